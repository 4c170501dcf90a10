"""Teleportation that remembers its packing: its parts one by one; its furnaces and leaks are in `test_transport`."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from tsdf.data.table import Table
from tsdf.errors import SceneError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import image, render, world
from tsdf.scene.scene import Box, Camera, ConstantLight, EnvironmentLight, GrainSpec, MediumSpec, Mesh, Scene, Slab
from tsdf.spheres.packing import cells_of, next_sphere, pack
from tsdf.spheres.packing_table import law
from tsdf.study.experiment import diffusion, slab
from tsdf.walk import memory
from tsdf.walk.memory import begin, onward
from tsdf.walk.records import AIMED, _aimed, memory_of, remembered
from tsdf.walk.walker import ENDED, FAULTS, FLY, MOST, WALKER

CAMERA = Camera((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))


def sphere(eta: float, **effort: int) -> Table:
    return scatterometer.exact_sphere(
        load_grain("sphere"), Optics(eta), Effort(**{"cells": 256, "memory": 64, **effort})
    )


@pytest.fixture(scope="module")
def ball() -> Table:
    return sphere(1.33, joint=32)


@pytest.fixture(scope="module")
def cube() -> Table:
    grain = load_grain("cube")
    build = scatterometer.Build.start(grain, Optics(1.31), Effort(200_000, memory=32))
    build.run(grain, 2)
    return build.table()


@pytest.fixture(scope="module")
def above(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an environment that is white above and black below."""
    path = tmp_path_factory.mktemp("sky") / "above.exr"
    image.write_exr(path, np.array([[[1.0, 1.0, 1.0]], [[0.0, 0.0, 0.0]]]))
    return path


def reflectance(shape: object, fraction: float, grains: tuple, sky: Path, spp: int, level: str = "teleport-memory",
                width: float = 300.0, **medium: object) -> tuple[float, float]:  # fmt: skip
    """Return what a beam straight from above sees of a medium, and its standard error."""
    spec = MediumSpec(shape, fraction, 1.0, grains, name="m", **medium)  # type: ignore[arg-type]
    made = world.build(Scene(CAMERA, (EnvironmentLight(sky),), (spec,)), level)
    beam = world.beam(made, (0.0, 0.0, 50.0), (0.0, 0.0, -1.0), width)
    picture = render.measure(made, beam, spp=spp, threads=2)
    return float(picture.rgb[0, 0, 1]), math.sqrt(picture.variance[0, 0, 1])


