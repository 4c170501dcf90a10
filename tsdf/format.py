"""The bytes of a table: reads and writes ``name.tsdf.exr``, as ``schema/SPEC.md`` lays down.

The reader takes the EXR apart itself, on purpose: the OpenEXR binding prints a warning and returns less when
a file is truncated and allocates what a corrupt header asks for, and a specification is only one if it can be
followed without somebody's library. It needs one compression, one channel and one part of EXR. Writing goes
through OpenEXR, so that every table is an image that OpenEXR itself made, and is read back before it takes
its place. What a table is stands in `table`; whether its numbers are plausible physics, in `validate`.
"""

import hashlib
import json
import math
import os
import re
import stat
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.errors import Finding, FormatError, FormatWarning, TSDFError
from tsdf.files import replacing
from tsdf.table import CONDITIONALS, FORMAT_VERSION, RECORD_FIELDS, Table, thawed

# code: (severity, rule). The set is closed; SPEC.md lists it and `reference_data/golden` breaks each of them.
CODES = {
    "FILE_UNREADABLE": ("error", "the path names a regular file that can be read"),
    "EXR_MAGIC": ("error", "the file begins with the bytes 76 2f 31 01"),
    "EXR_VERSION": ("error", "the version field is 2 and no flag is set: one part, scan lines, short names"),
    "EXR_TRUNCATED": ("error", "the file holds the whole EXR header and offset table"),
    "EXR_ATTRIBUTE": (
        "error",
        "attributes are well formed, unique and within bounds, the fixed ones as listed",
    ),
    "EXR_NOT_TSDF": ("error", "the string attribute tsdf is present"),
    "EXR_CHANNEL": ("error", "there is one channel, Y, of 32-bit floats, not subsampled"),
    "EXR_COMPRESSION": ("error", "the compression is ZIP with 16 scan lines a chunk"),
    "EXR_LINE_ORDER": ("error", "the scan lines are stored in increasing y"),
    "EXR_WINDOW": ("error", "data window and display window are equal, not empty and begin at 0, 0"),
    "EXR_SIZE": (
        "error",
        "the image has at most 65536 columns, 65536 rows and 2^26 pixels, the file 2^29 bytes",
    ),
    "EXR_CHUNK": ("error", "chunks lie gapless in the order of y and each unpacks to exactly its pixels"),
    "EXR_TRAILING": ("error", "the file ends with its last chunk"),
    "HEADER_SIZE": ("error", "the attribute tsdf is at most 2^20 bytes long"),
    "HEADER_JSON": ("error", "the attribute tsdf is one JSON object in ASCII that decodes to Unicode text"),
    "HEADER_DUPLICATE_KEY": ("error", "no object of the header has a key twice"),
    "HEADER_NUMBER": ("error", "every number is finite as a double, every integer below 2^63 in magnitude"),
    "HEADER_DEPTH": ("error", "objects and arrays nest at most 32 deep"),
    "HEADER_SCHEMA": ("error", "the header obeys header.schema.json"),
    "HEADER_LEDGER": ("error", "energy launched is the exact sum of the other entries of the ledger"),
    "VERSION_SYNTAX": ("error", 'format is "tsdf" and format_version is MAJOR.MINOR'),
    "VERSION_MAJOR": ("error", "the major version is 1"),
    "VERSION_FEATURE": ("error", "every required feature is known to the reader"),
    "VERSION_MINOR": (
        "warning",
        "the minor version is not newer than the reader's; what is new in it is ignored",
    ),
    "HASH_MISSING": (
        "error",
        "the string attribute tsdf_sha256 is present: 64 lower-case hexadecimal digits",
    ),
    "HASH_FILE": ("error", "tsdf_sha256 is the SHA-256 of the file with these 64 digits replaced by 0"),
    "HASH_PIXELS": ("error", "pixels_sha256 is the SHA-256 of the pixels"),
    "MANIFEST_ROWS": ("error", "each block begins at the row at which the one before it ends"),
    "MANIFEST_HEIGHT": ("error", "the rows of all blocks are as many as the image has"),
    "MANIFEST_WIDTH": ("error", "the image has as many columns as there are cells of cos theta"),
    "MANIFEST_DUPLICATE": ("error", "no block occurs twice"),
    "MANIFEST_UNKNOWN": ("error", "a file of version 1.0 has only the blocks of version 1.0"),
    "MANIFEST_MISSING": ("error", "p_theta, p_phi, p_r, p_z, p_l and mean_l are present"),
    "MANIFEST_ORDER": ("error", "the blocks stand in the order of the specification"),
    "MANIFEST_MEAN": ("error", "mean_l has as many rows as p_l"),
    "MANIFEST_RECORDS": (
        "error",
        "the six joint blocks are all present with the same number of rows, or all absent",
    ),
    "MANIFEST_EDGE_COUNT": ("error", "a block of masses has one edge more than rows"),
    "MANIFEST_EDGE_ORDER": ("error", "edges ascend; exactly the cells that are atoms have zero width"),
    "MANIFEST_EDGE_ENDS": ("error", "the edges of an axis span its whole range"),
    "VALUE_NOT_FINITE": ("error", "every pixel of a known block is finite"),
    "VALUE_NEGATIVE": ("error", "masses and means are not negative"),
    "VALUE_P_THETA_SUM": ("error", "p_theta sums to 1 within 1e-5"),
    "VALUE_COLUMN_SUM": (
        "error",
        "each conditional sums to 1 within 1e-5 in every column that p_theta can draw",
    ),
    "VALUE_EMPTY_COLUMN": ("error", "a column of which p_theta is 0 is 0 throughout"),
    "VALUE_MEAN_RANGE": ("error", "mean_l lies in its cell of p_l, and is 0 where the mass is 0"),
    "VALUE_RECORD_RANGE": ("error", "records lie in their ranges; entry_azimuth is 0 in the atoms"),
    "VALUE_RECORD_ORDER": ("error", "the records of a column ascend in entry_b2"),
    "VALUE_RECORD_SPHERE": ("error", "entry and exit of every record lie on the bounding sphere within 2e-3"),
}

