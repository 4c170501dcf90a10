"""Spheres around each sphere of a packing: which of them light that leaves it meets first.

`packing.next_sphere` follows lines that begin anywhere through a grid. Light that goes from sphere to sphere mostly
meets one of a few near ones; to look at these, many at once, takes a third of the time. Lengths are in R, as there.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.spheres.packing import Packing
from tsdf.vectors import KERNEL, dot, step

LANES = 16  # spheres looked at together, as vector instructions do
BLOCKS = 3  # of so many around each; more are seldom needed and fill the cache
_PAD = 1e-3  # what float32 says is known to be nearer than
_FAR = np.float32(1e6)
_LAST, _NONE = np.int32(LANES - 1), np.int32(2**31 - 1)


class Around(NamedTuple):
    """The spheres about each of n, nearest first. For kernels.

    spheres (n, BLOCKS, 4, LANES) float32: x, y, z of the centre relative to its own, and the bits of its code as in
    `Cells.entries`; start (n, BLOCKS) float32: the least distance of a block's spheres. Whatever light meets within
    `reach` is among them.
    """

    reach: float
    spheres: np.ndarray
    start: np.ndarray


def around_of(packing: Packing | None) -> Around:
    """Return the spheres around each of a packing, nothing for None."""
    if packing is None:
        return Around(0.0, np.zeros((0, BLOCKS, 4, LANES), np.float32), np.zeros((0, BLOCKS), np.float32))
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
    return Around(float(far) - 2.0 - _PAD, spheres, start)


@njit(forceinline=True, **KERNEL)
def nearest(around, sphere, n, d):
    """Return block and lane, as one number, of the sphere that light meets first which leaves a sphere along d where
    the normal is n, and about how far that is; -1 if what it meets is farther than those around it reach."""
    nx, ny, nz = np.float32(n[0]), np.float32(n[1]), np.float32(n[2])
    dx, dy, dz = np.float32(d[0]), np.float32(d[1]), np.float32(d[2])
    one, none = np.float32(1.0), np.float32(0.0)
    first, found, best = _NONE, -1, _FAR
    for b in range(BLOCKS):
        if around.start[sphere, b] >= best:
            break
        here = _NONE
        for lane in range(LANES):
            x = around.spheres[sphere, b, 0, lane] - nx
            y = around.spheres[sphere, b, 1, lane] - ny
            z = around.spheres[sphere, b, 2, lane] - nz
            along = x * dx + y * dy + z * dz
            x, y, z = x - along * dx, y - along * dy, z - along * dz
            left = one - (x * x + y * y + z * z)
            t = along - np.sqrt(left)
            # The bits of positive floats are in the order of the floats; the last few make room for the lane
            bits = (np.float32(t).view(np.int32) & ~_LAST) | np.int32(lane)
            here = min(here, bits if (left > none) & (t >= none) else _NONE)
        if here < first:
            first, found = here, b * LANES + (here & _LAST)
            best = np.int32(here).view(np.float32)
    return (found if best <= around.reach else -1), float(best)


@njit(forceinline=True, **KERNEL)
def entry_of(around, sphere, found, n, d):
    """Return how the sphere that `nearest` found is entered: the distance, the outward normal there, its code."""
    b, lane = found // LANES, found % LANES
    at = around.spheres[sphere, b]
    v = (float(at[0, lane]) - n[0], float(at[1, lane]) - n[1], float(at[2, lane]) - n[2])
    along = dot(v, d)
    t = step((-v[0], -v[1], -v[2]), along, d)
    depth = math.sqrt(max(0.0, 1.0 - dot(t, t)))
    return along - depth, step(t, -depth, d), np.float32(at[3, lane]).view(np.int32)
