"""Accuracy: how right each level is where it can be told exactly; bulk diffusion and slabs, against packed grains.

What is measured is `experiment`; here it is done for every level, fraction and slab. Errors of packed grains come from
the paths and from the spread over packings. Errors of whole pictures are `compare`'s, charts `plots`'.
"""

import contextlib
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import TSDFError, UsageError
from tsdf.scene import levels as L
from tsdf.scene.levels import DETAILED as MEASURED
from tsdf.scene.medium import MAX_PACKING_FRACTION
from tsdf.scene.scene import LEVELS, Absorption, GrainSpec
from tsdf.spheres.packing import MAX, pack
from tsdf.study.experiment import (
    BLOCKS,
    MOST_CUTS,
    PROFILE,
    SPHERES,
    Experiment,
    Sums,
    block_of,
    bulk_experiment,
    cuts,
    gather,
    slab_experiment,
)
from tsdf.study.experiment import diffusion as diffusion
from tsdf.study.experiment import follow as follow
from tsdf.study.experiment import slab as slab
from tsdf.walk.explicit import exemplar

FRACTIONS = (0.1, 0.3, 0.5, 0.6, 0.64)
LAYERS = (2.0, 4.0, 10.0, 40.0)  # [R]
ANGLES = (0.0, 60.0)  # [degrees]
DARKEST = 100.0  # [1/R] absorption coefficient up to which that albedo is looked for
ALBEDO = 0.99  # of a grain, in slabs that absorb
SECONDS = 300.0
LEAST_PACKINGS, MOST_PACKINGS = 4, 100
MOST_RUNS = MOST_PACKINGS * MOST_CUTS  # of one case at one level, each with random numbers of its own
SHOWN = 0.6  # packing fraction that the chart's slabs are nearest to
BULK, TIMED = 0.25, 0.1  # shares of the time for the bulk and for the time per event
ROUNDS = 5  # of all levels in turn, for the time per event
LARGEST_SEED = 2**63
MOVED = tuple(
    name for name, level in L.LEVELS.items() if not level.traits.spheres
)  # levels whose free path depends on absorption


# ---------------------------------------------------------------------------------------------- the grid


@dataclass(frozen=True)
class Row:
    """One number of one level.

    Attributes
    ----------
    quantity : str
        "displacement": mean squared displacement per event in the bulk [R^2]; "reflectance", "transmittance" of a slab
        [1]; "profile": total variation of the light that comes back over the distance from the beam, to explicit [1];
        "time": processor time per event over that of teleport [1].
    level : str
    fraction : float
        Packing fraction [1].
    layer, angle_deg, albedo : float
        Of slabs: thickness of the layer of centres [R], angle to the normal [degrees], a grain's albedo [1]; else nan.
    value, error : float
        And its standard error; of a profile, what counting alone would give on average.
    paths_error, packings_error : float
        Of levels of packed grains, what the error owes to counting and what to the places of the grains; 0 where that
        cannot be told from counting. The error is not less than the spread over packings says. Else nan.
    deviation, deviation_error : float
        From explicit, over it, with both errors [1]; nan where there is none.
    """

    quantity: str
    level: str
    fraction: float
    layer: float
    angle_deg: float
    albedo: float
    value: float
    error: float
    paths_error: float = math.nan
    packings_error: float = math.nan
    deviation: float = math.nan
    deviation_error: float = math.nan


@dataclass(frozen=True)
class Accuracy:
    """What `measure` found.

    Attributes
    ----------
    name : str
        Of the grain, and its refractive index.
    levels : tuple of str
        Those that there are rows of.
    fraction : float
        Whose slabs and times charts show: that nearest to 0.6.
    packings, block : int
        Behind levels of packed grains; events of a block in the bulk.
    rows : tuple of Row
    notes : tuple of str
        What was skipped, one line each.
    interrupted : bool
    """

    name: str
    levels: tuple[str, ...]
    fraction: float
    packings: int
    block: int
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    interrupted: bool


