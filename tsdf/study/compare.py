"""Comparison: every level of a scene against single grains, what each gets wrong, and what it costs.

The reference is the mean of the explicit level over several packings, so its own noise, the grains' places included, is
known per pixel from the packings' spread. Noise is taken off squared differences rather than left in, which needs
independent pictures: every picture here has random numbers of its own. Relative numbers are over the mean radiance of
the whole reference, dark background included. Pictures are made by `render`, charts by `plots`.
"""

import csv
import io
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tsdf.errors import TSDFError, UsageError
from tsdf.picture import render
from tsdf.picture.render import Picture
from tsdf.picture.world import World, build
from tsdf.scene.levels import LEVELS as MODELS
from tsdf.scene.scene import LEVELS, Scene

REFERENCES = LEVELS  # best first
TILES = 8  # along a side of the picture, whose spread gives the error of a mean over pixels
SEEN = 2.0  # standard errors above zero from which on a squared error counts as seen
MOST_PACKINGS = 100
UNSURE = 0.05  # relative noise of the reference's pixels from which on the user is told
TRIAL = 0.05  # share of its time after which a trial says how many samples a picture can have
TARGET = 0.01  # relative standard error per pixel to which times are given
SECONDS, REFERENCE_SECONDS = 10.0, 60.0  # [s] where nothing is said
LARGEST_SEED = 2**63


@dataclass(frozen=True)
class Difference:
    """How a picture differs from the reference, over the reference's mean.

    Attributes
    ----------
    mean, mean_error : float
        Difference of the mean radiances and its standard error [1].
    square, square_error : float
        Mean squared difference of pixels, noise of both taken off, and its standard error [1]; below zero by chance
        where there is nothing to see. Infinite error: unknown.
    """

    mean: float
    mean_error: float
    square: float
    square_error: float

    @property
    def seen(self) -> bool:
        """Whether the squared difference is more than noise."""
        return self.square > SEEN * self.square_error

    @property
    def rmse(self) -> float:
        """Root of the squared difference; where it is not seen, what it is below."""
        return math.sqrt(self.square if self.seen else max(self.square, 0.0) + SEEN * self.square_error)

    @property
    def bar(self) -> tuple[float, float]:
        """The root one standard error down and up; from 0 to `rmse` where nothing is seen."""
        if not self.seen:
            return 0.0, self.rmse
        return math.sqrt(self.square - self.square_error), math.sqrt(self.square + self.square_error)


@dataclass(frozen=True, eq=False)
class Row:
    """One level: its picture, and its difference to the reference.

    The reference's own row has the mean of its pictures, and as difference zero with its own noise; without a reference
    there is no difference.
    """

    level: str
    picture: Picture
    difference: Difference | None

    @property
    def samples(self) -> int:
        return int(self.picture.samples.sum())

    @property
    def mean(self) -> float:
        """Mean radiance."""
        return float(self.picture.rgb.mean())

    @property
    def variance_time(self) -> float:
        """Mean relative variance of pixels times seconds [s]: what a relative standard error of 1 takes."""
        return self.picture.relative_error**2 * self.picture.seconds


@dataclass(frozen=True, eq=False)
class Comparison:
    """All levels of a scene beside each other.

    Attributes
    ----------
    scene : Scene
    reference : str
        Level of the reference.
    pictures : int
        How many pictures it is the mean of.
    rows : tuple of Row
        The reference first; empty if not even it was finished.
    notes : tuple of str
        What was skipped, and what the user should know, one line each.
    interrupted : bool
    """

    scene: Scene
    reference: str
    pictures: int
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    interrupted: bool

    def speed_up(self, row: Row) -> float:
        """Return how many times less time than the reference a row takes to equal variance of pixels."""
        own = row.variance_time
        return self.rows[0].variance_time / own if own > 0.0 else math.inf


# ----------------------------------------------------------------------------------------------- numbers


