"""All rows in their order, and how they are measured one after the other."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from tsdf.errors import TSDFError, UsageError
from tsdf.stress import boundaries, ends, numbers, own, rays, slabs
from tsdf.stress.cells import FAILS, HOLDS, METHODS, TRUTH, Cell, Row, Setting, verdict

ROWS: tuple[Row, ...] = (*rays.ROWS, *numbers.ROWS, *ends.ROWS, *slabs.ROWS, *boundaries.ROWS, *own.ROWS)


@dataclass(frozen=True)
class Done:
    """A row and its cells, as many as were measured."""

    row: Row
    cells: tuple[Cell, ...]

    @property
    def seconds(self) -> float:
        return sum(cell.seconds for cell in self.cells)


@dataclass(frozen=True)
class Report:
    """What was measured.

    Attributes
    ----------
    done : tuple of Done
    quick, interrupted : bool
    title : str
        What was judged.
    notes : tuple of str
        Rows that could not be measured at all, one line each.
    """

    done: tuple[Done, ...]
    quick: bool
    interrupted: bool
    title: str
    notes: tuple[str, ...] = ()

    @property
    def broken(self) -> list[tuple[Row, Cell]]:
        """Where a method of ours fails though it is claimed to hold."""
        return [(one.row, cell) for one in self.done for cell in one.cells if one.row.claimed and cell.broken]

    @property
    def known(self) -> list[tuple[Row, Cell]]:
        """Where a method of ours fails as documented."""
        return [(one.row, c) for one in self.done for c in one.cells if c.ours and c.known and c.verdict == FAILS]

    @property
    def better(self) -> list[tuple[Row, Cell]]:
        """Where a method of ours holds though it is documented to fail."""
        return [(one.row, c) for one in self.done for c in one.cells if c.ours and c.known and c.verdict == HOLDS]


def chosen(names: str | None, setting: Setting) -> list[Row]:
    """Return the rows A,B,.. that are asked for, else those of the form; those about one table only where there is one.

    Raises
    ------
    UsageError
        With the row that was likely meant.
    """
    from difflib import get_close_matches

    there = {row.name: row for row in ROWS if row.group != own.GROUP or setting.table is not None}
    if names is None:
        return [row for row in there.values() if row.quick or not setting.quick]
    found = []
    for name in dict.fromkeys(part.strip() for part in names.split(",")):
        if name not in there:
            near = get_close_matches(name.lower(), there, 1)
            hint = f"did you mean {near[0]}?" if near else "see tsdf-stress --help, which lists them"
            if any(row.name == name for row in ROWS):
                hint = "it is about one table: name it"
            raise UsageError(f"--rows: no row {name!r}; {hint}")
        found.append(there[name])
    return found


def cells_of(row: Row, setting: Setting) -> Iterator[Cell]:
    """Yield the cells of a row as they are measured."""
    began = time.process_time()
    for measured in row.measure(setting):
        assert measured.method in METHODS, measured.method
        now = time.process_time()
        known = row.known.get(measured.method, "")
        found = TRUTH if measured.truth else verdict(measured.value, measured.error, row.limit)
        yield Cell(measured, found, known, now - began)
        began = now


def measure(
    rows: Sequence[Row], setting: Setting, title: str = "ready tables",
    told: Callable[[float, str], None] = lambda share, word: None,
) -> Report:  # fmt: skip
    """Return the report of rows; an interrupt keeps the cells that are done.

    Parameters
    ----------
    told : callable
        Called with the share done and the row that is begun.
    """
    done: list[Done] = []
    notes: list[str] = []
    interrupted = False
    for number, row in enumerate(rows):
        cells: list[Cell] = []
        try:
            told(number / len(rows), row.name)
            for cell in cells_of(row, setting):
                cells.append(cell)
                told((number + 0.5) / len(rows), row.name)
        except TSDFError as error:
            notes.append(f"{row.name}: {error}")
        except KeyboardInterrupt:
            interrupted = True
        if cells:
            done.append(Done(row, tuple(cells)))
        if interrupted:
            break
    return Report(tuple(done), setting.quick, interrupted, title, tuple(notes))
