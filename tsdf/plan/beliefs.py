"""Beliefs: what is expected and what was measured, as one number with an error bar.

An error that is expected is known within a factor: its logarithm is normal. What a pilot measures is a number with a
normal error, which can come out below zero. What is believed is the one times the likelihood of the other, over a grid.
"""

import math
from typing import NamedTuple

import numpy as np

STEPS = 241  # of the grid
REACH = 6.0  # spreads on either side


class Belief(NamedTuple):
    """An error that is not below zero [1]: by the mean of its logarithm, and by how much more it may well be."""

    value: float
    error: float

    @property
    def high(self) -> float:
        """What it is below in five cases of six."""
        return self.value + self.error


CERTAIN = Belief(0.0, 0.0)


def of_square(expected: float, spread: float, square: float | None = None, error: float = math.inf) -> Belief:
    """Return what is believed of an error.

    Parameters
    ----------
    expected : float
        What is expected of it [1]; 0 where it is none by definition.
    spread : float
        Standard deviation of its logarithm.
    square, error : float, optional
        Its square as measured, and the standard error of that.
    """
    if not expected > 0.0:
        return CERTAIN
    log = np.linspace(-REACH * spread, REACH * spread, STEPS)
    size = expected * np.exp(log)
    weight = -0.5 * (log / spread) ** 2
    if square is not None and error < math.inf:
        weight = weight - 0.5 * ((size**2 - square) / max(error, 1e-12)) ** 2
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    mean = float(weight @ log)
    left = math.sqrt(max(float(weight @ log**2) - mean**2, 0.0))
    value = expected * math.exp(mean)
    return Belief(value, value * math.expm1(left))


def of_bias(expected: float, measured: float | None = None, error: float = math.inf) -> tuple[float, float]:
    """Return what is believed of a bias whose size, not sign, is expected, and its standard error."""
    if measured is None or not expected > 0.0:
        return 0.0, expected
    prior, own = 1.0 / expected**2, 1.0 / max(error, 1e-9) ** 2
    return measured * own / (prior + own), math.sqrt(1.0 / (prior + own))
