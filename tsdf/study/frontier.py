"""Frontier: what each way to render a scene gets wrong, and what it costs, measured against single grains.

Everything is measured in independent runs, each with a packing of its own, the scene's the first. A run has a picture
of the truth, level explicit, and one of each candidate in the same packing, all with random numbers of their own; the
errors of all that is stated are the spread of the runs. What an error is says `candidates`; noise is taken off squares
by the variance of the samples, so that what stays when time goes on, the floor, is a number. Time is processor time,
all threads together. `ranking` orders candidates, `frontier_files` writes results and reads them again,
`frontier_plots` draws them.
"""

import math
import struct
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import TSDFError, UsageError
from tsdf.picture import render
from tsdf.picture.render import Picture
from tsdf.picture.trust import SHOWN, kurtosis_of
from tsdf.picture.world import World, build, sees
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import Scene
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.study.flip import hdr_flip
from tsdf.study.ranking import Estimate, Floor, floor_of, jackknife, mean_of
from tsdf.study.regions import regions
from tsdf.walk.explicit import Packed, packed

SECONDS, RUNS = 240.0, 10  # of a scene [s], where nothing is said
TRUTH = 0.45  # share of the time for the truth, which all candidates are measured against
LEAST_RUNS, MOST_RUNS = 2, 1000
TRIAL = 0.1  # share of a run's time after which a trial says how many samples it can have
DOUBLINGS = 4  # of the samples of a run, at which its error is measured
TRUE = 4.0  # times that the truth is to meet lights a pixel, if by chance alone: its noise is in all errors
LEAST_SAMPLES = 2  # of a pixel, for one has no variance
MOST_PIXELS = 20_000_000  # of all pictures, which are in memory until the end: a gigabyte
MEETINGS = 1.0 / SHOWN  # of lights that only chance finds, below which a picture of them is not believed
UNSURE = 0.2  # relative noise of the truth's pixels in a run, from which on the user is told
LARGEST_SEED = 2**63


@dataclass(frozen=True)
class Measured:
    """A candidate, in numbers of each run; relative ones are over the truth's mean of the whole picture, all runs.

    Attributes
    ----------
    candidate : Candidate
    samples : int
        Of each pixel in a run.
    pixels : int
    bytes : int
        Of the arrays it draws from, see `footprint`.
    seconds : (runs,) tuple of float
        Processor time of each run [s].
    noise : (runs,) tuple of float
        Squared standard error of its pixels [1].
    squares : (runs,) tuple of float
        Mean squared difference of pixels to the truth in the same packing, noise of both taken off [1].
    bias : dict of (runs,) tuples of float
        Difference of the means of each region over the truth's mean there, of the whole where that is black [1].
    flip : (runs,) tuple of float
        HDR-FLIP to the truth, noise of both included [1].
    curve : tuple of (float, tuple)
        Processor time and the squared error then, the truth's noise taken off, of each run; as samples double.
    lost : int
        Paths given up.
    """

    candidate: Candidate
    samples: int
    pixels: int
    bytes: int
    seconds: tuple[float, ...]
    noise: tuple[float, ...]
    squares: tuple[float, ...]
    bias: Mapping[str, tuple[float, ...]]
    flip: tuple[float, ...]
    curve: tuple[tuple[float, tuple[float, ...]], ...]
    lost: int = 0

    @property
    def floor(self) -> Floor:
        """What is left of the error when all noise is gone: bias and texture."""
        return floor_of(mean_of(self.squares), len(self.squares))

    @property
    def texture_square(self) -> Estimate:
        """Square of what the expected picture misses but for its mean; below zero by chance where that is nothing."""
        pairs = np.column_stack([self.squares, self.bias["whole"]])

        def texture(some: np.ndarray) -> float:
            noise = some[:, 1].var(ddof=1) / len(some) if len(some) > 1 else 0.0
            return float(some[:, 0].mean() - some[:, 1].mean() ** 2 + noise)

        return jackknife(pairs, texture)

    @property
    def noise_seconds(self) -> tuple[float, ...]:
        """Squared noise times processor time [s] in each run: noise after t seconds is the root of it over t."""
        return tuple(n * s for n, s in zip(self.noise, self.seconds, strict=True))

    @property
    def seconds_per_sample(self) -> float:
        """Processor time of one sample of one pixel [s]."""
        return float(np.mean(self.seconds)) / (self.samples * self.pixels)


