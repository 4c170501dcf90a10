"""Facets that many ways meet, asked together: what `grid.march` says of one, for walkers in lanes.

A way through a grid reads a cell, which says whether to read what is in it, which says which facets to read: each waits
for the one before, and ends in a branch that nobody guesses. Here all ways do the same at a time, in loops without
branches: the compiler works out several steps at once, and a processor waits for many of them together; what is read
next is fetched meanwhile. A way ends where it meets its first facet, or leaves the grid: outside there must be none.
"""

from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import KERNEL, dot, triple
from tsdf.walk.cells import FEW
from tsdf.walk.grid import BEYOND, NONE, among, boxed, inverse
from tsdf.walk.lanes import STRIDE, at, put, three
from tsdf.walk.wide import WIDE, bring, lowest, turned

PAIRS = 1024  # of ways and facets that are looked at together

# Numbers of a way: how far at most, and how far it has come; where it leaves its cell along each axis, how far that is
# from wall to wall, how many cells it comes for each unit, and by how much the number of its cell changes there: those
# are MOVED where it takes another's place. How far it had come before. And of the way that had that place at first, its
# NAME: from where, whither, and as `grid.line_of` has it, by its axis.
# Its cell, NONE at its end, and its name; the cell before, how far facets are from that, or in one with facets its
# number among these; and the axis along which the way of a name runs most
END, GONE, TX, TY, TZ, IX, IY, IZ, CX, CY, CZ, NX, NY, NZ, FROM, PX, PY, PZ, DX, DY, DZ, QX, QY, QZ, U, V = range(26)
MOVED, NUMBERS = 14, 26
CELL, NAME, THERE, FAR, AXIS, WHOLES = range(6)
EIGHT = 8  # ways that are worked out together


class Ways(NamedTuple):
    """Ways from places, and what they meet.

    numbers (NUMBERS * STRIDE,), wholes (WHOLES * STRIDE,) int64: of the ways that are under way, from 0 on; facets (n,
    1) int32: the first facet that each meets, or NONE; near (n,): those in a cell with facets, or whose place another
    takes, last (n,): which; queries (n,) uint32: through what box of its cell each goes; whose, which (PAIRS,): a way
    and a facet.
    """

    numbers: np.ndarray
    wholes: np.ndarray
    facets: np.ndarray
    near: np.ndarray
    last: np.ndarray
    queries: np.ndarray
    whose: np.ndarray
    which: np.ndarray


def ways_of(size: int) -> Ways:
    """Return room for so many ways, at most STRIDE - EIGHT."""
    return Ways(
        np.zeros(NUMBERS * STRIDE), np.zeros(WHOLES * STRIDE, np.int64), np.full((size, 1), NONE, np.int32),
        np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros(size, np.uint32), np.zeros(PAIRS, np.int64),
        np.zeros(PAIRS, np.int64),
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


@njit(forceinline=True, **KERNEL)
def filled(count):
    """Return a number of ways, a multiple of EIGHT, with which none is worked out alone; the last may be nothing."""
    return (count + EIGHT - 1) & -EIGHT


@njit(forceinline=True, **KERNEL)
def after(axis):
    """Return the numbers of the two axes that follow one."""
    return 9 >> 2 * axis & 3, 18 >> 2 * axis & 3


@njit(forceinline=True, **KERNEL)
def following(v, x, y):
    """Return what a triple is along the two axes that follow one, and along that: x, or else y, or else z."""
    return (
        v[1] if x else (v[2] if y else v[0]), v[2] if x else (v[0] if y else v[1]), v[0] if x else (v[1] if y else v[2])
    )  # fmt: skip


@njit(**KERNEL)
def begin(grid, ways, count):
    """Bring the first `count` ways to their first cells; see `grid.march` and `grid.line_of`."""
    numbers, wholes, size = ways.numbers, ways.wholes, 1.0 / grid.edge
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
    lx, ly, lz = grid.low[0], grid.low[1], grid.low[2]
    fx, fy, fz, hair, margin = float(nx), float(ny), float(nz), 1e-8 * grid.edge, grid.margin
    cells = nx * ny * nz
    for i in range(filled(count)):
        x, y, z = three(numbers, PX, i)
        x, y, z = (x - lx) * size, (y - ly) * size, (z - lz) * size
        dx, dy, dz = three(numbers, DX, i)
        dx, dy, dz = dx * size, dy * size, dz * size
        ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
        ax, ay, az, bx, by, bz = -x * ix, -y * iy, -z * iz, (fx - x) * ix, (fy - y) * iy, (fz - z) * iz
        t = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), 0.0))
        last = min(max(ax, bx), min(max(ay, by), max(az, bz)))
        i0, j0, k0 = clipped(x + t * dx, fx - 1.0), clipped(y + t * dy, fy - 1.0), clipped(z + t * dz, fz - 1.0)
        put(numbers, NX, i, (fy * fz if dx >= 0.0 else -fy * fz, fz if dy >= 0.0 else -fz, 1.0 if dz >= 0.0 else -1.0))
        wholes[at(NAME, i)] = i
        numbers[at(TX, i)] = (i0 + (1.0 if dx >= 0.0 else 0.0) - x) * ix
        numbers[at(TY, i)] = (j0 + (1.0 if dy >= 0.0 else 0.0) - y) * iy
        numbers[at(TZ, i)] = (k0 + (1.0 if dz >= 0.0 else 0.0) - z) * iz
        put(numbers, IX, i, (abs(ix), abs(iy), abs(iz)))
        put(numbers, CX, i, (max(abs(dx), 1e-300), max(abs(dy), 1e-300), max(abs(dz), 1e-300)))
        numbers[at(GONE, i)] = t
        end = min(numbers[at(END, i)] + margin, last - hair - 1e-13 * last)
        cell = (np.int64(i0) * ny + np.int64(j0)) * nz + np.int64(k0)
        on = (t <= end) & (cell >= 0) & (cell < cells)
        wholes[at(CELL, i)], numbers[at(END, i)] = cell if on else NONE, end
    for i in range(filled(count)):
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        x, y = abs(d[0]) > max(abs(d[1]), abs(d[2])), abs(d[1]) > abs(d[2])
        e = following(d, x, y)
        wholes[at(AXIS, i)] = 0 if x else (1 if y else 2)
        put(numbers, QX, i, following(p, x, y))
        numbers[at(U, i)], numbers[at(V, i)] = e[0] / e[2], e[1] / e[2]
    for i in range(count):
        ways.facets[i, 0] = NONE
    for i in range(count, filled(count)):
        wholes[at(CELL, i)] = NONE


