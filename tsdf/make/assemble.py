"""Assembling a table: header and blocks from what was estimated of a grain.

`traced_table` makes a `Table` of a tally's counts, as `exact.exact_table` does without counts.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from tsdf.data.blocks import BLOCKS, MEMORY_FIELDS, RECORD_FIELDS, version_for
from tsdf.data.table import Table
from tsdf.errors import TSDFError
from tsdf.files import software
from tsdf.grain.optics import Optics
from tsdf.make import tally as T
from tsdf.make.factorisation import Factorisation, factorisation_error, fits
from tsdf.make.records import EntryRecords, entry_records_of, joint_records_of
from tsdf.make.statistics import (
    RANGES,
    STATISTICS,
    TableError,
    _scalar_statistics,
    columns_of,
    cos_theta_edges,
    jackknife,
    legendre_matrix,
    normalised,
    product,
    ratio,
    table_error,
)
from tsdf.make.tally import Tally

LICENCE = "CC0-1.0"


def assemble(  # noqa: PLR0913 - by keyword: what a header holds
    *,
    grain: Mapping[str, Any],
    optics: Optics,
    edges: np.ndarray,
    p_theta: np.ndarray,
    conditionals: Mapping[str, np.ndarray],
    mean_l: np.ndarray,
    joint: np.ndarray | None,
    memory: EntryRecords | None,
    statistics: dict[str, Any],
    standard_errors: dict[str, Any],
    error: TableError,
    factorisation: Factorisation,
    mean_offset: float,
    ledger: Mapping[str, int],
    provenance: Mapping[str, Any],
) -> Table:
    """Stack the blocks and write the header, so that every rule of SPEC.md on values holds.

    Sums of rounded numbers may put a mean beside its cell or a statistic beside its range, by no more than was
    rounded: there they are put on the edge.
    """
    lower, upper = T.L_EDGES[:-1, None], np.append(T.L_EDGES[1:-1], math.inf)[:, None]
    mean_l = np.where(conditionals["p_l"].astype(np.float32) > 0.0, np.clip(mean_l, lower, upper), 0.0)
    statistics = (
        statistics
        | {name: min(max(statistics[name], low), high) for name, (low, high) in RANGES.items()}
        | {"legendre_moments": [min(max(moment, -1.0), 1.0) for moment in statistics["legendre_moments"]]}
    )
    values = {"p_theta": p_theta[None, :], **conditionals, "mean_l": mean_l}
    if joint is not None:
        values |= {f"joint_{name}": rows for name, rows in zip(RECORD_FIELDS, joint, strict=True)}
    if memory is not None:
        values |= {f"memory_{name}": rows for name, rows in zip(MEMORY_FIELDS, memory.records, strict=True)}
        values["memory_hit"] = memory.hit[None, :]
    edges_of = {"p_phi": T.PHI_EDGES, "p_r": T.R_EDGES, "p_z": T.Z_EDGES, "p_l": T.L_EDGES}
    blocks: list[dict[str, Any]] = []
    stacked: list[np.ndarray] = []
    for block in BLOCKS:
        if block.name in values:
            axis = edges_of[block.name].tolist() if block.axis else None
            blocks.append(block.entry(sum(map(len, stacked)), len(values[block.name]), axis))
            stacked.append(values[block.name])
    pixels = np.concatenate(stacked).astype(np.float32)
    header = {
        "format": "tsdf",
        "format_version": version_for(block["name"] for block in blocks),
        "required_features": [],
        "columns": {"quantity": "cos_theta", "edges": edges.tolist()},
        "blocks": blocks,
        "pixels_sha256": "0" * 64,  # the writer's to fill in
        "grain": dict(grain),
        "optics": asdict(optics),
        "statistics": statistics,
        "standard_errors": standard_errors,
        "table_error": {
            "total_variation": error.total_variation,
            "sampling_noise": error.sampling_noise,
            "cell_width": error.cell_width,
        },
        "factorisation_error": factorisation_error(
            factorisation, p_theta, conditionals["p_r"], conditionals["p_z"], mean_offset
        ),
        "fits": fits(p_theta, edges, statistics["mean_cosine"]),
        "energy_ledger": dict(ledger),
        "provenance": {"software": software(), **provenance},
        "licence": LICENCE,
    }
    return Table(header, pixels)


def traced_table(
    tally: Tally,
    cells: int,
    grain: Mapping[str, Any],
    optics: Optics,
    provenance: Mapping[str, Any],
    memory: int = 0,
) -> Table:
    """Return the table that a tally of traced paths stands for, with `memory` records by entry in each column.

    Raises
    ------
    TSDFError
        If no light at all was scattered.
    """
    if not tally.scalars[:, T.SCATTERED].sum():
        raise TSDFError("no path was scattered by the grain: trace more paths (--paths), or look at the grain's shape")
    sums = np.concatenate((tally.scalars, tally.theta[:, T.FINE :]), axis=1)
    values, errors = jackknife(sums, _scalar_statistics)
    fine_edges = np.concatenate(([-1.0], np.cos(np.linspace(math.pi, 0.0, T.FINE + 1)), [1.0]))
    matrix = legendre_matrix(fine_edges)
    fine = np.concatenate(
        (tally.theta[:, T.FINE + 1 :], tally.theta[:, T.FINE - 1 :: -1], tally.theta[:, T.FINE : T.FINE + 1]), axis=1
    )
    moments, moment_errors = jackknife(
        fine, lambda energy: ratio(product(energy, matrix), energy.sum(axis=-1, keepdims=True))
    )
    statistics: dict[str, Any] = dict(zip(STATISTICS, values[:-1].tolist(), strict=True))
    standard_errors: dict[str, Any] = dict(zip(STATISTICS, errors[:-1].tolist(), strict=True))
    moments[:2], moment_errors[:2] = (1.0, statistics["mean_cosine"]), (0.0, standard_errors["mean_cosine"])
    statistics["legendre_moments"], standard_errors["legendre_moments"] = moments.tolist(), moment_errors.tolist()

    energy = columns_of(tally.theta.sum(axis=0), cells)
    columns = {
        name: columns_of(np.ascontiguousarray(tally.conditional(name).T), cells).T
        for name in ("phi", "r", "z", "l", "l_sum")
    }
    totals = dict(zip(T.SCALARS, (int(v) for v in tally.scalars.astype(object).sum(axis=0)), strict=True))
    ledger = {name: totals[name] for name in ("launched", "unscattered", "scattered")}
    ledger |= {"absorbed": 0, "truncated": totals["truncated"], "lost": totals["lost"]}
    return assemble(
        grain=grain,
        optics=optics,
        edges=cos_theta_edges(cells),
        p_theta=energy / energy.sum(),
        conditionals={f"p_{name}": normalised(columns[name]) for name in ("phi", "r", "z", "l")},
        mean_l=ratio(columns["l_sum"].astype(np.float64), columns["l"].astype(np.float64)).T,
        joint=joint_records_of(tally, cells) if tally.joint else None,
        memory=entry_records_of(tally, cells + 2, memory) if memory else None,
        statistics=statistics,
        standard_errors=standard_errors,
        error=table_error(tally, cells),
        factorisation=Factorisation(tally.box, tally.box_l),
        mean_offset=float(values[-1]),
        ledger=ledger,
        provenance=provenance,
    )
