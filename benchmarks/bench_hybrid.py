"""The first k grains one by one, then a chain: slabs, the texture of one packing, beads, grains of many facets.

    python benchmarks/bench_hybrid.py [slabs] [texture] [beads] [facets] [EFFORT]

Everything is against level explicit with the same packings. Slabs: reflectance and transmittance. Texture: the error of
a pixel, root mean square over the mean; from two independent halves, whose noise has no part in it. EFFORT, 1 if not
given, multiplies the paths; 1 takes about eight minutes of one core.
"""

import itertools
import math
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import image, render, world
from tsdf.scene.scene import Camera, EnvironmentLight, GrainSpec, MediumSpec, Render, Scene, Slab, load, resized
from tsdf.spheres.packing import pack
from tsdf.study.experiment import SPHERES, gather, slab_experiment
from tsdf.walk import transport

COUNTS = (0, 1, 2, 3, 5, 7, 10)
FRACTION = 0.6
PACKINGS, PLACES = 12, 6  # of the slabs: so many heights at which they are cut from a tile hold all its spheres
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
ABOVE = Camera((0.0, 0.0, 50.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))
DOWN, STILL = (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)
ROWS = (  # eta, layer of centres [R], footprint [R], pixels along a side, samples of each half
    (1.33, 10.0, 0.0, 10, 400), (1.33, 10.0, 0.5, 12, 1000), (1.33, 10.0, 2.0, 8, 3000), (1.33, 40.0, 0.5, 12, 1000),
    (1.5, 10.0, 0.5, 12, 1000), (1.5, 10.0, 2.0, 8, 3000),
)  # fmt: skip


def sphere(eta: float) -> Table:
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(eta), Effort(joint=64, memory=64))


def slabs(effort: float) -> None:
    """Print R and T of slabs; the spread over packings is the error of what has single grains."""
    print("slab, sphere 1.33, f .6 | k | R [%] | of explicit [%] | T [%] | of explicit [%]")
    grain = GrainSpec(sphere(1.33))
    for layer, paths in ((4.0, 4e6), (10.0, 1.2e6), (40.0, 4e5)):
        side = pack(FRACTION, SPHERES, 0).side
        places = [(packing, side * i / PLACES) for packing in range(PACKINGS) for i in range(PLACES)]
        each = int(effort * paths / len(places))

        def passed(level: str, k: int) -> np.ndarray:
            rows = []
            for number, (packing, top) in enumerate(places):  # noqa: B023
                made = slab_experiment(level, grain, FRACTION, layer, 1.0, packing, None, top, k)  # noqa: B023
                rows.append(gather(made, each, seed=number, threads=1).mean[:2])  # noqa: B023
            return np.reshape(rows, (PACKINGS, PLACES, 2)).mean(axis=1)

        truth = passed("explicit", 0)
        mean, n = truth.mean(axis=0), len(truth)
        own = 100.0 * truth.std(axis=0, ddof=1) / math.sqrt(n) / mean
        print(f"{layer:g} R | explicit | {100 * mean[0]:.3f} | ± {own[0]:.2f} | {100 * mean[1]:.3f} | ± {own[1]:.2f}")
        for k in (0, 1, 2, 5, 10):
            ratio = 100.0 * (passed("teleport-memory", k) - truth) / mean
            off, error = ratio.mean(axis=0), ratio.std(axis=0, ddof=1) / math.sqrt(n)
            found = mean * (1.0 + 0.01 * off)
            print(f"{layer:g} R | {k} | {100 * found[0]:.3f} | {off[0]:+.2f} ± {error[0]:.2f} "
                  f"| {100 * found[1]:.3f} | {off[1]:+.2f} ± {error[1]:.2f}", flush=True)  # fmt: skip


def texture(effort: float, folder: Path) -> None:
    """Print the error of pixels by footprint and k: of two packings, the root of the product of two halves' means."""
    image.write_exr(folder / "sky.exr", np.array([[[1.0] * 3], [[0.0] * 3]]))
    print("texture: eta, T, w | " + " | ".join(f"k = {k}" for k in COUNTS) + " | known to")
    for eta, layer, w, side, samples in ROWS:
        table, spp = sphere(eta), max(2, int(effort * samples))

        def half(level: str, k: int, packing: int, seed: int) -> np.ndarray:
            spec = MediumSpec(Slab(-layer, 0.0), FRACTION, 1.0, (GrainSpec(table),), inside="centres",  # noqa: B023
                              packing_seed=packing)  # fmt: skip
            made = world.build(
                Scene(ABOVE, (EnvironmentLight(folder / "sky.exr"),), (spec,), render=Render(explicit_grains=k)), level
            )
            if w > 0.0:  # noqa: B023
                grid = transport.CameraArrays((0.0, 0.0, layer), (w, 0.0, 0.0), (0.0, w, 0.0), DOWN, STILL, STILL, side)  # noqa: B023
                return render.measure(made, grid, side, side, spp, seed=seed, threads=1).rgb[..., 1].ravel()  # noqa: B023
            rays = [transport.CameraArrays((2.3 * i, 2.3 * j, layer), STILL, STILL, DOWN, STILL, STILL, 1)  # noqa: B023
                    for i, j in itertools.product(range(side), repeat=2)]  # noqa: B023  # fmt: skip
            return np.array([
                render.measure(made, ray, spp=spp, seed=len(rays) * seed + i, threads=1).rgb[0, 0, 1]  # noqa: B023
                for i, ray in enumerate(rays)
            ])  # fmt: skip

        runs = [(packing, seed) for packing in (0, 1) for seed in (0, 1)]
        truth = {run: half("explicit", 0, *run) for run in runs}
        mean = np.mean([*truth.values()])
        cells, known = [], 0.0
        for k in COUNTS:
            apart = {run: half("teleport-memory", k, *run) - truth[run] for run in runs}
            products = np.concatenate([apart[packing, 0] * apart[packing, 1] for packing in (0, 1)]) / mean**2
            known = math.sqrt(products.std() / math.sqrt(len(products)))
            cells.append(f"{100.0 * math.copysign(math.sqrt(abs(products.mean())), products.mean()):.1f}")
        print(f"{eta:g}, {layer:g}, {w:g} | " + " | ".join(cells) + f" | {100.0 * known:.1f}", flush=True)


