"""Damaged mesh files: python fuzz/meshes.py --count 10000

Small files of every kind that `tsdf.grain.meshes` reads are damaged (bytes turned, cut out, doubled; numbers replaced
by others, in packed and compressed text too) and loaded as grains in a process of limited memory. Right is a grain or a
GrainError of one line, within `SECONDS` and `MEMORY`; whatever else happens is kept in the folder of --keep.
"""

import argparse
import base64
import io
import json
import os
import random
import re
import resource
import select
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np

SECONDS = 20  # for one file
MEMORY = 1_000_000_000  # bytes above what the process has before it reads the first

# A box of 2 x 1 x 1, its sides as quadrangles and as triangles
POINTS = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 2)], float)
QUADS = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
TRIANGLES = QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


# ---------------------------------------------------------------------------------------- files to damage


def ply(order: str, mixed: bool = True) -> bytes:
    """Return a PLY, with properties that nobody asked for; `order` is "", "<" or ">"."""
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    faces = [*QUADS[:5].tolist(), *TRIANGLES[10:].tolist()] if mixed else TRIANGLES.tolist()
    head = (
        f"ply\nformat {kind} 1.0\ncomment a box\nelement vertex 8\n"
        "property float x\nproperty float y\nproperty double z\nproperty uchar red\n"
        f"element face {len(faces)}\nproperty uchar flags\nproperty list uchar int vertex_indices\n"
        "property list ushort float more\nend_header\n"
    ).encode()
    if not order:
        rows = [f"{x:g} {y:g} {z:g} 7" for x, y, z in POINTS]
        rows += [f"1 {len(f)} {' '.join(map(str, f))} {len(f) % 3} {'0.5 ' * (len(f) % 3)}" for f in faces]
        return head + "\n".join(rows).encode() + b"\n"
    body = b"".join(struct.pack(order + "ffdB", *p, 7) for p in POINTS)
    for f in faces:
        extra = len(f) % 3
        body += struct.pack(f"{order}BB{len(f)}iH{extra}f", 1, len(f), *f, extra, *[0.5] * extra)
    return head + body


def gltf(binary: bool = True) -> bytes:
    """Return a glTF of the box; its buffer holds float32 positions, then uint16 indices."""
    blob = POINTS.astype("<f4").tobytes() + TRIANGLES.astype("<u2").tobytes()
    document: dict = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [1, 2, 3]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 72},
        ],
        "buffers": [{"byteLength": len(blob)}],
    }
    if not binary:
        document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
        return json.dumps(document).encode()
    return glb(document, blob)


def glb(document: dict, blob: bytes) -> bytes:
    """Return a .glb of a document and its buffer."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def quantised() -> bytes:
    """Return a .glb of normalised int16 positions, eight bytes apart, moved back by its node."""
    whole = np.zeros((8, 4), "<i2")
    whole[:, :3] = np.rint((POINTS - [1, 0.5, 0.5]) * 32767)
    blob = whole.tobytes() + TRIANGLES.astype("u1").tobytes()
    document = json.loads(gltf(binary=False))
    document["buffers"] = [{"byteLength": len(blob)}]
    document["bufferViews"] = [
        {"buffer": 0, "byteLength": 64, "byteStride": 8},
        {"buffer": 0, "byteOffset": 64, "byteLength": 36},
    ]
    document["accessors"][0].update(componentType=5122, normalized=True)
    document["accessors"][1].update(componentType=5121)
    document["extensionsRequired"] = document["extensionsUsed"] = ["KHR_mesh_quantization"]
    return glb(document, blob)


def sparse() -> bytes:
    """Return a .glb whose upper corners are sparse changes to zeros, and whose last face is a strip."""
    changed = np.flatnonzero(POINTS.any(axis=1))
    blob = TRIANGLES[:10].astype("<u4").tobytes() + np.array(QUADS[5][[0, 1, 3, 2]], "<u4").tobytes()
    blob += changed.astype("u1").tobytes() + b"\0" + POINTS[changed].astype("<f4").tobytes()
    at = np.cumsum([0, 120, 16, 8, 84]).tolist()
    views = [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in pairwise(at)]
    views[2]["byteLength"] = 7
    document = json.loads(gltf(binary=False))
    document["buffers"], document["bufferViews"] = [{"byteLength": len(blob)}], views
    document["accessors"] = [
        {
            "componentType": 5126,
            "count": 8,
            "type": "VEC3",
            "sparse": {
                "count": 7,
                "indices": {"bufferView": 2, "componentType": 5121},
                "values": {"bufferView": 3},
            },
        },
        {"bufferView": 0, "componentType": 5125, "count": 30, "type": "SCALAR"},
        {"bufferView": 1, "componentType": 5125, "count": 4, "type": "SCALAR"},
    ]
    attributes = {"POSITION": 0}
    document["meshes"][0]["primitives"] = [
        {"attributes": attributes, "indices": 1},
        {"attributes": attributes, "indices": 2, "mode": 5},
    ]
    return glb(document, blob)


MODEL = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources><object id="1" type="model"><mesh>'
    "<vertices>{points}</vertices><triangles>{faces}</triangles></mesh></object>"
    '<object id="2"><components><component objectid="1" transform="0 1 0 -1 0 0 0 0 1 5 0 0"/></components></object>'
    '</resources><build><item objectid="2"/></build></model>'
).format(
    points="".join('<vertex x="{:g}" y="{:g}" z="{:g}"/>'.format(*p) for p in POINTS),
    faces="".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*f) for f in TRIANGLES),
)


def packed(model: bytes) -> bytes:
    """Return a .3mf of a model."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
    return out.getvalue()


