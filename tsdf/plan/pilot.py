"""Pilots: short renders of some pixels at the picture's own footprint, at one candidate each.

All pilots of a picture look at the same pixels, spread evenly, with the same random numbers, so that what they differ
by is less noisy than they are. Samples come in two halves that know nothing of each other: the product of a difference
in one and in the other is, in the mean, the difference squared without its noise.
"""

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from tsdf.picture.render import SLOTS, Walkers
from tsdf.picture.world import World, camera_of
from tsdf.walk import transport

PIXELS, FEWEST = 484, 64  # looked at, at most, and where samples are dear
LATE = 6.0  # times what is asked for that it may take on the clock, where processors are busy with other things
HALVES = 2
AT_ONCE = 1 << 15  # samples of a thread at once, at most


class Seen(NamedTuple):
    """What a pilot saw; its variance is infinite where that is black."""

    mean: float  # radiance
    variance: float  # of one sample of a pixel, the mean of all pixels, over the mean squared [1]
    seconds: float  # of one thread, a sample [s]
    events: float  # grains met by a sample
    samples: int


class Apart(NamedTuple):
    """How a pilot differs from another: of the mean, and the mean of the squared difference of pixels, without noise;
    over the other's mean [1], with standard errors."""

    bias: float
    bias_error: float
    square: float
    square_error: float


