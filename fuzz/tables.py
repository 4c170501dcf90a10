"""Mutated tables: both readers must refuse what is no table, by the same rule, and read what is one as it is.

``python fuzz/tables.py --count 100000 --seed 0`` makes so many files out of the golden ones: bytes, text of the header,
values, pixels and container are changed, mostly with digests that are right again. Each is read by `tsdf.data.format`
and, where g++ is there, by ``loaders/tsdf.hpp``, many files in one process. What is read must be what was put in, and
be of use. ``--only I`` writes file I of this seed to ``table_I.tsdf.exr`` and says what is
found. Exit status 1 for a fault.
"""

import argparse
import copy
import hashlib
import json
import math
import random
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table, thawed
from tsdf.reference_data import make_golden
from tsdf.scene.medium import Component, free_path, volume_parameters

ROOT = Path(__file__).parents[1]
CHECK = ROOT / "loaders" / "cpp" / "check_tsdf.cpp"
GOLDEN = make_golden.GOLDEN
BATCH = 1000  # files in one process of the C++ reader
SECONDS, MEGABYTES = 20.0, 1000.0  # that a file may take at most, and the process

VALID = [path.read_bytes() for path in sorted((GOLDEN / "valid").glob("*.tsdf.exr"))]
INVALID = [path.read_bytes() for path in sorted((GOLDEN / "invalid").glob("*.tsdf.exr"))]
REAL = [(GOLDEN / "checks" / f"{name}.tsdf.exr").read_bytes() for name in ("cube", "sphere_memory")]

# What no header should hold, or only some places of it.
ODD: list[Any] = [
    None,
    True,
    -1,
    0,
    0.0,
    1,
    1.5,
    3,
    65536,
    2**62,
    1e300,
    5e-324,
    "",
    "x",
    "R",
    "mass",
    "\x85",
    "1.7",
    "p_r",
]
ODD += ["R", "mass", "\x85", "1.7", "p_r", [], {}, [0, 1], [0.0], {"x_": 1}]
EXTREMES: list[Any] = [-1e31, -1e30, -100, -1.0000000011, -1, -1.1e-9, -1e-9, 0, 5e-324, 1e-300, 1e-12, 0.5, 0.98, 1]
EXTREMES += [1.0000000009, 1.0000000011, 1.02, 1.5, 2, 2.0000000011, 5, 1e30, 1.1e30, 1e300]
PIECES = ['"', "\\", "[", "{", "]", "}", ",", ":", "1e999", "-", "9" * 19, "[" * 33, "]" * 33, '"\\ud800"', "\\u0041"]
PIECES += ['"eta":1,', '"x_":{"a":1,"a":2},', '"x_":9223372036854775808,', '"x_":-0.0,', "null", "NaN", " ", "\n"]
PIECES += ["\x00", "\x80"]


@dataclass(frozen=True)
class Variant:
    """One file, and what it holds where that is known."""

    kind: str
    data: bytes
    content: tuple[dict[str, Any], np.ndarray] | None = None


def sealed(data: bytes) -> bytes:
    """Return the bytes with the digest that they should have, if they have a place for it."""
    at = data.find(b"tsdf_sha256\0string\0") + 23
    if at < 23 or len(data) < at + 64:
        return data
    blank = data[:at] + b"0" * 64 + data[at + 64 :]
    return blank[:at] + hashlib.sha256(blank).hexdigest().encode() + blank[at + 64 :]


def content_of(data: bytes) -> tuple[dict[str, Any], np.ndarray]:
    """Return header and pixels of a sound file."""
    table = tsdf_format.inspect(data)[0]
    assert table is not None
    return thawed(table.header), np.array(table.pixels)


CONTENTS = [content_of(data) for data in (*VALID, *REAL)]


