"""Evidence: what is expected of the candidates of a scene, what pilots saw of them, and what both together say.

Level explicit is right by definition; where it cannot be piloted, the reference is the next best that can, and what
that is expected to get wrong is added. With explicit grains first, texture and bias fade: after how many is a law
until pilots with some have been seen.
"""

import math

from tsdf.errors import TSDFError
from tsdf.picture.footprint import PER_E
from tsdf.plan import beliefs, prior
from tsdf.plan.beliefs import Belief
from tsdf.plan.pilot import Apart, Pilot, Seen
from tsdf.plan.prediction import NOTHING, Prediction, Rare
from tsdf.scene.levels import LEVELS
from tsdf.study.candidates import Candidate, candidates
from tsdf.walk.lights import LUMINANCE

GRAINS = (0, 3, 8, 16)  # explicit ones before a chain
MEETINGS = 400.0  # of lights that are met by chance alone, that a pilot is believed from on: its mean, and what others
# differ from it by, is known to a twentieth then, and the error bar of that to as much
BESIDE = 0.06  # of them, that do where paths of the reference are held beside it that are the same but for their ends
LEAST_PER_E = 2.0  # explicit grains of facets that bring texture down by e, at least
TOLD, LEAST_ALIKE = 3.0, 0.5  # standard errors from which on a candidate misses other texture than all do, and what
# of that it misses at least
ALIKE = 0.2  # of the logarithm of an error, what two levels of teleportation may differ by
REGIONAL = 1.5  # times what levels are off by in slabs, that regions of a picture differ by
DIFFERS = 0.07  # of the texture that all levels miss alike, by which they may differ and no pilot tell
LEAST = 1e-4  # [1] of an error
UNSURE = 0.8  # of the logarithm of texture, what that law may be off by for other grains than spheres
FADING = 0.3  # of the logarithm of texture, what that law may be off by; and of what is left of a bias
SLOWEST, FASTEST = 0.1, 3.0  # of the logarithm of texture, that an explicit grain may be seen to take off
SLANTED = 1.3  # times as long as a layer is thick, that light crosses it
BOUND = 0.4  # of what smaller suns add to the square of texture, that this is known to
MIRRORED = 0.2  # of a sun's radiance, that is in a glint, about
RESOLVED = 3.0  # times what noise makes of it, from which on it is asked who makes a square
USUAL = 0.15  # of a square, that a fiftieth of the pixels make, of numbers that are normal
FLAT = 0.1  # share of light that goes straight on from which on grains are flat all over
BOLD = 1.0  # [l*] least radius of leaps that are bolder than they are by default
BOLD_BIAS = 0.006  # [1] that they may be off by (docs/leaps.md)


