"""Whether the error bar of a picture tells the truth: moments of its samples and their largest values.

A standard error is estimated from the very samples that it judges. Where a few of them bring most of the light, a small
sun that is met by chance say, it is as uncertain as the picture, and too small for as long as none has been met. After
the tests of MCNP (Los Alamos National Laboratory, MCNP theory manual, section 2.6.9): the relative variance of the
estimated variance, and how fast the largest samples fall off.
"""

import math
from dataclasses import dataclass

import numpy as np

from tsdf.walk.lights import LUMINANCE, LightArrays

ENOUGH = 3  # samples of a pixel that tell whether few make most of its variance; of two each makes half
MOST_VOV = 0.1  # [1] variance of the variance of a picture that is trusted; MCNP's
SHOWN = 0.1 * MOST_VOV  # [1] `Trust.chance` below which lights show in the variance, though grains send less their way
LEAST_SLOPE = 3.0  # of the density of samples: below, they have no variance; MCNP's
IDLE_VOV = 0.01  # below, the largest samples make too little of the variance for their slope to matter
SAME = 1e-12  # relative difference of samples that is rounding
LARGEST, RARE, FEWEST = 201, 20, 25  # samples that tell it: so many, of so many times as many at least; MCNP's most


@dataclass(frozen=True, eq=False)
class Trust:
    """What the samples of a picture say of its error bar.

    Attributes
    ----------
    vov : float
        Relative variance of the estimated variance of the picture's mean [1]: 1 where one sample makes it all, infinite
        where a pixel has fewer than `ENOUGH`, unless nothing varies.
    slope : float
        Exponent with which the density of the samples falls off beyond the largest of them; infinite where they are
        too few to tell.
    chance : float
        What `vov` would be expected to be of lights that only chance finds [1]; 0 where light is aimed at them.
    pixels : (h, w) float64
        `vov` of each pixel.
    """

    vov: float
    slope: float
    chance: float
    pixels: np.ndarray

    @property
    def unsure(self) -> float:
        """Share of the pixels whose own error bar cannot be trusted, by their own samples [1]."""
        return float((self.pixels > MOST_VOV).mean())

    @property
    def few(self) -> bool:
        """Whether all that is to be said is that samples are too few to say."""
        return math.isinf(self.vov) and not self.chance > MOST_VOV

    @property
    def doubt(self) -> str | None:
        """Why the error bar of the picture cannot be trusted, in one line; None if it can."""
        if self.chance > MOST_VOV:
            met = 1.0 / self.chance
            why = (
                f"suns or small bright lights are met by chance alone, about {met:.2g} times in all samples; widen "
                "them by a smooth sky, or take a level that aims at them"
            )
        elif self.few:
            why = f"too few samples to say, fewer than {ENOUGH} in a pixel; take more"
        elif self.vov > MOST_VOV:
            why = (
                f"a few bright samples make most of it (variance of the variance {self.vov:.2g}, above {MOST_VOV:g}); "
                "take more samples"
            )
        elif self.slope < LEAST_SLOPE and self.vov > IDLE_VOV:
            why = (
                f"its brightest samples become rarer too slowly to have a variance (slope {self.slope:.2g}, below "
                f"{LEAST_SLOPE:g}); widen small lights, or take another level"
            )
        else:
            return None
        return f"the error of the picture cannot be trusted: {why}"


