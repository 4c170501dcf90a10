"""Light in a lone mesh, in lanes, does what it does alone: the same samples with the same random numbers."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.handle import Handle
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render, world
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Scene,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.walk import bodies, grid, transport, walker, ways

ONE = ConstantLight((1.0, 1.0, 1.0))
SUN = SunLight((0.36, -0.48, 0.8), (3.0, 2.0, 1.0), 2.0)
OUTSIDE = Camera((3.0, -30.0, 7.0), (0.0, 0.0, 0.0), 20, 15, fov_deg=25.0)
INSIDE = Camera((0.3, -0.2, 0.1), (1.0, 0.5, 0.3), 16, 12, fov_deg=100.0)
SAMPLES = 20


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Mesh]:
    """Return a convex body, one with deep dents, which light leaves and comes back to, a fine one, and one of two parts
    with thin fins."""
    folder = tmp_path_factory.mktemp("meshes")

    def written(name: str, points: np.ndarray, faces: np.ndarray) -> Mesh:
        lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points]
        lines += [f"f {i} {j} {k}" for i, j, k in faces + 1]
        (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
        return Mesh(folder / f"{name}.obj", scale=4.0)

    found = {}
    for name, subdivisions, depth in (("convex", 2, 0.0), ("dented", 3, 0.3), ("fine", 5, 0.1)):
        ball = load_grain("icosphere", subdivisions=subdivisions)
        dents = 1.0 + depth * np.sin(7.0 * ball.vertices).prod(axis=1, keepdims=True)
        found[name] = written(name, ball.vertices * dents, ball.faces)
    box = load_grain("icosphere", subdivisions=2)
    points = np.concatenate((box.vertices * (0.5, 0.5, 0.02), box.vertices * (0.5, 0.5, 0.2) + (0.3, 0.2, 0.4)))
    found["parts"] = written("parts", points, np.concatenate((box.faces, box.faces + len(box.vertices))))
    return found


def scene_of(shape, lights, *grains, camera=OUTSIDE, surfaces=()) -> Scene:
    return Scene(camera, lights, (MediumSpec(shape, 0.5, 0.4, grains, name="grains"),), surfaces)


def followed(made: world.World, in_lanes: bool, seed: int = 3, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Return the radiance (samples, 3) of all samples of a picture, and the counters."""
    walkers = render.Walkers(made)
    assert walkers.lanes is not None and walkers.stride is bodies.walk
    if not in_lanes:
        walkers.lanes = None
    camera = made.scene.camera
    job = transport.Job(world.camera_of(made), 0, samples, 0, seed)
    found = walkers.follow(job, camera.width * camera.height, threading.Event())
    return found.reshape(-1, 3), walkers.counters


def alike(found: np.ndarray, other: np.ndarray) -> float:
    """Return the share of samples that agree but for rounding."""
    return float((np.abs(found - other) <= 1e-9 * np.abs(other).max()).all(axis=1).mean())


def check(made: world.World, samples: int = SAMPLES) -> None:
    """The same light and events in lanes as alone, without the ray engine; another seed's samples would not pass."""
    (found, events), (other, expected) = followed(made, True, samples=samples), followed(made, False, samples=samples)
    assert alike(found, other) > 0.9995
    assert abs(events[walker.EVENTS] / expected[walker.EVENTS] - 1.0) < 1e-3
    assert events[walker.TRUNCATED] == events[walker.FAULTS] == events[walker.RAYS] == 0
    assert alike(followed(made, True, seed=4, samples=samples)[0], other) < 0.9


@pytest.mark.parametrize("name", ["convex", "dented", "fine", "parts"])
def test_same_samples(name: str, meshes, table, sky) -> None:
    """Under a sky that differs in all directions, with a sun, among grains that absorb: shadows, roulette, amounts."""
    grain = GrainSpec(table, absorption=Absorption("rgb", (0.02, 0.1, 0.5)))
    check(world.build(scene_of(meshes[name], (SUN, sky), grain), "teleport"))


@pytest.mark.parametrize("level", ["teleport-joint", "volume", "volume-hg", "isotropic"])
def test_same_at_all_levels(level: str, meshes, table, sky) -> None:
    check(world.build(scene_of(meshes["dented"], (SUN, sky), GrainSpec(table)), level), samples=8)


