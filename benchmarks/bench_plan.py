"""Plans against what they predict: scenes that nothing was fitted to, rendered long at every candidate.

    python benchmarks/bench_plan.py [--only BEGINNING,..] [--drawn FIRST:LAST] [--glints FIRST:LAST]
        [--truth SECONDS] [--each SECONDS] [--suns DEGREES] [--kept FOLDER] [--out FILE.json]

For each scene the truth is level explicit over the scene's own packing; every candidate is rendered apart, and its
bias, texture and noise are taken from pictures whose noise is taken off. Suns that single grains hardly ever meet are 6
degrees wide, in plans as well: of smaller ones nobody can tell the truth. Printed are predicted over
measured errors after the time that the plan names, and what the chosen takes over the cheapest, or where none meets the
target its error over the least. Times are processor times. What was measured of scenes can be kept, to hold another
planner against it.
"""

import argparse
import json
import math
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from plan_draws import drawn, glinting
from plan_scenes import scenes

from tsdf.picture import render, world
from tsdf.plan import pilot, prior
from tsdf.plan.planner import FEWER, PATIENCE, plan
from tsdf.plan.prediction import Plan
from tsdf.scene.scene import Scene, SunLight, parse
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.walk.explicit import Packed
from tsdf.walk.geometry import Place

THREADS = min(2, os.cpu_count() or 1)
GRAINS = (0, 3, 8, 16)
SHIFTS = (0.0, -2.0, -1.0, 1.0, 2.0)  # standard errors
NOTHING = 1e-9  # [1] of variance of a sample: clear grains before a white sky
FREE = pilot.Clocks(wall=lambda: 0.0)  # plans are for free processors, however busy these are
SEEN = 2.0  # standard errors from which on a floor counts as measured
LEAST = 0.005  # [1] floors below are not told apart
ROUNDS, ROUND_S = 3, 0.15  # of timing, and what each candidate gets in each [s]
SEEDS = (101, 102)  # of two pictures that share no sample
WIDER = 6.0  # [deg] that suns have at least, for single grains meet smaller ones by chance alone


Pair = tuple[render.Picture, render.Picture]


