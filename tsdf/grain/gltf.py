"""glTF 2.0: the triangles of a .glb or .gltf, placed as its scene places them.

Geometry alone: accessors (normalised integers, sparse, interleaved), strips and fans, the transforms of nodes. What
the file needs beyond that is decoded (Draco, through DracoPy, whose only door this is) or refused by its name.
Buffers are read from the file itself and from files that it lists in its own folder.
Source: Khronos Group, glTF 2.0 Specification, ISO/IEC 12113:2022.
"""

import base64
import json
import stat
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from tsdf.errors import GrainError
from tsdf.grain.polygons import (
    MOST_PIECES,
    Budget,
    Floats,
    Ints,
    Part,
    fan_triangles,
    strip_triangles,
    triangle_part,
    turned_over,
)

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3}
MOST_MADE = 5_000_000  # numbers of accessors that are sparse or without a buffer: nothing in the file stands for them
NOT_SHAPE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp")
DRACO, MESHOPT = "KHR_draco_mesh_compression", "EXT_meshopt_compression"
READ = ("KHR_mesh_quantization", DRACO)
WAY_OUT = "export it without, or as OBJ, PLY or STL"


def read_gltf(data: bytes, folder: Path) -> tuple[list[Part], int]:
    """Return the parts of a file's scene, and the bytes of the file and the buffers it lists.

    Parameters
    ----------
    data : bytes
        A .glb or .gltf.
    folder : Path
        Where its buffers are looked for.

    Raises
    ------
    GrainError
        An extension that is not read, a buffer that is elsewhere.
    Exception
        Whatever a damaged file leads to.
    """
    return _Document(data, folder).parts()


