"""Light in grains, by what must be so whatever they do: furnaces, walls that leak nothing, rules at boundaries."""

import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import image, render, world
from tsdf.picture.render import Picture
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Rectangle,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.walk import geometry, lights

ONE = (ConstantLight((1.0, 1.0, 1.0)),)
OUTSIDE = Camera((3.0, -30.0, 7.0), (0.0, 0.0, 0.0), 16, 12, fov_deg=30.0)
INSIDE = Camera((0.3, -0.2, 0.1), (1.0, 0.5, 0.3), 8, 6, fov_deg=100.0)
JUMPING = (
    "teleport",
    "teleport-joint",
    "teleport-memory",
    "volume",
    "explicit",
    "teleport-packed",
)  # one of each way to move
MOST = {
    "explicit": 0.6,
    "teleport-packed": 0.6,
    "teleport-memory": 0.64,
}  # packing fractions of quick packings, of tabulated ones
BOX = Box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0))

# An L, extruded: a face of it sees another
OUTLINE = ((-6.0, -6.0), (6.0, -6.0), (6.0, 0.0), (0.0, 0.0), (0.0, 6.0), (-6.0, 6.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the meshes and environments of these tests."""
    import trimesh

    made = tmp_path_factory.mktemp("scenes")
    corners = [(x, y, z) for z in (-4.0, 4.0) for x, y in OUTLINE]
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [(c, b, a) for a, b, c in top] + [(a + 6, b + 6, c + 6) for a, b, c in top]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    trimesh.Trimesh(corners, faces, process=False).export(made / "concave.ply")
    trimesh.creation.icosphere(2, radius=6.0).export(made / "convex.ply")
    trimesh.creation.box(bounds=[BOX.low, BOX.high]).export(made / "box.ply")
    trimesh.creation.icosphere(2, radius=2.0).export(made / "buried.ply")
    # A wedge of 6 degrees, its edge upright at x = 0
    wedge = [(x, y, z) for z in (-3.0, 3.0) for x, y in ((0.0, 0.0), (8.0, -0.4), (8.0, 0.4))]
    sides = [(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)]
    trimesh.Trimesh(wedge, sides, process=False).export(made / "wedge.ply")
    # Dark to 22.5 degrees under the horizon, or light would come past the end of the largest floor
    for name, rows in (("white", (1.0, 1.0)), ("above", (1.0, 0.0)), ("below", (0.0,) * 5 + (1.0,) * 3)):
        image.write_exr(made / f"{name}.exr", np.repeat(np.array(rows)[:, None, None], 3, 2))
    return made


@pytest.fixture(scope="module")
def ball():
    """Return the table of the exact sphere."""
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=128, joint=16, memory=16))


@pytest.fixture(scope="module")
def cube():
    """Return the table of a traced grain."""
    shape = load_grain("cube")
    build = scatterometer.Build.start(shape, Optics(1.5), Effort(100_000, cells=64, joint=8, memory=32))
    build.run(shape)
    return build.table()


def scene_of(shapes, table, *surfaces, fraction=0.5, lights=ONE, camera=OUTSIDE, spheres=400) -> Scene:
    """Return a scene of media of one grain of radius 1 in some shapes."""
    media = tuple(
        MediumSpec(shape, fraction, 1.0, (GrainSpec(table),), name=f"medium {i}", packing_spheres=spheres)
        for i, shape in enumerate(shapes, 1)
    )
    return Scene(camera, lights, media, surfaces)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Make the grid of distances in no time: how fine it is must not matter."""
    monkeypatch.setattr(geometry, "GRID_CELLS", 50_000)


def aimed(made: world.World) -> world.World:
    """Return a world whose whole environment is aimed at, bright or not."""
    (sky,) = made.scene.lights
    pixels = image.read_environment(sky.file).radiance
    return replace(made, lights=lights.compile_lights(environment=pixels, contrast=0.0))


def take(scene: Scene, level: str, spp: int = 8, aim: bool = False, **how) -> Picture:
    """Return a picture whose paths all came to an end."""
    made = world.build(scene, level)
    picture = render.render(aimed(made) if aim else made, spp=spp, threads=2, **how)
    assert picture.truncated == 0
    assert picture.faults == 0
    return picture


def mean_of(picture: Picture) -> tuple[float, float]:
    """Return the mean of a picture's green and its standard error."""
    return float(picture.rgb[..., 1].mean()), math.sqrt(float(picture.variance[..., 1].sum())) / picture.samples.size


def agree(a: Picture, b: Picture, error: float = 0.0) -> bool:
    """Return whether two pictures have one mean, within 4 standard errors."""
    (x, dx), (y, dy) = mean_of(a), mean_of(b)
    return abs(x - y - error) <= 4.0 * math.hypot(dx, dy)


def shape_of(name: str, folder: Path):
    exact = {"slab": Slab(-4.0, 4.0), "box": BOX, "ball": Sphere((0.0, 0.0, 0.0), 6.0)}
    return exact[name] if name in exact else Mesh(folder / f"{name}.ply")


def under(folder: Path, name: str) -> tuple[EnvironmentLight]:
    return (EnvironmentLight(folder / f"{name}.exr"),)


def white(shape) -> SurfaceSpec:
    return SurfaceSpec(shape, (1.0, 1.0, 1.0), "white")


def black(shape) -> SurfaceSpec:
    return SurfaceSpec(shape, (0.0, 0.0, 0.0), "black")


# ------------------------------------------------------------------------------------------------ furnace


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("shape", ["slab", "box", "ball", "convex", "concave"])
def test_furnace_of_constant_light_is_exact(shape, level, folder, ball):
    """A constant 1 around grains that take nothing is 1 in each sample: no weight is ever lost or made, from outside
    and from within. Nothing of it is sampled, so there is no noise to hide behind."""
    scene = scene_of([shape_of(shape, folder)], ball)
    made = world.build(scene, level)
    camera = replace(INSIDE, position=(-3.0, -3.0, 0.1)) if shape == "concave" else INSIDE
    for view in (OUTSIDE, camera):
        made.scene = replace(scene, camera=view)
        picture = render.render(made, spp=4, threads=1)
        assert picture.events > 0
        assert (picture.rgb == 1.0).all()
        assert picture.truncated == picture.faults == 0


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("shape", ["slab", "ball"])
def test_furnace_of_sampled_light(shape, level, folder, ball):
    """The same light as a picture of the sky is found by chance and by next-event estimation; their weights must add
    up: the mean is 1 within 4 standard errors, and no pixel stands out."""
    picture = take(scene_of([shape_of(shape, folder)], ball, lights=under(folder, "white")), level, 400, aim=True)
    mean, error = mean_of(picture)
    assert abs(mean - 1.0) <= min(max(4.0 * error, 1e-12), 5e-3)
    assert picture.rgb.max() < 2.0 * mean
    assert (error > 0.0) == (not LEVELS[level].traits.packed)


def test_furnace_notices_a_loss(folder, ball):
    """Negative control: grains that take 1e-3 of the light that goes through them fail the furnace's test."""
    scene = scene_of([Slab(-4.0, 4.0)], ball, lights=under(folder, "white"))
    grain = replace(scene.media[0].grains[0], absorption=Absorption("grey", (3e-3,)))
    picture = take(replace(scene, media=(replace(scene.media[0], grains=(grain,)),)), "teleport", 64)
    mean, error = mean_of(picture)
    assert abs(mean - 1.0) > 4.0 * error


@pytest.mark.parametrize("fraction", [0.05, 0.3, 0.64, 0.74])
@pytest.mark.parametrize("level", LEVELS)
def test_furnace_at_any_packing(fraction, level, ball):
    """The furnace is 1 for thin and dense packings; random packings end at 0.64."""
    scene = scene_of([BOX], ball, fraction=min(fraction, MOST.get(level, 1.0)))
    assert (take(scene, level, 2).rgb == 1.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("level", [x for x in LEVELS if not LEVELS[x].traits.packed])
def test_furnace_of_optical_thickness_1000(level, ball):
    """In a slab of optical thickness 1000 and more, seen from its middle and from outside, no path is given up."""
    made = world.build(scene_of([Slab(-1200.0, 1200.0)], ball, fraction=0.64), level)
    assert 2400.0 / made.media.free[0] > (1000.0 if level != "isotropic" else 200.0)
    for z, pixels in ((0.0, 4), (1300.0, 16)):
        made.scene = replace(made.scene, camera=Camera((0.0, 0.0, z), (1.0, 0.0, -1.0), pixels, pixels))
        picture = render.render(made, spp=2, threads=2)
        assert (picture.rgb == 1.0).all()
        assert picture.truncated == picture.faults == 0


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_furnace_of_traced_grains(level, folder, cube):
    """The furnace is 1 for grains with facets, atoms of p_theta and rays that miss them."""
    assert (take(scene_of([BOX], cube), level, 4).rgb == 1.0).all()
    picture = take(scene_of([BOX], cube, lights=under(folder, "white")), level, 32)
    mean, error = mean_of(picture)
    assert abs(mean - 1.0) <= max(4.0 * error, 1e-12)


@pytest.mark.parametrize("level", ["teleport", "teleport-joint", "teleport-memory", "volume"])
def test_no_sample_outshines_the_light(level, ball):
    """In constant light of radiance 1 no sample is above 1, whatever the grains absorb: a survivor of the roulette has
    what it had before at most, and a jump that a boundary cuts short has lost less than the roulette was told. Those
    that are above a third, and thus have survived or are not dim, show that there was something to bound."""
    grain = GrainSpec(ball, absorption=Absorption("grey", (3.0,)))
    scene = Scene(replace(OUTSIDE, width=96, height=72), ONE, (MediumSpec(BOX, 0.5, 1.0, (grain,), inside="centres"),))
    picture = render.render(world.build(scene, level), spp=1)
    inside = picture.rgb[picture.rgb < 0.999]
    assert picture.rgb.max() <= 1.0 + 1e-9
    assert inside.size > 1000 and inside.max() > 0.3


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("what", ["ball", "box", "mesh", "floor", "cut"])
def test_furnace_with_white_surfaces(what, level, folder, ball):
    """White things in the medium, a floor on its face and one that cuts it leave the furnace at 1."""
    shape = {
        "ball": Sphere((0.5, 0.0, 0.3), 2.0),
        "box": Box((-2.0, -1.0, -2.0), (1.0, 2.0, 1.0)),
        "mesh": Mesh(folder / "buried.ply"),
        "floor": Rectangle((0.0, 0.0, -4.0), (20.0, 0.0, 0.0), (0.0, 20.0, 0.0)),
        "cut": Rectangle((0.0, 0.0, 0.5), (20.0, 0.0, 0.0), (0.0, 0.0, 20.0)),
    }[what]
    assert (take(scene_of([BOX], ball, white(shape)), level, 4).rgb == 1.0).all()
    picture = take(scene_of([BOX], ball, white(shape), lights=under(folder, "white")), level, 16)
    mean, error = mean_of(picture)
    assert abs(mean - 1.0) <= max(4.0 * error, 1e-12)


@pytest.mark.parametrize("level", ["teleport", "teleport-memory", "volume"])
def test_a_furnace_seen_along_a_face(level, folder, ball):
    """No path is given up where the camera stands in a flat face of a mesh and looks along it, which the ray engine
    meets again and again: rays have to go far to be clear of what they leave at a thousandth of a degree."""
    along = Camera((0.5, -1.0, 4.0), (1.5, 0.0, 4.0), 16, 12, fov_deg=0.01)
    speck = white(Sphere((300.0, 400.0, -900.0), 1e-3))  # or nothing would ask the ray engine
    assert (take(scene_of([Mesh(folder / "box.ply")], ball, speck, camera=along), level, 16).rgb == 1.0).all()


@pytest.mark.parametrize("fov", [0.01, 0.001])
def test_a_wall_seen_along_a_face(fov, folder, ball):
    """No ray is begun so far along the face that a wall in front of the camera is passed over: all above the face is
    black, by a wall a hundredth away and a thickness of .003 long."""
    along = Camera((0.5, -1.0, 4.0), (1.5, 0.0, 4.0), 16, 24, fov_deg=fov)
    wall = black(Box((0.51, -4.0, 3.0), (0.513, 3.0, 5.0)))
    picture = take(scene_of([Mesh(folder / "box.ply")], ball, wall, camera=along), "volume", 8)
    assert (picture.rgb[:12] == 0.0).all()


# -------------------------------------------------------------------------------------------------- leaks

FLOOR = Rectangle((0.0, 0.0, -4.0), (1000.0, 0.0, 0.0), (0.0, 1000.0, 0.0))
ABOVE = Camera((1.0, -20.0, 6.0), (0.0, 0.0, 0.0), 16, 12, fov_deg=30.0)


def leaks(name: str, folder: Path, table) -> Scene:
    """Return a scene whose picture is black unless light goes through a wall."""
    dim = SurfaceSpec(Box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0)), (0.5, 0.5, 0.5), "walls")
    below = under(folder, "below")
    if name == "walls on the boundary":
        return scene_of([BOX], table, dim, camera=INSIDE)
    if name == "boundary beyond the walls":
        return scene_of([Box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))], table, dim, camera=INSIDE)
    if name == "floor on the boundary":
        return scene_of([BOX], table, black(FLOOR), lights=below, camera=ABOVE)
    if name == "floor that cuts":
        return scene_of([BOX], table, black(replace(FLOOR, centre=(0.0, 0.0, 0.3))), lights=below, camera=ABOVE)
    if name == "thin wall":
        wall = Box((-1000.0, -1000.0, -0.005), (1000.0, 1000.0, 0.005))
        return scene_of([BOX], table, SurfaceSpec(wall, (0.5,) * 3, "wall"), lights=below, camera=ABOVE)
    if name == "two sheets":
        sheets = [white(replace(FLOOR, centre=(0.0, 0.0, z))) for z in (-0.005, 0.005)]
        return scene_of([BOX], table, *sheets, lights=below, camera=ABOVE)
    if name == "hollow box":
        hollow = SurfaceSpec(Box((-1.0, -1.0, -1.0), (2.0, 1.0, 1.0)), (0.5, 0.5, 0.5), "hollow")
        return scene_of([BOX], table, hollow, camera=INSIDE)
    wedge = SurfaceSpec(Mesh(folder / "wedge.ply"), (0.5, 0.5, 0.5), "wedge")
    return scene_of([BOX], table, wedge, camera=replace(INSIDE, position=(7.0, 0.0, 0.1), target=(0.0, 0.0, 0.0)))


