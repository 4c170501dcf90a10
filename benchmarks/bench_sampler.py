"""Measure what drawing a scattering event costs: ``python benchmarks/bench_sampler.py --help``.

Four ways to walk from event to event, each with the same hashed random numbers: Henyey-Greenstein (direction only),
the table by Algorithm 1, the table by its joint records, and Algorithm 1 by plain binary search in float64 sums. They
run in turn in one process; times are medians over rounds and so are their ratios.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from tsdf.data import format as tsdf_format
from tsdf.data.sampler import DRAWN, compile_tables, draw_column, draw_length, draw_offset, draw_record, leave, turned
from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Build, Effort
from tsdf.sampling import mix
from tsdf.vectors import frame

STEP = np.uint64(0x9E3779B97F4A7C15)
LOW = np.uint64(0xFFFFFFFF)


@njit(error_model="numpy")
def pair(counter):
    """Return two floats in [0, 1) and the next counter."""
    word = mix(counter)
    return (
        float(word >> np.uint64(32)) * 2.3283064365386963e-10,
        float(word & LOW) * 2.3283064365386963e-10,
        counter + STEP,
    )


@njit(nogil=True, error_model="numpy")
def henyey_greenstein(g, events, seed):
    d, total = (0.0, 0.0, 1.0), 0.0
    counter = np.uint64(seed)
    for _ in range(events):
        u, v, counter = pair(counter)
        f = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cos_theta = (1.0 + g * g - f * f) * (0.5 / g)
        sin_theta = math.sqrt(max(0.0, 1.0 - cos_theta * cos_theta))
        a, b = frame(d)
        c, s = turned(v)
        c, s = sin_theta * c, sin_theta * s
        d = (
            cos_theta * d[0] + c * a[0] + s * b[0],
            cos_theta * d[1] + c * a[1] + s * b[1],
            cos_theta * d[2] + c * a[2] + s * b[2],
        )
        total += d[2]
    return total


@njit(nogil=True, error_model="numpy")
def algorithm_1(tables, events, seed):
    d, total = (0.0, 0.0, 1.0), 0.0
    counter = np.uint64(seed)
    for _ in range(events):
        u_phi_d, u_theta, counter = pair(counter)
        u_r, u_z, counter = pair(counter)
        u_phi, u_l, counter = pair(counter)
        column, cos_theta = draw_column(tables, 0, u_theta)
        r, z, phi_delta = draw_offset(tables, column, u_r, u_z, u_phi)
        length = draw_length(tables, column, u_l)
        d, x = leave(d, cos_theta, u_phi_d, r, z, phi_delta)
        total += x[0] + x[1] + x[2] + length
    return total


@njit(nogil=True, error_model="numpy")
def joint_records(tables, events, seed):
    d, total = (0.0, 0.0, 1.0), 0.0
    counter = np.uint64(seed)
    for _ in range(events):
        u_phi_d, u_theta, counter = pair(counter)
        u, _, counter = pair(counter)
        column, cos_theta = draw_column(tables, 0, u_theta)
        r, z, phi_delta, length = draw_record(tables, column, u)
        d, x = leave(d, cos_theta, u_phi_d, r, z, phi_delta)
        total += x[0] + x[1] + x[2] + length
    return total


@njit(error_model="numpy")
def search(sums, edges, u):
    low, high = 0, len(sums) - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if u >= sums[middle]:
            low = middle
        else:
            high = middle
    return low, edges[low] + (u - sums[low]) / (sums[high] - sums[low]) * (edges[high] - edges[low])


@njit(nogil=True, error_model="numpy")
def binary_search(theta, cos_edges, sums, edges, events, seed):
    d, total = (0.0, 0.0, 1.0), 0.0
    counter = np.uint64(seed)
    for _ in range(events):
        u_phi_d, u_theta, counter = pair(counter)
        u_r, u_z, counter = pair(counter)
        u_phi, u_l, counter = pair(counter)
        column, cos_theta = search(theta, cos_edges, u_theta)
        _, r = search(sums[0][column], edges[0], u_r)
        _, z = search(sums[1][column], edges[1], u_z)
        _, phi_delta = search(sums[2][column], edges[2], u_phi)
        _, length = search(sums[3][column], edges[3], u_l)
        d, x = leave(d, cos_theta, u_phi_d, r, z, phi_delta)
        total += x[0] + x[1] + x[2] + length
    return total


def float64_sums(masses: np.ndarray) -> np.ndarray:
    """Return cumulative masses along the first axis as rows, from 0 to 1."""
    sums = np.cumsum(masses.astype(np.float64), axis=0)
    return np.ascontiguousarray(np.insert(sums / np.maximum(sums[-1:], 1e-300), 0, 0.0, axis=0).T)


def measured(works: dict[str, Callable[[int], float]], events: int, rounds: int) -> dict[str, list[float]]:
    """Return the nanoseconds an event of each way takes, by round."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for work in works.values():
        work(1000)
    for _ in range(rounds):
        for name, work in works.items():
            start = time.perf_counter()
            work(events)
            times[name].append((time.perf_counter() - start) / events * 1e9)
    return times


def built(grain: str, paths: int, records: int, memory: int = 0) -> Table:
    """Return a table of an exemplar."""
    shape = load_grain(grain)
    build = Build.start(shape, Optics(1.31), Effort(paths=paths, joint=records, memory=memory))
    build.run(shape)
    return build.table()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--grain", default="snow", help="built-in grain to make a table of")
    parser.add_argument("--table", type=Path, help="a finished table with joint records instead")
    parser.add_argument("--paths", type=int, default=1_000_000, help="paths of the table")
    parser.add_argument("--records", type=int, default=32, help="joint records per column")
    parser.add_argument("--events", type=int, default=1_000_000, help="events in each round")
    parser.add_argument("--rounds", type=int, default=15)
    given = parser.parse_args()
    table = tsdf_format.read(given.table) if given.table else built(given.grain, given.paths, given.records)
    tables, g = compile_tables([table], joint=True), float(table.statistics["mean_cosine"])
    sums = tuple(float64_sums(table.block(name)) for name in DRAWN)
    edges = tuple(table.edges(name) for name in DRAWN)
    theta = float64_sums(table.p_theta[:, None])[0]
    works: dict[str, Callable[[int], float]] = {
        "Henyey-Greenstein": lambda n: henyey_greenstein(g, n, 1),
        "Algorithm 1": lambda n: algorithm_1(tables, n, 1),
        "joint records": lambda n: joint_records(tables, n, 1),
        "binary search": lambda n: binary_search(theta, table.cos_theta_edges, sums, edges, n, 1),
    }
    times = measured(works, given.events, given.rounds)
    used = tables.cumulative.nbytes + tables.guide.nbytes
    print(f"{table!r}: conditionals {used / 1024:.0f} kB, records {tables.records.nbytes / 1024:.0f} kB")
    print(f"{'':18} ns/event   / Henyey-Greenstein   binary search / it")
    for name, own in times.items():
        slower = statistics.median(a / b for a, b in zip(own, times["Henyey-Greenstein"], strict=True))
        faster = statistics.median(b / a for a, b in zip(own, times["binary search"], strict=True))
        print(f"{name:18} {statistics.median(own):8.1f}   {slower:19.2f}   {faster:18.2f}")


if __name__ == "__main__":
    main()
