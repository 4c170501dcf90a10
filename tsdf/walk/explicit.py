"""Grains one by one, the truth that every model is measured against: a packing of bounding spheres, a grain in each.

A medium is filled by a periodic tile of spheres (`packing`), in which a grain stands where there is room (`room`).
Which exemplar it is and how it is turned are functions of its place. Light enters a bounding sphere, is brought into
the grain's frame, and goes one way at each hit, as in nature. The exact sphere and convex grains of few sides, cubes
and prisms, are followed here without a ray engine, all others where they stand alone (`standing`), by cells of facets;
else they share one ray-engine scene for each exemplar.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsdf.compiled import bits_of, njit
from tsdf.data.sampler import turned as on_circle
from tsdf.data.table import Table
from tsdf.errors import SceneError, TSDFError
from tsdf.grain.grains import BUILT_INS, Grain, embree_scene, grain_from_mesh, load_grain
from tsdf.grain.meshes import read_mesh
from tsdf.grain.optics import OFFSET, UNPOLARISED, P, S, fresnel, nearer, on_plane, parted, sound
from tsdf.sampling import GOLDEN, key_of, mix, unit
from tsdf.scene.scene import GrainSpec, Scene, called
from tsdf.spheres.around import ENDLESS, Around, across, around_of, entered, next_around
from tsdf.spheres.packing import Cells, Packing, cells_of, next_sphere, pack
from tsdf.vectors import KERNEL, dot, renewed, step, triple, unit_of
from tsdf.walk.geometry import NONE, planes_of
from tsdf.walk.room import stands
from tsdf.walk.walker import write

KEPT = 4096  # spheres of a packing, at most, that stays in memory for the next scene
EXACT_SPHERE = -1
ENTERED, INSIDE, RETRIED, LEFT = 0, 1, 2, 4
MOST_SIDES = 64  # of a convex grain that needs no ray engine, which with more is faster
SIDE, LAST = np.int64(MOST_SIDES - 1), np.int64(2**63 - 1)  # the bits of a number of a side, and beyond all distances
HARDLY = 1e-6  # [R] beyond a sphere where no grain stands, the next is looked for
FLAT = 1e-9  # [R] planes that near to each other are one side, and no vertex of a convex grain is higher over one


class Grains(NamedTuple):
    """What kernels ask about packed grains. The first three are tuples over media, the rest arrays.

    cells, centres, around: the tile's grid, its (n, 3) centres [R], and the spheres around each; radius (m,): R [unit];
    seed (m,) uint64. Of components:
    share (c,): running sum of number fractions in each medium; eta, kept_apart (c,) (the polarisations), exemplar (c,)
    int32: ray-engine scene. Of the exemplars' facets: planes (f, 4), centroids (f, 3), first_facet (e,). first_side
    (e + 1,), sides (s,), side_planes (4, s): of exemplars that are convex and have few sides, a facet of each side and
    its plane.
    """

    cells: tuple[Cells, ...]
    centres: tuple[np.ndarray, ...]
    around: tuple[Around, ...]
    radius: np.ndarray
    seed: np.ndarray
    share: np.ndarray
    eta: np.ndarray
    kept_apart: np.ndarray
    exemplar: np.ndarray
    planes: np.ndarray
    centroids: np.ndarray
    first_facet: np.ndarray
    first_side: np.ndarray
    sides: np.ndarray
    side_planes: np.ndarray


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
def named(grains, m, i, j, k, sphere):
    """Return the key of the grain in a sphere of tile (i, j, k) of medium m, of which it is a function."""
    tile = key_of(grains.seed[m], (i + 1048576) * 2097152 + (j + 1048576), k + 1048576)
    return mix(tile + np.uint64(sphere))


@njit(**KERNEL)
def find(grains, room, w, t_max):
    """Find the next grain that a walker meets, nearer than t_max [unit], and write down where it is, or that it is not
    known where. Most often it is one of those around the sphere that the walker has just left."""
    m, p, d, number = w.medium, triple(w.p), triple(w.d), w.left - 1
    r, around, cells = grains.radius[m], grains.around[m], grains.cells[m]
    o, most, w.free = (p[0] / r, p[1] / r, p[2] / r), t_max / r, -1.0
    if number >= 0 and cells.reach <= ENDLESS:
        q, c = (w.q[0] / r, w.q[1] / r, w.q[2] / r), grains.centres[m]
        home = tile(step(q, -1.0, (c[number, 0], c[number, 1], c[number, 2])), 1.0 / cells.side, 0.5)
        sphere, i, j, k, _, _ = next_around(around, number, step(o, -1.0, q), d, most)
        i, j, k = i + int(home[0]), j + int(home[1]), k + int(home[2])
    else:
        sphere, i, j, k = beyond(cells, around, o, d, 0.0, most)
    start = 0.0
    while sphere >= 0:
        centre = centre_of(grains, m, i, j, k, sphere)
        away = step(centre, -1.0, p)
        s = max(entered((away[0] / r, away[1] / r, away[2] / r), d)[0], 0.0)
        if stands(room, m, centre):
            w.free, w.grain, w.facet = r * s, named(grains, m, i, j, k, sphere), sphere + 1
            write(w.e, centre)
            return
        before, start = (sphere, i, j, k), max(s, start) + HARDLY
        sphere, i, j, k = beyond(cells, around, o, d, start, most)
        if (sphere, i, j, k) == before:  # hardly touched, it seems to be farther
            _, i, j, k, sphere = next_sphere(cells, o, d, start, most)


@njit(**KERNEL)
def beyond(cells, around, o, d, start, most):
    """Return the sphere that a ray from o enters first between two distances, its number, -1 for none, and tile."""
    if cells.reach > ENDLESS:  # so few spheres that the wide cells' float32 is not enough
        _, i, j, k, sphere = next_sphere(cells, o, d, start, most)
        return sphere, i, j, k
    home = tile(o, 1.0 / cells.side, 0.0)
    sphere, i, j, k = across(around, step(o, -cells.side, home), d, start, most)
    return sphere, i + int(home[0]), j + int(home[1]), k + int(home[2])


@njit(forceinline=True, **KERNEL)
def tile(x, per_side, half):
    """Return the numbers of a tile along the axes, as floats."""
    return (
        math.floor(x[0] * per_side + half) * 1.0,
        math.floor(x[1] * per_side + half) * 1.0,
        math.floor(x[2] * per_side + half) * 1.0,
    )


@njit(**KERNEL)
def rotation(key):
    """Return the uniformly random rotation (Shoemake 1992) of a grain's key, a quaternion (x, y, z, w)."""
    u = unit(mix(key + np.uint64(1)))
    c1, s1 = on_circle(unit(mix(key + np.uint64(2))))
    c2, s2 = on_circle(unit(mix(key + np.uint64(3))))
    a, b = math.sqrt(1.0 - u), math.sqrt(u)
    return a * s1, a * c1, b * s2, b * c2


