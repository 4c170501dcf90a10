"""Frontier: the statistics on scenes whose truth is known, results that are read again, the command."""

import csv
import io
import json
import math
import os
import re
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import stdtr

from tsdf.cli.frontier import main
from tsdf.data import format as tsdf_format
from tsdf.data import library
from tsdf.data.table import Table
from tsdf.errors import TSDFError, UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render
from tsdf.picture.render import Picture
from tsdf.picture.world import build
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import (
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Scene,
    Sphere,
    SunLight,
    SurfaceSpec,
    load,
)
from tsdf.study import frontier, frontier_files, frontier_plots
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.study.frontier import Frontier, Measured, square
from tsdf.study.ranking import mean_of
from tsdf.walk.explicit import built_in

SIGMAS = 4.5
RUNS, FEW = 8, 3
ALL = candidates(("explicit", "teleport-memory", "teleport-joint", "teleport", "volume", "isotropic"), (0, 2))


@pytest.fixture(scope="module")
def table() -> Table:
    return exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64, joint=8, memory=16))


@pytest.fixture(scope="module")
def ball(table: Table) -> Scene:
    """A ball of some hundred grains, white light above it and a black plate below."""
    medium = MediumSpec(Sphere((0.0, 0.0, 0.0), 8.0), 0.4, 1.0, (GrainSpec(table),), packing_spheres=200)
    plate = SurfaceSpec(Sphere((0.0, 0.0, -29.0), 20.0), (0.0, 0.0, 0.0))
    camera = Camera((0.0, -40.0, 10.0), (0.0, 0.0, 0.0), 12, 9, fov_deg=30.0)
    return Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), (plate,), name="ball")


