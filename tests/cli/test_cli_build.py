"""``tsdf-build`` and ``tsdf-merge`` as a user meets them: what they print, refuse and leave behind."""

import errno
import importlib
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import tsdf
from tsdf.cli import common
from tsdf.cli.build import main as build
from tsdf.cli.build import told
from tsdf.cli.info import main as info
from tsdf.cli.merge import main as merge
from tsdf.cli.validate import main as validate
from tsdf.make.scatterometer import Build

FAST = ["--eta", "1.31", "--paths", "10000", "--quiet"]


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(build, [str(word) for word in words], prog_name="tsdf-build")


def one_line(result: Result) -> str:
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.stdout == "" and result.stderr.count("\n") == 1, result.stderr
    return result.stderr


@pytest.mark.slow
def test_sphere(tmp_path: Path) -> None:
    out = tmp_path / "s.tsdf.exr"
    result = run("sphere", "--eta", "1.33", "--out", out)
    assert result.exit_code == 0 and "0.766749" in result.stdout and result.stderr == ""
    assert [p.name for p in tmp_path.iterdir()] == [out.name]
    table = tsdf.read(out)
    assert table.header["provenance"]["method"] == "exact"
    assert table.header["provenance"]["command"] == "tsdf-build sphere --eta 1.33 --fresnel un"


@pytest.mark.slow
def test_the_recorded_command_makes_the_same_bytes(tmp_path: Path) -> None:
    first, second = tmp_path / "1.exr", tmp_path / "2.exr"
    words = [
        "hexprism",
        "--set",
        "aspect=0.5",
        "--material",
        "ice",
        "--wavelength-nm",
        "600",
        "--joint",
        "3",
        "--memory",
        "2",
    ]
    assert run(*words, "--paths", "12000", "--quiet", "--out", first).exit_code == 0
    command = tsdf.read(first).header["provenance"]["command"].split()
    assert command[0] == "tsdf-build"
    assert run(*command[1:], "--quiet", "--threads", "1", "--out", second).exit_code == 0
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.slow
def test_material_is_recorded(tmp_path: Path) -> None:
    out = tmp_path / "s.exr"
    assert run("sphere", "--material", "ice", "--wavelength-nm", "600", "--out", out).exit_code == 0
    optics = tsdf.read(out).header["optics"]
    assert optics["eta"] == pytest.approx(1.3094, abs=1e-4) and optics["k"] == pytest.approx(5.73e-9, rel=0.01)
    assert optics["material"] == "ice" and "Warren" in optics["source"]


@pytest.mark.slow
def test_progress_and_summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no terminal shows a bar, a line now and then says how far it is: here at every look."""
    for name in ("EVERY_S", "LEAST_S"):
        monkeypatch.setattr(common, name, 0.0)
    result = run("cube", "--material", "ice", "--paths", "20000", "--out", tmp_path / "c.exr")
    assert result.exit_code == 0
    assert re.search(r"^100 %, 2e\+04 paths, .* paths/s, total variation .* cells \[0:\d\d\]$", result.stderr, re.M)
    for line in ("light lost or cut off", "as built in", "12 facets, convex", "fills   0.3676", "1.311, ice at 550 nm"):
        assert line in result.stdout
    quiet = run("cube", *FAST, "--out", tmp_path / "q.exr")
    assert quiet.exit_code == 0 and quiet.stdout == quiet.stderr == ""


def test_progress_says_the_error_and_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it stands, the goal, and once, if it will take long, how long."""
    from tsdf.make.scatterometer import Progress
    from tsdf.make.statistics import TableError

    class Recorder(common.Progress):
        def __call__(self, share: float, word: str) -> None:
            heard.append((share, word))

        def note(self, text: str) -> None:
            noted.append(text)

    heard: list[tuple[float, str]] = []
    noted: list[str] = []
    tell = told(Recorder(), 0.01)
    clock = iter((0.0, 10.0, 20.0))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    tell(Progress())
    for paths in (1000, 2000):
        tell(Progress(paths, 10**6, 0, TableError(64, 0.02, 0.01)))
    assert heard[0] == (0.0, "0 paths, 0 paths/s")
    assert heard[2] == (0.002, "2e+03 paths, 1e+02 paths/s, total variation 0.03 of 0.01, 64 cells")
    (note,) = noted
    assert note.startswith("--target-error 0.01 takes about 1.0e+06 paths, 166 minutes more")


