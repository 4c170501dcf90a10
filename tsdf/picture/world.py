"""World: a scene at one level of detail, as the arrays that `transport` follows light through.

Media become numbers in `media`; how light uses them is `transport`, pictures are `render`. The levels, cheapest first:
isotropic (point scatterers, similarity), volume-hg (one Henyey-Greenstein lobe), volume (tabulated deflections),
teleport (Algorithm 1 of Meng et al. 2015), teleport-joint (its offsets kept together), teleport-memory (where
neighbours are as well), teleport-packed (packed grains, answered by records), explicit (packed grains, traced).
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import assert_never

import numpy as np
from numpy.typing import ArrayLike

from tsdf.data import format as tsdf_format
from tsdf.data import library
from tsdf.data.sampler import Tables, compile_tables
from tsdf.data.table import Table
from tsdf.errors import SceneError, TSDFError, UsageError
from tsdf.grain.grains import first_hit
from tsdf.picture import image
from tsdf.picture.footprint import met_by_pixel
from tsdf.picture.leaping import GAMMA, checked, leaping
from tsdf.picture.media import DARKEST, media_of, spectra_of
from tsdf.picture.trust import MOST_VOV, kurtosis_of
from tsdf.scene.levels import AUTO, LEVELS, Traits
from tsdf.scene.medium import Component, VolumeParameters, free_path
from tsdf.scene.scene import (
    Box,
    ConstantLight,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Scene,
    Slab,
    SunLight,
    called,
)
from tsdf.scene.sizes import MATERIAL_DENSITY, InWords, grain_sizes
from tsdf.scene.specs import SPP
from tsdf.spheres.packing_table import law
from tsdf.vectors import frame
from tsdf.walk.explicit import Packed, nothing_packed, packed
from tsdf.walk.geometry import Place, Triangles, ball_hit, exact_hit, place
from tsdf.walk.hybrid import ALL, hybrid_notes, singles_of
from tsdf.walk.leaps import Leaps
from tsdf.walk.lights import LightArrays, compile_lights
from tsdf.walk.memory import Memory
from tsdf.walk.records import memory_of
from tsdf.walk.room import BALL, BOX, MESH
from tsdf.walk.transport import NOBODY, CameraArrays
from tsdf.walk.walker import MAX_EVENTS, UNENDING, Attenuation, Media

CAPTIVES = 32  # paths that look for a way out from the camera
OUTLIVED = 1000.0  # of the grains met in the mean, after which a path that leaps is given up: no light lives as long
MOST_EVENTS = 1 << 60  # that a walker counts
BOUNCES = 500  # after which there is none; a hole of a thousandth of all surfaces is found by then
SLOW = 1e5  # grains met by a path, beyond which it is said how long that takes
ENDLESS = 1e7  # beyond which a path takes seconds
EVENTS_PER_SECOND = 1e7  # of one thread, about
LATTICE = 16  # places along each side of a box that it looks for
LOOKS = 200  # pixels along each side through which it is looked whether the camera sees anything


@dataclass(eq=False)
class World:
    """What light meets in a scene at a level.

    Attributes
    ----------
    scene : Scene
    level : str
    leap : float
        Radius of the smallest leap in transport mean free paths, 0 where no medium is deep enough.
    place : Place
        Geometry and its ray engine.
    brim : Place
        Where the chain goes on after the first grains if that is another place: media that it fills to the brim.
    packed : Packed
        Grains that are met one by one.
    media, tables, memory, leaps, lights, absorption
        Arrays for kernels.
    amounts : int
        How many amounts of matter a walker counts.
    parameters : tuple of VolumeParameters
        Of the media, at the luminance-weighted mean of their absorption.
    notes : tuple of str
        What the user should know, one line each.
    sizes : tuple of InWords
        Of the media, in everybody's words.
    empty : tuple of int
        Numbers of the media, from 1 on, that no grain fits in: single grains are not there.
    met : (h * w,) int64
        Of its explicit grains, how many a pixel counts as met before it begins; () where all have as many.
    """

    scene: Scene
    level: str
    leap: float
    place: Place
    brim: Place
    packed: Packed
    media: Media
    tables: Tables
    memory: Memory
    leaps: Leaps
    lights: LightArrays
    absorption: Attenuation
    amounts: int
    parameters: tuple[VolumeParameters, ...]
    notes: tuple[str, ...]
    sizes: tuple[InWords, ...]
    empty: tuple[int, ...] = ()
    met: np.ndarray = field(default_factory=lambda: NOBODY)


def camera_of(world: World) -> CameraArrays:
    """Return the pinhole camera of a scene for kernels, relative to the scene's centre."""
    camera = world.scene.camera
    position = np.array(camera.position) - world.place.centre
    view = _unit(np.array(camera.target) - np.array(camera.position))
    right = _unit(np.cross(view, _unit(np.array(camera.up))))
    down = np.cross(view, right)
    pixel = 2.0 * math.tan(0.5 * math.radians(camera.fov_deg)) / camera.width
    corner = view - 0.5 * pixel * (camera.width * right + camera.height * down)
    still = (0.0, 0.0, 0.0)
    return CameraArrays(
        _triple(position), still, still, _triple(corner), _triple(pixel * right), _triple(pixel * down), camera.width
    )


