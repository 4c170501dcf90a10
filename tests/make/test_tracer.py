"""The tracer: numbers that do not depend on the way they are made, conventions by hand, physics by the exact sphere."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tsdf.data.blocks import MEMORY_FIELDS
from tsdf.grain.grains import Grain, embree_scene, first_hit, grain_from_mesh, load_grain
from tsdf.grain.horizon import horizon_of
from tsdf.judge import analytic
from tsdf.make import statistics
from tsdf.make import tally as T
from tsdf.make.counting import arc
from tsdf.make.records import entry_records_of
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer, in_order
from tsdf.sampling import SOBOL, key_of, sobol, turn


def traced(
    grain: Grain, paths: int | np.ndarray, joint: int = 0, eta: float = 1.33, memory: int = 0, **options: object
) -> Tally:
    tally = Tally(joint=joint, memory=memory)
    numbers = in_order(0, paths) if isinstance(paths, int) else paths
    Tracer(grain, eta, **options).trace(numbers, tally)  # type: ignore[arg-type]
    return tally


def assert_equal(one: Tally, other: Tally) -> None:
    for name, values in one.arrays().items():
        others = getattr(other, name)
        if name in T.RESERVOIRS:
            values, others = (np.sort(records[:, :, 0], axis=1) for records in (values, others))
        assert np.array_equal(values, others), name


# ------------------------------------------------------------------------------------------ numbers


def test_order_and_batches_do_not_show() -> None:
    """Any order, any split and any number of rays under way give the same counts to the last unit."""
    grain = load_grain("octahedron")
    whole = traced(grain, 20_000, joint=4, memory=4)
    shuffled = np.random.default_rng(0).permutation(20_000)
    assert_equal(traced(grain, shuffled, joint=4, memory=4), whole)
    assert_equal(traced(grain, 20_000, joint=4, memory=4, slots=100), whole)
    parts = traced(grain, np.arange(7_001), joint=4, memory=4)
    parts.add(traced(grain, np.arange(7_001, 20_000), joint=4, memory=4))
    assert_equal(parts, whole)
    assert not np.array_equal(traced(grain, 20_000, seed=1).theta, whole.theta)


def test_records_by_entry_change_nothing_else() -> None:
    """All other counts are the same to the last unit, and the energy by entry is that of the ledger."""
    grain = load_grain("cube")
    without, having = traced(grain, 20_000, joint=4), traced(grain, 20_000, joint=4, memory=8)
    for name in ("scalars", "theta", "cells", "box", "box_l", "records"):
        assert np.array_equal(getattr(without, name), getattr(having, name)), name
    assert without.entry.size == without.entry_records.size == 0
    s = having.scalars.sum(axis=0)
    assert np.array_equal(having.entry.sum(axis=1), s[[T.LAUNCHED, T.UNSCATTERED]])
    assert np.all(having.entry[1] <= having.entry[0]) and np.all(having.entry[1] >= 0)
    assert having.memory == T.LEAST


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "cube", "tetrahedron", "sand", "snow"])
@pytest.mark.parametrize("plain", [False, True])
def test_no_energy_is_made_or_lost(name: str, plain: bool) -> None:
    """launched = unscattered + scattered + truncated + lost, per replicate, and no more than 1e-6 of it is dropped.

    Of 30,000 paths a millionth is 0.03 paths: none may be lost, but for one at an edge of a sharp solid.
    """
    tally = traced(load_grain(name), 30_000, plain=plain)
    s = tally.scalars
    kept = s[:, [T.UNSCATTERED, T.SCATTERED, T.TRUNCATED, T.LOST]].sum(axis=1)
    assert np.array_equal(s[:, T.LAUNCHED], kept)
    assert s[:, T.LAUNCHED].sum() == 30_000 * T.UNIT
    assert np.array_equal(tally.theta.sum(axis=1), s[:, T.SCATTERED])
    assert tally.conditional("l").sum() == s[:, T.SCATTERED].sum()
    for offset in ("phi", "r", "z"):
        assert tally.conditional(offset).sum() == 2 * s[:, T.SCATTERED].sum()
    assert s[:, T.TRUNCATED].sum() == 0 and s[:, T.LOST].sum() <= T.UNIT


def test_a_bounce_limit_is_counted() -> None:
    tally = traced(load_grain("icosphere", subdivisions=3), 20_000, max_bounces=2)
    s = tally.scalars.sum(axis=0)
    assert 0 < s[T.TRUNCATED] < 0.1 * s[T.LAUNCHED]
    assert s[T.LAUNCHED] == s[T.UNSCATTERED] + s[T.SCATTERED] + s[T.TRUNCATED] + s[T.LOST]


def test_sobol_points_fill_the_boxes() -> None:
    """2^12 points, four dimensions: each box of volume 2^-12 of any shape with at most one direction per 2^6 holds one
    in the projections on two axes that make a (0, 12, 2)-net, the first two; other pairs are nearly as even.

    Unscrambled, the first points are those of Joe & Kuo 2008.
    """
    points = np.array([[sobol(i, d, np.uint32(77 + d), SOBOL) for d in range(4)] for i in range(1 << 12)])
    assert points.min() > 0.0 and points.max() < 1.0
    for k in range(13):
        boxes = (points[:, 0] * (1 << k)).astype(int) * (1 << (12 - k)) + (points[:, 1] * (1 << (12 - k))).astype(int)
        assert np.array_equal(np.sort(boxes), np.arange(1 << 12))
    for d in range(4):
        assert np.array_equal(np.sort((points[:, d] * (1 << 12)).astype(int)), np.arange(1 << 12))
    first = SOBOL.astype(np.float64) / 2.0**32
    assert np.array_equal(first[:, 0], [0.5] * 4)
    assert np.array_equal(first[1, :3], [0.5, 0.75, 0.625])


@pytest.mark.slow
def test_keys_and_angles() -> None:
    keys = {key_of(seed, a, b) for seed in range(10) for a in range(10) for b in range(10)}
    assert len(keys) == 1000
    angles = np.linspace(-math.pi + 1e-9, math.pi, 10_001)
    for angle in angles:
        assert arc(math.sin(angle), math.cos(angle)) == pytest.approx(angle, abs=1e-9)
        u = (angle / (2.0 * math.pi)) % 1.0
        assert turn(u) == pytest.approx((math.cos(angle), math.sin(angle)), abs=1e-11)
    assert arc(0.0, 0.0) == 0.0


# ------------------------------------------------------------------------------------------ geometry


def bumpy(seed: int) -> Grain:
    """A sphere with dents whose triangles are stretched: slender facets, gentle and steep hollows."""
    ball = load_grain("icosphere", subdivisions=3)
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(5, 3)) * 3.0, rng.uniform(0.0, 6.0, 5)
    height = 1.0 + 0.08 * np.cos(ball.vertices @ waves.T + phases).sum(axis=1)
    return grain_from_mesh(ball.vertices * height[:, None] * (1.0, 0.7, 0.25), ball.faces)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["snow", "sand", "bumpy 0", "bumpy 1"])
def test_nothing_stands_above_the_horizon(which: str) -> None:
    """Of 4e5 rays that leave facets above their horizon not one meets the grain; below it many do."""
    name, _, seed = which.partition(" ")
    grain = bumpy(int(seed)) if seed else load_grain(name, subdivisions=4)
    corners = grain.vertices[grain.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    planes = np.column_stack((normals, np.einsum("ij,ij->i", normals, corners.mean(axis=1))))
    horizon = horizon_of(grain.vertices, grain.faces, planes)
    rng = np.random.default_rng(1)
    facet = rng.integers(0, len(planes), 400_000)
    weights = rng.dirichlet((0.3, 0.3, 0.3), len(facet))  # mostly near edges and corners
    points = np.einsum("ij,ijk->ik", weights, corners[facet])
    ways = rng.normal(size=points.shape)
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    ways *= np.sign(np.einsum("ij,ij->i", ways, normals[facet]))[:, None]
    sine = np.einsum("ij,ij->i", ways, normals[facet])
    hit = first_hit(embree_scene(grain), points + 1e-5 * normals[facet], ways) >= 0
    above = (sine > horizon[facet]) | (horizon[facet] == 0.0)
    assert above.mean() > 0.1
    assert not hit[above].any()
    assert hit[~above].any()


@pytest.mark.slow
def test_one_ray_by_hand() -> None:
    """Records of the sphere obey Snell's law, in one plane, with the signs of SPEC.md.

    For light that enters at distance b off the axis and takes p chords, everything follows from b: deflection, offset
    and azimuths are computed here from the geometry of the plane, with the entry point up.
    """
    eta, count = 1.33, 16
    tally = traced(load_grain("sphere"), 20_000, joint=count, eta=eta)
    records = tally.records[np.isfinite(tally.records[:, :, 0])]
    checked = 0
    for _, _, r, z, phi_delta, length, b2, azimuth in records:
        chord = 2.0 * math.sqrt(1.0 - b2 / eta**2)
        order = round(length / chord)
        if order > 6 or abs(length - order * chord) > 1e-9:
            continue
        theta_i, theta_t = math.asin(math.sqrt(b2)), math.asin(math.sqrt(b2) / eta)
        turned = (
            math.pi - 2.0 * theta_i
            if order == 0
            else -2.0 * (theta_i - theta_t) - (order - 1) * (math.pi - 2.0 * theta_t)
        )
        out = np.array((math.cos(turned), math.sin(turned)))  # along d_in, towards the entry's side
        start = math.pi - theta_i
        end = start - order * (math.pi - 2.0 * theta_t)
        offset = np.array((math.cos(end) - math.cos(start), math.sin(end) - math.sin(start)))
        assert z == pytest.approx(offset[0], abs=1e-7) and r == pytest.approx(abs(offset[1]), abs=1e-7)
        if min(abs(out[1]), r) > 1e-6:
            assert abs(azimuth) == pytest.approx(0.0 if out[1] > 0.0 else math.pi, abs=1e-6)
            assert abs(phi_delta) == pytest.approx(0.0 if out[1] * offset[1] > 0.0 else math.pi, abs=1e-6)
            checked += 1
    assert checked > 5_000


def test_records_by_entry_by_hand() -> None:
    """As above for the records by entry: direction and exit follow from b and the number of chords.

    The exit normal is put together as SPEC.md says, and is where the chords end, on the sphere.
    """
    eta = 1.33
    tally = traced(load_grain("sphere"), 20_000, memory=16, eta=eta)
    records = tally.entry_records[np.isfinite(tally.entry_records[:, :, 0])]
    cell = np.broadcast_to(np.arange(T.COARSE)[:, None], tally.entry_records.shape[:2])
    cell = cell[np.isfinite(tally.entry_records[:, :, 0])]
    assert np.array_equal((records[:, 8] * T.COARSE).astype(int), cell)
    _, _, cos_theta, azimuth, r, z, phi_delta, length, b2 = records.T
    chord = 2.0 * np.sqrt(1.0 - b2 / eta**2)
    order = np.round(length / chord)
    assert np.abs(length - order * chord)[order < 50].max() < 1e-7
    theta_i, theta_t = np.arcsin(np.sqrt(b2)), np.arcsin(np.sqrt(b2) / eta)
    turned = np.where(
        order == 0, math.pi - 2.0 * theta_i, -2.0 * (theta_i - theta_t) - (order - 1.0) * (math.pi - 2.0 * theta_t)
    )
    sure = (np.abs(np.sin(turned)) > 1e-6) & (order < 10)  # where the side to which light leaves is one
    assert sure.sum() > 10_000
    assert np.abs(cos_theta - np.cos(turned))[order < 10].max() < 1e-7
    aside = np.sqrt(np.maximum(1.0 - cos_theta**2, 0.0)) * np.cos(azimuth)
    assert np.abs(aside - np.sin(turned))[sure].max() < 1e-6
    assert np.abs(np.sin(azimuth))[sure].max() < 1e-6
    b = np.sqrt(b2)
    normal = np.array((b + r * np.cos(azimuth + phi_delta), r * np.sin(azimuth + phi_delta), z - np.sqrt(1.0 - b2)))
    assert np.abs((normal**2).sum(axis=0) - 1.0).max() < 1e-9
    end = math.pi - theta_i - order * (math.pi - 2.0 * theta_t)
    assert np.abs(normal[2] - np.cos(end))[order < 10].max() < 1e-7
    assert np.abs(normal[0] - np.sin(end))[sure].max() < 1e-6


def cube_hits(b2: np.ndarray, seed: int) -> np.ndarray:
    """Return whether rays at distance b from the centre meet the cube, by slabs: no mesh, no ray engine."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(len(b2), 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    across = np.cross(d, rng.normal(size=d.shape))
    p = across * (np.sqrt(b2) / np.linalg.norm(across, axis=1))[:, None]
    one, other = (-1.0 / math.sqrt(3.0) - p) / d, (1.0 / math.sqrt(3.0) - p) / d
    hits: np.ndarray = np.minimum(one, other).max(axis=1) < np.maximum(one, other).min(axis=1)
    return hits


