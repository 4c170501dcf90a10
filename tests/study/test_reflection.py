"""Grains where k matters: spheres and a half-space of them photon by photon, with the reflectance of n - i k."""

import math

import numpy as np
import pytest

from tsdf.data.table import Table
from tsdf.grain.constants import constants_over
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.study import slabs, spectra
from tsdf.study.reflection import Surface, reflectance
from tsdf.study.spectra import Constants, Family, Spectrum

RADIUS = 2e-4  # [m]
PHOTONS = 400_000


def sphere(eta: float) -> Table:
    return exact_sphere(load_grain("sphere"), Optics(eta), Effort(cells=256))


def dark(n: float, k: float) -> tuple[Family, Spectrum]:
    """Return opaque spheres of one index and what they do to light."""
    family = Family((sphere(n),))
    constants = Constants(np.array([3000.0]), np.array([n]), np.array([k]), "something dark", "this test")
    return family, spectra.spectrum(family, constants, RADIUS)


def deflections(rng: np.random.Generator, count: int, n: float, k: float) -> tuple[np.ndarray, np.ndarray]:
    """Return cos theta of light that opaque spheres send back, and its share, of rays that meet them anywhere."""
    incidence = np.sqrt(1.0 - rng.random(count))  # b^2 is uniform
    return 1.0 - 2.0 * incidence**2, reflectance(incidence, np.full(count, n), np.full(count, k))


def half_space(n: float, k: float) -> tuple[float, float]:
    """Return what a half-space of opaque spheres sends back of diffuse light, and its standard error: photon by photon,
    with no more than unit optical depths."""
    rng = np.random.default_rng(7)
    cosine, depth, weight = np.sqrt(rng.random(PHOTONS)), np.zeros(PHOTONS), np.ones(PHOTONS)
    out = np.zeros(PHOTONS)
    for _ in range(40):
        depth = depth + cosine * rng.exponential(size=PHOTONS)
        out += np.where(depth < 0.0, weight, 0.0)
        turn, sent = deflections(rng, PHOTONS, n, k)
        weight = np.where(depth < 0.0, 0.0, weight) * sent
        side = np.sqrt((1.0 - cosine**2) * (1.0 - turn**2)) * np.cos(2.0 * math.pi * rng.random(PHOTONS))
        cosine = np.clip(cosine * turn + side, -1.0, 1.0)
    return float(out.mean()), float(out.std()) / math.sqrt(PHOTONS)


@pytest.mark.parametrize(("n", "k"), [(1.0355, 0.4293), (1.4375, 0.5812), (0.675, 2.28)])
def test_opaque_spheres_are_what_their_surface_is(n: float, k: float) -> None:
    """Ice at 3.0 and 3.1 um and gold: albedo, g, moments and masses, and that they are not those of n alone."""
    family, found = dark(n, k)
    turn, sent = deflections(np.random.default_rng(3), PHOTONS, n, k)
    g = float((turn * sent).sum() / sent.sum())
    assert found.albedo[0] == pytest.approx(float(sent.mean()), abs=4.0 * float(sent.std()) / math.sqrt(PHOTONS))
    assert found.g[0] == pytest.approx(g, abs=0.004)
    moments, straight = spectra.moments_of(family, found, 8)
    assert moments[0, :2] == pytest.approx([1.0, found.g[0]], abs=1e-3)
    assert moments[0, 2] == pytest.approx(float(((1.5 * turn**2 - 0.5) * sent).sum() / sent.sum()), abs=0.005)
    edges, masses = family.masses(found)
    assert masses.sum() == pytest.approx(1.0) and straight[0] == 0.0
    assert masses[0] @ (0.5 * (edges[1:] + edges[:-1])) == pytest.approx(found.g[0], abs=2e-3)
    assert "at 3000 nm k changes what the surface sends back" in found.notes[0]
    assert found.error("albedo")[0] < 1e-3  # nothing comes through
    alone = found.albedo_of_tables[0, 0], family.tables[0].mean_cosine(float(found.absorption_times_radius[0]))
    assert abs(found.albedo[0] - alone[0]) > 0.05 and abs(found.g[0] - alone[1]) > 0.03


def test_a_half_space_of_opaque_spheres() -> None:
    """Ice at 3 um sends .014 of diffuse light back, photon by photon, by doubling and by paths; by n alone .0002. That
    is of few orders of scattering, which two streams do not know."""
    n, k = 1.0355, 0.4293
    family, found = dark(n, k)
    got = slabs.measure(family, found, slabs.Request("volume"), paths=8192, threads=2)
    truth, error = half_space(n, k)
    assert got.theories.doubled.reflectance[0] == pytest.approx(truth, abs=4.0 * error)
    assert got.reflectance[0] == pytest.approx(truth, abs=4.0 * math.hypot(error, got.reflectance_error[0]))
    assert got.reflectance[0] - got.theories.surface.reflectance[0] < 0.1 * truth


