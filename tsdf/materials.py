"""What grains are made of: refractive index n and absorption index k of six materials, by wavelength.

The complex index is n - i k, so the absorption coefficient of the bulk is 4 pi k / wavelength. How light
meets a surface is `optics`. The numbers are those of the refractiveindex.info database (CC0), which has them
from the sources named in `MEDIA`; sucrose is not in it. k is None where the source gives none, which is not
k = 0. Between the nodes of a table log k is linear in wavelength, and n in 1/wavelength^2, as normal
dispersion nearly is: that holds n of ice to 1e-4 from 350 to 390 nm, where linear in wavelength would miss
by 2e-4. Crystals are taken as isotropic: birefringence is ignored.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tsdf.errors import UsageError

UM_PER_NM = 1e-3  # [um/nm]

# fmt: off
# Terms (strength [1], resonance^2 [um^2]) of n^2 = sum of strength * w^2 / (w^2 - resonance^2)
WATER_TERMS = (  # Daimon & Masumura 2007, 20.0 C
    (1.0, 0.0), (5.684027565e-1, 5.101829712e-3), (1.726177391e-1, 1.821153936e-2),
    (2.086189578e-2, 2.620722293e-2), (1.130748688e-1, 1.069792721e1),
)
QUARTZ_TERMS = (  # Ghosh 1999, ordinary ray
    (1.28604141, 0.0), (1.07044083, 1.00585997e-2), (1.10202242, 100.0),
)
SALT_TERMS = (  # NaCl, Li 1976, 297 K
    (1.00055, 0.0), (0.19800, 0.050**2), (0.48398, 0.100**2), (0.38696, 0.128**2), (0.25998, 0.158**2),
    (0.08796, 40.50**2), (3.17064, 60.98**2), (0.30038, 120.34**2),
)
GLASS_TERMS = (  # Schott N-BK7, catalogue 2017-01-20, 293 K
    (1.0, 0.0), (1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653),
)
SUCROSE_PRINCIPAL_N = (1.5376, 1.5651, 1.5705)  # [1] n_alpha, n_beta, n_gamma, 589 nm, source not traced
ICE_NODES_NM = (350, 390, *range(400, 1401, 10))  # [nm] Warren & Brandt 2008, 266 K
ICE_N = (  # [1], one row per 100 nm from 400 nm on
    1.3249, 1.3203,
    1.3194, 1.3185, 1.3177, 1.3170, 1.3163, 1.3157, 1.3151, 1.3145, 1.3140, 1.3135,
    1.3130, 1.3126, 1.3121, 1.3117, 1.3114, 1.3110, 1.3106, 1.3103, 1.3100, 1.3097,
    1.3094, 1.3091, 1.3088, 1.3085, 1.3083, 1.3080, 1.3078, 1.3076, 1.3073, 1.3071,
    1.3069, 1.3067, 1.3065, 1.3062, 1.3060, 1.3059, 1.3057, 1.3055, 1.3053, 1.3051,
    1.3049, 1.3047, 1.3046, 1.3044, 1.3042, 1.3040, 1.3039, 1.3037, 1.3035, 1.3033,
    1.3032, 1.3030, 1.3028, 1.3027, 1.3025, 1.3023, 1.3022, 1.3020, 1.3019, 1.3017,
    1.3015, 1.3014, 1.3012, 1.3010, 1.3009, 1.3007, 1.3005, 1.3003, 1.3002, 1.3000,
    1.2998, 1.2997, 1.2995, 1.2993, 1.2991, 1.2990, 1.2988, 1.2986, 1.2984, 1.2982,
    1.2980, 1.2979, 1.2977, 1.2975, 1.2973, 1.2971, 1.2969, 1.2967, 1.2965, 1.2963,
    1.2961, 1.2959, 1.2957, 1.2955, 1.2953, 1.2951, 1.2949, 1.2946, 1.2944, 1.2941,
    1.2939,
)
ICE_K = (  # [1], same nodes; the source holds 2e-11 from 202 to 390 nm
    2e-11, 2e-11,
    2.365e-11, 2.669e-11, 3.135e-11, 4.14e-11, 6.268e-11,
    9.239e-11, 1.325e-10, 1.956e-10, 2.861e-10, 4.172e-10,
    5.889e-10, 8.036e-10, 1.076e-9, 1.409e-9, 1.813e-9, 2.289e-9, 2.839e-9, 3.461e-9, 4.159e-9, 4.93e-9,
    5.73e-9, 6.89e-9, 8.58e-9, 1.04e-8, 1.22e-8, 1.43e-8, 1.66e-8, 1.89e-8, 2.09e-8, 2.4e-8,
    2.9e-8, 3.44e-8, 4.03e-8, 4.3e-8, 4.92e-8, 5.87e-8, 7.08e-8, 8.58e-8, 1.02e-7, 1.18e-7,
    1.34e-7, 1.4e-7, 1.43e-7, 1.45e-7, 1.51e-7, 1.83e-7, 2.15e-7, 2.65e-7, 3.35e-7, 3.92e-7,
    4.2e-7, 4.44e-7, 4.74e-7, 5.11e-7, 5.53e-7, 6.02e-7, 7.55e-7, 9.26e-7, 1.12e-6, 1.33e-6,
    1.62e-6, 2e-6, 2.25e-6, 2.33e-6, 2.33e-6, 2.17e-6, 1.96e-6, 1.81e-6, 1.74e-6, 1.73e-6,
    1.7e-6, 1.76e-6, 1.82e-6, 2.04e-6, 2.25e-6, 2.29e-6, 3.04e-6, 3.84e-6, 4.77e-6, 5.76e-6,
    6.71e-6, 8.66e-6, 1.02e-5, 1.13e-5, 1.22e-5, 1.29e-5, 1.32e-5, 1.35e-5, 1.33e-5, 1.32e-5,
    1.32e-5, 1.31e-5, 1.32e-5, 1.32e-5, 1.34e-5, 1.39e-5, 1.42e-5, 1.48e-5, 1.58e-5, 1.74e-5,
    1.98e-5,
)
WATER_NODES_NM = tuple(range(300, 1001, 25))  # [nm] Hale & Querry 1973, 25 C
WATER_K = (  # [1], same nodes
    1.6e-8, 1.08e-8, 6.5e-9, 3.5e-9, 1.86e-9, 1.3e-9, 1.02e-9, 9.35e-10, 1e-9, 1.32e-9,
    1.96e-9, 3.6e-9, 1.09e-8, 1.39e-8, 1.64e-8, 2.23e-8, 3.35e-8, 9.15e-8, 1.56e-7, 1.48e-7,
    1.25e-7, 1.82e-7, 2.93e-7, 3.91e-7, 4.86e-7, 1.06e-6, 2.93e-6, 3.48e-6, 2.89e-6,
)
GLASS_NODES_NM = (  # [nm] Schott N-BK7, as above
    300, 310, 320, 334, 350, 365, 370, 380, 390, 400, 405, 420, 436,
    460, 500, 546, 580, 620, 660, 700, 1060, 1530, 1970, 2325, 2500,
)
GLASS_K = (  # [1], same nodes
    2.861e-6, 1.368e-6, 6.661e-7, 2.641e-7, 9.289e-8, 3.419e-8, 2.74e-8, 2.074e-8, 1.373e-8,
    1.023e-8, 9.056e-9, 9.391e-9, 1.115e-8, 1.029e-8, 9.578e-9, 6.966e-9, 9.254e-9, 1.188e-8,
    1.264e-8, 8.931e-9, 1.014e-8, 9.839e-8, 1.093e-6, 4.291e-6, 8.13e-6,
)
# fmt: on


@dataclass(frozen=True)
class OpticalConstants:
    """The complex refractive index n - i k of one material at one wavelength."""

    n: float  # refractive index [1]
    k: float | None  # absorption index [1]; None where the source gives none
    wavelength_nm: float  # the wavelength asked for [nm]
    material: str  # one of MATERIALS
    source: str  # short citation, with what is ignored


@dataclass(frozen=True)
class Medium:
    """How the optical constants of one material are found, and where that holds."""

    range_nm: tuple[float, float]  # both ends are included [nm]
    n: Callable[[float], float]  # of the wavelength [nm]
    k: Callable[[float], float] | None
    source: str


def sellmeier_n(terms: Sequence[tuple[float, float]]) -> Callable[[float], float]:
    """Return n as a function of the wavelength [nm] from (strength [1], resonance^2 [um^2])."""

    def n(wavelength_nm: float) -> float:
        w2 = (wavelength_nm * UM_PER_NM) ** 2
        return math.sqrt(sum(strength * w2 / (w2 - resonance2) for strength, resonance2 in terms))

    return n


def table_n(nodes_nm: Sequence[float], values: Sequence[float]) -> Callable[[float], float]:
    """Return n as a function of the wavelength [nm], linear in 1/wavelength^2 between ascending nodes."""
    abscissae = -1.0 / np.array(nodes_nm, dtype=np.float64) ** 2
    return lambda wavelength_nm: float(np.interp(-1.0 / wavelength_nm**2, abscissae, values))


def table_k(nodes_nm: Sequence[float], values: Sequence[float]) -> Callable[[float], float]:
    """Return k as a function of the wavelength [nm], log k linear in wavelength between ascending nodes."""
    logs = np.log(values)
    return lambda wavelength_nm: math.exp(np.interp(wavelength_nm, nodes_nm, logs))


MEDIA = {
    "ice": Medium(
        (350.0, 1400.0),
        table_n(ICE_NODES_NM, ICE_N),
        table_k(ICE_NODES_NM, ICE_K),
        "Warren & Brandt 2008, doi:10.1029/2007JD009744, 266 K; birefringence ignored",
    ),
    "water": Medium(
        (300.0, 1000.0),
        sellmeier_n(WATER_TERMS),
        table_k(WATER_NODES_NM, WATER_K),
        "n Daimon & Masumura 2007, doi:10.1364/AO.46.003811, 20 C; "
        "k Hale & Querry 1973, doi:10.1364/AO.12.000555, 25 C",
    ),
    "quartz": Medium(
        (198.0, 2053.1),
        sellmeier_n(QUARTZ_TERMS),
        None,
        "Ghosh 1999, doi:10.1016/S0030-4018(99)00091-7, ordinary ray; birefringence ignored",
    ),
    "salt": Medium((200.0, 30000.0), sellmeier_n(SALT_TERMS), None, "NaCl, Li 1976, doi:10.1063/1.555536, 297 K"),
    "glass": Medium(
        (300.0, 2500.0),
        sellmeier_n(GLASS_TERMS),
        table_k(GLASS_NODES_NM, GLASS_K),
        "Schott N-BK7, catalogue 2017-01-20, 293 K",
    ),
    "sucrose": Medium(
        (400.0, 700.0),
        lambda _: math.fsum(SUCROSE_PRINCIPAL_N) / len(SUCROSE_PRINCIPAL_N),
        None,
        "handbook value of 589 nm (primary source not traced) used at every wavelength; "
        "mean of the three principal indices, birefringence ignored",
    ),
}
MATERIALS: tuple[str, ...] = tuple(MEDIA)


def optical_constants(material: str, wavelength_nm: float) -> OpticalConstants:
    """Return n and k of a material at a wavelength.

    Parameters
    ----------
    material : str
        One of MATERIALS, ends included: ice 350-1400 nm, water 300-1000, quartz (ordinary ray) 198-2053.1,
        salt (NaCl) 200-30000, glass (Schott N-BK7) 300-2500, sucrose 400-700. k is None for quartz, salt and
        sucrose. n of sucrose is that of 589 nm throughout; n of quartz falls by 0.017 over the same range.
    wavelength_nm : float
        Wavelength [nm]. Outside the range of the material, or not a number: UsageError.
    """
    if material not in MATERIALS:
        raise UsageError(f"unknown material {material!r}; it is one of {', '.join(MATERIALS)}")
    medium, wavelength_nm = MEDIA[material], float(wavelength_nm)
    shortest, longest = medium.range_nm
    if not shortest <= wavelength_nm <= longest:
        raise UsageError(
            f"the wavelength must be {shortest:g} to {longest:g} nm for {material}, not {wavelength_nm:.10g}"
        )
    k = None if medium.k is None else medium.k(wavelength_nm)
    return OpticalConstants(medium.n(wavelength_nm), k, wavelength_nm, material, medium.source)
