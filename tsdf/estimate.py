"""From counts to a table: statistics, their errors, what the cells and the factorisation lose, and the header.

`columns_of` is where fine cells become the columns of a table; `traced_table` and `exact_table` are the two ways to
a `Table`. Everything is a function of its arguments alone, so equal counts give equal bytes.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numba import njit

from tsdf import analytic
from tsdf import tally as T
from tsdf.errors import TSDFError, UsageError
from tsdf.optics import Optics
from tsdf.table import CONDITIONALS, FORMAT_VERSION, RECORD_FIELDS, Table
from tsdf.tally import Tally

LEGENDRE = 16  # highest Legendre moment in the header
MIN_CELLS, MAX_CELLS = 8, T.COARSE
STATISTICS = (
    "hit_probability",
    "albedo",
    "mean_cosine",
    "mean_z",
    "mean_r",
    "mean_miss_chord",
    "mean_path_length",
    "atom_forward",
    "atom_backward",
)
LICENCE = "CC0-1.0"
LEDGER_UNITS = 1 << 52  # energy units of an exact table


@dataclass(frozen=True)
class TableError:
    """Estimated total variation between the table and the truth.

    Parameters
    ----------
    cells : int
        Cells of theta it holds for.
    sampling_noise, cell_width : float
        What the finite number of paths and the finite width of the cells contribute.
    """

    cells: int
    sampling_noise: float
    cell_width: float

    @property
    def total_variation(self) -> float:
        """Their sum, an upper bound of what both do together."""
        return self.sampling_noise + self.cell_width


def bounds(cells: int, fine: int) -> np.ndarray:
    """Return where `cells` nearly equal cells of theta begin and end, (cells + 1,) indices into `fine` cells.

    All of them fall on the coarse cells of a tally.
    """
    return (np.arange(cells + 1) * T.COARSE + cells // 2) // cells * (fine // T.COARSE)


def cos_theta_edges(cells: int) -> np.ndarray:
    """Return the column edges of a table, (cells + 3,) ascending from -1 to 1 with an atom at either end."""
    theta = bounds(cells, T.COARSE) * (math.pi / T.COARSE)
    inner = np.cos(theta[::-1])
    inner[0], inner[-1] = -1.0, 1.0
    return np.concatenate(([-1.0], inner, [1.0]))


def columns_of(fine: np.ndarray, cells: int) -> np.ndarray:
    """Sum fine cells of theta into columns.

    Parameters
    ----------
    fine : (..., n + 2) array
        Last axis ascending in theta, then the forward and the backward atom.

    Returns
    -------
    (..., cells + 2) array
        Last axis ascending in cos theta: backward atom, cells, forward atom.
    """
    count = fine.shape[-1] - 2
    inner = np.add.reduceat(fine[..., :count], bounds(cells, count)[:-1], axis=-1)
    return np.concatenate((fine[..., count + 1 :], inner[..., ::-1], fine[..., count : count + 1]), axis=-1)


def jackknife(sums: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return a statistic of sums over replicates and its standard error.

    Parameters
    ----------
    sums : (replicates, n) array
    statistic : callable
        From (..., n) sums to (..., m) values; may be a ratio.
    """
    total = sums.sum(axis=0)
    left_out = statistic(total - sums)
    spread = ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
    return statistic(total), np.sqrt(spread * (len(sums) - 1) / len(sums))


def table_error(tally: Tally, cells: int) -> TableError:
    """Estimate the total variation between p_theta in `cells` cells and the truth.

    The noise is the sum of the standard errors of the columns times sqrt(2 / pi), halved. The cell width shows in how
    parts of each column differ from what its mean density gives them (a linear density shows in full in two parts),
    corrected for their own noise, in as many parts as the noise allows.
    """
    replicates = len(tally.theta)
    theta = tally.theta * (replicates / tally.scalars[:, T.SCATTERED].sum())
    noise = columns_of(theta, cells).std(axis=0, ddof=1).sum()
    widths: list[float] = []
    for parts in (2, 4, 8, 16):
        if parts * cells > T.FINE:
            break
        width, blur = _width(theta[:, : T.FINE], cells, parts)
        if widths and blur > 1.5 * width:
            break
        widths.append(width)
    # what still finer parts would show: nothing where the density is smooth; at a caustic, whose cells deviate as the
    # root of their width, the gains of ever finer parts add up to 2.4 times the last
    hidden = 2.4 * max(0.0, widths[-1] - widths[-2]) if len(widths) > 1 else 0.0
    return TableError(cells, float(noise * math.sqrt(0.5 / (math.pi * replicates))), widths[-1] + hidden)


