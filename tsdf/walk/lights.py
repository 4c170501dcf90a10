"""Light from infinity: a constant, an environment in latitude and longitude, suns.

z is up. A `direction` is a unit triple that points toward the light, the way a camera ray travels on leaving the
scene; its azimuth runs counter-clockwise seen from above, from +x over +y. Row 0 of an environment is the zenith (+z),
its last row the nadir. Columns run as in OpenEXR's ImfEnvmap.h, so that left in the image is left in the picture: the
azimuth falls from 0 at the left edge to -360 degrees at the right, and the middle looks along -x with -y to its left
(OpenEXR's -z, -x, y are our x, y, z). `rotation_deg` adds to the azimuth. Pixels are constant.

Suns are drawn in proportion to the luminance they send, the environment to that above a multiple of its mean; the
density is the sum of both over their power, whatever overlaps. The constant is never drawn. Reading image files is
`image`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tsdf.compiled import njit
from tsdf.data.sampler import turned
from tsdf.errors import UsageError
from tsdf.vectors import KERNEL, frame, step

LUMINANCE = (0.2126, 0.7152, 0.0722)  # [1] of linear sRGB, IEC 61966-2-1
CONTRAST = 4.0  # times the mean luminance of an environment that need not be aimed at
PARTS = 4  # of z, for each row of an environment, by which its row is found
SMALLEST_DEG = 1e-6  # below, a disc is no wider than the rounding of directions

Sun = tuple[npt.ArrayLike, float, npt.ArrayLike]


class LightArrays(NamedTuple):
    """The lights of a scene as the kernels take them; made by `compile_lights`."""

    constant: tuple[float, float, float]  # radiance
    environment: np.ndarray  # (h, w, 4) radiance and by how much it is aimed at [luminance]; h = 0 where there is none
    rotation: float  # [turns] azimuth of the left edge of column 0, which falls from there
    cos_edges: np.ndarray  # (h + 1,) cosine of the polar angle of the rows' edges, from 1 to -1
    rows: np.ndarray  # (h,) running sum of what is aimed at times cosine difference
    columns: np.ndarray  # (h, w) running sum of it along each row
    row_guide: np.ndarray  # (power of two,) int32: row in which each of as many equal parts of `rows` begins
    column_guide: np.ndarray  # (h, power of two) int32: as `row_guide`, for `columns`
    height_guide: np.ndarray  # (parts,) int32: row that each of as many equal parts of z, from 1 down to -1, begins in
    sun_direction: np.ndarray  # (n, 3) toward the centre of each sun
    sun_chord2: np.ndarray  # (n,) squared distance of centre and edge of the disc on the unit sphere
    sun_radiance: np.ndarray  # (n, 3)
    shares: np.ndarray  # (n + 1,) running sum of the probability to draw the environment, then each sun
    power: float  # what is aimed at and luminance of suns, integrated over directions
    sampled: bool  # whether there is anything to draw


def compile_lights(
    constant: npt.ArrayLike = (0.0, 0.0, 0.0),
    environment: npt.ArrayLike | None = None,
    rotation_deg: float = 0.0,
    suns: Sequence[Sun] = (),
    contrast: float = CONTRAST,
) -> LightArrays:
    """Return the lights of a scene for the kernels of this module.

    Parameters
    ----------
    constant : (3,) float
        Radiance of every direction, linear sRGB, >= 0.
    environment : (h, w, 3) float, optional
        Radiance of the pixels, >= 0; it adds to the constant.
    rotation_deg : float
        By how much the environment is turned about +z, counter-clockwise seen from above [degrees]: the azimuth of
        its left edge.
    suns : sequence of (direction, angular_diameter_deg, irradiance)
        Discs of uniform radiance: a vector toward the centre, of any length; the diameter [degrees], in [1e-6, 180];
        the linear-sRGB irradiance on a surface that faces it, >= 0.
    contrast : float
        `draw` aims at pixels of the environment in proportion to their luminance less so many times its mean. What is
        not aimed at is found by chance, which is better for a broad sky: half of the variance and of the time went
        into aiming at it.

    Raises
    ------
    UsageError
        If a value is out of its range, or everything is black.
    """
    everywhere = _colours(constant, "the radiance of a constant light", (3,))
    pixels = np.zeros((0, 0, 3))
    if environment is not None:
        pixels = _colours(environment, "the radiance of an environment", None)
    if not math.isfinite(rotation_deg):
        raise UsageError(f"the rotation of an environment must be a finite number of degrees, got {rotation_deg}")
    height, width = pixels.shape[:2]
    cos_edges = np.cos(np.linspace(0.0, math.pi, height + 1))
    luminance = pixels @ LUMINANCE
    with np.errstate(over="ignore", invalid="ignore"):  # judged below, by the power
        brightness = float(np.sum(-np.diff(cos_edges)[:, None] * luminance)) / (2.0 * width) if height else 0.0
        aim = np.maximum(luminance - contrast * brightness, 0.0)
        columns = np.cumsum(aim, axis=1)
        rows = np.cumsum(-np.diff(cos_edges) * columns[:, -1]) if height else np.zeros(0)
        discs = [_disc(number, *sun) for number, sun in enumerate(suns, 1)]
        direction, chord2, radiance = (np.array([disc[i] for disc in discs]) for i in range(3))
        direction, radiance = direction.reshape(-1, 3), radiance.reshape(-1, 3)
        environment_power = rows[-1] * 2.0 * math.pi / width if height else 0.0
        powers = np.append(environment_power, math.pi * chord2 * (radiance @ LUMINANCE))
    power = float(powers.sum())
    if not (math.isfinite(power) and math.isfinite(brightness)):
        raise UsageError("the lights are too bright for the range of numbers; scale them down")
    if not (power > 0.0 or any(everywhere) or luminance.any()):
        raise UsageError("a scene without light: every light is black; give one a radiance or irradiance above 0")
    shares = np.cumsum(powers)
    return LightArrays(
        constant=(float(everywhere[0]), float(everywhere[1]), float(everywhere[2])),
        environment=np.concatenate((pixels, aim[..., None]), axis=2),
        rotation=math.fmod(rotation_deg, 360.0) / 360.0,
        cos_edges=cos_edges,
        rows=rows,
        columns=columns,
        row_guide=_guide(rows),
        column_guide=np.array([_guide(sums) for sums in columns], np.int32).reshape(height, -1 if height else 1),
        height_guide=_heights(cos_edges),
        sun_direction=direction,
        sun_chord2=chord2,
        sun_radiance=radiance,
        shares=shares / shares[-1] if power > 0.0 else shares,
        power=power,
        sampled=power > 0.0,
    )


def _colours(value: npt.ArrayLike, name: str, shape: tuple[int, ...] | None) -> np.ndarray:
    """Return radiances as float64 of a shape; None stands for (h, w, 3)."""
    colours = np.array(value, dtype=np.float64, order="C")
    if shape is None:
        if colours.ndim != 3 or colours.shape[2] != 3 or colours.size == 0:
            raise UsageError(f"{name} must have the shape (h, w, 3), not {colours.shape}")
    elif colours.shape != shape:
        raise UsageError(f"{name} must be three numbers, linear red, green and blue, not of shape {colours.shape}")
    bad = ~(np.isfinite(colours) & (colours >= 0.0))
    if bad.any():
        place = np.argwhere(bad)[0]
        at = f" at row {place[0]}, column {place[1]}" if shape is None else ""
        raise UsageError(f"{name} must be finite and not negative, got {colours[tuple(place)]:g}{at}")
    return colours


def _guide(sums: np.ndarray) -> np.ndarray:
    """Return the cell of a running sum that each of equal parts of it begins in, as `_cell` has it, int32."""
    parts = 1 << max(sums.size - 1, 0).bit_length()  # a power of two, so that a number is in the part that it says
    starts = np.arange(parts) / parts * sums[-1:] if sums.size else np.zeros(parts)
    return np.minimum(np.searchsorted(sums, starts, side="right"), max(sums.size - 1, 0)).astype(np.int32)


def _heights(cos_edges: np.ndarray) -> np.ndarray:
    """Return the row that each of equal parts of z begins in at the top, int32."""
    parts = PARTS * (cos_edges.size - 1)
    tops = 1.0 - 2.0 * np.arange(parts) / max(parts, 1) + 2.0**-50  # the part of a z is rounded
    return np.searchsorted(-cos_edges[1:-1], -tops, side="right").astype(np.int32)


def _disc(
    number: int, direction: npt.ArrayLike, diameter_deg: float, irradiance: npt.ArrayLike
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return unit direction, squared chord and radiance of a sun."""
    centre = np.array(direction, dtype=np.float64)
    if centre.shape != (3,) or not np.isfinite(centre).all() or not centre.any():
        raise UsageError(f"the direction of sun {number} must be three finite numbers, not all 0")
    if not SMALLEST_DEG <= diameter_deg <= 180.0:
        why = "; a zero-area light meets no ray" if diameter_deg < SMALLEST_DEG else ""
        raise UsageError(
            f"the angular diameter of sun {number} must be {SMALLEST_DEG:g} to 180 degrees, got {diameter_deg}{why}"
        )
    half = 0.5 * math.radians(diameter_deg)
    colour = _colours(irradiance, f"the irradiance of sun {number}", (3,))
    centre /= np.abs(centre).max()  # first, or the squares may leave the range of numbers
    return centre / np.linalg.norm(centre), 4.0 * math.sin(0.5 * half) ** 2, colour / (math.pi * math.sin(half) ** 2)