@njit(**KERNEL)
def rotated(axis, w, v):
    """Return a triple turned by the quaternion of vector `axis` and scalar w."""
    x, y, z = axis
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
        p = unit_of(step(p, 2.0 * cos_t, d))
        length += 2.0 * cos_t
        key = mix(key + GOLDEN)
        if unit(key) >= reflectance:
            d = step((eta * d[0], eta * d[1], eta * d[2]), cos_i - eta * cos_t, p)
            return p, d, length, key
        d = step(d, -2.0 * dot(d, p), p)


@njit(**KERNEL)
def side_met(grains, e, w):
    """Return the facet of convex exemplar e that a walker in its frame meets next, -1 for none."""
    p, d, planes, first = triple(w.e), triple(w.d), grains.side_planes, grains.first_side[e]
    x, y, z, h = planes[0], planes[1], planes[2], planes[3]
    # Several sides are worked out at once: as whole numbers, the bits of distances are in their order, and the last few
    # have room for the side
    entry, way_out, misses = np.int64(0), LAST, np.int64(0)
    for at in range(first, grains.first_side[e + 1]):
        cosine = x[at] * d[0] + y[at] * d[1] + z[at] * d[2]
        under = h[at] - (x[at] * p[0] + y[at] * p[1] + z[at] * p[2])
        t = under / cosine
        key = bits_of(t if t > 0.0 else 0.0) & ~SIDE | (at - first)
        way_out = min(way_out, key if cosine > 0.0 else LAST)
        entry = max(entry, key if cosine < 0.0 else np.int64(0))
        misses |= np.int64((cosine == 0.0) & (under < 0.0))
    if w.state & INSIDE:
        return grains.sides[first + (way_out & SIDE)] if way_out < LAST else NONE
    return grains.sides[first + (entry & SIDE)] if SIDE < entry < way_out and misses == 0 else NONE


