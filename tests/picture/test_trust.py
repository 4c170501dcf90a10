"""Error bars: moments of samples against formulas, what is doubted and what is trusted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render, world
from tsdf.picture.render import BLOCK, FEW, Goal, Picture, Portion, Sums
from tsdf.picture.trust import SHOWN, Moments, Trust, kurtosis_of
from tsdf.scene.scene import Camera, ConstantLight, GrainSpec, MediumSpec, Scene, Sphere, SunLight, SurfaceSpec
from tsdf.walk.lights import compile_lights

PIXELS = 60


def gathered(values: np.ndarray, each: int = 20) -> Trust:
    """Return what samples (pixels, n) of grey pixels say, added in blocks."""
    count, n = values.shape
    moments, samples = Moments(count), np.zeros(count, np.int64)
    for start in range(0, n, each):
        for own in (slice(0, count // 3), slice(count // 3, count)):
            block = values[own, start : start + each]
            moments.add(own, samples[own], np.repeat(block[..., None], 3, axis=2))
        samples += min(each, n - start)
    return moments.trust(samples, (1, count), 0.0)


def test_moments_are_those_of_all_samples() -> None:
    """Sums over blocks give the central moments of all samples; pixels that do not vary have none to the last bit."""
    values = np.random.default_rng(0).gamma(0.3, size=(PIXELS, 73)) + np.linspace(0.0, 50.0, PIXELS)[:, None]
    values[7] = 0.1
    moments, samples = Moments(PIXELS), np.zeros(PIXELS, np.int64)
    for start in (0, 1, 17, 33):
        block = values[:, start : {0: 1, 1: 17, 17: 33, 33: 73}[start]]
        moments.add(slice(0, PIXELS), samples, np.repeat(block[..., None], 3, axis=2))
        samples += block.shape[1]
    second, fourth = moments.central(samples)
    away = values - values.mean(axis=1, keepdims=True)
    assert second[7] == fourth[7] == 0.0
    assert np.allclose(second, (away**2).sum(axis=1), rtol=1e-9, atol=1e-20)
    assert np.allclose(fourth, (away**4).sum(axis=1), rtol=1e-9, atol=1e-20)
    trust = moments.trust(samples, (6, 10), 0.0)
    assert trust.pixels.shape == (6, 10) and trust.pixels[0, 7] == 0.0
    rest = np.delete(np.arange(PIXELS), 7)
    expected = (away**4).sum(axis=1)[rest] / (away**2).sum(axis=1)[rest] ** 2 - 1.0 / 73.0
    expected *= 73.0 * 72.0 / 71.0**2
    assert np.allclose(trust.pixels.ravel()[rest], expected, rtol=1e-8)


def test_vov_is_the_variance_of_the_variance() -> None:
    """Over 400 pictures the estimated variance of their mean scatters as `vov` says, within 4 standard errors of what
    400 tell (its own distribution taken as normal) and a tenth for its bias at 30 samples; not as of normal ones."""
    rng = np.random.default_rng(1)
    variances, vovs = [], []
    for _ in range(400):
        values = rng.exponential(size=(PIXELS, 30))
        variances.append(values.var(axis=1, ddof=1).sum())
        vovs.append(gathered(values).vov)
    found = np.var(variances, ddof=1) / np.mean(variances) ** 2
    assert abs(np.mean(vovs) / found - 1.0) < 4.0 * math.sqrt(2.0 / 400) + 0.1
    assert found > 2.0 * 2.0 / (30 * PIXELS)


@pytest.mark.parametrize(("index", "trusted"), [(1.3, False), (4.0, True), (math.inf, True)])
def test_slow_tails_are_doubted(index: float, trusted: bool) -> None:
    """Samples of density x^-2.3 have no variance and are doubted, whatever is seen of them; x^-5 and exponential ones
    are not. The slope is found within 4 of its standard errors."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        values = rng.exponential(size=(PIXELS, 300)) if math.isinf(index) else rng.pareto(index, (PIXELS, 300))
        trust = gathered(values)
        assert (trust.doubt is None) == trusted
        if index < 2.0:
            assert abs(1.0 / (trust.slope - 1.0) - 1.0 / index) < 4.0 * math.sqrt((1.0 + index**-2) / 201.0)


def test_one_bright_sample_is_doubted() -> None:
    values = np.random.default_rng(2).random((PIXELS, 64))
    assert gathered(values).doubt is None
    values[11, 40] = 3e3
    trust = gathered(values)
    assert trust.vov > 0.9 and trust.doubt is not None and "a few bright samples" in trust.doubt
    assert trust.pixels[0, 11] > 0.9 and trust.unsure == 1.0 / PIXELS


