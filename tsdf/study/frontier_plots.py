"""Charts of a frontier: error against processor time and against bytes, by matplotlib as in `plots`.

A line is the error that the runs imply, the root of floor squared and noise squared, dots are the runs themselves at
fewer samples. What is an upper limit is drawn as one: a floor that is not seen ends its line where the limit begins,
and has an arrow and no dot beside bytes.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.scene.levels import LEVELS
from tsdf.study.frontier import Frontier, Measured
from tsdf.study.plots import STYLE, literal
from tsdf.study.ranking import mean_of

LINES: Any = ("-", "--", ":", "-.")  # by the number of explicit grains, fewest first
WIDTHS = (1.1, 2.4, 0.5)  # of lines, by the least radius of leaps, as the scene says first
ONWARD = 30.0  # how much farther than the measured times a line goes
COLUMNS = 3  # of charts beside each other
MOST_NAMED = 14  # candidates that can all be named beside a chart
STEPS = {1.2: (1.0, 1.5, 2.0, 3.0, 5.0, 7.0), 2.2: (1.0, 2.0, 5.0), 3.5: (1.0, 3.0)}  # of a decade, by decades shown


def plot_frontier(frontier: Frontier) -> Any:
    """Return a matplotlib Figure of one scene: error against processor time, and its floor against bytes."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 5.2), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
        _against_time(left, frontier)
        chosen = named(frontier, *left.get_xlim())
        _names(left, frontier, chosen)
        _against_bytes(right, frontier)
        few = f"; {len(chosen)} of {len(frontier.rows)} named: the best of each time, of each level"
        figure.suptitle(
            f"{_title(frontier)}: error to {frontier.truth}, {frontier.runs} runs, "
            f"{frontier.width} x {frontier.height} pixels{few if len(chosen) < len(frontier.rows) else ''}", fontsize=10
        )  # fmt: skip
        figure.legend(handles=_keys([frontier]), loc="outside lower center", ncols=6, frameon=False, handlelength=2.4)
    return figure


