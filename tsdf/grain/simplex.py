"""Simplex: where a function of a few numbers is lowest, without derivatives.

Here and not scipy's, which takes longer to import than a search takes.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEPS = 600  # of a search at most; about 100 are enough


def lowest(
    function: Callable[[Floats], float], start: Floats, size: float, near: float = 1e-7, level: float = 1e-9
) -> tuple[Floats, float]:
    """Return where a function is lowest near a start, and its value there: the search of Nelder & Mead (1965).

    Parameters
    ----------
    function : callable
        Of (n,) float64.
    start : (n,) float64
    size : float
        Of the simplex that the search starts with.
    near, level : float
        It ends where corners are as near to the lowest, along each axis, and values as near to its value.
    """
    corners = start + size * np.vstack([np.zeros(len(start)), np.eye(len(start))])
    values = np.array([function(corner) for corner in corners])
    for _ in range(STEPS):
        order = values.argsort(kind="stable")
        corners, values = corners[order], values[order]
        if values[-1] - values[0] <= level and np.abs(corners[1:] - corners[0]).max() <= near:
            break
        middle = corners[:-1].mean(axis=0)
        way = middle - corners[-1]
        new = middle + way
        value = function(new)
        if value < values[0]:
            if (farther := function(new + way)) < value:
                new, value = new + way, farther
        elif value >= values[-2]:
            nearer = middle + (0.5 if value < values[-1] else -0.5) * way
            if (there := function(nearer)) >= min(value, values[-1]):
                corners[1:] = 0.5 * (corners[0] + corners[1:])
                values[1:] = [function(corner) for corner in corners[1:]]
                continue
            new, value = nearer, there
        corners[-1], values[-1] = new, value
    return corners[0], float(values[0])
