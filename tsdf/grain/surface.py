"""Closed surfaces: weld, close and orient the triangles of a grain, and find their minimal bounding sphere.

Geometry on arrays of points and faces, with numpy alone, but for vertices that must be welded. Where the arrays come
from and what is made of them is `grains`. Lengths are in units of about R, so that tolerances mean the same for a grain
of any size.
"""

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsdf.errors import GrainError
from tsdf.grain.polygons import Part, triangles_of

NEAR_WELD = 1e-6  # [R] vertices of open edges closer than this are one vertex
SLIVER_HEIGHT = 1e-9  # [R] a face less high than this has no area
FLAT_VOLUME = 1e-9  # volume / area^1.5 of a shell without volume; a sphere has 0.094
MOST_SHELLS = 10_000  # the boxes of each are compared with each
MOST_NESTED = 200_000  # pairs of shells of which one's box holds the other's
MOST_PAIRS = 50_000_000  # of points and triangles, to tell which shells are inside which
PAIRS_AT_ONCE = 200_000  # of them in memory
MOST_PER_TRIANGLE = 4  # cells of a grid that a triangle covers on average
SAME_ANGLE = 1e-6  # [rad] faces about an edge that are closer than this lie on each other
MODELLER = "use a modeller (Blender: Edit Mode, Mesh > Clean Up)"

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ODDLY = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]  # turns what stands along axes away from them


