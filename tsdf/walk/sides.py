"""The inside of a box, slab or ball without branches, for `lanes`: the compiler works out several places at once.

What each says is what `geometry` and `room` say of such a shape, but for rounding. A body is the lowest and the highest
coordinates, a pair of triples, or of a ball centre and radius, four numbers: which it is, is known when a kernel is
compiled, for it asks for no more than how many there are.
"""

import math

import numpy as np

from tsdf.compiled import bits_of, float_of, njit
from tsdf.vectors import KERNEL, dot, step
from tsdf.walk.geometry import Geometry
from tsdf.walk.grid import GRAZING
from tsdf.walk.room import BALL, SLAB

HAIR = 1e-6  # of a boundary's thickness: an event nearer than this to it may be beyond it by rounding


def body_of(g: Geometry) -> np.ndarray:
    """Return the first medium's lowest and highest coordinates (2, 3), infinite along a slab, or centre and radius of a
    ball (4,)."""
    if g.kind[0] == BALL:
        return np.array(g.shape[0, :4])
    ends = np.array(g.shape[0]).reshape(2, 3)
    if g.kind[0] == SLAB:
        ends[0, :2], ends[1, :2] = -math.inf, math.inf
    return ends


@njit(forceinline=True, **KERNEL)
def sides(array):
    """Return a body from its array."""
    if array.ndim == 1:
        return array[0], array[1], array[2], array[3]
    return (array[0, 0], array[0, 1], array[0, 2]), (array[1, 0], array[1, 1], array[1, 2])


@njit(forceinline=True, **KERNEL)
def depth(body, p):
    """Return how far p is inside of its sides, as `room.exact_depth`."""
    if len(body) == 4:
        q = (p[0] - body[0], p[1] - body[1], p[2] - body[2])
        return body[3] - math.sqrt(dot(q, q))
    low, high = body
    z = min(p[2] - low[2], high[2] - p[2])
    return min(z, min(min(p[0] - low[0], high[0] - p[0]), min(p[1] - low[1], high[1] - p[1])))


@njit(forceinline=True, **KERNEL)
def between(low, high, at, d):
    """Return where a ray is between two planes, as `geometry._between`, and 1 / d."""
    low, high = low - at, high - at
    begins = low < 0.0 < high
    each = 1.0 / d
    a, b = low * each, high * each
    near, far = min(a, b), max(a, b)
    still = d == 0.0
    near = (-math.inf if begins else math.inf) if still else near
    far = (math.inf if begins else -math.inf) if still else far
    return near, far, each


@njit(forceinline=True, **KERNEL)
def way_in(body, p, d):
    """Return where a ray from outside comes in, infinite if nowhere, and 1 over the part of d across the side where it
    does; as `geometry.exact_hit`."""
    if len(body) == 4:
        q = (p[0] - body[0], p[1] - body[1], p[2] - body[2])
        along = dot(q, d)
        left = along * along - (dot(q, q) - body[3] * body[3])
        root = math.sqrt(max(left, 0.0))
        return -along - root if along < 0.0 < left else math.inf, body[3] / root
    low, high = body
    near, far, each = between(low[2], high[2], p[2], d[2])
    a, b, across = between(low[1], high[1], p[1], d[1])
    each = across if a >= near else each
    near, far = a if a >= near else near, b if b <= far else far
    a, b, across = between(low[0], high[0], p[0], d[0])
    each = across if a >= near else each
    near, far = a if a >= near else near, b if b <= far else far
    return near if 0.0 <= near <= far else math.inf, each


@njit(forceinline=True, **KERNEL)
def way_out(body, p, e, d):
    """Return where a ray from inside along e goes out, 1 over the part of e across the side where it does, and how far
    d points outward there; as `geometry.exact_hit`, with one division."""
    if len(body) == 4:
        q = (p[0] - body[0], p[1] - body[1], p[2] - body[2])
        along = dot(q, e)
        root = math.sqrt(max(along * along - (dot(q, q) - body[3] * body[3]), 0.0))
        t = root - along
        return t, body[3] / root, dot(step(q, t, e), d)
    low, high = body
    x = high[0] - p[0] if e[0] > 0.0 else p[0] - low[0]
    y = high[1] - p[1] if e[1] > 0.0 else p[1] - low[1]
    z = high[2] - p[2] if e[2] > 0.0 else p[2] - low[2]
    size, along, outward = z, abs(e[2]), d[2] if e[2] > 0.0 else -d[2]
    first = y * along <= size * abs(e[1])
    size, along = y if first else size, abs(e[1]) if first else along
    outward = (d[1] if e[1] > 0.0 else -d[1]) if first else outward
    first = x * along <= size * abs(e[0])
    size, along = x if first else size, abs(e[0]) if first else along
    outward = (d[0] if e[0] > 0.0 else -d[0]) if first else outward
    each = 1.0 / along
    return size * each, each, outward


@njit(forceinline=True, **KERNEL)
def landing(body, slack, p, offset, bound, d):
    """Return whether a jump along an offset from p ends inside, whether it goes out, where it ends, how much is free
    around it if it ends inside, and what part of it is beyond the boundary. Around p, `bound` is free, and light goes
    on along d. See `transport.land`."""
    square = dot(offset, offset)
    part = 1.0 / math.sqrt(square)
    size = square * part if square > 0.0 else 0.0
    there = bound - size
    near = there > 0.0 or size == 0.0
    e = (offset[0] * part, offset[1] * part, offset[2] * part)
    beyond = depth(body, step(p, size, e)) - HAIR * slack
    sure = near or beyond > 0.0
    t, each, outward = way_out(body, p, e, d)
    leaves = t < size and not sure
    out = leaves and outward > 0.0
    move = slack * min(each, GRAZING)
    goes = t + (move if out else -min(move, 0.5 * t)) if leaves else size
    q, end = step(p, 1.0, offset), step(p, goes, e)
    end = (q[0] if near else end[0], q[1] if near else end[1], q[2] if near else end[2])
    return sure, out, end, there if near else beyond, 1.0 - t * part if leaves else 0.0


@njit(forceinline=True, **KERNEL)
def logarithm(x):
    """Return the natural logarithm of x > 0 to some ulps, by the series of the inverse hyperbolic tangent."""
    bits = bits_of(x)
    exponent = (bits >> 52) - 1023
    m = float_of((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
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