@pytest.mark.parametrize("radius", [5e-7, 2e-6, 1e-5, 1e-4])
def test_light_that_comes_through_is_in_the_error(radius: float) -> None:
    """Spheres that let light through, with the reflectance of n - i k at each meeting: the albedo is within its error,
    which is more than nothing; of n alone it is not, in the opaque one."""
    n, k = 1.33, 0.3
    family, _ = dark(n, k)
    constants = Constants(np.array([3000.0]), np.array([n]), np.array([k]), "something dark", "this test")
    found = spectra.spectrum(family, constants, radius)
    cosine = np.sqrt((np.arange(20_000) + 0.5) / 20_000)
    sent = reflectance(cosine, np.full(20_000, n), np.full(20_000, k))
    chord = 2.0 * np.sqrt(1.0 - (1.0 - cosine**2) / n**2)
    left = np.exp(-float(found.absorption_times_radius[0]) * chord)
    truth = float((sent + (1.0 - sent) ** 2 * left / (1.0 - sent * left)).mean())
    assert abs(found.albedo[0] - truth) <= found.error("albedo")[0] + 1e-5
    if radius >= 1e-5:
        assert found.error("albedo")[0] < 1e-6 < abs(truth - found.albedo_of_tables[0, 0])


def test_what_is_not_felt_stays_to_the_bit() -> None:
    """Where k is nothing a table's own numbers stay; of grains that are not convex as much is unsure as they send back
    to themselves."""
    family, _ = dark(1.3, 0.5)
    rough = Surface(np.array([1.3]), np.array([0.5]), np.array([1.3]), 0.8)
    opaque = float(rough.whole[0][0, 0])
    assert rough.unsure(np.ones((1, 1)), np.array([opaque])) == pytest.approx([0.2])
    ice = Constants.of(constants_over("ice", [400.0]))
    clear = spectra.spectrum(family, ice, RADIUS)
    assert clear.albedo[0] == spectra.absorbed(family.tables[0], clear.absorption_times_radius)[0, 0]
    assert not any("surface" in note for note in clear.notes)


def test_opaque_grains_do_not_mind_the_index_of_their_tables() -> None:
    """Of a table of another n, of a family between its indices and of n = 1, where nothing is sent back without k: what
    opaque grains do follows from n and k alone, and every number is one."""
    glass, around = Family((sphere(1.52),)), Family(tuple(sphere(eta) for eta in (0.96, 1.0, 1.2, 1.44)))
    for family, n, k in ((glass, 0.5, 3.0), (around, 1.0355, 0.4293), (around, 1.0, 2.0)):
        constants = Constants(np.array([3000.0]), np.array([n]), np.array([k]), "something dark", "this test")
        found = spectra.spectrum(family, constants, RADIUS)
        turn, sent = deflections(np.random.default_rng(3), PHOTONS, n, k)
        assert found.albedo[0] == pytest.approx(float(sent.mean()), abs=1e-3)
        assert found.g[0] == pytest.approx(float((turn * sent).sum() / sent.sum()), abs=0.006)
        assert found.error("albedo")[0] < 2e-3
        edges, masses = family.masses(found)
        assert masses.sum() == pytest.approx(1.0)
        assert masses[0] @ (0.5 * (edges[1:] + edges[:-1])) == pytest.approx(found.g[0], abs=3e-3)
        assert spectra.moments_of(family, found, 4)[0][0, 1] == pytest.approx(found.g[0], abs=1e-3)


def test_layers_of_opaque_grains_add_up() -> None:
    """What comes back of a half-space and what its layers absorb is all of the light."""
    family, found = dark(1.4375, 0.5812)
    request = slabs.Request("volume", depths=4, profile_depth=40.0)
    got = slabs.measure(family, found, request, paths=8192, threads=2)
    error = math.hypot(got.reflectance_error[0], float(np.hypot.reduce(got.profile_error[:, 0])))
    assert got.reflectance[0] + got.profile.sum() == pytest.approx(1.0, abs=4.0 * error + 1e-3)
    assert got.theories.surface.reflectance[0] > 0.005


def test_reflectance_of_a_mirror_and_of_clear_surfaces() -> None:
    cosine = np.linspace(0.01, 1.0, 50)
    assert reflectance(cosine, np.full(50, 1e-3), np.full(50, 1e4)).min() > 0.99
    s, p = analytic.fresnel_reflectance(cosine, 1.31)
    assert reflectance(cosine, np.full(50, 1.31), np.zeros(50)) == pytest.approx(0.5 * (s + p), abs=1e-12)
    # normal incidence, gold
    assert reflectance(np.ones(1), np.array([0.675]), np.array([2.28]))[0] == pytest.approx(
        ((0.675 - 1.0) ** 2 + 2.28**2) / ((0.675 + 1.0) ** 2 + 2.28**2)
    )
