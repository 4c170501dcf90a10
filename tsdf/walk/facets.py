"""Facets of a grain by cells: which of them a ray meets first, without a ray engine and so without waiting for one.

Sixteen triangles are looked at together, as vector instructions do. Triangles that share an edge see a ray pass it on
the same side, to the last bit (Woop, Benthin & Wald 2013), so none slips through between them; which of those that are
crossed is the first is computed in float64. Blocks of triangles are passed over that the ray does not come near, and
those that all face away: light from outside meets a closed surface from the front, light from inside from behind.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.vectors import KERNEL, cross, dot, step
from tsdf.walk.geometry import NONE, planes_of
from tsdf.walk.lots import BITS, MOST_ALL, MOST_BLOCKS, Lots, arrival, cell_at, listed, lots_of, onward, outside, scaled

ABREAST = 16  # triangles looked at together, and boxes of so many triangles
MOST_FACETS = 200_000  # of a grain: more are for the ray engine, whose tree needs less room
PER_CELL = 50.0
MOST_CELLS = 96  # along an edge
BEYOND = 1e3  # [R] no facet is that far
HARDLY = 1e-20  # least component of a direction that counts
SKIN = 1e-5  # [R] triangles are listed in all cells to which they come that near


class Facets(NamedTuple):
    """Triangles of some exemplars. For kernels.

    where (e,) int64: which `lots` are those of an exemplar, -1 for none. blocks (b, 10, ABREAST) float32: x, y, z of
    three corners, and the bits of the facet's number; lanes without one are not numbers. boxes (g, 12, ABREAST)
    float32: of so many of them, one after the other from `start` (g,) int32 on: lowest and highest corner of what each
    has of its cell; a direction about which its facets' normals lie, the sine of the farthest one's angle to that,
    beyond 1 of a right angle or more, and the least and greatest height along it. Lanes without one are inside out. The
    blocks of a lot are such groups.
    """

    where: np.ndarray
    lots: tuple[Lots, ...]
    blocks: np.ndarray
    boxes: np.ndarray
    start: np.ndarray


@njit(forceinline=True, **KERNEL)
def _crossed(block, p, d, axis):
    """Return as bits which lanes of a block (10, ABREAST) have a triangle that the line through p along d crosses, of
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
    for lane in range(ABREAST):
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


@njit(forceinline=True, fastmath={"contract"}, **KERNEL)
def _through(boxes, p, each, toward, sign, far):
    """Return as bits which of some boxes (12, ABREAST) a ray from p comes through nearer than `far` that have a facet
    whose normal may point along `toward`, which is its direction times `sign`; `each` is one over its direction."""
    px, py, pz = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    ex, ey, ez = np.float32(each[0]), np.float32(each[1]), np.float32(each[2])
    sign = np.float32(sign)
    tx, ty, tz = np.float32(toward[0]), np.float32(toward[1]), np.float32(toward[2])
    x, y, z = (0 if each[0] > 0.0 else 3), (1 if each[1] > 0.0 else 4), (2 if each[2] > 0.0 else 5)
    none, far, hardly, found = np.float32(0.0), np.float32(far), np.float32(1e-12), np.int32(0)
    for lane in range(ABREAST):
        a, b, c = (boxes[x, lane] - px) * ex, (boxes[y, lane] - py) * ey, (boxes[z, lane] - pz) * ez
        near = max(max(a, b), max(c, none))
        a, b, c = (boxes[3 - x, lane] - px) * ex, (boxes[5 - y, lane] - py) * ey, (boxes[7 - z, lane] - pz) * ez
        end = min(min(a, b), min(c, far))
        across = boxes[6, lane] * tx + boxes[7, lane] * ty + boxes[8, lane] * tz
        height = boxes[6, lane] * px + boxes[7, lane] * py + boxes[8, lane] * pz
        per = sign / (across if abs(across) > hardly else hardly)
        a, b = (boxes[10, lane] - height) * per, (boxes[11, lane] - height) * per
        near, end = max(near, min(a, b)), min(end, max(a, b))
        found |= np.int32((near <= end) & (across >= -boxes[9, lane])) << np.int32(lane)
    return found


@njit(forceinline=True, **KERNEL)
def _lowest(bits):
    """Return the place of the lowest of some bits that are set, at most 24: the exponent of that as a float."""
    return (np.float32(bits & -bits).view(np.int32) >> 23) - 127


