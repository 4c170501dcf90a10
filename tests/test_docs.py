"""The documents say what is so: their code runs, their commands parse, the names in them exist; so do docstrings.

Each fenced block is judged by its language, each command by the parser of the command itself, and each option in the
text by whether a command has it. `docs/cpp.md` is compiled in tests/loaders/test_cpp.py as well; here its names are.
"""

import doctest
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import click
import numpy as np
import pytest

import tsdf
from tsdf.data import container
from tsdf.reference_data import make_golden
from tsdf.reference_data.make_checks import CHECKS
from tsdf.scene import scene

ROOT = Path(__file__).parents[1]
DOCUMENTS = [*ROOT.glob("*.md"), *ROOT.glob("*/*.md"), *ROOT.glob("reference_data/golden/*.md")]
MADE = {"stress", "frontier", "bench", "gallery", "demo", "reference"}  # folders of what make writes
DOCUMENTS = sorted(
    path
    for path in DOCUMENTS
    if path.parts[-2][0] != "." and path.parts[-2] not in MADE and path.name != "CHANGELOG.md"
)
LANGUAGES = {"", "python", "cpp", "glsl", "toml", "xml", "hex", "json"}
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
COMMANDS: dict[str, click.Command] = {
    name: import_module(f"tsdf.cli.{name.removeprefix('tsdf-')}").main for name in SCRIPTS
}
FOREIGN = {"--no-index", "--editable"}  # options of other people's commands
EXAMPLES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in ROOT.glob("tsdf/**/*.py")
    if ">>> " in path.read_text()
)
HEAP = """
camera = { position = [0, -8, 1], target = [0, 0, 1], width = 160, height = 120 }
light = [{ type = "constant", radiance = 1.0 }]
[[medium]]
shape = { type = "mesh", file = "heap.obj" }
packing_fraction = 0.5
radius = 0.05
grain = [{ table = "snow.tsdf.exr" }]
"""


def blocks(path: Path) -> list[tuple[str, str]]:
    """Return language and text of each fenced block of a document."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", path.read_text(), flags=re.M | re.S)
    assert path.read_text().count("\n```") == 2 * len(found) - path.read_text().startswith("```")
    return found


def spans(path: Path) -> list[str]:
    """Return the code in the text of a document, blocks left out."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.M | re.S)
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]


def commands(path: Path) -> list[str]:
    """Return the lines of a document's blocks without a language, and indented ones, that are commands of ours."""
    text = "\n".join(text for language, text in blocks(path) if not language)
    text += "\n".join(re.findall(r"^    (.*)$", re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.M | re.S), re.M))
    lines = text.replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if re.match(r"\s*(tsdf-\w+|make|python|pip) ", line)]