DAE = (
    '<?xml version="1.0" encoding="utf-8"?>\n<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" '
    'version="1.4.1"><asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g">'
    '<mesh><source id="p"><float_array id="a" count="24">{points}</float_array><technique_common>'
    '<accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
    '<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">'
    '<input semantic="POSITION" source="#p"/></vertices><polylist count="6">'
    '<input semantic="VERTEX" source="#v" offset="0"/><vcount>4 4 4 4 4 4</vcount><p>{faces}</p></polylist></mesh>'
    '</geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
    "<translate>1 0 0</translate>"
    '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>'
    '<instance_visual_scene url="#s"/></scene></COLLADA>'
).format(points=" ".join(f"{x:g}" for x in POINTS.ravel()), faces=" ".join(map(str, QUADS.ravel())))


def vtk(binary: bool, version: str = "3.0", grid: bool = False) -> bytes:
    """Return a legacy file: PolyData, or the flat cells of an unstructured grid."""

    def block(values: np.ndarray, kind: str) -> bytes:
        return values.astype(">" + kind).tobytes() if binary else " ".join(f"{v:g}" for v in values.ravel()).encode()

    out = f"# vtk DataFile Version {version}\na box\n{'BINARY' if binary else 'ASCII'}\n".encode()
    out += b"DATASET " + (b"UNSTRUCTURED_GRID" if grid else b"POLYDATA") + b"\n"
    out += b"POINTS 8 float\n" + block(POINTS, "f4") + b"\n"
    name = b"CELLS" if grid else b"POLYGONS"
    if version >= "5":
        out += name + b" 7 24\nOFFSETS vtktypeint64\n" + block(np.arange(0, 25, 4), "i8")
        out += b"\nCONNECTIVITY vtktypeint64\n" + block(QUADS, "i8") + b"\n"
    else:
        out += name + b" 6 30\n" + block(np.column_stack([np.full(6, 4), QUADS]), "i4") + b"\n"
    if grid:
        out += b"CELL_TYPES 6\n" + block(np.full(6, 9), "i4") + b"\n"
    return out + b"POINT_DATA 8\nSCALARS s float 1\nLOOKUP_TABLE default\n" + block(np.zeros(8), "f4") + b"\n"


