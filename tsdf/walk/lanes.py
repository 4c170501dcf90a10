"""Light in a lone box or ball: many walkers at once, in lanes, step by step together.

Where nothing is in a scene but one medium in a box, a slab or a ball, `transport.wander` is what nearly all walkers do,
and a processor waits: each of their steps needs the one before it and ends in a branch that nobody guesses. Here
walkers lie in lanes, each number of all of them side by side, and take a step together, so that the compiler works out
several at once: a flight, a grain, the jump to where light leaves it. Those that are out find their light, and the next
samples take their lanes. A sample's random numbers, and what is done with them, are those of `transport`, in the same
order: a reader may hold `fly` against the first half of `wander` and `land` against its second. Of loops without
branches the compiler works out several turns at once. What is rare is handed over as it stands, to go on alone.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.data.sampler import leave
from tsdf.sampling import GOLDEN, key_of, mix, unit
from tsdf.vectors import KERNEL, dot, renewed, step, triple
from tsdf.walk import walker as W
from tsdf.walk.geometry import NONE, Geometry
from tsdf.walk.grid import GRAZING
from tsdf.walk.leaps import ENDS, LEAPT_ON, NEVER, ROOM, leap, missing, patience
from tsdf.walk.lights import radiance as light_from
from tsdf.walk.room import BALL, BOX, SLAB
from tsdf.walk.sides import HAIR, body_of, depth, landing, logarithm, sides, way_in, way_out
from tsdf.walk.transport import aimed, carried, deflected, pixel_of, words_of
from tsdf.walk.walker import Media, absorbed, copy, halves, lives, power, write

WIDTH = 128  # lanes that walk; as many more hold samples that are about to
STRIDE = 2 * WIDTH + 8  # of one number of all lanes: no power of two, or all would want one line of the cache
STEPS = 4096  # of all lanes together, before others have their turn

# Numbers of a lane: those that go with its walker; those of a step; and those of light that is aimed into it
PX, PY, PZ, DX, DY, DZ, PDF, FREE, BOUND, LUCK, WEIGHT, WAITS = range(12)
WAY, COSINE, TURN, R, Z, PHI, LENGTH, BACK, TX, TY, TZ, RED, GREEN, BLUE = range(12, 26)
KEPT, NUMBERS = 12, 26
KEY, SAMPLE, MET, ONCE, STATE, KIND, AIMED, ONE, TWO, BITS, MORE = range(11)  # words of a lane, so too
WORDS_KEPT, WORDS = 5, 11
WALKS, LIGHT, LOST, DEAD = range(4)  # STATE of a lane: it goes on, finds light, is handed over, or roulette ended it
LIVE, NEXT, READY, HANDED = range(4)  # of `Lanes.counts`


class Lanes(NamedTuple):
    """Walkers in lanes.

    numbers (NUMBERS * STRIDE,), words (WORDS * STRIDE,) uint64, amounts (2 WIDTH + 1, a): of the lanes that walk, from
    0 on, and from WIDTH on of those that are about to, and room for a shadow's amounts. gone, ready, others (WIDTH,):
    lanes whose walk has ended, and of those that are about to, which do walk and which do not. counts (4,): lanes that
    walk, the next sample, how many are ready, walkers handed over. body: what they walk in, see `sides.body_of`.
    ends (samples, 10 + a): of those that find light, where they began, where they came out and which way, weight and
    amounts; no rows where nobody asks.
    """

    numbers: np.ndarray
    words: np.ndarray
    amounts: np.ndarray
    gone: np.ndarray
    ready: np.ndarray
    others: np.ndarray
    counts: np.ndarray
    body: np.ndarray
    ends: np.ndarray


def suited(g: Geometry, media: Media) -> bool:
    """Return whether nothing is in a scene but one medium in a box, slab or ball, at a level that knows no packing."""
    alone = len(g.kind) == 1 and g.kind[0] in (BOX, SLAB, BALL) and len(g.balls) == 0 and not g.engines
    return alone and not media.traits.placed and not media.singles


def lanes_of(g: Geometry, amounts: int, samples: int = 0) -> Lanes:
    """Return lanes without walkers in the first medium, for so many amounts, that keep the ends of so many samples."""
    return Lanes(
        np.zeros(NUMBERS * STRIDE), np.zeros(WORDS * STRIDE, np.uint64), np.zeros((2 * WIDTH + 1, amounts)),
        np.zeros(WIDTH, np.int64), np.zeros(WIDTH, np.int64), np.zeros(WIDTH, np.int64), np.zeros(4, np.int64),
        body_of(g), np.zeros((samples, 10 + amounts)),
    )  # fmt: skip


# ------------------------------------------------------------------------------------------- arithmetic


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
def give(world, batch, sample, amounts, weight, light):
    """Add light to a sample, less what the amounts of matter that it has crossed take; see `walker.find`."""
    left = (1.0, 1.0, 1.0)
    if amounts.shape[0] > 0:
        left = absorbed(world.absorption, amounts, batch.spectrum)
    radiance = batch.radiance
    radiance[sample, 0] += weight * light[0] * left[0]
    radiance[sample, 1] += weight * light[1] * left[1]
    radiance[sample, 2] += weight * light[2] * left[2]


# ------------------------------------------------------------------------------------------- from the camera


@njit(**KERNEL)
def begin(lanes, job, first, count):
    """Have the samples first .. first + count - 1 of a job ready behind the lanes that walk; see `transport.spawn`."""
    numbers, words, camera = lanes.numbers, lanes.words, job.camera
    at_pixel, number = first // job.spp, job.sample + first % job.spp
    pixel, last = pixel_of(job, at_pixel), job.sample + job.spp
    x, y = pixel % camera.width, pixel // camera.width
    for i in range(WIDTH, WIDTH + count):
        words[at(KEY, i)], words[at(MET, i)] = np.uint64(pixel), np.uint64(number)
        numbers[at(PX, i)], numbers[at(PY, i)] = float(x), float(y)
        words[at(SAMPLE, i)] = np.uint64(first + i - WIDTH)
        number += 1
        if number == last and i + 1 < WIDTH + count:
            at_pixel, number = at_pixel + 1, job.sample
            pixel = pixel_of(job, at_pixel)
            x, y = pixel % camera.width, pixel // camera.width
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
    for i in range(WIDTH, WIDTH + count if lanes.ends.shape[0] > 0 else WIDTH):
        own = lanes.ends[words[at(SAMPLE, i)]]
        own[0], own[1], own[2] = three(numbers, PX, i)


@njit(**KERNEL)
def arrive(g, leaps, lanes, count):
    """Bring the samples that are ready to where they come inside, or let them find light; see `transport.fly`."""
    numbers, words, slack = lanes.numbers, lanes.words, g.slack[0]
    body = sides(lanes.body)
    for i in range(WIDTH, WIDTH + count):
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        near, each = way_in(body, p, d)
        inside, met = depth(body, p) > 0.0, near < math.inf
        move = 0.0 if inside else (near + slack * min(abs(each), GRAZING) if met else 0.0)
        p = step(p, move, d)
        put(numbers, PX, i, p)
        numbers[at(PDF, i)], numbers[at(FREE, i)], numbers[at(BOUND, i)] = -1.0, -1.0, depth(body, p)
        numbers[at(LUCK, i)], numbers[at(WEIGHT, i)] = 0.0, 1.0
        words[at(MET, i)], words[at(ONCE, i)] = np.uint64(not inside), np.uint64(inside)
        words[at(STATE, i)] = np.uint64(WALKS) if inside or met else np.uint64(LIGHT)
    for i in range(WIDTH, WIDTH + count):
        for k in range(lanes.amounts.shape[1]):
            lanes.amounts[i, k] = 0.0
    if deep(leaps):
        for i in range(WIDTH, WIDTH + count):
            numbers[at(WAITS, i)] = wait(leaps, words[at(ONCE, i)], numbers[at(BOUND, i)])


@njit(forceinline=True, **KERNEL)
def deep(leaps):
    """Return whether there are any leaps."""
    return leaps.size[0, ROOM] < math.inf


@njit(forceinline=True, **KERNEL)
def wait(leaps, once, bound):
    """Return after how many events a leap is asked for where `transport.wander` begins anew, with so much clearance."""
    return float(NEVER if once != np.uint64(0) else patience(leaps, 0, missing(leaps, 0, bound)))


# ------------------------------------------------------------------------------------------- steps


@njit(**KERNEL)
def fly(world, lanes, first, last):
    """Take the lanes first .. last - 1 along a free path, to a grain or out; see `transport.wander`."""
    g, media, numbers, words = world.geometry, world.media, lanes.numbers, lanes.words
    mean, hair = media.free[0], HAIR * g.slack[0]
    body = sides(lanes.body)
    most = np.uint64((media.limit if deep(world.leaps) else min(W.PATIENCE, media.limit)) - 1)
    for i in range(first, last):
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        free, bound, key = numbers[at(FREE, i)], numbers[at(BOUND, i)], words[at(KEY, i)]
        drawn = free >= 0.0
        key = key if drawn else key + GOLDEN
        free = free if drawn else -mean * logarithm(1.0 - unit(mix(key)))
        end = step(p, free, d)
        there = depth(body, end)
        short = bound <= free
        walks = words[at(STATE, i)] == np.uint64(WALKS)
        lost = not bound > 0.0 or words[at(MET, i)] >= most
        out = short and there - hair <= 0.0
        ends = lost or out
        state = np.uint64(LOST) if lost else (np.uint64(LIGHT) if out else np.uint64(WALKS))
        left = (there - hair + free) - free if short else bound - free
        words[at(KEY, i)] = key
        words[at(STATE, i)] = state if walks else words[at(STATE, i)]
        put(numbers, PX, i, (p[0] if ends else end[0], p[1] if ends else end[1], p[2] if ends else end[2]))
        way = free if not ends else (0.0 if lost else -1.0)
        numbers[at(WAY, i)] = way if walks else 0.0
        numbers[at(FREE, i)] = free if ends else -1.0
        numbers[at(BOUND, i)] = bound if ends else (there if words[at(ONCE, i)] != np.uint64(0) else left)
        numbers[at(WAITS, i)] -= 1.0
    travel = media.travel[0]
    if travel < 0:
        return
    least = world.absorption.least[travel]
    for i in range(first, last):
        way = numbers[at(WAY, i)]
        if way < 0.0:  # out
            d = three(numbers, DX, i)
            t, each, _ = way_out(body, three(numbers, PX, i), d, d)
            way = t - HAIR * g.slack[0] * min(each, GRAZING)
        lanes.amounts[i, travel] += way
        numbers[at(LUCK, i)] += least * way


@njit(**KERNEL)
def choose(media, lanes):
    """Choose the component of the grain that each lane has come to."""
    words, last = lanes.words, media.kinds[0] - 1
    for i in range(lanes.counts[LIVE] if last > 0 else 0):
        words[at(KEY, i)] += GOLDEN
        u, c = unit(mix(words[at(KEY, i)])), 0
        while c < last and u >= media.choice[c]:
            c += 1
        words[at(KIND, i)] = np.uint64(c)


@njit(**KERNEL)
def deflect(world, lanes):
    """Let the grain that each lane has come to deflect its light."""
    numbers, words, media = lanes.numbers, lanes.words, world.media
    used = words_of(media.traits) * GOLDEN
    for i in range(lanes.counts[LIVE]):
        key = words[at(KEY, i)] + GOLDEN
        numbers[at(COSINE, i)], numbers[at(TURN, i)] = halves(mix(key))
        words[at(BITS, i)], words[at(MORE, i)] = mix(key + GOLDEN), mix(key + GOLDEN + GOLDEN)
        words[at(KEY, i)] = key + used
    for i in range(lanes.counts[LIVE]):
        c = np.int64(words[at(KIND, i)])
        cosine, pdf, r, z, phi, length = deflected(
            world, c, numbers[at(COSINE, i)], words[at(BITS, i)], words[at(MORE, i)]
        )
        numbers[at(COSINE, i)], numbers[at(PDF, i)] = cosine, pdf
        numbers[at(R, i)], numbers[at(Z, i)], numbers[at(PHI, i)] = r, z, phi
        numbers[at(LENGTH, i)] = media.scale[c] * length


@njit(**KERNEL)
def land(world, lanes):
    """Turn the lanes' directions and let them jump to where they leave their grains, or to the boundary and, from
    there, out or in again."""
    g, numbers, words, leaps = world.geometry, lanes.numbers, lanes.words, world.leaps
    slack, scale = g.slack[0], world.media.scale[0]
    body = sides(lanes.body)
    for i in range(lanes.counts[LIVE]):
        p, d = three(numbers, PX, i), three(numbers, DX, i)
        d, offset = leave(
            d, numbers[at(COSINE, i)], numbers[at(TURN, i)], numbers[at(R, i)], numbers[at(Z, i)], numbers[at(PHI, i)]
        )
        d = renewed(d)
        offset = (scale * offset[0], scale * offset[1], scale * offset[2])
        sure, out, p, left, back = landing(body, slack, p, offset, numbers[at(BOUND, i)], d)
        anew = not sure or words[at(ONCE, i)] != np.uint64(0)  # `transport.wander` would begin again
        put(numbers, PX, i, p)
        put(numbers, DX, i, d)
        numbers[at(BOUND, i)] = depth(body, p) if anew else left
        numbers[at(BACK, i)] = back
        numbers[at(WAITS, i)] = -1.0 if anew else numbers[at(WAITS, i)]
        words[at(MET, i)] += np.uint64(1)
        words[at(ONCE, i)] = np.uint64(back > 0.0)
        words[at(STATE, i)] = np.uint64(LIGHT) if out else np.uint64(WALKS)
    for i in range(lanes.counts[LIVE] if deep(leaps) else 0):
        if numbers[at(WAITS, i)] < 0.0:
            numbers[at(WAITS, i)] = wait(leaps, words[at(ONCE, i)], numbers[at(BOUND, i)])


@njit(**KERNEL)
def absorb(world, batch, lanes):
    """Count the matter that light has crossed in grains, and play roulette with what is dim."""
    numbers, words, media = lanes.numbers, lanes.words, world.media
    for i in range(lanes.counts[LIVE]):
        slot = media.slot[np.int64(words[at(KIND, i)])]
        if slot < 0:
            continue
        least, length, back = world.absorption.least[slot], numbers[at(LENGTH, i)], numbers[at(BACK, i)]
        lanes.amounts[i, slot] += length
        luck = numbers[at(LUCK, i)] + least * length
        numbers[at(LUCK, i)] = luck
        if back > 0.0:
            lanes.amounts[i, slot] -= back * length
            numbers[at(LUCK, i)] = luck - least * (back * length)
    for i in range(lanes.counts[LIVE]):
        walks = words[at(ONCE, i)] == np.uint64(0) and words[at(STATE, i)] == np.uint64(WALKS)
        if numbers[at(LUCK, i)] < W.DIM and walks:
            words[at(KEY, i)] += GOLDEN
            w = note(batch, lanes, i)
            if not lives(w, w.key):
                words[at(STATE, i)] = np.uint64(DEAD)
            numbers[at(LUCK, i)], numbers[at(WEIGHT, i)] = w.luck, w.weight


@njit(**KERNEL)
def soars(world, batch, lanes, i):
    """Let a lane leap; return whether it has, and is to fly from there."""
    numbers, words, w = lanes.numbers, lanes.words, note(batch, lanes, i)
    later, bound = leap(world, batch, w, lanes.amounts[i])
    numbers[at(WAITS, i)] = float(later)
    if later == ENDS:
        words[at(STATE, i)] = np.uint64(DEAD)
    if later > LEAPT_ON or later == ENDS:
        return False
    put(numbers, PX, i, triple(w.p))
    put(numbers, DX, i, triple(w.d))
    words[at(KEY, i)], words[at(MET, i)] = w.key, np.uint64(w.events)
    numbers[at(FREE, i)], numbers[at(LUCK, i)], numbers[at(PDF, i)] = w.free, w.luck, w.pdf
    numbers[at(WEIGHT, i)], numbers[at(BOUND, i)] = w.weight, bound
    return True


@njit(**KERNEL)
def soar(world, batch, lanes):
    """Let lanes leap that have come deep enough, see `leaps`; return whether any of them walks no more."""
    numbers, words, gone = lanes.numbers, lanes.words, False
    for i in range(lanes.counts[LIVE]):
        while words[at(STATE, i)] == np.uint64(WALKS) and numbers[at(WAITS, i)] <= 0.0:
            if not soars(world, batch, lanes, i):
                break
            fly(world, lanes, i, i + 1)
        gone |= words[at(STATE, i)] != np.uint64(WALKS)
    return gone


# ------------------------------------------------------------------------------------------- light that is aimed


@njit(**KERNEL)
def connect(world, batch, lanes):
    """Let light arrive from a light and be deflected into each lane's path by its grain; see `transport.connect`."""
    g, media, numbers, words = world.geometry, world.media, lanes.numbers, lanes.words
    mean, body = media.free[0], sides(lanes.body)
    for i in range(lanes.counts[LIVE]):
        bound = numbers[at(BOUND, i)]
        around = max(bound, depth(body, three(numbers, PX, i)))
        numbers[at(BOUND, i)] = around if bound < 8.0 * mean else bound
        lot(numbers, words, i)
    beam(world, lanes)
    shade(g, media, lanes)
    brighten(world, batch, lanes)


