"""``tsdf-build``: a grain in, a table out."""

import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsdf.cli.common import (
    Progress,
    Tool,
    beside,
    check_numbers,
    check_output,
    plain,
    say,
    seed_option,
    setting,
    shown_progress,
    threads_option,
    whole_number,
)
from tsdf.cli.start import interrupt_status, interruptible
from tsdf.errors import GrainError, TSDFError, UsageError
from tsdf.make.quality import QUALITIES

if TYPE_CHECKING:
    from tsdf.data.table import Table
    from tsdf.grain.grains import Grain
    from tsdf.grain.optics import Optics
    from tsdf.make.scatterometer import Build
    from tsdf.make.scatterometer import Progress as Done

NEAR = 2.0  # times the target, an error from which on what it still takes is known to a factor of two, by trials
LONG_S = 600.0  # [s] what takes longer deserves a note
DEFAULT_MATERIAL, DEFAULT_WAVELENGTH_NM = "ice", 550.0


def _list_grains(context: click.Context, _: click.Parameter, value: bool) -> None:
    if not value or context.resilient_parsing:
        return
    from tsdf.grain.exemplars import EXEMPLARS

    click.echo("sphere: the exact sphere, by quadrature (or --traced)")
    for name, exemplar in EXEMPLARS.items():
        click.echo(f"{name}: {exemplar.summary}")
        for key, p in exemplar.parameters.items():
            unit = f" {p.unit}" if p.unit else ""
            click.echo(f"    --set {key}={p.default:g}  {p.low:g} to {p.high:g}{unit}: {p.meaning}")
    context.exit()


def _part(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    first, slash, second = value.partition("/")
    if slash and value.isascii() and first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second):
        return int(first), int(second)
    raise click.BadParameter(f"{value!r} is not i/n with 1 <= i <= n", context, parameter)


def told(progress: Progress, target: float | None, quality: str | None = None) -> Callable[["Done"], None]:
    """Return what tells a progress bar of a build: paths, their rate, the error reached; and notes if it takes long, or
    how long it takes once its first paths have shown their pace, if a quality was asked for."""
    begun: list[float] = []
    noted: list[bool] = []
    paced: list[float] = []  # when the first paths were done, compiling before them, and how many

    def tell(done: "Done") -> None:
        now = time.monotonic()
        begun[:] = begun or [now, done.paths]
        seconds, paths = now - begun[0], done.paths - begun[1]
        if done.paths > begun[1]:
            paced[:] = paced or [now, done.paths]
        words = [f"{done.paths:.3g} paths, {paths / max(seconds, 1e-9):.2g} paths/s"]
        if done.error is not None:
            goal = f" of {target:g}" if target is not None else ""
            words.append(f"total variation {done.error.total_variation:.2g}{goal}, {done.error.cells} cells")
        progress(done.paths / done.total if done.total else 0.0, ", ".join(words))
        left = seconds * (done.total - done.paths) / paths if done.total and paths else 0.0
        if quality is not None:
            near = target is not None and done.error is not None and done.error.total_variation < NEAR * target
            if near and done.total and paced and done.paths > paced[1] and not noted:
                noted.append(True)
                pace = (done.paths - paced[1]) / (now - paced[0])
                progress.note(estimate(quality, done.total, pace, (done.total - done.paths) / pace))
        elif target is not None and seconds > 5.0 and left > LONG_S and not noted:
            noted.append(True)
            progress.note(
                f"--target-error {target:g} takes about {done.total:.1e} paths, {left / 60:.0f} minutes more; "
                "--max-seconds S ends in time, and what Ctrl-C interrupts is kept"
            )

    return tell


def estimate(quality: str, paths: float, pace: float, seconds: float) -> str:
    """Return how long a build takes, in words."""
    time_left = f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} minutes"
    return (
        f"--quality {quality}: about {paths:.1e} paths at {pace:.1e} a second, {time_left} more, to a factor of two; "
        "--max-seconds S ends in time, and what Ctrl-C interrupts is kept"
    )