def plot_frontiers(frontiers: Sequence[Frontier]) -> Any:
    """Return a matplotlib Figure of error against processor time in several scenes, side by side."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        columns = min(COLUMNS, len(frontiers))
        rows = -(-len(frontiers) // columns)
        figure = Figure(figsize=(3.7 * columns, 3.1 * rows + 0.9 + 0.5 * (columns < COLUMNS)), layout="constrained")
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, frontier in zip(places, frontiers, strict=False):
            _against_time(axes, frontier)
            axes.set_title(_title(frontier))
        for axes in places[len(frontiers) :]:
            axes.set_axis_off()
        keys, wide = _keys(frontiers), 2 * columns
        figure.legend(handles=keys, loc="outside lower center", ncols=wide, frameon=False, handlelength=2.4)
    return figure


def _against_time(axes: Any, frontier: Frontier) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    times = [spent for row in frontier.rows for spent, _ in row.curve if spent > 0.0]
    low, high = min(times) / 1.4, ONWARD * max(times)
    tops, bottoms = [], []
    for row in frontier.rows:
        style = {"color": LEVELS[row.candidate.level].colour}
        noise, floor = mean_of(row.noise_seconds).value, frontier.floor(row)
        seconds = np.geomspace(low, high, 200)
        error = np.sqrt((floor.value**2 if floor.seen else 0.0) + noise / seconds)
        known = error > (0.0 if floor.seen else floor.high)  # below the limit nobody knows
        axes.plot(seconds[known], 100.0 * error[known], _line(frontier, row), linewidth=_width(frontier, row), **style)
        if not floor.seen and known.any() and floor.high > 0.0:
            end = seconds[known][-1]
            axes.annotate(
                "", (end, 72.0 * floor.high), (end, 100.0 * floor.high), annotation_clip=True,
                arrowprops={"arrowstyle": "->", "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0, **style},
            )  # fmt: skip
        for spent, squares in row.curve:
            value, spread = mean_of(squares)
            if value > 2.0 * spread:
                middle, low_end, high_end = (100.0 * math.sqrt(value + k * spread) for k in (0, -1, 1))
                axes.errorbar(
                    spent, middle, [[middle - low_end], [high_end - middle]], fmt=LEVELS[row.candidate.level].mark,
                    markersize=2.6, elinewidth=0.7, capsize=1.5, **style,
                )  # fmt: skip
                tops.append(100.0 * math.sqrt(value + spread))
        if known.any():
            bottoms.append(100.0 * float(error[known].min()))
    axes.set_xlim(low, high)
    axes.set_ylim(0.6 * min(bottoms, default=1.0), 1.4 * max(tops, default=100.0))
    _decades(axes)
    axes.set_xlabel("processor time [s]")
    axes.set_ylabel("error of pixels, over the mean [%]")


def named(frontier: Frontier, low: float, high: float) -> list[Measured]:
    """Return the candidates whose names a chart from `low` to `high` seconds has room for: all, or if they are many
    those that have the least error at some time, and of each level the one with the least floor.
    """
    rows = frontier.rows
    if len(rows) <= MOST_NAMED:
        return list(rows)
    noise, floors = (
        np.array(of)[:, None]
        for of in ([mean_of(r.noise_seconds).value for r in rows], [frontier.floor(r).value for r in rows])
    )
    errors = np.sqrt(floors**2 + noise / np.geomspace(low, high, 200))
    chosen = set(errors.argmin(axis=0).tolist())
    for level in {row.candidate.level for row in rows}:
        chosen.add(min((k for k, r in enumerate(rows) if r.candidate.level == level), key=lambda k: floors[k, 0]))
    return [row for k, row in enumerate(rows) if k in chosen]


def _names(axes: Any, frontier: Frontier, rows: Sequence[Measured]) -> None:
    """Name the lines beside the axes, with their floors, pushed apart where they are close."""
    bottom, top = axes.get_ylim()
    ends = [100.0 * frontier.floor(row).value for row in rows]
    heights = [math.log(max(end, bottom) / bottom) / math.log(top / bottom) for end in ends]
    order = np.argsort(heights, kind="stable")
    step = min(0.05, 1.0 / max(1, len(order) - 1))
    placed, height = {}, -math.inf
    for k in order:
        height = placed[k] = max(heights[k], height + step)
    over = max(0.0, height - 1.0)
    for k in reversed(order):  # those at the top come down again, and push
        if over > 0.0:
            placed[k] = min(placed[k], height := min(height, 1.0))
            height -= step
    for k, row in enumerate(rows):
        value, seen = 100.0 * row.floor.value, row.floor.seen
        half = 50.0 * mean_of(row.squares).error / max(row.floor.value, 1e-300)
        word = "the truth" if frontier.exact(row) else f"{value:.2g} ± {half:.1g} %" if seen else f"< {value:.2g} %"
        colour = LEVELS[row.candidate.level].colour
        axes.annotate(
            f"{row.candidate}  {word}", (axes.get_xlim()[1], min(max(ends[k], bottom), top)), (1.04, placed[k]),
            "data", "axes fraction", va="center", color=colour, fontsize=7.5,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.4, "relpos": (0.0, 0.5)},
        )  # fmt: skip


def _against_bytes(axes: Any, frontier: Frontier) -> None:
    """Draw floors over the bytes that a candidate draws from."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    fills = dict(zip(_singles([frontier]), ("full", "none", "left", "bottom"), strict=False))
    drawn = [row for row in frontier.rows if not frontier.exact(row) and row.floor.high > 0.0]
    if drawn:  # first, for an arrow alone has no width to be laid out by
        tops = [100.0 * row.floor.high for row in drawn]
        feet = [100.0 * (max(f.low, 0.5 * f.high) if f.seen else 0.7 * f.high) for f in (row.floor for row in drawn)]
        axes.set_ylim(0.7 * min(feet), 1.4 * max(tops))
        sizes = [max(row.bytes, 1) / 1000.0 for row in frontier.rows]  # nothing is drawn from without grains
        axes.set_xlim(min(sizes) / 2.0, 2.0 * max(sizes))
    for row in drawn:
        value, low, high = (100.0 * x for x in row.floor[:3])
        level = LEVELS[row.candidate.level]
        kilobytes = row.bytes / 1000.0
        if row.floor.seen:
            axes.errorbar(
                kilobytes, value, [[value - max(low, 1e-9)], [high - value]], fmt=level.mark, markersize=5, capsize=2,
                elinewidth=0.8, color=level.colour, fillstyle=fills.get(row.candidate.explicit_grains, "full"),
            )  # fmt: skip
        else:
            axes.errorbar(
                kilobytes, high, 0.25 * high, fmt="none", uplims=True, capsize=3, elinewidth=0.8, color=level.colour
            )
    _decades(axes)
    axes.set_xlabel("kilobytes that are drawn from")
    axes.set_ylabel("floor: what time does not mend [%], arrows: below")