def vtk_xml(form: str, grid: bool = False, compressed: bool = False) -> bytes:
    """Return a .vtp or .vtu with arrays in the form "ascii", "binary" or "appended" (raw)."""
    appended = b""

    def array(name: str, kind: str, values: np.ndarray) -> str:
        nonlocal appended
        head = f'<DataArray type="{kind}" Name="{name}" format="{form}"'
        raw = values.astype({"Float32": "<f4", "Int64": "<i8", "UInt8": "u1"}[kind]).tobytes()
        if form == "ascii":
            return f"{head}>{' '.join(f'{v:g}' for v in values.ravel())}</DataArray>"
        header, body = struct.pack("<I", len(raw)), raw
        if compressed:
            body = zlib.compress(raw)
            header = struct.pack("<4I", 1, len(raw), 0, len(body))
        if form == "binary":
            coded = (
                base64.b64encode(header + body) if not compressed else b"".join(map(base64.b64encode, (header, body)))
            )
            return f"{head}>{coded.decode()}</DataArray>"
        offset, appended = len(appended), appended + header + body
        return f'{head} offset="{offset}"/>'

    points = array("Points", "Float32", POINTS)
    lists = array("connectivity", "Int64", QUADS) + array("offsets", "Int64", np.arange(4, 25, 4))
    kind, section, count = ("UnstructuredGrid", "Cells", "Cells") if grid else ("PolyData", "Polys", "Polys")
    lists += array("types", "UInt8", np.full(6, 7)) if grid else ""
    packing = ' compressor="vtkZLibDataCompressor"' if compressed else ""
    text = (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="0.1" byte_order="LittleEndian"{packing}><{kind}>'
        f'<Piece NumberOfPoints="8" NumberOf{count}="6"><Points>{points}</Points><{section}>{lists}</{section}></Piece>'
        f"</{kind}>"
    ).encode()
    if form == "appended":
        text += b'<AppendedData encoding="raw">_' + appended + b"</AppendedData>"
    return text + b"</VTKFile>"


def files() -> dict[str, bytes]:
    """Return the content of a small file of every kind, by name: the same box in each."""
    obj = "".join("v {:g} {:g} {:g}\n".format(*p) for p in POINTS)
    off = "OFF\n8 6 0\n" + "".join("{:g} {:g} {:g}\n".format(*p) for p in POINTS)
    off += "".join("4 {} {} {} {} 0.5 0.5 0.5\n".format(*q) for q in QUADS)
    facets = POINTS[TRIANGLES]
    stl = (
        b"\0" * 80 + struct.pack("<I", 12) + b"".join(b"\0" * 12 + f.astype("<f4").tobytes() + b"\0\0" for f in facets)
    )
    words = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {:g} {:g} {:g}\n".format(*p) for p in f)
        + "endloop\nendfacet\n"
        for f in facets
    )
    return {
        "box.obj": (obj + "".join("f {} {} {} {}\n".format(*q + 1) for q in QUADS)).encode(),
        "relative.obj": (obj + "".join("f {}//1 {}/2 {}/3/4 {}\n".format(*q - 8) for q in QUADS)).encode(),
        "text.ply": ply(""),
        "little.ply": ply("<"),
        "big.ply": ply(">"),
        "alike.ply": ply("<", mixed=False),
        "box.off": off.encode(),
        "binary.stl": stl,
        "text.stl": ("solid box\n" + words + "endsolid box\n").encode(),
        "box.glb": gltf(),
        "quantised.glb": quantised(),
        "sparse.glb": sparse(),
        "box.gltf": gltf(binary=False),
        "box.3mf": packed(MODEL.encode()),
        "box.dae": DAE.encode(),
        "text.vtk": vtk(False),
        "binary.vtk": vtk(True, "5.1"),
        "grid.vtk": vtk(True, grid=True),
        "text.vtp": vtk_xml("ascii"),
        "packed.vtp": vtk_xml("appended", compressed=True),
        "text.vtu": vtk_xml("ascii", grid=True),
        "packed.vtu": vtk_xml("binary", grid=True, compressed=True),
    }


# ---------------------------------------------------------------------------------------------- the damage

# fmt: off
NUMBERS = [
    "0", "1", "-1", "2", "3", "7", "127", "255", "256", "32768", "65535", "1000000", "2147483647", "4294967295",
    "99999999999", "1e308", "nan", "inf", "-0.0", "0.1",
]
# fmt: on


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes after a few random changes."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if not out:
            break
        at = rng.randrange(len(out))
        length = min(rng.choice((1, 2, 4, 8, 30, 200)), len(out) - at)
        match rng.randrange(8):
            case 0:
                out[at] ^= 1 << rng.randrange(8)
            case 1:
                out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 2:
                del out[at:]
            case 3:
                del out[at : at + length]
            case 4:
                out[at:at] = out[at : at + length] * rng.choice((1, 2, 50))
            case 5:
                to = rng.randrange(len(out))
                out[to : to + length] = out[at : at + length]
            case _:  # a number in text, else four bytes of one
                found = list(re.finditer(rb"-?[0-9][0-9.eE+-]*", out))
                if found and rng.random() < 0.8:
                    place = rng.choice(found)
                    out[place.start() : place.end()] = rng.choice(NUMBERS).encode()
                else:
                    out[at : at + 4] = struct.pack("<I", int(rng.choice((0, 1, 255, 65536, 2**31 - 1, 2**32 - 1))))
    return bytes(out)


