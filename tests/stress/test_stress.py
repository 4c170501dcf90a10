"""tsdf-stress: the rule of verdicts, the naive alternatives without their fault, the quick form, what is written."""

import csv
import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import tsdf
from tsdf.cli.stress import FILES, ROWS, main
from tsdf.errors import UsageError
from tsdf.grain import exemplars
from tsdf.scene.medium import Component, free_path
from tsdf.stress import cells, naive, report, rows
from tsdf.stress import own as own_rows
from tsdf.stress.cells import FAILS, HOLDS, NAIVE, OURS, UNSURE, Measured, Row, Setting, verdict
from tsdf.study.ranking import mean_of

ROOT = Path(__file__).parents[2]
# Rows that take next to nothing, and what is known to fail in them
LIGHT = {
    "restart": {"no offset", "along the ray"},
    "grazing-restart": {"no offset", "along the ray"},
    "far": {"as it comes", "fixed offset"},
    "small": {"fixed offset"},
    "vertices": {"engine alone"},
    "hole": {"as it comes"},
    "half": {"half-precision CDF"},
    "ends-of-u": {"search from left"},
    "phi-edges": {"edges at 0"},
    "far-exits": {"teleport"},
}
HEAVY = {
    "counters": {"32-bit counters"},
    "trapped": {"cap 10", "cap 32"},
    "facets": {"1280 facets"},
    "inverted": {"as it comes"},
    "furnace": {"depth cap", "capped roulette"},
    "albedo-99999": {"depth cap"},
    "billions": {"capped roulette", "depth cap"},
    "leaps": {"leaps about p"},
    "thin": {"teleport", "4R/3f flights"},
    "grazing": {"teleport", "volume"},
    "dark": {"teleport"},
    "mirrors-bulk": {"teleport-memory"},
    "mixture": {"teleport-memory"},
    "thin-wall": {"untested jumps"},
    "touching": {"toggled medium"},
    "small-sun": {"explicit", "teleport-packed"},
}


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def failing(found: rows.Report) -> dict[str, set[str]]:
    return {one.row.name: {c.measured.method for c in one.cells if c.verdict == FAILS} for one in found.done}


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [(0.0, 0.0, HOLDS), (0.4, 0.29, HOLDS), (0.9, 0.1, UNSURE), (1.01, 0.0, FAILS), (1.1, 0.1, UNSURE),
     (-5.0, 1.3, FAILS), (5.0, 1.4, UNSURE), (0.0, 0.6, UNSURE), (math.nan, 0.0, cells.NOT)],
)  # fmt: skip
def test_verdicts_follow_from_the_figure(value: float, error: float, said: str) -> None:
    assert verdict(value, error, 1.0) == said


def test_none_of_many_is_known_to_one() -> None:
    assert cells.share("tracer", 0, 1000).error == pytest.approx(0.1)
    assert cells.share("tracer", 500, 1000).error == pytest.approx(100.0 * math.sqrt(0.25 / 1000.0))


def test_known_failures_are_documented() -> None:
    """Each names a heading of a page; rows have names of their own, and only what is ours can be known."""
    names = [row.name for row in rows.ROWS]
    assert len(set(names)) == len(names)
    for row in rows.ROWS:
        for method, where in row.known.items():
            file, _, heading = where.partition(", ")
            assert method in OURS
            assert re.search(rf"^## {re.escape(heading)}$", (ROOT / "docs" / file).read_text(), flags=re.M), where


def test_light_rows() -> None:
    """Ours hold, and what physics says of the others is seen."""
    setting = Setting(quick=True, threads=2, table=tsdf.library("salt"))
    found = rows.measure(rows.chosen(",".join(LIGHT), setting), setting)
    assert not found.broken and not found.notes
    assert all(cell.verdict == HOLDS for one in found.done for cell in one.cells if cell.ours and not cell.known
               and cell.measured.error * 5.0 <= one.row.limit)  # fmt: skip
    seen = failing(found)
    assert {name: seen[name] & bad for name, bad in LIGHT.items()} == LIGHT


@pytest.mark.slow
def test_quick_form(tmp_path: Path) -> None:
    """The command itself: nothing of ours fails where it is claimed to hold, what is known to fail does."""
    result = run("--quick", "--out", tmp_path, "--threads", 2)
    assert result.exit_code == 0, result.output
    sheet = list(csv.DictReader(io.StringIO((tmp_path / "stress.csv").read_text())))
    assert len({line["row"] for line in sheet}) >= 30
    bad: dict[str, set[str]] = {}
    for line in sheet:
        if line["verdict"] == FAILS:
            bad.setdefault(line["row"], set()).add(line["method"])
            assert line["ours"] == "False" or line["known"]
    expected = LIGHT | HEAVY
    assert {name: bad.get(name, set()) & methods for name, methods in expected.items()} == expected
    assert max(map(len, result.stdout.splitlines())) <= 120
    assert [name for name in FILES if not (tmp_path / name).exists()] == []


