"""Scenes: what a whole one becomes, what each mistake is answered with, and spectra of absorption."""

import copy
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsdf.data import library
from tsdf.errors import SceneError, UsageError
from tsdf.picture import image
from tsdf.picture.media import BEYOND, notes_of
from tsdf.scene import scene
from tsdf.scene.scene import Absorption, load, parse
from tsdf.scene.specs import VISIBLE_NM, absorption_at, held
from tsdf.walk.lights import LUMINANCE

FILES = ("sky.exr", "heap.ply", "snow.tsdf.exr", "salt.tsdf.exr", "grain.stl")
WHOLE = """
metres_per_unit = 0.01
[camera]
position = [0.0, -3.0, 1.0]
target = [0, 0, 0.3]
up = [0.0, 1.0, 1.0]
fov_deg = 30
width = 320
height = 240
exposure = -1.5
[render]
level = "volume-hg"
spp = 16
seed = 7
[[light]]
type = "constant"
radiance = 1.0
[[light]]
type = "environment"
file = "sky.exr"
scale = 2.0
rotation_deg = -90.0
[[light]]
type = "sun"
direction = [3.0, 0.0, 4.0]
angular_diameter_deg = 1.0
irradiance = [3, 2, 1.5]
[[medium]]
name = "heap"
shape = { type = "mesh", file = "heap.ply", scale = 2.0, rotate = [0, 0, 45], translate = [0, 0, 1], up = "y" }
packing_fraction = 0.6
radius = 0.005
packing_seed = 3
packing_spheres = 500
[[medium.grain]]
table = "snow.tsdf.exr"
fraction = 0.7
mesh = "grain.stl"
absorption = { material = "ice" }
[[medium.grain]]
table = "salt.tsdf.exr"
fraction = 0.3
absorption = { wavelength_nm = [380, 500, 780], coefficient = [0.0, 1.0, 3] }
[[medium]]
name = "layer"
shape = { type = "slab", low = -1.0, high = 0 }
packing_fraction = 0.5
radius = 0.1
[[medium.grain]]
table = "snow.tsdf.exr"
absorption = [0.1, 0.2, 0.3]
[[medium]]
shape = { type = "sphere", centre = [0, 0, 2], radius = 0.5 }
packing_fraction = 0.1
radius = 0.1
grain = [{ table = "snow.tsdf.exr", absorption = 2 }]
[[surface]]
name = "floor"
shape = { type = "rectangle", centre = [0, 0, 0], u = [5, 0, 0], v = [0, 5, 0] }
reflectance = 0.5
[[surface]]
shape = { type = "box", low = [0, 0, 0], high = [1, 2, 3] }
reflectance = [0.1, 0.2, 1.0]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with all files that the scenes name, empty."""
    for name in FILES:
        (tmp_path / name).touch()
    return tmp_path


def small() -> dict:
    """Return a small sound scene as a dict, with one of each thing that can be broken."""
    return {
        "camera": {"position": [0, -3, 1], "target": [0, 0, 0], "width": 4, "height": 3},
        "light": [
            {"type": "constant", "radiance": 1.0},
            {"type": "sun", "direction": [0, 0, 1], "irradiance": 1.0},
            {"type": "environment", "file": "sky.exr"},
        ],
        "medium": [
            {
                "name": "heap",
                "shape": {"type": "box", "low": [0, 0, 0], "high": [1, 1, 1]},
                "packing_fraction": 0.6,
                "radius": 0.1,
                "grain": [{"table": "snow.tsdf.exr"}],
            },
        ],
        "surface": [
            {
                "name": "floor",
                "shape": {"type": "rectangle", "centre": [0, 0, 0], "u": [1, 0, 0], "v": [0, 1, 0]},
                "reflectance": 0.5,
            }
        ],
    }


def edited(path: str, value: object) -> dict:
    """Return the small scene with the value at a path of keys and indices replaced, or removed where it is `...`."""
    data = copy.deepcopy(small())
    *way, last = [int(part) if part.isdigit() else part for part in path.split("/")]
    place = data
    for part in way:
        place = place.setdefault(part, {}) if isinstance(place, dict) else place[part]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return data


# --- scenes that are right ----------------------------------------------------------


