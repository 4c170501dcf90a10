"""The free path and the medium of point scatterers, by hand, by theorem and by drawing them."""

import math

import numpy as np
import pytest

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table, thawed
from tsdf.errors import UsageError
from tsdf.reference_data.make_checks import CHECKS
from tsdf.scene.medium import Component, free_path, volume_parameters

SPHERE, CUBE = (tsdf_format.read(CHECKS / f"{name}.tsdf.exr") for name in ("sphere", "cube"))


def altered(table: Table, **statistics: float) -> Table:
    """Return a table whose header states other statistics."""
    header = thawed(table.header)
    header["statistics"] |= statistics
    return Table(header, table.pixels)


EXACT_CUBE = altered(CUBE, hit_probability=2.0 / math.pi, mean_miss_chord=0.84895)  # physics: convex theorems
IDENTITY = altered(tsdf_format.read(CHECKS / "cube_identity.tsdf.exr"), mean_cosine=1.0, albedo=1.0)


def draw_free_paths(path, rays: int, seed: int, gap: float) -> np.ndarray:
    """Draw the free path by its definition: gaps, and the bounding sphere of each grain that is missed."""
    rng = np.random.default_rng(seed)
    misses = rng.geometric(path.hit_probability, rays) - 1
    return rng.gamma(misses + 1, gap) + misses * path.lambda_delta


# --- the free path ------------------------------------------------------------------


def test_sphere_by_hand():
    """Every ray that enters a sphere meets it, so its free path is the gap alone: 4 (0.4) / 1.8 R at f = 0.6."""
    path = free_path([Component(SPHERE)], 0.6)
    assert path.lambda_b == path.lambda_beta == pytest.approx(8.0 / 9.0, rel=1e-14)
    assert (path.lambda_delta, path.hit_probability, path.choice) == (0.0, 1.0, (1.0,))
    assert path.lambda_s == SPHERE.statistics["mean_z"]
    assert path.sigma_t == pytest.approx(1.0 / (8.0 / 9.0 + 1.48184), rel=1e-5)


@pytest.mark.parametrize("f", [1e-6, 0.1, 0.6, 0.74])
def test_gap_and_chord_fill_the_line(f):
    """A line lies in spheres for a share f of its length: gap + chord 4R/3 is the chord over f."""
    assert free_path([Component(CUBE, radius=2.0)], f).lambda_b + 8.0 / 3.0 == pytest.approx(8.0 / (3.0 * f))


def test_cube_by_hand():
    """beta 2/pi and miss chord 0.84895 R are theorems of the cube; two thirds of a gap more is walked per grain."""
    path = free_path([Component(EXACT_CUBE)], 0.6)
    assert path.lambda_delta == pytest.approx(0.84895)
    assert path.lambda_beta == pytest.approx(0.888889 + (0.888889 + 0.84895) * 0.570796, abs=2e-6)
    # the whole line again: gap plus every chord, missed or met, per bounding sphere
    beta, met_chord = path.hit_probability, (4.0 / 3.0 - (1.0 - 2.0 / math.pi) * 0.84895) * math.pi / 2.0
    assert beta * (path.lambda_beta + met_chord) == pytest.approx(4.0 / (3.0 * 0.6), rel=1e-12)


@pytest.mark.parametrize("f", [0.2, 0.6])
def test_free_path_is_what_its_definition_draws(f):
    """Monte Carlo of the definition has the mean lambda_beta; gaps 1 % longer are seen at the same sample size."""
    grains = [Component(CUBE, 0.5, 1.0), Component(SPHERE, 0.3, 0.7), Component(EXACT_CUBE, 0.2, 2.0)]
    path = free_path(grains, f)

    def deviation(gap: float) -> float:
        drawn = draw_free_paths(path, 400_000, 7, gap)
        return (drawn.mean() - path.lambda_beta) / (drawn.std() / math.sqrt(len(drawn)))

    assert abs(deviation(path.lambda_b)) < 4.0
    assert abs(deviation(1.01 * path.lambda_b)) > 4.0


