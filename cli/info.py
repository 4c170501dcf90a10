"""``tsdf-info``: what a table says of itself."""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import click

from tsdf.cli.absorption import METRES
from tsdf.cli.common import LEVELS, Tool, plain
from tsdf.cli.sizes import colour_of, coloured, in_words, said, sized

if TYPE_CHECKING:
    from tsdf.data.table import Measured, Table
    from tsdf.scene.sizes import InWords

LENGTHS = ("lambda_b", "lambda_beta", "lambda_s")  # of the medium
COEFFICIENTS = ("sigma_t", "sigma_s", "sigma_a")
OTHERS = {  # what others call it: unit with a radius said, unit without, a word about it
    "absorption_enhancement": ("", "", "B"),
    "single_scattering_albedo": ("", "", ""),
    "asymmetry_factor": ("", "", "geometrical optics"),
    "asymmetry_factor_far_field": ("", "", "with diffraction"),
    "effective_radius": ("units", "R", "3 V / (4 projected area)"),
    "projected_area": ("units^2", "R^2", ""),
    "dark_share": ("", "", "of directions inside that no light reaches"),
}
SIZE_UNITS = {"ssa": "m2/kg", "density": "kg/m3", "material_density": "kg/m3"}  # of what is not a length
SIZE_UNITS |= {"packing_fraction": "", "solid_fraction": ""}
UNITS = {"mean_z": "R", "mean_r": "R", "mean_miss_chord": "R", "mean_path_length": "R"}


@click.command("tsdf-info", cls=Tool)
@click.argument("file")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON object.")
@click.option(
    "--absorption",
    metavar="X/R",
    help="Absorption coefficient of the grain's material: X/R is X over the bounding radius, X/unit per unit of "
    "--radius, X/mm (um, cm, m) per length, with --radius and --unit. Albedo and mean cosine are then those of the "
    "absorbing grain.  [default: 0]",
)
@sized
@coloured
@click.option(
    "--unit",
    type=float,
    is_eager=True,
    metavar="METRES",
    help="Length of the unit of --radius; X/mm (um, cm, m) and --ssa need it.  [default: of a length like 0.5mm]",
)  # fmt: skip
@click.option(
    "--render-colour",
    "level",
    type=click.Choice(LEVELS),
    help="Render the medium of that colour at a level, too (a minute), and say which absorption has it there.",
)
def main(
    file: str, as_json: bool, absorption: str | None, unit: float | None, deep_colour: str | None,
    colour_thickness: float | None, level: str | None, **options: float | None,
) -> None:  # fmt: skip
    """Show what the table FILE holds: grain, optics, statistics with standard errors, errors, energy, origin.

    With sizes and amounts, in any of the words of docs/sizes.md, what grains of that size and media of that amount are;
    with a colour, the absorption that gives it.
    """
    from tsdf.cli.absorption import times_radius
    from tsdf.data import format as tsdf_format
    from tsdf.errors import UsageError
    from tsdf.scene.sizes import SIZES

    words, colour = said(options), colour_of(deep_colour)
    if absorption is not None and colour:
        raise UsageError("--absorption and --deep-colour both say how grains absorb: give one")
    for name, value in (("--unit", unit), ("--colour-thickness", colour_thickness)):
        if value is not None and not 0.0 < value < math.inf:
            raise UsageError(f"{name} is a finite number > 0, not {value:g}")
    for name, given in (("--colour-thickness", colour_thickness), ("--render-colour", level)):
        if given is not None and not colour:
            raise UsageError(f"{name} is of a colour: give --deep-colour too")
    if absorption is not None and not any(word in words for word in SIZES):
        times_radius(absorption, None, unit)  # before anything is read
    table = tsdf_format.read(file)
    grains = in_words(table, words, unit, amount_needed=False)
    radius = grains.radius if any(word in words for word in SIZES) else None
    (product,) = times_radius(absorption, radius, unit)
    facts = describe(table, product, radius)
    facts |= describe_sizes(grains, radius)
    facts["metres_per_unit"] = unit
    if colour:
        facts["colour"] = describe_colour(table, grains, radius, colour, colour_thickness, level)
    if grains.packing_fraction is not None:
        facts["medium"] = describe_medium(table, grains.packing_fraction, radius, product)
    if as_json:
        click.echo(json.dumps(facts, indent=1))
    else:
        for line in _lines(facts):
            click.echo(plain(line))


