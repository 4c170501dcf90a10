"""The first grains one by one, then the chain: what is exact of it, and what one model hands over to the other."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import SceneError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.handle import Handle
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import footprint, image, render, world
from tsdf.picture.render import Picture, Walkers
from tsdf.picture.world import World
from tsdf.sampling import GOLDEN, key_of, mix
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
    Render,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.spheres.around import around_of
from tsdf.spheres.packing import Packing, cells_of
from tsdf.walk import explicit, geometry, hybrid, memory, transport
from tsdf.walk.walker import FLY, HANDED, MOST, UNKNOWN, WALKER

CAMERA = Camera((0.0, -14.0, 6.0), (0.0, 0.0, 0.0), 12, 8)
ABOVE = Camera((0.0, 0.0, 50.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))
DOWN = (0.0, 0.0, -1.0)
WHITE = ConstantLight((1.0, 1.0, 1.0))
CHAINS = ("teleport-memory", "teleport-joint", "teleport")
FEW = 200  # spheres in a tile
SIGMAS = 4.0


@pytest.fixture(scope="module")
def ball() -> Table:
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=256, joint=32, memory=32))


@pytest.fixture(scope="module")
def cube() -> Table:
    grain = load_grain("cube")
    build = scatterometer.Build.start(grain, Optics(1.31), Effort(50_000, joint=16, memory=16))
    build.run(grain, 2)
    return build.table()


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an environment that is white above and black below."""
    path = tmp_path_factory.mktemp("sky") / "sky.exr"
    image.write_exr(path, np.array([[[1.0] * 3], [[0.0] * 3]]))
    return path


@pytest.fixture(scope="module")
def heap(tmp_path_factory: pytest.TempPathFactory, ball: Table, cube: Table) -> Scene:
    """Return a mixture of spheres and cubes that absorb, bounded by a mesh, on a floor, under a wide sun and a sky."""
    import trimesh

    path = tmp_path_factory.mktemp("heap") / "body.ply"
    trimesh.creation.icosphere(2, radius=5.0).export(path)
    grains = (GrainSpec(ball, 0.6, absorption=Absorption("rgb", (0.0, 0.01, 0.1))), GrainSpec(cube, 0.4))
    floor = SurfaceSpec(Rectangle((0.0, 0.0, -5.5), (50.0, 0.0, 0.0), (0.0, 50.0, 0.0)), (0.5, 0.6, 0.7))
    lights = (ConstantLight((0.5, 0.6, 0.7)), SunLight((0.6, 0.0, 0.8), (1.0, 0.9, 0.7), 40.0))
    medium = MediumSpec(Mesh(path), 0.5, 1.0, grains, name="heap", packing_spheres=FEW)
    return Scene(CAMERA, lights, (medium,), (floor,), name="heap")


def asking(scene: Scene, singles: int, inside: str = "grains", lights: tuple = ()) -> Scene:
    """Return a scene that asks for so many explicit grains, with another convention or other lights."""
    media = tuple(replace(medium, inside=inside) for medium in scene.media)
    return replace(scene, media=media, render=Render(spp=64, explicit_grains=singles), lights=lights or scene.lights)


def picture(scene: Scene, level: str, spp: int = 16, threads: int = 2, seed: int = 0) -> Picture:
    made = render.render(world.build(scene, level), spp, seed=seed, threads=threads)
    assert made.truncated == made.faults == 0
    return made


# ---------------------------------------------------------------------------------------------- the two ends


@pytest.mark.slow
@pytest.mark.parametrize("inside", ["grains", "centres"])
def test_with_many_it_is_the_explicit_level(heap: Scene, inside: str) -> None:
    """to the last bit: the same packing, the same grains and the same random numbers, whatever the chain. With two
    grains it is another picture."""
    truth = picture(asking(heap, 0, inside), "explicit")
    assert len(np.unique(truth.rgb)) > 100
    for level in CHAINS:
        one = picture(asking(heap, 1_000_000, inside), level)
        assert np.array_equal(one.rgb, truth.rgb) and one.events == truth.events
        assert not np.array_equal(picture(asking(heap, 2, inside), level).rgb, truth.rgb)


