"""``tsdf-render`` as a user meets it: what it writes, when it stops, what it refuses, and what Ctrl-C leaves."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from click.testing import CliRunner, Result

from tsdf.cli import common
from tsdf.cli.render import fireflies, main
from tsdf.errors import TSDFError
from tsdf.picture import image
from tsdf.picture.render import Picture
from tsdf.plan import shot
from tsdf.reference_data.make_checks import CHECKS

WIDTH, HEIGHT = 12, 8
SCENE = (Path(__file__).parents[1] / "ball.toml").read_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of absorbing grains before a bright sky."""
    folder = tmp_path_factory.mktemp("render")
    shutil.copy(CHECKS / "cube.tsdf.exr", folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder


def run(folder: Path, *words: object, out: str = "p.exr") -> Result:
    words = (folder / "scene.toml", "--out", folder / out, *words)
    return CliRunner().invoke(main, [str(word) for word in words], prog_name="tsdf-render")


def facts(path: Path) -> dict:
    return json.loads(image.read_exr(path).attributes["tsdf_render"])


@pytest.mark.slow
def test_an_error_bar_that_cannot_be_trusted(folder: Path) -> None:
    """Beads under a small sun that level explicit cannot aim at: one line, also when quiet, and in the file; the same
    under a bright sky are trusted, and nothing is said."""
    shutil.copy(CHECKS / "sphere.tsdf.exr", folder)
    beads = SCENE.replace("cube", "sphere").replace("absorption = [2.0, 2.0, 4.0]\n", "")
    (folder / "trusted.toml").write_text(beads)
    (folder / "doubted.toml").write_text(
        beads.replace('type = "constant"\nradiance', 'type = "sun"\ndirection = [0.3, -0.6, 0.7]\nirradiance')
    )
    words = ("--level", "explicit", "--quiet", "--spp", "4")
    for name, trusted in (("trusted", True), ("doubted", False)):
        out = folder / f"{name}.exr"
        result = CliRunner().invoke(main, [str(folder / f"{name}.toml"), "--out", str(out), *words])
        assert (result.exit_code, result.stdout) == (0, "")
        warned = result.stderr.startswith("warning: the error of the picture cannot be trusted: suns")
        assert warned == (not trusted) and result.stderr.count("\n") == int(warned)
        said = facts(out)
        assert said["trusted"] is trusted and (said["met_by_chance"] is None) == trusted
        assert {"vov", "slope", "unsure_pixels"} <= set(said)


def test_what_is_written(folder: Path) -> None:
    """The picture and its variance, how it was made, and the same developed beside it."""
    result = run(folder)
    assert (result.exit_code, result.stderr) == (0, "")
    picture = image.read_exr(folder / "p.exr")
    assert picture.rgb.shape == picture.variance.shape == (HEIGHT, WIDTH, 3)
    assert (picture.variance >= 0.0).all() and np.isfinite(picture.variance).all()
    assert np.allclose(picture.rgb[0, 0], (1.0, 0.5, 0.25))  # the sky beside the ball, without noise
    assert (picture.rgb[HEIGHT // 2, WIDTH // 2] < (0.9, 0.45, 0.225)).all()
    said = facts(folder / "p.exr")
    assert said == said | {"level": "teleport", "samples": [3, 3], "seed": 5, "truncated": 0, "faults": 0}
    assert said["scene"].endswith("scene.toml") and said["events"] > 0 and said["software"].startswith("tsdf")
    with PIL.Image.open(folder / "p.png") as png:
        assert (png.size, png.mode) == ((WIDTH, HEIGHT), "RGB")
        levels = np.asarray(png, float)
    linear = np.clip(picture.rgb / 2.0, 0.0, 1.0)  # one stop darker
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    assert np.abs(levels - 255.0 * srgb).max() <= 0.51
    line = r"p\.exr: holds 3 samples per pixel, level teleport, relative error \S+, \S+ s, \S+ grain events per second"
    assert re.search(line, result.stdout)
    quiet = run(folder, "--quiet", out="q.exr")
    assert (quiet.exit_code, quiet.output) == (0, "")
    assert (folder / "q.exr").read_bytes() == (folder / "p.exr").read_bytes()
    assert (folder / "q.png").read_bytes() == (folder / "p.png").read_bytes()


def test_the_same_for_any_number_of_threads(folder: Path) -> None:
    for threads in (1, 3):
        assert run(folder, "--threads", threads, "--seed", 7, out=f"{threads}.exr").exit_code == 0
    assert (folder / "1.exr").read_bytes() == (folder / "3.exr").read_bytes()
    run(folder, "--threads", 1, "--seed", 8, out="other.exr")
    assert not np.array_equal(image.read_exr(folder / "1.exr").rgb, image.read_exr(folder / "other.exr").rgb)


def test_options(folder: Path) -> None:
    assert run(folder, "--width", 6, "--level", "isotropic", "--spp", 2, "--seed", 9, out="O.EXR").exit_code == 0
    said = facts(folder / "O.EXR")
    assert (said["level"], said["samples"], said["seed"]) == ("isotropic", [2, 2], 9)
    assert image.read_exr(folder / "O.EXR").rgb.shape == (4, 6, 3) and (folder / "O.png").is_file()


def test_few_samples_are_not_trusted(folder: Path) -> None:
    """One line, also when quiet, and in the file."""
    for spp in (1, 2):
        result = run(folder, "--width", 6, "--level", "isotropic", "--spp", spp, "--quiet")
        assert (result.exit_code, result.stdout) == (0, "") and result.stderr.count("\n") == 1
        assert result.stderr.startswith("warning: the error of the picture cannot be trusted: too few samples to say")
        said = facts(folder / "p.exr")
        assert said["trusted"] is False and said["vov"] is None and said["unsure_pixels"] > 0.0 and "slope" in said


def test_warnings_are_said_quietly_too(folder: Path) -> None:
    """An environment that was mended, and a medium in which no grain fits: not what was asked for. Notes are not."""
    pixels = np.full((4, 8, 3), 0.25)
    pixels[1, 4, 0] = np.nan
    image.write_exr(folder / "sky.exr", pixels)
    lit = SCENE.replace('type = "constant"\nradiance = [1.0, 0.5, 0.25]', 'type = "environment"\nfile = "sky.exr"')
    assert lit != SCENE
    (folder / "lit.toml").write_text(lit)
    (folder / "large.toml").write_text(SCENE.replace("radius = 0.05", "radius = 3.0"))
    for name, words, said in (
        ("lit", ("--level", "isotropic"), "sky.exr: 1 pixel is not a number: taken as 0"),
        ("large", ("--level", "teleport"), "does not fit into the medium"),
    ):
        arguments = [str(folder / f"{name}.toml"), "--out", str(folder / "w.exr"), "--spp", "16", "--quiet", *words]
        result = CliRunner().invoke(main, arguments)
        assert (result.exit_code, result.stdout) == (0, "") and said in result.stderr, result.output
        assert all(line.startswith("warning: ") for line in result.stderr.splitlines())
    image.write_exr(folder / "sky.exr", np.full((4, 5, 3), 0.25))  # no panorama: a note
    arguments = [str(folder / "lit.toml"), "--out", str(folder / "w.exr"), "--spp", "16", "--level", "isotropic"]
    assert CliRunner().invoke(main, [*arguments, "--quiet"]).stderr == ""
    assert "note: " in CliRunner().invoke(main, arguments).stderr


@pytest.mark.slow
def test_explicit_grains(folder: Path) -> None:
    """Asked for by the command or the scene, and what was made says so; 0 is a picture without."""
    assert run(folder, "--explicit-grains", 2, out="k.exr").exit_code == 0
    assert facts(folder / "k.exr")["explicit_grains"] == 2
    (folder / "asks.toml").write_text(SCENE.replace("[render]", "[render]\nexplicit_grains = 2"))
    result = CliRunner().invoke(main, [str(folder / "asks.toml"), "--out", str(folder / "asks.exr")])
    assert result.exit_code == 0 and "level teleport after 2 explicit grains" in result.stdout
    asked, given = (image.read_exr(folder / name).rgb for name in ("asks.exr", "k.exr"))
    assert np.array_equal(asked, given)
    none = CliRunner().invoke(
        main, [str(folder / "asks.toml"), "--out", str(folder / "none.exr"), "--explicit-grains", "0"]
    )
    assert none.exit_code == 0 and "explicit_grains" not in facts(folder / "none.exr")
    run(folder, out="plain.exr")
    assert np.array_equal(image.read_exr(folder / "none.exr").rgb, image.read_exr(folder / "plain.exr").rgb)
    assert not np.array_equal(asked, image.read_exr(folder / "plain.exr").rgb)


def test_stops(folder: Path) -> None:
    """By the clock, or once the error is small enough: then it is, and was not with a quarter of the samples."""
    begun = time.monotonic()
    assert run(folder, "--seconds", 0.3, out="s.exr").exit_code == 0
    assert time.monotonic() - begun > 0.2 and facts(folder / "s.exr")["samples"][0] >= 1
    result = run(folder, "--target-error", 0.05, out="e.exr")
    assert result.exit_code == 0
    picture = image.read_exr(folder / "e.exr")
    assert np.sqrt(picture.variance.mean()) / picture.rgb.mean() <= 0.05
    low, high = facts(folder / "e.exr")["samples"]
    assert low == high > 3


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--spp", "0"], 2, "--spp"),
        (["--width", "0"], 2, "--width"),
        (["--width", "100000"], 2, "width"),
        (["--threads", "0"], 2, "--threads"),
        (["--threads", "100000"], 2, "--threads"),
        (["--seed", "-1"], 2, "--seed"),
        (["--seed", str(2**63)], 2, "--seed"),
        (["--seconds", "0"], 2, "--seconds"),
        (["--seconds", "nan"], 2, "--seconds"),
        (["--target-error", "inf"], 2, "--target-error"),
        (["--leap", "0.5"], 2, "must be 0 or a finite number of at least 1, not 0.5; leaps that short are biased"),
        (["--leap", "nan"], 2, "--leap must be"),
        (["--leap", "2", "--level", "explicit"], 2, "level explicit cannot leap"),
        (["--spp", "1", "--seconds", "1"], 2, "give one"),
        (["--explicit-grains", "-1"], 2, "--explicit-grains"),
        (["--explicit-grains", "2.5"], 2, "--explicit-grains"),
        (["--explicit-grains", "5", "--level", "volume"], 1, "explicit_grains = 5"),
        (["--explicit-grains", "5", "--level", "explicit"], 1, "take teleport-memory"),
        (["--level", "teleprot"], 2, "--level"),
        (["--level", "teleport-memory"], 1, "--memory"),
        (["--out", "a.png"], 2, ".exr"),
        (["--out", "/no/such/folder/a.exr"], 1, "not a folder"),
        (["--out", ""], 2, ".exr"),
    ],
)
def test_bad_requests(words: list[str], status: int, said: str, folder: Path, tmp_path: Path) -> None:
    result = run(folder, *words, out=str(tmp_path / "x.exr"))
    assert result.exit_code == status and result.stdout == "" and result.stderr.count("\n") == 1, result.output
    assert result.stderr.startswith("tsdf-render: error: ") and said in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_bad_scenes(folder: Path, tmp_path: Path) -> None:
    for name, text, said in (
        ("a", "[camera", "not TOML"),
        ("b", SCENE.replace("cube.tsdf.exr", "none.exr"), "none.exr"),
        ("c", SCENE.replace("cube.tsdf.exr", "scene.toml"), "scene.toml"),
    ):
        (folder / f"{name}.toml").write_text(text)
        result = CliRunner().invoke(main, [str(folder / f"{name}.toml"), "--out", str(tmp_path / "x.exr")])
        assert result.exit_code == 1 and result.stderr.count("\n") == 1 and said in result.stderr, result.output
    assert list(tmp_path.iterdir()) == []


def test_a_picture_stays_until_there_is_a_whole_new_one(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(folder, out="kept.exr")
    before = {name: (folder / name).read_bytes() for name in ("kept.exr", "kept.png")}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("tsdf.files.os.replace", full)
        result = run(folder, "--seed", 1, out="kept.exr")
    assert result.exit_code == 1 and "No space left" in result.stderr
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert not list(folder.glob(".*"))


# --- interrupts and progress --------------------------------------------------------


@pytest.fixture
def begin(launch: Callable[..., subprocess.Popen], folder: Path) -> Callable[..., subprocess.Popen]:
    """Start to render without end, with a line of progress whenever there is any."""
    code = "import tsdf.cli.common as c; c.EVERY_S = c.LEAST_S = 0.0; from tsdf.cli.render import main; main()"
    command = [sys.executable, "-c", code, folder / "scene.toml", "--spp", 10**8, "--threads", 1, "--out"]
    return lambda *words: launch([str(word) for word in (*command, *words)], stdout=-1, stderr=-1, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "times"), [(signal.SIGINT, 1), (signal.SIGTERM, 2)])
def test_an_interrupt_writes_the_picture_so_far(
    number: int, times: int, begin: Callable[..., subprocess.Popen], tmp_path: Path
) -> None:
    """One signal or two at once, as `timeout` sends them: the picture, its PNG, its summary, 128 + the signal."""
    out = tmp_path / "i.exr"
    process = begin(out)
    for line in process.stderr:
        if re.match(r"\d+ %, [1-9]\d* spp ", line):
            break
    for _ in range(times):
        process.send_signal(number)
    said, rest = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    first, medium = said.splitlines()
    assert "interrupted: holds" in first and medium.startswith("[[medium]]") and "error:" not in rest
    low, high = facts(out)["samples"]
    assert high >= max(low, 1) and np.isfinite(image.read_exr(out).rgb).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["i.exr", "i.png"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_before_anything_ends_at_once(
    number: int, begin: Callable[..., subprocess.Popen], tmp_path: Path
) -> None:
    process = begin(tmp_path / "i.exr", "--quiet")
    while not int(re.search("SigCgt:\t(.*)", Path(f"/proc/{process.pid}/status").read_text())[1], 16) >> 14 & 1:
        time.sleep(0.001)  # until SIGTERM is caught
    process.send_signal(number)
    said, rest = process.communicate(timeout=30)  # 10^8 samples of each pixel take days
    assert process.returncode == 128 + number
    assert said == "" and rest.count("\n") == 1 and rest.startswith("tsdf-render: error: interrupted")
    assert list(tmp_path.iterdir()) == []


def test_getting_ready_leaves_nothing_to_keep(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However far the records for leaps are: an interrupt then ends at once, and not after a minute of compiling."""
    works: list[common.Work] = []

    class Known(common.Work):
        def __init__(self, progress: common.Progress) -> None:
            super().__init__(progress)
            works.append(self)

    def build(*_: object, progress: Callable[[float, str], None], **__: object) -> None:
        progress(0.9, "records for leaps")
        raise TSDFError(f"an interrupt means: {works[0].meaning()}")

    monkeypatch.setattr(common, "Work", Known)
    monkeypatch.setattr(shot, "build", build)
    assert run(folder).stderr.endswith("an interrupt means: nothing is written\n")


def test_progress(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A line a minute where there is no terminal; a kernel that is compiled is said to be."""
    clock = [0.0]
    monkeypatch.setattr(common.time, "monotonic", lambda: clock[0])
    progress = common.Progress()
    for second in range(200):
        clock[0] = float(second)
        progress(second / 200.0, f"{second} spp")
    assert capsys.readouterr().err == "30 %, 60 spp [1:00]\n60 %, 120 spp [2:00]\n90 %, 180 spp [3:00]\n"
    monkeypatch.setattr("tsdf.compiled.compiling", lambda: True)
    clock[0] = 260.0
    progress.show()
    assert capsys.readouterr().err == "100 %, compiling, once for this machine [4:20]\n"
    quiet = common.Progress(quiet=True)
    clock[0] = 1000.0
    quiet(0.5, "word")
    quiet.note("note")
    assert capsys.readouterr().err == ""


def test_a_reader_who_is_gone_costs_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error is a pipe that nobody reads any more."""

    def gone(*_: object, **__: object) -> None:
        raise BrokenPipeError

    for name in ("EVERY_S", "LEAST_S"):
        monkeypatch.setattr(common, name, 0.0)
    progress = common.Progress()
    with monkeypatch.context() as patch:
        patch.setattr(common.click, "echo", gone)
        progress(0.5, "word")
        progress.note("note")


@pytest.mark.slow
def test_level_auto(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene without a level is planned: what is taken, why, and what names it is said once, and is in the file; the
    options that are named make the same picture. With a level nothing is planned."""
    from tsdf.plan import planner

    monkeypatch.setattr(planner, "SECONDS", 1.0)
    monkeypatch.setattr(planner, "LEAST_PILOTS", 0.5)
    (folder / "auto.toml").write_text(SCENE.replace('level = "teleport"\n', ""))
    words = [str(folder / "auto.toml"), "--out", str(folder / "a.exr")]
    result = CliRunner().invoke(main, words, prog_name="tsdf-render")
    assert result.exit_code == 0, result.stderr
    lines = result.stderr.splitlines()
    (at,) = (n for n, line in enumerate(lines) if line.startswith("note: level auto: take "))
    again = re.fullmatch(
        r"note: to have the same again without planning: (--level \S+( --explicit-grains \S+)?)", lines[at + 1]
    )
    assert again is not None
    said = facts(folder / "a.exr")
    assert said["chosen"]["level"] == said["level"] and said["samples"] == [3, 3] and said["chosen"]["target"] == 0.02
    monkeypatch.setattr(planner, "plan", lambda *_: pytest.fail("a plan is made"))
    monkeypatch.setattr("tsdf.plan.shot.plan", lambda *_: pytest.fail("a plan is made"))
    same = CliRunner().invoke(main, [*words[:2], str(folder / "b.exr"), *again[1].split(), "--quiet"])
    assert same.exit_code == 0 and "level auto" not in same.stderr
    np.testing.assert_array_equal(image.read_exr(folder / "b.exr").rgb, image.read_exr(folder / "a.exr").rgb)
    assert "chosen" not in facts(folder / "b.exr")


@pytest.mark.slow
def test_fewer_far(folder: Path) -> None:
    """K-0 is what a scene says with fewer_far = true, and not what K is."""
    assert run(folder, "--explicit-grains", "3-0", out="f.exr").exit_code == 0
    assert facts(folder / "f.exr")["fewer_far"] is True and facts(folder / "f.exr")["explicit_grains"] == 3
    (folder / "far.toml").write_text(SCENE.replace("[render]", "[render]\nexplicit_grains = 3\nfewer_far = true"))
    asked = CliRunner().invoke(main, [str(folder / "far.toml"), "--out", str(folder / "g.exr"), "--quiet"])
    assert asked.exit_code == 0
    np.testing.assert_array_equal(image.read_exr(folder / "f.exr").rgb, image.read_exr(folder / "g.exr").rgb)


def dotted(dots: int, lit: int = 2000, noise: float = 0.02) -> Picture:
    """A picture of `lit` pixels of radiance 1 on black, some of which are far noisier."""
    rgb, variance = np.zeros((100, 100, 3)), np.zeros((100, 100, 3))
    rgb.reshape(-1, 3)[:lit], variance.reshape(-1, 3)[:lit] = 1.0, noise**2
    variance.reshape(-1, 3)[:dots] = 400.0
    return Picture(rgb, variance, np.full((100, 100), 16), 1, 1, 1.0, 0, 0, False)


def test_bright_dots_are_told_from_noise() -> None:
    """Not even noise is taken for them, nor a small thing on black, nor a few pixels."""
    assert "1 % of the lit pixels make 100 % of it, half of them are off by less than 0.02" in str(
        fireflies(dotted(10))
    )
    assert fireflies(dotted(0, noise=3.0)) is None
    assert fireflies(dotted(0, lit=80, noise=3.0)) is None
    assert fireflies(dotted(1, lit=80)) is None
    assert fireflies(dotted(200)) is None
