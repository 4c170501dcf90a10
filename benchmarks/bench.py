"""Measure the tracer and the tables side by side: ``make bench``, or ``python benchmarks/bench.py --help``.

Everything that is compared runs in turn in one process, and ratios are medians over rounds: on a shared machine single
times mean little. Writes DIR/results.md and DIR/error_against_time.png.
"""

import argparse
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import numpy as np

import tsdf
from tsdf.grain.grains import Grain, embree_scene, load_grain
from tsdf.grain.optics import Optics
from tsdf.judge import analytic
from tsdf.make.crew import Crew
from tsdf.make.scatterometer import Build, Effort, exact_sphere
from tsdf.make.statistics import cos_theta_edges, table_error
from tsdf.make.tally import Tally
from tsdf.make.tracer import Tracer, in_order

ETA = 1.31
CELLS = 256
GRAINS = {
    "sphere of 20,480 facets": ("icosphere", {"subdivisions": 5}),
    "ellipsoid": ("ellipsoid", {}),
    "sand": ("sand", {}),
    "snow": ("snow", {}),
    "cube": ("cube", {}),
}


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def tracer(grain: Grain, plain: bool = False, seed: int = 0) -> Tracer:
    made = Tracer(grain, ETA, plain=plain, seed=seed)
    made.trace(in_order(0, 64), Tally())  # compiles, and warms the caches
    return made


def rays(grain: Grain, rounds: int, paths: int) -> tuple[float, float]:
    """Return the tracer's rays per second and its ratio to what Embree alone makes of the very same rays."""
    batches: list[tuple[np.ndarray, np.ndarray]] = []
    logging = Tracer(grain, ETA)
    logging.log = lambda origins, directions: batches.append((origins.copy(), directions.copy()))
    count = logging.trace(in_order(0, paths), Tally())
    mine, scene = tracer(grain), embree_scene(grain)
    rates, ratios = [], []
    for _ in range(rounds):
        tally = Tally()
        whole = seconds(lambda tally=tally: mine.trace(in_order(0, paths), tally))  # type: ignore[misc]
        raw = seconds(lambda: [scene.run(origins, directions) for origins, directions in batches])
        rates.append(count / whole)
        ratios.append(raw / whole)
    return statistics.median(rates), statistics.median(ratios)


def scaling(grain: Grain, rounds: int, paths: int) -> float:
    """Return how many times faster two threads are than one."""
    tracers = [tracer(grain), tracer(grain)]
    ratios = []
    with ThreadPoolExecutor(2) as pool:

        def run(threads: int) -> None:
            shares = np.array_split(in_order(0, paths), threads)
            list(pool.map(lambda job: job[0].trace(job[1], Tally()), zip(tracers, shares, strict=False)))

        for _ in range(rounds):
            one = seconds(lambda: run(1))
            ratios.append(one / seconds(lambda: run(2)))
    return statistics.median(ratios)


def errors(grain: Grain, plain: bool, doublings: int, first: int) -> list[tuple[int, float, float]]:
    """Return paths, seconds and the noise of p_theta as they grow."""
    made, tally = tracer(grain, plain), Tally()
    points, done, spent = [], 0, 0.0
    for k in range(doublings):
        more = in_order(done, first << k)
        spent += seconds(lambda more=more: made.trace(more, tally))  # type: ignore[misc]
        done = first << k
        points.append((done, spent, table_error(tally, CELLS).sampling_noise))
    return points


def honesty(paths: list[int]) -> list[tuple[int, float, float]]:
    """Return paths, stated and true total variation of p_theta of the traced sphere, noise alone."""
    sphere, rows = load_grain("sphere"), []
    truth = analytic.deflection_masses(cos_theta_edges(CELLS)[1:-1], 1.33, "un")
    for count in paths:
        build = Build.start(sphere, Optics(1.33), Effort(paths=count, cells=CELLS))
        build.run(sphere, 2)
        table = build.table()
        true = 0.5 * float(np.abs(table.p_theta[1:-1] - truth).sum() + table.p_theta[0] + table.p_theta[-1])
        rows.append((count, table.header["table_error"]["sampling_noise"], true))
    return rows


def memory(paths: int) -> float:
    """Return the peak memory of a build in a process of its own [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        code = "import sys; from tsdf.cli.build import main\ntry: main(sys.argv[1:])\nexcept SystemExit: pass\n"
        code += "print(*(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))"
        words = ["snow", "--joint", "64", "--paths", str(paths), "--quiet", "--out", f"{folder}/x.tsdf.exr"]
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1]) / 1024


def tracing(paths: int, threads: int) -> float:
    """Return the share of a build's rounds that its threads are tracing, rather than waiting for a sum or a save."""
    spans: list[tuple[float, float]] = []
    trace = Crew._trace

    def timed(self: Crew, first: int, last: int, side: int) -> int:
        begin = time.perf_counter()
        try:
            return trace(self, first, last, side)
        finally:
            spans.append((begin, time.perf_counter()))

    grain = load_grain("snow")
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(Crew, "_trace", timed):
        build = Build.start(grain, Optics(ETA), Effort(paths=paths))
        build.run(grain, threads, part_file=Path(folder) / "x.part")
    begin, end = min(a for a, _ in spans), max(b for _, b in spans)
    return sum(b - a for a, b in spans) / (threads * (end - begin))


