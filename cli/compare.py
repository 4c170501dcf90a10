"""``tsdf-compare``: a scene in, the error and the time of every level out."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsdf.cli.common import Tool, make_folder, plain, watched
from tsdf.cli.render import LEVELS, save

if TYPE_CHECKING:
    from tsdf.render import Picture
    from tsdf.world import World


@click.command("tsdf-compare", cls=Tool)
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), metavar="DIR",
    help="Folder to write to: levels.md, levels.csv, levels.png and a picture of each level.",
)  # fmt: skip
@click.option("--levels", metavar="A,B,..", help="Levels to compare.  [default: all]")
@click.option("--spp", type=int, metavar="N", help="Samples per pixel of each level and packing.")
@click.option("--seconds", type=float, metavar="S", help="Time of each level instead.  [default: 10]")
@click.option(
    "--reference-seconds", type=float, metavar="S",
    help="Time of all packings together.  [default: 6 times --seconds, or --spp]",
)  # fmt: skip
@click.option("--packings", type=int, default=4, metavar="K", help="Packings behind the reference.  [default: 4]")
@click.option("--width", type=int, metavar="PIXELS", help="Width of the pictures; their shape is kept.")
@click.option("--seed", type=int, metavar="N", help="Of the random numbers, >= 0.  [default: the scene's]")
@click.option("--threads", type=int, metavar="N", help="[default: all processors]")
@click.option("--quiet", is_flag=True, help="No progress bar, no table.")
def main(
    scene: Path, out: Path, levels: str | None, spp: int | None, seconds: float | None,
    reference_seconds: float | None, packings: int, width: int | None, seed: int | None, threads: int | None,
    quiet: bool,
) -> int:  # fmt: skip
    """Compare the levels of SCENE, a TOML file, with tracing its grains one by one.

    The reference is the explicit level, or the best one that is possible; it is rendered with several packings, so that
    its own noise is known. A level that is impossible is skipped with a word. Ctrl-C keeps what is done. Exit status
    130 then, 1 if the scene cannot be rendered, 2 if the request cannot be meant.
    """
    from difflib import get_close_matches

    from tsdf.errors import UsageError

    chosen = [name.strip() for name in levels.split(",")] if levels is not None else list(LEVELS)
    for name in chosen:
        if name not in LEVELS:
            near = get_close_matches(name, LEVELS, 1)
            hint = f"did you mean {near[0]}?" if near else f"levels are {', '.join(LEVELS)}"
            raise UsageError(f"--levels: no level {name!r}; {hint}")
    for option, value in (("--spp", spp), ("--width", width), ("--threads", threads)):
        if value is not None and value < 1:
            raise UsageError(f"{option} is a whole number of at least 1, not {value}")
    if seed is not None and not 0 <= seed < 2**63:
        raise UsageError(f"--seed is a whole number from 0 to 2^63 - 1, not {seed}")

    from tsdf import compare, plots
    from tsdf.files import replacing
    from tsdf.scene import load, resized

    read = resized(load(scene), width)
    make_folder(out)

    def keep(name: str, world: "World", picture: "Picture", own: int) -> None:
        save(world, picture, own, out / f"{name}.exr")

    with watched(quiet) as progress:
        found = compare.compare(
            read, chosen, spp, seconds, reference_seconds, packings, read.render.seed if seed is None else seed,
            threads, progress, keep,
        )  # fmt: skip
    for name, text in (("levels.md", compare.markdown(found)), ("levels.csv", compare.csv_text(found))):
        with replacing(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    if found.pictures > 1:
        plots.save(plots.plot_levels(compare.facts(found), found.reference, found.scene.name), out / "levels.png")
    if not quiet:
        click.echo(compare.markdown(found), nl=False)
    if found.interrupted:
        click.echo(f"interrupted: {plain(out)} holds {len(found.rows)} of the levels", err=True)
    lost = sum(row.picture.truncated + row.picture.faults for row in found.rows)
    if lost:
        click.echo(f"warning: {lost} paths were given up", err=True)
    return 130 if found.interrupted else 0
