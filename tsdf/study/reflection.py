"""Light that surfaces send back where k matters: Fresnel of n - i k, and what it makes of grains by wavelength.

Tables are made with n alone, and absorption only takes from the light that went through. Where k is of the size of n,
as of ice near 3 um, metals and dyes, the surface itself sends back more; grains are opaque then.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

NODES = 8  # in a cell
BATCH = 64  # wavelengths at once, for memory
FELT = 3e-3  # k over n below which a surface does not know of it: 1e-5 of the light
LEAST = 1e-6  # of the light, that is told from none
TINY = 1e-12


def reflectance(cosine: np.ndarray, n: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Return the share of unpolarised light that a smooth surface of index n - i k sends back [1].

    Parameters
    ----------
    cosine, n, k : float64
        Of the angle of incidence, in (0, 1], and of the matter behind; of shapes that go together.
    """
    m = n - 1j * k
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / m**2)
    s, p = (cosine - m * inside) / (cosine + m * inside), (m * cosine - inside) / (m * cosine + inside)
    return np.asarray(0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2), np.float64)


def sent_back(edges: np.ndarray, n: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Return the share of the light that convex grains send back from outside into each cell, (w, columns) float64.

    Turned to all sides they send it back as a ball does (van de Hulst 1957, 8.4): of all directions equally much meets
    them, and cos theta is 1 - 2 cos^2 of the angle of incidence.

    Parameters
    ----------
    edges : (columns + 1,) float64
        Of cos theta, ascending.
    n, k : (w,) float64
    """
    at, weight = np.polynomial.legendre.leggauss(NODES)
    angle = np.sqrt(np.maximum(0.5 * (1.0 - edges), 0.0))  # cosines of incidence, in which grazing light is smooth
    half = 0.5 * (angle[:-1] - angle[1:])
    cosine = np.maximum((angle[1:] + half)[:, None] + half[:, None] * at, TINY)
    weight = 2.0 * cosine * half[:, None] * weight
    found = np.zeros((len(n), len(half)))
    for some in range(0, len(n), BATCH):
        here = slice(some, some + BATCH)
        found[here] = (reflectance(cosine, n[here, None, None], k[here, None, None]) * weight).sum(axis=2)
    return found


@dataclass(frozen=True, eq=False)
class Surface:
    """What k makes of the light that grains send back outside, by wavelength, beside tables that are made with n alone.

    Light that is let in, and out again or back, is less or more by as much each time: exact where grains are convex and
    no light comes through.

    Attributes
    ----------
    n, k : (w,) float64
    eta : (t,) float64
        Of the tables.
    convexity : float
        Four times the mean projected area of a grain over its surface, 1 of convex ones [1].
    """

    n: np.ndarray
    k: np.ndarray
    eta: np.ndarray
    convexity: float = 1.0

    @cached_property
    def felt(self) -> np.ndarray:
        """Where k changes anything, (w,) bool."""
        return np.asarray(self.k > FELT * self.n)

    def sent(self, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is sent back into each cell of cos theta, as in the tables, (t, columns), and with k where it is
        felt, (felt, columns) float64."""
        there = self.n[self.felt], self.k[self.felt]
        return sent_back(edges, self.eta, np.zeros(len(self.eta))), sent_back(edges, *there)

    @cached_property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """What is sent back in all, and its cosine, as in the tables, (t, 2), and with k, (felt, 2) float64."""
        edges = np.linspace(-1.0, 1.0, 513)
        one = np.stack([np.ones(512), 0.5 * (edges[1:] + edges[:-1])], axis=1)
        tables, felt = self.sent(edges)
        return tables @ one, felt @ one

    def energy(
        self, weights: np.ndarray, albedo: np.ndarray, of_n: np.ndarray, sent: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """Return energies (felt, ...) with k, over that which met the grain.

        Parameters
        ----------
        weights : (felt, t) float64
            Of tables.
        albedo, of_n : (felt,), (felt, ...) float64
            Albedo and these energies as of n alone.
        sent : (t, ...), (felt, ...) float64
            What of them is sent back, as in the tables, and with k.
        """
        (tables, felt), through = self.whole, self._through(weights, albedo)
        before, after = weights @ tables[:, 0], felt[:, 0]
        # what is left of light from one meeting of the surface to the next, where each sends back as much
        left = through / np.maximum(1.0 - before + before * through, TINY)
        more = (1.0 - after) ** 2 / np.maximum((1.0 - before) * (1.0 - before + before * through), TINY)
        more = np.where(1.0 - before > LEAST, more / np.maximum(1.0 - after * left, TINY), 0.0)
        # grains that take back what they send send back less than convex ones
        fewer = (before > LEAST) & (albedo < before)
        sends = np.where(fewer, np.maximum(albedo, 0.0) / np.where(fewer, before, 1.0), 1.0)
        more, sends = (some.reshape((-1,) + (1,) * (of_n.ndim - 1)) for some in (more, sends))
        return np.asarray(sends * sent[1] + more * (of_n - sends * np.tensordot(weights, sent[0], axes=1)), np.float64)

    def unsure(self, weights: np.ndarray, albedo: np.ndarray) -> np.ndarray:
        """Return the share of what k changes that may be wrong, (felt,) float64 in [0, 1], for albedos of n alone: that
        of light that comes through, and what grains that are not convex send back to themselves."""
        return np.minimum(self._through(weights, albedo) + 1.0 - self.convexity, 1.0)

    def _through(self, weights: np.ndarray, albedo: np.ndarray) -> np.ndarray:
        """Return the share of the light that is let in as of n alone and comes out again, (felt,)."""
        before = weights @ self.whole[0][:, 0]
        return np.clip((albedo - before) / np.maximum(1.0 - before, TINY), 0.0, 1.0)
