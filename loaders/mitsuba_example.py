"""A heap of snow on a floor, by ``tpt`` and by stock ``volpath``, in one run: two pictures and their times.

Usage: python -m tsdf.loaders.mitsuba_example [TABLE] [--out FOLDER] [--variant NAME] [--spp N]

Without a table the grains are glass spheres. One unit is one bounding radius. A boundary stands a little above what it
rests on, so that no two surfaces are in one place.
"""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.errors import TSDFError

RADIUS, HEIGHT = 24.0, 15.0  # of the heap
GAP = 0.02
PACKING = 0.55
ABSORPTION = (2e-3, 1e-3, 3e-4)  # [1/R], bluish


def heap(rings: int = 40, sides: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and triangles (m, 3), normals outward, of a rounded heap with a notch and a flat foot."""
    vertices, faces = [(0.0, 0.0, GAP), (0.0, 0.0, HEIGHT)], []
    for i in range(1, rings + 1):
        x = i / rings
        for j in range(sides):
            a = 2.0 * math.pi * j / sides
            notch = 1.0 - 0.55 * math.exp(-((math.remainder(a + 1.1, 2.0 * math.pi) / 0.35) ** 2)) * math.sin(
                math.pi * x
            )
            up = HEIGHT * (0.5 + 0.5 * math.cos(math.pi * x)) * notch * (1.0 + 0.06 * math.sin(7.0 * a) * x * (1.0 - x))
            vertices.append((RADIUS * x * math.cos(a), RADIUS * x * math.sin(a), GAP + max(up, 0.0)))
    for j in range(sides):
        k = (j + 1) % sides
        faces.append((1, 2 + j, 2 + k))
        for i in range(rings - 1):
            a, b = 2 + i * sides, 2 + (i + 1) * sides
            faces += [(a + j, b + j, b + k), (a + j, b + k, a + k)]
        foot = 2 + (rings - 1) * sides
        faces.append((0, foot + k, foot + j))
    return np.array(vertices), np.array(faces)


def scene_of(interior: dict[str, Any], integrator: dict[str, Any], width: int, height: int) -> Any:
    """Return the scene, with the heap's medium and the integrator given."""
    import mitsuba as mi

    vertices, faces = heap()
    mesh = mi.Mesh("heap", len(vertices), len(faces), props=_properties(interior))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    look = mi.ScalarTransform4f().look_at([-20.0, -78.0, 34.0], [0.0, 0.0, 5.0], [0.0, 0.0, 1.0])
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": {"type": "perspective", "fov": 36.0, "to_world": look, "film": film},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.22, 0.3, 0.42]}},
            "sun": {"type": "directional", "direction": [0.75, 0.3, -0.45], "irradiance": 4.0},
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(400.0),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.16, 0.13, 0.1]}},
            },
            "heap": mesh,
        }
    )


def _properties(interior: dict[str, Any]) -> Any:
    import mitsuba as mi

    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "null"})
    properties["interior"] = mi.load_dict(interior)
    properties["face_normals"] = True
    return properties


def main() -> int:
    parser = argparse.ArgumentParser(prog="mitsuba_example", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("table", nargs="?", help="a table (.tsdf.exr); without, glass spheres")
    parser.add_argument("--out", default=".", help="folder of the pictures (.)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (llvm_ad_rgb)")
    parser.add_argument("--width", type=int, default=480, help="of the picture [pixel] (480)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel (64)")
    args = parser.parse_args()
    try:
        import tsdf.loaders.mitsuba as loader
        from tsdf.data import format as tsdf_format
        from tsdf.grain.grains import load_grain
        from tsdf.grain.optics import Optics
        from tsdf.make.scatterometer import Effort, exact_sphere
        from tsdf.picture import image

        loader.set_variant(args.variant)
        import mitsuba as mi

        table = tsdf_format.read(args.table) if args.table else None
        if table is None:
            table = exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=256, joint=0))
        ways: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
            "tpt": (loader.granular(table, PACKING, 1.0, ABSORPTION), {"type": "tpt"}),
            "volpath": (
                loader.medium(table, PACKING, 1.0, ABSORPTION),
                {"type": "volpath", "max_depth": -1, "rr_depth": 1000},
            ),
        }
        for name, (interior, integrator) in ways.items():
            scene = scene_of(interior, integrator, args.width, args.width * 5 // 8)
            np.array(mi.render(scene, spp=1))  # compiles
            begin = time.perf_counter()
            picture = np.array(mi.render(scene, spp=args.spp), dtype=float)
            took = time.perf_counter() - begin
            image.write_png(Path(args.out) / f"mitsuba_{name}.png", picture)
            print(f"{name}: {took:.1f} s, mean {picture.mean():.4f}, mitsuba_{name}.png")
    except TSDFError as error:
        print(f"mitsuba_example: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
