"""Plots: pictures of tables by matplotlib, which is imported only when one is drawn.

Figures are made without pyplot, so nothing global changes, and `save` writes the same bytes for the same table.
"""

import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tsdf.data.blocks import BY_NAME
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.files import replacing
from tsdf.judge import analytic
from tsdf.judge.court import ROUNDING
from tsdf.judge.physics import ZHOU_ETA, reference
from tsdf.scene.levels import LEVELS
from tsdf.study.preview import Preview

SUFFIXES = (".png", ".pdf", ".svg")
DPI = 160
DECADES = 3.0  # range of the colours below the largest density
DENSEST = 1e30  # density shown; cells may be as narrow as numbers are
SHOWN = 0.99  # share of the light whose path lengths are in the picture: the last thousandth of quartz is 384 R long
STRIP = (0.05, 0.10)  # distance from the axis and width of an atom's strip [cos theta]
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.linewidth": 0.7,
    "mathtext.fontset": "dejavusans",
    "svg.hashsalt": "tsdf",
}
COLOURS = {name: level.colour for name, level in LEVELS.items()}
MARKS = {name: level.mark for name, level in LEVELS.items()}
ANGLE_STYLES: Any = (("-", "full"), ("--", "none"))  # of lines and marks, by angle
BAND = 0.18  # opacity of an error's band
LINEAR = 1.0  # [%] deviations up to which an axis is linear, beyond it is logarithmic


def check_suffix(path: str | os.PathLike[str]) -> str:
    """Return the format that a file name asks for, "png", "pdf" or "svg".

    Raises
    ------
    UsageError
        If it is another.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise UsageError(
            f"{os.fspath(path)}: a picture is a .png, .pdf or .svg file, not {suffix or 'without suffix'!r}"
        )
    return suffix[1:]


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure; the same figure gives the same bytes, and a file at `path` is replaced only by a whole one.

    Raises
    ------
    TSDFError
        If the file cannot be written; nothing is left behind.
    """
    import matplotlib

    kind = check_suffix(path)
    unstamped = {
        "png": {"Software": None},
        "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
        "svg": {"Date": None, "Creator": None},
    }
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=DPI, metadata=unstamped[kind])
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def plot_table(table: Table) -> Any:
    """Return a matplotlib Figure of all distributions of a table, as Fig. 1 of Meng et al. 2015.

    p_theta as a density over cos theta, and the conditional densities of phi_Delta, r, z and the path length as
    colours over cos theta. Cells are drawn at their true edges. Light in an atom of cos theta stands in a strip beside
    the axis; path lengths go as far as 99.9 % of the light.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 7.6), layout="constrained")
        figure.suptitle(_title(table), fontsize=10)
        grid = figure.add_gridspec(3, 2, height_ratios=(1.0, 1.0, 1.0))
        _p_theta(figure.add_subplot(grid[0, :]), table)
        pi = math.pi
        quarters = {0.0: "0", pi / 2: r"$\pi/2$", pi: r"$\pi$", 1.5 * pi: r"$3\pi/2$"}
        for place, name, label, ticks in (
            (grid[1, 0], "p_phi", r"$\phi_\Delta$ [rad]", quarters),
            (grid[1, 1], "p_r", r"$r$ [R]", None),
            (grid[2, 0], "p_z", r"$z$ [R]", None),
            (grid[2, 1], "p_l", r"path length $l$ [R]", None),
        ):
            _conditional(figure, figure.add_subplot(place), table, name, label, ticks)
    return figure


def plot_validation(table: Table) -> Any:
    """Return a matplotlib Figure of p_theta beside what it should be.

    A sphere's is drawn as Zhou, Li & Stamnes 2003 draw their Fig. 8, with the deviation of the cells below. Any other
    grain's is drawn with its stated error and the Henyey-Greenstein lobes of its header.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 6.0), layout="constrained")
        figure.suptitle(_title(table), fontsize=10)
        if table.header["grain"]["kind"] == "sphere":
            above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
            _phase_function(above, table)
            _deviation(below, table)
        else:
            above = figure.subplots()
            _fits(above, table)
        # below the axes, within which atoms are labelled and a curve may be anywhere
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", frameon=False)
    return figure


