"""Ranking: on numbers whose truth is known, with what a careless rule would say as a control."""

import math
from itertools import combinations

import numpy as np
import pytest

from tsdf.study.ranking import best, floor_of, jackknife, mean_of, places, ranked

RUNS, REPEATS = 10, 300


@pytest.mark.slow
def test_not_one_wrong_order_in_twenty() -> None:
    """Eight candidates that are equal, and a shared part in each run that is ten times the rest: a family of pairs has
    a wrong order in at most 5 % of the repetitions, within 3 standard errors of as many.

    Control: pair by pair at 5 % each, something wrong is stated in most.
    """
    rng = np.random.default_rng(1)
    wrong, careless = 0, 0
    for _ in range(REPEATS):
        values = rng.standard_normal((8, RUNS)) + 10.0 * rng.standard_normal(RUNS)
        wrong += any(pair.resolved for pair in ranked(values))
        scores = [mean_of(values[i] - values[j]) for i, j in combinations(range(8), 2)]
        careless += any(abs(one.value) > 2.262 * one.error for one in scores)
    assert wrong <= 0.05 * REPEATS + 3.0 * math.sqrt(0.05 * 0.95 * REPEATS)
    assert careless > 0.3 * REPEATS


def test_what_differs_is_told_apart_in_spite_of_what_is_shared() -> None:
    """A difference of 7 standard deviations of a run is always found, although the shared part is larger."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        shared = 20.0 * rng.standard_normal(RUNS)
        pair = ranked(np.array([[0.0], [7.0]]) + shared + rng.standard_normal((2, RUNS)))[0]
        assert pair[:2] == (0, 1) and pair.resolved


def test_so_many_more_runs_tell_them_apart() -> None:
    """Of a pair whose difference is known to be .3 standard deviations of a run, twice as many runs as are said to be
    needed tell it apart in most repetitions, a quarter as many in few."""
    rng = np.random.default_rng(7)
    drawn = rng.standard_normal(20)
    drawn = 0.3 + (drawn - drawn.mean()) / drawn.std(ddof=1)
    pair = ranked(np.array([np.zeros(20), drawn]))[0]
    needed = pair.times * 20
    assert not pair.resolved and 35.0 < needed < 60.0
    share = [
        np.mean([ranked(np.array([np.zeros(n), 0.3 + rng.standard_normal(n)]))[0].resolved for _ in range(100)])
        for n in (round(0.25 * needed), round(2.0 * needed))
    ]
    assert share[0] < 0.4 < 0.75 < share[1]


def test_sizes_of_either_sign() -> None:
    """-3 and 3 are not told apart, -3 and 1 are, -1 and 3 are, and the smaller is the better."""
    rng = np.random.default_rng(3)
    values = np.array([[-3.0], [3.0], [1.0], [0.0]]) + 0.1 * rng.standard_normal((4, RUNS))
    pairs = {frozenset(pair[:2]): pair for pair in ranked(values, sizes=True)}
    assert not pairs[frozenset((0, 1))].resolved
    assert pairs[frozenset((0, 2))].resolved and pairs[frozenset((0, 2))].better == 2
    assert pairs[frozenset((0, 3))].better == pairs[frozenset((1, 3))].better == pairs[frozenset((2, 3))].better == 3
    assert places(4, list(pairs.values())) == [(3, 4), (3, 4), (2, 2), (1, 1)]


def test_floors_hold_the_truth() -> None:
    """Of squares of .01 with an error of a tenth the interval of the root holds .1 in 95 % of the repetitions, within 4
    standard errors; of squares of zero the limit is above it in as many, and nothing is seen in 95 %."""
    rng = np.random.default_rng(4)
    spread = 4.0 * math.sqrt(0.05 * 0.95 / REPEATS)
    seen = [floor_of(mean_of(0.01 + 0.003 * rng.standard_normal(RUNS)), RUNS) for _ in range(REPEATS)]
    assert abs(np.mean([one.low <= 0.1 <= one.high for one in seen]) - 0.95) < spread
    assert all(one.seen for one in seen)
    none = [floor_of(mean_of(0.003 * rng.standard_normal(RUNS)), RUNS) for _ in range(REPEATS)]
    assert abs(np.mean([not one.seen for one in none]) - 0.95) < spread
    assert all(one.low == 0.0 and one.value == one.high > 0.0 for one in none if not one.seen)


def test_numbers_without_a_spread() -> None:
    """Equal numbers are equal, others are told apart; one run alone knows nothing."""
    pairs = ranked(np.array([[0.0] * 3, [0.0] * 3, [1.0] * 3]))
    assert [pair.resolved for pair in pairs] == [True, True, False] and pairs[2].times == math.inf
    assert floor_of(mean_of([0.0, 0.0]), 2) == (0.0, 0.0, 0.0, False)
    assert mean_of([1.0]).error == math.inf
    assert jackknife(np.array([[1.0], [2.0]]), lambda some: float(some.mean())).error == math.inf


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(5).standard_normal((12, 1))
    assert jackknife(values, lambda some: float(some.mean())) == pytest.approx(mean_of(values[:, 0]))


def test_the_best_and_those_that_may_be_as_good() -> None:
    rng = np.random.default_rng(6)
    values = np.array([[5.0], [1.0], [1.05], [9.0]]) + 0.2 * rng.standard_normal((4, RUNS))
    first, others = best(values)
    assert {first, *others} == {1, 2}


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 5, 12])
def test_the_best_of_equals_is_not_surely_the_best(count: int) -> None:
    """Of equal candidates any is called worse in at most 5 % of the repetitions, within 3 standard errors of as many;
    one that is 3 standard deviations of a run worse than equals, in most."""
    rng = np.random.default_rng(count)
    equal = rng.standard_normal((REPEATS, count, RUNS)) + 10.0 * rng.standard_normal((REPEATS, 1, RUNS))
    wrong = sum(len(best(values)[1]) < count - 1 for values in equal)
    assert wrong <= 0.05 * REPEATS + 3.0 * math.sqrt(0.05 * 0.95 * REPEATS)
    equal[:, 0] += 3.0
    assert np.mean([0 not in best(values)[1] for values in equal]) > 0.9
