"""Mutated scenes: each is rendered or refused in one line of our own, in 20 seconds of processor time and 1 GB.

    python fuzz/scenes.py --count 10000 --seed 0

A scene is one of a few sound ones, changed in structure (keys and tables gone, doubled, renamed, swapped with another
scene's), in values (extremes of numbers, wrong types, other choices, other files) or in the bytes of its text. What can
be built is rendered at 8 x 8 pixels, one sample each, and must be light: finite, and positive but for the gamut. Scene
k of a seed is the same always; what fails is shown with its number and text. Tiles of the explicit level are cut to a
few spheres.
"""

import argparse
import copy
import math
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

SECONDS = 20  # of processor time
WAITING = 120  # [s] by the clock, for what waits and does nothing
MEGABYTES = 1000
SIDE = 8  # [pixel]
SPHERES = 300
LONGEST = 1000  # [characters] of a message
SKY = {"type": "environment", "file": "sky.exr", "scale": 1.5, "rotation_deg": 30.0}
SUN = {"type": "sun", "direction": [1.0, 0.5, 1.0], "angular_diameter_deg": 0.53, "irradiance": [3.0, 2.0, 1.0]}
CONSTANT = {"type": "constant", "radiance": 0.5}
GRAIN = {"table": "ball.tsdf.exr", "fraction": 0.7, "absorption": [0.1, 0.2, 0.3]}
FLOOR = {
    "name": "floor",
    "shape": {"type": "rectangle", "centre": [0.0, 0.0, 0.0], "u": [5.0, 0.0, 0.0], "v": [0.0, 5.0, 0.0]},
    "reflectance": [0.5, 0.4, 0.3],
}


def _scene(shape: dict, light: list, surface: list, level: str, absorption: Any, **camera: Any) -> dict:
    return {
        "metres_per_unit": 0.01,
        "camera": {"position": [0.0, -6.0, 2.0], "target": [0.0, 0.0, 0.5], "width": 32, "height": 24} | camera,
        "render": {"level": level, "spp": 1, "seed": 3},
        "light": light,
        "medium": [
            {
                "name": "heap", "shape": shape, "packing_fraction": 0.5, "radius": 0.1, "inside": "grains",
                "packing_seed": 1, "packing_spheres": 200, "grain": [GRAIN, GRAIN | {"absorption": absorption}],
            }
        ],
        "surface": surface,
    }  # fmt: skip


BOX = {"type": "box", "low": [-1.0, -1.0, 0.0], "high": [1.0, 1.0, 1.0]}
BALL = {"type": "sphere", "centre": [0.0, 0.0, 1.0], "radius": 0.9}
SLAB = {"type": "slab", "low": -1.0, "high": 0.5}
MESH = {"type": "mesh", "file": "heap.ply", "scale": 1.1, "rotate": [0, 0, 30], "translate": [0, 0, 0.7], "up": "y"}
SPECTRUM = {"wavelength_nm": [380.0, 500.0, 780.0], "coefficient": [0.0, 1.0, 3.0]}
THING = {"shape": {"type": "sphere", "centre": [2.0, 0.0, 0.5], "radius": 0.4}, "reflectance": 0.9}
SOUND = (
    _scene(BOX, [SKY, SUN], [FLOOR, THING], "teleport", {"material": "ice"}, up=[0.0, 0.0, 1.0], fov_deg=40.0),
    _scene(MESH, [CONSTANT, SUN], [FLOOR], "teleport-memory", SPECTRUM, exposure=0.5),
    _scene(BALL, [SKY], [FLOOR | {"shape": MESH | {"translate": [3, 0, 1]}}], "volume", 0.0),
    _scene(SLAB, [CONSTANT], [THING | {"shape": BOX | {"low": [-1, -1, 0.6]}}], "volume-hg", 0.2),
    _scene(BOX, [SUN | {"angular_diameter_deg": 60.0}, CONSTANT], [FLOOR], "explicit", 0.1),
)
NUMBERS = (
    0, 1, -1, 2, 3, 0.5, -0.0, 0.64, 0.74, 0.7405, 1.0, 90, 180, 360, 5e-324, 2.2e-308, 1e-300, -1e-300, 1e-30, 1e-16,
    1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 1e16, 1e30, -1e30, 1.0000001e30, 1e300, 1.7e308, 2**31, 2**53, 2**63 - 1, 2**63,
    10**40, 16**5000, math.inf, -math.inf, math.nan,
)  # fmt: skip
TEXTS = (
    "", "x", "ice", "teleport", "explicit", "isotropic", "teleport-joint", "box", "mesh", "sphere", "slab",
    "rectangle", "sun", "constant", "environment", "grains", "centres", "y", "z", "sky.exr", "odd.exr", "cube.exr",
    "heap.ply", "open.ply", "ball.tsdf.exr", "plain.tsdf.exr", "text.txt", "pipe", ".", "/dev/zero", "../none",
    "a\0b", "é\n\u202e", "n" * 5000,
)  # fmt: skip


