"""Crystals: ice crystals that people ask for by name, as closed triangle meshes with flat facets and sharp edges.

Each is put together so that no part cuts another, and so needs no Boolean operation. Units are arbitrary, vertices
shared, faces wound counter-clockwise seen from outside. Which there are, with their parameters, is `exemplars`.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mesh = tuple[Floats, NDArray[np.int64]]

CLEARANCE = 1e-3  # of a column's circumradius, between the columns of an aggregate


def hull(points: Floats) -> Mesh:
    """Return the convex hull of points that are all its corners."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(points)
    faces = found.simplices.astype(np.int64)
    a, b, c = points[faces].swapaxes(0, 1)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    faces[inward] = faces[inward, ::-1]
    return points, faces


def _hexagon(radius: float = 1.0, z: float = 0.0) -> Floats:
    """Return the corners of a regular hexagon around the z axis, counter-clockwise seen from above."""
    angle = np.arange(6) * np.pi / 3
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6, z)])


def _band(low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the faces of a band between two rings, counter-clockwise seen from outside where `high` is above."""
    a, b, c, d = low, np.roll(low, -1), np.roll(high, -1), high
    return np.column_stack([a, b, c, a, c, d]).reshape(-1, 3)


def _frame(axis: Floats) -> Floats:
    """Return a rotation that takes z to `axis`."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def turned(rng: np.random.Generator) -> Floats:
    """Return a random rotation, uniform over all, (3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def hexprism(aspect: float) -> Mesh:
    """Return a regular hexagonal prism of circumradius a = 1 and length L = 2 a `aspect`, axis along z."""
    return hull(np.vstack([_hexagon(z=aspect), _hexagon(z=-aspect)]))


def droxtal(theta1: float, theta2: float) -> Mesh:
    """Return a droxtal: 20 facets inscribed in a unit sphere, a hexagonal prism between two truncated pyramids [1].

    The basal hexagons are seen from the centre at `theta1` from the axis, the prism's at `theta2` [degrees].

    [1] P. Yang, B. A. Baum, A. J. Heymsfield, Y. X. Hu, H.-L. Huang, S.-C. Tsay, S. Ackerman, JQSRT 79-80 (2003) 1159.
    """
    rings = [_hexagon(np.sin(t), np.cos(t)) for t in np.radians([theta1, theta2])]
    return hull(np.vstack([ring * [1, 1, side] for ring, side in product(rings, (1, -1))]))


def hollow_column(aspect: float, depth: float) -> Mesh:
    """Return a hexagonal prism into whose two ends hexagonal pyramids are sunk, `depth` of half the length deep.

    As `hexprism` otherwise.
    """
    apexes = np.array([[0, 0, aspect], [0, 0, -aspect]]) * (1 - depth)
    vertices = np.vstack([_hexagon(z=aspect), _hexagon(z=-aspect), apexes])
    top, bottom = np.arange(6), np.arange(6, 12)
    sunk = np.column_stack([top, np.roll(top, -1), np.full(6, 12)])
    below = np.column_stack([np.roll(bottom, -1), bottom, np.full(6, 13)])
    return vertices, np.vstack([_band(bottom, top), sunk, below])


_AXES = {  # as far from each other as so many directions can be
    2: [[0, 0, 1], [0, 0, -1]],
    3: [[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]],
    4: [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]],
    5: [[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0], [0, 0, 1], [0, 0, -1]],
    6: [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]],
}


def bullet_rosette(bullets: int, aspect: float, tip: float) -> Mesh:
    """Return bullets that have grown together at their tips, each a hexagonal column with a pyramid at one end.

    The pyramids narrow at `tip` [degrees] between axis and edge. They are cut off where their corners lie on a sphere
    of a fifth of the column's width; the convex hull of these corners joins them. Cones of half-angle `tip` hold the
    pyramids and cylinders over them the columns: none meets another as long as axes are two `tip` apart.
    """
    axes = np.array(_AXES[bullets], np.float64)
    sine, cosine = np.sin(np.radians(tip)), np.cos(np.radians(tip))
    core = 0.4
    rings = np.stack([_hexagon(core * sine, core * cosine), _hexagon(z=cosine / sine)])
    rings = np.concatenate([rings, rings[1:] + np.array([0, 0, 2 * aspect])])  # core, shoulder, end; circumradius 1
    points = np.concatenate([rings.reshape(-1, 3) @ _frame(axis).T for axis in axes])
    ring = np.arange(6)
    faces = []
    for first in 18 * np.arange(bullets):
        faces += [_band(first + 6 * k + ring, first + 6 * (k + 1) + ring) for k in range(2)]
        faces.append(first + 12 + np.array([[0, k, k + 1] for k in range(1, 5)]))
    inner = (18 * np.arange(bullets)[:, None] + ring).ravel()
    _, middle = hull(points[inner])
    middle = middle[(inner[middle] // 18 != inner[middle[:, :1]] // 18).any(axis=1)]  # not those under a pyramid
    return points, np.vstack([*faces, inner[middle]])


def koch_snowflake(order: int, aspect: float) -> Mesh:
    """Return a plate whose outline is Koch's snowflake: a triangle whose sides grew triangles `order` times.

    Thickness is `aspect` times the circumradius twice, that of the triangle or star all corners lie in.
    """
    from tsdf.grain.polygons import Part, triangles_of

    outline = np.exp(2j * np.pi * np.arange(3) / 3)
    for _ in range(order):
        step = (np.roll(outline, -1) - outline) / 3
        tip = outline + step * (1 + np.exp(-1j * np.pi / 3))
        outline = np.column_stack([outline, outline + step, tip, outline + 2 * step]).ravel()
    n = len(outline)
    low = np.column_stack([outline.real, outline.imag, np.full(n, -aspect)])
    cover = triangles_of(Part(low, np.arange(n), np.array([n])))
    a, b, c = low[cover].swapaxes(0, 1)
    cover = cover if np.cross(b - a, c - a)[:, 2].sum() > 0 else cover[:, ::-1]
    bottom = np.arange(n)
    return np.vstack([low, low * [1, 1, -1]]), np.vstack([cover[:, ::-1], cover + n, _band(bottom, bottom + n)])


def _way_out(still: Floats, moving: Floats, direction: Floats) -> float:
    """Return how far one convex body must be moved along a unit vector until it has left another, 0 if it has.

    Both are given by their corners: what they share is the origin within the hull of the differences.
    """
    from scipy.spatial import ConvexHull

    sides = ConvexHull((moving[:, None] - still[None]).reshape(-1, 3)).equations
    slope = sides[:, :3] @ direction  # x = -t direction stays within where n.x + d <= 0
    ahead, behind, along = slope < -1e-12, slope > 1e-12, np.abs(slope) <= 1e-12
    if (sides[along, 3] > 0).any():
        return 0.0
    last = (sides[ahead, 3] / slope[ahead]).min()
    first = (sides[behind, 3] / slope[behind]).max()
    return float(max(last, 0.0)) if last > first else 0.0


def column_aggregate(columns: int, aspect: float, seed: int) -> Mesh:
    """Return hexagonal columns, turned at random, that have fallen on each other from random sides until they touch.

    Their lengths are spread by a fifth about 2 `aspect` of their circumradius of 1, which is spread likewise. What
    touches is `CLEARANCE` apart, as bodies that share a point cannot be told from bodies that cross there.
    """
    rng = np.random.default_rng(seed)
    single, faces = hexprism(1.0)
    placed: list[Floats] = []
    for _ in range(columns):
        size = rng.uniform(0.8, 1.2, 2) * [1, aspect]
        column = (single * size[[0, 0, 1]]) @ turned(rng).T
        away = rng.normal(size=3)
        away /= np.linalg.norm(away)
        if placed:
            # start on one that has been placed, then go out until all are left behind
            column = column + placed[rng.integers(len(placed))].mean(axis=0)
            moved = 1.0
            while moved > 0:
                moved = max(_way_out(other, column, away) for other in placed)
                column = column + away * (moved + CLEARANCE if moved > 0 else 0.0)
        placed.append(column)
    return np.vstack(placed), np.vstack([faces + 12 * k for k in range(columns)])
