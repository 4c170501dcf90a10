"""Footprints: what each pixel covers of the grains that it sees, and how many of them it is to meet one by one.

A pixel that covers w of grains of radius R misses, without single grains, a texture of about `texture(w / R)` of its
brightness, and k single grains first bring that down by e to the k/4 (docs/hybrid.md). So a picture in which K are
enough where grains look largest is as good everywhere with K - 4 ln(texture there / texture here).
"""

import math

import numpy as np

from tsdf.grain.grains import first_hit
from tsdf.scene.scene import Scene
from tsdf.walk.geometry import MESH, Place, exact_hit
from tsdf.walk.transport import CameraArrays

LOOKS = 192  # places along each side that are looked at
TEXTURE = 0.55  # [1] of a ray, on 10 R of spheres of eta 1.33 at f = 0.6
HALF = 0.5  # [R] footprint at which it is half of that
PER_E = 4.0  # explicit grains that bring it down by e


def texture(footprint: np.ndarray | float) -> np.ndarray:
    """Return what a pixel misses without single grains, where it covers so much of 10 R of them [R], over its mean [1].

    It fits the table of docs/hybrid.md within a fifth: .55 of a ray, .26 at R/2, .125 at 2 R.
    """
    return TEXTURE / (1.0 + np.asarray(footprint, np.float64) / HALF)


def footprints(scene: Scene, place: Place, camera: CameraArrays) -> np.ndarray:
    """Return what pixels cover of the first medium that they look at, over its grains' radius [R].

    Parameters
    ----------
    scene : Scene
    place : Place
    camera : CameraArrays
        Of the scene.

    Returns
    -------
    (h, w) float64
        For places spread over the picture, at most `LOOKS` along each side; infinite where there is no medium. Surfaces
        before it are not looked at, for grains are seen by their light as well.
    """
    width, height = scene.camera.width, scene.camera.height
    x, y = ((np.arange(min(n, LOOKS)) + 0.5) * n / min(n, LOOKS) for n in (width, height))
    ways = np.array(camera.corner) + x[None, :, None] * camera.right + y[:, None, None] * camera.down
    shape, length = ways.shape[:2], np.linalg.norm(ways, axis=2).ravel()
    ways = ways.reshape(-1, 3) / length[:, None]
    starts = np.broadcast_to(camera.origin, ways.shape)
    g, pixel = place.arrays, math.hypot(*camera.right)
    least = np.full(len(ways), math.inf)
    for m, medium in enumerate(scene.media):
        far = np.full(len(ways), math.inf)
        if g.kind[m] == MESH:
            row = int(g.engine[m])
            facet = first_hit(place.engines[row], starts, ways)
            there = np.flatnonzero(facet >= 0)
            plane = g.grid.facets[place.first_facet[row] + facet[there]]
            slope = np.einsum("ij,ij->i", plane[:, :3], ways[there])
            gap = plane[:, 3] - plane[:, :3] @ np.array(camera.origin)
            far[there] = np.where(slope > 0.0, 0.0, gap / np.where(slope == 0.0, -1.0, slope))  # 0 from within
        else:
            for i, d in enumerate(ways.tolist()):
                t, inside, _ = exact_hit(g.kind[m], g.shape[m], camera.origin, tuple(d))
                far[i] = 0.0 if inside else t
        least = np.minimum(least, np.maximum(far, 0.0) / length * pixel / medium.radius)
    return least.reshape(shape)


def met_by_pixel(scene: Scene, place: Place, camera: CameraArrays, grains: int) -> np.ndarray:
    """Return how many of `grains` explicit ones each pixel counts as met before it begins, (h * w,) int64.

    None where a pixel covers least of the grains, all where it sees none; in between as many as leave the same error.
    """
    seen = footprints(scene, place, camera)
    rows, columns = np.pad(seen, 1, constant_values=math.inf), seen.shape
    near = np.min(
        [rows[i : i + columns[0], j : j + columns[1]] for i in range(3) for j in range(3)], axis=0
    )  # an outline's pixels may see grains where their middle does not
    if not np.isfinite(near).any():
        return np.zeros(scene.camera.width * scene.camera.height, np.int64)
    with np.errstate(divide="ignore"):
        fewer = PER_E * np.log(texture(near.min()) / texture(near))
    met = np.floor(np.clip(fewer, 0.0, grains)).astype(np.int64)
    y, x = ((np.arange(n) * m // n) for n, m in ((scene.camera.height, columns[0]), (scene.camera.width, columns[1])))
    return np.ascontiguousarray(met[y][:, x].ravel())
