"""tsdf-preview: one picture and what it says, and what is refused in one line."""

from pathlib import Path

import PIL.Image
import pytest
from click.testing import CliRunner, Result

from tsdf.cli.preview import main
from tsdf.cli.spectral import is_table
from tsdf.errors import FormatError
from tsdf.reference_data.make_checks import CHECKS

CUBE = CHECKS / "cube_memory.tsdf.exr"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.mark.slow
def test_a_table_gives_a_picture(tmp_path: Path) -> None:
    """Each thing has a line with a level on standard output, and the picture is one."""
    result = run(CUBE, "--out", tmp_path / "p.png", "--absorption", "0.01,0.02,0.1/R", "--seconds", 0.1)
    assert result.exit_code == 0, result.output
    lines = [line for line in result.stdout.splitlines() if "take level " in line]
    assert [line.split(":")[0].strip() for line in lines] == [
        "single grains", "ball", "slab, lit side", "slab, from behind", "heap, near", "heap, far",
    ]  # fmt: skip
    assert "explicit here" in lines[0] and "--explicit-grains" in lines[4] and "deep colour" in result.stdout
    with PIL.Image.open(tmp_path / "p.png") as picture:
        assert picture.width > 1000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((CUBE, "--packing-fraction", 0.7), "at most 0.64"),
        ((CUBE, "--packing-fraction", "nan"), "at most 0.64"),
        ((CUBE, "--seconds", 0), "above 0"),
        ((CUBE, "--eta", 1.5), "of a GRAIN"),
        ((CUBE, "--material", "ice", "--absorption", "1/R"), "give one"),
        ((CUBE, "--material", "quartz"), "no absorbing material"),
        ((CUBE, "--absorption", "much"), "--absorption is"),
        ((CUBE, "--radius", "5 furlongs"), "is not a length"),
        ((CUBE, "--out", "p.jpg"), ".png"),
        (("no.tsdf.exr",), "no.tsdf.exr"),
        (("snw",), "snw"),
    ],
)
def test_refused_in_one_line(
    arguments: tuple[object, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is computed, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code in (1, 2) and said in result.stderr
    assert result.stderr.startswith("tsdf-preview: error: ") and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_ready_table_by_name() -> None:
    """It is taken for a table, unlike a built-in grain and what is neither; what is of grains alone is refused."""
    assert is_table("sugar") and is_table("x.tsdf.exr") and not is_table("sand")
    with pytest.raises(FormatError, match="did you mean sugar"):
        is_table("sugra")
    result = run("sugar", "--eta", 1.5)
    assert result.exit_code == 2 and "not of a table" in result.stderr
