"""``tsdf-frontier``: scenes in, the error and the processor time of every way to render them out."""

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
    whole_number,
    working,
    write_text,
)
from tsdf.cli.start import interrupt_status
from tsdf.errors import UsageError

if TYPE_CHECKING:
    from tsdf.study.frontier import Frontier

SAVED = ".json"  # results that are drawn again
TEXTS = (SAVED, ".csv", ".md")
CHARTS = (".pdf", ".svg", ".png")
ALL = "frontier"  # the chart of several scenes
MOST_GRAINS = 1_000_000


@click.command("tsdf-frontier", cls=Tool)
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SCENE...")
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), metavar="DIR",
    help="Folder to write to, for each scene NAME.json, .csv, .md, .pdf, .svg and .png; of several also frontier.pdf, "
    ".svg and .png.",
)  # fmt: skip
@click.option("--levels", metavar="A,B,..", help="Levels to measure.  [default: all]")
@click.option(
    "--grains", metavar="K,K,..", help="Explicit grains before chains of grains, each a candidate.  [default: 0,3,8]"
)
@click.option(
    "--leaps", metavar="G,G,..",
    help="Least radius of leaps [transport mean free paths], each a candidate of the levels that leap; 0 for none.  "
    "[default: as the scene says]",
)  # fmt: skip
@click.option("--seconds", type=float, metavar="S", help="Time of each scene, by the clock.  [default: 240]")
@click.option("--runs", callback=whole_number, metavar="N", help="Independent runs, a packing each.  [default: 10]")
@click.option("--width", type=int, metavar="PIXELS", help="Width of the pictures; their shape is kept.")
@seed_option("the scene's")
@threads_option
@click.option("--quiet", is_flag=True, help="No progress bar, no report.")
def main(
    scenes: tuple[Path, ...], out: Path, levels: str | None, grains: str | None, leaps: str | None,
    seconds: float | None, runs: int | None, width: int | None, seed: int | None, threads: int | None, quiet: bool,
) -> int:  # fmt: skip
    """Measure every way to render each SCENE, a TOML file, against single grains: error against processor time.

    The truth is the explicit level, or the best one that is possible. All is measured in independent runs, whose spread
    is the error of what is stated; candidates are ranked with 95 % confidence, or said to be equal within the error.
    What is impossible is left out with a word. A SCENE that is a .json file of saved results is drawn again, to the
    same bytes. Ctrl-C keeps what is done. Exit status 130 then, 1 if a scene cannot be rendered, 2 if the request
    cannot be meant.
    """
    chosen = named_levels(levels, LEVELS)
    explicit, radii = _grains(grains), _leaps(leaps)
    check_numbers(seed, runs=runs, width=width, threads=threads)
    asked = {
        "levels": levels, "grains": grains, "leaps": leaps, "seconds": seconds, "runs": runs, "width": width,
        "seed": seed, "threads": threads,
    }  # fmt: skip
    vain = [f"--{name}" for name, value in asked.items() if value is not None]
    if vain and all(scene.suffix == SAVED for scene in scenes):
        raise UsageError(f"{', '.join(vain)}: saved results are only drawn again; leave it out, or give a scene")
    names = [scene.stem for scene in scenes]
    if twice := {name for name in names if names.count(name) > 1 or (name == ALL and len(names) > 1)}:
        raise UsageError(f"two results would be called {plain(min(twice))}; give scenes files of different names")

    from tsdf.picture import ahead
    from tsdf.scene.scene import load, resized
    from tsdf.scene.specs import files_of
    from tsdf.study import frontier, frontier_files
    from tsdf.study.candidates import candidates
    from tsdf.study.frontier import leaping

    saved = {scene: frontier_files.read(scene) for scene in scenes if scene.suffix == SAVED}
    read = {scene: resized(load(scene), width) for scene in scenes if scene not in saved}
    written = [f"{name}{suffix}" for name in names for suffix in (*TEXTS, *CHARTS)]
    drawn_again = [scene for scene in saved if _own(scene, out)]  # the same bytes once more
    inputs = [scene for scene in scenes if scene not in drawn_again]
    check_folder(
        out, [*written, *(f"{ALL}{suffix}" for suffix in CHARTS if len(names) > 1)], *inputs,
        *(file for scene in read.values() for file in files_of(scene)),
    )  # fmt: skip
    found: dict[Path, Frontier] = {}
    if read:
        ahead.begin()
    with working(quiet) as work:
        for number, scene in enumerate(scenes):

            def told(share: float, word: str, number: int = number, scene: Path = scene) -> None:
                word = word if len(scenes) == 1 else f"{plain(scene.stem)}: {word}"
                work.begun = work.begun or share > 0.0 or bool(found)
                work.progress((number + share) / len(scenes), word)

            one = saved.get(scene)
            if one is None:
                own = read[scene]
                one = frontier.measure(
                    own, leaping(candidates(chosen, explicit), radii), frontier.SECONDS if seconds is None else seconds,
                    frontier.RUNS if runs is None else runs, own.render.seed if seed is None else seed, threads, told,
                    work.stop,
                )  # fmt: skip
            if one is not None:
                found[scene] = one
                keep(one, out, scene.stem)
            if work.stop.is_set():
                break
        if len(scenes) > 1 and found:
            draw_all(list(found.values()), out)
    if not quiet:
        files = (plain(out / f"{scene.stem}.md") for scene in found)
        shown = map(frontier_files.terminal, found.values(), files)
        say("\n".join(shown).removesuffix("\n"))
    for one in found.values():
        if lost := sum(row.lost for row in one.rows):
            click.echo(f"warning: {plain(one.scene)}: {lost} paths were given up", err=True)
    if work.stop.is_set():
        whole = sum(one.runs == one.asked for one in found.values())
        click.echo(
            f"interrupted: {plain(out)} holds {len(found)} of {len(scenes)} scenes, {whole} of them whole", err=True
        )
        return interrupt_status()
    return 0


