"""Rows about how paths end: lossless grains, hardly any and very much absorption, very many events, leaps."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from tsdf.data.table import Table
from tsdf.picture import render
from tsdf.picture.trust import Moments
from tsdf.picture.world import World, build
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.scene import Absorption, Camera, ConstantLight, GrainSpec, MediumSpec, Render, Scene, Slab, Sphere
from tsdf.stress import naive
from tsdf.stress.cells import (
    HYBRID,
    ISOTROPIC_LEAPS,
    LEAPS,
    VOLUME_LEAPS,
    Measured,
    Row,
    Setting,
    attempted,
    known_to,
    relative,
)
from tsdf.study.experiment import Ends, follow, gather, scene_of, slab_experiment
from tsdf.study.ranking import mean_of

GROUP = "Ends of paths"
F = 0.6
TRUST = "rendering.md, Is the error bar to be trusted?"
CAPS: tuple[tuple[str, Callable[[int, np.ndarray, np.random.Generator], np.ndarray]], ...] = (
    ("capped roulette", naive.capped), ("depth cap", naive.ended)
)  # fmt: skip
SINGLES = 5
THICK = 1000.0  # [R] of slabs in a furnace


def level_of(method: str) -> tuple[str, float, int]:
    """Return the level of a method of ours, its leaps and its explicit grains."""
    if method == LEAPS:
        return "teleport-memory", 2.0, 0
    return ("teleport-memory", 0.0, SINGLES) if method == HYBRID else (method, 0.0, 0)


def isotropic_thickness(setting: Setting) -> float:
    """Return how many mean free paths of level isotropic the thick slab has."""
    world = build(scene_of(Slab(-THICK, 0.0), GrainSpec(setting.ball), F), "isotropic", leap=0.0)
    return THICK / float(world.media.free[0])


def furnace(setting: Setting) -> Iterator[Measured]:
    """Constant light around lossless grains is that light."""

    def measured(method: str) -> Measured:
        level, leap, singles = level_of(method)
        camera = Camera((3.0, -30.0, 20.0), (0.0, 0.0, 0.0), 16, 12, fov_deg=30.0)
        medium = MediumSpec(Slab(-THICK, 0.0), F, 1.0, (GrainSpec(setting.ball),), name="slab")
        scene = Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), render=Render(explicit_grains=singles))
        made = build(scene, level, leap=leap if LEVELS[level].traits.leaps else None)
        picture = render.render(made, spp=setting.some(40), seed=setting.seed, threads=setting.threads)
        error = 100.0 * math.sqrt(float(picture.variance[..., 1].sum())) / picture.samples.size
        note = f"{picture.events:.2g} events" + (f", {picture.truncated} given up" if picture.truncated else "")
        return Measured(method, 100.0 * (float(picture.rgb[..., 1].mean()) - 1.0), error, note)

    yield from attempted([*LEVELS, LEAPS, HYBRID], measured)
    thickness = isotropic_thickness(setting)
    for number, (method, end) in enumerate(CAPS):
        ends = naive.isotropic_slab(thickness, 1.0, setting.some(100_000), setting.rng(20 + number), end)
        value, error = mean_of(100.0 * ends.weight)
        yield Measured(method, value - 100.0, error)


def variances(setting: Setting) -> Iterator[Measured]:
    """The variance of an estimate is known as well as it looks: its relative variance, over 32,000 samples."""
    paths = 32_000

    def told(method: str, values: np.ndarray) -> Measured:
        sums = Moments(1)
        sums.add(slice(0, 1), np.zeros(1, np.int64), np.repeat(values[None, :, None], 3, axis=2))
        trust = sums.trust(np.array([len(values)]), (1, 1), 0.0)
        value, error = mean_of(values)
        return Measured(method, trust.vov, note=f"reads {value:.3f}({error:.3f}), slope {trust.slope:.2g}")

    for method in ("isotropic", LEAPS):
        level, leap, _ = level_of(method)
        one = slab_experiment(level, GrainSpec(setting.ball), F, THICK, leap=leap)
        _, ends = follow(one.world, one.camera, paths, setting.seed, threads=setting.threads)
        yield told(method, ends.weight)
    light = naive.isotropic_slab(isotropic_thickness(setting), 1.0, paths, setting.rng(24), naive.capped).weight
    yield told("capped roulette", light)


def absorbing(table: Table, albedo: float) -> float:
    """Return the absorption coefficient at which a grain keeps so much of the light that meets it [1/R]."""
    return float(brentq(lambda c: table.albedo(c) / table.albedo() - albedo, 0.0, 100.0, xtol=1e-15))


def dark(setting: Setting, albedo: float) -> Iterator[Measured]:
    """Half-spaces of isotropic scatterers against Chandrasekhar's H-function."""
    table = setting.ball
    coefficient = absorbing(table, albedo)
    medium = volume_parameters([Component(table)], F, [coefficient])
    seen = medium.albedo * (1.0 - medium.g) / (1.0 - medium.albedo * medium.g)  # by similarity
    truth = (1.0 - naive.h_function(seen) * math.sqrt(1.0 - seen), 0.0)
    free = 1.0 / (medium.sigma_t * (1.0 - medium.albedo * medium.g))
    thickness = max(20.0, 12.0 / math.sqrt(3.0 * (1.0 - seen)))
    grain = GrainSpec(table, absorption=Absorption("grey", (coefficient,)))
    paths = setting.some(400_000 if albedo > 0.9 else 4_000_000)
    for method, leap in (("isotropic", 0.0), (ISOTROPIC_LEAPS, 2.0))[: 2 if albedo > 0.9 else 1]:
        one = slab_experiment("isotropic", grain, F, thickness * free, leap=leap)
        sums = gather(one, paths, None, setting.seed + int(leap), setting.threads)
        yield relative(method, (float(sums.mean[0]), float(sums.error[0])), truth, f"{truth[0]:.5f} expected")
    for number, (method, end) in enumerate(CAPS):
        ends = naive.isotropic_slab(thickness, seen, paths // 4, setting.rng(30 + number), end)
        yield relative(method, mean_of(ends.weight * ends.up), truth)


def billions(setting: Setting) -> Iterator[Measured]:
    """A lossless ball of 1e8 R that holds the camera: light meets 1e15 grains, and comes out."""

    def measured(level: str) -> Measured:
        began = time.perf_counter()
        scene = scene_of(Sphere((0.0, 0.0, 0.0), 1e8), GrainSpec(setting.ball), F, inside="grains")
        scene = replace(scene, camera=Camera((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2, 1))
        picture = render.render(build(scene, level), spp=setting.some(640), seed=setting.seed, threads=setting.threads)
        value = float(picture.rgb.mean()) - 1.0
        note = f"{picture.events:.2g} events in {time.perf_counter() - began:.1f} s, {picture.truncated} given up"
        return Measured(level, 100.0 * value, 0.0, note)

    for one in attempted(["teleport-memory", "volume"], measured):
        yield one._replace(method=LEAPS if one.method == "teleport-memory" else VOLUME_LEAPS)
    for number, (method, end) in enumerate(CAPS):
        light = naive.isotropic_slab(1e8, 1.0, 1000, setting.rng(40 + number), end, 5e7).weight
        yield Measured(method, 100.0 * float(light.mean()) - 100.0, 100.0 * float(light.std()) / len(light) ** 0.5)


def leaps(setting: Setting) -> Iterator[Measured]:
    """What absorption leaves of all light that comes out of a slab of 100 R, against the same level without leaps."""
    grain = GrainSpec(setting.ball, absorption=Absorption("grey", (0.003,)))
    paths, found = setting.some(800_000), {}
    for number, leap in enumerate((0.0, 2.0, -2.0)):
        one = slab_experiment("teleport-memory", grain, F, 100.0, leap=abs(leap))
        if leap < 0.0:
            one.world.leaps.middle[:] = 0.0
        world = one.world

        def left(places: np.ndarray, ends: Ends, world: World = world) -> np.ndarray:
            return np.asarray(ends.weight * np.exp(ends.amounts @ world.absorption.rgb[0]))[:, None]

        sums = gather(replace(one, read=left), paths, None, setting.seed + number, setting.threads)
        found[leap] = (float(sums.mean[0]), float(sums.error[0]))
        drawn = sums.drawn / max(sums.events, 1)
        if not leap:
            yield known_to("teleport-memory", found[leap])
        else:
            name = LEAPS if leap > 0.0 else "leaps about p"
            yield relative(name, found[leap], found[0.0], f"{100.0 * drawn:.0f} % of the events are drawn")


ROWS = (
    Row("furnace", GROUP, "lossless slab of 1000 R in a furnace", "radiance less 1", "%", 0.5, furnace),
    Row("variance", GROUP, "the same, 32,000 samples", "variance of the variance", "1", 0.1, variances),
    Row("albedo-99999", GROUP, "half-space, albedo .99999", "reflectance", "%", 0.2, lambda s: dark(s, 0.99999)),
    Row("albedo-1", GROUP, "half-space, albedo .1", "reflectance", "%", 10.0, lambda s: dark(s, 0.1)),
    Row("billions", GROUP, "camera in a lossless ball of 1e8 R", "radiance less 1", "%", 0.5, billions),
    Row("leaps", GROUP, "slab of 100 R that absorbs", "light that comes out", "%", 1.0, leaps),
)
