"""Counting: light that left a grain into the cells and reservoirs of a tally.

Light is counted as it is and walked backwards, which is as likely. It is measured a block at a time, in straight loops
over columns, which become vector instructions.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.make import tally as T
from tsdf.sampling import mix, unit
from tsdf.vectors import KERNEL, cross, dot, minus, step

LIGHT = T.UNIT // 16  # light that weighs less is counted one way, as it is or walked backwards, with the weight of both
NO_OFFSET = 1e-9  # light that leaves this near to where it came in leaves there [R]
ATOM = 1e-5  # deflections closer than this to 0 or pi are exact for float32 geometry [rad]
BLOCK = 128  # light that leaves counted together: small enough for the first-level cache
# Rows of `Departed.found`; r, z, phi_delta follow in those from FORTH and BACK
COS_THETA, THETA, FORTH, BACK = 0, 1, 2, 5
BOX_PHI, BOX_R, BOX_Z, BOX_L = (T.BOX[name] for name in ("phi", "r", "z", "l"))


class Departed(NamedTuple):
    """Light that left and is still to be counted, in columns.

    left (13, n): where it starts for the rim, its direction, where the light entered, its direction, the length inside;
    notes (3, n) int64: weight, path, key; found (8, n): see `deflections`.
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
def deflections(count, left, found):
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
    deflections(count, left, found)
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