@pytest.mark.slow
def test_hits_by_entry_of_a_cube() -> None:
    """The share that meets a cube by distance from its centre, against slabs: 4 standard errors of both.

    In 33 cells, which do not end where those of the tally do. Control: one cell further out is rejected by far.
    """
    columns, rays, paths = 33, 40_000, 200_000
    hit = entry_records_of(traced(load_grain("cube"), paths, memory=1), columns, 1).hit
    u = (np.arange(columns * rays) + 0.5) / (columns * rays)
    expected = cube_hits(u, 3).reshape(columns, rays).mean(axis=1)
    spread = np.maximum(expected * (1.0 - expected), 1.0 / rays)
    error = np.sqrt(spread * (1.0 / rays + columns / paths))
    assert np.all(hit[: int(columns / 3.0)] == 1.0)  # within the inscribed sphere, b2 = 1/3
    assert np.abs((hit - expected) / error).max() < 4.0
    assert np.abs((hit[:-1] - expected[1:]) / error[1:]).max() > 15.0
    assert hit.mean() == pytest.approx(2.0 / math.pi, abs=4.0 * math.sqrt(spread.mean() / paths))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "cube", "snow"])
def test_as_much_light_enters_backwards_as_forwards(name: str) -> None:
    """What the records stand for is twice the light that met the grain in their cell: two unrelated counts.

    Reversed paths and the directions of a fan enter elsewhere than the ray that was sent, but as often. In 16 cells;
    a priority sample of K tells a sum to 1 / sqrt(K), or half as well as several records are of one path: 4 errors.
    Control: it is not the light that was sent, but where the grain fills its sphere.
    """
    count, cells = 32, 16
    tally = traced(load_grain(name), 200_000, memory=count, eta=1.31)
    keys, shares = tally.entry_records[:, :, 0], tally.entry_records[:, :, 1]
    threshold = keys.max(axis=1, keepdims=True)
    light = np.where(keys < threshold, np.maximum(shares, 1.0 / threshold), 0.0).sum(axis=1).reshape(cells, -1)
    sent, missed = tally.entry.reshape(2, cells, -1).sum(axis=2) / T.UNIT
    ratio = 0.5 * light.sum(axis=1) / (sent - missed)
    often = sent - missed > 0.05 * sent
    assert often.sum() >= 8
    error = 2.0 / math.sqrt(count * T.COARSE / cells)
    assert np.abs(ratio[often] - 1.0).max() < 4.0 * error
    if name != "sphere":
        assert np.abs(0.5 * light.sum(axis=1) / sent - 1.0)[often].max() > 10.0 * error


