"""Grains: a file or the name of an exemplar becomes a clean closed triangle mesh, or a one-line error.

The only door to embreex (ray casting), imported inside functions. Which files are read is `meshes`; what a grain is
made of is `optics`, how it scatters is `tracer`, the built-in shapes are `exemplars`.
Convention: lengths in units of R, the radius of the minimal bounding sphere, whose centre is the origin;
facets are wound so that their geometric normal points from the material to the void, in cavities too.
"""

import hashlib
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsdf.errors import GrainError, UsageError
from tsdf.grain.exemplars import EXEMPLARS
from tsdf.grain.meshes import read_mesh
from tsdf.grain.rounding import Steps, grid_steps, grid_tilt, is_convex
from tsdf.grain.surface import (
    MODELLER,
    Floats,
    Ints,
    area_normals,
    bounding_sphere,
    closed_faces,
    compact,
    filled,
    first_of_equals,
    half_edges,
    mesh_hash,
    oriented,
    outward,
    parted,
    with_volume,
    without_slivers,
)

BUILT_INS = ("sphere", *EXEMPLARS)

MOST_TILT = (
    0.01  # [rad] of facets by rounding; icospheres of ice: 0.015 moves g by -0.0009, 0.038 by -0.005, 0.15 by -0.046
)
MOST_REPAIRED = 0.1  # share of the surface that closing holes may make without being asked
RAY_OFFSET = 1e-5  # [R] restart distance off a facet along its normal: 1e-7 to 1e-4 leave no self-hits
RAYS_AT_ONCE = 8192  # test rays that a thread follows together
LARGEST_COORDINATE = 1e100  # squares and products of coordinates must stay finite in float64


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
    centre : (3,) float64
        Its centre before normalisation [the file's unit].
    area, volume : float
        Surface area [R^2] and volume of the material [R^3], cavities' surface counted and their volume not.
    convex : bool
        One body of which no vertex stands further before the plane of a face than 1e-6 R and what the digits of the
        file's coordinates explain; see `tsdf.grain.rounding.is_convex`.
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
    centre: Floats = field(default_factory=lambda: np.zeros(3))


class Crossings(NamedTuple):
    """What straight test rays met.

    ``share`` of them entered or left the material twice in a row, confirmed by shifted rays; ``leaks`` is the
    share that did so only once, grazing an edge; ``place`` (3,) float64 [R] is one confirmed point or zeros;
    ``touching`` tells that void closer than `RAY_OFFSET` lies between facets there: bodies touch.
    """

    share: float
    leaks: float
    place: Floats
    touching: bool = False


# ---------------------------------------------------------------------------------------------- loading


def load_grain(source: str | Path, repair: bool | Literal["any"] = False, **parameters: Any) -> Grain:
    """Return the grain named or stored in `source`.

    Parameters
    ----------
    source : str or Path
        ``"sphere"``, the name of an exemplar, or a mesh file (`tsdf.grain.meshes.READERS`). A
        name wins over a file of that name; write ``./cube`` for the file.
    repair : bool or "any"
        Close holes before judging; see `grain_from_mesh`.
    **parameters
        Parameters of the exemplar (`tsdf.grain.exemplars.EXEMPLARS`); none for files and the sphere.

    Raises
    ------
    GrainError
        The source does not exist, cannot be read, or is not a closed, simple surface.
    UsageError
        A parameter is unknown or out of range.

    Examples
    --------
    >>> import tsdf
    >>> grain = tsdf.load_grain("hexprism", aspect=2.0)
    >>> grain.kind, grain.faces.shape, grain.convex
    ('mesh', (20, 3), True)
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
    if not os.path.exists(name):
        near = get_close_matches(name.lower(), BUILT_INS, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise GrainError(
            f"{name}: neither a file nor a built-in grain; {hint}built-in grains are {', '.join(BUILT_INS)}"
        )
    if name.lower().endswith(".toml"):
        raise GrainError(f"{name}: is a scene, which tsdf-render and tsdf-plan take; name a grain")
    vertices, faces = read_mesh(Path(source))
    return grain_from_mesh(vertices, faces, name=Path(source).name, repair=repair)


# ------------------------------------------------------------------------------------- from mesh to grain


def grain_from_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    name: str = "mesh",
    repair: bool | Literal["any"] = False,
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
    repair : bool or "any"
        Close holes by a triangle, or by a fan about the centroid of the rim, and drop shells without volume; refused
        if that would make more than a tenth of the surface, unless "any".
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
    points, triangles = compact(points, triangles)
    steps = grid_steps(points)
    low, high = points.min(axis=0), points.max(axis=0)
    centre, scale = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    if not scale > 0:
        raise GrainError(f"{name}: all vertices are at one place; a grain must enclose a volume")

    def place(point: Floats) -> str:
        """Coordinates in the file's unit."""
        return "({:.5g}, {:.5g}, {:.5g})".format(*(centre + scale * point))

    points = (points - centre) / scale
    points, triangles = compact(points, first_of_equals(points)[triangles])
    points, triangles, edges = closed_faces(points, triangles, notes)
    points, triangles, edges = parted(points, triangles, edges, name, place, notes)
    half, edge, uses = edges
    triangles, shell = oriented(triangles, edges, name, notes)
    open_edges = int((uses == 1).sum())
    if open_edges:
        if not repair:
            where = place(points[half[np.flatnonzero(uses[edge] == 1)[0]]].mean(axis=0))
            way_out = "close the holes or pass --repair"
            raise GrainError(f"{name}: not closed: {open_edges} boundary edges, one at {where}; {way_out}")
        points, triangles, share = filled(points, triangles, notes)
        if share > MOST_REPAIRED and repair != "any":
            fault = f"closing its holes would make {100 * share:.2g} % of the surface, more than a tenth"
            raise GrainError(f"{name}: {fault}; complete the mesh, or pass --repair-any to close them all the same")
    even = without_slivers(points, triangles, notes)
    changed = open_edges > 0 or even is not triangles
    triangles = even
    if changed:
        edges = half_edges(triangles)
    if len(triangles) == 0 or (edges.uses != 2).any():
        raise GrainError(f"{name}: {(edges.uses != 2).sum()} edges cannot be closed; {MODELLER}")
    if changed:
        triangles, shell = oriented(triangles, edges, name, notes)
    triangles, shell = with_volume(points, triangles, shell, name, bool(repair), notes)
    triangles, bodies = outward(points, triangles, shell, name, place, notes)

    points, triangles = compact(points, triangles)
    middle, radius = bounding_sphere(points)
    points = (points - middle) / radius
    centre, scale = centre + scale * middle, scale * radius
    tilt = grid_tilt(points, triangles, Steps(steps.digits / scale, steps.axes / scale))
    if tilt.angle > MOST_TILT:
        which = "" if tilt.axes == "xyz" else " and ".join(tilt.axes) + " "
        grid = f"{100 * tilt.step:.2g} % of R ({tilt.step * scale:.2g} in the file)"
        fault = f"{which}coordinates stand on a grid of {grid}"
        effect = f"its facets are tilted by about {np.degrees(tilt.angle):.2g} degrees, as if rough"
        notes.append(f"{fault}: {effect}; export with more digits, in a smaller unit or nearer to the origin")
    normal = area_normals(points, triangles)
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
        bodies == 1 and is_convex(points, triangles, steps.common / 2 / scale),
        bodies,
        tuple(notes),
        mesh_hash(points, triangles),
        centre,
    )
    crossings = check_crossings(grain, rays=20_000 if grain.convex else 200_000)
    if crossings.share > 0:
        where = f"{crossings.share:.2g} of test rays enter or leave it twice in a row, one at "
        way_out = "unite overlapping parts (Blender: Boolean or Remesh modifier) or thicken thin walls"
        fault = f"the surface crosses itself, or walls or gaps are thinner than {RAY_OFFSET:g} R"
        if crossings.touching:
            fault = f"bodies touch over a face, or gaps are thinner than {RAY_OFFSET:g} R"
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
        raise GrainError(f"{name}: vertices {points.shape} and faces {triangles.shape} must be (n, 3), (m, 3)")
    bad = np.flatnonzero(~(np.abs(points) < LARGEST_COORDINATE).all(axis=1))
    if len(bad):
        fault = f"vertex {bad[0]} (counted from 0) is not a finite position: {points[bad[0]].tolist()}"
        raise GrainError(f"{name}: {fault}; {len(bad)} such vertices, remove them")
    if triangles.dtype.kind not in "iu" or triangles.min() < 0 or triangles.max() >= len(points):
        raise GrainError(f"{name}: faces must be integers from 0 to {len(points) - 1}; export the mesh again")
    return points, triangles.astype(np.int64)


