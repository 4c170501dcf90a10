"""Pilots: what a sample takes, and candidates held against explicit sample by sample."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tsdf
from tsdf.picture import render, world
from tsdf.plan import planner, report, shot
from tsdf.plan.pilot import HALVES, Pilot, Seen
from tsdf.scene.scene import (
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Rectangle,
    Scene,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.study.candidates import Candidate, taken

SUN = SunLight((0.6, 0.0, 0.8), (2.0, 2.0, 2.0), 60.0)


@pytest.fixture(scope="module")
def slab() -> Scene:
    ball = tsdf.build("sphere", 1.33, tsdf.Effort(cells=64, joint=8, memory=8))
    camera = Camera((0.0, -6.0, 5.0), (0.0, 0.0, 0.0), 12, 9, fov_deg=30.0)
    medium = MediumSpec(Box((-9.0, -9.0, -6.0), (9.0, 9.0, 0.0)), 0.3, 1.0, (GrainSpec(ball),), packing_spheres=200)
    return Scene(camera, (ConstantLight((0.3, 0.3, 0.3)), SUN), (medium,), name="slab")


def piloted(scene: Scene, candidate: Candidate, *portions: int) -> Pilot:
    pilot = Pilot(world.build(taken(scene, candidate), candidate.level), 3, 1)
    pilot.warm()
    for each in portions:
        pilot._take(each)
    return pilot


def test_explicit_grains_are_held_beside_explicit_sample_by_sample(slab: Scene) -> None:
    """With so many explicit grains that light meets no more, all samples are those of level explicit, and there is no
    difference at all; with few most are, and the difference has much less noise than two pictures. It is not made
    small: three grains of a biased chain are as far off as all samples of both say. Pilots of other portions are held
    beside each other by what both took."""
    explicit = piloted(slab, Candidate("explicit"), 1, 1, 2, 4, 8, 16)
    many, few = (piloted(slab, Candidate("teleport", k), 1, 1, 2, 4) for k in (1000, 3))
    seen = many.apart(explicit, met=math.inf)
    assert seen.bias == seen.square == 0.0 and 0.0 < seen.noise < 0.1 * many.apart(explicit).noise
    beside, alone = few.apart(explicit, met=math.inf), few.apart(explicit)
    assert beside.noise < 0.5 * alone.noise
    error = math.hypot(beside.square_error, alone.square_error)
    assert abs(beside.square - alone.square) < 4.0 * error
    sums = few.marks[-1].sums - explicit.marks[3].sums
    mean = explicit.seen.mean
    assert beside.square == pytest.approx(float((sums[0] * sums[1]).mean()) / (8.0 * mean) ** 2)
    assert [mark.each for mark in explicit.marks] == [1, 2, 4, 8, 16, 32]


def test_what_few_lights_tell_is_little(slab: Scene) -> None:
    """Paths that are the same say less, the more seldom they met what light comes from."""
    explicit, many = (piloted(slab, one, 1, 1, 2) for one in (Candidate("explicit"), Candidate("teleport", 1000)))
    often, once = (many.apart(explicit, met=met) for met in (math.inf, 1.0))
    assert once.noise > 3.0 * often.noise > 0.0 == once.square


def test_halves_share_no_sample(slab: Scene) -> None:
    """Whatever the portions, a sample is of the same half in all pilots, and in one of them only."""
    one, other = piloted(slab, Candidate("explicit"), 1, 1, 2), piloted(slab, Candidate("explicit"), 4)
    assert np.allclose(one.sums, other.sums) and not np.allclose(one.sums[0], one.sums[1])
    assert one.counts[0] == other.counts[0] == 4 and HALVES == 2


def test_the_first_sample_of_a_pixel_takes_longer(slab: Scene) -> None:
    """Where portions of one sample take 10 s a pixel and those of 16 take 40, one more takes 2; of a pilot with
    portions of one size another's say so."""
    long = piloted(slab, Candidate("explicit"))
    long.portions = {1: [10.0, 11.0, 10.0], 16: [40.0]}
    assert long.sample_seconds == pytest.approx(2.0)
    short = piloted(slab, Candidate("teleport", 3))
    short.portions = {1: [5.0]}
    assert short.sample_seconds == 5.0
    short.like = long
    assert short.sample_seconds == pytest.approx(1.0)