def options_of(command: click.Command) -> set[str]:
    return {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)} | {
        "--help"
    }


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that documents and docstrings name: tables, meshes, a sky and a scene."""
    import OpenEXR

    (tmp_path / "heap.toml").write_text(HEAP)
    for name in ("snow", "sphere", "quartz", "cube"):
        shutil.copy(CHECKS / "cube_memory.tsdf.exr", tmp_path / f"{name}.tsdf.exr")
    faces = [(1, 3, 2), (1, 2, 4), (2, 3, 4), (1, 4, 3)]
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (tmp_path / "heap.obj").write_text(corners + "".join(f"f {a} {b} {c}\n" for a, b, c in faces))
    import trimesh

    mesh = trimesh.load(tmp_path / "heap.obj")
    for name in ("heap.ply", "grain.stl"):
        mesh.export(tmp_path / name)
    sky = np.ones((4, 8, 3), dtype=np.float32)
    OpenEXR.File({}, {"RGB": sky}).write(str(tmp_path / "sky.exr"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_blocks_are_of_known_languages(path: Path) -> None:
    """What is not judged by one of the tests here would rot. JSON parses, and is a header if it says so; XML parses."""
    for language, text in blocks(path):
        assert language in LANGUAGES, f"a block of {language}: give it a test"
        if language == "json":
            made = json.loads(text)
            if isinstance(made, dict) and made.get("format") == "tsdf":
                assert not list(container._broken_schema(made, "header.schema.json", False))
        elif language == "xml":
            ElementTree.fromstring(f"<scene>{text}</scene>")


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_parse(path: Path) -> None:
    """Each command of ours is taken by its own parser, without being run; others name targets and files there are."""
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.M)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for line in commands(path):
        program, *arguments = shlex.split(line, comments=True)
        if program in COMMANDS:
            try:
                COMMANDS[program].make_context(program, list(arguments))
            except click.exceptions.Exit as done:  # of options that only print
                assert done.exit_code == 0
        elif program == "make":
            assert all(word in targets or "=" in word for word in arguments), line
        elif program == "python":
            script = (
                arguments[1].removeprefix("tsdf.").replace(".", "/") + ".py" if arguments[0] == "-m" else arguments[0]
            )
            assert (ROOT / script).exists() or (path.parent / script).exists(), line
        else:
            assert set(re.findall(r"tsdf-toolkit\[(\w+)\]", line)) <= set(extras), line


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_names_in_the_text_exist(path: Path) -> None:
    """Commands, options, targets and files in the running text."""
    known = set().union(*map(options_of, COMMANDS.values())) | FOREIGN
    scripts = "".join(
        file.read_text() for folder in ("fuzz", "benchmarks", "scenes") for file in ROOT.glob(f"{folder}/*.py")
    )
    for span in spans(path):
        words = span.split()
        program = words[0]
        if re.fullmatch(r"tsdf-[a-z]+", program) and program not in {"tsdf-toolkit", "tsdf-packing"}:
            assert program in COMMANDS, span
            used = {word.partition("=")[0] for word in words[1:] if word.startswith("--")}
            assert used <= options_of(COMMANDS[program]), span
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", span):
            assert option in known or f'"{option}"' in scripts, span
        if program == "make" and len(words) > 1:
            assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), flags=re.M), span
        if program in {"python", "pytest"} and len(words) > 1 and words[1].endswith(".py"):
            assert (ROOT / words[1]).exists() or (path.parent / words[1]).exists(), span


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path: Path) -> None:
    """Pages and pictures that a document points to, and the headings in them."""
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.M | re.S)):
        if "://" in target:
            continue
        file, _, heading = target.partition("#")
        there = path.parent / file if file else path
        assert there.exists(), target
        headings = re.findall(r"^#+ (.*)$", there.read_text(), flags=re.M) if heading else []
        assert not heading or heading in {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}, (
            target
        )


def test_the_recipes_name_what_is_there() -> None:
    """Files and folders of CONTRIBUTING, and the names in capitals that it says stand in them."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    paths = {span for span in spans(ROOT / "CONTRIBUTING.md") if re.fullmatch(r"[\w./]+/[\w./]*", span)}
    assert len(paths) > 20
    for path in paths - {"reference/"}:
        assert (ROOT / path).exists(), path
    files = [ROOT / path for path in paths if path.endswith(".py")]
    code = "".join(path.read_text() for path in files)
    for name in re.findall(r"`(_?[A-Z]+|test_\w+)`", text):
        assert re.search(rf"\b{name}\b", code), name


def test_the_index_lists_all_pages() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    for path in [*ROOT.glob("docs/*.md"), *ROOT.glob("schema/*.md"), ROOT / "CONTRIBUTING.md", ROOT / "CITATION.cff"]:
        assert path.name == "index.md" or f"{path.name})" in index, path.name