def test_a_quality_says_how_long_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, by the pace since the first paths, compiling left out; and not before the error says how many it takes."""
    from tsdf.make.scatterometer import Progress
    from tsdf.make.statistics import TableError

    noted: list[str] = []

    class Recorder(common.Progress):
        def __call__(self, share: float, word: str) -> None:
            pass

        def note(self, text: str) -> None:
            noted.append(text)

    tell = told(Recorder(quiet=True), 0.01, "draft")
    clock = iter((0.0, 60.0, 61.0, 62.0, 63.0))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    tell(Progress())
    for paths, error in ((1000, 0.05), (2000, 0.04), (3000, 0.015), (4000, 0.015)):
        assert not noted or paths > 3000
        tell(Progress(paths, 33_000, 0, TableError(64, error, 0.0)))
    (note,) = noted
    assert note.startswith("--quality draft: about 3.3e+04 paths at 1.0e+03 a second, 30 s more, to a factor of two")


@pytest.mark.slow
def test_a_quality_is_a_target_and_records(tmp_path: Path) -> None:
    """Records may be said otherwise; what else says how much to trace contradicts it, in one line."""
    for words, joint, memory in (((), 8, 32), (("--joint", "4", "--memory", "0"), 4, 0)):
        out = tmp_path / f"{joint}.tsdf.exr"
        assert run("sphere", "--eta", "1.3", "--out", out, "--quality", "draft", *words).exit_code == 0
        table = tsdf.read(out)
        assert table.header["table_error"]["total_variation"] <= 0.02
        assert bool(table.memory) == bool(memory) and f"--joint {joint}" in table.header["provenance"]["command"]
    for words in (("--paths", "1e5"), ("--target-error", "0.1")):
        assert "not both" in one_line(run("cube", "--out", tmp_path / "c.tsdf.exr", "--quality", "good", *words))
    assert "--chunk" in one_line(run("cube", "--out", tmp_path / "c", "--quality", "good", "--chunk", "1/2"))


@pytest.mark.slow
def test_max_seconds_and_then_more(tmp_path: Path) -> None:
    """The table as good as it got, the paths kept, and from them any other table."""
    out = tmp_path / "x.exr"
    words = ["cube", "--eta", "1.31", "--out", str(out)]
    result = run(*words, "--target-error", "1e-3", "--max-seconds", "0")
    assert result.exit_code == 0 and out.exists() and Path(f"{out}.part").exists()
    assert "target error 0.001 is not met after" in result.stderr and "--resume goes on" in result.stderr
    assert "total variation to the truth" in result.stdout
    result = run(*words, "--target-error", "1e-5", "--resume", "--quiet")
    assert result.exit_code == 2 and "out of reach" in one_line(result) and "are kept in" in result.stderr
    assert Path(f"{out}.part").exists()
    result = run(*words, "--target-error", "0.5", "--resume", "--quiet")
    assert result.exit_code == 0 and not Path(f"{out}.part").exists()
    assert tsdf.read(out).header["table_error"]["total_variation"] <= 0.5
    part = ["cube", "--eta", "1.31", "--paths", "1e7", "--chunk", "1/2", "--out", tmp_path / "1.part"]
    result = run(*part, "--max-seconds", "0")
    assert (
        result.exit_code == 0 and "of 4920960 paths are done" in result.stderr and "--resume goes on" in result.stderr
    )
    result = run("sphere", "--max-seconds", "1", "--out", tmp_path / "s.exr")
    assert result.exit_code == 2 and "--traced" in one_line(result)


def test_a_grain_whose_name_has_a_line_break(tmp_path: Path) -> None:
    """Such a name is a file's right: it is escaped where a header has room for one line only."""
    from tsdf.grain.grains import load_grain

    grain, path = load_grain("octahedron"), tmp_path / "o\n.obj"
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in grain.vertices.tolist()]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (grain.faces + 1).tolist())]))
    assert run(path, *FAST, "--out", tmp_path / "x.exr").exit_code == 0
    assert tsdf.read(tmp_path / "x.exr").header["grain"]["name"] == "o\\n.obj"


