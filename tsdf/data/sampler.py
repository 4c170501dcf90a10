"""Sampler of a table: Algorithm 1 of Meng et al. 2015, as numba kernels for a renderer and as arrays for a user.

Every cell is found by exact inversion of cumulative masses, so a draw is a monotone function of its random number; a
guide tells where to begin to look (the cutpoint method, Chen & Asau 1974), so it takes about one step. A cell
of zero width is an atom. The conditionals are 32-bit numbers, small enough for the second-level cache; the sums that
make them are float64, for the pixels sum to 1 only to within their rounding. What a table means is `table`; where
light goes between two grains is not here.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsdf.compiled import njit
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.vectors import frame

Floats = NDArray[np.float64]

ONE = 1 << 31  # what the 32-bit cumulative masses end with
DRAWN = ("p_r", "p_z", "p_phi", "p_l")  # the axes of the conditionals, in this order
R, Z, PHI, L = (np.uint64(axis) for axis in range(len(DRAWN)))
NEXT = np.uint64(1)  # unsigned indices need no look at their sign
RECORD = ("r", "z", "phi_delta", "l")
MAX_GUIDE = 1 << 12  # entries of a guide; more cells than these are only slower

# Taylor series of the sine of a turn
S0, S1, S2, S3, S4, S5, S6, S7, S8 = (
    (-1) ** k * (2.0 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(9)
)


class Tables(NamedTuple):
    """The tables of a mixture as the kernels take them, one after the other; from `compile_tables`.

    T tables have C columns together, column `first[t] + c` being column c of table t. All arrays are C-contiguous and
    padded to the table that needs most.
    """

    first: np.ndarray  # (T + 1,) int64: first column of each table
    theta: np.ndarray  # (T, most columns + 1) float64: cumulative masses of the columns, from 0 to 1
    theta_guide: np.ndarray  # (T, power of two) uint16 or uint32: column in which each of as many equal parts begins
    cos_theta: np.ndarray  # (T, most columns + 1) float64: edges of the columns
    cos_theta_guide: np.ndarray  # (T, power of two): as `theta_guide`, for equal parts of cos theta
    per_steradian: np.ndarray  # (C,) float64: density, 0 for an atom
    table: np.ndarray  # (C,) int64: the table of each column
    start: np.ndarray  # (5,) int64: where each axis begins in the second dimension of `cumulative` and `edges`
    cumulative: np.ndarray  # (C, start[4]) uint32: cumulative masses, each axis from 0 to ONE
    guide: np.ndarray  # (C, 4, power of two) uint8, uint16 or uint32: as `theta_guide`, for each axis
    edges: np.ndarray  # (T, start[4]) float64: edges of the cells of each axis
    records: np.ndarray  # (C, most records, 4) float32: r, z, phi_delta, l
    record_count: np.ndarray  # (C,) int64: 0 unless compiled for them


class Samples(NamedTuple):
    """Scattering events, arrays of one length; lengths in R, angles in radians.

    Attributes
    ----------
    cos_theta : (n,) float64
        Cosine of the deflection.
    phi_d : (n,) float64
        Azimuth of d_out about d_in, in [0, 2 pi).
    r, z : (n,) float64
        Parts of x_o - x_i across and along d_in.
    phi_delta : (n,) float64
        Azimuth of x_o - x_i less that of d_out.
    path_length : (n,) float64
        Length travelled inside the grain.
    column : (n,) int64
        Column of the table.
    """

    cos_theta: Floats
    phi_d: Floats
    r: Floats
    z: Floats
    phi_delta: Floats
    path_length: Floats
    column: NDArray[np.int64]


class Outgoing(NamedTuple):
    """Where light leaves.

    Attributes
    ----------
    d_out : (n, 3) float64
        Direction of propagation, unit.
    offset : (n, 3) float64
        x_o - x_i [R].
    """

    d_out: Floats
    offset: Floats


# ------------------------------------------------------------------------------------------- compilation


def _fitting(largest: int) -> Any:
    return np.min_scalar_type(max(largest, 0))


def _power_of_two(at_least: int) -> int:
    return min(1 << max(at_least - 1, 1).bit_length(), MAX_GUIDE)


def _cumulative(masses: np.ndarray) -> Floats:
    """Return cumulative masses along the last axis from exactly 0 to exactly 1, 0 where there is no mass at all."""
    sums = np.cumsum(masses, axis=-1, dtype=np.float64)
    total = sums[..., -1:]
    shares: Floats = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0)
    return np.concatenate((np.zeros_like(total), shares), axis=-1)


def _guide(cumulative: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the last cell that begins at or below each of the starts."""
    return np.clip(np.searchsorted(cumulative, starts, side="right") - 1, 0, len(cumulative) - 2)


