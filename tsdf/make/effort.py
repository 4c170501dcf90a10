"""Effort: how much is traced for a table, and what is kept."""

from dataclasses import asdict, dataclass

from tsdf.errors import UsageError
from tsdf.make import statistics
from tsdf.make import tally as T
from tsdf.make.tracer import MAX_BOUNCES

DEFAULT_PATHS = 4_000_000
DEFAULT_CELLS = 256
MIN_PATHS = 16 * T.REPLICATES  # fewer give no honest standard error
MAX_PATHS = 1 << 36  # 6.9e10: 2^30 in each replicate, whose energy times path length stays below 2^63
MAX_JOINT = 1024


@dataclass(frozen=True)
class Effort:
    """How much to trace and what to keep.

    Parameters
    ----------
    paths : int, optional
        Number of paths, MIN_PATHS .. MAX_PATHS; DEFAULT_PATHS unless there is a target.
    target_error : float, optional
        Stop when the estimated total variation of p_theta is this small; in (0, 1).
    cells : int, optional
        Cells of theta, MIN_CELLS .. MAX_CELLS; DEFAULT_CELLS, or with a target the fewest that meet it.
    joint : int
        Joint records per cell of theta, 0 .. MAX_JOINT.
    seed : int
        0 .. 2^63 - 1.
    max_bounces : int
        Hits after which a path is cut off.
    memory : int
        Records per cell of entry_b2, 0 .. MAX_JOINT; there are as many cells as columns.

    Raises
    ------
    UsageError
        If a value is out of range.

    Examples
    --------
    >>> import tsdf
    >>> tsdf.Effort(paths=1_000_000, joint=32, memory=64).cells is None  # 256 when it is built
    True
    """

    paths: int | None = None
    target_error: float | None = None
    cells: int | None = None
    joint: int = 0
    seed: int = 0
    max_bounces: int = MAX_BOUNCES
    memory: int = 0

    def __post_init__(self) -> None:
        if self.paths is not None and not (MIN_PATHS <= self.paths <= MAX_PATHS):
            raise UsageError(
                f"the number of paths must be {MIN_PATHS} to {MAX_PATHS:.2g}, got {self.paths:.6g}: errors are told "
                f"from {T.REPLICATES} independent samples, and counts must stay exact"
            )
        if self.target_error is not None and not (0.0 < self.target_error < 1.0):
            raise UsageError(f"the target error is a total variation between 0 and 1, got {self.target_error:g}")
        if self.paths is not None and self.target_error is not None:
            raise UsageError("give a number of paths or a target error, not both")
        if self.cells is not None and not (statistics.MIN_CELLS <= self.cells <= statistics.MAX_CELLS):
            raise UsageError(
                f"the cells of theta must be {statistics.MIN_CELLS} to {statistics.MAX_CELLS}, got {self.cells}"
            )
        if not (0 <= self.joint <= MAX_JOINT):
            raise UsageError(f"the joint records per cell must be 0 to {MAX_JOINT}, got {self.joint}")
        if not (0 <= self.memory <= MAX_JOINT):
            raise UsageError(f"the records per cell of entry must be 0 to {MAX_JOINT}, got {self.memory}")
        if not (0 <= self.seed < 1 << 63):
            raise UsageError(f"the seed must be 0 to 2^63 - 1, got {self.seed}")
        if not (1 <= self.max_bounces <= 10**9):
            raise UsageError(f"the bounce limit must be 1 to 1e9, got {self.max_bounces}")

    def resolved(self) -> "Effort":
        """Return the effort with its defaults filled in."""
        values = asdict(self)
        if self.target_error is None:
            values["paths"] = self.paths or DEFAULT_PATHS
            values["cells"] = self.cells or DEFAULT_CELLS
        return Effort(**values)
