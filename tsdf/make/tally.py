"""Tally: what the scatterometer counts; integer sums that add up in any order to the same total.

A `Tally` is a set of int64 arrays plus, if asked for, reservoirs of records by deflection and by entry. Weights are
fixed-point: a path starts with `UNIT` units of energy and every split of them is exact, so that the energy ledger
balances to the last unit and the sum over threads, chunks and machines does not depend on their order.

Cells of theta are uniform in theta, ascending from 0, with the forward and the backward atom last; `assemble` turns
them into the columns of a table. Lengths are in units of the bounding radius R, angles in radians.
"""

from dataclasses import dataclass, field, fields

import numpy as np

UNIT = 1 << 24  # energy units of one path
REPLICATES = 64  # independently scrambled samples; errors come from their spread
FINE = 4096  # cells of theta in which p_theta is counted
COARSE = 1024  # cells of theta in which the conditionals are counted; divides FINE
GROUPS = 64  # cells of theta in which joint distributions are counted; divides FINE
PHI, R, Z = 32, 64, 96  # cells of phi_Delta, r, z
BOX = {"phi": 8, "r": 16, "z": 16, "l": 16}  # cells of the joint distributions
BOX_LENGTH = 6.0  # path lengths from here on share the last cell of "l" [R]
ENTRY = 8192  # cells of entry_b2 in which rays and misses are counted; COARSE of them hold reservoirs
LEAST = 16  # records kept by entry at least, so that a column that lies across two cells has some
# Path length: nothing, 1/16 up to 6, quarter octaves up to 48, then octaves
L_FINE, L_STEP = 6.0, 16
L_EDGES = np.concatenate(
    (
        [0.0],
        np.arange(int(L_FINE * L_STEP)) / L_STEP,
        L_FINE * 2.0 ** (np.arange(13) / 4.0),
        48.0 * 2.0 ** np.arange(1, 16),
    )
)
L = len(L_EDGES) - 1
PHI_EDGES = (2.0 * np.arange(PHI + 1) - 1.0) * np.pi / PHI
R_EDGES = np.linspace(0.0, 2.0, R + 1)
Z_EDGES = np.linspace(-1.0, 2.0, Z + 1)

# First columns of the conditionals in `Tally.cells`
AT_PHI, AT_R, AT_Z, AT_L, AT_L_SUM = 0, PHI, PHI + R, PHI + R + Z, PHI + R + Z + L

# Scalar sums, one row per replicate
SCALARS = (
    "launched",
    "unscattered",
    "scattered",
    "truncated",
    "lost",
    "cos_theta",
    "r",
    "z",
    "path_length",
    "offset",
    "miss_chord",
)
LAUNCHED, UNSCATTERED, SCATTERED, TRUNCATED, LOST, COS_THETA, MEAN_R, MEAN_Z, PATH_LENGTH, OFFSET, MISS_CHORD = range(
    11
)

# A record of the reservoirs: key, weight, then table.RECORD_FIELDS or table.MEMORY_FIELDS
RECORD, MEMORY = 8, 9
RESERVOIRS = ("records", "entry_records")


