"""``tsdf-render``: a scene in, a picture out."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tsdf.cli.common import (
    AUTO,
    LEVELS,
    Tool,
    check_numbers,
    check_output,
    plain,
    say,
    seed_option,
    threads_option,
    working,
)
from tsdf.cli.start import interrupt_status

if TYPE_CHECKING:
    from tsdf.picture.render import Picture
    from tsdf.picture.world import World

SPOTTED, OF_DOTS = 0.1, 0.6  # [1] relative error from which on, and share of it of a hundredth of the lit pixels from
# which on, noise is said to be bright dots
LEAST_DOTS = 4  # such pixels


def first_grains(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[int, bool] | None:  # fmt: skip
    """Read a number of grains, and whether it falls to 0 where a pixel covers more."""
    if value is None:
        return None
    number, falls = (value[:-2], True) if value.endswith("-0") else (value, False)
    if not number.isdecimal():
        raise click.BadParameter(
            f"it is a whole number, 0 for none, or one that falls, as 8-0, not {value!r}", context, parameter
        )
    return int(number), falls


@click.command("tsdf-render", cls=Tool)
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "--out", required=True, type=click.Path(path_type=Path),
    help="Picture to write, NAME.exr (linear RGB and the variance of each pixel); NAME.png is written beside it.",
)  # fmt: skip
@click.option(
    "--level", type=click.Choice((*LEVELS, AUTO)),
    help="How grains are modelled; auto takes the cheapest whose error is 2 % (tsdf-plan).  "
    "[default: the scene's, else auto]",
)  # fmt: skip
@click.option(
    "--explicit-grains", callback=first_grains, metavar="K|K-0",
    help="Follow the first K grains from the camera one by one, then as the level does; K-0: so many where grains look "
    "largest, and fewer where a pixel covers more.  [default: the scene's]",
)  # fmt: skip
@click.option(
    "--spp", type=int, metavar="N",
    help="Samples per pixel.  [default: the scene's, else 64, or with auto what the 2 % take]",
)  # fmt: skip
@click.option(
    "--seconds", type=float, metavar="S", help="Stop after S seconds instead, planning of level auto included."
)
@click.option(
    "--target-error", type=float, metavar="E",
    help="Stop when the standard error of pixels, over the mean of the picture, is below E instead.",
)  # fmt: skip
@seed_option("the scene's")
@click.option("--width", type=int, metavar="PIXELS", help="Width of the picture; its shape is kept.")
@click.option(
    "--leap", type=float, metavar="G",
    help="Take many events in one step where nothing is nearer than G transport mean free paths; 0 never does.  "
    "[default: the scene's, else 2]",
)  # fmt: skip
@threads_option
@click.option("--quiet", is_flag=True, help="No progress bar, no notes, no summary; warnings stay.")
def main(
    scene: Path, out: Path, level: str | None, explicit_grains: tuple[int, bool] | None, spp: int | None,
    seconds: float | None, target_error: float | None, seed: int | None, width: int | None, leap: float | None,
    threads: int | None, quiet: bool,
) -> int:  # fmt: skip
    """Render the picture of SCENE, a TOML file.

    The same scene, level, seed and number of samples give the same picture for any number of threads. Ctrl-C writes the
    picture so far; once more, after two seconds, ends at once. Exit status 130 then, 1 if the scene cannot be rendered,
    2 if the request cannot be meant.
    """
    from tsdf.errors import UsageError

    if out.suffix.lower() != ".exr":
        raise UsageError(f"--out {plain(out)}: is to end in .exr")
    check_numbers(seed, spp=spp, width=width, threads=threads)
    for name, limit in (("--seconds", seconds), ("--target-error", target_error)):
        if limit is not None and not 0.0 < limit < float("inf"):
            raise UsageError(f"{name} is a finite number above 0, not {limit:g}")
    if sum(stop is not None for stop in (spp, seconds, target_error)) > 1:
        raise UsageError("--spp, --seconds and --target-error each say when to stop: give one")

    from tsdf.picture import ahead, leaping, render
    from tsdf.plan import report, shot
    from tsdf.scene.scene import MAX_EXPLICIT, load, resized
    from tsdf.scene.specs import files_of

    if leap is not None:
        leaping.checked(leap, "--leap")
    read = resized(load(scene), width)
    if explicit_grains is not None:
        most = min(explicit_grains[0], MAX_EXPLICIT)  # no path meets so many
        read = replace(read, render=replace(read.render, explicit_grains=most, fewer_far=explicit_grains[1]))
    if leap is not None and (level or read.render.level) == AUTO:  # of whichever level can
        read, leap = replace(read, render=replace(read.render, leap=leap)), None
    check_output(out, scene, *files_of(read), beside=[out.with_suffix(".png")])
    seed = read.render.seed if seed is None else seed

    ahead.begin(read, level or read.render.level)
    with working(quiet) as work:

        def told(share: float, word: str) -> None:
            work.begun = True  # samples that a picture can be made of
            work.told(share, word)

        work.progress(0.0, "reading the scene")
        choice = shot.chosen(read, level, spp, seconds, target_error, seed, threads, work.progress)
        made = choice.world(leap, work.progress)
        for note in (*(report.notes(choice.plan) if choice.plan else ()), *made.notes):
            work.progress.note(note, "warning" if note in made.warnings else "note")
        work.progress(0.0, "starting")
        picture = render.render(made, choice.spp, choice.left, choice.target_error, seed, threads, told, work.stop)
        if not picture.samples.any():
            click.echo("interrupted before the first sample: nothing is written", err=True)
            return interrupt_status()
        save(made, picture, seed, out, report.chosen_facts(choice.plan) if choice.plan else None)
    warn(picture)
    if not quiet or picture.interrupted:
        summary(made, picture, out)
        if choice.plan is not None and choice.plan.chosen.floor.value > picture.relative_error:
            say(f"{plain(out)}: that is noise; beside it the level misses about "
                f"{report.percent(choice.plan.chosen.floor.value)}")  # fmt: skip
    return interrupt_status() if picture.interrupted else 0


def save(world: "World", picture: "Picture", seed: int, out: Path, chosen: dict[str, Any] | None = None) -> None:
    """Write the EXR, with what it was made by as the attribute ``tsdf_render``, and the PNG beside it."""
    from tsdf import files
    from tsdf.picture import image

    facts = {
        "scene": world.scene.name,
        "level": world.level,
        "samples": [int(picture.samples.min()), int(picture.samples.max())],
        "seed": seed,
        "events": picture.events,
        "leap": world.leap,
        "leapt": picture.leapt,
        "leaps": picture.leaps,
        "truncated": picture.truncated,
        "faults": picture.faults,
        "software": files.software(),
    }
    if singles := world.scene.render.explicit_grains:
        facts["explicit_grains"] = singles
        facts["fewer_far"] = world.scene.render.fewer_far
    if chosen is not None:
        facts["chosen"] = chosen
    if picture.trust is not None:
        facts |= {
            "trusted": picture.trust.doubt is None,
            "vov": picture.trust.vov if math.isfinite(picture.trust.vov) else None,
            "slope": picture.trust.slope if math.isfinite(picture.trust.slope) else None,
            "met_by_chance": 1.0 / picture.trust.chance if picture.trust.chance > 0.0 else None,
            "unsure_pixels": picture.trust.unsure,
        }
    image.write_exr(out, picture.rgb, picture.variance, {"tsdf_render": json.dumps(facts)})
    image.write_png(out.with_suffix(".png"), picture.rgb, world.scene.camera.exposure)


def summary(world: "World", picture: "Picture", out: Path) -> None:
    """Say on standard output what the picture holds."""
    low, high = int(picture.samples.min()), int(picture.samples.max())
    held = f"{low}" if low == high else f"{low} to {high}"
    singles = world.scene.render.explicit_grains
    after = f" after {singles} explicit grains" if singles else ""
    state = "interrupted: holds" if picture.interrupted else "holds"
    error = f"{picture.relative_error:.2g}" if math.isfinite(picture.relative_error) else "unknown"
    say(
        f"{plain(out)}: {state} {held} samples per pixel, level {world.level}{after}, relative error {error}, "
        f"{picture.seconds:.1f} s, {picture.events / max(picture.seconds, 1e-9):.3g} grain events per second"
    )
    if (dots := fireflies(picture)) is not None:
        say(f"{plain(out)}: {dots}{fewer_dots(world)}")
    for line in media(world):
        say(line)


def warn(picture: "Picture") -> None:
    """Say on standard error what is wrong with a picture, however quiet the command is to be."""
    if picture.trust is not None and picture.trust.doubt is not None:
        click.echo(f"warning: {picture.trust.doubt}", err=True)
    lost = picture.truncated + picture.faults
    if lost:
        faults = f"{picture.faults} of them at a fault of a mesh"
        why = faults if picture.faults else "after more grains than any other"
        click.echo(f"warning: {lost} paths were given up, {why}", err=True)


def fireflies(picture: "Picture") -> str | None:
    """Return what is to be said of a picture whose noise is that of a few bright dots; None of others, and of those of
    which too few pixels are lit to tell."""
    import numpy as np

    lit = picture.rgb.mean(axis=2) > 0.0
    each = np.sort(picture.variance.mean(axis=2)[lit])
    few = each.size // 100
    if few < LEAST_DOTS or not SPOTTED < picture.relative_error < math.inf:
        return None
    share, mean = float(each[-few:].sum() / each.sum()), float(picture.rgb[lit].mean())
    if share < OF_DOTS:
        return None
    middle = math.sqrt(float(each[each.size // 2])) / mean
    half = f"are off by less than {middle:.2g} of their mean" if middle > 0.0 else "have none that can be told yet"
    return f"its noise is bright dots: 1 % of the lit pixels make {100.0 * share:.0f} % of it, half of them {half}"


def fewer_dots(world: "World") -> str:
    """Return what a scene can do about bright dots."""
    from tsdf.scene.levels import LEVELS
    from tsdf.scene.specs import SunLight

    suns = any(isinstance(light, SunLight) for light in world.scene.lights)
    aims = LEVELS[world.level].traits.points
    ways = ["a wider sun"] * suns + ["a level that aims all light, volume-hg or isotropic,"] * (not aims)
    return f"; {' or '.join(ways)} has fewer" if ways else ""


def media(world: "World") -> Iterator[str]:
    """What the media of a scene hold, in our words and in others', one line each, and the colours asked for."""
    from tsdf.cli.absorption import conventions
    from tsdf.scene.scene import called

    for number, (medium, packed) in enumerate(zip(world.scene.media, world.sizes, strict=True), 1):
        title = called("medium", number, medium.name)
        yield f"{title}: {packed.summary()}"
        for grain in medium.grains:
            if colour := grain.absorption.colour:
                by_radius = [a * medium.radius for a in grain.absorption.coefficient]
                same = conventions(by_radius, medium.radius, world.scene.metres_per_unit)
                deep = "deep" if math.isinf(grain.absorption.thickness) else f"{grain.absorption.thickness:g} thick"
                yield f"{title}: colour {', '.join(f'{c:g}' for c in colour)} where {deep}: absorption {same}"
