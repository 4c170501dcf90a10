"""``tsdf-export``: parameters of a table's medium for other renderers."""

import math
from pathlib import Path

import click
from click.core import ParameterSource

from tsdf.cli import spectral
from tsdf.cli.common import Tool, check_numbers, check_output, plain, write_text
from tsdf.cli.sizes import colour_of, coloured, in_words, length, said, sized

SPECTRAL = ("tartes", "snicar", "disort", "eradiate", "phase")  # `radiative` writes them
MEDIA = ("pbrt", "blender", "openpbr", "materialx", "arnold", "karma", "csv", "npz")  # `loaders.export` writes them
TARGETS = (*MEDIA, *SPECTRAL)
ONLY = {  # what some targets alone can be told
    **dict.fromkeys(("deep_colour", "colour_thickness", "lobes", "kept", "thickness", "measure"), MEDIA),
    **dict.fromkeys(("wavelength_nm", "settings", "fresnel", "table_paths", "threads", "quiet"), SPECTRAL),
    "orders": ("disort",),
}


def _check_target(context: click.Context, to: str) -> None:
    """Refuse options that do not matter to a target."""
    for parameter in context.command.params:
        given = context.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE
        if given and to not in ONLY.get(str(parameter.name), TARGETS):
            raise click.UsageError(f"{parameter.opts[0]} is not for --to {to}")


def _check_numbers(
    words: dict[str, float],
    unit: float | None,
    kept: float,
    thickness: float | None,
    colour_thickness: float | None,
    coloured: bool,
) -> None:
    """Refuse what no medium can have."""
    from tsdf.errors import UsageError
    from tsdf.scene.sizes import SIZES

    if not 0.0 < kept < 1.0:
        raise UsageError(f"--kept is a share > 0 and < 1, not {kept:g}")
    if thickness is not None and not thickness > 0.0:
        raise UsageError(f"--thickness is a number > 0, not {thickness:g}")
    if not any(word in words for word in SIZES):
        raise UsageError("say how large grains are: give one of --radius, --effective-radius, --sieve, ... (--help)")
    if colour_thickness is not None and not coloured:
        raise UsageError("--colour-thickness is of a colour: give --deep-colour too")
    for name, value in (("--unit", unit), ("--colour-thickness", colour_thickness)):
        if value is not None and not 0.0 < value < math.inf:
            raise UsageError(f"{name} is a finite number > 0, not {value:g}")