def sees(world: World) -> bool:
    """Return whether anything of the scene is in the picture, as far as one ray for each of some pixels tells, and some
    points of each thing.

    Raises
    ------
    SceneError
        If the camera is shut in by white surfaces, between which paths would go on for ever.
    """
    place, camera = world.place, camera_of(world)
    if _shut_in(world, camera):
        raise SceneError(
            f"{world.scene.name}: the camera is shut in by white surfaces, where no light gets and no path ends; "
            "move it out, open them or make them darker"
        )
    width, height = world.scene.camera.width, world.scene.camera.height
    x, y = ((np.arange(min(n, LOOKS)) + 0.5) * n / min(n, LOOKS) for n in (width, height))
    ways = np.array(camera.corner) + x[:, None, None] * camera.right + y[None, :, None] * camera.down
    ways = (ways / np.linalg.norm(ways, axis=2, keepdims=True)).reshape(-1, 3)
    starts = np.broadcast_to(camera.origin, ways.shape)
    if any((first_hit(engine, starts, ways) >= 0).any() for engine in place.engines):
        return True
    g = place.arrays
    exact = [m for m in range(len(g.kind)) if g.kind[m] != MESH]
    for d in map(_triple, ways):
        if len(g.balls) and ball_hit(g.balls, camera.origin, d)[1] >= 0:
            return True
        for m in exact:
            t, inside, _ = exact_hit(g.kind[m], g.shape[m], camera.origin, d)
            if inside or t < math.inf:
                return True
    points = _points(place) - camera.origin  # of what is smaller than pixels
    across, down, ahead = np.linalg.solve(np.stack((camera.right, camera.down, camera.corner), axis=1), points.T)
    before = ahead > 0.0
    across, down = across[before] / ahead[before], down[before] / ahead[before]
    return bool(((across >= 0.0) & (across < width) & (down >= 0.0) & (down < height)).any())


