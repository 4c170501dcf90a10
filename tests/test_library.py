"""Ready tables: what is shipped is valid, small and made again to the same bytes; a name does where a file does."""

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

import tsdf
from tsdf.cli.info import main as info
from tsdf.cli.render import main as render
from tsdf.data import library
from tsdf.errors import FormatError, SceneError
from tsdf.judge.validate import validate
from tsdf.reference_data import make_library
from tsdf.reference_data.make_checks import CHECKS
from tsdf.scene.ball import ball_of
from tsdf.scene.scene import load, parse

BALL = (Path(__file__).parent / "ball.toml").read_text()


def status(command, *words):
    with pytest.raises(SystemExit) as done:
        command([str(word) for word in words])
    return done.value.code


def test_all_are_there_and_small():
    assert library.names() == sorted(make_library.GRAINS) and len(library.names()) == 8
    assert sum(path.stat().st_size for path in library.FOLDER.iterdir()) < 3_000_000
    assert make_library.PAGE.read_text() == make_library.page()


@pytest.mark.parametrize("name", library.names())
def test_valid(name):
    """No error, no warning but of a few millionths of the light, CC0, with the records that levels draw from."""
    report = validate(name)
    assert report.ok and report.checks > 10
    assert {finding.code for finding in report.findings} <= {"STATISTICS_DROPPED"}
    table = tsdf.library(name)
    assert table.header["licence"] == "CC0-1.0" and table.memory and table.joint


@pytest.mark.slow
def test_made_again(tmp_path):
    """The exact sphere's file comes out the same to the byte."""
    tsdf.write(make_library.made("glass-beads"), tmp_path / "again.exr")
    kept = library.FOLDER / f"glass-beads{library.SUFFIX}"
    assert (tmp_path / "again.exr").read_bytes() == kept.read_bytes()


def test_a_file_of_that_name_wins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert tsdf.read("sugar").header["optics"]["material"] == "sucrose"
    scene = {**tomllib.loads(BALL)}
    scene["medium"][0]["grain"] = [{"table": "sugar"}]
    assert parse(scene, tmp_path).media[0].grains[0].table == library.FOLDER / "sugar.tsdf.exr"
    shutil.copy(CHECKS / "cube.tsdf.exr", "sugar")
    assert tsdf.read("sugar").header["optics"]["material"] is None
    assert parse(scene, tmp_path).media[0].grains[0].table == tmp_path / "sugar"
    assert tsdf.library("sugar").header["optics"]["material"] == "sucrose"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("suger", "suger: neither a file nor a ready table; did you mean sugar?"),
        ("Fresh-Snow", "did you mean fresh-snow?"),
        ("fresh_snow", "did you mean fresh-snow?"),
        ("xyzzy", "ready tables are coarse-snow, fresh-snow,"),
    ],
)
def test_unknown_names(name, message, capsys):
    for read in (tsdf.read, tsdf.library):
        with pytest.raises(FormatError) as error:
            read(name)
        assert message in str(error.value) and "\n" not in str(error.value)
    scene = ball_of(name)
    with pytest.raises(SceneError) as told:
        parse(scene)
    assert message in str(told.value)
    with pytest.raises(SceneError) as told:
        load(name)
    assert message in str(told.value) and "\n" not in str(told.value)
    assert not validate(name).ok
    assert status(info, name) == 1
    assert message in capsys.readouterr().err


def test_what_drawing_lengths_costs():
    """Lengths drawn uniformly in their cells against the means that tables state, as schema/SPEC.md says: how much
    longer in the mean, and how much more a grain absorbs; and the sampler does draw them so."""
    longer, darker = {}, {}
    for name in library.names():
        table = tsdf.library(name)
        masses = table.block("p_l").astype(np.float64) * table.p_theta / table.p_theta.sum()
        mean, (low, high) = (
            table.block("mean_l").astype(np.float64),
            (table.edges("p_l")[i:][:124, None] for i in (0, 1)),
        )
        stated = float((masses * mean).sum())
        longer[name] = float((masses * (low + high)).sum()) / 2.0 / stated - 1.0
        for x in (0.01, 0.1, 1.0):
            width = x * np.maximum(high - low, 1e-300)
            drawn = 1.0 - float((masses * np.exp(-x * low) * -np.expm1(-width) / width).sum())
            darker[name, x] = drawn / (1.0 - table.albedo(x) / table.albedo(0.0)) - 1.0
    assert {name for name, share in longer.items() if share > 0.003} == {"quartz", "sugar"}
    assert min(longer.values()) > 0.0001 and 0.006 < longer["sugar"] < 0.0075 and 0.023 < longer["quartz"] < 0.025
    assert max(darker.values()) < 0.004 and max(v for (_, x), v in darker.items() if x >= 0.1) < 0.002
    table = tsdf.library("sugar")
    drawn = tsdf.Sampler(table).sample(np.random.default_rng(0).random((250_000, 6))).path_length
    stated = table.header["statistics"]["mean_path_length"]
    assert abs(drawn.mean() / stated - 1.0 - longer["sugar"]) < 4.0 * drawn.std() / 500.0 / stated


@pytest.mark.slow
def test_first_picture(tmp_path, monkeypatch):
    """What docs/library.md shows, small: sugar is bright and beads, of which light comes out forwards, differ."""
    assert "tsdf-render sugar --out sugar.exr" in make_library.HEAD
    monkeypatch.chdir(tmp_path)
    assert status(render, "sugar", "--out", "sugar.exr", "--width", 16, "--spp", 4, "--quiet") == 0
    assert (tmp_path / "sugar.png").exists()
    picture = tsdf.render("sugar", width=16, spp=4)
    assert picture.rgb.shape == (12, 16, 3) and picture.rgb[6, 8].min() > 0.3
    other = tsdf.render("glass-beads", width=16, spp=4)
    assert not np.allclose(other.rgb, picture.rgb)
