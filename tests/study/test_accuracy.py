"""Levels against packed grains: formulas where there are any, the reports, and the command."""

import csv
import io
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tsdf
from tsdf.cli.accuracy import main
from tsdf.data.table import Table
from tsdf.errors import SceneError, UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import world
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.scene import Absorption, GrainSpec, Slab, Sphere
from tsdf.study import accuracy, accuracy_files, experiment, plots
from tsdf.study.accuracy import diffusion, measure, slab
from tsdf.study.experiment import Experiment, Sums, gather, slab_experiment

SIGMAS = 4.0


@pytest.fixture(scope="module")
def table() -> Table:
    return exact_sphere(load_grain("sphere"), Optics(1.31), Effort(cells=256, joint=16, memory=32))


@pytest.fixture(scope="module")
def grain(table: Table) -> GrainSpec:
    return GrainSpec(table)


def tabulated(table: Table) -> float:
    """Return the mean cosine of the cells, which is what is drawn, not the header's exact one."""
    edges = table.cos_theta_edges
    return float(table.p_theta @ (edges[1:] + edges[:-1]) / 2.0 / table.p_theta.sum())


# ---------------------------------------------------------------------------------------- bulk and slabs


@pytest.mark.slow
@pytest.mark.parametrize("level", ["volume", "volume-hg", "isotropic"])
def test_diffusion_of_point_scatterers_is_the_formula(level: str, table: Table, grain: GrainSpec) -> None:
    """Exponential free paths of mean l and a mean cosine g give 2 l^2 / (1 - g) per event, within 4 standard errors.

    Control: the same with the gap alone as free path, or with blocks that light remembers, is rejected.
    """
    volume = volume_parameters([Component(table)], 0.5)
    g = {"volume": tabulated(table), "volume-hg": volume.g, "isotropic": 0.0}[level]
    free = 1.0 / volume.sigma_t / (1.0 - volume.g if level == "isotropic" else 1.0)
    found = diffusion(level, grain, 0.5, 1500, seed=1, block=64)
    expected = 2.0 * free**2 / (1.0 - g)
    assert abs(found.value - expected) < SIGMAS * found.error
    assert found.error < 0.02 * expected
    assert abs(found.value - 2.0 * 0.75**2 * free**2 / (1.0 - g)) > SIGMAS * found.error
    if level != "isotropic":
        short = diffusion(level, grain, 0.5, 4000, seed=1, block=1)
        assert short.value < expected - SIGMAS * short.error


def test_blocks_are_longer_than_light_remembers(table: Table) -> None:
    """The block grows with the mean cosine: what is left of a direction after it is what the constant says."""
    block = experiment.block_of(table)
    assert block >= experiment.BLOCK
    assert table.mean_cosine() ** block <= experiment.FORGOTTEN < table.mean_cosine() ** (block - 2)
    mirror = exact_sphere(load_grain("sphere"), Optics(1.02), Effort(cells=64))
    assert experiment.block_of(mirror) > 4 * block


@pytest.mark.parametrize("level", ["volume", "teleport", "teleport-joint", "teleport-memory"])
def test_a_lossless_slab_loses_nothing(level: str, grain: GrainSpec) -> None:
    """Reflectance and transmittance sum to 1, the profile to the reflectance, to rounding; with absorption to less."""
    found = slab(level, grain, 0.5, 6.0, 3000, cosine=0.5, seed=2)
    assert found.reflectance + found.transmittance == pytest.approx(1.0, abs=1e-12)
    assert found.profile.sum() == pytest.approx(found.reflectance, abs=1e-12)
    dark = slab(level, replace(grain, absorption=Absorption("grey", (0.05,))), 0.5, 6.0, 3000, cosine=0.5, seed=2)
    assert dark.reflectance + dark.transmittance < 0.95
    assert dark.profile.sum() == pytest.approx(dark.reflectance, abs=1e-12)


