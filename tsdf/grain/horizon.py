"""Horizon map: what stands before a facet, from how low an elevation on light comes and goes unobstructed."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.handle import Handle
from tsdf.vectors import KERNEL, cross, dot, step, triple

LEAF = 16  # vertices in the smallest group of the search for what stands before a plane
FREQUENCY = 4  # steps along an edge of the octahedron whose grid of directions bounds groups of vertices
CHUNK = 65536  # facets at a time
GROUP = 16  # facets, one after the other in the mesh, that are passed over together where they cannot matter
PIECE = 2048  # facets that are worth a thread
UNKNOWN = 2.0  # horizon of a facet of which nothing is promised: no sine exceeds it


class Facets(NamedTuple):
    """Facets (m,) of a grain: vertices (m, 3) and their places (m, 3, 3), normals and centroids (m, 3), distance of the
    farthest corner from the centroid, and of vertices (n,) the sine of their sharpest corner."""

    faces: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    centroids: np.ndarray
    radii: np.ndarray
    corner_sines: np.ndarray


@njit(cache=True)
def _gap(corners, i, j, axis):
    """Return how far triangle j lies beyond triangle i along an axis of unit length: no point of them is nearer."""
    low, high = math.inf, -math.inf
    for k in range(3):
        low = min(low, dot(axis, triple(corners[j, k])))
        high = max(high, dot(axis, triple(corners[i, k])))
    return low - high


@njit(**KERNEL)
def _around(spheres, groups):
    """Write centre and radius of a sphere around each `GROUP` of spheres (n, 4) into `groups` (n / GROUP, 4)."""
    for g in range(len(groups)):
        members = range(g * GROUP, min((g + 1) * GROUP, len(spheres)))
        for j in members:
            for k in range(3):
                groups[g, k] += spheres[j, k] / len(members)
        for j in members:
            off = step(triple(spheres[j]), -1.0, triple(groups[g]))
            groups[g, 3] = max(groups[g, 3], math.sqrt(dot(off, off)) + spheres[j, 3] + 1e-12)


@njit(**KERNEL)
def _rise(facets, obstructed, groups, groups_of_groups, horizon):
    """Write into `horizon` a bound on the sine of the elevation of the grain over the facets listed.

    It is the largest that any other facet demands, in whatever order they are asked: first what the facet before this
    one owed its bound to, then those that are near in the mesh, which lets most groups of others be passed over.
    """
    highest = 0
    for i in obstructed:
        top = _demand(facets, i, highest, 0.0)
        for k in range(len(groups_of_groups)):
            c = (i // GROUP**2 + k) % len(groups_of_groups)
            if top >= 1.0:
                break
            if not _matters(facets, i, groups_of_groups[c], top):
                continue
            for g in range(c * GROUP, min((c + 1) * GROUP, len(groups))):
                if not _matters(facets, i, groups[g], top):
                    continue
                for j in range(g * GROUP, min((g + 1) * GROUP, len(facets.faces))):
                    demand = _demand(facets, i, j, top)
                    if demand > top:
                        top, highest = demand, j
        horizon[i] = min(top, 1.0)


@njit(**KERNEL)
def _matters(facets, i, sphere, top):
    """Return whether something in a sphere may demand more than `top` of facet i."""
    apart, radius = step(triple(sphere), -1.0, triple(facets.centroids[i])), sphere[3]
    above = dot(triple(facets.normals[i]), apart) + radius
    return above > 1e-9 and above > top * (math.sqrt(dot(apart, apart)) - radius - facets.radii[i])


@njit(**KERNEL)
def _demand(facets, i, j, top):
    """Return a bound on the sine of the elevation of facet j over facet i, a coarse one where it is below `top`."""
    faces, corners, normals, radii = facets.faces, facets.corners, facets.normals, facets.radii
    n, apart = triple(normals[i]), step(triple(facets.centroids[j]), -1.0, triple(facets.centroids[i]))
    highest = dot(n, apart) + radii[j]
    if highest <= 1e-9 or j == i:
        return 0.0
    distance = math.sqrt(dot(apart, apart))
    gap = distance - radii[i] - radii[j]  # below 0 for facets that share a corner
    if highest <= top * gap:
        return top
    above = -math.inf
    for k in range(3):
        above = max(above, dot(n, step(triple(corners[j, k]), -1.0, triple(corners[i, 0]))))
    if above <= 1e-9:
        return 0.0
    if above <= top * gap:
        return top
    shared, sharp = 0, 1.0
    for k in range(3):
        for m in range(3):
            if faces[i, k] == faces[j, m]:
                shared += 1
                sharp = min(sharp, facets.corner_sines[faces[i, k]])
    if shared > 0:  # across an edge as steep as the neighbour; around a corner, perhaps seen from the side
        facing = dot(n, triple(normals[j]))
        tilt = math.sqrt(max(0.0, 1.0 - facing * facing))
        return (tilt if shared == 2 else tilt / sharp) if facing > 0.0 else 1.0
    if distance > 0.0:  # it matters: look closer, along the centres and off each side
        gap = max(gap, _gap(corners, i, j, step((0.0, 0.0, 0.0), 1.0 / distance, apart)))
        for k in range(3):
            if above <= top * gap:
                break
            along = step(triple(corners[i, (k + 1) % 3]), -1.0, triple(corners[i, k]))
            off = cross(along, n)
            gap = max(gap, _gap(corners, i, j, step((0.0, 0.0, 0.0), 1.0 / math.sqrt(dot(off, off)), off)))
            along = step(triple(corners[j, (k + 1) % 3]), -1.0, triple(corners[j, k]))
            off = cross(triple(normals[j]), along)
            gap = max(gap, _gap(corners, i, j, step((0.0, 0.0, 0.0), 1.0 / math.sqrt(dot(off, off)), off)))
    return above / gap if gap > above else 1.0


def _nodes():
    """Return the nodes (4 F^2 + 2, 3) of a grid on the octahedron |x| + |y| + |z| = 1, and their index by 1 / F."""
    steps = np.arange(-FREQUENCY, FREQUENCY + 1)
    places = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    on = np.abs(places).sum(axis=1) == FREQUENCY
    index = np.full((len(steps),) * 3, -1)
    index[tuple((places[on] + FREQUENCY).T)] = np.arange(on.sum())
    return places[on] / FREQUENCY, index


def _weights(normals, index):
    """Return for each normal three nodes (m, 3) and weights (m, 3), not negative, of which it is the sum."""
    size = np.abs(normals).sum(axis=1, keepdims=True)
    at = np.abs(normals) / size * FREQUENCY
    low = np.floor(at + 1e-12).astype(np.int64)
    rest = at - low
    left = (FREQUENCY - low.sum(axis=1))[:, None, None]  # 0 at a node, else 1 or 2: which way the small triangle points
    corner = low[:, None] + np.where(
        left == 2, 1 - np.eye(3, dtype=np.int64), np.where(left == 1, np.eye(3, dtype=np.int64), 0)
    )
    weight = np.where(left[:, 0] == 2, 1.0 - rest, np.where(left[:, 0] == 1, rest, [1.0, 0.0, 0.0]))
    corner = np.where(normals[:, None] < 0.0, -corner, corner) + FREQUENCY
    return index[corner[..., 0], corner[..., 1], corner[..., 2]], weight * size


def _hulls(points, nodes):
    """Return points in an order that keeps neighbours together, and how far groups of them reach.

    The groups are a binary tree: group 1 holds all points, group i holds groups 2 i and 2 i + 1, and each of the last
    k holds `LEAF` points; the reach (2 k, nodes) is the largest product of its points with each node.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    cell = ((points - low) / np.maximum(high - low, 1e-300) * 1023.0).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(10):  # Morton's order
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    ordered = points[np.argsort(key, kind="stable")]
    leaves = 1 << max(0, math.ceil(math.log2(len(points) / LEAF)))
    filled = np.concatenate([ordered, np.broadcast_to(ordered[-1], (leaves * LEAF - len(points), 3))])
    reach = np.empty((2 * leaves, len(nodes)))
    for leaf in range(0, leaves, 1024):
        products = filled[leaf * LEAF : (leaf + 1024) * LEAF] @ nodes.T
        reach[leaves + leaf : leaves + leaf + 1024] = products.reshape(-1, LEAF, len(nodes)).max(axis=1)
    while leaves > 1:
        leaves //= 2
        reach[leaves : 2 * leaves] = reach[2 * leaves : 4 * leaves].reshape(leaves, 2, -1).max(axis=1)
    return filled, reach


