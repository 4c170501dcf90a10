"""The layout is what the design says: imports point one way, heavy third parties have one door each."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import tsdf
from tsdf.compiled import imported

PACKAGE = Path(tsdf.__file__).parent
ROOT = PACKAGE.parent

# What each module may import of the package: only what stands below it.
LAYERS = [
    {"errors", "levels"},
    {
        "files",
        "compiled",
        "container",
        "optics",
        "materials",
        "table",
        "tally",
        "archive",
        "constants",
        "analytic",
        "exemplars",
        "surface",
        "sampling",
        "vectors",
        "handle",
        "grid",
        "horizon",
        "image",
        "lights",
        "medium",
        "polygons",
        "gltf",
        "vtk",
        "meshes",
        "packing",
        "room",
    },
    {"grains", "format", "estimate", "horizon", "neighbours", "sampler", "scene"},
    {"tracer", "exact", "geometry"},
    {"crew"},
    {"scatterometer", "validate", "plots", "explicit", "walker"},
    {"memory"},
    {"transport"},
    {"world"},
    {"render"},
    {"experiment"},
    {"accuracy", "compare"},
]
DOORS = {
    "numba": {"compiled", "handle"},
    "DracoPy": {"gltf"},
    "collada": {"meshes"},
    "trimesh": {"meshes"},
    "mapbox_earcut": {"polygons"},
    "embreex": {"grains"},
    "OpenEXR": {"container", "image"},
    "colour": {"image"},
    "PIL": {"image"},
    "matplotlib": {"plots"},
    "jsonschema": {"container"},
    "yaml": {"constants"},
}


def imports(path: Path) -> list[tuple[str, bool]]:
    """Return the modules a file imports and whether at its top level."""
    tree = ast.parse(path.read_text())
    top = set(map(id, tree.body))
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, id(node) in top) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"tsdf.{a.name}" for a in node.names] if node.module == "tsdf" else [node.module]
            found += [(name, id(node) in top) for name in names]
    return found


def modules() -> list[Path]:
    return sorted(p for p in PACKAGE.glob("*.py") if p.name != "__init__.py")


def test_every_module_has_a_layer() -> None:
    assert {p.stem for p in modules()} == set().union(*LAYERS)


@pytest.mark.parametrize("path", modules(), ids=lambda p: p.stem)
def test_imports_point_down(path: Path) -> None:
    """A module imports only modules of lower layers, or of its own layer without a circle (`table` and the like)."""
    layer = next(i for i, names in enumerate(LAYERS) if path.stem in names)
    below = set().union(*LAYERS[:layer])
    same = LAYERS[layer]
    for name, _ in imports(path):
        if name.startswith("tsdf.") and name.split(".")[1] not in ("reference_data", "schema"):
            target = name.split(".")[1]
            assert target in below | same and target != path.stem, f"{path.stem} imports {target}"


def test_the_judge_does_not_import_the_judged() -> None:
    """`analytic` says what the answer should be, so it shares no more with what computes it than errors and numba."""
    own = {name for name, _ in imports(PACKAGE / "analytic.py") if name.startswith("tsdf")}
    assert own == {"tsdf.errors", "tsdf.compiled"}


@pytest.mark.parametrize("third_party", DOORS)
def test_one_door_for_each_heavy_third_party(third_party: str) -> None:
    """Each is imported by one module, inside functions, so that nothing pays for it who does not use it."""
    for path in modules():
        for name, at_top in imports(path):
            if name.split(".")[0] == third_party:
                assert path.stem in DOORS[third_party], f"{path.stem} imports {third_party}"
                assert not at_top or third_party == "numba", f"{path.stem} imports {third_party} at its top"


@pytest.mark.parametrize("path", modules(), ids=lambda p: p.stem)
def test_what_a_kernel_is_made_of(path: Path) -> None:
    """What decides whether machine code is stale finds all that Python's own parser finds at the top of modules."""
    found: set[str] = set()
    waiting = {path.stem}
    while waiting:
        found.add(name := waiting.pop())
        names = {m.split(".")[1] for m, top in imports(PACKAGE / f"{name}.py") if top and m.startswith("tsdf.")}
        waiting |= {name for name in names if (PACKAGE / f"{name}.py").is_file()} - found
    assert imported(path.stem) == found


def test_library_does_not_import_the_command_line() -> None:
    for path in modules():
        assert not any(name.startswith(("click", "tsdf.cli")) for name, _ in imports(path)), path


@pytest.mark.parametrize(
    "command", ["accuracy", "build", "compare", "export", "info", "merge", "packing", "plot", "render", "validate"]
)
def test_help_loads_nothing_slow(command: str) -> None:
    """``--help`` is instant because no array library is loaded for it."""
    code = (
        f"import sys; from tsdf.cli.{command} import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'numba', 'trimesh', 'matplotlib', 'OpenEXR', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "--help" in done.stdout


def test_readme_points_to_what_is_there() -> None:
    """Links of the README lead somewhere."""
    readme = (ROOT / "README.md").read_text()
    targets = re.findall(r"\]\(([^)#]+)\)", readme)
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target
