"""``tsdf-build``: a grain in, a table out."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tsdf.cli.common import Progress, Tool, check_numbers, check_output, plain, say, shown_progress
from tsdf.cli.start import interruptible
from tsdf.errors import GrainError, TSDFError, UsageError

if TYPE_CHECKING:
    from tsdf.scatterometer import Progress as Done

DEFAULT_MATERIAL, DEFAULT_WAVELENGTH_NM = "ice", 550.0


def _list_grains(context: click.Context, _: click.Parameter, value: bool) -> None:
    if not value or context.resilient_parsing:
        return
    from tsdf.exemplars import EXEMPLARS

    click.echo("sphere: the exact sphere, by quadrature (or --traced)")
    for name, exemplar in EXEMPLARS.items():
        click.echo(f"{name}: {exemplar.summary}")
        for key, p in exemplar.parameters.items():
            unit = f" {p.unit}" if p.unit else ""
            click.echo(f"    --set {key}={p.default:g}  {p.low:g} to {p.high:g}{unit}: {p.meaning}")
    context.exit()


def _count(context: click.Context, parameter: click.Parameter, value: str | None) -> int | None:
    """Read a whole number, also written as 1e7."""
    if value is None:
        return None
    try:
        number = float(value)
        if number == int(number):
            return int(value) if value.lstrip("+-").isdigit() else int(number)
    except (ValueError, OverflowError):
        pass
    raise click.BadParameter(f"{value!r} is not a whole number", context, parameter)


def _part(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    first, slash, second = value.partition("/")
    if slash and value.isascii() and first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second):
        return int(first), int(second)
    raise click.BadParameter(f"{value!r} is not i/n with 1 <= i <= n", context, parameter)


def _setting(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    settings = {}
    for value in values:
        name, equals, number = value.partition("=")
        if not equals or not name or name in settings:
            raise click.BadParameter(f"{value!r} is not NAME=VALUE, each name once", context, parameter)
        settings[name] = number
    return settings


def told(progress: "Progress", target: float | None) -> Callable[["Done"], None]:
    """Return what tells a progress bar of a build: paths, their rate, current error, and how far that is."""
    begun: list[float] = []

    def tell(done: "Done") -> None:
        begun[:] = begun or [time.monotonic(), done.paths]
        total = done.total
        words = [
            f"{done.paths:.3g} paths, {(done.paths - begun[1]) / max(time.monotonic() - begun[0], 1e-9):.2g} paths/s"
        ]
        if done.error is not None:
            words.append(f"total variation {done.error:.2g}, {done.cells} cells")
            if target is not None and done.paths:
                # noise falls as the square root of the paths: a guess of how many the target takes
                total = int(done.paths * max(1.0, done.error / target) ** 2)
        progress(done.paths / total if total else 0.0, ", ".join(words))

    return tell


@click.command("tsdf-build", cls=Tool)
@click.argument("grain")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The table to write, NAME.tsdf.exr.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    callback=_setting,
    metavar="NAME=VALUE",
    help="A parameter of a built-in grain; --grains lists them. May be given several times.",
)
@click.option("--eta", type=float, help="Relative refractive index n_inside / n_outside.  [default: ice at 550 nm]")
@click.option("--material", help="ice, water, quartz, salt, glass or sucrose, in air.")
@click.option(
    "--wavelength-nm", type=float, help=f"Wavelength for --material [nm].  [default: {DEFAULT_WAVELENGTH_NM:g}]"
)
@click.option(
    "--fresnel",
    type=click.Choice(["un", "sp"]),
    default="un",
    show_default=True,
    help="Fresnel reflectance averaged at each hit, or polarisations kept apart (sphere only).",
)
@click.option("--traced", is_flag=True, help="Send the exact sphere through the Monte Carlo tracer, too.")
@click.option("--paths", callback=_count, metavar="N", help="Paths to trace.  [default: 4e6]")
@click.option("--target-error", type=float, metavar="E", help="Stop at this estimated total variation of p_theta.")
@click.option("--cells", callback=_count, metavar="N", help="Cells of theta.  [default: 256, or what the target needs]")
@click.option(
    "--joint", callback=_count, default="0", metavar="K", show_default=True, help="Joint records per cell of theta."
)
@click.option(
    "--memory",
    callback=_count,
    default="0",
    metavar="K",
    show_default=True,
    help="Records per cell of entry, which level teleport-memory draws from; 64 are many enough.",
)
@click.option(
    "--seed", callback=_count, default="0", metavar="N", show_default=True, help="Seed of the random numbers."
)
@click.option(
    "--max-bounces",
    callback=_count,
    default="100000",
    metavar="N",
    show_default=True,
    help="Hits before a path is cut.",
)
@click.option(
    "--threads", callback=_count, metavar="N", help="Threads; the result does not depend on it.  [default: all]"
)
@click.option("--repair", is_flag=True, help="Try to close an open mesh, and say what that changed.")
@click.option("--repair-any", is_flag=True, help="As --repair, even if more than a tenth of the surface is new.")
@click.option("--chunk", "part", callback=_part, metavar="i/n", help="Trace part i of n only; --out is for tsdf-merge.")
@click.option("--resume", is_flag=True, help="Go on with an interrupted build of the same command.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
@click.option(
    "--grains",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_grains,
    help="List the built-in grains and their parameters.",
)
def main(
    grain: str,
    out: Path,
    settings: dict[str, str],
    eta: float | None,
    material: str | None,
    wavelength_nm: float | None,
    fresnel: str,
    traced: bool,
    paths: int | None,
    target_error: float | None,
    cells: int | None,
    joint: int,
    memory: int,
    seed: int,
    max_bounces: int,
    threads: int | None,
    repair: bool,
    repair_any: bool,
    part: tuple[int, int] | None,
    resume: bool,
    quiet: bool,
) -> None:
    """Build the table of GRAIN: "sphere", a built-in grain (see --grains), or a mesh file."""
    if eta is not None and material is not None:
        raise UsageError("give --eta or --material, not both")
    if eta is not None and wavelength_nm is not None:
        raise UsageError("--wavelength-nm goes with --material, not with --eta")
    check_numbers(threads=threads)
    if traced and grain != "sphere":
        raise UsageError("--traced is for the exact sphere; every other grain is traced anyway")
    exact = grain == "sphere" and not traced
    if exact and (part is not None or resume or paths is not None):
        raise UsageError("the exact sphere takes no paths, chunks or resuming; add --traced to trace it")
    if part is not None and target_error is not None:
        raise UsageError("parts cannot know when the whole meets a target: give --paths with --chunk")
    if (repair or repair_any) and grain == "sphere":
        raise UsageError("--repair is for mesh files")

    from tsdf import scatterometer
    from tsdf.optics import Optics

    if eta is None:
        from tsdf.materials import optical_constants

        found = optical_constants(
            material or DEFAULT_MATERIAL, DEFAULT_WAVELENGTH_NM if wavelength_nm is None else wavelength_nm
        )
        optics = Optics(found.n, fresnel, found.material, found.wavelength_nm, found.k, found.source)
    else:
        optics = Optics(eta, fresnel)
    effort = scatterometer.Effort(paths, target_error, cells, joint, seed, max_bounces, memory)
    part_file = out if part is not None else out.with_name(out.name + ".part")
    check_output(out, Path(grain), beside=[] if exact or part is not None else [part_file])
    if not exact and part_file.exists() and not resume:
        if part is not None:
            raise TSDFError(f"{part_file} exists already: add --resume to go on with it, or choose another --out")
        raise TSDFError(f"{part_file} holds an unfinished build: add --resume to go on with it, or delete it")

    from tsdf.format import write
    from tsdf.grains import load_grain

    shape = load_grain(grain, repair="any" if repair_any else repair, **settings)
    if not quiet:
        for note in shape.notes:
            click.echo(f"note: {note}", err=True)
    if exact:
        finish(scatterometer.exact_sphere(shape, optics, effort), out, quiet)
        return

    build = scatterometer.Build.start(shape, optics, effort)
    if resume and part_file.exists():
        stored = scatterometer.Build.load(part_file)
        if stored.request != build.request:
            differing = ", ".join(key for key in build.request if build.request[key] != stored.request.get(key))
            raise TSDFError(f"{part_file} is of another build (they differ in {differing}): delete it to start anew")
        build = stored

    def interrupted() -> str:
        safe = f"{build.paths} paths are safe in {plain(part_file)}; go on with --resume"
        return safe if build.done and part_file.exists() else "nothing is done yet"

    with interruptible(interrupted):
        try:
            with shown_progress(quiet) as progress:
                build.run(
                    shape, threads or os.cpu_count() or 1, part or (1, 1), part_file, told(progress, target_error)
                )
            table = build.table() if part is None else None
        except (GrainError, UsageError):
            part_file.unlink(missing_ok=True)  # a refused build cannot be gone on with
            raise
        if table is not None:
            write(table, out)
    if part is not None:
        if not quiet:
            say(f"{out}: part {part[0]} of {part[1]}, {build.paths} paths; tsdf-merge makes the table")
        return
    part_file.unlink(missing_ok=True)
    summary(table, out, quiet)


def finish(table: Any, out: Path, quiet: bool) -> None:
    """Write a finished table and sum it up."""
    from tsdf.format import write

    write(table, out)
    summary(table, out, quiet)


def summary(table: Any, out: Path, quiet: bool) -> None:
    """Sum a table up on standard output."""
    ledger = table.header["energy_ledger"]
    leak = (ledger["lost"] + ledger["truncated"]) / ledger["launched"]
    if leak > 1e-6:
        click.echo(f"warning: {leak:.1e} of the light was lost or cut off: see energy in tsdf-info", err=True)
    if quiet:
        return
    s, errors = table.statistics, table.header["standard_errors"]
    error = table.header["table_error"]
    say(f"{out}: {table.header['grain']['name']}, eta {table.header['optics']['eta']:.6g}")
    for label, name in (
        ("hit probability beta", "hit_probability"),
        ("mean cosine g", "mean_cosine"),
        ("mean z, lambda_s [R]", "mean_z"),
        ("mean r [R]", "mean_r"),
        ("mean chord of a miss, lambda_delta [R]", "mean_miss_chord"),
        ("mean path length [R]", "mean_path_length"),
        ("forward atom", "atom_forward"),
    ):
        say(f"  {label:40s}{s[name]:.6f} +- {errors[name]:.1e}")
    say(
        f"  {'total variation to the truth, about':40s}{error['total_variation']:.2g} "
        f"(noise {error['sampling_noise']:.2g}, cells {error['cell_width']:.2g})"
    )
    say(f"  {'light lost or cut off':40s}{leak:.1e}")
