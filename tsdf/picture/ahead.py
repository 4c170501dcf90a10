"""Kernels of pictures compiled ahead: by a process of its own, while this one makes ready what is to be rendered.

They take most of a first picture, on one processor, and are the same for all scenes and levels.
"""

import threading

from tsdf.compiled import compile_ahead, end_with_parent
from tsdf.walk import transport


def begin() -> None:
    """Have them compiled by another process, if they are not kept yet."""
    compile_ahead(transport.advance, __name__)


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
