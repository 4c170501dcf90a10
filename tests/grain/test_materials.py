"""Optical constants: the values of the sources, what lies between them, and what is refused."""

import dataclasses
import math

import numpy as np
import pytest
from click.testing import CliRunner

from tsdf.cli.build import main as build
from tsdf.errors import UsageError
from tsdf.grain import materials
from tsdf.grain.materials import MATERIALS, MEDIA, OpticalConstants, optical_constants

ABSORBING = [name for name in MATERIALS if MEDIA[name].k is not None]
# (material, wavelength [nm], n, digits): printed values, none of them taken from the code under test
N_PRINTED = [
    ("ice", 400, 1.31940, 5),
    ("ice", 450, 1.31570, 5),
    ("ice", 500, 1.31300, 5),
    ("ice", 550, 1.31100, 5),
    ("ice", 600, 1.30940, 5),
    ("ice", 650, 1.30800, 5),
    ("ice", 700, 1.30690, 5),
    ("water", 589.3, 1.33335, 5),
    ("quartz", 450, 1.55248, 5),
    ("quartz", 550, 1.54595, 5),
    ("quartz", 650, 1.54205, 5),
    ("quartz", 3000, 1.49956, 5),
    ("salt", 450, 1.55805, 5),
    ("salt", 550, 1.54691, 5),
    ("salt", 650, 1.54076, 5),
    ("glass", 587.5618, 1.5168, 4),  # n_d of the Schott data sheet
    ("sucrose", 589, 1.5577, 4),
]
ICE_K_PRINTED = {
    400: "2.37e-11",
    450: "9.24e-11",
    500: "5.89e-10",
    550: "2.29e-09",
    600: "5.73e-09",
    650: "1.43e-08",
    700: "2.90e-08",
}
# n / k of the infrared, by other routes: the strong band of both at 3 um, and values of other compilations
INFRARED = [
    ("ice", 1600, 1.2893, 3.0e-4, 0.15),
    ("ice", 2000, 1.274, 1.6e-3, 0.1),
    ("ice", 3100, 1.28, 0.63, 0.35),
    ("ice", 4500, 1.344, 0.032, 0.05),
    ("water", 1200, 1.324, 1.2e-5, 0.2),
    ("water", 1940, 1.308, 1.9e-3, 0.1),
    ("water", 2950, 1.29, 0.29, 0.1),
    ("water", 3800, 1.364, 3.4e-3, 0.1),
]
TABLES = [
    ("ice", "n", materials.ICE_NODES_NM, materials.ICE_N),
    ("ice", "k", materials.ICE_NODES_NM, materials.ICE_K),
    ("water", "k", materials.WATER_NODES_NM, materials.WATER_K),
    ("glass", "k", materials.GLASS_NODES_NM, materials.GLASS_K),
]


def grid(name, size=2001):
    shortest, longest = MEDIA[name].range_nm
    return np.clip(np.geomspace(shortest, longest, size), shortest, longest)


def test_the_result_says_what_was_asked_and_where_it_is_from():
    assert set(MATERIALS) == {"ice", "water", "quartz", "salt", "glass", "sucrose"}
    for name in MATERIALS:
        found = optical_constants(name, 550)
        assert (found.material, found.wavelength_nm) == (name, 550.0)
        assert found.source and "\n" not in found.source
        assert (found.k is None) == (name not in ABSORBING)
        assert all(type(value) is float for value in (found.n, found.wavelength_nm))
        with pytest.raises(dataclasses.FrozenInstanceError):
            found.n = 1.0
    assert isinstance(optical_constants("ice", np.float32(550)), OpticalConstants)


@pytest.mark.parametrize(("name", "wavelength_nm", "n", "digits"), N_PRINTED)
def test_n_is_the_printed_value(name, wavelength_nm, n, digits):
    assert round(optical_constants(name, wavelength_nm).n, digits) == n