class Moments:
    """Sums of powers over the samples of each pixel, and the largest of all; a sample is the mean of its channels.

    Powers are of what a sample is above the first of its pixel, so that pixels that do not vary have none to the last
    bit. What a sample is above the mean of its pixel, as far as that is known, tells how large it is.
    """

    def __init__(self, count: int) -> None:
        self.first = np.zeros(count)
        self.powers = np.zeros((4, count))
        self.largest = np.zeros(0)

    def add(self, own: slice, before: np.ndarray, radiance: np.ndarray) -> None:
        """Add radiance (pixels, number, 3) of pixels that had so many samples `before`."""
        value = (radiance[..., 0] + radiance[..., 1] + radiance[..., 2]) / 3.0
        number = value.shape[1]
        fresh = before == 0
        self.first[own][fresh] = value[fresh, 0]
        above = value - self.first[own][:, None]
        squares = above * above
        powers = self.powers[:, own]
        powers[0] += np.einsum("ij->i", above)
        powers[1] += np.einsum("ij->i", squares)
        powers[2] += np.einsum("ij,ij->i", squares, above)
        powers[3] += np.einsum("ij,ij->i", squares, squares)
        above -= (powers[0] / (before + number))[:, None]
        least = self.largest[0] if len(self.largest) == LARGEST else 0.0
        if (more := above[above > least]).size:
            self.largest = np.sort(np.concatenate((self.largest, more)))[-LARGEST:]

    def central(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of the second and fourth powers about the mean of each pixel, of so many samples."""
        n = np.maximum(samples, 1)
        one, two, three, four = self.powers
        mean = one / n
        second = np.maximum(two - mean * one, 0.0)
        fourth = four - 4.0 * mean * three + 6.0 * mean**2 * two - 3.0 * mean**3 * one
        return second, np.maximum(fourth, second**2 / n)

    def slope(self, samples: np.ndarray) -> float:
        """Return the exponent with which the density of the largest values falls off, infinite where it has an end or
        they are too few (Dekkers, Einmahl & de Haan 1989, eq. 1.7, which tells a far end from a slow fall)."""
        known = min(LARGEST, len(self.largest), int(samples.sum()) // RARE)
        if known < FEWEST:
            return math.inf
        largest = self.largest[-known:]
        logs = np.log(largest[1:] / largest[0])
        mean, square = float(logs.mean()), float((logs**2).mean())
        if not square > mean**2:
            return math.inf
        index = mean + 1.0 - 0.5 / (1.0 - mean**2 / square)
        return 1.0 + 1.0 / index if index > 0.0 else math.inf

    def trust(self, samples: np.ndarray, shape: tuple[int, ...], kurtosis: float) -> Trust:
        """Return what is to be said of a picture of so many samples of each pixel; kurtosis as of `kurtosis_of`."""
        second, fourth = self.central(samples)
        varies = second > (SAME * self.first) ** 2
        second, n = np.where(varies, second, 0.0), np.maximum(samples, ENOUGH)
        away = np.where(varies, fourth - second**2 / n, 0.0)
        away *= n * (n - 1) / (n - 2) ** 2  # second**2 where one sample makes it all
        with np.errstate(invalid="ignore", divide="ignore"):
            pixels = np.where(varies, away / second**2, 0.0)
        whole = float((second / n**2).sum())
        vov = float((away / n**4).sum()) / whole**2 if whole > 0.0 else 0.0
        few, lone = samples < ENOUGH, samples < 2
        if few.any() and (varies.any() or (lone.any() and not _alike(self.first))):  # of lone ones only others tell
            vov = math.inf
            pixels[few & (lone | varies)] = math.inf
        return Trust(vov, self.slope(samples), kurtosis / max(int(samples.sum()), 1), pixels.reshape(shape))


def _alike(values: np.ndarray) -> bool:
    """Return whether all of several pixels show the same light but for rounding, as in a furnace."""
    least, most = float(values.min()), float(values.max())
    return len(values) > 1 and most > 0.0 and most - least <= SAME * most


def kurtosis_of(lights: LightArrays) -> float:
    """Return the fourth moment over the squared second of the radiance of all directions: where a sun outshines all
    else, 1 over the share of the sphere that it takes."""
    sun = np.column_stack((0.25 * lights.sun_chord2, lights.sun_radiance @ LUMINANCE))
    height, width = lights.environment.shape[:2]
    if height:
        share = np.repeat(-np.diff(lights.cos_edges) / (2.0 * width), width)
        sky = np.column_stack((share, (lights.environment[..., :3] @ LUMINANCE).ravel()))
        sky[:, 1] -= float(sky.prod(axis=1).sum())
    else:
        sky = np.zeros((0, 2))
    share, radiance = np.concatenate((sky, sun)).T
    second = float((share * radiance**2).sum())
    return float((share * radiance**4).sum()) / second**2 if second > 0.0 else 0.0
