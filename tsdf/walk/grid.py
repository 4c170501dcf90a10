"""Facets by the cells of a grid: how far the nearest is, which lie in a cell, and what a ray meets on its way.

Where nothing is near, a ray goes as far as it is free at once; near facets it goes from cell to cell and looks at those
that are listed there. Whether it passes within one is told by where its corners are, seen along the ray in float64,
which facets see alike at the edges and corners that they share: none slips through between them. Distances are those of
the facets' planes.
A ray that would need many steps, or that leaves the grid where much is outside it, is left to the ray engine.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import KERNEL, dot

STEPS = 64  # of a ray through the grid; the ray engine is faster with those that need more
OUTSIDE = 16  # facets that reach out of the grid, with more of which rays that leave it are left to the ray engine
MOST_LISTED = 2e7  # facets in all cells, about: cells of very many large facets are larger
BATCH = 1 << 17  # triangles and boxes that are looked at together
PAD = 0.004  # [cells] facets count as in a cell when this near to it, far more than the rounding of the way through
GRAZING = 100.0  # times its thickness is the most that a point is moved off a facet along a ray
NONE = -1


class Grid(NamedTuple):
    """What kernels ask about a grid of cells (x, y, z) over meshes' facets (f,).

    low (3,), edge: its corner and the edge of a cell; free (x, y, z) float32: distances of the cells' middles to the
    nearest facet, at most; first (x y z + 1,) int32, listed: the facets in each cell, one cell after the other; outer:
    the facets that reach out of the grid, if there are no more than OUTSIDE; closed: rays that leave the grid meet
    nothing else; beyond: distances outside it are at least those to the grid. corners (f, 3, 3); planes (f, 4): normal
    and height over the origin; mesh (f,) int32: the number of the facet's mesh; thickness (f,): how near to it counts
    as on it; margin: how far behind each other rays may meet facets, wholly inside the grid, that are at one place.
    """

    low: np.ndarray
    edge: float
    free: np.ndarray
    first: np.ndarray
    listed: np.ndarray
    outer: np.ndarray
    closed: bool
    beyond: bool
    corners: np.ndarray
    planes: np.ndarray
    mesh: np.ndarray
    thickness: np.ndarray
    margin: float


# ------------------------------------------------------------------------------------------- for kernels


@njit(**KERNEL)
def plane_hit(planes, facet, p, d):
    """Return distance along d from p to a facet's plane, and the cosine of d to its normal."""
    n = (planes[facet, 0], planes[facet, 1], planes[facet, 2])
    cosine = dot(n, d)
    if cosine == 0.0:
        return math.inf, 0.0
    return (planes[facet, 3] - dot(n, p)) / cosine, cosine


@njit(forceinline=True, **KERNEL)
def turns(a, b):
    """Return on which side of the edge from a to b, pairs of coordinates, the origin is; the opposite for the edge from
    b to a, even where it is on it."""
    area = a[0] * b[1] - a[1] * b[0]
    if area != 0.0:
        return area > 0.0
    return a[0] < b[0] if a[0] != b[0] else a[1] < b[1]


@njit(forceinline=True, **KERNEL)
def line_of(p, d):
    """Return the line through p along d as `passes` takes it: the numbers of two axes and of that along which it runs
    most, p in that order, and how far it goes along the two for each unit along the third."""
    if abs(d[0]) > max(abs(d[1]), abs(d[2])):
        return (1, 2, 0), (p[1], p[2], p[0]), d[1] / d[0], d[2] / d[0]
    if abs(d[1]) > abs(d[2]):
        return (2, 0, 1), (p[2], p[0], p[1]), d[2] / d[1], d[0] / d[1]
    return (0, 1, 2), p, d[0] / d[2], d[1] / d[2]


