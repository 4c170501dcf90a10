"""Pace of a build: how far it has come, and how many paths a round should have so that it takes about a second."""

import math
import time
from dataclasses import dataclass

from tsdf.make import statistics
from tsdf.make.crew import PIECE
from tsdf.make.spans import CHUNK_MIN

ROUND_S = 1.0  # [s] how long a round of the threads should last


@dataclass
class Pace:
    """How many paths a round should have: about ROUND_S of work, and no more than there is time for.

    Parameters
    ----------
    deadline : float
        When to stop, on the monotonic clock [s].
    length : int
        Paths of a round.
    rate : float
        Paths in a second; 0 as long as it is not known [1/s].
    """

    deadline: float
    length: int = CHUNK_MIN
    rate: float = 0.0

    def next(self, under_way: int) -> int:
        """Return the paths of the next round if so many are under way; 0 if there is no time for more."""
        if not self.rate or math.isinf(self.deadline):
            return self.length
        left = int((self.deadline - time.monotonic()) * self.rate) - under_way
        return min(self.length, left) if left >= PIECE else 0

    def learn(self, paths: int, seconds: float) -> None:
        """Take note of how long a round took; short ones say little of longer ones, but that they may be longer."""
        self.rate = paths / max(seconds, 1e-6)
        if paths == self.length and seconds < 0.5 * ROUND_S:
            self.length = min(max(2 * self.length, int(0.75 * ROUND_S * self.rate)), 8 * self.length)


@dataclass
class Progress:
    """How far a build has come.

    Attributes
    ----------
    paths : int
        Paths done.
    total : int, optional
        Paths that it will take; with a target, as far as can be told.
    rays : int
        Rays traced since `Build.run` began.
    error : TableError, optional
        Of the table that would be made now.
    """

    paths: int = 0
    total: int | None = None
    rays: int = 0
    error: statistics.TableError | None = None
