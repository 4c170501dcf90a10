"""Light in a lone body whose boundary is a mesh: walkers in lanes, as `lanes` has them in a box.

What they draw, and what grains do with it, are pieces of `lanes`; where a box is left is a formula there, and here is
found along ways through the grid of facets (`ways`), those of all lanes that may come to the boundary together. A
sample's random numbers, and what is done with them, are those of `transport`: a reader may hold `fly` against the first
half of `wander`, `land` against its second and `transport.land`, `shade` against what becomes of a shadow there, and
`enter` against `transport.fly` from outside. What is rare is handed over as it stands, to go on alone.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.data.sampler import leave
from tsdf.sampling import GOLDEN, mix, unit
from tsdf.vectors import KERNEL, dot, renewed, step
from tsdf.walk.geometry import MESH, Geometry
from tsdf.walk.grid import NONE, THICK, free_around, held, plane_hit, slipped
from tsdf.walk.lanes import (
    AIMED,
    BACK,
    BITS,
    BOUND,
    COSINE,
    DX,
    FREE,
    HANDED,
    KEY,
    LIGHT,
    LIVE,
    LOST,
    LUCK,
    MET,
    MORE,
    NEXT,
    ONCE,
    ONE,
    PDF,
    PHI,
    PX,
    STATE,
    STEPS,
    TURN,
    TX,
    WAITS,
    WALKS,
    WAY,
    WEIGHT,
    WIDTH,
    Lanes,
    R,
    Z,
    absorb,
    at,
    beam,
    begin,
    brighten,
    choose,
    close,
    crowded,
    deep,
    deflect,
    ended,
    lanes_of,
    lot,
    put,
    replace,
    settle,
    soars,
    sort,
    three,
    wait,
)
from tsdf.walk.sides import HAIR, logarithm
from tsdf.walk.transport import GRAZING, beyond, carried
from tsdf.walk.walker import EVENTS, FAINT, PATIENCE, Media, power
from tsdf.walk.ways import Ways, lay, meet, ways_of

OUTSIDE = 4  # more of `lanes.STATE`: it is not known to be inside
# ONCE of a lane: the next event is all that is known of; it has jumped to where that is so, or as far as the boundary;
# it has come in, if it did not only meet a corner
ALONE, CROSSED, REACHED, ENTERED = 1, 2, 4, 3
SHORT = 0.25  # [cells] mean free paths below which lanes do not pay
FRESH = -2.0  # FREE of a lane that has not flown since it was found how far it is from all facets


class Crowd(NamedTuple):
    """Lanes, their ways, and lists (2 WIDTH,) of lanes: those that fly, those that one of the ways is of, and of light
    that is aimed, that outside and that inside."""

    lanes: Lanes
    ways: Ways
    flying: np.ndarray
    bound: np.ndarray
    outer: np.ndarray
    inner: np.ndarray


def suited(g: Geometry, media: Media) -> bool:
    """Return whether nothing is in a scene but one medium in a mesh, at a level that knows no packing, in which light
    flies from cell to cell: where it stays in one for long, few lanes look at a time, and wait as each alone would."""
    alone = len(g.kind) == 1 and g.kind[0] == MESH and len(g.balls) == 0 and g.engines == 1
    known = g.grid.closed and g.grid.shape[0] > 0 and len(g.grid.outer) == 0
    far = len(media.free) > 0 and media.free[0] >= SHORT * g.grid.edge
    return alone and known and far and not media.traits.placed and not media.singles


def crowd_of(g: Geometry, amounts: int) -> Crowd:
    """Return lanes without walkers in the first medium, for so many amounts."""
    lists = [np.zeros(2 * WIDTH, np.int64) for _ in range(4)]
    return Crowd(lanes_of(g, amounts), ways_of(2 * WIDTH), *lists)


@njit(forceinline=True, **KERNEL)
def found(grid, facet, p, d):
    """Return where a way meets the plane of its facet, how steeply, its normal and its thickness."""
    t, cosine = plane_hit(grid.facets, facet, p, d)
    n = (grid.facets[facet, 0], grid.facets[facet, 1], grid.facets[facet, 2])
    return t, cosine, n, grid.facets[facet, THICK]


# ------------------------------------------------------------------------------------------- from outside


@njit(**KERNEL)
def enter(world, crowd, count):
    """Take the lanes in `outer`, so many, that are not known to be inside, to where they come inside, or let them find
    light; those that are inside are then in `flying`. Return how many. See `transport.fly`."""
    grid, lanes, ways = world.geometry.grid, crowd.lanes, crowd.ways
    numbers, words, inside = lanes.numbers, lanes.words, 0
    for k in range(count):
        i = crowd.outer[k]
        lay(ways, k, three(numbers, PX, i), three(numbers, DX, i), math.inf)
    meet(grid, ways, count)
    for k in range(count):
        i, facet = crowd.outer[k], ways.facets[k, 0]
        if facet == NONE:
            words[at(STATE, i)] = np.uint64(LIGHT)
            continue
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        t, cosine, _, slack = found(grid, facet, p, d)
        if cosine > 0.0:
            if slipped(grid, ways.facets[k], 0, p, GRAZING * slack):
                words[at(STATE, i)] = np.uint64(LIGHT)
                continue
            numbers[at(BOUND, i)], words[at(ONCE, i)] = 0.0, np.uint64(ALONE)
        else:
            p = step(p, t + beyond(slack, cosine), d)
            put(numbers, PX, i, p)
            words[at(MET, i)] += np.uint64(1)
            numbers[at(BOUND, i)], words[at(ONCE, i)] = free_around(grid, p, 0.0), np.uint64(ENTERED)
        words[at(STATE, i)], numbers[at(FREE, i)] = np.uint64(WALKS), FRESH
        if deep(world.leaps):
            numbers[at(WAITS, i)] = wait(world.leaps, np.uint64(cosine > 0.0), numbers[at(BOUND, i)])
        crowd.flying[inside] = i
        inside += 1
    return inside


@njit(**KERNEL)
def arrive(world, crowd, count):
    """Bring the samples that are ready to where they come inside, or let them find light; return how many do."""
    lanes = crowd.lanes
    numbers, words = lanes.numbers, lanes.words
    for k in range(count):
        i = WIDTH + k
        crowd.outer[k] = i
        numbers[at(PDF, i)], numbers[at(FREE, i)] = -1.0, FRESH
        numbers[at(LUCK, i)], numbers[at(WEIGHT, i)], words[at(MET, i)] = 0.0, 1.0, np.uint64(0)
        for a in range(lanes.amounts.shape[1]):
            lanes.amounts[i, a] = 0.0
    return enter(world, crowd, count)


# ------------------------------------------------------------------------------------------- steps


@njit(**KERNEL)
def start(world, crowd, count):
    """Let the lanes in `flying`, so many, fly until each has come to a grain, found light, or is handed over."""
    lanes, mean = crowd.lanes, world.media.free[0]
    numbers, words = lanes.numbers, lanes.words
    while count > 0:
        for k in range(count):
            i = crowd.flying[k]
            free, key = numbers[at(FREE, i)], words[at(KEY, i)]
            drawn = free >= 0.0
            words[at(AIMED, i)] = np.uint64(free == FRESH)
            words[at(ONCE, i)] = words[at(ONCE, i)] if words[at(ONCE, i)] != np.uint64(REACHED) else np.uint64(0)
            key = key if drawn else key + GOLDEN
            words[at(KEY, i)] = key
            numbers[at(FREE, i)] = free if drawn else -mean * logarithm(1.0 - unit(mix(key)))
        count = enter(world, crowd, fly(world, crowd, count))


@njit(**KERNEL)
def bounded(world, crowd, count):
    """Lay ways along the free paths of those lanes in `flying`, so many, that may meet the boundary; return how
    many."""
    g, lanes, limited = world.geometry, crowd.lanes, 0
    numbers, words, bound = lanes.numbers, lanes.words, crowd.bound
    for k in range(count):
        i = crowd.flying[k]
        bound[limited] = i
        limited += (numbers[at(BOUND, i)] <= numbers[at(FREE, i)]) | (words[at(ONCE, i)] == np.uint64(ENTERED))
    ways = 0
    for k in range(limited):
        i = bound[k]
        p, free = three(numbers, PX, i), numbers[at(FREE, i)]
        once, d = words[at(ONCE, i)], three(numbers, DX, i)
        if words[at(AIMED, i)] == np.uint64(0) and once == np.uint64(0):
            numbers[at(BOUND, i)] = free_around(g.grid, p, free)
            if numbers[at(BOUND, i)] > free:
                continue
        entered = once == np.uint64(ENTERED)
        if not entered and g.convex and held(g.grid, 0, step(p, free, d)):
            continue
        lay(crowd.ways, ways, p, d, math.inf if entered else free)
        bound[ways] = i
        ways += 1
    return ways


@njit(**KERNEL)
def fly(world, crowd, count):
    """Take the lanes in `flying`, so many, that have a free path along it, to a grain or out; those that may come back
    are then in `outer`. Return how many. See `transport.wander` and `transport.fly`."""
    g, media, lanes, ways, outer = world.geometry, world.media, crowd.lanes, crowd.ways, 0
    numbers, words, grid = lanes.numbers, lanes.words, world.geometry.grid
    limited = bounded(world, crowd, count)
    meet(grid, ways, limited)
    most = np.uint64((media.limit if deep(world.leaps) else min(PATIENCE, media.limit)) - 1)
    for k in range(count):
        i = crowd.flying[k]
        lost = words[at(MET, i)] >= most
        words[at(STATE, i)] = np.uint64(LOST) if lost else np.uint64(WALKS)
        numbers[at(WAY, i)] = 0.0 if lost else numbers[at(FREE, i)]
        numbers[at(WAITS, i)] -= 1.0
    for k in range(limited):
        i, facet = crowd.bound[k], ways.facets[k, 0]
        entered = words[at(ONCE, i)] == np.uint64(ENTERED)
        if words[at(STATE, i)] != np.uint64(WALKS) or (facet == NONE and not entered):
            continue
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        t, cosine, _, slack = found(grid, max(facet, 0), p, d)
        if facet == NONE or not cosine > 0.0:  # it has only met a corner, or rounding has brought it outside
            words[at(STATE, i)], numbers[at(WAY, i)] = np.uint64(OUTSIDE), 0.0
            words[at(KEY, i)] -= GOLDEN if entered else np.uint64(0)
            crowd.outer[outer] = i
            outer += 1
            continue
        words[at(ONCE, i)] = np.uint64(0 if entered else words[at(ONCE, i)])
        move = beyond(slack, cosine)
        if numbers[at(FREE, i)] < t - HAIR * move:
            continue
        numbers[at(WAY, i)] = t - HAIR * move
        put(numbers, PX, i, step(p, t + move, d))
        words[at(MET, i)] += np.uint64(1)
        words[at(STATE, i)], numbers[at(FREE, i)] = np.uint64(LIGHT if g.convex else OUTSIDE), -1.0
        crowd.outer[outer] = i
        outer += not g.convex
    for k in range(count):
        i = crowd.flying[k]
        free, walks = numbers[at(FREE, i)], words[at(STATE, i)] == np.uint64(WALKS)
        p = step(three(numbers, PX, i), free if walks else 0.0, three(numbers, DX, i))
        put(numbers, PX, i, p)
        numbers[at(BOUND, i)] -= free
        numbers[at(FREE, i)] = free if words[at(STATE, i)] == np.uint64(LOST) else -1.0
    travel = media.travel[0]
    if travel >= 0:
        least = world.absorption.least[travel]
        for k in range(count):
            i = crowd.flying[k]
            lanes.amounts[i, travel] += numbers[at(WAY, i)]
            numbers[at(LUCK, i)] += least * numbers[at(WAY, i)]
    return outer


@njit(**KERNEL)
def land(world, crowd):
    """Turn the lanes' directions and let them jump to where they leave their grains, or to the boundary and, from
    there, out or in again; return how many go out that may come back, which are then in `outer`."""
    g, grid, lanes, ways = world.geometry, world.geometry.grid, crowd.lanes, crowd.ways
    numbers, words, live, scale = lanes.numbers, lanes.words, crowd.lanes.counts[LIVE], world.media.scale[0]
    for i in range(live):
        d, offset = leave(
            three(numbers, DX, i), numbers[at(COSINE, i)], numbers[at(TURN, i)], numbers[at(R, i)], numbers[at(Z, i)],
            numbers[at(PHI, i)],
        )  # fmt: skip
        put(numbers, DX, i, renewed(d))
        put(numbers, TX, i, offset)
        numbers[at(R, i)] = scale * math.sqrt(dot(offset, offset))
        numbers[at(BACK, i)] = 0.0
        words[at(MET, i)] += np.uint64(1)
    count, limited = 0, 0
    for i in range(live):
        size = numbers[at(R, i)]
        crowd.bound[count] = i
        near = numbers[at(BOUND, i)] <= size
        count += near
        if not near:
            put(numbers, PX, i, step(three(numbers, PX, i), scale, three(numbers, TX, i)))
            numbers[at(BOUND, i)] -= size
    for k in range(count):
        i = crowd.bound[k]
        p, offset, size = three(numbers, PX, i), three(numbers, TX, i), numbers[at(R, i)]
        bound = free_around(grid, p, size)
        end = step(p, scale, offset)
        if bound > size or size == 0.0:
            numbers[at(BOUND, i)] = bound - size
            put(numbers, PX, i, end)
            continue
        each = scale / size
        e = (offset[0] * each, offset[1] * each, offset[2] * each)
        if g.convex and held(grid, 0, end):
            numbers[at(BOUND, i)] = 0.0
            put(numbers, PX, i, step(p, size, e))
            continue
        lay(ways, limited, p, e, size)
        put(numbers, TX, i, e)
        crowd.bound[limited] = i
        limited += 1
    meet(grid, ways, limited)
    outer = 0
    for k in range(limited):
        i, facet = crowd.bound[k], ways.facets[k, 0]
        p, e, size = three(numbers, PX, i), three(numbers, TX, i), numbers[at(R, i)]
        if facet == NONE:
            numbers[at(BOUND, i)] = 0.0
            put(numbers, PX, i, step(p, size, e))
            continue
        state, p, t = leap_out(g, facet, p, e, size, three(numbers, DX, i))
        put(numbers, PX, i, p)
        numbers[at(BACK, i)] = 1.0 - t / size if t < size else 0.0
        words[at(STATE, i)] = np.uint64(state)
        numbers[at(BOUND, i)] = 0.0
        if state == WALKS:
            words[at(ONCE, i)] = np.uint64(CROSSED if t < size else REACHED)
        crowd.outer[outer] = i
        outer += state == OUTSIDE
    for i in range(live):  # `transport.wander` would begin again
        once = words[at(ONCE, i)]
        if once == np.uint64(ALONE) or once == np.uint64(REACHED):
            numbers[at(BOUND, i)], numbers[at(FREE, i)] = free_around(grid, three(numbers, PX, i), 0.0), FRESH
        words[at(ONCE, i)] = once if once == np.uint64(REACHED) else np.uint64(once == np.uint64(CROSSED))
        if deep(world.leaps) and once != np.uint64(0):
            numbers[at(WAITS, i)] = wait(world.leaps, np.uint64(once == np.uint64(CROSSED)), numbers[at(BOUND, i)])
    return outer


@njit(forceinline=True, **KERNEL)
def leap_out(g, facet, p, e, size, q):
    """Return what becomes of a jump from p along e that meets a facet, after which light goes on along q; where it ends
    and how far the boundary is. See `transport.land`."""
    t, cosine, n, slack = found(g.grid, facet, p, e)
    inside = cosine > 0.0
    t = t if inside else 0.0
    if t >= size:
        return WALKS, step(p, size, e), size
    outward = dot(q, n)
    move = beyond(slack, cosine) if inside else 0.0
    move = -min(move, 0.5 * t) if outward < 0.0 else move
    state = LIGHT if outward > 0.0 and g.convex else (OUTSIDE if outward > 0.0 else WALKS)
    return state if inside else OUTSIDE, step(p, t + move, e), t


# ------------------------------------------------------------------------------------------- light that is aimed


@njit(**KERNEL)
def connect(world, batch, crowd):
    """Let light arrive from a light and be deflected into each lane's path by its grain; see `transport.connect`."""
    grid, lanes = world.geometry.grid, crowd.lanes
    numbers, words, mean, reach = lanes.numbers, lanes.words, world.media.free[0], world.media.reach[0]
    for i in range(lanes.counts[LIVE]):
        bound = numbers[at(BOUND, i)]
        if bound < 8.0 * mean:
            numbers[at(BOUND, i)] = max(bound, free_around(grid, three(numbers, PX, i), reach))
        lot(numbers, words, i)
    beam(world, lanes)
    inner, outer = jump(world, crowd)
    shade(world, crowd, inner, outer)
    brighten(world, batch, lanes)


