"""Records of first passage: where, and after how many grains, light that starts in the middle of a ball leaves it.

For a level and what a medium is made of. `leaps` takes many events in one step by them and says what a ball is. They
are made by the very chain that a walker follows (`transport`, `memory`), in an endless medium, once, and kept in the
user's cache beside the packings. Lengths are in the level's own unit: R where grains are spheres, else the mean free
path.

The chain is in the state of one that enters the next sphere, or meets the next point, at p along d, at the side t with
impact parameter b; where it will be in the end is E[p_oo] = M = p + K(b) d + H(b) t. M is a martingale: its steps have
mean 0, and their mean square, `step2`, adds up. docs/leaps.md derives what follows from that.
"""

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsdf import archive
from tsdf.compiled import njit
from tsdf.data.sampler import Tables, leave
from tsdf.data.table import Table, thawed
from tsdf.errors import TSDFError
from tsdf.handle import Handle
from tsdf.sampling import GOLDEN, SOBOL, key_of, mix, sobol, unit
from tsdf.scene.levels import Traits
from tsdf.spheres.packing import cache_folder
from tsdf.vectors import KERNEL, cross, dot, renewed, step
from tsdf.walk import memory as M
from tsdf.walk.transport import deflection
from tsdf.walk.walker import Media, halves

VERSION = 2  # of records; raised whenever the same arguments give others
CLASSES = 8  # of radii, each sqrt 2 of the one before
LEAST_RADIUS = 6.0  # [R] of the first class where grains are spheres: smaller balls are of a few grains
RECORDS = 4096  # of each class
FEWEST = 512  # where light hardly turns, and a record takes very many events
TRIED = (16, 16, 16, 16, 8, 8, 4, 4)  # times as many whose means the records are given, most of the balls most used
BUDGET = 6e7  # events that making records may take, unless there would be fewer than FEWEST
DRAWS = 1 << 20  # of deflections, for their means
BATCHES = 16  # of these draws: the errors are what they differ by
DEPTH, NU, MU, CHI, PSI, B, FLIGHT, GRAINS = range(8)  # columns of records: see `Passage`


class Chain(NamedTuple):
    """What the chain of a medium is drawn from; see `transport.WorldArrays`."""

    media: Media
    tables: Tables
    memory: M.Memory


@dataclass(frozen=True, eq=False)
class Passage:
    """Records of first passage of one medium at one level.

    Attributes
    ----------
    ahead, aside : (cells,) float64
        K and H by equal cells of the squared impact parameter of the entry.
    step2, turn : float
        Mean square of a step of M per grain met, and l* = step2 / (2 (mean free path + mean z)).
    radius : (classes,) float64
        Of the balls.
    numbers : (classes, 4) float64
        A and B of reff^2 = r^2 + 2 A r + B = step2 E[N]; what the mean N was over that, which records have been
        corrected for, and its standard error.
    records : (classes, n, 8) float32
        Where and whither the last grain was left: depth below the ball's surface; cosine nu between the way there from
        the middle, u, and the direction at the start, d_0; cosine mu between u and the direction d now; azimuth chi of
        d about u, from d_0 [turns]. What is entered next: azimuth psi of its side about d, from u [turns]; its impact
        parameter; the flight there, still pending. And N.
    crossed : (classes, n, components + 1) float32
        Path length in the matter of each component [R], events where it has none; and the length flown.
    """

    ahead: np.ndarray
    aside: np.ndarray
    step2: float
    turn: float
    radius: np.ndarray
    numbers: np.ndarray
    records: np.ndarray
    crossed: np.ndarray


# ------------------------------------------------------------------------------------------- the chains


@njit(**KERNEL)
def drawn(chain, m, first, last, seed, sums):
    """Add up what the mean step needs over draws `first` to `last` of a level that draws free paths: cosines, z, the
    square of the offset, and its part along the new direction; lengths in R."""
    media = chain.media
    begin = media.first[m]
    end = begin + media.kinds[m] - 1
    for i in range(first, last):
        key = key_of(seed, i, 0)
        c = M.component(media.choice, begin, end, sobol(i, 1, np.uint32(seed), SOBOL))
        cosine, _, r, z, phi, _, key = deflection(chain, c, sobol(i, 0, np.uint32(seed), SOBOL), key)
        d, offset = leave((0.0, 0.0, 1.0), cosine, 0.0, r, z, phi)
        sums[0] += cosine
        sums[1] += offset[2]
        sums[2] += dot(offset, offset)
        sums[3] += dot(offset, d)


