"""What stands before a facet: from how low an elevation on light comes and goes unobstructed."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _rise(facets, faces, planes, centroids, radii, corner_sines, horizon):
    """Write into `horizon` a bound on the sine of the elevation of the grain over the `facets` listed."""
    for i in facets:
        top = 0.0
        nx, ny, nz, height = planes[i, 0], planes[i, 1], planes[i, 2], planes[i, 3]
        for j in range(faces.shape[0]):
            above = nx * centroids[j, 0] + ny * centroids[j, 1] + nz * centroids[j, 2] - height
            if above + radii[j] <= 1e-9 or j == i:
                continue
            facing = nx * planes[j, 0] + ny * planes[j, 1] + nz * planes[j, 2]
            tilt = math.sqrt(max(0.0, 1.0 - facing * facing))
            above += radii[j] * tilt
            if above <= 1e-9:
                continue
            shared, sharp = 0, 1.0
            for k in range(3):
                for m in range(3):
                    if faces[i, k] == faces[j, m]:
                        shared += 1
                        sharp = min(sharp, corner_sines[faces[i, k]])
            if shared == 2:  # across an edge: the neighbour's own slope
                rise = tilt if facing > 0.0 else 1.0
            elif shared == 1:  # around a corner, which may be seen from the side
                rise = tilt / sharp if facing > 0.0 else 1.0
            else:
                dx, dy = centroids[j, 0] - centroids[i, 0], centroids[j, 1] - centroids[i, 1]
                dz = centroids[j, 2] - centroids[i, 2]
                gap = math.sqrt(dx * dx + dy * dy + dz * dz) - radii[i] - radii[j]
                rise = above / gap if gap > above else 1.0
            top = max(top, rise)
            if top >= 1.0:
                break
        horizon[i] = min(top, 1.0)


def horizon_of(vertices: np.ndarray, faces: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return for each facet the sine of an elevation above which nothing of the grain stands, (facets,) float64.

    Light above the horizon of a facet reaches it unobstructed and leaves it for good, so it needs no ray. 0 where
    the whole grain lies behind the facet's plane (every facet of a convex grain); 1 where nothing is promised, as
    for all facets with something before them if there are so many that looking would take longer than tracing.
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
        _rise(obstructed, faces, planes, centroids, radii, np.maximum(corner_sines, 1e-9), horizon)
    return horizon
