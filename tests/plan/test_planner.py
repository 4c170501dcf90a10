"""Plans as a whole, with short pilots: what they must not say, what they refuse, and how they reach pictures."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import tsdf
from tsdf.data import library
from tsdf.errors import SceneError, UsageError
from tsdf.picture import render, world
from tsdf.plan import evidence, planner, report, shot
from tsdf.plan.beliefs import CERTAIN, Belief
from tsdf.plan.pilot import Apart, Pilot
from tsdf.plan.planner import plan
from tsdf.plan.prediction import Plan, Prediction
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

LIGHTS = (ConstantLight((0.3, 0.3, 0.3)), SunLight((0.6, 0.0, 0.8), (2.0, 2.0, 2.0), 60.0))
FEW = 300  # spheres in a tile


@pytest.fixture(scope="module")
def ball() -> tsdf.Table:
    return tsdf.build("sphere", 1.33, tsdf.Effort(cells=256, joint=32, memory=32))


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans in a second or so."""
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
    assert far.spent > 0.0 and far.clock > 0.0 and not far.fewer_far
    told = report.facts(far)
    assert told["chosen"]["level"] == far.chosen.candidate.level and len(told["candidates"]) == len(far.predictions)
    assert all(len(line) < 300 and "\n" not in line for line in (*far.why, *far.notes, *far.needs))


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
    assert "none that was looked at is likely to have a tenth less" in hurried.why[0]
    looked = [p for p in hurried.predictions if p.piloted]
    errors = [math.hypot(p.floor.value, p.floor.error, p.noise(0.5 / hurried.load)) for p in looked]
    assert errors[0] <= planner.TIE * min(errors)


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
    made = plan(scene, 0.05, seconds=2.0, threads=2)
    one = made.chosen.candidate
    assert not one.explicit_grains and not LEVELS[one.level].traits.packed
    assert any("pilots look at suns" in note for note in made.notes)
    assert 100.0 * made.chosen.variance < of(made, "explicit").variance < math.inf
    assert made.chosen.piloted and 0.1 < made.chosen.texture < 1.5 and made.chosen.floor.error < made.chosen.texture
    assert f"{made.chosen.candidate}" in made.why[0] and json.dumps(report.facts(made), allow_nan=False)
    assert report.table(made)[1].startswith(str(one)) and made.scene.lights == lights
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        patch.setattr(shot, "plan", lambda *_: made)
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
    """Black scenes are planned, and nothing is said to be known of their noise; so are scenes without
    grains, or with none in sight. Those without light are refused."""
    monkeypatch.setattr(planner, "SECONDS", 0.3)
    monkeypatch.setattr(planner, "LEAST_PILOTS", 0.2)
    with pytest.raises(SceneError, match="a scene without light"):
        plan(replace(pile(ball, 160.0), lights=()), 0.05)
    away = replace(pile(ball, 160.0).camera, target=(0.0, -999.0, 999.0))
    made = plan(replace(pile(ball, 160.0), camera=away), 0.05, threads=2)
    assert len(made.why) == 3 and math.isfinite(made.chosen.variance)
    black = plan(replace(pile(ball, 160.0), camera=away, lights=(SUN,)), 0.05, threads=2)
    assert any("no pilot has seen any light" in note for note in black.notes)
    assert "nothing is known of its noise" in black.why[0] and json.dumps(report.facts(black), allow_nan=False)
    for lights in (LIGHTS, (SUN,)):
        assert plan(Scene(away, lights, ()), 0.05, threads=1).why[0].startswith("take ")


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
    monkeypatch.setattr(shot, "plan", lambda *_: choice.plan)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)
        one = tsdf.render(scene, spp=3, threads=1)
        named = replace(scene, render=replace(found))
        other = tsdf.render(named, spp=3, threads=2)
    np.testing.assert_array_equal(one.rgb, other.rgb)
    monkeypatch.setattr(shot, "plan", lambda *_: pytest.fail("a plan is made"))
    assert shot.chosen(scene, "volume").spp == shot.SPP
    assert shot.chosen(replace(scene, render=Render("volume", 5)), target_error=0.1)[1:4] == (None, None, 0.1)


@pytest.mark.slow
def test_without_a_stop_it_is_done_at_the_target(far: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise is what the target leaves beside bias and texture."""
    monkeypatch.setattr(shot, "plan", lambda *_: far)
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
    apart = {Candidate(level): Apart(0.0, 0.001, *square) for level, square in squares.items()}
    monkeypatch.setattr(planner._Planning, "apart", lambda _, candidate: apart.get(candidate))
    best = run.without(Candidate("teleport"), run.expected["teleport"])[2]
    for level in ("volume", "teleport-memory"):
        missed = run.missed(Candidate(level))
        assert missed is not None and missed.value == pytest.approx(math.sqrt(0.011), rel=0.02)
        floor = run.without(Candidate(level), run.expected[level]._replace(bias=0.0))[2]
        assert floor.value == pytest.approx(math.sqrt(0.011), rel=evidence.ALIKE) and floor.error >= 0.99 * best.error
    assert run.missed(Candidate("teleport")) is None


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
    what is taken is rendered so, and the options that fix it say so."""
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
    the sky that takes; a sphere's stays. (A picture of cubes in the sun of bench_plan says so, too.)"""
    for table, flat in ((ball, False), (tsdf.read(library.ready("salt")), True)):
        scene = replace(pile(table, 120.0), lights=(replace(SUN, angular_diameter_deg=8.0),))
        run = planner._Planning(scene, 0.1, None, 0, 2)
        run.look()
        more = (run.wide / 8.0) ** 2 if flat else 1.0
        assert run.sparkle == pytest.approx(more, rel=0.05) and (more > 3.0) == flat
        run.refer()
        assert run.add(Candidate("volume"))
        for pilot in run.pilots.values():
            pilot.each = 1
        monkeypatch.setattr(planner._Planning, "trusted", lambda *_: True)
        monkeypatch.setattr(Pilot, "apart", lambda *_: Apart(0.01, 0.001, 0.2, 0.1))
        seen = run.apart(Candidate("volume"))
        assert seen is not None and seen.bias == 0.01
        assert (seen.square, seen.square_error) == pytest.approx((0.2 * more, 0.1 * more), rel=0.05)


def test_what_chains_miss_after_explicit_grains_is_alike(ball: tsdf.Table, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pilot of one chain with three explicit grains first tells of others with three, less surely; not of none."""
    run = planner._Planning(pile(ball, 160.0), 0.05, None, 0, 2)
    run.look()
    run.refer()
    before = [run.predicted(Candidate("teleport-memory", k)).floor for k in (0, 3)]
    one = Candidate("teleport", 3)
    assert run.add(one)
    monkeypatch.setattr(planner._Planning, "apart", lambda _, c: Apart(0.0, 1e-4, 1e-4, 1e-6) if c == one else None)
    own, other = run.predicted(one).floor, run.predicted(Candidate("teleport-memory", 3)).floor
    assert own.value == pytest.approx(0.01, rel=0.1) and other.value == pytest.approx(0.01, rel=0.3)
    assert before[1].value < 0.3 * other.value and other.error > own.error
    assert run.predicted(Candidate("teleport-memory")).floor == before[0]
