"""Grains that stand alone in a scene, against the same found one by one in their packing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tsdf.picture import render, world
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.walk import facets, standing
from tsdf.walk.room import stand

LIBRARY = Path(__file__).parents[2] / "tsdf" / "data" / "library"


def grain(name: str, fraction: float = 1.0) -> GrainSpec:
    return GrainSpec(LIBRARY / f"{name}.tsdf.exr", fraction, absorption=Absorption("grey", (0.1,)))


def scene(medium: MediumSpec, pixels: int = 16) -> Scene:
    lights = (ConstantLight((0.5, 0.6, 0.7)), SunLight((0.3, -0.4, 0.8), (3.0, 3.0, 3.0), 40.0))
    return Scene(Camera((0.0, -16.0, 7.0), (0.0, 0.0, 0.0), pixels, pixels, fov_deg=30.0), lights, (medium,), name="s")


@pytest.fixture(scope="module")
def heap(tmp_path_factory: pytest.TempPathFactory) -> MediumSpec:
    """A dented body of two kinds of grains, whose spheres stick out."""
    file = tmp_path_factory.mktemp("heap") / "heap.ply"
    ball = trimesh.creation.icosphere(3)
    points = ball.vertices * (4.0, 3.0, 2.5) * (1.0 + 0.2 * np.sin(4.0 * ball.vertices[:, :1]))
    trimesh.Trimesh(points, ball.faces, process=False).export(file)
    return MediumSpec(Mesh(file), 0.5, 0.5, (grain("coarse-snow"), grain("salt", 2.0)), inside="centres")


def pictures(made: world.World, monkeypatch: pytest.MonkeyPatch, spp: int = 16) -> list[render.Picture]:
    """With grains that stand alone, and without."""
    found = [render.render(made, spp=spp, seed=1, threads=1)]
    with monkeypatch.context() as patch:
        patch.setattr(standing, "standing", lambda *_: standing.nothing_standing())
        return [*found, render.render(made, spp=spp, seed=1, threads=1)]


@pytest.mark.slow
@pytest.mark.parametrize("body", ["heap", "box", "ball"])
def test_pictures_are_the_same(body: str, heap: MediumSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Path by path, to rounding, in a dented mesh of two kinds of grains, a box of crystals and a ball of exact spheres
    that hold whole grains; control: another seed."""
    medium = {
        "heap": heap,
        "box": MediumSpec(Box((-4.0, -3.0, -2.0), (4.0, 3.0, 2.0)), 0.3, 0.7, (grain("sugar"),)),
        "ball": MediumSpec(Sphere((0.5, 0.0, 0.0), 3.0), 0.1, 0.5, (grain("glass-beads"),)),
    }[body]
    made = world.build(scene(medium), "explicit")
    one, other = pictures(made, monkeypatch)
    assert one.rgb == pytest.approx(other.rgb, rel=1e-9)
    assert one.events == other.events > 400 and one.faults == other.faults
    assert np.abs(render.render(made, spp=16, seed=2, threads=1).rgb - one.rgb).max() > 0.01


@pytest.mark.slow
def test_chains_and_the_ray_engine(heap: MediumSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chain takes over after two grains where it did; grains of more facets than are kept ask the ray engine."""
    asking = scene(heap)
    asking = replace(asking, render=replace(asking.render, explicit_grains=2))
    for level in ("teleport", "teleport-memory"):
        one, other = pictures(world.build(asking, level), monkeypatch)
        assert one.rgb == pytest.approx(other.rgb, rel=1e-9) and one.events == other.events > 1000
    monkeypatch.setattr(facets, "MOST_FACETS", 100)
    made = world.build(scene(heap), "explicit")
    assert (standing.standing(made.packed, made.place, 2).facets.where < 0).all()
    one, other = pictures(made, monkeypatch)
    assert one.rgb == pytest.approx(other.rgb, rel=1e-6) and one.events == other.events


def test_the_same_grains_stand(heap: MediumSpec) -> None:
    """Those of all tiles around that `room` lets stand, each once, with their own key."""
    made = world.build(scene(heap), "explicit")
    found = standing.standing(made.packed, made.place, 2)
    assert found is standing.standing(made.packed, made.place, 2)
    grains, radius = made.packed.arrays, heap.radius
    side = grains.cells[0].side
    tiles = np.array(list(np.ndindex(4, 4, 4))) - 2
    every = np.ascontiguousarray((grains.centres[0] + side * tiles[:, None]).reshape(-1, 3))
    there = np.zeros(len(every), np.uint8)
    stand(made.place.room, 0, radius * every, there)
    wanted = every[there > 0]
    assert len(found.centre) == len(wanted) > 50
    order, other = (np.lexsort(np.round(v, 9).T) for v in (found.centre, wanted))
    assert found.centre[order] == pytest.approx(wanted[other], abs=1e-9)
    assert len(np.unique(found.key)) == len(found.key)
    assert np.bincount(found.component) / len(found.key) == pytest.approx([1 / 3, 2 / 3], abs=0.2)


def test_where_grains_do_not_stand_alone(heap: MediumSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside surfaces, without an end, and where there are more than are listed."""
    whole = scene(heap)
    ground = SurfaceSpec(Sphere((0.0, 0.0, -40.0), 30.0), (0.5, 0.5, 0.5))
    endless = replace(heap, shape=Slab(-2.0, 2.0))
    for other in (replace(whole, surfaces=(ground,)), scene(endless)):
        made = world.build(other, "explicit")
        assert not standing.standing(made.packed, made.place, 2).there
    made = world.build(whole, "explicit")
    assert standing.standing_of(made.packed, made.place, 2).there
    monkeypatch.setattr(standing, "MOST", 40)
    assert not standing.standing_of(made.packed, made.place, 2).there