def test_thin_slab_is_single_scattering(table: Table, grain: GrainSpec) -> None:
    """A slab of optical thickness t = 0.02 sends back what is scattered once, to first order in t; the error of that
    is below 2 t of it. Control: at a cosine of 1/2 it is nearly twice as much, and the value at 1 is rejected."""
    volume = volume_parameters([Component(table)], 0.5)
    layer = 0.02 / volume.sigma_t
    found = slab("volume", grain, 0.5, layer, 150_000, seed=3)
    edges = table.cos_theta_edges
    middle = 0.5 * (edges[1:] + edges[:-1])
    t, mu = 0.02, -middle[middle < 0.0]
    once = float((table.p_theta[middle < 0.0] * mu / (1.0 + mu) * -np.expm1(-t * (1.0 + 1.0 / mu))).sum())
    assert abs(found.reflectance - once) < SIGMAS * found.reflectance_error + 2.0 * t * once
    tilted = slab("volume", grain, 0.5, layer, 150_000, cosine=0.5, seed=3)
    assert abs(tilted.reflectance - once) > SIGMAS * tilted.reflectance_error + 2.0 * t * once


@pytest.mark.slow
def test_slabs_are_cut_from_several_heights(grain: GrainSpec) -> None:
    """Cuts are as far apart as a layer and a grain, and within the tile. Another height is another slab of spheres, the
    one a whole tile higher is the same."""
    side = (2000 * 4.0 / 3.0 * math.pi / 0.5) ** (1.0 / 3.0)
    for layer in (2.0, 4.0, 10.0, 40.0):
        tops = experiment.cuts(0.5, layer)
        assert tops[0] == 0.0 and len(tops) <= experiment.MOST_CUTS
        assert all(b - a >= layer + 2.0 for a, b in zip(tops, [*tops[1:], side], strict=True)) or len(tops) == 1
    assert len(experiment.cuts(0.5, 2.0)) == 4
    low, high, again = (
        gather(slab_experiment("explicit", grain, 0.5, 4.0, top=top), 1000).mean for top in (0.0, 0.3 * side, side)
    )
    assert np.allclose(low, again, atol=2.5e-3)
    assert not np.allclose(low, high, atol=2.5e-3)


def test_the_same_numbers_for_any_threads(grain: GrainSpec) -> None:
    """Paths have random numbers of their own: threads and passes change nothing but the rounding of sums."""
    world = slab_experiment("teleport-memory", grain, 0.5, 4.0)
    one, three = (experiment.follow(world.world, world.camera, 3000, 5, threads=n)[1] for n in (1, 3))
    for a, b in zip(one[:5], three[:5], strict=True):
        assert np.array_equal(a, b)
    assert one.events == three.events
    halves = [experiment.follow(world.world, world.camera, 1500, 5, first=n)[1] for n in (0, 1500)]
    assert np.array_equal(np.concatenate([half.place for half in halves]), one.place)
    other = experiment.follow(world.world, world.camera, 3000, 6)[1]
    assert not np.array_equal(other.place, one.place)


