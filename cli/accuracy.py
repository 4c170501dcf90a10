"""``tsdf-accuracy``: a table in, the error of every level in bulk and in slabs out."""

from pathlib import Path

import click

from tsdf.cli.common import (
    Tool,
    check_folder,
    check_numbers,
    named_levels,
    plain,
    say,
    seed_option,
    threads_option,
    working,
    write_text,
)
from tsdf.cli.start import interrupt_status, interrupted, interruptible
from tsdf.scene.levels import DETAILED as MEASURED


@click.command("tsdf-accuracy", cls=Tool)
@click.argument("table", type=click.Path(path_type=Path))
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), metavar="FOLDER",
    help="Folder to write to: accuracy.csv, accuracy.md, accuracy.png.",
)  # fmt: skip
@click.option(
    "--packing", type=float, multiple=True, metavar="F", default=(0.1, 0.3, 0.5, 0.6, 0.64), show_default=True,
    help="Packing fraction; may be given several times.",
)  # fmt: skip
@click.option(
    "--layer", type=float, multiple=True, metavar="T", default=(2.0, 4.0, 10.0, 40.0), show_default=True,
    help="Thickness of the layer of centres of a slab's grains [R]; may be given several times.",
)  # fmt: skip
@click.option("--levels", metavar="A,B,..", help=f"Levels to measure.  [default: {','.join(MEASURED)}]")
@click.option("--mesh", type=click.Path(path_type=Path), metavar="FILE", help="Of a grain that is not beside TABLE.")
@click.option(
    "--seconds", type=float, metavar="S",
    help="Time of measuring, after a start that makes packings and compiles once for this machine.  [default: 300]",
)  # fmt: skip
@click.option("--paths", type=int, metavar="N", help="Paths of each slab, level and packing instead.")
@click.option(
    "--packings", type=int, default=4, metavar="K", show_default=True, help="Packings behind levels of packed grains."
)
@seed_option("0")
@threads_option
@click.option("--quiet", is_flag=True, help="No progress bar, no report.")
def main(
    table: Path, out: Path, packing: tuple[float, ...], layer: tuple[float, ...], levels: str | None,
    mesh: Path | None, seconds: float | None, paths: int | None, packings: int, seed: int, threads: int | None,
    quiet: bool,
) -> int:  # fmt: skip
    """Measure the levels that render the grain of TABLE against tracing packed grains one by one.

    In the bulk: mean squared displacement per event. In slabs: light that comes back and passes, at two angles, of
    lossless grains and of albedo 0.99. A level that is impossible is skipped with a word. Ctrl-C keeps what is done.
    With --paths the same command gives the same numbers, but for times. Exit status 130 if interrupted, 1 if the table
    cannot be measured, 2 if the request cannot be meant.
    """
    from tsdf.errors import SceneError, TSDFError

    chosen = named_levels(levels, MEASURED)
    check_numbers(seed, threads=threads)

    from tsdf.data import format as tsdf_format
    from tsdf.scene.scene import GrainSpec
    from tsdf.study import accuracy, plots
    from tsdf.study import accuracy_files as files
    from tsdf.walk.explicit import mesh_beside

    read = tsdf_format.read(table)
    mesh = mesh or mesh_beside(read, [table.parent])
    meshes = [] if mesh is None else [mesh]
    check_folder(out, ["accuracy.md", "accuracy.csv", "accuracy.png"], table, *meshes)
    with working(quiet) as work:

        def told(share: float, word: str) -> None:
            if interrupted():  # the exception was lost on its way, in a callback say
                raise KeyboardInterrupt
            work.told(share, word)

        try:
            with interruptible(work.meaning, raises=True):
                found = accuracy.measure(
                    GrainSpec(read, mesh=mesh), packing, layer, chosen, packings, seconds, paths, seed, threads, told,
                    plain(table.name),
                )  # fmt: skip
        except SceneError as error:
            raise TSDFError(f"{error} (--mesh FILE)" if mesh is None else str(error)) from None
        for name, text in (("accuracy.md", files.markdown(found)), ("accuracy.csv", files.csv_text(found))):
            write_text(out / name, text)
        if found.rows:
            plots.save(plots.plot_accuracy(files.facts(found), found.fraction, found.name), out / "accuracy.png")
    if not quiet:
        say(f"{files.summary(found)}\n{plain(out / 'accuracy.md')} has every number")
    if found.interrupted:
        click.echo(f"interrupted: {plain(out)} holds what was done", err=True)
    return interrupt_status() if found.interrupted else 0
