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
from tsdf.vectors import KERNEL, dot, step, triple
from tsdf.walk.cells import FEW, FINER, HALF_DIAGONAL, MET, SIDES, SLAB, cells_of, lined, listed_of
from tsdf.walk.wide import WIDE, lowest, over, turned

STEPS = 64  # of a ray through the grid; the ray engine is faster with those that need more
OUTSIDE = 16  # facets that reach out of the grid, with more of which rays that leave it are left to the ray engine
MOST_LISTED = 2e7  # facets in all cells, about: cells of very many large facets are larger
FEW_LISTED, EACH_LISTED = 4e5, 200  # the most there, and for each facet more: a wide floor needs no fine cells
GRAZING = 100.0  # times its thickness is the most that a point is moved off a facet along a ray
MANY = 8  # facets in a cell, with more of which the slab that all are in tells how far they are
SHORTER = 1.0 - 1e-6  # the directions of slabs are that near to unit vectors
BEYOND = 1.0 + 1e-9  # walls of cells that a ray has passed, or nearly so, count
NEAR = 1e-7  # [cells] that near to a facet, on which side of it a place is is not asked
MOST_MEDIA = 2**15 - 1  # whose numbers a grid has room for
NONE, UNKNOWN = -1, -2
THICK = 7  # a number of `Grid.facets`


class Grid(NamedTuple):
    """What kernels ask about a grid of cells (x, y, z) over meshes' facets (f,).

    low (3,), edge: its corner and the edge of a cell; shape (3,): how many along each axis; far (x y z,) uint16: how
    far the nearest of those with facets is, see `cells.far_of`, and below MET in those; cells (x y z,) int32: the
    number of such a cell among them; slabs (occupied,) of cells.SLAB: what is in each; listed, boxes (n,) int32: the
    facets in each, one cell after the other, and where in it they are, see `cells.listed_of`; home (x y z,) int16: the
    medium in whose mesh a place near each cell's middle is, see `mark`, NONE or UNKNOWN, empty where no medium has a
    mesh; outer: the facets that reach out of the grid, if there are no more than OUTSIDE; closed: rays that leave the
    grid meet nothing else; beyond: distances outside it are at least those to the grid. facets (f, 16), two lines of a
    processor's cache: normal and height over the origin, where the corners are along x and as THICK how near to it
    counts as on it, and from 8 and 12 on where they are along y and z; mesh (f,) int32: the number of the facet's mesh;
    owner (meshes,) int32: the medium whose boundary it is, NONE for surfaces;
    margin: how far behind each other rays may meet facets, wholly inside the grid, that are at one place.
    """

    low: np.ndarray
    edge: float
    shape: tuple[int, int, int]
    far: np.ndarray
    cells: np.ndarray
    slabs: np.ndarray
    listed: np.ndarray
    boxes: np.ndarray
    home: np.ndarray
    outer: np.ndarray
    closed: bool
    beyond: bool
    facets: np.ndarray
    mesh: np.ndarray
    owner: np.ndarray
    margin: float


# ------------------------------------------------------------------------------------------- for kernels


@njit(**KERNEL)
def plane_hit(facets, facet, p, d):
    """Return distance along d from p to a facet's plane, and the cosine of d to its normal."""
    n = (facets[facet, 0], facets[facet, 1], facets[facet, 2])
    cosine = dot(n, d)
    if cosine == 0.0:
        return math.inf, 0.0
    return (facets[facet, 3] - dot(n, p)) / cosine, cosine


@njit(forceinline=True, **KERNEL)
def line_of(p, d):
    """Return the line through p along d as `passes` takes it: the numbers of two axes and of that along which it runs
    most, p in that order, and how far it goes along the two for each unit along the third."""
    if abs(d[0]) > max(abs(d[1]), abs(d[2])):
        return (1, 2, 0), (p[1], p[2], p[0]), d[1] / d[0], d[2] / d[0]
    if abs(d[1]) > abs(d[2]):
        return (2, 0, 1), (p[2], p[0], p[1]), d[2] / d[1], d[0] / d[1]
    return (0, 1, 2), p, d[0] / d[2], d[1] / d[2]


@njit(forceinline=True, **KERNEL)
def passes(facets, facet, line):
    """Return whether a line passes within a facet, see `turned`."""
    axes, p, u, v = line
    return turned(facets, facet, axes, p, (u, v))


