"""Level teleport-packed against the same packings with each grain traced: diffusion in the bulk, and time.

Each table is measured at three packing fractions in four packings, explicit and not, and compared packing by packing.
Times are processor time of one thread per event, over that of level teleport, in turns. Give SECONDS of each run.

    tsdf-build sphere --eta 1e9 --traced --paths 2e6 --memory 64 --out mirror.tsdf.exr
    python benchmarks/bench_packed.py mirror.tsdf.exr 12
"""

import statistics
import sys
from pathlib import Path

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.scene.scene import GrainSpec
from tsdf.study.experiment import block_of, bulk_experiment, gather

FRACTIONS = (0.1, 0.3, 0.6)
PACKINGS = 4
EVENTS = 1000  # of a block where time is taken: restarts between blocks are no part of it
ROUNDS = 5
TIMED = ("teleport", "teleport-memory", "teleport-packed", "explicit")


def deviation(grain: GrainSpec, fraction: float, block: int, seconds: float) -> tuple[float, float, float]:
    """Return the displacement per event of explicit [R^2], by how much that of packed is off, and that one's error."""
    offs, errors, values = [], [], []
    for k in range(PACKINGS):
        found = []
        for seed, level in enumerate(("explicit", "teleport-packed")):
            sums = gather(bulk_experiment(level, grain, fraction, k, block), None, seconds, 2 * k + seed, 1)
            found.append((float(sums.mean[0]), float(sums.error[0])))
        (true, own), (value, error) = found
        values.append(true)
        offs.append(value / true - 1.0)
        errors.append(np.hypot(error, own * value / true) / true)
    weight = np.array(errors) ** -2.0
    return float(np.mean(values)), float((weight * offs).sum() / weight.sum()), float(weight.sum() ** -0.5)


def times(grain: GrainSpec, fraction: float) -> dict[str, tuple[float, float]]:
    """Return processor time per event [ns] of each level, and over teleport's."""
    made = {level: bulk_experiment(level, grain, fraction, 0, EVENTS, 8) for level in TIMED}
    taken: dict[str, list[float]] = {level: [] for level in TIMED}
    for k in range(ROUNDS):
        for level, one in made.items():
            taken[level].append(gather(one, 40, None, k, 1).event)
    ratios = {
        level: statistics.median(a / b for a, b in zip(taken[level], taken["teleport"], strict=True)) for level in TIMED
    }
    return {level: (1e9 * statistics.median(taken[level]), ratios[level]) for level in TIMED}


def main() -> None:
    path, seconds = Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 12.0
    table = tsdf_format.read(path)
    grain, block = GrainSpec(table), block_of(table)
    for fraction in FRACTIONS:
        line = ", ".join(f"{name} {ns:.0f} ns ({ratio:.2f})" for name, (ns, ratio) in times(grain, fraction).items())
        true, off, error = deviation(grain, fraction, block, seconds)
        print(f"{path.name} f {fraction}: explicit {true:.5g} R^2 per event, packed {100 * off:+.2f} +- "
              f"{100 * error:.2f} %; {line}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
