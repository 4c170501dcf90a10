"""Which candidate is taken of given predictions, where pixels cannot be right and where light is hardly ever met."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tsdf.data import library
from tsdf.picture import world
from tsdf.plan.beliefs import CERTAIN, Belief
from tsdf.plan.choice import Wish, choose
from tsdf.plan.pilot import HALVES, Pilot
from tsdf.plan.prediction import HALF, Prediction, Rare
from tsdf.scene.scene import Box, Camera, ConstantLight, GrainSpec, MediumSpec, Scene
from tsdf.study.candidates import Candidate


def one(level: str, variance: float, floor: float, regions: float = 0.0, k: int = 0) -> Prediction:
    """A prediction of turns of a second."""
    belief = Belief(floor, 0.5 * floor) if floor else CERTAIN
    return Prediction(
        Candidate(level, k), 0.0, 0.0, floor, 0.5 * floor, belief, variance, 1.0, piloted=True, known=True,
        regions=regions,
    )  # fmt: skip


def glinting(texture: float) -> list[Prediction]:
    """Snow in the sun: all miss the same glints; what knows less of grains has less noise, and wrong regions."""
    return [
        one("explicit", 1e9, 0.0),
        one("teleport-memory", 4.0, texture, 0.004),
        one("volume", 3.5, 1.01 * texture, 0.012),
        one("volume-hg", 0.9, 1.02 * texture, 0.026),
        one("isotropic", 0.8, 1.02 * texture, 0.024),
    ]


def test_what_all_miss_does_not_tell_them_apart() -> None:
    """As long as noise is all that one sees it is about the least noise; then it is right regions, though the error of
    pixels is the same to a hundredth at all levels. Where the target is above what is missed, that error decides, and
    so it does where one is a fifth less noisy in all."""
    for seconds, level in ((3.0, "volume-hg"), (60.0, "teleport-memory"), (600.0, "teleport-memory")):
        taken, regional = choose(glinting(1.2), Wish(0.02, seconds, sunny=True))
        assert (taken.candidate.level, regional) == (level, True)
    taken, regional = choose(glinting(1.2), Wish(0.02, 60.0))  # explicit is mostly noise, sun or none
    assert (taken.candidate.level, regional) == ("teleport-memory", True)
    taken, regional = choose(glinting(0.1), Wish(0.02, 60.0))
    assert taken.candidate.level in ("volume-hg", "isotropic")
    taken, regional = choose(glinting(0.01), Wish(0.02, 60.0))
    assert not regional and taken.candidate.level in ("volume-hg", "isotropic")


def test_single_grains_that_miss_less_are_taken() -> None:
    """What all others miss decides against all of them, where few explicit grains first have less error in the time."""
    some = [*glinting(1.2), one("teleport-memory", 9.0, 0.1, k=3)]
    taken, regional = choose(some, Wish(0.02, 600.0))
    assert (taken.candidate, regional) == (Candidate("teleport-memory", 3), False)


def test_light_that_nobody_meets_is_missing_not_noise() -> None:
    """A share of .1 % of the light, met once in a million turns of this picture, is no noise of one of a thousand, and
    all of it is missing; of one of ten million it is. The time to an error is the earlier one if that is soon."""
    rare = Rare(variance=1e-6 / 1e-6, meetings=1e-6, light=1e-3)
    plain = one("teleport-memory", 0.5, 0.0)
    p = replace(plain, variance=plain.variance + rare.variance, rare=rare)
    assert p.noise(1e3) == pytest.approx(plain.noise(1e3)) and p.error(1e3) == pytest.approx(
        math.hypot(p.noise(1e3), 1e-3)
    )
    late = 1.01 * HALF / rare.meetings
    assert p.noise(late) == pytest.approx(math.sqrt(p.variance / late)) and p.error(late) == p.noise(late)
    assert p.seconds(0.01) == pytest.approx(plain.variance / (0.01**2 - 1e-6))
    assert p.seconds(1e-4) == pytest.approx(p.variance / 1e-8)  # less than what is missing: until it is met often
    often = replace(p, rare=Rare(1.0, 1.0, 1.0))
    assert often.seconds(0.01) == pytest.approx(1.5 / 1e-4)
    for seconds in (1e2, 1e9):  # of regions it is never more than missing
        assert p.error_of_regions(seconds) <= math.hypot(plain.error_of_regions(seconds), 1e-3) + 1e-12


def test_regions_that_make_up_for_each_other() -> None:
    """One side a tenth too bright, the other as much too dark: no bias, but an error of regions of a tenth; noise is no
    part of it, nor what alternates from pixel to pixel, and a picture has none to itself."""
    camera = Camera((0.0, -90.0, 60.0), (0.0, 0.0, 0.0), 64, 48, fov_deg=20.0)
    medium = MediumSpec(
        Box((-30.0, -30.0, -10.0), (30.0, 30.0, 0.0)), 0.5, 1.0, (GrainSpec(library.ready("glass-beads")),)
    )
    made = world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), name="slab"), "volume")
    pilots = [Pilot(made, 1, 1), Pilot(made, 1, 1)]
    rng = np.random.default_rng(0)
    for pilot in pilots:
        pilot.counts[:] = 100
        pilot.sums[:] = 100.0 * (1.0 + 0.02 * rng.normal(size=pilot.sums.shape))
    y, x = np.divmod(pilots[0].pixels, 64)
    square, error = pilots[0].regions(pilots[1])
    assert abs(square) < 4.0 * error < 0.01**2
    side = np.where(x < 32, 0.1, -0.1)[None, :, None]
    pilots[0].sums += 100.0 * side * np.ones((HALVES, 1, 3))
    square, error = pilots[0].regions(pilots[1])
    assert math.sqrt(square) == pytest.approx(0.1, rel=0.1) and error < 0.1 * square
    assert abs(pilots[0].seen.mean / pilots[1].seen.mean - 1.0) < 0.01
    pilots[0].sums += 100.0 * (0.3 * (1 - 2 * ((x + y) % 2)))[None, :, None]
    assert math.sqrt(pilots[0].regions(pilots[1])[0]) == pytest.approx(0.1, rel=0.4)
    for pilot in pilots:
        pilot.counts[1:] = 0
    assert pilots[0].regions(pilots[1])[1] == math.inf  # one pixel tells nothing
