"""Sizes and densities: each word means what docs/sizes.md says, by grains that are known, and there is a way back."""

import math

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from tsdf.data.table import Table, thawed
from tsdf.errors import UsageError
from tsdf.grain.extent import maximum_dimension, sieve
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import assemble
from tsdf.make.origin import grain_header
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.sizes import AMOUNTS, DENSITIES, SIZES, convert, grain_sizes

EDGE = 2.0 / math.sqrt(3.0)  # [R] of a cube


@pytest.fixture(scope="module")
def ball() -> Table:
    return exact_sphere(load_grain("sphere"), Optics(1.31, material="ice"), Effort(cells=16))


@pytest.fixture(scope="module")
def cube() -> Table:
    grain, tally = load_grain("cube"), Tally()
    Tracer(grain, 1.31, seed=1).trace(np.arange(1 << 14), tally)
    made = {"command": "", "method": "traced", "seed": 1, "paths": 1 << 14, "max_bounces": 100_000}
    return assemble.traced_table(tally, 16, grain_header(grain), Optics(1.31, material="ice"), made)


def without(table: Table, *keys: str, material: str | None = "ice") -> Table:
    header = thawed(table.header)
    for key in keys:
        del header["grain"][key]
    header["optics"]["material"] = material
    return Table(header, table.pixels)


@pytest.mark.parametrize(
    ("name", "shape", "across", "hole"),
    [
        ("cube", {}, 2.0, EDGE),
        ("octahedron", {}, 2.0, 4.0 / 3.0),  # two of its edges lie along the hole's sides, turned
        ("tetrahedron", {}, math.sqrt(8.0 / 3.0), EDGE),  # edge over sqrt(2): it is inscribed in a cube
        ("hexprism", {}, 2.0, math.sqrt(2.0) * math.cos(math.pi / 12.0)),  # end on, turned by 15 degrees
    ],
)  # fmt: skip
def test_dimensions_of_solids(name, shape, across, hole):
    vertices = load_grain(name, **shape).vertices
    assert maximum_dimension(vertices) == pytest.approx(across, rel=1e-9)
    assert sieve(vertices) == pytest.approx(hole, rel=1e-6)


@pytest.mark.parametrize("squeezed", [1.0, 0.999, 0.99, 0.5])
def test_the_widest_of_many_vertices(squeezed):
    """Of 5000 points on a ball, squeezed or not, two outside it: as by all pairs."""
    rng = np.random.default_rng(4)
    points = rng.normal(size=(5000, 3))
    points *= np.array([1.0, 1.0, squeezed]) / np.linalg.norm(points, axis=1, keepdims=True)
    points[:2] *= 1.0001
    assert maximum_dimension(points) == pytest.approx(pdist(points).max(), rel=1e-12)


def test_a_sieve_does_not_know_how_a_grain_is_turned():
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    vertices = load_grain("hexprism", aspect=0.2).vertices
    a = 2.0 / math.hypot(2.0, 0.4)  # circumradius: the plate stands in the hole's diagonal
    assert sieve(vertices @ turned) == pytest.approx((math.sqrt(3.0) * a + 0.4 * a) / math.sqrt(2.0), rel=1e-6)
    assert maximum_dimension(vertices @ turned) == pytest.approx(2.0, rel=1e-9)


def test_words_of_a_sphere(ball):
    """All radii are the radius, a sieve is a diameter, ssa is 3 / (rho r)."""
    facts = convert([(ball, 1.0)], {"radius": 0.5, "packing_fraction": 0.6}, 1e-3).facts()
    assert facts["effective_radius"] == pytest.approx(0.5, rel=1e-12)
    assert facts["volume_radius"] == pytest.approx(0.5, rel=1e-12)
    assert facts["maximum_dimension"] == facts["sieve"] == 1.0
    assert facts["ssa"] == pytest.approx(3.0 / (917.0 * 0.5e-3), rel=1e-12)
    assert facts["solid_fraction"] == pytest.approx(0.6, rel=1e-12)
    assert facts["density"] == pytest.approx(0.6 * 917.0, rel=1e-12)


def test_words_of_a_cube(cube):
    facts = convert([(cube, 1.0)], {"sieve": 3.0, "density": 100.0}, 1e-3).facts()
    assert facts["radius"] == pytest.approx(3.0 / EDGE, rel=1e-4)  # four decimals are stored
    assert facts["maximum_dimension"] == pytest.approx(3.0 * math.sqrt(3.0), rel=1e-4)
    assert facts["effective_radius"] == pytest.approx(1.5, rel=0.01)  # 3 V / S of edge 3; A has an error
    assert facts["volume_radius"] == pytest.approx(3.0 * (0.75 / math.pi) ** (1.0 / 3.0), rel=1e-4)
    assert facts["ssa"] == pytest.approx(6.0 / (917.0 * 3e-3), rel=1e-4)
    assert facts["solid_fraction"] == pytest.approx(100.0 / 917.0, rel=1e-12)
    share = 8.0 / 3.0**1.5 / (4.0 * math.pi / 3.0)
    assert facts["packing_fraction"] == pytest.approx(100.0 / 917.0 / share, rel=1e-12)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("amount", AMOUNTS)
