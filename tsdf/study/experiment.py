"""Experiments: light sent into packed grains or what stands for them, path by path; bulk diffusion, and slabs.

Paths are followed one by one to where they end, so that one run of a slab gives reflectance, transmittance, and how
far from the beam light comes out. What levels make of it beside each other is `accuracy`, pictures are `render`'s.
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tsdf.data.table import Table
from tsdf.handle import Handle
from tsdf.picture.render import SLOTS, Walkers
from tsdf.picture.world import World, beam, build
from tsdf.scene.scene import Absorption, Camera, ConstantLight, GrainSpec, MediumSpec, Render, Scene, Slab, Sphere
from tsdf.spheres.around import Around
from tsdf.spheres.packing import Cells, pack
from tsdf.walk import lanes, transport
from tsdf.walk import walker as W
from tsdf.walk.explicit import laid

WIDE = 300.0  # [R] width of beams, so that they see many places of a packing
FAR = 1e6  # [R] radius of what stands for an endless medium
BATCH = 1 << 14  # paths followed by one thread at a time, at most
CAMERA = Camera((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))
LIGHT = (ConstantLight((1.0, 1.0, 1.0)),)
PROFILE = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 1e30])  # [R]

BLOCK, BLOCKS = 32, 12  # events of a block, at least, and blocks of a path in the bulk
FORGOTTEN = 5e-4  # what light has left of its direction after a block, at most
FIRST, GROWTH, MOST = 1 << 13, 8, 1 << 17  # marks of the first pass, paths of each over all before, marks of any
EAGER = 1024  # paths of the first pass, at most: the ray engine likes many at once
MOST_CUTS = 4  # slabs from one tile
SPHERES = 2000  # in a tile
FAINTEST = 1e-300  # [1/R] an absorption coefficient that counts lengths and takes no light


class Ends(NamedTuple):
    """Where paths ended, in the order of their numbers; lengths in scene units.

    Attributes
    ----------
    start, place, direction : (n, 3) float64
        Where each began and ended, relative to the scene's centre, and which way it then went. Of paths without weight
        that were walked in lanes, nothing but the first is kept.
    weight : (n,) float64
        What roulette makes of it; throughput but for absorption, 0 if it did not come out.
    amounts : (n, a) float64
        Of matter crossed, see `walker.Attenuation`.
    events, drawn : int
        Grains met, by all; and what was drawn for that, single events and leaps.
    seconds : float
        Processor time spent on it, by all threads together.
    """

    start: np.ndarray
    place: np.ndarray
    direction: np.ndarray
    weight: np.ndarray
    amounts: np.ndarray
    events: int
    drawn: int
    seconds: float


class Value(NamedTuple):
    """A number, its standard error, and processor time per event behind it [s]."""

    value: float
    error: float
    event: float


class Passed(NamedTuple):
    """What a slab does to a beam: shares of its light, with standard errors, and processor time per event [s].

    profile (bins,), profile_error: share of the light that comes back at each distance from the beam, by `PROFILE`.
    """

    reflectance: float
    transmittance: float
    reflectance_error: float
    transmittance_error: float
    profile: np.ndarray
    profile_error: np.ndarray
    event: float


# ----------------------------------------------------------------------------------------------- paths


def trips(
    world: World, camera: transport.CameraArrays, first: int, paths: int, seed: int,
    heard: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    aim: Callable[[np.ndarray], None] = lambda new: None,
) -> tuple[int, int, float]:  # fmt: skip
    """Follow paths of a camera's first pixel, and tell of each whenever it has met as many grains as the world's limit
    says, and when it ends; return grains met, what was drawn for that (single events and leaps), processor time [s].

    Parameters
    ----------
    first : int
        Number of the first path; paths of another number have other random numbers.
    heard : callable
        Given walkers, their amounts, and which of them could go on (n,) bool, it returns which of them do. `sample` is
        a walker's number from `first` on.
    aim : callable
        May turn walkers that are about to start.
    """
    mine = Walkers(world)
    began = time.thread_time()
    mine.reserve(paths)
    job = transport.Job(camera, 0, paths, first, seed)
    spawned, live = 0, 0
    while live or spawned < paths:
        if live <= SLOTS // 2 and spawned < paths:
            fresh = min(SLOTS - live, paths - spawned)
            mine.spawn(live, job, spawned, fresh)
            aim(mine.walkers[0][live : live + fresh])
            spawned, live = spawned + fresh, live + fresh
        before = live
        live = mine.turn(live)
        gone = np.flatnonzero(mine.walkers[1][:before]["sample"] < 0)
        those = mine.walkers[1][gone].copy()
        those["sample"] = ~those["sample"]
        again = heard(those, mine.amounts[1][gone], (those["events"] >= world.media.limit) & (those["weight"] > 0.0))
        more = int(again.sum())
        if more:
            those["events"], those["ray"] = 0, W.NONE
            mine.walkers[0][live : live + more] = those[again]
            mine.amounts[0][live : live + more] = mine.amounts[1][gone][again]
            live += more
    return _spent(mine, began)


def _spent(mine: Walkers, began: float) -> tuple[int, int, float]:
    """Return the grains that walkers have met, what was drawn for that, and their thread's time since it began."""
    events = int(mine.counters[W.EVENTS])
    return events, events - int(mine.counters[W.LEAPT]) + int(mine.counters[W.LEAPS]), time.thread_time() - began