@njit(**KERNEL)
def jump(world, crowd):
    """Take light that is aimed to where it leaves its grain, or to the boundary, and list it as `inner` if it is inside
    there, `outer` if that is not known; return how many. TX holds whither, R where it is; BACK as `lanes.shade`."""
    g, grid, lanes, ways = world.geometry, world.geometry.grid, crowd.lanes, crowd.ways
    numbers, words, scale, limited, inner, outer = lanes.numbers, lanes.words, world.media.scale[0], 0, 0, 0
    used = (np.uint64(2) + np.uint64(world.media.traits.jumps)) * GOLDEN
    for i in range(lanes.counts[LIVE]):
        if words[at(AIMED, i)] == np.uint64(0):
            continue
        p, toward = three(numbers, PX, i), three(numbers, TX, i)
        offset = carried(
            three(numbers, DX, i), toward, numbers[at(COSINE, i)], numbers[at(R, i)], numbers[at(Z, i)],
            numbers[at(PHI, i)], scale,
        )  # fmt: skip
        size, end = math.sqrt(dot(offset, offset)), step(p, 1.0, offset)
        put(numbers, R, i, end)
        numbers[at(COSINE, i)], numbers[at(WAY, i)], numbers[at(BACK, i)] = 1.0, 0.0, 0.0
        words[at(BITS, i)], words[at(MORE, i)] = words[at(ONE, i)] + used, np.uint64(0)
        if size < numbers[at(BOUND, i)] or size == 0.0 or (g.convex and held(grid, 0, end)):
            crowd.inner[inner] = i
            inner += 1
        else:
            each = 1.0 / size
            lay(ways, limited, p, (offset[0] * each, offset[1] * each, offset[2] * each), size)
            crowd.bound[limited] = i
            limited += 1
    meet(grid, ways, limited)
    for k in range(limited):
        i, facet, state = crowd.bound[k], ways.facets[k, 0], WALKS
        if facet != NONE:
            p, end, toward = three(numbers, PX, i), three(numbers, R, i), three(numbers, TX, i)
            offset = step(end, -1.0, p)
            size = math.sqrt(dot(offset, offset))
            each = 1.0 / size
            e = (offset[0] * each, offset[1] * each, offset[2] * each)
            state, end, t = leap_out(g, facet, p, e, size, toward)
            put(numbers, R, i, end)
            numbers[at(BACK, i)] = 1.0 - t * each if t < size else 0.0
        if state == WALKS:
            crowd.inner[inner] = i
            inner += 1
        elif state == OUTSIDE:
            crowd.outer[outer] = i
            outer += 1
    return inner, outer