LEAKS = ("walls on the boundary", "boundary beyond the walls", "floor on the boundary", "floor that cuts", "thin wall",
         "two sheets", "hollow box", "wedge")  # fmt: skip


def meshed(scene: Scene, folder: Path) -> Scene:
    """Return a scene whose box of grains is a mesh."""
    import trimesh

    (medium,) = scene.media
    trimesh.creation.box(bounds=[medium.shape.low, medium.shape.high]).export(folder / "as_mesh.ply")
    return replace(scene, media=(replace(medium, shape=Mesh(folder / "as_mesh.ply")),))


@pytest.mark.slow
@pytest.mark.parametrize("level", JUMPING)
@pytest.mark.parametrize("boundary", ["exact", "mesh"])
@pytest.mark.parametrize("name", LEAKS)
def test_nothing_leaks(name, boundary, level, folder, ball):
    """Light on one side, the camera on the other, walls between that no light passes: exactly 0, for walls thinner than
    a grain, on a boundary, across it, and that meet in a sharp edge. 5e3 to 2e4 paths each."""
    scene = leaks(name, folder, ball)
    picture = take(scene if boundary == "exact" else meshed(scene, folder), level, 100)
    assert (picture.rgb == 0.0).all()


def test_a_boundary_just_before_a_wall(folder, ball):
    """A flat ray through the facet of a boundary 1e-4 or less before it meets a wall must not be moved beyond it."""
    wall = black(Rectangle((1.0, 0.0, 4.0), (0.0, 50.0, 0.0), (0.0, 0.0, 50.0)))
    scene = meshed(scene_of([BOX], ball, wall, lights=ONE), folder)
    made = world.build(scene, "teleport")
    d = np.array([1.0, 0.0, -0.005])
    for before in (1e-5, 5e-5, 1e-4):
        at = np.array([1.0 - before, 0.0, 4.0])
        assert (render.measure(made, world.beam(made, at - d, d), spp=100).rgb == 0.0).all()