@njit(forceinline=True, **KERNEL)
def lot(numbers, words, i):
    """Draw what light that is aimed at a lane needs: as COSINE whether any is, and four words."""
    key = words[at(KEY, i)] + GOLDEN
    words[at(KEY, i)] = key
    numbers[at(COSINE, i)] = unit(mix(key))
    key = mix(key ^ W.OTHER)
    words[at(ONE, i)], words[at(TWO, i)] = key, mix(key + GOLDEN)
    words[at(BITS, i)], words[at(MORE, i)] = mix(key + GOLDEN + GOLDEN), mix(key + GOLDEN + GOLDEN + GOLDEN)


@njit(**KERNEL)
def beam(world, lanes):
    """Draw the light that is aimed at each lane: as AIMED whether there is any."""
    media, numbers, words = world.media, lanes.numbers, lanes.words
    mean, reach = media.free[0], media.reach[0]
    for i in range(lanes.counts[LIVE]):
        c, bound, weight = np.int64(words[at(KIND, i)]), numbers[at(BOUND, i)], 0.0
        share = math.exp((reach - bound) / mean) if reach < bound else 1.0
        if numbers[at(COSINE, i)] < share:
            toward, light, weight, cosine, r, z, phi, length = aimed(
                world, three(numbers, DX, i), c, words[at(ONE, i)], words[at(TWO, i)], words[at(BITS, i)],
                words[at(MORE, i)],
            )  # fmt: skip
            put(numbers, TX, i, toward)
            numbers[at(COSINE, i)], numbers[at(R, i)], numbers[at(Z, i)], numbers[at(PHI, i)] = cosine, r, z, phi
            numbers[at(LENGTH, i)] = media.scale[c] * length
            weight *= numbers[at(WEIGHT, i)] / share
            put(numbers, RED, i, (light[0] * weight, light[1] * weight, light[2] * weight))
        words[at(AIMED, i)] = np.uint64(weight > 0.0)


