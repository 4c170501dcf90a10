"""The layout is what the design says: imports point one way, heavy third parties have one door each."""

import ast
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

import tsdf
from tsdf.compiled import imported

PACKAGE = Path(tsdf.__file__).parent
ROOT = PACKAGE.parent

# Rooms in order: a module imports those of its own room and of the rooms before it. "" is the root.
ROOMS = ["", "grain", "data", "judge", "make", "spheres", "scene", "walk", "picture", "study", "plan", "stress"]
ROOT_MODULES = {"archive", "compiled", "errors", "files", "handle", "sampling", "simplex", "vectors"}
DOORS = {
    "numba": {"compiled", "handle", "wide"},
    "DracoPy": {"gltf"},
    "collada": {"meshes"},
    "trimesh": {"meshes"},
    "mapbox_earcut": {"polygons"},
    "embreex": {"grains"},
    "OpenEXR": {"container", "image"},
    "colour": {"image"},
    "PIL": {"image"},
    "skimage": {"volumes"},
    "tifffile": {"volumes"},
    "matplotlib": {"plots", "frontier_plots", "spectral_plots"},
    "jsonschema": {"container"},
    "yaml": {"constants"},
}


@cache
def imports(path: Path) -> list[tuple[str, bool]]:
    """Return the modules a file imports, in full, and whether at its top level."""
    tree = ast.parse(path.read_text())
    top = set(map(id, tree.body))
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, id(node) in top) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            below = [f"{node.module}.{a.name}" for a in node.names]
            inside = [name for name in below if name.startswith("tsdf.") and name[5:] in NAMES]
            found += [(name, id(node) in top) for name in inside or [node.module]]
    return found


def modules() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if p.name != "__init__.py")


def named(path: Path) -> str:
    """Return the name of a module within the package: walk.memory."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def own(path: Path) -> set[str]:
    """Return the modules of the package that a module imports, by their names within it, at its top or later."""
    return {name[5:] for name, _ in imports(path) if name.startswith("tsdf.") and name[5:] in NAMES}


NAMES = {named(path) for path in modules()}


def test_every_module_has_a_room() -> None:
    assert {name for name in NAMES if "." not in name} == ROOT_MODULES
    assert {name.split(".")[0] for name in NAMES if "." in name} == set(ROOMS) - {""}


@pytest.mark.parametrize("path", modules(), ids=named)
def test_imports_point_down(path: Path) -> None:
    """A module imports only from its own room and from rooms before it."""
    rooms = ROOMS[: 1 + ROOMS.index(named(path).rpartition(".")[0])]
    for name in own(path):
        assert name.rpartition(".")[0] in rooms, f"{named(path)} imports {name}"


def circle(arrows: dict[str, set[str]]) -> list[str]:
    """Return the names that stand in a circle or behind one: what is left when all that need nothing more are gone."""
    left = dict(arrows)
    while free := [name for name, needs in left.items() if not needs & set(left)]:
        for name in free:
            del left[name]
    return sorted(left)


def test_no_circle() -> None:
    """Modules can be put into an order in which each imports only earlier ones; a circle would be found."""
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["a", "b", "c"]
    assert circle({named(path): own(path) for path in modules()}) == []


@pytest.mark.parametrize("room", ["cli", "loaders"])
def test_no_circle_outside(room: str) -> None:
    """Nor do those that stand beside the package."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in (ROOT / room).rglob("*.py")}
    arrows = {
        name: {
            target
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"tsdf.{room}")
            for target in [node.module[5:], *(f"{node.module[5:]}.{alias.name}" for alias in node.names)]
            if target in names
        }
        for name, path in names.items()
    }
    assert any(arrows.values()) and circle(arrows) == []


def test_the_judge_does_not_import_the_judged() -> None:
    """`analytic` says what the answer should be, so it shares no more with what computes it than errors and numba."""
    assert own(PACKAGE / "judge/analytic.py") == {"errors", "compiled"}