def test_leaks_would_be_seen(folder, ball):
    """Negative control: a slit of 1e-3 of the floor lets light through that the same test sees."""
    scene = leaks("floor that cuts", folder, ball)
    half = Rectangle((-1001.0, 0.0, 0.3), (1000.0, 0.0, 0.0), (0.0, 1000.0, 0.0))
    other = replace(half, centre=(1001.0, 0.0, 0.3))
    assert take(replace(scene, surfaces=(black(half), black(other))), "teleport", 100).rgb.max() > 0.0


# --------------------------------------------------------------------------------------------- boundaries


def reflectance(made: world.World, spp: int, **how) -> Picture:
    """Return what a narrow beam from above finds."""
    camera = world.beam(made, (0.0, 0.0, 9.0), (0.0, 0.0, -1.0), 2.0)
    return render.measure(made, camera, spp=spp, threads=2, **how)


@pytest.mark.parametrize("level", ["teleport", "volume"])
@pytest.mark.parametrize("kind", ["boxes", "box and mesh"])
def test_media_that_touch_are_one(kind, level, folder, ball):
    """Two boxes, or a box and a mesh, that share a face are one box: the furnace is 1, the reflectance the same."""
    upper, lower = Box((-6.0, -5.0, 0.5), BOX.high), Box(BOX.low, (6.0, 5.0, 0.5))
    import trimesh

    trimesh.creation.box(bounds=[upper.low, upper.high]).export(folder / "upper.ply")
    halves = [upper if kind == "boxes" else Mesh(folder / "upper.ply"), lower]
    assert (take(scene_of(halves, ball), level, 4).rgb == 1.0).all()
    both = world.build(scene_of(halves, ball, lights=under(folder, "above")), level)
    one = world.build(scene_of([BOX], ball, lights=under(folder, "above")), level)
    thin = world.build(scene_of([upper], ball, lights=under(folder, "above")), level)
    expected = reflectance(one, 40_000)
    assert agree(reflectance(both, 40_000, seed=1), expected)
    assert not agree(reflectance(thin, 40_000, seed=1), expected)  # negative control