@pytest.mark.slow
def test_with_none_nothing_is_packed(heap: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """and the chain has one place and one handle, as if there were no other way."""
    monkeypatch.setattr(explicit, "pack", lambda *_: pytest.fail("a packing is made"))
    made = world.build(asking(heap, 0), "teleport-memory")
    assert made.media.singles == 0 and not made.packed.engines and made.brim is made.place
    walkers = Walkers(made)
    assert walkers.near is walkers.arrays and walkers.near_batches == walkers.batches


@pytest.mark.slow
@pytest.mark.parametrize("level", CHAINS)
def test_the_same_for_any_number_of_threads(heap: Scene, level: str) -> None:
    scene = asking(heap, 2, "centres")
    one, other = (picture(scene, level, threads=threads) for threads in (1, 3))
    assert np.array_equal(one.rgb, other.rgb) and np.array_equal(one.variance, other.variance)
    assert not np.array_equal(one.rgb, picture(scene, level, seed=1).rgb)


@pytest.mark.parametrize("inside", ["grains", "centres"])
@pytest.mark.parametrize("level", CHAINS)
def test_furnace(heap: Scene, ball: Table, cube: Table, level: str, inside: str) -> None:
    """Spheres and cubes that lose nothing, between white light and a white floor, look white: exactly 1 everywhere,
    with a mesh around them and with exact shapes."""
    lossless = (GrainSpec(ball, 0.6), GrainSpec(cube, 0.4))
    floor = (replace(heap.surfaces[0], reflectance=(1.0, 1.0, 1.0)),)
    for shape in (heap.media[0].shape, Box((-4.0,) * 3, (4.0,) * 3), Sphere((0.0, 0.0, 0.0), 4.0)):
        media = (replace(heap.media[0], shape=shape, grains=lossless),)
        made = picture(asking(replace(heap, media=media, surfaces=floor), 2, inside, (WHITE,)), level, spp=4)
        assert (made.rgb == 1.0).all() and made.events > 150


@pytest.mark.slow
def test_deep_below_the_first_grains_the_chain_leaps(ball: Table, sky: Path) -> None:
    """What a slab of seven transport mean free paths sends back of a sky, with three explicit grains, is with leaps
    what it is without, within 4 standard errors of half a per cent. The control has its balls about where light is
    instead of where it will be in the mean, and is rejected."""
    grain = GrainSpec(ball, absorption=Absorption("grey", (0.003,)))
    medium = MediumSpec(Slab(-80.0, 0.0), 0.6, 1.0, (grain,), packing_spheres=FEW, inside="grains")
    scene = Scene(ABOVE, (EnvironmentLight(sky),), (medium,), render=Render(explicit_grains=3))

    def seen(made: World, seed: int) -> tuple[float, float]:
        camera = world.beam(made, (0.0, 0.0, 5.0), DOWN, 40.0)
        one = render.measure(made, camera, spp=40_000, seed=seed, threads=2)
        return float(one.rgb[0, 0, 1]), float(one.variance[0, 0, 1])

    exact, leapt = world.build(scene, "teleport-memory", leap=0.0), world.build(scene, "teleport-memory")
    assert leapt.leap and not exact.leap and leapt.media.singles == 3
    truth, found = seen(exact, 0), seen(leapt, 1)
    assert abs(found[0] - truth[0]) < SIGMAS * math.sqrt(found[1] + truth[1]) < 0.02 * truth[0]
    leapt.leaps.middle[:] = 0.0
    control = seen(leapt, 1)
    assert abs(control[0] - truth[0]) > 2.0 * SIGMAS * math.sqrt(control[1] + truth[1])


# ------------------------------------------------------------------------------------------------ hand-over


def one_mirror(ball: Table, radius: float) -> World:
    """Return a world with a mirror of given radius in its middle, and others 20 R apart, the first met one by one."""
    shape = Sphere((0.5, -0.25, 0.125), 9.0 * radius)
    medium = MediumSpec(shape, 0.5, radius, (GrainSpec(ball),), packing_spheres=64)
    made = world.build(Scene(ABOVE, (WHITE,), (medium,), render=Render(explicit_grains=1)), "teleport-memory")
    alone = Packing(np.zeros((1, 3)), 20.0, 4.0 / 3.0 * math.pi / 8000.0, 0)
    made.packed.arrays = made.packed.arrays._replace(
        cells=(cells_of(alone),), centres=(np.zeros((1, 3)),), around=(around_of(alone),), eta=np.array([1e12])
    )
    return made


@pytest.mark.slow
@pytest.mark.parametrize("radius", [1.0, 0.004])
def test_the_state_at_the_hand_over(ball: Table, radius: float) -> None:
    """A mirror is met at a known point: from there light goes on along the mirrored direction, on the
    side and with the impact parameter that the normal there has, and the next sphere is drawn from them."""
    made = one_mirror(ball, radius)
    walkers = Walkers(made)
    walkers.asked[MOST] = 2  # room for more
    for i, (x, y) in enumerate(((0.3, 0.2), (-0.6, 0.5), (0.05, 0.0), (0.0, -0.97), (0.7, 0.7))):
        w = np.zeros(1, WALKER)[0]
        w["p"], w["d"], w["key"] = (radius * x, radius * y, 3.0 * radius), DOWN, key_of(3, i, 0)
        w["pdf"], w["free"], w["ray"], w["medium"], w["mode"], w["weight"] = -1.0, -1.0, -1, UNKNOWN, FLY, 1.0
        state = transport.follow(walkers.near, walkers.near_batches[0], w, np.zeros(0))
        assert state == HANDED and w["single"] == 1
        n = np.array([x, y, math.sqrt(1.0 - x * x - y * y)])
        d = np.array(DOWN) + 2.0 * n[2] * n
        side = n - (n @ d) * d
        key, was = w["key"], w.copy()
        hybrid.hand_over(walkers.arrays, w)
        assert np.abs(w["p"] / radius - n).max() < 1e-12 and np.abs(w["d"] - d).max() < 1e-12
        assert np.array_equal(was["p"], w["p"]) and w["mode"] == FLY and w["medium"] == 0
        b = float(np.linalg.norm(side))
        bits = np.uint64(mix(np.uint64((int(key) + int(GOLDEN)) % 2**64)))
        gap, t, b_next = memory.onward(made.memory, 0, tuple(d), tuple(side / b), b, bits)
        assert (w["free"] / radius, w["b"]) == pytest.approx((gap, b_next), abs=1e-9)
        assert w["t"] == pytest.approx(t, abs=1e-9)


@pytest.mark.slow
def test_the_next_sphere_is_that_of_the_packing(ball: Table) -> None:
    """Where light leaves the second sphere, the next sphere of the very packing and the one that the chain draws are
    alike in how far their centre is from the one left, and in how its two normals point to one side. With the side
    turned over, or begun at the middle of the sphere, they are not."""
    scene = Scene(
        ABOVE, (WHITE,), (MediumSpec(Sphere((0.0,) * 3, 500.0), 0.6, 1.0, (GrainSpec(ball),), packing_spheres=FEW),)
    )
    made = world.build(replace(scene, render=Render(explicit_grains=2)), "teleport-memory", leap=0.0)
    walkers, arrays, room = Walkers(made), Handle(made.packed.arrays), Handle(made.place.room)
    walkers.asked[MOST] = 2  # room for more
    n, rng = 1_000, np.random.default_rng(1)
    found: dict[str, list[tuple[float, float]]] = {"packing": [], "chain": [], "turned over": [], "from the middle": []}
    for i in range(n):
        w = np.zeros(1, WALKER)[0]
        d = rng.normal(size=3)
        w["p"], w["d"], w["key"] = 30.0 * rng.random(3), d / np.linalg.norm(d), key_of(4, i, 0)
        w["pdf"], w["free"], w["ray"], w["medium"], w["mode"], w["weight"] = -1.0, -1.0, -1, UNKNOWN, FLY, 1.0
        assert transport.follow(walkers.near, walkers.near_batches[0], w, np.zeros(0)) == HANDED
        p, d, q = (np.array(w[name]) for name in "pdq")
        side = (p - q) - ((p - q) @ d) * d

        def seen(centre: np.ndarray, q: np.ndarray = q, d: np.ndarray = d, side: np.ndarray = side) -> tuple:
            other = (q - centre) - ((q - centre) @ d) * d + side  # of the point of entry, about the next centre
            return float(np.linalg.norm(centre - q)), float(side @ other)

        def drawn(w: np.void, d: np.ndarray = d) -> np.ndarray:
            b = float(w["b"])
            return np.array(w["p"]) + (w["free"] + math.sqrt(1.0 - b * b)) * d - b * np.array(w["t"])

        other = w.copy()
        explicit.find(arrays, room, other, 1e9)
        found["packing"].append(seen(np.array(other["e"])))
        for name in ("chain", "turned over", "from the middle"):
            other = w.copy()
            if name == "turned over":
                other["q"] = q + 2.0 * side  # whose outward normal has the other side
            hybrid.hand_over(walkers.arrays, other)
            if name == "from the middle":
                other["p"] = q
            found[name].append(seen(drawn(other)))
    truth = np.array(found.pop("packing"))
    for name, values in found.items():
        other = np.array(values)
        error = np.sqrt((truth.var(axis=0) + other.var(axis=0)) / n)
        apart = np.abs(truth.mean(axis=0) - other.mean(axis=0)) / error
        assert (apart < SIGMAS).all() if name == "chain" else (apart > 1.5 * SIGMAS).any(), (name, apart)


# ------------------------------------------------------------------------------------------- how right it is


def layer(level: str, singles: int, table: Table, sky: Path, spp: int = 60_000, **medium: object) -> Picture:
    """Return what a wide beam from above sees of a layer of centres 10 R thick."""
    spec = MediumSpec(Slab(-10.0, 0.0), 0.6, 1.0, (GrainSpec(table),), inside="centres", **medium)  # type: ignore[arg-type]
    scene = Scene(ABOVE, (EnvironmentLight(sky),), (spec,), render=Render(explicit_grains=singles))
    made = world.build(scene, level)
    return render.measure(made, world.beam(made, (0.0, 0.0, 50.0), DOWN, 300.0), spp=spp, seed=singles, threads=2)


@pytest.mark.slow
def test_reflectance_of_a_layer(ball: Table, sky: Path) -> None:
    """teleport-memory after any number of grains is as bright as the explicit level; teleport is not before there
    are many, and comes nearer with each."""
    truth = layer("explicit", 0, ball, sky)

    def off(level: str, singles: int) -> tuple[float, float]:
        made = layer(level, singles, ball, sky)
        error = math.sqrt(made.variance[0, 0, 1] + truth.variance[0, 0, 1])
        return float(made.rgb[0, 0, 1] - truth.rgb[0, 0, 1]), error

    for singles in (1, 3, 8):
        difference, error = off("teleport-memory", singles)
        assert abs(difference) < SIGMAS * error
    difference, error = off("teleport", 0)
    assert difference > SIGMAS * error
    nearer, error = off("teleport", 8)
    assert abs(nearer) < 0.5 * difference + SIGMAS * error


@pytest.mark.slow
def test_single_grains_show(ball: Table, sky: Path) -> None:
    """The squared error of pixels, half an R wide, falls from none to three to ten explicit grains: from independent
    halves, so that noise has no part in the mean."""
    spec = MediumSpec(Slab(-10.0, 0.0), 0.6, 1.0, (GrainSpec(ball),), inside="centres", packing_spheres=FEW)
    scene, still = Scene(ABOVE, (EnvironmentLight(sky),), (spec,)), (0.0, 0.0, 0.0)
    grid = transport.CameraArrays((-3.0, -3.0, 20.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0), DOWN, still, still, 12)

    def half(level: str, singles: int, seed: int) -> np.ndarray:
        made = world.build(asking(scene, singles, "centres"), level)
        return render.measure(made, grid, 12, 12, 400, seed=seed, threads=2).rgb[..., 1]

    truth = [half("explicit", 0, seed) for seed in (0, 1)]
    square = []
    for singles in (0, 3, 10):
        one, other = (half("teleport-memory", singles, seed) - truth[seed] for seed in (0, 1))
        square.append(float((one * other).mean() / truth[0].mean() ** 2))
    assert square[0] > 1.5 * square[1] > 2.25 * abs(square[2])


@pytest.mark.slow
@pytest.mark.parametrize("level", ["teleport-memory", "teleport"])
def test_a_sun_looked_for_and_a_sun_found(heap: Scene, level: str) -> None:
    """Aimed light follows the rule: from the floor and from the chain it changes no mean, and a twentieth of the light
    of the sun more would be seen."""
    made = world.build(asking(heap, 2, "centres", (SunLight((0.6, 0.0, 0.8), (1.0, 0.9, 0.7), 120.0),)), level)
    looked = render.render(made, 400, threads=2)
    made.lights = made.lights._replace(sampled=False, power=math.inf)  # then all that is found counts in full
    found = render.render(made, 800, seed=1, threads=2)
    error = np.sqrt(looked.variance.sum(axis=(0, 1)) + found.variance.sum(axis=(0, 1)))
    one, other = looked.rgb.sum(axis=(0, 1)), found.rgb.sum(axis=(0, 1))
    assert (np.abs(one - other) < SIGMAS * error).all()
    assert (np.abs(1.05 * one - other) > SIGMAS * error).all()


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("level", "why"),
    [
        ("explicit", "follows all of them"),
        ("volume", "has no grains"),
        ("volume-hg", "has no"),
        ("isotropic", "has no"),
    ],
)
def test_levels_that_cannot_take_it(heap: Scene, level: str, why: str) -> None:
    with pytest.raises(SceneError, match=rf"heap: explicit_grains = 5: level {level} {why}.*teleport-memory.*or 0"):
        world.build(asking(heap, 5), level)


