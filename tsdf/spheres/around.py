"""Spheres around each sphere of a packing: which of them light that leaves it meets first.

`packing.next_sphere` follows lines that begin anywhere, with the rounding of float64. Light that goes from sphere to
sphere mostly meets one of a few near ones, else one in a grid of wide cells. Here many are looked at together, as
vector instructions do, in float32, and the one that is met is then computed anew. Lengths are in R, as there.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.spheres.packing import Packing, _first_border, cells_of
from tsdf.vectors import KERNEL, dot, step

LANES = 16  # spheres looked at together, as vector instructions do
BLOCKS = 3  # of so many around each; more are seldom needed and fill the cache
FILLED = 11.0  # spheres that reach into a cell of the grid, in the mean: few cells need a second block
_PAD = 1e-3  # what float32 says is known to be nearer than
_FAR = np.float32(1e6)
ENDLESS = 1e4  # [R] lines along an axis may never meet a sphere
_LAST, _NONE = np.int32(LANES - 1), np.int32(2**31 - 1)


class Around(NamedTuple):
    """The spheres about each of n, nearest first. For kernels.

    spheres (n, BLOCKS, 4, LANES) float32: x, y, z of the centre relative to its own, and the bits of its code as in
    `Cells.entries`; start (n, BLOCKS) float32: the least distance of a block's spheres. Whatever light meets within
    `reach` is among them.

    Beyond, the cube of edge `side` has m^3 cells, numbered as in `Cells`, with the blocks first[number] ..
    first[number + 1] - 1 of `cells` (blocks, 4, LANES) float32: as `spheres`, centres relative to the cell's middle.
    centres (n, 3): of the packing.
    """

    reach: float
    spheres: np.ndarray
    start: np.ndarray
    side: float
    m: int
    first: np.ndarray
    cells: np.ndarray
    centres: np.ndarray


def around_of(packing: Packing | None) -> Around:
    """Return the spheres around each of a packing, nothing for None."""
    if packing is None:
        none = np.zeros((0, 4, LANES), np.float32)
        return Around(0.0, none[:, None], none[:, 0], 1.0, 1, np.zeros(2, np.int32), none, np.zeros((0, 3)))
    from scipy.spatial import cKDTree

    side, centres, count = packing.side, packing.centres, len(packing.centres)
    far = min((1.5 * BLOCKS * LANES / packing.fraction) ** (1.0 / 3.0), 0.499 * side)
    pairs = cKDTree(centres, boxsize=side).query_pairs(far, output_type="ndarray")
    one, other = np.concatenate((pairs, pairs[:, ::-1])).T
    tile = -np.rint((centres[other] - centres[one]) / side).astype(np.int64)
    relative = centres[other] + side * tile - centres[one]
    distance = np.linalg.norm(relative, axis=1)
    order = np.lexsort((other, distance, one))
    one, other, tile, relative, distance = (v[order] for v in (one, other, tile, relative, distance))
    place = np.arange(len(one)) - np.searchsorted(one, np.arange(count))[one]
    left_out = place >= BLOCKS * LANES
    if left_out.any():
        far = distance[left_out].min()
        one, other, tile, relative, distance, place = (
            v[~left_out] for v in (one, other, tile, relative, distance, place)
        )
    block, lane = np.divmod(place, LANES)
    spheres, start = np.full((count, BLOCKS, 4, LANES), _FAR), np.full((count, BLOCKS), _FAR)
    spheres[one, block, :3, lane] = relative
    spheres[one, block, 3, lane] = (other * 64 + (tile + 1) @ (16, 4, 1)).astype(np.int32).view(np.float32)
    start[one[lane == 0], block[lane == 0]] = distance[lane == 0] - 2.0
    reach = float(far) - 2.0 - _PAD
    return Around(reach, spheres, start, side, *_wide(packing), np.ascontiguousarray(centres))


def _wide(packing: Packing) -> tuple[int, np.ndarray, np.ndarray]:
    """Return number of cells along an edge, first block and blocks of the grid: see `Around`."""
    density = packing.fraction * 3.0 / (4.0 * math.pi)
    widths = np.linspace(0.5, 20.0, 400)  # the volume within 1 of a cube, by Steiner's formula
    volume = widths**3 + 6.0 * widths**2 + 3.0 * math.pi * widths + 4.0 * math.pi / 3.0
    grid = cells_of(packing, float(widths[min(int(np.searchsorted(volume * density, FILLED)), len(widths) - 1)]))
    m, edge, count = grid.m, packing.side / grid.m, np.diff(grid.first)
    blocks = -(-count // LANES)
    first = np.concatenate(([0], np.cumsum(blocks)))
    cell = np.repeat(np.arange(m**3), count)
    place = np.arange(len(cell)) - grid.first[cell]
    middle = (np.stack(np.unravel_index(cell, (m, m, m)), axis=1) + 0.5) * edge
    code = grid.entries
    tile = np.stack((code >> 4 & 3, code >> 2 & 3, code & 3), axis=1) - 1
    cells = np.full((first[-1], 4, LANES), _FAR)
    block, lane = first[cell] + place // LANES, place % LANES
    cells[block, :3, lane] = packing.centres[code >> 6] + packing.side * tile - middle
    cells[block, 3, lane] = code.view(np.float32)
    return m, first.astype(np.int32), cells


@njit(forceinline=True, **KERNEL)
def met(block, p, d, least):
    """Return the bits of about how far it is along d from p to the sphere of a block (4, LANES) that is entered first,
    at `least` or beyond, the last few bits its lane; _NONE if there is none."""
    px, py, pz = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    dx, dy, dz = np.float32(d[0]), np.float32(d[1]), np.float32(d[2])
    one, none, low, here = np.float32(1.0), np.float32(0.0), np.float32(least), _NONE
    for lane in range(LANES):
        x, y, z = block[0, lane] - px, block[1, lane] - py, block[2, lane] - pz
        along = x * dx + y * dy + z * dz
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        left = one - (x * x + y * y + z * z)
        t = along - np.sqrt(left)
        # The bits of positive floats are in the order of the floats; the last few make room for the lane
        bits = (np.float32(max(t, none)).view(np.int32) & ~_LAST) | np.int32(lane)
        here = min(here, bits if (left > none) & (t >= low) else _NONE)
    return here


@njit(forceinline=True, **KERNEL)
def nearest(around, sphere, n, d):
    """Return block and lane, as one number, of the sphere that light meets first which leaves a sphere along d where
    the normal is n, and about how far that is; -1 if what it meets is farther than those around it reach."""
    first, found, best = _NONE, -1, _FAR
    for b in range(BLOCKS):
        if around.start[sphere, b] >= best:
            break
        here = met(around.spheres[sphere, b], n, d, 0.0)
        if here < first:
            first, found = here, b * LANES + (here & _LAST)
            best = np.int32(here).view(np.float32)
    return (found if best <= around.reach else -1), float(best)


@njit(**KERNEL)
def across(around, p, d, start, most):
    """Return the sphere that light meets first along d from p, anywhere, in wide cells; its number and tile, -1 and
    zeros if there is none from the distance `start` to `most`, or `ENDLESS` beyond `start`; to about 1e-6 R, as float32
    is."""
    side, m = around.side, around.m
    edge, per_edge = side / m, m / side
    px, py, pz = p
    dx, dy, dz = d
    end = min(most, start + ENDLESS)
    gx, gy, gz = (
        math.floor((px + start * dx) * per_edge),
        math.floor((py + start * dy) * per_edge),
        math.floor((pz + start * dz) * per_edge),
    )
    tx, ex = _first_border(px, dx, gx, edge)
    ty, ey = _first_border(py, dy, gy, edge)
    tz, ez = _first_border(pz, dz, gz, edge)
    t, least = start, 0.0
    while t <= end:
        i, j, k = gx // m, gy // m, gz // m
        cell = ((gx - i * m) * m + gy - j * m) * m + gz - k * m
        p = (
            px + t * dx - (gx + 0.5) * edge,
            py + t * dy - (gy + 0.5) * edge,
            pz + t * dz - (gz + 0.5) * edge,
        )
        best, block = _NONE, -1
        for b in range(around.first[cell], around.first[cell + 1]):
            here = met(around.cells[b], p, d, least)
            if here < best:
                best, block = here, b
        after = min(tx, ty, tz)
        if block >= 0 and t + float(np.int32(best).view(np.float32)) <= after + _PAD:
            code = np.float32(around.cells[block, 3, best & _LAST]).view(np.int32)
            return code >> 6, i + ((code >> 4) & 3) - 1, j + ((code >> 2) & 3) - 1, k + (code & 3) - 1
        t, least = after, -_PAD
        if tx <= t:
            tx, gx = tx + ex, gx + (1 if dx > 0.0 else -1)
        elif ty <= t:
            ty, gy = ty + ey, gy + (1 if dy > 0.0 else -1)
        else:
            tz, gz = tz + ez, gz + (1 if dz > 0.0 else -1)
    return -1, 0, 0, 0


@njit(**KERNEL)
def ahead(around, sphere, n, d, most):
    """Return the sphere that light meets first beyond `reach`, and not farther than `most`, as `nearest` goes on: its
    number and tile relative to that of the sphere that is left, -1 and zeros if there is none."""
    c = around.centres
    p = (c[sphere, 0] + n[0], c[sphere, 1] + n[1], c[sphere, 2] + n[2])
    return across(around, p, d, around.reach, most)


@njit(forceinline=True, **KERNEL)
def entered(v, d):
    """Return how far it is along d to the unit sphere about v, as seen from where light starts, that it meets, and the
    outward normal there."""
    along = dot(v, d)
    t = step((-v[0], -v[1], -v[2]), along, d)
    depth = math.sqrt(max(0.0, 1.0 - dot(t, t)))
    return along - depth, step(t, -depth, d)


@njit(forceinline=True, **KERNEL)
def next_around(around, sphere, n, d, most):
    """Return the sphere that light meets first which leaves a sphere along d where the normal is n, if that is not
    farther than `most`: its number, -1 for none, its tile relative to that one's, the distance, the normal there."""
    found, s = nearest(around, sphere, n, d)
    side, c = around.side, around.centres
    if found >= 0:
        block, lane = around.spheres[sphere, found // LANES], found % LANES
        v = (float(block[0, lane]) - n[0], float(block[1, lane]) - n[1], float(block[2, lane]) - n[2])
        code = np.float32(block[3, lane]).view(np.int32)
        other, i, j, k = code >> 6, ((code >> 4) & 3) - 1, ((code >> 2) & 3) - 1, (code & 3) - 1
    else:
        other, i, j, k = ahead(around, sphere, n, d, most)
        if other < 0:
            return -1, 0, 0, 0, 0.0, n
        v = (
            c[other, 0] - c[sphere, 0] + i * side - n[0],
            c[other, 1] - c[sphere, 1] + j * side - n[1],
            c[other, 2] - c[sphere, 2] + k * side - n[2],
        )
    s, normal = entered(v, d)
    if s > most:
        return -1, 0, 0, 0, 0.0, n
    return other, i, j, k, s, normal
