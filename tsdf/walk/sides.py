"""The inside of a box or slab without branches, for `lanes`: the compiler works out several places at once.

What each says is what `geometry` and `room` say of such a shape, but for rounding.
"""

import math

from tsdf.compiled import bits_of, float_of, njit
from tsdf.vectors import KERNEL, dot, step
from tsdf.walk.grid import GRAZING
from tsdf.walk.room import SLAB

HAIR = 1e-6  # of a boundary's thickness: an event nearer than this to it may be beyond it by rounding


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
def way_in(low, high, p, d):
    """Return where a ray from outside comes in, infinite if nowhere, and 1 over the part of d across the side where it
    does; as `geometry.exact_hit`."""
    near, far, each = between(low[2], high[2], p[2], d[2])
    a, b, across = between(low[1], high[1], p[1], d[1])
    each = across if a >= near else each
    near, far = a if a >= near else near, b if b <= far else far
    a, b, across = between(low[0], high[0], p[0], d[0])
    each = across if a >= near else each
    near, far = a if a >= near else near, b if b <= far else far
    return near if 0.0 <= near <= far else math.inf, each


@njit(forceinline=True, **KERNEL)
def way_out(low, high, p, e, d):
    """Return where a ray from inside along e goes out, 1 over the part of e across the side where it does, and how far
    d points outward there; as `geometry.exact_hit`, with one division."""
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
def landing(low, high, slack, p, offset, bound, d):
    """Return whether a jump along an offset from p ends inside, whether it goes out, where it ends, how much is free
    around it if it ends inside, and what part of it is beyond the boundary. Around p, `bound` is free, and light goes
    on along d. See `transport.land`."""
    square = dot(offset, offset)
    part = 1.0 / math.sqrt(square)
    size = square * part if square > 0.0 else 0.0
    there = bound - size
    near = there > 0.0 or size == 0.0
    e = (offset[0] * part, offset[1] * part, offset[2] * part)
    beyond = depth(low, high, step(p, size, e)) - HAIR * slack
    sure = near or beyond > 0.0
    t, each, outward = way_out(low, high, p, e, d)
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
