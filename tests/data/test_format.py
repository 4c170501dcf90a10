"""The file format: golden files, round trips, and that no damaged file is ever taken for a table."""

import copy
import json
import os
import re
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tsdf
from tsdf.data import container
from tsdf.data import format as fmt
from tsdf.data.blocks import MEMORY_FIELDS
from tsdf.data.table import Table, thawed
from tsdf.errors import FormatError, FormatWarning, TSDFError
from tsdf.reference_data import make_golden

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "reference_data" / "golden"
SPEC = (ROOT / "schema" / "SPEC.md").read_text("utf-8")
VALID, INVALID = make_golden.valid(), make_golden.invalid()
MINIMAL = VALID["minimal"]


def table(name: str = "records") -> Table:
    made, findings = fmt.inspect(VALID[name])
    assert made is not None and not findings
    return made


@cache
def large_file() -> bytes:
    return make_golden.file(*make_golden.table([1] * 130, phi=32, other=32, count=32, joint=True))


def codes(data: bytes) -> list[str]:
    """Return the codes of what is wrong, and check on the way that a table comes only without errors."""
    made, findings = fmt.inspect(data)
    assert (made is None) == any(finding.severity == "error" for finding in findings)
    for finding in findings:
        assert finding.severity == fmt.CODES[finding.code][0]
        assert "\n" not in finding.message + finding.pointer and len(finding.message) < 500
    return [finding.code for finding in findings]


# --- golden files ------------------------------------------------------------------


