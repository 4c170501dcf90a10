"""``tsdf-plan`` as a user meets it."""

import json
import re
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from tsdf.cli.plan import main
from tsdf.plan import planner
from tsdf.reference_data.make_checks import CHECKS
from tsdf.study.candidates import Candidate

SCENE = (Path(__file__).parents[1] / "ball.toml").read_text()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(planner, "SECONDS", 0.8)
    monkeypatch.setattr(planner, "LEAST_PILOTS", 0.4)
    shutil.copy(CHECKS / "cube.tsdf.exr", tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


def run(folder: Path, *words: object) -> Result:
    return CliRunner().invoke(main, [str(folder / "scene.toml"), *map(str, words)], prog_name="tsdf-plan")


@pytest.mark.slow
def test_what_it_says(folder: Path) -> None:
    """Three lines, what the table needs, a table of all candidates; the same as a file."""
    result = run(folder, "--target", 0.1, "--out", folder / "plan.json", "--seconds", 10)
    assert result.exit_code == 0, result.stderr
    assert max(map(len, result.stdout.splitlines())) <= 120
    first, second, third, need, *rest = result.stdout.replace("\n  ", " ").splitlines()
    assert first.startswith("take ") and second.startswith("because ") and third.startswith("runner-up: ")
    assert need.startswith("table: ") and "--memory 64" in need
    facts = json.loads((folder / "plan.json").read_text())
    chosen = Candidate(facts["chosen"]["level"], facts["chosen"]["explicit_grains"])
    assert rest[2].split("  ")[0] == str(chosen) and first.startswith(f"take {chosen}")
    assert len(rest) - 2 == len(facts["candidates"]) and facts["target"] == 0.1
    assert facts["why"] == [first, second, third]
    assert all(one["seconds_to_target"] is None or one["seconds_to_target"] > 0.0 for one in facts["candidates"])
    told = re.search(r"planned in (\S+) s of free processors, (\S+) s by the clock\n", result.stderr)
    assert told is not None and float(told[1]) == pytest.approx(facts["planning_seconds"], abs=0.06)
    assert facts["planning_clock_seconds"] > 0.0 and float(told[2]) == pytest.approx(
        facts["planning_clock_seconds"], abs=0.06
    )


@pytest.mark.slow
def test_json(folder: Path) -> None:
    result = run(folder, "--target", 0.1, "--json", "--quiet")
    assert result.exit_code == 0 and json.loads(result.stdout)["seconds"] is None and result.stderr == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--target", "0"], "--target is an error of pixels"),
        (["--target", "2"], "--target is an error of pixels"),
        (["--target", "nan"], "--target is an error of pixels"),
        (["--seconds", "0"], "--seconds is a finite number above 0"),
        (["--out", "plan.txt"], "is to end in .json"),
        (["--width", "0"], "--width"),
    ],
)
def test_refused(folder: Path, words: list[str], said: str) -> None:
    """In one line, before anything is rendered."""
    result = run(folder, *words)
    assert result.exit_code == 2 and said in result.stderr and result.stderr.count("\n") == 1


def test_explicit_grains_are_the_plans(folder: Path) -> None:
    (folder / "scene.toml").write_text(SCENE.replace("[render]", "[render]\nexplicit_grains = 2"))
    result = run(folder)
    assert result.exit_code == 2 and "explicit_grains is what a plan chooses" in result.stderr