def _checked(table: Table, name: str) -> np.ndarray:
    masses = table.block(name).astype(np.float64)
    if not (np.isfinite(masses).all() and (masses >= 0.0).all()):
        raise UsageError(f"{table!r}: block {name} has masses that are negative or not finite: build the table again")
    empty = ~masses.any(axis=0) & (table.p_theta > 0.0) if name != "p_theta" else ~masses.any(axis=1)
    if empty.any():
        place = f"column {np.argmax(empty)} of {name}" if name != "p_theta" else name
        raise UsageError(f"{table!r}: {place} has no mass to draw from: build the table again")
    return masses


def _used(masses: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Return for each table the first cell with any mass and the last + 1."""
    spans = []
    for mass in masses:
        used = np.flatnonzero(mass.any(axis=1))
        spans.append((int(used[0]), int(used[-1]) + 1))
    return spans


def compile_tables(tables: Sequence[Table], joint: bool = False) -> Tables:
    """Return tables in the form that the kernels take.

    Parameters
    ----------
    tables : sequence of Table
        At least one; they may differ in columns, rows and edges.
    joint : bool
        Keep the joint records as well.

    Raises
    ------
    UsageError
        If there is no table, if a column with light has nothing to draw from, or if records are asked for and missing.
    """
    return _compiled(tuple(tables), joint)


@lru_cache(maxsize=2)
def _compiled(tables: tuple[Table, ...], joint: bool) -> Tables:
    """Return what `compile_tables` does; experiments ask for the same over and over."""
    if not tables:
        raise UsageError("there is no table to draw from: give at least one")
    for table in tables:
        if joint and not table.joint:
            raise UsageError(f"{table!r} has no joint records to draw from: build it with --joint, or draw without")
    widths = [table.pixels.shape[1] for table in tables]
    first = np.concatenate(([0], np.cumsum(widths))).astype(np.int64)
    columns, most = int(first[-1]), max(widths)

    buckets = _power_of_two(4 * most)
    parts = np.arange(buckets) / buckets
    # cos_theta + 1 is rounded, so a cosine may come to be looked for in the part above its own
    cosines = 2.0 * parts - 1.0 - 2.0**-50
    theta, cos_theta = np.ones((2, len(tables), most + 1))
    theta_guide, cos_theta_guide = np.zeros((2, len(tables), buckets), dtype=_fitting(max(most, 256)))
    per_steradian = np.zeros(columns)
    for t, (table, width) in enumerate(zip(tables, widths, strict=True)):
        masses = _checked(table, "p_theta")[0]
        edges = table.cos_theta_edges
        theta[t, : width + 1], cos_theta[t, : width + 1] = _cumulative(masses), edges
        theta_guide[t] = _guide(theta[t, : width + 1], parts)
        cos_theta_guide[t] = _guide(edges[1:-1], cosines) + 1
        per_steradian[first[t] + 1 : first[t + 1] - 1] = (
            masses[1:-1] / masses.sum() / np.diff(edges)[1:-1] / (2.0 * math.pi)
        )

    blocks = [[_checked(table, name) for table in tables] for name in DRAWN]
    spans = [_used(axis) for axis in blocks]  # cells that no column uses would only take up the cache
    rows = [max(last - begin for begin, last in axis) for axis in spans]
    start = np.concatenate(([0], np.cumsum([n + 1 for n in rows]))).astype(np.int64)
    buckets = _power_of_two(max(rows))
    starts = np.arange(buckets) * (ONE / buckets)
    cumulative = np.full((columns, start[-1]), ONE, dtype=np.uint32)
    guide = np.zeros((columns, len(DRAWN), buckets), dtype=_fitting(max(rows)))
    edges_of = np.zeros((len(tables), start[-1]))
    for axis, name in enumerate(DRAWN):
        for t, table in enumerate(tables):
            begin, last = spans[axis][t]
            own = slice(start[axis], start[axis] + last - begin + 1)
            edges_of[t, start[axis] : start[axis + 1]] = table.edges(name)[last]
            edges_of[t, own] = table.edges(name)[begin : last + 1]
            sums = np.rint(_cumulative(blocks[axis][t][begin:last].T) * ONE).astype(np.uint32)
            sums[:, -1] = ONE  # in columns without light, too: nothing may send a search astray
            cumulative[first[t] : first[t + 1], own] = sums
            for c, column in enumerate(sums, start=first[t]):
                guide[c, axis] = _guide(column, starts)

    counts = [len(table.joint["r"]) if joint else 0 for table in tables]
    records = np.zeros((columns, max(1, *counts), len(RECORD)), dtype=np.float32)
    for t, table in enumerate(tables):
        for axis, name in enumerate(RECORD if joint else ()):
            records[first[t] : first[t + 1], : counts[t], axis] = table.joint[name].T
    return Tables(
        first,
        theta,
        theta_guide,
        cos_theta,
        cos_theta_guide,
        per_steradian,
        np.repeat(np.arange(len(tables)), widths),
        start,
        cumulative,
        guide,
        edges_of,
        records,
        np.repeat(np.array(counts, dtype=np.int64), widths),
    )


# ------------------------------------------------------------------------------------------------ kernels

# All are forced inline: a call would copy the hundred words that the arrays of `Tables` are.


@njit(cache=True, error_model="numpy", forceinline=True)
def draw_column(tables, t, u):
    """Return the global column and the cosine of the deflection that u in [0, 1) stands for, rising with u."""
    sums, edges, guide = tables.theta, tables.cos_theta, tables.theta_guide
    t = np.uint64(t)
    k = np.uint64(guide[t, np.uint64(np.int64(u * guide.shape[1]))])
    k += np.uint64(u >= sums[t, k + NEXT])  # most often enough, and costs the processor no guess
    while u >= sums[t, k + NEXT]:
        k += NEXT
    below, low, high = sums[t, k], edges[t, k], edges[t, k + NEXT]
    cos_theta = min(low + (u - below) / (sums[t, k + NEXT] - below) * (high - low), high)
    return tables.first[t] + np.int64(k), cos_theta


@njit(cache=True, error_model="numpy", forceinline=True)
def column_of(tables, t, cos_theta):
    """Return the global column, not an atom, whose cell holds a cosine in [-1, 1]; the first or last beyond."""
    edges, guide = tables.cos_theta, tables.cos_theta_guide
    first = tables.first[t]
    last = tables.first[t + 1] - first - 2
    k = np.int64(1)
    if cos_theta > -1.0:
        part = int((cos_theta + 1.0) * (0.5 * guide.shape[1]))
        k = np.int64(guide[t, min(part, guide.shape[1] - 1)])
        while k < last and cos_theta >= edges[t, k + 1]:
            k += 1
    return first + k


@njit(cache=True, error_model="numpy", forceinline=True)
def density(tables, column):
    """Return the density of d_out of a column [1/sr], 0 for an atom."""
    return tables.per_steradian[column]


@njit(cache=True, error_model="numpy", forceinline=True)
def _draw(tables, column, axis, u):
    """Return the value on an axis that u in [0, 1) stands for given the column, rising with u."""
    sums, edges, guide = tables.cumulative, tables.edges, tables.guide
    column = np.uint64(column)
    t = np.uint64(tables.table[column])
    x = u * ONE
    whole = np.uint32(np.int64(x))
    k = np.uint64(guide[column, axis, np.uint64(np.int64(u * guide.shape[2]))]) + np.uint64(tables.start[axis])
    k += np.uint64(whole >= sums[column, k + NEXT])
    while whole >= sums[column, k + NEXT]:
        k += NEXT
    below, low, high = sums[column, k], edges[t, k], edges[t, k + NEXT]
    return min(low + (x - below) / np.int64(sums[column, k + NEXT] - below) * (high - low), high)


@njit(cache=True, error_model="numpy", forceinline=True)
def draw_offset(tables, column, u_r, u_z, u_phi):
    """Return r [R], z [R] and phi_delta [rad] of three numbers in [0, 1), drawn independently given the column."""
    return _draw(tables, column, R, u_r), _draw(tables, column, Z, u_z), _draw(tables, column, PHI, u_phi)


@njit(cache=True, error_model="numpy", forceinline=True)
def draw_length(tables, column, u):
    """Return the path length inside the grain [R] of u in [0, 1), given the column; 0 in the atom at 0."""
    return _draw(tables, column, L, u)


@njit(cache=True, error_model="numpy", forceinline=True)
def draw_record(tables, column, u):
    """Return r [R], z [R], phi_delta [rad] and l [R] of one joint record of the column, chosen by u in [0, 1)."""
    records = tables.records
    k = int(u * tables.record_count[column])
    return (
        float(records[column, k, 0]),
        float(records[column, k, 1]),
        float(records[column, k, 2]),
        float(records[column, k, 3]),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def quarter_sine(a):
    """Return the sine of 2 pi a, a in [-1/4, 1/4], to 1e-13: its Taylor series."""
    q = a * a
    q2 = q * q
    q4 = q2 * q2
    return a * (((S0 + q * S1) + q2 * (S2 + q * S3)) + q4 * (((S4 + q * S5) + q2 * (S6 + q * S7)) + q4 * S8))


@njit(cache=True, error_model="numpy", forceinline=True)
def turned(u):
    """Return cosine and sine of 2 pi u, u in [0, 1]: `sampling.turn` without its divisions and branches."""
    a = u - 0.5
    b = abs(a)
    return quarter_sine(b - 0.25), -math.copysign(quarter_sine(0.25 - abs(b - 0.25)), a)


@njit(cache=True, error_model="numpy", forceinline=True)
def leave(d_in, cos_theta, u_phi_d, r, z, phi_delta):
    """Return d_out and x_o - x_i [R] as triples: lines 7 and 8 of Algorithm 1 with phi_d = 2 pi u_phi_d, d_in unit."""
    a, b = frame(d_in)
    c, s = turned(u_phi_d)
    sin_theta = math.sqrt(max(0.0, 1.0 - cos_theta * cos_theta))
    c, s = sin_theta * c, sin_theta * s
    d_out = (
        cos_theta * d_in[0] + c * a[0] + s * b[0],
        cos_theta * d_in[1] + c * a[1] + s * b[1],
        cos_theta * d_in[2] + c * a[2] + s * b[2],
    )
    v = u_phi_d + phi_delta * (0.5 / math.pi)
    c, s = turned(v - np.floor(v))
    c, s = r * c, r * s
    offset = (
        z * d_in[0] + c * a[0] + s * b[0],
        z * d_in[1] + c * a[1] + s * b[1],
        z * d_in[2] + c * a[2] + s * b[2],
    )
    return d_out, offset


@njit(cache=True, nogil=True, error_model="numpy")
def _sample_all(tables, joint, u, out, columns):
    for i in range(len(u)):
        column, cos_theta = draw_column(tables, 0, u[i, 1])
        if joint:
            r, z, phi_delta, length = draw_record(tables, column, u[i, 2])
        else:
            r, z, phi_delta = draw_offset(tables, column, u[i, 2], u[i, 3], u[i, 4])
            length = draw_length(tables, column, u[i, 5])
        columns[i] = column
        out[0, i], out[1, i], out[2, i], out[3, i] = cos_theta, 2.0 * math.pi * u[i, 0], r, z
        out[4, i], out[5, i] = phi_delta, length


@njit(cache=True, nogil=True, error_model="numpy")
def _density_all(tables, cos_theta, out):
    for i in range(len(cos_theta)):
        out[i] = density(tables, column_of(tables, 0, cos_theta[i]))


@njit(cache=True, nogil=True, error_model="numpy")
def _leave_all(d_in, cos_theta, phi_d, r, z, phi_delta, d_out, offset):
    for i in range(len(d_in)):
        d = (d_in[i, 0], d_in[i, 1], d_in[i, 2])
        v = phi_d[i] * (0.5 / math.pi)
        d_out[i], offset[i] = leave(d, cos_theta[i], v - np.floor(v), r[i], z[i], phi_delta[i])


# ------------------------------------------------------------------------------------------------ arrays


def _floats(values: Any, name: str) -> Floats:
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise TypeError
        return np.ascontiguousarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{name} must be an array of real numbers") from None


class Sampler:
    """Draws from one table, arrays in, arrays out.

    Parameters
    ----------
    table : Table
    joint : bool
        Draw r, z, phi_delta and the path length together, as one of the joint records of the column, instead of each
        independently given the column.

    Raises
    ------
    UsageError
        As `compile_tables`.

    Examples
    --------
    >>> import tsdf
    >>> import numpy as np
    >>> sampler = tsdf.Sampler(tsdf.read("cube.tsdf.exr"))
    >>> samples = sampler.sample(np.random.default_rng(0).random((100_000, 6)))
    >>> bool(abs(samples.cos_theta.mean() - 0.4737) < 0.01)  # the table's mean cosine; its cells are wide
    True
    """

    def __init__(self, table: Table, joint: bool = False) -> None:
        self.tables = compile_tables([table], joint)
        self.joint = joint
        p = table.p_theta / table.p_theta.sum()
        self._atoms = float(p[0]), float(p[-1])

    @property
    def atoms(self) -> tuple[float, float]:
        """Probabilities of exactly backward and exactly forward light."""
        return self._atoms

    def sample(self, u: Any) -> Samples:
        """Return the events that random numbers stand for, by Algorithm 1, lines 2 to 6.

        Parameters
        ----------
        u : (n, 6) float
            In [0, 1): for phi_d, theta, r, z, phi_delta and path length. Each result rises with its own, as long as
            the column stays; with joint records the one for r chooses the record and the last three are not used.

        Raises
        ------
        UsageError
            If the shape is wrong or a number is not in [0, 1).
        """
        u = _floats(u, "u")
        if u.ndim != 2 or u.shape[1] != 6:
            raise UsageError(f"u must have shape (n, 6), got {u.shape}: one row of six random numbers for each event")
        valid = (u >= 0.0) & (u < 1.0)
        if not valid.all():
            row, number = np.unravel_index(np.argmin(valid), u.shape)
            raise UsageError(f"u[{row}, {number}] is {u[row, number]}: random numbers must be in [0, 1)")
        out, columns = np.empty((6, len(u))), np.empty(len(u), dtype=np.int64)
        _sample_all(self.tables, self.joint, u, out, columns)
        return Samples(out[0], out[1], out[2], out[3], out[4], out[5], columns)

    def density_solid_angle(self, cos_theta: Any) -> Floats:
        """Return the density of d_out [1/sr] at cosines in [-1, 1], atoms left out; float64 of the given shape.

        Raises
        ------
        UsageError
            If a cosine is not in [-1, 1].
        """
        cosines = _floats(cos_theta, "cos_theta")
        if not ((cosines >= -1.0) & (cosines <= 1.0)).all():
            raise UsageError("cos_theta must be in [-1, 1] everywhere")
        out = np.empty(cosines.size)
        _density_all(self.tables, cosines.ravel(), out)
        return out.reshape(np.shape(cos_theta))

    def density(self, cos_theta: Any) -> Floats:
        """Return the density of cos theta at cosines in [-1, 1], atoms left out; float64 of the given shape.

        Integrates over [-1, 1] to 1 minus the atoms. UsageError as `density_solid_angle`.
        """
        return 2.0 * math.pi * self.density_solid_angle(cos_theta)


def outgoing(samples: Samples, d_in: Any) -> Outgoing:
    """Return where the light of samples leaves, for given directions: Algorithm 1, lines 7 and 8.

    Azimuths are counted from the first axis of `vectors.frame`, right-handed about d_in.

    Parameters
    ----------
    samples : Samples
        n of them.
    d_in : (3,) or (n, 3) float
        Directions of propagation before, unit vectors.

    Raises
    ------
    UsageError
        If a direction is not of unit length within 1e-6, or there are not as many as samples.

    Examples
    --------
    >>> import tsdf
    >>> import numpy as np
    >>> samples = tsdf.Sampler(tsdf.read("cube.tsdf.exr")).sample(np.full((1, 6), 0.999))  # straight on
    >>> outgoing(samples, (0.0, 0.0, 1.0)).d_out
    array([[0., 0., 1.]])
    """
    d = _floats(d_in, "d_in")
    shape = (len(samples.cos_theta), 3)
    if d.shape not in ((3,), shape):
        raise UsageError(f"d_in must have shape (3,) or {shape}, as the samples, got {d.shape}")
    with np.errstate(over="ignore"):
        length = np.sqrt(np.sum(d * d, axis=-1))
    if not (np.abs(length - 1.0) <= 1e-6).all():
        raise UsageError("d_in must be unit vectors: divide them by their lengths")
    d_out, offset = np.empty(shape), np.empty(shape)
    d = np.ascontiguousarray(np.broadcast_to(d, shape))
    _leave_all(d, samples.cos_theta, samples.phi_d, samples.r, samples.z, samples.phi_delta, d_out, offset)
    return Outgoing(d_out, offset)
