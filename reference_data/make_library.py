"""Makes the ready tables, ``tsdf/data/library``, and their page: ``python -m tsdf.reference_data.make_library``.

The same version of the package makes the same bytes, whatever the number of threads. Names given make only these.
"""

import sys
from pathlib import Path
from typing import Any

import tsdf
from tsdf.data.library import FOLDER, SUFFIX
from tsdf.grain.constants import constants_of

NM = 550.0  # [nm] of the constants
PAGE = Path(tsdf.__file__).parent.parent / "docs" / "library.md"
GRAINS: dict[str, tuple[str, dict[str, Any], str, str]] = {  # name: grain, parameters, material, what it is
    "coarse-snow": ("rounded", {}, "ice", "rounded, coarse grains"),
    "fresh-snow": ("fresh", {}, "ice", "plates grown through each other"),
    "glass-beads": ("sphere", {}, "glass", "exact spheres"),
    "plates": ("hexprism", {"aspect": 0.1}, "ice", "hexagonal plates, a tenth as thick as wide"),
    "quartz": ("ellipsoid", {"subdivisions": 4}, "quartz", "clear pebbles, worn smooth"),
    "salt": ("cube", {}, "salt", "sharp cubes"),
    "sand": ("sand", {"subdivisions": 4}, "quartz", "Gaussian random spheres"),
    "sugar": ("cube", {"bevel": 0.1}, "sucrose", "cubes with bevelled edges"),
}
EFFORT = tsdf.Effort(paths=4_000_000, cells=128, joint=16, memory=16)


def made(name: str) -> tsdf.Table:
    """Return the table of one name."""
    from tsdf.grain.optics import Optics

    grain, parameters, material, _ = GRAINS[name]
    c = constants_of(material, NM)
    effort = tsdf.Effort(cells=EFFORT.cells, joint=16, memory=16) if grain == "sphere" else EFFORT
    optics = Optics(c.n, "un", c.material, c.wavelength_nm, c.k, c.source)
    return tsdf.build(tsdf.load_grain(grain, **parameters), optics, effort)


def page() -> str:
    """Return docs/library.md."""
    rows = []
    for name, (_, _, material, what) in GRAINS.items():
        file = FOLDER / f"{name}{SUFFIX}"
        table = tsdf.read(file)
        b, dark, radius = table.absorption_enhancement, table.dark_share, table.effective_radius
        g, error = table.mean_cosine(), table.header["standard_errors"]["mean_cosine"]
        eta = table.header["optics"]["eta"]
        rows.append(
            f"| `{name}` | {what}, {material} | {eta:.4f} | {g:.4f} ± {error:.4f} | {b.value:.4f} ± {b.error:.4f} "
            f"| {100 * max(dark.value, 0):.1f} ± {100 * dark.error:.1f} % "
            f"| {table.statistics['hit_probability']:.4f} | {radius.value:.4f} "
            f"| {file.stat().st_size // 1000} |"
        )
    return HEAD + "\n".join(rows) + "\n" + commands()


def commands() -> str:
    """Return the part of the page that says how each was built."""
    lines = [tsdf.read(FOLDER / f"{name}{SUFFIX}").header["provenance"]["command"] for name in GRAINS]
    return "\n## How they were built\n\n" + "\n".join(f"- `{line}`" for line in lines) + "\n"


HEAD = """# Ready tables

Tables of grains that many need, in the public domain (CC0), installed with the package. Their names stand for files:

```
tsdf-info sugar --radius 0.5 --packing 0.6
tsdf-export salt --to npz --radius 1 --packing 0.6 --out salt.npz
```

```python
import tsdf

table = tsdf.library("sugar")
```

From nothing to a picture, `sugar.png`, of a ball of sugar in the sun:

```
pip install tsdf-toolkit
tsdf-render sugar --out sugar.exr
```

In Python `tsdf.render("sugar")`. A scene says `table = "sugar"`. **A file of that name wins**, in the folder of the
scene or, of a command, in the current one. Of a name that is neither, the error tells the nearest. Where built-in
grains are taken as well (`tsdf-optics`, `tsdf-albedo`), `sand` is the grain.

Each has 128 cells of theta, 16 joint records and 16 records by entry in each: enough for every level, too few to judge
the levels' errors by; build your own for that. Materials are at 550 nm and do not absorb: say absorption where it is
used. `make library` makes all again to the same bytes, and this page. Sizes are in R, the radius of the bounding
sphere: a crystal of sugar 1 mm from corner to corner has R = 0.5 mm. `tsdf-preview sugar` shows what
a table looks like, `make gallery` all of them. [Words](glossary.md), [sizes](sizes.md).

| name | grain | n | g, geometrical | B | dark share | hit probability | effective radius [R] | kB |
|---|---|---|---|---|---|---|---|---|
"""


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or GRAINS:
        tsdf.write(made(name), FOLDER / f"{name}{SUFFIX}")
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