def test_few_samples_have_no_slope() -> None:
    assert gathered(np.random.default_rng(3).random((4, 4))).slope == math.inf


@pytest.mark.parametrize("n", [1, 2])
def test_one_or_two_samples_of_a_pixel_are_too_few_to_say(n: int) -> None:
    """However even they look: of two, each makes half of the variance. From three on they tell."""
    values = np.random.default_rng(4).random((PIXELS, 3))
    trust = gathered(values[:, :n])
    assert trust.vov == math.inf and trust.unsure == 1.0
    assert trust.doubt is not None and "too few samples to say" in trust.doubt and "\n" not in trust.doubt
    assert gathered(values).doubt is None and gathered(values).vov < 0.1
    part = Moments(PIXELS)  # an interrupted pass
    part.add(slice(0, PIXELS), np.zeros(PIXELS, np.int64), np.repeat(values[..., None], 3, axis=2))
    samples = np.where(np.arange(PIXELS) < PIXELS - 1, 3, n)
    assert part.trust(samples, (1, PIXELS), 0.0).vov == math.inf
    blind = part.trust(samples, (1, PIXELS), 1e6)  # of a sun that has not been met more is to be said
    assert trust.few and not blind.few and "suns" in str(blind.doubt)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_without_noise_any_number_of_samples_does(n: int) -> None:
    """A furnace, rounding included; not a picture that is black so far, nor one of which a pixel has no sample."""
    values = 0.3 * (1.0 + 1e-15 * np.random.default_rng(5).random((PIXELS, n)))
    trust = gathered(values)
    assert trust.doubt is None and trust.unsure == 0.0
    assert (gathered(0.0 * values).doubt is None) == (n > 1)
    begun = Moments(2)
    begun.add(slice(0, 1), np.zeros(2, np.int64)[:1], np.ones((1, 1, 3)))
    assert begun.trust(np.array([1, 0]), (1, 2), 0.0).doubt is not None
    assert (gathered(np.ones((1, n))).doubt is None) == (n > 1)  # a single sample of all


@pytest.mark.parametrize("n", [3, 4, 8, 30, 300])
def test_one_sample_that_makes_it_all_is_told_of_any_number(n: int) -> None:
    values = np.zeros((PIXELS, n))
    values[11, n // 2] = 1.0
    assert gathered(values).vov == pytest.approx(1.0) and gathered(values).pixels[0, 11] == pytest.approx(1.0)


def test_kurtosis_of_a_sun_is_one_over_its_share_of_the_sphere() -> None:
    for diameter in (0.53, 20.0):
        share = 0.5 * (1.0 - math.cos(0.5 * math.radians(diameter)))
        lights = compile_lights((1.0, 1.0, 1.0), suns=[((0.0, 0.0, 1.0), diameter, (1.0, 2.0, 3.0))])
        assert kurtosis_of(lights) == pytest.approx(1.0 / share, rel=1e-4)
    sky = np.ones((32, 64, 3))
    assert kurtosis_of(compile_lights(environment=sky)) == 0.0
    sky[10, 20] = 1e5  # one pixel of so many
    share = (math.cos(math.pi * 10 / 32) - math.cos(math.pi * 11 / 32)) / 128.0
    assert kurtosis_of(compile_lights(environment=sky)) == pytest.approx(1.0 / share, rel=0.02)


# ------------------------------------------------------------------------------------------------ pictures


@pytest.fixture(scope="module")
def table() -> Table:
    return exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=64, joint=8, memory=16))


def scene_of(table: Table, diameter: float) -> Scene:
    """Return a ball of beads on a floor under a sun."""
    medium = MediumSpec(Sphere((0.0, 0.0, 0.0), 8.0), 0.5, 1.0, (GrainSpec(table),), packing_spheres=200)
    floor = SurfaceSpec(Sphere((0.0, 0.0, -208.0), 200.0), (0.5, 0.4, 0.3))
    sun = SunLight((0.3, -0.5, 0.8), (3.0, 3.0, 3.0), diameter)
    return Scene(Camera((0.0, -40.0, 10.0), (0.0, 0.0, 0.0), 24, 18, fov_deg=30.0), (sun,), (medium,), (floor,))


def picture(table: Table, level: str, diameter: float, spp: int = 16, threads: int = 2, seed: int = 0) -> Picture:
    return render.render(world.build(scene_of(table, diameter), level), spp=spp, threads=threads, seed=seed)


