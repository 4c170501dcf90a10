"""Container of tables: an OpenEXR image with a header in JSON, as ``schema/SPEC.md`` lays down.

What sections 2, 6, 7, 8 of it and the first half of 3 ask of every file stands here, whatever the file holds: what
differs from one format to the next is a `Format`. The formats themselves are `format` (grains) and `packing_table`
(packings).

The reader takes the EXR apart itself, on purpose: the OpenEXR binding prints a warning and returns less when
a file is truncated and allocates what a corrupt header asks for, and a specification is only one if it can be
followed without somebody's library. It needs one compression, one channel and one part of EXR. Writing goes
through OpenEXR, so that every table is an image that OpenEXR itself made, and is read back before it takes
its place.
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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from tsdf.archive import begins_part
from tsdf.errors import Finding, FormatError, FormatWarning, TSDFError
from tsdf.files import replacing

MAX_FILE = 2**29  # [bytes]
MAX_SIDE = 2**16
MAX_PIXELS = 2**26
MAX_ATTRIBUTE = 2**20  # [bytes]
MAX_ATTRIBUTES = 128
MAX_DEPTH = 32
MAX_FINDINGS = 50
LINES_PER_CHUNK = 16
MAGIC = b"\x76\x2f\x31\x01"

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
Broken = Iterator[tuple[str, str, str]]  # code, pointer, message
Held = TypeVar("Held")


@dataclass(frozen=True)
class Attribute:
    """One attribute of an EXR header."""

    kind: str
    at: int  # where the value begins in the file
    value: bytes


@dataclass(frozen=True)
class Format(Generic[Held]):
    """What differs between the formats that share the container.

    Parameters
    ----------
    name : str
        What the key `format` of the header says.
    version : str
        MAJOR.MINOR, the newest that is known here.
    attribute : str
        The EXR attribute that holds the header; that of the file's digest is called this and ``_sha256``.
    codes : mapping
        (severity, rule) by code: `rules` and what the format adds to them.
    schema : str
        File of ``tsdf.schema`` that the header obeys.
    specification, command, suffix, what : str
        For messages: the document, the command that makes such files, how they are called, and what one is.
    make : callable
        The table of a header and its pixels.
    manifest : callable
        The rules that a header breaks beyond the schema: of header, width, height, and whether the file is newer.
    values : callable
        The rules that a table breaks.
    """

    name: str
    version: str
    attribute: str
    codes: Mapping[str, tuple[str, str]]
    schema: str
    specification: str
    command: str
    suffix: str
    what: str
    make: Callable[[dict[str, Any], np.ndarray], Held]
    manifest: Callable[[dict[str, Any], int, int, bool], Broken]
    values: Callable[[Held], Broken]

    def way_out(self, code: str) -> str:
        """Return the end of a message."""
        return {
            "FILE_UNREADABLE": "check the name and the permissions",
            "EXR_MAGIC": f"name a {self.suffix} file",
            "EXR_VERSION": f"name a {self.suffix} file",
            "EXR_TRUNCATED": DAMAGED,
            "EXR_NOT_TSDF": f"name a file made by {self.command}",
            "VERSION_MAJOR": "upgrade tsdf-toolkit",
            "VERSION_FEATURE": "upgrade tsdf-toolkit",
            "VERSION_MINOR": "upgrade tsdf-toolkit to use what is new",
            "HASH_FILE": DAMAGED,
        }.get(code, f"what wrote the file does not follow {self.specification}, build it again with {self.command}")

    def finding(self, error: FormatError) -> Finding:
        """Return the finding of an error that names what is wrong, its message completed by the way out."""
        message = f"{error.reason}; {self.way_out(error.code)}"
        return Finding(error.code, self.codes[error.code][0], error.pointer, message)


def rules(attribute: str, name: str, schema: str) -> dict[str, tuple[str, str]]:
    """Return the rules of the container, (severity, rule) by code, for a format as `Format` describes it."""
    return {
        "FILE_UNREADABLE": ("error", "the path names a regular file that can be read"),
        "EXR_MAGIC": ("error", "the file begins with the bytes 76 2f 31 01"),
        "EXR_VERSION": ("error", "the version field is 2 and no flag is set: one part, scan lines, short names"),
        "EXR_TRUNCATED": ("error", "the file holds the whole EXR header and offset table"),
        "EXR_ATTRIBUTE": (
            "error",
            "attributes are well formed, unique and within bounds, the fixed ones as listed",
        ),
        "EXR_NOT_TSDF": ("error", f"the string attribute {attribute} is present"),
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
        "HEADER_SIZE": ("error", f"the attribute {attribute} is at most 2^20 bytes long"),
        "HEADER_JSON": ("error", f"the attribute {attribute} is one JSON object in ASCII that decodes to Unicode text"),
        "HEADER_DUPLICATE_KEY": ("error", "no object of the header has a key twice"),
        "HEADER_NUMBER": ("error", "every number is finite as a double, every integer below 2^63 in magnitude"),
        "HEADER_DEPTH": ("error", "objects and arrays nest at most 32 deep"),
        "HEADER_SCHEMA": ("error", f"the header obeys {schema}"),
        "VERSION_SYNTAX": ("error", f'format is "{name}" and format_version is MAJOR.MINOR'),
        "VERSION_MAJOR": ("error", "the major version is 1"),
        "VERSION_FEATURE": ("error", "every required feature is known to the reader"),
        "VERSION_MINOR": (
            "warning",
            "the minor version is not newer than the reader's; what is new in it is ignored",
        ),
        "HASH_MISSING": (
            "error",
            f"the string attribute {attribute}_sha256 is present: 64 lower-case hexadecimal digits",
        ),
        "HASH_FILE": ("error", f"{attribute}_sha256 is the SHA-256 of the file with these 64 digits replaced by 0"),
        "HASH_PIXELS": ("error", "pixels_sha256 is the SHA-256 of the pixels"),
    }


def read(path: str | os.PathLike[str], form: Format[Held]) -> Held:
    """Return the table in a file.

    Raises
    ------
    FormatError
        If the file cannot be read or breaks a rule; the message names file, rule and place.

    Warns
    -----
    FormatWarning
        If the file follows a newer minor version of the format; the warning is of the caller's caller.
    """
    table, findings = inspect_file(path, form)  # type: ignore[arg-type]  # mypy infers Held | None for Held
    for finding in findings:
        if finding.severity == "error":
            raise FormatError(finding.code, f"{shown(path)}: {finding.message}", finding.pointer)
    for finding in findings:
        warnings.warn(f"{shown(path)}: {finding.code}: {finding.message}", FormatWarning, stacklevel=3)
    assert table is not None
    return table


def inspect(data: bytes, form: Format[Held]) -> tuple[Held | None, list[Finding]]:
    """Return the table that the bytes of a file hold, None if they break a rule, and the findings."""
    findings: list[Finding] = []
    try:
        return _table(data, form, findings), findings
    except FormatError as error:
        return None, [*findings, form.finding(error)]


def inspect_file(path: str | os.PathLike[str], form: Format[Held]) -> tuple[Held | None, list[Finding]]:
    """Return the same for a file."""
    try:
        data = _file_bytes(path)
    except FormatError as error:
        return None, [form.finding(error)]
    return inspect(data, form)


def write(header: dict[str, Any], pixels: np.ndarray, path: str | os.PathLike[str], form: Format[Any]) -> None:
    """Write a table; the same header and pixels give the same bytes.

    A file that is at `path` already is replaced only once the new one is whole and valid. `pixels_sha256` is set here.

    Raises
    ------
    TSDFError
        If the table breaks a rule or the file cannot be written; nothing is left behind.
    """
    try:
        with replacing(path) as temporary:
            _write_checked(header, pixels, temporary, form)
    except (RuntimeError, ValueError, TypeError) as error:  # OpenEXR raises the first
        raise TSDFError(f"cannot write {shown(path)}: {shown(error)}") from error


def get_ready(form: Format[Any]) -> None:
    """Load what writing asks for, which takes as long as all else of it: for a thread beside other work."""
    import OpenEXR  # noqa: F401

    _validator(form.schema)


def _write_checked(header: dict[str, Any], pixels: np.ndarray, path: Path, form: Format[Any]) -> None:
    import OpenEXR

    # OpenEXR writes arrays that are not contiguous wrong, without a word.
    pixels = np.ascontiguousarray(pixels, dtype="<f4")
    if pixels.ndim != 2 or not 0 < pixels.size <= MAX_PIXELS or max(pixels.shape) > MAX_SIDE:
        raise ValueError(f"pixels of shape {pixels.shape} are no table's; SPEC.md states the bounds")
    header = header | {"pixels_sha256": hashlib.sha256(pixels.tobytes()).hexdigest()}
    attributes = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        form.attribute: json.dumps(header, allow_nan=False, sort_keys=True, separators=(",", ":")),
        f"{form.attribute}_sha256": "0" * 64,
    }
    OpenEXR.File(attributes, {"Y": pixels}).write(str(path))
    blank = path.read_bytes()
    try:
        at = _attributes(blank, form.attribute)[0][f"{form.attribute}_sha256"].at
        data = blank[:at] + hashlib.sha256(blank).hexdigest().encode() + blank[at + 64 :]
        findings = inspect(data, form)[1]
    except FormatError as error:
        findings = [form.finding(error)]
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


def shown(value: Any, length: int = 200) -> str:
    """Return a name or text from outside as one printable ASCII line."""
    text = os.fsdecode(value) if isinstance(value, bytes | os.PathLike) else str(value)
    text = text if text.isascii() and text.isprintable() else ascii(text)
    return text if len(text) <= length else f"{text[: length - 3]}..."


def _file_bytes(path: str | os.PathLike[str]) -> bytes:
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise FormatError("FILE_UNREADABLE", "this is not a regular file")
        if status.st_size > MAX_FILE:
            raise FormatError("EXR_SIZE", f"{status.st_size} bytes are more than a table can have", "bytes 0")
        with open(path, "rb") as file:
            return file.read(MAX_FILE)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise FormatError("FILE_UNREADABLE", reason) from None
    except ValueError:
        raise FormatError("FILE_UNREADABLE", "this name cannot be a file's") from None


def _table(data: bytes, form: Format[Held], findings: list[Finding]) -> Held | None:
    """Return the table or None, adding to `findings`; raise where a broken rule hides all others."""
    attributes, end = _attributes(data, form.attribute)
    if form.attribute not in attributes or attributes[form.attribute].kind != "string":
        raise FormatError("EXR_NOT_TSDF", f"an OpenEXR image, but not a {form.what}", "bytes 8")
    header = _header(attributes[form.attribute])
    newer = _version(header, form, findings)
    _check_digest(data, attributes, f"{form.attribute}_sha256")
    width, height = _window(attributes)
    if _collect(findings, form, _broken_schema(header, form.schema, newer)):
        return None
    if _collect(findings, form, form.manifest(header, width, height, newer)):
        return None
    pixels = _pixels(data, end, width, height)
    if hashlib.sha256(pixels.data).hexdigest() != header["pixels_sha256"]:
        raise FormatError("HASH_PIXELS", "the pixels are not those announced", "/pixels_sha256")
    table = form.make(header, pixels)
    return None if _collect(findings, form, form.values(table)) else table


def _collect(findings: list[Finding], form: Format[Any], broken: Broken) -> bool:
    """Add what is broken to the findings, up to a bound; return whether there was anything."""
    before = len(findings)
    for code, place, message in islice(broken, MAX_FINDINGS):
        findings.append(form.finding(FormatError(code, message, place)))
    return len(findings) > before


def _attributes(data: bytes, header: str) -> tuple[dict[str, Attribute], int]:
    """Return the attributes of the EXR header by name, and where it ends; `header` is the one that holds the JSON."""
    if data[:4] != MAGIC:
        kind = " but a part of a build, of which tsdf-merge makes a table" if begins_part(data) else ""
        kind = " but a scene, which tsdf-render and tsdf-plan take" if b"[camera]" in data else kind
        raise FormatError("EXR_MAGIC", f"not an OpenEXR file{kind}", "bytes 0")
    if len(data) < 8:
        raise FormatError("EXR_TRUNCATED", "the file ends too early", f"bytes {len(data)}")
    if data[4:8] != b"\2\0\0\0":
        raise FormatError("EXR_VERSION", f"version field {data[4:8].hex(' ')}; a table has 02 00 00 00", "bytes 4")
    found: dict[str, Attribute] = {}
    at = 8
    while True:
        start = at
        name, at = _text(data, at)
        if not name:
            return found, at
        kind, at = _text(data, at)
        if at + 4 > len(data):
            raise FormatError("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
        size = int.from_bytes(data[at : at + 4], "little")
        at += 4
        if size > MAX_ATTRIBUTE:
            code = "HEADER_SIZE" if name == header else "EXR_ATTRIBUTE"
            message = f"attribute {shown(name)} of {size} bytes is longer than {MAX_ATTRIBUTE}"
            raise FormatError(code, message, f"bytes {start}")
        if name in found or len(found) == MAX_ATTRIBUTES or not kind:
            message = f"attribute {shown(name)} is there twice, one too many or has no type"
            raise FormatError("EXR_ATTRIBUTE", message, f"bytes {start}")
        if at + size > len(data):
            raise FormatError("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
        found[name] = Attribute(kind, at, data[at : at + size])
        at += size


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return the name of at most 31 characters that ends in a zero byte, and where the next thing begins."""
    end = data.find(b"\0", at, at + 32)
    if end >= 0:
        return data[at:end].decode("latin-1"), end + 1
    if at + 32 > len(data):
        raise FormatError("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
    raise FormatError("EXR_ATTRIBUTE", "a name is longer than 31 characters", f"bytes {at}")


def _header(attribute: Attribute) -> dict[str, Any]:
    """Return the header, parsed without faith in its author: its depth, then its syntax, then its keys and numbers."""
    place = f"bytes {attribute.at}"
    if _depth(attribute.value) > MAX_DEPTH:
        raise FormatError("HEADER_DEPTH", f"the header nests deeper than {MAX_DEPTH}", place)
    broken: dict[str, str] = {}  # first message by code; a syntax error further on comes before

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        made = dict(pairs)
        if len(made) < len(pairs):
            seen: set[str] = set()
            twice = next(name for name, _ in pairs if name in seen or seen.add(name))  # type: ignore[func-returns-value]
            broken.setdefault("HEADER_DUPLICATE_KEY", f"an object has the key {shown(ascii(twice))} twice")
        return made

    def integer(text: str) -> int:
        if len(text) > 20 or abs(value := int(text)) >= 2**63:
            broken.setdefault("HEADER_NUMBER", f"{shown(text, 30)} does not fit 64 bits")
            return 0
        return value

    def double(text: str) -> float:
        if not math.isfinite(value := float(text)):
            broken.setdefault("HEADER_NUMBER", f"{shown(text, 30)} is not finite as a double")
            return 0.0
        return value

    try:
        header = json.loads(
            attribute.value.decode("ascii"),
            object_pairs_hook=unique,
            parse_int=integer,
            parse_float=double,
            parse_constant=_no_constant,
        )
        json.dumps(header, ensure_ascii=False).encode()  # refuses half a surrogate pair
    except ValueError as error:
        if isinstance(error, json.JSONDecodeError):
            place = f"bytes {attribute.at + error.pos}"
        raise FormatError("HEADER_JSON", shown(error), place) from None
    if not isinstance(header, dict):
        raise FormatError("HEADER_JSON", "the header is not a JSON object", place)
    for code in ("HEADER_DUPLICATE_KEY", "HEADER_NUMBER"):
        if code in broken:
            raise FormatError(code, broken[code], place)
    return header


def _depth(text: bytes) -> int:
    """Return how many brackets are open at most, outside strings, whatever else is wrong with the text."""
    bare = np.frombuffer(re.sub(rb'"(?:[^"\\]++|\\.)*+"?', b"", text, flags=re.DOTALL), dtype=np.uint8)
    steps = np.isin(bare, list(b"[{")).astype(np.int64) - np.isin(bare, list(b"]}"))
    return int(np.cumsum(steps).max(initial=0))


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


def _version(header: Mapping[str, Any], form: Format[Any], findings: list[Finding]) -> bool:
    """Return whether the file follows a newer minor version, of which unknown keys and blocks are ignored."""
    version = header.get("format_version")
    known_major, known_minor = form.version.split(".")
    number = "(0|[1-9][0-9]*)"
    match = re.fullmatch(rf"{number}\.{number}", version if isinstance(version, str) else "")
    if header.get("format") != form.name or not match:
        message = f'format is not "{form.name}" or format_version not MAJOR.MINOR'
        raise FormatError("VERSION_SYNTAX", message, "/format_version" if not match else "/format")
    major, minor = match.groups()  # of any number of digits, and so compared as text
    version = shown(version, 30)
    if major != known_major:
        message = f"the file has format version {version}, this reads {form.version}"
        raise FormatError("VERSION_MAJOR", message, "/format_version")
    features = header.get("required_features")
    if isinstance(features, list) and features:
        message = f"the file needs the feature {shown(ascii(features[0]))}, unknown here"
        raise FormatError("VERSION_FEATURE", message, "/required_features/0")
    newer = (len(minor), minor) > (len(known_minor), known_minor)
    if newer:
        message = f"format version {version} is newer than {form.version}, and what is new is ignored"
        _collect(findings, form, iter([("VERSION_MINOR", "/format_version", message)]))
    return newer


def _check_digest(data: bytes, attributes: Mapping[str, Attribute], name: str) -> None:
    digest = attributes.get(name)
    if digest is None or digest.kind != "string" or not re.fullmatch(rb"[0-9a-f]{64}", digest.value):
        message = f"the attribute {name} is missing or not 64 lower-case hexadecimal digits"
        raise FormatError("HASH_MISSING", message, f"bytes {digest.at}" if digest else "bytes 8")
    view = memoryview(data)
    true = hashlib.sha256(view[: digest.at])
    true.update(b"0" * 64)
    true.update(view[digest.at + 64 :])
    if true.hexdigest().encode() != digest.value:
        raise FormatError("HASH_FILE", "the bytes of the file do not match its digest", f"bytes {digest.at}")


def _window(attributes: Mapping[str, Attribute]) -> tuple[int, int]:
    """Return width and height of the image after the fixed attributes have been checked."""
    for name, (kind, value, code) in FIXED_ATTRIBUTES.items():
        got = attributes.get(name)
        if got is None or (got.kind, got.value) != (kind, value):
            message = f"attribute {name} is missing or not {kind} {value.hex(' ')}"
            raise FormatError(code, message, f"bytes {got.at}" if got else "bytes 8")
    windows = [attributes.get("dataWindow"), attributes.get("displayWindow")]
    if any(w is None or w.kind != "box2i" or len(w.value) != 16 for w in windows):
        raise FormatError("EXR_WINDOW", "a window is missing or malformed", "bytes 8")
    data, display = (struct.unpack("<4i", w.value) for w in windows if w)
    place = f"bytes {windows[0].at}" if windows[0] else ""
    width, height = data[2] + 1, data[3] + 1
    if data != display or data[:2] != (0, 0) or width < 1 or height < 1:
        message = f"data window {data}, display window {display}: not equal, empty or not at 0, 0"
        raise FormatError("EXR_WINDOW", message, place)
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise FormatError("EXR_SIZE", f"{width} x {height} pixels are more than a table can have", place)
    return width, height


@cache
def _validator(name: str) -> Any:
    from jsonschema import Draft202012Validator
    from jsonschema.validators import extend

    def items(validator: Any, rule: Any, values: Any, schema: Mapping[str, Any]) -> Iterator[Any]:
        # a list that is too long is refused as such, and not looked at for minutes
        if not isinstance(values, list) or len(values) <= schema.get("maxItems", math.inf):
            yield from each(validator, rule, values, schema)

    each = Draft202012Validator.VALIDATORS["items"]
    # JSON Schema counts 1.0 as an integer; SPEC.md does not.
    types = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
    schema = json.loads(resources.files("tsdf.schema").joinpath(name).read_text("ascii"))
    return extend(Draft202012Validator, {"items": items}, type_checker=types)(schema)


def _broken_schema(header: Mapping[str, Any], schema: str, newer: bool) -> Broken:
    for error in _validator(schema).iter_errors(header):
        what = error.message
        if error.validator == "additionalProperties":
            if newer:
                continue
            known = error.schema["properties"]
            what = f"unknown key {next(k for k in error.instance if k not in known and k[:2] != 'x_')!r}"
        place = "".join(f"/{str(step).replace('~', '~0').replace('/', '~1')}" for step in error.absolute_path)
        yield "HEADER_SCHEMA", shown(place), shown(what)


def _pixels(data: bytes, at: int, width: int, height: int) -> np.ndarray:
    """Return the pixels, (height, width) little-endian float32; `at` is where the offset table begins."""
    count = -(-height // LINES_PER_CHUNK)
    if at + 8 * count > len(data):
        raise FormatError("EXR_TRUNCATED", "the file ends too early", f"bytes {at}")
    offsets = struct.unpack_from(f"<{count}Q", data, at)
    place = at + 8 * count
    pixels = bytearray()  # grows with what is there, not with what the header claims
    for i, offset in enumerate(offsets):
        lines = min(LINES_PER_CHUNK, height - i * LINES_PER_CHUNK)
        chunk, length = _unpack(data, place, 4 * width * lines, i * LINES_PER_CHUNK, offset)
        pixels += chunk
        place += length
    if place != len(data):
        raise FormatError("EXR_TRAILING", f"{len(data) - place} bytes after the last chunk", f"bytes {place}")
    array = np.frombuffer(pixels, dtype="<f4").reshape(height, width)
    array.flags.writeable = False
    return array


def _unpack(data: bytes, at: int, size: int, y: int, offset: int) -> tuple[bytes, int]:
    """Return the `size` bytes of pixels of the chunk of scan line `y`, and the length of the chunk."""
    broken = FormatError("EXR_CHUNK", f"the chunk of scan line {y} is not what it should be", f"bytes {at}")
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