def cases(count: int, seed: int) -> "list[tuple[str, bytes]]":
    """Return `count` damaged files; those of a packed kind are damaged inside half of the time."""
    rng = random.Random(seed)
    whole = files()
    found = []
    for k in range(count):
        name = list(whole)[k % len(whole)]
        if name.endswith(".3mf") and rng.random() < 0.7:
            data = packed(damaged(MODEL.encode(), rng))
        elif name == "box.gltf" and rng.random() < 0.5:
            name, data = "box.glb", gltf(False)
            document = json.loads(data)
            blob = base64.b64decode(document["buffers"][0].pop("uri").partition(",")[2])
            text = damaged(json.dumps(document).encode(), rng)
            text += b" " * (-len(text) % 4)
            chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
            data = b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
        else:
            data = damaged(whole[name], rng)
        found.append((name, data))
    return found


# --------------------------------------------------------------------------------------------- the loading


def work() -> None:
    """Load the files named on standard input, a line each, and answer in a line what came of each."""
    import warnings

    from tsdf.errors import TSDFError
    from tsdf.grain.grains import load_grain

    warnings.simplefilter("error")
    load_grain("snow")  # everything is imported and compiled
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        path = json.loads(line)
        try:
            load_grain(path)
            answer = "a grain"
        except TSDFError as error:
            answer = f"an error of ours: {error}"
            if "\n" in answer or Path(path).name not in answer or "memory" in answer:
                answer = f"wrong: {error}"
        except BaseException as error:
            answer = f"wrong: {type(error).__name__}: {error}"
        print(json.dumps(answer), flush=True)


class Loader:
    """A process that loads grains, replaced when it hangs or dies."""

    def __init__(self) -> None:
        command = [sys.executable, __file__, "--work"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer(600)  # the first may compile

    def _answer(self, seconds: float) -> str:
        if not select.select([self._process.stdout], [], [], seconds)[0]:
            return f"wrong: no answer within {seconds} s"
        line = self._process.stdout.readline()
        return json.loads(line) if line else "wrong: the process died"

    def load(self, path: Path) -> str:
        """Return what came of a file."""
        self._process.stdin.write(json.dumps(str(path)) + "\n")
        self._process.stdin.flush()
        answer = self._answer(SECONDS)
        if answer in ("wrong: the process died", f"wrong: no answer within {SECONDS} s"):
            self.close()
            self.__init__()  # type: ignore[misc]
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def main(count: int, seconds: float = float("inf"), seed: int = 0, keep: Path | None = None) -> Counter:
    """Load `count` damaged files, or as many as the time allows, and return how many ended how."""
    ends: Counter = Counter()
    slowest, begin = 0.0, time.monotonic()
    loader = Loader()
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, data) in enumerate(cases(count, seed)):
            if time.monotonic() - begin > seconds:
                break
            path = Path(folder, name)
            path.write_bytes(data)
            start = time.monotonic()
            answer = loader.load(path)
            slowest = max(slowest, time.monotonic() - start)
            ends[answer if answer.startswith("wrong") else answer.partition(":")[0]] += 1
            if answer.startswith("wrong"):
                print(f"{k} {name}: {answer}", flush=True)
                if keep is not None:
                    keep.mkdir(exist_ok=True)
                    (keep / f"{k}_{name}").write_bytes(data)
    loader.close()
    print(
        f"{sum(ends.values())} files, the slowest took {slowest:.1f} s:", ", ".join(f"{n} {e}" for e, n in ends.items())
    )
    return ends


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=10_000, help="files to try")
    options.add_argument("--seconds", type=float, default=float("inf"), help="time after which to stop")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--keep", type=Path, help="folder for the files that went wrong")
    options.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.work:
        sys.exit(work())
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    result = main(given.count, given.seconds, given.seed, given.keep)
    sys.exit(any(end.startswith("wrong") for end in result))