@dataclass(frozen=True)
class Frontier:
    """All candidates of a scene.

    Attributes
    ----------
    scene : str
    width, height : int
        Of the pictures [pixel].
    seed : int
    truth : str
        Level of the truth.
    truth_samples : int
        Of each of its pixels in a run.
    truth_seconds, truth_noise : (runs,) tuple of float
        Its processor time [s] and the relative standard error of its pixels [1].
    regions : dict
        Share of the pixels in each region.
    rows : tuple of Measured
        Best level first.
    notes : tuple of str
        What was left out, and what the user should know, one line each.
    asked : int
        Runs that were asked for; fewer were done where it was interrupted.
    """

    scene: str
    width: int
    height: int
    seed: int
    truth: str
    truth_samples: int
    truth_seconds: tuple[float, ...]
    truth_noise: tuple[float, ...]
    regions: Mapping[str, float]
    rows: tuple[Measured, ...]
    notes: tuple[str, ...]
    asked: int

    @property
    def runs(self) -> int:
        """How many runs were done."""
        return len(self.truth_seconds)

    @property
    def spent(self) -> float:
        """Processor time of all of it [s]."""
        return sum(self.truth_seconds) + sum(sum(row.seconds) for row in self.rows)

    def exact(self, row: Measured) -> bool:
        """Return whether a candidate is the truth's own level: its floor is 0, what was measured of it a control."""
        return row.candidate == Candidate(self.truth)

    def squares(self) -> np.ndarray:
        """Return (candidates, runs) the squared floors of each run, 0 for the truth's own level; those of a candidate
        whose mean comes out below zero, which it cannot be, are moved there."""
        squares = np.array([np.zeros(self.runs) if self.exact(row) else row.squares for row in self.rows])
        return squares - np.minimum(squares.mean(axis=1, keepdims=True), 0.0)

    def squared_errors(self, seconds: float) -> np.ndarray:
        """Return (candidates, runs) the squared errors after so much processor time [s]."""
        return self.squares() + np.array([row.noise_seconds for row in self.rows]) / seconds

    def biases(self) -> np.ndarray:
        """Return (candidates, runs) the bias of the whole in each run, 0 for the truth's own level."""
        return np.array([np.zeros(self.runs) if self.exact(row) else row.bias["whole"] for row in self.rows])

    def floor(self, row: Measured) -> Floor:
        """Return the floor of a candidate, 0 for the truth's own level."""
        return Floor(0.0, 0.0, 0.0, True) if self.exact(row) else row.floor


