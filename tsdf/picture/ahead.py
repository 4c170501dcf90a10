"""Kernels of pictures compiled ahead: by a process of its own, while this one makes ready what is to be rendered.

They take most of a first picture, on one processor, and are the same for all scenes and levels but those of `lanes` and
`bodies`.
"""

import threading

from tsdf.compiled import compile_ahead, end_with_parent
from tsdf.scene.levels import AUTO, LEVELS
from tsdf.scene.specs import Box, Scene, Slab, Sphere
from tsdf.walk import transport


def begin(scene: Scene | None = None, level: str = AUTO) -> None:
    """Have them compiled by another process, if they are not kept yet and `scene`, if it is known, needs them."""
    if scene is None or level == AUTO or not _lone(scene, level):
        compile_ahead(transport.advance, __name__)


def _lone(scene: Scene, level: str) -> bool:
    """Return whether a scene is walked in lanes, see `lanes.suited`; whether a mesh is shows later."""
    alone = len(scene.media) == 1 and isinstance(scene.media[0].shape, Box | Slab | Sphere) and not scene.surfaces
    return alone and not LEVELS[level].traits.placed and not scene.render.explicit_grains


def compile_all() -> None:
    """Follow a sample through a scene with nothing in it."""
    from tsdf.picture import render, world
    from tsdf.scene.scene import Camera, ConstantLight, Scene

    scene = Scene(Camera((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1, 1), (ConstantLight((1.0, 1.0, 1.0)),))
    nothing = world.build(scene, "isotropic")
    job = transport.Job(world.camera_of(nothing), 0, 1, 0, 0)
    render.Walkers(nothing).follow(job, 1, threading.Event())


if __name__ == "__main__":
    end_with_parent()
    compile_all()