@njit(forceinline=True, **KERNEL)
def _reached(block, lane, p, d):
    """Return how far it is from p along d to the triangle of a lane, and whether it is met from behind."""
    a = (float(block[0, lane]), float(block[1, lane]), float(block[2, lane]))
    u = (block[3, lane] - a[0], block[4, lane] - a[1], block[5, lane] - a[2])
    v = (block[6, lane] - a[0], block[7, lane] - a[1], block[8, lane] - a[2])
    n = cross(u, v)
    cosine = dot(n, d)
    return dot(n, step(a, -1.0, p)) / cosine, cosine > 0.0


@njit(**KERNEL)
def facet_met(facets, e, p, d, inside):
    """Return the facet of exemplar e, in whose frame p and d are, that a ray meets first of those that face the side
    from which it comes, -1 for none."""
    lots, blocks = facets.lots[facets.where[e]], facets.blocks
    boxes, start = facets.boxes, facets.start
    q, ds, each = scaled(lots, p, d)
    t = arrival(lots, q, each, 0.0)
    if t == math.inf:
        return NONE
    per_d = (_over(d[0]), _over(d[1]), _over(d[2]))
    a, b, c = abs(d[0]), abs(d[1]), abs(d[2])
    axis = 0 if a >= b and a >= c else (1 if b >= c else 2)
    sign = 1.0 if inside else -1.0
    toward = (sign * d[0], sign * d[1], sign * d[2])
    g, best, found = cell_at(lots, q, ds, t), BEYOND, NONE
    while True:
        lot, wide = lots.lot[(g[0] * lots.counts[1] + g[1]) * lots.counts[2] + g[2]], 1
        if lot < 0:
            wide = -lot
        else:
            first = lot >> BITS
            for group in range(first, first + (lot & MOST_BLOCKS)):
                there = _through(boxes[group], p, per_d, toward, sign, best)
                while there != 0:
                    block = start[group] + _lowest(there)
                    there &= there - 1
                    hits = _crossed(blocks[block], p, d, axis)
                    while hits != 0:
                        lane = _lowest(hits)
                        hits &= hits - 1
                        t, behind = _reached(blocks[block], lane, p, d)
                        if 0.0 <= t < best and behind == inside:
                            best, found = t, np.float32(blocks[block, 9, lane]).view(np.int32)
        t, g = onward(q, ds, each, g, wide)
        if best <= t or outside(lots, g):
            return found


@njit(forceinline=True, **KERNEL)
def _over(d):
    """Return one over a component of a direction, which is finite."""
    return 1.0 / (d if abs(d) > HARDLY else math.copysign(HARDLY, d))


# ------------------------------------------------------------------------------------------------ making