def test_grains_are_listed() -> None:
    result = CliRunner().invoke(build, ["--grains"])
    assert result.exit_code == 0
    for name in ("sphere", "cube", "hexprism", "octahedron", "ellipsoid", "sand", "snow"):
        assert f"{name}: " in result.stdout
    assert "bevel=0 " in result.stdout and "gamma=35" in result.stdout


@pytest.mark.slow
def test_parts_and_merge(tmp_path: Path) -> None:
    parts = []
    for i in (1, 2):
        parts.append(str(tmp_path / f"{i}.part"))
        assert run("cube", *FAST, "--chunk", f"{i}/2", "--out", parts[-1]).exit_code == 0
    whole, merged = tmp_path / "whole.exr", tmp_path / "merged.exr"
    assert run("cube", *FAST, "--out", whole).exit_code == 0
    result = CliRunner().invoke(merge, [*parts[::-1], "--out", str(merged), "--quiet"])
    assert result.exit_code == 0 and merged.read_bytes() == whole.read_bytes()
    result = CliRunner().invoke(merge, [parts[0], "--out", str(tmp_path / "x.exr")])
    assert result.exit_code == 1 and "missing" in one_line(result)
    assert not (tmp_path / "x.exr").exists()
    for command in (info, validate):
        result = CliRunner().invoke(command, [parts[0]])
        assert result.exit_code == 1 and "a part of a build, of which tsdf-merge makes a table" in result.output


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_says_what_is_safe(number: int, tmp_path: Path, launch: Callable[..., subprocess.Popen]) -> None:
    out = tmp_path / "i.tsdf.exr"
    command = [sys.executable, "-c", "from tsdf.cli.build import main; main()"]
    command += ["cube", "--eta", "1.31", "--paths", "1e9", "--threads", "1", "--quiet", "--out", str(out)]
    process = launch(command, stderr=subprocess.PIPE, text=True)
    while not Path(f"{out}.part").exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(1.0)  # counts that are in no file yet
    process.send_signal(number)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert message.count("\n") == 1 and "--resume" in message
    said = re.search(r"(\d+) paths are safe", message)
    assert said is not None and Build.load(Path(f"{out}.part")).paths == int(said[1])
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["cube", "--eta", "0"], 2, "eta"),
        (["cube", "--eta", "nan"], 2, "eta"),
        (["cube", "--eta", "-1.3"], 2, "eta"),
        (["cube", "--paths", "0"], 2, "paths"),
        (["cube", "--paths", "1e30"], 2, "paths"),
        (["cube", "--paths", "1.5"], 2, "whole number"),
        (["cube", "--paths", "many"], 2, "whole number"),
        (["cube", "--memory", "-1"], 2, "cell of entry"),
        (["cube", "--memory", "some"], 2, "whole number"),
        (["cube", "--chunk", "3/2"], 2, "--chunk"),
        (["cube", "--chunk", "1/2", "--target-error", "0.1"], 2, "--paths"),
        (["cube", "--eta", "1.3", "--material", "ice"], 2, "not both"),
        (["cube", "--material", "gold"], 2, "sucrose"),
        (["cube", "--material", "ice", "--wavelength-nm", "3"], 2, "wavelength"),
        (["cube", "--eta", "1.3", "--wavelength-nm", "500"], 2, "--material"),
        (["cube", "--fresnel", "sp", "--paths", "5000"], 2, "sphere"),
        (["cube", "--fresnel", "xx"], 2, "--fresnel"),
        (["cube", "--set", "bevel=2"], 2, "bevel"),
        (["cube", "--set", "bevvel=0.1"], 2, "bevel"),
        (["cube", "--set", "bevel"], 2, "NAME=VALUE"),
        (["cube", "--traced"], 2, "sphere"),
        (["cube", "--threads", "0"], 2, "threads"),
        (["cube", "--no-such-option"], 2, "--no-such-option"),
        (["sphere", "--paths", "5000"], 2, "--traced"),
        pytest.param(["sphere", "--target-error", "1e-6"], 2, "out of reach", marks=pytest.mark.slow),
        (["no-such-grain"], 1, "built-in grains"),
    ],
)
def test_bad_requests(words: list[str], status: int, said: str, tmp_path: Path) -> None:
    result = run(*words, "--out", tmp_path / "x.exr")
    assert result.exit_code == status
    assert said in one_line(result)
    assert not list(tmp_path.iterdir())


