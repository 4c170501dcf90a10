"""Spectral albedo of slabs and half-spaces of grains, at any level: paths once, and every wavelength read off them.

A path keeps the length of grain material it went through, so exp(-sigma_a length) is what is left of it at any
wavelength; it is followed with the absorption of the wavelength that is absorbed least. Only n cannot be changed
afterwards: paths are followed at the index of up to three tables of a family, the rest is their polynomial. Ground
under the slab is added exactly, from what the slab does to diffuse light. Deep down paths leap; where they cannot, few
of the long ones are followed to their end (`_thin`). What k makes of the surface of grains paths do not know; it is put
in by doubling. Theories to compare with are `streams`.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.data.phase import legendre
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.picture.media import DARKEST
from tsdf.picture.world import World, beam, build
from tsdf.sampling import mix, unit
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, free_path, volume_parameters
from tsdf.scene.scene import Absorption, GrainSpec, Slab
from tsdf.study import streams
from tsdf.study.experiment import WIDE, scene_of, trips
from tsdf.study.spectra import Family, Spectrum, absorbed, lagrange, moments_of
from tsdf.walk import transport

GROUPS = 32  # of paths, whose spread tells the error
CHUNK = 4096  # paths that one thread follows at a time
FEWEST, MOST = 1 << 14, 1 << 24  # paths of a set
SPREAD = 0.4  # of what a path gives: a guess for how many it takes, before any is followed
DEEP = 30.0  # decay lengths of the least absorbed light from which on a slab is a half-space
FEEBLE = 1e-9  # co-albedo below which a half-space cannot be told from one that absorbs nothing
CLEAR = 5.0  # [R] above the slab where light starts
BINS = 256  # of the logarithm of the matter crossed
LENGTHS = np.concatenate(([0.0], np.geomspace(1e-4, 1e12, BINS)))  # [R], or grains met
LATTICE = (0.7548776662466927, 0.5698402909980532)  # inverse powers of the root of a^3 = a + 1
FAINTLY = 0.999  # albedo from which on free paths are those without absorption to a thousandth
FAINT = 1e-6  # [1/R] an absorption coefficient for which free paths are taken
CROSSINGS = 2  # that a path counts among the grains met: its way into the slab and out
LONG = 512  # grains met between two times that a path may be given up
APART = np.uint64(0x3C6EF372FE94F82B)  # from other uses of a walker's key


@dataclass(frozen=True)
class Request:
    """A slab and its light.

    Parameters
    ----------
    level : str
    packing_fraction : float
        Share of the volume in bounding spheres [1].
    thickness : float
        [R]; infinite for a half-space.
    cosine : float, optional
        Of the angle of incidence, in (0, 1]; None for diffuse light.
    ground : float
        Reflectance of the ground below, in [0, 1], the same to all sides.
    depths : int
        Layers of equal thickness of the absorption profile; 0 for none. A half-space's go down to `profile_depth`.
    profile_depth : float
        [R]; of a half-space.
    mesh : path, optional
        Of a grain that is not built in, for level explicit.

    Raises
    ------
    UsageError
    """

    level: str = "volume"
    packing_fraction: float = 0.3
    thickness: float = math.inf
    cosine: float | None = None
    ground: float = 0.0
    depths: int = 0
    profile_depth: float = 100.0
    mesh: Path | None = None

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise UsageError(f"no level {self.level!r}; levels are {', '.join(LEVELS)}")
        if not self.thickness > 0.0:
            raise UsageError(f"the thickness of a slab is above 0, not {self.thickness:g} R")
        if self.cosine is not None and not 0.0 < self.cosine <= 1.0:
            raise UsageError("light comes in at an angle from 0 to below 90 degrees to the normal")
        if not 0.0 <= self.ground <= 1.0:
            raise UsageError(f"the reflectance of the ground is 0 to 1, not {self.ground:g}")
        if not 0 <= self.depths <= 1000:
            raise UsageError(f"a profile has 1 to 1000 layers, not {self.depths}")
        if not 0.0 < self.profile_depth < math.inf:
            raise UsageError(f"the depth of a profile is a finite number above 0, not {self.profile_depth:g} R")

    @property
    def lights(self) -> tuple[float | None, ...]:
        """Lights whose paths are needed: its own, and diffuse light where there is ground to send it up."""
        grounded = self.ground > 0.0 and math.isfinite(self.thickness)
        return (self.cosine, None) if grounded and self.cosine is not None else (self.cosine,)


@dataclass(frozen=True, eq=False)
class Albedo:
    """What a slab does to light by wavelength, shares of the incident light; arrays (w,) float64.

    Attributes
    ----------
    reflectance, transmittance : transmittance is what reaches the ground, again and again.
    reflectance_error, transmittance_error : one standard error, and what is not known of surfaces with k.
    theories : Theories
        Of the same slab, and what the polynomial in n may miss of the reflectance.
    profile, profile_error : (depths, w) absorbed in each layer; in a grain it counts where light leaves it
    edges : (depths + 1,) float64 depths of the layers' ends [R]
    paths : int
        In each set.
    eta : (s,) float64
        Indices at which paths were followed.
    seconds : float
        Processor time.
    finished : bool
        Whether all paths that were asked for, or that the error takes, were followed.
    """

    reflectance: np.ndarray
    transmittance: np.ndarray
    reflectance_error: np.ndarray
    transmittance_error: np.ndarray
    theories: "Theories"
    profile: np.ndarray
    profile_error: np.ndarray
    edges: np.ndarray
    paths: int
    eta: np.ndarray
    seconds: float
    finished: bool


def extinction(table: Table, packing_fraction: float, albedo: np.ndarray) -> np.ndarray:
    """Return the extinction coefficient of point scatterers at single-scattering albedos (w,), (w,) float64 [1/R]."""
    path = free_path([Component(table)], packing_fraction)
    return np.asarray(1.0 / (path.lambda_beta + albedo * path.lambda_s))


def depth_of(table: Table, packing_fraction: float, x: float) -> float:
    """Return the thickness [R] of a slab from which on it is a half-space to light absorbed as sigma_a R = x says.

    Raises
    ------
    UsageError
        If so little is absorbed that light hardly ever ends.
    """
    albedo, g = (float(value) for value in absorbed(table, np.array([x]))[:2, 0])
    if 1.0 - albedo < FEEBLE:
        raise UsageError(
            f"a grain absorbs {1.0 - albedo:.1g} of the light at the wavelength it absorbs least: a half-space of them "
            "sends all of it back, after paths without end; give a thickness, other wavelengths or larger grains"
        )
    decay = math.sqrt(3.0 * (1.0 - albedo) * (1.0 - albedo * g))
    return DEEP * max(1.0, 1.0 / decay) / float(extinction(table, packing_fraction, np.array([albedo]))[0])


@njit(cache=True)
def _deposit(layers, group, layer, before, after, weight, lengths):  # type: ignore[no-untyped-def]
    """Add the matter that was crossed between two amounts to the cells it covers, layers[group, layer, cell]."""
    for i in range(len(group)):
        if layer[i] >= layers.shape[1] or before[i] == after[i]:
            continue
        low, high = min(before[i], after[i]), max(before[i], after[i])
        sign = weight[i] if after[i] > before[i] else -weight[i]
        k = max(np.searchsorted(lengths, low, side="right") - 1, 0)
        while k < layers.shape[2] and lengths[k] < high:
            layers[group[i], layer[i], k] += sign * (min(high, lengths[k + 1]) - max(low, lengths[k]))
            k += 1


@njit(cache=True)
def _thin(walkers, able, met):  # type: ignore[no-untyped-def]
    """Return which walkers go on: of those that have met j times `LONG` grains sqrt(j / (j + 1)), as if they were all.

    Of a half-space's paths about 1/sqrt(n) meet more than n grains, and most of the time would go to the longest of
    them. So thinned they are as 1/n, and what that adds to the variance of the reflectance is below .3 where light
    comes back nearly whole, about what it is where half of it does.
    """
    on = able.copy()
    for i in range(len(walkers)):
        if not able[i]:
            continue
        times = met[i] // LONG
        if times < 1.0 or met[i] % LONG != 0.0:
            continue
        share = math.sqrt(times / (times + 1.0))
        if unit(mix(walkers[i].key ^ APART)) < share:
            walkers[i].weight /= share
        else:
            on[i] = False
            walkers[i].weight = 0.0
    return on


def _diffuse(walkers: np.ndarray, numbers: np.ndarray, top: float) -> None:
    """Turn walkers that come down so that they fall on the same places as diffuse light does, by their numbers.

    Directions are points of a lattice with the golden ratio's and its kin's multiples, cosine-weighted.
    """
    u, v = ((0.5 + (numbers & 0xFFFFFFFF) * step) % 1.0 for step in LATTICE)
    cosine = np.sqrt(np.maximum(u, 1e-12))
    sine = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
    way = np.stack([sine * np.cos(2.0 * np.pi * v), sine * np.sin(2.0 * np.pi * v), -cosine], axis=1)
    place = walkers["p"].copy()
    place[:, 2] = top
    walkers["d"], walkers["p"] = way, place - way * (CLEAR / cosine)[:, None]


@dataclass(eq=False)
class Paths:
    """One set of paths: a table, a light, and the sums so far over groups of them.

    Attributes
    ----------
    light : (GROUPS, 2, w) float64
        Sums of what came back and what passed.
    layers : (GROUPS, depths, BINS) float64
        Sums of the matter crossed in each layer, by how much was crossed before.
    count : (GROUPS,) int64
    """

    world: World
    cosine: float | None
    exponents: np.ndarray  # (amounts, w): logarithm of what an amount of matter leaves
    stretch: np.ndarray  # (2, w): that of a grain met, and of a length flown, where free paths depend on absorption
    edges: np.ndarray
    finite: bool
    number: int
    light: np.ndarray
    layers: np.ndarray
    count: np.ndarray
    seconds: float = 0.0

    @classmethod
    def start(cls, table: Table, request: Request, cosine: float | None, x: np.ndarray, number: int) -> "Paths":
        """Return a set of which no path is followed yet, for absorptions x = sigma_a R (w,) [1]."""
        traits = LEVELS[request.level].traits
        component = [Component(table)]
        lossless = volume_parameters(component, request.packing_fraction)
        thickness = request.thickness
        if math.isinf(thickness):
            thickness = depth_of(table, request.packing_fraction, float(x.min()))
        deep = math.isinf(request.thickness) and not request.depths
        # free paths and phase functions are those of grains that hardly absorb; how much of it is seen to afterwards
        world = build(
            scene_of(
                Slab(-thickness, 0.0), GrainSpec(table, absorption=Absorption("grey", (FAINT,)), mesh=request.mesh),
                request.packing_fraction,
            ),
            request.level,
            leap=None if deep else 0.0,
        )  # fmt: skip
        kept = np.maximum(absorbed(table, x)[0], DARKEST)
        stretch = np.zeros((2, len(x)))
        rows = [np.log(kept) if traits.points else -x]
        media = world.media if world.leap else world.media._replace(limit=1 if request.depths else LONG)
        if traits.similar:
            rows.append(-lossless.sigma_t * lossless.g * (1.0 - kept))
        elif not traits.spheres and not deep:  # of a half-space only albedo and phase function count
            if math.isfinite(request.thickness):
                ratio = extinction(table, request.packing_fraction, kept) / lossless.sigma_t
                stretch = np.stack([np.log(ratio), -(ratio - 1.0) * lossless.sigma_t])
            media = media._replace(travel=np.ones(1, np.int64))
            rows.append(np.zeros(len(x)))
        exponents = np.stack(rows)
        best = int(np.argmax(exponents[0]))
        absorption = world.absorption._replace(
            rgb=np.ascontiguousarray(np.tile(exponents[:, best], (3, 1))),
            least=np.ascontiguousarray(exponents[:, best]),
            spectral=np.zeros((0, len(rows))),
        )
        depths = request.depths
        bottom = request.thickness if math.isfinite(request.thickness) else request.profile_depth
        return cls(
            replace(world, absorption=absorption, amounts=len(rows), media=media),
            cosine, exponents, stretch, np.linspace(0.0, bottom, depths + 1),
            math.isfinite(request.thickness), number, np.zeros((GROUPS, 2, len(x))),
            np.zeros((GROUPS, depths, BINS)), np.zeros(GROUPS, np.int64),
        )  # fmt: skip

    @property
    def top(self) -> float:
        """Height of the slab's upper side, relative to the scene's centre."""
        return -float(self.world.place.centre[2])

    def camera(self) -> transport.CameraArrays:
        """Return the beam, or what `_diffuse` turns into diffuse light."""
        cosine = 1.0 if self.cosine is None else self.cosine
        way = np.array([math.sqrt(1.0 - cosine**2), 0.0, -cosine])
        return beam(self.world, -way * (CLEAR + WIDE) / cosine, way, WIDE)

    def follow(self, first: int, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Return sums over paths first .. first + count - 1 by group, and processor time: light, layers, count."""
        world, top = self.world, self.top
        light, layers = np.zeros_like(self.light), np.zeros_like(self.layers)
        begin = (self.number << 40) + first
        group = np.arange(first, first + count) % GROUPS
        met, before, weight = np.zeros(count), np.zeros(count), np.ones(count)
        profiled = len(self.edges) > 1

        def aim(new: np.ndarray) -> None:
            if self.cosine is None:
                _diffuse(new, begin + new["sample"].astype(np.int64), top)

        def heard(those: np.ndarray, crossed: np.ndarray, able: np.ndarray) -> np.ndarray:
            number = those["sample"]
            met[number] += those["events"]
            if not world.leap:
                able = able & _thin(those, able, met[number])
            if profiled:
                layer = np.searchsorted(self.edges, np.maximum(top - those["p"][:, 2], 0.0), side="right") - 1
                if self.finite:  # what leaves below is beyond the last
                    layer = np.minimum(layer, len(self.edges) - 2)
                _deposit(layers, group[number], layer, before[number], crossed[:, 0], weight[number], LENGTHS)
                before[number], weight[number] = crossed[:, 0], those["weight"]
            end = ~able & (those["weight"] > 0.0)
            if end.any():
                exponent = crossed[end] @ self.exponents
                if self.stretch.any():
                    grains = met[number[end]] - CROSSINGS
                    exponent += np.outer(grains, self.stretch[0]) + np.outer(crossed[end, 1], self.stretch[1])
                left = those["weight"][end, None] * np.exp(exponent)
                side = (those["d"][end, 2] <= 0.0).astype(np.int64)
                for s in range(2):
                    np.add.at(light[:, s], group[number[end]][side == s], left[side == s])
            return able

        _, _, seconds = trips(world, self.camera(), begin, count, seed, heard, aim)
        return light, layers, np.bincount(group, minlength=GROUPS), seconds

    def more(self, paths: int, seed: int, pool: ThreadPoolExecutor) -> Iterator[float]:
        """Follow so many more paths; yield the share done."""
        done = int(self.count.sum())
        jobs = [(at, min(CHUNK, done + paths - at)) for at in range(done, done + paths, CHUNK)]
        for number, (light, layers, count, seconds) in enumerate(
            pool.map(lambda job: self.follow(job[0], job[1], seed), jobs), 1
        ):
            self.light += light
            self.layers += layers
            self.count += count
            self.seconds += seconds
            yield number / len(jobs)

    def means(self, without: int | None = None) -> np.ndarray:
        """Return reflectance and transmittance, (2, w) float64, of all groups but one."""
        kept = np.arange(GROUPS) != without
        return np.asarray(self.light[kept].sum(axis=0) / self.count[kept].sum())

    def profile(self, without: int | None = None) -> np.ndarray:
        """Return what is absorbed in each layer, (depths, w) float64, of all groups but one."""
        kept = np.arange(GROUPS) != without
        crossed = self.layers[kept].sum(axis=0) / self.count[kept].sum()
        rate = -self.exponents[0]
        with np.errstate(under="ignore"):
            left = np.exp(-np.outer(LENGTHS, rate))
        return np.asarray(crossed / np.diff(LENGTHS) @ -np.diff(left, axis=0))


