"""Images: OpenEXR in and out, 8-bit PNG, and the linear-sRGB weights of wavelengths.

Pixels are linear sRGB (Rec. 709 primaries, white D65), (h, w, 3), row 0 on top. The one door to colour-science and,
beside `format`, to OpenEXR. The directions that the pixels of an environment stand for are in `lights`.
"""

import contextlib
import io
import math
import os
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tsdf.errors import TSDFError, UsageError
from tsdf.files import replacing

MAGIC = b"\x76\x2f\x31\x01"
MAX_SIDE = 2**16
MAX_IMAGE = 2**27
MAX_EXPOSURE = 128.0  # [stops]
WAVELENGTHS_NM = tuple(float(nm) for nm in range(385, 780, 10))
WINDOWS = ("dataWindow", "displayWindow")
MAX_NUMBERS = 2**25  # of an environment out of a small file: four channels of 4096 x 2048
SMALL = 10_000_000  # [B] files that must be read within a gigabyte of memory
DENSEST = 8  # numbers for each byte of a larger file: 8192 x 4096 pixels fit well into 13 MB of lossy compression
STDERR = 2  # its file descriptor
OBSERVER = "observer.csv"  # in tsdf.reference_data: the CIE 1931 2-degree observer and D65
XYZ_TO_RGB = np.array(  # IEC 61966-2-1
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
LOST = 1e-3  # share of the light of an environment, below which what is negative is the overshoot of a filter
LARGEST_HALF = 65504.0  # beyond which 16-bit floats are infinite
OTHERS = {b"#?": "Radiance HDR", b"\x89PNG": "PNG", b"\xff\xd8\xff": "JPEG", b"II*\0": "TIFF", b"MM\0*": "TIFF"}


@dataclass(frozen=True, eq=False)
class Image:
    """What is in an OpenEXR file.

    Parameters
    ----------
    rgb : (h, w, 3) float32
        Linear colour; the three are equal where the file has only luminance.
    variance : (h, w, 3) float32, optional
        Variance of `rgb`, where the file has the channels variance.R, variance.G and variance.B.
    attributes : dict of str
        The string attributes of the header.
    """

    rgb: np.ndarray
    variance: np.ndarray | None = None
    attributes: dict[str, str] = field(default_factory=dict)


class Spectrum(NamedTuple):
    """Wavelengths and what each adds to linear sRGB."""

    wavelength_nm: np.ndarray  # (k,) float64 [nm]
    weight: np.ndarray  # (k, 3) float64 [1], columns sum to 1; negative for light outside the gamut


def write_exr(
    path: str | os.PathLike[str],
    rgb: npt.ArrayLike,
    variance: npt.ArrayLike | None = None,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write an image as OpenEXR: one part, scan lines, ZIP, float32.

    Parameters
    ----------
    path : path
        Replaced only once the new file is whole.
    rgb : (h, w, 3) float
        Linear colour, channels R, G, B. Values that are not finite are written as they are, and those beyond
        float32 as infinity.
    variance : (h, w, 3) float, optional
        Variance of `rgb`, channels variance.R, variance.G, variance.B.
    attributes : mapping of str to str, optional
        String attributes of the header.

    Raises
    ------
    UsageError
        If shapes are wrong or an attribute is not text.
    TSDFError
        If the file cannot be written.

    Examples
    --------
    >>> write_exr("grey.exr", [[[0.5, 0.5, 0.5]]], attributes={"made_by": "me"})
    >>> read_exr("grey.exr").attributes["made_by"]
    'me'
    """
    import OpenEXR

    attributes = dict(attributes or {})
    for name, value in attributes.items():
        if not isinstance(name, str) or not isinstance(value, str) or not name:
            raise UsageError(f"attributes of an image must be texts with a name, got {value!r} for {name!r}")
    pixels = {"": _pixels(rgb, "rgb")}
    if variance is not None:
        pixels["variance."] = _pixels(variance, "variance")
        if pixels["variance."].shape != pixels[""].shape:
            raise UsageError(f"variance has the shape {pixels['variance.'].shape}, not {pixels[''].shape} as rgb")
    channels = {  # OpenEXR writes arrays that are not contiguous wrong, without a word
        layer + c: np.ascontiguousarray(p[..., i]) for layer, p in pixels.items() for i, c in enumerate("RGB")
    }
    header = attributes | {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    try:
        with replacing(path) as temporary:
            OpenEXR.File(header, channels).write(str(temporary))
            _check_written(temporary, Image(pixels[""], pixels.get("variance."), attributes))
    except (RuntimeError, ValueError, TypeError) as error:  # OpenEXR raises the first
        raise TSDFError(f"cannot write {os.fspath(path)}: {_one_line(error)}") from error


def read_exr(path: str | os.PathLike[str]) -> Image:
    """Return the image in an OpenEXR file.

    The first part that has channels R, G, B, in any order and of any number type, or else a channel Y, or else the only
    layer of colour (say Combined.R, .G, .B). The display window is returned; what the data window leaves out of it is
    0. Alpha is not looked at: colours are premultiplied. Of a mip map the finest level is read.

    Raises
    ------
    TSDFError
        If there is no such file, it is not an OpenEXR image of colour, or it is truncated. Not all damage can be
        seen: OpenEXR has no checksums.

    Examples
    --------
    >>> image = read_exr("sky.exr")
    >>> image.rgb.shape, image.variance is None
    ((4, 8, 3), True)
    """
    return _read(path, math.inf)[0]


def _read(path: str | os.PathLike[str], most: float) -> tuple[Image, Mapping[str, Any]]:
    """Return the image in an OpenEXR file of so many numbers at most, and the header of its part."""
    import OpenEXR

    name = os.fspath(path)
    _check_kind(path)
    damaged = f"{name}: the file is damaged or truncated, fetch or make it again"
    try:
        with _hushed():
            headers = [part.header for part in OpenEXR.File(os.fsdecode(path), header_only=True).parts]
        _check_sizes(name, headers, most)  # before the pixels: OpenEXR allocates whatever a damaged header asks for
        if headers and all("deep" in str(header["type"]) for header in headers):
            raise TSDFError(f"{name}: its pixels are deep (several samples each), not an image; flatten it")
        with _hushed():
            parts = OpenEXR.File(os.fsdecode(path), separate_channels=True).parts
    except (RuntimeError, ValueError, TypeError, KeyError, IndexError, MemoryError) as error:
        raise TSDFError(f"{damaged} ({_one_line(error)})") from error
    # OpenEXR leaves out the parts it cannot read, and only prints so
    if not headers or len(parts) != len(headers):
        raise TSDFError(damaged)
    both = [(header, part.channels) for header, part in zip(headers, parts, strict=True)]
    flat = [(header, channels) for header, channels in both if "deep" not in str(header["type"])]
    for layer in ("", *_layers(name, flat)):
        for header, channels in flat:
            variance = None
            if rgb := _planes(header, channels, tuple(layer + c for c in "RGB")):
                variance = _planes(header, channels, ("variance.R", "variance.G", "variance.B"))
            elif not {"RY", "BY", "X"} & set(channels):
                rgb = _planes(header, channels, ("Y", "Y", "Y"))
            if rgb:
                texts = {key: value for key, value in header.items() if isinstance(value, str)}
                return Image(np.stack(rgb, axis=-1), np.stack(variance, axis=-1) if variance else None, texts), header
    raise TSDFError(f"{name}: {_why_no_colour(flat)}; save it as an image with channels R, G, B")


def _check_kind(path: str | os.PathLike[str]) -> None:
    """Refuse what is no OpenEXR file by its first bytes, or cannot be read."""
    name = os.fspath(path)
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise TSDFError(f"{name} is not a regular file; name an .exr image")
        with open(path, "rb") as file:
            magic = file.read(12)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TSDFError(f"cannot read {name}: {reason}; check the name and the permissions") from error
    if not magic.startswith(MAGIC):
        kind = next((kind for start, kind in OTHERS.items() if magic.startswith(start)), "")
        way_out = (
            f"but {kind}; save it as OpenEXR, with a converter or an image editor" if kind else "name an .exr image"
        )
        raise TSDFError(f"{name} is not an OpenEXR file (bytes 0), {way_out}")


def _check_sizes(name: str, headers: Sequence[Mapping[str, Any]], most: float) -> None:
    """Refuse parts that are too large, each or together."""
    numbers = 0
    for header in headers:
        for window in WINDOWS:
            height, width = _size(header[window])
            numbers += height * width * (len(header["channels"]) if window == "dataWindow" else 0)
            if not _readable(height, width):
                raise TSDFError(f"{name}: {width} x {height} pixels ({window}) are not an image this reads; shrink it")
            if numbers > most:
                raise TSDFError(
                    f"{name}: {width} x {height} pixels ({window}) are {numbers:.2g} numbers in all channels, and "
                    f"{most:.2g} are read out of a file of its size; shrink it, or leave out other channels"
                )


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Keep the lines in which OpenEXR itself tells of damage out of both streams: an error of ours is one line."""
    try:
        kept = os.dup(STDERR)
    except OSError:  # closed on purpose
        kept = None
    with contextlib.redirect_stdout(io.StringIO()):  # its Python module prints there, its C library on the other
        try:
            if kept is not None:
                with open(os.devnull, "wb") as nowhere:
                    os.dup2(nowhere.fileno(), STDERR)
            yield
        finally:
            if kept is not None:
                os.dup2(kept, STDERR)
                os.close(kept)


def _layers(name: str, parts: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> list[str]:
    """Return what stands before R, G, B in the names of channels, if that is one layer only or there is a plain one."""
    names = {channel for _, channels in parts for channel in channels}
    if {"R", "G", "B"} <= names or "Y" in names:
        return []
    layers = sorted(n[:-1] for n in names if n.endswith(".R") and {n[:-1] + "G", n[:-1] + "B"} <= names)
    layers = [layer for layer in layers if layer != "variance."]
    if len(layers) > 1:
        raise TSDFError(
            f"{name}: no plain channels R, G, B, but {len(layers)} layers ({', '.join(v[:-1] for v in layers):.100}); "
            "save the one that is meant as R, G, B"
        )
    return layers


def _why_no_colour(parts: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> str:
    """Return why none of the parts is an image of colour."""
    channels = {name: channel for _, part in parts for name, channel in part.items()}
    if {"X", "Y", "Z"} <= set(channels):
        return "its channels X, Y, Z are of CIE XYZ"
    if {"RY", "BY"} & set(channels):
        return "it has luminance and chroma (Y, RY, BY)"
    thinned = [name for name, c in channels.items() if (c.xSampling, c.ySampling) != (1, 1)]
    if thinned and {"R", "G", "B"} <= set(channels):
        return f"its channel {thinned[0]} is subsampled"
    return f"no full-size channels R, G, B or Y, but {', '.join(sorted(channels)) or 'none':.100}"


class Environment(NamedTuple):
    """Radiance from all directions, and what a user should know of it."""

    radiance: np.ndarray  # (h, w, 3) float64, linear sRGB, finite and >= 0
    notes: tuple[str, ...]  # one line each
    warnings: tuple[str, ...]  # those of the notes that mean other light than that of the file


def read_environment(path: str | os.PathLike[str]) -> Environment:
    """Return the radiance of a latitude-longitude environment from an OpenEXR file.

    Pixels that are no radiance are mended, and a note says how many: what is negative or not a number becomes 0, what
    is infinite the largest half-float, or the largest finite number of the image if that is more. Colours of other
    primaries (ACES, say), if the file states them, are converted to linear sRGB. Notes also tell of an image that is
    not twice as wide as high, but for one column, and of a data window that is not the whole image.

    Raises
    ------
    TSDFError
        As `read_exr`; also if it is a cube map by its attribute ``envmap`` or a table of grains, if all pixels are
        black, and for an image of more than 2^25 numbers, and more numbers than the file has bytes (eight times as many
        from 10 MB on).
    """
    name = os.fspath(path)
    try:
        size = os.path.getsize(path)
    except (OSError, ValueError):
        size = 0  # `_read` says why
    picture, header = _read(path, max(MAX_NUMBERS, DENSEST * size if size >= SMALL else size))
    if "tsdf" in header:
        raise TSDFError(f"{name}: a table of grains (TSDF) and no picture; name an environment")
    if "CUBE" in str(header.get("envmap")):
        raise TSDFError(f"{name}: a cube map by its attribute envmap; convert it to latitude-longitude (exrenvmap)")
    rgb = picture.rgb.astype(np.float64)
    height, width = rgb.shape[:2]
    notes = []
    if width not in (1, 2 * height):
        notes.append(
            f"{width} x {height} pixels, not twice as wide as high: is it a panorama? It is taken as one of all "
            "directions, in latitude and longitude"
        )
    if any((a != b).any() for a, b in zip(*(np.asarray(header[window]) for window in WINDOWS), strict=True)):
        notes.append("its data window is not its display window, which is taken as all directions; outside it is black")
    rgb, senseless = _srgb(rgb, header, notes)
    if not (rgb > 0.0).any():
        raise TSDFError(f"{name}: every pixel is {_dark(rgb)}, so it lights nothing; name another image")
    warned = [*senseless, *_mend(rgb, notes)]
    said, told = (tuple(f"{name}: {note}" for note in part) for part in (notes, warned))
    return Environment(rgb, said, told)


def _dark(rgb: np.ndarray) -> str:
    """Return what pixels are of which none is light."""
    kinds = {"negative": (rgb < 0.0).any(axis=2), "not a number": np.isnan(rgb).any(axis=2)}
    black = ["black"] * bool((rgb == 0.0).all(axis=2).any())
    return " or ".join(black + [f"{kind} ({int(bad.sum())} pixels)" for kind, bad in kinds.items() if bad.any()])


def _srgb(rgb: np.ndarray, header: Mapping[str, Any], notes: list[str]) -> tuple[np.ndarray, list[str]]:
    """Return colours in linear sRGB of those with the primaries and the white point that a header states, and which of
    the notes that are added is a warning."""
    stated = header.get("chromaticities")
    if stated is None:
        return rgb, []
    primaries = np.asarray(stated, dtype=np.float64).reshape(4, 2)
    colour = _colour()
    target = colour.RGB_COLOURSPACES["sRGB"]
    if np.abs(primaries - np.vstack((target.primaries, target.whitepoint))).max() < 1e-3:
        return rgb, []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            source = colour.RGB_Colourspace("stated", primaries[:3], primaries[3])
            matrix = np.asarray(colour.matrix_RGB_to_RGB(source, target, "Bradford"))
        except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
            matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        notes.append("its attribute chromaticities makes no sense; its colours are taken as linear sRGB")
        return rgb, notes[-1:]
    notes.append("colours converted to linear sRGB from the primaries that it states (chromaticities)")
    with np.errstate(invalid="ignore", over="ignore"):
        return rgb @ matrix.T, []


def _mend(rgb: np.ndarray, notes: list[str]) -> list[str]:
    """Make every number of an image a radiance, in place, note how many were none, and return which of these notes are
    warnings."""
    before = len(notes)

    def pixels(bad: np.ndarray) -> str:
        count = int(bad.any(axis=2).sum())
        return f"{count} pixel{'s are' if count > 1 else ' is'} "

    nothing = np.isnan(rgb)
    if nothing.any():
        notes.append(f"{pixels(nothing)}not a number: taken as 0")
        rgb[nothing] = 0.0
    endless = rgb == math.inf
    if endless.any():
        most = max(LARGEST_HALF, float(rgb[~endless].max(initial=0.0)))
        notes.append(f"{pixels(endless)}infinite: taken as {most:g}")
        rgb[endless] = most
    negative = rgb < 0.0
    if negative.any():
        lowest, total = float(rgb.min()), float(rgb.sum(where=~negative))
        lost = -float(rgb.sum(where=negative)) / total if total > 0.0 else math.inf
        notes.append(
            f"{pixels(negative)}negative, down to {lowest:.2g}, {100.0 * lost:.2g} % of the sum of all: taken as 0"
        )
        rgb[negative] = 0.0
        return notes[before:] if lost > LOST else notes[before:-1]
    return notes[before:]


def encoded(rgb: npt.ArrayLike, exposure: float = 0.0) -> np.ndarray:
    """Return an image as 8-bit sRGB (IEC 61966-2-1), (h, w, 3) uint8; see `write_png`."""
    if not abs(exposure) <= MAX_EXPOSURE:
        raise UsageError(f"exposure must be -{MAX_EXPOSURE:g} to {MAX_EXPOSURE:g} stops, got {exposure}")
    linear = _pixels(rgb, "rgb").astype(np.float64) * 2.0**exposure
    linear = np.clip(np.nan_to_num(linear), 0.0, 1.0)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * shown).astype(np.uint8)


def write_png(path: str | os.PathLike[str], rgb: npt.ArrayLike, exposure: float = 0.0) -> None:
    """Write an image as 8-bit sRGB.

    Parameters
    ----------
    path : path
        Replaced only once the new file is whole.
    rgb : (h, w, 3) float
        Linear colour; clipped to [0, 1] after the exposure. What is not a number becomes black.
    exposure : float
        Multiplies `rgb` by 2**exposure [stops], in [-128, 128].
    """
    import PIL.Image

    picture = PIL.Image.fromarray(encoded(rgb, exposure))
    with replacing(path) as temporary:
        picture.save(temporary, format="PNG")


@lru_cache
def spectral_weights(wavelengths: tuple[float, ...] | None = None) -> Spectrum:
    """Return what each wavelength of a reflectance or transmittance adds to its linear sRGB under D65.

    ``weight.T @ S`` is the colour of a spectrum S given at the wavelengths, seen by the CIE 1931 2-degree observer:
    colour matching functions times D65 (CIE 15:2018, 7.1) in steps of 1 nm from 380 to 780 nm, each step counted to
    the nearest wavelength, times the matrix of IEC 61966-2-1. Columns are scaled to sum to 1, so that white stays
    (1, 1, 1); that moves them by 4e-4 at most. Cells of 10 nm give the colour of light through ice to 1e-3.

    Parameters
    ----------
    wavelengths : tuple of float, optional
        Ascending, more than 0 [nm]. None: the centres of the cells of 10 nm, 385 to 775.
    """
    nodes = np.array(WAVELENGTHS_NM if wavelengths is None else wavelengths, dtype=np.float64)
    if (
        nodes.ndim != 1
        or not nodes.size
        or not (np.isfinite(nodes).all() and nodes[0] > 0 and (np.diff(nodes) > 0).all())
    ):
        raise UsageError("wavelengths must be finite, ascending and more than 0 nm")
    with (resources.files("tsdf.reference_data") / OBSERVER).open(encoding="ascii") as file:
        nm, x, y, z, light = np.loadtxt(file, delimiter=",", skiprows=2, unpack=True)
    light[[0, -1]] *= 0.5  # the trapezoidal rule
    rgb = (light[:, None] * np.stack([x, y, z], axis=1)) @ XYZ_TO_RGB.T
    distance = np.abs(nm - nodes[:, None])
    nearest = distance == distance.min(axis=0)
    weight = (nearest / nearest.sum(axis=0)) @ (rgb / rgb.sum(axis=0))  # a step halfway counts half to each
    for array in (nodes, weight):
        array.flags.writeable = False
    return Spectrum(nodes, weight)


def _colour() -> Any:
    """Return colour-science, which on import warns of what is not there and changes how numpy prints numbers."""
    printed = np.get_printoptions()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    np.set_printoptions(**printed)
    return colour


def _check_written(path: Path, image: Image) -> None:
    """Raise OSError if a file does not hold an image; OpenEXR does not tell of every failure to write."""
    try:
        found = read_exr(path)
    except TSDFError as error:
        raise OSError("what OpenEXR wrote cannot be read") from error
    none = np.zeros(0)
    for one, other in ((found.rgb, image.rgb), (found.variance, image.variance)):
        if not np.array_equal(none if one is None else one, none if other is None else other, equal_nan=True):
            raise OSError("what OpenEXR wrote does not read back")
    if not image.attributes.items() <= found.attributes.items():
        raise OSError("the attributes that OpenEXR wrote do not read back")


def _pixels(rgb: npt.ArrayLike, name: str) -> np.ndarray:
    with np.errstate(over="ignore"):
        pixels = np.asarray(rgb).astype(np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not _readable(pixels.shape[0], pixels.shape[1]):
        raise UsageError(
            f"{name} must have the shape (h, w, 3), 1 to {MAX_SIDE} pixels a side and {MAX_IMAGE} in all, "
            f"not {pixels.shape}"
        )
    return pixels


def _readable(height: int, width: int) -> bool:
    return min(height, width) > 0 and max(height, width) <= MAX_SIDE and height * width <= MAX_IMAGE


def _size(window: Any) -> tuple[int, int]:
    """Return height and width of a window of an EXR header."""
    low, high = (np.asarray(corner, dtype=np.int64) for corner in window)
    width, height = high - low + 1
    return int(height), int(width)


def _planes(header: Mapping[str, Any], channels: Mapping[str, Any], names: tuple[str, ...]) -> list[np.ndarray] | None:
    """Return the display window of channels as (h, w) float32 each, None unless all are there and full size."""
    data, display = (_size(header[window]) for window in WINDOWS)
    # where the display window begins in the data window
    x, y = np.asarray(header["displayWindow"][0], dtype=np.int64) - np.asarray(header["dataWindow"][0], dtype=np.int64)
    rows, columns = (np.arange(size) + begin for size, begin in zip(display, (y, x), strict=True))
    rows_in, columns_in = (rows >= 0) & (rows < data[0]), (columns >= 0) & (columns < data[1])
    planes = []
    for name in names:
        pixels = np.asarray(channels[name].pixels) if name in channels else None
        if pixels is None or pixels.shape != data or pixels.dtype.kind not in "fu":
            return None
        plane = np.zeros(display, dtype=np.float32)
        plane[np.ix_(rows_in, columns_in)] = pixels[np.ix_(rows[rows_in], columns[columns_in])]
        planes.append(plane)
    return planes


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