# ------------------------------------------------------------------------------ the naive without their fault


def test_the_naive_slab_is_right_but_for_its_ends() -> None:
    """With paths that end by leaving alone it sends back what Chandrasekhar says; H(1) without loss is his 2.9078."""
    h = [naive.h_function(1.0 - loss) for loss in (1e-4, 4e-4)]
    assert 2.0 * h[0] - h[1] == pytest.approx(2.9078, abs=5e-3)  # linear in the root of the loss
    fair = naive.isotropic_slab(40.0, 0.9, 100_000, np.random.default_rng(1), lambda event, weight, rng: weight)
    value, error = mean_of(fair.weight * fair.up)
    truth = 1.0 - naive.h_function(0.9) * math.sqrt(0.1)
    assert abs(value - truth) < 4.0 * error < 0.03 * truth
    short = naive.isotropic_slab(40.0, 0.9, 100_000, np.random.default_rng(1), naive.ended)
    assert mean_of(short.weight * short.up)[0] < truth - 4.0 * error


def test_no_jump_passes_what_is_thicker_than_a_grain() -> None:
    table, rng = tsdf.library("glass-beads"), np.random.default_rng(2)
    free = free_path([Component(table)], 0.5).lambda_beta
    assert naive.untested_jumps(table, free, 0.01, 2000, rng).mean() > 0.1
    assert not naive.untested_jumps(table, free, 3.0, 2000, rng).any()


# ------------------------------------------------------------------------------------------------- the report


def made_up(name: str, method: str, value: float, known: dict[str, str] | None = None, stop: bool = False) -> Row:
    def measure(setting: Setting) -> Iterator[Measured]:
        yield Measured(method, value, 0.1, "a note, with a comma")
        if stop:
            raise KeyboardInterrupt
        yield Measured("depth cap", -44.1, 0.5)

    return Row(name, "Made up", f"row {name}", "figure", "%", 1.0, measure, known or {})


@pytest.mark.parametrize(
    ("row", "status", "said"),
    [
        (made_up("good", "teleport", 0.1), 0, "holds teleport 0.10(10)"),
        (made_up("bad", "teleport", 5.0), 1, "FAILS though it is claimed to hold: bad, teleport"),
        (made_up("bad", "teleport", 5.0, {"teleport": "memory.md, How right it is"}), 0, "known teleport 5.00(10)"),
        (made_up("good", "teleport", 0.1, {"teleport": "memory.md, How right it is"}), 0, "holds here, though"),
        (made_up("bad", "depth cap", 5.0), 0, "FAILS depth cap 5.00(10)"),
    ],
)  # fmt: skip
def test_exit_status(row: Row, status: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1 only where a method of ours fails that is claimed to hold; what is written is whole."""
    monkeypatch.setattr(rows, "ROWS", (row,))
    result = run("--out", tmp_path)
    assert result.exit_code == status and said in result.stdout
    page = (tmp_path / "stress.md").read_text()
    assert f"| `{row.name}` {row.title} |" in page and "tsdf-stress" in page
    sheet = list(csv.DictReader(io.StringIO((tmp_path / "stress.csv").read_text())))
    assert [line["method"] for line in sheet][1] == "depth cap" and sheet[0]["note"] == "a note, with a comma"
    picture = ElementTree.parse(tmp_path / "stress.svg").getroot()
    assert any(element.text == row.title for element in picture.iter())


def test_nothing_is_claimed_of_a_named_table_but_conservation() -> None:
    """A failure in own-slab is shown, is nowhere said to be documented and does not count; in the others it does."""
    own = {row.name: row for row in rows.ROWS if row.group == own_rows.GROUP}
    assert not any(row.known for row in own.values())
    bad = {name: replace(row, measure=made_up("", "teleport", 9.0).measure) for name, row in own.items()}
    found = rows.measure(list(bad.values()), Setting())
    assert {row.name for row, _ in found.broken} == {"own-sums", "own-furnace"}
    lines = [line for line in report.page(found, "tsdf-stress").splitlines() if line.startswith("- layer of 10 R")]
    assert "`teleport` 9.00(10) % (nothing is claimed)" in lines[0]


def test_a_mesh_that_is_not_found_is_asked_for() -> None:
    """Also by rows that need it for one level only: the reason stands below them."""
    table = tsdf.library("salt")
    table = replace(table, header=table.header | {"grain": table.header["grain"] | {"name": "box.obj"}})
    setting = Setting(quick=True, threads=2, table=table)
    found = rows.measure(rows.chosen("own-slab", setting), setting)
    assert found.notes == ("own-slab: mesh of box.obj not found: --mesh FILE",)
    with pytest.raises(UsageError, match="mesh of box"):
        own_rows.check_mesh(setting)
    own_rows.check_mesh(Setting(table=tsdf.library("salt")))
    note = "mesh of box.obj not found: --mesh FILE"
    row = Row("a", "Made up", "b", "c", "%", 1.0, lambda s: iter([Measured("explicit", math.nan, note=note)]))
    assert f"\n- explicit: {note}\n" in report.terminal(rows.measure([row], Setting()))


@pytest.mark.parametrize(("columns", "widest"), [(200, 120), (120, 120), (90, 90), (30, 66)])
def test_the_table_fits_a_terminal(columns: int, widest: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is cut off: figures stand on a line of their own where there is no room."""
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr(rows, "ROWS", (made_up("a-row-with-a-name", "teleport-memory", 123456.7),))
    table = run().stdout.split("\n\n")[0]
    assert max(map(len, table.splitlines())) == widest
    assert "teleport-memory" in table and "123456.70(10)" in table


def test_help_names_all_rows() -> None:
    assert ROWS.split("\b")[1].split() == [row.name for row in rows.ROWS]
    assert "small-sun own-sums own-furnace own-slab\n" in run("--help").stdout


def test_an_interrupt_keeps_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = (
        made_up("one", "teleport", 0.1),
        made_up("two", "volume", 0.1, stop=True),
        made_up("three", "teleport", 0.1),
    )
    monkeypatch.setattr(rows, "ROWS", some)
    result = run("--out", tmp_path)
    assert result.exit_code == 130 and "interrupted: rows that follow are missing" in result.stdout
    text = (tmp_path / "stress.csv").read_text()
    assert "row one" in text and "row two" in text and "row three" not in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rows", "furnce"), "did you mean furnace?"),
        (("--rows", "quite else"), "no row 'quite else'; see tsdf-stress --help, which lists them\n"),
        (("scene.toml",), "is a scene; name a table"),
        (("--rows", "own-slab"), "it is about one table: name it"),
        (("--mesh", "x.stl"), "of the grain of a TABLE"),
        (("salt", "--mesh", "no.obj", "--rows", "own-slab"), "--mesh: no.obj: "),
        (("salt", "--mesh", ROOT, "--rows", "own-sums"), f"--mesh: {ROOT}: "),
        (("no.tsdf.exr",), "no.tsdf.exr"),
        (("snw",), "snw"),
        (("--threads", 0), "--threads"),
        (("--seed", -1), "--seed"),
    ],
)
def test_refused_in_one_line(arguments: tuple[object, ...], said: str) -> None:
    result = run(*arguments)
    assert result.exit_code in (1, 2) and said in result.stderr and result.stderr.count("\n") == 1