@pytest.mark.slow
def test_golden_files_are_what_the_script_makes(tmp_path: Path) -> None:
    """Rationale: golden files that nobody can regenerate rot. Every byte, and no file more or less."""
    make_golden.main(tmp_path)
    made = {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    kept = {p.relative_to(GOLDEN): p.read_bytes() for d in ("valid", "invalid") for p in (GOLDEN / d).iterdir()}
    assert made == kept
    assert sum(map(len, kept.values())) < 1e6


@pytest.mark.parametrize("name", VALID)
def test_valid_golden_file(name: str) -> None:
    """Each valid file gives the header and the pixels beside it, bit for bit, and the warnings."""
    expected = json.loads((GOLDEN / "valid" / f"{name}.json").read_text())
    path = GOLDEN / "valid" / f"{name}.tsdf.exr"
    if expected["warnings"]:
        with pytest.warns(FormatWarning, match=re.escape(str(path))):
            got = tsdf.read(path)
    else:
        got = tsdf.read(path)
    assert thawed(got.header) == expected["header"]
    np.testing.assert_array_equal(got.pixels, np.array(expected["pixels"], dtype=np.float32))
    assert [finding.code for finding in fmt.check(path)] == expected["warnings"]


@pytest.mark.parametrize("name", INVALID)
def test_invalid_golden_file(name: str) -> None:
    """Each invalid file breaks the rule it is named after first of all, and `read` raises the first error."""
    path = GOLDEN / "invalid" / f"{name}.tsdf.exr"
    expected = json.loads(path.with_name(f"{name}.json").read_text())["findings"]
    got = [{"code": f.code, "severity": f.severity, "pointer": f.pointer} for f in fmt.check(path)]
    assert got == expected
    assert got[0]["code"] == name.split("-")[0]
    first = next(finding for finding in got if finding["severity"] == "error")
    with pytest.raises(FormatError) as caught:
        tsdf.read(path)
    assert (caught.value.code, caught.value.pointer) == (first["code"], first["pointer"])
    message = str(caught.value)
    assert str(path) in message and "\n" not in message and "; " in message


def test_the_set_of_codes_is_closed() -> None:
    """Every rule is broken by a golden file and listed in SPEC.md in the same words; nothing else is."""
    broken = {name.split("-")[0] for name in INVALID}
    assert broken == set(fmt.CODES) - {"FILE_UNREADABLE"}
    listed = re.findall(r"^\| `([A-Z_]+)` \| (\w+) \| (.*) \|$", SPEC.split("## Annex A")[0], flags=re.M)
    assert {code: (severity, rule) for code, severity, rule in listed} == fmt.CODES
    text = Path(fmt.__file__).read_text() + Path(container.__file__).read_text()
    used = set(re.findall(r'"((?:FILE|EXR|HEADER|VERSION|HASH|MANIFEST|VALUE)_[A-Z_]+)"', text))
    assert used == set(fmt.CODES)


def test_the_worked_example_is_the_golden_file() -> None:
    """The dump in SPEC.md is the file, and its chunk unpacks as shown, by the rules of SPEC.md alone."""
    dump = SPEC.split("```hex\n")[1].split("```")[0]
    rows = re.findall(r"^([0-9a-f]{8})  ((?:[0-9a-f]{2} ?)+)", dump, flags=re.M)
    shown = 0
    for at, digits in rows:
        piece = bytes.fromhex(digits)
        assert MINIMAL[int(at, 16) :].startswith(piece)
        shown += len(piece)
    assert int(rows[-1][0], 16) + len(piece) == len(MINIMAL) and shown > 500
    steps = dict(re.findall(r"^ *(\w+)\b.*?((?:[0-9a-f]{2} ){16})\.\.\.$", SPEC, flags=re.M))
    d = bytearray(zlib.decompress(MINIMAL[0xC37:]))
    assert d.startswith(bytes.fromhex(steps["inflated"]))
    for i in range(1, len(d)):
        d[i] = (d[i - 1] + d[i] - 128) % 256
    assert d.startswith(bytes.fromhex(steps["differences"]))
    half = (len(d) + 1) // 2
    assert d[half:].startswith(bytes.fromhex(steps["second"]))
    pixels = bytearray(len(d))
    for i in range(half):
        pixels[2 * i], pixels[2 * i + 1] = d[i], d[half + i]
    assert pixels.startswith(bytes.fromhex(steps["woven"]))
    assert bytes(pixels) == table("minimal").pixels.tobytes()


def test_the_schema_is_one() -> None:
    """The schema itself is valid, and every key of it is described in the specification."""
    from jsonschema import Draft202012Validator

    schema = json.loads((ROOT / "schema" / "header.schema.json").read_text("ascii"))
    Draft202012Validator.check_schema(schema)
    for name, data in VALID.items():
        made = fmt.inspect(data)[0]
        assert made is not None
        assert "newer" in name or Draft202012Validator(schema).is_valid(thawed(made.header))

    def keys(part: object) -> set[str]:
        if isinstance(part, list):
            return set().union(*map(keys, part))
        if not isinstance(part, dict):
            return set()
        own = set(part.get("properties", ())) if isinstance(part.get("properties"), dict) else set()
        return own.union(*map(keys, part.values()))

    assert not {key for key in keys(schema) if f"`{key}`" not in SPEC and f"`blocks.{key}`" not in SPEC}


def test_a_chunk_is_stored_raw() -> None:
    """Set-up check: the file that is meant to hold a chunk stored as it is does hold one."""
    assert VALID["raw_chunk"].endswith(table("raw_chunk").pixels[16:].tobytes())


# --- writing -----------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in VALID if "newer" not in name])
def test_round_trip(name: str, tmp_path: Path) -> None:
    """What is written is read back; twice the same bytes; the EXR header is the golden script's."""
    one, two = tmp_path / "one.tsdf.exr", tmp_path / "two.tsdf.exr"
    tsdf.write(table(name), one)
    tsdf.write(tsdf.read(one), two)
    assert one.read_bytes() == two.read_bytes()
    got = tsdf.read(two)
    assert got.header == table(name).header
    np.testing.assert_array_equal(got.pixels, table(name).pixels)
    end = VALID[name].index(b"tsdf_sha256") + 22
    assert one.read_bytes()[:end] == VALID[name][:end]
    assert {p.name for p in tmp_path.iterdir()} == {one.name, two.name}


def test_the_order_of_keys_does_not_matter(tmp_path: Path) -> None:
    """Equal tables give equal bytes, whatever the order in which their headers were put together."""
    good = table()
    for i, keys in enumerate((sorted(good.header), sorted(good.header, reverse=True))):
        tsdf.write(Table({key: good.header[key] for key in keys}, good.pixels), tmp_path / str(i))
    assert (tmp_path / "0").read_bytes() == (tmp_path / "1").read_bytes()


@pytest.mark.parametrize("name", VALID)
def test_openexr_reads_the_same_pixels(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Two unrelated readers: OpenEXR's own finds what ours finds, so any EXR viewer does."""
    import OpenEXR

    with OpenEXR.File(str(GOLDEN / "valid" / f"{name}.tsdf.exr")) as file:
        pixels = file.channels()["Y"].pixels
    made = fmt.inspect(VALID[name])[0]
    assert made is not None and pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels, made.pixels)
    assert capfd.readouterr() == ("", "")


def test_arrays_that_are_not_contiguous(tmp_path: Path) -> None:
    """OpenEXR writes transposed and strided arrays wrong without a word; a Table of them must be right."""
    good = table()
    wide = np.repeat(good.pixels, 2, axis=1)
    for pixels in (
        np.asfortranarray(good.pixels),
        wide[:, ::2],
        good.pixels[::-1].copy()[::-1],
        good.pixels.astype(">f4"),
    ):
        path = tmp_path / "a.tsdf.exr"
        tsdf.write(Table(good.header, pixels), path)
        np.testing.assert_array_equal(tsdf.read(path).pixels, good.pixels)


def edited(*path: str | int, value: object, pixels: np.ndarray | None = None) -> Table:
    good = table()
    header = thawed(good.header)
    part = header
    for step in path[:-1]:
        part = part[step]
    part[path[-1]] = value
    return Table(header, good.pixels if pixels is None else pixels)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (edited("optics", "eta", value=-1.0), "HEADER_SCHEMA at /optics/eta"),
        (edited("optics", "eta", value=float("nan")), "not JSON compliant"),
        (edited("optics", "eta", value=np.float32(1.5)), "float32"),
        (edited("format_version", value="1.1"), "format_version"),
        (edited("licence", value="", pixels=2 * table().pixels), "VALUE_P_THETA_SUM"),
        (edited("licence", value="", pixels=table().pixels[0]), "shape"),
        (edited("licence", value="", pixels=np.zeros((0, 4))), "shape"),
        (edited("x_long", value="x" * 2**20), "HEADER_SIZE"),
    ],
)
def test_an_invalid_table_is_refused(broken: Table, message: str, tmp_path: Path) -> None:
    """Nothing is left behind, and what was there stays."""
    path = tmp_path / "t.tsdf.exr"
    path.write_bytes(b"old")
    with pytest.raises(TSDFError, match=message) as caught:
        tsdf.write(broken, path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    """A missing folder, a folder, a fifo, which a rename would replace, and a name too long."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").touch()
    for name in ("no/such", "fifo", ".", "file/inside", "n" * 300, "nul\0"):
        with pytest.raises(TSDFError, match=r"^cannot write ") as caught:
            tsdf.write(table(), f"{tmp_path}/{name}")
        assert "\n" not in str(caught.value)
    assert {p.name for p in tmp_path.iterdir()} == {"fifo", "file"} and (tmp_path / "fifo").is_fifo()


def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    tsdf.write(table(), tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and tsdf.read(tmp_path / "target").pixels.size


@pytest.mark.parametrize("limit", [0, 100, 3000, 4200])
def test_a_full_disk(limit: int, tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk: an error of one line, the old file stays."""
    path = tmp_path / "t.tsdf.exr"
    path.write_bytes(VALID["records"])
    script = (
        "import resource, sys, tsdf, OpenEXR\n"
        "table = tsdf.read(sys.argv[1])\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
        "try:\n    tsdf.write(table, sys.argv[1])\n"
        "except tsdf.TSDFError as error:\n    sys.exit(str(error))\n"
    )
    run = subprocess.run([sys.executable, "-c", script, path], capture_output=True, text=True, check=False)
    assert run.returncode == 1 and run.stdout == ""
    assert run.stderr.count("\n") == 1 and run.stderr.startswith(f"cannot write {path}: ")
    assert path.read_bytes() == VALID["records"] and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("cut", [10, 3000, -30, -1])
def test_openexr_that_writes_too_little(cut: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: a writer that loses bytes without an error is found out because the file is read back."""
    import OpenEXR

    class Lossy:
        def __init__(self, *args: object) -> None:
            self.file = real(*args)

        def write(self, path: str) -> None:
            self.file.write(path)
            Path(path).write_bytes(Path(path).read_bytes()[:cut])

    real = OpenEXR.File
    monkeypatch.setattr(OpenEXR, "File", Lossy)
    with pytest.raises(TSDFError, match="not whole"):
        tsdf.write(table(), tmp_path / "t.tsdf.exr")
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_loses_what_is_written_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written is flushed to the disk, then read once more before it takes its place."""
    monkeypatch.setattr(os, "fsync", lambda number: os.ftruncate(number, 1000))
    with pytest.raises(TSDFError, match="does not read back"):
        tsdf.write(table(), tmp_path / "t.tsdf.exr")
    assert list(tmp_path.iterdir()) == []


def test_records_by_entry() -> None:
    """By field, and the share that meets the grain; a table without them has none."""
    made = table("memory")
    assert list(made.memory) == list(MEMORY_FIELDS) and made.hit.shape == (6,)
    for field, values in made.memory.items():
        np.testing.assert_array_equal(values, made.block(f"memory_{field}"))
        assert values.shape == (4, 6) and not values.flags.writeable
    assert made.header["format_version"] == "1.1" and made.hit[4] == 0.0 and made.hit[0] == 1.0
    assert not table().memory and table().header["format_version"] == "1.0"


def test_the_exit_follows_from_a_record() -> None:
    """Section 5 of SPEC.md by hand: entry, exit and direction of all records are unit vectors of one path.

    Before the division the exit is off the sphere by what float32 loses; after it by the rounding of a double.
    """
    made = fmt.read(GOLDEN / "checks" / "cube_memory.tsdf.exr")
    memory = {field: values[:, made.hit > 0.0].astype(np.float64) for field, values in made.memory.items()}
    b, a, cosine = np.sqrt(memory["entry_b2"]), memory["entry_azimuth"], memory["cos_theta"]
    sine = np.sqrt(1.0 - cosine**2)
    n_i = np.array((b, 0.0 * b, -np.sqrt(1.0 - memory["entry_b2"])))
    phi_p = a + memory["phi_delta"]
    reached = n_i + np.array((memory["r"] * np.cos(phi_p), memory["r"] * np.sin(phi_p), memory["z"]))
    size = np.sqrt((reached**2).sum(axis=0))
    assert 1e-9 < np.abs(size - 1.0).max() < fmt.SPHERE_TOLERANCE
    n_o, d_out = reached / size, np.array((sine * np.cos(a), sine * np.sin(a), cosine))
    assert np.abs((n_o**2).sum(axis=0) - 1.0).max() < 1e-15 * 4
    assert (n_o * d_out).sum(axis=0).min() > -1e-3  # light leaves outwards, as it came in
    assert n_i[2].max() <= 0.0


def test_which_version_a_file_states(tmp_path: Path) -> None:
    """1.1 without anything new in it can be read, but is not written; nor is anything new as 1.0."""
    header, pixels = make_golden.table(make_golden.WEIGHTS)
    assert codes(make_golden.file({**header, "format_version": "1.1"}, pixels)) == []
    for name, version in (("records", "1.1"), ("memory", "1.0"), ("memory", "1.2")):
        header = {**thawed(table(name).header), "format_version": version}
        with pytest.raises(TSDFError, match="that of its blocks is"):
            tsdf.write(Table(header, table(name).pixels), tmp_path / "t.tsdf.exr")
    assert list(tmp_path.iterdir()) == []


# --- damage ------------------------------------------------------------------------


def test_every_truncation_is_refused() -> None:
    for data in (MINIMAL, VALID["raw_chunk"]):
        assert all(codes(data[:length]) for length in range(len(data)))


@pytest.mark.parametrize(("name", "code"), [("p_theta", "VALUE_P_THETA_SUM"), ("p_r", "VALUE_COLUMN_SUM")])
@pytest.mark.parametrize("excess", [-2e-5, -5e-6, 5e-6, 2e-5])
def test_masses_sum_to_one_as_closely_as_said(name: str, code: str, excess: float) -> None:
    """SPEC.md says 1e-5."""
    header, pixels = make_golden.table(make_golden.WEIGHTS)
    (block,) = (block for block in header["blocks"] if block["name"] == name)
    rows = slice(block["first_row"], block["first_row"] + block["rows"])
    pixels[rows] = pixels[rows].astype(np.float64) * (1.0 + excess)
    assert codes(make_golden.file(header, pixels)) == [code] * (abs(excess) > 1e-5)


@pytest.mark.slow
def test_every_flipped_bit_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    """No bit may be flipped and the file still be taken for a table, unused places included.

    All bits of the container, the digest and the chunk, and two of each byte of the long JSON text.
    """
    data = bytearray(MINIMAL)
    start, end = data.index(b"{"), data.rindex(b"}")
    for at in range(len(data)):
        for bit in {at % 8, (at + 5) % 8} if start < at < end else range(8):
            data[at] ^= 1 << bit
            assert fmt.inspect(bytes(data))[0] is None, f"byte {at}, bit {bit}"
            data[at] ^= 1 << bit
    assert fmt.inspect(bytes(data))[0] is not None  # control: what is flipped back is a table again
    assert capfd.readouterr() == ("", "")


def test_random_damage_is_refused() -> None:
    """Bytes overwritten, inserted, removed, swapped between files: refused, with nothing but a finding."""
    rng = np.random.default_rng(1)
    files = [*VALID.values(), *INVALID.values()]
    for _ in range(2000):
        data = bytearray(files[rng.integers(len(files))])
        other = files[rng.integers(len(files))]
        for _ in range(rng.integers(1, 4)):
            a, b = sorted(rng.integers(0, len(data) + 1, 2))
            match rng.integers(4):
                case 0:
                    data[a : a + 4] = rng.bytes(4)
                case 1:
                    data[a:a] = rng.bytes(int(rng.integers(1, 20)))
                case 2:
                    del data[a : min(b, a + 100)]
                case 3:
                    data[a:b] = other[a:b]
        assert bytes(data) in files or codes(bytes(data))


ODD = [
    None,
    True,
    -1,
    0,
    1,
    2**63 - 1,
    65536,
    0.5,
    1.79e308,
    -1.79e308,
    5e-324,
    "",
    "x",
    "p_l",
    "\0\n",
    "1.1",
    [],
    [0.0],
    {},
    {"x_": 1},
]


@pytest.mark.slow
def test_random_headers_and_pixels() -> None:
    """Hostile authors recompute digests: the answer is a finding, or a table that can be used."""
    rng = np.random.default_rng(2)
    sources = [fmt.inspect(VALID[name])[0] for name in ("minimal", "records", "newer_minor")]
    accepted = 0
    for _ in range(600):
        source = sources[rng.integers(len(sources))]
        assert source is not None
        header, pixels = thawed(source.header), source.pixels.copy()
        del header["pixels_sha256"]
        for _ in range(rng.integers(0, 3)):
            part: Any = header
            while True:
                inner: Any = list(part) if isinstance(part, dict) else range(len(part))
                key = inner[rng.integers(len(inner))]
                if not (isinstance(part[key], dict | list) and part[key] and rng.random() < 0.8):
                    break
                part = part[key]
            match rng.integers(3):
                case 0:
                    part[key] = copy.deepcopy(ODD[rng.integers(len(ODD))])
                case 1:
                    part.pop(key)
                case 2 if isinstance(part, list):
                    part.insert(key, copy.deepcopy(part[rng.integers(len(part))]))
                case 2:
                    part[f"new_{rng.integers(9)}"] = 1
            if not header:
                break
        for _ in range(rng.integers(0, 2)):
            bad = [np.nan, np.inf, -np.inf, 3e38, -1.0, 1e-45, 1.0, 0.0][rng.integers(8)]
            pixels[rng.integers(len(pixels)), rng.integers(pixels.shape[1])] = bad
        data = make_golden.file(header, pixels)
        if not [code for code in codes(data) if code != "VERSION_MINOR"]:
            accepted += 1
            made = fmt.inspect(data)[0]
            assert made is not None
            assert made.deflection_masses(0.1).sum() == pytest.approx(1.0)
    assert 50 < accepted < 300  # both outcomes are tried


@pytest.mark.slow
def test_random_containers() -> None:
    """As above for the EXR part: attributes and chunks changed at random, the digest right."""
    rng = np.random.default_rng(3)
    header, pixels = make_golden.table(make_golden.WEIGHTS, other=3)
    sealed = fmt.inspect(make_golden.file(header, pixels))[0]
    assert sealed is not None
    text = make_golden.text(thawed(sealed.header))
    seen = set()
    for _ in range(600):
        attributes = make_golden.attributes(text, pixels.shape[1], len(pixels))
        chunks = make_golden.chunks(pixels)
        if rng.random() < 0.5:
            name = list(attributes)[rng.integers(len(attributes))]
            kind, value = attributes[name]
            changed = bytearray(value)
            changed[rng.integers(len(changed))] = rng.integers(256)
            attributes[name] = kind, bytes(changed)[: None if rng.random() < 0.7 else -1]
        else:
            which = rng.integers(len(chunks))
            packed = bytearray(chunks[which])
            packed[rng.integers(len(packed))] = rng.integers(256)
            chunks[which] = bytes(packed)[: None if rng.random() < 0.7 else -1]
        seen |= set(codes(make_golden.bind(attributes, chunks)))
    assert seen >= {"EXR_CHUNK", "EXR_WINDOW", "EXR_CHANNEL", "HEADER_JSON", "HASH_PIXELS", "EXR_ATTRIBUTE"}


@pytest.mark.parametrize(
    "name", ["EXR_SIZE", "HEADER_SIZE", "EXR_ATTRIBUTE-claims_4_GB", "EXR_CHUNK-bomb", "HEADER_DEPTH-2001"]
)
def test_memory_is_bounded_by_the_file_not_its_claims(name: str) -> None:
    """Files of a few kB that claim 100 MB must not cost more than 0.5 MB; a large one is the control."""
    fmt.inspect(large_file())
    tracemalloc.start()
    try:
        codes(INVALID[name])
        assert tracemalloc.get_traced_memory()[1] < 5e5
        tracemalloc.reset_peak()
        assert not codes(large_file())
        assert tracemalloc.get_traced_memory()[1] > 5e5
    finally:
        tracemalloc.stop()


def test_a_chunk_that_inflates_too_far() -> None:
    """A chunk of 10 kB that inflates to 10 MB, a thousandfold, is given up after the 16 kB it should have."""
    header, pixels = make_golden.table([1] * 258, count=8, joint=True)
    made, _ = fmt.inspect(make_golden.file(header, pixels))
    assert made is not None
    attributes = make_golden.attributes(make_golden.text(thawed(made.header)), 258, len(pixels))
    bomb = zlib.compress(bytes(10**7), 9)
    chunks = [struct.pack("<iI", 0, len(bomb)) + bomb, *make_golden.chunks(pixels)[1:]]
    data = make_golden.bind(attributes, chunks)
    tracemalloc.start()
    try:
        assert codes(data) == ["EXR_CHUNK"]
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_a_long_hostile_header_takes_bounded_time() -> None:
    """A mebibyte of anything, in a file otherwise right, ends in a finding; no hang, no recursion."""
    header, pixels = make_golden.table(make_golden.WEIGHTS)
    text = make_golden.text({**header, "pixels_sha256": "0" * 64})
    size = 2**20 - len(text) - 20
    for extra in (
        b'"k":1.' + b"3" * size,
        b'"k":' + b"3" * size,
        b'"k":' + b"[" * size,
        b'"k":"' + b'\\"' * (size // 2),
        b",".join(b'"%x":1' % i for i in range(size // 10)),
        b'"x":[' + b",".join([b"{}"] * (size // 3)) + b"]",
        b" " * size + b'"k":1',
    ):
        attributes = make_golden.attributes(text[:-1] + b"," + extra + b"}", pixels.shape[1], len(pixels))
        assert set(codes(make_golden.bind(attributes, make_golden.chunks(pixels)))) <= {
            "HEADER_JSON",
            "HEADER_NUMBER",
            "HEADER_DEPTH",
            "HEADER_SCHEMA",
        }


def test_the_largest_lists_take_bounded_time() -> None:
    """Of lists that are too long it is said so, and no entry is looked at: 28,000 blocks took a minute of processor."""
    header, pixels = make_golden.table(make_golden.WEIGHTS)
    for key, value in (
        ("blocks", [{"name": "a", "first_row": 0, "rows": 1}] * 28_000),
        ("required_features", [""] * 65),
    ):
        start = time.process_time()
        found = codes(make_golden.file({**header, key: value}, pixels))
        assert found == (["HEADER_SCHEMA"] if key == "blocks" else ["VERSION_FEATURE"])
        assert time.process_time() - start < 3.0


def test_memory_of_a_large_image_is_bounded() -> None:
    """A sound file of 60 kB with an image of 16 MB: read in less than three times that, and not held twice."""
    header, pixels = make_golden.table([0] * 1023 + [1], count=2, joint=True)
    rows, parts, count = 0, [], 670
    for block in header["blocks"]:
        own = pixels[block["first_row"] : block["first_row"] + block["rows"]]
        own = np.repeat(own[:1], count, axis=0) if block["name"].startswith("joint_") else own
        block["first_row"], block["rows"] = rows, len(own)
        rows += len(own)
        parts.append(own)
    data = make_golden.file(header, np.concatenate(parts))
    assert len(data) < 2e5 and rows * 1024 * 4 > 16e6
    tracemalloc.start()
    try:
        table, findings = fmt.inspect(data)
        held, most = tracemalloc.get_traced_memory()
        assert table is not None and not findings
        assert held < 1.3 * table.pixels.nbytes and most < 3.0 * table.pixels.nbytes
    finally:
        tracemalloc.stop()


# --- other files -------------------------------------------------------------------


def test_an_ordinary_photograph(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """An EXR that is no table is told so, in words for somebody who picked the wrong file."""
    import OpenEXR

    path = tmp_path / "photo.exr"
    rgb = np.zeros((8, 8, 3), dtype=np.float16)
    OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION}, {"RGB": rgb}).write(str(path))
    with pytest.raises(FormatError, match="an OpenEXR image, but not a TSDF") as caught:
        tsdf.read(path)
    assert caught.value.code == "EXR_NOT_TSDF"
    assert capfd.readouterr() == ("", "")


def test_paths_that_cannot_be_read(tmp_path: Path) -> None:
    """Missing file, folder, fifo (which would block), bad names, device: the same error, of one line."""
    os.mkfifo(tmp_path / "fifo")
    for path in (
        tmp_path / "missing",
        tmp_path,
        tmp_path / "fifo",
        "a\0b",
        "n" * 5000,
        "two\nlines",
        "\udcff",
        "/dev/zero",
    ):
        with pytest.raises(FormatError) as caught:
            tsdf.read(path)
        assert caught.value.code == "FILE_UNREADABLE" == fmt.check(path)[0].code
        assert "\n" not in str(caught.value) and str(caught.value).isascii()


def test_a_file_too_large(tmp_path: Path) -> None:
    """It is refused by its size, before a byte of it is read (the file is sparse)."""
    path = tmp_path / "large.tsdf.exr"
    with path.open("wb") as file:
        file.write(MINIMAL)
        file.truncate(2**29 + 1)
    assert [finding.code for finding in fmt.check(path)] == ["EXR_SIZE"]


def test_import_is_lazy() -> None:
    """``import tsdf`` costs no third party, so that ``--help`` is quick; unknown names still fail."""
    script = "import sys, tsdf; assert not {'numpy', 'jsonschema', 'OpenEXR'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True)
    assert {tsdf.read, tsdf.write} == {fmt.read, fmt.write} and tsdf.Table is Table
    with pytest.raises(AttributeError):
        tsdf.no_such_name  # noqa: B018
