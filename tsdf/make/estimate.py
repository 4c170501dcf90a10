"""From counts to a table: statistics, their errors, what the cells and the factorisation lose, and the header.

`columns_of` is where fine cells become the columns of a table; `traced_table` makes a `Table` of them, as
`exact.exact_table` does without counts. Everything is a function of its arguments alone, so equal counts give equal
bytes with any number of threads: sums have a fixed order (`product`; numpy's own do, those of BLAS and LAPACK do not),
and functions whose last digits depend on numpy's vector instructions are those of `math` (`each`). Those are the C
library's, whose last digits differ on processors without fused multiply-add: of standard errors, not of pixels.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from tsdf.data.blocks import BLOCKS, MEMORY_FIELDS, RECORD_FIELDS, version_for
from tsdf.data.table import Table
from tsdf.errors import TSDFError
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.make import tally as T
from tsdf.make.tally import Tally

LEGENDRE = 16  # highest Legendre moment in the header
MIN_CELLS, MAX_CELLS = 8, T.COARSE
HAZE = 0.3  # share of the noise that a cell width may be too large by
NEAR = 1.3  # errors an octave of cells beside the least are no larger than so many times it
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
SHIFT = (math.sqrt(5.0) - 1.0) / 2.0  # its multiples fall evenly into [0, 1)
# What a statistic can be; sums of rounded numbers may miss it by their last digit
RANGES = {
    "hit_probability": (0.0, 1.0),
    "albedo": (0.0, 1.0),
    "mean_cosine": (-1.0, 1.0),
    "mean_z": (-1.0, 2.0),
    "mean_r": (0.0, 2.0),
    "mean_miss_chord": (0.0, 2.0),
    "mean_path_length": (0.0, math.inf),
    "atom_forward": (0.0, 1.0),
    "atom_backward": (0.0, 1.0),
}


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


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sums of (..., n) times (n, m), (..., m) float64, always added in the same order."""
    out = np.zeros((*a.shape[:-1], b.shape[1]))
    for k in range(len(b)):
        out += a[..., k, None] * b[k]
    return out


def each(function: Callable[[float], float], values: np.ndarray) -> np.ndarray:
    """Return a function of `math` of every element; the last digits of numpy's own depend on the processor."""
    return np.array([function(value) for value in values.ravel().tolist()], dtype=np.float64).reshape(values.shape)


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
    sums = sums.astype(np.float64)  # sums over replicates may pass 2^63
    total = sums.sum(axis=0)
    left_out = statistic(total - sums)
    spread = ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
    return statistic(total), np.sqrt(spread * (len(sums) - 1) / len(sums))


def table_error(tally: Tally, cells: int) -> TableError:
    """Estimate the total variation between p_theta in `cells` cells and the truth; see `TableErrors`."""
    return TableErrors(tally)(cells)


