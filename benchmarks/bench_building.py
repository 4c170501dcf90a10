"""The frontier of building: the true error of a table against paths, cells of theta and processor time.

In each of ten runs, with random numbers of its own, a grain is traced for more and more paths; its table in so many
cells is compared with the truth, by total variation of p_theta in 1024 cells: of the sphere by quadrature, of other
grains by as many paths as all runs have, four times over. What the build itself says its error is stands beside it.
Writes building.json, .csv, .pdf, .svg and .png; building.json in the place of the grain draws them again.

    python benchmarks/bench_building.py sphere --out frontier

With --threads it measures instead how much sooner more threads are done, and prints it: a build of so many paths, and
one to the target error that they reach, in turn.

    python benchmarks/bench_building.py snow --threads 1,2,4,8,16 --paths 1e7
"""

import argparse
import csv
import json
import math
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.files import replacing
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import statistics
from tsdf.make.effort import Effort
from tsdf.make.scatterometer import Build, exact_sphere
from tsdf.study import plots
from tsdf.study.ranking import mean_of

PATHS = (10_000, 40_000, 160_000, 640_000, 2_560_000)
CELLS = (16, 32, 64, 128, 256, 512)  # of which the truth, in twice as many, tells the width
RUNS = 10
REFERENCE = 4 * RUNS * PATHS[-1]  # paths of the truth of what is no sphere
ETA = 1.31
COLOURS = ("#0072b2", "#009e73", "#d55e00", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


def masses(build: Build) -> np.ndarray:
    """Return the masses of p_theta (replicates, 1024 columns and atoms) of the replicates of a build; they sum to 1."""
    theta = statistics.columns_of(build.tally.theta.astype(np.float64), statistics.MAX_CELLS)
    return theta / theta.sum()


def variation(columns: np.ndarray, cells: int, truth: np.ndarray) -> float:
    """Return the total variation of a table in so many cells, even within each in cos theta, to the truth.

    columns, truth : (1026,) float64, masses in 1024 cells of theta and of the atoms at either end.
    """
    width = np.diff(statistics.cos_theta_edges(statistics.MAX_CELLS)[1:-1])
    first = (statistics.MAX_CELLS - statistics.bounds(cells, statistics.MAX_CELLS)[::-1])[:-1]
    mass, wide = np.add.reduceat(columns[1:-1], first), np.add.reduceat(width, first)
    number = np.searchsorted(first, np.arange(statistics.MAX_CELLS), side="right") - 1
    spread = mass[number] * width / wide[number]
    ends = abs(columns[0] - truth[0]) + abs(columns[-1] - truth[-1])
    return 0.5 * float(np.abs(spread - truth[1:-1]).sum() + ends)


def traced(name: str, paths: int, seed: int) -> Build:
    grain = load_grain(name)
    build = Build.start(grain, Optics(ETA), Effort(paths=paths, cells=256, seed=seed))
    build.run(grain, os.cpu_count() or 1)
    return build


def measure(name: str) -> dict[str, Any]:
    """Return the numbers of all runs."""
    grain = load_grain(name)
    if grain.kind == "sphere":
        truth, blur = exact_sphere(grain, Optics(ETA), Effort(cells=statistics.MAX_CELLS)).p_theta, 0.0
        word = "quadrature"
    else:
        reference = masses(traced(name, REFERENCE, RUNS))
        truth, word = reference.sum(axis=0), f"{REFERENCE:.3g} paths"
        blur = float(reference.std(axis=0, ddof=1).sum()) * math.sqrt(len(reference) / (2.0 * math.pi))
    rows = [{"paths": paths, "seconds": [], "error": {c: [] for c in CELLS}, "said": {c: [] for c in CELLS}}
            for paths in PATHS]  # fmt: skip
    traced(name, PATHS[0], 0)  # compiles
    for run in range(RUNS):
        build, spent = Build.start(grain, Optics(ETA), Effort(paths=PATHS[0], cells=256, seed=run)), 0.0
        for row in rows:
            build.effort = replace(build.effort, paths=row["paths"])
            begun = time.process_time()
            build.run(grain, os.cpu_count() or 1)
            spent += time.process_time() - begun
            row["seconds"].append(spent)
            columns, errors = masses(build).sum(axis=0), statistics.TableErrors(build.tally)
            for cells in CELLS:
                row["error"][cells].append(variation(columns, cells, truth))
                row["said"][cells].append(errors(cells).total_variation)
        print(f"run {run + 1} of {RUNS}", flush=True)
    return {"grain": name, "eta": ETA, "truth": word, "blur": blur, "rows": rows}


def draw(found: dict[str, Any], out: Path) -> None:
    """Write the table and the chart."""
    lines = []
    for row in found["rows"]:
        for cells in CELLS:
            error, said = (mean_of(row[key][str(cells)]) for key in ("error", "said"))
            lines.append({"paths": row["paths"], "cells": cells, "seconds": mean_of(row["seconds"]).value,
                          "error": error.value, "error_error": error.error, "said": said.value})  # fmt: skip
    with replacing(out / "building.csv") as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, lines[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
    for suffix in (".pdf", ".svg", ".png"):
        plots.save(chart(found, lines), out / f"building{suffix}")


def chart(found: dict[str, Any], lines: list[dict[str, Any]]) -> Any:
    """Return the figure: error over paths, over cells, and over processor time."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(plots.STYLE):
        figure = Figure(figsize=(10.5, 3.7), layout="constrained")
        left, middle, right = figure.subplots(1, 3, sharey=True)
        for axes, over, by, values, word in (
            (left, "paths", "cells", CELLS[::2], "cells"),
            (middle, "cells", "paths", PATHS, "paths"),
            (right, "seconds", "cells", CELLS[::2], "cells"),
        ):
            for colour, value in zip(COLOURS, values, strict=False):
                some = [line for line in lines if line[by] == value]
                x, y = [line[over] for line in some], [100.0 * line["error"] for line in some]
                bars = [100.0 * line["error_error"] for line in some]
                axes.errorbar(x, y, bars, color=colour, marker="o", markersize=3, linewidth=1.0, capsize=2,
                              label=f"{value:,} {word}")  # fmt: skip
                axes.plot(x, [100.0 * line["said"] for line in some], ":", color=colour, linewidth=0.9)
            axes.set_xscale("log")
            axes.set_yscale("log")
            if found["blur"] > 0.0:
                axes.axhline(100.0 * found["blur"], color="0.6", linewidth=0.7)
            axes.set_xlabel({"seconds": "processor time [s]"}.get(over, over))
            axes.grid(linewidth=0.3, alpha=0.5)
            axes.legend(frameon=False, fontsize=7)
            if over == "cells":
                axes.set_xticks(CELLS, map(str, CELLS))
                axes.set_xticks([], minor=True)
        left.set_yticks([0.1, 0.2, 0.5, 1, 2, 5, 10, 20], ["0.1", "0.2", "0.5", "1", "2", "5", "10", "20"])
        left.set_yticks([], minor=True)
        most = 100.0 * max(max(line["error"], line["said"]) for line in lines)
        least = 100.0 * min(min(line["error"], line["said"]) for line in lines)
        left.set_ylim(least / 1.3, 1.3 * most)
        left.set_ylabel("error: total variation of p_theta [%]")
        title = f"{found['grain']}, eta {found['eta']:g}, {RUNS} runs: error to {found['truth']}"
        figure.suptitle(f"{title}; dotted: what the build says", fontsize=10)
    return figure


def scaling(name: str, threads: list[int], paths: int, rounds: int = 3) -> Iterator[str]:
    """Yield a line for each number of threads: seconds, and how near they come to being so many times as fast.

    Seconds are the least of some rounds, in turn, from the begin of tracing to its end: grain and kernels are ready.
    With a target the paths that it takes are counted, which are the same for any number of threads.
    """
    grain, folder = load_grain(name), tempfile.TemporaryDirectory()

    def seconds(effort: Effort, count: int) -> tuple[float, int]:
        build = Build.start(grain, Optics(ETA), effort)
        begun = time.perf_counter()
        build.run(grain, count, part_file=Path(folder.name) / "x.part", report=lambda _: None)
        return time.perf_counter() - begun, build.paths

    with folder:
        first = Build.start(grain, Optics(ETA), Effort(paths=paths))
        first.run(grain, max(threads))  # compiles
        error = first.error()
        assert error is not None
        efforts = Effort(paths=paths), Effort(target_error=error.total_variation)
        least = {(count, k): (math.inf, 0) for count in threads for k in range(2)}
        for _ in range(rounds):
            for count, k in least:
                least[count, k] = min(least[count, k], seconds(efforts[k], count))
    target, needed = error.total_variation, least[threads[0], 1][1]
    yield f"{name}, {paths:.3g} paths, or --target-error {target:.3g}, which takes {needed:.3g}"
    yield "threads, seconds, of perfect; to the target: seconds, of perfect"
    for count in threads:
        took = [least[count, k][0] for k in range(2)]
        share = [threads[0] * least[threads[0], k][0] / (count * took[k]) for k in range(2)]
        yield f"{count:7d} {took[0]:8.2f} {share[0]:11.2f} {took[1]:23.2f} {share[1]:11.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grain", help="built in, a mesh file, or building.json of another time")
    parser.add_argument("--out", type=Path, help="folder to write to")
    parser.add_argument("--threads", metavar="N,M,..", help="measure builds by so many threads instead")
    parser.add_argument("--paths", type=float, default=1e7, help="of these builds")
    given = parser.parse_args()
    if given.threads:
        for line in scaling(given.grain, [int(count) for count in given.threads.split(",")], int(given.paths)):
            print(line, flush=True)
        return
    if given.out is None:
        parser.error("name a folder to write to: --out")
    given.out.mkdir(parents=True, exist_ok=True)
    if given.grain.endswith(".json"):
        found = json.loads(Path(given.grain).read_text())
    else:
        found = json.loads(json.dumps(measure(given.grain)))
        with replacing(given.out / "building.json") as temporary:
            temporary.write_text(json.dumps(found, indent=1) + "\n")
    draw(found, given.out)


if __name__ == "__main__":
    main()