@click.command("tsdf-build", cls=Tool)
@click.argument("grain")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The table to write, NAME.tsdf.exr.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    callback=setting,
    metavar="NAME=VALUE",
    help="A parameter of a built-in grain; --grains lists them. May be given several times.",
)
@click.option("--eta", type=float, help="Relative refractive index n_inside / n_outside.  [default: ice at 550 nm]")
@click.option(
    "--material",
    metavar="NAME|FILE",
    help="Built in, in air: ice (200 to 5000 nm), water (200 to 4000), quartz (198 to 3000), salt (200 to 30000), "
    "glass (N-BK7, 300 to 2500), sucrose (400 to 700). Or a file of your own: lines of wavelength_nm,n,k "
    "under that header (.csv), or an entry of refractiveindex.info (.yml). Between lines log k is linear, beside k = 0 "
    "k itself.",
)
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
@click.option("--paths", callback=whole_number, metavar="N", help="Paths to trace.  [default: 4e6]")
@click.option("--target-error", type=float, metavar="E", help="Stop at this estimated total variation of p_theta.")
@click.option(
    "--quality",
    type=click.Choice(tuple(QUALITIES)),
    help="Target error and records in one word: draft .02, 8 joint, 32 by entry (seconds), good .005, 32, 64 (a "
    "minute), final .0025, 64, 64 (ten). Says how long it takes first.",
)
@click.option(
    "--max-seconds",
    type=click.FloatRange(0.0),
    metavar="S",
    help="Stop tracing after S seconds and write the table as good as it got; --resume goes on all the same.",
)
@click.option(
    "--cells", callback=whole_number, metavar="N", help="Cells of theta.  [default: 256, or what the target needs]"
)
@click.option(
    "--joint",
    callback=whole_number,
    metavar="K",
    help="Joint records per cell of theta.  [default: 0, or the quality's]",
)
@click.option(
    "--memory",
    callback=whole_number,
    metavar="K",
    help="Records per cell of entry, which level teleport-memory draws from; 64 are many enough.  "
    "[default: 0, or the quality's]",
)
@seed_option("0")
@click.option(
    "--max-bounces",
    callback=whole_number,
    default="100000",
    metavar="N",
    show_default=True,
    help="Hits before a path is cut.",
)
@threads_option
@click.option("--repair", is_flag=True, help="Try to close an open mesh, and say what that changed.")
@click.option("--repair-any", is_flag=True, help="As --repair, even if more than a tenth of the surface is new.")
@click.option("--chunk", "part", callback=_part, metavar="i/n", help="Trace part i of n only; --out is for tsdf-merge.")
@click.option(
    "--resume",
    is_flag=True,
    help="Go on from the part file of an interrupted build of the same grain, optics and --seed; any --paths, "
    "--target-error and --cells, --max-seconds 0 for the table as good as it got.",
)
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
@click.option(
    "--grains",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_grains,
    help="List the built-in grains and their parameters.",
)
def main(  # noqa: PLR0913 - an argument for each option
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
    max_seconds: float | None,
    quality: str | None,
    cells: int | None,
    joint: int | None,
    memory: int | None,
    seed: int,
    max_bounces: int,
    threads: int | None,
    repair: bool,
    repair_any: bool,
    part: tuple[int, int] | None,
    resume: bool,
    quiet: bool,
) -> int:
    """Build the table of GRAIN: "sphere", a built-in grain (see --grains), or a mesh file."""
    exact = grain == "sphere" and not traced
    some = part is not None or resume or paths is not None or max_seconds is not None
    check_numbers(threads=threads)
    for contradiction, text in (
        (eta is not None and material is not None, "give --eta or --material, not both"),
        (eta is not None and wavelength_nm is not None, "--wavelength-nm goes with --material, not with --eta"),
        (traced and grain != "sphere", "--traced is for the exact sphere; every other grain is traced anyway"),
        (exact and some, "the exact sphere takes no paths, chunks, seconds or resuming; add --traced to trace it"),
        (
            part is not None and (target_error is not None or quality is not None),
            "parts cannot know when the whole meets a target: give --paths with --chunk",
        ),
        (
            quality is not None and (paths is not None or target_error is not None),
            "--quality says how much to trace: give it, or --paths or --target-error, not both",
        ),
        ((repair or repair_any) and grain == "sphere", "--repair is for mesh files"),
    ):
        if contradiction:
            raise UsageError(text)

    from tsdf.grain.grains import load_grain

    loaded = beside(lambda: load_grain(grain, repair="any" if repair_any else repair, **settings))

    from tsdf.make import scatterometer, tracer

    if not exact:
        tracer.ahead(load_grain("sphere"))  # machine code, while the grain is read
    optics = optics_of(eta, material, wavelength_nm, fresnel, quiet)
    if quality is not None:
        chosen = QUALITIES[quality]
        target_error = chosen.target_error
        joint = chosen.joint if joint is None else joint
        memory = chosen.memory if memory is None else memory
    joint, memory = joint or 0, memory or 0
    effort = scatterometer.Effort(paths, target_error, cells, joint, seed, max_bounces, memory)
    part_file = out if part is not None else out.with_name(out.name + ".part")
    inputs = [Path(grain), *([Path(material)] if material else [])]
    check_output(out, *inputs, beside=[] if exact or part is not None else [part_file], part=part is not None)
    if not exact and part_file.exists() and not resume:
        if part is not None:
            raise TSDFError(f"{part_file} exists already: add --resume to go on with it, or choose another --out")
        raise TSDFError(f"{part_file} holds an unfinished build: add --resume to go on with it, or delete it")

    shape = loaded()
    for text in shape.notes:
        note(text, quiet)
    if exact:
        finish(scatterometer.exact_sphere(shape, optics, effort), out, quiet)
        return 0

    build = scatterometer.Build.start(shape, optics, effort)
    if resume:
        go_on(build, part_file, paths, max_seconds, quiet)
    try:
        table = trace(
            build, shape, part, part_file, target_error, max_seconds, threads or os.cpu_count() or 1, quiet, quality
        )  # fmt: skip
    except KeyboardInterrupt:
        click.echo(
            f"tsdf-build: error: interrupted: {build.paths} paths are safe in {plain(part_file)}; go on with --resume, "
            "or with --resume --max-seconds 0 for the table as good as it got",
            err=True,
        )
        return interrupt_status()
    short = build.falls_short(part or (1, 1))
    if table is not None:
        finish(table, out, quiet, None if short else part_file)
    elif part is not None and not quiet:
        say(f"{plain(out)}: part {part[0]} of {part[1]}, {build.paths} paths; tsdf-merge makes the table")
    if short:
        note(f"{short}; {plain(part_file)} is kept: --resume goes on")
    return 0