@njit(**KERNEL)
def gaze(far, ways, count):
    """See how far facets are from the ways' cells, -1 for those that have come to their end, and list those in cells
    with facets; return how many."""
    wholes, which, near = ways.wholes, ways.near, 0
    for i in range(count):
        cell = wholes[at(CELL, i)]
        away = np.int64(far[np.uint64(max(cell, 0))]) >> 8 | cell >> 63
        wholes[at(FAR, i)] = away
        which[np.uint64(near)] = i
        near += away == 0
    return near


@njit(**KERNEL)
def advance(ways, count, cells):
    """Take ways past their cells, of so many, to NONE where they come to their end; return how many do not."""
    numbers, wholes, goes = ways.numbers, ways.wholes, 0
    for i in range(filled(count)):
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
        to = cell + np.int64(x * numbers[at(NX, i)] + y * numbers[at(NY, i)] + z * numbers[at(NZ, i)])
        on = (cell >= 0) & (to >= 0) & (to < cells) & (t <= numbers[at(END, i)])
        wholes[at(CELL, i)] = to if on else NONE
        numbers[at(GONE, i)] = t
        goes += on
    return goes


@njit(**KERNEL)
def close(ways, count, goes):
    """Let ways that are under way, at most so many of the first `count`, take the places of those that are not."""
    numbers, wholes, near, last, holes, others = ways.numbers, ways.wholes, ways.near, ways.last, 0, 0
    for i in range(goes):
        near[np.uint64(holes)] = i
        holes += wholes[at(CELL, i)] < 0
    for i in range(goes, count):
        last[np.uint64(others)] = i
        others += wholes[at(CELL, i)] >= 0
    for k in range(others):
        i, j = near[np.uint64(k)], last[np.uint64(k)]
        for field in range(MOVED):
            numbers[at(field, i)] = numbers[at(field, j)]
        wholes[at(CELL, i)], wholes[at(NAME, i)] = wholes[at(CELL, j)], wholes[at(NAME, j)]
    for i in range(goes, filled(goes)):
        wholes[at(CELL, i)] = NONE


@njit(**KERNEL)
def sift(grid, ways, near):
    """Of ways in cells with facets leave those that may meet one, see `grid.asked`; return how many."""
    numbers, wholes, which, cells, slabs, left = ways.numbers, ways.wholes, ways.near, grid.cells, grid.slabs, 0
    for k in range(near):
        i = which[np.uint64(k)]
        number = np.int64(cells[np.uint64(wholes[at(THERE, i)])])
        wholes[at(FAR, i)] = number
        bring(slabs, number)
    for k in range(near):
        i = which[np.uint64(k)]
        slab, name = slabs[np.uint64(wholes[at(FAR, i)])], wholes[at(NAME, i)]
        n = triple(slab.way)
        level, by = dot(n, three(numbers, PX, name)), dot(n, three(numbers, DX, name))
        a = level + numbers[at(FROM, i)] * by
        b = level + min(numbers[at(GONE, i)], numbers[at(END, i)]) * by
        which[np.uint64(left)] = i
        left += (min(a, b) <= slab.high) & (max(a, b) >= slab.low)
    return left


