"""Tracing: light through one grain, from a sampled ray until it leaves the bounding sphere; `counting` counts it.

Embree finds the facets, `advance` does the rest in one go over all rays: Fresnel, splitting, restart, counting,
compaction. Only the facet's number is taken from Embree; the hit is recomputed in float64 (`optics`), so that the
result does not depend on the last bits of a ray engine.

Light splits in two at a hit. A part lighter than `SPLIT` goes on with that much or not at all, at random, and the other
part has the rest, so that no energy is made or lost; a part that leaves for good may be lighter, for it needs no ray.
What leaves for good is told from the horizon of its facet (`horizon_of`), above which a facet is also lit from several
directions at once (`FAN`). Every path has a random stream of its own, a function of the seed and the path's number, so
paths may be traced in any order, batch and thread.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from threading import Event, Lock, Thread
from typing import Any, NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.grain.grains import Grain, embree_scene
from tsdf.grain.horizon import UNKNOWN, horizon_of
from tsdf.grain.optics import OFFSET, UNPOLARISED, P, S, nearer, on_plane, parted, sound
from tsdf.handle import Handle
from tsdf.make import tally as T
from tsdf.make.counting import BLOCK, Counts, Departed, Past, count_block, entry_b2, entry_cell, leave, rim, rounded
from tsdf.make.tally import Tally
from tsdf.sampling import GOLDEN, SOBOL, key_of, mix, sobol, turn, unit
from tsdf.vectors import KERNEL, dot, frame, minus, renewed, step, triple

SPLIT = 0.6  # a part lighter than this share of the light that enters is raised to it at random
FAN = 4  # directions in which a facet is lit from one point, half as many in a grain that shades itself
OPEN = 0.9  # share of the light that comes in above the horizon of a grain that does not
SLOTS = 4096  # rays under way at once, per thread, but for splitting: few enough for the cache, a millisecond of work
MAX_BOUNCES = 100_000  # default bounce limit
# A ray under way: where it starts and goes, the length inside so far, the light that entered, its random key and path,
# the facet it starts from, hits so far
RAY = np.dtype(
    [("p", "3f8"), ("d", "3f8"), ("entry", "3f8"), ("d_in", "3f8"), ("length", "f8"), ("key", "u8"), ("path", "i8"),
     ("weight", "i4"), ("facet", "i4"), ("hits", "i4"), ("flags", "i4")]
)  # fmt: skip
INSIDE, RETRIED, MET, P_POLARISED = 1, 2, 4, 8
OTHER = np.uint64(0xA5A5A5A5A5A5A5A5)  # turns a random key into that of the other branch
REST = np.uint64(0x3C6EF372FE94F82B)  # turns it into that by which a rest is rounded
FEW = 4096  # units of energy from which on rounding to the nearest loses nothing that matters
KEPT_APART = 3  # polarisations: each path has one
GOLDEN_C, GOLDEN_S = math.cos(2.0 * math.pi * 0.6180339887498949), math.sin(2.0 * math.pi * 0.6180339887498949)


class Task(NamedTuple):
    """A grain and how it is traced.

    sphere: it is the exact sphere, one facet that says nothing; planes (n, 4): normal and height over the origin of
    each facet; centroids (n, 3), horizon (n,): see `horizon_of`; polarisation: that of `fresnel` or KEPT_APART; split:
    the weight to which lighter parts are raised; fan: directions in which a facet is lit; sobol: direction numbers.
    The rest as in `Tracer`.
    """

    sphere: bool
    planes: np.ndarray
    centroids: np.ndarray
    horizon: np.ndarray
    eta: float
    polarisation: int
    reflectance_scale: float
    split: int
    fan: int
    max_bounces: int
    seed: int
    plain: bool
    sobol: np.ndarray


class Rays(NamedTuple):
    """Rays (n,) under way, those that go on after a hit, and their starts and ways (n, 3) for the ray engine."""

    now: np.ndarray
    then: np.ndarray
    starts: np.ndarray
    ways: np.ndarray


class State(NamedTuple):
    """Of a ray: energy, random key, the facet it starts from, flags, hits so far."""

    weight: int
    key: int
    facet: int
    flags: int
    hits: int


@njit(**KERNEL)
def spawn(task, rays, live, paths, counts):
    """Start the paths numbered behind the first `live` rays: parallel light, uniform over the disc, from everywhere."""
    seed, low, high = task.seed, np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(len(paths)):
        path = paths[i]
        if task.plain:
            u0, u1 = unit(key_of(seed, path, 11)), unit(key_of(seed, path, 12))
            u2, u3 = unit(key_of(seed, path, 13)), unit(key_of(seed, path, 14))
        else:
            index = path // T.REPLICATES
            k = key_of(seed, path % T.REPLICATES, 7)
            k2 = mix(k + np.uint64(1))
            u0 = sobol(index, 0, k & low, task.sobol)
            u1 = sobol(index, 1, k >> high, task.sobol)
            u2 = sobol(index, 2, k2 & low, task.sobol)
            u3 = sobol(index, 3, k2 >> high, task.sobol)
        dz = 1.0 - 2.0 * u0
        across = math.sqrt(max(0.0, 1.0 - dz * dz))
        c, s = turn(u1)
        d = (across * c, across * s, dz)
        t, b = frame(d)
        radius = math.sqrt(u2)
        c, s = turn(u3)
        entry = step(step(step((0.0, 0.0, 0.0), radius * c, t), radius * s, b), -math.sqrt(1.0 - u2), d)
        side = P_POLARISED if key_of(seed, path, 2) & np.uint64(1) else 0
        ray = rays.now[live + i]
        start(ray, entry, d, Past(entry, d, 0.0, path), State(T.UNIT, key_of(seed, path, 1), -1, side, 0))
        ask(rays, live + i, entry, ray)
        if counts.entry.shape[1] > 0:
            counts.entry[0, entry_cell(entry_b2(entry, triple(ray.d)), T.ENTRY)] += T.UNIT


@njit(forceinline=True, **KERNEL)
def start(ray, p, d, past, state):
    """Write a ray from p along d."""
    d = renewed(d)
    for k in range(3):
        ray.p[k], ray.d[k], ray.entry[k], ray.d_in[k] = p[k], d[k], past.entry[k], past.d_in[k]
    ray.length, ray.path = past.length, past.path
    ray.weight, ray.key, ray.facet, ray.flags, ray.hits = state.weight, state.key, state.facet, state.flags, state.hits


@njit(forceinline=True, **KERNEL)
def ask(rays, i, p, ray):
    """Ask the ray engine for the facet that ray i meets, seen from p."""
    for k in range(3):
        rays.starts[i, k], rays.ways[i, k] = p[k], ray.d[k]


@njit(**KERNEL)
def advance(task, rays, block, counts, count, prims):
    """Take `count` rays, whose next facets are `prims`, through one hit each; return how many go on.

    What goes on is packed into ``rays.then`` and, for the ray engine, starts and ways.
    """
    live, held = 0, 0
    for i in range(count):
        if held > BLOCK - task.fan:
            count_block(held, block, counts)
            held = 0
        ray, facet = rays.now[i], prims[i]
        if facet < 0 and ray.flags & INSIDE == 0:
            held += outside(block, counts, held, ray)
            continue
        p, n, cosine, t = hit(task, ray, facet)
        if not sound(cosine, t, ray.flags & INSIDE != 0):
            live += again(task, rays, counts, live, ray)
        elif ray.hits >= task.max_bounces:
            counts.scalars[ray.path % T.REPLICATES, T.TRUNCATED] += ray.weight
        else:
            live, held = light(task, rays, block, (live, held), ray, facet, (p, n, cosine, t))
    count_block(held, block, counts)
    return live


@njit(**KERNEL)
def outside(block, counts, held, ray):
    """Count a ray that missed the grain, or note that it leaves it; return how many were noted."""
    p, d, weight = triple(ray.p), triple(ray.d), np.int64(ray.weight)
    if ray.flags & MET:
        leave(block, held, p, d, Past(triple(ray.entry), triple(ray.d_in), ray.length, ray.path), weight, ray.key)
        return 1
    replicate = ray.path % T.REPLICATES
    counts.scalars[replicate, T.UNSCATTERED] += weight
    counts.scalars[replicate, T.MISS_CHORD] += rounded(weight * -2.0 * dot(p, d))
    if counts.entry.shape[1] > 0:
        counts.entry[1, entry_cell(entry_b2(p, d), T.ENTRY)] += weight
    return 0


@njit(forceinline=True, **KERNEL)
def hit(task, ray, facet):
    """Return where a ray meets a facet or the sphere, the normal there, its cosine with the ray, and the distance,
    which is infinite where it meets nothing."""
    p, d = triple(ray.p), triple(ray.d)
    if task.sphere:
        t = -2.0 * dot(p, d) if ray.flags & INSIDE else 0.0
        n = step(p, t, d)
        n = step((0.0, 0.0, 0.0), 1.0 / math.sqrt(dot(n, n)), n)
        return n, n, dot(n, d), t
    if facet < 0:
        return p, d, 0.0, math.inf
    n, cosine, t = on_plane(task.planes[facet], p, d)
    return step(p, max(t, 0.0), d), n, cosine, t


@njit(**KERNEL)
def again(task, rays, counts, live, ray):
    """Send a ray that leaked at an edge or a vertex off once more, from nearer the middle of the facet it came from;
    return how many go on."""
    if ray.facet < 0 or ray.flags & RETRIED:
        counts.scalars[ray.path % T.REPLICATES, T.LOST] += ray.weight
        return 0
    p, past = triple(ray.p), Past(triple(ray.entry), triple(ray.d_in), ray.length, ray.path)
    moved = nearer(task.centroids[ray.facet], p)
    moved = step(moved, -OFFSET if ray.flags & INSIDE else OFFSET, triple(task.planes[ray.facet]))
    start(rays.then[live], p, triple(ray.d), past,
          State(ray.weight, ray.key, ray.facet, ray.flags | RETRIED, ray.hits))  # fmt: skip
    ask(rays, live, moved, rays.then[live])
    return 1


@njit(forceinline=True, **KERNEL)
def light(task, rays, block, ends, ray, facet, met):
    """Split the light of a ray where it meets a facet; return the new ends of the rays that go on and of the block.

    `met` is what `hit` found. Light that comes from above the horizon of the facet comes unobstructed: one point is
    lit from several directions.
    """
    (live, held), (p, n, cosine, t) = ends, met
    inside, side, key = ray.flags & INSIDE != 0, ray.flags & P_POLARISED, ray.key
    d, entry, d_in = triple(ray.d), triple(ray.entry), triple(ray.d_in)
    length = ray.length + max(t, 0.0) if inside else ray.length
    ratio = 1.0 / task.eta if inside else task.eta
    polarisation = task.polarisation
    if polarisation == KEPT_APART:
        polarisation = P if side else S
    low = task.horizon[facet]
    fan = 1 if inside or ray.flags & MET or -cosine <= low else task.fan
    weight, split, full = ray.weight // fan, task.split, 1.0 - low * low
    lit, axes = (0.0, 1.0, 0.0), (d, d)
    if fan > 1:
        axes = frame(n)
        lit = projected(dot(d, axes[0]), dot(d, axes[1]), full)
    for k in range(fan):
        if k > 0:
            lit = next_of_fan(lit, full, fan)
            around, cosine = math.sqrt(lit[0]), -math.sqrt(max(1.0 - lit[0], 1e-300))
            d = step(step(step((0.0, 0.0, 0.0), around * lit[1], axes[0]), around * lit[2], axes[1]), cosine, n)
            entry, d_in = rim(p, minus(d)), d
        # Of reflection and refraction one goes on outside (out), the other inside (into)
        reflectance, mirrored, refracted = parted(d, n, cosine, ratio, polarisation)
        out, into = (refracted, mirrored) if inside else (mirrored, refracted)
        mirrored_weight = weight
        if reflectance < 1.0:
            mirrored_weight = units(weight * min(reflectance * task.reflectance_scale, 1.0), key)
        out_weight = weight - mirrored_weight if inside else mirrored_weight
        key = mix(key + GOLDEN)
        free = dot(out, n) > low or low == 0.0
        if not (free and weight > split and 2 * out_weight <= weight):
            out_weight = raised(out_weight, weight, min(split, weight), key)
        past, hits = Past(entry, d_in, length, ray.path), ray.hits + 1
        if out_weight > 0 and free:
            leave(block, held, p, out, past, out_weight, key)
            held += 1
        elif out_weight > 0:
            start(rays.then[live], p, out, past, State(out_weight, mix(key ^ OTHER), facet, MET | side, hits))
            ask(rays, live, step(p, OFFSET, n), rays.then[live])
            live += 1
        if out_weight < weight:
            start(rays.then[live], p, into, past, State(weight - out_weight, key, facet, MET | INSIDE | side, hits))
            ask(rays, live, step(p, -OFFSET, n), rays.then[live])
            live += 1
    return live, held


@njit(forceinline=True, **KERNEL)
def projected(x, y, full):
    """Return a direction of components x and y in Lambert's projection: squared radius, `full` at most, and azimuth."""
    u = min(x * x + y * y, full)
    around = math.sqrt(u)
    return (u, x / around, y / around) if around > 0.0 else (u, 1.0, 0.0)


