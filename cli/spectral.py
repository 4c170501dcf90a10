"""What commands about spectra share: a grain or its tables, how large it is, wavelengths, and columns of numbers."""

import csv
import io
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from tsdf.cli.common import (
    Output,
    check_outputs,
    plain,
    say,
    setting,
    threads_option,
    whole_number,
    write_text,
)
from tsdf.cli.sizes import by_option, measured
from tsdf.cli.sizes import said as numbers
from tsdf.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from tsdf.scene.sizes import InWords
    from tsdf.study.spectra import Constants, Family

SUFFIX = ".exr"  # of tables; all else is a grain
DEFAULT_SIZE = ("effective_radius", 2e-4)  # [m] where nothing is said: old snow
TABLE_PATHS = 2_000_000  # of each table that is made
LENGTHS = ("radius", "effective_radius", "volume_radius", "maximum_dimension", "sieve")
FRESNEL = {"un": "averaged at each hit", "sp": "polarisations kept apart"}
Command = Callable[..., Any]


def metres(context: click.Context, parameter: click.Parameter, value: str | None) -> float | None:
    """Read a length, "0.2mm" say; without a unit it is in metres."""
    if value is None:
        return None
    number, unit = measured(context, parameter, value)
    if not 0.0 < number < math.inf:
        raise click.BadParameter(f"{value!r} is not a length > 0", context, parameter)
    return number * (unit or 1.0)


def building(command: Command) -> Command:
    """Add the options that say how tables of a grain are made."""
    for add in reversed(
        (
            click.option("--set", "settings", multiple=True, callback=setting, metavar="NAME=VALUE",
                         help="A parameter of a built-in grain; tsdf-build --grains lists them."),
            click.option("--fresnel", type=click.Choice(tuple(FRESNEL)),
                         help="Of tables that are made: reflectance averaged at each hit, or polarisations kept apart, "
                         "which is exact (sphere only).  [default: un]"),
            click.option("--table-paths", callback=whole_number, default=f"{TABLE_PATHS:g}", show_default=True,
                         metavar="N", help="Paths of each table that is made of a GRAIN."),
            threads_option,
        )
    ):  # fmt: skip
        command = add(command)
    return command


def options(command: Command) -> Command:
    """Add the arguments and options that say which grains, how large, of what and at which wavelengths."""
    for add in reversed(
        (
            click.argument("grains", nargs=-1, required=True, metavar="GRAIN|TABLE.."),
            click.option("--material", metavar="NAME|FILE",
                         help="As of tsdf-build: ice, water, quartz, salt, glass, sucrose, or your own constants, of "
                         "which log k is linear between rows, but k next to a row of 0.  [default: that of the TABLE, "
                         "else ice]"),
            click.option("--wavelength-nm", default="300:2500:10", show_default=True, metavar="FROM:TO:STEP|A,B,..",
                         help="Wavelengths [nm], ends included."),
            click.option("--radius", callback=metres, metavar="LENGTH", help="Bounding radius R, 0.5mm say."),
            click.option("--effective-radius", callback=metres, metavar="LENGTH",
                         help="3 V / (4 projected area).  [default: 0.2mm]"),
            click.option("--volume-radius", callback=metres, metavar="LENGTH", help="Of the sphere of equal volume."),
            click.option("--maximum-dimension", callback=metres, metavar="LENGTH", help="Between any two points."),
            click.option("--sieve", callback=metres, metavar="LENGTH", help="Mesh width that grains just pass."),
            click.option("--ssa", type=float, metavar="X", help="Specific surface area [m2/kg]."),
            click.option("--material-density", type=float, metavar="X",
                         help="Of the solid [kg/m3].  [default: that of the --material, else of the TABLE's own]"),
            building,
            click.option("--json", "as_json", is_flag=True, help="Print one JSON object."),
            click.option("--csv", "csv_file", type=click.Path(path_type=Path), metavar="PATH",
                         help="Write columns; - prints them."),
            click.option("--plot", type=click.Path(path_type=Path), metavar="PATH", help="Chart, .png, .pdf or .svg."),
            click.option("--quiet", is_flag=True, help="No progress bar, no table."),
        )
    ):  # fmt: skip
        command = add(command)
    return command


def is_table(name: str) -> bool:
    """Whether a name stands for a table, by its ending or as a ready one's, and not for a grain."""
    from tsdf.data.library import names
    from tsdf.grain.grains import BUILT_INS

    return name.lower().endswith(SUFFIX) or (name in names() and name not in BUILT_INS and not Path(name).exists())


