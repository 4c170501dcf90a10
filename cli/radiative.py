"""``tsdf-export`` for radiative transfer programs: what it is asked becomes a spectrum for `loaders.radiative`."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from tsdf.cli import sizes, spectral
from tsdf.cli.absorption import times_radius
from tsdf.cli.common import check_output, plain, working, write_text
from tsdf.errors import UsageError

if TYPE_CHECKING:
    from tsdf.study.spectra import Constants

FILES = ("snicar", "eradiate")  # that are no text
MONOCHROME = ("disort", "phase")  # that need neither material nor size
SNICAR = "205:4995:10"
AMOUNTS = ("packing_fraction", "solid_fraction", "density")
ANYTHING_NM = 550.0


class Said(NamedTuple):
    """Options of `tsdf-export` as they were said."""

    absorption: str | None
    material: str | None
    wavelength_nm: str | None
    unit: float | None
    orders: int
    out: str | None
    options: Mapping[str, float | None]
    building: Mapping[str, Any]  # options of `spectral.building`
    quiet: bool


def export(files: tuple[str, ...], to: str, said: Said) -> None:
    """Write what a target takes of tables of one grain, or of a grain.

    Raises
    ------
    UsageError, TSDFError
    """
    words = sizes.said(said.options)
    metres = 1.0 if said.unit is None else said.unit
    if not 0.0 < metres < math.inf:
        raise UsageError(f"--unit is a finite number of metres above 0, not {metres:g}")
    if to in FILES and said.out is None:
        raise UsageError(f"{to} is no text: say with --out where to write it")
    if said.absorption is not None and (said.material is not None or to not in MONOCHROME):
        raise UsageError(f"--to {to} takes --material, not --absorption" if to not in MONOCHROME else
                         "--absorption and --material both say how grains absorb: give one")  # fmt: skip
    if to == "snicar" and said.wavelength_nm is not None:
        raise UsageError("SNICAR has its own 480 bands: leave --wavelength-nm out")
    lengths = {name: words[name] * (1.0 if name == "ssa" else metres) for name in words
               if name in (*spectral.LENGTHS, "ssa")}  # fmt: skip
    wavelengths = SNICAR if to == "snicar" else said.wavelength_nm or "300:2500:10"
    given = dict.fromkeys((*spectral.LENGTHS, "ssa")) | lengths | {
        "material_density": words.get("material_density"), "material": said.material, "wavelength_nm": wavelengths,
        **said.building,
    }  # fmt: skip
    asked = spectral.Asked.of(files, given)
    single = to in MONOCHROME and said.material is None and said.wavelength_nm is None and asked.tabulated
    if single:
        if len(files) > 1:
            raise UsageError("several tables are for a spectrum: say --material or --wavelength-nm, or give one table")
        asked = asked._replace(material="")  # the table's own
    elif said.absorption is not None:
        raise UsageError("--absorption is for one table and no wavelengths; say --material instead")
    if said.out is not None:
        check_output(Path(said.out), *asked.inputs, printed="" if to in FILES else "leave it out")

    from tsdf.loaders import radiative
    from tsdf.study import spectra

    with working(said.quiet) as work:
        constants = None if single else asked.constants()
        family = asked.family(constants, work.progress)
    grain = asked.words(family, **{name: words[name] for name in AMOUNTS if name in words})
    if single:
        radius = grain.radius / metres if lengths else None  # of no use where nobody said it
        constants = _at(family, times_radius(said.absorption, radius, said.unit)[0], grain.radius)
    assert constants is not None
    found = spectra.spectrum(family, constants, grain.radius)
    name, c = family.tables[0].header["grain"]["name"], found.constants
    of = f"{c.material} ({c.source})" if c.material else f"n {c.n[0]:.6g}, absorption " \
        f"{found.absorption_times_radius[0]:.6g} / R"  # fmt: skip
    tables, size = spectral.tables_of(family), asked.told(grain)
    notes = tuple(plain(note) for note in (f"{name}, {of}, {size}; by tsdf-export", tables, *found.notes))
    request = radiative.Request(family, found, grain, notes, said.orders)
    if to in FILES:
        assert said.out is not None
        radiative.FILES[to](request, said.out)
        return
    text = radiative.TEXTS[to](request)
    if said.out is None:
        click.echo(text, nl=False)
    else:
        write_text(said.out, text)


def _at(family: "spectral.Family", absorption: float, radius: float) -> "Constants":
    """Return constants at the index of the one table, with the k that makes grains absorb as is said."""
    import numpy as np

    from tsdf.study.spectra import NM, Constants

    k = absorption * ANYTHING_NM * NM / (4.0 * math.pi * radius)
    one = Constants(np.array([ANYTHING_NM]), family.eta[:1], np.array([k]), "", "")
    return one
