"""Scene files: the TOML text that says what is rendered, read into the dataclasses of `specs` and checked.

`load` reads a file, `parse` takes the same as a dict. Everything that can be known to be wrong without opening the
files a scene names is refused here, in one line that names the scene, the place and the way out; that they exist is
checked, what is in them is not, but for sizes, densities and colours in others' words (`sizes`, `deep`), which tables
answer, and for the constants of a material. Lengths are in scene units, axes right-handed, radiances linear RGB. No
geometry is built here, no light is followed, and absorption spectra of materials come from `materials`. Paths in a
scene may point anywhere its reader may read.
"""

import errno
import math
import os
import stat
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data import library
from tsdf.data.container import MAGIC
from tsdf.data.table import Table
from tsdf.errors import FormatError, SceneError, TSDFError, UsageError
from tsdf.grain import constants
from tsdf.grain.materials import MEDIA
from tsdf.scene import levels
from tsdf.scene.ball import ball_of
from tsdf.scene.deep import absorption_of_colour, check_colour
from tsdf.scene.keys import (
    ANY,
    COORDINATE,
    NOT_NEGATIVE,
    POSITIVE,
    Place,
    Reader,
    as_choice,
    as_colour,
    as_file,
    as_flag,
    as_integer,
    as_name,
    as_number,
    as_numbers,
    as_place,
    as_section,
    as_table,
    as_tables,
    as_tagged,
    as_text,
    as_triple,
    check_keys,
    hint,
    shown,
)
from tsdf.scene.medium import MAX_PACKING_FRACTION
from tsdf.scene.sizes import SIZES, WORDS, check_words, convert
from tsdf.scene.specs import (
    INSIDE,
    KNOWN_NM,
    UP,
    Absorption,
    Box,
    Camera,
    ConstantLight,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Rectangle,
    Render,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
    Triple,
    called,
)

LEVELS = tuple(levels.LEVELS)
SMALLEST = 1e-12  # [unit] of anything that has a size
MAX_BYTES = 1_000_000  # of the TOML text
HEAD_BYTES = 4096  # that hold the names of what is at the head of a table
MAX_SIDE = 65536  # [pixel] along one side of the picture
MAX_PICTURE = 2**25  # of the picture: two gigabytes while it is made
MAX_SAMPLES = 2**31 - 1  # per pixel
MAX_GRAINS = 64  # kinds in all media together, each of which keeps a table in memory
MAX_LIGHTS = 64
MAX_MEDIA = 64
MAX_SURFACES = 1000
MAX_SPHERES = 100_000  # in a tile of the explicit level: a minute to pack
MAX_EXPLICIT = 1_000_000  # grains met one by one before a chain takes over
ABSORBING = tuple(name for name, medium in MEDIA.items() if medium.k is not None)
COLOURS = ("albedo", "deep_colour")  # two words for the colour of a deep medium in diffuse light


def load(path: str | os.PathLike[str]) -> Scene:
    """Return the scene that a TOML file describes; paths in it are relative to its folder.

    The name of a ready table (docs/library.md) that no file has stands for a ball of that grain in the sun.

    Raises
    ------
    SceneError
        In one line, for a file that cannot be read, is not TOML, or describes no scene.

    Examples
    --------
    >>> import tsdf
    >>> scene = tsdf.load_scene("heap.toml")
    >>> scene.media[0].packing_fraction, scene.render.level
    (0.5, 'auto')
    """
    name = os.fspath(path)
    try:
        if not os.path.exists(path) and library.ready(name):
            return parse(ball_of(name), name=name)
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(status.st_mode):
            raise SceneError(f"{name}: is not a regular file; give the path of a TOML file")
        _check_text(path, name)
        if status.st_size > MAX_BYTES:
            raise SceneError(f"{name}: has {status.st_size} bytes, and a scene at most {MAX_BYTES}; is it a scene?")
        data = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except FormatError as error:  # no ready table either
        raise SceneError(error.reason) from error
    except OSError as error:
        raise SceneError(f"{name}: cannot be read: {error.strerror or error}; give the path of a TOML file") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError(f"{name}: line {line} is not UTF-8 text; save the scene as UTF-8") from error
    except RecursionError as error:
        raise SceneError(f"{name}: lists or tables are nested too deeply; a scene needs three levels") from error
    except ValueError as error:  # a TOMLDecodeError, but also a number of 5000 digits or a zero byte in the path
        raise SceneError(f"{name}: not TOML: {error}; see https://toml.io") from error
    return parse(data, Path(path).parent, name)


