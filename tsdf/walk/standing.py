"""Grains that stand alone: of a medium that nothing else is beside, each that there is, with all that a ray asks of it.

What is packed repeats for ever, and a boundary says which grains there are. But where a scene has one medium and
nothing else, light meets nothing at the boundary: only grains. So these are listed once, in cells of which most that
are empty are passed at once (`lots`), and light goes from grain to grain, and out, without asking where the boundary
is. They are the same grains, in the same places, turned the same way as those that `explicit` finds. `walk` and `tour`
are kernels of their own, compiled by who has such a scene and nobody else.
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
from tsdf.walk.facets import Facets, facet_met, facets_of
from tsdf.walk.geometry import Place
from tsdf.walk.hulls import MARGIN, ROWS, WORTH, ellipsoid_of, reach_of, rows_of, seen, shadow
from tsdf.walk.hybrid import hand_over
from tsdf.walk.lights import radiance as light_from
from tsdf.walk.lots import (
    BITS,
    MOST_ALL,
    MOST_BLOCKS,
    Lots,
    arrival,
    cell_at,
    listed,
    lots_of,
    onward,
    outside,
    scaled,
)
from tsdf.walk.room import BALL, SLAB, stand
from tsdf.walk.transport import in_grain, spawn
from tsdf.walk.walker import ENDED, FLY, GRAIN, HANDED, JUMP, LOOK, NONE, PATIENCE, copy, find, write

MOST = 200_000  # grains; more are asked of the packing, which needs no room for each
MOST_TILES = 10_000  # of the packing, a third of a second
WIDER = 1.4  # than those of `around` are cells of grains that fill little of their spheres
MOST_CELLS = 2_000_000
NEAR = 1e-3  # [R] cells list spheres that come this close, far more than the rounding of float32
NOWHERE = 1e6  # [R] where lanes without a sphere have theirs
ASK = -2  # no facet
CREW = 256  # walkers side by side
CREWS = 64  # before others have their turn
LIVE, NEXT, OTHERS = range(3)  # of `Crew.counts`
HARDLY = 1e-6  # [R] beyond a sphere that is not to be met again


class Standing(NamedTuple):
    """For kernels. Lengths are in R, about the scene's centre.

    there: whether there is a list at all; lots, blocks (b, 4 or ROWS, LANES) float32: spheres by cells, x, y, z
    relative to the cell's middle, the bits of the grain's number, and the ellipsoid if any grain has one (`hulls`); of
    grains: centre (n, 3); turned (n, 4), quaternions as of `explicit.rotation`; component (n,) int32; key (n,) uint64;
    sphere (n,) int32, its number in the packing. facets: of the exemplars.
    """

    there: bool
    lots: Lots
    blocks: np.ndarray
    centre: np.ndarray
    turned: np.ndarray
    component: np.ndarray
    key: np.ndarray
    sphere: np.ndarray
    facets: Facets


class Crew(NamedTuple):
    """Walkers side by side. For kernels.

    counts (3,): how many there are, the next sample, and how many others are to take on. rows (CREW,): where in the
    batch each is; last, ahead (CREW,): the grain that it has entered last, and the facet that it meets next.
    """

    counts: np.ndarray
    rows: np.ndarray
    last: np.ndarray
    ahead: np.ndarray


# ------------------------------------------------------------------------------------------- for kernels


@njit(forceinline=True, **KERNEL)
def _nearest(block, p, d, least):
    """Return the sphere of a block that a ray enters first, as `around.met`, if it meets what is known of its grain."""
    return seen(block, p, d, least) if block.shape[0] == ROWS else met(block, p, d, least)


@njit(**KERNEL)
def first_met(standing, p, d, start):
    """Return the number of the grain whose sphere a ray enters first, at `start` or beyond [R]; -1 for none."""
    lots, blocks = standing.lots, standing.blocks
    q, ds, each = scaled(lots, p, d)
    t = arrival(lots, q, each, start)
    if t == math.inf:
        return -1
    g, edge = cell_at(lots, q, ds, t), 1.0 / lots.per_edge
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
            block, least = lot >> BITS, start - t  # its sphere may have been entered in another cell
            here = _nearest(blocks[block], o, d, least)
            for b in range(block + 1, block + (lot & MOST_BLOCKS)):
                other = _nearest(blocks[b], o, d, least)
                if other < here:
                    here, block = other, b
            best = t + float(np.int32(here).view(np.float32))
        after, g = onward(q, ds, each, g, wide)
        if block >= 0 and best <= after + NEAR:
            return np.float32(blocks[block, 3, here & (LANES - 1)]).view(np.int32)
        if outside(lots, g):
            return -1
        t = max(t, after)


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
def facet_ahead(standing, grains, w):
    """Return the facet that a walker in a grain's frame meets next, -1 for none and of an exact sphere, ASK where the
    ray engine must say."""
    e = grains.exemplar[w.component]
    if e == X.EXACT_SPHERE:
        return NONE
    if grains.first_side[e] < grains.first_side[e + 1]:
        return X.side_met(grains, e, w)
    if standing.facets.where[e] < 0:
        return ASK
    inside = (w.state & X.INSIDE) != 0
    return facet_met(standing.facets, e, triple(w.e), triple(w.d), inside)


@njit(**KERNEL)
def travel(standing, world, batch, w, amounts):
    """Take a walker from grain to grain; return ENDED, HANDED, or LOOK where others are to have their turn or the ray
    engine must be asked."""
    last = NONE
    for _ in range(PATIENCE):
        if w.mode == FLY:
            last = enter_next(standing, world.grains, w, last)
            if last < 0:
                find(world, batch, w, amounts, light_from(world.lights, triple(w.d), -1.0))
                return ENDED
        facet = facet_ahead(standing, world.grains, w)
        if facet == ASK:
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


@njit(**KERNEL)
def walk(standing, near, world, batch, crew, job, total):
    """Take the samples of a job, `total` of them, as far as they come, a crew after the other; end when all are done,
    or others must have their turn: after so many crews, or when so many must go on as `transport` has them that there
    may be no room for more. These are then the first of the batch's walkers."""
    counts, first = crew.counts, batch.walkers.shape[0] - CREW
    counts[OTHERS] = 0
    for _ in range(CREWS):
        if counts[NEXT] == total or 4 * counts[OTHERS] > first:
            break
        count = min(CREW, total - counts[NEXT])
        spawn(batch, first, job, counts[NEXT], count)
        counts[NEXT] += count
        counts[LIVE] = count
        for k in range(count):
            crew.rows[k], crew.last[k] = first + k, NONE
        for k in range(count - 1, -1, -1):
            if batch.walkers[first + k].single >= near.media.singles:
                part(batch, crew, k)
        patience = PATIENCE
        while counts[LIVE] > 0 and patience > 0:
            go(standing, near, world, batch, crew)
            patience -= 1
        while counts[LIVE] > 0:
            part(batch, crew, counts[LIVE] - 1)