# ------------------------------------------------------------------------------------------- ray casting


def embree_scene(grain: Grain) -> Any:
    """Return the robust Embree scene of a grain's mesh (float32, geometry 0, primitive = face index).

    Raises
    ------
    GrainError
        The grain has no mesh, or one that Embree must not be given: it reads out of bounds without a word.
    """
    return triangle_scene(grain.vertices, grain.faces, grain.name)


def triangle_scene(vertices: ArrayLike, faces: ArrayLike, name: str = "mesh") -> Any:
    """Return the robust Embree scene of any triangles, as `embree_scene` does for a grain's; threads may share it."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    corners = np.array(vertices, np.float32, order="C")
    triangles = np.array(faces, np.int32, order="C")
    if len(triangles) == 0 or corners.shape[1:] != (3,) or triangles.shape[1:] != (3,):
        raise GrainError(f"{name}: has no triangle mesh to cast rays at")
    if not np.isfinite(corners).all() or triangles.min() < 0 or triangles.max() >= len(corners):
        raise GrainError(f"{name}: the mesh is damaged; make it by grain_from_mesh")
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, corners, triangles)  # copied into the scene, which owns it
    scene.run(corners[:1], np.ones((1, 3), np.float32))  # builds its tree, so that threads can share it
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
    touching = False
    for i in confirmed[:8]:
        gap = _gap_on_ray(grain, origin[i], direction[i])
        if gap is not None:
            place, touching = gap, True
            break
    return Crossings(len(confirmed) / rays, (len(suspect) - len(confirmed)) / rays, place, touching)


def _gap_on_ray(grain: Grain, origin: Floats, direction: Floats) -> Floats | None:
    """Return where a ray leaves the material for less than `RAY_OFFSET`, measured across the facets, or None."""
    a, b, c = (grain.vertices[grain.faces] - origin).swapaxes(0, 1)
    inside = [np.cross(u, v) @ direction for u, v in ((a, b), (b, c), (c, a))]  # one sign: the ray meets the facet
    met = np.flatnonzero((np.min(inside, axis=0) >= 0) | (np.max(inside, axis=0) <= 0))
    normal = np.cross(b[met] - a[met], c[met] - a[met])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    slope = normal @ direction
    met, normal, slope = met[slope != 0], normal[slope != 0], slope[slope != 0]
    along = np.einsum("ij,ij->i", a[met], normal) / slope
    leave, enter = np.flatnonzero(slope > 0), np.flatnonzero(slope < 0)
    gap = (along[enter] - along[leave][:, None]) * slope[leave][:, None]
    facing = normal[leave] @ normal[enter].T < -1 + 1e-6
    at = np.argwhere((np.abs(gap) < RAY_OFFSET) & facing)
    return origin + along[leave[at[0, 0]]] * direction if len(at) else None


def _broken_rays(grain: Grain, scene: Any, origin: Floats, direction: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Return which rays do not enter and leave in turn, and where each ray was last."""
    faces = grain.faces.astype(np.int64)
    normal = area_normals(grain.vertices, faces)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = np.einsum("ij,ij->i", normal, grain.vertices[faces[:, 0]])
    ends, bad = np.empty(origin.shape), np.zeros(len(origin), bool)

    def follow(first: int) -> None:
        part = slice(first, first + RAYS_AT_ONCE)
        along = direction[part].astype(np.float32).astype(np.float64)  # the ray Embree sees
        at = ends[part]
        at[...] = origin[part].astype(np.float32)
        inside, broken = np.zeros(len(at), bool), bad[part]
        active = np.arange(len(at))
        while len(active):
            face = first_hit(scene, at[active], along[active])
            missed = active[face < 0]
            broken[missed] = inside[missed]
            active, face = active[face >= 0], face[face >= 0]
            n, d = normal[face], along[active]
            slope = np.einsum("ij,ij->i", d, n)
            leaving = slope > 0
            broken[active] = (inside[active] != leaving) | (np.abs(slope) < 1e-7)
            inside[active] = ~leaving
            step = (level[face] - np.einsum("ij,ij->i", at[active], n)) / np.where(slope == 0, 1.0, slope)
            beyond = at[active] + step[:, None] * d + np.copysign(RAY_OFFSET, slope)[:, None] * n
            at[active] = beyond.astype(np.float32)
            active = active[~broken[active] & (np.abs(beyond) < 4).all(axis=1)]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(follow, range(0, len(origin), RAYS_AT_ONCE)))
    return bad, ends
