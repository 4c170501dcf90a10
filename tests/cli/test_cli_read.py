"""tsdf-info, tsdf-plot, tsdf-validate: results on standard output, one-line errors, exit statuses, no tracebacks."""

import json
import math
import os
import subprocess
import sys
import warnings
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from tsdf.cli import info, plot, validate
from tsdf.cli.common import Tool, plain
from tsdf.data import format as tsdf_format
from tsdf.errors import FormatWarning, TSDFError, UsageError
from tsdf.reference_data.make_checks import CHECKS
from tsdf.scene.deep import deep_colour

SPHERE, CUBE = str(CHECKS / "sphere.tsdf.exr"), str(CHECKS / "cube.tsdf.exr")
WRONG = str(CHECKS / "PHYSICS_CHORD.tsdf.exr")
NEWER = str(CHECKS.parent / "valid" / "newer_minor.tsdf.exr")


def run(command, *arguments):
    return CliRunner().invoke(command.main, [str(a) for a in arguments])


def fails(result, status, *parts):
    """The run ended with `status` and one line on standard error that holds all `parts`."""
    assert result.exit_code == status, result.output
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1 and ": error: " in result.stderr
    assert all(part in result.stderr for part in parts), result.stderr


# --- info ---------------------------------------------------------------------------


def test_info_json_says_what_the_header_says():
    result = run(info, CUBE, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    facts, table = json.loads(result.stdout), tsdf_format.read(CUBE)
    assert (facts["grain"], facts["kind"], facts["eta"], facts["fresnel"]) == ("cube", "mesh", 1.31, "un")
    assert facts["cells"] == {"cos_theta": 16, "p_phi": 32, "p_r": 64, "p_z": 96, "p_l": len(table.p_l)}
    for name, value in table.statistics.items():
        assert facts[name] == (list(value) if name == "legendre_moments" else value)
    assert facts["standard_errors"]["mean_z"] == table.header["standard_errors"]["mean_z"] > 0
    for name in ("table_error", "factorisation_error", "energy_ledger", "fits"):
        assert set(facts[name]) == set(table.header[name])
    assert (facts["joint_records"], facts["paths"], facts["absorption_times_radius"]) == (8, 1 << 17, 0.0)
    assert (facts["memory_records"], facts["format_version"]) == (0, "1.0")
    facts = json.loads(run(info, CUBE.replace("cube.tsdf", "cube_memory.tsdf"), "--json").stdout)
    assert (facts["memory_records"], facts["joint_records"], facts["format_version"]) == (32, 0, "1.1")


def test_info_for_people():
    result = run(info, CUBE)
    assert (result.exit_code, result.stderr) == (0, "")
    table = tsdf_format.read(CUBE)
    for text in (f"{table.statistics['mean_z']:.6f} +- ", "Henyey-Greenstein", "scattered", "eta", "131072 paths"):
        assert text in result.stdout
    assert "exact" in run(info, SPHERE).stdout


def test_info_in_others_words():
    """What snow scientists ask for, in JSON, by any word of size and amount; in metres here, of ice."""
    options = ("--effective-radius", "1e-4", "--density", "200", "--material-density", "917", "--unit", "1")
    facts = json.loads(run(info, SPHERE, "--json", *options).stdout)
    assert facts["absorption_enhancement"] == pytest.approx(1.333**2 * (1.0 - (1.0 - 1.333**-2) ** 1.5), abs=1e-9)
    assert facts["asymmetry_factor"] == facts["mean_cosine"]
    assert facts["asymmetry_factor_far_field"] == pytest.approx((1.0 + facts["mean_cosine"]) / 2.0)
    assert facts["specific_surface_area"] == pytest.approx(3.0 / 917.0 / 1e-4)
    assert facts["effective_radius"] == pytest.approx(1e-4) and facts["projected_area"] == pytest.approx(math.pi * 1e-8)
    assert facts["solid_fraction"] == pytest.approx(200.0 / 917.0)
    assert facts["dark_share"] == pytest.approx((1.0 - 1.333**-2) ** 1.5, abs=1e-9)
    assert facts["medium"]["packing_fraction"] == facts["sizes"]["packing_fraction"] == facts["solid_fraction"]
    for name in ("absorption_enhancement", "asymmetry_factor", "asymmetry_factor_far_field", "effective_radius"):
        assert facts["standard_errors"][name] == 0.0
    assert json.loads(run(info, CUBE, "--json").stdout)["standard_errors"]["absorption_enhancement"] > 0.0
    said = run(info, SPHERE, *options).stdout
    assert "ssa                        32.7154 m2/kg" in said and "density                    200 kg/m3" in said
    assert json.loads(run(info, SPHERE, "--json").stdout)["specific_surface_area"] is None


def test_info_of_a_colour():
    """Absorption in all conventions; lengths are those said, here R of 2 mm."""
    options = ("--deep-colour", "0.9,0.5,0.2", "--radius", "2", "--unit", "1e-3")
    colour = json.loads(run(info, SPHERE, "--json", *options).stdout)["colour"]
    by_radius = colour["absorption_times_radius"]
    assert [deep_colour(tsdf_format.read(SPHERE), x) for x in by_radius] == pytest.approx([0.9, 0.5, 0.2], abs=1e-6)
    assert colour["absorption"] == pytest.approx([x / 2.0 for x in by_radius])
    assert colour["absorption_per_metre"] == pytest.approx([x / 2e-3 for x in by_radius])
    units = {"R": 1.0, "mm": 2.0, "m": 2e-3}
    said = " = ".join(f"{', '.join(f'{x / by:.4g}' for x in by_radius)} / {unit}" for unit, by in units.items())
    assert said in run(info, SPHERE, *options).stdout
    thin = ("--colour-thickness", "20", "--packing", "0.6")
    slab = json.loads(run(info, SPHERE, "--json", "--albedo", "0.3", "--radius", "2", *thin).stdout)["colour"]
    (whole,) = json.loads(run(info, SPHERE, "--json", "--albedo", "0.3").stdout)["colour"]["absorption_times_radius"]
    assert 0.0 < slab["absorption_times_radius"][0] < whole


def test_absorption_changes_albedo_and_mean_cosine_only():
    facts = json.loads(run(info, SPHERE, "--json", "--absorption", "0.1/R").stdout)
    lossless = json.loads(run(info, SPHERE, "--json").stdout)
    assert facts["albedo"] == tsdf_format.read(SPHERE).albedo(0.1) == pytest.approx(0.847, abs=0.001)
    assert facts["mean_cosine"] == tsdf_format.read(SPHERE).mean_cosine(0.1) > lossless["mean_cosine"]
    assert (facts["absorption_times_radius"], facts["absorption"]) == (0.1, None)
    assert facts["mean_z"] == lossless["mean_z"]
    assert facts["standard_errors"]["albedo"] is None
    assert run(info, SPHERE, "--absorption", "1e300/R").exit_code == 0


@pytest.mark.parametrize(
    ("given", "options", "product"),
    [
        ("0.1/R", (), 0.1),
        ("0.1 / R", ("--radius", "7", "--packing", "0.5"), 0.1),
        ("0.2/unit", ("--radius", "0.5"), 0.1),
        ("5/mm", ("--radius", "0.5", "--unit", "1e-3"), 2.5),
        ("5/mm", ("--radius", "2e-3", "--unit", "1"), 10.0),
        ("50/cm", ("--radius", "2", "--unit", "1e-3"), 10.0),
        ("5000/m", ("--radius", "2000", "--unit", "1e-6"), 10.0),
        ("5e-3/um", ("--radius", "0.02", "--unit", "0.1"), 10.0),
    ],
)
def test_absorption_has_a_unit(given, options, product):
    """Times R, per unit of --radius or per length: the product by hand, and both conventions in text and JSON."""
    result = run(info, SPHERE, "--json", "--absorption", given, *options)
    facts = json.loads(result.stdout)
    assert result.stderr == ""
    assert facts["absorption_times_radius"] == pytest.approx(product, rel=1e-12)
    assert facts["albedo"] == pytest.approx(tsdf_format.read(SPHERE).albedo(product), rel=1e-12)
    text = run(info, SPHERE, "--absorption", given, *options).stdout
    radius = dict(zip(options[::2], options[1::2], strict=True)).get("--radius")
    assert f"absorption           {product:g} / R" in text
    if radius is None:
        assert facts["absorption"] is None
    else:
        assert facts["absorption"] == pytest.approx(product / float(radius), rel=1e-12)
        unit = {"1e-3": "mm", "1": "m", "1e-6": "um"}.get(options[3], "unit") if "--unit" in options else "unit"
        assert f"{product:g} / R, {product / float(radius):g} / {unit}," in text


def test_a_bare_absorption_is_over_R():
    """As what is shown says."""
    assert json.loads(run(info, SPHERE, "--json", "--absorption", "0.1").stdout)["absorption_times_radius"] == 0.1
    assert "0.1 / R" in run(info, SPHERE, "--absorption", "0.1").stdout


@pytest.mark.parametrize(
    "value", ["-1", "nan", "inf", "x", "", "/R", "1/", "1/mile", "1/r", "-1/R", "1,2,3/R", "1/R/R", "1/unit", "1/mm"]
)
def test_absorption_that_cannot_be(value):
    fails(run(info, SPHERE, "--absorption", value), 2, "--absorption")


def test_absorption_that_lacks_a_length():
    """The way out names what is missing."""
    fails(run(info, SPHERE, "--absorption", "1/unit"), 2, "--radius, the bounding radius")
    fails(run(info, SPHERE, "--absorption", "1/mm", "--radius", "1"), 2, "--unit, the length of that unit in metres")
    fails(run(info, SPHERE, "--absorption", "1e300/nm", "--radius", "1e30", "--unit", "1"), 2, "out of the range")
    fails(run(info, SPHERE, "--absorption", "1/mm", "--radius", "0", "--unit", "1"), 2, "--radius", "> 0")
    fails(run(info, SPHERE, "--radius", "1e200"), 2, "--radius is a number of scene units from 1e-30 to 1e30")


def test_medium_of_packed_grains():
    """--packing says what `medium` says, in R; with --radius the same in its unit, absorption staying sigma_a R."""
    from tsdf.scene.medium import Component, free_path, volume_parameters

    facts = json.loads(run(info, CUBE, "--json", "--packing", "0.6", "--absorption", "0.1/R").stdout)["medium"]
    grains = [Component(tsdf_format.read(CUBE))]
    path, volume = free_path(grains, 0.6), volume_parameters(grains, 0.6, [0.1])
    lengths = {"lambda_b": path.lambda_b, "lambda_beta": path.lambda_beta, "lambda_s": path.lambda_s}
    lengths["transport_mean_free_path"] = volume.transport_mean_free_path
    coefficients = {name: getattr(volume, name) for name in ("sigma_t", "sigma_s", "sigma_a")}
    numbers = {"albedo": volume.albedo, "g": volume.g}
    assert facts == {"packing_fraction": 0.6, "radius": None} | lengths | coefficients | numbers
    options = ("--packing", "0.6", "--absorption", "0.1/R", "--radius", "0.001")
    scaled = json.loads(run(info, CUBE, "--json", *options).stdout)["medium"]
    assert all(scaled[name] == pytest.approx(0.001 * value) for name, value in lengths.items())
    assert all(scaled[name] == pytest.approx(1000.0 * value) for name, value in coefficients.items())
    assert all(scaled[name] == pytest.approx(value) for name, value in numbers.items())
    text = run(info, CUBE, *options).stdout
    assert f"{0.001 * path.lambda_beta:.6g} units" in text and f"{1000.0 * volume.sigma_t:.6g} / unit\n" in text
    for said in (("--radius", "1um"), ("--radius", "1", "--unit", "1e-6")):
        text = run(info, CUBE, *options[:4], *said).stdout
        assert f"{path.lambda_beta:.6g} um\n" in text and f"{volume.sigma_t:.6g} / um\n" in text
        assert f"{tsdf_format.read(CUBE).projected_area.value:.6g}" in text and " um^2\n" in text
        assert " units" not in text and "/ unit" not in text
    text = run(info, SPHERE, "--packing", "0.6").stdout
    assert "lambda_b             0.888889 R\n" in text and "sigma_a              0 / R\n" in text
    assert "medium" not in run(info, CUBE).stdout and "medium" not in json.loads(run(info, CUBE, "--json").stdout)


def test_medium_without_deflection():
    """Grains of the surrounding material never turn light: an infinite path is a word, and null in JSON."""
    options = (CHECKS / "cube_identity.tsdf.exr", "--packing", "0.5")
    assert "transport path       infinite\n" in run(info, *options).stdout
    assert json.loads(run(info, *options, "--json").stdout)["medium"]["transport_mean_free_path"] is None


@pytest.mark.parametrize(
    ("words", "same"),
    [
        (("--radius", "0.5mm"), ("--radius", "0.5", "--unit", "0.001")),
        (("--unit", "1", "--sieve", "500um"), ("--sieve", "0.0005", "--unit", "1")),
        (("--sieve", "500um", "--unit", "1"), ("--sieve", "0.0005", "--unit", "1")),
        (
            ("--radius", "1mm", "--colour-thickness", "4cm", "--deep-colour", ".5"),
            ("--unit", "1e-3", "--radius", "1", "--colour-thickness", "40", "--deep-colour", ".5"),
        ),
    ],
)
def test_lengths_with_a_unit(words, same):
    """A length that names its unit is converted to --unit, wherever that stands, or is what it says."""
    said, by_hand = (run(info, SPHERE, "--packing", "0.5", "--json", *some).stdout for some in (words, same))
    assert json.loads(said) == json.loads(by_hand)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (("--packing", "0.8"), ("--packing", "0.74")),
        (("--packing", "nan"), ("--packing", "0.74")),
        (("--packing", "0.5", "--radius", "0"), ("--radius", "> 0")),
        (("--density", "900"), ("--density", "names none that is known", "say --material-density")),
        (
            ("--density", "900", "--material-density", "900"),
            ("--density", "would take a packing fraction of 1:", "Say --packing 0.64:"),
        ),
        (("--ssa", "20"), ("--ssa", "--unit")),
        (("--radius", "1", "--sieve", "2"), ("--radius, --sieve", "give one")),
        (("--radius", "1parsec"), ("--radius", "'1parsec' is not a length, 0.2mm say (nm, um, mm, cm, m, km)")),
        (("--radius", "-1mm"), ("--radius", "not -1")),
        (("--radius", "1mm", "--unit", "0"), ("--unit is a finite number > 0",)),
        (("--colour-thickness", "1"), ("--colour-thickness", "--deep-colour")),
        (("--deep-colour", "1,.5,.5"), ("--deep-colour 1,.5,.5", "not 1: without any absorption it is 1")),
        (("--deep-colour", "0"), ("--deep-colour", "not 0: grains reflect some light")),
        (("--deep-colour", "red"), ("--deep-colour", "one number or three, R,G,B, not 'red'")),
        (("--deep-colour", ".5", "--absorption", "1/R"), ("--absorption and --deep-colour",)),
        (("--deep-colour", ".9", "--colour-thickness", "1"), ("give --packing",)),
        (("--albedo", "0.001"), ("a colour of 0.001 is out of reach", "say more than that")),
        (("--packing", "x"), ("--packing",)),
    ],
)
def test_medium_that_cannot_be(options, parts):
    fails(run(info, SPHERE, *options), 2, *parts)


