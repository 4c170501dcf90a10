"""Format of a table: reads and writes its bytes, ``name.tsdf.exr``, as ``schema/SPEC.md`` lays down.

What its header, its blocks and its pixels must be; the file around them, an OpenEXR image, is `container`. What a
table is stands in `table`; whether its numbers are plausible physics, in `validate`.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from tsdf.data import container
from tsdf.data import library as library_files
from tsdf.data.blocks import (
    BY_NAME,
    CONDITIONALS,
    FORMAT_VERSION,
    LONGEST,
    MEMORY_FIELDS,
    NAMES,
    RECORD_FIELDS,
    REQUIRED,
    Block,
    blocks_of,
    version_for,
)
from tsdf.data.container import Broken, Format
from tsdf.data.table import Table, thawed
from tsdf.errors import Finding, FormatError, TSDFError

# code: (severity, rule). The set is closed; SPEC.md lists it and `reference_data/golden` breaks each of them.
CODES = container.rules("tsdf", "tsdf", "header.schema.json") | {
    "HEADER_LEDGER": ("error", "energy launched is the exact sum of the other entries of the ledger"),
    "HEADER_STATISTICS": ("error", "hit_probability and albedo are those of the energy ledger within 1e-3 of them"),
    "MANIFEST_ROWS": ("error", "each block begins at the row at which the one before it ends"),
    "MANIFEST_DUPLICATE": ("error", "no block occurs twice"),
    "MANIFEST_UNKNOWN": ("error", "a file of version 1.0 or 1.1 has only the blocks of its version"),
    "MANIFEST_HEIGHT": ("error", "the rows of all blocks are as many as the image has"),
    "MANIFEST_MISSING": ("error", "p_theta, p_phi, p_r, p_z, p_l and mean_l are present"),
    "MANIFEST_ORDER": ("error", "the blocks stand in the order of the specification"),
    "MANIFEST_MEAN": ("error", "mean_l has as many rows as p_l"),
    "MANIFEST_RECORDS": (
        "error",
        "the six joint blocks are all present with the same number of rows, or all absent",
    ),
    "MANIFEST_MEMORY": (
        "error",
        "memory_hit and seven memory blocks with the same number of rows are all present, or all absent",
    ),
    "MANIFEST_WIDTH": ("error", "the image has as many columns as there are cells of cos theta"),
    "MANIFEST_EDGE_COUNT": ("error", "a block of masses has one edge more than rows"),
    "MANIFEST_EDGE_ENDS": ("error", "the edges of an axis span its whole range"),
    "MANIFEST_EDGE_ORDER": ("error", "edges ascend by 1e-30 or more, but by 0 in the cells that are atoms"),
    "VALUE_NOT_FINITE": ("error", "every pixel of a known block is finite"),
    "VALUE_NEGATIVE": ("error", "masses and means are not negative"),
    "VALUE_P_THETA_SUM": ("error", "p_theta sums to 1 within 1e-5"),
    "VALUE_COLUMN_SUM": (
        "error",
        "each conditional sums to 1 within 1e-5 in every column that p_theta can draw",
    ),
    "VALUE_EMPTY_COLUMN": ("error", "a column of which p_theta is 0 is 0 throughout"),
    "VALUE_MEAN_RANGE": ("error", "mean_l lies in its cell of p_l within 1e-6 of it, and is 0 where the mass is 0"),
    "VALUE_RECORD_RANGE": (
        "error",
        "records lie in their ranges within 1e-6; in the atoms of joint records entry_azimuth is 0",
    ),
    "VALUE_RECORD_ORDER": ("error", "the records of a column ascend in entry_b2"),
    "VALUE_RECORD_SPHERE": ("error", "entry and exit of every record lie on the bounding sphere within 2e-3"),
    "VALUE_MEMORY_HIT": ("error", "memory_hit is a probability"),
    "VALUE_MEMORY_CELL": ("error", "entry_b2 of every record by entry lies in the cell of its column within 1e-6"),
    "VALUE_MEMORY_EMPTY": ("error", "records by entry are 0 where memory_hit is"),
    "VALUE_STATISTICS": ("error", "atoms and means of the statistics are those of the blocks within 0.02"),
}

SUM_TOLERANCE = 1e-5  # of float32 masses summed in double
ROUNDING = 1e-6  # of means of l, relative, and of records: rounded to float32
LEDGER_TOLERANCE = 1e-3  # relative: a ledger may be kept in few units
STATISTICS_TOLERANCE = 0.02  # beyond what the cells allow: far more than a tracer errs, far less than matters to render
NARROWEST = 1e-30  # width of a cell, so that densities are finite even where subnormal numbers are taken for 0
SLAB = 2**18  # pixels that are looked at together: a file of some MB may hold 2^26
SPHERE_TOLERANCE = 2e-3  # [R^2] float32 loses sqrt(1 - b2) near grazing entry

Wrong = Callable[[np.ndarray, slice], np.ndarray]  # of rows of a block, (n, columns) float64, and which they are
Breach = Callable[[str, str, Wrong, str], Broken]  # code, block, where it is broken, what is wrong


def read(path: str | os.PathLike[str]) -> Table:
    """Return the table in a file, or the ready table of a name (`library.names`) that no file has.

    Raises
    ------
    FormatError
        If the file cannot be read or breaks a rule of SPEC.md; the message names file, rule and place.

    Warns
    -----
    FormatWarning
        If the file follows a newer minor version of the format.

    Examples
    --------
    >>> import tsdf
    >>> table = tsdf.read("cube.tsdf.exr")
    >>> table
    Table(cube, eta=1.31, 18 cells of cos theta)
    >>> round(table.mean_cosine(), 4)
    0.4737
    """
    return container.read(library_files.found(path), FORMAT)


def library(name: str) -> Table:
    """Return the ready table of a name, one of those docs/library.md lists, whatever files there are.

    Raises
    ------
    FormatError
        There is none of that name; the message names the nearest.

    Examples
    --------
    >>> import tsdf
    >>> tsdf.library("sugar")
    Table(cube, eta=1.55773, 130 cells of cos theta)
    """
    return container.read(library_files.ready(name) or name, FORMAT)


def check(path: str | os.PathLike[str]) -> list[Finding]:
    """Return the broken rules of a file, as many as can be told apart."""
    try:
        path = library_files.found(path)
    except FormatError as error:
        return [Finding(error.code, "error", error.pointer, error.reason)]
    return container.inspect_file(path, FORMAT)[1]


def inspect(data: bytes) -> tuple[Table | None, list[Finding]]:
    """Return the table that the bytes of a file hold, None if they break a rule, and the findings."""
    return container.inspect(data, FORMAT)


def get_ready() -> None:
    """Load what writing a table asks for: for a thread beside other work."""
    container.get_ready(FORMAT)


def write(table: Table, path: str | os.PathLike[str]) -> None:
    """Write a table; the same table gives the same bytes.

    A file that is at `path` already is replaced only once the new one is whole and valid.

    Raises
    ------
    TSDFError
        If the table breaks a rule of SPEC.md or the file cannot be written; nothing is left behind.

    Examples
    --------
    >>> import tsdf
    >>> table = tsdf.read("cube.tsdf.exr")
    >>> tsdf.write(table, "copy.tsdf.exr")
    >>> tsdf.read("copy.tsdf.exr").header == table.header
    True
    """
    header = thawed(table.header)
    blocks = header.get("blocks")
    names = [str(block.get("name")) for block in blocks if isinstance(block, dict)] if isinstance(blocks, list) else []
    if header.get("format_version") != version_for(names):
        version = container.shown(repr(header.get("format_version")))
        raise TSDFError(
            f"cannot write {container.shown(path)}: format_version is {version}, that of its blocks is "
            f"{version_for(names)}"
        )
    container.write(header, table.pixels, path, FORMAT)


def _broken_manifest(header: Mapping[str, Any], width: int, height: int, newer: bool) -> Broken:
    """Rules of the header that the schema cannot state, (code, place, message)."""
    yield from _broken_ledger(header)
    yield from _broken_rows(header, height, newer)
    yield from _broken_groups(header)
    yield from _broken_axes(header, width)


def _broken_ledger(header: Mapping[str, Any]) -> Broken:
    ledger = header["energy_ledger"]
    parts = sum(ledger[key] for key in ("unscattered", "scattered", "absorbed", "truncated", "lost"))
    if ledger["launched"] != parts:
        message = f"launched is {ledger['launched']}, the others sum to {parts}"
        yield "HEADER_LEDGER", "/energy_ledger/launched", message
    met = ledger["launched"] - ledger["unscattered"]
    for name, part, whole in (("hit_probability", met, ledger["launched"]), ("albedo", ledger["scattered"], met)):
        stated = float(header["statistics"][name]) * float(whole)
        if not abs(stated - float(part)) <= LEDGER_TOLERANCE * stated or part <= 0:
            message = f"{name} is {header['statistics'][name]:.9g}, but of {whole} units of energy it is {part}"
            yield "HEADER_STATISTICS", f"/statistics/{name}", message


def _known(header: Mapping[str, Any]) -> list[str]:
    """Return the names of a file's blocks that its version has and this reads, in the order of the file."""
    allowed = blocks_of(header["format_version"])
    return [block["name"] for block in header["blocks"] if block["name"] in allowed]


