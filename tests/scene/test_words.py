"""Scenes in others' words: sizes, densities, colours and own constants become our numbers, by the tables they name."""

import math
from pathlib import Path

import pytest

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table, thawed
from tsdf.errors import SceneError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.scene import deep
from tsdf.scene.scene import parse
from tsdf.scene.specs import absorption_at, files_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an ice sphere that fills half of its bounding sphere, and constants in a file."""
    place = tmp_path_factory.mktemp("words")
    table = exact_sphere(load_grain("sphere"), Optics(1.31, material="ice"), Effort(cells=16))
    header = thawed(table.header)
    header["grain"]["volume"] /= 2.0
    tsdf_format.write(Table(header, table.pixels), place / "half.tsdf.exr")
    tsdf_format.write(table, place / "ball.tsdf.exr")
    (place / "own.csv").write_text("wavelength_nm,n,k\n300,1.5,1e-6\n900,1.5,1e-6\n")
    (place / "short.csv").write_text("wavelength_nm,n,k\n450,1.5,1e-6\n900,1.5,1e-6\n")
    (place / "clear.csv").write_text("wavelength_nm,n\n300,1.5\n900,1.5\n")
    return place


def whole(folder, medium=None, metres=0.001, **grain):
    """Return a scene of one medium, in millimetres."""
    grains = {"shape": {"type": "slab", "low": 0, "high": 9}, "grain": [{"table": "half.tsdf.exr", **grain}]}
    data = {
        "camera": {"position": [0, -3, 1], "target": [0, 0, 0], "width": 4, "height": 3},
        "light": [{"type": "constant", "radiance": 1.0}],
        "medium": [grains | (medium or {"radius": 0.5, "packing_fraction": 0.6})],
    }
    return parse(data | ({"metres_per_unit": metres} if metres else {}), folder, "a.toml")


def scene(folder, medium=None, metres=0.001, **grain):
    return whole(folder, medium, metres, **grain).media[0]


def test_sizes_and_densities_become_ours(folder):
    """In millimetres: half a ball of ice has an effective radius of R / 2, a specific surface of 6 / (rho R)."""
    medium = scene(folder, {"effective_radius": 0.5, "density": 91.7})
    assert (medium.radius, medium.packing_fraction) == pytest.approx((1.0, 0.2))
    medium = scene(folder, {"ssa": 6.0 / 0.917, "solid_fraction": 0.1})
    assert (medium.radius, medium.packing_fraction) == pytest.approx((1.0, 0.2))
    medium = scene(folder, {"sieve": 2.0, "density": 100.0, "material_density": 1000.0})
    assert (medium.radius, medium.packing_fraction) == pytest.approx((1.0, 0.2))
    assert dict(medium.sizes) == {"sieve": 2.0, "density": 100.0, "material_density": 1000.0}


def test_a_mixture_is_converted_as_one(folder):
    grains = [{"table": "half.tsdf.exr", "fraction": 1}, {"table": "ball.tsdf.exr", "fraction": 2}]
    medium = scene(folder, {"radius": 1.0, "solid_fraction": 0.25, "grain": grains})
    assert medium.packing_fraction == pytest.approx(0.25 / (2.5 / 3.0))


@pytest.mark.parametrize("word", ["albedo", "deep_colour"])
@pytest.mark.parametrize("inner", [False, True])
def test_a_colour_becomes_absorption(folder, word, inner):
    """Per unit it is what `deep` says over the radius, wherever the word stands."""
    colour = [0.9, 0.5, 0.2]
    said = {"absorption": {word: colour}} if inner else {word: colour}
    spec = scene(folder, **said).grains[0].absorption
    table = tsdf_format.read(folder / "half.tsdf.exr")
    assert spec.kind == "rgb" and spec.colour == tuple(colour)
    assert [deep.deep_colour(table, a * 0.5) for a in spec.coefficient] == pytest.approx(colour, abs=1e-6)
    medium = {"effective_radius": 0.5, "density": 91.7}  # R is 1
    again = scene(folder, medium, **said).grains[0].absorption
    assert again.coefficient == pytest.approx([a / 2.0 for a in spec.coefficient], rel=1e-9)


def test_a_slab_needs_less(folder):
    thin = scene(folder, absorption={"albedo": 0.3, "thickness": 8.0}).grains[0].absorption
    thick = scene(folder, absorption={"albedo": 0.3}).grains[0].absorption
    assert all(0.0 < a < b for a, b in zip(thin.coefficient, thick.coefficient, strict=True))


def test_own_constants(folder):
    spec = scene(folder, absorption={"material": "own.csv"}).grains[0].absorption
    assert spec.material == folder / "own.csv"
    assert absorption_at(spec, [500.0], 0.001) == pytest.approx(4.0 * math.pi * 1e-6 / 500e-9 * 0.001)


def test_own_constants_are_files_of_the_scene(folder):
    """So that no command writes over them."""
    assert folder / "own.csv" in files_of(whole(folder, absorption={"material": "own.csv"}))


@pytest.mark.parametrize(
    ("medium", "grain", "message"),
    [
        ({"radius": 1.0, "density": 400.0}, {}, "density 400 kg/m3 of sphere would take a packing fraction of 0.872"),
        ({"density": 100.0}, {}, "how large grains are is missing; give one of radius, effective_radius"),
        ({"sieve": 1.0}, {}, "how much of space is filled is missing"),
        ({"radius": 1.0, "density": 1000.0}, {}, "more than that of the material"),
        (None, {"albedo": 0.001}, "a colour of 0.001 is out of reach"),
        (None, {"albedo": 0.5, "deep_colour": 0.5}, "albedo and deep_colour both say how grains absorb"),
        (None, {"albedo": 0.5, "absorption": 1.0}, "albedo and absorption both say how grains absorb"),
        (None, {"absorption": {"albedo": 0.9, "thickness": 2.0}}, "a slab 4 R thick of this grain reflects"),
        (None, {"absorption": {"material": "short.csv"}}, "short.csv: says k from 450 to 900 nm only"),
        (None, {"absorption": {"material": "clear.csv"}}, "clear.csv: does not say k"),
    ],
)  # fmt: skip
def test_what_tables_refuse_is_said_with_its_place(folder, medium, grain, message):
    with pytest.raises(SceneError) as caught:
        scene(folder, medium, **grain)
    text = str(caught.value)
    assert text.startswith("a.toml: [[medium]] 1") and "\n" not in text
    assert message in text


def test_a_file_that_is_no_table_is_refused_with_its_place(folder):
    with pytest.raises(SceneError, match=r"a\.toml: \[\[medium\]\] 1: .*own\.csv"):
        scene(folder, {"radius": 1.0, "density": 9.0, "grain": [{"table": "own.csv"}]})
    with pytest.raises(SceneError, match="ssa is per kg and in metres"):
        scene(folder, {"ssa": 20.0, "packing_fraction": 0.5}, metres=None)
