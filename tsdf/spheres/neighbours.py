"""What comes next along a straight line through a packing: its packing table, made, kept and looked up.

Where a line leaves a bounding sphere, with n_o the outward normal and d the direction, its obliquity is the squared
impact parameter b_o^2 = 1 - (n_o . d)^2. What comes next is a record: the gap to the next sphere, the squared impact
parameter b_i^2 of its entry, and psi, the azimuth about d between the tangential parts of the exit's and the entry's
normal, in [0, pi], for its sign is random. This is a property of the packing alone, whatever stands in its spheres.
Lengths are in units of the bounding radius R. The file that holds such tables is laid down in ``schema/PACKING.md``;
how light uses them is `memory`.
"""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.data import container
from tsdf.data.container import Broken, Format
from tsdf.data.table import frozen, thawed
from tsdf.errors import UsageError
from tsdf.make.estimate import software
from tsdf.sampling import SOBOL, key_of, mix, sobol, unit
from tsdf.spheres.packing import MAX, Packing, cells_of, next_sphere, pack
from tsdf.vectors import cross, dot, step

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

_PER_LINE = 32  # mean distances of spheres that a line is long
_JUDGED = 32  # cells of exit_b2 by which all records of a sample are judged
_BITS = 8  # significant bits that are kept of a gap and an azimuth, 0.4 %: far less than what K records resolve


class Records(NamedTuple):
    """What comes next, seen along many lines; arrays of (n,) float64.

    The exits lie evenly: exit_b2 is uniform in [0, 1], whatever the packing.
    """

    exit_b2: np.ndarray  # squared impact parameter of the exit, in [0, 1] [R^2]
    gap: np.ndarray  # way to the next sphere, >= 0 [R]
    entry_b2: np.ndarray  # squared impact parameter of the entry there, in [0, 1] [R^2]
    azimuth: np.ndarray  # between the sides of exit and entry, in [0, pi] [rad]


class Law(NamedTuple):
    """What comes next by the obliquity of the exit; arrays of (cells, k) float64.

    Row c is of exits with exit_b2 in [c / cells, (c + 1) / cells), and its k records are equally likely.
    """

    gap: np.ndarray  # [R]
    entry_b2: np.ndarray  # [R^2]
    azimuth: np.ndarray  # [rad]


def mean_gap(fraction: float) -> float:
    """Return the mean gap lambda_b between spheres along a line, exact for any packing [R]."""
    return 4.0 * (1.0 - fraction) / (3.0 * fraction)


# ------------------------------------------------------------------------------------------ making


@njit(cache=True, nogil=True)
def _walk(cells, length, first, last, seed, out):
    """Write the gaps that begin on lines `first` to `last`, and return how many there are, written or not.

    Counting what begins on a piece of fixed length of an endless line gives every gap of the packing the same chance.
    """
    n = 0
    for line in range(first, last):
        key = key_of(seed, line, 0)
        z = 2.0 * unit(key) - 1.0
        azimuth = 2.0 * math.pi * unit(mix(key + np.uint64(1)))
        rho = math.sqrt(max(0.0, 1.0 - z * z))
        d = (rho * math.cos(azimuth), rho * math.sin(azimuth), z)
        p = (
            cells.side * unit(mix(key + np.uint64(2))),
            cells.side * unit(mix(key + np.uint64(3))),
            cells.side * unit(mix(key + np.uint64(4))),
        )
        p = step(p, -2.0, d)  # no sphere that is left on the line is entered before
        t, left, side, b2 = 0.0, -math.inf, (0.0, 0.0, 0.0), 0.0
        while True:
            t, i, j, k, sphere = next_sphere(cells, p, d, t, math.inf)
            if sphere < 0:
                break
            centre = (
                cells.centres[sphere, 0] + cells.side * i,
                cells.centres[sphere, 1] + cells.side * j,
                cells.centres[sphere, 2] + cells.side * k,
            )
            normal = step(step(p, t, d), -1.0, centre)
            cosine = -dot(normal, d)
            new = step(normal, cosine, d)
            new_b2 = min(dot(new, new), 1.0)
            if left >= 2.0:
                if n < len(out):
                    turn = cross(side, new)
                    out[n, 0], out[n, 1], out[n, 2] = b2, max(t - left, 0.0), new_b2
                    out[n, 3] = math.atan2(math.sqrt(dot(turn, turn)), dot(side, new))
                n += 1
            side, b2, left = new, new_b2, t + 2.0 * cosine
            if left >= length + 2.0:
                break
    return n


