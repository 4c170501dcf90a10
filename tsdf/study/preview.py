"""Preview: what a grain looks like by itself and in bulk, in seconds, and which level each picture should take.

Six small pictures of one grain under one sky: some grains, a ball, a slab from both sides, a heap from near and far;
the colour of a deep medium; and for each picture the level of `advice`, at which it is drawn if the table can. Lengths
are in bounding radii R. `plots.plot_preview` lays them out.
"""

import math
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsdf.data.table import Table
from tsdf.errors import SceneError, UsageError
from tsdf.picture import image, render, world
from tsdf.picture.media import spectra_of
from tsdf.scene.deep import deep_colour
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Rectangle,
    Render,
    Scene,
    Sphere,
    SurfaceSpec,
)
from tsdf.scene.specs import MediumShape, Triple
from tsdf.spheres.packing import MAX
from tsdf.study.advice import Advice, Medium, advise
from tsdf.walk.explicit import exemplar

WIDTH = 144  # [pixel] of a picture, three quarters as high
COARSE = 80  # [pixel] of the one whose paths take longest
FOV_DEG = 30.0  # horizontal
SPHERES = 500  # in the periodic tile, which is then about 15 R wide
FEW = 0.5  # packing fraction of the single grains
BALL, HEAP = 70.0, (560.0, 210.0)  # [R] radius; radius and height
LAYER = (11.0, 8.0, 3.2)  # [R] of the single grains
SLAB = (130.0, 8.0, 90.0)  # [R] width, thickness, height
SKY = (32, 64)  # [pixel]
EXPOSURE = 0.35  # [stops]


class View(NamedTuple):
    """A thing and where it is looked at from; lengths in R."""

    title: str
    shape: str  # of `_shape`
    thickness: float  # of what light goes through
    position: Triple
    target: Triple
    share: float  # of the time
    packing_fraction: float | None = None  # other than what is asked for
    width: int = WIDTH  # [pixel]

    @property
    def footprint(self) -> float:
        """What a pixel covers [R]."""
        return 2.0 * math.dist(self.position, self.target) * math.tan(math.radians(0.5 * FOV_DEG)) / self.width


def _flank() -> tuple[Triple, Triple]:
    """Return where the heap is looked at from near: a camera 30 R off its flank, and the point below it."""
    at = 0.35 * HEAP[0]
    z = float(_height(np.array(0.35)))
    return (-6.0, -at - 24.0, z + 17.0), (0.0, -at, z)


def _height(r: np.ndarray) -> np.ndarray:
    """Return the height of the heap at a distance from its axis [1 of its radius]."""
    height: np.ndarray = HEAP[1] * (1.0 - r) * (1.0 + 0.5 * r)
    return height