def _batch(
    world: World, camera: transport.CameraArrays, first: int, paths: int, seed: int, marks: int
) -> tuple[np.ndarray, Ends]:
    """Follow paths to their end, or past their limit of events so often; return as `follow` does."""
    if marks == 1 and lanes.suited(world.place.arrays, world.media):
        return _abreast(world, camera, first, paths, seed)
    places = np.zeros((paths, marks, 3))
    start, place, way = (np.zeros((paths, 3)) for _ in range(3))
    weight, amounts = np.zeros(paths), np.zeros((paths, world.amounts))
    passed = np.zeros(paths, np.int64)

    def begin(new: np.ndarray) -> None:
        start[new["sample"]] = new["p"]

    def heard(those: np.ndarray, crossed: np.ndarray, able: np.ndarray) -> np.ndarray:
        number = those["sample"]
        places[number, passed[number]] = place[number] = those["p"]
        way[number], weight[number], amounts[number] = those["d"], those["weight"], crossed
        passed[number] += 1
        return able & (passed[number] < marks)

    events, drawn, seconds = trips(world, camera, first, paths, seed, heard, begin)
    return places, Ends(start, place, way, weight, amounts, events, drawn, seconds)


def _abreast(
    world: World, camera: transport.CameraArrays, first: int, paths: int, seed: int
) -> tuple[np.ndarray, Ends]:
    """Follow paths to their end in lanes, as `_batch` does one by one."""
    mine = Walkers(world)
    began = time.thread_time()
    mine.reserve(paths)
    mine.lanes = own = lanes.lanes_of(world.place.arrays, world.amounts, paths)
    abreast, ends = Handle(own), own.ends
    job = transport.Job(camera, 0, paths, first, seed)
    while own.counts[lanes.LIVE] or own.counts[lanes.NEXT] < paths:
        lanes.walk(mine.arrays, mine.batches[0], abreast, job, paths)
        live = int(own.counts[lanes.HANDED])
        while live:
            before, live = live, mine.turn(live)
            gone = np.flatnonzero(mine.walkers[1][:before]["sample"] < 0)
            those = mine.walkers[1][gone]
            ends[~those["sample"], 3:] = np.column_stack(
                (those["p"], those["d"], those["weight"], mine.amounts[1][gone])
            )
    spent = _spent(mine, began)
    start, place, way, weight, amounts = np.split(ends, (3, 6, 9, 10), axis=1)
    return place[:, None], Ends(start, place, way, weight[:, 0], amounts, *spent)


