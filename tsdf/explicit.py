"""Grains one by one, the truth that every model is measured against: a packing of bounding spheres, a grain in each.

A medium is filled by a periodic tile of spheres (`packing`); a grain exists where its bounding sphere is wholly inside
the boundary and clear of the opaque surfaces. Which exemplar it is and how it is turned are functions of its place.
Light enters a bounding sphere, is brought into the grain's frame, and goes one way at each hit, as in nature. The exact
sphere is followed here without a ray engine; all other grains share one ray-engine scene for each exemplar.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from tsdf.errors import GrainError, SceneError, TSDFError
from tsdf.geometry import MESH, SLAB, Place, exact_depth, planes_of, triangle_distance, within
from tsdf.grains import Grain, embree_scene, grain_from_mesh, load_grain, read_mesh, triangle_scene
from tsdf.optics import UNPOLARISED, P, S, fresnel
from tsdf.packing import Cells, cells_of, next_sphere, pack
from tsdf.sampling import GOLDEN, key_of, mix, turn, unit
from tsdf.scene import GrainSpec, MediumSpec, Scene
from tsdf.table import Table
from tsdf.vectors import KERNEL, dot, step

OFFSET = 1e-5  # [R] restart distance off a facet along its normal, as in `tracer`
RETRY = 1e-3  # share of the way to the facet's centroid by which a failed restart is moved
MOST_GRAINS = 30_000_000  # whose place must be looked up one by one
EMPTY, FULL = -1, -2  # tiles in which no grain, or every grain, exists
EXACT_SPHERE = -1
ENTERED, INSIDE, RETRIED, LEFT = 0, 1, 2, 4


class Grains(NamedTuple):
    """What kernels ask about packed grains. The first five are tuples over media, the rest arrays.

    cells, centres: the tile's grid and its (n, 3) centres [R]; status (x, y, z) int32: for each tile of a block a row
    of `mask` or EMPTY or FULL, mask (rows, n) uint8: which grains exist, block (3,) int64: number of its first tile.
    radius (m,): R [unit]; seed (m,) uint64; tiled (m,) bool: grains outside the block exist where the exact shape has
    room. Of components: share (c,): running sum of number fractions in each medium; eta, kept_apart (c,) (the
    polarisations), exemplar (c,) int32: ray-engine scene. Of the exemplars' facets: planes (f, 4), centroids (f, 3),
    first_facet (e,).
    """

    cells: tuple[Cells, ...]
    centres: tuple[np.ndarray, ...]
    status: tuple[np.ndarray, ...]
    mask: tuple[np.ndarray, ...]
    block: tuple[np.ndarray, ...]
    radius: np.ndarray
    seed: np.ndarray
    tiled: np.ndarray
    share: np.ndarray
    eta: np.ndarray
    kept_apart: np.ndarray
    exemplar: np.ndarray
    planes: np.ndarray
    centroids: np.ndarray
    first_facet: np.ndarray


# ------------------------------------------------------------------------------------------- for kernels


@njit(**KERNEL)
def centre_of(grains, m, i, j, k, sphere):
    """Return the centre of a sphere of tile (i, j, k) of medium m [unit]."""
    side, c, radius = grains.cells[m].side, grains.centres[m], grains.radius[m]
    return (
        radius * (c[sphere, 0] + side * i),
        radius * (c[sphere, 1] + side * j),
        radius * (c[sphere, 2] + side * k),
    )


@njit(**KERNEL)
def exists(grains, g, m, i, j, k, sphere):
    """Return whether there is a grain in a sphere of tile (i, j, k) of medium m."""
    status, block = grains.status[m], grains.block[m]
    a, b, c = i - block[0], j - block[1], k - block[2]
    if 0 <= a < status.shape[0] and 0 <= b < status.shape[1] and 0 <= c < status.shape[2]:
        row = status[a, b, c]
        return row == FULL or (row >= 0 and grains.mask[m][row, sphere] != 0)
    if not grains.tiled[m]:
        return False
    centre = centre_of(grains, m, i, j, k, sphere)
    return exact_depth(g.kind[m], g.shape[m], centre) >= grains.radius[m]


@njit(**KERNEL)
def next_grain(grains, g, m, p, d, t_max):
    """Return distance to the next grain's bounding sphere along d from p [unit] or infinity, its centre and its key."""
    r = grains.radius[m]
    o = (p[0] / r, p[1] / r, p[2] / r)
    t = 0.0
    while True:
        t, i, j, k, sphere = next_sphere(grains.cells[m], o, d, t, t_max / r)
        if sphere < 0:
            return math.inf, o, np.uint64(0)
        if exists(grains, g, m, i, j, k, sphere):
            tile = key_of(grains.seed[m], (i + 1048576) * 2097152 + (j + 1048576), k + 1048576)
            return t * r, centre_of(grains, m, i, j, k, sphere), mix(tile + np.uint64(sphere))