def describe(table: "Table", absorption_times_radius: float = 0.0, radius: float | None = None) -> dict[str, Any]:
    """Return what `table` says, as ``tsdf-info --json`` writes it; None where a number is unknown.

    With absorption (sigma_a R), `albedo`, `mean_cosine` and the asymmetry factors are those of the absorbing grain. The
    standard errors of the first two are then unknown. With a radius, lengths of `OTHERS` are in its unit, else in R.
    """
    from tsdf.data.blocks import CONDITIONALS
    from tsdf.data.table import thawed

    header = thawed(table.header)
    grain, optics, made = header["grain"], header["optics"], header["provenance"]
    statistics, errors = header["statistics"], header["standard_errors"]
    if absorption_times_radius > 0.0:
        mean_cosine = table.mean_cosine(absorption_times_radius)
        statistics["albedo"] = table.albedo(absorption_times_radius)
        statistics["mean_cosine"] = None if math.isnan(mean_cosine) else mean_cosine
        errors["albedo"] = errors["mean_cosine"] = None
    scale = 1.0 if radius is None else radius
    others = {
        "absorption_enhancement": table.absorption_enhancement,
        "single_scattering_albedo": table.single_scattering_albedo(absorption_times_radius),
        "asymmetry_factor": table.asymmetry_factor(absorption_times_radius),
        "asymmetry_factor_far_field": table.asymmetry_factor_far_field(absorption_times_radius),
        "effective_radius": _times(table.effective_radius, scale),
        "projected_area": _times(table.projected_area, scale**2),
        "dark_share": table.dark_share,
    }
    errors |= {name: found.error for name, found in others.items()}
    return {
        "format_version": header["format_version"],
        "grain": grain["name"],
        **{key: grain[key] for key in ("kind", "parameters", "bounding_radius", "area", "volume", "convex")},
        **{key: grain[key] for key in ("bodies", "faces", "mesh_sha256", "notes")},
        **{key: optics[key] for key in ("eta", "fresnel", "material", "wavelength_nm", "k", "source")},
        **{key: made[key] for key in ("method", "paths", "seed", "max_bounces", "software", "command")},
        "absorption_times_radius": absorption_times_radius,
        "absorption": None if radius is None else absorption_times_radius / radius,
        **statistics,
        **{name: None if math.isnan(found.value) else found.value for name, found in others.items()},
        "standard_errors": errors,
        "table_error": header["table_error"],
        "factorisation_error": header["factorisation_error"],
        "fits": header["fits"],
        "energy_ledger": header["energy_ledger"],
        "cells": {"cos_theta": len(table.p_theta) - 2} | {n: len(table.block(n)) for n in CONDITIONALS},
        "joint_records": len(table.joint["r"]) if table.joint else 0,
        "memory_records": len(table.memory["r"]) if table.memory else 0,
        "pixels_sha256": header["pixels_sha256"],
        "licence": header["licence"],
    }


def describe_sizes(grains: "InWords", radius: float | None) -> dict[str, Any]:
    """Return sizes and amount of grains in the words of docs/sizes.md, as ``tsdf-info --json`` writes them.

    Lengths are in the unit of `radius`, or in R where it is None; None where a number is unknown.
    """
    facts = grains.facts()
    ssa = None if radius is None else facts["ssa"]
    sizes = facts | {"radius": radius, "ssa": ssa}
    return {
        "specific_surface_area": ssa,
        "solid_fraction": facts["solid_fraction"],
        "density": facts["density"],
        "sizes": sizes,
    }


