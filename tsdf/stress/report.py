"""The stability report as a table for terminals, as Markdown, as CSV and as a picture of the matrix (SVG)."""

import csv
import io
import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby, zip_longest

from tsdf.stress.cells import BEYOND, FAILS, HOLDS, NAIVE, NOT, OURS, REFUSED, TRUTH, UNSURE, WITHIN, Cell, Row
from tsdf.stress.rows import Done, Report

COLUMNS, NARROW = 120, 20  # of a terminal, all; least of each of three: the situation, ours, others
WORDS = {HOLDS: "holds", FAILS: "FAILS", UNSURE: "?", NOT: "-", TRUTH: "truth"}
# To be told apart by all eyes (Okabe & Ito 2008)
COLOURS = {HOLDS: "#56b4e9", FAILS: "#d55e00", UNSURE: "#f0e442", NOT: "#ffffff", TRUTH: "#dddddd", "known": "#e69f00"}
FIELDS = ("group", "row", "title", "figure", "unit", "limit", "method", "ours", "known", "value", "error", "verdict",
          "seconds", "note")  # fmt: skip
READING = (
    "A figure ought to be 0: it is a deviation from the truth, a share of light lost or leaked, or a relative "
    "variance. Its standard error stands in brackets behind it, in units of its last digit; none where it is exact.",
    f"A cell **fails** where the figure is more than {BEYOND:g} standard errors above the row's limit, and **holds** "
    f"where it is {WITHIN:g} below it; else **?**, nobody can tell.",
    "**known** is a failure of ours that is documented, and where; **truth** is what others are held against; **-** "
    "does not apply. No verdict is written down anywhere: each follows from its figure.",
)


def figure(value: float, error: float) -> str:
    """Return a number with its standard error in units of its last digit.

    Examples
    --------
    >>> figure(0.15123, 0.0023), figure(-43.589, 1.4), figure(0.0, 0.0), figure(5.64e-4, 0.0)
    ('0.151(2)', '-43.6(14)', '0', '0.00056')
    """
    if math.isnan(value):
        return ""
    if not error > 0.0 or not math.isfinite(error):
        return f"{value:.2g}" if abs(value) < 100.0 else f"{value:.4g}"
    digits = -math.floor(math.log10(error))
    if error * 10.0**digits < 1.95:
        digits += 1
    digits = max(digits, 0)
    text = f"{value:.{digits}f}"
    return f"{text.lstrip('-') if float(text) == 0.0 else text}({round(error * 10.0**digits)})"


def word(cell: Cell) -> str:
    """Return the verdict in a word."""
    return "known" if cell.known and cell.ours and cell.verdict == FAILS else WORDS[cell.verdict]


def about(row: Row) -> str:
    """Return what a row measures and its limit."""
    unit = f" [{row.unit}]" if row.unit != "1" else ""
    return f"{row.figure}{unit}, at most {row.limit:g}"


def _groups(report: Report) -> Iterable[tuple[str, list[Done]]]:
    for name, some in groupby(report.done, key=lambda one: one.row.group):
        yield name, list(some)


def _said(cell: Cell) -> str:
    return f"{word(cell):5s} {cell.measured.method} {figure(cell.measured.value, cell.measured.error)}".rstrip()


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent="  ", break_on_hyphens=False)