@njit(forceinline=True, **KERNEL)
def azimuth(n, a, b):
    """Return the angle from a to b about the unit vector n, in [0, 1) turns; 0 where there is none."""
    a, b = step(a, -dot(a, n), n), step(b, -dot(b, n), n)
    turns = math.atan2(dot(cross(a, b), n), dot(a, b)) / (2.0 * math.pi)
    return turns - math.floor(turns)


@njit(forceinline=True, **KERNEL)
def ended(out, c, p, d, rest):
    """Write a record: p and d are where and whither the last grain was left, the direction at the start is along z, and
    `rest` is (t, b, pending flight, N, radius)."""
    t, b, s, n, radius = rest
    q = step(p, -1.0, c)
    far = math.sqrt(dot(q, q))
    u = (q[0] / far, q[1] / far, q[2] / far) if far > 0.0 else d
    out[DEPTH], out[NU], out[MU] = radius - far, u[2], min(max(dot(u, d), -1.0), 1.0)
    out[CHI], out[PSI] = azimuth(u, (0.0, 0.0, 1.0), d), azimuth(d, u, t)
    out[B], out[FLIGHT], out[GRAINS] = b, s, n


@njit(**KERNEL)
def flown(chain, m, job, ahead, out, crossed):
    """Write the records `first` to `last` of a level that draws free paths; job is (first, last, seed, radius, mean
    free path)."""
    media = chain.media
    first, last, seed, radius, mean = job
    begin = media.first[m]
    end = begin + media.kinds[m] - 1
    centre = (0.0, 0.0, ahead[0])
    for i in range(first, last):
        key = key_of(seed, i, 1)
        p, d, n, s = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0, 0.0
        while True:
            c = begin
            if end > begin:
                key += GOLDEN
                c = M.component(media.choice, begin, end, unit(mix(key)))
            key += GOLDEN
            u0, u1 = halves(mix(key))
            cosine, _, r, z, phi, length, key = deflection(chain, c, u0, key)
            d, offset = leave(d, cosine, u1, r, z, phi)
            d = renewed(d)
            p = step(p, 1.0, offset)
            n += 1
            crossed[i, c - begin] += length
            key += GOLDEN
            s = -mean * math.log(1.0 - unit(mix(key)))
            q = step(step(p, s, d), -1.0, centre)
            if dot(q, q) > radius * radius:
                break
            p = step(p, s, d)
            crossed[i, end + 1 - begin] += s
        ended(out[i], centre, p, d, ((1.0, 0.0, 0.0), 0.0, s, float(n), radius))


@njit(**KERNEL)
def remembered(chain, m, job, ahead, aside, out, crossed):
    """Write the records `first` to `last` of level teleport-memory; job is (first, last, seed, radius)."""
    memory = chain.memory
    first, last, seed, radius = job
    begin = chain.media.first[m]
    end = begin + chain.media.kinds[m] - 1
    for i in range(first, last):
        key = key_of(seed, i, 2)
        b2 = unit(mix(key))  # entries are even over the disc
        p, d, t, b, n, s = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), math.sqrt(b2), 0, 0.0
        cell = min(int(b2 * ahead.shape[0]), ahead.shape[0] - 1)
        centre = (aside[cell], 0.0, ahead[cell])
        while True:
            c = begin
            if end > begin:
                key += GOLDEN
                c = M.component(memory.choice, begin, end, unit(mix(key)))
            column = min(int(b * b * memory.columns[c]), memory.columns[c] - 1)
            hit, met = memory.hit[c, column], True
            if hit < 1.0:
                key += GOLDEN
                met = unit(mix(key)) < hit
            key += GOLDEN
            bits = mix(key)
            through = 2.0 * math.sqrt(max(0.0, 1.0 - b * b))
            if met:
                middle = step(step(p, 0.5 * through, d), -b, t)
                grain = memory.grains[c, column, int(unit(bits) * memory.kept[c])]
                d, t, b, out_normal = M.sent(grain, d, t)
                p = step(middle, 1.0, out_normal)
                n += 1
                crossed[i, c - begin] += float(grain[7])
                through = 0.0
                key += GOLDEN
                bits = mix(key)
            gap, t, b = M.onward(memory, m, d, t, b, bits)
            s = through + gap
            q = step(step(p, s, d), -1.0, centre)
            if dot(q, q) > radius * radius:
                break
            p = step(p, s, d)
            crossed[i, end + 1 - begin] += s
        ended(out[i], centre, p, d, (t, b, s, float(n), radius))


