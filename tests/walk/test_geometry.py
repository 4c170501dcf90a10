"""Where things are: distances against brute force, bounds that are bounds, media that are refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numba import njit

from tsdf.errors import SceneError
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.picture import render, world
from tsdf.scene.scene import (
    Absorption,
    Box,
    Camera,
    ConstantLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Rectangle,
    Scene,
    Slab,
    Sphere,
    SurfaceSpec,
)
from tsdf.walk import bodies, geometry
from tsdf.walk.cells import cells_of, free_of
from tsdf.walk.geometry import clearance, exact_hit, unmet
from tsdf.walk.room import BALL, BOX, SLAB, exact_depth, triangle_distance

SHAPES = ((SLAB, (0.0, 0.0, -1.0, 0.0, 0.0, 2.0)), (BOX, (-1.0, -2.0, -0.5, 1.5, 1.0, 0.7)),
          (BALL, (0.3, -0.2, 0.1, 1.5, 0.0, 0.0)))  # fmt: skip


@pytest.fixture(scope="module")
def table():
    return scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=16))


def placed(table, *shapes, surfaces=()):
    """Return the geometry of media of grains of radius 0.1."""
    media = tuple(MediumSpec(shape, 0.5, 0.1, (GrainSpec(table),), name=f"m{i}") for i, shape in enumerate(shapes))
    camera = Camera((9.0, 0.0, 0.0), (0.0, 0.0, 0.0), 2, 2)
    return geometry.place(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), media, surfaces))


def directions(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "shape"), SHAPES)
def test_exact_hit_is_where_the_depth_changes_sign(kind, shape):
    """Along the ray the depth keeps its sign up to the distance found and has the other beyond: independent of how the
    distance is found. Rays along the axes are among them; where nothing is met, the sign never changes."""
    rng = np.random.default_rng(0)
    s = np.array(shape)
    ways = directions(rng, 400)
    ways[:60] = np.eye(3)[rng.integers(0, 3, 60)] * rng.choice([-1.0, 1.0], (60, 1))
    met = 0
    for p, d in zip(rng.uniform(-3.0, 3.0, (400, 3)), ways, strict=True):
        t, inside, n = exact_hit(kind, s, tuple(p), tuple(d))
        assert inside == (exact_depth(kind, s, tuple(p)) > 0.0)
        far = min(t, 20.0)
        signs = [exact_depth(kind, s, tuple(p + x * d)) > 0.0 for x in np.linspace(0.0, far * (1.0 - 1e-9), 200)]
        assert all(sign == inside for sign in signs)
        if t < math.inf:
            met += 1
            assert abs(exact_depth(kind, s, tuple(p + t * d))) < 1e-9
            assert (exact_depth(kind, s, tuple(p + (t + 1e-7) * d)) > 0.0) != inside or abs(np.dot(n, d)) < 1e-3
            assert (np.dot(n, d) > 0.0) == inside
            assert math.isclose(np.linalg.norm(n), 1.0)
    assert met > 50


@pytest.mark.parametrize(("kind", "shape"), SHAPES)
def test_exact_hit_from_the_boundary_itself(kind, shape):
    """From a point on the boundary a ray inward enters at once and a ray outward never comes back."""
    s = np.array(shape)
    p = (s[0] + s[3], s[1], s[2]) if kind == BALL else (0.5, 0.2, s[5])
    out = (1.0, 0.0, 0.0) if kind == BALL else (0.0, 0.0, 1.0)
    assert exact_hit(kind, s, p, out)[0] in (0.0, math.inf)
    t, inside, _ = exact_hit(kind, s, p, tuple(-x for x in out))
    assert (t == 0.0 and not inside) or inside


def test_rays_along_a_slab_never_leave_it():
    """A flight along a slab has no end, whether it is inside or not."""
    s = np.array(SHAPES[0][1])
    assert exact_hit(SLAB, s, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))[:2] == (math.inf, True)
    assert exact_hit(SLAB, s, (0.0, 0.0, 3.0), (1.0, 0.0, 0.0))[:2] == (math.inf, False)


def brute_distance(corners, p, n=60):
    """Return the distance from p to the nearest of n^2 points of a triangle, and how far those may miss."""
    a, b = np.meshgrid(*(np.linspace(0.0, 1.0, n),) * 2)
    a, b = a[a + b <= 1.0 + 1e-12], b[a + b <= 1.0 + 1e-12]
    points = corners[0] + a[:, None] * (corners[1] - corners[0]) + b[:, None] * (corners[2] - corners[0])
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
    return float(np.linalg.norm(points - p, axis=1).min()), longest / (n - 1)


def test_triangle_distance_against_samples():
    """The distance is never above that to any of the triangle's points, nor below it by more than their spacing."""
    rng = np.random.default_rng(1)
    for corners, p in zip(rng.normal(size=(300, 3, 3)), 2.0 * rng.normal(size=(300, 3)), strict=True):
        found = triangle_distance(corners, tuple(p))
        sampled, spacing = brute_distance(corners, p)
        assert sampled - spacing <= found <= sampled + 1e-12


