"""Advice: which level a picture of grains should take, by a rule of four sizes, with its reasons.

`plan` knows better, for it looks at the scene; this is for things that are not one yet, and shares its law of texture.

Sizes are in bounding radii R: what a pixel covers, how thick the grains lie, how far light goes before it has forgotten
its direction (the transport mean free path l*). Where the numbers come from: docs/rendering.md ("Which level?").
"""

import math
from typing import NamedTuple

from tsdf.picture.footprint import PER_E, texture
from tsdf.spheres.packing import MAX
from tsdf.walk.hybrid import LEAST_COSINE, LEAST_LAYER

SINGLE = 1.0  # [R] that a pixel covers, below which single grains are seen
THIN = 10.0  # [R] thinner layers are not told from their neighbours' places
DEEP = 25.0  # [l*] thicker ones let 1 / (1 + 3/4 25) = .05 of the light through: a tenth of it is .005 of reflectance
SPARSE = 0.3  # packing fraction up to which grains do not know of their neighbours
TARGET = 0.05  # [1] error of a pixel that is borne


class Medium(NamedTuple):
    """What advice depends on of grains in bulk."""

    packing_fraction: float  # of bounding spheres [1]
    transport: float  # transport mean free path l* [R]
    mean_cosine: float  # of one grain's deflection [1]


class Advice(NamedTuple):
    """A level, how many explicit grains before it, and why."""

    level: str
    explicit_grains: int
    reason: str

    def __str__(self) -> str:
        first = f", k = {self.explicit_grains}" if self.explicit_grains else ""
        return f"take level {self.level} here{first}"


def advise(footprint: float, thickness: float, medium: Medium) -> Advice:
    """Return the cheapest level whose error a picture can bear.

    Parameters
    ----------
    footprint : float
        What a pixel covers of the grains [R], > 0.
    thickness : float
        Of the grains along light's way through [R], > 0; infinity where there is no other side.
    medium : Medium

    Examples
    --------
    >>> snow = Medium(packing_fraction=0.5, transport=5.0, mean_cosine=0.6)
    >>> print(advise(0.5, 100.0, snow))
    take level teleport-memory here, k = 7
    >>> print(advise(5.0, 400.0, snow))
    take level volume here
    """
    mirrors = medium.mean_cosine < LEAST_COSINE
    back = f"grains send much light back (mean cosine {medium.mean_cosine:.2f}) and are met again"
    chain = "teleport-memory" if medium.packing_fraction <= MAX else "teleport"
    if footprint < SINGLE:
        seen = f"a pixel covers {footprint:.2g} R: single grains are seen"
        if mirrors:
            return Advice("explicit", 0, f"{seen}, and {back}")
        if thickness - 2.0 <= LEAST_LAYER:
            return Advice("explicit", 0, f"{seen}, and {thickness:.2g} R are but a few of them")
        missing = float(texture(footprint))
        k = max(1, math.ceil(PER_E * math.log(missing / TARGET)))
        return Advice(
            chain,
            k,
            f"{seen}; k = 4 ln({missing:.2g} / {TARGET:g}) explicit grains first (--explicit-grains {k}) bring the "
            f"error of a pixel from {missing:.0%} to {TARGET:.0%}",
        )
    deep = thickness / medium.transport
    if deep >= DEEP:
        return Advice(
            "volume",
            0,
            f"a pixel covers {footprint:.2g} R, and {_number(thickness)} R are {_number(deep)} l* >= {DEEP:g}: all "
            "levels agree, and this one goes into any renderer",
        )
    if mirrors:
        return Advice("teleport-packed", 0, back)
    if thickness < THIN:
        return Advice(chain, 0, f"{thickness:.2g} R are less than {THIN:g}: neighbours show")
    if medium.packing_fraction > SPARSE:
        return Advice(
            chain,
            0,
            f"{_number(deep)} l* < {DEEP:g} and f = {medium.packing_fraction:g} > {SPARSE:g}: light comes through, and "
            "neighbours speed it by up to a tenth",
        )
    return Advice(
        "teleport",
        0,
        f"a pixel covers {footprint:.2g} R, {_number(thickness)} R are no less than {THIN:g}, f = "
        f"{medium.packing_fraction:g} <= {SPARSE:g}: neighbours do not matter",
    )


def _number(value: float) -> str:
    return "countless" if math.isinf(value) else f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
