"""What is worth asking: what it may save to know more of a candidate, before its time is spent on it."""

import math

from tsdf.plan.prediction import Prediction

CHEAPER = 1.2  # times as long as a candidate as the chosen takes, from which on it is asked whether that would do
MAY = 1.5  # standard errors that a floor may well be off by, where it is asked what is worth a look


def hopeful(p: Prediction, target: float) -> float:
    """Return the time to an error [s] if the floor is as low as it may well be."""
    return p.seconds(target, max(p.floor.value - MAY * p.floor.error, 0.0))


def saved(p: Prediction, target: float, takes: float, chosen: bool) -> float:
    """Return what it is likely to save of the time that the chosen takes [s], to know whether a candidate meets an
    error: of another, if it does; of the chosen itself, if it does not, all. Nothing where this is known, or where
    another would not take a fifth less at best."""
    if not p.floor.error:
        return 0.0
    misses = 0.5 * math.erfc((target - p.floor.value) / (p.floor.error * math.sqrt(2.0)))
    if chosen:
        return misses * takes if p.floor.value + MAY * p.floor.error > target else 0.0
    soon = hopeful(p, target)
    return (1.0 - misses) * (takes - soon) if soon * CHEAPER < takes else 0.0
