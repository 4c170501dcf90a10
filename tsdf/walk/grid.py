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
from tsdf.handle import Handle
from tsdf.vectors import KERNEL, dot

STEPS = 64  # of a ray through the grid; the ray engine is faster with those that need more
OUTSIDE = 16  # facets that reach out of the grid, with more of which rays that leave it are left to the ray engine
MOST_LISTED = 2e7  # facets in all cells, about: cells of very many large facets are larger
FEW_LISTED, EACH_LISTED = 4e5, 200  # the most there, and for each facet more: a wide floor needs no fine cells
BATCH = 1 << 17  # triangles and boxes that are looked at together
PAD = 0.004  # [cells] facets count as in a cell when this near to it, far more than the rounding of the way through
GRAZING = 100.0  # times its thickness is the most that a point is moved off a facet along a ray
FEW = 3  # facets in a cell, below which nothing is gained by looking whether they all are on one side
ROUNDING = 1e-13  # of coordinates: some hundreds of the last bits of heights; what leans outward by less is flat
BEYOND = 1.0 + 1e-9  # walls of cells that a ray has passed, or nearly so, count
NEAR = 1e-7  # [cells] that near to a facet, on which side of it a place is is not asked
MOST_MEDIA = 2**15 - 1  # whose numbers a grid has room for
NONE, UNKNOWN = -1, -2


class Grid(NamedTuple):
    """What kernels ask about a grid of cells (x, y, z) over meshes' facets (f,).

    low (3,), edge: its corner and the edge of a cell; free (x, y, z) float32: distances of the cells' middles to the
    nearest facet, at most; cells (x y z,) int32: the number of the cell among those with facets, or less than 0, how
    many cells on the next of those is; first (occupied + 1,) int32, listed: the facets in each, one cell after the
    other; slabs (occupied, 5): a direction, and between which heights along it all of them are; home (x y z,) int16:
    the medium in whose mesh a place near each cell's middle is, see `mark`, NONE or UNKNOWN, empty where no medium has
    a mesh; outer: the facets that reach out of the grid, if there are no more than OUTSIDE; closed: rays that leave the
    grid meet nothing else; beyond: distances outside it are at least those to the grid. corners (f, 3, 3); planes
    (f, 4): normal and height over the origin; mesh (f,) int32: the number of the facet's mesh; owner (meshes,) int32:
    the medium whose boundary it is, NONE for surfaces; thickness (f,): how near to it counts as on it; margin: how far
    behind each other rays may meet facets, wholly inside the grid, that are at one place.
    """

    low: np.ndarray
    edge: float
    free: np.ndarray
    cells: np.ndarray
    slabs: np.ndarray
    first: np.ndarray
    listed: np.ndarray
    home: np.ndarray
    outer: np.ndarray
    closed: bool
    beyond: bool
    corners: np.ndarray
    planes: np.ndarray
    mesh: np.ndarray
    owner: np.ndarray
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
def free_around(grid, p, least):
    """Return a length within which no facet is around p; one below `least` may be shorter than need be."""
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
        if bound < wall and wall > least:
            # Nearer than the walls of the cell there are only its own, none nearer than its plane
            what = int(grid.cells[(i * ny + j) * nz + k])
            for at in range(grid.first[what] if what >= 0 else 0, grid.first[what + 1] if what >= 0 else 0):
                f = grid.listed[at]
                n = (grid.planes[f, 0], grid.planes[f, 1], grid.planes[f, 2])
                wall = min(wall, abs(dot(n, p) - grid.planes[f, 3]))
                if wall <= max(bound, least):
                    return bound
            bound = max(bound, wall)
        return bound
    if not grid.beyond:
        return 0.0
    x, y, z = max(-x, x - nx, 0.0), max(-y, y - ny, 0.0), max(-z, z - nz, 0.0)
    return h * math.sqrt(x * x + y * y + z * z)


@njit(forceinline=True, **KERNEL)
def compared(grid, met, m, facet, p, d, end):
    """Note a facet that a ray meets before `end` in `met` (meshes,), if it is the first of its mesh so far; return the
    distance, or infinity where another medium's boundary does not end a way in medium m."""
    n = (grid.planes[facet, 0], grid.planes[facet, 1], grid.planes[facet, 2])
    cosine, height = dot(n, d), grid.planes[facet, 3] - dot(n, p)
    if not (height * cosine >= 0.0 and abs(height) <= end * abs(cosine)):
        return math.inf
    t = height / cosine  # most facets are left out without the division
    if not (0.0 <= t < end) or not passes(grid.corners, facet, line_of(p, d)):
        return math.inf
    mesh = grid.mesh[facet] if met.shape[0] > 1 else 0
    before = met[mesh]
    if before == NONE or t < plane_hit(grid.planes, before, p, d)[0]:
        met[mesh] = facet
    return t if met.shape[0] == 1 or m < 0 or grid.owner[mesh] == m or grid.owner[mesh] == NONE else math.inf


