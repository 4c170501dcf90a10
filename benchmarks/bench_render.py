"""Measure the renderer: ``python benchmarks/bench_render.py --help``. Writes DIR/render.md.

(a) Grain events per second deep inside a large medium, without leaps, at each level, with one and two threads, beside
the cost of drawing an event alone (`bench_sampler`). (b) Time to equal variance of multiply scattered light, explicit
against teleport. Multiply scattered light is the diffuse reflectance of a thick slab of lossless grains: light that a
grain sends back at its first event is a few per cent of it, and its share is stated. (c) Beside each, a furnace of
radiance 1 around the same grains, which must read 1: a fast wrong answer shows. (d) The explicit level's rays per
second against what the ray engine alone makes of the very same rays. (e) Where pictures are made: a cube of 4 R, balls
of 80 to 80,000 facets and grains of 1/10 to 1/100,000 of them, beside the bulk, whose walkers go one by one or are in
lanes, and the scenes of scenes/ where `make demo` has made their tables. What is compared runs in turn in one process;
numbers are medians over rounds, ratios medians of the ratios of a round. Where others share the machine, processor time
is steadier than the wall's: (b) and (d) use it, (a) gives both, and the scaling of two kernels that share nothing,
which is what the machine has to give.
"""

import argparse
import math
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_sampler import algorithm_1, built, henyey_greenstein, joint_records

from tsdf.data.sampler import compile_tables
from tsdf.data.table import Table
from tsdf.errors import TSDFError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Build, Effort, exact_sphere
from tsdf.picture import image, render, world
from tsdf.picture.render import Picture, Walkers
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Scene,
    Slab,
    Sphere,
    SunLight,
    load,
    resized,
)
from tsdf.scene.specs import Light, MediumShape
from tsdf.walk.transport import EVENTS, Job

FRACTION = 0.6
LARGE = 500.0  # [R] radius of the ball of grains
THICK = 60.0  # [R] thickness of the slab
FACETS = 5  # subdivisions of the icosphere: 20,480 facets
ETA = 1.31
DEEP = tuple(name for name, level in LEVELS.items() if level.traits.leaps)
DRAWS = {"teleport": "Algorithm 1", "teleport-joint": "joint records", "volume-hg": "Henyey-Greenstein"}
MEMORY = 64  # records per cell of entry
SCENES = Path(__file__).parent.parent / "scenes"
SHIPPED = {
    "snow": ("teleport", "teleport-memory"),
    "sand": ("teleport", "teleport-memory"),
    "beads": ("teleport", "teleport-memory", "explicit"),
}
GOALS = {"events": 10e6, "scaling": 1.7, "gain": 10.0}