def _broken_rows(header: Mapping[str, Any], height: int, newer: bool) -> Broken:
    """Rules of the blocks as the file stacks them, one by one; where it follows a newer minor version, any name will
    do."""
    known, names = _known(header), [block["name"] for block in header["blocks"]]
    row = 0
    for i, block in enumerate(header["blocks"]):
        first, name, place = block["first_row"], block["name"], f"/blocks/{i}"
        if first != row:
            yield "MANIFEST_ROWS", f"{place}/first_row", f"it is {first}, but row {row} is next"
        row = first + block["rows"]
        if names.index(name) < i:
            yield "MANIFEST_DUPLICATE", f"{place}/name", f"a second block {name}"
        if name not in known and not newer:
            yield "MANIFEST_UNKNOWN", f"{place}/name", f"version {header['format_version']} has no block {name}"
    if row != height:
        yield "MANIFEST_HEIGHT", "/blocks", f"the blocks have {row} rows, the image {height}"


def _broken_groups(header: Mapping[str, Any]) -> Broken:
    """Rules of which blocks are there, in which order, and which have as many rows as others."""
    known, rows = _known(header), {block["name"]: block["rows"] for block in header["blocks"]}
    if missing := [name for name in REQUIRED if name not in rows]:
        yield "MANIFEST_MISSING", "/blocks", f"there is no block {', '.join(missing)}"
    if known != sorted(known, key=NAMES.index):
        yield "MANIFEST_ORDER", "/blocks", "the blocks are not in the order of the specification"
    if len({rows[name] for name in ("p_l", "mean_l") if name in rows}) > 1:
        yield "MANIFEST_MEAN", "/blocks", "mean_l has not as many rows as p_l"
    joint, entry = (
        [rows[name] for name in (f"{group}_{field}" for field in fields) if name in known]
        for group, fields in (("joint", RECORD_FIELDS), ("memory", MEMORY_FIELDS))
    )
    if joint and (len(joint) < len(RECORD_FIELDS) or len(set(joint)) > 1):
        yield "MANIFEST_RECORDS", "/blocks", "the joint blocks are not six of equal length"
    hit = "memory_hit" in known
    if (hit or entry) and (len(entry) < len(MEMORY_FIELDS) or len(set(entry)) > 1):
        yield "MANIFEST_MEMORY", "/blocks", "the memory blocks of records are not seven of equal length"
    elif entry and not hit:
        yield "MANIFEST_MEMORY", "/blocks", "there are records by entry, but no block memory_hit"


