"""Reports: what a plan says of itself, in three lines, as a table and as facts."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tsdf.plan.choice import Wish, choose, swamped
from tsdf.plan.prediction import BLOCK, UNFINISHED, Plan, Prediction
from tsdf.plan.prior import Body

TARGETS = np.geomspace(0.002, 0.5, 120)  # [1] that are tried for what would change a plan's mind
BUSY = 1.5  # times as long as on processors that have nothing else to do, from which on it is said
MEANINGFUL = 0.5  # [1] above which the error of a pixel says little: a few glints make it
HELPS = 2.0  # times as much error as under a wider sun there has to be for that to be said
ABOVE = 1.05  # times the target, that an error may have to be for it to be said
OTHER = 1.2  # times as high or low as its target, from which on another target is another wish


def why(plan: Plan, bodies: Sequence[Body], footprint: float, coverage: float, reference: str) -> tuple[str, ...]:
    """Return three lines: what is taken and what it does, why, and what would change that."""
    return (_first(plan), _reason(plan, bodies, footprint, coverage, reference), _other(plan))


def short(prediction: Prediction) -> str:
    """Return a candidate and its parts in one phrase."""
    p = prediction
    if not p.floor.high:
        return f"{p.candidate} has neither bias nor missing texture"
    return (
        f"{p.candidate} has a bias of {within(p.bias, p.bias_error)} % and misses texture of "
        f"{within(p.texture, p.texture_error)} %"
    )


def percent(value: float) -> str:
    """Return a share in per cent with two digits."""
    return f"{digits(100.0 * value)} %" if math.isfinite(value) else "not known"


def within(value: float, error: float) -> str:
    """Return a share and its error in per cent, of as many digits as the error allows: two of its own, but no more than
    three behind the point."""
    value, error = 100.0 * value, 100.0 * error
    if not (math.isfinite(value) and math.isfinite(error)):
        return "not known"
    if not error > 0.0:
        return f"{digits(value)} ± 0"
    last = min(1 - math.floor(math.log10(error)), 3)  # digit behind the point
    return f"{_rounded(value, last)} ± {_rounded(error, last)}"


def _rounded(number: float, last: int) -> str:
    number = round(number, last) + 0.0  # no -0
    return f"{number:.{max(last, 0)}f}"


def digits(number: float) -> str:
    """Return a number with two digits, however large."""
    return f"{number:.2g}" if abs(number) < 99.5 else f"{float(f'{number:.2g}'):.0f}"


def span(seconds: float) -> str:
    """Return a time as one reads it."""
    if math.isinf(seconds):
        return "no time"
    if seconds < 0.01:
        return "less than .01 s"
    if seconds < 100.0:
        return f"{seconds:.2g} s"
    for unit, size in (("min", 60.0), ("h", 3600.0)):
        if seconds < 100.0 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds / 86400.0:.3g} days"


def by_clock(plan: Plan, seconds: float) -> str:
    """Return how long it takes on processors as busy as they are now, what free ones do in so long [s]."""
    return span(seconds * plan.load)


def _about(plan: Plan, seconds: float) -> str:
    said = by_clock(plan, seconds)
    return said if said.startswith("less") else f"about {said}"


def _first(plan: Plan) -> str:
    p = plan.chosen
    far = ", fewer where a pixel covers more" if plan.fewer_far else ""
    takes = p.done(plan.target)
    if math.isinf(p.variance):
        return f"take {p.candidate}{far}: nothing is known of its noise"
    if plan.spp is not None:
        after = f"an error of {percent(p.error(p.turn * plan.spp))}"
        after += f" with {plan.spp} samples per pixel"
        met = f"{percent(p.floor.value)} of it is not noise"
    elif plan.seconds is not None and plan.able is not None:
        after = f"an error of {percent(p.error(plan.able))} after {span(plan.seconds)}"
        met = f"none is sure to meet {percent(plan.target)} then; {_left(plan, plan.able)}"
        if takes <= plan.able:
            met = f"{percent(plan.target)} after {_about(plan, takes)}"
    elif math.isinf(takes):
        after, met = f"an error of {percent(p.floor.value)} at best", f"none is sure to meet {percent(plan.target)}"
    else:
        after = f"an error of {percent(plan.target)} after {_about(plan, takes)}"
        met = f"noise {percent(plan.noise)}"
    if (blocks := _of_blocks(plan)) is not None:
        met += f"; means of {BLOCK} by {BLOCK} pixels are off by {blocks}"
    if (most := _at_most(plan)) is not None:
        met += f"; up to {percent(most)} as far as is known"
    if p.floor.error > p.floor.value > plan.target:
        met += f"; {within(p.floor.value, p.floor.error)} % is expected, not measured"
    return f"take {p.candidate}{far}: {after} ({met})"


def _at_most(plan: Plan) -> float | None:
    """Return how large the error of a picture may be that is done when it is likely to have the target, where that is
    more."""
    p = plan.chosen
    takes = p.done(plan.target)
    if plan.spp is not None or math.isinf(takes) or (plan.able is not None and takes > plan.able):
        return None
    most = math.hypot(p.noise(takes), p.floor.high) if takes else p.floor.high
    return most if most > ABOVE * plan.target else None


def _left(plan: Plan, able: float) -> str:
    """Return what decides in a time in which no candidate meets the target."""
    said = []
    if plan.glints:
        said.append(f"single grains would be mostly noise until {span(plan.glints)} and are left out")
    if plan.regional:
        off = percent(plan.chosen.error_of_regions(able))
        said.append(f"means of {BLOCK} by {BLOCK} pixels are off by {off}, about the least")
    return "; ".join(said) or "no other that was looked at is likely to have a tenth less"


def wider_sun(plan: Plan) -> str | None:
    """Return how wide suns would have to be for single grains, where these are left out because they meet suns too
    seldom, by what pilots have seen under wider ones; None where that would not help."""
    real, wide = plan.suns
    if plan.able is None or plan.chosen.candidate.single or not plan.rarer > 1.0:
        return None
    ways = []
    for p in plan.predictions:
        if p.candidate.single and p.piloted and 0.0 < p.variance < math.inf:
            noise = p.variance / plan.rarer * p.turn / plan.able  # squared, under the suns of pilots
            more = min(max((plan.target**2 - p.floor.value**2) / noise, 1.0), plan.rarer)  # as it may be
            error = max(math.hypot(p.floor.value, math.sqrt(more * noise)), plan.target)
            degrees = wide * (real / wide) ** (math.log(more) / math.log(plan.rarer))
            ways.append((round(error, 6), degrees, str(p.candidate)))
    if not ways:
        return None
    error, degrees, which = min(ways)
    if error > UNFINISHED or HELPS * error > plan.chosen.error(plan.able):
        return None
    return (
        f"single grains meet a sun of {real:.2g} degrees too seldom to be taken; with angular_diameter_deg = "
        f"{digits(degrees)}, as bright, {which} would show them, with an error of about {percent(error)} after "
        f"{span(plan.seconds or 0.0)}"
    )


def _of_blocks(plan: Plan) -> str | None:
    """Return the error of means of many pixels, where that of one is so large that it says little."""
    p = plan.chosen
    seconds = p.turn * plan.spp if plan.spp is not None else plan.able
    if seconds is None:
        seconds = p.seconds(plan.target)
    if plan.regional or not (seconds > 0.0 and p.error(seconds) > MEANINGFUL):
        return None
    return percent(p.error_of_blocks(seconds, plan.grain))


def to_noise(plan: Plan, noise: float) -> str:
    """Return the first line of a plan for a picture that is done at a noise of its pixels, whatever it misses."""
    p = plan.chosen
    if not 0.0 < p.variance < math.inf:
        return _first(plan)
    after = _about(plan, p.seconds(noise, 0.0))
    missed = f"beside which it misses {percent(p.floor.value)}" if p.floor.high else "and nothing else is wrong"
    return f"take {p.candidate}: noise of {percent(noise)} after {after}, {missed}"


def _reason(plan: Plan, bodies: Sequence[Body], footprint: float, coverage: float, reference: str) -> str:
    chosen = plan.chosen
    if not bodies:
        return "because there are no grains in the scene, and all levels are the same"
    body = max(bodies, key=lambda one: one.thickness)
    seen = f"a pixel covers {footprint:.2g} R of grains" if math.isfinite(footprint) else "it sees no grains,"
    many = digits(body.thickness / body.transport)
    thick = f"{digits(body.thickness)} R or {many} transport length{'s' * (many != '1')}"
    which = f", the thickest of {len(bodies)}" if len(bodies) > 1 else ""
    of = f"{100.0 * body.packing_fraction:.3g} % of a body{which}, 2 V/S = {thick}"
    where = f"{seen} that fill {of}"
    after = plan.able if plan.able is not None else chosen.seconds(plan.target)
    if plan.spp is not None:
        after = chosen.turn * plan.spp
    after = after if 0.0 < after < math.inf else 1.0
    noise = chosen.noise(after)
    faster = [p for p in plan.predictions[1:] if p.noise(after) < noise and p.floor.high > 0.0]
    nearest = min((p for p in faster if p.floor.high > chosen.floor.high), key=lambda p: p.floor.value, default=None)
    than = f"; {short(nearest)}, and is faster to the same noise" if nearest is not None else ""
    unseen = [p for p in faster if not p.piloted and p.floor.value < chosen.floor.value]
    best = min(unseen, key=lambda p: p.floor.high, default=None)
    than += f"; {best.candidate} may be faster and miss less, but no pilot has seen it" if best is not None else ""
    return f"because {where}; {short(chosen)}{than or '; nothing takes less'}"


def _other(plan: Plan) -> str:
    if len(plan.predictions) < 2:
        return "no other candidate is possible"
    if plan.able is not None and plan.spp is None and not plan.chosen.done(plan.target) <= plan.able:
        return _short_of_time(plan, plan.able)
    chosen = plan.chosen
    second = min(plan.predictions[1:], key=lambda p: (p.sure_seconds(plan.target), p.floor.value))
    takes = second.sure_seconds(plan.target)
    runner = f"runner-up: {second.candidate}, {by_clock(plan, takes)}" if math.isfinite(takes) else (
        f"runner-up: {second.candidate}, error {percent(second.floor.value)} at best"
    )  # fmt: skip
    if math.isfinite(takes) and takes < chosen.sure_seconds(plan.target) and _at_most(plan) is not None:
        runner += ", which is surer"
    flips = {}
    for target in TARGETS:
        best = choose(list(plan.predictions), Wish(float(target), math.inf))[0]
        if best is not chosen and math.isfinite(best.done(float(target))):
            flips[float(target)] = best
    lower = [t for t in flips if OTHER * t < plan.target]
    upper = [t for t in flips if t > OTHER * plan.target]
    changes = []
    if lower:
        changes.append(f"a target below {percent(max(lower))} ({flips[max(lower)].candidate})")
    if upper:
        changes.append(f"{'one' if lower else 'a target'} above {percent(min(upper))} ({flips[min(upper)].candidate})")
    return (
        f"{runner}; {' or '.join(changes)} would change this"
        if changes
        else f"{runner}; no other target would change this"
    )


def _short_of_time(plan: Plan, able: float) -> str:
    assert plan.seconds is not None
    known = [p for p in plan.predictions[1:] if math.isfinite(p.variance)] or plan.predictions[1:]
    done = [p for p in known if not (plan.glints and p.candidate.single and p.noise(able) > UNFINISHED)] or known
    if plan.regional:
        second = min(swamped(done, able) or done, key=lambda p: p.error_of_regions(able))
        off = percent(second.error_of_regions(able))
        runner = f"runner-up: {second.candidate}, an error of {percent(second.error(able))}, of such means {off}"
    else:
        second = min(done, key=lambda p: p.likely_error(able))
        runner = f"runner-up: {second.candidate}, an error of {percent(second.error(able))} then"
        alike = math.hypot(plan.chosen.floor.error, second.floor.error)
        if abs(second.error(able) - plan.chosen.error(able)) < alike:
            runner += ", which is the same as far as can be told"
    best = min(plan.predictions, key=lambda p: p.safe_seconds(plan.target))
    takes = best.safe_seconds(plan.target)
    if not math.isfinite(takes):
        return f"{runner}; no time is known to be enough for {percent(plan.target)}"
    more = f"{best.candidate} and {by_clock(plan, takes)} instead of {span(plan.seconds)}"
    return f"{runner}; {percent(plan.target)} would take {more}"


def table(plan: Plan) -> list[str]:
    """Return a table of all candidates as lines of text."""
    after = plan.able
    head = ["candidate", "bias %", "texture %", "error at best %", f"time to {percent(plan.target)}"]
    head += [f"error after {span(plan.seconds)}"] if plan.seconds is not None else []
    rows = [[*head, "by"]]
    for p in plan.predictions:
        row = [
            str(p.candidate),
            within(p.bias, p.bias_error),
            within(p.texture, p.texture_error),
            within(p.floor.value, p.floor.error),
            _when(plan, p),
        ]
        row += [percent(p.error(after))] if after is not None else []
        rows.append([*row, "pilot" if p.piloted else "others"])
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _when(plan: Plan, p: Prediction) -> str:
    takes = p.seconds(plan.target)
    if math.isinf(p.variance):
        return "not known"
    return by_clock(plan, takes) if math.isfinite(takes) else "never"


def facts(plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON takes it; what is infinite is null."""

    def number(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return {
        "scene": plan.scene.name,
        "target": plan.target,
        "seconds": plan.seconds,
        "threads": plan.threads,
        "load": round(plan.load, 2),
        "chosen": chosen_facts(plan),
        "why": list(plan.why),
        "needs": list(plan.needs),
        "notes": list(plan.notes),
        "planning_seconds": round(plan.spent, 2),
        "planning_clock_seconds": round(plan.clock, 2),
        "candidates": [
            {
                "level": p.candidate.level,
                "explicit_grains": p.candidate.explicit_grains,
                "leap": p.candidate.leap,
                "bias": p.bias,
                "bias_error": p.bias_error,
                "texture": p.texture,
                "texture_error": p.texture_error,
                "floor": p.floor.value,
                "floor_error": p.floor.error,
                "variance_of_a_sample": number(p.variance),
                "seconds_per_sample_of_all_pixels": number(p.turn),
                "noise": number(p.noise(plan.able)) if plan.able is not None else None,
                "error": number(p.error(plan.able)) if plan.able is not None else None,
                "seconds_to_target": number(p.seconds(plan.target)),
                "piloted": p.piloted,
                "known": p.known,
            }
            for p in plan.predictions
        ],
    }


def chosen_facts(plan: Plan) -> dict[str, Any]:
    """Return what is taken, as JSON takes it."""
    one = plan.chosen.candidate
    return {
        "level": one.level,
        "explicit_grains": one.explicit_grains,
        "fewer_far": plan.fewer_far,
        "leap": one.leap,
        "target": plan.target,
        "noise": plan.noise,
    }


def options(plan: Plan) -> str:
    """Return the options of ``tsdf-render`` that name what is chosen."""
    one = plan.chosen.candidate
    words = f"--level {one.level}"
    if one.explicit_grains:
        words += f" --explicit-grains {one.explicit_grains}" + "-0" * plan.fewer_far
    if one.leap is not None:
        words += f" --leap {one.leap:g}"
    return words


def notes(plan: Plan) -> tuple[str, ...]:
    """Return what ``tsdf-render`` says of a plan: what it takes, how to have the same again, why, what it does not
    know."""
    again = f"to have the same again without planning: {options(plan)}"
    return f"level auto: {plan.why[0]}", again, *plan.why[1:2], *plan.notes, *plan.needs