def test_a_whole_scene(folder):
    """Every key of the format arrives in its field, integers as floats, paths at the folder of the scene."""
    path = folder / "a.toml"
    path.write_text(WHOLE, encoding="utf-8-sig")  # editors of one system put the mark there
    got = load(path)
    assert got == scene.Scene(
        camera=scene.Camera((0.0, -3.0, 1.0), (0.0, 0.0, 0.3), 320, 240, (0.0, 1.0, 1.0), 30.0, -1.5),
        lights=(
            scene.ConstantLight((1.0, 1.0, 1.0)),
            scene.EnvironmentLight(folder / "sky.exr", 2.0, -90.0),
            scene.SunLight((0.6, 0.0, 0.8), (3.0, 2.0, 1.5), 1.0),
        ),
        media=(
            scene.MediumSpec(
                scene.Mesh(folder / "heap.ply", 2.0, (0.0, 0.0, 1.0), (0.0, 0.0, 45.0), "y"),
                0.6,
                0.005,
                (
                    scene.GrainSpec(
                        folder / "snow.tsdf.exr", 0.7, folder / "grain.stl", Absorption("spectral", material="ice")
                    ),
                    scene.GrainSpec(
                        folder / "salt.tsdf.exr",
                        0.3,
                        None,
                        Absorption("spectral", (0.0, 1.0, 3.0), (380.0, 500.0, 780.0)),
                    ),
                ),
                "heap",
                3,
                500,
            ),
            scene.MediumSpec(
                scene.Slab(-1.0, 0.0),
                0.5,
                0.1,
                (scene.GrainSpec(folder / "snow.tsdf.exr", absorption=Absorption("rgb", (0.1, 0.2, 0.3))),),
                "layer",
            ),
            scene.MediumSpec(
                scene.Sphere((0.0, 0.0, 2.0), 0.5),
                0.1,
                0.1,
                (scene.GrainSpec(folder / "snow.tsdf.exr", absorption=Absorption("grey", (2.0,))),),
            ),
        ),
        surfaces=(
            scene.SurfaceSpec(
                scene.Rectangle((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, 5.0, 0.0)), (0.5, 0.5, 0.5), "floor"
            ),
            scene.SurfaceSpec(scene.Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)), (0.1, 0.2, 1.0)),
        ),
        render=scene.Render("volume-hg", 16, 7),
        metres_per_unit=0.01,
        name=str(path),
    )
    assert isinstance(got.camera.target[0], float) and isinstance(got.camera.width, int)


def test_defaults(folder):
    """What may be left out has the value that the format says."""
    got = parse(small(), folder)
    assert got.camera == scene.Camera((0.0, -3.0, 1.0), (0.0, 0.0, 0.0), 4, 3, (0.0, 0.0, 1.0), 40.0, 0.0)
    assert got.render == scene.Render("auto", None, 0)
    assert got.lights[1].angular_diameter_deg == 0.53
    assert (got.lights[2].scale, got.lights[2].rotation_deg) == (1.0, 0.0)
    medium = got.media[0]
    assert (medium.packing_seed, medium.packing_spheres) == (0, 2000)
    assert medium.grains == (scene.GrainSpec(folder / "snow.tsdf.exr", 1.0, None, Absorption("grey", (0.0,))),)
    assert got.metres_per_unit is None


def test_scenes_of_numpy_numbers(folder):
    """Scripts compute their numbers, so numbers of numpy are numbers too, and paths may be Path objects."""
    data = edited("medium/0/radius", np.float32(0.25))
    data["camera"]["width"] = np.int64(4)
    data["medium"][0]["grain"][0]["table"] = folder / "salt.tsdf.exr"
    got = parse(data, folder)
    assert (got.media[0].radius, got.camera.width) == (0.25, 4)
    assert got.media[0].grains[0].table == folder / "salt.tsdf.exr"


def test_the_smallest_scenes(folder):
    """A medium or a surface is enough; every level is a level; ends of ranges are inside."""
    for key in ("medium", "surface"):
        parse(edited(key, ...), folder)
    for level in (*scene.LEVELS, "auto"):
        assert parse(edited("render/level", level), folder).render.level == level
    for path, value in [
        ("medium/0/inside", "centres"),
        ("camera/width", 65536),
        ("light/1/angular_diameter_deg", 180),
        ("medium/0/packing_fraction", 0.74),
        ("surface/0/reflectance", [0, 1, 0.5]),
        ("light/1/irradiance", 0),
        ("medium/0/grain/0/fraction", 1e-9),
    ]:
        parse(edited(path, value), folder)


# --- scenes that are wrong ----------------------------------------------------------