MAX_FILE = 2**29  # [bytes]
MAX_SIDE = 2**16
MAX_PIXELS = 2**26
MAX_ATTRIBUTE = 2**20  # [bytes]
MAX_ATTRIBUTES = 128
MAX_DEPTH = 32
MAX_FINDINGS = 50
LINES_PER_CHUNK = 16
MAGIC = b"\x76\x2f\x31\x01"
SUM_TOLERANCE = 1e-5  # of float32 masses summed in double
SPHERE_TOLERANCE = 2e-3  # [R^2] float32 loses sqrt(1 - b2) near grazing entry

BLOCKS = ("p_theta", *CONDITIONALS, "mean_l")
RECORDS = tuple(f"joint_{field}" for field in RECORD_FIELDS)
AXIS_ENDS = {"p_r": (0.0, 2.0), "p_z": (-1.0, 2.0)}

# EXR attributes of which type and value are fixed, and the code if they differ.
FIXED_ATTRIBUTES = {
    "channels": ("chlist", b"Y\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"\0", "EXR_CHANNEL"),
    "compression": ("compression", b"\3", "EXR_COMPRESSION"),
    "lineOrder": ("lineOrder", b"\0", "EXR_LINE_ORDER"),
    "pixelAspectRatio": ("float", struct.pack("<f", 1.0), "EXR_ATTRIBUTE"),
    "screenWindowCenter": ("v2f", struct.pack("<2f", 0.0, 0.0), "EXR_ATTRIBUTE"),
    "screenWindowWidth": ("float", struct.pack("<f", 1.0), "EXR_ATTRIBUTE"),
    "type": ("string", b"scanlineimage", "EXR_ATTRIBUTE"),
}
DAMAGED = "the file is damaged or truncated, fetch or build it again"
UNRULY = "what wrote the file does not follow SPEC.md, build it again with tsdf-build"
WAYS_OUT = {  # the end of a message, UNRULY for every other code
    "FILE_UNREADABLE": "check the name and the permissions",
    "EXR_MAGIC": "name a .tsdf.exr file",
    "EXR_VERSION": "name a .tsdf.exr file",
    "EXR_TRUNCATED": DAMAGED,
    "EXR_NOT_TSDF": "name a file made by tsdf-build",
    "VERSION_MAJOR": "upgrade tsdf-toolkit",
    "VERSION_FEATURE": "upgrade tsdf-toolkit",
    "VERSION_MINOR": "upgrade tsdf-toolkit to use what is new",
    "HASH_FILE": DAMAGED,
}

Broken = Iterator[tuple[str, str, str]]  # code, pointer, message


@dataclass(frozen=True)
class Attribute:
    """One attribute of an EXR header."""

    kind: str
    at: int  # where the value begins in the file
    value: bytes


def read(path: str | os.PathLike[str]) -> Table:
    """Return the table in a file.

    Raises
    ------
    FormatError
        If the file cannot be read or breaks a rule of SPEC.md; the message names file, rule and place.

    Warns
    -----
    FormatWarning
        If the file follows a newer minor version of the format.
    """
    table, findings = _inspect_file(path)
    for finding in findings:
        if finding.severity == "error":
            raise FormatError(finding.code, f"{_shown(path)}: {finding.message}", finding.pointer)
    for finding in findings:
        warnings.warn(f"{_shown(path)}: {finding.code}: {finding.message}", FormatWarning, stacklevel=2)
    assert table is not None
    return table


def check(path: str | os.PathLike[str]) -> list[Finding]:
    """Return the broken rules of a file, as many as can be told apart."""
    return _inspect_file(path)[1]


def inspect(data: bytes) -> tuple[Table | None, list[Finding]]:
    """Return the table that the bytes of a file hold, None if they break a rule, and the findings."""
    findings: list[Finding] = []
    try:
        return _table(data, findings), findings
    except FormatError as error:
        return None, [*findings, _finding(error)]


def _inspect_file(path: str | os.PathLike[str]) -> tuple[Table | None, list[Finding]]:
    try:
        return inspect(_file_bytes(path))
    except FormatError as error:
        return None, [_finding(error)]


def write(table: Table, path: str | os.PathLike[str]) -> None:
    """Write a table; the same table gives the same bytes.

    A file that is at `path` already is replaced only once the new one is whole and valid.

    Raises
    ------
    TSDFError
        If the table breaks a rule of SPEC.md or the file cannot be written; nothing is left behind.
    """
    try:
        with replacing(path) as temporary:
            _write_checked(table, temporary)
    except (RuntimeError, ValueError, TypeError) as error:  # OpenEXR raises the first
        raise TSDFError(f"cannot write {_shown(path)}: {_shown(error)}") from error


def _write_checked(table: Table, path: Path) -> None:
    import OpenEXR

    # OpenEXR writes arrays that are not contiguous wrong, without a word; Table holds contiguous ones.
    pixels = np.ascontiguousarray(table.pixels, dtype="<f4")
    header = thawed(table.header)
    if header.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"format_version is {header.get('format_version')!r}, this writes {FORMAT_VERSION}")
    if pixels.ndim != 2 or not 0 < pixels.size <= MAX_PIXELS or max(pixels.shape) > MAX_SIDE:
        raise ValueError(f"pixels of shape {pixels.shape} are no table's; SPEC.md states the bounds")
    header["pixels_sha256"] = hashlib.sha256(pixels.tobytes()).hexdigest()
    attributes = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "tsdf": json.dumps(header, allow_nan=False, sort_keys=True, separators=(",", ":")),
        "tsdf_sha256": "0" * 64,
    }
    path.touch(exist_ok=False)
    OpenEXR.File(attributes, {"Y": pixels}).write(str(path))
    blank = path.read_bytes()
    try:
        at = _attributes(blank)[0]["tsdf_sha256"].at
        data = blank[:at] + hashlib.sha256(blank).hexdigest().encode() + blank[at + 64 :]
        findings = inspect(data)[1]
    except FormatError as error:
        findings = [_finding(error)]
    for finding in findings:
        if finding.code.startswith(("EXR", "HASH")):
            raise OSError("what OpenEXR wrote is not whole")
        what = finding.message.rpartition("; ")[0]
        raise ValueError(f"the table breaks {finding.code} at {finding.pointer}: {what}")
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    if path.read_bytes() != data:
        raise OSError("what was written does not read back")


