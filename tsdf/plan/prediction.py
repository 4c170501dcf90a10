"""Predictions of candidates, and the plan that takes one of them."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from tsdf.plan.beliefs import Belief
from tsdf.scene.scene import Scene
from tsdf.study.candidates import Candidate, taken
from tsdf.walk.explicit import Packed
from tsdf.walk.geometry import Place

TIE = 1.1  # times as long as the cheapest as it may take, of those the one with the least error is taken
SLACK = 1.2  # times the target, that the error of what is taken may be if bias and texture are as large as may well be
UNFINISHED = 0.5  # [1] noise of pixels over their mean, above which single grains under small suns are but bright dots
BLOCK = 16  # pixels across, of whose means the error is said where that of a pixel says little
HALF = math.log(2.0)  # meetings that are expected, below which it is likelier than not that there is none


class Rare(NamedTuple):
    """Light that only chance finds, of a level that aims at all else: a sun behind parallel facets.

    Until a whole picture is likely to have met it once it is not noise there but missing.
    """

    variance: float = 0.0  # its part of a sample's variance
    meetings: float = 0.0  # with it in a sample of each pixel
    light: float = 0.0  # its share of the picture's mean

    def __bool__(self) -> bool:
        return self.variance > 0.0


NOTHING = Rare()


@dataclass(frozen=True)
class Prediction:
    """What is predicted of a candidate; errors over the mean of the picture [1].

    Attributes
    ----------
    candidate : Candidate
    bias, bias_error : float
    texture, texture_error : float
    floor : Belief
        Root of bias squared and texture squared: the error that time does not bring down.
    variance : float
        Of one sample of a pixel, over the mean of the picture squared [1].
    turn : float
        Time on the clock of a sample of each pixel [s].
    piloted : bool
        Whether it was rendered, or follows from others that were.
    known : bool
        Whether the atlas covers the scene, or a pilot tells.
    regions : float
        Error of the means of regions of the picture, root mean square, that time does not bring down, of a level
        without single grains: as its bias, but what is too bright here does not make up for what is too dark there.
    rare : Rare
        What of the variance only chance finds.
    """

    candidate: Candidate
    bias: float
    bias_error: float
    texture: float
    texture_error: float
    floor: Belief
    variance: float
    turn: float
    piloted: bool
    known: bool
    regions: float = 0.0
    rare: Rare = NOTHING

    def meets(self, seconds: float) -> bool:
        """Return whether what only chance finds is more likely than not to be met within so long [s]."""
        return self.rare.meetings * seconds >= HALF * self.turn

    def variance_within(self, seconds: float) -> float:
        """Return the variance of a sample [1] as a picture of so long has it [s]."""
        return self.variance if not self.rare or self.meets(seconds) else self.variance - self.rare.variance

    def noise(self, seconds: float) -> float:
        """Return the standard error of pixels after so long [s]."""
        return math.sqrt(self.variance_within(seconds) * self.turn / seconds)

    def error(self, seconds: float) -> float:
        """Return the whole error after so long [s]."""
        unmet = 0.0 if not self.rare or self.meets(seconds) else self.rare.light
        return math.hypot(self.floor.value, self.noise(seconds), unmet)

    def error_of_blocks(self, seconds: float, across: float) -> float:
        """Return the whole error of the means of `BLOCK` by `BLOCK` pixels after so long [s], if what it misses is
        alike in so many of them across."""
        patches = min(max(across, 1.0) / BLOCK, 1.0)
        return math.hypot(self.texture * patches, self.error_of_regions(seconds))

    def error_of_regions(self, seconds: float) -> float:
        """Return the error of the means of `BLOCK` by `BLOCK` pixels after so long [s], but for texture that they miss:
        of light that few of them have met either its noise or that it is missing, whichever is less."""
        steady = math.sqrt((self.variance - self.rare.variance) * self.turn / seconds) / BLOCK
        rare = min(math.sqrt(self.rare.variance * self.turn / seconds) / BLOCK, self.rare.light)
        return math.hypot(max(abs(self.bias), self.regions), steady, rare)

    def likely_error(self, seconds: float) -> float:
        """Return the root mean square of the whole error after so long [s], over what the floor may be."""
        return math.hypot(self.error(seconds), self.floor.error)

    def seconds(self, target: float, floor: float | None = None) -> float:
        """Return the time to an error [s], infinite where it is out of reach; `floor` instead of what is believed."""
        left = target**2 - (self.floor.value if floor is None else floor) ** 2
        if self.rare and left > self.rare.light**2:
            soon = (self.variance - self.rare.variance) * self.turn / (left - self.rare.light**2)
            if not self.meets(soon):
                return soon
        return self.variance * self.turn / left if left > 0.0 else math.inf

    def safe_seconds(self, target: float) -> float:
        """Return the time to an error [s] that is at most a fifth larger if the floor is as high as it may well be."""
        return max(self.seconds(target), self.seconds(SLACK * target, self.floor.high))

    def sure_seconds(self, target: float) -> float:
        """Return the time to an error [s] if the floor is as high as it may well be."""
        return self.seconds(target, self.floor.high)

    def done(self, target: float) -> float:
        """Return when a picture is done that is to have an error [s]."""
        return self.safe_seconds(target) if self.reaches(target) else self.seconds(target)

    def reaches(self, target: float) -> bool:
        """Return whether there is such a time."""
        return self.floor.value < target and self.floor.high < SLACK * target


@dataclass(frozen=True, eq=False)
class Plan:
    """What is to be done, and why.

    Attributes
    ----------
    scene : Scene
        As it was planned for.
    target : float
        Error that is asked for [1].
    seconds : float or None
        Time that the picture takes [s], where it is not done at the target.
    predictions : tuple of Prediction
        The chosen first, then by the time to the target.
    fewer_far : bool
        Whether the explicit grains are to be fewer where a pixel covers more.
    why : tuple of str
        Three lines.
    needs : tuple of str
        What the tables lack, one line each.
    notes : tuple of str
        What the planner does not know.
    spent : float
        Time that planning took of processors that have nothing else to do: worlds that were built, with their packings
        and records, and pilots; machine code is not counted [s].
    clock : float
        Time that it took by the clock, everything counted [s].
    compiling : float
        What of this machine code took that was made for the first time [s].
    threads : int
    load : float
        How many times as long things take now as they would if processors had nothing else to do.
    spp : int or None
        Samples per pixel that the picture has, where it is done then.
    glints : float
        Time from which on single grains are taken that are left out, for most of their error would be the noise of
        their glints [s]; 0 where none are.
    grain : float
        How many pixels a grain looks across, about.
    regional : bool
        Whether the choice is by the error of regions: all that is left misses alike in pixels.
    suns : tuple of float
        How wide the smallest sun is, and at least in pilots [deg].
    rarer : float
        How many times as seldom as in pilots single grains meet suns in the picture.
    places, packings : dict
        Geometry and packed grains of the scene as far as they were made, for `tsdf.picture.world.build`.
    """

    scene: Scene
    target: float
    seconds: float | None
    predictions: tuple[Prediction, ...]
    fewer_far: bool
    why: tuple[str, ...]
    needs: tuple[str, ...]
    notes: tuple[str, ...]
    spent: float
    clock: float
    compiling: float
    threads: int
    load: float = 1.0
    spp: int | None = None
    glints: float = 0.0
    grain: float = 1.0
    regional: bool = False
    suns: tuple[float, float] = (math.inf, math.inf)
    rarer: float = 1.0
    places: dict[bool, Place] = field(default_factory=dict)
    packings: dict[bool, Packed] = field(default_factory=dict)

    @property
    def chosen(self) -> Prediction:
        return self.predictions[0]

    @property
    def able(self) -> float | None:
        """What of the time the picture has processors for [s]."""
        return None if self.seconds is None else self.seconds / self.load

    @property
    def noise(self) -> float:
        """Standard error of pixels at which the whole error is the target, and no more than a fifth above it if it has
        as much beside noise as may well be, where that is in reach; half of the target where neither is."""
        floor, target = self.chosen.floor, self.target
        likely, safe = target**2 - floor.value**2, (SLACK * target) ** 2 - floor.high**2
        if likely > 0.0:
            return math.sqrt(min(likely, safe) if safe > 0.0 else likely)
        return 0.5 * target

    @property
    def planned(self) -> Scene:
        """The scene, to be rendered as it is chosen."""
        scene = taken(self.scene, self.chosen.candidate)
        return replace(scene, render=replace(scene.render, fewer_far=self.fewer_far))
