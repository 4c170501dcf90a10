"""``tsdf-compare``: a scene in, the error and the time of every level out."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsdf.cli.common import (
    LEVELS,
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
from tsdf.cli.render import save
from tsdf.cli.start import interrupt_status

if TYPE_CHECKING:
    from tsdf.picture.render import Picture
    from tsdf.picture.world import World


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
@seed_option("the scene's")
@threads_option
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
    chosen = named_levels(levels, LEVELS)
    check_numbers(seed, spp=spp, width=width, threads=threads)

    from tsdf.scene.scene import load, resized
    from tsdf.scene.specs import files_of
    from tsdf.study import compare, plots

    read = resized(load(scene), width)
    pictures = [f"{name}{suffix}" for name in (*LEVELS, "reference") for suffix in (".exr", ".png")]
    check_folder(out, ["levels.md", "levels.csv", "levels.png", *pictures], scene, *files_of(read))

    def keep(name: str, world: "World", picture: "Picture", own: int) -> None:
        save(world, picture, own, out / f"{name}.exr")

    with working(quiet) as work:
        found = compare.compare(
            read, chosen, spp, seconds, reference_seconds, packings, read.render.seed if seed is None else seed,
            threads, work.told, keep, work.stop,
        )  # fmt: skip
        for name, text in (("levels.md", compare.markdown(found)), ("levels.csv", compare.csv_text(found))):
            write_text(out / name, text)
        if found.pictures > 1:
            plots.save(plots.plot_levels(compare.facts(found), found.reference, found.scene.name), out / "levels.png")
    if not quiet:
        say(compare.markdown(found).removesuffix("\n"))
    if found.interrupted:
        click.echo(f"interrupted: {plain(out)} holds {len(found.rows)} of the levels", err=True)
    lost = sum(row.picture.truncated + row.picture.faults for row in found.rows)
    if lost:
        click.echo(f"warning: {lost} paths were given up", err=True)
    return interrupt_status() if found.interrupted else 0
