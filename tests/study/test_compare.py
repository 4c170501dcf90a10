"""Error against time: the statistics on pictures whose truth is known, the reports on small real scenes."""

import csv
import io
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsdf
from tsdf.cli.compare import main
from tsdf.errors import UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render
from tsdf.picture.render import Picture
from tsdf.scene.scene import LEVELS, Camera, ConstantLight, GrainSpec, MediumSpec, Scene, Sphere, SurfaceSpec
from tsdf.study import compare, plots
from tsdf.study.compare import Difference, difference

SHAPE = (24, 32, 3)


def picture(rgb: np.ndarray, variance: np.ndarray) -> Picture:
    return Picture(rgb, variance, np.full(rgb.shape[:2], 16), 1000, 10, 0.5, 0, 0, False)


def drawn(
    rng: np.random.Generator, error: np.ndarray, noise: float, grains: float, whole: float
) -> tuple[Picture, list[Picture]]:
    """Return a picture with a model's error and four references whose packings differ by pixel and as a whole."""
    truth = 1.0 + 0.5 * np.linspace(0.0, 1.0, SHAPE[1])[None, :, None] * np.ones(SHAPE)

    def grey(sigma: float) -> np.ndarray:
        return sigma * np.repeat(rng.standard_normal((*SHAPE[:2], 1)), 3, axis=2)

    variance = np.full(SHAPE, noise**2)
    references = [
        picture(truth * (1.0 + whole * rng.standard_normal()) + grey(grains) + grey(noise), variance) for _ in range(4)
    ]
    return picture(truth + error + grey(noise), variance), references


@pytest.mark.parametrize("whole", [0.0, 0.01])
def test_squared_difference_has_no_bias_and_a_true_error(whole: float) -> None:
    """Over 300 repetitions the debiased square is the true one, and so is the mean, within 4 standard errors of the
    spread; the stated errors are that spread within 30 %, also where packings differ as a whole.

    Control: the plain mean squared difference, noise and all, is rejected.
    """
    rng = np.random.default_rng(5)
    error = 0.05 * rng.standard_normal((*SHAPE[:2], 1)) * np.ones(SHAPE)
    found, naive = [], []
    for _ in range(300):
        one, references = drawn(rng, error, 0.1, 0.1, whole)
        found.append(difference(one, references))
        naive.append(float(((one.rgb - np.mean([r.rgb for r in references], axis=0)) ** 2).mean()) / 1.25**2)

    def far(values: np.ndarray | list[float], truth: float) -> float:
        return abs(np.mean(values) - truth) / (np.std(values, ddof=1) / math.sqrt(len(values)))

    squares, means = np.array([d.square for d in found]), np.array([d.mean for d in found])
    true = float((error**2).mean()) / 1.25**2
    # the mean of the references, whose own noise scales everything, is within a per cent: second order
    assert far(squares, true) < 4.0
    assert far(means, float(error.mean()) / 1.25) < 4.0
    assert far(naive, true) > 40.0
    for stated, spread in (
        (np.sqrt(np.mean([d.square_error**2 for d in found])), squares.std()),
        (np.sqrt(np.mean([d.mean_error**2 for d in found])), means.std()),
    ):
        assert 0.7 < stated / spread < 1.3


def test_an_equal_picture_is_below_noise_and_a_wrong_one_is_seen() -> None:
    """Without a model error the square is zero within 4 of its errors, and below noise in most of 100 repetitions (a
    normal variable is above 2 in 2.3 %); an error as large as the noise, 8 of its errors here, is seen in all."""
    rng = np.random.default_rng(6)
    none, some = np.zeros(SHAPE), 0.1 * rng.standard_normal((*SHAPE[:2], 1)) * np.ones(SHAPE)
    same = [difference(*drawn(rng, none, 0.1, 0.0, 0.0)) for _ in range(100)]
    assert max(abs(d.square) / d.square_error for d in same) < 4.5
    assert sum(d.seen for d in same) <= 10
    assert min(d.square for d in same) < 0.0
    assert all(difference(*drawn(rng, some, 0.1, 0.0, 0.0)).seen for _ in range(100))


def test_rmse_and_bar() -> None:
    seen, unseen = Difference(0.0, 0.1, 0.04, 0.01), Difference(0.0, 0.1, -0.01, 0.02)
    assert seen.seen and seen.rmse == pytest.approx(0.2)
    assert seen.bar == (pytest.approx(math.sqrt(0.03)), pytest.approx(math.sqrt(0.05)))
    assert not unseen.seen and unseen.rmse == pytest.approx(0.2) and unseen.bar == (0.0, unseen.rmse)


def test_a_picture_of_one_pixel_has_its_error_from_the_references() -> None:
    rng = np.random.default_rng(7)
    ones = [picture(1.0 + 0.1 * rng.standard_normal((1, 1, 3)), np.full((1, 1, 3), 0.01)) for _ in range(4)]
    assert 0.0 < difference(ones[0], ones[1:]).square_error < 1.0
    assert difference(ones[0], ones[1:3]).square_error == math.inf
    assert not difference(ones[0], ones[1:3]).seen


