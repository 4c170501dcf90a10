"""Optics: light meets a surface; the constants that a table is made for, Fresnel reflectance, a hit on a facet.

Directions are those of propagation. `Optics.eta` is that of the grain, n_inside / n_outside; `fresnel` and `parted`
take that of the hit at hand, n_transmitted / n_incident. A ray engine says which facet light meets; where, is computed
here in float64 from the facet's plane. A ray restarts `OFFSET` off the facet along its geometric normal.
"""

import math
from dataclasses import dataclass

import numpy as np

from tsdf.compiled import njit
from tsdf.errors import UsageError
from tsdf.vectors import KERNEL, dot, step, triple

Triple = tuple[float, float, float]

UNPOLARISED, S, P = 0, 1, 2
OFFSET = 1e-5  # restart distance along the geometric normal [R]: 1e-7 to 1e-4 leave no self-hits, 1e-3 biases
RETRY = 1e-3  # share of the way to the facet's centroid by which a failed restart is moved
ETA = (1e-30, 1e30)  # that a table may have (schema/SPEC.md); 1e9 is a mirror to nine digits


@dataclass(frozen=True)
class Optics:
    """The optical constants of a grain in its surroundings.

    Parameters
    ----------
    eta : float
        n_inside / n_outside, in `ETA`; below 1 for a bubble.
    fresnel : {"un", "sp"}
        Reflectance averaged over the polarisations at each hit, or the two kept apart along the whole path.
    material, source : str, optional
        Where eta is from.
    wavelength_nm, k : float, optional
        The wavelength it holds for [nm] and the extinction coefficient there [1]; tracing does not use them.

    Raises
    ------
    UsageError
        If eta is out of range or the convention is unknown.

    Examples
    --------
    >>> import tsdf
    >>> tsdf.Optics(1.31)
    Optics(eta=1.31, fresnel='un', material=None, wavelength_nm=None, k=None, source=None)
    """

    eta: float
    fresnel: str = "un"
    material: str | None = None
    wavelength_nm: float | None = None
    k: float | None = None
    source: str | None = None

    def __post_init__(self) -> None:
        if not (ETA[0] <= self.eta <= ETA[1]):
            raise UsageError(
                f"eta must be a number from {ETA[0]:g} to {ETA[1]:g} (n_inside / n_outside, above 0), got {self.eta}"
            )
        if self.fresnel not in ("un", "sp"):
            raise UsageError(f"fresnel must be 'un' or 'sp', got {self.fresnel!r}")


@njit(cache=True, inline="always")
def fresnel(cos_i: float, eta: float, polarisation: int) -> tuple[float, float]:
    """Return the power reflectance and the cosine of the refraction angle.

    Parameters
    ----------
    cos_i : float
        Cosine of the incidence angle on the incident side, in [0, 1].
    eta : float
        n_transmitted / n_incident, > 0.
    polarisation : int
        UNPOLARISED (the mean of both), S or P.

    Returns
    -------
    reflectance, cos_t : float
        (1, 0) where the reflection is total.
    """
    sin2_t = (1.0 - cos_i * cos_i) / (eta * eta)
    if sin2_t >= 1.0:
        return 1.0, 0.0
    cos_t = math.sqrt(1.0 - sin2_t)
    r_s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    r_p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    if polarisation == S:
        return r_s * r_s, cos_t
    if polarisation == P:
        return r_p * r_p, cos_t
    return 0.5 * (r_s * r_s + r_p * r_p), cos_t


@njit(forceinline=True, **KERNEL)
def sound(cosine: float, t: float, inside: bool) -> bool:
    """Return whether light on that side of a surface can meet it from there, at that angle and distance [R]."""
    return (cosine > 0.0) == inside and -10.0 * OFFSET <= t <= 2.5


@njit(forceinline=True, **KERNEL)
def on_plane(plane: np.ndarray, p: Triple, d: Triple) -> tuple[Triple, float, float]:
    """Return a facet's normal, its cosine with d and the distance along d from p to the facet's plane."""
    n = triple(plane)
    cosine = dot(n, d)
    return n, cosine, (plane[3] - dot(n, p)) / cosine


@njit(forceinline=True, **KERNEL)
def nearer(centroid: np.ndarray, p: Triple) -> Triple:
    """Return where a ray from p that lost its grain, at an edge or a vertex, is tried again: nearer the middle."""
    return step(p, RETRY, step(triple(centroid), -1.0, p))


@njit(forceinline=True, **KERNEL)
def parted(d: Triple, n: Triple, cosine: float, ratio: float, polarisation: int) -> tuple[float, Triple, Triple]:
    """Part light along d at a surface of normal n; return reflectance, reflected and refracted direction.

    `cosine` is that of d and n, `ratio` n_transmitted / n_incident. The refracted direction says nothing where the
    reflectance is 1.
    """
    cos_i = min(abs(cosine), 1.0)
    reflectance, cos_t = fresnel(cos_i, ratio, polarisation)
    bent = d
    if ratio != 1.0:
        bend = cos_t - cos_i / ratio
        bent = step(step((0.0, 0.0, 0.0), 1.0 / ratio, d), bend if cosine > 0.0 else -bend, n)
    return reflectance, step(d, -2.0 * cosine, n), bent