def keep(one: "Frontier", out: Path, name: str) -> None:
    """Write the results of a scene and its charts."""
    from tsdf.study import frontier_files, frontier_plots, plots

    makers = (frontier_files.json_text, frontier_files.csv_text, frontier_files.markdown)
    for suffix, made in zip(TEXTS, makers, strict=True):
        write_text(out / f"{name}{suffix}", made(one))
    for suffix in CHARTS:
        plots.save(frontier_plots.plot_frontier(one), out / f"{name}{suffix}")


def draw_all(found: "list[Frontier]", out: Path) -> None:
    """Write the chart of several scenes."""
    from tsdf.study import frontier_plots, plots

    for suffix in CHARTS:
        plots.save(frontier_plots.plot_frontiers(found), out / f"{ALL}{suffix}")


def _own(scene: Path, out: Path) -> bool:
    """Return whether saved results are those that would be written again."""
    try:
        return scene.samefile(out / scene.name)
    except OSError:
        return False


def _grains(text: str | None) -> list[int]:
    """Return the numbers K,K,.. of --grains.

    Raises
    ------
    UsageError
    """
    from tsdf.study.candidates import GRAINS

    if text is None:
        return list(GRAINS)
    found = []
    for word in text.split(","):
        if not (word.strip().isdecimal() and int(word) <= MOST_GRAINS):
            raise UsageError(f"--grains are whole numbers from 0 to {MOST_GRAINS}, as 0,3,8, not {plain(text)}")
        found.append(int(word))
    return sorted(set(found))


def _leaps(text: str | None) -> list[float | None]:
    """Return the radii G,G,.. of --leaps; what the scene says where nothing is said.

    Raises
    ------
    UsageError
    """
    if text is None:
        return [None]
    from tsdf.picture.leaping import checked

    found: list[float | None] = []
    for word in text.split(","):
        try:
            radius = float(word)
        except ValueError:
            raise UsageError(f"--leaps are numbers, as 0,2,4, not {plain(text)}") from None
        checked(radius, "--leaps")
        found.append(radius)
    return found
