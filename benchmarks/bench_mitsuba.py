"""The same cube and ball of grains in Mitsuba 3 and in our renderer: ``python benchmarks/bench_mitsuba.py --help``.

Three are timed turn by turn in one process, processor time of all threads: our integrator ``tpt`` and Mitsuba's own
``volpath`` with ``tabphase``, and our renderer's level `teleport`. ``tpt`` is set against ``volpath`` per event, grains
met there and scatterings here (those of our own level `volume`, the same medium, counted there; roulette is off, for
nothing is absorbed), and against our renderer per sample, which must be the same picture: their means are compared.
Writes DIR/mitsuba.md.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

import tsdf.loaders.mitsuba as loader
from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render, world
from tsdf.scene.scene import Box, Camera, ConstantLight, GrainSpec, MediumSpec, Scene, Sphere, SunLight
from tsdf.scene.specs import Light, MediumShape

PACKING = 0.5
SIDE = 48  # pixels
TURNS = 5
REST = 0.1  # [s] in which Mitsuba's threads, which look out for more, come to rest: it takes some ms of our time
LIGHTS = {
    "constant": {"type": "constant"},
    "directional": {"type": "directional", "direction": [-0.36, 0.48, -0.8], "irradiance": 3.0},
}
OWN: dict[str, Light] = {
    "constant": ConstantLight((1.0, 1.0, 1.0)),
    "directional": SunLight((0.36, -0.48, 0.8), (3.0, 3.0, 3.0), 0.01),
}
GOAL = 3.0  # times the speed of tpt
BODIES: dict[str, Callable[[float], MediumShape]] = {
    "cube": lambda half: Box((-half,) * 3, (half,) * 3),
    "ball": lambda half: Sphere((0.0, 0.0, 0.0), half),
}


def scene_of(body: str, half: float, light: str, interior: dict, integrator: dict) -> object:
    """Return a cube or a ball of grains that fills the middle of the picture."""
    at = [0.5 * half, -5.0 * half, 1.2 * half]
    look = mi.ScalarTransform4f().look_at(at, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    shape = "sphere" if body == "ball" else "cube"
    boundary = {"type": shape, "to_world": mi.ScalarTransform4f().scale(half), "bsdf": {"type": "null"}}
    sensor = {"type": "perspective", "fov": 25.0, "to_world": look, "film": film}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": sensor,
            "light": LIGHTS[light],
            "body": boundary | {"interior": interior},
        }
    )


def seconds(scene: object, spp: int, seed: int) -> tuple[float, np.ndarray]:
    """Return the processor time a picture takes (all threads; others may share the machine), and the picture."""
    begin = time.process_time()
    picture = np.array(mi.render(scene, spp=spp, seed=seed))
    return time.process_time() - begin, picture


def own_scene(table: Table, body: str, half: float, light: str) -> Scene:
    """Return the same scene for our own renderer."""
    camera = Camera((0.5 * half, -5.0 * half, 1.2 * half), (0.0, 0.0, 0.0), SIDE, SIDE, fov_deg=25.0)
    medium = MediumSpec(BODIES[body](half), PACKING, 1.0, (GrainSpec(table),), name="grains")
    return Scene(camera, (OWN[light],), (medium,), name="bench")


def row(table: Table, body: str, half: float, light: str, spp: int) -> str:
    """Return a line about one body in one light."""
    tpt = scene_of(body, half, light, loader.granular(table, PACKING, 1.0), {"type": "tpt", "count": True})
    stock = {"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000}
    volpath = scene_of(body, half, light, loader.medium(table, PACKING, 1.0), stock)
    scene = own_scene(table, body, half, light)
    own = world.build(scene, "teleport")
    counted = render.render(world.build(own_scene(table, body, half, "constant"), "volume"), spp=32)
    scattered = counted.events / counted.samples.sum()
    samples = spp * SIDE**2
    events: list[tuple[float, float]] = []
    each: list[tuple[float, float]] = []
    values: list[tuple[float, float, float]] = []
    met = 0.0
    for turn in range(TURNS + 1):
        took, picture = seconds(tpt, spp, turn)
        met = float(picture[..., -1].mean())
        other, _ = seconds(volpath, spp, turn)
        time.sleep(REST)
        begin = time.process_time()
        ours = render.render(own, spp=spp, seed=turn)
        mine = time.process_time() - begin
        if turn:  # the first compiles
            events.append((1e9 * took / (met * samples), 1e9 * other / (scattered * samples)))
            each.append((1e6 * took / samples, 1e6 * mine / samples))
            values.append((float(picture[..., :3].mean()), float(ours.rgb.mean()), float(ours.variance.mean())))
    a, b = (statistics.median(t) for t in zip(*events, strict=True))
    c, d = (statistics.median(t) for t in zip(*each, strict=True))
    faster = statistics.median(x / y for x, y in each)
    theirs, mean, variance = (statistics.fmean(v) for v in zip(*values, strict=True))
    error = math.sqrt(2.0 * variance / (SIDE**2 * TURNS))  # as much noise in tpt's
    off = f"{theirs / mean - 1.0:+.1e} +- {error / mean:.0e}"
    return (
        f"| {body} | {half:g} | {light} | {a:.0f} | {b:.0f} | {b / a:.2f} | {met:.1f} | {scattered:.1f} | {c:.2f} "
        f"| {d:.2f} | {faster:.1f} | {off} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", help="a table; without, the exact sphere of eta 1.33")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (llvm_ad_rgb)")
    parser.add_argument("--body", choices=tuple(BODIES), help="which (both)")
    parser.add_argument("--spp", type=int, default=128, help="samples per pixel (128)")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder for the results")
    args = parser.parse_args()
    loader.set_variant(args.variant)
    if args.table:
        table = tsdf_format.read(args.table)
    else:
        table = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=256, joint=0))
    text = [
        f"# Mitsuba {mi.__version__}, {args.variant}, and our own renderer",
        "",
        f"{table!r}; processor time of all threads, medians of {TURNS} turns of {args.spp} samples per pixel. Goal: our"
        f" renderer {GOAL:g} times as fast as tpt.",
        "",
        "| body | half its width / R | light | tpt ns/event | volpath ns/event | ratio | tpt events | volpath events "
        "| tpt us/sample | ours us/sample | ours is faster | tpt's mean / ours - 1 |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    print("\n".join(text), flush=True)
    for body in BODIES if args.body is None else (args.body,):
        for half in (4.0, 12.0, 40.0):
            for light in LIGHTS:
                text.append(row(table, body, half, light, args.spp))
                print(text[-1], flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "mitsuba.md").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main()