def timed(scene: Scene, level: str, k: int, spp: int, seeds: tuple[int, ...]) -> tuple[list[render.Picture], float]:
    """Return pictures of one thread with different random numbers, and the processor time of one [s]."""
    made = world.build(replace(scene, render=Render(explicit_grains=k)), level)
    render.render(made, 1, threads=1)
    began = time.process_time()
    pictures = [render.render(made, spp, seed=seed, threads=1) for seed in seeds]
    return pictures, (time.process_time() - began) / len(seeds)


def beads(effort: float, width: int = 320) -> None:
    """Print how far the beads are from those traced one by one, in the picture and where there are beads."""
    scene = resized(load(Path(__file__).parents[1] / "scenes" / "beads.toml"), width)
    spp = max(4, int(effort * 48))
    truth, taken = timed(scene, "explicit", 0, spp, (1, 2))
    bare = timed(replace(scene, media=()), "explicit", 0, spp, (3,))[0][0].rgb @ LUMINANCE
    light = [picture.rgb @ LUMINANCE for picture in truth]
    pile = np.abs(0.5 * (light[0] + light[1]) - bare) > 0.1 * bare
    mean, base = np.mean(light), 0.0
    print(f"beads {width} wide, {spp} spp: k | rms [% of the mean] | in the pile | bias [%] | variance to explicit "
          "| time per sample to teleport-memory")  # fmt: skip
    for k in (0, 2, 5, 10):
        made, own = timed(scene, "teleport-memory", k, spp, (1, 2))
        base = base or own
        one, other = (picture.rgb @ LUMINANCE - it for picture, it in zip(made, light, strict=True))
        square = one * other / mean**2
        rms, inside = (100.0 * math.sqrt(max(0.0, some.mean())) for some in (square, square[pile]))
        variance = made[0].variance.mean() / truth[0].variance.mean()
        print(f"{k} | {rms:.1f} | {inside:.1f} | {100 * 0.5 * (one + other).mean() / mean:+.2f} | {variance:.2f} "
              f"| {own / base:.2f}", flush=True)  # fmt: skip
    print(f"explicit | | | | 1 | {taken / base:.2f}")


def facets(effort: float, folder: Path) -> None:
    """Print how much sooner a slab of 40 R of spheres of 20,480 facets has the same error of pixels than explicit."""
    grain = load_grain("icosphere", subdivisions=5)
    build = scatterometer.Build.start(grain, Optics(1.33), Effort(int(3e5), memory=64))
    build.run(grain, 2)
    image.write_exr(folder / "sky.exr", np.array([[[1.0] * 3], [[0.0] * 3]]))
    spec = MediumSpec(Slab(-40.0, 0.0), FRACTION, 1.0, (GrainSpec(build.table()),), inside="centres")
    scene = Scene(ABOVE, (EnvironmentLight(folder / "sky.exr"),), (spec,))
    print("40 R of spheres of 20,480 facets | reflectance [%] | relative variance x time, explicit's over it")
    base = 0.0
    for level, k in (("explicit", 0), *(("teleport-memory", k) for k in (0, 2, 5, 10))):
        made = world.build(replace(scene, render=Render(explicit_grains=k)), level)
        beam = world.beam(made, (0.0, 0.0, 50.0), DOWN, 300.0)
        render.measure(made, beam, spp=100, threads=1)
        began = time.process_time()
        picture = render.measure(made, beam, spp=int(effort * 6000), threads=1)
        taken = time.process_time() - began
        r, variance = picture.rgb[0, 0, 1], picture.variance[0, 0, 1]
        base = base or variance / r**2 * taken
        print(f"{level}, {k} | {100 * r:.2f} ± {100 * math.sqrt(variance):.2f} "
              f"| {base / (variance / r**2 * taken):.1f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word in ("slabs", "texture", "beads", "facets")]
    effort = float(next((word for word in sys.argv[1:] if word not in words), 1.0))
    with tempfile.TemporaryDirectory() as temporary:
        if not words or "slabs" in words:
            slabs(effort)
        if not words or "texture" in words:
            texture(effort, Path(temporary))
        if not words or "beads" in words:
            beads(effort)
        if not words or "facets" in words:
            facets(effort, Path(temporary))
