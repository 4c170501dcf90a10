"""Light that surfaces send back where k matters: Fresnel of n - i k, and what it makes of grains by wavelength.

Tables are made with n alone, and absorption only takes from the light that went through. Where k is of the size of n,
as of ice near 3 um, metals and dyes, the surface itself sends back more; grains are opaque then.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

NODES = 8  # in a cell
TINY = 1e-12


def reflectance(cosine: np.ndarray, n: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Return the share of unpolarised light that a smooth surface of index n - i k sends back [1].

    Parameters
    ----------
    cosine, n, k : float64
        Of the angle of incidence, in [0, 1], and of the matter behind; of shapes that go together.
    """
    m = n - 1j * k
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / m**2)
    s, p = (cosine - m * inside) / (cosine + m * inside), (m * cosine - inside) / (m * cosine + inside)
    return np.asarray(0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2), np.float64)


@dataclass(frozen=True, eq=False)
class Surface:
    """What k makes of the light that a surface sends back outside, by wavelength: tables are made with n alone.

    Convex grains turned to all sides send it back as a ball does (van de Hulst 1957, 8.4): of all directions equally
    much meets them, and cos theta is 1 - 2 cos^2 of the angle of incidence. What is let in is less by as much, and
    the rest of it is left as it is: exact where no light comes through.

    Attributes
    ----------
    n, k : (w,) float64
    albedo_of_n : (w,) float64
        As of n alone [1].
    convexity : float
        Four times the mean projected area of a grain over its surface, 1 of convex ones [1].
    """

    n: np.ndarray
    k: np.ndarray
    albedo_of_n: np.ndarray
    convexity: float = 1.0

    @property
    def of_n(self) -> "Surface":
        """The same without k."""
        return replace(self, k=np.zeros(len(self.n)))

    def masses(self, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is sent back into each cell of cos theta as of n alone, and with k, (w, columns) float64."""
        at, weight = np.polynomial.legendre.leggauss(NODES)
        angle = np.sqrt(np.maximum(0.5 * (1.0 - edges), 0.0))  # cosines of incidence, in which grazing light is smooth
        half = 0.5 * (angle[:-1] - angle[1:])
        cosine = (angle[1:] + half)[:, None] + half[:, None] * at
        weight = 2.0 * cosine * half[:, None] * weight
        n, k = self.n[:, None, None], self.k[:, None, None]
        without, whole = ((reflectance(cosine, n, some) * weight).sum(axis=2) for some in (np.zeros_like(k), k))
        return without, whole

    @cached_property
    def sent(self) -> np.ndarray:
        """What is sent back, as of n alone and with k, and its cosine, (2, 2, w) float64."""
        edges = np.linspace(-1.0, 1.0, 257)
        both = np.array(self.masses(edges))
        return np.stack([both.sum(axis=-1), both @ (0.5 * (edges[1:] + edges[:-1]))], axis=1)

    @cached_property
    def albedo(self) -> np.ndarray:
        """With k, (w,) float64 [1]."""
        return np.clip(self._energy(np.ones(len(self.n)), *self.sent[:, 0]), 0.0, 1.0)

    @property
    def changed(self) -> np.ndarray:
        """Where k changes anything, (w,) bool."""
        return np.asarray((self.sent[0, 0] != self.sent[1, 0]) & (self.albedo > 0.0))

    @property
    def unsure(self) -> np.ndarray:
        """Share of what k changes that may be wrong, (w,) float64 in [0, 1]: of light that is let in and comes out
        again, and of what grains that are not convex send back to themselves."""
        before = self.sent[0, 0]
        through = np.clip((self.albedo_of_n - before) / np.maximum(1.0 - before, TINY), 0.0, 1.0)
        return np.minimum(through + 1.0 - self.convexity, 1.0)

    def mean(self, values: np.ndarray, without: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Return means (w, ...) over all that leaves, with k, of those as of n alone; `without` and `whole` are sums of
        the same over what is sent back, as of n alone and with k."""
        shape = (-1,) + (1,) * (values.ndim - 1)
        changed = self.changed.reshape(shape)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(
                changed, self._energy(np.nan_to_num(values), without, whole) / self.albedo.reshape(shape), values
            )

    def _energy(self, values: np.ndarray, without: np.ndarray, whole: np.ndarray) -> np.ndarray:
        shape = (-1,) + (1,) * (values.ndim - 1)
        (before, after), energy = self.sent[:, 0], values * self.albedo_of_n.reshape(shape)
        let_in = ((1.0 - after) / np.maximum(1.0 - before, TINY)).reshape(shape)
        return np.asarray(energy + (whole - without) + (let_in - 1.0) * (energy - without), np.float64)