def describe_colour(
    table: "Table",
    grains: "InWords",
    radius: float | None,
    colour: tuple[float, ...],
    thickness: float | None = None,
    level: str | None = None,
) -> dict[str, Any]:
    """Return the absorption that gives grains in bulk a colour, as ``tsdf-info --json`` writes it.

    With a level, what the renderer makes of it there, and the absorption that is right there: that of a colour as far
    off on the other side.
    """
    from tsdf.errors import UsageError
    from tsdf.scene.deep import absorption_of_colour

    packing = grains.packing_fraction
    if packing is None and (thickness is not None or level is not None):
        raise UsageError("a slab of some thickness, or a picture, is of packed grains: give --packing, say, too")
    thick = math.inf if thickness is None else thickness / (radius or 1.0)

    def absorbing(wanted: tuple[float, ...]) -> tuple[float, ...]:
        return absorption_of_colour(table, wanted, thick, packing or 0.5)

    def in_conventions(products: tuple[float, ...]) -> dict[str, Any]:
        unit = grains.metres_per_unit
        per_unit = None if radius is None else [x / radius for x in products]
        per_metre = None if per_unit is None or unit is None else [a / unit for a in per_unit]
        return {"absorption_times_radius": list(products), "absorption": per_unit, "absorption_per_metre": per_metre}

    found = absorbing(colour)
    facts = {"asked": list(colour), "thickness": thickness, **in_conventions(found)}
    if level is not None:
        from tsdf.picture.colour import rendered

        assert packing is not None
        seen, error = rendered(table, found * (3 // len(found)), packing, level, thick)
        facts["rendered"] = {"level": level, "colour": seen.tolist(), "standard_errors": error.tolist()}
        aim = tuple(2.0 * c - s for c, s in zip(colour, seen.tolist(), strict=False))
        with suppress(UsageError):  # of a colour nearly out of reach, what is as far on the other side may be beyond
            facts["rendered"] |= in_conventions(absorbing(aim))
    return facts


def describe_medium(
    table: "Table", packing: float, radius: float | None = None, absorption_times_radius: float = 0.0
) -> dict[str, Any]:
    """Return the medium of packed grains, as ``tsdf-info --json`` writes it; None where a number is not finite.

    Lengths are in the unit of `radius`, or in R where it is None; absorption is sigma_a R.
    """
    from tsdf.errors import UsageError
    from tsdf.scene.medium import Component, free_path, volume_parameters

    unit = 1.0 if radius is None else radius
    try:
        grains = [Component(table, radius=unit)]
        path, volume = free_path(grains, packing), volume_parameters(grains, packing, [absorption_times_radius / unit])
    except UsageError as error:
        raise UsageError(f"--packing or --radius: {error}") from error
    numbers = {name: getattr(path, name) for name in LENGTHS}
    numbers |= {name: getattr(volume, name) for name in (*COEFFICIENTS, "albedo", "g", "transport_mean_free_path")}
    return {"packing_fraction": packing, "radius": radius} | {
        name: value if math.isfinite(value) else None for name, value in numbers.items()
    }


def _others(facts: Mapping[str, Any]) -> Iterator[str]:
    """The quantities that others ask for, sizes, and the colour, for people."""
    yield "in others' words (docs/glossary.md)"
    sizes, length = facts["sizes"], _length(facts)
    for name, (with_radius, without, word) in OTHERS.items():
        value, error = facts[name], facts["standard_errors"][name]
        spread = "" if value is None else " exact" if facts["method"] == "exact" else f" +- {error:.1g}"
        unit = without if sizes["radius"] is None else with_radius.replace("units", length)
        text = "unknown" if value is None else f"{value:.6g}{spread} {unit}".rstrip()
        yield f"  {name:<26} {text}" + (f"  ({word})" if word else "")
    for name, value in sizes.items():
        if value is not None and name != "effective_radius":
            yield f"  {name:<26} {value:.6g} {SIZE_UNITS.get(name, length)}".rstrip()
    if "colour" in facts:
        colour = facts["colour"]
        body = "a deep medium" if colour["thickness"] is None else f"a slab {colour['thickness']:g} {length} thick"
        yield f"colour of {body} in diffuse light: {', '.join(f'{c:g}' for c in colour['asked'])}"
        yield f"  {'absorption':<26} {_conventions(colour, length)}"
        if "rendered" in colour:
            seen = colour["rendered"]
            by = ", ".join(f"{c:.4f} +- {e:.1g}" for c, e in zip(seen["colour"], seen["standard_errors"], strict=True))
            yield f"  {'rendered, ' + seen['level']:<26} {by}"
            if "absorption_times_radius" in seen:
                yield f"  {'absorption right there':<26} {_conventions(seen, length)}"


def _length(facts: Mapping[str, Any]) -> str:
    """In what lengths are: R, or the unit of the radius, by its name where it has one."""
    if facts["sizes"]["radius"] is None:
        return "R"
    metres = facts["metres_per_unit"]
    return next((name for name, length in METRES.items() if metres and math.isclose(length, metres)), "units")


def _conventions(facts: Mapping[str, Any], length: str) -> str:
    """An absorption in all conventions that are known."""
    known = {"R": "absorption_times_radius", length.removesuffix("s"): "absorption", "m": "absorption_per_metre"}
    return " = ".join(
        f"{', '.join(f'{x:.4g}' for x in facts[key])} / {name}" for name, key in known.items() if facts[key] is not None
    )


def _times(found: "Measured", scale: float) -> "Measured":
    """Return a number and its error in another unit."""
    return found._replace(value=found.value * scale, error=found.error * scale)


def _lines(facts: Mapping[str, Any]) -> Iterator[str]:
    """The same for people."""

    def row(name: str, value: str) -> str:
        return f"  {name:<20} {value}"

    def known(value: Any, form: str = "") -> str:
        return "unknown" if value is None else format(value, form)

    yield f"TSDF of {facts['grain']}, format {facts['format_version']}"
    yield "grain"
    shape = "exact sphere" if facts["kind"] == "sphere" else f"mesh of {facts['faces']} triangles"
    yield row("shape", f"{shape}, {'convex' if facts['convex'] else 'not convex'}, bodies: {facts['bodies']}")
    if facts["parameters"]:
        yield row("parameters", ", ".join(f"{key} {value}" for key, value in facts["parameters"].items()))
    yield row("bounding_radius", f"{facts['bounding_radius']:g} (R, in the unit of the grain's source)")
    yield row("area, volume", f"{facts['area']:.6g} R^2, {facts['volume']:.6g} R^3")
    for note in facts["notes"]:
        yield row("note", note)
    yield "optics"
    fresnel = "averaged at every hit" if facts["fresnel"] == "un" else "polarisations kept apart"
    yield row("eta", f"{facts['eta']:g}, Fresnel {facts['fresnel']} ({fresnel})")
    if facts["material"]:
        yield row(
            "material", f"{facts['material']}, {known(facts['wavelength_nm'], 'g')} nm, k {known(facts['k'], 'g')}"
        )
    if facts["source"]:
        yield row("source", facts["source"])
    yield "statistics"
    if product := facts["absorption_times_radius"]:
        by_unit = f", {facts['absorption'] or 0.0:g} / {_length(facts).removesuffix('s')}"
        both = f"{product:g} / R" + ("" if facts["absorption"] is None else by_unit)
        yield row("absorption", f"{both}, in albedo and mean_cosine; all else is lossless")
    for name, error in facts["standard_errors"].items():
        if name == "legendre_moments" or name not in facts or name in OTHERS:
            continue
        text = known(facts[name], ".6f")
        text += "" if error is None else " exact" if facts["method"] == "exact" else f" +- {error:.1g}"
        yield row(name, f"{text} {UNITS.get(name, '')}".rstrip())
    moments = " ".join(f"{value:.4f}" for value in facts["legendre_moments"])
    yield row("legendre_moments", moments)
    yield from _others(facts)
    if "medium" in facts:
        medium = facts["medium"]
        length = _length(facts)
        bare = ", without the colour's absorption" if "colour" in facts else ""
        yield f"medium, packing fraction {medium['packing_fraction']:g}{bare}"
        if medium["radius"] is not None:
            yield row("radius", f"{medium['radius']:g} {length}")
        for name in LENGTHS:
            yield row(name, f"{known(medium[name], '.6g')} {length}")
        for name in COEFFICIENTS:
            yield row(name, f"{known(medium[name], '.6g')} / {length.removesuffix('s')}")
        yield row("albedo", f"{medium['albedo']:.6g}")
        yield row("g", known(medium["g"], ".6g"))
        path = medium["transport_mean_free_path"]
        yield row("transport path", "infinite" if path is None else f"{path:.6g} {length}")
    yield "errors, as total variation"
    error, loss = facts["table_error"], facts["factorisation_error"]
    parts = f"sampling {error['sampling_noise']:.2g}, cell width {error['cell_width']:.2g}"
    yield row("table", f"{error['total_variation']:.2g} ({parts})")
    yield row("factorisation", f"{loss['total_variation']:.2g} (noise {loss['total_variation_noise']:.2g})")
    bits = ", ".join(f"{key} {value:.2g}" for key, value in loss["mutual_information_bits"].items())
    yield row("shared information", f"{bits} bit")
    yield row("impossible offsets", f"{100.0 * loss['impossible_offsets']:.2g} % of independent draws")
    yield row("mean offset", f"{loss['mean_offset']:.4f} R, drawn {loss['mean_offset_factorised']:.4f} R")
    yield "fits"
    one, two = facts["fits"]["henyey_greenstein"], facts["fits"]["two_lobe"]
    yield row("Henyey-Greenstein", f"g {one['g']:.4f}, total variation {one['total_variation']:.2g}")
    lobes = f"g {two['g1']:.4f} and {two['g2']:.4f}, first {100.0 * two['weight']:.1f} %"
    yield row("two lobes", f"{lobes}, total variation {two['total_variation']:.2g}")
    yield "energy"
    ledger = facts["energy_ledger"]
    whole = ledger["launched"]
    for name in ("unscattered", "scattered", "absorbed", "truncated", "lost"):
        share = f"{100.0 * ledger[name] / whole:.6g} %" if whole else "nothing launched"
        yield row(name, share)
    yield "table"
    cells = ", ".join(f"{key} {value}" for key, value in facts["cells"].items())
    yield row("cells", f"{cells}; joint records {facts['joint_records']}; records by entry {facts['memory_records']}")
    paths = f"{facts['paths']} paths, seed {facts['seed']}" if facts["paths"] else "no random numbers"
    yield row("made by", f"{facts['software']}, {facts['method']}, {paths}")
    yield row("command", facts["command"])
    yield row("pixels_sha256", facts["pixels_sha256"])
    yield row("licence", facts["licence"])
