"""Grains where k matters: spheres and a half-space of them photon by photon, with the reflectance of n - i k."""

import math

import numpy as np
import pytest

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


def dark(n: float, k: float) -> tuple[Family, Spectrum]:
    """Return opaque spheres of one index and what they do to light."""
    family = Family((exact_sphere(load_grain("sphere"), Optics(n), Effort()),))
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
    alone = found.surface.albedo_of_n[0], family.tables[0].mean_cosine(float(found.absorption_times_radius[0]))
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


def test_light_that_comes_through_is_in_the_error() -> None:
    """Thin spheres: what k changes is put in, and as much of it may be wrong as of the light comes through; of a grain
    that is not convex, as much as it sends back to itself. Where k is nothing a table's own numbers stay to the bit."""
    family, found = dark(1.3, 0.02)
    thin = spectra.spectrum(family, found.constants, 2e-6)
    n_alone = thin.surface.albedo_of_n
    assert thin.error("albedo")[0] >= 0.5 * abs(thin.albedo[0] - n_alone[0]) > 0.0
    rough = Surface(thin.surface.n, thin.surface.k, np.zeros(1), 0.8)
    assert rough.unsure == pytest.approx([0.2])
    ice = Constants.of(constants_over("ice", [400.0]))
    clear = spectra.spectrum(family, ice, RADIUS)
    assert clear.albedo[0] == spectra.absorbed(family.tables[0], clear.absorption_times_radius)[0, 0]
    assert not any("surface" in note for note in clear.notes)


def test_reflectance_of_a_mirror_and_of_clear_surfaces() -> None:
    cosine = np.linspace(0.01, 1.0, 50)
    assert reflectance(cosine, np.full(50, 1e-3), np.full(50, 1e4)).min() > 0.99
    s, p = analytic.fresnel_reflectance(cosine, 1.31)
    assert reflectance(cosine, np.full(50, 1.31), np.zeros(50)) == pytest.approx(0.5 * (s + p), abs=1e-12)
    # normal incidence, gold
    assert reflectance(np.ones(1), np.array([0.675]), np.array([2.28]))[0] == pytest.approx(
        ((0.675 - 1.0) ** 2 + 2.28**2) / ((0.675 + 1.0) ** 2 + 2.28**2)
    )
