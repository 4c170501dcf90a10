"""Facets that many ways meet, asked together: what `grid.march` says of one, for walkers in lanes.

A way through a grid reads a cell, which says whether to read what is in it, which says which facets to read: each waits
for the one before, and ends in a branch that nobody guesses. Here each of these is done for all ways that have come to
it, one after the other in a loop without branches, so that a processor waits for many of them at once; what is read
next is fetched meanwhile. A way ends where it meets its first facet, or leaves the grid: outside there must be none.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import fetch, njit
from tsdf.vectors import KERNEL, dot, step, triple
from tsdf.walk.cells import FEW, SIDES
from tsdf.walk.grid import BEYOND, NONE, box_around, boxed, compared, inverse

PAIRS = 1024  # of ways and facets that are looked at together
PART = 64  # of a list, that is looked through at once

# Numbers of a way: from where, whither, how far; how far it has gone, and goes at most; where it leaves its cell along
# each axis, how far that is from wall to wall, and how many cells it comes for each unit
PX, PY, PZ, DX, DY, DZ, END, GONE, LAST, TX, TY, TZ, IX, IY, IZ, CX, CY, CZ, FROM = range(19)
NUMBERS, WHOLES = 24, 8  # of each way
CELL, NX, NY, NZ, THERE = range(5)  # its cell, and to which it comes next along each axis; the one before


class Ways(NamedTuple):
    """Ways from places, and what they meet.

    numbers (n * NUMBERS,), wholes (n * WHOLES,) int64; facets (n, meshes) int32: the first facet met of each mesh, or NONE;
    live, near, sought (n,): those that are under way, in a cell with facets, and may meet one there; lists (n, 8): of
    these the list and which part of it; pairs (PAIRS, 2): a way and a facet.
    """

    numbers: np.ndarray
    wholes: np.ndarray
    facets: np.ndarray
    live: np.ndarray
    near: np.ndarray
    pairs: np.ndarray


def ways_of(size: int, meshes: int) -> Ways:
    """Return room for so many ways among the facets of so many meshes."""
    return Ways(
        np.zeros(NUMBERS * size), np.zeros(WHOLES * size, np.int64), np.full((size, meshes), NONE, np.int32),
        np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros((PAIRS, 2), np.int64),
    )  # fmt: skip


@njit(forceinline=True, **KERNEL)
def at(i, field):
    """Return where a number of a way is."""
    return np.uint64(i) * np.uint64(NUMBERS) + np.uint64(field)


@njit(forceinline=True, **KERNEL)
def on(i, field):
    """Return where a whole number of a way is."""
    return np.uint64(i) * np.uint64(WHOLES) + np.uint64(field)


@njit(forceinline=True, **KERNEL)
def place(numbers, i):
    """Return from where a way goes."""
    return numbers[at(i, PX)], numbers[at(i, PY)], numbers[at(i, PZ)]


@njit(forceinline=True, **KERNEL)
def course(numbers, i):
    """Return whither a way goes."""
    return numbers[at(i, DX)], numbers[at(i, DY)], numbers[at(i, DZ)]


@njit(forceinline=True, **KERNEL)
def lay(ways, i, p, d, end):
    """Write a way from p along d up to a distance."""
    numbers = ways.numbers
    numbers[at(i, PX)], numbers[at(i, PY)], numbers[at(i, PZ)] = p
    numbers[at(i, DX)], numbers[at(i, DY)], numbers[at(i, DZ)] = d
    numbers[at(i, END)] = end


@njit(**KERNEL)
def begin(grid, ways, count):
    """Bring the first `count` ways to their first cells; see `grid.march`."""
    numbers, wholes, size = ways.numbers, ways.wholes, 1.0 / grid.edge
    nx, ny, nz = grid.shape[0], grid.shape[1], grid.shape[2]
    lx, ly, lz = grid.low[0], grid.low[1], grid.low[2]
    fx, fy, fz, hair = float(nx), float(ny), float(nz), 1e-8 * grid.edge
    for i in range(count):
        x, y, z = (numbers[at(i, PX)] - lx) * size, (numbers[at(i, PY)] - ly) * size, (numbers[at(i, PZ)] - lz) * size
        dx, dy, dz = numbers[at(i, DX)] * size, numbers[at(i, DY)] * size, numbers[at(i, DZ)] * size
        ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
        ax, ay, az, bx, by, bz = -x * ix, -y * iy, -z * iz, (fx - x) * ix, (fy - y) * iy, (fz - z) * iz
        t = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), 0.0))
        last = min(max(ax, bx), min(max(ay, by), max(az, bz)))
        i0 = min(max(float(np.int64(min(max(x + t * dx, 0.0), fx))), 0.0), fx - 1.0)
        j0 = min(max(float(np.int64(min(max(y + t * dy, 0.0), fy))), 0.0), fy - 1.0)
        k0 = min(max(float(np.int64(min(max(z + t * dz, 0.0), fz))), 0.0), fz - 1.0)
        wholes[on(i, CELL)] = (np.int64(i0) * ny + np.int64(j0)) * nz + np.int64(k0)
        wholes[on(i, NX)] = ny * nz if dx >= 0.0 else -ny * nz
        wholes[on(i, NY)] = nz if dy >= 0.0 else -nz
        wholes[on(i, NZ)] = 1 if dz >= 0.0 else -1
        numbers[at(i, TX)] = (i0 + (1.0 if dx >= 0.0 else 0.0) - x) * ix
        numbers[at(i, TY)] = (j0 + (1.0 if dy >= 0.0 else 0.0) - y) * iy
        numbers[at(i, TZ)] = (k0 + (1.0 if dz >= 0.0 else 0.0) - z) * iz
        numbers[at(i, IX)], numbers[at(i, IY)], numbers[at(i, IZ)] = abs(ix), abs(iy), abs(iz)
        numbers[at(i, CX)], numbers[at(i, CY)], numbers[at(i, CZ)] = max(abs(dx), 1e-300), max(abs(dy), 1e-300), max(abs(dz), 1e-300)
        numbers[at(i, GONE)], numbers[at(i, LAST)] = t, last - hair - 1e-13 * last
    margin, live, cells = grid.margin, 0, grid.far.shape[0]
    for i in range(count):
        numbers[at(i, END)] += margin
        for e in range(ways.facets.shape[1]):
            ways.facets[i, e] = NONE
        ways.live[np.uint64(live)] = i
        live += (numbers[at(i, GONE)] <= min(numbers[at(i, LAST)], numbers[at(i, END)])) & (0 <= wholes[on(i, CELL)] < cells)
    return live


@njit(**KERNEL)
def advance(grid, ways, live):
    """Take ways that are under way past their cells; return how many go on, and how many were in cells with facets."""
    numbers, wholes, near, going, cells = ways.numbers, ways.wholes, 0, 0, grid.far.shape[0]
    for k in range(live):
        i = ways.live[np.uint64(k)]
        cell = wholes[on(i, CELL)]
        far = np.int64(grid.far[np.uint64(cell)]) >> 8
        ways.near[np.uint64(near)] = i
        wholes[on(i, THERE)], numbers[at(i, FROM)] = cell, numbers[at(i, GONE)]
        near += far == 0
        f = float(max(far, 1) - 1)
        tx, ty, tz = numbers[at(i, TX)], numbers[at(i, TY)], numbers[at(i, TZ)]
        ix, iy, iz = numbers[at(i, IX)], numbers[at(i, IY)], numbers[at(i, IZ)]
        t = min(tx + f * ix, min(ty + f * iy, tz + f * iz))
        n = np.int64(max((t - tx) * numbers[at(i, CX)] + BEYOND, 0.0))
        numbers[at(i, TX)] = tx + n * ix
        cell += n * wholes[on(i, NX)]
        n = np.int64(max((t - ty) * numbers[at(i, CY)] + BEYOND, 0.0))
        numbers[at(i, TY)] = ty + n * iy
        cell += n * wholes[on(i, NY)]
        n = np.int64(max((t - tz) * numbers[at(i, CZ)] + BEYOND, 0.0))
        numbers[at(i, TZ)] = tz + n * iz
        cell += n * wholes[on(i, NZ)]
        wholes[on(i, CELL)], numbers[at(i, GONE)] = cell, t
        ways.live[np.uint64(going)] = i
        going += (t <= min(numbers[at(i, LAST)], numbers[at(i, END)])) & (0 <= cell < cells)
    return going, near


@njit(**KERNEL)
def sift(grid, ways, near):
    """Of ways in cells with facets leave those that may meet one, see `grid.asked`; return how many."""
    numbers, wholes, left = ways.numbers, ways.wholes, 0
    for k in range(near):
        wholes[on(ways.near[np.uint64(k)], THERE)] = np.int64(grid.cells[wholes[on(ways.near[np.uint64(k)], THERE)]])
    for k in range(near):
        i = ways.near[np.uint64(k)]
        slab = grid.slabs[wholes[on(i, THERE)]]
        n = triple(slab.way)
        high, by = dot(n, place(numbers, i)), dot(n, course(numbers, i))
        a = high + numbers[at(i, FROM)] * by
        b = high + min(numbers[at(i, GONE)], numbers[at(i, END)]) * by
        ways.near[np.uint64(left)] = i
        left += (min(a, b) <= slab.high) & (max(a, b) >= slab.low)
    return left


@njit(**KERNEL)
def search(grid, ways, near, before):
    """Note which facets ways meet in their cells."""
    numbers, wholes, pairs, count = ways.numbers, ways.wholes, ways.pairs, 0
    for k in range(near):
        fetch(grid.listed[grid.slabs[wholes[on(ways.near[np.uint64(k)], THERE)]].first])
    for k in range(near):
        i = ways.near[np.uint64(k)]
        slab = grid.slabs[wholes[on(i, THERE)]]
        here, there, box = int(slab.first), int(slab.last), (0, SIDES - 1, 0, SIDES - 1)
        if there - here > FEW:
            n, p, d = triple(slab.way), place(numbers, i), course(numbers, i)
            each, high = inverse(dot(n, d)), dot(n, p)
            low, far = numbers[at(i, FROM)], min(numbers[at(i, GONE)], numbers[at(i, END)])
            a, b = (slab.low - high) * each, (slab.high - high) * each
            a, b = max(low, min(a, b)), min(far, max(a, b))
            middle = step(p, 0.5 * (low + numbers[at(i, GONE)]), d)
            box = box_around(grid, cell_of(grid, middle), n, step(p, a, d), step(p, b, d))
        while here < there:
            end = min(there, here + PART)
            if count + PART > PAIRS:
                compare(grid, ways, count)
                count = 0
            for k2 in range(here, end):
                pairs[np.uint64(count), 0], pairs[np.uint64(count), 1] = i, grid.listed[np.uint64(k2), 0]
                count += boxed_both(box, grid.listed[np.uint64(k2), 1])
            here = end
    for k in range(count):
        fetch(grid.facets[pairs[k, 1]])
        fetch(grid.facets[pairs[k, 1], 8:])
    compare(grid, ways, count)


@njit(forceinline=True, **KERNEL)
def boxed_both(box, its):
    """Return what `grid.boxed` does, without a branch."""
    u = (box[0] <= (its >> 8 & 255)) & (box[1] >= (its & 255))
    return u & (box[2] <= (its >> 24 & 255)) & (box[3] >= (its >> 16 & 255))


@njit(forceinline=True, **KERNEL)
def cell_of(grid, p):
    """Return the number of the cell that p is in."""
    by = 1.0 / grid.edge
    i, j, k = int((p[0] - grid.low[0]) * by), int((p[1] - grid.low[1]) * by), int((p[2] - grid.low[2]) * by)
    return (i * grid.shape[1] + j) * grid.shape[2] + k


@njit(**KERNEL)
def compare(grid, ways, count):
    """Note the facets of pairs that are the first that their ways meet."""
    numbers = ways.numbers
    for k in range(count):
        i, facet = ways.pairs[k, 0], ways.pairs[k, 1]
        p, d, end = place(numbers, i), course(numbers, i), numbers[at(i, END)]
        numbers[at(i, END)] = min(end, compared(grid, ways.facets[i], NONE, facet, p, d, end) + grid.margin)


@njit(**KERNEL)
def meet(grid, ways, count):
    """Note in `facets` of the first `count` ways which they meet first; what is farther than their end may be missing."""
    live = begin(grid, ways, count)
    while live > 0:
        live, near = advance(grid, ways, live)
        near = sift(grid, ways, near)
        if near > 0:
            search(grid, ways, near, 0)