@njit(forceinline=True, **KERNEL)
def seen(numbers, name, axis, low, by, ends):
    """Return where a way is, along an axis, at two distances from its begin, in units of the cell that it is in at a
    third, from that cell's begin."""
    p, d = (numbers[at(PX + axis, name)] - low) * by, numbers[at(DX + axis, name)] * by
    p -= float(np.int64(p + ends[2] * d))
    return p + ends[0] * d, p + ends[1] * d


@njit(**KERNEL)
def aim(grid, ways, near):
    """Write through which boxes of their cells ways go, as far as there are facets; see `grid.box_around`."""
    numbers, wholes, which, queries = ways.numbers, ways.wholes, ways.near, ways.queries
    slabs, boxes, listed, low, by = grid.slabs, grid.boxes, grid.listed, grid.low, 1.0 / grid.edge
    for k in range(near):
        i = which[np.uint64(k)]
        slab, name = slabs[np.uint64(wholes[at(FAR, i)])], wholes[at(NAME, i)]
        first = np.int64(slab.first)
        bring(boxes, first)
        bring(listed, first)
        bring(boxes, first + WIDE // 2)
        bring(listed, first + WIDE // 2)
        n = triple(slab.way)
        level, each = dot(n, three(numbers, PX, name)), inverse(dot(n, three(numbers, DX, name)))
        s, t = (slab.low - level) * each, (slab.high - level) * each
        gone, start = numbers[at(GONE, i)], numbers[at(FROM, i)]
        s, t, middle = max(start, min(s, t)), min(min(gone, numbers[at(END, i)]), max(s, t)), 0.5 * (start + gone)
        j, m = after(np.int64(slab.axis))
        a, b = seen(numbers, name, j, low[np.uint64(j)], by, (s, t, middle))
        c, e = seen(numbers, name, m, low[np.uint64(m)], by, (s, t, middle))
        queries[np.uint64(k)] = boxed((a, c), (b, e)) if slab.last - slab.first > FEW else np.uint32(0)


@njit(**KERNEL)
def search(grid, ways, near):
    """Note which facets ways meet in their cells."""
    wholes, which, queries, count = ways.wholes, ways.near, ways.queries, 0
    slabs, listed, facets = grid.slabs, grid.listed, grid.facets
    for k in range(near):
        i = which[np.uint64(k)]
        slab, query = slabs[np.uint64(wholes[at(FAR, i)])], queries[np.uint64(k)]
        here, there = np.int64(slab.first), np.int64(slab.last)
        while here < there:
            if count + WIDE > PAIRS:
                compare(grid, ways, count)
                count = 0
            bits = among(grid, here, there, query)
            while bits != 0:
                f = np.int64(listed[np.uint64(here + lowest(bits))])
                bring(facets, 16 * f)
                bring(facets, 16 * f + 8)
                ways.whose[np.uint64(count)], ways.which[np.uint64(count)] = i, f
                count += 1
                bits &= bits - 1
            here += WIDE
    compare(grid, ways, count)


@njit(**KERNEL)
def compare(grid, ways, count):
    """Note the facets of pairs that are the first that their ways meet; see `grid.compared`."""
    numbers, wholes, whose, which, facets, left = ways.numbers, ways.wholes, ways.whose, ways.which, grid.facets, 0
    for k in range(count):
        i, f = whose[np.uint64(k)], which[np.uint64(k)]
        name = wholes[at(NAME, i)]
        axis = wholes[at(AXIS, name)]
        j, m = after(axis)
        whose[np.uint64(left)], which[np.uint64(left)] = i, f
        left += turned(facets, f, (j, m, axis), three(numbers, QX, name), (numbers[at(U, name)], numbers[at(V, name)]))
    for k in range(left):
        i, f = whose[np.uint64(k)], np.uint64(which[np.uint64(k)])
        name, n = wholes[at(NAME, i)], (facets[f, 0], facets[f, 1], facets[f, 2])
        t = (facets[f, 3] - dot(n, three(numbers, PX, name))) / dot(n, three(numbers, DX, name))
        if (t >= 0.0) & (t < numbers[at(END, i)]):
            numbers[at(END, i)] = t
            wholes[at(CELL, i)] = wholes[at(CELL, i)] if t > numbers[at(GONE, i)] else NONE
            ways.facets[name, 0] = f


@njit(**KERNEL)
def meet(grid, ways, count):
    """Note in `facets` which the first `count` ways meet first; what is farther than their end may be missing."""
    begin(grid, ways, count)
    while count > 0:
        near = gaze(grid.far, ways, count)
        goes = advance(ways, count, grid.far.shape[0])
        near = sift(grid, ways, near)
        if near > 0:
            aim(grid, ways, near)
            search(grid, ways, near)
        if 2 * goes <= count:
            close(ways, count, goes)
            count = goes
