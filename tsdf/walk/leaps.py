"""Leaps: many events in one step, deep inside a medium, where nothing else can be met.

A ball about where light will be in the mean, as large as there is room for, is left where a record of first passage
(`passage`) says: so far below its surface, in such a direction, with the flight that leads out still to fly, after so
many grains and so much matter. docs/leaps.md derives why the middle is not where light is now, and what is left of an
error. Which media leap, and from what clearance on, is `picture.leaping`'s.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.data.sampler import turned
from tsdf.sampling import GOLDEN, mix
from tsdf.vectors import KERNEL, cross, dot, frame, step, triple
from tsdf.walk.geometry import clearance
from tsdf.walk.walker import DIM, EVENTS, LEAPS, LEAPT, halves, lives, write

NEVER = 1 << 60
ENDS, LEAPT_ON = -1, 0  # what `leap` says; else how many events it is too early to ask again
PATIENT = 1.0  # of the events in which light diffuses as far as room is missing, it is not asked again


ROOM, MARGIN, PACE, UNIT = range(4)


class Leaps(NamedTuple):
    """What kernels ask about leaps in media (m,); lengths in scene units, those of records in each medium's unit.

    size (m, 4): ROOM, radius of the smallest ball, infinite where there are no leaps; MARGIN, what is left free
    around a ball; PACE, root of the mean square step; UNIT. middle (m, cells, 2), cells (m,): where a ball's middle is
    from the place of an entry, along the direction and the side of the entry, by cells of the squared impact parameter.
    balls (m, k, 4), of the records: squared radius, A, B, and 1 / (r^2 + 2 A r + B). records (m, k, n, 8), crossed
    (m, k, n, components + 1) float32: see `passage.Passage`; kept (m,): how many of n.
    """

    size: np.ndarray
    middle: np.ndarray
    cells: np.ndarray
    balls: np.ndarray
    records: np.ndarray
    crossed: np.ndarray
    kept: np.ndarray


@njit(forceinline=True, **KERNEL)
def patience(leaps, m, missing):
    """Return how many events it is too early to ask for a leap where so much room is missing."""
    if not missing < math.inf:
        return NEVER
    times = max(missing, 0.0) / leaps.size[m, PACE]
    return 1 + int(PATIENT * times * times)


@njit(forceinline=True, **KERNEL)
def missing(leaps, m, bound):
    """Return how much room is missing for a leap about a place of that clearance."""
    return leaps.size[m, ROOM] + leaps.size[m, MARGIN] - bound


@njit(forceinline=True, **KERNEL)
def tilted(n, side, cosine):
    """Return the unit vector at an angle of given cosine from n toward the side, and the side from there toward n."""
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    return (
        step((cosine * n[0], cosine * n[1], cosine * n[2]), sine, side),
        step((sine * n[0], sine * n[1], sine * n[2]), -cosine, side),
    )


@njit(forceinline=True, **KERNEL)
def around(n, side, turns, mirrored):
    """Return a side of n turned about it, or the other way."""
    co, si = turned(turns)
    if mirrored:
        si = -si
    return step((co * side[0], co * side[1], co * side[2]), si, cross(n, side))


@njit(**KERNEL)
def leap(world, batch, w, amounts):
    """Take a walker that enters a sphere, or meets a point, out of the largest ball that there is room for.

    Returns LEAPT_ON, ENDS where roulette ends it, or if there is too little room, after how many events to ask again;
    and a length within which the walker then is sure to have nothing around it.
    """
    leaps, m = world.leaps, w.medium
    p, d = triple(w.p), triple(w.d)
    remembers, margin, cell = world.media.traits.remembers, leaps.size[m, MARGIN], 0
    if remembers:
        cell = min(int(w.b * w.b * leaps.cells[m]), leaps.cells[m] - 1)
    middle = step(p, leaps.middle[m, cell, 0], d)
    if remembers:
        middle = step(middle, leaps.middle[m, cell, 1], triple(w.t))
    r = clearance(world.geometry, m, middle) - margin
    away = step(middle, -1.0, p)
    # With p in the ball, both are on the same side of everything
    if r < leaps.size[m, ROOM] or dot(away, away) >= r * r:
        return patience(leaps, m, leaps.size[m, ROOM] - r), 0.0

    balls, square, key, k, last = leaps.balls, r * r, w.key, 0, leaps.balls.shape[1] - 1
    while k < last and balls[m, k + 1, 0] <= square:
        k += 1
    key += GOLDEN
    u0, u1 = halves(mix(key))
    key += GOLDEN
    u2, u3 = halves(mix(key))
    if k < last and u2 * (balls[m, k + 1, 0] - balls[m, k, 0]) < square - balls[m, k, 0]:
        k += 1
    i = int(u3 * leaps.kept[m])
    record, unit = leaps.records[m, k, i], leaps.size[m, UNIT]
    times = balls[m, k, 3] * (square + 2.0 * balls[m, k, 1] * r + balls[m, k, 2])

    # u, where the ball is left, about d as far as the record's; the new direction about u, the next side about it
    first, second = frame(d)
    co, si = turned(u0)
    side = step((co * first[0], co * first[1], co * first[2]), si, second)
    nu, mu, mirrored = float(record[1]), float(record[2]), u1 < 0.5  # the mirror image is as likely
    u, inward = tilted(d, side, nu)
    side = around(u, inward, float(record[3]), mirrored)
    d, inward = tilted(u, side, mu)
    write(w.p, step(middle, r - unit * float(record[0]), u))
    write(w.d, d)
    w.free = unit * float(record[6])
    if remembers:
        write(w.t, around(d, inward, float(record[4]), mirrored))
        w.b = float(record[5])
    met = float(record[7])
    if met > 0.0:
        w.pdf = -1.0  # nobody has aimed at a light where this direction was drawn: what it finds counts in full
    count_of(world, batch, w, amounts, leaps.crossed[m, k, i], (times, met * times, key))
    w.key = key
    if w.luck < DIM:
        w.key += GOLDEN
        if not lives(w, w.key):
            return ENDS, 0.0
    return LEAPT_ON, margin + unit * float(record[0])


@njit(forceinline=True, **KERNEL)
def count_of(world, batch, w, amounts, crossed, leapt):
    """Count a leap as the grains and the matter that it stands for; `leapt` is what the record's are times, grains, and
    a key."""
    media, absorption, m = world.media, world.absorption, w.medium
    times, grains, key = leapt
    first, kinds = media.first[m], media.kinds[m]
    for c in range(kinds):
        slot = media.slot[first + c]
        if slot >= 0:
            length = media.scale[first + c] * times * float(crossed[c])
            amounts[slot] += length
            w.luck += absorption.least[slot] * length
    travel = media.travel[m]
    if travel >= 0:
        length = world.leaps.size[m, UNIT] * times * float(crossed[kinds])
        amounts[travel] += length
        w.luck += absorption.least[travel] * length
    whole = np.int64(grains + halves(key)[1])
    w.events += whole
    batch.counters[EVENTS] += whole
    batch.counters[LEAPT] += whole
    batch.counters[LEAPS] += 1


# ------------------------------------------------------------------------------------------- from records


def leaps_of(passages: Sequence[Any], unit: np.ndarray, room: np.ndarray, margin: np.ndarray) -> Leaps:
    """Return what kernels ask about leaps.

    Parameters
    ----------
    passages : sequence of Passage or None
        Of each medium; None where there are no leaps.
    unit, room, margin : (m,) float64
        Unit of the records, and radius of the smallest ball and what is left free around it, infinite and 0 where there
        are no leaps.
    """
    media, there = len(passages), [one for one in passages if one is not None]
    cells = max((len(one.ahead) for one in there), default=1)
    k = max((len(one.radius) for one in there), default=1)
    n = max((one.records.shape[1] for one in there), default=1)
    kinds = max((one.crossed.shape[2] for one in there), default=1)
    made = Leaps(
        size=np.stack((room, margin, np.ones(media), unit), axis=1),
        middle=np.zeros((media, cells, 2)),
        cells=np.ones(media, np.int64),
        balls=np.ones((media, k, 4)),
        records=np.zeros((media, k, n, 8), np.float32),
        crossed=np.zeros((media, k, n, kinds), np.float32),
        kept=np.zeros(media, np.int64),
    )
    for m, one in enumerate(passages):
        if one is None:
            continue
        made.size[m, PACE] = unit[m] * math.sqrt(one.step2)
        made.cells[m], made.kept[m] = len(one.ahead), one.records.shape[1]
        made.middle[m, : len(one.ahead)] = unit[m] * np.stack((one.ahead, one.aside), axis=1)
        # N of a ball is to that of a record as their r^2 + 2 A r + B
        r, a, b = unit[m] * one.radius, unit[m] * one.numbers[:, 0], unit[m] ** 2 * one.numbers[:, 1]
        made.balls[m] = np.stack((r * r, a, b, 1.0 / (r * r + 2.0 * a * r + b)), axis=1)
        made.records[m, :, : one.records.shape[1], : one.records.shape[2]] = one.records
        made.crossed[m, :, : one.crossed.shape[1], : one.crossed.shape[2]] = one.crossed
    return made
