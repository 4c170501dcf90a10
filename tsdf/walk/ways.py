"""Facets that many ways meet, asked together: what `grid.march` says of one, for walkers in lanes.

A way through a grid reads a cell, which says whether to read what is in it, which says which facets to read: each waits
for the one before, and ends in a branch that nobody guesses. Here all ways do the same at a time, in loops without
branches: the compiler works out several steps at once, and a processor waits for many of them together; what is read
next is fetched meanwhile. A way ends where it meets its first facet, or leaves the grid: outside there must be none.
"""

from typing import NamedTuple

import numpy as np

from tsdf.compiled import fetch, njit
from tsdf.vectors import KERNEL, dot, step, triple
from tsdf.walk.cells import AHEAD, FEW, PAD, SIDES
from tsdf.walk.grid import BEYOND, GRAZING, NONE, box_in, inverse, line_of, passes
from tsdf.walk.lanes import STRIDE, at, put, three

PAIRS = 1024  # of ways and facets that are looked at together
PART = 64  # of a list, that is looked through at once

# Numbers of a way: from where, whither, how far at most; how far it has come, and had before; where it leaves its cell
# along each axis, how far that is from wall to wall, how many cells it comes for each unit, and by how much the number
# of its cell changes there. Its cell, the one before, how far facets are from that (of those in one with facets, its
# number among these), and the number of the way
PX, PY, PZ, DX, DY, DZ, END, GONE, FROM, TX, TY, TZ, IX, IY, IZ, CX, CY, CZ, NX, NY, NZ, NUMBERS = range(22)
CELL, THERE, FAR, NAME, WHOLES = range(5)


class Ways(NamedTuple):
    """Ways from places, and what they meet.

    numbers (NUMBERS * STRIDE,), wholes (WHOLES * STRIDE,) int64: of the ways that are under way, from 0 on; facets (n,
    1) int32: the first facet that each meets, or NONE; near (n,): those in a cell with facets, or whose place another
    takes, last (n,): which; marks (PART,) int32: which of a list to look at; pairs (PAIRS, 2), reach (PAIRS,): a way, a
    facet, and how far from its begin the way meets the facet's plane.
    """

    numbers: np.ndarray
    wholes: np.ndarray
    facets: np.ndarray
    near: np.ndarray
    last: np.ndarray
    marks: np.ndarray
    pairs: np.ndarray
    reach: np.ndarray


def ways_of(size: int) -> Ways:
    """Return room for so many ways, at most STRIDE."""
    return Ways(
        np.zeros(NUMBERS * STRIDE), np.zeros(WHOLES * STRIDE, np.int64), np.full((size, 1), NONE, np.int32),
        np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros(PART, np.int32), np.zeros((PAIRS, 2), np.int64),
        np.zeros(PAIRS),
    )  # fmt: skip


@njit(forceinline=True, **KERNEL)
def lay(ways, i, p, d, end):
    """Write a way from p along d up to a distance."""
    put(ways.numbers, PX, i, p)
    put(ways.numbers, DX, i, d)
    ways.numbers[at(END, i)] = end


@njit(forceinline=True, **KERNEL)
def clipped(x, most):
    """Return x rounded down to a cell of a row."""
    return float(np.int64(min(max(x, 0.0), most)))


@njit(**KERNEL)
def begin(grid, ways, count):
    """Bring the first `count` ways to their first cells; see `grid.march`."""
    numbers, wholes, size = ways.numbers, ways.wholes, 1.0 / grid.edge
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
    lx, ly, lz = grid.low[0], grid.low[1], grid.low[2]
    fx, fy, fz, hair, margin = float(nx), float(ny), float(nz), 1e-8 * grid.edge, grid.margin
    for i in range(count):
        x, y, z = three(numbers, PX, i)
        x, y, z = (x - lx) * size, (y - ly) * size, (z - lz) * size
        dx, dy, dz = three(numbers, DX, i)
        dx, dy, dz = dx * size, dy * size, dz * size
        ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
        ax, ay, az, bx, by, bz = -x * ix, -y * iy, -z * iz, (fx - x) * ix, (fy - y) * iy, (fz - z) * iz
        t = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), 0.0))
        last = min(max(ax, bx), min(max(ay, by), max(az, bz)))
        i0, j0, k0 = clipped(x + t * dx, fx - 1.0), clipped(y + t * dy, fy - 1.0), clipped(z + t * dz, fz - 1.0)
        wholes[at(CELL, i)] = (np.int64(i0) * ny + np.int64(j0)) * nz + np.int64(k0)
        put(numbers, NX, i, (fy * fz if dx >= 0.0 else -fy * fz, fz if dy >= 0.0 else -fz, 1.0 if dz >= 0.0 else -1.0))
        wholes[at(NAME, i)] = i
        numbers[at(TX, i)] = (i0 + (1.0 if dx >= 0.0 else 0.0) - x) * ix
        numbers[at(TY, i)] = (j0 + (1.0 if dy >= 0.0 else 0.0) - y) * iy
        numbers[at(TZ, i)] = (k0 + (1.0 if dz >= 0.0 else 0.0) - z) * iz
        put(numbers, IX, i, (abs(ix), abs(iy), abs(iz)))
        put(numbers, CX, i, (max(abs(dx), 1e-300), max(abs(dy), 1e-300), max(abs(dz), 1e-300)))
        numbers[at(GONE, i)] = t
        numbers[at(END, i)] = min(numbers[at(END, i)] + margin, last - hair - 1e-13 * last)
    for i in range(count):
        ways.facets[i, 0] = NONE


