"""Grains one by one: convex grains of few sides, which need no ray engine."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.picture import render, world
from tsdf.scene.scene import Absorption, Box, Camera, ConstantLight, GrainSpec, MediumSpec, Scene, SunLight
from tsdf.walk.explicit import sides_of
from tsdf.walk.geometry import planes_of

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
def test_the_ray_engine_sees_the_same() -> None:
    """Packed salt that absorbs, in a sun: to the last bit as with a ray for each side that is met."""
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
