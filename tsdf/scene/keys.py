"""Keys: readers of what stands at a key of a scene's text, from a number to an array of tables.

What is wrong is said in one line, which names the scene, the place and the way out.
"""

import difflib
import math
import os
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from tsdf.errors import SceneError
from tsdf.scene.specs import Triple

LARGEST = 1e30  # of any number in a scene, so that squares and products stay finite
FARTHEST = 1e15  # [unit] of any coordinate: the ray engine's numbers are float32
MAX_NAME = 200  # [characters]


class Place(NamedTuple):
    """Where in a scene a value stands."""

    file: str
    table: str
    folder: Path

    def fail(self, what: str) -> NoReturn:
        raise SceneError(": ".join(part for part in (self.file, self.table, what) if part))

    def inside(self, table: str) -> "Place":
        return self._replace(table=f"{self.table}, {table}" if self.table else table)


Reader = Callable[[Any, str, Place], Any]  # (value, its key, its place) -> what it means, or SceneError
_FIELDS = {"light": "lights", "medium": "media", "surface": "surfaces", "grain": "grains"}  # where not the key


class _Brief(reprlib.Repr):
    """Of what is deep or long, no more than can be shown."""

    def repr_int(self, value: int, _: int) -> str:
        return repr(value) if abs(value) <= LARGEST else f"a whole number of {value.bit_length()} bits"


_BRIEF = _Brief()
_BRIEF.maxlist = _BRIEF.maxtuple = _BRIEF.maxdict = 40
_BRIEF.maxstring = _BRIEF.maxother = 60


def shown(value: Any) -> str:
    """Return a short printable rendering of a value."""
    text = str(value).lower() if isinstance(value, bool) else _BRIEF.repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def hint(word: str, valid: Sequence[str]) -> str:
    begun = [name for name in valid if len(word) >= 3 and name.startswith(word)]  # of "packing" the first named
    near = begun or difflib.get_close_matches(word[:MAX_NAME], valid, 1)
    return f"did you mean {near[0]!r}?" if near else f"it is one of {', '.join(valid)}"


def check_keys(value: Any, valid: Sequence[str], at: Place) -> None:
    if not isinstance(value, Mapping):
        at.fail(f"must be a table of keys and values, not {shown(value)}")
    for key in value:
        if key not in valid:
            at.fail(f"unknown key {shown(key)}; {hint(str(key), valid)}")


def as_number(
    low: float = -LARGEST, high: float = LARGEST, above: float = -math.inf, below: float = math.inf, why: str = ""
) -> Reader:
    """Read a number with low <= x <= high and above < x < below; `why` says why, where that is not plain."""
    bounds = [f">= {low:g}"] * (low > -LARGEST) + [f"> {above:g}"] * (above > -math.inf)
    bounds += [f"<= {high:g}"] * (high < LARGEST) + [f"< {below:g}"] * (below < math.inf)

    def read(value: Any, key: str, at: Place) -> float:
        real = isinstance(value, Real) and not isinstance(value, bool)
        if not real:
            at.fail(f"{key} must be a number, not {shown(value)}")
        if not -LARGEST <= value <= LARGEST:
            at.fail(f"{key} must be a finite number of at most {LARGEST:g}, not {shown(value)}")
        if not (low <= value <= high and above < value < below):
            at.fail(f"{key} must be {' and '.join(bounds)}, not {shown(value)}" + f"; {why}" * bool(why))
        return float(value)

    return read


def as_integer(low: int = 0, high: int = 2**63 - 1) -> Reader:
    def read(value: Any, key: str, at: Place) -> int:
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole:
            at.fail(f"{key} must be a whole number, not {shown(value)}")
        if not low <= value <= high:
            at.fail(f"{key} must be from {low} to {high}, not {shown(value)}")
        return int(value)

    return read


def as_flag(value: Any, key: str, at: Place) -> bool:
    """Read true or false."""
    if not isinstance(value, bool):
        at.fail(f"{key} must be true or false, not {shown(value)}")
    return value


def as_text(value: Any, key: str, at: Place) -> str:
    if not isinstance(value, str):
        at.fail(f"{key} must be text, not {shown(value)}")
    return value


def as_name(value: Any, key: str, at: Place) -> str:
    """Read what messages call a thing, as one short printable line."""
    text = as_text(value, key, at)[:MAX_NAME]
    return text if text.isprintable() else ascii(text)[1:-1]


