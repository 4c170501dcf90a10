"""Ellipsoids about grains: a ray that misses a grain's ellipsoid need not enter its bounding sphere.

Most rays that meet the bounding sphere of a long or flat grain miss the grain. `standing` keeps beside each sphere the
smallest ellipsoid about the grain in it, as it is turned, and looks at both together, sixteen grains at a time, as
vector instructions do, in float32.
"""

import math

import numpy as np

from tsdf.compiled import njit
from tsdf.spheres.around import LANES
from tsdf.vectors import KERNEL

ROWS = 13  # of a block of `seen`; `around.met` knows the first four
MARGIN = 1e-3  # of an ellipsoid's axes, far more than the rounding of float32
THINNEST = 0.02  # axis of an ellipsoid [R]
WORTH = 0.9  # of the sphere's mean shadow: an ellipsoid of more is no help
DIRECTIONS = 150  # in which the points are looked for that an ellipsoid is laid about
SPARE = 0.01  # the ellipsoid's volume is the smallest possible but for about this


@njit(forceinline=True, fastmath={"contract"}, **KERNEL)
def seen(block, p, d, least):
    """Return what `around.met` does of the spheres of a block (ROWS, LANES) whose ellipsoid the line along d meets.

    A block has x, y, z of the sphere's centre, the bits of a number, and m_xx, m_xy, m_xz, m_yy, m_yz, m_zz and k of
    the ellipsoid, the places x relative to that centre with \\|m x + k\\| <= 1.
    """
    px, py, pz = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    dx, dy, dz = np.float32(d[0]), np.float32(d[1]), np.float32(d[2])
    one, none, low, here = np.float32(1.0), np.float32(0.0), np.float32(least), np.int32(2**31 - 1)
    last = np.int32(LANES - 1)
    for lane in range(LANES):
        x, y, z = block[0, lane] - px, block[1, lane] - py, block[2, lane] - pz
        along = x * dx + y * dy + z * dz
        # In the ellipsoid's coordinates, in which it is the unit sphere, the ray is at t e - f
        xx, xy, xz = block[4, lane], block[5, lane], block[6, lane]
        yy, yz, zz = block[7, lane], block[8, lane], block[9, lane]
        e, g, h = xx * dx + xy * dy + xz * dz, yy * dy + yz * dz, zz * dz
        u, v, w = (
            xx * x + xy * y + xz * z - block[10, lane],
            yy * y + yz * z - block[11, lane],
            zz * z - block[12, lane],
        )
        square, part = e * e + g * g + h * h, e * u + g * v + h * w
        u, v, w = square * u - part * e, square * v - part * g, square * w - part * h
        meets = u * u + v * v + w * w <= square * square
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        left = one - (x * x + y * y + z * z)
        t = along - np.sqrt(left)
        bits = (np.float32(max(t, none)).view(np.int32) & ~last) | np.int32(lane)  # as in `met`
        here = min(here, bits if meets & (left > none) & (t >= low) else np.int32(2**31 - 1))
    return here


def ellipsoid_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix m (3, 3) and offset k (3,) of about the smallest ellipsoid |m x + k| <= 1 that holds points
    (n, 3) (Khachiyan 1996), a little wider."""
    turns = np.arange(DIRECTIONS) + 0.5
    z, phi = 1.0 - 2.0 * turns / DIRECTIONS, turns * math.pi * (3.0 - math.sqrt(5.0))
    ways = np.stack((np.sqrt(1.0 - z * z) * np.cos(phi), np.sqrt(1.0 - z * z) * np.sin(phi), z))
    some = points[np.unique((ways.T @ points.T).argmax(axis=1))]
    lifted, share = np.column_stack((some, np.ones(len(some)))), np.full(len(some), 1.0 / len(some))
    while True:
        moments = (lifted.T * share) @ lifted
        far = np.einsum("ij,ij->i", lifted, np.linalg.solve(moments, lifted.T).T)
        j = int(far.argmax())
        if not far[j] >= 4.0 * (1.0 + SPARE):
            break
        move = (far[j] - 4.0) / (4.0 * (far[j] - 1.0))
        share *= 1.0 - move
        share[j] += move
    middle = share @ some
    values, axes = np.linalg.eigh((some.T * share) @ some - np.outer(middle, middle))
    matrix = (axes / np.sqrt(3.0 * np.maximum(values, THINNEST**2 / 3.0))) @ axes.T
    matrix /= (1.0 + MARGIN) * np.linalg.norm((points - middle) @ matrix.T, axis=1).max()
    return matrix, -matrix @ middle


def shadow(matrix: np.ndarray) -> float:
    """Return the mean shadow of an ellipsoid of such a matrix, over that of the unit sphere; to a few per cent."""
    a, b, c = 1.0 / np.linalg.svd(matrix, compute_uv=False)
    p = 1.6075  # Thomsen's formula
    return float((((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3.0) ** (1.0 / p))


def rows_of(matrix: np.ndarray, offset: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Return rows 4 to 12 (n, 9) of grains with an ellipsoid each, matrix (n, 3, 3) and offset (n, 3), that are turned
    by a matrix (n, 3, 3) from their frame to the scene's."""
    whole, upper = np.linalg.qr(matrix @ turned.swapaxes(1, 2))
    k = np.einsum("nji,nj->ni", whole, offset)
    return np.concatenate((upper[:, 0], upper[:, 1, 1:], upper[:, 2, 2:], k), axis=1)


def reach_of(matrix: np.ndarray, offset: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corners (n, 3) of boxes about such ellipsoids, relative to the spheres' centres."""
    inverse = np.linalg.inv(matrix @ turned.swapaxes(1, 2))
    middle, half = -np.einsum("nij,nj->ni", inverse, offset), np.linalg.norm(inverse, axis=2)
    return middle - half, middle + half
