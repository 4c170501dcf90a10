"""Where grains stand: the one answer that all levels with single grains share, from the place of a grain's centre.

A grain exists where its bounding sphere is clear of every opaque surface and either lies wholly inside the medium's
boundary or has its centre there, as the scene says (`scene.MediumSpec.inside`). Exact shapes answer by formula; facets
are found through a grid whose cells list those that may matter, and which side of them a cell's middle is on.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import KERNEL, cross, dot, step

CELLS = 1_000_000  # of the grid, about: fewer where a cell would be smaller than a grain
ROUNDING = 1e-14  # of coordinates: some tens of the last bits of heights over planes
MESH, SLAB, BOX, BALL = 0, 1, 2, 3  # kinds of shapes
CLOSED, OPEN = -2, -1  # owners of the facets of opaque surfaces; a medium's are owned by its number


class Room(NamedTuple):
    """What kernels ask about the room for grains; coordinates as in `geometry.Geometry`.

    kind (m,), shape (m, 6): where centres may lie, if that is no mesh; radius (m,): R [unit]; whole (m,) bool:
    bounding spheres lie wholly inside a mesh; balls (b, 4): opaque; corners (f, 3, 3), owner (f,) of facets; planes
    (f, 5): their normal, height over the origin, and how far the corners are from it, with rounding; first (cells +
    1,), facets: those that come within R of a cell, one cell after the other; inside (m + 1, cells) bool: whether a
    cell's middle is in each medium with a mesh and, last, in a closed surface; low (3,), edge, counts (3,): the grid.
    """

    kind: np.ndarray
    shape: np.ndarray
    radius: np.ndarray
    whole: np.ndarray
    balls: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    planes: np.ndarray
    first: np.ndarray
    facets: np.ndarray
    inside: np.ndarray
    low: np.ndarray
    edge: float
    counts: np.ndarray


# ------------------------------------------------------------------------------------------- for kernels


@njit(forceinline=True, **KERNEL)
def exact_depth(kind, shape, p):
    """Return the distance of p to a slab's, box's or ball's boundary, positive inside; outside a box at most that."""
    if kind == BALL:
        q = (p[0] - shape[0], p[1] - shape[1], p[2] - shape[2])
        return shape[3] - math.sqrt(dot(q, q))
    depth = min(p[2] - shape[2], shape[5] - p[2])
    if kind == SLAB:
        return depth
    return min(depth, min(min(p[0] - shape[0], shape[3] - p[0]), min(p[1] - shape[1], shape[4] - p[1])))


@njit(**KERNEL)
def triangle_distance(corners, p):
    """Return the distance of p to a triangle (3, 3)."""
    a = (corners[0, 0], corners[0, 1], corners[0, 2])
    u = (corners[1, 0] - a[0], corners[1, 1] - a[1], corners[1, 2] - a[2])
    v = (corners[2, 0] - a[0], corners[2, 1] - a[1], corners[2, 2] - a[2])
    q = (p[0] - a[0], p[1] - a[1], p[2] - a[2])
    uu, uv, vv, qu, qv = dot(u, u), dot(u, v), dot(v, v), dot(q, u), dot(q, v)
    det = uu * vv - uv * uv
    s, t = vv * qu - uv * qv, uu * qv - uv * qu
    if s >= 0.0 and t >= 0.0 and s + t <= det and det > 0.0:  # of a needle that is mostly rounding: its plane is nearer
        n = cross(u, v)
        return abs(dot(q, n)) / math.sqrt(dot(n, n))
    best = math.inf
    for k in range(3):
        o = a if k < 2 else step(a, 1.0, u)
        e = u if k == 0 else (v if k == 1 else step(v, -1.0, u))
        w = step(p, -1.0, o)
        w = step(w, -min(max(dot(w, e) / dot(e, e), 0.0), 1.0), e)
        best = min(best, dot(w, w))
    return math.sqrt(best)


