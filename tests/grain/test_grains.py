"""Grains: what is accepted, what is changed and said, what is refused; whether the exemplars are true."""

import itertools
import subprocess
import sys
import time

import numpy as np
import pytest

from tsdf.errors import GrainError, UsageError
from tsdf.grain import exemplars, surface
from tsdf.grain.grains import (
    BUILT_INS,
    bounding_sphere,
    check_crossings,
    embree_scene,
    first_hit,
    grain_from_mesh,
    load_grain,
)
from tsdf.grain.surface import ODDLY, _winding_numbers


def mesh(name="cube", **given):
    exemplar = exemplars.EXEMPLARS[name]
    return exemplar.build(**exemplar.resolve(given))


def joined(*parts):
    """Concatenate meshes into one."""
    starts = np.cumsum([0] + [len(v) for v, _ in parts[:-1]])
    return np.vstack([v for v, _ in parts]), np.vstack([f + s for (_, f), s in zip(parts, starts, strict=True)])


def moved(part, scale=1.0, shift=(0, 0, 0)):
    return part[0] * scale + shift, part[1]


def flipped(part):
    return part[0], part[1][:, ::-1]


def refused(message, *args, **kwargs):
    """Assert one line naming the mesh, with the message."""
    with pytest.raises(GrainError, match=message) as error:
        grain_from_mesh(*args, name="stone.obj", **kwargs)
    assert "\n" not in str(error.value) and str(error.value).startswith("stone.obj: ")
    return str(error.value)


# ---------------------------------------------------------------------------------------- exemplars


