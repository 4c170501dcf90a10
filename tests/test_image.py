"""Images: what is written is what is read, what cannot be meant is refused, colours agree with colour-science."""

import math
import re
import subprocess
import sys
import warnings

import numpy as np
import OpenEXR
import PIL.Image
import pytest

from tsdf.errors import TSDFError, UsageError
from tsdf.image import read_environment, read_exr, spectral_weights, write_exr, write_png
from tsdf.materials import optical_constants

PRINTED = np.get_printoptions()
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import colour
np.set_printoptions(**PRINTED)  # which colour-science changes

SCAN = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}


def random_image(height=40, width=30, seed=0):
    return np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32)


def written(path, channels, **header):
    OpenEXR.File(SCAN | header, {name: np.ascontiguousarray(p) for name, p in channels.items()}).write(str(path))
    return path


# ------------------------------------------------------------------------------------------------ EXR


def test_colour_science_changes_nothing_else() -> None:
    """Its import sets numpy's way of printing, on which other people's output and our golden files depend."""
    code = (
        "import numpy as np; before = np.get_printoptions(); from tsdf import image; image.spectral_weights(); "
        "assert np.get_printoptions() == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_round_trip(tmp_path):
    """Every bit of pixels, variance and attributes returns, also from arrays that are not contiguous."""
    rgb, variance = random_image()[::-1, ::-1], np.asfortranarray(random_image(seed=1) ** 2)
    attributes = {"tsdf_render": '{"level": "teleport", "spp": 64}', "other": "two\nlines and snö"}
    write_exr(tmp_path / "a.exr", rgb, variance, attributes)
    found = read_exr(tmp_path / "a.exr")
    assert np.array_equal(found.rgb, rgb) and np.array_equal(found.variance, variance)
    assert found.rgb.dtype == found.variance.dtype == np.float32
    assert found.attributes == attributes
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    write_exr(tmp_path / "a.exr", rgb.astype(np.float64))
    assert read_exr(tmp_path / "a.exr").variance is None


def test_the_file_is_what_any_viewer_opens(tmp_path):
    """Seen by OpenEXR alone: one part, scan lines, ZIP, six float32 channels with the names that viewers group."""
    rgb = random_image()
    write_exr(tmp_path / "a.exr", rgb, rgb**2)
    (part,) = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).parts
    assert part.header["type"] == OpenEXR.scanlineimage
    assert part.header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert set(part.channels) == {*"RGB", "variance.R", "variance.G", "variance.B"}
    for i, c in enumerate("RGB"):
        assert part.channels[c].pixels.dtype == np.float32
        assert np.array_equal(part.channels[c].pixels, rgb[..., i])
        assert np.array_equal(part.channels[f"variance.{c}"].pixels, rgb[..., i] ** 2)


def test_values_that_are_not_finite_are_kept(tmp_path):
    """A render that went wrong must say so; what float32 cannot hold is infinite."""
    rgb = np.zeros((2, 2, 3))
    rgb[0, 0] = math.nan, math.inf, -math.inf
    rgb[1, 1] = 1e300, 1e-300, -1.0
    write_exr(tmp_path / "a.exr", rgb)
    found = read_exr(tmp_path / "a.exr").rgb
    assert np.array_equal(found[0, 0], [math.nan, math.inf, -math.inf], equal_nan=True)
    assert found[1, 1].tolist() == [math.inf, 0.0, -1.0]


@pytest.mark.parametrize("kind", ["scan", "tiles"])
def test_reads_halves_in_any_order_with_more_channels(tmp_path, kind):
    """What painters and renderers write: halves, alpha, depth, tiles."""
    half = random_image().astype(np.float16)
    channels = {"Z": half[..., 0] * 2, "B": half[..., 2], "A": half[..., 0] * 0, "R": half[..., 0], "G": half[..., 1]}
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()} if kind == "tiles" else {}
    path = written(tmp_path / "a.exr", channels, **tiles)
    found = read_exr(path)
    assert found.rgb.dtype == np.float32 and found.variance is None
    assert np.array_equal(found.rgb, half.astype(np.float32))


def test_reads_luminance_and_the_second_part(tmp_path):
    """A single Y is grey; of several parts the first with colours counts."""
    y = random_image()[..., 0]
    assert np.array_equal(read_exr(written(tmp_path / "y.exr", {"Y": y})).rgb, np.stack([y] * 3, axis=-1))
    rgb = random_image(seed=2)
    parts = [
        OpenEXR.Part(dict(SCAN), {"Z": y}, "depth"),
        OpenEXR.Part(dict(SCAN), {c: np.ascontiguousarray(rgb[..., i]) for i, c in enumerate("RGB")}, "beauty"),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    assert np.array_equal(read_exr(tmp_path / "parts.exr").rgb, rgb)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (-3, -2), (5, 7), (-40, 0), (60, -90)])