def by_entry(eta: float, columns: int) -> dict[str, np.ndarray]:
    """Return means of the exact sphere by cell of entry_b2, from the list of its events."""
    events = analytic.sphere_events(eta, "un", 16384)
    cell = np.minimum((events.entry_b2 * columns).astype(int), columns - 1)
    cosine = 0.5 * (events.cos_theta_from + events.cos_theta_to)
    values = {"cos_theta": cosine, "z": events.z, "r": events.r, "l": events.path_length}
    whole = np.bincount(cell, events.weight)
    return {name: np.bincount(cell, events.weight * value) / whole for name, value in values.items()}


@pytest.mark.slow
def test_records_by_entry_of_a_sphere() -> None:
    """Means by cell of entry_b2 against the exact sphere: each within 4.5 standard errors of K draws, 264 of them;
    mean square deviation below 1 and four of its errors (K draws from a sorted pool scatter less than unrelated ones).

    Control: a sphere of another eta is rejected.
    """
    columns, count = 66, 256
    records = entry_records_of(traced(load_grain("sphere"), 400_000, memory=count), columns, count).records
    squares = {}
    for eta in (1.33, 1.40):
        truth = by_entry(eta, columns)
        z = []
        for name, values in zip(MEMORY_FIELDS, records, strict=True):
            if name in truth:
                error = np.maximum(values.std(axis=0, ddof=1) / math.sqrt(count), 1e-3)
                z.append((values.mean(axis=0) - truth[name]) / error)
        squares[eta] = np.square(z).mean()
        if eta == 1.33:
            assert np.abs(z).max() < 4.5
    assert squares[1.33] < 1.0 + 4.0 * math.sqrt(2.0 / (4 * columns)) and squares[1.40] > 3.0, squares


