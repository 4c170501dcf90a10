"""Grains: a file or the name of an exemplar becomes a clean closed triangle mesh, or a one-line error.

The only door to trimesh (file formats) and embreex (ray casting); both are imported inside functions. What a
grain is made of is `optics`, how it scatters is `tracer`, the built-in shapes are `exemplars`.
Convention: lengths in units of R, the radius of the minimal bounding sphere, whose centre is the origin;
facets are wound so that their geometric normal points from the material to the void, in cavities too.
"""

import hashlib
import logging
import warnings
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsdf.errors import GrainError, UsageError
from tsdf.exemplars import EXEMPLARS

BUILT_INS = ("sphere", *EXEMPLARS)

RAY_OFFSET = 1e-5  # [R] restart distance off a facet along its normal; design.md section 2
NEAR_WELD = 1e-6  # [R] vertices of open edges closer than this are one vertex
SLIVER_HEIGHT = 1e-9  # [R] a face less high than this has no area
FLAT_VOLUME = 1e-9  # volume / area^1.5 of a shell without volume; a sphere has 0.094
CONVEX_TOLERANCE = 1e-6  # [R] how far a vertex may stand before its neighbour's plane
LARGEST_COORDINATE = 1e100  # squares and products of coordinates must stay finite in float64
MODELLER = "use a modeller (Blender: Edit Mode, Mesh > Clean Up)"

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Grain:
    """One grain, normalised to its minimal bounding sphere.

    Attributes
    ----------
    kind : str
        ``"sphere"`` (the exact sphere; it has no mesh) or ``"mesh"``.
    name : str
        The exemplar's name or the file's base name.
    parameters : dict
        Every parameter of the exemplar, seed included; empty for files.
    vertices : (n, 3) float64
        Vertices [R]; the minimal bounding sphere has centre 0 and radius 1. Read-only.
    faces : (m, 3) int32
        Vertex indices, counter-clockwise seen from the void. Read-only.
    bounding_radius : float
        Radius of the minimal bounding sphere before normalisation [the file's unit].
    area, volume : float
        Surface area [R^2] and volume of the material [R^3], cavities' surface counted and their volume not.
    convex : bool
        One body without cavities, locally convex at every edge within 1e-6 R, and as large as its hull.
    bodies : int
        Number of separate solids.
    notes : tuple of str
        What was noticed or changed on the way in, one line each.
    mesh_hash : str
        SHA-256 of the normalised geometry, in hexadecimal: coordinates as integers of 1e-6 R, each triangle
        turned so that its smallest corner comes first, triangles sorted, written as little-endian int32. It
        does not depend on the order of vertices or faces, on scale or place (but for coordinates that lie
        on a rounding limit), nor on the last bits of an arithmetic unit. Of the exact sphere: of ``sphere``.
    """

    kind: str
    name: str
    parameters: dict[str, float | int]
    vertices: Floats
    faces: NDArray[np.int32]
    bounding_radius: float
    area: float
    volume: float
    convex: bool
    bodies: int
    notes: tuple[str, ...] = field(default=())
    mesh_hash: str = ""


class Crossings(NamedTuple):
    """What straight test rays met.

    ``share`` of them entered or left the material twice in a row, confirmed by shifted rays; ``leaks`` is the
    share that did so only once, grazing an edge; ``place`` (3,) float64 [R] is one confirmed point or zeros.
    """

    share: float
    leaks: float
    place: Floats


# ---------------------------------------------------------------------------------------------- loading


def load_grain(source: str | Path, repair: bool = False, **parameters: Any) -> Grain:
    """Return the grain named or stored in `source`.

    Parameters
    ----------
    source : str or Path
        ``"sphere"``, the name of an exemplar, or a mesh file (OBJ, PLY, STL, OFF, GLB and whatever else
        trimesh reads). A name wins over a file of that name; write ``./cube`` for the file.
    repair : bool
        Close holes before judging; see `grain_from_mesh`.
    **parameters
        Parameters of the exemplar (`tsdf.exemplars.EXEMPLARS`); none for files and the sphere.

    Raises
    ------
    GrainError
        The source does not exist, cannot be read, or is not a closed, simple surface.
    UsageError
        A parameter is unknown or out of range.
    """
    name = str(source)
    if name in EXEMPLARS:
        values = EXEMPLARS[name].resolve(parameters)
        vertices, faces = EXEMPLARS[name].build(**values)
        return grain_from_mesh(vertices, faces, name=name, repair=repair, parameters=values)
    if parameters:
        raise UsageError(f"{name}: takes no parameters, got {', '.join(parameters)}")
    if name == "sphere":
        digest = hashlib.sha256(b"sphere").hexdigest()
        nothing, none = np.empty((0, 3)), np.empty((0, 3), np.int32)
        area, volume = 4 * np.pi, 4 * np.pi / 3
        return Grain("sphere", name, {}, nothing, none, 1.0, area, volume, True, 1, (), digest)
    vertices, faces = _read_mesh(Path(source))
    return grain_from_mesh(vertices, faces, name=Path(source).name, repair=repair)


