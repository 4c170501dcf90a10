"""Deep media: the colour of grains in bulk, or in a slab, and the absorption that gives a colour.

Point scatterers with the table's own deflections, as level volume has them, in plane layers under diffuse light, by
doubling [1] with delta-M scaling [2]. Absorption is sigma_a R, the table's. A deep medium has no length in it, so that
its colour does not depend on the grains' size or packing.

[1] Wiscombe 1976, doi:10.1016/0022-4073(76)90007-2: doubling from a layer so thin that the diamond rule serves
[2] Wiscombe 1977, doi:10.1175/1520-0469(1977)034<1408:TDMRYA>2.0.CO;2
"""

import math
from collections.abc import Sequence

import numpy as np

from tsdf.data.phase import legendre
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.scene.medium import Component, volume_parameters

STREAMS = 12  # directions of a hemisphere; 32 differ by less than 1e-6
THINNEST = 0.125  # of the least cosine of a stream, over which the first layer is thinner
DARK = 1e-7  # [1] transmittance of what is deep
DOUBLINGS = 60
X = 1e-12, 1e6  # absorption times radius that is tried


def deep_colour(table: Table, absorption_times_radius: float, optical_depth: float = math.inf) -> float:
    """Return the share of diffuse light that a deep medium of grains sends back [1]; of a slab, if its depth is given.

    Parameters
    ----------
    table : Table
    absorption_times_radius : float
        sigma_a R of the grains' material [1], >= 0.
    optical_depth : float
        sigma_t times the thickness of a slab with nothing behind it [1], > 0; deep by default.
    """
    w = min(1.0, table.single_scattering_albedo(absorption_times_radius).value)
    if w <= 0.0:
        return 0.0
    moments = _moments(table, absorption_times_radius)
    peak = 0.5 * (moments[-2] + moments[-1])  # two, lest an atom straight back counts as one straight on
    if w >= 1.0 and math.isinf(optical_depth):
        return 1.0 if moments[1] < 1.0 else 0.0
    if peak >= 1.0 - 1e-12:
        return 0.0  # nothing ever deflects light
    scaled = (moments[:-2] - peak) / (1.0 - peak)
    depth = (1.0 - w * peak) * optical_depth
    w = w * (1.0 - peak) / (1.0 - w * peak)
    return _reflectance(scaled, w, depth)


def _moments(table: Table, x: float) -> np.ndarray:
    """Return the Legendre moments of the deflections of absorbing grains, (2 STREAMS + 2,), the first of them 1."""
    masses = table.deflection_masses(x)
    return legendre(table.cos_theta_edges, masses / masses.sum(), 2 * STREAMS + 1)


def _reflectance(moments: np.ndarray, w: float, depth: float) -> float:
    """Return the share of diffuse light that a layer reflects, moments (2 STREAMS,), albedo w, by doubling."""
    nodes, weights = np.polynomial.legendre.leggauss(STREAMS)
    mu, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    at = np.polynomial.legendre.legvander(mu, len(moments) - 1)
    order = np.arange(len(moments))
    strength = (2 * order + 1) * moments * (0.5 * w)
    ahead = (at * strength) @ at.T * weights
    back = (at * strength * (-1.0) ** order) @ at.T * weights
    eye = np.eye(STREAMS)
    loss = (eye - ahead) / mu[:, None]
    turn = back / mu[:, None]
    thin = THINNEST * float(mu.min())
    steps = 0 if math.isinf(depth) else max(0, math.ceil(math.log2(depth / thin)))
    first = thin if math.isinf(depth) else depth / 2.0**steps
    # Light alike from both sides, and opposite: what comes out is R + T and T - R of what goes in
    alike, opposite = (
        np.linalg.solve(eye + 0.5 * first * m, eye - 0.5 * first * m) for m in (loss - turn, loss + turn)
    )
    reflect, transmit = 0.5 * (alike - opposite), 0.5 * (alike + opposite)
    flux = 2.0 * weights * mu
    for _ in range(DOUBLINGS if math.isinf(depth) else steps):
        between = np.linalg.solve((eye - reflect @ reflect).T, transmit.T).T  # T (1 - R R)^-1
        reflect, transmit = reflect + between @ reflect @ transmit, between @ transmit
        if float(flux @ transmit.sum(axis=1)) < DARK:
            break
    return min(1.0, max(0.0, float(flux @ reflect.sum(axis=1))))


def absorption_of_colour(
    table: Table,
    colour: Sequence[float],
    thickness: float = math.inf,
    packing_fraction: float = 0.5,
) -> tuple[float, ...]:
    """Return the absorption, sigma_a R by channel [1], of which grains in bulk have a colour in diffuse light.

    Parameters
    ----------
    table : Table
    colour : sequence of float
        Share of diffuse light that comes back, by channel, each > 0 and < 1; linear.
    thickness : float
        Of a slab with nothing behind it [R]; a deep medium by default.
    packing_fraction : float
        Share of the volume in bounding spheres [1]; of a slab only.

    Raises
    ------
    UsageError
        In one line, for a colour of 0 or less, of 1 or above, darker than what is reflected outside of grains, or
        brighter than the slab is without absorption.
    """
    return tuple(_one(table, float(c), thickness, packing_fraction) for c in colour)


def check_colour(colour: Sequence[float]) -> None:
    """Refuse what nothing that absorbs can have as its colour.

    Raises
    ------
    UsageError
        In one line.
    """
    for c in colour:
        if not 0.0 < c < 1.0:
            why = "without any absorption it is 1" if c >= 1.0 else "grains reflect some light whatever they absorb"
            way = "take a linear value such as 0.99 or 0.05"
            raise UsageError(f"a colour is > 0 and < 1 in each channel, not {c:g}: {why}; {way}")


def _one(table: Table, colour: float, thickness: float, packing_fraction: float) -> float:
    from scipy.optimize import brentq

    check_colour([colour])

    def excess(log_x: float) -> float:
        x = math.exp(log_x)
        if math.isinf(thickness):
            return deep_colour(table, x) - colour
        sigma_t = volume_parameters([Component(table)], packing_fraction, [x]).sigma_t
        return deep_colour(table, x, sigma_t * thickness) - colour

    low, high = (math.log(x) for x in X)
    brightest, darkest = excess(low) + colour, excess(high) + colour
    if not colour < brightest:
        what = "a deep medium" if math.isinf(thickness) else f"a slab {thickness:g} R thick"
        raise UsageError(
            f"a colour of {colour:g} is out of reach: {what} of this grain reflects {brightest:.4g} at most; say less"
        )
    if not colour > darkest:
        raise UsageError(
            f"a colour of {colour:g} is out of reach: grains reflect {darkest:.3g} of the light outside, whatever they "
            "absorb; say more than that"
        )
    return math.exp(float(brentq(excess, low, high, xtol=1e-7, rtol=1e-12)))