def test_pictures_that_cannot_be_compared() -> None:
    a, b = picture(np.ones(SHAPE), np.zeros(SHAPE)), picture(np.ones((2, 2, 3)), np.zeros((2, 2, 3)))
    black = picture(np.zeros(SHAPE), np.zeros(SHAPE))
    for references, word in (([a], "two"), ([a, b], "sizes"), ([black, black], "black")):
        with pytest.raises(UsageError, match=word):
            difference(a, references)


# ------------------------------------------------------------------------------------------- real scenes


@pytest.fixture(scope="module")
def ball() -> Scene:
    """A ball of 200 grains, white light above it and a black plate below."""
    table = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64, joint=8, memory=16))
    medium = MediumSpec(Sphere((0.0, 0.0, 0.0), 8.0), 0.4, 1.0, (GrainSpec(table),), packing_spheres=200)
    plate = SurfaceSpec(Sphere((0.0, 0.0, -29.0), 20.0), (0.0, 0.0, 0.0))
    camera = Camera((0.0, -40.0, 10.0), (0.0, 0.0, 0.0), 12, 9, fov_deg=30.0)
    return Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), (plate,), name="ball")


def without_joint(scene: Scene) -> Scene:
    table = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64))
    return replace(scene, media=(replace(scene.media[0], grains=(GrainSpec(table),)),))


def test_every_level_has_a_row(ball: Scene) -> None:
    """All levels, explicit first; reports hold what the rows do; a chain that forgets where light left the last grain
    and fills the ball to its brim differs in the mean from single grains, far more than by the noise of both."""
    names: list[str] = []
    found = compare.compare(ball, spp=24, packings=3, seed=4, done=lambda name, *_: names.append(name))
    assert [row.level for row in found.rows] == list(LEVELS)
    assert sorted(names) == sorted([*LEVELS, "reference"])
    assert not found.interrupted and found.pictures == 3
    assert found.rows[0].samples == 3 * 24 * 12 * 9
    assert found.speed_up(found.rows[0]) == 1.0
    for row in found.rows:
        assert row.difference is not None
        assert row.variance_time == pytest.approx(row.picture.relative_error**2 * row.picture.seconds)
    packed = found.rows[1]  # of packings of its own: no error is seen, for what they differ by is in its noise
    assert packed.samples == found.rows[0].samples and packed.difference is not None
    assert abs(packed.difference.square) < 4.0 * packed.difference.square_error
    forgetful = found.rows[list(LEVELS).index("teleport-joint")].difference
    assert forgetful is not None and abs(forgetful.mean) > 4.0 * forgetful.mean_error
    assert abs(packed.difference.mean) < 4.0 * packed.difference.mean_error
    lines = list(csv.DictReader(io.StringIO(compare.csv_text(found))))
    assert [line["level"] for line in lines] == list(LEVELS)
    assert float(lines[1]["mean"]) == found.rows[1].mean
    text = compare.markdown(found)
    assert "mean of 3 packings" in text
    assert sum(line.startswith(f"| {level} |") for line in text.splitlines() for level in LEVELS) == len(LEVELS)


def test_pictures_share_no_random_numbers(ball: Scene) -> None:
    """The level that is its own reference, with new random numbers, differs by nothing within 4 standard errors; with
    the same numbers, the control, far too little: its noise is in both and still taken off."""
    from tsdf.picture.world import build

    seeds = [compare._seed(3, level, k) for level in LEVELS for k in range(compare.MOST_PACKINGS)]
    assert len(set(seeds)) == len(seeds)
    world = build(ball, "volume")
    references = [render.render(world, spp=64, seed=k) for k in range(4)]
    d = difference(render.render(world, spp=64, seed=9), references)
    assert abs(d.square) < 4.0 * d.square_error
    assert abs(d.mean) < 4.0 * d.mean_error
    copy = difference(references[0], references[:2])
    assert copy.square < -4.0 * copy.square_error


def test_impossible_levels_are_said(ball: Scene) -> None:
    """A packing too dense to make has the best other level as reference; a level that cannot be is skipped."""
    tight = without_joint(replace(ball, media=(replace(ball.media[0], packing_fraction=0.72),)))
    found = compare.compare(tight, ["teleport", "teleport-joint", "volume"], spp=4, packings=2)
    assert found.reference == "teleport"
    assert [row.level for row in found.rows] == ["teleport", "volume"]
    text = compare.markdown(found)
    assert "explicit cannot be the reference: " in text and "teleport-joint cannot be the reference: " in text
    assert "speed-up over teleport |" in text
    loose = compare.compare(without_joint(ball), ["teleport-joint"], spp=4, packings=2)
    assert [row.level for row in loose.rows] == ["explicit"]
    assert any(note.startswith("teleport-joint is skipped: ") for note in loose.notes)