def plot_accuracy(rows: Sequence[Mapping[str, Any]], fraction: float, title: str) -> Any:
    """Return a matplotlib Figure of how far levels are from packed grains: in the bulk, in slabs, and against time.

    Parameters
    ----------
    rows : sequence of dict
        As of `accuracy_files.facts`.
    fraction : float
        Packing fraction of the slabs and times that are shown [1].
    title : str
    """
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import MaxNLocator

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 3.9), layout="constrained")
        left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.9))
        bulk = [row for row in rows if row["quantity"] == "displacement"]
        _deviations(left, bulk, "fraction", {None: ("-", "full")})
        left.set_title("bulk: mean squared displacement per event")
        left.set_xlabel("packing fraction")
        left.set_ylabel("deviation from explicit [%]")
        if len({row["fraction"] for row in bulk}) > 1:
            left.xaxis.set_major_locator(MaxNLocator(7))
        slabs = [row for row in rows if row["quantity"] == "reflectance" and row["fraction"] == fraction]
        clear = [row for row in slabs if row["albedo"] == 1.0]
        angles = sorted({row["angle_deg"] for row in clear})
        _deviations(middle, clear, "layer", dict(zip(angles, ANGLE_STYLES, strict=False)))
        layers = sorted({row["layer"] for row in clear})
        middle.set_xscale("log")
        middle.set_xticks(layers, [f"{layer:g}" for layer in layers])
        middle.set_xticks([], minor=True)
        middle.set_title(f"reflectance of slabs, packing fraction {fraction:g}")
        middle.set_xlabel("thickness of the layer of centres [R]")
        _against_time(right, slabs, [row for row in rows if row["quantity"] == "time"])
        right.set_title("cost, and the worst of these slabs")

        levels = [level for level in COLOURS if any(row["level"] == level for row in rows)]
        style: Any = {"markersize": 4.5}
        keys: list[Any] = [
            Line2D([], [], color=COLOURS[level], marker=MARKS.get(level, "o"), label=level, **style)
            for level in levels if level != "explicit"
        ]  # fmt: skip
        keys.append(Patch(color=COLOURS["explicit"], alpha=BAND, linewidth=0, label="error of explicit"))
        keys += [
            Line2D([], [], color="0.4", linestyle=line, marker="o", fillstyle=fill, label=f"at {angle:g}°", **style)
            for angle, (line, fill) in zip(angles, ANGLE_STYLES, strict=False)
        ]
        figure.suptitle(f"{literal(title)}: levels against packed grains, traced one by one", fontsize=10.5)
        figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), frameon=False, handlelength=1.8)
    return figure


def _deviations(axes: Any, rows: Sequence[Mapping[str, Any]], over: str, styles: Mapping[Any, tuple[str, str]]) -> None:
    """Draw deviations from explicit [%] over a key of the rows, by level and, where `styles` has several, by angle; the
    band is explicit's own error, the widest of them. If there is one place, what stands there stands side by side."""
    own: dict[float, float] = {}
    for row in rows:
        if row["level"] == "explicit" and row["value"] > 0.0:
            own[row[over]] = max(own.get(row[over], 0.0), 100.0 * row["error"] / row["value"])
    places = sorted(own)
    band = np.array([own[place] for place in places])
    alone = len({row[over] for row in rows}) == 1
    if alone:
        axes.set_xlim(0.7 * rows[0][over], 1.3 * rows[0][over])
        axes.set_xticks([rows[0][over]], [f"{rows[0][over]:g}"])
        places, band = [*axes.get_xlim()][: 2 * len(band)], np.tile(band, 2)
    axes.fill_between(places, -band, band, color=COLOURS["explicit"], alpha=BAND, linewidth=0)
    axes.axhline(0.0, color=COLOURS["explicit"], linewidth=0.8)
    axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.8)
    shown = [3.0 * LINEAR]
    drawn = [level for level in COLOURS if any(row["level"] == level for row in rows)]
    for k, level in enumerate(drawn):
        for angle, (line, fill) in styles.items():
            some = sorted(
                (row for row in rows if row["level"] == level and (angle is None or row["angle_deg"] == angle)
                 and row["deviation"] == row["deviation"]), key=lambda row: row[over],
            )  # fmt: skip
            values = [100.0 * row["deviation"] for row in some]
            errors = [100.0 * row["error"] / max(row["value"], 1e-300) for row in some]
            aside = 0.5 * (k + 0.5 * (fill == "none") - 0.5 * len(drawn)) / len(drawn) if alone else 0.0
            axes.errorbar(
                [row[over] * (1.0 + aside) for row in some], values, errors, color=COLOURS[level], linestyle=line,
                linewidth=1.2, marker=MARKS.get(level, "o"), markersize=4.5, fillstyle=fill, capsize=2, elinewidth=0.8,
            )  # fmt: skip
            shown += [abs(value) + error for value, error in zip(values, errors, strict=True)]
    _percent_ticks(axes.yaxis, 1.25 * max(shown))
    axes.set_ylim(-1.25 * max(shown), 1.25 * max(shown))
    axes.grid(linewidth=0.3, alpha=0.5)