def measured(ball: Scene, samples: int, runs: int) -> Frontier:
    """All levels, with and without explicit grains first, in runs of so many samples, whatever time they take."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(frontier, "_affordable", lambda *_: samples)
        made = frontier.measure(ball, ALL, runs=runs, seed=4, threads=1)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def found(ball: Scene) -> Frontier:
    """A short one, to be written and drawn."""
    return measured(ball, 32, FEW)


@pytest.fixture(scope="module")
def known(ball: Scene) -> Frontier:
    """One from which to judge."""
    return measured(ball, 192, RUNS)


def chance(values: Any) -> float:
    """Return how likely the mean of independent numbers is so far from zero if they are of zero mean (t test)."""
    value, error = mean_of(values)
    return 2.0 * float(stdtr(len(values) - 1, -abs(value) / max(error, 1e-300)))


def of(found: Frontier, name: str) -> Measured:
    return next(row for row in found.rows if str(row.candidate) == name)


@pytest.mark.slow
def test_squares_have_no_bias(ball: Scene) -> None:
    """Level volume against itself, twelve times with four samples: the squared difference less the noise is zero within
    4.5 standard errors of the spread, also with the noise of one alone taken off, when that of the other is left.

    Control: with the noise in, and with the same random numbers in both, it is far from zero.
    """
    world = build(ball, "volume")
    pictures = [render.render(world, spp=4, seed=k) for k in range(24)]
    pairs = list(zip(pictures[::2], pictures[1::2], strict=True))
    both = mean_of([square(a, b, True, 1.0) for a, b in pairs])
    assert abs(both.value) < SIGMAS * both.error
    one = mean_of([square(a, b, False, 1.0) - float(a.variance.mean()) for a, b in pairs])
    assert one == pytest.approx(both)
    naive = mean_of([float(((a.rgb - b.rgb) ** 2).mean()) for a, b in pairs])
    assert naive.value > 2.0 * SIGMAS * naive.error
    same = mean_of([square(a, a, True, 1.0) for a, _ in pairs])
    assert same.value < -2.0 * SIGMAS * same.error


@pytest.mark.slow
def test_all_candidates_are_measured(known: Frontier) -> None:
    """Each has its row, best level first, eight runs, and the times at which its samples double."""
    assert [row.candidate for row in known.rows] == list(ALL)
    assert known.truth == "explicit" and known.runs == known.asked == RUNS
    for row in known.rows:
        assert len(row.seconds) == len(row.noise) == len(row.squares) == len(row.flip) == RUNS
        assert set(row.bias) == set(known.regions)
        times = [spent for spent, _ in row.curve]
        assert len(times) == 5 and times == sorted(times) and times[-1] == pytest.approx(np.mean(row.seconds))
        assert row.seconds_per_sample * row.samples * row.pixels == pytest.approx(np.mean(row.seconds))
        if not known.exact(row):
            assert mean_of(row.curve[0][1]).value > mean_of(row.curve[-1][1]).value


@pytest.mark.slow
def test_what_is_known_of_levels_is_found(known: Frontier) -> None:
    """The truth's own level, measured as all others, differs by nothing: the control. Every chain without explicit
    grains has the texture of single grains missing; the chain that forgets where light left the last grain, and fills
    the ball to its brim, is too bright or too dark by far; two explicit grains leave less to miss."""
    control = of(known, "explicit")
    assert chance(control.squares) > 1e-4 and chance(control.bias["whole"]) > 1e-4
    assert not control.floor.seen or control.floor.value < 0.3 * of(known, "volume").floor.value
    assert known.floor(control).value == 0.0
    for name in ("teleport-memory", "teleport-joint", "teleport", "volume"):
        assert of(known, name).floor.seen
        assert of(known, name).texture_square.value > 4.0 * of(known, name).texture_square.error
    assert chance(of(known, "teleport-joint").bias["whole"]) < 1e-3
    fewer = np.array(of(known, "teleport-memory").squares) - of(known, "teleport-memory k=2").squares
    assert fewer.mean() > 0.0 and chance(fewer) < 1e-2


@pytest.mark.slow
def test_floor_and_noise_make_the_curve(known: Frontier) -> None:
    """The error of the runs at each number of samples is floor squared and noise squared, as far as the spread of their
    difference can tell: noise is what the samples of all of a run say, over their number. Control: without the noise it
    is not, at the fewest samples."""
    for row in known.rows:
        for step, (_, squares) in enumerate(row.curve):
            times = 2.0 ** (len(row.curve) - 1 - step)
            assert chance(np.array(squares) - row.squares - np.array(row.noise) * times) > 1e-4, (row.candidate, step)
        assert chance(np.array(row.curve[0][1]) - row.squares) < 1e-3


def test_noise_and_bias_are_taken_apart(ball: Scene) -> None:
    """Pictures made by hand: a bias of 10 % in the left half alone and a pattern of 20 % in the whole; both are found,
    with errors, and the floor is the root of the sum of their squares."""
    rng = np.random.default_rng(3)
    shape = (9, 12, 3)
    pattern = 0.2 * np.where(np.indices(shape[:2]).sum(axis=0) % 2, 1.0, -1.0)[..., None] * np.ones(shape)
    left = np.zeros(shape[:2], bool)
    left[:, :6] = True

    def picture(mean: np.ndarray) -> Picture:
        noise = 0.05 * np.repeat(rng.standard_normal((*shape[:2], 1)), 3, axis=2)
        return Picture(mean + noise, np.full(shape, 0.05**2), np.full(shape[:2], 8), 1, 1, 1.0, 0, 0, False)

    truths = [picture(np.ones(shape)) for _ in range(12)]
    way = frontier.Way(Candidate("volume"), build(ball, "volume"), 0)
    way.runs = [picture(1.0 + pattern + 0.1 * left[..., None]) for _ in truths]
    way.grown = [[(1.0, square(one, truth, False, 1.0))] for one, truth in zip(way.runs, truths, strict=True)]
    row = frontier.numbers(way, truths, {"whole": np.ones_like(left), "left": left}, 1.0)
    expected = {"whole": 0.05, "left": 0.1}
    for name, value in expected.items():
        assert abs(mean_of(row.bias[name]).value - value) < SIGMAS * mean_of(row.bias[name]).error < 0.02
    whole = 0.2**2 + 0.5 * 0.1**2
    assert abs(mean_of(row.squares).value - whole) < SIGMAS * mean_of(row.squares).error < 0.02
    assert row.floor.seen and row.floor.low < math.sqrt(whole) < row.floor.high
    assert abs(row.texture_square.value - (whole - 0.05**2)) < SIGMAS * row.texture_square.error < 0.02


def test_runs_share_no_random_numbers_but_packings(ball: Scene) -> None:
    """Another stream for each candidate, run and doubling; the truth and the candidates of a run are in one packing,
    and runs are not, nor are they the truth of each other."""
    ways = [c._replace(leap=leap) for c in ALL for leap in (None, 0.0, 3.0, 3.5)]
    streams = {
        ((stream * frontier.MOST_RUNS + run) * (frontier.DOUBLINGS + 1) + step + 1) % frontier.LARGEST_SEED
        for stream in {0, *map(frontier.stream_of, ways)}
        for run in range(10)
        for step in range(frontier.DOUBLINGS + 1)
    }
    assert len(streams) == (1 + len(ways)) * 10 * (frontier.DOUBLINGS + 1)
    packings = frontier.Packings(ball)
    worlds = [build(taken(ball, c), c.level) for c in (Candidate("explicit"), Candidate("teleport", 2))]
    first, second = ([packings.of(world, run).packed for world in worlds] for run in (0, 1))
    assert first[0] is first[1] and second[0] is second[1]
    own = worlds[0].packed.arrays.centres[0]
    assert np.array_equal(first[0].arrays.centres[0], own) and not np.array_equal(second[0].arrays.centres[0], own)


def test_leaps_are_candidates_of_the_levels_that_leap(ball: Scene) -> None:
    """Each radius once, smallest first, none before those of the scene; explicit grains never leap. In a ball too small
    for them all are the same level, told apart by name, line and random numbers."""
    chosen = frontier.leaping(candidates(("explicit", "teleport"), (0, 2)), [4.0, 0.0, 4.0])
    names = ["explicit", "teleport k=2 leap=0", "teleport k=2 leap=4", "teleport leap=0", "teleport leap=4"]
    assert [str(one) for one in chosen] == names
    assert frontier.leaping(chosen[:1], [None]) == chosen[:1]
    made = frontier.measure(ball, chosen, seconds=0.3, runs=2, threads=1)
    assert made is not None and [str(row.candidate) for row in made.rows] == names
    assert made.rows[-1].noise != made.rows[-2].noise
    figure = frontier_plots.plot_frontier(made)
    shown = [text.get_text() for text in figure.legends[0].get_texts()]
    assert shown[-2:] == ["no leaps", "leaps from 4 on"]
    widths = {line.get_linewidth() for line in figure.axes[0].get_lines() if len(line.get_xdata()) > 20}
    assert len(widths) >= 2


def test_of_many_candidates_few_are_named(found: Frontier) -> None:
    """All of a few; of many the least error at any time, and of each level the least floor."""
    assert frontier_plots.named(found, 0.1, 100.0) == list(found.rows)
    row = found.rows[0]

    def made(level: str, grains: int, floor: float, noise: float) -> Measured:
        runs = (1.0,) * found.runs
        squares = tuple(floor**2 * (1.0 + 0.01 * (-1) ** k) for k in range(found.runs))
        return replace(row, candidate=Candidate(level, grains), seconds=runs, noise=(noise**2,) * found.runs,
                       squares=squares)  # fmt: skip

    rows = [made("teleport", k, 0.01 + 0.001 * k, 0.5) for k in range(9)]
    rows += [made("teleport-joint", k, 0.02 - 0.001 * k, 0.5) for k in range(9)]
    rows += [made("isotropic", 0, 0.3, 0.001), made("volume", 0, 0.005, 0.1), made("volume", 1, 0.006, 0.05)]
    many = replace(found, rows=tuple(rows))
    names = [str(one.candidate) for one in frontier_plots.named(many, 0.01, 1000.0)]
    assert names == ["teleport", "teleport-joint k=8", "isotropic", "volume", "volume k=1"]
    figure = frontier_plots.plot_frontier(many)
    beside = [text.get_text().split("  ")[0] for text in figure.axes[0].texts if text.get_text()]
    assert beside == names
    assert f"{len(names)} of 21 named" in figure.get_suptitle()


def test_bytes_are_of_what_a_level_draws_from(found: Frontier) -> None:
    """Cheaper levels hold less, explicit grains hold more, and points know no table."""
    held = {str(row.candidate): row.bytes for row in found.rows}
    assert held["isotropic"] < 1000 < held["volume"] < held["teleport"] < held["teleport k=2"]
    assert held["volume"] < held["teleport-memory"] < held["teleport-memory k=2"]
    assert held["teleport-memory k=2"] - held["teleport-memory"] == held["teleport k=2"] - held["teleport"]


def test_impossible_candidates_are_said(ball: Scene) -> None:
    """A packing too dense to make has the best other level as truth, and says which and why; a level without its
    records is left out, once for all its numbers of grains; nothing at all is an error."""
    bare = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64))
    loose = replace(ball, media=(replace(ball.media[0], grains=(GrainSpec(bare),)),))
    tight = replace(loose, media=(replace(loose.media[0], packing_fraction=0.72),))
    chosen = candidates(("teleport", "teleport-joint", "volume"), (0, 2))
    made = frontier.measure(tight, chosen, seconds=0.2, runs=2, threads=1)
    assert made is not None and made.truth == "teleport"
    assert [str(row.candidate) for row in made.rows] == ["teleport", "volume"]
    assert sum(note.startswith("left out: explicit, teleport k=2: ") for note in made.notes) == 1
    text = frontier_files.markdown(made)
    assert "Truth: teleport, " in text and "Not grain by grain" in text
    assert "left out: teleport-joint, teleport-joint k=2: " in text
    with pytest.raises(UsageError, match="none of teleport-joint is possible"):
        frontier.measure(loose, [Candidate("teleport-joint")], seconds=0.2, runs=2)


@pytest.mark.slow
def test_no_level_that_meets_a_small_sun_by_chance_is_believed(ball: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under a small sun the truth is the best level that aims at it, and what has explicit grains is left out, once.

    Control: a wide sun leaves nothing out. A level that alone was asked for and cannot be had is an error.
    """
    chosen = candidates(("explicit", "teleport", "volume"), (0, 2))
    monkeypatch.setattr(frontier, "_affordable", lambda *_: 64)

    def under(diameter_deg: float) -> Scene:
        return replace(ball, lights=(SunLight((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), diameter_deg),))

    made = frontier.measure(under(0.53), chosen, runs=2, threads=1)
    assert made is not None and made.truth == "teleport-memory"
    assert [str(row.candidate) for row in made.rows] == ["teleport", "volume"]
    left = [note for note in made.notes if note.startswith("left out: ")]
    assert len(left) == 2 and left[0].startswith("left out: explicit, teleport-packed: as the truth: ")
    assert left[1].startswith("left out: explicit, teleport k=2: ")
    assert not any(note.startswith("ball: level explicit meets") for note in made.notes)
    wide = frontier.measure(under(60.0), chosen, runs=2, threads=1)
    assert wide is not None and wide.truth == "explicit" and len(wide.rows) == len(chosen)
    with pytest.raises(UsageError, match="none of explicit is possible"):
        frontier.measure(under(0.53), [Candidate("explicit")], runs=2, threads=1)