def _check_text(path: str | os.PathLike[str], name: str) -> None:
    """Refuse tables and pictures in the place of a scene."""
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(MAGIC) and b"tsdf\0string\0" in head:
        way_out = f"look at it with tsdf-preview, or name it in a scene: table = {os.path.basename(name)!r}"
        raise SceneError(f"{name}: is a table of grains and no scene; {way_out}")
    if head.startswith(MAGIC):
        raise SceneError(f"{name}: is an OpenEXR picture and no scene; give the path of a TOML file")


def parse(data: Mapping[str, Any], folder: str | os.PathLike[str] = ".", name: str = "scene") -> Scene:
    """Return the scene that nested dicts and lists describe, with the keys of the TOML text.

    Parameters
    ----------
    data : mapping
        What ``tomllib`` makes of a scene.
    folder : path
        Where relative paths start.
    name : str
        What messages call the scene.

    Raises
    ------
    SceneError
        In one line, with the table, the key and the way out.

    Examples
    --------
    >>> scene = parse({
    ...     "camera": {"position": [0, -8, 1], "target": [0, 0, 1], "width": 160, "height": 120},
    ...     "light": [{"type": "sun", "direction": [1, 0, 1], "irradiance": [3, 3, 3]}],
    ...     "surface": [{"shape": {"type": "sphere", "centre": [0, 0, 1], "radius": 1}, "reflectance": 0.5}],
    ... })
    >>> scene.surfaces[0].shape
    Sphere(centre=(0.0, 0.0, 1.0), radius=1.0)
    """
    return replace(_SCENE(data, "the scene", Place(name, "", Path(folder))), name=name, folder=os.fspath(folder))


def absorbing_material(name: str, folder: str | os.PathLike[str] = ".") -> str | Path:
    """Return an absorbing material: the name of a built-in one, or the path of a file of constants.

    Parameters
    ----------
    name : str
        As ``tsdf-build --material`` takes it.
    folder : path
        Where a relative path starts.

    Raises
    ------
    UsageError, TSDFError
        In one line, for what is neither, and for constants that do not say how light is absorbed from 400 to 700 nm.
    """
    path = Path(folder) / name
    if name in ABSORBING:
        return name
    if name in MEDIA or not (Path(name).suffix or path.exists()):
        named = f"its k is not known, those of {', '.join(ABSORBING)} are" if name in MEDIA else hint(name, ABSORBING)
        raise UsageError(
            f"no absorbing material {shown(name)}; {named} (or a file of your own constants, .csv of "
            "wavelength_nm,n,k or .yml of refractiveindex.info)"
        )
    medium, (low, high) = constants.read(path)
    if medium.k is None or low > KNOWN_NM[0] or high < KNOWN_NM[1]:
        known = "does not say k" if medium.k is None else f"says k from {low:g} to {high:g} nm only"
        way_out = f"absorption needs it from {KNOWN_NM[0]:g} to {KNOWN_NM[1]:g} nm: add lines for the rest"
        raise TSDFError(f"{path}: {known}; {way_out}")
    return path


