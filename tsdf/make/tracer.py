"""Light through one grain: sample an incoming ray, follow it until it leaves the bounding sphere, count it.

Embree finds the facets, `advance` does the rest in one go over all rays: Fresnel, splitting, restart, counting,
compaction. Only the facet's number is taken from Embree; the hit is recomputed in float64 (`optics`), so that the
result does not depend on the last bits of a ray engine.

Light splits in two at a hit. A part lighter than `SPLIT` goes on with that much or not at all, at random, and the other
part has the rest, so that no energy is made or lost; a part that leaves for good may be lighter, for it needs no ray.
What leaves for good is told from the horizon of its facet (`horizon_of`), above which a facet is also lit from several
directions at once (`FAN`). Every path has a random stream of its own, a function of the seed and the path's number, so
paths may be traced in any order, batch and thread.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from threading import Event
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.grain.grains import Grain, embree_scene
from tsdf.grain.horizon import UNKNOWN, horizon_of
from tsdf.grain.optics import OFFSET, UNPOLARISED, P, S, nearer, on_plane, parted, sound
from tsdf.handle import Handle
from tsdf.make import tally as T
from tsdf.make.tally import Tally
from tsdf.sampling import GOLDEN, SOBOL, key_of, mix, sobol, turn, unit
from tsdf.vectors import KERNEL, cross, dot, frame, minus, renewed, step, triple

LIGHT = T.UNIT // 16  # light that weighs less is counted one way, as it is or walked backwards, with the weight of both
NO_OFFSET = 1e-9  # light that leaves this near to where it came in leaves there [R]
ATOM = 1e-5  # deflections closer than this to 0 or pi are exact for float32 geometry [rad]
SPLIT = 0.6  # a part lighter than this share of the light that enters is raised to it at random
FAN = 4  # directions in which a facet is lit from one point, half as many in a grain that shades itself
OPEN = 0.9  # share of the light that comes in above the horizon of a grain that does not
SLOTS = 2048  # rays under way at once, per thread, but for splitting: their state stays in the second-level cache
MAX_BOUNCES = 100_000  # default bounce limit

# A ray under way: where it starts and goes, the length inside so far, the light that entered, its random key and path,
# the facet it starts from, hits so far
RAY = np.dtype(
    [("p", "3f8"), ("d", "3f8"), ("entry", "3f8"), ("d_in", "3f8"), ("length", "f8"), ("key", "u8"), ("path", "i8"),
     ("weight", "i4"), ("facet", "i4"), ("hits", "i4"), ("flags", "i4")]
)  # fmt: skip
INSIDE, RETRIED, MET, P_POLARISED = 1, 2, 4, 8
OTHER = np.uint64(0xA5A5A5A5A5A5A5A5)  # turns a random key into that of the other branch

BLOCK = 128  # light that leaves counted together: small enough for the first-level cache
COS_THETA, THETA, FORTH, BACK = 0, 1, 2, 5  # rows of `Block.found`; r, z, phi_delta follow in those from FORTH and BACK

KEPT_APART = 3  # polarisations: each path has one

BOX_PHI, BOX_R, BOX_Z, BOX_L = (T.BOX[name] for name in ("phi", "r", "z", "l"))

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


class Block(NamedTuple):
    """Light that left and is still to be counted, in columns.

    left (13, n): where it starts for the rim, its direction, where the light entered, its direction, the length inside;
    notes (3, n) int64: weight, path, key; found (8, n): see `measure`.
    """

    left: np.ndarray
    notes: np.ndarray
    found: np.ndarray


class Counts(NamedTuple):
    """The arrays of a `Tally`, and the edges of its cells of path length."""

    scalars: np.ndarray
    theta: np.ndarray
    cells: np.ndarray
    box: np.ndarray
    box_l: np.ndarray
    records: np.ndarray
    entry: np.ndarray
    entry_records: np.ndarray
    edges: np.ndarray


class Past(NamedTuple):
    """What light has behind it: where and along what direction it entered, the length inside so far, its path."""

    entry: tuple[float, float, float]
    d_in: tuple[float, float, float]
    length: float
    path: int


class State(NamedTuple):
    """Of a ray: energy, random key, the facet it starts from, flags, hits so far."""

    weight: int
    key: int
    facet: int
    flags: int
    hits: int


@njit(cache=True)
def rim(p, d):
    """Return where light from p along d leaves the bounding sphere."""
    along = dot(p, d)
    return step(p, math.sqrt(max(0.0, along * along + (1.0 - dot(p, p)))) - along, d)


@njit(cache=True)
def entry_b2(p, d):
    """Return the squared distance from the centre of the ray through p along d."""
    side = step(p, -dot(p, d), d)
    return min(1.0, dot(side, side))


@njit(cache=True)
def entry_cell(b2, cells):
    """Return which of so many equal cells of [0, 1] holds b2."""
    return min(int(b2 * cells), cells - 1)


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


@njit(cache=True)
def length_cell(length, edges):
    """Return the cell of `tally.L_EDGES` that holds a path length; 0 is the atom of light that never entered."""
    if length <= 0.0:
        return 0
    if length < T.L_FINE:
        return 1 + int(length * T.L_STEP)
    k = 1 + int(T.L_FINE * T.L_STEP)
    while k < edges.shape[0] - 2 and length >= edges[k + 1]:
        k += 1
    return k


@njit(cache=True, error_model="numpy")
def arc(y, x):
    """Return atan2(y, x) to 1e-10, the same on every machine; a Chebyshev fit of atan(a) / a in a^2.

    Without branches, so that the compiler can do several at once.
    """
    ay, ax = abs(y), abs(x)
    a = min(ay, ax) / max(ay, ax, 1e-300)
    q = a * a
    s = 0.004827227698418 - 0.0006804972611845 * q
    s = 0.03413342266011 + q * (-0.01605516042953 + q * s)
    s = 0.07242284126318 + q * (-0.05421530811893 + q * s)
    s = 0.1109298478666 + q * (-0.08979051044096 + q * s)
    s = 0.1999990995702 + q * (-0.1428394842117 + q * s)
    s = a * (0.999999999939 + q * (-0.333333315182 + q * s))
    s = 0.5 * math.pi - s if ay > ax else s
    s = math.pi - s if x < 0.0 else s
    return -s if y < 0.0 else s


@njit(cache=True)
def settle(reservoir):
    """Let the row of the largest key stand last."""
    last, worst = reservoir.shape[0] - 1, 0
    for k in range(1, last + 1):
        if reservoir[k, 0] > reservoir[worst, 0]:
            worst = k
    if worst != last:
        for k in range(reservoir.shape[1]):
            reservoir[last, k], reservoir[worst, k] = reservoir[worst, k], reservoir[last, k]


@njit(cache=True)
def azimuth_from(p, d, out):
    """Return the azimuth of `out` about d from the side on which light along d enters at p."""
    side = step(p, -dot(p, d), d)
    return arc(dot(d, cross(side, out)), dot(side, out))


@njit(cache=True)
def keep(counts, c, weight, key, offset, p, d, out):
    """Offer the record of light that enters at p along d and leaves along `out` to the reservoirs.

    Those of cell `c` of theta and of its cell of entry_b2: it stays if its key u / weight is among the smallest.
    `offset` is r, z, phi_Delta and the path length.
    """
    records, entry_records = counts.records, counts.entry_records
    r, z, phi, length = offset
    share = weight / T.UNIT
    value = (1.0 - unit(key)) / share
    if records.shape[1] > 0 and value < records[c, -1, 0]:
        row = records[c, -1]
        row[0], row[1], row[2], row[3], row[4], row[5] = value, share, r, z, phi, length
        row[6] = entry_b2(p, d)
        row[7] = azimuth_from(p, d, out) if c < T.COARSE else 0.0
        settle(records[c])
    if entry_records.shape[1] > 0:
        b2 = entry_b2(p, d)
        reservoir = entry_records[entry_cell(b2, T.COARSE)]
        if value < reservoir[-1, 0]:
            row = reservoir[-1]
            row[0], row[1], row[2] = value, share, min(max(dot(d, out), -1.0), 1.0)
            row[3] = azimuth_from(p, d, out) if c < T.COARSE else 0.0
            row[4], row[5], row[6], row[7], row[8] = r, z, phi, length, b2
            settle(reservoir)


@njit(cache=True)
def rounded(x):
    """Return the nearest integer."""
    return np.int64(math.floor(x + 0.5))


@njit(cache=True, inline="always")
def column(block, row, i):
    """Return three elements of a column."""
    return block[row, i], block[row + 1, i], block[row + 2, i]


@njit(cache=True, error_model="numpy")
def measure(count, left, found):
    """Find cos theta, theta, and r, z, phi_delta forwards and backwards of the first `count` columns of `left`.

    A straight loop over arrays becomes vector instructions, five times faster; a ninth row of results, or a branch,
    and the compiler gives up on that.
    """
    for i in range(count):
        p, d, entry, d_in = column(left, 0, i), column(left, 3, i), column(left, 6, i), column(left, 9, i)
        offset = step(rim(p, d), -1.0, entry)
        axis, across, across_back = cross(d_in, d), cross(offset, d_in), cross(offset, d)
        cos_theta, z, z_back = dot(d_in, d), dot(offset, d_in), dot(offset, d)
        sine = dot(offset, axis)  # of phi_delta, times r sin theta; the same both ways
        found[COS_THETA, i], found[THETA, i] = cos_theta, arc(math.sqrt(dot(axis, axis)), cos_theta)
        found[FORTH, i], found[FORTH + 1, i] = math.sqrt(dot(across, across)), z
        found[FORTH + 2, i] = arc(sine, z_back - cos_theta * z)
        found[BACK, i], found[BACK + 1, i] = math.sqrt(dot(across_back, across_back)), z_back
        found[BACK + 2, i] = arc(sine, z - cos_theta * z_back)


@njit(cache=True)
def side_azimuth(entry, d_in, exit):
    """Return the azimuth of the offset from the side on which light enters, for light that is not deflected."""
    side, offset = step(entry, -dot(entry, d_in), d_in), step(exit, -1.0, entry)
    return arc(dot(d_in, cross(side, offset)), dot(side, offset))


@njit(forceinline=True, **KERNEL)
def offset_cells(r, z):
    """Return the cells of r and of z."""
    # z = 0, a reflection, must not fall on both sides
    return min(int(r * (T.R / 2.0)), T.R - 1), min(max(int((z + 1.0) * (T.Z / 3.0) + 1e-9), 0), T.Z - 1)


@njit(**KERNEL)
def count_offset(counts, c, weight, offset):
    """Count one offset in the conditionals of cell c of theta."""
    r, z, phi, _ = offset
    rc, zc = offset_cells(r, z)
    counts.cells[c, T.AT_PHI + int(phi * (T.PHI / (2.0 * math.pi)) + (T.PHI + 0.5)) % T.PHI] += weight
    counts.cells[c, T.AT_R + rc] += weight
    counts.cells[c, T.AT_Z + zc] += weight


@njit(**KERNEL)
def count_joint(counts, half, g, weight, offset):
    """Count one offset in the joint distributions of group g of theta."""
    r, z, phi, length = offset
    rc, zc = offset_cells(r, z)
    lb = min(int(length * (BOX_L / T.BOX_LENGTH)), BOX_L - 1)
    pb = int(phi * (BOX_PHI / (2.0 * math.pi)) + (BOX_PHI + 0.5)) % BOX_PHI
    rb, zb = rc * BOX_R // T.R, zc * BOX_Z // T.Z
    counts.box[half, g, pb, rb, zb] += weight
    counts.box_l[half, g, lb, pb] += weight
    counts.box_l[half, g, lb, BOX_PHI + rb] += weight
    counts.box_l[half, g, lb, BOX_PHI + BOX_R + zb] += weight


@njit(**KERNEL)
def count_block(count, block, counts):
    """Count the light of a block's first `count` columns, as it is and walked backwards, which is as likely."""
    left, notes, found, scalars = block.left, block.notes, block.found, counts.scalars
    kept = counts.records.shape[1] > 0 or counts.entry_records.shape[1] > 0
    measure(count, left, found)
    for i in range(count):
        p, d, entry, d_in = column(left, 0, i), column(left, 3, i), column(left, 6, i), column(left, 9, i)
        length, weight, path, key = left[12, i], notes[0, i], notes[1, i], np.uint64(notes[2, i])
        cos_theta, angle = found[COS_THETA, i], found[THETA, i]
        r, z, phi = column(found, FORTH, i)
        r_back, z_back, phi_back = column(found, BACK, i)
        if ATOM < angle < math.pi - ATOM:
            f = min(int(angle * (T.FINE / math.pi)), T.FINE - 1)
            c, g = f // (T.FINE // T.COARSE), f // (T.FINE // T.GROUPS)
        else:
            away = 0 if cos_theta > 0.0 else 1
            f, c, g = T.FINE + away, T.COARSE + away, T.GROUPS + away
            phi = side_azimuth(entry, d_in, rim(p, d))
            phi_back = side_azimuth(rim(p, d), minus(d), entry)

        phi = phi if r > NO_OFFSET else 0.0  # else an azimuth of rounding errors
        phi_back = phi_back if r_back > NO_OFFSET else 0.0

        replicate = path % T.REPLICATES
        energy_length = rounded(weight * length)
        scalars[replicate, T.SCATTERED] += weight
        scalars[replicate, T.COS_THETA] += rounded(weight * cos_theta)
        scalars[replicate, T.MEAN_R] += rounded(weight * 0.5 * (r + r_back))
        scalars[replicate, T.MEAN_Z] += rounded(weight * 0.5 * (z + z_back))
        scalars[replicate, T.PATH_LENGTH] += energy_length
        scalars[replicate, T.OFFSET] += rounded(weight * math.sqrt(r * r + z * z))
        counts.theta[replicate, f] += weight
        lc = length_cell(length, counts.edges)
        counts.cells[c, T.AT_L + lc] += weight
        counts.cells[c, T.AT_L_SUM + lc] += energy_length
        # an eighth of the paths tells the joint distributions well enough
        boxed = mix(np.uint64(path)) & np.uint64(7) == 0
        forth, back = weight, weight
        if weight < LIGHT:
            forth, back = (2 * weight, 0) if key & np.uint64(256) else (0, 2 * weight)
        for way in range(2):
            share = forth if way == 0 else back
            if share == 0:
                continue
            offset = (r, z, phi, length) if way == 0 else (r_back, z_back, phi_back, length)
            count_offset(counts, c, share, offset)
            if boxed:
                count_joint(counts, replicate & 1, g, share, offset)
            if kept and way == 0:
                keep(counts, c, share, mix(key + np.uint64(0x51)), offset, entry, d_in, d)
            elif kept:
                keep(counts, c, share, mix(key + np.uint64(0x52)), offset, rim(p, d), minus(d), minus(d_in))