@pytest.mark.slow
@pytest.mark.parametrize("level", ["explicit", "teleport-packed"])
def test_a_small_sun_that_only_chance_finds_is_doubted(table: Table, level: str) -> None:
    """Whether it has been met or not: hardly ever is. A wide sun is trusted, and the small one that is aimed at."""
    for seed in range(3):
        small = picture(table, level, 0.53, seed=seed).trust
        assert small is not None and small.doubt is not None and "\n" not in small.doubt
    wide, aimed = picture(table, level, 60.0).trust, picture(table, "teleport", 0.53).trust
    assert wide is not None and wide.doubt is None
    assert aimed is not None and aimed.doubt is None


@pytest.mark.slow
def test_a_target_error_waits_for_suns_that_only_chance_finds(table: Table) -> None:
    """Lossless grains before an even sky have no noise at all until one has met the sun, so an error that is asked for
    is not reached, nor a picture black for good, before as many samples as show it; where light is aimed at, it is."""
    for sky in (0.1, 0.0):
        made = scene_of(table, 5.0)
        made = replace(made, lights=(*made.lights, ConstantLight((sky,) * 3)) if sky else made.lights, surfaces=())
        found = {
            level: render.render(world.build(made, level), target_error=8.0, threads=2)
            for level in ("explicit", "teleport")
        }
        waited, aimed = found["explicit"].trust, found["teleport"].trust
        assert waited is not None and waited.chance <= SHOWN and found["explicit"].relative_error <= 8.0
        assert aimed is not None and found["teleport"].samples.max() < found["explicit"].samples.max()
    assert not Goal(None, None, 0.1).reached(10**6, math.inf, True, 1.01 * SHOWN)
    assert Goal(None, None, 0.1).reached(10**6, math.inf, True, SHOWN)
    assert Goal(None, None, 0.1).part(9, 9.0, 1.0, 1e-9, 10.0 * SHOWN) == pytest.approx(0.1)


def test_trust_is_the_same_for_any_threads(table: Table) -> None:
    found = [picture(table, "teleport", 5.0, 20, threads).trust for threads in (1, 2, 3)]
    assert len({(t.vov, t.slope, t.chance, t.pixels.tobytes()) for t in found if t is not None}) == 1
    single = picture(table, "teleport", 5.0, 1).trust
    assert single is not None and single.doubt is not None and "too few" in single.doubt


def test_a_pixel_of_one_sample_has_a_variance() -> None:
    """An interrupted pass: pixels with one sample have that of the samples around, 9 at a corner to 25, on the average
    the true one where the picture is even and more where it is not; pixels with more keep their own; none is known of
    pixels without a sample, nor of a single one."""
    rng = np.random.default_rng(3)

    def sums(height: int, width: int, slope: float, whole: int, first: int) -> Picture:
        made = Sums(width, height)
        values = rng.gamma(2.0, 1.0, (height * width, 3, 3)) + slope * np.arange(height * width)[:, None, None]
        for number, pixels in ((1, whole), (2, first)):
            made.add(Portion(0, pixels, number, 0), values[:pixels, number - 1 : 2 * number - 1])
        return made.picture(np.zeros(6, np.int64), 1.0, True)

    even, sloping = sums(100, 99, 0.0, 9900, 700), sums(100, 99, 0.1, 9900, 700)
    assert (even.samples.ravel()[:700] == 3).all() and (even.samples.ravel()[700:] == 1).all()
    assert even.variance.shape == (100, 99, 3) and np.isfinite(even.relative_error)
    single = even.variance[10:]
    assert single.mean() == pytest.approx(2.0, abs=4.0 * single.std() / math.sqrt(single[::5, ::5].size))
    assert sloping.variance[10:].mean() > 2.0 * single.mean()
    own = even.variance[:7]
    assert own.mean() == pytest.approx(2.0 / 3.0, abs=4.0 * own.std() / math.sqrt(own.size))
    begun = sums(10, 10, 0.0, 50, 0)
    assert np.isfinite(begun.variance[:5]).all() and np.isinf(begun.variance[5:]).all()
    assert begun.relative_error == math.inf and np.isinf(sums(1, 1, 0.0, 1, 0).variance).all()


@pytest.mark.parametrize("goal", [Goal(10**6, None, None), Goal(None, 1e6, None), Goal(None, None, 1e-9)])
@pytest.mark.parametrize("count", [1, 768, 10**6])
def test_no_pixel_is_far_behind(goal: Goal, count: int) -> None:
    """Whenever a picture is interrupted, pixels have half as many samples as others at least, once they have 16 or the
    picture has 65,536; and yet a million samples of a pixel take few passes where they are not many in all."""
    done, share, passes = 0, 0, 0
    while done < 10**6 and (share := goal.following(done, share, 1e-3 * share, 0.0, count)) > 0:
        if done > max(FEW, BLOCK // count):
            assert share <= done
        done, passes = done + share, passes + 1
    assert done >= 10**6 and (count > 1 or passes <= 12)