def test_unwritable_outputs(tmp_path: Path) -> None:
    for out in (tmp_path / "none" / "x.exr", tmp_path, Path("/dev/full")):
        result = run("cube", *FAST, "--out", out)
        assert result.exit_code == 1 and "cannot write" in one_line(result)


def test_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The part file cannot be moved into place: one line, nothing half-written, what stood there stays."""
    out = tmp_path / "x.exr"
    out.write_bytes(b"before")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    result = run("cube", *FAST, "--out", out)
    assert result.exit_code == 1 and "No space left" in one_line(result)
    assert [p.name for p in tmp_path.iterdir()] == ["x.exr"] and out.read_bytes() == b"before"


@pytest.mark.slow
def test_unfinished_builds_are_not_lost(tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    assert run("cube", *FAST, "--chunk", "1/2", "--out", f"{out}.part").exit_code == 0
    kept = Path(f"{out}.part").read_bytes()
    result = run("cube", *FAST, "--out", out)
    assert result.exit_code == 1 and "--resume" in one_line(result)
    result = run("cube", "--eta", "1.5", "--paths", "10000", "--quiet", "--resume", "--out", out)
    assert result.exit_code == 1 and "differ in optics" in one_line(result)
    assert Path(f"{out}.part").read_bytes() == kept
    assert run("cube", *FAST, "--resume", "--out", out).exit_code == 0
    assert not Path(f"{out}.part").exists()


@pytest.mark.slow
def test_meshes_from_files(tmp_path: Path) -> None:
    """The same octahedron as a file, at another size and place, is the same table to the rounding of the file."""
    from tsdf.grain.grains import load_grain

    grain = load_grain("octahedron")
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in (grain.vertices * 1e-6 + 1e-3).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (grain.faces + 1).tolist()]
    (tmp_path / "o.obj").write_text("\n".join(lines))
    assert run(tmp_path / "o.obj", *FAST, "--out", tmp_path / "file.exr").exit_code == 0
    assert run("octahedron", *FAST, "--out", tmp_path / "named.exr").exit_code == 0
    one, other = tsdf.read(tmp_path / "file.exr"), tsdf.read(tmp_path / "named.exr")
    assert one.header["grain"]["name"] == "o.obj" and one.header["grain"]["bounding_radius"] == pytest.approx(1e-6)
    assert np.abs(one.p_theta - other.p_theta).max() < 1e-5
    for name in ("mean_cosine", "mean_r", "hit_probability", "mean_path_length"):
        assert one.statistics[name] == pytest.approx(other.statistics[name], abs=1e-5)


def test_open_mesh_and_repair(tmp_path: Path) -> None:
    from tsdf.grain.grains import load_grain

    grain = load_grain("icosphere", subdivisions=2)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in grain.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (grain.faces[1:] + 1).tolist()]
    (tmp_path / "open.obj").write_text("\n".join(lines))
    result = run(tmp_path / "open.obj", *FAST, "--out", tmp_path / "x.exr")
    assert result.exit_code == 1 and "3 boundary edges" in one_line(result) and "--repair" in result.stderr
    words = ["--eta", "1.31", "--paths", "10000", "--repair"]
    result = run(tmp_path / "open.obj", *words, "--out", tmp_path / "x.exr")
    assert result.exit_code == 0 and "note: repair" in result.stderr
    assert any("repair" in note for note in tsdf.read(tmp_path / "x.exr").header["grain"]["notes"])


def test_inputs_are_not_overwritten(tmp_path: Path) -> None:
    part = tmp_path / "1.part"
    assert run("cube", *FAST, "--chunk", "1/1", "--out", part).exit_code == 0
    kept = part.read_bytes()
    result = CliRunner().invoke(merge, [str(part), "--out", str(part)])
    assert result.exit_code == 2 and "is an input" in one_line(result)
    assert part.read_bytes() == kept
    mesh = tmp_path / "m.obj"
    mesh.write_text("v 0 0 0")
    result = run(mesh, *FAST, "--out", mesh)
    assert result.exit_code == 2 and "is an input" in one_line(result)
    assert mesh.read_text() == "v 0 0 0"


@pytest.mark.slow
def test_more_parts_than_chunks(tmp_path: Path) -> None:
    """A job array may be larger than the work: its idle jobs leave parts that merge like the others."""
    words = ["cube", "--eta", "1.31", "--paths", "8192", "--quiet"]
    parts = [str(tmp_path / f"{i}.part") for i in (1, 2, 3)]
    for i, part in enumerate(parts, 1):
        assert run(*words, "--chunk", f"{i}/3", "--out", part).exit_code == 0
    result = CliRunner().invoke(merge, [*parts, "--out", str(tmp_path / "m.exr"), "--quiet"])
    assert result.exit_code == 0
    assert run(*words, "--out", tmp_path / "w.exr").exit_code == 0
    assert (tmp_path / "m.exr").read_bytes() == (tmp_path / "w.exr").read_bytes()


@pytest.mark.slow
def test_refused_builds_leave_nothing_in_the_way(tmp_path: Path) -> None:
    out = tmp_path / "x.exr"
    result = run("icosphere", "--eta", "1.5", "--paths", "20000", "--max-bounces", "2", "--quiet", "--out", out)
    assert result.exit_code == 1 and "raise --max-bounces" in one_line(result)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_part_files_are_not_replaced(tmp_path: Path) -> None:
    """Whoever gives a part file as --out, to --resume perhaps, loses no paths, whatever the command."""
    from tsdf.cli.plot import main as plot

    part, other = tmp_path / "t.exr.part", tmp_path / "other.part"
    for i, path in enumerate((part, other), 1):
        assert run("cube", *FAST, "--chunk", f"{i}/2", "--out", path).exit_code == 0
    picture, table = tmp_path / "p.png", tmp_path / "t.exr"
    picture.hardlink_to(other)
    kept = part.read_bytes(), other.read_bytes()
    results = [run("cube", *FAST, "--resume", "--out", part), run("sphere", "--out", part)]
    results.append(CliRunner().invoke(merge, [str(other), "--out", str(part)]))
    assert run("sphere", "--out", table).exit_code == 0
    results.append(CliRunner().invoke(plot, [str(table), "--out", str(picture)]))
    for result in results:
        assert result.exit_code == 1 and "holds paths of an unfinished build" in one_line(result)
    assert (part.read_bytes(), other.read_bytes()) == kept
    assert run("cube", *FAST, "--chunk", "1/2", "--resume", "--out", part).exit_code == 0
    assert run("cube", *FAST, "--resume", "--out", table).exit_code == 0 and not part.exists()


def test_a_full_standard_output_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table is written, so nothing is unfinished, whoever reads of it."""
    monkeypatch.setattr(importlib.import_module("tsdf.cli.build"), "say", full)
    result = run("cube", *FAST[:-1], "--out", tmp_path / "c.exr")
    assert result.exit_code == 1 and one_line(result).endswith("No space left on device\n")
    assert [path.name for path in tmp_path.iterdir()] == ["c.exr"]