@pytest.mark.parametrize("level", ["teleport", "volume-hg"])
@pytest.mark.parametrize("shape", ["slab", "ball"])
def test_paths_in_lanes_are_as_one_by_one(
    level: str, shape: str, grain: GrainSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Path by path: where each began and came out, which way, its weight, what it crossed; some are handed over.
    Control: another seed's are others."""
    dark = replace(grain, absorption=Absorption("grey", (0.2,)))
    body = Slab(-8.0, 0.0) if shape == "slab" else Sphere((0.0, 0.0, -5.0), 5.0)
    made = world.build(experiment.scene_of(body, dark, 0.5), level, leap=0.0)
    few = replace(made, media=made.media._replace(limit=40))
    camera = experiment.beam(made, (0.0, 0.0, 5.0), (0.0, 0.0, -1.0))

    def taken(seed: int = 1) -> experiment.Ends:
        return experiment.follow(few, camera, 3000, seed, threads=1)[1]

    def all_of(ends: experiment.Ends) -> np.ndarray:
        return np.column_stack((ends.place, ends.direction, ends.weight, ends.amounts))[wanted.weight > 0.0]

    found, other = taken(), taken(2)
    with monkeypatch.context() as patch:
        patch.setattr(experiment.lanes, "suited", lambda *_: False)
        wanted = taken()
    assert (wanted.weight > 0.0).mean() > 0.5 and ((wanted.weight > 0.0) == (found.weight > 0.0)).mean() > 0.999
    far = 1e-6  # one by one they end a little beyond the boundary, more so along it
    assert (np.abs(all_of(found) - all_of(wanted)) < far).all(axis=1).mean() > 0.999
    assert (np.abs(all_of(other) - all_of(wanted)) < far).all(axis=1).mean() < 0.1
    assert np.array_equal(found.start, wanted.start) and abs(found.events / wanted.events - 1.0) < 1e-3


def test_absorption_can_be_taken_off_afterwards(table: Table, grain: GrainSpec) -> None:
    """One run of lossless paths gives what a run with absorption gives, within 4 standard errors of both; and without
    any it is the lossless run to the last bit. Control: twice the coefficient is rejected."""
    sums = gather(slab_experiment("teleport", grain, 0.5, 10.0, coefficients=(0.0, 0.02, 0.04)), 20_000, seed=1)
    lossless = slab("teleport", grain, 0.5, 10.0, 20_000, seed=1)
    own = slab("teleport", replace(grain, absorption=Absorption("grey", (0.02,))), 0.5, 10.0, 20_000, seed=2)
    each = 1 + len(experiment.PROFILE)
    assert sums.mean[0] == lossless.reflectance
    assert abs(sums.mean[each] - own.reflectance) < SIGMAS * math.hypot(sums.error[each], own.reflectance_error)
    assert abs(sums.mean[2 * each + 1] - own.transmittance) > SIGMAS * own.transmittance_error


@pytest.mark.slow
def test_memory_is_right_where_teleport_is_not(grain: GrainSpec) -> None:
    """In the bulk at packing fraction 0.5, packed spheres and teleport-memory agree within 4 standard errors and 0.5 %,
    which one packing of 2000 may differ by; teleport, the control, is slower by 5 %, and is rejected."""
    truth = diffusion("explicit", grain, 0.5, 2000, seed=1, blocks=24)
    memory, plain = (diffusion(level, grain, 0.5, 8000, seed=2, blocks=24) for level in ("teleport-memory", "teleport"))

    def far(one: experiment.Value) -> float:
        return abs(one.value - truth.value) / (math.hypot(one.error, truth.error) * SIGMAS + 0.005 * truth.value)

    assert far(memory) < 1.0
    assert far(plain) > 1.0


# ------------------------------------------------------------------------------------------ errors and rows


def test_the_error_of_packings_is_the_larger_of_two() -> None:
    """Of 2000 sets of four packings that differ by nothing the packings' own error is small beside that of paths;
    where they differ three times as much as paths do, it is what they differ by, and that of paths a third of it."""
    rng = np.random.default_rng(3)

    def made(spread: float) -> Sums:
        mean = 1.0 + spread * rng.standard_normal(2000) + 0.01 * rng.standard_normal(2000)
        return Sums(2, 2.0 * mean, 2.0 * (mean**2 + 0.01**2))

    same = accuracy._packed([made(0.0) for _ in range(4)])
    other = accuracy._packed([made(0.03) for _ in range(4)])
    assert np.allclose(same.paths, 0.005) and np.allclose(other.paths, 0.005)
    assert (same.error >= same.paths).all() and np.median(same.packings) < 0.003
    true = math.hypot(0.03, 0.01) / 2.0
    assert 0.85 < np.sqrt((other.error**2).mean()) / true < 1.15
    assert np.median(other.packings) == pytest.approx(0.015, rel=0.2)


def test_noise_of_a_profile_is_what_equal_profiles_differ_by(grain: GrainSpec) -> None:
    """One level twice differs by about the noise stated for counting alone; two levels, the control, by far more."""
    case = accuracy._Case(0.5, 4.0, 0.0)

    def found(level: str, seed: int) -> accuracy._Found:
        return accuracy._packed([gather(slab_experiment(level, grain, 0.5, 4.0), 20_000, seed=seed)])

    levels = {"explicit": found("teleport", 1), "teleport": found("teleport", 2), "volume": found("volume", 3)}
    rows = [row for row in accuracy._slab_rows(case, levels) if row.quantity == "profile"]
    assert [row.level for row in rows] == ["teleport", "volume"]
    assert 0.4 < rows[0].value / rows[0].error < 2.0
    assert rows[1].value > 4.0 * rows[1].error


def test_runs_beside_each_other_add_up() -> None:
    """Each keeps its mean, and what they took adds up field by field."""
    runs = [Sums(10, np.array([m * 10.0]), np.array([(m**2 + 0.9) * 10.0]), events=5, drawn=3, seconds=0.25)
            for m in (1.0, 2.0)]  # fmt: skip
    both = accuracy._beside(runs)
    assert both.mean == pytest.approx([1.0, 2.0]) and both.error == pytest.approx(np.sqrt([0.1, 0.1]))
    assert (both.events, both.drawn, both.seconds) == (10, 6, 0.5)


def test_lost_paths_are_counted_and_left_out() -> None:
    """A path that did not come to its last block has no number; the mean is that of the others."""
    nothing = experiment.Ends(*(np.zeros((0, 3)) for _ in range(3)), np.zeros(0), np.zeros((0, 0)), 0, 0, 0.0)
    sums = Sums()
    sums.add(np.array([[1.0], [math.nan], [3.0]]), nothing)
    assert (sums.paths, sums.lost, sums.mean[0]) == (2, 1, 2.0)
    made = experiment.bulk_experiment(
        "volume", GrainSpec(exact_sphere(load_grain("sphere"), Optics(1.31), Effort(cells=32))), 0.5
    )
    places = np.ones((3, experiment.BLOCKS + 1, 3))
    places[1, -2:] = 0.0
    places[2, 5:] = 2.0 * experiment.FAR
    assert list(np.isnan(made.read(places, nothing)[:, 0])) == [False, True, True]


@pytest.fixture(scope="module")
def small(grain: GrainSpec) -> accuracy.Accuracy:
    return measure(grain, [0.05], [10.0], paths=256, seed=3, threads=1)


@pytest.mark.slow
def test_every_number_has_a_row(small: accuracy.Accuracy) -> None:
    """Bulk, slabs at two angles and two albedos, times; the reports hold them; explicit deviates from nothing."""
    assert small.levels == accuracy.MEASURED and not small.notes and not small.interrupted
    count = dict.fromkeys(("displacement", "reflectance", "transmittance", "profile", "time"), 0)
    for row in small.rows:
        count[row.quantity] += 1
        assert math.isnan(row.deviation) == (row.level == "explicit" or row.quantity in ("profile", "time"))
        own = LEVELS[row.level].traits.packed and row.quantity not in ("profile", "time")
        assert math.isnan(row.paths_error) != own
    levels = len(accuracy.MEASURED)
    assert count == {
        "displacement": levels, "reflectance": 4 * levels, "transmittance": 4 * levels, "profile": 4 * (levels - 1),
        "time": levels,
    }  # fmt: skip
    lines = list(csv.DictReader(io.StringIO(accuracy_files.csv_text(small))))
    assert len(lines) == len(small.rows) and float(lines[0]["value"]) == small.rows[0].value
    assert lines[0]["deviation"] == "" and lines[0]["layer"] == ""
    text = accuracy_files.markdown(small)
    assert "nan" not in text and "| 0.05 | 10 | 60 | 0.99 |" in text
    begins, _, rest = text.partition("\n## ")
    short = accuracy_files.summary(small)
    assert short.startswith(begins) and len(short) < len(rest)
    dark, light = (
        next(r for r in small.rows if r.quantity == "reflectance" and r.albedo == albedo) for albedo in (0.99, 1.0)
    )
    assert dark.value < light.value


def test_noise_is_no_headline(small: accuracy.Accuracy) -> None:
    """What 256 paths say of a level is not told; a deviation of many errors is, before a larger one of few."""
    assert "teleport | none told (± " in accuracy_files.summary(small)
    changed = {"reflectance": (-0.2, 0.01), "transmittance": (0.9, 0.5)}
    rows = [
        replace(row, deviation=changed[row.quantity][0], deviation_error=changed[row.quantity][1])
        if row.level == "teleport" and row.quantity in changed
        else row
        for row in small.rows
    ]
    assert " | -20.00 ± 1 | none told (± 50) |" in accuracy_files.summary(replace(small, rows=tuple(rows)))


@pytest.mark.slow
def test_the_same_request_gives_the_same_numbers(small: accuracy.Accuracy, grain: GrainSpec) -> None:
    again = measure(grain, [0.05], [10.0], paths=256, seed=3, threads=2)
    other = measure(grain, [0.05], [10.0], paths=256, seed=4)

    def values(found: accuracy.Accuracy) -> list[float]:
        return [row.value for row in found.rows if row.quantity != "time"]

    assert values(again) == values(small)
    assert values(other) != values(small)


@pytest.mark.slow
def test_what_a_table_cannot_is_said() -> None:
    """Without records their levels are skipped, above 0.64 those that need packings; the rest has numbers, and without
    explicit no deviations. Above 0.64 alone nothing can be held against anything."""
    bare = GrainSpec(exact_sphere(load_grain("sphere"), Optics(1.31), Effort(cells=32)))
    with pytest.raises(UsageError, match=r"end at 0\.64"):
        measure(bare, [0.7], [2.0], paths=64)
    found = measure(bare, [0.3, 0.7], [2.0], paths=64)
    assert found.levels == ("explicit", "teleport", "volume")
    assert all(math.isnan(row.deviation) for row in found.rows if row.fraction == 0.7)
    for words, times in (("--memory 64", 2), ("--joint 32", 1), ("explicit is skipped at packing fraction 0.7", 1)):
        assert sum(words in note for note in found.notes) == times  # of two levels, of one
    text = accuracy_files.markdown(found)
    assert "nan" not in text and "--memory 64" in text
    plots.plot_accuracy(accuracy_files.facts(found), found.fraction, found.name)


@pytest.mark.slow
def test_grains_that_let_no_light_in_have_no_absorbing_slabs() -> None:
    class Closed(Table):
        def albedo(self, absorption: float = 0.0) -> float:
            return 1.0

    plain = exact_sphere(load_grain("sphere"), Optics(1.31), Effort(cells=32))
    found = measure(GrainSpec(Closed(plain.header, plain.pixels)), [0.5], [2.0], ["teleport"], paths=64)
    assert {row.albedo for row in found.rows if row.quantity == "reflectance"} == {1.0}
    assert any("left out" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize(("word", "rows"), [("start: packing 1", 0), ("bulk, volume", 0), ("layer of 2 R at 0", 3)])
def test_interruption_keeps_what_is_done(word: str, rows: int, grain: GrainSpec) -> None:
    """At any step what came before it stays: nothing at the start, the bulk's three levels at the first slab."""

    def progress(share: float, now: str) -> None:
        assert 0.0 <= share <= 1.0
        if word in now:
            raise KeyboardInterrupt

    found = measure(grain, [0.5], [2.0], ["teleport", "volume"], paths=64, progress=progress)
    assert found.interrupted
    assert "Interrupted" in accuracy_files.markdown(found)
    assert len(found.rows) == rows


@pytest.mark.slow
def test_time_is_kept_on_the_clock(grain: GrainSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """A start of 1000 s (of a clock that leaps whenever a packing is made) costs the measuring nothing, and runs that
    take ten times their share leave less to the next: asked for 60 s, all runs together are given no more."""
    clock, given = [0.0], []
    monkeypatch.setattr(accuracy.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(accuracy, "pack", lambda *_: clock.__setitem__(0, clock[0] + 250.0))

    def slow(made: Experiment, paths: int | None, seconds: float | None = None, *_: object, **__: object) -> Sums:
        if seconds is not None:
            given.append(seconds)
            clock[0] += 10.0 * max(seconds, 0.0)
        return gather(made, 2, threads=1)

    monkeypatch.setattr(accuracy, "gather", slow)
    found = measure(grain, [0.05], [2.0], ["teleport"], seconds=60.0)
    assert "60 s of measuring follow a start of 1000.0 s" in found.notes
    assert given[0] == pytest.approx(60.0 * accuracy.BULK / 5)
    assert clock[0] - 1000.0 < 60.0 + 10.0 * max(given)
    assert min(given) < 0.0
    assert f"it took {clock[0] - 1000.0:.0f} s, for each of so many slabs" in " ".join(found.notes)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"levels": ["teleprot"]}, "no level"),
        ({"packings": 3}, "packings"),
        ({"fractions": [0.8]}, "packing fractions"),
        ({"fractions": []}, "packing fractions"),
        ({"layers": [0.0]}, "layers"),
        ({"seconds": 1.0, "paths": 100}, "give one"),
        ({"seconds": math.nan}, "seconds"),
        ({"paths": 3}, "paths"),
    ],
)
def test_requests_that_cannot_be_meant(how: dict[str, object], said: str, grain: GrainSpec) -> None:
    with pytest.raises(UsageError, match=said):
        measure(grain, **how)  # type: ignore[arg-type]