@dataclass(eq=False)
class Tally:
    """Sums over paths, [units of energy] unless said otherwise.

    Parameters
    ----------
    joint : int
        Records kept per theta cell; 0 keeps none.
    memory : int
        Records kept per cell of entry_b2, LEAST or more; 0 keeps none and counts nothing by entry.
    scalars : (REPLICATES, len(SCALARS)) int64
        Energies, and energy times cos theta, r, z, l, |x_o - x_i|; miss_chord is energy times the chord of a miss.
    theta : (REPLICATES, FINE + 2) int64
        Energy by deflection.
    cells : (COARSE + 2, PHI + R + Z + 2 L) int64
        The conditionals side by side, `phi`, `r`, `z`, `l` and `l_sum`: energy by phi_Delta, r, z and path length,
        and energy times path length. In the first three all energy counts twice, as it is and reversed;
        little of it counts one way at random, with the weight of both.
    box : (2, GROUPS + 2, 8, 16, 16) int64
        Energy by (phi, r, z) of one path in eight, as it is and reversed, for the even and the odd replicates.
    box_l : (2, GROUPS + 2, 16, 8 + 16 + 16) int64
        Energy by path length and each of phi, r, z, of the same paths.
    records : (COARSE + 2, joint + 1, RECORD) float64
        Priority samples (Duffield, Lund & Thorup 2007): the records of the smallest keys u / weight, in no order.
    entry : (2, ENTRY or 0) int64
        Energy of the rays, and of those that miss the grain, by entry_b2.
    entry_records : (COARSE, memory + 1 or 0, MEMORY) float64
        As `records`, by entry_b2.
    """

    joint: int = 0
    memory: int = 0
    scalars: np.ndarray = field(default_factory=lambda: np.zeros((REPLICATES, len(SCALARS)), np.int64))
    theta: np.ndarray = field(default_factory=lambda: np.zeros((REPLICATES, FINE + 2), np.int64))
    cells: np.ndarray = field(default_factory=lambda: np.zeros((COARSE + 2, PHI + R + Z + 2 * L), np.int64))
    box: np.ndarray = field(default_factory=lambda: np.zeros((2, GROUPS + 2, BOX["phi"], BOX["r"], BOX["z"]), np.int64))
    box_l: np.ndarray = field(
        default_factory=lambda: np.zeros((2, GROUPS + 2, BOX["l"], BOX["phi"] + BOX["r"] + BOX["z"]), np.int64)
    )
    records: np.ndarray = field(default_factory=lambda: np.empty(0))
    entry: np.ndarray = field(default_factory=lambda: np.empty(0))
    entry_records: np.ndarray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        self.memory = max(self.memory, LEAST) if self.memory else 0
        if self.records.size == 0:
            self.records = np.full((COARSE + 2, self.joint + 1 if self.joint else 0, RECORD), np.inf)
        if self.entry.size == 0:
            self.entry = np.zeros((2, ENTRY if self.memory else 0), np.int64)
        if self.entry_records.size == 0:
            self.entry_records = np.full((COARSE, self.memory + 1 if self.memory else 0, MEMORY), np.inf)

    def conditional(self, name: str) -> np.ndarray:
        """Return "phi", "r", "z", "l" or "l_sum", (COARSE + 2, cells) int64, a view."""
        first, count = {
            "phi": (AT_PHI, PHI),
            "r": (AT_R, R),
            "z": (AT_Z, Z),
            "l": (AT_L, L),
            "l_sum": (AT_L_SUM, L),
        }[name]
        return self.cells[:, first : first + count]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by name; views, not copies."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("joint", "memory")}

    def add(self, other: "Tally") -> None:
        """Add the counts of `other`, which holds other paths and as many records per cell."""
        for name, mine in self.arrays().items():
            if name not in RESERVOIRS:
                mine += getattr(other, name)
            elif mine.size:
                both = np.concatenate((mine, getattr(other, name)), axis=1)
                setattr(self, name, smallest(both, mine.shape[1]))

    def narrowed(self, joint: int, memory: int) -> "Tally":
        """Return the tally of the same paths that would have kept so many records, at most as many as this one.

        The smallest of the smallest keys are the smallest of all, so nothing tells it from one that was counted so.
        """
        narrow = Tally(joint, memory, *(getattr(self, f) for f in ("scalars", "theta", "cells", "box", "box_l")))
        if narrow.joint:
            narrow.records = smallest(self.records, narrow.joint + 1)
        if narrow.memory:
            narrow.entry, narrow.entry_records = self.entry, smallest(self.entry_records, narrow.memory + 1)
        return narrow

    def check(self, launched: np.ndarray) -> None:
        """Refuse counts that no tracer can have made; for those that come from a file.

        Parameters
        ----------
        launched : (REPLICATES,) int64
            Paths of each replicate that were traced.

        Raises
        ------
        ValueError
        """
        s = self.scalars
        scattered = s[:, SCATTERED]
        by_theta = np.concatenate(
            (self.theta[:, :FINE].reshape(REPLICATES, COARSE, -1).sum(axis=2), self.theta[:, FINE:]), axis=1
        )
        unsigned = np.delete(s, (COS_THETA, MEAN_Z), axis=1)
        for counts in (unsigned, self.theta, self.cells, self.box, self.box_l, self.entry):
            _require(not counts.size or counts.min() >= 0, "negative counts")
        _require((s[:, LAUNCHED] == UNIT * launched).all(), "other light than that of the paths")
        _agree(s[:, [UNSCATTERED, SCATTERED, TRUNCATED, LOST]].T, s[:, LAUNCHED])
        _agree(self.theta.T, scattered)
        for name, ways in (("phi", 2), ("r", 2), ("z", 2), ("l", 1)):  # as it is and reversed
            _agree(self.conditional(name).T, ways * by_theta.sum(axis=0))
        _require(self.conditional("l_sum").sum() == s[:, PATH_LENGTH].sum(), "sums that do not agree")
        for i, most in ((COS_THETA, 1), (MEAN_R, 2), (MEAN_Z, 2), (OFFSET, 2)):
            _require((np.abs(s[:, i]) <= most * scattered).all(), "a mean out of its range")
        _require((s[:, MISS_CHORD] <= 2 * s[:, UNSCATTERED]).all(), "a mean out of its range")
        _require(self.box.sum(dtype=float) <= 2.01 * float(scattered.sum(dtype=float)), "too much in boxes")
        if self.memory:
            _agree(self.entry[0].reshape(-1, 1), s[:, LAUNCHED].sum())
            _require((self.entry[1] <= self.entry[0]).all(), "more misses than rays")
        cell = np.arange(COARSE)[:, None]
        b2 = self.entry_records[:, :, -1]
        _require(((b2 * COARSE >= cell - 1e-9) & (b2 * COARSE <= cell + 1.0 + 1e-9) | np.isinf(b2)).all(), "a record")
        for records, angles, lengths in (
            (self.records, (4, 7), (2, 5, 6)),
            (self.entry_records, (3, 6), (4, 7, 8)),
        ):
            kept = records[records[:, :, 0] < np.inf]
            _require(not np.isnan(records).any() and (kept[:, :2] > 0.0).all() and np.isfinite(kept).all(), "a record")
            _require((np.abs(kept[:, angles]) <= np.pi + 1e-6).all() and (kept[:, lengths] >= 0.0).all(), "a record")

    def clear(self) -> None:
        """Forget everything."""
        for name, mine in self.arrays().items():
            mine[...] = np.inf if name in RESERVOIRS else 0


def smallest(records: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` records of the smallest keys, (cells, count, RECORD), sorted by key within each cell."""
    order = np.argsort(records[:, :, 0], axis=1, kind="stable")[:, :count]
    return np.take_along_axis(records, order[:, :, None], axis=1)


def _require(holds: bool | np.bool_, what: str) -> None:
    if not holds:
        raise ValueError(what)


def _agree(parts: np.ndarray, whole: np.ndarray) -> None:
    """Refuse (n, m) parts whose sums over n are not `whole`; float sums are there because they do not overflow."""
    _require((parts.sum(axis=0, dtype=float) < 2.0**63).all(), "sums that are too large")
    _require(np.array_equal(parts.sum(axis=0), np.broadcast_to(whole, parts.shape[1:])), "sums that do not agree")