def apart(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return how many standard errors lie between two numbers."""
    return abs(a[0] - b[0]) / math.hypot(a[1], b[1])


# ------------------------------------------------------------------------------------------------ records


@pytest.mark.slow
def test_records_in_their_frame(ball: Table, cube: Table) -> None:
    """Directions and sides are unit and perpendicular, exits lie on the sphere ahead of the light, entry and exit are
    as far apart as the table says."""
    for table in (ball, cube):
        records, b = remembered(table)
        lit = np.broadcast_to(table.hit[:, None] > 0.0, b.shape)
        d, side, out = (records[lit][:, i].astype(np.float64) for i in (slice(0, 3), slice(3, 6), 6))
        assert np.abs(np.linalg.norm(d, axis=1) - 1.0).max() < 3e-7
        assert np.abs(np.linalg.norm(side, axis=1) - 1.0).max() < 3e-7
        assert np.abs((d * side).sum(axis=1)).max() < 3e-7
        assert ((out >= 0.0) & (out <= 1.0)).all()
        normal = out[:, None] * side + np.sqrt(1.0 - out**2)[:, None] * d
        offset = normal - np.stack((b[lit], 0.0 * b[lit], -np.sqrt(1.0 - b[lit] ** 2)), axis=1)
        z = table.memory["z"].T[lit]
        r = table.memory["r"].T[lit]
        # near grazing exits float32 loses the root of its rounding
        assert np.abs(offset[:, 2] - z).max() < 3e-3 and np.abs(np.hypot(offset[:, 0], offset[:, 1]) - r).max() < 3e-3
        assert np.median(np.abs(offset[:, 2] - z)) < 1e-6
        assert np.allclose(d[:, 2], table.memory["cos_theta"].T[lit], atol=1e-6)


def test_light_keeps_to_the_plane_of_a_sphere(ball: Table) -> None:
    """In a sphere all happens in the plane of d and the entry's side; exits are as oblique as entries."""
    records, b = remembered(ball)
    assert np.abs(records[..., 1]).max() < 1e-6 and np.abs(records[..., 4]).max() < 1e-6
    assert np.abs(records[..., 6] - b).max() < 1e-3


@pytest.mark.slow
def test_records_for_aimed_light_are_of_their_column(cube: Table) -> None:
    """Where a column of cos theta has records, those that stand for it lie in it, by the light that they are."""
    k = len(cube.memory["l"])
    chosen = _aimed(cube, k)
    cosines = cube.memory["cos_theta"].T.ravel()[chosen]
    edges = cube.cos_theta_edges
    full = (
        np.histogram(cube.memory["cos_theta"].T[np.broadcast_to(cube.hit[:, None] > 0, (len(cube.hit), k))], edges)[0]
        > 0
    )
    full[[0, 1, -2, -1]] = False
    inside = (cosines >= edges[:-1, None] - 1e-6) & (cosines <= edges[1:, None] + 1e-6)
    assert inside[full].all() and full.sum() > 100


def test_records_for_aimed_light_are_whole(ball: Table, cube: Table) -> None:
    """They are records of the table with the entry of these, so that the shadow's grain is left on its sphere."""
    for table in (ball, cube):
        aimed = remembering(0.5, table).aimed
        records, b = remembered(table)
        known = {
            (*record.tolist(), float(np.float32(at))) for record, at in zip(records.reshape(-1, 8), b.flat, strict=True)
        }
        assert aimed.shape == (len(table.cos_theta_edges) - 1, AIMED, 9)
        assert all(tuple(one) in known for one in aimed.reshape(-1, 9).tolist())
        d, side, out = (aimed[..., i].astype(np.float64) for i in (slice(0, 3), slice(3, 6), slice(6, 7)))
        normal = out * side + np.sqrt(1.0 - out**2) * d
        assert np.abs(np.linalg.norm(normal, axis=-1) - 1.0).max() < 1e-6


# ---------------------------------------------------------------------------------------------- the packing


def remembering(fraction: float, table: Table) -> memory.Memory:
    return memory_of([law(fraction)], [fraction], [1.0], [[(table, 1.0)]])


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.1, 0.55])
def test_flights_begin_anywhere_in_a_packing(ball: Table, fraction: float) -> None:
    """The way from a random point to the next sphere, and how that is entered, are distributed as in a packing.

    Controls: ways a tenth longer are rejected, and in a dense packing those between ideal spheres."""
    n, made = 20_000, remembering(fraction, ball)
    walkers = np.zeros(n, WALKER)
    walkers["d"], walkers["key"] = (0.0, 0.6, 0.8), np.arange(n, dtype=np.uint64) << np.uint64(20)
    for w in walkers:
        begin(w, made)
    assert np.abs((walkers["t"] * walkers["d"]).sum(axis=1)).max() < 1e-6
    cells, rng = [cells_of(pack(fraction, 1000, k)) for k in range(4)], np.random.default_rng(0)
    free, b = np.zeros(n), np.zeros(n)
    for i in range(n):
        packing = cells[i % 4]
        p, d = rng.random(3) * packing.side, rng.normal(size=3)
        d /= np.linalg.norm(d)
        free[i], x, y, z, sphere = next_sphere(packing, tuple(p), tuple(d), 0.0, 1e4)
        centre = packing.centres[sphere] + packing.side * np.array((x, y, z)) - p
        b[i] = np.linalg.norm(centre - (centre @ d) * d)
    for mine, true in ((walkers["free"], free), (walkers["b"] ** 2, b**2)):
        edges = np.quantile(true, np.linspace(0.0, 1.0, 17))
        edges[[0, -1]] = 0.0, 1e9
        one, other = np.histogram(mine, edges)[0], np.histogram(true, edges)[0]
        assert ((one - other) ** 2 / (one + other)).sum() < chi2.isf(1e-4, 15)
    gaps = -4.0 * (1.0 - fraction) / (3.0 * fraction) * np.log(1.0 - rng.random(n))  # if spheres were ideal
    for wrong in (1.1 * walkers["free"], *([gaps] if fraction > 0.5 else [])):
        one, other = np.histogram(wrong, np.quantile(free, np.linspace(0.0, 1.0, 17)))[0], n / 16.0
        assert ((one - other) ** 2 / (one + other)).sum() > chi2.isf(1e-4, 15)


