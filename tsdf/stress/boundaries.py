"""Rows about boundaries, scales and small lights: walls thinner than a grain, facets that coincide, suns."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tsdf.grain.grains import first_hit, triangle_scene
from tsdf.picture import render
from tsdf.picture.render import Picture
from tsdf.picture.world import beam, build
from tsdf.scene.medium import Component, free_path
from tsdf.scene.scene import (
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Render,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.scene.specs import Light, MediumShape
from tsdf.stress import naive
from tsdf.stress.cells import HYBRID, Measured, Row, Setting, attempted, relative, share
from tsdf.stress.ends import TRUST, level_of
from tsdf.stress.slabs import upward
from tsdf.study.experiment import Experiment, gather, scene_of

GROUP = "Boundaries, scales, small lights"
MEASURED = ("explicit", "teleport-packed", "teleport-memory", "teleport-joint", "teleport", "volume", HYBRID)
ONE = ConstantLight((1.0, 1.0, 1.0))
CAMERA = Camera((0.0, -30.0, 10.0), (0.0, 0.0, 0.0), 16, 12, fov_deg=30.0)
INSIDE = Camera((0.3, -0.2, 0.1), (1.0, 0.5, 0.3), 16, 12, fov_deg=100.0)
LOW, HIGH = (-6.0, -5.0, -4.0), (6.0, 5.0, 4.0)
WALL = 0.005  # [R] half of the thickness of a thin wall
AHEAD = 1e-4  # by which rays that toggle their medium restart
SPHERES = 400  # in the tile of single grains


def scene(
    setting: Setting, shapes: tuple[MediumShape, ...], camera: Camera, lights: tuple[Light, ...] = (ONE,),
    surfaces: tuple[SurfaceSpec, ...] = (), radius: float = 1.0,
) -> Scene:  # fmt: skip
    media = tuple(
        MediumSpec(shape, 0.5, radius, (GrainSpec(setting.ball),), f"medium {k}", packing_spheres=SPHERES)
        for k, shape in enumerate(shapes, 1)
    )
    return Scene(camera, lights, media, surfaces)


def taken(setting: Setting, whole: Scene, method: str, spp: int) -> Picture:
    level, _, singles = level_of(method)
    made = build(replace(whole, render=Render(explicit_grains=singles)), level)
    return render.render(made, spp=spp, seed=setting.seed, threads=setting.threads)


def radiance(method: str, picture: Picture, expected: float) -> Measured:
    """Return the mean of a picture less what is expected, in per cent of the light; its error is at least a sample."""
    value = float(picture.rgb[..., 1].mean())
    error = math.sqrt(float(picture.variance[..., 1].sum())) / picture.samples.size
    error = max(error, 1.0 / float(picture.samples.sum()))
    wrong = picture.faults + picture.truncated
    return Measured(method, 100.0 * (value - expected), 100.0 * error, f"{wrong} given up" if wrong else "")


def thin_wall(setting: Setting) -> Iterator[Measured]:
    """Light below a black wall of .01 R, the camera above, grains on both sides: black, but for what leaks."""
    wall = Box((-1e3, -1e3, -WALL), (1e3, 1e3, WALL))
    below = SunLight((0.0, 0.0, -1.0), (1.0, 1.0, 1.0), 170.0)
    camera = Camera((0.0, 0.0, 30.0), (0.0, 0.0, 0.0), 16, 12, up=(0.0, 1.0, 0.0), fov_deg=20.0)
    dark = (SurfaceSpec(wall, (0.5, 0.5, 0.5), "wall"),)
    whole = scene(setting, (Box(LOW, HIGH),), camera, (below,), dark)
    yield from attempted(
        MEASURED, lambda method: radiance(method, taken(setting, whole, method, setting.some(2000)), 0.0)
    )
    path = free_path([Component(setting.ball)], 0.5)
    through = naive.untested_jumps(setting.ball, path.lambda_beta, 2.0 * WALL, setting.some(400_000), setting.rng(70))
    yield share("untested jumps", int(through.sum()), len(through))


def buried(setting: Setting) -> Iterator[Measured]:
    """The camera is in a hollow box that is buried in grains under bright light: black, but for what leaks."""
    hollow = SurfaceSpec(Box((-1.0, -1.0, -1.0), (2.0, 1.0, 1.0)), (0.5, 0.5, 0.5), "hollow")
    whole = scene(setting, (Box(LOW, HIGH),), INSIDE, (ONE,), (hollow,))
    yield from attempted(
        MEASURED, lambda method: radiance(method, taken(setting, whole, method, setting.some(2000)), 0.0)
    )


def box_mesh(folder: Path, name: str, low: tuple[float, ...], high: tuple[float, ...]) -> Path:
    """Write a box as a mesh of twelve facets."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners)
    text += "".join(f"f {a + 1} {b + 1} {c + 1}\nf {a + 1} {c + 1} {d + 1}\n" for a, b, c, d in quads)
    (folder / name).write_text(text)
    return folder / name


