"""``tsdf-stress``: situations in which methods fail, ours and others, measured; a matrix of verdicts out."""

import shutil
from pathlib import Path

import click

from tsdf.cli.common import (
    Tool,
    check_folder,
    check_numbers,
    plain,
    say,
    seed_option,
    threads_option,
    working,
    write_text,
)
from tsdf.cli.start import interrupt_status, interrupted, interruptible

FILES = ("stress.md", "stress.csv", "stress.svg")
ROWS = """Rows, the last three of a TABLE only:

\b
restart grazing-restart far small vertices trapped diamond facets inverted
hole eta-1 bubble mirror half counters ends-of-u phi-edges far-exits drawn
furnace variance albedo-99999 albedo-1 billions leaps thin monolayer thin-60
thin-4 grazing f-01 f-30 f-64 f-57 deep dark mirrors eta-102 facets-traced
bubbles plates mirrors-bulk mixture thin-wall buried touching sheets scales
small-sun own-sums own-furnace own-slab"""  # written out, for --help imports nothing slow


@click.command("tsdf-stress", cls=Tool, epilog=ROWS)
@click.argument("table", required=False, type=click.Path(path_type=Path))
@click.option("--quick", is_flag=True, help="The rows that take least, with a tenth of the paths: half a minute.")
@click.option("--rows", metavar="A,B,..", help="Rows to measure, by the names below.")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="FOLDER",
    help="Folder to write to: stress.md, stress.csv and the matrix as a picture, stress.svg.",
)  # fmt: skip
@click.option("--mesh", type=click.Path(path_type=Path), metavar="FILE", help="Of a grain that is not beside TABLE.")
@seed_option("0")
@threads_option
@click.option("--quiet", is_flag=True, help="No progress bar, no table.")
def main(
    table: Path | None, quick: bool, rows: str | None, out: Path | None, mesh: Path | None, seed: int,
    threads: int | None, quiet: bool,
) -> int:  # fmt: skip
    """Measure where methods fail: ours, and what other software does, in situations that are known to break some.

    Rows about tables judge TABLE, a file or a ready table, else all ready ones; others need none. docs/stress.md says
    how to read what comes out. Ctrl-C keeps the rows that are done. Exit status 1 if a method of ours fails where it is
    claimed to hold, or a row that --rows names cannot be measured; 130 if interrupted, 2 if the request cannot be
    meant. Of own-slab nothing is claimed: what levels are worth depends on the grain.
    """
    from tsdf.errors import UsageError

    check_numbers(seed, threads=threads)
    if mesh is not None and table is None:
        raise UsageError("--mesh is of the grain of a TABLE: name it")
    if table is not None and table.suffix.lower() == ".toml":
        raise UsageError(f"{plain(table)}: is a scene; name a table, a file .tsdf.exr or a ready one")

    from tsdf.data import format as tsdf_format
    from tsdf.stress import report
    from tsdf.stress.cells import Setting
    from tsdf.stress.rows import chosen, measure

    setting = Setting(quick, seed, threads)
    if table is not None:
        from tsdf.scene.specs import GrainSpec
        from tsdf.walk.explicit import exemplar, mesh_beside

        setting.table = tsdf_format.read(table)
        setting.mesh = mesh or mesh_beside(setting.table, [table.parent])
        if mesh is not None:
            exemplar(GrainSpec(setting.table, mesh=mesh), setting.table, "--mesh")  # or else said after all other rows
    some = chosen(rows, setting)
    if out is not None:
        check_folder(out, FILES, *(path for path in (table, setting.mesh) if path is not None))
    with working(quiet) as work:

        def told(share: float, word: str) -> None:
            if interrupted():  # the exception was lost on its way, in a callback say
                raise KeyboardInterrupt
            work.told(share, word)

        with interruptible(work.meaning, raises=True):
            found = measure(some, setting, plain(table.name) if table is not None else "ready tables", told)

    if out is not None:
        words = ["tsdf-stress", *([plain(table)] if table else []), *(["--quick"] if quick else [])]
        words += [f"--rows {rows}"] if rows else []
        for name, text in zip(
            FILES, (report.page(found, " ".join(words)), report.csv_text(found), report.svg(found)), strict=True
        ):
            write_text(out / name, text)
    if not quiet:
        say(report.terminal(found, shutil.get_terminal_size((report.COLUMNS, 24)).columns))
    if found.interrupted:
        return interrupt_status()
    return 1 if found.broken or (rows is not None and found.notes) else 0
