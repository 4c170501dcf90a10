"""Needs: the tables of a scene, what they lack for a picture, and the commands that make it."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tsdf.data import format as tsdf_format
from tsdf.data import library
from tsdf.data.table import Table
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import Scene
from tsdf.walk.explicit import mesh_beside

ENOUGH = 0.25  # of the error that is asked for that a table may be off by


def of_tables(tables: Sequence[tuple[str, Table]], target: float, level: str, chained: bool = True) -> list[str]:
    """Return what tables need for a picture of an error, one line each.

    Parameters
    ----------
    tables : sequence of (str, Table)
        By the names of their files.
    target : float
        Error of the picture [1].
    level : str
        That is taken.
    chained : bool
        Whether packings are thin enough for the levels that draw from records by entry.
    """
    lines = []
    for name, table in dict(tables).items():
        made = table.header["provenance"]["command"]
        wants: dict[str, str] = {}
        reasons = []
        if chained and not table.memory:
            reasons.append("has no records by entry, which teleport-memory and teleport-packed draw from")
            wants["--memory"] = "64"
        if level == "teleport" and not table.joint:
            loss = table.header["factorisation_error"]["total_variation"]
            reasons.append(f"has no joint records, and offsets drawn apart are {loss:.0%} off")
            wants["--joint"] = "32"
        if LEVELS[level].traits != LEVELS["explicit"].traits:  # which asks no table
            off = table.header["standard_errors"]["mean_cosine"] / max(1.0 - table.mean_cosine(), 1e-6)
            paths = table.header["provenance"].get("paths")
            if off > ENOUGH * target and paths:
                reasons.append(f"knows 1 - g to {off:.1%} only")
                wants["--paths"] = f"{min(paths * (off / (ENOUGH * target)) ** 2, 1e10):.1g}"
            width = table.header["table_error"]["cell_width"]
            if width > target:
                reasons.append(f"has cells of theta so wide that they are {width:.1%} off")
                wants["--cells"] = str(2 * (len(table.header["columns"]["edges"]) - 3))
        if reasons:
            lines.append(f"{name} {' and '.join(reasons)}: {_command(made, name, wants)}")
    return lines


def _command(made: str, name: str, wants: dict[str, str]) -> str:
    """Return the command that made a table, with other options and into a file that is not there yet; or what the
    options are, where it is not known."""
    words = shlex.split(made) if made.startswith("tsdf-build ") else []
    if not words:
        return "build it by tsdf-build with " + " ".join(f"{option} {value}" for option, value in wants.items())
    for option, value in {**wants, "--out": _beside(name, wants)}.items():
        if option in words:
            words[words.index(option) + 1] = value
        else:
            words += [option, value]
    return shlex.join(words)


def _beside(name: str, wants: dict[str, str]) -> str:
    """Return a name for a better table that no file has, beside the one that it is better than; of a ready table in the
    folder one is in."""
    path = Path(name)
    stem = path.name.removesuffix(".exr").removesuffix(".tsdf")
    folder = Path() if path.parent == library.FOLDER else path.parent
    stem += "".join(option.removeprefix("-") for option in wants)
    tried = [f"{stem}.tsdf.exr", *(f"{stem}-{n}.tsdf.exr" for n in range(2, 1000))]
    return str(folder / next((one for one in tried if not (folder / one).exists()), tried[0]))


def loaded(scene: Scene) -> tuple[Scene, list[Table]]:
    """Return a scene that holds its tables, so that they are read once, and these."""
    media, tables = [], []
    for medium in scene.media:
        grains = []
        for grain in medium.grains:
            if isinstance(grain.table, Table):
                table, mesh = grain.table, grain.mesh
            else:
                table = tsdf_format.read(grain.table)
                mesh = grain.mesh or mesh_beside(table, [grain.table.parent])
            tables.append(table)
            grains.append(replace(grain, table=table, mesh=mesh))
        media.append(replace(medium, grains=tuple(grains)))
    return replace(scene, media=tuple(media)), tables
