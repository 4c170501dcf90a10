"""Pictures: samples of pixels shared out over threads, added up in a fixed order, with the variance of each pixel.

How a sample is followed is `transport`, what it is followed through is `world`. A sample's random numbers are a
function of (seed, pixel, number of the sample), and blocks of samples are the same whatever the number of threads, so
a picture of so many samples (`spp`) is the same to the last bit for any number of threads; one that the clock stopped
is not.
"""

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tsdf.compiled import compiled_for, not_ahead
from tsdf.errors import UsageError
from tsdf.handle import Handle
from tsdf.picture.trust import SHOWN, Moments, Trust, kurtosis_of
from tsdf.picture.world import World, camera_of, check_sight
from tsdf.scene.levels import LEVELS
from tsdf.walk import bodies, lanes, packed, standing, transport
from tsdf.walk import walker as W
from tsdf.walk.hybrid import ALL
from tsdf.walk.transport import CameraArrays

SLOTS = 2048  # walkers under way at once, per thread, but for shadows: their state stays in the second-level cache
ROOM = 4 * SLOTS
BLOCK = 65536  # samples of a block, about: the last few walkers of each wait for the ray engine alone
LEAST = 4096  # samples of a block, however few are asked for
LEAST_IN_LANES = 4 * LEAST  # for they take a third of the time
PIECES = 128  # of a pass: with few, threads wait for the one whose part of the picture is slowest
PARTS = 16  # of the time, so that it is kept; and blocks of the largest pass
FEW = 16  # samples per pixel of a pass of a large picture; the first has one, so that soon no pixel is black
BLACK = 256  # samples per pixel after which a black picture needs no smaller error
GROWTH = 8  # of a pass over the one before it, at most, while it is not known how long they take


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered picture and what it took.

    Attributes
    ----------
    rgb : (h, w, 3) float64
        Mean radiance, linear sRGB.
    variance : (h, w, 3) float64
        Of that mean, estimated from the samples; of a pixel that has one, from those of the pixels around it, too, with
        what these differ; infinite with none, or where there is one in all.
    samples : (h, w) int64
        Samples of each pixel.
    events, rays : int
        Grains met, and rays traced in the scene.
    seconds : float
        Time spent on it.
    truncated, faults : int
        Paths given up because nothing let their light out, and rays that lost track of a surface.
    interrupted : bool
        Whether it is less than what was asked for because the user stopped it.
    leapt, leaps : int
        How many of the events were not drawn one by one, and how many leaps stand for them.
    trust : Trust, optional
        Whether its variance is to be believed; None where nobody has looked.
    processor_seconds : float
        Time that the processors spent on it, all threads together, and whatever else the process did meanwhile.
    """

    rgb: np.ndarray
    variance: np.ndarray
    samples: np.ndarray
    events: int
    rays: int
    seconds: float
    truncated: int
    faults: int
    interrupted: bool
    leapt: int = 0
    leaps: int = 0
    trust: Trust | None = None
    processor_seconds: float = 0.0

    @property
    def relative_error(self) -> float:
        """Standard error of pixels (root mean square) over the mean of the picture."""
        mean = float(self.rgb.mean())
        if not np.isfinite(self.variance).all() or mean <= 0.0:
            return math.inf
        return math.sqrt(float(self.variance.mean())) / mean


class Walkers:
    """What one thread needs to follow light through a world.

    Attributes
    ----------
    walkers, amounts : lists of two arrays
        Walkers under way, and what they were.
    radiance : (n, 3) float64
        Found so far by each sample; `reserve` makes room.
    counters : (6,) int64
        See `walker.EVENTS`.
    lanes : Lanes, optional
        Where walkers of a lone box or slab are followed; set to None, they are followed one by one.
    """

    def __init__(self, world: World) -> None:
        near = transport.WorldArrays(
            world.place.arrays, world.place.room, world.media, world.tables, world.lights, world.packed.arrays,
            world.memory, world.leaps, world.absorption,
        )  # fmt: skip
        self.near = self.arrays = Handle(near)
        if 0 < world.media.singles < ALL:  # another level's law takes over, where it may have more or less room
            self.near = Handle(near._replace(media=world.media._replace(traits=LEVELS["explicit"].traits)))
            self.arrays = Handle(near._replace(geometry=world.brim.arrays))
        self.place, self.brim, self.packed = world.place, world.brim, world.packed
        self.answered, self.standing = world.media.traits.answered, None
        if world.media.singles and not self.answered and world.scene.media:
            found = standing.standing(world.packed, world.place, len(world.scene.media[0].grains))
            self.standing = Handle(found) if found.there else None
        self.crew = standing.crew_of()
        self.together = Handle(self.crew)
        exemplars = len(self.packed.engines)
        self.walkers = [np.zeros(ROOM, W.WALKER) for _ in range(2)]
        self.amounts = [np.zeros((ROOM, world.amounts)) for _ in range(2)]
        self.near_hits = np.full((ROOM + 1, len(self.place.engines)), -1, np.int32)
        self.hits = self.near_hits
        if self.brim is not self.place:
            self.hits = np.full((ROOM + 1, len(self.brim.engines)), -1, np.int32)
        self.grain_hits = np.full((exemplars, ROOM), -1, np.int32)
        self.starts, self.ways = (np.zeros((ROOM, 3), np.float32) for _ in range(2))
        self.grain_starts, self.grain_ways = (np.zeros((exemplars, ROOM, 3), np.float32) for _ in range(2))
        self.counters = np.zeros(6, np.int64)
        self.asked = np.zeros(W.GRAINS_ASKED + exemplars, np.int64)
        self.spectrum = np.zeros(world.absorption.spectral.shape[1])
        self.lanes = self.abreast = None
        if lanes.suited(world.place.arrays, world.media):
            self.lanes = lanes.lanes_of(world.place.arrays, world.amounts)
            self.abreast, self.stride = Handle(self.lanes), lanes.walk
        elif bodies.suited(world.place.arrays, world.media):
            not_ahead(transport.advance)
            crowd = bodies.crowd_of(world.place.arrays, world.amounts)
            self.lanes, self.abreast, self.stride = crowd.lanes, Handle(crowd), bodies.walk
        self.radiance = np.zeros((BLOCK, 3))  # more than most need: to lay it out takes as long as 2000 samples
        self._lay_out()

    def reserve(self, samples: int) -> None:
        """Let so many samples have found nothing yet."""
        if len(self.radiance) < samples:
            self.radiance = np.zeros((samples, 3))
            self._lay_out()
        self.radiance[:samples] = 0.0

    def _lay_out(self) -> None:
        """Make the handles of both directions, and those of the single grains, whose ray engine is another."""
        batches = [
            W.Batch(
                self.walkers[now], self.amounts[now], self.walkers[then], self.amounts[then], self.hits,
                self.grain_hits, self.starts, self.ways, self.grain_starts, self.grain_ways, self.radiance,
                self.counters, self.asked, self.spectrum,
            )
            for now, then in ((0, 1), (1, 0))
        ]  # fmt: skip
        self.batches = [Handle(batch) for batch in batches]
        self.near_batches = self.batches.copy()
        if self.hits is not self.near_hits:
            self.near_batches = [Handle(batch._replace(hits=self.near_hits)) for batch in batches]

    def follow(self, job: transport.Job, pixels: int, stop: threading.Event) -> np.ndarray:
        """Return the radiance (pixels, spp, 3) of the samples of a job, of so many pixels.

        Once `stop` is set it is worthless.
        """
        total = pixels * job.spp
        self.reserve(total)
        first, live = 0, 0
        if self.lanes is not None or self.standing:
            first = total
            (self.walk if self.lanes is not None else self.visit)(job, total, stop)
        while (live or first < total) and not stop.is_set():
            if live <= SLOTS // 2 and first < total:
                fresh = min(SLOTS - live, total - first)
                self.spawn(live, job, first, fresh)
                first, live = first + fresh, live + fresh
            live = self.turn(live)
        return self.radiance[:total].reshape(pixels, job.spp, 3).copy()

    def walk(self, job: transport.Job, total: int, stop: threading.Event) -> None:
        """Walk the samples of a job, `total` of them, in lanes."""
        assert self.lanes is not None
        counts = self.lanes.counts
        counts[:] = 0
        while (counts[lanes.LIVE] or counts[lanes.NEXT] < total) and not stop.is_set():
            self.stride(self.arrays, self.batches[0], self.abreast, job, total)
            self.finish(int(counts[lanes.HANDED]), stop)

    def visit(self, job: transport.Job, total: int, stop: threading.Event) -> None:
        """Walk the samples of a job, `total` of them, from grain to grain of those that stand alone."""
        counts = self.crew.counts
        counts[:] = 0
        while counts[standing.NEXT] < total and not stop.is_set():
            standing.walk(self.standing, self.near, self.arrays, self.near_batches[0], self.together, job, total)
            self.finish(int(counts[standing.OTHERS]), stop)

    def finish(self, live: int, stop: threading.Event) -> None:
        """Take the first `live` of ``walkers[0]`` to their ends."""
        while live and not stop.is_set():
            live = self.turn(live)

    def spawn(self, live: int, job: transport.Job, first: int, count: int) -> None:
        """Start walkers, behind the first `live` of ``walkers[0]``, for samples first .. first + count - 1 of a job."""
        transport.spawn(self.batches[0], live, job, first, count)

    def turn(self, live: int) -> int:
        """Take the first `live` of ``walkers[0]`` as far as they come without the ray engine, ask it, and return how
        many go on; ``walkers[1]`` then holds what they were, those that have ended as they ended."""
        if self.answered:
            packed.answer(self.arrays, self.batches[0], live)
        elif self.standing:
            standing.tour(self.standing, self.near, self.arrays, self.near_batches[0], live)
        transport.advance(self.near, self.arrays, self.near_batches[0], self.batches[0], live)
        live, rays = int(self.asked[W.LIVE]), int(self.asked[W.ASKED])
        if rays:
            self.place.hits(self.starts[:rays], self.ways[:rays], self.near_hits.T)
            if self.brim is not self.place:
                self.brim.hits(self.starts[:rays], self.ways[:rays], self.hits.T)
        for e, asked in enumerate(self.asked[W.GRAINS_ASKED :]):
            if asked:
                starts, ways = self.grain_starts[e, :asked], self.grain_ways[e, :asked]
                self.grain_hits[e, :asked] = self.packed.hits(e, starts, ways)
        for pair in (self.batches, self.near_batches, self.walkers, self.amounts):
            pair.reverse()
        return live


def render(
    world: World,
    spp: int | None = None,
    seconds: float | None = None,
    target_error: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[float, str], None] | None = None,
    stop: threading.Event | None = None,
) -> Picture:
    """Return the picture that the scene's camera takes.

    Parameters
    ----------
    world : World
    spp : int, optional
        Samples per pixel.
    seconds : float, optional
        Stop when another pass over all pixels would take longer than this; one is always made.
    target_error : float, optional
        Stop when `Picture.relative_error` is below this, and as many samples are taken as lights that are met by chance
        alone need to show in it (`Trust.chance` not above `trust.SHOWN`).
    seed : int
        The same seed and number of samples give the same picture for any number of threads.
    threads : int, optional
        All processors by default.
    progress : callable, optional
        Called with the share done in [0, 1] and a word about it.
    stop : Event, optional
        Set by others to end early; the picture then holds the samples so far.
    """
    camera = world.scene.camera
    check_sight(world)
    return measure(
        world, camera_of(world), camera.width, camera.height, spp, seconds, target_error, seed, threads, progress, stop,
        world.met,
    )  # fmt: skip


def measure(
    world: World,
    camera: CameraArrays,
    width: int = 1,
    height: int = 1,
    spp: int | None = None,
    seconds: float | None = None,
    target_error: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[float, str], None] | None = None,
    stop: threading.Event | None = None,
    already: np.ndarray = transport.NOBODY,
) -> Picture:
    """Return the picture that any camera takes, as `render` does for the scene's own; of a parallel beam, say."""
    goal = Goal(spp, seconds, target_error)
    threads = threads or os.cpu_count() or 1
    stop, halt = stop or threading.Event(), threading.Event()
    met = world.media.singles > 0 and bool(world.scene.media) and world.lights.sampled  # by chance alone
    sums, count = Sums(width, height, kurtosis_of(world.lights) if met else 0.0), width * height
    pool = [Walkers(world) for _ in range(threads)]
    pool[0].follow(transport.Job(camera, 0, 1, 0, seed), 1, halt)  # compiles, outside the time
    for walkers in pool:
        walkers.counters[:] = 0
    free, least = list(pool), LEAST if pool[0].lanes is None else LEAST_IN_LANES
    begin, worked, before = time.perf_counter(), time.process_time(), compiled_for()

    def follow(block: Portion) -> np.ndarray:
        mine = free.pop()
        try:
            job = transport.Job(camera, block.pixel, block.number, block.sample, seed, already)
            return mine.follow(job, block.pixels, halt)
        finally:
            free.append(mine)

    def spent() -> float:
        return time.perf_counter() - begin - float(compiled_for()[0] - before[0])  # what lanes hand over is rare

    def picture(interrupted: bool) -> Picture:
        made = sums.picture(np.sum([walkers.counters for walkers in pool], axis=0), spent(), interrupted)
        return replace(made, processor_seconds=time.process_time() - worked - float(compiled_for()[1] - before[1]))

    done, share, took, reached, chance = 0, 0, 0.0, math.inf, 0.0
    with ThreadPoolExecutor(threads) as executor:
        try:
            while not stop.is_set() and (share := goal.following(done, share, took, spent(), count)) > 0:
                found, start = 0, time.perf_counter()
                for block, radiance in _in_turn(
                    executor, follow, _blocks(count, done, share, least), 2 * threads, stop
                ):
                    sums.add(block, radiance)
                    found += block.number * block.pixels
                    if progress is not None:
                        progress(
                            goal.part(done, found / count, spent(), reached, chance), f"{done + found // count} spp"
                        )
                if stop.is_set():
                    break
                took, done = time.perf_counter() - start, done + share
                if target_error is not None and done > 1:
                    reached, chance = max(picture(False).relative_error, 1e-9), sums.chance
                if goal.reached(done, reached, sums.black, chance):
                    break
        except KeyboardInterrupt:
            stop.set()
        finally:
            halt.set()
    return picture(stop.is_set())