@njit(**KERNEL)
def go(standing, near, world, batch, crew):
    """Take each of a crew to the next facet or through the next grain. All take each step before any takes the next:
    a processor waits less where what it begins does not need what it has just begun."""
    counts, rows, ahead = crew.counts, crew.rows, crew.ahead
    for k in range(counts[LIVE] - 1, -1, -1):
        w = batch.walkers[rows[k]]
        if w.mode == FLY:
            crew.last[k] = enter_next(standing, near.grains, w, crew.last[k])
            if crew.last[k] < 0:
                find(near, batch, w, batch.amounts[rows[k]], light_from(near.lights, triple(w.d), -1.0))
                drop(crew, k)
    for k in range(counts[LIVE]):
        ahead[k] = facet_ahead(standing, near.grains, batch.walkers[rows[k]])
    for k in range(counts[LIVE] - 1, -1, -1):
        w, state = batch.walkers[rows[k]], HANDED
        if ahead[k] != ASK:
            state = in_grain(near, batch, w, batch.amounts[rows[k]], ahead[k])
            if state == HANDED:
                hand_over(world, w)
        if state == HANDED:
            part(batch, crew, k)
        elif state == ENDED:
            drop(crew, k)


@njit(forceinline=True, **KERNEL)
def drop(crew, k):
    """Let the last of a crew have the place of one that is done."""
    crew.counts[LIVE] -= 1
    last = crew.counts[LIVE]
    crew.rows[k], crew.last[k], crew.ahead[k] = crew.rows[last], crew.last[last], crew.ahead[last]


