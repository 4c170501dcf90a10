"""tsdf-optics and tsdf-albedo: what they print and write, and what they refuse in one line."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import tsdf
from tsdf.cli import albedo, common, optics
from tsdf.reference_data.make_checks import CHECKS
from tsdf.study import slabs

CUBE = CHECKS / "cube_memory.tsdf.exr"
SOME = ("--wavelength-nm", "400:1200:400", "--quiet")


def run(command: object, *arguments: object) -> Result:
    return CliRunner().invoke(command.main, [str(a) for a in arguments])  # type: ignore[attr-defined]


@pytest.mark.slow
def test_optics_says_the_same_everywhere(tmp_path: Path) -> None:
    """JSON, CSV and the table of numbers agree; phase functions, moments and picture are there."""
    files = {name: tmp_path / name for name in ("a.csv", "p.txt", "m.csv", "o.png")}
    result = run(
        optics, CUBE, *SOME[:2], "--ssa", 20, "--json", "--csv", files["a.csv"], "--phase", files["p.txt"],
        "--moments", files["m.csv"], "--orders", 8, "--forward", "apart", "--plot", files["o.png"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    rows = [row for row in csv.reader(files["a.csv"].read_text().splitlines()) if not row[0].startswith("#")]
    table = {name: [float(row[i]) for row in rows[1:]] for i, name in enumerate(rows[0])}
    assert table["wavelength_nm"] == facts["wavelength_nm"] == [400.0, 800.0, 1200.0]
    for name in ("albedo", "g", "g_far", "enhancement", "albedo_error"):
        assert table[name] == pytest.approx(facts[name], rel=1e-6), name
    cube = tsdf.read(CUBE)
    assert facts["g"][0] == pytest.approx(cube.mean_cosine(), abs=1e-4)
    assert facts["enhancement"][0] == pytest.approx(cube.absorption_enhancement.value, rel=1e-6)
    assert "n is that of the one table" in " ".join(facts["notes"])
    moments = np.loadtxt(files["m.csv"], delimiter=",", skiprows=3)
    assert moments.shape == (9, 4) and (moments[0, 1:] == 1.0).all()
    assert len(np.loadtxt(files["p.txt"], skiprows=5)) == len(cube.p_theta) - 2
    assert files["o.png"].read_bytes()[1:4] == b"PNG"
    text = run(optics, CUBE, *SOME[:2], "--ssa", 20).stdout.splitlines()
    assert len([line for line in text if not line.startswith("#")]) == 4


@pytest.mark.slow
def test_albedo_says_what_was_asked(tmp_path: Path) -> None:
    plot, sheet = tmp_path / "a.png", tmp_path / "a.csv"
    result = run(
        albedo, CUBE, *SOME, "--level", "teleport-memory", "--packing", 0.4, "--thickness", "2mm", "--angle", 60,
        "--ground", 0.3, "--profile", 3, "--paths", 2048, "--radius", "0.2mm", "--json", "--plot", plot, "--csv", sheet,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["paths"] == 2048 and facts["level"] == "teleport-memory" and facts["packing_fraction"] == 0.4
    assert facts["profile_edges_m"] == pytest.approx([0.0, 2e-3 / 3, 4e-3 / 3, 2e-3])
    whole = np.array(facts["reflectance"]) + 0.7 * np.array(facts["transmittance"])
    whole += sum(np.array(facts[f"absorbed_{k}"]) for k in (1, 2, 3))
    assert whole == pytest.approx(np.ones(3), abs=1e-6)
    assert facts["reflectance"][0] > facts["reflectance"][2] and all(e > 0.0 for e in facts["reflectance_error"])
    assert plot.stat().st_size > 10_000 and sheet.read_text().count("\n") > 4
    dense = json.loads(
        run(albedo, CUBE, *SOME, "--density", 150, "--paths", 512, "--thickness", "1mm", "--json").stdout
    )
    cube = tsdf.read(CUBE)
    share = cube.header["grain"]["volume"] / (4.0 / 3.0 * np.pi)
    assert dense["packing_fraction"] == pytest.approx(150.0 / 917.0 / share, rel=1e-6)
    assert dense["size"].endswith("(by default)")


@pytest.mark.parametrize("command", [optics, albedo])
@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        ((CUBE, "--wavelength-nm", "100"), 2, "200 to 5000 nm"),
        ((CUBE, "--wavelength-nm", "red"), 2, "give FROM:TO:STEP"),
        ((CUBE, "--material", "chees"), 2, "unknown material"),
        ((CUBE, "snow"), 2, "not both"),
        (("snow", "sand"), 2, "give one GRAIN"),
        ((CUBE, "--set", "size=1"), 2, "--set shapes a GRAIN"),
        ((CUBE, "--ssa", 20, "--radius", "1mm"), 2, "each say how large"),
        ((CUBE, "--radius", "1 furlong"), 2, "is not a length"),
        ((CUBE, "--ssa", -1), 2, "ssa"),
        ((CUBE, "--plot", "x.gif"), 2, "a .png, .pdf or .svg"),
        ((CUBE, "--csv", CUBE), 2, "it is an input"),
        ((CUBE, "--fresnel", "un"), 2, "--fresnel is that of tables that are made"),
        (("cube", "--fresnel", "sp"), 2, "use --fresnel un for meshes"),
        (("sphere", "--material-density", 0), 2, "--material-density is a finite number > 0, not 0"),
        (("sphere", "--material", "mine.csv", "--ssa", 20), 2, "not known of mine.csv: say --material-density"),
        (("sphere", "--csv", "/dev/stdout"), 1, "choose another --csv, or - to print it"),
        (("sphere", "--plot", "/dev/x.png"), 1, "(screen, pipe or device); choose another --plot\n"),
        (("sphere", "--csv", "none/x.csv"), 1, "choose another --csv"),
        (("sphere", "--csv", "-", "--json"), 2, "--csv - and --json both go to standard output"),
        (("no-such.tsdf.exr",), 1, "no-such.tsdf.exr"),
        (("no-such-grain",), 1, "neither a file nor a built-in grain"),
    ],
)  # fmt: skip
def test_what_both_refuse(command: object, arguments: tuple[object, ...], status: int, said: str) -> None:
    result = run(command, *arguments)
    assert result.exit_code == status, result.output
    assert said in result.output and result.output.count("\n") == 1, result.output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--angle", 90), "below 90"), (("--angle", 30, "--diffuse"), "give one"), (("--ground", 0.5), "--thickness"),
        (("--ground", 1.5, "--thickness", "1mm"), "0 to 1"), (("--level", "telport"), "did you mean teleport"),
        (("--error", 0), "--error"), (("--depth", "1mm"), "--profile"), (("--paths", 0), "at least 1"),
        (("--density", 900, "--level", "teleport"), "--packing 0.64: of a half-space density hardly matters"),
        (("--density", 470.776, "--level", "teleport", "--thickness", "1mm"), "--packing 0.64 --thickness 2.18mm: as"),
        (("--density", 918), "or another --material-density"), (("--packing", 0.9), "0.74"),
        (("--material", "quartz"), "not known at 300 nm"),
        (("--level", "teleport-joint"), "--joint 32"), (("--profile", 2000), "1 to 1000"),
        (("--packing", 0.5, "--density", 100), "--packing and --density"),
        (("--level", "volume,explicit"), "one level"),
        (("--paths", 31), "at least 32 paths"), (("--packing", "nan"), "--packing"),
        (("--density", "nan"), "--density"),
    ],
)  # fmt: skip
def test_what_albedo_refuses(arguments: tuple[object, ...], said: str) -> None:
    result = run(albedo, CUBE, *arguments)
    assert result.exit_code in (1, 2) and said in result.output, result.output
    assert result.output.count("\n") == 1


def test_what_is_wrong_is_said_before_tables_are_made() -> None:
    """Making them takes minutes."""
    for arguments in (
        ("--packing", 0.9),
        ("--density", 918),
        ("--ground", 2, "--thickness", "1mm"),
        ("--profile", -1),
        ("--paths", 1),
    ):
        result = run(albedo, "snow", "--table-paths", "1e18", *arguments)
        assert result.exit_code == 2 and result.output.count("\n") == 1, result.output


@pytest.mark.slow
def test_constants_of_your_own_take_a_density(tmp_path: Path) -> None:
    """Grains of an SSA are as large as the density says, and as those of ice if it is that of ice."""
    mine = tmp_path / "mine.csv"
    mine.write_text("wavelength_nm,n,k\n500,1.31,1e-7\n1000,1.31,1e-7\n")
    same = ("sphere", "--wavelength-nm", "600", "--json")

    def radius(*words: object) -> float:
        result = run(optics, *same, "--ssa", 20, *words)
        assert result.exit_code == 0, result.output
        return float(json.loads(result.stdout)["radius_m"])

    assert radius("--material", mine, "--material-density", 500) == pytest.approx(3.0 / (500.0 * 20.0))
    assert radius("--material", mine, "--material-density", 917) == pytest.approx(radius()) == 3.0 / (917.0 * 20.0)
    thin = ("--material", mine, "--thickness", "1mm", "--paths", 64, *same)
    without = run(albedo, *thin, "--density", 300)
    assert without.exit_code == 2 and "--density needs the density of the material" in without.stderr
    slab = json.loads(run(albedo, *thin, "--density", 300, "--material-density", 1000).stdout)
    assert slab["packing_fraction"] == pytest.approx(0.3) and slab["material_density"] == 1000.0


@pytest.mark.slow
def test_the_convention_of_fresnel_is_said() -> None:
    """Kept apart g of a sphere is the exact one of polarised light, averaged it is not, and the notes say which."""
    from tsdf.judge.analytic import sphere_statistics

    for words, convention in (((), "un"), (("--fresnel", "sp"), "sp")):
        facts = json.loads(run(optics, "sphere", "--wavelength-nm", "500", "--json", *words).stdout)
        exact = sphere_statistics(facts["n"][0], convention, 0.0).mean_cosine
        assert facts["fresnel"] == convention and facts["g"][0] == pytest.approx(exact, abs=1e-5)
        assert f"Fresnel {convention} (" in " ".join(facts["notes"])


@pytest.mark.slow
def test_points_need_no_room() -> None:
    """A density at which bounding spheres cannot be packed is as much mass of the same grains at the densest packing,
    in a slab that is thicker; depths are those of the slab that was asked for. Half as thick it is another."""
    cube = tsdf.read(CUBE)
    most = 0.64 * cube.header["grain"]["volume"] / (4.0 / 3.0 * np.pi) * 917.0

    def slab(*words: object) -> dict:
        words = (CUBE, *SOME, "--ssa", 20, "--profile", 2, "--paths", 512, "--json", *words)
        return json.loads(run(albedo, *words).stdout)

    dense = slab("--density", 1.6 * most, "--thickness", "2mm")
    same, other = (slab("--packing", 0.64, "--thickness", f"{t}mm") for t in (3.2, 2.0))
    assert dense["packing_fraction"] == 0.64 and dense["density"] == pytest.approx(1.6 * most)
    assert any("in a slab of 3.2 mm, which has the same mass per area" in note for note in dense["notes"])
    for name in ("reflectance", "transmittance", "absorbed_2", "two_streams_r"):
        assert dense[name] == pytest.approx(same[name], rel=1e-6)
        assert dense[name] != pytest.approx(other[name], rel=0.01)
    assert dense["profile_edges_m"] == pytest.approx([0.0, 1e-3, 2e-3])
    assert dense["optical_depth"] == pytest.approx(same["optical_depth"], rel=1e-6)
    for i, albedo_of in enumerate(json.loads(run(optics, CUBE, *SOME, "--ssa", 20, "--json").stdout)["albedo"]):
        sigma = slabs.extinction(cube, 0.64, np.array([albedo_of])).item()
        assert dense["optical_depth"][i] == pytest.approx(3.2e-3 / dense["radius_m"] * sigma, rel=1e-6)


def test_texts_go_to_standard_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `-`, which is no file then, and alone there: what a file would hold."""
    monkeypatch.chdir(tmp_path)
    some = (optics, CUBE, "--wavelength-nm", "500,600", "--orders", 3)
    for option in ("--csv", "--phase", "--moments"):
        printed, filed = run(*some, option, "-"), run(*some, option, "file", "--quiet")
        assert printed.exit_code == filed.exit_code == 0 and filed.stdout == ""
        assert printed.stdout == (tmp_path / "file").read_text() and [*tmp_path.iterdir()] == [tmp_path / "file"]


