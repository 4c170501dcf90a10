"""Images: OpenEXR in and out, 8-bit PNG, and the linear-sRGB weights of wavelengths.

Pixels are linear sRGB (Rec. 709 primaries, white D65), (h, w, 3), row 0 on top. The one door to colour-science and,
beside `format`, to OpenEXR. The directions that the pixels of an environment stand for are in `lights`.
"""

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tsdf.errors import TSDFError, UsageError
from tsdf.files import replacing

MAGIC = b"\x76\x2f\x31\x01"
MAX_SIDE = 2**16
MAX_PIXELS = 2**27
MAX_EXPOSURE = 128.0  # [stops]
WAVELENGTHS_NM = tuple(float(nm) for nm in range(385, 780, 10))
WINDOWS = ("dataWindow", "displayWindow")


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

    The first part that has channels R, G, B, in any order and of any number type, or else a channel Y. The display
    window is returned; what the data window leaves out of it is 0.

    Raises
    ------
    TSDFError
        If there is no such file, it is not an OpenEXR image of colour, or it is truncated. Not all damage can be
        seen: OpenEXR has no checksums.
    """
    import OpenEXR

    name = os.fspath(path)
    try:
        with open(path, "rb") as file:
            magic = file.read(4)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TSDFError(f"cannot read {name}: {reason}; check the name and the permissions") from error
    if magic != MAGIC:
        raise TSDFError(f"{name} is not an OpenEXR file (bytes 0); name an .exr image")
    damaged = f"{name}: the file is damaged or truncated, fetch or make it again"
    try:
        headers = [part.header for part in OpenEXR.File(os.fsdecode(path), header_only=True).parts]
        for header in headers:  # before the pixels, for OpenEXR allocates whatever a damaged header asks for
            for window in WINDOWS:
                height, width = _size(header[window])
                if not _readable(height, width):
                    raise TSDFError(
                        f"{name}: {width} x {height} pixels ({window}) are not an image this reads; shrink it"
                    )
        parts = OpenEXR.File(os.fsdecode(path), separate_channels=True).parts
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise TSDFError(f"{damaged} ({_one_line(error)})") from error
    # OpenEXR leaves out the parts it cannot read, and only prints so
    if not headers or len(parts) != len(headers):
        raise TSDFError(damaged)
    for header, part in zip(headers, parts, strict=True):
        channels = part.channels
        if rgb := _planes(header, channels, ("R", "G", "B")):
            variance = _planes(header, channels, ("variance.R", "variance.G", "variance.B"))
        elif "RY" not in channels and (rgb := _planes(header, channels, ("Y", "Y", "Y"))):
            variance = None
        else:
            continue
        texts = {key: value for key, value in header.items() if isinstance(value, str)}
        return Image(np.stack(rgb, axis=-1), np.stack(variance, axis=-1) if variance else None, texts)
    names = ", ".join(sorted({channel for part in parts for channel in part.channels})) or "none"
    raise TSDFError(f"{name}: no full-size channels R, G, B or Y, but {names:.100}; save it as an RGB image")


def read_environment(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the radiance of an environment, (h, w, 3) float64, from an OpenEXR file.

    Raises
    ------
    TSDFError
        As `read_exr`; also if a pixel is not a number, infinite or negative, or if all are black.
    """
    rgb = read_exr(path).rgb.astype(np.float64)
    name = os.fspath(path)
    bad = ~(np.isfinite(rgb) & (rgb >= 0.0))
    if bad.any():
        row, column, channel = np.argwhere(bad)[0]
        raise TSDFError(
            f"{name}: the pixel at row {row}, column {column} (from 0 at the top left) has {'RGB'[channel]} = "
            f"{rgb[row, column, channel]:g}; radiance must be finite and not negative, repair the image"
        )
    if not rgb.any():
        raise TSDFError(f"{name}: every pixel is black, so it lights nothing; name another image")
    return rgb


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

    colour = _colour()
    if not abs(exposure) <= MAX_EXPOSURE:
        raise UsageError(f"exposure must be -{MAX_EXPOSURE:g} to {MAX_EXPOSURE:g} stops, got {exposure}")
    linear = _pixels(rgb, "rgb").astype(np.float64) * 2.0**exposure
    encoded = colour.cctf_encoding(np.clip(np.nan_to_num(linear), 0.0, 1.0), function="sRGB")
    picture = PIL.Image.fromarray(np.rint(255.0 * encoded).astype(np.uint8))
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
    colour = _colour()
    nm = np.arange(380.0, 781.0)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    d65 = colour.SDS_ILLUMINANTS["D65"]
    light = np.interp(nm, d65.wavelengths, d65.values)  # CIE 15:2018 interpolates D65 linearly
    light[[0, -1]] *= 0.5  # the trapezoidal rule
    xyz = light[:, None] * np.stack([np.interp(nm, observer.wavelengths, v) for v in observer.values.T], axis=1)
    rgb = xyz @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T
    distance = np.abs(nm - nodes[:, None])
    nearest = distance == distance.min(axis=0)
    weight = (nearest / nearest.sum(axis=0)) @ (rgb / rgb.sum(axis=0))  # a step halfway counts half to each
    for array in (nodes, weight):
        array.flags.writeable = False
    return Spectrum(nodes, weight)


def prepare() -> None:
    """Import what `write_png` needs, which takes a second or more, so that it then writes at once."""
    _colour()


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
            f"{name} must have the shape (h, w, 3), 1 to {MAX_SIDE} pixels a side and {MAX_PIXELS} in all, "
            f"not {pixels.shape}"
        )
    return pixels


def _readable(height: int, width: int) -> bool:
    return min(height, width) > 0 and max(height, width) <= MAX_SIDE and height * width <= MAX_PIXELS


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