@njit(**KERNEL)
def brighten(world, batch, lanes):
    """Give samples the light that is aimed and comes through, see `shade`."""
    media, numbers, words = world.media, lanes.numbers, lanes.words
    for i in range(lanes.counts[LIVE]):
        if words[at(AIMED, i)] == np.uint64(0):
            continue
        passed, way = numbers[at(COSINE, i)], numbers[at(WAY, i)]
        if passed < W.FAINT:
            key = words[at(ONE, i)] + (np.uint64(3) + np.uint64(media.traits.jumps)) * GOLDEN
            if unit(mix(key)) * W.FAINT >= passed:
                continue
            passed = W.FAINT
        amounts, slot = lanes.amounts[i], media.slot[np.int64(words[at(KIND, i)])]
        if amounts.shape[0] > 0:
            copy(lanes.amounts[2 * WIDTH], amounts)
            amounts = lanes.amounts[2 * WIDTH]
            if slot >= 0:
                amounts[slot] += numbers[at(LENGTH, i)] * (1.0 - numbers[at(BACK, i)])
            if media.travel[0] >= 0:
                amounts[media.travel[0]] += way
        give(world, batch, words[at(SAMPLE, i)], amounts, passed, three(numbers, RED, i))


@njit(**KERNEL)
def shade(g, media, lanes):
    """Take light that is aimed from where it leaves its grain out of the medium: as COSINE what comes through, as WAY
    what it has flown, as BACK what part of the jump is beyond the boundary; see `transport.fly`."""
    numbers, scale, slack, mean = lanes.numbers, media.scale[0], g.slack[0], media.free[0]
    body = sides(lanes.body)
    for i in range(lanes.counts[LIVE]):
        p, d, toward = three(numbers, PX, i), three(numbers, DX, i), three(numbers, TX, i)
        offset = carried(
            d, toward, numbers[at(COSINE, i)], numbers[at(R, i)], numbers[at(Z, i)], numbers[at(PHI, i)], scale
        )
        _, out, p, _, back = landing(body, slack, p, offset, numbers[at(BOUND, i)], toward)
        t, each, _ = way_out(body, p, toward, toward)
        way = 0.0 if out else t - HAIR * slack * min(each, GRAZING)
        numbers[at(WAY, i)], numbers[at(BACK, i)] = way, back
        numbers[at(COSINE, i)] = power(-way / mean)


