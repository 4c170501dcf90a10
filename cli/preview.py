"""``tsdf-preview``: a grain or its table in, one picture of what it looks like and which level to take out."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsdf.cli.absorption import FORM, conventions, times_radius
from tsdf.cli.build import optics_of
from tsdf.cli.common import Tool, check_output, plain, say, setting, threads_option, working
from tsdf.cli.spectral import is_table, metres
from tsdf.errors import UsageError
from tsdf.make.quality import QUALITIES

if TYPE_CHECKING:
    from tsdf.data.table import Table
    from tsdf.scene.scene import Absorption
    from tsdf.study.preview import Preview

DEFAULT_RADIUS = "0.5mm"
QUALITY = "draft"
FLAT_PATHS = 1_000_000  # of grains for which it is out of reach


@click.command("tsdf-preview", cls=Tool)
@click.argument("grain", metavar="TABLE|GRAIN")
@click.option(
    "--out", default="preview.png", show_default=True, type=click.Path(path_type=Path),
    help="Picture to write, .png, .pdf or .svg.",
)  # fmt: skip
@click.option(
    "--material", metavar="NAME|FILE",
    help="What absorbs, as of tsdf-build.  [default: what the table was made of, nothing if that was a bare --eta]",
)  # fmt: skip
@click.option("--eta", type=float, help="Relative refractive index of a GRAIN.  [default: the material's, else of ice]")
@click.option("--absorption", metavar="X[,Y,Z]/UNIT", help=f"Instead of a material: {FORM}.")
@click.option(
    "--radius", callback=metres, default=DEFAULT_RADIUS, show_default=True, metavar="LENGTH",
    help="Bounding radius R, which says how much a material absorbs.",
)  # fmt: skip
@click.option(
    "--packing-fraction", type=float, default=0.6, show_default=True, metavar="F",
    help="Of bounding spheres, at most 0.64.",
)  # fmt: skip
@click.option(
    "--set", "settings", multiple=True, callback=setting, metavar="NAME=VALUE",
    help="A parameter of a built-in GRAIN; tsdf-build --grains lists them.",
)  # fmt: skip
@click.option(
    "--seconds", type=float, default=12.0, show_default=True, metavar="S",
    help="For the pictures; compiling, once for this machine, and a GRAIN's table come on top.",
)  # fmt: skip
@threads_option
@click.option("--quiet", is_flag=True, help="No progress bar, no summary.")
def main(
    grain: str, out: Path, material: str | None, eta: float | None, absorption: str | None, radius: float,
    packing_fraction: float, settings: dict[str, str], seconds: float, threads: int | None, quiet: bool,
) -> None:  # fmt: skip
    """Draw what a grain looks like: lit, as a ball, a slab and a heap, and the colour of a deep medium.

    Beneath each picture stands which level to take for one like it, and why; standard output says the same. A GRAIN (a
    built-in one or a mesh file) gets a table of quality draft first, which takes a few seconds and is not kept.
    """
    from tsdf.cli.common import check_numbers
    from tsdf.study.plots import check_suffix

    check_numbers(threads=threads)
    check_suffix(out)
    tabulated = is_table(grain)
    if tabulated and (settings or eta is not None):
        raise UsageError("--set and --eta are of a GRAIN that is built, not of a table")
    if material is not None and absorption is not None:
        raise UsageError("--material and --absorption each say what absorbs: give one")
    if not 0.0 < seconds < float("inf"):
        raise UsageError(f"--seconds is a finite number above 0, not {seconds:g}")
    if not 0.0 < packing_fraction <= 0.64:
        raise UsageError(
            f"--packing-fraction is above 0 and at most 0.64, the densest at random, not {packing_fraction:g}"
        )
    check_output(out, Path(grain), *([Path(material)] if material is not None else []))
    by_hand = times_radius(absorption, radius, 1.0, colours=True) if absorption is not None else None

    from tsdf.picture import ahead
    from tsdf.study import plots
    from tsdf.study.preview import preview

    ahead.begin()
    with working(quiet) as work:
        work.told(0.0, "reading the grain")
        table, mesh = table_of(grain, tabulated, eta, material, settings, threads, quiet)
        absorbs = absorption_of(table, material if tabulated or eta is not None else None, by_hand)
        found = preview(table, absorbs, radius, packing_fraction, mesh, seconds, threads, work.progress)
        notes = about(found, absorbs, radius)
        plots.save(plots.plot_preview(found, notes), out)
    if not quiet:
        summary(found, notes, out)


def table_of(
    grain: str, tabulated: bool, eta: float | None, material: str | None, settings: dict[str, str],
    threads: int | None, quiet: bool,
) -> tuple["Table", Path | None]:  # fmt: skip
    """Return the table that is named, or a draft of the grain that is, and the mesh of it where that is a file."""
    from tsdf.data import format as tsdf_format
    from tsdf.grain.grains import load_grain
    from tsdf.make.build import build
    from tsdf.make.effort import Effort
    from tsdf.walk.explicit import mesh_beside

    if tabulated:
        table = tsdf_format.read(Path(grain))
        return table, mesh_beside(table, [Path(grain).parent])
    shape = load_grain(grain, False, **settings)
    draft = QUALITIES[QUALITY]
    effort = Effort(target_error=draft.target_error, joint=draft.joint, memory=draft.memory)
    optics = optics_of(eta, None if eta is not None else material, None, "un", quiet)
    built_in = shape.kind == "sphere" or not Path(grain).is_file()
    mesh = None if built_in else Path(grain)
    try:
        return build(shape, optics, effort, threads), mesh
    except UsageError:  # of flat grains no number of cells is enough; a picture is not the place to say so
        return build(shape, optics, Effort(paths=FLAT_PATHS, joint=draft.joint, memory=draft.memory), threads), mesh


def absorption_of(table: "Table", material: str | None, by_hand: tuple[float, ...] | None) -> "Absorption":
    """Return what absorbs: what was said, else the material that the table was made of, else nothing."""
    from tsdf.scene.scene import Absorption, absorbing_material

    if by_hand is not None:
        return Absorption("rgb", by_hand if len(by_hand) == 3 else by_hand * 3)
    if material is not None:
        return Absorption("spectral", material=absorbing_material(material))
    made_of = table.header["optics"]["material"]
    try:
        return Absorption("spectral", material=absorbing_material(made_of)) if made_of else Absorption("grey", (0.0,))
    except UsageError:  # quartz say, which is clear, or a file that is not here
        return Absorption("grey", (0.0,))


def about(found: "Preview", absorbs: "Absorption", radius: float) -> list[str]:
    """Return lines about the grain and what the pictures assume."""
    table, medium = found.table, found.medium
    optics = table.header["optics"]
    if absorbs.kind == "spectral":
        dark = f"absorption of {plain(absorbs.material)}"
    elif any(absorbs.coefficient):
        dark = f"absorption {conventions(absorbs.coefficient, radius, 1.0)}"
    else:
        dark = "no absorption (--material, --absorption)"
    return [
        f"{plain(table.header['grain']['name'])}, eta {optics['eta']:.4g}, R = {1e3 * radius:.4g} mm",
        dark,
        f"packing fraction {medium.packing_fraction:g} of bounding spheres",
        f"mean cosine g = {medium.mean_cosine:.3f}",
        f"transport mean free path l* = {medium.transport:.3g} R = {1e3 * radius * medium.transport:.3g} mm",
        "Which level? Single grains seen (a pixel covers less than R): explicit, or a chain with explicit_grains. "
        "Else thicker than 25 l*: volume. Thinner than 10 R, or dense: teleport-memory. Else teleport.",
    ]


def summary(found: "Preview", notes: list[str], out: Path) -> None:
    """Say on standard output what the picture says."""
    say(f"{plain(out)}: {'; '.join(notes[:-1])}")
    for panel in found.panels:
        say(f"  {panel.title}: {panel.advice}: {panel.advice.reason}" + (f" ({panel.drawn})" if panel.drawn else ""))
    say(f"  deep colour: linear {', '.join(f'{c:.3f}' for c in found.deep)}; any level has it")
