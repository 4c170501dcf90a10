"""Packing table: gap laws of several packing fractions, made, kept in a file and looked up.

The file is laid down in ``schema/PACKING.md``; what a law is, and how one is gathered, is `gaps`.
"""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from tsdf.compiled import njit
from tsdf.data import container
from tsdf.data.container import Broken, Format
from tsdf.data.table import frozen, thawed
from tsdf.errors import UsageError
from tsdf.files import software
from tsdf.sampling import SOBOL, key_of, sobol
from tsdf.spheres.gaps import Law, Records, even, gather, mean_gap, measured, reduce, spread
from tsdf.spheres.packing import MAX, pack

FORMAT_VERSION = "1.0"
FRACTIONS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.62, 0.64)
SHIPPED = "packings.exr"  # in tsdf.reference_data
EVEN_TOLERANCE = 1e-3  # of the mean of entry_b2
GAP_TOLERANCE = 1e-4  # of the mean gap, relative
# code: (severity, rule). The set is closed; PACKING.md lists it.
CODES = container.rules("tsdf_packing", "tsdf-packing", "packing.schema.json") | {
    "MANIFEST_FRACTION_ORDER": ("error", "the fractions ascend"),
    "MANIFEST_ROWS": ("error", "each fraction begins at the row at which the one before it ends"),
    "MANIFEST_HEIGHT": ("error", "the rows of all fractions are as many as the image has"),
    "MANIFEST_WIDTH": ("error", "the image has as many columns as there are cells of exit_b2"),
    "MANIFEST_EDGES": ("error", "edge c of C cells is the double nearest to c / C"),
    "VALUE_NOT_FINITE": ("error", "every pixel is finite"),
    "VALUE_RANGE": ("error", "gap is not negative, entry_b2 lies in [0, 1] and azimuth in [0, pi]"),
    "VALUE_MEAN_GAP": ("error", "the mean gap of each fraction f is 4 (1 - f) / (3 f) within 1e-4 of it"),
    "VALUE_EVEN": ("error", "the mean entry_b2 of each fraction is 1/2 within 1e-3"),
}
_BITS = 8  # significant bits that are kept of a gap and an azimuth, 0.4 %: far less than what K records resolve


@dataclass(frozen=True, eq=False)
class PackingTable:
    """What comes next in packings of several fractions; immutable.

    Parameters
    ----------
    header : mapping
        The header of the file, see ``schema/packing.schema.json``.
    pixels : (rows, cells) float32
        Columns are equal cells of exit_b2, rows are the records: for each fraction all gap, then entry_b2, azimuth.
    """

    header: Mapping[str, Any]
    pixels: np.ndarray

    def __post_init__(self) -> None:
        pixels = np.array(self.pixels, dtype=np.float32, order="C")
        pixels.flags.writeable = False
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "header", frozen(self.header))

    def __repr__(self) -> str:
        number, high = len(self.fractions), self.fractions[-1]
        return f"PackingTable({number} fractions to {high:g}, {self.cells} cells of {self.records} records)"

    @property
    def fractions(self) -> tuple[float, ...]:
        """Return the tabulated fractions, ascending [1]."""
        return tuple(float(entry["fraction"]) for entry in self.header["fractions"])

    @property
    def cells(self) -> int:
        """Return how many cells of exit_b2 there are."""
        return int(self.pixels.shape[1])

    @property
    def records(self) -> int:
        """Return how many records each cell has."""
        return int(self.header["records"])

    def tabulated(self, index: int) -> Law:
        """Return the law of a tabulated fraction by its place among `fractions`."""
        first = self.header["fractions"][index]["first_row"]
        blocks = self.pixels[first : first + 3 * self.records].astype(np.float64).reshape(3, self.records, -1)
        blocks[2] = np.minimum(blocks[2], math.pi)  # float32 rounds pi up
        return Law(*(np.ascontiguousarray(block.T) for block in blocks))


