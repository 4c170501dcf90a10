"""Draws from tables follow the tables: each axis by chi-square, edges of the unit interval, geometry, mixtures."""

import math
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from tsdf.data import format as tsdf_format
from tsdf.data.sampler import (
    Sampler,
    column_of,
    compile_tables,
    density,
    draw_column,
    draw_length,
    draw_offset,
    draw_record,
    outgoing,
    turned,
)
from tsdf.data.table import Table, thawed
from tsdf.errors import UsageError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Build, Effort, exact_sphere

GOLDEN = Path(tsdf_format.__file__).parents[2] / "reference_data" / "golden" / "valid"
AXES = {"p_r": ("r", 2), "p_z": ("z", 3), "p_phi": ("phi_delta", 4), "p_l": ("path_length", 5)}
ALPHA = 0.01
N = 1_000_000
BELOW_1 = (float(np.nextafter(np.float32(1), np.float32(0))), math.nextafter(1.0, 0.0))


@pytest.fixture(scope="module")
def cube():
    """Both atoms, no empty column, records."""
    grain = load_grain("cube")
    build = Build.start(grain, Optics(1.31), Effort(paths=100_000, joint=32))
    build.run(grain)
    return build.table()


@pytest.fixture(scope="module")
def sphere():
    """No atom, phi_delta in two cells only, many cells without mass, records, other columns than the cube's."""
    return exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64, joint=16))


