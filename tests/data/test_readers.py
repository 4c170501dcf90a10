"""A table's file, opened as the OpenEXR image that it is, shows every image reader the pixels of the table."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tsdf
from tsdf.errors import FormatWarning
from tsdf.reference_data import make_golden
from tsdf.reference_data.make_checks import CHECKS

VALID = CHECKS.parent / "valid"
FILES = [*sorted(VALID.glob("*.tsdf.exr")), CHECKS / "cube.tsdf.exr", CHECKS / "sphere.tsdf.exr"]


def by_openexr(path: Path) -> np.ndarray:
    import OpenEXR

    return OpenEXR.File(str(path), separate_channels=True).parts[0].channels["Y"].pixels


def by_openimageio(path: Path) -> np.ndarray:
    oiio = pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed: pip install openimageio")
    file = oiio.ImageInput.open(str(path))
    assert file is not None, oiio.geterror()
    assert file.spec().channelnames == ("Y",)
    return file.read_image("float")[:, :, 0]


def by_mitsuba(path: Path) -> np.ndarray:
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'tsdf-toolkit[mitsuba]'")
    mitsuba.set_variant("scalar_rgb")
    bitmap = mitsuba.Bitmap(str(path))
    assert bitmap.pixel_format() == mitsuba.Bitmap.PixelFormat.Y
    assert bitmap.component_format() == mitsuba.Struct.Type.Float32
    return np.array(bitmap).reshape(bitmap.height(), bitmap.width())


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name.removesuffix(".tsdf.exr"))
@pytest.mark.parametrize("reader", [by_openexr, by_openimageio, by_mitsuba])
def test_readers_see_the_same_pixels(reader: Callable[[Path], np.ndarray], path: Path) -> None:
    """Bit for bit, each golden file: raw and compressed chunks, extensions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # a newer minor version
        own = tsdf.read(path).pixels
    found = reader(path)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, own)


@pytest.mark.parametrize("reader", [by_openexr, by_openimageio, by_mitsuba])
def test_readers_would_see_other_pixels(reader: Callable[[Path], np.ndarray], tmp_path: Path) -> None:
    """The control: of a file whose rows are upside down, or of which one number is the next float32, they say so."""
    header, pixels = make_golden.table(make_golden.WEIGHTS)
    other = pixels.copy()
    other[2, 1] = np.nextafter(other[2, 1], np.float32(2.0))
    for changed in (pixels[::-1], other):
        (tmp_path / "t.exr").write_bytes(make_golden.file(header, changed))
        found = reader(tmp_path / "t.exr")
        np.testing.assert_array_equal(found, changed)
        assert not np.array_equal(found, pixels)


@pytest.mark.parametrize("reader", ["OpenImageIO", "mitsuba"])
def test_readers_see_the_header(reader: str) -> None:
    """The JSON header is an ordinary attribute of the image, whole."""
    import json

    module = pytest.importorskip(reader, reason=f"{reader} is not installed")
    path = CHECKS / "cube.tsdf.exr"
    if reader == "mitsuba":
        module.set_variant("scalar_rgb")
        text = str(module.Bitmap(str(path)).metadata()["tsdf"])
    else:
        text = module.ImageInput.open(str(path)).spec().getattribute("tsdf")
    assert json.loads(text)["statistics"]["mean_z"] == tsdf.read(path).statistics["mean_z"]