def measure(
    scene: Scene,
    chosen: Sequence[Candidate] | None = None,
    seconds: float = SECONDS,
    runs: int = RUNS,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[float, str], None] | None = None,
    stop: threading.Event | None = None,
) -> Frontier | None:
    """Measure the candidates of a scene against its truth; None where it was stopped before two runs were done.

    Parameters
    ----------
    scene : Scene
    chosen : sequence of Candidate, optional
        All by default.
    seconds : float
        About the time of everything [s], by the clock, but for what is made ready before the first sample.
    runs : int
        Independent ones, 2 to 1000; ten are few enough to be quick and enough for their spread to be known.
    seed, threads
        As of `render.render`.
    progress : callable, optional
        Called with the share done, 0 until there is something to keep, and a word about it.
    stop : Event, optional
        Set by others to end early; the runs done so far are kept.

    Raises
    ------
    UsageError, SceneError, FormatError
        In one line; a candidate that alone is impossible becomes a note instead.
    """
    if not LEAST_RUNS <= runs <= MOST_RUNS:
        raise UsageError(f"--runs is {LEAST_RUNS} to {MOST_RUNS}, for their spread is the error, not {runs}")
    if not 0.0 < seconds < math.inf:
        raise UsageError(f"--seconds is a finite number above 0, not {seconds}")
    stop, told = stop or threading.Event(), progress or (lambda share, word: None)
    told(0.0, "reading the scene")
    sized = Sizing(seconds / runs, runs, seed, threads, stop)
    left = Left()
    truth = truth_of(scene, sized, left)
    ways = possible(scene, candidates() if chosen is None else chosen, truth, left, told, stop)
    if stop.is_set():
        return None
    if not sees(truth.world):
        raise UsageError(f"{scene.name}: a camera looking at nothing: it sees neither a medium nor a surface")
    pixels, pictures = scene.camera.width * scene.camera.height, runs * (1 + len(ways))
    if pixels * pictures > MOST_PIXELS:
        raise UsageError(
            f"{scene.name}: {pictures} pictures of {scene.camera.width} x {scene.camera.height} pixels do not fit into "
            "memory; give a smaller --width, which is sooner as well"
        )
    told(0.0, "trying how long samples take")
    truth.samples = sized.of(truth.world, TRUTH)
    ways = seeing(scene, ways, sized, 1.0 - TRUTH, left)
    if stop.is_set():
        return None
    packings = Packings(scene)
    for run in range(runs):
        for number, way in enumerate((truth, *ways)):
            if stop.is_set():
                break
            done = (run + number / (1 + len(ways))) / runs
            told(done if run >= LEAST_RUNS else 0.0, f"run {run + 1} of {runs}, {'truth' if way is truth else way}")
            way.take(packings.of(way.world, run), run, None if way is truth else truth.runs[run], seed, threads, stop)
        if stop.is_set():
            break
    done = min(len(way.runs) for way in (truth, *ways))
    return summed(scene, truth, ways, done, sized, left) if done >= LEAST_RUNS else None


# --------------------------------------------------------------------------------------------- rendering


@dataclass(eq=False)
class Way:
    """A candidate on its way: its world, the samples of a pixel in a run, the picture of each run, and its processor
    time and squared difference to the truth as samples double."""

    candidate: Candidate
    world: World
    stream: int  # another for each, so that no two pictures share random numbers
    samples: int = LEAST_SAMPLES
    runs: list[Picture] = field(default_factory=list)
    grown: list[list[tuple[float, float]]] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return str(self.candidate)

    def take(
        self, world: World, run: int, truth: Picture | None, seed: int, threads: int | None, stop: threading.Event
    ) -> None:
        """Add a run, unless it is stopped: a picture of a few samples and, each time, as many more."""
        steps = min(DOUBLINGS, int(math.log2(self.samples / LEAST_SAMPLES))) if truth else 0
        first, whole, grown = self.samples >> steps, None, []
        for step in range(steps + 1):
            number = ((self.stream * MOST_RUNS) + run) * (DOUBLINGS + 1) + step + 1
            picture = _shot(world, first << max(step - 1, 0), (seed + number) % LARGEST_SEED, threads, stop)
            if picture.interrupted:
                return
            whole = _together(whole, picture) if whole else picture
            if truth:
                grown.append((whole.processor_seconds, square(whole, truth, False, 1.0)))
        assert whole is not None
        if whole.trust is not None and whole.trust.doubt is not None and not whole.trust.few:  # runs tell
            self.doubts.append(whole.trust.doubt)
        self.runs.append(replace(whole, trust=None))
        self.grown.append(grown)


