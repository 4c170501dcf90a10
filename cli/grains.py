"""``tsdf-grains``: a volume of voxels in, a mesh for each grain out."""

import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from tsdf.cli.absorption import METRES
from tsdf.cli.common import Tool, check_output, plain, say, shown_progress
from tsdf.errors import TSDFError, UsageError

if TYPE_CHECKING:
    from tsdf.grain.volumes import Parts, Solid


class Row(NamedTuple):
    """The sizes of a grain [the unit of the voxel size]; `ssa` [m^2/kg] is None without a unit."""

    file: str
    voxels: int
    bounding_radius: float
    area: float
    volume: float
    volume_radius: float  # of the ball of the same volume
    surface_radius: float  # 3 V / S, of the ball of the same surface over volume
    ssa: float | None


def _voxel_size(text: str | None) -> tuple[tuple[float, ...] | None, str | None]:
    """Return the sizes of a voxel along x, y, z and their unit, as --voxel-size says them."""
    if text is None:
        return None, None
    match = re.fullmatch(r"([^a-z]+?)\s*([a-z]+)", text.strip().replace("µ", "u"))
    try:
        sizes = [float(word) for word in match[1].split(",")] if match else []
    except ValueError:
        sizes = []
    sizes = sizes * 3 if len(sizes) == 1 else sizes
    if not match or match[2] not in METRES or len(sizes) != 3 or not all(0 < size < 1e9 for size in sizes):
        raise UsageError(f"--voxel-size is a length > 0 such as 20um, or x,y,z as 20,20,25um, not {plain(text)}")
    return tuple(sizes), match[2]


@click.command("tsdf-grains", cls=Tool)
@click.argument("volume", type=click.Path(path_type=Path))
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="A new or empty folder, for grain-0001.ply and so on, and grains.csv with their sizes.",
)
@click.option(
    "--voxel-size",
    metavar="LENGTH",
    help="Edge of a voxel: 20um (nm, um, mm, cm, m), or along x, y, z: 20,20,25um. Meshes are in that unit.  "
    "[default: what a .vti or .vtk says, without a unit; else 1]",
)
@click.option(
    "--threshold",
    type=float,
    metavar="X",
    help="Voxels above X are material.  [default: of two values the larger is]",
)
@click.option(
    "--smoothing",
    type=click.FloatRange(0.5, 10.0),
    default=2.0,
    show_default=True,
    metavar="VOXELS",
    help="Standard deviation of the filter that takes the stairs of voxels away, 0.5 to 10.",
)
@click.option("--material", default="ice", show_default=True, metavar="NAME", help="Whose density the SSA is of.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def main(
    volume: Path, out: Path, voxel_size: str | None, threshold: float | None, smoothing: float, material: str,
    quiet: bool,
) -> None:  # fmt: skip
    """Write a closed mesh for each grain of VOLUME: .npy, .tif (a stack, or a folder of slices), .vti, legacy .vtk.

    A grain is material that hangs together over faces of voxels. Those that touch the border are left out and counted.
    """
    size, unit = _voxel_size(voxel_size)
    made = _check_folder(out, volume)

    from tsdf.grain import volumes
    from tsdf.scene.sizes import DENSITIES

    if material not in DENSITIES:
        raise UsageError(f"--material: the density of {plain(material)} is not known; known: {', '.join(DENSITIES)}")
    mass = DENSITIES[material] * METRES[unit] if unit else None  # [kg/m^2] of a layer one unit thick
    with shown_progress(quiet) as progress:
        held = volumes.read_volume(volume)
        try:
            solid = volumes.material(held.voxels, threshold)
            found = volumes.parts(solid)
            rows: dict[Row, bytes] = {}
            for one in volumes.solids(found, size or held.spacing or (1.0, 1.0, 1.0), smoothing):
                rows[_row(one, f"grain-{len(rows) + 1:04d}.ply", mass)] = volumes.ply(one.grain)
                progress(len(rows) / len(found.kept), f"{len(rows)} of {len(found.kept)} grains")
        except TSDFError as error:
            raise type(error)(f"{plain(volume)}: {error}") from None
    _write(out, made, {row.file: data for row, data in rows.items()} | {"grains.csv": _csv(list(rows)).encode()})
    if not quiet:
        for line in _summary(
            list(rows), found, float(solid.mean()), unit or ("unit" if held.spacing else "voxel"), mass
        ):
            say(plain(f"{out}: {line}"))


def _check_folder(out: Path, volume: Path) -> bool:
    """See to it that a folder can be written to and is new or empty; return whether it is to be made."""
    if os.path.exists(out):
        try:
            taken = os.listdir(out)
        except OSError as error:
            raise TSDFError(f"--out {plain(out)}: {error.strerror}; give a new or empty folder") from None
        if taken:
            raise UsageError(f"--out {plain(out)} is not empty: grains of two volumes would mix; give a new folder")
        check_output(out / "grains.csv", volume)
        return False
    check_output(out, volume)
    return True


def _write(out: Path, made: bool, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, all or none."""
    from tsdf.files import replacing, whole

    with whole:
        written: list[Path] = []
        try:
            if made:
                out.mkdir()
            for name, data in files.items():
                with replacing(out / name) as temporary:
                    temporary.write_bytes(data)
                written.append(out / name)
        except BaseException:
            for path in written:
                path.unlink(missing_ok=True)
            if made and out.is_dir():
                out.rmdir()
            raise


def _row(one: "Solid", name: str, mass: float | None) -> Row:
    radius = one.grain.bounding_radius
    area, volume = one.grain.area * radius**2, one.grain.volume * radius**3
    ssa = None if mass is None else area / (volume * mass)
    return Row(name, one.voxels, radius, area, volume, (0.75 * volume / math.pi) ** (1 / 3), 3 * volume / area, ssa)


def _csv(rows: list[Row]) -> str:
    """Return the sizes as text, a line for each grain under a header."""
    lines = [",".join("" if value is None else f"{value:.6g}" for value in row[1:]) for row in rows]
    named = [f"{row.file},{line}" for row, line in zip(rows, lines, strict=True)]
    return "\n".join([",".join(Row._fields), *named]) + "\n"


def _summary(rows: list[Row], found: "Parts", share: float, unit: str, mass: float | None) -> Iterator[str]:
    left = [f"{n} {why}" for n, why in ((found.border, "touch the border"), (found.small, "are too small")) if n]
    count = f"{len(rows)} grain{'s' * (len(rows) != 1)}"
    yield f"{count}; left out: {', '.join(left) or 'none'}; solid fraction {share:.4f}"
    area, volume = sum(row.area for row in rows), sum(row.volume for row in rows)
    ssa = "" if mass is None else f", SSA {area / (volume * mass):.4g} m2/kg"
    low, high = min(row.bounding_radius for row in rows), max(row.bounding_radius for row in rows)
    spread = f"{low:.4g}" if len(rows) == 1 else f"{low:.4g} to {high:.4g}"
    yield f"bounding radius {spread} {unit}, 3 V / S {3 * volume / area:.4g} {unit}{ssa}"
