"""``tsdf-albedo``: grains in a slab or a half-space, spectral albedo out."""

import math
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from tsdf.cli import spectral
from tsdf.cli.common import Tool, check_numbers, named_levels, plain, seed_option, whole_number, working
from tsdf.errors import UsageError

COMMANDLINE = ParameterSource.COMMANDLINE


@click.command("tsdf-albedo", cls=Tool)
@spectral.options
@click.option("--level", default="volume", show_default=True, help="Level of detail, as of tsdf-render.")
@click.option(
    "--packing", type=float, default=0.3, show_default=True, metavar="F",
    help="Share of the volume in bounding spheres; of a half-space it hardly matters.",
)  # fmt: skip
@click.option("--density", type=float, metavar="X", help="Instead of --packing: of the medium [kg/m3].")
@click.option(
    "--thickness", callback=spectral.metres, metavar="LENGTH", help="Of the slab, 20mm say.  [default: half-space]"
)  # fmt: skip
@click.option("--angle", type=float, metavar="DEG", help="Of direct light to the normal, 0 to below 90.")
@click.option("--diffuse", is_flag=True, help="Diffuse light instead; the default without --angle.")
@click.option(
    "--ground", type=float, default=0.0, show_default=True, metavar="R", help="Reflectance of the ground below a slab."
)  # fmt: skip
@click.option("--profile", type=int, default=0, metavar="N", help="Tell absorption in N layers, too.")
@click.option(
    "--depth", callback=spectral.metres, metavar="LENGTH", help="To which --profile goes in a half-space."
)  # fmt: skip
@click.option(
    "--error", type=float, default=0.0007, show_default=True, metavar="E", help="Standard error at which to stop."
)  # fmt: skip
@click.option("--paths", callback=whole_number, metavar="N", help="Paths of each set, instead of --error.")
@click.option(
    "--mesh", type=click.Path(path_type=Path), metavar="FILE", help="Of tables' grain, for --level explicit."
)  # fmt: skip
@seed_option("0")
def main(  # noqa: PLR0913 - an argument for each option
    grains: tuple[str, ...], as_json: bool, csv_file: Path | None, plot: Path | None, quiet: bool, level: str,
    packing: float, density: float | None, thickness: float | None, angle: float | None, diffuse: bool, ground: float,
    profile: int, depth: float | None, error: float, paths: int | None, mesh: Path | None, seed: int, **said: Any,
) -> None:  # fmt: skip
    """Tell what a slab or half-space of GRAIN does to light by wavelength: reflectance, transmittance, absorption.

    GRAIN is as of tsdf-build, or tables of one grain at several indices. All wavelengths are read off the same paths,
    followed at up to three refractive indices. Beside them, from the same single scattering: doubling, which is level
    volume without noise, two streams (delta-Eddington) and asymptotic theory. `between` is what n between the indices
    may miss.
    """
    asked = spectral.Asked.of(grains, said)
    check_numbers(seed, said["threads"], paths=paths)
    level, *others = named_levels(level, (), "--level")
    if others:
        raise UsageError(f"--level takes one level, not {1 + len(others)}")
    if density is not None and click.get_current_context().get_parameter_source("packing") is COMMANDLINE:
        raise UsageError("--packing and --density both say how much of space is filled: give one")
    if angle is not None and diffuse:
        raise UsageError("--angle and --diffuse both say where the light comes from: give one")
    if angle is not None and not 0.0 <= angle < 90.0:
        raise UsageError(f"--angle is 0 to below 90 degrees, not {angle:g}")
    if not 1e-5 <= error < 1.0:
        raise UsageError(f"--error is a standard error from 1e-5 to below 1, not {error:g}")
    if ground and thickness is None:
        raise UsageError("--ground lies below a slab: say its --thickness")
    if depth is not None and (thickness is not None or not profile):
        raise UsageError("--depth is that of the --profile of a half-space; that of a slab goes all through it")
    spectral.check(asked, csv_file, plot)
    if plot is not None:
        from tsdf.study.plots import check_suffix

        check_suffix(plot)

    from tsdf.scene.medium import MAX_PACKING_FRACTION
    from tsdf.study import slabs, spectra

    # before tables are made, which takes minutes
    slabs.Request(level, ground=ground, depths=profile)
    slabs.check_paths(paths)
    if not 0.0 < packing <= MAX_PACKING_FRACTION:
        raise UsageError(f"--packing is above 0 and at most {MAX_PACKING_FRACTION:g}, not {packing:g}")
    if density is not None and not 0.0 < density < math.inf:
        raise UsageError(f"--density is a finite number > 0, not {density:g}")
    with working(quiet) as work:
        records = {"memory": {"memory": 64}, "joint": {"joint": 32}}
        needed = slabs.records_of(level)
        c = asked.constants()
        family = asked.family(
            c, lambda share, word: work.progress(0.3 * share, word), seed, **records.get(needed or "", {})
        )
        words = asked.words(family, **({"packing_fraction": packing} if density is None else {"density": density}))
        assert words.packing_fraction is not None
        packing, radius = words.packing_fraction, words.radius
        found = spectra.spectrum(family, c, radius)
        request = slabs.Request(
            level, packing, math.inf if thickness is None else thickness / radius,
            None if angle is None else math.cos(math.radians(angle)), ground, profile,
            100.0 if depth is None else depth / radius, mesh if mesh is not None else asked.mesh,
        )  # fmt: skip
        result = slabs.measure(
            family, found, request, error, seed, asked.threads, paths,
            lambda share, word: work.progress(0.3 + 0.7 * share, word),
        )  # fmt: skip
    name, size = family.tables[0].header["grain"]["name"], asked.told(words)
    body = "half-space" if thickness is None else f"slab of {thickness:g} m"
    light = "diffuse light" if angle is None else f"light at {angle:g} degrees"
    over = f" over ground of reflectance {ground:g}" if ground else ""
    title = f"{body} of {name}, {c.material}, {size}, packing fraction {packing:.4g}{over}, {light}, level {level}"
    notes = [
        title,
        f"{result.paths} paths at n = {', '.join(f'{eta:.5g}' for eta in result.eta)}; constants: {c.source}",
        *found.notes,
    ]
    notes = [plain(note) for note in notes]
    if plot is not None:
        from tsdf.study import plots, spectral_plots

        plots.save(spectral_plots.plot_albedo(result, c.wavelength_nm, title), plot)
    facts = {
        "grain": name, "material": c.material, "source": c.source, "radius_m": radius, "size": size, "level": level,
        "packing_fraction": packing, "thickness_m": thickness, "angle_deg": angle, "ground": ground,
        "paths": result.paths, "eta": result.eta.tolist(), "profile_edges_m": (radius * result.edges).tolist(),
    }  # fmt: skip
    spectral.tell(slabs.columns(result, found), facts, notes, as_json, csv_file, quiet)