class _Case(NamedTuple):
    """A bulk, its layer nan, or a slab."""

    fraction: float
    layer: float
    angle_deg: float


class _Found(NamedTuple):
    """Numbers (q,) of a case at a level, their errors, and of explicit what these owe to paths and to packings."""

    mean: np.ndarray
    error: np.ndarray
    paths: np.ndarray
    packings: np.ndarray


def measure(
    grain: GrainSpec,
    fractions: Sequence[float] = FRACTIONS,
    layers: Sequence[float] = LAYERS,
    levels: Sequence[str] = MEASURED,
    packings: int = LEAST_PACKINGS,
    seconds: float | None = None,
    paths: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[float, str], None] | None = None,
    name: str = "table",
) -> Accuracy:
    """Measure levels against packed grains: in the bulk, in slabs, and what an event takes.

    Parameters
    ----------
    grain : GrainSpec
        Its absorption is not looked at: slabs are lossless, and of grains of albedo 0.99.
    fractions, layers : sequences of float
        Packing fractions [1], and thicknesses of layers of centres [R].
    levels : sequence of str
        Explicit is measured in any case.
    packings : int
        Behind explicit, 4 to 100.
    seconds : float, optional
        About the time of it all on the clock, after a start in which packings are made and kernels compiled [s]; 300 if
        paths are not given either. What the start took is a note.
    paths : int, optional
        Paths of each slab and level instead, of explicit in each packing; a bulk has as many blocks of events.
    seed : int
        Every level, case and packing has random numbers of its own.
    progress : callable, optional
        Called with the share done and what is being done.
    name : str
        What messages call the table.

    Raises
    ------
    UsageError, TSDFError
        In one line. A level that is impossible, at one packing fraction or at all, becomes a note instead.
    """
    table = _checked(grain, fractions, layers, levels, packings, seconds, paths)
    if min(fractions) > MAX:
        raise UsageError(
            f"packing fraction {min(fractions):g}: random packings, which levels are held against, end at {MAX}"
        )
    if paths is None and seconds is None:
        seconds = SECONDS
    exemplar(grain, table, name)  # explicit has to find it
    notes: list[str] = []
    some = tuple(level for level in LEVELS if level in ("explicit", *levels))
    some = tuple(level for level in some if not _lacks(level, table, notes))
    spec, fractions = replace(grain, table=table, absorption=Absorption("grey", (0.0,))), sorted(set(fractions))
    run = _Run(spec, table, packings, seconds, paths, seed, threads, progress, notes, some)
    cases = [_Case(f, math.nan, math.nan) for f in fractions]
    cases += [_Case(f, layer, angle) for f in fractions for layer in sorted(set(layers)) for angle in ANGLES]
    shown = min(fractions, key=lambda f: abs(f - SHOWN))
    rows, interrupted = [], False
    try:
        run.start(fractions)
        for number, case in enumerate(cases):
            rows += run.case(case, number, len(fractions), len(cases))
        rows += run.times(shown)
        run.end()
    except KeyboardInterrupt:
        interrupted = True
    there = tuple(level for level in some if any(row.level == level for row in rows))
    title = f"{table.header['grain']['name']}, eta = {table.header['optics']['eta']:g}"
    return Accuracy(
        title, there, shown, packings, block_of(table), tuple(rows), tuple(dict.fromkeys(notes)), interrupted
    )