def _error(code: str, what: str, place: str = "") -> FormatError:
    """Return the error for a broken rule, its message completed by the way out."""
    return FormatError(code, f"{what}; {WAYS_OUT.get(code, UNRULY)}", place)


def _finding(error: FormatError) -> Finding:
    return Finding(error.code, CODES[error.code][0], error.pointer, error.reason)


def _shown(value: Any, length: int = 200) -> str:
    """Return a name or text from outside as one printable ASCII line."""
    text = os.fsdecode(value) if isinstance(value, bytes | os.PathLike) else str(value)
    text = text if text.isascii() and text.isprintable() else ascii(text)
    return text if len(text) <= length else f"{text[: length - 3]}..."


def _file_bytes(path: str | os.PathLike[str]) -> bytes:
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise _error("FILE_UNREADABLE", "this is not a regular file")
        if status.st_size > MAX_FILE:
            raise _error("EXR_SIZE", f"{status.st_size} bytes are more than a table can have", "bytes 0")
        with open(path, "rb") as file:
            return file.read(MAX_FILE)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise _error("FILE_UNREADABLE", reason) from None
    except ValueError:
        raise _error("FILE_UNREADABLE", "this name cannot be a file's") from None


def _table(data: bytes, findings: list[Finding]) -> Table | None:
    """Return the table or None, adding to `findings`; raise where a broken rule hides all others."""
    attributes, end = _attributes(data)
    if "tsdf" not in attributes or attributes["tsdf"].kind != "string":
        raise _error("EXR_NOT_TSDF", "an OpenEXR image, but not a TSDF", "bytes 8")
    header = _header(attributes["tsdf"])
    newer = _version(header, findings)
    _check_digest(data, attributes.get("tsdf_sha256"))
    width, height = _window(attributes)
    if _collect(findings, _broken_schema(header, newer)):
        return None
    if _collect(findings, _broken_manifest(header, width, height, newer)):
        return None
    pixels = _pixels(data, end, width, height)
    if hashlib.sha256(pixels.tobytes()).hexdigest() != header["pixels_sha256"]:
        raise _error("HASH_PIXELS", "the pixels are not those announced", "/pixels_sha256")
    table = Table(header, pixels)
    return None if _collect(findings, _broken_values(table)) else table


