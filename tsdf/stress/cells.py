"""Cells of the stability report: a figure, its error, and the verdict that follows from both by one rule.

Every figure is made so that it ought to be 0: a deviation from the truth, a share of light lost or leaked, a relative
variance. It may be as large as the row's limit. What is measured, and by whom, is in the modules beside this one.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import tsdf
from tsdf.data import library
from tsdf.data.table import Table
from tsdf.scene.levels import LEVELS

HOLDS, FAILS, UNSURE, NOT, TRUTH = "holds", "fails", "cannot tell", "does not apply", "the truth"
REFUSED = "refused"  # begins a note: nothing was done, and this was said
BEYOND, WITHIN = (
    3.0,
    2.0,
)  # standard errors beyond its limit from which on a figure fails, and within it, where it holds

TRACER, TABLES, HYBRID = "tracer", "tables", "5 explicit"
LEAPS, VOLUME_LEAPS, ISOTROPIC_LEAPS = "memory + leaps", "volume + leaps", "isotropic + leaps"
OURS = {
    TRACER: "single grains as `tsdf-build` traces them",
    TABLES: "what tables hold and how they are drawn from",
    **{name: f"level `{name}`" for name in LEVELS},
    "teleport-joint": "level `teleport-joint`: exponential flights, without memory",
    "teleport": "level `teleport`: exponential flights, independent offsets; as published",
    LEAPS: "level `teleport-memory`, many events in one step deep inside",
    VOLUME_LEAPS: "the same, level `volume`",
    ISOTROPIC_LEAPS: "the same, level `isotropic`",
    HYBRID: "five explicit grains, then level `teleport-memory`",
}
NAIVE = {
    "no offset": "rays start where they hit",
    "along the ray": "rays start 1e-6 of the scene's size further along",
    "fixed offset": "rays start 1e-4 scene units off the surface, whatever their size",
    "engine alone": "what the ray engine misses is missed",
    "as it comes": "a mesh is traced as its file has it",
    "cap 10": "light ends after 10 bounces",
    "cap 32": "light ends after 32 bounces",
    "1280 facets": "a mesh of so many triangles for a sphere",
    "5120 facets": "a mesh of so many triangles for a sphere",
    "half-precision CDF": "cumulative masses as 16-bit floats",
    "32-bit counters": "counts and energies as 32-bit floats",
    "search from left": "the first cell whose cumulative mass is at least u, u a 32-bit float",
    "edges at 0": "cells of azimuth from -pi to pi, so that 0 is an edge",
    "capped roulette": "paths go on with probability 0.95 at most, from the fifth event on, and are weighted for it",
    "depth cap": "paths end after 12 events",
    "4R/3f flights": "point scatterers with the mean free path 4 R / (3 f)",
    "reset flights": "level `teleport-memory`, but each flight forgets where on its sphere light left",
    "untested jumps": "from entry to exit of a grain without a look at what lies between",
    "toggled medium": "inside becomes outside at each facet met, rays start 1e-4 further along",
    "leaps about p": "balls about where light is, not about where it will be in the mean",
}
METHODS = OURS | NAIVE


class Measured(NamedTuple):
    """A figure of a method, in the unit of its row, and its standard error; not a number where it does not apply.

    truth: whether others are held against it; then the figure is 0, and the error that of the truth.
    """

    method: str
    value: float
    error: float = 0.0
    note: str = ""
    truth: bool = False


class Cell(NamedTuple):
    """What was measured, the verdict, and the processor time that it took [s].

    known: where it is documented that this method of ours fails here, "" where it is claimed to hold.
    """

    measured: Measured
    verdict: str
    known: str
    seconds: float

    @property
    def ours(self) -> bool:
        return self.measured.method in OURS

    @property
    def broken(self) -> bool:
        """Whether a method of ours fails where it is claimed to hold."""
        return self.ours and not self.known and self.verdict == FAILS


@dataclass(frozen=True)
class Row:
    """A situation.

    Attributes
    ----------
    name : str
        By which it is asked for.
    group, title : str
    figure, unit : str
        What is measured, and in what.
    limit : float
        Up to which a figure holds [unit].
    measure : callable
        Given a `Setting` it yields what it measures.
    known : mapping
        Methods of ours that are not claimed to hold here, and where this is documented.
    quick : bool
        Whether it is a row of the quick form.
    claimed : bool
        Whether methods of ours that are not `known` to fail are claimed to hold.
    """

    name: str
    group: str
    title: str
    figure: str
    unit: str
    limit: float
    measure: Callable[["Setting"], Iterator[Measured]]
    known: Mapping[str, str] = field(default_factory=dict)
    quick: bool = True
    claimed: bool = True


def verdict(value: float, error: float, limit: float) -> str:
    """Return the verdict on a figure that ought to be 0 and may be as large as a limit.

    It fails where it is more than 3 standard errors above the limit, and holds where it is 2 below it; else nobody can
    tell.

    Examples
    --------
    >>> verdict(0.2, 0.1, 1.0), verdict(5.0, 0.1, 1.0), verdict(5.0, 3.0, 1.0), verdict(0.2, 0.9, 1.0)
    ('holds', 'fails', 'cannot tell', 'cannot tell')
    """
    if math.isnan(value):
        return NOT
    if abs(value) - BEYOND * error > limit:
        return FAILS
    return HOLDS if abs(value) + WITHIN * error <= limit else UNSURE


def share(method: str, count: float, among: int, note: str = "") -> Measured:
    """Return a share of independent events in per cent; of none at all the error is that of one."""
    p = count / among
    return Measured(method, 100.0 * p, 100.0 * math.sqrt(max(p * (1.0 - p), 1.0 / among) / among), note)


def relative(method: str, value: tuple[float, float], truth: tuple[float, float], note: str = "") -> Measured:
    """Return the deviation of a number from the truth in per cent, both with their errors."""
    off = value[0] / truth[0] - 1.0
    error = math.hypot(value[1], (1.0 + off) * truth[1]) / truth[0]
    return Measured(method, 100.0 * off, 100.0 * abs(error), note)


def known_to(method: str, truth: tuple[float, float]) -> Measured:
    """Return the cell of the method that others are held against."""
    return Measured(method, 0.0, 100.0 * abs(truth[1] / truth[0]), f"{truth[0]:.5g}", truth=True)


@dataclass(eq=False)
class Setting:
    """What rows are measured with: how much, and the tables that they share.

    Attributes
    ----------
    quick : bool
        Whether a tenth of the effort has to do.
    seed : int
    threads : int, optional
        All processors by default.
    table : Table, optional
        That rows about tables are to judge, instead of the ready ones.
    mesh : Path, optional
        Of its grain.
    """

    quick: bool = False
    seed: int = 0
    threads: int | None = None
    table: Table | None = None
    mesh: Path | None = None
    kept: dict[Any, Any] = field(default_factory=dict)

    def some(self, whole: int) -> int:
        """Return how many of something are taken, of which so many are in the whole form."""
        return max(1, whole // 10) if self.quick else whole

    def rng(self, number: int) -> np.random.Generator:
        """Return the random numbers of one use."""
        return np.random.default_rng((self.seed, number))

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` makes, once for each key."""
        if key not in self.kept:
            self.kept[key] = make()
        return self.kept[key]

    @cached_property
    def tables(self) -> dict[str, Table]:
        """The tables that are judged, by name."""
        if self.table is not None:
            return {"table": self.table}
        return {name: tsdf.library(name) for name in library.names()}

    @property
    def own(self) -> Table:
        """The table that rows are to judge."""
        assert self.table is not None
        return self.table

    @cached_property
    def ball(self) -> Table:
        """Return the exact sphere of eta 1.33."""
        return tsdf.build("sphere", 1.33, tsdf.Effort(cells=256, joint=32, memory=64), self.threads)

    @cached_property
    def mirror(self) -> Table:
        """Return the sphere that sends all light back from its surface."""
        return self.traced("sphere", 1e9)

    def traced(self, name: str, eta: float, paths: int = 200_000, **parameters: Any) -> Table:
        """Return the table of a traced grain."""

        def make() -> Table:
            from tsdf.make.scatterometer import Build

            grain = tsdf.load_grain(name, repair=False, **parameters)
            built = Build.start(grain, tsdf.Optics(eta), tsdf.Effort(paths, cells=128, joint=16, memory=64))
            built.run(grain, self.threads or 2)
            return built.table()

        made: Table = self.once((name, eta, paths, *parameters.items()), make)
        return made


def attempted(methods: Sequence[str], measure: Callable[[str], Measured]) -> Iterator[Measured]:
    """Yield what is measured of each method, or why it does not apply."""
    from tsdf.errors import TSDFError

    for method in methods:
        try:
            yield measure(method)
        except TSDFError as error:
            yield Measured(method, math.nan, note=str(error).splitlines()[0])
