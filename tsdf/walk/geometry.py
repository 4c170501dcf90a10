"""Where things are in a scene: boundaries of media, opaque surfaces, what a ray meets and how far the nearest is.

Media have a boundary each: a closed mesh, in a ray-engine scene of its own, or a slab, box or sphere, found exactly.
Opaque surfaces are triangles, all in one more ray-engine scene, and exact balls. Which medium a ray is in is not
remembered across boundaries: the first facet of a medium's own boundary that the ray meets says on which side the ray
runs, or the grid (`grid.home_of`) in which mesh it has come, so that boundaries that touch, coincide with a surface or
hold the camera need no care. Embree names the facet; the distance
comes from the facet's plane in float64. What light does there is `transport`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.errors import GrainError, SceneError
from tsdf.grain.grains import first_hit, grain_from_mesh, triangle_scene
from tsdf.grain.meshes import read_mesh
from tsdf.scene.keys import FARTHEST
from tsdf.scene.scene import SMALLEST, Box, MediumSpec, Mesh, Rectangle, Scene, Slab, Sphere, SurfaceSpec, called
from tsdf.vectors import KERNEL, dot, step
from tsdf.walk.cells import ROUNDING
from tsdf.walk.grid import GRAZING, MOST_MEDIA, NONE, Grid, free_around, grid_of, held, march
from tsdf.walk.room import BALL, BOX, CLOSED, MESH, OPEN, SLAB, Room, exact_depth, room_of

SLACK = 2e-6  # [of a facet's largest coordinate] a point this near to a facet is on it: 30 float32 ulps
GRID_CELLS = 2_000_000  # of the grid of facets: half a second to make
RANGE = 1e6  # of the largest coordinate to the smallest extent of a medium, which a facet that large blurs
DIGITS = 1e-9  # of a coordinate is the least size there
LEAST_OVERLAP = 1e-3  # [of the smaller extent] media that overlap by less only touch
NEAR = 1e-4  # of a way or a ball's radius: what passes a ball so near is looked at with more care


class Geometry(NamedTuple):
    """What kernels ask about a scene; coordinates are relative to the scene's centre.

    kind (m,), shape (m, 6), slack (m,), engine (m,) of media: kind, numbers, thickness of an exact boundary [unit],
    ray-engine scene; grid: facets by cells, in which their meshes are the ray-engine scenes; surface (f,) of facets;
    balls (b, 4), ball_surface (b,): centre, radius, surface; reflectance (s, 3); engines: the number of ray-engine
    scenes; solid: the first of them is that of the surfaces; convex: there is nothing but one medium, in a convex mesh.
    """

    kind: np.ndarray
    shape: np.ndarray
    slack: np.ndarray
    engine: np.ndarray
    grid: Grid
    surface: np.ndarray
    balls: np.ndarray
    ball_surface: np.ndarray
    reflectance: np.ndarray
    engines: int
    solid: bool
    convex: bool


# ------------------------------------------------------------------------------------------- for kernels


@njit(forceinline=True, **KERNEL)
def _between(low, high, at, d):
    """Return where a ray comes between two parallel planes, where it goes, and whether it begins there.

    It begins at height `at` and gains d per length. Where it is never between them, it comes after it has gone.
    """
    low, high = low - at, high - at
    begins = low < 0.0 < high
    if d == 0.0:
        return (-math.inf, math.inf, True) if begins else (math.inf, -math.inf, False)
    each = 1.0 / d
    low, high = low * each, high * each
    return min(low, high), max(low, high), begins


@njit(**KERNEL)
def exact_hit(kind, shape, p, d):
    """Return distance to a slab, box or ball, whether p is inside, and the outward normal there."""
    if kind == BALL:
        q = (p[0] - shape[0], p[1] - shape[1], p[2] - shape[2])
        along, rest = dot(q, d), dot(q, q) - shape[3] * shape[3]
        root = along * along - rest
        if rest < 0.0:
            t = math.sqrt(root) - along
        elif along >= 0.0 or root <= 0.0:
            return math.inf, False, (0.0, 0.0, 0.0)
        else:
            t = -along - math.sqrt(root)
        m = step(q, t, d)
        return t, rest < 0.0, (m[0] / shape[3], m[1] / shape[3], m[2] / shape[3])
    near, far, inside = _between(shape[2], shape[5], p[2], d[2])
    near_axis = far_axis = 2
    if kind != SLAB:
        a, b, between = _between(shape[1], shape[4], p[1], d[1])
        inside &= between
        near, near_axis = (a, 1) if a >= near else (near, near_axis)
        far, far_axis = (b, 1) if b <= far else (far, far_axis)
        a, b, between = _between(shape[0], shape[3], p[0], d[0])
        inside &= between
        near, near_axis = (a, 0) if a >= near else (near, near_axis)
        far, far_axis = (b, 0) if b <= far else (far, far_axis)
    t, axis = (far, far_axis) if inside else (near, near_axis)
    if (not inside and (near > far or near < 0.0)) or abs(t) == math.inf:
        return math.inf, inside, (0.0, 0.0, 0.0)
    along = d[0] if axis == 0 else (d[1] if axis == 1 else d[2])
    side = 1.0 if (along > 0.0) == inside else -1.0
    return t, inside, (side if axis == 0 else 0.0, side if axis == 1 else 0.0, side if axis == 2 else 0.0)


@njit(**KERNEL)
def ball_hit(balls, p, d):
    """Return distance to the nearest of the opaque balls and its number, or infinity and -1."""
    nearest, which = math.inf, NONE
    for b in range(balls.shape[0]):
        q = (p[0] - balls[b, 0], p[1] - balls[b, 1], p[2] - balls[b, 2])
        along = dot(q, d)
        root = along * along - (dot(q, q) - balls[b, 3] * balls[b, 3])
        if root <= 0.0:
            continue
        root = math.sqrt(root)
        t = -along - root
        if t < 0.0:
            t = root - along
        if 0.0 <= t < nearest:
            nearest, which = t, b
    return nearest, which


@njit(forceinline=True, **KERNEL)
def clearance(g, m, p, least=0.0):
    """Return a length within which p of medium m is sure to have neither its boundary nor a surface around it; one
    below `least` may be shorter than need be."""
    bound = math.inf
    if g.kind[m] != MESH:
        bound = exact_depth(g.kind[m], g.shape[m], p)
    for b in range(g.balls.shape[0]):
        q = (p[0] - g.balls[b, 0], p[1] - g.balls[b, 1], p[2] - g.balls[b, 2])
        bound = min(bound, abs(math.sqrt(dot(q, q)) - g.balls[b, 3]))
    return bound if g.engines == 0 else min(bound, free_around(g.grid, p, least))


@njit(**KERNEL)
def unmet(g, met, m, p, d, end):
    """Return whether a ray from p of medium m along d is sure to meet neither its boundary nor a surface up to `end`,
    and whether `met` (engines,) says which facets it meets first."""
    if g.kind[m] != MESH:
        t, inside, _ = exact_hit(g.kind[m], g.shape[m], p, d)
        if not inside or t - end <= GRAZING * g.slack[m]:
            return False, False
    if g.balls.shape[0] > 0:
        t, ball = ball_hit(g.balls, p, d)
        if t - end <= NEAR * (end + g.balls[ball, 3]):
            return False, False
    if g.engines == 0 or (g.convex and held(g.grid, m, step(p, end, d))):
        return True, False
    if not march(g.grid, met, m, p, d, end):
        return False, False
    for e in range(met.shape[0]):
        if met[e] != NONE:
            return False, True
    return True, True


# --------------------------------------------------------------------------------------------- from specs


class Triangles(NamedTuple):
    """Corners (n, 3) float64 and faces (m, 3) int32 of a mesh."""

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(eq=False)
class Place:
    """The geometry of a scene: arrays for kernels, the ray engine, and what must be asked before rendering.

    Attributes
    ----------
    arrays : Geometry
    engines : list
        Ray-engine scenes: of the surfaces first if there are any, then of the media with a mesh.
    first_facet : list of int
        Number of the first facet of each.
    centre : (3,) float64
        World coordinates of the origin of all arrays [unit].
    boundaries : list of Triangles or None
        Of the media, relative to `centre`; None for exact shapes.
    surfaces : list of Triangles or None
        Of the surfaces, relative to `centre`; None for balls.
    room : Room
        Where grains stand; without facets unless asked for.
    notes : tuple of str
        What the user should know.
    """

    arrays: Geometry
    engines: list
    first_facet: list[int]
    centre: np.ndarray
    boundaries: list[Triangles | None]
    surfaces: list[Triangles | None]
    room: Room
    notes: tuple[str, ...]

    def hits(self, starts: np.ndarray, ways: np.ndarray, out: np.ndarray) -> None:
        """Write the facet that each ray meets first in each ray-engine scene, -1 for none, to (engines, n) int32."""
        for row, (engine, first) in enumerate(zip(self.engines, self.first_facet, strict=True)):
            prims = engine.run(starts, ways)
            np.add(prims, first, out=out[row, : len(prims)], where=prims >= 0)
            out[row, : len(prims)][prims < 0] = NONE

    def inside(self, m: int, points: np.ndarray) -> np.ndarray:
        """Return (n,) bool whether points (n, 3), relative to the centre, are inside medium m."""
        kind = self.arrays.kind[m]
        if kind != MESH:
            return np.array([exact_depth(kind, self.arrays.shape[m], tuple(p)) > 0.0 for p in points], bool)
        row = int(self.arrays.engine[m])
        return within(self.engines[row], self.arrays.grid.facets[self.first_facet[row] :, :3], points)


def within(engine: Any, normals: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (n,) bool whether points (n, 3) are inside a closed mesh: the first facet met is met from inside."""
    way = np.array([0.36, 0.48, 0.8])  # any direction that modelled facets are not likely to be parallel to
    facet = first_hit(engine, points, np.broadcast_to(way, points.shape))
    return (facet >= 0) & (normals[facet] @ way > 0.0)


