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

from tsdf.cli.common import check_output, plain, say, setting, threads_option, whole_number
from tsdf.cli.sizes import by_option, measured
from tsdf.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from tsdf.scene.sizes import InWords
    from tsdf.study.spectra import Constants, Family

SUFFIX = ".exr"  # of tables; all else is a grain
DEFAULT_SIZE = ("effective_radius", 2e-4)  # [m] where nothing is said: old snow
TABLE_PATHS = 2_000_000  # of each table that is made
LENGTHS = ("radius", "effective_radius", "volume_radius", "maximum_dimension", "sieve")
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
                         help="As of tsdf-build: ice, water, quartz, salt, glass, sucrose, or your own constants.  "
                         "[default: that of the TABLE, else ice]"),
            click.option("--wavelength-nm", default="300:2500:10", show_default=True, metavar="FROM:TO:STEP|A,B,..",
                         help="Wavelengths [nm], ends included."),
            click.option("--radius", callback=metres, metavar="LENGTH", help="Bounding radius R, 0.5mm say."),
            click.option("--effective-radius", callback=metres, metavar="LENGTH",
                         help="3 V / (4 projected area).  [default: 0.2mm]"),
            click.option("--volume-radius", callback=metres, metavar="LENGTH", help="Of the sphere of equal volume."),
            click.option("--maximum-dimension", callback=metres, metavar="LENGTH", help="Between any two points."),
            click.option("--sieve", callback=metres, metavar="LENGTH", help="Mesh width that grains just pass."),
            click.option("--ssa", type=float, metavar="X", help="Specific surface area [m2/kg]."),
            building,
            click.option("--json", "as_json", is_flag=True, help="Print one JSON object."),
            click.option("--csv", "csv_file", type=click.Path(path_type=Path), metavar="PATH", help="Write columns."),
            click.option("--plot", type=click.Path(path_type=Path), metavar="PATH", help="Chart, .png, .pdf or .svg."),
            click.option("--quiet", is_flag=True, help="No progress bar, no table."),
        )
    ):  # fmt: skip
        command = add(command)
    return command


def is_table(name: str) -> bool:
    """Whether a name stands for a table, by its ending or as a ready one's, and not for a grain.

    Raises
    ------
    FormatError
        It stands for neither, and the nearest name is that of a ready table.
    """
    from difflib import get_close_matches

    from tsdf.data.library import names, ready
    from tsdf.grain.grains import BUILT_INS

    if name.lower().endswith(SUFFIX):
        return True
    if name in BUILT_INS or os.path.exists(name):
        return False
    near = get_close_matches(name.lower(), [*BUILT_INS, *names()], 1)
    return bool(near) and near[0] not in BUILT_INS and ready(name) is not None


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
    settings: Mapping[str, str]
    table_paths: int
    threads: int

    @classmethod
    def of(cls, grains: tuple[str, ...], said: Mapping[str, Any]) -> "Asked":
        """Return them as a command was given them.

        Raises
        ------
        UsageError
        """
        sizes = {name: float(said[name]) for name in (*LENGTHS, "ssa") if said[name] is not None}
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
        threads = said["threads"] or os.cpu_count() or 1
        material = said["material"] or own_material(grains if all(tables) else ())
        return cls(grains, material, said["wavelength_nm"], sizes or dict([DEFAULT_SIZE]), said["settings"],
                   said["table_paths"], threads)  # fmt: skip

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
        return spectra.build(grain, constants.n, effort, threads=self.threads, told=told)

    @property
    def tabulated(self) -> bool:
        """Whether tables are given, and no grain."""
        return is_table(self.grains[0])

    def words(self, family: "Family", solid: Mapping[str, float] | None = None, **amount: float) -> "InWords":
        """Return sizes in metres, and how much of space is filled where that is said.

        `solid` may hold the density of the material.

        Raises
        ------
        UsageError
        """
        from tsdf.scene.sizes import DENSITIES, MATERIAL_DENSITY, convert

        said = dict(self.sizes) | dict(solid or {}) | amount
        if self.material in DENSITIES:
            said = {MATERIAL_DENSITY: DENSITIES[self.material]} | said
        try:
            return convert([(family.tables[0], 1.0)], said, 1.0, amount_needed=bool(amount))
        except UsageError as error:
            raise UsageError(by_option(error)) from None

    def told(self, words: "InWords") -> str:
        """Return how large grains are, for notes."""
        forms = {"radius": "R {:.4g} m", "effective_radius": "effective radius {:.4g} m", "ssa": "SSA {:.4g} m2/kg"}
        facts = words.facts()
        size = ", ".join(form.format(facts[name]) for name, form in forms.items() if facts[name] is not None)
        return size + (" (by default)" if self.sizes == dict([DEFAULT_SIZE]) else "")


def check(asked: Asked, *outputs: Path | None) -> None:
    """Refuse outputs that cannot be written, and pictures of no known kind, before any work is done."""
    written = [path for path in outputs if path is not None]
    if written:
        check_output(written[0], *asked.inputs, beside=written[1:])


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
    """Print columns as JSON or for people, and write them as CSV where that is asked for."""
    from tsdf.files import replacing

    if csv_file is not None:
        with replacing(csv_file) as temporary:
            temporary.write_text(csv_text(columns, notes), encoding="utf-8")
    if as_json:
        values = {name: [number(value) for value in column] for name, column in columns.items()}
        click.echo(json.dumps({**facts, "notes": list(notes), **values}))
    elif not quiet:
        say(text_table(columns, notes))
