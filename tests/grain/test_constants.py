"""Optical constants from a user's own file: right values, one-line refusals."""

import math
import os
from pathlib import Path

import pytest

from tsdf.errors import TSDFError, UsageError
from tsdf.grain import constants
from tsdf.grain.constants import constants_of
from tsdf.grain.materials import optical_constants

ENTRY = """# comment
REFERENCES: |
    M. Daimon and A. Masumura.
    <a href="https://doi.org/10.1364/AO.46.003811"><i>Appl. Opt.</i> <b>46</b>, 3811-3820 (2007)</a>
DATA:
  - type: {kind}
    wavelength_range: {limits}
    coefficients: {coefficients}
  - type: tabulated k
    data: |
        0.5 1e-8
        0.6 1e-6
"""


def file(folder: Path, text: str, name: str = "m.csv") -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    "text",
    [
        "wavelength_nm,n,k\n500,1.5,1e-8\n600,1.4,1e-6\n",
        "\ufeff# measured by us\nWavelength (um); n; k\n0,6; 1,4; 1e-6\n0,5; 1,5; 1e-8\n",
        "lambda[µm]\tk\tn\n.5\t1e-8\t1.5\n\n.6\t1e-6\t1.4\n",
        "wl_m n k\n5e-7 1.5 1e-8\n6e-7 1.4 1e-6",
    ],
)
def test_tables_of_any_usual_form(text: str, tmp_path: Path) -> None:
    """Nodes are met; between them n is linear in 1 / wavelength^2 and log k in wavelength, as in `materials`."""
    name = file(tmp_path, text)
    found = constants_of(name, 500.0)
    assert (found.n, found.material, found.wavelength_nm) == (pytest.approx(1.5), "m.csv", 500.0)
    assert found.k == pytest.approx(1e-8)
    assert found.source == ("measured by us" if "#" in text else "file m.csv")
    between = constants_of(name, 550.0)
    assert between.k == pytest.approx(1e-7)
    share = (1 / 500**2 - 1 / 550**2) / (1 / 500**2 - 1 / 600**2)
    assert between.n == pytest.approx(1.5 - 0.1 * share)


def test_k_may_be_unknown(tmp_path: Path) -> None:
    """No column, no number where asked, or 0: None, None, 0."""
    assert constants_of(file(tmp_path, "wavelength_um,n\n0.5,1.5\n0.6,1.4\n"), 550).k is None
    some = file(tmp_path, "wavelength_um,n,k\n0.4,1.6,\n0.5,1.5,0\n0.6,1.4,0.02\n")
    assert constants_of(some, 450).k is None and constants_of(some, 500).k == 0.0
    assert constants_of(some, 550).k == pytest.approx(0.01)


def test_a_row_of_no_k_is_left_in_a_straight_line_and_said(tmp_path: Path) -> None:
    """Only beside it, and the source says where; between other rows, on rows and without such a row log k is linear."""
    text = "wavelength_nm,n,k\n400,1.3,0\n500,1.3,{}\n1000,1.3,1e-6\n1200,1.3,1e-4\n"
    none, little = (file(tmp_path, text.format(k), f"{k}.csv") for k in ("0", "1e-12"))
    for name, k in ((none, 4e-7), (little, 10 ** (-12 + 6 * 0.4))):
        found = constants.constants_over(name, [450.0, 700.0, 800.0, 1000.0, 1100.0])
        assert found[1].k == pytest.approx(k, rel=1e-9) and found[4].k == pytest.approx(1e-5, rel=1e-9), name
    assert constants.constants_over(none, [450.0])[0].k == 0.0
    linear = "; k at {} nm is linear from a row of k = 0 to the next"
    for name, asked, said in (
        (none, [450.0, 700.0, 800.0], linear.format("700 to 800")), (none, [700.0, 1100.0], linear.format("700")),
        (none, [500.0, 1000.0, 1100.0], ""), (little, [450.0], linear.format("450")), (little, [700.0, 1100.0], ""),
    ):  # fmt: skip
        sources = {found.source for found in constants.constants_over(name, asked)}
        assert len(sources) == 1 and sources.pop().startswith(f"file {Path(name).name}{said}"), (name, asked)
        assert said or constants_of(name, asked[0]).source == f"file {Path(name).name}"


