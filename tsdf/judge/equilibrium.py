"""Equilibrium: light's way inside a lossless grain, exactly, for grains whose facets keep its angles.

In isotropic light the radiance inside is eta^2 times that outside, in every direction that outside light can reach, so
the mean path inside obeys <l> beta pi R^2 = eta^2 V reach. In a sphere each chord keeps its angle with the surface; in
a box or a hexagonal prism reflections only change signs of a direction, or turn it by multiples of 60 degrees: light
that meets all facets beyond the critical angle never leaves, nor ever came in. Most other grains mix all directions:
reach is 1.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

NODES = 64  # of Gauss's rule


def reach_of_sphere(eta: float) -> float:
    """Return the share of the directions inside a sphere, over its volume, that outside light reaches [1]."""
    return 1.0 if eta <= 1.0 else 1.0 - (1.0 - 1.0 / eta**2) ** 1.5


def reach_of_prism(eta: float, sides: int) -> float:
    """Return the share of the directions inside a right prism that outside light reaches [1].

    Parameters
    ----------
    eta : float
        Relative refractive index, > 0 [1].
    sides : {4, 6}
        Of the base: a box, whatever its edges, or a prism over a regular hexagon of any height.
    """
    if eta <= 1.0:
        return 1.0
    c = math.sqrt(1.0 - 1.0 / eta**2)  # cosine of the critical angle: a facet lets out what it meets at more
    half = math.pi / sides  # of the angle between the normals of neighbouring sides
    # Trapped is |z| <= c and rho cos(phi) <= c, with rho^2 = 1 - z^2 and phi in [-half, half] to the nearest normal
    low, high = math.sqrt(max(0.0, 1.0 - (c / math.cos(half)) ** 2)), min(c, 1.0 / eta)
    dark = max(0.0, c - 1.0 / eta)
    if low < high:
        t, weight = np.polynomial.legendre.leggauss(NODES)
        t = 0.5 * (t + 1.0)
        z = high - (high - low) * t**2  # the integrand rises as a root at 1/eta
        inside = np.arccos(np.minimum(c / np.sqrt(1.0 - z**2), 1.0))
        dark += float((weight * t * (high - low)) @ np.maximum(1.0 - inside / half, 0.0))
    return 1.0 - dark


def reach(grain: Mapping[str, Any], eta: float) -> float | None:
    """Return the share of directions inside that outside light reaches, None where nothing is known of the grain.

    Parameters
    ----------
    grain : mapping
        A table's account of its grain: the sphere, the sharp built-in `cube` and the `hexprism` are known.
    eta : float
        Relative refractive index, > 0 [1].
    """
    if eta <= 1.0:
        return 1.0
    if grain["kind"] == "sphere":
        return reach_of_sphere(eta)
    parameters = grain["parameters"]
    if grain["name"] == "cube" and parameters.get("bevel") == 0:
        return reach_of_prism(eta, 4)
    if grain["name"] == "hexprism" and "aspect" in parameters:
        return reach_of_prism(eta, 6)
    return None