def test_a_furnace_has_no_error_and_no_noise(ball: Scene, tmp_path: Path) -> None:
    """Lossless grains in light of radiance 1 are 1 at every level: no floor, no noise, nothing to rank, and reports and
    charts of that are made."""
    made = frontier.measure(replace(ball, surfaces=()), candidates(("volume", "isotropic")), 0.2, 2, threads=1)
    assert made is not None
    assert all(row.floor.high < 1e-12 and max(row.noise) < 1e-24 for row in made.rows)
    assert "nan" not in frontier_files.markdown(made)
    frontier_plots.plot_frontier(made)


def test_pictures_that_fill_the_memory_are_refused(ball: Scene) -> None:
    large = replace(ball, camera=replace(ball.camera, width=2000, height=1500))
    with pytest.raises(UsageError, match="--width"):
        frontier.measure(large, [Candidate("volume")], 0.2, 10, threads=1)


@pytest.mark.slow
def test_a_scene_without_grains_is_the_same_at_all_levels(ball: Scene) -> None:
    """Nothing to pack, no medium to have sides or a rim: the plate alone, without a floor that is seen."""
    made = frontier.measure(replace(ball, media=()), candidates(("explicit", "volume")), 0.2, 3, threads=1)
    assert made is not None and set(made.regions) == {"whole", "object"}
    assert all(chance(row.squares) > 1e-3 for row in made.rows)
    frontier_plots.plot_frontier(made)