def gather(packing: Packing, lines: int, seed: int) -> Records:
    """Return what comes next along random lines through a packing; the same arguments give the same numbers.

    Each gap between two spheres is one record along the line and one against it.

    Parameters
    ----------
    packing : Packing
    lines : int
        Lines, each 32 mean distances between spheres long.
    seed : int
        Seed, in [0, 2^64).
    """
    cells, length = cells_of(packing), _PER_LINE * 4.0 / (3.0 * packing.fraction)
    out = np.empty((int(1.1 * _PER_LINE * lines) + 1000, 4))
    n = _walk(cells, length, 0, lines, np.uint64(seed), out)
    if n > len(out):
        out = np.empty((n, 4))
        _walk(cells, length, 0, lines, np.uint64(seed), out)
    exit_b2, gap, entry_b2, azimuth = out[:n].T
    return Records(
        np.concatenate([exit_b2, entry_b2]),
        np.concatenate([gap, gap]),
        np.concatenate([entry_b2, exit_b2]),
        np.concatenate([azimuth, azimuth]),
    )


def _cell(b2: np.ndarray, cells: int) -> np.ndarray:
    """Return the number of the cell of equal width that squared impact parameters lie in."""
    return np.minimum((b2 * cells).astype(np.int64), cells - 1)


def _leaves(coordinates: np.ndarray, order: np.ndarray, leaves: int, axis: int) -> list[np.ndarray]:
    """Return a partition of the records `order` into `leaves` parts of the same size, nearly: a k-d tree of medians."""
    if leaves == 1:
        return [order]
    half = leaves // 2
    at = len(order) * half // leaves
    order = order[np.argpartition(coordinates[axis, order], at)]
    axis = (axis + 1) % len(coordinates)
    return _leaves(coordinates, order[:at], half, axis) + _leaves(coordinates, order[at:], leaves - half, axis)


def reduce(records: Records, cells: int, k: int, seed: int = 0) -> Law:
    """Return a law of few records that stands for many.

    The records of each cell of `exit_b2` are parted into k groups of neighbours in (gap, entry_b2, azimuth), and one
    is drawn from each. Then what is known exactly is made exact: the mean gap of each cell is that of all its records,
    and `entry_b2` is as even as that of all lines is.

    Parameters
    ----------
    records : Records
    cells, k : int
        Shape of the law.
    seed : int
        Seed of the draws.
    """
    generator = np.random.Generator(np.random.PCG64([seed, cells, k]))
    cell = _cell(records.exit_b2, cells)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(cells + 1))
    if np.diff(first).min() < k:
        raise UsageError(f"{len(cell)} records are too few for {cells} cells of {k}; take more lines")
    values = np.array([records.gap, records.entry_b2, records.azimuth])
    kept = np.empty((3, cells, k))
    for c in range(cells):
        own = values[:, order[first[c] : first[c + 1]]]
        groups = _leaves(own, np.arange(own.shape[1]), k, 0)
        u = generator.random(k)
        chosen = np.array([group[int(u[i] * len(group))] for i, group in enumerate(groups)])
        kept[:, c] = own[:, chosen]
        kept[0, c] *= own[0].mean() / kept[0, c].mean()
    kept[1] = _even(kept[1])
    return Law(*kept)


# ------------------------------------------------------------------------------------------ judging


def spread(law: Law, eta: float = 1.31) -> float:
    """Return the mean squared displacement per event that a law gives to light in a packing of clear spheres [R^2].

    The exact sum over all events, no random walk: a sphere turns light in the plane of its entry and lets it out as
    obliquely as it let it in, so that the mean displacement to come depends on the cell of the exit alone, and solves
    a linear equation. In that plane, with the real axis along the side of the entry and the imaginary one along d, the
    entry's normal is m = b - i c, the exit's after p chords of central angle g is m e^(ipg), and the plane itself has
    turned by m^2 e^(ipg). Reflectance is that of unpolarised light at every hit.

    Parameters
    ----------
    law : Law
    eta : float
        Refractive index inside over outside, >= 1 [1].
    """
    cells, k = law.gap.shape
    s, b2, azimuth = (values.ravel() for values in law)
    b, c = np.sqrt(b2), np.sqrt(1.0 - b2)
    refracted = np.sqrt(1.0 - b2 / eta**2)
    reflectance = 0.5 * (
        ((c - eta * refracted) / (c + eta * refracted)) ** 2 + ((eta * c - refracted) / (eta * c + refracted)) ** 2
    )
    m, chord = b - 1j * c, np.exp(1j * (math.pi - 2.0 * np.arcsin(b / eta)))
    turned = reflectance + (1.0 - reflectance) ** 2 * chord / (1.0 - reflectance * chord)  # mean of e^(ipg)
    here, there, cosine = np.repeat(np.arange(cells), k), _cell(b2, cells), np.cos(azimuth)
    shift, turn = 1j * s + m * turned - m, m * m * turned
    # V = rest + matrix V for V = (along the side, along d) of every cell; the other side of psi cancels what is across
    rest = np.concatenate([np.bincount(here, cosine * shift.real, cells), np.bincount(here, shift.imag, cells)]) / k
    pair = here * cells + there
    parts = (cosine * turn.real, -cosine * turn.imag, turn.imag, turn.real)
    tt, td, dt, dd = (np.bincount(pair, part / k, cells * cells).reshape(cells, cells) for part in parts)
    matrix = np.block([[tt, td], [dt, dd]])
    to_come = np.linalg.solve(np.eye(2 * cells) - matrix, rest)
    ahead = to_come[:cells] + 1j * to_come[cells:]
    square = s * s + 2.0 - 2.0 * turned.real + 2.0 * s * (m * (turned - 1.0)).imag
    with_next = ((-1j * s - m.conj()) * turn + m) * ahead[there]
    each = np.bincount(here, square + 2.0 * with_next.real, cells) / k
    return float(_stationary(here, there, cells, k) @ each)


