"""A heap bounded by a mesh, on a floor, under a sky: pictures of level teleport-memory against packed grains, by pixel.

    python benchmarks/heap.py [PACKINGS [SAMPLES]]

The truth is the mean over packings (16, with 64 samples per pixel each), its noise their spread. Prints for each level
the root mean square of z, the difference over its standard error, over all pixels and over those along the heap's
outline, where only the first grains are seen; 1 is noise. Writes bench/heap.png.
"""

import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import image, render, world
from tsdf.scene.scene import Camera, EnvironmentLight, GrainSpec, MediumSpec, Mesh, Rectangle, Scene, SurfaceSpec

LEVELS = ("teleport-memory", "teleport-joint")
CAMERA = Camera((10.0, -70.0, 40.0), (0.0, 0.0, 9.0), 60, 40, fov_deg=34.0)
FRACTION = 0.6


def heap(folder: Path) -> Scene:
    """Return a bumpy heap of glass-like spheres of radius 1, 36 wide, on a grey floor under a sky brighter above."""
    import trimesh

    ball = trimesh.creation.icosphere(4)
    points = ball.vertices * (18.0, 14.0, 10.0)
    points = points * (1.0 + 0.12 * np.sin(0.5 * points[:, :1]) * np.cos(0.4 * points[:, 1:2])) + (0.0, 0.0, 11.5)
    trimesh.Trimesh(points, ball.faces, process=False).export(folder / "heap.ply")
    image.write_exr(folder / "sky.exr", np.repeat(np.array([1.0, 0.6, 0.2, 0.0])[:, None, None], 3, axis=2))
    table = scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(joint=64, memory=64))
    medium = MediumSpec(Mesh(folder / "heap.ply"), FRACTION, 1.0, (GrainSpec(table),), name="heap")
    floor = SurfaceSpec(Rectangle((0.0, 0.0, 0.0), (200.0, 0.0, 0.0), (0.0, 200.0, 0.0)), (0.5, 0.5, 0.5))
    return Scene(CAMERA, (EnvironmentLight(folder / "sky.exr"),), (medium,), (floor,), name="heap")


def outline(scene: Scene) -> np.ndarray:
    """Return (h, w) bool: pixels through which both the heap and what is beside it are seen."""
    camera = replace(scene.camera, width=4 * CAMERA.width, height=4 * CAMERA.height)
    made = world.build(replace(scene, camera=camera, surfaces=()), "teleport")
    kernel = world.camera_of(made)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ways = np.array(kernel.corner) + x[..., None] * kernel.right + y[..., None] * kernel.down
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    seen = np.full((1, x.size), -1, np.int32)
    made.place.hits(np.broadcast_to(kernel.origin, (x.size, 3)).astype(np.float32),
                    ways.reshape(-1, 3).astype(np.float32), seen)  # fmt: skip
    share = (seen[0] >= 0).reshape(CAMERA.height, 4, CAMERA.width, 4).mean(axis=(1, 3))
    edge = (share > 0.0) & (share < 1.0)
    for axis in (0, 1):  # and their neighbours, for a grain is wider than a pixel
        edge |= np.roll(edge, 1, axis) | np.roll(edge, -1, axis)
    return edge


def main(packings: int = 16, samples: int = 64) -> None:
    """Render, compare, print, draw."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with tempfile.TemporaryDirectory() as folder:
        scene = heap(Path(folder))
        pictures = []
        for k in range(packings):
            media = (replace(scene.media[0], packing_seed=k),)
            pictures.append(render.render(world.build(replace(scene, media=media), "explicit"), spp=samples, seed=k))
        truth = np.array([picture.rgb[..., 1] for picture in pictures])
        mean, spread = truth.mean(axis=0), truth.var(axis=0, ddof=1) / packings
        edge = outline(scene)
        seconds = sum(picture.seconds for picture in pictures)
        print(
            f"explicit: {packings} packings, {samples} samples each, {seconds:.0f} s; mean radiance {mean.mean():.4f}"
        )
        shown = [("explicit, one packing", truth[0]), (f"explicit, mean of {packings}", mean)]
        for number, level in enumerate(LEVELS):
            own = render.render(world.build(scene, level), spp=packings * samples, seed=1000 + number)
            picture, variance = own.rgb[..., 1], own.variance[..., 1]
            z = (picture - mean) / np.sqrt(variance + spread)
            factor = math.sqrt((packings - 3) / (packings - 1))  # the spread of few packings is itself noisy
            rms = [factor * math.sqrt(float((z[mask] ** 2).mean())) for mask in (np.ones_like(edge), ~edge, edge)]
            bias, largest = 100.0 * (picture.mean() / mean.mean() - 1.0), np.abs(z).max()
            print(f"{level}: {own.seconds:.0f} s; mean {bias:+.2f} %; rms of z {rms[0]:.3f}, "
                  f"off the outline {rms[1]:.3f}, along it {rms[2]:.3f}; largest |z| {largest:.1f}")  # fmt: skip
            shown += [(level, picture), (f"{level}: z", z)]
    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(2, 3)
    for axes, (title, values) in zip(rows.T.ravel(), shown, strict=True):
        if title.endswith("z"):
            drawn = axes.imshow(values, cmap="coolwarm", vmin=-5.0, vmax=5.0)
            figure.colorbar(drawn, ax=axes, shrink=0.7)
        else:
            axes.imshow(values, cmap="gray", vmin=0.0, vmax=0.9)
        axes.set_title(title, fontsize=11)
        axes.set_axis_off()
    out = Path("bench")
    out.mkdir(exist_ok=True)
    figure.savefig(out / "heap.png", dpi=90)
    print(f"wrote {out / 'heap.png'}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
