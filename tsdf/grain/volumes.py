"""Volumes: a microCT scan, two values of voxels, becomes one closed mesh for each grain that lies whole in it.

Read are .npy, .tif (a stack, or a folder of slices), .vti and legacy .vtk images. The only door to scikit-image, whose
marching cubes find the surface, and to tifffile; both come with the extra ``volumes``. Lengths are in voxels until a
size is given; axes are x, y, z, of .npy in the order of the array, of .tif a slice for each z.
"""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsdf.errors import GrainError
from tsdf.grain.grains import Grain, grain_from_mesh
from tsdf.grain.surface import Floats, Ints
from tsdf.grain.vtk import MOST_VOXELS, read_image

SMOOTHING = 2.0  # [voxels] standard deviation of the filter that takes the stairs away; docs/volumes.md compares
LEAST_VOXELS = 500  # of a grain: a ball of 5 voxels radius; less is noise rather than a shape
MOST_FACES = 800_000  # of a mesh; where a grain has more, every second voxel is taken
SUFFIXES = (".npy", ".tif", ".tiff", ".vti", ".vtk")
EXTRA = "pip install 'tsdf-toolkit[volumes]'"


class Volume(NamedTuple):
    """Voxels (nx, ny, nz), any kind of number, and their size along x, y, z, None if the file does not say it."""

    voxels: NDArray
    spacing: tuple[float, ...] | None


class Solid(NamedTuple):
    """A grain of a volume: what it is as a shape, and of how many voxels."""

    grain: Grain
    voxels: int


class Parts(NamedTuple):
    """The grains of a volume: a number for each voxel, 0 none; those kept; how many were left out for what."""

    labels: NDArray[np.int32]
    kept: list[int]
    border: int
    small: int


def read_volume(path: Path) -> Volume:
    """Return the voxels of a file.

    Raises
    ------
    GrainError
        The file cannot be read, is of another kind, has other than three axes or more than `MOST_VOXELS` voxels.
    """
    try:
        if path.is_dir():
            slices = sorted(one for one in path.iterdir() if one.suffix.lower() in (".tif", ".tiff"))
            if not slices:
                raise GrainError("is a folder without slices (.tif)")
            return Volume(_stack(slices), None)
        kind = path.suffix.lower()
        if kind not in SUFFIXES:
            raise GrainError(f"not a kind of volume that is read: {', '.join(SUFFIXES)}, or a folder of slices (.tif)")
        if kind in (".tif", ".tiff"):
            return Volume(_stack([path]), None)
        if kind == ".npy":
            voxels = np.load(path, mmap_mode="r", allow_pickle=False)
            _check_shape(voxels.shape)
            return Volume(np.asarray(voxels), None)
        if path.stat().st_size > 16 * MOST_VOXELS:
            raise GrainError("is too large; crop it, or take every second voxel")
        return Volume(*read_image(path.read_bytes()))
    except GrainError as error:
        raise GrainError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise GrainError(f"{path}: no such file; name a volume ({', '.join(SUFFIXES)})") from None
    except MemoryError:
        raise GrainError(f"{path}: takes more memory than there is; crop it, or take every second voxel") from None
    except Exception as error:  # a damaged file: whatever reading it runs into
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise GrainError(f"{path}: cannot be read as a volume ({reason}); save it as .npy or .tif") from None


def _check_shape(shape: tuple[int, ...]) -> None:
    if len(shape) != 3:
        raise GrainError(f"has {len(shape)} axes; a volume has 3, one number for each voxel")
    if np.prod(shape, dtype=object) > MOST_VOXELS:
        size = " x ".join(map(str, shape))
        raise GrainError(f"{size} voxels are more than {MOST_VOXELS}; crop it, or take every second voxel")


def _stack(paths: list[Path]) -> NDArray:
    """Return the pages of TIFF files, (nx, ny, nz)."""
    try:
        from tifffile import TiffFile
    except ImportError:
        raise GrainError(f"reading .tif needs tifffile: {EXTRA}") from None
    found = []
    for path in paths:
        with TiffFile(path) as file:
            shape = file.series[0].shape
            _check_shape(shape if len(paths) == 1 else (len(paths), *shape))
            found.append(file.series[0].asarray())
    if any(one.shape != found[0].shape for one in found):
        raise GrainError("its slices differ in size")
    return (found[0] if len(paths) == 1 else np.stack(found)).transpose(2, 1, 0)


