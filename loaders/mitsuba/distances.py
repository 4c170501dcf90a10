"""Distances: lower bounds of those to the nearest surface, by a grid over each medium."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tsdf.loaders.mitsuba.variant import array_of, dr, element, mi

VOXELS = 112  # along the longest side of a medium, at most
FINE = 0.25  # side of a voxel over the bounding radius that is fine enough


class Distances:
    """For each medium a grid of lower bounds of the distance from a voxel's centre to the nearest surface [voxel]."""

    def __init__(self, shapes: Sequence[Any], boundaries: Sequence[Sequence[int]], radii: Sequence[float]) -> None:
        low, inverse, size, first, bounds = [], [], [], [0], []
        for own, radius in zip(boundaries, radii, strict=True):
            boxes = [shapes[i].bbox() for i in own]
            lowest = np.min([np.array(b.min) for b in boxes], axis=0).ravel()
            extent = np.max([np.array(b.max) for b in boxes], axis=0).ravel() - lowest
            step = max(float(extent.max()) / VOXELS, min(FINE * radius, float(extent.max()) / 16.0))
            lowest = lowest - step
            count = np.maximum(np.ceil(extent / step).astype(int) + 2, 3)
            grid = _distances(shapes, lowest, step, count)
            low.append(lowest)
            inverse.append(1.0 / step)
            size.append(count)
            first.append(first[-1] + grid.size)
            bounds.append(grid.ravel())
        self.low = [array_of("Float", np.array(low)[:, k]) for k in range(3)]
        self.size = [array_of("UInt32", np.array(size)[:, k]) for k in range(3)]
        self.inverse = array_of("Float", inverse)
        self.first = array_of("UInt32", first[:-1])
        self.bounds = array_of("Float", np.concatenate(bounds))

    def __call__(self, m: Any, p: Any) -> Any:
        """Return a lower bound of the distance from points in media m to any surface, -1 outside the medium's box."""
        inverse = element(mi.Float, self.inverse, m)
        x = [(p[k] - element(mi.Float, self.low[k], m)) * inverse for k in range(3)]
        size = [element(mi.UInt32, self.size[k], m) for k in range(3)]
        inside = True
        for k in range(3):
            inside = inside & (x[k] >= 0.0) & (x[k] < mi.Float(size[k]))
        i, j, k = (mi.UInt32(dr.select(inside, v, 0.0)) for v in x)
        at = element(mi.UInt32, self.first, m) + (i * size[1] + j) * size[2] + k
        a, b, c = (v - mi.Float(n) - 0.5 for v, n in zip(x, (i, j, k), strict=True))
        from_centre = dr.sqrt(a * a + b * b + c * c)
        bound = (element(mi.Float, self.bounds, at, inside) - from_centre) / inverse
        return dr.select(inside, dr.maximum(bound, 0.0), -1.0)


def _distances(shapes: Sequence[Any], low: np.ndarray, step: float, count: np.ndarray) -> np.ndarray:
    """Return the bounds of the middles of a grid's cells, (x, y, z), whichever shapes are of the medium [voxel]."""
    from scipy.ndimage import distance_transform_edt

    from tsdf.walk.grid import cells_of

    free = np.ones(count, dtype=bool)
    for shape in shapes:
        box_low, box_high = (np.array(corner, dtype=float).ravel() for corner in (shape.bbox().min, shape.bbox().max))
        kind = shape.class_name()
        if shape.is_mesh() or kind == "Rectangle":
            first = cells_of(*_facets(shape), low, step, count)[1]
            free &= (first[1:] == first[:-1]).reshape(tuple(count))
        elif kind == "Sphere":
            centre, radius = 0.5 * (box_low + box_high), 0.5 * float((box_high - box_low).max())
            at = np.meshgrid(
                *(low[k] + step * (np.arange(count[k]) + 0.5) - centre[k] for k in range(3)), indexing="ij"
            )
            free[np.abs(np.sqrt(sum(a * a for a in at)) - radius) <= step] = False
        else:  # all of its box
            begin = np.clip(np.floor((box_low - low) / step), 0, count).astype(int)
            end = np.clip(np.floor((box_high - low) / step) + 1, 0, count).astype(int)
            free[tuple(slice(b, e) for b, e in zip(begin, end, strict=True))] = False
    if free.all():
        return np.full(count, -2.0)
    # A surface is half a diagonal from the centre of its voxel, at most
    grid: np.ndarray = distance_transform_edt(free) - 0.501 * math.sqrt(3.0)
    return grid


def _facets(shape: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (n, 3, 3) and planes (n, 4) of the triangles of a mesh or a rectangle that have an area."""
    from tsdf.walk.geometry import planes_of

    corners = _triangles(shape)
    a, b, c = corners.transpose(1, 0, 2)
    corners = corners[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0]
    return corners, planes_of(corners)


def _triangles(shape: Any) -> np.ndarray:
    """Return the corners of the triangles of a mesh or a rectangle, (n, 3, 3)."""
    if shape.class_name() == "Rectangle":
        corners = [
            np.array(shape.eval_parameterization(mi.Point2f(u, v)).p).ravel()
            for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        return np.array([[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]], dtype=float)
    parameters = mi.traverse(shape)
    points = np.array(parameters["vertex_positions"], dtype=float).reshape(-1, 3)
    return points[np.array(parameters["faces"]).reshape(-1, 3)]