# -------------------------------------------------------------------------------------------- the command


def status(*words: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(list(words))
    return int(str(caught.value.code))


@pytest.fixture
def file(table: Table, tmp_path: Path) -> str:
    tsdf.write(table, tmp_path / "sphere.tsdf.exr")
    return os.fspath(tmp_path / "sphere.tsdf.exr")


@pytest.mark.slow
def test_command_writes_the_reports(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "out"
    words = [file, "--out", os.fspath(out), "--packing", "0.05", "--layer", "2", "--paths", "64"]
    assert status(*words, "--levels", "teleport") == 0
    assert {p.name for p in out.iterdir()} == {"accuracy.md", "accuracy.csv", "accuracy.png"}
    said, report = capsys.readouterr().out, (out / "accuracy.md").read_text()
    assert said.endswith("accuracy.md has every number\n") and len(said) < len(report)
    assert said.splitlines()[:5] == report.splitlines()[:5]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--out", "o", "--levels", "teleprot"], 2, "did you mean teleport"),
        (["--out", "o", "--paths", "1"], 2, "paths"),
        (["--out", "o", "--seconds", "-1"], 2, "seconds"),
        (["--out", "o", "--packings", "1"], 2, "packings"),
        (["--out", "o", "--packing", "0.9"], 2, "packing fractions"),
        (["--out", "o", "--threads", "0"], 2, "--threads"),
        (["--out", "o", "--seed", "-1"], 2, "--seed"),
        (["--out", "o", "--mesh", "nothing.obj"], 1, "nothing.obj"),
        (["--out", "sphere.tsdf.exr"], 1, "give a folder"),
        ([], 2, "--out"),
    ],
)
def test_bad_requests_are_one_line(
    words: list[str], code: int, said: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert status("sphere.tsdf.exr", *words, "--quiet") == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error


def test_a_missing_table_and_an_unknown_grain_are_one_line(
    table: Table, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status(os.fspath(tmp_path / "nothing.exr"), "--out", os.fspath(tmp_path / "o")) == 1
    assert "nothing.exr" in capsys.readouterr().err
    header = dict(table.header)
    header["grain"] = {**dict(header["grain"]), "kind": "mesh", "name": "pebble", "parameters": {}}
    with pytest.raises(SceneError, match="pebble"):
        measure(GrainSpec(Table(header, table.pixels)), paths=64)


def test_levels_of_the_command_are_the_library_s() -> None:
    from tsdf.cli.accuracy import MEASURED

    assert MEASURED == accuracy.MEASURED
    defaults = {option.name: option.default for option in main.params}
    assert defaults["packing"] == accuracy.FRACTIONS and defaults["layer"] == accuracy.LAYERS