def _width(theta: np.ndarray, cells: int, parts: int) -> tuple[float, float]:
    """Return the total variation between the columns and their `parts` nearly equal parts, and the parts' noise."""
    replicates = len(theta)
    edges = bounds(cells, T.FINE)
    cuts = np.append(np.rint(np.linspace(edges[:-1], edges[1:], parts, endpoint=False)).astype(int).T.ravel(), T.FINE)
    masses = np.add.reduceat(theta, cuts[:-1], axis=1).reshape(replicates, cells, parts)
    share = np.diff(-np.cos(cuts * (math.pi / T.FINE))).reshape(cells, parts)
    share /= share.sum(axis=1, keepdims=True)  # the density of the table is uniform in cos theta within a column
    deviations = masses - masses.sum(axis=2, keepdims=True) * share
    variances = deviations.var(axis=0, ddof=1) / replicates
    squares = deviations.mean(axis=0) ** 2 - variances
    # the noise of a square is known and subtracted: part by part in columns that clearly deviate, which leaves a
    # little too much elsewhere, so there over a window of columns if that leaves less
    alone = np.sqrt(np.maximum(squares, 0.0)).sum(axis=1)
    window = np.ones(min(17, cells))
    pooled = np.convolve(squares.mean(axis=1), window, "same") / np.convolve(np.ones(cells), window, "same")
    together = parts * np.sqrt(np.maximum(pooled, 0.0))
    clear = squares.sum(axis=1) > 3.0 * math.sqrt(2.0 / parts) * variances.sum(axis=1)
    width = 0.5 * np.where(clear, alone, np.minimum(alone, together)).sum()
    return float(width), float(np.sqrt(variances).sum() * math.sqrt(0.5 / math.pi))


def candidate_cells() -> list[int]:
    """Return the numbers of cells that an automatic choice tries, ascending, an eighth of an octave apart."""
    return sorted({round(2.0 ** (k / 8.0)) for k in range(24, 81)})


def smallest_enough(tally: Tally, target: float) -> TableError | None:
    """Return the error of the fewest cells that meet `target`, or None if none does."""
    errors = (table_error(tally, cells) for cells in candidate_cells())
    return next((error for error in errors if error.total_variation <= target), None)


def legendre_matrix(edges: np.ndarray) -> np.ndarray:
    """Return the mean of P_0 .. P_LEGENDRE over each cell of cos theta, (cells, LEGENDRE + 1); at the edge of atoms."""
    lower, upper = edges[:-1], edges[1:]
    wide = upper > lower
    values = np.polynomial.legendre.legvander(upper, LEGENDRE + 1)
    below = np.polynomial.legendre.legvander(lower, LEGENDRE + 1)
    means = values[:, : LEGENDRE + 1].copy()
    # the integral of P_n is (P_{n+1} - P_{n-1}) / (2 n + 1)
    for n in range(LEGENDRE + 1):
        previous = (values[:, n - 1] - below[:, n - 1]) if n else 0.0
        integral = (values[:, n + 1] - below[:, n + 1] - previous) / (2 * n + 1)
        means[wide, n] = (integral / np.where(wide, upper - lower, 1.0))[wide]
    return means


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.divide(a, b, out=np.zeros(np.broadcast(a, b).shape), where=b != 0)


