"""Downhill simplex: the least value of a function of a few numbers, without a derivative.

As `scipy.optimize.minimize` finds it by Nelder-Mead, step for step and to the last bit, on plain numbers: for so few
that is twice as fast, and a build need not import what takes longer to import than the search.
"""

from collections.abc import Callable, Sequence

Point = list[float]
EVERY, ZERO = 0.05, 0.00025  # how far `around` steps from a number, as a share of it, and from 0


def around(start: Sequence[float]) -> list[Point]:
    """Return the simplex about a point from which a search begins that knows no better: one number larger in each."""
    simplex = [list(start)]
    for k, value in enumerate(start):
        simplex.append(list(start))
        simplex[-1][k] = (1.0 + EVERY) * value if value != 0.0 else ZERO
    return simplex


def least(
    function: Callable[[Point], float], simplex: Sequence[Sequence[float]], near: float, alike: float, steps: int
) -> tuple[Point, float]:
    """Return where a function is least near a simplex, and its value there.

    Parameters
    ----------
    function : callable
        From n numbers to one.
    simplex : (n + 1) points of n numbers
        Where to begin.
    near, alike : float
        The search ends when no corner is farther than `near` from the best along any axis, and no value larger than
        the best by more than `alike`.
    steps : int
        The most steps of the search.

    Notes
    -----
    J. A. Nelder, R. Mead, Computer Journal 7 (1965) 308: reflection 1, expansion 2, contraction and shrinking 1/2.
    """
    corners = sorted(((function(list(point)), list(point)) for point in simplex), key=_value)
    for _ in range(steps - 1):
        (lowest, best), (highest, worst), second = corners[0], corners[-1], corners[-2][0]
        if all(abs(x - b) <= near for _, point in corners[1:] for x, b in zip(point, best, strict=True)) and all(
            abs(lowest - value) <= alike for value, _ in corners[1:]
        ):
            break
        centre = [sum(values) / len(best) for values in zip(*(point for _, point in corners[:-1]), strict=True)]

        def beyond(share: float, centre: Point = centre, worst: Point = worst) -> tuple[float, Point]:
            """Return the corner that is so many times as far beyond the centre as the worst is before it."""
            point = [(1.0 + share) * c - share * w for c, w in zip(centre, worst, strict=True)]
            return function(point), point

        new = beyond(1.0)
        if new[0] < lowest:
            farther = beyond(2.0)
            new = farther if farther[0] < new[0] else new
        elif not new[0] < second:
            if new[0] < highest:
                reflected, new = new[0], beyond(0.5)
                shrinks = not new[0] <= reflected
            else:
                new = beyond(-0.5)
                shrinks = not new[0] < highest
            if shrinks:
                closer = ([b + 0.5 * (x - b) for x, b in zip(point, best, strict=True)] for _, point in corners[1:])
                corners = sorted([corners[0], *((function(point), point) for point in closer)], key=_value)
                continue
        corners = sorted([*corners[:-1], new], key=_value)
    return corners[0][1], corners[0][0]


def _value(corner: tuple[float, Point]) -> float:
    return corner[0]
