"""Plans against what they predict: scenes that nothing was fitted to, rendered long at every candidate.

    python benchmarks/bench_plan.py [--only BEGINNING,..] [--truth SECONDS] [--each SECONDS] [--out FILE.json]

For each scene the truth is level explicit over the scene's own packing; every candidate is rendered apart, and its
bias, texture and noise are taken from pictures whose noise is taken off. Printed are predicted over measured errors
after the time that the plan names, and what the chosen takes over the cheapest. Times are processor times.
"""

import argparse
import json
import math
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.picture import render, world
from tsdf.plan import prior
from tsdf.plan.planner import FEWER, plan
from tsdf.plan.prediction import Plan
from tsdf.scene.scene import Scene, parse
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.walk.geometry import Place

WIDTH, HEIGHT = 48, 36
THREADS = min(2, os.cpu_count() or 1)
GRAINS = (0, 3, 8, 16)
SEEN = 2.0  # standard errors from which on a floor counts as measured
LEAST = 0.005  # [1] floors below are not told apart
NOON = {"type": "sun", "direction": [0.5, -0.4, 1.0], "irradiance": [2.0, 1.9, 1.8], "angular_diameter_deg": 50.0}
LOW_SUN = {"type": "sun", "direction": [1.0, -0.2, 0.25], "irradiance": [2.5, 2.4, 2.2], "angular_diameter_deg": 35.0}
BEHIND = {"type": "sun", "direction": [0.1, 1.0, 0.4], "irradiance": [3.0, 3.0, 3.0], "angular_diameter_deg": 45.0}
SKY = {"type": "constant", "radiance": [0.3, 0.35, 0.45]}
WHITE = {"type": "constant", "radiance": [1.0, 1.0, 1.0]}
FLOOR = {"shape": {"type": "rectangle", "centre": [0, 0, 0], "u": [2000, 0, 0], "v": [0, 2000, 0]}, "reflectance": 0.3}


def box(x: float, y: float, z: float) -> dict[str, Any]:
    return {"type": "box", "low": [-x / 2, -y / 2, 0.02], "high": [x / 2, y / 2, z]}


def ball(radius: float) -> dict[str, Any]:
    return {"type": "sphere", "centre": [0, 0, radius + 0.02], "radius": radius}


def made(
    shape: dict[str, Any], grains: Any, fraction: float, lights: list, distance: float, height: float, look: float,
    fov: float = 40.0, floor: bool = False, inside: str = "grains",
) -> dict[str, Any]:  # fmt: skip
    """Return a scene with grains of radius 1, seen from a distance and a height [R]."""
    medium = {"shape": shape, "packing_fraction": fraction, "radius": 1.0, "inside": inside, "grain": grains}
    return {
        "camera": {"position": [0.2 * distance, -distance, height], "target": [0, 0, look], "fov_deg": fov,
                   "width": WIDTH, "height": HEIGHT},
        "light": lights,
        "medium": [medium],
        "surface": [FLOOR] if floor else [],
    }  # fmt: skip


def grain(table: str, absorption: Any = 0.0, fraction: float = 1.0) -> dict[str, Any]:
    return {"table": table, "absorption": absorption, "fraction": fraction}


def heap(folder: Path, radius: float, height: float) -> dict[str, Any]:
    """Return a closed heap with a flat foot."""
    import trimesh

    body = trimesh.creation.icosphere(3, radius=1.0)
    v = body.vertices * [radius, radius, height]
    v[:, 2] = np.maximum(v[:, 2], -0.15 * height) + 0.15 * height + 0.02
    path = folder / f"heap{radius:g}.ply"
    trimesh.Trimesh(v, body.faces, process=False).export(path)
    return {"type": "mesh", "file": str(path)}


