"""Mesh files: what is read, within which bounds, and the triangles that come out.

Only the file types in `READERS` are opened, only regular files, and no file beside the one named but the buffers that
a .gltf lists in its own folder. Whatever a file announces is compared with what it holds before room is made for it: a
file below 10 MB takes less than 1 GB and 20 seconds, or is refused. STL is read through trimesh. Others are not, for it
fans concave polygons (OBJ, OFF, PLY, DAE), leaves out what it cannot find (DAE, 3MF) and takes each object of a second
model of a 3MF for all of them. DAE is read through pycollada, glTF by `gltf`, VTK by `vtk`, the rest here.
Nothing is checked here, nor merged but the equal corners of an STL: what makes a closed surface of it is `surface`.
"""

import io
import logging
import re
import stat
import warnings
import zipfile
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from tsdf.errors import GrainError
from tsdf.grain.gltf import read_gltf
from tsdf.grain.polygons import (
    MOST_PIECES,
    Budget,
    Floats,
    Ints,
    Part,
    strips_part,
    triangle_part,
    triangles_of,
    turned_over,
    whole,
)
from tsdf.grain.surface import compact, first_of_equals
from tsdf.grain.vtk import check_xml, numbers, read_vtk

LARGEST_FILE = 2**31  # bytes
WAY_OUT = "export it again, as OBJ, PLY, STL or GLB"


def read_mesh(path: Path) -> tuple[NDArray, NDArray]:
    """Return all triangles of a mesh file, placed as its scene places them, with nothing merged or checked.

    Parameters
    ----------
    path : Path
        A regular file, or a link to one, whose name ends as `READERS` lists.

    Returns
    -------
    vertices : (n, 3) float64
        In the file's unit.
    faces : (m, 3) int64

    Raises
    ------
    GrainError
        The file does not exist, is of a kind that is not read, cannot be read, announces more than it holds, or holds
        no faces.
    """
    try:
        _check_kind(path)
        data = path.read_bytes()
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            parts, size = READERS[path.suffix.lower()](data, path.parent)
            budget = Budget(size)
            faces = [triangles_of(budget.spend(part)) for part in parts]
    except GrainError as error:
        raise GrainError(f"{path}: {error}") from None
    except (MemoryError, RecursionError):
        raise GrainError(f"{path}: takes more memory than there is; simplify the mesh") from None
    except Exception as error:  # a damaged file: whatever reading it runs into
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise GrainError(f"{path}: cannot be read as a mesh ({reason}); {WAY_OUT}") from None
    if not any(map(len, faces)):
        what = "points or lines but no faces" if any(len(part.points) for part in parts) else "no mesh"
        raise GrainError(f"{path}: holds {what}; a grain is a closed triangle mesh")
    starts = np.cumsum([0] + [len(part.points) for part in parts[:-1]])
    return (
        np.vstack([part.points for part in parts]),
        np.vstack([f + start for f, start in zip(faces, starts, strict=True)]),
    )


def _check_kind(path: Path) -> None:
    """Refuse what is not a regular file of a kind that is read."""
    try:
        mode = path.stat()
    except (OSError, ValueError):
        raise GrainError("no such file, or it may not be read; name a mesh file") from None
    if stat.S_ISDIR(mode.st_mode):
        raise GrainError("is a directory; name a mesh file in it")
    if not stat.S_ISREG(mode.st_mode):
        raise GrainError("is not a regular file; name a mesh file")
    if path.suffix.lower() not in READERS:
        raise GrainError(f"not a kind of mesh file that is read ({', '.join(READERS)}); {WAY_OUT}")
    if mode.st_size == 0:
        raise GrainError("is empty; export the mesh again")
    if mode.st_size > LARGEST_FILE:
        raise GrainError(f"{mode.st_size} bytes are more than the {LARGEST_FILE} that are read; simplify the mesh")


# --------------------------------------------------------------------------------------------------- text


