"""Equilibrium: the share of directions inside that light reaches, against random directions and against the tracer."""

import math

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.judge.equilibrium import reach, reach_of_prism, reach_of_sphere
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer


@pytest.mark.slow
@pytest.mark.parametrize("sides", [4, 6])
@pytest.mark.parametrize("eta", [0.8, 1.0, 1.2, 1.31, 1.4, 1.5, 1.544, 2.0, 3.0])
def test_against_random_directions(sides, eta):
    """A direction is reached if it meets some facet within the critical angle; beside it, a slightly wrong index."""
    directions = np.random.default_rng(1).normal(size=(400_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    angles = np.arange(sides // 2) * 2.0 * math.pi / sides
    normals = np.vstack([np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles]), [0.0, 0.0, 1.0]])
    steepest = np.abs(directions @ normals.T).max(axis=1)
    share = float((steepest > math.sqrt(max(0.0, 1.0 - 1.0 / eta**2))).mean())
    error = math.sqrt(share * (1.0 - share) / len(directions))
    assert abs(reach_of_prism(eta, sides) - share) <= 4.5 * error + 1e-12
    if share < 0.99:
        assert abs(reach_of_prism(1.02 * eta, sides) - share) > 4.5 * error


def test_known_values():
    """A box above sqrt(2) has six caps that do not overlap; B = eta^2 reach of spheres as published."""
    assert reach_of_prism(1.544, 4) == pytest.approx(3.0 * (1.0 - math.sqrt(1.0 - 1.0 / 1.544**2)), abs=1e-12)
    assert reach_of_prism(1.2, 4) == reach_of_prism(math.sqrt(1.75) - 1e-9, 6) == 1.0
    assert [round(eta**2 * reach_of_sphere(eta), 4) for eta in (1.3, 1.333, 1.5)] == [1.2491, 1.2632, 1.3183]


def test_only_known_grains_are_judged():
    cube = {"kind": "mesh", "name": "cube", "parameters": {"bevel": 0.0}}
    assert reach(cube, 1.5) == reach_of_prism(1.5, 4)
    assert reach({**cube, "parameters": {"bevel": 0.1}}, 1.5) is None
    assert reach({**cube, "parameters": {}}, 1.5) is None  # a file of that name
    assert reach({**cube, "name": "snow", "parameters": {}}, 1.5) is None
    assert reach({**cube, "name": "hexprism", "parameters": {"aspect": 3.0}}, 1.5) == reach_of_prism(1.5, 6)


@pytest.mark.slow
def test_the_tracer_agrees_where_prisms_are_not_all_reached():
    """A hexagonal prism at 1.5 holds 12 % of directions that no light reaches; were all reached, it would show."""
    grain, tally = load_grain("hexprism"), Tally()
    Tracer(grain, 1.5, seed=1).trace(np.arange(1 << 16), tally)
    from tsdf.grain.optics import Optics
    from tsdf.make import assemble
    from tsdf.make.origin import grain_header

    made = {"command": "", "method": "traced", "seed": 1, "paths": 1 << 16, "max_bounces": 100_000}
    table = assemble.traced_table(tally, 16, grain_header(grain), Optics(1.5), made)
    share, error = table.dark_share
    assert error < 0.005
    assert abs(share - (1.0 - reach_of_prism(1.5, 6))) <= 4.0 * error
    assert abs(share) > 20.0 * error