@njit(**KERNEL)
def parted(corners, p, q):
    """Return whether a triangle (3, 3) lies between two points."""
    d = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
    x = (corners[0, 0] - p[0], corners[0, 1] - p[1], corners[0, 2] - p[2])
    y = (corners[1, 0] - p[0], corners[1, 1] - p[1], corners[1, 2] - p[2])
    z = (corners[2, 0] - p[0], corners[2, 1] - p[1], corners[2, 2] - p[2])
    n = cross((y[0] - x[0], y[1] - x[1], y[2] - x[2]), (z[0] - x[0], z[1] - x[1], z[2] - x[2]))
    height = dot(x, n)
    if (height > 0.0) == (height > dot(d, n)):
        return False
    # Signs of three volumes, which two facets see alike at the edge they share: none slips through between them
    a, b, c = dot(d, cross(x, y)) > 0.0, dot(d, cross(y, z)) > 0.0, dot(d, cross(z, x)) > 0.0
    return a == b and b == c


@njit(forceinline=True, **KERNEL)
def height(room, facet, p):
    """Return how high p is over a facet's plane, less what the facet's corners are off it: none of the facet is nearer
    than the amount, 0 within."""
    planes = room.planes
    h = planes[facet, 0] * p[0] + planes[facet, 1] * p[1] + planes[facet, 2] * p[2] - planes[facet, 3]
    return math.copysign(max(abs(h) - planes[facet, 4], 0.0), h)


@njit(**KERNEL)
def stands(room, m, c):
    """Return whether a grain of medium m stands where the centre of its bounding sphere is c."""
    radius, solid = room.radius[m], room.kind[m] != MESH
    if solid and exact_depth(room.kind[m], room.shape[m], c) < 0.0:
        return False
    for b in range(room.balls.shape[0]):
        q = (c[0] - room.balls[b, 0], c[1] - room.balls[b, 1], c[2] - room.balls[b, 2])
        if dot(q, q) < (room.balls[b, 3] + radius) ** 2:
            return False
    if room.counts[0] == 0:
        return solid
    x = (c[0] - room.low[0]) / room.edge
    y = (c[1] - room.low[1]) / room.edge
    z = (c[2] - room.low[2]) / room.edge
    if not (0.0 <= x < room.counts[0] and 0.0 <= y < room.counts[1] and 0.0 <= z < room.counts[2]):
        return solid
    i, j, k = int(x), int(y), int(z)
    cell = (i * room.counts[1] + j) * room.counts[2] + k
    middle = (
        room.low[0] + (i + 0.5) * room.edge, room.low[1] + (j + 0.5) * room.edge, room.low[2] + (k + 0.5) * room.edge
    )  # fmt: skip
    inside, body = solid or room.inside[m, cell], room.inside[room.kind.shape[0], cell]
    for at in range(room.first[cell], room.first[cell + 1]):
        facet = room.facets[at]
        owner = room.owner[facet]
        if owner != m and owner >= 0:
            continue
        here, corners = height(room, facet, c), room.corners[facet]
        # Planes tell most facets that neither come near nor part c from the middle
        if owner != OPEN and here * height(room, facet, middle) <= 0.0 and parted(corners, c, middle):
            if owner == m:
                inside = not inside
            else:
                body = not body
        if abs(here) < radius and (owner < 0 or room.whole[m]) and triangle_distance(corners, c) < radius:
            return False
    return inside and not body


@njit(**KERNEL)
def stand(room, m, centres, result):
    """Write whether grains of medium m stand at centres (n, 3) to (n,) uint8."""
    for i in range(centres.shape[0]):
        result[i] = stands(room, m, (centres[i, 0], centres[i, 1], centres[i, 2]))


# --------------------------------------------------------------------------------------------- from meshes


@njit(cache=True)
def _listed(corners, reach, low, edge, counts, first, facets):
    """Count the facets within their reach of each cell in first[1:], or with room for them write them to `facets`."""
    half = math.sqrt(0.75) * edge
    at = first[:-1].copy()
    ends = np.empty((3, 2), np.int64)
    for f in range(len(corners)):
        for k in range(3):
            a, b, c = corners[f, 0, k], corners[f, 1, k], corners[f, 2, k]
            ends[k, 0] = max(0, math.floor((min(a, b, c) - reach[f] - low[k]) / edge))
            ends[k, 1] = min(counts[k], math.floor((max(a, b, c) + reach[f] - low[k]) / edge) + 1)
        for i in range(ends[0, 0], ends[0, 1]):
            for j in range(ends[1, 0], ends[1, 1]):
                for k in range(ends[2, 0], ends[2, 1]):
                    p = (low[0] + (i + 0.5) * edge, low[1] + (j + 0.5) * edge, low[2] + (k + 0.5) * edge)
                    if triangle_distance(corners[f], p) > reach[f] + half:
                        continue
                    cell = (i * counts[1] + j) * counts[2] + k
                    if len(facets):
                        facets[at[cell]] = f
                        at[cell] += 1
                    else:
                        first[cell + 1] += 1


