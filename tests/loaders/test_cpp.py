"""``loaders/tsdf.hpp`` reads as the Python reader does, draws as the sampler does, and stands damaged files.

All of it is compiled here by the system's g++, with every warning an error.
"""

import csv
import hashlib
import json
import math
import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import tsdf
from tsdf.data import format as tsdf_format
from tsdf.data.sampler import Sampler, Samples, outgoing
from tsdf.data.table import Table
from tsdf.reference_data import make_golden, make_vectors
from tsdf.scene.medium import Component, free_path, volume_parameters

ROOT = Path(tsdf.__file__).parent.parent
CPP = ROOT / "loaders" / "cpp"
GOLDEN = make_golden.GOLDEN
VALID, INVALID = (sorted((GOLDEN / kind).glob("*.tsdf.exr")) for kind in ("valid", "invalid"))
TRACED = GOLDEN / "checks" / "STATISTICS_DROPPED.tsdf.exr"  # a cube with atoms and joint records
STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror"]
pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++, the C++ compiler, in PATH")


def compiled(source: Path, program: Path, *flags: str) -> Path:
    done = subprocess.run(["g++", "-std=c++17", *STRICT, *flags, source, "-o", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The test program as an engine would build it: without exceptions and run-time types."""
    folder = tmp_path_factory.mktemp("cpp")
    return compiled(CPP / "check_tsdf.cpp", folder / "check_tsdf", "-O2", "-fno-exceptions", "-fno-rtti")


def run(program: Path, *arguments: object, numbers: Any = None, dtype: Any = np.float64) -> np.ndarray:
    """Return the numbers that a program writes when it is given numbers."""
    given = None if numbers is None else np.ascontiguousarray(numbers).tobytes()
    done = subprocess.run([program, *map(str, arguments)], input=given, capture_output=True, check=True)
    return np.frombuffer(done.stdout, dtype=dtype)


def events(program: Path, path: Path, joint: bool, u: np.ndarray, d_in: np.ndarray) -> np.ndarray:
    """Return what C++ makes of random numbers: the six results, the column, d_out and the offset, (n, 13)."""
    made = run(program, "sample", path, "joint" if joint else "apart", numbers=np.concatenate([u, d_in], axis=1))
    return made.reshape(len(u), 13)


def codes(program: Path, *paths: Path) -> list[list[str]]:
    """Return code, place, message and warnings for each file."""
    done = subprocess.run([program, "codes", *map(str, paths)], capture_output=True, text=True, check=True)
    return [line.split("|") for line in done.stdout.splitlines()]


def batch(program: Path, files: list[bytes], folder: Path) -> list[str]:
    """Return the code of each of many files in memory, "" for a sound one."""
    path = folder / "batch"
    path.write_bytes(b"".join(struct.pack("<Q", len(data)) + data for data in files))
    done = subprocess.run([program, "batch", path], capture_output=True, check=True)
    return [line.partition(b"|")[0].decode() for line in done.stdout.splitlines()]


def table_of(path: Path) -> Table:
    """Return the table in a file, without warnings of a newer version."""
    table = tsdf_format.inspect(path.read_bytes())[0]
    assert table is not None
    return table


def first_error(data: bytes) -> str:
    return next((f.code for f in tsdf_format.inspect(data)[1] if f.severity == "error"), "")


# ---------------------------------------------------------------------------------------------------- reading


@pytest.mark.slow
@pytest.mark.parametrize("path", VALID, ids=lambda p: p.name.partition(".")[0])
def test_valid_files_are_read(program: Path, path: Path) -> None:
    """Header and pixels are those of the ``.json`` beside each file, bit for bit, and so are the warnings."""
    expected = json.loads(path.with_name(path.name.replace(".tsdf.exr", ".json")).read_text())
    code, _, message, warnings = codes(program, path)[0]
    assert (code, message, warnings.split()) == ("", "", expected["warnings"])
    assert json.loads(run(program, "header", path, dtype=np.uint8).tobytes()) == expected["header"]
    pixels = np.array(expected["pixels"], dtype=np.float32)
    assert run(program, "pixels", path, dtype=np.float32).tobytes() == pixels.tobytes()


@pytest.mark.slow
def test_invalid_files_are_refused_by_their_code(program: Path) -> None:
    """The first broken rule is the one that each file was made to break."""
    assert len(INVALID) > 80
    for path, (code, place, message, _) in zip(INVALID, codes(program, *INVALID), strict=True):
        findings = json.loads(path.with_name(path.name.replace(".tsdf.exr", ".json")).read_text())["findings"]
        assert code == next(f["code"] for f in findings if f["severity"] == "error"), path.name
        assert place or code == "HEADER_SCHEMA"  # the pointer to all of the header is empty
        assert message.startswith(str(path)) and "; " in message and message.isascii() and message.isprintable()


def test_files_that_are_not_there(program: Path, tmp_path: Path) -> None:
    found = codes(program, tmp_path / "missing.tsdf.exr", tmp_path, Path("/dev/null"))
    assert [code for code, *_ in found] == ["FILE_UNREADABLE"] * 3


def test_every_way_to_deflate(program: Path, tmp_path: Path) -> None:
    """Stored, fixed and dynamic blocks, runs and long distances: each stream that zlib makes of a table is read."""
    header, pixels = make_golden.table([1] * 130, phi=32, other=32, count=32, joint=True)
    header = {"pixels_sha256": hashlib.sha256(pixels.tobytes()).hexdigest(), **header}
    chunks = make_golden.chunks(pixels)
    files = []
    strategies = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE, zlib.Z_FIXED)
    for strategy in strategies:
        for level, window, flush in ((1, 15, zlib.Z_NO_FLUSH), (6, 9, zlib.Z_SYNC_FLUSH), (9, 15, zlib.Z_FULL_FLUSH)):
            packed = []
            for chunk in chunks:
                line, size = struct.unpack_from("<iI", chunk)
                lines = min(16, len(pixels) - line)
                if size == 4 * pixels.shape[1] * lines:
                    packed.append(chunk)
                    continue
                plain = zlib.decompress(chunk[8:])
                deflate = zlib.compressobj(level, zlib.DEFLATED, window, strategy=strategy)
                stream = b"".join(
                    deflate.compress(plain[i : i + 999]) + deflate.flush(flush) for i in range(0, len(plain), 999)
                )
                stream += deflate.flush()
                packed.append(
                    chunk if len(stream) >= len(plain) else chunk[:4] + struct.pack("<I", len(stream)) + stream
                )
            assert sum(a != b for a, b in zip(packed, chunks, strict=True)) > len(chunks) // 2
            attributes = make_golden.attributes(make_golden.text(header), pixels.shape[1], len(pixels))
            files.append(make_golden.bind(attributes, packed))
    assert len(set(files)) > 10
    assert batch(program, files, tmp_path) == [first_error(data) for data in files] == [""] * len(files)


def test_texts_and_numbers_at_their_bounds(program: Path, tmp_path: Path) -> None:
    """Lengths count characters, not bytes; integers end at 2^63; versions may have any number of digits."""
    header, pixels = make_golden.table(make_golden.WEIGHTS)

    def changed(**keys: Any) -> bytes:
        return make_golden.file({**header, **keys}, pixels)

    accepted = [
        changed(licence="\N{GREEK SMALL LETTER THETA}" * 4096),
        changed(licence="\N{SNOWFLAKE}\N{PILE OF POO}\xa0"),
        changed(x_number=2**63 - 1, x_other=1e-320, x_tiny=-0.0),
        changed(provenance={**header["provenance"], "seed": -(2**63) + 1}),
        changed(format_version="1.10000"),
    ]
    assert batch(program, accepted, tmp_path) == [""] * len(accepted)
    refused = {
        "HEADER_SCHEMA": [changed(licence="\N{GREEK SMALL LETTER THETA}" * 4097), changed(licence="\x85")],
        "HEADER_NUMBER": [changed(x_number=2**63), changed(x_number=-(2**63))],
        "VERSION_MAJOR": [changed(format_version="12345.0"), changed(format_version="0.0")],
        "VERSION_SYNTAX": [
            changed(format_version=v) for v in ("1", "1.", ".0", "1.00", "01.0", "1.0.0", "+1.0", "1.0 ")
        ],
    }
    for code, files in refused.items():
        assert batch(program, files, tmp_path) == [code] * len(files)


@pytest.mark.slow
def test_damaged_files_break_the_same_rule_in_both_readers(
    program: Path, tmp_path: Path, fuzzer: Callable[[str], ModuleType]
) -> None:
    """Two readers written apart name the same rule for thousands of files; some are sound, many rules occur."""
    tables = fuzzer("tables")
    files = [tables.variant(0, i).data for i in range(2500)]
    expected = [first_error(data) for data in files]
    assert len(set(expected)) > 40 and 200 < expected.count("") < len(files) / 2
    found = batch(program, files, tmp_path)
    differ = [(i, a, b) for i, (a, b) in enumerate(zip(expected, found, strict=True)) if a != b]
    assert not differ, differ[:5]


@pytest.mark.slow
def test_damaged_files_are_stood_under_sanitizers(tmp_path: Path, fuzzer: Callable[[str], ModuleType]) -> None:
    """No read out of bounds, no undefined behaviour: on damaged files, and in using those that are accepted."""
    flags = ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    plain = tmp_path / "plain.cpp"
    plain.write_text("int main() { return 0; }\n")
    if subprocess.run(["g++", *flags, plain, "-o", tmp_path / "plain"], capture_output=True).returncode != 0:
        pytest.skip("needs the address and undefined-behaviour sanitizers of g++ (libasan, libubsan)")
    program = compiled(CPP / "check_tsdf.cpp", tmp_path / "sanitized", *flags)
    done = subprocess.run([program, "fuzz", "50", *VALID, *INVALID, TRACED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    tables = fuzzer("tables")
    batch(program, [tables.variant(5, i).data for i in range(600)], tmp_path)
    done = subprocess.run([program, "codes", *VALID, *INVALID], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    for joint in ("joint", "apart"):  # files as they are, random numbers as they should not be
        u = np.resize([math.nan, -1.0, 0.0, 0.5, 1.0, 1.5, math.inf, -math.inf, 1e-320, 1.0 - 2**-53], (97, 9))
        assert len(run(program, "sample", TRACED, joint, numbers=u)) == 97 * 13


# --------------------------------------------------------------------------------------------------- sampling


def vectors() -> dict[tuple[str, bool], np.ndarray]:
    """Return the committed vectors, (n, 13) by table and way of drawing: six u's and seven results."""
    made: dict[tuple[str, bool], list[list[float]]] = {}
    with make_vectors.VECTORS.open(newline="") as file:
        rows = csv.reader(line for line in file if not line.startswith("#"))
        assert next(rows)[2:8] == ["u_phi_d", "u_theta", "u_r", "u_z", "u_phi_delta", "u_l"]
        for name, joint, *numbers in rows:
            made.setdefault((name, joint == "1"), []).append([float(number) for number in numbers])
    return {key: np.array(rows) for key, rows in made.items()}


VECTORS = vectors()


def test_vectors_are_those_that_python_makes() -> None:
    """The committed file is up to date: 1e-9, which is what its digits hold."""
    committed = make_vectors.VECTORS.read_text().splitlines()
    for old, new in zip(committed, make_vectors.lines(), strict=True):
        if old != new:
            names, numbers = zip(*(line.split(",", 1) for line in (old, new)), strict=True)
            assert names[0] == names[1]
            a, b = (np.array(text.split(","), dtype=float) for text in numbers)
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("key", VECTORS, ids=lambda key: f"{key[0]}{'-joint' * key[1]}")
def test_same_numbers_same_events_as_python(program: Path, key: tuple[str, bool]) -> None:
    """All of `make_vectors`, edges of [0, 1) included, to 1e-6. Negative control: u's 1e-5 off do not pass."""
    rows = VECTORS[key]
    assert len(rows) > 150
    u, path = rows[:, :6] / make_vectors.ONE, GOLDEN / f"{key[0]}.tsdf.exr"
    d_in = np.tile([0.0, 0.0, 1.0], (len(u), 1))
    np.testing.assert_allclose(events(program, path, key[1], u, d_in)[:, :7], rows[:, 6:], rtol=0.0, atol=1e-6)
    off = events(program, path, key[1], np.minimum(u + 1e-5, 1.0 - 2**-24), d_in)[:, :7]
    assert np.abs(off - rows[:, 6:]).max() > 1e-6


@pytest.mark.slow
def test_events_of_a_traced_table(program: Path) -> None:
    """100,000 events of a cube with atoms: every cell is as in Python, and d_out and the offset for any d_in."""
    rng = np.random.default_rng(6)
    u = rng.random((100_000, 6))
    d_in = rng.normal(size=(len(u), 3))
    d_in /= np.linalg.norm(d_in, axis=1, keepdims=True)
    d_in[:2] = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    for joint in (False, True):
        expected = Sampler(table_of(TRACED), joint).sample(u)
        made = events(program, TRACED, joint, u, d_in)
        np.testing.assert_allclose(made[:, :6].T, np.array(expected[:-1]), rtol=0.0, atol=1e-12)
        assert (made[:, 6] == expected.column).all()
        out = outgoing(Samples(*expected), d_in)
        np.testing.assert_allclose(made[:, 7:10], out.d_out, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(made[:, 10:], out.offset, rtol=0.0, atol=1e-11)


@pytest.mark.slow
def test_an_axis_of_many_cells(program: Path, tmp_path: Path) -> None:
    """More than 256 cells: the guide keeps the upper bits of the cell only, which must not change an event."""
    path = tmp_path / "tall.tsdf.exr"
    path.write_bytes(
        make_golden.file(*make_golden.table([1, 1, 2, 4, 6, 2], phi=1200, other=300, count=64, joint=True))
    )
    words = run(program, "words", path, "apart", dtype=np.uint32)
    assert words[18] > 0
    u = np.random.default_rng(9).random((20_000, 6))
    d_in = np.tile([0.0, 0.0, 1.0], (len(u), 1))
    expected = Sampler(table_of(path)).sample(u)
    np.testing.assert_allclose(events(program, path, False, u, d_in)[:, :7].T, np.array(expected), rtol=0.0, atol=1e-12)


def test_densities(program: Path) -> None:
    """`pdf` is Python's, at the edges of cells too, is 0 outside [-1, 1], and integrates to what is not an atom."""
    for path in (*VALID, TRACED):
        table = table_of(path)
        edges = table.cos_theta_edges
        near = np.concatenate([edges, np.nextafter(edges, -2.0), np.nextafter(edges, 2.0)])
        cosines = np.concatenate([np.clip(near, -1.0, 1.0), np.random.default_rng(7).uniform(-1.0, 1.0, 500)])
        got = run(program, "pdf", path, "apart", numbers=cosines).reshape(-1, 2)
        sampler = Sampler(table)
        np.testing.assert_allclose(got[:, 0], sampler.density(cosines), rtol=1e-12)
        np.testing.assert_allclose(got[:, 1], sampler.density_solid_angle(cosines), rtol=1e-12)
        outside = run(program, "pdf", path, "apart", numbers=np.array([-1.1, 1.1, math.nan, math.inf]))
        assert not outside.any()
        middles = np.array([0.5 * (low + high) for low, high in pairwise(edges)])
        masses = run(program, "pdf", path, "apart", numbers=middles)[::2] * np.diff(edges)
        assert math.isclose(masses.sum(), 1.0 - sum(sampler.atoms), abs_tol=1e-9)


def test_medium(program: Path) -> None:
    """Free path and point scatterers are those of `tsdf.scene.medium`, with and without absorption."""
    for path in (*VALID, TRACED):
        table = table_of(path)
        for f, radius, sigma_a in ((0.6, 1.0, 0.0), (0.05, 1e-3, 40.0), (0.74, 30.0, 0.01)):
            own = free_path([Component(table, radius=radius)], f)
            volume = volume_parameters([Component(table, radius=radius)], f, [sigma_a])
            expected = [own.lambda_b, own.lambda_delta, own.lambda_beta, own.lambda_s]
            expected += [volume.sigma_t, volume.albedo, volume.g]
            np.testing.assert_allclose(run(program, "medium", path, f, radius, sigma_a), expected, rtol=1e-12)
    for f, radius in ((0.0, 1.0), (0.75, 1.0), (math.nan, 1.0), (0.5, -1.0)):
        assert np.isnan(run(program, "medium", TRACED, f, radius, 0.0)[:5]).all()


def test_nothing_allocates_after_loading(program: Path) -> None:
    for joint in ("apart", "joint"):
        done = subprocess.run([program, "frugal", TRACED, joint], capture_output=True, text=True, check=True)
        assert done.stdout == "0\n"


def test_records_that_are_missing(program: Path) -> None:
    done = subprocess.run(
        [program, "words", GOLDEN / "valid/minimal.tsdf.exr", "joint"], capture_output=True, text=True
    )
    assert done.returncode == 1 and done.stderr.startswith("SAMPLER_RECORDS: ") and "--joint" in done.stderr


# ----------------------------------------------------------------------------------------------------- shader


@pytest.mark.slow
def test_the_example_of_the_documentation(tmp_path: Path) -> None:
    """It compiles without a warning and reads a table."""
    include, _, body = (
        (ROOT / "docs" / "cpp.md").read_text().partition("```cpp\n")[2].partition("```")[0].partition("\n")
    )
    body = body.replace("snow.tsdf.exr", str(TRACED))
    source = tmp_path / "example.cpp"
    numbers = "double u0 = 0.1, u1 = 0.2, u2 = 0.3, u3 = 0.4, u4 = 0.5, u5 = 0.6;"
    source.write_text(
        f"{include}\n#include <cstdio>\nstatic void run() {{ {numbers}\n{body}"
        'std::printf("%f %f\\n", out.d_out.x, travel);\n}\nint main() { run(); }\n'
    )
    program = compiled(source, tmp_path / "example", f"-I{ROOT / 'loaders'}")
    lines = subprocess.run([program], capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines[-1].split()) == 2 and float(lines[-1].split()[1]) > 0.0


@pytest.mark.slow
def test_the_shader_of_the_documentation(program: Path, tmp_path: Path) -> None:
    """The GLSL of docs/cpp.md, compiled as C++, draws what the sampler draws, as far as 32 bits go.

    Columns differ for at most 1e-6 of random events (masses are rounded to 2^-31, cells by less); values by 4e-6 (a few
    roundings of numbers up to 2 pi). Negative control: the numbers for r and z exchanged do not pass.
    """
    text = (ROOT / "docs" / "cpp.md").read_text()
    (tmp_path / "shader.glsl").write_text(text.partition("```glsl\n")[2].partition("```")[0])
    flags = ["-O1", "-Wdouble-promotion", "-fsanitize=undefined", f"-I{tmp_path}"]
    shader = compiled(CPP / "check_shader.cpp", tmp_path / "shader", *flags)
    d_in = np.tile([0.0, 0.0, 1.0], (20_000, 1))
    tall = tmp_path / "tall.tsdf.exr"
    tall.write_bytes(
        make_golden.file(*make_golden.table([1, 1, 2, 4, 6, 2], phi=1200, other=300, count=64, joint=True))
    )
    for path in (GOLDEN / "valid/minimal.tsdf.exr", GOLDEN / "valid/many_rows.tsdf.exr", tall, TRACED):
        for joint in (False, True) if "minimal" not in path.name else (False,):
            u = np.random.default_rng(8).random((len(d_in), 6)).astype(np.float32)
            u = np.minimum(u, np.float32(1.0 - 2**-24))
            u[:3] = [[0.0] * 6, [1.0 - 2**-24] * 6, [2.0**-140] * 6]
            word = "joint" if joint else "apart"
            words = tmp_path / "words"
            words.write_bytes(run(program, "words", path, word, dtype=np.uint32).tobytes())
            expected = events(program, path, joint, u.astype(np.float64), d_in)
            made = run(shader, word, words, numbers=u, dtype=np.float32).reshape(len(u), 14)
            agree = made[:, 6] == expected[:, 6]
            assert np.count_nonzero(~agree) <= 1
            np.testing.assert_allclose(made[agree, :6], expected[agree, :6], rtol=0.0, atol=4e-6)
            np.testing.assert_allclose(made[agree, 8:], expected[agree, 7:], rtol=0.0, atol=1e-5)
            density = run(program, "pdf", path, "apart", numbers=made[:, 0].astype(np.float64))[1::2]
            # a cosine in 32 bits may lie on the other side of an edge
            assert np.count_nonzero(np.abs(made[:, 7] - density) > 1e-6 * density) <= 0.002 * len(u)
            swapped = run(shader, word, words, numbers=u[:, [0, 1, 3, 2, 4, 5]], dtype=np.float32).reshape(len(u), 14)
            assert np.abs(swapped[:, :6] - expected[:, :6]).max() > 0.1