@njit(forceinline=True, **KERNEL)
def searched(grid, met, m, what, p, d, inside, end):
    """Note in `met` which facets of an occupied cell a ray in medium m meets, that is in it between two distances;
    return how far it is still of interest."""
    here, there = grid.first[what], grid.first[what + 1]
    if there - here >= FEW:  # it may be on one side of all of them
        n = (grid.slabs[what, 0], grid.slabs[what, 1], grid.slabs[what, 2])
        at, by = dot(n, p), dot(n, d)
        a, b = at + inside[0] * by, at + inside[1] * by
        if min(a, b) > grid.slabs[what, 4] or max(a, b) < grid.slabs[what, 3]:
            return end
    for at in range(here, there):
        end = min(end, compared(grid, met, m, grid.listed[at], p, d, end) + grid.margin)
    return end


@njit(**KERNEL)
def march(grid, met, m, p, d, end):
    """Note in `met` (meshes,) the first facets that a ray meets, NONE where there is none; return whether it is known.

    What is met farther than `end`, or behind what is at the place of the first facet of medium m or of a surface, may
    be missing; of any mesh where m is none.
    """
    for e in range(met.shape[0]):
        met[e] = NONE
    for at in range(grid.outer.shape[0]):
        facet = grid.outer[at]
        end = min(end, compared(grid, met, m, facet, p, d, end + GRAZING * grid.thickness[facet]))
    end += grid.margin
    nx, ny, nz = grid.free.shape
    size = 1.0 / grid.edge
    x, y, z = (p[0] - grid.low[0]) * size, (p[1] - grid.low[1]) * size, (p[2] - grid.low[2]) * size
    dx, dy, dz = d[0] * size, d[1] * size, d[2] * size
    ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
    # The ray enters the grid at t and leaves it at `last`
    (ax, ay, az), (bx, by, bz) = (-x * ix, -y * iy, -z * iz), ((nx - x) * ix, (ny - y) * iy, (nz - z) * iz)
    t, i, j, k = 0.0, int(x), int(y), int(z)
    if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
        t = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), 0.0))
        i, j, k = int(x + t * dx), int(y + t * dy), int(z + t * dz)
        i, j, k = min(max(i, 0), nx - 1), min(max(j, 0), ny - 1), min(max(k, 0), nz - 1)
    last = min(max(ax, bx), min(max(ay, by), max(az, bz)))
    if not grid.closed and (nx == 0 or t > 0.0 or last < end):
        return False
    last -= 1e-8 * grid.edge + 1e-13 * last  # not beyond it by rounding
    cell = (i * ny + j) * nz + k
    # Where it leaves its cell along each axis, what lies between two such places, and which cell is the next. Choices
    # that a processor cannot foresee are made without branches.
    tx, ty, tz = ((i + (dx >= 0.0)) - x) * ix, ((j + (dy >= 0.0)) - y) * iy, ((k + (dz >= 0.0)) - z) * iz
    nextx, nexty, nextz = (ny * nz if dx >= 0.0 else -ny * nz), (nz if dy >= 0.0 else -nz), (1 if dz >= 0.0 else -1)
    ix, iy, iz = abs(ix), abs(iy), abs(iz)
    dx, dy, dz = max(abs(dx), 1e-300), max(abs(dy), 1e-300), max(abs(dz), 1e-300)
    for _ in range(STEPS):
        if not t <= min(last, end):
            return True
        if not 0 <= cell < grid.cells.shape[0]:
            return False
        what = int(grid.cells[cell])
        if what >= 0:
            end = searched(grid, met, m, what, p, d, (t, min(end, min(tx, min(ty, tz)))), end)
        if what >= -1:
            t = min(tx, min(ty, tz))
            cell += (nextx if tx <= t else 0) + (nexty if ty <= t else 0) + (nextz if tz <= t else 0)
            tx += ix if tx <= t else 0.0
            ty += iy if ty <= t else 0.0
            tz += iz if tz <= t else 0.0
            continue
        far = -what - 1
        t = min(tx + far * ix, min(ty + far * iy, tz + far * iz))
        n = int(max((t - tx) * dx + BEYOND, 0.0))
        tx += n * ix
        cell += n * nextx
        n = int(max((t - ty) * dy + BEYOND, 0.0))
        ty += n * iy
        cell += n * nexty
        n = int(max((t - tz) * dz + BEYOND, 0.0))
        tz += n * iz
        cell += n * nextz
    return False


