"""Leaps deep inside: what they leave as it was, what they are made of, and when there are none."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsdf.data.table import Table
from tsdf.errors import SceneError, UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import leaping, render, world
from tsdf.picture.world import World, beam, build
from tsdf.scene.scene import (
    Absorption,
    Camera,
    ConstantLight,
    GrainSpec,
    Mesh,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
    parse,
)
from tsdf.spheres.gaps import Law
from tsdf.study import experiment
from tsdf.study.experiment import diffusion, scene_of
from tsdf.walk import passage
from tsdf.walk.lights import compile_lights
from tsdf.walk.passage import Chain

WHITE = ConstantLight((1.0, 1.0, 1.0))
CHAINS = ("teleport-memory", "teleport-joint", "teleport")
LEVELS = (*CHAINS, "volume", "volume-hg", "isotropic")


@pytest.fixture(scope="module")
def ball() -> Table:
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(joint=32, memory=64))


@pytest.fixture(scope="module")
def cube() -> Table:
    grain = load_grain("cube")
    made = scatterometer.Build.start(grain, Optics(1.31), Effort(200_000, joint=32, memory=32))
    made.run(grain, 2)
    return made.table()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer records do for tests."""
    monkeypatch.setattr(passage, "RECORDS", 2048)
    monkeypatch.setattr(passage, "TRIED", (2, 2, 2, 2, 1, 1, 1, 1))