MEDIUM, GRAIN = "[[medium]] 1 (heap): ", "[[medium]] 1 (heap), [[medium.grain]] 1"
BROKEN = [  # (path, value, what the line says after the name of the scene)
    ("lihgt", 1, "unknown key 'lihgt'; did you mean 'light'?"),
    ("zzz", 1, "unknown key 'zzz'; it is one of metres_per_unit, camera,"),
    ("metres_per_unit", 0, "metres_per_unit must be > 0, not 0"),
    ("camera", ..., "'camera' is missing"),
    ("camera", 3, "[camera]: must be a table of keys and values, not 3"),
    ("camera/position", ..., "[camera]: 'position' is missing"),
    ("camera/positon", [0, 0, 0], "[camera]: unknown key 'positon'; did you mean 'position'?"),
    ("camera/position", [0, 1], "[camera]: position must be a list of 3 numbers, not [0, 1]"),
    ("camera/position", [0, "1", 2], "[camera]: number 2 of position must be a number, not '1'"),
    ("camera/position", [0, math.nan, 2], "[camera]: number 2 of position must be a finite number"),
    ("camera/position", [1e200, 0, 2], "[camera]: number 1 of position must be a finite number"),
    ("camera/position", 5, "[camera]: position must be a list of 3 numbers, not 5"),
    ("camera/target", [0, -3, 1], "[camera]: the camera is at its target"),
    ("camera/up", [0, 6, -2], "[camera]: up is parallel to the view"),
    ("camera/up", [0, -3, 1], "[camera]: up is parallel to the view"),
    ("camera/up", [0, 0, 0], "[camera]: up has no length"),
    ("camera/width", 0, "[camera]: width must be from 1 to 65536, not 0"),
    ("camera/width", 65537, "[camera]: width must be from 1 to 65536"),
    ("camera/height", 2.0, "[camera]: height must be a whole number, not 2.0"),
    ("camera/height", True, "[camera]: height must be a whole number, not true"),
    ("camera/fov_deg", 0, "[camera]: fov_deg must be > 0 and < 180, not 0"),
    ("camera/fov_deg", 180.0, "[camera]: fov_deg must be > 0 and < 180"),
    ("camera/fov_deg", False, "[camera]: fov_deg must be a number, not false"),
    ("camera/fov_deg", 10**400, "[camera]: fov_deg must be a finite number"),
    ("camera/exposure", math.inf, "[camera]: exposure must be a finite number"),
    ("camera/exposure", 2000, "[camera]: exposure must be >= -100 and <= 100, not 2000"),
    ("render/level", "telport", "[render]: level cannot be 'telport'; did you mean 'teleport'?"),
    ("render/level", "x", "[render]: level cannot be 'x'; it is one of explicit, teleport-packed,"),
    ("medium/0/inside", "outside", "inside cannot be 'outside'; it is one of grains, centres"),
    ("render/level", 3, "[render]: level must be text, not 3"),
    ("render/spp", 0, "[render]: spp must be from 1 to"),
    ("render/spp", 2**40, "[render]: spp must be from 1 to"),
    ("render/explicit_grains", -1, "[render]: explicit_grains must be from 0 to"),
    ("render/explicit_grains", 2.5, "[render]: explicit_grains must be a whole number, not 2.5"),
    ("render/explicit_grains", math.nan, "[render]: explicit_grains must be a whole number, not nan"),
    ("render/seed", -1, "[render]: seed must be from 0 to"),
    ("render/speed", 1, "[render]: unknown key 'speed'; did you mean 'seed'?"),
    ("light", ..., "no lights"),
    ("light", [], "no lights"),
    ("light", {"type": "constant"}, "light must be a list of tables: head each with [[light]]"),
    ("light", [3], "[[light]] 1: must be a table of keys and values, not 3"),
    ("light/0/type", ..., "[[light]] 1: 'type' is missing; it is one of constant, environment, sun"),
    ("light/0/type", "constnat", "[[light]] 1 (constnat): type cannot be 'constnat'; did you mean 'constant'?"),
    ("light/0/type", ["sun"], "[[light]] 1: type must be text, not ['sun']"),
    ("light/0/radiance", ..., "[[light]] 1 (constant): 'radiance' is missing"),
    ("light/0/radiance", -1, "[[light]] 1 (constant): number 1 of radiance must be >= 0, not -1"),
    ("light/0/radiance", [1, 1], "[[light]] 1 (constant): radiance must be a list of 3 numbers, not [1, 1]"),
    ("light/0/file", "sky.exr", "[[light]] 1 (constant): unknown key 'file'; it is one of radiance"),
    ("light/1/direction", [0, 0, 0], "[[light]] 2 (sun): direction has no length"),
    ("light/1/irradiance", -0.1, "[[light]] 2 (sun): number 1 of irradiance must be >= 0"),
    ("light/1/angular_diameter_deg", 0, "[[light]] 2 (sun): angular_diameter_deg must be > 0 and <= 180, not 0; 0 wo"),
    ("light/1/angular_diameter_deg", 181, "[[light]] 2 (sun): angular_diameter_deg must be > 0 and <= 180"),
    ("light/2/file", "sly.exr", "[[light]] 3 (environment): file 'sly.exr' does not exist; paths start at the folder"),
    ("light/2/file", ".", "[[light]] 3 (environment): file '.' is not a regular file"),
    ("light/2/file", "a\0b", "[[light]] 3 (environment): file 'a\\x00b' does not exist"),
    ("light/2/file", "x" * 5000, "[[light]] 3 (environment): file 'xxx"),
    ("light/2/file", "", "[[light]] 3 (environment): file must be the path of a file, not ''"),
    ("light/2/file", 1, "[[light]] 3 (environment): file must be the path of a file, not 1"),
    ("light/2/scale", -1, "[[light]] 3 (environment): scale must be >= 0, not -1"),
    ("medium/0/radius", ..., MEDIUM + "'radius' is missing"),
    ("medium/0/raduis", 1.0, MEDIUM + "unknown key 'raduis'; did you mean 'radius'?"),
    ("medium/0/packing", 0.6, MEDIUM + "unknown key 'packing'; did you mean 'packing_fraction'?"),
    ("medium/0/effective_raduis", 1.0, MEDIUM + "unknown key 'effective_raduis'; did you mean 'effective_radius'?"),
    ("medium/0/density", 100.0, MEDIUM + "packing_fraction and density each say the amount of grains: give one"),
    ("medium/0/ssa", -20.0, MEDIUM + "ssa must be > 0, not -20"),
    ("medium/0/sieve", 1.0, MEDIUM + "radius and sieve each say the size of grains: give one"),
    ("medium/0/grain/0/albdeo", [0.5] * 3, GRAIN + ": unknown key 'albdeo'; did you mean 'albedo'?"),
    ("medium/0/grain/0/albedo", [0.5, 1.0, 0.5], GRAIN + ", absorption: albedo: a colour is > 0 and < 1 in each"),
    ("medium/0/grain/0/deep_colour", 0.0, GRAIN + ", absorption: deep_colour: a colour is > 0 and < 1 in each"),
    ("medium/0/grain/0/absorption", {"albedo": [0.5, 0.5]}, "absorption: albedo must be a list of 3 numbers"),
    ("medium/0/grain/0/absorption", {"albedo": 0.5, "deep_colour": 0.5}, "absorption: unknown key 'deep_colour'"),
    ("medium/0/grain/0/absorption", {"albedo": 0.5, "thickness": 0}, "absorption: thickness must be > 0, not 0"),
    ("medium/0/grain/0/absorption", {"material": "no.csv"}, "no.csv: no such file, and no built-in material"),
    ("medium/0/grain/0/absorption", {"material": "snow.tsdf.exr"}, "absorption: material: "),
    ("medium/0/radius", 0, MEDIUM + "radius must be > 0, not 0"),
    ("medium/0/name", 3, "[[medium]] 1: name must be text, not 3"),
    ("medium/0/name", "a\nb", None),  # a name may hold anything, and is shown as one printable line
    ("medium/0/packing_fraction", 0, MEDIUM + "packing_fraction must be > 0 and <= 0.74, not 0; equal"),
    ("medium/0/packing_fraction", 0.75, MEDIUM + "packing_fraction must be > 0 and <= 0.74, not 0.75"),
    ("medium/0/packing_seed", 1.5, MEDIUM + "packing_seed must be a whole number"),
    ("medium/0/packing_spheres", 0, MEDIUM + "packing_spheres must be from 1"),
    ("medium/0/shape", ..., MEDIUM + "'shape' is missing"),
    ("medium/0/shape", "box", "[[medium]] 1 (heap), shape: must be a table of keys and values, not 'box'"),
    ("medium/0/shape/type", ..., "[[medium]] 1 (heap), shape: 'type' is missing; it is one of mesh, box, sphere, slab"),
    ("medium/0/shape/type", "rectangle", "[[medium]] 1 (heap), shape: type cannot be 'rectangle'; it is one of mesh"),
    ("medium/0/shape/hihg", [1, 1, 1], "[[medium]] 1 (heap), shape: unknown key 'hihg'; did you mean 'high'?"),
    (
        "medium/0/shape/high",
        [1, 0, 1],
        "[[medium]] 1 (heap), shape: low must be below high, but in y it is 0 against 0",
    ),
    ("medium/0/shape", {"type": "slab", "low": 1, "high": 1}, "shape: low must be below high, not 1 against 1"),
    ("medium/0/shape", {"type": "sphere", "centre": [0, 0, 0], "radius": 0}, "shape: radius must be > 0, not 0"),
    ("medium/0/shape", {"type": "mesh", "file": "heap.obj"}, "shape: file 'heap.obj' does not exist"),
    ("medium/0/shape", {"type": "mesh", "file": "heap.ply", "scale": -1}, "shape: scale must be > 0, not -1"),
    ("medium/0/shape", {"type": "mesh", "file": "heap.ply", "rotate": 90}, "shape: rotate must be a list of 3 numbers"),
    ("medium/0/shape", {"type": "mesh", "file": "heap.ply", "up": "x"}, "shape: up cannot be 'x'; it is one of z, y"),
    (
        "medium/0/packing_spheres",
        9 * 10**18,
        "packing_spheres must be from 1 to 100000, not 9000000000000000000",
    ),
    (
        "medium/0/packing_spheres",
        16**9000,
        "packing_spheres must be from 1 to 100000, not a whole number of 36001",
    ),
    ("medium/0/grain", ..., MEDIUM + "'grain' is missing"),
    ("medium/0/grain", [{"table": "snow.tsdf.exr"}] * 2000, MEDIUM + "there are 2000 [[medium.grain]], and at most 64"),
    ("medium", [small()["medium"][0]] * 65, "there are 65 [[medium]], and at most 64 can be"),
    (
        "medium",
        [small()["medium"][0] | {"grain": [{"table": "snow.tsdf.exr"}] * 33}] * 2,
        "there are 66 [[medium.grain]] in all, at most 64 can be; join those",
    ),
    ("surface", [small()["surface"][0]] * 1001, "there are 1001 [[surface]], and at most 1000 can be"),
    ("light", [small()["light"][0]] * 65, "there are 65 [[light]], and at most 64 can be"),
    ("medium/0/grain", [], MEDIUM + "grain must be a list of one or more tables: head each with [[medium.grain]]"),
    ("medium/0/grain/0/table", ..., GRAIN + ": 'table' is missing"),
    ("medium/0/grain/0/table", "no.exr", GRAIN + ": table 'no.exr' does not exist"),
    ("medium/0/grain/0/mesh", "no.stl", GRAIN + ": mesh 'no.stl' does not exist"),
    ("medium/0/grain/0/fraction", -0.1, GRAIN + ": fraction must be >= 0, not -0.1"),
    ("medium/0/grain/0/fraction", 0, MEDIUM + "the fractions of all grains are 0"),
    ("medium/0/grain/0/absorption", -1, GRAIN + ": absorption must be >= 0, not -1"),
    ("medium/0/grain/0/absorption", [1, 2], GRAIN + ": absorption must be a list of 3 numbers, not [1, 2]"),
    ("medium/0/grain/0/absorption", "ice", GRAIN + ": absorption must be numbers or a table, not 'ice'; of a material"),
    ("medium/0/grain/0/absorption", {"material": "ise"}, "material: no absorbing material 'ise'; did you mean 'ice'?"),
    ("medium/0/grain/0/absorption", {"material": "salt"}, "material 'salt'; its k is not known, those of ice, "),
    ("medium/0/grain/0/absorption", {"material": "ice", "x": 1}, "absorption: unknown key 'x'; it is one of material"),
    ("medium/0/grain/0/absorption", {"material": "ice"}, "metres_per_unit is missing: absorption of a material"),
    ("medium/0/grain/0/absorption", {}, "absorption: 'wavelength_nm' is missing"),
    ("medium/0/grain/0/absorption", {"wavelength_nm": [380, 780]}, "absorption: 'coefficient' is missing"),
    ("medium/0/grain/0/absorption", {"wavelength": [1]}, "unknown key 'wavelength'; did you mean 'wavelength_nm'?"),
    ("surface/0/reflectance", ..., "[[surface]] 1 (floor): 'reflectance' is missing"),
    ("surface/0/reflectance", 1.01, "[[surface]] 1 (floor): number 1 of reflectance must be >= 0 and <= 1, not 1.01"),
    ("surface/0/reflectance", [0, 0, -1], "[[surface]] 1 (floor): number 3 of reflectance must be >= 0 and <= 1"),
    ("surface/0/shape/type", "slab", "[[surface]] 1 (floor), shape: type cannot be 'slab'; it is one of rectangle,"),
    ("surface/0/shape/v", [-2, 0, 0], "[[surface]] 1 (floor), shape: u and v span no area"),
    ("surface/0/shape/u", [5e-324, 0, 0], "[[surface]] 1 (floor), shape: u and v must be at least 1e-12 long"),
    ("medium/0/shape/high", [1, 1, 1e-300], "low must be at least 1e-12 below high, but in z it is 1e-300"),
    ("surface/0/shape/u", [0, 0, 0], "[[surface]] 1 (floor), shape: u and v span no area"),
]