def touching(setting: Setting) -> Iterator[Measured]:
    """Two meshes of grains share a face, and a camera stands on the boundary: a furnace reads 1."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        upper = box_mesh(folder, "upper.obj", (-6.0, -5.0, 0.5), HIGH)
        lower = box_mesh(folder, "lower.obj", LOW, (6.0, 5.0, 0.5))
        camera = replace(INSIDE, position=(6.0, 0.0, 0.5))
        whole = scene(setting, (Mesh(upper), Mesh(lower)), camera)

        def measured(method: str) -> Measured:
            return radiance(method, taken(setting, whole, method, setting.some(200)), 1.0)

        yield from attempted(MEASURED, measured)
    yield toggled(setting)


def toggled(setting: Setting) -> Measured:
    """Rays straight through two boxes that share a face must be outside in the end; inside or not is toggled at each
    facet that is met, in float32, and rays go on a little further along."""
    rays, rng = setting.some(400_000), setting.rng(71)
    quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    faces = np.concatenate((quads[:, :3], quads[:, [0, 2, 3]]))
    corners: list[tuple[float, float, float]] = []
    both: list[np.ndarray] = []
    for low, high in (((-6.0, -5.0, 0.5), HIGH), (LOW, (6.0, 5.0, 0.5))):
        both.append(faces + 8 * len(both))
        corners += [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    vertices, triangles = np.array(corners), np.concatenate(both)
    engine = triangle_scene(vertices, triangles)
    planes = vertices[triangles]
    normal = np.cross(planes[:, 1] - planes[:, 0], planes[:, 2] - planes[:, 0])
    ways = rng.normal(size=(rays, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    at = np.column_stack((rng.uniform(-5.0, 5.0, rays), rng.uniform(-4.0, 4.0, rays), np.full(rays, 0.5)))
    p = at - 50.0 * ways
    inside = np.zeros((rays, 2), bool)  # by body
    on = np.arange(rays)
    for _ in range(12):
        facet = first_hit(engine, p[on], ways[on])
        on, facet = on[facet >= 0], facet[facet >= 0]
        if not len(on):
            break
        n = normal[facet]
        t = np.einsum("ij,ij->i", n, planes[facet, 0] - p[on]) / np.einsum("ij,ij->i", n, ways[on])
        p[on] = p[on] + (t + AHEAD)[:, None] * ways[on]
        inside[on, facet // 12] ^= True
    return share("toggled medium", int(inside.any(axis=1).sum()), rays)


def sheets(setting: Setting) -> Iterator[Measured]:
    """A slab of 10 R cut into ten that touch sends back what it does in one piece."""
    levels = ("teleport-joint", "teleport", "volume", "isotropic")

    def sent_back(level: str, cuts: int) -> tuple[float, float]:
        base = scene_of(Slab(-10.0, 0.0), GrainSpec(setting.ball), 0.6)
        edges = np.linspace(-10.0, 0.0, cuts + 1)
        media = tuple(
            replace(base.media[0], shape=Slab(float(low), float(high)), name=f"sheet {k}")
            for k, (low, high) in enumerate(pairwise(edges))
        )
        world = build(replace(base, media=media), level, leap=0.0)
        made = Experiment(world, beam(world, (0.0, 0.0, 5.0), (0.0, 0.0, -1.0), 1.0), 1, upward)
        sums = gather(made, setting.some(600_000), None, setting.seed + cuts, setting.threads)
        return float(sums.mean[0]), float(sums.error[0])

    yield from attempted(levels, lambda level: relative(level, sent_back(level, 10), sent_back(level, 1)))


def scales(setting: Setting) -> Iterator[Measured]:
    """A mesh of grains around a dark ball, in micrometres, in thousands of kilometres and 1e5 R from the origin, is as
    bright as at the origin: the worst of the three."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        file = box_mesh(folder, "box.obj", LOW, HIGH)

        def sent_back(method: str, scale: float, shift: float, seed: int) -> tuple[float, float]:
            level, _, singles = level_of(method)
            thing = SurfaceSpec(Sphere((shift, 0.0, -shift), 2.0 * scale), (0.0, 0.0, 0.0), "dark")
            whole = scene(setting, (Mesh(file, scale, (shift, 0.0, -shift)),), CAMERA, (ONE,), (thing,), scale)
            made = build(replace(whole, render=Render(explicit_grains=singles)), level)
            camera = beam(made, (shift, 0.0, 9.0 * scale - shift), (0.0, 0.0, -1.0), 4.0 * scale)
            spp = setting.some(400_000)
            picture = render.measure(made, camera, spp=spp, seed=setting.seed + seed, threads=setting.threads)
            return float(picture.rgb[0, 0, 1]), math.sqrt(float(picture.variance[0, 0, 1]))

        def measured(method: str) -> Measured:
            truth = sent_back(method, 1.0, 0.0, 0)
            found = [
                relative(method, sent_back(method, scale, shift, k), truth, f"scale {scale:g}, shift {shift:g}")
                for k, (scale, shift) in enumerate(((1e-6, 0.0), (1e6, 0.0), (1.0, 1e5)), 1)
            ]
            return max(found, key=lambda one: abs(one.value))

        yield from attempted(("explicit", "teleport-packed", "teleport-memory", "teleport", "volume", HYBRID), measured)


