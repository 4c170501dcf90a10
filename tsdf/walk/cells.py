"""Which facets are in which cells of a grid, as `grid.Grid` keeps it: their lists, and what cells they fill.

Beside the list stands what tells most facets from a ray without looking at them: the slab that all are in, and a box
around each.
"""

import math

import numpy as np

from tsdf.walk.wide import WIDE

BATCH = 1 << 17  # triangles and boxes that are looked at together
PAD = 0.004  # [cells] facets count as in a cell when this near to it, far more than the rounding of the way through
ROUNDING = 1e-13  # of coordinates: some hundreds of the last bits of heights; what leans outward by less is flat
HAIR = 1e-7  # [cells] by which what facets fill is larger, for rounding on the way through
MET = 256  # cells that are as far from the next with facets have room for a byte of how far exactly
FINER = (math.sqrt(3.0) - 1.0) / 255.0  # of it: that is at most so much farther than along an axis
BLUR = 1e-3  # of that: more than float32 rounds
HALF_DIAGONAL = math.sqrt(0.75)  # [cells]
FEW = 3  # facets in a cell, with more of which none is looked at that can be told from the cell alone
SIDES = 256  # parts of a cell a side, across the direction of its slab
LINE = 64  # bytes of a line of a processor's cache
# A unit vector, between which heights along it all is that is in a cell of its facets, and where in a list they are;
# two fill a line
SLAB = np.dtype([("way", "3f4"), ("low", "f4"), ("high", "f4"), ("first", "i4"), ("last", "i4"), ("axis", "i4")])


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


def far_of(empty: np.ndarray) -> np.ndarray:
    """Return how far from each cell of a grid (x, y, z) the nearest is that is not empty, (x y z,) uint16.

    By the longest way along an axis: so many times MET cells, 255 at most. And by how much from middle to middle it is
    farther than that: so many times FINER, at least.
    """
    from scipy.ndimage import distance_transform_cdt, distance_transform_edt

    if empty.all():
        return np.full(empty.size, min(max(empty.shape), MET - 1) * MET, np.uint16)
    steps = np.minimum(distance_transform_cdt(empty, "chessboard"), MET - 1)
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    square = sum((nearest[k] - np.expand_dims(np.arange(n, dtype=np.int32), axis=(*range(k), *range(k + 1, 3)))) ** 2
                 for k, n in enumerate(empty.shape))  # fmt: skip
    finer = (np.sqrt(square, dtype=np.float32) / np.maximum(steps, 1).astype(np.float32) - 1.0) / FINER
    return (MET * steps + np.clip(finer - BLUR, 0, MET - 1).astype(np.int32)).astype(np.uint16).ravel()


def free_of(far: np.ndarray, edge: float) -> np.ndarray:
    """Return distances of cells' middles to the nearest triangle, at most, from what `far_of` says."""
    middles = (far >> 8) * (1.0 + (far & 255) * FINER)
    return edge * np.maximum(middles - HALF_DIAGONAL, 0.0)