@pytest.mark.parametrize(("path", "value", "expected"), BROKEN, ids=lambda v: _id(v))
def test_what_is_wrong_is_said_in_one_line(folder, path, value, expected):
    """Each mistake is answered with the scene, the place and the way out; only the edit makes the scene fail."""
    if expected is None:
        parse(edited(path, value), folder, "a.toml")
        return
    with pytest.raises(SceneError) as error:
        parse(edited(path, value), folder, "a.toml")
    line = str(error.value)
    assert line.startswith("a.toml: ") and "\n" not in line
    assert expected in line
    if expected.startswith("["):
        assert line.startswith(f"a.toml: {expected}")


def _id(value: object) -> str:
    return value if isinstance(value, str) and value.isprintable() and len(value) < 40 else "-"


@pytest.mark.parametrize(
    ("wavelength_nm", "coefficient", "expected"),
    [
        ([380, 780], [1.0], "must be of one length, not 2 and 1"),
        ([380, 500, 500, 780], [1, 1, 1, 1], "wavelength_nm must ascend"),
        ([780, 380], [1, 1], "wavelength_nm must ascend"),
        ([401, 780], [1, 1], "must cover 400 to 700 nm, not only 401 to 780; add values for the rest"),
        ([380, 699], [1, 1], "must cover 400 to 700 nm, not only 380 to 699"),
        ([], [], "must cover 400 to 700 nm"),
        ([380, 780], [1, -1], "number 2 of coefficient must be >= 0"),
        ([380, math.nan, 780], [1, 1, 1], "number 2 of wavelength_nm must be a finite number"),
        (380, [1], "wavelength_nm must be a list of numbers, not 380"),
    ],
)
def test_spectra_that_cannot_be(folder, wavelength_nm, coefficient, expected):
    """A spectrum has to cover what is seen, in order, without negative absorption."""
    spectrum = {"wavelength_nm": wavelength_nm, "coefficient": coefficient}
    with pytest.raises(SceneError, match=expected) as error:
        parse(edited("medium/0/grain/0/absorption", spectrum), folder)
    assert f"{GRAIN}, absorption: " in str(error.value)


