"""Point medium: grains in bulk as point scatterers, by colour, and how far light gets in it."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.picture import image
from tsdf.scene.medium import Component, VolumeParameters, volume_parameters
from tsdf.scene.scene import Absorption
from tsdf.scene.specs import absorption_at
from tsdf.walk.lights import LUMINANCE

ENOUGH = 0.02  # [1] total variation up to which one lobe is taken where a target could mix two
BETTER = 0.9  # [1] of the error of one lobe, which two must stay below
MOST_BOUNCES = 1024  # Cycles' own limit
DEEP = 4000.0  # [transport mean free paths] from which on a body counts as deep
MODES = 20_000  # of the diffusion equation in a slab
EXTRAPOLATED = 0.7104  # [transport mean free paths] beyond a boundary diffuse light vanishes (Milne)
LARGEST_G = 0.9999  # [1] as fits have it
NOTHING = Absorption("grey", (0.0,))


@dataclass(frozen=True, eq=False)
class PointMedium:
    """Grains in bulk as a homogeneous medium, by colour.

    Attributes
    ----------
    table : Table
    packing_fraction : float
        Share of the volume in bounding spheres [1], in (0, 0.74].
    radius : float
        Bounding radius of the grains [scene unit].
    absorption : (3,) float
        Absorption coefficient of the grains' material, red, green, blue [1/scene unit].

    Raises
    ------
    UsageError
        For numbers out of range.
    """

    table: Table
    packing_fraction: float
    radius: float
    absorption: tuple[float, float, float]

    def __post_init__(self) -> None:
        for a in self.absorption:
            self.at(a)

    def at(self, absorption: float) -> VolumeParameters:
        """Return the medium where the grains' material absorbs with a coefficient [1/scene unit].

        As the renderer does, the albedo is over that of the lossless grain: what the tracer of the table gave up is no
        absorption, and a millionth of it would darken a deep layer by half a percent.
        """
        grain = Component(self.table, radius=self.radius)
        found = volume_parameters([grain], self.packing_fraction, [absorption])
        return replace(found, albedo=min(1.0, found.albedo / self.table.albedo()))

    @cached_property
    def channels(self) -> tuple[VolumeParameters, ...]:
        """The medium in red, green and blue."""
        return tuple(self.at(a) for a in self.absorption)

    @property
    def sigma_t(self) -> np.ndarray:
        """Extinction, (3,) float64 [1/scene unit]."""
        return np.array([c.sigma_t for c in self.channels])

    @property
    def sigma_s(self) -> np.ndarray:
        """Scattering, (3,) float64 [1/scene unit]."""
        return np.array([c.sigma_s for c in self.channels])

    @property
    def sigma_a(self) -> np.ndarray:
        """Absorption of the medium, (3,) float64 [1/scene unit]."""
        return np.array([c.sigma_a for c in self.channels])

    @property
    def g(self) -> float:
        """Mean cosine at the luminance of the absorption, as the renderer's level volume-hg takes it; 0 if black."""
        g = self.at(float(np.dot(LUMINANCE, self.absorption))).g
        return 0.0 if math.isnan(g) else max(-LARGEST_G, min(LARGEST_G, g))

    def lobes(self, most: int | None = None) -> tuple[tuple[float, float], ...]:
        """Return share and g of the Henyey-Greenstein lobes to mix, the table's own fit if they are two.

        Two where one is farther than `ENOUGH` from the table and two are nearer, unless `most` says how many. The fit
        of two is of the lossless grain.
        """
        fits = self.table.header["fits"]
        one, two = fits["henyey_greenstein"], fits["two_lobe"]
        if most is None:
            error = one["total_variation"]
            most = 2 if error > ENOUGH and two["total_variation"] < BETTER * error else 1
        if most == 1:
            return ((1.0, self.g),)
        w = two["weight"]
        return tuple((s, max(-LARGEST_G, min(LARGEST_G, two[n]))) for s, n in ((w, "g1"), (1.0 - w, "g2")))

    def colour(self) -> np.ndarray:
        """Return the reflectance of a deep layer under diffuse light, (3,) float64 [1], after [1]."""
        return np.array([_deep_colour(c) for c in self.channels])


