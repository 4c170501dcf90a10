"""HDR-FLIP: how different two pictures look when one is flipped to the other on a screen, from their linear radiance.

Written from Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström & Fairchild 2020, "FLIP: A Difference Evaluator for
Alternating Images", and Andersson, Nilsson, Shirley & Akenine-Möller 2021, "Visualizing Errors in Rendered High Dynamic
Range Images". Its numbers are 0 for what looks the same, up to 1, and it sees noise as well as errors. Here the middle
of the spatial filters is sampled at pixels, as the papers do; pictures continue as at their edge.
"""

import math

import numpy as np

from tsdf.errors import UsageError

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180.0  # 0.7 m from a screen 0.7 m and 3840 pixels wide
SENSITIVITY = ((1.0, 0.0047, 0.0, 1e-5), (1.0, 0.0053, 0.0, 1e-5), (34.1, 0.04, 13.5, 0.025))  # 2020, table 1
WIDEST = 0.04  # of them
FEATURE = 0.082  # [degree] width of what edges and points are looked for by
Q_COLOUR, P_COLOUR, P_TARGET, Q_FEATURE = 0.7, 0.4, 0.95, 0.5
TO_XYZ = np.array(
    [[10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
     [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
     [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382]]
)  # fmt: skip
FROM_XYZ = np.linalg.inv(TO_XYZ)
WHITE = TO_XYZ.sum(axis=1)
LUMINANCE = TO_XYZ[1]
ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.0, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)  # 2021: tone map, its default
BRIGHT = 0.85  # tone-mapped, at which exposures start and stop


def hdr_flip(reference: np.ndarray, test: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> float:
    """Return HDR-FLIP of two pictures, the mean over pixels of the largest FLIP at any exposure [1], in [0, 1].

    Parameters
    ----------
    reference, test : (h, w, 3) float
        Linear sRGB radiance; what is below 0 is taken as 0. The reference says which exposures are looked at.
    pixels_per_degree : float
        Of the screen, as seen.

    Raises
    ------
    UsageError
        Pictures of different shapes, or a black reference, which has no exposure.
    """
    if reference.shape != test.shape or reference.ndim != 3 or reference.shape[2] != 3:
        raise UsageError(f"FLIP compares two pictures of one size (h, w, 3), not {reference.shape} and {test.shape}")
    start, stop = exposures(reference)
    count = max(2, math.ceil(stop - start))
    each = []
    for stops in np.linspace(start, stop, count):
        shown = [tone_mapped(2.0**stops * picture) for picture in (reference, test)]
        each.append(ldr_flip(shown[0], shown[1], pixels_per_degree))
    return float(np.maximum.reduce(each).mean())


def exposures(reference: np.ndarray) -> tuple[float, float]:
    """Return the first and the last exposure [stops]: the brightest pixel, and the median one, are nearly white."""
    a, b, c = (ACES[k] - BRIGHT * ACES[k + 3] for k in range(3))
    white = (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)  # 0.85 after the tone map
    luminance = np.maximum(reference, 0.0) @ LUMINANCE
    if not luminance.max() > 0.0:
        raise UsageError("the reference is black, and FLIP has no exposure for that; give the scene light")
    middle = max(float(np.median(luminance)), 1e-12 * float(luminance.max()))
    return math.log2(white / float(luminance.max())), math.log2(white / middle)


def tone_mapped(radiance: np.ndarray) -> np.ndarray:
    """Return radiance as a screen shows it, linear in [0, 1]."""
    x = np.maximum(radiance, 0.0)
    k = ACES
    return np.clip((k[0] * x * x + k[1] * x + k[2]) / (k[3] * x * x + k[4] * x + k[5]), 0.0, 1.0)


def ldr_flip(reference: np.ndarray, test: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> np.ndarray:
    """Return FLIP of each pixel (h, w) of two pictures (h, w, 3) of linear sRGB in [0, 1]."""
    opponent = [_opponent(picture @ TO_XYZ.T) for picture in (reference, test)]
    shown = [_hunt(_lab(_filtered(picture, pixels_per_degree))) for picture in opponent]
    colour = _hyab(*shown) ** Q_COLOUR
    green, blue = (_hunt(_lab(np.array(rgb)[None, None])) for rgb in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    most = float(_hyab(green, blue)[0, 0]) ** Q_COLOUR
    knee = P_COLOUR * most
    colour = np.where(
        colour < knee, P_TARGET / knee * colour, P_TARGET + (colour - knee) / (most - knee) * (1.0 - P_TARGET)
    )
    grey = [(picture[..., 0] + 16.0) / 116.0 for picture in opponent]
    edges, points = ([np.hypot(*_slopes(one, pixels_per_degree, twice)) for one in grey] for twice in (False, True))
    feature = np.maximum(np.abs(edges[0] - edges[1]), np.abs(points[0] - points[1]))
    feature = np.clip((feature / math.sqrt(2.0)) ** Q_FEATURE, 0.0, 1.0)
    return np.asarray(np.clip(colour, 0.0, 1.0) ** (1.0 - feature))


def _opponent(xyz: np.ndarray) -> np.ndarray:
    """Return YyCxCz, a linear space with a lightness and two colour differences, of XYZ."""
    x, y, z = np.moveaxis(xyz / WHITE, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _filtered(opponent: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """Return what the eye resolves of a picture in YyCxCz, as linear sRGB in [0, 1]."""
    reach = math.ceil(3.0 * math.sqrt(WIDEST / (2.0 * math.pi**2)) * pixels_per_degree)
    d2 = (np.arange(-reach, reach + 1) / pixels_per_degree) ** 2
    seen = np.empty_like(opponent)
    for k, (a1, b1, a2, b2) in enumerate(SENSITIVITY):
        # a sum of two Gaussians, each a product of one across and one down
        total, weight = np.zeros(opponent.shape[:2]), 0.0
        for a, b in ((a1, b1), (a2, b2)):
            line = np.exp(-(math.pi**2) * d2 / b)
            share = a * math.sqrt(math.pi / b)
            total += share * _across(_across(opponent[..., k], line).T, line).T
            weight += share * line.sum() ** 2
        seen[..., k] = total / weight
    y = (seen[..., 0] + 16.0) / 116.0
    xyz = np.stack([y + seen[..., 1] / 500.0, y, y - seen[..., 2] / 200.0], axis=-1) * WHITE
    return np.clip(xyz @ FROM_XYZ.T, 0.0, 1.0)


def _lab(rgb: np.ndarray) -> np.ndarray:
    """Return CIELAB of linear sRGB."""
    t = rgb @ TO_XYZ.T / WHITE
    delta = 6.0 / 29.0
    x, y, z = np.moveaxis(np.where(t > delta**3, np.cbrt(t), t / (3.0 * delta**2) + 4.0 / 29.0), -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _hunt(lab: np.ndarray) -> np.ndarray:
    """Return CIELAB with colours paler where it is darker (the Hunt effect)."""
    return np.concatenate([lab[..., :1], 0.01 * lab[..., :1] * lab[..., 1:]], axis=-1)


def _hyab(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the distance of colours for large differences, city-block in lightness (Abasi et al. 2020)."""
    d = one - other
    return np.asarray(np.abs(d[..., 0]) + np.hypot(d[..., 1], d[..., 2]))


def _slopes(grey: np.ndarray, pixels_per_degree: float, twice: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the first or second derivative of a Gaussian-smoothed picture across and down; edges and points."""
    sigma = 0.5 * FEATURE * pixels_per_degree
    reach = math.ceil(3.0 * sigma)
    x = np.arange(-reach, reach + 1.0)
    smooth = np.exp(-(x**2) / (2.0 * sigma**2))
    rise = (x**2 / sigma**2 - 1.0) * smooth if twice else -x * smooth
    rise = np.where(rise > 0.0, rise / rise[rise > 0.0].sum(), -rise / rise[rise < 0.0].sum())
    smooth = smooth / smooth.sum()
    return _across(_across(grey.T, smooth).T, rise), _across(_across(grey, smooth).T, rise).T


def _across(grey: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return a picture (h, w) convolved along its rows by an odd symmetric or antisymmetric kernel."""
    reach = len(kernel) // 2
    wide = np.pad(grey, ((0, 0), (reach, reach)), mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(wide, len(kernel), axis=1) @ kernel)