# ------------------------------------------------------------------------------------------- coming and going


@njit(**KERNEL)
def note(batch, lanes, i):
    """Return the walker of a lane as `transport` knows it, written where the next is handed over."""
    numbers, words, w = lanes.numbers, lanes.words, batch.walkers[lanes.counts[HANDED]]
    write(w.p, three(numbers, PX, i))
    write(w.d, three(numbers, DX, i))
    for k in range(3):
        w.colour[k] = 1.0
    w.weight, w.luck, w.pdf = numbers[at(WEIGHT, i)], numbers[at(LUCK, i)], numbers[at(PDF, i)]
    w.free, w.skip, w.key, w.events = numbers[at(FREE, i)], 0.0, words[at(KEY, i)], np.int64(words[at(MET, i)])
    w.sample, w.ray, w.medium, w.mode = np.int64(words[at(SAMPLE, i)]), NONE, 0, W.FLY
    w.tries, w.shadow, w.single, w.left = 0, 0, 0, 0
    return w


@njit(**KERNEL)
def settle(world, batch, lanes, i):
    """Let a lane that walks no more find its light, or hand its walker over."""
    numbers, state, amounts = lanes.numbers, lanes.words[at(STATE, i)], lanes.amounts[i]
    if state == np.uint64(LIGHT):
        light = world.lights.constant[0], world.lights.constant[1], world.lights.constant[2]
        if world.lights.environment.shape[0] > 0 or world.lights.sun_chord2.shape[0] > 0:
            light = light_from(world.lights, three(numbers, DX, i), numbers[at(PDF, i)])
        sample = lanes.words[at(SAMPLE, i)]
        give(world, batch, sample, amounts, numbers[at(WEIGHT, i)], light)
        if lanes.ends.shape[0] > 0:
            own, p, d = lanes.ends[sample], three(numbers, PX, i), three(numbers, DX, i)
            t = way_out(sides(lanes.body), p, d, d)[0]  # from its last grain, unless a jump has brought it out
            own[3], own[4], own[5] = step(p, t if 0.0 < t < math.inf else 0.0, d)
            own[6], own[7], own[8] = d
            own[9] = numbers[at(WEIGHT, i)]
            copy(own[10:], amounts)
    elif state == np.uint64(LOST):
        note(batch, lanes, i)
        copy(batch.amounts[lanes.counts[HANDED]], amounts)
        lanes.counts[HANDED] += 1


