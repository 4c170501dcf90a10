"""VTK files: the polygons of a legacy .vtk, a .vtp or a .vtu; the voxels of a legacy .vtk or a .vti.

Points, polygons and triangle strips of PolyData, and the flat cells of an unstructured grid; a grid of volumes is
refused, for its surface is another tool's to find. Text and binary, and in XML appended and compressed by zlib or lzma.
Source: VTK File Formats, https://docs.vtk.org/en/latest/vtk_file_formats/.
"""

import base64
import lzma
import re
import warnings
import zlib
from collections.abc import Sequence
from itertools import islice
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tsdf.errors import GrainError
from tsdf.grain.polygons import Budget, Floats, Ints, Part, strips_part, whole

MOST_NUMBERS = 9_000_000  # of one array, or one for each byte: a compressed one takes room that its bytes do not show
# fmt: off
LEGACY_TYPES = {
    "unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
    "unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4",
    "vtktypeint64": "i8", "vtktypeuint64": "u8", "vtktypeint32": "i4",
}
XML_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}
# fmt: on
MOST_VOXELS = 512_000_000  # of an image: 800^3
IMAGE = "ImageData"
SURFACE = "save it as .vtp or .stl"
WORD = re.compile(rb"\S+")
NO_FACE, TRIANGLE, STRIP, POLYGON, PIXEL, QUAD = (1, 2, 3, 4), 5, 6, 7, 8, 9  # cell types


def numbers(text: bytes) -> Floats:
    """Return the numbers of a text, separated by white space, as float64.

    Raises
    ------
    ValueError
        Something in it is no number.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text.decode("ascii"), np.float64, sep=" ") if text.strip() else np.empty(0)
        except (DeprecationWarning, UnicodeDecodeError):
            raise ValueError("something in it is no number") from None


def read_vtk(data: bytes) -> list[Part]:
    """Return the parts of a legacy or XML file.

    Raises
    ------
    GrainError
        A data set without surfaces, cells that are not flat, a compression that is not read.
    Exception
        Whatever a damaged file leads to.
    """
    return _legacy(data) if data.startswith(b"# vtk") else _xml(data)


def _part(points: Floats, corners: Ints, sizes: Ints, types: Ints | None = None) -> list[Part]:
    """Return the parts of cells: all polygons if no types are given."""
    if sizes.min(initial=0) < 0 or sizes.sum() != len(corners):
        raise ValueError(f"{sizes.sum()} corners of cells are announced, {len(corners)} are there")
    if types is None:
        return [Part(points, corners, sizes)]
    if len(types) != len(sizes):
        raise ValueError(f"{len(sizes)} cells have {len(types)} types")
    wrong = np.setdiff1d(types, (*NO_FACE, TRIANGLE, STRIP, POLYGON, PIXEL, QUAD))
    if len(wrong):
        fault = f"holds cells of VTK type {wrong[0]}, volumes or curved ones"
        raise GrainError(f"{fault}; extract the surface (ParaView: Extract Surface) and save it as .vtp or .stl")
    starts = np.cumsum(sizes) - sizes
    corners = corners.copy()
    for at in starts[(types == PIXEL) & (sizes == 4)]:
        corners[at + 2 : at + 4] = corners[[at + 3, at + 2]]
    flat = np.isin(types, (TRIANGLE, POLYGON, PIXEL, QUAD))
    parts = [Part(points, corners[np.repeat(flat, sizes)], sizes[flat])]
    strips = types == STRIP
    return parts + _strips(points, corners[np.repeat(strips, sizes)], sizes[strips])


def _strips(points: Floats, corners: Ints, sizes: Ints) -> list[Part]:
    """Return the parts of triangle strips."""
    if len(sizes) == 0 or sizes.min() < 0 or sizes.sum() != len(corners):
        return _part(points, corners, sizes)  # none, or refused
    return [strips_part(points, np.split(corners, np.cumsum(sizes)[:-1]))]


# ------------------------------------------------------------------------------------------------- legacy


class _Words:
    """A legacy file, read from front to back."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0
        self.version = self.line().split()[-1]
        self.line()  # the title
        self.text = self.line().strip().upper() == "ASCII"

    def line(self) -> str:
        """Return the line that begins here."""
        end = self._data.find(b"\n", self._at)
        end = len(self._data) if end < 0 else end
        line, self._at = self._data[self._at : end], end + 1
        return line.decode("latin-1").strip()

    def words(self) -> list[str]:
        """Return the words of the next line that has any; none at the end."""
        while self._at < len(self._data):
            if words := self.line().split():
                return words
        return []

    def array(self, count: int, kind: str) -> NDArray:
        """Return the `count` numbers that begin here."""
        if self.text:
            if not 0 <= count <= len(self._data) - self._at:
                raise ValueError(f"announces {count} numbers and holds fewer")
            last = next(islice(WORD.finditer(self._data, self._at), count - 1, None), None) if count else None
            end = last.end() if last else self._at
            values, self._at = numbers(self._data[self._at : end]), end
            if len(values) != count:
                raise ValueError(f"announces {count} numbers and holds {len(values)}")
            return values
        size = np.dtype(kind).itemsize * count
        if not 0 <= size <= len(self._data) - self._at:
            raise ValueError(f"announces {count} numbers and holds fewer")
        values = np.frombuffer(self._data, ">" + kind, count, self._at)
        self._at += size
        return values