def _lines(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the words of each line of a text file, without comments, which may be in any encoding.

    A backslash at the end of a line goes on with the next.
    """
    words: list[str] = []
    for number, line in enumerate(data.decode("utf-8-sig", errors="replace").splitlines(), 1):
        text, comment, _ = line.partition("#")
        words += text.split()
        if words and not comment and words[-1].endswith("\\"):
            words[-1] = words[-1][:-1]
            continue
        if words := [word for word in words if word]:
            yield number, words
        words = []
    if words:
        yield number, words


def _positions(rows: list[list[str]], first: int = 0) -> Floats:
    """Return (n, 3) three numbers of each row of words."""
    return np.array([row[first : first + 3] for row in rows], np.float64).reshape(-1, 3)


PASSED_OVER = (b"#", b"vn", b"vt", b"g", b"o", b"s ", b"usemtl", b"mtllib")  # beginnings of lines of an OBJ
ODD = re.compile(rb"[\\\x0b\x0c\x1c-\x1e]|\xc2\x85|\xe2\x80[\xa8\xa9]")  # lines go on, or end by other characters


def _plain_obj(data: bytes) -> Part | None:
    """Vertices and faces of an OBJ as most programs write it, much faster than line by line; None of any other."""
    lines = data.splitlines()
    places, faces = ([line[2:] for line in lines if line.startswith(key)] for key in (b"v ", b"f "))
    left = (line for line in lines if not line.startswith((b"v ", b"f ")))
    if ODD.search(data) or not all(line.startswith(PASSED_OVER) or not line for line in left):
        return None
    indices = re.sub(rb"(?<=[0-9])/[0-9/]*", b"", b"\n".join([b"", *faces]))
    if re.search(rb"[^0-9\s]", indices):
        return None
    try:  # before each line stands a number that it must not have in it
        place = numbers(b"\nnan ".join([b"", *places]))
        corner = numbers(indices.replace(b"\n", b"\n0 "))
    except ValueError:
        return None
    begin, first = np.flatnonzero(np.isnan(place)), np.flatnonzero(corner == 0.0)
    if len(begin) != len(places) or len(first) != len(faces):
        return None
    if (np.diff(begin, append=len(place)) < 4).any() or not (corner < 2.0**53).all():
        return None
    sizes = np.diff(first, append=len(corner)) - 1
    return Part(place[begin[:, None] + np.arange(1, 4)], corner[corner > 0.0].astype(np.int64) - 1, sizes)


def _read_obj(data: bytes) -> list[Part]:
    """Vertices and faces of an OBJ; its materials and other files are left alone."""
    return [_plain_obj(data) or _obj_by_lines(data)]


def _obj_by_lines(data: bytes) -> Part:
    """Vertices and faces of any OBJ, also by relative indices."""
    places: list[list[str]] = []
    corners: list[int] = []
    sizes: list[int] = []
    for number, words in _lines(data):
        key = words[0]
        if key == "v":
            if len(words) < 4:
                raise ValueError(f"line {number}: a vertex of {len(words) - 1} numbers")
            places.append(words[1:4])
        elif key in ("f", "fo"):
            for word in words[1:]:
                index = int(word.partition("/")[0])
                corner = index - 1 if index > 0 else len(places) + index
                if index == 0 or corner < 0:
                    raise ValueError(f"line {number}: there is no vertex {index}")
                corners.append(corner)
            sizes.append(len(words) - 1)
        elif key in ("surf", "curv2", "call"):
            raise GrainError(f"line {number}: {key} (free-form surfaces, other files) is not read; {WAY_OUT}")
    return Part(_positions(places), np.array(corners, np.int64), np.array(sizes, np.int64))


def _read_off(data: bytes) -> list[Part]:
    """Vertices and faces of an OFF (also COFF, NOFF, STOFF), colours left out."""
    rows = [words for _, words in _lines(data)]
    if rows and rows[0][0].endswith("OFF"):
        kind, *rest = rows[0]
        if "BINARY" in rest or kind.startswith(("4", "n")):
            raise GrainError(f"{' '.join(rows[0])} is not read; {WAY_OUT}")
        rows = [rest, *rows[1:]] if rest else rows[1:]
    vertices, faces = (int(word) for word in rows[0][:2])
    if min(vertices, faces) < 0 or vertices + faces >= len(rows):
        raise ValueError(f"announces {vertices} vertices and {faces} faces in {len(rows) - 1} lines")
    places = _positions(rows[1 : 1 + vertices])
    corners: list[int] = []
    sizes = []
    for row in rows[1 + vertices : 1 + vertices + faces]:
        size = int(row[0])
        if not 0 <= size < len(row):
            raise ValueError(f"a face of {size} corners names {len(row) - 1}")
        corners += map(int, row[1 : 1 + size])
        sizes.append(size)
    return [Part(places, np.array(corners, np.int64), np.array(sizes, np.int64))]


# ---------------------------------------------------------------------------------------------------- PLY

# fmt: off
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}
# fmt: on


class Column(NamedTuple):
    """A property of a PLY: its name and type, and the type of its length if it is a list."""

    name: str
    kind: str
    length: str = ""


def _read_ply(data: bytes) -> list[Part]:
    """Vertices and faces of a PLY, in text or binary of either order, with any further properties."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r|$)", data)
    if not data.startswith(b"ply") or end is None:
        raise ValueError("no PLY header")
    body = data[end.end() :]
    order, elements = _ply_header(data[: end.start()])
    text = None if order else numbers(body)
    places, at = np.empty((0, 3)), 0
    faces: list[tuple[bool, Ints, Ints]] = []
    for name, rows, columns in elements:
        needed = rows * max(1, sum(1 if text is not None else np.dtype(c.length or c.kind).itemsize for c in columns))
        if not 0 <= needed <= (len(body) if text is None else len(text)) - at:
            raise ValueError(f"announces {rows} of {name} and holds fewer")
        if not columns:
            continue
        if rows > Budget(len(data)).most and any(column.length for column in columns):
            raise GrainError(f"announces {rows} of {name}, more than are read; simplify the mesh")
        if text is None:
            values, at = _binary_rows(body, at, rows, columns, order)
        else:
            values, at = _text_rows(text, at, rows, columns)
        if name == "vertex":
            places = np.column_stack([values[axis] for axis in "xyz"]).astype(np.float64)
        key = next((c.name for c in columns if c.length and c.name in ("vertex_indices", "vertex_index")), None)
        if name in ("face", "tristrips") and key is not None:
            faces.append((name == "tristrips", whole(values[key][0]), values[key][1]))
    parts = [
        _strips(places, corners, sizes) if strips else Part(places, corners, sizes) for strips, corners, sizes in faces
    ]
    return parts or [Part(places, np.empty(0, np.int64), np.empty(0, np.int64))]


