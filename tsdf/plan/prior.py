"""Prior: what errors of levels are to be expected of a scene before anything is rendered.

From an atlas of slabs (reference_data/level_errors.csv), over mean cosine, packing fraction, thickness in transport
mean free paths and albedo; from how large grains look; and from where levels that know no single grains put the
boundary. It says how large an error is likely to be, within a factor, not its sign: a picture mixes light that is sent
back, of which a level may have too much, with light that is let through. Outside the atlas the factor grows, and that
is said.
"""

import csv
import math
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from tsdf.data.table import Table
from tsdf.picture.footprint import HALF, TEXTURE, footprints, texture
from tsdf.picture.media import spectra_of
from tsdf.picture.world import World, camera_of, mean_chord
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, free_path

FILE = "level_errors.csv"
LEAST = 0.003  # [1] that any level but explicit may be off by: packings differ, records are few
SPREAD = math.log(2.5)  # of the logarithm of an error about what is expected
THIN = 10.0  # [R] of spheres, whose texture `texture` is; that of thicker ones falls as one over thickness
DEEP = 0.25  # of it that is left at 40 R, and however thick: light comes from one side, and rims stay thin
FACETED = 1.6  # times the texture of spheres, of grains with facets, which flash
CLEAR = 1e-3  # co-albedo of a grain that stands for none in logarithms
BLURRED = 0.3  # share of the texture that packed spheres miss which answer from records; facets miss all
LEAST_SEEN = 0.05  # share of the picture that grains make, for their light falls on other things
FILLS = 0.5  # of the share of light that two grains' radii change, that a picture shows


class Points(NamedTuple):
    """The atlas: of each grain, in the order of their mean cosines (g,), at each packing fraction (f,), layer [R] (l,)
    and albedo (a,): transport mean free path [R] (g, f), and error of each level (g, f, l, a), nan where unknown."""

    mean_cosine: np.ndarray
    packing_fraction: np.ndarray
    layer: np.ndarray
    albedo: np.ndarray
    transport: np.ndarray
    error: dict[str, np.ndarray]


class Body(NamedTuple):
    """A medium as the prior sees it."""

    packing_fraction: float  # [1]
    transport: float  # l* of lossless grains [R]
    mean_cosine: float  # of one grain's deflection [1]
    albedo: float  # of one grain, by luminance [1]
    thickness: float  # [R]
    whole: bool = True  # whether bounding spheres lie wholly inside the boundary
    round: bool = True  # whether all grains are spheres, that look the same however they are turned


class Expected(NamedTuple):
    """An error that is expected of a level: root of bias and texture squared, over the mean of the picture."""

    bias: float
    texture: float
    spread: float  # of the logarithm
    known: bool  # whether the atlas covers it

    @property
    def floor(self) -> float:
        """What is left however long a picture is rendered [1]."""
        return math.hypot(self.bias, self.texture)


@lru_cache(maxsize=1)
def atlas() -> Points:
    """Return the shipped atlas."""
    path = resources.files("tsdf.reference_data") / FILE
    with path.open(encoding="utf-8") as file:
        read = list(csv.DictReader(line for line in file if not line.startswith("#")))
    rows: list[dict[str, Any]] = [
        {key: value if key in ("grain", "level") else float(value) for key, value in row.items()} for row in read
    ]
    cosines = {str(row["grain"]): float(row["mean_cosine"]) for row in rows}
    grains = sorted(cosines, key=lambda name: cosines[name])
    fractions, layers, albedos = (
        np.unique([row[key] for row in rows]) for key in ("packing_fraction", "layer", "albedo")
    )
    transport = np.full((len(grains), len(fractions)), math.nan)
    shape = (len(grains), len(fractions), len(layers), len(albedos))
    squares, counts = ({level: np.zeros(shape) for level in LEVELS} for _ in range(2))
    for row in rows:
        g, f = grains.index(str(row["grain"])), int(np.searchsorted(fractions, row["packing_fraction"]))
        transport[g, f] = row["transport"]
        at = (g, f, int(np.searchsorted(layers, row["layer"])), int(np.searchsorted(albedos, row["albedo"])))
        through = min(1.0, (1.0 - row["reflectance"]) / row["reflectance"])  # what little comes through counts little
        for name, weight in (("reflectance", 1.0), ("transmittance", through)):
            square = weight**2 * (row[f"{name}_deviation"] ** 2 - row[f"{name}_deviation_error"] ** 2)
            if math.isfinite(square):
                squares[str(row["level"])][at] += square
                counts[str(row["level"])][at] += 1.0
    with np.errstate(invalid="ignore"):  # noise goes out with the mean, so it is no error until all rows are in
        means = {level: squares[level] / counts[level] for level in LEVELS if level != "explicit"}
    error = {level: np.sqrt(np.maximum(mean, LEAST**2)) for level, mean in means.items()}
    return Points(np.array([cosines[g] for g in grains]), fractions, layers, albedos, transport, error)


