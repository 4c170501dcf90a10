"""Slabs in two lines of algebra: delta-Eddington two streams, and the asymptotic theory of weakly absorbing snow; and
by doubling, which takes the whole phase function and is exact but for its number of directions.

What they are given is what single scattering says, optical depth, albedo and g; paths through grains are `slabs`. The
first two take the light as diffuse nearly everywhere, which thin slabs and strong absorption are not.

[1] Joseph, Wiscombe & Weinman 1976, doi:10.1175/1520-0469(1976)033<2452:TDEAFR>2.0.CO;2
[2] Meador & Weaver 1980, doi:10.1175/1520-0469(1980)037<0630:TSATRT>2.0.CO;2, eqs. 14 and 15
[3] Kokhanovsky & Zege 2004, doi:10.1364/AO.43.001589; slabs: Zege, Ivanov & Katsev 1991, Image Transfer, ch. 3
[4] van de Hulst 1980, Multiple Light Scattering, ch. 4
"""

from typing import NamedTuple

import numpy as np

NODES = 16  # of the integral over directions of diffuse light
NEAREST = 1e-3  # that k mu is kept from 1, where the formula is 0 / 0
ALPHA = 1.07  # of a slab's diffuse transmittance [3]
FEEBLE = 1e-12  # co-albedo of what does not absorb, so that nothing is 0 / 0
DEEPEST = 300.0  # exponents beyond are all the same
DIRECTIONS = 24  # of doubling, in each half of the sphere
ORDERS = 2 * DIRECTIONS  # of Legendre moments that it takes
THINNEST, THICKEST = 1e-4, 1e8  # optical depth of the layer that it begins with, and of a half-space


class Streams(NamedTuple):
    """What comes back from a slab and what passes it, shares of the light, (w,) float64 each."""

    reflectance: np.ndarray
    transmittance: np.ndarray


def two_streams(depth: np.ndarray, albedo: np.ndarray, g: np.ndarray, cosine: float | None) -> Streams:
    """Return what a slab does to a beam, or to diffuse light, by the delta-Eddington approximation [1, 2].

    Parameters
    ----------
    depth : (w,) float64
        Optical depth [1], may be infinite.
    albedo, g : (w,) float64
        Of single scattering, albedo in [0, 1].
    cosine : float, optional
        Of the angle of incidence, in (0, 1]; None for diffuse light, a mean over such beams.
    """
    if cosine is None:
        at, weight = np.polynomial.legendre.leggauss(NODES)
        beams = [(w * 0.5 * (mu + 1.0), two_streams(depth, albedo, g, 0.5 * (mu + 1.0)))
                 for mu, w in zip(at, weight, strict=True)]  # fmt: skip
        return Streams(
            np.sum([w * b.reflectance for w, b in beams], axis=0),
            np.sum([w * b.transmittance for w, b in beams], axis=0),
        )
    w = np.minimum(albedo, 1.0 - FEEBLE)
    f = g * g
    tau = np.minimum((1.0 - w * f) * depth, 1e12)
    w, g = (1.0 - f) * w / (1.0 - w * f), g / (1.0 + g)
    y1, y2 = 0.25 * (7.0 - w * (4.0 + 3.0 * g)), -0.25 * (1.0 - w * (4.0 - 3.0 * g))
    y3 = 0.25 * (2.0 - 3.0 * g * cosine)
    y4 = 1.0 - y3
    a1, a2 = y1 * y4 + y2 * y3, y1 * y3 + y2 * y4
    k = np.sqrt(np.maximum((y1 - y2) * (y1 + y2), 1e-24))
    near = np.abs(k * cosine - 1.0) < NEAREST
    k = np.where(near, (1.0 + NEAREST) / cosine, k)
    ku = k * cosine
    # all over exp(k tau), so that deep slabs do not overflow
    e2, beam = np.exp(-np.minimum(2.0 * k * tau, DEEPEST)), np.exp(-np.minimum(tau / cosine, DEEPEST))
    ek = np.exp(-np.minimum(k * tau, DEEPEST))
    whole = (1.0 - ku**2) * ((k + y1) + (k - y1) * e2)
    reflected = (
        w
        / whole
        * ((1.0 - ku) * (a2 + k * y3) - (1.0 + ku) * (a2 - k * y3) * e2 - 2.0 * k * (y3 - a2 * cosine) * ek * beam)
    )
    passed = (
        w
        / whole
        * (
            (1.0 + ku) * (a1 + k * y4) * beam
            - (1.0 - ku) * (a1 - k * y4) * e2 * beam
            - 2.0 * k * (y4 + a1 * cosine) * ek
        )
    )
    return Streams(np.clip(reflected, 0.0, 1.0), np.where(np.isinf(depth), 0.0, np.clip(beam - passed, 0.0, 1.0)))


