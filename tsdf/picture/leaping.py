"""Which media of a scene are deep enough to leap in, and the records that they leap by.

Nothing is made for media in which no ball of the least size has room. How a walker leaps is `walk.leaps`, how records
are made and kept `walk.passage`.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from tsdf.data.sampler import Tables
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.scene.medium import Component, free_path
from tsdf.scene.scene import Scene
from tsdf.walk.cells import free_of
from tsdf.walk.geometry import MESH, Place
from tsdf.walk.leaps import Leaps, leaps_of
from tsdf.walk.lights import LUMINANCE, LightArrays
from tsdf.walk.memory import Memory
from tsdf.walk.passage import LEAST_RADIUS, Chain, Passage, kept
from tsdf.walk.room import BALL, SLAB
from tsdf.walk.walker import Media

GAMMA = 2.0  # by default: what it leaves of an error is not seen (docs/leaps.md)
TOUCHED = 2.0  # [R] how far from where it is entered a sphere of level teleport-memory reaches
LOOKED_AT = 4096  # cells of the grid that are asked for whether they are inside a mesh


def checked(gamma: float, name: str = "leap") -> float:
    """Return the smallest radius of leaps in transport mean free paths, 0 for none.

    Raises
    ------
    UsageError
        For a number that is not 0 and not a finite one of at least 1.
    """
    if not (gamma == 0.0 or 1.0 <= gamma < math.inf):
        why = "leaps that short are biased" if 0.0 < gamma < 1.0 else "0 is for no leaps"
        raise UsageError(f"{name} must be 0 or a finite number of at least 1, not {gamma:g}; {why}")
    return gamma


def left_free(lights: LightArrays) -> float:
    """Return how many mean free paths are left free around balls, within which nothing is aimed at lights; 0 where
    nothing is.

    From so deep, e to minus that many of the light of a leap's last grain meets lights by chance. What it finds is so
    many times as bright as a picture as their brightest is to a white wall that faces them; with the logarithm of that,
    chance adds some hundredths to the variance, whatever the size of a sun.
    """
    if not lights.sampled:
        return 0.0
    suns = lights.sun_radiance @ LUMINANCE
    brightest = max(float(suns.max(initial=0.0)), float(lights.environment[..., 3].max(initial=0.0)))
    return max(0.0, math.log(math.pi * brightest / lights.power))


def deepest(place: Place, m: int, least: float = 0.0) -> float:
    """Return about how far the place of a medium that is farthest from its boundary is from it [unit]; surfaces are not
    looked at, and nothing is of meshes in which nothing is as deep as `least`, for which 0 is returned."""
    g = place.arrays
    kind, shape = g.kind[m], g.shape[m]
    if kind == BALL:
        return float(shape[3])
    if kind != MESH:
        size = 0.5 * (shape[3:] - shape[:3])
        return float(size[2] if kind == SLAB else size.min())
    free = free_of(g.grid.far, g.grid.edge)
    cells = np.flatnonzero(free >= least)
    if not len(cells):
        return 0.0
    cells = cells[np.argsort(-free[cells], kind="stable")]
    cells = cells[np.unique(np.linspace(0, len(cells) - 1, LOOKED_AT).astype(np.int64))]
    places = g.grid.low + g.grid.edge * (np.stack(np.unravel_index(cells, g.grid.shape), axis=1) + 0.5)
    inside = place.inside(m, places)
    return float(free[cells[inside]].max()) if inside.any() else 0.0


def leaping(
    scene: Scene, place: Place, media: Media, tables: Tables, memory: Memory, own: Sequence[Table], gamma: float,
    lights: LightArrays, progress: Callable[[float, str], None] | None = None,
) -> tuple[Leaps, list[bool]]:  # fmt: skip
    """Return the leaps of a scene's media, and in which of them there are any.

    Parameters
    ----------
    scene, place, media, tables, memory
        At the level.
    own : sequence of Table
        Of all components of all media.
    gamma : float
        Radius of the smallest leap, in transport mean free paths; 0 for none.
    lights : LightArrays
        Those that are aimed at keep leaps away from the boundary.
    progress : callable, optional
        Called with the share done and a word about it where records must be made.
    """
    traits, count = media.traits, len(scene.media)
    passages: list[Passage | None] = [None] * count
    unit, room, margin = np.ones(count), np.full(count, math.inf), np.zeros(count)
    for m, medium in enumerate(scene.media if gamma else ()):
        first, last = int(media.first[m]), int(media.first[m] + media.kinds[m])
        radius, mean = medium.radius, float(media.free[m])
        if traits.remembers and not place.room.whole[m] and place.arrays.kind[m] == MESH:
            continue  # where its grains stand is not told by how far the boundary is
        grains = [
            Component(table, grain.fraction, radius)
            for table, grain in zip(own[first:last], medium.grains, strict=True)
        ]
        path = free_path(grains, medium.packing_fraction)
        unit[m] = radius if traits.spheres else mean
        touched = TOUCHED * radius if traits.remembers else float(media.reach[m])
        margin[m] = max(touched, left_free(lights) * mean)
        g = 0.0 if traits.similar else float(media.g[first])
        turn = (mean + (path.lambda_s if traits.spheres else 0.0)) / max(1.0 - g, 1e-9)
        smallest = LEAST_RADIUS * radius if traits.spheres else 0.0
        need = gamma * max(turn, smallest) + margin[m]
        if not deepest(place, m, need) >= need:
            continue
        shares = np.diff([0.0, *(memory.choice if traits.remembers else media.choice)[first:last]]).tolist()

        def told(share: float, title: str = medium.name or f"[[medium]] {m + 1}") -> None:
            if progress is not None:
                progress(share, f"records for leaps in {title}")

        found = kept(
            Chain(media, tables, memory), m, list(zip(own[first:last], shares, strict=True)), mean / unit[m],
            radius / unit[m], told,
        )  # fmt: skip
        room[m] = gamma * unit[m] * float(found.radius[0])
        passages[m] = found
    return leaps_of(passages, unit, room, margin), [one is not None for one in passages]