def scenes(folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield names, scenes and two targets; those with + were held out until the laws of texture stood, those
    with ++ until nothing of a plan was changed any more."""
    glass, salt, sugar, sand = (grain(name) for name in ("glass-beads", "salt", "sugar", "sand"))
    quartz, snow, fresh, plates = (grain(name) for name in ("quartz", "coarse-snow", "fresh-snow", "plates"))
    grey, tinted, dark = grain("glass-beads", 0.1), grain("salt", 0.02, 0.6), grain("salt", [0.02, 0.1, 0.3])
    brown, most, some = grain("sugar", [0.05, 0.15, 0.4]), grain("sand", 0.0, 0.7), grain("glass-beads", 0.05, 0.3)
    # fmt: off
    yield "dilute glass slab", made(box(60, 60, 12), [glass], 0.1, [SKY, NOON], 70, 60, 4), (0.02, 0.05)
    yield "dense glass box", made(box(50, 50, 30), [glass], 0.6, [SKY, NOON], 110, 80, 12), (0.02, 0.05)
    yield "glass close up", made(box(40, 40, 20), [glass], 0.6, [SKY, NOON], 12, 34, 20, 35), (0.05, 0.1)
    yield "salt ball", made(ball(15), [salt], 0.5, [SKY, LOW_SUN], 80, 40, 14), (0.03, 0.1)
    yield "sugar heap", made(heap(folder, 40, 25), [sugar], 0.55, [SKY, NOON], 130, 60, 8, floor=True), (0.04, 0.1)
    yield "grey glass", made(ball(12), [grey], 0.3, [SKY, NOON], 70, 30, 12, 30), (0.01, 0.05)
    yield "sand from behind", made(box(60, 10, 50), [sand], 0.6, [SKY, BEHIND], 130, 40, 24), (0.05, 0.1)
    yield "mixture", made(box(40, 40, 16), [quartz, tinted], 0.45, [SKY, NOON], 90, 70, 6), (0.04, 0.1)
    yield "plates", made(ball(20), [plates], 0.2, [SKY, LOW_SUN], 120, 30, 20, 30, True), (0.05, 0.1)
    yield "deep snow", made(ball(150), [snow], 0.5, [SKY, NOON], 900, 300, 140, 30, True), (0.03, 0.1)
    yield "+glass far", made(ball(30), [glass], 0.5, [SKY, LOW_SUN], 400, 150, 28, 20), (0.02, 0.05)
    yield "+fresh layer", made(box(120, 120, 30), [fresh], 0.3, [SKY, NOON], 200, 120, 10, floor=True), (0.05, 0.1)
    yield "+quartz layer", made(box(40, 40, 5), [quartz], 0.6, [SKY, NOON], 30, 35, 2, 40, True), (0.05, 0.1)
    yield "+dark salt", made(box(40, 40, 40), [dark], 0.6, [SKY, NOON], 120, 80, 16), (0.03, 0.08)
    yield "+white sky", made(heap(folder, 30, 30), [sand], 0.4, [WHITE], 100, 50, 8, floor=True), (0.02, 0.05)
    yield "+sugar centres", made(box(30, 30, 10), [sugar], 0.6, [SKY, BEHIND], 80, 30, 4, inside="centres"), (0.05, 0.1)
    yield "+dilute snow", made(ball(40), [snow], 0.1, [SKY, NOON], 250, 90, 38, 25), (0.03, 0.06)
    yield "+glass grazing", made(box(60, 60, 8), [glass], 0.5, [SKY, LOW_SUN], 60, 10, 4, 40, True), (0.03, 0.1)
    yield "++plates backlit", made(box(50, 8, 40), [plates], 0.3, [SKY, BEHIND], 110, 30, 20), (0.05, 0.1)
    yield "++glass sheet", made(box(80, 80, 4), [glass], 0.4, [SKY, NOON], 90, 70, 2, floor=True), (0.03, 0.06)
    yield "++salt heap", made(heap(folder, 25, 12), [salt], 0.6, [WHITE], 90, 40, 4, floor=True), (0.02, 0.05)
    yield "++brown ball", made(ball(25), [brown], 0.5, [SKY, NOON], 150, 50, 24), (0.04, 0.1)
    yield "++sand and glass", made(box(35, 35, 20), [most, some], 0.5, [SKY, LOW_SUN], 90, 60, 8), (0.04, 0.1)
    yield "++quartz far", made(ball(60), [quartz], 0.6, [SKY, LOW_SUN], 600, 200, 58, 22), (0.02, 0.05)
    yield "++snow wall", made(box(60, 20, 60), [fresh], 0.5, [SKY, NOON], 45, 40, 30, 35), (0.05, 0.1)
    yield "++dilute salt", made(ball(18), [salt], 0.08, [SKY, BEHIND], 90, 20, 18, 30), (0.03, 0.08)
    # fmt: on


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

    def error(self, seconds: float) -> float:
        return math.sqrt(max(self.square, 0.0) + self.variance * self.turn / seconds)

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
        after = found[Candidate("explicit")].seconds(target)
    by = {p.candidate: p for p in made.predictions}
    ratios = {str(c): by[c].error(after) / m.error(after) for c, m in found.items() if c in by}
    floors = {str(c): by[c].floor.value / m.floor for c, m in found.items() if c in by and m.resolved}
    turns = {str(c): by[c].variance * by[c].turn / (m.variance * m.turn) for c, m in found.items() if c in by}
    takes = {c: m.seconds(target) for c, m in found.items()}
    low, high = ({c: m.seconds(target, shift) for c, m in found.items()} for shift in (-1.0, 1.0))
    best = min(takes, key=lambda c: takes[c])
    own = found.get(chosen.candidate)
    mine = takes[chosen.candidate] if own is not None else math.nan
    return {
        "target": target, "chosen": str(chosen.candidate), "best": str(best), "takes": mine, "best_takes": takes[best],
        "over": mine / takes[best], "over_at_least": low.get(chosen.candidate, math.nan) / min(high.values()),
        "errors": ratios, "floors": floors, "costs": turns, "planning": made.spent, "why": list(made.why),
    }  # fmt: skip


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
            if args.only and not name.startswith(tuple(args.only.split(","))):
                continue
            scene = parse(data, name=name)
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
