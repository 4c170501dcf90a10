"""How tables are made: the same bytes whatever the way, honest errors, and the physics of simple solids."""

import importlib.util
import itertools
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tsdf
from tsdf import archive
from tsdf.data.table import Table
from tsdf.errors import GrainError, TSDFError, UsageError
from tsdf.grain.grains import Grain, load_grain
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.make import assemble, scatterometer, statistics
from tsdf.make import tally as T
from tsdf.make.origin import grain_header
from tsdf.make.scatterometer import Build, Effort, merge
from tsdf.make.spans import CHUNK_MIN, chunks
from tsdf.make.tally import Tally


def built(grain: Grain, optics: Optics, threads: int = 2, **effort: float) -> Table:
    build = Build.start(grain, optics, Effort(**effort))  # type: ignore[arg-type]
    build.run(grain, threads)
    return build.table()


def deviations(table: Table, truth: dict[str, float]) -> dict[str, float]:
    """Return how many standard errors each statistic is off."""
    s, e = table.statistics, table.header["standard_errors"]
    return {name: (s[name] - value) / e[name] for name, value in truth.items()}


# ------------------------------------------------------------------------------------------ the same bytes


@pytest.fixture(scope="module")
def octahedron() -> Grain:
    return load_grain("octahedron")


@pytest.fixture(scope="module")
def reference(octahedron: Grain, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file of a build in one piece on one thread; the other ways must give its very bytes."""
    path = tmp_path_factory.mktemp("reference") / "one.tsdf.exr"
    tsdf.write(built(octahedron, Optics(1.31), threads=1, paths=30_000, joint=4, memory=3), path)
    return path.read_bytes()


@pytest.mark.parametrize("threads", [2, 7])
def test_threads_do_not_show(octahedron: Grain, reference: bytes, threads: int, tmp_path: Path) -> None:
    path = tmp_path / "t.tsdf.exr"
    tsdf.write(built(octahedron, Optics(1.31), threads=threads, paths=30_000, joint=4, memory=3), path)
    assert path.read_bytes() == reference


@pytest.fixture(scope="module")
def parts(octahedron: Grain, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The part files of the same build in three parts."""
    files = []
    for i in (1, 2, 3):
        build = Build.start(octahedron, Optics(1.31), Effort(paths=30_000, joint=4, memory=3))
        files.append(tmp_path_factory.mktemp("parts") / f"{i}.part")
        build.run(octahedron, 1, (i, 3), files[-1])
    return files


@pytest.mark.slow
def test_parts_merge_to_the_whole_in_any_order(reference: bytes, parts: list[Path], tmp_path: Path) -> None:
    for order in (parts, parts[::-1]):
        tsdf.write(merge(order).table(), tmp_path / "m.tsdf.exr")
        assert (tmp_path / "m.tsdf.exr").read_bytes() == reference
    with pytest.raises(TSDFError, match="are missing"):
        merge(parts[:2]).table()
    with pytest.raises(TSDFError, match="give each part once"):
        merge([*parts, parts[0]])


@pytest.mark.slow
def test_a_table_without_records_by_entry_is_as_ever(octahedron: Grain) -> None:
    """Version 1.0 and the same pixels; the records by entry stand below them, each in the cell of its column."""
    optics = Optics(1.31)
    having, without = (built(octahedron, optics, paths=30_000, joint=4, memory=m, cells=32) for m in (3, 0))
    assert (having.header["format_version"], without.header["format_version"]) == ("1.1", "1.0")
    assert np.array_equal(having.pixels[: len(without.pixels)], without.pixels)
    assert not without.memory and having.memory["r"].shape == (3, 34) and having.hit.shape == (34,)
    cell = (having.memory["entry_b2"][:, having.hit > 0.0] * 34.0).astype(int)
    assert np.array_equal(cell, np.broadcast_to(np.flatnonzero(having.hit > 0.0), cell.shape))
    assert having.hit.mean() == pytest.approx(having.statistics["hit_probability"], abs=1e-3)
    with pytest.raises(UsageError, match="no block 'memory_hit'"):
        _ = without.hit


def test_few_paths_leave_no_record_without_light(octahedron: Grain) -> None:
    """So few paths that some cells of entry are hit by none: their records are 0, all others are of their cell."""
    table = built(octahedron, Optics(1.31), paths=1024, memory=2, cells=512)
    hit, memory = table.hit, table.memory
    assert 10 < np.count_nonzero(hit == 0.0) < 400
    for values in memory.values():
        assert not values[:, hit == 0.0].any()
    b2 = memory["entry_b2"][:, hit > 0.0] * 514.0 - np.flatnonzero(hit > 0.0)
    assert b2.min() > -1e-3 and b2.max() < 1.0 + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("eta", "fresnel"), [(1.33, "un"), (1.5, "sp"), (0.75, "un"), (1.0, "un")])