def note(text: str, quiet: bool = False) -> None:
    """Say on standard error what is worth knowing."""
    if not quiet:
        click.echo(f"note: {text}", err=True)


def optics_of(
    eta: float | None, material: str | None, wavelength_nm: float | None, fresnel: str, quiet: bool
) -> "Optics":
    """Return the optics of a grain of this index, or else of this material."""
    from tsdf.grain.optics import Optics

    if eta is not None:
        return Optics(eta, fresnel)

    from tsdf.grain.constants import constants_of

    found = constants_of(
        material or DEFAULT_MATERIAL, DEFAULT_WAVELENGTH_NM if wavelength_nm is None else wavelength_nm
    )
    optics = Optics(found.n, fresnel, found.material, found.wavelength_nm, found.k, found.source)
    if found.k is not None and found.k > 0.01:
        note(f"k is {found.k:.2g}: the reflectance of so dark a surface is taken as if k were 0", quiet)
    return optics


def go_on(build: "Build", part_file: Path, paths: int | None, max_seconds: float | None, quiet: bool) -> None:
    """Let a build begin with the paths of a part file, as --resume says, if there is one."""
    from tsdf.make import scatterometer

    if not part_file.exists():
        if max_seconds == 0.0:
            raise TSDFError(f"{plain(part_file)} is not there: there are no paths to make a table of")
        note(f"{plain(part_file)} is not there: the build begins anew", quiet)
        return
    build.take(scatterometer.Build.load(part_file), plain(part_file))
    if build.paths > (paths or build.paths):
        note(f"{plain(part_file)} holds {build.paths} paths already, and all are used", quiet)