def terminal(report: Report, columns: int = COLUMNS) -> str:
    """Return the report as a table that fits into so many columns, from 66 to 120."""
    width = max(NARROW, (min(columns, COLUMNS) - 6) // 3)
    rule = "-+-".join(["-" * width] * 3)

    def side_by_side(*texts: list[str]) -> list[str]:
        return [" | ".join(f"{t:{width}s}" for t in line).rstrip() for line in zip_longest(*texts, fillvalue="")]

    lines = []
    for name, some in _groups(report):
        lines += [*side_by_side(textwrap.wrap(name, width), ["ours"], ["others"]), rule]
        for one in some:
            left = textwrap.wrap(f"{one.row.name}: {one.row.title}", width)
            left += textwrap.wrap(about(one.row), width, initial_indent="  ", subsequent_indent="  ")
            said = ([_said(c) for c in one.cells if c.ours is ours] for ours in (True, False))
            lines += side_by_side(left, *([line for text in some for line in _wrapped(text, width)] for some in said))
            for note in _noted([cell for cell in one.cells if cell.verdict == NOT]):
                lines += _wrapped(f"- {note}", 3 * width + 6)
            lines.append(rule)
        lines.append("")
    return "\n".join([*lines, *summary(report)])


def summary(report: Report) -> list[str]:
    """Return lines that say what counts."""
    cells = [cell for one in report.done for cell in one.cells if cell.verdict not in (TRUTH, NOT)]
    ours, others = ([c for c in cells if c.ours is mine] for mine in (True, False))

    def count(some: Sequence[Cell]) -> str:
        return ", ".join(
            f"{sum(word(c) == WORDS.get(w, w) for c in some)} {w}" for w in (HOLDS, FAILS, "known", UNSURE)
        )

    lines = [f"ours: {count(ours)}; others: {count(others)}; {sum(one.seconds for one in report.done):.0f} s"]
    for row, cell in report.broken:
        m = cell.measured
        lines.append(
            f"FAILS though it is claimed to hold: {row.name}, {m.method}: {figure(m.value, m.error)}, {about(row)}"
        )
    for row, cell in report.better:
        lines.append(f"holds here, though documented to fail ({cell.known}): {row.name}, {cell.measured.method}")
    lines += [f"cannot be measured: {note}" for note in report.notes]
    if report.interrupted:
        lines.append("interrupted: rows that follow are missing")
    return lines


def markdown(report: Report) -> str:
    """Return the report as Markdown: for each group a matrix, a column for each of ours and one for all others."""
    lines = []
    for name, some in _groups(report):
        seen = {cell.measured.method for one in some for cell in one.cells}
        ours = [method for method in OURS if method in seen]
        lines += [
            f"### {name}",
            "",
            f"| situation | figure | {' | '.join(ours)} | others |",
            "|---" * (len(ours) + 3) + "|",
        ]
        for one in some:
            by = {cell.measured.method: cell for cell in one.cells}
            cells = [_marked(by[method]) if method in by else "" for method in ours]
            rest = "<br>".join(f"{method}: {_marked(cell)}" for method, cell in by.items() if method not in OURS)
            lines.append(f"| `{one.row.name}` {one.row.title} | {about(one.row)} | {' | '.join(cells)} | {rest} |")
        lines += ["", *(f"- {one.row.title}: {'; '.join(said)}." for one in some if (said := _noted(one.cells))), ""]
    return "\n".join(lines)


def _noted(cells: Iterable[Cell]) -> list[str]:
    """Return what was noted beside figures, each note once, with the methods that it is of."""
    notes: dict[str, list[str]] = {}
    for cell in cells:
        if cell.measured.note and cell.verdict != TRUTH:
            notes.setdefault(cell.measured.note, []).append(cell.measured.method)
    return [f"{', '.join(methods)}: {note}" for note, methods in notes.items()]


def _marked(cell: Cell) -> str:
    text = figure(cell.measured.value, cell.measured.error)
    if cell.verdict == TRUTH:
        return f"truth, {cell.measured.note} ± {cell.measured.error:.2g} %"
    if cell.measured.note.startswith(REFUSED):
        return REFUSED
    if cell.verdict in (HOLDS, NOT):
        return f"{word(cell)} {text}".strip()
    return f"**{word(cell)}** {text}"


def notes(report: Report) -> list[str]:
    """Return what of ours fails, a line for each situation and place where it is documented, and what holds there."""
    lines = []
    for one in report.done:
        ours = [cell for cell in one.cells if cell.ours]
        good = [f"`{c.measured.method}`" for c in ours if c.verdict == HOLDS]
        for known in dict.fromkeys(cell.known for cell in ours if cell.verdict == FAILS):
            bad = [c.measured for c in ours if c.verdict == FAILS and c.known == known]
            unit = one.row.unit.replace("1", "")
            said = ", ".join(f"`{m.method}` {figure(m.value, m.error)} {unit}".rstrip() for m in bad)
            file, _, section = known.partition(", ")
            anchor = re.sub(r"[^\w\- ]", "", section.lower()).replace(" ", "-")
            where = f"[{section}]({file}#{anchor})" if known else "**claimed to hold**"
            where = where if known or one.row.claimed else "nothing is claimed"
            lines.append(
                f"- {one.row.title}, {one.row.figure}: {said} ({where}). " + f"Holds: {', '.join(good) or 'none'}."
            )
    return lines


def csv_text(report: Report) -> str:
    """Return all cells, one a line."""
    text = io.StringIO()
    sheet = csv.writer(text, lineterminator="\n")
    sheet.writerow(FIELDS)
    for one in report.done:
        row = one.row
        for cell in one.cells:
            m = cell.measured
            sheet.writerow(
                (row.group, row.name, row.title, row.figure, row.unit, row.limit, m.method, cell.ours, cell.known,
                 f"{m.value:.6g}", f"{m.error:.3g}", cell.verdict, f"{cell.seconds:.2f}", m.note)
            )  # fmt: skip
    return text.getvalue()


LEFT, TOP, WIDE, HIGH, OTHER = (
    290,
    105,
    68,
    18,
    160,
)  # of the picture: margins, cells of ours, width of one of others [px]


def svg(report: Report) -> str:
    """Return the whole matrix as a picture: rows are situations, columns methods of ours, others stand behind them."""
    ours = [m for m in OURS if any(c.measured.method == m for one in report.done for c in one.cells)]
    most = max((sum(not cell.ours for cell in one.cells) for one in report.done), default=0)
    width, height = LEFT + WIDE * len(ours) + OTHER * most + 10, TOP + HIGH * (len(report.done) + 2)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="10">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for k, method in enumerate(ours):
        parts.append(
            f'<text transform="translate({LEFT + WIDE * k + 20},{TOP - 5}) rotate(-40)">{escape(method)}</text>'
        )
    if most:
        parts.append(f'<text x="{LEFT + WIDE * len(ours)}" y="{TOP - 5}">others</text>')
    for j, one in enumerate(report.done):
        y, at = TOP + HIGH * j, LEFT + WIDE * len(ours)
        parts.append(f'<text x="{LEFT - 6}" y="{y + 12}" text-anchor="end">{escape(one.row.title)}</text>')
        for cell in one.cells:
            m = cell.measured
            text = "truth" if cell.verdict == TRUTH else figure(m.value, m.error) or "-"
            if cell.ours:
                x, size = LEFT + WIDE * ours.index(m.method), WIDE
            else:
                x, size, text = at, OTHER, f"{m.method} {text}"
                at += OTHER
            colour = COLOURS["known" if word(cell) == "known" else cell.verdict]
            parts.append(_box(x, y, size - 1, HIGH - 1, colour))
            parts.append(f'<text x="{x + size / 2:g}" y="{y + 12}" text-anchor="middle">{escape(text)}</text>')
    for k, (name, colour) in enumerate(COLOURS.items()):
        x, y = LEFT + 130 * k, TOP + HIGH * len(report.done) + 12
        said = "fails as documented" if name == "known" else name
        parts += [_box(x, y, 12, 12, colour), f'<text x="{x + 16}" y="{y + 10}">{said}</text>']
    return "\n".join([*parts, "</svg>", ""])


def _box(x: float, y: float, width: float, height: float, colour: str) -> str:
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" fill="{colour}" stroke="#888888"/>'


def methods_of(report: Report) -> list[str]:
    """Return the lines of a table that says what the methods are."""
    seen = {cell.measured.method for one in report.done for cell in one.cells}
    sides = [[(m, said) for m, said in some.items() if m in seen] for some in (OURS, NAIVE)]
    pairs = zip_longest(*sides, fillvalue=("", ""))
    return [f"| {mine[0]} | {mine[1]} | {other[0]} | {other[1]} |" for mine, other in pairs]


def page(report: Report, command: str) -> str:
    """Return docs/stress.md."""
    found = notes(report)
    return "\n".join(
        [
            "# Where methods fail",
            "",
            "Rows are situations in which methods of rendering grains fail, columns are methods: ours, and what other",
            f"software does. Measured by `{command}`; this page is what it wrote.",
            "",
            *(f"- {line}" for line in READING),
            "- **refused**: in one line, and so no wrong table is made.",
            "- Exit status 1: one of ours fails where it is claimed to hold. `--quick`, which the tests run, takes",
            "  half a minute, the whole some minutes; the first run on a machine compiles and packs grains first.",
            "",
            "![the matrix](stress.svg)",
            "",
            "## What fails among ours",
            "",
            *(found or ["Nothing."]),
            "",
            "## The matrix",
            "",
            "The first word names the row: `tsdf-stress --rows restart,far` measures those two. Of a table,",
            "`tsdf-stress TABLE`, three rows more are measured: `own-sums`, whether what it holds sums to 1,",
            "`own-furnace`, whether levels keep all light, and `own-slab`, levels against its grains one by one; of",
            "the last nothing is claimed, and exit status 1 never comes from it.",
            "",
            markdown(report).rstrip(),
            "",
            "## Methods",
            "",
            "Others are a few lines of numpy each (`tsdf/stress/`), as textbooks and renderers have them, with nothing",
            "else wrong; reset flights and leaps about p are our own level with one thing taken away.",
            "",
            "| ours | what it is | others | what it is |",
            "|---|---|---|---|",
            *methods_of(report),
            "",
            *(f"{line}  " for line in summary(report)),
            "",
        ]
    )
