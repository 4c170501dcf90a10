"""Many random scenes whose pictures are known: furnaces, and bodies that are said in two ways.

    python fuzz/pictures.py --count 300

Of each number one scene is a furnace: media of grains and surfaces that absorb nothing, apart, touching or a hair from
each other, in light that is the same everywhere, at a random level. Every pixel must be 1 to rounding. The other has
boxes that absorb, some with a surface inside, once as exact shapes and once as meshes of 12 to 3,072 facets, which
other code follows. The mean of the pictures must agree within their noise: a leak, or a place taken for another
medium's, is a difference. A scene that is refused counts as nothing. It takes about two minutes for 100 and says what
was wrong; --count 1 with --first repeats one, and says why it was refused.
"""

import argparse
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from tsdf.data import library
from tsdf.errors import TSDFError
from tsdf.picture.render import Picture, render
from tsdf.picture.world import build
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import Box, Camera, ConstantLight, GrainSpec, MediumSpec, Mesh, Scene, Sphere, SunLight
from tsdf.scene.specs import Absorption, MediumShape, SurfaceSpec

TABLES = ("glass-beads", "coarse-snow", "salt")
GAPS = (0.0, 0.0, 1e-7, 1e-3, 0.3)  # between media [their radius or unit]
FURNACE = 1e-9  # off 1, of rounding
SIGMAS = 4.5  # of the difference of two means: 1 in 150,000 scenes by chance
SPP = {"furnace": 4, "pair": 64}
WHITE = ConstantLight((1.0, 1.0, 1.0))
BY_CHANCE = ("explicit", "teleport-packed")  # levels that meet suns by chance alone


class Maker:
    """A random scene and the files of its meshes."""

    def __init__(self, seed: int, number: int, folder: Path) -> None:
        self.rng = np.random.default_rng((seed, number))
        self.name, self.folder, self.files = f"scene {number}", folder, 0

    def one_of(self, choices):
        return choices[self.rng.integers(len(choices))]

    def mesh(self, made: trimesh.Trimesh) -> Mesh:
        self.files += 1
        path = self.folder / f"{self.files}.ply"
        made.export(path)
        return Mesh(path)

    def body(self, centre: np.ndarray, size: float) -> MediumShape:
        """Return a shape that reaches `size` from its centre to all sides, at most."""
        kind = self.rng.integers(7)
        if kind == 0:
            return Box(tuple(centre - size), tuple(centre + size))
        if kind == 1:
            return Sphere(tuple(centre), size)
        if kind == 2:
            made = trimesh.creation.box((2.0, 2.0, 2.0))
        elif kind == 3:
            made = trimesh.creation.torus(0.7, 0.3, int(self.rng.integers(8, 32)), int(self.rng.integers(6, 20)))
        elif kind == 4:
            made = trimesh.creation.cylinder(0.6, 1.4, sections=int(self.rng.integers(3, 40)))
        else:
            made = trimesh.creation.icosphere(int(self.rng.integers(0, 5)))
            if kind == 6:
                bumps = 1.0 + 0.2 * np.sin(4.0 * made.vertices[:, :1]) * np.cos(3.0 * made.vertices[:, 1:2])
                made = trimesh.Trimesh(made.vertices * bumps / 1.2, made.faces, process=False)
        made.vertices = np.clip(made.vertices, -1.0, 1.0) * size + centre
        return self.mesh(made)

    def medium(self, shape: MediumShape, inside: str, size: float, absorption: float) -> MediumSpec:
        grain = GrainSpec(
            library.FOLDER / f"{self.one_of(TABLES)}{library.SUFFIX}", 1.0, None, Absorption("grey", (absorption,))
        )
        fraction, radius = self.one_of((0.05, 0.3, 0.6)), size * 10.0 ** self.rng.uniform(-2.0, -0.5)
        return MediumSpec(shape, fraction, radius, (grain,), packing_spheres=64, inside=inside)

    def camera(self, target: np.ndarray, away: float, fov: float) -> Camera:
        toward = self.rng.normal(size=3)
        return Camera(tuple(target + away * toward / math.hypot(*toward)), tuple(target), 12, 12, fov_deg=fov)

    def size(self) -> float:
        size = 10.0 ** self.rng.uniform(0.0, 1.0)
        return float(round(size)) if self.rng.random() < 0.5 else float(size)  # where grid and boundary may coincide

    def furnace(self) -> tuple[Scene, str]:
        """Return a scene whose pixels are 1, and a level for it."""
        size, gap, count = self.size(), self.one_of(GAPS), int(self.rng.integers(1, 4))
        inside = self.one_of(("centres", "grains"))
        places = [np.array([k * (2.0 * size + gap), 0.0, 0.0]) for k in range(count)]
        media = [self.medium(self.body(place, size), inside, size, 0.0) for place in places]
        surfaces = []
        for _ in range(int(self.rng.integers(0, 3))):
            centre, reach = self.rng.uniform(-0.7, 0.7, 3) * size, size * 10.0 ** self.rng.uniform(-1.5, -0.2)
            surfaces.append(SurfaceSpec(self.body(centre, float(reach)), (1.0, 1.0, 1.0)))
        camera = self.camera(places[0], 6.0 * size, 40.0)
        return Scene(camera, (WHITE,), tuple(media), tuple(surfaces), name=self.name), self.one_of(tuple(LEVELS))

    def pair(self) -> tuple[Scene, Scene, str]:
        """Return a scene of exact boxes, the same of meshes, and a level."""
        size, gap, count = self.size(), self.one_of(GAPS), int(self.rng.integers(1, 4))
        inside = self.one_of(("centres", "grains")) if count == 1 else "grains"
        boxes, meshes = [], []
        for k in range(count):
            low = np.array([k * (2.0 * size + gap) - size, -size, -size])
            high = low + 2.0 * size
            medium = self.medium(Box(tuple(low), tuple(high)), inside, size, self.one_of((0.0, 0.02, 0.3, 3.0)) / size)
            made = trimesh.creation.box((2.0, 2.0, 2.0))
            for _ in range(int(self.rng.integers(0, 5))):
                made = made.subdivide()
            ends = np.where(made.vertices > 1.0 - 1e-9, high, 0.5 * (low + high) + made.vertices * size)
            made.vertices = np.where(made.vertices < 1e-9 - 1.0, low, ends)
            boxes.append(medium)
            meshes.append(replace(medium, shape=self.mesh(made)))
        surfaces = ()
        if self.rng.random() < 0.4:
            place = (self.rng.uniform(0.0, count - 1.0) * 2.0 * size, 0.0, 0.0)
            surfaces = (SurfaceSpec(Sphere(place, float(size * self.rng.uniform(0.05, 0.5))), (0.8, 0.5, 0.1)),)
        level, lights = self.one_of(tuple(LEVELS)), (WHITE,)
        if level not in BY_CHANCE and self.rng.random() < 0.4:
            lights = (ConstantLight((0.2, 0.2, 0.2)), SunLight(tuple(self.rng.normal(size=3)), (1.0, 1.0, 1.0)))
        middle = np.array([(count - 1) * (size + 0.5 * gap), 0.0, 0.0])
        scene = Scene(self.camera(middle, 8.0 * size * count, 20.0), lights, tuple(boxes), surfaces, name=self.name)
        return scene, replace(scene, media=tuple(meshes)), level


