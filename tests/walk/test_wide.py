"""Many numbers at once, against one after the other."""

import itertools

import numpy as np
import pytest
from numba import njit

from tsdf.walk.grid import line_of
from tsdf.walk.wide import WIDE, lowest, over, turned

WAYS = 2000


@njit
def at_least(words, at, least):
    return over(words, at, least)


@njit
def first(bits):
    return lowest(bits)


@njit
def within(facets, p, d, found):
    for i in range(p.shape[0]):
        axes, q, u, v = line_of((p[i, 0], p[i, 1], p[i, 2]), (d[i, 0], d[i, 1], d[i, 2]))
        for f in range(facets.shape[0]):
            found[i, f] = turned(facets, f, axes, q, (u, v))


def test_bytes_are_compared_each() -> None:
    """Of words whose bytes are often equal, and large ones, which are negative as whole numbers."""
    rng = np.random.default_rng(1)
    parts = rng.choice([0, 1, 2, 127, 128, 200, 254, 255], (3 * WIDE, 4)).astype(np.uint8)
    words = parts.view(np.int32).ravel()
    seen = 0
    for at, least in itertools.product((0, 5, 2 * WIDE), rng.choice([0, 1, 2, 128, 200], (200, 4)).astype(np.uint8)):
        expected = (parts[at : at + WIDE] >= least).all(axis=1)
        found = at_least(words, at, least.view(np.uint32)[0])
        assert found == sum(1 << int(k) for k in np.flatnonzero(expected))
        seen += expected.sum()
        assert not found or first(found) == np.flatnonzero(expected)[0]
    assert 1000 < seen < 500 * WIDE


def rows(corners: np.ndarray) -> np.ndarray:
    """Return the facets of corners (f, 3, 3) as a grid has them, as far as lines are asked about them."""
    facets = np.zeros((len(corners), 16))
    facets.reshape(-1, 4, 4)[:, 1:, :3] = corners.transpose(0, 2, 1)
    return facets


def asked(corners: np.ndarray, p: np.ndarray, d: np.ndarray) -> np.ndarray:
    found = np.zeros((len(p), len(corners)), bool)
    within(rows(corners), p, d, found)
    return found


def test_lines_pass_within_facets() -> None:
    """Where three volumes of corners and a line have one sign: anywhere, with corners in whichever order."""
    rng = np.random.default_rng(2)
    corners, p, d = rng.normal(size=(20, 3, 3)), rng.normal(size=(WAYS, 3)), rng.normal(size=(WAYS, 3))
    a, b, c = (corners[None, :, k] - p[:, None] for k in range(3))
    sides = np.stack([np.einsum("ik,ijk->ij", d, np.cross(x, y)) > 0.0 for x, y in ((a, b), (b, c), (c, a))])
    expected = sides.all(axis=0) | ~sides.any(axis=0)
    assert (asked(corners, p, d) == expected).all() and 0.02 < expected.mean() < 0.5
    for order in itertools.permutations(range(3)):
        assert (asked(corners[:, order], p, d) == expected).all()
    assert not asked(corners[:, [0, 1, 1]], p, d).any()  # it has no inside


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_of_two_facets_has_an_edge(axis: int) -> None:
    """Through a floor of facets with corners at whole numbers, lines that meet corners, edges and middles pass within
    one facet each, whichever way they go."""
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], float)
    flat = np.concatenate([square + np.array((i, j)) for i, j in itertools.product(range(-3, 3), repeat=2)])
    corners = np.insert(flat, axis, 0.0, axis=2)
    rng = np.random.default_rng(3)
    p = np.insert(rng.integers(-4, 5, (WAYS, 2)) * 0.5, axis, rng.choice([-1.0, 1.0], WAYS), axis=1)
    d = np.insert(rng.choice([-0.5, 0.0, 0.5], (WAYS, 2)), axis, -p[:, axis], axis=1)
    found = asked(corners, p, d)
    assert (found.sum(axis=1) == 1)[np.abs(np.delete(p + d, axis, axis=1)).max(axis=1) < 2.9].all()
    assert found.any(axis=0).mean() > 0.9  # of those at the rim, some have only what is not theirs