def own_material(tables: Sequence[str]) -> str:
    """Return the material that tables are of; ice where they do not say one, as those of an index alone.

    Raises
    ------
    UsageError
        If they differ, or it is none of the built-in ones.
    TSDFError
        If one cannot be read.
    """
    from tsdf.data import format as tsdf_format
    from tsdf.grain.materials import MATERIALS

    found = {name: tsdf_format.read(name).header["optics"]["material"] for name in tables}
    materials = sorted({material for material in found.values() if material is not None})
    if len(materials) > 1:
        raise UsageError(f"the tables are of {plain(' and '.join(materials))}: say --material")
    if materials and materials[0] not in MATERIALS:
        raise UsageError(f"the table is of {plain(materials[0])}, which is not built in: say --material NAME or FILE")
    return str(materials[0]) if materials else "ice"


class Asked(NamedTuple):
    """Options of `options`, but for those about output."""

    grains: tuple[str, ...]
    material: str
    wavelength_nm: str
    sizes: Mapping[str, float]
    material_density: float | None
    settings: Mapping[str, str]
    fresnel: str
    table_paths: int
    threads: int

    @classmethod
    def of(cls, grains: tuple[str, ...], said: Mapping[str, Any]) -> "Asked":
        """Return them as a command was given them.

        Raises
        ------
        UsageError
        """
        sizes = numbers({name: said[name] for name in (*LENGTHS, "ssa", "material_density")})
        solid = sizes.pop("material_density", None)
        if len(sizes) > 1:
            words = " and ".join("--" + name.replace("_", "-") for name in sizes)
            raise UsageError(f"{words} each say how large the grains are: give one")
        tables = [is_table(grain) for grain in grains]
        if any(tables) and not all(tables):
            raise UsageError("give one GRAIN, or tables of one grain (NAME.tsdf.exr), not both")
        if not any(tables) and len(grains) > 1:
            raise UsageError("give one GRAIN, or tables of one grain (NAME.tsdf.exr) at several indices")
        if any(tables) and said["settings"]:
            raise UsageError("--set shapes a GRAIN that is built, not one whose tables are given")
        if any(tables) and said["fresnel"]:
            raise UsageError("--fresnel is that of tables that are made of a GRAIN, not of those that are given")
        threads = said["threads"] or os.cpu_count() or 1
        material = said["material"] or own_material(grains if all(tables) else ())
        asked = cls(grains, material, said["wavelength_nm"], sizes or dict([DEFAULT_SIZE]), solid, said["settings"],
                    said["fresnel"] or "un", said["table_paths"], threads)  # fmt: skip
        asked.need_density(*sizes)
        return asked

    def need_density(self, *words: str) -> None:
        """Refuse words of mass where nobody says the density of what a grain, whose tables are not made yet, is of.

        Raises
        ------
        UsageError
        """
        if not self.tabulated and "material_density" not in self.solid:
            for word in ("ssa", "density"):
                if word in words:
                    raise UsageError(
                        f"--{word} needs the density of the material, which is not known of {plain(self.material)}: "
                        "say --material-density [kg/m3] too"
                    )

    @property
    def solid(self) -> dict[str, float]:
        """The density of the material by its word, where it is said or known of the constants."""
        from tsdf.scene.sizes import DENSITIES, MATERIAL_DENSITY

        density = self.material_density or DENSITIES.get(self.material)
        return {} if density is None else {MATERIAL_DENSITY: density}

    @property
    def mesh(self) -> Path | None:
        """The file of a grain that is not built in, None where a table or a built-in grain is given."""
        path = Path(self.grains[0])
        return path if not self.tabulated and path.is_file() else None

    @property
    def inputs(self) -> list[Path]:
        """All that is read."""
        return [Path(name) for name in (*self.grains, self.material) if name]

    def constants(self) -> "Constants":
        """Return optical constants at the wavelengths.

        Raises
        ------
        UsageError, TSDFError
        """
        from tsdf.grain.constants import constants_over
        from tsdf.study import spectra

        return spectra.Constants.of(constants_over(self.material, spectra.wavelengths(self.wavelength_nm)))

    def family(
        self, constants: "Constants | None", told: Callable[[float, str], None], seed: int = 0, **records: int
    ) -> "Family":
        """Return the tables that are given, or tables of the grain at the indices that are needed.

        Raises
        ------
        UsageError, TSDFError
        """
        from tsdf.data import format as tsdf_format
        from tsdf.grain.grains import load_grain
        from tsdf.make.scatterometer import Effort
        from tsdf.study import spectra

        if self.tabulated:
            return spectra.Family.of([tsdf_format.read(Path(name)) for name in self.grains])
        assert constants is not None
        grain = load_grain(self.grains[0], False, **self.settings)
        paths = None if grain.kind == "sphere" else self.table_paths
        effort = Effort(paths, seed=seed, **records)
        return spectra.build(grain, constants.n, effort, threads=self.threads, fresnel=self.fresnel, told=told)

    @property
    def tabulated(self) -> bool:
        """Whether tables are given, and no grain."""
        return is_table(self.grains[0])

    def words(self, family: "Family", **amount: float) -> "InWords":
        """Return sizes in metres, and how much of space is filled where that is said, with or without room for spheres.

        Raises
        ------
        UsageError
        """
        from tsdf.scene.sizes import convert

        said = dict(self.sizes) | self.solid | amount
        try:
            return convert([(family.tables[0], 1.0)], said, 1.0, amount_needed=bool(amount), packed=False)
        except UsageError as error:
            raise UsageError(by_option(error)) from None

    def told(self, words: "InWords") -> str:
        """Return how large grains are, for notes."""
        forms = {"radius": "R {:.4g} m", "effective_radius": "effective radius {:.4g} m", "ssa": "SSA {:.4g} m2/kg"}
        facts = words.facts()
        size = ", ".join(form.format(facts[name]) for name, form in forms.items() if facts[name] is not None)
        return size + (" (by default)" if self.sizes == dict([DEFAULT_SIZE]) else "")


