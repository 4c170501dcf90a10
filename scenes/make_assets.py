"""Make the meshes and skies that the scenes of this folder need, into assets/ beside it; the same bytes every time.

    python scenes/make_assets.py

Meshes are closed, manifold and stand on z = 0; the boundaries of media have one sheet above each point of the floor, so
they cannot cross themselves. Skies are latitude-longitude images as `tsdf.walk.lights` has them: row 0 is the zenith,
the middle of the width +x, left of it +y.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tsdf.picture import image

Array = np.ndarray


def heightfield(x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Return vertices and faces of the body between z = 0 and heights z > 0 at x, y: (n, m) each."""
    n, m = z.shape
    top = np.column_stack((x.ravel(), y.ravel(), z.ravel()))
    index = np.arange(n * m).reshape(n, m)
    rim = np.concatenate((index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]))
    skirt = top[rim] * (1.0, 1.0, 0.0)
    middle = skirt.mean(axis=0, keepdims=True)
    low = n * m + np.arange(len(rim))
    return np.concatenate((top, skirt, middle)), np.concatenate((_quads(index), _wall(rim, low, n * m + len(rim))))


def mound(radius: float, rings: int, sides: int, height: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """Return vertices and faces of a body on the disc of given radius, height(x, y) > 0 high [radius]."""
    r = np.sqrt(np.linspace(0.0, 1.0, rings + 1)[1:])[:, None] * np.ones(sides)
    r = 0.5 * (r + np.linspace(0.0, 1.0, rings + 1)[1:, None])  # between equal areas and equal steps
    angle = 2.0 * np.pi * np.arange(sides) / sides
    x, y = r * np.cos(angle), r * np.sin(angle)
    top = np.column_stack((x.ravel(), y.ravel(), height(x, y).ravel()))
    index = np.arange(rings * sides).reshape(rings, sides)
    rim = index[-1]
    points = np.concatenate(([[0.0, 0.0, height(*np.zeros((2, 1)))[0]]], top, top[rim] * (1, 1, 0), np.zeros((1, 3))))
    around = np.roll(index, -1, axis=1)
    cap = np.column_stack((np.zeros(sides, int), index[0] + 1, around[0] + 1))
    a, b, c, d = index[:-1].ravel(), index[1:].ravel(), around[1:].ravel(), around[:-1].ravel()
    slopes = np.concatenate((np.column_stack((a, b, c)), np.column_stack((a, c, d)))) + 1
    low = 1 + rings * sides + np.arange(sides)
    faces = np.concatenate((cap, slopes, _wall(rim + 1, low, len(points) - 1)))
    return radius * points, faces


def _quads(index: Array) -> Array:
    """Return the faces of a grid whose first axis is x and second y, seen from above."""
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return np.concatenate((np.column_stack((a, b, c)), np.column_stack((a, c, d))))


def _wall(rim: Array, low: Array, middle: int) -> Array:
    """Return the faces from a rim down to the floor, and the floor; seen from above the rim turns left."""
    nxt, low_next = np.roll(rim, -1), np.roll(low, -1)
    centre = np.full(len(rim), middle)
    return np.concatenate(
        (np.column_stack((rim, low, low_next)), np.column_stack((rim, low_next, nxt)),
         np.column_stack((low, centre, low_next)))
    )  # fmt: skip


def waves(x: Array, y: Array, count: int, size: float, seed: int) -> Array:
    """Return a sum of sines of random directions and phases, of wavelengths about `size`, with deviation 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for _ in range(count):
        k = 2.0 * np.pi / (size * rng.uniform(0.7, 1.5))
        a, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        total += np.sin(k * (np.cos(a) * x + np.sin(a) * y) + phase)
    return total / np.sqrt(0.5 * count)


def snow_heap() -> tuple[Array, Array]:
    """A heap thrown up by a shovel, 0.35 m in radius."""

    def height(x: Array, y: Array) -> Array:
        foot = np.clip(1.0 - np.hypot(x, y) ** 2, 0.0, 1.0)
        body = 0.58 * foot**1.25 * np.exp(-0.5 * ((x + 0.15) ** 2 + (y - 0.1) ** 2))
        lumps = 0.070 * waves(x, y, 9, 0.8, 1) + 0.018 * waves(x, y, 14, 0.3, 2) + 0.008 * waves(x, y, 20, 0.1, 3)
        return 0.006 + (body + foot * lumps * (0.4 + body)).clip(0.0)

    return mound(0.35, 90, 160, height)


def sand_dune() -> tuple[Array, Array]:
    """A dune whose crest winds away along +y, in metres: a slope with ripples toward -x, a steep smooth one toward +x.

    A column of its grid lies on the crest, which is sharp thereby, and the grid widens with the distance.
    """
    far, side = np.meshgrid(np.linspace(0.0, 1.0, 150) ** 1.5, np.linspace(-1.0, 1.0, 171), indexing="xy")
    y = -1.6 + 6.6 * far
    across = side * np.where(side < 0.0, 1.6, 1.1) * (1.0 + 2.4 * far)  # from the crest
    x = 0.28 * np.sin(1.15 * y + 0.4) + 0.12 * y + across
    top = 0.38 + 0.24 * np.exp(-(((y - 1.3) / 1.3) ** 2)) + 0.2 * far
    body = top + np.where(across < 0.0, 0.20 * across, -0.62 * across)
    body = 0.04 + 0.03 * np.logaddexp(0.0, (body - 0.04) / 0.03) + 0.008 * waves(x, y, 6, 1.5, 5)
    phase = 2.0 * np.pi * (across + 0.10 * np.sin(1.7 * y) + 0.02 * waves(x, y, 8, 0.6, 7)) / 0.11
    shape = np.sin(phase) + 0.25 * np.sin(2.0 * phase + 0.6)
    return heightfield(x, y, body + 0.008 * shape * np.clip(-6.0 * across - 0.2, 0.0, 1.0) * np.exp(-2.5 * far))


def bead_pile() -> tuple[Array, Array]:
    """A round pile, 15 mm in radius and 9 mm high, of beads of 2 mm diameter."""
    return mound(15.0, 24, 72, lambda x, y: 0.17 + 0.42 * (1.0 - np.hypot(x, y) ** 1.6).clip(0.0))


def directions(height: int) -> tuple[Array, Array, Array]:
    """Return x, y, z of the middles of the pixels of an image of 2 height columns."""
    polar = np.pi * (np.arange(height)[:, None] + 0.5) / height
    azimuth = -np.pi * (np.arange(2 * height) + 0.5) / height
    return np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) * np.ones(2 * height)


def gradient(zenith: Array, horizon: Array, ground: Array, height: int = 256) -> Array:
    """Return a sky that goes from the zenith's colour to the horizon's, and the ground's below."""
    up = directions(height)[2][..., None]
    share = np.clip(up, 0.0, 1.0) ** 0.5
    return np.where(up > 0.0, share * zenith + (1.0 - share) * horizon, ground)


def blue_sky() -> Array:
    """A clear day above pale ground."""
    return gradient(np.array((0.16, 0.30, 0.62)), np.array((0.62, 0.74, 0.90)), np.array((0.22, 0.22, 0.23)))


def evening_sky() -> Array:
    """A low sun's sky, warm on its side (-x) and blue on the other."""
    x, _, z = directions(256)
    sky = gradient(np.array((0.16, 0.26, 0.50)), np.array((0.62, 0.54, 0.48)), np.array((0.16, 0.11, 0.07)))
    glow = np.exp(-((1.0 + x) / 0.35)) * np.exp(-np.abs(z) / 0.25) * (z > 0.0)
    return sky + glow[..., None] * (1.2, 0.62, 0.22)


def studio() -> Array:
    """A bright room with an overhead panel, a window with a cross and a warm strip."""
    x, y, z = directions(128)
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z))
    room = gradient(np.array((0.5, 0.52, 0.56)), np.array((0.30, 0.30, 0.31)), np.array((0.05, 0.05, 0.05)), 128)
    window = (np.abs(azimuth - 125.0) < 32.0) & (np.abs(elevation - 38.0) < 22.0)
    cross = (np.abs(azimuth - 125.0) < 2.0) | (np.abs(elevation - 38.0) < 1.6)
    room[window & ~cross] = (2.9, 3.4, 4.0)
    room[(np.abs(azimuth + 40.0) < 9.0) & (np.abs(elevation - 35.0) < 30.0)] = (4.5, 2.8, 1.5)
    room[(elevation > 72.0)] = (1.8, 1.8, 1.8)
    return room


MESHES = {"snow_heap": snow_heap, "sand_dune": sand_dune, "bead_pile": bead_pile}
SKIES = {"blue_sky": blue_sky, "evening_sky": evening_sky, "studio": studio}


def make(folder: Path) -> list[Path]:
    """Write every asset into a folder, which is made, and return their paths."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for name, body in MESHES.items():
        vertices, faces = body()
        made.append(folder / f"{name}.ply")
        made[-1].write_bytes(trimesh.Trimesh(vertices, faces, process=False).export(file_type="ply"))
    for name, sky in SKIES.items():
        made.append(folder / f"{name}.exr")
        image.write_exr(made[-1], sky())
    return made


if __name__ == "__main__":
    for path in make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "assets"):
        print(path)