def test_nothing_to_see(folder):
    """A camera with light and neither a medium nor a surface is told so."""
    data = small()
    del data["medium"], data["surface"]
    with pytest.raises(SceneError, match="a camera looking at nothing"):
        parse(data, folder)


def test_the_second_medium_is_called_second(folder):
    """Places count from one and carry the name."""
    data = small()
    data["medium"] += copy.deepcopy(data["medium"])
    data["medium"][1] |= {"name": "layer", "radius": -1}
    with pytest.raises(SceneError, match=r"scene: \[\[medium\]\] 2 \(layer\): radius must be > 0, not -1"):
        parse(data, folder)


def test_a_long_value_is_cut_short(folder):
    """A message stays one readable line whatever stands in the scene."""
    with pytest.raises(SceneError) as error:
        parse(edited("camera/position", list(range(10**5))), folder)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"[camera]\nposition = \n", "not TOML: Invalid value (at line 2"),
        (b"a = 1\na = 2\n", "not TOML: Cannot overwrite a value (at line 2"),
        (b"a = 1\nb = '\xff'\n", "line 2 is not UTF-8 text"),
        (b"a = " + b"9" * 5000, "not TOML: "),
        (b"a = " + b"[" * 100_000, "nested too deeply"),
        (b"", "'camera' is missing"),
        (b"[[camera]]\nwidth = 1\n", "[camera]: must be a table of keys and values, not [{'width': 1}]"),
        (b"[camera]\nfov_deg = 1979-05-27\n", "[camera]: 'position' is missing"),
    ],
)
def test_text_that_is_no_scene(tmp_path, content, expected):
    """Text that is not UTF-8 or not TOML is answered with its line."""
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError) as error:
        load(path)
    assert str(error.value).startswith(f"{path}: ") and expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_table_or_a_picture_is_no_scene(tmp_path):
    """A table, of more bytes than a scene may have even, says what it is and what is done with it."""
    table = tmp_path / "sugar.tsdf.exr"
    table.write_bytes((library.FOLDER / "sugar.tsdf.exr").read_bytes() + bytes(10**6))
    with pytest.raises(SceneError, match=r"is a table of grains and no scene; .* tsdf-preview, .* table = 'sugar\."):
        load(table)
    image.write_exr(tmp_path / "picture.exr", np.ones((2, 2, 3)), attributes={"tsdf_render": "{}"})
    with pytest.raises(SceneError, match="is an OpenEXR picture and no scene"):
        load(tmp_path / "picture.exr")


