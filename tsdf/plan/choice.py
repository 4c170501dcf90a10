"""The choice: which of the candidates is taken, of what is predicted of them."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from tsdf.plan.prediction import TIE, UNFINISHED, Prediction
from tsdf.scene.levels import LEVELS

SPARED = 5.0  # [s] that one has to spare for one to be taken that may be a little above the target; as planning takes
SWAMPED = 1.2  # times the least error of pixels that one may have and be taken for its regions


class Wish(NamedTuple):
    """What a picture is to be like, and what is known of all candidates."""

    target: float  # error that is asked for [1]
    limit: float  # time that there is, of processors that have nothing else to do [s]
    spp: int | None = None  # samples of a pixel that it has instead
    sunny: bool = False  # whether suns are smaller than in pilots
    dear: bool = False  # whether single grains could not be piloted

    def able(self, p: Prediction) -> float:
        """Return the time that there is [s], or that the samples asked for take."""
        return self.limit if self.spp is None else p.turn * self.spp

    def unfinished(self, p: Prediction) -> bool:
        """Return whether single grains under small suns are still but bright dots after the time that there is."""
        return self.sunny and p.candidate.single and p.noise(self.able(p)) > UNFINISHED

    def glints(self, chosen: Prediction, others: Sequence[Prediction]) -> float:
        """Return from when on single grains are taken [s] that have less error than the chosen but are left out, as
        mostly noise; 0 where there are none."""
        left_out = [
            p
            for p in others
            if self.unfinished(p) and TIE * p.likely_error(self.limit) < chosen.likely_error(self.limit)
        ]
        return min((p.variance * p.turn / UNFINISHED**2 for p in left_out), default=0.0)


def choose(found: list[Prediction], wish: Wish) -> tuple[Prediction, bool]:
    """Return what is taken, and whether that is by the error of regions.

    It is the cheapest that meets the target if bias and texture are as large as may well be; or one that is likely to,
    and at most a fifth above it then, if that saves more than planning takes. If there is a time and none does, it is
    the one with the least error in it, of those that aim at small suns. With so many samples it is the cheapest of
    those whose noise is about the least, or small enough, and that miss less than the target. None is taken of whose
    noise nothing is known, unless nothing is of any. Where that with the least error has no single grains and misses
    more texture than the target, no pixel can be right with it, nor with any other that has none: of these, as far as
    their errors are within a fifth of it, it is the one whose regions are.
    """
    found = [p for p in found if math.isfinite(p.variance)] or found
    if wish.dear:  # what few samples have told of paths that long is not what they take
        found = [p for p in found if not LEVELS[p.candidate.level].traits.answered] or found
    if wish.spp is not None:
        after = {p.candidate: p.likely_error(wish.able(p)) for p in found}
        aimed = [p for p in found if not wish.unfinished(p)] or found
        enough = max(wish.target, TIE * min(after[p.candidate] for p in aimed))
        alike = [p for p in aimed if after[p.candidate] <= enough] or aimed  # of pilots without light
        fit = [p for p in alike if p.floor.high < wish.target]
        return min(fit, key=lambda p: p.turn) if fit else safest(alike, lambda p: p.floor.high), False
    limit, time_of = wish.limit, Prediction.sure_seconds
    takes, soon = (min(by(p, wish.target) for p in found) for by in (time_of, Prediction.safe_seconds))
    if takes > min(soon + SPARED, limit):
        takes, time_of = soon, Prediction.safe_seconds
    if not takes <= limit and math.isfinite(limit):
        # sparkle that is not rendered to the end is nothing but noise; and what all miss tells none from the others
        aimed = [p for p in found if not wish.unfinished(p) and p.turn <= limit]
        aimed = aimed or [p for p in found if not wish.unfinished(p)] or found
        least = min(aimed, key=lambda p: p.likely_error(limit))
        if not least.candidate.single and least.texture > wish.target:
            return safest(swamped(aimed, limit), lambda p: p.error_of_regions(limit)), True
        enough = TIE * least.likely_error(limit)
        alike = [p for p in aimed if p.likely_error(limit) <= enough] or aimed  # of pilots without light
        return safest(alike, lambda p: math.hypot(p.bias, p.bias_error, p.noise(limit))), False
    if math.isinf(takes):
        return safest(found, lambda p: p.floor.high), False
    alike = [p for p in found if time_of(p, wish.target) <= TIE * takes]
    return min(alike, key=lambda p: p.floor.high), False


def swamped(some: Sequence[Prediction], seconds: float) -> list[Prediction]:
    """Return those without single grains whose errors of pixels after so long [s] do not tell them apart."""
    some = [p for p in some if not p.candidate.single]
    enough = SWAMPED * min((p.likely_error(seconds) for p in some), default=0.0)
    return [p for p in some if not p.likely_error(seconds) > enough]


def safest(some: Sequence[Prediction], error: Callable[[Prediction], float]) -> Prediction:
    """Return the one with the least error; of those that have as little as can be told, that which models most."""
    least = TIE * min(error(p) for p in some)
    order = list(LEVELS)
    return min(
        (p for p in some if not error(p) > least),  # of pilots without light nothing is
        key=lambda p: (order.index(p.candidate.level), -p.candidate.explicit_grains),
    )
