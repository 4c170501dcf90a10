"""Light in lanes does what it does alone: the same samples, one by one, with the same random numbers."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render, world
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Scene,
    Slab,
    Sphere,
    SunLight,
)
from tsdf.walk import lanes, transport, walker

ONE = ConstantLight((1.0, 1.0, 1.0))
SUN = SunLight((0.36, -0.48, 0.8), (3.0, 2.0, 1.0), 2.0)
BOX = Box((-4.0, -5.0, -3.0), (6.0, 5.0, 4.0))
BALL = Sphere((0.5, 0.3, -0.2), 5.0)
OUTSIDE = Camera((3.0, -30.0, 7.0), (0.0, 0.0, 0.0), 20, 15, fov_deg=30.0)
INSIDE = Camera((0.3, -0.2, 0.1), (1.0, 0.5, 0.3), 16, 12, fov_deg=100.0)
ABOVE = Camera((0.0, 0.0, 30.0), (1.0, 2.0, 0.0), 16, 12, fov_deg=60.0)
SAMPLES = 20


def scene_of(shape, lights, *grains, camera=OUTSIDE) -> Scene:
    return Scene(camera, lights, (MediumSpec(shape, 0.5, 1.0, grains, name="grains"),))


def followed(made: world.World, in_lanes: bool, seed: int = 3, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Return the radiance (samples, 3) of all samples of a picture, and the counters."""
    walkers = render.Walkers(made)
    assert walkers.lanes is not None
    if not in_lanes:
        walkers.lanes = None
    camera = made.scene.camera
    job = transport.Job(world.camera_of(made), 0, samples, 0, seed)
    found = walkers.follow(job, camera.width * camera.height, threading.Event())
    return found.reshape(-1, 3), walkers.counters


def alike(found: np.ndarray, other: np.ndarray) -> float:
    """Return the share of samples that agree but for rounding."""
    return float((np.abs(found - other) <= 1e-9 * np.abs(other).max()).all(axis=1).mean())


def check(made: world.World) -> None:
    """The same light and events in lanes as alone; another seed's samples would not pass."""
    (found, events), (other, expected) = followed(made, True), followed(made, False)
    assert alike(found, other) > 0.9995
    assert abs(events[walker.EVENTS] / expected[walker.EVENTS] - 1.0) < 1e-3
    assert events[walker.TRUNCATED] == events[walker.FAULTS] == 0
    assert alike(followed(made, True, seed=4)[0], other) < 0.8


@pytest.mark.parametrize("level", ["teleport", "teleport-joint", "volume", "volume-hg", "isotropic"])
def test_same_samples(level: str, table, sky) -> None:
    """At each level that lanes know; a sky that differs in all directions tells samples apart."""
    check(world.build(scene_of(BOX, (sky,), GrainSpec(table)), level))


@pytest.mark.parametrize("level", ["teleport", "teleport-joint", "volume", "volume-hg", "isotropic"])
def test_same_light_that_is_aimed(level: str, table, sky) -> None:
    """With a sun, among grains that absorb: shadows, roulette, amounts."""
    grain = GrainSpec(table, absorption=Absorption("rgb", (0.02, 0.1, 0.5)))
    check(world.build(scene_of(BOX, (SUN, sky), grain), level))


@pytest.mark.parametrize(
    "shape, camera",
    [
        (BOX, INSIDE), (Slab(-3.0, 3.0), INSIDE), (Slab(-3.0, 3.0), ABOVE), (Slab(-3.0, 0.5), OUTSIDE),
        (BALL, INSIDE), (BALL, OUTSIDE),
    ],
)  # fmt: skip
def test_same_in_each_shape_and_from_inside(shape, camera, table, sky) -> None:
    check(world.build(scene_of(shape, (SUN, sky), GrainSpec(table), camera=camera), "teleport"))


def test_same_among_grains_of_two_kinds(table, sky) -> None:
    """Of which one absorbs, by wavelength."""
    dark = Absorption("spectral", (0.1, 0.4, 0.9), (360.0, 550.0, 830.0))
    other = exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=32, joint=0))
    grains = GrainSpec(table, 0.7), GrainSpec(other, 0.3, absorption=dark)
    check(world.build(scene_of(BOX, (SUN, sky), *grains), "teleport"))