def scene(table: Table, shape: MediumShape, light: Light) -> Scene:
    """Return grains of radius 1 in a shape, seen from the origin."""
    medium = MediumSpec(shape, FRACTION, 1.0, (GrainSpec(table),), name="grains")
    return Scene(Camera((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1, 1), (light,), (medium,), name="bench")


def furnace(picture: Picture) -> str:
    """Return the deviation of a furnace from 1 and how many standard errors that is; a lossless one has no noise."""
    off, sigma = float(picture.rgb.mean()) - 1.0, math.sqrt(float(picture.variance.mean()))
    lost = f", {picture.truncated + picture.faults} lost" if picture.truncated + picture.faults else ""
    return f"{off:+.1e}" + (f" ({abs(off) / sigma:.1f} sigma)" if sigma > 0.0 else "") + lost


def clocked(work: Callable[[], object]) -> tuple[float, float]:
    """Return the seconds that work takes, on the wall and of processors."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def events(tables: dict[str, Table], rounds: int, many: int) -> list[str]:
    """Return lines about events per second; `many` is how many events a measurement has, about."""
    text = [
        "| table | level | million events/s | per CPU second | two threads, per CPU second | scaling "
        "| of plain kernels | ns/event | over teleport | ns/draw alone | furnace - 1 |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    pool = ThreadPoolExecutor(2)
    for name, table in tables.items():
        compiled, g = compile_tables([table], joint=True), float(table.statistics["mean_cosine"])
        works: dict[str, Callable[[int], float]] = {
            "Henyey-Greenstein": lambda n, g=g: henyey_greenstein(g, n, 1),  # type: ignore[misc]
            "Algorithm 1": lambda n, compiled=compiled: algorithm_1(compiled, n, 1),  # type: ignore[misc]
            "joint records": lambda n, compiled=compiled: joint_records(compiled, n, 1),  # type: ignore[misc]
        }
        for draw in works.values():
            draw(1000)  # compiles
        draws: dict[str, list[float]] = {way: [] for way in works}
        ball = scene(table, Sphere((0.0, 0.0, 0.0), LARGE), ConstantLight((1.0, 1.0, 1.0)))
        made = {level: world.build(ball, level, leap=0.0) for level in DEEP}
        spp, checks = {}, {}
        for level, one in made.items():
            first = render.render(one, spp=512, threads=1, seed=99)
            spp[level] = max(256, round(512 * many / first.events))
            checks[level] = furnace(first)
        rates: dict[tuple[str, int], list[tuple[float, float]]] = {(level, n): [] for level in DEEP for n in (1, 2)}
        plain: dict[str, list[float]] = {level: [] for level in DEEP}
        for k in range(rounds):
            for way, draw in works.items():
                draws[way].append(clocked(lambda draw=draw: draw(many // 4))[1] / (many // 4) * 1e9)  # type: ignore[misc]
            for level, one in made.items():
                for threads in (1, 2):
                    pictures: list[Picture] = []
                    wall, cpu = clocked(
                        lambda one=one, n=spp[level], threads=threads, k=k, pictures=pictures: pictures.append(  # type: ignore[misc]
                            render.render(one, spp=n, threads=threads, seed=k)
                        )
                    )
                    rates[level, threads].append((pictures[0].events / wall, pictures[0].events / cpu))
                whole = clocked(lambda g=g: henyey_greenstein(g, 4 * many, 1))[0]  # type: ignore[misc]
                half = clocked(lambda g=g: list(pool.map(lambda s: henyey_greenstein(g, 2 * many, s), (1, 2))))[0]  # type: ignore[misc]
                plain[level].append(whole / half)
        for level in DEEP:
            (one_wall, one_cpu), (two_wall, two_cpu) = (zip(*rates[level, n], strict=True) for n in (1, 2))
            scaling = statistics.median(b / a for a, b in zip(one_wall, two_wall, strict=True))
            ns = 1e9 / statistics.median(one_cpu)
            base = [rate for _, rate in rates["teleport", 1]]
            ratio = statistics.median(b / a for a, b in zip(one_cpu, base, strict=True))
            draw_ns = statistics.median(draws[DRAWS[level]]) if level in DRAWS else math.nan
            alone = f"{draw_ns:.0f} ({ns / draw_ns:.1f} times)" if level in DRAWS else "-"
            row = (
                f"| {name} | {level} | {statistics.median(one_wall) / 1e6:.1f} "
                f"| {statistics.median(one_cpu) / 1e6:.1f} | {statistics.median(two_cpu) / 1e6:.1f} "
                f"| {scaling:.2f} | {statistics.median(plain[level]):.2f} "
                f"| {ns:.0f} | {ratio:.2f} | {alone} | {checks[level]} |"
            )
            print(row, flush=True)
            text.append(row)
    pool.shutdown()
    return text


def faceted() -> Table:
    """Return a table of the sphere of 20,480 facets."""
    grain = load_grain("icosphere", subdivisions=FACETS)
    build = Build.start(grain, Optics(ETA), Effort(paths=200_000, joint=32, memory=MEMORY))
    build.run(grain)
    return build.table()


def single_share(table: Table, reflectance: float) -> float:
    """Return the share of a thick slab's reflectance at normal incidence that is light of one event, by p_theta."""
    cosines = 0.5 * (table.cos_theta_edges[1:] + table.cos_theta_edges[:-1])
    up = np.maximum(-cosines, 0.0)
    return float((table.p_theta * up / (1.0 + up)).sum()) / reflectance


@dataclass(frozen=True)
class Shot:
    """One block of samples of a beam, by one thread."""

    samples: np.ndarray  # (n,) reflectance that each found
    seconds: float
    events: int


def shot(made: world.World, walkers: Walkers, samples: int, seed: int) -> Shot:
    """Follow a block that is large enough for its last long paths, with little to do at once, not to matter much."""
    beam = world.beam(made, (0.0, 0.0, THICK), (0.0, 0.0, -1.0), 100.0)
    before = int(walkers.counters[EVENTS])
    start = time.process_time()
    radiance = walkers.follow(Job(beam, 0, samples, 0, seed), 1, threading.Event())
    taken = time.process_time() - start
    return Shot(radiance[0, :, 0], taken, int(walkers.counters[EVENTS]) - before)


def equal_variance(table: Table, rounds: int, seconds: float, folder: Path) -> tuple[list[str], float]:
    """Return lines about time times variance of a slab's reflectance, and the median gain of teleport."""
    slab = Slab(-0.5 * THICK, 0.5 * THICK)
    levels = ("explicit", "teleport-memory", "teleport", "teleport-joint")
    chance = "teleport, lights met by chance"

    def under(name: str, below: float) -> dict[str, world.World]:
        """Return the slab at each level under a white sky, above ground of a radiance of its own."""
        sky = np.ones((2, 4, 3))
        sky[1] = below
        image.write_exr(folder / name, sky)
        made = {level: world.build(scene(table, slab, EnvironmentLight(folder / name)), level) for level in levels}
        made[chance] = world.build(made["teleport"].scene, "teleport")
        made[chance].lights = made[chance].lights._replace(sampled=False)
        return made

    lit, hot = under("sky.exr", 0.0), under("furnace.exr", 1.0)
    walkers = {level: Walkers(made) for level, made in lit.items()}
    samples = {}
    for level, made in lit.items():
        shot(made, walkers[level], 64, 98)  # compiles
        trial = shot(made, walkers[level], 1024, 99)
        samples[level] = max(4096, round(1024 * seconds / trial.seconds))
    found: dict[str, list[Shot]] = {level: [] for level in lit}
    for k in range(rounds):
        for j, (level, made) in enumerate(lit.items()):
            found[level].append(shot(made, walkers[level], samples[level], 8 * k + j))
    text = [
        "| level | reflectance | one event only | events per sample | CPU us per sample | variance per sample "
        "| time to equal variance, explicit / it | furnace - 1 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    variances = {level: float(np.var([one.samples for one in shots])) for level, shots in found.items()}
    gain = math.nan
    for level, shots in found.items():
        everything, n = np.concatenate([one.samples for one in shots]), samples[level]
        value, error = float(everything.mean()), math.sqrt(variances[level] / len(everything))
        cost = [one.seconds / n * variances[level] for one in shots]
        base = [one.seconds / samples["explicit"] * variances["explicit"] for one in found["explicit"]]
        ratio = statistics.median(b / a for a, b in zip(cost, base, strict=True))
        gain = ratio if level == "teleport" else gain
        check = shot(hot[level], Walkers(hot[level]), n // 4, 7).samples
        off, sigma = float(check.mean()) - 1.0, float(check.std()) / math.sqrt(len(check))
        row = (
            f"| {level} | {value:.4f} +- {error:.4f} | {100.0 * single_share(table, value):.1f} % "
            f"| {sum(one.events for one in shots) / len(everything):.1f} "
            f"| {statistics.median(1e6 * one.seconds for one in shots) / n:.1f} | {variances[level]:.3f} "
            f"| {ratio:.2f} | {off:+.1e} +- {sigma:.1g} |"
        )
        print(row, flush=True)
        text.append(row)
    return text, gain


def rays(table: Table, rounds: int, samples: int) -> str:
    """Return a line about the explicit level's rays per second and the ray engine's with the very same rays."""
    slab = Slab(-0.5 * THICK, 0.5 * THICK)
    made = world.build(scene(table, slab, ConstantLight((1.0, 1.0, 1.0))), "explicit")
    engine, batches, walkers = made.packed.engines[0], [], Walkers(made)

    class Logged:
        def run(self, starts: np.ndarray, ways: np.ndarray) -> np.ndarray:
            batches.append((starts.copy(), ways.copy()))
            return engine.run(starts, ways)

    made.packed.engines[0] = Logged()
    shot(made, walkers, samples, 1)
    made.packed.engines[0] = engine
    count = sum(len(starts) for starts, _ in batches)
    rates, ratios = [], []
    for _ in range(rounds):
        whole = shot(made, walkers, samples, 1).seconds
        start = time.process_time()
        for starts, ways in batches:
            engine.run(starts, ways)
        rates.append(count / whole)
        ratios.append((time.process_time() - start) / whole)
    rate, ratio = statistics.median(rates), statistics.median(ratios)
    return (
        f"Rays on the grain, one thread: {rate / 1e6:.2f} million per second at the explicit level, "
        f"{rate / ratio / 1e6:.2f} million by the ray engine alone, a share of {ratio:.2f} of the time; {len(batches)} "
        f"batches of {count / len(batches):.0f} rays on average."
    )


def outlook(table: Table, shape: MediumShape, size: float, radius: float, light: Light) -> Scene:
    """Return grains in a shape of a size about the origin, seen whole from outside in 160 x 90 pixels; they absorb a
    little, or light would stay in large bodies for ever."""
    grain = GrainSpec(table, absorption=Absorption("grey", (0.02 / radius,)))
    medium = MediumSpec(shape, FRACTION, radius, (grain,), name="grains")
    camera = Camera((0.0, -4.0 * size, 1.2 * size), (0.0, 0.0, 0.0), 160, 90)
    return Scene(camera, (light,), (medium,), name="bench")


def near(table: Table, rounds: int, spp: int, folder: Path) -> list[str]:
    """Return lines about processor time per sample and per event where boundaries are near, beside the bulk's."""
    import trimesh

    white, sun = ConstantLight((1.0, 1.0, 1.0)), SunLight((-0.48, -0.36, 0.8), (3.0, 3.0, 3.0))
    box = Box((-4.0, -4.0, -4.0), (4.0, 4.0, 4.0))
    bulk = world.build(scene(table, Sphere((0.0, 0.0, 0.0), LARGE), white), "teleport", leap=0.0)
    made = {
        f"cube of half side 4 R, {name}, {level}": world.build(outlook(table, box, 4.0, 1.0, light), level, leap=0.0)
        for name, light in (("constant", white), ("sun", sun))
        for level in ("teleport", "teleport-memory")
    }
    for subdivisions in (1, 3, 6):
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
        mesh.export(folder / f"{subdivisions}.ply")
        for radius in (1e-1, 1e-2, 1e-4, 1e-5):
            one = outlook(table, Mesh(folder / f"{subdivisions}.ply"), 1.0, radius, sun)
            made[f"ball of {len(mesh.faces)} facets, grains of {radius:g}, sun"] = world.build(
                one, "teleport", leap=0.0
            )
        bumps = np.sin(9.0 * mesh.vertices).prod(axis=1, keepdims=True)
        trimesh.Trimesh(mesh.vertices * (1.0 + 0.1 * bumps), mesh.faces).export(folder / f"bumpy{subdivisions}.ply")
        one = outlook(table, Mesh(folder / f"bumpy{subdivisions}.ply"), 1.0, 1e-1, sun)
        made[f"bumpy ball of {len(mesh.faces)} facets, grains of 0.1, sun"] = world.build(one, "teleport", leap=0.0)
    for name, levels in SHIPPED.items():
        try:
            shipped = resized(load(SCENES / f"{name}.toml"), 160)
            made |= {f"{name}.toml, {level}": world.build(shipped, level) for level in levels}
        except TSDFError:
            print(f"{name}.toml is left out: make tables makes its tables")
    for one in (bulk, *made.values()):
        render.render(one, spp=1, threads=1)
    one_by_one(bulk, 16, 0)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in made}
    shares: dict[str, list[tuple[float, float]]] = {name: [] for name in made}
    for k in range(rounds):
        deep, cpu = cost(bulk, 4096, k)
        base, single = cpu / deep.events, one_by_one(bulk, 1024, k)
        for name, one in made.items():
            picture, cpu = cost(one, spp, k)
            times[name].append((1e6 * cpu / picture.samples.sum(), 1e9 * cpu / picture.events))
            shares[name].append((cpu / picture.events / single, cpu / picture.events / base))
    text = [
        "| scene | CPU us per sample | ns per event | over the bulk's, walkers one by one | in lanes |",
        "|---|---|---|---|---|",
    ]
    for name in made:
        sample, event = (statistics.median(column) for column in zip(*times[name], strict=True))
        alone, lanes = (statistics.median(column) for column in zip(*shares[name], strict=True))
        text.append(f"| {name} | {sample:.2f} | {event:.0f} | {alone:.1f} | {lanes:.1f} |")
    return text


def one_by_one(made: world.World, samples: int, seed: int) -> float:
    """Return the processor time [s] per event of so many samples of one pixel, of walkers that are not in lanes."""
    walkers = Walkers(made)
    walkers.lanes = None
    start = time.process_time()
    walkers.follow(Job(world.camera_of(made), 0, samples, 0, seed), 1, threading.Event())
    return (time.process_time() - start) / float(walkers.counters[EVENTS])


def cost(made: world.World, spp: int, seed: int) -> tuple[Picture, float]:
    """Return a picture by one thread and its processor time."""
    start = time.process_time()
    picture = render.render(made, spp=spp, threads=1, seed=seed)
    return picture, time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rounds, fewer events")
    parser.add_argument("--near", action="store_true", help="only the table near boundaries, on stdout")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder for the results")
    given = parser.parse_args()
    rounds, many, seconds = (3, 1_000_000, 1.0) if given.quick else (5, 4_000_000, 3.0)
    sphere = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=256, joint=32, memory=MEMORY))
    spp = 4 if given.quick else 8
    if given.near:
        with tempfile.TemporaryDirectory() as folder:
            print("\n".join(near(sphere, rounds, spp, Path(folder))))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    tables = {"exact sphere": sphere, "snow": built("snow", 200_000, 32, MEMORY)}
    text = [
        "# The renderer",
        "",
        f"Medians of {rounds} rounds, side by side in one process; packing fraction {FRACTION}. Goals: "
        f"{GOALS['events'] / 1e6:.0f} million events per second and thread at teleport, scaling {GOALS['scaling']}, "
        f"gain {GOALS['gain']:.0f}.",
        "",
        f"## Deep inside: the middle of a ball of {LARGE:.0f} R",
        "",
        *events(tables, rounds, many),
    ]
    table = faceted()
    with tempfile.TemporaryDirectory() as folder:
        lines, gain = equal_variance(table, rounds, seconds, Path(folder))
        boundaries = near(sphere, rounds, spp, Path(folder))
    text += [
        "",
        f"## Multiply scattered light: a slab of {THICK:.0f} R, grains of 20,480 facets, one thread",
        "",
        *lines,
        "",
        f"Teleport takes 1/{gain:.1f} of the time of explicit to equal variance.",
        "",
        rays(table, 3, 4096 if given.quick else 8192),
        "",
        "## Near boundaries: whole pictures, one thread",
        "",
        *boundaries,
    ]
    (given.out / "render.md").write_text("\n".join(text) + "\n")
    print("\n".join(text))


if __name__ == "__main__":
    main()