@pytest.mark.slow
def test_what_is_said(heap: Scene, ball: Table) -> None:
    """Of packings that cannot be, of mirrors, and of lights that are found by chance."""
    dense = replace(heap, media=(replace(heap.media[0], packing_fraction=0.7),))
    for level in CHAINS:
        with pytest.raises(SceneError, match=r"heap: \[\[medium\]\] 1 \(heap\): .*at most 0\.64"):
            world.build(asking(dense, 1), level)
    wide, small = (
        world.build(asking(heap, 1, "grains", (SunLight((0.6, 0.0, 0.8), (1.0, 0.9, 0.7), angle),)), "teleport").notes
        for angle in (40.0, 0.5)
    )
    assert any("explicit grains meet suns" in note for note in small)
    assert not any("meet suns" in note or "mean cosine" in note for note in wide)
    sphere = load_grain("sphere")
    build = scatterometer.Build.start(sphere, Optics(1e9), Effort(2_000, memory=4))
    build.run(sphere, 1)
    mirrors = replace(heap, media=(replace(heap.media[0], grains=(GrainSpec(build.table()),)),))
    (note,) = (n for n in world.build(asking(mirrors, 1), "teleport").notes if "mean cosine" in n)
    assert "take level explicit" in note
    for shape, inside, thin in (
        (Slab(0.0, 6.5), "grains", False), (Slab(0.0, 6.0), "grains", True), (Slab(0.0, 4.5), "centres", False),
        (Slab(0.0, 4.0), "centres", True),
    ):  # fmt: skip
        layer = replace(heap, media=(replace(heap.media[0], shape=shape),), surfaces=())
        said = [n for n in world.build(asking(layer, 1, inside), "teleport").notes if "a layer of 4 R" in n]
        assert len(said) == thin


