"""Polygons of mesh files: what a reader hands on, and how polygons become triangles.

A file's faces are stored flat: `corners` are vertex indices, `sizes` says how many of them each polygon takes.
The only door to mapbox_earcut. Reading files is `meshes`, `gltf` and `vtk`; closed surfaces are `surface`.
"""

from collections import Counter, defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsdf.errors import GrainError

MOST_CORNERS = 5_000  # of one polygon: clipping ears takes up to their square
MANY_FACES = 1_000_000  # more triangles than this only of a file with ten bytes for each
MOST_PIECES = 100_000  # objects, primitives or nodes in a file
MOST_CLIPPED = 100_000  # polygons that are neither triangles nor fans
THIN = 0.02  # height of a triangle over its longest side below which another is looked for
SLIVER = 1e-3  # the same of a fan or a quadrangle: with thinner ones ears are clipped instead

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Part(NamedTuple):
    """A piece of a mesh file.

    Attributes
    ----------
    points : (n, 3) float64
        Vertices [the file's unit].
    corners : (k,) int64
        Vertex indices, polygon after polygon.
    sizes : (m,) int64
        Corners of each polygon.
    """

    points: Floats
    corners: Ints
    sizes: Ints


class Budget:
    """How many triangles, three times as many points, and `MOST_PIECES`, may come out of a file of `size` bytes.

    A file can name the same mesh many times over, so that a few bytes stand for more than fits into memory.
    """

    def __init__(self, size: int) -> None:
        self.most = max(MANY_FACES, size // 10)
        self._size, self._left, self._pieces = size, self.most, MOST_PIECES

    def spend(self, part: Part) -> Part:
        """Return the part, or raise GrainError if it is one too many."""
        self.take(max(len(part.corners) - 2 * len(part.sizes), len(part.points) // 3))
        return part

    def take(self, triangles: int) -> None:
        """Count one piece of so many triangles."""
        self._left -= triangles
        self._pieces -= 1
        if self._left < 0:
            fault = f"stands for more than {self.most} triangles in {self._size} bytes"
            raise GrainError(f"{fault}; export it without instances or compression, or simplify it")
        if self._pieces < 0:
            raise GrainError(f"is made of more than {MOST_PIECES} pieces; join them")


def whole(values: NDArray) -> Ints:
    """Return indices as int64.

    Raises
    ------
    ValueError
        One of them is no whole number.
    """
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
        raise ValueError("an index that is no whole number")
    indices = values.astype(np.int64)
    if (indices != values).any():
        raise ValueError("an index that is no whole number")
    return indices


def triangle_part(points: ArrayLike, triangles: ArrayLike) -> Part:
    """Return the part of triangles, (m, 3) int."""
    faces = np.asarray(triangles, np.int64)
    return Part(np.asarray(points, np.float64), faces.reshape(-1), np.full(len(faces), 3))


def turned_over(part: Part) -> Part:
    """Return the part with each polygon wound the other way, for a placement that mirrors."""
    last = np.cumsum(part.sizes) - 1
    order = np.repeat(2 * last - part.sizes + 1, part.sizes) - np.arange(len(part.corners))
    return part._replace(corners=part.corners[order])


def strip_triangles(corners: ArrayLike) -> Ints:
    """Return (m, 3) the triangles of a strip, every second turned so that all wind alike."""
    strip = np.asarray(corners, np.int64)
    if len(strip) < 3:
        return np.empty((0, 3), np.int64)
    faces = np.column_stack([strip[:-2], strip[1:-1], strip[2:]])
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def strips_part(points: ArrayLike, strips: list[Ints]) -> Part:
    """Return the part of the triangles of strips.

    Raises
    ------
    GrainError
        There are more strips than `MOST_PIECES`.
    """
    if len(strips) > MOST_PIECES:
        raise GrainError(f"is made of {len(strips)} strips, more than {MOST_PIECES}; export it as triangles")
    return triangle_part(points, np.vstack([strip_triangles(strip) for strip in strips]))


def fan_triangles(corners: ArrayLike) -> Ints:
    """Return (m, 3) the triangles of a fan about its first corner."""
    fan = np.asarray(corners, np.int64)
    if len(fan) < 3:
        return np.empty((0, 3), np.int64)
    return np.column_stack([np.broadcast_to(fan[0], len(fan) - 2), fan[1:-1], fan[2:]])


def triangles_of(part: Part) -> Ints:
    """Return (m, 3) triangles that cover the polygons of a part, each in the polygon's own plane (Newell's normal).

    A polygon whose fan about its first corner is wound one way throughout is fanned; a quadrangle may take its other
    diagonal; every other one has its ears clipped. Each side of a polygon is a side of one of its triangles, so that
    neighbours stay neighbours, also where corners are collinear or repeated.

    Raises
    ------
    GrainError
        Indices beyond the vertices, a polygon of more than `MOST_CORNERS` corners.
    """
    points, corners, sizes = part
    if len(sizes) == 0:
        return np.empty((0, 3), np.int64)
    if sizes.min() < 0 or sizes.sum() != len(corners):
        raise GrainError(f"its faces take {sizes.sum()} corners of {len(corners)}; export the mesh again")
    starts = np.cumsum(sizes) - sizes
    wrong = np.flatnonzero((corners < 0) | (corners >= len(points)))
    if len(wrong):
        face = int(np.searchsorted(starts, wrong[0], side="right"))
        fault = f"face {face} names vertex {corners[wrong[0]]} (counted from 0) of {len(points)}"
        raise GrainError(f"{fault}; export the mesh again")
    if sizes.max() > MOST_CORNERS:
        fault = f"face {int(sizes.argmax()) + 1} has {sizes.max()} corners, more than {MOST_CORNERS}"
        raise GrainError(f"{fault}; triangulate it in a modeller")
    corners, sizes = _distinct(corners, sizes, starts)
    starts = np.cumsum(sizes) - sizes
    found, order, clipped = [], [], 0
    for size in np.unique(sizes[sizes >= 3]):
        which = np.flatnonzero(sizes == size)
        loops = corners[starts[which][:, None] + np.arange(size)]
        if size == 3:
            found.append(loops)
            order.append(which)
            continue
        fan = loops[:, _fan(size)]
        bad = ~_one_way(points, loops, fan)
        if size == 4 and bad.any():
            other = loops[bad][:, [[1, 2, 3], [1, 3, 0]]]
            good = _one_way(points, loops[bad], other)
            fan[np.flatnonzero(bad)[good]] = other[good]
            bad[np.flatnonzero(bad)[good]] = False
        found.append(fan[~bad].reshape(-1, 3))
        order.append(np.repeat(which[~bad], size - 2))
        clipped += int(bad.sum())
        if clipped > MOST_CLIPPED:
            raise GrainError(f"more than {MOST_CLIPPED} concave or degenerate polygons; triangulate it in a modeller")
        for i in np.flatnonzero(bad):
            found.append(loops[i][_clipped(points[loops[i]])])
            order.append(np.full(len(found[-1]), which[i]))
    if not found:
        return np.empty((0, 3), np.int64)
    return np.vstack(found)[np.argsort(np.concatenate(order), kind="stable")]


def _distinct(corners: Ints, sizes: Ints, starts: Ints) -> tuple[Ints, Ints]:
    """Return corners and sizes without corners that polygons of more than three name twice in a row."""
    following = np.roll(corners, -1)
    some = sizes > 0
    following[(starts + sizes - 1)[some]] = corners[starts[some]]
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    keep = (corners != following) | (sizes[polygon] <= 3)
    return corners[keep], np.bincount(polygon[keep], minlength=len(sizes))


def _fan(size: int) -> Ints:
    """Return (size - 2, 3) the fan of a polygon about its corner 0."""
    return fan_triangles(np.arange(size))


def _newell(loops: Floats) -> Floats:
    """Return (m, 3) Newell's normal of polygons (m, size, 3), as long as twice the area.

    M. E. Newell, R. G. Newell and T. L. Sancha, Proc. ACM Annual Conf. (1972) 443.
    """
    p = loops - loops[:, :1]
    return np.cross(p, np.roll(p, -1, axis=1)).sum(axis=1)


def _one_way(points: Floats, loops: Ints, triangles: Ints) -> NDArray[np.bool_]:
    """Tell of which polygons (m, size) all triangles (m, size - 2, 3) are wound as the whole, and none is a sliver."""
    normal = _newell(points[loops])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    corners = points[triangles]
    sides = np.roll(corners, -1, axis=2) - corners
    double = np.einsum("ijk,ik->ij", np.cross(sides[:, :, 0], sides[:, :, 1]), normal)
    return (double > SLIVER * (sides**2).sum(axis=3).max(axis=2)).all(axis=1)


def _clipped(loop: Floats) -> Ints:
    """Return (n - 2, 3) triangles of one polygon (n, 3), as indices into it, by clipping ears."""
    import mapbox_earcut

    n = len(loop)
    normal = _newell(loop[None])[0]
    length = float(np.linalg.norm(normal))
    if not (np.isfinite(loop).all() and length > 0 and np.isfinite(length)):
        return _fan(n)  # no plane: whatever closes it
    normal /= length
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    flat = (loop - loop[0]) @ np.column_stack([across, np.cross(normal, across)])
    flat /= max(np.abs(flat).max(), 1e-300)
    faces = mapbox_earcut.triangulate_float64(flat, np.array([n], np.uint32)).astype(np.int64).reshape(-1, 3)
    a, b, c = flat[faces].swapaxes(0, 1)
    u, v = b - a, c - a
    faces = np.where((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0)[:, None], faces[:, ::-1], faces)
    if len(faces) != n - 2:
        faces = np.vstack([faces, *_remainder(n, faces)])
    return _fattened(flat, faces)


def _remainder(n: int, faces: Ints) -> list[Ints]:
    """Return the triangles that lead from the rim of `faces` to the sides of a polygon of n corners.

    Clipping drops corners that are collinear or repeated; the neighbours still have them, so there must be triangles
    there, without area.
    """
    missing: Counter[tuple[int, int]] = Counter((i, (i + 1) % n) for i in range(n))
    for a, b in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist():
        if missing[b, a] < 0:  # the other side of a cut
            missing[b, a] += 1
        else:
            missing[a, b] -= 1
    follow = defaultdict(list)
    for (a, b), times in missing.items():
        for _ in range(abs(times)):
            follow[a if times > 0 else b].append(b if times > 0 else a)
    loops = []
    for start in list(follow):
        while follow[start]:
            loop = [start]
            while (ahead := follow[loop[-1]].pop()) != start:
                loop.append(ahead)
            loops.append(fan_triangles(loop))
    return loops


def _fattened(points: Floats, faces: Ints) -> Ints:
    """Return triangles of a plane of which none is `THIN` that a flip of its longest side mends."""

    def fatness(corners: tuple[int, ...]) -> float:
        """Height over the longest side, over that side; negative if turned over."""
        (ax, ay), (bx, by), (cx, cy) = (places[i] for i in corners)
        longest = max((bx - ax) ** 2 + (by - ay) ** 2, (cx - bx) ** 2 + (cy - by) ** 2, (ax - cx) ** 2 + (ay - cy) ** 2)
        return ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / max(longest, 1e-300)

    a, b, c = points[faces].swapaxes(0, 1)
    u, v = b - a, c - a
    longest = np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    thin = np.flatnonzero(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < THIN * longest).tolist()
    if not thin:
        return faces
    places, made = points.tolist(), [tuple(face) for face in faces.tolist()]
    owner = {(face[k], face[(k + 1) % 3]): t for t, face in enumerate(made) for k in range(3)}
    if len(owner) != 3 * len(made):  # a polygon that crosses itself
        return faces
    for _ in range(8 * len(made)):
        if not thin:
            break
        t = thin.pop()
        if fatness(made[t]) >= THIN:
            continue
        sides = [(made[t][k], made[t][(k + 1) % 3], made[t][(k + 2) % 3]) for k in range(3)]
        a, b, c = max(
            sides, key=lambda side: sum((p - q) ** 2 for p, q in zip(places[side[0]], places[side[1]], strict=True))
        )
        other = owner.get((b, a))
        if other is None:
            continue
        d = next(i for i in made[other] if i not in (a, b))
        first, second = (c, a, d), (b, c, d)
        if min(fatness(first), fatness(second)) <= min(fatness(made[t]), fatness(made[other])):
            continue
        del owner[a, b], owner[b, a]
        for index, face in ((t, first), (other, second)):
            made[index] = face
            owner.update({(face[k], face[(k + 1) % 3]): index for k in range(3)})
        thin += [t, other]
    return np.array(made, np.int64)