@pytest.mark.slow
def test_the_reference_shows_what_is_public(tmp_path: Path) -> None:
    """Names that are imported when asked for, and each room; nothing that pdoc warns of."""
    done = subprocess.run([sys.executable, ROOT / "docs" / "reference.py", tmp_path], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    page = (tmp_path / "tsdf.html").read_text()
    for name in set(tsdf.__all__) - {"__version__"}:
        assert f'<section id="{name}">' in page, name
    rooms = {path.stem for path in ROOT.glob("tsdf/[a-z]*") if path.suffix in {"", ".py"}}
    assert rooms <= {path.stem for path in (tmp_path / "tsdf").glob("*.html")}


@pytest.mark.parametrize(
    "path", [path for path in DOCUMENTS if any(kind == "toml" for kind, _ in blocks(path))], ids=lambda path: path.name
)
def test_scenes_load(path: Path, folder: Path) -> None:
    for i, text in enumerate(text for language, text in blocks(path) if language == "toml"):
        (folder / f"{i}.toml").write_text(text)
        assert scene.load(folder / f"{i}.toml").media


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [path for path in DOCUMENTS if any(kind == "python" for kind, _ in blocks(path))],
    ids=lambda path: path.name,
)
def test_python_runs(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a document, one after the other, after the exports that it shows; Blender itself is a dummy."""
    for line in commands(path):
        program, *arguments = shlex.split(line, comments=True)
        if program == "tsdf-export" and "--out" in arguments:
            with pytest.raises(SystemExit) as done:
                COMMANDS[program].main(arguments)
            assert done.value.code == 0
    if "mitsuba" in path.name:
        pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'tsdf-toolkit[mitsuba]'")
    blender = MagicMock(spec_set=["data", "context", "app"])
    blender.context.scene.cycles.volume_bounces = blender.context.scene.cycles.max_bounces = 12
    monkeypatch.setitem(sys.modules, "bpy", blender)
    held: dict[str, Any] = {"__name__": "document"}
    for text in (text for language, text in blocks(path) if language == "python"):
        exec(compile(text.replace("llvm_ad_rgb", "scalar_rgb"), str(path), "exec"), held)  # LLVM may be missing
    assert any(not isinstance(value, ModuleType) for name, value in held.items() if name[:2] != "__")


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name: str, folder: Path) -> None:
    """Each example of a module's docstrings, in a folder with the files that it names."""
    module = import_module(name)
    done = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert done.failed == 0 and done.attempted > 0


def test_what_is_public_has_an_example() -> None:
    """All that `tsdf` promises is there, is listed, typed and has an example, but for errors; nothing else is."""
    assert dir(tsdf) == sorted(tsdf.__all__) and "numpy" not in dir(tsdf)
    typed = re.findall(r"^    from tsdf\.\S+ import \w+ as (\w+)$", Path(tsdf.__file__).read_text(), flags=re.M)
    assert {*typed, "__version__"} == set(tsdf.__all__)
    for name in typed:
        what = getattr(tsdf, name)
        assert ">>> " in (what.__doc__ or "") or issubclass(what, Exception), name
    with pytest.raises(AttributeError, match="no attribute 'reed'"):
        tsdf.reed  # noqa: B018


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++, the C++ compiler, in PATH")
def test_names_of_the_cpp_page_exist(tmp_path: Path) -> None:
    """Each expression of the tables in docs/cpp.md compiles; a name that does not exist is found out: the control."""
    text = (ROOT / "docs" / "cpp.md").read_text()
    expressions: list[str] = []
    for row in re.findall(r"^\| (`.*?`.*?) \|", text.split("## The arrays")[0], flags=re.M):
        whole = ""
        for span in re.findall(r"`([^`]+)`", row):
            whole = whole.rpartition(".")[0] + span if span.startswith(".") else span
            expressions.append(whole)
    arrays = text.split("## The arrays")[1].split("## One buffer")[0]
    expressions += [f"sampler.{name}" for name in re.findall(r"^\| `(\w+)` \|", arrays, flags=re.M)]
    expressions += [
        f"sampler.{name}" for name in ("columns", "records", "theta_bits", "bits", "guide_shift", "words()")
    ]
    assert len(expressions) > 50 and {"sampler.cumulative", "table.free_path(f, R).lambda_s"} <= set(expressions)
    declared = """#include "tsdf.hpp"
using namespace tsdf;
void use(Table& table, const Sampler& sampler, const Sample& s, Vector d_in, double f, double R, double X, double c,
         std::size_t y, const char* path, const void* bytes, std::size_t size, double u0, double u1, double u2,
         double u3, double u4, double u5, Vector a, Vector b) {
"""
    for extra, expected in (([], 0), (["table.no_such_field"], 1)):
        source = tmp_path / "names.cpp"
        source.write_text(declared + "".join(f"(void)({one});\n" for one in [*expressions, *extra]) + "}\n")
        done = subprocess.run(
            ["g++", "-std=c++17", "-fsyntax-only", f"-I{ROOT / 'loaders'}", source], capture_output=True, text=True
        )
        assert (done.returncode != 0) == expected, done.stderr
    assert make_golden.table(make_golden.WEIGHTS)[0]["licence"]  # that find("licence") would find
