"""What stands before a facet: the search by groups of vertices finds what looking at each of them finds."""

import time

import numpy as np
import pytest

from tsdf.grain.exemplars import icosphere
from tsdf.grain.grains import load_grain
from tsdf.grain.horizon import horizon_of, stand_before


def planes_of(vertices, faces):
    """Planes (m, 4) and centroids (m, 3) of facets."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.column_stack([normal, np.einsum("ij,ij->i", normal, corners[:, 0])]), corners.mean(axis=1)


@pytest.mark.parametrize("count", [4, 15, 17, 1000])
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_stand_before(count, slope):
    """Random points and planes, most of them near the hull, and normals along the axes and the nodes' diagonals."""
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * [1, 0.5, 2]
    normals = np.vstack([rng.normal(size=(300, 3)), np.eye(3), -np.eye(3), [[1, 1, 0], [1, -1, 2], [-1, -1, -1]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    reach = (normals @ points.T).max(axis=1)
    planes = np.column_stack([normals, reach + 0.1 * rng.normal(size=len(reach)) * (rng.random(len(reach)) < 0.7)])
    centroids = rng.normal(size=(len(planes), 3))
    slopes = slope * rng.random(len(planes))
    distance = np.linalg.norm(points - centroids[:, None], axis=2)
    expected = (normals @ points.T - planes[:, 3:] > 1e-9 + slopes[:, None] * distance).any(axis=1)
    assert (stand_before(points, planes, centroids, slopes, 1e-9) == expected).all()
    assert slope or (expected.any() and not expected.all())


@pytest.mark.parametrize("name", ["sand", "snow", "hexprism", "ellipsoid"])
def test_nothing_before_a_facet(name):
    """The horizon is 0 where all vertices lie behind the facet's plane, and nowhere else."""
    grain = load_grain(name, **({"subdivisions": 3} if name != "hexprism" else {}))
    planes, _ = planes_of(grain.vertices, grain.faces)
    behind = (planes[:, :3] @ grain.vertices.T).max(axis=1) <= planes[:, 3] + 1e-9
    assert ((horizon_of(grain.vertices, grain.faces, planes) == 0) == behind).all() and behind.any()


def test_dense_and_smooth():
    """Four times the facets take about four times the time, not sixteen."""
    took = []
    test_stand_before(4, 0.0)  # compiles
    for subdivisions in (5, 6):
        vertices, faces = icosphere(subdivisions)
        planes, _ = planes_of(vertices, faces)
        begin = time.process_time()
        assert (horizon_of(vertices, faces, planes) == 0).all()
        took.append(time.process_time() - begin)
    assert took[1] < 9 * took[0]