def _scalar_statistics(sums: np.ndarray) -> np.ndarray:
    """Return STATISTICS and the mean offset, (..., 10), from sums (..., scalars + 2), the atoms last."""
    sums = np.asarray(sums, dtype=np.float64)
    scattered, launched = sums[..., T.SCATTERED], sums[..., T.LAUNCHED]
    missed = sums[..., T.UNSCATTERED]
    means = [
        1.0 - missed / launched,
        _ratio(scattered, launched - missed),
        *(_ratio(sums[..., i], scattered) for i in (T.COS_THETA, T.MEAN_Z, T.MEAN_R)),
        _ratio(sums[..., T.MISS_CHORD], missed),
        *(_ratio(sums[..., i], scattered) for i in (T.PATH_LENGTH, -2, -1, T.OFFSET)),
    ]
    return np.stack(means, axis=-1)


@dataclass(frozen=True)
class Factorisation:
    """Joint masses from which to tell what eq. (1) of Meng et al. 2015 loses, see `factorisation_error`.

    Parameters
    ----------
    box : (n, groups, phi, r, z) array
        Energy in independent halves; n = 1 if it is free of noise.
    box_l : (n, groups, l, phi + r + z) array
    """

    box: np.ndarray
    box_l: np.ndarray

    def pairs(self) -> dict[str, np.ndarray]:
        """Return the energy of each pair given the group, (n, groups, a, b)."""
        phi, r = T.BOX["phi"], T.BOX["r"]
        return {
            "r_z": self.box.sum(axis=2),
            "r_phi": self.box.sum(axis=4).swapaxes(2, 3),
            "z_phi": self.box.sum(axis=3).swapaxes(2, 3),
            "r_l": self.box_l[..., phi : phi + r],
            "z_l": self.box_l[..., phi + r :],
            "phi_l": self.box_l[..., :phi],
        }


def mutual_information(energy: np.ndarray) -> float:
    """Return the conditional mutual information of the last two axes given the first [bit], from (groups, a, b)."""
    total = energy.sum()
    if total == 0:
        return 0.0
    p = energy / total
    group, a, b = p.sum(axis=(1, 2), keepdims=True), p.sum(axis=2, keepdims=True), p.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = p * np.log2(p * group / (a * b))
    return float(np.nansum(terms))


def _joint_variation(energy: np.ndarray) -> float:
    """Return the total variation between (groups, phi, r, z) and the product of its marginals given the group."""
    p = energy / energy.sum()
    group = p.sum(axis=(1, 2, 3), keepdims=True)
    given = _ratio(p, group)
    product = given.sum(axis=(2, 3), keepdims=True) * given.sum(axis=(1, 3), keepdims=True)
    product = product * given.sum(axis=(1, 2), keepdims=True)
    return float(0.5 * (group * np.abs(given - product)).sum())


def factorisation_error(
    factorisation: Factorisation, p_theta: np.ndarray, p_r: np.ndarray, p_z: np.ndarray, mean_offset: float
) -> dict[str, Any]:
    """Return what drawing phi_Delta, r and z independently given theta loses; keys as in SPEC.md.

    Mutual information from counts is biased upwards by an amount inverse to their number, so the mean of the two
    halves shows the bias twice: it is subtracted. Sums of absolute differences keep theirs, and the noise is stated.
    """
    information = {}
    for name, energy in factorisation.pairs().items():
        value = mutual_information(energy.sum(axis=0))
        if len(energy) == 2:
            value = 2.0 * value - 0.5 * (mutual_information(energy[0]) + mutual_information(energy[1]))
        information[name] = max(0.0, value)
    box = factorisation.box
    noise = 0.0
    if len(box) == 2 and box[0].sum() and box[1].sum():
        noise = float(0.25 * np.abs(box[0] / box[0].sum() - box[1] / box[1].sum()).sum())
    # points spread evenly over each cell of (r, z), as a sampler would draw them
    parts = (np.arange(4) + 0.5) / 4.0
    r = (T.R_EDGES[:-1, None] + parts * (T.R_EDGES[1] - T.R_EDGES[0])).ravel()
    z = (T.Z_EDGES[:-1, None] + parts * (T.Z_EDGES[1] - T.Z_EDGES[0])).ravel()
    length = np.hypot(r[:, None], z[None, :])
    density = (p_r * p_theta) @ p_z.T
    cells = density.repeat(4, axis=0).repeat(4, axis=1) / 16.0
    return {
        "mutual_information_bits": information,
        "total_variation": _joint_variation(box.sum(axis=0)),
        "total_variation_noise": noise,
        "impossible_offsets": float(cells[length > 2.0].sum()),
        "mean_offset": mean_offset,
        "mean_offset_factorised": float((cells * length).sum()),
        "resolution": {"theta": T.GROUPS, **T.BOX},
    }