@pytest.mark.parametrize("width", [1e-4, 1e-7, 1e-9, 1e-12])
def test_triangle_distance_to_needles(width):
    """Of needles, whose two long edges are parallel in float64, the distance is right to within their width."""
    rng = np.random.default_rng(2)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, width, 0.0]])
    for p in [*rng.normal(size=(200, 3)), np.array([0.5, 0.0, 0.3]), np.array([0.5, 0.0, 0.0])]:
        rest = np.array([p[0] - min(max(p[0], 0.0), 1.0), p[1], p[2]])
        assert abs(triangle_distance(corners, tuple(p)) - np.linalg.norm(rest)) <= 2.0 * width + 1e-12


@pytest.fixture(scope="module")
def bumpy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a closed mesh with a dent and facets of many sizes."""
    import trimesh

    mesh = trimesh.creation.icosphere(2, radius=2.0)
    mesh.vertices *= (1.0 - 0.4 * (mesh.vertices[:, :1] > 1.2)) * (1.0 + 0.1 * np.sin(5.0 * mesh.vertices[:, 1:2]))
    path = tmp_path_factory.mktemp("meshes") / "bumpy.ply"
    mesh.export(path)
    return path


@njit
def exact_distances(corners, points, nearest):
    """Lower (n,) `nearest` to the distances of points (n, 3) to any of the triangles (m, 3, 3)."""
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        for t in range(corners.shape[0]):
            nearest[i] = min(nearest[i], triangle_distance(corners[t], p))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["mesh", "slab", "box"])
def test_clearance_is_a_bound(shape, bumpy, table):
    """At 3000 places of each medium nothing is nearer than the clearance, by exact distances to every facet; most
    places have some. Exact distances halved fail, so the test can see a bound that is no bound."""
    thing = Mesh(bumpy, 0.3, (0.3, 0.2, 0.1))
    medium = {"mesh": Mesh(bumpy), "slab": Slab(-2.0, 2.0), "box": Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))}[shape]
    made = placed(table, medium, surfaces=(SurfaceSpec(thing, (0.5,) * 3), SurfaceSpec(Sphere((1.0, 0.0, 0.0), 0.2),
                  (0.5,) * 3)))  # fmt: skip
    rng = np.random.default_rng(3)
    points = rng.uniform(-2.5, 2.5, (9000, 3)) * ((3.0, 3.0, 1.0) if shape == "slab" else (1.0, 1.0, 1.0))
    points = points[made.inside(0, points)][:3000]
    meshes = [m for m in (*made.boundaries, *made.surfaces) if m is not None]
    true = np.full(len(points), math.inf)
    exact_distances(np.concatenate([m.vertices[m.faces] for m in meshes]), points, true)
    centre = made.arrays.balls[0]
    true = np.minimum(true, np.abs(np.linalg.norm(points - centre[:3], axis=1) - centre[3]))
    if shape != "mesh":
        kind, s = made.arrays.kind[0], made.arrays.shape[0]
        true = np.minimum(true, [exact_depth(kind, s, tuple(p)) for p in points])
    bound = np.array([clearance(made.arrays, 0, tuple(p)) for p in points])
    assert (bound <= true * (1.0 + 1e-6)).all()
    assert (bound > 0.5 * true).mean() > 0.5
    assert not (bound <= 0.5 * true).all()


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["mesh", "box"])
def test_ways_that_are_sure_to_meet_nothing(shape, bumpy, table):
    """Of ways from places in a medium those that are sure meet nothing, by the ray engine, the depth at their ends and
    the distance to a ball; nearly all that end well before what is there are sure. Twice as long ways fail."""
    thing = Mesh(bumpy, 0.3, (0.3, 0.2, 0.1))
    medium = {"mesh": Mesh(bumpy), "box": Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))}[shape]
    made = placed(table, medium, surfaces=(SurfaceSpec(thing, (0.5,) * 3), SurfaceSpec(Sphere((1.0, 0.0, 0.0), 0.2),
                  (0.5,) * 3)))  # fmt: skip
    rng = np.random.default_rng(5)
    points = rng.uniform(-2.2, 2.2, (3000, 3))
    points = points[made.inside(0, points)][:800]
    ways, ends = directions(rng, len(points)), rng.exponential(0.4, len(points))
    g = made.arrays
    facets = np.full((g.engines, len(points)), -1, np.int32)
    made.hits(points.astype(np.float32), ways.astype(np.float32), facets)
    met = np.full(len(points), math.inf)
    for row in facets:
        n, height = g.grid.facets[row, :3], g.grid.facets[row, 3]
        t = (height - (n * points).sum(axis=1)) / (n * ways).sum(axis=1)
        met = np.where((row >= 0) & (t < met), t, met)
    scratch = np.zeros(g.engines, np.int32)
    sure, known = np.array([unmet(g, scratch, 0, tuple(p), tuple(d), e)
                            for p, d, e in zip(points, ways, ends, strict=True)]).T  # fmt: skip
    assert known[sure].all()
    along = np.einsum("ij,ij->i", g.balls[0, :3] - points, ways)
    for times, whole in ((1.0, True), (2.0, False)):
        far = times * ends
        inside = made.inside(0, points + far[:, None] * ways)
        nearest = points + np.clip(along, 0.0, far)[:, None] * ways - g.balls[0, :3]
        free = (met > far * (1.0 - 1e-5)) & inside & (np.linalg.norm(nearest, axis=1) > g.balls[0, 3] * (1.0 - 1e-9))
        assert free[sure].all() == whole
        if whole:
            assert sure[free & (met > 1.01 * far)].mean() > 0.95 and 0.3 < sure.mean() < 0.9


@pytest.mark.slow
def test_distances_bound_those_of_each_cell(bumpy, table):
    """No cell's number is above its centre's distance to the nearest facet, nor short by two diagonals of a cell."""
    made = placed(table, Mesh(bumpy))
    corners = made.boundaries[0].vertices[made.boundaries[0].faces]
    for step in (0.05, 0.2):
        counts = np.array([int(5.2 / step)] * 3)
        low = np.full(3, -2.6)
        found = free_of(cells_of(corners, geometry.planes_of(corners), low, step, counts)[0], step).reshape(counts)
        at = np.random.default_rng(4).integers(0, counts, (2000, 3))
        true = np.full(len(at), math.inf)
        exact_distances(corners, low + step * (at + 0.5), true)
        cells = found[tuple(at.T)]
        assert (cells <= true * (1.0 + 1e-6)).all()
        assert (true - cells < 2.0 * math.sqrt(3.0) * step).all()


@pytest.mark.slow
def test_overlap_is_refused_and_touching_is_not(bumpy, table):
    """Media that share room are refused in one line with a place; media that only share a face are not."""
    low, high = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), Box((0.0, 0.0, 1.0), (1.0, 1.0, 2.0))
    placed(table, low, high)
    placed(table, low, Sphere((0.5, 0.5, -1.0), 1.0))
    for other in (Box((0.5, 0.5, 0.5), (2.0, 2.0, 2.0)), Sphere((0.5, 0.5, 0.5), 0.1), Slab(0.2, 0.4), Mesh(bumpy)):
        with pytest.raises(SceneError, match=r"overlap, at \(") as error:
            placed(table, low, other)
        assert "\n" not in str(error.value)


def test_open_boundary_is_refused(tmp_path, bumpy, table):
    """A medium whose boundary has a hole has no inside: one line that names the medium and the file."""
    import trimesh

    mesh = trimesh.load(bumpy)
    trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False).export(tmp_path / "open.ply")
    with pytest.raises(SceneError, match=r"\[\[medium\]\] 1 \(m0\).*open\.ply") as error:
        placed(table, Mesh(tmp_path / "open.ply"))
    assert "\n" not in str(error.value)


def test_which_meshes_are_convex(bumpy):
    """Balls, boxes with facets in one plane, and the same with one corner pushed in, dents, and two pieces of one."""
    grain = load_grain("icosphere", subdivisions=3)
    convex, box = geometry.Triangles(grain.vertices, grain.faces), geometry.box_mesh((-1.0, -2.0, 0.1), (1.0, 3.0, 0.7))
    assert geometry.is_convex(convex) and geometry.is_convex(box)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turned = geometry.Triangles(box.vertices @ (turn * np.sign(np.linalg.det(turn))), box.faces)
    assert geometry.is_convex(turned)  # rounding alone
    dented = convex.vertices.copy()
    dented[7] *= 0.97
    assert not geometry.is_convex(geometry.Triangles(dented, convex.faces))
    two = np.concatenate((convex.vertices, convex.vertices + 5.0))
    assert not geometry.is_convex(geometry.Triangles(two, np.concatenate((convex.faces, convex.faces + 642))))
    assert not geometry.is_convex(geometry.Triangles(convex.vertices, convex.faces[1:]))


@pytest.mark.slow
def test_who_leaves_a_lone_convex_mesh_asks_no_more(tmp_path, table, monkeypatch):
    """One by one, walkers ask the ray engine for what the camera sees and hardly more, the furnace is 1; where there is
    a surface, or a dent, it is asked as it must be."""
    monkeypatch.setattr(bodies, "suited", lambda *_: False)
    convex, dented = load_grain("icosphere", subdivisions=3), load_grain("icosphere", subdivisions=3).vertices.copy()
    dented[0] *= 0.6
    asked = {}
    floor = SurfaceSpec(Box((-9.0, -9.0, -2.0), (9.0, 9.0, -1.5)), (1.0, 1.0, 1.0))
    for name, points, surfaces in (
        ("convex", convex.vertices, ()),
        ("dented", dented, ()),
        ("floor", dented, (floor,)),
    ):
        lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points]
        lines += [f"f {i} {j} {k}" for i, j, k in convex.faces + 1]
        (tmp_path / "body.obj").write_text("\n".join(lines) + "\n")
        medium = MediumSpec(Mesh(tmp_path / "body.obj"), 0.5, 0.1, (GrainSpec(table),), name="m")
        camera = Camera((4.0, 0.0, 1.0), (0.0, 0.0, 0.0), 16, 16, fov_deg=25.0)
        made = world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), surfaces), "teleport")
        picture = render.render(made, spp=4, threads=1)
        assert picture.truncated == 0 and abs(float(picture.rgb.mean()) - 1.0) < 1e-12
        assert made.place.arrays.convex == (name == "convex")
        asked[name] = picture.rays / picture.samples.sum()
    assert asked["convex"] < 1.1 < 1.4 < asked["dented"] < asked["floor"]


class Slips:
    """A ray engine whose rays slip through the first facet that they meet from outside."""

    def __init__(self, engine, corners):
        self.engine, self.planes = engine, geometry.planes_of(corners)

    def run(self, starts, ways):
        found = self.engine.run(starts, ways)
        plane = self.planes[np.maximum(found, 0)]
        cosine = np.einsum("ij,ij->i", plane[:, :3], ways)
        t = (plane[:, 3] - np.einsum("ij,ij->i", plane[:, :3], starts)) / np.where(cosine == 0.0, 1.0, cosine)
        beyond = (starts + (t * 1.0001 + 1e-3)[:, None] * ways).astype(np.float32)
        return np.where((found >= 0) & (cosine < 0.0), self.engine.run(beyond, ways), found)


def test_what_slips_through_a_mesh_is_not_in_it(table, tmp_path, monkeypatch):
    """A camera's ray that the ray engine lets through a ball's front is outside when it meets the back, far from it."""
    monkeypatch.setattr(bodies, "suited", lambda *_: False)
    trimesh.creation.icosphere(3, radius=10.0).export(tmp_path / "ball.ply")
    medium = MediumSpec(Mesh(tmp_path / "ball.ply"), 0.5, 1.0, (GrainSpec(table),), name="ball")
    camera = Camera((0.0, -60.0, 5.0), (0.0, 0.0, 0.0), 16, 16, fov_deg=15.0)
    made = world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), name="slips"), "volume")
    whole = render.render(made, spp=4)
    corners = made.place.boundaries[0].vertices[made.place.boundaries[0].faces]
    place = replace(made.place, engines=[Slips(made.place.engines[0], corners)])
    limited = made.media._replace(limit=1000)  # what is lost never ends
    slipped = render.render(replace(made, place=place, brim=place, media=limited), spp=4)
    assert whole.events > 4000 and (whole.rgb == 1.0).all()
    assert slipped.events == 0 and slipped.truncated == 0 and (slipped.rgb == 1.0).all()


def boxes(tmp_path, *extents):
    """Return meshes of boxes, low and high corners each."""
    paths = []
    for number, (low, high) in enumerate(extents):
        mesh = geometry.box_mesh(low, high)
        paths.append(tmp_path / f"{number}.ply")
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(paths[-1])
    return [Mesh(path) for path in paths]


def test_media_that_touch_keep_to_themselves(table, tmp_path):
    """A dark one beside a lossless one, whose extent is a whole number of the grid's cells, or nearly: facets at one
    place are both met. Half of the light of one was scattered in the other."""
    shapes = boxes(tmp_path, ((-1.0, -1.0, -1.0), (0.0, 1.0, 1.0)), ((0.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    camera = Camera((6.0, 0.1, 0.1), (0.0, 0.0, 0.0), 12, 12, fov_deg=15.0)
    means = []
    for radius in (0.05, 0.0501):
        media = tuple(
            MediumSpec(shape, 0.5, radius, (GrainSpec(table, absorption=Absorption("grey", (dark,))),), name=f"{dark}")
            for shape, dark in zip(shapes, (100.0, 0.0), strict=True)
        )
        made = world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), media, name="two"), "volume", leap=0.0)
        assert made.place.arrays.grid.margin > 0.0
        means.append(float(render.render(made, spp=64).rgb.mean()))
    assert means[0] < 0.95 and abs(means[0] - means[1]) < 0.03  # standard errors of .005; it was .08


@pytest.mark.slow
def test_media_that_overlap_a_little_are_all_there(table, tmp_path):
    """By less than is refused, where the grid has a mark: the second is there beyond it."""
    shapes = boxes(tmp_path, ((-1.0, -0.5, -0.5), (0.0054, 0.5, 0.5)), ((0.0049, -0.5, -0.5), (1.0, 0.5, 0.5)))
    media = tuple(MediumSpec(shape, 0.5, 0.01, (GrainSpec(table),), name=f"{n}") for n, shape in enumerate(shapes))
    surface = SurfaceSpec(Box((0.3, -0.1, -0.1), (0.5, 0.1, 0.1)), (0.5, 0.5, 0.5))
    camera = Camera((0.8, 0.0, 0.0), (0.4, 0.0, 0.0), 4, 4, fov_deg=10.0)
    made = world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), media, (surface,), name="o"), "volume")
    picture = render.render(made, spp=4)
    assert picture.events > 20 * picture.samples.sum()


def test_more_media_than_can_be_told_apart_are_refused(table):
    """In one line, before anything is made: places know media by numbers of 16 bits."""
    with pytest.raises(SceneError, match=r"has 32768 media, of at most 32767") as error:
        placed(table, *[Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))] * 32768)
    assert "\n" not in str(error.value)


def test_a_wide_floor_needs_no_fine_cells(table):
    """Under a thin slab of fine grains it had 3 million, which took 3 s; many facets still have theirs."""
    floor = SurfaceSpec(Rectangle((0.0, 0.0, -0.001), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0)), (0.5, 0.5, 0.5))
    medium = MediumSpec(Slab(0.0, 0.02), 0.5, 0.005, (GrainSpec(table),), name="m")
    camera = Camera((0.0, -5.0, 3.0), (0.0, 0.0, 0.0), 2, 2)
    grid = geometry.place(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), (floor,))).arrays.grid
    assert len(grid.listed) < 1_000_000


@pytest.mark.parametrize("level", ["volume", "teleport"])
def test_ways_end_at_their_own_boundary(table, tmp_path, level):
    """Two meshes that overlap by less than is refused: a way in one that meets the other first, more than a hair before
    its own end, ends there; it went on for ever, in light that never came out, 23 of 2048 times."""
    shapes = boxes(tmp_path, ((-1.0, -0.5, -0.5), (0.0003, 0.5, 0.5)), ((0.0, -0.5, -0.5), (1.0, 0.5, 0.5)))
    media = tuple(MediumSpec(shape, 0.5, 0.1, (GrainSpec(table),), name=f"{n}") for n, shape in enumerate(shapes))
    camera = Camera((4.0, 0.3, 0.2), (0.0, 0.0, 0.0), 16, 16, fov_deg=25.0)
    made = world.build(Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), media, name="o"), level)
    made.media = made.media._replace(limit=1000)
    picture = render.render(made, spp=8, threads=1, seed=1)
    assert picture.truncated == 0 and (picture.rgb == 1.0).all()