def bytes_changed(rng: random.Random) -> Variant:
    """Change, insert, remove or exchange some bytes of a file."""
    files = VALID + INVALID
    made, other = bytearray(rng.choice(files)), rng.choice(files)
    for _ in range(rng.randrange(1, 4)):
        a, b = sorted(rng.randrange(len(made) + 1) for _ in range(2))
        if rng.random() < 0.3:  # where the chunks are
            a = max(len(made) - 1 - rng.randrange(300), 0)
        what = rng.randrange(5)
        if what == 0 and made:
            made[min(a, len(made) - 1)] ^= 1 << rng.randrange(8)
        elif what == 1:
            made[a : a + 4] = rng.randbytes(4)
        elif what == 2:
            made[a:a] = rng.randbytes(rng.randrange(1, 20))
        elif what == 3:
            del made[a : min(b, a + 100)]
        else:
            made[a:b] = other[a:b]
    return Variant("bytes", sealed(bytes(made)) if rng.random() < 0.8 else bytes(made))


def text_changed(rng: random.Random) -> Variant:
    """Put faults into the text of the header, several at once."""
    header, pixels = CONTENTS[rng.randrange(len(VALID))]
    text = make_golden.text(header).decode()
    for _ in range(rng.randrange(1, 4)):
        at = rng.choice([rng.randrange(len(text)), 1, len(text) - 1, len(text)])
        cut = rng.choice([0, 0, 0, 1, rng.randrange(20)])
        text = text[:at] + rng.choice(PIECES) + text[at + cut :]
    attributes = make_golden.attributes(text.encode("latin-1"), pixels.shape[1], len(pixels))
    return Variant("text", make_golden.bind(attributes, make_golden.chunks(pixels)))


def place_of(rng: random.Random, header: Any) -> tuple[Any, Any]:
    """Return a part of a header and a key of it, at random."""
    part = header
    while True:
        key = rng.choice(list(part) if isinstance(part, dict) else range(len(part)))
        if not (isinstance(part[key], dict | list) and part[key]) or rng.random() < 0.15:
            return part, key
        part = part[key]


def header_changed(rng: random.Random) -> Variant:
    """Change one or two values of the header."""
    header, pixels = copy.deepcopy(CONTENTS[rng.randrange(len(CONTENTS) if rng.random() < 0.1 else len(VALID))])
    for _ in range(rng.randrange(1, 3)):
        part, key = place_of(rng, header)
        what = rng.randrange(5)
        if what == 0:
            del part[key]
        elif what == 1 and isinstance(part, dict):
            part[rng.choice(["x_key", "key", "rows", "edges"])] = rng.choice(ODD)
        elif what == 2 and isinstance(part[key], int | float) and not isinstance(part[key], bool):
            small = rng.choice([1e-12, 1e-9, 1e-7, 1e-4, 1e-3, 0.02])
            part[key] = part[key] * (1 + small) if isinstance(part[key], float) else part[key] + rng.choice([-1, 1])
        elif what == 3 and isinstance(part, list):
            part.insert(key, copy.deepcopy(rng.choice(part)))
        else:
            part[key] = copy.deepcopy(rng.choice(ODD))
        if not header:
            break
    if rng.random() < 0.9 or "pixels_sha256" not in header:
        header["pixels_sha256"] = hashlib.sha256(pixels.tobytes()).hexdigest()
    return Variant("header", make_golden.file(header, pixels), (header, pixels))


def statistics_changed(rng: random.Random) -> Variant:
    """Push the numbers that others divide by, loop over or allocate by to their ends."""
    header, pixels = copy.deepcopy(CONTENTS[rng.randrange(len(CONTENTS))])
    for _ in range(rng.choice([1, 1, 2, 6])):
        name = rng.choice(["statistics", "statistics", "standard_errors", "fits", "energy_ledger", "optics", "grain"])
        part = header[name]
        if name == "fits":
            part = part[rng.choice(list(part))]
        key = rng.choice([key for key, value in part.items() if isinstance(value, int | float | list)])
        value = rng.choice(EXTREMES)
        part[key] = [value] * 17 if key == "legendre_moments" else int(value) if name == "energy_ledger" else value
    if rng.random() < 0.2:  # a ledger that fits the lie
        whole = rng.choice([1, 1000, 2**62])
        met = rng.randrange(0, whole + 1)
        header["energy_ledger"] |= {"launched": whole, "unscattered": whole - met, "scattered": met}
        header["energy_ledger"] |= {"absorbed": 0, "truncated": 0, "lost": 0}
        header["statistics"] |= {"hit_probability": met / whole, "albedo": 1.0}
    return Variant("statistics", make_golden.file(header, pixels), (header, pixels))


