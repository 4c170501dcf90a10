"""Images: what is written is what is read, what cannot be meant is refused, colours agree with colour-science."""

import base64
import math
import os
import subprocess
import sys
import warnings

import numpy as np
import OpenEXR
import PIL.Image
import pytest

from tsdf.errors import TSDFError, UsageError
from tsdf.grain.materials import optical_constants
from tsdf.picture import image
from tsdf.picture.image import read_environment, read_exr, spectral_weights, write_exr, write_png
from tsdf.reference_data import make_observer

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


@pytest.mark.slow
def test_colour_science_changes_nothing_else() -> None:
    """Its import sets numpy's way of printing, on which other people's output and our golden files depend; and takes
    longer than a small picture, which needs nothing of it."""
    code = (
        "import sys, numpy as np; before = np.get_printoptions(); from tsdf.picture import image; "
        "image.spectral_weights(); assert 'colour' not in sys.modules; image._colour(); "
        "assert 'colour' in sys.modules and np.get_printoptions() == before"
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


MIP = (  # 8 by 4 halves 0, 1/64, 2/64 ..., with its smaller levels; made by OpenImageIO's make_texture
    "di8xAQICAABjYXBEYXRlAHN0cmluZwATAAAAMjAyNjoxMToyNiAwNzoxNjozMmNoYW5uZWxzAGNobGlzdAA3AAAAQgABAAAAAAAAAAEAAAAB"
    "AAAARwABAAAAAAAAAAEAAAABAAAAUgABAAAAAAAAAAEAAAABAAAAAGNvbXByZXNzaW9uAGNvbXByZXNzaW9uAAEAAAADZGF0YVdpbmRvdwBi"
    "b3gyaQAQAAAAAAAAAAAAAAAHAAAAAwAAAGRpc3BsYXlXaW5kb3cAYm94MmkAEAAAAAAAAAAAAAAABwAAAAMAAABmb3Zjb3QAZmxvYXQABAAA"
    "AAAAAEBsaW5lT3JkZXIAbGluZU9yZGVyAAEAAAAAb2lpbzpBdmVyYWdlQ29sb3IAc3RyaW5nABoAAAAwLjcyNjU2MiwwLjc0MjE4OCwwLjc1"
    "NzgxMm9paW86U0hBLTEAc3RyaW5nACgAAAA0QzZFQjVENkM3QjdEOEI0OUJERkJBQjYxREU3QTk4NjRDNUYyOUVCcGl4ZWxBc3BlY3RSYXRp"
    "bwBmbG9hdAAEAAAAAACAP3NjcmVlbldpbmRvd0NlbnRlcgB2MmYACAAAAAAAAAAAAAAAc2NyZWVuV2luZG93V2lkdGgAZmxvYXQABAAAAAAA"
    "gD90ZXh0dXJlZm9ybWF0AHN0cmluZwANAAAAUGxhaW4gVGV4dHVyZXRpbGVzAHRpbGVkZXNjAAkAAABAAAAAQAAAAAF3cmFwbW9kZXMAc3Ry"
    "aW5nAAsAAABibGFjayxibGFjawBrAgAAAAAAAOkCAAAAAAAALQMAAAAAAABNAwAAAAAAAAAAAAAAAAAAAAAAAAAAAABqAAAAeF5dibEVgDAI"
    "RBklIzgCvcM4gXok+p6zWDFCRrC0zCgC0cZ7B587CCCqzBV+MJODwFa1kFUOy8kZ61Id4qkauVW1KpR+vPciWQTTUbJkyHhu2bILMM9i24le"
    "RDAvPXS6Y4D1PT4+I9lnvgAAAAAAAAAAAQAAAAEAAAAwAAAAwDNgNeA2MDhAMyA1oDYQOMAy4DRgNuA38DtYPLg8GD3QO0g8qDwIPbA7ODyY"
    "PPg8AAAAAAAAAAACAAAAAgAAAAwAAABQOdA6MDmwOhA5kDoAAAAAAAAAAAMAAAADAAAABgAAABA68DnQOQ=="
)  # fmt: skip


def test_reads_the_finest_level_of_a_mip_map(tmp_path):
    (tmp_path / "mip.exr").write_bytes(base64.b64decode(MIP))
    expected = np.arange(4 * 8 * 3).reshape(4, 8, 3) / 64
    assert np.array_equal(read_exr(tmp_path / "mip.exr").rgb, expected)


def test_reads_the_only_layer_of_colour(tmp_path):
    """Blender's names: one layer beside depth is taken, plain channels come before layers, two layers are refused."""
    rgb = random_image()

    def layer(name):
        return {f"{name}{c}": rgb[..., i] for i, c in enumerate("RGB")}

    only = written(tmp_path / "only.exr", layer("ViewLayer.Combined.") | {"ViewLayer.Depth.Z": rgb[..., 0]})
    assert np.array_equal(read_exr(only).rgb, rgb)
    plain = written(tmp_path / "plain.exr", layer("diffuse.") | {c: 2.0 * rgb[..., i] for i, c in enumerate("RGB")})
    assert np.array_equal(read_exr(plain).rgb, 2.0 * rgb)
    with pytest.raises(TSDFError, match=r"no plain channels R, G, B, but 2 layers \(diffuse, specular\); save the one"):
        read_exr(written(tmp_path / "two.exr", layer("diffuse.") | layer("specular.")))


def deep(dtype=np.float32):
    pixels = np.empty((4, 8), dtype=object)
    for place in np.ndindex(pixels.shape):
        pixels[place] = np.ones(2, dtype)
    return pixels


def test_what_is_not_read_is_called_by_its_name(tmp_path):
    """Deep pixels, CIE XYZ, luminance and chroma, subsampled colour: each is refused for what it is."""
    import Imath

    def thinned(name, **step):
        header = OpenEXR.Header(8, 4)
        kind = Imath.PixelType(Imath.PixelType.FLOAT)
        header["channels"] = {c: Imath.Channel(kind, n, n) for c, n in step.items()}
        file = OpenEXR.OutputFile(str(tmp_path / name), header)
        file.writePixels({c: np.ones((4 // n, 8 // n), np.float32).tobytes() for c, n in step.items()})
        file.close()

    zips = OpenEXR.ZIPS_COMPRESSION
    written(tmp_path / "deep.exr", dict.fromkeys("RGBAZ", deep()), type=OpenEXR.deepscanline, compression=zips)
    written(tmp_path / "xyz.exr", dict.fromkeys("XYZ", random_image()[..., 0]))
    thinned("chroma.exr", Y=1, RY=2, BY=2)
    thinned("thin.exr", R=1, G=1, B=2)
    for name, says in [
        ("deep.exr", "its pixels are deep .*; flatten it"),
        ("xyz.exr", "its channels X, Y, Z are of CIE XYZ; save"),
        ("chroma.exr", r"it has luminance and chroma \(Y, RY, BY\); save"),
        ("thin.exr", "its channel B is subsampled; save"),
    ]:
        with pytest.raises(TSDFError, match=says) as caught:
            read_exr(tmp_path / name)
        assert "\n" not in str(caught.value)


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
    (tmp_path / "sky.hdr").write_text("#?RADIANCE\n")
    write_png(tmp_path / "sky.png", random_image())
    os.mkfifo(tmp_path / "pipe")
    written(tmp_path / "depth.exr", {"Z": random_image()[..., 0]})
    for name, says in [
        ("none.exr", "No such file.*check the name"),
        (".", "is not a regular file; name"),
        ("pipe", "is not a regular file; name"),
        ("sky.hdr", "is not an OpenEXR file .*but Radiance HDR; save it as OpenEXR"),
        ("sky.png", "is not an OpenEXR file .*but PNG; save it as OpenEXR"),
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


def sky_with(path, change, dtype=np.float32):
    """Write an environment of values from 0.1 to 1.1, changed, and return it as written."""
    rgb = (0.1 + np.random.default_rng(3).random((8, 16, 3))).astype(dtype)
    change(rgb)
    return rgb, written(path, {c: rgb[..., i] for i, c in enumerate("RGB")})


def test_a_good_environment_is_as_it_is(tmp_path):
    """Float64, every value as written, and nothing to say."""
    rgb, path = sky_with(tmp_path / "sky.exr", lambda rgb: None)
    sky = read_environment(path)
    assert sky.radiance.dtype == np.float64 and np.array_equal(sky.radiance, rgb)
    assert sky.notes == ()


def put(value, *places):
    def change(rgb):
        for place in places:
            rgb[place] = value

    return change


@pytest.mark.parametrize(
    ("change", "dtype", "mended", "says"),
    [
        (put(-1e-7, (3, 5, 1)), "f4", 0.0, "1 pixel is negative, down to -1e-07, "),
        (put(-2.0, (3, 5, 1), (0, 0, 0), (0, 0, 2)), "f4", 0.0, "2 pixels are negative, down to -2, "),
        (put(-np.inf, (3, 5, 1)), "f4", 0.0, "1 pixel is negative, down to -inf, "),
        (put(np.inf, (3, 5, 1), (7, 15, 0)), "f2", 65504.0, "2 pixels are infinite: taken as 65504"),
        (put(np.inf, (3, 5, 1)), "f4", 65504.0, "1 pixel is infinite: taken as 65504"),
        (put(np.nan, (3, 5, 1)), "f4", 0.0, "1 pixel is not a number: taken as 0"),
    ],
)
def test_pixels_that_are_no_radiance_are_mended(tmp_path, change, dtype, mended, says):
    """Each such number, and no other, becomes what the note says; the note names the file and how many."""
    rgb, path = sky_with(tmp_path / "sky.exr", change, dtype)
    sky = read_environment(path)
    good = np.isfinite(rgb) & (rgb >= 0.0)
    assert np.array_equal(sky.radiance[good], rgb[good].astype(np.float64))
    assert (~good).any() and (sky.radiance[~good] == mended).all()
    (note,) = sky.notes
    assert note.startswith(f"{path}: {says}") and "\n" not in note
    assert sky.warnings == (() if "-1e-07" in says else (note,))  # the overshoot of a filter


def test_how_much_is_negative_is_said(tmp_path):
    """The sum of what is negative over the sum of what is not, here -0.5 over 25; an infinite number counts as the
    largest that is finite."""
    pixels = np.zeros((2, 4, 3))
    pixels[0], pixels[1, 0, 0], pixels[1, 1] = 1.0, -0.5, (1.0, 6.0, 6.0)
    write_exr(tmp_path / "sky.exr", pixels)
    assert read_environment(tmp_path / "sky.exr").notes[0].endswith("down to -0.5, 2 % of the sum of all: taken as 0")
    pixels[1, 0, 0], pixels[1, 1, 1] = np.inf, 1e6
    write_exr(tmp_path / "sky.exr", pixels)
    sky = read_environment(tmp_path / "sky.exr")
    assert sky.notes[0].endswith("1 pixel is infinite: taken as 1e+06") and sky.radiance[1, 0, 0] == 1e6


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([0.0], "black"),
        ([-1.0], r"negative \(32 pixels\)"),
        ([np.nan], r"not a number \(32 pixels\)"),
        ([0.0, -1.0], r"black or negative \(16 pixels\)"),
        ([0.0, -np.inf, np.nan, np.nan], r"black or negative \(8 pixels\) or not a number \(16 pixels\)"),
    ],
)
def test_an_environment_without_light_is_refused(tmp_path, values, said):
    pixels = np.repeat(np.resize(values, 32)[:, None], 3, axis=1).reshape(4, 8, 3)
    write_exr(tmp_path / "sky.exr", pixels)
    with pytest.raises(TSDFError, match=f"every pixel is {said}, so it lights nothing"):
        read_environment(tmp_path / "sky.exr")


@pytest.mark.parametrize(
    ("height", "width", "noted"),
    [(5, 10, False), (5, 1, False), (1, 2, False), (100, 60, True), (9, 12, True), (8, 15, True)],
)
def test_shapes_that_are_no_panorama_are_noted(tmp_path, height, width, noted):
    """Photographs, upright or not, are taken with a note; twice as wide as high, or one column, without."""
    write_exr(tmp_path / "sky.exr", np.ones((height, width, 3)))
    notes = read_environment(tmp_path / "sky.exr").notes
    assert [f"{width} x {height} pixels, not twice as wide as high" in note for note in notes] == [True] * noted


def test_cube_maps_are_refused_by_their_attribute(tmp_path):
    """The attribute envmap says cube; one that says latitude-longitude is taken."""
    channels = {c: np.ones((48, 8), np.float32) for c in "RGB"}
    with pytest.raises(TSDFError, match="a cube map by its attribute envmap; convert"):
        read_environment(written(tmp_path / "cube.exr", channels, envmap=OpenEXR.ENVMAP_CUBE))
    channels = {c: np.ones((4, 8), np.float32) for c in "RGB"}
    assert not read_environment(written(tmp_path / "sky.exr", channels, envmap=OpenEXR.ENVMAP_LATLONG)).notes


def test_a_cropped_environment_is_noted(tmp_path):
    """The display window is all directions; what the data window leaves out is black, and a note says so."""
    rgb = np.ones((4, 8), np.float32)
    display = (np.array([0, 0], np.int32), np.array([15, 7], np.int32))
    data = (np.array([4, 2], np.int32), np.array([11, 5], np.int32))
    path = written(tmp_path / "sky.exr", dict.fromkeys("RGB", rgb), dataWindow=data, displayWindow=display)
    sky = read_environment(path)
    assert sky.radiance.shape == (8, 16, 3) and sky.radiance.sum() == 3 * rgb.sum()
    assert "data window" in sky.notes[0]


def test_other_primaries_are_converted(tmp_path):
    """ACES AP0 by its attribute chromaticities: the colour that sRGB calls (0.2, 0.5, 0.1), by way of colour-science's
    own ACES; white stays white, and primaries of sRGB itself are no news. Primaries on one line are noted."""
    aces, srgb = colour.RGB_COLOURSPACES["ACES2065-1"], colour.RGB_COLOURSPACES["sRGB"]
    wanted = np.array([0.2, 0.5, 0.1])
    rgb = np.ones((4, 8, 3))
    rgb[1, 2] = colour.RGB_to_RGB(wanted, srgb, aces, "Bradford")
    channels = {c: rgb[..., i].astype(np.float32) for i, c in enumerate("RGB")}

    def read(*chromaticities):
        return read_environment(written(tmp_path / "sky.exr", channels, chromaticities=chromaticities))

    sky = read(*aces.primaries.ravel(), *aces.whitepoint)
    assert np.abs(sky.radiance[1, 2] - wanted).max() < 2e-4
    assert np.abs(sky.radiance[0] - 1.0).max() < 2e-4
    assert "primaries" in sky.notes[0] and len(sky.notes) == 1
    sky = read(*srgb.primaries.ravel(), *srgb.whitepoint)
    assert np.array_equal(sky.radiance, rgb.astype(np.float32)) and not sky.notes
    assert "makes no sense" in read(0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3).notes[0]


@pytest.mark.slow
def test_small_files_of_many_pixels_are_refused_before_they_are_read(tmp_path):
    """A black image of 8192 x 4096 pixels is a small file that would take gigabytes as an environment."""
    path = written(tmp_path / "sky.exr", dict.fromkeys("RGB", np.zeros((4096, 8192), np.float16)))
    assert path.stat().st_size < 1e6
    with pytest.raises(TSDFError, match=r"8192 x 4096 pixels.*1e\+08 numbers.*shrink it"):
        read_environment(path)


def test_large_files_may_be_compressed(tmp_path, monkeypatch):
    """As skies of 8192 x 4096 pixels are; here what is large is made small, and the file padded."""
    path = written(tmp_path / "sky.exr", dict.fromkeys("RGB", np.ones((64, 128), np.float16)))
    monkeypatch.setattr(image, "MAX_NUMBERS", 1000)
    monkeypatch.setattr(image, "SMALL", 4000)
    path.write_bytes(path.read_bytes().ljust(3999, b"\0"))
    with pytest.raises(TSDFError, match=r"2.5e[+]04 numbers in all channels, and 4e[+]03 are read"):
        read_environment(path)
    path.write_bytes(path.read_bytes().ljust(4000, b"\0"))
    assert read_environment(path).radiance.shape == (64, 128, 3)


def test_a_table_is_no_environment(tmp_path):
    """It is an OpenEXR image with luminance, and would light a scene."""
    path = written(tmp_path / "t.exr", {"Y": np.ones((4, 8), np.float32)}, tsdf="{}")
    with pytest.raises(TSDFError, match=r"a table of grains .*name an environment"):
        read_environment(path)


def test_damage_is_told_in_one_line(tmp_path, capfd):
    """OpenEXR writes lines of its own to both streams, which stay open."""
    write_exr(tmp_path / "a.exr", random_image())
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[:-20])
    with pytest.raises(TSDFError, match="truncated"):
        read_exr(tmp_path / "cut.exr")
    assert capfd.readouterr() == ("", "")
    os.write(2, b"still open")
    assert capfd.readouterr().err == "still open"


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


def test_observer_is_that_of_colour_science():
    """The file that stands for the library is what its script makes, the matrix is the library's, to the last bit."""
    assert "\n".join(make_observer.lines()) + "\n" == make_observer.OBSERVER.read_text(encoding="ascii")
    matrix = colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB
    assert np.array_equal(matrix, image.XYZ_TO_RGB)


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