def henyey_greenstein_masses(g: float, edges: np.ndarray) -> np.ndarray:
    """Return the mass of a Henyey-Greenstein lobe in each cell of cos theta, (cells,); no atoms."""
    if abs(g) < 1e-6:
        return 0.5 * np.diff(edges)
    cumulative = (1.0 - g * g) / (2.0 * g) * (1.0 / np.sqrt(1.0 + g * g - 2.0 * g * edges) - 1.0 / (1.0 + g))
    return np.diff(cumulative)


def fits(p_theta: np.ndarray, edges: np.ndarray, mean_cosine: float) -> dict[str, Any]:
    """Return one- and two-lobe Henyey-Greenstein stand-ins of the same mean cosine, with their total variation.

    The two lobes, weights and asymmetries, are those of least total variation that keep the mean cosine, so that light
    diffuses as far as with the table itself.
    """
    from scipy.optimize import minimize

    def variation(masses: np.ndarray) -> float:
        return float(0.5 * np.abs(masses - p_theta).sum())

    limit = 0.9999
    g = min(max(mean_cosine, -limit), limit)

    def lobes(x: np.ndarray) -> tuple[float, float, float]:
        narrow = g + (limit - g) / (1.0 + math.exp(-x[0]))
        wide = g - (limit + g) / (1.0 + math.exp(-x[1]))
        return narrow, wide, (g - wide) / (narrow - wide) if narrow > wide else 1.0

    def both(x: np.ndarray) -> float:
        narrow, wide, weight = lobes(x)
        first, second = henyey_greenstein_masses(narrow, edges), henyey_greenstein_masses(wide, edges)
        return variation(weight * first + (1.0 - weight) * second)

    starts = [np.array((a, b)) for a in (-2.0, 0.0, 2.0) for b in (-2.0, 0.0, 2.0)]
    options = {"xatol": 1e-4, "fatol": 1e-7, "maxiter": 400}
    best = min(
        (minimize(both, start, method="Nelder-Mead", options=options) for start in starts),
        key=lambda result: result.fun,
    )
    narrow, wide, weight = lobes(best.x)
    return {
        "henyey_greenstein": {"g": g, "total_variation": variation(henyey_greenstein_masses(g, edges))},
        "two_lobe": {"g1": narrow, "g2": wide, "weight": weight, "total_variation": float(best.fun)},
    }


def _systematic(weights: np.ndarray, count: int) -> np.ndarray:
    """Return `count` indices in proportion to `weights`, evenly spaced in the running sum."""
    running = np.cumsum(weights)
    return np.searchsorted(running, (np.arange(count) + 0.5) / count * running[-1], side="right").clip(0, len(weights) - 1)


def records_of(tally: Tally, cells: int) -> np.ndarray:
    """Return `tally.joint` equally likely records per column, (fields, joint, cells + 2), by ascending entry_b2.

    The reservoirs of the coarse cells in a column are one reservoir; one that is not full holds everything there was,
    with its weight.
    """
    count = tally.joint
    result = np.zeros((len(RECORD_FIELDS), count, cells + 2))
    edges = bounds(cells, T.COARSE)
    groups = [np.array([T.COARSE + 1])]
    groups += [np.arange(edges[i], edges[i + 1]) for i in range(cells - 1, -1, -1)]
    groups += [np.array([T.COARSE])]
    for column, members in enumerate(groups):
        rows = tally.records[members].reshape(-1, T.RECORD)
        rows = rows[np.isfinite(rows[:, 0])]
        if len(rows) == 0:
            continue
        if len(rows) >= count:
            rows = rows[np.lexsort(rows.T[::-1])[:count]]
            rows = rows[np.lexsort(rows[:, 2:].T[::-1][[1, 0, 2, 3, 4, 5]])]
        else:
            rows = rows[np.lexsort(rows[:, 2:].T[::-1][[1, 0, 2, 3, 4, 5]])]
            rows = rows[_systematic(rows[:, 1], count)]
        rows = rows[np.argsort(rows[:, 6], kind="stable")]
        result[:, :, column] = rows[:, 2:].T
    result[2] = np.where(result[2] <= -math.pi, math.pi, result[2])
    result[5] = np.where(result[5] <= -math.pi, math.pi, result[5])
    return result