@njit(cache=True)
def _parted(middles, found, first, blocks, lanes):
    """Write the triangles of each cell to lanes (b, ABREAST), those of a block near each other: halves of halves along
    whatever is longest."""
    done, stack = 0, np.empty((64, 2), np.int64)
    for cell in range(len(blocks)):
        stack[0, 0], stack[0, 1], waiting = first[cell], first[cell + 1], 1
        while waiting > 0:
            waiting -= 1
            low, high = stack[waiting]
            own = found[low:high]
            if len(own) <= ABREAST:
                if len(own):
                    lanes[done, : len(own)] = own
                    done += 1
                continue
            widest, axis = -1.0, 0
            for k in range(3):
                wide = middles[own, k].max() - middles[own, k].min()
                if wide > widest:
                    widest, axis = wide, k
            found[low:high] = own[np.argsort(middles[own, axis])]
            half = low + ABREAST * ((len(own) + ABREAST - 1) // ABREAST // 2)
            stack[waiting, 0], stack[waiting, 1] = half, high
            stack[waiting + 1, 0], stack[waiting + 1, 1] = low, half
            waiting += 2


def _about(normals: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return a direction (n, 3) about which some normals (n, k, 3) lie; the sine of the farthest one's angle to it, a
    little more, 2 of a right angle or more; and least and greatest height of their corners (n, k, 3, 3) along it."""
    normals = np.nan_to_num(normals)
    mean = normals.sum(axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    least = np.einsum("ij,ikj->ik", mean, normals).min(axis=1)
    h = np.einsum("ij,iklj->ikl", mean, corners)
    return (
        mean,
        np.where(least > 0.01, np.sqrt(np.maximum(1.0 - least**2, 0.0)) + 1e-3, 2.0),
        h.min(axis=(1, 2)) - SKIN,
        h.max(axis=(1, 2)) + SKIN,
    )


def _sorted(corners: np.ndarray) -> tuple[Lots, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the cells of triangles (f, 3, 3), the triangle (blocks, ABREAST) of each lane, -1 for none, the boxes of
    the blocks and the first of each group; None where a cell has too many."""
    low, high = corners.min(axis=(0, 1)) - 10.0 * SKIN, corners.max(axis=(0, 1)) + 10.0 * SKIN
    edge = max(float((high - low).max()) / MOST_CELLS, float(np.sqrt(8.0 * PER_CELL / len(corners))))
    counts = np.maximum(np.ceil((high - low) / edge), 1.0).astype(np.int64)
    planes = planes_of(corners)
    cell, facet = listed(corners.min(axis=1) - SKIN, corners.max(axis=1) + SKIN, low, edge, counts)
    middle = low + (np.stack(np.unravel_index(cell, counts), axis=1) + 0.5) * edge
    off = np.abs(np.einsum("ij,ij->i", planes[facet, :3], middle) - planes[facet, 3])
    near = ~(off > (0.5 * edge + SKIN) * np.abs(planes[facet, :3]).sum(axis=1))  # a triangle without area has no plane
    found = facet[near]
    first = np.concatenate(([0], np.cumsum(np.bincount(cell[near], minlength=int(counts.prod())))))
    blocks = -(-np.diff(first) // ABREAST)
    groups = -(-blocks // ABREAST)
    if groups.max() > MOST_BLOCKS:
        return None
    lanes = np.full((int(blocks.sum()), ABREAST), -1)
    _parted(corners.mean(axis=1), found, first, blocks, lanes)
    own = np.where(lanes >= 0, lanes, lanes[:, :1])
    ends = corners.min(axis=1)[own].min(axis=1) - SKIN, corners.max(axis=1)[own].max(axis=1) + SKIN
    cell = np.repeat(np.arange(len(blocks)), blocks)
    at = low + edge * np.stack(np.unravel_index(cell, counts), axis=1)
    ends = np.maximum(ends[0], at - SKIN), np.minimum(ends[1], at + edge + SKIN)
    place = np.arange(len(cell)) - (np.cumsum(blocks) - blocks)[cell]
    group = (np.cumsum(groups) - groups)[cell] + place // ABREAST
    boxes = np.zeros((int(groups.sum()), 12, ABREAST), np.float32)
    boxes[:, :3], boxes[:, 3:6] = BEYOND, -BEYOND
    boxes[group, :, place % ABREAST] = np.column_stack((*ends, *_about(planes[own, :3], corners[own])))
    start = np.flatnonzero(place % ABREAST == 0)
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
        [np.zeros((0, 10, ABREAST), np.float32)], [np.zeros((0, 12, ABREAST), np.float32)], [np.zeros(0, np.int32)]
    )  # fmt: skip
    begun, groups = 0, 0
    for corners, first in zip(meshes, first_facet, strict=True):
        where.append(-1)
        if corners is None or not 0 < len(corners) <= MOST_FACETS or not np.isfinite(corners).all():
            continue
        found = _sorted(corners)
        if found is None or groups + len(found[2]) >= MOST_ALL:
            continue
        own, lanes, box, start = found
        block = np.full((len(lanes), 10, ABREAST), np.nan, np.float32)
        block[:, :9] = np.where(lanes[..., None] >= 0, corners.reshape(-1, 9)[lanes], np.nan).swapaxes(1, 2)
        block[:, 9] = np.maximum(lanes + first, 0).astype(np.int32).view(np.float32)
        where[-1] = len(lots)
        lots.append(own._replace(lot=np.where(own.lot >= 0, own.lot + (groups << BITS), own.lot).astype(np.int32)))
        blocks.append(block)
        boxes.append(box)
        starts.append((start + begun).astype(np.int32))
        begun, groups = begun + len(lanes), groups + len(box)
    return Facets(
        np.array(where, np.int64), tuple(lots) or (none,), *(np.concatenate(v) for v in (blocks, boxes, starts))
    )
