"""Pilots: short renders of some pixels at the picture's own footprint, at one candidate each.

All pilots of a picture look at the same pixels, spread evenly, with the same random numbers, so that what they differ
by is less noisy than they are: with explicit grains first most paths are the same. Samples come in two halves that know
nothing of each other: the product of a difference in one and in the other is, in the mean, the difference squared
without its noise.
"""

import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from tsdf.picture.render import Walkers
from tsdf.picture.world import World, camera_of
from tsdf.walk import transport

PIXELS, FEWEST = 484, 64  # looked at, at most, and where samples are dear
MORE = 1936  # looked at where few pixels make most of a difference
LEAST_OF_FIRST = 0.2  # of the time of a sample as it seems, that it takes at least, where portions of two sizes tell
FREE = 0.25  # quantile of times that stands for a processor that has nothing else to do
FEW = 50  # one pixel in so many may make most of a difference
LATE = 6.0  # times what is asked for that it may take on the clock, where processors are busy with other things
MANY = 4  # times as many samples of a pixel, that portions of two sizes tell what one more takes
REGION = 16  # pixels that are looked at in a region
HALVES = 2
HALF = 1 << 40  # number of the first sample of the second half: one sample of a pixel is of one half in all pilots
AT_ONCE = 1 << 15  # samples of a thread at once, at most


class Clocks(NamedTuple):
    """What time is read from.

    thread: of one thread that has these walkers [s]; process: of all threads [s]; wall: on the clock [s].
    """

    thread: Callable[[Walkers], float] = lambda _: time.thread_time()
    process: Callable[[], float] = time.process_time
    wall: Callable[[], float] = time.perf_counter


CLOCKS = Clocks()


class Seen(NamedTuple):
    """What a pilot saw; its variance is infinite where that is black."""

    mean: float  # radiance
    variance: float  # of one sample of a pixel, the mean of all pixels, over the mean squared [1]
    seconds: float  # of one thread, a sample [s]
    events: float  # grains met by a sample
    samples: int


class Apart(NamedTuple):
    """How a pilot differs from another: of the mean, and the mean of the squared difference of pixels, without noise;
    over the other's mean [1], with standard errors, and what noise alone makes of the last of these. Of the square, the
    share that one pixel in `FEW` makes of which it is most, and the mean of its own square, what noise makes of its
    error in these pixels, and how many these are; and how many times what was seen the square is, where the picture has
    smaller suns."""

    bias: float
    bias_error: float
    square: float
    square_error: float
    noise: float = 0.0
    few: float = 0.0
    fourth: float = 0.0
    own: float = 0.0
    pixels: int = 0
    scale: float = 1.0


class Mark(NamedTuple):
    """Sums of the first `each` samples in each half of pixels `first` to `last`, (halves, n, 3)."""

    first: int
    last: int
    each: int
    sums: np.ndarray

    def of(self, first: int, last: int) -> np.ndarray:
        """Return those of pixels among them."""
        return self.sums[:, first - self.first : last - self.first]