@njit(**KERNEL)
def shade(world, crowd, inner, outer):
    """Take light that is aimed, in `inner` and `outer`, out of the medium, and through it again where it comes back: as
    COSINE what comes through, as WAY what it has flown. See `transport.fly`."""
    while inner > 0 or outer > 0:
        outer = through(world, crowd, inner, outer)
        inner, outer = back(world, crowd, outer), 0


@njit(**KERNEL)
def through(world, crowd, count, outer):
    """Take light in `inner` out of the medium; what may come back to it joins that in `outer`. Return how many."""
    g, lanes, ways, mean = world.geometry, crowd.lanes, crowd.ways, world.media.free[0]
    numbers, words = lanes.numbers, lanes.words
    for k in range(count):  # farther, it will not survive its roulette
        i = crowd.inner[k]
        last = FAINT * unit(mix(words[at(BITS, i)] + GOLDEN)) + 1e-300
        end = mean * (logarithm(numbers[at(COSINE, i)]) - logarithm(last))
        sure = words[at(MORE, i)] == np.uint64(0)
        lay(ways, k, three(numbers, R, i), three(numbers, TX, i), max(end, 0.0) if sure else math.inf)
    meet(g.grid, ways, count)
    for k in range(count):
        i, facet = crowd.inner[k], ways.facets[k, 0]
        if facet == NONE:
            numbers[at(COSINE, i)] *= float(words[at(MORE, i)])
            continue
        p, toward = three(numbers, R, i), three(numbers, TX, i)
        t, cosine, _, slack = found(g.grid, facet, p, toward)
        if cosine > 0.0:
            move = beyond(slack, cosine)
            way = t - HAIR * move
            passed = numbers[at(COSINE, i)] * power(-way / mean)
            numbers[at(WAY, i)] += way
            put(numbers, R, i, step(p, t + move, toward))
            if passed < FAINT:
                words[at(BITS, i)] += GOLDEN
                passed = 0.0 if unit(mix(words[at(BITS, i)])) * FAINT >= passed else FAINT
            numbers[at(COSINE, i)] = passed
            if g.convex or passed == 0.0:
                continue
        crowd.outer[outer] = i
        outer += 1
    return outer