def _ply_header(header: bytes) -> tuple[str, list[tuple[str, int, list[Column]]]]:
    """Return the order of bytes, "" for text, and the elements of a PLY: name, rows, columns."""
    order: str | None = None
    elements: list[tuple[str, int, list[Column]]] = []
    for line in header.decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as name, *_]:
                order = {"a": "", "l": "<", "b": ">"}[name.removeprefix("binary_")[0]]
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1][2].append(Column(name, PLY_TYPES[kind], PLY_TYPES[length]))
            case ["property", kind, name]:
                elements[-1][2].append(Column(name, PLY_TYPES[kind]))
    if order is None:
        raise ValueError("no format in its header")
    return order, elements


def _strips(places: Floats, corners: Ints, sizes: Ints) -> Part:
    """Return the triangles of strips that −1 ends."""
    rows = np.split(corners, np.cumsum(sizes)[:-1])
    return strips_part(
        places, [s[s >= 0] for row in rows for s in np.split(row, np.flatnonzero(row < 0)[:MOST_PIECES])]
    )


def _binary_rows(body: bytes, at: int, count: int, columns: list[Column], order: str) -> tuple[dict[str, Any], int]:
    """Return the columns of `count` rows, a list as its flat values and lengths, and where they end."""

    def alike(lengths: list[int]) -> np.dtype:
        """The type of a row whose lists have these lengths."""
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        left = iter(lengths)
        for k, column in enumerate(columns):
            if column.length:
                fields.append((f"length{k}", order + column.length))
                fields.append((f"value{k}", order + column.kind, (next(left),)))
            else:
                fields.append((f"value{k}", order + column.kind))
        return np.dtype(fields)

    def lengths_at(at: int) -> tuple[list[int], int]:
        """The lengths of the lists of the row that begins here, and where it ends."""
        found = []
        for size, kind in widths:
            if kind:
                length = int.from_bytes(body[at : at + size], endian, signed=kind[0] == "i")
                found.append(length)
                at += size
                if length < 0:
                    raise ValueError("a list of negative length")
                at += length * next_widths[len(found) - 1]
            else:
                at += size
        if at > len(body):
            raise ValueError("ends within a face")
        return found, at

    if any(column.length.startswith("f") for column in columns):
        raise ValueError("the length of a list is no whole number")
    endian: Any = "big" if order == ">" else "little"
    widths = [(np.dtype(c.length or c.kind).itemsize, c.length) for c in columns]
    next_widths = [np.dtype(c.kind).itemsize for c in columns if c.length]
    values: dict[str, Any] = {}
    lists = [k for k, column in enumerate(columns) if column.length]
    if count == 0:
        return {c.name: (np.empty(0, np.int64),) * 2 if c.length else np.empty(0) for c in columns}, at
    row = alike(lengths_at(at)[0])
    if count * row.itemsize <= len(body) - at:
        table = np.frombuffer(body, row, count, at)
        if all((table[f"length{k}"] == row[f"value{k}"].shape[0]).all() for k in lists):  # all rows like the first
            for k, column in enumerate(columns):
                value = table[f"value{k}"]
                values[column.name] = (value.reshape(-1), np.full(count, value.shape[1])) if column.length else value
            return values, at + count * row.itemsize
    starts, lengths = [], []
    for _ in range(count):
        starts.append(at)
        found, at = lengths_at(at)
        lengths.append(found)
    begin, sizes, raw = np.array(starts), np.array(lengths), np.frombuffer(body, np.uint8)
    for k, column in enumerate(columns):
        if column.length:
            mine = sizes[:, lists.index(k)]
            begin = begin + np.dtype(column.length).itemsize
        else:
            mine = np.ones(count, np.int64)
        width = np.dtype(column.kind).itemsize
        first = np.repeat(begin - width * (np.cumsum(mine) - mine), mine) + width * np.arange(mine.sum())
        value = raw[first[:, None] + np.arange(width)].reshape(-1).view(order + column.kind)
        values[column.name] = (value, mine) if column.length else value
        begin = begin + width * mine
    return values, at