def full(_: str) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_an_unfinished_target_is_no_table(tmp_path: Path) -> None:
    from tsdf.grain.grains import load_grain
    from tsdf.grain.optics import Optics
    from tsdf.make.scatterometer import Build, Effort

    grain = load_grain("cube")
    whole = Build.start(grain, Optics(1.31), Effort(target_error=0.02))
    whole.run(grain, part_file=tmp_path / "x.part")
    unfinished = Build.start(grain, Optics(1.31), Effort(target_error=0.001))
    unfinished.tally, unfinished.done = whole.tally, whole.done
    unfinished.save(tmp_path / "y.part")
    result = CliRunner().invoke(merge, [str(tmp_path / "y.part"), "--out", str(tmp_path / "y.exr")])
    assert result.exit_code == 1 and "not met" in one_line(result)
    assert not (tmp_path / "y.exr").exists()


@pytest.mark.parametrize("command", ["build", "merge"])
def test_little_memory_is_one_line(command: str, tmp_path: Path) -> None:
    """With an address space in which the libraries crash or hang, the command says so before it loads them."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (500_000_000, 500_000_000))

    code = f"from tsdf.cli.{command} import main; main()"
    words = [sys.executable, "-c", code, "cube", "--out", str(tmp_path / "x.exr")]
    done = subprocess.run(words, preexec_fn=limit, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(rf"tsdf-{command}: error: not enough memory: ulimit -v is 476 MiB, .*\n", done.stderr)