def _collect(findings: list[Finding], broken: Broken) -> bool:
    """Add what is broken to the findings, up to a bound; return whether there was anything."""
    before = len(findings)
    for code, place, message in islice(broken, MAX_FINDINGS):
        findings.append(_finding(_error(code, message, place)))
    return len(findings) > before


def _attributes(data: bytes) -> tuple[dict[str, Attribute], int]:
    """Return the attributes of the EXR header by name, and where the header ends."""
    if data[:4] != MAGIC:
        raise _error("EXR_MAGIC", "not an OpenEXR file", "bytes 0")
    if len(data) < 8:
        raise _error("EXR_TRUNCATED", "the file ends too early", f"bytes {len(data)}")
    if data[4:8] != b"\2\0\0\0":
        raise _error("EXR_VERSION", f"version field {data[4:8].hex(' ')}; a table has 02 00 00 00", "bytes 4")
    found: dict[str, Attribute] = {}
    at = 8
    while True:
        start = at
        name, at = _text(data, at)
        if not name:
            return found, at
        kind, at = _text(data, at)
        if at + 4 > len(data):
            raise _error("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
        size = int.from_bytes(data[at : at + 4], "little")
        at += 4
        if size > MAX_ATTRIBUTE:
            code = "HEADER_SIZE" if name == "tsdf" else "EXR_ATTRIBUTE"
            message = f"attribute {_shown(name)} of {size} bytes is longer than {MAX_ATTRIBUTE}"
            raise _error(code, message, f"bytes {start}")
        if name in found or len(found) == MAX_ATTRIBUTES or not kind:
            message = f"attribute {_shown(name)} is there twice, one too many or has no type"
            raise _error("EXR_ATTRIBUTE", message, f"bytes {start}")
        if at + size > len(data):
            raise _error("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
        found[name] = Attribute(kind, at, data[at : at + size])
        at += size


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return the name of at most 31 characters that ends in a zero byte, and where the next thing begins."""
    end = data.find(b"\0", at, at + 32)
    if end >= 0:
        return data[at:end].decode("latin-1"), end + 1
    if at + 32 > len(data):
        raise _error("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
    raise _error("EXR_ATTRIBUTE", "a name is longer than 31 characters", f"bytes {at}")


def _header(attribute: Attribute) -> dict[str, Any]:
    """Return the header, parsed without faith in its author."""
    place = f"bytes {attribute.at}"
    too_deep = _error("HEADER_DEPTH", f"the header nests deeper than {MAX_DEPTH}", place)
    try:
        header = json.loads(
            attribute.value.decode("ascii"),
            object_pairs_hook=_unique,
            parse_int=_integer,
            parse_float=_double,
            parse_constant=_no_constant,
        )
        level, depth = [header], 0
        while level := [value for value in level if isinstance(value, dict | list)]:
            depth += 1
            if depth > MAX_DEPTH:
                raise too_deep
            level = [item for value in level for item in (value.values() if isinstance(value, dict) else value)]
        json.dumps(header, ensure_ascii=False).encode()  # refuses half a surrogate pair
    except RecursionError:
        raise too_deep from None
    except FormatError as error:  # from a hook, which does not know the place
        raise FormatError(error.code, error.reason, place) from None
    except ValueError as error:
        if isinstance(error, json.JSONDecodeError):
            place = f"bytes {attribute.at + error.pos}"
        raise _error("HEADER_JSON", _shown(error), place) from None
    if not isinstance(header, dict):
        raise _error("HEADER_JSON", "the header is not a JSON object", place)
    return header


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))  # type: ignore[func-returns-value]
        raise _error("HEADER_DUPLICATE_KEY", f"an object has the key {_shown(ascii(twice))} twice")
    return made


def _integer(text: str) -> int:
    if len(text) > 20 or abs(value := int(text)) >= 2**63:
        raise _error("HEADER_NUMBER", f"{_shown(text, 30)} does not fit 64 bits")
    return value


def _double(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise _error("HEADER_NUMBER", f"{_shown(text, 30)} is not finite as a double")
    return value


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


def _version(header: Mapping[str, Any], findings: list[Finding]) -> bool:
    """Return whether the file follows a newer minor version, of which unknown keys and blocks are ignored."""
    version = header.get("format_version")
    known_major, known_minor = map(int, FORMAT_VERSION.split("."))
    number = "(0|[1-9][0-9]{0,3})"
    match = re.fullmatch(rf"{number}\.{number}", version if isinstance(version, str) else "")
    if header.get("format") != "tsdf" or not match:
        message = 'format is not "tsdf" or format_version not MAJOR.MINOR'
        raise _error("VERSION_SYNTAX", message, "/format_version" if not match else "/format")
    major, minor = map(int, match.groups())
    if major != known_major:
        message = f"the file has format version {version}, this reads {FORMAT_VERSION}"
        raise _error("VERSION_MAJOR", message, "/format_version")
    features = header.get("required_features")
    if isinstance(features, list) and features:
        message = f"the file needs the feature {_shown(ascii(features[0]))}, unknown here"
        raise _error("VERSION_FEATURE", message, "/required_features/0")
    if minor > known_minor:
        message = f"format version {version} is newer than {FORMAT_VERSION}, and what is new is ignored"
        _collect(findings, iter([("VERSION_MINOR", "/format_version", message)]))
    return minor > known_minor


def _check_digest(data: bytes, digest: Attribute | None) -> None:
    if digest is None or digest.kind != "string" or not re.fullmatch(rb"[0-9a-f]{64}", digest.value):
        message = "the attribute tsdf_sha256 is missing or not 64 lower-case hexadecimal digits"
        raise _error("HASH_MISSING", message, f"bytes {digest.at}" if digest else "bytes 8")
    view = memoryview(data)
    true = hashlib.sha256(view[: digest.at])
    true.update(b"0" * 64)
    true.update(view[digest.at + 64 :])
    if true.hexdigest().encode() != digest.value:
        raise _error("HASH_FILE", "the bytes of the file do not match its digest", f"bytes {digest.at}")


def _window(attributes: Mapping[str, Attribute]) -> tuple[int, int]:
    """Return width and height of the image after the fixed attributes have been checked."""
    for name, (kind, value, code) in FIXED_ATTRIBUTES.items():
        got = attributes.get(name)
        if got is None or (got.kind, got.value) != (kind, value):
            message = f"attribute {name} is missing or not {kind} {value.hex(' ')}"
            raise _error(code, message, f"bytes {got.at}" if got else "bytes 8")
    windows = [attributes.get("dataWindow"), attributes.get("displayWindow")]
    if any(w is None or w.kind != "box2i" or len(w.value) != 16 for w in windows):
        raise _error("EXR_WINDOW", "a window is missing or malformed", "bytes 8")
    data, display = (struct.unpack("<4i", w.value) for w in windows if w)
    place = f"bytes {windows[0].at}" if windows[0] else ""
    width, height = data[2] + 1, data[3] + 1
    if data != display or data[:2] != (0, 0) or width < 1 or height < 1:
        message = f"data window {data}, display window {display}: not equal, empty or not at 0, 0"
        raise _error("EXR_WINDOW", message, place)
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise _error("EXR_SIZE", f"{width} x {height} pixels are more than a table can have", place)
    return width, height


@cache
def _validator() -> Any:
    from jsonschema import Draft202012Validator
    from jsonschema.validators import extend

    # JSON Schema counts 1.0 as an integer; SPEC.md does not.
    types = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
    schema = json.loads(resources.files("tsdf.schema").joinpath("header.schema.json").read_text("ascii"))
    return extend(Draft202012Validator, type_checker=types)(schema)


def _broken_schema(header: Mapping[str, Any], newer: bool) -> Broken:
    for error in _validator().iter_errors(header):
        what = error.message
        if error.validator == "additionalProperties":
            if newer:
                continue
            known = error.schema["properties"]
            what = f"unknown key {next(k for k in error.instance if k not in known and k[:2] != 'x_')!r}"
        place = "".join(f"/{str(step).replace('~', '~0').replace('/', '~1')}" for step in error.absolute_path)
        yield "HEADER_SCHEMA", _shown(place), _shown(what)


def _broken_manifest(header: Mapping[str, Any], width: int, height: int, newer: bool) -> Broken:
    blocks = header["blocks"]
    names = [block["name"] for block in blocks]
    ledger = header["energy_ledger"]
    parts = sum(ledger[key] for key in ("unscattered", "scattered", "absorbed", "truncated", "lost"))
    if ledger["launched"] != parts:
        message = f"launched is {ledger['launched']}, the others sum to {parts}"
        yield "HEADER_LEDGER", "/energy_ledger/launched", message

    by_name = {block["name"]: block for block in blocks}
    known = [name for name in names if name in BLOCKS + RECORDS]

    row = 0
    for i, block in enumerate(blocks):
        first, name, place = block["first_row"], block["name"], f"/blocks/{i}"
        if first != row:
            yield "MANIFEST_ROWS", f"{place}/first_row", f"it is {first}, but row {row} is next"
        row = first + block["rows"]
        if names.index(name) < i:
            yield "MANIFEST_DUPLICATE", f"{place}/name", f"a second block {name}"
        if name not in known and not newer:
            yield "MANIFEST_UNKNOWN", f"{place}/name", f"version 1.0 has no block {name}"
    if row != height:
        yield "MANIFEST_HEIGHT", "/blocks", f"the blocks have {row} rows, the image {height}"
    if missing := [name for name in BLOCKS if name not in names]:
        yield "MANIFEST_MISSING", "/blocks", f"there is no block {', '.join(missing)}"
    if known != sorted(known, key=(BLOCKS + RECORDS).index):
        yield "MANIFEST_ORDER", "/blocks", "the blocks are not in the order of the specification"
    if len({by_name[name]["rows"] for name in ("p_l", "mean_l") if name in by_name}) > 1:
        yield "MANIFEST_MEAN", "/blocks", "mean_l has not as many rows as p_l"
    counts = [by_name[name]["rows"] for name in RECORDS if name in by_name]
    if counts and (len(counts) < len(RECORDS) or len(set(counts)) > 1):
        yield "MANIFEST_RECORDS", "/blocks", "the joint blocks are not six of equal length"

    edges = header["columns"]["edges"]
    if len(edges) != width + 1:
        yield "MANIFEST_WIDTH", "/columns/edges", f"{len(edges)} edges for {width} columns"
    whole = edges[0] == -1.0 and edges[-1] == 1.0
    yield from _broken_edges("/columns/edges", edges, (0, len(edges) - 2), whole)
    for i, block in enumerate(blocks):
        name, place = block["name"], f"/blocks/{i}/edges"
        if name in CONDITIONALS:
            edges = block["edges"]
            if len(edges) != block["rows"] + 1:
                yield "MANIFEST_EDGE_COUNT", place, f"{len(edges)} edges for {block['rows']} rows"
            first, last = edges[0], edges[-1]
            if name == "p_phi":
                whole = -math.pi <= first <= 0.0 and abs(last - first - 2.0 * math.pi) <= 1e-9
            else:
                whole = (first, last) == AXIS_ENDS.get(name, (0.0, last))
            yield from _broken_edges(place, edges, (0,) if name == "p_l" else (), whole)


def _broken_edges(place: str, edges: Sequence[float], atoms: tuple[int, ...], whole: bool) -> Broken:
    if not whole:
        yield "MANIFEST_EDGE_ENDS", place, f"{edges[0]} to {edges[-1]} is not the range of this axis"
    for i, (low, high) in enumerate(pairwise(edges)):
        if (low != high) if i in atoms else not (low < high):
            kind = "zero" if i in atoms else "positive"
            yield "MANIFEST_EDGE_ORDER", f"{place}/{i + 1}", f"the width of {low} to {high} is not {kind}"


def _pixels(data: bytes, at: int, width: int, height: int) -> np.ndarray:
    """Return the pixels, (height, width) little-endian float32; `at` is where the offset table begins."""
    count = -(-height // LINES_PER_CHUNK)
    if at + 8 * count > len(data):
        raise _error("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
    offsets = struct.unpack_from(f"<{count}Q", data, at)
    place = at + 8 * count
    chunks = []
    for i, offset in enumerate(offsets):
        lines = min(LINES_PER_CHUNK, height - i * LINES_PER_CHUNK)
        chunk, length = _unpack(data, place, 4 * width * lines, i * LINES_PER_CHUNK, offset)
        chunks.append(chunk)
        place += length
    if place != len(data):
        raise _error("EXR_TRAILING", f"{len(data) - place} bytes after the last chunk", f"bytes {place}")
    return np.frombuffer(b"".join(chunks), dtype="<f4").reshape(height, width)


def _unpack(data: bytes, at: int, size: int, y: int, offset: int) -> tuple[bytes, int]:
    """Return the `size` bytes of pixels of the chunk of scan line `y`, and the length of the chunk."""
    broken = _error("EXR_CHUNK", f"the chunk of scan line {y} is not what it should be", f"bytes {at}")
    if offset != at or at + 8 > len(data):
        raise broken
    line, length = struct.unpack_from("<iI", data, at)
    packed = data[at + 8 : at + 8 + length]
    if line != y or not 0 < length <= size or len(packed) < length:
        raise broken
    if length == size:  # packing did not help, and the pixels are stored as they are
        return packed, 8 + length
    stream = zlib.decompressobj()
    try:
        plain = stream.decompress(packed, size + 1)
    except zlib.error:
        raise broken from None
    if len(plain) != size or not stream.eof or stream.unused_data:
        raise broken
    bytes_ = np.frombuffer(plain, dtype=np.uint8).copy()
    bytes_[1:] += 128  # each byte but the first is the difference to the one before, plus 128, modulo 256
    bytes_ = np.cumsum(bytes_, dtype=np.uint8)
    woven = np.empty_like(bytes_)
    half = (size + 1) // 2
    woven[0::2], woven[1::2] = bytes_[:half], bytes_[half:]
    return woven.tobytes(), 8 + length


def _broken_values(table: Table) -> Broken:
    """Rules of the pixels, (code, place of the first breach, message); not finite ones hide all others."""
    blocks = [block for block in table.header["blocks"] if block["name"] in BLOCKS + RECORDS]
    first_row = {block["name"]: block["first_row"] for block in blocks}

    def breach(code: str, name: str, bad: np.ndarray, what: str) -> Broken:
        if bad.any():
            row, column = np.argwhere(np.atleast_2d(bad))[0]
            message = f"{name}: {what}, here first of {int(np.count_nonzero(bad))}"
            yield code, f"row {first_row[name] + row}, column {column}", message

    infinite = [b["name"] for b in blocks if not np.isfinite(table.block(b["name"])).all()]
    for name in infinite:
        yield from breach("VALUE_NOT_FINITE", name, ~np.isfinite(table.block(name)), "not finite")
    if infinite:
        return
    for name in BLOCKS:
        yield from breach("VALUE_NEGATIVE", name, table.block(name) < 0.0, "negative")
    p_theta = table.p_theta
    if abs(p_theta.sum() - 1.0) > SUM_TOLERANCE:
        message = f"p_theta sums to {p_theta.sum():.9g}"
        yield "VALUE_P_THETA_SUM", f"row {first_row['p_theta']}, column 0", message
    empty = p_theta == 0.0
    for name in CONDITIONALS:
        off = np.abs(table.block(name).sum(axis=0, dtype=np.float64) - 1.0) > SUM_TOLERANCE
        yield from breach("VALUE_COLUMN_SUM", name, off & ~empty, "the column does not sum to 1")
    for name in first_row:
        filled = (table.block(name) != 0.0) & empty
        yield from breach("VALUE_EMPTY_COLUMN", name, filled, "not 0 though p_theta is")

    mean, edges = table.block("mean_l").astype(np.float64), table.edges("p_l")
    upper = np.append(edges[1:-1], math.inf)  # the last cell holds all longer paths too
    outside = (mean * (1 + 1e-6) < edges[:-1, None]) | (mean * (1 - 1e-6) > upper[:, None])
    bad = np.where(table.p_l == 0.0, mean != 0.0, outside)
    yield from breach("VALUE_MEAN_RANGE", "mean_l", bad, "outside its cell or of no mass")

    if not (joint := table.joint):
        return
    pi = float(np.float32(math.pi))
    low = {"r": 0.0, "z": -1.0, "phi_delta": -pi, "l": 0.0, "entry_b2": 0.0, "entry_azimuth": -pi}
    high = {"r": 2.0, "z": 2.0, "phi_delta": pi, "l": math.inf, "entry_b2": 1.0, "entry_azimuth": pi}
    for field, values in joint.items():
        bad = (values < low[field] - 1e-6) | (values > high[field] + 1e-6)
        if field == "entry_azimuth":
            bad[:, [0, -1]] |= values[:, [0, -1]] != 0.0
        yield from breach("VALUE_RECORD_RANGE", f"joint_{field}", bad, "out of range")
    falling = np.zeros(joint["entry_b2"].shape, dtype=bool)
    falling[1:] = np.diff(joint["entry_b2"], axis=0) < 0.0
    yield from breach("VALUE_RECORD_ORDER", "joint_entry_b2", falling, "smaller than the one before")
    r, z, phi_delta, _, b2, azimuth = (joint[field].astype(np.float64) for field in RECORD_FIELDS)
    b2 = np.clip(b2, 0.0, 1.0)
    # With d_in along z and x_i at azimuth 0, phi_d is entry_azimuth and phi_p is phi_delta + phi_d.
    across = r**2 + 2.0 * r * np.sqrt(b2) * np.cos(phi_delta + azimuth)
    off = np.abs(across + z**2 - 2.0 * z * np.sqrt(1.0 - b2)) > SPHERE_TOLERANCE
    yield from breach("VALUE_RECORD_SPHERE", "joint_r", off, "the exit is off the bounding sphere")