# (formula, coefficients, wavelength [um], n): numbers of the sources, and formulas of round numbers by hand
FORMULAS = [
    (1, "0 1.03961212 0.0774642 0.231792344 0.1414846 1.01046945 10.1764754", 0.5875618, 1.5168, 5e-5),  # N-BK7
    (2, "0 1.03961212 0.00600069867 0.231792344 0.0200179144 1.01046945 103.560653", 0.5875618, 1.5168, 5e-5),
    (3, "2 1 2 0.5 -2", 0.5, math.sqrt(2 + 0.25 + 2), 1e-12),
    (4, "1 1 2 0.3 2 0.1 0 0.2 1 0.01 2", 1.0, math.sqrt(1 + 1 / 0.91 + 0.1 / 0.8 + 0.01), 1e-12),
    (5, "1.3 0.01 -2", 0.5, 1.34, 1e-12),
    (6, "0 0.05792105 238.0185 0.00167917 57.362", 0.633, 1.000276, 1e-6),  # air, Ciddor 1996, 15 C
    (7, "1.4 0.01 0.001 0.01 0 0", 0.8, 1.4 + 0.01 / 0.612 + 0.001 / 0.612**2 + 0.0064, 1e-12),
    (8, "0.2 0.1 0.04 0", 0.4, math.sqrt((1 + 2 * (0.2 + 0.016 / 0.12)) / (1 - (0.2 + 0.016 / 0.12))), 1e-12),
    (9, "2.5 0.02 0.03 0.02 1.5 0.9", 0.5, math.sqrt(2.5 + 0.02 / 0.22 - 0.02 / 1.9), 1e-12),
]


@pytest.mark.parametrize(("number", "coefficients", "wavelength", "n", "tolerance"), FORMULAS)
def test_the_formulas(
    number: int, coefficients: str, wavelength: float, n: float, tolerance: float, tmp_path: Path
) -> None:
    text = ENTRY.format(kind=f"formula {number}", limits="0.35 1.1", coefficients=coefficients)
    found = constants_of(file(tmp_path, text, "m.yml"), 1e3 * wavelength)
    assert found.n == pytest.approx(n, abs=tolerance)
    assert found.source == "M. Daimon and A. Masumura. Appl. Opt. 46, 3811-3820 (2007)"
    if 0.5 <= wavelength <= 0.6:
        assert found.k == pytest.approx(1e-8 * 100 ** ((wavelength - 0.5) / 0.1))
    else:
        assert found.k is None


def test_entries_with_tables(tmp_path: Path) -> None:
    """Published tables are taken as they are: in any order, noise below k = 0, a wavelength twice."""
    text = (
        "DATA:\n  - type: tabulated nk\n    data: |\n        0.6 1.4 1e-6\n        0.5 1.5 -1e-3\n        0.5 1.6 0\n"
    )
    found = constants_of(file(tmp_path, text, "m.yaml"), 500)
    assert (found.n, found.k, found.source) == (1.5, 0.0, "file m.yaml")


