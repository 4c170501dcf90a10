"""Plans as a whole, with short pilots: what they must not say, what they refuse, and how they reach pictures."""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest

import tsdf
from tsdf.data import library
from tsdf.errors import SceneError, UsageError
from tsdf.picture import render, world
from tsdf.plan import evidence, planner, report, shot
from tsdf.plan.beliefs import CERTAIN, Belief
from tsdf.plan.choice import Wish, choose
from tsdf.plan.pilot import Apart, Clocks, Pilot
from tsdf.plan.planner import plan
from tsdf.plan.prediction import TIE, Plan, Prediction
from tsdf.plan.prior import Body
from tsdf.reference_data.make_checks import CHECKS
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import (
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Rectangle,
    Render,
    Scene,
    SunLight,
    SurfaceSpec,
)
from tsdf.study.candidates import Candidate
from tsdf.walk import geometry

LIGHTS = (ConstantLight((0.3, 0.3, 0.3)), SunLight((0.6, 0.0, 0.8), (2.0, 2.0, 2.0), 60.0))
FEW = 300  # spheres in a tile


@pytest.fixture(scope="module")
def ball() -> tsdf.Table:
    return tsdf.build("sphere", 1.33, tsdf.Effort(cells=256, joint=32, memory=32))


SECOND = 2.0**-20  # [s] of a grain or a boundary that light meets, about; sums of it are exact
PORTION = 500  # as many of them are what it takes to begin


def counted() -> Clocks:
    """Return clocks that count what light meets."""
    calls: Counter[int] = Counter()

    def thread(walkers: render.Walkers) -> float:
        calls[id(walkers)] += PORTION
        return SECOND * float(walkers.counters[:2].sum() + calls[id(walkers)])

    return Clocks(thread, lambda: 0.0, lambda: 0.0)


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans in a second or so, by what light meets and not by the clock: a busy machine makes the same."""
    monkeypatch.setattr(planner, "CLOCKS", counted())
    monkeypatch.setattr(planner, "SECONDS", 1.5)
    monkeypatch.setattr(planner, "LEAST_PILOTS", 1.0)


def pile(ball: tsdf.Table, distance: float, fraction: float = 0.6, level: str = "auto") -> Scene:
    """A flat pile of spheres, its camera so far away."""
    camera = Camera((0.0, -0.8 * distance, 0.6 * distance), (0.0, 0.0, 0.0), 24, 18, fov_deg=30.0)
    medium = MediumSpec(Box((-12.0, -12.0, -10.0), (12.0, 12.0, 0.0)), fraction, 1.0, (GrainSpec(ball),),
                        packing_spheres=FEW)  # fmt: skip
    return Scene(camera, LIGHTS, (medium,), render=Render(level), name="pile")


def of(made: Plan, level: str, k: int = 0) -> Prediction:
    return next(p for p in made.predictions if p.candidate == Candidate(level, k))


@pytest.fixture(scope="module")
def far(ball: tsdf.Table) -> Plan:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "SECONDS", 3.0)
        patch.setattr(planner, "CLOCKS", counted())
        return plan(pile(ball, 160.0), 0.05, threads=2)


@pytest.mark.slow
def test_a_dense_slab_seen_from_afar(far: Plan) -> None:
    """Spheres packed at 0.6 are too bright at teleport, and a plan knows; not so at teleport-memory. Explicit is right
    by definition. What is taken meets the target, and there are three lines that say so."""
    assert of(far, "explicit").floor == CERTAIN and of(far, "explicit").piloted
    assert of(far, "teleport").bias > 2.0 * of(far, "teleport").bias_error > 0.0
    assert of(far, "teleport").floor.value > of(far, "teleport-memory").floor.value
    assert far.chosen.floor.high < far.target and len(far.why) == 3
    assert far.chosen.seconds(far.target) <= of(far, "explicit").seconds(far.target)
    assert str(far.chosen.candidate) in far.why[0] and "R" in far.why[1] and far.why[2].startswith("runner-up")
    assert far.spent > 0.0 and not far.fewer_far
    told = report.facts(far)
    assert told["chosen"]["level"] == far.chosen.candidate.level and len(told["candidates"]) == len(far.predictions)
    lines = (*far.why, *far.notes, *far.needs)
    assert max(map(len, lines)) < 300 and not any("\n" in line for line in lines)


@pytest.mark.slow
def test_close_grains_are_met_one_by_one(ball: tsdf.Table) -> None:
    """Where a pixel covers a fifth of a grain no chain alone will do: explicit grains come first, or there are no
    others."""
    made = plan(pile(ball, 9.0), 0.05, threads=2)
    one = made.chosen.candidate
    assert one.explicit_grains > 0 or one.level in ("explicit", "teleport-packed")
    assert of(made, "teleport-memory").floor.value > 0.05
    assert of(made, "teleport-memory", 16).floor.value < 0.5 * of(made, "teleport-memory").floor.value


@pytest.mark.slow
def test_what_is_measured_wins(ball: tsdf.Table) -> None:
    """The truth itself, taken for another level, is found without error; a level with light of its own is found out."""
    scene = pile(ball, 160.0)
    made = world.build(scene, "volume")
    one, same = Pilot(made, 1, 2, 64), Pilot(made, 1, 2, 64)
    bright = Pilot(world.build(replace(scene, lights=(ConstantLight((1.0, 1.0, 1.0)),)), "volume"), 1, 2, 64)
    for pilot in (one, same, bright):
        pilot.run(0.3)
    apart = same.apart(one)
    assert abs(apart.bias) < 5.0 * apart.bias_error + 1e-3 and abs(apart.square) < 5.0 * apart.square_error + 1e-6
    apart = bright.apart(one)
    assert apart.square > 5.0 * apart.square_error
    seen, picture = one.seen, render.render(made, spp=256, seed=2, threads=2)
    spp_error = math.sqrt(seen.variance / 256)
    assert picture.relative_error == pytest.approx(spp_error, rel=0.25)
    assert picture.rgb.mean() == pytest.approx(seen.mean, rel=0.1)


@pytest.mark.slow
def test_other_wishes_other_choices(far: Plan, ball: tsdf.Table) -> None:
    """What is found is sorted by time to the target; a level of too much bias is never sure to meet it; with a time
    that is too short the least error is taken."""
    times = [p.safe_seconds(far.target) for p in far.predictions[1:]]
    assert times == sorted(times)
    biased = replace(of(far, "teleport"), floor=Belief(0.2, 0.01))
    assert math.isinf(biased.seconds(0.05)) and biased.error(1e9) == pytest.approx(0.2)
    p = of(far, "explicit")
    assert p.noise(4.0) == pytest.approx(0.5 * p.noise(1.0)) and p.error(p.seconds(0.03)) == pytest.approx(0.03)
    hurried = plan(pile(ball, 160.0), 0.002, seconds=0.5, threads=2)
    assert "no other that was looked at is likely to have a tenth less" in hurried.why[0]
    looked = [p for p in hurried.predictions if p.piloted]
    errors = [math.hypot(p.floor.value, p.floor.error, p.noise(0.5 / hurried.load)) for p in looked]
    assert errors[0] <= TIE * min(errors)


@pytest.mark.slow
def test_only_the_camera_matters_to_scenes_without_grains() -> None:
    floor = SurfaceSpec(Rectangle((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0)), (0.5, 0.5, 0.5))
    scene = Scene(Camera((0.0, -9.0, 9.0), (0.0, 0.0, 0.0), 8, 6), LIGHTS, (), (floor,))
    made = plan(scene, 0.05, threads=1)
    assert made.chosen.floor == CERTAIN and "no grains" in made.why[1]


SUN = SunLight((0.6, 0.0, 0.8), (3.0, 3.0, 3.0), 0.53)


@pytest.mark.slow
@pytest.mark.parametrize("sky", [0.1, 0.0])
def test_a_small_sun_is_left_to_levels_that_aim_at_it(ball: tsdf.Table, sky: float) -> None:
    """Single grains meet it once in 200,000 times; until then explicit is dark, or black, with no noise at all, and
    would be taken. So pilots look at a wider sun, what other levels miss is known, and so is about how much longer
    explicit takes, hours where there are seconds; and the picture is as bright as an explicit one under a sun as
    strong but wide."""
    lights = (SUN, ConstantLight((sky,) * 3)) if sky else (SUN,)
    scene = replace(pile(ball, 9.0), lights=lights)
    made = plan(scene, 0.05, seconds=4.5, threads=2)
    one = made.chosen.candidate
    assert not one.explicit_grains and not LEVELS[one.level].traits.packed
    assert any("pilots look at suns" in note for note in made.notes)
    assert 100.0 * made.chosen.variance < of(made, "explicit").variance < math.inf
    assert made.chosen.piloted and 0.1 < made.chosen.texture < 1.5 and made.chosen.floor.error < made.chosen.texture
    assert f"{made.chosen.candidate}" in made.why[0] and json.dumps(report.facts(made), allow_nan=False)
    assert report.table(made)[1].startswith(str(one)) and made.scene.lights == lights
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        patch.setattr(shot, "plan", lambda *_, **__: made)
        found = tsdf.render(scene, target_error=0.1, threads=2)
        wide = replace(scene, lights=(replace(SUN, angular_diameter_deg=15.0), *lights[1:]))
        truth = tsdf.render(wide, "explicit", spp=1500, threads=2)
    assert found.rgb.mean() == pytest.approx(truth.rgb.mean(), rel=0.15)  # the level's bias and truth's noise of 3 %


@pytest.mark.slow
def test_what_single_grains_take_under_a_small_sun(ball: tsdf.Table) -> None:
    """Is about what a picture at level explicit has, under a sun that this meets often enough to tell: 4 degrees, a
    small part of what pilots look at. It is an upper bound, for not all of the variance is the sun's."""
    scene = replace(pile(ball, 9.0), lights=(replace(SUN, angular_diameter_deg=4.0),))
    said = of(plan(scene, 0.2, threads=2), "explicit")
    picture = render.render(world.build(scene, "explicit"), spp=2000, seed=3, threads=2)
    found = 2000 * float(picture.variance.mean()) / float(picture.rgb.mean()) ** 2
    assert 0.7 < said.variance / found < 2.0


