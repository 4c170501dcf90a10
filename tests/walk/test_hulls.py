"""Ellipsoids about grains, and which spheres a ray need not enter."""

import math

import numpy as np
import pytest

from tsdf.compiled import njit
from tsdf.grain.grains import load_grain
from tsdf.spheres.around import LANES, met
from tsdf.vectors import KERNEL
from tsdf.walk.hulls import ROWS, ellipsoid_of, reach_of, rows_of, seen, shadow

NONE = 2**31 - 1


@njit(**KERNEL)
def first(block, starts, ways, found, filtered):
    for i in range(len(starts)):
        p, d = (starts[i, 0], starts[i, 1], starts[i, 2]), (ways[i, 0], ways[i, 1], ways[i, 2])
        found[i] = seen(block, p, d, 0.0) if filtered else met(block, p, d, 0.0)


def rotations(count: int) -> np.ndarray:
    q = np.linalg.qr(np.random.default_rng(3).normal(size=(count, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


@pytest.mark.parametrize("name, settings", [("sand", {"subdivisions": 3}), ("hexprism", {"aspect": 3.0}), ("cube", {})])
def test_an_ellipsoid_holds_its_grain(name: str, settings: dict) -> None:
    """All of it and hardly more, that of a cube its bounding ball; so does the box about it, however it is turned."""
    points = load_grain(name, **settings).vertices
    matrix, offset = ellipsoid_of(points)
    far = np.linalg.norm(points @ matrix.T + offset, axis=1)
    assert 0.997 < far.max() < 1.0
    volume = 1.0 / np.linalg.det(matrix)
    assert volume == pytest.approx(1.0, abs=0.02) if name == "cube" else volume < 0.8
    ball = np.random.default_rng(2).normal(size=(5000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    for turned in rotations(5):
        rows = rows_of(matrix[None], offset[None], turned[None])[0]
        upper = np.array([rows[:3], [0.0, *rows[3:5]], [0.0, 0.0, rows[5]]])
        moved = points @ turned.T
        assert np.linalg.norm(moved @ upper.T + rows[6:], axis=1) == pytest.approx(far, abs=1e-9)
        low, high = reach_of(matrix[None], offset[None], turned[None])
        assert (moved > low).all() and (moved < high).all()
        rim = np.linalg.solve(matrix @ turned.T, (ball - offset).T).T
        assert np.abs(rim.max(axis=0) - high).max() < 0.02 and np.abs(rim.min(axis=0) - low).max() < 0.02


def test_shadow() -> None:
    """Of a ball, of a needle (pi / 4 of what is seen from aside) and of a disc (half of it)."""
    assert shadow(np.eye(3)) == pytest.approx(1.0)
    assert shadow(np.diag([1.0, 100.0, 100.0])) == pytest.approx(0.01 * math.pi / 4, rel=0.02)
    assert shadow(np.diag([1.0, 1.0, 1e4])) == pytest.approx(0.5, rel=0.02)


def test_spheres_whose_ellipsoid_is_missed() -> None:
    """Of a block of spheres the first whose ellipsoid the ray meets, against both computed one by one in float64; most
    spheres that are met alone are not."""
    rng = np.random.default_rng(1)
    matrix, offset = ellipsoid_of(load_grain("hexprism", aspect=4.0).vertices)
    turned = rotations(LANES)
    each, places = np.repeat(matrix[None], LANES, axis=0), np.repeat(offset[None], LANES, axis=0)
    centres = rng.uniform(-6.0, 6.0, (LANES, 3))
    block = np.zeros((ROWS, LANES), np.float32)
    block[:3], block[4:] = centres.T, rows_of(each, places, turned).T
    starts, ways = rng.normal(size=(2, 4000, 3))
    starts *= 12.0 / np.linalg.norm(starts, axis=1, keepdims=True)
    ways = rng.uniform(-4.0, 4.0, (4000, 3)) - starts
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    v = centres - starts[:, None]
    along = np.einsum("nij,nj->ni", v, ways)
    left = 1.0 - (v**2).sum(axis=2) + along**2
    entry = np.where(left > 0.0, along - np.sqrt(np.maximum(left, 0.0)), np.inf)
    whole = each @ turned.swapaxes(1, 2)
    e = np.einsum("kij,nj->nki", whole, ways)
    f = np.einsum("kij,nkj->nki", whole, v) - places
    b = (e * f).sum(axis=2) / (e * e).sum(axis=2)
    miss = ((f - b[..., None] * e) ** 2).sum(axis=2)
    found, alone = np.zeros(4000, np.int32), np.zeros(4000, np.int32)
    first(block, starts, ways, found, True)
    first(block, starts, ways, alone, False)
    both = np.where(miss <= 1.0, entry, np.inf)
    wanted = np.where(both.min(axis=1) < np.inf, both.argmin(axis=1), -1)
    sure = (np.abs(miss - 1.0) > 1e-3).all(axis=1) & (np.abs(left) > 1e-3).all(axis=1)
    assert sure.mean() > 0.9
    lane = np.where(found == NONE, -1, found & (LANES - 1))
    assert (lane == wanted)[sure].mean() > 0.999  # two may be entered at nearly the same place
    assert 0.1 < (found == NONE)[alone != NONE].mean() < 0.95


@pytest.mark.parametrize("aspect", [0.02, 4.0, 30.0])
def test_no_ray_that_meets_a_grain_is_turned_away(aspect: float) -> None:
    """Rays at its corners and edges, half of them along the ellipsoid. Control: one a hundredth smaller loses some."""
    rng, many = np.random.default_rng(7), 4000
    grain = load_grain("hexprism", aspect=aspect)
    matrix, offset = ellipsoid_of(grain.vertices)
    lost = np.zeros(2, int)
    for turned in rotations(4):
        corners = grain.vertices[grain.faces[rng.integers(len(grain.faces), size=many)]]
        weights = rng.dirichlet((0.3, 0.3, 0.3), many)
        weights[::2] = np.eye(3)[rng.integers(3, size=len(weights[::2]))]
        x = np.einsum("nk,nkj->nj", weights, corners)
        normal = (x @ matrix.T + offset) @ matrix
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        d = rng.normal(size=(many, 3))
        along = rng.random(many) < 0.5
        d[along] -= (np.einsum("ij,ij->i", d, normal)[:, None] * normal)[along]
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        x, d = x @ turned.T, d @ turned.T
        starts = x - 3.0 * d
        deep = 1.0 - (starts**2).sum(axis=1) + np.einsum("ij,ij->i", starts, d) ** 2 > 1e-5  # enough for float32
        for k, size in enumerate((1.0, 1.01)):
            block = np.full((ROWS, LANES), 1e6, np.float32)
            block[:3, 0] = 0.0
            block[4:, 0] = rows_of(size * matrix[None], size * offset[None], turned[None])[0]
            found = np.zeros(many, np.int32)
            first(block, starts, d, found, True)
            lost[k] += int((deep & (found == NONE)).sum())
    assert lost[0] == 0 and lost[1] > 0
