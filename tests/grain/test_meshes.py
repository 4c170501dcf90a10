"""Mesh files: every kind read right, in whatever form; what cannot be read refused by its name, within bounds."""

import base64
import importlib.util
import io
import json
import os
import random
import re
import struct
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from tsdf.errors import GrainError
from tsdf.grain.grains import embree_scene, first_hit, load_grain
from tsdf.grain.meshes import READERS, _obj_by_lines, _plain_obj, read_mesh
from tsdf.grain.polygons import Part, triangles_of

FUZZ = Path(__file__).parents[2] / "fuzz" / "meshes.py"
spec = importlib.util.spec_from_file_location("fuzz_meshes", FUZZ)
fuzz = sys.modules["fuzz_meshes"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fuzz)
FILES = fuzz.files()

# A prism of height 1 over an L of three unit squares; its caps are single concave polygons
L = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
L_POINTS = [(x, y, z) for z in (0, 1) for x, y in L]
L_FACES = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *[[k, (k + 1) % 6, (k + 1) % 6 + 6, k + 6] for k in range(6)]]


def loaded(folder, name, content):
    """Load a grain from a file made of bytes or text."""
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return load_grain(folder / name)


def size(grain):
    """Volume and area in the file's unit."""
    return grain.volume * grain.bounding_radius**3, grain.area * grain.bounding_radius**2


def refused(message, folder, name, content):
    """Assert one line that names the file, with the message."""
    with pytest.raises(GrainError, match=message) as error:
        loaded(folder, name, content)
    assert "\n" not in str(error.value) and str(error.value).startswith(str(folder / name) + ": ")


def obj(points, faces):
    rows = ["v {} {} {}\n".format(*p) for p in points]
    return "".join(rows + ["f " + " ".join(str(i + 1) for i in f) + "\n" for f in faces])


def off(points, faces):
    rows = ["{} {} {}\n".format(*p) for p in points]
    return f"OFF {len(points)} {len(faces)} 0\n" + "".join(
        rows + [f"{len(f)} " + " ".join(map(str, f)) + "\n" for f in faces]
    )


def ply(points, faces, order=""):
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += f"element face {len(faces)}\nproperty list ushort uint vertex_index\nend_header\n"
    if not order:
        return head + off(points, faces).partition("\n")[2]
    body = b"".join(struct.pack(order + "3f", *p) for p in points)
    return head.encode() + body + b"".join(struct.pack(f"{order}H{len(f)}I", len(f), *f) for f in faces)


# ------------------------------------------------------------------------------------------- every kind


@pytest.mark.parametrize("name", FILES)
def test_every_kind(name, tmp_path):
    """The same box of 2 x 1 x 1 from a file of every kind and form, some of them with what nobody asked for."""
    grain = loaded(tmp_path, name, FILES[name])
    exact = 2e-4 if name == "quantised.glb" else 1e-6  # half is not among the normalised integers
    assert size(grain) == pytest.approx((2, 10), rel=exact) and grain.convex and grain.notes == ()
    places = {"box.3mf": (4.5, 1, 0.5), "box.dae": (2, 0.5, 0.5), "quantised.glb": (1, 2, 3)}
    glb = (2, 2.5, 3.5)  # its node moves it
    expected = places.get(name, glb if name.endswith(("glb", "gltf")) else (1, 0.5, 0.5))
    assert np.allclose(grain.centre, expected, atol=2e-4)


def test_every_kind_is_tried():
    assert {Path(name).suffix for name in FILES} == set(READERS)


CUBE = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
CUBE_FACES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
CUBE_OBJ = obj(CUBE, CUBE_FACES)


@pytest.mark.parametrize(
    "text",
    [
        CUBE_OBJ.replace(" ", "\t"),
        "\ufeff" + CUBE_OBJ,
        CUBE_OBJ.replace("\n", "\r\n"),
        CUBE_OBJ.replace("\nf ", "\nf \\\n").replace("v 1", "v \\\r\n  1"),
        CUBE_OBJ.replace(" 1\nv", " 1 0.5 0.25 0.125\nv"),  # colours
        CUBE_OBJ.replace("\nf 1 ", "\nf 1/1/1 ").replace(" 4 ", " 4//7 ").replace(" 8 ", " 8/2 "),
        CUBE_OBJ.replace("\nf", " # a comment\ns off\ng side\nusemtl white\nf"),
        "# from C:\\grains\\\n" + CUBE_OBJ,
        "mtllib /etc/passwd\n" + CUBE_OBJ + "l 1 2 3\np 4\nvn 0 0 1\nvt 0.5 0.5",
    ],
    ids=["tabs", "bom", "crlf", "continued", "colours", "forms", "comments", "path", "others"],
)
def test_obj_forms(text, tmp_path):
    grain = loaded(tmp_path, "cube.obj", text)
    assert size(grain) == pytest.approx((1, 6)) and grain.bounding_radius == pytest.approx(0.75**0.5)