@pytest.mark.parametrize(
    ("name", "given", "hit_probability"),
    [
        ("cube", {}, 0.636620),
        ("octahedron", {}, 0.551329),
        ("tetrahedron", {}, 0.367553),
        ("hexprism", {}, 0.684213),
        ("hexprism", {"aspect": 0.2}, 0.581233),
        ("hexprism", {"aspect": 3}, 0.327829),
    ],
)
def test_cauchy(name, given, hit_probability):
    """Convex grains: beta = S / (4 pi R²), values of the closed forms."""
    grain = load_grain(name, **given)
    assert grain.area / (4 * np.pi) == pytest.approx(hit_probability, abs=6e-7)
    assert grain.convex and grain.bodies == 1 and grain.notes == ()
    scene = embree_scene(grain)
    rng = np.random.default_rng(1)
    d = rng.normal(size=(100_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    side = np.cross(d, rng.normal(size=d.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    hits = (first_hit(scene, side * np.sqrt(rng.random((len(d), 1))) - 3 * d, d) >= 0).mean()
    assert abs(hits - hit_probability) < 4 * np.sqrt(hit_probability * (1 - hit_probability) / len(d))


CONCAVE = {
    "bullet_rosette", "column_aggregate", "faceted", "fresh", "hollow_column", "koch_snowflake", "rounded", "sand",
    "snow",
}  # fmt: skip


FINE = ("snow", "sand", "fresh", "faceted", "rounded")  # of 10,000 facets and more


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in FINE else name for name in exemplars.EXEMPLARS]
)
def test_exemplars_are_clean(name):
    """Every exemplar passes without a note, is normalised, and comes out the same twice."""
    grain, again = load_grain(name), load_grain(name)
    parted = name == "column_aggregate"  # of eight columns, which touch and share nothing
    assert grain.notes == (("8 disjoint bodies",) if parted else ()) and grain.bodies == (8 if parted else 1)
    assert grain.name == name and grain.kind == "mesh"
    assert grain.parameters == {k: p.default for k, p in exemplars.EXEMPLARS[name].parameters.items()}
    assert abs(np.linalg.norm(grain.vertices, axis=1).max() - 1) < 1e-12
    assert grain.mesh_hash == again.mesh_hash and len(grain.mesh_hash) == 64
    assert grain.convex == (name not in CONCAVE)
    assert not grain.vertices.flags.writeable and grain.faces.dtype == np.int32


def test_bevelled_cube():
    """Six squares, twelve bevels, eight corners; volume from the pieces cut off."""
    grain = load_grain("cube", bevel="0.1")
    volume = 1 - 12 * (0.1**2 / 2) * 0.8 - 8 * (0.1**3 - 0.1**3 / 6)
    assert grain.convex and len(grain.faces) == 44 and grain.parameters == {"bevel": 0.1}
    assert grain.volume * grain.bounding_radius**3 == pytest.approx(volume, rel=1e-12)


@pytest.mark.parametrize("n", range(2, 7))
def test_icosphere_faces(n):
    vertices, faces = exemplars.icosphere(n)
    assert len(faces) == 20 * 4**n and len(vertices) == len(faces) // 2 + 2
    assert np.allclose(np.linalg.norm(vertices, axis=1), 1, atol=1e-15)


def test_ellipsoid_volume():
    grain = load_grain("ellipsoid", a=2, b=1, c=0.5)
    assert grain.volume * grain.bounding_radius**3 == pytest.approx(4 * np.pi / 3, rel=1e-3)


@pytest.mark.slow
def test_sand_statistics():
    """The sand's radii have the relative standard deviation and correlation they claim.

    Set-up: 300 seeds at 642 directions. At one direction the seeds are independent, so a correlation
    coefficient of log radii has standard error (1 − rho²)/sqrt(300) < 0.058; averaging over directions only
    helps. Power: a correlation angle of 30 instead of 40 degrees is further off than the tolerance.
    """
    sigma, gamma = 0.3, 40.0
    u, _ = exemplars.icosphere(3)
    r = np.array([np.linalg.norm(exemplars.sand(sigma, gamma, s, 3)[0], axis=1) for s in range(300)])
    assert r.mean() == pytest.approx(1, abs=4 * sigma / np.sqrt(300))
    assert r.std() / r.mean() == pytest.approx(sigma, rel=4 / np.sqrt(600))
    s = np.log(r) + np.log1p(sigma**2) / 2
    cosine = u @ u.T
    for angle in (20.0, 40.0, 80.0):
        pairs = np.argwhere(np.abs(np.degrees(np.arccos(np.clip(cosine, -1, 1))) - angle) < 0.5)
        measured = (s[:, pairs[:, 0]] * s[:, pairs[:, 1]]).mean() / np.log1p(sigma**2)

        def formula(gamma, angle=angle):
            half = np.sin(np.radians([angle, gamma]) / 2)
            return np.exp(-2 * half[0] ** 2 / (2 * half[1]) ** 2)

        assert abs(measured - formula(gamma)) < 0.06
    assert formula(40.0) - formula(30.0) > 0.06  # the last angle tells them apart


def test_legendre_weights():
    """Weights sum to 1 within the stated rest, and to the correlation function at any angle."""
    for gamma in (10.0, 35.0, 90.0):
        c = exemplars.covariance_weights(gamma)
        assert 0 <= 1 - c.sum() < 1e-6 and (c > 0).all()
        g = np.radians(25.0)
        exact = np.exp(-2 * np.sin(g / 2) ** 2 / (2 * np.sin(np.radians(gamma) / 2)) ** 2)
        assert np.polynomial.legendre.legval(np.cos(g), c) == pytest.approx(exact, abs=2e-6)


@pytest.mark.parametrize("given", [{"lobes": 1, "rounding": 0}, {"lobes": 4, "rounding": 1}, {"seed": 5}])
def test_snow_is_star_shaped_and_partly_flat(given):
    """All facets see the origin; some normals are shared by many faces, others by none."""
    vertices, faces = mesh("snow", **given)
    a, b, c = vertices[faces].swapaxes(0, 1)
    assert (np.einsum("ij,ij->i", a, np.cross(b, c)) > 0).all()
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shared = np.unique(normals.round(6), axis=0, return_counts=True)[1]
    assert shared[shared > 20].sum() > (0.02 if given.get("rounding") == 1 else 0.1) * len(faces)
    assert (shared == 1).sum() > 100


def test_seeds_differ():
    assert not np.allclose(mesh("sand", subdivisions=2, seed=1)[0], mesh("sand", subdivisions=2, seed=2)[0])


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("cube", {"bevel": 0.5}, "bevel=0.5: must be a number from 0 to 0.49"),
        ("cube", {"bevel": "wide"}, "bevel=wide: must be a number"),
        ("cube", {"bevel": float("nan")}, "bevel=nan"),
        ("cube", {"size": 2}, "size: no parameter of this grain; valid names: bevel"),
        ("octahedron", {"size": 2}, "valid names: none"),
        ("icosphere", {"subdivisions": 2.5}, "must be a whole number from 2 to 7"),
        ("sand", {"seed": -1}, "seed=-1"),
        ("sphere", {"radius": 2}, "takes no parameters"),
        ("stone.obj", {"radius": 2}, "takes no parameters"),
    ],
)
def test_bad_parameters(name, given, message):
    with pytest.raises(UsageError, match=message):
        load_grain(name, **given)


def test_exact_sphere():
    grain = load_grain("sphere")
    assert (grain.kind, grain.convex, grain.bodies, grain.bounding_radius) == ("sphere", True, 1, 1.0)
    assert grain.area == 4 * np.pi and grain.volume == 4 * np.pi / 3 and len(grain.faces) == 0
    assert check_crossings(grain).share == 0
    with pytest.raises(GrainError, match="no triangle mesh"):
        embree_scene(grain)


# -------------------------------------------------------------------------------------------- files


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off", "glb"])
def test_formats(kind, tmp_path):
    """The same grain from every format, within the precision of the format."""
    import trimesh

    vertices, faces = mesh("snow", subdivisions=3)
    path = tmp_path / f"grain.{kind}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    grain, expected = load_grain(path), load_grain("snow", subdivisions=3)
    assert grain.name == path.name and grain.parameters == {} and grain.notes == ()
    assert len(grain.vertices) == len(vertices)
    assert (grain.area, grain.volume) == pytest.approx((expected.area, expected.volume), rel=1e-5)
    assert grain.bounding_radius == pytest.approx(expected.bounding_radius, rel=1e-6)