@njit(**KERNEL)
def turned(key, v, back):
    """Return a triple turned by the uniformly random rotation (Shoemake 1992) of a grain's key, or turned back."""
    u = unit(mix(key + np.uint64(1)))
    c1, s1 = turn(unit(mix(key + np.uint64(2))))
    c2, s2 = turn(unit(mix(key + np.uint64(3))))
    a, b = math.sqrt(1.0 - u), math.sqrt(u)
    x, y, z, w = a * s1, a * c1, b * s2, b * c2
    if back:
        x, y, z = -x, -y, -z
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


@njit(**KERNEL)
def component_of(grains, first, count, key):
    """Return the component of a grain, by number fraction."""
    u = unit(mix(key + np.uint64(4)))
    c = first
    while c < first + count - 1 and u >= grains.share[c]:
        c += 1
    return c


@njit(**KERNEL)
def through_sphere(p, d, eta, kept_apart, key):
    """Follow light that meets the unit sphere at p until it leaves; return place, direction, length inside, key."""
    cos_i = min(-dot(p, d), 1.0)
    polarisation = UNPOLARISED
    if kept_apart:
        key = mix(key + GOLDEN)
        polarisation = S if key & np.uint64(1) else P
    reflectance, cos_t = fresnel(cos_i, eta, polarisation)
    key = mix(key + GOLDEN)
    if unit(key) < reflectance:
        return p, step(d, 2.0 * cos_i, p), 0.0, key
    length = 0.0
    d = step((d[0] / eta, d[1] / eta, d[2] / eta), cos_i / eta - cos_t, p)
    while True:
        p = step(p, 2.0 * cos_t, d)
        size = 1.0 / math.sqrt(dot(p, p))
        p = (p[0] * size, p[1] * size, p[2] * size)
        length += 2.0 * cos_t
        key = mix(key + GOLDEN)
        if unit(key) >= reflectance:
            d = step((eta * d[0], eta * d[1], eta * d[2]), cos_i - eta * cos_t, p)
            return p, d, length, key
        d = step(d, -2.0 * dot(d, p), p)


@njit(**KERNEL)
def at_facet(planes, centroids, facet, last, p, d, eta, state, key):
    """Take light at p along d in a grain's frame to the facet that the ray engine found, -1 for none, and on.

    Returns
    -------
    start, d : triples
        Where the next ray starts, off the facet along its normal, and the way the light goes on. With RETRIED the same
        ray is to be repeated from there, and `p` stays what it was.
    length : float
        Travelled inside [R].
    facet : int
        The facet it is on.
    state : int
        INSIDE, RETRIED and LEFT (the light left the grain for good) as bits.
    key : uint64
    fault : bool
        The light was inside and met nothing, twice: it is set free where it is.
    """
    inside = (state & INSIDE) != 0
    if facet < 0 and not inside:
        return p, d, 0.0, facet, LEFT, key, False
    n, cosine, t = (0.0, 0.0, 0.0), 0.0, 0.0
    lost = facet < 0
    if not lost:
        n = (planes[facet, 0], planes[facet, 1], planes[facet, 2])
        cosine = dot(n, d)
        t = (planes[facet, 3] - dot(n, p)) / cosine
    if lost or (cosine > 0.0) != inside or not (-10.0 * OFFSET <= t <= 2.5):
        if last < 0 or state & RETRIED:
            return p, d, 0.0, facet, LEFT, key, inside
        middle = (centroids[last, 0] - p[0], centroids[last, 1] - p[1], centroids[last, 2] - p[2])
        return step(p, RETRY, middle), d, 0.0, last, state | RETRIED, key, False
    t = max(t, 0.0)
    p = step(p, t, d)
    length = t if inside else 0.0
    ratio = 1.0 / eta if inside else eta
    cos_i = min(abs(cosine), 1.0)
    reflectance, cos_t = fresnel(cos_i, ratio, UNPOLARISED)
    key = mix(key + GOLDEN)
    if unit(key) < reflectance:
        d = step(d, -2.0 * cosine, n)
    else:
        bend = cos_t - cos_i / ratio
        d = step((d[0] / ratio, d[1] / ratio, d[2] / ratio), bend if cosine > 0.0 else -bend, n)
        inside = not inside
    half = 1.5 - 0.5 * dot(d, d)
    d = (d[0] * half, d[1] * half, d[2] * half)
    return step(p, -OFFSET if inside else OFFSET, n), d, length, facet, INSIDE if inside else 0, key, False