@click.command("tsdf-export", cls=Tool)
@click.argument("files", nargs=-1, required=True, metavar="FILE..")
@click.option("--to", required=True, type=click.Choice(TARGETS), help="What to write for.")
@sized
@coloured
@click.option(
    "--absorption", metavar="X/R",
    help="Absorption coefficient of the grains' material: X/R is X over the bounding radius, X/unit per scene unit, "
    "X/mm (um, cm, m) per length, with --unit; X is one number, or red,green,blue.  [default: 0]",
)  # fmt: skip
@click.option(
    "--material", metavar="NAME|FILE",
    help="Absorb as this material instead (ice, say, or a file as of tsdf-build --material); needs --unit.",
)  # fmt: skip
@click.option(
    "--unit", type=float, is_eager=True, metavar="METRES",
    help="Length of the scene unit; only --material, X/mm and --ssa need it.  [default: that of a length like 0.5mm]",
)  # fmt: skip
@click.option(
    "--lobes", type=click.IntRange(1, 2),
    help="Henyey-Greenstein lobes where the target can mix two.  [default: two where needed; Blender: 1]",
)  # fmt: skip
@click.option(
    "--kept", type=float, default=0.99, show_default=True, metavar="SHARE",
    help="Share of the light [1] that the number of bounces is to keep.",
)  # fmt: skip
@click.option(
    "--thickness", callback=length, metavar="L", help="Of the body in scene units, for the bounces.  [default: deep]"
)  # fmt: skip
@click.option("--measure", is_flag=True, help="Render a slab of 40 R to find the error of point scatterers.")
@click.option(
    "--wavelength-nm", metavar="FROM:TO:STEP|A,B,..",
    help="For tartes, disort, eradiate, phase [nm].  [default: 300:2500:10; snicar has its own]",
)  # fmt: skip
@click.option(
    "--orders", type=click.IntRange(1, 1024), default=128, show_default=True, metavar="N",
    help="Highest Legendre moment for disort.",
)  # fmt: skip
@spectral.building
@click.option("--quiet", is_flag=True, help="No progress bar where tables are made.")
@click.option("--out", metavar="PATH", help="File to write.  [default: standard output; npz and netCDF need it]")
def main(  # noqa: PLR0913 - an argument for each option
    files: tuple[str, ...], to: str, absorption: str | None, material: str | None, deep_colour: str | None,
    colour_thickness: float | None, unit: float | None, lobes: int | None, kept: float, thickness: float | None,
    measure: bool, wavelength_nm: str | None, orders: int, settings: dict[str, str], fresnel: str | None,
    table_paths: int, threads: int | None, quiet: bool, out: str | None, **options: float | None,
) -> None:  # fmt: skip
    """Write the medium of grains of the table FILE for another renderer, or the table as plain arrays.

    Each text says what level of model it stands for, what that costs and how many bounces it needs; a page on each
    target is in the folder docs. For tartes, snicar, disort, eradiate and phase, FILE may be several tables of one
    grain at several indices, or a grain as of tsdf-optics; their lengths are in metres unless --unit says otherwise.
    """
    _check_target(click.get_current_context(), to)
    check_numbers(threads=threads, **{"table-paths": table_paths})
    if to in SPECTRAL:
        from tsdf.cli import radiative

        building = {"settings": settings, "fresnel": fresnel, "table_paths": table_paths, "threads": threads}
        said_so = radiative.Said(absorption, material, wavelength_nm, unit, orders, out, options, building, quiet)
        radiative.export(files, to, said_so)
        return
    if len(files) > 1:
        raise click.UsageError(f"--to {to} takes one table, not {len(files)}")
    file = files[0]
    from tsdf.cli.absorption import conventions, times_radius
    from tsdf.errors import UsageError

    words, colour = said(options), colour_of(deep_colour)
    _check_numbers(words, unit, kept, thickness, colour_thickness, bool(colour))
    if sum(given is not None for given in (absorption, material, deep_colour)) > 1:
        raise UsageError("--absorption, --material and --deep-colour all say how grains absorb: give one")
    if material is not None and unit is None:
        raise UsageError(f"absorption of {plain(material)} is per metre: say with --unit how long the scene unit is")
    if to == "npz" and out is None:
        raise UsageError("npz is no text: say with --out where to write it")
    if out is not None:
        check_output(Path(out), Path(file), printed="" if to == "npz" else "leave it out")

    from tsdf.data import format as tsdf_format
    from tsdf.loaders import export
    from tsdf.loaders.pointmedium import point_medium
    from tsdf.scene.deep import absorption_of_colour
    from tsdf.scene.scene import Absorption, absorbing_material

    table = tsdf_format.read(file)
    grains = in_words(table, words, unit)
    packing, radius = grains.fraction, grains.radius
    products = times_radius(absorption, radius, unit, colours=True)
    if colour:
        thick = math.inf if colour_thickness is None else colour_thickness / radius
        products = absorption_of_colour(table, colour, thick, packing)
    if material is not None:
        spec = Absorption("spectral", material=absorbing_material(material))
    elif len(products) == 1:
        spec = Absorption("grey", (products[0] / radius,))
    else:
        spec = Absorption("rgb", tuple(x / radius for x in products))
    medium = point_medium(table, packing, radius, spec, unit)
    measured = export.level_errors(medium, export.SLAB * radius) if measure else None
    told = [grains.summary()]
    if colour:
        body = "deep" if colour_thickness is None else f"{colour_thickness:g} thick"
        told.append(f"colour {plain(deep_colour)} where {body}: absorption {conventions(products, radius, unit)}")
    deep = math.inf if thickness is None else thickness
    request = export.Request(medium, lobes, kept, deep, measured, tuple(told))
    if to == "npz":
        assert out is not None
        export.write_npz(request, out)
        return
    text = export.TEXTS[to](request)
    if out is None:
        click.echo(text, nl=False)
        return
    write_text(out, text)
