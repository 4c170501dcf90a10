"""Gap law: what comes next along a straight line through a packing, gathered, reduced to few records, and judged.

Where a line leaves a bounding sphere, with n_o the outward normal and d the direction, its obliquity is the squared
impact parameter b_o^2 = 1 - (n_o . d)^2. What comes next is a record: the gap to the next sphere, the squared impact
parameter b_i^2 of its entry, and psi, the azimuth about d between the tangential parts of the exit's and the entry's
normal, in [0, pi], for its sign is random. This is a property of the packing alone, whatever stands in its spheres.
Lengths are in units of the bounding radius R. The table of such laws is `packing_table`; how light uses them, `memory`.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.errors import UsageError
from tsdf.sampling import key_of, mix, unit
from tsdf.spheres.packing import Packing, cells_of, next_sphere
from tsdf.vectors import cross, dot, step

_PER_LINE = 32  # mean distances of spheres that a line is long
_JUDGED = 32  # cells of exit_b2 by which all records of a sample are judged


class Records(NamedTuple):
    """What comes next, seen along many lines; arrays of (n,) float64.

    The exits lie evenly: exit_b2 is uniform in [0, 1], whatever the packing.
    """

    exit_b2: np.ndarray  # squared impact parameter of the exit, in [0, 1] [R^2]
    gap: np.ndarray  # way to the next sphere, >= 0 [R]
    entry_b2: np.ndarray  # squared impact parameter of the entry there, in [0, 1] [R^2]
    azimuth: np.ndarray  # between the sides of exit and entry, in [0, pi] [rad]


class Law(NamedTuple):
    """What comes next by the obliquity of the exit; arrays of (cells, k) float64.

    Row c is of exits with exit_b2 in [c / cells, (c + 1) / cells), and its k records are equally likely.
    """

    gap: np.ndarray  # [R]
    entry_b2: np.ndarray  # [R^2]
    azimuth: np.ndarray  # [rad]


def mean_gap(fraction: float) -> float:
    """Return the mean gap lambda_b between spheres along a line, exact for any packing [R]."""
    return 4.0 * (1.0 - fraction) / (3.0 * fraction)


@njit(cache=True, nogil=True)
def _walk(cells, length, first, last, seed, out):
    """Write the gaps that begin on lines `first` to `last`, and return how many there are, written or not.

    Counting what begins on a piece of fixed length of an endless line gives every gap of the packing the same chance.
    """
    n = 0
    for line in range(first, last):
        key = key_of(seed, line, 0)
        z = 2.0 * unit(key) - 1.0
        azimuth = 2.0 * math.pi * unit(mix(key + np.uint64(1)))
        rho = math.sqrt(max(0.0, 1.0 - z * z))
        d = (rho * math.cos(azimuth), rho * math.sin(azimuth), z)
        p = (
            cells.side * unit(mix(key + np.uint64(2))),
            cells.side * unit(mix(key + np.uint64(3))),
            cells.side * unit(mix(key + np.uint64(4))),
        )
        p = step(p, -2.0, d)  # no sphere that is left on the line is entered before
        t, left, side, b2 = 0.0, -math.inf, (0.0, 0.0, 0.0), 0.0
        while True:
            t, i, j, k, sphere = next_sphere(cells, p, d, t, math.inf)
            if sphere < 0:
                break
            centre = (
                cells.centres[sphere, 0] + cells.side * i,
                cells.centres[sphere, 1] + cells.side * j,
                cells.centres[sphere, 2] + cells.side * k,
            )
            normal = step(step(p, t, d), -1.0, centre)
            cosine = -dot(normal, d)
            new = step(normal, cosine, d)
            new_b2 = min(dot(new, new), 1.0)
            if left >= 2.0:
                if n < len(out):
                    turn = cross(side, new)
                    out[n, 0], out[n, 1], out[n, 2] = b2, max(t - left, 0.0), new_b2
                    out[n, 3] = math.atan2(math.sqrt(dot(turn, turn)), dot(side, new))
                n += 1
            side, b2, left = new, new_b2, t + 2.0 * cosine
            if left >= length + 2.0:
                break
    return n


def gather(packing: Packing, lines: int, seed: int) -> Records:
    """Return what comes next along random lines through a packing; the same arguments give the same numbers.

    Each gap between two spheres is one record along the line and one against it.

    Parameters
    ----------
    packing : Packing
    lines : int
        Lines, each 32 mean distances between spheres long.
    seed : int
        Seed, in [0, 2^64).
    """
    cells, length = cells_of(packing), _PER_LINE * 4.0 / (3.0 * packing.fraction)
    out = np.empty((int(1.1 * _PER_LINE * lines) + 1000, 4))
    n = _walk(cells, length, 0, lines, np.uint64(seed), out)
    if n > len(out):
        out = np.empty((n, 4))
        _walk(cells, length, 0, lines, np.uint64(seed), out)
    exit_b2, gap, entry_b2, azimuth = out[:n].T
    return Records(
        np.concatenate([exit_b2, entry_b2]),
        np.concatenate([gap, gap]),
        np.concatenate([entry_b2, exit_b2]),
        np.concatenate([azimuth, azimuth]),
    )


def _cell(b2: np.ndarray, cells: int) -> np.ndarray:
    """Return the number of the cell of equal width that squared impact parameters lie in."""
    return np.minimum((b2 * cells).astype(np.int64), cells - 1)


def _leaves(coordinates: np.ndarray, order: np.ndarray, leaves: int, axis: int) -> list[np.ndarray]:
    """Return a partition of the records `order` into `leaves` parts of the same size, nearly: a k-d tree of medians."""
    if leaves == 1:
        return [order]
    half = leaves // 2
    at = len(order) * half // leaves
    order = order[np.argpartition(coordinates[axis, order], at)]
    axis = (axis + 1) % len(coordinates)
    return _leaves(coordinates, order[:at], half, axis) + _leaves(coordinates, order[at:], leaves - half, axis)


def reduce(records: Records, cells: int, k: int, seed: int = 0) -> Law:
    """Return a law of few records that stands for many.

    The records of each cell of `exit_b2` are parted into k groups of neighbours in (gap, entry_b2, azimuth), and one
    is drawn from each. Then what is known exactly is made exact: the mean gap of each cell is that of all its records,
    and `entry_b2` is as even as that of all lines is.

    Parameters
    ----------
    records : Records
    cells, k : int
        Shape of the law.
    seed : int
        Seed of the draws.
    """
    generator = np.random.Generator(np.random.PCG64([seed, cells, k]))
    cell = _cell(records.exit_b2, cells)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(cells + 1))
    if np.diff(first).min() < k:
        raise UsageError(f"{len(cell)} records are too few for {cells} cells of {k}; take more lines")
    values = np.array([records.gap, records.entry_b2, records.azimuth])
    kept = np.empty((3, cells, k))
    for c in range(cells):
        own = values[:, order[first[c] : first[c + 1]]]
        groups = _leaves(own, np.arange(own.shape[1]), k, 0)
        u = generator.random(k)
        chosen = np.array([group[int(u[i] * len(group))] for i, group in enumerate(groups)])
        kept[:, c] = own[:, chosen]
        kept[0, c] *= own[0].mean() / kept[0, c].mean()
    kept[1] = even(kept[1])
    return Law(*kept)


def even(values: np.ndarray) -> np.ndarray:
    """Return numbers in the same order that are spread evenly over [0, 1]."""
    rank = np.empty(values.size)
    rank[np.argsort(values, axis=None, kind="stable")] = np.arange(values.size)
    return ((rank + 0.5) / values.size).reshape(values.shape)


def spread(law: Law, eta: float = 1.31) -> float:
    """Return the mean squared displacement per event that a law gives to light in a packing of clear spheres [R^2].

    The exact sum over all events, no random walk: a sphere turns light in the plane of its entry and lets it out as
    obliquely as it let it in, so that the mean displacement to come depends on the cell of the exit alone, and solves
    a linear equation. In that plane, with the real axis along the side of the entry and the imaginary one along d, the
    entry's normal is m = b - i c, the exit's after p chords of central angle g is m e^(ipg), and the plane itself has
    turned by m^2 e^(ipg). Reflectance is that of unpolarised light at every hit.

    Parameters
    ----------
    law : Law
    eta : float
        Refractive index inside over outside, >= 1 [1].
    """
    cells, k = law.gap.shape
    s, b2, azimuth = (values.ravel() for values in law)
    b, c = np.sqrt(b2), np.sqrt(1.0 - b2)
    refracted = np.sqrt(1.0 - b2 / eta**2)
    reflectance = 0.5 * (
        ((c - eta * refracted) / (c + eta * refracted)) ** 2 + ((eta * c - refracted) / (eta * c + refracted)) ** 2
    )
    m, chord = b - 1j * c, np.exp(1j * (math.pi - 2.0 * np.arcsin(b / eta)))
    turned = reflectance + (1.0 - reflectance) ** 2 * chord / (1.0 - reflectance * chord)  # mean of e^(ipg)
    here, there, cosine = np.repeat(np.arange(cells), k), _cell(b2, cells), np.cos(azimuth)
    shift, turn = 1j * s + m * turned - m, m * m * turned
    # V = rest + matrix V for V = (along the side, along d) of every cell; the other side of psi cancels what is across
    rest = np.concatenate([np.bincount(here, cosine * shift.real, cells), np.bincount(here, shift.imag, cells)]) / k
    pair = here * cells + there
    parts = (cosine * turn.real, -cosine * turn.imag, turn.imag, turn.real)
    tt, td, dt, dd = (np.bincount(pair, part / k, cells * cells).reshape(cells, cells) for part in parts)
    matrix = np.block([[tt, td], [dt, dd]])
    to_come = np.linalg.solve(np.eye(2 * cells) - matrix, rest)
    ahead = to_come[:cells] + 1j * to_come[cells:]
    square = s * s + 2.0 - 2.0 * turned.real + 2.0 * s * (m * (turned - 1.0)).imag
    with_next = ((-1j * s - m.conj()) * turn + m) * ahead[there]
    each = np.bincount(here, square + 2.0 * with_next.real, cells) / k
    return float(_stationary(here, there, cells, k) @ each)


def _stationary(here: np.ndarray, there: np.ndarray, cells: int, k: int) -> np.ndarray:
    """Return how often each cell is left through in the long run, (cells,), sum 1."""
    share = np.bincount(there * cells + here, np.full(len(here), 1.0 / k), cells * cells)
    passing = share.reshape(cells, cells) - np.eye(cells)
    passing[-1] = 1.0
    return np.linalg.solve(passing, np.eye(cells)[-1])


def measured(records: Records, fraction: float) -> dict[str, float]:
    """Return what the header of a table says of all the records of a fraction, as ``PACKING.md`` defines it."""
    gap = records.gap * (mean_gap(fraction) / records.gap.mean())
    tangents = np.sqrt(records.exit_b2 * records.entry_b2) * np.cos(records.azimuth)
    return {
        "gap_second_moment": float((gap**2).mean() / (2.0 * mean_gap(fraction) ** 2)),
        "tangent_correlation": float(tangents.mean()),
        "entry_correlation": float(np.corrcoef(records.exit_b2, records.entry_b2)[0, 1]),
        "displacement": spread(_whole(records._replace(gap=gap), _JUDGED)),
    }


def _whole(records: Records, cells: int) -> Law:
    """Return the law of all records, but for those that some cells have more than the one that has the fewest."""
    cell = _cell(records.exit_b2, cells)
    order, number = np.argsort(cell, kind="stable"), np.bincount(cell, minlength=cells)
    chosen = order[(np.cumsum(number) - number)[:, None] + np.arange(number.min())]
    return Law(records.gap[chosen], records.entry_b2[chosen], records.azimuth[chosen])
