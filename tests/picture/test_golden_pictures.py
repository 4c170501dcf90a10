"""Pictures stay what they are: small ones of every level and kind of scene against those kept in golden/pictures.npz.

They say nothing about what is right, which is what `test_levels` and `test_transport` are for; they make it safe to
write the kernels anew. A change that moves them must say why, and then keeps the new ones:

    python tests/picture/test_golden_pictures.py

which says which pictures are the same to the last bit and by how much the others moved; with --compare, that alone.
"""

import sys
import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Build, Effort
from tsdf.picture import image, render, world
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
    Rectangle,
    Scene,
    Slab,
    Sphere,
    SunLight,
    SurfaceSpec,
)
from tsdf.walk import geometry, room

GOLDEN = Path(__file__).parent / "golden"
WIDTH, HEIGHT, SPP, SEED = 16, 12, 4, 1
CELLS = 20_000
RELATIVE = 1e-9  # of the brightest pixel: what another processor's last bits may make of a picture
WHITE = ConstantLight((1.0, 1.0, 1.0))
SUN = SunLight((-0.48, -0.36, 0.8), (3.0, 2.5, 2.0), 5.0)
FLOOR = SurfaceSpec(Rectangle((0.0, 0.0, -3.0), (40.0, 0.0, 0.0), (0.0, 40.0, 0.0)), (0.5, 0.4, 0.3), "floor")
BALL = SurfaceSpec(Sphere((1.5, -1.0, 2.5), 1.5), (0.7, 0.2, 0.2), "ball")
CAMERA = Camera((2.0, -16.0, 7.0), (0.0, 0.0, 0.0), WIDTH, HEIGHT, fov_deg=40.0)
GREY, RGB = Absorption("grey", (0.05,)), Absorption("rgb", (0.02, 0.1, 0.3))
SPECTRAL = Absorption("spectral", (0.02, 0.15, 0.3), (300.0, 550.0, 900.0))


def heap(path: Path) -> Path:
    """Write a dented, closed body with a flat bottom at z = -3, 5 wide, and return its path."""
    rings, sides = 6, 14
    r, a = np.meshgrid(np.linspace(0.0, 1.0, rings + 1)[1:], 2.0 * np.pi * np.arange(sides) / sides, indexing="ij")
    z = -2.8 + 4.0 * (1.0 - r**2) + 0.4 * np.sin(3.0 * a + 5.0 * r) * (1.0 - r)
    top = np.stack((5.0 * r * np.cos(a), 5.0 * r * np.sin(a), z), axis=-1).reshape(-1, 3)
    points = np.concatenate(([[0.0, 0.0, 1.2]], top, top[-sides:] * (1, 1, 0) + (0, 0, -3), [[0.0, 0.0, -3.0]]))
    ring = 1 + np.arange((rings + 1) * sides).reshape(rings + 1, sides)
    nxt = np.roll(ring, -1, axis=1)
    a, b, c, d = (x.ravel() for x in (ring[:-1], ring[1:], nxt[1:], nxt[:-1]))
    faces = np.concatenate((
        np.column_stack((np.zeros(sides, int), ring[0], nxt[0])),
        np.column_stack((a, b, c)), np.column_stack((a, c, d)),
        np.column_stack((ring[-1], np.full(sides, len(points) - 1), nxt[-1])),
    ))  # fmt: skip
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points] + [f"f {i} {j} {k}" for i, j, k in faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


@lru_cache
def table(name: str) -> Table:
    return tsdf_format.read(GOLDEN / f"{name}.tsdf.exr")


def make_tables() -> None:
    """Write the tables of the pictures: kept, so that pictures tell of the renderer alone."""
    sphere = scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=48, joint=8, memory=8))
    tsdf_format.write(sphere, GOLDEN / "sphere.tsdf.exr")
    grain = load_grain("cube")
    build = Build.start(grain, Optics(1.31), Effort(paths=60_000, joint=4, memory=4))
    build.run(grain)
    tsdf_format.write(build.table(), GOLDEN / "cube.tsdf.exr")