def test_records_by_entry_of_the_exact_sphere(eta: float, fresnel: str) -> None:
    """They have the statistics of the sphere, by quadrature: 32 x 258 of them are within 2e-3.

    Fewer records are less even, but not biased: where they begin varies from cell to cell.
    """
    truth = analytic.sphere_statistics(eta, fresnel)
    for count, allowed in ((32, 2e-3), (3, 1e-2)):
        table = scatterometer.exact_sphere(load_grain("sphere"), Optics(eta, fresnel), Effort(memory=count))
        memory = table.memory
        assert np.all(table.hit == 1.0) and memory["r"].shape == (count, 258)
        assert memory["cos_theta"].mean(dtype=float) == pytest.approx(truth.mean_cosine, abs=allowed)
        assert memory["z"].mean(dtype=float) == pytest.approx(truth.mean_z, abs=2.0 * allowed)
        assert memory["r"].mean(dtype=float) == pytest.approx(truth.mean_r, abs=2.0 * allowed)
        assert memory["l"].mean(dtype=float) == pytest.approx(truth.mean_path_length, abs=4.0 * allowed)
        assert memory["entry_b2"].mean(dtype=float) == pytest.approx(0.5, abs=1e-3)


def test_part_of_another_build_is_refused(octahedron: Grain, tmp_path: Path) -> None:
    for name, eta in (("a", 1.31), ("b", 1.32)):
        Build.start(octahedron, Optics(eta), Effort(paths=30_000)).run(octahedron, 1, (1, 2), tmp_path / name)
    with pytest.raises(TSDFError, match="they differ in optics"):
        merge([tmp_path / "a", tmp_path / "b"])


