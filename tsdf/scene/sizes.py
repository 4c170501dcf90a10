"""Sizes and densities in everybody's words: what a bounding radius and a packing fraction are to others, and back.

`convert` is the one way from words to numbers, whoever asks: scenes, commands, loaders. docs/sizes.md defines words.
Lengths in here are in units of the bounding radius R or in scene units, densities in kg/m^3. Of a mixture the grains
have one R; volumes, surfaces and projected areas are means over the number of grains, dimensions those of the largest.
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.scene.medium import MAX_PACKING_FRACTION, Component, volume_parameters

BALL = 4.0 * math.pi / 3.0  # [R^3] volume of the bounding sphere
DENSEST_RANDOM = 0.64  # [1] packing fraction of equal spheres thrown together, beyond which nobody can pack them

# Words for how large grains are: (what follows, unit); and for how much of space is filled
SIZES = {
    "radius": "bounding radius R [unit]",
    "effective_radius": "3 V / (4 projected area) [unit]",
    "volume_radius": "radius of the sphere of the same volume [unit]",
    "maximum_dimension": "greatest distance between two points [unit]",
    "sieve": "width of the square mesh that the grain just passes [unit]",
    "ssa": "specific surface area, surface over mass [m^2/kg]",
}
AMOUNTS = {
    "packing_fraction": "share of space in bounding spheres [1]",
    "solid_fraction": "share of space in the grains' material [1]",
    "density": "mass of grains over the volume they take up [kg/m^3]",
}
MATERIAL_DENSITY = "material_density"  # [kg/m^3] of the grains' solid material
WORDS = (*SIZES, *AMOUNTS, MATERIAL_DENSITY)

DENSITIES = {  # [kg/m^3]
    "ice": 917.0,  # 0 C; as Picard & Libois 2024 (TARTES) and Flanner et al. 2021 (SNICAR) take it
    "water": 998.2,  # 20 C, IAPWS-95
    "quartz": 2648.0,  # alpha quartz, CRC Handbook of Chemistry and Physics
    "salt": 2165.0,  # NaCl, CRC Handbook
    "glass": 2510.0,  # Schott N-BK7, catalogue 2017-01-20
    "sucrose": 1580.5,  # CRC Handbook
}


@dataclass(frozen=True)
class GrainSizes:
    """One grain, or the mean of a mixture, in units of its bounding radius R."""

    volume: float  # of material [R^3]
    area: float  # of surface [R^2]
    projected_area: float  # of its shadow, mean over directions [R^2]
    maximum_dimension: float | None  # [R]; None where a table does not say
    sieve: float | None  # [R]; None where a table does not say
    material_density: float | None = None  # [kg/m^3]; None where no material is named
    name: str = "the grain"

    @property
    def solid_share(self) -> float:
        """Share of the bounding sphere that is material [1]."""
        return self.volume / BALL

    @property
    def effective_radius(self) -> float:
        """3 V / (4 A), A the projected area [R]; of a convex grain 3 V / S."""
        return 0.75 * self.volume / self.projected_area

    @property
    def volume_radius(self) -> float:
        """Radius of the sphere of the same volume [R]."""
        return self.solid_share ** (1.0 / 3.0)


@dataclass(frozen=True)
class InWords:
    """Packed grains in our words, radius and packing fraction, and in the others'.

    Attributes
    ----------
    sizes : GrainSizes
    packing_fraction : float or None
        Share of space in bounding spheres [1]; None where only a size was said.
    radius : float
        Bounding radius R [unit].
    metres_per_unit : float or None
        Length of the unit of `radius` [m], None where unknown.
    """

    sizes: GrainSizes
    packing_fraction: float | None
    radius: float
    metres_per_unit: float | None = None

    @property
    def solid_fraction(self) -> float | None:
        """Share of space in the grains' material [1]."""
        return None if self.packing_fraction is None else self.packing_fraction * self.sizes.solid_share

    @property
    def density(self) -> float | None:
        """Mass over volume [kg/m^3]; None where the material's is unknown."""
        solid, share = self.sizes.material_density, self.solid_fraction
        return None if solid is None or share is None else solid * share

    @property
    def ssa(self) -> float | None:
        """Specific surface area [m^2/kg]; None without the material's density or the length of the unit."""
        solid = self.sizes.material_density
        if solid is None or self.metres_per_unit is None:
            return None
        return self.sizes.area / (self.sizes.volume * solid * self.radius * self.metres_per_unit)

    def facts(self) -> dict[str, float | None]:
        """Return all words of `SIZES` and `AMOUNTS`, lengths in scene units; None for what is unknown."""
        r, s = self.radius, self.sizes
        return {
            "radius": r,
            "effective_radius": s.effective_radius * r,
            "volume_radius": s.volume_radius * r,
            "maximum_dimension": None if s.maximum_dimension is None else s.maximum_dimension * r,
            "sieve": None if s.sieve is None else s.sieve * r,
            "ssa": self.ssa,
            "packing_fraction": self.packing_fraction,
            "solid_fraction": self.solid_fraction,
            "density": self.density,
            MATERIAL_DENSITY: s.material_density,
        }

    def summary(self) -> str:
        """Return both sides on one line: ours, then theirs."""
        said = {name: f"{value:.4g}" for name, value in self.facts().items() if value is not None}
        units = {"ssa": " m2/kg", "density": " kg/m3", MATERIAL_DENSITY: " kg/m3"}
        told = [f"{name} {value}{units.get(name, '')}" for name, value in said.items()]
        ours = [w for w in told if w.split()[0] in ("radius", "packing_fraction")]
        return f"{', '.join(ours)} = {', '.join(w for w in told if w not in ours)}"

    @property
    def fraction(self) -> float:
        """The packing fraction, where one was said [1]."""
        assert self.packing_fraction is not None
        return self.packing_fraction