@njit(forceinline=True, **KERNEL)
def inverse(x):
    """Return 1 / x, a large number for 0."""
    return 1.0 / x if abs(x) > 1e-300 else 1e300


@njit(forceinline=True, **KERNEL)
def list_of(grid, cell):
    """Return where in `listed` the facets of a cell begin and end."""
    if grid.far[cell] >= MET:
        return 0, 0
    slab = grid.slabs[grid.cells[cell]]
    return int(slab.first), int(slab.last)


@njit(**KERNEL)
def free_around(grid, p, least):
    """Return a length within which no facet is around p; one below `least` may be shorter than need be."""
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
    if nx == 0:
        return math.inf if grid.beyond else 0.0
    h = grid.edge
    by = 1.0 / h
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    if 0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz:
        i, j, k = int(x), int(y), int(z)
        x, y, z = x - i - 0.5, y - j - 0.5, z - k - 0.5
        cell = (i * ny + j) * nz + k
        far = int(grid.far[cell])
        bound = max((far >> 8) * (1.0 + (far & 255) * FINER) - HALF_DIAGONAL, 0.0)
        bound = h * (bound - math.sqrt(x * x + y * y + z * z))
        wall = h * (0.5 - max(max(abs(x), abs(y)), abs(z)))
        if bound < wall and wall > least:
            # Nearer than the walls of the cell there are only its own, none nearer than its plane
            here, there = list_of(grid, cell)
            if there - here > MANY:
                slab = grid.slabs[grid.cells[cell]]
                at = dot(triple(slab.way), p)
                wall = min(wall, SHORTER * max(slab.low - at, at - slab.high))
                there = here
            for at in range(here, there):
                f = grid.listed[at]
                n = (grid.facets[f, 0], grid.facets[f, 1], grid.facets[f, 2])
                wall = min(wall, abs(dot(n, p) - grid.facets[f, 3]))
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
    n = (grid.facets[facet, 0], grid.facets[facet, 1], grid.facets[facet, 2])
    cosine, height = dot(n, d), grid.facets[facet, 3] - dot(n, p)
    if not (height * cosine >= 0.0 and abs(height) <= end * abs(cosine)):
        return math.inf
    t = height / cosine  # most facets are left out without the division
    if not (0.0 <= t < end) or not passes(grid.facets, facet, line_of(p, d)):
        return math.inf
    mesh = grid.mesh[facet] if met.shape[0] > 1 else 0
    before = met[mesh]
    if before == NONE or t < plane_hit(grid.facets, before, p, d)[0]:
        met[mesh] = facet
    return t if met.shape[0] == 1 or m < 0 or grid.owner[mesh] == m or grid.owner[mesh] == NONE else math.inf


@njit(forceinline=True, **KERNEL)
def asked(grid, cell, p, d, inside):
    """Return where in `listed` those facets of an occupied cell are that a line may pass between two places in it, at
    these distances from p in units of d, and the box of it, as of `boxed`, that it goes through among them."""
    slab = grid.slabs[grid.cells[cell]]
    n = triple(slab.way)
    at, by = dot(n, p), dot(n, d)
    a, b = at + inside[0] * by, at + inside[1] * by
    here, there, box = int(slab.first), int(slab.last), np.uint32(0)
    if min(a, b) > slab.high or max(a, b) < slab.low:  # it is on one side of all of them
        there = here
    elif there - here > FEW:
        each = inverse(by)
        a, b = (slab.low - at) * each, (slab.high - at) * each
        a, b = max(inside[0], min(a, b)), min(inside[1], max(a, b))
        box = box_around(grid, cell, slab.axis, step(p, a, d), step(p, b, d))
    return here, there, box


@njit(forceinline=True, **KERNEL)
def among(grid, here, there, box):
    """Return which of the next WIDE facets of a list, which ends, have boxes that meet another: a bit for each."""
    return over(grid.boxes, here, box) & ((1 << min(there - here, WIDE)) - 1)


@njit(forceinline=True, **KERNEL)
def searched(grid, met, m, cell, p, d, inside, end):
    """Note in `met` which facets of an occupied cell a ray in medium m meets, that is in it between two distances;
    return how far it is still of interest."""
    here, there, box = asked(grid, cell, p, d, inside)
    while here < there:
        bits = among(grid, here, there, box)
        while bits != 0:
            facet = grid.listed[here + lowest(bits)]
            end = min(end, compared(grid, met, m, facet, p, d, end) + grid.margin)
            bits &= bits - 1
        here += WIDE
    return end


