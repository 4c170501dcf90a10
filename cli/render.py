"""``tsdf-render``: a scene in, a picture out."""

import json
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsdf import levels
from tsdf.cli.common import Tool, plain

if TYPE_CHECKING:
    from tsdf.render import Picture
    from tsdf.world import World

LEVELS = tuple(levels.LEVELS)


@click.command("tsdf-render", cls=Tool)
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "--out", required=True, type=click.Path(path_type=Path),
    help="Picture to write, NAME.exr (linear RGB and the variance of each pixel); NAME.png is written beside it.",
)  # fmt: skip
@click.option("--level", type=click.Choice(LEVELS), help="How grains are modelled.  [default: the scene's]")
@click.option("--spp", type=int, metavar="N", help="Samples per pixel.  [default: the scene's]")
@click.option("--seconds", type=float, metavar="S", help="Stop after S seconds instead.")
@click.option(
    "--target-error", type=float, metavar="E",
    help="Stop when the standard error of pixels, over the mean of the picture, is below E instead.",
)  # fmt: skip
@click.option("--seed", type=int, metavar="N", help="Of the random numbers, >= 0.  [default: the scene's]")
@click.option("--width", type=int, metavar="PIXELS", help="Width of the picture; its shape is kept.")
@click.option("--threads", type=int, metavar="N", help="[default: all processors]")
@click.option("--quiet", is_flag=True, help="No progress bar, no summary.")
def main(
    scene: Path, out: Path, level: str | None, spp: int | None, seconds: float | None, target_error: float | None,
    seed: int | None, width: int | None, threads: int | None, quiet: bool,
) -> int:  # fmt: skip
    """Render the picture of SCENE, a TOML file.

    The same scene, level, seed and number of samples give the same picture for any number of threads. Ctrl-C writes the
    picture so far. Exit status 130 then, 1 if the scene cannot be rendered, 2 if the request cannot be meant.
    """
    from tsdf.errors import UsageError

    if out.suffix.lower() != ".exr":
        raise UsageError(f"--out {plain(out)}: is to end in .exr")
    if not out.absolute().parent.is_dir():
        raise UsageError(f"--out {plain(out)}: its folder does not exist; make it first")
    for name, value in (("--spp", spp), ("--width", width), ("--threads", threads)):
        if value is not None and value < 1:
            raise UsageError(f"{name} is a whole number of at least 1, not {value}")
    for name, limit in (("--seconds", seconds), ("--target-error", target_error)):
        if limit is not None and not 0.0 < limit < float("inf"):
            raise UsageError(f"{name} is a finite number above 0, not {limit:g}")
    if seed is not None and not 0 <= seed < 2**63:
        raise UsageError(f"--seed is a whole number from 0 to 2^63 - 1, not {seed}")
    if sum(stop is not None for stop in (spp, seconds, target_error)) > 1:
        raise UsageError("--spp, --seconds and --target-error each say when to stop: give one")

    from tqdm import tqdm

    from tsdf import render, world
    from tsdf.scene import load, resized

    read = resized(load(scene), width)
    made = world.build(read, level or read.render.level)
    if not quiet:
        for note in made.notes:
            click.echo(f"note: {plain(note)}", err=True)
    if spp is None and seconds is None and target_error is None:
        spp = read.render.spp
    seed = read.render.seed if seed is None else seed

    # A flag, for signals come twice (timeout sends them to the process and to its group) and the second is no other
    stop = threading.Event()
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in signals]
    form = "{percentage:3.0f}% |{bar}| {postfix} [{elapsed}<{remaining}]"
    try:
        with tqdm(total=1.0, disable=quiet or None, bar_format=form, dynamic_ncols=True) as bar:

            def progress(share: float, word: str) -> None:
                bar.set_postfix_str(word, refresh=False)
                bar.update(share - bar.n)

            picture = render.render(made, spp, seconds, target_error, seed, threads, progress, stop)
        if not picture.samples.any():
            click.echo("interrupted before the first sample: nothing is written", err=True)
            return 130
        save(made, picture, seed, out)
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
    if not quiet or picture.interrupted:
        summary(made, picture, out)
    return 130 if picture.interrupted else 0


def save(world: "World", picture: "Picture", seed: int, out: Path) -> None:
    """Write the EXR, with what it was made by as the attribute ``tsdf_render``, and the PNG beside it."""
    from tsdf import estimate, image

    facts = {
        "scene": world.scene.name,
        "level": world.level,
        "samples": [int(picture.samples.min()), int(picture.samples.max())],
        "seed": seed,
        "events": picture.events,
        "truncated": picture.truncated,
        "faults": picture.faults,
        "software": estimate.software(),
    }
    image.write_exr(out, picture.rgb, picture.variance, {"tsdf_render": json.dumps(facts)})
    image.write_png(out.with_suffix(".png"), picture.rgb, world.scene.camera.exposure)


def summary(world: "World", picture: "Picture", out: Path) -> None:
    """Say on standard output what the picture holds."""
    low, high = int(picture.samples.min()), int(picture.samples.max())
    held = f"{low}" if low == high else f"{low} to {high}"
    state = "interrupted: holds" if picture.interrupted else "holds"
    click.echo(
        f"{plain(out)}: {state} {held} samples per pixel, level {world.level}, relative error "
        f"{picture.relative_error:.2g}, {picture.seconds:.1f} s, {picture.events / max(picture.seconds, 1e-9):.3g} "
        "grain events per second"
    )
    lost = picture.truncated + picture.faults
    if lost:
        click.echo(f"warning: {lost} paths were given up ({picture.faults} of them at a fault of a mesh)", err=True)