def _absorption(value: Any, key: str, at: Place) -> Absorption:
    """Read a coefficient, three of them, the name of a material, or a spectrum."""
    element = as_number(0.0)
    if isinstance(value, list | tuple):
        return Absorption("rgb", as_triple(value, key, at, element))
    if isinstance(value, str):
        at.fail(f'{key} must be numbers or a table, not {shown(value)}; of a material it is {{ material = "ice" }}')
    if not isinstance(value, Mapping):
        return Absorption("grey", (element(value, key, at),))
    at = at.inside(key)
    if "material" in value:
        check_keys(value, ("material",), at)
        name = as_text(value["material"], "material", at)
        try:
            return Absorption("spectral", material=absorbing_material(name, at.folder))
        except TSDFError as error:
            at.fail(f"material: {error}")
    if asked := [name for name in COLOURS if name in value]:
        check_keys(value, (asked[0], "thickness"), at)
        thick = as_number(above=0.0)(value["thickness"], "thickness", at) if "thickness" in value else math.inf
        colour = as_colour()(value[asked[0]], asked[0], at)
        try:
            check_colour(colour)
        except UsageError as error:
            at.fail(f"{asked[0]}: {error}")
        return Absorption("colour", colour=colour, thickness=thick)
    names = ("wavelength_nm", "coefficient")
    check_keys(value, ("material", *COLOURS, *names), at)
    for name in names:
        if name not in value:
            at.fail(f"{name!r} is missing; a spectrum is wavelength_nm and coefficient, or else say the material")
    nm, sigma_a = (as_numbers(value[name], name, at, element) for name in names)
    if len(nm) != len(sigma_a):
        at.fail(f"wavelength_nm and coefficient must be of one length, not {len(nm)} and {len(sigma_a)}")
    if any(a >= b for a, b in pairwise(nm)):
        at.fail("wavelength_nm must ascend")
    low, high = KNOWN_NM
    if not nm or nm[0] > low or nm[-1] < high:
        covered = f"not only {nm[0]:g} to {nm[-1]:g}" if nm else "not nothing"
        at.fail(f"wavelength_nm must cover {low:g} to {high:g} nm, {covered}; add values for the rest")
    return Absorption("spectral", sigma_a, nm)


def _grain(table: Reader, keys: Sequence[str]) -> Reader:
    """Read a kind of grain, whose colour may stand in the place of its absorption."""

    def read(value: Any, key: str, at: Place) -> GrainSpec:
        check_keys(value, (*keys, *COLOURS), at)
        asked = [name for name in COLOURS if name in value]
        if len(asked) + (bool(asked) and "absorption" in value) > 1:
            at.fail(f"{asked[0]} and {[*asked, 'absorption'][1]} both say how grains absorb; give one")
        if asked:
            value = {name: item for name, item in value.items() if name not in asked} | {
                "absorption": {asked[0]: value[asked[0]]}
            }
        made: GrainSpec = table(value, key, at)
        return made

    return read


def _medium(table: Reader, keys: Sequence[str]) -> Reader:
    """Read a medium, whose radius and packing fraction may be said in words of `sizes`; `_in_numbers` finds them."""

    def read(value: Any, key: str, at: Place) -> MediumSpec:
        check_keys(value, (*keys, *WORDS), at)
        if not any(name in value for name in WORDS if name not in keys):
            plain: MediumSpec = table(value, key, at)
            return plain
        words = {name: POSITIVE(value[name], name, at) for name in WORDS if name in value}
        try:
            check_words(words)
        except UsageError as error:
            at.fail(str(error))
        if not any(name in SIZES for name in words):
            at.fail(f"how large grains are is missing; give one of {', '.join(SIZES)}")
        rest = {name: item for name, item in value.items() if name not in WORDS or name in keys}
        made: MediumSpec = table({"radius": 1.0, "packing_fraction": 0.5} | rest, key, at)
        return replace(made, sizes=tuple(words.items()))

    return read


def _in_numbers(medium: MediumSpec, metres_per_unit: float | None, at: Place) -> MediumSpec:
    """Return a medium whose sizes and colours are numbers of ours, by the tables it names."""
    coloured = [grain.absorption.kind == "colour" for grain in medium.grains]
    if not medium.sizes and not any(coloured):
        return medium
    try:
        tables = [g.table if isinstance(g.table, Table) else tsdf_format.read(g.table) for g in medium.grains]
        if medium.sizes:
            shares = [(table, grain.fraction) for table, grain in zip(tables, medium.grains, strict=True)]
            packed = convert(shares, dict(medium.sizes), metres_per_unit)
            medium = replace(medium, radius=packed.radius, packing_fraction=packed.fraction)
        grains = []
        for grain, table, ask in zip(medium.grains, tables, coloured, strict=True):
            if ask:
                of, thick = grain.absorption.colour, grain.absorption.thickness / medium.radius
                found = absorption_of_colour(table, of, thick, medium.packing_fraction)
                coefficient = tuple(x / medium.radius for x in found)
                grain = replace(grain, absorption=replace(grain.absorption, kind="rgb", coefficient=coefficient))
            grains.append(grain)
    except TSDFError as error:
        at.fail(str(error))
    return replace(medium, grains=tuple(grains))


def _direction(v: Triple) -> Triple | None:
    """Return `v` at unit length, None where it has none."""
    length = math.hypot(*v)
    return (v[0] / length, v[1] / length, v[2] / length) if length > 0.0 else None


