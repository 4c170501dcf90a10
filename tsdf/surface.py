"""Closed surfaces: weld, close, orient and judge the triangles of a grain, and find their minimal bounding sphere.

Geometry on arrays of points and faces, with numpy and scipy alone. Where the arrays come from and what is made of them
is `grains`. Lengths are in units of about R, so that tolerances mean the same for a grain of any size.
"""

import hashlib
from collections import defaultdict
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsdf.errors import GrainError

NEAR_WELD = 1e-6  # [R] vertices of open edges closer than this are one vertex
SLIVER_HEIGHT = 1e-9  # [R] a face less high than this has no area
FLAT_VOLUME = 1e-9  # volume / area^1.5 of a shell without volume; a sphere has 0.094
CONVEX_TOLERANCE = 1e-6  # [R] how far a vertex may stand before its neighbour's plane
MODELLER = "use a modeller (Blender: Edit Mode, Mesh > Clean Up)"

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def compact(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Drop vertices that no face uses."""
    used, index = np.unique(faces, return_inverse=True)
    return points[used], index.reshape(-1, 3)


def equal_vertices(points: Floats) -> Ints:
    """Return for each vertex the first vertex at exactly its position."""
    order = np.lexsort(points.T)  # stable: the first of equals stays first
    new = np.r_[True, (np.diff(points[order], axis=0) != 0).any(axis=1)]
    first = np.empty(len(points), np.int64)
    first[order] = order[new][np.cumsum(new) - 1]
    return first


def _near_vertices(points: Floats, among: Ints) -> Ints:
    """Return for each vertex the first one within `NEAR_WELD` of it, linked through vertices `among` only."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = among[cKDTree(points[among]).query_pairs(NEAR_WELD, output_type="ndarray")]
    n = len(points)
    _, label = connected_components(coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n, n)))
    return np.unique(label, return_index=True)[1][label]


def half_edges(faces: Ints) -> tuple[Ints, Ints, Ints]:
    """Return directed edges (3m, 2), face by face, the undirected edge (3m,) of each, and its uses."""
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key = half.min(axis=1) * (faces.max(initial=0) + 1) + half.max(axis=1)
    _, edge, uses = np.unique(key, return_inverse=True, return_counts=True)
    return half, edge, uses


def _edge_pairs(edge: Ints, uses: Ints) -> Ints:
    """Return (k, 2) the two half-edges of every edge that has exactly two."""
    order = np.argsort(edge, kind="stable")
    return order[uses[edge[order]] == 2].reshape(-1, 2)