class Packings:
    """The packings of each run, made when they are asked for and only as long as it lasts."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.run, self.made = scene, -1, dict[bool, Packed]()
        grains = [grain.table for medium in scene.media for grain in medium.grains]
        self.tables = [table if isinstance(table, Table) else tsdf_format.read(table) for table in grains]

    def of(self, world: World, run: int) -> World:
        """Return a world with the packing of a run, the scene's own for the first."""
        if not world.media.singles or not self.scene.media:
            return world
        if run != self.run:
            self.run, self.made = run, {}
        traced = not LEVELS[world.level].traits.answered
        if traced not in self.made:
            self.made[traced] = packed(_repacked(self.scene, run), self.tables, traced)
        return replace(world, packed=self.made[traced])


def _repacked(scene: Scene, k: int) -> Scene:
    media = tuple(replace(m, packing_seed=(m.packing_seed + k) % LARGEST_SEED) for m in scene.media)
    return replace(scene, media=media)


@dataclass(frozen=True)
class Sizing:
    """What the number of samples follows: time of a run by the clock [s], runs, and how they are rendered."""

    seconds: float
    runs: int
    seed: int
    threads: int | None
    stop: threading.Event

    def of(self, world: World, share: float) -> int:
        """Return how many samples of a pixel fit into a share of a run."""
        return _affordable(world, share * self.seconds, self.seed, self.threads, self.stop)

    def blind(self, world: World, samples: int, meetings: float = MEETINGS) -> bool:
        """Return whether all runs together meet suns and small bright lights too seldom, for a world that finds them by
        chance alone."""
        if not (world.media.singles and world.scene.media and world.lights.sampled) or self.stop.is_set():
            return False
        camera = world.scene.camera
        met = samples * self.runs * camera.width * camera.height / kurtosis_of(world.lights)
        return met < meetings


class Left(dict[str, list[str]]):
    """What is left out, by the reason why."""

    def add(self, reason: str, name: str) -> None:
        names = self.setdefault(reason, [])
        if name not in names:
            names.append(name)

    def notes(self) -> list[str]:
        """Return a line for each reason."""
        return [f"left out: {', '.join(names)}: {reason}" for reason, names in self.items()]


BLIND = (
    f"light from suns and small bright lights would be met by chance alone, less than {MEETINGS:g} times in all runs, "
    "and neither the picture nor its noise be known; widen them by a smooth sky, or give more seconds"
)


def truth_of(scene: Scene, sized: Sizing, left: Left) -> Way:
    """Return the best level that is possible and meets the lights."""
    failed: TSDFError | None = None
    for level in LEVELS:
        candidate = Candidate(level)
        try:
            world = build(taken(scene, candidate), level)
        except TSDFError as error:
            failed = failed or error
            left.add(str(error), str(candidate))
            continue
        few = max(TRUE * scene.camera.width * scene.camera.height, MEETINGS)
        if sized.blind(world, LEAST_SAMPLES, few) and sized.blind(world, sized.of(world, TRUTH), few):
            left.add(f"as the truth: suns and small lights would be met by less than {few:.0f} paths", str(candidate))
            continue
        return Way(candidate, world, 0)
    raise failed or UsageError(f"{scene.name}: {BLIND}")


def seeing(scene: Scene, ways: Sequence[Way], sized: Sizing, share: float, left: Left) -> list[Way]:
    """Return the candidates that meet the lights in as many samples as they are given here, all together in a share of
    a run."""
    found = []
    for way in ways:
        way.samples = sized.of(way.world, share / len(ways))
        if sized.blind(way.world, way.samples):
            left.add(BLIND, str(way))
        else:
            found.append(way)
    if not found and not sized.stop.is_set():
        raise UsageError(f"{scene.name}: none of {', '.join(map(str, ways))} is possible: {BLIND}")
    return found


def leaping(chosen: Sequence[Candidate], leaps: Sequence[float | None]) -> tuple[Candidate, ...]:
    """Return candidates with each of these least radii of leaps, smallest first; once where a level cannot leap."""
    radii = sorted(set(leaps), key=lambda leap: -1.0 if leap is None else leap)
    return tuple(
        one._replace(leap=leap) for one in chosen for leap in (radii if LEVELS[one.level].traits.leaps else (None,))
    )