def _legacy(data: bytes) -> list[Part]:
    words = _Words(data)
    dataset, points, parts = "", np.empty((0, 3)), []
    cells: tuple[Ints, Ints] | None = None
    while head := words.words():
        key = head[0].upper()
        if key == "DATASET":
            dataset = head[1].upper()
            if dataset not in ("POLYDATA", "UNSTRUCTURED_GRID"):
                raise GrainError(f"a data set of kind {dataset} has no surface; save its surface as .vtp or .stl")
        elif key == "POINTS":
            points = words.array(3 * int(head[1]), LEGACY_TYPES[head[2].lower()]).reshape(-1, 3).astype(np.float64)
        elif key in ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS"):
            if int(head[1]) > Budget(len(data)).most:
                raise GrainError(f"announces {head[1]} cells, more than are read; simplify the surface")
            corners, sizes = _legacy_cells(words, int(head[1]), int(head[2]))
            if key == "POLYGONS":
                parts += _part(points, corners, sizes)
            elif key == "TRIANGLE_STRIPS":
                parts += _strips(points, corners, sizes)
            elif key == "CELLS":
                cells = corners, sizes
        elif key == "CELL_TYPES":
            if cells is None:
                raise ValueError("has types of cells and no cells")
            parts += _part(points, *cells, whole(words.array(int(head[1]), "i4")))
        elif key == "METADATA":
            while words.line():
                pass
        elif key == "FIELD":
            for _ in range(int(head[2])):
                _, width, count, kind = words.words()[:4]
                words.array(int(width) * int(count), LEGACY_TYPES[kind.lower()])
        elif key in ("POINT_DATA", "CELL_DATA"):
            break
        else:
            raise ValueError(f"{key[:20]!r} is not known")
    return parts or [Part(points, np.empty(0, np.int64), np.empty(0, np.int64))]


def _legacy_cells(words: _Words, count: int, size: int) -> tuple[Ints, Ints]:
    """Return the corners and sizes of cells: since version 5 by offsets, before that each after its size."""
    if words.version.split(".")[0] >= "5":
        arrays = []
        for name, length in (("OFFSETS", count), ("CONNECTIVITY", size)):
            head = words.words()
            if len(head) < 2 or head[0].upper() != name:
                raise ValueError(f"has no {name} of its cells")
            arrays.append(whole(words.array(length, LEGACY_TYPES[head[1].lower()])))
        return arrays[1], np.diff(arrays[0])
    values = whole(words.array(size, "i4"))
    at, starts = 0, []
    listed = values.tolist()
    for _ in range(count):
        if at >= len(listed) or listed[at] < 0:
            raise ValueError("ends within a cell")
        starts.append(at)
        at += 1 + listed[at]
    if at != len(listed):
        raise ValueError("ends within a cell")
    kept = np.ones(len(listed), bool)
    kept[starts] = False
    return values[kept], values[starts]


# ---------------------------------------------------------------------------------------------------- XML


def check_xml(data: bytes) -> None:
    """Refuse XML that declares a document type, for entities grow without bound, or that is not in UTF-8."""
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
        raise GrainError("its XML declares a document type or is not UTF-8; save it as .stl or .ply")


