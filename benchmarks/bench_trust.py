"""Does an image's error bar tell the truth? Twenty pictures that are to be trusted, four that are not, and the cost.

The shipped scenes, small, at every level; the beads at the levels of packed grains too, which cannot aim at the suns of
the others. Then the same beads under a sun of 0.53 degrees, once with few and once with many samples.

    PYTHONPATH=. python benchmarks/bench_trust.py
"""

import statistics
import tempfile
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes import make_assets
from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Build, Effort, exact_sphere
from tsdf.picture import render, world
from tsdf.picture.trust import Moments
from tsdf.scene import scene
from tsdf.scene.levels import LEVELS

FOLDER = Path(make_assets.__file__).parent
WIDTH, SPP = 48, 16
PACKED = [name for name, level in LEVELS.items() if level.traits.packed]
GOOD = [(name, level) for name in ("snow", "sand", "beads") for level in LEVELS if level not in PACKED]
GOOD += [("beads", level) for level in PACKED]
SUN = scene.SunLight((0.4, -0.5, 0.8), (3.0, 2.9, 2.7), 0.53)


def tables() -> dict[str, Table]:
    """Return a table of beads, and one of grains with facets for the others."""
    sphere = exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=256, joint=32, memory=64))
    grain = load_grain("cube")
    build = Build.start(grain, Optics(1.31), Effort(500_000, joint=32, memory=64))
    build.run(grain)
    return {"beads": sphere, "snow": build.table(), "sand": build.table()}


def loaded(name: str, folder: Path, table: Table) -> scene.Scene:
    """Return a shipped scene, small, with a table for each of its grains."""
    data = tomllib.loads((FOLDER / f"{name}.toml").read_text())
    stand_in = folder / "any.tsdf.exr"
    stand_in.write_bytes(b"")
    for medium in data["medium"]:
        for grain in medium["grain"]:
            grain["table"] = stand_in.name
    made = scene.parse(data, folder, name)
    media = tuple(replace(m, grains=tuple(replace(g, table=table) for g in m.grains)) for m in made.media)
    return replace(made, media=media, camera=replace(made.camera, width=WIDTH, height=WIDTH * 9 // 16))


def shown(name: str, level: str, made: world.World, spp: int) -> bool:
    """Render, print what is said of the error bar, and return whether it is trusted."""
    picture = render.render(made, spp=spp)
    trust = picture.trust
    assert trust is not None
    print(
        f"{name:<10} {level:<16} {spp:>5} spp  error {picture.relative_error:7.4f}  vov {trust.vov:8.5f}  "
        f"slope {trust.slope:6.2f}  chance {trust.chance:8.2g}  unsure pixels {trust.unsure:5.2f}  "
        f"{trust.doubt or 'trusted'}",
        flush=True,
    )
    return trust.doubt is None


def cost() -> None:
    """Print what the moments take of a picture's time: their own time over that of the cheapest samples there are."""
    rng = np.random.default_rng(0)
    radiance = rng.exponential(size=(4096, 16, 3))
    moments, before = Moments(4096), np.zeros(4096, np.int64)
    moments.add(slice(0, 4096), before, radiance)
    taken = []
    for _ in range(50):
        began = time.thread_time()
        moments.add(slice(0, 4096), before + 16, radiance)
        taken.append(time.thread_time() - began)
    print(f"moments: {1e9 * statistics.median(taken) / 65536:.1f} ns a sample")


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make_assets.make(folder / "assets")
        grains = tables()
        good = []
        for name, level in GOOD:
            made = world.build(loaded(name, folder, grains[name]), level)
            good.append(shown(name, level, made, SPP))
        print(f"{sum(good)} of {len(good)} good pictures are trusted")
        beads = replace(loaded("beads", folder, grains["beads"]), lights=(SUN,))
        bad = [
            shown("beads, sun", level, world.build(beads, level), spp) for level in PACKED for spp in (SPP, 40 * SPP)
        ]
        print(f"{len(bad) - sum(bad)} of {len(bad)} bad pictures are doubted")
        shown("beads, sun", "teleport", world.build(beads, "teleport"), SPP)
    cost()


if __name__ == "__main__":
    main()
