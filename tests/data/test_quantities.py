"""A table in others' words: exact for the sphere, with the errors of unrelated builds for a traced prism."""

import math

import numpy as np
import pytest

from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.judge.equilibrium import reach_of_prism
from tsdf.make import assemble
from tsdf.make.origin import grain_header
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer

SEEDS = 12


@pytest.fixture(scope="module")
def prisms() -> list[Table]:
    """Return the same prism by other random numbers."""
    grain, tables = load_grain("hexprism"), []
    for seed in range(SEEDS):
        tally = Tally()
        Tracer(grain, 1.31, seed=seed).trace(np.arange(1 << 13), tally)
        made = {"command": "", "method": "traced", "seed": seed, "paths": 1 << 13, "max_bounces": 100_000}
        tables.append(assemble.traced_table(tally, 64, grain_header(grain), Optics(1.31), made))
    return tables


def ball(eta: float = 1.3, fresnel: str = "un", cells: int = 256) -> Table:
    return exact_sphere(load_grain("sphere"), Optics(eta, fresnel), Effort(cells=cells))


@pytest.mark.parametrize(("eta", "b"), [(1.3, 1.2491), (1.333, 1.2632), (1.5, 1.3183)])
@pytest.mark.parametrize("fresnel", ["un", "sp"])
def test_enhancement_of_spheres(eta, b, fresnel):
    """Libois et al. 2014 have 1.25 for ice; the exact law whatever the Fresnel convention."""
    found = ball(eta, fresnel, 16).absorption_enhancement
    assert found.value == pytest.approx(eta**2 * (1.0 - (1.0 - 1.0 / eta**2) ** 1.5), abs=1e-9)
    assert round(found.value, 4) == b
    assert found.error == 0.0


def test_a_sphere_in_others_words():
    table = ball(fresnel="sp")
    assert table.asymmetry_factor().value == pytest.approx(0.7922, abs=5e-5)  # Kokhanovsky 2001
    assert table.asymmetry_factor().error == 0.0
    assert table.projected_area == pytest.approx((math.pi, 0.0))
    assert table.effective_radius == pytest.approx((1.0, 0.0))
    assert table.dark_share.value == pytest.approx((1.0 - 1.0 / 1.69) ** 1.5, abs=1e-9)
    assert table.asymmetry_factor_far_field().value == pytest.approx((1.0 + table.mean_cosine()) / 2.0)
    for x in (0.01, 1.0):
        truth = analytic.sphere_statistics(1.3, "sp", x)
        w, g = table.single_scattering_albedo(x).value, table.asymmetry_factor(x).value
        assert w == pytest.approx(truth.albedo, abs=1e-3)
        assert g == pytest.approx(truth.mean_cosine, abs=1e-3)
        far = table.asymmetry_factor_far_field(x).value  # energy: w cross sections scattered by g, one diffracted
        assert far * (1.0 + w) == pytest.approx(w * g + 1.0, rel=1e-12)


def test_weak_absorption_is_that_of_the_enhancement():
    """1 - w = B sigma_a V / A for a little absorption: what B is for."""
    table, x = ball(), 1e-6
    thin = x * float(table.header["grain"]["volume"]) / table.projected_area.value
    b = table.absorption_enhancement.value
    assert 1.0 - table.single_scattering_albedo(x).value == pytest.approx(b * thin, rel=1e-3)


@pytest.mark.slow
def test_a_prism_in_others_words(prisms):
    """All directions inside are reached at 1.31, so B is eta^2; at 3 V / S the radius is that of convex bodies."""
    for table in prisms:
        value, error = table.absorption_enhancement
        assert abs(value - 1.31**2 * reach_of_prism(1.31, 6)) <= 4.0 * error < 0.2
        radius, error = table.effective_radius
        shape = table.header["grain"]
        assert abs(radius - 3.0 * shape["volume"] / shape["area"]) <= 4.0 * error


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("word", ["single_scattering_albedo", "asymmetry_factor", "asymmetry_factor_far_field"])
def test_errors_are_those_of_unrelated_builds(prisms, word, x):
    """Scatter over stated error, by chi-square at 1e-4; stated errors may be up to five times too large, not too small.

    Of the lossless grain, where they are near, a quarter of the stated error would be found out.
    """
    found = [getattr(table, word)(x) for table in prisms]
    scatter, stated = np.std([f.value for f in found], ddof=1), np.mean([f.error for f in found])
    if word == "single_scattering_albedo" and x == 0.0:
        assert scatter == stated == 0.0
        return
    high = math.sqrt(37.4 / (SEEDS - 1))  # of chi-square with 11 degrees of freedom, above with 1e-4
    assert stated / 5.0 <= scatter <= stated * high
    if x == 0.0:
        assert not scatter <= 0.25 * stated * high
