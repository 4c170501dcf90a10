"""Volumes: each kind of file gives the same voxels, each grain a closed mesh without stairs, or a one-line error."""

import base64
import zlib

import numpy as np
import pytest

import tsdf
from tsdf.cli.grains import main
from tsdf.errors import GrainError
from tsdf.grain import volumes
from tsdf.grain.grains import load_grain

pytest.importorskip("skimage", reason="scikit-image is not installed: pip install 'tsdf-toolkit[volumes]'")
SHAPE = (40, 36, 44)
BALLS = [((12.3, 12.1, 14.7), 8.0), ((26.2, 23.4, 30.1), 9.3), ((39.0, 10.0, 10.0), 6.0), ((6.0, 30.0, 40.0), 2.0)]


def ball(middle, radius, shape=SHAPE):
    x, y, z = np.meshgrid(*map(np.arange, shape), indexing="ij")
    return (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2 < radius**2


@pytest.fixture(scope="module")
def voxels():
    """Two balls, one at the border, one too small."""
    return np.any([ball(*one) for one in BALLS], axis=0).astype(np.uint8) * 255


def run(*words):
    with pytest.raises(SystemExit) as done:
        main([str(word) for word in words])
    return done.value.code


def legacy(voxels, cells=False, text=False):
    n = [size + cells for size in voxels.shape]
    flat = voxels.ravel(order="F")
    body = " ".join(map(str, flat)).encode() if text else flat.tobytes()
    head = (
        f"# vtk DataFile Version 3.0\nscan\n{'ASCII' if text else 'BINARY'}\nDATASET STRUCTURED_POINTS\n"
        f"DIMENSIONS {n[0]} {n[1]} {n[2]}\nORIGIN 0 0 0\nSPACING 2 2 3\n"
        f"{'CELL' if cells else 'POINT'}_DATA {len(flat)}\nSCALARS ice unsigned_char 1\nLOOKUP_TABLE default\n"
    )
    return head.encode() + body + b"\n"


def vti(voxels, packed=False):
    n = voxels.shape
    data = voxels.ravel(order="F").tobytes()
    if packed:
        inner = zlib.compress(data)
        sizes = np.array([1, len(data), 0, len(inner)], "<u4").tobytes()
        body, compressor = base64.b64encode(sizes) + base64.b64encode(inner), ' compressor="vtkZLibDataCompressor"'
    else:
        body, compressor = base64.b64encode(np.uint32(len(data)).tobytes() + data), ""
    extent = f"0 {n[0] - 1} 0 {n[1] - 1} 0 {n[2] - 1}"
    return (
        f'<VTKFile type="ImageData" byte_order="LittleEndian" header_type="UInt32"{compressor}>'
        f'<ImageData WholeExtent="{extent}" Origin="0 0 0" Spacing="2 2 3"><Piece Extent="{extent}"><PointData>'
        f'<DataArray type="UInt8" Name="ice" format="binary">{body.decode()}</DataArray>'
        "</PointData></Piece></ImageData></VTKFile>"
    ).encode()


@pytest.mark.parametrize("kind", ["npy", "tif", "folder", "vtk", "cells", "text", "vti", "packed"])
def test_all_kinds_of_files(kind, voxels, tmp_path):
    """The same voxels come out of each, axis by axis: the shape is different along all three."""
    import tifffile

    path = tmp_path / f"v.{kind}"
    if kind == "npy":
        np.save(path, voxels)
    elif kind == "tif":
        tifffile.imwrite(path, voxels.transpose(2, 1, 0))
    elif kind == "folder":
        path.mkdir()
        for k in range(voxels.shape[2]):
            tifffile.imwrite(path / f"{k:03d}.tif", voxels[:, :, k].T)
    elif kind in ("vti", "packed"):
        (path := tmp_path / "v.vti").write_bytes(vti(voxels, kind == "packed"))
    else:
        (path := tmp_path / "v.vtk").write_bytes(legacy(voxels, kind == "cells", kind == "text"))
    found = volumes.read_volume(path)
    np.testing.assert_array_equal(found.voxels, voxels)
    assert found.spacing == (None if kind in ("npy", "tif", "folder") else (2.0, 2.0, 3.0))


@pytest.mark.slow
def test_command(voxels, tmp_path, capsys):
    """Each grain is a closed mesh of its size and place; what is left out is said."""
    np.save(tmp_path / "v.npy", voxels)
    assert run(tmp_path / "v.npy", "--out", tmp_path / "out", "--voxel-size", "20,20,20um") == 0
    said = capsys.readouterr().out
    assert "2 grains; left out: 1 touch the border, 1 are too small" in said and "SSA" in said
    names = ["grain-0001.ply", "grain-0002.ply"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [*names, "grains.csv"]
    table = (tmp_path / "out" / "grains.csv").read_text().splitlines()
    for name, line, (middle, radius) in zip(names, table[1:], BALLS, strict=False):
        grain = load_grain(tmp_path / "out" / name)
        assert grain.notes == () and grain.bodies == 1
        assert np.allclose(grain.centre, 20 * (np.array(middle) + 0.5), atol=8)
        count = int(ball(middle, radius).sum())
        volume = grain.volume * grain.bounding_radius**3 / 20**3
        assert volume == pytest.approx(count, rel=0.01)
        row = dict(zip(table[0].split(","), line.split(","), strict=True))
        assert row["file"] == name and int(row["voxels"]) == count
        ssa = grain.area / grain.volume / (grain.bounding_radius * 1e-6) / 917
        assert float(row["ssa"]) == pytest.approx(ssa, rel=1e-4)
    assert run(tmp_path / "v.npy", "--out", tmp_path / "out") == 2
    assert "is not empty" in capsys.readouterr().err


@pytest.mark.slow
def test_a_cavity_stays_one():
    shell = ball((20, 20, 20), 16, (41, 41, 41)) & ~ball((20, 20, 20), 9, (41, 41, 41))
    ((grain, count),) = volumes.solids(volumes.parts(shell), smoothing=1.0)
    assert count == shell.sum() and grain.bodies == 1
    assert grain.volume * grain.bounding_radius**3 == pytest.approx(4 / 3 * np.pi * (16**3 - 9**3), rel=0.02)


@pytest.mark.slow
def test_no_stairs():
    """g of a voxelised ball of 40 voxels radius is that of the sphere within 0.01; with little smoothing it is not."""
    inside = ball((44.23, 44.1, 43.7), 40, (89, 89, 89))
    exact = tsdf.build("sphere", 1.31, tsdf.Effort(cells=64)).mean_cosine()
    for smoothing, close in ((volumes.SMOOTHING, True), (0.5, False)):
        ((grain, _),) = volumes.solids(volumes.parts(inside), smoothing=smoothing)
        table = tsdf.build(grain, 1.31, tsdf.Effort(paths=80_000, cells=64))
        assert 3 * table.header["standard_errors"]["mean_cosine"] < 0.005
        assert (abs(table.mean_cosine() - exact) < 0.01) == close


GREY = np.arange(1000).reshape(10, 10, 10)


@pytest.mark.parametrize(
    ("name", "data", "words", "message"),
    [
        ("v.npy", np.ones((9, 9, 9)), (), "holds one phase only"),
        ("v.npy", GREY, ("--threshold", 2000), "holds one phase only: all voxels are at or below 2000"),
        ("v.npy", GREY, (), "not binary: it holds more than two values; say with --threshold"),
        ("v.npy", GREY, ("--threshold", 500), "no grain is whole in it: 1 of 1 touch the border"),
        ("v.npy", np.ones((9, 9)), (), "has 2 axes; a volume has 3"),
        ("v.npy", np.broadcast_to(np.uint8(1), (1, 1, 1)).astype(complex), (), "not numbers"),
        ("v.npy", b"\x93NUMPY", (), "cannot be read as a volume"),
        ("v.tif", b"II*\0", (), "cannot be read as a volume"),
        ("v.vti", b"<VTKFile type='PolyData'/>", (), "is no image"),
        ("v.vtk", legacy(np.zeros((3, 3, 3), np.uint8))[:-9], (), "announces 27 numbers and holds fewer"),
        ("v.raw", b"00", (), "not a kind of volume that is read"),
        ("v.npy", GREY, ("--voxel-size", "20"), "--voxel-size is a length > 0 such as 20um"),
        ("v.npy", GREY, ("--voxel-size", "0um"), "--voxel-size is a length > 0"),
        ("v.npy", GREY, ("--material", "iec"), "--material"),
    ],
)
def test_refused(name, data, words, message, tmp_path, capsys):
    """In one line; nothing is left behind."""
    path = tmp_path / name
    path.write_bytes(data) if isinstance(data, bytes) else np.save(path, data)
    assert run(path, "--out", tmp_path / "out", "--quiet", *words) in (1, 2)
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1 and "Traceback" not in said
    assert [one.name for one in tmp_path.iterdir()] == [name]


def test_too_large(tmp_path):
    """Told from the header, before any voxel is read."""
    header = np.lib.format.header_data_from_array_1_0(np.empty(0, np.uint8)) | {"shape": (1000, 1000, 1000)}
    with (tmp_path / "v.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(10**9 + 200)
    with pytest.raises(GrainError, match="1000 x 1000 x 1000 voxels are more than"):
        volumes.read_volume(tmp_path / "v.npy")
