"""Sampling: random numbers as functions of what they are for; hashes, scrambled Sobol' points, points on a circle.

numba kernels; uint64 keys stand for random streams. Nothing here keeps a state, so the order of use does not matter.
"""

import math

import numpy as np

from tsdf.compiled import njit

GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: the step of SplitMix64

# Direction numbers of the first four dimensions of Sobol' sequences (Joe & Kuo 2008: s, a, m)
_JOE_KUO = ((0, 0, ()), (1, 0, (1,)), (2, 1, (1, 3)), (3, 1, (1, 3, 1)))


def _direction_numbers() -> np.ndarray:
    v = np.zeros((4, 32), dtype=np.uint32)
    for dimension, (s, a, m) in enumerate(_JOE_KUO):
        numbers = [1] * 32 if s == 0 else list(m)
        for i in range(len(numbers), 32):
            new = numbers[i - s] ^ (numbers[i - s] << s)
            for k in range(1, s):
                new ^= ((a >> (s - 1 - k)) & 1) * (numbers[i - k] << k)
            numbers.append(new)
        v[dimension] = [(number << (31 - i)) & 0xFFFFFFFF for i, number in enumerate(numbers)]
    return v


SOBOL = _direction_numbers()


@njit(cache=True)
def mix(x):
    """Return 64 well-mixed bits of a uint64 (the finaliser of SplitMix64, Steele et al. 2014)."""
    x = np.uint64(x)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True)
def key_of(seed, a, b):
    """Return the random key of item (a, b) of a seed, uint64."""
    k = mix(np.uint64(seed) + GOLDEN)
    k = mix(k ^ (np.uint64(a) * np.uint64(0xD1342543DE82EF95)))
    return mix(k ^ (np.uint64(b) * np.uint64(0x2545F4914F6CDD1D) + np.uint64(1)))


@njit(cache=True)
def unit(key):
    """Return a float64 in [0, 1) from a uint64."""
    return float(np.uint64(key) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def reverse_bits(x):
    """Return a uint32 with its bits in reverse order."""
    x = np.uint32(x)
    x = ((x >> np.uint32(1)) & np.uint32(0x55555555)) | ((x & np.uint32(0x55555555)) << np.uint32(1))
    x = ((x >> np.uint32(2)) & np.uint32(0x33333333)) | ((x & np.uint32(0x33333333)) << np.uint32(2))
    x = ((x >> np.uint32(4)) & np.uint32(0x0F0F0F0F)) | ((x & np.uint32(0x0F0F0F0F)) << np.uint32(4))
    x = ((x >> np.uint32(8)) & np.uint32(0x00FF00FF)) | ((x & np.uint32(0x00FF00FF)) << np.uint32(8))
    return np.uint32((x >> np.uint32(16)) | (x << np.uint32(16)))


@njit(cache=True)
def sobol(index, dimension, scramble, directions):
    """Return one coordinate of a nested-uniformly (Owen) scrambled Sobol' point, float64 in (0, 1).

    The scramble is a hash in the manner of Laine & Karras 2011 with the constants of Vegdahl 2021, a different tree for
    each `scramble`.
    """
    x = np.uint32(0)
    bit = 0
    while index:
        if index & 1:
            x ^= directions[dimension, bit]
        index >>= 1
        bit += 1
    s = np.uint32(scramble)
    x = reverse_bits(x)
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x3D20ADEA)))
    x = np.uint32(x + s)
    x = np.uint32(x * np.uint32((s >> np.uint32(16)) | np.uint32(1)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x05526C56)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x53A22864)))
    return (float(reverse_bits(x)) + 0.5) * (1.0 / 4294967296.0)


@njit(cache=True)
def turn(u):
    """Return cosine and sine of 2 pi u, u in [0, 1), to 1e-13, the same on every machine: Taylor series in quarters."""
    quarter = int(4.0 * u + 0.5)
    a = (u - 0.25 * quarter) * (2.0 * math.pi)
    q = a * a
    c = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (1.0 - q / 90.0 * (1.0 - q / 132.0)))))
    s = a * (
        1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (1.0 - q / 110.0 * (1.0 - q / 156.0)))))
    )
    if quarter & 1:
        c, s = -s, c
    return (-c, -s) if quarter & 2 else (c, s)