def pixels_changed(rng: random.Random) -> Variant:
    """Change pixels by a little or a lot."""
    header, pixels = copy.deepcopy(CONTENTS[rng.randrange(len(CONTENTS) if rng.random() < 0.1 else len(VALID))])
    for _ in range(rng.randrange(1, 3)):
        block = rng.choice(header["blocks"])
        rows = range(block["first_row"], block["first_row"] + block["rows"])
        at = rng.choice(rows), rng.randrange(pixels.shape[1])
        change = rng.choice([1e-7, 4e-7, 9e-7, 2e-6, 1e-5, 1.2e-5, 1e-3, 0.5, -0.5, -2.0])
        what = rng.choice([0, 0, 1, 1, 2, 3])
        if what == 2:
            at = rng.choice(rows), slice(None)
        if what == 3:
            pixels[at] = rng.choice([change, 0.0, -0.0, math.nan, -math.inf, 3e38, 1e30, 1e-45])
        else:
            pixels[at] = pixels[at] + np.float32(change) if what else pixels[at] * np.float32(1 + change)
    header["pixels_sha256"] = hashlib.sha256(pixels.tobytes()).hexdigest()
    return Variant("pixels", make_golden.file(header, pixels), (header, pixels))


def container_changed(rng: random.Random) -> Variant:
    """Change attributes and chunks of the image."""
    header, pixels = CONTENTS[rng.randrange(len(VALID))]
    attributes = make_golden.attributes(make_golden.text(header), pixels.shape[1], len(pixels))
    chunks = make_golden.chunks(pixels)
    options: dict[str, Any] = {}
    for _ in range(rng.randrange(1, 3)):
        what = rng.randrange(7)
        name = rng.choice(list(attributes))
        if what == 0:
            kind, value = attributes[name]
            changed = bytearray(value)
            changed[rng.randrange(len(changed))] = rng.randrange(256)
            attributes[name] = kind, bytes(changed)[: None if rng.random() < 0.7 else -1] or b"\0"
        elif what == 1:
            attributes[rng.choice(["comment", "n" * 31, "n" * 32, "Tsdf"])] = (
                "string",
                rng.randbytes(rng.randrange(1, 9)),
            )
        elif what == 2:
            del attributes[name]
            if not attributes:
                break
        elif what == 3:
            size = rng.choice([0, 1, 4, 16, 65535, 65536, 2**26, 2**31 - 1, -1])
            window = struct.pack("<4i", 0, 0, *rng.sample([size, pixels.shape[1] - 1, len(pixels) - 1], 2))
            attributes |= {"dataWindow": ("box2i", window), "displayWindow": ("box2i", window)}
        elif what == 4:
            which = rng.randrange(len(chunks))
            packed = bytearray(chunks[which])
            packed[rng.randrange(len(packed))] = rng.randrange(256)
            chunks[which] = bytes(packed)[: None if rng.random() < 0.7 else -1]
        elif what == 5:
            options = {"tail": b"more"} if rng.random() < 0.5 else {"shift": rng.choice([1, -1, 2**32])}
        else:
            chunks = rng.sample(chunks, rng.randrange(1, len(chunks) + 1))
    return Variant("container", make_golden.bind(attributes, chunks, **options))


KINDS = (bytes_changed, text_changed, header_changed, statistics_changed, pixels_changed, container_changed)


def variant(seed: int, i: int) -> Variant:
    """Return file `i` of a seed."""
    rng = random.Random(f"{seed}:{i}")
    return rng.choice(KINDS)(rng)


def compiled(folder: Path) -> Path:
    """Return the C++ reader, compiled as an engine would."""
    program = folder / "check_tsdf"
    subprocess.run(["g++", "-std=c++17", "-O2", "-fno-exceptions", "-fno-rtti", CHECK, "-o", program], check=True)
    return program