@pytest.mark.parametrize("level", JUMPING)
def test_camera_on_the_boundary(level, ball):
    """A camera on a face, an edge or a corner of the boundary sees the furnace as 1."""
    for place in ((0.0, 0.0, 4.0), (6.0, 0.0, 4.0), (6.0, 5.0, 4.0)):
        scene = scene_of([BOX], ball, camera=replace(INSIDE, position=place))
        assert (take(scene, level, 4).rgb == 1.0).all()


@pytest.mark.parametrize("level", LEVELS)
def test_exact_boundaries_are_the_meshes_limit(level, folder, ball):
    """A box and the mesh of that box, found by the ray engine, have one reflectance."""
    box, mesh = (
        world.build(scene_of([shape_of("box", folder)], ball, lights=under(folder, "above")), level),
        world.build(scene_of([Mesh(folder / "box.ply")], ball, lights=under(folder, "above")), level),
    )
    assert agree(reflectance(box, 20_000), reflectance(mesh, 20_000, seed=1))


@pytest.mark.parametrize("level", JUMPING[:3])
def test_deep_steps_change_nothing(level, folder, ball, monkeypatch):
    """Walkers that ask the ray engine at each event, for no distance is known to be free, find the same reflectance."""
    monkeypatch.setattr(geometry, "GRID_CELLS", 1_000_000)
    made = world.build(scene_of([Mesh(folder / "box.ply")], ball, lights=under(folder, "above")), level)
    expected = reflectance(made, 20_000)
    g = made.place.arrays.grid
    blank = g._replace(shape=(0, 0, 0), closed=False, beyond=False)
    place = replace(made.place, arrays=made.place.arrays._replace(grid=blank))
    blind = reflectance(replace(made, place=place), 20_000, seed=1)
    assert blind.rays > 1.2 * expected.rays
    assert agree(blind, expected)