@pytest.mark.parametrize("name", ["convex", "dented"])
def test_same_from_inside(name: str, meshes, table, sky) -> None:
    check(world.build(scene_of(meshes[name], (sky,), GrainSpec(table), camera=INSIDE), "teleport"), samples=8)


def test_same_among_grains_of_two_kinds(meshes, table, sky) -> None:
    """Of which one absorbs, by wavelength."""
    dark = Absorption("spectral", (0.1, 0.4, 0.9), (360.0, 550.0, 830.0))
    other = exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=32, joint=0))
    grains = GrainSpec(table, 0.7), GrainSpec(other, 0.3, absorption=dark)
    check(world.build(scene_of(meshes["dented"], (SUN, sky), *grains), "teleport"), samples=8)


@pytest.mark.slow
@pytest.mark.parametrize("name, lights", [("convex", 2), ("dented", 1)])
def test_same_where_light_leaps(name: str, lights: int, meshes, table, sky) -> None:
    """In a body that is deep enough for leaps, among grains that absorb a little."""
    grain = GrainSpec(table, absorption=Absorption("grey", (0.001,)))
    camera = Camera((30.0, -400.0, 70.0), (0.0, 0.0, 0.0), 12, 9, fov_deg=15.0)
    deep = replace(meshes[name], scale=40.0)
    made = world.build(scene_of(deep, (sky, SUN)[:lights], grain, camera=camera), "teleport", leap=1.0)
    check(made)
    found, expected = followed(made, True)[1], followed(made, False)[1]
    assert abs(found[walker.LEAPS] / expected[walker.LEAPS] - 1.0) < 0.01 and expected[walker.LEAPS] > 1000


@pytest.mark.parametrize("limit", [1, 2, 6])
def test_handed_over(limit: int, meshes, table, sky) -> None:
    """Light that has met many grains and walls is handed over, goes on as it would have, and is counted if given up."""
    made = world.build(scene_of(meshes["dented"], (SUN, sky), GrainSpec(table)), "teleport")
    few = replace(made, media=made.media._replace(limit=limit))
    (found, counted), (other, expected) = (followed(few, here, samples=60) for here in (True, False))
    assert alike(found, other) > 0.9995
    assert counted[walker.TRUNCATED] == expected[walker.TRUNCATED] > 1000
    assert counted[walker.EVENTS] == pytest.approx(expected[walker.EVENTS], rel=1e-3)


@pytest.mark.parametrize("name", ["convex", "dented", "fine", "parts"])
def test_furnace_is_exact(name: str, meshes, table) -> None:
    """Light that loses nothing is 1 to the last bit, in every pixel, from outside and inside."""
    for camera in (OUTSIDE, INSIDE):
        made = world.build(scene_of(meshes[name], (ONE,), GrainSpec(table), camera=camera), "teleport")
        picture = render.render(made, spp=32, seed=1)
        assert (picture.rgb == 1.0).all() and picture.truncated == 0


def test_any_number_of_threads_and_portions(meshes, table, sky) -> None:
    """Pictures are the same bytes for any number of threads, and samples whatever is followed with them."""
    made = world.build(scene_of(meshes["dented"], (SUN, sky), GrainSpec(table)), "teleport")
    one, three = (render.render(made, spp=300, seed=2, threads=threads) for threads in (1, 3))
    assert (one.rgb == three.rgb).all() and one.events == three.events
    walkers, camera = render.Walkers(made), world.camera_of(made)
    whole = walkers.follow(transport.Job(camera, 0, 8, 0, 5), 300, threading.Event())
    part = walkers.follow(transport.Job(camera, 100, 3, 4, 5), 20, threading.Event())
    assert (part == whole[100:120, 4:7]).all()