def _xml_file(data: bytes, *kinds: str) -> "tuple[ElementTree.Element, _Arrays]":
    """Return the root of a file whose data set is of one of these kinds, and its arrays."""
    head, mark, tail = data.partition(b"<AppendedData")
    appended = b""
    if mark:  # raw bytes are no XML: cut them out
        tag, _, rest = tail.partition(b">")
        appended = rest.partition(b"_")[2]
        if b"base64" in tag:
            appended = appended.partition(b"<")[0]
        data = head + b"</VTKFile>"
    check_xml(data)
    root = ElementTree.fromstring(data)
    if root.tag != "VTKFile" or root.get("type") not in kinds:
        kind = root.get("type", root.tag)
        if kinds == (IMAGE,):
            raise GrainError(f"a data set of kind {kind} is no image; save voxels as ImageData (.vti)")
        raise GrainError(f"a data set of kind {kind} has no surface; {SURFACE}")
    most = max(MOST_VOXELS if kinds == (IMAGE,) else MOST_NUMBERS, len(data) + len(appended))
    return root, _Arrays(root, appended, b"base64" in tag if mark else False, most)


def _xml(data: bytes) -> list[Part]:
    root, arrays = _xml_file(data, "PolyData", "UnstructuredGrid")
    parts: list[Part] = []
    for piece in root.iter("Piece"):
        node = piece.find("Points/DataArray")
        count = int(piece.get("NumberOfPoints", 0))
        points = np.empty((0, 3)) if node is None or count == 0 else arrays.of(node, 3 * count).reshape(-1, 3)
        points = points.astype(np.float64)
        for tag_name, key in (("Polys", "NumberOfPolys"), ("Strips", "NumberOfStrips"), ("Cells", "NumberOfCells")):
            section, cells = piece.find(tag_name), int(piece.get(key, 0))
            if section is None or cells == 0:
                continue
            named = {node.get("Name"): node for node in section.iter("DataArray")}
            ends = whole(arrays.of(named["offsets"], cells))
            sizes = np.diff(ends, prepend=0)
            corners = whole(arrays.of(named["connectivity"], int(ends[-1])))
            types = whole(arrays.of(named["types"], cells)) if tag_name == "Cells" else None
            parts += _strips(points, corners, sizes) if tag_name == "Strips" else _part(points, corners, sizes, types)
        if not parts:
            parts.append(Part(points, np.empty(0, np.int64), np.empty(0, np.int64)))
    return parts