def codes_of(program: Path, files: list[bytes], folder: Path) -> list[str]:
    """Return the first broken rule of each file by the C++ reader, in one process, "" for a sound one."""
    path = folder / "batch"
    path.write_bytes(b"".join(struct.pack("<Q", len(data)) + data for data in files))
    done = subprocess.run([program, "batch", path], capture_output=True, check=True)
    return [line.partition(b"|")[0].decode() for line in done.stdout.splitlines()]


def misread(table: Table, made: Variant) -> str:
    """Return how a table differs from what was put in, or why it is of no use; "" if all is well."""
    if made.content is not None:
        header, pixels = made.content
        if json.dumps(thawed(table.header), sort_keys=True) != json.dumps(header, sort_keys=True):
            return "another header"
        if table.pixels.tobytes() != pixels.tobytes():
            return "other pixels"
    elif hashlib.sha256(table.pixels.tobytes()).hexdigest() != table.header["pixels_sha256"]:
        return "other pixels"
    component = [Component(table)]
    path, volume = free_path(component, 0.5), volume_parameters(component, 0.5, [0.1])
    numbers = [
        path.lambda_beta,
        path.hit_probability,
        volume.albedo,
        volume.sigma_a,
        table.deflection_masses(0.1).sum(),
    ]
    if volume.albedo > 0.0:
        numbers.append(volume.g)
    if not all(map(math.isfinite, numbers)) or not 0.0 <= volume.albedo <= 1.0 + 1e-6:
        return f"numbers of no use: {numbers}"
    return ""


def _megabytes() -> float:
    """Return the most memory that this process has had [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> int:
    """Run as the module says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="files [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="of the changes [%(default)s]")
    parser.add_argument("--only", type=int, help="write and judge this one file")
    options = parser.parse_args()
    which = range(options.count) if options.only is None else range(options.only, options.only + 1)
    faults: list[str] = []
    before = _megabytes()  # of the process, which may have done other things

    def fault(text: str) -> None:
        faults.append(text)
        if len(faults) <= 50:
            print(text, file=sys.stderr, flush=True)

    found: Counter[str] = Counter()
    slowest, accepted = 0.0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = compiled(folder) if shutil.which("g++") else None
        waiting: list[tuple[int, str, bytes]] = []
        for i in which:
            made = variant(options.seed, i)
            start = time.process_time()
            try:
                table, findings = tsdf_format.inspect(made.data)
                wrong = misread(table, made) if table is not None else ""
            except Exception as error:
                table, findings, wrong = None, [], f"{type(error).__name__}: {error}"
            slowest = max(slowest, time.process_time() - start)
            code = next((finding.code for finding in findings if finding.severity == "error"), "")
            if wrong:
                fault(f"file {i} ({made.kind}): {wrong}")
            found[code] += 1
            accepted += table is not None
            waiting.append((i, code, made.data))
            if program is not None and (len(waiting) == BATCH or i == which[-1]):
                others = codes_of(program, [data for *_, data in waiting], folder)
                if len(others) != len(waiting):
                    fault(f"files {waiting[0][0]} to {i}: the C++ reader stopped after {len(others)}")
                for (j, own, _), other in zip(waiting, others, strict=False):
                    if own != other:
                        fault(f"file {j}: {own or 'sound'} in Python, {other or 'sound'} in C++")
                waiting = []
            if options.only is not None:
                Path(f"table_{i}.tsdf.exr").write_bytes(made.data)
                print(f"table_{i}.tsdf.exr ({made.kind})", *findings, sep="\n")
    megabytes = _megabytes()
    if slowest > SECONDS or megabytes > max(MEGABYTES, before):
        fault(f"{slowest:.1f} s for one file, {megabytes:.0f} MB")
    print(f"{len(which)} tables, seed {options.seed}: {accepted} read, {len(which) - accepted} refused by ", end="")
    print(f"{len(set(found) - {''})} rules, {len(faults)} faults; {slowest:.2f} s at most, {megabytes:.0f} MB")
    print("C++ compared" if program else "C++ not compared: g++ is not in PATH")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