def test_no_save_waits_for_what_is_sought(octahedron: Grain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The extent of a huge mesh takes seconds: paths are safe before it is found, and the table has it all the same."""
    part, there = tmp_path / "x.part", []
    sought = scatterometer.extent_header

    def late(grain: Grain) -> dict[str, float]:
        end = time.monotonic() + 20.0
        while not part.exists() and time.monotonic() < end:
            time.sleep(0.01)
        there.append(part.exists())
        return sought(grain)

    monkeypatch.setattr(scatterometer, "extent_header", late)
    monkeypatch.setattr(scatterometer, "SAVE_S", 0.0)
    build = Build.start(octahedron, Optics(1.31), Effort(paths=40_000))
    build.run(octahedron, 1, part_file=part)
    assert there == [True]
    whole = Build.load(part).table()
    assert whole.header["grain"]["x_sieve"] == build.table().header["grain"]["x_sieve"] > 0.0


def test_resuming_gives_the_same_bytes(octahedron: Grain, reference: bytes, tmp_path: Path) -> None:
    """Stop when the first paths are done, as Ctrl-C would, and go on from the part file."""
    part = tmp_path / "x.part"

    class Stop(Exception):
        pass

    def stop(progress: scatterometer.Progress) -> None:
        if progress.paths:
            raise Stop

    build = Build.start(octahedron, Optics(1.31), Effort(paths=10_000_000, joint=4, memory=3))
    with pytest.raises(Stop):
        build.run(octahedron, 2, part_file=part, report=stop)
    stored = Build.load(part)
    assert 0 < stored.paths < 10_000_000 and stored.done == [(0, stored.paths)]
    first = Build.start(octahedron, Optics(1.31), Effort(paths=8192, joint=4, memory=3))
    first.run(octahedron, 2, part_file=part)
    resumed = Build.start(octahedron, Optics(1.31), Effort(paths=30_000, joint=4, memory=3))
    resumed.take(Build.load(part))
    resumed.run(octahedron, 1)
    tsdf.write(resumed.table(), tmp_path / "r.tsdf.exr")
    assert (tmp_path / "r.tsdf.exr").read_bytes() == reference


@pytest.mark.slow
def test_paths_serve_every_request_they_can_answer(octahedron: Grain, reference: bytes, tmp_path: Path) -> None:
    """Other cells, fewer records, fewer and more paths, a target: the very bytes of a build of its own, where there is
    one; else a message that says what the part file can answer."""
    optics, part = Optics(1.31), tmp_path / "x.part"
    whole = Build.start(octahedron, optics, Effort(paths=30_000, joint=6, memory=20, cells=99))
    whole.run(octahedron, 2, part_file=part)

    def served(**effort: float) -> Build:
        build = Build.start(octahedron, optics, Effort(**effort))  # type: ignore[arg-type]
        build.take(Build.load(part), "x.part")
        build.run(octahedron)
        return build

    tsdf.write(served(paths=30_000, joint=4, memory=3).table(), tmp_path / "t.tsdf.exr")
    assert (tmp_path / "t.tsdf.exr").read_bytes() == reference
    narrow, own = (
        served(paths=2_000, cells=20, memory=17).table(),
        built(octahedron, optics, paths=30_000, cells=20, memory=17),
    )
    assert np.array_equal(narrow.pixels, own.pixels) and narrow.header == own.header
    more, own = served(paths=50_000, cells=20).table(), built(octahedron, optics, paths=50_000, cells=20)
    assert np.array_equal(more.pixels, own.pixels) and more.header == own.header
    met = served(target_error=0.2)
    assert met.paths == 30_000 and met.table().header["table_error"]["total_variation"] <= 0.2
    assert "--paths 30000 --seed 0 --max-bounces 100000 --cells" in met.table().header["provenance"]["command"]
    for effort, said in (
        ({"seed": 1}, "differ in seed"),
        ({"joint": 7}, "differ in --joint 7.*--joint up to 6 and --memory up to 20"),
        ({"memory": 32}, "differ in --memory 32"),
    ):
        with pytest.raises(TSDFError, match=said):
            served(paths=30_000, **effort)


@pytest.mark.slow
def test_a_table_as_good_as_it_got(octahedron: Grain) -> None:
    """No time at all: the first paths, a table of them that says its error, and the same bytes as by number."""
    build = Build.start(octahedron, Optics(1.31), Effort(target_error=1e-4))
    build.run(octahedron, max_seconds=0.0)
    with pytest.raises(TSDFError, match=r"is not met after .* go on with --resume"):
        build.table()
    table = build.table(as_it_got=True)
    assert table.header["provenance"]["paths"] == build.paths < 100_000
    own = built(octahedron, Optics(1.31), paths=build.paths, cells=len(table.p_theta) - 2)
    assert np.array_equal(table.pixels, own.pixels) and table.header == own.header


@pytest.mark.slow
def test_kill_loses_no_more_than_a_few_seconds(
    octahedron: Grain, tmp_path: Path, launch: Callable[..., subprocess.Popen]
) -> None:
    """A process killed without warning leaves a part file from which the build goes on to the same bytes."""
    out = tmp_path / "k.tsdf.exr"
    part = Path(f"{out}.part")
    code = "from tsdf.make import scatterometer as s; s.SAVE_S = 0.1; from tsdf.cli.build import main; main()"
    command = [sys.executable, "-c", code, "octahedron", "--eta", "1.31"]
    command += ["--paths", "1000000", "--quiet", "--threads", "1", "--out", str(out)]
    process = launch(command)
    while not part.exists() and process.poll() is None:
        time.sleep(0.005)
    process.kill()
    process.wait()
    assert part.exists() and not out.exists()
    survived = Build.load(part)
    assert 0 < survived.paths < 1_000_000
    again = subprocess.run(command, capture_output=True, text=True)
    assert again.returncode == 1 and "--resume" in again.stderr
    subprocess.run([*command, "--resume"], check=True)
    assert not part.exists()
    tsdf.write(built(octahedron, Optics(1.31), paths=1_000_000), tmp_path / "whole.tsdf.exr")
    assert out.read_bytes() == (tmp_path / "whole.tsdf.exr").read_bytes()


def test_damaged_part_files_are_refused(octahedron: Grain, tmp_path: Path) -> None:
    """Cut, or with any byte of any consequence changed: dates in the archive may change."""
    part = tmp_path / "x.part"
    build = Build.start(octahedron, Optics(1.31), Effort(paths=10_000))
    build.run(octahedron, 1, (1, 2), part)
    data = part.read_bytes()
    rng = np.random.default_rng(0)
    for cut in (0, 10, len(data) // 2, len(data) - 1):
        part.write_bytes(data[:cut])
        with pytest.raises(TSDFError, match="not a whole part file"):
            Build.load(part)
    refused = 0
    for place in rng.integers(0, len(data), 20):
        damaged = bytearray(data)
        damaged[place] ^= 255
        part.write_bytes(bytes(damaged))
        try:
            again = Build.load(part)
        except TSDFError as error:
            assert "not a whole part file" in str(error) and "\n" not in str(error)
            refused += 1
        else:
            assert all(np.array_equal(v, again.tally.arrays()[k]) for k, v in build.tally.arrays().items())
    assert refused > 15
    with pytest.raises(TSDFError, match="no such file"):
        Build.load(tmp_path / "absent.part")


@pytest.mark.slow
def test_part_files_that_lie_are_refused(octahedron: Grain, tmp_path: Path) -> None:
    """Whole archives with a right digest, but of counts that no tracer can have made, or that would grow when read."""
    part = tmp_path / "x.part"
    build = Build.start(octahedron, Optics(1.31), Effort(paths=10_000, joint=1, memory=1))
    build.run(octahedron, 1, (1, 2), part)
    arrays = archive.read(part, scatterometer.PART_LIMIT)
    assert Build.load(part).paths == 8192

    def changed(
        name: str, place: tuple[int, ...] | None = None, value: float | np.ndarray = 0
    ) -> dict[str, np.ndarray]:
        values = np.array(value) if place is None else arrays[name].copy()
        if place is not None:
            values[place] = value
        return arrays | {name: values}

    def text(name: str, before: str, after: str) -> np.ndarray:
        stored = arrays[name].tobytes().decode()
        assert before in stored
        return np.frombuffer(stored.replace(before, after).encode(), np.uint8)

    theta = np.argwhere(arrays["theta"][0] > 0)[0, 0]
    lies = {
        "chunk numbers of another type": changed("done", None, arrays["done"].astype(float)),
        "paths twice": changed("done", None, np.array([[0, 8192], [0, 8192]])),
        "paths that were not traced": changed("done", None, np.array([[0, 8256]])),
        "negative paths": changed("done", None, np.array([[-64, 8128]])),
        "negative counts": changed("theta", (0, theta), -1),
        "light from nowhere": changed("theta", (0, theta), arrays["theta"][0, theta] + 1),
        "conditionals of other light": changed("cells", (5, T.AT_R), arrays["cells"][5, T.AT_R] + 1),
        "sums that overflow": changed("box", (0, 0, 0, 0, 0), 2**62),
        "a mean cosine of 2": changed("scalars", (0, T.COS_THETA), 2 * arrays["scalars"][0, T.SCATTERED]),
        "a record of nothing": changed("records", (0, 0, 3), math.nan),
        "a request of other types": changed("request", None, text("request", '"cells": 256', '"cells": 256.0')),
        "more records than there are": changed("request", None, text("request", '"joint": 1', '"joint": 9')),
        "a judgement that never comes": changed("request", None, text("request", '"judgement": 8', '"judgement": -8')),
        "another type": changed("cells", None, arrays["cells"].astype(np.int32)),
        "another shape": changed("cells", None, arrays["cells"][1:]),
        "one array more": arrays | {"more": np.zeros(3)},
        "one array less": {name: values for name, values in arrays.items() if name != "box"},
        "objects": changed("request", None, np.frombuffer(b"[1, 2]", np.uint8)),
    }
    for lie, stored in lies.items():
        archive.write(part, stored)
        with pytest.raises(TSDFError, match="not a whole part file"):
            Build.load(part)
            pytest.fail(lie)
    np.savez_compressed(tmp_path / "bomb.npz", theta=np.zeros(10**7))
    os.mkfifo(tmp_path / "fifo.npz")
    for name in ("bomb.npz", "fifo.npz"):
        with pytest.raises(TSDFError, match="not a whole part file"):
            Build.load(tmp_path / name)


def test_chunks_cover_all_paths_once() -> None:
    for paths in (1024, 8192, 8193, 3_000_000):
        limits = list(chunks(paths))
        assert limits[0][0] == 0 and limits[-1][1] == paths
        assert all(a[1] == b[0] for a, b in itertools.pairwise(limits))
        assert all(b - a <= max(CHUNK_MIN, a // 8) for a, b in limits)


# ------------------------------------------------------------------------------------------ effort and errors


@pytest.mark.slow
@pytest.mark.parametrize("target", [0.05, 0.01])
def test_target_error_is_met_in_truth(target: float) -> None:
    """The traced sphere's total variation to the exact density is what was asked for, and not much less.

    The truth is taken in 16 parts of each cell; the estimate may be a tenth too small at the rainbows.
    """
    table = built(load_grain("sphere"), Optics(1.33), target_error=target, seed=3)
    assert table.header["table_error"]["total_variation"] <= target
    edges = table.cos_theta_edges[1:-1]
    theta = np.arccos(edges)
    fine = np.append(np.cos((theta[:-1, None] + np.diff(theta)[:, None] * np.arange(16) / 16).ravel()), 1.0)
    truth = analytic.deflection_masses(fine, 1.33, "un").reshape(-1, 16)
    share = np.diff(fine).reshape(-1, 16)
    share = share / share.sum(axis=1, keepdims=True)
    variation = 0.5 * np.abs(truth - table.p_theta[1:-1, None] * share).sum()
    assert 0.5 * target < variation < 1.1 * target
    assert table.p_theta[0] == table.p_theta[-1] == 0.0


@pytest.mark.slow
def test_target_error_stops_at_the_same_path_for_any_threads(octahedron: Grain, tmp_path: Path) -> None:
    for threads in (1, 3):
        tsdf.write(built(octahedron, Optics(1.31), threads, target_error=0.05), tmp_path / f"{threads}.tsdf.exr")
    assert (tmp_path / "1.tsdf.exr").read_bytes() == (tmp_path / "3.tsdf.exr").read_bytes()


@pytest.mark.slow
def test_target_takes_no_more_paths_and_cells_than_needed(octahedron: Grain) -> None:
    """One chunk less, or one candidate of the cells less, does not meet the target."""
    target = 0.02
    build = Build.start(octahedron, Optics(1.31), Effort(target_error=target))
    build.run(octahedron, 2)
    error = build.error()
    assert error is not None and error.total_variation <= target
    fewer = [n for n in statistics.candidate_cells() if n < error.cells]
    assert all(statistics.table_error(build.tally, n).total_variation > target for n in fewer)
    before = max(first for first, _ in chunks(build.paths))
    shorter = Build.start(octahedron, Optics(1.31), Effort(paths=before))
    shorter.run(octahedron, 2)
    assert statistics.TableErrors(shorter.tally).fewest(target) is None


@pytest.mark.slow
def test_a_target_costs_a_handful_of_judgements(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of a few numbers of cells, on the way to where noise, falling as the root of the paths, lets it be met."""
    asked: list[int] = []
    estimated = statistics.TableErrors._estimate
    monkeypatch.setattr(
        statistics.TableErrors, "_estimate", lambda self, cells: asked.append(cells) or estimated(self, cells)
    )
    grain = load_grain("cube")
    build = Build.start(grain, Optics(1.31), Effort(target_error=0.008))
    build.run(grain, 2)
    assert build.paths > 200_000 and len(asked) < 120


@pytest.mark.slow
def test_unreachable_target_is_refused(octahedron: Grain) -> None:
    build = Build.start(octahedron, Optics(1.31), Effort(target_error=0.01, cells=8))
    with pytest.raises(UsageError, match="8 cells of theta alone cost"):
        build.run(octahedron, 2)
    finest = Build.start(octahedron, Optics(1.31), Effort(target_error=1e-4))
    with pytest.raises(UsageError, match="1024 cells of theta alone cost"):
        finest.run(octahedron, 2)
    assert finest.paths < 1_000_000


@pytest.mark.slow
def test_stated_errors_are_those_of_repeated_builds() -> None:
    """Forty builds with other seeds scatter as much as each says it does.

    Their standard deviation over the mean standard error has itself a relative error of 1 / sqrt(78) = 0.11 (and a
    little for the errors' own): within 0.55 .. 1.45 at four of these.
    """
    grain = load_grain("cube")
    tables = [built(grain, Optics(1.31), paths=16384, seed=seed) for seed in range(40)]
    for name in ("hit_probability", "mean_cosine", "mean_z", "mean_r", "mean_path_length", "atom_forward"):
        values = np.array([t.statistics[name] for t in tables])
        stated = np.array([t.header["standard_errors"][name] for t in tables])
        assert 0.55 < values.std(ddof=1) / stated.mean() < 1.45, name
    masses = np.array([t.p_theta for t in tables])
    variation = 0.5 * np.abs(masses - masses.mean(axis=0)).sum(axis=1).mean() * math.sqrt(40 / 39)
    stated = np.array([t.header["table_error"]["sampling_noise"] for t in tables])
    assert abs(variation / stated.mean() - 1.0) < 0.1


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"paths": 0}, "number of paths"),
        ({"paths": -5}, "number of paths"),
        ({"paths": 10**30}, "number of paths"),
        ({"target_error": 0.0}, "target error"),
        ({"target_error": math.nan}, "target error"),
        ({"paths": 5000, "target_error": 0.1}, "not both"),
        ({"cells": 4}, "cells of theta"),
        ({"joint": -1}, "joint records"),
        ({"memory": -1}, "cell of entry"),
        ({"memory": 1025}, "cell of entry"),
        ({"seed": -1}, "seed"),
        ({"max_bounces": 0}, "bounce limit"),
    ],
)
def test_impossible_efforts_are_refused(values: dict[str, float], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Effort(**values)  # type: ignore[arg-type]


def test_polarisations_are_not_kept_apart_for_meshes(octahedron: Grain) -> None:
    with pytest.raises(UsageError, match="exact sphere"):
        Build.start(octahedron, Optics(1.31, "sp"), Effort(paths=5000))


def test_a_grain_that_keeps_its_light_is_refused() -> None:
    grain = load_grain("icosphere", subdivisions=2)
    build = Build.start(grain, Optics(1.5), Effort(paths=100_000, max_bounces=3))
    with pytest.raises(GrainError, match="raise --max-bounces"):
        build.run(grain, 2)


# ------------------------------------------------------------------------------------------ physics


@pytest.mark.slow
@pytest.mark.parametrize("fresnel", ["un", "sp"])
def test_exact_table_is_the_exact_sphere(fresnel: str) -> None:
    table = scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33, fresnel), Effort(joint=256))
    truth = analytic.sphere_statistics(1.33, fresnel)
    for name in ("mean_cosine", "mean_z", "mean_r", "mean_path_length"):
        assert table.statistics[name] == getattr(truth, name)
    masses = analytic.deflection_masses(table.cos_theta_edges[1:-1], 1.33, fresnel)
    assert np.abs(table.p_theta[1:-1] - masses).max() < 1e-8
    for absorption in (0.001, 0.1, 1.0, 10.0):
        dark = analytic.sphere_statistics(1.33, fresnel, absorption)
        assert table.albedo(absorption) == pytest.approx(dark.albedo, abs=1e-5)
        assert table.mean_cosine(absorption) == pytest.approx(dark.mean_cosine, abs=1e-5)
        expected = analytic.deflection_masses(table.cos_theta_edges[1:-1], 1.33, fresnel, absorption)
        assert 0.5 * np.abs(table.deflection_masses(absorption)[1:-1] - expected).sum() < 1e-4
    # the records have the means of their columns
    weight = table.p_theta / table.joint["r"].shape[0]
    assert (table.joint["r"] @ weight).sum() == pytest.approx(truth.mean_r, abs=1e-3)
    assert (table.joint["z"] @ weight).sum() == pytest.approx(truth.mean_z, abs=1e-3)