@njit(forceinline=True, **KERNEL)
def next_of_fan(lit, full, fan):
    """Turn a projected direction by the golden angle and shift it by 1 / fan of the disc: uniform again."""
    u, c, s = lit
    u = u + full / fan if u + full / fan < full else u + full / fan - full
    return u, c * GOLDEN_C - s * GOLDEN_S, s * GOLDEN_C + c * GOLDEN_S


@njit(forceinline=True, **KERNEL)
def units(part, key):
    """Return a weight in whole units of energy; of few the rest is rounded at random, so that none is lost in the mean:
    a surface of eta 1.0005 reflects a quarter of a unit of what a path has there."""
    return rounded(part) if part >= FEW else np.int64(math.floor(part + unit(mix(key ^ REST))))


@njit(forceinline=True, **KERNEL)
def raised(part, whole, least, key):
    """Return the weight of a part, after the lighter of it and the rest was raised to the least, or dropped."""
    lighter = min(part, whole - part)
    if not 0 < lighter < least:
        return part
    kept = least if unit(key) * least < lighter else 0
    return kept if lighter == part else whole - kept


def in_order(first: int, last: int) -> np.ndarray:
    """Return the path numbers first .. last - 1 one replicate after the other, the order kindest to the cache."""
    numbers = np.arange(first, last)
    return numbers[np.argsort(numbers % T.REPLICATES, kind="stable")]