def _broken_axes(header: Mapping[str, Any], width: int) -> Broken:
    """Rules of the edges of cells, columns first."""
    edges = header["columns"]["edges"]
    if len(edges) != width + 1:
        yield "MANIFEST_WIDTH", "/columns/edges", f"{len(edges)} edges for {width} columns"
    whole = edges[0] == -1.0 and edges[-1] == 1.0
    yield from _broken_edges("/columns/edges", edges, (0, len(edges) - 2), whole)
    for i, block in enumerate(header["blocks"]):
        name, place = block["name"], f"/blocks/{i}/edges"
        if name not in CONDITIONALS:
            continue
        edges = block["edges"]
        if len(edges) != block["rows"] + 1:
            yield "MANIFEST_EDGE_COUNT", place, f"{len(edges)} edges for {block['rows']} rows"
        yield from _broken_edges(place, edges, (0,) if name == "p_l" else (), _whole(name, edges[0], edges[-1]))


def _whole(name: str, first: float, last: float) -> bool:
    """Return whether the cells of a block of masses cover its axis; azimuths do in one turn that holds 0."""
    if name == "p_phi":
        return -math.pi <= first <= 0.0 and abs(last - first - 2.0 * math.pi) <= 1e-9
    axis = BY_NAME[name].axis
    assert axis is not None
    return first == axis[0] and (last == axis[1] or math.isinf(axis[1]))


