"""Pictures of the same size side by side in one.

    python scenes/plate.py PICTURE.png ... OUT.png

They are put in the order given.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def plate(pictures: Sequence[Path], out: Path) -> None:
    """Write PNG pictures, (h, w, 3) each, as one PNG of (h, n w, 3)."""
    from matplotlib import image

    shown = [image.imread(path)[..., :3] for path in pictures]
    if len({picture.shape for picture in shown}) != 1:
        raise SystemExit("the pictures are not of the same size")
    image.imsave(out, np.concatenate(shown, axis=1), metadata={"Software": None})


if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit((__doc__ or "").split("\n\n")[1].strip())
    plate([Path(p) for p in sys.argv[1:-1]], Path(sys.argv[-1]))
