"""Rows about tables: what finite precision, the ends of random numbers and independent draws do to them."""

import math
from collections.abc import Iterator

import numpy as np

from tsdf.data.sampler import DRAWN, ONE, Sampler, Samples, compile_tables
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.grain.grains import load_grain
from tsdf.judge import analytic
from tsdf.make import tally as T
from tsdf.make.effort import MAX_PATHS
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer, in_order
from tsdf.stress.cells import TABLES, Measured, Row, Setting, share
from tsdf.stress.rays import turn_of_records
from tsdf.study.ranking import mean_of

GROUP = "Tables and random numbers"
DEPENDS = "rendering.md, Levels"
FLOATS = 1 << 25  # that a 32-bit counter is asked to count to
EDGES = (0.0, 5e-324, 2.0**-60, 1.0 - 2.0**-24, 1.0 - 2.0**-53)


def lost(masses: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Return by how much what is drawn from cumulative sums differs from masses, by column, total variation [%]."""
    drawn = np.diff(sums.astype(np.float64), axis=0)
    return np.asarray(50.0 * np.abs(drawn - masses).sum(axis=0))


def half_precision(setting: Setting) -> Iterator[Measured]:
    """Each column of each table, as the kernels keep it and as 16-bit floats do: the worst."""
    worst: dict[str, tuple[float, str]] = {TABLES: (-1.0, ""), "half-precision CDF": (-1.0, "")}
    for name, table in setting.tables.items():
        made = compile_tables([table])
        lit = table.p_theta > 0.0
        for number, axis in enumerate(("p_theta", *DRAWN)):
            block = table.block(axis).astype(np.float64)
            masses = block[0][:, None] if axis == "p_theta" else block[:, lit]
            masses = masses / masses.sum(axis=0)
            exact = np.concatenate((np.zeros((1, masses.shape[1])), np.cumsum(masses, axis=0)))
            if axis == "p_theta":
                ours = made.theta[0][:, None]
            else:
                used = np.flatnonzero(table.block(axis).any(axis=1))
                own = made.cumulative[lit, made.start[number - 1] : made.start[number]].T / ONE
                ours = np.concatenate(
                    (np.zeros((int(used[0]), own.shape[1])), own, np.ones((len(masses), own.shape[1])))
                )
                ours = ours[: len(masses) + 1]
            for method, sums in ((TABLES, ours), ("half-precision CDF", exact.astype(np.float16))):
                off = float(lost(masses, sums).max())
                if off > worst[method][0]:
                    gone = (np.diff(sums.astype(np.float64), axis=0) <= 0.0) & (masses > 0.0)
                    worst[method] = (off, f"{axis} of {name}; {gone.sum()} of {(masses > 0.0).sum()} cells vanish")
    for method, (off, note) in worst.items():
        yield Measured(method, off, note=note)


def counters(setting: Setting) -> Iterator[Measured]:
    """As many paths as there may be: their energy is counted to the last unit."""
    begun = 1 << 14
    tally = Tally()
    Tracer(load_grain("sphere"), 1.33, seed=setting.seed).trace(in_order(0, begun), tally)
    turn = tally.scalars[:, T.COS_THETA].sum() / tally.scalars[:, T.SCATTERED].sum()
    paths = begun
    while paths < MAX_PATHS:
        tally.add(tally)
        paths *= 2
    tally.check(np.full(T.REPLICATES, paths // T.REPLICATES))
    s = tally.scalars.sum(axis=0, dtype=object)
    missing = 1.0 - sum(s[i] for i in (T.UNSCATTERED, T.SCATTERED, T.TRUNCATED, T.LOST)) / (paths * T.UNIT)
    off = max(abs(missing), abs(s[T.COS_THETA] / s[T.SCATTERED] / turn - 1.0))
    yield Measured(TABLES, 100.0 * float(off), note=f"{paths:.2g} paths")
    counted = float(np.add.accumulate(np.ones(FLOATS, np.float32), dtype=np.float32)[-1])
    yield Measured("32-bit counters", 100.0 * (1.0 - counted / FLOATS), note=f"counts to {counted:.4g}")


def ends_of_u(setting: Setting) -> Iterator[Measured]:
    """Random numbers at and next to 0 and 1 draw no cell without mass and none beyond the last."""
    drawn = wrong = naive = asked = 0
    for table in setting.tables.values():
        sampler, rng = Sampler(table), setting.rng(11)
        u = rng.random((2000, 6))
        for number in range(1, 6):
            at = rng.random(len(u)) < 0.4
            u[at, number] = rng.choice(EDGES, int(at.sum()))
        one = sampler.sample(u)
        wrong += int((~_possible(table, one)).sum())
        drawn += len(u)
        try:
            sampler.sample(np.full((1, 6), float(np.float32(1.0 - 2.0**-53))))
            wrong += 1  # u = 1 was taken
        except UsageError:
            pass
        lit = table.p_theta > 0.0
        for mass in (table.p_theta, *(column for name in DRAWN for column in table.block(name)[:, lit].T)):
            sums = np.cumsum(mass, dtype=np.float64).astype(np.float32)
            k = np.searchsorted(sums / sums[-1], np.array(EDGES, np.float32), side="left")
            naive += int(((k >= len(mass)) | (mass[np.minimum(k, len(mass) - 1)] == 0.0)).sum())
            asked += len(k)
    yield share(TABLES, wrong, drawn)
    yield share("search from left", naive, asked)


def _possible(table: Table, one: Samples) -> np.ndarray:
    """Return which samples lie in cells that have mass."""
    good = (one.column >= 0) & (one.column < len(table.p_theta))
    column = np.clip(one.column, 0, len(table.p_theta) - 1)
    good &= table.p_theta[column] > 0.0
    for name, value in zip(DRAWN, (one.r, one.z, one.phi_delta, one.path_length), strict=True):
        edges, masses = table.edges(name), table.block(name)
        above = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(masses) - 1)
        below = np.clip(np.searchsorted(edges, value, side="left") - 1, 0, len(masses) - 1)
        good &= (value >= edges[0]) & (value <= edges[-1])
        good &= (masses[above, column] > 0.0) | (masses[below, column] > 0.0)
    return np.asarray(good & np.isfinite(one.cos_theta) & (np.abs(one.cos_theta) <= 1.0))


def on_edges(setting: Setting) -> Iterator[Measured]:
    """Light turns to neither side of a sphere: the mean sine of phi_delta, which is exactly 0 or pi, is 0."""
    samples = Sampler(setting.ball).sample(setting.rng(12).random((setting.some(2_000_000), 6)))
    value, error = mean_of(100.0 * np.sin(samples.phi_delta))
    yield Measured(TABLES, value, error)
    events = analytic.sphere_events(1.33, intervals=4096)
    masses, edges = np.histogram(events.phi_delta, T.PHI, (-math.pi, math.pi), weights=events.weight)
    sine = (np.cos(edges[:-1]) - np.cos(edges[1:])) / np.diff(edges)
    yield Measured("edges at 0", 100.0 * float(masses @ sine / masses.sum()))


def impossible(setting: Setting) -> Iterator[Measured]:
    """Light cannot leave a sphere farther from where it entered than the sphere is wide."""
    u = setting.rng(13).random((setting.some(2_000_000), 6))
    records = setting.ball.memory
    if records:
        far = np.hypot(records["r"], records["z"]) > 2.0 + 1e-5
        yield share("teleport-memory", int(far.sum()), far.size)
    for method, joint in (("teleport-joint", True), ("teleport", False)):
        samples = Sampler(setting.ball, joint=joint).sample(u)
        yield share(method, int((np.hypot(samples.r, samples.z) > 2.0 + 1e-5).sum()), len(u))


def drawn_right(setting: Setting) -> Iterator[Measured]:
    """The mean cosine of what is drawn from each table, and of its records by entry, is the table's: the worst."""
    worst = {TABLES: Measured(TABLES, 0.0), "teleport-memory": Measured("teleport-memory", 0.0)}
    for name, table in setting.tables.items():
        truth = 1.0 - table.mean_cosine()
        samples = Sampler(table).sample(setting.rng(14).random((setting.some(4_000_000), 6)))
        value, error = mean_of(1.0 - samples.cos_theta)
        found = [Measured(TABLES, 100.0 * (value / truth - 1.0), 100.0 * error / truth, name)]
        if table.memory:
            found.append(Measured("teleport-memory", 100.0 * (turn_of_records(table) / truth - 1.0), note=name))
        for one in found:
            if abs(one.value) > abs(worst[one.method].value):
                worst[one.method] = one
    yield from worst.values()


ROWS = (
    Row("half", GROUP, "cumulative masses kept in few bits", "total variation of the worst column", "%", 0.01,
        half_precision),
    Row("counters", GROUP, "6.9e10 paths counted", "energy and mean cosine", "%", 1e-9, counters),
    Row("ends-of-u", GROUP, "u at and next to 0 and 1", "draws of what cannot be", "%", 0.05, ends_of_u),
    Row("phi-edges", GROUP, "azimuths exactly on 0 and pi", "mean sine of phi_Delta times 100", "1", 1.0, on_edges),
    Row("far-exits", GROUP, "entry and exit more than 2 R apart", "share of draws", "%", 0.05, impossible,
        known={"teleport": DEPENDS}),
    Row("drawn", GROUP, "what is drawn, all tables", "1 - g of the worst table", "%", 2.0, drawn_right),
)  # fmt: skip
