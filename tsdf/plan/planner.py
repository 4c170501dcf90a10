"""The planner: predicts what each way to render a scene costs and gets wrong; takes the cheapest that is good enough.

What is expected of a scene is `prior`, what short renders of it show is `pilot`, what both say of a candidate is
`evidence`. Here is what is looked at in which order, for how long, and what is taken in the end.
"""

import math
import os
from collections.abc import Callable
from dataclasses import replace
from threading import Event

from tsdf.data.table import Table
from tsdf.errors import SceneError, UsageError
from tsdf.picture.trust import kurtosis_of
from tsdf.picture.world import World, build, check_sight
from tsdf.plan import asking, needs, prior
from tsdf.plan.choice import Wish, choose
from tsdf.plan.evidence import BOLD, BOLD_BIAS, GRAINS, MEETINGS, Evidence
from tsdf.plan.pilot import CLOCKS, FEWEST, HALVES, MORE, PIXELS, Clocks, Pilot
from tsdf.plan.prediction import Plan, Prediction
from tsdf.plan.report import BUSY, digits, why, wider_sun
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, free_path
from tsdf.scene.scene import Scene, called
from tsdf.scene.specs import SunLight
from tsdf.spheres.packing import MAX as MOST_PACKED
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.walk.explicit import Packed
from tsdf.walk.geometry import Place, place

TARGET = 0.02  # [1] where nothing else is asked for
LEAST_TARGET, MOST_TARGET = 1e-4, 1.0
SECONDS, SHARE, MOST_SECONDS = 5.0, 0.1, 20.0  # [s] of worlds and pilots; or this share of the render, up to so much
MOST_SHARE = 1.0 / 3.0  # of a render that is said to take so long, that planning takes, by the clock
LEAST_PILOTS = 2.0  # [s] for pilots, however long worlds take to build
BUILDING = 0.4  # of the time, after which no more worlds are built that may want records for leaps
TURN = 0.05  # of the time, that a sample of each pixel of the reference may take
FIRST, OF_REFERENCE = 0.35, 0.4  # shares of the time for the first round, and of a round for the reference
BEGUN = 0.02  # of the time, for how long the reference takes
OF_CHAIN = 0.1  # of the time, that one with a few explicit grains is likely to get
OUT = 2.0  # spreads below what is expected that an error must be within reach of what is asked for
LEAPS = 2.0  # [l*] of thickness from which on records for leaps may have to be made, a second each
MOST_FINALISTS = 4
LATEST = 0.7  # of the time, after which nothing more is made ready for the second round
CHECK = 0.15  # of what is left for pilots, for looks at what is chosen and was not seen
BRIEF, MOST_CHECKS = 0.3, 3  # [s] that such a look takes at least, and how many there are at most
WIDE, WIDEST = 2.0, 50.0  # [deg] of suns in pilots that are smaller in the picture, which single grains would hardly
# ever meet, at least and at most
ENOUGH_MORE = 1.5  # times as many samples as there are, that tell more
AGAIN = 1.3  # times as long as these are likely to take, that they may
FOREVER = 1e9  # [s] that something takes which never comes to an end
LESS = 0.95  # of an error bar that more samples have to leave, or there is no use in them
RUNG = 1.4  # times as wide as the next narrower one that pilots may look at
TAILED = 1.5  # times what noise makes of it, that the error bar of what is missed is where few pixels make most of it
SOON = 0.5  # of `MEETINGS`, after the first round, that there will be enough of after the second
ENOUGH = 4.0  # times `MEETINGS` that they are to be met in the time that the reference has
NEAR = 3.0  # times as long as the best as a candidate may seem to take to be looked at again
EVENT_S = (1.0e-6, 5.0e-6)  # [s] of one explicit grain, an exact sphere and one of facets, about
PATIENCE = 600.0  # [s] that a picture may take where nothing is said
FEWER = 1.3  # times as large as they look in the middle, grains must look somewhere for their number to go by pixel


