"""Teleportation that remembers its packing: a chain from bounding sphere to bounding sphere.

Where light left one sphere decides where it enters the next. `gaps` has the law of that, for one packing fraction
and any grain; a table's records by entry have what the grain does then. Between the two, the only state is the side of
the sphere on which light left it and the impact parameter. The packing goes on for ever and only some of its spheres
hold grains: one that has no room (`room`), or whose grain is missed, is passed straight through, so a flight into a
medium begins in the packing outside it and needs no law of its own. docs/memory.md derives all this.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import fetch, njit
from tsdf.data.sampler import column_of, density, turned
from tsdf.sampling import GOLDEN, mix, unit
from tsdf.vectors import KERNEL, cross, dot, frame, step, triple
from tsdf.walk.geometry import NEAR, NONE, ball_hit, clearance, exact_hit
from tsdf.walk.grid import GRAZING, march, plane_hit
from tsdf.walk.leaps import ENDS, LEAPT_ON, NEVER, leap, missing, patience
from tsdf.walk.lights import draw as draw_light
from tsdf.walk.room import MESH, stands
from tsdf.walk.walker import (
    DIM,
    ENDED,
    EVENTS,
    FAULTS,
    LOOK,
    OTHER,
    PATIENCE,
    TRUNCATED,
    WAIT,
    born,
    cast,
    full,
    halves,
    lives,
    write,
)

STRAIGHT = -2  # in place of a component: light that it did not deflect
FAR = 2.0  # [mean free paths] how much farther than a flight it is looked where walls are near, for those to come
FAULT = -1  # what becomes of a shadow that meets neither grain nor wall
AIMED = 16  # records of each column of cos theta that light aimed at a lamp is drawn from


class Memory(NamedTuple):
    """What kernels ask about packings of media (m,) and grains of components (c,); lengths in R.

    law (m, cells, k, 4) float32: gap, impact parameter, cosine and sine of the azimuth of the next entry, cells being
    equal parts of the squared impact parameter of the exit; records (m,): how many of k; gaps (m, cells k + 1): running
    sum of the gaps, from 0 to 1; fraction (m,): packing fraction; radius (m,): R [unit].

    choice (c,): running sum of the number fractions in each medium; hit (c, columns) float32, columns (c,): hit
    probability by equal parts of the squared impact parameter of the entry; grains (c, columns, k, 8) float32, kept
    (c,): records of the light that met it, in the frame (side of the entry, d x side, d): direction, side of the exit,
    impact parameter of the exit, path length.

    For light that is aimed: aimed (all columns of cos theta, AIMED, 9) float32: records of light deflected so, as in
    `grains`, and the impact parameter of the entry; met (c,): hit probability.
    """

    law: np.ndarray
    records: np.ndarray
    gaps: np.ndarray
    fraction: np.ndarray
    radius: np.ndarray
    choice: np.ndarray
    hit: np.ndarray
    columns: np.ndarray
    grains: np.ndarray
    kept: np.ndarray
    aimed: np.ndarray
    met: np.ndarray


# ------------------------------------------------------------------------------------------- for kernels


@njit(forceinline=True, **KERNEL)
def onward(memory, m, d, t, b, bits):
    """Draw the next sphere that light along d enters, given the side t and the impact parameter b with which it left
    one; return the gap [R], the side on which it is entered, and the impact parameter."""
    cells = memory.law.shape[1]
    cell = min(int(b * b * cells), cells - 1)
    k = int(unit(bits) * memory.records[m])
    record = memory.law[m, cell, k]
    c, s = float(record[2]), float(record[3])
    if bits & np.uint64(1):  # a bit that `unit` does not use: the mirror image is as likely
        s = -s
    up = cross(d, t)
    side = (c * t[0] + s * up[0], c * t[1] + s * up[1], c * t[2] + s * up[2])
    return float(record[0]), side, float(record[1])


@njit(forceinline=True, **KERNEL)
def upright(t, d):
    """Return a nearly unit vector t, nearly perpendicular to the unit vector d, made so: errors do not pile up."""
    t = step(t, -dot(t, d), d)
    half = 1.5 - 0.5 * dot(t, t)
    return t[0] * half, t[1] * half, t[2] * half


@njit(forceinline=True, **KERNEL)
def sent(grain, d, t):
    """Return direction, side, impact parameter and normal with which light leaves a sphere, given a record and the
    direction and side with which it enters it."""
    up = cross(d, t)
    x, y, z = float(grain[0]), float(grain[1]), float(grain[2])
    new = step(step(step((0.0, 0.0, 0.0), x, t), y, up), z, d)
    half = 1.5 - 0.5 * dot(new, new)
    new = (new[0] * half, new[1] * half, new[2] * half)
    x, y, z = float(grain[3]), float(grain[4]), float(grain[5])
    t = upright(step(step(step((0.0, 0.0, 0.0), x, t), y, up), z, d), new)
    b = float(grain[6])
    return new, t, b, step(step((0.0, 0.0, 0.0), b, t), math.sqrt(max(0.0, 1.0 - b * b)), new)


@njit(forceinline=True, **KERNEL)
def component(choice, first, last, u):
    """Return the component that u stands for."""
    c = first
    while c < last and u >= choice[c]:
        c += 1
    return c


@njit(**KERNEL)
def begin(w, memory):
    """Draw the sphere that a walker enters next, of which nothing is known: it starts anywhere in the packing."""
    m, d = w.medium, triple(w.d)
    w.key += GOLDEN
    u0, u1 = halves(mix(w.key))
    w.key += GOLDEN
    u2, u3 = halves(mix(w.key))
    a, c = frame(d)
    co, si = turned(u1)
    t = step(step((0.0, 0.0, 0.0), co, a), si, c)
    if u0 < memory.fraction[m]:  # in a sphere, the oftener the longer its chord
        b2 = 1.0 - u2 ** (2.0 / 3.0)
        w.key += GOLDEN
        gap, t, b = onward(memory, m, d, t, math.sqrt(b2), mix(w.key))
        w.free = memory.radius[m] * (2.0 * u3 * math.sqrt(1.0 - b2) + gap)
    else:  # in a gap, the oftener the longer it is
        sums = memory.gaps[m]
        low, high = 0, sums.shape[0] - 1
        while high - low > 1:
            middle = (low + high) // 2
            if sums[middle] <= u2:
                low = middle
            else:
                high = middle
        cell, k = low // memory.law.shape[2], low % memory.law.shape[2]
        b = float(memory.law[m, cell, k, 1])
        w.free = memory.radius[m] * u3 * float(memory.law[m, cell, k, 0])
    write(w.t, t)
    w.b = b


@njit(forceinline=True, **KERNEL)
def parting(n, d):
    """Return side and impact parameter with which light along d leaves a sphere where the outward normal is n."""
    away = step(n, -dot(n, d), d)
    b = math.sqrt(dot(away, away))
    t = (away[0] / b, away[1] / b, away[2] / b) if b > 1e-9 else frame(d)[0]
    return t, min(b, 1.0)


@njit(**KERNEL)
def emerge(w, memory, n):
    """Draw the sphere that a walker enters next, which has just left one where the outward normal is n."""
    m, d = w.medium, triple(w.d)
    t, b = parting(n, d)
    w.key += GOLDEN
    gap, t, w.b = onward(memory, m, d, t, b, mix(w.key))
    write(w.t, t)
    w.free = memory.radius[m] * gap


@njit(**KERNEL)
def way_ahead(g, met, m, p, d, free, far):
    """Return how far along d from p of medium m there is surely neither its boundary nor a surface, `far` at most, and
    whether `met` (meshes,) says which facets are met first. It is below `free` only where that is so."""
    if g.kind[m] != MESH:
        t, inside, _ = exact_hit(g.kind[m], g.shape[m], p, d)
        far = min(far, t - GRAZING * g.slack[m]) if inside else 0.0
    if g.balls.shape[0] > 0:
        t, ball = ball_hit(g.balls, p, d)
        far = min(far, (t - NEAR * g.balls[ball, 3]) / (1.0 + NEAR))
    if far <= free or g.engines == 0:
        return far, False
    if not march(g.grid, met, m, p, d, far):
        far = free
        if not march(g.grid, met, m, p, d, far):
            return 0.0, False
        far = math.nextafter(far, math.inf)
    for e in range(met.shape[0]):
        if met[e] != NONE:
            far = min(far, plane_hit(g.grid.facets, met[e], p, d)[0] - g.grid.margin)
    return far, True


@njit(**KERNEL)
def holds(world, m, centre, sure):
    """Return whether a sphere of medium m at `centre` holds a grain, and a length within which nothing is around it;
    `sure` says that what is clear of everything is."""
    bound = clearance(world.geometry, m, centre) if sure else 0.0
    return bound >= world.memory.radius[m] or stands(world.room, m, centre), bound


@njit(**KERNEL)
def darkened(world, m, p, d, side, key, bound):
    """Return whether a shadow meets a grain in the sphere that it enters at p, with `side` = (t, b), and the key that
    is used up; nothing is nearer to p than `bound`."""
    media, memory, (t, b) = world.media, world.memory, side
    first, last = media.first[m], media.first[m] + media.kinds[m] - 1
    c = first
    if last > first:
        key += GOLDEN
        c = component(memory.choice, first, last, unit(mix(key)))
    key += GOLDEN
    if unit(mix(key)) >= memory.hit[c, min(int(b * b * memory.columns[c]), memory.columns[c] - 1)]:
        return False, key
    radius, sure = memory.radius[m], world.room.whole[m] or world.room.kind[m] != MESH
    if sure and bound > 2.0 * radius:
        return True, key
    centre = step(step(p, radius * math.sqrt(max(0.0, 1.0 - b * b)), d), -radius * b, t)
    return holds(world, m, centre, sure)[0], key


@njit(**KERNEL)
def shaded(world, met, m, way, side, free, key, bound):
    """Take a shadow from sphere to sphere, straight on, while its way can meet nothing else.

    Parameters
    ----------
    met : (meshes,) int32
        For what `way_ahead` says.
    way, side : tuples
        Where it is and whither, (p, d), and the side and impact parameter with which it enters the next sphere, (t, b).
    free, bound : float
        How far that is, and a length within which nothing else is.

    Returns
    -------
    state : int
        LOOK, ENDED where it has met a grain, FAULT where it has gone on for ever.
    p, t, b, free, key
        Where it has got.
    known : bool
        Whether `met` says what it meets then.
    """
    (p, d), (t, b), radius, ahead = way, side, world.memory.radius[m], 0.0
    for _ in range(PATIENCE):
        if max(bound, ahead) <= free:
            ahead, known = way_ahead(world.geometry, met, m, p, d, free, free + FAR * world.media.free[m])
            if ahead <= free:
                return LOOK, p, t, b, free, key, known
        p = step(p, free, d)
        bound -= free
        ahead -= free
        dark, key = darkened(world, m, p, d, (t, b), key, bound)
        if dark:
            return ENDED, p, t, b, free, key, False
        key += GOLDEN
        through = 2.0 * math.sqrt(max(0.0, 1.0 - b * b))
        gap, t, b = onward(world.memory, m, d, t, b, mix(key))
        free = radius * (through + gap)
    return FAULT, p, t, b, free, key, False


@njit(**KERNEL)
def shade(world, batch, w, once):
    """Take a shadow in a known medium as `roam` does other walkers; it ends at the first grain that it meets."""
    m, memory, spot = w.medium, world.memory, batch.hits.shape[0] - 1
    if w.free < 0.0:
        begin(w, memory)
    p, d, t, b = triple(w.p), triple(w.d), triple(w.t), w.b
    if once:
        p = step(p, w.free, d)
        dark, key = darkened(world, m, p, d, (t, b), w.key, 0.0)
        if dark:
            return ENDED
        key += GOLDEN
        through = 2.0 * math.sqrt(max(0.0, 1.0 - b * b))
        gap, t, b = onward(memory, m, d, t, b, mix(key))
        free = memory.radius[m] * (through + gap)
    else:
        bound = clearance(world.geometry, m, p)
        state, p, t, b, free, key, known = shaded(world, batch.hits[spot], m, (p, d), (t, b), w.free, w.key, bound)
        if state == ENDED:
            return ENDED
        if state == FAULT:  # no grain stands where it has got: out of bounds
            batch.counters[FAULTS] += 1
            w.weight = 0.0
            return ENDED
        w.ray = spot if known else NONE
    write(w.p, p)
    write(w.t, t)
    w.b, w.key, w.free = b, key, free
    return LOOK


@njit(forceinline=True, **KERNEL)
def connect(world, batch, w, amounts, p, c, share, bound):
    """Send off light that arrives from a light and is deflected into the walker's path by a grain.

    A bounding sphere with a grain of component c of its medium is entered at p by the walker, whose key is for this;
    whichever sphere it is, for the side on which it is entered is drawn anew. `share` is the probability that this is
    done at all; nothing is nearer than `bound`.
    """
    media, memory, tables = world.media, world.memory, world.tables
    m, d = w.medium, triple(w.d)
    key = mix(w.key ^ OTHER)
    u0, u1 = halves(key)
    key += GOLDEN
    u2, u3 = halves(mix(key))
    toward, light_pdf, light = draw_light(world.lights, u0, u1, u2)
    if not light_pdf > 0.0:
        return
    cosine = min(max(dot(d, toward), -1.0), 1.0)
    column = column_of(tables, c, cosine)
    phase = memory.met[c] * density(tables, column)
    if not phase > 0.0:
        return
    # Where grains send less this way than to all sides alike, it is seldom looked whether it arrives, and counts more
    brings = min(1.0, 4.0 * math.pi * phase * light_pdf / (light_pdf + phase))
    u3 *= AIMED
    if u3 - math.floor(u3) >= brings:
        return
    grain = memory.aimed[column, int(u3)]
    b = float(grain[8])
    # The side of the entry is the one from which the record's light goes toward the lamp
    side = step(toward, -cosine, d)
    size = math.sqrt(dot(side, side))
    if size > 1e-12:
        side = (side[0] / size, side[1] / size, side[2] / size)
    else:
        side = frame(d)[0]
    x, y = float(grain[0]), float(grain[1])
    size = math.sqrt(x * x + y * y)
    x, y = (x / size, y / size) if size > 1e-12 else (1.0, 0.0)
    t = upright(step(step((0.0, 0.0, 0.0), x, side), -y, cross(d, side)), d)
    radius = memory.radius[m]
    along = math.sqrt(max(0.0, 1.0 - b * b))
    centre = step(step(p, radius * along, d), -radius * b, t)
    sure = world.room.whole[m] or world.room.kind[m] != MESH  # what is clear of everything is on the side on which p is
    left = bound - 2.0 * radius
    if not sure or left <= 0.0:
        there, around = holds(world, m, centre, sure)
        if not there:
            return
        left = around - radius
    up = cross(d, t)
    b_out = float(grain[6])
    along = math.sqrt(max(0.0, 1.0 - b_out * b_out))
    nx, ny = b_out * grain[3] + along * grain[0], b_out * grain[4] + along * grain[1]
    nz = b_out * grain[5] + along * grain[2]
    n = step(step(step((0.0, 0.0, 0.0), nx, t), ny, up), nz, d)
    # From there to where it must look it is a shadow that need not be written down
    spot, out = batch.hits.shape[0] - 1, step(centre, radius, n)
    key += GOLDEN
    gap, t, b = onward(memory, m, toward, *parting(n, toward), mix(key))
    state, at, t, b, free, key, _ = shaded(
        world, batch.hits[spot], m, (out, toward), (t, b), radius * gap, key, max(left, 0.0)
    )
    if state != LOOK:
        batch.counters[FAULTS] += state == FAULT
        return
    number = born(batch, amounts)
    shadow, its_amounts = batch.out[number], batch.out_amounts[number]
    if media.slot[c] >= 0:
        its_amounts[media.slot[c]] += media.scale[c] * float(grain[7])
    cast(w, shadow, at, toward, light, phase / ((light_pdf + phase) * share * brings), m, key)
    write(shadow.t, t)
    shadow.b, shadow.free = b, free


@njit(forceinline=True, **KERNEL)
def drawn(world, pdf, c, cosine):
    """Return the density per steradian with which a direction was drawn: that of a deflection by a grain of component
    c, by an angle of that cosine, or what it was where c is NONE; -1 for none."""
    if c == NONE:
        return pdf
    pdf = 0.0
    if c != STRAIGHT:
        pdf = world.memory.met[c] * density(world.tables, column_of(world.tables, c, cosine))
    return pdf if pdf > 0.0 else -1.0


@njit(**KERNEL)
def roam(world, batch, w, amounts, once):  # noqa: C901 - all that can become of a walker, in one loop
    """Take a walker in a known medium from sphere to sphere while its flights can meet nothing else; as
    `transport.wander`, but that a shadow ends at the first grain it meets. Returns LOOK, WAIT or ENDED."""
    if w.shadow:
        return shade(world, batch, w, once)
    g, room, media, memory = world.geometry, world.room, world.media, world.memory
    m = w.medium
    radius, sampled = memory.radius[m], world.lights.sampled
    first, last = media.first[m], media.first[m] + media.kinds[m] - 1
    mean, sure = media.free[m], room.whole[m] or room.kind[m] != MESH
    bound, ahead, fresh, spot = 0.0 if once else clearance(g, m, triple(w.p)), 0.0, True, batch.hits.shape[0] - 1
    if w.free < 0.0:
        begin(w, memory)
    p, d, t, b, key, free = triple(w.p), triple(w.d), triple(w.t), w.b, w.key, w.free
    luck, steps, met, before, state = w.luck, 0, 0, w.events, LOOK
    bent, cosine = NONE, 0.0  # the last grain that was met here, and by how much it deflected
    again = NEVER if once else patience(world.leaps, m, missing(world.leaps, m, bound))
    while True:
        if not once and max(bound, ahead) <= free:
            if not fresh:
                bound = clearance(g, m, p)
            if bound <= free:
                ahead, known = way_ahead(g, batch.hits[spot], m, p, d, free, free + FAR * mean)
                if ahead <= free:
                    w.ray = spot if known else NONE
                    break
        if steps >= PATIENCE or (sampled and not once and full(batch)):
            state = WAIT
            if steps >= PATIENCE and met == 0 and w.events == before:  # no grain stands where it has got: out of bounds
                batch.counters[FAULTS] += 1
                w.weight, state = 0.0, ENDED
            break
        fresh = False
        steps += 1
        p = step(p, free, d)
        bound -= free
        ahead -= free
        if steps >= again:
            write(w.p, p)
            write(w.d, d)
            write(w.t, t)
            w.b, w.key, w.luck, w.pdf = b, key, luck, drawn(world, w.pdf, bent, cosine)
            bent = NONE
            wait, bound_there = leap(world, batch, w, amounts)
            again = steps + wait
            if wait <= LEAPT_ON:
                p, d, t, b, free = triple(w.p), triple(w.d), triple(w.t), w.b, w.free
                key, luck, bound, ahead = w.key, w.luck, bound_there, 0.0
                if wait == ENDS:
                    state = ENDED
                    break
                if w.events + met >= media.limit:
                    batch.counters[TRUNCATED] += 1
                    state = ENDED
                    break
                continue
        c = first
        if last > first:
            key += GOLDEN
            c = component(memory.choice, first, last, unit(mix(key)))
        column = min(int(b * b * memory.columns[c]), memory.columns[c] - 1)
        key += GOLDEN
        there = unit(mix(key)) < memory.hit[c, column]
        key += GOLDEN
        bits = mix(key)
        number = int(unit(bits) * memory.kept[c])
        if there:  # the record comes while the lights and the room are looked at
            fetch(memory.grains[c, column, number])
        if sampled:
            if bound < 8.0 * mean:
                bound = max(bound, clearance(g, m, p))
            # The root of how likely the shadow is to arrive: it ends at a grain or not at all, and so costs least
            share = math.exp(0.5 * (2.0 * radius - bound) / mean) if 2.0 * radius < bound else 1.0
            key += GOLDEN
            if unit(mix(key)) < share:
                write(w.d, d)
                w.key = key
                connect(world, batch, w, amounts, p, c, share, bound)

        # Is there a grain in this sphere?
        along = math.sqrt(max(0.0, 1.0 - b * b))
        through = 0.0
        centre = step(step(p, radius * along, d), -radius * b, t)
        left = bound - 2.0 * radius
        if there and (left <= 0.0 or not sure):
            there, around = holds(world, m, centre, sure)
            bound, left = max(bound, around - radius), max(left, around - radius)
        if there:
            met += 1
            grain = memory.grains[c, column, number]
            if sampled:
                bent, cosine = c if grain[0] != 0.0 or grain[1] != 0.0 else STRAIGHT, float(grain[2])
            d, t, b, n = sent(grain, d, t)
            p = step(centre, radius, n)
            bound, ahead = left, 0.0
            slot = media.slot[c]
            if slot >= 0:
                length = media.scale[c] * float(grain[7])
                amounts[slot] += length
                luck += world.absorption.least[slot] * length
            key += GOLDEN
            bits = mix(key)
        else:
            through = 2.0 * along
        gap, t, b = onward(memory, m, d, t, b, bits)
        free = radius * (through + gap)
        if luck < DIM:
            w.luck = luck
            key += GOLDEN
            if not lives(w, key):
                state = ENDED
                break
            luck = w.luck
        if w.events + met >= media.limit:
            batch.counters[TRUNCATED] += 1
            state = ENDED
            break
        if once:
            break
    batch.counters[EVENTS] += met
    w.events += met
    write(w.p, p)
    write(w.d, d)
    write(w.t, t)
    w.b, w.key, w.free, w.luck, w.pdf = b, key, free, luck, drawn(world, w.pdf, bent, cosine)
    return state