class Pilot:
    """Samples of some pixels of a world.

    Attributes
    ----------
    world : World
    pixels : (n,) int64
        Numbers of the pixels.
    counts : (n,) int64
        Samples of each in each half.
    """

    def __init__(
        self, world: World, seed: int = 0, threads: int | None = None, pixels: int = PIXELS, clocks: Clocks = CLOCKS
    ) -> None:
        self.world, self.seed, self.threads, self.clocks = world, seed, threads or os.cpu_count() or 1, clocks
        camera = world.scene.camera
        self.pixels = spread(camera.width, camera.height, pixels, seed)
        n = len(self.pixels)
        self.sums, self.squares = np.zeros((HALVES, n, 3)), np.zeros((HALVES, n, 3))
        self.counts, self.active = np.zeros(n, np.int64), 0  # the first of those that samples are taken of now
        self.busy, self.wall = 0.0, 0.0  # [s] of all threads together; on the clock
        self.portions: dict[int, list[float]] = {}  # [s] of one thread, by how many samples of each pixel they were
        self.marks: list[Mark] = []
        self.like: Pilot | None = None  # whose times say how those of many samples are to those of few
        self._kept: tuple[object, Seen] | None = None  # asked for thousands of times a plan
        self._walkers: list[Walkers] = []

    @property
    def each(self) -> int:
        """Samples of a pixel in each half, of the first of them."""
        return int(self.counts[0])

    @property
    def done(self) -> int:
        """Samples of each pixel in each half that every thread has taken, of those that samples are taken of now."""
        return int(self.counts[self.active]) // self.threads

    def seconds_to(self, done: int) -> float:
        """Return about how long [s] it takes until these are so many; by another's times while it has none."""
        each = self.sample_seconds or (self.like.sample_seconds if self.like is not None else 0.0)
        return max(done - self.done, 0) * HALVES * (len(self.pixels) - self.active) * each

    def look_wider(self, pixels: int) -> None:
        """Have samples be taken of about so many pixels from here on, none of which it has looked at."""
        camera = self.world.scene.camera
        more = np.setdiff1d(spread(camera.width, camera.height, pixels, self.seed + 1), self.pixels)
        if not len(more):
            return
        old = len(self.pixels) if self.each else 0
        fresh = np.zeros((HALVES, len(more), 3))
        self.pixels, self.active = np.concatenate((self.pixels, more)), old
        self.sums, self.squares = (np.concatenate((own, fresh), axis=1) for own in (self.sums, self.squares))
        self.counts = np.concatenate((self.counts, np.zeros(len(more), np.int64)))

    def warm(self) -> None:
        """Follow one sample, so that everything is compiled."""
        if not self._walkers:
            self._walkers = [Walkers(self.world) for _ in range(self.threads)]
            followed(self._walkers[0], camera_of(self.world), self.pixels[:1], 1, 0, self.seed)
            for one in self._walkers:
                one.counters[:] = 0

    def run(self, seconds: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Take samples for about so long [s], or until stopped: of each thread, on processors that have nothing else
        to do. Portions end at powers of two as far as they can, which other pilots have come to as well."""
        self.warm()
        began, begun, share = self.clocks.wall(), self.busy, 1
        most = max(AT_ONCE // (len(self.pixels) - self.active), 1)
        while not stopped():
            before = self.busy
            self._take(share)
            took = (self.busy - before) / self.threads / share
            left = seconds - (self.busy - begun) / self.threads
            if left < took or self.clocks.wall() - began > LATE * seconds:
                break
            done = self.done
            able = max(min(int(0.7 * left / max(took, 1e-9)), most), 1)
            share = (1 << done.bit_length()) - done  # to the next power of two
            if share > able:
                share = 1 << (able.bit_length() - 1)
        self.wall += self.clocks.wall() - began

    def _take(self, each: int) -> None:
        """Take so many samples of each pixel that is active, in each half, for each thread."""
        camera = camera_of(self.world)
        jobs = [(h, k) for k in range(self.threads) for h in range(HALVES)]
        free, active = list(self._walkers), self.pixels[self.active :]
        done = int(self.counts[self.active])

        def work(job: tuple[int, int]) -> tuple[int, np.ndarray, float]:
            half, k = job
            mine = free.pop()
            began = self.clocks.thread(mine)
            first = half * HALF + done + k * each
            radiance = followed(mine, camera, active, each, first, self.seed, self.world.met)
            spent = self.clocks.thread(mine) - began
            free.append(mine)
            return half, radiance, spent

        with ThreadPoolExecutor(self.threads) as pool:
            for half, radiance, spent in pool.map(work, jobs):
                self.sums[half, self.active :] += radiance.sum(axis=1)
                self.squares[half, self.active :] += (radiance**2).sum(axis=1)
                self.busy += spent
                self.portions.setdefault(each, []).append(spent / len(active))
        self.counts[self.active :] += self.threads * each
        sums = self.sums[:, self.active :].copy()
        self.marks.append(Mark(self.active, len(self.pixels), done + self.threads * each, sums))

    @property
    def looked(self) -> np.ndarray:
        """Which pixels have samples (n,)."""
        return self.counts > 0

    @property
    def seen(self) -> Seen:
        """What it saw so far."""
        of = self.like.portions if self.like is not None else {}
        state = (
            float(self.sums.sum()), int(self.counts.sum()), len(self.pixels),
            *(len(spent) for times in (self.portions, of) for spent in times.values()),
        )  # fmt: skip
        if self._kept is None or self._kept[0] != state:
            self._kept = state, self._seen()
        return self._kept[1]

    def _seen(self) -> Seen:
        seen = self.looked
        count, samples = HALVES * self.counts[seen][:, None], HALVES * int(self.counts.sum())
        each, met = self.sample_seconds, self.events / max(samples, 1)
        if not samples:
            return Seen(0.0, math.inf, each, met, 0)
        means, squares = self.sums.sum(axis=0)[seen] / count, self.squares.sum(axis=0)[seen] / count
        mean = float(means.mean())
        if not mean > 0.0:
            return Seen(0.0, math.inf, each, met, samples)
        variance = np.maximum(squares - means**2, 0.0) * count / np.maximum(count - 1, 1)
        return Seen(mean, float(variance.mean()) / mean / mean, each, met, samples)

    @property
    def sample_seconds(self) -> float:
        """Time of a sample of one thread [s], of many samples of a pixel: the first of each takes longer, for what it
        meets has to be fetched, and so has what begins a portion. Other work on the machine only adds to times."""
        if not self.portions:
            return 0.0
        times = {each: float(np.quantile(spent, FREE)) for each, spent in self.portions.items()}
        low, high = min(times), max(times)
        rough, like = times[high] / high, self.like
        if like is not None and high < MANY * low and high in like.portions and max(like.portions) > MANY * high:
            return rough * like.sample_seconds * high / float(np.quantile(like.portions[high], FREE))
        if low == high:
            return rough
        return min(max((times[high] - times[low]) / (high - low), LEAST_OF_FIRST * rough), rough)

    @property
    def events(self) -> int:
        """Grains met by all samples."""
        return sum(int(one.counters[0]) for one in self._walkers)

    def pixel_means(self, half: int) -> np.ndarray:
        """Mean radiance of each pixel (n, 3) in one half."""
        means: np.ndarray = self.sums[half] / np.maximum(self.counts, 1)[:, None]
        return means

    def apart(self, other: "Pilot", within: "Pilot | None" = None, met: float | None = None) -> Apart:
        """Return how it differs from another of the same picture, which is not black, in pixels that both looked at, or
        a third as well; where most of their paths are the same, and have `met` so often what light comes from, by those
        that both took."""
        mean, n = other.seen.mean, min(len(one.pixels) for one in (self, other, within or self))
        both = np.logical_and.reduce([one.looked[:n] for one in (self, other, within or self)])
        n = int(both.sum())
        one, two = (((self.pixel_means(h)[: len(both)] - other.pixel_means(h)[: len(both)]) / mean)[both]
                    for h in range(HALVES))  # fmt: skip
        noise = (self.noise()[: len(both)] + other.noise()[: len(both)])[both] / mean**2  # of each half; as few samples
        # may not have shown it yet
        unsure = float(np.linalg.norm(noise)) / n
        beside = None if met is None else self._beside(other, both, mean, met)
        if beside is not None and beside[2].sum() < noise.sum():
            one, two, noise = beside
            unsure = float(np.linalg.norm(noise)) / n / math.sqrt(3.0)  # each by two numbers only
        apart, product = 0.5 * (one + two).mean(axis=1), (one * two).mean(axis=1)
        few = float(np.partition(product, -(n // FEW) - 1)[-(n // FEW) - 1 :].sum()) / max(float(product.sum()), 1e-12)
        few = min(max(few, 0.0), 1.0)
        whole = float(product.var(ddof=1)) / n
        own = min(whole, float((noise**2 + 2.0 * np.maximum(product, 0.0) * noise).sum()) / n**2)
        # pixels that were not looked at may have more, the more so the fewer make most of it; none is left of all
        left = 1.0 - n / (self.world.scene.camera.width * self.world.scene.camera.height)
        error = math.sqrt(own + (whole - own) * left * (1.0 + few) ** 2)
        all_of_it = float(apart.var(ddof=1)) / n
        noisy = min(all_of_it, 0.5 * float(noise.mean()) / n)
        bias, bias_error = float(apart.mean()), math.sqrt(noisy + (all_of_it - noisy) * left)
        fourth = float((product**2).mean())
        return Apart(bias, bias_error, float(product.mean()), max(error, unsure), unsure, few, fourth, own, n)

    def regions(self, other: "Pilot") -> tuple[float, float]:
        """Return the mean of the squared difference of regions of the picture to another, of `REGION` pixels that both
        looked at in each, without noise, over the other's mean [1], and its standard error, infinite of one."""
        n = min(len(self.pixels), len(other.pixels))
        both = self.looked[:n] & other.looked[:n]
        camera = self.world.scene.camera
        across = max(math.sqrt(REGION * camera.width * camera.height / max(int(both.sum()), 1)), 1.0)
        y, x = np.divmod(self.pixels[:n][both], camera.width)
        _, which = np.unique(
            (y / across).astype(np.int64) * camera.width + (x / across).astype(np.int64), return_inverse=True
        )
        counts = np.bincount(which)
        halves = []
        for half in range(HALVES):
            apart = (self.pixel_means(half)[:n] - other.pixel_means(half)[:n])[both] / other.seen.mean
            halves.append(np.stack([np.bincount(which, channel) for channel in apart.T], axis=1) / counts[:, None])
        product = (halves[0] * halves[1]).mean(axis=1)
        if len(product) < 2:
            return 0.0, math.inf
        share = counts / counts.sum()
        square = float(share @ product)
        return square, math.sqrt(float(share**2 @ (product - square) ** 2) * len(product) / (len(product) - 1))

    def _beside(
        self, other: "Pilot", both: np.ndarray, mean: float, met: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:  # fmt: skip
        """Return the differences of pixels in both halves, over a mean, and their noise, by as many of the first
        samples as both took: what these met alike is no part of it. None where there are no such samples."""
        sums, counts = np.zeros((HALVES, len(both), 3)), np.zeros(len(both))
        for own, beside in ((a, b) for a in self.marks for b in other.marks if a.each == b.each):
            first, last = max(own.first, beside.first), min(own.last, beside.last, len(both))
            if first < last and own.each > counts[first:last].max():
                sums[:, first:last] = own.of(first, last) - beside.of(first, last)
                counts[first:last] = own.each
        if not (counts[both] > 0).all():
            return None
        one, two = (sums[:, both] / counts[both][:, None]) / mean
        # of all the pixels that make the noise of what is not held side by side, and of all the lights that were met,
        # one may not have shown yet that it is apart
        mine, theirs = (p.noise()[: len(both)] * p.counts[: len(both)] for p in (self, other))
        whole = (mine + theirs)[both] / counts[both] / mean**2
        unseen = whole * max(float(whole @ whole) / max(float(whole.sum()) ** 2, 1e-300), 1.0 / max(met, 1.0))
        return one, two, 0.5 * ((one - two) ** 2).mean(axis=1) + unseen

    def noise(self) -> np.ndarray:
        """Variance of the mean of each pixel in one half, the mean of its channels (n,)."""
        count = HALVES * np.maximum(self.counts, 1)[:, None]
        mean = self.sums.sum(axis=0) / count
        variance = np.maximum(self.squares.sum(axis=0) / count - mean**2, 0.0)
        noise: np.ndarray = variance.mean(axis=1) / np.maximum(self.counts, 1)
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
    job = transport.Job(camera, 0, each, first, seed, met, np.ascontiguousarray(pixels, np.int64))
    return walkers.follow(job, len(pixels), threading.Event())
