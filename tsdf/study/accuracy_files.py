"""Results of `accuracy`: CSV with a row for each number, and a report in Markdown."""

import csv
import io
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields

from tsdf.study.accuracy import Accuracy, Row

TOLD = 3.5  # of its errors that a deviation is more than, where a hundred are looked at


def facts(accuracy: Accuracy) -> list[dict[str, float | str]]:
    """Return the rows as dicts."""
    return [asdict(row) for row in accuracy.rows]


def csv_text(accuracy: Accuracy) -> str:
    """Return the rows as comma-separated values; what there is not is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    for one in facts(accuracy):
        writer.writerow({key: "" if value != value else value for key, value in one.items()})
    return text.getvalue()


def markdown(accuracy: Accuracy) -> str:
    """Return the report: the worst of each level, every number, what they mean, notes."""
    a, text = accuracy, _beginning(accuracy)
    bulk = [row for row in a.rows if row.quantity == "displacement"]
    if bulk:
        text += ["", "## Bulk: mean squared displacement per event", "", *_table(a.levels, bulk, "R^2")]
    for quantity in ("reflectance", "transmittance"):
        some = [row for row in a.rows if row.quantity == quantity]
        if some:
            text += ["", f"## Slabs: {quantity}", "", *_table(a.levels, some, "%", 100.0)]
    profile = [row for row in a.rows if row.quantity == "profile"]
    if profile:
        others = tuple(level for level in a.levels if level != "explicit")
        text += ["", "## Slabs: where light comes back", "", *_profiles(others, profile)]
    text += [
        "",
        "Deviations are from explicit, in % of it, with the standard error of both. Explicit's own error: from its",
        "paths or from the spread over packings, whichever is more; in brackets what packings add to paths, where it",
        f"can be told. Bulk: blocks of {a.block} events. Slabs: centres of grains lie in a layer, light comes at an",
        "angle to the normal, and grains have the albedo. Where light comes back: total variation of its distance",
        "from the beam, to explicit, and what counting alone would give. Time: processor time per event in the bulk",
        "over that of teleport, median of runs in turn.",
    ]
    return "\n".join(text + _notes(a)) + "\n"


def summary(accuracy: Accuracy) -> str:
    """Return the beginning of the report, the worst of each level, and its notes."""
    return "\n".join(_beginning(accuracy) + _notes(accuracy)) + "\n"


def _beginning(a: Accuracy) -> list[str]:
    return [
        "# " + a.name.replace("|", r"\|") + ": levels against packed grains",
        "",
        f"Explicit is the mean of {a.packings} packings, and of slabs from several heights of each."
        + " **Interrupted: not all that was asked for.**" * a.interrupted,
        "",
        *_worst(a),
    ]


def _notes(a: Accuracy) -> list[str]:
    return ["", *(f"- {note}" for note in a.notes)] if a.notes else []


def _worst(a: Accuracy) -> list[str]:
    """Return lines of a table of the largest deviations that are told."""
    lines = [
        f"Of each kind the largest deviation from explicit beyond {TOLD:g} of its errors; where none is, their median:",
        "",
        "| level | bulk [%] | reflectance [%] | transmittance [%] | where it comes back | time per event / teleport |",
        "|---|---|---|---|---|---|",
    ]
    for level in a.levels:
        cells = [level]
        own = [row for row in a.rows if row.level == level]
        for quantity in ("displacement", "reflectance", "transmittance"):
            cells.append(_told([row for row in own if row.quantity == quantity and row.deviation == row.deviation]))
        some = [row for row in own if row.quantity == "profile"]
        far = max(some, key=lambda row: row.value - row.error, default=None)
        cells.append(f"{far.value:.4f} (noise {far.error:.4f})" if far else "-")
        some = [row for row in own if row.quantity == "time"]
        cells.append(f"{some[0].value:.2f} ± {some[0].error:.2g}" if some else "-")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _told(some: Sequence[Row]) -> str:
    told = [row for row in some if abs(row.deviation) > TOLD * row.deviation_error]
    if told:
        return _deviation(max(told, key=lambda row: abs(row.deviation)))
    return f"none told (± {100.0 * statistics.median(row.deviation_error for row in some):.2g})" if some else "-"


def _deviation(row: Row) -> str:
    return f"{100.0 * row.deviation:+.2f} ± {100.0 * row.deviation_error:.2g}"


def _cases(rows: Sequence[Row]) -> Iterator[tuple[str, dict[str, Row]]]:
    """Yield the first cells of a line and its rows by level, for each case."""
    cases: dict[str, dict[str, Row]] = {}
    for row in rows:
        slab = f" | {row.layer:g} | {row.angle_deg:g} | {row.albedo:g}" if row.layer == row.layer else ""
        cases.setdefault(f"{row.fraction:g}{slab}", {})[row.level] = row
    yield from cases.items()


def _head(rows: Sequence[Row], levels: Sequence[str]) -> list[str]:
    case = "f | layer [R] | angle [degrees] | albedo" if rows[0].layer == rows[0].layer else "f"
    columns = [*case.split(" | "), *levels]
    return [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]


def _table(levels: Sequence[str], rows: Sequence[Row], unit: str, scale: float = 1.0) -> list[str]:
    """Return lines of explicit's numbers and the deviations of all others, or their numbers where there is no truth."""
    names = [f"{level} [{unit}]" if level == "explicit" else f"{level} [%]" for level in levels]
    lines = _head(rows, names)
    for case, by_level in _cases(rows):
        cells = [case]
        for level in levels:
            row = by_level.get(level)
            if row is None:
                cells.append("-")
            elif row.deviation == row.deviation:
                cells.append(_deviation(row))
            else:
                cell = f"{scale * row.value:.5g} ± {scale * row.error:.2g}"
                if row.packings_error > 0.0:
                    cell += f" ({scale * row.packings_error:.2g})"
                cells.append(cell if level == "explicit" else f"{cell} {unit}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _profiles(levels: Sequence[str], rows: Sequence[Row]) -> list[str]:
    lines = _head(rows, levels)
    for case, by_level in _cases(rows):
        cells = (f"{r.value:.4f} ({r.error:.4f})" if (r := by_level.get(level)) else "-" for level in levels)
        lines.append(f"| {case} | {' | '.join(cells)} |")
    return lines