def check_paths(paths: int | None) -> None:
    """Refuse fewer paths than there are groups of them; None is not given.

    Raises
    ------
    UsageError
    """
    if paths is not None and paths < GROUPS:
        raise UsageError(f"at least {GROUPS} paths tell an error, not {paths}")


def chosen(family: Family) -> list[int]:
    """Return the numbers of the tables at which paths are followed: at the ends and in the middle, at most."""
    last = len(family.tables) - 1
    return sorted({0, int(np.argmin(np.abs(family.eta - 0.5 * (family.eta[0] + family.eta[-1])))), last})


def measure(
    family: Family,
    found: Spectrum,
    request: Request,
    target: float = 0.002,
    seed: int = 0,
    threads: int | None = None,
    paths: int | None = None,
    told: Callable[[float, str], None] = lambda share, word: None,
    goes_on: Callable[[int], bool] = lambda paths: True,
) -> Albedo:
    """Return what a slab does to light at the wavelengths of a spectrum.

    Parameters
    ----------
    family : Family
    found : Spectrum
        Of the same family.
    request : Request
    target : float
        Standard error of reflectance and transmittance at which to stop.
    seed : int
        Of the random numbers; the same for any number of threads.
    threads : int, optional
        All processors by default.
    paths : int, optional
        Of each set, instead of a target.
    told : callable
        Called with the share done, in [0, 1], and a word about it.
    goes_on : callable
        Called now and then with the number of paths that each set has had at least; tells whether to follow more. It is
        not heeded as long as that is 0.

    Raises
    ------
    UsageError
        For fewer paths than `GROUPS`, where absorption is not known, and for a half-space of grains that absorb next
        to nothing.
    SceneError
        If the level cannot be had of these tables.
    """
    check_paths(paths)
    x, n = found.absorption_times_radius, found.constants.n
    if np.isnan(x).any():
        where = found.constants.wavelength_nm[np.isnan(x)]
        raise UsageError(
            f"k of {found.constants.material} is not known at {where[0]:g} nm, so how it absorbs is not: give a file "
            "of constants that has k, or other wavelengths"
        )
    which = chosen(family)
    eta = family.eta[which]
    told(0.0, "theories")
    weights, theories = lagrange(eta, n), _theories(family, found, request, which)
    sets = [
        [Paths.start(family.tables[t], request, light, x, len(request.lights) * number + k) for number, t in
         enumerate(which)] for k, light in enumerate(request.lights)
    ]  # fmt: skip
    flat = [one for light in sets for one in light]

    def result(without: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        both = [np.einsum("wt,tsw->sw", weights, np.array([one.means(without) for one in light])) for light in sets]
        layers = [np.einsum("wt,tzw->zw", weights, np.array([one.profile(without) for one in light])) for light in sets]
        light, diffuse = streams.Streams(*both[0]), streams.Streams(*both[-1])
        whole, profile = light, layers[0]
        if request.ground > 0.0 and math.isfinite(request.thickness):
            whole = streams.over_ground(light, diffuse, request.ground)
            profile = layers[0] + request.ground * whole.transmittance * layers[-1][::-1]
        reflected, passed = (of + more for of, more in zip(whole, theories.surface, strict=True))
        whole = streams.Streams(np.clip(reflected, 0.0, 1.0), np.maximum(passed, 0.0))  # what passes, again and again
        if len(profile) and math.isfinite(request.thickness):
            # where free paths depend on absorption, layers do not know; of faint ones the rest is noise
            kept = whole.reflectance + (1.0 - request.ground) * whole.transmittance
            rest = (1.0 - kept) / np.maximum(profile.sum(axis=0), 1e-300)
            profile = profile * np.where(found.albedo < FAINTLY, rest, 1.0)
        elif len(profile):
            profile = profile * ((1.0 - whole.reflectance) / np.maximum(1.0 - light.reflectance, 1e-300))
        return np.array(whole), profile

    threads = threads or os.cpu_count() or 1
    done, following = 0, min(paths, FEWEST) if paths else FEWEST
    wanted, on = paths or max(following, int((SPREAD / target) ** 2)), True
    with ThreadPoolExecutor(threads) as pool:
        while following and on:
            steps = (
                (number + share) / len(flat) for number, one in enumerate(flat)
                for share in one.more(following, seed, pool)
            )  # fmt: skip
            for within in steps:
                told(min((done + within * following) / wanted, 1.0), f"{done + following} of about {wanted} paths")
                if done and not goes_on(done):
                    break
            steps.close()  # jobs that are not begun are not done
            done = min(int(one.count.sum()) for one in flat)
            on = goes_on(done)
            spread = [result(group)[0] for group in range(GROUPS)]
            error = _jackknife(spread)
            if paths:
                following = min(paths - done, max(done, FEWEST))
            else:
                needed = min(done * (float(error.max()) / target) ** 2 * 1.05, MOST)
                following = max(0, min(int(needed) - done, 8 * done)) if error.max() > target else 0
                following = -(-following // GROUPS) * GROUPS
                wanted = max(int(needed), done)
    whole, profile = result()
    profile_error = _jackknife([result(group)[1] for group in range(GROUPS)]) if request.depths else profile
    if (felt := found.surface.felt).any():
        full = family.weights(n[felt])
        alone = np.einsum("wt,tw->w", full, found.albedo_of_tables[:, felt])
        unsure = found.surface.unsure(full, alone)
        error[:, felt] += unsure * np.abs(theories.surface)[:, felt]
    return Albedo(
        whole[0], whole[1], error[0], error[1], theories, profile, profile_error, flat[0].edges, done, eta,
        sum(one.seconds for one in flat), not following,
    )  # fmt: skip


def _jackknife(spread: list[np.ndarray]) -> np.ndarray:
    """Return the standard error of what leaving out each group gives."""
    values = np.array(spread)
    return np.asarray(np.sqrt((GROUPS - 1) / GROUPS * ((values - values.mean(axis=0)) ** 2).sum(axis=0)))


class Theories(NamedTuple):
    """What theories say of a slab: from the same optical depth, albedo and g; `doubled` from the whole phase function.

    `between` is how far off two streams would be between the tables that paths are followed at; `surface` what k makes
    of the surface, which paths do not know, by doubling; `optical_depth` that of the slab, (w,) float64.
    """

    two_streams: streams.Streams
    asymptotic: streams.Streams
    doubled: streams.Streams
    between: np.ndarray
    surface: streams.Streams
    optical_depth: np.ndarray


def _theories(family: Family, found: Spectrum, request: Request, which: list[int]) -> Theories:
    n, x, f = found.constants.n, found.absorption_times_radius, request.packing_fraction
    full, few = family.weights(n), lagrange(family.eta[which], n)

    def over(solve: Callable[[float | None], streams.Streams]) -> streams.Streams:
        light = solve(request.cosine)
        return streams.over_ground(light, solve(None), request.ground) if request.ground else light

    def depth(albedo: np.ndarray) -> np.ndarray:
        each = np.array([extinction(table, f, albedo) for table in family.tables])
        return np.asarray(request.thickness * np.einsum("wt,tw->w", full, each))

    def eddington(depth: np.ndarray, w: np.ndarray, cosine: np.ndarray) -> streams.Streams:
        return over(lambda mu: streams.two_streams(depth, w, cosine, mu))

    def doubled(depth: np.ndarray, albedo: np.ndarray, moments: np.ndarray) -> streams.Streams:
        return over(lambda mu: streams.doubled(depth, albedo, moments, mu))

    single = [absorbed(table, x)[:2] for table in family.tables]
    each = np.array([
        eddington(request.thickness * extinction(family.tables[t], f, single[t][0]), *single[t]).reflectance
        for t in which
    ])  # fmt: skip
    albedo, g = np.einsum("wt,tqw->qw", full, np.array(single))
    albedo = np.clip(albedo, 0.0, 1.0)
    between = np.abs(np.einsum("wt,tw->w", few, each) - eddington(depth(albedo), albedo, g).reflectance)

    exact = doubled(depth(found.albedo), found.albedo, moments_of(family, found, streams.ORDERS)[0])
    surface = streams.Streams(np.zeros(len(n)), np.zeros(len(n)))
    if (felt := found.surface.felt).any():  # the tables that paths are followed at, as they are
        paths = np.zeros((2, int(felt.sum())))
        for i, t in enumerate(which):
            table, w = family.tables[t], single[t][0][felt]
            masses = np.array([table.deflection_masses(float(a)) for a in x[felt]])
            moments = legendre(table.cos_theta_edges, masses, streams.ORDERS)
            paths += few[felt, i] * doubled(request.thickness * extinction(table, f, w), w, moments)
        for whole, of_paths, more in zip(exact, paths, surface, strict=True):
            more[felt] = whole[felt] - of_paths
        between[felt] = 0.0

    statistics = [table.statistics for table in family.tables]
    lossless, length = (full @ np.array([s[name] for s in statistics]) for name in ("mean_cosine", "mean_path_length"))
    empty = depth(np.ones(len(n)))
    simple = over(lambda mu: streams.asymptotic(empty, x * length, lossless, mu))
    thick = (1.0 - lossless) * empty >= 1.0  # of a slab thinner than a transport length it knows nothing
    return Theories(
        eddington(depth(found.albedo), found.albedo, found.g),
        streams.Streams(*(np.where(thick, values, math.nan) for values in simple)), exact, between, surface,
        depth(found.albedo),
    )  # fmt: skip


def records_of(level: str) -> str | None:
    """Return the block of records that a level draws from, None where it needs none."""
    records = LEVELS[level].records
    return None if records is None else records.block


def columns(result: Albedo, found: Spectrum) -> dict[str, np.ndarray]:
    """Return what a slab does as named columns; layers of the profile by number, from above."""
    sheet = {
        "wavelength_nm": found.constants.wavelength_nm, "optical_depth": result.theories.optical_depth,
        "reflectance": result.reflectance, "reflectance_error": result.reflectance_error,
        "between": result.theories.between,
        "transmittance": result.transmittance, "transmittance_error": result.transmittance_error,
    }  # fmt: skip
    for name in ("doubled", "two_streams", "asymptotic"):
        sheet[f"{name}_r"], sheet[f"{name}_t"] = getattr(result.theories, name)
    for number, (layer, error) in enumerate(zip(result.profile, result.profile_error, strict=True), 1):
        sheet[f"absorbed_{number}"], sheet[f"absorbed_{number}_error"] = layer, error
    return sheet
