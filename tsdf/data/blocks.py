"""Blocks of the format: name, kind, unit, range and version of each, in the one table that reader, writer and `Table`
follow.

What they mean is laid down in ``schema/SPEC.md``. The golden files' generator, the JSON Schema and the C++ reader write
all this down once more, on purpose: they are witnesses.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

LONGEST = 1e30  # [R] of path lengths
TURN = 3.1415927410125732  # pi as the nearest float32, which lies above it


class Block(NamedTuple):
    """What the format says of a block.

    Attributes
    ----------
    name : str
    kind : str
        As the header has it: mass, mean, record or probability.
    unit : str or None
        Of the values, of masses that of their axis; None where the header states none.
    low, high : float
        Range of the values.
    group : str
        Blocks of one group are all present or all absent; of "", the table itself, always present.
    version : str
        Version of the format in which it came.
    quantity : str or None
        What the rows of masses are cells of.
    axis : (float, float) or None
        First and last edge of those cells; infinite where the file says how far they go.
    of : str or None
        The masses whose cells these are the means of.
    """

    name: str
    kind: str
    unit: str | None = None
    low: float = 0.0
    high: float = math.inf
    group: str = ""
    version: str = "1.0"
    quantity: str | None = None
    axis: tuple[float, float] | None = None
    of: str | None = None

    @property
    def field(self) -> str:
        """Name within the group."""
        return self.name.removeprefix(f"{self.group}_")

    def entry(self, first_row: int, rows: int, edges: Sequence[float] | None = None) -> dict[str, Any]:
        """Return what the header says of the block, at these rows of the image, with these edges of its axis."""
        said = {"quantity": self.quantity, "unit": self.unit, "edges": edges, "of": self.of}
        place = {"name": self.name, "kind": self.kind, "first_row": first_row, "rows": rows}
        return place | {key: value for key, value in said.items() if value is not None}


def _records(group: str, version: str, *names: str) -> tuple[Block, ...]:
    """Return the blocks of records of a group, a field each."""
    fields = {
        "r": ("R", 0.0, 2.0),
        "z": ("R", -1.0, 2.0),
        "phi_delta": ("rad", -TURN, TURN),
        "l": ("R", 0.0, LONGEST),
        "entry_b2": ("R^2", 0.0, 1.0),
        "entry_azimuth": ("rad", -TURN, TURN),
        "cos_theta": ("1", -1.0, 1.0),
    }
    return tuple(Block(f"{group}_{name}", "record", *fields[name], group, version) for name in names)


BLOCKS = (  # in the order of the file
    Block("p_theta", "mass"),
    Block("p_phi", "mass", "rad", quantity="phi_delta", axis=(-math.inf, math.inf)),
    Block("p_r", "mass", "R", quantity="r", axis=(0.0, 2.0)),
    Block("p_z", "mass", "R", quantity="z", axis=(-1.0, 2.0)),
    Block("p_l", "mass", "R", quantity="l", axis=(0.0, math.inf)),
    Block("mean_l", "mean", "R", of="p_l"),
    *_records("joint", "1.0", "r", "z", "phi_delta", "l", "entry_b2", "entry_azimuth"),
    Block("memory_hit", "probability", high=1.0, group="memory", version="1.1"),
    *_records("memory", "1.1", "cos_theta", "entry_azimuth", "r", "z", "phi_delta", "l", "entry_b2"),
)
BY_NAME: Mapping[str, Block] = {block.name: block for block in BLOCKS}
NAMES = tuple(BY_NAME)
REQUIRED = tuple(block.name for block in BLOCKS if not block.group)
CONDITIONALS = tuple(block.name for block in BLOCKS if block.axis)  # masses given the column
RECORD_FIELDS = tuple(block.field for block in BLOCKS if block.group == "joint")
MEMORY_FIELDS = tuple(block.field for block in BLOCKS if block.group == "memory" and block.kind == "record")


def _minor(version: str) -> int:
    return int(version.partition(".")[2])


FORMAT_VERSION = max((block.version for block in BLOCKS), key=_minor)  # the newest that this reads


def version_for(names: Iterable[str]) -> str:
    """Return the format version of a table with blocks of these names: the oldest that has them all."""
    return max((BY_NAME[name].version for name in names if name in BY_NAME), key=_minor, default="1.0")


def blocks_of(version: str) -> frozenset[str]:
    """Return the names of the blocks that a file of a version MAJOR.MINOR can have, newer ones but those known here."""
    return frozenset(block.name for block in BLOCKS if _minor(block.version) <= _minor(version))
