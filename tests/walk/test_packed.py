"""Packed grains that answer from their records, against the same packings with each grain traced.

Furnaces, leaks, threads and boundaries of the level are in `test_transport`, with those of all levels.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from tsdf.compiled import imported
from tsdf.data.table import Table
from tsdf.errors import SceneError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import render, world
from tsdf.scene.scene import Absorption, Box, Camera, ConstantLight, GrainSpec, MediumSpec, Mesh, Scene, Slab, SunLight
from tsdf.spheres.around import LANES, around_of, nearest, next_around
from tsdf.spheres.packing import cells_of, next_sphere, pack
from tsdf.study.experiment import bulk_experiment, diffusion, gather, slab

LEVEL = "teleport-packed"
SKY = (SunLight((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), 178.0),)  # only found by chance, by what lets nothing aim
CAMERA = Camera((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))


def traced(name: str, eta: float, paths: int) -> Table:
    grain = load_grain(name)
    build = scatterometer.Build.start(grain, Optics(eta), Effort(paths, memory=64))
    build.run(grain, 2)
    return build.table()


@pytest.fixture(scope="module")
def ball() -> Table:
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=256, memory=64))


@pytest.fixture(scope="module")
def mirror() -> Table:
    return traced("sphere", 1e9, 200_000)


@pytest.fixture(scope="module")
def cube() -> Table:
    return traced("cube", 1.31, 200_000)


def apart(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return how many standard errors lie between two numbers."""
    return abs(a[0] - b[0]) / math.hypot(a[1], b[1])


def reflectance(level: str, shape: object, grains: tuple, spp: int, seed: int = 0, **medium: object) -> tuple:
    """Return what a beam straight from above sees of a medium under a sky above it, and its standard error."""
    spec = MediumSpec(shape, 0.5, 1.0, grains, name="m", packing_spheres=1000, **medium)  # type: ignore[arg-type]
    made = world.build(Scene(CAMERA, SKY, (spec,)), level)
    picture = render.measure(made, world.beam(made, (0.0, 0.0, 50.0), (0.0, 0.0, -1.0), 16.0), spp=spp, seed=seed)
    return float(picture.rgb[0, 0, 1]), math.sqrt(picture.variance[0, 0, 1])


# ----------------------------------------------------------------------------------------- spheres around


@pytest.mark.slow
@pytest.mark.parametrize(("fraction", "spheres"), [(0.1, 300), (0.6, 64), (0.6, 600)])
def test_spheres_around_are_those_that_lines_meet(fraction: float, spheres: int) -> None:
    """Light that leaves a sphere anywhere meets the sphere that a walk through the finer grid finds, near or far, and
    none that is farther than it may be."""
    packing = pack(fraction, spheres, 0)
    cells, around, rng = cells_of(packing), around_of(packing), np.random.default_rng(1)
    near = 0
    for _ in range(1000):
        s = int(rng.integers(spheres))
        n, d = rng.normal(size=(2, 3))
        n, d = n / np.linalg.norm(n), d / np.linalg.norm(d)
        d *= np.sign(n @ d)
        o = packing.centres[s] + n
        t, i, j, k, other = next_sphere(cells, tuple(o), tuple(d), 0.0, 1e3)
        centre = packing.centres[other] + packing.side * np.array([i, j, k])
        found, di, dj, dk, way, normal = next_around(around, s, tuple(n), tuple(d), 1e3)
        graze = -float(d @ (o + t * d - centre))
        if graze < 1e-3:  # float32 may take it for a miss
            continue
        assert (found, di, dj, dk) == (other, i, j, k)
        assert abs(way - t) < 1e-6 / graze and np.abs(normal - (o + t * d - centre)).max() < 1e-6 / graze
        assert next_around(around, s, tuple(n), tuple(d), 0.99 * t)[0] == -1
        near += nearest(around, s, tuple(n), tuple(d))[0] >= 0
    assert (100 if fraction < 0.5 else 600) < near < 1000
    assert around.spheres.shape[-1] == LANES and around_of(None).reach == 0.0


# ---------------------------------------------------------------------------------------------- the level


@pytest.mark.slow
def test_mirrors_diffuse_as_in_their_packing(mirror: Table) -> None:
    """Light that is sent back finds the mirror that it came from: mean squared displacement per event, packing by
    packing. A chain that remembers one sphere is far off."""
    grain = GrainSpec(mirror)
    truth, own = (diffusion(level, grain, 0.6, 1200, seed=k) for k, level in enumerate(("explicit", LEVEL)))
    assert apart(own[:2], truth[:2]) < 4.0
    assert apart(diffusion("teleport-memory", grain, 0.6, 1200, seed=7)[:2], truth[:2]) > 6.0


@pytest.mark.slow
def test_cubes_diffuse_as_in_their_packing(cube: Table) -> None:
    """Grains that are often missed, which light passes straight; passed as if hit, they would be seen."""
    grain = GrainSpec(cube)
    truth = diffusion("explicit", grain, 0.5, 1000, seed=1)
    assert apart(diffusion(LEVEL, grain, 0.5, 3000, seed=2)[:2], truth[:2]) < 4.0
    other = bulk_experiment(LEVEL, grain, 0.5)
    other.world.memory = other.world.memory._replace(hit=np.ones_like(other.world.memory.hit))
    never_missed = gather(other, 3000, seed=2)
    assert apart((never_missed.mean[0], never_missed.error[0]), truth[:2]) > 6.0


