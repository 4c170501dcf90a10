"""``tsdf-plot``: a picture of a table."""

from pathlib import Path

import click

from tsdf.cli.common import Tool, check_output


@click.command("tsdf-plot", cls=Tool)
@click.argument("file")
@click.option("--out", required=True, metavar="PNG|PDF", help="Picture to write; the suffix says which.")
def main(file: str, out: str) -> None:
    """Draw the distributions of the table FILE, as Fig. 1 of Meng et al. 2015 does.

    \b
    p_theta as a density over cos theta, and the densities of phi_Delta, r, z and the path length given cos theta.
    Lengths are in units of the bounding radius R. Light in the atoms stands beside the axes.
    """
    from tsdf.study import plots

    plots.check_suffix(out)
    check_output(Path(out), Path(file))
    from tsdf.data import format as tsdf_format

    plots.save(plots.plot_table(tsdf_format.read(file)), out)
