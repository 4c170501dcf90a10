"""Truths that plans are held against: what each candidate of a scene really costs and gets wrong.

The truth is level explicit over the scene's own packing. Pictures are taken in batches, each with its own random
numbers: of candidates with explicit grains first by the same as level explicit, so that both differ by little noise, of
the others apart. A scene has seconds of a processor for it, which go where choices are decided: to the candidate whose
time to a target may be the least, or within a fifth of it, and is not known to a fifth, then to whose error is known
worst. What was taken can be kept in a folder, a file for each scene, and taken on from there.
"""

import hashlib
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.errors import SceneError
from tsdf.picture import render, world
from tsdf.plan import prior
from tsdf.plan.planner import FEWER
from tsdf.scene.scene import Scene
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.walk.explicit import Packed
from tsdf.walk.geometry import Place

EXPLICIT = Candidate("explicit")
GRAINS = (0, 3, 8, 16)
SEEN = 2.0  # standard errors from which on a floor counts as measured
LEAST = 0.005  # [1] floors below are not told apart
FIRST = 4  # batches before anything is decided
OF_EXPLICIT, OF_EACH = 0.06, 0.01  # shares of the time that the first batches take, of level explicit and of each other
ROUNDS, ROUND_S = 3, 0.15  # of timing, and what each candidate gets in each [s]
NEAR = 1.2  # times the cheapest that counts as being as cheap
KNOWN = 0.2  # of what is left for noise, that a square has to be known to
SEED = 101  # of the first batch


@dataclass
class Measured:
    """What a candidate really costs and gets wrong; errors over the mean of the true picture [1]."""

    square: float  # of the error that time does not bring down, the mean over pixels
    square_error: float  # by the noise of both pictures
    bias: float
    variance: float  # of one sample of a pixel
    turn: float  # [s] of a sample of each pixel, on the clock
    largest: float = 0.0  # share of `square` that is of the hundredth of the pixels of which it is most

    @property
    def floor(self) -> float:
        return math.sqrt(max(self.square, 0.0))

    @property
    def floor_error(self) -> float:
        return max(math.sqrt(max(self.square, 0.0) + self.square_error) - self.floor, 1e-6)

    @property
    def resolved(self) -> bool:
        return self.square > SEEN * self.square_error and self.floor > LEAST

    def error(self, seconds: float, shift: float = 0.0) -> float:
        square = max(self.square + shift * self.square_error, 0.0)
        return math.sqrt(square + self.variance * self.turn / seconds)

    def known(self, target: float) -> bool:
        """Return whether the time to an error, or that it is out of reach, is known to a fifth."""
        return self.square_error < KNOWN * abs(target**2 - max(self.square, 0.0))

    def seconds(self, target: float, shift: float = 0.0) -> float:
        left = target**2 - max(self.square + shift * self.square_error, 0.0)
        return self.variance * self.turn / left if left > 0.0 else math.inf


@dataclass
class Shots:
    """Batches of one candidate: mean radiance of pixels in each (h, w, 3), and over all of them the sum of variances of
    these means; samples of a pixel in each, and a sample's time [s]."""

    spp: int
    turn: float
    batches: list[np.ndarray] = field(default_factory=list)
    variance: np.ndarray = field(default_factory=lambda: np.zeros(()))

    @property
    def mean(self) -> np.ndarray:
        found: np.ndarray = np.mean(self.batches, axis=0, dtype=np.float64)
        return found

    @property
    def noise(self) -> np.ndarray:
        """Variance of that mean."""
        found: np.ndarray = self.variance / len(self.batches) ** 2
        return found