@njit(**KERNEL)
def box_around(grid, cell, axis, p, q):
    """Return the box on the way from p to q in a cell, as of `boxed`: along the two axes that follow one."""
    ny, nz = grid.shape[1], grid.shape[2]
    i, rest, size, low = cell // (ny * nz), cell % (ny * nz), 1.0 / grid.edge, grid.low
    j, k = rest // nz, rest % nz
    x = ((p[0] - low[0]) * size - i, (p[1] - low[1]) * size - j, (p[2] - low[2]) * size - k)
    y = ((q[0] - low[0]) * size - i, (q[1] - low[1]) * size - j, (q[2] - low[2]) * size - k)
    if axis == 0:
        return boxed((x[1], x[2]), (y[1], y[2]))
    if axis == 1:
        return boxed((x[2], x[0]), (y[2], y[0]))
    return boxed((x[0], x[1]), (y[0], y[1]))


@njit(forceinline=True, **KERNEL)
def boxed(p, q):
    """Return the box between two places in a cell, in units of it, along two axes, as `over` takes it to find boxes of
    `cells.listed_of` that meet it: where it begins, theirs end, and the other way around."""
    high = np.uint32(SIDES - 1)
    u = part(max(p[0], q[0])) ^ high | part(min(p[0], q[0])) << np.uint32(8)
    return u | (part(max(p[1], q[1])) ^ high) << np.uint32(16) | part(min(p[1], q[1])) << np.uint32(24)


@njit(forceinline=True, **KERNEL)
def part(x):
    """Return in which of the parts of a cell x, in units of it, is."""
    return np.uint32(np.int64(min(max(x * SIDES, 0.0), SIDES - 1.0)))


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
        end = min(end, compared(grid, met, m, facet, p, d, end + GRAZING * grid.facets[facet, THICK]))
    end += grid.margin
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
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
        if not 0 <= cell < grid.far.shape[0]:
            return False
        far = int(grid.far[cell]) >> 8
        if far == 0:
            end = searched(grid, met, m, cell, p, d, (t, min(end, min(tx, min(ty, tz)))), end)
        if far <= 1:
            t = min(tx, min(ty, tz))
            cell += (nextx if tx <= t else 0) + (nexty if ty <= t else 0) + (nextz if tz <= t else 0)
            tx += ix if tx <= t else 0.0
            ty += iy if ty <= t else 0.0
            tz += iz if tz <= t else 0.0
            continue
        far -= 1
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
    return dot((grid.facets[facet, 0], grid.facets[facet, 1], grid.facets[facet, 2]), p) - grid.facets[facet, 3]


@njit(**KERNEL)
def crossings(grid, sums, cell, line, p, q):
    """Add to `sums` (meshes,) how often the facets in a cell are crossed from p to q, both in it, on that line: inward
    less outward."""
    if grid.far[cell] >= MET:
        return
    here, there, box = asked(grid, cell, p, (q[0] - p[0], q[1] - p[1], q[2] - p[2]), (0.0, 1.0))
    while here < there:
        bits = among(grid, here, there, box)
        while bits != 0:
            facet = grid.listed[here + lowest(bits)]
            above = height(grid, facet, p) > 0.0
            if above != (height(grid, facet, q) > 0.0) and passes(grid.facets, facet, line):
                sums[grid.mesh[facet]] += 1 if above else -1
            bits &= bits - 1
        here += WIDE


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
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
    if grid.home.shape[0] == 0:
        return NONE
    by = 1.0 / grid.edge
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
        return NONE
    i, j, k = int(x), int(y), int(z)
    cell = (i * ny + j) * nz + k
    home = int(grid.home[cell])
    if home == UNKNOWN or grid.far[cell] >= MET:
        return home
    for e in range(sums.shape[0]):
        sums[e] = 0
    q = mark(grid, i, j, k)
    crossings(grid, sums, cell, line_of(q, (p[0] - q[0], p[1] - q[1], p[2] - q[2])), q, p)
    return entered(grid, sums, home)


