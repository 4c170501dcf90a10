"""How large a grain is across: its maximum dimension, and the sieve that it passes.

Both are of the convex hull and in the unit of the vertices. Volume, surface and projected area are elsewhere: `grains`
has the first two, a table's hit_probability is the third over that of the bounding sphere.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

DIRECTIONS, TURNS = 300, 24  # from which the search for a sieve starts
STARTS = 8  # of these, from which it goes on
BLOCK = 1024  # vertices whose distances to all are held at once
ALIKE = 512  # directions whose extreme vertices stand for all where a search starts


def maximum_dimension(vertices: Floats) -> float:
    """Return the greatest distance between two points of a body, given its vertices (n, 3)."""
    points = vertices[ConvexHull(vertices).vertices]
    reach = np.linalg.norm(points, axis=1)
    points = points[reach >= _widest(_extremes(points)) - reach.max() * (1.0 + 1e-9)]  # others have no one so far
    return _widest(points)


def _widest(points: Floats) -> float:
    """Return the greatest distance between two of some points."""
    squares = (points**2).sum(axis=1)
    most = 0.0
    for i in range(0, len(points), BLOCK):
        part = slice(i, i + BLOCK)
        most = max(most, float((squares[part, None] + squares - 2.0 * points[part] @ points.T).max()))
    return math.sqrt(most)


def sieve(vertices: Floats) -> float:
    """Return the width of the smallest square hole that a body passes, however turned, moving straight on.

    It is the least of max(width along u, width along v) over all pairs of perpendicular directions u and v.

    Parameters
    ----------
    vertices : (n, 3) float64
        Of the body.
    """
    points = vertices[ConvexHull(vertices).vertices]
    few = _extremes(points)
    angles = np.arange(TURNS) * (0.5 * math.pi / TURNS)
    first = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(TURNS)])
    second = np.column_stack([-np.sin(angles), np.cos(angles), np.zeros(TURNS)])

    def needed(turned: Floats) -> Floats:
        """Return the hole that points, turned so that they move along z, need at each angle, (TURNS,)."""
        return np.maximum(np.ptp(turned @ first.T, axis=0), np.ptp(turned @ second.T, axis=0))

    ways = [Rotation.align_vectors([[0.0, 0.0, 1.0]], [d])[0] for d in _hemisphere(DIRECTIONS)]
    found = np.array([needed(way.apply(few)) for way in ways])
    best = np.argsort(found.min(axis=1))[:STARTS]
    least = math.inf
    for k in best:
        start = Rotation.from_euler("z", -float(angles[found[k].argmin()])) * ways[k]

        def hole(turn: Floats, start: Rotation = start) -> float:
            return float(np.ptp((Rotation.from_rotvec(turn) * start).apply(points)[:, :2], axis=0).max())

        simplex = np.vstack([np.zeros(3), 0.05 * np.eye(3)])
        done = minimize(
            hole, np.zeros(3), method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-7, "fatol": 1e-9}
        )
        least = min(least, float(done.fun))
    return least


def _extremes(points: Floats) -> Floats:
    """Return the points that are farthest in some direction, of many directions."""
    along = _hemisphere(ALIKE) @ points.T
    return points[np.unique([along.argmax(axis=1), along.argmin(axis=1)])]


def _hemisphere(count: int) -> Floats:
    """Return directions spread evenly over a hemisphere, (count, 3)."""
    z = (np.arange(count) + 0.5) / count
    azimuth = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(count)
    rho = np.sqrt(1.0 - z * z)
    return np.column_stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z])