def test_the_display_window_is_read(tmp_path, x, y):
    """Crops and overscan: the data window begins at (x, y) of a display of 20 by 10; compared pixel by pixel."""
    rgb = random_image(24, 32)
    display = (np.array([0, 0], np.int32), np.array([19, 9], np.int32))
    data = (np.array([x, y], np.int32), np.array([x + 31, y + 23], np.int32))
    channels = {c: rgb[..., i] for i, c in enumerate("RGB")}
    path = written(tmp_path / "a.exr", channels, dataWindow=data, displayWindow=display)
    found = read_exr(path).rgb
    assert found.shape == (10, 20, 3)
    for row in range(10):
        for column in range(20):
            inside = 0 <= row - y < 24 and 0 <= column - x < 32
            assert np.array_equal(found[row, column], rgb[row - y, column - x] if inside else [0, 0, 0])


def test_truncated_files_are_refused(tmp_path):
    """Cut at any length, the file is never taken for an image; OpenEXR itself only prints and returns less."""
    write_exr(tmp_path / "a.exr", random_image())
    data = (tmp_path / "a.exr").read_bytes()
    for length in [0, 3, 4, 8, 50, 200, *range(300, len(data), 701), len(data) - 1]:
        (tmp_path / "cut.exr").write_bytes(data[:length])
        with pytest.raises(TSDFError, match=r"cut\.exr.*(truncated|not an OpenEXR)") as caught:
            read_exr(tmp_path / "cut.exr")
        assert "\n" not in str(caught.value)


def test_what_is_no_image_is_refused(tmp_path):
    """One line that names the file and the way out."""
    (tmp_path / "text.exr").write_text("hello")
    written(tmp_path / "depth.exr", {"Z": random_image()[..., 0]})
    for name, says in [
        ("none.exr", "No such file.*check the name"),
        (".", "Is a directory.*check"),
        ("nul\0.exr", "null byte"),
        ("text.exr", "not an OpenEXR file"),
        ("depth.exr", "no full-size channels R, G, B or Y, but Z; save"),
    ]:
        with pytest.raises(TSDFError, match=says) as caught:
            read_exr(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_header_that_asks_for_too_much_is_refused(tmp_path):
    """A damaged window must not make anything allocate it; one of 2^30 OpenEXR refuses itself."""
    write_exr(tmp_path / "a.exr", random_image())
    data = (tmp_path / "a.exr").read_bytes()
    for window in (b"displayWindow", b"dataWindow"):
        at = data.index(window + b"\0box2i\0") + len(window) + 1 + 6 + 4
        for corner, says in [(99_999, f"100000 x 100000 pixels .{window.decode()}.*shrink"), (2**30, "damaged")]:
            bad = data[: at + 8] + np.array([corner, corner], "<i4").tobytes() + data[at + 16 :]
            (tmp_path / "bad.exr").write_bytes(bad)
            with pytest.raises(TSDFError, match=says):
                read_exr(tmp_path / "bad.exr")


def test_bad_arguments_of_write(tmp_path):
    """Refused before anything is written, and an image that was there stays."""
    good = random_image()
    write_exr(tmp_path / "a.exr", good)
    for rgb, options, says in [
        (good[..., 0], {}, "shape"),
        (good[:, :0], {}, "shape"),
        (good[..., [0, 1, 2, 2]], {}, "shape"),
        (good, {"variance": good[:-1]}, "variance has the shape"),
        (good, {"attributes": {"spp": 64}}, "must be texts"),
    ]:
        with pytest.raises(UsageError, match=says):
            write_exr(tmp_path / "a.exr", rgb, **options)
    with pytest.raises(TSDFError, match="cannot write"):
        write_exr(tmp_path / "none" / "a.exr", good)
    with pytest.raises(TSDFError, match="cannot write"):
        write_exr(tmp_path / "a.exr", good, attributes={"channels": "R"})
    assert np.array_equal(read_exr(tmp_path / "a.exr").rgb, good)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


# -------------------------------------------------------------------------------------- environments


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e-3])
def test_environment_pixels_are_checked(tmp_path, bad):
    """A bad pixel is named by its place; a good image returns as float64."""
    rgb = np.abs(random_image())
    write_exr(tmp_path / "sky.exr", rgb)
    sky = read_environment(tmp_path / "sky.exr")
    assert sky.dtype == np.float64 and np.array_equal(sky, rgb)
    rgb[3, 5, 1] = bad
    write_exr(tmp_path / "sky.exr", rgb)
    with pytest.raises(TSDFError, match=re.escape(f"row 3, column 5 (from 0 at the top left) has G = {bad:g}")):
        read_environment(tmp_path / "sky.exr")


