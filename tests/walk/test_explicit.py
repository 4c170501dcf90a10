"""Grains one by one: convex grains of few sides, which need no ray engine."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.handle import Handle
from tsdf.picture import render, world
from tsdf.scene.scene import Absorption, Box, Camera, ConstantLight, GrainSpec, MediumSpec, Scene, SunLight
from tsdf.spheres.packing import next_sphere
from tsdf.walk import standing
from tsdf.walk.explicit import find, sides_of
from tsdf.walk.geometry import planes_of
from tsdf.walk.room import stands
from tsdf.walk.walker import WALKER

SALT = Path(__file__).parents[2] / "tsdf" / "data" / "library" / "salt.tsdf.exr"


@pytest.mark.parametrize(
    "name, settings, sides",
    [("cube", {}, 6), ("hexprism", {}, 8), ("droxtal", {}, 20), ("cube", {"bevel": 0.1}, 26),
     ("sand", {"subdivisions": 2}, 0), ("icosphere", {"subdivisions": 2}, 0)],
)  # fmt: skip
def test_sides(name: str, settings: dict, sides: int) -> None:
    """Of crystals those that textbooks count; none of dented grains, none of those with more than pay."""
    grain = load_grain(name, **settings)
    found = sides_of(grain, planes_of(grain.vertices[grain.faces]))
    assert len(found) == sides and len(set(found)) == sides


@pytest.mark.slow
def test_the_ray_engine_sees_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packed salt that absorbs, in a sun: to the last bit as with a ray for each side that is met."""
    monkeypatch.setattr(standing, "standing", lambda *_: standing.nothing_standing())
    grains = (GrainSpec(SALT, absorption=Absorption("grey", (0.3,))),)
    medium = MediumSpec(Box((-6.0, -6.0, -3.0), (6.0, 6.0, 3.0)), 0.5, 1.0, grains, name="salt")
    lights = (ConstantLight((0.5, 0.6, 0.7)), SunLight((0.3, -0.4, 0.8), (3.0, 3.0, 3.0), 40.0))
    scene = Scene(Camera((0.0, -25.0, 12.0), (0.0, 0.0, 0.0), 24, 18, fov_deg=35.0), lights, (medium,), name="salt")
    made = world.build(scene, "explicit")
    without = made.packed.arrays._replace(first_side=np.zeros(2, np.int64), sides=np.zeros(0, np.int64))
    pictures = [
        render.render(w, spp=16, seed=1)
        for w in (made, replace(made, packed=replace(made.packed, arrays=without)))
    ]  # fmt: skip
    assert made.packed.arrays.first_side.tolist() == [0, 6]
    assert pictures[0].rgb.var() > 0.0 and pictures[0].events > 1000
    assert np.array_equal(pictures[0].rgb, pictures[1].rgb)


@pytest.mark.parametrize("fraction", [0.5, 0.01])
def test_the_next_grain_is_the_first_that_stands(fraction: float) -> None:
    """From anywhere, and from the sphere that was left, the grain that a ray meets in a box is the first sphere along
    it that has its centre in there, as a walk through all spheres finds it, to the last digits.

    Control: spheres that hold no grain are passed on the way, and there are rays that meet no grain."""
    medium = MediumSpec(Box((-4.0, -4.0, -3.0), (4.0, 4.0, 3.0)), fraction, 0.7, (GrainSpec(SALT),), inside="centres")
    scene = Scene(Camera((0.0, -25.0, 12.0), (0.0, 0.0, 0.0), 4, 4), (ConstantLight((1.0,) * 3),), (medium,))
    made = world.build(scene, "explicit")
    grains, room, r, most = made.packed.arrays, made.place.room, 0.7, 40.0
    handles, cells, rng = (Handle(grains), Handle(room)), Handle(grains.cells[0]), np.random.default_rng(5)
    passed, missed, w = 0, 0, np.zeros(1, WALKER)[0]
    for i in range(2_000):
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        if i % 2 or not w["left"]:
            w["p"], w["left"] = rng.uniform(-6.0, 6.0, 3), 0
        else:  # it leaves the sphere of the grain that was found last
            w["p"], d = w["q"] + r * d, d if rng.random() < 0.5 else -d
            d = d if (w["p"] - w["q"]) @ d > 0.0 else -d
        w["d"], t, there = d, 0.0, False
        while not there:
            t, *tile, sphere = next_sphere(cells, tuple(w["p"] / r), tuple(d), t, most)
            if sphere < 0:
                break
            centre = r * (grains.centres[0][sphere] + grains.cells[0].side * np.array(tile))
            there = stands(handles[1], 0, tuple(centre))
            passed += not there
        find(*handles, w, most * r)
        missed += not there
        assert (w["free"] >= 0.0) == there
        w["left"] = 0
        if there:
            assert w["facet"] == sphere + 1 and np.abs(w["e"] - centre).max() < 1e-9
            assert w["free"] == pytest.approx(r * t, abs=1e-9)
            w["q"], w["left"] = w["e"], w["facet"]
    assert passed > 500 and missed > 200 and missed < 1_999


def test_a_grain_is_found_however_far_away() -> None:
    """A ray that passes 20,000 spheres without a grain meets the first one that has its centre in the box."""
    box = Box((0.0, -4.0, -4.0), (4.0, 4.0, 4.0))
    medium = MediumSpec(box, 0.5, 1.0, (GrainSpec(SALT),), inside="centres")
    scene = Scene(Camera((0.0, -25.0, 12.0), (0.0, 0.0, 0.0), 4, 4), (ConstantLight((1.0,) * 3),), (medium,))
    made = world.build(scene, "explicit")
    handles, w = (Handle(made.packed.arrays), Handle(made.place.room)), np.zeros(1, WALKER)[0]
    w["p"], w["d"] = (-25_000.0, 0.1, 0.2), (1.0, 0.0, 0.0)
    find(*handles, w, 1e5)
    assert abs(w["e"]).max() <= 4.0
    assert np.linalg.norm(w["p"] + w["free"] * w["d"] - w["e"]) == pytest.approx(1.0, abs=1e-9)