@njit(**KERNEL)
def move(lanes, i, j):
    """Write the walker of lane i to lane j."""
    for field in range(KEPT):
        lanes.numbers[at(field, j)] = lanes.numbers[at(field, i)]
    for field in range(WORDS_KEPT):
        lanes.words[at(field, j)] = lanes.words[at(field, i)]
    copy(lanes.amounts[j], lanes.amounts[i])


@njit(**KERNEL)
def welcome(world, batch, lanes, job, count):
    """Make the next samples ready, so many, as far as they come to a grain."""
    begin(lanes, job, lanes.counts[NEXT], count)
    lanes.counts[NEXT] += count
    arrive(world.geometry, world.leaps, lanes, count)
    fly(world, lanes, WIDTH, WIDTH + count)
    for k in range(sort(lanes, count)):
        settle(world, batch, lanes, lanes.others[k])


@njit(**KERNEL)
def sort(lanes, count):
    """List which samples that are about to walk do, and which do not; return how many do not."""
    ready, other = 0, 0
    for i in range(WIDTH, WIDTH + count):
        walks = lanes.words[at(STATE, i)] == np.uint64(WALKS)
        lanes.ready[ready] = i
        lanes.others[other] = i
        ready, other = ready + walks, other + (not walks)
    lanes.counts[READY] = ready
    return other