def test_scene_transforms(tmp_path):
    """A scene of two instances is two bodies at their places."""
    import trimesh

    scene = trimesh.Scene()
    cube = trimesh.Trimesh(*mesh(), process=False)
    scene.add_geometry(cube)
    scene.add_geometry(cube, transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.export(tmp_path / "two.glb")
    grain = load_grain(tmp_path / "two.glb")
    assert grain.bodies == 2 and grain.notes == ("2 disjoint bodies",) and not grain.convex
    assert grain.bounding_radius == pytest.approx(np.sqrt(2**2 + 2 * 0.5**2))


def test_split_vertices_are_welded(tmp_path):
    """Texture seams and unshared vertices do not open a mesh; nor does a comment in another encoding."""
    vertices, faces = mesh()
    text = "".join(f"v {x} {y} {z}\nvt {x} {z}\n" for x, y, z in vertices[faces].reshape(-1, 3))
    text += "".join(f"f {i}/{i} {i + 1}/{i + 1} {i + 2}/{i + 2}\n" for i in range(1, 36, 3))
    (tmp_path / "seams.obj").write_bytes(b"# gr\xf6\xdfe\nmtllib none.mtl\n" + text.encode())
    grain = load_grain(tmp_path / "seams.obj")
    assert len(grain.vertices) == 8 and grain.notes == () and grain.mesh_hash == load_grain("cube").mesh_hash


TETRAHEDRON_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
NOISE = np.random.default_rng(0).bytes(2000)
BAD_FILES = {
    "text.obj": b"hello world\n",
    "points.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "range.obj": TETRAHEDRON_OBJ.replace("f 2 3 4", "f 2 3 9").encode(),
    "nan.obj": TETRAHEDRON_OBJ.replace("v 0 1 0", "v 0 nan 0").encode(),
    "inf.obj": TETRAHEDRON_OBJ.replace("v 0 1 0", "v 0 1e999 0").encode(),
    "huge.obj": TETRAHEDRON_OBJ.replace("v 0 1 0", "v 0 1e200 0").encode(),
    "flat.obj": TETRAHEDRON_OBJ.replace("v 0 0 1", "v 1 1 0").encode(),
    "half.obj": TETRAHEDRON_OBJ[:-9].encode(),
    "binary.stl": b"\0" * 80 + (10**9).to_bytes(4, "little") + b"\0" * 50,
    "picture.png": b"\x89PNG\r\n\x1a\n" + NOISE,
    "note.txt": b"a grain\n",
    "grain": NOISE,
    "points.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n0 0 0\n",
    "range.off": b"OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 9\n",
    **{f"noise.{kind}": NOISE for kind in ("obj", "ply", "stl", "off", "glb", "gltf", "3mf", "dae")},
    **{f"empty.{kind}": b"" for kind in ("obj", "ply", "stl", "off", "glb")},
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files(name, tmp_path, capfd):
    """Whatever is in the file: one GrainError of one line that names it, and nothing printed."""
    (tmp_path / name).write_bytes(BAD_FILES[name])
    with pytest.raises(GrainError) as error:
        load_grain(tmp_path / name)
    assert name in str(error.value) and "\n" not in str(error.value) and ";" in str(error.value)
    assert error.value.__cause__ is None
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off", "glb"])
def test_truncated_files(kind, tmp_path):
    import trimesh

    path = tmp_path / f"cut.{kind}"
    trimesh.Trimesh(*mesh("icosphere", subdivisions=2), process=False).export(path)
    data = path.read_bytes()
    for share in (0.02, 0.3, 0.6, 0.95):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(GrainError, match=r"cut\.") as error:
            load_grain(path)
        assert "\n" not in str(error.value)


def test_missing_and_directory(tmp_path):
    with pytest.raises(GrainError, match="neither a file nor a built-in grain") as error:
        load_grain(tmp_path / "cubes")
    assert all(name in str(error.value) for name in BUILT_INS)
    with pytest.raises(GrainError, match=r"grain; did you mean hexprism\? built-in"):
        load_grain("hex_prism")
    (tmp_path / "scene.toml").write_text("[camera]")
    with pytest.raises(GrainError, match="is a scene, which tsdf-render and tsdf-plan take"):
        load_grain(tmp_path / "scene.toml")
    with pytest.raises(GrainError, match="is a directory"):
        load_grain(tmp_path)
    with pytest.raises(GrainError):
        load_grain("a\0b")


def test_import_is_light():
    """trimesh and embreex are imported when a grain is made, not before."""
    code = "import sys, tsdf.grain.grains; print(*[m for m in ('trimesh', 'embreex', 'scipy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


# ------------------------------------------------------------------------------------- normalisation


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_scale_and_place_do_not_matter(scale, shift):
    vertices, faces = mesh("sand", subdivisions=3)
    grain = grain_from_mesh((vertices + np.array([shift, -shift, shift])) * scale, faces)
    expected = grain_from_mesh(vertices, faces)
    assert np.allclose(grain.vertices, expected.vertices, atol=1e-9)
    assert grain.bounding_radius == pytest.approx(scale * expected.bounding_radius, rel=1e-9)
    assert (grain.area, grain.volume) == pytest.approx((expected.area, expected.volume), rel=1e-9)


@pytest.mark.slow
def test_hash_ignores_order():
    vertices, faces = mesh("sand", subdivisions=2)
    rng = np.random.default_rng(3)
    order = rng.permutation(len(vertices))
    shuffled = np.argsort(order)[rng.permutation(np.roll(faces, 1, axis=1))]
    hashes = {grain_from_mesh(v, f).mesh_hash for v, f in ((vertices, faces), (vertices[order], shuffled))}
    assert len(hashes) == 1
    assert grain_from_mesh(vertices * [1, 1, 1.001], faces).mesh_hash not in hashes
    assert grain_from_mesh(*flipped((-vertices, faces))).mesh_hash not in hashes


def brute_sphere(points):
    """Smallest sphere around points by trying every pair, triple and quadruple, with Cramer-like formulas."""
    best = np.inf
    for k in (2, 3, 4):
        for chosen in itertools.combinations(points, k):
            p = np.array(chosen)
            bordered = np.ones((k + 1, k + 1))
            bordered[:k, :k] = 2 * p @ p.T
            bordered[k, k] = 0
            if abs(np.linalg.det(bordered)) < 1e-9:
                continue
            weights = np.linalg.solve(bordered, np.r_[(p**2).sum(axis=1), 1])[:k]
            centre = weights @ p
            radius = np.linalg.norm(p - centre, axis=1).max()
            if np.linalg.norm(points - centre, axis=1).max() <= radius * (1 + 1e-10):
                best = min(best, radius)
    return best


@pytest.mark.slow
def test_bounding_sphere():
    """Against brute force on small random sets, and known radii of degenerate ones."""
    rng = np.random.default_rng(4)
    for stretch in ([1, 1, 1], [1, 0.3, 0.1], [3, 1, 1e-3]):
        for _ in range(5):
            points = rng.normal(size=(12, 3)) * stretch
            centre, radius = bounding_sphere(points)
            assert radius == pytest.approx(brute_sphere(points), rel=1e-10)
            assert np.linalg.norm(points - centre, axis=1).max() <= radius
    plate = np.array(list(itertools.product((0, 1), (0, 1), (0, 1e-4))))
    for points, radius in [
        (mesh()[0], 0.75**0.5),
        (mesh("tetrahedron")[0], 3**0.5),
        (exemplars.icosphere(5)[0], 1.0),
        (plate, (0.5 + 0.25e-8) ** 0.5),
        ([[0, 0, 0], [4, 0, 0], [2, 0.3, 0], [2, 0, 0.1]], 2.0),  # trimesh.nsphere answers 21
        ([[1, 2, 3]], 0.0),
    ]:
        assert bounding_sphere(points)[1] == pytest.approx(radius, rel=1e-12)


# ------------------------------------------------------------------------------- what is put in order


def test_inverted_is_flipped():
    grain = grain_from_mesh(*flipped(mesh()))
    assert grain.volume > 0 and grain.notes == ("winding was inside out: turned over all faces",)
    assert grain.mesh_hash == load_grain("cube").mesh_hash


def test_inconsistent_winding_is_made_consistent():
    vertices, faces = mesh("icosphere", subdivisions=2)
    faces = faces.copy()
    faces[::7] = faces[::7, ::-1]
    grain = grain_from_mesh(vertices, faces)
    assert grain.notes == (f"turned over {len(faces[::7])} inconsistently wound faces",) and grain.convex


def test_duplicates_and_degenerate_faces():
    vertices, faces = mesh()
    extra = np.vstack([faces, faces[3], faces[5, ::-1], [[0, 0, 1]], [[2, 2, 2]]])
    grain = grain_from_mesh(vertices, extra)
    assert grain.notes == ("removed 2 degenerate faces", "removed 2 duplicate faces")
    assert grain.mesh_hash == load_grain("cube").mesh_hash


def test_unused_vertices_do_not_count():
    vertices, faces = mesh()
    grain = grain_from_mesh(np.vstack([vertices, [[50, 0, 0]]]), faces)
    assert grain.bounding_radius == pytest.approx(0.75**0.5) and len(grain.vertices) == 8


def test_face_without_area_in_the_surface():
    """A vertex on an edge, held by a face without area: flipped away, surface and volume unchanged."""
    vertices = np.vstack([mesh("tetrahedron")[0], [[1, 0, 0]]])  # 4 is the middle of edge 0, 1
    faces = [[0, 2, 4], [4, 2, 1], [0, 1, 3], [0, 4, 1], [0, 3, 2], [1, 2, 3]]
    grain = grain_from_mesh(vertices, faces)
    assert "flipped away 1 faces without area" in grain.notes and len(grain.faces) == 6
    assert grain.volume == pytest.approx(load_grain("tetrahedron").volume) and grain.convex


def test_near_vertices_are_welded():
    vertices, faces = mesh("icosphere", subdivisions=2)
    loose = vertices[faces].reshape(-1, 3) * 5
    loose += np.random.default_rng(0).uniform(-1, 1, loose.shape) * 1e-7
    grain = grain_from_mesh(loose, np.arange(len(loose)).reshape(-1, 3))
    assert len(grain.vertices) == len(vertices) and "welded" in grain.notes[0] and len(grain.notes) == 1
    refused("boundary edges", loose * 1 + 1e-4 * np.sin(np.arange(loose.size)).reshape(-1, 3),
            np.arange(len(loose)).reshape(-1, 3))  # fmt: skip


@pytest.mark.slow
def test_bodies_and_cavities():
    """Two balls, one with a cavity that holds a third: three bodies, whichever are turned over."""
    ball = mesh("icosphere", subdivisions=2)
    shell = flipped(moved(ball, 0.8))
    whole = joined(ball, shell, moved(ball, 0.3), moved(ball, 1, (3, 0, 0)))
    grain = grain_from_mesh(*whole)
    assert grain.bodies == 3 and not grain.convex and grain.notes == ("3 disjoint bodies", "1 cavity")
    unit = load_grain("icosphere", subdivisions=2).volume
    assert grain.volume * grain.bounding_radius**3 == pytest.approx(unit * (2 - 0.8**3 + 0.3**3))
    upside = grain_from_mesh(*flipped(whole))
    assert upside.mesh_hash == grain.mesh_hash and "inside out" in upside.notes[0]
    one = joined(*[flipped(p) for p in (ball, shell, moved(ball, 0.3))], moved(ball, 1, (3, 0, 0)))
    partly = grain_from_mesh(*one)
    assert partly.mesh_hash == grain.mesh_hash and "of 3 of 4 shells" in partly.notes[0]


def test_many_bodies_are_fast():
    ball = mesh("octahedron")
    places = itertools.product(range(7), repeat=3)
    begin = time.process_time()
    assert grain_from_mesh(*joined(*[moved(ball, 0.4, p) for p in places])).bodies == 343
    assert time.process_time() - begin < 10


# ------------------------------------------------------------------------------------ what is refused


def test_refused_arrays():
    vertices, faces = mesh()
    refused("no faces", vertices, np.empty((0, 3), int))
    refused("must be", vertices[:, :2], faces)
    refused("integers from 0 to 7", vertices, faces + 1)
    refused("integers from 0 to 7", vertices, faces - 1)
    refused("integers", vertices, faces + 0.5)
    refused("not arrays of numbers", [["a"]], faces)
    for value in (np.nan, np.inf, -np.inf, 1e200):
        broken = vertices.copy()
        broken[5, 1] = value
        refused(r"vertex 5 \(counted from 0\)", broken, faces)
    refused("one place", np.ones((8, 3)), faces)


def test_open_mesh():
    vertices, faces = mesh()
    message = refused("not closed: 3 boundary edges", vertices * 7, faces[1:])
    assert "--repair" in message


def test_non_manifold():
    vertices, faces = mesh()
    wing = [*range(8), 8]
    refused(
        "shared by more than two faces",
        np.vstack([vertices, [[3, 3, 3]]]),
        [*faces, [*faces[0, :2], wing[-1]]],
    )
    refused("shared by more than two faces", *joined(mesh(), moved(mesh(), 1, (1, 0, 0))))


def test_one_sided_surface():
    """A Klein bottle closes but has no inside."""
    n = 12
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")

    def vertex(i, j):
        return (i % n) * n + np.where(i // n == 1, -j, j) % n

    a, b, c, d = (vertex(i + p, j + q).ravel() for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    refused("one side only", np.random.default_rng(0).normal(size=(n * n, 3)), faces)


def box(at=(0, 0, 0), sides=(1, 1, 1)):
    """A box of its own vertices."""
    vertices, faces = mesh()
    return (vertices + 0.5) * sides + at, faces


@pytest.mark.slow
@pytest.mark.parametrize(("at", "radius"), [((1, 1, 1), 3**0.5), ((1, 1, 0), 1.5), ((-1, 0, 1), 1.5)])
def test_bodies_that_touch_in_a_corner_or_along_an_edge(at, radius):
    """Each closed: bodies of their own, with vertices of their own, however their faces are wound."""
    vertices, faces = joined(box(), box(at))
    for turned in (faces, faces[:, ::-1], np.vstack([faces[:12], faces[12:, ::-1]]), flipped((0, faces[::-1]))[1]):
        grain = grain_from_mesh(vertices, turned)
        scale = grain.bounding_radius
        assert (grain.volume * scale**3, grain.area * scale**2) == pytest.approx((2, 12)) and grain.bodies == 2
        assert scale == pytest.approx(radius) and not grain.convex
        edges = np.sort(grain.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


@pytest.mark.slow
@pytest.mark.parametrize("at", [(1, 0, 0), (1, 0.3, 0.2), (0, 1, 0.5), (0.25, 0.25, 1)])
def test_bodies_that_touch_over_a_face(at):
    """Over a whole face, whatever its diagonal, or over part of one: refused, and it says so."""
    sides = (0.5, 0.5, 1) if at[2] == 1 else (1, 1, 1)
    refused("bodies touch over a face", *joined(box(), box(at, sides)))
    vertices, faces = box(at, sides)
    mirrored = vertices * [1, 1, -1] + [0, 0, 2 * at[2] + sides[2]]  # has the other diagonals
    refused("bodies touch over a face", *joined(box(), (mirrored, faces[:, ::-1])))


def voxels(cells):
    """The outer faces of the cells of a volume, two triangles each, with common vertices."""
    inside = np.pad(cells, 1)
    n = np.array(inside.shape) + 1
    found = []
    for axis, side in itertools.product(range(3), (0, 1)):
        at = np.argwhere(inside & ~np.roll(inside, 1 - 2 * side, axis))
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        corner = at + side * np.eye(3, dtype=int)[axis]
        ring = [corner, corner + u, corner + u + v, corner + v][:: 2 * side - 1]
        a, b, c, d = (np.ravel_multi_index(p.T, n) for p in ring)
        found += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    return np.argwhere(np.ones(n, bool)).astype(float), np.vstack(found)


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "share"), [((2, 2, 2), 0.5), ((3, 3, 3), 0.4), ((5, 6, 7), 0.35), ((7, 6, 5), 0.75)])
def test_clusters_of_voxels(shape, share):
    """Random volumes: V and A count cells and faces; bodies are cells joined over faces, found by other means."""
    from scipy.ndimage import label

    rng = np.random.default_rng(6)
    cells = rng.random(shape) < share
    cells[0, 0, 0] = True
    vertices, faces = voxels(cells)
    mixed = np.where(rng.random((len(faces), 1)) < 0.2, faces[:, ::-1], faces)
    for given in (faces, mixed):
        grain = grain_from_mesh(vertices, given)
        scale = grain.bounding_radius
        assert grain.volume * scale**3 == pytest.approx(cells.sum()) and grain.bodies == label(cells)[1]
        assert grain.area * scale**2 == pytest.approx(len(faces) / 2)
        assert not any("grid" in note for note in grain.notes)


def test_no_volume():
    """Two sheets back to back between equal corners, and a flattened cube."""
    refused("no volume", mesh()[0] * [1, 1, 0] + 1e-3 * np.arange(8)[:, None] * [1, 1, 0], mesh()[1])
    vertices, faces = mesh("icosphere", subdivisions=2)
    refused("no volume", vertices * [1, 1, 1e-12], faces)


def test_nested_bodies():
    message = refused("inside another of the same orientation", *joined(mesh(), moved(mesh(), 0.5)))
    assert "cavity" in message
    refused("same orientation", *flipped(joined(mesh("snow", subdivisions=3), moved(mesh(), 0.1))))


def lens(share):
    """Distance of two unit spheres whose overlap is met by about `share` of the rays through both."""
    low, high = 1.0, 2.0
    for _ in range(50):
        d = (low + high) / 2
        cap = 1 - d / 2  # height of each half of the lens; its surface is 2 * 2 pi cap
        low, high = (d, high) if cap / (1 + d / 2) ** 2 > share else (low, d)
    return d


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 1e-2, 1e-3, 2e-4])
def test_overlapping_spheres(share):
    ball = mesh("icosphere", subdivisions=5)
    refused("crosses itself", *joined(ball, moved(ball, 1, (lens(share), 0, 0))))


@pytest.mark.slow
def test_spike_pushed_through():
    """One vertex of a sphere pushed through the opposite wall."""
    vertices, faces = mesh("icosphere", subdivisions=4)
    vertices = vertices.copy()
    vertices[0] *= -1.3
    refused("crosses itself", vertices, faces)
    vertices[0] *= 0.95 / 1.3  # just inside: a deep dent, which is no crossing
    assert not grain_from_mesh(vertices, faces).convex


@pytest.mark.parametrize(("height", "convex"), [(1e-3, True), (1e-9, True), (-1e-9, True), (-1e-5, False)])
def test_convexity(height, convex):
    """An icosphere with one vertex moved out of or into its neighbours' plane, by `height`."""
    vertices, faces = mesh("icosphere", subdivisions=2)
    ring = np.setdiff1d(faces[(faces == 0).any(axis=1)], 0)
    vertices = vertices.copy()
    vertices[0] = vertices[ring].mean(axis=0) + height * vertices[0]
    assert grain_from_mesh(vertices, faces).convex == convex


def sphere_on_a_grid(subdivisions, digits):
    """An icosphere of radius 1 written with so many decimals."""
    vertices, faces = mesh("icosphere", subdivisions=subdivisions)
    return vertices.round(digits), faces


@pytest.mark.slow
@pytest.mark.parametrize("name", list(exemplars.EXEMPLARS))
def test_convex_within_its_digits(name):
    """A convex crystal stays convex in float32, near and far, and in six decimals; a concave one stays concave."""
    coarse = {"subdivisions": 3} if "subdivisions" in exemplars.EXEMPLARS[name].parameters else {}
    grain = load_grain(name, **coarse)
    for given in ((grain.vertices * 1e-4).astype(np.float32), (grain.vertices + 50).astype(np.float32),
                  grain.vertices.round(6)):  # fmt: skip
        again = grain_from_mesh(given, grain.faces)
        assert again.convex == grain.convex and again.notes == grain.notes


@pytest.mark.parametrize("given", [{"aspect": 20}, {"aspect": 0.01}, {"bevel": 0.001}])
def test_slender_crystals_are_convex_within_their_digits(given):
    vertices, faces = mesh("cube" if "bevel" in given else "hexprism", **given)
    spin = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    assert grain_from_mesh((vertices @ spin).astype(np.float32), faces).convex


@pytest.mark.slow
def test_a_dent_is_no_rounding():
    """The same float32 sphere with one vertex a thousandth of R too deep, and the concave prism on a coarse grid."""
    vertices, faces = mesh("icosphere", subdivisions=4)
    assert grain_from_mesh((vertices + 3).astype(np.float32), faces).convex
    vertices = vertices.copy()
    ring = np.setdiff1d(faces[(faces == 0).any(axis=1)], 0)
    vertices[0] = 0.999 * vertices[ring].mean(axis=0)
    assert not grain_from_mesh((vertices + 3).astype(np.float32), faces).convex
    assert not grain_from_mesh(*voxels(np.array([[[1, 1], [1, 0]]], bool))).convex


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 50e-6, 0.37])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_digits_that_ran_out(scale, kind):
    """A sphere of which 2 % of R is the last digit: said, with the share, whatever the unit and the type."""
    vertices, faces = mesh("icosphere", subdivisions=4)
    grain = grain_from_mesh((np.rint(vertices * 50) * (scale / 50)).astype(kind), faces)
    assert len(grain.notes) == 1 and "on a grid of 2 % of R" in grain.notes[0] and "more digits" in grain.notes[0]
    assert grain_from_mesh((np.rint(vertices * 5000) * (scale / 5000)).astype(kind), faces).notes == ()