def difference(picture: Picture, references: Sequence[Picture]) -> Difference:
    """Return how a picture differs from the mean of at least two independent pictures of the same size.

    The squared difference is the mean of (a - b)^2 - var a - var b, with var b from the spread of the references: what
    is left are errors of the model. Its error is the larger of two: the spread over tiles of the picture, which holds
    all that differs from place to place, and the jackknife over the references (three or more), which holds what a
    packing does to the whole picture.

    Raises
    ------
    UsageError
        Fewer than two references, pictures of different sizes, references that are black.
    """
    if len(references) < 2:
        raise UsageError("a reference is two pictures or more, for its noise is their spread")
    if any(reference.rgb.shape != picture.rgb.shape for reference in references):
        raise UsageError("pictures of different sizes cannot be compared; render them again with one width")
    a, own, b = picture.rgb, picture.variance, np.array([reference.rgb for reference in references])
    scale = float(b.mean())
    if not scale > 0.0:
        raise UsageError("the reference is black, and nothing is relative to that; give the scene light")

    def squares(some: np.ndarray) -> np.ndarray:
        excess = (a - some.mean(axis=0)) ** 2 - own - some.var(axis=0, ddof=1) / len(some)
        return excess.mean(axis=2) / scale**2

    pixels = squares(b)
    errors = [_tile_error(pixels)]
    if len(b) > 2:
        left_out = np.array([squares(np.delete(b, k, axis=0)).mean() for k in range(len(b))])
        errors.append(math.sqrt((len(b) - 1) * float(left_out.var())))
    known = [error for error in errors if math.isfinite(error)]
    means = b.mean(axis=(1, 2, 3))
    # channels as if their noise were one and the same: exact for grey light, an upper bound for any
    noise = float((np.sqrt(own).mean(axis=2) ** 2).sum()) / own[..., 0].size ** 2
    return Difference(
        mean=(float(a.mean()) - scale) / scale,
        mean_error=math.sqrt(noise + float(means.var(ddof=1)) / len(b)) / scale,
        square=float(pixels.mean()),
        square_error=max(known, default=math.inf),
    )


def _tile_error(pixels: np.ndarray) -> float:
    """Return the standard error of the mean of (h, w) from the spread of tiles; infinite if there is but one."""
    rows = np.array_split(pixels, min(TILES, pixels.shape[0]), axis=0)
    tiles = [t for row in rows for t in np.array_split(row, min(TILES, pixels.shape[1]), axis=1)]
    if len(tiles) < 2:
        return math.inf
    weight = np.array([tile.size for tile in tiles]) / pixels.size
    spread = np.array([tile.mean() for tile in tiles]) - pixels.mean()
    return math.sqrt(float((weight**2 * spread**2).sum()) * len(tiles) / (len(tiles) - 1))


def pooled(pictures: Sequence[Picture]) -> Picture:
    """Return the mean of pictures, as one that took all their samples and time; its variance is theirs, not their
    spread."""
    count = len(pictures)

    def total(name: str) -> int:
        return sum(getattr(picture, name) for picture in pictures)

    return Picture(
        rgb=np.mean([picture.rgb for picture in pictures], axis=0),
        variance=np.mean([picture.variance for picture in pictures], axis=0) / count,
        samples=np.sum([picture.samples for picture in pictures], axis=0),
        events=total("events"),
        rays=total("rays"),
        seconds=sum(picture.seconds for picture in pictures),
        truncated=total("truncated"),
        faults=total("faults"),
        interrupted=any(picture.interrupted for picture in pictures),
    )


def _own_noise(references: Sequence[Picture]) -> Difference:
    """Return the difference of a reference to itself: zero, with the noise of its mean and, as error, of its pixels."""
    b = np.array([reference.rgb for reference in references])
    scale = max(float(b.mean()), 1e-300)
    means = float(b.mean(axis=(1, 2, 3)).std(ddof=1))
    return Difference(
        0.0, means / math.sqrt(len(b)) / scale, 0.0, float(b.var(axis=0, ddof=1).mean()) / len(b) / scale**2
    )


# --------------------------------------------------------------------------------------------- rendering


