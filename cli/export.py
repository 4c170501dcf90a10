"""``tsdf-export``: parameters of a table's medium for other renderers."""

import math
from pathlib import Path

import click

from tsdf.cli.common import Tool, check_output, plain, write_text

TARGETS = ("pbrt", "blender", "openpbr", "materialx", "arnold", "karma", "csv", "npz")


@click.command("tsdf-export", cls=Tool)
@click.argument("file")
@click.option("--to", required=True, type=click.Choice(TARGETS), help="What to write for.")
@click.option(
    "--packing", required=True, type=float, metavar="F",
    help="Share of the volume in bounding spheres [1], 0 < F <= 0.74.",
)  # fmt: skip
@click.option(
    "--radius", required=True, type=float, metavar="L",
    help="Bounding radius of the grains in scene units.",
)  # fmt: skip
@click.option(
    "--absorption", metavar="X/R",
    help="Absorption coefficient of the grains' material: X/R is X over the bounding radius, X/unit per scene unit, "
    "X/mm (um, cm, m) per length, with --unit; X is one number, or red,green,blue.  [default: 0]",
)  # fmt: skip
@click.option("--material", metavar="NAME", help="Absorb as this material instead (ice, say); needs --unit.")
@click.option(
    "--unit", type=float, metavar="METRES", help="Length of the scene unit; only --material and X/mm need it."
)
@click.option(
    "--lobes", type=click.IntRange(1, 2),
    help="Henyey-Greenstein lobes where the target can mix two.  [default: two where needed; Blender: 1]",
)  # fmt: skip
@click.option(
    "--kept", type=float, default=0.99, show_default=True, metavar="SHARE",
    help="Share of the light [1] that the number of bounces is to keep.",
)  # fmt: skip
@click.option(
    "--thickness", type=float, metavar="L", help="Of the body in scene units, for the bounces.  [default: deep]"
)  # fmt: skip
@click.option("--measure", is_flag=True, help="Render a slab of 40 R to find the error of point scatterers.")
@click.option("--out", metavar="PATH", help="File to write.  [default: standard output; npz needs it]")
def main(
    file: str, to: str, packing: float, radius: float, absorption: str | None, material: str | None,
    unit: float | None, lobes: int | None, kept: float, thickness: float | None, measure: bool, out: str | None,
) -> None:  # fmt: skip
    """Write the medium of grains of the table FILE for another renderer, or the table as plain arrays.

    Each text says what level of model it stands for, what that costs and how many bounces it needs; a page on each
    target is in the folder docs.
    """
    from tsdf.cli.absorption import times_radius
    from tsdf.errors import UsageError

    if not 0.0 < kept < 1.0:
        raise UsageError(f"--kept is a share > 0 and < 1, not {kept:g}")
    if thickness is not None and not thickness > 0.0:
        raise UsageError(f"--thickness is a number > 0, not {thickness:g}")
    if absorption is not None and material is not None:
        raise UsageError("--absorption and --material both say how grains absorb: give one")
    if material is not None and unit is None:
        raise UsageError(f"absorption of {plain(material)} is per metre: say with --unit how long the scene unit is")
    if not 1e-30 <= radius <= 1e30:
        raise UsageError(f"--radius is a number of scene units from 1e-30 to 1e30, not {radius:g}")
    if unit is not None and not 0.0 < unit < math.inf:
        raise UsageError(f"--unit is a finite number of metres > 0, not {unit:g}")
    products = times_radius(absorption, radius, unit, colours=True)
    if to == "npz" and out is None:
        raise UsageError("npz is no text: say with --out where to write it")
    if out is not None:
        check_output(Path(out), Path(file))

    from tsdf.data import format
    from tsdf.loaders import export
    from tsdf.loaders.pointmedium import point_medium
    from tsdf.scene.scene import Absorption

    table = format.read(file)
    if material is not None:
        _check_material(material)
        spec = Absorption("spectral", material=material)
    elif len(products) == 1:
        spec = Absorption("grey", (products[0] / radius,))
    else:
        spec = Absorption("rgb", tuple(x / radius for x in products))
    medium = point_medium(table, packing, radius, spec, unit)
    measured = export.level_errors(medium, export.SLAB * radius) if measure else None
    request = export.Request(medium, lobes, kept, math.inf if thickness is None else thickness, measured)
    if to == "npz":
        assert out is not None
        export.write_npz(request, out)
        return
    text = export.TEXTS[to](request)
    if out is None:
        click.echo(text, nl=False)
        return
    write_text(out, text)


def _check_material(name: str) -> None:
    """Refuse what does not absorb or is not known."""
    from tsdf.errors import UsageError
    from tsdf.scene.scene import ABSORBING

    if name not in ABSORBING:
        raise UsageError(f"--material: no absorbing material {plain(name)!r}; there are {', '.join(ABSORBING)}")
