"""Arrays for Dr.Jit: tables and media of a scene, drawn from by alias tables (Walker 1977)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tsdf.loaders.mitsuba.bulk import Bulk
from tsdf.loaders.mitsuba.variant import array_of, dr, element, mi, two_elements, vectorised

AXES = ("p_r", "p_z", "p_phi", "p_l")
R, Z, PHI, LENGTH = range(len(AXES))
GUIDE = 1024  # parts of the cosines from -1 to 1


def _alias(masses: np.ndarray, bits: int) -> np.ndarray:
    """Return the alias table (Walker 1977, by Vose 1991) of each row as words: a share above, an alias below `bits`."""
    count = masses.shape[1]
    out = np.empty(masses.shape, dtype=np.uint32)
    one = 1 << (32 - bits)
    for row, mass in enumerate(masses):
        total = mass.sum()
        share = (mass / total * count).tolist() if total > 0.0 else [1.0] * count
        other = list(range(count))
        small = [i for i, s in enumerate(share) if s < 1.0]
        large = [i for i, s in enumerate(share) if s >= 1.0]
        while small and large:
            i, j = small.pop(), large[-1]
            other[i] = j
            share[j] -= 1.0 - share[i]
            if share[j] < 1.0:
                small.append(large.pop())
        for i in (*small, *large):  # what is left differs from 1 by rounding errors
            share[i] = 1.0
        kept = np.minimum(np.rint(np.array(share) * one), one - 1).astype(np.uint32)
        # A share of exactly 1 has no word: its alias is itself
        out[row] = (kept << np.uint32(bits)) | np.where(np.array(share) >= 1.0, np.arange(count), other).astype(
            np.uint32
        )
    return out


class Arrays:
    """Tables and media of a scene as arrays of the variant.

    The draws are by alias tables: one number chooses the cell and the place in it, without a search.
    """

    def __init__(self, bulks: Sequence[Bulk]) -> None:
        components = [c for b in bulks for c in b.components]
        self.first_component = array_of("UInt32", np.cumsum([0] + [len(b.components) for b in bulks])[:-1])
        self.mixed = max(len(b.components) for b in bulks) > 1
        self.kinds = array_of("UInt32", [len(b.components) for b in bulks])
        self.choice = array_of("Float", np.concatenate([np.cumsum(b.path.choice) for b in bulks]))
        self.free = array_of("Float", [b.path.lambda_beta for b in bulks])
        self.radius = array_of("Float", [c.radius for c in components])
        sigma = np.concatenate([b.sigma_a for b in bulks])
        self.absorbs = bool(sigma.any())
        self.sigma = [array_of("Float", sigma[:, k]) for k in range(3)]

        widths = [c.table.pixels.shape[1] for c in components]
        self.most = max(widths)
        self.column_bits = max(1, (self.most - 1).bit_length())
        p_theta = np.zeros((len(components), self.most))
        columns = np.zeros((sum(widths), 2))
        density = np.zeros(sum(widths))
        edges = np.full((len(components), self.most + 1), 1.0)
        first = np.concatenate(([0], np.cumsum(widths)))
        for i, c in enumerate(components):
            p_theta[i, : widths[i]] = c.table.p_theta / c.table.p_theta.sum()
            e = c.table.cos_theta_edges
            edges[i, : widths[i] + 1] = e
            width = np.diff(e)
            columns[first[i] : first[i + 1]] = np.stack((e[:-1], width), axis=1)
            density[first[i] + 1 : first[i + 1] - 1] = p_theta[i, 1 : widths[i] - 1] / width[1:-1] / (2.0 * math.pi)
        self.first_column = array_of("UInt32", first[:-1])
        guide = np.zeros((len(components), GUIDE + 1), dtype=np.int64)
        for i, width in enumerate(widths):
            cosines = np.linspace(-1.0, 1.0, GUIDE + 1)
            guide[i] = np.clip(np.searchsorted(edges[i, : width + 1], cosines, side="right") - 1, 1, width - 2)
        self.guide = array_of("UInt32", np.stack((guide[:, :-1], guide[:, 1:]), axis=-1))
        self.halvings = int(np.diff(guide, axis=1).max()).bit_length()
        self.p_theta = array_of("UInt32", _alias(p_theta, self.column_bits))
        self.columns = array_of("Float", columns)
        self.density = array_of("Float", density)
        self.edges = array_of("Float", edges)

        blocks = [[c.table.block(name).astype(np.float64) for c in components] for name in AXES]
        spans = [[np.flatnonzero(b.any(axis=1))[[0, -1]] + (0, 1) for b in axis] for axis in blocks]
        self.cells = [int(max(high - low for low, high in axis)) for axis in spans]
        self.bits = max(1, (max(self.cells) - 1).bit_length())
        self.words, self.bounds, reach = [], [], np.zeros(len(components))
        for axis, name in enumerate(AXES):
            masses = np.zeros((sum(widths), self.cells[axis]))
            bounds = np.zeros((len(components), self.cells[axis], 2))
            for i, c in enumerate(components):
                low, high = spans[axis][i]
                e = c.table.edges(name)[low : high + 1]
                masses[first[i] : first[i + 1], : high - low] = blocks[axis][i][low:high].T
                bounds[i, : high - low] = np.stack((e[:-1], np.diff(e)), axis=1)
                if axis in (R, Z):
                    reach[i] = math.hypot(reach[i], np.abs(e).max() * c.radius)
            self.words.append(array_of("UInt32", _alias(masses, self.bits)))
            self.bounds.append(array_of("Float", bounds))
        ends = np.cumsum([len(b.components) for b in bulks])
        self.reach = array_of(
            "Float", [reach[e - len(b.components) : e].max() for e, b in zip(ends, bulks, strict=True)]
        )

    def component(self, m: Any, u: Any) -> Any:
        """Return the component of the next grain met in medium m."""
        first = element(mi.UInt32, self.first_component, m)
        if not self.mixed:
            return first
        last = element(mi.UInt32, self.kinds, m) - 1
        most = max(self.kinds) if not vectorised() else int(dr.max(self.kinds)[0])
        c = mi.UInt32(0)
        for k in range(most - 1):
            c += dr.select(
                (c == k) & (k < last) & (u >= element(mi.Float, self.choice, first + dr.minimum(k, last))), 1, 0
            )
        return first + c

    def share(self, m: Any, bound: Any) -> Any:
        """Return the probability to look for far light at a grain that deep: what gets through after half a jump."""
        return dr.minimum(
            dr.exp((0.5 * element(mi.Float, self.reach, m) - bound) / element(mi.Float, self.free, m)), 1.0
        )

    def column(self, c: Any, u: Any) -> tuple[Any, Any, Any]:
        """Return the column of a deflection drawn by u, its cosine and its density [1/sr], 0 for an atom."""
        k, v = _cell(self.p_theta, c * self.most, self.most, self.column_bits, u)
        k += element(mi.UInt32, self.first_column, c)
        low, width = two_elements(self.columns, k)
        return k, dr.clip(dr.fma(v, width, low), -1.0, 1.0), element(mi.Float, self.density, k)

    def column_of(self, c: Any, cosine: Any) -> Any:
        """Return the column, not an atom, that holds a cosine, by bisection between two guides."""
        part = dr.minimum(mi.UInt32((cosine + 1.0) * (0.5 * GUIDE)), GUIDE - 1)
        first, last = two_elements(self.guide, c * GUIDE + part)
        for _ in range(self.halvings):
            middle = (first + last + 1) >> 1
            above = cosine >= element(mi.Float, self.edges, c * (self.most + 1) + middle)
            first, last = dr.select(above, middle, first), dr.select(above, last, dr.maximum(middle, first + 1) - 1)
        return first + element(mi.UInt32, self.first_column, c)

    def draw(self, axis: int, c: Any, column: Any, u: Any) -> Any:
        """Return the value on an axis that u stands for given the column."""
        k, v = _cell(self.words[axis], column * self.cells[axis], self.cells[axis], self.bits, u)
        low, width = two_elements(self.bounds[axis], c * self.cells[axis] + k)
        return dr.fma(v, width, low)

    def kept(self, c: Any, length: Any) -> Any:
        """Return the colour that a length [scene unit] of a component's material leaves of white light."""
        return mi.Color3f(*(dr.exp(-element(mi.Float, s, c) * length) for s in self.sigma))


def _cell(words: Any, row: Any, count: int, bits: int, u: Any) -> tuple[Any, Any]:
    """Return the cell of an alias table's row that u in [0, 1) chooses, and where in it, in [0, 1)."""
    x = u * count
    k = dr.minimum(mi.UInt32(x), count - 1)
    rest = x - mi.Float(k)
    word = element(mi.UInt32, words, row + k)
    alias = word & ((1 << bits) - 1)
    share = mi.Float(word >> bits) * (0.5 ** (32 - bits))
    own = (rest < share) | (alias == k)
    low, width = dr.select(own, 0.0, share), dr.select(own, dr.select(alias == k, 1.0, share), 1.0 - share)
    return dr.select(own, k, alias), (rest - low) / dr.maximum(width, 1e-9)