def box_mesh(low: Sequence[float], high: Sequence[float]) -> Triangles:
    """Return the closed mesh of a box, facets wound so that normals point outward."""
    corners = np.array([[(low, high)[(i >> k) & 1][k] for k in range(3)] for i in range(8)], np.float64)
    quads = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
    return Triangles(corners, np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))], np.int32))


def _surface_mesh(spec: SurfaceSpec, where: str) -> Triangles:
    """Return the triangles of an opaque surface, which need not be closed."""
    shape = spec.shape
    if isinstance(shape, Box):
        return box_mesh(shape.low, shape.high)
    if isinstance(shape, Rectangle):
        c, u, v = (np.array(x, np.float64) for x in (shape.centre, shape.u, shape.v))
        return Triangles(np.array([c - u - v, c + u - v, c + u + v, c - u + v]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert isinstance(shape, Mesh)
    try:
        vertices, faces = read_mesh(shape.file)
    except GrainError as error:
        raise SceneError(f"{where}: {_of_scenes(error)}") from None
    points = shape.placed(vertices)
    if not np.isfinite(points).all():
        raise SceneError(f"{where}: {shape.file}: holds coordinates that are not finite; export the mesh again")
    corners = points[faces]
    flat = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) == 0.0
    if flat.all():
        raise SceneError(f"{where}: {shape.file}: no face has an area; export the mesh again")
    return Triangles(points, np.asarray(faces, np.int32)[~flat])


def _of_scenes(error: GrainError) -> str:
    """Return a message about a grain's mesh in the words of scenes, whose tool cannot repair."""
    return str(error).replace(" or pass --repair", "").replace("a grain is", "a boundary is").replace("a grain", "it")


def _boundary(spec: MediumSpec, where: str) -> tuple[Triangles, tuple[str, ...]]:
    """Return the closed mesh around a medium, checked as a grain is."""
    shape = spec.shape
    assert isinstance(shape, Mesh)
    try:
        vertices, faces = read_mesh(shape.file)
        body = grain_from_mesh(vertices, faces, name=str(shape.file))
    except GrainError as error:
        raise SceneError(f"{where}: {_of_scenes(error)}") from None
    points = shape.placed(body.centre + body.bounding_radius * body.vertices)
    return Triangles(points, body.faces), tuple(f"{where}: {note}" for note in body.notes)


def _extent(low: np.ndarray, high: np.ndarray, triangles: Sequence[Triangles | None]) -> tuple[np.ndarray, np.ndarray]:
    for mesh in triangles:
        if mesh is not None:
            low, high = np.minimum(low, mesh.vertices.min(axis=0)), np.maximum(high, mesh.vertices.max(axis=0))
    return low, high


def _around(triangles: Triangles, margin: float) -> Triangles:
    """Return a convex mesh around all that is nearer than `margin` to a mesh."""
    from scipy.spatial import ConvexHull

    corners = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    hull = ConvexHull((triangles.vertices[:, None] + margin * corners).reshape(-1, 3))
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    points = hull.points[used]
    normals = planes_of(points[faces])[:, :3]
    outward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) > 0.0
    return Triangles(points, np.where(outward[:, None], faces, faces[:, ::-1]).astype(np.int32))


