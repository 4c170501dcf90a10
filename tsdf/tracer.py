"""Light through one grain: sample an incoming ray, follow it until it leaves the bounding sphere, count it.

Embree finds the facets, one fused kernel does the rest: Fresnel, splitting, restart, counting, compaction. Only the
facet's number is taken from Embree; the hit is recomputed in float64 from the facet's plane, so that the result does
not depend on the last bits of a ray engine. A ray restarts `OFFSET` off the facet along its geometric normal.

A path splits in two at a hit as long as both parts weigh `SPLIT` or more; a lighter one takes one of the two ways at
random with all of its weight. Either way no energy is made or lost. Every path has a random stream of its own, a
function of the seed and the path's number, so paths may be traced in any order, batch and thread.
"""

import math
from dataclasses import dataclass
from threading import Event
from typing import Any

import numpy as np
from numba import njit

from tsdf import tally as T
from tsdf.grains import Grain, embree_scene
from tsdf.optics import UNPOLARISED, fresnel
from tsdf.tally import Tally

OFFSET = 1e-5  # restart distance along the geometric normal [R], measured: design notes in physics.md §6
RETRY = 1e-3  # share of the way to the facet's centroid by which a failed restart is moved
ATOM = 1e-5  # deflections closer than this to 0 or pi are exact for float32 geometry [rad]
SPLIT = 0.2  # a part lighter than this share of the light that enters is raised to it at random
FAN = 4  # directions in which a facet is lit from one point
SLOTS = 16384  # rays under way at once, per thread
MAX_BOUNCES = 100_000  # default bounce limit

# State of a ray, float64: position, direction, length inside so far, entry, incoming direction
PX, DX, LENGTH, XI, DI, STATE = 0, 3, 6, 7, 10, 13
# and int64: weight, random key, facet, flags, hits so far, path number
WEIGHT, KEY, FACET, FLAGS, HITS, PATH, META = 0, 1, 2, 3, 4, 5, 6
INSIDE, RETRIED, MET = 1, 2, 4

BOX_PHI, BOX_R, BOX_Z, BOX_L = (T.BOX[name] for name in ("phi", "r", "z", "l"))

# Direction numbers of the first four dimensions of Sobol' sequences (Joe & Kuo 2008: s, a, m)
_JOE_KUO = ((0, 0, ()), (1, 0, (1,)), (2, 1, (1, 3)), (3, 1, (1, 3, 1)))


def _direction_numbers() -> np.ndarray:
    v = np.zeros((4, 32), dtype=np.uint32)
    for dimension, (s, a, m) in enumerate(_JOE_KUO):
        numbers = [1] * 32 if s == 0 else list(m)
        for i in range(len(numbers), 32):
            new = numbers[i - s] ^ (numbers[i - s] << s)
            for k in range(1, s):
                new ^= ((a >> (s - 1 - k)) & 1) * (numbers[i - k] << k)
            numbers.append(new)
        v[dimension] = [(number << (31 - i)) & 0xFFFFFFFF for i, number in enumerate(numbers)]
    return v


SOBOL = _direction_numbers()
GOLDEN_C, GOLDEN_S = math.cos(2.0 * math.pi * 0.6180339887498949), math.sin(2.0 * math.pi * 0.6180339887498949)


@njit(cache=True)
def mix(x: int) -> int:
    """Return 64 well-mixed bits of a uint64 (the finaliser of SplitMix64, Steele et al. 2014)."""
    x = np.uint64(x)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True)
def key_of(seed: int, a: int, b: int) -> int:
    """Return the random key of item (a, b) of a seed, uint64."""
    k = mix(np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15))
    k = mix(k ^ (np.uint64(a) * np.uint64(0xD1342543DE82EF95)))
    return mix(k ^ (np.uint64(b) * np.uint64(0x2545F4914F6CDD1D) + np.uint64(1)))