def light(made: World, spp: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return reflected, transmitted and all light of a beam from above into a slab, and standard errors."""
    spec = experiment.Experiment(made, beam(made, (0.0, 0.0, 5.0), (0.0, 0.0, -1.0)), 1, shares(made))
    sums = experiment.gather(spec, spp, None, seed, 2)
    return sums.mean, sums.error


def shares(made: World) -> Callable[[np.ndarray, experiment.Ends], np.ndarray]:
    def read(places: np.ndarray, ends: experiment.Ends) -> np.ndarray:
        left = ends.weight * np.exp(ends.amounts @ made.absorption.rgb[0])
        up = ends.direction[:, 2] > 0.0
        far = np.hypot(ends.place[:, 0], ends.place[:, 1])
        return np.stack((left * up, left * ~up, left, left * up * (far < 24.0)), axis=1)

    return read


def slab(table: Table, thickness: float = 80.0, absorption: float = 0.003, fraction: float = 0.6) -> Scene:
    grain = GrainSpec(table, absorption=Absorption("grey", (absorption,)))
    return scene_of(Slab(-thickness, 0.0), grain, fraction, inside="grains")


def deviation(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.asarray((one[0] - other[0]) / np.hypot(one[1], other[1]))


@pytest.mark.slow
@pytest.mark.parametrize("level", ["teleport-memory", "teleport"])
def test_slabs_send_the_same_light_back(level: str, ball: Table) -> None:
    """Reflectance, transmittance, what absorption leaves and what comes back near the beam, of a slab of about seven
    transport mean free paths, within 4 standard errors of 0.3 to 1 %. The control has its balls about where light is
    instead of where it will be in the mean, and is rejected."""
    exact, leapt = build(slab(ball), level, leap=0.0), build(slab(ball), level)
    assert leapt.leap == leaping.GAMMA and exact.leap == 0.0
    truth = light(exact, 60_000)
    assert np.abs(deviation(light(leapt, 60_000, 1), truth)).max() < 4.0
    leapt.leaps.middle[:] = 0.0
    assert np.abs(deviation(light(leapt, 60_000, 1), truth)).max() > 8.0


@pytest.mark.slow
def test_mixtures_and_grains_that_are_missed(ball: Table, cube: Table) -> None:
    """The same for two kinds of grains of different absorption, of which one is missed by a third of the spheres."""
    for level in ("teleport-memory", "teleport-joint"):
        medium = slab(ball).media[0]
        kinds = (
            GrainSpec(ball, 0.4, absorption=Absorption("grey", (0.004,))),
            GrainSpec(cube, 0.6, absorption=Absorption("grey", (0.001,))),
        )
        scene = replace(slab(ball), media=(replace(medium, grains=kinds),))
        leapt = build(scene, level)
        assert leapt.leap
        truth = light(build(scene, level, leap=0.0), 40_000)
        assert np.abs(deviation(light(leapt, 40_000, 1), truth)).max() < 4.0
        leapt.leaps.crossed[:, :, :, 0] *= 1.3  # the control: a third more of one grain's matter
        assert deviation(light(leapt, 40_000, 1), truth)[2] < -4.0


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_a_furnace_is_exact(level: str, ball: Table) -> None:
    """Lossless grains under constant light are as bright as it to the last bit, and leaps are what light crosses them
    by; bytes are the same for any number of threads."""
    camera = Camera((0.0, 0.0, 900.0), (0.0, 0.0, 0.0), 5, 4, up=(0.0, 1.0, 0.0), fov_deg=50.0)
    scene = replace(scene_of(Sphere((0.0, 0.0, 0.0), 300.0), GrainSpec(ball), 0.6, inside="grains"), camera=camera)
    picture = render.render(build(scene, level), spp=16, threads=2)
    assert (picture.rgb == 1.0).all() and picture.leaps > 0 and picture.leapt > 10 * picture.leaps
    absorbing = replace(GrainSpec(ball), absorption=Absorption("rgb", (0.001, 0.002, 0.004)))
    coloured = replace(scene, media=(replace(scene.media[0], grains=(absorbing,)),), lights=(WHITE, sun(20.0)))
    one, three = (render.render(build(coloured, level), spp=16, threads=n) for n in (1, 3))
    assert one.rgb.tobytes() == three.rgb.tobytes() and one.leaps > 0


def sun(angle: float) -> SunLight:
    return SunLight((0.3, 0.2, 1.0), (3.0, 3.0, 3.0), angle)


@pytest.mark.slow
@pytest.mark.parametrize("level", ["teleport-memory", "teleport", "isotropic"])
@pytest.mark.parametrize("angle", [0.53, 25.0])
def test_light_that_is_aimed_is_not_lost(level: str, angle: float, ball: Table) -> None:
    """Every pixel of a ball under a sun, small or wide, is as bright with leaps as without: deviations are those of
    noise, chi^2 of 48 within its own 4.5 standard deviations and the mean within 4."""
    camera = Camera((0.0, -700.0, 100.0), (0.0, 0.0, 0.0), 8, 6, fov_deg=40.0)
    grain = GrainSpec(ball, absorption=Absorption("grey", (2e-3,)))
    scene = scene_of(Sphere((0.0, 0.0, 0.0), 200.0), grain, 0.6, inside="grains")
    scene = replace(scene, camera=camera, lights=(sun(angle),))
    leapt = build(scene, level)
    assert leapt.leap
    one, other = (
        render.render(made, spp=192, seed=k, threads=2) for k, made in enumerate((build(scene, level, leap=0.0), leapt))
    )
    assert other.leaps
    lit = (one.variance[..., 1] > 0.0) & (other.variance[..., 1] > 0.0)
    z = (one.rgb - other.rgb)[..., 1][lit] / np.sqrt((one.variance + other.variance)[..., 1][lit])
    assert (z**2).sum() < len(z) + 4.5 * math.sqrt(2.0 * len(z))
    assert abs(z.sum()) < 4.0 * math.sqrt(len(z))


def test_the_smaller_a_sun_the_deeper_leaps_stay(ball: Table) -> None:
    """What a leap's last grain sends to a sun by chance is e to minus the mean free paths left free, at the radiance of
    the sun: their product, which adds to the variance, is the same for all suns. A broad sky is not aimed at; a bright
    spot of it is as a sun of its size."""
    for light in (sun(0.53), sun(0.01), sun(180.0)):
        free = leaping.left_free(compile_lights(suns=[(light.direction, light.angular_diameter_deg, (3.0,) * 3)]))
        chord = 2.0 * math.sin(math.radians(0.25 * light.angular_diameter_deg))
        assert free == pytest.approx(max(0.0, -2.0 * math.log(chord)), abs=1e-9)
    spot = np.full((64, 128, 3), 0.01)
    assert leaping.left_free(compile_lights(environment=spot)) == 0.0
    spot[20, 30] = 1e4
    row = math.cos(20.0 * math.pi / 64.0) - math.cos(21.0 * math.pi / 64.0)
    assert leaping.left_free(compile_lights(environment=spot)) == pytest.approx(
        math.log(math.pi / (row * 2.0 * math.pi / 128.0)), rel=1e-3
    )
    made = build(replace(slab(ball, 400.0), lights=(sun(0.53),)), "teleport")
    assert made.leaps.size[0, 1] == pytest.approx(10.75 * made.media.free[0], rel=1e-2)


@pytest.mark.slow
def test_meshes_and_what_is_buried(ball: Table, tmp_path: Path) -> None:
    """A mesh of a ball with a dark ball buried in it: what comes out with leaps is what comes out without. The control
    takes leaps through the dark ball, for what they look at does not see it."""
    import trimesh

    trimesh.creation.icosphere(4, radius=90.0).export(tmp_path / "ball.ply")
    dark = SurfaceSpec(Sphere((0.0, 0.0, 20.0), 25.0), (0.0, 0.0, 0.0), "buried")
    scene = scene_of(Slab(-1.0, 0.0), GrainSpec(ball), 0.6, inside="grains")
    scene = replace(scene, media=(replace(scene.media[0], shape=Mesh(tmp_path / "ball.ply")),), surfaces=(dark,))

    def seen(made: World, seed: int) -> tuple[np.ndarray, np.ndarray]:
        picture = render.measure(
            made, beam(made, (20.0, 0.0, 120.0), (0.0, 0.0, -1.0)), spp=30_000, seed=seed, threads=2
        )
        return picture.rgb[0, 0, :1], np.sqrt(picture.variance[0, 0, :1])

    leapt = build(scene, "teleport-memory")
    assert leapt.leap
    truth = seen(build(scene, "teleport-memory", leap=0.0), 0)
    assert abs(deviation(seen(leapt, 1), truth)[0]) < 4.0
    leapt.place.arrays = leapt.place.arrays._replace(balls=np.zeros((0, 4)), ball_surface=np.zeros(0, np.int32))
    assert deviation(seen(leapt, 1), truth)[0] > 8.0


# ------------------------------------------------------------------------------------------------ records


@pytest.mark.slow
@pytest.mark.parametrize("level", ["teleport-memory", "teleport-joint", "teleport"])
def test_the_mean_square_step_is_that_of_diffusion(level: str, ball: Table, cube: Table) -> None:
    """What sums over the records say a martingale's step is, light does in an endless medium: within 4 standard errors
    of half a per cent, for grains that are missed too. The control is another packing fraction."""
    for table, fraction in ((ball, 0.3), (cube, 0.6)):
        block = experiment.block_of(table)
        walked = diffusion(level, GrainSpec(table), fraction, 12_000, block=block, threads=2)
        made, other = (known(level, table, f) for f in (fraction, fraction * 1.04))
        assert abs(walked.value - made.step2) < 4.0 * walked.error < 0.04 * made.step2
        assert abs(walked.value - other.step2) > 4.0 * walked.error
        off = (made.numbers[:, 2] - 1.0) / made.numbers[:, 3]  # N of the records against r^2 + 2 A r + B
        assert np.abs(off).max() < 4.0 and (made.numbers[:, 3] < 0.02).all()


def known(level: str, table: Table, fraction: float) -> passage.Passage:
    made = build(scene_of(Slab(-1e4, 0.0), GrainSpec(table), fraction, inside="grains"), level, leap=0.0)
    return passage.made(Chain(made.media, made.tables, made.memory), 0, float(made.media.free[0]), 1.0, 2)


@pytest.mark.slow
def test_records_are_kept_and_made_again_when_the_table_changes(
    ball: Table, cube: Table, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The second scene takes what the first has made, at another packing fraction, of another table or from a damaged
    file it is made; what is read is what was made. Scenes that are too thin make nothing, and neither does leap = 0."""
    monkeypatch.setenv("TSDF_CACHE", str(tmp_path))
    count, real = [0], passage.made

    def counted(*arguments: object, **how: object) -> passage.Passage:
        count[0] += 1
        return real(*arguments, **how)  # type: ignore[arg-type]

    monkeypatch.setattr(passage, "made", counted)
    first = build(slab(ball), "teleport-memory").leaps
    for scene, made in (
        (slab(ball), 1), (slab(ball, absorption=0.1), 1), (slab(ball, fraction=0.59), 2), (slab(cube), 3),
        (slab(ball, 40.0), 3),
    ):  # fmt: skip
        again = build(scene, "teleport-memory").leaps
        assert count[0] == made
    assert not build(slab(ball, 40.0), "teleport-memory").leap and not build(slab(ball), "teleport", leap=0.0).leap
    again = build(slab(ball), "teleport-memory").leaps
    assert count[0] == 3 and all((a == b).all() for a, b in zip(first, again, strict=True))
    real_law = world.law
    monkeypatch.setattr(world, "law", lambda f: replaced(real_law(f)))
    build(slab(ball), "teleport-memory")
    assert count[0] == 4  # another table of packings
    monkeypatch.setattr(world, "law", real_law)
    count[0] = 3
    for path in tmp_path.glob("leaps-*.npz"):
        path.write_bytes(path.read_bytes()[:-100])
    again = build(slab(ball), "teleport-memory").leaps
    assert count[0] == 4 and all((a == b).all() for a, b in zip(first, again, strict=True))


@pytest.mark.slow
def test_lengths_are_those_of_all_that_were_tried(ball: Table, cube: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Matter crossed per grain met, of each kind in a mixture, is known better than the records that are kept know it:
    within 4 standard errors of sixteen times as many, where that of as many is off by more than half of this."""
    kinds = (GrainSpec(ball, 0.4), GrainSpec(cube, 0.6))
    scene = replace(slab(ball), media=(replace(slab(ball).media[0], grains=kinds),))
    base = build(scene, "teleport", leap=0.0)
    monkeypatch.setattr(passage, "RECORDS", 512)
    off = []
    for times in (16, 1):
        monkeypatch.setattr(passage, "TRIED", (times,) * 4 + (1,) * 4)
        chain = Chain(base.media, base.tables, base.memory)
        made = passage.made(chain, 0, float(base.media.free[0]), 1.0, 2)
        met = made.records[:4, :, passage.GRAINS].mean(axis=1, dtype=np.float64)
        rate = made.crossed[:4, :, :2].mean(axis=1, dtype=np.float64) / met[:, None]
        shares = np.diff([0.0, *base.media.choice])
        known = shares * [table.statistics["mean_path_length"] for table in (ball, cube)]
        off.append((rate / known - 1.0) * np.sqrt(512 * met)[:, None])  # about 1.2 for as many records
    assert np.sqrt((off[0] ** 2).mean()) < 0.6 < np.sqrt((off[1] ** 2).mean())


def replaced(one: Law) -> Law:
    """Return a law whose first gap is another."""
    gap = one.gap.copy()
    gap[0, 0] *= 1.5
    return one._replace(gap=gap)


@pytest.mark.slow
def test_records_are_the_same_for_any_number_of_threads(ball: Table) -> None:
    made = build(slab(ball), "teleport", leap=0.0)
    chain = Chain(made.media, made.tables, made.memory)
    one, three = (passage.made(chain, 0, float(made.media.free[0]), 1.0, n) for n in (1, 3))
    assert (one.records == three.records).all() and (one.crossed == three.crossed).all()


# ------------------------------------------------------------------------------------------------ the option


def text(**section: object) -> dict[str, object]:
    return {
        "camera": {"position": [0, -9, 0], "target": [0, 0, 0], "width": 4, "height": 3},
        "light": [{"type": "constant", "radiance": 1.0}],
        "surface": [{"shape": {"type": "sphere", "centre": [0, 0, 0], "radius": 1}, "reflectance": 0.5}],
        "render": section,
    }


@pytest.mark.parametrize(
    ("leap", "why"),
    [(-1.0, ">= 0"), (0.5, "biased"), (math.inf, "finite"), (math.nan, "finite"), ("2", "number"), (True, "number")],
)
def test_what_cannot_be_a_leap_is_refused(leap: object, why: str, ball: Table) -> None:
    """In one line, in scenes and by name; 0 and 1 are taken."""
    with pytest.raises(SceneError, match=rf"\[render\]: leap must be .*{why}"):
        parse(text(leap=leap))
    for good in (0, 1, 2.5):
        assert parse(text(leap=good)).render.leap == good
    if isinstance(leap, float):
        with pytest.raises(UsageError, match=r"leap must be 0 or a finite number of at least 1"):
            build(slab(ball), "teleport", leap=leap)


def test_levels_that_cannot_leap(ball: Table) -> None:
    """Where it is named for them it is refused; as a default, or named for another level, it is not looked at."""
    with pytest.raises(SceneError, match=r"\[render\]: level explicit cannot leap.*leave out leap"):
        parse(text(level="explicit", leap=2))
    assert parse(text(level="explicit", leap=0)).render.leap == 0.0
    scene = replace(slab(ball), render=replace(slab(ball).render, leap=3.0))
    assert build(scene, "teleport").leap == 3.0
    spheres = replace(scene, media=(replace(scene.media[0], packing_spheres=100),))
    assert build(spheres, "explicit").leap == 0.0
    with pytest.raises(UsageError, match="level explicit cannot leap"):
        build(spheres, "explicit", leap=2.0)


def test_what_would_never_end_is_rendered(ball: Table) -> None:
    """A ball of 1e8 grains across, lossless, that holds the camera: 1e15 events a path, and none is given up."""
    scene = scene_of(Sphere((0.0, 0.0, 0.0), 1e8), GrainSpec(ball), 0.6, inside="grains")
    scene = replace(scene, camera=Camera((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2, 1))
    with pytest.raises(SceneError, match=r"light meets about .*take larger grains"):
        build(scene, "teleport", leap=0.0)
    picture = render.render(build(scene, "teleport"), spp=8, threads=1)
    assert (picture.rgb == 1.0).all() and picture.events > 1e12 and not picture.truncated
