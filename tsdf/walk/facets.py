"""Facets of a grain by cells: which of them a ray meets first, without a ray engine and so without waiting for one.

Sixteen triangles are looked at together, as vector instructions do. Triangles that share an edge see a ray pass it on
the same side, to the last bit (Woop, Benthin & Wald 2013), so none slips through between them; which of those that are
crossed is the first is computed from their planes in float64.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import KERNEL, dot
from tsdf.walk.grid import NONE
from tsdf.walk.lots import BLOCKS, MOST_ALL, MOST_BLOCKS, Lots, arrival, cell_at, lots_of, onward, outside, scaled

LANES = 16  # triangles looked at together, and boxes of so many triangles
MOST_FACETS = 200_000  # of a grain: more are for the ray engine, whose tree needs less room
PER_CELL = 25.0
MOST_CELLS = 96  # along an edge
FAR = 1e3  # [R] no facet is that far
HARDLY = 1e-20  # least component of a direction that counts
PAD = 1e-5  # [R] triangles are listed in all cells to which they come that near


class Facets(NamedTuple):
    """Triangles of some exemplars. For kernels.

    where (e,) int64: which `lots` are those of an exemplar, -1 for none. blocks (b, 10, LANES) float32: x, y, z of
    three corners, and the bits of the facet's number; lanes without one are not numbers. boxes (g, 6, LANES) float32:
    of so many of them, one after the other from `start` (g,) int32 on, lowest and highest corner of what each has of
    its cell; lanes without one are inside out. The blocks of a lot are such groups.
    """

    where: np.ndarray
    lots: tuple[Lots, ...]
    blocks: np.ndarray
    boxes: np.ndarray
    start: np.ndarray


@njit(forceinline=True, **KERNEL)
def _crossed(block, p, d, axis):
    """Return as bits which lanes of a block (10, LANES) have a triangle that the line through p along d crosses, of
    which `axis` is the longest component."""
    x, y = (1 if axis == 0 else (2 if axis == 1 else 0)), (2 if axis == 0 else (0 if axis == 1 else 1))
    dz = d[0] if axis == 0 else (d[1] if axis == 1 else d[2])
    dx = d[1] if axis == 0 else (d[2] if axis == 1 else d[0])
    dy = d[2] if axis == 0 else (d[0] if axis == 1 else d[1])
    px = np.float32(p[1] if axis == 0 else (p[2] if axis == 1 else p[0]))
    py = np.float32(p[2] if axis == 0 else (p[0] if axis == 1 else p[1]))
    pz = np.float32(p[0] if axis == 0 else (p[1] if axis == 1 else p[2]))
    sx, sy, none = np.float32(dx / dz), np.float32(dy / dz), np.float32(0.0)
    found = np.int32(0)
    for lane in range(LANES):
        z = block[axis, lane] - pz
        ax, ay = (block[x, lane] - px) - sx * z, (block[y, lane] - py) - sy * z
        z = block[axis + 3, lane] - pz
        bx, by = (block[x + 3, lane] - px) - sx * z, (block[y + 3, lane] - py) - sy * z
        z = block[axis + 6, lane] - pz
        cx, cy = (block[x + 6, lane] - px) - sx * z, (block[y + 6, lane] - py) - sy * z
        u, v, w = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
        one = ((u >= none) & (v >= none) & (w >= none)) | ((u <= none) & (v <= none) & (w <= none))
        found |= np.int32(one) << np.int32(lane)
    return found


@njit(forceinline=True, **KERNEL)
def _through(boxes, p, each, far):
    """Return as bits which of some boxes (6, LANES) a ray from p comes through nearer than `far`; `each` is one over
    its direction."""
    px, py, pz = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    ex, ey, ez = np.float32(each[0]), np.float32(each[1]), np.float32(each[2])
    x, y, z = (0 if each[0] > 0.0 else 3), (1 if each[1] > 0.0 else 4), (2 if each[2] > 0.0 else 5)
    none, end, found = np.float32(0.0), np.float32(far), np.int32(0)
    for lane in range(LANES):
        a, b, c = (boxes[x, lane] - px) * ex, (boxes[y, lane] - py) * ey, (boxes[z, lane] - pz) * ez
        near = max(max(a, b), max(c, none))
        a, b, c = (boxes[3 - x, lane] - px) * ex, (boxes[5 - y, lane] - py) * ey, (boxes[7 - z, lane] - pz) * ez
        found |= np.int32(near <= min(min(a, b), min(c, end))) << np.int32(lane)
    return found


@njit(forceinline=True, **KERNEL)
def _lowest(bits):
    """Return the place of the lowest of some bits that are set, at most 24: the exponent of that as a float."""
    return (np.float32(bits & -bits).view(np.int32) >> 23) - 127


@njit(**KERNEL)
def facet_met(facets, planes, e, p, d):
    """Return the facet of exemplar e, in whose frame p and d are, that a ray meets first, -1 for none."""
    lots, blocks = facets.lots[facets.where[e]], facets.blocks
    boxes, start = facets.boxes, facets.start
    q, ds, each = scaled(lots, p, d)
    t = arrival(lots, q, each, 0.0)
    if t == math.inf:
        return NONE
    per_d = (_over(d[0]), _over(d[1]), _over(d[2]))
    a, b, c = abs(d[0]), abs(d[1]), abs(d[2])
    axis = 0 if a >= b and a >= c else (1 if b >= c else 2)
    g, best, found = cell_at(lots, q, ds, t), FAR, NONE
    while True:
        lot, wide = lots.lot[(g[0] * lots.counts[1] + g[1]) * lots.counts[2] + g[2]], 1
        if lot < 0:
            wide = -lot
        else:
            first = lot >> BLOCKS
            for group in range(first, first + (lot & MOST_BLOCKS)):
                there = _through(boxes[group], p, per_d, best)
                while there != 0:
                    block = start[group] + _lowest(there)
                    there &= there - 1
                    hits = _crossed(blocks[block], p, d, axis)
                    while hits != 0:
                        facet = np.float32(blocks[block, 9, _lowest(hits)]).view(np.int32)
                        hits &= hits - 1
                        n = (planes[facet, 0], planes[facet, 1], planes[facet, 2])
                        t = (planes[facet, 3] - dot(n, p)) / dot(n, d)
                        if 0.0 <= t < best:
                            best, found = t, facet
        t, g = onward(q, ds, each, g, wide)
        if best <= t or outside(lots, g):
            return found


@njit(forceinline=True, **KERNEL)
def _over(d):
    """Return one over a component of a direction, which is finite."""
    return 1.0 / (d if abs(d) > HARDLY else math.copysign(HARDLY, d))


# ------------------------------------------------------------------------------------------------ making


@njit(cache=True)
def _listed(corners, low, edge, counts, first, listed):
    """Count the triangles (f, 3, 3) that come near each cell in first[1:], or with room for them write them."""
    at = first[:-1].copy()
    ends = np.empty((3, 2), np.int64)
    half = 0.5 * edge + PAD
    for f in range(len(corners)):
        for k in range(3):
            a, b, c = corners[f, 0, k], corners[f, 1, k], corners[f, 2, k]
            ends[k, 0] = max(0, math.floor((min(a, b, c) - PAD - low[k]) / edge))
            ends[k, 1] = min(counts[k], math.floor((max(a, b, c) + PAD - low[k]) / edge) + 1)
        u, v = corners[f, 1] - corners[f, 0], corners[f, 2] - corners[f, 0]
        x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        reach = half * (abs(x) + abs(y) + abs(z))
        height = x * corners[f, 0, 0] + y * corners[f, 0, 1] + z * corners[f, 0, 2]
        for i in range(ends[0, 0], ends[0, 1]):
            for j in range(ends[1, 0], ends[1, 1]):
                for k in range(ends[2, 0], ends[2, 1]):
                    there = x * (low[0] + (i + 0.5) * edge) + y * (low[1] + (j + 0.5) * edge)
                    there += z * (low[2] + (k + 0.5) * edge)
                    if abs(there - height) > reach:
                        continue
                    cell = (i * counts[1] + j) * counts[2] + k
                    if len(listed):
                        listed[at[cell]] = f
                        at[cell] += 1
                    else:
                        first[cell + 1] += 1


@njit(cache=True)
def _parted(middles, listed, first, blocks, lanes):
    """Write the triangles of each cell to lanes (b, LANES), those of a block near each other: halves of halves along
    whatever is longest."""
    done, stack = 0, np.empty((64, 2), np.int64)
    for cell in range(len(blocks)):
        stack[0, 0], stack[0, 1], waiting = first[cell], first[cell + 1], 1
        while waiting > 0:
            waiting -= 1
            low, high = stack[waiting]
            own = listed[low:high]
            if len(own) <= LANES:
                if len(own):
                    lanes[done, : len(own)] = own
                    done += 1
                continue
            widest, axis = -1.0, 0
            for k in range(3):
                wide = middles[own, k].max() - middles[own, k].min()
                if wide > widest:
                    widest, axis = wide, k
            listed[low:high] = own[np.argsort(middles[own, axis])]
            half = low + LANES * ((len(own) + LANES - 1) // LANES // 2)
            stack[waiting, 0], stack[waiting, 1] = half, high
            stack[waiting + 1, 0], stack[waiting + 1, 1] = low, half
            waiting += 2


def _sorted(corners: np.ndarray) -> tuple[Lots, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the cells of triangles (f, 3, 3), the triangle (blocks, LANES) of each lane, -1 for none, the boxes of the
    blocks and the first of each group; None where a cell has too many."""
    low, high = corners.min(axis=(0, 1)) - 10.0 * PAD, corners.max(axis=(0, 1)) + 10.0 * PAD
    edge = max(float((high - low).max()) / MOST_CELLS, float(np.sqrt(8.0 * PER_CELL / len(corners))))
    counts = np.maximum(np.ceil((high - low) / edge), 1.0).astype(np.int64)
    first = np.zeros(int(counts.prod()) + 1, np.int64)
    _listed(corners, low, edge, counts, first, np.zeros(0, np.int64))
    first = np.cumsum(first)
    listed = np.zeros(int(first[-1]), np.int64)
    _listed(corners, low, edge, counts, first, listed)
    blocks = -(-np.diff(first) // LANES)
    groups = -(-blocks // LANES)
    if groups.max() > MOST_BLOCKS:
        return None
    lanes = np.full((int(blocks.sum()), LANES), -1)
    _parted(corners.mean(axis=1), listed, first, blocks, lanes)
    own = np.where(lanes >= 0, lanes, lanes[:, :1])
    ends = corners.min(axis=1)[own].min(axis=1) - PAD, corners.max(axis=1)[own].max(axis=1) + PAD
    cell = np.repeat(np.arange(len(blocks)), blocks)
    at = low + edge * np.stack(np.unravel_index(cell, counts), axis=1)
    ends = np.maximum(ends[0], at - PAD), np.minimum(ends[1], at + edge + PAD)
    place = np.arange(len(cell)) - (np.cumsum(blocks) - blocks)[cell]
    group = (np.cumsum(groups) - groups)[cell] + place // LANES
    boxes = np.empty((int(groups.sum()), 6, LANES), np.float32)
    boxes[:, :3], boxes[:, 3:] = FAR, -FAR
    boxes[group, :, place % LANES] = np.concatenate(ends, axis=1)
    start = np.flatnonzero(place % LANES == 0)
    return lots_of(low, 1.0 / edge, counts, groups), lanes, boxes, start


def facets_of(meshes: list[np.ndarray | None], first_facet: list[int]) -> Facets:
    """Return the facets of exemplars by cells.

    Parameters
    ----------
    meshes : list of (f, 3, 3) float64 or None
        Corners of each one's triangles [R]; None for one that is not to be there.
    first_facet : list of int
        The number of the first facet of each.
    """
    none = Lots(np.zeros(3), 1.0, np.ones(3, np.int64), np.full(1, -1, np.int32))
    where, lots = list[int](), list[Lots]()
    blocks, boxes, starts = (
        [np.zeros((0, 10, LANES), np.float32)], [np.zeros((0, 6, LANES), np.float32)], [np.zeros(0, np.int32)]
    )  # fmt: skip
    begun, groups = 0, 0
    for corners, first in zip(meshes, first_facet, strict=True):
        where.append(-1)
        if corners is None or not 0 < len(corners) <= MOST_FACETS:
            continue
        found = _sorted(corners)
        if found is None or groups + len(found[2]) >= MOST_ALL:
            continue
        own, lanes, box, start = found
        block = np.full((len(lanes), 10, LANES), np.nan, np.float32)
        block[:, :9] = np.where(lanes[..., None] >= 0, corners.reshape(-1, 9)[lanes], np.nan).swapaxes(1, 2)
        block[:, 9] = np.maximum(lanes + first, 0).astype(np.int32).view(np.float32)
        where[-1] = len(lots)
        lots.append(own._replace(lot=np.where(own.lot >= 0, own.lot + (groups << BLOCKS), own.lot).astype(np.int32)))
        blocks.append(block)
        boxes.append(box)
        starts.append((start + begun).astype(np.int32))
        begun, groups = begun + len(lanes), groups + len(box)
    return Facets(
        np.array(where, np.int64), tuple(lots) or (none,), *(np.concatenate(v) for v in (blocks, boxes, starts))
    )