def test_a_row_that_cannot_be_measured_does_not_end_the_rest() -> None:
    def measure(setting: Setting) -> Iterator[Measured]:
        raise UsageError("no such thing")
        yield

    row = Row("none", "Made up", "none", "figure", "%", 1.0, measure)
    found = rows.measure([row, made_up("one", "teleport", 0.1)], Setting())
    assert found.notes == ("none: no such thing",) and [one.row.name for one in found.done] == ["one"]
    assert "cannot be measured: none: no such thing" in report.terminal(found)


@pytest.mark.parametrize(("arguments", "status"), [((), 0), (("--rows", "none,one,none"), 1)])
def test_a_row_that_is_named_is_measured_or_missed(
    arguments: tuple[str, ...], status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, however often it is named; that it cannot be is an error only if it is named."""

    def measure(setting: Setting) -> Iterator[Measured]:
        raise UsageError("no such thing")
        yield

    none = Row("none", "Made up", "none", "figure", "%", 1.0, measure)
    monkeypatch.setattr(rows, "ROWS", (none, made_up("one", "teleport", 0.1)))
    result = run(*arguments)
    assert result.exit_code == status and result.stdout.count("cannot be measured: none: no such thing") == 1


def test_the_mesh_of_another_grain_is_refused(tmp_path: Path) -> None:
    """At once, and not after all the rows that ask for no mesh."""
    vertices, faces = exemplars.cube(0.1)
    mesh = tmp_path / "cube.off"
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [" ".join(map(str, v)) for v in vertices] + [f"3 {' '.join(map(str, f))}" for f in faces]
    mesh.write_text("\n".join(lines) + "\n")
    result = run("salt", "--mesh", mesh, "--rows", "own-sums")
    assert result.exit_code == 1 and result.stderr.count("\n") == 1
    assert f"--mesh: {mesh} is not the grain the table was made of" in result.stderr


@pytest.mark.slow
def test_a_table_of_ones_own() -> None:
    """Rows about one table take a ready one by name; its levels are held against its own grain traced."""
    result = run("salt", "--quick", "--rows", "own-sums,own-furnace,half,drawn")
    assert result.exit_code == 0, result.output
    assert "own-furnace" in result.stdout and "FAILS teleport" not in result.stdout


def test_all_methods_are_told_apart() -> None:
    assert not set(OURS) & set(NAIVE) and len(set(cells.METHODS)) == len(OURS) + len(NAIVE)
