"""What is rendered, as plain frozen dataclasses, and the TOML text that says it.

`load` reads a file, `parse` takes the same as a dict. Everything that can be known to be wrong without opening the
files a scene names is refused here, in one line that names the scene, the place and the way out; that they exist is
checked, what is in them is not, but for sizes, densities and colours in others' words (`sizes`, `deep`), which tables
answer, and for the constants of a material. Lengths are in scene units, axes right-handed, radiances linear RGB. No
geometry is built here, no light is followed, and absorption spectra of materials come from `materials`. Paths in a
scene may point anywhere its reader may read.
"""

import difflib
import errno
import math
import os
import reprlib
import stat
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from itertools import pairwise
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from tsdf.data import format
from tsdf.data.table import Table
from tsdf.errors import SceneError, TSDFError, UsageError
from tsdf.grain import constants
from tsdf.grain.materials import MEDIA, optical_constants
from tsdf.scene import levels
from tsdf.scene.deep import absorption_of_colour, check_colour
from tsdf.scene.medium import MAX_PACKING_FRACTION
from tsdf.scene.sizes import SIZES, WORDS, check_words, convert

UP = ("z", "y")
LEVELS = tuple(levels.LEVELS)
INSIDE = ("grains", "centres")
VISIBLE_NM = (380.0, 780.0)  # [nm] what an absorption spectrum must cover
LARGEST = 1e30  # of any number in a scene, so that squares and products stay finite
FARTHEST = 1e15  # [unit] of any coordinate: the ray engine's numbers are float32
SMALLEST = 1e-12  # [unit] of anything that has a size
MAX_BYTES = 1_000_000  # of the TOML text
MAX_SIDE = 65536  # [pixel] along one side of the picture
MAX_PICTURE = 2**25  # of the picture: two gigabytes while it is made
MAX_SAMPLES = 2**31 - 1  # per pixel
MAX_GRAINS = 64  # kinds in all media together, each of which keeps a table in memory
MAX_LIGHTS = 64
MAX_MEDIA = 64
MAX_SURFACES = 1000
MAX_SPHERES = 100_000  # in a tile of the explicit level: a minute to pack
MAX_EXPLICIT = 1_000_000  # grains met one by one before a chain takes over
MAX_NAME = 200  # [characters]
METRES_PER_NM = 1e-9
ABSORBING = tuple(name for name, medium in MEDIA.items() if medium.k is not None)
COLOURS = ("albedo", "deep_colour")  # two words for the colour of a deep medium in diffuse light

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    position: Triple  # [unit]
    target: Triple  # what the middle of the picture shows [unit]
    width: int  # [pixel]
    height: int  # [pixel]
    up: Triple = (0.0, 0.0, 1.0)  # of any length, not along the view
    fov_deg: float = 40.0  # horizontal field of view [deg], in (0, 180)
    exposure: float = 0.0  # of the PNG only [stops]


@dataclass(frozen=True)
class Render:
    """Defaults of the command line."""

    level: str = "teleport"  # one of LEVELS
    spp: int = 64  # samples per pixel
    seed: int = 0
    leap: float | None = None  # smallest leap [transport mean free paths], 0 for none; None where it is not said
    explicit_grains: int = 0  # met one by one, the first from the camera, before a chain of grains takes over


@dataclass(frozen=True)
class ConstantLight:
    """The same radiance from everywhere."""

    radiance: Triple  # linear RGB


@dataclass(frozen=True)
class EnvironmentLight:
    """Radiance from a picture of all directions; its middle lies along -x, with -y to its left."""

    file: Path
    scale: float = 1.0
    rotation_deg: float = 0.0  # about +z, counter-clockwise seen from above [deg]


@dataclass(frozen=True)
class SunLight:
    """A disc of constant radiance, infinitely far away."""

    direction: Triple  # toward the sun, of unit length
    irradiance: Triple  # linear RGB, on a surface that faces the sun
    angular_diameter_deg: float = 0.53  # [deg], in (0, 180]