def taken(scene: Scene, level: str, spp: int, seed: int) -> Picture:
    return render(build(scene, level), spp, seed=seed, threads=1)


def lost(picture: Picture) -> int:
    return picture.truncated + picture.faults


def wrong_furnace(maker: Maker) -> str:
    """Return what is wrong with a furnace, "" for nothing."""
    scene, level = maker.furnace()
    picture = taken(scene, level, SPP["furnace"], 0)
    off = float(np.abs(picture.rgb - 1.0).max())
    return f"furnace at {level}: off by {off:.2g}, {lost(picture)} lost" if not off <= FURNACE or lost(picture) else ""


def wrong_pair(maker: Maker) -> str:
    """Return what is wrong between exact boxes and meshes of the same, "" for nothing."""
    exact, meshes, level = maker.pair()
    one, other = (taken(scene, level, SPP["pair"], seed) for seed, scene in enumerate((exact, meshes)))
    error = np.sqrt(sum(p.variance.sum(axis=(0, 1)) for p in (one, other))) / one.samples.size
    off = np.abs(one.rgb.mean(axis=(0, 1)) - other.rgb.mean(axis=(0, 1))) / np.maximum(error, 1e-12)
    if not off.max() <= SIGMAS or lost(one) or lost(other):
        return f"boxes at {level}: {off.max():.2g} standard errors, {lost(one)} and {lost(other)} lost"
    return ""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    wrong = refused = 0
    for number in range(asked.first, asked.first + asked.count):
        for check in (wrong_furnace, wrong_pair):
            with tempfile.TemporaryDirectory() as folder:
                try:
                    said = check(Maker(asked.seed, number, Path(folder)))
                except TSDFError as error:
                    refused += 1
                    if asked.count == 1:
                        print(f"refused: {error}")
                    continue
            if said:
                wrong += 1
                print(f"{number}: {said}", flush=True)
    print(f"{2 * asked.count} scenes: {wrong} wrong, {refused} refused")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