def test_values_of_any_size_and_depth_are_answered(folder):
    """Whatever nesting or length a value has, the answer is one short line at once."""
    deep: dict = {}
    for _ in range(100_000):
        deep = {"a": deep}
    for path in ("camera/position", "medium/0/radius", "medium/0/grain/0/absorption", "light/0/type", "surface"):
        for value in (deep, "x" * 10**6, [[[1]]] * 10**5, 10**400):
            with pytest.raises(SceneError) as error:
                parse(edited(path, value), folder)
            assert len(str(error.value)) < 300 and "\n" not in str(error.value)
    with pytest.raises(SceneError, match="unknown key"):
        parse(edited("camera/" + "x" * 10**6, 1), folder)


def test_what_is_no_regular_file_is_refused(folder):
    """A pipe, which would be read for ever, a device and a folder: as the scene itself and as a file it names."""
    os.mkfifo(folder / "pipe")
    for name in ("pipe", os.devnull, "."):
        with pytest.raises(SceneError, match=r"is not a regular file|Is a directory"):
            load(folder / name)
        for path in ("light/2/file", "medium/0/grain/0/table", "medium/0/grain/0/mesh"):
            with pytest.raises(SceneError, match="is not a regular file"):
                parse(edited(path, name), folder)


def test_a_file_too_large_for_a_scene_is_not_read(tmp_path):
    """The size is looked at before anything is read."""
    path = tmp_path / "a.toml"
    with open(path, "wb") as file:
        file.truncate(10**12)
    with pytest.raises(SceneError, match="has 1000000000000 bytes, and a scene at most 1000000; is it a scene"):
        load(path)