def test_far_from_the_origin_digits_run_out():
    """Micrometres at a place given in metres, in float32."""
    vertices, faces = mesh("icosphere", subdivisions=4)
    grain = grain_from_mesh((vertices * 1e-4 + 30).astype(np.float32), faces)
    assert "on a grid of 1.9 % of R" in grain.notes[0] and "nearer to the origin" in grain.notes[0]


@pytest.mark.slow
def test_grids_that_are_meant():
    """Whole numbers of a few corners, voxels, marching cubes on binary data (corners in the middle of edges)."""
    for name in ("cube", "octahedron", "tetrahedron"):
        assert grain_from_mesh(np.rint(mesh(name)[0] * 40), mesh(name)[1]).notes == ()
    i = np.arange(16) - 7.5
    ball = (i[:, None, None] ** 2 + i[:, None] ** 2 + i**2) < 45
    vertices, faces = voxels(ball)
    assert grain_from_mesh(vertices, faces).notes == ()
    assert grain_from_mesh((vertices * 0.37 + 2).astype(np.float32), faces).notes == ()
    ball, sides = mesh("icosphere", subdivisions=3)
    rounded = np.rint(ball * 50)
    assert "on a grid of 2 % of R" in grain_from_mesh(rounded, sides).notes[0]
    middles = 2 * np.rint(rounded / 2)  # one odd coordinate each
    middles[np.arange(len(ball)), np.abs(ball).argmax(axis=1)] += 1
    assert grain_from_mesh(middles, sides).notes == ()