def place(scene: Scene, grains: bool = False) -> Place:
    """Load and check the geometry of a scene.

    Parameters
    ----------
    scene : Scene
    grains : bool
        Whether there are single grains: the room for them is found, and media reach as far as their grains do where
        only the centres of grains are inside the boundary.

    Raises
    ------
    SceneError
        A boundary that is not a closed, simple surface, media that overlap, a mesh that cannot be read, too many media.
    """
    if len(scene.media) > MOST_MEDIA:
        raise SceneError(f"{scene.name}: has {len(scene.media)} media, of at most {MOST_MEDIA}; leave some out")
    boundaries, notes = _boundaries(scene)
    surfaces = [
        None if isinstance(s.shape, Sphere) else _surface_mesh(s, f"{scene.name}: {called('surface', i, s.name)}")
        for i, s in enumerate(scene.surfaces, 1)
    ]
    _check_sizes(scene, boundaries, surfaces)
    low, high = _ends(scene, boundaries, surfaces)
    centre = 0.5 * (low + high)
    boundaries = [m and Triangles(m.vertices - centre, m.faces) for m in boundaries]
    surfaces = [m and Triangles(m.vertices - centre, m.faces) for m in surfaces]

    kind, shape, slack = _exact_shapes(scene.media, centre)
    balls = [(i, s.shape) for i, s in enumerate(scene.surfaces) if isinstance(s.shape, Sphere)]
    places = np.array([[*(np.array(b.centre) - centre), b.radius] for _, b in balls]).reshape(-1, 4)
    radii = np.array([medium.radius for medium in scene.media])
    whole = np.array([medium.inside == "grains" for medium in scene.media], bool)
    room = room_of(kind, _moved(kind, shape, np.where(whole, -radii, 0.0)), radii, whole, places,
                   _walls(boundaries, surfaces) if grains else [], (low - centre, high - centre))  # fmt: skip
    if grains:
        out = np.where(whole, 0.0, radii)
        shape = _moved(kind, shape, out)
        boundaries = [m and (_around(m, x) if x else m) for m, x in zip(boundaries, out.tolist(), strict=True)]
        low, high = low - out.max(initial=0.0), high + out.max(initial=0.0)

    solid = any(mesh is not None for mesh in surfaces)
    meshes, owners, engine = _ray_meshes(boundaries, surfaces)
    engines = [triangle_scene(mesh.vertices, mesh.faces) for mesh in meshes]
    first_facet = [sum(len(mesh.faces) for mesh in meshes[:i]) for i in range(len(meshes))]
    arrays = Geometry(
        kind=kind,
        shape=shape,
        slack=slack,
        engine=engine,
        grid=_grid(meshes, engine, low - centre, high - centre, scene),
        surface=owners,
        balls=places,
        ball_surface=np.array([i for i, _ in balls], np.int32),
        reflectance=np.array([s.reflectance for s in scene.surfaces], np.float64).reshape(-1, 3),
        engines=len(engines),
        solid=solid,
        convex=len(meshes) == len(scene.media) == 1 and not solid and not balls and is_convex(meshes[0]),
    )
    made = Place(arrays, engines, first_facet, centre, boundaries, surfaces, room, notes)
    _no_overlap(made, scene, grains)
    return made