@njit(**KERNEL)
def back(world, crowd, count):
    """Take light in `outer` away, or to where it comes into the medium again: what does is then in `inner`, as MORE
    that it may only have met a corner. Return how many."""
    grid, lanes, ways, inner = world.geometry.grid, crowd.lanes, crowd.ways, 0
    numbers, words = lanes.numbers, lanes.words
    for k in range(count):
        i = crowd.outer[k]
        lay(ways, k, three(numbers, R, i), three(numbers, TX, i), math.inf)
    meet(grid, ways, count)
    for k in range(count):
        i, facet = crowd.outer[k], ways.facets[k, 0]
        if facet == NONE:
            continue
        p, toward = three(numbers, R, i), three(numbers, TX, i)
        t, cosine, _, slack = found(grid, facet, p, toward)
        if not cosine > 0.0:
            put(numbers, R, i, step(p, t + beyond(slack, cosine), toward))
        words[at(MORE, i)] = np.uint64(1)
        crowd.inner[inner] = i
        inner += 1
    return inner


# ------------------------------------------------------------------------------------------- coming and going


@njit(**KERNEL)
def welcome(world, batch, crowd, job, count):
    """Make the next samples ready, so many, as far as they come to a grain."""
    lanes = crowd.lanes
    begin(lanes, job, lanes.counts[NEXT], count)
    lanes.counts[NEXT] += count
    start(world, crowd, arrive(world, crowd, count))
    for k in range(sort(lanes, count)):
        settle(world, batch, lanes, lanes.others[k])