def compare(
    scene: Scene,
    levels: Sequence[str] = LEVELS,
    spp: int | None = None,
    seconds: float | None = None,
    reference_seconds: float | None = None,
    packings: int = 4,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[float, str], None] | None = None,
    done: Callable[[str, World, Picture, int], None] | None = None,
    stop: threading.Event | None = None,
) -> Comparison:
    """Render a scene at several levels and measure them against the mean of several packings of single grains.

    Parameters
    ----------
    scene : Scene
    levels : sequence of str
        The reference's own is rendered in any case.
    spp : int, optional
        Samples per pixel of each level, and of each packing unless `reference_seconds` is given; at least 2. A level of
        packed grains that is not the reference is the mean of as many other packings, for they all differ.
    seconds : float, optional
        About the time of each level instead [s]; 10 if neither is given.
    reference_seconds : float, optional
        About the time of all packings together [s]; six times `seconds` if not given.
    packings : int
        How many packings, 2 to 100: the seed of each medium's packing goes up by one from each to the next. Where the
        explicit level is impossible, so many pictures of the best level that is not, with other random numbers.
    seed, threads, progress
        As of `render.render`.
    done : callable, optional
        Called with each finished picture: its name, world, picture and seed. Names are those of levels, "reference" for
        the mean of packings; that of the reference's level is its first packing.
    stop : Event, optional
        Set by others to end early; the rows are then those done so far.

    Raises
    ------
    UsageError, SceneError, FormatError
        In one line; a level that alone is impossible becomes a note instead.
    """
    if unknown := [level for level in levels if level not in LEVELS]:
        raise UsageError(f"no level {unknown[0]!r}; levels are {', '.join(LEVELS)}")
    if spp is not None and seconds is not None:
        raise UsageError("samples per pixel and seconds each say when a level is done: give one")
    if not 2 <= packings <= MOST_PACKINGS:
        raise UsageError(
            f"packings are 2 to {MOST_PACKINGS}, for their spread is the reference's noise, not {packings}"
        )
    if spp is None:
        seconds = SECONDS if seconds is None else seconds
        reference_seconds = REFERENCE_SECONDS / SECONDS * seconds if reference_seconds is None else reference_seconds
    for value in (spp, seconds, reference_seconds):
        if value is not None and not 0 < value < math.inf:
            raise UsageError(f"samples and seconds are finite numbers above 0, not {value}")

    notes: list[str] = []
    if singles := scene.render.explicit_grains:
        notes.append(f"the levels that go from grain to grain follow the first {singles} grains as level explicit does")
    level, world = _reference(scene, notes)
    better = REFERENCES[: REFERENCES.index(level)]  # impossible, and noted
    others = [name for name in LEVELS if name in levels and name not in (level, *better)]
    stop = stop or threading.Event()
    jobs = packings + sum(packings if _varies(scene, name) else 1 for name in others)
    series = _Series(scene, level, notes, seed, threads, jobs, progress, done, stop)
    try:
        try:
            series.pack(world, packings, spp, reference_seconds)
        finally:  # what there is of it, if it is cut short
            series.sum_up()
        if series.references and not series.lit:
            notes.append("the reference is black, and nothing is relative to that; give the scene light")
        for name in others:
            if stop.is_set():
                break
            series.judge(name, packings, spp, seconds)
    except KeyboardInterrupt:
        stop.set()
    rows = tuple(series.rows)
    return Comparison(scene, level, len(series.references), rows, tuple(dict.fromkeys(notes)), stop.is_set())