def test_names_win(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file(tmp_path, "wavelength_nm,n\n550,9\n", "ice")
    assert constants_of("ice", 550) == optical_constants("ice", 550)
    assert constants_of("./ice", 550).n == 9.0
    with pytest.raises(UsageError, match=r"'gold'; it is one of ice.* or the FILE .*--eta"):
        constants_of("gold", 550)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("m.csv", "", "empty"),
        ("m.csv", "wl,n,k\n0.5,1.5,0\n", "line 1: 'wl' does not name wavelength and its unit"),
        ("m.csv", "500,1.5,0\n", "line 1: '500' does not name wavelength"),
        ("m.csv", "wavelength_nm,k\n500,1.5\n", "no column n"),
        ("m.csv", "wavelength_nm,n\n", "no lines of numbers"),
        ("m.csv", "wavelength_nm,n\n500,1.5\n600,one\n", "line 3: '600,one' is not 2 numbers"),
        ("m.csv", "wavelength_nm,n,k\n550,1e31,0\n", "n is 1e+31 at 550 nm; it must be above 0"),
        ("m.csv", "wavelength_nm,n,k\n550,1.3,1e31\n", "k is 1e+31 at 550 nm; it must be 0 to 1e+30"),
        ("m.csv", "wavelength_nm,n\n500,1,5\n600,1,4\n", "line 2: '500,1,5' is not 2 numbers"),
        ("m.csv", "wavelength_nm,n,n\n500,1.5,1.6\n", "line 1: there are two columns n"),
        ("m.csv", f"wavelength_nm,n\n500,{'1' * 200_000}\n", "line 2: '500,1111"),
        ("m.csv", f"{'1' * 200_000},n\n500,1.5\n", "line 1: '' does not name wavelength"),
        ("m.csv", "wavelength_nm,n\n500,nan\n", "n is nan at 500 nm"),
        ("m.csv", "wavelength_nm,n\n500,0\n", "n is 0 at 500 nm"),
        ("m.csv", "wavelength_nm,n\n-500,1\n", "wavelength of -500 nm"),
        ("m.csv", "wavelength_nm,n,k\n500,1.5,-0.1\n", "k is -0.1 at 500 nm"),
        ("m.csv", "wavelength_nm,n\n500,1.5\n500,1.6\n", "two values of n at 500 nm"),
        ("m.yml", "DATA: [", "not YAML"),
        ("m.yml", "[" * 100_000, "not"),
        ("m.yml", "a: 1", "no list DATA"),
        ("m.yml", "DATA: [1, 2]", "no list DATA"),
        ("m.yml", "DATA: [{type: formula 10}]", "not one of its formulas"),
        ("m.yml", "DATA: [{type: formula 2, coefficients: 0 1 2}]", "wavelength_range or coefficients are missing"),
        ("m.yml", "DATA: [{type: formula 2, wavelength_range: 0.1 1, coefficients: a b}]", "coefficients: not numbers"),
        ("m.yml", "DATA: [{type: formula 2, wavelength_range: 0.1 1, coefficients: -9}]", "n is nan at 550"),
        ("m.yml", "DATA: [{type: tabulated k, data: 0.5 1}]", "no n in its DATA"),
        ("m.yml", "DATA: [{type: tabulated n, data: 0.5 1 2}]", "row 1 of DATA"),
        ("m.yml", "!!python/object/apply:os.system ['false']", "not YAML"),
    ],
)
def test_what_is_no_table_is_refused(name: str, text: str, said: str, tmp_path: Path) -> None:
    path = file(tmp_path, text, name)
    with pytest.raises(TSDFError) as caught:
        constants_of(path, 550.0)
    assert said in str(caught.value) and str(caught.value).startswith(path) and "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.csv")
    (tmp_path / "latin.csv").write_bytes(b"wavelength_\xb5m,n\n")
    with (tmp_path / "large.csv").open("wb") as large:
        large.truncate(constants.LARGEST + 1)
    for name, said in (
        ("fifo.csv", "not a regular file"),
        ("latin.csv", "UTF-8"),
        ("large.csv", "more than"),
        ("none.csv", "no such file, and no built-in material; these are ice"),
    ):
        with pytest.raises(TSDFError, match=said):
            constants_of(str(tmp_path / name), 550.0)
    with pytest.raises(UsageError, match="must be 500 to 600 nm, not 700"):
        constants_of(file(tmp_path, "wavelength_nm,n\n500,1.5\n600,1.4\n"), 700.0)
