"""Facets by cells, against the ray engine and against all facets one by one."""

import numpy as np
import pytest

from tsdf.compiled import njit
from tsdf.grain.grains import Grain, embree_scene, load_grain
from tsdf.handle import Handle
from tsdf.vectors import KERNEL
from tsdf.walk import facets
from tsdf.walk.facets import ABREAST, Facets, facet_met, facets_of
from tsdf.walk.geometry import planes_of


@njit(**KERNEL)
def met(own, e, starts, ways, inside, found):
    for i in range(len(starts)):
        p, d = (starts[i, 0], starts[i, 1], starts[i, 2]), (ways[i, 0], ways[i, 1], ways[i, 2])
        found[i] = facet_met(own, e, p, d, inside[i])


def corners_of(grain: Grain) -> np.ndarray:
    return grain.vertices[grain.faces]


def asked(own: Facets, starts: np.ndarray, ways: np.ndarray, inside: np.ndarray, e: int = 0) -> np.ndarray:
    found = np.zeros(len(starts), np.int64)
    met(Handle(own), e, starts, ways, inside, found)
    return found


def rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """From all over the bounding ball and onto it, as float32, some along axes and in planes of theirs."""
    rng = np.random.default_rng(seed)
    starts, ways = rng.normal(size=(2, count, 3))
    starts *= (rng.choice([0.3, 0.7, 1.0], count) / np.linalg.norm(starts, axis=1))[:, None]
    ways[: count // 10, 0] = 0.0
    ways[: count // 20, 1] = 0.0
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    return starts.astype(np.float32).astype(float), ways.astype(np.float32).astype(float)


@pytest.mark.parametrize(
    "name, settings",
    [("sand", {"subdivisions": 4}), ("rounded", {"subdivisions": 3}), ("hexprism", {"aspect": 0.05}), ("cube", {})],
)  # fmt: skip
def test_the_first_facet_is_that_of_the_ray_engine(name: str, settings: dict) -> None:
    """Of dented, flat and plain grains, but for facets that are met at the edge that they share. Light that said it
    came from the other side would not meet it."""
    grain = load_grain(name, **settings)
    corners, (starts, ways) = corners_of(grain), rays(20_000)
    engine = embree_scene(grain).run(starts.astype(np.float32), ways.astype(np.float32))
    planes, own = planes_of(corners), facets_of([corners], [0])
    inside = (engine >= 0) & (np.einsum("ij,ij->i", planes[engine, :3], ways) > 0.0)
    found = asked(own, starts, ways, inside)
    assert ((found < 0) == (engine < 0)).mean() > 0.9999 and 0.05 < (found >= 0).mean() < 1.0
    both = (found >= 0) & (engine >= 0)
    far = [
        (planes[f, 3] - np.einsum("ij,ij->i", planes[f, :3], starts[both]))
        / np.einsum("ij,ij->i", planes[f, :3], ways[both])
        for f in (found[both], engine[both])
    ]  # fmt: skip
    assert (np.abs(far[0] - far[1]) < 1e-5).mean() > 0.9999
    assert (found != engine).mean() < 1e-3
    assert (asked(own, starts, ways, ~inside)[both] != engine[both]).all()


def test_nothing_slips_between_facets() -> None:
    """From within, aimed at corners and at middles of edges, where two or six facets meet, light meets one of them.

    Control: without a facet, light that was aimed at its corners slips out."""
    grain = load_grain("sand", subdivisions=3)
    corners = corners_of(grain)
    inside = np.random.default_rng(1).normal(size=(200, 3)) * 0.05
    aims = np.concatenate((grain.vertices, corners.mean(axis=1), 0.5 * (corners[:, 0] + corners[:, 1])))
    starts = np.repeat(inside, 60, axis=0)
    ways = aims[np.arange(len(starts)) % len(aims)] - starts
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    own = facets_of([corners], [0])
    within = np.ones(len(starts), bool)
    found = asked(own, starts, ways, within)
    assert (found >= 0).all()
    blocks = own.blocks.copy()
    gone = blocks[:, 9].view(np.int32) == np.bincount(found).argmax()
    blocks[:, :9][np.broadcast_to(gone[:, None], (len(blocks), 9, ABREAST))] = np.nan
    assert (asked(own._replace(blocks=blocks), starts, ways, within) < 0).any()


def test_exemplars_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has its own cells and facet numbers; one that is not to be there, or that has too many facets, has none."""
    grains = [load_grain("sand", subdivisions=2), load_grain("cube"), load_grain("rounded", subdivisions=2)]
    corners, (starts, ways) = [corners_of(grain) for grain in grains], rays(500)
    first = [0, len(corners[0]), len(corners[0]) + len(corners[1])]
    own, outside = facets_of([corners[0], None, corners[2]], first), np.zeros(500, bool)
    assert own.where.tolist() == [0, -1, 1]
    for e in (0, 2):
        alone = asked(facets_of([corners[e]], [0]), starts, ways, outside)
        assert np.array_equal(asked(own, starts, ways, outside, e), np.where(alone < 0, -1, alone + first[e]))
    monkeypatch.setattr(facets, "MOST_FACETS", len(corners[0]) - 1)
    assert facets_of([corners[0]], [0]).where.tolist() == [-1]


def test_a_cell_of_too_many_facets_is_left_to_the_ray_engine() -> None:
    """A tiny ball of 81,920 facets beside a large one, all in one cell, which holds 65,280 at most; one of 20,480 is
    found."""
    large = load_grain("icosphere", subdivisions=4)
    for subdivisions, there in ((5, 0), (6, -1)):
        small = load_grain("icosphere", subdivisions=subdivisions)
        both = np.concatenate((corners_of(large), 0.004 * corners_of(small) + (0.3, 0.2, 0.1)))
        assert facets_of([both], [0]).where.tolist() == [there]


def test_what_has_no_numbers_is_left_to_the_ray_engine() -> None:
    corners = corners_of(load_grain("sand", subdivisions=2))
    corners[7, 1, 2] = np.nan
    assert facets_of([corners], [0]).where.tolist() == [-1]