def law(fraction: float, table: PackingTable | None = None) -> Law:
    """Return what comes next in a packing of any fraction.

    At a tabulated fraction this is what the table says. Between two, twice as many records are taken from both, in
    proportion to how near they are, their gaps stretched to the mean gap of the fraction. Below the least one the
    other is the limit of thin packings, where gaps are exponential and nothing depends on anything.

    Parameters
    ----------
    fraction : float
        Share of the volume that lies in spheres, in (0, 0.64] [1].
    table : PackingTable, optional
        The shipped one, where it is not given.

    Returns
    -------
    Law
        Arrays of (cells, k), k the records of the table or twice that.

    Raises
    ------
    UsageError
        For a fraction that is not in the table nor below what is.
    """
    table = table or shipped()
    known = table.fractions
    if not (0.0 < fraction <= known[-1]):
        raise UsageError(f"the packing fraction must be above 0 and at most {known[-1]:g}, got {fraction}")
    upper = int(np.searchsorted(known, fraction))
    if known[upper] == fraction:
        return table.tabulated(upper)
    high, below = known[upper], known[upper - 1] if upper else 0.0
    other = table.tabulated(upper - 1) if upper else thin(table.cells, table.records)
    gap_scale = mean_gap(below) if upper else 1.0
    k = 2 * table.records
    taken = round(k * (fraction - below) / (high - below))
    mine = _thinned(table.tabulated(upper), taken, 1.0 / mean_gap(high))
    mixed = [
        np.concatenate(pair, axis=1) for pair in zip(_thinned(other, k - taken, 1.0 / gap_scale), mine, strict=True)
    ]
    mixed[0] *= mean_gap(fraction) / mixed[0].mean()
    mixed[1] = even(mixed[1])
    return Law(*mixed)


def _thinned(all_of: Law, k: int, scale: float) -> Law:
    """Return a law of k records a cell, evenly chosen, so that records whose neighbours stay are dropped or doubled."""
    own = all_of.gap.shape[1]
    chosen = ((np.arange(k) + 0.5) * own / max(k, 1)).astype(np.int64)
    return Law(all_of.gap[:, chosen] * scale, all_of.entry_b2[:, chosen], all_of.azimuth[:, chosen])


@njit(cache=True)
def _points(n):
    """Return n points of the unit cube, (n, 3) float64."""
    u = np.empty((n, 3))
    for i in range(n):
        for axis in range(3):
            u[i, axis] = sobol(i, axis, np.uint32(key_of(0, axis, 0) >> np.uint64(32)), SOBOL)
    return u


def thin(cells: int, k: int) -> Law:
    """Return the law of the thinnest packings, its mean gap 1: a gap is exponential, the rest even, all independent.

    The records are consecutive points of a scrambled Sobol' sequence, so each cell and all of them are even.
    """
    u = _points(cells * k)
    order = np.lexsort((u[:, 0], np.repeat(np.arange(cells), k)))
    gap, entry, azimuth = u[order].T.reshape(3, cells, k)
    gap = -np.log1p(-gap)
    return Law(gap / gap.mean(), even(entry), math.pi * azimuth)


MOST_SPHERES = 10**6  # of a packing; that many are more than any table needs