def made_up(columns, rows, seed, zeros=0.0, even=False):
    """Return a table of random masses, a share of them zero, the ends of each axis among them."""
    rng = np.random.default_rng(seed)
    cosines = -np.cos(np.pi * np.linspace(0.0, 1.0, columns - 1) ** 1.3)
    spans = {"p_phi": (-0.3, 2.0 * math.pi - 0.3), "p_r": (0.0, 2.0), "p_z": (-1.0, 2.0), "p_l": (0.0, 7.0)}
    blocks, pixels, first = [{"name": "p_theta", "first_row": 0, "rows": 1}], [], 1

    def masses(count):
        drawn = np.ones(count) if even else rng.random(count) ** 3
        drawn[rng.random(count) < zeros] = 0.0
        if zeros and count > 4:
            drawn[[0, -1]] = 0.0
        drawn[count // 2] += drawn.sum() == 0.0
        return drawn / drawn.sum()

    p_theta = masses(columns)
    for name, (low, high) in spans.items():
        inner = np.linspace(low, high, rows + (name != "p_l"))
        edges = np.concatenate(([0.0], inner)) if name == "p_l" else inner
        blocks.append({"name": name, "first_row": first, "rows": rows, "edges": edges.tolist()})
        first += rows
        pixels.append(np.stack([masses(rows) * (p > 0.0) for p in p_theta], axis=1))
    header = {
        "blocks": blocks,
        "columns": {"edges": [-1.0, *cosines.tolist(), 1.0]},
        "grain": {"name": "made up"},
        "optics": {"eta": 1.3},
    }
    return Table(header, np.concatenate([p_theta[None], *pixels]))


def changed(table, name, masses):
    """Return the table with other masses in one block."""
    pixels = table.pixels.copy()
    entry = next(b for b in table.header["blocks"] if b["name"] == name)
    pixels[entry["first_row"] : entry["first_row"] + entry["rows"]] = masses
    return Table(thawed(table.header), pixels)


def normal(masses):
    return masses.astype(np.float64) / masses.astype(np.float64).sum(axis=0)


def half_cells(edges, values):
    """Return in which half of which cell each value lies, as 2 cell + half; atoms hold what equals them."""
    cell = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    if edges[0] == edges[1]:
        cell[values == edges[0]] = 0
    return 2 * cell + (values > 0.5 * (edges[cell] + edges[cell + 1]))


def chi_square(edges, masses, values):
    """Return the p-value of values against masses of cells, uniform in each cell, rare cells taken together."""
    from scipy.stats import chi2

    expected = np.repeat(masses / masses.sum(), 2) * 0.5 * len(values)
    for atom in np.flatnonzero(np.diff(edges) == 0.0):
        expected[2 * atom : 2 * atom + 2] = 2.0 * expected[2 * atom], 0.0
    counts = np.bincount(half_cells(edges, values), minlength=len(expected))
    rare = expected < 10.0
    if rare.any():
        expected = np.append(expected[~rare], expected[rare].sum() + 1e-9)
        counts = np.append(counts[~rare], counts[rare].sum())
    statistic = ((counts - expected) ** 2 / np.maximum(expected, 1.0)).sum()
    return chi2.sf(statistic, max(1, len(expected) - 1))


def in_column(table, sampler, column, seed):
    """Return samples of one column."""
    u = np.random.default_rng(seed).random((N // 4, 6))
    sums = np.insert(np.cumsum(normal(table.p_theta)), 0, 0.0)
    u[:, 1] = 0.5 * (sums[column] + sums[column + 1])
    samples = sampler.sample(u)
    assert (samples.column == column).all()
    return samples


def p_values(table, sampler, seed=1, columns=None):
    """Return the p-values of theta, of the marginals, and of all conditionals in some columns, against the table."""
    samples = sampler.sample(np.random.default_rng(seed).random((N, 6)))
    p = normal(table.p_theta)
    found = {"p_theta": chi_square(table.cos_theta_edges, p, samples.cos_theta)}
    for name, (field, _) in AXES.items():
        found[name] = chi_square(table.edges(name), normal_columns(table, name) @ p, getattr(samples, field))
    found["phi_d"] = chi_square(np.linspace(0.0, 2.0 * math.pi, 33), np.ones(32), samples.phi_d)
    columns = columns or sorted({0, len(p) - 1, 1, int(np.argmax(p[1:-1])) + 1, len(p) // 2} & {*np.flatnonzero(p)})
    for column in columns:
        own = in_column(table, sampler, column, seed + column)
        for name, (field, _) in AXES.items():
            masses = normal_columns(table, name)[:, column]
            found[f"{name} {column}"] = chi_square(table.edges(name), masses, getattr(own, field))
    return found


def normal_columns(table, name):
    masses = table.block(name).astype(np.float64)
    return masses / np.maximum(masses.sum(axis=0), 1e-300)


def split(found, name):
    """Return the p-values of one block and those of the others."""
    own = {key: p for key, p in found.items() if key.split()[0] == name}
    return own, {key: p for key, p in found.items() if key not in own}


def accepted(found):
    """Tell whether the smallest of m p-values is above Sidak's limit."""
    return min(found.values()) > 1.0 - (1.0 - ALPHA) ** (1.0 / len(found))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cube", "sphere", "made up"])
def test_every_axis_follows_the_table(kind, request):
    """chi-square of theta with its atoms, the marginals, and each conditional in several columns, Sidak-corrected.

    Cells are tested by halves, so that the place within a cell is tested as well.
    """
    table = made_up(40, 300, 3, zeros=0.5) if kind == "made up" else request.getfixturevalue(kind)
    found = p_values(table, Sampler(table))
    assert accepted(found), found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["p_theta", *AXES])
def test_a_bias_of_two_percent_is_seen(name):
    """The negative control: masses of every other cell 2 % up, the rest down, in one block at a time; the others pass.

    Power: a bias e of all cells adds n e^2 = 400 (n = 1e6, e = 0.02) to a chi-square of at most 127 degrees of
    freedom, whose standard deviation is 16.
    """
    table = made_up(64, 64, 4, even=True)
    masses = table.block(name)
    sign = np.where(np.arange(64) % 2, 1.0, -1.0)
    biased = changed(table, name, masses * (1.0 + 0.02 * (sign if name == "p_theta" else sign[:, None])))
    own, others = split(p_values(table, Sampler(biased), columns=(20,)), name)
    assert not accepted(own) and accepted(others)


@pytest.mark.parametrize("columns, rows, zeros", [(8, 2, 0.0), (8, 9, 0.6), (258, 100, 0.9), (1024, 17, 0.5)])
def test_draws_invert_the_cumulative_masses(columns, rows, zeros):
    """A draw rises with u and is np.interp's, at random and at the limits of all cells and just beside them.

    The reference is float64; conditionals are stored to 2^-32, so a draw lies between those of u -+ 2^-31.
    """
    table = made_up(columns, rows, columns, zeros)
    sampler = Sampler(table)
    p = normal(table.p_theta)
    column = int(np.argmax(p))
    sums = np.insert(np.cumsum(p), 0, 0.0)

    def inverse(edges, masses, u):
        own = np.insert(np.cumsum(masses), 0, 0.0)
        u = np.clip(u, 0.0, np.nextafter(own[-1], 0.0))
        k = np.searchsorted(own, u, side="right") - 1
        return edges[k] + (u - own[k]) / masses[k] * np.diff(edges)[k]

    for name, index in [("p_theta", 1), *((name, i) for name, (_, i) in AXES.items())]:
        masses = p if index == 1 else normal_columns(table, name)[:, column]
        edges = table.cos_theta_edges if index == 1 else table.edges(name)
        limits = np.cumsum(masses)
        places = (limits, np.nextafter(limits, 0.0), np.nextafter(limits, 1.0), [0.0, 5e-324, *BELOW_1])
        given = np.concatenate((*places, np.random.default_rng(5).random(20_000)))
        u = np.full(((given < 1.0).sum(), 6), 0.5)
        u[:, 1] = 0.5 * (sums[column] + sums[column + 1])
        u[:, index] = np.sort(given[given < 1.0])
        samples = sampler.sample(u)
        drawn = samples.cos_theta if index == 1 else getattr(samples, AXES[name][0])
        assert (np.diff(drawn) >= 0.0).all(), f"{name} does not rise with u"
        doubt = 1e-12 if index == 1 else 2.0**-31
        assert (drawn >= inverse(edges, masses, u[:, index] - doubt) - 1e-12).all(), name
        assert (drawn <= inverse(edges, masses, u[:, index] + doubt) + 1e-12).all(), name


def has_mass(edges, masses, values):
    """Tell of each value whether it lies in a closed cell with mass."""
    inside = (values[:, None] >= edges[:-1]) & (values[:, None] <= edges[1:])
    return (inside & (masses > 0.0)).any(axis=1)


def test_no_cell_without_mass_is_drawn():
    """Four fifths of the cells and columns are empty, at both ends and in runs; u on the limits of the unit interval.

    The cells are told from the values alone; all columns that can be drawn are.
    """
    for table in (made_up(64, 30, 7, zeros=0.8), tsdf_format.read(GOLDEN / "empty_columns.tsdf.exr")):
        sampler = Sampler(table)
        p = table.p_theta
        u = np.random.default_rng(8).random((100_000, 6))
        ends = np.array([0.0, 5e-324, 2.0**-53, *BELOW_1])
        u[:10_000, 2:] = np.random.default_rng(9).choice(ends, (10_000, 4))
        u[10_000:10_005, 1] = ends
        samples = sampler.sample(u)
        assert (p[samples.column] > 0.0).all()
        assert set(samples.column) == set(np.flatnonzero(p))
        assert samples.column[10_000] == np.flatnonzero(p)[0] and samples.column[10_004] == np.flatnonzero(p)[-1]
        for column in np.unique(samples.column):
            own = samples.column == column
            for name, (field, _) in AXES.items():
                assert has_mass(table.edges(name), table.block(name)[:, column], getattr(samples, field)[own]).all()
            assert has_mass(table.cos_theta_edges, p * (np.arange(len(p)) == column), samples.cos_theta[own]).all()


@pytest.mark.slow
def test_float32_numbers_are_taken_as_they_are(cube):
    """float32 random numbers, the largest below 1 among them, give what the same numbers in float64 give."""
    u = np.random.default_rng(10).random((1000, 6), dtype=np.float32)
    u[:6][np.eye(6, dtype=bool)] = np.float32(BELOW_1[0])
    for narrow, wide in zip(Sampler(cube).sample(u), Sampler(cube).sample(u.astype(np.float64)), strict=True):
        np.testing.assert_array_equal(narrow, wide)


@pytest.mark.slow
def test_density(cube, sphere):
    """The density integrates to 1 minus the atoms, agrees with a histogram of samples, and has no atom in it."""
    for table in (cube, sphere):
        sampler = Sampler(table)
        edges, p = table.cos_theta_edges, normal(table.p_theta)
        middles = 0.5 * (edges[1:] + edges[:-1])
        found = sampler.density(middles)
        assert sampler.atoms == pytest.approx((p[0], p[-1]), abs=0.0, rel=1e-12)
        assert found[1:-1] @ np.diff(edges)[1:-1] == pytest.approx(1.0 - sum(sampler.atoms), rel=1e-12)
        np.testing.assert_allclose(sampler.density_solid_angle(middles) * 2.0 * math.pi, found, rtol=1e-15)
        # on a limit a cosine belongs to the cell above; the limits at the ends, to the cells inside
        inside = np.diff(edges)[1:-1]
        np.testing.assert_allclose(sampler.density(edges[1:-2]), p[1:-1] / inside, rtol=1e-12)
        np.testing.assert_allclose(sampler.density(np.nextafter(edges[2:-1], -1.0)), p[1:-1] / inside, rtol=1e-12)
        assert sampler.density(1.0) == pytest.approx(p[-2] / inside[-1])
        samples = sampler.sample(np.random.default_rng(11).random((N, 6)))
        atoms = np.isin(samples.column, (0, len(p) - 1))
        assert abs(atoms.mean() - sum(sampler.atoms)) <= 4.0 * math.sqrt(sum(sampler.atoms) / N)
        coarse = np.linspace(-1.0, 1.0, 21)
        counts = np.histogram(samples.cos_theta[~atoms], coarse)[0]
        grid = np.linspace(-1.0, 1.0, 400_001)
        masses = sampler.density(0.5 * (grid[1:] + grid[:-1])).reshape(20, -1).mean(axis=1) * 0.1
        # the finest cells near +-1 are some grid steps wide; their density is integrated to a step's share
        assert (np.abs(counts - N * masses) <= 5.0 * np.sqrt(N * masses) + 2e-3 * N * masses + 5.0).all()


def test_mean_cosine(cube, sphere):
    """The mean cosine of samples is the header's, which no cell has touched, within the cells' half widths."""
    for table in (cube, sphere):
        samples = Sampler(table).sample(np.random.default_rng(12).random((N, 6)))
        noise = 4.0 * samples.cos_theta.std() / math.sqrt(N)
        allowed = 0.5 * np.diff(table.cos_theta_edges) @ normal(table.p_theta)
        assert abs(samples.cos_theta.mean() - table.mean_cosine()) <= allowed + noise


def correlations(samples, columns):
    return np.array(
        [np.corrcoef(samples.r[samples.column == c], samples.z[samples.column == c])[0, 1] for c in columns]
    )


@pytest.mark.slow
def test_joint_records_keep_what_belongs_together(cube, sphere):
    """corr(r, z | theta) of joint samples is that of the traced records; factorised samples have none.

    Tolerances are 5 standard errors of a correlation of n pairs, 1/sqrt(n). Most of the sphere's correlations are five
    times that, so a sampler that mixes records up fails.
    """
    u = np.random.default_rng(13).random((N, 6))
    for table in (cube, sphere):
        joint, apart = Sampler(table, joint=True).sample(u), Sampler(table).sample(u)
        np.testing.assert_array_equal(joint.cos_theta, apart.cos_theta)
        columns = np.argsort(table.p_theta)[-20:]
        tolerance = 5.0 / np.sqrt(np.bincount(joint.column)[columns])
        traced = np.array([np.corrcoef(table.joint["r"][:, c], table.joint["z"][:, c])[0, 1] for c in columns])
        assert (np.abs(correlations(joint, columns) - traced) <= tolerance).all()
        assert (np.abs(correlations(apart, columns)) <= tolerance).all()
    assert (np.abs(traced) > 5.0 * tolerance).sum() > 10


@pytest.mark.slow
def test_records_are_equally_likely_and_whole(cube, sphere):
    """Each record of a column is drawn as often, with all its fields, and the ends of u give the first and last."""
    for table in (cube, sphere):
        column = int(np.argmax(table.p_theta))
        fields = np.stack([table.joint[name][:, column] for name in ("r", "z", "phi_delta", "l")], axis=1)
        samples = in_column(table, Sampler(table, joint=True), column, 14)
        drawn = np.stack([samples.r, samples.z, samples.phi_delta, samples.path_length], axis=1)
        records, counts = np.unique(drawn, axis=0, return_counts=True)
        known, copies = np.unique(fields.astype(np.float64), axis=0, return_counts=True)
        np.testing.assert_array_equal(records, known)
        expected = copies / len(fields) * len(drawn)
        assert (np.abs(counts - expected) <= 5.0 * np.sqrt(expected)).all()
        u = np.full((3, 6), 0.5)
        u[:, 1] = Sampler(table).tables.theta[0, column : column + 2].mean()
        u[:, 2] = 0.0, *BELOW_1
        np.testing.assert_array_equal(Sampler(table, joint=True).sample(u).r, fields[[0, -1, -1], 0])


@pytest.mark.slow
def test_geometry():
    """d_out and the offset have the cosine, z, r and azimuth that were drawn, for any d_in.

    Two routes: the scalar definitions of SPEC.md, and rotations about d_in as Algorithm 1 writes them. phi_delta lies
    on one side only, so that a flipped sign fails, and the mirrored offset is shown to.
    """
    from scipy.spatial.transform import Rotation

    from tsdf.vectors import frame

    table = made_up(64, 20, 15)
    table = changed(table, "p_phi", np.where(np.arange(20) == 4, 1.0, 0.0)[:, None] * np.ones(64))  # 0.96 to 1.27
    rng = np.random.default_rng(16)
    d_in = rng.normal(size=(20_000, 3))
    d_in[:4] = [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]
    d_in /= np.linalg.norm(d_in, axis=1, keepdims=True)
    samples = Sampler(table).sample(rng.random((len(d_in), 6)))
    d_out, offset = outgoing(samples, d_in)
    np.testing.assert_allclose(np.linalg.norm(d_out, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose((d_in * d_out).sum(axis=1), samples.cos_theta, atol=1e-12)
    np.testing.assert_allclose((d_in * offset).sum(axis=1), samples.z, atol=1e-12)
    across = offset - samples.z[:, None] * d_in
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), samples.r, atol=1e-12)

    def azimuth(a, b):
        return np.arctan2((np.cross(a, b) * d_in).sum(axis=1), (a * b).sum(axis=1))

    seen = (np.abs(samples.cos_theta) < 0.999) & (samples.r > 1e-3)
    aside = d_out - samples.cos_theta[:, None] * d_in
    np.testing.assert_allclose(azimuth(aside, across)[seen], samples.phi_delta[seen], atol=1e-9)
    assert (np.abs(azimuth(across, aside) - samples.phi_delta)[seen] > 1.0).all()  # the control

    axis = np.array([frame(tuple(d))[0] for d in d_in])
    sin_theta = np.sqrt(1.0 - samples.cos_theta**2)
    turn = Rotation.from_rotvec(d_in * samples.phi_d[:, None])
    reference = turn.apply(samples.cos_theta[:, None] * d_in + sin_theta[:, None] * axis)
    np.testing.assert_allclose(d_out, reference, atol=1e-12)
    turn = Rotation.from_rotvec(d_in * (samples.phi_d + samples.phi_delta)[:, None])
    np.testing.assert_allclose(offset, turn.apply(samples.z[:, None] * d_in + samples.r[:, None] * axis), atol=1e-12)
    np.testing.assert_array_equal(outgoing(samples, [0, 0, 1.0]).d_out[:, 2], samples.cos_theta)


def test_turned_is_cosine_and_sine():
    """Cosine and sine of a turn against libm, to 1e-13, quarters and both ends included."""
    u = np.concatenate((np.linspace(0.0, 1.0, 10_001), BELOW_1, np.arange(9) / 8.0))
    found = np.array([turned(x) for x in u])
    np.testing.assert_allclose(found[:, 0], np.cos(2.0 * math.pi * u), atol=1e-13)
    np.testing.assert_allclose(found[:, 1], np.sin(2.0 * math.pi * u), atol=1e-13)


@njit
def _draw_all(tables, t, joint, u, out):
    for i in range(len(u)):
        column, cos_theta = draw_column(tables, t, u[i, 1])
        if joint:
            out[i, 2:6] = draw_record(tables, column, u[i, 2])
        else:
            out[i, 2:5] = draw_offset(tables, column, u[i, 2], u[i, 3], u[i, 4])
            out[i, 5] = draw_length(tables, column, u[i, 5])
        out[i, 0], out[i, 1] = column, cos_theta
        out[i, 6], out[i, 7] = column_of(tables, t, cos_theta), density(tables, column)


@pytest.mark.slow
def test_mixture(cube, sphere):
    """Tables of other sizes and edges, one after the other, each give what they give alone, for the same numbers."""
    u = np.random.default_rng(17).random((100_000, 6))
    golden = tsdf_format.read(GOLDEN / "records.tsdf.exr")
    for joint in (False, True):
        members = [sphere, cube, golden] + ([] if joint else [made_up(300, 300, 18)])
        tables = compile_tables(members, joint)
        assert all(array.flags.c_contiguous for array in tables)
        first = 0
        for t, table in enumerate(members):
            out = np.empty((len(u), 8))
            _draw_all(tables, t, joint, u, out)
            alone = Sampler(table, joint).sample(u)
            assert tables.first[t] == first
            np.testing.assert_array_equal(out[:, 0], alone.column + first)
            drawn = (alone.cos_theta, alone.r, alone.z, alone.phi_delta, alone.path_length)
            np.testing.assert_array_equal(out[:, 1:6], np.stack(drawn, axis=1))
            atoms = np.isin(alone.column, (0, len(table.p_theta) - 1))
            # a draw may round to the limit of its cell, which belongs to the next
            assert (out[:, 6] == out[:, 0])[~atoms].mean() > 0.9999
            np.testing.assert_array_equal(np.abs(out[:, 6] - out[:, 0])[atoms], 1.0)
            assert (out[atoms, 7] == 0.0).all() and (out[~atoms, 7] > 0.0).all()
            first += len(table.p_theta)


def test_bad_requests_are_refused(cube):
    """Whatever cannot be meant ends in one line that says the way out."""
    sampler, table = Sampler(cube), made_up(8, 4, 19)
    samples = sampler.sample(np.full((3, 6), 0.5))
    hollow = table.p_r * (np.arange(8) != 3)

    def numbers(value):
        u = np.full((3, 6), 0.5)
        u[1, 2] = value
        return u

    for attempt in [
        *(lambda bad=bad: sampler.sample(numbers(bad)) for bad in (1.0, -1e-9, np.nan, np.inf)),
        lambda: sampler.sample(np.full((3, 5), 0.5)),
        lambda: sampler.sample(np.full(6, 0.5)),
        lambda: sampler.sample("u"),
        lambda: sampler.sample(np.full((3, 6), 0.5 + 0.1j)),
        lambda: sampler.sample([[0.5] * 6, [0.5]]),
        lambda: sampler.density(1.1),
        lambda: sampler.density([0.0, np.nan]),
        lambda: outgoing(samples, [0.0, 0.0, 1.1]),
        lambda: outgoing(samples, [0.0, np.nan, 1.0]),
        lambda: outgoing(samples, np.ones((2, 3))),
        lambda: compile_tables([]),
        lambda: Sampler(table, joint=True),
        lambda: Sampler(changed(table, "p_r", hollow)),
        lambda: Sampler(changed(table, "p_theta", 0.0)),
        lambda: Sampler(changed(table, "p_z", -1.0)),
        lambda: Sampler(changed(table, "p_z", np.nan)),
    ]:
        with pytest.raises(UsageError) as caught:
            attempt()
        assert "\n" not in str(caught.value) and len(str(caught.value)) > 20
    assert len(sampler.sample(np.empty((0, 6))).r) == 0
    assert sampler.density(0.3).shape == () and sampler.density([[0.1, 0.2]]).shape == (1, 2)