@njit(**KERNEL)
def passes(corners, facet, line):
    """Return whether a line passes within a facet: whether its corners, seen along it, turn around it all one way
    (Woop et al. 2013)."""
    (i, j, k), (x, y, z), u, v = line
    far = corners[facet, 0, k] - z
    a = (corners[facet, 0, i] - x - u * far, corners[facet, 0, j] - y - v * far)
    far = corners[facet, 1, k] - z
    b = (corners[facet, 1, i] - x - u * far, corners[facet, 1, j] - y - v * far)
    side = turns(a, b)
    far = corners[facet, 2, k] - z
    c = (corners[facet, 2, i] - x - u * far, corners[facet, 2, j] - y - v * far)
    return turns(b, c) == side and turns(c, a) == side


@njit(forceinline=True, **KERNEL)
def inverse(x):
    """Return 1 / x, a large number for 0."""
    return 1.0 / x if abs(x) > 1e-300 else 1e300


@njit(**KERNEL)
def free_around(grid, p):
    """Return a length within which no facet is around p."""
    nx, ny, nz = grid.free.shape
    if nx == 0:
        return math.inf if grid.beyond else 0.0
    h = grid.edge
    by = 1.0 / h
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    if 0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz:
        i, j, k = int(x), int(y), int(z)
        x, y, z = x - i - 0.5, y - j - 0.5, z - k - 0.5
        bound = grid.free[i, j, k] - h * math.sqrt(x * x + y * y + z * z)
        wall = h * (0.5 - max(max(abs(x), abs(y)), abs(z)))
        if bound < wall:
            # Nearer than the walls of the cell there are only its own, none nearer than its plane
            cell = (i * ny + j) * nz + k
            for at in range(grid.first[cell], grid.first[cell + 1]):
                f = grid.listed[at]
                n = (grid.planes[f, 0], grid.planes[f, 1], grid.planes[f, 2])
                wall = min(wall, abs(dot(n, p) - grid.planes[f, 3]))
            bound = max(bound, wall)
        return bound
    if not grid.beyond:
        return 0.0
    x, y, z = max(-x, x - nx, 0.0), max(-y, y - ny, 0.0), max(-z, z - nz, 0.0)
    return h * math.sqrt(x * x + y * y + z * z)


@njit(forceinline=True, **KERNEL)
def compared(grid, met, facet, p, d, line, end):
    """Note a facet that a ray, of that line, meets before `end` in `met` (meshes,), if it is the first of its mesh so
    far; return the distance, or infinity."""
    n = (grid.planes[facet, 0], grid.planes[facet, 1], grid.planes[facet, 2])
    cosine, height = dot(n, d), grid.planes[facet, 3] - dot(n, p)
    if not (height * cosine >= 0.0 and abs(height) <= end * abs(cosine)):
        return math.inf
    t = height / cosine  # most facets are left out without the division
    if not (0.0 <= t < end) or not passes(grid.corners, facet, line):
        return math.inf
    before = met[grid.mesh[facet]]
    if before == NONE or t < plane_hit(grid.planes, before, p, d)[0]:
        met[grid.mesh[facet]] = facet
    return t


