"""Single scattering by wavelength: between tables as at tables of their own, with errors that hold."""

import math

import numpy as np
import pytest

from tsdf.errors import UsageError
from tsdf.grain.constants import constants_over
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Build, Effort
from tsdf.study import spectra
from tsdf.study.spectra import Constants, Family, Spectrum

RADIUS = 2e-4  # [m]


@pytest.fixture(scope="module")
def ice() -> Constants:
    return Constants.of(constants_over("ice", spectra.wavelengths("300:2500:100")))


@pytest.fixture(scope="module")
def family(ice: Constants) -> Family:
    return spectra.build(load_grain("sphere"), ice.n, Effort())


@pytest.fixture(scope="module")
def found(ice: Constants, family: Family) -> Spectrum:
    return spectra.spectrum(family, ice, RADIUS)


@pytest.mark.slow
def test_spheres_are_exact_at_every_index(ice: Constants, found: Spectrum) -> None:
    """The exact sphere of each index and absorption, by an integral that knows no table. The lossless g is within the
    stated error; with absorption cells of path length and angle cost 2e-4 more. Held at one index g is not."""
    for i in range(0, len(ice.n), 3):
        x = float(found.absorption_times_radius[i])
        truth = analytic.sphere_statistics(float(ice.n[i]), "un", x)
        assert found.albedo[i] == pytest.approx(truth.albedo, abs=3e-4)
        if truth.albedo > 0.2:
            assert found.g[i] == pytest.approx(truth.mean_cosine, abs=5e-4)
        b = (1.0 - (1.0 - 1.0 / ice.n[i] ** 2) ** 1.5) * ice.n[i] ** 2
        assert found.enhancement[i] == pytest.approx(b, abs=1e-4)
    far = spectra.spectrum(Family(found_tables(1.31)), ice, RADIUS)
    assert abs(far.g[0] - found.g[0]) > 0.01 and any("n is that of the one table" in note for note in far.notes)


def found_tables(*etas: float) -> tuple:
    return tuple(scatterometer.exact_sphere(load_grain("sphere"), Optics(eta), Effort()) for eta in etas)


@pytest.mark.slow
def test_what_lies_between_is_within_the_stated_error() -> None:
    """A traced grain: tables at a few indices against one of its own, other paths, at another index. The error stated
    is no more than .001 of g, and three times the difference of neighbouring indices would be seen."""
    grain, eta = load_grain("hexprism"), 1.297
    n = np.array([1.26, eta, 1.334])
    constants = Constants(np.array([2300.0, 1300.0, 300.0]), n, np.full(3, 1e-6), "ice", "made up")
    family = spectra.build(grain, n, Effort(300_000), tolerance=2e-3, threads=2)
    assert len(family.tables) in (3, 5)
    found = spectra.spectrum(family, constants, RADIUS)
    build = Build.start(grain, Optics(eta), Effort(300_000, seed=9))
    build.run(grain, 2)
    own = spectra.spectrum(Family((build.table(),)), Constants(*(a[1:2] for a in (
        constants.wavelength_nm, n, constants.k)), "ice", "made up"), RADIUS)  # fmt: skip
    for name in ("albedo", "g", "enhancement"):
        error = math.hypot(found.error(name)[1], own.error(name)[0])
        assert abs(getattr(found, name)[1] - getattr(own, name)[0]) < 4.0 * error, name
    assert found.error("g")[1] < 2e-3
    assert abs(found.g[0] - own.g[0]) > 8.0 * found.error("g")[1]
    moments, straight = spectra.moments_of(family, found, 16)
    assert moments[:, 1] == pytest.approx(found.g, abs=1e-3)
    assert straight[1] == pytest.approx(own_straight := build.table().deflection_masses()[-1], abs=5e-3), own_straight


@pytest.mark.slow
def test_moments_between_tables_are_no_clipped_polynomials(ice: Constants, family: Family, found: Spectrum) -> None:
    """Rainbows move with n, and polynomials through cells would be negative; moments and their g agree everywhere, and
    the phase functions for reading are nowhere negative."""
    moments, _ = spectra.moments_of(family, found, 1)
    assert moments[:, 1] == pytest.approx(found.g, abs=2e-4)
    _, masses = family.masses(found)
    assert masses.min() >= 0.0 and masses.sum(axis=1) == pytest.approx(np.ones(len(ice.n)))


@pytest.mark.slow
def test_errors_grow_with_the_gap_between_tables(ice: Constants) -> None:
    """Of two tables far apart the error is large, and holds; of three it is smaller, and holds as well."""
    truth = spectra.spectrum(Family(found_tables(1.22, 1.25, 1.28, 1.31, 1.34)), ice, RADIUS)
    errors = []
    for etas in ((1.22, 1.34), (1.22, 1.28, 1.34)):
        rough = spectra.spectrum(Family(found_tables(*etas)), ice, RADIUS)
        assert (np.abs(rough.g - truth.g) <= rough.between["g"] + truth.between["g"] + 1e-9).all()
        errors.append(float(rough.between["g"].max()))
    assert errors[1] < 0.2 * errors[0]


def test_k_that_is_not_known_is_no_absorption_of_zero() -> None:
    quartz = Constants.of(constants_over("quartz", [400.0, 500.0]))
    found = spectra.spectrum(Family(found_tables(1.55)), quartz, RADIUS)
    assert np.isnan(found.albedo).all() and np.isfinite(found.g).all()
    assert any("k of quartz is not known at 2 of 2" in note for note in found.notes)


@pytest.mark.parametrize(
    ("text", "count", "last"), [("550", 1, 550.0), ("600,400", 2, 600.0), ("300:2500:10", 221, 2500.0),
                                ("300:310:4", 3, 308.0), ("0.5:0.6:0.1", 2, 0.6)],
)  # fmt: skip
def test_wavelengths(text: str, count: int, last: float) -> None:
    found = spectra.wavelengths(text)
    assert len(found) == count and found[-1] == pytest.approx(last) and (np.diff(found) > 0.0).all()


@pytest.mark.parametrize("text", ["", "red", "300:200:10", "300:400", "300:400:0", "-1", "nan", "1:1e8:1e-3", "1e9"])
def test_wavelengths_that_are_none(text: str) -> None:
    with pytest.raises(UsageError, match="give FROM:TO:STEP"):
        spectra.wavelengths(text)


def test_wavelengths_that_fall() -> None:
    for text in ("5000:200:-1000", "5000:200:1000", "200:5000:-10", "200:5000:0"):
        with pytest.raises(UsageError, match="FROM:TO:STEP rises"):
            spectra.wavelengths(text)
    assert spectra.wavelengths("300:300:10").tolist() == [300.0]


@pytest.mark.slow
def test_tables_that_make_no_family(ice: Constants) -> None:
    ball = found_tables(1.3, 1.31)
    cube = load_grain("cube")
    build = Build.start(cube, Optics(1.32), Effort(2048))
    build.run(cube)
    with pytest.raises(UsageError, match="different grains"):
        Family.of([*ball, build.table()])
    apart = scatterometer.exact_sphere(load_grain("sphere"), Optics(1.32, "sp"), Effort())
    with pytest.raises(UsageError, match="--fresnel sp and --fresnel un"):
        Family.of([*ball, apart])
    with pytest.raises(UsageError, match="the same index"):
        Family.of([ball[0], ball[0]])
    with pytest.raises(UsageError, match="add tables at the ends"):
        spectra.spectrum(Family(ball), ice, RADIUS)
    with pytest.raises(UsageError, match="radius"):
        spectra.spectrum(Family(ball[:1]), ice, math.nan)