@dataclass(eq=False)
class _Series:
    """The pictures of a comparison, one after the other.

    Attributes
    ----------
    scene, seed, threads, progress, done, stop
        As of `compare`.
    level : str
        Of the reference.
    notes : list of str
    jobs, begun : int
        Pictures in all, and those begun.
    world : World
        Of the reference's last packing.
    references : list of Picture
    rows : list of Row
    """

    scene: Scene
    level: str
    notes: list[str]
    seed: int
    threads: int | None
    jobs: int
    progress: Callable[[float, str], None] | None
    done: Callable[[str, World, Picture, int], None] | None
    stop: threading.Event
    begun: int = 0
    world: World | None = None
    references: list[Picture] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)

    def pack(self, world: World, packings: int, spp: int | None, seconds: float | None) -> None:
        """Render the reference with several packings, the first of which is `world`'s, in `seconds` in all."""
        self.world = world
        for k in range(packings):
            if k and _varies(self.scene, self.level):
                self.world = build(_taken(_repacked(self.scene, k), self.level), self.level)
            time = seconds and seconds / packings
            what = f"{self.level}, picture {k + 1} of {packings}"
            picture = self._shot(self.world, k, what, None if time else spp, time)
            if picture is not None:
                self.references.append(picture)
                if k == 0:
                    self._keep(self.level, self.world, picture, self.level)
            if self.stop.is_set():
                return

    def sum_up(self) -> None:
        """Add the reference's row, and what is to be said of it."""
        level, references = self.level, self.references
        if not references:
            return
        noise = _own_noise(references) if len(references) > 1 else None
        self.rows.append(Row(level, pooled(references), noise))
        if noise is not None:
            if (pixels := math.sqrt(noise.square_error)) > UNSURE:
                self.notes.append(
                    f"the reference is only known to {100.0 * pixels:.2g} % per pixel: give it more seconds or fewer "
                    "pixels; a small sun it finds by chance alone, a wide one or an environment more easily"
                )
            assert self.world is not None
            mean = replace(self.rows[0].picture, variance=_spread(references))
            self._keep("reference", self.world, mean, level)

    def judge(self, name: str, packings: int, spp: int | None, seconds: float | None) -> None:
        """Add the row of another level, or why there is none; of so many packings that the reference has not, where
        its picture is one of single grains."""
        several = packings if _varies(self.scene, name) else 1
        pictures: list[Picture] = []
        for k in range(several):
            try:
                scene = _repacked(self.scene, packings + k) if several > 1 else self.scene
                world = build(_taken(scene, name), name)
            except TSDFError as error:
                self.notes.append(f"{name} is skipped: {error}")
                self.begun += several - k
                return
            what = name if several == 1 else f"{name}, picture {k + 1} of {several}"
            picture = self._shot(world, k, what, spp, seconds and seconds / several)
            if picture is not None:
                pictures.append(picture)
            if self.stop.is_set():
                break
        if len(pictures) < min(several, 2):
            return
        picture = pictures[0]
        if several > 1:  # what its packings differ by is noise, too
            picture = replace(pooled(pictures), variance=_spread(pictures))
        self.rows.append(Row(name, picture, difference(picture, self.references) if self.lit else None))
        self._keep(name, world, picture, name)

    @property
    def lit(self) -> bool:
        """Whether the reference has any light."""
        return any(picture.rgb.any() for picture in self.references)

    def _keep(self, name: str, world: World, picture: Picture, level: str) -> None:
        if self.done is not None:
            self.done(name, world, picture, _seed(self.seed, level, 0))

    def _shot(self, world: World, number: int, what: str, spp: int | None, seconds: float | None) -> Picture | None:
        """Return a picture with random numbers of its own, None if it was stopped before it could be one."""
        own = _seed(self.seed, world.level, number)
        before, self.begun = self.begun, self.begun + 1

        def part(share: float, word: str) -> None:
            if self.progress is not None:
                self.progress((before + share) / self.jobs, f"{what}, {word}")

        part(0.0, "starting")
        samples = _affordable(world, spp, seconds, own, self.threads, self.stop)
        picture = render.render(world, samples, None, None, own, self.threads, part, self.stop)
        return picture if not picture.interrupted or np.isfinite(picture.variance).all() else None


def _varies(scene: Scene, level: str) -> bool:
    """Return whether a picture is of one packing, and another of another."""
    return MODELS[level].traits.packed and bool(scene.media)


def _spread(pictures: Sequence[Picture]) -> np.ndarray:
    """Return the variance of the mean of pictures, from what they differ by."""
    return np.asarray(np.var([picture.rgb for picture in pictures], axis=0, ddof=1) / len(pictures))


def _affordable(
    world: World, spp: int | None, seconds: float | None, seed: int, threads: int | None, stop: threading.Event
) -> int:
    """Return samples per pixel: `spp`, or what fits into `seconds` by short trials, at least two.

    A number that is known beforehand, for pictures that are stopped by the clock throw away what is under way, which
    costs time and, where long paths are the late ones, light.
    """
    if seconds is None:
        assert spp is not None
        return max(2, spp)
    tried, taken = 1, 0.0
    while not stop.is_set():
        taken = max(render.render(world, tried, None, None, seed, threads, None, stop).seconds, 1e-6)
        if taken >= TRIAL * seconds:
            break
        tried *= 4
    return max(2, int(seconds / taken * tried)) if taken else 2


def _seed(seed: int, level: str, number: int) -> int:
    """Return the seed of a picture, another for each: with one seed for all, the noise of two would be the same."""
    return (seed + 1 + 2 * MOST_PACKINGS * LEVELS.index(level) + number) % LARGEST_SEED


def _reference(scene: Scene, notes: list[str]) -> tuple[str, World]:
    """Return the best level that is possible, and the scene at it; why not the better ones goes to the notes."""
    failed: TSDFError | None = None
    first: list[str] = []
    for level in REFERENCES:
        try:
            world = build(_taken(scene, level), level)
        except TSDFError as error:
            failed = failed or error
            first.append(f"{level} cannot be the reference: {error}")
            continue
        notes += [*first, *world.notes]
        return level, world
    assert failed is not None
    raise failed


def _taken(scene: Scene, level: str) -> Scene:
    """Return a scene without the explicit grains that a level cannot take."""
    if MODELS[level].traits.chains:
        return scene
    return replace(scene, render=replace(scene.render, explicit_grains=0))