@pytest.mark.parametrize(("run", "rows"), [("run 1 of 3", None), ("run 3 of 3", 2), ("never", 3)])
def test_interruption_keeps_the_runs_that_are_done(ball: Scene, run: str, rows: int | None) -> None:
    """A stop in the first run leaves nothing, one in the third two runs; until then nothing is said to be kept."""
    stop, shares = threading.Event(), []

    def told(share: float, word: str) -> None:
        shares.append(share)
        if word.startswith(run) and word.endswith("volume"):
            stop.set()

    made = frontier.measure(ball, candidates(("volume", "isotropic")), 0.2, 3, 0, 1, told, stop)
    assert (made.runs if made else None) == rows
    assert (max(shares) > 0.0) == (rows is not None)
    if made:
        assert ("Interrupted" in frontier_files.markdown(made)) == (rows == 2)


# ------------------------------------------------------------------------------------------------- files


def test_results_are_read_again(found: Frontier, tmp_path: Path) -> None:
    """All of it, to the same text; CSV has a line for each candidate."""
    (tmp_path / "ball.json").write_text(frontier_files.json_text(found))
    again = frontier_files.read(tmp_path / "ball.json")
    assert again == found
    for written in (frontier_files.json_text, frontier_files.csv_text, frontier_files.markdown):
        assert written(again) == written(found)
    lines = list(csv.DictReader(io.StringIO(frontier_files.csv_text(found))))
    assert [line["candidate"] for line in lines] == [str(c) for c in ALL]
    assert float(lines[3]["square"]) == mean_of(found.rows[3].squares).value


