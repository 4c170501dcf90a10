"""Time per event in Mitsuba 3: ``tpt`` per grain met, beside stock ``volpath`` with ``tabphase`` per scattering event.

Usage: python benchmarks/bench_mitsuba.py [TABLE] [--variant NAME] [--spp N]

One run, one machine, turn by turn. The scattering events of ``volpath`` are those of our own renderer's level `volume`,
the same medium, counted there; roulette is off, for nothing is absorbed.
"""

import argparse
import statistics
import time

import mitsuba as mi
import numpy as np

import tsdf.loaders.mitsuba as loader
from tsdf.data import format as tsdf_format
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import render, world
from tsdf.scene.scene import Box, Camera, ConstantLight, GrainSpec, MediumSpec, Scene

PACKING = 0.5
SIDE = 48  # pixels
TURNS = 5
LIGHTS = {
    "constant": {"type": "constant"},
    "directional": {"type": "directional", "direction": [-0.36, 0.48, -0.8], "irradiance": 3.0},
}


def scene_of(half: float, light: str, interior: dict, integrator: dict) -> object:
    """Return a cube of grains that fills the middle of the picture."""
    at = [0.5 * half, -5.0 * half, 1.2 * half]
    look = mi.ScalarTransform4f().look_at(at, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    boundary = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(half), "bsdf": {"type": "null"}}
    sensor = {"type": "perspective", "fov": 25.0, "to_world": look, "film": film}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": sensor,
            "light": LIGHTS[light],
            "cube": boundary | {"interior": interior},
        }
    )


def seconds(scene: object, spp: int, seed: int) -> tuple[float, np.ndarray]:
    """Return the processor time a picture takes (all threads; others may share the machine), and the picture."""
    begin = time.process_time()
    picture = np.array(mi.render(scene, spp=spp, seed=seed))
    return time.process_time() - begin, picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", nargs="?", help="a table; without, the exact sphere of eta 1.33")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (llvm_ad_rgb)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel (64)")
    args = parser.parse_args()
    loader.set_variant(args.variant)
    if args.table:
        table = tsdf_format.read(args.table)
    else:
        table = exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=256, joint=0))
    print(f"Mitsuba {mi.__version__}, {args.variant}, {table!r}; processor ns per event, median of {TURNS} turns")
    print(
        f"{'half side / R':>14} {'light':>12} {'tpt':>8} {'volpath':>8} {'ratio':>6} {'tpt events':>11} {'volpath':>8}"
    )
    for half in (4.0, 12.0, 40.0):
        for light in LIGHTS:
            tpt = scene_of(half, light, loader.granular(table, PACKING, 1.0), {"type": "tpt", "count": True})
            stock = {"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000}
            volpath = scene_of(half, light, loader.medium(table, PACKING, 1.0), stock)
            camera = Camera((0.5 * half, -5.0 * half, 1.2 * half), (0.0, 0.0, 0.0), SIDE, SIDE, fov_deg=25.0)
            box = Box((-half,) * 3, (half,) * 3)
            specs = (MediumSpec(box, PACKING, 1.0, (GrainSpec(table),)),)
            own = render.render(world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), specs), "volume"), spp=32)
            scattered = own.events / own.samples.sum()
            times: list[list[float]] = [[], []]
            met = 0.0
            for turn in range(TURNS + 1):
                took, picture = seconds(tpt, args.spp, turn)
                met = float(picture[..., -1].mean())
                other, _ = seconds(volpath, args.spp, turn)
                if turn:  # the first compiles
                    times[0].append(1e9 * took / (met * args.spp * SIDE**2))
                    times[1].append(1e9 * other / (scattered * args.spp * SIDE**2))
            a, b = (statistics.median(t) for t in times)
            print(f"{half:14g} {light:>12} {a:8.0f} {b:8.0f} {b / a:6.2f} {met:11.1f} {scattered:8.1f}", flush=True)


if __name__ == "__main__":
    main()
