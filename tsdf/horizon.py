"""What stands before a facet: from how low an elevation on light comes and goes unobstructed."""

import math

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import cross, dot, step, triple

UNKNOWN = 2.0  # horizon of a facet of which nothing is promised: no sine exceeds it


@njit(cache=True)
def _gap(i, j, corners, axis):
    """Return how far triangle j lies beyond triangle i along an axis of unit length: no point of them is nearer."""
    low, high = math.inf, -math.inf
    for k in range(3):
        low = min(low, dot(axis, triple(corners[j, k])))
        high = max(high, dot(axis, triple(corners[i, k])))
    return low - high


@njit(cache=True, nogil=True, error_model="numpy")
def _rise(obstructed, faces, corners, normals, centroids, radii, corner_sines, horizon):
    """Write into `horizon` a bound on the sine of the elevation of the grain over the facets listed."""
    for i in obstructed:
        top, n = 0.0, triple(normals[i])
        for j in range(len(faces)):
            apart = step(triple(centroids[j]), -1.0, triple(centroids[i]))
            if dot(n, apart) + radii[j] <= 1e-9 or j == i:
                continue
            above = -math.inf
            for k in range(3):
                above = max(above, dot(n, step(triple(corners[j, k]), -1.0, triple(corners[i, 0]))))
            if above <= 1e-9:
                continue
            shared, sharp = 0, 1.0
            for k in range(3):
                for m in range(3):
                    if faces[i, k] == faces[j, m]:
                        shared += 1
                        sharp = min(sharp, corner_sines[faces[i, k]])
            if shared > 0:  # across an edge as steep as the neighbour; around a corner, perhaps seen from the side
                facing = dot(n, triple(normals[j]))
                tilt = math.sqrt(max(0.0, 1.0 - facing * facing))
                rise = (tilt if shared == 2 else tilt / sharp) if facing > 0.0 else 1.0
            else:
                distance = math.sqrt(dot(apart, apart))
                gap = distance - radii[i] - radii[j]
                if above > top * gap and distance > 0.0:  # it matters: look closer, along the centres and off each side
                    gap = max(gap, _gap(i, j, corners, step((0.0, 0.0, 0.0), 1.0 / distance, apart)))
                    for k in range(3):
                        along = step(triple(corners[i, (k + 1) % 3]), -1.0, triple(corners[i, k]))
                        off = cross(along, n)
                        gap = max(gap, _gap(i, j, corners, step((0.0, 0.0, 0.0), 1.0 / math.sqrt(dot(off, off)), off)))
                        along = step(triple(corners[j, (k + 1) % 3]), -1.0, triple(corners[j, k]))
                        off = cross(triple(normals[j]), along)
                        gap = max(gap, _gap(i, j, corners, step((0.0, 0.0, 0.0), 1.0 / math.sqrt(dot(off, off)), off)))
                rise = above / gap if gap > above else 1.0
            top = max(top, rise)
            if top >= 1.0:
                break
        horizon[i] = min(top, 1.0)


def horizon_of(vertices: np.ndarray, faces: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return for each facet the sine of an elevation above which nothing of the grain stands, (facets,) float64.

    Light above the horizon of a facet reaches it unobstructed and leaves it for good, so it needs no ray. 0 where
    the whole grain lies behind the facet's plane (every facet of a convex grain); UNKNOWN where nothing is promised,
    as for all facets with something before them if there are so many that looking would take longer than tracing.
    """
    from scipy.spatial import ConvexHull

    hull = vertices[ConvexHull(vertices).vertices]
    horizon = np.ones(len(planes))
    for start in range(0, len(planes), 1024):
        part = planes[start : start + 1024]
        horizon[start : start + 1024][(part[:, :3] @ hull.T).max(axis=1) <= part[:, 3] + 1e-9] = 0.0
    obstructed = np.flatnonzero(horizon)
    if 0 < len(obstructed) * len(planes) <= 1e9:
        corners = vertices[faces]
        centroids = corners.mean(axis=1)
        radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
        sides = np.roll(corners, -1, axis=1) - corners
        sides /= np.linalg.norm(sides, axis=2)[:, :, None]
        sines = np.linalg.norm(np.cross(sides, np.roll(sides, 1, axis=1)), axis=2)
        corner_sines = np.ones(len(vertices))
        np.minimum.at(corner_sines, faces.ravel(), sines.ravel())
        normals = np.ascontiguousarray(planes[:, :3])
        _rise(obstructed, faces, corners, normals, centroids, radii, np.maximum(corner_sines, 1e-9), horizon)
    horizon[horizon >= 1.0] = UNKNOWN
    return horizon