@pytest.mark.parametrize(
    "harm",
    [
        lambda held: held.pop("truth"),
        lambda held: held.update(format="tsdf-frontier 9"),
        lambda held: held.update(candidates=[]),
        lambda held: held["candidates"][0].update(level="teleprot"),
        lambda held: held["candidates"][0].update(samples=0),
        lambda held: held["candidates"][1]["runs"]["squares"].pop(),
        lambda held: held["candidates"][1]["runs"]["bias"].pop("whole"),
        lambda held: held["candidates"][1]["runs"].update(noise=["a"] * FEW),
        lambda held: held["candidates"][1]["runs"].update(noise=[math.nan] * FEW),
        lambda held: held.update(width=1e999),
        lambda held: held.update(width="12"),
        lambda held: held.update(scene=None),
        lambda held: held.update(notes="x"),
        lambda held: held.update(notes=[1]),
        lambda held: held["regions"].pop("whole"),
        lambda held: held["candidates"][1].update(lost=True),
        lambda held: held["candidates"][1]["runs"].update(flip="12345678"),
    ],
)
def test_damaged_results_are_one_line(found: Frontier, harm: Callable[[dict], Any], tmp_path: Path) -> None:
    held = json.loads(frontier_files.json_text(found))
    harm(held)
    (tmp_path / "ball.json").write_text(json.dumps(held))
    with pytest.raises(TSDFError, match=r"ball.json: (does not hold|has the format)") as caught:
        frontier_files.read(tmp_path / "ball.json")
    assert "\n" not in str(caught.value)