def _read_mesh(path: Path) -> tuple[NDArray, NDArray]:
    """Return all triangles of a file, placed as its scene places them, with nothing merged yet."""
    try:
        if not path.exists():
            built_ins = ", ".join(BUILT_INS)
            raise GrainError(f"{path}: neither a file nor a built-in grain; built-in grains are {built_ins}")
        if path.is_dir():
            raise GrainError(f"{path}: is a directory; name a mesh file in it")
        if path.stat().st_size == 0:
            raise GrainError(f"{path}: is empty; export the mesh again")
        geometries = _trimesh_geometries(path)
    except GrainError:
        raise
    except (
        ImportError
    ):  # of charset_normalizer, lxml, ...: trimesh's optional modules, or a damaged text file
        reason = "damaged, or of a kind this installation cannot read"
        raise GrainError(f"{path}: {reason}; export it as OBJ, PLY, STL or GLB") from None
    except Exception as error:  # trimesh's loaders raise whatever their parsing runs into
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        way_out = "export it as OBJ, PLY, STL or GLB"
        raise GrainError(f"{path}: cannot be read as a mesh ({reason}); {way_out}") from None
    meshes = [
        (np.asarray(g.vertices), np.asarray(g.faces)) for g in geometries if len(getattr(g, "faces", ()))
    ]
    if not meshes:
        what = "points or lines but no faces" if geometries else "no mesh"
        raise GrainError(f"{path}: holds {what}; a grain is a closed triangle mesh")
    starts = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    return np.vstack([v for v, _ in meshes]), np.vstack(
        [f + s for (_, f), s in zip(meshes, starts, strict=True)]
    )


def _trimesh_geometries(path: Path) -> list:
    """Return trimesh's geometries of a file, their scene's transforms applied, without a word of its own."""
    import trimesh

    kind = path.suffix[1:].lower()
    log = logging.getLogger("trimesh")
    silenced, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            if kind in ("obj", "off"):  # text whose comments may be in any encoding; materials are not needed
                with path.open(encoding="utf-8", errors="replace") as text:
                    scene = trimesh.load_scene(text, file_type=kind, process=False)
            else:
                # process=False: trimesh would merge vertices within 1e-8, wrong for grains of size 1e-6
                scene = trimesh.load_scene(str(path), process=False)
            return list(scene.dump())
    finally:
        log.disabled = silenced


# ------------------------------------------------------------------------------------- from mesh to grain


