"""The colour of a deep medium, rendered: what `tsdf.scene.deep` says, and not what a little more absorption would."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import tsdf
from tsdf.cli import info
from tsdf.cli import render as cli_render
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.effort import Effort
from tsdf.make.scatterometer import exact_sphere
from tsdf.picture.colour import rendered
from tsdf.scene.deep import absorption_of_colour, deep_colour
from tsdf.scene.medium import Component, volume_parameters

ASKED = (0.7, 0.4, 0.1)


@pytest.fixture(scope="module")
def ball():
    return exact_sphere(load_grain("sphere"), Optics(1.31, material="ice"), Effort(cells=64))


@pytest.mark.slow
def test_the_renderer_agrees(ball):
    """Level volume, deep and a slab, within 4 standard errors; 15 % more absorption in one channel is found."""
    found = absorption_of_colour(ball, ASKED)
    seen, error = rendered(ball, found, 0.5, samples=3000, threads=1)
    assert error.max() < 0.004
    assert np.abs(seen - ASKED).max() < 0.01 and (np.abs(seen - ASKED) < 4.0 * error).all()
    assert abs(deep_colour(ball, 1.15 * found[1]) - seen[1]) > 4.0 * error[1]
    slab, error = rendered(ball, found, 0.5, thickness=12.0, samples=3000, threads=1)
    depths = [12.0 * volume_parameters([Component(ball)], 0.5, [x]).sigma_t for x in found]
    expected = [deep_colour(ball, x, depth) for x, depth in zip(found, depths, strict=True)]
    assert (np.abs(slab - expected) < 4.0 * error + 0.002).all()  # the renderer's sigma_t is one for all channels
    assert slab[0] < ASKED[0] - 0.1


@pytest.mark.slow
def test_info_renders_the_colour(ball, tmp_path):
    """tsdf-info says what a level makes of it, and the absorption of a colour as far off on the other side."""
    tsdf.write(ball, tmp_path / "ball.tsdf.exr")
    arguments = [tmp_path / "ball.tsdf.exr", "--json", "--packing", 0.6, "--deep-colour", "0.7,0.4,0.1"]
    done = CliRunner().invoke(info.main, [*map(str, arguments), "--render-colour", "teleport"])
    assert done.exit_code == 0, done.output
    colour = json.loads(done.stdout)["colour"]
    seen = colour["rendered"]
    aims = [2.0 * a - s for a, s in zip(ASKED, seen["colour"], strict=True)]
    assert [deep_colour(ball, x) for x in seen["absorption_times_radius"]] == pytest.approx(aims, abs=1e-6)
    assert np.abs(np.subtract(seen["colour"], ASKED)).max() < 0.03
    assert max(seen["standard_errors"]) < 0.005


def test_a_picture_says_both_sides(ball, tmp_path):
    """The summary of tsdf-render has sizes and densities in all words, and a colour's absorption in all conventions."""
    tsdf.write(ball, tmp_path / "ball.tsdf.exr")
    (tmp_path / "a.toml").write_text("""
        metres_per_unit = 0.001
        camera = { position = [0, -3, 3], target = [0, 0, 0], width = 8, height = 6 }
        light = [{ type = "constant", radiance = 1.0 }]
        [[medium]]
        shape = { type = "slab", low = -4.0, high = 0.0 }
        effective_radius = 0.1
        density = 183.4
        grain = [{ table = "ball.tsdf.exr", deep_colour = [0.7, 0.4, 0.1] }]
    """)
    arguments = [tmp_path / "a.toml", "--out", tmp_path / "a.exr", "--level", "volume", "--spp", 1, "--threads", 1]
    done = CliRunner().invoke(cli_render.main, [str(a) for a in arguments])
    assert done.exit_code == 0, done.output
    x = absorption_of_colour(ball, ASKED)
    units = {"R": 1.0, "unit": 0.1, "m": 1e-4}
    said = " = ".join(f"{', '.join(f'{a / by:.4g}' for a in x)} / {unit}" for unit, by in units.items())
    for part in ("radius 0.1, packing_fraction 0.2 = ", "density 183.4 kg/m3", "ssa 32.72 m2/kg", said):
        assert part in done.stdout