class _Document:
    """A file's JSON and its buffers."""

    def __init__(self, data: bytes, folder: Path) -> None:
        self.size, self._folder, self._binary = len(data), folder, b""
        text = data
        if data[:4] == b"glTF":
            version, length = (int.from_bytes(data[k : k + 4], "little") for k in (4, 8))
            if version != 2:
                raise GrainError(f"glTF of version {version} is not read; export it as glTF 2.0")
            if not 20 <= length <= len(data):
                raise ValueError(f"announces {length} bytes and holds {len(data)}")
            chunks, at = [], 12
            while at + 8 <= length:
                room = int.from_bytes(data[at : at + 4], "little")
                if at + 8 + room > length:
                    raise ValueError("ends within a chunk")
                chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + room]))
                at += 8 + room
            if not chunks or chunks[0][0] != b"JSON":
                raise ValueError("has no JSON")
            text = chunks[0][1]
            self._binary = next((chunk for kind, chunk in chunks[1:2] if kind == b"BIN\0"), b"")
        self._json = json.loads(text.decode("utf-8-sig"))
        if not str(self._json["asset"]["version"]).startswith("2"):
            raise GrainError(f"glTF of version {self._json['asset']['version']} is not read; export it as glTF 2.0")
        self._required = tuple(map(str, self._json.get("extensionsRequired", ())))
        for name in self._required:
            if name not in READ and not name.startswith(NOT_SHAPE):
                raise GrainError(f"needs the extension {name}, which is not read; {WAY_OUT}")
        self._buffers: dict[int, NDArray[np.uint8]] = {}
        self._meshes: dict[int, list[Part]] = {}
        self._made: dict[int, NDArray] = {}
        self._budget: Budget | None = None

    def _item(self, what: str, index: Any) -> dict:
        """Return an object of one of the file's lists."""
        items = self._json.get(what, [])
        if type(index) is not int or not 0 <= index < len(items):
            raise ValueError(f"there is no {index} among its {len(items)} {what}")
        return items[index]

    # ------------------------------------------------------------------------------------------- the scene

    def parts(self) -> tuple[list[Part], int]:
        """Return what `read_gltf` does."""
        nodes = self._json.get("nodes", [])
        if self._json.get("scenes"):
            roots = self._item("scenes", self._json.get("scene", 0)).get("nodes", [])
        else:
            below = {child for node in nodes for child in node.get("children", ())}
            roots = [k for k in range(len(nodes)) if k not in below]
        found: list[Part] = []
        seen: set[int] = set()
        budget = Budget(self.size)
        waiting = [(root, np.eye(4)) for root in reversed(roots)]
        while waiting:
            index, outer = waiting.pop()
            node = self._item("nodes", index)
            if index in seen:
                raise ValueError(f"node {index} stands in its scene twice")
            seen.add(index)
            if len(seen) > MOST_PIECES:
                raise GrainError(f"its scene has more than {MOST_PIECES} nodes; join them")
            if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
                raise GrainError(f"node {index} uses EXT_mesh_gpu_instancing, which is not read; {WAY_OUT}")
            matrix = outer @ _transform(node)
            waiting += [(child, matrix) for child in reversed(node.get("children", []))]
            if "mesh" not in node:
                continue
            if "skin" in node or any(node.get("weights", self._item("meshes", node["mesh"]).get("weights", ()))):
                raise GrainError(f"node {index} is posed by a skin or morph targets; apply them and export again")
            for part in self._mesh(node["mesh"]):
                placed = part._replace(points=part.points @ matrix[:3, :3].T + matrix[:3, 3])
                mirrored = np.linalg.det(matrix[:3, :3]) < 0
                found.append(budget.spend(turned_over(placed) if mirrored else placed))
        return found, self.size

    def _mesh(self, index: int) -> list[Part]:
        """Return the primitives of a mesh that have faces."""
        if index not in self._meshes:
            budget = self._budget = self._budget or Budget(self.size)
            primitives = [p for p in self._item("meshes", index)["primitives"] if p.get("mode", 4) in (4, 5, 6)]
            self._meshes[index] = [part for p in primitives if len((part := budget.spend(self._primitive(p))).sizes)]
        return self._meshes[index]

    def _primitive(self, primitive: dict) -> Part:
        """Return the triangles of a primitive and the points that they use."""
        position, indices = primitive["attributes"]["POSITION"], primitive.get("indices")
        draco = primitive.get("extensions", {}).get(DRACO)
        stored = [a for a in (position, indices) if a is not None and "bufferView" in self._item("accessors", a)]
        if draco is not None and (DRACO in self._required or len(stored) < 1 + (indices is not None)):
            points, corners = self._draco(draco)
        else:
            points = self._accessor(position, "VEC3")
            corners = np.arange(len(points)) if indices is None else self._accessor(indices, "SCALAR").reshape(-1)
        if corners.dtype.kind == "f" or (len(corners) and not 0 <= corners.min() <= corners.max() < len(points)):
            raise ValueError(f"indices beyond {len(points)} points")
        used, corners = np.unique(corners, return_inverse=True)
        points = points[used].astype(np.float64)
        accessor = self._item("accessors", position)
        if accessor.get("normalized"):  # integers are fractions of the largest (section 3.11)
            points = np.maximum(points / np.iinfo(COMPONENTS[accessor["componentType"]]).max, -1.0)
        mode = primitive.get("mode", 4)
        if mode == 4:
            if len(corners) % 3:
                raise ValueError(f"{len(corners)} corners are no triangles")
            return triangle_part(points, corners.reshape(-1, 3))
        return triangle_part(points, (strip_triangles if mode == 5 else fan_triangles)(corners))

    def _draco(self, extension: dict) -> tuple[Floats, Ints]:
        """Return points and corners of a primitive that Draco compressed."""
        try:
            import DracoPy
        except ImportError:
            fault = f"a primitive is compressed by {DRACO}, which needs the package DracoPy"
            raise GrainError(f"{fault}; pip install DracoPy, or {WAY_OUT}") from None
        try:
            mesh = DracoPy.decode(self._view(extension["bufferView"]).tobytes())
            points = np.asarray(mesh.points, np.float64).reshape(-1, 3)
            corners = np.asarray(mesh.faces, np.int64).reshape(-1)
        except Exception as error:
            reason = " ".join(str(error).split())[:80] or type(error).__name__
            raise GrainError(f"a primitive compressed by {DRACO} cannot be decoded ({reason}); {WAY_OUT}") from None
        return points, corners

    # --------------------------------------------------------------------------------------------- numbers

    def _accessor(self, index: Any, kind: str) -> NDArray:
        """Return (count, width) the numbers of an accessor as they are stored."""
        accessor = self._item("accessors", index)
        count, width, component = accessor["count"], WIDTHS[kind], COMPONENTS[accessor["componentType"]]
        if accessor["type"] != kind or type(count) is not int or count < 0:
            raise ValueError(f"accessor {index} is {count} of {accessor['type']}, not {kind}")
        sparse, view = accessor.get("sparse"), accessor.get("bufferView")
        if view is not None and sparse is None:
            return self._table(accessor, component, count, width, self._item("bufferViews", view).get("byteStride"))
        if index not in self._made:
            if sum(map(np.size, self._made.values())) + count * width > MOST_MADE:
                raise GrainError(f"its sparse accessors are more than {MOST_MADE} numbers; {WAY_OUT}")
            values = np.zeros((count, width), component)
            if view is not None:
                stride = self._item("bufferViews", view).get("byteStride")
                values[:] = self._table(accessor, component, count, width, stride)
            if sparse is not None:
                changed, places = sparse["count"], sparse["indices"]
                if type(changed) is not int or not 0 < changed <= count:
                    raise ValueError(f"accessor {index} changes {changed} of {count} elements")
                which = self._table(places, COMPONENTS[places["componentType"]], changed, 1, None)[:, 0]
                values[which] = self._table(sparse["values"], component, changed, width, None)
            self._made[index] = values
        return self._made[index]

    def _table(self, place: dict, component: str, count: int, width: int, stride: Any) -> NDArray:
        """Return (count, width) numbers of a buffer view, each element `stride` bytes after the one before."""
        view = self._view(place["bufferView"])
        offset, size = place.get("byteOffset", 0), np.dtype(component).itemsize
        step = width * size if stride is None else stride
        if type(offset) is not int or type(step) is not int or offset < 0 or not width * size <= step <= 252:
            raise ValueError(f"byteOffset {offset}, byteStride {step}")
        if count and offset + step * (count - 1) + width * size > len(view):
            raise ValueError(f"{count} elements are announced and a buffer view of {len(view)} bytes holds fewer")
        return np.ndarray((count, width), component, np.ascontiguousarray(view), offset, (step, size))

    def _view(self, index: Any) -> NDArray[np.uint8]:
        """Return the bytes of a buffer view."""
        view = self._item("bufferViews", index)
        buffer = self._item("buffers", view["buffer"])
        if MESHOPT in view.get("extensions", {}) and MESHOPT in buffer.get("extensions", {}):
            raise GrainError(f"buffer view {index} is compressed by {MESHOPT}, which is not read; {WAY_OUT}")
        whole = self._buffer(view["buffer"], buffer)
        offset, length = view.get("byteOffset", 0), view["byteLength"]
        if type(offset) is not int or type(length) is not int or not 0 <= offset <= offset + length <= len(whole):
            raise ValueError(f"buffer view {index} lies outside its buffer of {len(whole)} bytes")
        return whole[offset : offset + length]

    def _buffer(self, index: int, buffer: dict) -> NDArray[np.uint8]:
        if index not in self._buffers:
            uri, length = buffer.get("uri"), buffer["byteLength"]
            if uri is None:
                whole = np.frombuffer(self._binary, np.uint8)
            elif uri.startswith("data:"):
                whole = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
            else:
                name = unquote(uri)
                parts = Path(name).parts
                if ":" in name or "\\" in name or Path(name).is_absolute() or ".." in parts or not parts:
                    raise GrainError(f"its buffer {uri!r} is not in its own folder; export it as GLB")
                try:
                    regular = stat.S_ISREG((self._folder / name).stat().st_mode)
                except (OSError, ValueError):
                    regular = False
                if not regular:
                    raise GrainError(f"its buffer {uri!r} is not there or no regular file; export it as GLB")
                whole = np.memmap(self._folder / name, np.uint8, "r")
                self.size += len(whole)
            if type(length) is not int or not 0 <= length <= len(whole):
                raise ValueError(f"buffer {index} announces {length} bytes and holds {len(whole)}")
            self._buffers[index] = whole[:length]
        return self._buffers[index]


def _transform(node: dict) -> Floats:
    """Return (4, 4) the matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = (float(q) for q in node.get("rotation", (0, 0, 0, 1)))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