@pytest.mark.slow
@pytest.mark.parametrize("kept", [True, False])
def test_an_interrupt_keeps_what_is_measured(kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first paths of all sets on; before there is nothing, and the signal ends the process by itself."""
    works: list[common.Work] = []

    class Known(common.Work):
        def __init__(self, progress: common.Progress) -> None:
            super().__init__(progress)
            works.append(self)

    measure = slabs.measure

    def interrupted(*words: Any) -> Any:
        *others, told, goes_on = words
        assert works[0].meaning() == "nothing is written"

        def heard(paths: int) -> bool:
            goes_on(paths)
            assert paths > 0 and (not kept or works[0].meaning() is None)
            return bool(goes_on(paths))

        return measure(*others, told, heard)

    monkeypatch.setattr(common, "Work", Known)
    monkeypatch.setattr(slabs, "measure", interrupted)
    sheet = tmp_path / "a.csv"
    error = 1e-4 if kept else 0.01
    result = run(albedo, CUBE, *SOME[:2], "--thickness", "2mm", "--error", error, "--json", "--csv", sheet)
    facts = json.loads(result.stdout)
    assert facts["interrupted"] == kept and facts["paths"] == slabs.FEWEST and sheet.exists()
    assert result.exit_code == (130 if kept else 0), result.output
    said = f"interrupted: results of {slabs.FEWEST} paths with errors up to 0.00"
    assert (said in result.stderr) == kept == any(said in note for note in facts["notes"])
    assert (max(facts["reflectance_error"]) > error) == kept


def test_near_wavelengths_keep_their_columns(tmp_path: Path) -> None:
    out, near = tmp_path / "m.csv", "500.00001,500.00002"
    assert run(optics, CUBE, "--wavelength-nm", near, "--moments", out, "--orders", 2, "--quiet").exit_code == 0
    assert out.read_text().splitlines()[2] == "order,500.00001nm,500.00002nm"


@pytest.mark.slow
def test_tables_say_what_they_are_of(tmp_path: Path) -> None:
    """Without --material the constants are those of the table's own; of an index alone, of ice as before; of two
    materials, or of one that is not built in, they are asked for."""
    files = {"quartz": tmp_path / "q.tsdf.exr", "salt": tmp_path / "s.tsdf.exr", "mine": tmp_path / "m.tsdf.exr"}
    for name, path in files.items():
        made = tsdf.build("sphere", tsdf.Optics(1.55, "un", name, 550.0), tsdf.Effort(cells=16))
        tsdf.write(made, path)
    some = ("--wavelength-nm", "500,600", "--quiet", "--json")

    def material(*words: object) -> str:
        return str(json.loads(run(optics, *words, *some).stdout)["material"])

    assert material(files["quartz"]) == "quartz" and material(CUBE) == "ice" and material("glass-beads") == "glass"
    assert material(files["quartz"], "--material", "salt") == "salt"
    for words, said in ((("quartz", "salt"), "of quartz and salt: say --material"), (("mine",), "mine, which is not")):
        result = run(optics, *(files[word] for word in words), *some)
        assert result.exit_code == 2 and said in result.stderr and result.stderr.count("\n") == 1
