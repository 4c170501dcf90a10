"""Scenes of ours in other renderers, for `bench_peers`: Mitsuba, Blender's Cycles and PhotonTracer.

A peer takes a `Scene` as far as it can: one medium of packed grains with grey absorption, lights from infinity, no
surfaces. Mitsuba's ``volpath`` and ``tpt`` get what `tsdf.loaders.mitsuba` makes, Cycles what `tsdf-export --to
blender` writes, PhotonTracer each grain of a packing in its place, as facets. What a peer cannot render it refuses with
`Unable`. Cycles and PhotonTracer are taken where they are installed (`pip install bpy==4.5.15 photontracer`, of which
nothing here depends).
"""

import contextlib
import itertools
import math
import os
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.grain.grains import Grain
from tsdf.grain.meshes import read_mesh
from tsdf.loaders import export
from tsdf.loaders.pointmedium import MOST_BOUNCES, PointMedium
from tsdf.picture import image
from tsdf.picture.world import World
from tsdf.scene.scene import Box, ConstantLight, EnvironmentLight, MediumSpec, Mesh, Scene, Sphere, SunLight
from tsdf.walk import explicit
from tsdf.walk.room import stand

MANY = 1_000_000  # bounces before roulette: none
FACETS = 5  # subdivisions of the icosahedron that stands for the exact sphere: 20,480 facets
ABSENT = "(not installed)"
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
TRAPPED = 20_000  # hits after which PhotonTracer gives up light that total reflection keeps in a grain for ever
MOST_RAYS = 4_000_000  # of PhotonTracer at once, which keeps what comes of each


class Unable(Exception):
    """The peer cannot render this scene; says why."""


class Renderer(Protocol):
    """A peer with a scene."""

    name: str
    level: str  # ours, of the same model

    def shot(self, samples: int, seed: int) -> tuple[np.ndarray, float]:
        """Return a picture (h, w, 3) of so many samples of each pixel, and the processor time it took [s]."""

    def repack(self, world: World) -> None:
        """Take the packing of a world of level explicit, if grains have places."""


def medium_of(scene: Scene) -> tuple[MediumSpec, list[Table]]:
    """Return the only medium of a scene, and its tables."""
    if scene.surfaces or len(scene.media) != 1:
        raise Unable("there is more than one body of grains")
    medium = scene.media[0]
    if any(grain.absorption.kind != "grey" for grain in medium.grains):
        raise Unable("absorption has a colour")
    tables = [grain.table for grain in medium.grains]
    return medium, [table if isinstance(table, Table) else tsdf_format.read(table) for table in tables]


def body_of(medium: MediumSpec) -> Any:
    """Return the boundary of a medium as a trimesh.Trimesh."""
    import trimesh

    if isinstance(medium.shape, Box):
        return trimesh.creation.box(bounds=[medium.shape.low, medium.shape.high])
    if isinstance(medium.shape, Sphere):
        ball = trimesh.creation.icosphere(FACETS, radius=medium.shape.radius)
        return ball.apply_translation(medium.shape.centre)
    if isinstance(medium.shape, Mesh):
        vertices, faces = read_mesh(medium.shape.file)
        return trimesh.Trimesh(medium.shape.placed(vertices), faces, process=False)
    raise Unable("the body is a slab without end")


# ----------------------------------------------------------------------------------------------- Mitsuba


class Mitsuba:
    """Mitsuba 3: stock ``volpath`` with our medium, or our integrator ``tpt``; the variant is set before."""

    def __init__(self, scene: Scene, integrator: str) -> None:
        self.name, self.level = integrator, {"volpath": "volume", "tpt": "teleport"}[integrator]
        self.scene = _in_mitsuba(scene, integrator)

    def shot(self, samples: int, seed: int) -> tuple[np.ndarray, float]:
        import mitsuba as mi

        begin = time.process_time()
        picture = np.array(mi.render(self.scene, spp=samples, seed=seed), float)[..., :3]
        return picture, time.process_time() - begin

    def repack(self, world: World) -> None:
        pass


