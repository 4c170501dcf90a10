"""Light through one grain: sample an incoming ray, follow it until it leaves the bounding sphere, count it.

Embree finds the facets, one fused kernel does the rest: Fresnel, splitting, restart, counting, compaction. Only the
facet's number is taken from Embree; the hit is recomputed in float64 from the facet's plane, so that the result does
not depend on the last bits of a ray engine. A ray restarts `OFFSET` off the facet along its geometric normal.

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

import numpy as np

from tsdf import tally as T
from tsdf.compiled import njit
from tsdf.grains import Grain, embree_scene
from tsdf.horizon import UNKNOWN, horizon_of
from tsdf.optics import UNPOLARISED, fresnel
from tsdf.sampling import GOLDEN, SOBOL, key_of, mix, sobol, turn, unit
from tsdf.tally import Tally
from tsdf.vectors import cross, dot, frame, minus, step, triple

OFFSET = 1e-5  # restart distance along the geometric normal [R]: 1e-7 to 1e-4 leave no self-hits, 1e-3 biases
RETRY = 1e-3  # share of the way to the facet's centroid by which a failed restart is moved
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

# Light that leaves is counted in blocks. Rows of `left`: where it starts for the rim, its direction, where the light
# entered, its direction, the length inside (13); of `notes`: weight, path, key; of `found`, see `measure`:
BLOCK = 128  # small enough for the first-level cache
COS_THETA, THETA, FORTH, BACK = 0, 1, 2, 5  # r, z, phi_delta follow in the rows from FORTH and BACK

BOX_PHI, BOX_R, BOX_Z, BOX_L = (T.BOX[name] for name in ("phi", "r", "z", "l"))

GOLDEN_C, GOLDEN_S = math.cos(2.0 * math.pi * 0.6180339887498949), math.sin(2.0 * math.pi * 0.6180339887498949)


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


@njit(cache=True, nogil=True)
def spawn(paths, seed, plain, directions, rays, starts, ways, by_entry):
    """Start the paths numbered: parallel light, uniform over the disc, from everywhere."""
    low, high = np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(len(paths)):
        path = paths[i]
        if plain:
            u0, u1 = unit(key_of(seed, path, 11)), unit(key_of(seed, path, 12))
            u2, u3 = unit(key_of(seed, path, 13)), unit(key_of(seed, path, 14))
        else:
            index = path // T.REPLICATES
            k = key_of(seed, path % T.REPLICATES, 7)
            k2 = mix(k + np.uint64(1))
            u0 = sobol(index, 0, k & low, directions)
            u1 = sobol(index, 1, k >> high, directions)
            u2 = sobol(index, 2, k2 & low, directions)
            u3 = sobol(index, 3, k2 >> high, directions)
        dz = 1.0 - 2.0 * u0
        across = math.sqrt(max(0.0, 1.0 - dz * dz))
        c, s = turn(u1)
        d = (across * c, across * s, dz)
        t, b = frame(d)
        radius = math.sqrt(u2)
        c, s = turn(u3)
        entry = step(step(step((0.0, 0.0, 0.0), radius * c, t), radius * s, b), -math.sqrt(1.0 - u2), d)
        side = P_POLARISED if key_of(seed, path, 2) & np.uint64(1) else 0
        start(i, rays, starts, ways, entry, entry, d, entry, d, 0.0, T.UNIT, key_of(seed, path, 1), -1, side, 0, path)
        if by_entry.shape[1] > 0:
            by_entry[0, entry_cell(entry_b2(entry, triple(rays[i].d)), T.ENTRY)] += T.UNIT


@njit(cache=True, inline="always")
def start(i, rays, starts, ways, p, shifted, d, entry, d_in, length, weight, key, facet, flags, hits, path):
    """Write ray i from p along d, and for the ray engine from `shifted`."""
    unit_length = 1.5 - 0.5 * dot(d, d)  # a step of Newton's: keeps rounding errors from piling up
    ray = rays[i]
    for k in range(3):
        ray.p[k], ray.d[k], ray.entry[k], ray.d_in[k] = p[k], d[k] * unit_length, entry[k], d_in[k]
        starts[i, k], ways[i, k] = shifted[k], d[k] * unit_length
    ray.length, ray.weight, ray.key, ray.path = length, weight, key, path
    ray.facet, ray.flags, ray.hits = facet, flags, hits


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
def keep(records, entry_records, c, weight, key, r, z, phi, length, p, d, out):
    """Offer the record of light that enters at p along d and leaves along `out` to the reservoirs.

    Those of cell `c` of theta and of its cell of entry_b2: it stays if its key u / weight is among the smallest.
    """
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
def row(block, i):
    """Return the first three elements of a row."""
    return block[i, 0], block[i, 1], block[i, 2]


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


@njit(cache=True, inline="always")
def count_offset(cells, c, box, box_l, half, g, lb, boxed, weight, r, z, phi):
    """Count one offset in the conditionals and, if `boxed`, in the joint distributions."""
    rc = min(int(r * (T.R / 2.0)), T.R - 1)
    zc = min(max(int((z + 1.0) * (T.Z / 3.0) + 1e-9), 0), T.Z - 1)  # z = 0, a reflection, must not fall on both sides
    cells[c, T.AT_PHI + int(phi * (T.PHI / (2.0 * math.pi)) + (T.PHI + 0.5)) % T.PHI] += weight
    cells[c, T.AT_R + rc] += weight
    cells[c, T.AT_Z + zc] += weight
    if boxed:
        pb = int(phi * (BOX_PHI / (2.0 * math.pi)) + (BOX_PHI + 0.5)) % BOX_PHI
        rb, zb = rc * BOX_R // T.R, zc * BOX_Z // T.Z
        box[half, g, pb, rb, zb] += weight
        box_l[half, g, lb, pb] += weight
        box_l[half, g, lb, BOX_PHI + rb] += weight
        box_l[half, g, lb, BOX_PHI + BOX_R + zb] += weight


@njit(cache=True)
def count_block(count, block, edges, counters):
    """Count the light of a block's first `count` columns, as it is and walked backwards, which is as likely."""
    left, notes, found = block
    scalars, theta, cells, box, box_l, records, _, entry_records = counters
    kept = records.shape[1] > 0 or entry_records.shape[1] > 0
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
        theta[replicate, f] += weight
        lc = length_cell(length, edges)
        cells[c, T.AT_L + lc] += weight
        cells[c, T.AT_L_SUM + lc] += energy_length
        # an eighth of the paths tells the joint distributions well enough
        boxed = mix(np.uint64(path)) & np.uint64(7) == 0
        half, lb = replicate & 1, min(int(length * (BOX_L / T.BOX_LENGTH)), BOX_L - 1)
        forth, back = weight, weight
        if weight < LIGHT:
            forth, back = (2 * weight, 0) if key & np.uint64(256) else (0, 2 * weight)
        if forth > 0:
            count_offset(cells, c, box, box_l, half, g, lb, boxed, forth, r, z, phi)
        if back > 0:
            count_offset(cells, c, box, box_l, half, g, lb, boxed, back, r_back, z_back, phi_back)
        if kept and forth > 0:
            once = mix(key + np.uint64(0x51))
            keep(records, entry_records, c, forth, once, r, z, phi, length, entry, d_in, d)
        if kept and back > 0:
            again, exit = mix(key + np.uint64(0x52)), rim(p, d)
            keep(records, entry_records, c, back, again, r_back, z_back, phi_back, length, exit, minus(d), minus(d_in))


