"""Records: a few equally likely ones drawn from the reservoirs of a tally, by column and by cell of entry."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tsdf.data.blocks import MEMORY_FIELDS, RECORD_FIELDS
from tsdf.make import tally as T
from tsdf.make.statistics import bounds, each, ratio
from tsdf.make.tally import Tally

SHIFT = (math.sqrt(5.0) - 1.0) / 2.0  # its multiples fall evenly into [0, 1)


def systematic(weights: np.ndarray, count: int, first: float = 0.5) -> np.ndarray:
    """Return `count` indices in proportion to `weights`, evenly spaced in the running sum from `first` steps on."""
    running = np.cumsum(weights)
    return np.searchsorted(running, (np.arange(count) + first) / count * running[-1], side="right").clip(
        0, len(weights) - 1
    )


ENTRY_B2 = 2 + RECORD_FIELDS.index("entry_b2")  # column of a record; the first two are key and weight


def joint_records_of(tally: Tally, cells: int) -> np.ndarray:
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
class EntryRecords:
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


def entry_records_of(tally: Tally, columns: int, count: int) -> EntryRecords:
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
    return EntryRecords(hit, records)


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