# ------------------------------------------------------------------------------------------- the means


class Means(NamedTuple):
    """The martingale of a chain: K and H by cells of b^2, mean square of its step and mean displacement per grain met,
    and the standard error of the former [1], 0 where it is an exact sum."""

    ahead: np.ndarray
    aside: np.ndarray
    step2: float
    shift: float
    error: float


def _of_free_paths(handle: Handle, m: int, mean: float, scale: float, pool: ThreadPoolExecutor) -> Means:
    """Return the means of a level that draws free paths of given mean; `scale` is R in the unit, 0 for points."""
    sums = np.zeros((BATCHES, 4))
    size = DRAWS // BATCHES
    list(pool.map(lambda k: drawn(handle, m, k * size, (k + 1) * size, np.uint64(1), sums[k]), range(BATCHES)))

    def means(sums: np.ndarray) -> tuple[float, float, float]:
        g, z, square, along = sums / size * (1.0, scale, scale**2, scale)
        ahead = (z + g * mean) / (1.0 - g)
        step2 = square + 2.0 * mean * (mean + ahead) + 2.0 * ahead * ahead
        step2 += 2.0 * along * (mean + ahead) - 2.0 * ahead * z - 2.0 * ahead * (mean + ahead) * g
        return float(ahead), float(step2), float(mean + z)

    ahead, step2, shift = means(sums.mean(axis=0))
    error = float(np.std([means(one)[1] for one in sums], ddof=1)) / math.sqrt(BATCHES) / step2
    return Means(np.array([ahead]), np.zeros(1), step2, shift, error)


