"""Simplex: where a function of a few numbers is lowest, without derivatives.

Here and not scipy's, which takes longer to import than all searches of a build take; its steps are the
same to the last bit.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEPS = 400  # of a search, fewer than these; about 100 are enough


def lowest(function: Callable[[Floats], float], corners: Floats, near: float, level: float) -> tuple[Floats, float]:
    """Return where a function is lowest, (n,) float64, and its value there: the search of Nelder & Mead (1965).

    Parameters
    ----------
    function : callable
        Of (n,) float64.
    corners : (n + 1, n) float64
        Of the simplex that the search starts with.
    near, level : float
        It ends where corners are as near to the lowest, along each axis, and values as near to its value.
    """

    def tried(share: float) -> tuple[Floats, float]:
        """Return a point so many times as far beyond the middle as the worst is before it, and the value there."""
        point = (1.0 + share) * middle - share * corners[-1]
        return point, function(point)

    values = np.array([function(corner) for corner in corners])
    for _ in range(1, STEPS):
        order = values.argsort()
        corners, values = corners[order], values[order]
        if np.abs(corners[1:] - corners[0]).max() <= near and values[-1] - values[0] <= level:
            break
        middle = np.add.reduce(corners[:-1], 0) / (len(corners) - 1)
        new, value = tried(1.0)
        if value < values[0]:
            new, value = min((new, value), tried(2.0), key=lambda found: found[1])
        elif value >= values[-2]:
            outside, least = value < values[-1], min(value, values[-1])
            new, value = tried(0.5 if outside else -0.5)
            if value > least or (value == least and not outside):
                corners[1:] = corners[0] + 0.5 * (corners[1:] - corners[0])
                values[1:] = [function(corner) for corner in corners[1:]]
                continue
        corners[-1], values[-1] = new, value
    best = values.argmin()
    return corners[best], float(values[best])