@pytest.mark.slow
def test_handedness() -> None:
    """A grain and its mirror image have opposite azimuths: a propeller is not its own mirror image.

    The seed's phi_Delta has a sign, and a flipped one would pass every test on symmetric grains.
    """
    ball = load_grain("icosphere", subdivisions=4)
    x, y, z = (ball.vertices * (1.0, 0.4, 1.0)).T
    c, s = np.cos(1.2 * z), np.sin(1.2 * z)  # twist about z
    right = grain_from_mesh(np.column_stack((c * x - s * y, s * x + c * y, z)), ball.faces)
    left = grain_from_mesh(right.vertices * (-1.0, 1.0, 1.0), right.faces[:, ::-1])
    skew = []
    for grain in (right, left):
        phi = traced(grain, 200_000).conditional("phi").sum(axis=0).astype(float)
        middle = 0.5 * (T.PHI_EDGES[1:] + T.PHI_EDGES[:-1])
        skew.append(float((phi * np.sin(middle)).sum() / phi.sum()))
    assert abs(skew[0]) > 0.003
    assert skew[0] == pytest.approx(-skew[1], abs=0.3 * abs(skew[0]))


# ------------------------------------------------------------------------------------------ physics


def deviations(tally: Tally, eta: float, fresnel: str) -> tuple[np.ndarray, float]:
    """Return the statistics' deviations from the exact sphere [standard errors] and chi-square a cell.

    Cells are 64; the squared deviation in standard errors of 64 replicates is 63/61 on average.
    """
    truth = analytic.sphere_statistics(eta, fresnel)
    sums = np.concatenate((tally.scalars, tally.theta[:, T.FINE :]), axis=1)
    values, errors = statistics.jackknife(sums, statistics._scalar_statistics)
    at = [statistics.STATISTICS.index(name) for name in ("mean_cosine", "mean_z", "mean_r", "mean_path_length")]
    exact = np.array((truth.mean_cosine, truth.mean_z, truth.mean_r, truth.mean_path_length))
    columns = statistics.columns_of(tally.theta / tally.scalars[:, T.SCATTERED][:, None], 64)[:, 1:-1]
    masses = analytic.deflection_masses(statistics.cos_theta_edges(64)[1:-1], eta, fresnel)
    z = (columns.mean(axis=0) - masses) / (columns.std(axis=0, ddof=1) / 8.0)
    return (values[at] - exact) / errors[at], float((z**2).mean() * 61.0 / 63.0)