def planning_seconds(seconds: float | None) -> float:
    """Return for how long is planned [s] for a picture that may take so long: a tenth of it, but 5 s where that is
    less, and a third at most; of processors that have nothing else to do."""
    if seconds is None or math.isinf(seconds):
        return SECONDS
    return min(max(SECONDS, min(SHARE * seconds, MOST_SECONDS)), MOST_SHARE * seconds)


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
    threads: int | None = None, told: Callable[[float, str], None] | None = None, stop: Event | None = None,
    clocks: Clocks | None = None, together: bool = False,
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
        Called with the share done and a word about it; the share is above 0 from when something is known.
    stop : Event, optional
        Set by others to end early; the plan is then what is known so far.
    clocks : Clocks, optional
        What time is read from; others than the machine's make plans that can be made again to the last bit.
    together : bool
        Whether `seconds` are for planning and picture together, and not for the picture alone.

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
    run.spp, run.clocks, run.stop = spp, clocks or CLOCKS, stop or Event()
    run.told = told or (lambda share, word: None)
    if together:
        run.limit -= planning_seconds(seconds)
    return run.plan()


class _Planning(Evidence):
    """What is common to one plan, as far as it has come."""

    def __init__(self, scene: Scene, target: float, seconds: float | None, seed: int, threads: int) -> None:
        super().__init__(scene.camera.width * scene.camera.height, threads)
        self.asked, self.target, self.seed = scene, target, seed
        self.limit = self.whole = PATIENCE if seconds is None else seconds
        self.said = seconds is not None and math.isfinite(seconds)  # whether that long is meant, and not at most
        self.told: Callable[[float, str], None] = lambda share, word: None
        self.scene, self.tables = needs.loaded(scene)  # as pilots see it
        self.looked_at, self.wider = PIXELS, False
        self.named = [
            (str(spec.table), table)
            for spec, table in zip((g for m in scene.media for g in m.grains), self.tables, strict=True)
            if not isinstance(spec.table, Table)
        ]
        self.notes: list[str] = []
        self.budget = planning_seconds(seconds)
        self.spp: int | None = None
        self.clocks, self.stop = CLOCKS, Event()
        self.spent, self.load, self.known = 0.0, 1.0, 0.0
        self.began, self.compiling = 0.0, 0.0  # [s] by the clock
        self.ends = self.budget  # of the time that is spent
        self.places: dict[bool, Place] = {}
        self.packings: dict[bool, Packed] = {}
        self.wide = WIDE  # [deg] of suns in pilots, at least
        self.real = 0.0  # `chance` of the suns of the picture
        self.answered: set[Candidate] = set()  # of which more samples would tell no more
        self.dear = False  # whether single grains cannot be piloted

    def plan(self) -> Plan:
        """Return the plan."""
        self.began = self.clocks.wall()
        self.told(0.0, "planning")
        self.look()
        self.refer()
        for level in self.contenders():
            if self.deep and self.spent > BUILDING * self.budget and len(self.pilots) > 2:
                break
            self.add(Candidate(level))
        self.look_deeper()
        left = max(self.budget - self.spent, min(LEAST_PILOTS, LEAST_PILOTS / SECONDS * self.budget))
        self.ends = self.spent + left
        self.round(FIRST * left, list(self.pilots))
        self.known = FIRST
        self.refer_anew(SOON)
        glints = self.look_wider()
        self.round((1.0 - FIRST - CHECK) * left, list(dict.fromkeys((*self.finalists(), *glints))))
        self.known = 1.0 - CHECK
        self.refer_anew()
        chosen, found, regional = self.settled()
        self.weigh()
        rest = sorted((p for p in found if p is not chosen), key=lambda p: (p.safe_seconds(self.target), p.floor.value))
        far = bool(chosen.candidate.explicit_grains) and self.far
        thin = all(medium.packing_fraction <= MOST_PACKED for medium in self.scene.media)
        lacking = needs.of_tables(self.named, self.target, chosen.candidate.level, thin)
        beyond = self.spp is None and math.isfinite(self.limit) and not (
            chosen.done(self.target) <= self.limit / self.load
        )  # fmt: skip
        made = Plan(
            self.asked, self.target, self.limit if self.said or beyond else None, (chosen, *rest), far, (),
            tuple(lacking), tuple(self.notes), self.spent, self.clocks.wall() - self.began, self.compiling,
            self.threads, self.load, self.spp, self.load * self.wish.glints(chosen, rest) if beyond else 0.0,
            2.0 / max(self.footprint, 1e-6), regional, (self.narrowest, self.wide), self.rarer, self.places,
            self.packings,
        )  # fmt: skip
        lines = why(made, self.bodies, self.footprint, self.coverage, str(self.reference))
        return replace(made, why=lines, notes=(*made.notes, *filter(None, [wider_sun(made)])))

    def settled(self) -> tuple[Prediction, list[Prediction], bool]:
        """Return what is chosen, which a pilot has seen where one can, all predictions, and whether the choice is by
        the error of regions."""
        self.see_to_it()
        while (asked := self.question()) is not None:
            self.go_on(*asked)
        self.see_to_it()
        found = self.predictions()
        seen = [
            p for p in found if p.candidate in self.pilots or (self.dear and LEVELS[p.candidate.level].traits.packed)
        ]
        chosen, regional = choose(seen or found, self.wish)
        if not self.stopped() and (bold := self.bolder_of(chosen)) is not None and self.add(bold):
            self.round(max(self.ends - self.spent, BRIEF), [chosen.candidate, bold], 0.0)
            found = self.predictions()
            plain, bolder = (next(p for p in found if p.candidate == one) for one in (chosen.candidate, bold))
            chosen = bolder if bolder.safe_seconds(self.target) < plain.safe_seconds(self.target) else plain
        return chosen, found, regional

    def see_to_it(self) -> None:
        """Pilot what is chosen, as far as it was not."""
        for looks in range(MOST_CHECKS):
            self.load = self.seen_load
            one = self.choose(self.predictions()).candidate
            if one in self.pilots or (looks and self.spent > self.ends + BRIEF) or self.stopped():
                break
            if self.dear and LEVELS[one.level].traits.packed:
                if self.possible(one) is not None:
                    break
            elif self.add(one):
                self.round(max(0.5 * (self.ends - self.spent), BRIEF), [one])
            self.refused |= {one} - set(self.pilots)

    def question(self) -> tuple[Candidate, float] | None:
        """Return what is to be piloted on, for what that may save, and for how long at most [s]; None once all is told,
        or planning has taken its share of what the chosen takes."""
        if self.spp is not None or self.stopped():
            return None
        found = self.predictions()
        chosen = self.choose(found)
        takes = min(chosen.done(self.target), self.limit / self.load, FOREVER)
        saved = {
            p.candidate: asking.saved(p, self.target, takes, p.candidate == chosen.candidate)
            for p in found
            if not (self.dear and p.candidate.single)
            and not {p.candidate, self.teller(p.candidate)} & {*self.answered, self.reference}
        }
        one = max(saved, key=lambda c: saved[c], default=chosen.candidate)
        left = self.ends - self.spent
        if saved.get(one, 0.0) > BRIEF and takes < FOREVER and not self.said:
            left = max(left, min(SHARE * takes, MOST_SECONDS) - self.spent)
        return (self.teller(one), left) if saved.get(one, 0.0) > 0.0 and left >= BRIEF else None

    def teller(self, one: Candidate) -> Candidate:
        """Return whose pilot tells most of what a candidate misses: of chains after as many explicit grains, which all
        miss the same, the one that has most samples; or itself."""
        alike = [c for c in self.pilots if c.explicit_grains == one.explicit_grains > 0 and c.leap is None]
        return max(alike, key=lambda c: self.pilots[c].each, default=one)

    def go_on(self, one: Candidate, seconds: float) -> None:
        """Take about as many samples again of a candidate and of what it is held against, as many of both, for so long
        at most [s]. It is answered where that does not tell more."""
        assert self.reference is not None
        if one not in self.pilots and not self.add(one):
            self.refused |= {one}
            return
        own, best, seen = self.pilots[one], self.pilots[self.reference], self.apart(one)
        most = max(own.done, best.done) if own.active == best.active else 0
        goals = [1 << math.ceil(math.log2(ENOUGH_MORE * max(most, p.done, 1))) for p in (own, best)]
        wanted = [p.seconds_to(goal) for p, goal in zip((own, best), goals, strict=True)]
        if AGAIN * sum(wanted) > seconds and own.done < most:  # as many as the other has will have to do
            wanted = [own.seconds_to(most), 0.0]
        of_reference = wanted[1] / max(sum(wanted), 1e-9)
        before = self.spent
        self.round(min(AGAIN * sum(wanted), seconds), [one], of_reference)
        now = self.apart(one)
        if self.spent == before or (seen and now and now.square_error > LESS * seen.square_error):
            self.answered |= {one}

    def bolder_of(self, chosen: Prediction) -> Candidate | None:
        """Return a candidate with bolder leaps, where they may win and its error would still do: at the level whose
        events are dear (docs/plan.md), in media that are deep enough for leaps at all."""
        own = self.pilots.get(chosen.candidate)
        if own is None or not own.world.leap > BOLD or self.scene.render.leap is not None:
            return None
        if not LEVELS[chosen.candidate.level].traits.remembers:
            return None
        if not math.hypot(chosen.floor.high, BOLD_BIAS) < self.target:
            return None
        return chosen.candidate._replace(leap=BOLD)

    # ------------------------------------------------------------------------------------------ what is there

    def look(self) -> None:
        """See how large grains look and what is expected of the levels."""
        began = self.clocks.process()
        if all(medium.inside == "grains" for medium in self.scene.media):
            self.places = dict.fromkeys((False, True), place(self.scene, grains=True))  # one for all levels
        world = build(self.scene, "volume", leap=0.0, places=self.places)
        check_sight(world)
        if world.empty:
            self.refuse(world)
        self.bodies = prior.bodies(world, self.tables)
        self.footprint, self.coverage, self.ratio = prior.looks(world)
        self.far = self.ratio > FEWER
        if world.lights.sampled and self.bodies:
            self.real = self.chance = kurtosis_of(world.lights)
            self.atoms = max(float(table.p_theta[0] + table.p_theta[-1]) for table in self.tables)
            self.widen(self.sample())
        self.expected = {level: self.foreseen(level) for level in LEVELS}
        if not all(one.known for one in self.expected.values()):
            self.notes.append(
                "the scene lies outside the atlas of level errors: what no pilot has seen is known within a factor of "
                f"{math.exp(2.0 * prior.SPREAD):.0f} only"
            )
        self.spent += self.clocks.process() - began

    def refuse(self, world: World) -> None:
        """Leave out levels of single grains, where none fits into a medium: their picture would be empty there."""
        medium = world.scene.media[world.empty[0] - 1]
        error = SceneError(
            f"{world.scene.name}: {called('medium', world.empty[0], medium.name)}: no grain of diameter "
            f"{2.0 * medium.radius:g} fits into it, so that single grains are not there and a picture of them is empty"
        )
        self.impossible |= {name: error for name, one in LEVELS.items() if one.traits.packed or one.traits.remembers}

    def widen(self, sample: float, measured: bool = False) -> bool:
        """Have pilots look at suns that single grains meet often enough to tell what other levels miss, where a sample
        takes one thread so long [s]; return whether that changes any. Only what is measured makes them narrower."""
        samples = OF_REFERENCE * self.budget * self.threads / max(sample, 1e-9)
        share = ENOUGH * MEETINGS / max(samples * self.coverage, 1e-9)  # of the sphere
        wide = max(WIDE, math.degrees(4.0 * math.asin(math.sqrt(min(share, 1.0)))))
        # by steps, so that one scene is planned alike however fast processors are just now
        wide = min(WIDE * RUNG ** math.ceil(math.log(wide / WIDE, RUNG) - 1e-9), WIDEST)
        lights = tuple(
            replace(light, angular_diameter_deg=wide)
            if isinstance(light, SunLight) and light.angular_diameter_deg < wide
            else light
            for light in self.asked.lights
        )
        if lights == self.scene.lights or (wide < self.wide and not measured):
            return False
        self.wide, self.scene = wide, replace(self.scene, lights=lights)
        self.chance = kurtosis_of(build(self.scene, "volume", leap=0.0, places=self.places).lights)
        self.rarer = max(self.real / self.chance, 1.0)
        return True

    @property
    def narrowest(self) -> float:
        """How wide the smallest sun of the scene is [deg]."""
        suns = [light.angular_diameter_deg for light in self.asked.lights if isinstance(light, SunLight)]
        return min(suns, default=math.inf)

    def foreseen(self, level: str) -> prior.Expected:
        """Return what is expected of a level, of the medium of which most is."""
        if not self.bodies or not self.coverage:
            return prior.Expected(0.0, 0.0, 0.0, True)
        each = [prior.expected(level, body, self.footprint, self.coverage) for body in self.bodies]
        most = max(each, key=lambda one: one.floor)
        return most._replace(texture=math.sqrt(self.sparkle) * most.texture)

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

    def sample(self) -> float:
        """Return about what a sample of level explicit takes of one thread [s]."""
        return self.met() * EVENT_S[any(table.header["grain"]["kind"] != "sphere" for table in self.tables)]

    def possible(self, candidate: Candidate) -> World | None:
        """Return the world of a candidate; None where there is none, which is kept in mind."""
        if candidate.level in self.impossible:
            return None
        try:
            scene = taken(self.scene, candidate)
            scene = replace(scene, render=replace(scene.render, fewer_far=self.far and candidate.explicit_grains > 0))
            return build(
                scene,
                candidate.level,
                progress=self.building,
                places=self.places,
                packings=self.packings,
            )
        except (SceneError, UsageError) as error:
            if not candidate.explicit_grains:
                self.impossible[candidate.level] = error
            return None

    def add(self, candidate: Candidate) -> bool:
        """Make a candidate ready for pilots, if it is possible; kernels are compiled outside the time."""
        self.told(self.known, f"building {candidate}")
        began = self.clocks.process()
        world = self.possible(candidate)
        self.spent += self.clocks.process() - began
        if world is None:
            return False
        pilot = self.pilots[candidate] = Pilot(world, self.seed, self.threads, self.looked_at, self.clocks)
        if self.reference is not None:
            pilot.like = self.pilots[self.reference]
        if self.wider:
            pilot.look_wider(MORE)
        began = self.clocks.wall()
        pilot.warm()
        self.compiling += self.clocks.wall() - began
        return True

    def refer(self) -> None:
        """Find what stands for the truth: the best level that can be piloted."""
        each = self.sample()
        able = TURN * self.budget * self.threads / max(HALVES * each, 1e-12)  # pixels
        self.looked_at = int(min(max(able, FEWEST), PIXELS))
        self.dear = able < TURN * FEWEST and bool(self.bodies)
        for level in LEVELS:
            if LEVELS[level].traits.packed and self.dear:
                if level == "explicit":
                    self.notes.append(
                        f"light meets {digits(self.met())} grains on its way, so that level explicit cannot be piloted "
                        f"in {self.budget:.0f} s: what others are held against is what is expected of them"
                    )
                    self.explicit_sample = each
                continue
            if self.add(Candidate(level)):
                self.reference = Candidate(level)
                break
        self.time_the_reference()
        if self.reference is None:
            raise next(iter(self.impossible.values()))
        if self.reference.level != "explicit" and "explicit" in self.impossible:
            self.notes.append(f"no level explicit here, {self.reference} stands for it: {self.impossible['explicit']}")

    def time_the_reference(self) -> None:
        """See what a sample of single grains takes, and have suns be as wide as that asks, if it is not what was
        thought: what pilots of wider ones see is carried over to the picture's by a law, and a few glints by chance."""
        if self.reference is None or not self.reference.single or not self.chance:
            return
        self.round(BEGUN * self.budget, [self.reference])
        if self.widen(self.pilots[self.reference].seen.seconds, measured=True):
            self.pilots.clear()
            self.add(self.reference)

    def refer_anew(self, share: float = 1.0) -> None:
        """Hold levels against the best that aims at lights, where the pilot of the best has met them too seldom, or
        less often than a share of that."""
        assert self.reference is not None
        best = self.pilots[self.reference]
        if self.trusted(best) or not self.chance or self.often(best, share):
            return
        aimed = [one for one in self.pilots if not one.single and self.trusted(self.pilots[one])]
        if aimed:
            self.reference = min(aimed, key=lambda one: list(LEVELS).index(one.level))

    @property
    def deep(self) -> bool:
        """Whether records for leaps may have to be made."""
        return any(body.thickness > LEAPS * body.transport for body in self.bodies)

    def contenders(self) -> list[str]:
        """Return levels that may meet the target, those first of which most is expected."""
        order = ["teleport-memory", "volume", "teleport-packed", "teleport", "teleport-joint", "volume-hg", "isotropic"]
        aim = bool(self.chance and self.atoms)  # whether what aims all of its light is to be seen before time is up
        if aim:
            order.sort(key=lambda level: level != "teleport-memory" and not LEVELS[level].traits.points)
        found: list[str] = []
        for level in order if self.bodies else ():
            one = self.expected[level]
            reach = one.floor * math.exp(-OUT * one.spread)
            chain = LEVELS[level].traits.chains  # with explicit grains first its texture goes
            wanted = chain or reach < self.target or not self.deep or (aim and LEVELS[level].traits.points)
            if Candidate(level) not in self.pilots and wanted:
                found.append(level)
        if "teleport-memory" in found and all(table.memory for table in self.tables):
            found = [level for level in found if level not in ("teleport-joint",)]
        return found

    # ------------------------------------------------------------------------------------------------ rounds

    def look_deeper(self) -> None:
        """Have the best chain be piloted with a few explicit grains first, where it is likely to need some: how fast
        what is missed falls with their number is seen better than foreseen."""
        chain = next((c for c in self.pilots if LEVELS[c.level].traits.chains), None)
        if chain is None or self.dear or self.expected[chain.level].texture < self.target:
            return
        samples = OF_CHAIN * self.budget * self.threads / max(self.sample(), 1e-9)
        if self.chance and samples * self.coverage / self.chance < MEETINGS:  # it would not be believed
            return
        self.add(chain._replace(explicit_grains=GRAINS[1]))

    def look_wider(self) -> list[Candidate]:
        """Have pilots look at more pixels, where few of those that they looked at make most of what others miss: how
        large that is so few cannot tell. Return what is to be piloted for it."""
        best = self.best_known()
        seen = self.apart(best) if best is not None and self.looked_at == PIXELS else None
        if best is None or seen is None:
            return []
        if seen.square_error < TAILED * self.sparkle * seen.noise:
            return []
        self.wider = True
        for one in {best, self.reference} | {c for c in self.pilots if c.explicit_grains}:
            if one is not None:
                self.pilots[one].look_wider(MORE)
        return [best]

    def round(self, seconds: float, some: list[Candidate], of_reference: float = OF_REFERENCE) -> None:
        """Pilot some candidates for about so long in all [s], of which the reference gets a share."""
        rest = [one for one in some if one != self.reference]
        assert self.reference is not None
        own = seconds * (of_reference if rest else 1.0)
        shares = {self.reference: own} if own else {}
        for one, share in (shares | dict.fromkeys(rest, (seconds - own) / max(len(rest), 1))).items():
            self.told(self.known, f"piloting {one}")
            pilot = self.pilots[one]
            before = pilot.busy
            pilot.run(share, self.stopped)
            self.spent += (pilot.busy - before) / self.threads

    def building(self, share: float, word: str) -> None:
        """Say what is being built."""
        self.told(self.known, word)

    def stopped(self) -> bool:
        """Return whether somebody wants the plan as it is, or the clock does, and there is one."""
        return self.known > 0.0 and (self.stop.is_set() or self.late)

    @property
    def late(self) -> bool:
        """Whether as much of the time that the picture may take has gone by on the clock as planning may have of it."""
        return self.said and self.clocks.wall() - self.began - self.compiling > MOST_SHARE * self.whole

    def weigh(self) -> None:
        """Say what is not known, and how busy processors are."""
        if self.load > BUSY:
            self.notes.append(
                f"processors are busy with other things: everything takes {self.load:.1f} times as long as without, "
                "which is in all times that are said here"
            )
        if self.known > 0.0 and self.stop.is_set():
            self.notes.append("planning was interrupted: this is what pilots had seen by then")
        elif self.late:
            self.notes.append(
                f"planning was cut short after a third of the {self.whole:.3g} s: this is what pilots had seen by then"
            )
        assert self.reference is not None
        if not any(pilot.seen.mean > 0.0 for pilot in self.pilots.values()):
            self.notes.append("no pilot has seen any light: nothing is known of noise, and errors are expected ones")
        elif any(map(self.hidden, candidates(tuple(LEVELS), GRAINS))):
            self.notes.append(
                "single grains meet suns and small bright lights by chance alone, too seldom for pilots: what they "
                "take is not known, and they are left out for levels that aim at lights, whose missing texture is what "
                "is expected; a wider sun brings them back"
            )
        elif self.rarer > 1.0:
            self.notes.append(
                f"single grains meet suns by chance alone, so pilots look at suns {self.wide:.0f} degrees wide: under "
                "smaller ones other levels miss rather more texture than is said; what candidates with single grains "
                f"take is said as {digits(self.rarer)} times what it was in pilots, and may be less"
                + "; flat facets sparkle, the more the smaller the sun, and that is in what is missed"
                * (self.sparkle > 2.0)
            )

    def finalists(self) -> list[Candidate]:
        """Return the candidates that may be the best, of which pilots are worth their time."""
        found = self.predictions()
        best = min(p.safe_seconds(self.target) for p in found)
        soon = {p.candidate: asking.hopeful(p, self.target) for p in found}
        may = sorted((p for p in found if soon[p.candidate] <= NEAR * best), key=lambda p: soon[p.candidate])
        first: list[Candidate] = []
        for p in may:
            if len(first) == MOST_FINALISTS or self.stopped():
                break
            k = p.candidate.explicit_grains
            if k and any(one.explicit_grains == k for one in first):  # what one chain misses then all do
                continue
            if p.candidate in self.pilots or (self.spent < LATEST * self.budget and self.add(p.candidate)):
                first.append(p.candidate)
        return first

    @property
    def wish(self) -> Wish:
        """What the picture is to be like."""
        return Wish(self.target, self.limit / self.load, self.spp, self.rarer > 1.0, self.dear)

    def choose(self, found: list[Prediction]) -> Prediction:
        """Return what is taken of these."""
        return choose(found, self.wish)[0]
