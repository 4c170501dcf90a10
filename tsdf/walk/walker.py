"""A walker, one sample of one pixel on its way, and what all that moves it shares.

`transport` says where walkers go, `memory` how they go on through grains whose packing they remember.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.sampling import mix, unit
from tsdf.scene.levels import Traits
from tsdf.vectors import KERNEL
from tsdf.walk.geometry import NONE
from tsdf.walk.grid import UNKNOWN as UNKNOWN  # medium of a walker that may have crossed a boundary

WALKER = np.dtype(
    [("p", "3f8"), ("d", "3f8"), ("q", "3f8"), ("e", "3f8"), ("t", "3f8"), ("colour", "3f8"), ("weight", "f8"),
     ("luck", "f8"), ("pdf", "f8"), ("free", "f8"), ("length", "f8"), ("gained", "f8"), ("skip", "f8"), ("b", "f8"),
     ("key", "u8"), ("grain", "u8"),
     ("events", "i8"), ("sample", "i4"), ("ray", "i4"), ("medium", "i4"), ("mode", "i4"), ("component", "i4"),
     ("facet", "i4"), ("state", "i4"), ("tries", "i4"), ("shadow", "i4"), ("single", "i4"), ("left", "i4")]
)  # fmt: skip
# p, d: place and direction. q, e, length, gained: of a jump, the direction after it, its own, its length and what it
# adds to the amounts; in a grain, q is its centre, e where the ray starts. luck: logarithm of a bound of the
# throughput. pdf: density per steradian with which d was drawn, -1 for none. free: the free path still to fly, < 0 if
# not drawn. skip: how far beyond p the ray engine starts. ray: row of the ray engine's answers, -1 for none. t, b: of
# the bounding sphere at the end of the free path, the side on which it is entered and the impact parameter [R]; in a
# grain, how it is turned. single: grains met one by one so far. left: number of the packed sphere with centre q where
# it is or which it has just left, from 1 on, 0 for none. Where grains are packed, free is how far the next is, if it is
# known, e its centre, grain its key and facet its number.
FLY, JUMP, GRAIN = 0, 1, 2

EVENTS, RAYS, TRUNCATED, FAULTS, LEAPT, LEAPS = range(6)  # counters; LEAPT of the events, in so many LEAPS
LIVE, MOST, ASKED, GRAINS_ASKED = range(4)  # of `Batch.asked`
CLEAR, LOOK, WAIT, ENDED, HANDED = range(5)  # what becomes of a walker: it has met nothing, must look ahead, ...

OTHER = np.uint64(0xA5A5A5A5A5A5A5A5)
LOW = np.uint64(0xFFFFFFFF)
HALF_WORD = 1.0 / 4294967296.0
PATIENCE = 100_000  # steps of a walker before others have their turn
MAX_EVENTS = 50_000_000  # of one path; only light that nothing lets out comes that far, and it is counted
DIM = math.log(0.25)  # walkers dimmer than this may end
FAINT = 0.02  # shadows fainter than this may end
UNENDING = 1e300  # free path where nothing deflects or no grain is, finite so that 0 of it is 0
TRIES = 8  # to start a ray off a facet, each twice as far from it; and as many off the facet


class Media(NamedTuple):
    """What kernels ask about media (m,) and their components (c,).

    traits: of the level, for all media; free: mean free path; reach: the longest jump; first, kinds: its
    first component and how many it has; travel: amount that counts the length flown, or -1. Of components: choice, the
    running sum of the probability that the next grain met is of it; scale: what one event's path length [R], or the
    event itself where there is none, counts in the amount `slot`; slot, -1 for none; g: mean cosine of the
    Henyey-Greenstein lobe. Lengths in scene units. limit: events after which a path is given up. singles: grains
    that are met one by one before the level's own law takes over.
    """

    traits: Traits
    free: np.ndarray
    reach: np.ndarray
    first: np.ndarray
    kinds: np.ndarray
    travel: np.ndarray
    choice: np.ndarray
    scale: np.ndarray
    slot: np.ndarray
    g: np.ndarray
    limit: int
    singles: int = 0


class Attenuation(NamedTuple):
    """How amounts (a,) of matter become colour: exponents per wavelength (a, k) and per channel (3, a), the weight
    (3, k) of each wavelength in linear RGB, and the exponent of the least absorbed light (a,)."""

    spectral: np.ndarray
    rgb: np.ndarray
    weight: np.ndarray
    least: np.ndarray


class Batch(NamedTuple):
    """The walkers that one thread takes on together, and what they ask the ray engine.

    walkers (n,) and amounts (n, a) are those under way, out and out_amounts receive those that go on and the shadows
    that are born; starts and ways (n, 3) float32 the rays in the scene, grain_starts and grain_ways (e, n, 3) those in
    the exemplars, hits (n + 1, engines) and grain_hits (e, n) int32 the facets that they meet, the last of
    hits those of the walker under way. radiance (samples, 3); spectrum (k,): room for a number per wavelength;
    counters (6,): see EVENTS; asked (3 + e,): walkers in out, the number of them from which on no more are made, rays
    asked for in the scene, and in each exemplar.
    """

    walkers: np.ndarray
    amounts: np.ndarray
    out: np.ndarray
    out_amounts: np.ndarray
    hits: np.ndarray
    grain_hits: np.ndarray
    starts: np.ndarray
    ways: np.ndarray
    grain_starts: np.ndarray
    grain_ways: np.ndarray
    radiance: np.ndarray
    counters: np.ndarray
    asked: np.ndarray
    spectrum: np.ndarray


@njit(**KERNEL)
def full(batch):
    """Return whether a batch has no room for more walkers."""
    return batch.asked[LIVE] >= batch.asked[MOST]


@njit(**KERNEL)
def born(batch, amounts):
    """Return the number in `out` of a new walker, whose amounts are those given."""
    live = batch.asked[LIVE]
    batch.asked[LIVE] += 1
    copy(batch.out_amounts[live], amounts)
    return live


@njit(forceinline=True, **KERNEL)
def power(x):
    """Return exp(x), x in [-300, 300], to 3e-12: the Taylor series of a 1024th of it, squared ten times.

    Without a table or a branch, so that the processor works out several at once.
    """
    y = max(min(x, 700.0), -700.0) * (1.0 / 1024.0)
    y2 = y * y
    y4 = y2 * y2
    high = (1.0 / 40320 + y * (1.0 / 362880)) + y2 * (1.0 / 3628800 + y * (1.0 / 39916800))
    low = (1.0 / 24 + y * (1.0 / 120)) + y2 * (1.0 / 720 + y * (1.0 / 5040))
    e = ((1.0 + y) + y2 * (0.5 + y * (1.0 / 6))) + y4 * (low + y4 * high)
    for _ in range(10):
        e *= e
    return e


@njit(fastmath={"reassoc", "contract", "nsz"}, **KERNEL)
def by_wavelength(absorption, amounts, spectrum):
    """Return the colour that amounts of matter with a spectrum leave of white light; `spectrum` is overwritten."""
    for k in range(spectrum.shape[0]):
        spectrum[k] = 0.0
    for i in range(amounts.shape[0]):
        amount = amounts[i]
        if amount != 0.0:
            for k in range(spectrum.shape[0]):
                spectrum[k] += absorption.spectral[i, k] * amount
    r, g, b = 0.0, 0.0, 0.0
    for k in range(spectrum.shape[0]):
        passed = power(spectrum[k])
        r += absorption.weight[0, k] * passed
        g += absorption.weight[1, k] * passed
        b += absorption.weight[2, k] * passed
    return r, g, b


@njit(**KERNEL)
def absorbed(absorption, amounts, spectrum):
    """Return the colour that the amounts of matter crossed leave of white light."""
    crossed = False
    for i in range(amounts.shape[0]):
        crossed |= amounts[i] != 0.0
    if not crossed:
        return 1.0, 1.0, 1.0
    r, g, b = 1.0, 1.0, 1.0
    if spectrum.shape[0] > 0:
        r, g, b = by_wavelength(absorption, amounts, spectrum)
    er, eg, eb = 0.0, 0.0, 0.0
    for i in range(amounts.shape[0]):
        er += absorption.rgb[0, i] * amounts[i]
        eg += absorption.rgb[1, i] * amounts[i]
        eb += absorption.rgb[2, i] * amounts[i]
    if er == eg and er == eb:
        grey = math.exp(er)
        return r * grey, g * grey, b * grey
    return r * math.exp(er), g * math.exp(eg), b * math.exp(eb)


@njit(**KERNEL)
def find(world, batch, w, amounts, light):
    """Add light found by a walker to its sample."""
    left = absorbed(world.absorption, amounts, batch.spectrum)
    for k in range(3):
        batch.radiance[w.sample, k] += w.weight * w.colour[k] * light[k] * left[k]


@njit(forceinline=True, **KERNEL)
def halves(bits):
    """Return two numbers in [0, 1) from 64 bits."""
    return float(bits >> np.uint64(32)) * HALF_WORD, float(bits & LOW) * HALF_WORD


@njit(**KERNEL)
def copy(row, other):
    """Write a row to another."""
    for i in range(row.shape[0]):
        row[i] = other[i]


@njit(**KERNEL)
def write(row, v):
    """Write a triple to a row."""
    row[0], row[1], row[2] = v


@njit(**KERNEL)
def cast(w, shadow, p, toward, light, weight, m, key):
    """Write the shadow of walker w: from p toward a light of that colour."""
    write(shadow.p, p)
    write(shadow.d, toward)
    for k in range(3):
        shadow.colour[k] = w.colour[k] * w.weight * light[k] * weight
    shadow.weight, shadow.luck, shadow.pdf, shadow.free = 1.0, 0.0, -1.0, -1.0
    shadow.skip, shadow.key, shadow.events = 0.0, key, 0
    shadow.sample, shadow.ray, shadow.medium, shadow.mode = w.sample, NONE, m, FLY
    shadow.tries, shadow.shadow, shadow.single, shadow.left = 0, 1, w.single, 0


@njit(**KERNEL)
def lives(w, key):
    """Play roulette with a walker that has become dim: it ends, or goes on with what those that end had.

    The chance to live is the throughput itself, without a cap, so light that loses nothing is never in play.
    """
    chance = 2.0 * math.exp(w.luck)
    if unit(mix(key ^ OTHER)) >= chance:
        w.weight = 0.0
        return False
    w.weight /= chance
    w.luck = math.log(0.5)
    return True