@pytest.mark.parametrize(("eta", "fresnel"), [(1.33, "un"), (1.33, "sp"), (1.5, "un"), (0.75, "un")])
@pytest.mark.parametrize("plain", [False, True])
def test_traced_sphere_is_the_exact_sphere(eta: float, fresnel: str, plain: bool) -> None:
    """Every statistic within 4 standard errors; chi-square over 64 cells, whose own error is sqrt(2.2 / 64) = 0.19."""
    tally = traced(load_grain("sphere"), 400_000, eta=eta, fresnel=fresnel, plain=plain, seed=2)
    z, chi_square = deviations(tally, eta, fresnel)
    assert np.abs(z).max() < 4.0, z
    assert chi_square < 1.0 + 4.0 * 0.19


@pytest.mark.parametrize("scale", [0.98, 1.02])
def test_a_biased_tracer_is_rejected(scale: float) -> None:
    """Negative control: reflectance 2 % off fails both tests above by far."""
    z, chi_square = deviations(traced(load_grain("sphere"), 400_000, reflectance_scale=scale, seed=2), 1.33, "un")
    assert np.abs(z).max() > 8.0 and chi_square > 3.0


def test_conventions_are_told_apart() -> None:
    """Negative control: the traced sphere of one Fresnel convention is not the exact one of the other."""
    tally = traced(load_grain("sphere"), 400_000, fresnel="sp", seed=2)
    z, chi_square = deviations(tally, 1.33, "un")
    assert np.abs(z).max() > 8.0 and chi_square > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["snow", "hexprism"])
