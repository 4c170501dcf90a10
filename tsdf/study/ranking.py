"""Ranking: numbers from independent runs, and which of two candidates is surely the better.

Runs of two candidates are paired, for they share a packing and the truth's noise. A pair is told apart by the t test of
its differences; of all pairs of a scene at once by Holm's rule (1979), so that with 95 % confidence not one of the
orders that are stated is wrong.
"""

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr, stdtrit

CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A number and its standard error."""

    value: float
    error: float


class Floor(NamedTuple):
    """The root of a square that is known with an error.

    value, low, high: the root and its interval of 95 %; where the square is no more than noise, low is 0 and value and
    high are what it is below, with 95 %. seen: whether it is more than noise.
    """

    value: float
    low: float
    high: float
    seen: bool


class Pair(NamedTuple):
    """Two candidates by number, the first with the smaller mean.

    difference, error: of what tells them apart, and its standard error; resolved: whether the first is surely the
    better; within: half the interval of their difference at the confidence of all pairs; times: how many times as many
    runs would tell them apart as there were, at least.
    """

    better: int
    worse: int
    difference: float
    error: float
    resolved: bool
    within: float
    times: float


def mean_of(values: Sequence[float] | np.ndarray) -> Estimate:
    """Return the mean of independent numbers, with the error from their spread; infinite for one alone."""
    some = np.asarray(values, float)
    error = float(some.std(ddof=1)) / math.sqrt(len(some)) if len(some) > 1 else math.inf
    return Estimate(float(some.mean()), error)


def jackknife(rows: np.ndarray, statistic: Callable[[np.ndarray], float]) -> Estimate:
    """Return a statistic of independent rows, with the error from leaving out each in turn (Tukey 1958)."""
    count = len(rows)
    if count < 3:
        return Estimate(statistic(rows), math.inf)
    left = np.array([statistic(np.delete(rows, k, axis=0)) for k in range(count)])
    return Estimate(statistic(rows), math.sqrt((count - 1) * float(left.var())))


def quantile(runs: int, tail: float) -> float:
    """Return how many standard errors the mean of so many runs is off with a probability of `tail` upwards."""
    return float(stdtrit(runs - 1, 1.0 - tail)) if runs > 1 else math.inf


def floor_of(square: Estimate, runs: int) -> Floor:
    """Return the root of a mean square of so many runs."""
    value, error = square
    top = max(value, 0.0) + _times(quantile(runs, 1.0 - CONFIDENCE), error)
    if value <= _times(quantile(runs, 1.0 - CONFIDENCE), error) or value <= 0.0:
        return Floor(math.sqrt(top), 0.0, math.sqrt(top), False)
    wide = _times(quantile(runs, 0.5 * (1.0 - CONFIDENCE)), error)
    return Floor(math.sqrt(value), math.sqrt(max(value - wide, 0.0)), math.sqrt(value + wide), True)


def _times(factor: float, error: float) -> float:
    return 0.0 if error == 0.0 else factor * error


def ranked(values: np.ndarray, sizes: bool = False) -> list[Pair]:
    """Return all pairs of candidates, those that are told apart with most confidence first.

    Parameters
    ----------
    values : (candidates, runs) float64
        What is the better the smaller it is, at least two runs.
    sizes : bool
        Whether it is the better the nearer it is to zero. A pair is then told apart if both the difference and the sum
        of the two are surely not zero, for the difference of their squares is the product.
    """
    count, runs = values.shape
    found = []
    for i, j in combinations(range(count), 2):
        one, other = values[i].mean(), values[j].mean()
        if (abs(one) > abs(other)) if sizes else (one > other):
            i, j = j, i
        tests = [mean_of(values[j] - values[i])] + [mean_of(values[j] + values[i])] * sizes
        value, error = min(tests, key=_score)
        chance = 2.0 * float(stdtr(runs - 1, -_score(Estimate(value, error))))
        found.append((chance, i, j, abs(value), error))
    found.sort()
    pairs, holds = [], True
    for k, (chance, i, j, value, error) in enumerate(found):
        share = (1.0 - CONFIDENCE) / (len(found) - k)
        holds = holds and chance <= share
        needed = quantile(runs, 0.5 * share)
        # a difference smaller than its error may be any that size
        times = 1.0 if holds else math.inf if error == 0.0 else max(1.0, (needed * error / max(value, error)) ** 2)
        pairs.append(Pair(i, j, value, error, holds, _times(needed, error), times))
    return pairs


def _score(one: Estimate) -> float:
    """Return how many of its errors a number is away from zero; very many where it has none."""
    return abs(one.value) / one.error if one.error > 0.0 else 1e30 * (one.value != 0.0)


def places(count: int, pairs: Sequence[Pair]) -> list[tuple[int, int]]:
    """Return the first and the last place that each of so many candidates may have, from 1."""
    better, worse = [0] * count, [0] * count
    for pair in pairs:
        if pair.resolved:
            worse[pair.better] += 1
            better[pair.worse] += 1
    return [(1 + b, count - w) for b, w in zip(better, worse, strict=True)]


def best(values: np.ndarray) -> tuple[int, list[int]]:
    """Return the candidate with the smallest mean of values (candidates, runs), each one standard error high so that
    what is little known does not win by luck, and those that may be as good: all that it is not told apart from when
    all pairs are ranked, for which is the smallest is known from the same runs."""
    errors = values.std(axis=1, ddof=1) / math.sqrt(values.shape[1]) if values.shape[1] > 1 else 0.0
    first = int((values.mean(axis=1) + errors).argmin())
    told = {pair.worse for pair in ranked(values) if pair.resolved and pair.better == first}
    return first, [k for k in range(len(values)) if k != first and k not in told]