def _of_memory(memory: M.Memory, m: int, first: int, kinds: int) -> Means:
    """Return the means of level teleport-memory, as exact sums over its records: what the chain is drawn from is
    discrete but for the impact parameter within a column.

    Where x = (K, H) by columns of the entry, x = rest + matrix x, for the mean displacement to come is that of this
    sphere and flight and what is to come from the next entry.
    """
    cells, k = memory.law.shape[1], int(memory.records[m])
    gap, b, cosine = (memory.law[m, :, :k, i].astype(np.float64) for i in range(3))
    columns = int(memory.columns[first : first + kinds].max())
    there = np.minimum((b * b * columns).astype(np.int64), columns - 1)
    pair = (np.arange(cells)[:, None] * columns + there).ravel()

    def by_cell(weight: np.ndarray) -> np.ndarray:
        return np.bincount(pair, weight.ravel() / k, cells * columns).reshape(cells, columns)

    to, to_side, mean_gap = by_cell(np.ones_like(gap)), by_cell(cosine), gap.mean(axis=1)
    edges = np.arange(columns + 1) / columns
    into = 2.0 / 3.0 * columns * -np.diff((1.0 - edges) ** 1.5)  # mean of sqrt(1 - b^2), and of b
    off = 2.0 / 3.0 * columns * np.diff(edges**1.5)
    middle = 0.5 * (edges[1:] + edges[:-1])
    own = np.minimum((middle * cells).astype(np.int64), cells - 1)

    # For each column: leaving by which cell, and the means that the sums need, of the grains it may hold
    leaving, met = np.zeros((4, columns, cells)), np.zeros(columns)  # z, t'_z, x, t'_x
    exits, rest = np.zeros((columns, cells)), np.zeros((2, columns))
    parts = []
    share = np.diff(memory.choice[first : first + kinds], prepend=0.0)
    for c, probability in zip(range(first, first + kinds), share, strict=True):
        at = np.minimum((middle * memory.columns[c]).astype(np.int64), memory.columns[c] - 1)
        hit = memory.hit[c, at].astype(np.float64)
        grains = memory.grains[c, at, : memory.kept[c]].astype(np.float64)
        x, _, z, tx, _, tz, out, _ = np.moveaxis(grains, 2, 0)
        a = np.sqrt(np.maximum(0.0, 1.0 - out * out))
        cell = np.minimum((out * out * cells).astype(np.int64), cells - 1)
        weight = probability * hit[:, None] / memory.kept[c] * np.ones_like(x)
        number = (np.arange(columns)[:, None] * cells + cell).ravel()
        for total, values in zip(leaving, (z, tz, x, tx), strict=True):
            total += np.bincount(number, (weight * values).ravel(), columns * cells).reshape(columns, cells)
        exits += np.bincount(number, weight.ravel(), columns * cells).reshape(columns, cells)
        nx, nz = out * tx + a * x, out * tz + a * z
        rest += [(weight * (into[:, None] + nz)).sum(axis=1), (weight * (nx - off[:, None])).sum(axis=1)]
        met += probability * hit
        parts.append((weight, cell, x, z, tx, tz, out, a, nx, nz))
    missed = 1.0 - met
    column = np.arange(columns)
    for total in (leaving[0], leaving[3], exits):
        total[column, own] += missed
    rest[0] += missed * 2.0 * into
    shift = rest[0] + exits @ mean_gap
    rest += [leaving[0] @ mean_gap, leaving[2] @ mean_gap]
    matrix = np.block([[leaving[0] @ to, leaving[1] @ to_side], [leaving[2] @ to, leaving[3] @ to_side]])
    ahead, aside = np.linalg.solve(np.eye(2 * columns) - matrix, rest.ravel()).reshape(2, columns)

    # The step of M is X + Y: of what the grain does, less where M was, and of flight and what is to come, whose means
    # are known by the cell of the exit
    on, beside = mean_gap + to @ ahead, to_side @ aside
    square = ((gap + ahead[there]) ** 2 + aside[there] ** 2).mean(axis=1)
    each = exits @ square + missed * (
        4.0 * (1.0 - middle - into * ahead)
        + ahead**2
        + aside**2
        + 2.0 * (2.0 * into - ahead) * on[own]
        - 2.0 * aside * beside[own]
    )
    forward, sideways, e, f = ahead[:, None], aside[:, None], into[:, None], off[:, None]
    for weight, cell, x, z, tx, tz, out, a, nx, nz in parts:
        xx = 2.0 + 2.0 * (e * nz - f * nx) - 2.0 * forward * (e + nz) - 2.0 * sideways * (nx - f)
        xx += forward**2 + sideways**2
        along = (e - forward) * z - (f + sideways) * x + a
        across = (e - forward) * tz - (f + sideways) * tx + out
        each += (weight * (xx + 2.0 * along * on[cell] + 2.0 * across * beside[cell])).sum(axis=1)
    passing = (exits @ to).T - np.eye(columns)
    passing[-1] = 1.0
    often = np.linalg.solve(passing, np.eye(columns)[-1])
    grains_met = float(often @ met)
    return Means(ahead, aside, float(often @ each) / grains_met, float(often @ shift) / grains_met, 0.0)


# ------------------------------------------------------------------------------------------- making, keeping


