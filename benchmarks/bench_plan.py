"""Plans against what they predict: scenes that nothing was fitted to, rendered long at every candidate.

    python benchmarks/bench_plan.py [--only BEGINNING,..] [--truth SECONDS] [--each SECONDS] [--out FILE.json]

For each scene the truth is level explicit over the scene's own packing; every candidate is rendered apart, and its
bias, texture and noise are taken from pictures whose noise is taken off. Suns that single grains hardly ever meet are 6
degrees wide, in plans as well: of smaller ones nobody can tell the truth. Printed are predicted over
measured errors after the time that the plan names, and what the chosen takes over the cheapest, or where none meets the
target its error over the least. Times are processor times.
"""

import argparse
import json
import math
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from plan_scenes import scenes

from tsdf.picture import render, world
from tsdf.plan import prior
from tsdf.plan.planner import FEWER, PATIENCE, plan
from tsdf.plan.prediction import Plan
from tsdf.scene.scene import Scene, SunLight, parse
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.walk.geometry import Place

THREADS = min(2, os.cpu_count() or 1)
GRAINS = (0, 3, 8, 16)
SEEN = 2.0  # standard errors from which on a floor counts as measured
LEAST = 0.005  # [1] floors below are not told apart
WIDER = 6.0  # [deg] that suns have at least, for single grains meet smaller ones by chance alone


class Measured:
    """What a candidate really costs and gets wrong."""

    def __init__(self, picture: render.Picture, truth: render.Picture, processor: float) -> None:
        mean = float(truth.rgb.mean())
        apart = (picture.rgb - truth.rgb) / mean
        noise = (picture.variance + truth.variance) / mean**2
        each = (apart**2 - noise).mean(axis=2)
        self.square = float(each.mean())
        tiles = [t.mean() for row in np.array_split(each, 6) for t in np.array_split(row, 6, axis=1)]
        self.square_error = float(np.std(tiles, ddof=1) / math.sqrt(len(tiles)))
        noise_only = 2.0 * float((noise.mean(axis=2) ** 2).mean()) / each.size
        self.square_error = max(self.square_error, math.sqrt(noise_only))
        self.bias = float(apart.mean())
        spp = float(picture.samples.mean())
        self.variance = float(picture.variance.mean()) * spp / mean**2
        self.turn = processor / spp / THREADS

    @property
    def floor(self) -> float:
        return math.sqrt(max(self.square, 0.0))

    @property
    def resolved(self) -> bool:
        return self.square > SEEN * self.square_error and self.floor > LEAST

    def error(self, seconds: float, shift: float = 0.0) -> float:
        square = max(self.square + shift * self.square_error, 0.0)
        return math.sqrt(square + self.variance * self.turn / seconds)

    def seconds(self, target: float, shift: float = 0.0) -> float:
        left = target**2 - max(self.square + shift * self.square_error, 0.0)
        return self.variance * self.turn / left if left > 0.0 else math.inf


def photographed(
    scene: Scene, candidate: Candidate, seconds: float, seed: int, places: dict[bool, Place]
) -> tuple[render.Picture, float]:
    """Return a picture and the processor time of all threads that it took [s]."""
    built = world.build(taken(scene, candidate), candidate.level, places=places)
    render.render(built, spp=1, seed=seed, threads=THREADS)
    began = time.process_time()
    picture = render.render(built, seconds=seconds, seed=seed, threads=THREADS)
    return picture, time.process_time() - began


def widened(scene: Scene) -> Scene:
    """Return a scene whose suns are as bright, but not so small that single grains hardly ever meet them."""
    suns = [isinstance(light, SunLight) and light.angular_diameter_deg < WIDER for light in scene.lights]
    lights = (
        replace(light, angular_diameter_deg=WIDER) if small else light
        for light, small in zip(scene.lights, suns, strict=True)
    )
    return replace(scene, lights=tuple(lights)) if any(suns) else scene


def measured(scene: Scene, truth_s: float, each_s: float, others: set[Candidate]) -> dict[Candidate, Measured]:
    places: dict[bool, Place] = {}
    far = prior.looks(world.build(scene, "volume", leap=0.0, places=places))[2] > FEWER  # as plans have it
    scene = replace(scene, render=replace(scene.render, fewer_far=far))
    truth, processor = photographed(scene, Candidate("explicit"), truth_s, 1, places)
    found = {Candidate("explicit"): Measured(truth, truth, processor)}
    found[Candidate("explicit")].square = 0.0
    for number, one in enumerate(candidates(grains=GRAINS)):
        usual = one.level not in ("explicit", "teleport-joint") and (one.level != "teleport" or not one.explicit_grains)
        if not usual and (one not in others or one.level == "explicit"):
            continue
        picture, processor = photographed(scene, one, each_s, 2 + number, places)
        found[one] = Measured(picture, truth, processor)
    return found


def judged(made: Plan, found: dict[Candidate, Measured], target: float) -> dict[str, Any]:
    """Return how a plan compares with what was measured."""
    chosen = made.chosen
    after = chosen.seconds(target)
    if not math.isfinite(after):
        after = min(m.variance * m.turn for m in found.values()) / target**2
    by = {p.candidate: p for p in made.predictions}
    ratios = {str(c): by[c].error(after) / m.error(after) for c, m in found.items() if c in by}
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
        "over": mine / takes[best], "over_at_least": low.get(chosen.candidate, math.nan) / min(high.values()),
        "errors": ratios, "floors": floors, "costs": turns, "planning": made.spent, "why": list(made.why),
    }  # fmt: skip


def begins(name: str, beginning: str) -> bool:
    """Return whether a scene is meant; ++ is that set alone."""
    marks = len(name) - len(name.lstrip("+"))
    return name.startswith(beginning) and (beginning.strip("+") != "" or len(beginning) == marks)


def main() -> None:
    """Print the comparison and its summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="how names of scenes begin, comma-separated")
    parser.add_argument("--truth", type=float, default=30.0, help="seconds of the truth")
    parser.add_argument("--each", type=float, default=6.0, help="seconds of each candidate")
    parser.add_argument("--out", type=Path, help="JSON of all numbers")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, data, targets in scenes(Path(folder)):
            if args.only and not any(begins(name, one) for one in args.only.split(",")):
                continue
            scene = widened(parse(data, name=name))
            plans = [(target, plan(scene, target, threads=THREADS)) for target in targets]
            found = measured(scene, args.truth, args.each, {one.chosen.candidate for _, one in plans})
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
                print(
                    f"    {c!s:24s} {100 * m.floor:6.2f}+{100 * error:.2f} % bias {100 * m.bias:+.2f} | {told}",
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
        for key, said in (("errors", "errors"), ("floors", "resolved floors"), ("costs", "costs")):
            ratios = [r for row in some for r in row[key].values()]
            good = sum(0.5 <= r <= 2.0 for r in ratios)
            share = 100.0 * good / max(len(ratios), 1)
            print(f"{title}: {said} within a factor 2: {good} of {len(ratios)} ({share:.0f} %)")
        right = sum(row["over"] <= 1.2 for row in some)  # inf / inf is neither
        print(
            f"{title}: chosen within 20 % of the cheapest: {right} of {len(some)} ({100.0 * right / len(some):.0f} %)"
        )
        close = sum(row["over_at_least"] <= 1.2 for row in some)
        share = 100.0 * close / len(some)
        print(f"{title}: or not told from that by what is measured: {close} of {len(some)} ({share:.0f} %)")
        print(f"{title}: planning took {np.mean([row['planning'] for row in some]):.1f} s in the mean")


if __name__ == "__main__":
    main()