class Evidence:
    """What is known of a scene's candidates.

    Attributes
    ----------
    expected : dict
        Of levels, before anything is rendered.
    pilots : dict
    reference : Candidate or None
        What the others are held against.
    impossible, refused : dict, set
        Levels of which there is no world, and why; candidates likewise.
    footprint, coverage, ratio : float
        How grains look, see `prior.looks`.
    far : bool
        Whether the explicit grains are to be fewer where a pixel covers more.
    chance : float
        Kurtosis of lights that single grains meet by chance, 0 where there are none.
    rarer : float
        How many times as seldom they are met in the picture as in pilots, whose suns are wider.
    atoms : float
        Share of the light that grains let go exactly straight on or send exactly back.
    explicit_sample : float
        Time of a sample at level explicit of one thread, where that is not piloted [s].
    """

    def __init__(self, pixels: int, threads: int) -> None:
        self.pixels, self.threads = pixels, threads
        self.bodies: list[prior.Body] = []
        self.expected: dict[str, prior.Expected] = {}
        self.pilots: dict[Candidate, Pilot] = {}
        self.reference: Candidate | None = None
        self.impossible: dict[str, TSDFError] = {}
        self.refused: set[Candidate] = set()
        self.footprint, self.coverage, self.ratio, self.far = math.inf, 0.0, 1.0, False
        self.chance, self.rarer, self.atoms = 0.0, 1.0, 0.0
        self.explicit_sample = math.inf

    def predictions(self) -> list[Prediction]:
        """Return what is predicted of every candidate that is possible."""
        bold = [one for one in self.pilots if one.leap is not None]
        return [
            self.predicted(one)
            for one in (*candidates(tuple(LEVELS), GRAINS), *bold)
            if one.level not in self.impossible
            and one not in self.refused
            and not (one.explicit_grains and "explicit" in self.impossible)
        ]

    @property
    def seen_load(self) -> float:
        """How many times as long pilots took as they would have if processors had nothing else to do."""
        busy = sum(pilot.busy for pilot in self.pilots.values()) / self.threads
        return max(1.0, sum(pilot.wall for pilot in self.pilots.values()) / max(busy, 1e-9))

    def trusted(self, pilot: Pilot, share: float = 1.0) -> bool:
        """Return whether a pilot has seen light, and met what only chance finds of it often enough to be believed, or a
        share of that."""
        if not pilot.seen.mean > 0.0:
            return False
        return not (self.chance and pilot.world.media.singles) or self.often(pilot, share)

    def often(self, pilot: Pilot, share: float = 1.0) -> bool:
        """Return whether a pilot has samples enough for lights that chance finds, or a share of enough."""
        return not self.chance or pilot.seen.samples * self.coverage / self.chance > share * MEETINGS

    def hidden(self, candidate: Candidate) -> bool:
        """Return whether a candidate's single grains meet lights too seldom for its variance to be known: by the pilot
        of level explicit or the reference, if that has single grains, or else by its own or one of as many samples."""
        assert self.reference is not None
        if not candidate.single:
            return False
        best = self.pilots.get(Candidate("explicit"), self.pilots[self.reference])
        return not self.often(best if best.world.media.singles else self.pilots.get(candidate, best))

    def apart(self, candidate: Candidate) -> Apart | None:
        """Return how a candidate differs from the reference as far as that is known."""
        assert self.reference is not None
        own, other = self.pilots.get(candidate), self.pilots[self.reference]
        if own is None or own is other or not own.each or not other.each:
            return None
        beside = candidate.explicit_grains > 0 and other.world.media.singles > 0  # most of their paths are the same
        if not self.trusted(own, BESIDE if beside else 1.0) or not self.trusted(other):
            return None
        met = own.seen.samples * self.coverage / self.chance if self.chance else math.inf
        seen, more = self.elsewhere(candidate, own.apart(other, met=met if beside else None)), self.sparkle
        error = seen.square_error if candidate.explicit_grains else math.hypot(seen.square_error, self.unseen())
        bound = BOUND * (more - 1.0) * max(seen.square, 0.0)  # not all of it is glints, so this is rather too much
        # which facets mirror the real sun, of those that mirror a wider one, is chance, in a picture of few most of all
        luck = math.sqrt((more - 1.0) * more**2 * seen.fourth / self.pixels)
        mean = more * seen.square  # over pictures, of which few have most: half of them have less than this over
        rare = math.hypot(1.0, luck / mean) if mean > 0.0 else 1.0
        error = math.hypot(more * error, bound, luck)
        return seen._replace(square=mean / rare, square_error=error, scale=more / rare)

    def unseen(self) -> float:
        """Return the square of texture that glints of flat facets may make which no pilot has met: one, of a facet that
        mirrors the brightest sun, as likely as it is that none of those that were looked at does."""
        assert self.reference is not None
        pilot = self.pilots[self.reference]
        suns = pilot.world.lights.sun_radiance @ LUMINANCE
        if self.atoms < FLAT or not self.chance or not len(suns) or not pilot.seen.mean > 0.0:
            return 0.0
        looked, each = int(pilot.looked.sum()), max(self.footprint**2, 1.0)  # pixels; facets in one, about
        glint = MIRRORED * float(suns.max()) / pilot.seen.mean / each
        left = max(1.0 - looked / self.pixels, 0.0)  # of the picture
        return left * glint**2 / looked * math.exp(-0.5 * looked * each * self.coverage / self.chance)

    def elsewhere(self, candidate: Candidate, seen: Apart) -> Apart:
        """Return how a candidate without explicit grains differs from the reference, with what one that looked at more
        pixels has found there: all miss the same glints."""
        assert self.reference is not None
        own, other = self.pilots[candidate], self.pilots[self.reference]
        wide = [p for c, p in self.pilots.items() if not c.explicit_grains and p is not other]
        best = max((p for p in wide if self.trusted(p)), key=lambda p: int(p.looked.sum()), default=own)
        if candidate.explicit_grains or best.looked.sum() <= own.looked.sum():
            return seen
        whole, part = best.apart(other), best.apart(other, own)
        square = seen.square + whole.square - part.square
        error, fourth = max(seen.square_error, whole.square_error), max(seen.fourth, whole.fourth)
        return seen._replace(square=square, square_error=error, few=whole.few, fourth=fourth)

    @property
    def sparkle(self) -> float:
        """How many times as much the square of texture is under the suns of the picture as under those of pilots: flat
        facets mirror a smaller sun as much more seldom as it is brighter, curved ones make a small image of any. Only
        levels of single grains have any of it that another could miss."""
        if self.reference is not None and not self.reference.single:
            return 1.0
        return 1.0 + (self.rarer - 1.0) * min(self.atoms / FLAT, 1.0)

    def predicted(self, candidate: Candidate) -> Prediction:
        """Return what is predicted of a candidate."""
        level, k = candidate.level, candidate.explicit_grains
        plain = Candidate(level)
        one = self.expected[level]
        bias, bias_error, floor, known = self.without(plain, one)
        base = 0
        for fewer in GRAINS[1:]:  # what is seen of fewer explicit grains says more of this number than none does
            later = self.apart(Candidate(level, fewer)) if fewer <= k else None
            alike = self.seen_after(fewer) if fewer <= k else None  # what other chains miss then
            if later is None and alike is None:
                continue
            before = floor.value
            bias, bias_error, floor = self.faded(one, bias, bias_error, floor, base, fewer)
            if later is not None:
                unseen = max(1.0 - later.pixels / self.pixels, 0.0) * self.luck(before, floor.value)
                error = math.hypot(later.square_error, unseen)
                floor = beliefs.of_square(max(floor.value, LEAST), UNSURE, later.square, error)
                bias, bias_error = beliefs.of_bias(max(bias_error, LEAST), later.bias, later.bias_error, bias)
            elif alike is not None:
                square = alike.square - alike.bias**2 + bias**2 + bias_error**2  # which may be of either sign
                floor = beliefs.of_square(max(floor.value, LEAST), UNSURE, square, alike.square_error)
                floor = floor._replace(error=math.hypot(floor.error, ALIKE * floor.value))
            base, known = fewer, True
        bias, bias_error, floor = self.faded(one, bias, bias_error, floor, base, k)
        if candidate.leap is not None:
            bias_error, floor = self.bolder(candidate, bias_error, floor)
        floor = self.beside_the_reference(candidate, floor)
        texture, most = (math.sqrt(max(value**2 - bias**2, 0.0)) for value in (floor.value, floor.high))
        seen, piloted, rare = self.cost(candidate)
        turn = seen.seconds * self.pixels / self.threads
        regions = 0.0 if candidate.single else self.of_regions(candidate, bias, bias_error)
        return Prediction(
            candidate, bias, bias_error, texture, most - texture, floor, seen.variance, turn, piloted, known, regions,
            rare,
        )  # fmt: skip

    def of_regions(self, candidate: Candidate, bias: float, bias_error: float) -> float:
        """Return the error of means of regions, as high as it may well be: what the level that is expected to be least
        off has of it, that is its bias, and how pilots of both differ. Neither has single grains, so this is known long
        before texture is."""
        alike = [c for c, p in self.pilots.items() if not c.single and c.leap is None and p.seen.mean > 0.0]
        nearest = min(alike, key=lambda c: self.expected[c.level].bias, default=None)  # of as much, the first
        own, one = self.pilots.get(candidate), self.expected[candidate.level]
        if nearest is None or nearest == candidate:
            return math.hypot(bias, bias_error)
        square, error = own.regions(self.pilots[nearest]) if own is not None and own.each else (None, math.inf)
        differs = beliefs.of_square(REGIONAL * one.bias, max(one.spread, 1e-9), square, error)
        seen = self.apart(nearest)
        wide = self.expected[nearest.level].bias
        own_bias, own_error = beliefs.of_bias(wide, seen and seen.bias, seen.bias_error if seen else math.inf)
        return math.hypot(own_bias, own_error, differs.high)

    def seen_after(self, k: int) -> Apart | None:
        """Return what pilots of chains with so many explicit grains first saw, by the one that knows it best: all miss
        the same texture."""
        seen = [self.apart(one) for one in self.pilots if one.explicit_grains == k and one.leap is None]
        return min((one for one in seen if one is not None), key=lambda one: one.square_error, default=None)

    def bolder(self, candidate: Candidate, bias_error: float, floor: Belief) -> tuple[float, Belief]:
        """Return the error of a bias and a floor with what bolder leaps may add, and what their pilot saw of it."""
        value = max(math.hypot(floor.value, BOLD_BIAS), LEAST)
        spread = math.log1p(max(floor.error, 0.5 * (value - floor.value)) / value)
        if (seen := self.apart(candidate)) is not None:
            return math.hypot(bias_error, BOLD_BIAS), beliefs.of_square(value, spread, seen.square, seen.square_error)
        return math.hypot(bias_error, BOLD_BIAS), Belief(value, value * math.expm1(spread))

    def without(self, plain: Candidate, one: prior.Expected) -> tuple[float, float, Belief, bool]:
        """Return bias, its error and the floor of a candidate without explicit grains, and whether these are known."""
        apart, spread = self.apart(plain), max(one.spread, 1e-9)
        if apart is None and plain.level == "teleport-joint":
            apart, spread = self.apart(Candidate("teleport")), spread + ALIKE
        wide = math.hypot(one.bias, self.of_one_packing(one))
        bias, bias_error = beliefs.of_bias(wide, apart and apart.bias, apart.bias_error if apart else math.inf)
        square, error = (apart.square, apart.square_error) if apart else (None, math.inf)
        size = one.floor
        if (missed := self.missed(plain)) is not None and size:
            size = math.hypot(missed.value, math.hypot(one.bias, 0.5 * one.bias))
            spread = max(math.log1p(missed.error / missed.value), ALIKE) if one.bias < missed.value else spread
        elif apart is None and LEVELS[plain.level].traits.packed:  # it misses a part of the same texture
            size = math.hypot(one.bias, one.texture * self.rougher())
        floor = beliefs.of_square(size, spread, square, error)
        if missed is not None and apart is not None and size:  # held against the same samples in the same pixels
            floor = self.beside_the_best(apart, missed, bias)
        elif missed is not None and size:
            floor = floor._replace(error=max(floor.error, missed.error))
        return bias, bias_error, floor, one.known or apart is not None

    def missed(self, plain: Candidate) -> Belief | None:
        """Return the texture that all levels without single grains miss alike, by the pilot that knows it best; None
        for that, and for levels that have some of it."""
        best = self.best_known()
        if best is None or best == plain or LEVELS[plain.level].traits.packed:
            return None
        return self.texture_of(best)

    def beside_the_best(self, own: Apart, missed: Belief, bias: float) -> Belief:
        """Return the floor of a candidate that misses what all do, and what it was seen to have beside that, if this is
        more than noise."""
        best = self.best_known()
        other = self.apart(best) if best is not None else None
        assert other is not None
        square = missed.value**2 + bias**2
        more = own.square - other.square - bias**2 + other.bias**2
        noise = other.scale * math.hypot(own.own, other.own)
        if own.pixels < other.pixels:  # which differ by what they look at as well
            noise = math.hypot(own.square_error, other.square_error)
        if abs(more) > TOLD * noise:
            square = max(square + more, (LEAST_ALIKE * missed.value) ** 2)
        return Belief(math.sqrt(square), math.hypot(missed.error, DIFFERS * missed.value))

    def texture_of(self, best: Candidate) -> Belief:
        """Return the texture that a candidate without single grains misses, by its pilot."""
        apart, one = self.apart(best), self.expected[best.level]
        assert apart is not None
        floor = beliefs.of_square(one.floor, max(one.spread, 1e-9), apart.square, apart.square_error)
        off = min(abs(apart.bias), 0.9 * floor.value)
        texture = max(math.sqrt(floor.value**2 - off**2), LEAST)
        return Belief(texture, math.hypot(floor.value * floor.error, off * apart.bias_error) / texture)

    def best_known(self) -> Candidate | None:
        """Return the candidate without single grains whose pilot says most of the texture that it misses."""
        alike = [c for c in self.pilots if not c.explicit_grains and not LEVELS[c.level].traits.packed]
        seen = {c: apart for c in alike if (apart := self.apart(c)) is not None}
        # by the error of texture squared, not by its value: the least of several values is too small; and of few pixels
        # neither is known
        return min(
            seen,
            key=lambda c: (
                -int(self.pilots[c].looked.sum()),
                math.hypot(seen[c].square_error, 2.0 * seen[c].bias * seen[c].bias_error),
            ),
            default=None,
        )

    def rougher(self) -> float:
        """Return how many times as much texture the scene has as is expected, as far as that was seen."""
        best = self.best_known()
        expected = self.expected[best.level].texture if best is not None else 0.0
        return self.texture_of(best).value / expected if best is not None and expected else 1.0

    def beside_the_reference(self, candidate: Candidate, floor: Belief) -> Belief:
        """Return a floor with what the reference itself may be off by, where that is not level explicit; with explicit
        grains first there is less of it."""
        assert self.reference is not None
        if self.reference.level == "explicit" or candidate.level == "explicit":
            return floor
        own = self.expected[self.reference.level]
        off = beliefs.of_square(own.floor, max(own.spread, 1e-9))
        off = self.faded(own, 0.0, own.bias, off, 0, candidate.explicit_grains)[2]
        if candidate.level == self.reference.level:
            return off
        return Belief(math.hypot(floor.value, off.value), math.hypot(floor.error, off.error))

    def of_one_packing(self, one: prior.Expected) -> float:
        """Return what of texture is left in the mean of the picture, of as many grains as there are in it: a plan is of
        one packing."""
        each = min(1.0, self.footprint**2 / math.pi)  # of a grain, that a pixel sees
        return one.texture / math.sqrt(max(self.coverage * self.pixels * each, 1.0))

    def faded(
        self, one: prior.Expected, bias: float, bias_error: float, floor: Belief, before: int, k: int
    ) -> tuple[float, float, Belief]:
        """Return what is left of a bias, its error and a floor with k explicit grains, of one with fewer.

        Texture falls by e for every `per_e` of them, and as the light that meets more grains yet, and so does what it
        adds to the mean; what a level makes of all packings alike falls as that light, of as many as it meets. Where
        the first go by pixel, all pixels come to what the one is left with that has most.
        """
        if k == before:
            return bias, bias_error, floor
        off = min(math.hypot(bias, bias_error), floor.value)
        # light that a few bright paths bring does not get weaker with the grains that it has met, but rarer
        lasting = self.lasting * (1.0 - 0.5 * self.glinting)
        rate = 1.0 / self.per_e + lasting  # as much less light is left, and it shows as much less
        seen = self.fading if before else None
        fall, kept = (k - before) * (seen or rate), 0.0
        if seen is None:  # glints go straight on through parallel facets, as long as they do: which law holds is open
            kept = 0.5 * self.glinting * max(fall - self.straight(k) + self.straight(before), 0.0)
        left = math.exp(kept - fall)
        if self.far and not before:
            left = min(1.0, self.ratio * left)
        packing, alike = self.of_one_packing(one), math.exp((before - k) * self.lasting)
        share = one.bias**2 / max(one.bias**2 + packing**2, 1e-30)
        less = math.sqrt(share * alike**2 + (1.0 - share) * left**2)
        bias, bias_error = bias * less, math.hypot(bias_error, FADING * bias) * less
        texture = math.sqrt(max(floor.value**2 - off**2, 0.0)) * left
        value = math.hypot(texture, min(math.hypot(bias, bias_error), floor.value))
        luck = math.sqrt(texture**2 + self.luck(texture / left, texture)) - texture
        unsure = math.hypot(floor.error * left, FADING * texture, math.expm1(kept) * texture, luck)
        return bias, bias_error, Belief(value, math.hypot(unsure, 0.5 * min(bias_error, value)))

    def straight(self, k: int) -> float:
        """Return how much less glints show, as a logarithm, of light that is deflected once and goes straight on
        through all other grains that it meets, if that is more than k grains: where each lets a share a straight on, n
        grains are met by n a^(n - 1) (1 - a)^2 of it."""
        a = min(max(self.atoms, 1e-9), 0.95)
        return -0.5 * (k * math.log(a) + math.log1p(k * (1.0 - a)))

    def luck(self, texture: float, left: float) -> float:
        """Return by how much the square of what explicit grains leave of texture may be off, because few pixels make
        it: which of these they leave is chance."""
        share = min((left / max(texture, LEAST)) ** 2, 1.0)
        return texture**2 * math.sqrt(share * (1.0 - share) / max(self.glints, 1.0))

    @property
    def glints(self) -> float:
        """How many pixels of the picture make most of what levels miss, by the pilot that knows it best."""
        best = self.best_known()
        seen = self.apart(best) if best is not None else None
        if seen is None or not seen.fourth > 0.0 or not seen.square > RESOLVED * seen.scale * seen.noise:
            return float(self.pixels)
        return self.pixels * min((seen.square / seen.scale) ** 2 / seen.fourth / self.sparkle, 1.0)

    @property
    def glinting(self) -> float:
        """Which share of the square of what levels miss a few pixels make, beyond what they do of any texture [1]."""
        best = self.best_known()
        seen = self.apart(best) if best is not None else None
        if seen is None or not seen.square > RESOLVED * seen.scale * seen.noise:
            return 0.0
        return max(seen.few - USUAL, 0.0) / (1.0 - USUAL)

    @property
    def fading(self) -> float | None:
        """Of the logarithm of texture, what each explicit grain takes off, as far as pilots with the first of them and
        without any saw."""
        few, best = GRAINS[1], self.best_known()
        seen = self.seen_after(few)
        if seen is None or best is None:
            return None
        square = seen.square - seen.bias**2
        if not square > 2.0 * seen.square_error:
            return None
        less = self.texture_of(best).value * (self.ratio if self.far else 1.0) / math.sqrt(square)
        return min(max(math.log(less) / few, SLOWEST), FASTEST)

    @property
    def per_e(self) -> float:
        """How many grains bring texture down by e: spheres 4 (docs/hybrid.md), facets as many as forget a direction."""
        forget = [max(LEAST_PER_E, 1.0 / max(1.0 - body.mean_cosine, 1e-9)) for body in self.bodies if not body.round]
        return min([PER_E, *forget])

    @property
    def length(self) -> float:
        """How many grains light meets that meets any, by the reference: with fewer still to come less can be missed."""
        assert self.reference is not None
        return max(self.pilots[self.reference].seen.events / max(self.coverage * self.struck, 1e-9), 1.0)

    @property
    def struck(self) -> float:
        """Share of the light that meets any grain of that which comes into the medium of which most is, about."""
        struck = 1.0
        for body in self.bodies:  # transport mean free paths are mean free paths over 1 - g
            layer = max(body.thickness - 2.0 * body.whole, 0.5) / max(1.0 - body.mean_cosine, 1e-9)
            struck = min(struck, -math.expm1(-SLANTED * layer / body.transport))
        return struck

    @property
    def lasting(self) -> float:
        """How much of the light that has met any number of grains meets none any more, as a logarithm, if each may be
        the last alike."""
        return -math.log1p(-1.0 / max(self.length, 1.05))

    def cost(self, candidate: Candidate) -> tuple[Seen, bool, Rare]:
        """Return variance and time of a sample, by its pilot or from those of others, whether it was the former, and
        what of the variance only chance finds.

        Suns that only chance finds make as much more of the variance as they are smaller than in pilots: all of it, at
        most, of single grains, and of levels whose grains let a share of light go exactly straight on, along which
        nothing is aimed, that share of it.
        """
        seen, piloted = self.cost_of_pilots(candidate)
        found, rare = seen.variance, NOTHING
        if not candidate.single:
            explicit = self.pilots.get(Candidate("explicit"))
            all_of_it = self.of_reference(explicit).variance if explicit is not None and explicit.each else math.inf
            straight = 0.0 if LEVELS[candidate.level].traits.points or not self.atoms else self.atoms * all_of_it
            found = min(found, straight)
        more = (self.rarer - 1.0) * found if self.rarer > 1.0 else 0.0
        if 0.0 < more < math.inf and not candidate.single:
            each = self.atoms * self.coverage / self.chance  # meetings of a sample, under the suns of pilots
            rare = Rare(more, each / self.rarer * self.pixels, math.sqrt(found * each))
        return seen._replace(variance=seen.variance + more), piloted, rare

    def cost_of_pilots(self, candidate: Candidate) -> tuple[Seen, bool]:
        """Return the same of the lights that pilots are under."""
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
        alike = ("volume-hg", "isotropic") if LEVELS[level].traits.points else ()  # whose light all aims
        near = next((self.pilots[Candidate(o)] for o in (*alike, "teleport-memory", "teleport", "volume")
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