def test_black_environment_is_refused(tmp_path):
    write_exr(tmp_path / "sky.exr", np.zeros((4, 8, 3)))
    with pytest.raises(TSDFError, match="every pixel is black"):
        read_environment(tmp_path / "sky.exr")


# ------------------------------------------------------------------------------------------------ PNG


def test_png_is_srgb(tmp_path):
    """Known codes of the sRGB curve (IEC 61966-2-1), by the formula and by hand: 0.5 is 188, 0.0031308 is 10.3."""
    linear = np.array([0.0, 0.001, 0.0031308, 0.18, 0.5, 1.0, 7.0, -1.0, math.nan, math.inf])
    codes = [0, 3, 10, 118, 188, 255, 255, 0, 0, 255]
    rgb = np.stack([linear, linear[::-1], linear], axis=-1)[None]
    write_png(tmp_path / "a.png", rgb)
    with PIL.Image.open(tmp_path / "a.png") as picture:
        assert picture.mode == "RGB" and picture.size == (10, 1)
        found = np.asarray(picture)
    assert found[0, :, 0].tolist() == codes and found[0, :, 1].tolist() == codes[::-1]
    ramp = np.linspace(0.0, 1.0, 999)
    write_png(tmp_path / "a.png", np.stack([ramp] * 3, axis=-1)[None] / 4.0, exposure=2.0)
    with PIL.Image.open(tmp_path / "a.png") as picture:
        found = np.asarray(picture)[0, :, 0]
    formula = np.where(ramp <= 0.0031308, 12.92 * ramp, 1.055 * ramp ** (1 / 2.4) - 0.055)
    assert np.abs(found - 255.0 * formula).max() < 0.501
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_png_refuses(tmp_path):
    for exposure in (math.nan, math.inf, 1e4):
        with pytest.raises(UsageError, match="exposure must be"):
            write_png(tmp_path / "a.png", random_image(), exposure)
    with pytest.raises(TSDFError, match="cannot write"):
        write_png(tmp_path / "none" / "a.png", random_image())


# ----------------------------------------------------------------------------------------- wavelengths


def ice(nm):
    return np.array([4e9 * math.pi * optical_constants("ice", w).k / w for w in nm])  # [1/m]


def colour_of(values):
    """Return the linear sRGB of a transmittance at 380, 381 ... 780 nm by way of colour-science."""
    shape = colour.SpectralShape(380, 780, 1)
    cmfs = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    d65 = colour.SDS_ILLUMINANTS["D65"].copy().align(shape)
    spectrum = colour.SpectralDistribution(values, shape.wavelengths)
    xyz = colour.sd_to_XYZ(spectrum, cmfs, d65, method="Integration") / 100.0
    return colour.XYZ_to_RGB(xyz, "sRGB")


def test_white_stays_white():
    spectrum = spectral_weights()
    assert spectrum.wavelength_nm.size == 40 and spectrum.weight.shape == (40, 3)
    assert np.abs(spectrum.weight.sum(axis=0) - 1.0).max() < 1e-12
    assert spectral_weights() is spectrum
    with pytest.raises(ValueError, match="read-only"):
        spectrum.weight[0, 0] = 0.0


@pytest.mark.parametrize("metres", [0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0])
def test_colour_of_light_through_ice(metres):
    """The 40 wavelengths give the colour of 1 nm steps by colour-science, each relative to its own white, to 1e-3.

    Negative control: the wavelengths shifted by half a cell are seen wherever the ice has a colour.
    """
    nm = np.arange(380.0, 781.0)
    expected = colour_of(np.exp(-ice(nm) * metres)) / colour_of(np.ones(401))
    spectrum = spectral_weights()
    error = np.exp(-ice(spectrum.wavelength_nm) * metres) @ spectrum.weight - expected
    assert np.abs(error).max() < 1e-3
    shifted = np.exp(-ice(spectrum.wavelength_nm + 5.0) * metres) @ spectrum.weight - expected
    assert np.abs(shifted).max() > 1e-3


def test_own_wavelengths():
    """Finer cells come closer to the 1 nm steps; a single wavelength carries everything."""
    nm = np.arange(380.0, 781.0)
    expected = colour_of(np.exp(-ice(nm) * 10.0)) / colour_of(np.ones(401))
    fine = spectral_weights(tuple(nm))
    assert np.abs(np.exp(-ice(nm) * 10.0) @ fine.weight - expected).max() < 1e-4
    assert np.allclose(spectral_weights((550.0,)).weight, 1.0)
    for bad in [(), (500.0, 400.0), (400.0, 400.0), (0.0, 500.0), (400.0, math.nan), (400.0, math.inf)]:
        with pytest.raises(UsageError, match="wavelengths must be"):
            spectral_weights(bad)