@njit(cache=True)
def unit(key: int) -> float:
    """Return a float64 in [0, 1) from a uint64."""
    return float(np.uint64(key) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def coin(path: int, which: int) -> int:
    """Return 0 or 1, the same for the whole of a path."""
    return np.int64(mix(np.uint64(path) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(which)) >> np.uint64(63))


@njit(cache=True)
def reverse_bits(x: int) -> int:
    """Return a uint32 with its bits in reverse order."""
    x = np.uint32(x)
    x = ((x >> np.uint32(1)) & np.uint32(0x55555555)) | ((x & np.uint32(0x55555555)) << np.uint32(1))
    x = ((x >> np.uint32(2)) & np.uint32(0x33333333)) | ((x & np.uint32(0x33333333)) << np.uint32(2))
    x = ((x >> np.uint32(4)) & np.uint32(0x0F0F0F0F)) | ((x & np.uint32(0x0F0F0F0F)) << np.uint32(4))
    x = ((x >> np.uint32(8)) & np.uint32(0x00FF00FF)) | ((x & np.uint32(0x00FF00FF)) << np.uint32(8))
    return np.uint32((x >> np.uint32(16)) | (x << np.uint32(16)))


@njit(cache=True)
def sobol(index: int, dimension: int, scramble: int, directions: np.ndarray) -> float:
    """Return one coordinate of a nested-uniformly (Owen) scrambled Sobol' point, float64 in (0, 1).

    The scramble is the hash of Laine & Karras 2011 in the form of Burley 2020, a different tree for each `scramble`.
    """
    x = np.uint32(0)
    bit = 0
    while index:
        if index & 1:
            x ^= directions[dimension, bit]
        index >>= 1
        bit += 1
    s = np.uint32(scramble)
    x = reverse_bits(x)
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x3D20ADEA)))
    x = np.uint32(x + s)
    x = np.uint32(x * np.uint32((s >> np.uint32(16)) | np.uint32(1)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x05526C56)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x53A22864)))
    return (float(reverse_bits(x)) + 0.5) * (1.0 / 4294967296.0)