def grain_sizes(grains: Sequence[tuple[Table, float]], material_density: float | None = None) -> GrainSizes:
    """Return the sizes of a grain or of a mixture of grains of one bounding radius.

    Parameters
    ----------
    grains : sequence of (Table, float)
        Tables, each with its share of the number of grains [1], not normalised.
    material_density : float, optional
        Of the solid material [kg/m^3]; by default that of the material each table names, where `DENSITIES` has it.

    Raises
    ------
    UsageError
        If there is no grain with a share above 0.
    """
    present = [(table, share) for table, share in grains if share > 0.0]
    total = math.fsum(share for _, share in present)
    if not 0.0 < total < math.inf:
        raise UsageError("a medium needs at least one grain with a number fraction > 0")

    def mean(values: Sequence[float]) -> float:
        return math.fsum(share / total * value for (_, share), value in zip(present, values, strict=True))

    volumes = [float(table.header["grain"]["volume"]) for table, _ in present]
    volume = mean(volumes)
    if material_density is None:
        solids = [DENSITIES.get(table.header["optics"]["material"] or "") for table, _ in present]
        known = [solid for solid in solids if solid is not None]
        if len(known) == len(solids):
            material_density = mean([v * solid for v, solid in zip(volumes, known, strict=True)]) / volume

    def largest(key: str, least: float) -> float | None:
        shapes = [table.header["grain"] for table, _ in present]
        found = [2.0 if shape["kind"] == "sphere" else shape.get(f"x_{key}") for shape in shapes]
        numbers = [x for x in found if isinstance(x, int | float) and not isinstance(x, bool) and least <= x <= 2.0001]
        return max(numbers) if len(numbers) == len(found) else None

    return GrainSizes(
        volume=volume,
        area=mean([float(table.header["grain"]["area"]) for table, _ in present]),
        projected_area=mean([math.pi * table.statistics["hit_probability"] for table, _ in present]),
        maximum_dimension=largest("maximum_dimension", 1.6329),  # sqrt(8/3), by Jung's theorem
        sieve=largest("sieve", 1e-6),
        material_density=material_density,
        name=" and ".join(dict.fromkeys(str(table.header["grain"]["name"]) for table, _ in present)),
    )


def convert(
    grains: Sequence[tuple[Table, float]],
    said: Mapping[str, float],
    metres_per_unit: float | None = None,
    amount_needed: bool = True,
    packed: bool = True,
) -> InWords:
    """Return bounding radius and packing fraction of grains of which somebody says size and amount in any words.

    Parameters
    ----------
    grains : sequence of (Table, float)
        As for `grain_sizes`.
    said : mapping
        At most one word of `SIZES` (radius 1 if none), exactly one of `AMOUNTS`, and `MATERIAL_DENSITY` where it is
        needed and the table names no material; numbers > 0.
    metres_per_unit : float, optional
        Length of the scene unit [m]; only ssa needs it.
    amount_needed : bool
        Whether one of `AMOUNTS` must be there.
    packed : bool
        Whether bounding spheres are to be packed; if not, any solid fraction up to 1 is taken, and the packing fraction
        may be more than spheres can have.

    Raises
    ------
    UsageError
        In one line: for no such words or two of a kind, for what the table or the caller does not say, and, if
        spheres are to be packed, for solid fractions and densities at which they cannot be (`DENSEST_RANDOM`), with
        the way out.
    """
    check_words(said, amount_needed)
    sizes = grain_sizes(grains, said.get(MATERIAL_DENSITY))
    size = next((word for word in SIZES if word in said), None)
    radius = 1.0 if size is None else _radius(sizes, size, said[size], metres_per_unit)
    if size not in (None, "radius") and not 1e-30 <= radius <= 1e30:
        raise UsageError(f"{size} {said[str(size)]:g} makes a bounding radius of {radius:g} units: out of range")
    amount = next((word for word in AMOUNTS if word in said), None)
    if amount is None:
        return InWords(sizes, None, radius, metres_per_unit)
    fraction = said[amount]
    if amount == "packing_fraction":
        if not fraction <= MAX_PACKING_FRACTION:
            raise UsageError(f"the packing fraction must be at most {MAX_PACKING_FRACTION:g}, not {fraction:g}")
        return InWords(sizes, fraction, radius, metres_per_unit)
    solid = fraction
    if amount == "density":
        solid = fraction / _known_density(sizes, amount)
        if not solid <= 1.0:
            raise UsageError(
                f"density {fraction:g} kg/m3 is more than that of the material, {sizes.material_density:g} kg/m3; "
                "say less, or another material_density"
            )
    if not solid <= 1.0:
        raise UsageError(f"solid_fraction is a share of space, at most 1, not {solid:g}")
    if packed and solid / sizes.solid_share > DENSEST_RANDOM:
        raise UsageError(_too_dense(grains, sizes, amount, fraction, solid / sizes.solid_share))
    return InWords(sizes, solid / sizes.solid_share, radius, metres_per_unit)


