"""Medium of grains: the free path between them, and the parameters of the homogeneous medium that stands for them.

The statistics of a table and the packing fraction of the bounding spheres go in, lengths in scene units come out.
What one grain does to light is `table`, the packed grains themselves are `packing`, walks through the medium are not
here either. The gaps between grains are taken as exponential, as [1] does after Dixmier.

[1] Meng, Papas, Habel, Dachsbacher, Marschner, Gross & Jarosz 2015, doi:10.1145/2766949
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tsdf.data.table import Table
from tsdf.errors import UsageError

MAX_PACKING_FRACTION = 0.74  # [1] equal spheres fill at most pi/sqrt(18) = 0.7405 of space


@dataclass(frozen=True)
class Component:
    """One kind of grain in a mixture.

    Raises
    ------
    UsageError
        For a fraction that is negative or not finite, and for a radius that is not finite and > 0.
    """

    table: Table
    fraction: float = 1.0  # share of the number of grains [1], normalised over the mixture
    radius: float = 1.0  # bounding radius R [scene unit]

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction < math.inf:
            raise UsageError(f"the number fraction of a grain must be a finite number >= 0, not {self.fraction:g}")
        if not 0.0 < self.radius < math.inf:
            raise UsageError(f"the bounding radius of a grain must be a finite number > 0, not {self.radius:g}")


@dataclass(frozen=True)
class FreePath:
    """How far light travels between grains, and through them; lengths in scene units [1]."""

    lambda_b: float  # mean gap between bounding spheres
    lambda_delta: float  # mean chord through the bounding spheres whose grain is missed; 0 where none is
    lambda_beta: float  # mean free path from leaving one grain to meeting the next
    lambda_s: float  # mean advance z in a grain, over the grains met
    hit_probability: float  # share of the bounding spheres entered whose grain is met [1]
    choice: tuple[float, ...]  # probability that the next grain met is of each component; sums to 1

    @property
    def sigma_t(self) -> float:
        """Extinction coefficient of point scattering by lossless grains, 1 / (lambda_beta + lambda_s) [1/unit]."""
        return 1.0 / (self.lambda_beta + self.lambda_s)


@dataclass(frozen=True)
class VolumeParameters:
    """The homogeneous medium of point scatterers (VPT) that stands for the grains [1].

    Coefficients in 1/scene unit.
    """

    sigma_t: float  # extinction, 1 / (lambda_beta + alpha_s lambda_s)
    albedo: float  # single-scattering albedo alpha_s [1]
    g: float  # energy-weighted mean cosine of the deflection [1]; not a number where no light leaves a grain

    @property
    def sigma_s(self) -> float:
        """Scattering coefficient."""
        return self.albedo * self.sigma_t

    @property
    def sigma_a(self) -> float:
        """Absorption coefficient of the medium, (1 - albedo) sigma_t; >= 0 even if albedo is 1 and a rounding error."""
        return max(0.0, 1.0 - self.albedo) * self.sigma_t

    @property
    def sigma_s_reduced(self) -> float:
        """Reduced scattering coefficient sigma_s (1 - g), of similarity theory; 0 where no light leaves a grain."""
        return self.sigma_s * (1.0 - self.g) if self.albedo > 0.0 else 0.0

    @property
    def transport_mean_free_path(self) -> float:
        """Length 1 / (sigma_a + sigma_s (1 - g)) [scene unit]; infinite where nothing deflects or absorbs."""
        reduced = self.sigma_a + self.sigma_s_reduced
        return 1.0 / reduced if reduced > 0.0 else math.inf


def free_path(components: Sequence[Component], packing_fraction: float) -> FreePath:
    """Return the free path in a mixture of grains [1].

    With number averages <.>, lambda_b = 4 (1 - f) <R^3> / (3 f <R^2>), the mean chord 4 V/S of the gaps, and
    lambda_beta = lambda_b + (lambda_b + lambda_delta) (1 - beta) / beta: each grain missed costs its bounding sphere
    and another gap. A line meets bounding spheres in proportion to n R^2 and grains in proportion to n R^2 beta.

    Parameters
    ----------
    components : sequence of Component
        At least one.
    packing_fraction : float
        Share f of the volume that lies in bounding spheres [1], in (0, 0.74].

    Raises
    ------
    UsageError
        For an empty mixture, fractions that sum to 0, a packing fraction out of range, and one at which the mean
        advance in grains, if negative, outweighs the gaps.

    Examples
    --------
    >>> import tsdf
    >>> path = free_path([Component(tsdf.read("cube.tsdf.exr"), radius=0.001)], 0.5)
    >>> f"{path.lambda_b:.6f} {path.hit_probability:.2f}"  # the gap between bounding spheres is 4/3 R at f = 1/2
    '0.001333 0.64'
    """
    if not 0.0 < packing_fraction <= MAX_PACKING_FRACTION:
        raise UsageError(
            f"the packing fraction must be > 0 and <= {MAX_PACKING_FRACTION:g}, not {packing_fraction:g}: it is the "
            "share of the volume in bounding spheres, and equal spheres fill at most pi/sqrt(18) = 0.7405"
        )
    # Largest first, so that no power of a radius or sum of fractions leaves the range of floats
    largest = max((c.radius for c in components if c.fraction > 0.0), default=0.0)
    most = max((c.fraction for c in components), default=0.0)
    if not most > 0.0:
        raise UsageError("a medium needs at least one grain with a number fraction > 0")
    spheres = [c.fraction / most * (c.radius / largest) ** 2 if c.fraction else 0.0 for c in components]
    hits = [w * c.table.statistics["hit_probability"] for w, c in zip(spheres, components, strict=True)]
    misses = [w - h for w, h in zip(spheres, hits, strict=True)]
    met, missed = math.fsum(hits), math.fsum(misses)
    if not met > 0.0:
        raise UsageError("no ray ever meets a grain: hit_probability is 0 in every table of the medium")
    mean_radius = _mean(spheres, [c.radius for c in components])  # <R^3> / <R^2>
    lambda_b = 4.0 * (1.0 - packing_fraction) / (3.0 * packing_fraction) * mean_radius
    chords = [c.table.statistics["mean_miss_chord"] * c.radius for c in components]
    lambda_delta = _mean(misses, chords) if missed > 0.0 else 0.0
    lambda_beta = lambda_b + (lambda_b + lambda_delta) * missed / met
    lambda_s = _mean(hits, _advances(components))
    if not lambda_beta + lambda_s > 0.0:
        raise UsageError(
            f"at a packing fraction of {packing_fraction:g} light would go back farther in grains (mean z "
            f"{lambda_s:.3g}) than on between them ({lambda_beta:.3g}): take a lower one, or build the table again"
        )
    return FreePath(
        lambda_b=lambda_b,
        lambda_delta=lambda_delta,
        lambda_beta=lambda_beta,
        lambda_s=lambda_s,
        hit_probability=met / math.fsum(spheres),
        choice=tuple(h / met for h in hits),
    )


def volume_parameters(
    components: Sequence[Component], packing_fraction: float, absorption: Sequence[float] | None = None
) -> VolumeParameters:
    """Return the medium of point scatterers that stands for a mixture of grains [1].

    sigma_t = 1 / (lambda_beta + alpha_s lambda_s): a point scatterer does not move light, so the advance in the grain
    is part of the free path, with the energy that makes it. g and lambda_s are means over the scattered energy.

    Parameters
    ----------
    components, packing_fraction
        As for `free_path`.
    absorption : sequence of float, optional
        Absorption coefficient sigma_a of the material of each component [1/scene unit], >= 0; none by default. It
        changes albedo and g; the mean advance of what is left is taken as that of the lossless grain.

    Raises
    ------
    UsageError
        As for `free_path`, and for an absorption that is negative, not finite or not one number per component.

    Examples
    --------
    >>> import tsdf
    >>> medium = volume_parameters([Component(tsdf.read("cube.tsdf.exr"), radius=0.001)], 0.5, absorption=[0.1])
    >>> f"{medium.sigma_t:.0f} {medium.albedo:.5f} {medium.g:.3f}"
    '247 0.99987 0.474'
    """
    path = free_path(components, packing_fraction)
    sigma_a = [0.0] * len(components) if absorption is None else [float(a) for a in absorption]
    if len(sigma_a) != len(components):
        raise UsageError(f"absorption needs one number per grain, {len(components)} in all, not {len(sigma_a)}")
    if not all(0.0 <= a < math.inf for a in sigma_a):
        raise UsageError(f"absorption must be finite numbers >= 0 [1/unit], not {sigma_a}")
    products = [a * c.radius for a, c in zip(sigma_a, components, strict=True)]
    albedos = [c.table.albedo(x) for c, x in zip(components, products, strict=True)]
    energies = [p * a for p, a in zip(path.choice, albedos, strict=True)]
    albedo = math.fsum(energies)
    advance = math.fsum(e * z for e, z in zip(energies, _advances(components), strict=True))
    cosines = [c.table.mean_cosine(x) for c, x in zip(components, products, strict=True)]
    return VolumeParameters(
        sigma_t=1.0 / (path.lambda_beta + advance),
        albedo=albedo,
        g=_mean(energies, cosines) if albedo > 0.0 else math.nan,
    )


def _advances(components: Sequence[Component]) -> list[float]:
    """Return the mean advance z in a grain of each component [scene unit]."""
    return [c.table.statistics["mean_z"] * c.radius for c in components]


def _mean(weights: Sequence[float], values: Sequence[float]) -> float:
    """Return the weighted mean, in which what has no weight has no say, not even as a NaN."""
    total = math.fsum(weights)
    return math.fsum(w / total * v for w, v in zip(weights, values, strict=True) if w > 0.0)