def area_normals(points: Floats, faces: Ints) -> Floats:
    """Return (m, 3) normals, as long as twice the area."""
    a, b, c = points[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def _heights(points: Floats, faces: Ints) -> Floats:
    """Return (m,) the height of each face over its longest edge."""
    longest = np.linalg.norm(points[faces] - points[np.roll(faces, -1, axis=1)], axis=2).max(axis=1)
    return np.linalg.norm(area_normals(points, faces), axis=1) / np.maximum(longest, 1e-300)


def closed_faces(points: Floats, faces: Ints, notes: list[str]) -> tuple[Floats, Ints]:
    """Remove collapsed and duplicate faces; weld near vertices if that leaves fewer open edges."""

    def distinct(faces: Ints) -> tuple[Ints, int, int]:
        real = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        kept = np.sort(np.unique(np.sort(real, axis=1), axis=0, return_index=True)[1])
        return real[kept], len(faces) - len(real), len(real) - len(kept)

    def defects(faces: Ints) -> int:
        return int((half_edges(faces)[2] != 2).sum())

    clean, collapsed, doubled = distinct(faces)
    half, edge, uses = half_edges(clean)
    if (uses == 1).any():
        rim = np.unique(half[uses[edge] == 1])
        first = _near_vertices(points, rim)
        welded, more, again = distinct(first[clean])
        if (half_edges(welded)[2] == 1).sum() < (uses == 1).sum():
            count = int((first != np.arange(len(points))).sum())
            notes.append(f"welded {count} vertices of open edges within {NEAR_WELD:g} R")
            clean, collapsed, doubled = welded, collapsed + more, doubled + again
    # Faces without area that hang on a closed surface go; those that are part of it are flipped away later.
    flat = _heights(points, clean) < SLIVER_HEIGHT
    if flat.any() and defects(clean[~flat]) < max(defects(clean), 1):
        clean, collapsed = clean[~flat], collapsed + int(flat.sum())
    if collapsed:
        notes.append(f"removed {collapsed} degenerate faces")
    if doubled:
        notes.append(f"removed {doubled} duplicate faces")
    return points, clean


def oriented(faces: Ints, name: str, notes: list[str]) -> tuple[Ints, Ints]:
    """Return the faces consistently wound, and the shell (m,) each belongs to.

    Each face stands twice in a graph, as it is and turned over; neighbours are joined in the states that
    agree. A shell is then two components, one for each side, or one if the surface has one side only.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    m = len(faces)
    half, edge, uses = half_edges(faces)
    first, second = _edge_pairs(edge, uses).T
    alike = half[first, 0] == half[second, 0]  # both run along the edge in one direction: one must turn over
    f, g = first // 3, second // 3
    rows, columns = np.r_[f, f + m], np.r_[g + m * alike, g + m * ~alike]
    _, label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), (2 * m, 2 * m)))
    kept, turned = label[:m], label[m:]
    if (kept == turned).any():
        raise GrainError(f"{name}: no consistent winding exists: the surface has one side only; {MODELLER}")
    shell = np.unique(np.minimum(kept, turned), return_inverse=True)[1]
    flip = kept > turned
    mostly = np.bincount(shell, flip) * 2 > np.bincount(shell)
    flip ^= mostly[shell]
    if flip.any():
        notes.append(f"turned over {flip.sum()} inconsistently wound faces")
    return np.where(flip[:, None], faces[:, ::-1], faces), shell


def filled(points: Floats, faces: Ints, notes: list[str]) -> tuple[Floats, Ints]:
    """Close every hole of consistently wound faces: three edges by a face, more by a fan."""
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
    notes.append(f"repair: closed {len(loops)} holes of {(uses == 1).sum()} edges with {len(added)} faces")
    return np.vstack([points, *centres]), np.vstack([faces, np.array(added, np.int64).reshape(-1, 3)])


def without_slivers(points: Floats, faces: Ints, notes: list[str]) -> Ints:
    """Give each face without area to its neighbour across the longest edge by flipping that edge.

    Its third corner lies on that edge; the flip splits the neighbour there. The surface stays as it is.
    """
    thin = int((_heights(points, faces) < SLIVER_HEIGHT).sum())
    faces = faces.copy()
    for _ in range(4 * thin):
        flat = np.flatnonzero(_heights(points, faces) < SLIVER_HEIGHT)
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
    if thin:
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


def _winding_number(corners: Floats, point: Floats) -> float:
    """Return how often triangles (m, 3, 3) wind about a point: the sum of signed solid angles over 4 pi [1].

    [1] A. Van Oosterom and J. Strackee, IEEE Trans. Biomed. Eng. BME-30 (1983) 125, eq. 8.
    """
    a, b, c = (corners - point).swapaxes(0, 1)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    return float(np.arctan2(triple, la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb).sum()) / (2 * np.pi)


def outward(points: Floats, faces: Ints, shell: Ints, name: str, place: Any, notes: list[str]) -> tuple[Ints, int]:
    """Return the faces with normals towards the void, and the number of solids."""
    order = np.argsort(shell, kind="stable")
    groups = np.split(faces[order], np.cumsum(np.bincount(shell))[:-1])
    low = np.array([points[g].min(axis=(0, 1)) for g in groups])
    high = np.array([points[g].max(axis=(0, 1)) for g in groups])
    sign = np.sign(_shell_volumes(points, faces, shell))
    around: list[list[int]] = []  # the shells around each shell
    for i, group in enumerate(groups):
        boxes = np.flatnonzero((low <= low[i]).all(axis=1) & (high >= high[i]).all(axis=1))
        probes = points[np.unique(group)[:: max(1, len(group) // 8)]]
        corners = {int(j): points[groups[j]] for j in boxes if j != i}
        # probes that disagree mean shells that cross; check_crossings finds those
        around.append([j for j, c in corners.items() if all(abs(_winding_number(c, p)) > 0.5 for p in probes)])
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


def is_convex(points: Floats, faces: Ints, area: float, volume: float) -> bool:
    """Tell whether a mesh is convex: no neighbour before a face's plane, the size of its hull."""
    from scipy.spatial import ConvexHull, QhullError

    half, edge, uses = half_edges(faces)
    first, second = _edge_pairs(edge, uses).T
    normal = area_normals(points, faces)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beyond = faces[second // 3, (second % 3 + 2) % 3]  # the neighbour's vertex off the common edge
    height = np.einsum("ij,ij->i", normal[first // 3], points[beyond] - points[half[first, 0]])
    if height.max() > CONVEX_TOLERANCE:
        return False
    try:
        hull = ConvexHull(points)
    except QhullError:
        return False
    return abs(hull.volume - volume) < CONVEX_TOLERANCE and abs(hull.area - area) < 10 * CONVEX_TOLERANCE


def mesh_hash(points: Floats, faces: Ints) -> str:
    """Return the hash defined under `Grain`."""
    grid, index = np.unique(np.rint(points * 1e6).astype(np.int64), axis=0, return_inverse=True)
    corners = index.reshape(-1)[faces]  # ranks of positions: their order is the order of the positions
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
