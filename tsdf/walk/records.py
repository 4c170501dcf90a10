"""What level `teleport-memory` draws from: tables' records by entry, and the law of packings, laid out for kernels.

`memory` says what is done with them.
"""

from collections.abc import Sequence

import numpy as np

from tsdf.data.table import Table
from tsdf.spheres.gaps import Law
from tsdf.walk.memory import AIMED, Memory


def remembered(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return a table's records by entry as kernels take them, (columns, k, 8) float32, and the impact parameters of
    their entries (columns, k): see `Memory`.

    The exit normal is the entry's and the offset together, at unit length, so that no rounding puts it off the sphere.
    """
    record = {name: values.T.astype(np.float64) for name, values in table.memory.items()}
    b = np.sqrt(np.clip(record["entry_b2"], 0.0, 1.0))
    cos_theta = np.clip(record["cos_theta"], -1.0, 1.0)
    sin_theta, a = np.sqrt(1.0 - cos_theta**2), record["entry_azimuth"]
    d = np.stack((sin_theta * np.cos(a), sin_theta * np.sin(a), cos_theta), axis=-1)
    straight = (np.abs(cos_theta) == 1.0)[..., None]
    d = np.where(straight, (0.0, 0.0, 1.0) * np.sign(d[..., 2:]), d)
    phi = a + record["phi_delta"]
    n = np.stack((b + record["r"] * np.cos(phi), record["r"] * np.sin(phi), record["z"] - np.sqrt(1.0 - b**2)), axis=-1)
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-300)
    side = n - (n * d).sum(axis=-1, keepdims=True) * d
    out = np.linalg.norm(side, axis=-1, keepdims=True)
    other = np.cross(d, np.where(np.abs(d[..., :1]) < 0.5, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    side = np.where(out > 1e-9, side / np.maximum(out, 1e-300), other / np.linalg.norm(other, axis=-1, keepdims=True))
    return np.concatenate((d, side, np.minimum(out, 1.0), record["l"][..., None]), axis=-1).astype(np.float32), b


def _aimed(table: Table, most: int) -> np.ndarray:
    """Return for each column of cos theta AIMED records of light deflected so, (columns, AIMED) int32, as numbers
    column * most + record; the nearest where a column has none."""
    cos_theta = table.memory["cos_theta"].T.astype(np.float64)
    columns, k = cos_theta.shape
    weight = np.repeat(table.hit, k) * (np.abs(cos_theta.ravel()) < 1.0)
    number = (np.arange(columns)[:, None] * most + np.arange(k)).ravel()
    order = np.argsort(cos_theta.ravel(), kind="stable")
    order = order[weight[order] > 0.0]
    result = np.zeros((columns, AIMED), np.int32)
    if not len(order):
        return result
    values, running = cos_theta.ravel()[order], np.concatenate(([0.0], np.cumsum(weight[order])))
    edges = table.cos_theta_edges
    ends = np.searchsorted(values, edges[1:])
    ends[-1] = len(values)
    starts = np.searchsorted(values, edges[:-1])
    for column, (first, last) in enumerate(zip(starts, ends, strict=True)):
        if last <= first:
            first = min(max(first - AIMED // 2, 0), max(len(values) - AIMED, 0))
            last = min(first + AIMED, len(values))
        places = running[first] + (np.arange(AIMED) + 0.5) / AIMED * (running[last] - running[first])
        chosen = np.clip(np.searchsorted(running, places, side="right") - 1, first, last - 1)
        result[column] = number[order[chosen]]
    return result


def memory_of(
    laws: Sequence[Law],
    fractions: Sequence[float],
    radii: Sequence[float],
    grains: Sequence[Sequence[tuple[Table, float]]],
) -> Memory:
    """Return what kernels ask about media.

    Parameters
    ----------
    laws : sequence of Law
        Of each medium's packing, all with as many cells.
    fractions, radii : sequences of float
        Packing fraction [1] and R [unit] of each medium.
    grains : sequence of sequences of (Table, float)
        Tables with records by entry, and number fractions, of each medium's components.
    """
    media, tables = len(laws), [table for some in grains for table, _ in some]
    most = max((law.gap.shape[1] for law in laws), default=1)
    cells = laws[0].gap.shape[0] if laws else 1
    law = np.zeros((media, cells, most, 4), np.float32)
    gaps = np.zeros((media, cells * most + 1))
    for m, one in enumerate(laws):
        k = one.gap.shape[1]
        law[m, :, :k] = np.stack((one.gap, np.sqrt(one.entry_b2), np.cos(one.azimuth), np.sin(one.azimuth)), axis=-1)
        gaps[m, 1:] = np.cumsum(law[m, :, :, 0].astype(np.float64))
        gaps[m] /= gaps[m, -1]
    columns = [len(table.hit) for table in tables]
    kept = [len(table.memory["l"]) for table in tables]
    shape = (len(tables), max(columns, default=1), max(kept, default=1))
    hit, records = np.zeros(shape[:2], np.float32), np.zeros((*shape, 8), np.float32)
    aimed = [np.zeros((0, AIMED, 9), np.float32)]
    for c, (table, n, k) in enumerate(zip(tables, columns, kept, strict=True)):
        hit[c, :n] = table.hit
        records[c, :n, :k], entered = remembered(table)
        chosen = np.unravel_index(_aimed(table, k), (n, k))
        own = records[c, :n, :k][chosen]
        aimed.append(np.concatenate((own, entered[chosen][..., None]), axis=-1, dtype=np.float32))
    shares = [np.array([share for _, share in some]) for some in grains]
    return Memory(
        law=law,
        records=np.array([one.gap.shape[1] for one in laws], np.int64),
        gaps=gaps,
        fraction=np.array(fractions, np.float64),
        radius=np.array(radii, np.float64),
        choice=np.concatenate([np.zeros(0), *(np.cumsum(share) / share.sum() for share in shares)]),
        hit=hit,
        columns=np.array(columns, np.int64),
        grains=records,
        kept=np.array(kept, np.int64),
        aimed=np.concatenate(aimed),
        met=np.array([table.statistics["hit_probability"] for table in tables], np.float64),
    )
