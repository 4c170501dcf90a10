"""Lights from infinity: draws have the density that is stated, and every route to the irradiance gives the same."""

import math

import numpy as np
import pytest
from numba import njit
from scipy.stats import chi2

from tsdf.errors import UsageError
from tsdf.sampling import turn
from tsdf.vectors import dot
from tsdf.walk.lights import LUMINANCE, compile_lights, draw, pdf, radiance

Z_BINS, AZIMUTH_BINS = 24, 48


def sky(height=7, width=13, seed=5):
    """Return an environment without any symmetry, with black pixels and a whole black row."""
    rng = np.random.default_rng(seed)
    pixels = rng.exponential(size=(height, width, 3)) ** 2
    pixels[rng.random((height, width)) < 0.2] = 0.0
    pixels[height // 2] = 0.0
    return pixels


WIDE = ((1.0, -2.0, 3.0), 40.0, (3.0, 2.0, 1.0))
NARROW = ((-1.0, 0.2, 1.5), 10.0, (1.0, 2.0, 4.0))
LOW = ((0.3, 1.0, -0.1), 25.0, (2.0, 0.0, 1.0))


def scene(**changes):
    options = {"constant": (0.1, 0.2, 0.4), "environment": sky(), "rotation_deg": 37.0, "suns": (WIDE, NARROW, LOW)}
    options["contrast"] = 0.5  # so that part of the environment is not aimed at
    return compile_lights(**(options | changes))


@njit
def binned(z, azimuth):
    row = min(Z_BINS - 1, int((z + 1.0) / 2.0 * Z_BINS))
    return row, min(AZIMUTH_BINS - 1, int((azimuth / (2.0 * math.pi) + 0.5) * AZIMUTH_BINS))


@njit
def count(lights, u, exponent):
    """Return how many draws fall in each bin; the first number is raised to a power, to spoil the draw."""
    counts = np.zeros((Z_BINS, AZIMUTH_BINS))
    for i in range(len(u)):
        d = draw(lights, u[i, 0] ** exponent, u[i, 1] ** exponent, u[i, 2])[0]
        counts[binned(d[2], math.atan2(d[1], d[0]))] += 1
    return counts


@njit
def masses(lights, fine):
    """Return the integral of the density over each bin by the midpoint rule, fine * fine points a bin."""
    total = np.zeros((Z_BINS, AZIMUTH_BINS))
    rows, columns = Z_BINS * fine, AZIMUTH_BINS * fine
    for i in range(rows):
        z = -1.0 + (i + 0.5) * 2.0 / rows
        rho = math.sqrt(1.0 - z * z)
        for j in range(columns):
            a = ((j + 0.5) / columns - 0.5) * 2.0 * math.pi
            total[i // fine, j // fine] += pdf(lights, (rho * math.cos(a), rho * math.sin(a), z))
    return total * (4.0 * math.pi / (rows * columns))


def p_value(counts, expected):
    """Return the chi-square probability; bins of less than 10 expected counts are taken together."""
    large = expected >= 10.0
    e = np.append(expected[large], expected[~large].sum())
    c = np.append(counts[large], counts[~large].sum())
    keep = e > 1.0
    return chi2.sf(((c - e)[keep] ** 2 / e[keep]).sum(), keep.sum() - 1)


CASES = {
    "environment": {"suns": ()},
    "suns": {"environment": None},
    "all": {},
    "one row": {"environment": sky()[:1], "suns": ()},
    "half the sky": {"environment": None, "suns": (((0.0, 0.0, -1.0), 180.0, (1.0, 1.0, 1.0)), WIDE)},
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_density_integrates_to_one_and_is_drawn(case):
    """Draws by chi-square against the stated density, whose integral is 1.

    Negative controls: two random numbers raised to the power 1.05, and the density of lights moved by 2 to 4 degrees.
    """
    lights = scene(**CASES[case])
    expected = masses(lights, 64)
    assert abs(expected.sum() - 1.0) < 1e-3
    u = np.random.default_rng(1).random((400_000, 3))
    counts = count(lights, u, 1.0)
    assert counts.sum() == len(u)
    assert p_value(counts, expected * len(u)) > 1e-3
    assert p_value(count(lights, u, 1.05), expected * len(u)) < 1e-6
    suns = tuple(((d[0], d[1] + 0.05, d[2]), *rest) for d, *rest in CASES[case].get("suns", (WIDE, NARROW, LOW)))
    turned = scene(**(CASES[case] | {"rotation_deg": 39.0, "suns": suns}))
    assert p_value(counts, masses(turned, 64) * len(u)) < 1e-6


@njit
def same_everywhere(lights, u):
    """Return the largest relative difference of what `draw` says and what `pdf` and `radiance` say of its direction."""
    worst = 0.0
    for i in range(len(u)):
        d, p, rgb = draw(lights, u[i, 0], u[i, 1], u[i, 2])
        worst = max(worst, abs(pdf(lights, d) / p - 1.0), abs(math.sqrt(dot(d, d)) - 1.0))
        full, half = radiance(lights, d, -1.0), radiance(lights, d, p)
        for c in range(3):
            scale = full[c] + 1e-9
            worst = max(worst, abs(full[c] - lights.constant[c] - rgb[c]) / scale)
            worst = max(worst, abs(half[c] - lights.constant[c] - 0.5 * rgb[c]) / scale)
    return worst


@pytest.mark.slow
def test_draw_pdf_and_radiance_agree():
    """The density of a draw is `pdf` there, its colour is `radiance` less the constant, and equal densities halve."""
    assert same_everywhere(scene(), np.random.default_rng(2).random((100_000, 3))) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("u", [0.0, 0.5, 1.0 - 2.0**-53])
def test_the_ends_of_the_random_numbers(u):
    """No random number leads to a light that is not there, or out of an array; a density of 0 brings no light."""
    edge = np.zeros((4, 8, 3))
    edge[0, 0] = edge[3, 7] = edge[2, 3] = 1.0
    dark = ((1.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0))
    for lights in (scene(), compile_lights(environment=edge), scene(suns=(dark, WIDE, dark))):
        for v in (0.0, 1.0 - 2.0**-53):
            for numbers in ((u, v, v), (v, u, v), (v, v, u), (u, u, u)):
                d, p, rgb = draw(lights, *numbers)
                assert np.isfinite([*d, p, *rgb]).all()
                assert p > 0.0 or rgb == (0.0, 0.0, 0.0)
                assert abs(np.linalg.norm(d) - 1.0) < 1e-12


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 9), (5, 1), (16, 32), (33, 70)])
def test_guides_lead_to_the_cell_that_a_search_finds(height, width):
    """Row and column of a draw are those of a search through the running sums, made here from the pixels.

    One pixel has nearly all light, some rows have none, so that many cells lie in one part of a guide.
    """
    pixels = sky(height, width) if height > 1 else sky(9, width)[:1] + 0.01
    pixels[0, width // 2] = 1e3
    lights = compile_lights(environment=pixels, contrast=0.0)
    aim = pixels @ LUMINANCE
    rows = np.cumsum(-np.diff(np.cos(np.linspace(0.0, math.pi, height + 1))) * aim.sum(axis=1))
    for u in np.random.default_rng(7).random((500, 3)) ** (1.0, 0.2, 1.0):  # most of the rows' numbers near 1
        x, y, z = draw(lights, *u)[0]
        row = np.searchsorted(rows, u[1] * rows[-1], side="right")
        column = np.searchsorted(np.cumsum(aim[row]), u[2] * aim[row].sum(), side="right")
        assert math.floor(math.acos(z) / math.pi * height) == row
        assert math.floor(-math.atan2(y, x) / (2.0 * math.pi) % 1.0 * width) == column


# ------------------------------------------------------------------------------------------ irradiance


@njit
def estimates(lights, n, u):
    """Return per sample the irradiance on a surface by four routes, (4, samples, 3).

    0: by `draw`; 1: by uniform directions at full weight; 2: by both, each with its weight; 3: by both, not weighted.
    """
    out = np.zeros((4, len(u), 3))
    uniform = 1.0 / (4.0 * math.pi)
    for i in range(len(u)):
        d, p, rgb = draw(lights, u[i, 0], u[i, 1], u[i, 2])
        cosine = max(0.0, dot(d, n))
        z = 1.0 - 2.0 * u[i, 3]
        c, s = turn(u[i, 4])
        rho = math.sqrt(1.0 - z * z)
        away = (rho * c, rho * s, z)
        far = max(0.0, dot(away, n)) / uniform
        full, weighted = radiance(lights, away, -1.0), radiance(lights, away, uniform)
        for k in range(3):
            nee = rgb[k] * cosine / p
            constant = lights.constant[k] * math.pi
            out[0, i, k] = nee + constant
            out[1, i, k] = full[k] * far
            out[2, i, k] = nee * p / (p + uniform) + weighted[k] * far
            out[3, i, k] = nee + full[k] * far
    return out


def quadrature(n, constant, environment, rotation_deg, suns, fine=60):
    """Return the irradiance from the meaning of the arguments alone, without anything of the module under test."""
    height, width = environment.shape[:2]
    polar = np.linspace(0.0, math.pi, height * fine + 1)
    mid = 0.5 * (polar[1:] + polar[:-1])
    azimuth = -(np.arange(width * fine) + 0.5) / (width * fine) * 2.0 * math.pi + math.radians(rotation_deg)
    x = np.sin(mid)[:, None] * np.cos(azimuth)
    y = np.sin(mid)[:, None] * np.sin(azimuth)
    cosine = np.maximum(n[0] * x + n[1] * y + n[2] * np.cos(mid)[:, None], 0.0)
    cosine *= -np.diff(np.cos(polar))[:, None] * 2.0 * math.pi / (width * fine)
    per_pixel = cosine.reshape(height, fine, width, fine).sum(axis=(1, 3))
    total = np.pi * np.array(constant) + np.einsum("ij,ijk->k", per_pixel, environment)
    for direction, diameter_deg, irradiance in suns:
        tilt = math.acos(np.dot(direction, n) / np.linalg.norm(direction))
        half = math.radians(diameter_deg) / 2.0
        if tilt + half <= math.pi / 2.0:
            total += math.cos(tilt) * np.array(irradiance)  # a disc wholly above the horizon
        else:
            assert tilt - half >= math.pi / 2.0, "choose a disc that the horizon does not cut"
    return total


@pytest.mark.slow
@pytest.mark.parametrize("n", [(0.0, 0.0, 1.0), (0.6, -0.48, 0.64), (-0.36, 0.48, -0.8)])
def test_every_route_to_the_irradiance_agrees(n):
    """Draws, uniform directions, both weighted, and quadrature agree within 4.5 standard errors of the data.

    Twelve colours and routes a surface, three surfaces: one false alarm in 4,000 runs. Negative controls: both routes
    added without weights, and the quadrature of a sky turned the other way.
    """
    low = ((-0.36, 0.48, -0.8), 25.0, (2.0, 0.0, 1.0))
    options = {
        "constant": (0.1, 0.2, 0.4),
        "environment": sky(),
        "rotation_deg": 37.0,
        "suns": (((0.3, -0.9, 1.0), 30.0, (3.0, 2.0, 1.0)), low),
    }
    u = np.random.default_rng(3).random((300_000, 5))
    expected = quadrature(n, **options)
    for contrast in (0.5, 0.0):  # draws alone find all light only if all is aimed at
        found = estimates(compile_lights(**options, contrast=contrast), n, u)
        mean, error = found.mean(axis=1), found.std(axis=1) / math.sqrt(found.shape[1])
        deviation = (mean - expected) / error
        assert np.abs(deviation[1 if contrast else 0 : 3]).max() < 4.5
    assert np.abs(deviation[3]).min() > 20.0
    mirrored = quadrature(n, **(options | {"rotation_deg": -37.0}))
    if n != (0.0, 0.0, 1.0):  # which a turn does not change
        assert np.abs((mean - mirrored) / error)[0].max() > 20.0


@pytest.mark.parametrize("diameter_deg", [180.0, 30.0, 0.53, 1e-3, 1e-6])
def test_a_sun_gives_exactly_its_irradiance(diameter_deg):
    """On a facing surface by draws, within 4.5 standard errors or rounding, however small; all within the disc.

    The radiance is E / (pi sin^2 a), and the disc ends at its half angle a.
    """
    direction = (1.0, -2.0, 3.0)
    lights = compile_lights(suns=[(direction, diameter_deg, (3.0, 2.0, 1.0))])
    n = tuple(np.array(direction) / math.sqrt(14.0))
    u = np.random.default_rng(4).random((100_000, 5))
    found = estimates(lights, n, u)[0]
    error = found.std(axis=0) / math.sqrt(len(u))
    assert np.all(np.abs(found.mean(axis=0) - (3.0, 2.0, 1.0)) < 4.5 * error + 1e-6)
    half = math.radians(diameter_deg) / 2.0
    assert radiance(lights, n, -1.0) == pytest.approx(np.array([3.0, 2.0, 1.0]) / (math.pi * math.sin(half) ** 2))
    s = np.cross(n, (0.0, 0.0, 1.0))
    s /= np.linalg.norm(s)
    for angle, lit in [(0.99 * half, True), (1.01 * half, False)]:
        beside = tuple(np.cos(angle) * np.array(n) + np.sin(angle) * s)
        assert (radiance(lights, beside, -1.0)[0] > 0.0) == (pdf(lights, beside) > 0.0) == lit


# ----------------------------------------------------------------------------------------- orientation


def toward(polar_deg, azimuth_deg):
    p, a = math.radians(polar_deg), math.radians(azimuth_deg)
    return math.sin(p) * math.cos(a), math.sin(p) * math.sin(a), math.cos(p)


def latlong(x, y, z, width, height):
    """Return column and row of a direction by ImfEnvmap.h (LatLongMap), in pixels from the left and upper edge.

    Its world is y-up: latitude is the angle to the plane y = 0, longitude is 0 along +z and 90 degrees along +x; the
    image goes from longitude +pi at the left to -pi, from latitude +pi/2 at the top to -pi/2.
    """
    latitude = math.atan2(y, math.hypot(x, z))
    longitude = math.atan2(x, z)
    return (0.5 - longitude / (2.0 * math.pi)) * width, (0.5 - latitude / math.pi) * height


def test_columns_are_those_of_openexr():
    """Each direction finds the pixel that the definition of OpenEXR gives, whose -z, -x, y are our x, y, z.

    Pixels there are constant, so that those within 1e-6 of an edge are left out. Negative control: columns that run the
    other way, as a mirror image has them.
    """
    height, width = 6, 14
    pixels = 1.0 + np.arange(height * width * 3.0).reshape(height, width, 3)
    lights = compile_lights(environment=pixels)
    ways = np.random.default_rng(8).normal(size=(2000, 3))
    wrong = mirrored = 0
    for x, y, z in ways / np.linalg.norm(ways, axis=1, keepdims=True):
        column, row = latlong(-y, z, -x, width, height)
        if min(column % 1.0, -column % 1.0, row % 1.0, -row % 1.0) > 1e-6:
            found = radiance(lights, (x, y, z), -1.0)
            wrong += found != tuple(pixels[int(row), int(column)])
            mirrored += found == tuple(pixels[int(row), width - 1 - int(column)])
    assert wrong == 0
    assert mirrored < 200


@pytest.mark.parametrize("rotation_deg", [0.0, 30.0, -30.0, 300.0, 765.0])
def test_where_a_pixel_is(rotation_deg):
    """One bright pixel, row 1 of 4 and column 5 of 8: polar angle 45 to 90, azimuth 90 to 135 degrees from +x to +y.

    A rotation adds to the azimuth. Looked at from inside and outside of each edge, and every draw lies in it; mirror
    images are dark.
    """
    pixels = np.zeros((4, 8, 3))
    pixels[1, 5] = 1e6, 2e6, 3e6
    lights = compile_lights(environment=pixels, rotation_deg=rotation_deg)

    def bright(polar_deg, azimuth_deg):
        return radiance(lights, toward(polar_deg, azimuth_deg + rotation_deg), -1.0) == (1e6, 2e6, 3e6)

    assert bright(67.5, 112.5) and bright(46, 91) and bright(89, 134) and bright(46, 134) and bright(89, 91)
    assert not any(bright(*at) for at in [(44, 112), (91, 112), (67, 89), (67, 136)])
    assert not any(bright(*at) for at in [(112.5, 112.5), (67.5, -112.5), (67.5, 67.5), (67.5, 292.5)])
    solid_angle = math.cos(math.radians(45)) * math.pi / 4
    for u in np.random.default_rng(6).random((1000, 3)):
        d, p, rgb = draw(lights, *u)
        azimuth = (math.degrees(math.atan2(d[1], d[0])) - rotation_deg) % 360.0
        assert 45.0 <= math.degrees(math.acos(d[2])) <= 90.0 and 90.0 <= azimuth <= 135.0
        assert p == pytest.approx(1.0 / solid_angle) and rgb == (1e6, 2e6, 3e6)


def test_up_is_row_0_and_suns_are_not_turned():
    """The zenith is row 0, the nadir the last; the rotation is the environment's alone."""
    pixels = np.ones((2, 4, 3)) * np.array([4.0, 1.0])[:, None, None]
    lights = compile_lights(environment=pixels, rotation_deg=90.0, suns=[((1.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))])
    assert radiance(lights, (0.0, 0.0, 1.0), -1.0)[0] == 4.0
    assert radiance(lights, (0.0, 0.0, -1.0), -1.0)[0] == 1.0
    assert radiance(lights, (1.0, 0.0, 0.0), -1.0)[0] > 1e3
    assert radiance(lights, (0.0, 1.0, 0.0), -1.0)[0] <= 4.0


# -------------------------------------------------------------------------------------- bounds, errors


def test_only_a_constant_is_not_drawn():
    """A constant counts in full whatever the weight, and nothing is drawn."""
    lights = compile_lights(constant=(1.0, 2.0, 3.0))
    assert not lights.sampled and scene().sampled
    assert pdf(lights, (0.0, 0.0, 1.0)) == 0.0
    for weight_pdf in (-1.0, 0.0, 2.0):
        assert radiance(lights, (0.0, 0.6, 0.8), weight_pdf) == (1.0, 2.0, 3.0)
    assert draw(lights, 0.5, 0.5, 0.5)[2] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("where", ["environment", "sun"])
def test_weights(where):
    """The balance heuristic by hand; -1 is full weight, 0 is none."""
    other = {"suns": ()} if where == "environment" else {"environment": None}
    lights = scene(constant=(0.5, 0.5, 0.5), **other)
    d, p, rgb = draw(lights, 0.9, 0.3, 0.4)
    for weight_pdf, weight in [(-1.0, 1.0), (0.0, 0.0), (p, 0.5), (3.0 * p, 0.75)]:
        assert radiance(lights, d, weight_pdf) == pytest.approx(0.5 + weight * np.array(rgb))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "a scene without light"),
        ({"environment": np.zeros((2, 2, 3)), "suns": [((0, 0, 1), 1, (0, 0, 0))]}, "a scene without light"),
        ({"constant": (1, -1, 1)}, "constant light must be finite and not negative, got -1"),
        ({"constant": (1, math.nan, 1)}, "got nan"),
        ({"constant": 1.0}, "three numbers"),
        ({"environment": np.ones((2, 2))}, r"must have the shape \(h, w, 3\)"),
        ({"environment": np.ones((0, 2, 3))}, r"must have the shape \(h, w, 3\)"),
        (
            {"environment": -np.ones((2, 2, 3))},
            "environment must be finite and not negative, got -1 at row 0, column 0",
        ),
        ({"environment": np.full((2, 2, 3), 1e308)}, "too bright"),
        ({"environment": np.ones((2, 2, 3)), "rotation_deg": math.inf}, "rotation"),
        ({"suns": [((0, 0, 0), 1, (1, 1, 1))]}, "the direction of sun 1"),
        ({"suns": [WIDE, ((0, math.nan, 1), 1, (1, 1, 1))]}, "the direction of sun 2"),
        ({"suns": [((0, 1), 1, (1, 1, 1))]}, "the direction of sun 1"),
        ({"suns": [((0, 0, 1), 0, (1, 1, 1))]}, "a zero-area light"),
        ({"suns": [((0, 0, 1), -1, (1, 1, 1))]}, "a zero-area light"),
        ({"suns": [((0, 0, 1), math.nan, (1, 1, 1))]}, "to 180 degrees, got nan"),
        ({"suns": [((0, 0, 1), 181, (1, 1, 1))]}, "to 180 degrees, got 181"),
        ({"suns": [((0, 0, 1), 1, (1, -1, 1))]}, "irradiance of sun 1 must be finite and not negative"),
        ({"suns": [((0, 0, 1), 1, (1e308, 1, 1))]}, "too bright"),
    ],
)
def test_what_is_no_light(options, says):
    """One line that says what is wrong."""
    with pytest.raises(UsageError, match=says) as caught:
        compile_lights(**options)
    assert "\n" not in str(caught.value)


def test_long_and_short_sun_directions():
    """Only the direction of the vector counts, up to the ends of the range of numbers."""
    expected = compile_lights(suns=[((1, 2, 2), 1, (1, 1, 1))]).sun_direction
    for scale in (1e-300, 1e300):
        lights = compile_lights(suns=[((scale, 2 * scale, 2 * scale), 1, (1, 1, 1))])
        assert np.allclose(lights.sun_direction, expected, rtol=1e-15)