def test_mixture_is_what_lines_through_it_meet():
    """Shares, chords and choice of a mixture against spheres drawn one by one in proportion to n R^2.

    With n alone instead, the negative control, the share of grains met is off by tens of standard errors.
    """
    grains = [Component(CUBE, 3.0, 0.5), Component(EXACT_CUBE, 1.0, 1.5), Component(SPHERE, 2.0, 1.0)]
    path = free_path(grains, 0.5)
    rng, rays = np.random.default_rng(5), 400_000
    beta = np.array([c.table.statistics["hit_probability"] for c in grains])
    chord = np.array([c.table.statistics["mean_miss_chord"] * c.radius for c in grains])
    advance = np.array([c.table.statistics["mean_z"] * c.radius for c in grains])

    def met(weights: list[float]) -> tuple[np.ndarray, np.ndarray]:
        kind = rng.choice(3, rays, p=np.array(weights) / sum(weights))
        return kind, rng.random(rays) < beta[kind]

    def off(sample: np.ndarray, expected: float) -> float:
        return abs(sample.mean() - expected) / (sample.std() / math.sqrt(len(sample)))

    kind, hit = met([c.fraction * c.radius**2 for c in grains])
    assert off(hit, path.hit_probability) < 4.0
    assert off(chord[kind[~hit]], path.lambda_delta) < 4.0
    assert off(advance[kind[hit]], path.lambda_s) < 4.0
    for i, probability in enumerate(path.choice):
        assert off(kind[hit] == i, probability) < 4.0
    assert off(met([c.fraction for c in grains])[1], path.hit_probability) > 10.0
    # <R^3> / <R^2> = (3 .125 + 3.375 + 2) / (3 .25 + 2.25 + 2)
    assert path.lambda_b == pytest.approx(4.0 * 0.5 / 1.5 * 5.75 / 5.0, rel=1e-14)


def test_a_grain_mixed_with_itself_is_the_grain():
    """Splitting a grain into several components of one table changes nothing, nor does a component of fraction 0."""
    alone = free_path([Component(CUBE, 1.0, 0.3)], 0.4)
    mixed = free_path([Component(CUBE, 0.25, 0.3), Component(CUBE, 5.0, 0.3), Component(SPHERE, 0.0, 9.0)], 0.4)
    for name in ("lambda_b", "lambda_delta", "lambda_beta", "lambda_s", "hit_probability", "sigma_t"):
        assert getattr(mixed, name) == pytest.approx(getattr(alone, name), rel=1e-14)
    assert mixed.choice == pytest.approx((0.25 / 5.25, 5.0 / 5.25, 0.0))
    one = volume_parameters([Component(CUBE, 1.0, 0.3)], 0.4, [2.0])
    two = volume_parameters([Component(CUBE, 0.25, 0.3), Component(CUBE, 5.0, 0.3)], 0.4, [2.0, 2.0])
    assert (two.sigma_t, two.albedo, two.g) == pytest.approx((one.sigma_t, one.albedo, one.g), rel=1e-13)


@pytest.mark.parametrize("scale", [1e-200, 1e-3, 1e200])
def test_lengths_scale_with_the_radii(scale):
    """Only ratios of radii matter: all lengths scale, absorption per length inversely, even where R^3 overflows."""
    grains = [(CUBE, 1.0, 1.0, 0.1), (SPHERE, 2.0, 3.0, 0.4)]
    for extent in (1.0, scale):
        components = [Component(t, n, r * extent) for t, n, r, _ in grains]
        path = free_path(components, 0.55)
        volume = volume_parameters(components, 0.55, [a / extent for *_, a in grains])
        lengths = (path.lambda_b, path.lambda_delta, path.lambda_beta, path.lambda_s, volume.transport_mean_free_path)
        numbers = [*(x / extent for x in lengths), volume.sigma_t * extent, volume.albedo, volume.g, *path.choice]
        if extent == 1.0:
            expected = numbers
    assert numbers == pytest.approx(expected, rel=1e-12)


# --- the medium of point scatterers -------------------------------------------------


def test_volume_parameters_of_lossless_spheres():
    """All light is scattered; the reduced coefficient is sigma_t (1 - g) by the exact statistics of the sphere."""
    medium = volume_parameters([Component(SPHERE, radius=0.5)], 0.6)
    assert medium.sigma_t == pytest.approx(2.0 / (8.0 / 9.0 + 1.481840), rel=1e-6)
    assert (medium.albedo, medium.sigma_a) == (1.0, 0.0)
    assert medium.g == pytest.approx(0.768519, abs=1e-6)
    assert medium.sigma_s == medium.sigma_t
    assert medium.transport_mean_free_path == pytest.approx(1.0 / (medium.sigma_t * (1.0 - 0.768519)), rel=1e-5)


