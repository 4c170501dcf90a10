"""Packed grains that are not traced but answered from their records: level teleport-packed.

The spheres are those of `explicit`, one by one, so neighbours are right, and light that is sent back finds the grain it
came from. What a grain does is drawn from its table's records by entry, as in `memory`: where it is entered is known
here, not drawn. `transport` brings a walker to a bounding sphere and leaves it there; this takes it from grain to
grain until something else could be met. It is a kernel of its own, compiled by who uses the level and nobody else.
"""

import math

from tsdf.compiled import njit
from tsdf.sampling import GOLDEN, mix, unit
from tsdf.spheres.around import next_around
from tsdf.spheres.packing import next_sphere
from tsdf.vectors import KERNEL, dot, frame, step, triple
from tsdf.walk import explicit as X
from tsdf.walk.geometry import clearance
from tsdf.walk.memory import sent
from tsdf.walk.room import MESH, stands
from tsdf.walk.walker import DIM, EVENTS, FLY, GRAIN, PATIENCE, TRUNCATED, lives, write


@njit(**KERNEL)
def rove(world, batch, w, amounts):
    """Take a walker that meets a bounding sphere from grain to grain while its flights can meet nothing else. It flies
    on, is at the next sphere if others are to have their turn, or ends: then its state is LEFT."""
    g, room, media, memory, grains = world.geometry, world.room, world.media, world.memory, world.grains
    m, d, key = w.medium, triple(w.d), w.key
    centre, c = triple(w.q), w.component
    cells, around = grains.cells[m], grains.around[m]
    radius, sure = grains.radius[m], room.whole[m] or room.kind[m] != MESH
    luck, met, bound, state, mode = w.luck, 0, 0.0, 0, GRAIN
    limit, s, sphere, i, j, k = media.limit - w.events, 0.0, -1, 0, 0, 0
    n = step(triple(w.p), -1.0, centre)
    n = (n[0] / radius, n[1] / radius, n[2] / radius)
    for _ in range(PATIENCE):
        t = step(n, -dot(n, d), d)
        b2 = min(dot(t, t), 1.0)
        column = min(int(b2 * memory.columns[c]), memory.columns[c] - 1)
        hit = memory.hit[c, column]
        there = True
        if hit < 1.0:
            key += GOLDEN
            there = unit(mix(key)) < hit
        if there:
            met += 1
            size = 1.0 / math.sqrt(b2) if b2 > 1e-18 else 0.0
            t = (t[0] * size, t[1] * size, t[2] * size) if size > 0.0 else frame(d)[0]
            key += GOLDEN
            grain = memory.grains[c, column, int(unit(mix(key)) * memory.kept[c])]
            d, _, _, n = sent(grain, d, t)
            slot = media.slot[c]
            if slot >= 0:
                length = media.scale[c] * float(grain[7])
                amounts[slot] += length
                luck += world.absorption.least[slot] * length
                if luck < DIM:
                    w.luck = luck
                    key += GOLDEN
                    if not lives(w, key):
                        state = X.LEFT
                    luck = w.luck
        else:
            n = step(t, math.sqrt(1.0 - b2), d)
        if met >= limit and state == 0:
            batch.counters[TRUNCATED] += 1
            state = X.LEFT
        if state != 0:
            break

        # The next grain, as long as it is nearer than all else
        bound -= (2.0 + s) * radius
        other = -1
        if sphere >= 0 and sure and bound > 2.01 * radius:
            other, di, dj, dk, s, away = next_around(around, sphere, n, d, bound / radius - 2.01)
        if other >= 0:
            n, sphere, i, j, k = away, other, i + di, j + dj, k + dk
        else:
            if sphere >= 0:
                centre = X.centre_of(grains, m, i, j, k, sphere)
            p, passed, fresh = step(centre, radius, n), 0.0, False
            o, c0 = (p[0] / radius, p[1] / radius, p[2] / radius), centre
            while True:
                s, i, j, k, sphere = next_sphere(cells, o, d, passed, bound / radius)
                if sphere >= 0:
                    centre = X.centre_of(grains, m, i, j, k, sphere)
                    if (sure and bound > (s + 2.0) * radius) or stands(room, m, centre):
                        break
                    passed = s
                elif fresh:
                    break
                else:
                    bound, fresh = clearance(g, m, p), True
            if sphere < 0:
                centre, mode = c0, FLY
                break
            n = step(step(p, s * radius, d), -1.0, centre)
            n = (n[0] / radius, n[1] / radius, n[2] / radius)
        if media.kinds[m] > 1:
            c = X.component_of(grains, media.first[m], media.kinds[m], X.named(grains, m, i, j, k, sphere))
    if sphere >= 0:
        centre = X.centre_of(grains, m, i, j, k, sphere)
    batch.counters[EVENTS] += met
    w.events += met
    write(w.p, step(centre, radius, n))
    write(w.d, d)
    write(w.q, centre)
    w.key, w.component, w.luck = key, c, luck
    w.mode, w.state, w.free, w.pdf, w.left = mode, state, -1.0, -1.0, 0


@njit(**KERNEL)
def answer(world, batch, count):
    """Take those of a batch's walkers, the first `count`, that have come to a grain from there to where they are to
    look where they go."""
    for i in range(count):
        if batch.walkers[i].mode == GRAIN:
            rove(world, batch, batch.walkers[i], batch.amounts[i])