def _checked(
    grain: GrainSpec, fractions: Sequence[float], layers: Sequence[float], levels: Sequence[str], packings: int,
    seconds: float | None, paths: int | None,
) -> Table:  # fmt: skip
    if unknown := [level for level in levels if level not in LEVELS]:
        raise UsageError(f"no level {unknown[0]!r}; levels are {', '.join(LEVELS)}")
    if not LEAST_PACKINGS <= packings <= MOST_PACKINGS:
        raise UsageError(
            f"packings are {LEAST_PACKINGS} to {MOST_PACKINGS}, for their spread is an error, not {packings}"
        )
    if bad := [f for f in fractions if not 0.0 < f <= MAX_PACKING_FRACTION] or not fractions:
        raise UsageError(f"packing fractions are above 0 and at most {MAX_PACKING_FRACTION}, not {bad}")
    if bad := [layer for layer in layers if not 0.0 < layer < math.inf]:
        raise UsageError(f"layers are finite numbers above 0, not {bad[0]:g}")
    if seconds is not None and paths is not None:
        raise UsageError("seconds and paths each say when it is done: give one")
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise UsageError(f"seconds are a finite number above 0, not {seconds:g}")
    if paths is not None and paths < 64:
        raise UsageError(f"paths are a whole number of at least 64, not {paths}")
    return grain.table if isinstance(grain.table, Table) else tsdf_format.read(grain.table)


def _lacks(level: str, table: Table, notes: list[str]) -> bool:
    """Return whether a table lacks what a level draws from, and note it."""
    records = L.LEVELS[level].records
    if records is None or getattr(table, records.block):
        return False
    notes.append(f"{level} is skipped: the table has no {records.name}; build it with {records.option}")
    return True