def _parallel(a: Triple, b: Triple) -> bool:
    """Return whether two unit vectors span no plane, to 1e-6."""
    return math.hypot(*np.cross(a, b)) < 1e-6


def _check_camera(camera: Camera, at: Place) -> Camera:
    p, q = camera.position, camera.target
    view, up = _direction((q[0] - p[0], q[1] - p[1], q[2] - p[2])), _direction(camera.up)
    if view is None:
        at.fail("the camera is at its target; move position or target")
    if up is None:
        at.fail("up has no length; say up = [0, 0, 1]")
    if _parallel(view, up):
        at.fail("up is parallel to the view from position to target; turn it, say up = [0, 1, 0]")
    if camera.width * camera.height > MAX_PICTURE:
        at.fail(f"a picture of {camera.width} x {camera.height} has more than {MAX_PICTURE} pixels; make it smaller")
    return camera


def resized(scene: Scene, width: int | None) -> Scene:
    """Return a scene whose picture has another width [pixel] and its shape; the same scene for None.

    Raises
    ------
    UsageError
        If that is no width or makes too many pixels.
    """
    if width is None:
        return scene
    height = max(1, round(scene.camera.height * width / scene.camera.width))
    if width < 1 or width * height > MAX_PICTURE or max(width, height) > MAX_SIDE:
        raise UsageError(f"a width of {width} is out of range: at least 1, at most {MAX_PICTURE} pixels in all")
    return replace(scene, camera=replace(scene.camera, width=width, height=height))


def _check_sun(sun: SunLight, at: Place) -> SunLight:
    direction = _direction(sun.direction)
    if direction is None:
        at.fail("direction has no length; it points toward the sun")
    return replace(sun, direction=direction)


def _check_box(box: Box, at: Place) -> Box:
    for axis, low, high in zip("xyz", box.low, box.high, strict=True):
        if low >= high:
            at.fail(f"low must be below high, but in {axis} it is {low:g} against {high:g}")
        if high - low < SMALLEST:
            at.fail(f"low must be at least {SMALLEST:g} below high, but in {axis} it is {high - low:g}")
    return box


def _check_slab(slab: Slab, at: Place) -> Slab:
    if slab.low >= slab.high:
        at.fail(f"low must be below high, not {slab.low:g} against {slab.high:g}")
    return slab


def _check_rectangle(rectangle: Rectangle, at: Place) -> Rectangle:
    u, v = _direction(rectangle.u), _direction(rectangle.v)
    if u is None or v is None or _parallel(u, v):
        at.fail("u and v span no area; they are the half edges, not zero and not parallel")
    if min(math.hypot(*rectangle.u), math.hypot(*rectangle.v)) < SMALLEST:
        at.fail(f"u and v must be at least {SMALLEST:g} long")
    return rectangle


def _check_medium(medium: MediumSpec, at: Place) -> MediumSpec:
    if not any(grain.fraction > 0.0 for grain in medium.grains):
        at.fail("the fractions of all grains are 0; give one of them a share > 0")
    return medium


def _check_scene(scene: Scene, at: Place) -> Scene:
    if not scene.lights:
        at.fail("no lights, so the picture would be black; add a [[light]], say of type = 'constant'")
    if not scene.media and not scene.surfaces:
        at.fail("a camera looking at nothing; add a [[medium]] or a [[surface]]")
    if (kinds := sum(len(medium.grains) for medium in scene.media)) > MAX_GRAINS:
        at.fail(f"there are {kinds} [[medium.grain]] in all, at most {MAX_GRAINS} can be; join those that are alike")
    materials = [grain.absorption.material for medium in scene.media for grain in medium.grains]
    if scene.metres_per_unit is None and any(materials):
        at.fail("metres_per_unit is missing: absorption of a material is per metre; say metres_per_unit = 1.0")
    places = [at.inside(called("medium", i, medium.name)) for i, medium in enumerate(scene.media, 1)]
    media = (_in_numbers(m, scene.metres_per_unit, place) for m, place in zip(scene.media, places, strict=True))
    return replace(scene, media=tuple(media))