@pytest.mark.parametrize("wavelength_nm", ICE_K_PRINTED)
def test_k_of_ice_is_the_printed_value(wavelength_nm):
    """Compared to half a unit of the last digit, as 2.365e-11 is a tie that binary numbers may round down."""
    printed = ICE_K_PRINTED[wavelength_nm]
    half_a_digit = 0.005 * 10.0 ** int(printed[-3:])
    found = optical_constants("ice", wavelength_nm).k
    assert found == pytest.approx(float(printed), rel=1e-12, abs=half_a_digit * (1 + 1e-9))


@pytest.mark.parametrize(("name", "wavelength_nm", "n", "k", "share"), INFRARED)
def test_the_infrared(name, wavelength_nm, n, k, share):
    found = optical_constants(name, wavelength_nm)
    assert found.n == pytest.approx(n, abs=0.002 if wavelength_nm < 2500 or wavelength_nm == 3800 else 0.3)
    assert found.k == pytest.approx(k, rel=share)


def test_the_sources_of_water_meet():
    """Where the formula ends and where k goes over to another source nothing jumps by more than the sources differ."""
    for wavelength, rel_n, rel_k in ((1100.0, 1e-5, 1e-2), (1200.0, 1e-5, 1e-2), (1000.0, 1e-5, 0.05)):
        before, after = (optical_constants("water", wavelength * f) for f in (1 - 1e-4, 1 + 1e-4))
        assert after.n == pytest.approx(before.n, rel=rel_n) and after.k == pytest.approx(before.k, rel=rel_k)


def test_the_sources_of_quartz_meet():
    """Nothing jumps by more than the sources differ."""
    before, after = (optical_constants("quartz", materials.QUARTZ_FORMULA_NM + d).n for d in (0.0, 1e-6))
    assert 0.0 < abs(after - before) < 1e-5


def test_the_help_states_the_ranges():
    words = " ".join(CliRunner().invoke(build, ["--help"], terminal_width=200).output.split())
    for name in MATERIALS:
        shortest, longest = MEDIA[name].range_nm
        assert f"{shortest:g} to {longest:g}" in words and name in words


def test_sucrose_is_the_same_at_every_wavelength_and_says_so():
    found = [optical_constants("sucrose", w) for w in (400, 589, 700)]
    assert len({one.n for one in found}) == 1
    assert "589 nm" in found[0].source
    assert min(materials.SUCROSE_PRINCIPAL_N) < found[0].n < max(materials.SUCROSE_PRINCIPAL_N)
    quartz_falls = optical_constants("quartz", 400).n - optical_constants("quartz", 700).n
    assert round(quartz_falls, 3) == 0.017  # what the docstring warns of


@pytest.mark.parametrize(("name", "field", "nodes", "values"), TABLES)
def test_tables_are_met_at_their_nodes_and_continuous_there(name, field, nodes, values):
    """The nodes ascend and fill the range; each gives the table's value, and so does either side of it."""
    assert len(nodes) == len(values)
    assert np.all(np.diff(nodes) > 0)
    shortest, longest = MEDIA[name].range_nm
    assert nodes[0] <= shortest < longest <= nodes[-1]
    within = [(node, value) for node, value in zip(nodes, values, strict=True) if shortest <= node <= longest]
    assert len(within) >= len(nodes) - 2  # the ends may lie between nodes
    for node, value in within:
        assert getattr(optical_constants(name, node), field) == pytest.approx(value, rel=1e-12)
        for beside in (node * (1 - 1e-9), node * (1 + 1e-9)):
            if shortest <= beside <= longest:
                assert getattr(optical_constants(name, beside), field) == pytest.approx(value, rel=1e-6)


