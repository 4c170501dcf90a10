"""No command destroys what it reads, however that is spelled, and what cannot be written is told before any work."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from tsdf.cli.export import TARGETS
from tsdf.picture import image
from tsdf.reference_data.make_checks import CHECKS

CUBE = """
o cube
mtllib cube.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 1 4 3 2
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""
SCENE = """
[camera]
position = [0.0, -9.0, 3.0]
target = [0.0, 0.0, 0.0]
width = 4
height = 4
[[light]]
type = "environment"
file = "{sky}"
[[medium]]
packing_fraction = 0.4
radius = 0.1
shape = {{ type = "mesh", file = "{shape}" }}
[[medium.grain]]
table = "{table}"
[[medium.grain]]
table = "{second}"
mesh = "{mesh}"
[[surface]]
shape = {{ type = "mesh", file = "{surface}" }}
reflectance = 0.5
"""
GLTF = '{{"asset": {{"version": "2.0"}}, "buffers": [{{"uri": "{}", "byteLength": 4}}]}}'
ROLES = {"sky", "shape", "table", "second", "mesh", "surface"}


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """A folder of what commands read."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    shutil.copy(CHECKS / "cube.tsdf.exr", folder / "table.exr")
    for name in ("table.png", "table.csv", "accuracy.csv", "accuracy.png", "one.part", "two.part"):
        shutil.copy(folder / "table.exr", folder / name)
    (folder / "cube.obj").write_text(CUBE)
    (folder / "cube.mtl").write_text("newmtl grey\nmap_Kd -s 1 1 skin.png\n")
    (folder / "skin.png").write_bytes(b"\x89PNG")
    (folder / "parts.gltf").write_text(GLTF.format("the%20buffer.bin"))
    (folder / "the buffer.bin").write_bytes(b"1234")
    image.write_exr(folder / "sky.exr", np.ones((2, 4, 3)))
    return folder


def scene(folder: Path, name: str, **files: Path) -> Path:
    """A scene of the cube, the sky and the table; `files` stand in for some of them, and are made if need be."""
    named = dict.fromkeys(ROLES, folder / "cube.obj") | {"sky": folder / "sky.exr"}
    named |= {"table": folder / "table.exr", "second": folder / "table.exr"}
    for role, file in files.items():
        if not file.exists():
            shutil.copy(named[role], file)
    (folder / name).write_text(SCENE.format(**named | files))
    return folder / name


def spelled(path: Path, how: str) -> Path:
    """Another name of a file."""
    other = path.parent.parent / "other" / path.name
    other.parent.mkdir(exist_ok=True)
    if how == "relative":
        return Path(os.path.relpath(path))
    if how == "dotted":
        return path.parent / ".." / path.parent.name / "." / path.name
    if how == "symbolic":
        other.symlink_to(path)
        return other
    if how == "symbolic twice":
        (other.parent / "first").symlink_to(path)
        other.symlink_to("first")
        return other
    if how == "hard":
        other.hardlink_to(path)
        return other
    if how == "folder":
        (other.parent / "folder").symlink_to(path.parent)
        return other.parent / "folder" / path.name
    return path


SPELLINGS = ("itself", "relative", "dotted", "symbolic", "symbolic twice", "hard", "folder")


def invoke(*words: object) -> Result:
    command, *others = map(str, words)
    main = import_module(f"tsdf.cli.{command}").main
    return CliRunner().invoke(main, others, prog_name=f"tsdf-{command}")


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


MEDIUM = ("--packing", "0.3", "--radius", "1")
# Each command that writes a file, what it reads, and the input that its output is put upon.
FILES: dict[str, tuple[Callable[[Path], tuple[object, ...]], str]] = {
    "build, mesh": (lambda at: ("build", at / "cube.obj"), "cube.obj"),
    "build, material": (lambda at: ("build", at / "cube.obj"), "cube.mtl"),
    "build, texture": (lambda at: ("build", at / "cube.obj"), "skin.png"),
    "build, buffer": (lambda at: ("build", at / "parts.gltf"), "the buffer.bin"),
    "build, part": (lambda at: ("build", at / "cube.obj", "--chunk", "1/2"), "cube.obj"),
    "merge, first": (lambda at: ("merge", at / "one.part", at / "two.part"), "one.part"),
    "merge, second": (lambda at: ("merge", at / "one.part", at / "two.part"), "two.part"),
    "plot": (lambda at: ("plot", at / "table.png"), "table.png"),
    "validate": (lambda at: ("validate", at / "table.png", "--plot"), "table.png"),
    **{
        f"export, {to}": (lambda at, to=to: ("export", at / "table.csv", *MEDIUM, "--to", to), "table.csv")  # type: ignore[misc]
        for to in TARGETS
    },
    "render, scene": (lambda at: ("render", scene(at, "scene.exr")), "scene.exr"),
    **{
        f"render, {role}": (lambda at, role=role: ("render", scene(at, "s.toml", **{role: at / "own.exr"})), "own.exr")  # type: ignore[misc]
        for role in sorted(ROLES)
    },
    "render, beside": (lambda at: ("render", scene(at, "s.toml", table=at / "table.png")), "table.png"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("case", FILES)
def test_inputs_stay(case: str, spelling: str, inputs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(inputs.parent)
    words, name = FILES[case]
    command = words(inputs)
    out = spelled(inputs / name, spelling)
    before = contents(inputs.parent)
    out = out.with_suffix(".exr") if case == "render, beside" else out
    flag = () if command[-1] == "--plot" else ("--out",)
    result = invoke(*command, *flag, out)
    assert result.exit_code == 2 and result.stdout == "" and result.stderr.count("\n") == 1, result.output
    assert "it is an input" in result.stderr
    assert contents(inputs.parent) == before


FOLDERS = {  # what is read, and as what in a scene
    "accuracy, csv": ("accuracy.csv", None),
    "accuracy, png": ("accuracy.png", None),
    "frontier, scene": ("s.csv", "scene"),
    "frontier, table": ("s.png", "table"),
    "frontier, mesh": ("s.json", "mesh"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("case", FOLDERS)
def test_inputs_stay_in_folders(case: str, spelling: str, inputs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the input is spelled otherwise, for the command decides how the files in the folder are called."""
    monkeypatch.chdir(inputs.parent)
    name, role = FOLDERS[case]
    if role == "scene":
        scene(inputs, name)
    elif role is not None:
        scene(inputs, "s.toml", **{role: inputs / name})
    read = spelled(inputs / name, spelling)
    if role not in (None, "scene"):
        read = scene(inputs, "s.toml", **{str(role): read.absolute()})
    before = contents(inputs.parent)
    result = invoke(case.partition(",")[0], read, "--out", inputs)
    assert result.exit_code == 2 and result.stdout == "" and result.stderr.count("\n") == 1, result.output
    assert "it is an input" in result.stderr
    assert contents(inputs.parent) == before