# --- where a mesh is placed ---------------------------------------------------------


def test_rotations_are_about_x_then_y_then_z(folder):
    """Against scipy's extrinsic "xyz"; scaled about the file's origin, then moved; other orders fail."""
    from scipy.spatial.transform import Rotation

    points = np.random.default_rng(0).normal(size=(5, 3))
    mesh = scene.Mesh(folder / "heap.ply", 2.0, (1.0, 2.0, 3.0), (20.0, -70.0, 130.0))
    expected = 2.0 * Rotation.from_euler("xyz", mesh.rotate, degrees=True).apply(points) + mesh.translate
    assert np.abs(mesh.placed(points) - expected).max() < 1e-14
    other = 2.0 * Rotation.from_euler("zyx", mesh.rotate[::-1], degrees=True).apply(points) + mesh.translate
    assert np.abs(other - expected).max() > 0.1


def test_a_file_whose_up_is_y_is_stood_upright(folder):
    """Blender's OBJ and glTF: (x, y, z) is (x, -z, y) of the scene, exactly, before anything is turned; so is rotate =
    [90, 0, 0]. Right angles are exact, and the default changes nothing."""
    points = np.random.default_rng(1).normal(size=(5, 3))
    x, y, z = points.T
    upright = np.column_stack((x, -z, y))
    file = folder / "heap.ply"
    assert np.array_equal(scene.Mesh(file, up="y").placed(points), upright)
    assert np.array_equal(scene.Mesh(file, rotate=(90.0, 0.0, 0.0)).placed(points), upright)
    assert np.array_equal(scene.Mesh(file, rotate=(-270.0, 0.0, 0.0)).placed(points), upright)
    turned = scene.Mesh(file, rotate=(0.0, 0.0, 90.0), up="y").placed(points)
    assert np.array_equal(turned, np.column_stack((z, x, y)))
    assert np.array_equal(scene.Mesh(file).placed(points), points)


