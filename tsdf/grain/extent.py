"""Extent of a grain: its maximum dimension, and the sieve that it passes.

Both are of the convex hull and in the unit of the vertices. Volume, surface and projected area are elsewhere: `grains`
has the first two, a table's hit_probability is the third over that of the bounding sphere.
"""

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tsdf.simplex import least as least_of

Floats = NDArray[np.float64]

DIRECTIONS, TURNS = 300, 24  # from which the search for a sieve starts
STARTS = 8  # of these, from which it goes on
ENDS = 1e-7, 1e-9, 600  # of a search: so near [rad] and alike [R], or after so many steps
MANY, NEAR = 4096, 0.1  # vertices of a body like a ball, and how near [R] they stand to the opposite, if few are asked
BLOCK = 1024  # its square is how many distances are held at once
ALIKE = 512  # directions whose extreme vertices stand for all where a search starts


def maximum_dimension(vertices: Floats) -> float:
    """Return the greatest distance between two points of a body, given its vertices (n, 3)."""
    few = _extremes(vertices)
    least = _widest(few, few)
    reach = np.linalg.norm(vertices, axis=1)
    points = vertices[reach >= least - reach.max() * (1.0 + 1e-9)]  # others have no one so far
    # |p + q|^2 + |p - q|^2 = 2 |p|^2 + 2 |q|^2: of a body like a ball, who is as far stands near the opposite
    near = math.sqrt(max(4.0 * reach.max() ** 2 - least**2, 0.0)) + 1e-9 * reach.max()
    if len(points) <= MANY or near > NEAR * reach.max():
        return max(least, _widest(points, points))
    from scipy.spatial import cKDTree

    opposite = cKDTree(-points)
    for first in range(0, len(points), BLOCK):
        part = points[first : first + BLOCK]
        found = opposite.query_ball_point(part, near)
        one, other = np.repeat(np.arange(len(part)), [len(some) for some in found]), np.concatenate(found).astype(int)
        least = max(least, float(np.linalg.norm(part[one] - points[other], axis=1).max(initial=0.0)))
    return least


def _widest(points: Floats, others: Floats) -> float:
    """Return the greatest distance between one of some points and one of others."""
    squares, most = (others**2).sum(axis=1), 0.0
    rows = max(1, BLOCK**2 // len(others))
    for i in range(0, len(points), rows):
        part = points[i : i + rows]
        most = max(most, float(((part**2).sum(axis=1)[:, None] + squares - 2.0 * part @ others.T).max()))
    return math.sqrt(most)


def sieve(vertices: Floats) -> float:
    """Return the width of the smallest square hole that a body passes, however turned, moving straight on.

    It is the least of max(width along u, width along v) over all pairs of perpendicular directions u and v.

    Parameters
    ----------
    vertices : (n, 3) float64
        Of the body.
    """
    few = _extremes(vertices)
    angles = np.arange(TURNS) * (0.5 * math.pi / TURNS)
    first = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(TURNS)])
    second = np.column_stack([-np.sin(angles), np.cos(angles), np.zeros(TURNS)])

    def needed(turned: Floats) -> Floats:
        """Return the hole that points, turned so that they move along z, need at each angle, (TURNS,)."""
        return np.maximum(np.ptp(turned @ first.T, axis=0), np.ptp(turned @ second.T, axis=0))

    def hole(turn: list[float], start: Floats, across: Floats) -> float:
        """Return the hole that points, (3, k), need which move across two directions (3, 2) that are turned."""
        along = (_rotation(turn) @ start).T @ across
        return float((along.max(axis=1) - along.min(axis=1)).max())

    ways = _frames(_hemisphere(DIRECTIONS))
    found = np.array([needed(few @ way) for way in ways])
    best = np.argsort(found.min(axis=1))[:STARTS]
    least = math.inf
    for k in best:
        at = found[k].argmin()
        start = ways[k] @ np.column_stack([first[at], second[at]])
        turn, size, missed = [0.0, 0.0, 0.0], 0.05, True
        while missed:
            across = np.ascontiguousarray(few.T)
            simplex = (turn + size * np.vstack([np.zeros(3), np.eye(3)])).tolist()
            turn, narrowest = least_of(partial(hole, start=start, across=across), simplex, *ENDS)
            size = 0.005
            along = vertices @ (_rotation(turn) @ start)
            width = float(np.ptp(along, axis=0).max())
            missed = width > narrowest * (1.0 + 1e-9)
            if missed:  # vertices that were not among the few
                few = np.unique(
                    np.vstack([few, vertices[along.argmax(axis=0)], vertices[along.argmin(axis=0)]]), axis=0
                )
        least = min(least, width)
    return least


def _frames(d: Floats) -> Floats:
    """Return rotations (n, 3, 3) whose last columns are unit directions (n, 3)."""
    u = np.cross(d, np.eye(3)[np.abs(d).argmin(axis=1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(d, u), d], axis=2)


def _rotation(turn: list[float]) -> Floats:
    """Return the rotation (3, 3) by a vector: about it, by its length [rad] (Rodrigues)."""
    x, y, z = turn
    square = x * x + y * y + z * z
    if square < 1e-24:
        c, s = 0.5, 1.0
    else:
        angle = math.sqrt(square)
        c, s = (1.0 - math.cos(angle)) / square, math.sin(angle) / angle
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )


def _extremes(points: Floats) -> Floats:
    """Return the points that are farthest in some direction, of many directions."""
    directions, chosen, step = _hemisphere(ALIKE), [], max(1, BLOCK**2 // len(points))
    for first in range(0, ALIKE, step):
        along = directions[first : first + step] @ points.T
        chosen += [along.argmax(axis=1), along.argmin(axis=1)]
    found: Floats = points[np.unique(np.concatenate(chosen))]
    return found


def _hemisphere(count: int) -> Floats:
    """Return directions spread evenly over a hemisphere, (count, 3)."""
    z = (np.arange(count) + 0.5) / count
    azimuth = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(count)
    rho = np.sqrt(1.0 - z * z)
    return np.column_stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z])