def _normalised(energy: np.ndarray) -> np.ndarray:
    """Return (rows, columns) masses that sum to 1 in each column that holds anything, from (columns, rows) energy."""
    energy = energy.T.astype(np.float64)
    return _ratio(energy, energy.sum(axis=0, keepdims=True))


def software() -> str:
    """Return name and version of this package."""
    try:
        return f"tsdf-toolkit {version('tsdf-toolkit')}"
    except PackageNotFoundError:
        return "tsdf-toolkit"


def _assemble(
    *,
    grain: Mapping[str, Any],
    optics: Optics,
    edges: np.ndarray,
    p_theta: np.ndarray,
    conditionals: Mapping[str, np.ndarray],
    mean_l: np.ndarray,
    joint: np.ndarray | None,
    statistics: dict[str, Any],
    standard_errors: dict[str, Any],
    error: TableError,
    factorisation: Factorisation,
    mean_offset: float,
    ledger: Mapping[str, int],
    provenance: Mapping[str, Any],
) -> Table:
    """Stack the blocks and write the header."""
    axes = {
        "p_phi": ("phi_delta", "rad", T.PHI_EDGES),
        "p_r": ("r", "R", T.R_EDGES),
        "p_z": ("z", "R", T.Z_EDGES),
        "p_l": ("l", "R", T.L_EDGES),
    }
    blocks: list[dict[str, Any]] = [{"name": "p_theta", "kind": "mass", "first_row": 0, "rows": 1}]
    rows = [p_theta[None, :]]

    def stack(entry: dict[str, Any], values: np.ndarray) -> None:
        place = {"first_row": sum(len(part) for part in rows), "rows": len(values)}
        blocks.append({"name": entry.pop("name"), "kind": entry.pop("kind"), **place, **entry})
        rows.append(values)

    for name in CONDITIONALS:
        quantity, unit, axis = axes[name]
        entry = {"name": name, "kind": "mass", "quantity": quantity, "unit": unit, "edges": axis.tolist()}
        stack(entry, conditionals[name])
    stack({"name": "mean_l", "kind": "mean", "of": "p_l", "unit": "R"}, mean_l)
    if joint is not None:
        units = {"phi_delta": "rad", "entry_azimuth": "rad", "entry_b2": "R^2"}
        for name, values in zip(RECORD_FIELDS, joint, strict=True):
            stack({"name": f"joint_{name}", "kind": "record", "unit": units.get(name, "R")}, values)
    pixels = np.concatenate(rows).astype(np.float32)
    header = {
        "format": "tsdf",
        "format_version": FORMAT_VERSION,
        "required_features": [],
        "columns": {"quantity": "cos_theta", "edges": edges.tolist()},
        "blocks": blocks,
        "pixels_sha256": "0" * 64,  # the writer's to fill in
        "grain": dict(grain),
        "optics": asdict(optics),
        "statistics": statistics,
        "standard_errors": standard_errors,
        "table_error": {
            "total_variation": error.total_variation,
            "sampling_noise": error.sampling_noise,
            "cell_width": error.cell_width,
        },
        "factorisation_error": factorisation_error(
            factorisation, p_theta, conditionals["p_r"], conditionals["p_z"], mean_offset
        ),
        "fits": fits(p_theta, edges, statistics["mean_cosine"]),
        "energy_ledger": dict(ledger),
        "provenance": {"software": software(), **provenance},
        "licence": LICENCE,
    }
    return Table(header, pixels)