def _ahead(records: np.ndarray, means: Means) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the parts of M, seen from where the last grain was left: along u, across it toward d_0, and its square."""
    _, _, mu, chi, psi, b, s, _ = records.T
    cell = np.minimum((b * b * len(means.ahead)).astype(np.int64), len(means.ahead) - 1)
    along, across, sine = s + means.ahead[cell], means.aside[cell], np.sqrt(np.maximum(0.0, 1.0 - mu * mu))
    (co_chi, si_chi), (co_psi, si_psi) = ((np.cos(2.0 * np.pi * x), np.sin(2.0 * np.pi * x)) for x in (chi, psi))
    beside = along * sine * co_chi + across * (si_psi * si_chi - co_psi * mu * co_chi)
    return along * mu + across * co_psi * sine, beside, along**2 + across**2


def _corrected(tried: Sequence[np.ndarray], radius: np.ndarray, turn: float, means: Means) -> np.ndarray:
    """Return `Passage.numbers`, and correct the records that will be kept by what is known better than they know it.

    M is in the middle of the ball in the mean, and the mean of its square tells that of N. A is a smooth function of
    the radius.
    """
    count = min(len(one) // times for one, times in zip(tried, TRIED, strict=True))
    parts = [_ahead(one, means) for one in tried]
    off = [out - one[:, DEPTH] for one, (out, _, _) in zip(tried, parts, strict=True)]
    error = np.array([one.std() / math.sqrt(len(one)) for one in off])
    x = turn / radius
    a = np.polyval(np.polyfit(x, [one.mean() for one in off], 2, w=1.0 / error), x)
    numbers = []
    for one, (out, beside, square), r, mean in zip(tried, parts, radius, a, strict=True):
        depth, n = one[:, DEPTH], one[:, GRAINS]
        b2 = float((depth**2 - 2.0 * depth * out + square).mean())
        each = n * (means.step2 / (r * r + 2.0 * mean * r + b2))
        numbers.append([float(mean), b2, float(each[:count].mean()), float(each.std()) / math.sqrt(count)])
        n[:count] /= each[:count].mean()
        depth[:count] += (out - depth)[:count].mean() - mean
        nu, far = one[:count, NU].copy(), (r - depth + out)[:count]
        by, new = 0.0, nu
        askew = float((far * (1.0 - nu * nu)).mean())
        for _ in range(4 if askew > 0.0 else 0):  # grains that only turn light straight back leave nothing to mend
            by -= (far * new + beside[:count] * np.sqrt(1.0 - new * new)).mean() / askew
            new = np.clip(nu + by * (1.0 - nu * nu), -1.0, 1.0)
        one[:count, NU] = new
    return np.array(numbers)


def _even(crossed: np.ndarray, records: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the lengths of the records that are kept, of all that were tried, at the known rates per grain met."""
    kept = crossed[: len(records)]
    mean = kept.mean(axis=0)
    right = rate * records[:, GRAINS].mean(dtype=np.float64)
    even: np.ndarray = kept * np.divide(right, mean, out=np.ones_like(mean), where=mean > 0.0)
    return even