class Surface(NamedTuple):
    """What tracing asks of a grain's surface; of the exact sphere, one facet that says nothing, and no ray engine.

    planes (n, 4): normal and height over the origin of each facet; centroids (n, 3); horizon (n,): see `horizon_of`,
    nothing is promised of a plain one; share: of the light, what comes in above the horizon; scene: the ray engine's.
    """

    planes: np.ndarray
    centroids: np.ndarray
    horizon: np.ndarray
    share: float
    scene: Any


def surface_of(grain: Grain, plain: bool) -> Surface:
    """Return the surface of a grain, found once for all threads that ask, for the horizon may take a second."""
    with _finding:
        return _surface_of(grain, plain)


_finding = Lock()


@lru_cache(maxsize=2)
def _surface_of(grain: Grain, plain: bool) -> Surface:
    if grain.kind == "sphere":
        return Surface(np.zeros((1, 4)), np.zeros((1, 3)), np.zeros(1), 1.0, None)
    corners = grain.vertices[grain.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_areas = np.linalg.norm(normals, axis=1)
    normals /= double_areas[:, None]
    centroids = corners.mean(axis=1)
    planes = np.column_stack((normals, np.einsum("ij,ij->i", normals, centroids)))
    horizon = np.full(len(planes), UNKNOWN) if plain else horizon_of(grain.vertices, grain.faces, planes)
    share = float(np.average(np.maximum(1.0 - horizon**2, 0.0), weights=double_areas))
    return Surface(planes, centroids, horizon, share, embree_scene(grain))


@dataclass(eq=False)
class Tracer:
    """One thread's way of tracing a grain: the state of its rays, and what all share: surface and ray engine.

    Parameters
    ----------
    grain : Grain
    eta : float
        n_inside / n_outside.
    fresnel : {"un", "sp"}
        Reflectance averaged over polarisations at each hit, or (exact sphere only) kept apart along each path.
    seed : int
    max_bounces : int
        Hits after which the rest of a path counts as truncated.
    plain : bool
        Independent random numbers and one way at each hit: the textbook estimator, for comparison.
    reflectance_scale : float
        Factor on every partial reflectance; other than 1 it makes a wrong tracer, to test the tests.
    """

    grain: Grain
    eta: float
    fresnel: str = "un"
    seed: int = 0
    max_bounces: int = MAX_BOUNCES
    plain: bool = False
    reflectance_scale: float = 1.0
    slots: int = SLOTS
    log: Callable[[np.ndarray, np.ndarray], None] | None = None

    def __post_init__(self) -> None:
        planes, centroids, horizon, share, self._scene = surface_of(self.grain, self.plain)
        self._sphere = self.grain.kind == "sphere"
        self._fan = 1 if self.plain else FAN if share > OPEN else FAN // 2
        self._task = Handle(
            Task(
                self._sphere, planes, centroids, horizon, float(self.eta),
                {"un": UNPOLARISED, "sp": KEPT_APART}[self.fresnel], float(self.reflectance_scale),
                T.UNIT if self.plain else int(SPLIT * T.UNIT / self._fan), self._fan, self.max_bounces, self.seed,
                self.plain, SOBOL,
            )
        )  # fmt: skip
        self._block = Handle(Departed(np.empty((13, BLOCK)), np.empty((3, BLOCK), np.int64), np.empty((8, BLOCK))))
        self._always = np.zeros(0, np.int32)
        self._rays: list[Handle] = []
        self._reserve((1 + self._fan) * self.slots)

    def _reserve(self, capacity: int) -> None:
        """Make room for that many rays, keeping those under way."""
        old = len(self._always)
        if capacity <= old:
            return
        now, then = np.empty(capacity, RAY), np.empty(capacity, RAY)
        starts, ways = np.empty((capacity, 3), np.float32), np.empty((capacity, 3), np.float32)
        if old:
            mine = self._rays[0].values
            now[:old], starts[:old], ways[:old] = mine.now, mine.starts, mine.ways
        self._rays = [Handle(Rays(now, then, starts, ways)), Handle(Rays(then, now, starts, ways))]
        self._always = np.zeros(capacity, np.int32)

    def trace(self, paths: np.ndarray, tally: Tally, stop: Event | None = None) -> int:
        """Trace the paths of the numbers given, (n,) int64, into `tally`; return the number of rays that took.

        Once `stop` is set the counts are worthless.
        """
        counts = Handle(Counts(**tally.arrays(), edges=T.L_EDGES))
        first, live, total = 0, 0, 0
        tally.scalars[:, T.LAUNCHED] += T.UNIT * np.bincount(paths % T.REPLICATES, minlength=T.REPLICATES)
        while (live or first < len(paths)) and not (stop is not None and stop.is_set()):
            if live < self.slots // 2 and first < len(paths):
                fresh = paths[first : first + self.slots - live]
                spawn(self._task, self._rays[0], live, fresh, counts)
                first, live = first + len(fresh), live + len(fresh)
            self._reserve((1 + self._fan) * live)
            starts, ways = self._rays[0].values.starts[:live], self._rays[0].values.ways[:live]
            prims = self._always[:live] if self._sphere else self._scene.run(starts, ways)
            if self.log is not None:
                self.log(starts, ways)
            total += live
            live = advance(self._task, self._rays[0], self._block, counts, live, prims)
            self._rays.reverse()
        return total


def ahead(grain: Grain) -> None:
    """Begin, in a thread beside what goes on here, to make ready what tracing a grain asks for: machine code, horizon.

    What fails there fails again where it is needed.
    """

    def work() -> None:
        with contextlib.suppress(Exception):
            Tracer(grain, eta=1.5).trace(in_order(0, T.REPLICATES), Tally())

    Thread(target=work).start()