def _text_rows(text: Floats, at: int, count: int, columns: list[Column]) -> tuple[dict[str, Any], int]:
    """Return what `_binary_rows` does, of numbers in text."""
    lists = [k for k, column in enumerate(columns) if column.length]
    if not lists:
        table = text[at : at + count * len(columns)].reshape(count, -1)
        return {column.name: table[:, k] for k, column in enumerate(columns)}, at + table.size
    found: list[list[float]] = [[] for _ in columns]
    sizes: list[list[int]] = [[] for _ in columns]
    words = text[at:].tolist()
    i = 0
    for _ in range(count):
        for k, column in enumerate(columns):
            length = 1
            if column.length:
                length = int(words[i])
                i += 1
            if length < 0 or i + length > len(words):
                raise ValueError("ends within a face")
            found[k] += words[i : i + length]
            sizes[k].append(length)
            i += length
    return {
        column.name: (np.array(found[k]), np.array(sizes[k], np.int64)) if column.length else np.array(found[k])
        for k, column in enumerate(columns)
    }, at + i


# ---------------------------------------------------------------------------------------------------- STL

VERTEX = re.compile(rb"^[ \t]*vertex\s+\S+\s+\S+\s+\S+", re.MULTILINE | re.IGNORECASE)


def _read_stl(data: bytes) -> list[Part]:
    """Facets of an STL through trimesh, equal corners as one vertex.

    It is binary if the number of facets that it would announce then fits its length. Of a text trimesh sees the vertex
    lines alone, as one solid: it takes quadratic time in the number of solids (139 s for 20,000), leaves out one that
    is cut off, and takes words of a name for vertices.
    """
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and (len(data) == 84 + 50 * count or data.lstrip()[:5].lower() != b"solid"):
        if 84 + 50 * count > len(data):
            raise ValueError(f"announces {count} facets and holds {max(0, len(data) - 84) // 50}")
        data = data[: 84 + 50 * count]
    else:
        lines = VERTEX.findall(data.replace(b"\r", b"\n"))
        if len(lines) % 3:
            raise ValueError("ends within a facet")
        count = len(lines) // 3
        data = b"solid\n" + b"\n".join(b" ".join(line.split()) for line in lines) + b"\nendsolid\n"
    if count == 0:
        return []
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    import trimesh

    mesh = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
    corners = np.asarray(mesh.triangles, np.float64).reshape(-1, 3)
    if len(corners) != 3 * count:
        raise ValueError(f"{count} facets are there, {len(corners) // 3} can be read")
    return [triangle_part(*compact(corners, first_of_equals(corners).reshape(-1, 3)))]


