"""Optical constants from a user's own file: a table of wavelength, n and k, or an entry of refractiveindex.info.

Built-in materials are `materials`, whose rules hold between the nodes here too. The only door to PyYAML.
"""

import csv
import math
import re
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tsdf.errors import TSDFError, UsageError
from tsdf.grain.materials import MATERIALS, Medium, OpticalConstants, TableK, optical_constants, table_n

LARGEST = 4_000_000  # bytes of a file; the largest of refractiveindex.info has 2e6
INDEX = (1e-30, 1e30)  # that a table may have (schema/SPEC.md), as `optics.ETA`; and k at most
NM = {"nm": 1.0, "um": 1e3, "µm": 1e3, "μm": 1e3, "m": 1e9}  # [nm]
YAML = (".yml", ".yaml")
WAY_OUT = "give lines of wavelength_nm,n,k under a header that says so (.csv), or a .yml of refractiveindex.info"

Rows = list[tuple[float, float]]  # wavelength [nm] and n or k [1]


def constants_of(material: str, wavelength_nm: float) -> OpticalConstants:
    """Return n and k of a built-in material, or of the file that is named, at a wavelength [nm].

    Raises
    ------
    UsageError
        If there is neither, or the wavelength is out of range.
    TSDFError
        If the file cannot be read.
    """
    return constants_over(material, [wavelength_nm])[0]


def constants_over(material: str, wavelengths_nm: Iterable[float]) -> list[OpticalConstants]:
    """Return n and k as `constants_of` does, at several wavelengths; a file is read once.

    Where k of a file is on a straight line between a row of 0 and a number, `source` says so.
    """
    path = Path(material)
    if material in MATERIALS or not (path.suffix or path.exists()):
        return [optical_constants(material, wavelength) for wavelength in wavelengths_nm]
    medium, k_range_nm = read(path)
    wavelengths = [float(wavelength) for wavelength in wavelengths_nm]
    found = [_at(path, medium, k_range_nm, wavelength) for wavelength in wavelengths]
    if isinstance(medium.k, TableK) and (faint := [w for w in wavelengths if medium.k.from_zero(w)]):
        where = f"{min(faint):g}" + (f" to {max(faint):g}" if len(faint) > 1 else "")
        said = f"{medium.source}; k at {where} nm is linear from a row of k = 0 to the next, elsewhere log k is"
        found = [replace(one, source=said) for one in found]
    return found


def _at(path: Path, medium: Medium, k_range_nm: tuple[float, float], wavelength_nm: float) -> OpticalConstants:
    shortest, longest = medium.range_nm
    if not shortest <= wavelength_nm <= longest:
        raise UsageError(f"{path}: the wavelength must be {shortest:g} to {longest:g} nm, not {wavelength_nm:.10g}")
    n = medium.n(wavelength_nm)
    if not INDEX[0] <= n <= INDEX[1]:
        raise TSDFError(f"{path}: n is {n:g} at {wavelength_nm:g} nm; it must be above 0, {INDEX[0]:g} to {INDEX[1]:g}")
    known = medium.k is not None and k_range_nm[0] <= wavelength_nm <= k_range_nm[1]
    k = medium.k(wavelength_nm) if medium.k is not None and known else None
    if k is not None and not 0.0 <= k <= INDEX[1]:
        raise TSDFError(f"{path}: k is {k:g} at {wavelength_nm:g} nm; it must be 0 to {INDEX[1]:g}")
    return OpticalConstants(n, k, wavelength_nm, _line(path.name), medium.source)


