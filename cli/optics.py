"""``tsdf-optics``: a grain in, single scattering by wavelength out."""

from pathlib import Path
from typing import Any

import click

from tsdf.cli import spectral
from tsdf.cli.common import Tool, check_numbers, plain, whole_number, working
from tsdf.errors import UsageError

FORWARDS = ("kept", "apart", "delta-m")


@click.command("tsdf-optics", cls=Tool)
@spectral.options
@click.option(
    "--phase", type=click.Path(path_type=Path), metavar="PATH",
    help="Write phase functions: angle [deg] and one column a wavelength, mean over the sphere 1; - prints them.",
)  # fmt: skip
@click.option(
    "--moments", type=click.Path(path_type=Path), metavar="PATH",
    help="Write Legendre moments as CSV, one column a wavelength; - prints them.",
)  # fmt: skip
@click.option(
    "--orders", callback=whole_number, default="128", show_default=True, metavar="N",
    help="Highest order of --moments, up to 1024.",
)  # fmt: skip
@click.option(
    "--forward", type=click.Choice(FORWARDS), default="kept", show_default=True,
    help="What goes straight on, in --moments: among the rest, apart from it, or cut off as by delta-M.",
)  # fmt: skip
def main(
    grains: tuple[str, ...], as_json: bool, csv_file: Path | None, plot: Path | None, quiet: bool, phase: Path | None,
    moments: Path | None, orders: int, forward: Any, **said: Any,
) -> None:  # fmt: skip
    """Tell single-scattering albedo, asymmetry factor and absorption enhancement of GRAIN by wavelength.

    GRAIN is as of tsdf-build; tables of it are made at the few refractive indices that serve all of the spectrum. Or
    give tables, at several indices if n matters. Columns: absorption_times_radius; albedo and g of geometrical optics,
    albedo_far and g_far with diffraction (Q_ext = 2), B; each with its error, of noise and of n between tables.
    """
    asked = spectral.Asked.of(grains, said)
    check_numbers(threads=said["threads"], **{"table-paths": said["table_paths"]})
    if not 0 <= orders <= 1024:
        raise UsageError(f"--orders is 0 to 1024, not {orders}")
    spectral.check(asked, as_json, csv=csv_file, plot=plot, phase=phase, moments=moments)
    if plot is not None:
        from tsdf.study.plots import check_suffix

        check_suffix(plot)

    import numpy as np

    from tsdf.data.phase import parted, phase_text
    from tsdf.study import spectra

    with working(quiet) as work:
        c = asked.constants()
        family = asked.family(c, work.progress)
    words = asked.words(family)
    found, size = spectra.spectrum(family, c, words.radius), asked.told(words)
    missed = (
        f"; polynomials between them may miss {found.between['g'].max():.1g} of g" if len(family.tables) > 1 else ""
    )
    notes = [
        f"single scattering of {family.tables[0].header['grain']['name']}, {c.material} ({c.source}), {size}",
        f"{spectral.tables_of(family)}{missed}",
        *found.notes,
    ]
    notes = [plain(note) for note in notes]
    if phase is not None:
        edges, masses = family.masses(found)
        spectral.write(phase, lambda: phase_text(edges, masses, spectra.wavelength_heads(c), notes[:1]))
    if moments is not None:
        left, straight = parted(*spectra.moments_of(family, found, orders), forward)
        columns = {"order": np.arange(orders + 1.0)} | dict(zip(spectra.wavelength_heads(c), left, strict=True))
        told = [notes[0], f"goes straight on ({forward}): {' '.join(f'{x:.8g}' for x in straight)}"]
        spectral.write(moments, lambda: spectral.csv_text(columns, told))
    if plot is not None:
        from tsdf.study import plots, spectral_plots

        plots.save(spectral_plots.plot_spectrum(found, family.tables[0].header["grain"]["name"]), plot)
    facts = {
        "grain": family.tables[0].header["grain"]["name"], "material": c.material, "source": c.source,
        "radius_m": found.radius, "size": size, "table_eta": family.eta.tolist(),
        "fresnel": family.tables[0].header["optics"]["fresnel"], "material_density": words.sizes.material_density,
    }  # fmt: skip
    spectral.tell(spectra.columns(found), facts, notes, as_json, csv_file,
                  quiet or any(map(spectral.is_printed, (csv_file, phase, moments))))  # fmt: skip