# --------------------------------------------------------------------------------------------- 3MF and DAE

INFLATED = 100_000_000  # bytes of the models in a 3MF
MAY_REQUIRE = (
    "http://schemas.microsoft.com/3dmanufacturing/production/2015/06",
    "http://schemas.microsoft.com/3dmanufacturing/material/2015/02",
)
SHAPES = ("beamlattice", "booleanshape", "displacementmesh", "implicitfunction", "levelset", "slicestack")


def _read_3mf(data: bytes) -> list[Part]:
    """The build items of a 3MF, placed."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    models = [entry for entry in archive.infolist() if entry.filename.lower().endswith(".model")]
    if sum(entry.file_size for entry in models) > INFLATED:
        raise GrainError(f"its models are larger than {INFLATED} bytes when inflated; export it as PLY or STL")
    objects: dict[tuple[str, str], tuple[Part | None, list[tuple[str, str, Floats]]]] = {}
    budget = Budget(len(data))
    items: list[tuple[str, str, Floats]] = []
    for entry in models:
        file = "/" + entry.filename.lstrip("/").lower()
        with archive.open(entry) as stream:
            mine = _read_model(stream, file, objects, budget.most)
        if not file.startswith("/3d/objects") and (file.endswith("3dmodel.model") or len(models) == 1):
            items += mine
    parts: list[Part] = []
    waiting = [(*item, 0) for item in items]
    while waiting:
        file, index, matrix, depth = waiting.pop()
        if (file, index) not in objects:
            raise ValueError(f"object {index} is not there")
        part, components = objects[file, index]
        if part is not None:
            placed = part._replace(points=part.points @ matrix[:3] + matrix[3])
            parts.append(budget.spend(turned_over(placed) if np.linalg.det(matrix[:3]) < 0 else placed))
        budget.take(0)
        if depth > 32 or len(waiting) + len(components) > MOST_PIECES:
            raise GrainError(f"objects within objects more than 32 deep, or more than {MOST_PIECES} of them; {WAY_OUT}")
        for below, name, inner in components:
            waiting.append(
                (below, name, np.vstack([inner[:3] @ matrix[:3], inner[3] @ matrix[:3] + matrix[3]]), depth + 1)
            )
    return parts


def _read_model(stream: Any, file: str, objects: dict, most: int) -> list[tuple[str, str, Floats]]:
    """Add the objects of one model of a 3MF to `objects` and return its build items: file, object, matrix (4, 3)."""

    def target(attributes: dict[str, str]) -> tuple[str, str, Floats]:
        elsewhere = next((value for key, value in attributes.items() if key.rpartition("}")[2] == "path"), file)
        words = attributes.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
        return "/" + elsewhere.lstrip("/").lower(), attributes["objectid"], np.array(words, float).reshape(4, 3)

    items, components = [], []
    points, faces = array("d"), array("q")
    spaces: dict[str, str] = {}
    meshes: list[Part] = []
    identity = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal identity
        name = tag.rpartition("}")[2]
        if name == "vertex":
            points.append(float(attributes["x"]))
            points.append(float(attributes["y"]))
            points.append(float(attributes["z"]))
        elif name == "triangle":
            faces.append(int(attributes["v1"]))
            faces.append(int(attributes["v2"]))
            faces.append(int(attributes["v3"]))
        elif name == "object":
            identity = attributes["id"]
        elif name == "component":
            components.append(target(attributes))
        elif name == "item":
            items.append(target(attributes))
        elif name == "model":
            for prefix in attributes.get("requiredextensions", "").split():
                if spaces.get(prefix) not in MAY_REQUIRE:
                    raise GrainError(f"needs the extension {spaces.get(prefix, prefix)}; {WAY_OUT}")
        elif name in SHAPES:
            raise GrainError(f"holds a {name}, which is not read; {WAY_OUT}")
        if len(points) > 6 * most or len(faces) > 3 * most:
            raise GrainError(f"a mesh of more than {most} triangles; simplify it, or export it as PLY or STL")

    def end(tag: str) -> None:
        name = tag.rpartition("}")[2]
        if name == "mesh":
            meshes.append(triangle_part(np.array(points).reshape(-1, 3), np.array(faces).reshape(-1, 3)))
            del points[:], faces[:]
        elif name == "object":
            objects[file, identity] = (meshes[0] if meshes else None, list(components))
            del meshes[:], components[:]

    def doctype(*_: Any) -> None:
        raise GrainError(f"its XML declares a document type; {WAY_OUT}")

    parser = expat.ParserCreate(namespace_separator="}")
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    parser.StartNamespaceDeclHandler = lambda prefix, space: spaces.update({prefix: space})
    parser.ParseFile(stream)
    return items


def _read_dae(data: bytes) -> list[Part]:
    """The triangles and polygons of a COLLADA scene, placed, through pycollada."""
    check_xml(data)
    try:
        import collada
    except ImportError:
        raise GrainError("DAE needs the package pycollada; pip install pycollada") from None
    document = collada.Collada(io.BytesIO(data), ignore=[collada.common.DaeError])
    if document.errors:  # pycollada leaves out what it could not follow
        raise ValueError(str(document.errors[0]))
    parts: list[Part] = []
    budget = Budget(len(data))
    if document.scene is None:
        return parts
    for shape in document.scene.objects("geometry"):
        mirrored = np.linalg.det(shape.matrix[:3, :3]) < 0
        for primitive in shape.primitives():
            if getattr(primitive, "vertex", None) is None or primitive.vertex_index is None:
                continue
            index = np.asarray(primitive.vertex_index, np.int64)
            if hasattr(primitive, "polyindex"):
                sizes = np.diff(primitive.polyindex)[:, 0].astype(np.int64)
                part = Part(primitive.vertex, index.reshape(-1), sizes)
            elif index.ndim == 2 and index.shape[1] == 3:
                part = triangle_part(primitive.vertex, index)
            else:
                continue
            parts.append(budget.spend(turned_over(part) if mirrored else part))
    return parts


# ------------------------------------------------------------------------------------------------ the list


def _alone(read: Callable[[bytes], list[Part]]) -> Callable[[bytes, Path], tuple[list[Part], int]]:
    """Return a reader that looks at the file itself only."""
    return lambda data, folder: (read(data), len(data))


READERS: dict[str, Callable[[bytes, Path], tuple[list[Part], int]]] = {
    ".obj": _alone(_read_obj),
    ".ply": _alone(_read_ply),
    ".stl": _alone(_read_stl),
    ".off": _alone(_read_off),
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".3mf": _alone(_read_3mf),
    ".dae": _alone(_read_dae),
    ".vtk": _alone(read_vtk),
    ".vtp": _alone(read_vtk),
    ".vtu": _alone(read_vtk),
}