# Convex solids inscribed in R = 1, Fresnel averaged, lossless: another program's 4e6 rays each. Its errors are of the
# mean cosine; those of <z> and <r> are not stated and taken to be as large.
SOLIDS = [
    ("hexprism", {"aspect": 1.0}, 1.31, (0.684213, 0.83191), (0.54237, 1.47024, 0.65206), 0.00033, 0.24),
    ("hexprism", {"aspect": 0.2}, 1.31, (0.581233, 1.00020), (0.74639, 1.51898, 0.43628), 0.00030, 0.55),
    ("hexprism", {"aspect": 3.0}, 1.31, (0.327829, 1.18359), (0.68442, 1.50416, 0.50310), 0.00043, None),
    ("cube", {}, 1.54, (0.636620, 0.84895), (0.44447, 1.38391, 0.70589), 0.00041, None),
    ("cube", {}, 1.31, (0.636620, 0.84895), (0.47403, 1.47317, 0.73104), 0.00036, 0.33),
    ("octahedron", {}, 1.31, (0.551329, 0.92483), None, None, None),
    ("tetrahedron", {}, 1.31, (0.367553, 1.09113), None, None, None),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameters", "eta", "geometry", "optics", "error", "atom"), SOLIDS)
def test_convex_solids(name, parameters, eta, geometry, optics, error, atom) -> None:  # type: ignore[no-untyped-def]
    """Two routes to each number: Cauchy's theorems and other people's rays."""
    grain = load_grain(name, **parameters)
    table = built(grain, Optics(eta), paths=400_000, seed=1)
    s, e = table.statistics, table.header["standard_errors"]
    assert abs(s["hit_probability"] - geometry[0]) < 4 * e["hit_probability"]
    assert s["hit_probability"] == pytest.approx(grain.area / (4 * math.pi), abs=4 * e["hit_probability"])
    assert abs(s["mean_miss_chord"] - geometry[1]) < 4 * e["mean_miss_chord"] + 5e-6
    bound = eta**2 * 4 * grain.volume / grain.area
    assert s["mean_path_length"] < bound + 4 * e["mean_path_length"]
    if optics is not None:
        for key, value in zip(("mean_cosine", "mean_z", "mean_r"), optics, strict=True):
            assert abs(s[key] - value) < 4 * math.hypot(e[key], error), key
    if atom is not None:
        assert s["atom_forward"] == pytest.approx(atom, abs=0.005)


def test_identity() -> None:
    """At eta = 1 nothing is deflected and the offset is the chord of the bounding sphere."""
    grain = load_grain("octahedron")
    table = built(grain, Optics(1.0), paths=50_000)
    s, e = table.statistics, table.header["standard_errors"]
    assert s["atom_forward"] == 1.0 and s["mean_cosine"] == pytest.approx(1.0, abs=1e-12)
    assert s["mean_r"] == pytest.approx(0.0, abs=1e-7)
    assert abs(s["mean_path_length"] - 4 * grain.volume / grain.area) < 4 * e["mean_path_length"]
    chord = (4 / 3 - (1 - s["hit_probability"]) * s["mean_miss_chord"]) / s["hit_probability"]
    assert abs(s["mean_z"] - chord) < 4 * e["mean_z"] + 1e-3


@pytest.mark.slow
def test_absorption_of_a_mesh_follows_the_sphere() -> None:
    """A fine icosphere's table, absorbing, is near the exact absorbing sphere: the facets cost a percent."""
    table = built(load_grain("icosphere", subdivisions=4), Optics(1.33), paths=200_000)
    for absorption in (0.01, 0.1, 1.0):
        truth = analytic.sphere_statistics(1.33, "un", absorption)
        # the facets let light in that a sphere would not, and keep it: short paths agree, long ones do not
        assert table.albedo(absorption) == pytest.approx(truth.albedo, abs=0.012)
        assert table.mean_cosine(absorption) == pytest.approx(truth.mean_cosine, abs=0.006)


@pytest.mark.slow
def test_icospheres_converge_to_the_sphere() -> None:
    """The total variation of the density falls as the root of the number of faces, first order in the edge length.

    In 1024 cells, where it is that of the density; coarser cells average over the facets and make it fall faster. The
    figures of another program (.107, .053, .025 for 320, 1280, 5120 faces) are of cells it does not name; 256 uniform
    in cos theta give .134, .050, .025.
    """
    variations = []
    for subdivisions in (2, 3, 4):
        table = built(load_grain("icosphere", subdivisions=subdivisions), Optics(1.33), paths=400_000, cells=1024)
        truth = analytic.deflection_masses(table.cos_theta_edges[1:-1], 1.33, "un")
        variations.append(0.5 * (np.abs(table.p_theta[1:-1] - truth).sum() + table.p_theta[0] + table.p_theta[-1]))
    slopes = np.diff(np.log(variations)) / np.log(4.0)
    assert np.all(np.abs(slopes + 0.5) < 0.12), (variations, slopes)


def test_mirror_sphere_is_isotropic() -> None:
    """As eta grows a sphere reflects everything at its surface, which scatters evenly into all directions."""
    table = built(load_grain("sphere"), Optics(1e9), paths=100_000, cells=16)
    expected = np.diff(table.cos_theta_edges) / 2.0
    assert np.abs(table.p_theta - expected).max() < 2e-3


def test_merging_cells_keeps_the_sums() -> None:
    tally = Tally()
    rng = np.random.default_rng(0)
    tally.theta[:] = rng.integers(0, 100, tally.theta.shape)
    for cells in (8, 100, 256, 1024):
        columns = statistics.columns_of(tally.theta, cells)
        assert columns.shape == (T.REPLICATES, cells + 2)
        assert np.array_equal(columns.sum(axis=1), tally.theta.sum(axis=1))
        assert np.array_equal(columns[:, 0], tally.theta[:, T.FINE + 1])
        assert np.array_equal(columns[:, -1], tally.theta[:, T.FINE])
        edges = statistics.cos_theta_edges(cells)
        assert np.all(np.diff(edges[1:-1]) > 0)


@pytest.mark.parametrize("cells", [8, 16, 100, 333, 512, 1024])
def test_parts_of_columns(cells: int) -> None:
    """Sums over parts, what they have beside their share of the column, and its variance, as numpy finds them."""
    tally = Tally()
    rng = np.random.default_rng(cells)
    tally.theta[:] = rng.integers(0, 1 << 30, tally.theta.shape)
    tally.scalars[:, T.SCATTERED] = tally.theta.sum(axis=1)
    errors = statistics.TableErrors(tally)
    columns = statistics.columns_of(errors._theta, cells)[:, -2:0:-1]
    for parts in (1, 2, 4):
        cuts, finer = errors._parts(cells, parts)
        assert (finer == np.add.reduceat(errors._theta[:, : T.FINE], cuts[:-1], axis=1)).all()
        assert parts > 1 or (finer == columns).all()
        share = rng.random((cells, parts))
        found = np.zeros((2, cells, parts))
        statistics._deviations(finer.reshape(-1, cells, parts), np.ascontiguousarray(columns), share, found)
        deviations = finer.reshape(-1, cells, parts) - columns[:, :, None] * share
        assert (found[0] == deviations.mean(axis=0)).all()
        assert found[1] == pytest.approx(deviations.var(axis=0, ddof=1) / T.REPLICATES, rel=1e-9)
    values = rng.normal(size=cells)
    window = min(17, cells)
    around = [values[max(0, i - window // 2) : i + (window + 1) // 2].mean() for i in range(cells)]
    assert statistics._pooled(values, window) == pytest.approx(np.array(around), rel=1e-9, abs=1e-12)


@pytest.mark.slow
def test_records_by_entry_keep_the_means_of_all_paths():
    """A chain of grains multiplies what its records get wrong, so the mean deflection and offset are those of the
    header, not of a sample of so many."""
    grain = load_grain("cube")
    build = Build.start(grain, Optics(1.31), Effort(100_000, cells=64, memory=16))
    build.run(grain)
    table = build.table()
    share = table.hit / table.hit.sum()
    means = {name: float(table.memory[name].mean(axis=0) @ share) for name in ("cos_theta", "r", "z")}
    sample = float(table.memory["cos_theta"].std()) / math.sqrt(table.memory["cos_theta"].size)
    s = table.statistics
    assert abs(means["cos_theta"] - s["mean_cosine"]) < 0.25 * sample
    assert abs(means["z"] - s["mean_z"]) < 0.02 and abs(means["r"] - s["mean_r"]) < 0.02


# ------------------------------------------------------------------------------------------ nothing is lost


@pytest.mark.slow
def test_a_target_that_is_met_is_met_when_resumed(octahedron: Grain, tmp_path: Path) -> None:
    """A build that was stopped after its target was met, before its table was made, asks for no more paths."""
    part = tmp_path / "x.part"
    build = Build.start(octahedron, Optics(1.31), Effort(target_error=0.05))
    build.run(octahedron, 2, part_file=part)
    again = Build.start(octahedron, Optics(1.31), Effort(target_error=0.05))
    again.take(Build.load(part), "x.part")
    again.run(octahedron, 1, part_file=part)
    assert again.paths == build.paths
    assert again.table().header == build.table().header


def test_means_lie_in_their_cells(tmp_path: Path) -> None:
    """A part of 5 units of energy alone in a cell of path length: its rounded moment puts the mean beside the cell."""
    tally = Tally()
    rest = T.UNIT - 5
    tally.scalars[:, [T.LAUNCHED, T.SCATTERED, T.COS_THETA]] = T.UNIT
    tally.scalars[:, T.MEAN_Z] = -T.UNIT
    tally.theta[:, 0] = T.UNIT  # straight on, from the first cells of r and z
    tally.cells[0, [T.AT_PHI, T.AT_R, T.AT_Z]] = 2 * T.UNIT * T.REPLICATES
    for length, energy in ((0.0, rest * T.REPLICATES), (0.5 / 16, 5), (1.45, 5), (2.05, 5), (1e6, 5)):
        cell = np.searchsorted(T.L_EDGES, length, side="right") - 1 if length else 0
        tally.cells[0, T.AT_L + min(cell, T.L - 1)] += energy
        tally.cells[0, T.AT_L_SUM + min(cell, T.L - 1)] += math.floor(energy * length + 0.5)
    grain = grain_header(load_grain("cube"))
    made = {"method": "traced", "command": "", "seed": 0, "paths": 64, "max_bounces": 1}
    table = assemble.traced_table(tally, 64, grain, Optics(1.31), made)
    tsdf.write(table, tmp_path / "t.tsdf.exr")
    assert table.block("mean_l")[24, -2] == 1.4375 != round(5 * 1.45) / 5  # the upper edge of its cell


@pytest.mark.slow
def test_random_builds_are_not_lost(tmp_path: Path) -> None:
    """A few of the builds of `fuzz/builds.py`, of which 0 of 2,000 may be lost."""
    place = Path(__file__).parents[2] / "fuzz" / "builds.py"
    spec = importlib.util.spec_from_file_location("builds", place)
    assert spec is not None and spec.loader is not None
    builds = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builds)
    assert [why for number in range(8) if (why := builds.lost(number, tmp_path))] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [{"OMP_NUM_THREADS": n, "OPENBLAS_NUM_THREADS": n} for n in "123"]
    + [{"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512F AVX512_SKX"}],
)
def test_bytes_do_not_depend_on_the_processor(
    octahedron: Grain, reference: bytes, parts: list[Path], environment: dict[str, str], tmp_path: Path
) -> None:
    """Neither the threads of BLAS nor the vector instructions of numpy and BLAS show in a merged table."""
    out = tmp_path / "m.tsdf.exr"
    command = [sys.executable, "-W", "ignore", "-c", "from tsdf.cli.merge import main; main()"]
    words = [*map(str, parts), "--quiet", "--out", str(out)]
    subprocess.run([*command, *words], check=True, env=os.environ | environment)
    assert out.read_bytes() == reference