@njit(**KERNEL)
def rim_of(p, d):
    """Return the distance along d from p to the unit sphere, from within."""
    along = dot(p, d)
    return math.sqrt(max(0.0, along * along + 1.0 - dot(p, p))) - along


# --------------------------------------------------------------------------------------------- from specs


@dataclass(eq=False)
class Packed:
    """The grains of a scene: arrays for kernels and the exemplars' ray-engine scenes."""

    arrays: Grains
    engines: list
    notes: tuple[str, ...]

    def hits(self, e: int, starts: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Return (n,) int32 the facet each ray meets first on exemplar e, -1 for none."""
        prims = self.engines[e].run(starts, ways)
        return np.where(prims >= 0, prims + np.int32(self.arrays.first_facet[e]), np.int32(-1))


def nothing_packed(media: int, components: int) -> Packed:
    """Return grains for the levels that have none."""
    cells = Cells(1.0, 1, 0.0, np.zeros((0, 3)), np.zeros(2, np.int32), np.zeros(0, np.int32))
    arrays = Grains(
        cells=(cells,) * max(media, 1),
        centres=(np.zeros((0, 3)),) * max(media, 1),
        status=(np.zeros((0, 0, 0), np.int32),) * max(media, 1),
        mask=(np.zeros((0, 0), np.uint8),) * max(media, 1),
        block=(np.zeros(3, np.int64),) * max(media, 1),
        radius=np.ones(media),
        seed=np.zeros(media, np.uint64),
        tiled=np.zeros(media, np.bool_),
        share=np.ones(components),
        eta=np.ones(components),
        kept_apart=np.zeros(components, np.bool_),
        exemplar=np.full(components, EXACT_SPHERE, np.int32),
        planes=np.zeros((0, 4)),
        centroids=np.zeros((0, 3)),
        first_facet=np.zeros(0, np.int64),
    )
    return Packed(arrays, [], ())


def exemplar(spec: GrainSpec, table: Table, where: str) -> Grain:
    """Return the grain that a table was made of, found by name or in the mesh file that the scene names."""
    header = table.header["grain"]
    if spec.mesh is not None:
        vertices, faces = read_mesh(spec.mesh)
        grain = grain_from_mesh(vertices, faces, name=spec.mesh.name)
    elif header["kind"] == "sphere":
        grain = load_grain("sphere")
    else:
        try:
            grain = load_grain(header["name"], **dict(header["parameters"]))
        except TSDFError:
            raise SceneError(
                f'{where}: the table\'s grain {header["name"]!r} is not built in: name its file as mesh = "..."'
            ) from None
    if grain.mesh_hash != header["mesh_sha256"]:
        raise SceneError(f"{where}: {grain.name} is not the grain the table was made of; build the table again")
    return grain


def packed(scene: Scene, place: Place, tables: Sequence[Table]) -> Packed:
    """Pack the media of a scene with the grains of its tables, one table for each component of each medium in turn.

    Raises
    ------
    SceneError
        Grains of several sizes, a grain that cannot be found, more grains than can be looked after.
    UsageError
        A packing fraction beyond what random packings reach.
    """
    cells, centres, status, mask, block, notes = [], [], [], [], [], []
    share, eta, kept_apart, chosen = [], [], [], []
    engines: list[Any] = []
    known: dict[str, int] = {}
    planes, centroids, first_facet = [np.zeros((0, 4))], [np.zeros((0, 3))], []
    facets, at = 0, 0
    for m, medium in enumerate(scene.media):
        where = f"{scene.name}: [[medium]] {m + 1} ({medium.name})"
        try:
            packing = pack(medium.packing_fraction, medium.packing_spheres, medium.packing_seed)
        except TSDFError as error:
            raise SceneError(f"{where}: {error}") from None
        cells.append(cells_of(packing))
        centres.append(np.ascontiguousarray(packing.centres))
        notes.append(f"{where}: {len(packing.centres)} spheres in a tile of {packing.side:.4g} R, "
                     f"packing fraction {packing.fraction:.6f}")  # fmt: skip
        a, b, c = _existing(medium, m, place, packing.centres, packing.side, scene, where)
        status.append(a)
        mask.append(b)
        block.append(c)
        fractions = np.array([grain.fraction for grain in medium.grains])
        share += list(np.cumsum(fractions) / fractions.sum())
        for spec in medium.grains:
            table = tables[at]
            at += 1
            grain = exemplar(spec, table, where)
            eta.append(table.header["optics"]["eta"])
            kept_apart.append(table.header["optics"]["fresnel"] == "sp")
            if grain.kind == "sphere":
                chosen.append(EXACT_SPHERE)
                continue
            if grain.mesh_hash not in known:
                known[grain.mesh_hash] = len(engines)
                corners = grain.vertices[grain.faces]
                planes.append(planes_of(corners))
                centroids.append(corners.mean(axis=1))
                first_facet.append(facets)
                facets += len(corners)
                engines.append(embree_scene(grain))
            chosen.append(known[grain.mesh_hash])
    arrays = Grains(
        cells=tuple(cells),
        centres=tuple(centres),
        status=tuple(status),
        mask=tuple(mask),
        block=tuple(block),
        radius=np.array([medium.radius for medium in scene.media]),
        seed=np.array([medium.packing_seed for medium in scene.media], np.uint64),
        tiled=np.array([mesh is None for mesh in place.boundaries], np.bool_),
        share=np.array(share),
        eta=np.array(eta, np.float64),
        kept_apart=np.array(kept_apart, np.bool_),
        exemplar=np.array(chosen, np.int32),
        planes=np.concatenate(planes),
        centroids=np.concatenate(centroids),
        first_facet=np.array(first_facet, np.int64),
    )
    return Packed(arrays, engines, tuple(notes))


def _existing(
    medium: MediumSpec, m: int, place: Place, centres: np.ndarray, side: float, scene: Scene, where: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return status, mask and first tile of the block of tiles in which not every grain with room exists."""
    g, radius = place.arrays, medium.radius
    tile = side * radius
    obstacles = [mesh.vertices[mesh.faces] for mesh in place.surfaces if mesh is not None]
    bodies = [corners.reshape(-1, 3) for corners in obstacles] + [
        b[:3] + b[3] * np.array([[-1.0], [1.0]]) for b in g.balls
    ]
    boundary = place.boundaries[m]
    if boundary is not None:
        low, high = boundary.vertices.min(axis=0), boundary.vertices.max(axis=0)
    elif bodies:
        everything = np.concatenate(bodies)
        low, high = everything.min(axis=0) - radius, everything.max(axis=0) + radius
        if g.kind[m] == SLAB:
            low[2], high[2] = max(low[2], g.shape[m, 2]), min(high[2], g.shape[m, 5])
        elif g.kind[m] != MESH:
            s = g.shape[m]
            box = (s[:3], s[3:]) if g.kind[m] == 2 else (s[:3] - s[3], s[:3] + s[3])
            low, high = np.maximum(low, box[0]), np.minimum(high, box[1])
    if (boundary is None and not bodies) or (high <= low).any():
        return np.zeros((0, 0, 0), np.int32), np.zeros((0, len(centres)), np.uint8), np.zeros(3, np.int64)
    first = np.floor(low / tile).astype(np.int64)
    counts = np.floor(high / tile).astype(np.int64) - first + 1
    tiles = int(counts.prod())
    if tiles * len(centres) > MOST_GRAINS:
        raise SceneError(
            f"{where}: level explicit would have to look after {tiles * len(centres):.2g} grains, more than "
            f"{MOST_GRAINS:.2g}; make the medium or the rectangles in it smaller, or the grains larger"
        )
    status = np.full(tuple(counts), EMPTY, np.int32)
    rows: list[np.ndarray] = []
    judge = _Room(place, m, radius, obstacles)
    for index in np.ndindex(*counts):
        corner = (first + index) * tile
        if boundary is not None and ((corner > high).any() or (corner + tile < low).any()):
            continue
        there = (
            judge(corner + radius * centres)
            if judge.near(corner + 0.5 * tile, 0.8661 * tile + radius)
            else (np.full(len(centres), bool(judge.inside((corner + 0.5 * tile)[None])[0])))
        )
        if there.all():
            status[index] = FULL
        elif there.any():
            status[index] = len(rows)
            rows.append(there.astype(np.uint8))
    mask = np.array(rows, np.uint8) if rows else np.zeros((0, len(centres)), np.uint8)
    return status, mask, first


class _Room:
    """Whether a sphere of the grain's radius has room at a place: inside the boundary, clear of it and of surfaces."""

    def __init__(self, place: Place, m: int, radius: float, obstacles: list[np.ndarray]) -> None:
        from scipy.spatial import cKDTree

        self.place, self.m, self.radius = place, m, radius
        boundary = place.boundaries[m]
        walls = obstacles + ([boundary.vertices[boundary.faces]] if boundary is not None else [])
        self.corners = np.ascontiguousarray(np.concatenate(walls)) if walls else np.zeros((0, 3, 3))
        # Candidates for the nearest facet: those whose bounding ball reaches that far
        self.middles = self.corners.mean(axis=1)
        self.extent = np.linalg.norm(self.corners - self.middles[:, None], axis=2).max(axis=1, initial=0.0)
        self.tree = cKDTree(self.middles) if len(self.middles) else None
        self.closed = []  # engine, normals and sign of each closed surface
        for mesh in place.surfaces:
            if mesh is None:
                continue
            try:
                body = grain_from_mesh(mesh.vertices, mesh.faces)
            except GrainError:
                continue  # open: it has no inside
            points = body.centre + body.bounding_radius * body.vertices
            self.closed.append((triangle_scene(points, body.faces), planes_of(points[body.faces])[:, :3]))

    def near(self, point: np.ndarray, distance: float) -> bool:
        """Return whether anything may be nearer to a point (3,) than that."""
        g = self.place.arrays
        if g.kind[self.m] != MESH and abs(exact_depth(g.kind[self.m], g.shape[self.m], tuple(point))) < distance:
            return True
        if any(np.linalg.norm(point - ball[:3]) < ball[3] + distance for ball in g.balls):
            return True
        return bool((np.linalg.norm(self.middles - point, axis=1) - self.extent < distance).any())

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) bool whether points (n, 3) are in the medium and in no closed surface."""
        ok = self.place.inside(self.m, points)
        for engine, normals in self.closed:
            if ok.any():
                ok[ok] = ~within(engine, normals, points[ok])
        return ok

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) bool for centres (n, 3)."""
        g, m = self.place.arrays, self.m
        ok = self.inside(points)
        if g.kind[m] != MESH:
            ok &= np.array([exact_depth(g.kind[m], g.shape[m], tuple(p)) >= self.radius for p in points], bool)
        for ball in g.balls:
            ok &= np.linalg.norm(points - ball[:3], axis=1) >= ball[3] + self.radius
        if self.tree is not None and ok.any():
            ok[ok] = clear(self.corners, self.middles, self.extent, points[ok], self.radius, self.tree)
        return ok