@pytest.mark.slow
@pytest.mark.parametrize("lights", [1, 2])
def test_same_where_light_leaps(lights: int, table, sky) -> None:
    """In a box that is deep enough for leaps, among grains that absorb a little."""
    grain = GrainSpec(table, absorption=Absorption("grey", (0.001,)))
    deep = Box((-60.0,) * 3, (60.0,) * 3)
    camera = Camera((30.0, -400.0, 70.0), (0.0, 0.0, 0.0), 12, 9, fov_deg=15.0)
    made = world.build(scene_of(deep, (sky, SUN)[:lights], grain, camera=camera), "teleport", leap=1.0)
    check(made)
    found, expected = followed(made, True)[1], followed(made, False)[1]
    assert abs(found[walker.LEAPS] / expected[walker.LEAPS] - 1.0) < 0.01 and expected[walker.LEAPS] > 1000


@pytest.mark.parametrize("limit", [1, 2, 6])
def test_handed_over(limit: int, table, sky) -> None:
    """Light that has met many grains is handed over, and goes on as it would have; given up, it is counted. Of a limit
    of one, all of it is, more than there is room for at once."""
    made = world.build(
        scene_of(BOX, (SUN, sky), GrainSpec(table), camera=INSIDE if limit == 1 else OUTSIDE), "teleport"
    )
    few = replace(made, media=made.media._replace(limit=limit))
    (found, counted), (other, expected) = (followed(few, here, samples=60) for here in (True, False))
    assert alike(found, other) > 0.9995
    assert counted[walker.TRUNCATED] == expected[walker.TRUNCATED] > 1000
    assert counted[walker.EVENTS] == pytest.approx(expected[walker.EVENTS], rel=1e-3)


def test_furnace_is_exact(table) -> None:
    """Light that loses nothing is 1 to the last bit, in every pixel."""
    for shape in (BOX, BALL):
        picture = render.render(world.build(scene_of(shape, (ONE,), GrainSpec(table)), "teleport"), spp=32, seed=1)
        assert (picture.rgb == 1.0).all() and picture.truncated == 0


def test_any_number_of_threads_and_portions(table, sky) -> None:
    """Pictures are the same bytes for any number of threads, and samples whatever is followed with them."""
    made = world.build(scene_of(BOX, (SUN, sky), GrainSpec(table)), "teleport")
    one, three = (render.render(made, spp=300, seed=2, threads=threads) for threads in (1, 3))
    assert (one.rgb == three.rgb).all() and one.events == three.events
    walkers, camera = render.Walkers(made), world.camera_of(made)
    whole = walkers.follow(transport.Job(camera, 0, 8, 0, 5), 300, threading.Event())
    part = walkers.follow(transport.Job(camera, 100, 3, 4, 5), 20, threading.Event())
    assert (part == whole[100:120, 4:7]).all()


def test_stops_when_told(table) -> None:
    """A job ends soon after others say so."""
    stop = threading.Event()
    stop.set()
    made = world.build(scene_of(BOX, (ONE,), GrainSpec(table)), "teleport")
    walkers = render.Walkers(made)
    walkers.follow(transport.Job(world.camera_of(made), 0, 1000, 0, 5), 300, stop)
    assert walkers.counters[walker.EVENTS] == 0


def test_who_walks_in_lanes(table) -> None:
    """A lone box, slab or ball, at levels that know no packing; nothing else."""

    def walks(*shapes, level: str = "teleport") -> bool:
        media = tuple(MediumSpec(shape, 0.5, 1.0, (GrainSpec(table),)) for shape in shapes)
        made = world.build(Scene(OUTSIDE, (ONE,), media), "teleport")
        return lanes.suited(made.place.arrays, made.media._replace(traits=LEVELS[level].traits))

    assert walks(BOX) and walks(Slab(0.0, 1.0)) and walks(BOX, level="isotropic")
    assert not any(walks(BOX, level=level) for level in ("explicit", "teleport-packed", "teleport-memory"))
    assert walks(BALL) and not walks(BALL, level="teleport-memory")
    assert not walks(BOX, Box((10.0, 0.0, 0.0), (15.0, 5.0, 5.0)))


def test_logarithm() -> None:
    """It is the library's to three units in the last place, from the smallest number that is drawn to 1."""
    x = np.concatenate((np.random.default_rng(2).random(20000), 2.0 ** -np.arange(54.0), [1.0 - 2.0**-53]))
    x = x[x > 0.0]
    found = np.array([lanes.logarithm(one) for one in x])
    assert (np.abs(found - np.log(x)) <= 3.0 * np.spacing(np.abs(np.log(x)))).all()
    assert math.isinf(-lanes.logarithm(0.0)) or lanes.logarithm(0.0) < -700.0