def test_plain_objs_are_read_as_line_by_line():
    text = "# a box\nmtllib box.mtl\no box\n" + CUBE_OBJ.replace("f 1 ", "f 1/2/3 ") + "vn 0 0 1\ns off\n"
    rng, plain = random.Random(3), 0
    for k in range(1500):
        data = text.replace("\n", rng.choice(("\n", "\r\n", "\r"))).encode()
        data = fuzz.damaged(data, rng) if k else data
        found = _plain_obj(data)
        if found is not None:
            plain += 1
            for one, other in zip(found, _obj_by_lines(data), strict=True):
                np.testing.assert_array_equal(one, other)
    assert 200 < plain < 1200
    for odd in (
        "v 0 0 0 # where\n",
        "v 0 0\n",
        "f 1 2 -1\n",
        "f 1 2 \\\n3\n",
        "surf 0 1\n",
        "v 0 0 nan\n",
        "f 1 2 3e0\n",
    ):
        assert _plain_obj((text + odd).encode()) is None


def test_obj_by_relative_indices(tmp_path):
    """Body by body, each naming its own vertices by how far back they are."""
    text = ""
    for k in range(3):
        text += f"o body{k}\n" + "".join(f"v {x + 3 * k} {y} {z}\n" for x, y, z in CUBE)
        text += "".join("f " + " ".join(str(i - 8) for i in f) + "\n" for f in CUBE_FACES)
    grain = loaded(tmp_path, "bodies.obj", text)
    assert size(grain) == pytest.approx((3, 18)) and grain.bodies == 3 and grain.notes == ("3 disjoint bodies",)
    refused("line 9: there is no vertex -9", tmp_path, "far.obj", CUBE_OBJ.replace("f 1 3", "f -9 3"))
    refused("line 9: there is no vertex 0", tmp_path, "zero.obj", CUBE_OBJ.replace("f 1 3", "f 0 3"))
    refused("line 1: surf", tmp_path, "nurbs.obj", "surf 0 1 0 1 1 2 3 4\n" + CUBE_OBJ)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_ply_of_mixed_polygons(order, tmp_path):
    faces = [*CUBE_FACES[:4], [0, 4, 6], [0, 6, 2], CUBE_FACES[5]]
    assert size(loaded(tmp_path, "mixed.ply", ply(CUBE, faces, order))) == pytest.approx((1, 6))


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize(
    "index", ["uchar int vertex_index", "uint8 uint8 vertex_indices", "ushort double vertex_index"]
)
@pytest.mark.parametrize("mixed", [True, False])
def test_ply_with_further_properties(order, index, mixed, tmp_path):
    """Lists of any type and length in any element, before and after the indices; what they hold is of no matter."""
    codes = {"uchar": "B", "uint8": "B", "ushort": "H", "int": "i", "double": "d", "float": "f"}
    words, rows = [], []

    def row(*fields):
        words.append(" ".join(f"{value:g}" for _, value in fields))
        rows.append(b"".join(struct.pack((order or "<") + code, value) for code, value in fields))

    def several(length, kind, values):
        return (codes[length], len(values)), *((codes[kind], value) for value in values)

    length, kind, _ = index.split()
    faces = [
        *CUBE_FACES[:5],
        *([CUBE_FACES[5][:3], CUBE_FACES[5][2:] + CUBE_FACES[5][:1]] if mixed else CUBE_FACES[5:]),
    ]
    row(("f", 35.5), *several("uchar", "double", [0.25]))
    for k, p in enumerate(CUBE):
        weights = [0.5] * (k % 3 if mixed else 1)
        row(*(("f", x) for x in p), ("B", 200), *several("uchar", "float", weights))
    for k, f in enumerate(faces):
        before, after = ([0.5] * (k % 2), [0.125] * len(f)) if mixed else ([], [0.125])
        row(*several("uchar", "double", before), ("f", 0.5), *several(length, kind, f),
            *several("uchar", "float", after), ("i", -7))  # fmt: skip
    row(("i", 0), ("i", 1), *several("ushort", "float", [0.5, -0.5]))
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"ply\nformat {form} 1.0\ncomment no format ascii 1.0\nelement camera 1\nproperty float f\n"
    head += "property list uchar double range\nelement vertex 8\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty uchar red\nproperty list uchar float weights\n"
    head += f"element face {len(faces)}\nproperty list uchar double before\nproperty float quality\n"
    head += f"property list {index}\nproperty list uchar float texcoord\nproperty int flags\nelement edge 1\n"
    head += "property int vertex1\nproperty int vertex2\nproperty list ushort float vertex_indices\nend_header\n"
    body = b"".join(rows) if order else "\n".join(words).encode()
    assert size(loaded(tmp_path, "extra.ply", head.encode() + body)) == pytest.approx((1, 6))
    if kind == "double":
        wrong = body.replace(*(struct.pack(order + "d", x) if order else f" {x} ".encode() for x in (6, 6.5)), 1)
        refused("no whole number", tmp_path, "half.ply", head.encode() + wrong)