def slab_error(level: str, body: Body, points: Points | None = None) -> tuple[float, bool]:
    """Return by how much a level is off in a slab like a body, over what comes back [1], and whether the atlas has it.

    Linear in mean cosine and packing fraction, and in the logarithms of thickness over l* and of co-albedo; beyond the
    atlas it is what it is at its edge, but for lossless grains in deeper layers: there it falls as the light that comes
    through, 1 / (1 + 3/4 thickness / l*).
    """
    p = points or atlas()
    if level == "explicit":
        return 0.0, True
    deep = math.log(max(body.thickness - 2.0 * body.whole, 0.1) / body.transport)
    dark = math.log(max(1.0 - body.albedo, CLEAR))
    darks = np.log(np.maximum(1.0 - p.albedo[::-1], CLEAR))
    by_grain = []
    for g in range(len(p.mean_cosine)):
        by_fraction = []
        for f in range(len(p.packing_fraction)):
            layers = np.log(p.layer / p.transport[g, f])
            by_albedo = [float(np.interp(deep, layers, p.error[level][g, f, :, a])) for a in range(len(p.albedo))]
            if deep > layers[-1]:
                by_albedo[-1] *= (1.0 + 0.75 * math.exp(layers[-1])) / (1.0 + 0.75 * math.exp(deep))
            there = np.isfinite(by_albedo[::-1])
            by_fraction.append(float(np.interp(dark, darks[there], np.array(by_albedo[::-1])[there])))
        by_grain.append(float(np.interp(body.packing_fraction, p.packing_fraction, by_fraction)))
    value = float(np.interp(body.mean_cosine, p.mean_cosine, by_grain))
    nearest = int(np.argmin(abs(p.mean_cosine - body.mean_cosine)))
    star = np.interp(body.packing_fraction, p.packing_fraction, p.transport[nearest])
    known = bool(
        0.5 * p.packing_fraction[0] <= body.packing_fraction <= p.packing_fraction[-1] + 0.05
        and p.mean_cosine[0] - 0.1 <= body.mean_cosine <= p.mean_cosine[-1] + 0.08
        and body.albedo >= p.albedo[0] - 0.1
        and body.thickness / body.transport >= 0.5 * p.layer[0] / star
    )
    return value, known


def expected(level: str, body: Body, footprint: float, coverage: float) -> Expected:
    """Return the error to be expected of a level.

    Parameters
    ----------
    level : str
    body : Body
    footprint : float
        What a pixel covers of the grains [R].
    coverage : float
        Share of the picture that shows them [1].
    """
    if level == "explicit":
        return Expected(0.0, 0.0, 0.0, True)
    traits = LEVELS[level].traits
    slab, known = slab_error(level, body)
    share = math.sqrt(coverage)
    if not traits.placed and body.whole:  # they fill the boundary to the brim
        optical = body.thickness / body.transport
        slab = math.hypot(slab, FILLS * 2.0 / body.transport / (optical + 4.0 / 3.0))
    grainy = float(texture(footprint)) * max(DEEP, min(1.0, THIN / body.thickness))
    if not body.round:
        grainy *= FACETED
    elif traits.answered:
        grainy *= BLURRED
    return Expected(coverage * slab, share * math.hypot(0.5 * slab, grainy), SPREAD if known else 2.0 * SPREAD, known)


def bodies(world: World, tables: Sequence[Table]) -> list[Body]:
    """Return the media of a world, whose components have these tables, as the prior sees them."""
    found, at = [], 0
    for medium, boundary in zip(world.scene.media, world.place.boundaries, strict=True):
        own = tables[at : at + len(medium.grains)]
        at += len(own)
        grains = [Component(table, grain.fraction) for grain, table in zip(medium.grains, own, strict=True)]
        path = free_path(grains, medium.packing_fraction)
        g = sum(p * table.mean_cosine() for p, table in zip(path.choice, own, strict=True))
        kept = 0.0
        for p, table, grain in zip(path.choice, own, medium.grains, strict=True):
            spectra = spectra_of(grain.absorption, world.scene.metres_per_unit)
            dark = spectra.grey(world.absorption.weight.T) * medium.radius
            kept += p * table.albedo(dark) / max(table.albedo(), 1e-12)
        transport = (path.lambda_beta + path.lambda_s) / max(1.0 - g, 1e-9)
        thickness = 0.5 * mean_chord(medium, boundary) / medium.radius
        spheres = all(table.header["grain"]["kind"] == "sphere" for table in own)
        found.append(Body(medium.packing_fraction, transport, g, kept, thickness, medium.inside == "grains", spheres))
    return found


def looks(world: World) -> tuple[float, float, float]:
    """Return how grains look: what a pixel covers of them [R], by the root of the mean of `texture` squared; what share
    of the picture sees any, not less than `LEAST_SEEN` where there are any [1]; and how many times as much texture as
    that mean the pixel has that covers least."""
    seen = footprints(world.scene, world.place, camera_of(world))
    there = np.isfinite(seen)
    if not there.any():
        return math.inf, LEAST_SEEN if world.scene.media else 0.0, 1.0
    rms = math.sqrt(float((texture(seen[there]) ** 2).mean()))
    most = float(texture(seen[there].min()))
    return HALF * (TEXTURE / rms - 1.0), max(float(there.mean()), LEAST_SEEN), most / rms