def test_there_and_back(cube, ball, size, amount):
    """A mixture said in any words has all the others' values, which in turn say the same."""
    grains = [(cube, 3.0), (ball, 1.0)]
    first = convert(grains, {"radius": 0.37, "packing_fraction": 0.41}, 0.01)
    facts = first.facts()
    again = convert(grains, {size: facts[size], amount: facts[amount]}, 0.01)
    assert again.radius == pytest.approx(0.37, rel=1e-12)
    assert again.packing_fraction == pytest.approx(0.41, rel=1e-12)
    for word, value in facts.items():
        assert f"{word} {value:.4g}" in again.summary()


def test_a_mixture_is_a_mean_by_number(cube, ball):
    both, one, other = grain_sizes([(cube, 1.0), (ball, 3.0)]), grain_sizes([(cube, 2.0)]), grain_sizes([(ball, 1.0)])
    assert both.volume == pytest.approx((one.volume + 3.0 * other.volume) / 4.0, rel=1e-12)
    assert both.area == pytest.approx((one.area + 3.0 * other.area) / 4.0, rel=1e-12)
    assert both.sieve == 2.0 and both.maximum_dimension == 2.0
    assert both.material_density == pytest.approx(917.0, rel=1e-12)
    salt = grain_sizes([(ball, 1.0), (without(ball, material="salt"), 1.0)])
    assert salt.material_density == pytest.approx((917.0 + DENSITIES["salt"]) / 2.0, rel=1e-12)


def test_too_dense_says_what_it_would_take(cube):
    sizes = grain_sizes([(cube, 1.0)])
    most = 0.64 * sizes.solid_share * 917.0
    convert([(cube, 1.0)], {"density": most * (1.0 - 1e-9)})
    with pytest.raises(UsageError) as caught:
        convert([(cube, 1.0)], {"density": 1.5 * most})
    text = str(caught.value)
    path = volume_parameters([Component(cube)], 0.64).transport_mean_free_path
    for part in (f"fraction of {0.96:g}", f"{most:.3g} kg/m3", f"{path:.3g} R", "about 1.5 times", "1.5 times as thick",
                 "0.667 times as large where absorption is said by colour or over R"):  # fmt: skip
        assert part in text
    assert "\n" not in text
    loose = convert([(cube, 1.0)], {"density": 1.5 * most}, packed=False)  # where spheres need no room
    assert loose.packing_fraction == pytest.approx(0.96) and loose.density == pytest.approx(1.5 * most)
    with pytest.raises(UsageError, match="more than that of the material"):
        convert([(cube, 1.0)], {"density": 918.0}, packed=False)
    with pytest.raises(UsageError, match=r"solid_fraction 0\.4 of cube would take a packing fraction of 1\.09"):
        convert([(cube, 1.0)], {"solid_fraction": 0.4})


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"radius": 1.0}, "how much of space is filled is missing: give one of packing_fraction"),
        ({"radius": 1.0, "sieve": 1.0, "density": 1.0}, "radius and sieve each say the size"),
        ({"density": 100.0, "solid_fraction": 0.1}, "solid_fraction and density each say the amount"),
        ({"packing_fraction": 0.75}, "at most 0.74"),
        ({"solid_fraction": 1.2}, "at most 1"),
        ({"density": 1000.0}, "more than that of the material, 917 kg/m3"),
        ({"density": -1.0}, "density must be a finite number > 0, not -1"),
        ({"density": math.nan}, "density must be a finite number > 0, not nan"),
        ({"ssa": 20.0, "density": 100.0}, "ssa is per kg and in metres"),
        ({"grainsize": 1.0, "density": 100.0}, "unknown size or amount 'grainsize'; there are radius"),
        ({"effective_radius": 1e31, "density": 100.0}, "out of range"),
    ],
)
def test_what_cannot_be_meant(cube, said, message):
    with pytest.raises(UsageError) as caught:
        convert([(cube, 1.0)], said)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_what_a_table_does_not_say(cube):
    old = without(cube, "x_sieve", "x_maximum_dimension", material=None)
    for word in ("sieve", "maximum_dimension"):
        with pytest.raises(UsageError, match=f"{word}: the table of cube does not say it; build it again"):
            convert([(old, 1.0)], {word: 1.0, "packing_fraction": 0.5})
    with pytest.raises(UsageError, match=r"density needs .* names none .* say material_density"):
        convert([(old, 1.0)], {"density": 100.0})
    assert convert([(old, 1.0)], {"density": 100.0, "material_density": 500.0}).solid_fraction == pytest.approx(0.2)
    assert "sieve" not in convert([(old, 1.0)], {"packing_fraction": 0.5}).summary()
    header = thawed(cube.header)
    header["grain"]["x_sieve"] = "a hostile one"
    assert grain_sizes([(Table(header, cube.pixels), 1.0)]).sieve is None