def _planes(corners: np.ndarray, farthest: float) -> np.ndarray:
    """Return planes (f, 5) as of `Room`, for points whose coordinates are at most `farthest`."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    heights = np.einsum("ik,ijk->ij", normal, corners)
    middle = 0.5 * (heights.min(axis=1) + heights.max(axis=1))
    off = np.ptp(heights, axis=1) + ROUNDING * (np.abs(corners).max(axis=(1, 2)) + farthest)
    return np.column_stack((normal, middle, off))


def room_of(
    kind: np.ndarray,
    shape: np.ndarray,
    radius: np.ndarray,
    whole: np.ndarray,
    balls: np.ndarray,
    meshes: Sequence[tuple[int, np.ndarray, Any]],
    extent: tuple[np.ndarray, np.ndarray],
) -> Room:
    """Return the room for grains in a scene.

    Parameters
    ----------
    kind, shape, radius, whole, balls
        As of `Room`.
    meshes : sequence of (owner, corners, within)
        Facets (f, 3, 3) of each boundary and surface, and for those that are closed what says of points (n, 3) whether
        they are inside.
    extent : two (3,) arrays
        Corners of a box that holds all media that have an end; the grid is laid there, and where there are endless
        media, wherever there are facets.
    """
    media = len(kind)
    meshes = [(owner, corners, within) for owner, corners, within in meshes if len(corners)]
    if not meshes or not media:
        nothing = np.zeros(0, np.int32)
        return Room(kind, shape, radius, whole, balls, np.zeros((0, 3, 3)), nothing, np.zeros((0, 5)),
                    np.zeros(0, np.int64), nothing, np.zeros((media + 1, 0), bool), np.zeros(3), 1.0,
                    np.zeros(3, np.int64))  # fmt: skip
    corners = np.concatenate([c for _, c, _ in meshes])
    owner = np.repeat([o for o, _, _ in meshes], [len(c) for _, c, _ in meshes]).astype(np.int32)
    # Surfaces matter to every medium's grains, a boundary to its own, and if these may stick out, only which side it is
    reach = np.append(np.where(whole, radius, 0.0), [radius.max()] * 2)[owner]
    margin = 1.01 * radius.max()
    low, high = extent
    if (kind == SLAB).any():
        low, high = np.minimum(low, corners.min(axis=(0, 1))), np.maximum(high, corners.max(axis=(0, 1)))
    low, high = low - margin, high + margin
    edge = max(float(((high - low).prod() / CELLS) ** (1 / 3)), 0.5 * float(radius.min()))
    while np.ceil((high - low) / edge + 1.0).prod() > 2 * CELLS:  # a flat grid has cells to spare
        edge *= 1.1
    low = low - edge * np.array([0.017, 0.029, 0.041])  # so that no middle of a cell lies on a facet along an axis
    counts = np.ceil((high - low) / edge).astype(np.int64)
    first = np.zeros(int(counts.prod()) + 1, np.int64)
    _listed(corners, reach, low, edge, counts, first, np.zeros(0, np.int32))
    first = np.cumsum(first)
    facets = np.zeros(int(first[-1]), np.int32)
    _listed(corners, reach, low, edge, counts, first, facets)
    inside = np.zeros((media + 1, int(counts.prod())), bool)
    if (owner != OPEN).any():
        middles = low + (np.stack(np.unravel_index(np.arange(inside.shape[1]), counts), axis=1) + 0.5) * edge
    for number, _, within in meshes:
        if number != OPEN:  # bodies that overlap count as often as facets between two places do
            inside[number if number >= 0 else media] ^= within(middles)
    planes = _planes(corners, float(max(np.abs(low).max(), np.abs(high).max())))
    return Room(kind, shape, radius, whole, balls, corners, owner, planes, first, facets, inside, low, edge, counts)
