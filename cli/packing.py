"""``tsdf-packing``: sphere packings in, a packing table out; or what a packing table says of itself."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsdf.cli.common import Tool, check_output, plain, say, seed_option, shown_progress, whole_number
from tsdf.errors import UsageError

if TYPE_CHECKING:
    from tsdf.spheres.packing_table import PackingTable


@click.command("tsdf-packing", cls=Tool)
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="The packing table to write, NAME.exr.")
@click.option("--info", is_flag=True, help="Show what FILE says, or the table that comes with the package.")
@click.option(
    "--fraction",
    "fractions",
    type=float,
    multiple=True,
    metavar="F",
    help="A packing fraction to tabulate [1], 0 < F <= 0.64. May be given several times.  "
    "[default: 0.05, 0.1, ... 0.6, 0.62, 0.64]",
)
@click.option(
    "--packings", callback=whole_number, default="4", metavar="N", show_default=True, help="Packings of each fraction."
)
@click.option(
    "--spheres", callback=whole_number, default="2000", metavar="N", show_default=True, help="Spheres of each packing."
)
@click.option(
    "--lines",
    callback=whole_number,
    default="15000",
    metavar="N",
    show_default=True,
    help="Lines through each packing, of about 32 gaps.",
)
@click.option(
    "--cells",
    callback=whole_number,
    default="32",
    metavar="N",
    show_default=True,
    help="Cells of the exit's obliquity.",
)
@click.option(
    "--records", callback=whole_number, default="256", metavar="K", show_default=True, help="Records of each cell."
)
@seed_option("0")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def main(
    file: Path | None,
    out: Path | None,
    info: bool,
    fractions: tuple[float, ...],
    packings: int,
    spheres: int,
    lines: int,
    cells: int,
    records: int,
    seed: int,
    quiet: bool,
) -> None:
    """Make a packing table, which says what comes next along lines through packings; or show --info of one.

    With its defaults the table is the one that comes with the package.
    """
    if info == (out is not None):
        raise UsageError("give --out for a table to make, or --info for one to look at")
    if file is not None and not info:
        raise UsageError("FILE goes with --info; the table to make is named by --out")

    from tsdf.spheres import packing_table

    if out is None:
        for line in _lines(packing_table.shipped() if file is None else packing_table.read(file)):
            click.echo(plain(line))
        return
    check_output(out)
    chosen = fractions or packing_table.FRACTIONS
    done = 0
    with shown_progress(quiet) as progress:

        def told(fraction: float) -> None:
            nonlocal done
            done += 1
            progress(done / len(set(chosen)), f"packing fraction {fraction:g}")

        table = packing_table.tabulate(chosen, packings, spheres, lines, cells, records, seed, progress=told)
    packing_table.write(table, out)
    if not quiet:
        for line in _lines(table, str(out)):
            say(plain(line))


def _lines(table: "PackingTable", name: str = "") -> Iterator[str]:
    """What a table says of itself."""
    made = table.header["provenance"]
    yield f"{name + ': ' if name else ''}packing table, format {table.header['format_version']}"
    yield f"  {'cells, records':<16}{table.cells} cells of exit_b2, {table.records} records each"
    yield f"  {'packings':<16}{made['packings']} of {made['spheres']} spheres, {made['lines']} lines each"
    yield f"  {'made by':<16}{made['software']}, seed {made['seed']}"
    yield f"  {'command':<16}{made['command']}"
    yield f"  {'licence':<16}{table.header['licence']}"
    yield f"  {'pixels_sha256':<16}{table.header['pixels_sha256']}"
    yield (
        "fraction  <gap^2> / 2 lambda_b^2  <b_o b_i cos psi>     corr(b_o^2, b_i^2)    "
        "displacement per event of spheres, eta 1.31 [R^2], the table's"
    )
    for entry in table.header["fractions"]:
        s, e = entry["statistics"], entry["standard_errors"]
        off = 100.0 * (entry["table_displacement"] / s["displacement"] - 1.0)
        yield (
            f"{entry['fraction']:<10g}"
            f"{s['gap_second_moment']:.4f} +- {e['gap_second_moment']:.4f}      "
            f"{s['tangent_correlation']:+.4f} +- {e['tangent_correlation']:.4f}   "
            f"{s['entry_correlation']:+.4f} +- {e['entry_correlation']:.4f}   "
            f"{s['displacement']:10.3f} +- {e['displacement']:.3f}, {off:+.2f} %"
        )