@njit(forceinline=True, **KERNEL)
def crowded(batch, lanes):
    """Return whether so many walkers have been handed over that it is their turn."""
    return 4 * lanes.counts[HANDED] > batch.walkers.shape[0]


@njit(**KERNEL)
def ended(lanes):
    """List the lanes that walk no more; return how many."""
    gone = 0
    for i in range(lanes.counts[LIVE]):
        lanes.gone[gone] = i
        gone += lanes.words[at(STATE, i)] != np.uint64(WALKS)
    return gone


@njit(**KERNEL)
def replace(lanes, gone):
    """Let those that are ready take the places of those that are gone, and others; return how many are still gone."""
    counts = lanes.counts
    while counts[READY] > 0 and (gone > 0 or counts[LIVE] < WIDTH):
        counts[READY] -= 1
        if gone > 0:
            gone -= 1
            to = lanes.gone[gone]
        else:
            to = counts[LIVE]
            counts[LIVE] += 1
        move(lanes, lanes.ready[counts[READY]], to)
    return gone


@njit(**KERNEL)
def close(lanes, gone):
    """Let others have the places of those that are gone, for nobody is ready any more."""
    counts = lanes.counts
    while gone > 0:
        gone -= 1
        counts[LIVE] -= 1
        if lanes.gone[gone] < counts[LIVE]:
            move(lanes, counts[LIVE], lanes.gone[gone])