def point_medium(
    table: Table,
    packing_fraction: float,
    radius: float,
    absorption: Absorption = NOTHING,
    metres_per_unit: float | None = None,
) -> PointMedium:
    """Return the medium that stands for packed grains.

    A spectrum becomes three coefficients so that a deep layer has the colour it has by wavelength; taking the mean of
    the spectrum instead would let the wavelengths that are soaked up at once decide.

    Parameters
    ----------
    table : Table
    packing_fraction, radius
        As of `PointMedium`.
    absorption : Absorption
        Of the grains' material [1/scene unit]; none by default.
    metres_per_unit : float, optional
        Length of the scene unit [m]; only a material needs it.

    Raises
    ------
    UsageError
        For numbers out of range, and for a material without metres_per_unit.
    """
    if metres_per_unit is not None and not 0.0 < metres_per_unit < math.inf:
        raise UsageError(f"the scene unit must be a finite number of metres > 0, not {metres_per_unit:g}")
    lossless = PointMedium(table, packing_fraction, radius, (0.0, 0.0, 0.0))
    if absorption.kind == "spectral":
        nm, weight = image.spectral_weights()
        coefficient = absorption_at(absorption, nm, metres_per_unit)
        seen = weight.T @ np.array([_deep_colour(lossless.at(a)) for a in coefficient])
        of = [_absorption_of_colour(lossless, float(c), float(coefficient.max())) for c in seen]
    else:
        of = list(absorption.coefficient) * (3 if absorption.kind == "grey" else 1)
    red, green, blue = of
    return PointMedium(table, packing_fraction, radius, (red, green, blue))


def _deep_colour(medium: VolumeParameters) -> float:
    """Return the reflectance of a deep layer: the albedo inversion of [1] solved for the reflectance."""
    if not medium.sigma_s_reduced > 0.0:  # nothing comes back
        return 0.0
    s = math.sqrt(max(0.0, 1.0 - medium.albedo) / (1.0 - medium.albedo * medium.g))
    # s = a + b A - sqrt(c + d A + b^2 A^2); squared, what is left is linear in A
    a, b, c, d = 4.09712, 4.20863, 9.59217, 41.6808
    return min(1.0, max(0.0, (c - (a - s) ** 2) / (2.0 * b * (a - s) - d)))


def _absorption_of_colour(lossless: PointMedium, colour: float, high: float) -> float:
    """Return the absorption, from 0 to `high`, at which a deep layer has a reflectance."""
    from scipy.optimize import brentq

    def excess(a: float) -> float:
        return _deep_colour(lossless.at(a)) - colour

    if excess(0.0) <= 0.0:
        return 0.0
    return high if excess(high) >= 0.0 else float(brentq(excess, 0.0, high, xtol=1e-12 * high, rtol=1e-12))


def lost(medium: PointMedium, bounces: int, thickness: float = math.inf) -> float:
    """Return about what share of the light that leaves a slab is lost if paths end after so many scatterings [1].

    Light falls straight on one side of a slab; diffusion of the lossless walk, from one transport mean free path below
    the surface, with the albedo of the channel that absorbs least to the power of the scatterings. Within a tenth of
    the truth in slabs of five transport mean free paths and more if the share is below a tenth; too high in thinner
    ones, up to three times in one of a third of that path.

    Parameters
    ----------
    bounces : int
        Number of scatterings that are followed, >= 0.
    thickness : float
        Of the slab [scene unit]; deep by default.
    """
    best = max(medium.channels, key=lambda c: c.albedo)
    if not best.albedo > 0.0:
        return 0.0
    transport = 1.0 / (1.0 - medium.g)  # [mean free paths]
    depth = min(thickness * best.sigma_t, DEEP * transport)
    start = min(transport, 0.5 * depth) + EXTRAPOLATED * transport
    wide = depth + 2.0 * EXTRAPOLATED * transport
    k = np.pi * (2.0 * np.arange(MODES) + 1.0) / wide
    leaving = transport / 3.0 * k**2
    ending = leaving - math.log(min(best.albedo, 1.0))
    share = np.sin(k * start) / k * leaving / ending
    with np.errstate(under="ignore"):
        return float(min(1.0, max(0.0, share @ np.exp(-ending * bounces) / share.sum())))


def bounces(medium: PointMedium, kept: float = 0.99, thickness: float = math.inf) -> int:
    """Return the number of scatterings to follow so that a share of the light that leaves a slab is kept, >= 1."""
    low, high = 0, 1
    while lost(medium, high, thickness) > 1.0 - kept:
        low, high = high, 2 * high
    while high - low > max(1, high // 1000):
        middle = (low + high) // 2
        low, high = (middle, high) if lost(medium, middle, thickness) > 1.0 - kept else (low, middle)
    return high
