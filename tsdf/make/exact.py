"""Exact sphere: its table, by quadrature over the impact parameter.

`analytic` lists what leaves the sphere as intervals of cos theta; here they are spread over the cells of a table. No
random numbers, and no error but the width of the cells.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tsdf.compiled import njit
from tsdf.data.blocks import MEMORY_FIELDS, RECORD_FIELDS
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.make import tally as T
from tsdf.make.assemble import assemble
from tsdf.make.factorisation import Factorisation
from tsdf.make.records import SHIFT, EntryRecords, systematic
from tsdf.make.statistics import (
    LEGENDRE,
    MAX_CELLS,
    STATISTICS,
    TableError,
    candidate_cells,
    cos_theta_edges,
    each,
    normalised,
    ratio,
)

LEDGER_UNITS = 1 << 52  # energy units of an exact table
DARK = 1e-30  # a column of less is empty: its conditionals would be rounding errors


@njit(cache=True)
def _covered(a, b, low, high):  # type: ignore[no-untyped-def]
    """Return the share of the interval a .. b that lies in low .. high; a point lies in one of them or the next."""
    if b <= a:
        return 1.0 if low <= a < high or a == high == 1.0 else 0.0
    return max(0.0, (min(b, high) - max(a, low)) / (b - a))


@njit(cache=True)
def _deposit(weight, low, high, row, edges, out):  # type: ignore[no-untyped-def]
    """Spread each event's weight over the columns it covers, as far as it covers each: out[column, row] += share."""
    columns = len(edges) - 1
    for k in range(len(weight)):
        a, b = min(low[k], high[k]), max(low[k], high[k])
        i = min(max(np.searchsorted(edges, a, side="right") - 1, 0), columns - 1)
        while i < columns and edges[i] <= b:
            out[i, row[k]] += weight[k] * _covered(a, b, edges[i], edges[i + 1])
            i += 1


@njit(cache=True)
def _choose(weight, low, high, edges, totals, chosen):  # type: ignore[no-untyped-def]
    """Write the events at evenly spaced places of each column's running sum, (columns, records), in their order.

    Where the first place is differs from column to column, or what a few records miss would add up over the columns:
    0.6 % of the mean z with 32.
    """
    columns, count = chosen.shape
    running, taken = np.zeros(columns), np.zeros(columns, dtype=np.int64)
    for k in range(len(weight)):
        a, b = min(low[k], high[k]), max(low[k], high[k])
        i = min(max(np.searchsorted(edges, a, side="right") - 1, 0), columns - 1)
        while i < columns and edges[i] <= b:
            running[i] += weight[k] * _covered(a, b, edges[i], edges[i + 1])
            first = i * SHIFT % 1.0
            while taken[i] < count and running[i] > (taken[i] + first) / count * totals[i]:
                chosen[i, taken[i]] = k
                taken[i] += 1
            i += 1
    for i in range(columns):  # rounding may leave the last places open
        for j in range(taken[i], count):
            chosen[i, j] = chosen[i, taken[i] - 1] if taken[i] > 0 else 0


def _memory(events: analytic.SphereEvents, eta: float, columns: int, count: int) -> EntryRecords:
    """Return `count` records for each of so many equal cells of entry_b2, evenly spaced in the running sum of weights.

    The sum runs through the orders one after the other, so that the records of a cell hold each with its share of the
    light and spread over the cell.
    """
    along = analytic.sphere_path(events.entry_b2, events.order, eta).along
    by_name = {"cos_theta": along, "l": events.path_length}
    fields = np.stack([by_name[name] if name in by_name else getattr(events, name) for name in MEMORY_FIELDS])
    column = np.minimum((events.entry_b2 * columns).astype(np.int64), columns - 1)
    order = np.lexsort((events.entry_b2, events.order, column))
    limits = np.searchsorted(column[order], np.arange(columns + 1))
    records = np.zeros((len(MEMORY_FIELDS), count, columns))
    for c in range(columns):
        members = order[limits[c] : limits[c + 1]]
        running = np.cumsum(events.weight[members])
        places = (np.arange(count) + c * SHIFT % 1.0) / count * running[-1]
        chosen = members[np.minimum(np.searchsorted(running, places, side="right"), len(members) - 1)]
        records[:, :, c] = fields[:, chosen[np.argsort(events.entry_b2[chosen], kind="stable")]]
    return EntryRecords(np.ones(columns), records)