@pytest.mark.parametrize("third_party", DOORS)
def test_one_door_for_each_heavy_third_party(third_party: str) -> None:
    """Each is imported by one module, inside functions, so that nothing pays for it who does not use it."""
    for path in modules():
        for name, at_top in imports(path):
            if name.split(".")[0] == third_party:
                assert path.stem in DOORS[third_party], f"{path.stem} imports {third_party}"
                assert not at_top or third_party == "numba", f"{path.stem} imports {third_party} at its top"


@pytest.mark.parametrize("path", modules(), ids=named)
def test_what_a_kernel_is_made_of(path: Path) -> None:
    """What decides whether machine code is stale finds all that Python's own parser finds at the top of modules."""
    found: set[str] = set()
    waiting = {named(path)}
    while waiting:
        found.add(name := waiting.pop())
        at_top = {m[5:] for m, top in imports(PACKAGE.joinpath(*name.split(".")).with_suffix(".py")) if top}
        waiting |= (at_top & NAMES) - found
    assert imported(named(path)) == found


LONG = {"tsdf/walk/transport.py", "tsdf/judge/analytic.py"}  # the kernels of light, the judge


def sources() -> list[Path]:
    return sorted(path for room in ("tsdf", "cli", "loaders") for path in (ROOT / room).rglob("*.py"))


def test_kernels_take_few_arguments() -> None:
    """At most eight: what belongs together comes as one handle."""
    many = []
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list):
                many += [f"{named(path)}.{node.name}"] * (len(node.args.args) > 8)
    assert not many


def test_files_are_short() -> None:
    """At most 600 lines, but for those named, and half of them at most 250."""
    lines = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in sources()}
    assert {name for name, count in lines.items() if count > 600} <= LONG
    assert sorted(lines.values())[len(lines) // 2] <= 250


def code(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a file that do something, with their numbers: no comment, docstring, import or signature."""
    text = path.read_text()
    tree = ast.parse(text)
    idle: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            idle |= set(range(node.lineno, node.end_lineno + 1))
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            idle |= set(range(node.lineno, node.body[0].lineno))
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and ast.get_docstring(node) is not None:
            idle |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    stripped = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if number not in idle]
    return [(number, line) for number, line in stripped if line and not line.startswith("#")]


def repeated(paths: list[Path], count: int) -> list[str]:
    """Return where runs of so many lines that do something stand a second time."""
    seen: dict[tuple[str, ...], str] = {}
    found = []
    for path in paths:
        lines = code(path)
        for k in range(len(lines) - count + 1):
            run, place = tuple(line for _, line in lines[k : k + count]), f"{path}:{lines[k][0]}"
            if run in seen:
                found.append(f"{place} is {seen[run]}")
            seen.setdefault(run, place)
    return found


def test_nothing_stands_twice(tmp_path: Path) -> None:
    """No run of eight lines does, in whatever files; one of a file and its copy would be found."""
    copy = tmp_path / "copy.py"
    copy.write_text((PACKAGE / "files.py").read_text())
    assert repeated([PACKAGE / "files.py", copy], 8)
    assert repeated(sources(), 8) == []


def test_library_does_not_import_the_command_line() -> None:
    for path in modules():
        assert not any(name.startswith(("click", "tsdf.cli")) for name, _ in imports(path)), path


COMMANDS = sorted(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"])


@pytest.mark.parametrize("command", [name.removeprefix("tsdf-") for name in COMMANDS])
def test_help_loads_nothing_slow(command: str) -> None:
    """``--help`` and ``--version`` are instant because no array library is loaded for them."""
    code = (
        f"import sys; from tsdf.cli.{command} import main\n"
        "for word in ('--version', '--help'):\n"
        "    try: main([word])\n"
        "    except SystemExit as end: assert end.code == 0\n"
        "print(sorted({'numpy', 'numba', 'trimesh', 'matplotlib', 'OpenEXR', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "--help" in done.stdout and done.stdout.startswith(f"tsdf-{command} {tsdf.__version__}\n")