def test_a_screen_shows_the_table_and_where_the_rest_is(found: Frontier) -> None:
    """No line is wider than 120; columns are left out where they do not fit, those of regions first."""
    regions = {"whole": 1.0} | {f"region of name {k}": 0.1 for k in range(9)}
    rows = [replace(row, bias=dict.fromkeys(regions, row.bias["whole"])) for row in found.rows]
    many = replace(found, regions=regions, rows=tuple(rows), notes=("many words " * 40,))
    few = replace(found, regions={"whole": 1.0})
    heads = []
    for one in (few, many):
        text = frontier_files.terminal(one, "charts/ball.md")
        lines = text.splitlines()
        assert max(map(len, lines)) <= 120 and lines[-1].endswith("rank: charts/ball.md") and "|" not in text
        heads.append(next(re.split("  +", line) for line in lines if line.startswith("candidate ")))
        assert sum(line.startswith(f"{row.candidate}  ") for line in lines for row in one.rows) == len(ALL)
    assert " ".join(text.split()).count("many words") == 40
    always = ["candidate", "place", "floor [%]", "bias, whole [%]", "FLIP", "us per sample", "s to 1 %"]
    for some in heads:
        assert [head for head in some if head in always] == always
    assert sum("region" in head for head in heads[1]) < 2
    slim = tuple(replace(row, squares=(1e-4,) * FEW) for row in few.rows)
    slimmer = frontier_files.terminal(replace(few, rows=slim), "a.md")
    assert "texture [%]" in slimmer and "kB" in slimmer


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(1.2345, 0.04, "1.23(4)"), (1.2345, 0.014, "1.234(14)"), (57.3, 12.0, "57(12)"), (1.0, math.inf, "1(?)"),
     (math.nan, 1.0, "-"), (2.0, 0.0, "2"), (0.0, 0.0996, "0.00(10)")],
)  # fmt: skip
def test_numbers_with_their_error(value: float, error: float, text: str) -> None:
    assert frontier_files.with_error(value, error) == text


def test_charts_draw_no_limit_as_a_measurement(found: Frontier) -> None:
    """Floors that are not seen have no mark over bytes, and their lines end where the limit begins; ticks have room."""
    limit, seen = of(found, "teleport"), of(found, "volume")
    unseen = replace(limit, squares=tuple(1e-3 * (-1.0) ** k for k in range(FEW)))
    drawn = replace(found, rows=(found.rows[0], unseen, seen))
    assert not unseen.floor.seen and seen.floor.seen
    left, right = frontier_plots.plot_frontier(drawn).axes
    lines = {line.get_color(): line for line in left.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 9}
    ends = {name: min(lines[LEVELS[name].colour].get_ydata()) for name in ("explicit", "teleport", "volume")}
    last = mean_of(seen.noise_seconds).value / left.get_xlim()[1]
    assert ends["teleport"] > 100.0 * unseen.floor.high
    assert ends["volume"] == pytest.approx(100.0 * math.sqrt(seen.floor.value**2 + last))
    assert ends["explicit"] < ends["teleport"]
    marks = {line.get_color() for line in right.lines if line.get_marker() == LEVELS["volume"].mark}
    assert marks == {LEVELS["volume"].colour}
    for axes in (left, right):
        for ticks, (low, high) in ((axes.get_xticks(), axes.get_xlim()), (axes.get_yticks(), axes.get_ylim())):
            assert 2 <= len(ticks) <= 14
            assert (np.diff(np.log(ticks)) > 0.05 * math.log(high / low)).all()