def stream_of(candidate: Candidate) -> int:
    """Return the stream of random numbers of a candidate, from 1 on; another for each, whatever else is measured."""
    stream = 1 + list(LEVELS).index(candidate.level) + len(LEVELS) * candidate.explicit_grains
    if candidate.leap is not None:  # above all streams without: no chain has 2^24 explicit grains
        stream += (1 + zlib.crc32(struct.pack("<d", candidate.leap))) << 24
    return stream


def possible(
    scene: Scene, chosen: Sequence[Candidate], truth: Way, left: Left, told: Callable[[float, str], None],
    stop: threading.Event,
) -> list[Way]:  # fmt: skip
    """Return the candidates that can be made ready."""
    ways: list[Way] = []
    why = ""
    for candidate in chosen:
        if stop.is_set():
            return ways
        told(0.0, f"making {candidate} ready")
        try:
            world = truth.world
            if candidate != truth.candidate:
                world = build(taken(scene, candidate), candidate.level)
        except TSDFError as error:
            why = why or str(error)
            left.add(str(error), str(candidate))
            continue
        ways.append(Way(candidate, world, stream_of(candidate)))
    if not ways:
        raise UsageError(f"{scene.name}: none of {', '.join(map(str, chosen))} is possible: {why}")
    return ways


def _shot(world: World, spp: int, seed: int, threads: int | None, stop: threading.Event) -> Picture:
    return render.render(world, spp, seed=seed, threads=threads, stop=stop)


def _together(one: Picture, other: Picture) -> Picture:
    """Return the picture of the samples of two."""
    a, b = (picture.samples[..., None].astype(float) for picture in (one, other))
    return replace(
        other,
        rgb=(a * one.rgb + b * other.rgb) / (a + b),
        variance=(a**2 * one.variance + b**2 * other.variance) / (a + b) ** 2,
        samples=one.samples + other.samples,
        seconds=one.seconds + other.seconds,
        processor_seconds=one.processor_seconds + other.processor_seconds,
        truncated=one.truncated + other.truncated,
        faults=one.faults + other.faults,
    )


def _affordable(world: World, seconds: float, seed: int, threads: int | None, stop: threading.Event) -> int:
    """Return how many samples of each pixel fit into a time by the clock, from short trials; two at least."""
    tried, took = 1, 0.0
    while not stop.is_set():
        took = max(_shot(world, tried, seed, threads, stop).seconds, 1e-6)
        if took >= TRIAL * seconds:
            break
        tried *= 4
    return max(LEAST_SAMPLES, int(seconds / took * tried)) if took else LEAST_SAMPLES


# ----------------------------------------------------------------------------------------------- numbers


def summed(scene: Scene, truth: Way, ways: Sequence[Way], runs: int, sized: Sizing, left: Left) -> Frontier:
    """Return the numbers of so many runs."""
    references = truth.runs[:runs]
    mean_picture = np.mean([picture.rgb for picture in references], axis=0)
    scale = float(mean_picture.mean())
    if not scale > 0.0:
        raise UsageError(f"{scene.name}: the truth is black, and nothing is relative to that; give the scene light")
    masks, said = regions(truth.world, mean_picture)
    noise = tuple(math.sqrt(float(picture.variance.mean())) / scale for picture in references)
    if (pixels := math.sqrt(float(np.mean(np.square(noise))))) > UNSURE:
        said.append(
            f"the truth is only known to {100.0 * pixels:.2g} % per pixel in a run: give more seconds or fewer pixels"
        )
    if truth.doubts:
        said.append(f"the truth's own errors cannot be trusted in {len(truth.doubts)} runs: {truth.doubts[0]}")
    if runs < sized.runs:
        said.append(f"interrupted: {runs} of {sized.runs} runs")
    notes = dict.fromkeys(note for way in (truth, *ways) for note in way.world.notes)
    return Frontier(
        scene=scene.name,
        width=scene.camera.width,
        height=scene.camera.height,
        seed=sized.seed,
        truth=truth.candidate.level,
        truth_samples=truth.samples,
        truth_seconds=tuple(picture.processor_seconds for picture in references),
        truth_noise=noise,
        regions={name: float(mask.mean()) for name, mask in masks.items()},
        rows=tuple(numbers(way, references, masks, scale) for way in ways),
        notes=(*notes, *left.notes(), *said),
        asked=sized.runs,
    )