def traced_table(
    tally: Tally, cells: int, grain: Mapping[str, Any], optics: Optics, provenance: Mapping[str, Any]
) -> Table:
    """Return the table that a tally of traced paths stands for.

    Raises
    ------
    TSDFError
        If no light at all was scattered.
    """
    if not tally.scalars[:, T.SCATTERED].sum():
        raise TSDFError("no path was scattered by the grain: trace more paths (--paths), or look at the grain's shape")
    sums = np.concatenate((tally.scalars, tally.theta[:, T.FINE :]), axis=1)
    values, errors = jackknife(sums, _scalar_statistics)
    fine_edges = np.concatenate(([-1.0], np.cos(np.linspace(math.pi, 0.0, T.FINE + 1)), [1.0]))
    matrix = legendre_matrix(fine_edges)
    fine = np.concatenate((tally.theta[:, T.FINE + 1 :], tally.theta[:, T.FINE - 1 :: -1], tally.theta[:, T.FINE : T.FINE + 1]), axis=1)
    moments, moment_errors = jackknife(fine, lambda energy: _ratio(energy @ matrix, energy.sum(axis=-1, keepdims=True)))
    statistics: dict[str, Any] = dict(zip(STATISTICS, values[:-1].tolist(), strict=True))
    standard_errors: dict[str, Any] = dict(zip(STATISTICS, errors[:-1].tolist(), strict=True))
    moments[:2], moment_errors[:2] = (1.0, statistics["mean_cosine"]), (0.0, standard_errors["mean_cosine"])
    statistics["legendre_moments"], standard_errors["legendre_moments"] = moments.tolist(), moment_errors.tolist()

    energy = columns_of(tally.theta.sum(axis=0), cells)
    columns = {
        name: columns_of(np.ascontiguousarray(tally.conditional(name).T), cells).T for name in ("phi", "r", "z", "l", "l_sum")
    }
    totals = dict(zip(T.SCALARS, (int(v) for v in tally.scalars.astype(object).sum(axis=0)), strict=True))
    ledger = {name: totals[name] for name in ("launched", "unscattered", "scattered")}
    ledger |= {"absorbed": 0, "truncated": totals["truncated"], "lost": totals["lost"]}
    return _assemble(
        grain=grain,
        optics=optics,
        edges=cos_theta_edges(cells),
        p_theta=energy / energy.sum(),
        conditionals={f"p_{name}": _normalised(columns[name]) for name in ("phi", "r", "z", "l")},
        mean_l=_ratio(columns["l_sum"].astype(np.float64), columns["l"].astype(np.float64)).T,
        joint=records_of(tally, cells) if tally.joint else None,
        statistics=statistics,
        standard_errors=standard_errors,
        error=table_error(tally, cells),
        factorisation=Factorisation(tally.box, tally.box_l),
        mean_offset=float(values[-1]),
        ledger=ledger,
        provenance=provenance,
    )


@njit(cache=True)
def _covered(a, b, low, high):  # type: ignore[no-untyped-def]
    """Return the share of the interval a .. b that lies in low .. high; a point lies in one of them or the next."""
    if b <= a:
        return 1.0 if low <= a < high or a == high == 1.0 else 0.0
    return max(0.0, (min(b, high) - max(a, low)) / (b - a))


@njit(cache=True)
def _deposit(weight, low, high, row, edges, out):  # type: ignore[no-untyped-def]
    """Spread each event's weight over the columns it covers, as far as it covers each: out[column, row] += share."""
    columns = len(edges) - 1
    for k in range(len(weight)):
        a, b = min(low[k], high[k]), max(low[k], high[k])
        i = min(max(np.searchsorted(edges, a, side="right") - 1, 0), columns - 1)
        while i < columns and edges[i] <= b:
            out[i, row[k]] += weight[k] * _covered(a, b, edges[i], edges[i + 1])
            i += 1