class Groups(NamedTuple):
    """Points (n, 3) in groups and, of the tree of these, how far each reaches along the nodes (2 groups, nodes);
    sides (2, 3): the nodes against and along each axis."""

    points: np.ndarray
    reach: np.ndarray
    sides: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def _stand_before(planes, nodes, weights, centroids, slopes, tolerance, groups, before):
    """Write into `before` which facets have a point further before them than the tolerance and slope allow."""
    points, reach, sides = groups.points, groups.reach, groups.sides
    leaves = len(reach) // 2
    waiting = np.empty(128, np.int64)
    for i in range(len(planes)):
        normal, level = (planes[i, 0], planes[i, 1], planes[i, 2]), planes[i, 3] + tolerance
        a, b, c = nodes[i, 0], nodes[i, 1], nodes[i, 2]
        u, v, w = weights[i, 0], weights[i, 1], weights[i, 2]
        waiting[0], count = 1, 1
        while count > 0 and not before[i]:
            count -= 1
            group = waiting[count]
            excess = u * reach[group, a] + v * reach[group, b] + w * reach[group, c] - level
            if excess <= 0.0:
                continue
            if slopes[i] > 0.0:
                apart = 0.0  # to the group's box
                for axis in range(3):
                    at = centroids[i, axis]
                    apart += max(-reach[group, sides[0, axis]] - at, at - reach[group, sides[1, axis]], 0.0) ** 2
                if excess <= slopes[i] * math.sqrt(apart):
                    continue
            if group < leaves:
                waiting[count], waiting[count + 1] = 2 * group, 2 * group + 1
                count += 2
                continue
            for k in range((group - leaves) * LEAF, (group - leaves + 1) * LEAF):
                excess = dot(normal, triple(points[k])) - level
                if excess > 0.0:
                    off = step(triple(points[k]), -1.0, triple(centroids[i]))
                    if excess > slopes[i] * math.sqrt(dot(off, off)):
                        before[i] = True
                        break