@njit(**KERNEL)
def relieve(world, batch, lanes, job, total):
    """Settle the lanes that walk no more and let others have their place."""
    counts, gone = lanes.counts, ended(lanes)
    for k in range(gone):
        settle(world, batch, lanes, lanes.gone[k])
    gone = replace(lanes, gone)
    while (gone > 0 or counts[LIVE] < WIDTH) and counts[NEXT] < total and not crowded(batch, lanes):
        welcome(world, batch, lanes, job, min(WIDTH, total - counts[NEXT]))
        gone = replace(lanes, gone)
    close(lanes, gone)


@njit(**KERNEL)
def walk(world, batch, lanes, job, total):
    """Walk the samples of a job, `total` of them, until all have found light, or so many steps have been taken or so
    many walkers handed over that others must have their turn."""
    counts, leaps = lanes.counts, deep(world.leaps)
    counts[HANDED] = 0
    for _ in range(STEPS):
        if crowded(batch, lanes):
            break
        fly(world, lanes, 0, counts[LIVE])
        relieve(world, batch, lanes, job, total)
        while leaps and soar(world, batch, lanes):
            relieve(world, batch, lanes, job, total)
        if counts[LIVE] == 0:
            break
        choose(world.media, lanes)
        if world.lights.sampled:
            connect(world, batch, lanes)
        deflect(world, lanes)
        land(world, lanes)
        if lanes.amounts.shape[1] > 0:
            absorb(world, batch, lanes)
        batch.counters[W.EVENTS] += counts[LIVE]