def _points(place: Place) -> np.ndarray:
    """Return points (n, 3) of boundaries and surfaces, or within, some of each."""
    g = place.arrays
    meshes = [mesh for mesh in (*place.boundaries, *place.surfaces) if mesh is not None]
    parts = [mesh.vertices[mesh.faces[:: -(-len(mesh.faces) // LOOKS)]].mean(axis=1) for mesh in meshes]
    parts += [g.balls[:, :3], g.shape[g.kind == BALL, :3]]
    lattice = np.stack(np.meshgrid(*[(np.arange(LATTICE) + 0.5) / LATTICE] * 3), axis=-1).reshape(-1, 3)
    parts += [shape[:3] + lattice * (shape[3:] - shape[:3]) for shape in g.shape[g.kind == BOX]]
    return np.concatenate([part.reshape(-1, 3) for part in parts])


def check_sight(world: World) -> None:
    """Raise SceneError where the picture would show nothing of the scene, or paths would go on for ever."""
    if not sees(world):
        raise SceneError(
            f"{world.scene.name}: a camera looking at nothing: it sees neither a medium nor a surface; move its target"
        )


def _shut_in(world: World, camera: CameraArrays) -> bool:
    """Return whether paths from the camera neither leave the scene nor end, if media were clear; by following some."""
    place, g = world.place, world.place.arrays
    if not world.scene.surfaces:
        return False
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(CAPTIVES, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = np.tile(np.array(camera.origin), (CAPTIVES, 1))
    brightest = g.reflectance.max(axis=1)
    for _ in range(BOUNCES):
        distance, normal, owner = np.full(len(points), np.inf), np.zeros((len(points), 3)), np.full(len(points), -1)
        if g.solid:
            facet = first_hit(place.engines[0], points, ways)
            met = np.flatnonzero(facet >= 0)
            plane = g.grid.facets[facet[met]]
            cosine = np.einsum("ij,ij->i", plane[:, :3], ways[met])
            distance[met] = (plane[:, 3] - np.einsum("ij,ij->i", plane[:, :3], points[met])) / cosine
            normal[met], owner[met] = plane[:, :3], g.surface[facet[met]]
        for i in range(len(points) if len(g.balls) else 0):
            t, b = ball_hit(g.balls, _triple(points[i]), _triple(ways[i]))
            if b >= 0 and t < distance[i]:
                distance[i], owner[i] = t, g.ball_surface[b]
                normal[i] = _unit(points[i] + t * ways[i] - g.balls[b, :3])
        if (owner < 0).any():
            return False
        goes_on = rng.random(len(points)) < brightest[owner]
        if not goes_on.any():
            return False
        points, ways, distance, normal = (v[goes_on] for v in (points, ways, distance, normal))
        normal *= -np.sign(np.einsum("ij,ij->i", normal, ways))[:, None]
        points = points + distance[:, None] * ways
        points += 1e-6 * (np.abs(points).max(axis=1, keepdims=True) + distance[:, None]) * normal
        ways = normal + _units(rng.normal(size=normal.shape))  # a cosine-weighted direction
        ways = _units(ways)
    return True


def _units(v: np.ndarray) -> np.ndarray:
    units: np.ndarray = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)
    return units


def beam(world: World, origin: ArrayLike, direction: ArrayLike, width: float = 0.0) -> CameraArrays:
    """Return a camera whose one pixel is a parallel beam, a square of given width about `origin` [unit]."""
    d = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    a, b = (width * np.array(v) for v in frame(_triple(d)))
    start = np.asarray(origin, np.float64) - world.place.centre - 0.5 * (a + b)
    still = (0.0, 0.0, 0.0)
    return CameraArrays(_triple(start), _triple(a), _triple(b), _triple(d), still, still, 1)


def _unit(v: np.ndarray) -> np.ndarray:
    """Return a vector at unit length, however short or long."""
    v = v / np.abs(v).max()
    unit: np.ndarray = v / np.linalg.norm(v)
    return unit


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def build(
    scene: Scene, level: str, limit: int = MAX_EVENTS, leap: float | None = None,
    progress: Callable[[float, str], None] | None = None, places: dict[bool, Place] | None = None,
    packings: dict[bool, Packed] | None = None,
) -> World:  # fmt: skip
    """Return a scene ready to be rendered at a level.

    Parameters
    ----------
    scene : Scene
    level : str
    limit : int
        Grains met after which a path is given up; many more, if it is not given, where paths leap over most of them.
    leap : float, optional
        Radius of the smallest leap in transport mean free paths, 0 for none; else what the scene says, or `GAMMA`,
        where the level leaps at all.
    progress : callable, optional
        Called with the share done and a word about it while records for leaps are made.
    places : dict, optional
        Geometry of the same scene, as far as it has been made, with and without single grains; it is added to.
    packings : dict, optional
        Its packed grains likewise, traced and not.

    Raises
    ------
    SceneError, FormatError, UsageError
        In one line, for whatever makes the scene impossible at that level.
    """
    if level not in LEVELS:
        hint = "; tsdf-plan chooses one" if level == AUTO else ""
        raise SceneError(f"{scene.name}: no level {level!r}; levels are {', '.join(LEVELS)}{hint}")
    traits, singles = LEVELS[level].traits, singles_of(scene, level)
    gamma = _gamma(scene, level, leap)
    read: dict[str, Table] = {}

    def table_of(spec: GrainSpec) -> Table:
        if isinstance(spec.table, Table):
            return spec.table
        file = os.path.realpath(spec.table)  # each file once, by whatever name
        if file not in read:
            read[file] = tsdf_format.read(spec.table)
        return read[file]

    tables = [table_of(grain) for medium in scene.media for grain in medium.grains]
    places = {} if places is None else places

    def placed(grains: bool) -> Place:
        if grains not in places:
            places[grains] = place(scene, grains=grains)
        return places[grains]

    made = brim = placed(traits.placed or singles > 0)
    if not traits.placed and singles and any(medium.inside == "centres" for medium in scene.media):
        brim = placed(False)
    notes = list(made.notes)
    media, absorption, parameters = media_of(scene, traits, tables, limit)
    if records := LEVELS[level].records:
        for grain, table in zip((g for m in scene.media for g in m.grains), tables, strict=True):
            if not getattr(table, records.block):
                raise SceneError(
                    f"{scene.name}: {grain.table} has no {records.name}, which level {level} draws from; "
                    f"build it with {records.option}"
                )
    memory = _memory(scene, tables if traits.remembers or traits.answered else [], traits.remembers)
    layers, empty = [], []
    for number, (medium, boundary) in enumerate(zip(scene.media, made.boundaries, strict=True), 1):
        extent = _extent(medium, boundary.vertices if boundary is not None else None)
        sticks_out = medium.inside == "centres" and boundary is None
        layers.append(extent / medium.radius - (0.0 if sticks_out else 2.0))
        empty.append(2.0 * medium.radius > extent and medium.inside == "grains")
        if empty[-1]:
            notes.append(
                f"{scene.name}: {called('medium', number, medium.name)}: a grain of diameter {2.0 * medium.radius:g} "
                f"does not fit into the medium, which is {extent:.3g} thin: "
                + ("no grain is there" if singles or traits.remembers else "it is filled as if with smaller grains")
                + '; take smaller grains (radius is in units of the scene), or inside = "centres"'
            )
    lights, said = _lights(scene)
    compiled = compile_tables(tables or [_no_table()], joint=traits.joint)
    leaps, deep = leaping(scene, brim, media, compiled, memory, tables, gamma, lights, progress)
    met = _grains_met(scene, traits, tables, made, parameters, limit)
    if singles:
        media = media._replace(free=np.where(empty, UNENDING, media.free))
        singles = 0 if all(empty) else singles  # none is met, and lights are aimed at as in a scene without
    if any(deep) and limit == MAX_EVENTS:
        longest = OUTLIVED * max(n for n, there in zip(met, deep, strict=True) if there)
        media = media._replace(limit=int(min(max(limit, longest), MOST_EVENTS)))
    notes += _long_paths(scene, [0.0 if there else n for n, there in zip(met, deep, strict=True)])
    notes += said
    samples = (scene.render.spp or SPP) * scene.camera.width * scene.camera.height
    if singles and scene.media and lights.sampled and kurtosis_of(lights) > MOST_VOV * samples:
        notes.append(
            f"{scene.name}: {f'level {level} meets' if traits.packed else 'explicit grains meet'} suns and small "
            "bright lights by chance alone: until many samples have, the picture is too dark and its variance does not "
            "tell; widen the sun or light by a smooth sky"
        )
    if singles and not traits.packed:
        notes += hybrid_notes(scene, tables, layers)
    grains = nothing_packed(len(scene.media), len(tables))
    if singles and scene.media:
        traced, packings = not traits.answered, {} if packings is None else packings
        if traced not in packings:
            packings[traced] = packed(scene, tables, traced)
        grains = packings[traced]
    ready = World(
        scene=scene,
        level=level,
        leap=gamma if any(deep) else 0.0,
        place=made,
        brim=brim,
        packed=grains,
        media=media._replace(singles=singles),
        tables=compiled,
        memory=memory,
        leaps=leaps,
        lights=lights,
        absorption=absorption,
        amounts=len(absorption.least),
        parameters=parameters,
        notes=(*notes, *grains.notes),
        sizes=tuple(_sizes(scene, tables)),
        empty=tuple(number for number, none in enumerate(empty, 1) if none),
    )
    if scene.render.fewer_far and 0 < singles < ALL:
        ready.met = met_by_pixel(scene, made, camera_of(ready), singles)
    return ready


def _sizes(scene: Scene, tables: list[Table]) -> Iterator[InWords]:
    """Return size and amount of the grains of each medium."""
    at = 0
    for medium in scene.media:
        grains = [(table, grain.fraction) for grain, table in zip(medium.grains, tables[at:], strict=False)]
        at += len(grains)
        sizes = grain_sizes(grains, dict(medium.sizes).get(MATERIAL_DENSITY))
        yield InWords(sizes, medium.packing_fraction, medium.radius, scene.metres_per_unit)


def _memory(scene: Scene, tables: list[Table], chained: bool) -> Memory:
    """Return what tables remember of entries and, where light goes from sphere to sphere in a chain, packings of their
    neighbours; of nothing where there are no tables."""
    if not tables:
        return memory_of([], [], [], [])
    laws, grains, at = [], [], 0
    for number, medium in enumerate(scene.media, 1):
        own = tables[at : at + len(medium.grains)]
        at += len(own)
        if chained:
            try:
                laws.append(law(medium.packing_fraction))
            except TSDFError as error:
                raise SceneError(f"{scene.name}: {called('medium', number, medium.name)}: {error}") from None
        grains.append([(table, grain.fraction) for grain, table in zip(medium.grains, own, strict=True)])
    fractions = [medium.packing_fraction for medium in scene.media]
    return memory_of(laws, fractions, [medium.radius for medium in scene.media], grains)


def grains_met(
    medium: MediumSpec, boundary: Triangles | None, inside: bool, extinction: float, transport: float
) -> float:
    """Return about how many lossless grains a path meets in a medium in the mean, from a camera outside or inside it.

    The mean path through a body is its mean chord 4 V/S, whatever it scatters (Blanco & Fournier 2003); from the middle
    of a ball out it is 9/32 of that squared over the transport mean free path, by diffusion.

    Parameters
    ----------
    medium : MediumSpec
    boundary : Triangles or None
        Where the medium is bounded by a mesh.
    inside : bool
        Whether the camera is in the medium.
    extinction, transport : float
        Extinction coefficient [1/unit] and transport mean free path [unit].
    """
    chord = mean_chord(medium, boundary)
    return max(chord, 9.0 / 32.0 * chord * chord / transport if inside else 0.0) * extinction


def mean_chord(medium: MediumSpec, boundary: Triangles | None) -> float:
    """Return the mean chord 4 V/S of a medium [unit], by its mesh where it has one."""
    shape = medium.shape
    if isinstance(shape, Slab):
        return 2.0 * (shape.high - shape.low)
    if isinstance(shape, Box):
        return float(2.0 / (1.0 / (np.array(shape.high) - np.array(shape.low))).sum())
    if isinstance(shape, Mesh):
        assert boundary is not None
        a, b, c = boundary.vertices[boundary.faces].swapaxes(0, 1)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        return float(4.0 / 6.0 * abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / area)
    return 4.0 / 3.0 * shape.radius


def _gamma(scene: Scene, level: str, leap: float | None) -> float:
    """Return the smallest radius of leaps in transport mean free paths; UsageError where it cannot be what is asked."""
    can = LEVELS[level].traits.leaps
    if leap is None:
        named = scene.render.leap
        return (GAMMA if named is None else checked(named)) if can else 0.0
    if checked(leap) and not can:
        raise UsageError(f"{scene.name}: level {level} cannot leap, for its grains have their places; leave out leap")
    return leap


def _grains_met(
    scene: Scene, traits: Traits, tables: list[Table], place: Place, parameters: Sequence[VolumeParameters], limit: int
) -> list[float]:
    """Return how many grains a path meets in each medium in the mean, about, until absorption or the limit ends it."""
    found, at = [], 0
    camera = np.array(scene.camera.position) - place.centre
    for m, (medium, volume) in enumerate(zip(scene.media, parameters, strict=True)):
        own = list(zip(medium.grains, tables[at : at + len(medium.grains)], strict=True))
        at += len(own)
        grains = [Component(table, grain.fraction, medium.radius) for grain, table in own]
        extinction = free_path(grains, medium.packing_fraction).sigma_t
        if traits.similar and volume.albedo > 0.0:
            extinction *= 1.0 - volume.g
        inside = bool(place.inside(m, camera[None])[0])
        events = grains_met(medium, place.boundaries[m], inside, extinction, volume.transport_mean_free_path)
        kept = max(
            table.albedo(spectra_of(grain.absorption, scene.metres_per_unit).least * medium.radius)
            / max(table.albedo(), DARKEST)
            for grain, table in own
        )
        found.append(min(events, 1.0 / max(1.0 - kept, DARKEST), limit if limit != MAX_EVENTS else math.inf))
    return found


def _long_paths(scene: Scene, met: Sequence[float]) -> list[str]:
    """Return what is to be said of media in which paths meet very many grains; SceneError where they hardly end."""
    notes = []
    for m, (medium, events) in enumerate(zip(scene.media, met, strict=True)):
        title = called("medium", m + 1, medium.name)
        where = f"{scene.name}: {title}: light meets about {events:.1g} grains in the mean"
        if not events <= ENDLESS:
            raise SceneError(
                f"{where} on its way through, which would take minutes a path; take larger grains, a smaller medium or "
                "a lower packing fraction"
            )
        if events > SLOW:
            pixels = scene.camera.width * scene.camera.height
            notes.append(
                f"{where} on its way through: a sample of each of the {pixels} pixels takes about "
                f"{pixels * events / EVENTS_PER_SECOND:.1g} s of one thread"
            )
    return notes


def _extent(medium: MediumSpec, vertices: np.ndarray | None) -> float:
    """Return the smallest extent of a medium along the axes."""
    shape = medium.shape
    if isinstance(shape, Slab):
        return shape.high - shape.low
    if isinstance(shape, Box):
        return float((np.array(shape.high) - np.array(shape.low)).min())
    if isinstance(shape, Mesh):
        assert vertices is not None
        return float(np.ptp(vertices, axis=0).min())
    return 2.0 * shape.radius


def _no_table() -> Table:
    """Return a table for scenes without media, whose kernels want one."""
    return tsdf_format.read(library.FOLDER / f"glass-beads{library.SUFFIX}")


def _lights(scene: Scene) -> tuple[LightArrays, list[str]]:
    """Return the lights of a scene, and what is to be said of its environment."""
    constant, suns, environment, rotation = np.zeros(3), [], None, 0.0
    notes: list[str] = []
    for light in scene.lights:
        if isinstance(light, ConstantLight):
            constant += light.radiance
        elif isinstance(light, SunLight):
            suns.append((light.direction, light.angular_diameter_deg, light.irradiance))
        elif isinstance(light, EnvironmentLight):
            if environment is not None:
                raise SceneError(f"{scene.name}: more than one environment light; add the images into one file")
            environment, said = image.read_environment(light.file)
            environment *= light.scale
            rotation = light.rotation_deg
            notes += [f"{scene.name}: {note}" for note in said]
        else:
            assert_never(light)
    try:
        return compile_lights(constant, environment, rotation, suns), notes
    except TSDFError as error:
        raise SceneError(f"{scene.name}: {error}") from None