def test_text_of_a_file_is_escaped(tmp_path):
    from tsdf.data.table import Table, thawed

    table = tsdf_format.read(CUBE)
    header = thawed(table.header)
    header["grain"]["name"] = "salt\u202e"
    path = tmp_path / "a.tsdf.exr"
    tsdf_format.write(Table(header, table.pixels), path)
    result = run(info, path)
    assert result.exit_code == 0 and "\x1b" not in result.stdout and r"salt\u202e" in result.stdout


# --- validate -----------------------------------------------------------------------


@pytest.mark.slow
def test_verdicts_and_exit_status():
    result = run(validate, SPHERE, CUBE)
    assert (result.exit_code, result.stderr) == (0, "")
    first, second = result.stdout.splitlines()
    assert first.startswith(f"{SPHERE}: valid (") and second.startswith(f"{CUBE}: valid (")
    result = run(validate, CUBE, WRONG)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert "PHYSICS_CHORD at /statistics/mean_miss_chord: " in lines[1]
    assert lines[2] == f"{WRONG}: not valid (1 error)"


def test_warnings_alone_are_valid():
    result = run(validate, "--structure", NEWER)
    assert result.exit_code == 0 and "VERSION_MINOR" in result.stdout
    assert result.stdout.endswith("valid (structure only, 1 warning)\n")


