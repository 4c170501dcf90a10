"""What stands before a facet: from how low an elevation on light comes and goes unobstructed."""

import math

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import cross, dot, step, triple

LEAF = 8  # points in the smallest box of the search for what stands before a plane
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


def _boxes(points):
    """Return points (n, 3) in an order that keeps neighbours together, and boxes (2 k, 2, 3) around `LEAF` at a time.

    A binary tree: box 1 holds all points, box i holds boxes 2 i and 2 i + 1, and the last k boxes hold points.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    cell = ((points - low) / np.maximum(high - low, 1e-300) * 1023.0).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(10):  # Morton's order
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    ordered = points[np.argsort(key, kind="stable")]
    leaves = 1 << max(0, math.ceil(math.log2(len(points) / LEAF)))
    filled = np.resize(ordered, (leaves * LEAF, 3))
    filled[len(points) :] = ordered[-1]
    boxes = np.empty((2 * leaves, 2, 3))
    blocks = filled.reshape(leaves, LEAF, 3)
    boxes[leaves:, 0], boxes[leaves:, 1] = blocks.min(axis=1), blocks.max(axis=1)
    while leaves > 1:
        pairs = boxes[leaves : 2 * leaves].reshape(leaves // 2, 2, 2, 3)
        leaves //= 2
        boxes[leaves : 2 * leaves, 0], boxes[leaves : 2 * leaves, 1] = (
            pairs[:, :, 0].min(axis=1),
            pairs[:, :, 1].max(axis=1),
        )
    return filled, boxes


@njit(cache=True, nogil=True, error_model="numpy")
def _obstruct(planes, points, boxes, horizon):
    """Write 0 into `horizon` where no point lies before a facet's plane; boxes behind the plane are passed over."""
    leaves = len(boxes) // 2
    waiting = np.empty(128, np.int64)
    for i in range(len(planes)):
        n, level = (planes[i, 0], planes[i, 1], planes[i, 2]), planes[i, 3] + 1e-9
        waiting[0], count, before = 1, 1, False
        while count > 0 and not before:
            count -= 1
            box = waiting[count]
            reach = 0.0
            for axis in range(3):
                reach += n[axis] * boxes[box, 1 if n[axis] > 0.0 else 0, axis]
            if reach <= level:
                continue
            if box < leaves:
                waiting[count], waiting[count + 1] = 2 * box, 2 * box + 1
                count += 2
                continue
            for k in range((box - leaves) * LEAF, (box - leaves + 1) * LEAF):
                if dot(n, triple(points[k])) > level:
                    before = True
                    break
        if not before:
            horizon[i] = 0.0


def horizon_of(vertices: np.ndarray, faces: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return for each facet the sine of an elevation above which nothing of the grain stands, (facets,) float64.

    Light above the horizon of a facet reaches it unobstructed and leaves it for good, so it needs no ray. 0 where
    the whole grain lies behind the facet's plane (every facet of a convex grain); UNKNOWN where nothing is promised,
    as for all facets with something before them if there are so many that looking would take longer than tracing.
    """
    horizon = np.ones(len(planes))
    _obstruct(planes, *_boxes(vertices), horizon)
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
