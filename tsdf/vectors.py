"""Vectors as triples of floats, which the compiler keeps in registers where arrays would cost a reference count."""

import math
from typing import Any

from tsdf.compiled import njit

# Options of kernels that allocate nothing: without counting references, which takes two thirds of the time of a kernel
# that is handed many arrays. Not a public option of numba's: without it, all works, only slower.
KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}


@njit(cache=True)
def dot(a, b):
    """Return the scalar product of two triples of floats."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a, b):
    """Return the vector product of two triples of floats."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def step(a, t, b):
    """Return a + t b of two triples of floats."""
    return a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]


@njit(cache=True)
def minus(a):
    """Return -a of a triple."""
    return -a[0], -a[1], -a[2]


@njit(cache=True)
def triple(v):
    """Return an array of three as a triple, which the compiler keeps in registers."""
    return v[0], v[1], v[2]


@njit(cache=True)
def frame(n):
    """Return two unit vectors that complete a unit vector to a right-handed frame (Duff et al. 2017)."""
    x, y, z = n
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@njit(forceinline=True, **KERNEL)
def renewed(d):
    """Return a nearly unit vector with unit length, by a step of Newton's: keeps rounding errors from piling up."""
    half = 1.5 - 0.5 * dot(d, d)
    return d[0] * half, d[1] * half, d[2] * half


@njit(forceinline=True, **KERNEL)
def unit_of(v):
    """Return the unit vector along a triple."""
    size = 1.0 / math.sqrt(dot(v, v))
    return v[0] * size, v[1] * size, v[2] * size
