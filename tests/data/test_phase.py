"""Phase functions by moments and by angle: exact sums over cells, atoms apart, and what is read back."""

import numpy as np
import pytest
from scipy.special import eval_legendre

import tsdf
from tsdf.data.phase import far_field, legendre, moments, parted, phase_text
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.reference_data.make_checks import CHECKS


@pytest.fixture(scope="module")
def cube() -> Table:
    return tsdf.read(CHECKS / "cube.tsdf.exr")


@pytest.mark.slow
def test_moments_are_those_of_the_header(cube: Table) -> None:
    """An integral without cells there, so alike to a cell's width; at order 400 the recurrence is still exact."""
    ball = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=512))
    assert moments(ball, 16).moments == pytest.approx(np.array(ball.statistics["legendre_moments"][:17]), abs=2e-4)
    found = moments(cube, 1024)
    assert found.moments[0] == pytest.approx(1.0, abs=1e-12)
    edges, masses = cube.cos_theta_edges, cube.deflection_masses()
    at, weight = np.polynomial.legendre.leggauss(600)
    for order in (7, 400):
        middle = 0.5 * (edges[1:] + edges[:-1])[:, None] + 0.5 * np.diff(edges)[:, None] * at
        means = 0.5 * (eval_legendre(order, middle) @ weight)
        assert found.moments[order] == pytest.approx(float(masses @ means), abs=1e-10)


def test_what_goes_straight_on_is_kept_apart_or_cut_off(cube: Table) -> None:
    """Put back, both give the whole again; a cube's atom stays in every moment however high, so apart is what falls."""
    whole = moments(cube, 200).moments
    atom = cube.deflection_masses()[-1]
    assert atom > 0.2
    apart, cut = moments(cube, 200, forward="apart"), moments(cube, 200, forward="delta-m")
    assert apart.straight == pytest.approx(atom)
    for part in (apart, cut):
        assert part.straight + (1.0 - part.straight) * part.moments == pytest.approx(whole, abs=1e-12)
    assert abs(cut.moments[-1]) < 1e-12
    assert whole[200] > 0.2 and abs(apart.moments[200]) < 0.5 * whole[200]


def test_all_straight_on() -> None:
    """Nothing is left beside an atom of everything."""
    left = parted(np.ones((2, 4)), np.ones(2), "apart")
    assert (left.straight == 1.0).all() and left.moments == pytest.approx(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))


def test_orders_are_refused(cube: Table) -> None:
    for orders in (-1, 1025):
        with pytest.raises(UsageError, match="0 to 1024"):
            legendre(cube.cos_theta_edges, cube.p_theta, orders)


def test_a_phase_function_read_back_is_the_table(cube: Table) -> None:
    """Its mean over the sphere is 1 with the atoms, its mean cosine that of the cells."""
    masses = cube.deflection_masses(0.3)
    text = phase_text(cube.cos_theta_edges, masses[None], ["p"])
    rows = np.loadtxt(text.splitlines()[4:])
    low, high = (np.cos(np.radians(rows[:, i])) for i in (2, 1))
    share = 0.5 * rows[:, 3] * (high - low)
    assert share.sum() + masses[0] + masses[-1] == pytest.approx(1.0, abs=1e-6)
    cosine = share @ (0.5 * (low + high)) + masses[-1] - masses[0]
    assert cosine == pytest.approx(float(moments(cube, 1, 0.3).moments[1]), abs=1e-6)
    assert f"straight on (theta 0): {masses[-1]:.8g}" in text
    assert (np.diff(rows[:, 0]) > 0.0).all()


def test_the_far_field() -> None:
    """As much again straight on: a grain that takes all it meets scatters only that."""
    albedo, g = far_field(np.array([1.0, 0.5, 0.0]), np.array([0.6, 0.6, np.nan]))
    assert albedo == pytest.approx([1.0, 0.75, 0.5])
    assert g == pytest.approx([0.8, 1.3 / 1.5, 1.0])