def test_absorption_enters_as_its_product_with_the_radius():
    """sigma_a R = 0.1 whichever way, with the exact absorbing sphere's albedo as the second route."""
    from tsdf.judge.analytic import sphere_statistics

    small = volume_parameters([Component(SPHERE, radius=0.01)], 0.3, [10.0])
    large = volume_parameters([Component(SPHERE, radius=10.0)], 0.3, [0.01])
    exact = sphere_statistics(1.333, "sp", absorption=0.1)
    assert small.albedo == pytest.approx(large.albedo, rel=1e-12)
    assert small.albedo == pytest.approx(exact.albedo, abs=1e-4)
    assert small.g == pytest.approx(exact.mean_cosine, abs=2e-3)
    assert small.sigma_s + small.sigma_a == pytest.approx(small.sigma_t, rel=1e-14)
    assert large.sigma_t == pytest.approx(0.1 / (4.0 * 0.7 / 0.9 + large.albedo * SPHERE.statistics["mean_z"]))


def test_mixture_weighs_by_energy():
    """A black grain in the mixture takes light away and says nothing of g or of the advance; an opaque one reflects."""
    grains = [Component(CUBE, 1.0), Component(altered(SPHERE, albedo=0.0), 1.0)]
    path = free_path(grains, 0.5)
    medium = volume_parameters(grains, 0.5)
    assert medium.albedo == path.choice[0]
    assert medium.g == CUBE.statistics["mean_cosine"]
    advance = path.choice[0] * CUBE.statistics["mean_z"]
    assert medium.sigma_t == pytest.approx(1.0 / (path.lambda_beta + advance), rel=1e-14)
    opaque = volume_parameters([grains[0], Component(SPHERE, 1.0)], 0.5, [0.0, 1e6])
    reflected = 0.066406  # order 0 of the sphere of eta 1.333, exact
    assert opaque.albedo == pytest.approx(path.choice[0] + path.choice[1] * reflected, rel=2e-4)


def test_ends_of_the_range():
    """Black grains have no g but a transport path; grains that do nothing have an infinite one."""
    black = volume_parameters([Component(altered(CUBE, albedo=0.0))], 0.5)
    assert black.albedo == 0.0 and math.isnan(black.g) and black.sigma_s_reduced == 0.0
    assert black.transport_mean_free_path == 1.0 / black.sigma_t
    assert black.sigma_t == 1.0 / free_path([Component(CUBE)], 0.5).lambda_beta
    assert volume_parameters([Component(IDENTITY)], 0.5).transport_mean_free_path == math.inf


# --- what is refused ----------------------------------------------------------------


@pytest.mark.parametrize("f", [0.0, -0.1, 0.7401, 1.0, math.nan, math.inf])
def test_packing_fraction_that_cannot_be(f):
    with pytest.raises(UsageError, match=r"packing fraction must be > 0 and <= 0\.74, not"):
        free_path([Component(SPHERE)], f)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_grains_that_cannot_be(value):
    with pytest.raises(UsageError, match="radius of a grain"):
        Component(SPHERE, radius=value)
    with pytest.raises(UsageError, match="fraction of a grain"):
        Component(SPHERE, fraction=value)
    with pytest.raises(UsageError, match="absorption must be finite"):
        volume_parameters([Component(SPHERE)], 0.5, [value])


@pytest.mark.parametrize(
    ("components", "absorption", "message"),
    [
        ([], None, "at least one grain"),
        ([Component(SPHERE, 0.0), Component(CUBE, 0.0)], None, "at least one grain"),
        ([Component(altered(CUBE, hit_probability=0.0))], None, "hit_probability is 0"),
        ([Component(SPHERE)], [0.1, 0.2], "one number per grain, 1 in all, not 2"),
    ],
)
def test_mixtures_that_cannot_be(components, absorption, message):
    with pytest.raises(UsageError, match=message) as error:
        volume_parameters(components, 0.5, absorption)
    assert "\n" not in str(error.value)


def test_radius_zero_is_refused():
    with pytest.raises(UsageError, match="radius of a grain must be a finite number > 0, not 0"):
        Component(SPHERE, radius=0.0)