def follow(
    world: World, camera: transport.CameraArrays, paths: int, seed: int = 0, marks: int = 1, threads: int | None = None,
    first: int = 0,
) -> tuple[np.ndarray, Ends]:  # fmt: skip
    """Follow paths of a camera's first pixel to where they end; the same for any number of threads.

    Parameters
    ----------
    world : World
        Whose lights are not aimed at: shadows would count as paths.
    marks : int
        Times that a path goes on after it has reached the world's limit of events, plus one.
    first : int
        Number of the first path; paths of another number have other random numbers.

    Returns
    -------
    places : (paths, marks, 3) float64
        Where each was when it reached the limit for the first, second, ... time; zero where it did not.
    ends : Ends
    """
    assert not world.lights.sampled
    threads = threads or os.cpu_count() or 1
    size = min(BATCH, -(-paths // threads))
    jobs = [(at, min(size, first + paths - at)) for at in range(first, first + paths, size)]
    pool = ThreadPoolExecutor(threads)
    try:
        found = list(pool.map(lambda job: _batch(world, camera, job[0], job[1], seed, marks), jobs))
    finally:
        pool.shutdown(cancel_futures=True)
    ends = [one for _, one in found]
    start, place, way, weight, amounts = (np.concatenate([one[k] for one in ends]) for k in range(5))
    events, drawn = sum(one.events for one in ends), sum(one.drawn for one in ends)
    return np.concatenate([places for places, _ in found]), Ends(
        start, place, way, weight, amounts, events, drawn, sum(one.seconds for one in ends)
    )


@dataclass(frozen=True, eq=False)
class Experiment:
    """Paths through a world, and the numbers (paths, q) that are read off where they were and ended."""

    world: World
    camera: transport.CameraArrays
    marks: int
    read: Callable[[np.ndarray, Ends], np.ndarray]


@dataclass
class Sums:
    """Means of numbers over paths, as far as they have been followed; those without numbers are lost."""

    paths: int = 0
    total: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0
    events: int = 0
    seconds: float = 0.0
    lost: int = 0
    drawn: int = 0

    def add(self, values: np.ndarray, ends: Ends) -> None:
        there = np.isfinite(values).all(axis=1)
        self.lost += int((~there).sum())
        values = values[there]
        self.paths += len(values)
        self.total, self.squares = self.total + values.sum(axis=0), self.squares + (values**2).sum(axis=0)
        self.events, self.drawn = self.events + ends.events, self.drawn + ends.drawn
        self.seconds += ends.seconds

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.total) / max(self.paths, 1)

    @property
    def error(self) -> np.ndarray:
        """Standard errors of the means."""
        variance = np.maximum(np.asarray(self.squares) / max(self.paths, 1) - self.mean**2, 0.0)
        return np.asarray(np.sqrt(variance / max(self.paths - 1, 1)))

    @property
    def event(self) -> float:
        """Processor time per event [s]."""
        return self.seconds / max(self.events, 1)


def gather(
    experiment: Experiment, paths: int | None, seconds: float | None = None, seed: int = 0, threads: int | None = None
) -> Sums:
    """Follow so many paths of an experiment, or as many as there is time for on the clock, at least a few."""
    e, sums = experiment, Sums()
    _batch(e.world, e.camera, 0, 1, seed, 1)  # compiles, outside the time
    size = MOST // e.marks if seconds is None else min(EAGER, FIRST // e.marks)
    began = time.perf_counter()
    while paths is None or sums.paths + sums.lost < paths:
        done = sums.paths + sums.lost
        count = size if paths is None else min(size, paths - done)
        places, ends = follow(e.world, e.camera, count, seed, e.marks, threads, done)
        sums.add(e.read(places, ends), ends)
        if paths is not None:
            continue
        assert seconds is not None
        spent = time.perf_counter() - began
        done = sums.paths + sums.lost
        left = (seconds - spent) / spent * done
        if left < 0.2 * done or not sums.paths:
            break
        size = max(1, min(GROWTH * done, MOST // e.marks, int(left)))
    return sums


# ----------------------------------------------------------------------------------------- bulk and slabs


def scene_of(
    shape: Slab | Sphere, grain: GrainSpec, fraction: float, packing: int = 0, inside: str = "centres"
) -> Scene:
    """Return a scene of one medium of grains of radius 1 under constant light."""
    medium = MediumSpec(shape, fraction, 1.0, (grain,), name="grains", inside=inside, packing_seed=packing,
                         packing_spheres=SPHERES)  # fmt: skip
    return Scene(CAMERA, LIGHT, (medium,), name=f"packing fraction {fraction:g}")


def cuts(fraction: float, layer: float) -> list[float]:
    """Return at which heights slabs of a layer [R] can be cut from the tile of a packing and share no sphere [R]."""
    side = (SPHERES * 4.0 / 3.0 * math.pi / fraction) ** (1.0 / 3.0)
    count = min(MOST_CUTS, max(1, int(side / (layer + 2.0))))
    return [side * k / count for k in range(count)]


def block_of(table: Table) -> int:
    """Return after how many events light has forgotten its direction, at least `BLOCK`."""
    g = min(abs(table.mean_cosine()), 0.999)
    return max(BLOCK, math.ceil(math.log(FORGOTTEN) / math.log(g))) if g > 0.0 else BLOCK


def bulk_experiment(
    level: str, grain: GrainSpec, fraction: float, packing: int = 0, block: int = BLOCK, blocks: int = BLOCKS
) -> Experiment:
    """Return what `diffusion` measures."""
    world = build(scene_of(Sphere((0.0, 0.0, 0.0), FAR), grain, fraction, packing), level, limit=block, leap=0.0)

    def read(places: np.ndarray, ends: Ends) -> np.ndarray:
        steps = np.diff(places, axis=1)
        near = steps[:, :-2] + steps[:, 1:-1] + steps[:, 2:]
        squares = np.asarray((steps[:, 1:-1] * near).sum(axis=2).mean(axis=1) / block)
        ended = ~places[:, -1].any(axis=1) | (np.abs(places) > 0.5 * FAR).any(axis=(1, 2))
        return np.where(ended, math.nan, squares)[:, None]

    return Experiment(world, beam(world, (0.0, 0.0, 0.0), (0.36, 0.48, 0.8), WIDE), blocks + 1, read)


def diffusion(level: str, grain: GrainSpec, fraction: float, paths: int, seed: int = 0, packing: int = 0,
              block: int = BLOCK, blocks: int = 8, threads: int | None = None) -> Value:  # fmt: skip
    """Return the mean squared displacement per event in an endless medium [R^2], once nothing remembers its start.

    Displacements over blocks of events are correlated with themselves and the blocks beside them, and with no others:
    the blocks must be longer than light remembers its direction (`block_of`). The first block is left out.

    Parameters
    ----------
    level : str
    grain : GrainSpec
        Lossless, for none of its light is to end.
    fraction : float
        Packing fraction [1].
    paths : int
        Each of `blocks` + 1 blocks of `block` events.
    seed, packing : int
        Of the random numbers, and of the packing of the explicit level.
    """
    sums = gather(bulk_experiment(level, grain, fraction, packing, block, blocks), paths, None, seed, threads)
    return Value(float(sums.mean[0]), float(sums.error[0]), sums.event)


@lru_cache(maxsize=32)
def _lowered(fraction: float, packing: int, height: float) -> tuple[Cells, np.ndarray, Around]:
    """Return what kernels take of the spheres of a packing, all moved down the same."""
    made = pack(fraction, SPHERES, packing)
    return laid(replace(made, centres=(made.centres - (0.0, 0.0, height)) % made.side))


def _lower(world: World, fraction: float, packing: int, height: float) -> None:
    """Move the spheres of a packed world down, all the same."""
    cells, centres, around = _lowered(fraction, packing, height)
    world.packed.arrays = world.packed.arrays._replace(cells=(cells,), centres=(centres,), around=(around,))


def slab_experiment(
    level: str, grain: GrainSpec, fraction: float, layer: float, cosine: float = 1.0, packing: int = 0,
    coefficients: Sequence[float] | None = None, top: float = 0.0, leap: float = 0.0, singles: int = 0,
) -> Experiment:  # fmt: skip
    """Return what `slab` measures: reflectance, transmittance and profile one after the other, and so again for each of
    several absorption coefficients [1/R] if they are given, of the very same paths. The layer's
    upper end is at height `top` of the tile; the first `singles` grains are met one by one."""
    if coefficients is not None:
        grain = replace(grain, absorption=Absorption("grey", (FAINTEST,)))
    scene = replace(scene_of(Slab(-layer, 0.0), grain, fraction, packing), render=Render(explicit_grains=singles))
    world = build(scene, level, leap=leap)
    if world.media.singles:
        _lower(world, fraction, packing, top)
    way = np.array([math.sqrt(1.0 - cosine**2), 0.0, -cosine])
    high = 5.0 + WIDE  # the beam's tilted square begins above the slab
    middle = world.place.centre[2]  # heights are relative to it
    bins = len(PROFILE) - 1

    def read(places: np.ndarray, ends: Ends) -> np.ndarray:
        up = ends.direction[:, 2] > 0.0
        into = ends.start + way * ((ends.start[:, 2:] + middle) / cosine)
        rise = np.where(up, ends.direction[:, 2], 1.0)[:, None]
        out = ends.place - ends.direction * ((ends.place[:, 2:] + middle) / rise)
        far = np.hypot(out[:, 0] - into[:, 0], out[:, 1] - into[:, 1])
        ring = np.searchsorted(PROFILE, far, side="right") - 1
        some: list[np.ndarray] = []
        exponents = (
            [ends.amounts @ world.absorption.rgb[0]]
            if coefficients is None
            else [-c * ends.amounts.sum(axis=1) for c in coefficients]
        )
        for exponent in exponents:
            light = ends.weight * np.exp(exponent)
            values = np.zeros((len(light), 2 + bins))
            values[:, 0], values[:, 1] = np.where(up, light, 0.0), np.where(up, 0.0, light)
            values[np.flatnonzero(up), 2 + ring[up]] = light[up]
            some.append(values)
        return np.concatenate(some, axis=1)

    return Experiment(world, beam(world, -way * high / cosine, way, WIDE), 1, read)


def slab(level: str, grain: GrainSpec, fraction: float, layer: float, paths: int, cosine: float = 1.0, seed: int = 0,
         packing: int = 0, threads: int | None = None) -> Passed:  # fmt: skip
    """Return what a slab does to a beam that comes in at an angle of given cosine to its normal.

    Centres of grains lie in a layer of given thickness [R]; levels without single grains have that layer itself.
    """
    sums = gather(slab_experiment(level, grain, fraction, layer, cosine, packing), paths, None, seed, threads)
    mean, error = sums.mean, sums.error
    return Passed(float(mean[0]), float(mean[1]), float(error[0]), float(error[1]), mean[2:], error[2:], sums.event)
