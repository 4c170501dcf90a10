"""Results of `frontier`: JSON to draw from again, CSV with a line for each candidate, and a report in Markdown.

The JSON holds the runs and, for other programs, what follows from them. Of each candidate: `seconds_per_sample` [s],
processor time of one sample of one pixel; `noise_seconds` [s], noise squared times processor time of the picture,
`square`, `bias` by region, `texture_square` and `flip`, each [value, standard error]; `floor`: value, low, high (95 %)
and whether it is seen, else an upper limit; `bytes`. All errors are over the truth's mean. Of the truth's own level
all this is a control: its floor is 0.
"""

import csv
import io
import json
import math
import os
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tsdf.errors import TSDFError
from tsdf.scene.levels import LEVELS
from tsdf.study.candidates import Candidate
from tsdf.study.frontier import Frontier, Measured
from tsdf.study.ranking import CONFIDENCE, Pair, best, mean_of, places, ranked

FORMAT = "tsdf-frontier 1"
TIMES = (0.1, 1.0, 10.0, 100.0, 1000.0, 10000.0)  # [s] of a processor, at which the best is named
COLUMNS = 120  # of a screen
TARGET = 0.01  # relative standard error of pixels to which times are given


def facts(row: Measured) -> dict[str, Any]:
    """Return what follows from the runs of a candidate."""
    return {
        "name": str(row.candidate),
        "seconds_per_sample": row.seconds_per_sample,
        "noise_seconds": list(mean_of(row.noise_seconds)),
        "square": list(mean_of(row.squares)),
        "floor": dict(row.floor._asdict()),
        "texture_square": [value if math.isfinite(value) else None for value in row.texture_square],
        "bias": {name: list(mean_of(values)) for name, values in row.bias.items()},
        "flip": list(mean_of(row.flip)),
    }


def json_text(frontier: Frontier) -> str:
    """Return the results as JSON."""
    f = frontier
    held = {
        "format": FORMAT,
        "scene": f.scene,
        "width": f.width,
        "height": f.height,
        "seed": f.seed,
        "asked": f.asked,
        "truth": {
            "level": f.truth, "samples": f.truth_samples, "seconds": list(f.truth_seconds), "noise": list(f.truth_noise)
        },
        "regions": dict(f.regions),
        "candidates": [
            facts(row)
            | {
                "level": row.candidate.level,
                "explicit_grains": row.candidate.explicit_grains,
                "leap": row.candidate.leap,
                "samples": row.samples,
                "pixels": row.pixels,
                "bytes": row.bytes,
                "lost": row.lost,
                "runs": {
                    "seconds": list(row.seconds),
                    "noise": list(row.noise),
                    "squares": list(row.squares),
                    "flip": list(row.flip),
                    "bias": {name: list(values) for name, values in row.bias.items()},
                    "curve": [[spent, list(values)] for spent, values in row.curve],
                },
            }
            for row in f.rows
        ],
        "notes": list(f.notes),
    }  # fmt: skip
    return json.dumps(held, indent=1, allow_nan=False) + "\n"


def read(path: str | os.PathLike[str]) -> Frontier:
    """Return results that were written as JSON.

    Raises
    ------
    TSDFError
        In one line, for a file that cannot be read or does not hold such results.
    """
    name = os.fspath(path)
    try:
        with open(path, encoding="utf-8") as file:
            held = json.load(file)
        if held["format"] != FORMAT:
            raise TSDFError(f"{name}: has the format {held['format']!r:.50}, not {FORMAT!r}; measure the scene again")
        rows = tuple(_row(one) for one in held["candidates"])
        found = Frontier(
            scene=_text(held["scene"]),
            width=_whole(held["width"], 1),
            height=_whole(held["height"], 1),
            seed=_whole(held["seed"]),
            truth=_level(held["truth"]["level"]),
            truth_samples=_whole(held["truth"]["samples"], 1),
            truth_seconds=_numbers(held["truth"]["seconds"]),
            truth_noise=_numbers(held["truth"]["noise"]),
            regions=dict(zip(held["regions"], _numbers([*held["regions"].values()]), strict=True)),
            rows=rows,
            notes=tuple(map(_text, _listed(held["notes"]))),
            asked=_whole(held["asked"]),
        )
        runs = found.runs
        kept = [(row.seconds, row.noise, row.squares, row.flip, *row.bias.values()) for row in rows]
        kept += [tuple(values for _, values in row.curve) for row in rows]
        if runs < 2 or not rows or any(len(values) != runs for row in kept for values in row):
            raise ValueError("runs")
        if "whole" not in found.regions or any(set(row.bias) != set(found.regions) for row in rows):
            raise ValueError("regions")
    except OSError as error:
        raise TSDFError(f"cannot read {name}: {error.strerror or error}; give results of tsdf-frontier") from error
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        raise TSDFError(f"{name}: does not hold results of tsdf-frontier; measure the scene again") from error
    return found