def files(folder: Path) -> None:
    """Write the files that scenes may name."""
    import OpenEXR
    import trimesh

    from tsdf.data import format as tsdf_format
    from tsdf.grain.grains import load_grain
    from tsdf.grain.optics import Optics
    from tsdf.make.scatterometer import Effort, exact_sphere
    from tsdf.picture import image

    rng = np.random.default_rng(0)
    image.write_exr(folder / "sky.exr", rng.random((8, 16, 3)) ** 8)
    image.write_exr(folder / "odd.exr", np.where(rng.random((9, 5, 3)) < 0.2, math.inf, -1e-3))
    cube = {c: np.ones((12, 2), np.float32) for c in "RGB"}
    OpenEXR.File({"type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_CUBE}, cube).write(str(folder / "cube.exr"))
    trimesh.creation.box((2.0, 1.0, 2.0)).export(folder / "heap.ply")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(folder / "open.ply")
    effort = Effort(cells=32, joint=4, memory=8)
    tsdf_format.write(exact_sphere(load_grain("sphere"), Optics(1.33), effort), folder / "ball.tsdf.exr")
    tsdf_format.write(
        exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=16, joint=0)), folder / "plain.tsdf.exr"
    )
    (folder / "text.txt").write_text("no image, mesh or table\n")
    os.mkfifo(folder / "pipe")


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each dict or list in a value with each of its keys or indices."""
    for key in list(value) if isinstance(value, dict) else range(len(value)):
        yield value, key
        if isinstance(value[key], dict | list):
            yield from places(value[key])


def mutated(rng: random.Random) -> bytes:
    """Return the text of a scene that is changed in one to four places."""
    scene = copy.deepcopy(rng.choice(SOUND))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        at, key = rng.choice(list(places(scene)))
        old = at[key]
        kind = rng.randrange(12)
        if kind < 5:
            if isinstance(old, list) and old and kind < 4:
                at, key = old, rng.randrange(len(old))
                old = at[key]
            if isinstance(old, int | float) and rng.random() < 0.4:
                at[key] = old * 10.0 ** rng.uniform(-12.0, 12.0) * rng.choice((1, 1, -1))
            else:
                at[key] = rng.choice(TEXTS if isinstance(old, str) and rng.random() < 0.8 else NUMBERS)
        elif kind == 5:
            del at[key]
        elif kind == 6:  # what stands at such a key elsewhere
            others = [a[k] for a, k in places(rng.choice(SOUND)) if k == key or rng.random() < 0.02]
            at[key] = copy.deepcopy(rng.choice(others or [0]))
        elif kind == 7:
            at[key] = rng.choice(([], {}, [old], {"type": old}, True, "x", [old] * 3, _deep(old), [[]] * 100))
        elif kind == 8 and isinstance(at, list):
            at.extend(copy.deepcopy(at) * rng.choice((1, 1, 2, 50)))
        elif kind == 9 and isinstance(at, dict):
            at[rng.choice((str(key) + "s", "", "type", "name", "é", str(key).upper(), "x" * 3000))] = at.pop(key)
        else:
            at[key] = rng.choice(NUMBERS)
    text = bytearray(toml(scene).encode("utf-8", "replace"))
    if rng.random() < 0.15:
        for _ in range(rng.choice((1, 2, 5))):
            i = rng.randrange(len(text))
            text[i : i + rng.choice((0, 1, 1, 30))] = rng.randbytes(rng.choice((0, 1, 3)))
    return bytes(text[: rng.randrange(len(text)) if rng.random() < 0.03 else None])


def _deep(value: Any) -> Any:
    for _ in range(60):
        value = [value]
    return value


def toml(value: dict) -> str:
    """Return a scene as TOML, tables of tables inline."""
    return "".join(f"{_quoted(key)} = {_inline(item)}\n" for key, item in value.items())


def _quoted(text: str) -> str:
    escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08X}" for c in text)
    return f'"{escaped}"'


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_quoted(key)} = {_inline(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return str(value).lower()
    return hex(value) if isinstance(value, int) and value > 10**30 else repr(value)


class TooSlow(BaseException):
    """The clock rang."""


def trial(path: Path) -> str:
    """Return "rendered" or "refused" for the scene in a file.

    Raises
    ------
    AssertionError, Exception, TooSlow
        What must not happen.
    """
    from tsdf.errors import TSDFError
    from tsdf.picture import render, world
    from tsdf.scene.levels import AUTO
    from tsdf.scene.scene import load

    try:
        scene = load(path)
        media = tuple(replace(m, packing_spheres=min(m.packing_spheres, SPHERES)) for m in scene.media)
        camera = replace(scene.camera, width=SIDE, height=SIDE)
        level = "teleport" if scene.render.level == AUTO else scene.render.level
        made = world.build(replace(scene, camera=camera, media=media), level)
        picture = render.render(made, spp=1, threads=1, seed=scene.render.seed)
    except TSDFError as error:
        message = str(error)
        assert message and "\n" not in message and len(message) <= LONGEST, f"not one short line: {message[:2000]!r}"
        return "refused"
    assert all("\n" not in note for note in made.notes), f"not one line each: {made.notes}"
    rgb = picture.rgb  # channels of colours outside the gamut are negative, where absorption is spectral
    assert np.isfinite(rgb).all() and rgb.min() >= -rgb.max(), "the picture is not light"
    return "rendered"


def run(count: int, seed: int = 0, first: int = 0, loud: bool = True, warm: bool = True) -> Counter:
    """Return how many of `count` scenes from number `first` on were rendered, refused or failed, and the worst of
    seconds and megabytes."""

    def ring(*_: object) -> None:
        raise TooSlow(f"more than {SECONDS} s of processor time, or {WAITING} s by the clock")

    before = [signal.signal(number, ring) for number in (signal.SIGPROF, signal.SIGALRM)]
    found: Counter = Counter(rendered=0, refused=0, failed=0)
    slowest = 0.0
    try:
        with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
            warnings.simplefilter("error")  # arithmetic that goes wrong is no answer
            folder = Path(name)
            files(folder)
            path = folder / "scene.toml"
            if warm:
                _warm(folder)
            for number in range(first, first + count):
                path.write_bytes(text := mutated(random.Random(f"{seed}/{number}")))
                begin = time.process_time()
                signal.setitimer(signal.ITIMER_PROF, SECONDS)
                signal.alarm(WAITING)
                try:
                    found[trial(path)] += 1
                except (Exception, TooSlow) as error:
                    found["failed"] += 1
                    sys.stderr.write(f"--- scene {number} of seed {seed}: {type(error).__name__}: {error}\n")
                    if not isinstance(error, AssertionError):
                        sys.stderr.write("".join(traceback.format_exception(error)[-3:]))
                    sys.stderr.write(text.decode("utf-8", "backslashreplace")[:3000] + "\n")
                finally:
                    signal.setitimer(signal.ITIMER_PROF, 0)
                    signal.alarm(0)
                slowest = max(slowest, time.process_time() - begin)
                if loud and (number + 1) % 500 == 0:
                    print(f"{number + 1 - first} scenes: {dict(found)}, {slowest:.1f} s, {_memory()} MB", flush=True)
    finally:
        for signal_number, handler in zip((signal.SIGPROF, signal.SIGALRM), before, strict=True):
            signal.signal(signal_number, handler)
    found["seconds"], found["megabytes"] = math.ceil(slowest), _memory()
    return found


def _warm(folder: Path) -> None:
    """Render the sound scenes, so that what compiles does so outside the time."""
    for number, scene in enumerate(SOUND):
        (folder / f"sound_{number}.toml").write_text(toml(scene))
        assert trial(folder / f"sound_{number}.toml") == "rendered"


def _memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1000


def main() -> int:
    """Run from the command line; the status is 1 if anything failed or took too much."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene, to see one again")
    options = parser.parse_args()
    found = run(options.count, options.seed, options.first)
    print(f"{options.count} scenes: {dict(found)}")
    return int(found["failed"] > 0 or found["megabytes"] > MEGABYTES or found["seconds"] > SECONDS)


if __name__ == "__main__":
    sys.exit(main())