@njit(**KERNEL)
def held(grid, m, p):
    """Return whether p is in a cell that no facet is in and medium m holds."""
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
    by = 1.0 / grid.edge
    x, y, z = (p[0] - grid.low[0]) * by, (p[1] - grid.low[1]) * by, (p[2] - grid.low[2]) * by
    if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
        return False
    cell = (int(x) * ny + int(y)) * nz + int(z)
    return grid.far[cell] >= MET and grid.home[cell] == m


@njit(**KERNEL)
def slipped(grid, sums, m, p, near):
    """Return whether p, from where the ray engine sees the mesh of medium m from within, is surely outside it, farther
    than `near`: once in 1e7 times a ray slips through between two facets. `sums` (meshes,) is used."""
    if grid.shape[0] == 0:  # there is no grid that would know
        return False
    home, off = home_of(grid, sums, p), free_around(grid, p, 0.0)
    for k in range(3):
        off = max(off, max(grid.low[k] - p[k], p[k] - grid.low[k] - grid.edge * grid.shape[k]))
    return home != m and home != UNKNOWN and off > near


# --------------------------------------------------------------------------------------------- from meshes


@njit(**KERNEL)
def find_homes(grid, home, sums):
    """Write the medium of each cell's mark to `home` (x y z,): NONE at the grid's walls, and then as facets are
    crossed along x; `sums` (meshes,) is used. UNKNOWN where rounding could matter, and where there are several."""
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
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
                if grid.far[cell] < MET or grid.far[last] < MET:
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
                begin, end = list_of(grid, cell)
                for at in range(begin, end):
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
    facets = lined(len(corners), np.dtype("16f8"))
    facets[:, :4], facets[:, THICK] = planes, thickness
    facets.reshape(-1, 4, 4)[:, 1:, :3] = corners.transpose(0, 2, 1)
    if not len(corners) or not cells:
        nothing = np.zeros(0, np.int32)
        return Grid(np.zeros(3), 1.0, (0, 0, 0), np.zeros(0, np.uint16), nothing, np.zeros(0, SLAB),
                    nothing, nothing, np.zeros(0, np.int16), nothing, not len(corners), not len(corners),
                    facets, mesh, owner, 0.0)  # fmt: skip
    size = np.maximum(high - low, 1e-3 * (high - low).max())
    sides = np.sort(np.clip(corners.max(axis=1), low, high) - np.clip(corners.min(axis=1), low, high), axis=1)
    area = float((sides[:, 1] * sides[:, 2]).sum())  # of the facets in the box, at most twice as much
    most = min(FEW_LISTED + EACH_LISTED * len(corners), MOST_LISTED)
    edge = max(float((size.prod() / cells) ** (1 / 3)), math.sqrt(area / most), least)
    counts = np.ceil(size / edge).astype(int) + 2
    low = 0.5 * (low + high) - 0.5 * counts * edge
    far, first, listed = cells_of(corners, planes, low, edge, counts)
    hair = 1e-6 * edge  # what the box holds is no outer for rounding
    outer = ((corners < low + edge - hair) | (corners > low + (counts - 1) * edge + hair)).any(axis=(1, 2))
    held = ((corners >= low) & (corners <= low + counts * edge)).all(axis=(1, 2))
    margin = 2.0 * GRAZING * float(thickness[held].max(initial=0.0))
    few = int(outer.sum()) <= OUTSIDE
    home = np.full(far.size if (owner != NONE).any() else 0, NONE, np.int16)
    occupied = np.flatnonzero(first[1:] > first[:-1])
    number = np.full(far.size, NONE, np.int32)
    number[occupied] = np.arange(len(occupied))
    middles = low + edge * (0.5 + np.stack(np.unravel_index(occupied, counts), axis=1))
    slabs, listed, boxes = listed_of(corners, planes, middles, edge, first[np.append(occupied, -1)], listed)
    reaching = outer.nonzero()[0].astype(np.int32)[: OUTSIDE * few]
    shape = int(counts[0]), int(counts[1]), int(counts[2])
    grid = Grid(low, edge, shape, far, number, slabs, listed, boxes, home, reaching, few, beyond, facets, mesh, owner,
                margin)  # fmt: skip
    if home.size:
        find_homes(Handle(grid), grid.home, np.zeros(len(owner), np.int32))
    return grid