class TableErrors:
    """Estimates of the total variation between the truth and the tables of a tally, each made once, when asked for.

    The noise is the sum of the standard errors of the columns times sqrt(2 / pi), halved. The cell width shows in how
    parts of each column differ from what its mean density gives them (a linear density shows in full in two parts),
    corrected for their own noise, in as many parts as the noise allows. So caustics narrower than a part come to light
    only with more paths, and make the width grow.

    Parameters
    ----------
    tally : Tally
    cells : int, optional
        The only number of cells that may be chosen; without it, any of `candidate_cells`.
    """

    def __init__(self, tally: Tally, cells: int | None = None) -> None:
        self._theta = tally.theta * (len(tally.theta) / tally.scalars[:, T.SCATTERED].sum())
        self._candidates = candidate_cells() if cells is None else [cells]
        self._known: dict[int, TableError] = {}

    def __call__(self, cells: int) -> TableError:
        """Return the error in so many cells."""
        if cells not in self._known:
            self._known[cells] = self._estimate(cells)
        return self._known[cells]

    def _estimate(self, cells: int) -> TableError:
        theta, replicates = self._theta, len(self._theta)
        noise = columns_of(theta, cells).std(axis=0, ddof=1).sum()
        widths: list[float] = []
        for parts in (2, 4, 8, 16):
            if parts * cells > T.FINE:
                break
            width, blur = _width(theta[:, : T.FINE], cells, parts)
            if widths and blur > 1.5 * width:
                break
            widths.append(width)
        # what still finer parts would show: nothing where the density is smooth; at a caustic, whose cells deviate as
        # the root of their width, the gains of ever finer parts add up to 2.4 times the last
        hidden = 2.4 * max(0.0, widths[-1] - widths[-2]) if len(widths) > 1 else 0.0
        return TableError(cells, float(noise * math.sqrt(0.5 / (math.pi * replicates))), widths[-1] + hidden)

    def rough(self) -> TableError:
        """Return the least error of candidates an octave apart, from the finest on to where errors rise again."""
        best = self(self._candidates[-1])
        for cells in self._candidates[-9::-8]:
            error = self(cells)
            if error.total_variation > NEAR * best.total_variation:
                break
            best = min(best, error, key=lambda e: e.total_variation)
        return best

    def best(self) -> TableError:
        """Return the least error: that of ever nearer neighbours of the best of `rough`."""
        last, best = len(self._candidates) - 1, self._candidates.index(self.rough().cells)
        for step in (4, 2, 1):
            best = min((i for i in (best - step, best, best + step) if 0 <= i <= last), key=self._variation)
        return self(self._candidates[best])

    def fewest(self, target: float) -> TableError | None:
        """Return the error of the fewest cells that meet a target, by bisection, or None if none does."""
        if self.rough().total_variation > NEAR * target or self.best().total_variation > target:
            return None
        low, high = -1, self._candidates.index(self.best().cells)
        while high - low > 1:
            middle = (low + high) // 2
            if self._variation(middle) <= target:
                high = middle
            else:
                low = middle
        return self(self._candidates[high])

    def _variation(self, candidate: int) -> float:
        return self(self._candidates[candidate]).total_variation

    def needed(self, target: float) -> tuple[float, float]:
        """Return how many times as many paths will meet a target, at least and about; infinity if none will.

        Noise falls as the root of their number; cells cost what they seem to, or less: noise may show as width.
        """
        self.rough()

        def times(haze: float) -> float:
            rooms = [
                (error.sampling_noise, target - max(0.0, error.cell_width - haze * error.sampling_noise))
                for error in self._known.values()
            ]
            return min(((noise / room) ** 2 for noise, room in rooms if room > 0.0), default=math.inf)

        least, most = times(HAZE), times(0.0)
        return least, math.sqrt(least * most) if math.isfinite(most) else least


def _width(theta: np.ndarray, cells: int, parts: int) -> tuple[float, float]:
    """Return the total variation between the columns and their `parts` nearly equal parts, and the parts' noise."""
    replicates = len(theta)
    edges = bounds(cells, T.FINE)
    cuts = np.append(np.rint(np.linspace(edges[:-1], edges[1:], parts, endpoint=False)).astype(int).T.ravel(), T.FINE)
    deviations = np.add.reduceat(theta, cuts[:-1], axis=1).reshape(replicates, cells, parts)
    share = np.diff(-np.cos(cuts * (math.pi / T.FINE))).reshape(cells, parts)
    share /= share.sum(axis=1, keepdims=True)  # the density of the table is uniform in cos theta within a column
    deviations -= np.add.reduceat(theta, edges[:-1], axis=1)[:, :, None] * share
    mean = deviations.mean(axis=0)
    deviations -= mean
    variances = np.square(deviations, out=deviations).sum(axis=0) / ((replicates - 1) * replicates)
    squares = mean**2 - variances
    # the noise of a square is known and subtracted: part by part in columns that clearly deviate, which leaves a
    # little too much elsewhere, so there over a window of columns if that leaves less
    alone = np.sqrt(np.maximum(squares, 0.0)).sum(axis=1)
    pooled = _pooled(squares.mean(axis=1), min(17, cells))
    together = parts * np.sqrt(np.maximum(pooled, 0.0))
    clear = squares.sum(axis=1) > 3.0 * math.sqrt(2.0 / parts) * variances.sum(axis=1)
    width = 0.5 * np.where(clear, alone, np.minimum(alone, together)).sum()
    return float(width), float(np.sqrt(variances).sum() * math.sqrt(0.5 / math.pi))


def _pooled(values: np.ndarray, window: int) -> np.ndarray:
    """Return the mean of the values around each, as many as there are up to `window`."""
    before = (window - 1) // 2
    padded = np.pad(np.stack((values, np.ones(len(values)))), ((0, 0), (window - 1 - before, before)))
    sums = np.zeros((2, len(values)))
    for k in range(window):
        sums += padded[:, k : k + len(values)]
    return sums[0] / sums[1]