def test_validate_json(tmp_path):
    missing = tmp_path / "missing.tsdf.exr"
    result = run(validate, CUBE, WRONG, missing, "--json")
    assert result.exit_code == 1
    reports = json.loads(result.stdout)
    assert [(r["file"], r["valid"]) for r in reports] == [(CUBE, True), (WRONG, False), (str(missing), False)]
    assert reports[0]["findings"] == [] and reports[0]["checks"] > 50
    assert set(reports[1]["findings"][0]) == {"code", "severity", "pointer", "message"}
    assert reports[2]["findings"][0]["code"] == "FILE_UNREADABLE"


@pytest.mark.slow
def test_validate_plot(tmp_path):
    out = tmp_path / "a.png"
    assert run(validate, SPHERE, "--plot", out).exit_code == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    fails(run(validate, SPHERE, CUBE, "--plot", out), 2, "--plot")
    fails(run(validate, SPHERE, "--plot", tmp_path / "a.jpg"), 2, ".png, .pdf or .svg")
    result = run(validate, tmp_path / "missing", "--plot", tmp_path / "b.png")
    assert result.exit_code == 1 and "no picture" in result.stderr and not (tmp_path / "b.png").exists()


# --- plot, and what all share -------------------------------------------------------


@pytest.mark.slow
def test_plot_writes_a_picture(tmp_path):
    result = run(plot, CUBE, "--out", tmp_path / "a.PNG")
    assert (result.exit_code, result.output) == (0, "")
    assert [p.name for p in tmp_path.iterdir()] == ["a.PNG"]


