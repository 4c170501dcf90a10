"""Plans against what they predict: scenes that nothing was fitted to, rendered long at every candidate.

    python benchmarks/bench_plan.py [--only BEGINNING,..] [--drawn FIRST:LAST] [--glints FIRST:LAST]
        [--truth SECONDS] [--truths FOLDER [--no-plans]] [--suns DEGREES] [--out FILE.json]

The truth of a scene is level explicit over its own packing; what candidates really cost and get wrong is taken in
`plan_truths`, where choices are decided, for so many seconds of a processor a scene, and kept in a folder, if one is
given: then plans can be judged again in their own 5 seconds. Suns are 6 degrees wide at least, in plans as well: single
grains meet smaller ones too seldom for the truth to be known. Printed are predicted over measured errors after the time
that the plan names, how far what was measured lies outside the error bars of what was said, and what the chosen takes
over the cheapest, or where none meets the target its error over the least. Times are processor times.
"""

import argparse
import json
import math
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from plan_draws import drawn, glinting
from plan_scenes import scenes
from plan_truths import EXPLICIT, Measured, Truth, kept_in

from tsdf.plan import pilot
from tsdf.plan.planner import PATIENCE, plan
from tsdf.plan.prediction import Plan
from tsdf.scene.scene import Scene, SunLight, parse
from tsdf.study.candidates import Candidate

THREADS = min(2, os.cpu_count() or 1)
SHIFTS = (0.0, -2.0, -1.0, 1.0, 2.0)  # standard errors
NOTHING = 1e-9  # [1] of variance of a sample: clear grains before a white sky
FREE = pilot.Clocks(wall=lambda: 0.0)  # plans are for free processors, however busy these are
WIDER = 6.0  # [deg] that suns have at least, for single grains meet smaller ones by chance alone


def widened(scene: Scene, least: float = WIDER) -> Scene:
    """Return a scene whose suns are as bright, but not so small that single grains hardly ever meet them [deg]."""
    suns = [isinstance(light, SunLight) and light.angular_diameter_deg < least for light in scene.lights]
    lights = (
        replace(light, angular_diameter_deg=least) if small else light
        for light, small in zip(scene.lights, suns, strict=True)
    )
    return replace(scene, lights=tuple(lights)) if any(suns) else scene


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
    bars = {  # by how many standard errors of both what was measured is off from what was said
        str(c): (by[c].floor.value - m.floor) / math.hypot(by[c].floor.error, m.floor_error)
        for c, m in found.items() if c in by and by[c].floor.error > 0.0
    }  # fmt: skip
    floors = {str(c): by[c].floor.value / m.floor for c, m in found.items() if c in by and m.resolved}
    turns = {
        str(c): by[c].noise(after) ** 2 * after / (m.variance * m.turn)
        for c, m in found.items() if c in by and m.variance > NOTHING
    }  # fmt: skip
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
        "errors": ratios, "near": near, "floors": floors, "bars": bars, "costs": turns, "planning": made.spent,
        "why": list(made.why),
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
    parser.add_argument("--truths", type=Path, help="folder where what is measured of scenes is kept and taken on from")
    parser.add_argument("--truth", type=float, default=60.0, help="seconds of a processor that a scene's truth takes")
    parser.add_argument("--no-plans", action="store_true", help="measure only")
    parser.add_argument("--suns", type=float, default=WIDER, help="degrees that suns have at least")
    parser.add_argument("--out", type=Path, help="JSON of all numbers")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    pilot.LATE = math.inf  # processors that others use, too, are waited for
    with tempfile.TemporaryDirectory() as folder:
        for name, data, targets in asked_for(args, Path(folder)):
            scene = widened(parse(data, name=name), args.suns)
            plans = [] if args.no_plans else [(t, plan(scene, t, threads=THREADS, clocks=FREE)) for t in targets]
            truth = Truth(scene, targets, kept_in(args.truths, name, data, args.suns))
            truth.take(args.truth, [one.chosen.candidate for _, one in plans])
            found = truth.measured(THREADS)
            if EXPLICIT not in found:
                print(f"{name}: no level explicit, and so no truth", flush=True)
                continue
            if found[EXPLICIT].variance < NOTHING:
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
                tail = f" {100 * m.largest:.0f} % in 1 %" if m.resolved else ""
                shown = f"{100 * m.floor:6.2f}+{100 * m.floor_error:.2f} % bias {100 * m.bias:+.2f}{tail}"
                print(f"    {c!s:24s} {shown} | {told}", flush=True)
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
        bars = [abs(z) for row in some for z in row["bars"].values()]
        shares = [100.0 * sum(z <= n for z in bars) / max(len(bars), 1) for n in (1.0, 2.0)]
        print(f"{title}: floors within one, two standard errors: {shares[0]:.0f} %, {shares[1]:.0f} % of {len(bars)}")
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