class Pilot:
    """Samples of some pixels of a world.

    Attributes
    ----------
    world : World
    pixels : (n,) int64
        Numbers of the pixels.
    """

    def __init__(self, world: World, seed: int = 0, threads: int | None = None, pixels: int = PIXELS) -> None:
        self.world, self.seed, self.threads = world, seed, threads or os.cpu_count() or 1
        camera = world.scene.camera
        self.pixels = spread(camera.width, camera.height, pixels, seed)
        n = len(self.pixels)
        self.sums, self.squares = np.zeros((HALVES, n, 3)), np.zeros((HALVES, n, 3))
        self.each = 0  # samples of a pixel in each half
        self.busy, self.wall = 0.0, 0.0  # [s] of all threads together; on the clock
        self.timed, self.timed_samples, self.largest = 0.0, 0, 0  # [s] of the largest portions, whose start is no part
        self._walkers: list[Walkers] = []

    def warm(self) -> None:
        """Follow one sample, so that everything is compiled."""
        if not self._walkers:
            self._walkers = [Walkers(self.world) for _ in range(self.threads)]
            followed(self._walkers[0], camera_of(self.world), self.pixels[:1], 1, 0, self.seed)
            for one in self._walkers:
                one.counters[:] = 0

    def run(self, seconds: float) -> None:
        """Take samples for about so long [s]: of each thread, on processors that have nothing else to do."""
        self.warm()
        began, begun, share = time.perf_counter(), self.busy, 1
        while True:
            before = self.busy
            self._take(share)
            took = (self.busy - before) / self.threads / share
            left = seconds - (self.busy - begun) / self.threads
            if left < took or time.perf_counter() - began > LATE * seconds:
                break
            share = max(1, min(8 * share, int(0.7 * left / took), AT_ONCE // len(self.pixels)))
        self.wall += time.perf_counter() - began

    def _take(self, each: int) -> None:
        """Take so many samples of each pixel, in each half, for each thread."""
        camera = camera_of(self.world)
        jobs = [(h, k) for k in range(self.threads) for h in range(HALVES)]
        free = list(self._walkers)

        def work(job: tuple[int, int]) -> tuple[int, np.ndarray, float]:
            half, k = job
            mine, began = free.pop(), time.thread_time()
            first = HALVES * (self.each + k * each) + half * each  # halves share no sample
            radiance = followed(mine, camera, self.pixels, each, first, self.seed, self.world.met)
            spent = time.thread_time() - began
            free.append(mine)
            return half, radiance, spent

        if each > 2 * self.largest:
            self.timed, self.timed_samples, self.largest = 0.0, 0, each
        with ThreadPoolExecutor(self.threads) as pool:
            for half, radiance, spent in pool.map(work, jobs):
                self.sums[half] += radiance.sum(axis=1)
                self.squares[half] += (radiance**2).sum(axis=1)
                self.busy += spent
                if 2 * each > self.largest:
                    self.timed, self.timed_samples = self.timed + spent, self.timed_samples + radiance[..., 0].size
        self.each += self.threads * each

    @property
    def seen(self) -> Seen:
        """What it saw so far."""
        n, count = len(self.pixels), HALVES * self.each
        total, squares = self.sums.sum(axis=0), self.squares.sum(axis=0)
        mean = float(total.mean()) / max(count, 1)
        events, each = sum(int(one.counters[0]) for one in self._walkers), self.timed / max(self.timed_samples, 1)
        met = events / max(count * n, 1)
        if not mean > 0.0:
            return Seen(0.0, math.inf, each, met, count * n)
        variance = np.maximum(squares / count - (total / count) ** 2, 0.0) * count / max(count - 1, 1)
        grey = float(variance.mean())
        return Seen(mean, grey / mean / mean, each, met, count * n)

    def pixel_means(self, half: int) -> np.ndarray:
        """Mean radiance of each pixel (n, 3) in one half."""
        means: np.ndarray = self.sums[half] / max(self.each, 1)
        return means

    def apart(self, other: "Pilot") -> Apart:
        """Return how it differs from another of the same picture, which is not black."""
        mean = other.seen.mean
        one, two = ((self.pixel_means(h) - other.pixel_means(h)) / mean for h in range(HALVES))
        both, product = 0.5 * (one + two).mean(axis=1), (one * two).mean(axis=1)
        n = len(self.pixels)
        noise = (self.noise() + other.noise()) / mean**2  # of each half; as few samples may not have shown it yet
        error = max(float(product.std(ddof=1)) / math.sqrt(n), float(np.linalg.norm(noise)) / n)
        return Apart(float(both.mean()), float(both.std(ddof=1)) / math.sqrt(n), float(product.mean()), error)

    def noise(self) -> np.ndarray:
        """Variance of the mean of each pixel in one half, the mean of its channels (n,)."""
        count = HALVES * self.each
        mean = self.sums.sum(axis=0) / count
        variance = np.maximum(self.squares.sum(axis=0) / count - mean**2, 0.0)
        noise: np.ndarray = variance.mean(axis=1) / max(self.each, 1)
        return noise


def spread(width: int, height: int, most: int = PIXELS, seed: int = 0) -> np.ndarray:
    """Return numbers of pixels spread evenly over a picture, one at random in each of at most `most` parts of it, (n,)
    int64."""
    columns = max(1, min(width, round(math.sqrt(most * width / height))))
    rows = max(1, min(height, most // columns))
    rng = np.random.default_rng(seed)
    x, y = (
        ((np.arange(parts)[shape] + rng.random((rows, columns))) * size / parts).astype(np.int64)
        for parts, size, shape in ((columns, width, np.s_[None, :]), (rows, height, np.s_[:, None]))
    )
    return np.unique(y * width + x)


def followed(
    walkers: Walkers, camera: transport.CameraArrays, pixels: np.ndarray, each: int, first: int, seed: int,
    met: np.ndarray = transport.NOBODY,
) -> np.ndarray:  # fmt: skip
    """Return the radiance (n, each, 3) of samples `first` and so on of pixels that need not lie side by side."""
    total = len(pixels) * each
    walkers.reserve(total)
    spawned, live = 0, 0
    while live or spawned < total:
        while live <= SLOTS // 2 and spawned < total:
            number, begun = divmod(spawned, each)
            fresh = min(SLOTS - live, each - begun)
            walkers.spawn(live, transport.Job(camera, int(pixels[number]), each, first, seed, met), begun, fresh)
            walkers.walkers[0][live : live + fresh]["sample"] += number * each
            spawned, live = spawned + fresh, live + fresh
        live = walkers.turn(live)
    return walkers.radiance[:total].reshape(len(pixels), each, 3).copy()