def test_wall_too_thin():
    """A plate thinner than the restart offset cannot be traced, convex or not."""
    refused("thinner than", mesh()[0] * [1, 1, 1e-6], mesh()[1])


@pytest.mark.slow
def test_crossing_check_is_fast_and_quiet():
    """Clean grains with sharp edges, necks and cavities: no ray is called a crossing, few are flukes."""
    ball = mesh("icosphere", subdivisions=3)
    cavity = grain_from_mesh(*joined(ball, flipped(moved(ball, 0.9))))
    for grain in (
        cavity,
        load_grain("tetrahedron"),
        load_grain("hexprism", aspect=0.01),
        load_grain("snow", rounding=0),
    ):
        begin = time.process_time()
        crossings = check_crossings(grain, seed=5)
        assert crossings.share == 0 and crossings.leaks < 1e-4
        assert time.process_time() - begin < 5  # 0.4 s on a free machine


def test_rays_are_checked():
    scene = embree_scene(load_grain("cube"))
    ones = np.ones((4, 3))
    for origins, directions in (
        (ones, ones[:3]),
        (ones[:, :2], ones[:, :2]),
        (ones * np.nan, ones),
        (ones[0], ones[0]),
    ):
        with pytest.raises(ValueError):
            first_hit(scene, origins, directions)
    assert first_hit(scene, np.empty((0, 3)), np.empty((0, 3))).shape == (0,)
    assert (first_hit(scene, [[0, 0.1, 0.2], [2, 0, 0]], [[1, 0, 0], [1, 0, 0]]) >= 0).tolist() == [
        True,
        False,
    ]