@njit(**KERNEL)
def part(batch, crew, k):
    """Have one of a crew go on with those that are left to others."""
    to = crew.counts[OTHERS]
    batch.walkers[to] = batch.walkers[crew.rows[k]]
    copy(batch.amounts[to], batch.amounts[crew.rows[k]])
    crew.counts[OTHERS] += 1
    drop(crew, k)


# ------------------------------------------------------------------------------------------------ making


@njit(cache=True)
def _known(grains, first, count, tiles, spheres, key, component, turned):
    """Write key, component and rotation of grains, known by tile (n, 3) and sphere (n,)."""
    for i in range(len(spheres)):
        key[i] = X.named(grains, 0, tiles[i, 0], tiles[i, 1], tiles[i, 2], spheres[i])
        component[i] = X.component_of(grains, first, count, key[i])
        turned[i, 0], turned[i, 1], turned[i, 2], turned[i, 3] = X.rotation(key[i])


def crew_of() -> Crew:
    """Return a crew that is not there yet."""
    return Crew(np.zeros(3, np.int64), *(np.zeros(CREW, np.int64) for _ in range(3)))


def nothing_standing() -> Standing:
    """Return the grains of a scene that has none of its own, or too many."""
    lots = Lots(np.zeros(3), 1.0, np.ones(3, np.int64), np.full(1, -1, np.int32))
    return Standing(False, lots, np.zeros((0, 4, LANES), np.float32), np.zeros((0, 3)), np.zeros((0, 4)),
                    np.zeros(0, np.int32), np.zeros(0, np.uint64), np.zeros(0, np.int32),
                    facets_of([], []))  # fmt: skip


def standing(packed: X.Packed, place: Place, kinds: int) -> Standing:
    """Return what `standing_of` does, made once for the same packing and place."""
    kept = packed.kept
    if kept is None or kept[0] is not packed.arrays or kept[1] is not place:
        kept = packed.kept = (packed.arrays, place, standing_of(packed, place, kinds))
    return kept[2]


