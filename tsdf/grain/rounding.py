"""What coordinates with few digits allow to say of a surface: whether it is convex, on what grid its corners stand.

A file's float32 or its decimals are a grid, on which facets are tilted a little and planes uncertain. Lengths are in
units of R, but where said otherwise.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsdf.grain.surface import area_normals, heights

CONVEX_TOLERANCE = 1e-6  # [R] how far a vertex may stand before a face's plane
FEW_PLANES = 16  # are looked at before all
MOST_ROUNDING = 2e-6  # [R] coordinates rounded more coarsely than this cannot be told from a shape
FEWEST_LEVELS = 8  # of coordinates along an axis that tell a grid from a few chosen values
FEWEST_CORNERS = 64  # of a mesh whose coordinates are rounded rather than chosen
HEIGHTS = 0.25  # of the steps of two axes, below which the third's shows that these two are a lattice of places
LEVEL = 1e-9  # tilt against an axis below which a facet is a wall or a floor
ALONG_LEVELS = 0.9  # share of the facets with one side along a level, from which on levels are lines of the mesh
TELLING = 0.2  # of the tilt by the worst axis, from which on an axis is named beside it

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Steps(NamedTuple):
    """Steps of the grids on which coordinates stand, 0 where there is none."""

    digits: float  # of all, by the digits of the file alone
    axes: Floats  # (3,) of each axis, for whatever reason

    @property
    def common(self) -> float:
        """The largest with which all coordinates may be off."""
        return max(self.digits, float(self.axes.max()) if self.axes.min() > 0 else 0.0)


class Tilt(NamedTuple):
    """By how much facets are tilted because coordinates are rounded."""

    angle: float  # the mean over the area [rad]
    step: float  # of the coarsest grid that does it, in the unit of the points
    axes: str  # those that do it, of "xyz"


def is_convex(points: Floats, faces: Ints, rounding: float = 0.0) -> bool:
    """Tell whether all of a mesh lies behind the plane of each of its faces, within what its digits allow.

    A vertex may stand `CONVEX_TOLERANCE` before a plane. Where coordinates are rounded, the plane itself is uncertain,
    the more the further from the face and the less high the face: 4 `rounding` (1 + distance / height) is added.

    Parameters
    ----------
    points : (n, 3) float64
        Vertices [R].
    faces : (m, 3) int64
        Counter-clockwise seen from the void.
    rounding : float
        How far a coordinate may be off [R], from `grid_step`; more than `MOST_ROUNDING` counts as that.
    """
    from tsdf.grain.horizon import stand_before

    rounding = min(rounding, MOST_ROUNDING)
    tolerance = CONVEX_TOLERANCE + 4 * rounding

    def planes_of(faces: Ints) -> tuple[Floats, Floats, Floats]:
        normal = area_normals(points, faces)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        corners = points[faces]
        level = np.einsum("ijk,ik->ij", corners, normal).max(axis=1)
        return np.column_stack([normal, level]), corners.mean(axis=1), 4 * rounding / heights(points, faces)

    for plane, centroid, slope in zip(*planes_of(faces[:: -(-len(faces) // FEW_PLANES)]), strict=True):
        before = points @ plane[:3] - plane[3] - tolerance  # of a mesh that is not convex most planes tell it
        if (before > slope * np.linalg.norm(points - centroid, axis=1)).any():
            return False
    planes, centroids, slopes = planes_of(faces)
    return not stand_before(points, planes, centroids, slopes, tolerance).any()


def grid_steps(points: Floats) -> Steps:
    """Return the largest steps of grids on which coordinates stand.

    Numbers of float32 stand on a grid of the last bit of the largest of them, written decimals on a power of ten, and
    numbers of either that were scaled afterwards on any; the last is looked for where an axis has eight levels or more.

    Parameters
    ----------
    points : (n, 3) float64
        Vertices, as the file has them.
    """
    largest = float(np.abs(points).max())
    with np.errstate(over="ignore"):  # what float32 cannot hold is not of float32
        bits = 2.0**-23 if (points == points.astype(np.float32)).all() else 2.0**-52
    unsure = bits * 2.0 ** np.floor(np.log2(max(largest, 1e-300)))  # the last bit of the largest
    digits = unsure if bits == 2.0**-23 else 0.0
    for power in range(int(np.floor(np.log10(max(largest, 1e-300)))), -300, -1):
        step = 10.0**power
        if step <= 100 * unsure:  # finer grids fit anything
            break
        if (np.abs(points - step * np.rint(points / step)) <= 2 * unsure).all():
            digits = max(digits, step)
            break
    return Steps(digits, np.array([_spacing(axis, unsure) for axis in points.T]))


def _spacing(values: Floats, unsure: float) -> float:
    """Return the common spacing of values that stand on eight levels of a grid or more, 0 if there is none."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    step = gaps[gaps > 8 * unsure].min(initial=np.inf)
    if not np.isfinite(step):
        return 0.0
    step = (levels[-1] - levels[0]) / max(np.rint((levels[-1] - levels[0]) / step), 1.0)
    rest = (levels - levels[0]) / step
    enough = len(np.unique(np.rint(rest))) >= FEWEST_LEVELS
    return float(step) if enough and (np.abs(rest - np.rint(rest)) < 0.02).all() else 0.0