def read(path: Path) -> tuple[Medium, tuple[float, float]]:
    """Return the material that a file describes, and in which range of wavelengths it says k [nm].

    Raises
    ------
    TSDFError
        If it is no such file; the message names the line, or the entry.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("not a regular file")
        if path.stat().st_size > LARGEST:
            raise ValueError(f"more than {LARGEST} bytes")
        text = path.read_bytes().decode("utf-8-sig")
        n, k, source = _yaml(text) if path.suffix.lower() in YAML else _csv(text)
    except FileNotFoundError:
        built_ins = ", ".join(MATERIALS)
        raise TSDFError(f"{path}: no such file, and no built-in material; these are {built_ins}") from None
    except OSError as error:
        raise TSDFError(f"{path}: {error.strerror or error}") from None
    except (UnicodeDecodeError, RecursionError):
        raise TSDFError(f"{path}: not text in UTF-8; {WAY_OUT}") from None
    except ValueError as error:
        raise TSDFError(f"{path}: {error}; {WAY_OUT}") from None
    n_range, n_of = n
    return Medium(n_range, n_of, k[1] if k else None, source or f"file {_line(path.name)}"), k[0] if k else (0.0, 0.0)


Span = tuple[tuple[float, float], Callable[[float], float]]  # where it holds [nm], and n or k of the wavelength [nm]


def _table(rows: Rows, quantity: str, lenient: bool = False) -> Span:
    """Return n or k by its nodes, in any order; whatever is no table of it is refused.

    Published tables are taken as they are (`lenient`): noise below k = 0 as 0, of two values at one wavelength the
    first.
    """
    known: dict[float, float] = {}
    for wavelength, value in rows:
        if not 0.0 < wavelength < math.inf:
            raise ValueError(f"{quantity} at a wavelength of {wavelength:g} nm")
        if lenient and quantity == "k":
            value = max(value, 0.0)
        if not 0.0 <= value < math.inf or (quantity == "n" and value == 0.0):
            raise ValueError(f"{quantity} is {value:g} at {wavelength:g} nm; the index is n - i k, both positive")
        if known.setdefault(wavelength, value) != value and not lenient:
            raise ValueError(f"two values of {quantity} at {wavelength:g} nm")
    nodes = sorted(known)
    values = [known[node] for node in nodes]
    return (nodes[0], nodes[-1]), (table_n if quantity == "n" else TableK)(nodes, values)


def _line(text: str, length: int = 300) -> str:
    """Return text from a file as one printable line."""
    plain = " ".join(re.sub(r"<[^<>]*>", "", text).split())
    return "".join(c for c in plain if c.isprintable())[:length]


# ------------------------------------------------------------------------------------------ tables


def _csv(text: str) -> tuple[Span, Span | None, str]:
    """Read lines of numbers under a header that names wavelength and its unit, n and k; # begins a comment."""
    lines = [(i, line.strip()) for i, line in enumerate(text.splitlines(), 1)]
    comments = [line[1:] for _, line in lines if line.startswith("#")]
    lines = [(i, line) for i, line in lines if line and not line.startswith("#")]
    if not lines:
        raise ValueError("it is empty")
    separator = next((s for s in ";\t," if s in lines[0][1]), " ")

    def fields(line: str) -> list[str]:
        if separator == " ":
            return line.split()
        try:
            return [field.strip() for field in next(csv.reader([line], delimiter=separator))]
        except csv.Error:  # a field of more than 131,072 letters
            return []

    header = [name.lower() for name in fields(lines[0][1])] or [""]
    unit, columns = _header(header, lines[0][0])
    rows: dict[str, Rows] = {name: [] for name in columns}
    for i, line in lines[1:]:
        numbers = [field.replace(",", ".") if separator != "," else field for field in fields(line)]
        try:
            if not numbers or any(numbers[len(header) :]):  # decimal commas between commas, say
                raise ValueError
            wavelength = float(numbers[0]) * unit
            for name, column in columns.items():
                if column < len(numbers) and numbers[column]:  # k may be given for some wavelengths only
                    rows[name].append((wavelength, float(numbers[column])))
        except ValueError:
            raise ValueError(f"line {i}: {_line(line, 40)!r} is not {len(header)} numbers") from None
    if not rows["n"]:
        raise ValueError("there are no lines of numbers")
    k = _table(rows["k"], "k") if rows.get("k") else None
    return _table(rows["n"], "n"), k, _line(comments[0]) if comments else ""


def _header(names: list[str], line: int) -> tuple[float, dict[str, int]]:
    """Return the unit of wavelength [nm] that a header names first, and which columns n and k are."""
    found = re.fullmatch(r"(?:wavelength|lambda|wl)?[ _]*[(\[]?(nm|um|µm|μm|m)[)\]]?", names[0])
    if found is None:
        raise ValueError(f"line {line}: {_line(names[0], 40)!r} does not name wavelength and its unit")
    columns: dict[str, int] = {name: names.index(name) for name in ("n", "k") if name in names}
    if "n" not in columns:
        raise ValueError(f"line {line}: there is no column n")
    if twice := [name for name in columns if names.count(name) > 1]:
        raise ValueError(f"line {line}: there are two columns {twice[0]}")
    return NM[found[1]], columns


# ------------------------------------------------------------------------------------------ refractiveindex.info