def _in_mitsuba(scene: Scene, integrator: str) -> Any:
    import mitsuba as mi

    import tsdf.loaders.mitsuba as loader

    medium, tables = medium_of(scene)
    grains = [
        loader.Grain(table, grain.fraction, grain.absorption.coefficient[0])
        for table, grain in zip(tables, medium.grains, strict=True)
    ]
    make = loader.granular if integrator == "tpt" else loader.medium
    interior = make(grains, medium.packing_fraction, medium.radius)
    to, shape = mi.ScalarTransform4f, medium.shape
    if isinstance(shape, Box):
        low, high = np.array(shape.low), np.array(shape.high)
        placed = to().translate(list(0.5 * (low + high))).scale(list(0.5 * (high - low)))
        boundary: dict[str, Any] = {"type": "cube", "to_world": placed}
    elif isinstance(shape, Sphere):
        boundary = {"type": "sphere", "center": list(shape.centre), "radius": shape.radius}
    elif isinstance(shape, Mesh) and shape == Mesh(shape.file) and shape.file.suffix == ".ply":
        boundary = {"type": "ply", "filename": str(shape.file)}
    else:
        raise Unable("the body is no box, ball or PLY file")
    upright = to([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    lights: dict[str, Any] = {}
    for number, light in enumerate(scene.lights):
        if isinstance(light, ConstantLight):
            one: dict[str, Any] = {"type": "constant", "radiance": {"type": "rgb", "value": list(light.radiance)}}
        elif isinstance(light, EnvironmentLight):
            one = {"type": "envmap", "filename": str(light.file), "scale": light.scale}
            one["to_world"] = to().rotate([0, 0, 1], light.rotation_deg) @ upright
        else:
            away = [-x for x in light.direction]
            one = {"type": "directional", "direction": away, "irradiance": {"type": "rgb", "value": light.irradiance}}
        lights[f"light{number}"] = one
    camera = scene.camera
    look = to().look_at(list(camera.position), list(camera.target), list(camera.up))
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": camera.fov_deg, "fov_axis": "x", "to_world": look}
    how = {"type": "tpt"} if integrator == "tpt" else {"type": "volpath", "max_depth": -1, "rr_depth": MANY}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": how,
            "sensor": sensor | {"film": film | {"pixel_format": "rgb"}},
            **lights,
            "body": boundary | {"bsdf": {"type": "null"}, "interior": interior},
        }
    )


# ----------------------------------------------------------------------------------------------- Blender


class Blender:
    """Cycles on the CPU, with the material that `tsdf-export --to blender` writes: one Henyey-Greenstein lobe."""

    name, level = "cycles", "volume-hg"

    def __init__(self, scene: Scene, folder: Path) -> None:
        import bpy
        from mathutils import Vector

        medium, tables = medium_of(scene)
        if len(tables) > 1:
            raise Unable("the exporter makes a medium of one kind of grain")
        self.file = folder / "cycles.exr"
        bpy.ops.wm.read_factory_settings(use_empty=True)
        stage, body, camera = bpy.context.scene, body_of(medium), scene.camera
        point = PointMedium(
            tables[0], medium.packing_fraction, medium.radius, medium.grains[0].absorption.coefficient * 3
        )
        made: dict[str, Any] = {}
        exec(export.blender(export.Request(point, thickness=float(np.ptp(body.vertices, axis=0).min()))), made)
        shell = bpy.data.meshes.new("body")
        shell.from_pydata(body.vertices.tolist(), [], body.faces.tolist())
        shell.materials.append(made["material"])
        stage.collection.objects.link(bpy.data.objects.new("body", shell))
        _light_blender(bpy, stage, scene)
        eye = bpy.data.cameras.new("camera")
        eye.sensor_fit, eye.angle = "HORIZONTAL", math.radians(camera.fov_deg)
        eye.clip_start, eye.clip_end = 1e-3, 1e5
        stage.camera = bpy.data.objects.new("camera", eye)
        stage.collection.objects.link(stage.camera)
        stage.camera.location = camera.position
        ahead = Vector(camera.target) - Vector(camera.position)
        stage.camera.rotation_mode, stage.camera.rotation_quaternion = "QUATERNION", ahead.to_track_quat("-Z", "Y")
        render, cycles = stage.render, stage.cycles
        render.engine, cycles.device = "CYCLES", "CPU"
        render.resolution_x, render.resolution_y, render.resolution_percentage = camera.width, camera.height, 100
        cycles.pixel_filter_type, cycles.use_adaptive_sampling, cycles.use_denoising = "BOX", False, False
        cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.light_sampling_threshold = 0.0
        cycles.blur_glossy, cycles.transparent_max_bounces = 0.0, MOST_BOUNCES
        render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
        render.filepath = str(self.file)
        self.bpy, self.ready = bpy, 0.0
        self.ready = min(self.shot(1, seed)[1] for seed in range(3))

    def shot(self, samples: int, seed: int) -> tuple[np.ndarray, float]:
        """As of `Renderer`; Cycles makes the scene ready anew for each picture, what that takes is not counted."""
        cycles = self.bpy.context.scene.cycles
        cycles.samples, cycles.seed = samples, seed
        with _silent():
            begin = time.process_time()
            self.bpy.ops.render.render(write_still=True)
            took = time.process_time() - begin
        return image.read_exr(self.file).rgb.astype(float), max(took - self.ready, 1e-6)

    def repack(self, world: World) -> None:
        pass


