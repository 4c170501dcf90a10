"""Regions of a picture, by name: where a level may be wrong though the whole is right.

They come from the scene's geometry alone, by one ray through the middle of each pixel: `lit side` and `shadow side` of
the media by the strongest sun, `rim`, their pixels next to their silhouette, and `object`, where an opaque surface is
met before a medium, beside it or within it. Without a sun the lit side is the brighter half of the media in the truth.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.grain.grains import first_hit
from tsdf.picture.world import World, camera_of
from tsdf.scene.scene import SunLight
from tsdf.walk.geometry import MESH, ball_hit, exact_hit

RIM = 0.05  # [of the root of the area of the media] how far from the silhouette the rim reaches, a pixel at least
AHEAD = 1e-7  # [of a way] beyond a boundary that was met, from where the next is looked for
BLUR = 2  # [pixel] about each, over which the truth is averaged before it tells the brighter half


class Seen(NamedTuple):
    """What the ray through the middle of each pixel meets, arrays (h, w).

    near, far: distances to where the first medium is entered and left again, infinite without one; surface: to the
    first opaque surface; normal (h, w, 3): outward, where the medium is entered.
    """

    near: np.ndarray
    far: np.ndarray
    surface: np.ndarray
    normal: np.ndarray


def seen(world: World) -> Seen:
    """Return what the middle of each pixel of the scene's camera sees."""
    camera, size = camera_of(world), (world.scene.camera.height, world.scene.camera.width)
    x, y = np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5
    ways = np.array(camera.corner) + x[:, None] * camera.right + y[:, None, None] * camera.down
    ways = (ways / np.linalg.norm(ways, axis=2, keepdims=True)).reshape(-1, 3)
    starts = np.broadcast_to(np.array(camera.origin), ways.shape)
    g, place = world.place.arrays, world.place
    surface = np.full(len(ways), math.inf)
    if g.solid:
        surface = _to_mesh(world, 0, starts, ways)[0]
    if len(g.balls):
        met = [ball_hit(g.balls, camera.origin, _triple(d))[0] for d in ways]
        surface = np.minimum(surface, met)
    near, far = (np.full(len(ways), math.inf) for _ in range(2))
    normal = np.zeros((len(ways), 3))
    for m in range(len(g.kind)):
        enters, leaves, outward = _through(world, m, starts, ways)
        if place.inside(m, np.array(camera.origin)[None])[0]:
            enters, leaves = np.zeros(len(ways)), enters
        first = enters < near
        near, far = np.where(first, enters, near), np.where(first, leaves, far)
        normal[first] = outward[first]
    return Seen(near.reshape(size), far.reshape(size), surface.reshape(size), normal.reshape(*size, 3))


def _through(world: World, m: int, starts: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where rays meet a medium's boundary first and next, and its outward normal at the first."""
    first, normal = _to_medium(world, m, starts, ways)
    onto = np.where(np.isfinite(first), first * (1.0 + AHEAD) + AHEAD * np.abs(starts).max(axis=1), 0.0)
    there = np.isfinite(first)
    then = np.full(len(first), math.inf)
    then[there] = onto[there] + _to_medium(world, m, (starts + onto[:, None] * ways)[there], ways[there])[0]
    return first, then, normal


def _to_medium(world: World, m: int, starts: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    g = world.place.arrays
    if g.kind[m] == MESH:
        return _to_mesh(world, int(g.engine[m]), starts, ways)
    met = [exact_hit(g.kind[m], g.shape[m], _triple(p), _triple(d)) for p, d in zip(starts, ways, strict=True)]
    return np.array([t for t, _, _ in met]), np.array([n for _, _, n in met]).reshape(-1, 3)


def _to_mesh(world: World, engine: int, starts: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance to a mesh, infinite where it is missed, and the normal of the facet."""
    facet = first_hit(world.place.engines[engine], starts, ways)
    plane = world.place.arrays.grid.facets[np.maximum(facet, 0) + world.place.first_facet[engine]]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (plane[:, 3] - np.einsum("ij,ij->i", plane[:, :3], starts)) / np.einsum("ij,ij->i", plane[:, :3], ways)
    return np.where(facet >= 0, t, math.inf), plane[:, :3]


def regions(world: World, truth: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the regions of a picture that have pixels, (h, w) bool by name, and what is to be said of the others.

    Parameters
    ----------
    world : World
        The scene at any level.
    truth : (h, w, 3) float64
        Its picture, which is asked only where no light is aimed.
    """
    met = seen(world)
    medium = met.near < met.surface
    suns = [light for light in world.scene.lights if isinstance(light, SunLight)]
    notes = []
    if suns:
        sun = max(suns, key=lambda light: max(light.irradiance))
        lit = np.einsum("hwk,k->hw", met.normal, np.array(sun.direction)) > 0.0
    else:
        notes.append("no light is a sun: the lit side is the brighter half of the media in the truth, blurred")
        smooth = _blurred(truth.mean(axis=2))
        lit = smooth > (np.median(smooth[medium]) if medium.any() else 0.0)
    found = {
        "whole": np.ones(medium.shape, bool),
        "lit side": medium & lit,
        "shadow side": medium & ~lit,
        "rim": medium & ~_shrunk(medium, max(1, round(RIM * math.sqrt(medium.sum())))),
        "object": np.isfinite(met.surface) & (met.surface < met.far),
    }
    found["object"] |= np.isfinite(met.surface) & ~np.isfinite(met.near)
    if empty := [name for name, pixels in found.items() if not pixels.any()]:
        notes.append(f"nothing in this picture is {' or '.join(empty)}")
    return {name: pixels for name, pixels in found.items() if pixels.any()}, notes


def _shrunk(pixels: np.ndarray, by: int) -> np.ndarray:
    """Return the pixels that are `by` of them away, along rows, columns and diagonals, from all that are not; the edge
    of the picture is no end."""
    for _ in range(by):
        wide = np.pad(pixels, 1, constant_values=True)
        h, w = pixels.shape
        pixels = np.logical_and.reduce([wide[i : i + h, j : j + w] for i in range(3) for j in range(3)])
    return pixels


def _blurred(grey: np.ndarray) -> np.ndarray:
    """Return means over the squares about each pixel."""
    wide, side = np.pad(grey, BLUR, mode="edge"), 2 * BLUR + 1
    h, w = grey.shape
    return np.asarray(np.mean([wide[i : i + h, j : j + w] for i in range(side) for j in range(side)], axis=0))


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
