"""Lots: cells of a grid that either have blocks of things to be looked at together, or know how far such a cell is.

A ray goes through them with `onward`: where there is something, from cell to cell, else over all that is empty at once.
`standing` keeps spheres in them, `facets` triangles.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import KERNEL

BITS = 8  # bits of a lot that say how many blocks a cell has
MOST_BLOCKS, MOST_ALL = 2**BITS - 1, 2 ** (31 - BITS)
PARALLEL = 1e-12  # component of a direction below which it never comes out of its cells' padding


class Lots(NamedTuple):
    """Cells (i n_y + j) n_z + k. For kernels.

    low (3,) float64: lowest corner; per_edge: cells per length; counts (3,) int64; lot (cells,) int32: of a cell that
    has blocks, the first of them times 2^BITS and how many, else minus the number of cells to the next that has any,
    in the maximum norm.
    """

    low: np.ndarray
    per_edge: float
    counts: np.ndarray
    lot: np.ndarray


# ------------------------------------------------------------------------------------------- for kernels


@njit(forceinline=True, **KERNEL)
def scaled(lots, p, d):
    """Return a ray in units of cells, and one over its direction, which is not a number where it is parallel: no
    comparison is true of that."""
    s = lots.per_edge
    q = ((p[0] - lots.low[0]) * s, (p[1] - lots.low[1]) * s, (p[2] - lots.low[2]) * s)
    d = (d[0] * s, d[1] * s, d[2] * s)
    each = (
        1.0 / d[0] if abs(d[0]) > PARALLEL * s else math.nan,
        1.0 / d[1] if abs(d[1]) > PARALLEL * s else math.nan,
        1.0 / d[2] if abs(d[2]) > PARALLEL * s else math.nan,
    )
    return q, d, each


@njit(forceinline=True, **KERNEL)
def _clipped(q, each, count, start, end):
    """Return the part of a ray, from start to end, on which one coordinate is within the cells."""
    if each != each:
        return (start, end) if 0.0 <= q < count else (math.inf, end)
    a, b = -q * each, (count - q) * each
    return max(start, min(a, b)), min(end, max(a, b))


@njit(forceinline=True, **KERNEL)
def arrival(lots, q, each, start):
    """Return where a ray is in the cells first, at `start` or beyond; infinity if nowhere."""
    end = math.inf
    start, end = _clipped(q[0], each[0], lots.counts[0], start, end)
    start, end = _clipped(q[1], each[1], lots.counts[1], start, end)
    start, end = _clipped(q[2], each[2], lots.counts[2], start, end)
    return start if start <= end else math.inf


@njit(forceinline=True, **KERNEL)
def cell_at(lots, q, d, t):
    """Return the cell in which a ray is at t, that of the grid next to it."""
    return (
        min(max(math.floor(q[0] + t * d[0]), 0), lots.counts[0] - 1),
        min(max(math.floor(q[1] + t * d[1]), 0), lots.counts[1] - 1),
        min(max(math.floor(q[2] + t * d[2]), 0), lots.counts[2] - 1),
    )


@njit(forceinline=True, **KERNEL)
def onward(q, d, each, g, wide):
    """Return where a ray leaves the cells nearer than `wide` to cell g, which it is in, and for which cell."""
    after, axis = math.inf, 0
    t = (g[0] + (wide if d[0] > 0.0 else 1 - wide) - q[0]) * each[0]
    if t < after:
        after = t
    t = (g[1] + (wide if d[1] > 0.0 else 1 - wide) - q[1]) * each[1]
    if t < after:
        after, axis = t, 1
    t = (g[2] + (wide if d[2] > 0.0 else 1 - wide) - q[2]) * each[2]
    if t < after:
        after, axis = t, 2
    i, j, k = g
    if wide > 1:
        i = min(max(math.floor(q[0] + after * d[0]), i - wide + 1), i + wide - 1)
        j = min(max(math.floor(q[1] + after * d[1]), j - wide + 1), j + wide - 1)
        k = min(max(math.floor(q[2] + after * d[2]), k - wide + 1), k + wide - 1)
    if axis == 0:
        i = g[0] + (wide if d[0] > 0.0 else -wide)
    elif axis == 1:
        j = g[1] + (wide if d[1] > 0.0 else -wide)
    else:
        k = g[2] + (wide if d[2] > 0.0 else -wide)
    return after, (i, j, k)


@njit(forceinline=True, **KERNEL)
def outside(lots, g):
    """Return whether there is no such cell."""
    return not (0 <= g[0] < lots.counts[0] and 0 <= g[1] < lots.counts[1] and 0 <= g[2] < lots.counts[2])


# ------------------------------------------------------------------------------------------------ making


@njit(cache=True)
def _filled(ends, counts, first, listed):
    """Count the boxes that reach into each cell, from cell ends[:, 0] to the one before ends[:, 1] (n, 2, 3), in
    first[1:], or with room for them write them to `listed`."""
    at = first[:-1].copy()
    for one in range(len(ends)):
        for i in range(ends[one, 0, 0], ends[one, 1, 0]):
            for j in range(ends[one, 0, 1], ends[one, 1, 1]):
                for k in range(ends[one, 0, 2], ends[one, 1, 2]):
                    cell = (i * counts[1] + j) * counts[2] + k
                    if len(listed):
                        listed[at[cell]] = one
                        at[cell] += 1
                    else:
                        first[cell + 1] += 1


def listed(
    lows: np.ndarray, highs: np.ndarray, low: np.ndarray, edge: float, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a cell and a box of each pair of these that meet, by cells: boxes have corners (n, 3), the grid begins at
    `low` and has cells of an edge, `counts` (3,) of them."""
    ends = np.stack((np.floor((lows - low) / edge), np.floor((highs - low) / edge) + 1.0), axis=1)
    ends = np.clip(ends, 0, counts).astype(np.int64)
    first = np.zeros(int(counts.prod()) + 1, np.int64)
    _filled(ends, counts, first, np.zeros(0, np.int64))
    number, first = first[1:].copy(), np.cumsum(first)
    found = np.zeros(int(first[-1]), np.int64)
    _filled(ends, counts, first, found)
    return np.repeat(np.arange(len(number)), number), found


def lots_of(low: np.ndarray, per_edge: float, counts: np.ndarray, blocks: np.ndarray) -> Lots:
    """Return the cells of a grid that have so many blocks (cells,) each, MOST_BLOCKS at most, one after the other."""
    from scipy.ndimage import distance_transform_cdt

    far = distance_transform_cdt((blocks == 0).reshape(counts), metric="chessboard").reshape(-1)
    assert blocks.max() <= MOST_BLOCKS
    first = np.cumsum(blocks) - blocks
    if not (blocks > 0).any():  # then it is nowhere
        far = np.full(len(blocks), int(counts.max()))
    lot = np.where(blocks > 0, first << BITS | blocks, -far)
    return Lots(np.ascontiguousarray(low), float(per_edge), counts.astype(np.int64), lot.astype(np.int32))