def _light_blender(bpy: Any, stage: Any, scene: Scene) -> None:
    sky = stage.world = bpy.data.worlds.new("sky")
    sky.use_nodes = True
    nodes, links = sky.node_tree.nodes, sky.node_tree.links
    background = nodes["Background"]
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    for number, light in enumerate(scene.lights):
        if isinstance(light, ConstantLight):
            background.inputs["Color"].default_value = (*light.radiance, 1.0)
        elif isinstance(light, EnvironmentLight):
            at, turn, picture = (nodes.new(f"ShaderNode{name}") for name in ("TexCoord", "Mapping", "TexEnvironment"))
            turn.inputs["Rotation"].default_value[2] = math.pi - math.radians(light.rotation_deg)  # its middle is +x
            picture.image = bpy.data.images.load(str(light.file))
            background.inputs["Strength"].default_value = light.scale
            sky.cycles.sampling_method, sky.cycles.sample_map_resolution = "MANUAL", picture.image.size[0]
            links.new(at.outputs["Generated"], turn.inputs["Vector"])
            links.new(turn.outputs["Vector"], picture.inputs["Vector"])
            links.new(picture.outputs["Color"], background.inputs["Color"])
        else:
            sun = bpy.data.lights.new(f"sun {number}", "SUN")
            sun.energy = max(light.irradiance)
            sun.color = [x / sun.energy for x in light.irradiance]
            sun.angle = math.radians(light.angular_diameter_deg)
            from mathutils import Vector

            lamp = bpy.data.objects.new(sun.name, sun)
            lamp.rotation_mode, lamp.rotation_quaternion = "QUATERNION", Vector(light.direction).to_track_quat("Z", "Y")
            stage.collection.objects.link(lamp)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Send what Blender prints, from C as well, nowhere."""
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


# ------------------------------------------------------------------------------------------ PhotonTracer


class PhotonTracer:
    """PhotonTracer on Embree (Ottersberg, Bern): grain by grain as level explicit, polarised, lights met by chance.

    Its exact sphere has facets. What it takes to look up the light of a direction is not counted.
    """

    name, level = "photontracer", "explicit"

    def __init__(self, scene: Scene) -> None:
        import photontracer as pt

        self.scene, self.light = scene, _sky(scene)
        self.medium, tables = medium_of(scene)
        camera = scene.camera
        um = 0.5  # any wavelength does: k makes the absorption coefficient [1/um], and a unit is 1 um
        self.meshes, materials = [], [pt.Material(pt.MaterialType.REFRACTIVE, 1.0 + 0.0j)]
        for spec, table in zip(self.medium.grains, tables, strict=True):
            vertices, faces = facets_of(explicit.exemplar(spec, table, scene.name, scene.folder))
            self.meshes.append(pt.MeshGeometry(np.array(vertices, np.float32), np.array(faces, np.uint32)))
            k = spec.absorption.coefficient[0] * um / (4.0 * math.pi)
            materials.append(pt.Material(pt.MaterialType.REFRACTIVE, complex(table.header["optics"]["eta"], k)))
        self.simulation = pt.Simulation(backend=pt.Backend.EMBREE)
        self.simulation.materials = materials
        self.simulation.wavelength_um, self.simulation.max_scattering_count = um, TRAPPED
        eye = self.eye = pt.CameraRayGenerator()
        eye.image_width, eye.image_height = camera.width, camera.height
        half = math.tan(0.5 * math.radians(camera.fov_deg)) * camera.height / camera.width
        eye.vertical_fov = 2.0 * math.degrees(math.atan(half))
        eye.look_from, eye.look_at, eye.vertical_up = list(camera.position), list(camera.target), list(camera.up)
        eye.focus_distance = math.dist(camera.position, camera.target)
        out = pt.OutputType
        self.state, self.direction = out.RAY_STATE, out.LAST_DIRECTION
        self.simulation.outputs = [self.state, self.direction]
        self.pt = pt

    def shot(self, samples: int, seed: int) -> tuple[np.ndarray, float]:
        shape = (self.scene.camera.height, self.scene.camera.width, samples)
        most = max(1, MOST_RAYS // (shape[0] * shape[1]))
        picture, spent = np.zeros((*shape[:2], 3)), 0.0
        for part, start in enumerate(range(0, samples, most)):
            count = min(most, samples - start)
            self.eye.samples_per_pixel, self.simulation.seed = count, 1 + seed * 1000 + part
            begin = time.process_time()
            self.simulation.ray_generator = self.eye
            self.simulation.run()
            spent += time.process_time() - begin
            flat = (*shape[:2], count)
            free = self.simulation.get_output_buffer(self.state).reshape(flat) == 0
            light = self.light(self.simulation.get_output_buffer(self.direction).reshape(*flat, 3))
            picture += np.where(free[..., None], light, 0.0).sum(axis=2)
        return picture / samples, spent

    def repack(self, world: World) -> None:
        places, kinds = self._places(world)
        self.simulation.geometry = self.pt.InstanceGeometry(self.meshes, places, kinds, 1 + kinds)
        self.shot(1, 0)  # makes it ready

    def _places(self, world: World) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 3, 4) how each grain is turned, scaled and moved, and (n,) uint32 its kind."""
        grains, radius, origin = world.packed.arrays, self.medium.radius, world.place.centre
        side, centres = grains.cells[0].side, grains.centres[0]
        bounds = (body_of(self.medium).bounds - origin) / (radius * side)
        tiles = [range(math.floor(a), math.floor(b) + 1) for a, b in bounds.T]
        found, kinds = [], []
        for i, j, k in itertools.product(*tiles):
            at = np.ascontiguousarray(radius * (centres + side * np.array([i, j, k])))
            there = np.zeros(len(at), np.uint8)
            stand(world.place.room, 0, at, there)
            for sphere in np.flatnonzero(there).tolist():
                key = np.uint64(explicit.named(grains, 0, i, j, k, sphere))
                x, y, z, w = explicit.rotation(key)
                axes = np.array([explicit.rotated((x, y, z), w, axis) for axis in AXES])
                found.append(np.column_stack([radius * axes.T, origin + at[sphere]]))
                kinds.append(explicit.component_of(grains, 0, len(self.meshes), key))
        return np.array(found, np.float32), np.array(kinds, np.uint32)