def grid_tilt(points: Floats, faces: Ints, steps: Steps) -> Tilt:
    """Return by how much facets are tilted where coordinates are rounded to a grid.

    A facet with heights h and the unit normal n is tilted by sqrt(sum of 1 / h^2) |n step| / sqrt(12) for independent
    corners. None is if the grid is a design: facets along the axes (voxels), corners in the middle of a grid's edges
    (marching cubes on binary data), or fewer than `FEWEST_CORNERS`; of an axis with a grid by design only digits count.

    Parameters
    ----------
    points : (n, 3) float64
        Vertices [R].
    faces : (m, 3) int64
    steps : Steps
        Of the grids [R].
    """
    step = np.maximum(steps.axes, steps.digits)
    if not step.any() or len(points) < FEWEST_CORNERS:
        return Tilt(0.0, 0.0, "")
    if step.all():
        odd = np.rint((points - points.min(axis=0)) / step).astype(np.int64) % 2
        for turned in np.ndindex(2, 2, 2):
            if ((odd ^ turned).sum(axis=1) == 1).all():
                return Tilt(0.0, 0.0, "")
    normal = area_normals(points, faces)
    double = np.linalg.norm(normal, axis=1)
    step[~_rounded(points, faces, normal, step)] = steps.digits
    sides = np.linalg.norm(points[faces] - points[np.roll(faces, -1, axis=1)], axis=2)
    by_axis = (np.sqrt((sides**2).sum(axis=1)) / double**2)[:, None] * np.abs(normal) * step / np.sqrt(12)
    by_axis[np.abs(normal).max(axis=1) > (1 - 1e-9) * double] = 0.0
    tilt = np.minimum(np.linalg.norm(by_axis, axis=1), 1.0)
    means = np.average(by_axis, axis=0, weights=double)
    telling = np.flatnonzero(means > TELLING * means.max())
    names = "".join("xyz"[axis] for axis in telling)
    return Tilt(float(np.average(tilt, weights=double)), float(step[telling].max(initial=0.0)), names)


def _rounded(points: Floats, faces: Ints, normal: Floats, step: Floats) -> NDArray[np.bool_]:
    """Return (3,) bool, along which axes coordinates stand on a grid for want of digits and not by design.

    Two axes are a design where the third's grid is much finer, the digits that do for heights would do for places, and
    the mesh is a height field: slopes that face up meet none that face down, but walls or a level floor. So is one
    whose levels are lines of the mesh, as the rings of a lathe and the rows of a field: then each facet, but for those
    within the first and the last level, has just one side along a level, where rounding makes none or all three.
    """
    up, middle, _ = np.argsort(step)
    rounded = np.ones(3, bool)
    if step[up] < HEIGHTS * step[middle]:
        height, across = normal[:, up], np.abs(np.delete(normal, up, axis=1)).max(axis=1)
        slope = np.minimum(np.abs(height), across) > LEVEL * np.maximum(np.abs(height), across)
        rising, hanging = faces[slope & (height > 0)], faces[slope & (height < 0)]
        if not np.isin(rising, hanging).any():
            rounded = np.arange(3) == up
    for axis in np.flatnonzero(rounded & (step > 0)):
        level = np.rint((points[:, axis] - points[:, axis].min()) / step[axis])[faces]
        inner = (level > 0).any(axis=1) & (level < level.max()).any(axis=1)
        along = (level == np.roll(level, 1, axis=1)).sum(axis=1)
        rounded[axis] = (along[inner] == 1).sum() < ALONG_LEVELS * inner.sum()
    return rounded