def _exact_width(optics: Optics, cells: int) -> float:
    """Return the total variation between the exact p_theta and its cell means."""
    parts = 16
    edges = cos_theta_edges(cells)[1:-1]
    theta = each(math.acos, edges)
    fine = np.cos((theta[:-1, None] + np.diff(theta)[:, None] * np.arange(parts) / parts).ravel())
    fine = np.append(fine, 1.0)
    masses = analytic.deflection_masses(fine, optics.eta, optics.fresnel).reshape(cells, parts)
    share = np.diff(fine).reshape(cells, parts)
    share /= share.sum(axis=1, keepdims=True)
    return float(0.5 * np.abs(masses - masses.sum(axis=1, keepdims=True) * share).sum())


def exact_table(
    cells: int | None,
    target: float | None,
    joint: int,
    grain: Mapping[str, Any],
    optics: Optics,
    provenance: Mapping[str, Any],
    memory: int = 0,
) -> Table:
    """Return the table of the exact sphere by quadrature over the impact parameter, without random numbers.

    Parameters
    ----------
    cells : int, optional
        Cells of theta; by default the fewest that meet `target`.
    target : float, optional
        Total variation of p_theta that the cells may cost.
    joint : int
        Records per column, 0 for none.
    memory : int
        Records per column by entry, 0 for none.
    """
    if cells is None:
        assert target is not None
        cells = next((n for n in candidate_cells() if _exact_width(optics, n) <= target), None)
        if cells is None:
            raise UsageError(
                f"--target-error {target:g} is out of reach: {MAX_CELLS} cells of theta, the most a table may have, "
                f"cost {_exact_width(optics, MAX_CELLS):.2g} of total variation"
            )
    elif target is not None and _exact_width(optics, cells) > target:
        raise UsageError(
            f"--target-error {target:g} needs more than {cells} cells, which cost {_exact_width(optics, cells):.2g}"
        )
    edges = cos_theta_edges(cells)
    inner = edges[1:-1]
    truth = analytic.sphere_statistics(optics.eta, optics.fresnel)
    p_theta = np.concatenate(
        ([truth.atom_backward], analytic.deflection_masses(inner, optics.eta, optics.fresnel), [truth.atom_forward])
    )
    atoms = truth.atom_forward + truth.atom_backward
    p_theta[1:-1] *= 1.0 - atoms
    events = analytic.sphere_events(optics.eta, optics.fresnel, intervals=16384)
    low, high, weight = events.cos_theta_from, events.cos_theta_to, events.weight

    def spread(row: np.ndarray, count: int, scale: np.ndarray | float = 1.0, by: np.ndarray = inner) -> np.ndarray:
        out = np.zeros((len(by) - 1, count))
        _deposit(weight * scale, low, high, row.astype(np.int64), by, out)
        return out

    def cell(values: np.ndarray, axis: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(axis, values, side="right") - 1, 0, len(axis) - 2)

    def with_atoms(inside: np.ndarray) -> np.ndarray:
        """Add the atom columns: empty ones, or all the light of a sphere that does not deflect."""
        edge = np.zeros((1, inside.shape[1]))
        if atoms:
            return np.concatenate((edge, np.zeros_like(inside), inside.sum(axis=0, keepdims=True)))
        return np.concatenate((edge, inside, edge))

    phi = cell(
        np.where(events.phi_delta < T.PHI_EDGES[0], events.phi_delta + 2.0 * math.pi, events.phi_delta), T.PHI_EDGES
    )
    r, z = cell(events.r, T.R_EDGES), cell(events.z, T.Z_EDGES)
    length = np.where(events.path_length > 0.0, cell(events.path_length, T.L_EDGES), 0)  # cell 0 is the atom at l = 0
    energy = {
        "p_phi": with_atoms(spread(phi, T.PHI)),
        "p_r": with_atoms(spread(r, T.R)),
        "p_z": with_atoms(spread(z, T.Z)),
        "p_l": with_atoms(spread(length, T.L)),
    }
    moments = with_atoms(spread(length, T.L, events.path_length))
    dark = (p_theta < DARK) | (energy["p_l"].sum(axis=1) < DARK)
    p_theta[dark] = 0.0
    conditionals = {name: np.where(dark, 0.0, normalised(values)) for name, values in energy.items()}
    mean_l = np.where(dark, 0.0, ratio(moments, energy["p_l"]).T)

    groups = np.cos(np.linspace(math.pi, 0.0, T.GROUPS + 1))
    groups[0], groups[-1] = -1.0, 1.0
    turned = np.where(events.phi_delta > 0.5 * math.pi, T.BOX["phi"] // 2, 0)
    r_box, z_box = r * T.BOX["r"] // T.R, z * T.BOX["z"] // T.Z
    l_box = np.minimum((events.path_length * (T.BOX["l"] / T.BOX_LENGTH)).astype(np.int64), T.BOX["l"] - 1)
    shape = tuple(T.BOX[name] for name in ("phi", "r", "z"))
    box = spread(np.ravel_multi_index((turned, r_box, z_box), shape), math.prod(shape), by=groups)
    width = sum(shape)
    box_l = np.zeros((T.GROUPS, T.BOX["l"] * width))
    for place in (turned, shape[0] + r_box, shape[0] + shape[1] + z_box):
        box_l += spread(l_box * width + place, T.BOX["l"] * width, by=groups)

    records = None
    if joint:
        records = np.zeros((len(RECORD_FIELDS), joint, cells + 2))
        fields = np.stack([
            events.r, events.z, events.phi_delta, events.path_length, events.entry_b2, events.entry_azimuth
        ])  # fmt: skip
        order = np.argsort(events.entry_b2, kind="stable")
        totals = np.zeros((cells, 1))
        arguments = (weight[order], low[order], high[order])
        _deposit(*arguments, np.zeros(len(order), np.int64), inner, totals)
        chosen = np.zeros((cells, joint), dtype=np.int64)
        _choose(*arguments, inner, totals[:, 0], chosen)
        if atoms:
            records[:, :, -1] = fields[:, order[systematic(weight[order], joint)]]
        else:
            records[:, :, 1:-1] = fields[:, order[chosen.T]]
        records[:, :, dark] = 0.0

    offset = np.hypot(events.r, events.z)
    statistics: dict[str, Any] = {
        "hit_probability": 1.0,
        "albedo": 1.0,
        "mean_cosine": truth.mean_cosine,
        "mean_z": truth.mean_z,
        "mean_r": truth.mean_r,
        "mean_miss_chord": 0.0,
        "mean_path_length": truth.mean_path_length,
        "atom_forward": truth.atom_forward,
        "atom_backward": truth.atom_backward,
        "legendre_moments": [float(v) for v in truth.legendre[: LEGENDRE + 1]],
    }
    # p_theta and the statistics hold all orders; only the conditionals lack events.residual (< 1e-9)
    ledger = {"launched": LEDGER_UNITS, "unscattered": 0, "scattered": LEDGER_UNITS}
    return assemble(
        grain=grain,
        optics=optics,
        edges=edges,
        p_theta=p_theta,
        conditionals=conditionals,
        mean_l=mean_l,
        joint=records,
        memory=_memory(events, optics.eta, cells + 2, memory) if memory else None,
        statistics=statistics,
        standard_errors=dict.fromkeys(STATISTICS, 0.0) | {"legendre_moments": [0.0] * (LEGENDRE + 1)},
        error=TableError(cells, 0.0, 0.0 if atoms else _exact_width(optics, cells)),
        factorisation=Factorisation(
            box.reshape((1, T.GROUPS, *shape)), box_l.reshape((1, T.GROUPS, T.BOX["l"], width))
        ),
        mean_offset=float((weight * offset).sum() / weight.sum()),
        ledger=ledger | {"absorbed": 0, "truncated": 0, "lost": 0},
        provenance=provenance,
    )