# ------------------------------------------------------------------------------------- passes, and when to stop


class Portion(NamedTuple):
    """Samples that one thread takes at once: first pixel, pixels, samples of each and the number of the first."""

    pixel: int
    pixels: int
    number: int
    sample: int


def _blocks(count: int, done: int, share: int, least: int) -> Iterator[Portion]:
    """Yield the blocks of a pass of `share` samples over `count` pixels, each of which has `done` of them already; they
    have `least` samples, if there are so many."""
    size = min(max(share * count // PIECES, least), BLOCK)
    number = min(share, size)
    step = max(1, size // number)
    for sample in range(done, done + share, number):
        for pixel in range(0, count, step):
            yield Portion(pixel, min(step, count - pixel), min(number, done + share - sample), sample)


def _in_turn(
    executor: ThreadPoolExecutor,
    follow: Callable[[Portion], np.ndarray],
    coming: Iterator[Portion],
    at_once: int,
    stop: threading.Event,
) -> Iterator[tuple[Portion, np.ndarray]]:
    """Yield blocks and what `follow` returns of each, in their order, until `stop` is set; so many are under way."""
    waiting: deque[tuple[Portion, Future]] = deque()
    while not stop.is_set():
        while len(waiting) < at_once and (block := next(coming, None)):
            waiting.append((block, executor.submit(follow, block)))
        if not waiting:
            return
        block, future = waiting[0]
        try:
            radiance = future.result(timeout=0.1)
        except TimeoutError:
            continue
        waiting.popleft()
        yield block, radiance


class Sums:
    """Sums over the samples of each pixel, and the picture that they make.

    Attributes
    ----------
    total, squares : (h * w, 3) float64
        Of radiance, and of its square.
    samples : (h * w,) int64
    moments : Moments
    kurtosis : float
        Of the lights that are met by chance alone, see `trust.kurtosis_of`; 0 where there are none.
    """

    def __init__(self, width: int, height: int, kurtosis: float = 0.0) -> None:
        self.shape = (height, width, 3)
        self.total, self.squares = np.zeros((width * height, 3)), np.zeros((width * height, 3))
        self.samples = np.zeros(width * height, np.int64)
        self.moments, self.kurtosis = Moments(width * height), kurtosis

    @property
    def black(self) -> bool:
        """Whether no sample has found light yet."""
        return not self.total.any()

    @property
    def chance(self) -> float:
        """`Trust.chance` so far."""
        return self.kurtosis / max(int(self.samples.sum()), 1)

    def add(self, block: Portion, radiance: np.ndarray) -> None:
        """Add the radiance (pixels, number, 3) of a block."""
        own = slice(block.pixel, block.pixel + block.pixels)
        planes = np.ascontiguousarray(np.moveaxis(radiance, 2, 0))  # summed three times as fast
        self.total[own] += np.einsum("kij->ik", planes)
        self.squares[own] += np.einsum("kij,kij->ik", planes, planes)
        self.moments.add(own, self.samples[own], radiance)
        self.samples[own] += block.number

    def picture(self, counters: np.ndarray, seconds: float, interrupted: bool) -> Picture:
        """Return the picture so far; counters (4,) as in `Walkers`, seconds [s] that it took."""
        n = self.samples[:, None]
        variance = _variance(self.total, self.squares, n)
        if (single := self.samples == 1).any():  # as in a pass that was interrupted
            total, squares, many = (
                _around(part.reshape(*self.shape[:2], -1)).reshape(len(n), -1)[single]
                for part in (self.total, self.squares, n)
            )
            variance[single] = many * _variance(total, squares, many)
        mean = self.total / np.maximum(n, 1)
        return Picture(
            rgb=mean.reshape(self.shape),
            variance=variance.reshape(self.shape),
            samples=self.samples.reshape(self.shape[:2]),
            events=int(counters[W.EVENTS]),
            rays=int(counters[W.RAYS]),
            seconds=seconds,
            truncated=int(counters[W.TRUNCATED]),
            leapt=int(counters[W.LEAPT]),
            leaps=int(counters[W.LEAPS]),
            faults=int(counters[W.FAULTS]),
            interrupted=interrupted,
            trust=self.moments.trust(self.samples, self.shape[:2], self.kurtosis) if self.samples.any() else None,
        )


def _variance(total: np.ndarray, squares: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the variance of the mean of n samples (pixels, 1) of these sums (pixels, 3); infinite below 2."""
    many = np.maximum(n, 1)
    return np.where(n > 1, np.maximum(squares / many - (total / many) ** 2, 0.0) / np.maximum(n - 1, 1), math.inf)


def _around(pixels: np.ndarray) -> np.ndarray:
    """Return the sums over each pixel of (h, w, n) and its neighbours, two to each side."""
    height, width, _ = pixels.shape
    pixels = np.pad(pixels, ((2, 2), (2, 2), (0, 0)))
    rows = np.sum([pixels[k : k + height] for k in range(5)], axis=0)
    summed: np.ndarray = np.sum([rows[:, k : k + width] for k in range(5)], axis=0)
    return summed


@dataclass(frozen=True)
class Goal:
    """When a picture is done: at so many samples per pixel, after so many seconds, or at a relative error.

    Raises
    ------
    UsageError
        If none of them is given, or one is out of range.
    """

    spp: int | None
    seconds: float | None
    target_error: float | None

    def __post_init__(self) -> None:
        limits = (("spp", self.spp), ("seconds", self.seconds), ("target error", self.target_error))
        if all(value is None for _, value in limits):
            raise UsageError("say when to stop: samples per pixel, seconds or a target error")
        for name, value in limits:
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"{name} must be a finite number above 0, not {value}")

    def following(self, done: int, share: int, took: float, spent: float, count: int) -> int:
        """Return how many samples per pixel the next pass has, 0 for no next pass.

        Each of `count` pixels has `done` of them after `spent` seconds; the last pass had `share` and `took` seconds.
        """
        # after the first seconds an interrupt leaves no pixel with less than half the samples of another
        most = max(FEW, min(PARTS * BLOCK // count, max(BLOCK // count, done)))
        if self.spp is not None:
            return min(most if share else 1, self.spp - done)
        if self.seconds is None:
            return most if share else 1
        if not share:
            return 1
        left = self.seconds - spent
        each = max(took, 1e-6) / share  # of a pass of one sample
        return min(max(int(min(left, self.seconds / PARTS) / each), int(left >= each)), most, GROWTH * share)

    def part(self, done: int, found: float, spent: float, error: float, chance: float = 0.0) -> float:
        """Return the share done in [0, 1], with `found` samples per pixel of a pass after `done`, at this error and
        `Trust.chance`."""
        if self.target_error is not None and done > 1:
            return min(1.0, (self.target_error / error) ** 2, SHOWN / max(chance, SHOWN))
        if self.seconds is not None:
            return min(1.0, spent / self.seconds)
        return (done + found) / self.spp if self.spp else 0.0

    def reached(self, done: int, error: float, black: bool, chance: float = 0.0) -> bool:
        """Return whether an error is small enough after `done` samples per pixel, or never will be.

        Neither is known before lights that are met by chance alone have been met about 1 / `SHOWN` times: until then a
        picture may look free of noise for their light is missing from it.
        """
        if self.target_error is None or chance > SHOWN:
            return False
        return (done > 1 and error <= self.target_error) or (done >= BLACK and black)