@dataclass
class Measured:
    """What a candidate really costs and gets wrong; errors over the mean of the true picture [1]."""

    square: float  # of the error that time does not bring down, the mean over pixels
    square_error: float  # by the noise of both pictures
    bias: float
    variance: float  # of one sample of a pixel
    turn: float  # [s] of a sample of each pixel
    largest: float = 0.0  # share of `square` that is of the hundredth of the pixels of which it is most

    @classmethod
    def of(cls, picture: render.Picture, truth: render.Picture, processor: float) -> "Measured":
        """Return what a picture shows, whose processors took so long [s]."""
        mean = float(truth.rgb.mean())
        apart = (picture.rgb - truth.rgb) / mean
        noise = (picture.variance + truth.variance) / mean**2
        each = (apart**2 - noise).mean(axis=2)
        square = float(each.mean())
        grey = noise.mean(axis=2)
        error = math.sqrt(float((4.0 * np.maximum(each, 0.0) * grey + 2.0 * grey**2).sum())) / each.size
        spp = float(picture.samples.mean())
        largest = float(np.sort(each.ravel())[-max(each.size // 100, 1) :].sum()) / each.size / max(square, 1e-12)
        return cls(
            square, error, float(apart.mean()), float(picture.variance.mean()) * spp / mean**2,
            processor / spp / THREADS, largest,
        )  # fmt: skip

    @classmethod
    def beside(cls, pairs: list[Pair], mean: float, processor: float) -> "Measured":
        """Return what two pairs of pictures show, of a candidate and of level explicit by the same random numbers, so
        that they differ by little noise: the product of their differences has none in the mean."""
        one, two = ((picture.rgb - truth.rgb) / mean for picture, truth in pairs)
        each, noise = (one * two).mean(axis=2), 0.5 * ((one - two) ** 2).mean(axis=2)
        error = math.sqrt(float((noise**2 / 3.0 + 2.0 * np.maximum(each, 0.0) * noise).sum())) / each.size
        spp = float(pairs[0][0].samples.mean())
        variance = np.mean([picture.variance.mean() for picture, _ in pairs]) * spp / mean**2
        return cls(
            float(each.mean()), error, float(0.5 * (one + two).mean()), float(variance), processor / spp / 2 / THREADS,
        )  # fmt: skip

    @property
    def floor(self) -> float:
        return math.sqrt(max(self.square, 0.0))

    @property
    def resolved(self) -> bool:
        return self.square > SEEN * self.square_error and self.floor > LEAST

    def error(self, seconds: float, shift: float = 0.0) -> float:
        square = max(self.square + shift * self.square_error, 0.0)
        return math.sqrt(square + self.variance * self.turn / seconds)

    def known(self, target: float) -> bool:
        """Return whether the time to an error, or that it is out of reach, is known to a fifth."""
        return self.square_error < 0.2 * abs(target**2 - max(self.square, 0.0))

    def seconds(self, target: float, shift: float = 0.0) -> float:
        left = target**2 - max(self.square + shift * self.square_error, 0.0)
        return self.variance * self.turn / left if left > 0.0 else math.inf


def photographed(
    scene: Scene, candidate: Candidate, seconds: float | None, seed: int, places: dict[bool, Place],
    spp: int | None = None,
) -> tuple[render.Picture, float]:  # fmt: skip
    """Return a picture and the processor time of all threads that it took [s]."""
    built = world.build(taken(scene, candidate), candidate.level, places=places)
    render.render(built, spp=1, seed=seed, threads=THREADS)
    began = time.process_time()
    picture = render.render(built, spp, seconds, seed=seed, threads=THREADS)
    return picture, time.process_time() - began


def widened(scene: Scene, least: float = WIDER) -> Scene:
    """Return a scene whose suns are as bright, but not so small that single grains hardly ever meet them [deg]."""
    suns = [isinstance(light, SunLight) and light.angular_diameter_deg < least for light in scene.lights]
    lights = (
        replace(light, angular_diameter_deg=least) if small else light
        for light, small in zip(scene.lights, suns, strict=True)
    )
    return replace(scene, lights=tuple(lights)) if any(suns) else scene


def measured(
    scene: Scene, truth_s: float, each_s: float, others: set[Candidate], kept: Path | None = None
) -> dict[Candidate, Measured]:
    """Return what candidates cost and get wrong, of which some may be in a file already, to which others are added."""
    found: dict[Candidate, Measured] = {}
    if kept is not None and kept.exists():
        found = {Candidate(*one): Measured(**values) for one, values in json.loads(kept.read_text())}
    wanted = [
        one
        for one in candidates(grains=GRAINS)
        if one in others
        or (one.level not in ("explicit", "teleport-joint") and (one.level != "teleport" or not one.explicit_grains))
    ]
    if all(one in found for one in (Candidate("explicit"), *wanted)):
        return found
    places: dict[bool, Place] = {}
    far = prior.looks(world.build(scene, "volume", leap=0.0, places=places))[2] > FEWER  # as plans have it
    scene = replace(scene, render=replace(scene.render, fewer_far=far))
    if any(one not in found and not one.explicit_grains for one in wanted):
        truth, processor = photographed(scene, Candidate("explicit"), truth_s, 1, places)
        found[Candidate("explicit")] = replace(Measured.of(truth, truth, processor), square=0.0, square_error=0.0)
    single: list[render.Picture] = []  # explicit, beside candidates that have some
    for one in wanted:
        if one in found:
            continue
        if one.explicit_grains:
            spp = max(int(each_s / 2 / found[Candidate("explicit")].turn), 2)
            single = single or [photographed(scene, Candidate("explicit"), None, s, places, spp)[0] for s in SEEDS]
            shots = [photographed(scene, one, None, seed, places, spp) for seed in SEEDS]
            pairs = [(shot[0], other) for shot, other in zip(shots, single, strict=True)]
            found[one] = Measured.beside(
                pairs, float(np.mean([p.rgb.mean() for p in single])), sum(shot[1] for shot in shots)
            )
        else:
            number = 2 + candidates(grains=GRAINS).index(one)
            picture, processor = photographed(scene, one, each_s, number, places)
            found[one] = Measured.of(picture, truth, processor)
    timed(scene, found, places)
    if kept is not None:
        kept.write_text(json.dumps([(one, asdict(m)) for one, m in found.items()]))
    return found


def timed(scene: Scene, found: dict[Candidate, Measured], places: dict[bool, Place]) -> None:
    """Time all candidates side by side, some rounds of each; the least counts, for other work only adds to it."""
    packings: dict[bool, Packed] = {}
    worlds = {one: world.build(taken(scene, one), one.level, places=places, packings=packings) for one in found}
    for _ in range(ROUNDS):
        for one, m in found.items():
            spp = max(int(ROUND_S / m.turn), 1)
            m.turn = min(m.turn, render.render(worlds[one], spp, threads=THREADS).processor_seconds / spp / THREADS)


def judged(made: Plan, found: dict[Candidate, Measured], target: float) -> dict[str, Any]:
    """Return how a plan compares with what was measured."""
    chosen = made.chosen
    after = chosen.seconds(target)
    if not math.isfinite(after):
        after = min(m.variance * m.turn for m in found.values()) / target**2
    by = {p.candidate: p for p in made.predictions}
    ratios = {str(c): by[c].error(after) / m.error(after) for c, m in found.items() if c in by}
    near = {  # how near to what was measured, within two standard errors of that
        str(c): min((by[c].error(after) / m.error(after, shift) for shift in SHIFTS), key=lambda r: abs(math.log(r)))
        for c, m in found.items() if c in by
    }  # fmt: skip
    floors = {str(c): by[c].floor.value / m.floor for c, m in found.items() if c in by and m.resolved}
    turns = {str(c): by[c].variance * by[c].turn / (m.variance * m.turn) for c, m in found.items() if c in by}
    takes = {c: m.seconds(target) for c, m in found.items()}
    low, high = ({c: m.seconds(target, shift) for c, m in found.items()} for shift in (-1.0, 1.0))
    if min(takes.values()) == math.inf:  # none meets it: how little error there is after as long as anybody waits
        takes, low, high = ({c: m.error(PATIENCE, shift) for c, m in found.items()} for shift in (0.0, -1.0, 1.0))
    best = min(takes, key=lambda c: takes[c])
    own = found.get(chosen.candidate)
    mine = takes[chosen.candidate] if own is not None else math.nan
    return {
        "target": target, "chosen": str(chosen.candidate), "best": str(best), "takes": mine, "best_takes": takes[best],
        "told": all(m.known(target) for m in (found[best], own) if m is not None),
        "over": mine / takes[best], "over_at_least": low.get(chosen.candidate, math.nan) / min(high.values()),
        "errors": ratios, "near": near, "floors": floors, "costs": turns, "planning": made.spent, "why": list(made.why),
    }  # fmt: skip


def begins(name: str, beginning: str) -> bool:
    """Return whether a scene is meant; ++ is that set alone."""
    marks = len(name) - len(name.lstrip("+"))
    return name.startswith(beginning) and (beginning.strip("+") != "" or len(beginning) == marks)


def asked_for(args: argparse.Namespace, folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield names, scenes and two targets of what the command line asks for."""
    for draw, seeds in ((drawn, args.drawn), (glinting, args.glints)):
        if seeds:
            first, last = (int(word) for word in seeds.split(":"))
            yield from (draw(seed) for seed in range(first, last + 1))
    if not (args.drawn or args.glints):
        for name, data, targets in scenes(folder):
            if not args.only or any(begins(name, one) for one in args.only.split(",")):
                yield name, data, targets


def main() -> None:
    """Print the comparison and its summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="how names of scenes begin, comma-separated")
    for name, said in (("--drawn", "drawn by `plan_draws`"), ("--glints", "likewise, of what sparkles")):
        parser.add_argument(name, metavar="FIRST:LAST", help=f"seeds of scenes {said}, and none else")
    parser.add_argument("--kept", type=Path, help="folder where what is measured of scenes is kept and taken from")
    parser.add_argument("--truth", type=float, default=30.0, help="seconds of the truth")
    parser.add_argument("--each", type=float, default=6.0, help="seconds of each candidate")
    parser.add_argument("--suns", type=float, default=WIDER, help="degrees that suns have at least")
    parser.add_argument("--out", type=Path, help="JSON of all numbers")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    pilot.LATE = math.inf  # processors that others use, too, are waited for
    with tempfile.TemporaryDirectory() as folder:
        for name, data, targets in asked_for(args, Path(folder)):
            scene = widened(parse(data, name=name), args.suns)
            plans = [(target, plan(scene, target, threads=THREADS, clocks=FREE)) for target in targets]
            kept = args.kept / f"{name.replace(' ', '_').replace(':', '')}.json" if args.kept else None
            found = measured(scene, args.truth, args.each, {one.chosen.candidate for _, one in plans}, kept)
            if found[Candidate("explicit")].variance < NOTHING:
                print(f"{name}: a picture without noise, by whatever level", flush=True)
                continue
            for target, one in plans:
                row = {"scene": name, **judged(one, found, target)}
                rows.append(row)
                off = [r for r in row["errors"].values() if not 0.5 <= r <= 2.0]
                print(
                    f"{name}, {100 * target:g} %: {row['chosen']} ({row['takes']:.3g} s; cheapest {row['best']} "
                    f"{row['best_takes']:.3g} s), {len(off)} of {len(row['errors'])} errors off by more than 2, "
                    f"planned in {one.spent:.1f} s", flush=True,
                )  # fmt: skip
                print(f"    {one.why[1]}")
            for c, m in found.items():
                mine = {t: next((p for p in one.predictions if p.candidate == c), None) for t, one in plans}
                told = "; ".join(
                    f"{100 * p.floor.value:.2f}±{100 * p.floor.error:.2f} bias {100 * p.bias:+.2f}±"
                    f"{100 * p.bias_error:.2f} cost {p.variance * p.turn / (m.variance * m.turn):.2f}"
                    for p in mine.values() if p is not None
                )  # fmt: skip
                error = math.sqrt(max(m.square, 0.0) + m.square_error) - m.floor
                tail = f" {100 * m.largest:.0f} % in 1 %" if m.resolved else ""
                print(
                    f"    {c!s:24s} {100 * m.floor:6.2f}+{100 * error:.2f} % bias {100 * m.bias:+.2f}{tail} | {told}",
                    flush=True,
                )
            if args.out:
                args.out.write_text(json.dumps(rows, indent=1))
    summary(rows)


def summary(rows: list[dict[str, Any]]) -> None:
    """Print shares of what is right."""
    for title, some in (("all", rows), ("held out", [r for r in rows if r["scene"].startswith("+")])):
        if not some:
            continue
        for key, said in (
            ("errors", "errors"),
            ("near", "errors, as far as they are known,"),
            ("floors", "resolved floors"),
            ("costs", "costs"),
        ):
            ratios = [r for row in some for r in row[key].values()]
            good = sum(0.5 <= r <= 2.0 for r in ratios)
            share = 100.0 * good / max(len(ratios), 1)
            print(f"{title}: {said} within a factor 2: {good} of {len(ratios)} ({share:.0f} %)")
        right = sum(row["over"] <= 1.2 for row in some)  # inf / inf is neither
        print(
            f"{title}: chosen within 20 % of the cheapest: {right} of {len(some)} ({100.0 * right / len(some):.0f} %)"
        )
        known = [row for row in some if row["told"]]
        right = sum(row["over"] <= 1.2 for row in known)
        print(f"{title}: where times of both are known to a fifth: {right} of {len(known)}")
        close = sum(row["over_at_least"] <= 1.2 for row in some)
        share = 100.0 * close / len(some)
        print(f"{title}: or not told from that by what is measured: {close} of {len(some)} ({share:.0f} %)")
        print(f"{title}: planning took {np.mean([row['planning'] for row in some]):.1f} s in the mean")


if __name__ == "__main__":
    main()