def small_sun(setting: Setting) -> Iterator[Measured]:
    """A slab under a sun of .53 degrees: whether the error bar is to be trusted, by the variance of the variance."""
    sun = SunLight((0.3, 0.2, 1.0), (3.0, 3.0, 3.0), 0.53)
    camera = Camera((0.0, -20.0, 20.0), (0.0, 0.0, 0.0), 16, 12, fov_deg=30.0)
    whole = scene(setting, (Slab(-10.0, 0.0),), camera, (sun,))

    def measured(method: str) -> Measured:
        picture = taken(setting, whole, method, setting.some(2000))
        trust = picture.trust
        assert trust is not None
        value = float(picture.rgb.mean())
        doubt = "says so" if trust.doubt else "does not say so" if max(trust.vov, trust.chance) > 0.1 else ""
        return Measured(method, max(trust.vov, trust.chance), note=f"radiance {value:.4g}; {doubt}".rstrip("; "))

    yield from attempted(("explicit", "teleport-packed", "teleport-memory", "teleport", "volume", HYBRID), measured)


ROWS = (
    Row("thin-wall", GROUP, "wall of .01 R between light and camera", "light that leaks", "%", 0.05, thin_wall),
    Row("buried", GROUP, "hollow box buried in bright grains", "light that leaks", "%", 0.05, buried),
    Row("touching", GROUP, "meshes that share a face, camera on it", "furnace; rays in the wrong medium", "%", 0.1,
        touching),
    Row("sheets", GROUP, "slab of 10 R cut into ten that touch", "reflectance", "%", 3.0, sheets,),
    Row("scales", GROUP, "1e-6 and 1e6 times as large, 1e5 R away", "light that a dark ball leaves", "%", 3.0, scales),
    Row("small-sun", GROUP, "sun of .53 degrees", "variance of the variance", "1", 0.1, small_sun,
        {"explicit": TRUST, "teleport-packed": TRUST, HYBRID: TRUST}),
)  # fmt: skip
