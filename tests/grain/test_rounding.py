"""Coordinates with few digits: what a grid of corners says of facets, and which grids are meant."""

import numpy as np
import pytest
import scipy.spatial

from tsdf.grain.exemplars import icosphere
from tsdf.grain.grains import MOST_TILT, grain_from_mesh
from tsdf.grain.rounding import Steps, grid_steps, grid_tilt
from tsdf.grain.surface import area_normals


def field(n, jitter=0.0, steep=1.0):
    """A snow field of 20 x 20 with a print in it over a flat base, n x n corners each; and which facets are its top."""
    x, y = np.meshgrid(*[np.linspace(-10.0, 10.0, n)] * 2, indexing="ij")
    if jitter:
        moved = np.random.default_rng(0).uniform(-jitter, jitter, (2, n - 2, n - 2)) * 20.0 / (n - 1)
        x[1:-1, 1:-1] += moved[0]
        y[1:-1, 1:-1] += moved[1]
    z = 0.8 + steep * (0.3 * np.sin(x) + 0.2 * np.sin(0.7 * y + 1.0) - 0.5 * np.exp(-(x**2 + y**2) / 2.0))
    top = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    sides = np.concatenate([np.stack([a, a + n, a + n + 1], axis=1), np.stack([a, a + n + 1, a + 1], axis=1)])
    line = np.arange(n)
    rim = np.concatenate([line[:-1] * n + 0, (n - 1) * n + line[:-1], (line[1:] * n + n - 1)[::-1], line[1:][::-1]])
    after = np.roll(rim, -1)
    below = n * n
    walls = np.concatenate([
        np.stack([rim, rim + below, after], axis=1), np.stack([after, rim + below, after + below], axis=1)
    ])  # fmt: skip
    return np.concatenate([top, top * [1, 1, 0] - [0, 0, 3]]), np.concatenate([sides, sides[:, ::-1] + below, walls])


def ball(floor=-1.0):
    """A ball, or what of it is above a floor: a heap with steep flanks."""
    points, faces = (np.asarray(part) for part in icosphere(subdivisions=4))
    return points, faces[(points[faces, 2] >= floor).all(axis=1)]


def lathe(levels):
    """A turned body: rings of 48 corners at given heights, closed by a corner at each end."""
    turn = 2.0 * np.pi * np.arange(48) / 48
    radius = 2.0 + np.sin(levels / 3.0)
    rings = [
        np.stack([r * np.cos(turn), r * np.sin(turn), np.full(48, z)], axis=1)
        for z, r in zip(levels, radius, strict=True)
    ]
    points = np.concatenate([*rings, [[0, 0, levels[0]], [0, 0, levels[-1]]]])
    j, k = np.arange(48), (np.arange(48) + 1) % 48
    low, high = len(points) - 2 + 0 * j, len(points) - 1 + 0 * j
    last = 48 * (len(levels) - 1)
    faces = [np.stack([low, k, j], axis=1), np.stack([high, last + j, last + k], axis=1)]
    for i in range(0, last, 48):
        faces += [np.stack([i + j, i + k, i + 48 + k], axis=1), np.stack([i + j, i + 48 + k, i + 48 + j], axis=1)]
    return points, np.concatenate(faces)


def on_grid(points, step, axes="xyz"):
    """Points of which the coordinates along some axes are rounded."""
    rounded = points.copy()
    for axis in ("xyz".index(name) for name in axes):
        rounded[:, axis] = np.rint(rounded[:, axis] / step) * step
    return rounded


def tilt_of(points, faces):
    return grid_tilt(points, faces, grid_steps(points))


def angle_between(points, moved, faces):
    """The mean angle between the same facets of two meshes over the area [rad]."""
    a, b = area_normals(points, faces), area_normals(moved, faces)
    sizes = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    cosine = np.einsum("ij,ij->i", a, b) / sizes[0] / np.maximum(sizes[1], 1e-30)
    return np.average(np.arccos(np.clip(cosine, -1.0, 1.0)), weights=sizes[1])


@pytest.mark.parametrize("digits", [3, 4, 6, None])
@pytest.mark.parametrize("n", [30, 41, 128])
def test_places_of_a_field_are_meant(n, digits):
    """Regular x and y with heights of as many digits as a file has: x and y tilt nothing, for they are no rounding."""
    points, faces = field(n)
    written = points if digits is None else np.round(points, digits)
    assert tilt_of(written, faces).angle < MOST_TILT
    turned = written[:, [0, 2, 1]] * [1, 1, -1]  # the height along y
    assert tilt_of(turned, faces).angle < MOST_TILT
    assert tilt_of(written * [1, 3, 1], faces).angle < MOST_TILT