def test_lines_through_missed_spheres_are_those_of_the_packing(ball: Table) -> None:
    """A chain that passes straight through every sphere meets one every 4 R / 3 f, evenly over their discs."""
    made = remembering(0.6, ball)
    rng = np.random.default_rng(5)
    d, t, b, way, squares = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5, 0.0, []
    for _ in range(20_000):
        gap, t, b = onward(made, 0, d, t, b, rng.integers(1 << 64, dtype=np.uint64))
        way += gap + 2.0 * math.sqrt(1.0 - b * b)
        squares.append(b * b)
    assert abs(way / 20_000 / (4.0 / 1.8) - 1.0) < 0.02
    assert (
        abs(np.mean(squares) - 0.5) < 4.0 * math.sqrt(1.0 / 12.0 / 20_000) * 1.5
    )  # neighbours are correlated a little
    assert abs(t[0] ** 2 + t[1] ** 2 - 1.0) < 1e-3 and t[2] == 0.0


# ------------------------------------------------------------------------------------------------ the level


@pytest.mark.slow
@pytest.mark.parametrize("cosine", [1.0, 0.5])
def test_dense_slabs_are_those_of_single_grains(ball: Table, cosine: float) -> None:
    """Reflectance of thin, dense slabs against four packings; teleportation without memory is far off where light
    comes in obliquely."""
    grain = GrainSpec(ball)
    packed = [slab("explicit", grain, 0.6, 4.0, 8000, cosine, seed=k, packing=k).reflectance for k in range(4)]
    truth = float(np.mean(packed)), float(np.std(packed, ddof=1)) / 2.0
    truth = truth[0], max(truth[1], math.sqrt(truth[0] * (1.0 - truth[0]) / 32_000))
    own, other = (
        slab(level, grain, 0.6, 4.0, 60_000, cosine, seed=9) for level in ("teleport-memory", "teleport-joint")
    )
    assert apart((own.reflectance, own.reflectance_error), truth) < 4.0
    if cosine < 1.0:
        assert apart((other.reflectance, other.reflectance_error), truth) > 6.0


@pytest.mark.slow
def test_cubes_diffuse_as_single_grains_do(cube: Table) -> None:
    """Grains that are often missed: mean squared displacement per event in the bulk, against two packings."""
    grain = GrainSpec(cube)
    values = [diffusion("explicit", grain, 0.5, 2000, seed=k, packing=k) for k in range(2)]
    truth = sum(v.value for v in values) / 2.0, math.hypot(*(v.error for v in values)) / 2.0
    own = diffusion("teleport-memory", grain, 0.5, 8000, seed=7)
    assert apart(own[:2], truth) < 4.0


