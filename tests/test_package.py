"""What is installed: a wheel that holds all it needs and nothing else, whose commands run outside the repository."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SCRIPTS = sorted(PROJECT["project"]["scripts"])
FOLDERS = {"tsdf": "tsdf", "cli": "tsdf/cli", "loaders": "tsdf/loaders", "schema": "tsdf/schema"}
FOLDERS |= {"reference_data": "tsdf/reference_data"}
MOST_BYTES = 4_500_000  # of the wheel: two of them ready tables, one the packings
MAKERS = ("atlas", "checks", "golden", "library", "observer", "vectors")  # scripts that stay out of the wheel


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a copy of the sources, in which no earlier build has left anything; nothing is downloaded."""
    sources, out = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("wheel")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    words = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--wheel-dir", out, sources]
    subprocess.run([sys.executable, "-m", "pip", *words], check=True)
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands of an environment of its own, which has the wheel and sees the packages that this one has."""
    home = tmp_path_factory.mktemp("clean")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home], check=True)
    (site,) = home.glob("lib/python*/site-packages")
    (site / "others.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    words = ["--python", home / "bin/python", "install", "--no-deps", "--no-index", "--quiet", wheel]
    subprocess.run([sys.executable, "-m", "pip", "--disable-pip-version-check", *words], check=True)
    return home / "bin"


def run(program: Path, *words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run([program, *words], capture_output=True, text=True, cwd=cwd, env=own)


def test_the_wheel_holds_what_is_needed(wheel: Path) -> None:
    """All modules, whatever room they are in, and the files that modules read; no golden files and what makes them."""
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    modules = {
        f"{inside}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, inside in FOLDERS.items()
        for path in (ROOT / folder).rglob("*.py")
    }
    makers = {f"tsdf/reference_data/make_{name}.py" for name in MAKERS}
    assert makers < modules
    assert {name for name in names if name.endswith(".py")} == modules - makers
    for name in (
        "py.typed",
        "loaders/tsdf.hpp",
        "schema/header.schema.json",
        "reference_data/observer.csv",
        "reference_data/packings.exr",
        "data/library/sugar.tsdf.exr",
    ):
        assert f"tsdf/{name}" in names
    assert not any("golden" in name for name in names)
    assert wheel.stat().st_size < MOST_BYTES


@pytest.mark.parametrize("script", SCRIPTS)
def test_each_command_says_help_and_version(script: str, installed: Path, tmp_path: Path) -> None:
    done = run(installed / script, "--help", cwd=tmp_path)
    assert done.returncode == 0 and f"Usage: {script}" in done.stdout and done.stderr == ""
    done = run(installed / script, "--version", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{script} {PROJECT['project']['version']}\n", "")


@pytest.mark.slow
def test_the_installed_package_works(installed: Path, tmp_path: Path) -> None:
    """A table is built, shown and judged (with reference data), far from the repository; packings are found."""
    where = run(installed / "python", "-c", "import tsdf; print(tsdf.__file__)", cwd=tmp_path)
    assert Path(where.stdout.strip()).is_relative_to(installed.parent)
    for script, *words in (
        ("tsdf-build", "sphere", "--eta", "1.333", "--fresnel", "sp", "--cells", "64", "--out", "s.tsdf.exr"),
        ("tsdf-info", "s.tsdf.exr"),
        ("tsdf-validate", "s.tsdf.exr"),
        ("tsdf-packing", "--info"),
    ):
        done = run(installed / script, *words, cwd=tmp_path)
        assert done.returncode == 0 and done.stderr == "", done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["s.tsdf.exr"]