@njit(cache=True)
def _choose(weight, low, high, edges, totals, chosen):  # type: ignore[no-untyped-def]
    """Write the events at evenly spaced places of each column's running sum, (columns, records), in their order."""
    columns, count = chosen.shape
    running, taken = np.zeros(columns), np.zeros(columns, dtype=np.int64)
    for k in range(len(weight)):
        a, b = min(low[k], high[k]), max(low[k], high[k])
        i = min(max(np.searchsorted(edges, a, side="right") - 1, 0), columns - 1)
        while i < columns and edges[i] <= b:
            running[i] += weight[k] * _covered(a, b, edges[i], edges[i + 1])
            while taken[i] < count and running[i] > (taken[i] + 0.5) / count * totals[i]:
                chosen[i, taken[i]] = k
                taken[i] += 1
            i += 1
    for i in range(columns):  # rounding may leave the last places open
        for j in range(taken[i], count):
            chosen[i, j] = chosen[i, taken[i] - 1] if taken[i] > 0 else 0


def _exact_width(optics: Optics, cells: int) -> float:
    """Return the total variation between the exact p_theta and its cell means."""
    parts = 16
    edges = cos_theta_edges(cells)[1:-1]
    theta = np.arccos(edges)
    fine = np.cos((theta[:-1, None] + np.diff(theta)[:, None] * np.arange(parts) / parts).ravel())
    fine = np.append(fine, 1.0)
    masses = analytic.deflection_masses(fine, optics.eta, optics.fresnel).reshape(cells, parts)
    share = np.diff(fine).reshape(cells, parts)
    share /= share.sum(axis=1, keepdims=True)
    return float(0.5 * np.abs(masses - masses.sum(axis=1, keepdims=True) * share).sum())


