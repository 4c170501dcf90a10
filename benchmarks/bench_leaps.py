"""Leaps against none: what slabs and a ball do to a beam, how many events are drawn for that, and how long it takes.

    python benchmarks/bench_leaps.py TABLE [--level teleport-memory] [--packing 0.6] [--slab 20 ...] [--ball 400]
        [--gamma 2] [--seconds 20]

One line for each body: grains met in the mean, events drawn without and with leaps, how many times sooner a path ends;
and then in per cent what leaps change, with the standard error of the difference: of reflectance R, transmittance T, of
all light that comes out if a grain keeps 99.99 % and 99 % of it, of N, the grains met, and the total variation of the
light that comes back over the distance from the beam, with what noise alone makes of it. Of a ball, R is what leaves
its near half.
"""

import argparse
import math
import threading
import time
from typing import Any

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.picture.render import Walkers
from tsdf.picture.world import beam, build
from tsdf.scene.scene import Absorption, GrainSpec, Slab, Sphere
from tsdf.study.experiment import FAINTEST, PROFILE, Ends, Experiment, follow, scene_of
from tsdf.walk.transport import Job

KEPT = (0.9999, 0.99)  # of the light by a grain
BATCHES = 32
ROUNDS = 9  # of the time that paths take
ROUND = 1 << 12  # paths of the first batches


def experiment(table: Table, level: str, fraction: float, size: float, ball: bool, gamma: float) -> Experiment:
    """Return a beam into a slab or a ball, and what it reads: light up, down, all of it at each of KEPT, profile."""
    spec = GrainSpec(table, absorption=Absorption("grey", (FAINTEST,)))
    shape = Sphere((0.0, 0.0, -size), size) if ball else Slab(-size, 0.0)
    world = build(scene_of(shape, spec, fraction, inside="grains"), level, leap=gamma)
    inside = format_length(table)

    def read(places: np.ndarray, ends: Ends) -> np.ndarray:
        height = ends.place[:, 2] if ball else ends.direction[:, 2]
        up = height > 0.0
        light = [np.exp(math.log(kept) / inside * ends.amounts.sum(axis=1)) for kept in KEPT]
        if level in ("volume-hg", "isotropic"):  # they count events, each at the albedo of the faintest absorption
            light = [np.ones(len(up))] * len(KEPT)
        ring = np.searchsorted(PROFILE, np.hypot(ends.place[:, 0], ends.place[:, 1]), side="right") - 1
        values = np.zeros((len(up), 2 + len(KEPT) + len(PROFILE) - 1))
        values[:, 0], values[:, 1] = np.where(up, ends.weight, 0.0), np.where(up, 0.0, ends.weight)
        values[:, 2 : 2 + len(KEPT)] = np.stack(light, axis=1)
        values[np.flatnonzero(up), 2 + len(KEPT) + ring[up]] = 1.0
        return values

    return Experiment(world, beam(world, (0.0, 0.0, 5.0), (0.0, 0.0, -1.0)), 1, read)


def format_length(table: Table) -> float:
    """Return the mean path length in a grain [R]."""
    return max(-math.log(table.albedo(1e-6)) / 1e-6, 1e-300)  # mirrors have none


def batch(e: Experiment, paths: int, first: int) -> np.ndarray:
    """Return R, T, light at each of KEPT, profile; grains met, events drawn, seconds: all per path."""
    places, ends = follow(e.world, e.camera, paths, 7, 1, 1, first)
    cost = np.array([ends.events, ends.drawn, ends.seconds]) / paths
    return np.concatenate([e.read(places, ends).mean(axis=0), cost])


def sooner(pair: list[Experiment], seconds: float) -> float:
    """Return how many times sooner paths of a picture end with leaps, by processor time: the median of some rounds."""
    walkers, halt, ratios = [Walkers(e.world) for e in pair], threading.Event(), []
    counts = [256, 256]
    for number in range(1 + ROUNDS):
        took = []
        for e, own, count in zip(pair, walkers, counts, strict=True):
            began = time.thread_time()
            own.follow(Job(e.camera, 0, count, number * count, 3), 1, halt)
            took.append((time.thread_time() - began) / count)
        ratios.append(took[0] / took[1])
        if not number:
            counts = [max(256, min(1 << 17, int(seconds / 2 / ROUNDS / each))) for each in took]
    return float(np.median(ratios[1:]))


def compared(name: str, table: Table, arguments: Any, size: float, ball: bool) -> str:
    """Return the line of one body."""
    pair = [
        experiment(table, arguments.level, arguments.packing, size, ball, gamma) for gamma in (0.0, arguments.gamma)
    ]
    if not pair[1].world.leap:
        return f"{name}: too thin for leaps"
    rows: list[np.ndarray] = []
    for number, e in enumerate(pair):
        follow(e.world, e.camera, 64, 1, 1, 1)
        each = batch(e, ROUND, 0)[-1]
        paths = max(ROUND // 4, int(arguments.seconds / BATCHES / each))
        first = ROUND * (1 + number) + number * BATCHES * paths
        rows.append(np.array([batch(e, paths, first + k * paths) for k in range(BATCHES)]))
    mean, error = ([f(row) for row in rows] for f in (lambda r: r.mean(axis=0), _error))
    change = 100.0 * (mean[1] / np.maximum(mean[0], 1e-300) - 1.0)
    noise = 100.0 * np.hypot(error[0], error[1]) / np.maximum(mean[0], 1e-300)
    bins = slice(2 + len(KEPT), -3)
    difference = mean[1][bins] / mean[1][bins].sum() - mean[0][bins] / mean[0][bins].sum()
    both = np.hypot(error[0][bins] / mean[0][bins].sum(), error[1][bins] / mean[1][bins].sum())
    variation = 50.0 * np.abs(difference).sum(), 50.0 * math.sqrt(2.0 / math.pi) * both.sum()
    places = {"R": 0, "T": 1, f"{KEPT[0]}": 2, f"{KEPT[1]}": 3, "N": -3}
    changes = " ".join(f"{what} {change[k]:+.2f}({noise[k]:.2f})" for what, k in places.items())
    return (
        f"{name}: N {mean[0][-3]:.4g}, drawn {mean[0][-2]:.4g} -> {mean[1][-2]:.3g}, "
        f"{sooner(pair, arguments.seconds):.3g} times sooner; {changes} profile {variation[0]:.2f} ({variation[1]:.2f})"
    )


def _error(rows: np.ndarray) -> np.ndarray:
    return np.asarray(rows.std(axis=0, ddof=1) / math.sqrt(len(rows)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table")
    parser.add_argument("--level", default="teleport-memory")
    parser.add_argument("--packing", type=float, default=0.6)
    parser.add_argument("--slab", type=float, nargs="*", default=[20.0, 40.0, 100.0, 400.0, 2000.0])
    parser.add_argument("--ball", type=float, nargs="*", default=[400.0])
    parser.add_argument("--gamma", type=float, default=2.0)
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="of one thread, for each body without and with leaps"
    )
    arguments = parser.parse_args()
    table = tsdf_format.read(arguments.table)
    for ball, sizes in ((False, arguments.slab), (True, arguments.ball)):
        for size in sizes:
            name = f"{'ball' if ball else 'slab'} {size:g} R, {arguments.level}, f {arguments.packing:g}"
            print(compared(name, table, arguments, size, ball), flush=True)


if __name__ == "__main__":
    main()