def test_plot_refuses(tmp_path):
    fails(run(plot, CUBE, "--out", "a.gif"), 2, ".png, .pdf or .svg")
    fails(run(plot, CUBE), 2, "--out")
    fails(run(plot, CUBE, "--out", tmp_path / "missing" / "a.png"), 1, "cannot write")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("command", [(info,), (plot, "--out", "a.png")], ids=["info", "plot"])
def test_bad_files(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command, *options = command
    (tmp_path / "text.tsdf.exr").write_text("not an image")
    fails(run(command, "missing.tsdf.exr", *options), 1, "missing.tsdf.exr", "FILE_UNREADABLE")
    fails(run(command, "text.tsdf.exr", *options), 1, "text.tsdf.exr", "EXR_MAGIC")
    fails(run(command, ".", *options), 1, "FILE_UNREADABLE")
    fails(run(command, "--frob"), 2, "--frob", "--help")
    fails(run(command), 2, "FILE")
    result = run(command, NEWER, *options)
    assert result.exit_code == 0 and "warning: " in result.stderr and result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (UsageError("no"), 2, "tool: error: no"),
        (TSDFError("no"), 1, "tool: error: no"),
        (TSDFError("a\nb"), 1, r"tool: error: a\nb"),
        (OSError(28, "No space left on device", "out"), 1, "tool: error: out: No space left on device"),
        (KeyboardInterrupt(), 130, "tool: error: interrupted"),
        (MemoryError(), 1, "tool: error: not enough memory"),
        (click.UsageError("no"), 2, "tool: error: no (see tool --help)"),
        (click.ClickException("no"), 1, "tool: error: no"),
        (ZeroDivisionError("no"), 1, "tool: error: ZeroDivisionError: no; this is a bug"),
    ],
    ids=str,
)
def test_errors_are_one_line(error, status, text):
    @click.command("tool", cls=Tool)
    def tool() -> None:
        raise error

    result = CliRunner().invoke(tool, [])
    assert result.exit_code == status
    message = result.stderr.lstrip("\n")  # click ends the line that ^C is on
    assert message.startswith(text) and message.count("\n") == 1


