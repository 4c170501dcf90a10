"""Factorisation: what drawing phi_Delta, r and z independently given theta loses, and lobes that stand for a table."""

import math
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from tsdf import simplex
from tsdf.judge import analytic
from tsdf.make import tally as T
from tsdf.make.statistics import each, product, ratio


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
    smeared = p_theta[1:-1].copy()
    smeared[0] += p_theta[0]
    smeared[-1] += p_theta[-1]
    edges = edges[1:-1]

    def variation(masses: np.ndarray) -> float:
        return float(0.5 * np.abs(masses - smeared).sum())

    limit = 0.9999
    g = min(max(mean_cosine, -limit), limit)

    def lobes(x: list[float]) -> tuple[float, float, float]:
        narrow = g + (limit - g) / (1.0 + math.exp(-x[0]))
        wide = g - (limit + g) / (1.0 + math.exp(-x[1]))
        return narrow, wide, (g - wide) / (narrow - wide) if narrow > wide else 1.0

    def both(x: list[float]) -> float:
        narrow, wide, weight = lobes(x)
        first, second = analytic.henyey_greenstein(narrow, edges), analytic.henyey_greenstein(wide, edges)
        return variation(weight * first + (1.0 - weight) * second)

    starts = [(a, b) for a in (-2.0, 0.0, 2.0, 8.0) for b in (-2.0, 0.0, 2.0)]
    found = (simplex.least(both, simplex.around(start), 1e-4, 1e-7, 400) for start in starts)
    best, least = min(found, key=itemgetter(1))
    narrow, wide, weight = lobes(best)
    return {
        "henyey_greenstein": {"g": g, "total_variation": variation(analytic.henyey_greenstein(g, edges))},
        "two_lobe": {"g1": narrow, "g2": wide, "weight": weight, "total_variation": least},
    }