def _row(one: dict[str, Any]) -> Measured:
    runs = one["runs"]
    leap = one["leap"]
    return Measured(
        candidate=Candidate(
            _level(one["level"]), _whole(one["explicit_grains"]), None if leap is None else _number(leap)
        ),
        samples=_whole(one["samples"], 1),
        pixels=_whole(one["pixels"], 1),
        bytes=_whole(one["bytes"]),
        seconds=_numbers(runs["seconds"]),
        noise=_numbers(runs["noise"]),
        squares=_numbers(runs["squares"]),
        bias={name: _numbers(values) for name, values in runs["bias"].items()},
        flip=_numbers(runs["flip"]),
        curve=tuple((_number(spent), _numbers(values)) for spent, values in runs["curve"]),
        lost=_whole(one["lost"]),
    )


def _level(name: str) -> str:
    if name not in LEVELS:
        raise ValueError(name)
    return name


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("not a text")
    return value


def _listed(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError("not a list")
    return value


def _whole(value: Any, least: int = 0) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ValueError("not such a whole number")
    return value


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError("not a finite number")
    return float(value)


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(map(_number, _listed(values)))


# ----------------------------------------------------------------------------------------------- reports


def csv_text(frontier: Frontier) -> str:
    """Return a line of comma-separated values for each candidate; errors are shares of 1."""
    lines = []
    for row, (first, last) in zip(frontier.rows, places(len(frontier.rows), _pairs(frontier)), strict=True):
        one, floor = facts(row), frontier.floor(row)
        line: dict[str, Any] = {
            "candidate": one["name"],
            "level": row.candidate.level,
            "explicit_grains": row.candidate.explicit_grains,
            "runs": frontier.runs,
            "samples": row.samples,
            "seconds_per_sample": one["seconds_per_sample"],
            "noise_seconds": one["noise_seconds"][0],
            "noise_seconds_error": one["noise_seconds"][1],
            "bytes": row.bytes,
            "floor": floor.value,
            "floor_low": floor.low,
            "floor_high": floor.high,
            "floor_seen": int(floor.seen),
            "first_place": first,
            "last_place": last,
            "square": one["square"][0],
            "square_error": one["square"][1],
            "texture_square": one["texture_square"][0],
            "texture_square_error": one["texture_square"][1],
            "flip": one["flip"][0],
            "flip_error": one["flip"][1],
        }
        for name, (value, error) in one["bias"].items():
            line |= {f"bias_{name.replace(' ', '_')}": value, f"bias_{name.replace(' ', '_')}_error": error}
        lines.append(line | {"lost_paths": row.lost})
    text = io.StringIO()
    writer = csv.DictWriter(text, lines[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def markdown(frontier: Frontier) -> str:
    """Return the report: what was measured, the table, the best by time, the ranking, notes."""
    f = frontier
    heads, *rows = _table(f)
    text = [
        f"# {_cell(f.scene)}: error against processor time",
        "",
        *_measured(f),
        "",
        f"| {' | '.join(heads)} |",
        "|---" * len(heads) + "|",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        "Errors in % of the truth's mean, in brackets the standard error of the last digits, from the spread of the",
        "runs. Floor: root mean square over pixels of what is left when all noise is gone, bias and texture, with its",
        "interval of 95 %; `<`: no more than noise, below this with 95 %. Texture: the floor without the whole's bias.",
        "Bias of a region: over the truth's mean there. FLIP: HDR-FLIP of a run's picture to the truth's, with",
        f"the noise of both. Seconds to {100.0 * TARGET:g} %: processor time until pixels have no more noise. Place:",
        "by the floor. What was measured of the truth's own level is a control: all but its noise should be 0.",
        "",
        *_by_time(f),
        "",
        *_ranking(f, "floor", _pairs(f), lambda pair: f"{100.0 * gap(f, pair):.2g}"),
        "",
        *_ranking(
            f, "bias of the whole", ranked(f.biases(), sizes=True),
            lambda pair: f"{100.0 * (pair.difference + pair.within):.2g}",
        ),
    ]  # fmt: skip
    if f.notes:
        text += ["", "## Notes", "", *(f"- {_cell(note)}" for note in f.notes)]
    return "\n".join(text) + "\n"


def terminal(frontier: Frontier, file: str) -> str:
    """Return what a screen shows of the report in `file`: its table, without the columns that do not fit, and notes."""
    table = _table(frontier)
    lines = _aligned(table)
    regions = [f"bias, {name} [%]" for name in reversed(list(frontier.regions)) if name != "whole"]
    for name in (*regions, "texture [%]", "kB"):
        if max(map(len, lines)) > COLUMNS:
            place = table[0].index(name)
            table = [row[:place] + row[place + 1 :] for row in table]
            lines = _aligned(table)
    last = f"All of it, with what the columns are and how candidates rank: {file}"
    text = [frontier.scene, *_wrapped(_measured(frontier)), "", *lines, "", *_wrapped([*frontier.notes, last])]
    return "\n".join(text) + "\n"


def _wrapped(lines: Sequence[str]) -> list[str]:
    wrap = textwrap.TextWrapper(COLUMNS, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return [part for line in lines for part in wrap.wrap(line)]


def _aligned(table: Sequence[Sequence[str]]) -> list[str]:
    wide = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(f"{cell:{w}s}" for cell, w in zip(row, wide, strict=True)).rstrip() for row in table]


def _measured(f: Frontier) -> list[str]:
    pixels = math.sqrt(float(np.mean(np.square(f.truth_noise))))
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in f.regions.items() if name != "whole")
    return [
        f"{f.width} x {f.height} pixels, {f.runs} runs, a packing each, {f.spent:.0f} s of processor time."
        + f" **Interrupted: {f.asked} runs were asked for.**" * (f.runs < f.asked),
        f"Truth: {f.truth}, its pixels known to {100.0 * pixels:.2g} % in a run. Regions: {shares or 'one'}."
        + f" **Not grain by grain: what {f.truth} gets wrong, texture above all, is in no error here.**"
        * (not LEVELS[f.truth].traits.packed),
    ]


def _table(f: Frontier) -> list[list[str]]:
    """Return the heads of the table and its rows, as many cells each."""
    regions = list(f.regions)
    heads = ["candidate", "place", "floor [%]", "texture [%]", *(f"bias, {name} [%]" for name in regions), "FLIP",
             "us per sample", f"s to {100.0 * TARGET:g} %", "kB"]  # fmt: skip
    lines = [heads]
    for row, (first, last) in zip(f.rows, places(len(f.rows), _pairs(f)), strict=True):
        cells = [
            str(row.candidate),
            f"{first}" if first == last else f"{first}–{last}",
            floor_in_words(f, row),
            _root(*row.texture_square),
            *(
                with_error(100.0 * value, 100.0 * error)
                for value, error in (mean_of(row.bias[name]) for name in regions)
            ),
            with_error(*mean_of(row.flip)),
            f"{1e6 * row.seconds_per_sample:.3g}",
            f"{mean_of(row.noise_seconds).value / TARGET**2:.3g}",
            f"{row.bytes / 1000.0:.3g}",
        ]
        lines.append(cells)
    return lines


def _by_time(f: Frontier) -> list[str]:
    lines = ["| processor time [s] | least error | [%] | not surely worse |", "|---|---|---|---|"]
    for seconds in TIMES:
        squares = f.squared_errors(seconds)
        first, others = best(squares)
        error = math.sqrt(float(squares[first].mean()))
        names = ", ".join(str(f.rows[k].candidate) for k in others)
        lines.append(f"| {seconds:g} | {f.rows[first].candidate} | {100.0 * error:.2g} | {names or 'none'} |")
    return ["## The least error for a time", "", *lines]


def _ranking(f: Frontier, title: str, pairs: Sequence[Pair], unit: Callable[[Pair], str]) -> list[str]:
    """Return who is surely better than whom, and what it takes to tell the others apart; `unit` says by how much a pair
    that is equal may differ."""
    names = [str(row.candidate) for row in f.rows]
    open_ = [pair for pair in pairs if not pair.resolved]
    told = {(pair.better, pair.worse) for pair in pairs if pair.resolved}
    lines = [
        f"## Ranking by the {title}",
        "",
        f"{len(pairs) - len(open_)} of {len(pairs)} pairs are told apart, all together with {100.0 * CONFIDENCE:g} % "
        f"confidence (paired t tests, Holm). `<`: the row has the smaller {title}; `=`: equal within the error.",
        "",
        f"| | {' | '.join(str(k + 1) for k in range(len(names)))} |",
        "|---" * (len(names) + 1) + "|",
    ]
    for i, name in enumerate(names):
        marks = ["" if i == j else "<" if (i, j) in told else ">" if (j, i) in told else "=" for j in range(len(names))]
        lines.append(f"| {i + 1} {name} | {' | '.join(marks)} |")
    if open_:
        lines += ["", "What is equal, by how much it may differ, and more processor time that would tell it apart:", "",
                  "| pair | differ by less than [%] | s more |", "|---|---|---|"]  # fmt: skip
        lines += [
            f"| {names[pair.better]} = {names[pair.worse]} | {unit(pair)} | {more_seconds(f, pair)} |" for pair in open_
        ]
    return lines


def gap(f: Frontier, pair: Pair) -> float:
    """Return by how much the floors of a pair may differ at most, at the confidence of the ranking."""
    squares = [max(float(square), 0.0) for square in f.squares().mean(axis=1)[[pair.better, pair.worse]]]
    most = pair.difference + pair.within
    return most / max(sum(map(math.sqrt, squares)), math.sqrt(most), 1e-300)


def more_seconds(f: Frontier, pair: Pair) -> str:
    """Return how much more processor time would tell a pair apart, in words; as a bound where their difference is
    smaller than its error."""
    more = (pair.times - 1.0) * f.spent
    if not math.isfinite(more):
        return "never"
    return f"{'at least ' if pair.difference < pair.error else ''}{more:.2g}"


def _pairs(f: Frontier) -> list[Pair]:
    return ranked(f.squares())


def floor_in_words(f: Frontier, row: Measured) -> str:
    """Return a floor [%] with its interval, or what it is below."""
    value, low, high, seen = row.floor
    if f.exact(row):
        return "0 (the truth)"
    if not seen:
        return f"< {100.0 * high:.2g}"
    return f"{100.0 * value:.3g} ({100.0 * low:.3g} to {100.0 * high:.3g})"


def _root(square: float, error: float) -> str:
    """Return the root [%] of a square with its error, or what it is below."""
    if not square > 2.0 * error:
        return f"< {100.0 * math.sqrt(max(square, 0.0) + 2.0 * error):.2g}" if math.isfinite(error) else "-"
    return with_error(100.0 * math.sqrt(square), 50.0 * error / math.sqrt(square))


def with_error(value: float, error: float) -> str:
    """Return a number with the standard error of its last digits in brackets: 1.23(4)."""
    if not (math.isfinite(value) and math.isfinite(error)):
        return "-" if not math.isfinite(value) else f"{value:.3g}(?)"
    if error <= 0.0:
        return f"{value:.3g}"
    digits = max(0, 1 - math.floor(math.log10(error)) - (error / 10.0 ** math.floor(math.log10(error)) >= 2.0))
    return f"{value:.{digits}f}({max(1, round(error * 10.0**digits))})"


def _cell(text: str) -> str:
    return text.replace("|", r"\|")