@dataclass(frozen=True)
class Mesh:
    """The triangles of a file, stood upright, scaled and turned about the origin of the file, then moved."""

    file: Path
    scale: float = 1.0
    translate: Triple = (0.0, 0.0, 0.0)
    rotate: Triple = (0.0, 0.0, 0.0)  # about x, then y, then z, counter-clockwise seen from the axis' end [deg]
    up: str = "z"  # axis of the file that becomes z; "y" turns it by 90 degrees about x first

    def placed(self, points: ArrayLike) -> np.ndarray:
        """Return points (n, 3) of the file where they are in the scene, (n, 3) float64 [unit]."""
        placed = np.array(points, dtype=np.float64)
        for axis, degrees in ((0, 90.0 if self.up == "y" else 0.0), *enumerate(self.rotate)):
            if degrees % 360.0:
                cosine, sine = _turned(degrees)
                a, b = placed[:, axis - 2].copy(), placed[:, axis - 1].copy()
                placed[:, axis - 2], placed[:, axis - 1] = cosine * a - sine * b, sine * a + cosine * b
        return placed * self.scale + np.array(self.translate, dtype=np.float64)


@dataclass(frozen=True)
class Box:
    """A box along the axes, `low` below `high` on each."""

    low: Triple
    high: Triple


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    centre: Triple
    radius: float


@dataclass(frozen=True)
class Slab:
    """All between two heights z, without end in x and y."""

    low: float
    high: float


@dataclass(frozen=True)
class Rectangle:
    """The parallelogram centre + s u + t v with s and t in [-1, 1]."""

    centre: Triple
    u: Triple
    v: Triple


@dataclass(frozen=True)
class Absorption:
    """The absorption coefficient of what a grain is made of: grey, rgb or spectral; or the colour that it makes."""

    kind: str  # "grey", "rgb" or "spectral"; "colour" only until `parse` has made it "rgb"
    coefficient: tuple[float, ...] = ()  # [1/unit]: one; red, green, blue; or one per wavelength. () with a material
    wavelength_nm: tuple[float, ...] = ()  # [nm], ascending; only where spectral and not of a material
    material: str | Path | None = None  # an absorbing one of `tsdf.grain.materials`, or a file; only where spectral
    colour: tuple[float, ...] = ()  # linear RGB of a deep medium of these grains, where this was asked for [1]
    thickness: float = math.inf  # of the slab that has this colour [unit]


@dataclass(frozen=True)
class GrainSpec:
    """One kind of grain in a medium."""

    table: Path | Table  # a file, or the table itself in scenes made in Python
    fraction: float = 1.0  # share of the number of grains [1], not normalised
    mesh: Path | None = None  # of the explicit level, where the table's grain is not a built-in one
    absorption: Absorption = Absorption("grey", (0.0,))


MediumShape = Mesh | Box | Sphere | Slab
SurfaceShape = Rectangle | Mesh | Box | Sphere
Light = ConstantLight | EnvironmentLight | SunLight


@dataclass(frozen=True)
class MediumSpec:
    """A body of packed grains."""

    shape: MediumShape
    packing_fraction: float  # share of the volume in bounding spheres [1], in (0, 0.74]
    radius: float  # bounding radius of the grains [unit]
    grains: tuple[GrainSpec, ...]
    name: str = ""
    packing_seed: int = 0  # of the explicit level
    packing_spheres: int = 2000  # in the periodic tile of the explicit level
    inside: str = "grains"  # what lies inside the shape: bounding spheres wholly, or their centres; one of INSIDE
    sizes: tuple[tuple[str, float], ...] = ()  # what was said in words of `sizes` that radius and packing_fraction obey


@dataclass(frozen=True)
class SurfaceSpec:
    """A diffuse surface."""

    shape: SurfaceShape
    reflectance: Triple  # linear RGB, each in [0, 1]
    name: str = ""


