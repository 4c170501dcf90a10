"""The planner: predicts what each way to render a scene costs and gets wrong; takes the cheapest that is good enough.

What is expected of a scene is `prior`, what short renders of it show is `pilot`, how the two become one number is
`beliefs`, and what a candidate and an error are is `study.candidates`. Level explicit is right by definition; where it
cannot be piloted, the next best that can stands for it, and what that is expected to get wrong is added.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import SceneError, TSDFError, UsageError
from tsdf.picture.footprint import PER_E
from tsdf.picture.trust import kurtosis_of
from tsdf.picture.world import World, build
from tsdf.plan import beliefs, needs, prior
from tsdf.plan.beliefs import Belief
from tsdf.plan.pilot import FEWEST, HALVES, PIXELS, Apart, Pilot, Seen
from tsdf.plan.prediction import Plan, Prediction
from tsdf.plan.report import why
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, free_path
from tsdf.scene.scene import Scene
from tsdf.spheres.packing import MAX as MOST_PACKED
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.walk.explicit import mesh_beside
from tsdf.walk.geometry import Place

TARGET = 0.02  # [1] where nothing else is asked for
LEAST_TARGET, MOST_TARGET = 1e-4, 1.0
GRAINS = (0, 3, 8, 16)  # explicit ones before a chain
SECONDS, SHARE, MOST_SECONDS = 5.0, 0.1, 20.0  # [s] of worlds and pilots; or this share of the render, up to so much
LEAST_PILOTS = 2.0  # [s] for pilots, however long worlds take to build
BUILDING = 0.4  # of the time, after which no more worlds are built
TURN = 0.05  # of the time, that a sample of each pixel of the reference may take
FIRST, OF_REFERENCE = 0.35, 0.4  # shares of the time for the first round, and of a round for the reference
OUT = 2.0  # spreads below what is expected that an error must be within reach of what is asked for
LEAPS = 2.0  # [l*] of thickness from which on records for leaps may have to be made, a second each
MOST_FINALISTS = 4
LATEST = 0.7  # of the time, after which nothing more is made ready for the second round
CHECK = 0.1  # of the time for a look at what is chosen and was not seen
NEAR = 3.0  # times as long as the best as a candidate may seem to take to be looked at again
EVENT_S = (1.0e-6, 5.0e-6)  # [s] of one explicit grain, an exact sphere and one of facets, about
MEETINGS = 400.0  # of lights that are met by chance alone, that a pilot is believed from on: its mean, and what others
# differ from it by, is known to a twentieth then, and the error bar of that to as much
LEAST_PER_E = 2.0  # explicit grains of facets that bring texture down by e, at least
TIE = 1.1  # times as long as the cheapest as it may take, of those the one with the least error is taken
PATIENCE = 600.0  # [s] that a picture may take where nothing is said
ALIKE = 0.2  # of the logarithm of an error, what two levels of teleportation may differ by
BUSY = 1.5  # times as long as on processors that have nothing else to do, from which on it is said
LEAST = 1e-4  # [1] of an error
UNSURE = 0.8  # of the logarithm of texture, what that law may be off by for other grains than spheres
FADING = 0.3  # of the logarithm of texture, what that law may be off by
FEWER = 1.3  # times as large as they look in the middle, grains must look somewhere for their number to go by pixel


def checked_target(target: float, name: str = "target") -> float:
    """Return the error that is asked for.

    Raises
    ------
    UsageError
    """
    if not LEAST_TARGET <= target < MOST_TARGET:
        raise UsageError(
            f"{name} is an error of pixels over the mean of the picture, from {LEAST_TARGET:g} to below "
            f"{MOST_TARGET:g}, not {target:g}; 0.02 is 2 %"
        )
    return target


def plan(
    scene: Scene, target: float = TARGET, seconds: float | None = None, spp: int | None = None, seed: int | None = None,
    threads: int | None = None, told: Callable[[float, str], None] | None = None,
) -> Plan:  # fmt: skip
    """Return how a scene is best rendered.

    Parameters
    ----------
    scene : Scene
        Whose own level is not looked at.
    target : float
        Error of the picture that is asked for, bias, texture and noise together, over its mean [1].
    seconds : float, optional
        Time that the picture may take [s], `PATIENCE` by default, infinite for as long as it takes: it is the cheapest
        that meets the target within it, else the one with the least error.
    spp : int, optional
        Samples per pixel that it will have instead: then it is the cheapest whose bias and texture alone are within the
        target, else that in which they are least.
    seed : int, optional
        Of the pilots; the scene's by default.
    threads : int, optional
        All processors by default.
    told : callable, optional
        Called with the share done and a word about it.

    Raises
    ------
    UsageError, SceneError, FormatError
        In one line; a level that is impossible is a note instead, unless all are.
    """
    checked_target(target)
    if seconds is not None and not seconds > 0.0:
        raise UsageError(f"seconds are a number above 0, not {seconds:g}")
    if scene.render.explicit_grains:
        raise UsageError(f"{scene.name}: explicit_grains is what a plan chooses; leave it out, or name a level")
    run = _Planning(scene, target, seconds, scene.render.seed if seed is None else seed, threads or os.cpu_count() or 1)
    run.spp = spp
    run.told = told or (lambda share, word: None)
    return run.plan()


class _Planning:
    """What is common to one plan, as far as it has come."""

    def __init__(self, scene: Scene, target: float, seconds: float | None, seed: int, threads: int) -> None:
        self.asked, self.target, self.seed, self.threads = scene, target, seed, threads
        self.limit = PATIENCE if seconds is None else seconds
        self.said = seconds is not None and math.isfinite(seconds)  # whether that long is meant, and not at most
        self.told: Callable[[float, str], None] = lambda share, word: None
        self.scene, self.tables = loaded(scene)
        camera = self.scene.camera
        self.pixels, self.looked_at = camera.width * camera.height, PIXELS
        self.named = [
            (str(spec.table), table)
            for spec, table in zip((g for m in scene.media for g in m.grains), self.tables, strict=True)
            if not isinstance(spec.table, Table)
        ]
        self.bodies: list[prior.Body] = []
        self.expected: dict[str, prior.Expected] = {}
        self.footprint, self.coverage, self.ratio, self.far = math.inf, 0.0, 1.0, False  # see `prior.looks`
        self.chance = 0.0  # kurtosis of lights that single grains meet by chance
        self.notes: list[str] = []
        self.budget = max(SECONDS, min(SHARE * self.limit, MOST_SECONDS)) if self.said else SECONDS
        self.spp: int | None = None
        self.spent, self.load, self.began = 0.0, 1.0, time.perf_counter()
        self.places: dict[bool, Place] = {}
        self.pilots: dict[Candidate, Pilot] = {}
        self.reference: Candidate | None = None
        self.impossible: dict[str, TSDFError] = {}
        self.refused: set[Candidate] = set()  # what no world can be built of
        self.dear = False  # whether single grains cannot be piloted
        self.explicit_sample = math.inf  # [s] of one thread, where it is not piloted

    def plan(self) -> Plan:
        """Return the plan."""
        self.told(0.0, "planning")
        self.look()
        self.refer()
        for level in self.contenders():
            if self.spent > BUILDING * self.budget and len(self.pilots) > 2:
                break
            self.add(Candidate(level))
        left = max(self.budget - self.spent, LEAST_PILOTS)
        self.round(FIRST * left, list(self.pilots))
        self.round((1.0 - FIRST) * left, self.finalists())
        found = self.predictions()
        self.weigh()
        chosen = self.choose(found)
        while chosen.candidate not in self.pilots:  # none is taken unseen
            one = chosen.candidate
            if self.dear and LEVELS[one.level].traits.packed:
                if self.possible(one) is not None:
                    break
            elif self.add(one):
                self.round(CHECK * self.budget, [one])
            self.refused |= {one} - set(self.pilots)
            found = self.predictions()
            chosen = self.choose(found)
        rest = sorted((p for p in found if p is not chosen), key=lambda p: (p.safe_seconds(self.target), p.floor.value))
        far = bool(chosen.candidate.explicit_grains) and self.far
        thin = all(medium.packing_fraction <= MOST_PACKED for medium in self.scene.media)
        lacking = needs.of_tables(self.named, self.target, chosen.candidate.level, thin)
        beyond = self.spp is None and math.isfinite(self.limit) and not (
            chosen.seconds(self.target) <= self.limit / self.load
        )  # fmt: skip
        made = Plan(
            self.asked, self.target, self.limit if self.said or beyond else None, (chosen, *rest), far, (),
            tuple(lacking), tuple(self.notes), self.spent, time.perf_counter() - self.began, self.threads, self.load,
            self.spp,
        )  # fmt: skip
        return replace(made, why=why(made, self.bodies, self.footprint, self.coverage, str(self.reference)))

    # ------------------------------------------------------------------------------------------ what is there

    def look(self) -> None:
        """See how large grains look and what is expected of the levels."""
        began = time.process_time()
        world = build(self.scene, "volume", leap=0.0, places=self.places)
        self.bodies = prior.bodies(world, self.tables)
        self.footprint, self.coverage, self.ratio = prior.looks(world)
        self.far = self.ratio > FEWER
        self.chance = kurtosis_of(world.lights) if world.lights.sampled and self.bodies else 0.0
        self.expected = {level: self.foreseen(level) for level in LEVELS}
        if not all(one.known for one in self.expected.values()):
            self.notes.append(
                "the scene lies outside the atlas of level errors: what no pilot has seen is known within a factor of "
                f"{math.exp(2.0 * prior.SPREAD):.0f} only"
            )
        self.spent += time.process_time() - began

    def foreseen(self, level: str) -> prior.Expected:
        """Return what is expected of a level, of the medium of which most is."""
        if not self.bodies or not self.coverage:
            return prior.Expected(0.0, 0.0, 0.0, True)
        each = [prior.expected(level, body, self.footprint, self.coverage) for body in self.bodies]
        return max(each, key=lambda one: one.floor)

    def met(self) -> float:
        """Return about how many explicit grains a sample meets."""
        events = 0.0
        at = 0
        for medium, body in zip(self.scene.media, self.bodies, strict=True):
            own = self.tables[at : at + len(medium.grains)]
            at += len(own)
            path = free_path([Component(t, g.fraction) for g, t in zip(medium.grains, own, strict=True)], body[0])
            met = 2.0 * body.thickness * path.sigma_t
            events = max(events, min(met, 1.0 / max(1.0 - body.albedo, 1e-12)))
        return self.coverage * events

    def possible(self, candidate: Candidate) -> World | None:
        """Return the world of a candidate; None where there is none, which is kept in mind."""
        if candidate.level in self.impossible:
            return None
        try:
            scene = taken(self.scene, candidate)
            scene = replace(scene, render=replace(scene.render, fewer_far=self.far and candidate.explicit_grains > 0))
            return build(scene, candidate.level, progress=self.told, places=self.places)
        except (SceneError, UsageError) as error:
            if not candidate.explicit_grains:
                self.impossible[candidate.level] = error
            return None

    def add(self, candidate: Candidate) -> bool:
        """Make a candidate ready for pilots, if it is possible; kernels are compiled outside the time."""
        self.told(0.0, f"building {candidate}")
        began = time.process_time()
        world = self.possible(candidate)
        self.spent += time.process_time() - began
        if world is None:
            return False
        self.pilots[candidate] = Pilot(world, self.seed, self.threads, self.looked_at)
        self.pilots[candidate].warm()
        return True

    def refer(self) -> None:
        """Find what stands for the truth: the best level that can be piloted."""
        facets = any(table.header["grain"]["kind"] != "sphere" for table in self.tables)
        each = self.met() * EVENT_S[facets]
        able = TURN * self.budget * self.threads / max(HALVES * each, 1e-12)  # pixels
        self.looked_at = int(min(max(able, FEWEST), PIXELS))
        self.dear = able < TURN * FEWEST and bool(self.bodies)
        for level in LEVELS:
            if LEVELS[level].traits.packed and self.dear:
                if level == "explicit":
                    self.notes.append(
                        f"light meets {self.met():.2g} grains on its way, so that level explicit cannot be piloted in "
                        f"{self.budget:.0f} s: what others are held against is what is expected of them"
                    )
                    self.explicit_sample = each
                continue
            if self.add(Candidate(level)):
                self.reference = Candidate(level)
                break
        if self.reference is None:
            raise next(iter(self.impossible.values()))
        if self.reference.level != "explicit" and "explicit" in self.impossible:
            self.notes.append(f"no level explicit here, {self.reference} stands for it: {self.impossible['explicit']}")

    def contenders(self) -> list[str]:
        """Return levels that may meet the target, those first of which most is expected."""
        order = ("teleport-memory", "volume", "teleport-packed", "teleport", "teleport-joint", "volume-hg", "isotropic")
        deep = any(body.thickness > LEAPS * body.transport for body in self.bodies)
        found: list[str] = []
        for level in order if self.bodies else ():
            one = self.expected[level]
            reach = one.floor * math.exp(-OUT * one.spread)
            chain = LEVELS[level].traits.chains  # with explicit grains first its texture goes
            if Candidate(level) not in self.pilots and (chain or reach < self.target or not deep):
                found.append(level)
        if "teleport-memory" in found and all(table.memory for table in self.tables):
            found = [level for level in found if level not in ("teleport-joint",)]
        return found

    # ------------------------------------------------------------------------------------------------ rounds

    def round(self, seconds: float, some: list[Candidate]) -> None:
        """Pilot some candidates for about so long in all [s]."""
        rest = [one for one in some if one != self.reference]
        assert self.reference is not None
        own = seconds * (OF_REFERENCE if rest else 1.0)
        for number, one in enumerate([self.reference, *rest]):
            self.told(0.0, f"piloting {one}")
            pilot = self.pilots[one]
            before = pilot.busy
            pilot.run(own if not number else (seconds - own) / len(rest))
            self.spent += (pilot.busy - before) / self.threads

    def weigh(self) -> None:
        """See how much longer things take than they would if processors had nothing else to do."""
        busy = sum(pilot.busy for pilot in self.pilots.values()) / self.threads
        self.load = max(1.0, sum(pilot.wall for pilot in self.pilots.values()) / max(busy, 1e-9))
        if self.load > BUSY:
            self.notes.append(
                f"processors are busy with other things: now everything takes {self.load:.1f} times as long"
            )
        assert self.reference is not None
        if not any(pilot.seen.mean > 0.0 for pilot in self.pilots.values()):
            self.notes.append("no pilot has seen any light: nothing is known of noise, and errors are expected ones")
        elif any(map(self.hidden, candidates(tuple(LEVELS), GRAINS))):
            self.notes.append(
                "single grains meet suns and small bright lights by chance alone, too seldom for pilots: what they "
                "take is not known, and they are left out for levels that aim at lights, whose errors are what is "
                "expected of slabs; a wider sun brings them back"
            )

    def finalists(self) -> list[Candidate]:
        """Return the candidates that may be the best, of which pilots are worth their time."""
        found = self.predictions()
        best = min(p.safe_seconds(self.target) for p in found)
        may = sorted((p for p in found if self.hopeful(p) <= NEAR * best), key=self.hopeful)
        first = []
        for p in may[:MOST_FINALISTS]:
            if p.candidate in self.pilots or (self.spent < LATEST * self.budget and self.add(p.candidate)):
                first.append(p.candidate)
        return first

    def hopeful(self, p: Prediction) -> float:
        """Return the time to the target [s] if the floor is as low as it may well be."""
        return p.seconds(self.target, max(p.floor.value - 1.5 * p.floor.error, 0.0))

    # ------------------------------------------------------------------------------------------- predictions

    def predictions(self) -> list[Prediction]:
        """Return what is predicted of every candidate that is possible."""
        return [
            self.predicted(one)
            for one in candidates(tuple(LEVELS), GRAINS)
            if one.level not in self.impossible
            and one not in self.refused
            and not (one.explicit_grains and "explicit" in self.impossible)
        ]

    def trusted(self, pilot: Pilot) -> bool:
        """Return whether a pilot has seen light, and met what only chance finds of it often enough to be believed."""
        if not pilot.seen.mean > 0.0:
            return False
        return not (self.chance and pilot.world.media.singles) or self.often(pilot)

    def often(self, pilot: Pilot) -> bool:
        """Return whether so many samples as a pilot has are enough for lights that are met by chance alone."""
        return not self.chance or pilot.seen.samples * self.coverage / self.chance > MEETINGS

    def hidden(self, candidate: Candidate) -> bool:
        """Return whether a candidate's single grains meet lights too seldom for its variance to be known: by the pilot
        of the reference, if that has single grains, or else by its own or one of as many samples as the reference's."""
        assert self.reference is not None
        if not _singly(candidate):
            return False
        best = self.pilots[self.reference]
        return not self.often(best if _singly(self.reference) else self.pilots.get(candidate, best))

    def apart(self, candidate: Candidate) -> Apart | None:
        """Return how a candidate differs from the reference as far as that is known."""
        assert self.reference is not None
        own, other = self.pilots.get(candidate), self.pilots[self.reference]
        if own is None or own is other or not own.each or not other.each:
            return None
        if not self.trusted(own) or not self.trusted(other):
            return None
        return own.apart(other)

    def predicted(self, candidate: Candidate) -> Prediction:
        """Return what is predicted of a candidate."""
        level, k = candidate.level, candidate.explicit_grains
        plain = Candidate(level)
        one = self.expected[level]
        bias, bias_error, floor, known = self.without(plain, one)
        base = 0
        for fewer in GRAINS[1:]:  # what is seen of fewer explicit grains says more of this number than none does
            if fewer <= k and (later := self.apart(Candidate(level, fewer))) is not None:
                floor = self.faded(floor, bias, bias_error, base, fewer)
                floor = beliefs.of_square(max(floor.value, LEAST), UNSURE, later.square, later.square_error)
                bias, bias_error = beliefs.of_bias(max(abs(bias), bias_error), later.bias, later.bias_error)
                base, known = fewer, True
        floor = self.faded(floor, bias, bias_error, base, k)
        floor = self.beside_the_reference(candidate, floor)
        texture, most = (math.sqrt(max(value**2 - bias**2, 0.0)) for value in (floor.value, floor.high))
        seen, piloted = self.cost(candidate)
        turn = seen.seconds * self.pixels / self.threads
        return Prediction(
            candidate, bias, bias_error, texture, most - texture, floor, seen.variance, turn, piloted, known,
        )  # fmt: skip

    def without(self, plain: Candidate, one: prior.Expected) -> tuple[float, float, Belief, bool]:
        """Return bias, its error and the floor of a candidate without explicit grains, and whether these are known."""
        apart, spread = self.apart(plain), max(one.spread, 1e-9)
        if apart is None and plain.level == "teleport-joint":
            apart, spread = self.apart(Candidate("teleport")), spread + ALIKE
        bias, bias_error = beliefs.of_bias(one.bias, apart and apart.bias, apart.bias_error if apart else math.inf)
        square, error = (apart.square, apart.square_error) if apart else (None, math.inf)
        size = one.floor
        if (missed := self.missed(plain)) is not None and size:
            size = math.hypot(missed.value, math.hypot(one.bias, 0.5 * one.bias))
            spread = max(math.log1p(missed.error / missed.value), ALIKE) if one.bias < missed.value else spread
        floor = beliefs.of_square(size, spread, square, error)
        if missed is not None and size:  # both are held against the same samples of the reference
            floor = floor._replace(error=max(floor.error, missed.error))
        return bias, bias_error, floor, one.known or apart is not None

    def missed(self, plain: Candidate) -> Belief | None:
        """Return the texture that all levels without single grains miss alike, by the pilot that knows it best; None
        for that, and for levels that have some of it."""
        alike = [c for c in self.pilots if not c.explicit_grains and not LEVELS[c.level].traits.packed]
        seen = {c: apart for c in alike if (apart := self.apart(c)) is not None}
        if not seen or LEVELS[plain.level].traits.packed:
            return None
        # by the error of texture squared, not by its value: the least of several values is too small
        best = min(seen, key=lambda c: math.hypot(seen[c].square_error, 2.0 * seen[c].bias * seen[c].bias_error))
        if best == plain:
            return None
        apart, one = seen[best], self.expected[best.level]
        floor = beliefs.of_square(one.floor, max(one.spread, 1e-9), apart.square, apart.square_error)
        off = min(abs(apart.bias), 0.9 * floor.value)
        texture = max(math.sqrt(floor.value**2 - off**2), LEAST)
        return Belief(texture, math.hypot(floor.value * floor.error, off * apart.bias_error) / texture)

    def beside_the_reference(self, candidate: Candidate, floor: Belief) -> Belief:
        """Return a floor with what the reference itself may be off by, where that is not level explicit."""
        assert self.reference is not None
        if self.reference.level == "explicit" or candidate.level == "explicit":
            return floor
        own = self.expected[self.reference.level]
        off = beliefs.of_square(own.floor, max(own.spread, 1e-9))
        if candidate.level == self.reference.level:
            return off
        return Belief(math.hypot(floor.value, off.value), math.hypot(floor.error, off.error))

    def faded(self, floor: Belief, bias: float, bias_error: float, before: int, k: int) -> Belief:
        """Return what is left of a floor with k explicit grains, of one with fewer: its texture falls, its bias does
        not. Where the first of them go by pixel, all pixels come to what the one is left with that has most."""
        if k == before:
            return floor
        off = math.hypot(bias, bias_error)
        left = math.exp((before - k) / min(self.per_e, self.length))
        if self.far and not before:
            left = min(1.0, self.ratio * left)
        texture = math.sqrt(max(floor.value**2 - off**2, 0.0)) * left
        value = math.hypot(texture, min(off, floor.value))
        return Belief(value, math.hypot(math.hypot(floor.error * left, FADING * texture), 0.5 * min(bias_error, value)))

    @property
    def per_e(self) -> float:
        """How many grains bring texture down by e: spheres 4 (docs/hybrid.md), facets as many as forget a direction."""
        forget = [max(LEAST_PER_E, 1.0 / max(1.0 - body.mean_cosine, 1e-9)) for body in self.bodies if not body.round]
        return min([PER_E, *forget])

    @property
    def length(self) -> float:
        """How many grains light meets that meets any, by the reference: with fewer still to come less can be missed."""
        assert self.reference is not None
        return max(self.pilots[self.reference].seen.events / max(self.coverage, 1e-9), 1.0)

    def cost(self, candidate: Candidate) -> tuple[Seen, bool]:
        """Return variance and time of a sample, by its pilot or from those of others, and whether it was the former."""
        own = self.pilots.get(candidate)
        assert self.reference is not None
        best = self.of_reference(self.pilots[self.reference])
        if self.hidden(candidate):
            seen = self.of_reference(own) if own is not None and own.each else best
            return seen._replace(variance=math.inf), own is not None
        if own is not None and own.each:
            return self.with_suns(own), True
        level, k = candidate.level, candidate.explicit_grains
        if level == "explicit":
            return best._replace(seconds=self.explicit_sample), False
        plain = self.pilots.get(Candidate(level))
        near = next((self.pilots[Candidate(o)] for o in ("teleport-memory", "teleport", "volume")
                     if Candidate(o) in self.pilots), None)  # fmt: skip
        chain = self.of_reference(plain or near or self.pilots[self.reference])
        if not k:
            return chain, False
        share = 1.0 - math.exp(-k * self.coverage / chain.events) if chain.events else 0.0
        mixed = {
            name: (1.0 - share) * getattr(chain, name) + share * getattr(best, name) for name in ("variance", "seconds")
        }
        return chain._replace(**mixed), False

    def of_reference(self, pilot: Pilot) -> Seen:
        """Return what a pilot saw, its variance over the mean of the reference squared, where that is to be believed:
        errors are over the mean of the true picture, not of one that is too bright."""
        assert self.reference is not None
        seen, best = pilot.seen, self.pilots[self.reference]
        if not (seen.mean > 0.0 and self.trusted(best)):
            return seen
        return seen._replace(variance=seen.variance * (seen.mean / best.seen.mean) ** 2)

    def with_suns(self, pilot: Pilot) -> Seen:
        """Return what a pilot saw; its variance is not less than lights that it has hardly met will make it."""
        seen = self.of_reference(pilot)
        if self.trusted(pilot):
            return seen
        return seen._replace(variance=max(seen.variance, 0.1 * self.coverage * self.chance))

    # ---------------------------------------------------------------------------------------------- the choice

    def choose(self, found: list[Prediction]) -> Prediction:
        """Return the cheapest that is sure enough to meet the target; if there is a time and none does, the one with
        the least error in it. None is taken of whose noise nothing is known, unless nothing is of any."""
        found = [p for p in found if math.isfinite(p.variance)] or found
        if self.spp is not None:
            fit = [p for p in found if p.floor.high < self.target]
            return min(fit, key=lambda p: p.turn) if fit else min(found, key=lambda p: p.floor.high)
        best = min(found, key=lambda p: p.safe_seconds(self.target))
        takes = best.safe_seconds(self.target)
        limit = self.limit / self.load
        if not takes <= limit and math.isfinite(limit):
            return min(found, key=lambda p: math.hypot(p.floor.high, p.noise(limit)))
        if math.isinf(takes):
            return min(found, key=lambda p: p.floor.high)
        alike = [p for p in found if p.safe_seconds(self.target) <= TIE * takes]
        return min(alike, key=lambda p: p.floor.high)


def _singly(candidate: Candidate) -> bool:
    """Return whether a candidate meets single grains, whose light is met by chance."""
    return candidate.explicit_grains > 0 or LEVELS[candidate.level].traits.packed


def loaded(scene: Scene) -> tuple[Scene, list[Table]]:
    """Return a scene that holds its tables, so that they are read once, and these."""
    media, tables = [], []
    for medium in scene.media:
        grains = []
        for grain in medium.grains:
            if isinstance(grain.table, Table):
                table, mesh = grain.table, grain.mesh
            else:
                table = tsdf_format.read(grain.table)
                mesh = grain.mesh or mesh_beside(table, [grain.table.parent])
            tables.append(table)
            grains.append(replace(grain, table=table, mesh=mesh))
        media.append(replace(medium, grains=tuple(grains)))
    return replace(scene, media=tuple(media)), tables