@njit(**KERNEL)
def march(grid, met, p, d, end):
    """Note in `met` (meshes,) the first facets that a ray meets, NONE where there is none; return whether it is known.

    What is met farther than `end`, or behind what is at the place of the first facet, may be missing.
    """
    for e in range(met.shape[0]):
        met[e] = NONE
    line = line_of(p, d)
    for at in range(grid.outer.shape[0]):
        facet = grid.outer[at]
        end = min(end, compared(grid, met, facet, p, d, line, end + GRAZING * grid.thickness[facet]))
    end += grid.margin
    nx, ny, nz = grid.free.shape
    h = grid.edge
    by = 1.0 / h
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    dx, dy, dz = d[0] * by, d[1] * by, d[2] * by
    if 0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz:
        i, j, k = int(x), int(y), int(z)
        if 0.0 <= x + end * dx - i < 1.0 and 0.0 <= y + end * dy - j < 1.0 and 0.0 <= z + end * dz - k < 1.0:
            # Short ways mostly end in the cell in which they begin
            cell = (i * ny + j) * nz + k
            for at in range(grid.first[cell], grid.first[cell + 1]):
                end = min(end, compared(grid, met, grid.listed[at], p, d, line, end) + grid.margin)
            return True
    # The ray enters the grid at t and leaves it at `last`
    t, last = 0.0, math.inf
    ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
    a, b = -x * ix, (nx - x) * ix
    t, last = max(t, min(a, b)), min(last, max(a, b))
    a, b = -y * iy, (ny - y) * iy
    t, last = max(t, min(a, b)), min(last, max(a, b))
    a, b = -z * iz, (nz - z) * iz
    t, last = max(t, min(a, b)), min(last, max(a, b))
    if not grid.closed and (nx == 0 or t > 0.0 or last < end):
        return False
    for _ in range(STEPS):
        if not t <= min(last, end):
            return True
        ux, uy, uz = x + t * dx, y + t * dy, z + t * dz
        i, j, k = min(max(int(ux), 0), nx - 1), min(max(int(uy), 0), ny - 1), min(max(int(uz), 0), nz - 1)
        cell = (i * ny + j) * nz + k
        here, there = grid.first[cell], grid.first[cell + 1]
        if here == there:
            ux, uy, uz = ux - i - 0.5, uy - j - 0.5, uz - k - 0.5
            free = grid.free[i, j, k] - h * math.sqrt(ux * ux + uy * uy + uz * uz)
            if free > h:
                t += free
                continue
        for at in range(here, there):
            end = min(end, compared(grid, met, grid.listed[at], p, d, line, end) + grid.margin)
        a = (i + (1.0 if dx >= 0.0 else 0.0) - x) * ix
        b = (j + (1.0 if dy >= 0.0 else 0.0) - y) * iy
        c = (k + (1.0 if dz >= 0.0 else 0.0) - z) * iz
        t = max(t, min(a, min(b, c))) + 1e-6 * h
    return False


# --------------------------------------------------------------------------------------------- from meshes


def grid_of(meshes: Sequence[np.ndarray], planes: np.ndarray, thickness: np.ndarray,
            box: tuple[np.ndarray, np.ndarray], cells: int, least: float, beyond: bool) -> Grid:  # fmt: skip
    """Return the grid over a box.

    Parameters
    ----------
    meshes : sequence of (f, 3, 3) float64
        Corners of the facets of each mesh.
    planes : (all f, 4) float64
        Unit normal, and height over the origin, of each facet.
    thickness : (all f,) float64
        How near to it counts as on it.
    box : two (3,) arrays
        Its low and high corner.
    cells : int
        About how many; none makes no grid, and leaves all to the ray engine.
    least : float
        The edge of a cell, at least.
    beyond : bool
        The box holds all facets.
    """
    corners = np.concatenate([np.zeros((0, 3, 3)), *meshes])
    mesh = np.repeat(np.arange(len(meshes)), [len(each) for each in meshes]).astype(np.int32)
    low, high = box
    if not len(corners) or not cells:
        nothing = np.zeros(0, np.int32)
        return Grid(np.zeros(3), 1.0, np.zeros((0, 0, 0), np.float32), np.zeros(1, np.int32), nothing, nothing,
                    not len(corners), not len(corners), corners, planes, mesh, thickness, 0.0)  # fmt: skip
    size = np.maximum(high - low, 1e-3 * (high - low).max())
    sides = np.sort(np.clip(corners.max(axis=1), low, high) - np.clip(corners.min(axis=1), low, high), axis=1)
    area = float((sides[:, 1] * sides[:, 2]).sum())  # of the facets in the box, at most twice as much
    edge = max(float((size.prod() / cells) ** (1 / 3)), math.sqrt(area / MOST_LISTED), least)
    counts = np.ceil(size / edge).astype(int) + 2
    low = 0.5 * (low + high) - 0.5 * counts * edge
    free, first, listed = cells_of(corners, planes, low, edge, counts)
    outer = ((corners < low + edge) | (corners > low + (counts - 1) * edge)).any(axis=(1, 2))
    margin = 2.0 * GRAZING * float(thickness[~outer].max(initial=0.0))
    few = int(outer.sum()) <= OUTSIDE
    return Grid(low, edge, free, first, listed, outer.nonzero()[0].astype(np.int32)[: OUTSIDE * few], few, beyond,
                corners, planes, mesh, thickness, margin)  # fmt: skip