@pytest.mark.slow
@pytest.mark.parametrize("cosine", [1.0, 0.5])
def test_slabs_of_spheres(ball: Table, cosine: float) -> None:
    """Reflectance and transmittance of a thin, dense slab of the same spheres, traced and not."""
    grain = GrainSpec(ball)
    truth, own = (slab(level, grain, 0.6, 4.0, 30_000, cosine, seed=k) for k, level in enumerate(("explicit", LEVEL)))
    for name in ("reflectance", "transmittance"):
        a, b = ((getattr(one, name), getattr(one, f"{name}_error")) for one in (truth, own))
        assert apart(a, b) < 4.0, name
    other = slab(LEVEL, grain, 0.6, 4.6, 30_000, cosine, seed=3)
    assert apart((other.transmittance, other.transmittance_error), (truth.transmittance, truth.transmittance_error)) > 4


@pytest.mark.slow
def test_slabs_of_cubes_that_absorb(cube: Table) -> None:
    """Reflectance of grains with facets that take light."""
    grain = GrainSpec(cube, absorption=Absorption("grey", (0.1,)))
    truth, own = (slab(level, grain, 0.5, 6.0, 30_000, seed=k) for k, level in enumerate(("explicit", LEVEL)))
    assert apart((own.reflectance, own.reflectance_error), (truth.reflectance, truth.reflectance_error)) < 4.0
    other = slab(LEVEL, GrainSpec(cube), 0.5, 6.0, 30_000, seed=3)
    assert apart((other.reflectance, other.reflectance_error), (truth.reflectance, truth.reflectance_error)) > 4.0


@pytest.mark.slow
def test_kinds_have_their_places(ball: Table, cube: Table) -> None:
    """In a mixture each place holds the kind that it holds when it is traced."""
    mixed = (GrainSpec(ball, 1.0, absorption=Absorption("grey", (5.0,))), GrainSpec(cube, 2.0))
    truth, own = (reflectance(level, Slab(-8.0, 0.0), mixed, 20_000, k) for k, level in enumerate(("explicit", LEVEL)))
    assert apart(own, truth) < 4.0
    assert apart(reflectance(LEVEL, Slab(-8.0, 0.0), mixed[1:], 20_000, 2), truth) > 6.0


@pytest.mark.slow
def test_grains_stand_where_they_do_when_traced(ball: Table, tmp_path) -> None:
    """Both conventions of `inside`, boxes exact and of facets."""
    import trimesh

    trimesh.creation.box(bounds=[(-5.0, -5.0, -4.0), (5.0, 5.0, 4.0)]).export(tmp_path / "box.ply")
    grains, found = (GrainSpec(ball),), {}
    for inside in ("grains", "centres"):
        truth = reflectance("explicit", Box((-5.0, -5.0, -4.0), (5.0, 5.0, 4.0)), grains, 20_000, inside=inside)
        for k, shape in enumerate((Box((-5.0, -5.0, -4.0), (5.0, 5.0, 4.0)), Mesh(tmp_path / "box.ply"))):
            own = found[inside] = reflectance(LEVEL, shape, grains, 20_000, k + 1, inside=inside)
            assert apart(own, truth) < 4.0
    assert apart(*found.values()) > 4.0


def test_what_is_not_used_is_not_compiled() -> None:
    """The kernels of all levels know nothing of this one's."""
    assert "walk.packed" not in imported("walk.transport")


def test_no_grain_is_looked_for(cube: Table) -> None:
    """A table of a mesh that is not there will do: nothing of it is traced."""
    header = {**cube.header, "grain": {**cube.header["grain"], "name": "gone", "mesh_sha256": "0" * 64}}
    scene = Scene(CAMERA, (ConstantLight((1.0,) * 3),),
                  (MediumSpec(Slab(-4.0, 0.0), 0.4, 1.0, (GrainSpec(replace(cube, header=header)),)),))  # fmt: skip
    assert (render.render(world.build(scene, LEVEL), spp=4, threads=1).rgb == 1.0).all()
    with pytest.raises(SceneError, match="neither built in"):
        world.build(scene, "explicit")


def test_what_cannot_be_is_said(ball: Table) -> None:
    """Tables without records by entry, and packings beyond what random ones reach, are refused in one line."""
    bare = scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64))
    for table, fraction, words in (
        (bare, 0.5, "no records by entry, which level teleport-packed draws from; build it with --memory 64"),
        (ball, 0.65, "[[medium]] 1 (m): the packing fraction must be above 0 and at most 0.64"),
    ):
        medium = MediumSpec(Slab(-4.0, 0.0), fraction, 1.0, (GrainSpec(table),), name="m")
        with pytest.raises(SceneError) as error:
            world.build(Scene(CAMERA, SKY, (medium,)), LEVEL)
        assert words in str(error.value) and "\n" not in str(error.value)


def test_a_sun_that_cannot_be_aimed_at_is_said(ball: Table) -> None:
    medium = MediumSpec(Slab(-4.0, 0.0), 0.5, 1.0, (GrainSpec(ball),))
    for lights, small in (((SunLight((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), 0.5),), True), (SKY, False)):
        notes = world.build(Scene(CAMERA, lights, (medium,)), LEVEL).notes
        assert any(f"level {LEVEL} meets suns" in note for note in notes) == small