# --------------------------------------------------------------------------------------------- repair


def test_repair_closes_holes():
    vertices, faces = mesh()
    grain = grain_from_mesh(vertices, faces[1:], repair=True)
    assert grain.convex and grain.notes == ("repair: closed 1 holes of 3 edges with 1 faces, 8.3 % of the area",)
    ball, faces = mesh("icosphere", subdivisions=3)
    keep = ~np.isin(faces, [0, 40]).any(axis=1)
    grain = grain_from_mesh(ball, flipped((0, faces))[1][keep], repair=True)
    assert "closed 2 holes" in grain.notes[0] and "inside out" in grain.notes[1]
    assert grain.volume == pytest.approx(4 * np.pi / 3, rel=0.02)


@pytest.mark.parametrize("kept", [0.5, 0.0, 0.9])
def test_repair_says_what_is_new(kept):
    """A closed half is no repair unless asked for; the area of the flat cap over all area is what it says."""
    ball, faces = mesh("icosphere", subdivisions=4)
    open_ball = faces[ball[faces].mean(axis=1)[:, 2] < kept]
    cap = np.pi * (1 - kept**2)
    expected = 100 * cap / (cap + 2 * np.pi * (1 + kept))
    if expected > 10:
        message = refused("more than a tenth", ball, open_ball, repair=True)
        assert float(message.partition("would make ")[2].split()[0]) == pytest.approx(
            expected, rel=0.25
        )  # the rim is jagged
    grain = grain_from_mesh(ball, open_ball, repair="any")
    said = float(grain.notes[0].rpartition(", ")[2].split()[0])
    assert said == pytest.approx(expected, rel=0.25) and grain.notes[0].endswith("% of the area")