@njit(forceinline=True, **KERNEL)
def _pixel(lights, direction):
    """Return row and column of the environment in a direction."""
    x, y, z = direction
    height, width = lights.environment.shape[0], lights.environment.shape[1]
    part = int((1.0 - z) * (0.5 * lights.height_guide.size))
    row = lights.height_guide[max(0, min(part, lights.height_guide.size - 1))]
    while row < height - 1 and z <= lights.cos_edges[row + 1]:
        row += 1
    along = lights.rotation - math.atan2(y, x) / (2.0 * math.pi)
    return row, max(0, min(width - 1, int((along - math.floor(along)) * width)))


@njit(forceinline=True, **KERNEL)
def _sent(lights, direction, row, column):
    """Return the radiance of environment and suns, and the density with which `draw` makes a direction [1/sr].

    The pixel of the environment is that given, or looked for if its row is negative.
    """
    x, y, z = direction
    r = g = b = density = 0.0
    if lights.environment.shape[0] > 0:
        if row < 0:
            row, column = _pixel(lights, direction)
        r = lights.environment[row, column, 0]
        g = lights.environment[row, column, 1]
        b = lights.environment[row, column, 2]
        density = lights.environment[row, column, 3]
    for i in range(lights.sun_chord2.size):
        dx, dy, dz = x - lights.sun_direction[i, 0], y - lights.sun_direction[i, 1], z - lights.sun_direction[i, 2]
        if dx * dx + dy * dy + dz * dz < lights.sun_chord2[i]:  # a cosine could not tell small discs apart
            r += lights.sun_radiance[i, 0]
            g += lights.sun_radiance[i, 1]
            b += lights.sun_radiance[i, 2]
            for k in range(3):
                density += LUMINANCE[k] * lights.sun_radiance[i, k]
    return r, g, b, density / lights.power if lights.sampled else 0.0


