"""What other software does: walks in a slab or a ball of isotropic scatterers, and teleportation that looks at nothing.

Each is the textbook's, or a renderer's default, and nothing else is wrong with it; in numpy, all paths at once.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tsdf.data.sampler import Sampler, outgoing
from tsdf.data.table import Table

DEPTH = 12  # events after which Blender's light ends by default
FROM, MOST = 5, 0.95  # event from which on roulette is played, and the most it lets go on (Pharr, Jakob & Humphreys)
LONGEST = 100_000  # events


class Ends(NamedTuple):
    """Light that came out of paths, arrays (n,): weight with which each left, 0 if it did not; whether upward."""

    weight: np.ndarray
    up: np.ndarray


def capped(event: int, weight: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Play roulette with a chance of going on that is the throughput, but capped; return the weights, 0 where ended."""
    if event < FROM:
        return weight
    chance = np.minimum(weight, MOST)
    return np.where(rng.random(len(weight)) < chance, weight / np.maximum(chance, 1e-300), 0.0)


def ended(event: int, weight: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """End all paths after `DEPTH` events."""
    return weight if event < DEPTH else np.zeros_like(weight)


def isotropic_slab(
    thickness: float, albedo: float, paths: int, rng: np.random.Generator,
    end: Callable[[int, np.ndarray, np.random.Generator], np.ndarray], depth: float = 0.0,
) -> Ends:  # fmt: skip
    """Send light straight down, from some depth, in a slab of isotropic scatterers; lengths in mean free paths."""
    weight, up = np.zeros(paths), np.zeros(paths, bool)
    who, z, cosine, w = np.arange(paths), np.full(paths, -depth), np.full(paths, -1.0), np.ones(paths)
    for event in range(1, LONGEST):
        z = z + cosine * rng.exponential(size=len(z))
        out = (z > 0.0) | (z < -thickness)
        weight[who[out]], up[who[out]] = w[out], z[out] > 0.0
        w = end(event, w * albedo, rng)
        on = ~out & (w > 0.0)
        who, z, w = who[on], z[on], w[on]
        if not len(who):
            break
        cosine = rng.uniform(-1.0, 1.0, len(who))
    return Ends(weight, up)


def untested_jumps(
    table: Table, free: float, wall: float, paths: int, rng: np.random.Generator, events: int = 40
) -> np.ndarray:
    """Return which paths get through a wall that lies in the grains, from z = `wall` down, by jumping over it.

    Free paths are tested against the wall, jumps from entry to exit of a grain are not. Light comes straight from 4 R
    above.
    """
    sampler = Sampler(table)
    p = np.zeros((paths, 3))
    p[:, 2] = 4.0
    d = np.tile((0.0, 0.0, -1.0), (paths, 1))
    through = np.zeros(paths, bool)
    who = np.arange(paths)
    for _ in range(events):
        step = rng.exponential(free, len(who))
        stopped = p[:, 2] + step * d[:, 2] < 0.0
        gone = p[:, 2] + step * d[:, 2] > 1e3
        on = ~stopped & ~gone
        who, p, d = who[on], p[on] + step[on, None] * d[on], d[on]
        if not len(who):
            break
        out = outgoing(sampler.sample(rng.random((len(who), 6))), d)
        p, d = p + out.offset, out.d_out / np.linalg.norm(out.d_out, axis=1, keepdims=True)
        beyond = p[:, 2] < -wall
        through[who[beyond]] = True
        on = p[:, 2] > 0.0
        who, p, d = who[on], p[on], d[on]
        if not len(who):
            break
    return through


def h_function(albedo: float, nodes: int = 64, rounds: int = 20_000) -> float:
    """Return Chandrasekhar's H(1) for isotropic scatterers: a half-space sends back 1 - H(1) sqrt(1 - albedo) of light
    that comes straight down (Chandrasekhar 1960, section 38)."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    mu, w = 0.5 * (x + 1.0), 0.5 * w
    root, h = math.sqrt(1.0 - albedo), np.ones(nodes)
    kernel = mu[None, :] / (mu[:, None] + mu[None, :])
    for _ in range(rounds):
        new = 1.0 / (root + 0.5 * albedo * (kernel * h) @ w)
        done = float(np.abs(new / h - 1.0).max()) < 1e-13
        h = new
        if done:
            break
    return 1.0 / (root + 0.5 * albedo * float((h * mu / (1.0 + mu)) @ w))
