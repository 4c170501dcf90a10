"""``tsdf-info``: what a table says of itself."""

import json
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import click

from tsdf.cli.common import Tool, plain

if TYPE_CHECKING:
    from tsdf.data.table import Table

LENGTHS = ("lambda_b", "lambda_beta", "lambda_s")  # of the medium
COEFFICIENTS = ("sigma_t", "sigma_s", "sigma_a")
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
@click.option(
    "--packing",
    type=float,
    metavar="F",
    help="Share of a volume filled by bounding spheres [1], 0 < F <= 0.74; adds the medium of such grains.",
)
@click.option(
    "--radius",
    type=float,
    metavar="L",
    help="Bounding radius of the grains in that medium, whose lengths are then in the unit of L.  [default: in R]",
)
@click.option("--unit", type=float, metavar="METRES", help="Length of the unit of L; only X/mm (um, cm, m) needs it.")
def main(
    file: str, as_json: bool, absorption: str | None, packing: float | None, radius: float | None, unit: float | None
) -> None:
    """Show what the table FILE holds: grain, optics, statistics with standard errors, errors, energy, origin."""
    from tsdf.cli.absorption import times_radius
    from tsdf.data import format
    from tsdf.errors import UsageError

    if radius is not None and packing is None and absorption is None:
        raise UsageError("--radius is of the grains of a medium: give its --packing too")
    for name, value in (("--radius", radius), ("--unit", unit)):
        if value is not None and not 0.0 < value < math.inf:
            raise UsageError(f"{name} is a finite number > 0, not {value:g}")
    (product,) = times_radius(absorption, radius, unit)
    table = format.read(file)
    facts = describe(table, product, radius)
    if packing is not None:
        facts["medium"] = describe_medium(table, packing, radius, product)
    if as_json:
        click.echo(json.dumps(facts, indent=1))
    else:
        for line in _lines(facts):
            click.echo(plain(line))


def describe(table: "Table", absorption_times_radius: float = 0.0, radius: float | None = None) -> dict[str, Any]:
    """Return what `table` says, as ``tsdf-info --json`` writes it; None where a number is unknown.

    With absorption (sigma_a R), `albedo` and `mean_cosine` are those of the absorbing grain. Their standard errors are
    unknown.
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
        both = f"{product:g} / R" + ("" if facts["absorption"] is None else f", {facts['absorption']:g} / unit")
        yield row("absorption", f"{both}, in albedo and mean_cosine; all else is lossless")
    for name, error in facts["standard_errors"].items():
        if name == "legendre_moments" or name not in facts:
            continue
        text = known(facts[name], ".6f")
        text += "" if error is None else " exact" if facts["method"] == "exact" else f" +- {error:.1g}"
        yield row(name, f"{text} {UNITS.get(name, '')}".rstrip())
    moments = " ".join(f"{value:.4f}" for value in facts["legendre_moments"])
    yield row("legendre_moments", moments)
    if "medium" in facts:
        medium = facts["medium"]
        length = "R" if medium["radius"] is None else "units"
        yield f"medium, packing fraction {medium['packing_fraction']:g}"
        if medium["radius"] is not None:
            yield row("radius", f"{medium['radius']:g} units")
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