def standing_of(packed: X.Packed, place: Place, kinds: int) -> Standing:
    """Return the grains of a scene's only medium, of so many components, as far as they can be listed.

    They are not `there` where other media or surfaces are, where a medium is endless, and where there are too many.
    """
    g, grains = place.arrays, packed.arrays
    if len(g.kind) != 1 or g.solid or len(g.balls) or g.kind[0] == SLAB or not len(grains.centres[0]):
        return nothing_standing()
    found = _found(grains, place)
    if found is None:
        return nothing_standing()
    centre, tiles, sphere = found
    key, component, turned = (
        np.zeros(len(sphere), np.uint64), np.zeros(len(sphere), np.int32), np.zeros((len(sphere), 4))
    )  # fmt: skip
    _known(Handle(grains), 0, kinds, tiles, sphere, key, component, turned)
    rows, lows, highs = _hulls(packed, component, turned)
    low, high = centre.min(axis=0) - 1.0 - 2.0 * NEAR, centre.max(axis=0) + 1.0 + 2.0 * NEAR
    around = grains.around[0]
    edge = (WIDER if rows.shape[1] else 1.0) * around.side / around.m
    counts = np.ceil((high - low) / edge).astype(np.int64)
    if counts.prod() > MOST_CELLS:
        return nothing_standing()
    cell, one = listed(centre + lows - NEAR, centre + highs + NEAR, low, edge, counts)
    middle = low + (np.stack(np.unravel_index(cell, counts), axis=1) + 0.5) * edge
    near = (np.maximum(np.abs(centre[one] - middle) - 0.5 * edge, 0.0) ** 2).sum(axis=1) <= (1.0 + NEAR) ** 2
    cell, one, middle = cell[near], one[near], middle[near]
    number = np.bincount(cell, minlength=int(counts.prod()))
    blocks = -(-number // LANES)
    if blocks.max() > MOST_BLOCKS or blocks.sum() >= MOST_ALL:
        return nothing_standing()
    at = (np.cumsum(blocks) - blocks)[cell] * LANES + np.arange(len(cell)) - (np.cumsum(number) - number)[cell]
    lanes = np.full((int(blocks.sum()) * LANES, 4 + rows.shape[1]), NOWHERE, np.float32)
    lanes[at, :3], lanes[at, 3], lanes[at, 4:] = centre[one] - middle, one.astype(np.int32).view(np.float32), rows[one]
    return Standing(
        there=True,
        lots=lots_of(low, 1.0 / edge, counts, blocks),
        blocks=np.ascontiguousarray(lanes.reshape(-1, LANES, lanes.shape[1]).swapaxes(1, 2)),
        centre=centre,
        turned=turned,
        component=component,
        key=key,
        sphere=sphere,
        facets=facets_of(
            [None if sides else mesh for sides, mesh in zip(np.diff(grains.first_side), packed.meshes, strict=True)],
            grains.first_facet.tolist(),
        ),
    )


def _found(grains: X.Grains, place: Place) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return centre (n, 3) [R], tile (n, 3) and sphere (n,) of each grain that stands; None if they are too many or
    none."""
    radius, side, centres = float(grains.radius[0]), grains.cells[0].side, grains.centres[0]
    low, high = (v / radius for v in _extent(place))
    if (high - low).prod() * len(centres) > 4.0 * MOST * side**3:  # with room for grains that do not stand
        return None
    room, tiles, spheres, found = Handle(place.room), [], [], []
    every = [range(math.floor(a), math.floor(b) + 1) for a, b in zip(low / side, high / side, strict=True)]
    if math.prod(map(len, every)) > MOST_TILES:
        return None
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
    return (centre, np.concatenate(tiles), sphere) if 0 < len(centre) <= MOST else None


def _hulls(packed: X.Packed, component: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `hulls` knows of each grain (n, ROWS - 4), nothing (n, 0) where it is no help, and the corners (n, 3)
    of boxes about what it fills, relative to its centre."""
    from scipy.spatial.transform import Rotation

    exemplar, count = packed.arrays.exemplar, len(component)
    ball = np.eye(3) / (1.0 + MARGIN), np.zeros(3)
    found = [ball if e == X.EXACT_SPHERE else ellipsoid_of(packed.meshes[e].reshape(-1, 3)) for e in exemplar]
    found = [one if shadow(one[0]) < WORTH else ball for one in found]
    if all(one is ball for one in found):
        return np.zeros((count, 0)), np.full((count, 3), -1.0), np.full((count, 3), 1.0)
    matrix, offset = (np.array([one[k] for one in found])[component] for k in range(2))
    turn = Rotation.from_quat(turned).as_matrix()
    low, high = reach_of(matrix, offset, turn)
    return rows_of(matrix, offset, turn), np.maximum(low, -1.0), np.minimum(high, 1.0)


def _extent(place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box about the only medium of a scene [unit]."""
    kind, shape, boundary = place.arrays.kind[0], place.arrays.shape[0], place.boundaries[0]
    if boundary is not None:
        return boundary.vertices.min(axis=0), boundary.vertices.max(axis=0)
    if kind == BALL:
        return shape[:3] - shape[3], shape[:3] + shape[3]
    return shape[:3], shape[3:]