def numbers(way: Way, references: Sequence[Picture], masks: Mapping[str, np.ndarray], scale: float) -> Measured:
    """Return the numbers of a candidate."""
    ends = way.runs[: len(references)]
    pairs = list(zip(ends, references, strict=True))
    bias = {}
    for name, mask in masks.items():
        own = float(np.mean([reference.rgb[mask].mean() for reference in references]))
        far = [float(end.rgb[mask].mean() - reference.rgb[mask].mean()) for end, reference in pairs]
        bias[name] = tuple(one / (own if own > 0.0 else scale) for one in far)
    curve = []
    for step in zip(*way.grown[: len(references)], strict=True):
        curve.append((float(np.mean([spent for spent, _ in step])), tuple(error / scale**2 for _, error in step)))
    return Measured(
        candidate=way.candidate,
        samples=int(ends[0].samples.max()),
        pixels=ends[0].samples.size,
        bytes=footprint(way.world),
        seconds=tuple(end.processor_seconds for end in ends),
        noise=tuple(float(end.variance.mean()) / scale**2 for end in ends),
        squares=tuple(square(end, reference, True, scale) for end, reference in pairs),
        bias=bias,
        flip=tuple(hdr_flip(reference.rgb, end.rgb) for end, reference in pairs),
        curve=tuple(curve),
        lost=sum(end.truncated + end.faults for end in ends),
    )


def square(picture: Picture, truth: Picture, own: bool, scale: float) -> float:
    """Return the mean squared difference of the pixels of two independent pictures over `scale` squared, the noise of
    the second taken off and, if `own`, that of the first."""
    excess = (picture.rgb - truth.rgb) ** 2 - truth.variance - (picture.variance if own else 0.0)
    return float(excess.mean()) / scale**2


def footprint(world: World) -> int:
    """Return the bytes of the arrays that a level draws from: what it reads of tables, records, packings and leaps.

    Scene, lights and what the ray engine keeps of a grain's facets for itself are not counted.
    """
    traits, tables, axis = world.media.traits, world.tables, world.tables.start
    taken: list[Any] = [world.media, world.absorption]
    if traits.tabulated:
        taken += [tables.first, tables.theta, tables.theta_guide, tables.cos_theta, tables.cos_theta_guide]
        taken += [tables.per_steradian, tables.table]
        axes = range(3, 4)  # the path length
        if traits.joint:
            taken, axes = [*taken, tables.records, tables.record_count], range(0)
        elif traits.jumps:
            axes = range(4)
        for k in axes:
            part = slice(axis[k], axis[k + 1])
            taken += [tables.cumulative[:, part], tables.edges[:, part], tables.guide[:, k]]
    if traits.remembers:
        taken.append(world.memory)
    elif traits.answered:
        taken += [world.memory.choice, world.memory.hit, world.memory.columns, world.memory.grains, world.memory.kept]
    if world.media.singles:
        taken.append(world.packed.arrays)
    if world.leap > 0.0:
        taken.append(world.leaps)
    return sum(map(_bytes, taken))


def _bytes(held: Any) -> int:
    if isinstance(held, np.ndarray):
        return held.size * held.itemsize
    return sum(map(_bytes, held)) if isinstance(held, tuple) else 0