def stand_before(
    vertices: np.ndarray, planes: np.ndarray, centroids: np.ndarray, slopes: np.ndarray, tolerance: float
) -> np.ndarray:
    """Return (m,) bool which facets have a vertex of the grain before their plane.

    Groups of vertices that end behind the plane are passed over. How far a group reaches along a normal is bounded by
    how far it reaches along three nodes of a grid of directions whose weighted sum the normal is.

    Parameters
    ----------
    vertices : (n, 3) float64
    planes : (m, 4) float64
        Unit normal and level of each facet's plane.
    centroids : (m, 3) float64
    slopes : (m,) float64
        How much further before the plane a vertex may stand for each unit of its distance from the centroid [1].
    tolerance : float
        How far before the plane it may stand in any case.
    """
    before = np.zeros(len(planes), bool)
    nodes, index = _nodes()
    points, reach = _hulls(vertices, nodes)
    f = FREQUENCY
    sides = np.array(
        [[index[0, f, f], index[f, 0, f], index[f, f, 0]], [index[-1, f, f], index[f, -1, f], index[f, f, -1]]]
    )
    groups = Handle(Groups(points, reach, sides))
    for begin in range(0, len(planes), CHUNK):
        part = slice(begin, begin + CHUNK)
        which, weights = _weights(planes[part, :3], index)
        _stand_before(planes[part], which, weights, centroids[part], slopes[part], tolerance, groups, before[part])
    return before


def horizon_of(vertices: np.ndarray, faces: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return for each facet the sine of an elevation above which nothing of the grain stands, (facets,) float64.

    Light above the horizon of a facet reaches it unobstructed and leaves it for good, so it needs no ray. 0 where
    the whole grain lies behind the facet's plane (every facet of a convex grain); UNKNOWN where nothing is promised,
    as for all facets with something before them if there are so many that looking would take longer than tracing.
    """
    corners = vertices[faces]
    centroids = corners.mean(axis=1)
    horizon = stand_before(vertices, planes, centroids, np.zeros(len(planes)), 1e-9).astype(np.float64)
    obstructed = np.flatnonzero(horizon)
    if 0 < len(obstructed) * len(planes) <= 1e9:
        radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
        sides = np.roll(corners, -1, axis=1) - corners
        sides /= np.linalg.norm(sides, axis=2)[:, :, None]
        sines = np.linalg.norm(np.cross(sides, np.roll(sides, 1, axis=1)), axis=2)
        corner_sines = np.ones(len(vertices))
        np.minimum.at(corner_sines, faces.ravel(), sines.ravel())
        parts = faces, corners, planes[:, :3], centroids, radii, np.maximum(corner_sines, 1e-9)
        facets = Handle(Facets(*map(np.ascontiguousarray, parts)))
        groups, groups_of_groups = (np.zeros((-(-len(faces) // size), 4)) for size in (GROUP, GROUP**2))
        _around(np.column_stack((centroids, radii)), groups)
        _around(groups, groups_of_groups)
        pieces = np.array_split(obstructed, -(-len(obstructed) // PIECE))
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda piece: _rise(facets, piece, groups, groups_of_groups, horizon), pieces))
    horizon[horizon >= 1.0] = UNKNOWN
    return horizon