def _yaml(text: str) -> tuple[Span, Span | None, str]:
    """Read an entry of refractiveindex.info: the first n and the first k of its DATA."""
    import yaml

    try:
        entry = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"not YAML ({_line(str(error), 100)})") from None
    data = entry.get("DATA") if isinstance(entry, dict) else None
    if not isinstance(data, list) or not all(isinstance(one, dict) for one in data):
        raise ValueError("it has no list DATA")
    n: Span | None = None
    k: Span | None = None
    for one in data:
        kind = str(one.get("type"))
        if kind in ("tabulated nk", "tabulated n", "tabulated k"):
            names = kind.removeprefix("tabulated ")  # letters
            rows = list(_rows(str(one.get("data")), len(names) + 1))
            tables = {name: _table([(row[0], row[i]) for row in rows], name, True) for i, name in enumerate(names, 1)}
            n, k = n or tables.get("n"), k or tables.get("k")
        elif kind.startswith("formula "):
            n = n or _formula(kind, one)
    if n is None:
        raise ValueError("there is no n in its DATA")
    source = entry.get("REFERENCES")
    return n, k, _line(source) if isinstance(source, str) else ""


def _rows(text: str, columns: int) -> Iterator[tuple[float, ...]]:
    for i, line in enumerate(filter(str.strip, text.splitlines()), 1):
        try:
            numbers = tuple(float(word) for word in line.replace(",", " ").split())
        except ValueError:
            numbers = ()
        if len(numbers) != columns:
            raise ValueError(f"row {i} of DATA: {_line(line, 40)!r} is not {columns} numbers")
        yield (numbers[0] * NM["um"], *numbers[1:])


def _formula(kind: str, entry: dict[str, Any]) -> Span:
    """Return n by one of the nine formulas of refractiveindex.info, "Dispersion formulas.pdf"; wavelengths in um."""
    function = FORMULAS.get(kind)
    if function is None:
        raise ValueError(f"{_line(kind, 40)!r} is not one of its formulas 1 to 9")
    limits = _numbers(entry, "wavelength_range") or _numbers(entry, "range")
    c = _numbers(entry, "coefficients")
    if len(limits) != 2 or not 0.0 < limits[0] <= limits[1] or not c:
        raise ValueError(f"{kind}: wavelength_range or coefficients are missing")
    c = (*c, *([0.0] * (FEWEST.get(kind, 1) - len(c))))

    def n(wavelength_nm: float) -> float:
        try:
            value = function(wavelength_nm / NM["um"], c)
        except (ZeroDivisionError, OverflowError):
            return math.nan
        return value if isinstance(value, float) else math.nan  # roots of negative numbers are complex

    return (limits[0] * NM["um"], limits[1] * NM["um"]), n


def _numbers(entry: dict[str, Any], key: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in str(entry.get(key, "")).split())
    except ValueError:
        numbers = (math.nan,)
    if not all(map(math.isfinite, numbers)) or len(numbers) > 100:
        raise ValueError(f"{key}: not numbers")
    return numbers


def _pairs(c: Sequence[float], first: int = 1) -> list[tuple[float, float]]:
    return list(zip(c[first::2], c[first + 1 :: 2], strict=False))


def _retro(w: float, c: Sequence[float]) -> float:
    a = c[0] + c[1] * w**2 / (w**2 - c[2]) + c[3] * w**2
    return float(((1.0 + 2.0 * a) / (1.0 - a)) ** 0.5)


def _herzberger(w: float, c: Sequence[float]) -> float:
    far = 1.0 / (w**2 - 0.028)
    return c[0] + c[1] * far + c[2] * far**2 + c[3] * w**2 + c[4] * w**4 + c[5] * w**6


FEWEST = {"formula 4": 9, "formula 7": 6, "formula 8": 4, "formula 9": 6}  # coefficients; missing ones are 0
FORMULAS: dict[str, Callable[[float, Sequence[float]], Any]] = {
    "formula 1": lambda w, c: (1.0 + c[0] + sum(a * w**2 / (w**2 - b**2) for a, b in _pairs(c))) ** 0.5,  # Sellmeier
    "formula 2": lambda w, c: (1.0 + c[0] + sum(a * w**2 / (w**2 - b) for a, b in _pairs(c))) ** 0.5,
    "formula 3": lambda w, c: (c[0] + sum(a * w**b for a, b in _pairs(c))) ** 0.5,
    "formula 4": lambda w, c: (
        (
            c[0]
            + c[1] * w ** c[2] / (w**2 - c[3] ** c[4])
            + c[5] * w ** c[6] / (w**2 - c[7] ** c[8])
            + sum(a * w**b for a, b in _pairs(c, 9))
        )
        ** 0.5
    ),
    "formula 5": lambda w, c: c[0] + sum(a * w**b for a, b in _pairs(c)),  # Cauchy
    "formula 6": lambda w, c: 1.0 + c[0] + sum(a / (b - w**-2) for a, b in _pairs(c)),  # gases
    "formula 7": _herzberger,
    "formula 8": _retro,
    "formula 9": lambda w, c: (c[0] + c[1] / (w**2 - c[2]) + c[3] * (w - c[4]) / ((w - c[4]) ** 2 + c[5])) ** 0.5,
}