@dataclass(frozen=True)
class Scene:
    """All that a renderer has to know."""

    camera: Camera
    lights: tuple[Light, ...] = ()  # at least one
    media: tuple[MediumSpec, ...] = ()
    surfaces: tuple[SurfaceSpec, ...] = ()  # at least one medium or surface
    render: Render = Render()
    metres_per_unit: float | None = None  # [m/unit]; given wherever a grain absorbs as a material does
    name: str = "scene"  # what messages call it
    folder: str | None = field(default=None, compare=False)  # where its paths start; None if it was made in Python


def load(path: str | os.PathLike[str]) -> Scene:
    """Return the scene that a TOML file describes; paths in it are relative to its folder.

    Raises
    ------
    SceneError
        In one line, for a file that cannot be read, is not TOML, or describes no scene.

    Examples
    --------
    >>> import tsdf
    >>> scene = tsdf.load_scene("heap.toml")
    >>> scene.media[0].packing_fraction, scene.render.level
    (0.5, 'teleport')
    """
    name = os.fspath(path)
    try:
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(status.st_mode):
            raise SceneError(f"{name}: is not a regular file; give the path of a TOML file")
        if status.st_size > MAX_BYTES:
            raise SceneError(f"{name}: has {status.st_size} bytes, and a scene at most {MAX_BYTES}; is it a scene?")
        data = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
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
    return replace(_SCENE(data, "the scene", _Place(name, "", Path(folder))), name=name, folder=os.fspath(folder))


def called(table: str, number: int, label: str) -> str:
    """Return what messages call one of an array of tables: its number, from 1, and its name or type if it has one."""
    return f"[[{table}]] {number}" + (f" ({label})" if label else "")


def files_of(scene: Scene) -> tuple[Path, ...]:
    """Return all files that a scene names: tables, meshes and environments."""

    def named(value: Any) -> Iterator[Path]:
        if isinstance(value, Path):
            yield value
        elif isinstance(value, tuple):
            for item in value:
                yield from named(item)
        elif is_dataclass(value) and not isinstance(value, Table):
            for field in fields(value):
                yield from named(getattr(value, field.name))

    return tuple(dict.fromkeys(named(scene)))


def absorption_at(spec: Absorption, wavelengths_nm: ArrayLike, metres_per_unit: float | None = None) -> np.ndarray:
    """Return the absorption coefficient sigma_a by wavelength, (k,) float64 [1/unit].

    Of a material it is 4 pi k / wavelength, with k of `materials`; a given spectrum is linear between its wavelengths;
    grey is the same at all.

    Parameters
    ----------
    spec : Absorption
    wavelengths_nm : (k,) array_like
        [nm], inside the given spectrum or the range of the material.
    metres_per_unit : float, optional
        Length of the scene unit [m]; only a material needs it.

    Raises
    ------
    UsageError
        For a wavelength out of range, a material without metres_per_unit, and for rgb, which has no wavelengths.
    """
    nm = np.atleast_1d(np.asarray(wavelengths_nm, dtype=np.float64))
    if spec.kind in ("rgb", "colour"):
        raise UsageError("absorption given as [r, g, b] has no spectrum; give a material, or wavelength_nm with it")
    if spec.kind == "grey":
        return np.full(len(nm), spec.coefficient[0])
    if spec.material is not None:
        if metres_per_unit is None:
            raise UsageError(f"absorption of {spec.material} is per metre: say metres_per_unit")
        k = _absorption_index(spec.material, nm)
        return 4.0 * math.pi * k / (nm * METRES_PER_NM) * metres_per_unit
    low, high = spec.wavelength_nm[0], spec.wavelength_nm[-1]
    if not ((nm >= low) & (nm <= high)).all():
        raise UsageError(f"the absorption spectrum is known from {low:g} to {high:g} nm only")
    return np.interp(nm, spec.wavelength_nm, spec.coefficient)