def listed_of(
    corners: np.ndarray, planes: np.ndarray, middles: np.ndarray, edge: float, first: np.ndarray, listed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `slabs`, `listed` and `boxes` of a `grid.Grid`: what is in each cell, the facets, and where in it these
    are, where they are more than FEW; and WIDE more, of nothing.

    A box is, a byte each, the lowest and the highest part of the cell, of SIDES a side, that a facet may be in, along
    the two axes that follow that nearest to the slab's way. Of the lowest is kept what is missing to the last part:
    facets whose boxes meet one have at least as much in each byte as `grid.boxed` has of that.

    Parameters
    ----------
    corners, planes, edge
        As for `cells_of`.
    middles : (occupied, 3) float64
        Of the cells in which facets are.
    first, listed : (occupied + 1,), (n,) int32
        Where the facets of each begin, and which they are.
    """
    slabs, many = lined(len(middles), SLAB), np.diff(first)
    slabs["first"], slabs["last"] = first[:-1], first[1:]
    boxes = np.zeros(len(listed) + WIDE, np.int32)
    off = ROUNDING * float(np.abs(corners).max()) + HAIR * edge
    begins = np.unique(np.searchsorted(first, np.arange(0, len(listed), BATCH), "right") - 1)
    for begin, end in zip(begins, np.append(begins, len(many))[1:], strict=True):
        here, there = slice(begin, end), slice(first[begin], first[end])
        own, at = listed[there], first[here] - first[begin]
        way, low, high = _slabs(corners[own], planes[own], at, middles[here], (edge, off))
        slabs["axis"][here] = np.abs(way).argmax(axis=1)
        slabs["way"][here], slabs["low"][here], slabs["high"][here] = way, low, high
        boxed = np.flatnonzero(many[here].repeat(many[here]) > FEW)
        row = np.arange(len(at)).repeat(many[here])[boxed]
        places = (corners[own[boxed]] - middles[here][row][:, None]) / edge + 0.5
        boxes[first[begin] + boxed] = _boxes(places, np.abs(way).argmax(axis=1)[row])
    return slabs, np.append(listed, np.zeros(WIDE, np.int32)), boxes


def lined(many: int, kind: np.dtype) -> np.ndarray:
    """Return (many,) zeros of a kind that begin where a line of a processor's cache does."""
    size = many * kind.itemsize
    room = np.zeros(size + LINE, np.uint8)
    begin = -room.ctypes.data % LINE
    return room[begin : begin + size].view(kind.base).reshape(many, *kind.shape)


def _slabs(
    corners: np.ndarray, planes: np.ndarray, at: np.ndarray, middles: np.ndarray, sizes: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `way`, `low` and `high` of SLAB for cells.

    Corners (n, 3, 3) and planes (n, 4) are of the facets in each, those of a cell begin at `at` (cells,); middles
    (cells, 3) are those of the cells. `sizes`: the edge of a cell, and by how much slabs are thicker on each side.
    """
    edge, off = sizes
    many = np.diff(np.append(at, len(planes)))
    normal = planes[:, :3]
    alike = np.einsum("ij,ij->i", normal, normal[at].repeat(many, axis=0)) < 0.0
    way = np.add.reduceat(np.where(alike[:, None], -normal, normal), at, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    way = way.astype(np.float32).astype(np.float64)
    along = way.repeat(many, axis=0)
    heights = np.einsum("ikj,ij->ik", corners, along)
    # In the cell a facet is as high as its plane is there
    cosine = np.einsum("ij,ij->i", normal, along)
    across = along - cosine[:, None] * normal
    plane = cosine * planes[:, 3] + np.einsum("ij,ij->i", across, middles.repeat(many, axis=0))
    reach = (0.5 + PAD) * edge * np.abs(across).sum(axis=1)
    under, over = _ends(*heights.T)
    off = off + np.abs(np.einsum("ikj,ij->ik", corners, normal) - planes[:, 3:]).max(axis=1)  # of needles
    low = np.minimum.reduceat(np.maximum(under, plane - reach) - off, at)
    high = np.maximum.reduceat(np.minimum(over, plane + reach) + off, at)
    under, over = low.astype(np.float32), high.astype(np.float32)
    under = np.where(under > low, np.nextafter(under, np.float32(-math.inf)), under)
    over = np.where(over < high, np.nextafter(over, np.float32(math.inf)), over)
    return way, under, over


def _ends(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the most of three, much faster than along an axis of three."""
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _boxes(places: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the parts of cells that triangles are in, as of `listed_of`, from their corners (n, 3, 3) in units of the
    cell from its own corner; `axis` (n,) is that which is not asked about."""
    result = np.zeros(len(places), np.uint32)
    (low, high), row = _ends(places[:, 0], places[:, 1], places[:, 2]), np.arange(len(places))
    low, high = low - PAD, high + PAD
    for k in (1, 2):
        for shift, end in ((0, low), (8, high)):
            x = end[row, (axis + k) % 3]
            result |= np.clip(x * SIDES, 0, SIDES - 1).astype(np.uint32) << (16 * (k - 1) + shift)
    return (result ^ np.uint32(0x00FF00FF)).view(np.int32)


def _batches(*arrays: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return arrays of one length in pieces of BATCH rows."""
    return [tuple(array[i : i + BATCH] for array in arrays) for i in range(0, len(arrays[0]), BATCH)]


def cells_of(
    corners: np.ndarray, planes: np.ndarray, low: np.ndarray, edge: float, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how far from each cell of a grid the nearest is that triangles reach into, as `far_of`, where those of
    each cell begin (cells + 1,), and which they are, one cell after the other.

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
    return far_of(empty), first, listed