def tables() -> dict[str, float]:
    """Return the seconds that whole-table operations take."""
    sphere = load_grain("sphere")
    exact_sphere(sphere, Optics(1.33), Effort())
    made: list[tsdf.Table] = []
    times = {"exact table of the sphere": seconds(lambda: made.append(exact_sphere(sphere, Optics(1.33), Effort())))}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.tsdf.exr"
        tsdf.write(made[0], path)
        tsdf.read(path)
        times["writing it"] = statistics.median(seconds(lambda: tsdf.write(made[0], path)) for _ in range(5))
        times["reading it"] = statistics.median(seconds(lambda: tsdf.read(path)) for _ in range(5))
    return times


def processor() -> str:
    """Return the name of the processor, not of the machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def chart(curves: dict[str, dict[str, list[tuple[int, float, float]]]], path: Path) -> None:
    """Draw error against time, both estimators, with the slope that every Monte Carlo has."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.add_subplot()
    for k, (name, both) in enumerate(curves.items()):
        for kind, style in (("ours", "-o"), ("plain", "--x")):
            _, times, noise = zip(*both[kind], strict=True)
            axes.loglog(times, noise, style, color=f"C{k}", markersize=4, label=name if kind == "ours" else None)
    ends = np.array(axes.get_xlim())
    level = max(point[2] * point[1] ** 0.5 for both in curves.values() for point in both["plain"])
    axes.loglog(ends, 1.4 * level * ends**-0.5, ":", color="grey", label="slope -1/2")
    axes.set_xlabel("time, one thread [s]")
    axes.set_ylabel(f"noise of p_theta, total variation, {CELLS} cells")
    axes.set_title(
        "Error against time: ours (solid), plain roulette with independent random numbers (dashed)", fontsize=9
    )
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer rounds and paths")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder for the results")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rounds, paths, doublings = (3, 1 << 16, 4) if options.quick else (7, 1 << 18, 6)

    text = [
        "# Benchmarks",
        "",
        f"Median of {rounds} rounds, side by side in one process; {processor()}; eta {ETA}.",
        "",
        "| grain | triangles | rays/s, one thread | to raw Embree | two threads | time to equal error, plain to ours |",
        "|---|---|---|---|---|---|",
    ]
    curves: dict[str, dict[str, list[tuple[int, float, float]]]] = {}
    for label, (name, parameters) in GRAINS.items():
        grain = load_grain(name, **parameters)
        rate, ratio = rays(grain, rounds, paths)
        twice = scaling(grain, rounds, paths)
        curves[label] = {"ours": [], "plain": []}
        gains = []
        for _ in range(1 if options.quick else 3):  # in turn, so that a drift of the machine hits both
            for kind in ("ours", "plain"):
                curves[label][kind] = errors(grain, kind == "plain", doublings, paths >> 3)
            (_, t, e), (_, t_plain, e_plain) = curves[label]["ours"][-1], curves[label]["plain"][-1]
            gains.append((t_plain * e_plain**2) / (t * e**2))
        gain = statistics.median(gains)
        row = f"| {label} | {len(grain.faces)} | {rate / 1e6:.2f} M | {ratio:.2f} | {twice:.2f} | {gain:.2f} |"
        print(row, flush=True)
        text.append(row)
    chart(curves, options.out / "error_against_time.png")

    text += ["", "Is the stated noise true? The traced sphere, eta 1.33, against the exact one:", ""]
    text += ["| paths | stated | true |", "|---|---|---|"]
    counts = [10_000, 100_000, 1_000_000] + ([] if options.quick else [10_000_000])
    text += [f"| {count:,} | {stated:.2e} | {true:.2e} |" for count, stated, true in honesty(counts)]
    small, large = (50_000, 200_000) if options.quick else (250_000, 1_000_000)
    text += ["", "| what | measured |", "|---|---|"]
    text += [f"| peak memory, snow, 64 joint records, {n:,} paths | {memory(n):.0f} MB |" for n in (small, large)]
    text += [f"| {name} | {value * 1e3:.0f} ms |" for name, value in tables().items()]
    text += [f"| share of the time that {n} threads trace | {tracing(40 * paths, n):.3f} |" for n in (2, 16)]
    (options.out / "results.md").write_text("\n".join(text) + "\n")
    print("\n".join(text))


if __name__ == "__main__":
    main()
