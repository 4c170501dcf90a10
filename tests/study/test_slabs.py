"""Slabs by wavelength: against discrete ordinates, energy, other levels, ground, theories, and bad input."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest

from tsdf.errors import SceneError, UsageError
from tsdf.grain.constants import constants_over
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.scene.scene import GrainSpec
from tsdf.study import experiment, slabs, spectra, streams
from tsdf.study.slabs import Request
from tsdf.study.spectra import Constants, Family, Spectrum

RADIUS, FRACTION = 2e-4, 0.3  # [m], [1]
SIGMAS = 4.0
WITHIN = 0.002  # of discrete ordinates


@pytest.fixture(scope="module")
def ice() -> Constants:
    return Constants.of(constants_over("ice", [300.0, 500.0, 900.0, 1100.0, 1300.0, 1700.0, 2200.0, 2500.0]))


@pytest.fixture(scope="module")
def family(ice: Constants) -> Family:
    tables = [exact_sphere(load_grain("sphere"), Optics(eta), Effort(memory=16, joint=16))
              for eta in spectra.points(ice.n.min(), ice.n.max(), 4)]  # fmt: skip
    return Family(tuple(tables))


@pytest.fixture(scope="module")
def found(ice: Constants, family: Family) -> Spectrum:
    return spectra.spectrum(family, ice, RADIUS)


def disort(depth: float, albedo: float, moments: np.ndarray, mu: float) -> tuple[float, float]:
    """Return reflectance and transmittance of a slab by 64 discrete ordinates."""
    from PythonicDISORT import pydisort

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        solved = pydisort(
            depth, min(albedo, 1.0 - 1e-9), 64, moments[None], mu, 1.0 / mu, 0.0, NLeg=64, only_flux=True,
            f_arr=max(moments[64], 0.0),
        )  # fmt: skip
        return float(solved[1](0.0)), float(sum(solved[2](depth)))


@pytest.mark.slow
@pytest.mark.parametrize(("thickness", "mu"), [(math.inf, 0.5), (30.0, 1.0), (8.0, 0.6)])
def test_discrete_ordinates(family: Family, found: Spectrum, thickness: float, mu: float) -> None:
    """Moments, albedo and extinction of this family at each wavelength, paths at three indices for all of them.

    Within .002 and the errors; a slab a tenth thinner, or grains of twice the absorption, are neither.
    """
    if math.isinf(thickness):  # paths of the least absorbed light are the longest
        some = found.constants.wavelength_nm > 800.0
        c = found.constants
        found = spectra.spectrum(
            family, replace(c, wavelength_nm=c.wavelength_nm[some], n=c.n[some], k=c.k[some]), RADIUS
        )
    got = slabs.measure(family, found, Request("volume", FRACTION, thickness, mu), 9e-4, threads=2)
    off = np.abs(got.reflectance - got.theories.doubled.reflectance)
    assert (off < SIGMAS * got.reflectance_error + got.theories.between).all(), off
    moments, _ = spectra.moments_of(family, found, 64)
    weights = family.weights(found.constants.n)
    sigma = np.array([slabs.extinction(table, FRACTION, found.albedo) for table in family.tables])
    depth = np.minimum(thickness * np.einsum("wt,tw->w", weights, sigma), 3000.0)

    def far(depth: np.ndarray, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        truth = np.array([disort(d, w, m, mu) for d, w, m in zip(depth, albedo, moments, strict=True)])
        off = np.stack([got.reflectance, got.transmittance]) - truth.T
        if math.isinf(thickness):
            off = off[:1]
        return np.abs(off), np.abs(off) / np.stack([got.reflectance_error, got.transmittance_error])[: len(off)]

    off, sigmas = far(depth, found.albedo)
    assert (off < WITHIN + np.where(sigmas < SIGMAS, 1e-3, 0.0)).all(), off
    assert (sigmas < SIGMAS + 1.0).all(), sigmas
    wrong = (depth, 2.0 * found.albedo - 1.0) if math.isinf(thickness) else (0.9 * depth, found.albedo)
    assert far(wrong[0], np.maximum(wrong[1], 0.0))[0].max() > 2.0 * WITHIN


@pytest.mark.slow
@pytest.mark.parametrize("level", ["teleport", "teleport-joint", "teleport-memory", "volume-hg", "isotropic"])
def test_levels_are_those_of_the_renderer(family: Family, found: Spectrum, level: str) -> None:
    """A slab at each level against paths that are followed with one absorption, as `experiment` does; other paths."""
    one = Family(family.tables[2:3])
    flat = replace(found.constants, n=np.full(8, family.eta[2]))
    spectrum = spectra.spectrum(one, flat, RADIUS)
    got = slabs.measure(one, spectrum, Request(level, FRACTION, 12.0, 0.8), threads=2, paths=8192)
    for i in (1, 4):
        x = float(spectrum.absorption_times_radius[i])
        absorption = experiment.Absorption("grey", (x,))
        made = experiment.slab_experiment(level, GrainSpec(one.tables[0], absorption=absorption), FRACTION, 12.0, 0.8)
        sums = experiment.gather(made, 8192, seed=5, threads=2)
        error = np.hypot(sums.error[:2], (got.reflectance_error[i], got.transmittance_error[i]))
        off = np.abs(sums.mean[:2] - (got.reflectance[i], got.transmittance[i]))
        assert (off < SIGMAS * error).all(), (level, i, off, error)


@pytest.mark.slow
@pytest.mark.parametrize("level", ["volume", "teleport", "teleport-memory"])
def test_layers_add_up(family: Family, found: Spectrum, level: str) -> None:
    """What comes back, what the ground keeps and what layers absorb is all the light, where it is made to be and where
    so little is absorbed that it is not; so are sums of the raw layers, at a level whose free paths know nothing of
    absorption, within the cells of path length."""
    request = Request(level, FRACTION, 10.0, 0.7, ground=0.4, depths=5)
    got = slabs.measure(family, found, request, threads=2, paths=4096)
    whole = got.reflectance + 0.6 * got.transmittance + got.profile.sum(axis=0)
    error = SIGMAS * np.hypot(got.reflectance_error, got.transmittance_error) + 1e-9
    assert (np.abs(whole - 1.0) < np.where(found.albedo < slabs.FAINTLY, 1e-9, error)).all()
    sets = slabs.Paths.start(family.tables[2], replace(request, ground=0.0), 0.7, found.absorption_times_radius, 0)
    sets.stretch[:] = 0.0
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(2) as pool:
        list(sets.more(4096, 0, pool))
    raw = sets.means().sum(axis=0) + sets.profile().sum(axis=0)
    assert raw == pytest.approx(np.ones(len(raw)), abs=2e-3)
    assert sets.profile().sum(axis=0)[-1] > 0.5
    # the strongly absorbed stays near the top, the weakly absorbed goes through
    deeper = got.profile[-1] / got.profile[:2].sum(axis=0)
    assert deeper[-1] < 0.2 and deeper[1] > 0.3


@pytest.mark.slow
def test_ground(family: Family, found: Spectrum) -> None:
    """White ground under lossless-as-can-be grains sends all back; grey ground is the series of what goes to and fro,
    and a half-space knows no ground."""
    white = slabs.measure(family, found, Request("volume", FRACTION, 6.0, 0.6, ground=1.0), threads=2, paths=8192)
    assert white.reflectance[0] == pytest.approx(1.0, abs=SIGMAS * white.reflectance_error[0] + 1e-3)
    bare = slabs.measure(family, found, Request("volume", FRACTION, 6.0, 0.6), threads=2, paths=8192)
    sky = slabs.measure(family, found, Request("volume", FRACTION, 6.0), threads=2, paths=8192)
    series = bare.reflectance + sum(
        bare.transmittance * sky.reflectance**k * sky.transmittance for k in range(400)
    )  # fmt: skip
    error = 3.0 * np.hypot(bare.transmittance_error, sky.transmittance_error) / (1.0 - sky.reflectance)
    assert (np.abs(series - white.reflectance) < SIGMAS * error + 2e-3).all()
    assert (white.reflectance - bare.reflectance > 0.05)[:3].all()
    assert Request("volume", FRACTION, math.inf, 0.6, ground=0.5).lights == (0.6,)


@pytest.mark.slow
def test_the_same_for_any_number_of_threads(family: Family, found: Spectrum) -> None:
    request = Request("teleport", FRACTION, 5.0)
    one, two = (slabs.measure(family, found, request, threads=k, paths=9000) for k in (1, 2))
    assert np.array_equal(one.reflectance, two.reflectance) and one.paths == 9000
    other = slabs.measure(family, found, request, threads=2, paths=9000, seed=1)
    assert not np.array_equal(one.reflectance, other.reflectance)
    assert (np.abs(one.reflectance - other.reflectance)
            < SIGMAS * np.hypot(one.reflectance_error, other.reflectance_error) + 1e-9).all()  # fmt: skip


@pytest.mark.slow
def test_what_is_stopped_tells_what_it_has_with_its_error(family: Family, found: Spectrum) -> None:
    """Not before each set has its first paths; then in the middle of a set, so that one has more of them than another,
    what is told is that slab by doubling, within errors that are those of so few paths."""
    request = Request("volume", FRACTION, 10.0, 0.7)
    first = slabs.measure(family, found, request, 1e-5, threads=2, goes_on=lambda paths: False)
    whole = slabs.measure(family, found, request, threads=2, paths=slabs.FEWEST)
    assert first.paths == slabs.FEWEST and np.array_equal(first.reflectance, whole.reflectance)
    heard: list[int] = []

    def goes_on(paths: int) -> bool:
        heard.append(paths)
        return heard.count(slabs.FEWEST) < 8

    some = slabs.measure(family, found, request, 1e-5, threads=2, goes_on=goes_on)
    assert some.paths == slabs.FEWEST and set(heard) == {slabs.FEWEST}
    assert not np.array_equal(some.reflectance, whole.reflectance)
    for got in (first, some):
        off = np.abs(np.stack([got.reflectance, got.transmittance]) - np.stack(got.theories.doubled))
        error = np.stack([got.reflectance_error, got.transmittance_error])
        assert (off < SIGMAS * error + 5e-4).all() and error[:, 2].min() > 1e-3 and error.max() < 5e-3


@pytest.mark.slow
def test_thinned_paths_are_unbiased(family: Family, found: Spectrum, monkeypatch: pytest.MonkeyPatch) -> None:
    """Long paths thinned, as with a profile, against paths that are all followed to their end, and against leaps: the
    same, but noisier where light comes back nearly whole. A share that is not made up for would take a tenth of it."""
    one = Family(family.tables[2:3])
    c = replace(found.constants, n=np.full(1, one.eta[0]), k=np.full(1, 2e-8), wavelength_nm=np.full(1, 900.0))
    spectrum = spectra.spectrum(one, c, RADIUS)
    build = slabs.build
    means = []
    for long, leap in ((slabs.LONG, 0.0), (1 << 40, 0.0), (slabs.LONG, None)):
        monkeypatch.setattr(slabs, "LONG", long)
        monkeypatch.setattr(slabs, "build", lambda scene, level, leap, kept=leap: build(scene, level, leap=kept))
        got = slabs.measure(one, spectrum, Request("volume", FRACTION, math.inf, 1.0), threads=2, paths=8192)
        means.append((got.reflectance[0], got.reflectance_error[0]))
    for mean, error in means[1:]:
        assert abs(means[0][0] - mean) < SIGMAS * math.hypot(means[0][1], error)
        assert means[0][1] > 1.2 * error and error < 0.01


# ------------------------------------------------------------------------------------------------ theories


def test_two_streams_are_right_where_they_must_be() -> None:
    """No scattering: Beer; no absorption: all of it; a slab on the same slab is the thicker one, in diffuse light of a
    thick one nearly; and half-spaces do not overflow."""
    mu = 0.6
    tau = np.array([0.1, 1.0, 5.0])
    clear = streams.two_streams(tau, np.full(3, 1e-9), np.full(3, 0.5), mu)
    assert clear.transmittance == pytest.approx(np.exp(-tau / mu), abs=1e-6)
    white = streams.two_streams(tau, np.ones(3), np.full(3, 0.8), mu)
    assert white.reflectance + white.transmittance == pytest.approx(np.ones(3), abs=2e-6)
    deep = streams.two_streams(np.full(2, math.inf), np.array([0.99, 1.0]), np.full(2, 0.8), None)
    assert deep.reflectance[1] == pytest.approx(1.0, abs=1e-4) and deep.transmittance == pytest.approx(np.zeros(2))
    simple = streams.asymptotic(np.full(1, math.inf), np.array([1e-5]), np.full(1, 0.8), None)
    exact = streams.two_streams(np.full(1, math.inf), np.array([1.0 - 1e-5]), np.full(1, 0.8), None)
    assert simple.reflectance == pytest.approx(exact.reflectance, abs=1e-3)
    # between the point where k mu is 1 and beside it nothing jumps
    near = streams.two_streams(np.full(400, 3.0), np.linspace(0.3, 0.9, 400), np.full(400, 0.5), 0.7)
    assert np.abs(np.diff(near.reflectance, 2)).max() < 1e-3


@pytest.mark.parametrize("cosine", [1.0, 0.3, None])
def test_two_streams_near_discrete_ordinates(cosine: float | None) -> None:
    """Within .03, as the approximation is; the asymptotic theory within .01 of a lossless thick slab."""
    g, tau = 0.75, 12.0
    moments = g ** np.arange(65.0)
    for albedo in (1.0, 0.999, 0.9):
        two = streams.two_streams(np.array([tau]), np.array([albedo]), np.array([g]), cosine)
        if cosine is None:
            at, weight = np.polynomial.legendre.leggauss(8)
            beams = [disort(tau, albedo, moments, 0.5 * (a + 1.0)) for a in at]
            truth = np.array([w * 0.5 * (a + 1.0) for a, w in zip(at, weight, strict=True)]) @ np.array(beams)
        else:
            truth = np.array(disort(tau, albedo, moments, cosine))
        assert np.abs(np.array(two)[:, 0] - truth).max() < 0.03
        if albedo == 1.0 and cosine != 0.3:
            simple = streams.asymptotic(np.array([tau]), np.array([0.0]), np.array([g]), cosine)
            assert np.abs(np.array(simple)[:, 0] - truth).max() < 0.015


@pytest.mark.parametrize("cosine", [1.0, 0.3])
@pytest.mark.parametrize("tau", [0.1, 4.0, 300.0])
def test_doubling_is_discrete_ordinates(tau: float, cosine: float) -> None:
    """Another method with other directions: within 2e-4; a slab 2 % thicker is not, nor one of g .02 more."""
    g, albedo = np.array([0.0, 0.75, 0.9]), np.array([0.5, 0.999, 1.0 - 1e-9])
    got = np.array(streams.doubled(np.full(3, tau), albedo, g[:, None] ** np.arange(streams.ORDERS + 1), cosine)).T
    truth = np.array([disort(tau, w, one ** np.arange(65.0), cosine) for w, one in zip(albedo, g, strict=True)])
    assert np.abs(got - truth).max() < 2e-4
    other = np.minimum(g + 0.02, 1.0)[:, None] ** np.arange(streams.ORDERS + 1)
    assert np.abs(np.array(streams.doubled(np.full(3, tau), albedo, other, cosine)).T - truth).max() > 4e-4


def test_doubling_of_diffuse_light() -> None:
    """It is the mean over beams; a lossless slab loses nothing, and a half-space of it is white."""
    moments = np.array([0.8, 0.5])[:, None] ** np.arange(streams.ORDERS + 1)
    at, weight = np.polynomial.legendre.leggauss(32)
    mu, weight = 0.5 * (at + 1.0), 0.5 * weight
    tau, albedo = np.array([5.0, math.inf]), np.array([1.0, 0.9])
    beams = np.array([streams.doubled(tau, albedo, moments, m) for m in mu])
    mean = np.einsum("m,msw->sw", 2.0 * weight * mu, beams)
    got = np.array(streams.doubled(tau, albedo, moments, None))
    assert np.abs(got - mean).max() < 2e-5
    assert got[:, 0].sum() == pytest.approx(1.0, abs=1e-6) and got[1, 1] == 0.0
    assert streams.doubled(np.full(1, math.inf), np.ones(1), moments[:1], None).reflectance[0] > 0.999


def test_doubling_of_thick_slabs() -> None:
    """Lossless slabs up to a million deep lose nothing to 2e-6, and let 4/3 / ((1 - g) tau + 1.42) of diffuse light
    through."""
    g, tau = np.array([0.0, 0.9]), np.array([1e4, 1e5, 1e6])
    for one in g:
        moments = np.tile(one ** np.arange(streams.ORDERS + 1.0), (3, 1))
        reflected, passed = streams.doubled(tau, np.ones(3), moments, None)
        assert reflected + passed == pytest.approx(np.ones(3), abs=2e-6)
        assert passed == pytest.approx(4.0 / 3.0 / ((1.0 - one) * tau + 1.42), rel=0.01, abs=5e-7)


def test_light_that_white_ground_sends_up_again(family: Family, found: Spectrum) -> None:
    """What reaches the ground again and again is more than came in, and layers have what is left of it; a lossless slab
    on white ground sends all of it back, however thick it is."""
    request = Request("volume", FRACTION, 4.0, 1.0, ground=0.9, depths=2)
    got = slabs.measure(family, found, request, paths=8192, threads=2)
    assert got.transmittance[1] > 1.0 + 5.0 * got.transmittance_error[1]
    off = np.abs(got.transmittance - got.theories.doubled.transmittance)
    assert (off < SIGMAS * got.transmittance_error + 2.0 * got.theories.between + 0.002).all(), off
    error = np.hypot(got.reflectance_error, 0.1 * got.transmittance_error)
    left = got.reflectance + 0.1 * got.transmittance + got.profile.sum(axis=0) - 1.0
    assert (np.abs(left) < np.where(found.albedo < slabs.FAINTLY, 1e-6, SIGMAS * error)).all()
    assert (got.profile > 0.0).all()
    moments = np.tile(0.85 ** np.arange(streams.ORDERS + 1.0), (3, 1))
    light = streams.doubled(np.array([1e3, 1e5, 1e7]), np.ones(3), moments, None)
    assert streams.over_ground(light, light, 1.0).reflectance == pytest.approx(np.ones(3), abs=1e-6)


# ------------------------------------------------------------------------------------------------ bad input


def test_requests_that_cannot_be_meant(family: Family, found: Spectrum) -> None:
    for wrong in (
        {"level": "teleprot"}, {"thickness": 0.0}, {"thickness": math.nan}, {"cosine": 0.0}, {"cosine": 1.1},
        {"ground": -0.1}, {"ground": 1.1}, {"depths": -1}, {"depths": 1001}, {"profile_depth": math.inf},
    ):  # fmt: skip
        with pytest.raises(UsageError):
            Request(**wrong)
    quartz = Constants.of(constants_over("quartz", [400.0, 500.0]))
    one = Family(family.tables[:1])
    with pytest.raises(UsageError, match="k of quartz is not known at 400 nm"):
        slabs.measure(one, spectra.spectrum(one, quartz, RADIUS), Request(), paths=64)
    fine = spectra.spectrum(family, found.constants, 1e-9)
    with pytest.raises(UsageError, match="give a thickness, other wavelengths or larger grains"):
        slabs.measure(family, fine, Request(), paths=64)
    plain = Family((exact_sphere(load_grain("sphere"), Optics(1.31), Effort()),))
    spectrum = spectra.spectrum(plain, found.constants, RADIUS)
    with pytest.raises(SceneError, match="--memory 64"):
        slabs.measure(plain, spectrum, Request("teleport-memory"), paths=64)
