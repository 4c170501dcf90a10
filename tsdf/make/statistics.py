"""Statistics of a table: columns from fine cells, means and their standard errors, and what the cells lose.

Everything is a function of its arguments alone, so equal counts give equal bytes with any number of threads: sums have
a fixed order (`product`; numpy's own do, those of BLAS and LAPACK do not), and functions whose last digits depend on
numpy's vector instructions are those of `math` (`each`). Those are the C library's, whose last digits differ on
processors without fused multiply-add: of standard errors, not of pixels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tsdf.compiled import njit
from tsdf.make import tally as T
from tsdf.make.tally import Tally
from tsdf.vectors import KERNEL

LEGENDRE = 16  # highest Legendre moment in the header
MIN_CELLS, MAX_CELLS = 8, T.COARSE
HAZE = 0.3  # share of the noise that a cell width may be too large by
FEW = 8  # numbers that numpy, too, sums one by one
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
        self._sums: dict[bytes, np.ndarray] = {}

    def __call__(self, cells: int) -> TableError:
        """Return the error in so many cells."""
        if cells not in self._known:
            self._known[cells] = self._estimate(cells)
        return self._known[cells]

    def _estimate(self, cells: int) -> TableError:
        theta, replicates = self._theta, len(self._theta)
        sums = self._parts(cells, 1)[1]
        columns = np.concatenate((theta[:, T.FINE + 1 :], sums[:, ::-1], theta[:, T.FINE : T.FINE + 1]), axis=1)
        noise = columns.std(axis=0, ddof=1).sum()
        widths: list[float] = []
        for parts in (2, 4, 8, 16):
            if parts * cells > T.FINE:
                break
            width, blur = _width(*self._parts(cells, parts), sums)
            if widths and blur > 1.5 * width:
                break
            widths.append(width)
        # what still finer parts would show: nothing where the density is smooth; at a caustic, whose cells deviate as
        # the root of their width, the gains of ever finer parts add up to 2.4 times the last
        hidden = 2.4 * max(0.0, widths[-1] - widths[-2]) if len(widths) > 1 else 0.0
        return TableError(cells, float(noise * math.sqrt(0.5 / (math.pi * replicates))), widths[-1] + hidden)

    def _parts(self, cells: int, parts: int) -> tuple[np.ndarray, np.ndarray]:
        """Return where `parts` nearly equal parts of each of so many cells begin and end, and the sums over them,
        (replicates, cells * parts); cells an octave apart share them."""
        edges = bounds(cells, T.FINE)
        cuts = np.append(
            np.rint(np.linspace(edges[:-1], edges[1:], parts, endpoint=False)).astype(int).T.ravel(), T.FINE
        )
        key = cuts.tobytes()
        if key not in self._sums:
            self._sums[key] = _between(self._theta, cuts)
        return cuts, self._sums[key]

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

    def meets(self, target: float) -> bool:
        """Return whether some number of cells meets a target."""
        return self.rough().total_variation <= NEAR * target and self.best().total_variation <= target

    def fewest(self, target: float) -> TableError | None:
        """Return the error of the fewest cells that meet a target, by bisection, or None if none does."""
        if not self.meets(target):
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


def _width(cuts: np.ndarray, finer: np.ndarray, sums: np.ndarray) -> tuple[float, float]:
    """Return the total variation between columns and their nearly equal parts, and the parts' noise.

    Parameters
    ----------
    cuts : (cells * parts + 1,) int64
        Where the parts begin and end, in fine cells.
    finer : (replicates, cells * parts) float64
        What is in each part.
    sums : (replicates, cells) float64
        What is in each column.
    """
    cells = sums.shape[1]
    parts = finer.shape[1] // cells
    share = np.diff(-np.cos(cuts * (math.pi / T.FINE))).reshape(cells, parts)
    share /= share.sum(axis=1, keepdims=True)  # the density of the table is uniform in cos theta within a column
    mean, variances = found = np.zeros((2, cells, parts))
    _deviations(finer.reshape(-1, cells, parts), sums, share, found)
    squares = mean**2 - variances
    # the noise of a square is known and subtracted: part by part in columns that clearly deviate, which leaves a
    # little too much elsewhere, so there over a window of columns if that leaves less
    alone = np.sqrt(np.maximum(squares, 0.0)).sum(axis=1)
    pooled = _pooled(squares.mean(axis=1), min(17, cells))
    together = parts * np.sqrt(np.maximum(pooled, 0.0))
    clear = squares.sum(axis=1) > 3.0 * math.sqrt(2.0 / parts) * variances.sum(axis=1)
    width = 0.5 * np.where(clear, alone, np.minimum(alone, together)).sum()
    return float(width), float(np.sqrt(variances).sum() * math.sqrt(0.5 / math.pi))


@njit(**KERNEL)
def _deviations(finer: np.ndarray, sums: np.ndarray, share: np.ndarray, found: np.ndarray) -> None:
    """Write the mean over replicates of what parts have beside their share of sums, and the variance of that mean.

    finer (replicates, cells, parts); sums (replicates, cells); share (cells, parts); found (2, cells, parts), zeros.
    One row after the other, as numpy would add them.
    """
    replicates, cells, parts = finer.shape
    mean, variances = found[0], found[1]
    for r in range(replicates):
        for c in range(cells):
            for k in range(parts):
                mean[c, k] += finer[r, c, k] - sums[r, c] * share[c, k]
    mean /= replicates
    for r in range(replicates):
        for c in range(cells):
            for k in range(parts):
                deviation = finer[r, c, k] - sums[r, c] * share[c, k] - mean[c, k]
                variances[c, k] += deviation * deviation
    variances /= (replicates - 1) * replicates


def _between(values: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """Return the sums of (n, m) values from each cut to the next, to the last bit those of ``np.add.reduceat``, which
    takes several times as long where there are few between cuts."""
    sizes = np.diff(cuts)
    size = int(sizes[0])
    if sizes.max() > FEW:
        return np.add.reduceat(values[:, : cuts[-1]], cuts[:-1], axis=1)
    if size < 3 and (sizes == size).all():
        values = values[:, : cuts[-1]]
        return values.copy() if size == 1 else values[:, ::2] + values[:, 1::2]
    out = np.empty((len(values), len(sizes)))
    _sum_between(values, cuts, out)
    return out


@njit(**KERNEL)
def _sum_between(values: np.ndarray, cuts: np.ndarray, out: np.ndarray) -> None:
    """Write the sums of `FEW` values at most from each cut to the next into `out`: all but the first, which is added
    last."""
    for i in range(len(values)):
        for k in range(len(cuts) - 1):
            rest = 0.0
            for j in range(cuts[k] + 1, cuts[k + 1]):
                rest += values[i, j]
            out[i, k] = values[i, cuts[k]] + rest


def _pooled(values: np.ndarray, window: int) -> np.ndarray:
    """Return the mean of the values around each, as many as there are up to `window`."""
    count, before = len(values), (window - 1) // 2
    sums, numbers = np.zeros(count), np.zeros(count)
    for k in range(before + 1 - window, before + 1):  # from the first to the last of those around
        here, there = slice(max(0, -k), count - max(0, k)), slice(max(0, k), count - max(0, -k))
        sums[here] += values[there]
        numbers[here] += 1.0
    return sums / numbers


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


def normalised(energy: np.ndarray) -> np.ndarray:
    """Return (rows, columns) masses that sum to 1 in each column that holds anything, from (columns, rows) energy."""
    energy = energy.T.astype(np.float64)
    return ratio(energy, energy.sum(axis=0, keepdims=True))