def _decades(axes: Any) -> None:
    """Put ticks that have room: 1, 1.5, 2, 3, 5, 7 of each decade where one is shown, and fewer the more there are."""
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        decades = math.log10(high / low)
        steps = next((steps for most, steps in STEPS.items() if decades <= most), (1.0,))
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        every = 1 if decades <= 7.0 else 2
        ticks = [step * 10.0**power for power in powers if power % every == 0 for step in steps]
        axis.set_ticks([tick for tick in ticks if low <= tick <= high])
        axis.set_ticks([], minor=True)
        axis.set_major_formatter("{x:g}")
    axes.grid(linewidth=0.3, alpha=0.5)


def _title(frontier: Frontier) -> str:
    return str(literal(Path(frontier.scene).stem))


def _singles(frontiers: Sequence[Frontier]) -> list[int]:
    return sorted({row.candidate.explicit_grains for frontier in frontiers for row in frontier.rows})


def _line(frontier: Frontier, row: Measured) -> Any:
    return LINES[min(_singles([frontier]).index(row.candidate.explicit_grains), len(LINES) - 1)]


def _leaps(frontiers: Sequence[Frontier]) -> list[float]:
    """Return the least radii of leaps that candidates name."""
    leaps = {row.candidate.leap for frontier in frontiers for row in frontier.rows}
    return sorted(leap for leap in leaps if leap is not None)


def _width(frontier: Frontier, row: Measured) -> float:
    leap = row.candidate.leap
    return WIDTHS[0 if leap is None else min(_leaps([frontier]).index(leap), len(WIDTHS) - 1)]


def _keys(frontiers: Sequence[Frontier]) -> list[Any]:
    """Return what the legend shows: colours and marks are levels, lines are explicit grains, their widths leaps."""
    from matplotlib.lines import Line2D

    shown = {row.candidate.level for frontier in frontiers for row in frontier.rows}
    keys: list[Any] = [
        Line2D([], [], color=level.colour, marker=level.mark, markersize=3.5, label=name)
        for name, level in LEVELS.items() if name in shown
    ]  # fmt: skip
    singles = _singles(frontiers)
    keys += [
        Line2D([], [], color="0.3", linestyle=LINES[min(n, len(LINES) - 1)], label=f"{k} explicit grains first")
        for n, k in enumerate(singles) if k
    ]  # fmt: skip
    keys += [
        Line2D([], [], color="0.3", linewidth=WIDTHS[min(n, len(WIDTHS) - 1)],
               label=f"leaps from {leap:g} on" if leap else "no leaps")
        for n, leap in enumerate(_leaps(frontiers))
    ]  # fmt: skip
    return keys