def test_ply_faces_first(tmp_path):
    """Elements in another order, and one of no interest before them."""
    head = "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\nelement face 6\n"
    head += "property list uchar int vertex_indices\nelement vertex 8\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n35\n"
    rows = "".join("4 {} {} {} {}\n".format(*f) for f in CUBE_FACES) + "".join("{} {} {}\n".format(*p) for p in CUBE)
    assert size(loaded(tmp_path, "first.ply", head + rows)) == pytest.approx((1, 6))


def test_stl_forms(tmp_path):
    """A binary file that calls itself solid or goes on, texts whose names hold words of the format, many solids."""
    binary, text = FILES["binary.stl"], FILES["text.stl"]
    for data in (
        b"solid" + binary[5:],
        binary + b"\0\0",
        text.replace(b"solid box\n", b"solid a vertex more\n", 1).replace(b"facet", b"FACET"),
        text.replace(b"solid box\n", b"solid the endsolid of \xe9\n", 1),
        text.replace(b"endsolid", b""),
        text.replace(b"\n", b"\r"),
        text.replace(b"facet normal", b"endsolid\nsolid\nfacet normal"),
    ):
        assert size(loaded(tmp_path, "box.stl", data)) == pytest.approx((2, 10))
    two = loaded(tmp_path, "two.stl", text + text.replace(b"vertex ", b"vertex 5"))  # the second moved by 50
    assert size(two) == pytest.approx((4, 20)) and two.bodies == 2


def test_stl_that_is_cut_off(tmp_path):
    """Never a grain of what is left, whether a facet, a solid or a number is missing."""
    text = FILES["text.stl"]
    last = text.rindex(b"vertex")
    refused("ends within a facet", tmp_path, "facet.stl", text + text[:last])
    second = text[: text.rindex(b"facet n")].replace(b"vertex ", b"vertex 5")
    with pytest.raises(GrainError, match="not closed: 3 boundary edges"):
        loaded(tmp_path, "solid.stl", text + second)
    refused("cannot be read", tmp_path, "word.stl", text[:last] + b"vertex 1 x 0\n" + text[last:].partition(b"\n")[2])
    refused("cannot be read", tmp_path, "number.stl", text.replace(b"vertex 2 0 0\n", b"vertex 2 0\n"))
    refused("announces 12 facets and holds 11", tmp_path, "binary.stl", FILES["binary.stl"][:-1])
    lines = b"solid\n" + b"\n" * 5_000_000  # would take days if each were a place to begin
    for name, data in (("empty.stl", b"solid\nendsolid\n"), ("none.stl", bytes(84)), ("lines.stl", lines)):
        refused("holds no mesh", tmp_path, name, data)


def test_ply_strips(tmp_path):
    """Strips of triangles, −1 between them."""
    strips = [-1 if i < 0 else i for f in CUBE_FACES for i in (*[f[k] for k in (0, 1, 3, 2)], -1)]
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    rows = "".join("{} {} {}\n".format(*p) for p in CUBE) + f"{len(strips)} {' '.join(map(str, strips))}\n"
    assert size(loaded(tmp_path, "strips.ply", head + rows)) == pytest.approx((1, 6))


@pytest.mark.parametrize("missing", ["header", "body"])
@pytest.mark.parametrize("order", ["", "<"])
def test_ply_announces_more_than_it_holds(order, missing, tmp_path):
    """Refused before room is made for it."""
    data = ply(CUBE, CUBE_FACES, order)
    data = data.encode() if isinstance(data, str) else data
    if missing == "body":
        broken = data[:-5]
    else:
        broken = data.replace(b"vertex 8", b"vertex 4000000000")
    tracemalloc.start()
    refused("announces|ends within", tmp_path, "lies.ply", broken)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


# -------------------------------------------------------------------------------------------- polygons


@pytest.mark.slow
@pytest.mark.parametrize("name", ["l.obj", "l.off", "text.ply", "little.ply"])
@pytest.mark.parametrize("turn", range(6))
def test_concave_polygons(name, turn, tmp_path):
    """An L-shaped prism: V 3, A 14, whichever corner its caps begin with."""
    faces = [np.roll(f, turn).tolist() for f in L_FACES[:2]] + L_FACES[2:]
    write = {"l.obj": obj, "l.off": off, "text.ply": ply, "little.ply": lambda p, f: ply(p, f, "<")}[name]
    grain = loaded(tmp_path, name, write(L_POINTS, faces))
    assert size(grain) == pytest.approx((3, 14)) and not grain.convex and grain.notes == () and len(grain.faces) == 20