_MESH = as_table(Mesh, file=as_file, scale=POSITIVE, rotate=as_triple, translate=as_place, up=as_choice(UP))
_BOX = as_table(Box, _check_box, low=as_place, high=as_place)
_SPHERE = as_table(Sphere, centre=as_place, radius=POSITIVE)
_SLAB = as_table(Slab, _check_slab, low=COORDINATE, high=COORDINATE)
_RECTANGLE = as_table(Rectangle, _check_rectangle, centre=as_place, u=as_place, v=as_place)
_LIGHT = as_tagged(
    constant=as_table(ConstantLight, radiance=as_colour()),
    environment=as_table(EnvironmentLight, file=as_file, scale=NOT_NEGATIVE, rotation_deg=ANY),
    sun=as_table(
        SunLight,
        _check_sun,
        direction=as_triple,
        irradiance=as_colour(),
        angular_diameter_deg=as_number(above=0.0, high=180.0, why="0 would make a zero-area light"),
    ),
)


def _table_file(value: Any, key: str, at: Place) -> Path:
    """Read the path of a table, or the name of a ready one that no file has."""
    if isinstance(value, str) and not os.path.exists(at.folder / value):
        try:
            if file := library.ready(value):
                return file
        except FormatError as error:
            at.fail(error.reason)
    return as_file(value, key, at)


_GRAIN_KEYS: dict[str, Reader] = {
    "table": _table_file, "fraction": NOT_NEGATIVE, "mesh": as_file, "absorption": _absorption,
}  # fmt: skip
_GRAIN = _grain(as_table(GrainSpec, **_GRAIN_KEYS), tuple(_GRAIN_KEYS))
_MEDIUM_KEYS: dict[str, Reader] = {
    "name": as_name,
    "shape": as_section(as_tagged(mesh=_MESH, box=_BOX, sphere=_SPHERE, slab=_SLAB)),
    "packing_fraction": as_number(above=0.0, high=MAX_PACKING_FRACTION, why="equal spheres fill at most 0.7405"),
    "radius": POSITIVE,
    "inside": as_choice(INSIDE),
    "packing_seed": as_integer(),
    "packing_spheres": as_integer(1, MAX_SPHERES),
    "grain": as_tables("[[medium.grain]]", _GRAIN, MAX_GRAINS, 1),
}
_MEDIUM = _medium(as_table(MediumSpec, _check_medium, **_MEDIUM_KEYS), tuple(_MEDIUM_KEYS))
_SURFACE = as_table(
    SurfaceSpec,
    name=as_name,
    shape=as_section(as_tagged(rectangle=_RECTANGLE, mesh=_MESH, box=_BOX, sphere=_SPHERE)),
    reflectance=as_colour(1.0),
)


def _leap(value: Any, key: str, at: Place) -> float:
    """Read the smallest radius of leaps: 0 for none, else 1 or more."""
    leap: float = as_number(0.0)(value, key, at)
    if 0.0 < leap < 1.0:
        at.fail(f"{key} must be 0 (none) or at least 1, not {leap:g}; leaps that short are biased")
    return leap


def _check_render(render: Render, at: Place) -> Render:
    if render.leap and render.level != levels.AUTO and not levels.LEVELS[render.level].traits.leaps:
        at.fail(f"level {render.level} cannot leap, for its grains have their places; leave out leap, or say 0")
    return render


_CAMERA = as_table(
    Camera,
    _check_camera,
    position=as_place,
    target=as_place,
    up=as_triple,
    fov_deg=as_number(above=0.0, below=180.0),
    width=as_integer(1, MAX_SIDE),
    height=as_integer(1, MAX_SIDE),
    exposure=as_number(-100.0, 100.0),
)
_SCENE = as_table(
    Scene,
    _check_scene,
    metres_per_unit=POSITIVE,
    camera=as_section(_CAMERA),
    render=as_section(
        as_table(
            Render,
            _check_render,
            level=as_choice((*LEVELS, levels.AUTO)),
            spp=as_integer(1, MAX_SAMPLES),
            seed=as_integer(),
            leap=_leap,
            explicit_grains=as_integer(0, MAX_EXPLICIT),
            fewer_far=as_flag,
        )
    ),
    light=as_tables("[[light]]", _LIGHT, MAX_LIGHTS),
    medium=as_tables("[[medium]]", _MEDIUM, MAX_MEDIA),
    surface=as_tables("[[surface]]", _SURFACE, MAX_SURFACES),
)
