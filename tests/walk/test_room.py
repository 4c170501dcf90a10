"""Where grains stand, for boundaries that are meshes; exact shapes and surfaces are judged in `test_levels`."""

from pathlib import Path

import numpy as np
import pytest

from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make import scatterometer
from tsdf.make.scatterometer import Effort
from tsdf.scene.scene import Camera, ConstantLight, GrainSpec, MediumSpec, Mesh, Scene
from tsdf.walk import room
from tsdf.walk.geometry import place
from tsdf.walk.room import parted, stand, triangle_distance


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory):
    """Return the file of a ring, which no convex body is like, and its mesh."""
    import trimesh

    mesh = trimesh.creation.torus(12.0, 5.0, major_sections=24, minor_sections=12)
    path: Path = tmp_path_factory.mktemp("room") / "ring.ply"
    mesh.export(path)
    return path, mesh


def scene_of(path: Path, inside: str, radius: float = 1.0) -> Scene:
    table = scatterometer.exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=8))
    medium = MediumSpec(Mesh(path), 0.5, radius, (GrainSpec(table),), inside=inside)
    camera = Camera((0.0, -50.0, 10.0), (0.0, 0.0, 0.0), 4, 3)
    return Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,))


@pytest.mark.slow
@pytest.mark.parametrize("cells", [500, 1_000_000])
@pytest.mark.parametrize("inside", ["grains", "centres"])
def test_room_in_a_ring(ring, inside, cells, monkeypatch) -> None:
    """Distances to all facets and the winding of the mesh say the same as lists of facets, however coarse the grid."""
    path, mesh = ring
    monkeypatch.setattr(room, "CELLS", cells)
    made = place(scene_of(path, inside), grains=True)
    points = np.random.default_rng(1).uniform(-18.0, 18.0, (4000, 3)) * (1.0, 1.0, 0.4)
    found = np.zeros(len(points), np.uint8)
    stand(made.room, 0, points, found)
    world = points + made.centre
    corners = np.ascontiguousarray(mesh.triangles)
    away = np.array([min(triangle_distance(t, tuple(p)) for t in corners) for p in world])
    within = solid_angle(corners, world) > 0.5
    right = within & (away >= 1.0) if inside == "grains" else within
    assert np.array_equal(found.astype(bool), right)
    assert 0.05 < right.mean() < 0.6


def solid_angle(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the winding number of a closed mesh about points (van Oosterom & Strackee 1983)."""
    result = np.zeros(len(points))
    for triangle in corners:
        a, b, c = (vertex - points for vertex in triangle)
        x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        top = np.einsum("ij,ij->i", a, np.cross(b, c))
        under = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
        result += np.arctan2(top, under) / (2.0 * np.pi)
    return result


@pytest.mark.slow
def test_media_reach_as_far_as_their_grains(ring) -> None:
    """Where centres are inside, the boundary that light meets holds every point of every grain that may stand there."""
    path, mesh = ring
    for radius in (0.01, 1.0, 4.0):
        made = place(scene_of(path, "centres", radius), grains=True)
        ways = np.random.default_rng(2).normal(size=(500, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        points = mesh.vertices[np.arange(500) % len(mesh.vertices)] - made.centre + 0.999 * radius * ways
        assert made.inside(0, points).all()
        grown = mesh.vertices.max(axis=0) + 1.01 * radius - made.centre
        assert not made.inside(0, grown[None]).any()
        alone = place(scene_of(path, "centres", radius))
        assert not alone.inside(0, np.zeros((1, 3))).any()  # the hole is outside for levels without single grains


def test_every_edge_belongs_to_one_facet() -> None:
    """A segment through a closed mesh crosses it an even number of times, however near to edges and vertices."""
    import trimesh

    corners = np.ascontiguousarray(trimesh.creation.box().triangles)
    rng = np.random.default_rng(3)
    for scale in (0.1, 1e-5, 1e-10):
        aims = rng.choice([-0.5, 0.0, 0.5], (1000, 3)) + scale * rng.normal(size=(1000, 3))
        ways = rng.normal(size=(1000, 3))
        for aim, way in zip(aims, ways / np.linalg.norm(ways, axis=1, keepdims=True), strict=True):
            assert sum(parted(t, tuple(aim - 3.0 * way), tuple(aim + 3.0 * way)) for t in corners) % 2 == 0
    assert sum(parted(t, (0.1, 0.2, 0.3), (3.0, 0.2, 0.3)) for t in corners) == 1
