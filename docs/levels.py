"""Draws the picture that helps to choose a level: ``python docs/levels.py``, into levels.png and levels.svg beside it.

The numbers in it are those of `tsdf.study.advice`, the order that of its rule; the same bytes every time.
"""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from tsdf.scene.levels import LEVELS
from tsdf.study import advice
from tsdf.study.plots import STYLE

INTO = Path(__file__).parent
QUESTIONS = (
    ("Are single grains seen?", f"a pixel covers less than {advice.SINGLE:g} R"),
    ("Is it thin?", f"less than {advice.THIN:g} R; or f > {advice.SPARSE:g}\nand less than {advice.DEEP:g} l*"),
    ("How much time?", "or which renderer?"),
)
ANSWERS = (
    (
        ("explicit", "a few grains, up to 6 R thick,\nor mirrors"),
        ("teleport-memory", "else, with --explicit-grains K:\nK = 4 ln(texture / target)"),
    ),
    (
        ("teleport-memory", "neighbours show; needs\nrecords: --memory 64"),
        ("teleport-packed", "the same of mirrors and metals:\n2.5 times the time of teleport"),
    ),
    (
        ("teleport", "offsets kept: edges and thin\nparts of a heap are right"),
        ("volume", f"more than {advice.DEEP:g} l*: as right,\nand in any renderer"),
        ("volume-hg", "a preview, or a renderer\nthat has but one lobe"),
    ),
)
INK, GREY, PAPER = "#222222", "#666666", "#f4f2ec"


def box(axes: Any, x: float, y: float, size: tuple[float, float], colour: str, **style: Any) -> None:
    """Draw a rounded box about a point."""
    from matplotlib.patches import FancyBboxPatch

    w, h = size
    axes.add_patch(
        FancyBboxPatch(
            (x - w / 2, y - h / 2), w, h, boxstyle="round,pad=0,rounding_size=0.12", edgecolor=colour, **style
        )
    )


def figure() -> Figure:
    """Return the picture."""
    made = Figure(figsize=(9.6, 4.3))
    axes = made.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, 9.6)
    axes.set_ylim(0.0, 4.3)
    axes.set_axis_off()
    for i, ((question, what), answers) in enumerate(zip(QUESTIONS, ANSWERS, strict=True)):
        x = 1.65 + 3.15 * i
        box(axes, x, 3.62, (2.6, 0.95), INK, facecolor=INK)
        axes.text(x, 3.80, f"{i + 1}. {question}", color="white", ha="center", va="center", fontsize=11, weight="bold")
        axes.text(x, 3.44, what, color="#dddddd", ha="center", va="center", fontsize=7.5, linespacing=1.2)
        axes.annotate("", (x, 2.78), (x, 3.14), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.4})
        if i < 2:
            axes.text(x + 0.1, 2.97, "yes", fontsize=8.5, color=GREY, va="center")
            axes.annotate(
                "", (x + 1.85, 3.62), (x + 1.3, 3.62), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.4}
            )
            axes.text(x + 1.56, 3.74, "no", fontsize=8.5, color=GREY, ha="center")
        for j, (level, why) in enumerate(answers):
            y = 2.42 - 0.8 * j
            box(axes, x, y, (2.6, 0.68), LEVELS[level].colour, facecolor=PAPER, lw=1.8)
            axes.text(x - 1.18, y + 0.19, level, fontsize=9.5, weight="bold", va="center", color=INK)
            axes.text(x - 1.18, y - 0.13, why, fontsize=7.3, va="center", color=GREY, linespacing=1.15)
    words = (
        "R: bounding radius of a grain.  f: packing fraction of bounding spheres.  l*: transport mean free path "
        "(tsdf-info FILE --packing f --radius R).\ntsdf-preview FILE draws your grain and answers all three."
    )
    axes.text(4.8, 0.27, words, fontsize=7.6, color=GREY, ha="center", va="center", linespacing=1.5)
    return made


def main() -> None:
    """Write the picture, as PNG for pages and as SVG for print."""
    with matplotlib.rc_context(STYLE | {"svg.fonttype": "none"}):
        figure().savefig(INTO / "levels.png", dpi=130, metadata={"Software": None})
        figure().savefig(INTO / "levels.svg", metadata={"Date": None, "Creator": None})


if __name__ == "__main__":
    main()