def _percent_ticks(axis: Any, most: float) -> None:
    """Mark 0, half and all of where the axis is linear, and 1 and 3 of each decade beyond."""
    steps = [0.5 * LINEAR, *(LINEAR * a * 10.0**k for k in range(6) for a in (1.0, 3.0))]
    steps = [step for step in steps if step <= most]
    axis.set_ticks([-step for step in reversed(steps)] + [0.0] + steps)
    axis.set_ticks([], minor=True)
    axis.set_major_formatter(lambda value, _: "0" if value == 0.0 else f"{value:+g}")


def _against_time(axes: Any, slabs: Sequence[Mapping[str, Any]], times: Sequence[Mapping[str, Any]]) -> None:
    """Draw the largest deviation of slabs, its error taken off, over the time per event."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    points: list[tuple[str, float, float, float]] = []
    for row in times:
        own = [one for one in slabs if one["level"] == row["level"] and one["value"] > 0.0]
        far = [one for one in own if one["deviation"] == one["deviation"]]
        if row["level"] == "explicit" and own:
            points.append((row["level"], row["value"], 0.0, max(100.0 * one["error"] / one["value"] for one in own)))
        elif far:
            most = max(far, key=lambda one: abs(one["deviation"]) - one["deviation_error"])
            points.append((row["level"], row["value"], 100.0 * abs(most["deviation"]), 100.0 * most["deviation_error"]))
    floor, top = 0.1, 10.0
    for level, time, worst, error in points:
        style: Any = {"color": COLOURS[level], "markersize": 6, "capsize": 3, "elinewidth": 0.9}
        if level == "explicit":
            axes.errorbar(time, error, 0.3 * error, fmt="_", uplims=True, **style)
            axes.annotate("explicit,\nits error", (time, error), (6.0, 4.0), "data", "offset points", ha="right")
            worst = error
        else:
            down = worst - max(worst - error, 0.5 * floor)
            axes.errorbar(time, worst, [[down], [error]], fmt=MARKS.get(level, "o"), **style)
        top, floor = max(top, 1.5 * (worst + error)), min(floor, worst / 2.0)
    if points:
        spread = [time for _, time, _, _ in points]
        axes.set_xlim(min(spread) / 1.5, max(spread) * 1.8)
        axes.set_ylim(floor, top)
    for axis, steps in ((axes.xaxis, (1.0, 2.0, 5.0)), (axes.yaxis, (1.0, 3.0))):
        low, high = axis.get_view_interval()
        axis.set_ticks([a * 10.0**k for k in range(-4, 5) for a in steps if low <= a * 10.0**k <= high])
        axis.set_ticks([], minor=True)
        axis.set_major_formatter("{x:g}")
    axes.grid(linewidth=0.3, alpha=0.5)
    axes.set_xlabel("time per event, over that of teleport")
    axes.set_ylabel("largest deviation of reflectance [%]")


def plot_preview(found: Preview, notes: Sequence[str]) -> Any:
    """Return a matplotlib Figure of a preview: its pictures with what to take for them, the deep colour, and notes."""
    import textwrap

    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12.4, 7.3))
        figure.suptitle(_title(found.table), fontsize=10)
        grid = figure.subplots(2, 4)
        figure.subplots_adjust(left=0.012, right=0.988, top=0.875, bottom=0.115, wspace=0.05, hspace=0.42)
        for axes in grid.flat:
            axes.set_axis_off()
        for axes, panel in zip(grid.flat, found.panels, strict=False):
            axes.imshow(panel.rgb, interpolation="bilinear", aspect="equal")
            noise = f", noise {100.0 * panel.error:.2g} %" if math.isfinite(panel.error) else ""
            axes.set_title(f"{panel.title}{noise}")
            bold = {"transform": axes.transAxes, "va": "top", "weight": "bold", "fontsize": 8.0}
            axes.text(0.0, -0.03, str(panel.advice), **bold)
            why = textwrap.wrap(panel.advice.reason, 62) + textwrap.wrap(panel.drawn, 62)
            axes.text(0.0, -0.11, "\n".join(why), transform=axes.transAxes, va="top", fontsize=7.0)
        swatch, words = grid[1, 2:]
        swatch.imshow(np.broadcast_to(found.deep_srgb, (3, 4, 3)), aspect="equal")
        swatch.set_title("deep colour")
        swatch.set_axis_on()  # a frame, for white is the colour of what does not absorb
        swatch.set_xticks([])
        swatch.set_yticks([])
        rgb = ", ".join(f"{c:.3f}" for c in found.deep)
        swatch.text(0.0, -0.03, f"linear {rgb}", transform=swatch.transAxes, va="top", weight="bold")
        about = "of a deep medium in white light from everywhere, whatever its packing; any level has it"
        swatch.text(0.0, -0.11, "\n".join(textwrap.wrap(about, 62)), transform=swatch.transAxes, va="top", fontsize=7.0)
        text = "\n".join("\n".join(textwrap.wrap(note, 52, subsequent_indent="  ")) for note in notes)
        words.text(0.0, 1.0, text, transform=words.transAxes, va="top", fontsize=7.5, linespacing=1.4)
    return figure


def _title(table: Table) -> str:
    header = table.header
    grain, optics, error = header["grain"], header["optics"], header["table_error"]
    paths = header["provenance"]["paths"]
    made = f"{paths:,} paths" if paths else "quadrature"
    name = literal(grain["name"])
    total = error["total_variation"]
    return (
        f"{name}, $\\eta$ = {optics['eta']:.6g}, Fresnel {optics['fresnel']}, {made}\n"
        f"stated error {total:.2g} (noise {error['sampling_noise']:.2g}, cell width {error['cell_width']:.2g})"
    )


def literal(text: str) -> str:
    """Return text from a header as matplotlib shows it literally: no mathematics, one line, not too long."""
    text = text if text.isascii() and text.isprintable() else ascii(text)[1:-1]
    return (text if len(text) <= 40 else f"{text[:37]}...").replace("$", r"\$")


def _steps(axes: Any, edges: np.ndarray, density: np.ndarray, **style: Any) -> None:
    """Draw a density as steps; cells without any leave a gap on a log axis."""
    axes.stairs(np.where(density > 0.0, density, np.nan), edges, baseline=None, **style)


def _density(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of the columns that are not atoms, and the density of cos theta in them."""
    edges = table.cos_theta_edges[1:-1]
    return edges, table.p_theta[1:-1] / np.diff(edges)