@njit(forceinline=True, **KERNEL)
def mark(grid, i, j, k):
    """Return the place of a cell whose medium is known: near its middle, but not where modelled facets often are."""
    h = grid.edge
    return grid.low[0] + (i + 0.517) * h, grid.low[1] + (j + 0.529) * h, grid.low[2] + (k + 0.541) * h


@njit(**KERNEL)
def height(grid, facet, p):
    """Return how high p is over a facet's plane."""
    return dot((grid.planes[facet, 0], grid.planes[facet, 1], grid.planes[facet, 2]), p) - grid.planes[facet, 3]


@njit(**KERNEL)
def crossings(grid, sums, cell, line, p, q):
    """Add to `sums` (meshes,) how often the facets in a cell are crossed from p to q, both in it, on that line: inward
    less outward."""
    what = int(grid.cells[cell])
    if what < 0:
        return
    for at in range(grid.first[what], grid.first[what + 1]):
        facet = grid.listed[at]
        over = height(grid, facet, p) > 0.0
        if over != (height(grid, facet, q) > 0.0) and passes(grid.corners, facet, line):
            sums[grid.mesh[facet]] += 1 if over else -1


@njit(**KERNEL)
def entered(grid, sums, home):
    """Return the medium that holds a place, after so many crossings (meshes,) from one that `home` holds: NONE, or
    UNKNOWN where several do."""
    found = NONE
    for e in range(sums.shape[0]):
        m = grid.owner[e]
        if m != NONE and sums[e] + (1 if m == home else 0) > 0:
            found = m if found == NONE else UNKNOWN
    return found


@njit(**KERNEL)
def home_of(grid, sums, p):
    """Return the medium within whose mesh p is, NONE, or UNKNOWN where that is not known; `sums` (meshes,) is used."""
    nx, ny, nz = grid.free.shape
    if grid.home.shape[0] == 0:
        return NONE
    by = 1.0 / grid.edge
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
        return NONE
    i, j, k = int(x), int(y), int(z)
    cell = (i * ny + j) * nz + k
    home = int(grid.home[cell])
    if home == UNKNOWN or grid.cells[cell] < 0:
        return home
    for e in range(sums.shape[0]):
        sums[e] = 0
    q = mark(grid, i, j, k)
    crossings(grid, sums, cell, line_of(q, (p[0] - q[0], p[1] - q[1], p[2] - q[2])), q, p)
    return entered(grid, sums, home)


@njit(**KERNEL)
def held(grid, m, p):
    """Return whether p is in a cell that no facet is in and medium m holds."""
    nx, ny, nz = grid.free.shape
    by = 1.0 / grid.edge
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
        return False
    cell = (int(x) * ny + int(y)) * nz + int(z)
    return grid.cells[cell] < 0 and grid.home[cell] == m


@njit(**KERNEL)
def slipped(grid, sums, m, p, near):
    """Return whether p, from where the ray engine sees the mesh of medium m from within, is surely outside it, farther
    than `near`: once in 1e7 times a ray slips through between two facets. `sums` (meshes,) is used."""
    if grid.free.shape[0] == 0:  # there is no grid that would know
        return False
    home, off = home_of(grid, sums, p), free_around(grid, p, 0.0)
    for k in range(3):
        off = max(off, max(grid.low[k] - p[k], p[k] - grid.low[k] - grid.edge * grid.free.shape[k]))
    return home != m and home != UNKNOWN and off > near


# --------------------------------------------------------------------------------------------- from meshes


@njit(**KERNEL)
def find_homes(grid, home, sums):
    """Write the medium of each cell's mark to `home` (x y z,): NONE at the grid's walls, and then as facets are
    crossed along x; `sums` (meshes,) is used. UNKNOWN where rounding could matter, and where there are several."""
    nx, ny, nz = grid.free.shape
    way = (1.0, 0.0, 0.0)
    for j in range(ny):
        for k in range(nz):
            now, before = NONE, mark(grid, 0, j, k)
            line = line_of(before, way)
            for e in range(sums.shape[0]):
                sums[e] = 0
            for i in range(nx):
                cell, here = (i * ny + j) * nz + k, mark(grid, i, j, k)
                last = ((i - 1) * ny + j) * nz + k if i > 0 else cell
                if grid.cells[cell] >= 0 or grid.cells[last] >= 0:
                    wall = (grid.low[0] + i * grid.edge, here[1], here[2])
                    crossings(grid, sums, last, line, before, wall)
                    crossings(grid, sums, cell, line, wall, here)
                    now = entered(grid, sums, NONE)
                home[cell], before = now, here
            if now != NONE:  # these are no closed meshes
                for i in range(nx):
                    home[(i * ny + j) * nz + k] = UNKNOWN
            for i in range(nx):
                cell, here = (i * ny + j) * nz + k, mark(grid, i, j, k)
                what = int(grid.cells[cell])
                for at in range(grid.first[what] if what >= 0 else 0, grid.first[what + 1] if what >= 0 else 0):
                    if abs(height(grid, grid.listed[at], here)) < NEAR * grid.edge:
                        home[cell] = UNKNOWN