def tables_of(family: "Family") -> str:
    """Return which tables are taken, for notes."""
    convention = str(family.tables[0].header["optics"]["fresnel"])
    etas = ", ".join(f"{eta:.5g}" for eta in family.eta)
    return f"tables at n = {etas}, Fresnel {convention} ({FRESNEL.get(convention, convention)})"


def check(asked: Asked, as_json: bool, **outputs: Path | None) -> None:
    """Refuse outputs that cannot be written, by the names of their options, before any work is done; texts may go to
    standard output as `-`, one of them."""
    given = [Output(f"--{name}", path, "" if name == "plot" else "- to print it") for name, path in outputs.items()
             if path is not None]  # fmt: skip
    printed = [f"{output.option} -" for output in given if is_printed(output.path)] + ["--json"] * as_json
    if len(printed) > 1:
        raise UsageError(f"{' and '.join(printed)} both go to standard output: give one, and the others files")
    check_outputs([output for output in given if not is_printed(output.path)], *asked.inputs)


def is_printed(path: Path | None) -> bool:
    """Whether an output is to go to standard output."""
    return path == Path("-")


def write(path: Path | None, text: Callable[[], str]) -> None:
    """Write a text where that is asked for, or print it."""
    if is_printed(path):
        click.echo(text(), nl=False)
    elif path is not None:
        write_text(path, text())


Columns = Mapping[str, "np.ndarray"]


def number(value: float) -> float | None:
    """Return a number for JSON, None for what is not known."""
    return float(value) if math.isfinite(value) else None


def csv_text(columns: Columns, notes: Sequence[str]) -> str:
    """Return columns as CSV under comments."""
    text = io.StringIO()
    text.writelines(f"# {note}\n" for note in notes)
    sheet = csv.writer(text, lineterminator="\n")
    sheet.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        sheet.writerow(["" if number(value) is None else f"{value:.8g}" for value in row])
    return text.getvalue()


def text_table(columns: Columns, notes: Sequence[str]) -> str:
    """Return columns for people, under comments."""
    lines = [f"# {note}" for note in notes]
    width = {name: max(len(name), 10) for name in columns}
    lines.append(" ".join(name.rjust(width[name]) for name in columns))
    for row in zip(*columns.values(), strict=True):
        cells = ("-" if number(value) is None else f"{value:.5g}" for value in row)
        lines.append(" ".join(cell.rjust(width[name]) for name, cell in zip(columns, cells, strict=True)))
    return "\n".join(lines)


def tell(
    columns: Columns, facts: Mapping[str, Any], notes: Sequence[str], as_json: bool, csv_file: Path | None, quiet: bool
) -> None:
    """Print columns as JSON or for people, and write them as CSV where that is asked for; with `quiet` print none."""
    write(csv_file, lambda: csv_text(columns, notes))
    if as_json:
        values = {name: [number(value) for value in column] for name, column in columns.items()}
        click.echo(json.dumps({**facts, "notes": list(notes), **values}))
    elif not quiet:
        say(text_table(columns, notes))
