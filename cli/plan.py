"""``tsdf-plan``: which level a scene needs, and what each would cost and get wrong."""

import json
import shutil
import textwrap
from pathlib import Path

import click

from tsdf.cli.common import (
    Tool,
    check_numbers,
    check_output,
    interrupt_status,
    plain,
    say,
    seed_option,
    threads_option,
    working,
    write_text,
)


@click.command("tsdf-plan", cls=Tool)
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "--target", type=float, default=0.02, show_default=True, metavar="E",
    help="Error of the picture over its mean: bias, missing texture and noise of pixels together.",
)  # fmt: skip
@click.option(
    "--seconds", type=float, metavar="S",
    help="Time for the picture: what meets the target within it, else what has the least error after it.",
)  # fmt: skip
@seed_option("the scene's")
@click.option("--width", type=int, metavar="PIXELS", help="Width of the picture; its shape is kept.")
@click.option("--json", "as_json", is_flag=True, help="Print the predictions as JSON.")
@click.option("--out", type=click.Path(path_type=Path), help="Write the predictions to this file, .json.")
@threads_option
@click.option("--quiet", is_flag=True, help="No progress bar; with --out nothing else either.")
def main(
    scene: Path, target: float, seconds: float | None, seed: int | None, width: int | None, as_json: bool,
    out: Path | None, threads: int | None, quiet: bool,
) -> int:  # fmt: skip
    """Predict for SCENE, a TOML file, what each level costs and gets wrong, and say which to take.

    It renders a few pixels at each level that may do, for 5 seconds in all, or a tenth of --seconds if that is more, 20
    at most, of processors that have nothing else to do; machine code that is made for the first time comes on top, and
    so do packings and records where they leave less than 2 seconds. An interrupt after the first look at all levels
    ends it with what is known by then. tsdf-render without a level does the same and renders what is chosen.
    """
    from tsdf.errors import UsageError
    from tsdf.plan.planner import checked_target

    check_numbers(seed, width=width, threads=threads)
    checked_target(target, "--target")
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise UsageError(f"--seconds is a finite number above 0, not {seconds:g}")
    if out is not None and out.suffix.lower() != ".json":
        raise UsageError(f"--out {plain(out)}: is to end in .json")

    from tsdf.picture import ahead
    from tsdf.plan import planner, report
    from tsdf.scene.scene import load, resized
    from tsdf.scene.specs import files_of

    read = resized(load(scene), width)
    if out is not None:
        check_output(out, scene, *files_of(read))
    ahead.begin()
    with working(quiet) as work:
        plan = planner.plan(read, target, seconds, None, seed, threads, work.told, work.stop)
    text = json.dumps(report.facts(plan), indent=1)
    if out is not None:
        write_text(out, text + "\n")
    if as_json:
        say(text)
    elif not (quiet and out is not None):
        width = max(shutil.get_terminal_size((120, 24)).columns, 40)
        for line in (*plan.why, *(f"table: {need}" for need in plan.needs)):
            say(textwrap.fill(plain(line), width, subsequent_indent="  ", break_on_hyphens=False))
        for line in ("", *report.table(plan)):
            say(plain(line))
    if not quiet:
        for note in plan.notes:
            click.echo(f"note: {plain(note)}", err=True)
        click.echo(f"planned in {plan.spent:.1f} s of free processors, {plan.clock:.1f} s by the clock", err=True)
    return interrupt_status() if work.stop.is_set() else 0