def test_explicit_grains_are_for_the_levels_that_take_them(ball: Scene) -> None:
    """A chain is another one where a scene asks for them, a volume the same as without, and the report says so."""
    asks = replace(ball, render=replace(ball.render, explicit_grains=1000))
    one, other = (compare.compare(s, ["teleport", "volume"], spp=4, packings=2) for s in (asks, ball))
    chains = [found.rows[1].picture.rgb for found in (one, other)]
    assert [row.level for row in one.rows] == ["explicit", "teleport", "volume"]
    assert not np.array_equal(*chains)
    assert np.array_equal(one.rows[2].picture.rgb, other.rows[2].picture.rgb)
    assert any("first 1000 grains" in note for note in one.notes)
    assert not any("grains as" in note for note in other.notes)


def test_a_furnace_has_no_error_and_no_noise(ball: Scene) -> None:
    """Lossless grains in light of radiance 1 are 1 at every level, and reports of no noise at all are written."""
    found = compare.compare(replace(ball, surfaces=()), ["volume"], spp=4, packings=2)
    for row in found.rows:
        assert row.difference is not None
        assert abs(row.mean - 1.0) < 1e-12
    assert "nan" not in compare.markdown(found)
    plots.plot_levels(compare.facts(found), found.reference, "furnace")


@pytest.mark.parametrize(("calls", "rows"), [(1, 0), (9, 1), (10_000, 4)])
def test_interruption_keeps_what_is_done(ball: Scene, calls: int, rows: int) -> None:
    """Ctrl-C before the first picture, in the second level, and never: the rows so far, and reports of them."""
    count = 0

    def progress(share: float, word: str) -> None:
        nonlocal count
        count += 1
        if count == calls or (calls == 9 and word.startswith("teleport,")):
            raise KeyboardInterrupt

    levels = ["teleport", "volume", "isotropic"]
    found = compare.compare(ball, levels, spp=8, packings=2, threads=1, progress=progress)
    assert len(found.rows) == rows
    assert found.interrupted == (rows < 4)
    assert ("Interrupted" in compare.markdown(found)) == found.interrupted
    compare.csv_text(found)


def test_seconds_become_samples(ball: Scene) -> None:
    """A time asked of a level gives all pixels as many samples, two at least, by trials."""
    found = compare.compare(ball, ["volume"], seconds=0.5, reference_seconds=1.0, packings=2, threads=1)
    assert all(row.picture.samples.min() == row.picture.samples.max() >= 2 for row in found.rows)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"levels": ["teleprot"]}, "no level"),
        ({"spp": 4, "seconds": 1.0}, "give one"),
        ({"packings": 1}, "packings"),
        ({"seconds": math.nan}, "finite"),
        ({"spp": 0}, "above 0"),
    ],
)
def test_requests_that_cannot_be_meant(ball: Scene, given: dict[str, Any], word: str) -> None:
    with pytest.raises(UsageError, match=word):
        compare.compare(ball, **given)


SCENE = """
[camera]
position = [0.0, -40.0, 10.0]
target = [0.0, 0.0, 0.0]
width = 24
height = 18
[[light]]
type = "constant"
radiance = 1.0
[[medium]]
shape = {type = "sphere", centre = [0, 0, 0], radius = 8.0}
packing_fraction = 0.4
radius = 1.0
packing_spheres = 200
[[medium.grain]]
table = "sphere.tsdf.exr"
absorption = 0.01
"""


def status(*words: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(list(words))
    return int(str(caught.value.code))


def test_command_writes_the_reports_and_the_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64, joint=8, memory=16))
    tsdf.write(table, tmp_path / "sphere.tsdf.exr")
    (tmp_path / "scene.toml").write_text(SCENE)
    out = tmp_path / "new" / "out"
    words = [os.fspath(tmp_path / "scene.toml"), "--out", os.fspath(out), "--spp", "4", "--packings", "2"]
    assert status(*words, "--levels", "teleport,volume", "--width", "12") == 0
    made = {"explicit", "reference", "teleport", "volume"}
    pictures = {f"{name}{suffix}" for name in made for suffix in (".exr", ".png")}
    assert {p.name for p in out.iterdir()} == pictures | {"levels.md", "levels.csv", "levels.png"}
    assert capsys.readouterr().out == (out / "levels.md").read_text()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["scene.toml", "--out", "o", "--levels", "teleprot"], 2, "did you mean teleport"),
        (["scene.toml", "--out", "o", "--spp", "0"], 2, "--spp"),
        (["scene.toml", "--out", "o", "--spp", "1", "--seconds", "1"], 2, "give one"),
        (["scene.toml", "--out", "o", "--packings", "1"], 2, "packings"),
        (["nothing.toml", "--out", "o"], 1, "nothing.toml"),
        (["scene.toml", "--out", "scene.toml"], 1, "give a folder"),
        (["scene.toml", "--out", "o"], 1, "sphere.tsdf.exr"),
        (["scene.toml"], 2, "--out"),
    ],
)
def test_bad_requests_are_one_line(
    words: list[str], code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    if said != "sphere.tsdf.exr":
        (tmp_path / "sphere.tsdf.exr").write_bytes(b"")
    assert status(*words, "--quiet") == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error