def tabulate(
    fractions: Sequence[float] = FRACTIONS,
    packings: int = 4,
    spheres: int = 2000,
    lines: int = 15000,
    cells: int = 32,
    k: int = 256,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> PackingTable:
    """Return the table of several fractions; the same arguments give the same table.

    Parameters
    ----------
    fractions : sequence of float
        In (0, 0.64] [1], in any order.
    packings : int
        Packings of each fraction, 2 or more: the errors are what they differ by.
    spheres : int
        Spheres of each packing.
    lines : int
        Lines through each packing, each of about 32 gaps.
    cells, k : int
        Cells of exit_b2 and records of each.
    seed : int
        Seed: packing p of a fraction has seed + p.
    progress : callable, optional
        Called with each fraction once it is done.

    Raises
    ------
    UsageError
        For arguments out of range.
    """
    chosen = sorted(set(map(float, fractions)))
    if not chosen or not all(0.0 < f <= MAX for f in chosen):
        raise UsageError(f"the packing fractions of a table must be above 0 and at most {MAX}, got {fractions}")
    for name, value, low, high in (
        ("packings", packings, 2, 64),
        ("lines", lines, 1, 10**6),
        ("spheres", spheres, 64, MOST_SPHERES),
        ("cells", cells, 2, 1024),
        ("records", k, 2, 4096),
        ("seed", seed, 0, 2**63 - 65),
    ):
        if not low <= value <= high:
            raise UsageError(f"the {name} of a packing table must be {low} to {high}, got {value}")
    if len(chosen) * 3 * k > container.MAX_SIDE:
        raise UsageError(f"{len(chosen)} fractions of {k} records are more than a file can hold: give fewer --records")
    entries: list[dict[str, Any]] = []
    rows: list[np.ndarray] = []
    for f in chosen:
        entry, block = _tabulated(f, packings, spheres, lines, cells, k, seed)
        entries.append({"fraction": f, "first_row": 3 * k * len(rows), **entry})
        rows.append(block)
        if progress:
            progress(f)
    given = "" if tuple(chosen) == FRACTIONS else "".join(f" --fraction {f!r}" for f in chosen)
    header = {
        "format": "tsdf-packing",
        "format_version": FORMAT_VERSION,
        "required_features": [],
        "columns": {"quantity": "exit_b2", "edges": [c / cells for c in range(cells + 1)]},
        "records": k,
        "fractions": entries,
        "pixels_sha256": "0" * 64,
        "provenance": {
            "software": software(),
            "command": f"tsdf-packing{given} --packings {packings} --spheres {spheres} --lines {lines} --cells {cells} "
            f"--records {k} --seed {seed}",
            "packings": packings,
            "spheres": spheres,
            "lines": lines,
            "seed": seed,
        },
        "licence": "CC0-1.0",
    }
    return PackingTable(header, np.concatenate(rows))


def _tabulated(
    f: float, packings: int, spheres: int, lines: int, cells: int, k: int, seed: int
) -> tuple[dict[str, Any], np.ndarray]:
    """Return what the header says of a fraction, and its rows, (3 k, cells) float32."""

    def one(p: int) -> tuple[Records, dict[str, float]]:
        records = gather(pack(f, spheres, seed + p), lines, seed + p)
        return records, measured(records, f)

    with ThreadPoolExecutor(min(packings, os.cpu_count() or 1)) as pool:
        samples, each = zip(*pool.map(one, range(packings)), strict=True)
    records = Records(*map(np.concatenate, zip(*samples, strict=True)))
    gap, entry_b2, azimuth = reduce(records, cells, k, seed)
    gap *= mean_gap(f) / gap.mean()
    kept = Law(_rounded_gaps(gap), entry_b2, np.minimum(_rounded(azimuth, _BITS), math.pi))
    errors = {name: float(np.std([one[name] for one in each], ddof=1) / math.sqrt(packings)) for name in each[0]}
    entry = {"statistics": measured(records, f), "standard_errors": errors, "table_displacement": spread(kept)}
    return entry, np.concatenate([block.T for block in kept]).astype(np.float32)


def _rounded(values: np.ndarray, bits: int) -> np.ndarray:
    """Return numbers rounded to a few significant bits, which a file holds in less room."""
    mantissa, exponent = np.frexp(values)
    return np.ldexp(np.round(np.ldexp(mantissa, bits)), exponent - bits)


def _rounded_gaps(gap: np.ndarray) -> np.ndarray:
    """Return gaps with no more bits than their mean needs: of few records it is off by more than of many."""
    for bits in range(_BITS, 24):
        rounded = _rounded(gap, bits)
        if abs(rounded.mean() / gap.mean() - 1.0) < 0.5 * GAP_TOLERANCE:
            return rounded
    return gap


def read(path: str | os.PathLike[str]) -> PackingTable:
    """Return the packing table in a file.

    Raises
    ------
    FormatError
        If the file cannot be read or breaks a rule of PACKING.md; the message names file, rule and place.

    Warns
    -----
    FormatWarning
        If the file follows a newer minor version of the format.
    """
    return container.read(path, FORMAT)


def write(table: PackingTable, path: str | os.PathLike[str]) -> None:
    """Write a packing table; the same table gives the same bytes.

    Raises
    ------
    TSDFError
        If the table breaks a rule of PACKING.md or the file cannot be written; nothing is left behind.
    """
    container.write(thawed(table.header), table.pixels, path, FORMAT)


@cache
def shipped() -> PackingTable:
    """Return the packing table that comes with the package."""
    with resources.as_file(resources.files("tsdf.reference_data").joinpath(SHIPPED)) as path:
        return read(path)


def _broken_manifest(header: dict[str, Any], width: int, height: int, newer: bool) -> Broken:
    edges, rows = header["columns"]["edges"], 3 * header["records"]
    if len(edges) != width + 1:
        yield "MANIFEST_WIDTH", "/columns/edges", f"{len(edges)} edges for {width} columns"
    for c, edge in enumerate(edges):
        if edge != c / (len(edges) - 1):
            yield "MANIFEST_EDGES", f"/columns/edges/{c}", f"{edge} is not {c} / {len(edges) - 1}"
    before = 0.0
    for i, entry in enumerate(header["fractions"]):
        if not entry["fraction"] > before:
            yield "MANIFEST_FRACTION_ORDER", f"/fractions/{i}/fraction", f"{entry['fraction']} follows {before}"
        if entry["first_row"] != rows * i:
            what = f"it is {entry['first_row']}, but row {rows * i} is next"
            yield "MANIFEST_ROWS", f"/fractions/{i}/first_row", what
        before = entry["fraction"]
    if rows * len(header["fractions"]) != height:
        what = f"the fractions have {rows * len(header['fractions'])} rows, the image {height}"
        yield "MANIFEST_HEIGHT", "/fractions", what


def _broken_values(table: PackingTable) -> Broken:
    bad = ~np.isfinite(table.pixels)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        yield "VALUE_NOT_FINITE", f"row {row}, column {column}", f"not finite, here first of {np.count_nonzero(bad)}"
        return
    high = (math.inf, 1.0, float(np.float32(math.pi)))
    for entry in table.header["fractions"]:
        f, first, k = entry["fraction"], entry["first_row"], table.records
        blocks = table.pixels[first : first + 3 * k].reshape(3, k, -1)
        for i, name in enumerate(Law._fields):
            bad = (blocks[i] < 0.0) | (blocks[i] > high[i])
            if bad.any():
                row, column = np.argwhere(bad)[0]
                what = f"{name} out of range, here first of {np.count_nonzero(bad)}"
                yield "VALUE_RANGE", f"row {first + i * k + row}, column {column}", what
        gap, middle = blocks[0].mean(dtype=np.float64), blocks[1].mean(dtype=np.float64)
        if not abs(gap / mean_gap(f) - 1.0) <= GAP_TOLERANCE:
            what = f"the mean gap at {f} is {gap:.9g}, not {mean_gap(f):.9g}"
            yield "VALUE_MEAN_GAP", f"row {first}, column 0", what
        if not abs(middle - 0.5) <= EVEN_TOLERANCE:
            yield "VALUE_EVEN", f"row {first + k}, column 0", f"the mean entry_b2 at {f} is {middle:.9g}"


FORMAT = Format(
    name="tsdf-packing",
    version=FORMAT_VERSION,
    attribute="tsdf_packing",
    codes=CODES,
    schema="packing.schema.json",
    specification="PACKING.md",
    command="tsdf-packing",
    suffix=".exr",
    what="packing table",
    make=PackingTable,
    manifest=_broken_manifest,
    values=_broken_values,
)