def _views() -> tuple[View, ...]:
    w, d, h = SLAB
    near, flank = _flank()
    return (
        View("single grains", "few", LAYER[2], (0.0, -12.5, 8.5), (0.0, 0.0, 1.3), 2.0, FEW),
        View("ball", "ball", 2.0 * BALL, (0.0, -6.0 * BALL, 2.4 * BALL), (0.0, 0.0, 0.95 * BALL), 1.0),
        View("slab, lit side", "slab", d, (0.35 * w, -2.7 * w, 0.9 * h), (0.0, 0.0, 0.48 * h), 1.0),
        View("slab, from behind", "slab", d, (0.35 * w, 2.7 * w, 0.9 * h), (0.0, 0.0, 0.48 * h), 1.0),
        View("heap, near", "heap", HEAP[1], near, flank, 6.0, width=COARSE),
        View("heap, far", "heap", HEAP[1], (0.0, -4.2 * HEAP[0], 1.4 * HEAP[0]), (0.0, 0.0, 0.35 * HEAP[1]), 1.0),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of a preview.

    Attributes
    ----------
    title : str
    footprint, thickness : float
        What a pixel covers, and how thick the grains lie [R].
    advice : Advice
    drawn : str
        At what it is drawn, where that is not as advised, and why; else empty.
    rgb : (h, w, 3) uint8
        sRGB.
    error : float
        Relative standard error of a pixel [1].
    """

    title: str
    footprint: float
    thickness: float
    advice: Advice
    drawn: str
    rgb: np.ndarray
    error: float


@dataclass(frozen=True, eq=False)
class Preview:
    """All of a preview.

    Attributes
    ----------
    table : Table
    medium : Medium
    panels : tuple of Panel
    deep : (3,) float64
        Linear sRGB of a deep medium in white diffuse light.
    """

    table: Table
    medium: Medium
    panels: tuple[Panel, ...]
    deep: np.ndarray

    @property
    def deep_srgb(self) -> np.ndarray:
        """The deep colour as a pixel, (1, 1, 3) uint8 sRGB."""
        return image.encoded(self.deep.reshape(1, 1, 3))


def preview(
    table: Table,
    absorption: Absorption,
    metres_per_radius: float | None = None,
    packing_fraction: float = 0.6,
    mesh: Path | None = None,
    seconds: float = 12.0,
    threads: int | None = None,
    told: Callable[[float, str], None] | None = None,
) -> Preview:
    """Return pictures of a grain and in bulk, with advice.

    Parameters
    ----------
    table : Table
    absorption : Absorption
        Of what the grains are made of [1/R].
    metres_per_radius : float, optional
        Length of R [m]; needed where a material absorbs.
    packing_fraction : float
        Of bounding spheres, up to the densest random packing.
    mesh : path, optional
        Of the grain, where it is not built in; without it no grain is drawn by itself.
    seconds : float
        For all pictures, compiling not counted [s].
    threads : int, optional
    told : callable, optional
        Called with the share done and a word about it.

    Raises
    ------
    UsageError, SceneError
        In one line.
    """
    if not 0.0 < packing_fraction <= MAX:
        raise UsageError(f"a packing fraction is above 0 and at most {MAX:g}, not {packing_fraction:g}")
    spec = GrainSpec(table, mesh=mesh, absorption=absorption)
    deep, grey = _deep(spec, table, metres_per_radius)
    traced = _traced(spec, table)
    panels = []
    views = _views()
    whole, done = sum(view.share for view in views), 0.0
    with tempfile.TemporaryDirectory() as folder:
        image.write_exr(Path(folder) / "sky.exr", _sky())
        _write_heap(Path(folder) / "heap.obj")
        for view in views:
            if told is not None:
                told(done / whole, view.title)
            fraction = view.packing_fraction or packing_fraction
            advice = advise(view.footprint, view.thickness, _medium(table, fraction, grey))
            level, singles, drawn = _drawable(advice, table, traced)
            scene = _scene(view, spec, fraction, metres_per_radius, Path(folder), singles)
            built = world.build(scene, level, leap=0.0)
            picture = render.render(built, seconds=seconds * view.share / whole, threads=threads or os.cpu_count() or 1)
            shown = image.encoded(picture.rgb, EXPOSURE)
            panels.append(
                Panel(view.title, view.footprint, view.thickness, advice, drawn, shown, picture.relative_error)
            )
            done += view.share
    return Preview(table, _medium(table, packing_fraction, grey), tuple(panels), deep)


def _medium(table: Table, packing_fraction: float, absorption_times_radius: float) -> Medium:
    volume = volume_parameters([Component(table)], packing_fraction, [absorption_times_radius])
    g = volume.g if volume.albedo > 0.0 else 0.0
    return Medium(packing_fraction, volume.transport_mean_free_path, g)


def _traced(spec: GrainSpec, table: Table) -> bool:
    """Return whether the grain itself is there to be traced."""
    try:
        exemplar(spec, table, "preview")
    except SceneError:
        if spec.mesh is not None:
            raise
        return False
    return True


def _drawable(advice: Advice, table: Table, traced: bool) -> tuple[str, int, str]:
    """Return the level and explicit grains nearest to what is advised that a table allows, and why they differ."""
    level, singles, missing = advice.level, advice.explicit_grains, []
    if not traced and (level == "explicit" or singles):
        missing.append("the grain's mesh is not beside the table")
        level, singles = "teleport-packed", 0
    if not table.memory and level in ("teleport-packed", "teleport-memory"):
        missing.append("no records by entry, tsdf-build --memory 64")
        level = "teleport"
    return level, singles, f"drawn at {level}: {'; '.join(missing)}" if missing else ""


def _deep(spec: GrainSpec, table: Table, metres_per_radius: float | None) -> tuple[np.ndarray, float]:
    """Return the colour of a deep medium (3,), and the mean absorption by luminance, times R."""
    spectra = spectra_of(spec.absorption, metres_per_radius)
    if spectra.by_wavelength is None:
        weight = np.zeros((0, 3))
        colour = np.array([deep_colour(table, float(x)) for x in spectra.by_channel])
    else:
        weight = image.spectral_weights().weight
        colour = weight.T @ np.array([deep_colour(table, float(x)) for x in spectra.by_wavelength])
    return colour, spectra.grey(weight)


def _scene(
    view: View, spec: GrainSpec, fraction: float, metres_per_radius: float | None, folder: Path, singles: int
) -> Scene:
    """Return a thing on grey ground under the sky; one length unit is R."""
    camera = Camera(view.position, view.target, view.width, 3 * view.width // 4, fov_deg=FOV_DEG)
    half = 40.0 * math.dist(view.position, view.target)
    ground = SurfaceSpec(Rectangle((0.0, 0.0, 0.0), (half, 0.0, 0.0), (0.0, half, 0.0)), (0.16, 0.15, 0.14), "ground")
    body = MediumSpec(_shape(view.shape, folder), fraction, 1.0, (spec,), name=view.title, packing_spheres=SPHERES)
    return Scene(
        camera, (EnvironmentLight(folder / "sky.exr"),), (body,), (ground,), Render(explicit_grains=singles),
        metres_per_radius, "preview",
    )  # fmt: skip


def _shape(name: str, folder: Path) -> MediumShape:
    w, d, h = SLAB
    x, y, z = LAYER
    shapes: dict[str, MediumShape] = {
        "few": Box((-0.5 * x, -0.5 * y, 0.0), (0.5 * x, 0.5 * y, z)),
        "ball": Sphere((0.0, 0.0, BALL), BALL),
        "slab": Box((-0.5 * w, -0.5 * d, 0.0), (0.5 * w, 0.5 * d, h)),
        "heap": Mesh(folder / "heap.obj"),
    }
    return shapes[name]


def _sky() -> np.ndarray:
    """Return the sky (h, w, 3): brighter towards the top, with a window before the things, on the right.

    It is too broad and dim for the renderer to aim at it: what finds it by chance has less noise, and is faster. It is
    hardly thrice as bright as the sky: under one of six times white grains took four times as long to the same noise.
    """
    h, w = SKY
    up = np.sin(math.pi * (0.5 - (np.arange(h) + 0.5) / h))[:, None, None]
    sky = np.where(up > 0.0, 0.42 + 0.25 * up, 0.2) * np.array([0.92, 0.98, 1.08]) * np.ones((h, w, 1))
    azimuth = -360.0 * (np.arange(w) + 0.5) / w + 360.0  # falls with the column, from +x
    elevation = np.degrees(np.arcsin(up[:, 0, 0]))
    window = (np.abs(azimuth[None, :] - 305.0) < 50.0) & (np.abs(elevation[:, None] - 45.0) < 30.0)
    sky[window] = [1.07, 1.01, 0.92]
    return sky


def _write_heap(path: Path, rings: int = 24, sides: int = 64) -> None:
    """Write the heap as a closed mesh."""
    r, angle = np.arange(1, rings + 1) / rings, 2.0 * math.pi * np.arange(sides) / sides
    lumps = 1.0 + 0.03 * np.sin(5.0 * angle) * np.sin(math.pi * r[:, None])
    x, y = HEAP[0] * r[:, None] * np.cos(angle) * lumps, HEAP[0] * r[:, None] * np.sin(angle) * lumps
    z = np.broadcast_to(_height(r)[:, None], x.shape)
    points = np.concatenate(([[0.0, 0.0, HEAP[1]]], np.stack((x, y, z), axis=-1).reshape(-1, 3), [[0.0, 0.0, 0.0]]))
    index = 1 + np.arange(rings * sides).reshape(rings, sides)
    after = np.roll(index, -1, axis=1)
    top, foot = np.zeros(sides, int), np.full(sides, len(points) - 1)
    faces: Sequence[np.ndarray] = [
        np.stack((top, index[0], after[0]), axis=-1),
        np.stack((index[:-1], index[1:], after[1:]), axis=-1).reshape(-1, 3),
        np.stack((index[:-1], after[1:], after[:-1]), axis=-1).reshape(-1, 3),
        np.stack((foot, after[-1], index[-1]), axis=-1),
    ]
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*p) for p in points]
    lines += ["f {} {} {}".format(*(f + 1)) for f in np.concatenate(faces)]
    path.write_text("\n".join(lines) + "\n")
