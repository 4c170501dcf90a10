"""Regions: of bodies whose pictures are known, exact and as meshes."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsdf.grain.exemplars import icosphere
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture.world import World, build
from tsdf.scene.scene import (
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Rectangle,
    Scene,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.study.regions import Seen, regions, seen

FAR = 1000.0
SIZE = 60
BALL = Sphere((0.0, 0.0, 0.0), 8.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A ball of radius 8, seen from so far that rays are nearly parallel, a quarter of a unit per pixel."""
    table = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=8, joint=1))
    fov = 2.0 * math.degrees(math.atan(10.0 / FAR))
    camera = Camera((0.0, -FAR, 0.0), (0.0, 0.0, 0.0), SIZE, SIZE, fov_deg=fov)
    sun = SunLight((1.0, 0.0, 0.0), (1.0, 1.0, 1.0), 5.0)
    return Scene(camera, (sun,), (MediumSpec(BALL, 0.4, 1.0, (GrainSpec(table),)),), name="ball")


def found(scene: Scene, truth: np.ndarray | None = None) -> dict[str, np.ndarray]:
    return regions(world(scene), np.ones((SIZE, SIZE, 3)) if truth is None else truth)[0]


def world(scene: Scene) -> World:
    return build(scene, "volume")


def test_a_ball_in_the_sun(scene: Scene) -> None:
    """Lit and shadow side are its halves, to the right and to the left, the rim a ring of 5 % of the root of its area;
    no surface is there. Areas are those of circles, to a pixel around each."""
    r = 8.0 * SIZE / 20.0
    at = found(scene)
    assert set(at) == {"whole", "lit side", "shadow side", "rim"}
    assert at["whole"].all()
    assert at["lit side"].sum() + at["shadow side"].sum() == pytest.approx(math.pi * r * r, abs=math.pi * r)
    assert at["lit side"][:, SIZE // 2 :].sum() == at["lit side"].sum() == at["shadow side"].sum()
    width = round(0.05 * math.sqrt(math.pi) * r)
    inner = (at["lit side"] | at["shadow side"]) & ~at["rim"]
    assert inner.sum() == pytest.approx(math.pi * (r - width) ** 2, rel=0.12)
    assert not at["rim"][SIZE // 2, SIZE // 2] and at["rim"][SIZE // 2, round(SIZE / 2 + r) - 1]


def test_distances_and_normals_of_a_mesh_are_those_of_the_ball(scene: Scene, tmp_path: Path) -> None:
    """Of an icosphere of 5120 faces, all but its edge: within what its facets cut off, and normals by its facets."""
    vertices, faces = icosphere(4)
    with open(tmp_path / "ball.obj", "w") as file:
        file.writelines(f"v {x} {y} {z}\n" for x, y, z in 8.0 * vertices)
        file.writelines(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    mesh = replace(scene.media[0], shape=Mesh(tmp_path / "ball.obj"))
    middle = slice(SIZE // 4, -SIZE // 4)
    one, other = (Seen(*(of[middle, middle] for of in seen(world(s)))) for s in (scene, replace(scene, media=(mesh,))))
    assert np.abs(one.near - other.near).max() < 0.02
    assert np.abs(one.far - other.far).max() < 0.02
    assert (one.normal * other.normal).sum(axis=2).min() > 0.99
    assert one.near.min() == pytest.approx(FAR - 8.0, rel=1e-4)
    assert one.far.max() == pytest.approx(FAR + 8.0, rel=1e-4)


@pytest.mark.parametrize(("y", "pixels"), [(0.0, True), (7.0, True), (-20.0, True), (20.0, False)])
def test_objects_within_and_before_a_medium_but_not_behind_it(scene: Scene, y: float, pixels: bool) -> None:
    """A ball of radius 2 is an object within the medium and before it, where it hides that, and not behind it."""
    ball = SurfaceSpec(Sphere((0.0, y, 0.0), 2.0 if y < 7.0 else 0.5), (0.5, 0.5, 0.5))
    at = found(replace(scene, surfaces=(ball,)))
    assert ("object" in at) == pixels
    if pixels:
        r = (2.0 if y < 7.0 else 0.5) * SIZE / 20.0
        assert at["object"].sum() == pytest.approx(math.pi * r * r, abs=2.0 * math.pi * r)
    assert bool(at["lit side"][SIZE // 2, SIZE // 2 + 1]) == (y != -20.0)


def test_a_floor_is_an_object_beside_the_medium_alone(scene: Scene) -> None:
    wall = SurfaceSpec(Rectangle((0.0, 50.0, 0.0), (500.0, 0.0, 0.0), (0.0, 0.0, 500.0)), (0.5, 0.5, 0.5))
    at = found(replace(scene, surfaces=(wall,)))
    assert np.array_equal(at["object"], ~(at["lit side"] | at["shadow side"]))


def test_a_box_from_within_and_without_a_sun(scene: Scene) -> None:
    """A camera in a medium sees it at once, everywhere; without a sun the lit side is the brighter half."""
    medium = replace(scene.media[0], shape=Box((-20.0, -2000.0, -20.0), (20.0, 20.0, 20.0)))
    inside = replace(scene, media=(medium,), lights=(ConstantLight((1.0, 1.0, 1.0)),))
    met = seen(world(inside))
    assert (met.near == 0.0).all() and met.far[SIZE // 2, SIZE // 2] == pytest.approx(FAR + 20.0, rel=1e-5)
    truth = np.ones((SIZE, SIZE, 3)) * np.arange(SIZE)[:, None, None]
    at, notes = regions(world(inside), truth)
    assert at["lit side"][SIZE // 2 + 2 :].all() and not at["lit side"][: SIZE // 2 - 2].any()
    assert "brighter half" in notes[0] and "rim" in notes[1]
