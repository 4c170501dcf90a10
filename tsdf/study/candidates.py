"""Candidates: the ways to render one scene, from which a chart or a plan takes.

A candidate is a level, how many explicit grains come before it, and from what radius on it leaps.

The error of a picture, wherever one is charted or predicted, is over the mean radiance of the whole true picture,
background included, and has three parts. Bias: the difference of the means. Texture: root mean square over pixels of
what else the expected picture differs by from the truth of the same packing. Noise: the standard error of pixels, as
`Picture.relative_error`. The whole is the root of the sum of their squares.

A plan is of one picture, so its bias and texture are against the scene's own packing. A chart is of a kind of scene:
its bias is that of the mean over packings, and what the difference to one packing has beside that counts as texture.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import Scene

GRAINS = (0, 3, 8)  # explicit ones before a chain, where nothing else is asked for


class Candidate(NamedTuple):
    """A level of `LEVELS`, the number of explicit grains before it, and the least radius of its leaps.

    The radius is in transport mean free paths, 0 for none, None for what the scene says or else the default.
    """

    level: str
    explicit_grains: int = 0
    leap: float | None = None

    @property
    def single(self) -> bool:
        """Whether it meets single grains, whose light is met by chance."""
        return self.explicit_grains > 0 or LEVELS[self.level].traits.packed

    def __str__(self) -> str:
        after = f" k={self.explicit_grains}" if self.explicit_grains else ""
        leap = "" if self.leap is None else f" leap={self.leap:g}"
        return f"{self.level}{after}{leap}"


def candidates(levels: Sequence[str] = tuple(LEVELS), grains: Sequence[int] = GRAINS) -> tuple[Candidate, ...]:
    """Return the candidates of these levels, best first; only chains of grains have explicit ones before them.

    Examples
    --------
    >>> [str(one) for one in candidates(("explicit", "teleport", "volume"), (0, 5))]
    ['explicit', 'teleport k=5', 'teleport', 'volume']
    """
    return tuple(
        Candidate(level, k)
        for level in LEVELS
        if level in levels
        for k in (sorted(set(grains), reverse=True) if LEVELS[level].traits.chains else (0,))
    )


def taken(scene: Scene, candidate: Candidate) -> Scene:
    """Return a scene that is rendered as a candidate says."""
    leap = scene.render.leap if candidate.leap is None else candidate.leap
    if not LEVELS[candidate.level].traits.leaps:
        leap = None
    own = replace(scene.render, level=candidate.level, explicit_grains=candidate.explicit_grains, leap=leap)
    return replace(scene, render=own)