def test_repair_of_holes_that_touch():
    """Two holes with one common vertex are two holes."""
    vertices, faces = mesh("icosphere", subdivisions=2)
    at = np.flatnonzero((faces == 0).any(axis=1))
    apart = next(f for f in at[1:] if len(np.intersect1d(faces[f], faces[at[0]])) == 1)
    grain = grain_from_mesh(vertices, np.delete(faces, [at[0], apart], axis=0), repair=True)
    assert grain.notes == ("repair: closed 2 holes of 6 edges with 2 faces, 0.58 % of the area",)
    assert grain.mesh_hash == load_grain("icosphere", subdivisions=2).mesh_hash


def test_repair_drops_sheets_and_gives_up_on_nonsense():
    sheet = (np.array([[5.0, 0, 0], [6, 0, 0], [5, 1, 0]]), np.array([[0, 1, 2]]))
    refused("boundary edges", *joined(mesh(), sheet))
    grain = grain_from_mesh(*joined(mesh(), sheet), repair=True)
    assert grain.mesh_hash == load_grain("cube").mesh_hash and any("dropped 1 shell" in n for n in grain.notes)
    refused("50 % of the surface, more than a tenth.*--repair-any", *sheet, repair=True)
    refused("no volume", *sheet, repair="any")


def wound(corners, point):
    """How often triangles wind about a point: the signed solid angles over 4 pi (Van Oosterom and Strackee 1983)."""
    a, b, c = (corners - point).swapaxes(0, 1)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    angle = np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), la * lb * lc + ab * lc + bc * la + ca * lb)
    return angle.sum() / (2 * np.pi)