def test_hit_probability_of_the_concave_prism(tmp_path):
    """.481 of isotropic rays through the bounding sphere meet it, as they meet the same body made of triangles.

    The share of n rays has standard error sqrt(beta (1 − beta) / n) < 8e-4.
    """
    grain = loaded(tmp_path, "l.obj", obj(L_POINTS, L_FACES))
    rng, rays = np.random.default_rng(2), 400_000
    d = rng.normal(size=(rays, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    side = np.cross(d, rng.normal(size=d.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    hit = first_hit(embree_scene(grain), side * np.sqrt(rng.random((rays, 1))) - 3 * d, d) >= 0
    assert abs(hit.mean() - 0.481) < 0.003


RING = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 3), (1.5, 3), (0, 3)]  # collinear corners
HOLED = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]  # a hole, by a cut
STAR = [(np.cos(a) * r, np.sin(a) * r) for a, r in zip(np.arange(14) * np.pi / 7, [2, 0.5] * 7, strict=True)]


def prism(outline, bend=0.0):
    """Return the points and faces of a prism of height 1 whose caps are one polygon each, bent out of the plane."""
    n = len(outline)
    points = [(x, y, z + bend * np.sin(5 * x + 3 * y)) for z in (0, 1) for x, y in outline]
    sides = [[k, (k + 1) % n, (k + 1) % n + n, k + n] for k in range(n)]
    return points, [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


def outline_size(outline):
    """Area and circumference of a polygon."""
    p = np.array(outline)
    q = np.roll(p, -1, axis=0)
    return abs((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()) / 2, np.linalg.norm(p - q, axis=1).sum()


@pytest.mark.slow
@pytest.mark.parametrize("bend", [0.0, 1e-3])
@pytest.mark.parametrize("outline", [RING, STAR, L[::-1]], ids=["ring", "star", "l"])
@pytest.mark.parametrize("turn", [0, 1, 3])
def test_prisms_of_any_outline(outline, turn, bend, tmp_path):
    """Collinear corners, points out of the plane, any first corner, any placement in space."""
    points, faces = prism(np.roll(outline, turn, axis=0).tolist(), bend)
    spin = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    grain = loaded(tmp_path, "prism.obj", obj((np.array(points) @ spin * 10 + 7).tolist(), faces))
    area, rim = outline_size(outline)
    assert size(grain) == pytest.approx((1e3 * area, 1e2 * (2 * area + rim)), rel=1e-9 if bend == 0 else 5e-3)


def test_polygon_with_a_hole_and_repeated_points(tmp_path):
    """A frame whose caps go round the hole by a cut, its corners there named twice; and a corner doubled."""
    points, faces = prism(HOLED)
    faces = [f for k, f in enumerate(faces) if k not in (2 + 4, 2 + 9)]  # the cut has no walls
    grain = loaded(tmp_path, "frame.obj", obj(points, faces))
    assert size(grain) == pytest.approx((8, 2 * 8 + 12 + 4))
    doubled = [[0, 0, *CUBE_FACES[0][1:]], *CUBE_FACES[1:]]
    assert size(loaded(tmp_path, "doubled.obj", obj(CUBE, doubled))) == pytest.approx((1, 6))
    points, faces = prism([(0, 0), (1, 0), (1, 0), (1, 1), (0, 1)])
    assert size(loaded(tmp_path, "same.obj", obj(points, faces))) == pytest.approx((1, 6))


def test_triangles_keep_every_side():
    """Random outlines, also ones that cross themselves: the sides that one triangle has alone are the polygon's."""
    rng = np.random.default_rng(5)
    for n in (5, 6, 9, 40):
        for _ in range(20):
            points = np.column_stack([rng.integers(0, 4, (n, 2)) + 1e-7 * rng.normal(size=(n, 2)), np.zeros(n)])
            faces = triangles_of(Part(points, np.arange(n), np.array([n])))
            count = np.zeros((n, n), int)
            np.add.at(count, (faces.ravel(), np.roll(faces, -1, axis=1).ravel()), 1)
            around = np.zeros((n, n), int)
            around[np.arange(n), (np.arange(n) + 1) % n] = 1
            assert (count - count.T == around - around.T).all()


def test_polygons_that_are_refused(tmp_path):
    refused("names vertex 8", tmp_path, "beyond.ply", ply(CUBE, [*CUBE_FACES[:5], [1, 3, 7, 8]]))
    many = obj(np.random.default_rng(0).normal(size=(6000, 3)).round(3).tolist(), [range(6000)])
    refused("face 1 has 6000 corners", tmp_path, "many.obj", many)


# ------------------------------------------------------------------------------------------------ glTF


def document():
    """The JSON of the box and its buffer."""
    made = json.loads(FILES["box.gltf"])
    return made, base64.b64decode(made["buffers"][0].pop("uri").partition(",")[2])


def changed(change):
    """A .glb of the box after a change to its JSON."""
    made, blob = document()
    change(made)
    return fuzz.glb(made, blob)


def test_gltf_scenes(tmp_path):
    """Mirrored nodes, two primitives of one body, instances: what the scene shows, once for each."""
    mirror = changed(lambda d: d["nodes"][0].update(scale=[-1, 1, 1]))
    assert size(loaded(tmp_path, "mirror.glb", mirror)) == pytest.approx((2, 10))

    def halves(d):
        d["accessors"][1].update(count=18)
        d["accessors"].append({**d["accessors"][1], "byteOffset": 36})
        primitive = d["meshes"][0]["primitives"][0]
        d["meshes"][0]["primitives"].append({**primitive, "indices": 2})

    two = loaded(tmp_path, "two.glb", changed(halves))
    assert size(two) == pytest.approx((2, 10)) and two.notes == () and two.bodies == 1

    def instances(d):
        turned = {"mesh": 0, "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "translation": [0, 5, 0]}
        d["nodes"] = [{"children": [1, 2], "scale": [2, 2, 2]}, {"mesh": 0}, turned]

    grain = loaded(tmp_path, "instances.glb", changed(instances))
    assert size(grain) == pytest.approx((2 * 16, 2 * 40)) and grain.bodies == 2
    box = read_mesh(tmp_path / "instances.glb")[0]
    assert box.min(axis=0) == pytest.approx((-2, 0, 0)) and box.max(axis=0) == pytest.approx((4, 14, 2))
    matrix = changed(
        lambda d: d.update(nodes=[{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 9, 8, 7, 1]}])
    )
    assert np.allclose(loaded(tmp_path, "matrix.glb", matrix).centre, (10, 7.5, 7.5))
    twice = changed(lambda d: d.update(nodes=[{"mesh": 0, "children": [0]}]))
    refused("stands in its scene twice", tmp_path, "circle.glb", twice)


@pytest.mark.parametrize("code", [5120, 5121, 5122, 5123])
@pytest.mark.parametrize("normalised", [True, False])
def test_gltf_quantised(code, normalised, tmp_path):
    """A cube from −1 or 0 to the largest integer; normalised integers are fractions of it, to −1 below."""
    kind = np.dtype({5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}[code])
    top, bottom = np.iinfo(kind).max, np.iinfo(kind).min  # −128 counts as −1 as −127 does
    corners = np.zeros((8, 4), kind)
    corners[:, :3] = np.where(np.array(CUBE) == 1, top, bottom)
    made, _ = document()
    faces = np.array(CUBE_FACES, "u1")[:, [0, 1, 2, 0, 2, 3]].tobytes()
    stride = 4 * kind.itemsize
    made["bufferViews"] = [
        {"buffer": 0, "byteLength": 8 * stride, "byteStride": stride},
        {"buffer": 0, "byteOffset": 8 * stride, "byteLength": 36},
    ]
    made["buffers"] = [{"byteLength": 8 * stride + 36}]
    made["accessors"][0].update(componentType=code, normalized=normalised)
    made["accessors"][1].update(componentType=5121)
    made["extensionsRequired"] = ["KHR_mesh_quantization"]
    grain = loaded(tmp_path, "quantised.glb", fuzz.glb(made, corners.tobytes() + faces))
    side = (2 if bottom < 0 else 1) if normalised else int(top) - int(bottom)
    assert grain.bounding_radius == pytest.approx(side * 0.75**0.5, rel=1e-12)


def test_gltf_fans_and_points(tmp_path):
    """A side as a fan; points and lines beside it do not count; without indices corners follow each other."""
    made, blob = document()
    fan = np.array([0, 4, 6, 2], "<u2").tobytes()
    keep = np.delete(fuzz.TRIANGLES, [8, 9], axis=0).astype("<u2").tobytes()
    blob = blob[:96] + keep + fan
    made["buffers"] = [{"byteLength": len(blob)}]
    made["bufferViews"][1]["byteLength"] = len(keep) + len(fan)
    made["accessors"][1]["count"] = 30
    made["accessors"].append({**made["accessors"][1], "byteOffset": 60, "count": 4})
    same = {"attributes": {"POSITION": 0}}
    made["meshes"][0]["primitives"] += [{**same, "indices": 2, "mode": 6}, {**same, "mode": 0}, {**same, "mode": 3}]
    assert size(loaded(tmp_path, "fan.glb", fuzz.glb(made, blob))) == pytest.approx((2, 10))
    soup = fuzz.POINTS[fuzz.TRIANGLES].astype("<f4").tobytes()
    made, _ = document()
    made["buffers"], made["bufferViews"] = [{"byteLength": len(soup)}], [{"buffer": 0, "byteLength": len(soup)}]
    made["accessors"] = [{**made["accessors"][0], "count": 36}]
    made["meshes"] = [{"primitives": [same]}]
    assert size(loaded(tmp_path, "soup.glb", fuzz.glb(made, soup))) == pytest.approx((2, 10))


DRACO = "KHR_draco_mesh_compression"


def draco_file(required, damage=False):
    """A box beside a box that Draco compressed, 5 to the right."""
    import DracoPy

    made, blob = document()
    packed = DracoPy.encode(fuzz.POINTS + np.array([5.0, 0, 0]), fuzz.TRIANGLES, quantization_bits=14)
    packed = packed[:-9] if damage else packed
    made["bufferViews"].append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(packed)})
    blob += packed
    made["buffers"] = [{"byteLength": len(blob)}]
    made["accessors"] += [{k: v for k, v in a.items() if k != "bufferView"} for a in made["accessors"]]
    extension = {DRACO: {"bufferView": 2, "attributes": {"POSITION": 0}}}
    made["meshes"][0]["primitives"].append({"attributes": {"POSITION": 2}, "indices": 3, "extensions": extension})
    made["extensionsUsed"] = [DRACO]
    if required:
        made["extensionsRequired"] = [DRACO]
    return fuzz.glb(made, blob)


@pytest.mark.parametrize("required", [True, False])
def test_draco(required, tmp_path, monkeypatch):
    """Both halves of a file of which one primitive is compressed; without DracoPy, or damaged, refused by name."""
    whole = draco_file(required)
    grain = loaded(tmp_path, "draco.glb", whole)
    assert size(grain) == pytest.approx((4, 20), rel=1e-3) and grain.bodies == 2
    refused(f"compressed by {DRACO} cannot be decoded", tmp_path, "damaged.glb", draco_file(required, damage=True))
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    refused(f"{DRACO}, which needs the package DracoPy; pip", tmp_path, "draco.glb", whole)


def test_gltf_refused_by_name(tmp_path):
    meshopt = "EXT_meshopt_compression"
    for name in (meshopt, "KHR_node_hierarchy"):
        needs = changed(lambda d, name=name: d.update(extensionsRequired=[name]))
        refused(f"needs the extension {name}", tmp_path, "needs.glb", needs)
    fine = changed(lambda d: d.update(extensionsRequired=["KHR_materials_unlit", "KHR_texture_transform"]))
    assert size(loaded(tmp_path, "fine.glb", fine)) == pytest.approx((2, 10))

    def packed(d):  # one view of two is compressed, and nothing stands in its place
        d["buffers"].append({"byteLength": 72, "extensions": {meshopt: {"fallback": True}}})
        d["bufferViews"][1].update(buffer=1, byteOffset=0, extensions={meshopt: {"buffer": 0, "count": 36}})

    refused(f"buffer view 1 is compressed by {meshopt}", tmp_path, "meshopt.glb", changed(packed))
    many = changed(lambda d: d["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {"attributes": {}}}))
    refused("EXT_mesh_gpu_instancing", tmp_path, "many.glb", many)
    refused("skin", tmp_path, "skin.glb", changed(lambda d: d["nodes"][0].update(skin=0)))
    refused("version 1.0", tmp_path, "old.gltf", json.dumps({"asset": {"version": "1.0"}}))


def test_gltf_buffers_of_its_own_folder(tmp_path):
    """A buffer in the folder or below it is read; one that leads out of it, a device or a pipe is not."""
    made, blob = document()
    (tmp_path / "in here").mkdir()
    (tmp_path / "in here" / "box.bin").write_bytes(blob)
    (tmp_path / "box.bin").write_bytes(blob)
    os.mkfifo(tmp_path / "pipe.bin")

    def with_uri(uri):
        return json.dumps({**made, "buffers": [{"byteLength": len(blob), "uri": uri}]})

    for uri in ("box.bin", "in%20here/box.bin", "./box.bin"):
        assert size(loaded(tmp_path, "box.gltf", with_uri(uri))) == pytest.approx((2, 10))
    for uri in ("../box.bin", "in%20here/../../box.bin", "%2e%2e/box.bin", str(tmp_path / "box.bin"), "file:box.bin",
                "http://example.org/box.bin", "a\\box.bin", ""):  # fmt: skip
        refused("not in its own folder|not there", tmp_path, "out.gltf", with_uri(uri))
    for uri in ("pipe.bin", "in here", "none.bin"):
        refused("is not there or no regular file", tmp_path, "out.gltf", with_uri(uri))


# --------------------------------------------------------------------------------------- 3MF, DAE and VTK


def test_3mf_refused_by_name(tmp_path):
    model = fuzz.MODEL
    beams = model.replace("</triangles>", "</triangles><beamlattice/>")
    refused("holds a beamlattice", tmp_path, "beams.3mf", fuzz.packed(beams.encode()))
    needs = model.replace('unit="', 'xmlns:v="http://example.org/volumetric" requiredextensions="v" unit="')
    refused("needs the extension http://example.org/volumetric", tmp_path, "needs.3mf", fuzz.packed(needs.encode()))
    lost = model.replace('component objectid="1"', 'component objectid="7"')
    refused("object 7 is not there", tmp_path, "lost.3mf", fuzz.packed(lost.encode()))


def test_3mf_of_several_models(tmp_path):
    """Objects of a second model, by their numbers, as often as they are named."""
    production = 'xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06" unit="'
    parts = fuzz.MODEL.replace('<object id="2"', '<object id="9">' + fuzz.MODEL.partition('type="model">')[2].partition(
        "<object")[0] + '<object id="2"')  # fmt: skip
    for first, second in ((1, 9), (1, 1)):
        components = "".join(
            f'<component p:path="/3D/Objects/parts.model" objectid="{k}" transform="1 0 0 0 1 0 0 0 1 {x} 0 0"/>'
            for k, x in ((first, 0), (second, 5))
        )
        root = fuzz.MODEL.replace('unit="', production)
        root = re.sub("<component .*?/>", components, re.sub("<mesh>.*?</mesh>", "", root))
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            archive.writestr("3D/3dmodel.model", root)
            archive.writestr("3D/Objects/parts.model", parts)
        grain = loaded(tmp_path, "parts.3mf", out.getvalue())
        assert size(grain) == pytest.approx((4, 20)) and grain.bodies == 2


@pytest.mark.slow
def test_dae_scenes(tmp_path):
    """A node that mirrors, concave polygons, a geometry that is not there."""
    mirror = loaded(tmp_path, "mirror.dae", fuzz.DAE.replace("<translate>1 0 0</translate>", "<scale>-1 1 1</scale>"))
    assert size(mirror) == pytest.approx((2, 10)) and mirror.notes == ()
    for turn in range(6):
        faces = [np.roll(f, turn).tolist() for f in L_FACES[:2]] + L_FACES[2:]
        text = re.sub('count="24">.*?<', f'count="36">{" ".join(str(x) for p in L_POINTS for x in p)}<', fuzz.DAE)
        text = text.replace('count="8" stride', 'count="12" stride').replace(
            '<polylist count="6"', '<polylist count="8"'
        )
        text = text.replace("4 4 4 4 4 4", "6 6 4 4 4 4 4 4")
        text = re.sub("<p>.*?</p>", f"<p>{' '.join(str(i) for f in faces for i in f)}</p>", text)
        assert size(loaded(tmp_path, "l.dae", text)) == pytest.approx((3, 14))
    one = '<instance_geometry url="#g"/>'
    refused("#lost not found", tmp_path, "lost.dae", fuzz.DAE.replace(one, one + one.replace("#g", "#lost")))


def test_dae_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "collada", None)
    refused("needs the package pycollada; pip install pycollada", tmp_path, "box.dae", FILES["box.dae"])


@pytest.mark.parametrize("order", ["Little", "Big"])
@pytest.mark.parametrize("width", [32, 64])
def test_vtk_of_either_byte_order(order, width, tmp_path):
    """Binary arrays of the XML form, with their sizes as UInt32 or UInt64; read the wrong way they are of no size."""
    sign = "<" if order == "Little" else ">"

    def array(name, kind, values, components=1):
        data = np.asarray(values, sign + {"Float32": "f4", "Int32": "i4"}[kind]).tobytes()
        coded = base64.b64encode(np.array(len(data), f"{sign}u{width // 8}").tobytes() + data).decode()
        more = f'NumberOfComponents="{components}" format="binary"'
        return f'<DataArray type="{kind}" Name="{name}" {more}>{coded}</DataArray>'

    ends = np.cumsum([len(face) for face in L_FACES])
    text = f"""<VTKFile type="PolyData" byte_order="{order}Endian" header_type="UInt{width}"><PolyData>
<Piece NumberOfPoints="{len(L_POINTS)}" NumberOfPolys="{len(L_FACES)}">
<Points>{array("Points", "Float32", np.ravel(L_POINTS), 3)}</Points>
<Polys>{array("connectivity", "Int32", np.concatenate(L_FACES))}{array("offsets", "Int32", ends)}</Polys>
</Piece></PolyData></VTKFile>"""
    assert size(loaded(tmp_path, "l.vtp", text)) == pytest.approx((3.0, 14.0))
    other = {"Little": "Big", "Big": "Little"}[order]
    refused("not a|an array of", tmp_path, "other.vtp", text.replace(f"{order}Endian", f"{other}Endian"))


def test_vtk_refused_by_name(tmp_path):
    grid = FILES["grid.vtk"].replace(struct.pack(">6i", *[9] * 6), struct.pack(">6i", *[9] * 5, 10))
    refused("VTK type 10, volumes", tmp_path, "tets.vtk", grid)
    image = FILES["text.vtk"].replace(b"POLYDATA", b"STRUCTURED_POINTS")
    refused("kind STRUCTURED_POINTS has no surface", tmp_path, "image.vtk", image)
    lz4 = FILES["packed.vtp"].replace(b"vtkZLibDataCompressor", b"vtkLZ4DataCompressor")
    refused("compressed by vtkLZ4DataCompressor", tmp_path, "lz4.vtp", lz4)


# ---------------------------------------------------------------------------------------------- bounds


@pytest.mark.parametrize("name", ["box.stl.bz2", "box.obj.gz", "box.zip", "box.tar.gz", "box.dxf", "box.xyz", "box"])
def test_kinds_that_are_not_read(name, tmp_path):
    refused(r"not a kind of mesh file that is read \(.obj, .ply", tmp_path, name, FILES["binary.stl"])


def test_only_regular_files(tmp_path):
    """Links to files count as files; pipes, devices and folders are refused at once."""
    (tmp_path / "box.ply").write_bytes(FILES["little.ply"])
    (tmp_path / "link.ply").symlink_to(tmp_path / "box.ply")
    (tmp_path / "zero.stl").symlink_to("/dev/zero")
    (tmp_path / "folder.obj").mkdir()
    os.mkfifo(tmp_path / "pipe.obj")
    assert size(load_grain(tmp_path / "link.ply")) == pytest.approx((2, 10))
    for name, message in (
        ("zero.stl", "not a regular file"),
        ("pipe.obj", "not a regular file"),
        ("folder.obj", "dir"),
    ):
        with pytest.raises(GrainError, match=message):
            load_grain(tmp_path / name)


def entities():
    levels = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
    return f'<?xml version="1.0"?>\n<!DOCTYPE x [<!ENTITY e0 "0 ">{levels}]>\n'


def bombs():
    """Small files that stand for much: name, content, what they are refused for."""
    yield "vertices.3mf", zipped(b"<model>" + b" " * 300_000_000), "larger than"
    model = fuzz.MODEL.partition("?>\n")[2]
    yield "entities.3mf", fuzz.packed((entities() + model.replace(">2<", ">&e11;<")).encode()), "document type"
    yield "entities.dae", entities() + fuzz.DAE.partition("?>\n")[2].replace("<p>", "<p>&e11;"), "document type"
    yield "entities.vtp", entities() + FILES["text.vtp"].decode().partition("?>\n")[2], "document type"
    nested = "".join(
        f'<object id="{k}"><components>{f"<component objectid={chr(34)}{k - 1}{chr(34)}/>" * 9}</components></object>'
        for k in range(2, 12)
    )
    deep = fuzz.MODEL.replace('<object id="2">', '<object id="old">').replace("</resources>", nested + "</resources>")
    yield "nested.3mf", fuzz.packed(deep.replace('item objectid="2"', 'item objectid="11"').encode()), "more than"
    yield "instances.glb", repeated(nodes=100), "stands for more than 1000000 triangles"
    yield "primitives.glb", repeated(primitives=100), "stands for more than 1000000 triangles"
    yield "nodes.glb", repeated(nodes=100_001, triangles=0), "more than 100000 nodes"
    yield "zeros.glb", changed(lambda d: zeros(d)), "sparse accessors are more than"
    yield "inflated.vtp", inflated(), "announces an array of 510000000 numbers"


def zipped(content):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", content)
    return out.getvalue()


def repeated(nodes=1, primitives=1, triangles=12_000):
    """A .glb of one mesh of many triangles that its primitives and nodes name many times."""
    made, blob = document()
    made["nodes"] = [{"mesh": 0} for _ in range(nodes)]
    made["scenes"] = [{"nodes": list(range(nodes))}]
    made["meshes"][0]["primitives"] *= primitives
    made["accessors"][1]["count"] = 3 * triangles
    blob = blob[:96] + blob[96:] * (triangles // 12)
    made["bufferViews"][1]["byteLength"] = 6 * triangles
    made["buffers"] = [{"byteLength": len(blob)}]
    return fuzz.glb(made, blob)


def zeros(made):
    made["accessors"][0].update(count=4_000_000_000)
    del made["accessors"][0]["bufferView"]


def inflated():
    """A .vtp whose points are 2 GB of zeros, compressed in one block."""
    data = FILES["packed.vtp"].replace(b'NumberOfPoints="8"', b'NumberOfPoints="170000000"')
    return data + zlib.compress(bytes(1000))


@pytest.mark.slow
def test_small_files_that_stand_for_much(tmp_path):
    """Refused for what they are, within the stated memory and time."""
    loader = fuzz.Loader()
    for name, content, message in bombs():
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        assert re.search(message, loader.load(path)), name
    loader.close()


@pytest.mark.slow
def test_damaged_files():
    """A short form of fuzz/meshes.py: grains or errors of ours, and enough of both."""
    ends = fuzz.main(150, seed=1)
    assert set(ends) == {"a grain", "an error of ours"} and sum(ends.values()) == 150