def as_choice(valid: Sequence[str]) -> Reader:
    def read(value: Any, key: str, at: Place) -> str:
        if as_text(value, key, at) not in valid:
            at.fail(f"{key} cannot be {shown(value)}; {hint(value, valid)}")
        return value

    return read


def as_numbers(value: Any, key: str, at: Place, element: Reader) -> tuple[float, ...]:
    if not isinstance(value, list | tuple):
        at.fail(f"{key} must be a list of numbers, not {shown(value)}")
    return tuple(element(item, f"number {i} of {key}", at) for i, item in enumerate(value, 1))


def as_triple(value: Any, key: str, at: Place, element: Reader | None = None) -> Triple:
    if not isinstance(value, list | tuple) or len(value) != 3:
        at.fail(f"{key} must be a list of 3 numbers, not {shown(value)}")
    x, y, z = as_numbers(value, key, at, element or ANY)
    return x, y, z


def as_place(value: Any, key: str, at: Place) -> Triple:
    """Read a place or an extent [unit]."""
    return as_triple(value, key, at, COORDINATE)


def as_colour(high: float = LARGEST) -> Reader:
    """Read linear RGB, each 0 to `high`, from one number for all or a list of three."""
    element = as_number(0.0, high)

    def read(value: Any, key: str, at: Place) -> Triple:
        return as_triple(value if isinstance(value, list | tuple) else [value] * 3, key, at, element)

    return read


def as_file(value: Any, key: str, at: Place) -> Path:
    """Read the path of a file that is there."""
    if not isinstance(value, str | os.PathLike) or not os.fspath(value):
        at.fail(f"{key} must be the path of a file, not {shown(value)}")
    path = at.folder / value
    if not os.path.isfile(path):  # unlike Path.is_file, never raises
        what = "is not a regular file" if os.path.exists(path) else "does not exist"
        at.fail(f"{key} {shown(str(value))} {what}; paths start at the folder of the scene")
    return path


def as_table(kind: type, check: Callable[[Any, Place], Any] | None = None, /, **readers: Reader) -> Reader:
    """Read a table into a dataclass; `check` returns the instance, or what stands for it, or fails."""
    required = {f.name for f in fields(kind) if f.default is MISSING}

    def read(value: Any, key: str, at: Place) -> Any:
        check_keys(value, tuple(readers), at)
        for name in readers:
            if name not in value and _FIELDS.get(name, name) in required:
                at.fail(f"{name!r} is missing")
        found = {
            _FIELDS.get(name, name): reader(value[name], name, at) for name, reader in readers.items() if name in value
        }
        made = kind(**found)
        return check(made, at) if check else made

    return read


def as_section(table: Reader) -> Reader:
    """Read a table that stands at a key, whose name becomes part of the place."""
    return lambda value, key, at: table(value, key, at.inside(key if at.table else f"[{key}]"))


def as_tagged(**kinds: Reader) -> Reader:
    """Read a table that says in `type` which of `kinds` it is."""

    def read(value: Any, key: str, at: Place) -> Any:
        if not isinstance(value, Mapping):
            at.fail(f"must be a table of keys and values, not {shown(value)}")
        if "type" not in value:
            at.fail(f"'type' is missing; it is one of {', '.join(kinds)}")
        kind = as_choice(tuple(kinds))(value["type"], "type", at)
        return kinds[kind]({name: item for name, item in value.items() if name != "type"}, key, at)

    return read


def as_tables(title: str, table: Reader, most: int, least: int = 0) -> Reader:
    """Read an array of tables, each called by its number and its name or type."""

    def read(value: Any, key: str, at: Place) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or len(value) < least:
            some = "one or more tables" if least else "tables"
            at.fail(f"{key} must be a list of {some}: head each with {title}")
        if len(value) > most:
            at.fail(f"there are {len(value)} {title}, and at most {most} can be; join them")
        found = []
        for i, item in enumerate(value, 1):
            label = item.get("name", item.get("type")) if isinstance(item, Mapping) else None
            known = isinstance(label, str) and label.isprintable() and 0 < len(label) <= 60
            found.append(table(item, key, at.inside(f"{title} {i}" + (f" ({label})" if known else ""))))
        return tuple(found)

    return read


ANY, POSITIVE, NOT_NEGATIVE = as_number(), as_number(above=0.0), as_number(0.0)
COORDINATE = as_number(-FARTHEST, FARTHEST)