@njit(cache=True, inline="always")
def leave(i, left, notes, p, d, length, entry, d_in, weight, key, path):
    """Note in column i light that leaves point p along d for good."""
    for k in range(3):
        left[k, i], left[3 + k, i], left[6 + k, i], left[9 + k, i] = p[k], d[k], entry[k], d_in[k]
    left[12, i], notes[0, i], notes[1, i], notes[2, i] = length, weight, path, np.int64(key)


@njit(cache=True, nogil=True, error_model="numpy")
def advance(count, prims, sphere, planes, centroids, horizon, eta, polarisation, reflectance_scale,
            split, fan_size, max_hits, edges, rays, next_rays, starts, ways, block, counters):  # fmt: skip
    """Take `count` rays, whose next facets are `prims`, through one hit each; return how many go on.

    What goes on is packed into next_rays and, for the ray engine, starts and ways.
    """
    scalars, by_entry, (left, notes, _) = counters[0], counters[6], block
    live, held = 0, 0
    for i in range(count):
        if held > BLOCK - fan_size:
            count_block(held, block, edges, counters)
            held = 0
        ray, facet = rays[i], prims[i]
        p, d, entry, d_in = triple(ray.p), triple(ray.d), triple(ray.entry), triple(ray.d_in)
        length, path, key, weight = ray.length, ray.path, ray.key, np.int64(ray.weight)
        inside, met, side = (ray.flags & INSIDE) != 0, (ray.flags & MET) != 0, ray.flags & P_POLARISED
        replicate = path % T.REPLICATES

        if facet < 0 and not inside:
            if met:
                leave(held, left, notes, p, d, length, entry, d_in, weight, key, path)
                held += 1
            else:
                scalars[replicate, T.UNSCATTERED] += weight
                scalars[replicate, T.MISS_CHORD] += rounded(weight * -2.0 * dot(p, d))
                if by_entry.shape[1] > 0:
                    by_entry[1, entry_cell(entry_b2(p, d), T.ENTRY)] += weight
            continue

        # The hit, on the facet's plane (or the sphere), with its normal
        lost = facet < 0
        n, cosine, t = (0.0, 0.0, 0.0), 0.0, 0.0
        if sphere:
            t = -2.0 * dot(p, d) if inside else 0.0
            n = step(p, t, d)
            n = step((0.0, 0.0, 0.0), 1.0 / math.sqrt(dot(n, n)), n)
            cosine = dot(n, d)
        elif not lost:
            n = row(planes, facet)
            cosine = dot(n, d)
            t = (planes[facet, 3] - dot(n, p)) / cosine
        if lost or (cosine > 0.0) != inside or not (-10.0 * OFFSET <= t <= 2.5):
            # A leak at an edge or a vertex: once more from nearer the middle of the facet it came from
            if ray.facet < 0 or ray.flags & RETRIED:
                scalars[replicate, T.LOST] += weight
            else:
                moved = step(p, RETRY, step(row(centroids, ray.facet), -1.0, p))
                moved = step(moved, -OFFSET if inside else OFFSET, row(planes, ray.facet))
                start(live, next_rays, starts, ways, p, moved, d, entry, d_in, length, weight, key,
                      ray.facet, ray.flags | RETRIED, ray.hits, path)  # fmt: skip
                live += 1
            continue

        t = max(t, 0.0)
        p = n if sphere else step(p, t, d)
        if inside:
            length += t
        hits = ray.hits + 1
        if hits > max_hits:
            scalars[replicate, T.TRUNCATED] += weight
            continue

        # Above the horizon of a facet light comes unobstructed: one point, several directions
        low = horizon[facet]
        fan = 1 if inside or met or -cosine <= low else fan_size
        weight //= fan
        full = 1.0 - low * low
        u, turn_c, turn_s = 0.0, 1.0, 0.0
        tangent, bitangent = d, d
        if fan > 1:
            tangent, bitangent = frame(n)
            c, s = dot(d, tangent), dot(d, bitangent)
            u = min(c * c + s * s, full)
            around = math.sqrt(u)
            turn_c, turn_s = (c / around, s / around) if around > 0.0 else (1.0, 0.0)
        for k in range(fan):
            if k > 0:
                # Lambert's projection turned by the golden angle and shifted by 1 / fan: uniform again
                u = u + full / fan if u + full / fan < full else u + full / fan - full
                turn_c, turn_s = turn_c * GOLDEN_C - turn_s * GOLDEN_S, turn_s * GOLDEN_C + turn_c * GOLDEN_S
                cosine = -math.sqrt(max(1.0 - u, 1e-300))
                d = step(step(step((0.0, 0.0, 0.0), math.sqrt(u) * turn_c, tangent), math.sqrt(u) * turn_s, bitangent),
                         cosine, n)  # fmt: skip
                entry, d_in = rim(p, minus(d)), d

            # Reflection and refraction; one of the two goes on outside (out), the other inside (into)
            ratio = 1.0 / eta if inside else eta
            cos_i = min(abs(cosine), 1.0)
            reflectance, cos_t = fresnel(cos_i, ratio, polarisation if polarisation < 3 else (2 if side else 1))
            total = reflectance >= 1.0
            if not total:
                reflectance = min(reflectance * reflectance_scale, 1.0)
            mirrored = step(d, -2.0 * cosine, n)
            bent = d
            if ratio != 1.0:
                bend = cos_t - cos_i / ratio
                bent = step(step((0.0, 0.0, 0.0), 1.0 / ratio, d), bend if cosine > 0.0 else -bend, n)
            out, into = (bent, mirrored) if inside else (mirrored, bent)
            mirrored_weight = weight if total else rounded(weight * reflectance)
            out_weight = weight - mirrored_weight if inside else mirrored_weight
            key = mix(key + GOLDEN)
            lighter = min(out_weight, weight - out_weight)
            least = min(split, weight)
            free = dot(out, n) > low or low == 0.0
            if 0 < lighter < least and not (free and weight > split and out_weight == lighter):
                kept = least if unit(key) * least < lighter else 0
                out_weight = kept if lighter == out_weight else weight - kept
            if out_weight > 0:
                if free:
                    leave(held, left, notes, p, out, length, entry, d_in, out_weight, key, path)
                    held += 1
                else:
                    start(live, next_rays, starts, ways, p, step(p, OFFSET, n), out, entry, d_in, length,
                          out_weight, mix(key ^ OTHER), facet, MET | side, hits, path)  # fmt: skip
                    live += 1
            if out_weight < weight:
                start(live, next_rays, starts, ways, p, step(p, -OFFSET, n), into, entry, d_in, length,
                      weight - out_weight, key, facet, MET | INSIDE | side, hits, path)  # fmt: skip
                live += 1
    count_block(held, block, edges, counters)
    return live


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
        self._sphere = self.grain.kind == "sphere"
        self._polarisation = {"un": UNPOLARISED, "sp": 3}[self.fresnel]
        self._planes, self._centroids, self._horizon, share = surface_of(self.grain, self.plain)
        if not self._sphere:
            self._scene = embree_scene(self.grain)
        self._fan = 1 if self.plain else FAN if share > OPEN else FAN // 2
        self._split = T.UNIT if self.plain else int(SPLIT * T.UNIT / self._fan)
        self._block = np.empty((13, BLOCK)), np.empty((3, BLOCK), dtype=np.int64), np.empty((8, BLOCK))
        self._rays, self._next = np.empty(0, RAY), np.empty(0, RAY)
        self._starts, self._ways = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
        self._always = np.empty(0, np.int32)
        self._reserve((1 + self._fan) * self.slots)

    def _reserve(self, capacity: int) -> None:
        """Make room for that many rays, keeping those under way."""
        old = len(self._rays)
        if capacity <= old:
            return
        kept = self._rays, self._starts, self._ways
        self._rays, self._next = np.empty(capacity, RAY), np.empty(capacity, RAY)
        self._starts, self._ways = np.empty((capacity, 3), np.float32), np.empty((capacity, 3), np.float32)
        self._always = np.zeros(capacity, dtype=np.int32)
        for new, mine in zip((self._rays, self._starts, self._ways), kept, strict=True):
            new[:old] = mine

    def trace(self, paths: np.ndarray, tally: Tally, stop: Event | None = None) -> int:
        """Trace the paths of the numbers given, (n,) int64, into `tally`; return the number of rays that took.

        Once `stop` is set the counts are worthless.
        """
        counters = (
            tally.scalars, tally.theta, tally.cells, tally.box, tally.box_l, tally.records, tally.entry,
            tally.entry_records,
        )  # fmt: skip
        first, live, total = 0, 0, 0
        tally.scalars[:, T.LAUNCHED] += T.UNIT * np.bincount(paths % T.REPLICATES, minlength=T.REPLICATES)
        while (live or first < len(paths)) and not (stop is not None and stop.is_set()):
            if live < self.slots // 2 and first < len(paths):
                fresh = paths[first : first + self.slots - live]
                spawn(
                    fresh, self.seed, self.plain, SOBOL, self._rays[live:], self._starts[live:], self._ways[live:],
                    tally.entry,
                )  # fmt: skip
                first, live = first + len(fresh), live + len(fresh)
            self._reserve((1 + self._fan) * live)
            starts, ways = self._starts[:live], self._ways[:live]
            prims = self._always[:live] if self._sphere else self._scene.run(starts, ways)
            if self.log is not None:
                self.log(starts, ways)
            total += live
            live = advance(
                live, prims, self._sphere, self._planes, self._centroids, self._horizon, self.eta, self._polarisation,
                self.reflectance_scale, self._split, self._fan, self.max_bounces, T.L_EDGES, self._rays, self._next,
                self._starts, self._ways, self._block, counters,
            )  # fmt: skip
            self._rays, self._next = self._next, self._rays
        return total