@njit(**KERNEL)
def at_facet(grains, w, facet):
    """Take a walker in a grain's frame to the facet that the ray engine found, -1 for none, and on: its facet, its key
    and where its next ray starts, off the facet along its normal.

    Returns
    -------
    p, d : triples
        Where it is and the way it goes on, both as they were if the same ray is to be repeated from nearer the middle
        of the facet it came from.
    length : float
        Travelled inside [R].
    state : int
        INSIDE, RETRIED and LEFT (the light left the grain for good) as bits.
    fault : bool
        The light was inside and met nothing, twice: it is set free where it is.
    """
    p, d, eta, last = triple(w.p), triple(w.d), grains.eta[w.component], w.facet
    write(w.e, p)
    inside = (w.state & INSIDE) != 0
    if facet < 0 and not inside:
        w.facet = facet
        return p, d, 0.0, LEFT, False
    n, cosine, t = (0.0, 0.0, 0.0), 0.0, math.inf
    if facet >= 0:
        n, cosine, t = on_plane(grains.planes[facet], p, d)
    if not sound(cosine, t, inside):
        if last < 0 or w.state & RETRIED:
            w.facet = facet
            return p, d, 0.0, LEFT, inside
        write(w.e, nearer(grains.centroids[last], p))
        return p, d, 0.0, w.state | RETRIED, False
    t = max(t, 0.0)
    p = step(p, t, d)
    length = t if inside else 0.0
    reflectance, mirrored, refracted = parted(d, n, cosine, 1.0 / eta if inside else eta, UNPOLARISED)
    w.key = mix(w.key + GOLDEN)
    if unit(w.key) < reflectance:
        d = mirrored
    else:
        d, inside = refracted, not inside
    d = renewed(d)
    p = step(p, -OFFSET if inside else OFFSET, n)
    write(w.e, p)
    w.facet = facet
    return p, d, length, INSIDE if inside else 0, False


@njit(**KERNEL)
def rim_of(p, d):
    """Return the distance along d from p to the unit sphere, from within."""
    along = dot(p, d)
    return math.sqrt(max(0.0, along * along + 1.0 - dot(p, p))) - along


# --------------------------------------------------------------------------------------------- from specs