def grid_of(meshes: Sequence[np.ndarray], owner: np.ndarray, planes: np.ndarray, thickness: np.ndarray,
            box: tuple[np.ndarray, np.ndarray], cells: int, least: float, beyond: bool) -> Grid:  # fmt: skip
    """Return the grid over a box.

    Parameters
    ----------
    meshes : sequence of (f, 3, 3) float64
        Corners of the facets of each mesh.
    owner : (meshes,) int32
        The medium that it is the boundary of, all of it in the box, NONE for surfaces.
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
        return Grid(np.zeros(3), 1.0, np.zeros((0, 0, 0), np.float32), nothing, np.zeros((0, 5)), np.zeros(1, np.int32),
                    nothing, np.zeros(0, np.int16), nothing, not len(corners), not len(corners), corners, planes, mesh,
                    owner, thickness, 0.0)  # fmt: skip
    size = np.maximum(high - low, 1e-3 * (high - low).max())
    sides = np.sort(np.clip(corners.max(axis=1), low, high) - np.clip(corners.min(axis=1), low, high), axis=1)
    area = float((sides[:, 1] * sides[:, 2]).sum())  # of the facets in the box, at most twice as much
    most = min(FEW_LISTED + EACH_LISTED * len(corners), MOST_LISTED)
    edge = max(float((size.prod() / cells) ** (1 / 3)), math.sqrt(area / most), least)
    counts = np.ceil(size / edge).astype(int) + 2
    low = 0.5 * (low + high) - 0.5 * counts * edge
    free, first, listed = cells_of(corners, planes, low, edge, counts)
    hair = 1e-6 * edge  # what the box holds is no outer for rounding
    outer = ((corners < low + edge - hair) | (corners > low + (counts - 1) * edge + hair)).any(axis=(1, 2))
    held = ((corners >= low) & (corners <= low + counts * edge)).all(axis=(1, 2))
    margin = 2.0 * GRAZING * float(thickness[held].max(initial=0.0))
    few = int(outer.sum()) <= OUTSIDE
    home = np.full(free.size if (owner != NONE).any() else 0, NONE, np.int16)
    occupied = np.flatnonzero(first[1:] > first[:-1])
    number = _steps(first, counts)
    number[occupied] = np.arange(len(occupied))
    first = first[np.append(occupied, len(first) - 1)]
    slabs = _slabs(corners, planes, first, listed)
    reaching = outer.nonzero()[0].astype(np.int32)[: OUTSIDE * few]
    grid = Grid(low, edge, free, number, slabs, first, listed, home, reaching, few, beyond, corners, planes, mesh,
                owner, thickness, margin)  # fmt: skip
    if home.size:
        find_homes(Handle(grid), grid.home, np.zeros(len(owner), np.int32))
    return grid


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


def _steps(first: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return `Grid.cells` for those that are empty, (x y z,) int32."""
    from scipy.ndimage import distance_transform_cdt

    empty = (first[1:] == first[:-1]).reshape(tuple(counts))
    if empty.all():
        return np.full(empty.size, -int(counts.max()), np.int32)
    return -distance_transform_cdt(empty, "chessboard").astype(np.int32).ravel()


def _slabs(corners: np.ndarray, planes: np.ndarray, first: np.ndarray, listed: np.ndarray) -> np.ndarray:
    """Return `Grid.slabs`, along the sums of the facets' normals."""
    slabs, many = np.zeros((len(first) - 1, 5)), BATCH // 8
    farthest = float(np.abs(corners).max())
    for begin in range(0, len(slabs), many):
        starts = first[begin : begin + many + 1]
        own, at = listed[starts[0] : starts[-1]], starts[:-1] - starts[0]
        way = np.add.reduceat(planes[own, :3], at, axis=0)
        heights = np.einsum("ikj,ij->ik", corners[own], np.repeat(way, np.diff(starts), axis=0))
        off = ROUNDING * farthest * np.abs(way).sum(axis=1)
        low, high = np.minimum.reduceat(heights.min(axis=1), at), np.maximum.reduceat(heights.max(axis=1), at)
        slabs[begin : begin + many] = np.column_stack((way, low - off, high + off))
    return slabs


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
