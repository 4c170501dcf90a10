"""Specifications: what is rendered, as plain frozen dataclasses. The TOML text that says it is read by `scene`.

Lengths are in scene units, axes right-handed, radiances linear RGB.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.grain import constants
from tsdf.grain.materials import optical_constants

UP = ("z", "y")
INSIDE = ("grains", "centres")
METRES_PER_NM = 1e-9
VISIBLE_NM = (380.0, 780.0)  # [nm] where light is seen
KNOWN_NM = (400.0, 700.0)  # [nm] what a spectrum must cover; beyond, its ends are held, for light there hardly shows
SPP = 64  # samples per pixel, where nothing says when to stop
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

    level: str = "auto"  # one of LEVELS, or whichever a plan takes
    spp: int | None = None  # samples per pixel; None where it is not said
    seed: int = 0
    leap: float | None = None  # smallest leap [transport mean free paths], 0 for none; None where it is not said
    explicit_grains: int = 0  # met one by one, the first from the camera, before a chain of grains takes over
    fewer_far: bool = False  # so many only where grains look largest, fewer where a pixel covers more of them


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
                cosine, sine = turned(degrees)
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
    grey is the same at all. What covers `KNOWN_NM` is held at its ends within `VISIBLE_NM`; see `held`.

    Parameters
    ----------
    spec : Absorption
    wavelengths_nm : (k,) array_like
        [nm], inside the given spectrum or the range of the material, or seen where their ends are held.
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
    nm = _held(nm, (spec.wavelength_nm[0], spec.wavelength_nm[-1]), "the absorption spectrum")
    return np.interp(nm, spec.wavelength_nm, spec.coefficient)


def held(spec: Absorption) -> tuple[float, float] | None:
    """Return where a spectrum ends [nm] of which an end is held to where light is seen no more; None if none is."""
    if spec.kind != "spectral" or isinstance(spec.material, str):
        return None
    low, high = constants.read(spec.material)[1] if spec.material else (spec.wavelength_nm[0], spec.wavelength_nm[-1])
    return (low, high) if low > VISIBLE_NM[0] or high < VISIBLE_NM[1] else None


def _held(nm: np.ndarray, known: tuple[float, float], name: str) -> np.ndarray:
    """Return wavelengths [nm], those beyond an end that is held at that end."""
    low, high = known
    least = min(low, VISIBLE_NM[0]) if low <= KNOWN_NM[0] else low
    most = max(high, VISIBLE_NM[1]) if high >= KNOWN_NM[1] else high
    if not ((nm >= least) & (nm <= most)).all():
        raise UsageError(f"{name} is known from {low:g} to {high:g} nm only")
    return np.clip(nm, low, high)


def _absorption_index(material: str | Path, nm: np.ndarray) -> np.ndarray:
    """Return k of a built-in material or of a file at wavelengths [nm], (n,) float64."""
    if isinstance(material, str):
        return np.array([optical_constants(material, w).k for w in nm.tolist()], dtype=np.float64)
    medium, known = constants.read(material)
    if medium.k is None:
        raise UsageError(f"{material}: does not say k")
    nm = _held(nm, known, f"{material}: k")
    return np.array([medium.k(w) for w in nm.tolist()], dtype=np.float64)


def turned(degrees: float) -> tuple[float, float]:
    """Return cosine and sine of an angle, exact at right angles."""
    if degrees % 90.0 == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(degrees // 90.0) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
