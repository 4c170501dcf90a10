"""A picture in one call, for those who write Python: what ``tsdf-render`` does, kept in memory."""

import os
import warnings
from collections.abc import Mapping
from typing import Any

from tsdf.picture import render as pictures
from tsdf.picture.render import Picture
from tsdf.picture.world import build
from tsdf.scene.scene import Scene, load, parse, resized


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
        How grains are modelled, one of `tsdf.scene.levels.LEVELS`; the scene's by default.
    spp : int, optional
        Samples per pixel; the scene's by default, unless one of the next two says when to stop.
    seconds : float, optional
        Stop after so long [s]; one sample of each pixel is always taken.
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
    world = build(scene, level or scene.render.level)
    for note in world.notes:
        warnings.warn(note, stacklevel=2)
    if spp is None and seconds is None and target_error is None:
        spp = scene.render.spp
    return pictures.render(world, spp, seconds, target_error, scene.render.seed if seed is None else seed, threads)