def compact(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Drop vertices that no face uses."""
    used = np.zeros(len(points), bool)
    used[faces] = True
    return points[used], (np.cumsum(used) - 1)[faces]


def _in_order(rows: NDArray[Any]) -> tuple[Ints, NDArray[np.bool_]]:
    """Return the order of rows (n, k), in which equal ones stay as they stand, and which are new there."""
    order = np.lexsort(rows.T[::-1])
    new = np.ones(len(rows), bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    return order, new


def first_of_equals(rows: NDArray[Any]) -> Ints:
    """Return for each row (n, k), of vertices say, the first that is exactly equal to it."""
    order, new = _in_order(rows)
    first = np.empty(len(rows), np.int64)
    first[order] = order[new][np.cumsum(new) - 1]
    return first


def _near_vertices(points: Floats, among: Ints) -> Ints:
    """Return for each vertex the first one within `NEAR_WELD` of it, linked through vertices `among` only."""
    from scipy.spatial import cKDTree

    pairs = among[cKDTree(points[among]).query_pairs(NEAR_WELD, output_type="ndarray")]
    return connected(len(points), pairs[:, 0], pairs[:, 1])


def connected(count: int, one: Ints, other: Ints) -> Ints:
    """Return for each of `count` things the first of all that are linked with it, by links (k,) from one to the other.

    Each round joins what is linked to the smallest neighbour of all: a handful of rounds, and nothing to import.
    """
    first = np.arange(count)
    while len(one):
        here, there = first[one], first[other]
        apart = here != there
        one, other = np.minimum(here, there)[apart], np.maximum(here, there)[apart]
        np.minimum.at(first, other, one)
        while (first != (ahead := first[first])).any():
            first = ahead
    return first


class Edges(NamedTuple):
    """Of m faces: half (3m, 2), directed, face by face; edge (3m,), which undirected one each is; the uses of these."""

    half: Ints
    edge: Ints
    uses: Ints


def half_edges(faces: Ints) -> Edges:
    """Return the edges of faces (m, 3)."""
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    start, end = half.T
    key = np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)
    _, edge, uses = np.unique(key, return_inverse=True, return_counts=True)
    return Edges(half, edge, uses)


def _edge_pairs(edge: Ints, uses: Ints) -> Ints:
    """Return (k, 2) the two half-edges of every edge that has exactly two."""
    order = np.argsort(edge, kind="stable")
    return order[uses[edge[order]] == 2].reshape(-1, 2)


def area_normals(points: Floats, faces: Ints) -> Floats:
    """Return (m, 3) normals, as long as twice the area."""
    return np.stack(_cross(*_sides(points, faces)[1:]), axis=1)


def _sides(points: Floats, faces: Ints) -> Floats:
    """Return (3, 3, m) the sides of faces that run from the second corner to the third, from the first to the second
    and from the first to the third, by x, y, z: of large meshes numpy is several times as fast along m as across."""
    a, b, c = np.ascontiguousarray(points.T)[:, faces.T].swapaxes(0, 1)
    return np.stack((c - b, b - a, c - a))


def _cross(one: Floats, other: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the cross products of vectors (3, m)."""
    (a, b, c), (x, y, z) = one, other
    return b * z - c * y, c * x - a * z, a * y - b * x


def _squares(vectors: Sequence[Floats]) -> Floats:
    """Return the squared lengths of vectors (3, m)."""
    x, y, z = vectors
    return x * x + y * y + z * z


def heights(points: Floats, faces: Ints) -> Floats:
    """Return (m,) the height of each face over its longest edge."""
    sides = _sides(points, faces)
    longest = np.sqrt(np.maximum(np.maximum(*map(_squares, sides[:2])), _squares(sides[2])))
    return np.sqrt(_squares(_cross(*sides[1:]))) / np.maximum(longest, 1e-300)


def closed_faces(points: Floats, faces: Ints, notes: list[str]) -> tuple[Floats, Ints, Edges]:
    """Remove collapsed and duplicate faces; weld near vertices if that leaves fewer open edges."""

    def distinct(faces: Ints) -> tuple[Ints, int, int]:
        real = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        kept = real[first_of_equals(np.sort(real, axis=1)) == np.arange(len(real))]
        return kept, len(faces) - len(real), len(real) - len(kept)

    clean, collapsed, doubled = distinct(faces)
    edges = half_edges(clean)
    half, edge, uses = edges
    if (uses == 1).any():
        rim = np.unique(half[uses[edge] == 1])
        first = _near_vertices(points, rim)
        welded, more, again = distinct(first[clean])
        if ((found := half_edges(welded)).uses == 1).sum() < (uses == 1).sum():
            count = int((first != np.arange(len(points))).sum())
            notes.append(f"welded {count} vertices of open edges within {NEAR_WELD:g} R")
            clean, edges, collapsed, doubled = welded, found, collapsed + more, doubled + again
    # Faces without area that hang on a closed surface go; those that are part of it are flipped away later.
    flat = heights(points, clean) < SLIVER_HEIGHT
    if flat.any() and ((found := half_edges(clean[~flat])).uses != 2).sum() < max((edges.uses != 2).sum(), 1):
        clean, edges, collapsed = clean[~flat], found, collapsed + int(flat.sum())
    if collapsed:
        notes.append(f"removed {collapsed} degenerate faces")
    if doubled:
        notes.append(f"removed {doubled} duplicate faces")
    return points, clean, edges


def oriented(faces: Ints, edges: Edges, name: str, notes: list[str]) -> tuple[Ints, Ints]:
    """Return the faces consistently wound, and the shell (m,) each belongs to."""
    flip, shell = _wound(faces, _edge_pairs(edges.edge, edges.uses))
    if flip is None:
        raise GrainError(f"{name}: no consistent winding exists: the surface has one side only; {MODELLER}")
    if flip.any():
        notes.append(f"turned over {flip.sum()} inconsistently wound faces")
    return np.where(flip[:, None], faces[:, ::-1], faces), shell


def _wound(faces: Ints, pairs: Ints) -> tuple[NDArray[np.bool_] | None, Ints]:
    """Return which faces to turn over so that pairs (k, 2) of half-edges run against each other, and the shells.

    Each face stands twice in a graph, as it is and turned over; neighbours are joined in the states that
    agree. A shell is then two components, one for each side, or one if the surface has one side only: None.
    """
    m = len(faces)
    start = faces.reshape(-1)  # of each half-edge
    first, second = pairs.T
    alike = start[first] == start[second]  # both run along the edge in one direction: one must turn over
    f, g = first // 3, second // 3
    rows, columns = np.r_[f, f + m], np.r_[g + m * alike, g + m * ~alike]
    label = connected(2 * m, rows, columns)
    kept, turned = label[:m], label[m:]
    shell = np.unique(np.minimum(kept, turned), return_inverse=True)[1]
    if (kept == turned).any():
        return None, shell
    flip = kept > turned
    mostly = np.bincount(shell, flip) * 2 > np.bincount(shell)
    return flip ^ mostly[shell], shell


def parted(
    points: Floats, faces: Ints, edges: Edges, name: str, place: Any, notes: list[str]
) -> tuple[Floats, Ints, Edges]:
    """Give solids that touch along an edge vertices of their own there, so that two faces meet at every edge.

    The faces about such an edge bound solid and void in turn; the two that bound one solid are joined. Where a solid
    touches itself so that both ends of the edge stay common, the edge is divided first.

    Raises
    ------
    GrainError
        Faces lie on each other or are odd in number: solids touch over a face, or there are inner walls.
    """
    count = int((edges.uses > 2).sum())
    if count == 0:
        return points, faces, edges
    way_out = f"unite the bodies (Blender: Boolean, Union), or remove inner walls: {MODELLER}"
    for _ in range(2):
        half, edge, uses = edges
        about = np.flatnonzero(uses[edge] > 2)
        line = np.sort(half[about], axis=1)
        origin, along = points[line[:, 0]], points[line[:, 1]] - points[line[:, 0]]
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        across = np.eye(3)[np.abs(along).argmin(axis=1)]
        across = np.cross(along, across)
        apex = points[faces[about // 3, (about % 3 + 2) % 3]] - origin
        angle = np.arctan2(np.einsum("ij,ij->i", apex, np.cross(along, across)), np.einsum("ij,ij->i", apex, across))
        order = np.lexsort([angle, edge[about]])
        about, angle = about[order], angle[order]
        first = np.r_[True, np.diff(edge[about]) != 0]
        last = np.roll(first, -1)
        begin = np.flatnonzero(first)[np.cumsum(first) - 1]
        ahead = np.where(last, begin, np.arange(len(about)) + 1)  # the next face about the same edge
        turn = np.where(last, angle[ahead] + 2 * np.pi, angle[ahead]) - angle
        lying = np.flatnonzero((turn < SAME_ANGLE) | (turn > 2 * np.pi - SAME_ANGLE) | (uses[edge[about]] % 2 == 1))
        if len(lying):
            where = place(points[half[about[lying[0]]]].mean(axis=0))
            fault = f"{count} edges are shared by more than two faces, one at {where}"
            raise GrainError(f"{name}: {fault}: bodies touch over a face, or there are inner walls; {way_out}")
        pairs = _edge_pairs(edge, uses)
        flip, whole = _wound(faces, np.vstack([pairs, np.column_stack([about, about[ahead]])]))
        if flip is None:
            fault = "the faces about edges where bodies touch do not bound solid and void in turn"
            raise GrainError(f"{name}: {fault}; {way_out}")
        flip ^= _inside_out(points, np.where(flip[:, None], faces[:, ::-1], faces), whole)
        down = (half[about, 0] > half[about, 1]) ^ flip[about // 3]  # solid lies at larger angles
        joined = np.vstack([pairs, np.column_stack([about, about[ahead]])[down]])
        points, faces = _own_vertices(points, faces, joined)
        edges = half_edges(faces)
        if not (edges.uses > 2).any():
            break
        points, faces = _divided(points, faces, edges.edge, edges.uses > 2)
        edges = half_edges(faces)
    notes.append(f"solids touch along {count} edges")
    return points, faces, edges


def _inside_out(points: Floats, faces: Ints, whole: Ints) -> NDArray[np.bool_]:
    """Return (m,) of which faces the group `whole` that they belong to is inside out, if nothing is around it."""
    volume = _shell_volumes(points, faces, whole)
    corners = points[faces].reshape(-1, 3)
    groups = np.repeat(whole, 3)
    low, high = np.full((len(volume), 3), np.inf), np.full((len(volume), 3), -np.inf)
    np.minimum.at(low, groups, corners)
    np.maximum.at(high, groups, corners)
    alone = np.array([((low <= a) & (high >= b)).all(axis=1).sum() == 1 for a, b in zip(low, high, strict=True)])
    return ((volume < 0) & alone)[whole]


def _own_vertices(points: Floats, faces: Ints, pairs: Ints) -> tuple[Floats, Ints]:
    """Return the mesh with one vertex for the corners that pairs (k, 2) of half-edges join, and no others."""
    corner = faces.reshape(-1)
    ends = np.stack([pairs, pairs - pairs % 3 + (pairs % 3 + 1) % 3], axis=2)  # corners at both ends of each
    same = (corner[ends[:, 0, 0]] == corner[ends[:, 1, 0]])[:, None]
    left, right = ends[:, 0], np.where(same, ends[:, 1], ends[:, 1, ::-1])
    rows, columns = left.ravel(), right.ravel()
    first, index = np.unique(connected(len(corner), rows, columns), return_inverse=True)
    return points[corner[first]], index.reshape(-1, 3)


def _divided(points: Floats, faces: Ints, edge: Ints, which: NDArray[np.bool_]) -> tuple[Floats, Ints]:
    """Return the mesh with a vertex in the middle of some of its edges, and the faces there divided."""
    middle = np.where(which, len(points) + np.cumsum(which) - 1, -1)
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    first = np.unique(edge, return_index=True)[1][which]
    points = np.vstack([points, points[half[first]].mean(axis=1)])
    corners = np.column_stack([faces, middle[edge].reshape(-1, 3)])[:, [0, 3, 1, 4, 2, 5]]
    return points, triangles_of(Part(points, corners[corners >= 0], (corners >= 0).sum(axis=1)))


def filled(points: Floats, faces: Ints, notes: list[str]) -> tuple[Floats, Ints, float]:
    """Close every hole of consistently wound faces, three edges by a face, more by a fan; say what share is new."""
    half, edge, uses = half_edges(faces)
    follow = defaultdict(list)  # the rim, run through against its faces
    for start, end in half[uses[edge] == 1].tolist():
        follow[end].append(start)
    loops = []
    for start in list(follow):
        while follow[start]:
            path = [start]
            while len(path) > 1 or follow[start]:
                ahead = follow[path[-1]].pop()
                if ahead in path:  # a loop, perhaps hanging on the rest by one vertex
                    cut = path.index(ahead)
                    loops.append(path[cut:])
                    path = path[: cut + 1]
                    if cut == 0:
                        break
                else:
                    path.append(ahead)
    added: list[tuple[int, int, int]] = []
    centres: list[Floats] = []
    for loop in loops:
        if len(loop) == 3:
            added.append((loop[0], loop[1], loop[2]))
            continue
        hub = len(points) + len(centres)
        centres.append(points[loop].mean(axis=0))
        added += [(a, b, hub) for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    points, new = np.vstack([points, *centres]), np.array(added, np.int64).reshape(-1, 3)
    area, more = (float(np.linalg.norm(area_normals(points, f), axis=1).sum()) for f in (faces, new))
    share = more / max(area + more, 1e-300)
    closed = f"closed {len(loops)} holes of {(uses == 1).sum()} edges with {len(added)} faces"
    notes.append(f"repair: {closed}, {100 * share:.2g} % of the area")
    return points, np.vstack([faces, new]), share


def without_slivers(points: Floats, faces: Ints, notes: list[str]) -> Ints:
    """Give each face without area to its neighbour across the longest edge by flipping that edge.

    Its third corner lies on that edge; the flip splits the neighbour there. The surface stays as it is.
    """
    thin = int((heights(points, faces) < SLIVER_HEIGHT).sum())
    if thin == 0:
        return faces
    faces = faces.copy()
    for _ in range(4 * thin):
        flat = np.flatnonzero(heights(points, faces) < SLIVER_HEIGHT)
        if len(flat) == 0:
            break
        corners = faces[flat[0]]
        turn = int(np.linalg.norm(points[corners] - points[np.roll(corners, -1)], axis=1).argmax())
        a, b, c = np.roll(corners, -turn)  # a, b is the longest edge
        across = np.flatnonzero(((faces == b) & (np.roll(faces, -1, axis=1) == a)).any(axis=1))
        if len(across) == 0:
            break
        d = next(v for v in faces[across[0]] if v not in (a, b))
        faces[flat[0]], faces[across[0]] = (c, a, d), (b, c, d)
        same = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        if not same.all():  # d was c: the two faces were each other's back
            faces = faces[same]
    notes.append(f"flipped away {thin} faces without area")
    return faces


def with_volume(
    points: Floats, faces: Ints, shell: Ints, name: str, repair: bool, notes: list[str]
) -> tuple[Ints, Ints]:
    """Return faces and shells that enclose a volume; the others are refused, or dropped in repair."""
    normal = area_normals(points, faces)
    area = np.bincount(shell, np.linalg.norm(normal, axis=1) / 2)
    flat = np.abs(_shell_volumes(points, faces, shell)) <= FLAT_VOLUME * area**1.5
    if not flat.any():
        return faces, shell
    if flat.all() or not repair:
        raise GrainError(f"{name}: {flat.sum()} of {len(flat)} shells enclose no volume; remove flat sheets")
    notes.append(f"repair: dropped {flat.sum()} shells without volume")
    keep = ~flat[shell]
    return faces[keep], np.unique(shell[keep], return_inverse=True)[1]


def _shell_volumes(points: Floats, faces: Ints, shell: Ints) -> Floats:
    """Return the signed volume of each shell."""
    six = np.einsum("ij,ij->i", points[faces[:, 0]], np.cross(points[faces[:, 1]], points[faces[:, 2]]))
    return np.bincount(shell, six) / 6


def _winding_numbers(corners: Floats, points: Floats, most: int) -> tuple[Ints, int]:
    """Return (k,) how often closed, consistently wound triangles (m, 3, 3) wind about points (k, 3), and the effort.

    Crossings of the ray from each point along +z, signed by the winding of the triangle. Triangles are looked for in
    the cells of a grid over x and y, so that the effort, in pairs of a point and a triangle, grows with m + k, not
    m k; if it would be more than `most`, zeros are returned. The caller turns all by an odd angle, so that no ray
    meets an edge; the sides of an edge are told apart by the same rounded number from both of its triangles.
    """
    low = corners[:, :, :2].min(axis=(0, 1))
    width = np.maximum(corners[:, :, :2].max(axis=(0, 1)) - low, 1e-300)
    cells = int(np.sqrt(len(corners))) + 1
    while True:
        first, last = (
            np.clip(((f(corners[:, :, :2], axis=1) - low) / width * cells).astype(np.int64), 0, cells - 1)
            for f in (np.min, np.max)
        )
        span = last - first + 1
        if span.prod(axis=1).sum() <= MOST_PER_TRIANGLE * len(corners) or cells == 1:
            break
        cells = (cells + 1) // 2
    triangle, nth = _ranges(span.prod(axis=1))
    cell = (first[triangle, 0] + nth // span[triangle, 1]) * cells + first[triangle, 1] + nth % span[triangle, 1]
    triangle = triangle[np.argsort(cell, kind="stable")]
    held = np.bincount(cell, minlength=cells**2)
    begin = np.cumsum(held) - held
    at = ((points[:, :2] - low) / width * cells).astype(np.int64)
    beside = ((at < 0) | (at >= cells)).any(axis=1)
    at = np.where(beside, 0, at[:, 0] * cells + at[:, 1])
    found = np.zeros(len(points), np.int64)
    met = np.where(beside, 0, held[at])
    pairs = int(met.sum())
    if pairs > most:
        return found, pairs
    for some in np.split(np.arange(len(points)), np.flatnonzero(np.diff(np.cumsum(met) // PAIRS_AT_ONCE)) + 1):
        point, nth = _ranges(met[some])
        point = some[point]
        relative = corners[triangle[begin[at[point]] + nth]] - points[point][:, None]
        a, b, c = relative.swapaxes(0, 1)
        weights = np.array([u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] for u, v in ((b, c), (c, a), (a, b))])
        total = weights.sum(axis=0)
        above = (weights.T * relative[:, :, 2]).sum(axis=1) * np.sign(total) > 0
        crossed = ((weights > 0).all(axis=0) | (weights < 0).all(axis=0)) & above
        np.add.at(found, point[crossed], np.sign(total[crossed]).astype(np.int64))
    return found, pairs


def _ranges(lengths: Ints) -> tuple[Ints, Ints]:
    """Return for every element of ranges of these lengths the range it is of, and its place in it."""
    which = np.repeat(np.arange(len(lengths)), lengths)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def outward(points: Floats, faces: Ints, shell: Ints, name: str, place: Any, notes: list[str]) -> tuple[Ints, int]:
    """Return the faces with normals towards the void, and the number of solids."""
    if shell.max(initial=0) >= MOST_SHELLS:
        fault = f"{shell.max() + 1} shells, more than the {MOST_SHELLS} that are told apart"
        raise GrainError(f"{name}: {fault}; remove small parts")
    order = np.argsort(shell, kind="stable")
    groups = np.split(faces[order], np.cumsum(np.bincount(shell))[:-1])
    sides = np.array([[*points[g].min(axis=(0, 1)), *-points[g].max(axis=(0, 1))] for g in groups]).T.copy()
    sign = np.sign(_shell_volumes(points, faces, shell))
    # probes of each shell: not vertices, which may touch another shell
    probes = [points[group[:: max(1, len(group) // 8)]].mean(axis=1) @ ODDLY.T for group in groups]
    turned = points @ ODDLY.T
    around: list[list[int]] = [[] for _ in groups]  # the shells around each shell
    nested, left = 0, MOST_PAIRS
    for j, group in enumerate(groups):
        within = np.flatnonzero((sides >= sides[:, [j]]).all(axis=0))
        within = within[within != j]
        if len(within) == 0:
            continue
        some = [probes[i] for i in within]
        wound, pairs = _winding_numbers(turned[group], np.vstack(some), left)
        nested, left = nested + len(within), left - pairs
        if nested > MOST_NESTED or left < 0:
            fault = f"{len(groups)} shells inside the bounding boxes of others, more than can be told apart"
            raise GrainError(f"{name}: {fault}; remove inner shells")
        starts = np.cumsum([0] + [len(p) for p in some[:-1]])
        # probes that disagree mean shells that cross; check_crossings finds those
        for i in within[np.logical_and.reduceat(wound != 0, starts)]:
            around[i].append(j)
    depth = np.array([len(a) for a in around])
    turn = np.zeros(len(groups), bool)
    for i, outer in enumerate(around):
        root = min([*outer, i], key=lambda j: depth[j])
        turn[i] = sign[root] < 0
        if outer and sign[i] == sign[max(outer, key=lambda j: depth[j])]:
            where = f"a shell at {place(points[groups[i][0, 0]])} lies inside another of the same orientation"
            raise GrainError(f"{name}: {where}; flip the inner shell to make a cavity, or remove it")
    if turn.any():
        which = "" if turn.all() else f" of {turn.sum()} of {len(turn)} shells"
        notes.append(f"winding was inside out: turned over all faces{which}")
    bodies, cavities = int((depth % 2 == 0).sum()), int((depth % 2).sum())
    if bodies > 1:
        notes.append(f"{bodies} disjoint bodies")
    if cavities:
        notes.append(f"{cavities} {'cavity' if cavities == 1 else 'cavities'}")
    return np.where(turn[shell][:, None], faces[:, ::-1], faces), bodies


def mesh_hash(points: Floats, faces: Ints) -> str:
    """Return the hash defined under `Grain`."""
    places = np.rint(points * 1e6).astype(np.int64)
    order, new = _in_order(places)
    grid, rank = places[order[new]], np.empty(len(places), np.int64)
    rank[order] = np.cumsum(new) - 1
    corners = rank[faces]  # ranks of positions: their order is the order of the positions
    corners = np.take_along_axis(corners, (corners.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    corners = corners[np.lexsort(corners.T[::-1])]
    return hashlib.sha256(grid[corners].astype("<i4").tobytes()).hexdigest()


def bounding_sphere(points: ArrayLike) -> tuple[Floats, float]:
    """Return centre (3,) and radius of the smallest sphere around points.

    At most four of the points determine it. As in the simplex method, the point farthest outside joins the
    present support, and the smallest sphere of those five at most is found among all their subsets; the
    radius grows with each step, so the steps end. It is that of the farthest point, so that none is outside.
    (trimesh's `minimum_nsphere` is too large where two or three points determine the sphere.)

    Parameters
    ----------
    points : (n, 3) float
        At least one point.
    """
    cloud = np.asarray(points, np.float64)
    support = cloud[[int(((cloud - cloud.mean(axis=0)) ** 2).sum(axis=1).argmax())]]
    best, limit = (support[0], 0.0), len(cloud) + 100
    for _ in range(limit):
        distance = np.linalg.norm(cloud - best[0], axis=1)
        far = int(distance.argmax())
        if distance[far] <= best[1] * (1 + 1e-14):
            break
        centre, radius, chosen = _smallest_sphere(np.vstack([support, cloud[far]]))
        if radius <= best[1] * (1 + 1e-15):  # rounding: no better sphere can be told apart
            break
        best, support = (centre, radius), chosen
    return best[0], float(np.linalg.norm(cloud - best[0], axis=1).max())


def _smallest_sphere(points: Floats) -> tuple[Floats, float, Floats]:
    """Return centre, radius and supporting points of the smallest sphere around at most five points."""
    best = (points[0], np.inf, points[:1])
    for count in range(2, min(len(points), 4) + 1):
        for chosen in combinations(range(len(points)), count):
            corner, rest = points[chosen[0]], points[list(chosen[1:])] - points[chosen[0]]
            # the centre at equal distance from all, within their line or plane: the least-norm solution
            centre = corner + np.linalg.lstsq(2 * rest, (rest**2).sum(axis=1), rcond=1e-13)[0]
            reach = np.linalg.norm(points - centre, axis=1)
            radius = reach[list(chosen)].max()
            if radius < best[1] and reach.max() <= radius * (1 + 1e-13):
                best = (centre, float(radius), points[list(chosen)])
    return best