def test_both_estimators_agree(name: str) -> None:
    """Splitting, fans, horizons and Sobol' points change the noise and nothing else."""
    grain = load_grain(name)
    results = []
    for plain in (False, True):
        tally = traced(grain, 200_000, eta=1.31, plain=plain, seed=5)
        sums = np.concatenate((tally.scalars, tally.theta[:, T.FINE :]), axis=1)
        results.append(statistics.jackknife(sums, statistics._scalar_statistics))
    (ours, errors), (others, other_errors) = results
    differences = np.abs(ours - others) / np.maximum(np.hypot(errors, other_errors), 1e-12)
    assert differences[np.maximum(errors, other_errors) > 1e-9].max() < 4.0


@pytest.mark.slow
def test_a_cavity_refracts_as_one() -> None:
    """A ball of glass with a hollow of its own radius but a hair is an empty shell: light goes nearly straight on."""
    ball = load_grain("icosphere", subdivisions=4)
    inner = 0.98
    shell = grain_from_mesh(
        np.vstack((ball.vertices, inner * ball.vertices)),
        np.vstack((ball.faces, ball.faces[:, ::-1] + len(ball.vertices))),
    )
    assert shell.notes == ("1 cavity",)
    solid, hollow = (
        statistics._scalar_statistics(np.concatenate((t.scalars, t.theta[:, T.FINE :]), axis=1).sum(axis=0))
        for t in (traced(ball, 50_000), traced(shell, 50_000))
    )
    cosine, length = statistics.STATISTICS.index("mean_cosine"), statistics.STATISTICS.index("mean_path_length")
    assert hollow[length] < 0.25 * solid[length]
    # equilibrium: mean path length eta^2 V / (pi beta) or less where light is trapped
    assert hollow[length] < 1.33**2 * shell.volume / math.pi * 1.02
    assert hollow[cosine] > solid[cosine] - 0.1


def test_replicates_are_independent() -> None:
    """The spread of p_theta over replicates follows from the number of paths in each, for plain random numbers."""
    tally = traced(load_grain("cube"), 64 * 500, eta=1.31, plain=True)
    hits = 1.0 - tally.scalars[:, T.UNSCATTERED] / tally.scalars[:, T.LAUNCHED]
    expected = math.sqrt(0.63662 * (1 - 0.63662) / 500)
    assert hits.std(ddof=1) == pytest.approx(expected, rel=0.35)
    quiet = traced(load_grain("cube"), 64 * 512, eta=1.31)
    hits = 1.0 - quiet.scalars[:, T.UNSCATTERED] / quiet.scalars[:, T.LAUNCHED]
    assert hits.std(ddof=1) < 0.5 * expected


def test_the_name_of_a_grain_does_not_matter() -> None:
    grain = load_grain("tetrahedron")
    assert_equal(traced(grain, 5_000), traced(replace(grain, name="other"), 5_000))


@pytest.mark.parametrize("name", ["sphere", "cube"])
def test_weak_reflections_are_not_rounded_away(name: str) -> None:
    """What a surface of eta 1.0005 sends steeply back is less than a unit of energy of each path: in the mean it is
    Fresnel's all the same, under light from all sides, deflected by more than 3/4 pi. Light turned back inside is as
    much again, but met by one path in 10 million, whole."""
    eta, tally = 1.0005, Tally()
    Tracer(load_grain(name), eta).trace(in_order(0, 64_000), tally)
    cosines = (np.arange(200_000) + 0.5) / 200_000
    inside = np.sqrt(eta**2 - 1.0 + cosines**2)
    s, p = (cosines - inside) / (cosines + inside), (eta**2 * cosines - inside) / (eta**2 * cosines + inside)
    steep = cosines >= math.cos(math.pi / 8.0)  # light that is mirrored is deflected by pi - 2 theta_i
    expected = float((cosines * (s**2 + p**2))[steep].sum() / 200_000)
    back = tally.theta[:, 3 * T.FINE // 4 : T.FINE].sum(axis=1) + tally.theta[:, T.FINE + 1]
    share = back / tally.scalars[:, T.SCATTERED]
    error = share.std(ddof=1) / math.sqrt(T.REPLICATES)
    assert error < 0.05 * expected
    assert abs(share.mean() - expected) < 5.0 * error, (share.mean(), expected, error)