@pytest.mark.slow
def test_a_grain_of_a_file(tmp_path: Path, heap: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its mesh is found beside the table, else in the scene's folder, never in the folder one happens to be in; what is
    not that grain is refused before anything is packed."""
    import trimesh

    for name in ("tables", "scenes", "here"):
        (tmp_path / name).mkdir()
    right, wrong = trimesh.creation.box((1.0, 1.2, 0.8)), trimesh.creation.box((1.0, 2.0, 3.0))
    right.export(tmp_path / "tables" / "rock.stl")
    grain = load_grain(tmp_path / "tables" / "rock.stl")
    build = scatterometer.Build.start(grain, Optics(1.31), Effort(2_000, memory=4))
    build.run(grain, 1)
    tsdf_format.write(build.table(), tmp_path / "tables" / "rock.tsdf.exr")
    spec = GrainSpec(tmp_path / "tables" / "rock.tsdf.exr")
    scene = replace(heap, media=(replace(heap.media[0], grains=(spec,)),), folder=str(tmp_path / "scenes"))
    monkeypatch.chdir(tmp_path / "here")
    assert world.build(scene, "explicit").packed.engines
    (tmp_path / "tables" / "rock.stl").rename(tmp_path / "scenes" / "rock.stl")
    assert world.build(asking(scene, 1), "teleport-memory").packed.engines
    wrong.export(tmp_path / "scenes" / "rock.stl")
    right.export("rock.stl")
    monkeypatch.setattr(explicit, "pack", lambda *_: pytest.fail("packed before the mesh was looked at"))
    with pytest.raises(SceneError, match=r"scenes.rock\.stl is not the grain the table was made of"):
        world.build(scene, "explicit")
    (tmp_path / "scenes" / "rock.stl").unlink()
    with pytest.raises(SceneError, match=r"'rock\.stl' is neither built in nor a file beside the table or the scene"):
        world.build(scene, "explicit")


# ---------------------------------------------------------------------------------------------- fewer far away


def test_fewer_where_a_pixel_covers_more() -> None:
    """All of them where grains look largest, none where there are none, and in between as many as leave the same error:
    4 ln 2 fewer, floored, where the texture is half."""
    slab = MediumSpec(Slab(-50.0, 0.0), 0.5, 1.0, (GrainSpec(Path("none")),))
    camera = Camera((0.0, -10.0, 8.0), (0.0, 40.0, 0.0), 64, 48, fov_deg=70.0)
    scene = Scene(camera, (WHITE,), (slab,))
    place = geometry.place(scene)
    made = SimpleNamespace(scene=scene, place=place)
    seen = footprint.footprints(scene, place, world.camera_of(made))
    met = footprint.met_by_pixel(scene, place, world.camera_of(made), 8).reshape(48, 64)
    assert np.isinf(seen[0]).all() and (met[0] == 8).all() and np.isfinite(seen[-1]).all()
    row = seen[:, 32]
    pixel = 2.0 * math.tan(math.radians(35.0)) / 64
    down = math.atan2(8.0, 50.0)
    ahead = 1.0 / (math.sin(down) + math.cos(down) * pixel * 23.5)  # to the last row, along the view, of a height
    assert row[-1] == pytest.approx(pixel * 8.0 * ahead, rel=1e-6)
    assert met[-1].min() == 0 and (np.diff(met[:, 32]) <= 0).all() and len(np.unique(met)) > 3
    half = np.argmin(abs(footprint.texture(row) - 0.5 * footprint.texture(row[-1])))
    assert abs(met[half, 32] - 4.0 * math.log(2.0)) <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("level", ["teleport-memory", "teleport"])
def test_pixels_with_fewer(heap: Scene, level: str) -> None:
    """A pixel that counts all grains as met is the chain's, one that counts none the hybrid's, to the last bit, side by
    side in one picture; and a scene that asks for fewer far away is neither."""
    chain, first = picture(asking(heap, 0), level), picture(asking(heap, 3), level)
    made = world.build(asking(heap, 3), level)
    count = heap.camera.width * heap.camera.height
    made.met = np.where(np.arange(count) % 2 == 0, 3, 0)
    mixed = render.render(made, 16, threads=2)
    even = (np.arange(count) % 2 == 0).reshape(chain.rgb.shape[:2])
    assert np.array_equal(mixed.rgb[even], chain.rgb[even]) and np.array_equal(mixed.rgb[~even], first.rgb[~even])
    assert not np.array_equal(chain.rgb, first.rgb)
    asked = asking(heap, 3)
    assert len(world.build(replace(asked, render=replace(asked.render, fewer_far=True)), level).met) == count