def test_n_of_ice_between_nodes_is_right_to_1e_4():
    """Against a second route: a smooth dispersion formula fitted to the nodes, instead of interpolation.

    n^2 is fitted by a polynomial in 1/w^2 and w^2 (Briot's form), which meets the nodes within 1e-4 (they are
    printed to 1e-4). The negative control is linear interpolation in wavelength, which must fail.
    """
    smooth_part = [(w, n) for w, n in zip(materials.ICE_NODES_NM, materials.ICE_N, strict=True) if 350 <= w <= 1400]
    nodes, n = np.array(smooth_part).T / [[1000], [1]]

    def powers(w):
        return np.stack([w ** (2 * p) for p in (-3, -2, -1, 0, 1, 2)], axis=1)

    coefficients = np.linalg.lstsq(powers(nodes), n**2, rcond=None)[0]
    smooth = np.linspace(350, 1400, 2001) / 1000
    expected = np.sqrt(powers(smooth) @ coefficients)
    assert np.abs(np.sqrt(powers(nodes) @ coefficients) - n).max() < 1e-4
    found = np.array([optical_constants("ice", w).n for w in 1000 * smooth])
    assert np.abs(found - expected).max() < 1e-4
    assert np.abs(np.interp(smooth, nodes, n) - expected).max() > 1e-4


@pytest.mark.parametrize("name", MATERIALS)
def test_n_never_rises_with_wavelength_and_is_plausible(name):
    """All six are transparent over their range, ice and water to 1.1 um, so dispersion is normal there."""
    longest = 1100 if name in ("ice", "water") else math.inf
    n = np.array([optical_constants(name, w).n for w in grid(name) if w <= longest])
    assert np.all(np.diff(n) <= 0)
    visible = [optical_constants(name, w).n for w in (400, 550, 700)]
    assert 1.30 < min(visible) <= max(visible) < 1.58
    if name != "sucrose":
        assert np.all(np.diff(n) < 0)


@pytest.mark.parametrize("name", ABSORBING)
def test_k_is_small_positive_and_between_its_neighbours(name):
    _, _, nodes, values = next(table for table in TABLES if table[:2] == (name, "k"))
    k = np.array([optical_constants(name, w).k for w in grid(name)])
    short = grid(name) <= 1400
    assert np.all((k > 1e-12) & (k < 1)) and np.all(k[short] < 2e-4)
    right = np.clip(np.searchsorted(nodes, grid(name)), 1, len(nodes) - 1)
    ends = np.array([np.array(values)[right - 1], np.array(values)[right]])
    assert np.all((k > ends.min(0) * (1 - 1e-12)) & (k < ends.max(0) * (1 + 1e-12)))
    middle = optical_constants(name, (nodes[10] + nodes[11]) / 2).k
    assert middle == pytest.approx(math.sqrt(values[10] * values[11]), rel=1e-12)


@pytest.mark.parametrize("name", MATERIALS)
def test_the_ends_of_the_range_are_included_and_nothing_beyond(name):
    shortest, longest = MEDIA[name].range_nm
    for wavelength_nm in (shortest, longest):
        assert optical_constants(name, wavelength_nm).n > 1
    beyond = (math.nextafter(shortest, 0), math.nextafter(longest, math.inf))
    for wavelength_nm in (*beyond, 0, -550, math.nan, math.inf, -math.inf):
        with pytest.raises(UsageError) as caught:
            optical_constants(name, wavelength_nm)
        message = str(caught.value)
        assert "\n" not in message and name in message
        assert f"{shortest:g} to {longest:g} nm" in message


@pytest.mark.parametrize("name", ["Ice", "", "silica", None, []])
def test_an_unknown_material_is_refused_with_the_valid_names(name):
    with pytest.raises(UsageError) as caught:
        optical_constants(name, 550)
    message = str(caught.value)
    assert "\n" not in message and all(valid in message for valid in MATERIALS)


@pytest.mark.parametrize("name", MATERIALS)
def test_the_docstring_states_the_range(name):
    shortest, longest = MEDIA[name].range_nm
    assert f"{shortest:g}-{longest:g}" in optical_constants.__doc__