def _repacked(scene: Scene, k: int) -> Scene:
    media = tuple(replace(m, packing_seed=(m.packing_seed + k) % LARGEST_SEED) for m in scene.media)
    return replace(scene, media=media)


# ----------------------------------------------------------------------------------------------- reports


def facts(comparison: Comparison) -> list[dict[str, float | int | str]]:
    """Return the numbers of each row; relative ones are shares of 1, times are in seconds."""
    found = []
    for row in comparison.rows:
        p, d = row.picture, row.difference
        one: dict[str, float | int | str] = {
            "level": row.level,
            "samples": row.samples,
            "seconds": p.seconds,
            "seconds_per_sample": p.seconds / row.samples,
            "events_per_sample": p.events / row.samples,
            "events_per_second": p.events / p.seconds,
            "mean": row.mean,
        }
        if d is not None:
            one |= {
                "mean_difference": d.mean,
                "mean_difference_error": d.mean_error,
                "square_difference": d.square,
                "square_difference_error": d.square_error,
                "rmse": d.rmse if row is not comparison.rows[0] else math.sqrt(d.square_error),
                "rmse_low": d.bar[0],
                "rmse_high": d.bar[1],
                "rmse_seen": int(d.seen),
            }
        one |= {
            "variance_time": row.variance_time,
            "seconds_to_1_percent": row.variance_time / TARGET**2,
            "speed_up": comparison.speed_up(row),
            "lost_paths": p.truncated + p.faults,
        }
        found.append(one)
    return found


def csv_text(comparison: Comparison) -> str:
    """Return `facts` as comma-separated values, a line for each level."""
    lines = facts(comparison)
    names = max(lines, key=len).keys() if lines else ("level",)
    text = io.StringIO()
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def markdown(comparison: Comparison) -> str:
    """Return the report: what was compared, the table, what its columns mean, notes."""
    c, camera = comparison, comparison.scene.camera
    kind = "packings" if _varies(c.scene, c.reference) else "pictures"
    title = c.scene.name.replace("|", r"\|")
    text = [
        f"# {title}: error against time",
        "",
        f"{camera.width} x {camera.height} pixels. Reference: {c.reference}, the mean of {c.pictures} {kind}."
        + " **Interrupted: not all that was asked for.**" * c.interrupted,
        "",
        "| level | time per sample [us] | events per sample | events per second | mean radiance "
        f"| mean to {c.reference} [%] | RMSE to {c.reference} [%] | variance x time [s] | time to 1 % [s] "
        f"| speed-up over {c.reference} |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row, one in zip(c.rows, facts(c), strict=True):
        cells = [
            row.level,
            f"{1e6 * float(one['seconds_per_sample']):.3g}",
            f"{one['events_per_sample']:.4g}",
            f"{one['events_per_second']:.3g}",
            f"{row.mean:.5g}",
            *_differences(row, row is c.rows[0]),
            f"{row.variance_time:.3g}",
            f"{one['seconds_to_1_percent']:.3g}",
            f"{one['speed_up']:.3g}",
        ]
        text.append(f"| {' | '.join(cells)} |")
    text += [
        "",
        "Events: grains met. Mean: difference and its standard error, in % of the reference's mean. RMSE: root",
        "mean square difference of pixels over the reference's mean, the noise of both pictures taken off, and one",
        f"standard error down and up; `<` where it is within {SEEN:g} of them of nothing. The reference's own row has",
        "its noise, what the places of its grains do included. Variance: of a pixel's mean within one packing, over",
        "the squared mean of the picture; time to 1 %: until its root, the relative standard error of pixels, is",
        "0.01; speed-up: at equal variance. Background counts as picture. Times are wall clock, all threads.",
    ]
    if c.notes:
        text += ["", *(f"- {note}" for note in c.notes)]
    return "\n".join(text) + "\n"


def _differences(row: Row, own: bool) -> tuple[str, str]:
    d = row.difference
    if d is None:
        return "-", "-"
    mean = f"{'' if own else f'{100.0 * d.mean:+.2f} '}± {100.0 * d.mean_error:.2g}"
    if own:
        return mean, f"± {100.0 * math.sqrt(d.square_error):.2g}"
    low, high = (100.0 * value for value in d.bar)
    return mean, f"{100.0 * d.rmse:.3g} ({low:.3g} to {high:.3g})" if d.seen else f"below noise, < {high:.2g}"
