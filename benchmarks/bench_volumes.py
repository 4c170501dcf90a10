"""Smoothing of voxels: g of a voxelised ball of 40 voxels radius against that of the exact sphere."""

import numpy as np

import tsdf
from tsdf.grain import volumes

RADIUS, ETA, PATHS = 40, 1.31, 300_000
MIDDLE = (0.23, 0.33, -0.07)  # off the grid


def ball() -> np.ndarray:
    """Return a ball as voxels of 0 and 1."""
    x = np.arange(-RADIUS - 4, RADIUS + 5)
    squares = sum(np.square(along - at) for along, at in zip(np.meshgrid(x, x, x, indexing="ij"), MIDDLE, strict=True))
    return (squares < RADIUS**2).astype(np.uint8)


def main() -> None:
    exact = tsdf.build("sphere", ETA, tsdf.Effort(cells=64)).mean_cosine()
    print(f"exact sphere: g {exact:.4f}")
    found = volumes.parts(volumes.material(ball()))
    for smoothing in (0.5, 1.0, 1.5, 2.0, 3.0):
        ((grain, _),) = volumes.solids(found, smoothing=smoothing)
        table = tsdf.build(grain, ETA, tsdf.Effort(paths=PATHS, cells=64))
        g, error = table.mean_cosine(), table.header["standard_errors"]["mean_cosine"]
        radius = grain.bounding_radius * (0.75 * grain.volume / np.pi) ** (1 / 3)
        surface = grain.area * grain.bounding_radius**2 / (4 * np.pi * radius**2)
        print(f"| {smoothing:g} | {g:.4f} ± {error:.4f} | {radius:.3f} | {surface:.4f} |", flush=True)


if __name__ == "__main__":
    main()
