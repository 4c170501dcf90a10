"""What rays meet through the grid, against every facet looked at, the ray engine, and rays that aim at edges."""

import math

import numpy as np
import pytest
from numba import njit

from tsdf.grain.grains import first_hit, load_grain, triangle_scene
from tsdf.walk.cells import far_of, free_of
from tsdf.walk.geometry import box_mesh, planes_of, within
from tsdf.walk.grid import OUTSIDE, UNKNOWN, Grid, compared, grid_of, held, home_of, march, plane_hit

RAYS = 4000
THICK = 1e-6


@njit
def marched(grid, p, d, end, met, known):
    for i in range(p.shape[0]):
        known[i] = march(grid, met[i], -1, (p[i, 0], p[i, 1], p[i, 2]), (d[i, 0], d[i, 1], d[i, 2]), end[i])


@njit
def looked_at(grid, p, d, end, met):
    for i in range(p.shape[0]):
        a, b = (p[i, 0], p[i, 1], p[i, 2]), (d[i, 0], d[i, 1], d[i, 2])
        for facet in range(grid.facets.shape[0]):
            compared(grid, met[i], -1, facet, a, b, end[i])


def rays(grid: Grid, p: np.ndarray, d: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first facets (n, meshes) and whether they are known."""
    met, known = np.zeros((len(p), int(grid.mesh.max()) + 1), np.int32), np.zeros(len(p), bool)
    marched(grid, p, d, end, met, known)
    return met, known


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def ball(subdivisions: int = 2, radius: float = 1.0) -> np.ndarray:
    """Return the corners of a ball of facets, dented so that rays meet it up to four times."""
    grain = load_grain("icosphere", subdivisions=subdivisions)
    points = grain.vertices * (1.0 - 0.5 * np.exp(-8.0 * (grain.vertices[:, 2:] - 1.0) ** 2))
    return np.asarray(radius * points[grain.faces])


def made(*meshes: np.ndarray, cells: int = 3000, half: float = 1.1) -> Grid:
    planes = planes_of(np.concatenate(meshes))
    box = np.full(3, -half), np.full(3, half)
    return grid_of(
        meshes, np.full(len(meshes), -1, np.int32), planes, np.full(len(planes), THICK), box, cells, 0.0, False
    )


def floor(z: float, size: float) -> np.ndarray:
    a, b, c, d = ((x * size, y * size, z) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    return np.array([[a, b, c], [a, c, d]], np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("cells", [1, 60, 3000, 200_000])
def test_first_facets(cells: int) -> None:
    """A dented ball over a floor that reaches far out of the grid: from anywhere, near and far, and short."""
    grid = made(floor(-1.0, 50.0), ball(), cells=cells)
    rng = np.random.default_rng(1)
    p, d = rng.uniform(-1.5, 1.5, (RAYS, 3)), directions(rng, RAYS)
    d[:50] = np.eye(3)[rng.integers(0, 3, 50)] * rng.choice([-1.0, 1.0], (50, 1))  # along the axes
    end = np.where(rng.random(RAYS) < 0.5, math.inf, rng.exponential(0.3, RAYS))
    met, known = rays(grid, p, d, end)
    true = np.full_like(met, -1)
    looked_at(grid, p, d, end, true)
    assert known.mean() > 0.9 and (true >= 0).any(axis=0).all() and (true < 0).any(axis=0).all()
    # The first of all is found, and whatever else is found is the first of its mesh
    t = np.array([[plane_hit(grid.facets, f, tuple(a), tuple(b))[0] if f >= 0 else math.inf for f in row]
                  for row, a, b in zip(true, p, d, strict=True)])  # fmt: skip
    first, row = t.argmin(axis=1), np.arange(RAYS)
    sure = known & (t[row, first] < math.inf)
    assert (met[row, first] == true[row, first])[sure].all()
    others = known & (np.sort(t, axis=1)[:, 1] < math.inf)
    assert ((met == true) | (met == -1) | (t > end[:, None]))[known].all() and others.any()


@pytest.mark.slow
def test_as_the_ray_engine() -> None:
    """Embree names the same facets, but for rays that pass an edge within its rounding."""
    corners = ball(3)
    grid = made(corners, cells=20_000)
    rng = np.random.default_rng(2)
    p, d = (x.astype(np.float32) for x in (rng.uniform(-1.5, 1.5, (RAYS, 3)), directions(rng, RAYS)))
    engine = triangle_scene(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3).astype(np.int32))
    met, known = rays(grid, p.astype(float), d.astype(float), np.full(RAYS, math.inf))
    same = met[known, 0] == first_hit(engine, p, d)[known]
    assert same.mean() > 0.999


@pytest.mark.slow
def test_none_slips_through_edges() -> None:
    """From within a closed mesh, rays at the very vertices and at middles of edges leave through some facet."""
    corners = ball()
    grid = made(corners)
    aims = np.concatenate((corners.reshape(-1, 3), corners.mean(axis=1), 0.5 * (corners[:, 0] + corners[:, 1])))
    for start in ((0.0, 0.0, 0.0), (0.1, 0.05, -0.2)):
        p = np.tile(start, (len(aims), 1))
        d = aims - p
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        met, known = rays(grid, p, d, np.full(len(aims), math.inf))
        assert known.all()
        assert (met[:, 0] >= 0).all()


def in_all(grid: Grid, p: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the first facets (n, meshes) by every facet looked at."""
    found = np.full((len(p), int(grid.mesh.max()) + 1), -1, np.int32)
    looked_at(grid, p, d, np.full(len(p), math.inf), found)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("cells", [1, 60, 1000, 20_000])
def test_what_stands_for_many_facets_hides_none(cells: int) -> None:
    """Slabs of cells and boxes of facets, of up to hundreds a cell, leave out none that is met: short ways, long ones,
    and such as start on facets and run flat over them. Slabs that are too thin, or boxes too small, are noticed."""
    corners = ball(4)
    grid = made(corners, cells=cells)
    rng = np.random.default_rng(5)
    facet = rng.integers(0, len(corners), RAYS)
    weights = rng.dirichlet((0.3, 0.3, 0.3), RAYS)
    p, d = np.einsum("ij,ijk->ik", weights, corners[facet]), directions(rng, RAYS)
    tilt = np.einsum("ij,ij->i", d, grid.facets[facet, :3]) * rng.choice([1.0, 0.99, 1.0 - 1e-4], RAYS)
    d -= tilt[:, None] * grid.facets[facet, :3]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    p -= rng.choice([1e-9, 1e-4, 0.01, 0.3], RAYS)[:, None] * d
    true, end = in_all(grid, p, d)[:, 0], np.full(RAYS, math.inf)
    met, known = rays(grid, p, d, end)
    assert known.mean() > 0.9 and (true >= 0).mean() > 0.5
    assert (met[:, 0] == true)[known].all()
    thin, small = grid.slabs.copy(), grid.boxes.copy()
    middle = 0.5 * (thin["low"] + thin["high"])
    thin["low"], thin["high"] = 0.5 * (thin["low"] + middle), 0.5 * (thin["high"] + middle)
    met, known = rays(grid._replace(slabs=thin), p, d, end)
    assert (met[:, 0] != true)[known].any()
    small.view(np.uint8).reshape(-1, 4)[:, 1] //= 2
    met, known = rays(grid._replace(boxes=small), p, d, end)
    assert (met[:, 0] != true)[known].any()


def test_far_is_a_bound() -> None:
    """Of a grid of empty cells but a few: within 0.3 % of the distance between middles where that is less than 255
    cells along an axis, never above; and the steps are those of a king."""
    empty = np.ones((600, 9, 5), bool)
    empty[[0, 3, 70], [1, 8, 2], [0, 4, 1]] = False
    far, place = far_of(empty).reshape(empty.shape), np.argwhere(empty)
    off = np.abs(place[:, None] - np.argwhere(~empty)[None])
    steps, straight = off.max(axis=2).min(axis=1), np.sqrt((off**2).sum(axis=2)).min(axis=1)
    found = free_of(far, 1.0)[empty] + math.sqrt(0.75)
    assert (far[empty] >> 8 == np.minimum(steps, 255)).all() and (far[~empty] == 0).all()
    assert (found <= straight * (1.0 + 1e-12)).all()
    assert (found >= 0.997 * straight)[steps < 255].all() and (steps > 255).any()


def test_what_reaches_out_of_the_grid() -> None:
    """Much of it is left to the ray engine where a ray leaves the grid, and only there."""
    grid = made(ball(2, 3.0), cells=500)
    assert len(grid.outer) == 0 and not grid.closed and len(grid.facets) > OUTSIDE
    d = np.array([[1.0, 0.0, 0.0]] * 2)
    known = rays(grid, np.zeros((2, 3)), d, np.array([0.5, math.inf]))[1]
    assert known.tolist() == [True, False]
    assert rays(made(floor(-1.0, 50.0)), np.zeros((2, 3)), d, np.array([0.5, math.inf]))[1].all()


@njit
def homes(grid, p, found, sums):
    for i in range(p.shape[0]):
        found[i] = home_of(grid, sums, (p[i, 0], p[i, 1], p[i, 2]))


@pytest.mark.parametrize("cells", [1, 3000, 60_000])
def test_in_which_mesh_a_place_is(cells: int) -> None:
    """A dented ball that touches a box along a face, and a floor that is no medium's, against the ray engine."""
    dented, beside, half = ball(2, 0.5), box_mesh((0.5, -0.4, -0.4), (1.0, 0.3, 0.4)), 1.1
    dented = dented - (0.0, 0.0, 0.1)
    other = box_mesh((0.5, 0.3, -0.4), (1.0, 0.7, 0.4))
    meshes = [floor(-1.0, 50.0), dented, *(mesh.vertices[mesh.faces] for mesh in (beside, other))]
    planes = planes_of(np.concatenate(meshes))
    owner = np.array([-1, 2, 0, 1], np.int32)
    grid = grid_of(meshes, owner, planes, np.full(len(planes), THICK), (np.full(3, -half), np.full(3, half)), cells,
                   0.0, False)  # fmt: skip
    rng = np.random.default_rng(3)
    p, found = rng.uniform(-1.3, 1.3, (20_000, 3)), np.zeros(20_000, np.int64)
    homes(grid, p, found, np.zeros(4, np.int32))
    true = np.full(len(p), -1)
    for mesh, m in zip(meshes[1:], owner[1:], strict=True):
        engine = triangle_scene(mesh.reshape(-1, 3), np.arange(3 * len(mesh)).reshape(-1, 3).astype(np.int32))
        true[within(engine, planes_of(mesh)[:, :3], p)] = m
    sure = found != UNKNOWN
    assert sure.mean() > 0.99 and set(true) == {-1, 0, 1, 2}
    assert (found == true)[sure].mean() > 0.9999  # within the ray engine's rounding of a facet


def test_open_meshes_have_no_inside() -> None:
    """Along lines that enter it and leave through its hole."""
    corners = ball()
    meshes = [corners[corners.mean(axis=1)[:, 0] < 0.7]]
    planes = planes_of(meshes[0])
    grid = grid_of(meshes, np.zeros(1, np.int32), planes, np.full(len(planes), THICK),
                   (np.full(3, -1.1), np.full(3, 1.1)), 3000, 0.0, False)  # fmt: skip
    assert (grid.home == UNKNOWN).any() and (grid.home == 0).any()


def test_what_is_held_is_in_the_mesh() -> None:
    """Cells of a convex mesh without facets are its own, those around it are not; most of it is held."""
    grain = load_grain("icosphere", subdivisions=2)
    corners = grain.vertices[grain.faces]
    planes = planes_of(corners)
    grid = grid_of([corners], np.zeros(1, np.int32), planes, np.full(len(planes), THICK),
                   (np.full(3, -1.1), np.full(3, 1.1)), 30_000, 0.0, False)  # fmt: skip
    p = np.random.default_rng(4).uniform(-1.3, 1.3, (4000, 3))
    found = np.array([held(grid, 0, tuple(x)) for x in p])
    inside = (p @ planes[:, :3].T < planes[:, 3]).all(axis=1)
    assert not (found & ~inside).any() and found[inside].mean() > 0.7