@njit(**KERNEL)
def gaze(grid, ways, count):
    """See how far facets are from the ways' cells, -1 for those that have come to their end, and list those in cells
    with facets; return how many, and how many ways are under way."""
    wholes, numbers, near, goes, cells = ways.wholes, ways.numbers, 0, 0, grid.far.shape[0]
    for i in range(count):
        cell = wholes[at(CELL, i)]
        on = (numbers[at(GONE, i)] <= numbers[at(END, i)]) & (cell >= 0) & (cell < cells)
        far = np.int64(grid.far[np.uint64(cell if on else 0)]) >> 8
        far = far if on else -1
        wholes[at(FAR, i)] = far
        ways.near[np.uint64(near)] = i
        near += far == 0
        goes += on
    return near, goes


@njit(**KERNEL)
def advance(ways, count):
    """Take ways past their cells."""
    numbers, wholes = ways.numbers, ways.wholes
    for i in range(count):
        cell = wholes[at(CELL, i)]
        wholes[at(THERE, i)], numbers[at(FROM, i)] = cell, numbers[at(GONE, i)]
        f = float(max(wholes[at(FAR, i)], 1) - 1)
        tx, ty, tz = three(numbers, TX, i)
        ix, iy, iz = three(numbers, IX, i)
        t = min(tx + f * ix, min(ty + f * iy, tz + f * iz))
        x = float(np.int64(max((t - tx) * numbers[at(CX, i)] + BEYOND, 0.0)))
        y = float(np.int64(max((t - ty) * numbers[at(CY, i)] + BEYOND, 0.0)))
        z = float(np.int64(max((t - tz) * numbers[at(CZ, i)] + BEYOND, 0.0)))
        put(numbers, TX, i, (tx + x * ix, ty + y * iy, tz + z * iz))
        cell += np.int64(x * numbers[at(NX, i)] + y * numbers[at(NY, i)] + z * numbers[at(NZ, i)])
        wholes[at(CELL, i)] = cell if wholes[at(FAR, i)] >= 0 else -1
        numbers[at(GONE, i)] = t


@njit(**KERNEL)
def close(ways, count, goes):
    """Let ways that are under way, so many of the first `count`, take the places of those that are not."""
    numbers, wholes, holes, others = ways.numbers, ways.wholes, 0, 0
    for i in range(goes):
        ways.near[np.uint64(holes)] = i
        holes += wholes[at(FAR, i)] < 0
    for i in range(goes, count):
        ways.last[np.uint64(others)] = i
        others += wholes[at(FAR, i)] >= 0
    for field in range(NUMBERS):
        for k in range(holes):
            numbers[at(field, ways.near[np.uint64(k)])] = numbers[at(field, ways.last[np.uint64(k)])]
    for field in range(WHOLES):
        for k in range(holes):
            wholes[at(field, ways.near[np.uint64(k)])] = wholes[at(field, ways.last[np.uint64(k)])]


@njit(**KERNEL)
def sift(grid, ways, near):
    """Of ways in cells with facets leave those that may meet one, see `grid.asked`; return how many."""
    numbers, wholes, left = ways.numbers, ways.wholes, 0
    for k in range(near):
        i = ways.near[np.uint64(k)]
        number = np.int64(grid.cells[np.uint64(wholes[at(THERE, i)])])
        wholes[at(FAR, i)] = number
        fetch(grid.slabs[number:])
    for k in range(near):
        i = ways.near[np.uint64(k)]
        slab = grid.slabs[np.uint64(wholes[at(FAR, i)])]
        n = triple(slab.way)
        level, by = dot(n, three(numbers, PX, i)), dot(n, three(numbers, DX, i))
        a = level + numbers[at(FROM, i)] * by
        b = level + min(numbers[at(GONE, i)], numbers[at(END, i)]) * by
        ways.near[np.uint64(left)] = i
        left += (min(a, b) <= slab.high) & (max(a, b) >= slab.low)
    return left