def test_warnings_are_one_line():
    @click.command("tool", cls=Tool)
    def tool() -> int:
        warnings.warn("old\nfile", FormatWarning, stacklevel=1)
        return 3

    result = CliRunner().invoke(tool, [])
    assert (result.exit_code, result.stderr) == (3, "tool: warning: old\\nfile\n")


def test_plain_text():
    assert plain("salt \u03b8") == "salt \u03b8"
    assert plain(Path("a\nb")) == r"a\nb"


def installed(name, *arguments, **options):
    tool = Path(sys.executable).with_name(name)
    return subprocess.run([tool, *map(str, arguments)], capture_output=True, text=True, **options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tsdf-info", "tsdf-plot", "tsdf-validate"])
def test_installed_commands(name, tmp_path):
    """Each answers --help, and a missing file without a traceback."""
    helped = installed(name, "--help")
    assert helped.returncode == 0 and "Usage: " + name in helped.stdout
    options = ["--out", tmp_path / "a.png"] if name == "tsdf-plot" else []
    done = installed(name, tmp_path / "missing", *options)
    assert done.returncode == 1 and "Traceback" not in done.stderr + done.stdout


@pytest.mark.parametrize("module", ["info", "plot", "validate"])
def test_nothing_slow_is_imported_for_help(module):
    script = f"import sys, tsdf.cli.{module}; print([m for m in ('numpy', 'matplotlib', 'numba') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_closed_pipe_is_quiet():
    """The reader of standard output is gone before anything is written."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    tool = Path(sys.executable).with_name("tsdf-info")
    done = subprocess.run([tool, CUBE], stdout=write_end, stderr=subprocess.PIPE, text=True)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (1, "")