def _absorption_index(material: str | Path, nm: np.ndarray) -> np.ndarray:
    """Return k of a built-in material or of a file at wavelengths [nm], (n,) float64."""
    if isinstance(material, str):
        return np.array([optical_constants(material, w).k for w in nm.tolist()], dtype=np.float64)
    medium, (low, high) = constants.read(material)
    if medium.k is None or not ((nm >= low) & (nm <= high)).all():
        raise UsageError(f"{material}: k is known from {low:g} to {high:g} nm only")
    return np.array([medium.k(w) for w in nm.tolist()], dtype=np.float64)


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
        In one line, for what is neither, and for constants that do not say how light is absorbed from 380 to 780 nm.
    """
    path = Path(folder) / name
    if name in ABSORBING:
        return name
    if name in MEDIA or not (Path(name).suffix or path.exists()):
        named = f"it is one of {', '.join(ABSORBING)}." if name in MEDIA else _hint(name, ABSORBING)
        raise UsageError(
            f"no absorbing material {_shown(name)}; {named} A file of your own constants will do, too (.csv of "
            "wavelength_nm,n,k or .yml of refractiveindex.info)"
        )
    medium, (low, high) = constants.read(path)
    if medium.k is None or low > VISIBLE_NM[0] or high < VISIBLE_NM[1]:
        known = "does not say k" if medium.k is None else f"says k from {low:g} to {high:g} nm only"
        raise TSDFError(f"{path}: {known}; absorption needs it from {VISIBLE_NM[0]:g} to {VISIBLE_NM[1]:g} nm")
    return path


# --- readers: from what stands at a key to what it means ----------------------------


class _Place(NamedTuple):
    """Where in a scene a value stands."""

    file: str
    table: str
    folder: Path

    def fail(self, what: str) -> NoReturn:
        raise SceneError(": ".join(part for part in (self.file, self.table, what) if part))

    def inside(self, table: str) -> "_Place":
        return self._replace(table=f"{self.table}, {table}" if self.table else table)


Reader = Callable[[Any, str, _Place], Any]  # (value, its key, its place) -> what it means, or SceneError

_FIELDS = {"light": "lights", "medium": "media", "surface": "surfaces", "grain": "grains"}  # where not the key


class _Brief(reprlib.Repr):
    """Of what is deep or long, no more than can be shown."""

    def repr_int(self, value: int, _: int) -> str:
        return repr(value) if abs(value) <= LARGEST else f"a whole number of {value.bit_length()} bits"


_BRIEF = _Brief()
_BRIEF.maxlist = _BRIEF.maxtuple = _BRIEF.maxdict = 40
_BRIEF.maxstring = _BRIEF.maxother = 60


def _shown(value: Any) -> str:
    """Return a short printable rendering of a value."""
    text = str(value).lower() if isinstance(value, bool) else _BRIEF.repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _hint(word: str, valid: Sequence[str]) -> str:
    begun = [name for name in valid if len(word) >= 3 and name.startswith(word)]  # of "packing" the first named
    near = begun or difflib.get_close_matches(word[:MAX_NAME], valid, 1)
    return f"did you mean {near[0]!r}?" if near else f"it is one of {', '.join(valid)}"


def _check_keys(value: Any, valid: Sequence[str], at: _Place) -> None:
    if not isinstance(value, Mapping):
        at.fail(f"must be a table of keys and values, not {_shown(value)}")
    for key in value:
        if key not in valid:
            at.fail(f"unknown key {_shown(key)}; {_hint(str(key), valid)}")


def _number(
    low: float = -LARGEST, high: float = LARGEST, above: float = -math.inf, below: float = math.inf, why: str = ""
) -> Reader:
    """Read a number with low <= x <= high and above < x < below; `why` says why, where that is not plain."""
    bounds = [f">= {low:g}"] * (low > -LARGEST) + [f"> {above:g}"] * (above > -math.inf)
    bounds += [f"<= {high:g}"] * (high < LARGEST) + [f"< {below:g}"] * (below < math.inf)

    def read(value: Any, key: str, at: _Place) -> float:
        real = isinstance(value, Real) and not isinstance(value, bool)
        if not real:
            at.fail(f"{key} must be a number, not {_shown(value)}")
        if not -LARGEST <= value <= LARGEST:
            at.fail(f"{key} must be a finite number of at most {LARGEST:g}, not {_shown(value)}")
        if not (low <= value <= high and above < value < below):
            at.fail(f"{key} must be {' and '.join(bounds)}, not {_shown(value)}" + f"; {why}" * bool(why))
        return float(value)

    return read


def _integer(low: int = 0, high: int = 2**63 - 1) -> Reader:
    def read(value: Any, key: str, at: _Place) -> int:
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole:
            at.fail(f"{key} must be a whole number, not {_shown(value)}")
        if not low <= value <= high:
            at.fail(f"{key} must be from {low} to {high}, not {_shown(value)}")
        return int(value)

    return read


def _text(value: Any, key: str, at: _Place) -> str:
    if not isinstance(value, str):
        at.fail(f"{key} must be text, not {_shown(value)}")
    return value


def _name(value: Any, key: str, at: _Place) -> str:
    """Read what messages call a thing, as one short printable line."""
    text = _text(value, key, at)[:MAX_NAME]
    return text if text.isprintable() else ascii(text)[1:-1]


def _choice(valid: Sequence[str]) -> Reader:
    def read(value: Any, key: str, at: _Place) -> str:
        if _text(value, key, at) not in valid:
            at.fail(f"{key} cannot be {_shown(value)}; {_hint(value, valid)}")
        return value

    return read


def _numbers(value: Any, key: str, at: _Place, element: Reader) -> tuple[float, ...]:
    if not isinstance(value, list | tuple):
        at.fail(f"{key} must be a list of numbers, not {_shown(value)}")
    return tuple(element(item, f"number {i} of {key}", at) for i, item in enumerate(value, 1))


def _triple(value: Any, key: str, at: _Place, element: Reader | None = None) -> Triple:
    if not isinstance(value, list | tuple) or len(value) != 3:
        at.fail(f"{key} must be a list of 3 numbers, not {_shown(value)}")
    x, y, z = _numbers(value, key, at, element or _ANY)
    return x, y, z


def _place(value: Any, key: str, at: _Place) -> Triple:
    """Read a place or an extent [unit]."""
    return _triple(value, key, at, _COORDINATE)


def _colour(high: float = LARGEST) -> Reader:
    """Read linear RGB, each 0 to `high`, from one number for all or a list of three."""
    element = _number(0.0, high)

    def read(value: Any, key: str, at: _Place) -> Triple:
        return _triple(value if isinstance(value, list | tuple) else [value] * 3, key, at, element)

    return read


def _file(value: Any, key: str, at: _Place) -> Path:
    """Read the path of a file that is there."""
    if not isinstance(value, str | os.PathLike) or not os.fspath(value):
        at.fail(f"{key} must be the path of a file, not {_shown(value)}")
    path = at.folder / value
    if not os.path.isfile(path):  # unlike Path.is_file, never raises
        what = "is not a regular file" if os.path.exists(path) else "does not exist"
        at.fail(f"{key} {_shown(str(value))} {what}; paths start at the folder of the scene")
    return path


def _table(kind: type, check: Callable[[Any, _Place], Any] | None = None, /, **readers: Reader) -> Reader:
    """Read a table into a dataclass; `check` returns the instance, or what stands for it, or fails."""
    required = {f.name for f in fields(kind) if f.default is MISSING}

    def read(value: Any, key: str, at: _Place) -> Any:
        _check_keys(value, tuple(readers), at)
        for name in readers:
            if name not in value and _FIELDS.get(name, name) in required:
                at.fail(f"{name!r} is missing")
        found = {
            _FIELDS.get(name, name): reader(value[name], name, at) for name, reader in readers.items() if name in value
        }
        made = kind(**found)
        return check(made, at) if check else made

    return read


def _section(table: Reader) -> Reader:
    """Read a table that stands at a key, whose name becomes part of the place."""
    return lambda value, key, at: table(value, key, at.inside(key if at.table else f"[{key}]"))


def _tagged(**kinds: Reader) -> Reader:
    """Read a table that says in `type` which of `kinds` it is."""

    def read(value: Any, key: str, at: _Place) -> Any:
        if not isinstance(value, Mapping):
            at.fail(f"must be a table of keys and values, not {_shown(value)}")
        if "type" not in value:
            at.fail(f"'type' is missing; it is one of {', '.join(kinds)}")
        kind = _choice(tuple(kinds))(value["type"], "type", at)
        return kinds[kind]({name: item for name, item in value.items() if name != "type"}, key, at)

    return read


def _tables(title: str, table: Reader, most: int, least: int = 0) -> Reader:
    """Read an array of tables, each called by its number and its name or type."""

    def read(value: Any, key: str, at: _Place) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or len(value) < least:
            some = "one or more tables" if least else "tables"
            at.fail(f"{key} must be a list of {some}: head each with {title}")
        if len(value) > most:
            at.fail(f"there are {len(value)} {title}, and at most {most} can be; join them")
        found = []
        for i, item in enumerate(value, 1):
            label = item.get("name", item.get("type")) if isinstance(item, Mapping) else None
            known = isinstance(label, str) and label.isprintable() and 0 < len(label) <= 60
            found.append(table(item, key, at.inside(f"{title} {i}" + (f" ({label})" if known else ""))))
        return tuple(found)

    return read


def _absorption(value: Any, key: str, at: _Place) -> Absorption:
    """Read a coefficient, three of them, the name of a material, or a spectrum."""
    element = _number(0.0)
    if isinstance(value, list | tuple):
        return Absorption("rgb", _triple(value, key, at, element))
    if isinstance(value, str):
        at.fail(f'{key} must be numbers or a table, not {_shown(value)}; of a material it is {{ material = "ice" }}')
    if not isinstance(value, Mapping):
        return Absorption("grey", (element(value, key, at),))
    at = at.inside(key)
    if "material" in value:
        _check_keys(value, ("material",), at)
        name = _text(value["material"], "material", at)
        try:
            return Absorption("spectral", material=absorbing_material(name, at.folder))
        except TSDFError as error:
            at.fail(f"material: {error}")
    if asked := [name for name in COLOURS if name in value]:
        _check_keys(value, (asked[0], "thickness"), at)
        thick = _number(above=0.0)(value["thickness"], "thickness", at) if "thickness" in value else math.inf
        colour = _colour()(value[asked[0]], asked[0], at)
        try:
            check_colour(colour)
        except UsageError as error:
            at.fail(f"{asked[0]}: {error}")
        return Absorption("colour", colour=colour, thickness=thick)
    names = ("wavelength_nm", "coefficient")
    _check_keys(value, ("material", *COLOURS, *names), at)
    for name in names:
        if name not in value:
            at.fail(f"{name!r} is missing; a spectrum is wavelength_nm and coefficient, or else say the material")
    nm, sigma_a = (_numbers(value[name], name, at, element) for name in names)
    if len(nm) != len(sigma_a):
        at.fail(f"wavelength_nm and coefficient must be of one length, not {len(nm)} and {len(sigma_a)}")
    if any(a >= b for a, b in pairwise(nm)):
        at.fail("wavelength_nm must ascend")
    low, high = VISIBLE_NM
    if not nm or nm[0] > low or nm[-1] < high:
        covered = f"not only {nm[0]:g} to {nm[-1]:g}" if nm else "not nothing"
        at.fail(f"wavelength_nm must cover {low:g} to {high:g} nm, {covered}")
    return Absorption("spectral", sigma_a, nm)


def _grain(table: Reader, keys: Sequence[str]) -> Reader:
    """Read a kind of grain, whose colour may stand in the place of its absorption."""

    def read(value: Any, key: str, at: _Place) -> GrainSpec:
        _check_keys(value, (*keys, *COLOURS), at)
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

    def read(value: Any, key: str, at: _Place) -> MediumSpec:
        _check_keys(value, (*keys, *WORDS), at)
        if not any(name in value for name in WORDS if name not in keys):
            plain: MediumSpec = table(value, key, at)
            return plain
        words = {name: _POSITIVE(value[name], name, at) for name in WORDS if name in value}
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


def _in_numbers(medium: MediumSpec, metres_per_unit: float | None, at: _Place) -> MediumSpec:
    """Return a medium whose sizes and colours are numbers of ours, by the tables it names."""
    coloured = [grain.absorption.kind == "colour" for grain in medium.grains]
    if not medium.sizes and not any(coloured):
        return medium
    try:
        tables = [g.table if isinstance(g.table, Table) else format.read(g.table) for g in medium.grains]
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


# --- what must hold between the values of one table ---------------------------------


def _turned(degrees: float) -> tuple[float, float]:
    """Return cosine and sine of an angle, exact at right angles."""
    if degrees % 90.0 == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(degrees // 90.0) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def _direction(v: Triple) -> Triple | None:
    """Return `v` at unit length, None where it has none."""
    length = math.hypot(*v)
    return (v[0] / length, v[1] / length, v[2] / length) if length > 0.0 else None


def _parallel(a: Triple, b: Triple) -> bool:
    """Return whether two unit vectors span no plane, to 1e-6."""
    return math.hypot(*np.cross(a, b)) < 1e-6


def _check_camera(camera: Camera, at: _Place) -> Camera:
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


def _check_sun(sun: SunLight, at: _Place) -> SunLight:
    direction = _direction(sun.direction)
    if direction is None:
        at.fail("direction has no length; it points toward the sun")
    return replace(sun, direction=direction)


def _check_box(box: Box, at: _Place) -> Box:
    for axis, low, high in zip("xyz", box.low, box.high, strict=True):
        if low >= high:
            at.fail(f"low must be below high, but in {axis} it is {low:g} against {high:g}")
        if high - low < SMALLEST:
            at.fail(f"low must be at least {SMALLEST:g} below high, but in {axis} it is {high - low:g}")
    return box


def _check_slab(slab: Slab, at: _Place) -> Slab:
    if slab.low >= slab.high:
        at.fail(f"low must be below high, not {slab.low:g} against {slab.high:g}")
    return slab


def _check_rectangle(rectangle: Rectangle, at: _Place) -> Rectangle:
    u, v = _direction(rectangle.u), _direction(rectangle.v)
    if u is None or v is None or _parallel(u, v):
        at.fail("u and v span no area; they are the half edges, not zero and not parallel")
    if min(math.hypot(*rectangle.u), math.hypot(*rectangle.v)) < SMALLEST:
        at.fail(f"u and v must be at least {SMALLEST:g} long")
    return rectangle


def _check_medium(medium: MediumSpec, at: _Place) -> MediumSpec:
    if not any(grain.fraction > 0.0 for grain in medium.grains):
        at.fail("the fractions of all grains are 0; give one of them a share > 0")
    return medium


def _check_scene(scene: Scene, at: _Place) -> Scene:
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


# --- the keys of each table ---------------------------------------------------------

_ANY, _POSITIVE, _NOT_NEGATIVE = _number(), _number(above=0.0), _number(0.0)
_COORDINATE = _number(-FARTHEST, FARTHEST)
_MESH = _table(Mesh, file=_file, scale=_POSITIVE, rotate=_triple, translate=_place, up=_choice(UP))
_BOX = _table(Box, _check_box, low=_place, high=_place)
_SPHERE = _table(Sphere, centre=_place, radius=_POSITIVE)
_SLAB = _table(Slab, _check_slab, low=_COORDINATE, high=_COORDINATE)
_RECTANGLE = _table(Rectangle, _check_rectangle, centre=_place, u=_place, v=_place)
_LIGHT = _tagged(
    constant=_table(ConstantLight, radiance=_colour()),
    environment=_table(EnvironmentLight, file=_file, scale=_NOT_NEGATIVE, rotation_deg=_ANY),
    sun=_table(
        SunLight,
        _check_sun,
        direction=_triple,
        irradiance=_colour(),
        angular_diameter_deg=_number(above=0.0, high=180.0, why="0 would make a zero-area light"),
    ),
)
_GRAIN_KEYS: dict[str, Reader] = {
    "table": _file, "fraction": _NOT_NEGATIVE, "mesh": _file, "absorption": _absorption,
}  # fmt: skip
_GRAIN = _grain(_table(GrainSpec, **_GRAIN_KEYS), tuple(_GRAIN_KEYS))
_MEDIUM_KEYS: dict[str, Reader] = {
    "name": _name,
    "shape": _section(_tagged(mesh=_MESH, box=_BOX, sphere=_SPHERE, slab=_SLAB)),
    "packing_fraction": _number(above=0.0, high=MAX_PACKING_FRACTION, why="equal spheres fill at most 0.7405"),
    "radius": _POSITIVE,
    "inside": _choice(INSIDE),
    "packing_seed": _integer(),
    "packing_spheres": _integer(1, MAX_SPHERES),
    "grain": _tables("[[medium.grain]]", _GRAIN, MAX_GRAINS, 1),
}
_MEDIUM = _medium(_table(MediumSpec, _check_medium, **_MEDIUM_KEYS), tuple(_MEDIUM_KEYS))
_SURFACE = _table(
    SurfaceSpec,
    name=_name,
    shape=_section(_tagged(rectangle=_RECTANGLE, mesh=_MESH, box=_BOX, sphere=_SPHERE)),
    reflectance=_colour(1.0),
)


def _leap(value: Any, key: str, at: _Place) -> float:
    """Read the smallest radius of leaps: 0 for none, else 1 or more."""
    leap: float = _number(0.0)(value, key, at)
    if 0.0 < leap < 1.0:
        at.fail(f"{key} must be 0 (none) or at least 1, not {leap:g}; leaps that short are biased")
    return leap


def _check_render(render: Render, at: _Place) -> Render:
    if render.leap and not levels.LEVELS[render.level].traits.leaps:
        at.fail(f"level {render.level} cannot leap, for its grains have their places; leave out leap, or say 0")
    return render


_CAMERA = _table(
    Camera,
    _check_camera,
    position=_place,
    target=_place,
    up=_triple,
    fov_deg=_number(above=0.0, below=180.0),
    width=_integer(1, MAX_SIDE),
    height=_integer(1, MAX_SIDE),
    exposure=_number(-100.0, 100.0),
)
_SCENE = _table(
    Scene,
    _check_scene,
    metres_per_unit=_POSITIVE,
    camera=_section(_CAMERA),
    render=_section(
        _table(
            Render,
            _check_render,
            level=_choice(LEVELS),
            spp=_integer(1, MAX_SAMPLES),
            seed=_integer(),
            leap=_leap,
            explicit_grains=_integer(0, MAX_EXPLICIT),
        )
    ),
    light=_tables("[[light]]", _LIGHT, MAX_LIGHTS),
    medium=_tables("[[medium]]", _MEDIUM, MAX_MEDIA),
    surface=_tables("[[surface]]", _SURFACE, MAX_SURFACES),
)