@njit(forceinline=True, **KERNEL)
def leave(block, i, p, d, past, weight, key):
    """Note in column i light that leaves point p along d for good."""
    left, notes = block.left, block.notes
    for k in range(3):
        left[k, i], left[3 + k, i], left[6 + k, i], left[9 + k, i] = p[k], d[k], past.entry[k], past.d_in[k]
    left[12, i], notes[0, i], notes[1, i], notes[2, i] = past.length, weight, past.path, np.int64(key)


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
            mirrored_weight = rounded(weight * min(reflectance * task.reflectance_scale, 1.0))
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


@lru_cache(maxsize=2)  # the threads of a build share it: the horizon takes about a second to find
def surface_of(grain: Grain, plain: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return what the kernels ask of a grain's surface; of the exact sphere, one facet that says nothing.

    Returns
    -------
    planes : (n, 4) float64
        Normal and height over the origin of each facet.
    centroids : (n, 3) float64
    horizon : (n,) float64
        See `horizon_of`; nothing is promised if `plain`.
    share : float
        Share of the light that comes in above the horizon.
    """
    if grain.kind == "sphere":
        return np.zeros((1, 4)), np.zeros((1, 3)), np.zeros(1), 1.0
    corners = grain.vertices[grain.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_areas = np.linalg.norm(normals, axis=1)
    normals /= double_areas[:, None]
    centroids = corners.mean(axis=1)
    planes = np.column_stack((normals, np.einsum("ij,ij->i", normals, centroids)))
    horizon = np.full(len(planes), UNKNOWN) if plain else horizon_of(grain.vertices, grain.faces, planes)
    share = float(np.average(np.maximum(1.0 - horizon**2, 0.0), weights=double_areas))
    return planes, centroids, horizon, share


@dataclass(eq=False)
class Tracer:
    """One thread's way of tracing a grain: the ray engine, the state of its rays and nothing else.

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
        planes, centroids, horizon, share = surface_of(self.grain, self.plain)
        self._sphere = self.grain.kind == "sphere"
        if not self._sphere:
            self._scene = embree_scene(self.grain)
        self._fan = 1 if self.plain else FAN if share > OPEN else FAN // 2
        self._task = Handle(
            Task(
                self._sphere, planes, centroids, horizon, float(self.eta),
                {"un": UNPOLARISED, "sp": KEPT_APART}[self.fresnel], float(self.reflectance_scale),
                T.UNIT if self.plain else int(SPLIT * T.UNIT / self._fan), self._fan, self.max_bounces, self.seed,
                self.plain, SOBOL,
            )
        )  # fmt: skip
        self._block = Handle(Block(np.empty((13, BLOCK)), np.empty((3, BLOCK), np.int64), np.empty((8, BLOCK))))
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
