"""Light meets a surface: the optical constants that a table is made for, and Fresnel reflectance.

Directions are those of propagation. `Optics.eta` is that of the grain, n_inside / n_outside; `fresnel` takes that of
the hit at hand, n_transmitted / n_incident.
"""

import math
from dataclasses import dataclass

from tsdf.compiled import njit
from tsdf.errors import UsageError

UNPOLARISED, S, P = 0, 1, 2
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
