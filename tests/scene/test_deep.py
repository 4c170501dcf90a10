"""The colour of a deep medium: against what is known exactly, against discrete ordinates, and there and back."""

import math

import numpy as np
import pytest

from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.scene import deep
from tsdf.scene.medium import Component, volume_parameters


@pytest.fixture(scope="module")
def ball() -> Table:
    return exact_sphere(load_grain("sphere"), Optics(1.31), Effort(cells=64))


@pytest.mark.parametrize("w", [0.3, 0.9, 0.99, 0.9999])
def test_isotropic_scatterers(w):
    """Chandrasekhar's H: a half space of isotropic scatterers reflects 1 - 2 sqrt(1 - w) (mean of mu H)."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    mu, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    h = np.ones_like(mu)
    kernel = mu[None, :] / (mu[:, None] + mu[None, :]) * weights
    for _ in range(3000):
        h = 1.0 / (math.sqrt(1.0 - w) + 0.5 * w * (kernel @ h))
    moments = np.zeros(2 * deep.STREAMS)
    moments[0] = 1.0
    expected = 1.0 - 2.0 * math.sqrt(1.0 - w) * float(weights @ (mu * h))
    assert deep._reflectance(moments, w, math.inf) == pytest.approx(expected, abs=1e-6)
    assert abs(deep._reflectance(moments, 0.99 * w, math.inf) - expected) > 5e-4


@pytest.mark.slow
@pytest.mark.parametrize(("x", "depth"), [(1e-4, 5.0), (0.03, 0.5), (0.03, math.inf), (1.0, 50.0)])
def test_slabs_against_discrete_ordinates(ball, depth, x):
    """PythonicDISORT with the table's moments, in diffuse light from above; beside it, twice the absorption."""
    disort = pytest.importorskip("PythonicDISORT").pydisort
    masses, edges = ball.deflection_masses(x), ball.cos_theta_edges
    nodes, weights = np.polynomial.legendre.leggauss(256)
    legendre = np.polynomial.legendre.legvander(0.5 * np.diff(edges)[:, None] * (nodes + 1.0) + edges[:-1, None], 63)
    moments = np.einsum("c,n,cnl->l", masses, 0.5 * weights, legendre)
    moments[0] = 1.0
    w = ball.single_scattering_albedo(x).value
    far = depth if math.isfinite(depth) else 30.0 / (1.0 - w)
    streams = 32
    peak = float(moments[streams])
    _, up, *_ = disort(
        far, w, streams, moments[None], 0.5, 0.0, 0.0, NLeg=streams, b_neg=1.0, f_arr=peak, only_flux=True
    )
    expected = float(up(0.0)) / math.pi
    assert deep.deep_colour(ball, x, depth) == pytest.approx(expected, abs=1e-4)
    assert deep.deep_colour(ball, 2.0 * x, depth) != pytest.approx(expected, abs=1e-4)


def test_limits(ball):
    """Without absorption a deep medium is white; a grain that does not refract is black; depth and absorption count."""
    assert deep.deep_colour(ball, 0.0) == 1.0
    nothing = exact_sphere(load_grain("sphere"), Optics(1.0), Effort(cells=8))
    assert deep.deep_colour(nothing, 0.0) == deep.deep_colour(nothing, 0.1) == 0.0
    found = [deep.deep_colour(ball, x) for x in (1e-6, 1e-3, 0.1, 10.0, 1e6)]
    assert found == sorted(found, reverse=True) and 0.0 < found[-1] < 0.01
    slabs = [deep.deep_colour(ball, 1e-3, depth) for depth in (0.1, 1.0, 10.0, 1e3, math.inf)]
    assert slabs == sorted(slabs) and slabs[-1] - slabs[-2] < 1e-5


@pytest.mark.parametrize("colour", [(0.99, 0.5, 0.02), (0.7, 0.7, 0.7)])
def test_there_and_back(ball, colour):
    xs = deep.absorption_of_colour(ball, colour)
    assert [deep.deep_colour(ball, x) for x in xs] == pytest.approx(colour, abs=1e-6)


def test_there_and_back_of_a_slab(ball):
    """Of 30 R at f 0.6, whose extinction goes with the absorption as the renderer's does."""
    (x,) = deep.absorption_of_colour(ball, [0.4], thickness=30.0, packing_fraction=0.6)
    sigma_t = volume_parameters([Component(ball)], 0.6, [x]).sigma_t
    assert deep.deep_colour(ball, x, 30.0 * sigma_t) == pytest.approx(0.4, abs=1e-6)
    assert deep.deep_colour(ball, x) > 0.405


@pytest.mark.parametrize(
    ("colour", "more", "message"),
    [
        (1.0, {}, "not 1: without any absorption it is 1"),
        (1.5, {}, "not 1.5"),
        (0.0, {}, "not 0: grains reflect some light whatever they absorb"),
        (-0.1, {}, "not -0.1"),
        (math.nan, {}, "not nan"),
        (0.001, {}, r"out of reach: grains reflect 0.00\d+ of the light outside"),
        (0.9, {"thickness": 10.0}, r"a slab 10 R thick of this grain reflects 0\.\d+ at most"),
    ],
)
def test_impossible_colours(ball, colour, more, message):
    with pytest.raises(UsageError, match=message) as caught:
        deep.absorption_of_colour(ball, [0.5, colour, 0.5] if not more else [colour], **more)
    assert "\n" not in str(caught.value)