SHIPPED = sorted((Path(__file__).parents[2] / "scenes" / "frontier").glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenes_need_nothing_but_the_package(path: Path) -> None:
    """Each is small, of ready tables whose grains can be traced, with boundaries that mean the same at all levels and
    no light that is too small for single grains to meet."""
    scene = load(path)
    assert scene.camera.width * scene.camera.height <= 72 * 64
    for medium in scene.media:
        assert medium.inside == "centres" and medium.packing_fraction <= 0.64
        for grain in medium.grains:
            assert not isinstance(grain.table, Table) and grain.table.parent == library.FOLDER
            read = tsdf_format.read(grain.table)
            assert built_in(read) and read.joint and read.memory
    assert all(light.angular_diameter_deg >= 30.0 for light in scene.lights if isinstance(light, SunLight))


def test_shipped_scenes_cover_what_sets_methods_apart() -> None:
    scenes = [load(path) for path in SHIPPED]
    media = [medium for scene in scenes for medium in scene.media]
    assert len(scenes) >= 6
    assert min(m.packing_fraction for m in media) <= 0.1 and max(m.packing_fraction for m in media) >= 0.6
    assert any(len(m.grains) > 1 for m in media) and any(scene.surfaces for scene in scenes)
    assert {m.grains[0].absorption.coefficient != (0.0,) for m in media} == {True, False}
    kinds = {tsdf_format.read(m.grains[0].table).header["grain"]["kind"] for m in media}  # type: ignore[arg-type]
    assert kinds == {"sphere", "mesh"}


# ----------------------------------------------------------------------------------------------- command

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
table = "glass-beads"
absorption = 0.01
"""
SUFFIXES = (".csv", ".json", ".md", ".pdf", ".png", ".svg")


def status(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([os.fspath(word) if isinstance(word, Path) else str(word) for word in words])
    return int(str(caught.value.code))


@pytest.mark.slow
def test_command_writes_results_and_draws_them_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two scenes and the chart of both; from the saved results the same bytes, also into the same folder."""
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_text(SCENE)
    out = tmp_path / "new" / "out"
    words = ["--seconds", "0.3", "--runs", "2", "--levels", "teleport,volume", "--grains", "0", "--width", "8"]
    assert status(tmp_path / "one.toml", tmp_path / "two.toml", "--out", out, *words) == 0
    names = {*(f"{name}{suffix}" for name in ("one", "two") for suffix in SUFFIXES)}
    names |= {f"frontier{suffix}" for suffix in (".pdf", ".png", ".svg")}
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert set(before) == names
    report = capsys.readouterr().out
    assert all(f"{out / name}.md\n" in report for name in ("one", "two"))
    saved = [out / "one.json", out / "two.json"]
    assert status(*saved, "--out", tmp_path / "again") == 0
    shown = capsys.readouterr().out
    assert shown.replace(str(tmp_path / "again"), str(out)).split() == report.split()
    assert {path.name: path.read_bytes() for path in (tmp_path / "again").iterdir()} == before
    assert status(saved[0], "--out", out, "--quiet") == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["scene.toml", "--out", "o", "--levels", "teleprot"], 2, "did you mean teleport"),
        (["scene.toml", "--out", "o", "--grains", "1,-2"], 2, "--grains"),
        (["scene.toml", "--out", "o", "--grains", "1.5"], 2, "--grains"),
        (["scene.toml", "--out", "o", "--leaps", "0,x"], 2, "--leaps"),
        (["scene.toml", "--out", "o", "--leaps", "0.5"], 2, "--leaps"),
        (["scene.toml", "--out", "o", "--leaps", "nan"], 2, "--leaps"),
        (["scene.toml", "--out", "o", "--runs", "1"], 2, "--runs is"),
        (["scene.toml", "--out", "o", "--seconds", "0"], 2, "--seconds is"),
        (["empty.json", "--out", "o", "--levels", "volume", "--seed", "0"], 2, "--levels, --seed: saved results"),
        (["empty.json", "scene.toml", "--out", "o", "--seconds", "1"], 1, "empty.json"),
        (["scene.toml", "other/scene.toml", "--out", "o"], 2, "two results"),
        (["nothing.toml", "--out", "o"], 1, "nothing.toml"),
        (["nothing.json", "--out", "o"], 1, "nothing.json"),
        (["empty.json", "--out", "o"], 1, "empty.json"),
        (["scene.toml", "--out", "scene.toml"], 1, "give a folder"),
        (["scene.toml"], 2, "--out"),
        (["--out", "o"], 2, "SCENE"),
    ],
)
def test_bad_requests_are_one_line(
    words: list[str], code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "empty.json").write_text("{}")
    assert status(*words, "--quiet") == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error