@pytest.mark.slow
def test_grains_whole_inside_are_centres_inside_a_smaller_shape(ball: Table, above: Path, tmp_path: Path) -> None:
    """The two conventions are one, a radius apart; a mesh of the shape says the same."""
    import trimesh

    trimesh.creation.box(bounds=[(-9.0, -9.0, -9.0), (9.0, 9.0, 9.0)]).export(tmp_path / "large.ply")
    trimesh.creation.box(bounds=[(-8.0, -8.0, -8.0), (8.0, 8.0, 8.0)]).export(tmp_path / "small.ply")
    grains = (GrainSpec(ball),)
    for level, spp in (("teleport-memory", 60_000), ("explicit", 20_000)):
        shapes = (
            (Box((-9.0,) * 3, (9.0,) * 3), "grains"), (Box((-8.0,) * 3, (8.0,) * 3), "centres"),
            (Mesh(tmp_path / "large.ply"), "grains"), (Mesh(tmp_path / "small.ply"), "centres"),
        )  # fmt: skip
        found = [reflectance(s, 0.5, grains, above, spp, level, 16.0, inside=what) for s, what in shapes]
        for other in found[1:]:
            assert apart(found[0], other) < 4.0, level
        thick = reflectance(shapes[0][0], 0.5, grains, above, spp, level, 16.0, inside="centres")
        assert apart(found[0], thick) > 4.0, level


@pytest.mark.slow
def test_mixtures_choose_by_number(ball: Table, cube: Table, above: Path) -> None:
    """A mixture of a grain with itself is that grain; of spheres and cubes, what single grains say."""
    alone = reflectance(Slab(-8.0, 0.0), 0.5, (GrainSpec(ball),), above, 60_000)
    twice = reflectance(Slab(-8.0, 0.0), 0.5, (GrainSpec(ball, 0.3), GrainSpec(ball, 0.9)), above, 60_000)
    assert apart(alone, twice) < 4.0
    mixed = (GrainSpec(ball, 1.0), GrainSpec(cube, 3.0))
    own = reflectance(Slab(-8.0, 0.0), 0.5, mixed, above, 60_000)
    truth = [reflectance(Slab(-8.0, 0.0), 0.5, mixed, above, 8000, "explicit", packing_seed=k) for k in range(3)]
    mean = sum(t[0] for t in truth) / 3.0, math.sqrt(sum(t[1] ** 2 for t in truth)) / 3.0
    assert apart(own, mean) < 4.0
    assert apart(own, alone) > 6.0


def test_what_cannot_be_is_said(ball: Table, above: Path) -> None:
    """Tables without records by entry, and packings denser than any table, are refused in one line."""
    for table, fraction, words in (
        (
            sphere(1.33, memory=0),
            0.5,
            "no records by entry, which level teleport-memory draws from; build it with --memory",
        ),
        (ball, 0.7, "[[medium]] 1 (m)"),
    ):
        with pytest.raises(SceneError) as error:
            reflectance(Slab(-8.0, 0.0), fraction, (GrainSpec(table),), above, 1)
        assert words in str(error.value) and "\n" not in str(error.value)


# ------------------------------------------------------------------------------------------------ out of bounds


@pytest.mark.slow
@pytest.mark.parametrize("shadow", [0, 1])
def test_light_that_is_out_of_bounds_ends(ball: Table, tmp_path: Path, shadow: int) -> None:
    """A walker that is outside of a mesh and believes it is inside meets no grain for ever: it is counted as lost."""
    import trimesh

    trimesh.creation.icosphere(2, radius=20.0).export(tmp_path / "ball.ply")
    medium = MediumSpec(Mesh(tmp_path / "ball.ply"), 0.5, 1.0, (GrainSpec(ball),))
    made = world.build(
        Scene(Camera((0.0, -60.0, 0.0), (0.0,) * 3, 1, 1), (ConstantLight((1.0,) * 3),), (medium,)), "teleport-memory"
    )
    walkers = render.Walkers(made)
    walkers.asked[MOST] = 2
    for start, state, faults in ((0.0, None, 0), (30.0, ENDED, 1)):
        w = np.zeros(1, WALKER)[0]
        w["p"], w["d"], w["key"], w["shadow"], w["mode"] = (start, 0.0, 0.0), (1.0, 0.0, 0.0), 5, shadow, FLY
        w["pdf"], w["free"], w["ray"], w["weight"] = -1.0, -1.0, -1, 1.0
        found = memory.roam(walkers.arrays, walkers.batches[0], w, np.zeros(0), False)
        assert (found == state or state is None) and walkers.counters[FAULTS] == faults