def _p_theta(axes: Any, table: Table) -> None:
    edges, density = _density(table)
    axes.set_xlim(-1.0, 1.0)
    if density.any():
        _steps(axes, edges, density, color="black", linewidth=1.0)
        axes.set_yscale("log")
        low, high = density[density > 0.0].min(), density.max()
        axes.set_ylim(max(low, high * 1e-6) / 1.5, high * 3.0)
    else:
        axes.set_yticks([])
    _atoms(axes, table)
    axes.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0], ["-1", "-0.5", "0", "0.5", "1"])
    axes.set_xlabel(r"$\cos\theta$")
    axes.set_ylabel(r"$p_\theta$, density of $\cos\theta$")
    axes.set_title(r"$p_\theta(\cos\theta)$")


def _atoms(axes: Any, table: Table) -> None:
    """Write the mass of each atom beside an arrow at its place."""
    for column, at, side, aligned in ((0, -1.0, 1.0, "left"), (-1, 1.0, -1.0, "right")):
        mass = float(table.p_theta[column])
        if mass < 5e-6:
            continue
        axes.annotate(
            "", (at, 0.98), (at, 0.55), ("data", "axes fraction"), ("data", "axes fraction"),
            arrowprops={"arrowstyle": "-|>", "color": "tab:red", "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0},
            annotation_clip=False,
        )  # fmt: skip
        axes.annotate(
            f"atom {100.0 * mass:.3g} %", (at, 0.95), (6.0 * side, 0.0), ("data", "axes fraction"), "offset points",
            ha=aligned, va="top", color="tab:red",
        )  # fmt: skip


def _conditional(figure: Any, axes: Any, table: Table, name: str, label: str, ticks: dict[float, str] | None) -> None:
    """One block as an image over cos theta."""
    from matplotlib.colors import LogNorm

    rows, masses = table.edges(name), table.block(name).astype(np.float64)
    symbol = {"p_phi": r"\phi_\Delta", "p_r": "r", "p_z": "z", "p_l": "l"}[name]
    title = rf"$p({symbol}\,|\,\theta)$"
    if name == "p_l":
        outside = float(masses[0] @ table.p_theta)  # a cell of zero width has no density
        title += rf", {100.0 * outside:.3g} % never enters"
        share = np.cumsum(masses @ table.p_theta)
        last = int(np.searchsorted(share, SHOWN * share[-1])) + 1
        if (longer := 100.0 * float(share[-1] - share[last - 1])) > 5e-4:
            title += f", {longer:.2g} % is longer"
        rows, masses = rows[1 : last + 1], masses[1:last]
    with np.errstate(over="ignore"):
        density = np.minimum(masses / np.diff(rows)[:, None], DENSEST)
    # log colours from the most of what matters: a few cells at a rainbow do not set the scale
    light = density[:, table.p_theta > 0.0]
    top = float(np.quantile(light[light > 0.0], 0.995)) if (light > 0.0).any() else 1.0
    norm = LogNorm(top / 10.0**DECADES, top)
    columns = table.cos_theta_edges
    axes.set_facecolor("black")
    style = {"norm": norm, "cmap": "inferno", "rasterized": True, "linewidth": 0, "antialiased": False}
    image = axes.pcolormesh(columns[1:-1], rows, _lit(density[:, 1:-1]), **style)
    gap, width = STRIP
    left, right = -1.0, 1.0
    for column, at, side in ((0, -1.0, -1.0), (-1, 1.0, 1.0)):
        if table.p_theta[column] < 5e-6:
            continue
        near, far = at + side * gap, at + side * (gap + width)
        axes.axvspan(at, near, color="white", linewidth=0)
        strip = sorted((near, far))
        axes.pcolormesh(strip, rows, _lit(density[:, [column]]), **style)
        left, right = min(left, far), max(right, far)
    axes.set_xlim(left, right)
    axes.set_ylim(rows[0], rows[-1])
    if ticks is not None:
        axes.set_yticks(list(ticks), list(ticks.values()))
    marks = [-1.0, -0.5, 0.0, 0.5, 1.0]
    names = [f"{mark:g}" for mark in marks]
    if left < -1.0:
        marks, names = [-1.0 - gap - 0.5 * width, *marks[1:]], ["atom", *names[1:]]
    if right > 1.0:
        marks, names = [*marks[:-1], 1.0 + gap + 0.5 * width], [*names[:-1], "atom"]
    axes.set_xticks(marks, names)
    axes.set_xlabel(r"$\cos\theta$")
    axes.set_ylabel(label)
    axes.set_title(title)
    figure.colorbar(image, ax=axes, label=f"density [1/{BY_NAME[name].unit}]", pad=0.02, extend="both")


def _lit(density: np.ndarray) -> np.ma.MaskedArray:
    """Mask what holds no light: it stays black."""
    return np.ma.masked_less_equal(density, 0.0)


def _phase_function(axes: Any, table: Table) -> None:
    """Fig. 8 of Zhou et al. 2003: P(theta), normalised to 4 pi, over the deflection in degrees."""
    optics = table.header["optics"]
    eta, fresnel = float(optics["eta"]), optics["fresnel"]
    edges, density = _density(table)
    degrees = np.degrees(np.arccos(edges))
    published = abs(eta - ZHOU_ETA) < ROUNDING
    theta = np.linspace(0.1, 179.9, 1799)
    if eta != 1.0:
        if published:
            data = reference("gomsphere_n1333.csv")
            name, column = {"sp": ("GOMsphere", "PN_fine"), "un": ("exact, averaged Fresnel", "P_un")}[fresnel]
            axes.plot(data["theta_deg"], data[column], color="tab:blue", linewidth=1.2, label=name)
        else:
            exact = analytic.phase_function(np.radians(theta), eta, fresnel)
            axes.plot(theta, exact, color="tab:blue", linewidth=1.2, label="exact geometrical optics")
        low = analytic.phase_function(np.radians(theta), eta, fresnel, orders=2)
        low = np.where(low > 0.0, low, np.nan)
        axes.plot(theta, low, ":", color="black", linewidth=1.2, label="N = 2, orders 0 and 1")
    if published:
        circles = reference("zhou2003_fig8_montecarlo.csv")
        style = {"markerfacecolor": "none", "markeredgecolor": "black", "markersize": 5.5, "zorder": 4}
        label = "Monte Carlo (Kokhanovsky & Nakajima 1998)"
        axes.plot(circles["theta_deg"], circles["P_MC_digitised"], "o", label=label, **style)
    label = f"this table, {len(density)} cells"
    _steps(axes, degrees[::-1], 2.0 * density[::-1], color="tab:red", linewidth=0.9, label=label)
    axes.set_yscale("log")
    axes.set_ylim(0.01, 100.0)
    axes.set_xlim(0.0, 180.0)
    axes.set_xticks(np.arange(0, 181, 20))
    axes.set_ylabel(r"phase function $P(\theta)$")


def _deviation(axes: Any, table: Table) -> None:
    """How far each cell is from its exact mass."""
    optics = table.header["optics"]
    edges = table.cos_theta_edges
    exact = analytic.deflection_masses(edges, optics["eta"], optics["fresnel"])
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = 100.0 * (table.p_theta / exact - 1.0)[1:-1]
    degrees = np.degrees(np.arccos(edges[1:-1]))
    axes.axhline(0.0, color="tab:blue", linewidth=1.2)
    axes.stairs(percent[::-1], degrees[::-1], baseline=None, color="tab:red", linewidth=0.9)
    finite = np.abs(percent[np.isfinite(percent)])
    limit = min(max(1.1 * float(finite.max(initial=0.0)), 0.01), 100.0)
    axes.set_ylim(-limit, limit)
    axes.set_ylabel("table / exact − 1 [%]")
    axes.set_xlabel(r"deflection $\theta$ [degrees]")


def _fits(axes: Any, table: Table) -> None:
    """p_theta, its stated error, and the lobes fitted to it."""
    edges, density = _density(table)
    error, stated = table.header["table_error"], table.header["fits"]
    fine = np.cos(np.linspace(math.pi, 0.0, 2001))
    middle = 0.5 * (fine[1:] + fine[:-1])
    one, two = stated["henyey_greenstein"], stated["two_lobe"]
    lobe = analytic.henyey_greenstein(one["g"], fine) / np.diff(fine)
    lobes = two["weight"] * analytic.henyey_greenstein(two["g1"], fine)
    lobes = (lobes + (1.0 - two["weight"]) * analytic.henyey_greenstein(two["g2"], fine)) / np.diff(fine)
    spread = np.sqrt(table.p_theta)
    # the stated noise, shared out among the columns as that of counts
    scale = error["sampling_noise"] / (math.sqrt(0.5 / math.pi) * max(float(spread.sum()), 1e-300))
    noise = scale * spread[1:-1] / np.diff(edges)
    low = np.maximum(density - 2.0 * noise, 1e-12)
    band = {"color": "tab:red", "alpha": 0.25, "linewidth": 0, "label": "±2 standard errors (stated noise)"}
    axes.stairs(density + 2.0 * noise, edges, baseline=low, fill=True, **band)
    _steps(axes, edges, density, color="tab:red", linewidth=1.0, label=f"this table, {len(density)} cells")
    for values, name, style in (
        (lobe, f"Henyey–Greenstein, g = {one['g']:.3f}, total variation {one['total_variation']:.2g}", "--"),
        (lobes, f"two lobes, g = {two['g1']:.3f}, {two['g2']:.3f}, total variation {two['total_variation']:.2g}", "-"),
    ):
        axes.plot(middle, values, style, color="tab:blue", linewidth=1.1, label=name)
    axes.set_yscale("log")
    if (density > 0.0).any():
        axes.set_ylim(max(density[density > 0.0].min(), density.max() * 1e-6) / 2.0, density.max() * 5.0)
    axes.set_xlim(-1.0, 1.0)
    _atoms(axes, table)
    axes.set_xlabel(r"$\cos\theta$")
    axes.set_ylabel(r"$p_\theta$, density of $\cos\theta$")