@njit(forceinline=True, **KERNEL)
def cell_at(grid, p):
    """Return the numbers along the axes of the cell that p is in, at least 0."""
    by, low = 1.0 / grid.edge, grid.low
    i, j, k = np.int64((p[0] - low[0]) * by), np.int64((p[1] - low[1]) * by), np.int64((p[2] - low[2]) * by)
    return float(i), float(j), float(k)


@njit(**KERNEL)
def search(grid, ways, near):
    """Note which facets ways meet in their cells."""
    numbers, wholes, pairs, count = ways.numbers, ways.wholes, ways.pairs, 0
    for k in range(near):
        first = grid.slabs[wholes[at(FAR, ways.near[np.uint64(k)])]].first
        fetch(grid.listed[first])
        fetch(grid.listed[first + AHEAD // 2])
        fetch(grid.listed[first + AHEAD])
    for k in range(near):
        i = ways.near[np.uint64(k)]
        slab = grid.slabs[np.uint64(wholes[at(FAR, i)])]
        here, there, box = int(slab.first), int(slab.last), (0, SIDES - 1, 0, SIDES - 1)
        if there - here > FEW:
            n, p, d = triple(slab.way), three(numbers, PX, i), three(numbers, DX, i)
            each, level = inverse(dot(n, d)), dot(n, p)
            s, t = (slab.low - level) * each, (slab.high - level) * each
            low, high = numbers[at(FROM, i)], min(numbers[at(GONE, i)], numbers[at(END, i)])
            s, t = max(low, min(s, t)), min(high, max(s, t))
            box = box_in(
                grid, cell_at(grid, step(p, 0.5 * (low + numbers[at(GONE, i)]), d)), n, step(p, s, d), step(p, t, d)
            )
        a, b, c, e = np.int32(box[0]), np.int32(box[1]), np.int32(box[2]), np.int32(box[3])
        while here < there:
            end = min(there, here + PART)
            if count + PART > PAIRS:
                compare(grid, ways, count)
                count = 0
            for j in range(end - here):
                its = grid.listed[np.uint64(here + j), 1]
                u = (a <= (its >> np.int32(8) & np.int32(255))) & (b >= (its & np.int32(255)))
                v = (c <= (its >> np.int32(24) & np.int32(255))) & (e >= (its >> np.int32(16) & np.int32(255)))
                ways.marks[np.uint64(j)] = np.int32(u & v)
            for j in range(end - here):
                pairs[np.uint64(count), 0], pairs[np.uint64(count), 1] = i, grid.listed[np.uint64(here + j), 0]
                count += ways.marks[np.uint64(j)]
            here = end
    compare(grid, ways, count)


@njit(**KERNEL)
def compare(grid, ways, count):
    """Note the facets of pairs that are the first that their ways meet; see `grid.compared`."""
    numbers, pairs, facets, left = ways.numbers, ways.pairs, grid.facets, 0
    hair, thick = 0.25 * PAD * grid.edge, grid.margin / GRAZING
    for k in range(count):
        fetch(facets[pairs[np.uint64(k), 1]])
        fetch(facets[pairs[np.uint64(k), 1], 8:])
    for k in range(count):
        i, f = pairs[np.uint64(k), 0], np.uint64(pairs[np.uint64(k), 1])
        n = facets[f, 0], facets[f, 1], facets[f, 2]
        cosine, height = dot(n, three(numbers, DX, i)), facets[f, 3] - dot(n, three(numbers, PX, i))
        pairs[np.uint64(left), 0], pairs[np.uint64(left), 1] = i, f
        ways.reach[np.uint64(left)] = height / cosine
        a = height - (numbers[at(FROM, i)] - hair) * cosine  # at its begin and its end in the cell
        b = height - (numbers[at(GONE, i)] + hair) * cosine
        met = (min(a, b) <= thick) & (max(a, b) >= -thick)
        left += met & (height * cosine >= 0.0) & (abs(height) <= numbers[at(END, i)] * abs(cosine))
    for k in range(left):
        i, f, t = pairs[np.uint64(k), 0], pairs[np.uint64(k), 1], ways.reach[np.uint64(k)]
        if t < numbers[at(END, i)] and passes(facets, f, line_of(three(numbers, PX, i), three(numbers, DX, i))):
            numbers[at(END, i)] = t
            ways.facets[ways.wholes[at(NAME, i)], 0] = f


@njit(**KERNEL)
def meet(grid, ways, count):
    """Note in `facets` which the first `count` ways meet first; what is farther than their end may be missing."""
    begin(grid, ways, count)
    while count > 0:
        near, goes = gaze(grid, ways, count)
        advance(ways, count)
        near = sift(grid, ways, near)
        if near > 0:
            search(grid, ways, near)
        if 2 * goes <= count:
            close(ways, count, goes)
            count = goes