def exact_table(
    cells: int | None,
    target: float | None,
    joint: int,
    grain: Mapping[str, Any],
    optics: Optics,
    provenance: Mapping[str, Any],
) -> Table:
    """Return the table of the exact sphere by quadrature over the impact parameter, without random numbers.

    Parameters
    ----------
    cells : int, optional
        Cells of theta; by default the fewest that meet `target`.
    target : float, optional
        Total variation of p_theta that the cells may cost.
    joint : int
        Records per column, 0 for none.
    """
    if cells is None:
        assert target is not None
        cells = next((n for n in candidate_cells() if _exact_width(optics, n) <= target), None)
        if cells is None:
            raise UsageError(
                f"--target-error {target:g} is out of reach: {MAX_CELLS} cells of theta, the most a table may have, "
                f"cost {_exact_width(optics, MAX_CELLS):.2g} of total variation"
            )
    elif target is not None and _exact_width(optics, cells) > target:
        raise UsageError(f"--target-error {target:g} needs more than {cells} cells, which cost {_exact_width(optics, cells):.2g}")
    edges = cos_theta_edges(cells)
    inner = edges[1:-1]
    truth = analytic.sphere_statistics(optics.eta, optics.fresnel)
    p_theta = np.concatenate(
        ([truth.atom_backward], analytic.deflection_masses(inner, optics.eta, optics.fresnel), [truth.atom_forward])
    )
    atoms = truth.atom_forward + truth.atom_backward
    p_theta[1:-1] *= 1.0 - atoms
    events = analytic.sphere_events(optics.eta, optics.fresnel, intervals=16384)
    low, high, weight = events.cos_theta_from, events.cos_theta_to, events.weight

    def spread(row: np.ndarray, count: int, scale: np.ndarray | float = 1.0, by: np.ndarray = inner) -> np.ndarray:
        out = np.zeros((len(by) - 1, count))
        _deposit(weight * scale, low, high, row.astype(np.int64), by, out)
        return out

    def cell(values: np.ndarray, axis: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(axis, values, side="right") - 1, 0, len(axis) - 2)

    def with_atoms(inside: np.ndarray) -> np.ndarray:
        """Add the atom columns: empty ones, or all the light of a sphere that does not deflect."""
        edge = np.zeros((1, inside.shape[1]))
        if atoms:
            return np.concatenate((edge, np.zeros_like(inside), inside.sum(axis=0, keepdims=True)))
        return np.concatenate((edge, inside, edge))

    phi = cell(np.where(events.phi_delta < T.PHI_EDGES[0], events.phi_delta + 2.0 * math.pi, events.phi_delta), T.PHI_EDGES)
    r, z, length = cell(events.r, T.R_EDGES), cell(events.z, T.Z_EDGES), cell(events.path_length, T.L_EDGES)
    energy = {
        "p_phi": with_atoms(spread(phi, T.PHI)),
        "p_r": with_atoms(spread(r, T.R)),
        "p_z": with_atoms(spread(z, T.Z)),
        "p_l": with_atoms(spread(length, T.L)),
    }
    moments = with_atoms(spread(length, T.L, events.path_length))
    dark = p_theta <= 0.0
    conditionals = {name: np.where(dark, 0.0, _normalised(values)) for name, values in energy.items()}
    mean_l = np.where(dark, 0.0, _ratio(moments, energy["p_l"]).T)

    groups = np.cos(np.linspace(math.pi, 0.0, T.GROUPS + 1))
    groups[0], groups[-1] = -1.0, 1.0
    turned = np.where(events.phi_delta > 0.5 * math.pi, T.BOX["phi"] // 2, 0)
    r_box, z_box = r * T.BOX["r"] // T.R, z * T.BOX["z"] // T.Z
    l_box = np.minimum((events.path_length * (T.BOX["l"] / T.BOX_LENGTH)).astype(np.int64), T.BOX["l"] - 1)
    shape = tuple(T.BOX[name] for name in ("phi", "r", "z"))
    box = spread(np.ravel_multi_index((turned, r_box, z_box), shape), math.prod(shape), by=groups)
    width = sum(shape)
    box_l = np.zeros((T.GROUPS, T.BOX["l"] * width))
    for place in (turned, shape[0] + r_box, shape[0] + shape[1] + z_box):
        box_l += spread(l_box * width + place, T.BOX["l"] * width, by=groups)

    records = None
    if joint:
        records = np.zeros((len(RECORD_FIELDS), joint, cells + 2))
        fields = np.stack([
            events.r, events.z, events.phi_delta, events.path_length, events.entry_b2, events.entry_azimuth
        ])  # fmt: skip
        order = np.argsort(events.entry_b2, kind="stable")
        totals = np.zeros((cells, 1))
        arguments = (weight[order], low[order], high[order])
        _deposit(*arguments, np.zeros(len(order), np.int64), inner, totals)
        chosen = np.zeros((cells, joint), dtype=np.int64)
        _choose(*arguments, inner, totals[:, 0], chosen)
        if atoms:
            records[:, :, -1] = fields[:, order[_systematic(weight[order], joint)]]
        else:
            records[:, :, 1:-1] = fields[:, order[chosen.T]]
        records[:, :, dark] = 0.0

    offset = np.hypot(events.r, events.z)
    statistics: dict[str, Any] = {
        "hit_probability": 1.0,
        "albedo": 1.0,
        "mean_cosine": truth.mean_cosine,
        "mean_z": truth.mean_z,
        "mean_r": truth.mean_r,
        "mean_miss_chord": 0.0,
        "mean_path_length": truth.mean_path_length,
        "atom_forward": truth.atom_forward,
        "atom_backward": truth.atom_backward,
        "legendre_moments": [float(v) for v in truth.legendre[: LEGENDRE + 1]],
    }
    # p_theta and the statistics hold all orders; only the conditionals lack events.residual (< 1e-9)
    ledger = {"launched": LEDGER_UNITS, "unscattered": 0, "scattered": LEDGER_UNITS}
    return _assemble(
        grain=grain,
        optics=optics,
        edges=edges,
        p_theta=p_theta,
        conditionals=conditionals,
        mean_l=mean_l,
        joint=records,
        statistics=statistics,
        standard_errors={name: 0.0 for name in STATISTICS} | {"legendre_moments": [0.0] * (LEGENDRE + 1)},
        error=TableError(cells, 0.0, 0.0 if atoms else _exact_width(optics, cells)),
        factorisation=Factorisation(box.reshape((1, T.GROUPS, *shape)), box_l.reshape((1, T.GROUPS, T.BOX["l"], width))),
        mean_offset=float((weight * offset).sum() / weight.sum()),
        ledger=ledger | {"absorbed": 0, "truncated": 0, "lost": 0},
        provenance=provenance,
    )