def clear(
    corners: np.ndarray, middles: np.ndarray, extent: np.ndarray, points: np.ndarray, radius: float, tree: Any
) -> np.ndarray:
    """Return (n,) bool whether no triangle is nearer to a point than `radius`."""
    small = extent <= 2.0 * np.median(extent)
    result = np.ones(len(points), bool)
    reach = radius + float(extent[small].max())
    close = np.flatnonzero(tree.query(points, workers=-1)[0] <= reach)
    near = tree.query_ball_point(points[close], reach, workers=-1)
    found = np.ones(len(close), bool)
    sizes = np.fromiter(map(len, near), np.int64, len(near))
    flat = np.fromiter((i for some in near for i in some), np.int64, int(sizes.sum()))
    any_nearer(corners, points[close], np.concatenate(([0], np.cumsum(sizes))), flat, radius, found)
    result[close] = found
    large = np.flatnonzero(~small)
    if len(large):
        every = np.tile(large, len(points))
        any_nearer(corners, points, len(large) * np.arange(len(points) + 1), every, radius, result)
    return result


@njit(**KERNEL)
def any_nearer(corners, points, first, candidates, radius, result):
    """Set `result` to False for points nearer than `radius` to one of their candidate triangles."""
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        for k in range(first[i], first[i + 1]):
            if result[i] and triangle_distance(corners[candidates[k]], p) < radius:
                result[i] = False