def test_winding_numbers():
    """Crossings of rays wind about points as solid angles do: nested and turned shells, needles, one cell and many."""
    rng = np.random.default_rng(4)
    ball = mesh("icosphere", subdivisions=3)
    needle = (ball[0] * [3.0, 0.01, 0.02], ball[1])
    for parts in ((ball,), (ball, moved(ball, 0.5), flipped(moved(ball, 0.7))), (needle, moved(ball, 0.3)), (mesh(),)):
        points, faces = joined(*parts)
        corners = points[faces] @ ODDLY.T
        probes = rng.uniform(corners.min(axis=(0, 1)) - 0.1, corners.max(axis=(0, 1)) + 0.1, (200, 3))
        found, effort = _winding_numbers(corners, probes, 10**9)
        assert found.tolist() == [round(wound(corners, p)) for p in probes] and len(set(found.tolist())) > 1
        assert _winding_numbers(corners, probes, effort - 1) == (pytest.approx(np.zeros(200)), effort)


def test_many_cavities_take_little():
    """The effort to tell where shells lie grows with the shells and facets, not with their product."""
    points, faces = mesh("icosphere", subdivisions=5)
    probes = np.random.default_rng(3).uniform(-0.5, 0.5, (10_000, 3))
    found, effort = _winding_numbers(points[faces] @ ODDLY.T, probes, 10**9)
    assert (found == 1).all() and effort < 100 * len(probes)  # of 20,480 facets


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["MOST_NESTED", "MOST_PAIRS"])
def test_shells_within_shells_are_bounded(limit, monkeypatch):
    """Forty shells are told apart; of too many in each other's boxes the message says how many."""
    points, faces = mesh()
    nested = joined(*[moved((points, faces if k % 2 else faces[:, ::-1]), 1 + k) for k in range(40)])
    grain = grain_from_mesh(*nested)
    assert grain.bodies == 20 and "20 cavities" in grain.notes
    monkeypatch.setattr(surface, limit, 700)
    refused("40 shells inside the bounding boxes of others", *nested)


# ------------------------------------------------------------------------------------- what is linked


@pytest.mark.parametrize(("count", "links"), [(1, 0), (5, 3), (1000, 400), (1000, 900), (20_000, 15_000)])
def test_connected(count, links):
    """Random links, and those of a path whose numbers are shuffled: each thing knows the first that it hangs on."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rng = np.random.default_rng(count)
    path = rng.permutation(count)
    for one, other in (rng.integers(0, count, (2, links)), (path[:-1], path[1:])):
        graph = coo_array((np.ones(len(one)), (one, other)), (count, count))
        _, label = connected_components(graph, directed=False)
        expected = np.unique(label, return_index=True)[1][label]
        assert (surface.connected(count, one, other) == expected).all()