class Truth:
    """What was taken of one scene so far.

    Attributes
    ----------
    shots : dict of Candidate to Shots
    spent : float
        Processor time of all pictures [s].
    """

    def __init__(self, scene: Scene, targets: Sequence[float], path: Path | None = None) -> None:
        self.places: dict[bool, Place] = {}
        self.packings: dict[bool, Packed] = {}
        far = prior.looks(world.build(scene, "volume", leap=0.0, places=self.places))[2] > FEWER  # as plans have it
        self.scene = replace(scene, render=replace(scene.render, fewer_far=far))
        self.targets, self.path = tuple(targets), path
        self.worlds: dict[Candidate, world.World] = {}
        self.shots: dict[Candidate, Shots] = {}
        self.spent = 0.0
        if path is not None and path.exists():
            self._read(path)

    # ----------------------------------------------------------------------------------------------- pictures

    def take(self, seconds: float, others: Sequence[Candidate] = ()) -> None:
        """Take pictures until so much processor time is spent [s], or all is known; of others as well."""
        wanted = [one for one in candidates(grains=GRAINS) if one in others or one in self.shots or usual(one)]
        wanted += sorted({one for one in others if one.leap is not None} - set(wanted))
        before = self.spent
        for one in (EXPLICIT, *wanted):
            if one not in self.shots:
                self._begin(one, seconds * (OF_EXPLICIT if one == EXPLICIT else OF_EACH))
            if EXPLICIT not in self.shots:
                return
        if any(not shots.turn for shots in self.shots.values()):
            self._time()
        while self.spent < seconds and (one := self.open()) is not None:
            self._more(one)
        if self.path is not None and self.spent > before:
            self._write(self.path)

    def open(self) -> Candidate | None:
        """Return what is to be looked at next; None where all choices and errors are known."""
        found = self.measured()
        worst, which = 1.0, None
        for target in self.targets:
            least = min(m.seconds(target, 1.0) for m in found.values())
            for one, m in found.items():
                gap = KNOWN * max(abs(target**2 - max(m.square, 0.0)), 1e-12)
                if m.seconds(target, -1.0) <= NEAR * least and m.square_error / gap > worst:
                    worst, which = m.square_error / gap, one
        if which is None:
            for one, m in found.items():
                unknown = m.square_error / KNOWN / max(m.square, min(self.targets) ** 2)
                if unknown > worst:
                    worst, which = unknown, one
        return which

    def _begin(self, one: Candidate, seconds: float) -> None:
        try:
            made = world.build(taken(self.scene, one), one.level, places=self.places, packings=self.packings)
        except SceneError:
            return
        self.worlds[one] = made
        if one.explicit_grains:  # beside level explicit, batch by batch
            spp = self.shots[EXPLICIT].spp
        else:
            trial = render.render(made, 8, seed=1, threads=1)
            spp = max(int(8 * seconds / FIRST / max(trial.processor_seconds, 1e-4)), 8)
        self.shots[one] = Shots(spp, 0.0)
        for _ in range(FIRST):
            self._more(one)

    def _more(self, one: Candidate) -> None:
        """Take another batch of a candidate, or of level explicit where that has the most of the noise."""
        shots = self.shots[one]
        if one != EXPLICIT and not one.explicit_grains and len(shots.batches) >= FIRST:
            best = self.shots[EXPLICIT]
            if best.noise.mean() > shots.noise.mean():
                shots, one = best, EXPLICIT
        elif one.explicit_grains and len(shots.batches) >= len(self.shots[EXPLICIT].batches):
            self._more(EXPLICIT)
        n = len(shots.batches)
        if one not in self.worlds:
            self.worlds[one] = world.build(
                taken(self.scene, one), one.level, places=self.places, packings=self.packings
            )
        seed = SEED + n  # of level explicit, and what is held beside it
        if not (one == EXPLICIT or one.explicit_grains):
            seed += 1000 * (1 + candidates(grains=GRAINS).index(one._replace(leap=None))) + 500 * (one.leap is not None)
        picture = render.render(self.worlds[one], shots.spp, seed=seed, threads=1)
        shots.batches.append(picture.rgb.astype(np.float32))
        shots.variance = shots.variance + picture.variance
        self.spent += picture.processor_seconds

    def _time(self) -> None:
        """Time all candidates side by side, some rounds of each; the least counts, for other work only adds to it."""
        for one in self.shots:
            if one not in self.worlds:
                self.worlds[one] = world.build(
                    taken(self.scene, one), one.level, places=self.places, packings=self.packings
                )
        turns = dict.fromkeys(self.shots, math.inf)
        numbers = dict.fromkeys(self.shots, 8)
        for turn in range(1 + ROUNDS):
            for one, made in self.worlds.items():
                took = render.render(made, numbers[one], threads=1).processor_seconds / numbers[one]
                if turn:
                    turns[one] = min(turns[one], took)
                else:
                    numbers[one] = max(int(ROUND_S / took), 8)
        for one, took in turns.items():
            self.shots[one].turn = took

    # ------------------------------------------------------------------------------------------ what they show

    def measured(self, threads: int = 1) -> dict[Candidate, Measured]:
        """Return what candidates cost and get wrong, of so many threads."""
        found = {one: self._measured(one) for one in self.shots}
        return {one: replace(m, turn=m.turn / threads) for one, m in found.items()}

    def _measured(self, one: Candidate) -> Measured:
        best, own = self.shots[EXPLICIT], self.shots[one]
        mean = float(best.mean.mean())
        variance = float(own.variance.mean()) / len(own.batches) * own.spp / mean**2
        if one == EXPLICIT:
            return Measured(0.0, 0.0, 0.0, variance, own.turn)
        if one.explicit_grains:
            n = len(own.batches)
            each = (np.array(own.batches, np.float64) - np.array(best.batches[:n], np.float64)) / mean
            apart, noise = each.mean(axis=0), each.var(axis=0, ddof=1) / n
            few = n / (n - 1.0)  # the noise is by so many numbers only
        else:
            apart, noise, few = (own.mean - best.mean) / mean, (own.noise + best.noise) / mean**2, 1.0
        square = (apart**2 - noise).mean(axis=2)
        grey = noise.mean(axis=2)
        error = math.sqrt(float((4.0 * np.maximum(square, 0.0) * grey + 2.0 * few * grey**2).sum())) / square.size
        whole = float(square.mean())
        largest = float(np.sort(square.ravel())[-max(square.size // 100, 1) :].sum()) / square.size / max(whole, 1e-12)
        return Measured(whole, error, float(apart.mean()), variance, own.turn, largest)

    # -------------------------------------------------------------------------------------------------- files

    def _write(self, path: Path) -> None:
        facts = [(*one, shots.spp, shots.turn) for one, shots in self.shots.items()]
        arrays = {}
        for n, shots in enumerate(self.shots.values()):
            arrays[f"batches{n}"], arrays[f"variance{n}"] = np.array(shots.batches), shots.variance
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(".part.npz")
        np.savez(beside, facts=json.dumps({"shots": facts, "spent": self.spent}), **arrays)
        beside.replace(path)

    def _read(self, path: Path) -> None:
        with np.load(path) as file:
            facts = json.loads(str(file["facts"]))
            self.spent = facts["spent"]
            for n, (level, k, leap, spp, turn) in enumerate(facts["shots"]):
                own = Shots(spp, turn, list(file[f"batches{n}"]), file[f"variance{n}"])
                self.shots[Candidate(level, k, leap)] = own


def usual(one: Candidate) -> bool:
    """Return whether a candidate is looked at in any case: others differ from these too little to be chosen often."""
    return one.level != "teleport-joint" and (one.level != "teleport" or not one.explicit_grains)


def kept_in(folder: Path | None, name: str, data: dict[str, Any], suns: float) -> Path | None:
    """Return the file where what is taken of a scene is kept, which another scene of that name does not share."""
    if folder is None:
        return None
    text = json.dumps([data, suns], sort_keys=True).replace(tempfile.gettempdir(), "")
    key = hashlib.sha256(text.encode()).hexdigest()[:12]
    return folder / f"{name.replace(' ', '_').replace(':', '').replace(',', '')}-{key}.npz"