@dataclass(eq=False)
class _Run:
    """What is common to all that `measure` does, and how far it is."""

    grain: GrainSpec
    table: Table
    packings: int
    seconds: float | None
    paths: int | None
    seed: int
    threads: int | None
    progress: Callable[[float, str], None] | None
    notes: list[str]
    levels: tuple[str, ...]
    done: float = 0.0
    began: float = 0.0

    def __post_init__(self) -> None:
        self.block = block_of(self.table)
        self.coefficients: tuple[float, ...] = (0.0,)  # of absorption, for lossless slabs and others [1/R]
        if self.left(DARKEST) < 0.0:
            self.coefficients += (float(brentq(self.left, 0.0, DARKEST)),)
        else:
            self.notes.append("slabs that absorb are left out: too little light is ever inside a grain")

    def left(self, coefficient: float) -> float:
        """Return by how much the albedo of a grain that absorbs is above what is asked for."""
        return self.table.albedo(coefficient) / self.table.albedo() - ALBEDO

    def start(self, fractions: Sequence[float]) -> None:
        """Make what is made once for this machine, packings and kernels, outside the time, and say what that took."""
        began = time.perf_counter()
        missing = [(f, k) for f in fractions if f <= MAX for k in range(self.packings)]
        for number, (f, k) in enumerate(missing, 1):
            self.told(0.0, f"start: packing {number} of {len(missing)}")
            with contextlib.suppress(TSDFError):  # told where it is used
                pack(f, SPHERES, k)
        self.told(0.0, "start: kernels, compiled once for this machine")
        made = self.possible("explicit", fractions[0], lambda: bulk_experiment("explicit", self.grain, fractions[0]))
        if made is not None:
            gather(made, 1, threads=1)
        self.began = time.perf_counter()
        if self.seconds is not None:
            self.notes.append(f"{self.seconds:g} s of measuring follow a start of {self.began - began:.1f} s")

    def end(self) -> None:
        """Say so where it took longer than it was to."""
        took = time.perf_counter() - self.began
        if self.seconds is not None and took > 1.1 * self.seconds:
            self.notes.append(f"it took {took:.0f} s, for each of so many slabs and levels takes the fewest paths")

    def time(self, share: float) -> float | None:
        """Return what a share of the time is, less what is overspent already [s]; None where paths are counted."""
        if self.seconds is None:
            return None
        return min(share * self.seconds, self.began + self.done * self.seconds - time.perf_counter())

    def told(self, share: float, word: str) -> None:
        """Say that something is begun, which is a share of the whole."""
        if self.progress is not None:
            self.progress(min(self.done, 1.0), word)
        self.done += share

    def possible(self, level: str, fraction: float, make: Callable[[], Experiment]) -> Experiment | None:
        """Return an experiment, or None and a note why not."""
        try:
            return make()
        except TSDFError as error:
            self.notes.append(f"{level} is skipped at packing fraction {fraction:g}: {error}")
            return None

    def case(self, case: _Case, number: int, bulks: int, cases: int) -> list[Row]:
        """Return the rows of one case."""
        bulk = math.isnan(case.layer)
        most = 1.0 - TIMED if bulks == cases else BULK
        share = most / bulks if bulk else (1.0 - BULK - TIMED) / (cases - bulks)
        share /= sum(self.packings if L.LEVELS[level].traits.packed else 1 for level in self.levels)
        found: dict[str, _Found] = {}
        word = f"packing fraction {case.fraction:g}, "
        word += "bulk" if bulk else f"layer of {case.layer:g} R at {case.angle_deg:g} degrees"
        tops = [0.0] if bulk else cuts(case.fraction, case.layer)
        for level in self.levels:
            several = L.LEVELS[level].traits.packed
            runs = [(k, top) for top in tops for k in range(self.packings)] if several else [(0, 0.0)]
            own = share * (self.packings if several else 1) / len(runs)
            sums = []
            for k, (packing, top) in enumerate(runs):
                self.told(own, f"{word}, {level}" + (f" {k + 1} of {len(runs)}" if len(runs) > 1 else ""))
                one = self.one(level, case, packing, top, own, MOST_RUNS * (len(LEVELS) * number) + k)
                if one is None:
                    self.done += own * (len(runs) - k - 1)
                    break
                sums.append(one)
            if lost := sum(one.lost for one in sums):
                self.notes.append(f"{word}, {level}: {lost} paths were lost, and are left out")
            if sums:
                found[level] = _packed(sums)
        return _bulk_rows(case, found) if bulk else _slab_rows(case, found)

    def one(self, level: str, case: _Case, packing: int, top: float, share: float, number: int) -> Sums | None:
        """Return what a level makes of a case in one packing; None where it is impossible."""
        f = case.fraction
        seed = (self.seed + 1 + MOST_RUNS * LEVELS.index(level) + number) % LARGEST_SEED
        if math.isnan(case.layer):
            made = self.possible(level, f, lambda: bulk_experiment(level, self.grain, f, packing, self.block))
            paths = self.paths and max(16, self.paths // BLOCKS)
            return gather(made, paths, self.time(share), seed, self.threads) if made else None
        cosine, several = math.cos(math.radians(case.angle_deg)), self.coefficients
        if level not in MOVED:
            made = self.possible(
                level, f, lambda: slab_experiment(level, self.grain, f, case.layer, cosine, packing, several, top)
            )
            return gather(made, self.paths, self.time(share), seed, self.threads) if made else None
        each = []
        for k, c in enumerate(several):
            grain = replace(self.grain, absorption=Absorption("grey", (c,)))
            made = self.possible(level, f, lambda grain=grain: slab_experiment(level, grain, f, case.layer, cosine))  # type: ignore[misc]
            if made is None:
                return None
            seconds = self.time(share / len(several))
            each.append(gather(made, self.paths, seconds, seed + k, self.threads))
        return _beside(each)

    def times(self, fraction: float) -> list[Row]:
        """Return rows of processor time per event in the bulk, from runs of all levels in turn."""
        made = {}
        for level in dict.fromkeys((*self.levels, "teleport")):
            one = self.possible(
                level,
                fraction,
                lambda level=level: bulk_experiment(level, self.grain, fraction, 0, self.block, 8),  # type: ignore[misc]
            )
            if one is not None:
                made[level] = one
        if "teleport" not in made:
            return []
        share = TIMED / ROUNDS / len(made)
        ratios: dict[str, list[float]] = {level: [] for level in made}
        for k in range(ROUNDS):
            taken = {}
            for level, one in made.items():
                self.told(share, f"time per event, {level}")
                paths = self.paths and max(16, self.paths // BLOCKS)
                taken[level] = gather(one, paths, self.time(share), k, self.threads).event
            for level, event in taken.items():
                ratios[level].append(event / taken["teleport"])
        rows = []
        for level in self.levels:
            if level in ratios:
                middle = statistics.median(ratios[level])
                spread = 1.48 * statistics.median(abs(ratio - middle) for ratio in ratios[level])
                error = 1.25 * spread / math.sqrt(ROUNDS)
                rows.append(Row("time", level, fraction, math.nan, math.nan, math.nan, middle, error))
        return rows


def _beside(runs: Sequence[Sums]) -> Sums:
    """Return the numbers of runs one after the other, as if of two paths each, and with their errors."""
    mean, error = np.concatenate([one.mean for one in runs]), np.concatenate([one.error for one in runs])
    return Sums(
        paths=2,
        total=2.0 * mean,
        squares=2.0 * (mean**2 + error**2),
        events=sum(one.events for one in runs),
        drawn=sum(one.drawn for one in runs),
        seconds=sum(one.seconds for one in runs),
    )


def _packed(sums: Sequence[Sums]) -> _Found:
    """Return the mean over packings, or slabs from them, and its error: from paths, or from what these differ by where
    that is more."""
    means, errors = np.array([one.mean for one in sums]), np.array([one.error for one in sums])
    paths = np.sqrt((errors**2).sum(axis=0)) / len(sums)
    if len(sums) == 1:
        nothing = np.full_like(paths, math.nan)
        return _Found(means[0], paths, nothing, nothing)
    spread = means.std(axis=0, ddof=1) / math.sqrt(len(sums))
    return _Found(means.mean(axis=0), np.maximum(paths, spread), paths, np.sqrt(np.maximum(spread**2 - paths**2, 0.0)))


def _compared(quantity: str, case: _Case, albedo: float, at: int, found: dict[str, _Found]) -> list[Row]:
    """Return a row for each level of the number that stands at a place of what was found."""
    truth, rows = found.get("explicit"), []
    for level, one in found.items():
        value, error = float(one.mean[at]), float(one.error[at])
        row = Row(quantity, level, *case, albedo, value, error, float(one.paths[at]), float(one.packings[at]))
        if truth is not None and truth.mean[at] > 0.0 and level != "explicit":
            true, own = float(truth.mean[at]), float(truth.error[at])
            both = math.hypot(error / true, value * own / true**2)
            row = replace(row, deviation=value / true - 1.0, deviation_error=both)
        rows.append(row)
    return rows


def _bulk_rows(case: _Case, found: dict[str, _Found]) -> list[Row]:
    return _compared("displacement", case, math.nan, 0, found)


def _slab_rows(case: _Case, found: dict[str, _Found]) -> list[Row]:
    rows, each = [], 1 + len(PROFILE)
    most = max((len(one.mean) for one in found.values()), default=0)
    for k, albedo in enumerate((1.0, ALBEDO)[: most // each]):
        rows += _compared("reflectance", case, albedo, k * each, found)
        rows += _compared("transmittance", case, albedo, k * each + 1, found)
        if "explicit" not in found:
            continue
        (p, own), *others = (
            (one.mean[k * each + 2 : (k + 1) * each], one.error[k * each + 2 : (k + 1) * each])
            for one in (found["explicit"], *(one for level, one in found.items() if level != "explicit"))
        )
        for level, (q, error) in zip((level for level in found if level != "explicit"), others, strict=True):
            if p.sum() > 0.0 and q.sum() > 0.0:
                far = 0.5 * float(np.abs(p / p.sum() - q / q.sum()).sum())
                noise = 0.5 * math.sqrt(2.0 / math.pi) * float(np.hypot(own / p.sum(), error / q.sum()).sum())
                rows.append(Row("profile", level, *case, albedo, far, noise))
    return rows