def scenes(folder: Path) -> dict[str, Scene]:
    """Return one scene of each kind; those with files have them in `folder`."""
    rng = np.random.default_rng(1)
    sky = rng.random((6, 12, 3)) * np.linspace(1.5, 0.1, 6)[:, None, None]
    sky[1, 3] = 40.0
    image.write_exr(folder / "sky.exr", sky)
    body = Mesh(heap(folder / "heap.obj"))
    environment = EnvironmentLight(folder / "sky.exr", rotation_deg=30.0)
    sphere, cube = GrainSpec(table("sphere")), GrainSpec(table("cube"))
    mixed = (replace(sphere, fraction=0.4, absorption=RGB), replace(cube, fraction=0.6, absorption=GREY))

    def medium(shape: object, *grains: GrainSpec, radius: float = 0.5, **how: object) -> MediumSpec:
        return MediumSpec(shape, 0.55, radius, grains, name="m", packing_spheres=200, **how)  # type: ignore[arg-type]

    return {
        "box": Scene(CAMERA, (WHITE, SUN), (medium(Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)), sphere),)),
        "ball": Scene(
            CAMERA, (environment,), (medium(Sphere((0.0, 0.0, 0.0), 4.0), replace(sphere, absorption=RGB)),)
        ),
        "slab": Scene(CAMERA, (SUN, environment), (medium(Slab(-3.0, 0.5), cube),), (BALL,)),
        "mesh": Scene(CAMERA, (SUN, environment), (medium(body, *mixed),), (FLOOR, BALL)),
        "centres": Scene(CAMERA, (SUN, WHITE), (medium(body, cube, inside="centres"),), (FLOOR,)),
        "spectral": Scene(
            CAMERA,
            (WHITE, environment),
            (
                medium(Box((-4.0, -4.0, -3.0), (4.0, 0.0, 1.0)), replace(sphere, absorption=SPECTRAL)),
                medium(Box((-4.0, 0.0, -3.0), (4.0, 4.0, 1.5)), replace(cube, absorption=GREY), radius=0.3),
            ),
            (FLOOR,),
        ),
        "within": Scene(
            replace(CAMERA, position=(0.5, -1.0, -1.0), target=(0.0, 3.0, 0.0)),
            (SUN, WHITE),
            (medium(body, replace(sphere, absorption=GREY), radius=0.2),),
            (replace(BALL, shape=Sphere((0.0, 1.0, -1.0), 0.8)),),
        ),
    }  # fmt: skip


def picture(scene: Scene, level: str) -> np.ndarray:
    """Return the (HEIGHT, WIDTH, 3) float64 picture of a scene at a level; coarse grids are made in no time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(geometry, "GRID_CELLS", CELLS)
        patch.setattr(room, "CELLS", CELLS)
        made = render.render(world.build(scene, level), spp=SPP, seed=SEED, threads=1)
    assert made.truncated == 0
    return made.rgb


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scene]:
    return scenes(tmp_path_factory.mktemp("scenes"))


@pytest.fixture(scope="module")
def kept() -> dict[str, np.ndarray]:
    with np.load(GOLDEN / "pictures.npz") as file:
        return dict(file)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("kind", ["box", "ball", "slab", "mesh", "centres", "spectral", "within"])
def test_pictures_stay(kinds: dict[str, Scene], kept: dict[str, np.ndarray], kind: str, level: str) -> None:
    found, before = picture(kinds[kind], level), kept[f"{kind} {level}"]
    assert np.isfinite(found).all() and found.any()
    np.testing.assert_allclose(found, before, rtol=0.0, atol=RELATIVE * before.max())


def test_every_picture_is_looked_at(kinds: dict[str, Scene], kept: dict[str, np.ndarray]) -> None:
    assert set(kept) == {f"{kind} {level}" for kind in kinds for level in LEVELS}


def main() -> None:
    GOLDEN.mkdir(exist_ok=True)
    if not (GOLDEN / "cube.tsdf.exr").exists():
        make_tables()
    before = dict(np.load(GOLDEN / "pictures.npz")) if (GOLDEN / "pictures.npz").exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        found = {
            f"{kind} {level}": picture(scene, level)
            for kind, scene in scenes(Path(folder)).items()
            for level in LEVELS
        }  # fmt: skip
    same = [name for name, rgb in found.items() if name in before and np.array_equal(rgb, before[name])]
    print(f"{len(same)} of {len(found)} pictures are the same to the last bit")
    for name in sorted(set(found) & set(before) - set(same)):
        moved = np.abs(found[name] - before[name]).max() / before[name].max()
        mean = found[name].mean() / before[name].mean() - 1.0
        print(f"{name}: at most {moved:.1e} of the brightest, in the mean {mean:+.1e}")
    if "--compare" not in sys.argv:
        np.savez_compressed(GOLDEN / "pictures.npz", allow_pickle=False, **found)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