def test_who_walks_in_lanes(meshes, table) -> None:
    """A lone mesh, at levels that know no packing, whose grains are not tiny; nothing else."""

    def walks(*shapes, level: str = "teleport", surfaces=(), radius: float = 0.4) -> bool:
        media = tuple(MediumSpec(shape, 0.5, radius, (GrainSpec(table),)) for shape in shapes)
        made = world.build(Scene(OUTSIDE, (ONE,), media, surfaces), "teleport")
        return bodies.suited(made.place.arrays, made.media._replace(traits=LEVELS[level].traits))

    assert walks(meshes["convex"]) and walks(meshes["parts"]) and walks(meshes["dented"], level="isotropic")
    levels = ("explicit", "teleport-packed", "teleport-memory")
    assert not any(walks(meshes["convex"], level=level) for level in levels)
    assert not walks(meshes["convex"], radius=0.004)
    far = replace(meshes["convex"], translate=(20.0, 0.0, 0.0))
    assert not walks(Sphere((0.0, 0.0, 0.0), 3.0)) and not walks(meshes["convex"], far)
    assert not walks(meshes["convex"], surfaces=(SurfaceSpec(Sphere((9.0, 0.0, 0.0), 1.0), (1.0, 1.0, 1.0)),))
    assert not walks(meshes["convex"], surfaces=(SurfaceSpec(Box((8.0,) * 3, (9.0,) * 3), (1.0, 1.0, 1.0)),))


@pytest.mark.parametrize("name", ["convex", "dented", "fine", "parts"])
def test_ways_meet_what_rays_do(name: str, meshes, table) -> None:
    """Ways from anywhere, far and short, at corners and middles of edges, along axes and in planes of facets, meet the
    facets that one ray at a time does; moved a little to the side, some do not."""
    field = world.build(scene_of(meshes[name], (ONE,), GrainSpec(table)), "teleport").place.arrays.grid
    rng, many = np.random.default_rng(5), 6000
    corners = field.facets.reshape(-1, 4, 4)[:, 1:, :3].transpose(0, 2, 1)
    p, d = rng.uniform(-6.0, 6.0, (many, 3)), rng.normal(size=(many, 3))
    aims = corners[rng.integers(0, len(corners), many)]
    d[: many // 3] = (aims[:, 0] - p)[: many // 3]
    d[many // 3 : many // 2] = (0.5 * (aims[:, 0] + aims[:, 1]) - p)[many // 3 : many // 2]
    p[-500:], d[-500:] = aims[-500:, 0] - (aims[-500:, 1] - aims[-500:, 0]), (aims[-500:, 1] - aims[-500:, 0])
    p[-900:-500], d[-900:-500] = aims[-900:-500].mean(axis=1) - (0.0, 0.0, 3.0), (0.0, 0.0, 1.0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    end = np.where(rng.random(many) < 0.5, math.inf, rng.exponential(3.0, many))
    arrays, room, met = Handle(field), ways.ways_of(256), np.zeros(1, np.int32)
    side = np.array([1e-3, 2e-3, -1e-3])

    def together(shift: float) -> np.ndarray:
        handle, facets = Handle(room), []
        for begin in range(0, many, 200):
            for k in range(200):
                ways.lay(room, k, tuple(p[begin + k] + shift * side), tuple(d[begin + k]), end[begin + k])
            ways.meet(arrays, handle, 200)
            facets.append(room.facets[:200, 0].copy())
        return np.concatenate(facets)

    expected = np.full(many, -1)
    known = np.zeros(many, bool)
    for k in range(many):
        known[k] = grid.march(arrays, met, 0, tuple(p[k]), tuple(d[k]), end[k])
        expected[k] = met[0]
    found = together(0.0)
    assert known.mean() > 0.9 and 0.2 < (expected >= 0).mean() < 0.95
    differ = (found != expected)[known]  # only where facets are met at one place, or farther than asked
    at = [grid.plane_hit(field.facets, max(f, 0), tuple(p[k]), tuple(d[k]))[0] if f >= 0 else math.inf
          for both in (found, expected) for k, f in enumerate(both)]  # fmt: skip
    one, other = np.array(at).reshape(2, -1)
    near = np.minimum(one, other) <= end
    with np.errstate(invalid="ignore"):
        assert (~near | (np.abs(one - other) < 1e-9) | (found == expected))[known].all() and differ.mean() < 0.25
    assert (together(1.0) != expected)[known].mean() > differ.mean() + 0.005