def facets_of(grain: Grain) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) [R] and triangles (m, 3) of a grain."""
    if grain.kind != "sphere":
        return grain.vertices, grain.faces
    import trimesh

    ball = trimesh.creation.icosphere(FACETS)
    return ball.vertices, ball.faces


def _sky(scene: Scene) -> Any:
    """Return a function of directions (..., 3) to radiance (..., 3)."""
    base, pictures = np.zeros(3), []
    for light in scene.lights:
        if isinstance(light, SunLight):
            raise Unable("its rays meet a small sun by chance alone")
        if isinstance(light, ConstantLight):
            base = base + np.array(light.radiance)
        else:
            pictures.append((light, image.read_exr(light.file).rgb.astype(float)))

    def found(ways: np.ndarray) -> np.ndarray:
        ways = ways.astype(float)
        total = np.broadcast_to(base, ways.shape).copy()
        for light, pixels in pictures:
            height, width = pixels.shape[:2]
            polar = np.arccos(np.clip(ways[..., 2] / np.linalg.norm(ways, axis=-1), -1.0, 1.0))
            along = (light.rotation_deg / 360.0 - np.arctan2(ways[..., 1], ways[..., 0]) / (2.0 * math.pi)) % 1.0
            row = np.minimum((polar / math.pi * height).astype(int), height - 1)
            total += light.scale * pixels[row, np.minimum((along * width).astype(int), width - 1)]
        return total

    return found


# --------------------------------------------------------------------------------------------------- all


def version_of(package: str) -> str:
    """Return the version of a package, or that there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ABSENT


def peers_of(scene: Scene, folder: Path, names: Sequence[str]) -> tuple[list[Renderer], list[str]]:
    """Return the peers that can render a scene, and why the others cannot."""
    makers: dict[str, Any] = {
        "volpath": lambda: Mitsuba(scene, "volpath"),
        "tpt": lambda: Mitsuba(scene, "tpt"),
        "cycles": lambda: Blender(scene, folder),
        "photontracer": lambda: PhotonTracer(scene),
    }
    found: list[Renderer] = []
    said = []
    for name in names:
        needs = {"cycles": "bpy", "photontracer": "photontracer"}.get(name, "mitsuba")
        if version_of(needs) == ABSENT:
            said.append(f"{name} is not measured: Python's package {needs} is not installed")
            continue
        try:
            found.append(makers[name]())
        except Unable as why:
            said.append(f"{scene.name}: no {name}: {why}")
    return found, said
