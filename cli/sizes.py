"""Options of every command that asks how large grains are and how much of space they fill: in words of `scene.sizes`.

docs/sizes.md defines them. Colours of deep media, which stand where absorption is asked for, are here, too.
"""

import contextlib
import math
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import click

from tsdf.cli.absorption import METRES
from tsdf.cli.common import plain
from tsdf.errors import UsageError

if TYPE_CHECKING:
    from tsdf.data.table import Table
    from tsdf.scene.sizes import InWords

OPTIONS = {  # word: option, unit, meaning
    "packing_fraction": ("--packing", "F", "Share of space in bounding spheres [1], at most 0.74."),
    "solid_fraction": ("--solid-fraction", "F", "Instead: share of space in the grains' material [1]."),
    "density": ("--density", "KG/M3", "Instead: mass over volume of the packed grains."),
    "radius": ("--radius", "L", "Bounding radius of the grains, 0.5mm say; lengths are in its unit."),
    "effective_radius": (
        "--effective-radius",
        "L",
        "Instead: 3 V / (4 projected area), 3 V / surface if convex.",
    ),
    "volume_radius": ("--volume-radius", "L", "Instead: radius of the sphere of the same volume."),
    "maximum_dimension": ("--maximum-dimension", "L", "Instead: greatest distance between two points of a grain."),
    "sieve": ("--sieve", "L", "Instead: width of the square mesh that the grain just passes."),
    "ssa": ("--ssa", "M2/KG", "Instead: specific surface area; needs --unit."),
    "material_density": ("--material-density", "KG/M3", "Of the solid.  [default: of the table's material]"),
}


def length(context: click.Context, parameter: click.Parameter, value: str | None) -> float | None:
    """Read a length in the unit of --unit, or with one of its own, 0.5mm say, which --unit then is unless it is given.

    So --unit must be eager.
    """
    if value is None:
        return None
    number, metres = measured(context, parameter, value)
    if metres is None:
        return number
    if context.params.get("unit") is None:
        context.params["unit"] = metres
    unit = context.params["unit"]
    return number * (metres / unit) if unit > 0.0 else number  # else it is refused


def measured(context: click.Context, parameter: click.Parameter, value: str) -> tuple[float, float | None]:
    """Return the number of a length, and its unit [m], None where it names none."""
    found = re.fullmatch(r"\s*([-+.0-9eE]+|[-+]?(?:nan|inf))\s*([a-z]*)\s*", value)
    if found is not None and found[2] in ("", *METRES):
        with contextlib.suppress(ValueError):
            return float(found[1]), METRES.get(found[2])
    raise click.BadParameter(f"{value!r} is not a length, 0.2mm say ({', '.join(METRES)})", context, parameter)


def sized(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of sizes and amounts, each under the name of its word."""
    for word, (option, unit, meaning) in reversed(OPTIONS.items()):
        kind: dict[str, Any] = {"callback": length} if unit == "L" else {"type": float}
        command = click.option(option, word, metavar=unit, help=meaning, **kind)(command)
    return command


def coloured(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of a colour: `deep_colour` and `colour_thickness`."""
    command = click.option(
        "--colour-thickness", callback=length, metavar="L",
        help="Of the slab with nothing behind it that has the colour, in units of --radius.  [default: deep]",
    )(command)  # fmt: skip
    return click.option(
        "--deep-colour", "--albedo", "deep_colour", metavar="R,G,B",
        help="Absorb so that a deep medium of the grains has this colour in diffuse light: one linear number, or "
        "red,green,blue, each above 0 and below 1.",
    )(command)  # fmt: skip


def said(options: Mapping[str, float | None]) -> dict[str, float]:
    """Return the words of sizes and amounts that were said, and their values.

    Raises
    ------
    UsageError
        For what is not a finite number > 0, by the name of its option.
    """
    words = {word: value for word in OPTIONS if (value := options.get(word)) is not None}
    for word, value in words.items():
        if not 0.0 < value < math.inf:
            what = "packing fraction > 0 and at most 0.74" if word == "packing_fraction" else "finite number > 0"
            raise UsageError(f"{OPTIONS[word][0]} is a {what}, not {value:g}")
    return words


def in_words(table: "Table", words: Mapping[str, float], unit: float | None, amount_needed: bool = True) -> "InWords":
    """Return grains of a table in everybody's words, by those that were said; the way out is told by option."""
    from tsdf.scene.sizes import AMOUNTS, convert

    if not 1e-30 <= words.get("radius", 1.0) <= 1e30:
        raise UsageError(f"--radius is a number of scene units from 1e-30 to 1e30, not {words['radius']:g}")
    if amount_needed and not any(word in words for word in AMOUNTS):
        raise UsageError("say how much of space is filled: give one of --packing, --solid-fraction, --density")
    try:
        return convert([(table, 1.0)], words, unit, amount_needed)
    except UsageError as error:
        options = ", ".join(OPTIONS[word][0] for word in words)
        raise UsageError(f"{options}: {by_option(error)}") from None


def by_option(error: UsageError) -> str:
    """Return what `scene.sizes` said, with the way out by option."""
    text = re.sub(r"(say|another) material_density", r"\1 --material-density", str(error))
    return text.replace("packing_fraction = ", "--packing ")


def colour_of(text: str | None) -> tuple[float, ...]:
    """Return the colour that an option states, one number or three; none for no option.

    Raises
    ------
    UsageError
        In one line, for what is no colour that something can have that absorbs.
    """
    if text is None:
        return ()
    from tsdf.scene.deep import check_colour

    try:
        numbers = tuple(float(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 3):
        raise UsageError(f"--deep-colour is one number or three, R,G,B, not {plain(text)!r}")
    try:
        check_colour(numbers)
    except UsageError as error:
        raise UsageError(f"--deep-colour {plain(text)}: {error}") from None
    return numbers