@pytest.mark.parametrize("level", ["teleport", "volume", "explicit", "teleport-packed"])
@pytest.mark.parametrize("shape", ["slab", "box", "ball"])
def test_a_shape_alone_is_as_beside_others(shape, level, folder, ball):
    """What is answered on the spot, or in lanes, in one exact shape alone is what looking step by step finds.

    A ball too far and small to be met makes it look. Light from one side and a loss in the grains tell where light
    leaves, and how far it went. Single grains that stand alone are not looked for along the same steps: to rounding.
    """
    grain = GrainSpec(ball, absorption=Absorption("grey", (0.1,)))
    medium = MediumSpec(shape_of(shape, folder), 0.5, 1.0, (grain,), name="medium", packing_spheres=400)
    alone = Scene(OUTSIDE, (*ONE, SunLight((0.3, -0.8, 0.5), (1.0, 2.0, 3.0), 20.0)), (medium,))
    beside = replace(alone, surfaces=(black(Sphere((0.0, 900.0, 0.0), 1e-3)),))
    first, second = take(alone, level, spp=4), take(beside, level, spp=4)
    apart = level != "teleport-packed"
    assert np.abs(first.rgb - second.rgb).max() <= (1e-9 * second.rgb.max() if apart else 0.0)
    assert first.rgb.std() > 0.1 and first.events == second.events > 0