@njit(**KERNEL)
def pdf(lights, direction):
    """Return the density with which `draw` makes a direction, 0 where nothing is drawn [1/sr]."""
    return _sent(lights, direction, -1, -1)[3]


@njit(**KERNEL)
def radiance(lights, direction, weight_pdf):
    """Return the radiance from a direction as linear sRGB, with its weight against `draw` (balance heuristic).

    Parameters
    ----------
    lights : LightArrays
    direction : triple of float
        Toward the light, unit.
    weight_pdf : float
        Density with which the path drew this direction [1/sr], finite: environment and suns count
        weight_pdf / (weight_pdf + pdf). Negative: the path had no partner from `draw` (camera rays, delta atoms)
        and all counts in full, as the constant always does (Veach 1997, eq. 9.8).
    """
    r, g, b, density = _sent(lights, direction, -1, -1)
    weight = 1.0
    if weight_pdf >= 0.0 and density > 0.0:
        weight = weight_pdf / (weight_pdf + density)
    return lights.constant[0] + weight * r, lights.constant[1] + weight * g, lights.constant[2] + weight * b


@njit(forceinline=True, **KERNEL)
def _cell(sums, i, x):
    """Return the cell of a running sum that x lies in, and how far in it, in [0, 1]; never an empty cell.

    It is looked for from i on, which is not beyond it.
    """
    last = sums.size - 1
    while i < last and x >= sums[i]:
        i += 1
    low = sums[i - 1] if i > 0 else 0.0
    return i, (x - low) / (sums[i] - low)


@njit(forceinline=True, **KERNEL)
def draw(lights, u0, u1, u2):
    """Return a direction toward environment or suns, its density and the radiance from there without the constant.

    Parameters
    ----------
    lights : LightArrays
        With ``sampled`` true; else the radiance is 0.
    u0, u1, u2 : float
        Random numbers in [0, 1): which light, and where on it.

    Returns
    -------
    direction : triple of float
    pdf : float
        Density of the whole mixture [1/sr]; 0, with no radiance, where nothing is drawn.
    rgb : triple of float
    """
    if not lights.sampled:
        return (0.0, 0.0, 1.0), 0.0, (0.0, 0.0, 0.0)
    chosen = _cell(lights.shares, 0, u0)[0]
    row, column = -1, -1
    if chosen == 0:
        begin = lights.row_guide[int(u1 * lights.row_guide.size)]
        row, down = _cell(lights.rows, begin, u1 * lights.rows[-1])
        sums, guide = lights.columns[row], lights.column_guide[row]
        column, along = _cell(sums, guide[int(u2 * guide.size)], u2 * sums[-1])
        z = lights.cos_edges[row] + down * (lights.cos_edges[row + 1] - lights.cos_edges[row])
        azimuth = lights.rotation - (column + along) / lights.columns.shape[1]
        c, s = turned(azimuth - math.floor(azimuth))
        rho = math.sqrt(max(0.0, 1.0 - z * z))
        direction = (rho * c, rho * s, z)
    else:
        sun = chosen - 1
        drop = 0.5 * u1 * lights.sun_chord2[sun]  # 1 - cosine, uniform over the cap
        centre = (lights.sun_direction[sun, 0], lights.sun_direction[sun, 1], lights.sun_direction[sun, 2])
        s, t = frame(centre)
        rho = math.sqrt(drop * (2.0 - drop))
        c, d = turned(u2)
        direction = step(step(step(centre, -drop, centre), rho * c, s), rho * d, t)
    r, g, b, density = _sent(lights, direction, row, column)
    if density <= 0.0:  # rounding can carry the edge of a sun to where nothing is drawn
        return direction, 0.0, (0.0, 0.0, 0.0)
    return direction, density, (r, g, b)
