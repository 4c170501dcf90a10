"""``tsdf-albedo``: grains in a slab or a half-space, spectral albedo out."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from tsdf.cli import spectral
from tsdf.cli.common import Tool, check_numbers, named_levels, plain, seed_option, whole_number, working
from tsdf.cli.start import interrupt_status
from tsdf.errors import UsageError

if TYPE_CHECKING:
    from tsdf.scene.sizes import InWords

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
) -> int:  # fmt: skip
    """Tell what a slab or half-space of GRAIN does to light by wavelength: reflectance, transmittance, absorption.

    GRAIN is as of tsdf-build, or tables of one grain at several indices. All wavelengths are read off the same paths,
    followed at up to three refractive indices. Beside them, from the same single scattering: doubling, which is level
    volume without noise, two streams (delta-Eddington) and asymptotic theory. `between` is what n between the indices
    may miss, `optical_depth` that of point scatterers. An interrupt keeps what the paths so far have told.
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
    spectral.check(asked, as_json, csv=csv_file, plot=plot)
    if plot is not None:
        from tsdf.study.plots import check_suffix

        check_suffix(plot)

    from tsdf.scene.medium import MAX_PACKING_FRACTION
    from tsdf.scene.sizes import DENSEST_RANDOM
    from tsdf.study import slabs, spectra

    # before tables are made, which takes minutes
    slabs.Request(level, ground=ground, depths=profile)
    slabs.check_paths(paths)
    if not 0.0 < packing <= MAX_PACKING_FRACTION:
        raise UsageError(f"--packing is above 0 and at most {MAX_PACKING_FRACTION:g}, not {packing:g}")
    if density is not None and not 0.0 < density < math.inf:
        raise UsageError(f"--density is a finite number > 0, not {density:g}")
    if density is not None:
        asked.need_density("density")
        solid = asked.solid.get("material_density", math.inf)
        if density > solid:
            raise UsageError(
                f"--density {density:g} kg/m3 is more than that of the material, {solid:g} kg/m3; say less, or another "
                "--material-density"
            )
    with working(quiet) as work:

        def goes_on(paths: int) -> bool:
            work.begun = paths > 0  # there are results to keep
            return not work.stop.is_set()

        records = {"memory": {"memory": 64}, "joint": {"joint": 32}}
        needed = slabs.records_of(level)
        c = asked.constants()
        family = asked.family(
            c, lambda share, word: work.progress(0.3 * share, word), seed, **records.get(needed or "", {})
        )
        words = asked.words(family, **({"packing_fraction": packing} if density is None else {"density": density}))
        packing, radius = words.fraction, words.radius
        crammed = _crammed(words, level, density, thickness, depth)
        if crammed > 1.0:
            packing = DENSEST_RANDOM
        found = spectra.spectrum(family, c, radius)
        request = slabs.Request(
            level, packing, math.inf if thickness is None else crammed * thickness / radius,
            None if angle is None else math.cos(math.radians(angle)), ground, profile,
            100.0 if depth is None else crammed * depth / radius, mesh if mesh is not None else asked.mesh,
        )  # fmt: skip
        result = slabs.measure(
            family, found, request, error, seed, asked.threads, paths,
            lambda share, word: work.progress(0.3 + 0.7 * share, word), goes_on,
        )  # fmt: skip
    result = replace(result, edges=result.edges / crammed)
    name, size = family.tables[0].header["grain"]["name"], asked.told(words)
    body = "half-space" if thickness is None else f"slab of {thickness:g} m"
    light = "diffuse light" if angle is None else f"light at {angle:g} degrees"
    over = f" over ground of reflectance {ground:g}" if ground else ""
    dense = "" if density is None else f"density {density:g} kg/m3, "
    title = (
        f"{body} of {name}, {c.material}, {size}, {dense}packing fraction {packing:.4g}{over}, {light}, level {level}"
    )
    notes = [
        title,
        f"{result.paths} paths at n = {', '.join(f'{eta:.5g}' for eta in result.eta)}; {spectral.tables_of(family)}; "
        f"constants: {c.source}",
        *([_as_much_mass(words, crammed, thickness)] if crammed > 1.0 else []),
        *found.notes,
    ]
    worst = max(float(result.reflectance_error.max()), float(result.transmittance_error.max()))
    short = work.stop.is_set() and not result.finished
    if short:
        asked_for = f"an error of {error:g}" if paths is None else f"{paths} paths"
        notes.insert(
            1, f"interrupted: results of {result.paths} paths with errors up to {worst:.2g}, short of {asked_for}"
        )
        click.echo(notes[1], err=True)
    notes = [plain(note) for note in notes]
    if plot is not None:
        from tsdf.study import plots, spectral_plots

        plots.save(spectral_plots.plot_albedo(result, c.wavelength_nm, title), plot)
    facts = {
        "grain": name, "material": c.material, "source": c.source, "radius_m": radius, "size": size, "level": level,
        "material_density": words.sizes.material_density, "fresnel": family.tables[0].header["optics"]["fresnel"],
        "density": words.density, "packing_fraction": packing, "thickness_m": thickness, "angle_deg": angle,
        "ground": ground,
        "interrupted": short, "paths": result.paths, "eta": result.eta.tolist(),
        "profile_edges_m": (radius * result.edges).tolist(),
    }  # fmt: skip
    spectral.tell(slabs.columns(result, found), facts, notes, as_json, csv_file, quiet or spectral.is_printed(csv_file))
    return interrupt_status() if short else 0


def _crammed(
    words: "InWords", level: str, density: float | None, thickness: float | None, depth: float | None
) -> float:
    """Return how many times more mass there is in a volume than where bounding spheres are packed as densely as they
    can; 1 where there is room for them.

    Grains that are points need no room: light meets the same grains in a slab that much thicker.

    Raises
    ------
    UsageError
        At levels whose grains need room.
    """
    from tsdf.scene.levels import LEVELS
    from tsdf.scene.sizes import DENSEST_RANDOM, unpackable

    crammed = words.fraction / DENSEST_RANDOM
    if density is None or crammed <= 1.0:
        return 1.0
    if LEVELS[level].traits.spheres:
        lengths = (("--thickness", thickness), ("--depth", depth))
        same = [f"{option} {1e3 * crammed * length:.3g}mm" for option, length in lengths if length is not None]
        kept = "as much mass per area" if same else "of a half-space density hardly matters"
        raise UsageError(
            f"{unpackable(words.sizes, 'density', density, words.fraction)}. At level {level} keep the size of grains "
            f"and say {' '.join([f'--packing {DENSEST_RANDOM:g}', *same])}: {kept}; or take --level volume, whose "
            "grains need no room"
        )
    return crammed


def _as_much_mass(words: "InWords", crammed: float, thickness: float | None) -> str:
    """Return the note on grains that are denser than their bounding spheres can be packed."""
    from tsdf.scene.sizes import DENSEST_RANDOM

    body = (
        "; of a half-space that only says how deep light goes" if thickness is None else
        f", in a slab of {1e3 * crammed * thickness:.4g} mm, which has the same mass per area"
    )  # fmt: skip
    return (
        f"{words.density:.4g} kg/m3 would take a packing fraction of {words.fraction:.3g}: free paths are those of "
        f"{DENSEST_RANDOM:g}, {(words.density or 0.0) / crammed:.3g} kg/m3{body}"
    )