def asymptotic(depth: np.ndarray, coalbedo: np.ndarray, g: np.ndarray, cosine: float | None) -> Streams:
    """Return what an optically thick, weakly absorbing slab does to a beam, or to diffuse light [3].

    Parameters
    ----------
    depth : (w,) float64
        Optical depth [1], may be infinite.
    coalbedo : (w,) float64
        Absorption of a grain as it begins, sigma_a R <l>, which is B sigma_a times volume over projected area [1].
    g : (w,) float64
        Of the lossless grain.
    cosine : float, optional
        Of the angle of incidence; None for diffuse light.
    """
    escape = 1.0 if cosine is None else 3.0 / 7.0 * (1.0 + 2.0 * cosine)
    b = np.maximum(coalbedo, FEEBLE)
    y = 4.0 * np.sqrt(b / (3.0 * (1.0 - g)))
    x = np.minimum(np.sqrt(3.0 * b * (1.0 - g)) * depth, DEEPEST)
    with np.errstate(over="ignore"):
        through = np.where(y < DEEPEST, np.sinh(np.minimum(y, DEEPEST)) / np.sinh(ALPHA * y + x), 0.0)
    reflected = np.exp(-y * escape) - escape * through * np.exp(-x - y)
    passed = np.where(np.isinf(depth), 0.0, np.clip(escape * through, 0.0, 1.0))
    return Streams(np.clip(reflected, 0.0, 1.0), passed)


def doubled(depth: np.ndarray, albedo: np.ndarray, moments: np.ndarray, cosine: float | None) -> Streams:
    """Return what a slab does to a beam, or to diffuse light, by doubling [4].

    Parameters
    ----------
    depth : (w,) float64
        Optical depth [1], may be infinite.
    albedo : (w,) float64
        Of single scattering, in [0, 1].
    moments : (w, ORDERS + 1) float64
        Legendre moments of the phase function; what the last says goes straight on (delta-M).
    cosine : float, optional
        Of the angle of incidence, in (0, 1]; None for diffuse light.
    """
    ahead = np.clip(moments[:, -1:], 0.0, 1.0 - FEEBLE)
    w = albedo[:, None]
    chi = (moments[:, :-1] - ahead) / (1.0 - ahead)
    tau, w = np.minimum((1.0 - w * ahead)[:, 0] * depth, THICKEST), w * (1.0 - ahead) / (1.0 - w * ahead)
    at, weight = np.polynomial.legendre.leggauss(DIRECTIONS)
    mu, weight = 0.5 * (at + 1.0), 0.5 * weight
    if cosine is not None:  # one more, which light leaves along: what a beam gives is what its direction gets
        mu, weight = np.append(mu, cosine), np.append(weight, 0.0)
    orders = np.arange(chi.shape[1])
    p = np.polynomial.legendre.legvander(mu, len(orders) - 1)
    terms = (2 * orders + 1) * chi
    on, back = ((some[:, None] * p) @ p.T * (0.5 * weight) for some in (terms, terms * (-1.0) ** orders))
    steps = np.ceil(np.log2(np.maximum(tau / THINNEST, 1.0))).astype(np.int64)
    scattered = -np.expm1(-(tau / 2.0**steps)[:, None, None] / mu[:, None])
    one = np.eye(len(mu))
    r, t = w[:, :, None] * scattered * back, one * (1.0 - scattered) + w[:, :, None] * scattered * on
    for step in range(int(steps.max(initial=0))):
        more = steps > step
        reflected, passed = r[more], t[more]
        between = np.linalg.solve(one - reflected @ reflected, passed)
        r[more], t[more] = reflected + passed @ reflected @ between, passed @ between
    up, down = np.clip(r.sum(axis=2), 0.0, 1.0), np.clip(t.sum(axis=2), 0.0, 1.0)
    if cosine is not None:
        return Streams(up[:, -1], down[:, -1])
    return Streams(2.0 * up @ (weight * mu), 2.0 * down @ (weight * mu))


def over_ground(light: Streams, diffuse: Streams, ground: np.ndarray | float) -> Streams:
    """Return the same slab on ground that reflects a share of the light, evenly to all sides; what the ground gets.

    The slab is the same from below as from above: `diffuse` is what it does to the ground's light.
    """
    lost = 1.0 - ground + ground * diffuse.transmittance  # at least, each time
    back = ground / np.maximum(np.maximum(1.0 - ground * diffuse.reflectance, lost), 1e-300)
    return Streams(
        np.clip(light.reflectance + light.transmittance * back * diffuse.transmittance, 0.0, 1.0),
        light.transmittance * (1.0 + back * diffuse.reflectance),
    )