def meets(corners: np.ndarray, planes: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return (n,) bool whether triangles (n, 3, 3), with their planes (n, 4), meet boxes of corners low, high (n, 3).

    Plane and box, then edges and box seen along each axis (Schwarz & Seidel 2010, section 3.1); boxes that only the
    triangle's own bounds miss are to be left out beforehand.
    """
    normal, size = planes[:, :3], high - low
    height = np.einsum("ij,ij->i", normal, 0.5 * (low + high)) - planes[:, 3]
    met: np.ndarray = np.abs(height) <= 0.5 * np.einsum("ij,ij->i", np.abs(normal), size)
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        sign = np.where(normal[:, c] < 0.0, -1.0, 1.0)
        for i in range(3):
            one, other = corners[:, i], corners[:, (i + 1) % 3]
            across = sign * (one[:, b] - other[:, b])
            along = sign * (other[:, a] - one[:, a])
            inner = across * (np.where(across > 0.0, high[:, a], low[:, a]) - one[:, a])
            inner += along * (np.where(along > 0.0, high[:, b], low[:, b]) - one[:, b])
            met &= inner >= 0.0
    return met


def _batches(*arrays: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return arrays of one length in pieces of BATCH rows."""
    return [tuple(array[i : i + BATCH] for array in arrays) for i in range(0, len(arrays[0]), BATCH)]


def cells_of(
    corners: np.ndarray, planes: np.ndarray, low: np.ndarray, edge: float, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float32 lower bounds of the distances of the cells' middles of a grid to the triangles that reach into it,
    short by less than two cells' diagonals, and the triangles in each cell, as `Grid` has them.

    Parameters
    ----------
    corners : (m, 3, 3) float64
        Of the triangles.
    planes : (m, 4) float64
        Unit normal, and height over the origin, of each.
    low : (3,) float64
        Corner of the grid.
    edge : float
        Of its cells.
    counts : (3,) int
        How many along each axis.
    """
    from scipy.ndimage import distance_transform_edt

    found = [np.zeros(0, np.int64)]
    at = np.clip((corners - low) / edge, -2.0, counts + 2.0)
    begin, end = (np.floor(at + sign * PAD).astype(int) for sign in (-1, 1))
    begin, end = np.maximum(begin.min(axis=1), 0), np.minimum(end.max(axis=1) + 1, counts)
    number = np.flatnonzero((begin < end).all(axis=1))
    waiting = _batches(number, begin[number], end[number])
    while waiting:
        number, begin, end = waiting.pop()
        met = meets(corners[number], planes[number], low + edge * (begin - PAD), low + edge * (end + PAD))
        number, begin, end = number[met], begin[met], end[met]
        size = end - begin
        single = (size == 1).all(axis=1)
        found.append(np.ravel_multi_index(tuple(begin[single].T), tuple(counts)) << 32 | number[single])
        number, begin, end, axis = number[~single], begin[~single], end[~single], size[~single].argmax(axis=1)
        row, upper, lower = np.arange(len(number)), begin.copy(), end.copy()
        upper[row, axis] = lower[row, axis] = (begin[row, axis] + end[row, axis]) // 2
        halves = np.tile(number, 2), np.concatenate((begin, upper)), np.concatenate((lower, end))
        waiting += _batches(*halves)
    both = np.sort(np.concatenate(found))
    cell, listed = both >> 32, (both & 0xFFFFFFFF).astype(np.int32)
    first = np.zeros(int(counts.prod()) + 1, np.int32)
    first[1:] = np.cumsum(np.bincount(cell, minlength=len(first) - 1))
    empty = (first[1:] == first[:-1]).reshape(tuple(counts))
    if not len(listed):
        return np.full(tuple(counts), edge * math.hypot(*counts), np.float32), first, listed
    bounds = distance_transform_edt(empty, sampling=edge) - math.sqrt(0.75) * edge
    return np.maximum(bounds, 0.0).astype(np.float32), first, listed