def grain_from_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    name: str = "mesh",
    repair: bool = False,
    kind: str = "mesh",
    parameters: Mapping[str, float | int] | None = None,
) -> Grain:
    """Return the grain bounded by a triangle mesh: cleaned, oriented, normalised and checked.

    Vertices at equal places are welded; if the mesh is then open, vertices of open edges within 1e-6 R are
    welded too. Faces without area and duplicate faces are removed. Winding is made consistent and outward. A
    shell inside another is a cavity if it is wound the other way. Each of these changes leaves a note.

    Parameters
    ----------
    vertices : (n, 3) float
        Vertices in any unit, anywhere.
    faces : (m, 3) int
        Vertex indices.
    name : str
        What errors and the grain are called.
    repair : bool
        Close holes by a triangle, or by a fan about the centroid of the rim, and drop shells without volume.
    kind : str
        Recorded as given.
    parameters : mapping, optional
        Recorded as given.

    Raises
    ------
    GrainError
        Coordinates that are not finite, no faces, open or non-manifold edges, no consistent winding, no
        volume, shells nested with equal orientation, or a surface that crosses itself.
    """
    points, triangles = _checked_arrays(vertices, faces, name)
    notes: list[str] = []
    points, triangles = _compact(points, triangles)
    low, high = points.min(axis=0), points.max(axis=0)
    centre, scale = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    if not scale > 0:
        raise GrainError(f"{name}: all vertices are at one place; a grain must enclose a volume")

    def place(point: Floats) -> str:
        """Coordinates in the file's unit."""
        return "({:.5g}, {:.5g}, {:.5g})".format(*(centre + scale * point))

    points = (points - centre) / scale
    points, triangles = _compact(points, _equal_vertices(points)[triangles])
    points, triangles = _closed_faces(points, triangles, notes)

    half, edge, uses = _half_edges(triangles)
    if (uses > 2).any():
        worst = half[np.flatnonzero(uses[edge] > 2)[0]]
        fault = f"{(uses > 2).sum()} edges are shared by more than two faces, one at "
        way_out = f"remove inner walls and doubled parts: {MODELLER}"
        raise GrainError(f"{name}: {fault}{place(points[worst].mean(axis=0))}; {way_out}")
    triangles, shell = _oriented(triangles, name, notes)
    open_edges = int((uses == 1).sum())
    if open_edges:
        if not repair:
            where = place(points[half[np.flatnonzero(uses[edge] == 1)[0]]].mean(axis=0))
            way_out = "close the holes or pass --repair"
            raise GrainError(f"{name}: not closed: {open_edges} boundary edges, one at {where}; {way_out}")
        points, triangles = _filled(points, triangles, notes)
    triangles = _without_slivers(points, triangles, notes)
    half, edge, uses = _half_edges(triangles)
    if len(triangles) == 0 or (uses != 2).any():
        raise GrainError(f"{name}: {(uses != 2).sum()} edges cannot be closed; {MODELLER}")

    triangles, shell = _oriented(triangles, name, notes)
    triangles, shell = _with_volume(points, triangles, shell, name, repair, notes)
    triangles, bodies = _outward(points, triangles, shell, name, place, notes)

    points, triangles = _compact(points, triangles)
    middle, radius = bounding_sphere(points)
    points = (points - middle) / radius
    centre, scale = centre + scale * middle, scale * radius
    normal = _area_normals(points, triangles)
    area = 0.5 * float(np.linalg.norm(normal, axis=1).sum())
    volume = float(np.einsum("ij,ij->", points[triangles[:, 0]], normal)) / 6
    points.setflags(write=False)
    (corners := triangles.astype(np.int32)).setflags(write=False)
    grain = Grain(
        kind,
        name,
        dict(parameters or {}),
        points,
        corners,
        float(scale),
        area,
        volume,
        _is_convex(points, triangles, area, volume),
        bodies,
        tuple(notes),
        _mesh_hash(points, triangles),
    )
    crossings = check_crossings(grain, rays=20_000 if grain.convex else 200_000)
    if crossings.share > 0:
        where = f"{crossings.share:.2g} of test rays enter or leave it twice in a row, one at "
        way_out = "unite overlapping parts (Blender: Boolean or Remesh modifier) or thicken thin walls"
        fault = f"the surface crosses itself, or walls or gaps are thinner than {RAY_OFFSET:g} R"
        raise GrainError(f"{name}: {fault}: {where}{place(crossings.place)}; {way_out}")
    return grain


def _checked_arrays(vertices: ArrayLike, faces: ArrayLike, name: str) -> tuple[Floats, Ints]:
    """Return float64 vertices and int64 faces fit for indexing."""
    try:
        points = np.asarray(vertices, np.float64)
        triangles = np.asarray(faces)
    except (TypeError, ValueError):
        raise GrainError(f"{name}: vertices and faces are not arrays of numbers") from None
    if triangles.size == 0 or points.size == 0:
        raise GrainError(f"{name}: has no faces; a grain is a closed triangle mesh")
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise GrainError(
            f"{name}: vertices {points.shape} and faces {triangles.shape} must be (n, 3), (m, 3)"
        )
    bad = np.flatnonzero(~(np.abs(points) < LARGEST_COORDINATE).all(axis=1))
    if len(bad):
        fault = f"vertex {bad[0]} (counted from 0) is not a finite position: {points[bad[0]].tolist()}"
        raise GrainError(f"{name}: {fault}; {len(bad)} such vertices, remove them")
    if triangles.dtype.kind not in "iu" or triangles.min() < 0 or triangles.max() >= len(points):
        raise GrainError(f"{name}: faces must be integers from 0 to {len(points) - 1}; export the mesh again")
    return points, triangles.astype(np.int64)


