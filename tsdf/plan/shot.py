"""A picture in one call, for those who write Python: what ``tsdf-render`` does, kept in memory.

Level "auto" is a plan: here it becomes a level, explicit grains before it, and when to stop.
"""

import math
import os
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from tsdf.picture import render as pictures
from tsdf.picture.render import Picture
from tsdf.picture.world import World, build
from tsdf.plan import report
from tsdf.plan.planner import TARGET, plan
from tsdf.plan.prediction import Plan
from tsdf.scene.levels import AUTO
from tsdf.scene.scene import Scene, load, parse, resized
from tsdf.scene.specs import SPP

LEAST_LEFT = 0.25  # of the time that is given, for the picture, however long planning took
BOTH = 2.0**0.5  # times the noise that is asked for, that the whole error may be: no more bias and texture than noise


class Choice(NamedTuple):
    """What is rendered, and when it is done: by samples per pixel, seconds, or the noise of pixels."""

    scene: Scene
    spp: int | None
    seconds: float | None
    target_error: float | None
    plan: Plan | None  # where the level was to be chosen
    ends: float | None = None  # [s] on `time.perf_counter`, when the time that is given for all of this is over

    @property
    def left(self) -> float | None:
        """How long the picture may take now [s]: what planning and making it ready have left of the time, where this
        is given for all."""
        if self.ends is None or self.seconds is None:
            return self.seconds
        return max(self.ends - time.perf_counter(), LEAST_LEFT * self.seconds)

    def world(self, leap: float | None = None, progress: Callable[[float, str], None] | None = None) -> World:
        """Return its scene ready to be rendered, of what the plan has made of it as far as that goes."""
        places, packings = (self.plan.places, self.plan.packings) if self.plan else ({}, {})
        return build(
            self.scene, self.scene.render.level, leap=leap, progress=progress, places=places, packings=packings
        )


def chosen(
    scene: Scene, level: str | None = None, spp: int | None = None, seconds: float | None = None,
    target_error: float | None = None, seed: int | None = None, threads: int | None = None,
    told: Callable[[float, str], None] | None = None,
) -> Choice:  # fmt: skip
    """Return a scene at a level, and when its picture is done; planned where the level is "auto".

    A stop that is given is obeyed, and the choice is for it; else the scene's samples per pixel are taken, and where it
    says none, `SPP`, or of a plan, as many as make its error `TARGET`, or where that is out of reach its noise half of
    that, but no more than take `planner.PATIENCE`. Seconds are for planning and picture together; only machine code
    that is made for the first time comes on top.
    """
    began = time.perf_counter()
    level = level or scene.render.level
    if spp is None and seconds is None and target_error is None:
        spp = scene.render.spp or (None if level == AUTO else SPP)
    if level != AUTO:
        return Choice(replace(scene, render=replace(scene.render, level=level)), spp, seconds, target_error, None)
    target = TARGET if target_error is None else BOTH * target_error
    limit, together = math.inf if target_error is not None else seconds, target_error is None and seconds is not None
    made = plan(scene, min(target, 0.99), limit, spp, seed, threads, told, together=together)
    if target_error is not None:
        made = replace(made, why=(report.to_noise(made, target_error), *made.why[1:]))
    if spp is None and seconds is None and target_error is None:
        target_error, seconds = made.noise, made.seconds
        return Choice(made.planned, spp, seconds, target_error, made)
    ends = None if seconds is None else began + made.compiling + seconds
    return Choice(made.planned, spp, seconds, target_error, made, ends)


def render(
    scene: Scene | Mapping[str, Any] | str | os.PathLike[str],
    level: str | None = None,
    *,
    spp: int | None = None,
    seconds: float | None = None,
    target_error: float | None = None,
    width: int | None = None,
    seed: int | None = None,
    threads: int | None = None,
) -> Picture:
    """Return the picture that the camera of a scene takes.

    Parameters
    ----------
    scene : Scene, mapping or path
        A scene, the nested dicts that `tsdf.scene.scene.parse` takes, or a TOML file.
    level : str, optional
        How grains are modelled, one of `tsdf.scene.levels.LEVELS`, or "auto" for the cheapest of them that is good
        enough (`tsdf.plan.planner.plan`); the scene's by default.
    spp : int, optional
        Samples per pixel; the scene's by default, unless one of the next two says when to stop. Where nothing does, 64,
        or with "auto" as many as make bias, missing texture and noise together 2 % of the picture's mean.
    seconds : float, optional
        Stop after so long [s], planning included; one sample of each pixel is always taken.
    target_error : float, optional
        Stop when `Picture.relative_error` is below this.
    width : int, optional
        Width of the picture [pixel], whose shape is kept; the scene's by default.
    seed : int, optional
        Of the random numbers; the scene's by default.
    threads : int, optional
        All processors by default; a picture of so many samples does not depend on it.

    Warns
    -----
    UserWarning
        Of what the user should know about the scene, one line each.

    Raises
    ------
    SceneError, FormatError, UsageError
        In one line, for whatever makes the scene impossible at that level.

    Examples
    --------
    >>> import tsdf
    >>> scene = {
    ...     "camera": {"position": [0, -8, 1], "target": [0, 0, 1], "width": 4, "height": 3},
    ...     "light": [{"type": "constant", "radiance": [1, 1, 1]}],
    ...     "medium": [{
    ...         "shape": {"type": "sphere", "centre": [0, 0, 1], "radius": 1},
    ...         "packing_fraction": 0.5,
    ...         "radius": 0.05,
    ...         "grain": [{"table": "snow.tsdf.exr"}],
    ...     }],
    ... }
    >>> picture = tsdf.render(scene, "teleport", spp=1)
    >>> picture.rgb.shape, bool((abs(picture.rgb - 1) < 1e-9).all())  # no lossless grain shows before a white sky
    ((3, 4, 3), True)
    """
    if isinstance(scene, Mapping):
        scene = parse(scene)
    elif not isinstance(scene, Scene):
        scene = load(scene)
    scene = resized(scene, width)
    seed = scene.render.seed if seed is None else seed
    choice = chosen(scene, level, spp, seconds, target_error, seed, threads)
    world = choice.world()
    for note in (*(choice.plan.notes if choice.plan else ()), *world.notes):
        warnings.warn(note, stacklevel=2)
    return pictures.render(world, choice.spp, choice.left, choice.target_error, seed, threads)
