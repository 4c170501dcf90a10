"""Table: the response of one grain, as the rows and columns of ``schema/SPEC.md``.

A `Table` is the pixels of the file and its header, both read-only, and nothing else: what can be derived from them
is derived here. How a table is made is `scatterometer`, its bytes are `format`. Lengths are in units of the bounding
radius R, angles in radians, absorption is the dimensionless product sigma_a R.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from tsdf.data.blocks import MEMORY_FIELDS, RECORD_FIELDS
from tsdf.errors import UsageError


def frozen(value: Any) -> Any:
    """Return `value` with every mapping and sequence in it made read-only."""
    if isinstance(value, Mapping):
        return MappingProxyType({key: frozen(item) for key, item in value.items()})
    if isinstance(value, list | tuple):
        return tuple(frozen(item) for item in value)
    return value


def thawed(value: Any) -> Any:
    """Return `value` as the plain dicts and lists that ``json`` writes; the inverse of `frozen`."""
    if isinstance(value, Mapping):
        return {key: thawed(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [thawed(item) for item in value]
    return value


class Measured(NamedTuple):
    """A number and its standard error, 0 where it is exact."""

    value: float
    error: float


@dataclass(frozen=True, eq=False)
class Table:
    """The scattering of one grain; immutable.

    Parameters
    ----------
    header : mapping
        The header of the file, see ``schema/header.schema.json``.
    pixels : (rows, columns) float32
        Columns are cells of cos theta in ascending order, rows are stacked blocks as ``header["blocks"]`` lists them.
        An array that can be written to is copied.

    Examples
    --------
    >>> import tsdf
    >>> table = tsdf.read("cube.tsdf.exr")
    >>> table.p_theta.shape, float(table.p_theta[-1])  # the last column is the atom of light that goes straight on
    ((18,), 0.32733437418937683)
    >>> round(table.albedo(0.1), 4)  # of a grain whose sigma_a times R is 0.1
    0.8808
    """

    header: Mapping[str, Any]
    pixels: np.ndarray

    def __post_init__(self) -> None:
        pixels = np.asarray(self.pixels, dtype=np.float32, order="C")
        if pixels.flags.writeable:  # a large file is not held twice
            pixels = pixels.copy()
            pixels.flags.writeable = False
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "header", frozen(self.header))

    def __repr__(self) -> str:
        grain, eta = self.header["grain"]["name"], self.header["optics"]["eta"]
        return f"Table({grain}, eta={eta:g}, {self.pixels.shape[1]} cells of cos theta)"

    def __contains__(self, name: str) -> bool:
        return any(block["name"] == name for block in self.header["blocks"])

    def _entry(self, name: str) -> Mapping[str, Any]:
        for block in self.header["blocks"]:
            if block["name"] == name:
                return block
        raise UsageError(
            f"the table has no block {name!r}; it has {', '.join(b['name'] for b in self.header['blocks'])}"
        )

    def block(self, name: str) -> np.ndarray:
        """Return the rows of one block, (rows, columns) float32, read-only."""
        entry = self._entry(name)
        return self.pixels[entry["first_row"] : entry["first_row"] + entry["rows"]]

    def edges(self, name: str) -> np.ndarray:
        """Return the cell edges of the axis of a mass block, (rows + 1,) float64 in the block's unit."""
        return np.array(self._entry(name)["edges"], dtype=np.float64)

    @property
    def cos_theta_edges(self) -> np.ndarray:
        """Edges of the columns, (columns + 1,) float64 ascending from -1 to 1; a zero-width cell is an atom."""
        return np.array(self.header["columns"]["edges"], dtype=np.float64)

    @property
    def p_theta(self) -> np.ndarray:
        """Probability mass of each column, (columns,) float64; sums to 1."""
        return self.block("p_theta")[0].astype(np.float64)

    @property
    def p_phi(self) -> np.ndarray:
        """Mass of each cell of phi_Delta given the column, (rows, columns) float32; columns sum to 1."""
        return self.block("p_phi")

    @property
    def p_r(self) -> np.ndarray:
        """Mass of each cell of r given the column, (rows, columns) float32; columns sum to 1."""
        return self.block("p_r")

    @property
    def p_z(self) -> np.ndarray:
        """Mass of each cell of z given the column, (rows, columns) float32; columns sum to 1."""
        return self.block("p_z")

    @property
    def p_l(self) -> np.ndarray:
        """Mass of each cell of the path length given the column, (rows, columns) float32; columns sum to 1."""
        return self.block("p_l")

    @property
    def joint(self) -> dict[str, np.ndarray]:
        """The joint records by field, each (K, columns) float32; empty where the table holds none."""
        return {f: self.block(f"joint_{f}") for f in RECORD_FIELDS if f"joint_{f}" in self}

    @property
    def memory(self) -> dict[str, np.ndarray]:
        """The records by entry by field, each (K, columns) float32; empty where the table holds none.

        Column c of C is the cell c/C to (c + 1)/C of entry_b2, not of cos theta.
        """
        return {f: self.block(f"memory_{f}") for f in MEMORY_FIELDS if f"memory_{f}" in self}

    @property
    def hit(self) -> np.ndarray:
        """Share of the rays of each cell of entry_b2 that meet the grain, (columns,) float64 in [0, 1].

        It needs records by entry.
        """
        return self.block("memory_hit")[0].astype(np.float64)

    @property
    def statistics(self) -> Mapping[str, Any]:
        """The statistics of the lossless grain as the header states them."""
        return self.header["statistics"]

    def survival(self, absorption_times_radius: float) -> np.ndarray:
        """Return the share of each column's light that an absorbing grain lets out, (columns,) float64 in [0, 1].

        Parameters
        ----------
        absorption_times_radius : float
            sigma_a R, the absorption coefficient times the bounding radius [1], >= 0.
        """
        if not (absorption_times_radius >= 0.0):
            raise UsageError(
                f"absorption must be a number >= 0 (sigma_a times the bounding radius), got {absorption_times_radius}"
            )
        if absorption_times_radius == 0.0:
            return np.ones(self.pixels.shape[1])
        share = np.zeros(self.pixels.shape[1])
        with np.errstate(under="ignore"):
            for mass, length in zip(self.p_l, self.block("mean_l"), strict=True):  # row by row: blocks may be large
                share += mass * np.exp(-min(absorption_times_radius, 1e30) * length.astype(np.float64))
        return share

    def deflection_masses(self, absorption_times_radius: float = 0.0) -> np.ndarray:
        """Return the deflection distribution of what an absorbing grain lets out, (columns,) float64, sum 1.

        Zero everywhere where nothing is let out.
        """
        masses = self.p_theta * self.survival(absorption_times_radius)
        total = masses.sum()
        return masses / total if total > 0.0 else masses

    def albedo(self, absorption_times_radius: float = 0.0) -> float:
        """Return the energy that leaves over the energy that met the grain (physics: E[exp(-sigma_a R l)])."""
        p = self.p_theta
        return float(self.statistics["albedo"] * (p @ self.survival(absorption_times_radius)) / p.sum())

    def mean_cosine(self, absorption_times_radius: float = 0.0) -> float:
        """Return the energy-weighted mean of cos theta of what an absorbing grain lets out, in [-1, 1].

        The lossless value is the header's own, which the cell width does not touch; absorption shifts it by the
        change of the masses between cells. Not a number where nothing is let out.
        """
        lossless = min(max(float(self.statistics["mean_cosine"]), -1.0), 1.0)
        if absorption_times_radius == 0.0:
            return lossless
        masses = self.deflection_masses(absorption_times_radius)
        if not masses.any():
            return math.nan
        edges = self.cos_theta_edges
        middle = 0.5 * (edges[1:] + edges[:-1])
        return min(max(float(lossless + middle @ (masses - self.deflection_masses())), -1.0), 1.0)

    # --- in others' words, with standard errors; docs/glossary.md -----------------------------------------------------

    @property
    def projected_area(self) -> Measured:
        """Mean area A of the grain's shadow over all directions [R^2]: hit_probability pi."""
        return self._scaled("hit_probability", math.pi)

    @property
    def effective_radius(self) -> Measured:
        """3 V / (4 A), A the projected area [R]."""
        area, error = self.projected_area
        radius = 0.75 * float(self.header["grain"]["volume"]) / area
        return Measured(radius, radius * error / area)

    @property
    def absorption_enhancement(self) -> Measured:
        """B = <l> A / V [1]: how much longer light is in the material than in a grain that does not refract."""
        (area, area_error), (length, length_error) = self.projected_area, self._scaled("mean_path_length", 1.0)
        b = length * area / float(self.header["grain"]["volume"])
        return Measured(b, b * math.hypot(area_error / area, length_error / length if length > 0.0 else 0.0))

    @property
    def dark_share(self) -> Measured:
        """Share of the directions inside, over the volume, that outside light cannot reach [1]: 1 - B / eta^2."""
        (b, error), square = self.absorption_enhancement, float(self.header["optics"]["eta"]) ** 2
        return Measured(1.0 - b / square, error / square)

    def single_scattering_albedo(self, absorption_times_radius: float = 0.0) -> Measured:
        """Return the share w of the light that met the grain and is not absorbed in it [1], without diffraction.

        It is `albedo` over that of the lossless grain: what the tracer dropped is no absorption. Its error is that of
        mean_path_length, by the variances of the path length and of what it leaves.
        """
        if absorption_times_radius == 0.0:
            return Measured(1.0, 0.0)
        p = self.p_theta / self.p_theta.sum()
        kept, squares = (float(p @ self.survival(by * absorption_times_radius)) for by in (1.0, 2.0))
        variance = self._path_variance()
        error = float(self.header["standard_errors"]["mean_path_length"])
        if not variance > 0.0:
            return Measured(kept, absorption_times_radius * kept * error)
        return Measured(kept, error * math.sqrt(max(0.0, squares - kept * kept) / variance))

    def asymmetry_factor(self, absorption_times_radius: float = 0.0) -> Measured:
        """Return the mean cosine g of geometrical optics, `mean_cosine`; its error by the energy that is left [1]."""
        g = self.mean_cosine(absorption_times_radius)
        p = self.p_theta / self.p_theta.sum()
        edges = self.cos_theta_edges
        middle = 0.5 * (edges[1:] + edges[:-1])
        error = float(self.header["standard_errors"]["mean_cosine"])
        lossless = self.mean_cosine()
        spread = float(p @ (middle - lossless) ** 2)
        if math.isnan(g) or not spread > 0.0:
            return Measured(g, error)
        kept, squares = (self.survival(by * absorption_times_radius) for by in (1.0, 2.0))
        left = float((p * squares) @ (middle - g) ** 2) / float(p @ kept) ** 2
        return Measured(g, error * math.sqrt(left / spread))

    def asymmetry_factor_far_field(self, absorption_times_radius: float = 0.0) -> Measured:
        """Return the mean cosine with diffraction, as large as the shadow and straight on [1]: (1 + w g) / (1 + w).

        The extinction efficiency is then 2 and the single-scattering albedo (1 + w) / 2.
        """
        (w, w_error), (g, g_error) = (
            self.single_scattering_albedo(absorption_times_radius),
            self.asymmetry_factor(absorption_times_radius),
        )
        if math.isnan(g):  # all that is left is diffracted
            return Measured(1.0, 0.0)
        error = math.hypot(w * g_error / (1.0 + w), (1.0 - g) * w_error / (1.0 + w) ** 2)
        return Measured((1.0 + w * g) / (1.0 + w), error)

    def _scaled(self, name: str, by: float) -> Measured:
        """Return one of the statistics times a factor."""
        return Measured(by * float(self.statistics[name]), by * float(self.header["standard_errors"][name]))

    def _path_variance(self) -> float:
        """Return the variance of the path length, by the cells [R^2]."""
        p = self.p_theta / self.p_theta.sum()
        lengths = self.block("mean_l").astype(np.float64)
        mean, square = (float(p @ (self.p_l * lengths**power).sum(axis=0)) for power in (1, 2))
        return max(0.0, square - mean * mean)