def material(voxels: NDArray, threshold: float | None = None) -> NDArray[np.bool_]:
    """Return where the material is: where the larger of two values is, or one above a threshold.

    Raises
    ------
    GrainError
        One phase only, or more than two values and no threshold.
    """
    if voxels.dtype.kind not in "biuf":
        raise GrainError(f"its voxels are of type {voxels.dtype}, not numbers")
    if threshold is None:
        low, high = voxels.min(), voxels.max()
        if not np.isin(voxels, (low, high)).all():
            raise GrainError("is not binary: it holds more than two values; say with --threshold what is above air's")
        solid = voxels == high
        if low == high:
            raise GrainError(f"holds one phase only: all voxels are {low}")
    else:
        solid = voxels > threshold
        if solid.all() or not solid.any():
            where = "above" if solid.all() else "at or below"
            raise GrainError(f"holds one phase only: all voxels are {where} {threshold:g}; choose another --threshold")
    return solid


def parts(solid: NDArray[np.bool_]) -> Parts:
    """Return the grains: material that hangs together over faces of voxels and does not touch the border.

    Raises
    ------
    GrainError
        None is left.
    """
    from scipy.ndimage import label

    labels, count = label(solid)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    faces = [labels.take(end, axis) for axis in range(3) for end in (0, -1)]
    touching = np.zeros(count + 1, bool)
    for face in faces:
        touching[face] = True
    touching[0] = True
    small = ~touching & (sizes < LEAST_VOXELS)
    kept = np.flatnonzero(~touching & ~small)
    border = int(touching[1:].sum())
    if not len(kept):
        raise GrainError(
            f"no grain is whole in it: {border} of {count} touch the border, {small.sum()} are smaller than "
            f"{LEAST_VOXELS} voxels; scan more around them, or separate grains that are joined (watershed) first"
        )
    return Parts(labels, kept.tolist(), border, int(small.sum()))


def solids(found: Parts, size: Sequence[float] = (1.0, 1.0, 1.0), smoothing: float = SMOOTHING) -> Iterator[Solid]:
    """Yield each grain as a closed mesh without the stairs of voxels.

    Its voxels, 1 inside and 0 outside, are filtered by a Gaussian; the surface is where the field has the value that
    as many voxels exceed as the grain has: volume is kept, which a value of one half would not do where the surface
    bends.

    Parameters
    ----------
    found : Parts
    size : (3,) float
        Of a voxel along x, y, z [the unit of the meshes].
    smoothing : float
        Standard deviation of the filter [voxels], > 0.

    Raises
    ------
    GrainError
        A grain whose surface is none, or scikit-image is missing.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise GrainError(f"finding surfaces needs scikit-image: {EXTRA}") from None
    from scipy.ndimage import find_objects, gaussian_filter

    margin = int(np.ceil(4 * smoothing)) + 2
    boxes = find_objects(found.labels)
    for number, one in enumerate(found.kept, 1):
        box = boxes[one - 1]
        inside = found.labels[box] == one
        count = int(inside.sum())
        field = gaussian_filter(np.pad(inside, margin).astype(np.float32), smoothing)
        level = _level(field, count)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for step in (1, 2, 4, 8):
                corners, faces, _, _ = marching_cubes(field, level, step_size=step)
                if len(faces) <= MOST_FACES:
                    break
        first = np.array([side.start for side in box]) - margin + 0.5  # values are those of the middles of voxels
        points: Floats = (corners.astype(np.float64) + first) * size
        triangles: Ints = faces[:, ::-1].astype(np.int64)  # seen from outside
        yield Solid(grain_from_mesh(points, triangles, f"grain {number}"), count)


def _level(field: NDArray[np.float32], count: int) -> float:
    """Return the value that `count` numbers of a field exceed."""
    ordered = np.partition(field.ravel(), [field.size - count - 1, field.size - count])
    return float(ordered[field.size - count - 1] + ordered[field.size - count]) / 2


def ply(grain: Grain) -> bytes:
    """Return the bytes of a .ply file of a grain in the unit and at the place it was made from."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(grain.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(grain.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(grain.faces), np.dtype([("n", "u1"), ("corners", "<i4", 3)]))
    rows["n"], rows["corners"] = 3, grain.faces
    places = (grain.vertices * grain.bounding_radius + grain.centre).astype("<f8")
    return head.encode() + places.tobytes() + rows.tobytes()