def _compact(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Drop vertices that no face uses."""
    used, index = np.unique(faces, return_inverse=True)
    return points[used], index.reshape(-1, 3)


def _equal_vertices(points: Floats) -> Ints:
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


def _half_edges(faces: Ints) -> tuple[Ints, Ints, Ints]:
    """Return directed edges (3m, 2), face by face, the undirected edge (3m,) of each, and its uses."""
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key = half.min(axis=1) * (faces.max(initial=0) + 1) + half.max(axis=1)
    _, edge, uses = np.unique(key, return_inverse=True, return_counts=True)
    return half, edge, uses


def _edge_pairs(edge: Ints, uses: Ints) -> Ints:
    """Return (k, 2) the two half-edges of every edge that has exactly two."""
    order = np.argsort(edge, kind="stable")
    return order[uses[edge[order]] == 2].reshape(-1, 2)


def _area_normals(points: Floats, faces: Ints) -> Floats:
    """Return (m, 3) normals, as long as twice the area."""
    a, b, c = points[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def _heights(points: Floats, faces: Ints) -> Floats:
    """Return (m,) the height of each face over its longest edge."""
    longest = np.linalg.norm(points[faces] - points[np.roll(faces, -1, axis=1)], axis=2).max(axis=1)
    return np.linalg.norm(_area_normals(points, faces), axis=1) / np.maximum(longest, 1e-300)


def _closed_faces(points: Floats, faces: Ints, notes: list[str]) -> tuple[Floats, Ints]:
    """Remove collapsed and duplicate faces; weld near vertices if that leaves fewer open edges."""

    def distinct(faces: Ints) -> tuple[Ints, int, int]:
        real = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        kept = np.sort(np.unique(np.sort(real, axis=1), axis=0, return_index=True)[1])
        return real[kept], len(faces) - len(real), len(real) - len(kept)

    def defects(faces: Ints) -> int:
        return int((_half_edges(faces)[2] != 2).sum())

    clean, collapsed, doubled = distinct(faces)
    half, edge, uses = _half_edges(clean)
    if (uses == 1).any():
        rim = np.unique(half[uses[edge] == 1])
        first = _near_vertices(points, rim)
        welded, more, again = distinct(first[clean])
        if (_half_edges(welded)[2] == 1).sum() < (uses == 1).sum():
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


def _oriented(faces: Ints, name: str, notes: list[str]) -> tuple[Ints, Ints]:
    """Return the faces consistently wound, and the shell (m,) each belongs to.

    Each face stands twice in a graph, as it is and turned over; neighbours are joined in the states that
    agree. A shell is then two components, one for each side, or one if the surface has one side only.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    m = len(faces)
    half, edge, uses = _half_edges(faces)
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


def _filled(points: Floats, faces: Ints, notes: list[str]) -> tuple[Floats, Ints]:
    """Close every hole of consistently wound faces: three edges by a face, more by a fan."""
    half, edge, uses = _half_edges(faces)
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


def _without_slivers(points: Floats, faces: Ints, notes: list[str]) -> Ints:
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


def _with_volume(
    points: Floats, faces: Ints, shell: Ints, name: str, repair: bool, notes: list[str]
) -> tuple[Ints, Ints]:
    """Return faces and shells that enclose a volume; the others are refused, or dropped in repair."""
    normal = _area_normals(points, faces)
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
    return float(np.arctan2(triple, la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb).sum()) / (
        2 * np.pi
    )


def _outward(
    points: Floats, faces: Ints, shell: Ints, name: str, place: Any, notes: list[str]
) -> tuple[Ints, int]:
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
        around.append(
            [j for j, c in corners.items() if all(abs(_winding_number(c, p)) > 0.5 for p in probes)]
        )
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


def _is_convex(points: Floats, faces: Ints, area: float, volume: float) -> bool:
    """Tell whether a mesh is convex: no neighbour before a face's plane, the size of its hull."""
    from scipy.spatial import ConvexHull, QhullError

    half, edge, uses = _half_edges(faces)
    first, second = _edge_pairs(edge, uses).T
    normal = _area_normals(points, faces)
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


def _mesh_hash(points: Floats, faces: Ints) -> str:
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


# ------------------------------------------------------------------------------------------- ray casting


def embree_scene(grain: Grain) -> Any:
    """Return the robust Embree scene of a grain's mesh (float32, geometry 0, primitive = face index).

    Raises
    ------
    GrainError
        The grain has no mesh, or one that Embree must not be given: it reads out of bounds without a word.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    vertices = np.array(grain.vertices, np.float32, order="C")
    faces = np.array(grain.faces, np.int32, order="C")
    if len(faces) == 0 or vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise GrainError(f"{grain.name}: has no triangle mesh to cast rays at")
    if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise GrainError(f"{grain.name}: the mesh is damaged; make it by grain_from_mesh")
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)  # copied into the scene, which owns it
    return scene


def first_hit(scene: Any, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.int32]:
    """Return (n,) int32 the face each ray meets first, −1 where it meets none.

    Parameters
    ----------
    scene : EmbreeScene
        From `embree_scene`.
    origins, directions : (n, 3) float
        Rounded to float32. Embree's distances are not returned: their last bits differ between processors, so
        the hit is to be found in float64 from the plane of the face.

    Raises
    ------
    ValueError
        Shapes that would make embreex read out of bounds, or values that are not finite.
    """
    start = np.ascontiguousarray(origins, np.float32)
    along = np.ascontiguousarray(directions, np.float32)
    if start.ndim != 2 or start.shape[1] != 3 or start.shape != along.shape:
        raise ValueError(f"origins {start.shape} and directions {along.shape} must both be (n, 3)")
    if not (np.isfinite(start).all() and np.isfinite(along).all()):
        raise ValueError("origins and directions must be finite")
    return scene.run(start, along) if len(start) else np.empty(0, np.int32)


def self_intersection_share(grain: Grain, rays: int = 200_000, seed: int = 0) -> float:
    """Return the share of test rays that prove that the surface crosses itself; see `check_crossings`."""
    return check_crossings(grain, rays, seed).share


def check_crossings(grain: Grain, rays: int = 200_000, seed: int = 0) -> Crossings:
    """Return how straight rays cross the surface, which must be void, material, void, and so on to void.

    Half the rays are uniform and isotropic through the bounding sphere; the other half are aimed from all
    sides at random points of random faces, to find small crossings of finely meshed parts. After each hit a
    ray goes on from `RAY_OFFSET` beyond the facet. A ray that breaks the rule near an edge may be a fluke, so
    it is repeated four times, shifted sideways by 1e-4 R, and counts if three of these break it as well.

    Parameters
    ----------
    grain : Grain
        With a mesh; the exact sphere has nothing to cross.
    rays : int
        Number of rays.
    seed : int
        Of the random numbers.
    """
    if len(grain.faces) == 0:
        return Crossings(0.0, 0.0, np.zeros(3))
    rng = np.random.default_rng(seed)
    scene = embree_scene(grain)
    direction = rng.normal(size=(rays, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    aim = rng.normal(size=(rays, 3))  # uniform in the ball, then pressed onto the disc across the ray
    side = np.cross(direction, aim)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    aim = side * np.sqrt(rng.random((rays, 1)))
    aimed = rays // 2
    weights = rng.dirichlet((1, 1, 1), aimed)
    aim[:aimed] = np.einsum(
        "ij,ijk->ik", weights, grain.vertices[grain.faces[rng.integers(len(grain.faces), size=aimed)]]
    )
    origin = aim - 2.5 * direction
    bad, point = _broken_rays(grain, scene, origin, direction)
    suspect = np.flatnonzero(bad)
    again = np.repeat(suspect, 4)
    shift = np.cross(direction[again], rng.normal(size=(len(again), 3)))
    shift *= 1e-4 / np.linalg.norm(shift, axis=1, keepdims=True)
    repeated, _ = _broken_rays(grain, scene, origin[again] + shift, direction[again])
    confirmed = suspect[repeated.reshape(-1, 4).sum(axis=1) >= 3]
    place = point[confirmed[0]] if len(confirmed) else np.zeros(3)
    return Crossings(len(confirmed) / rays, (len(suspect) - len(confirmed)) / rays, place)


def _broken_rays(
    grain: Grain, scene: Any, origin: Floats, direction: Floats
) -> tuple[NDArray[np.bool_], Floats]:
    """Return which rays do not enter and leave in turn, and where each ray was last."""
    along = direction.astype(np.float32).astype(np.float64)  # the ray Embree sees
    at = origin.astype(np.float32).astype(np.float64)
    faces = grain.faces.astype(np.int64)
    normal = _area_normals(grain.vertices, faces)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = np.einsum("ij,ij->i", normal, grain.vertices[faces[:, 0]])
    inside, bad = np.zeros(len(at), bool), np.zeros(len(at), bool)
    active = np.arange(len(at))
    while len(active):
        face = first_hit(scene, at[active], along[active])
        missed = active[face < 0]
        bad[missed] = inside[missed]
        active, face = active[face >= 0], face[face >= 0]
        n, d = normal[face], along[active]
        slope = np.einsum("ij,ij->i", d, n)
        leaving = slope > 0
        bad[active] = (inside[active] != leaving) | (np.abs(slope) < 1e-7)
        inside[active] = ~leaving
        step = (level[face] - np.einsum("ij,ij->i", at[active], n)) / np.where(slope == 0, 1.0, slope)
        beyond = at[active] + step[:, None] * d + np.copysign(RAY_OFFSET, slope)[:, None] * n
        at[active] = beyond.astype(np.float32)
        active = active[~bad[active] & (np.abs(beyond) < 4).all(axis=1)]
    return bad, at