@pytest.mark.slow
def test_pilots_take_what_pictures_take(slab: Scene) -> None:
    """A sample of a pilot and one of a picture of the same pixels take one thread as long, within a factor of 2 on a
    busy machine; of portions of one sample alone it would be more."""
    pilot = piloted(slab, Candidate("explicit"), 1, 1, 2, 4, 8, 16, 32, 64, 128)
    spp = 200
    picture = min(
        (render.render(pilot.world, spp=spp, seed=n, threads=1) for n in range(3)), key=lambda p: p.processor_seconds
    )
    ratio = pilot.sample_seconds / (picture.processor_seconds / spp / picture.samples.size)
    assert 0.5 < ratio < 2.0
    assert isinstance(pilot.seen, Seen) and pilot.seen.seconds == pilot.sample_seconds


def test_no_grain_that_does_not_fit(slab: Scene) -> None:
    """A sphere of radius 1 with grains of radius 2 has none: level explicit is the picture without it, to the last bit
    and with lights that are aimed at, and a plan leaves levels of single grains out and says why. Grains that fit are
    not refused."""
    small = replace(slab.media[0], shape=Sphere((0.0, 0.0, 0.0), 1.0), radius=2.0)
    lights = (SunLight((0.6, 0.0, 0.8), (2.0, 2.0, 2.0), 0.5),)
    floor = SurfaceSpec(Rectangle((0.0, 0.0, -2.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0)), (0.5, 0.5, 0.5))
    with_it, without = (replace(slab, lights=lights, media=media, surfaces=(floor,)) for media in ((small,), ()))
    one, other = (
        render.render(world.build(scene, "explicit"), spp=2, seed=1, threads=1) for scene in (with_it, without)
    )
    assert np.array_equal(one.rgb, other.rgb)
    for scene, refused in ((with_it, True), (slab, False)):
        run = planner._Planning(scene, 0.1, None, 0, 1)
        run.look()
        assert ("explicit" in run.impossible) == ("teleport-memory" in run.impossible) == refused
        assert "teleport" not in run.impossible
        assert not refused or "no grain of diameter 4 fits" in str(run.impossible["explicit"])


def test_seconds_are_for_planning_and_picture() -> None:
    """A tenth of the time that a picture may take, but 5 s where that is less, is planned, and a third at most."""
    assert [planner.planning_seconds(s) for s in (None, math.inf, 6.0, 30.0, 120.0, 9000.0)] == [5, 5, 2, 5, 12, 20]
    now = time.perf_counter()
    choice = shot.Choice(None, None, 60.0, None, None, now + 41.0)  # type: ignore[arg-type]
    assert choice.left == pytest.approx(41.0, abs=1.0)
    assert choice._replace(ends=now - 5.0).left == 15.0 and choice._replace(ends=None).left == 60.0


def test_a_third_of_the_seconds_for_both_is_planned(slab: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 9 s for planning and picture 3 are planned at most, and the picture has 6."""
    made: list[Any] = []
    monkeypatch.setattr(planner._Planning, "plan", lambda self: made.append(self))
    planner.plan(slab, seconds=9.0, together=True)
    planner.plan(slab, seconds=9.0)
    assert [(run.budget, run.limit, run.whole) for run in made] == [(3.0, 6.0, 9.0), (3.0, 9.0, 9.0)]


def test_numbers_have_the_digits_that_errors_allow() -> None:
    """Two of the error's own."""
    said = [report.within(*pair) for pair in ((1.2628, 1.7402), (0.0099, 0.0029), (0.0, 0.0), (-0.00001, 0.0002))]
    assert said == ["130 ± 170", "0.99 ± 0.29", "0 ± 0", "-0.001 ± 0.020"]
    assert (
        report.percent(1.264) == "130 %"
        and report.percent(0.0213) == "2.1 %"
        and report.percent(math.inf) == "not known"
    )