@njit(cache=True)
def frame(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Return two unit vectors that complete a unit vector to a right-handed frame (Duff et al. 2017)."""
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@njit(cache=True, nogil=True)
def spawn(paths, at, seed, plain, directions, state, meta, origins, rays):  # type: ignore[no-untyped-def]
    """Start the paths numbered in slots at ..: parallel light, uniform over the disc, from everywhere."""
    for i in range(len(paths)):
        path = paths[i]
        slot = at + i
        replicate = path % T.REPLICATES
        index = path // T.REPLICATES
        if plain:
            k0, k1, k2, k3 = 11, 12, 13, 14
            u0, u1 = unit(key_of(seed, path, k0)), unit(key_of(seed, path, k1))
            u2, u3 = unit(key_of(seed, path, k2)), unit(key_of(seed, path, k3))
        else:
            k = key_of(seed, replicate, 7)
            low, high = np.uint64(0xFFFFFFFF), np.uint64(32)
            k2 = mix(k + np.uint64(1))
            u0 = sobol(index, 0, k & low, directions)
            u1 = sobol(index, 1, k >> high, directions)
            u2 = sobol(index, 2, k2 & low, directions)
            u3 = sobol(index, 3, k2 >> high, directions)
        dz = 1.0 - 2.0 * u0
        across = math.sqrt(max(0.0, 1.0 - dz * dz))
        dx, dy = across * math.cos(2.0 * math.pi * u1), across * math.sin(2.0 * math.pi * u1)
        tx, ty, tz, bx, by, bz = frame(dx, dy, dz)
        b = math.sqrt(u2)
        c, s, back = b * math.cos(2.0 * math.pi * u3), b * math.sin(2.0 * math.pi * u3), math.sqrt(1.0 - u2)
        x, y, z = c * tx + s * bx - back * dx, c * ty + s * by - back * dy, c * tz + s * bz - back * dz
        row = state[slot]
        row[PX], row[PX + 1], row[PX + 2] = x, y, z
        row[DX], row[DX + 1], row[DX + 2] = dx, dy, dz
        row[LENGTH] = 0.0
        row[XI], row[XI + 1], row[XI + 2] = x, y, z
        row[DI], row[DI + 1], row[DI + 2] = dx, dy, dz
        note = meta[slot]
        note[WEIGHT] = T.UNIT
        note[KEY] = np.int64(key_of(seed, path, 1))
        note[FACET] = -1
        note[FLAGS] = 0
        note[HITS] = 0
        note[PATH] = path
        origins[slot, 0], origins[slot, 1], origins[slot, 2] = x, y, z
        rays[slot, 0], rays[slot, 1], rays[slot, 2] = dx, dy, dz


@njit(cache=True)
def cell(value, low, high, count):  # type: ignore[no-untyped-def]
    """Return the uniform cell that holds `value`, clipped to 0 .. count - 1."""
    return min(max(int((value - low) * (count / (high - low))), 0), count - 1)


@njit(cache=True)
def length_cell(length, edges):  # type: ignore[no-untyped-def]
    """Return the cell of `tally.L_EDGES` that holds a path length; 0 is the atom of light that never entered."""
    if length <= 0.0:
        return 0
    if length < 4.0:
        return 1 + int(length * 16.0)
    k = 65
    while k < edges.shape[0] - 2 and length >= edges[k + 1]:
        k += 1
    return k


@njit(cache=True)
def arc(y: float, x: float) -> float:
    """Return atan2(y, x) to 1e-10, the same on every machine; a Chebyshev fit of atan(a) / a in a^2."""
    ay, ax = abs(y), abs(x)
    low, high = min(ay, ax), max(ay, ax)
    a = low / high if high > 0.0 else 0.0
    q = a * a
    s = 0.004827227698418 - 0.0006804972611845 * q
    s = 0.03413342266011 + q * (-0.01605516042953 + q * s)
    s = 0.07242284126318 + q * (-0.05421530811893 + q * s)
    s = 0.1109298478666 + q * (-0.08979051044096 + q * s)
    s = 0.1999990995702 + q * (-0.1428394842117 + q * s)
    s = a * (0.999999999939 + q * (-0.333333315182 + q * s))
    if ay > ax:
        s = 0.5 * math.pi - s
    if x < 0.0:
        s = math.pi - s
    return -s if y < 0.0 else s


@njit(cache=True)
def azimuth(ax, ay, az, bx, by, bz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Return the angle from a to b about n, both perpendicular to n [rad], 0 if either vanishes."""
    sine = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
    cosine = ax * bx + ay * by + az * bz
    return arc(sine, cosine)


@njit(cache=True)
def offset(xi, di, xo, do, entry, out):  # type: ignore[no-untyped-def]
    """Write cos theta, sin theta, r, z, phi_delta and, if `entry`, b_i^2 and the entry azimuth of one way through."""
    cos_theta = di[0] * do[0] + di[1] * do[1] + di[2] * do[2]
    cx, cy, cz = xo[0] - xi[0], xo[1] - xi[1], xo[2] - xi[2]
    z = cx * di[0] + cy * di[1] + cz * di[2]
    cx, cy, cz = cx - z * di[0], cy - z * di[1], cz - z * di[2]
    tx, ty, tz = do[0] - cos_theta * di[0], do[1] - cos_theta * di[1], do[2] - cos_theta * di[2]
    sin_theta = math.sqrt(tx * tx + ty * ty + tz * tz)
    atom = sin_theta < ATOM
    ex, ey, ez = 0.0, 0.0, 0.0
    if entry or atom:
        depth = xi[0] * di[0] + xi[1] * di[1] + xi[2] * di[2]
        ex, ey, ez = xi[0] - depth * di[0], xi[1] - depth * di[1], xi[2] - depth * di[2]
    if atom:
        tx, ty, tz = ex, ey, ez
    r = math.sqrt(cx * cx + cy * cy + cz * cz)
    out[0], out[1], out[2], out[3] = cos_theta, sin_theta, r, z
    out[4] = azimuth(tx, ty, tz, cx, cy, cz, di[0], di[1], di[2]) if r > 1e-9 else 0.0
    if entry:
        out[5] = min(1.0, ex * ex + ey * ey + ez * ez)
        out[6] = azimuth(ex, ey, ez, tx, ty, tz, di[0], di[1], di[2])


@njit(cache=True)
def keep(records, c, weight, key, length, way):  # type: ignore[no-untyped-def]
    """Offer one record to the reservoir of cell `c`: it stays if its key -ln(u) / weight is among the smallest."""
    count = records.shape[1]
    share = weight / T.UNIT
    value = -math.log(1.0 - unit(key)) / share
    last = count - 1  # the largest key stands last
    if value >= records[c, last, 0]:
        return
    row = records[c, last]
    row[0], row[1] = value, share
    row[2], row[3], row[4], row[5], row[6], row[7] = way[2], way[3], way[4], length, way[5], way[6]
    worst = 0
    for k in range(1, count):
        if records[c, k, 0] > records[c, worst, 0]:
            worst = k
    if worst != last:
        for k in range(T.RECORD):
            swap = records[c, last, k]
            records[c, last, k] = records[c, worst, k]
            records[c, worst, k] = swap


@njit(cache=True)
def leave(p, d, length, xi, di, weight, key, path, edges, way, ends,  # type: ignore[no-untyped-def]
          scalars, theta, cells, box, box_l, records):  # fmt: skip
    """Count light that leaves point p along d for good; `way` (7,) and `ends` (3, 3) are scratch space."""
    along = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    rest = 1.0 - (p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    t = math.sqrt(max(0.0, along * along + rest)) - along
    for k in range(3):
        ends[0, k] = p[k] + t * d[k]
        ends[1, k] = -d[k]
        ends[2, k] = -di[k]
    replicate = path % T.REPLICATES
    sums = scalars[replicate]
    recorded = records.shape[1] > 0
    boxed = coin(path, 6) and coin(path, 7)  # a quarter of the paths tells the joint distributions well enough
    lc = length_cell(length, edges)
    lb = min(int(length * (BOX_L / T.BOX_LENGTH)), BOX_L - 1)
    moment = np.int64(math.floor(weight * length + 0.5))
    mean_r, mean_z = 0.0, 0.0
    c, g, row = 0, 0, cells[0]
    for turn in range(2):
        if turn == 0:
            offset(xi, di, ends[0], d, recorded, way)
            if way[1] < ATOM:
                back = 0 if way[0] > 0.0 else 1
                f, c, g = T.FINE + back, T.COARSE + back, T.GROUPS + back
            else:
                f = min(int(arc(way[1], way[0]) * (T.FINE / math.pi)), T.FINE - 1)
                c, g = f // (T.FINE // T.COARSE), f // (T.FINE // T.GROUPS)
            row = cells[c]
            theta[replicate, f] += weight
            row[T.AT_L + lc] += weight
            row[T.AT_L_SUM + lc] += moment
            sums[T.SCATTERED] += weight
            sums[T.PATH_LENGTH] += moment
            sums[T.COS_THETA] += np.int64(math.floor(weight * way[0] + 0.5))
            sums[T.OFFSET] += np.int64(math.floor(weight * math.sqrt(way[2] * way[2] + way[3] * way[3]) + 0.5))
        else:  # the same path walked backwards is as likely
            offset(ends[0], ends[1], xi, ends[2], recorded, way)
        turned = way[4] if way[4] >= -math.pi / T.PHI else way[4] + 2.0 * math.pi
        pc = int((turned + math.pi / T.PHI) * (T.PHI / (2.0 * math.pi))) % T.PHI
        rc, zc = cell(way[2], 0.0, 2.0, T.R), cell(way[3], -1.0, 2.0, T.Z)
        row[T.AT_PHI + pc] += weight
        row[T.AT_R + rc] += weight
        row[T.AT_Z + zc] += weight
        mean_r += 0.5 * way[2]
        mean_z += 0.5 * way[3]
        if boxed:
            half = replicate & 1
            pb = int((turned + math.pi / BOX_PHI) * (BOX_PHI / (2.0 * math.pi))) % BOX_PHI
            rb, zb = rc * BOX_R // T.R, zc * BOX_Z // T.Z
            box[half, g, pb, rb, zb] += weight
            box_l[half, g, lb, pb] += weight
            box_l[half, g, lb, BOX_PHI + rb] += weight
            box_l[half, g, lb, BOX_PHI + BOX_R + zb] += weight
        if recorded:
            keep(records, c, weight, mix(np.uint64(key) + np.uint64(0x51 + turn)), length, way)
    sums[T.MEAN_R] += np.int64(math.floor(weight * mean_r + 0.5))
    sums[T.MEAN_Z] += np.int64(math.floor(weight * mean_z + 0.5))


@njit(cache=True, nogil=True)
def advance(count, prims, sphere, horizon, eta, polarisation, reflectance_scale, split, fan_size, max_hits,  # type: ignore[no-untyped-def]
            planes, centroids, edges, state, meta, next_state, next_meta, origins, rays, way, ends,
            scalars, theta, cells, box, box_l, records):  # fmt: skip
    """Take `count` rays, whose next facets are `prims`, through one hit each; return how many go on.

    What goes on is packed into next_state, next_meta and, for the ray engine, origins and rays.
    """
    live = 0
    p, d, n = np.empty(3), np.empty(3), np.empty(3)
    out, into, from_x, from_d = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    tx, ty, tz, bx, by, bz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        row, note = state[i], meta[i]
        weight, key, flags, path = note[WEIGHT], np.uint64(note[KEY]), note[FLAGS], note[PATH]
        inside = (flags & INSIDE) != 0
        facet = prims[i]
        for k in range(3):
            p[k], d[k] = row[PX + k], row[DX + k]
        xi, di, length = row[XI : XI + 3], row[DI : DI + 3], row[LENGTH]
        sums = scalars[path % T.REPLICATES]

        if facet < 0 and not inside:
            if flags & MET:
                leave(p, d, length, xi, di, weight, key, path, edges, way, ends,
                      scalars, theta, cells, box, box_l, records)  # fmt: skip
            else:
                chord = -2.0 * (p[0] * d[0] + p[1] * d[1] + p[2] * d[2])
                sums[T.UNSCATTERED] += weight
                sums[T.MISS_CHORD] += np.int64(math.floor(weight * chord + 0.5))
            continue

        # The hit, on the facet's plane (or the sphere), with its normal
        lost = facet < 0
        cosine, t = 0.0, 0.0
        if not lost:
            if sphere:
                t = -2.0 * (p[0] * d[0] + p[1] * d[1] + p[2] * d[2]) if inside else 0.0
                norm = 0.0
                for k in range(3):
                    n[k] = p[k] + t * d[k]
                    norm += n[k] * n[k]
                norm = math.sqrt(norm)
                for k in range(3):
                    n[k] /= norm
                cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
            else:
                n[0], n[1], n[2] = planes[facet, 0], planes[facet, 1], planes[facet, 2]
                cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
                if cosine != 0.0:
                    t = (planes[facet, 3] - (n[0] * p[0] + n[1] * p[1] + n[2] * p[2])) / cosine
            lost = (cosine > 0.0) != inside or cosine == 0.0 or t < -10.0 * OFFSET or t > 2.5
        if lost and not sphere:
            # A leak at an edge or a vertex: once more from nearer the middle of the facet it came from
            start = note[FACET]
            if start < 0 or flags & RETRIED:
                sums[T.LOST] += weight
            else:
                side = -OFFSET if inside else OFFSET
                next_state[live] = row
                next_meta[live] = note
                next_meta[live, FLAGS] = flags | RETRIED
                for k in range(3):
                    moved = p[k] + RETRY * (centroids[start, k] - p[k])
                    origins[live, k] = moved + side * planes[start, k]
                    rays[live, k] = d[k]
                live += 1
            continue

        t = max(t, 0.0)
        for k in range(3):
            p[k] = n[k] if sphere else p[k] + t * d[k]
        if inside:
            length += t
        hits = note[HITS] + 1
        if hits > max_hits:
            sums[T.TRUNCATED] += weight
            continue

        # Above the horizon of a facet light comes unobstructed: one point, several directions
        low = horizon[facet]
        fan = 1 if inside or flags & MET or -cosine <= low else fan_size
        full = 1.0 - low * low
        u, turn_c, turn_s = 0.0, 1.0, 0.0
        if fan > 1:
            weight //= fan
            tx, ty, tz, bx, by, bz = frame(n[0], n[1], n[2])
            c, s = d[0] * tx + d[1] * ty + d[2] * tz, d[0] * bx + d[1] * by + d[2] * bz
            u = min(c * c + s * s, full)
            around = math.sqrt(u)
            turn_c, turn_s = (c / around, s / around) if around > 0.0 else (1.0, 0.0)
        for ray in range(fan):
            if ray > 0:
                # Lambert's projection turned by the golden angle and shifted by 1 / fan: uniform again
                u = u + full / fan if u + full / fan < full else u + full / fan - full
                turn_c, turn_s = turn_c * GOLDEN_C - turn_s * GOLDEN_S, turn_s * GOLDEN_C + turn_c * GOLDEN_S
                c, s, cosine = math.sqrt(u) * turn_c, math.sqrt(u) * turn_s, -math.sqrt(1.0 - u)
                d[0] = c * tx + s * bx + cosine * n[0]
                d[1] = c * ty + s * by + cosine * n[1]
                d[2] = c * tz + s * bz + cosine * n[2]
                along = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
                rest = 1.0 - (p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
                t = math.sqrt(max(0.0, along * along + rest)) + along
                for k in range(3):
                    from_x[k], from_d[k] = p[k] - t * d[k], d[k]
                xi, di = from_x, from_d
                if cosine == 0.0:
                    cosine = -1e-300

            # Reflection and refraction; one of the two goes on outside (out), the other inside (into)
            ratio = 1.0 / eta if inside else eta
            cos_i = min(abs(cosine), 1.0)
            reflectance, cos_t = fresnel(cos_i, ratio, polarisation if polarisation < 3 else 1 + coin(path, 5))
            total = reflectance >= 1.0
            if not total:
                reflectance = min(reflectance * reflectance_scale, 1.0)
            sign = 1.0 if cosine > 0.0 else -1.0
            for k in range(3):
                mirrored = d[k] - 2.0 * cosine * n[k]
                bent = d[k] if ratio == 1.0 else d[k] / ratio + sign * (cos_t - cos_i / ratio) * n[k]
                out[k], into[k] = (bent, mirrored) if inside else (mirrored, bent)
            mirrored_weight = weight if total else np.int64(math.floor(weight * reflectance + 0.5))
            out_weight = weight - mirrored_weight if inside else mirrored_weight
            key = mix(key + np.uint64(0x9E3779B97F4A7C15))
            lighter = min(out_weight, weight - out_weight)
            least = min(split, weight)
            outward = out[0] * n[0] + out[1] * n[1] + out[2] * n[2]
            free = outward > low or low == 0.0
            if 0 < lighter < least and not (free and weight > split and out_weight == lighter):
                kept = least if unit(key) * least < lighter else 0
                out_weight = kept if lighter == out_weight else weight - kept
            into_weight = weight - out_weight

            if out_weight > 0:
                if free:
                    leave(p, out, length, xi, di, out_weight, key, path, edges, way, ends,
                          scalars, theta, cells, box, box_l, records)  # fmt: skip
                else:
                    go_on(next_state[live], next_meta[live], origins[live], rays[live], p, out, n, length, xi, di,
                          out_weight, mix(key ^ np.uint64(0xA5A5A5A5A5A5A5A5)), facet, MET, hits, path, OFFSET)  # fmt: skip
                    live += 1
            if into_weight > 0:
                go_on(next_state[live], next_meta[live], origins[live], rays[live], p, into, n, length, xi, di,
                      into_weight, key, facet, MET | INSIDE, hits, path, -OFFSET)  # fmt: skip
                live += 1
    return live


@njit(cache=True)
def go_on(state, meta, origin, ray, p, d, n, length, xi, di, weight, key, facet, flags, hits, path, shift):  # type: ignore[no-untyped-def]
    """Write one ray that starts at point p of `facet` along d, moved by `shift` along the normal for the engine."""
    norm = 1.0 / math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    for k in range(3):
        state[PX + k], state[DX + k] = p[k], d[k] * norm
        state[XI + k], state[DI + k] = xi[k], di[k]
        origin[k], ray[k] = p[k] + shift * n[k], d[k] * norm
    state[LENGTH] = length
    meta[WEIGHT], meta[KEY], meta[FACET], meta[FLAGS], meta[HITS], meta[PATH] = weight, key, facet, flags, hits, path


@njit(cache=True, nogil=True)
def _rise(facets, faces, planes, centroids, radii, corner_sines, horizon):  # type: ignore[no-untyped-def]
    """Write into `horizon` a bound on the sine of the elevation of the grain over the `facets` listed."""
    for i in facets:
        top = 0.0
        nx, ny, nz, height = planes[i, 0], planes[i, 1], planes[i, 2], planes[i, 3]
        for j in range(faces.shape[0]):
            above = nx * centroids[j, 0] + ny * centroids[j, 1] + nz * centroids[j, 2] - height
            if above + radii[j] <= 1e-9 or j == i:
                continue
            facing = nx * planes[j, 0] + ny * planes[j, 1] + nz * planes[j, 2]
            tilt = math.sqrt(max(0.0, 1.0 - facing * facing))
            above += radii[j] * tilt
            if above <= 1e-9:
                continue
            shared, sharp = 0, 1.0
            for k in range(3):
                for m in range(3):
                    if faces[i, k] == faces[j, m]:
                        shared += 1
                        sharp = min(sharp, corner_sines[faces[i, k]])
            if shared == 2:  # across an edge: the neighbour's own slope
                rise = tilt if facing > 0.0 else 1.0
            elif shared == 1:  # around a corner, which may be seen from the side
                rise = tilt / sharp if facing > 0.0 else 1.0
            else:
                dx, dy = centroids[j, 0] - centroids[i, 0], centroids[j, 1] - centroids[i, 1]
                dz = centroids[j, 2] - centroids[i, 2]
                gap = math.sqrt(dx * dx + dy * dy + dz * dz) - radii[i] - radii[j]
                rise = above / gap if gap > above else 1.0
            top = max(top, rise)
            if top >= 1.0:
                break
        horizon[i] = min(top, 1.0)


def horizon_of(vertices: np.ndarray, faces: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return for each facet the sine of an elevation above which nothing of the grain stands, (facets,) float64.

    Light above the horizon of a facet reaches it unobstructed and leaves it for good, so it needs no ray. 0 where
    the whole grain lies behind the facet's plane (every facet of a convex grain); 1 where nothing is promised, as
    for all facets with something before them if there are so many that looking would take longer than tracing.
    """
    from scipy.spatial import ConvexHull

    hull = vertices[ConvexHull(vertices).vertices]
    horizon = np.ones(len(planes))
    for start in range(0, len(planes), 1024):
        part = planes[start : start + 1024]
        horizon[start : start + 1024][(part[:, :3] @ hull.T).max(axis=1) <= part[:, 3] + 1e-9] = 0.0
    obstructed = np.flatnonzero(horizon)
    if 0 < len(obstructed) * len(planes) <= 1e9:
        corners = vertices[faces]
        centroids = corners.mean(axis=1)
        radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
        sides = np.roll(corners, -1, axis=1) - corners
        sides /= np.linalg.norm(sides, axis=2)[:, :, None]
        sines = np.linalg.norm(np.cross(sides, np.roll(sides, 1, axis=1)), axis=2)
        corner_sines = np.ones(len(vertices))
        np.minimum.at(corner_sines, faces.ravel(), sines.ravel())
        _rise(obstructed, faces, planes, centroids, radii, np.maximum(corner_sines, 1e-9), horizon)
    return horizon


def in_order(first: int, last: int) -> np.ndarray:
    """Return the path numbers first .. last - 1 one replicate after the other, the order kindest to the cache."""
    numbers = np.arange(first, last)
    return numbers[np.argsort(numbers % T.REPLICATES, kind="stable")]


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
    split: float = SPLIT
    fan: int = FAN
    slots: int = SLOTS
    log: Any = None

    def __post_init__(self) -> None:
        self._sphere = self.grain.kind == "sphere"
        self._polarisation = {"un": UNPOLARISED, "sp": 3}[self.fresnel]
        if self._sphere:
            self._planes, self._centroids = np.zeros((1, 4)), np.zeros((1, 3))
            self._horizon = np.zeros(1)
        else:
            corners = self.grain.vertices[self.grain.faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.linalg.norm(normals, axis=1)[:, None]
            self._centroids = corners.mean(axis=1)
            height = np.einsum("ij,ij->i", normals, self._centroids)
            self._planes = np.ascontiguousarray(np.column_stack((normals, height)))
            self._horizon = horizon_of(self.grain.vertices, self.grain.faces, self._planes)
            self._scene = embree_scene(self.grain)
        self._capacity = 0
        self._reserve((1 + self.fan) * self.slots)

    def _reserve(self, capacity: int) -> None:
        if capacity <= self._capacity:
            return
        old = self._capacity
        grown = [np.empty((capacity, STATE)), np.empty((capacity, STATE))]
        notes = [np.empty((capacity, META), dtype=np.int64), np.empty((capacity, META), dtype=np.int64)]
        origins, rays = np.empty((capacity, 3), np.float32), np.empty((capacity, 3), np.float32)
        if old:
            for new, mine in zip(grown + notes, self._states + self._metas, strict=True):
                new[:old] = mine
            origins[:old], rays[:old] = self._origins, self._rays
        self._states, self._metas, self._origins, self._rays = grown, notes, origins, rays
        self._capacity = capacity

    def trace(self, paths: np.ndarray, tally: Tally, stop: Event | None = None) -> int:
        """Trace the paths of the numbers given, (n,) int64, into `tally`; return the number of rays that took.

        Once `stop` is set the counts are worthless.
        """
        counters = (tally.scalars, tally.theta, tally.cells, tally.box, tally.box_l, tally.records)
        fan = 1 if self.plain else self.fan
        split = np.int64(T.UNIT if self.plain else self.split * T.UNIT / fan)
        way, ends = np.empty(7), np.empty((3, 3))
        first, live, total, mine = 0, 0, 0, 0
        forever = np.zeros(self._capacity, dtype=np.int32)
        tally.scalars[:, T.LAUNCHED] += T.UNIT * np.bincount(paths % T.REPLICATES, minlength=T.REPLICATES)
        while (live or first < len(paths)) and not (stop is not None and stop.is_set()):
            if live < self.slots // 2 and first < len(paths):
                fresh = paths[first : first + self.slots - live]
                spawn(fresh, live, self.seed, self.plain, SOBOL,
                      self._states[mine], self._metas[mine], self._origins, self._rays)  # fmt: skip
                first, live = first + len(fresh), live + len(fresh)
            self._reserve((1 + self.fan) * live)
            if self._sphere:
                if len(forever) < live:
                    forever = np.zeros(self._capacity, dtype=np.int32)
                prims = forever[:live]
            else:
                prims = self._scene.run(self._origins[:live], self._rays[:live])
            if self.log is not None:
                self.log(self._origins[:live], self._rays[:live])
            total += live
            live = advance(
                live, prims, self._sphere, self._horizon, self.eta, self._polarisation, self.reflectance_scale,
                split, fan, self.max_bounces, self._planes, self._centroids, T.L_EDGES,
                self._states[mine], self._metas[mine], self._states[1 - mine], self._metas[1 - mine],
                self._origins, self._rays, way, ends, *counters,
            )  # fmt: skip
            mine = 1 - mine
        return total