def _broken_edges(place: str, edges: Sequence[float], atoms: tuple[int, ...], whole: bool) -> Broken:
    if not whole:
        yield "MANIFEST_EDGE_ENDS", place, f"{edges[0]} to {edges[-1]} is not the range of this axis"
    for i, (low, high) in enumerate(pairwise(edges)):
        if (low != high) if i in atoms else not (high - low >= NARROWEST):
            kind = "zero" if i in atoms else f"{NARROWEST:g} or more"
            yield "MANIFEST_EDGE_ORDER", f"{place}/{i + 1}", f"the width of {low} to {high} is not {kind}"


def _slabs(rows: int, columns: int) -> Iterator[slice]:
    """Return the rows of a block in parts of at most about `SLAB` pixels."""
    step = max(1, SLAB // columns)
    return (slice(first, min(first + step, rows)) for first in range(0, rows, step))


def _nothing(pixels: np.ndarray) -> np.ndarray:
    """Return which float32 are 0 by their bits: renderers tell their processor to take subnormal numbers for 0 too."""
    return (pixels.view(np.uint32) << 1) == 0


def _broken_values(table: Table) -> Broken:
    """Rules of the pixels, (code, place of the first breach, message); not finite ones hide all others."""
    blocks = [block for block in table.header["blocks"] if block["name"] in BY_NAME]
    first_row = {block["name"]: block["first_row"] for block in blocks}

    def breach(code: str, name: str, wrong: Wrong, what: str) -> Broken:
        block, count, place = table.block(name), 0, ""
        for rows in _slabs(*block.shape):
            bad = wrong(block[rows].astype(np.float64), rows)
            if bad.any():
                row, column = np.argwhere(bad)[0]
                place = place or f"row {first_row[name] + rows.start + row}, column {column}"
                count += int(np.count_nonzero(bad))
        if count:
            yield code, place, f"{name}: {what}, here first of {count}"

    infinite = False
    for name in first_row:
        for found in breach("VALUE_NOT_FINITE", name, lambda values, _: ~np.isfinite(values), "not finite"):
            infinite = True
            yield found
    if infinite:
        return
    for name in REQUIRED:
        yield from breach("VALUE_NEGATIVE", name, lambda values, _: values < 0.0, "negative")
    p_theta = table.p_theta
    if abs(p_theta.sum() - 1.0) > SUM_TOLERANCE:
        message = f"p_theta sums to {p_theta.sum():.9g}"
        yield "VALUE_P_THETA_SUM", f"row {first_row['p_theta']}, column 0", message
    empty = _nothing(table.block("p_theta")[0])
    for name in CONDITIONALS:
        sums = np.zeros(len(p_theta))
        for row in table.block(name):
            sums += row
        off = (np.abs(sums - 1.0) > SUM_TOLERANCE) & ~empty

        def uneven(values: np.ndarray, rows: slice, off: np.ndarray = off) -> np.ndarray:
            return off & (np.arange(rows.start, rows.stop) == 0)[:, None]

        yield from breach("VALUE_COLUMN_SUM", name, uneven, "the column does not sum to 1")
    for name in (name for name in first_row if BY_NAME[name].group != "memory"):
        yield from breach(
            "VALUE_EMPTY_COLUMN", name, lambda values, _: (values != 0.0) & empty, "not 0 though p_theta is"
        )

    edges = table.edges("p_l")
    upper = np.append(edges[1:-1], LONGEST)  # the last cell holds all longer paths too

    def outside(values: np.ndarray, rows: slice) -> np.ndarray:
        low, high = edges[:-1][rows, None], upper[rows, None]
        strays = (values * (1.0 + ROUNDING) < low) | (values * (1.0 - ROUNDING) > high)
        return np.where(_nothing(table.p_l[rows]), values != 0.0, strays)

    yield from breach("VALUE_MEAN_RANGE", "mean_l", outside, "outside its cell or of no mass")
    if joint := table.joint:
        atoms = np.zeros(p_theta.shape, dtype=bool)
        atoms[[0, -1]] = True
        yield from _broken_records("joint", joint, atoms, breach)
    if memory := table.memory:
        hit = table.hit
        yield from breach("VALUE_MEMORY_HIT", "memory_hit", lambda v, _: (v < 0.0) | (v > 1.0), "not a probability")
        yield from _broken_records("memory", memory, np.zeros(hit.shape, dtype=bool), breach)
        cell = np.arange(len(hit)) / len(hit)
        low, high = cell - ROUNDING, cell + 1.0 / len(hit) + ROUNDING

        def strays(values: np.ndarray, _: slice) -> np.ndarray:
            return ((values < low) | (values > high)) & (hit != 0.0)

        yield from breach("VALUE_MEMORY_CELL", "memory_entry_b2", strays, "not of this column's cell")
        for field in memory:
            yield from breach(
                "VALUE_MEMORY_EMPTY",
                f"memory_{field}",
                lambda values, _: (values != 0.0) & (hit == 0.0),
                "not 0 though memory_hit is",
            )
    yield from _broken_statistics(table)


def _broken_records(kind: str, records: Mapping[str, np.ndarray], atoms: np.ndarray, breach: Breach) -> Broken:
    """Rules of the records of either kind; `atoms` are the columns in which entry_azimuth must be 0, (columns,)."""
    for field in records:
        block = BY_NAME[f"{kind}_{field}"]

        def outside(values: np.ndarray, _: slice, block: Block = block) -> np.ndarray:
            bad = (values < block.low - ROUNDING) | (values > block.high + ROUNDING)
            return bad | (atoms & (values != 0.0)) if block.field == "entry_azimuth" else bad

        yield from breach("VALUE_RECORD_RANGE", block.name, outside, "out of range")

    def falling(values: np.ndarray, rows: slice) -> np.ndarray:
        before = records["entry_b2"][max(rows.start - 1, 0) : rows.stop - 1]
        bad = np.zeros(values.shape, dtype=bool)
        bad[len(values) - len(before) :] = values[len(values) - len(before) :] < before
        return bad

    yield from breach("VALUE_RECORD_ORDER", f"{kind}_entry_b2", falling, "smaller than the one before")

    def off(r: np.ndarray, rows: slice) -> np.ndarray:
        z, phi_delta, b2, azimuth = (
            records[field][rows].astype(np.float64) for field in ("z", "phi_delta", "entry_b2", "entry_azimuth")
        )
        b2 = np.clip(b2, 0.0, 1.0)
        # With d_in along z and x_i at azimuth 0, phi_d is entry_azimuth and phi_p is phi_delta + phi_d.
        across = r**2 + 2.0 * r * np.sqrt(b2) * np.cos(phi_delta + azimuth)
        return np.abs(across + z**2 - 2.0 * z * np.sqrt(1.0 - b2)) > SPHERE_TOLERANCE

    yield from breach("VALUE_RECORD_SPHERE", f"{kind}_r", off, "the exit is off the bounding sphere")


def _broken_statistics(table: Table) -> Broken:
    """Statistics that the masses of the cells do not allow, whatever lies where in a cell."""
    p, edges = table.p_theta, table.cos_theta_edges
    bounds = {"atom_backward": (p[0], p[0]), "atom_forward": (p[-1], p[-1])}
    bounds["mean_cosine"] = (edges[:-1] @ p, edges[1:] @ p)
    for name, block in (("mean_r", "p_r"), ("mean_z", "p_z")):
        edges, share = table.edges(block), np.array([row @ p for row in table.block(block)])
        bounds[name] = (edges[:-1] @ share, edges[1:] @ share)
    cells = zip(table.p_l, table.block("mean_l").astype(np.float64), strict=True)
    length = math.fsum(float((mass * mean) @ p) for mass, mean in cells)
    bounds["mean_path_length"] = (length, length)
    for name, (low, high) in bounds.items():
        slack = STATISTICS_TOLERANCE * (max(1.0, length) if name == "mean_path_length" else 1.0)
        if not low - slack <= table.statistics[name] <= high + slack:
            message = f"{name} is {table.statistics[name]:.9g}, the blocks allow {low:.9g} to {high:.9g}"
            yield "VALUE_STATISTICS", f"/statistics/{name}", message


FORMAT = Format(
    name="tsdf",
    version=FORMAT_VERSION,
    attribute="tsdf",
    codes=CODES,
    schema="header.schema.json",
    specification="SPEC.md",
    command="tsdf-build",
    suffix=".tsdf.exr",
    what="TSDF",
    make=Table,
    manifest=_broken_manifest,
    values=_broken_values,
)
