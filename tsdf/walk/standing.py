"""Grains that stand alone: of a medium that nothing else is beside, each that there is, with all that a ray asks of it.

What is packed repeats for ever, and a boundary says which grains there are. But where a scene has one medium and
nothing else, light meets nothing at the boundary: only grains. So these are listed once, in cells of which most that
are empty are passed at once (`lots`), and light goes from grain to grain, and out, without asking where the boundary
is. They are the same grains, in the same places, turned the same way as those that `explicit` finds. `tour` is a kernel
of its own, compiled by who has such a scene and nobody else.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.handle import Handle
from tsdf.spheres.around import LANES, entered, met
from tsdf.vectors import KERNEL, step, triple, unit_of
from tsdf.walk import explicit as X
from tsdf.walk.facets import facet_met
from tsdf.walk.geometry import Place
from tsdf.walk.hybrid import hand_over
from tsdf.walk.lights import radiance as light_from
from tsdf.walk.lots import BLOCKS, MOST_ALL, MOST_BLOCKS, Lots, arrival, cell_at, lots_of, onward, outside, scaled
from tsdf.walk.room import BALL, SLAB, stand
from tsdf.walk.transport import in_grain
from tsdf.walk.walker import ENDED, FLY, GRAIN, HANDED, JUMP, LOOK, NONE, PATIENCE, find, write

MOST = 200_000  # grains; more are asked of the packing, which needs no room for each
MOST_TILES = 10_000  # of the packing, a third of a second
MOST_CELLS = 2_000_000
PAD = 1e-3  # [R] cells list spheres that come this close, far more than the rounding of float32
FAR = 1e6  # [R] where lanes without a sphere have theirs
HARDLY = 1e-6  # [R] beyond a sphere that is not to be met again


class Standing(NamedTuple):
    """For kernels. Lengths are in R, about the scene's centre.

    there: whether there is a list at all; lots, blocks (b, 4, LANES) float32: spheres by cells, x, y, z relative to the
    cell's middle, and the bits of the grain's number; of grains: centre (n, 3); turned (n, 4), quaternions as of
    `explicit.rotation`; component (n,) int32; key (n,) uint64; sphere (n,) int32, its number in the packing.
    """

    there: bool
    lots: Lots
    blocks: np.ndarray
    centre: np.ndarray
    turned: np.ndarray
    component: np.ndarray
    key: np.ndarray
    sphere: np.ndarray


# ------------------------------------------------------------------------------------------- for kernels


@njit(**KERNEL)
def first_met(standing, p, d, start):
    """Return the number of the grain whose sphere a ray enters first, at `start` or beyond [R]; -1 for none."""
    lots, blocks = standing.lots, standing.blocks
    q, ds, each = scaled(lots, p, d)
    t = arrival(lots, q, each, start)
    if t == math.inf:
        return -1
    g, least, edge = cell_at(lots, q, ds, t), 0.0, 1.0 / lots.per_edge
    while True:
        lot, wide = lots.lot[(g[0] * lots.counts[1] + g[1]) * lots.counts[2] + g[2]], 1
        best, block = math.inf, -1
        if lot < 0:
            wide = -lot
        else:
            o = (
                (q[0] + t * ds[0] - g[0] - 0.5) * edge,
                (q[1] + t * ds[1] - g[1] - 0.5) * edge,
                (q[2] + t * ds[2] - g[2] - 0.5) * edge,
            )
            block = lot >> BLOCKS
            here = met(blocks[block], o, d, least)
            for b in range(block + 1, block + (lot & MOST_BLOCKS)):
                other = met(blocks[b], o, d, least)
                if other < here:
                    here, block = other, b
            best = t + float(np.int32(here).view(np.float32))
        after, g = onward(q, ds, each, g, wide)
        if block >= 0 and best <= after + PAD:
            return np.float32(blocks[block, 3, here & (LANES - 1)]).view(np.int32)
        if outside(lots, g):
            return -1
        t, least = max(t, after), -PAD


@njit(**KERNEL)
def enter_next(standing, grains, w, last):
    """Bring a walker to the next grain, into its frame; return the grain, -1 for none. `last` is the one it has left,
    whose sphere, which is convex, it cannot meet."""
    r, d = grains.radius[0], triple(w.d)
    o, start, by = (w.p[0] / r, w.p[1] / r, w.p[2] / r), 0.0, HARDLY
    grain = first_met(standing, o, d, 0.0)
    while grain >= 0 and grain == last:
        start, by = start + by, 2.0 * by
        grain = first_met(standing, o, d, start)
    if grain < 0:
        return grain
    centre = (standing.centre[grain, 0], standing.centre[grain, 1], standing.centre[grain, 2])
    away = step(o, -1.0, centre)
    s = max(entered((-away[0], -away[1], -away[2]), d)[0], 0.0)
    x = unit_of(step(away, s, d))
    w.mode, w.state, w.facet, w.pdf, w.ray, w.medium = GRAIN, X.ENTERED, NONE, -1.0, NONE, 0
    w.component, w.grain, w.left = standing.component[grain], standing.key[grain], standing.sphere[grain] + 1
    write(w.q, (r * centre[0], r * centre[1], r * centre[2]))
    axis, w.b = (0.0, 0.0, 0.0), 1.0
    if grains.exemplar[w.component] != X.EXACT_SPHERE:
        axis, w.b = (
            (standing.turned[grain, 0], standing.turned[grain, 1], standing.turned[grain, 2]),
            standing.turned[grain, 3],
        )
        back = (-axis[0], -axis[1], -axis[2])
        x, d = X.rotated(back, w.b, x), X.rotated(back, w.b, d)
    write(w.t, axis)
    write(w.p, x)
    write(w.e, x)
    write(w.d, d)
    return grain


@njit(**KERNEL)
def travel(standing, world, batch, w, amounts):
    """Take a walker from grain to grain; return ENDED, HANDED, or LOOK where others are to have their turn or the ray
    engine must be asked."""
    grains, last = world.grains, -1
    for _ in range(PATIENCE):
        if w.mode == FLY:
            last = enter_next(standing, grains, w, last)
            if last < 0:
                find(world, batch, w, amounts, light_from(world.lights, triple(w.d), -1.0))
                return ENDED
        e, facet = grains.exemplar[w.component], NONE
        if e != X.EXACT_SPHERE:
            if grains.first_side[e] < grains.first_side[e + 1]:
                facet = X.side_met(grains, e, w)
            elif grains.facets.where[e] >= 0:
                facet = facet_met(grains.facets, grains.planes, e, triple(w.e), triple(w.d))
            else:
                return LOOK
        state = in_grain(world, batch, w, amounts, facet)
        if state != LOOK:
            return state
    return LOOK


@njit(**KERNEL)
def tour(standing, near, world, batch, count):
    """Take those of a batch's walkers, the first `count`, that meet single grains, which is the world `near`, as far as
    they come. Those that end are left in a grain that they have left, where `transport` ends them."""
    for i in range(count):
        w = batch.walkers[i]
        if w.mode == JUMP or w.ray >= 0 or w.single >= near.media.singles:
            continue
        state = travel(standing, near, batch, w, batch.amounts[i])
        if state == ENDED:
            w.mode, w.state, w.single = GRAIN, X.LEFT, min(w.single, near.media.singles - 1)
        elif state == HANDED:
            hand_over(world, w)


# ------------------------------------------------------------------------------------------------ making


@njit(cache=True)
def _cells_of(centre, low, edge, counts, first, listed):
    """Count the spheres that come near each cell in first[1:], or with room for them write them to `listed`."""
    at, reach = first[:-1].copy(), 1.0 + PAD
    ends = np.empty((3, 2), np.int64)
    for s in range(len(centre)):
        for k in range(3):
            ends[k, 0] = max(0, math.floor((centre[s, k] - reach - low[k]) / edge))
            ends[k, 1] = min(counts[k], math.floor((centre[s, k] + reach - low[k]) / edge) + 1)
        for i in range(ends[0, 0], ends[0, 1]):
            x = abs(low[0] + (i + 0.5) * edge - centre[s, 0]) - 0.5 * edge
            for j in range(ends[1, 0], ends[1, 1]):
                y = abs(low[1] + (j + 0.5) * edge - centre[s, 1]) - 0.5 * edge
                for k in range(ends[2, 0], ends[2, 1]):
                    z = abs(low[2] + (k + 0.5) * edge - centre[s, 2]) - 0.5 * edge
                    if max(x, 0.0) ** 2 + max(y, 0.0) ** 2 + max(z, 0.0) ** 2 > reach * reach:
                        continue
                    cell = (i * counts[1] + j) * counts[2] + k
                    if len(listed):
                        listed[at[cell]] = s
                        at[cell] += 1
                    else:
                        first[cell + 1] += 1


@njit(cache=True)
def _known(grains, first, count, tiles, spheres, key, component, turned):
    """Write key, component and rotation of grains, known by tile (n, 3) and sphere (n,)."""
    for i in range(len(spheres)):
        key[i] = X.named(grains, 0, tiles[i, 0], tiles[i, 1], tiles[i, 2], spheres[i])
        component[i] = X.component_of(grains, first, count, key[i])
        turned[i, 0], turned[i, 1], turned[i, 2], turned[i, 3] = X.rotation(key[i])


def nothing_standing() -> Standing:
    """Return the grains of a scene that has none of its own, or too many."""
    lots = Lots(np.zeros(3), 1.0, np.ones(3, np.int64), np.full(1, -1, np.int32))
    return Standing(False, lots, np.zeros((0, 4, LANES), np.float32), np.zeros((0, 3)), np.zeros((0, 4)),
                    np.zeros(0, np.int32), np.zeros(0, np.uint64), np.zeros(0, np.int32))  # fmt: skip


def standing(packed: X.Packed, place: Place, kinds: int) -> Standing:
    """Return what `standing_of` does, made once for the same packing and place."""
    kept = packed.kept
    if kept is None or kept[0] is not packed.arrays or kept[1] is not place:
        kept = packed.kept = (packed.arrays, place, standing_of(packed.arrays, place, kinds))
    return kept[2]


def standing_of(grains: X.Grains, place: Place, kinds: int) -> Standing:
    """Return the grains of a scene's only medium, of so many components, as far as they can be listed.

    They are not `there` where other media or surfaces are, where a medium is endless, and where there are too many.
    """
    g = place.arrays
    if len(g.kind) != 1 or g.solid or len(g.balls) or g.kind[0] == SLAB or not len(grains.centres[0]):
        return nothing_standing()
    radius, side, centres = float(grains.radius[0]), grains.cells[0].side, grains.centres[0]
    low, high = (v / radius for v in _extent(place))
    if (high - low).prod() * len(centres) > 4.0 * MOST * side**3:  # with room for grains that do not stand
        return nothing_standing()
    room, tiles, spheres, found = Handle(place.room), [], [], []
    every = [range(math.floor(a), math.floor(b) + 1) for a, b in zip(low / side, high / side, strict=True)]
    if math.prod(map(len, every)) > MOST_TILES:
        return nothing_standing()
    there = np.zeros(len(centres), np.uint8)
    for tile in itertools.product(*every):
        own = centres + side * np.array(tile)
        near = ((own > low) & (own < high)).all(axis=1)
        own, number = own[near], np.flatnonzero(near)
        stand(room, 0, radius * own, there)
        stands = there[: len(own)] > 0
        found.append(own[stands])
        spheres.append(number[stands])
        tiles.append(np.tile(tile, (int(stands.sum()), 1)))
    centre, sphere = np.concatenate(found), np.concatenate(spheres).astype(np.int32)
    if not len(centre) or len(centre) > MOST:
        return nothing_standing()
    low, high = centre.min(axis=0) - 1.0 - 2.0 * PAD, centre.max(axis=0) + 1.0 + 2.0 * PAD
    around = grains.around[0]
    edge = around.side / around.m
    counts = np.ceil((high - low) / edge).astype(np.int64)
    if counts.prod() > MOST_CELLS:
        return nothing_standing()
    first = np.zeros(int(counts.prod()) + 1, np.int64)
    _cells_of(centre, low, edge, counts, first, np.zeros(0, np.int64))
    number = first[1:].copy()
    first = np.cumsum(first)
    listed = np.zeros(int(first[-1]), np.int64)
    _cells_of(centre, low, edge, counts, first, listed)
    blocks = -(-number // LANES)
    if blocks.max() > MOST_BLOCKS or blocks.sum() >= MOST_ALL:
        return nothing_standing()
    cell = np.repeat(np.arange(len(number)), number)
    at = (np.cumsum(blocks) - blocks)[cell] * LANES + np.arange(len(listed)) - np.repeat(first[:-1], number)
    lanes = np.full((int(blocks.sum()) * LANES, 4), FAR, np.float32)
    middle = low + (np.stack(np.unravel_index(cell, counts), axis=1) + 0.5) * edge
    lanes[at, :3], lanes[at, 3] = centre[listed] - middle, listed.astype(np.int32).view(np.float32)
    key, component, turned = (
        np.zeros(len(sphere), np.uint64), np.zeros(len(sphere), np.int32), np.zeros((len(sphere), 4))
    )  # fmt: skip
    _known(Handle(grains), 0, kinds, np.concatenate(tiles), sphere, key, component, turned)
    return Standing(
        there=True,
        lots=lots_of(low, 1.0 / edge, counts, blocks),
        blocks=np.ascontiguousarray(lanes.reshape(-1, LANES, 4).swapaxes(1, 2)),
        centre=centre,
        turned=turned,
        component=component,
        key=key,
        sphere=sphere,
    )


def _extent(place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box about the only medium of a scene [unit]."""
    kind, shape, boundary = place.arrays.kind[0], place.arrays.shape[0], place.boundaries[0]
    if boundary is not None:
        return boundary.vertices.min(axis=0), boundary.vertices.max(axis=0)
    if kind == BALL:
        return shape[:3] - shape[3], shape[:3] + shape[3]
    return shape[:3], shape[3:]