def made(
    chain: Chain, m: int, mean: float, scale: float, threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Passage:  # fmt: skip
    """Return the records of medium m of a chain; the same for any number of threads.

    Parameters
    ----------
    chain : Chain
    m : int
    mean, scale : float
        Mean free path and R in the unit of length; R is 0 where grains are points.
    threads : int, optional
        All processors by default.
    progress : callable, optional
        Called with the share done in [0, 1].
    """
    media = chain.media
    traits, kinds = media.traits, int(media.kinds[m])
    chain = chain._replace(media=media._replace(slot=np.zeros_like(media.slot)))  # all lengths are wanted
    handle = Handle(chain)
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        if traits.remembers:
            means = _of_memory(chain.memory, m, int(media.first[m]), kinds)
        else:
            means = _of_free_paths(handle, m, mean, scale, pool)
        turn = means.step2 / (2.0 * means.shift)
        radius = max(turn, LEAST_RADIUS * scale) * 2.0 ** (0.5 * np.arange(CLASSES))
        events = float(np.dot(TRIED, (radius + turn) ** 2)) / means.step2
        count = int(min(RECORDS, max(FEWEST, BUDGET / events)))
        tried = [np.zeros((times * count, GRAINS + 1)) for times in TRIED]
        crossed = [np.zeros((times * count, kinds + 1)) for times in TRIED]
        jobs = [(k, count * i, count * (i + 1)) for k in reversed(range(CLASSES)) for i in range(TRIED[k])]

        def one(job: tuple[int, int, int]) -> float:
            k, first, last = job
            where = (first, last, np.uint64(1000 + k), float(radius[k]))
            if traits.remembers:
                remembered(handle, m, where, means.ahead, means.aside, tried[k], crossed[k])
            else:
                flown(handle, m, (*where, mean), means.ahead, tried[k], crossed[k])
            return (last - first) * float(radius[k]) ** 2

        done, total = 0.0, count * float(np.dot(TRIED, radius**2))
        for part in pool.map(one, jobs):
            done += part
            if progress is not None:
                progress(done / total)
    rates = [one.sum(axis=0) / other[:, GRAINS].sum() for one, other in zip(crossed, tried, strict=True)]
    numbers = _corrected(tried, radius, turn, means)
    records = np.array([one[:count] for one in tried], np.float32)
    lengths = np.array([_even(*one) for one in zip(crossed, records, rates, strict=True)], np.float32)
    return Passage(means.ahead, means.aside, means.step2, turn, radius, numbers, records, lengths)


def _digest(traits: Traits, grains: Sequence[tuple[Table, float]], law: np.ndarray, *numbers: float) -> str:
    """Return what tells records from others: all that they are made of, but for the text of this package."""
    found = hashlib.sha256(repr((VERSION, RECORDS, TRIED, tuple(traits), numbers)).encode())
    found.update(law.tobytes())
    for table, share in grains:
        found.update(json.dumps(thawed(table.header), sort_keys=True).encode())
        found.update(table.pixels.data)
        found.update(repr(share).encode())
    return found.hexdigest()


def kept(
    chain: Chain, m: int, grains: Sequence[tuple[Table, float]], mean: float, scale: float,
    progress: Callable[[float], None] | None = None,
) -> Passage:  # fmt: skip
    """Return the records of a medium as `made` does, from the user's cache if they are there, else kept in it.

    Parameters
    ----------
    grains : sequence of (Table, float)
        The medium's components and the probability that the next grain is of each.
    """
    traits, kinds = chain.media.traits, len(grains)
    g = float(chain.media.g[chain.media.first[m]]) if traits.lobe else 0.0
    if not traits.spheres:
        mean, scale = 1.0, 0.0  # the mean free path is the unit
    law = chain.memory.law[m, :, : chain.memory.records[m]] if traits.remembers else np.zeros(0)
    digest = _digest(traits, grains if traits.spheres or traits.tabulated else (), law, kinds, g, mean, scale)
    path = cache_folder() / f"leaps-{digest[:32]}.npz"
    found = _read(path, digest, kinds)
    if found is None:
        found = made(chain, m, mean, scale, progress=progress)
        _keep(path, digest, found)
    return found


def _read(path: Path, digest: str, kinds: int) -> Passage | None:
    """Return records that are kept, None where they are not or are not whole."""
    try:
        arrays = archive.read(path, 64 * CLASSES * RECORDS * (GRAINS + kinds + 2) + (1 << 20))
        label, means = str(arrays.pop("digest")), arrays.pop("means")
        step2, turn = (float(x) for x in means)
        found = Passage(step2=step2, turn=turn, **arrays)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    shape = found.records.shape
    right = (
        label == digest
        and shape == (CLASSES, shape[1], GRAINS + 1)
        and found.crossed.shape == (CLASSES, shape[1], kinds + 1)
        and found.numbers.shape == (CLASSES, 4)
        and found.radius.shape == (CLASSES,)
        and found.ahead.shape == found.aside.shape
        and found.ahead.ndim == 1
    )
    return found if right else None


def _keep(path: Path, digest: str, found: Passage) -> None:
    """Keep records for later runs, where that is possible."""
    arrays = {name: getattr(found, name) for name in ("ahead", "aside", "radius", "numbers", "records", "crossed")}
    with contextlib.suppress(OSError, TSDFError):
        path.parent.mkdir(parents=True, exist_ok=True)
        archive.write(path, arrays | {"digest": np.array(digest), "means": np.array([found.step2, found.turn])})
