"""``tsdf-merge``: the parts of a build in, its table out."""

from pathlib import Path

import click

from tsdf.cli.build import finish
from tsdf.cli.common import Tool, check_output


@click.command("tsdf-merge", cls=Tool)
@click.argument("parts", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The table to write, NAME.tsdf.exr.")
@click.option("--quiet", is_flag=True, help="No summary.")
def main(parts: tuple[Path, ...], out: Path, quiet: bool) -> None:
    """Merge the PARTS that tsdf-build --chunk i/n wrote, in any order, into one table."""
    check_output(out, *parts)
    from tsdf.make.scatterometer import merge

    finish(merge(list(parts)).table(), out, quiet)
