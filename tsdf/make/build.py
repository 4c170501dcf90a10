"""A table in one call, for those who write Python: what ``tsdf-build`` does, kept in memory and not interruptible."""

import os
from pathlib import Path

from tsdf.data.table import Table
from tsdf.grain.grains import Grain, load_grain
from tsdf.grain.optics import Optics
from tsdf.make.effort import Effort
from tsdf.make.scatterometer import Build, exact_sphere


def build(
    grain: str | Path | Grain, optics: Optics | float, effort: Effort | None = None, threads: int | None = None
) -> Table:
    """Return the table of a grain: of the exact sphere by quadrature, of all others by tracing paths.

    Parameters
    ----------
    grain : str, Path or Grain
        The name of a built-in grain, a mesh file, or what `load_grain` made of one.
    optics : Optics or float
        The optical constants, or the relative refractive index eta = n_inside / n_outside alone [1].
    effort : Effort, optional
        How much to trace and what to keep; 4 million paths and 256 cells of theta by default.
    threads : int, optional
        Threads that trace, all processors by default; the table does not depend on it.

    Raises
    ------
    GrainError
        If the grain cannot be read, is not a closed simple surface, or loses too much light.
    UsageError
        If a number is out of range or a target error out of reach.

    Examples
    --------
    >>> import tsdf
    >>> table = tsdf.build("cube", 1.31, tsdf.Effort(paths=20_000, cells=32))
    >>> table
    Table(cube, eta=1.31, 34 cells of cos theta)
    >>> tsdf.write(table, "cube.tsdf.exr")
    """
    optics = optics if isinstance(optics, Optics) else Optics(optics)
    effort = effort or Effort()
    shape = grain if isinstance(grain, Grain) else load_grain(grain)
    if shape.kind == "sphere":
        return exact_sphere(shape, optics, effort)
    begun = Build.start(shape, optics, effort)
    begun.run(shape, threads or os.cpu_count() or 1)
    return begun.table()