WRITING = {
    "build": lambda at: ("build", "cube", "--out"),
    "packing": lambda at: ("packing", "--out"),
    "merge": lambda at: ("merge", at / "one.part", "--out"),
    "export": lambda at: ("export", at / "table.exr", *MEDIUM, "--to", "npz", "--out"),
    "plot": lambda at: ("plot", at / "table.exr", "--out"),
    "validate": lambda at: ("validate", at / "table.exr", "--plot"),
    "render": lambda at: ("render", scene(at, "s.toml"), "--out"),
}


@pytest.mark.parametrize("command", WRITING)
def test_what_cannot_be_written(command: str, inputs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Told in one line before the work, which would here fail or take a while; nothing is left behind."""
    suffix = {"plot": ".png", "validate": ".pdf"}.get(command, ".exr")
    words = WRITING[command](inputs)
    os.mkfifo(inputs / f"fifo{suffix}")
    (inputs / f"folder{suffix}").mkdir()
    (inputs / f"link{suffix}").symlink_to(inputs / "none" / f"x{suffix}")
    (inputs / f"screen{suffix}").symlink_to("/dev/stdout")
    (inputs / "streams").symlink_to("/proc/self/fd")
    before = contents(inputs)
    for name, status, said in (
        (f"fifo{suffix}", 1, "no regular file but a stream"),
        (f"screen{suffix}", 1, "no regular file but a stream"),
        (f"streams/1{suffix}", 1, "no regular file but a stream"),
        (f"/dev/stdout{suffix}", 1, "no regular file but a stream"),
        (f"folder{suffix}", 1, "regular file"),
        (f"link{suffix}", 1, "is not a folder"),
        (f"none/x{suffix}", 1, "is not a folder"),
        (f"table.exr/x{suffix}", 1, "is not a folder"),
        (f"{'x' * 252}{suffix}", 1, "too long"),
        (f"a\nb{suffix}", 2, r"a\nb"),
        (f"a\x1b[2Jb{suffix}", 2, r"a\x1b[2Jb"),
        (f"\udce9{suffix}", 2, r"\udce9"),
    ):
        result = invoke(*words, inputs / name)
        assert result.exit_code == status and result.stdout == "" and result.stderr.count("\n") == 1, (name, result)
        assert "cannot write" in result.stderr and said in result.stderr
        assert ("--plot" if command == "validate" else "--out") in result.stderr
    monkeypatch.setattr(Path, "write_bytes", full)
    result = invoke(*words, inputs / f"x{suffix}")
    assert result.exit_code == 1 and "No space left" in result.stderr and result.stderr.count("\n") == 1
    assert contents(inputs) == before


def test_what_standard_output_goes_to_stays(inputs: Path) -> None:
    """A log to which a command's output is added is not replaced by a file that is named like its stream, whatever name
    that goes by."""
    log = inputs / "log"
    (inputs / "to").symlink_to("/dev/stdout")
    command = [sys.executable, "-c", "from tsdf.cli.export import main; main()", inputs / "table.exr", *MEDIUM]
    for name in ("/dev/stdout", "/dev/fd/1", inputs / "to"):
        log.write_text("kept\n")
        with log.open("a") as stdout:
            done = subprocess.run(
                [*command, "--to", "csv", "--out", name], stdout=stdout, stderr=subprocess.PIPE, text=True, check=False
            )  # fmt: skip
        assert done.returncode == 1 and log.read_text() == "kept\n"
        assert done.stderr.count("\n") == 1 and "choose another --out, or leave it out" in done.stderr


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_one_output_is_not_the_other(inputs: Path) -> None:
    (inputs / "x.png").symlink_to("x.exr")
    result = invoke("render", scene(inputs, "s.toml"), "--out", inputs / "x.exr")
    assert result.exit_code == 2 and "same file" in result.stderr


@pytest.mark.parametrize("command", ["frontier", "accuracy"])
def test_folders_that_cannot_be_made(command: str, inputs: Path) -> None:
    read = scene(inputs, "s.toml") if command == "frontier" else inputs / "table.exr"
    for name, status, said in (("table.exr", 1, "cannot be made"), ("a\nb", 2, r"a\nb"), ("x" * 300, 1, "too long")):
        result = invoke(command, read, "--out", inputs / name)
        assert result.exit_code == status and said in result.stderr and result.stderr.count("\n") == 1
