"""Light in a lone box: many walkers at once, in lanes, step by step together.

Where nothing is in a scene but one medium in a box or a slab, `transport.wander` is what nearly all walkers do, and what
keeps a processor waiting is that each of their steps needs the one before it and ends in a branch that nobody can guess.
Here the walkers of some hundred samples lie in lanes, one number of all of them after the other, and take each step
together, so that the compiler works out several at once: a flight, a grain, the jump to where light leaves it. Those
that are out have found their light, and the next samples take their lanes.

A sample's random numbers, and what is done with them, are those of `transport`, in the same order; a reader may hold
`fly` against the first half of `wander` and `land` against its second. What is rare is handed over as it stands, and
goes on as a walker of `transport`.
"""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from tsdf.compiled import njit
from tsdf.data.sampler import leave
from tsdf.sampling import GOLDEN, key_of, mix, unit
from tsdf.vectors import KERNEL, dot, renewed, step
from tsdf.walk.grid import GRAZING
from tsdf.walk.lights import radiance as light_from
from tsdf.walk.room import BOX, SLAB
from tsdf.walk.transport import HAIR, deflection
from tsdf.walk.walker import EVENTS, FLY, PATIENCE, UNKNOWN, absorbed, copy, halves, write
from tsdf.walk.geometry import NONE

WIDTH = 128  # lanes that walk; as many more hold samples that are about to
STRIDE = 2 * WIDTH + 8  # of one number of all lanes: no power of two, or all would want one line of the cache
STEPS = 4096  # of all lanes together, before others have their turn

# Numbers of a lane: those that go with its walker first, then those of one step
PX, PY, PZ, DX, DY, DZ, PDF, FREE, BOUND, LUCK, WEIGHT, COSINE, TURN, R, Z, PHI, SCALE, LENGTH = range(18)
KEPT, NUMBERS = 11, 18
KEY, SAMPLE, MET, ONCE, STATE = range(5)  # words of a lane
WORDS = 5
WALKS, LIGHT, LOST = range(3)  # what a lane's STATE says: it goes on, has found light, or is handed over
LIVE, NEXT, READY, HANDED = range(4)  # of `Lanes.counts`


class Lanes(NamedTuple):
    """Walkers in lanes.

    numbers (NUMBERS * STRIDE,), words (WORDS * STRIDE,) uint64, amounts (2 WIDTH, a): of the lanes that walk, from 0
    on, and from WIDTH on of those that are about to; gone, ready (WIDTH,): lanes whose walk has ended, and that can be
    taken; counts (4,): lanes that walk, the next sample, how many are ready, walkers handed over.
    """

    numbers: np.ndarray
    words: np.ndarray
    amounts: np.ndarray
    gone: np.ndarray
    ready: np.ndarray
    counts: np.ndarray


def lanes_of(amounts: int) -> Lanes:
    """Return lanes without walkers, for so many amounts."""
    return Lanes(
        np.zeros(NUMBERS * STRIDE), np.zeros(WORDS * STRIDE, np.uint64), np.zeros((2 * WIDTH, amounts)),
        np.zeros(WIDTH, np.int64), np.zeros(WIDTH, np.int64), np.zeros(4, np.int64),
    )  # fmt: skip


# ------------------------------------------------------------------------------------------- arithmetic


@intrinsic
def _bits(typing, x):
    """Return the bits of a float64 as a whole number."""
    return types.int64(types.float64), lambda c, builder, s, args: builder.bitcast(args[0], ir.IntType(64))


@intrinsic
def _float(typing, x):
    """Return the float64 of these bits."""
    return types.float64(types.int64), lambda c, builder, s, args: builder.bitcast(args[0], ir.DoubleType())