@pytest.mark.parametrize(("name", "expected"), [("no.toml", "No such file"), (".", "Is a directory"), ("a\0b", "null")])
def test_files_that_cannot_be_read(tmp_path, name, expected):
    """A missing file, a directory, a name that no file can have."""
    with pytest.raises(SceneError, match=expected):
        load(f"{tmp_path}/{name}")


# --- absorption ---------------------------------------------------------------------


def test_absorption_of_ice():
    """4 pi k / wavelength of ice: 0.12 /m at 600 nm and 0.52 /m at 700 nm, here by the centimetre."""
    ice = Absorption("spectral", material="ice")
    assert absorption_at(ice, [600.0, 700.0], 0.01) == pytest.approx([0.0012, 0.0052], rel=0.01)
    assert absorption_at(ice, [600.0], 1.0) == pytest.approx(4 * math.pi * 5.73e-9 / 600e-9)


def test_absorption_between_given_wavelengths():
    """Linear between the nodes and exact on them; grey is the same everywhere."""
    spectrum = Absorption("spectral", (0.0, 1.0, 3.0), (380.0, 480.0, 780.0))
    assert absorption_at(spectrum, [380, 430, 480, 630, 780]) == pytest.approx([0.0, 0.5, 1.0, 2.0, 3.0])
    assert absorption_at(Absorption("grey", (2.0,)), [400, 500]).tolist() == [2.0, 2.0]


def test_ends_of_a_spectrum_are_held(folder):
    """What covers 400 to 700 nm, listed or in a file, holds its ends as far as light is seen, and says so; that changes
    the luminance of any light by less than .05 % of white, for the rest weighs no more."""
    spectrum = {"wavelength_nm": [400.0, 500.0, 700.0], "coefficient": [1.0, 2.0, 4.0]}
    read = parse(edited("medium/0/grain/0/absorption", spectrum), folder).media[0].grains[0].absorption
    assert absorption_at(read, [380, 390, 400, 600, 700, 780]).tolist() == [1.0, 1.0, 1.0, 3.0, 4.0, 4.0]
    assert held(read) == (400.0, 700.0)
    assert held(Absorption("spectral", (1.0, 1.0), VISIBLE_NM)) is held(Absorption("spectral", material="ice")) is None
    for nm in (379.0, 781.0):
        with pytest.raises(UsageError, match="from 400 to 700 nm only"):
            absorption_at(read, [nm])
    (folder / "own.csv").write_text("wavelength_nm,n,k\n400,1.5,1e-6\n550,1.5,2e-6\n700,1.5,4e-6\n")
    whole = edited("medium/0/grain/0/absorption", {"material": "own.csv"}) | {"metres_per_unit": 1.0}
    own = parse(whole, folder).media[0].grains[0].absorption
    assert held(own) == (400.0, 700.0)
    at = absorption_at(own, [380.0, 780.0], 1.0)
    assert at == pytest.approx([4 * math.pi * 1e-6 / 380e-9, 4 * math.pi * 4e-6 / 780e-9])
    said = notes_of(parse(whole, folder))
    assert len(said) == 1 and "own.csv is known from 400 to 700 nm; its ends are held from 380 to 780" in said[0]
    (folder / "own.csv").write_text("wavelength_nm,n,k\n450,1.5,1e-6\n550,1.5,2e-6\n700,1.5,4e-6\n")
    with pytest.raises(
        SceneError, match="k from 450 to 700 nm only; absorption needs it from 400 to 700 nm: add lines"
    ):
        parse(whole, folder)
    nm, weight = image.spectral_weights()
    beyond = weight[(nm < 400.0) | (nm > 700.0)] @ LUMINANCE
    assert np.abs(beyond).sum() < BEYOND / 100.0


def test_absorption_that_is_not_known():
    """No spectrum is made up: outside the range, for rgb, and where the unit has no length."""
    spectrum = Absorption("spectral", (1.0, 1.0), (380.0, 780.0))
    for nm in (379.0, 781.0, math.nan):
        with pytest.raises(UsageError, match="from 380 to 780 nm only"):
            absorption_at(spectrum, [500.0, nm])
    with pytest.raises(UsageError, match="has no spectrum"):
        absorption_at(replace(spectrum, kind="rgb"), [500.0])
    with pytest.raises(UsageError, match="metres_per_unit"):
        absorption_at(Absorption("spectral", material="ice"), [500.0])
    with pytest.raises(UsageError, match="200 to 5000 nm"):
        absorption_at(Absorption("spectral", material="ice"), [100.0], 1.0)