@pytest.mark.slow
def test_light_that_goes_straight_on_finds_suns_by_chance() -> None:
    """Cubes let much of the light through parallel facets exactly straight on, along which no level aims: its variance
    grows as a sun shrinks, but for levels that know no such light. What is said of a sun of 4 degrees, by pilots of
    a wider one, is about what a pilot of it sees; that of the lobe stays."""
    table = tsdf.read(library.ready("salt"))
    scene = replace(pile(table, 60.0), lights=(replace(SUN, angular_diameter_deg=4.0), ConstantLight((0.3,) * 3)))
    made = plan(scene, 0.2, threads=2)
    for level, grows in (("volume", True), ("volume-hg", False)):
        pilot = Pilot(world.build(scene, level), 7, 2, 400)
        pilot.run(1.0)
        wide = Pilot(
            world.build(replace(scene, lights=(replace(SUN, angular_diameter_deg=16.0), scene.lights[1])), level), 7
        )
        wide.run(0.2)
        assert (pilot.seen.variance > 3.0 * wide.seen.variance) == grows
        assert of(made, level).variance == pytest.approx(pilot.seen.variance, rel=0.6)


@pytest.mark.slow
def test_where_there_is_nothing_to_see(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Black scenes are planned, and nothing is said to be known of their noise; so are scenes without grains. Those
    without light are refused, and so are cameras that see nothing, as tsdf-render does, in the same words."""
    monkeypatch.setattr(planner, "SECONDS", 0.3)
    monkeypatch.setattr(planner, "LEAST_PILOTS", 0.2)
    with pytest.raises(SceneError, match="a scene without light"):
        plan(replace(pile(ball, 160.0), lights=()), 0.05)
    away = replace(pile(ball, 160.0).camera, target=(0.0, -999.0, 999.0))
    for scene in (replace(pile(ball, 160.0), camera=away), Scene(away, LIGHTS, ())):
        with pytest.raises(SceneError, match="sees neither a medium nor a surface") as planned:
            plan(scene, 0.05, threads=2)
        with pytest.raises(SceneError) as rendered:
            render.render(world.build(scene, "volume"), 1)
        assert str(planned.value) == str(rendered.value)
    shade = SurfaceSpec(Rectangle((0.0, 0.0, 20.0), (99.0, 0.0, 0.0), (0.0, 99.0, 0.0)), (0.0, 0.0, 0.0))
    low = SunLight((0.0, 0.0, 1.0), (3.0, 3.0, 3.0), 0.53)  # behind a black roof
    near = replace(pile(ball, 9.0), lights=(low,), surfaces=(shade,))
    black = plan(near, 0.05, threads=2)
    assert any("no pilot has seen any light" in note for note in black.notes)
    assert "nothing is known of its noise" in black.why[0] and json.dumps(report.facts(black), allow_nan=False)
    floor = SurfaceSpec(Rectangle((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0)), (0.5, 0.5, 0.5))
    for lights in (LIGHTS, (SUN,)):
        assert plan(Scene(pile(ball, 9.0).camera, lights, (), (floor,)), 0.05, threads=1).why[0].startswith("take ")


@pytest.mark.slow
def test_tables_without_records(tmp_path: Path) -> None:
    """Levels that need them are left out, not fatal; what makes them is said."""
    table = tsdf.read(CHECKS / "cube.tsdf.exr")
    assert not table.memory
    made = plan(pile(table, 160.0), 0.1, threads=2)
    assert not any(p.candidate.level in ("teleport-memory", "teleport-packed") for p in made.predictions)
    scene = pile(table, 160.0)
    tsdf.write(table, tmp_path / "cube.exr")
    named = replace(scene.media[0], grains=(GrainSpec(tmp_path / "cube.exr"),))
    (need,) = plan(replace(scene, media=(named,)), 0.1, threads=2).needs
    assert "no records by entry" in need and "--memory 64" in need


@pytest.mark.slow
def test_where_there_is_no_truth(ball: tsdf.Table) -> None:
    """No random packing is as dense as 0.7, so nothing is explicit: another level stands for the truth, that is said,
    and none claims to be without error. Nor is it piloted where a path meets millions of grains."""
    made = plan(pile(ball, 160.0, 0.7), 0.1, threads=2)
    assert any(note.startswith("no level explicit here") for note in made.notes)
    assert {p.candidate.level for p in made.predictions} >= {"teleport", "volume"}
    assert all(p.floor.value > 0.0 and not p.candidate.explicit_grains for p in made.predictions)
    deep = pile(ball, 160.0)
    box = Box((-1e5, -1e5, -1e5), (1e5, 1e5, 0.0))
    deep = replace(deep, media=(replace(deep.media[0], shape=box),))
    made = plan(deep, 0.1, threads=2)
    assert any("cannot be piloted" in note for note in made.notes) and not of(made, "explicit").piloted
    assert made.chosen.candidate.level != "explicit" and made.chosen.floor.high < 0.1


@pytest.mark.parametrize("target", [0.0, -0.1, 1.0, math.nan, math.inf])
def test_bad_targets(ball: tsdf.Table, target: float) -> None:
    with pytest.raises(UsageError, match="target is an error of pixels") as refused:
        plan(pile(ball, 160.0), target)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_auto_in_python(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene that names no level is planned, one that does is not; a stop that is given is obeyed; what is chosen is
    rendered to the last bit as if it had been named."""
    scene = pile(ball, 160.0)
    choice = shot.chosen(scene, spp=3, threads=2)
    assert choice.plan is not None and (choice.spp, choice.target_error) == (3, None)
    found = choice.scene.render
    monkeypatch.setattr(shot, "plan", lambda *_, **__: choice.plan)
    assert choice.world().place is choice.plan.places[True]  # made once, for all pilots and the picture
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        one = tsdf.render(scene, spp=3, threads=1)
        named = replace(scene, render=replace(found))
        other = tsdf.render(named, spp=3, threads=2)
    np.testing.assert_array_equal(one.rgb, other.rgb)
    monkeypatch.setattr(shot, "plan", lambda *_, **__: pytest.fail("a plan is made"))
    assert shot.chosen(scene, "volume").spp == shot.SPP
    assert shot.chosen(replace(scene, render=Render("volume", 5)), target_error=0.1)[1:4] == (None, None, 0.1)


@pytest.mark.slow
def test_without_a_stop_it_is_done_at_the_target(far: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise is what the target leaves beside bias and texture."""
    monkeypatch.setattr(shot, "plan", lambda *_, **__: far)
    choice = shot.chosen(far.scene)
    assert (choice.spp, choice.seconds) == (None, None) and choice.target_error is not None
    assert math.hypot(choice.target_error, far.chosen.floor.value) == pytest.approx(far.target)


@pytest.mark.slow
def test_nobody_waits_for_days(far: Plan, ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the target takes longer than a patient user waits, the least error in that time is taken, and it ends then;
    who asks for an error gets it, however long it takes; with samples per pixel their error is said."""
    monkeypatch.setattr(planner, "SECONDS", 1.0)
    monkeypatch.setattr(planner, "PATIENCE", 0.5)
    scene = replace(far.scene, render=Render("auto"))
    monkeypatch.setattr(shot, "TARGET", 0.002)
    choice = shot.chosen(scene, threads=2)
    assert choice.plan is not None
    assert (choice.spp, choice.seconds, choice.target_error) == (None, 0.5, choice.plan.noise)
    chosen = choice.plan.chosen
    chosen = replace(chosen, floor=chosen.floor._replace(value=0.5))
    hopeless = replace(choice.plan, predictions=(chosen, *choice.plan.predictions[1:]))
    assert hopeless.noise == 0.5 * 0.002  # beside what is missed, less noise would not show
    assert "after 0.5 s (none is sure to meet 0.2 %" in choice.plan.why[0]
    asked = shot.chosen(scene, target_error=0.002, threads=2)
    assert asked.seconds is None and asked.target_error == 0.002
    assert asked.plan is not None and asked.plan.seconds is None
    counted = shot.chosen(scene, spp=4, threads=2)
    assert counted.plan is not None
    p = counted.plan.chosen
    error = report.percent(math.hypot(p.floor.value, 0.5 * math.sqrt(p.variance)))
    assert f"an error of {error} with 4 samples per pixel" in counted.plan.why[0]


def test_pilots_render_what_is_taken(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where grains look larger in some pixels than in most, explicit ones are fewer elsewhere: so they are in pilots
    by which a plan is made. What is left of texture is that of the largest, from when k is enough for them; and that is
    not more than there is without explicit grains."""
    slanted = replace(pile(ball, 9.0), camera=Camera((0.0, -11.0, 2.0), (0.0, 12.0, 0.0), 24, 18, fov_deg=60.0))
    monkeypatch.setattr(planner, "FEWER", 1.1)
    seen: dict[bool, list[int]] = {True: [], False: []}
    for far in (True, False):
        run = planner._Planning(slanted if far else pile(ball, 160.0), 0.05, None, 0, 2)
        run.look()
        run.refer()
        assert run.far == far
        for k in (0, 8):
            assert run.add(Candidate("teleport-memory", k))
            seen[far].append(int(run.pilots[Candidate("teleport-memory", k)].world.met.sum()))
        whole, one = Belief(0.4, 0.05), run.expected["teleport-memory"]
        assert run.faded(one, 0.0, 0.0, whole, 0, 1)[2].value <= 0.4 * (1.0 if far else 0.8)
        left = run.faded(one, 0.0, 0.0, whole, 0, 8)[2].value / run.faded(one, 0.0, 0.0, whole, 8, 16)[2].value
        assert left == pytest.approx(run.ratio if far else 1.0)
    assert seen[True][0] == 0 < seen[True][1] and seen[False] == [0, 0]


def test_what_levels_miss_alike_is_by_the_best_measured(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three pilots of one texture the sharpest speaks for the others, not the one that came out least; what is
    believed of these is no sharper than that, for it is against the same samples."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    squares = {"volume": (0.010, 0.004), "teleport": (0.011, 0.0005), "teleport-memory": (0.002, 0.004)}
    for level in squares:
        assert run.add(Candidate(level))
    apart = {Candidate(level): Apart(0.0, 0.001, *square, own=square[1]) for level, square in squares.items()}
    monkeypatch.setattr(planner._Planning, "apart", lambda _, candidate: apart.get(candidate))
    best = run.without(Candidate("teleport"), run.expected["teleport"])[2]
    for level in ("volume", "teleport-memory"):
        missed = run.missed(Candidate(level))
        assert missed is not None and missed.value == pytest.approx(math.sqrt(0.011), rel=0.02)
        floor = run.without(Candidate(level), run.expected[level]._replace(bias=0.0))[2]
        assert floor.value == pytest.approx(math.sqrt(0.011), rel=evidence.ALIKE) and floor.error >= 0.99 * best.error
    assert run.missed(Candidate("teleport")) is None
    other = apart[Candidate("volume")] = Apart(0.0, 0.001, 0.04, 0.004, own=0.004)  # by more than noise
    floor = run.without(Candidate("volume"), run.expected["volume"]._replace(bias=0.0))[2]
    assert floor.value == pytest.approx(math.sqrt(other.square), rel=0.02)


def test_noise_is_over_the_true_mean(ball: tsdf.Table) -> None:
    """A candidate twice as bright as the reference has four times the variance over the mean of that."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    one = Candidate("volume")
    assert run.reference is not None and run.add(one)
    run.round(0.4, [one])
    before, own = run.predicted(one).variance, run.pilots[one].seen
    assert before == pytest.approx(own.variance * (own.mean / run.pilots[run.reference].seen.mean) ** 2)
    run.pilots[one].sums *= 2.0
    run.pilots[one].squares *= 4.0
    assert run.pilots[one].seen.variance == pytest.approx(own.variance)
    assert run.predicted(one).variance == pytest.approx(4.0 * before)


def test_bias_falls_with_the_grains_that_are_left_to_a_level(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a bias that all packings share as much is left as there is light that meets more grains yet, in a deep
    medium it stays; what one packing differs by falls as its texture does. A pilot with some has the last word."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    one, whole = run.expected["teleport"], Belief(0.1, 0.0)
    monkeypatch.setattr(planner._Planning, "length", 8.0)
    monkeypatch.setattr(planner._Planning, "of_one_packing", lambda *_: 0.0)
    assert run.faded(one, 0.02, 0.0, whole, 0, 8)[0] == pytest.approx(0.02 * (7.0 / 8.0) ** 8)
    monkeypatch.setattr(planner._Planning, "length", 800.0)
    assert run.faded(one, 0.02, 0.0, whole, 0, 8)[0] == pytest.approx(0.02, rel=0.02)
    monkeypatch.setattr(planner._Planning, "of_one_packing", lambda *_: 1e3)
    assert run.faded(one, 0.02, 0.0, whole, 0, 8)[0] == pytest.approx(0.02 * math.exp(-2.0), rel=0.01)
    apart = {
        Candidate("teleport"): Apart(0.02, 1e-4, 4e-4, 1e-6),
        Candidate("teleport", 8): Apart(0.003, 1e-4, 9e-6, 1e-6),
    }
    monkeypatch.setattr(planner._Planning, "apart", lambda _, candidate: apart.get(candidate))
    assert run.predicted(Candidate("teleport", 8)).bias == pytest.approx(0.003, rel=0.1)
    assert abs(run.predicted(Candidate("teleport", 16)).bias) < 0.0031


@pytest.mark.slow
def test_bolder_leaps_are_looked_at_where_they_may_win(far: Plan, ball: tsdf.Table) -> None:
    """At the level whose events are dear, where there are leaps, nobody has named any, and the error would still do;
    what is taken is rendered so, and the options that name it say so."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    chosen = replace(of(far, "teleport-memory"), floor=Belief(0.02, 0.005))
    run.pilots[chosen.candidate] = SimpleNamespace(world=SimpleNamespace(leap=2.0))
    bold = run.bolder_of(chosen)
    assert bold == Candidate("teleport-memory", 0, evidence.BOLD) and str(bold) == "teleport-memory leap=1"
    assert run.bolder_of(replace(chosen, floor=Belief(0.0497, 0.0))) is None
    run.pilots[Candidate("volume")] = run.pilots[chosen.candidate]
    assert run.bolder_of(replace(chosen, candidate=Candidate("volume"))) is None
    run.pilots[chosen.candidate] = SimpleNamespace(world=SimpleNamespace(leap=0.0))
    assert run.bolder_of(chosen) is None
    made = replace(far, predictions=(replace(chosen, candidate=bold), *far.predictions))
    assert made.planned.render.leap == 1.0 and report.options(made) == "--level teleport-memory --leap 1"
    assert report.chosen_facts(made)["leap"] == 1.0
    run.reference = chosen.candidate
    bias_error, floor = run.bolder(bold, 0.001, chosen.floor)
    assert bias_error > evidence.BOLD_BIAS and floor.value > chosen.floor.value and floor.error >= chosen.floor.error


def test_flat_facets_sparkle_under_small_suns(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """The square of what cubes miss under a sun of 8 degrees is what pilots of a wider one see times how much more of
    the sky that takes, in the mean over pictures; said is what half of them have. A sphere's stays. (A picture of cubes
    in the sun of bench_plan says so, too.)"""
    for table, flat in ((ball, False), (tsdf.read(library.ready("salt")), True)):
        scene = replace(pile(table, 120.0), lights=(replace(SUN, angular_diameter_deg=8.0),))
        run = planner._Planning(scene, 0.1, None, 0, 2)
        run.look()
        run.refer()
        more = (run.wide / 8.0) ** 2 if flat else 1.0
        assert run.sparkle == pytest.approx(more, rel=0.05) and (more > 3.0) == flat
        assert run.add(Candidate("volume"))
        for pilot in run.pilots.values():
            pilot.counts[:] = 1
        monkeypatch.setattr(planner._Planning, "trusted", lambda *_: True)
        fourth = 0.1 * run.pixels
        monkeypatch.setattr(Pilot, "apart", lambda *_, fourth=fourth, **__: Apart(0.01, 0.001, 0.2, 0.1, fourth=fourth))
        seen = run.apart(Candidate("volume"))
        assert seen is not None and seen.bias == 0.01
        luck = math.sqrt(0.1 * more**3 * (1.0 - 1.0 / more))  # of a facet that is seen or not, by one in `more`
        error = math.hypot(0.1 * more, evidence.BOUND * (more - 1.0) * 0.2, luck)  # of what is an upper bound, too
        half = 0.2 * more / math.hypot(1.0, luck / (0.2 * more))  # of pictures have less: few have most of the mean
        assert (seen.square, seen.square_error) == pytest.approx((half, error), rel=0.05)
        assert seen.scale == pytest.approx(half / 0.2, rel=0.05)


def test_what_chains_miss_after_explicit_grains_is_alike(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pilot of one chain with three explicit grains first tells of others with three, less surely; not of none."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    before = [run.predicted(Candidate("teleport-memory", k)).floor for k in (0, 3)]
    one = Candidate("teleport", 3)
    assert run.add(one)
    monkeypatch.setattr(planner._Planning, "apart", lambda _, c: Apart(0.0, 1e-4, 1e-2, 1e-4) if c == one else None)
    own, other = run.predicted(one).floor, run.predicted(Candidate("teleport-memory", 3)).floor
    assert own.value == pytest.approx(0.1, rel=0.1) and other.value == pytest.approx(0.1, rel=0.3)
    assert before[1].value < 0.3 * other.value and other.error > own.error
    assert run.predicted(Candidate("teleport-memory")).floor == before[0]
    run.expected["teleport-memory"] = run.expected["teleport-memory"]._replace(bias=0.3)  # of a sign that nobody knows
    monkeypatch.setattr(planner._Planning, "length", 50.0)
    biased = run.predicted(Candidate("teleport-memory", 3))
    assert biased.bias == 0.0 and biased.bias_error > 0.03 and biased.floor.value > 0.8 * biased.bias_error


def test_plans_by_counts_can_be_made_again(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time that is counted in what light meets makes the same plan to the last bit, whatever else the machine does."""
    monkeypatch.setattr(planner, "SECONDS", 0.3)
    monkeypatch.setattr(planner, "LEAST_PILOTS", 0.3)
    first, second = (report.facts(plan(pile(ball, 160.0), 0.05, threads=2)) for _ in range(2))
    assert first == second and first["candidates"][0]["seconds_to_target"] is not None


def test_an_interrupt_leaves_a_plan(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """From when all levels were looked at once; before that nothing is known, and it goes on."""
    stop, shares = Event(), []

    def told(share: float, word: str) -> None:
        shares.append(share)
        if share > 0.0 or len(shares) == 1:  # at once, to no effect, and again
            stop.set()

    monkeypatch.setattr(planner._Planning, "look_wider", lambda run: run.told(run.known, "known") or [])
    monkeypatch.setattr(planner._Planning, "finalists", lambda run: [] if run.stopped() else pytest.fail("it goes on"))
    made = plan(pile(ball, 160.0), 0.05, threads=2, told=told, stop=stop)
    assert any(note.startswith("planning was interrupted") for note in made.notes)
    assert made.chosen.piloted and len(made.why) == 3 and max(shares) == planner.FIRST


def test_suns_that_are_met_too_seldom_are_wider_in_pilots(ball: tsdf.Table) -> None:
    """Whatever their size, where a pilot of the reference has too few samples for it; of samples in plenty a sun of 20
    degrees stays as it is."""
    for budget, wider in ((0.02, True), (50.0, False)):
        scene = replace(pile(ball, 160.0), lights=(replace(SUN, angular_diameter_deg=20.0), LIGHTS[0]))
        run = planner._Planning(scene, 0.05, None, 0, 2)
        run.budget = budget
        run.look()
        (size,) = (light.angular_diameter_deg for light in run.scene.lights if isinstance(light, SunLight))
        assert (size > 20.0) == wider == (run.rarer > 1.0) and size <= planner.WIDEST


def test_suns_are_as_wide_as_what_samples_take_asks(ball: tsdf.Table) -> None:
    """Where a sample of single grains takes longer than was thought, they are widened once more before anything is
    piloted, and all pilots are under the same; where it takes as long, they stay."""
    for thought, again in ((1e-9, True), (1e-3, False)):
        scene = replace(pile(ball, 160.0), lights=(SUN, LIGHTS[0]))
        run = planner._Planning(scene, 0.05, None, 0, 2)
        run.budget, run.clocks = 0.3, counted()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(planner._Planning, "sample", lambda _, thought=thought: thought)
            run.look()
        before = run.wide
        run.refer()
        assert (run.wide > before) == again and before == (planner.WIDE if again else planner.WIDEST)
        assert [*run.pilots] == [run.reference] == [Candidate("explicit")]
        lights = run.pilots[Candidate("explicit")].world.scene.lights
        (size,) = (light.angular_diameter_deg for light in lights if isinstance(light, SunLight))
        assert size == run.wide and run.rarer == pytest.approx((size / 0.53) ** 2, rel=0.1)


def test_geometry_is_made_once(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where grains lie wholly inside, it is the same with single grains and without; where only centres, it is not."""
    for inside, times in (("grains", 1), ("centres", 2)):
        made: list[bool] = []
        scene = pile(ball, 160.0)
        scene = replace(scene, media=(replace(scene.media[0], inside=inside),))

        def counted(scene: Scene, grains: bool = False, made: list[bool] = made) -> geometry.Place:
            made.append(grains)
            return geometry.place(scene, grains)

        monkeypatch.setattr(planner, "place", counted)
        monkeypatch.setattr(world, "place", counted)
        run = planner._Planning(scene, 0.05, None, 0, 2)
        run.look()
        run.refer()
        assert run.add(Candidate("volume")) and len(made) == times


def test_few_pixels_do_not_tell_of_glints(ball: tsdf.Table) -> None:
    """A pilot that looks wider has all pixels of a small picture, each once, and what it saw before; what is known of
    other levels then is known in as many. One glint among a thousand pixels is not in the first fifty."""
    scene = replace(pile(ball, 160.0), camera=replace(pile(ball, 160.0).camera, width=40, height=25))
    run = planner._Planning(scene, 0.05, None, 0, 2)
    run.look()
    run.reference, run.looked_at = Candidate("explicit"), 50
    for level in ("explicit", "volume", "teleport"):
        assert run.add(Candidate(level))
    for pilot in run.pilots.values():
        pilot.counts[:], pilot.sums[:], pilot.squares[:] = 100, 100.0, 101.0
    before = [run.pilots[c].pixels.copy() for c in run.pilots]
    for level in ("explicit", "volume"):
        pilot = run.pilots[Candidate(level)]
        pilot.look_wider(1000)
        pilot._take(1)
        assert np.array_equal(np.sort(pilot.pixels), np.arange(1000)) and pilot.active == len(before[0])
        assert np.array_equal(pilot.pixels[: pilot.active], before[0])
        assert (pilot.counts[pilot.active :] == 2).all() and pilot.seen.samples == 2 * int(pilot.counts.sum())
        pilot.counts[:], pilot.sums[:], pilot.squares[:] = 100, 100.0, 101.0
    run.pilots[Candidate("explicit")].sums[:, 500] = 3100.0  # 30 times as bright as all others
    seen = run.apart(Candidate("teleport"))
    assert run.best_known() == Candidate("volume") and seen is not None
    assert seen.square == pytest.approx(0.9, rel=0.1) and seen.square_error < 0.01 and seen.few > 0.99
    larger = replace(scene, camera=replace(scene.camera, width=4000))  # of which they are one pixel in a hundred
    for pilot in run.pilots.values():
        pilot.world.scene = larger
    seen = run.apart(Candidate("teleport"))
    assert seen is not None and seen.square_error > seen.square
    assert run.pilots[Candidate("teleport")].apart(run.pilots[Candidate("explicit")]).square < 1e-3


def test_glints_get_rarer_not_weaker(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of light that is spread over all pixels what is left after k grains is missed in each; of light in a few of them
    it is missed in as much fewer, and texture falls as the root; besides, it shows less and less. What pilots with
    three grains saw counts beyond them, and of what they saw nothing certain of the law does."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    assert run.add(Candidate("volume"))
    monkeypatch.setattr(planner._Planning, "length", 1.25)
    whole, one = Belief(0.4, 0.0), run.expected["volume"]._replace(bias=0.0)
    monkeypatch.setattr(planner._Planning, "of_one_packing", lambda *_: 1.0)
    left = {}
    for few, square_error in ((0.1, 1e-4), (1.0, 1e-4)):
        seen = {Candidate("volume"): Apart(0.0, 1e-4, 0.16, square_error, 1e-4, few)}
        monkeypatch.setattr(planner._Planning, "apart", lambda _, c, seen=seen: seen.get(c))
        left[few] = run.faded(one, 0.0, 0.0, whole, 0, 2)[2].value / 0.4
        assert run.fading is None
    less = math.exp(-2.0 / 4.0)  # and what is left shows as much less, spheres' by e for four grains
    assert left[0.1] == pytest.approx(0.04 * less, rel=0.01) and left[1.0] == pytest.approx(0.2 * less, rel=0.01)
    three = Candidate("teleport-memory", 3)
    assert run.add(three)
    for square, rate in ((0.16 * math.exp(-2.4), 0.4), (1e-9, None)):
        seen = {Candidate("volume"): Apart(0.0, 1e-4, 0.16, 1e-6), three: Apart(0.0, 1e-5, square, 1e-5)}
        monkeypatch.setattr(planner._Planning, "apart", lambda _, c, seen=seen: seen.get(c))
        assert run.fading == (rate and pytest.approx(rate, rel=0.05))
    seen[three] = Apart(0.0, 1e-5, 0.16 * math.exp(-2.4), 1e-6)
    assert run.faded(one, 0.0, 0.0, whole, 3, 8)[2].value == pytest.approx(0.4 * math.exp(-2.0), rel=0.1)


def test_glints_that_few_pixels_cannot_have_met(ball: tsdf.Table) -> None:
    """A sun of 16 degrees is mirrored by one facet in two hundred: sixty pixels may all have missed it, two thousand
    have not; nor have sixty under a sun of 50 degrees, and spheres show it in every pixel."""
    for table, degrees, pixels, known in (
        (tsdf.read(library.ready("salt")), 16.0, 60, False),
        (tsdf.read(library.ready("salt")), 16.0, 2000, True),
        (tsdf.read(library.ready("salt")), 50.0, 200, True),
        (ball, 16.0, 60, True),
    ):
        camera = replace(pile(ball, 12.0).camera, width=60, height=45)
        scene = replace(pile(table, 12.0), lights=(replace(SUN, angular_diameter_deg=degrees), LIGHTS[0]))
        run = planner._Planning(replace(scene, camera=camera), 0.1, None, 0, 2)
        run.budget, run.looked_at = 50.0, pixels
        run.look()
        run.reference = Candidate("explicit")
        assert run.add(run.reference)
        pilot = run.pilots[run.reference]
        pilot.counts[:], pilot.sums[:] = 1, 1.0
        assert (run.unseen() < 0.02) == known, run.unseen()


def test_errors_of_hundreds_of_per_cent_are_explained(far: Plan) -> None:
    """Where glints make the error of a pixel, that of the mean of many is said: bias stays, noise falls as the root of
    their number, and so does what is missed as far as pixels do not show the same grain."""
    p = replace(far.chosen, bias=0.02, texture=1.5, floor=Belief(1.5, 0.1), variance=1.0, turn=1.0)
    assert p.error_of_blocks(16.0, 1.0) == pytest.approx(math.sqrt(0.02**2 + (1.5 / 16) ** 2 + (0.25 / 16) ** 2))
    assert p.error_of_blocks(16.0, 100.0) == pytest.approx(math.hypot(0.02, 1.5, 0.25 / 16))
    made = replace(far, predictions=(p, *far.predictions[1:]), seconds=16.0)
    assert "means of 16 by 16 pixels are off by" in report._first(made)
    assert "16 by 16" not in report._first(far)
    noisy = replace(made, predictions=(replace(p, variance=16.0), *far.predictions[1:]), glints=300.0)
    assert "mostly noise until 5 min" in report._first(noisy)


def candidate(level: str, variance: float, floor: float = 0.0, error: float = 0.0, turn: float = 1.0) -> Prediction:
    return Prediction(
        Candidate(level), 0.0, 0.0, floor, error, Belief(floor, error), variance, turn, piloted=True, known=True
    )


def test_how_wide_a_sun_has_to_be(far: Plan) -> None:
    """Where single grains are left out under a small sun, a note says how wide it has to be for them to have the target
    in the time: the variance falls as the sun grows, from that under the real one to what pilots have seen of it; or,
    where that is not enough, what they have under the widest that these looked at. Nothing is said where even that is
    mostly noise, or where nothing is missed."""
    miss = candidate("volume-hg", 1.0, 1.1, 0.1)
    for variance, words in (
        (25.6, "angular_diameter_deg = 4, as bright, explicit would show them, with an error of about 20 % after 10 s"),
        (1638.4, "angular_diameter_deg = 16, as bright, explicit would show them, with an error of about 40 % after"),
        (6553.6, None),
    ):
        found = (miss, candidate("explicit", variance))
        made = replace(far, predictions=found, target=0.2, seconds=10.0, suns=(0.5, 16.0), rarer=1024.0)
        told = report.wider_sun(made)
        assert (told is None) == (words is None) and (words or "") in (told or ""), told
    made = replace(made, predictions=(miss, candidate("explicit", 25.6)))
    assert report.wider_sun(made) and report.wider_sun(replace(made, rarer=1.0)) is None
    assert report.wider_sun(replace(made, predictions=(replace(miss, floor=Belief(0.1, 0.1)), *found[1:]))) is None


def test_what_decides_is_asked(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """A level that is within its error bar of the target and takes a second where what is sure takes three minutes is
    piloted on, for a tenth of these; not where it is told, or saves less than a fifth, nor beyond the share of a time
    that was named, nor once planning is interrupted, nor where more samples tell no more."""

    def asked(level: Prediction, seconds: float | None = None) -> tuple[Candidate, float] | None:
        run = planner._Planning(pile(ball, 160.0), 0.02, seconds, 0, 1)
        run.spent, run.known = run.ends, 1.0
        found = [candidate("explicit", 0.02**2 * 180.0), level]
        monkeypatch.setattr(planner._Planning, "predictions", lambda _: found)
        first = run.question()
        run.answered = {level.candidate}
        assert run.question() is None
        run.answered = set()
        run.stop.set()
        assert run.question() is None
        return first

    open_one = candidate("volume", 0.02**2, 0.039, 0.016)
    which = asked(open_one)
    assert which is not None and which[0] == open_one.candidate
    assert which[1] == pytest.approx(0.1 * 180.0 - planner.planning_seconds(None))
    assert asked(open_one, 300.0) is None
    for told in (Belief(0.039, 0.002), Belief(0.01, 0.002)):
        assert asked(replace(open_one, floor=told)) is None
    assert asked(replace(open_one, variance=0.02**2 * 170.0)) is None


def test_asking_on_takes_as_many_samples_of_both(ball: tsdf.Table) -> None:
    """What is asked about and what it is held against have half as many samples again as the one that had more, and as
    many; in a short time only what has fewer gets some. A pilot that cannot be made is not asked about again."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    volume = Candidate("volume")
    assert run.reference is not None and run.add(volume)
    run.round(0.1, [volume], 0.8)
    own, best = run.pilots[volume], run.pilots[run.reference]
    before, spent = (own.done, best.done), run.spent
    run.go_on(volume, 100.0)
    assert min(own.done, best.done) >= 1.5 * max(before) and run.spent > spent
    while own.done >= best.done:
        run.round(0.1, [volume], 1.0)
    before = best.done
    run.go_on(volume, 1e-6)
    assert best.done == before
    run.impossible["teleport"] = SceneError("no")
    run.go_on(Candidate("teleport"), 1.0)
    assert Candidate("teleport") in run.refused and Candidate("teleport") not in run.pilots


def test_what_may_be_a_little_above_its_target_is_said(far: Plan) -> None:
    """A level that is likelier than not to meet the target and is a sixth above it if it misses as much as it may is
    taken in a second, where what is sure takes three minutes; how much that may be is said, and what is surer. It is
    rendered until the whole of it is the target, or for longer where it would be above it by more than a fifth then."""
    sure, near = candidate("explicit", 0.02**2 * 180.0), candidate("volume", 0.0144**2, 0.0138, 0.0066)
    for target, taken_ in ((0.02, near), (0.0138, sure)):
        found = (taken_, near if taken_ is sure else sure)
        made = replace(far, predictions=found, target=target, seconds=None)
        assert choose([sure, near], Wish(target, 600.0))[0] == taken_
        quick = replace(sure, variance=0.02**2 * 6.0)  # what is sure takes seconds as well
        assert choose([quick, near], Wish(target, 600.0))[0] == quick
        assert ("; up to 2.4 % as far as is known" in report._first(made)) == (taken_ is near)
        assert ("explicit, 3 min, which is surer" in report._other(made)) == (taken_ is near)
    for floor, safe in ((Belief(0.0138, 0.0042), False), (Belief(0.01, 0.012), True)):
        one = replace(near, floor=floor)
        made = replace(far, predictions=(one, sure), target=0.02, seconds=None)
        assert (math.hypot(made.noise, floor.value) < 0.0199) == safe
        assert math.hypot(made.noise, floor.high) <= 1.2 * 0.02 + 1e-9
        assert one.done(0.02) == pytest.approx((0.0144 / made.noise) ** 2)
    assert not replace(near, floor=Belief(0.0138, 0.011)).reaches(0.02)


def test_why_not_another(far: Plan) -> None:
    """Beside the chosen stands what is faster and misses more; of what is likely better but was not looked at, that."""
    chosen, worse = candidate("teleport-memory", 0.04, 0.02), candidate("volume", 0.01, 0.05)
    unseen = replace(candidate("isotropic", 0.02, 0.01), piloted=False)

    def why(*found: Prediction) -> str:
        made = replace(far, predictions=(chosen, *found), target=0.05, seconds=None)
        return report._reason(made, [Body(0.5, 6.0, 0.8, 1.0, 40.0)], 1.0, 1.0, "explicit")

    assert (
        "volume has a bias" in why(worse) and "faster to the same noise" in why(worse) and "seen it" not in why(worse)
    )
    assert "isotropic may be faster and miss less, but no pilot has seen it" in why(worse, unseen)
    assert "nothing takes less" in why(candidate("explicit", 0.5))


def test_all_times_are_of_one_kind(far: Plan) -> None:
    """What three lines and the table say takes as long by the clock, on processors three times as busy as free ones."""
    found = tuple(candidate(level, 0.04) for level in ("explicit", "teleport-memory"))
    for load, said in ((1.0, "16 s"), (3.0, "48 s")):
        made = replace(far, predictions=found, target=0.05, seconds=None, load=load)
        assert f"after about {said}" in report._first(made) and f"teleport-memory, {said}" in report._other(made)
        assert f"  {said}  " in report.table(made)[1]
        hurried = replace(made, seconds=3.0)
        assert f"would take explicit and {said} instead of 3 s" in report._other(hurried)


def test_few_samples_are_not_spent_on_glints(ball: tsdf.Table) -> None:
    """Of so many samples a level is chosen whose noise with them is about the least, and of these one that misses less
    than the target; where nobody knows glints from noise, not level explicit, though it alone misses nothing."""
    run = planner._Planning(pile(ball, 160.0), 0.02, None, 0, 1)
    run.spp = 8

    def one(level: str, variance: float, floor: float, turn: float) -> Prediction:
        return Prediction(
            Candidate(level), 0.0, 0.0, floor, 0.0, Belief(floor, 0.1 * floor) if floor else CERTAIN, variance, turn,
            piloted=True, known=True,
        )  # fmt: skip

    glinting = [one("explicit", 7500.0, 0.0, 1.0), one("teleport", 0.16, 1.3, 0.5), one("volume", 0.16, 1.35, 0.3)]
    run.rarer = 100.0
    assert run.choose(glinting).candidate.level == "teleport"
    run.rarer = 1.0
    plain = [one("explicit", 0.16, 0.0, 1.0), one("teleport", 0.16, 0.01, 0.5), one("volume", 0.16, 0.05, 0.3)]
    assert run.choose(plain).candidate.level == "teleport"
    run.spp = 4096
    assert run.choose(plain).candidate.level == "teleport"
    assert run.choose(plain[::2]).candidate.level == "explicit"


def test_which_of_few_glints_are_left_is_chance(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of texture that a thousand pixels make three explicit grains leave a share; of as much that one pixel makes they
    may leave all: its error bar says so, though as much is likely to be left, and so does that of a pilot which has
    looked at few of the pixels."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    volume, three = Candidate("volume"), Candidate("teleport-memory", 3)
    assert run.add(volume) and run.add(three)
    one = run.expected["teleport-memory"]._replace(bias=0.0)
    said = {}
    for few in (1.0, 1e-3):  # of the pixels, that make it
        seen = {volume: Apart(0.0, 1e-4, 1.0, 1e-3, 1e-3, 0.1, 1.0 / few)}
        monkeypatch.setattr(planner._Planning, "apart", lambda _, c, seen=seen: seen.get(c))
        run.pixels = 1000
        law = run.faded(one, 0.0, 0.0, Belief(1.0, 0.01), 0, 3)[2]
        seen[three] = Apart(0.0, 1e-4, 0.0, 1e-4, pixels=250)
        said[few] = law, run.predicted(three).floor
        del seen[three]
    (law, pilot), (rare_law, rare_pilot) = said[1.0], said[1e-3]
    assert law.value == rare_law.value and rare_law.error > 4.0 * law.error
    assert rare_pilot.high > 1.5 * pilot.high, (rare_pilot, pilot)


def test_glints_go_straight_on_through_cubes(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of light that one grain deflects and all others let straight on a share is met by more than three: the sum says
    so. Of glints in few pixels more is left then, by half of the logarithm, and it is less well known."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    assert run.add(Candidate("volume"))
    run.atoms = 0.42
    left = sum(n * 0.42 ** (n - 1) * 0.58**2 for n in range(4, 200))
    assert run.straight(3) == pytest.approx(-0.5 * math.log(left)) and run.straight(0) == 0.0
    one, said = run.expected["volume"]._replace(bias=0.0), {}
    for few in (0.1, 1.0):
        seen = {Candidate("volume"): Apart(0.0, 1e-4, 1.0, 1e-3, 1e-3, few)}
        monkeypatch.setattr(planner._Planning, "apart", lambda _, c, seen=seen: seen.get(c))
        monkeypatch.setattr(planner._Planning, "length", 1.85)
        for atoms in (0.0, 0.42):
            run.atoms = atoms
            said[few, atoms] = run.faded(one, 0.0, 0.0, Belief(1.0, 0.01), 0, 3)[2]
    assert said[0.1, 0.0] == said[0.1, 0.42] and said[1.0, 0.42].error > said[1.0, 0.0].error
    assert said[1.0, 0.42].value == pytest.approx(math.sqrt(said[1.0, 0.0].value * math.sqrt(left)), rel=1e-3)
