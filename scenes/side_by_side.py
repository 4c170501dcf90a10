"""Pictures of one scene at several levels, and how far all others are from the first.

    python scenes/side_by_side.py TRUTH.exr OTHER.exr ... OUT.png

Prints, and writes under each error image, the difference of the pictures' means and the mean of |difference|, both over
the mean of the first picture, and what of the latter is expected from noise alone.
"""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsdf.picture import image

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, ITU-R BT.709


class Difference(NamedTuple):
    """How far a picture is from another, each over the mean luminance of that other [1]."""

    bias: float  # of the means, signed
    error: float  # mean of |difference| over the pixels
    noise: float  # what `error` would be if the two differed by their noise only
    per_pixel: np.ndarray  # (h, w) |difference|


def difference(one: image.Image, truth: image.Image) -> Difference:
    """Return how far the luminance of a picture is from that of the truth."""
    a, b = one.rgb.astype(np.float64) @ LUMINANCE, truth.rgb.astype(np.float64) @ LUMINANCE
    if a.shape != b.shape:
        raise SystemExit(f"the pictures are of {a.shape[1]} x {a.shape[0]} and {b.shape[1]} x {b.shape[0]} pixels")
    deviation = np.zeros_like(b)
    if one.variance is not None and truth.variance is not None:
        # Channels of a sample are nearly the same random number: their deviations add, not their variances
        deviation = np.hypot(*(np.sqrt(picture.variance.astype(np.float64)) @ LUMINANCE for picture in (one, truth)))
    mean = b.mean()
    return Difference(
        float((a.mean() - mean) / mean),
        float(np.abs(a - b).mean() / mean),
        float(math.sqrt(2.0 / math.pi) * deviation.mean() / mean),
        np.abs(a - b) / mean,
    )


def level_of(picture: image.Image) -> str:
    """Return the level that a picture of `tsdf-render` was made at."""
    facts = json.loads(picture.attributes.get("tsdf_render", "{}"))
    after = f", {facts['explicit_grains']} explicit" if "explicit_grains" in facts else ""
    return str(facts.get("level", "another")) + after


def side_by_side(pictures: Sequence[Path], out: Path) -> list[tuple[str, Difference]]:
    """Write the plate of pictures as PNG and return the level of each but the first, and its difference to that."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    truth, *others = shown = [image.read_exr(path) for path in pictures]
    found = [(level_of(one), difference(one, truth)) for one in others]
    height, width = truth.rgb.shape[:2]
    figure = Figure(figsize=(4.0 * len(shown), 8.0 * height / width + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, len(shown))
    for axes, one in zip(top, shown, strict=True):
        axes.imshow(image.encoded(one.rgb))
        axes.set_title(level_of(one))
    most = float(np.quantile([one.per_pixel for _, one in found], 0.99))
    for axes, (name, one) in zip(bottom[1:], found, strict=True):
        plate = axes.imshow(one.per_pixel, vmin=0.0, vmax=most, cmap="magma")
        axes.set_title(
            f"|{name} - {level_of(truth)}|\nmean {one.error:.1%} (noise {one.noise:.1%}), of the means {one.bias:+.1%}",
            fontsize=9,
        )
    for axes in (*top, *bottom):
        axes.set_axis_off()
    bar = bottom[0].inset_axes((0.1, 0.5, 0.8, 0.08))
    label = f"|difference| / mean of {level_of(truth)}, luminance"
    figure.colorbar(plate, cax=bar, orientation="horizontal", label=label)
    figure.savefig(out, dpi=80, metadata={"Software": None})
    return found


if __name__ == "__main__":
    if len(sys.argv) < 4:
        raise SystemExit((__doc__ or "").split("\n\n")[1].strip())
    for level, result in side_by_side([Path(p) for p in sys.argv[1:-1]], Path(sys.argv[-1])):
        print(
            f"{level}: mean {result.bias:+.2%} of the first, mean |difference| {result.error:.2%} "
            f"(noise {result.noise:.2%})"
        )