def check_words(said: Mapping[str, float], amount_needed: bool = True) -> None:
    """Refuse what no table could make sense of: two words of a kind, no amount, numbers that are not > 0.

    Raises
    ------
    UsageError
        In one line.
    """
    for word, value in said.items():
        if word not in WORDS:
            near = difflib.get_close_matches(str(word), WORDS, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise UsageError(f"unknown size or amount {word!r}; {hint}there are {', '.join(WORDS)}")
        if not 0.0 < value < math.inf:
            raise UsageError(f"{word} must be a finite number > 0, not {value:g}")
    for kind, words in (("size", SIZES), ("amount", AMOUNTS)):
        given = [word for word in words if word in said]
        if len(given) > 1:
            raise UsageError(f"{' and '.join(given)} each say the {kind} of grains: give one")
    if amount_needed and not any(word in said for word in AMOUNTS):
        raise UsageError(f"how much of space is filled is missing: give one of {', '.join(AMOUNTS)}")


def _radius(sizes: GrainSizes, size: str, value: float, metres_per_unit: float | None) -> float:
    """Return the bounding radius of grains of which a size has a value [unit]."""
    if size == "radius":
        return value
    if size == "ssa":
        if metres_per_unit is None:
            raise UsageError("ssa is per kg and in metres: say how long the scene unit is (metres_per_unit, --unit)")
        if not 0.0 < metres_per_unit < math.inf:
            raise UsageError(f"metres_per_unit must be a finite number > 0, not {metres_per_unit:g}")
        return sizes.area / (sizes.volume * _known_density(sizes, size) * value * metres_per_unit)
    across = getattr(sizes, size)
    if across is None:
        raise UsageError(
            f"{size}: the table of {sizes.name} does not say it; build it again with this version, or give one of "
            "radius, effective_radius, volume_radius"
        )
    return value / float(across)


def _known_density(sizes: GrainSizes, word: str) -> float:
    if sizes.material_density is None:
        raise UsageError(
            f"{word} needs the density of the material, and the table of {sizes.name} names none that is known "
            f"({', '.join(DENSITIES)}): say {MATERIAL_DENSITY} [kg/m3] too"
        )
    return sizes.material_density


def unpackable(sizes: GrainSizes, amount: str, value: float, wanted: float) -> str:
    """Return what an amount of grains would take whose bounding spheres cannot be packed so, as the part of a line."""
    most = InWords(sizes, DENSEST_RANDOM, 1.0)
    densest = most.solid_fraction if amount == "solid_fraction" else most.density
    unit = " kg/m3" if amount == "density" else ""
    return (
        f"{amount} {value:g}{unit} of {sizes.name} would take a packing fraction of {wanted:.3g}: the grain fills "
        f"{sizes.solid_share:.3g} of its bounding sphere, and spheres thrown together at most {DENSEST_RANDOM:g} of "
        f"space, which is {amount} {densest:.3g}{unit}"
    )


def _too_dense(
    grains: Sequence[tuple[Table, float]], sizes: GrainSizes, amount: str, value: float, wanted: float
) -> str:
    """Return one line on grains whose bounding spheres cannot be packed so: what it would take, and the way out.

    Mean free paths fall as 1/density: a void and a grain together are V / (A solid_fraction) long in the mean.
    """
    path = volume_parameters([Component(table, share) for table, share in grains], DENSEST_RANDOM)
    longer = wanted / DENSEST_RANDOM
    return (
        f"{unpackable(sizes, amount, value, wanted)}. Say packing_fraction = {DENSEST_RANDOM:g}: its transport mean "
        f"free path, {path.transport_mean_free_path:.3g} R, is about {longer:.3g} times that of this {amount}; the "
        f"same grains in a body {longer:.3g} times as thick make up for it, and grains {1.0 / longer:.3g} times as "
        "large where absorption is said by colour or over R (that of a material is per length: keep their size)"
    )