@dataclass(eq=False)
class Packed:
    """The grains of a scene: arrays for kernels, the exemplars' ray-engine scenes and corners of facets (f, 3, 3) [R];
    `kept` is for `standing`."""

    arrays: Grains
    engines: list
    meshes: list[np.ndarray]
    notes: tuple[str, ...]
    kept: Any = None

    def hits(self, e: int, starts: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Return (n,) int32 the facet each ray meets first on exemplar e, -1 for none."""
        prims = self.engines[e].run(starts, ways)
        return np.where(prims >= 0, prims + np.int32(self.arrays.first_facet[e]), np.int32(-1))


def nothing_packed(media: int, components: int) -> Packed:
    """Return grains for the levels that have none."""
    cells = Cells(1.0, 1, 0.0, np.zeros((0, 3)), np.zeros(2, np.int32), np.zeros(0, np.int32))
    arrays = Grains(
        cells=(cells,),  # one, whatever the number of media, which would be part of the type
        centres=(np.zeros((0, 3)),),
        around=(around_of(None),),
        radius=np.ones(media),
        seed=np.zeros(media, np.uint64),
        share=np.ones(components),
        eta=np.ones(components),
        kept_apart=np.zeros(components, np.bool_),
        exemplar=np.full(components, EXACT_SPHERE, np.int32),
        planes=np.zeros((0, 4)),
        centroids=np.zeros((0, 3)),
        first_facet=np.zeros(0, np.int64),
        first_side=np.zeros(1, np.int64),
        sides=np.zeros(0, np.int64),
        side_planes=np.zeros((4, 0)),
    )
    return Packed(arrays, [], [], ())


def sides_of(grain: Grain, planes: np.ndarray) -> list[int]:
    """Return a facet of each side of a convex grain; none of one that has dents or many sides.

    planes : (f, 4) float64
        Normal and height over the origin of its facets.
    """
    found: list[int] = []
    left = np.arange(len(planes))
    while len(left):
        plane = planes[left[0]]
        if len(found) == MOST_SIDES or (grain.vertices @ plane[:3]).max() > plane[3] + FLAT:
            return []
        found.append(int(left[0]))
        left = left[np.abs(planes[left] - plane).max(axis=1) > FLAT]
    return found


def built_in(table: Table) -> bool:
    """Return whether a table was made of a grain that is known by name."""
    header = table.header["grain"]
    return header["kind"] == "sphere" or header["name"] in BUILT_INS


def mesh_beside(table: Table, folders: Sequence[str | Path]) -> Path | None:
    """Return the file with the name of the grain that a table was made of, in the first of these folders that has it;
    None if the grain is built in, or there is no such file."""
    if built_in(table):
        return None
    files = (Path(folder) / Path(table.header["grain"]["name"]).name for folder in folders)
    return next((file for file in files if file.is_file()), None)


@lru_cache(maxsize=4)
def _built_in(name: str, parameters: tuple[tuple[str, Any], ...]) -> Grain:
    """Return a built-in grain; experiments ask for the same over and over."""
    return load_grain(name, **dict(parameters))


def exemplar(spec: GrainSpec, table: Table, where: str, folder: str | None = None) -> Grain:
    """Return the grain that a table was made of: built in, or from the mesh file that the scene names or, without that,
    the file of its name beside the table, else in the scene's folder.

    Raises
    ------
    SceneError
        There is no such file, it cannot be read, or it holds another grain.
    """
    header = table.header["grain"]
    beside = [] if isinstance(spec.table, Table) else [spec.table.parent]
    mesh = spec.mesh or mesh_beside(table, beside if folder is None else [*beside, folder])
    if mesh is None and built_in(table):
        try:
            grain = _built_in(header["name"], tuple(header["parameters"].items()))
        except TSDFError as error:
            raise SceneError(f"{where}: {error}; build the table again") from None
    else:
        if mesh is None:
            raise SceneError(
                f"{where}: the table's grain {header['name']!r} is neither built in nor a file beside the table or the "
                'scene: name its file as mesh = "..."'
            )
        try:
            vertices, faces = read_mesh(mesh)
            grain = grain_from_mesh(vertices, faces, name=str(mesh))
        except TSDFError as error:
            raise SceneError(f"{where}: {error}") from None
    if grain.mesh_hash != header["mesh_sha256"]:
        raise SceneError(
            f"{where}: {grain.name} is not the grain the table was made of; name that one's file as mesh, or build the "
            "table again"
        )
    return grain


def laid(packing: Packing) -> tuple[Cells, np.ndarray, Around]:
    """Return what kernels take of a packing: `cells`, `centres` and `around` of `Grains`."""
    return cells_of(packing), np.ascontiguousarray(packing.centres), around_of(packing)


@lru_cache(maxsize=8)
def _packing(fraction: float, spheres: int, seed: int) -> tuple[Packing, tuple[Cells, np.ndarray, Around]]:
    """Return a packing and what kernels take of it; experiments ask for the same few over and over."""
    packing = pack(fraction, spheres, seed)
    return packing, laid(packing)


def packed(scene: Scene, tables: Sequence[Table], traced: bool = True) -> Packed:
    """Pack the media of a scene with the grains of its tables, one table for each component of each medium in turn.

    Grains that are not to be `traced` need not be found.

    Raises
    ------
    SceneError
        A grain that cannot be found, a packing fraction beyond what random packings reach.
    """
    titles = [f"{scene.name}: {called('medium', m, medium.name)}" for m, medium in enumerate(scene.media, 1)]
    own = [(spec, where) for medium, where in zip(scene.media, titles, strict=True) for spec in medium.grains]
    grains = [
        exemplar(spec, table, where, scene.folder) if traced else None
        for (spec, where), table in zip(own, tables, strict=True)
    ]
    spheres: list[tuple[Cells, np.ndarray, Around]] = []
    notes = []
    share, eta, kept_apart, chosen = [], [], [], []
    engines: list[Any] = []
    known: dict[str, int] = {}
    planes, centroids, first_facet, sides = [np.zeros((0, 4))], [np.zeros((0, 3))], [], [np.zeros(0, np.int64)]
    meshes: list[np.ndarray] = []
    facets, at = 0, 0
    for medium, where in zip(scene.media, titles, strict=True):
        try:
            made = _packing if medium.packing_spheres <= KEPT else _packing.__wrapped__
            packing, found = made(medium.packing_fraction, medium.packing_spheres, medium.packing_seed)
        except TSDFError as error:
            raise SceneError(f"{where}: {error}") from None
        spheres.append(found)
        notes.append(f"{where}: {len(packing.centres)} spheres in a tile of {packing.side:.4g} R, "
                     f"packing fraction {packing.fraction:.6f}")  # fmt: skip
        fractions = np.array([grain.fraction for grain in medium.grains])
        share += list(np.cumsum(fractions) / fractions.sum())
        for grain, table in zip(grains[at : at + len(fractions)], tables[at : at + len(fractions)], strict=True):
            eta.append(table.header["optics"]["eta"])
            kept_apart.append(table.header["optics"]["fresnel"] == "sp")
            if grain is None or grain.kind == "sphere":
                chosen.append(EXACT_SPHERE)
                continue
            if grain.mesh_hash not in known:
                known[grain.mesh_hash] = len(engines)
                corners = grain.vertices[grain.faces]
                planes.append(planes_of(corners))
                centroids.append(corners.mean(axis=1))
                first_facet.append(facets)
                sides.append(facets + np.array(sides_of(grain, planes[-1]), np.int64))
                meshes.append(corners)
                facets += len(corners)
                engines.append(embree_scene(grain))
            chosen.append(known[grain.mesh_hash])
        at += len(fractions)
    arrays = Grains(
        cells=tuple(cells for cells, _, _ in spheres),
        centres=tuple(centres for _, centres, _ in spheres),
        around=tuple(around for _, _, around in spheres),
        radius=np.array([medium.radius for medium in scene.media]),
        seed=np.array([medium.packing_seed for medium in scene.media], np.uint64),
        share=np.array(share),
        eta=np.array(eta, np.float64),
        kept_apart=np.array(kept_apart, np.bool_),
        exemplar=np.array(chosen, np.int32),
        planes=np.concatenate(planes),
        centroids=np.concatenate(centroids),
        first_facet=np.array(first_facet, np.int64),
        first_side=np.cumsum([len(own) for own in sides]),
        sides=np.concatenate(sides),
        side_planes=np.ascontiguousarray(np.concatenate(planes)[np.concatenate(sides)].T),
    )
    return Packed(arrays, engines, meshes, tuple(notes))