def _boundaries(scene: Scene) -> tuple[list[Triangles | None], tuple[str, ...]]:
    """Return the meshes around media, None for exact shapes, and what the user should know of them."""
    notes: list[str] = []
    boundaries: list[Triangles | None] = []
    for number, medium in enumerate(scene.media, 1):
        mesh = None
        if isinstance(medium.shape, Mesh):
            mesh, found = _boundary(medium, f"{scene.name}: {called('medium', number, medium.name)}")
            notes += found
        boundaries.append(mesh)
    return boundaries, tuple(notes)


def _ends(
    scene: Scene, boundaries: Sequence[Triangles | None], surfaces: Sequence[Triangles | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corner of the media, whose middle is the origin, where float32 is finest.

    Where they are endless or there are none, those of the surfaces; else 0.
    """
    nothing = np.full(3, math.inf)
    low, high = _extent(nothing, -nothing, boundaries)
    for medium in scene.media:
        if isinstance(medium.shape, Box):
            low, high = np.minimum(low, medium.shape.low), np.maximum(high, medium.shape.high)
        elif isinstance(medium.shape, Sphere):
            centre, radius = np.array(medium.shape.centre), medium.shape.radius
            low, high = np.minimum(low, centre - radius), np.maximum(high, centre + radius)
        elif isinstance(medium.shape, Slab):
            low[2], high[2] = min(low[2], medium.shape.low), max(high[2], medium.shape.high)
    if np.isfinite(low).all():
        return low, high
    wide, far = _extent(nothing, -nothing, surfaces)
    low, high = (np.where(np.isfinite(a), a, np.where(np.isfinite(b), b, 0.0)) for a, b in ((low, wide), (high, far)))
    return low, high


def _exact_shapes(media: Sequence[MediumSpec], centre: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return kind, shape and slack of media as in `Geometry`, relative to `centre`."""
    kind, shape, slack = np.zeros(len(media), np.int32), np.zeros((len(media), 6)), np.zeros(len(media))
    for i, medium in enumerate(media):
        s = medium.shape
        if isinstance(s, Slab):
            kind[i], shape[i, 2], shape[i, 5] = SLAB, s.low - centre[2], s.high - centre[2]
        elif isinstance(s, Box):
            kind[i], shape[i, :3], shape[i, 3:] = BOX, s.low - centre, s.high - centre
        elif isinstance(s, Sphere):
            kind[i], shape[i, :3], shape[i, 3] = BALL, s.centre - centre, s.radius
        slack[i] = 1e-9 * max(np.abs(shape[i]).max(), medium.radius)
    return kind, shape, slack


def is_convex(mesh: Triangles) -> bool:
    """Return whether a closed mesh without self-intersections is convex: one piece whose facets all lean inward.

    What is convex along each edge is convex in whole (Tietze 1928, Nakajima 1928).
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = np.asarray(mesh.faces, np.int64)
    one = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    facet, opposite = np.tile(np.arange(len(faces)), 3), np.concatenate([faces[:, (k + 2) % 3] for k in range(3)])
    size = len(mesh.vertices)
    here, there = one[:, 0] * size + one[:, 1], one[:, 1] * size + one[:, 0]
    order, back = np.argsort(here), np.argsort(there)
    if not np.array_equal(here[order], there[back]) or (np.diff(here[order]) == 0).any():
        return False  # more than two facets meet at an edge
    planes = planes_of(mesh.vertices[faces])[facet[order]]
    height = np.einsum("ij,ij->i", planes[:, :3], mesh.vertices[opposite[back]]) - planes[:, 3]
    if (height > ROUNDING * np.abs(mesh.vertices).max()).any():
        return False
    pairs = coo_array((np.ones(len(order), bool), (facet[order], facet[back])), shape=(len(faces), len(faces)))
    return int(connected_components(pairs, directed=False)[0]) == 1


def _ray_meshes(
    boundaries: Sequence[Triangles | None], surfaces: Sequence[Triangles | None]
) -> tuple[list[Triangles], np.ndarray, np.ndarray]:
    """Return the meshes of the ray-engine scenes, first that of all surfaces, if any has a mesh, then those of media;
    the surface (f,) that each facet is of; and the scene (m,) of each medium; NONE where there is none."""
    meshes: list[Triangles] = []
    owners: list[np.ndarray] = []
    solid = [(i, mesh) for i, mesh in enumerate(surfaces) if mesh is not None]
    if solid:
        starts = np.cumsum([0] + [len(mesh.vertices) for _, mesh in solid[:-1]])
        united = Triangles(
            np.vstack([mesh.vertices for _, mesh in solid]),
            np.vstack([mesh.faces + at for (_, mesh), at in zip(solid, starts, strict=True)]),
        )
        owners.append(np.repeat([i for i, _ in solid], [len(mesh.faces) for _, mesh in solid]))
        meshes.append(united)
    engine = np.full(len(boundaries), NONE, np.int32)
    for i, boundary in enumerate(boundaries):
        if boundary is not None:
            engine[i] = len(meshes)
            meshes.append(boundary)
            owners.append(np.full(len(boundary.faces), NONE))
    return meshes, np.concatenate(owners).astype(np.int32) if owners else np.zeros(0, np.int32), engine


def _check_sizes(scene: Scene, boundaries: Sequence[Triangles | None], surfaces: Sequence[Triangles | None]) -> None:
    """Refuse sizes that the numbers of the ray engine cannot hold, and media too thin for what is around them."""
    specs: list[MediumSpec | SurfaceSpec] = [*scene.media, *scene.surfaces]
    meshes = [*boundaries, *surfaces]
    media = len(scene.media)
    for i, (spec, mesh) in enumerate(zip(specs, meshes, strict=True)):
        shape = spec.shape
        if mesh is not None:
            low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        elif isinstance(shape, Sphere):
            low, high = np.array(shape.centre) - shape.radius, np.array(shape.centre) + shape.radius
        else:
            assert isinstance(shape, Box | Slab)
            low, high = (np.ones(3) * end for end in (shape.low, shape.high))
        kind, number = ("medium", i + 1) if i < media else ("surface", i + 1 - media)
        title = f"{scene.name}: {called(kind, number, spec.name)}"
        size, farthest = float((high - low).max()), float(max(np.abs(low).max(), np.abs(high).max()))
        if not (size >= max(SMALLEST, DIGITS * farthest) and farthest <= FARTHEST):
            raise SceneError(
                f"{title}: is {size:.3g} wide and up to {farthest:.3g} from the origin, but sizes are at least "
                f"{SMALLEST:g} and a billionth of such distances, which are at most {FARTHEST:g}; move or scale it"
            )
        thin, middle = float((high - low).min()), 0.5 * (low + high)
        if isinstance(shape, Slab):
            middle[:2] = 0.0
        reach = max((float(np.abs(m.vertices - middle).max()) for m in meshes if m is not None), default=0.0)
        if i < media and reach > RANGE * thin:
            raise SceneError(
                f"{title}: is {thin:.3g} thin, and a facet reaches {reach:.3g} away, which blurs all below a millionth "
                "of that; cut down what is far, or make the medium thicker"
            )


def _moved(kind: np.ndarray, shape: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Return shapes (m, 6) whose boundaries are moved outward by (m,) [unit]."""
    moved = shape.copy()
    for k, by, new in zip(kind, out, moved, strict=True):
        if k == BALL:
            new[3] += by
        elif k != MESH:
            new[:3] -= by
            new[3:] += by
    return moved


def _walls(
    boundaries: Sequence[Triangles | None], surfaces: Sequence[Triangles | None]
) -> list[tuple[int, np.ndarray, Any]]:
    """Return owner, corners and a test for points inside of every mesh, as `room_of` takes them."""
    walls: list[tuple[int, np.ndarray, Any]] = []

    def inside(points: np.ndarray, faces: np.ndarray) -> Any:
        return partial(within, triangle_scene(points, faces), planes_of(points[faces])[:, :3])

    for m, mesh in enumerate(boundaries):
        if mesh is not None:
            walls.append((m, mesh.vertices[mesh.faces], inside(*mesh)))
    for mesh in surfaces:
        if mesh is None:
            continue
        try:
            body = grain_from_mesh(mesh.vertices, mesh.faces)
        except GrainError:
            walls.append((OPEN, mesh.vertices[mesh.faces], None))  # it has no inside
            continue
        points = body.centre + body.bounding_radius * body.vertices
        walls.append((CLOSED, points[body.faces], inside(points, body.faces)))
    return walls


def _planes(meshes: Sequence[Triangles]) -> tuple[np.ndarray, np.ndarray]:
    """Return normal and height (f, 4) of the facets of all meshes, and how near to each a point counts as on it."""
    if not meshes:
        return np.zeros((0, 4)), np.zeros(0)
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    return planes_of(corners), SLACK * np.abs(corners).max(axis=(1, 2))


def planes_of(corners: np.ndarray) -> np.ndarray:
    """Return normal and height over the origin (m, 4) of triangles given by their corners (m, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack((normals, np.einsum("ij,ij->i", normals, corners.mean(axis=1))))


def _grid(meshes: Sequence[Triangles], engine: np.ndarray, low: np.ndarray, high: np.ndarray, scene: Scene) -> Grid:
    """Return the grid over all media, which lie wholly inside it; where one is endless, over all facets. `engine` has
    the number of each one's mesh."""
    endless = any(isinstance(medium.shape, Slab) for medium in scene.media)
    if endless:
        nothing = np.full(3, math.inf)
        low, high = _extent(nothing, -nothing, meshes)
    corners = [mesh.vertices[mesh.faces] for mesh in meshes]
    planes, thickness = _planes(meshes)
    least = 0.5 * min((medium.radius for medium in scene.media), default=0.0)  # smaller ones are more to go through
    owner = np.full(len(meshes), NONE, np.int32)
    owner[engine[engine != NONE]] = np.flatnonzero(engine != NONE)
    return grid_of(corners, owner, planes, thickness, (low, high), GRID_CELLS if scene.media else 0, least, endless)


def _no_overlap(made: Place, scene: Scene, single: bool) -> None:
    """Refuse media that share room: no model says what a place in two of them is."""
    count = len(scene.media)
    if count < 2:
        return
    rng = np.random.default_rng(0)
    extents = []
    for i in range(count):
        mesh, s = made.boundaries[i], made.arrays.shape[i]
        if mesh is not None:
            extents.append((mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)))
        elif made.arrays.kind[i] == BALL:
            extents.append((s[:3] - s[3], s[:3] + s[3]))
        else:
            free = np.array([made.arrays.kind[i] == SLAB] * 2 + [False])
            extents.append((np.where(free, -math.inf, s[:3]), np.where(free, math.inf, s[3:])))
    for i in range(count):
        for j in range(i):
            low, high = np.maximum(extents[i][0], extents[j][0]), np.minimum(extents[i][1], extents[j][1])
            low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
            smaller = min((e[1] - e[0]).min() for e in (extents[i], extents[j]))
            if (high - low < LEAST_OVERLAP * smaller).any():
                continue
            points = low + (high - low) * rng.random((100_000, 3))
            both = made.inside(i, points) & made.inside(j, points)
            if both.any():
                at = "({:.4g}, {:.4g}, {:.4g})".format(*(points[both][0] + made.centre))
                a, b = (called("medium", k + 1, scene.media[k].name) for k in (j, i))
                if "centres" in (scene.media[i].inside, scene.media[j].inside) and single:
                    raise SceneError(
                        f"{scene.name}: grains of {a} and {b} reach into each other, at {at} for one, for "
                        'only their centres are inside; leave room between the media, or say inside = "grains"'
                    )
                raise SceneError(f"{scene.name}: {a} and {b} overlap, at {at} for one; move or cut one of them")
