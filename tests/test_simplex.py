"""The downhill simplex goes the same steps as scipy's."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from tsdf.simplex import around, least


def valley(x):
    return 100.0 * (x[1] - x[0] * x[0]) ** 2 + (1.0 - x[0]) ** 2


def edges(x):
    return max(abs(x[0] - 0.3), abs(x[1] + 0.2 * x[0]), abs(x[2] - x[0] * x[1]))


def waves(x):
    return math.sin(3.0 * x[0]) + 0.1 * x[0] * x[0] + abs(x[1] - 1.0) + 0.2 * math.cos(5.0 * x[1])


@pytest.mark.parametrize(("function", "size"), [(valley, 2), (edges, 3), (waves, 2)])
@pytest.mark.parametrize("steps", [17, 400])
def test_it_is_scipys_to_the_last_bit(function, size, steps):
    """From 20 places, also with coordinates 0, whether the search ends or is ended."""
    rng = np.random.default_rng(1)
    for start in 3.0 * rng.normal(size=(20, size)) * (rng.random((20, size)) < 0.8):
        options = {"xatol": 1e-4, "fatol": 1e-7, "maxiter": steps}
        expected = minimize(function, start, method="Nelder-Mead", options=options)
        point, value = least(function, around(start.tolist()), 1e-4, 1e-7, steps)
        assert point == expected.x.tolist() and value == expected.fun