class _Arrays:
    """The data arrays of an XML file."""

    def __init__(self, root: ElementTree.Element, appended: bytes, base64_appended: bool, most: int) -> None:
        self._most = most
        self._order = ">" if root.get("byte_order") == "BigEndian" else "<"
        self._header = np.dtype(self._order + XML_TYPES[root.get("header_type", "UInt32")])
        self._appended, self._base64_appended = appended, base64_appended
        compressor = root.get("compressor")
        known: dict[Any, Any] = {
            None: None,
            "vtkZLibDataCompressor": zlib.decompressobj,
            "vtkLZMADataCompressor": lzma.LZMADecompressor,
        }
        if compressor not in known:
            raise GrainError(f"is compressed by {compressor}, which is not read; save it without compression")
        self._inflater = known[compressor]

    def of(self, node: ElementTree.Element, count: int) -> NDArray:
        """Return the `count` numbers of a DataArray."""
        if not 0 <= count <= self._most:
            raise GrainError(f"announces an array of {count} numbers, more than {self._most}; save it as .stl or .ply")
        kind = np.dtype(self._order + XML_TYPES[node.attrib["type"]])
        form, size = node.get("format", "ascii"), count * kind.itemsize
        if form == "ascii":
            values = numbers((node.text or "").encode())
        else:
            if form == "binary":
                data, coded = (node.text or "").strip().encode(), True
            elif form == "appended":
                data, coded = self._appended[int(node.attrib["offset"]) :], self._base64_appended
            else:
                raise ValueError(f"an array of format {form}")
            values = np.frombuffer(self._plain(data, coded, size), kind)
        if len(values) != count:
            raise ValueError(f"announces {count} numbers and holds {len(values)}")
        return values

    def _plain(self, data: bytes, coded: bool, size: int) -> bytes:
        """Return the `size` bytes that a block of data stands for."""
        width = self._header.itemsize

        def header(numbers: int) -> Ints:
            """The first whole numbers of the block."""
            length = numbers * width
            raw = base64.b64decode(data[: -(-length // 3) * 4]) if coded else data
            return np.frombuffer(raw[:length], self._header, numbers).astype(np.int64)

        if self._inflater is None:
            if header(1)[0] != size:
                raise ValueError(f"an array of {header(1)[0]} bytes should have {size}")
            whole = base64.b64decode(data[: -(-(width + size) // 3) * 4]) if coded else data
            return whole[width : width + size]
        blocks, block, last = (int(n) for n in header(3))
        if not (0 <= blocks <= len(data) and 0 <= last <= max(block, 0)):
            raise ValueError("a compressed array whose header is damaged")
        if max(blocks - (last > 0), 0) * block + last != size:
            raise ValueError(f"a compressed array of other than {size} bytes")
        lengths = header(3 + blocks)[3:]
        if lengths.min(initial=0) < 0 or lengths.sum() > len(data):
            raise ValueError("a compressed array whose header is damaged")
        length = (3 + blocks) * width
        begin = -(-length // 3) * 4 if coded else length
        body = data[begin:]
        if coded:
            body = base64.b64decode(body[: -(-int(lengths.sum()) // 3) * 4])
        found, at = [], 0
        for k, packed in enumerate(lengths.tolist()):
            room = last if last and k == blocks - 1 else block
            found.append(self._inflater().decompress(body[at : at + packed], room))
            if len(found[-1]) != room:
                raise ValueError("a compressed array whose blocks are damaged")
            at += packed
        return b"".join(found)


# ------------------------------------------------------------------------------------------------- voxels


class Image(NamedTuple):
    """Voxels of an image: values (nx, ny, nz) of its first array of single numbers, and their size along x, y, z."""

    values: NDArray
    spacing: tuple[float, ...]


def read_image(data: bytes) -> Image:
    """Return the voxels of a legacy or XML file, at its points or in its cells.

    Raises
    ------
    GrainError
        Another kind of data set, more than `MOST_VOXELS` voxels, no array of single numbers.
    Exception
        Whatever a damaged file leads to.
    """
    return _legacy_image(data) if data.startswith(b"# vtk") else _xml_image(data)


def _image(values: NDArray, points: Sequence[int], spacing: Sequence[float]) -> Image:
    """Return the image of a number at each of so many points along x, y, z, or in each of the cells between."""
    cells = [max(n - 1, 1) for n in points]
    shape = points if len(values) == np.prod(points, dtype=object) else cells
    return Image(values.reshape(tuple(shape), order="F"), tuple(map(float, spacing)))


def _check_count(count: int) -> None:
    if count > MOST_VOXELS:
        raise GrainError(f"{count} voxels are more than {MOST_VOXELS}; crop it, or take every second voxel")


def _legacy_image(data: bytes) -> Image:
    words = _Words(data)
    points, spacing, count = [0, 0, 0], [1.0, 1.0, 1.0], 0
    while head := words.words():
        key = head[0].upper()
        if key == "DATASET" and head[1].upper() != "STRUCTURED_POINTS":
            raise GrainError(f"a data set of kind {head[1].upper()} is no image; save voxels as STRUCTURED_POINTS")
        if key == "DIMENSIONS":
            points = [int(n) for n in head[1:4]]
        elif key in ("SPACING", "ASPECT_RATIO"):
            spacing = [float(n) for n in head[1:4]]
        elif key in ("POINT_DATA", "CELL_DATA"):
            _check_count(count := int(head[1]))
        elif key == "SCALARS":
            if head[3:] not in ([], ["1"]):
                raise GrainError("holds vectors or colours, not one number for each voxel")
            if words.words()[:1] != ["LOOKUP_TABLE"]:
                raise ValueError("has no LOOKUP_TABLE after SCALARS")
            return _image(words.array(count, LEGACY_TYPES[head[2].lower()]), points, spacing)
        elif key == "FIELD":
            _, width, number, kind = words.words()[:4]
            if width != "1":
                raise GrainError("holds vectors or colours, not one number for each voxel")
            return _image(words.array(int(number), LEGACY_TYPES[kind.lower()]), points, spacing)
        elif key not in ("DATASET", "ORIGIN"):
            raise ValueError(f"{key[:20]!r} is not known")
    raise GrainError("holds no voxels")


def _xml_image(data: bytes) -> Image:
    root, arrays = _xml_file(data, IMAGE)
    image = root.find(IMAGE)
    pieces = [] if image is None else image.findall("Piece")
    if image is None or len(pieces) != 1:
        raise GrainError(f"an image in {len(pieces)} pieces; save it as one")
    ends = [int(n) for n in pieces[0].get("Extent", image.get("WholeExtent", "")).split()]
    points = [high - low + 1 for low, high in zip(ends[::2], ends[1::2], strict=True)]
    for section, shape in (("PointData", points), ("CellData", [max(n - 1, 1) for n in points])):
        for node in pieces[0].iterfind(f"{section}/DataArray"):
            if node.get("NumberOfComponents", "1") == "1":
                _check_count(count := int(np.prod(shape, dtype=object)))
                spacing = [float(n) for n in image.get("Spacing", "1 1 1").split()]
                return _image(arrays.of(node, count), points, spacing)
    raise GrainError("holds no voxels, one number for each")