def _stationary(here: np.ndarray, there: np.ndarray, cells: int, k: int) -> np.ndarray:
    """Return how often each cell is left through in the long run, (cells,), sum 1."""
    share = np.bincount(there * cells + here, np.full(len(here), 1.0 / k), cells * cells)
    passing = share.reshape(cells, cells) - np.eye(cells)
    passing[-1] = 1.0
    return np.linalg.solve(passing, np.eye(cells)[-1])


def measured(records: Records, fraction: float) -> dict[str, float]:
    """Return what the header of a table says of all the records of a fraction, as ``PACKING.md`` defines it."""
    gap = records.gap * (mean_gap(fraction) / records.gap.mean())
    tangents = np.sqrt(records.exit_b2 * records.entry_b2) * np.cos(records.azimuth)
    return {
        "gap_second_moment": float((gap**2).mean() / (2.0 * mean_gap(fraction) ** 2)),
        "tangent_correlation": float(tangents.mean()),
        "entry_correlation": float(np.corrcoef(records.exit_b2, records.entry_b2)[0, 1]),
        "displacement": spread(_whole(records._replace(gap=gap), _JUDGED)),
    }


def _whole(records: Records, cells: int) -> Law:
    """Return the law of all records, but for those that some cells have more than the one that has the fewest."""
    cell = _cell(records.exit_b2, cells)
    order, number = np.argsort(cell, kind="stable"), np.bincount(cell, minlength=cells)
    chosen = order[(np.cumsum(number) - number)[:, None] + np.arange(number.min())]
    return Law(records.gap[chosen], records.entry_b2[chosen], records.azimuth[chosen])


# ------------------------------------------------------------------------------------------ the table


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
    mixed[1] = _even(mixed[1])
    return Law(*mixed)


def _thinned(all_of: Law, k: int, scale: float) -> Law:
    """Return a law of k records a cell, evenly chosen, so that records whose neighbours stay are dropped or doubled."""
    own = all_of.gap.shape[1]
    chosen = ((np.arange(k) + 0.5) * own / max(k, 1)).astype(np.int64)
    return Law(all_of.gap[:, chosen] * scale, all_of.entry_b2[:, chosen], all_of.azimuth[:, chosen])


def _even(values: np.ndarray) -> np.ndarray:
    """Return numbers in the same order that are spread evenly over [0, 1]."""
    rank = np.empty(values.size)
    rank[np.argsort(values, axis=None, kind="stable")] = np.arange(values.size)
    return ((rank + 0.5) / values.size).reshape(values.shape)


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
    return Law(gap / gap.mean(), _even(entry), math.pi * azimuth)


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


# ------------------------------------------------------------------------------------------ the file


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
        gap, even = blocks[0].mean(dtype=np.float64), blocks[1].mean(dtype=np.float64)
        if not abs(gap / mean_gap(f) - 1.0) <= GAP_TOLERANCE:
            what = f"the mean gap at {f} is {gap:.9g}, not {mean_gap(f):.9g}"
            yield "VALUE_MEAN_GAP", f"row {first}, column 0", what
        if not abs(even - 0.5) <= EVEN_TOLERANCE:
            yield "VALUE_EVEN", f"row {first + k}, column 0", f"the mean entry_b2 at {f} is {even:.9g}"


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
