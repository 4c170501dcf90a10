"""The first grains that a path from the camera meets one by one, then the chain: how one hands over to the other.

A picture shows single grains for the first few that light met before it reached the camera, and only the mean of all
packings behind. So a walker meets `Media.singles` grains of a packing, as at level explicit, and goes on by its level's
own law where it leaves the bounding sphere of the last of them: from where it is, along its direction, and where the
level remembers, with the side and the impact parameter with which it left that sphere. Spheres whose grain is missed do
not count. docs/hybrid.md says what this gets right, and how many grains a picture needs.
"""

from collections.abc import Sequence

from tsdf.compiled import njit
from tsdf.data.table import Table
from tsdf.errors import SceneError
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import Scene, called
from tsdf.vectors import KERNEL, step, triple
from tsdf.walk import memory as M
from tsdf.walk.walker import UNKNOWN

ALL = 2**31 - 1  # grains met one by one: more than a path has
LEAST_LAYER = 4.0  # [R] of centres
LEAST_COSINE = 0.2  # mean cosine of grains below which light often comes back to a grain; of mirrors it is 0


# ------------------------------------------------------------------------------------------- for kernels


@njit(**KERNEL)
def hand_over(world, w):
    """Have a walker that has just left a packed grain's bounding sphere, with centre w.q, go on by a world's law."""
    w.skip, w.tries = 0.0, 0
    if world.media.traits.remembers:
        n = step(triple(w.p), -1.0, triple(w.q))
        size = 1.0 / world.memory.radius[w.medium]
        M.emerge(w, world.memory, (n[0] * size, n[1] * size, n[2] * size))
    else:
        w.free, w.medium = -1.0, UNKNOWN  # grains may stick out of a medium that is filled to the brim


# --------------------------------------------------------------------------------------------- from specs


def singles_of(scene: Scene, level: str) -> int:
    """Return how many grains are met one by one before a level's own law takes over.

    Raises
    ------
    SceneError
        The scene asks for some at a level that no grain can hand light over to.
    """
    grains, traits = scene.render.explicit_grains, LEVELS[level].traits
    if grains and not traits.chains:
        why = "follows all of them" if traits.packed else "has no grains to go on from"
        chains = ", ".join(name for name, other in LEVELS.items() if other.traits.chains)
        raise SceneError(
            f"{scene.name}: explicit_grains = {grains}: level {level} {why}; take {chains}, or 0 explicit grains"
        )
    return ALL if traits.packed else grains


def hybrid_notes(scene: Scene, tables: Sequence[Table], layers: Sequence[float]) -> list[str]:
    """Return what is to be said of media whose first grains hand over to an average.

    Parameters
    ----------
    scene : Scene
    tables : sequence of Table
        Of all components of all media in turn.
    layers : sequence of float
        How thin the layers are in which the centres of each medium's grains lie [R].
    """
    notes, at = [], 0
    for number, (medium, layer) in enumerate(zip(scene.media, layers, strict=True), 1):
        own = tables[at : at + len(medium.grains)]
        at += len(own)
        where = f"{scene.name}: {called('medium', number, medium.name)}"
        g = min(table.mean_cosine() for table in own)
        if g < LEAST_COSINE:
            notes.append(
                f"{where}: grains that send so much light back (mean cosine {g:.2g}) are met again, which no chain "
                "knows; take level explicit"
            )
        if layer <= LEAST_LAYER:
            notes.append(
                f"{where}: a layer of {max(layer, 0.0):.2g} R of centres is nothing but single grains; take level "
                "explicit, which is as fast there"
            )
    return notes
