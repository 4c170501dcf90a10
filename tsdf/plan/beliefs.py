"""Beliefs: what is expected and what was measured, as one number with an error bar.

An error that is expected is known within a factor: its logarithm is normal. What a pilot measures is a number with a
normal error, which can come out below zero. What is believed is the one times the likelihood of the other, over a grid.
"""

import math
from typing import NamedTuple

import numpy as np

STEPS = 241  # of the grid
REACH = 6.0  # spreads on either side
FINE = 4.0  # steps of the grid that what is believed must spread over
QUANTILES = (0.5, 0.8413)  # the second one standard deviation above the first, of what is normal
PASSES = 12  # over ever finer grids, at most


class Belief(NamedTuple):
    """An error that is not below zero [1]: its median, and by how much more it may well be (one standard deviation)."""

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
    low, high = -REACH * spread, REACH * spread
    for _ in range(PASSES):  # about the mode, until it is resolved
        log = np.linspace(low, high, STEPS)
        weight = -0.5 * (log / spread) ** 2
        if square is not None and error < math.inf:
            size = expected * np.exp(log)
            weight = weight - 0.5 * ((size**2 - square) / max(error, 1e-12)) ** 2
        mode = float(log[np.argmax(weight)])
        weight = np.exp(weight - weight.max())
        weight /= weight.sum()
        mean, step = float(weight @ log), (high - low) / (STEPS - 1)
        left = math.sqrt(float(weight @ (log - mean) ** 2))
        if left > FINE * step:
            break
        low, high = mode - REACH * max(left, step), mode + REACH * max(left, step)
    value, most = expected * np.exp(np.interp(QUANTILES, np.cumsum(weight) - 0.5 * weight, log))
    return Belief(float(value), float(most - value))


def of_bias(
    expected: float, measured: float | None = None, error: float = math.inf, about: float = 0.0
) -> tuple[float, float]:
    """Return what is believed of a bias and its standard error; expected is its size, not its sign, or by how much it
    may differ from what it is `about`."""
    if measured is None or not expected > 0.0:
        return about, expected
    prior, own = 1.0 / expected**2, 1.0 / max(error, 1e-9) ** 2
    return (about * prior + measured * own) / (prior + own), math.sqrt(1.0 / (prior + own))