def trace(
    build: "Build",
    shape: "Grain",
    part: tuple[int, int] | None,
    part_file: Path,
    target_error: float | None,
    max_seconds: float | None,
    threads: int,
    quiet: bool,
    quality: str | None = None,
) -> "Table | None":
    """Trace a grain, or one part of what is to be traced of it, and return the table, None of a part.

    Raises
    ------
    KeyboardInterrupt
        Once the paths are in the part file.
    TSDFError
    """

    from tsdf.data.format import get_ready

    def meaning() -> str | None:
        return None if build.done else "nothing is done yet"

    beside(get_ready)
    try:
        with interruptible(meaning, raises=True):
            with shown_progress(quiet) as progress:
                build.run(
                    shape, threads, part or (1, 1), part_file, None if quiet else told(progress, target_error, quality),
                    max_seconds=math.inf if max_seconds is None else max_seconds,
                )  # fmt: skip
            return build.table(as_it_got=max_seconds is not None) if part is None else None
    except GrainError:
        part_file.unlink(missing_ok=True)  # a refused grain cannot be gone on with
        raise
    except UsageError as error:
        other = " instead of --quality" if quality else ""
        raise UsageError(
            f"{error}{other}; its {build.paths} paths are kept in {plain(part_file)}: --resume goes on with them, "
            "--resume --max-seconds 0 makes the table as good as it got"
        ) from None


def finish(table: "Table", out: Path, quiet: bool, part_file: Path | None = None) -> None:
    """Write a finished table, remove its part file, and sum it up on standard output, which may be closed or full."""
    from tsdf.data.format import write

    write(table, out)
    if part_file is not None:
        part_file.unlink(missing_ok=True)
    ledger = table.header["energy_ledger"]
    leak = (ledger["lost"] + ledger["truncated"]) / ledger["launched"]
    if leak > 1e-6:
        click.echo(f"warning: {leak:.1e} of the light was lost or cut off: see energy in tsdf-info", err=True)
    if quiet:
        return
    say(f"{plain(out)}: {plain(table.header['grain']['name'])}")
    for line in summary(table):
        say(line)


def summary(table: "Table") -> Iterator[str]:
    """Yield the lines that sum a finished table up."""
    grain, optics, error = table.header["grain"], table.header["optics"], table.header["table_error"]
    s, errors, ledger = table.statistics, table.header["standard_errors"], table.header["energy_ledger"]
    made_of = f", {plain(optics['material'])} at {optics['wavelength_nm']:g} nm" if optics["material"] else ""
    yield f"  {'eta':40s}{optics['eta']:.6g}{made_of}"
    if grain["kind"] == "mesh":
        unit = "unit of the file" if not grain["parameters"] and "." in grain["name"] else "as built in"
        yield f"  {'bounding radius R':40s}{grain['bounding_radius']:.6g} ({unit})"
        bodies = f", {grain['bodies']} bodies" if grain["bodies"] > 1 else ""
        yield f"  {'shape':40s}{grain['faces']} facets, {'convex' if grain['convex'] else 'not convex'}{bodies}"
        filled = grain["volume"] / (4.0 / 3.0 * math.pi)
        yield f"  {'share of the bounding sphere it fills':40s}{filled:.4f}"
    for label, name in (
        ("hit probability beta", "hit_probability"),
        ("mean cosine g", "mean_cosine"),
        ("mean z, lambda_s [R]", "mean_z"),
        ("mean r [R]", "mean_r"),
        ("mean chord of a miss, lambda_delta [R]", "mean_miss_chord"),
        ("mean path length [R]", "mean_path_length"),
        ("forward atom", "atom_forward"),
    ):
        yield f"  {label:40s}{s[name]:.6f} +- {errors[name]:.1e}"
    if paths := table.header["provenance"]["paths"]:
        yield f"  {'paths, cells of theta':40s}{paths}, {len(table.p_theta) - 2}"
    yield (
        f"  {'total variation to the truth, about':40s}{error['total_variation']:.2g} "
        f"(noise {error['sampling_noise']:.2g}, cells {error['cell_width']:.2g})"
    )
    yield f"  {'light lost or cut off':40s}{(ledger['lost'] + ledger['truncated']) / ledger['launched']:.1e}"