@njit(forceinline=True, **KERNEL)
def logarithm(x):
    """Return the natural logarithm of x > 0 to some ulps, by the series of the inverse hyperbolic tangent."""
    bits = _bits(x)
    exponent = (bits >> 52) - 1023
    m = _float((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
    large = m > math.sqrt(2.0)
    m = 0.5 * m if large else m
    e = float(exponent) + (1.0 if large else 0.0)
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    q2 = q * q
    q4 = q2 * q2
    low = (1.0 / 3 + q * (1.0 / 5)) + q2 * (1.0 / 7 + q * (1.0 / 9))
    high = (1.0 / 11 + q * (1.0 / 13)) + q2 * (1.0 / 15 + q * (1.0 / 17)) + q4 * (1.0 / 19 + q * (1.0 / 21))
    return e * math.log(2.0) + 2.0 * (s + s * q * (low + q4 * high))


@njit(forceinline=True, **KERNEL)
def at(field, i):
    """Return where a number or a word of lane i is."""
    return np.uint64(field * STRIDE) + np.uint64(i)


@njit(forceinline=True, **KERNEL)
def three(numbers, field, i):
    """Return a triple of lane i."""
    return numbers[at(field, i)], numbers[at(field + 1, i)], numbers[at(field + 2, i)]


@njit(forceinline=True, **KERNEL)
def put(numbers, field, i, v):
    """Write a triple of lane i."""
    numbers[at(field, i)], numbers[at(field + 1, i)], numbers[at(field + 2, i)] = v


@njit(forceinline=True, **KERNEL)
def sides(g):
    """Return the lowest and highest coordinates of the medium, infinite along a slab."""
    s, wide = g.shape, g.kind[0] == SLAB
    return (
        (-math.inf if wide else s[0, 0], -math.inf if wide else s[0, 1], s[0, 2]),
        (math.inf if wide else s[0, 3], math.inf if wide else s[0, 4], s[0, 5]),
    )


@njit(forceinline=True, **KERNEL)
def depth(low, high, p):
    """Return how far p is inside of its sides, as `room.exact_depth`."""
    z = min(p[2] - low[2], high[2] - p[2])
    return min(z, min(min(p[0] - low[0], high[0] - p[0]), min(p[1] - low[1], high[1] - p[1])))


@njit(forceinline=True, **KERNEL)
def between(low, high, at, d):
    """Return where a ray is between two planes, as `geometry._between`."""
    low, high = low - at, high - at
    begins = low < 0.0 < high
    each = 1.0 / d
    a, b = low * each, high * each
    near, far = min(a, b), max(a, b)
    still = d == 0.0
    near = (-math.inf if begins else math.inf) if still else near
    far = (math.inf if begins else -math.inf) if still else far
    return near, far


@njit(forceinline=True, **KERNEL)
def way_in(low, high, p, d):
    """Return where a ray from outside comes in, infinite if nowhere, and the part of d across the side where it does;
    as `geometry.exact_hit`."""
    near, far = between(low[2], high[2], p[2], d[2])
    a, b = between(low[1], high[1], p[1], d[1])
    along = d[1] if a >= near else d[2]
    near, far = a if a >= near else near, b if b <= far else far
    a, b = between(low[0], high[0], p[0], d[0])
    along = d[0] if a >= near else along
    near, far = a if a >= near else near, b if b <= far else far
    return near if 0.0 <= near <= far else math.inf, along


@njit(forceinline=True, **KERNEL)
def way_out(low, high, p, e, d):
    """Return where a ray from inside along e goes out, the part of e across the side where it does, and how far d
    points outward there; as `geometry.exact_hit`."""
    _, t = between(low[2], high[2], p[2], e[2])
    _, b = between(low[1], high[1], p[1], e[1])
    along, outward = e[1] if b <= t else e[2], d[1] if b <= t else d[2]
    t = b if b <= t else t
    _, b = between(low[0], high[0], p[0], e[0])
    along, outward = e[0] if b <= t else along, d[0] if b <= t else outward
    t = b if b <= t else t
    return t, along, outward if along > 0.0 else -outward


# ------------------------------------------------------------------------------------------- from the camera


@njit(**KERNEL)
def begin(lanes, job, first, count):
    """Have the samples first .. first + count - 1 of a job ready behind the lanes that walk; see `transport.spawn`."""
    numbers, words, camera = lanes.numbers, lanes.words, job.camera
    pixel, number = job.pixel + first // job.spp, job.sample + first % job.spp
    last = job.sample + job.spp
    x, y = pixel % camera.width, pixel // camera.width
    for i in range(WIDTH, WIDTH + count):
        words[at(KEY, i)], words[at(MET, i)] = np.uint64(pixel), np.uint64(number)
        numbers[at(PX, i)], numbers[at(PY, i)] = float(x), float(y)
        words[at(SAMPLE, i)] = np.uint64(first + i - WIDTH)
        number += 1
        if number == last:
            number, pixel, x = job.sample, pixel + 1, x + 1
            if x == camera.width:
                x, y = 0, y + 1
    seed = job.seed
    corner, right, down = camera.corner, camera.right, camera.down
    origin, aside, below = camera.origin, camera.aside, camera.below
    corner, right, down = (corner[0], corner[1], corner[2]), (right[0], right[1], right[2]), (down[0], down[1], down[2])
    origin, aside = (origin[0], origin[1], origin[2]), (aside[0], aside[1], aside[2])
    below = (below[0], below[1], below[2])
    for i in range(WIDTH, WIDTH + count):
        key = key_of(seed, words[at(KEY, i)], words[at(MET, i)]) + GOLDEN
        u0, u1 = halves(mix(key))
        words[at(KEY, i)] = key
        x, y = numbers[at(PX, i)] + u0, numbers[at(PY, i)] + u1
        d = step(step(corner, x, right), y, down)
        size = 1.0 / math.sqrt(dot(d, d))
        put(numbers, PX, i, step(step(origin, x, aside), y, below))
        put(numbers, DX, i, (d[0] * size, d[1] * size, d[2] * size))


@njit(**KERNEL)
def arrive(g, lanes, count):
    """Bring the samples that are ready to where they come inside, or let them find light; see `transport.fly`."""
    numbers, words, slack = lanes.numbers, lanes.words, g.slack[0]
    low, high = sides(g)
    for i in range(WIDTH, WIDTH + count):
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        near, along = way_in(low, high, p, d)
        inside, met = depth(low, high, p) > 0.0, near < math.inf
        move = 0.0 if inside else (near + slack * min(1.0 / abs(along), GRAZING) if met else 0.0)
        p = step(p, move, d)
        put(numbers, PX, i, p)
        numbers[at(PDF, i)], numbers[at(FREE, i)] = -1.0, -1.0
        numbers[at(BOUND, i)] = depth(low, high, p)
        numbers[at(LUCK, i)], numbers[at(WEIGHT, i)] = 0.0, 1.0
        words[at(MET, i)] = np.uint64(0) if inside else np.uint64(1)
        words[at(ONCE, i)] = np.uint64(1) if inside else np.uint64(0)
        words[at(STATE, i)] = np.uint64(WALKS) if inside or met else np.uint64(LIGHT)


# ------------------------------------------------------------------------------------------- steps


@njit(**KERNEL)
def fly(g, media, lanes, first, last):
    """Take the lanes first .. last - 1 along a free path, to a grain or out."""
    numbers, words, mean, hair = lanes.numbers, lanes.words, media.free[0], HAIR * g.slack[0]
    low, high = sides(g)
    most = np.uint64(min(PATIENCE, media.limit) - 1)
    for i in range(first, last):
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        free, bound, key = numbers[at(FREE, i)], numbers[at(BOUND, i)], words[at(KEY, i)]
        drawn = free >= 0.0
        key = key if drawn else key + GOLDEN
        free = free if drawn else -mean * logarithm(1.0 - unit(mix(key)))
        end = step(p, free, d)
        there = depth(low, high, end)
        inside = bound > 0.0
        short = bound <= free
        once = words[at(ONCE, i)] != np.uint64(0)
        out = short and there - hair <= 0.0
        left = (there - hair + free) - free if short else bound - free
        walks = words[at(STATE, i)] == np.uint64(WALKS)
        lost = not inside or words[at(MET, i)] >= most
        state = np.uint64(LOST) if lost else (np.uint64(LIGHT) if out else np.uint64(WALKS))
        stays = lost or out
        words[at(KEY, i)] = key
        words[at(STATE, i)] = state if walks else words[at(STATE, i)]
        put(numbers, PX, i, (p[0] if stays else end[0], p[1] if stays else end[1], p[2] if stays else end[2]))
        numbers[at(FREE, i)] = free if stays else -1.0
        numbers[at(BOUND, i)] = bound if stays else (there if once else left)


@njit(**KERNEL)
def deflect(world, lanes):
    """Let the grain that each lane has come to deflect its light."""
    numbers, words, media = lanes.numbers, lanes.words, world.media
    last = media.kinds[0] - 1
    for i in range(lanes.counts[LIVE]):
        key, c = words[at(KEY, i)], 0
        if last > 0:
            key += GOLDEN
            u = unit(mix(key))
            while c < last and u >= media.choice[c]:
                c += 1
        key += GOLDEN
        u0, u1 = halves(mix(key))
        cosine, pdf, r, z, phi, length, key = deflection(world, c, u0, key)
        words[at(KEY, i)] = key
        numbers[at(COSINE, i)], numbers[at(TURN, i)], numbers[at(PDF, i)] = cosine, u1, pdf
        numbers[at(R, i)], numbers[at(Z, i)], numbers[at(PHI, i)] = r, z, phi
        numbers[at(SCALE, i)] = media.scale[c]


@njit(**KERNEL)
def land(g, lanes):
    """Turn the lanes' directions and let them jump to where they leave their grains, or to the boundary and, from
    there, out or in again; see `transport.land`."""
    numbers, words, hair, slack = lanes.numbers, lanes.words, HAIR * g.slack[0], g.slack[0]
    low, high = sides(g)
    for i in range(lanes.counts[LIVE]):
        p, d, bound, scale = three(numbers, PX, i), three(numbers, DX, i), numbers[at(BOUND, i)], numbers[at(SCALE, i)]
        once = words[at(ONCE, i)] != np.uint64(0)
        d, offset = leave(
            d, numbers[at(COSINE, i)], numbers[at(TURN, i)], numbers[at(R, i)], numbers[at(Z, i)], numbers[at(PHI, i)]
        )
        d = renewed(d)
        square = dot(offset, offset)
        size = scale * math.sqrt(square)
        there = bound - size
        near = there > 0.0 or size == 0.0
        each = 1.0 / math.sqrt(square)
        e = (offset[0] * each, offset[1] * each, offset[2] * each)
        beyond = depth(low, high, step(p, size, e)) - hair
        sure = near or beyond > 0.0
        t, cosine, outward = way_out(low, high, p, e, d)
        leaves = t < size and not sure
        out = leaves and outward > 0.0
        move = slack * min(1.0 / abs(cosine), GRAZING)
        goes = t + (move if out else -min(move, 0.5 * t)) if leaves else size
        q, end = step(p, scale, offset), step(p, goes, e)
        p = (q[0] if near else end[0], q[1] if near else end[1], q[2] if near else end[2])
        put(numbers, PX, i, p)
        put(numbers, DX, i, d)
        kept = sure and not once
        numbers[at(BOUND, i)] = (there if near else beyond) if kept else depth(low, high, p)
        words[at(MET, i)] += np.uint64(1)
        words[at(ONCE, i)] = np.uint64(leaves)
        words[at(STATE, i)] = np.uint64(LIGHT) if out else np.uint64(WALKS)


# ------------------------------------------------------------------------------------------- coming and going


@njit(**KERNEL)
def settle(world, batch, lanes, i):
    """Let a lane that walks no more find its light, or hand its walker over."""
    numbers, words = lanes.numbers, lanes.words
    d, sample, amounts = three(numbers, DX, i), np.int64(words[at(SAMPLE, i)]), lanes.amounts[i]
    if words[at(STATE, i)] == np.uint64(LIGHT):
        light = light_from(world.lights, d, numbers[at(PDF, i)])
        left = absorbed(world.absorption, amounts, batch.spectrum)
        for k in range(3):
            batch.radiance[sample, k] += numbers[at(WEIGHT, i)] * light[k] * left[k]
        return
    w = batch.walkers[lanes.counts[HANDED]]
    copy(batch.amounts[lanes.counts[HANDED]], amounts)
    lanes.counts[HANDED] += 1
    write(w.p, three(numbers, PX, i))
    write(w.d, d)
    for k in range(3):
        w.colour[k] = 1.0
    w.weight, w.luck, w.pdf = numbers[at(WEIGHT, i)], numbers[at(LUCK, i)], numbers[at(PDF, i)]
    w.free, w.skip, w.key, w.events = numbers[at(FREE, i)], 0.0, words[at(KEY, i)], np.int64(words[at(MET, i)])
    w.sample, w.ray, w.medium, w.mode = sample, NONE, 0, FLY
    w.tries, w.shadow, w.single, w.left = 0, 0, 0, 0


@njit(**KERNEL)
def move(lanes, i, j):
    """Write the walker of lane i to lane j."""
    for field in range(KEPT):
        lanes.numbers[at(field, j)] = lanes.numbers[at(field, i)]
    for field in range(WORDS):
        lanes.words[at(field, j)] = lanes.words[at(field, i)]
    copy(lanes.amounts[j], lanes.amounts[i])


@njit(**KERNEL)
def welcome(world, batch, lanes, job, count):
    """Make the next samples ready, so many, as far as they come to a grain."""
    begin(lanes, job, lanes.counts[NEXT], count)
    lanes.counts[NEXT] += count
    arrive(world.geometry, lanes, count)
    fly(world.geometry, world.media, lanes, WIDTH, WIDTH + count)
    ready = 0
    for i in range(WIDTH, WIDTH + count):
        lanes.ready[ready] = i
        walks = lanes.words[at(STATE, i)] == np.uint64(WALKS)
        ready += walks
        if not walks:
            settle(world, batch, lanes, i)
    lanes.counts[READY] = ready


@njit(**KERNEL)
def relieve(world, batch, lanes, job, total):
    """Settle the lanes that walk no more and let others have their place."""
    counts, gone = lanes.counts, 0
    for i in range(counts[LIVE]):
        lanes.gone[gone] = i
        gone += lanes.words[at(STATE, i)] != np.uint64(WALKS)
    for k in range(gone):
        settle(world, batch, lanes, lanes.gone[k])
    while gone > 0 or counts[LIVE] < WIDTH:
        if counts[READY] == 0:
            if counts[NEXT] == total:
                break
            welcome(world, batch, lanes, job, min(WIDTH, total - counts[NEXT]))
            continue
        counts[READY] -= 1
        if gone > 0:
            gone -= 1
            to = lanes.gone[gone]
        else:
            to = counts[LIVE]
            counts[LIVE] += 1
        move(lanes, lanes.ready[counts[READY]], to)
    while gone > 0:
        gone -= 1
        counts[LIVE] -= 1
        if lanes.gone[gone] < counts[LIVE]:
            move(lanes, counts[LIVE], lanes.gone[gone])


@njit(**KERNEL)
def walk(world, batch, lanes, job, total):
    """Walk the samples of a job, `total` of them, until all have found light, or so many steps have been taken or so
    many walkers handed over that others must have their turn."""
    counts = lanes.counts
    counts[HANDED] = 0
    for _ in range(STEPS):
        fly(world.geometry, world.media, lanes, 0, counts[LIVE])
        relieve(world, batch, lanes, job, total)
        if counts[LIVE] == 0 or 4 * counts[HANDED] > batch.walkers.shape[0]:
            break
        deflect(world, lanes)
        land(world.geometry, lanes)
        batch.counters[EVENTS] += counts[LIVE]