@pytest.mark.parametrize("level", LEVELS)
def test_constant_and_sampled_light_agree(level, folder, ball):
    """A black thing in the grains is as dark under a light that is drawn as under one that is only found."""
    thing = black(Sphere((0.0, 0.0, 1.0), 2.0))
    found = take(scene_of([BOX], ball, thing), level, 100)
    drawn = take(scene_of([BOX], ball, thing, lights=under(folder, "white")), level, 100, aim=True, seed=1)
    assert mean_of(found)[0] < 0.97
    assert agree(found, drawn)


@pytest.mark.parametrize("level", ["teleport", "volume"])
def test_buried_thing_shows_through_thin_grains(level, ball):
    """A black ball in hardly any grains looks as without them; dense ones hide it."""
    thing = black(Sphere((0.0, 0.0, 0.0), 2.0))
    alone = take(scene_of([], ball, thing), level, 50)
    thin = take(scene_of([BOX], ball, thing, fraction=1e-4), level, 50, seed=1)
    dense = take(scene_of([BOX], ball, thing, fraction=0.6), level, 50, seed=1)
    assert abs(mean_of(thin)[0] - mean_of(alone)[0]) < 0.02
    assert alone.rgb.min() == 0.0 < dense.rgb.min()


# -------------------------------------------------------------------------------------------- same pictures


@pytest.mark.parametrize("level", ["teleport", "explicit", "teleport-packed"])
def test_same_picture_for_any_threads(level, folder, ball):
    """The bytes of a picture depend on the seed and not on the number of threads."""
    made = world.build(scene_of([Mesh(folder / "box.ply")], ball, lights=under(folder, "above")), level)
    pictures = [render.render(made, spp=6, threads=n).rgb.tobytes() for n in (1, 2, 3)]
    assert len(set(pictures)) == 1
    assert render.render(made, spp=6, threads=1, seed=1).rgb.tobytes() != pictures[0]


def test_interrupted_picture_says_so(ball):
    """A stop from outside leaves the samples so far, whole and counted."""
    made, stop = world.build(scene_of([BOX], ball), "teleport"), threading.Event()
    picture = render.render(made, spp=10_000, threads=1, progress=lambda *_: stop.set(), stop=stop)
    assert picture.interrupted
    assert 0 < picture.samples.max() < 10_000
    assert (picture.rgb[picture.samples > 0] == 1.0).all()
    assert not render.render(made, spp=2).interrupted


@pytest.mark.parametrize("level", JUMPING)
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 1e5), (1e-6, 0.0), (1e6, 0.0)])
def test_far_large_and_small_scenes(scale, shift, level, folder, ball):
    """A scene far from the origin, in micrometres or in thousands of kilometres has the same reflectance."""

    def reflected(scale: float, shift: float, seed: int) -> Picture:
        mesh = Mesh(folder / "box.ply", scale, (shift, 0.0, -shift))
        medium = MediumSpec(mesh, 0.5, scale, (GrainSpec(ball),), "medium", packing_spheres=400)
        thing = black(Sphere((shift, 0.0, -shift), 2.0 * scale))
        made = world.build(Scene(OUTSIDE, under(folder, "above"), (medium,), (thing,)), level)
        camera = world.beam(made, (shift, 0.0, 9.0 * scale - shift), (0.0, 0.0, -1.0), 4.0 * scale)
        return render.measure(made, camera, spp=10_000, seed=seed, threads=2)

    assert agree(reflected(scale, shift, 1), reflected(1.0, 0.0, 0))