def candidate_cells() -> list[int]:
    """Return the numbers of cells that an automatic choice tries, ascending, an eighth of an octave apart."""
    return sorted({round(2.0 ** (k / 8.0)) for k in range(24, 81)})


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


def ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.divide(a, b, out=np.zeros(np.broadcast(a, b).shape), where=b != 0)


def _scalar_statistics(sums: np.ndarray) -> np.ndarray:
    """Return STATISTICS and the mean offset, (..., 10), from sums (..., scalars + 2), the atoms last."""
    sums = np.asarray(sums, dtype=np.float64)
    scattered, launched = sums[..., T.SCATTERED], sums[..., T.LAUNCHED]
    missed = sums[..., T.UNSCATTERED]
    means = [
        1.0 - missed / launched,
        ratio(scattered, launched - missed),
        *(ratio(sums[..., i], scattered) for i in (T.COS_THETA, T.MEAN_Z, T.MEAN_R)),
        ratio(sums[..., T.MISS_CHORD], missed),
        *(ratio(sums[..., i], scattered) for i in (T.PATH_LENGTH, -2, -1, T.OFFSET)),
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
    lit = p > 0.0
    terms = np.zeros(p.shape)
    terms[lit] = p[lit] * each(math.log2, ratio(p * group, a * b)[lit])
    return float(terms.sum())


def _joint_variation(energy: np.ndarray) -> float:
    """Return the total variation between (groups, phi, r, z) and the product of its marginals given the group."""
    total = energy.sum()
    p = energy / total if total else energy
    group = p.sum(axis=(1, 2, 3), keepdims=True)
    given = ratio(p, group)
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
    density = product(p_r * p_theta, p_z.T)
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


def fits(p_theta: np.ndarray, edges: np.ndarray, mean_cosine: float) -> dict[str, Any]:
    """Return one- and two-lobe Henyey-Greenstein stand-ins of the same mean cosine, with their total variation.

    The two lobes, weights and asymmetries, are those of least total variation that keep the mean cosine, so that light
    diffuses as far as with the table itself. Lobes have no atoms: those of the table count in the cells beside them,
    so that a lobe of g near 1 may stand for one.
    """
    from scipy.optimize import minimize

    smeared = p_theta[1:-1].copy()
    smeared[0] += p_theta[0]
    smeared[-1] += p_theta[-1]
    edges = edges[1:-1]

    def variation(masses: np.ndarray) -> float:
        return float(0.5 * np.abs(masses - smeared).sum())

    limit = 0.9999
    g = min(max(mean_cosine, -limit), limit)

    def lobes(x: np.ndarray) -> tuple[float, float, float]:
        narrow = g + (limit - g) / (1.0 + math.exp(-x[0]))
        wide = g - (limit + g) / (1.0 + math.exp(-x[1]))
        return narrow, wide, (g - wide) / (narrow - wide) if narrow > wide else 1.0

    def both(x: np.ndarray) -> float:
        narrow, wide, weight = lobes(x)
        first, second = analytic.henyey_greenstein(narrow, edges), analytic.henyey_greenstein(wide, edges)
        return variation(weight * first + (1.0 - weight) * second)

    starts = [np.array((a, b)) for a in (-2.0, 0.0, 2.0, 8.0) for b in (-2.0, 0.0, 2.0)]
    options = {"xatol": 1e-4, "fatol": 1e-7, "maxiter": 400}
    best = min(
        (minimize(both, start, method="Nelder-Mead", options=options) for start in starts),
        key=lambda result: result.fun,
    )
    narrow, wide, weight = lobes(best.x)
    return {
        "henyey_greenstein": {"g": g, "total_variation": variation(analytic.henyey_greenstein(g, edges))},
        "two_lobe": {"g1": narrow, "g2": wide, "weight": weight, "total_variation": float(best.fun)},
    }


def systematic(weights: np.ndarray, count: int, first: float = 0.5) -> np.ndarray:
    """Return `count` indices in proportion to `weights`, evenly spaced in the running sum from `first` steps on."""
    running = np.cumsum(weights)
    return np.searchsorted(running, (np.arange(count) + first) / count * running[-1], side="right").clip(
        0, len(weights) - 1
    )


ENTRY_B2 = 2 + RECORD_FIELDS.index("entry_b2")  # column of a record; the first two are key and weight


def records_of(tally: Tally, cells: int) -> np.ndarray:
    """Return `tally.joint` equally likely records per column, (fields, joint, cells + 2), by ascending entry_b2.

    The reservoirs of the coarse cells in a column are one reservoir, a priority sample of all its light (Duffield, Lund
    & Thorup 2007), from which `joint` records are drawn in proportion to what each stands for.
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
        rows = rows[np.lexsort(rows.T[::-1])]  # by key, and by the rest where keys are equal
        weights = rows[:, 1]
        if len(rows) > count:  # a priority sample: each stands for its weight, or for the threshold if that is more
            weights, rows = np.maximum(weights, 1.0 / rows[count, 0])[:count], rows[:count]
        order = np.argsort(rows[:, ENTRY_B2], kind="stable")
        rows = rows[order[systematic(weights[order], count)]]
        result[:, :, column] = rows[:, 2:].T
    result[2] = np.where(result[2] <= -math.pi, math.pi, result[2])
    result[5] = np.where(result[5] <= -math.pi, math.pi, result[5])
    return result


@dataclass(frozen=True)
class Memory:
    """The response of a grain given its entry obliquity.

    Parameters
    ----------
    hit : (columns,) float64
        Share of the rays of each cell of entry_b2 that meet the grain.
    records : (fields, K, columns) float64
        Equally likely records of the light that met it, `MEMORY_FIELDS`, by ascending entry_b2; 0 where hit is.
    """

    hit: np.ndarray
    records: np.ndarray


def memory_of(tally: Tally, columns: int, count: int) -> Memory:
    """Return `count` records for each of so many equal cells of entry_b2.

    The cells do not end where the reservoirs do. Of the reservoirs that a cell touches, the least of the largest keys
    is a threshold that does not change with the key of any record below it. So the records below it are a priority
    sample of all that light and of any part of it: each stands for its weight, or for the inverse threshold if that is
    more. What they stand for is calibrated to the means of all paths, and `count` are drawn in proportion to that,
    evenly over cos theta: a chain of grains multiplies what a small sample gets wrong.
    """
    b2 = 2 + MEMORY_FIELDS.index("entry_b2")
    rays, met = _in_equal_cells(np.stack((tally.entry[0], tally.entry[0] - tally.entry[1])), columns)
    hit = np.minimum(ratio(met, rays), 1.0)
    thresholds = tally.entry_records[:, :, 0].max(axis=1)
    found: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    for column in range(columns):
        low, high = column / columns, (column + 1) / columns
        touched = slice(int(low * T.COARSE), math.ceil(high * T.COARSE))
        threshold = thresholds[touched].min()
        rows = tally.entry_records[touched].reshape(-1, T.MEMORY)
        inside = (rows[:, b2] >= low) & ((rows[:, b2] < high) | (column == columns - 1))
        rows = rows[inside & (rows[:, 0] < threshold)]
        if len(rows) == 0 or not (hit[column] > 0.0):
            hit[column] = 0.0
            rows = rows[:0]
        rows = rows[np.lexsort(rows.T[::-1])]  # an order that does not depend on how the reservoirs were filled
        found.append(rows[:, 2:])
        weights.append(np.maximum(rows[:, 1], 1.0 / threshold))
    sums = tally.scalars.astype(np.float64).sum(axis=0)
    means = {name: sums[i] / sums[T.SCATTERED] for name, i in
             (("cos_theta", T.COS_THETA), ("r", T.MEAN_R), ("z", T.MEAN_Z))}  # fmt: skip
    _calibrate(found, weights, hit, means)
    records = np.zeros((len(MEMORY_FIELDS), count, columns))
    cos_theta, b2 = MEMORY_FIELDS.index("cos_theta"), b2 - 2
    for column, (rows, weight) in enumerate(zip(found, weights, strict=True)):
        if len(rows):
            order = np.argsort(rows[:, cos_theta], kind="stable")
            chosen = rows[order[systematic(weight[order], count, column * SHIFT % 1.0)]]
            records[:, :, column] = chosen[np.argsort(chosen[:, b2], kind="stable")].T
    for name in ("entry_azimuth", "phi_delta"):
        angles = records[MEMORY_FIELDS.index(name)]
        angles[angles <= -math.pi] = math.pi
    return Memory(hit, records)


def _calibrate(
    found: Sequence[np.ndarray], weights: list[np.ndarray], hit: np.ndarray, means: Mapping[str, float]
) -> None:
    """Change the weights of records as little as gives them known means (raking, Deville & Särndal 1992).

    Parameters
    ----------
    found : sequence of (n, fields) arrays
        Records of each column.
    weights : list of (n,) arrays
        What they stand for, to be changed; left as it is where the means are out of reach.
    hit : (columns,) array
        Share of light that each column has.
    """
    fields = [MEMORY_FIELDS.index(name) for name in means]
    tilt, target = np.zeros(len(fields)), np.array(list(means.values()))
    lit = [c for c in range(len(found)) if len(found[c])]
    every = np.concatenate([found[c][:, fields] for c in lit] or [np.zeros((1, len(fields)))])
    unit = np.maximum(every.std(axis=0), 1e-12)
    for _ in range(8):
        mean, spread = np.zeros(len(fields)), np.zeros((len(fields), len(fields)))
        for c in lit:
            x = (found[c][:, fields] - target) / unit
            w = weights[c] * each(math.exp, (x * tilt).sum(axis=1))
            w *= hit[c] / w.sum()
            own = (w[:, None] * x).sum(axis=0)
            mean += own
            spread += (w[:, None, None] * x[:, :, None] * x[:, None, :]).sum(axis=0) - np.outer(own, own) / hit[c]
        if np.abs(mean).max() < 1e-9 * hit.sum():
            break
        tilt = tilt - _solution(spread, mean)
        # weights that change by more than e^30 mean that a sample cannot have these means
        if not ((np.abs(tilt) < 1.0).all() and (np.abs((every - target) / unit * tilt).sum(axis=1) < 30.0).all()):
            return
    for c in lit:
        weights[c] = weights[c] * each(math.exp, ((found[c][:, fields] - target) / unit * tilt).sum(axis=1))


def _solution(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return x of matrix x = right for a small positive semi-definite matrix, 0 where it says nothing of x."""
    matrix, x = matrix.copy(), right.copy()
    least, left = 1e-9 * np.diag(matrix).max(), list(range(len(x)))
    while left:
        k = max(left, key=lambda i: matrix[i, i])
        if not (matrix[k, k] > least):
            break
        left.remove(k)
        x[k] /= matrix[k, k]
        matrix[k] /= matrix[k, k]
        for i in range(len(x)):
            if i != k:
                x[i] -= matrix[i, k] * x[k]
                matrix[i] -= matrix[i, k] * matrix[k]
    x[left] = 0.0
    return x


def _in_equal_cells(counts: np.ndarray, columns: int) -> np.ndarray:
    """Sum (..., n) counts by equal cells of [0, 1] into `columns` of them; what lies across a limit is divided."""
    running = np.zeros((*counts.shape[:-1], counts.shape[-1] + 1))
    np.cumsum(counts, axis=-1, out=running[..., 1:])
    places = np.arange(columns + 1) * counts.shape[-1] / columns
    before = places.astype(int)
    after = np.minimum(before + 1, counts.shape[-1])
    sums = running[..., before] + (places - before) * (running[..., after] - running[..., before])
    return np.maximum(np.diff(sums, axis=-1), 0.0)


def normalised(energy: np.ndarray) -> np.ndarray:
    """Return (rows, columns) masses that sum to 1 in each column that holds anything, from (columns, rows) energy."""
    energy = energy.T.astype(np.float64)
    return ratio(energy, energy.sum(axis=0, keepdims=True))


def software() -> str:
    """Return name and version of this package."""
    try:
        return f"tsdf-toolkit {version('tsdf-toolkit')}"
    except PackageNotFoundError:
        return "tsdf-toolkit"


def assemble(  # noqa: PLR0913 - by keyword: what a header holds
    *,
    grain: Mapping[str, Any],
    optics: Optics,
    edges: np.ndarray,
    p_theta: np.ndarray,
    conditionals: Mapping[str, np.ndarray],
    mean_l: np.ndarray,
    joint: np.ndarray | None,
    memory: Memory | None,
    statistics: dict[str, Any],
    standard_errors: dict[str, Any],
    error: TableError,
    factorisation: Factorisation,
    mean_offset: float,
    ledger: Mapping[str, int],
    provenance: Mapping[str, Any],
) -> Table:
    """Stack the blocks and write the header, so that every rule of SPEC.md on values holds.

    Sums of rounded numbers may put a mean beside its cell or a statistic beside its range, by no more than was
    rounded: there they are put on the edge.
    """
    lower, upper = T.L_EDGES[:-1, None], np.append(T.L_EDGES[1:-1], math.inf)[:, None]
    mean_l = np.where(conditionals["p_l"].astype(np.float32) > 0.0, np.clip(mean_l, lower, upper), 0.0)
    statistics = (
        statistics
        | {name: min(max(statistics[name], low), high) for name, (low, high) in RANGES.items()}
        | {"legendre_moments": [min(max(moment, -1.0), 1.0) for moment in statistics["legendre_moments"]]}
    )
    values = {"p_theta": p_theta[None, :], **conditionals, "mean_l": mean_l}
    if joint is not None:
        values |= {f"joint_{name}": rows for name, rows in zip(RECORD_FIELDS, joint, strict=True)}
    if memory is not None:
        values |= {f"memory_{name}": rows for name, rows in zip(MEMORY_FIELDS, memory.records, strict=True)}
        values["memory_hit"] = memory.hit[None, :]
    edges_of = {"p_phi": T.PHI_EDGES, "p_r": T.R_EDGES, "p_z": T.Z_EDGES, "p_l": T.L_EDGES}
    blocks: list[dict[str, Any]] = []
    stacked: list[np.ndarray] = []
    for block in BLOCKS:
        if block.name in values:
            axis = edges_of[block.name].tolist() if block.axis else None
            blocks.append(block.entry(sum(map(len, stacked)), len(values[block.name]), axis))
            stacked.append(values[block.name])
    pixels = np.concatenate(stacked).astype(np.float32)
    header = {
        "format": "tsdf",
        "format_version": version_for(block["name"] for block in blocks),
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
    tally: Tally,
    cells: int,
    grain: Mapping[str, Any],
    optics: Optics,
    provenance: Mapping[str, Any],
    memory: int = 0,
) -> Table:
    """Return the table that a tally of traced paths stands for, with `memory` records by entry in each column.

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
    fine = np.concatenate(
        (tally.theta[:, T.FINE + 1 :], tally.theta[:, T.FINE - 1 :: -1], tally.theta[:, T.FINE : T.FINE + 1]), axis=1
    )
    moments, moment_errors = jackknife(
        fine, lambda energy: ratio(product(energy, matrix), energy.sum(axis=-1, keepdims=True))
    )
    statistics: dict[str, Any] = dict(zip(STATISTICS, values[:-1].tolist(), strict=True))
    standard_errors: dict[str, Any] = dict(zip(STATISTICS, errors[:-1].tolist(), strict=True))
    moments[:2], moment_errors[:2] = (1.0, statistics["mean_cosine"]), (0.0, standard_errors["mean_cosine"])
    statistics["legendre_moments"], standard_errors["legendre_moments"] = moments.tolist(), moment_errors.tolist()

    energy = columns_of(tally.theta.sum(axis=0), cells)
    columns = {
        name: columns_of(np.ascontiguousarray(tally.conditional(name).T), cells).T
        for name in ("phi", "r", "z", "l", "l_sum")
    }
    totals = dict(zip(T.SCALARS, (int(v) for v in tally.scalars.astype(object).sum(axis=0)), strict=True))
    ledger = {name: totals[name] for name in ("launched", "unscattered", "scattered")}
    ledger |= {"absorbed": 0, "truncated": totals["truncated"], "lost": totals["lost"]}
    return assemble(
        grain=grain,
        optics=optics,
        edges=cos_theta_edges(cells),
        p_theta=energy / energy.sum(),
        conditionals={f"p_{name}": normalised(columns[name]) for name in ("phi", "r", "z", "l")},
        mean_l=ratio(columns["l_sum"].astype(np.float64), columns["l"].astype(np.float64)).T,
        joint=records_of(tally, cells) if tally.joint else None,
        memory=memory_of(tally, cells + 2, memory) if memory else None,
        statistics=statistics,
        standard_errors=standard_errors,
        error=table_error(tally, cells),
        factorisation=Factorisation(tally.box, tally.box_l),
        mean_offset=float(values[-1]),
        ledger=ledger,
        provenance=provenance,
    )