@njit(**KERNEL)
def relieve(world, batch, crowd, job, total):
    """Settle the lanes that walk no more and let others have their place."""
    lanes = crowd.lanes
    counts, gone = lanes.counts, ended(lanes)
    for k in range(gone):
        settle(world, batch, lanes, lanes.gone[k])
    gone = replace(lanes, gone)
    while (gone > 0 or counts[LIVE] < WIDTH) and counts[NEXT] < total and not crowded(batch, lanes):
        welcome(world, batch, crowd, job, min(WIDTH, total - counts[NEXT]))
        gone = replace(lanes, gone)
    close(lanes, gone)


@njit(**KERNEL)
def soar(world, batch, crowd):
    """Let lanes leap that have come deep enough, see `leaps`; return whether any of them walks no more."""
    lanes, gone, count = crowd.lanes, False, 1
    numbers, words = lanes.numbers, lanes.words
    while count > 0:
        count = 0
        for i in range(lanes.counts[LIVE]):
            waits = words[at(STATE, i)] != np.uint64(WALKS) or numbers[at(WAITS, i)] > 0.0
            if not waits and soars(world, batch, lanes, i):
                crowd.flying[count] = i
                count += 1
        start(world, crowd, count)
    for i in range(lanes.counts[LIVE]):
        gone |= words[at(STATE, i)] != np.uint64(WALKS)
    return gone


@njit(**KERNEL)
def walk(world, batch, crowd, job, total):
    """Walk the samples of a job, `total` of them, as `lanes.walk` does."""
    lanes, leaps = crowd.lanes, deep(world.leaps)
    counts = lanes.counts
    counts[HANDED] = 0
    for _ in range(STEPS):
        if crowded(batch, lanes):
            break
        count = 0
        for i in range(counts[LIVE]):
            crowd.flying[count] = i
            count += lanes.words[at(STATE, i)] == np.uint64(WALKS)
        start(world, crowd, count)
        relieve(world, batch, crowd, job, total)
        while leaps and soar(world, batch, crowd):
            relieve(world, batch, crowd, job, total)
        if counts[LIVE] == 0:
            break
        choose(world.media, lanes)
        if world.lights.sampled:
            connect(world, batch, crowd)
        deflect(world, lanes)
        outer = land(world, crowd)
        if lanes.amounts.shape[1] > 0:
            absorb(world, batch, lanes)
        enter(world, crowd, outer)
        batch.counters[EVENTS] += counts[LIVE]