def test_a_field_leaves_no_note():
    points, faces = field(30)
    assert grain_from_mesh(np.round(points, 4), faces).notes == ()
    said = grain_from_mesh(np.round(on_grid(points, 0.1, "z"), 4), faces).notes
    assert len(said) == 1 and said[0].startswith("z coordinates stand on a grid of 0.7 % of R (0.1 in the file)")


def test_places_of_a_decimated_field_are_meant():
    """Half the corners of a regular lattice, joined across gaps of one to many steps: heights still show that digits
    are there."""
    points, _ = field(41)
    top = points[: len(points) // 2]
    kept = top[np.random.default_rng(1).random(len(top)) < 0.5]
    faces = scipy.spatial.Delaunay(kept[:, :2]).simplices
    assert tilt_of(np.round(kept, 4), faces).angle < MOST_TILT
    assert tilt_of(np.round(on_grid(kept, 0.03, "z"), 4), faces).axes == "z"


@pytest.mark.parametrize("digits", [3, 4, None])
def test_rings_of_a_lathe_are_meant(digits):
    """Heights at whole numbers, none of which is the rounding of another."""
    points, faces = lathe(np.array([0, 1, 2, 3, 5, 6, 8, 9, 11, 12, 13.0]))
    assert tilt_of(points if digits is None else np.round(points, digits), faces).angle < MOST_TILT


@pytest.mark.parametrize(
    "mesh, step, axes",
    [
        (field(128), 0.01, "z"),  # a height map of 8 bits
        (field(41, jitter=0.3), 0.05, "z"),  # heights of single points
        (field(41, jitter=0.3), 0.05, "xyz"),
        (ball(), 0.01, "xyz"),
        (ball(), 0.03, "xyz"),
        (ball(), 0.03, "y"),
        (ball(), 0.005, "xy"),  # two axes of a body are no places
        (ball(), 0.03, "yz"),
        (ball(floor=0.0), 0.03, "xy"),
    ],
)
def test_tilt_is_that_of_the_facets(mesh, step, axes):
    """What is said of rounding, of all axes or one, is the angle between facets before and after, within a quarter."""
    points, faces = np.asarray(mesh[0], np.float64), np.asarray(mesh[1], np.int64)
    rounded = on_grid(points, step, axes)
    tilt, true = tilt_of(rounded, faces), angle_between(points, rounded, faces)
    assert tilt.angle > MOST_TILT and tilt.step == pytest.approx(step) and set(tilt.axes) <= set(axes)
    assert 0.8 * true < tilt.angle < 1.25 * true
    assert tilt_of(points, faces).angle < 1e-6


@pytest.mark.parametrize("fine", "xyz")
@pytest.mark.parametrize("step, finer", [(0.05, 0.005), (0.01, 0.0001)])
def test_a_body_is_no_field(step, finer, fine):
    """Digits of one axis finer than those of two: the two are told."""
    points, faces = ball()
    coarse = "xyz".replace(fine, "")
    rounded = on_grid(on_grid(points, step, coarse), finer, fine)
    tilt, true = tilt_of(rounded, faces), angle_between(points, rounded, faces)
    assert tilt.axes == coarse and tilt.step == pytest.approx(step)
    assert 0.75 * true < tilt.angle < 1.25 * true


def test_places_of_a_sheet_are_meant():
    """A field with a relief below too, walls between the two."""
    points, faces = field(41)
    half = len(points) // 2
    points[half:, 2] = points[:half, 2] - 2.0 - 0.1 * np.sin(points[:half, 0])
    assert tilt_of(np.round(points, 4), faces).angle < MOST_TILT
    assert tilt_of(np.round(on_grid(points, 0.1, "z"), 4), faces).axes == "z"


def test_a_grid_stretched_afterwards_is_told():
    """Rounded, then scaled by another factor along each axis."""
    points, faces = (np.asarray(part) for part in icosphere(subdivisions=4))
    tilt = tilt_of(on_grid(points, 0.03) * [1.0, 0.8, 0.3], faces)
    assert tilt.angle > 0.1 and tilt.axes == "xyz"


def test_steps():
    """Digits of the file, and spacings of single axes."""
    points, _ = field(30)
    digits, axes = grid_steps(np.round(points, 4))
    assert digits == pytest.approx(1e-4) and axes[:2] == pytest.approx(20 / 29, rel=1e-5) and axes[2] < 2e-4
    assert Steps(digits, axes).common == axes.max()
    free = grid_steps(points)
    assert free.digits == 0.0 and free.axes[2] == 0.0 and free.common == 0.0
