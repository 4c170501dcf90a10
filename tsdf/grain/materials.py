"""Materials of grains: refractive index n and absorption index k of six of them, by wavelength.

The complex index is n - i k, so the absorption coefficient of the bulk is 4 pi k / wavelength. How light
meets a surface is `optics`. The numbers are those of the refractiveindex.info database (CC0), which has them
from the sources named in `MEDIA`; sucrose is not in it. k is None where the source gives none, which is not
k = 0. Between the nodes of a table log k is linear in wavelength, and n in 1/wavelength^2, as normal
dispersion nearly is: that holds n of ice to 1e-4 from 350 to 390 nm, where linear in wavelength would miss
by 2e-4. Next to a node of k = 0 it is k that is linear. A user's own constants are read by `constants`.
Crystals are taken as isotropic: birefringence is ignored.
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
QUARTZ_FORMULA_NM = 2053.1  # up to here; the two differ by 8e-6 there, and by 2e-5 at most from 300 to 3000 nm [nm]
QUARTZ_FAR_TERMS = (  # Radhakrishnan 1951, ordinary ray, 18 C
    (1.0, 0.0), (0.663044, 0.060**2), (0.517852, 0.106**2), (0.175912, 0.119**2), (0.565380, 8.844**2),
    (1.675299, 20.742**2),
)
SALT_TERMS = (  # NaCl, Li 1976, 297 K
    (1.00055, 0.0), (0.19800, 0.050**2), (0.48398, 0.100**2), (0.38696, 0.128**2), (0.25998, 0.158**2),
    (0.08796, 40.50**2), (3.17064, 60.98**2), (0.30038, 120.34**2),
)
GLASS_TERMS = (  # Schott N-BK7, catalogue 2017-01-20, 293 K
    (1.0, 0.0), (1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653),
)
SUCROSE_PRINCIPAL_N = (1.5376, 1.5651, 1.5705)  # [1] n_alpha, n_beta, n_gamma, 589 nm, source not traced
ICE_NODES_NM = (  # [nm] Warren & Brandt 2008, 266 K
    199, 201, 201.9, 210, 250, 300, 350, 390, *range(400, 1401, 10),
    1410, 1420, 1430, 1440, 1449, 1460, 1471, 1481, 1493, 1504, 1515, 1527, 1538, 1563, 1587, 1613, 1650, 1680, 1700,
    1730, 1760, 1800, 1830, 1840, 1850, 1855, 1860, 1870, 1890, 1905, 1923, 1942, 1961, 1980, 2000, 2020, 2041, 2062,
    2083, 2105, 2130, 2150, 2170, 2190, 2220, 2240, 2245, 2250, 2260, 2270, 2290, 2310, 2330, 2350, 2370, 2390, 2410,
    2430, 2460, 2500, 2520, 2550, 2565, 2580, 2590, 2600, 2620, 2675, 2725, 2778, 2817, 2833, 2849, 2865, 2882, 2899,
    2915, 2933, 2950, 2967, 2985, 3003, 3021, 3040, 3058, 3077, 3096, 3115, 3135, 3155, 3175, 3195, 3215, 3236, 3257,
    3279, 3300, 3322, 3345, 3367, 3390, 3413, 3436, 3460, 3484, 3509, 3534, 3559, 3624, 3732, 3775, 3847, 3969, 4099,
    4239, 4348, 4387, 4444, 4505, 4547, 4560, 4580, 4719, 4904, 5000,
)
ICE_N = (  # [1], from 400 to 1390 nm one row per 100 nm
    1.3943, 1.3914, 1.3901, 1.3801, 1.3509, 1.3339, 1.3249, 1.3203,
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
    1.2937, 1.2934, 1.2931, 1.2929, 1.2927, 1.2924, 1.2921, 1.292, 1.2918, 1.2916, 1.2914, 1.2912, 1.2909, 1.2903,
    1.2897, 1.289, 1.2879, 1.287, 1.2863, 1.2853, 1.2843, 1.2828, 1.2816, 1.2811, 1.2807, 1.2805, 1.2802, 1.2797,
    1.2788, 1.278, 1.2771, 1.2762, 1.2756, 1.275, 1.2744, 1.2736, 1.2728, 1.2718, 1.2707, 1.2694, 1.2677, 1.2663,
    1.2648, 1.2633, 1.2609, 1.2591, 1.2587, 1.2582, 1.2573, 1.2564, 1.2545, 1.2525, 1.2504, 1.2482, 1.2459, 1.2435,
    1.2409, 1.2382, 1.2337, 1.227, 1.2232, 1.2169, 1.2135, 1.2097, 1.2071, 1.2043, 1.1983, 1.1776, 1.1507, 1.1083,
    1.0657, 1.0453, 1.0236, 1.0001, 0.9747, 0.9563, 0.9538, 0.9678, 0.9873, 1.0026, 1.018, 1.039, 1.0722, 1.1259,
    1.2089, 1.3215, 1.4225, 1.4933, 1.5478, 1.597, 1.6336, 1.6477, 1.6405, 1.6248, 1.6108, 1.5905, 1.5714, 1.5559,
    1.5396, 1.5241, 1.5086, 1.4949, 1.4827, 1.471, 1.4604, 1.4502, 1.4411, 1.4328, 1.4146, 1.3924, 1.385, 1.375,
    1.3623, 1.3526,
    1.3447, 1.3406, 1.3401, 1.3412, 1.3444, 1.3473, 1.3482, 1.3491, 1.347, 1.3379, 1.3325,
)
ICE_K = (  # [1], same nodes; the source holds 2e-11 from 202 to 390 nm
    9.565e-11, 3.249e-11, 2e-11, 2e-11, 2e-11, 2e-11, 2e-11, 2e-11,
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
    3.442e-5, 5.959e-5, 1.028e-4, 1.516e-4, 2.03e-4, 2.942e-4, 3.987e-4, 4.941e-4, 5.532e-4, 5.373e-4, 5.143e-4,
    4.908e-4, 4.594e-4, 3.858e-4, 3.105e-4, 2.659e-4, 2.361e-4, 2.046e-4, 1.875e-4, 1.65e-4, 1.522e-4, 1.411e-4,
    1.302e-4, 1.31e-4, 1.339e-4, 1.377e-4, 1.432e-4, 1.632e-4, 2.566e-4, 4.081e-4, 7.06e-4, 0.001108, 0.001442,
    0.001614, 0.00164, 0.001566, 0.001458, 0.001267, 0.001023, 7.586e-4, 5.255e-4, 4.025e-4, 3.235e-4, 2.707e-4,
    2.228e-4, 2.037e-4, 2.026e-4, 2.035e-4, 2.078e-4, 2.171e-4, 2.538e-4, 3.138e-4, 3.858e-4, 4.591e-4, 5.187e-4,
    5.605e-4, 5.956e-4, 6.259e-4, 6.82e-4, 7.53e-4, 7.685e-4, 7.647e-4, 7.473e-4, 7.392e-4, 7.437e-4, 7.543e-4,
    8.059e-4, 0.001367, 0.003508, 0.01346, 0.03245, 0.04572, 0.06287, 0.08548, 0.1198, 0.169, 0.221, 0.276, 0.312,
    0.347, 0.388, 0.438, 0.493, 0.554, 0.612, 0.625, 0.593, 0.539, 0.491, 0.438, 0.372, 0.3, 0.238, 0.193, 0.158,
    0.121, 0.103, 0.0836, 0.0668, 0.05312, 0.04286, 0.03523, 0.02887, 0.02347, 0.01921, 0.01586, 0.01326, 0.0113,
    0.008146, 0.006672, 0.006966, 0.008248, 0.01112, 0.01471,
    0.01867, 0.02411, 0.02656, 0.0299, 0.03179, 0.0309, 0.03007, 0.02883, 0.0194, 0.01347, 0.0124,
)
WATER_FORMULA_NM = 1100.0  # up to here n is from the formula [nm]
WATER_N_NODES_NM = (  # [nm] beyond it Hale & Querry 1973, 25 C
    1200, 1400, 1600, 1800, 2000, 2200, 2400, 2600, 2650, 2700, 2750, 2800, 2850, 2900, 2950, 3000, 3050, 3100, 3150,
    3200, 3250, 3300, 3350, 3400, 3450, 3500, 3600, 3700, 3800, 3900, 4000,
)
WATER_N = (  # [1], same nodes
    1.324, 1.321, 1.317, 1.312, 1.306, 1.296, 1.279, 1.242, 1.219, 1.188, 1.157, 1.142, 1.149, 1.201, 1.292, 1.371,
    1.426, 1.467, 1.483, 1.478, 1.467, 1.45, 1.432, 1.42, 1.41, 1.4, 1.385, 1.374, 1.364, 1.357, 1.351,
)
WATER_NODES_NM = (  # [nm] Hale & Querry 1973, from 1009 nm on Segelstein 1981, 25 C
    *range(200, 1001, 25),
    1009.25, 1020.94, 1030.39, 1039.92, 1049.54, 1059.25, 1069.05, 1078.95, 1088.93, 1099.01, 1109.17, 1119.44,
    1129.8, 1140.25, 1150.8, 1158.78, 1169.5, 1180.32, 1191.24, 1199.5, 1210.6, 1218.99, 1230.27, 1238.8, 1250.26,
    1258.93, 1270.57, 1279.38, 1291.22, 1300.17, 1309.18, 1321.3, 1330.45, 1339.68, 1348.96, 1361.44, 1370.88,
    1380.38, 1389.95, 1399.59, 1409.29, 1419.06, 1428.89, 1438.8, 1448.77, 1458.81, 1468.93, 1479.11, 1489.36,
    1499.68, 1510.08, 1520.55, 1531.09, 1541.7, 1548.82, 1559.55, 1570.36, 1581.25, 1588.55, 1599.56, 1610.65,
    1621.81, 1629.3, 1640.59, 1648.16, 1659.59, 1671.09, 1678.8, 1690.44, 1698.24, 1710.02, 1721.87, 1729.82,
    1741.81, 1749.85, 1761.98, 1770.11, 1778.28, 1790.61, 1798.87, 1811.34, 1819.7, 1828.1, 1840.77, 1849.27,
    1862.09, 1870.68, 1879.32, 1887.99, 1901.08, 1909.85, 1918.67, 1931.97, 1940.89, 1949.84, 1958.84, 1967.89,
    1981.53, 1990.67, 1999.86, 2009.09, 2018.37, 2027.68, 2041.74, 2051.16, 2060.63, 2070.14, 2079.7, 2089.3,
    2098.94, 2108.63, 2118.36, 2128.14, 2137.96, 2147.83, 2157.74, 2167.7, 2177.71, 2187.76, 2197.86, 2208, 2218.2,
    2228.44, 2238.72, 2249.05, 2259.44, 2269.86, 2280.34, 2290.87, 2301.44, 2312.06, 2317.39, 2328.09, 2338.84,
    2349.63, 2360.48, 2371.37, 2382.32, 2387.81, 2398.83, 2409.91, 2421.03, 2432.2, 2437.81, 2449.06, 2460.37,
    2471.72, 2477.42, 2488.86, 2500.35, 2511.89, 2517.68, 2529.3, 2540.97, 2552.7, 2564.48, 2570.4, 2576.32, 2582.26,
    2588.21, 2594.18, 2606.15, 2612.16, 2618.18, 2624.22, 2630.27, 2636.33, 2648.5, 2654.61, 2660.73, 2666.86,
    2673.01, 2679.17, 2685.34, 2697.74, 2703.96, 2710.19, 2716.44, 2722.7, 2728.98, 2741.57, 2747.89, 2754.23,
    2760.58, 2766.94, 2779.71, 2786.12, 2792.54, 2798.98, 2811.9, 2818.38, 2824.88, 2831.39, 2837.92, 2851.02,
    2857.59, 2864.18, 2870.78, 2884.03, 2890.68, 2897.34, 2904.02, 2917.43, 2924.15, 2930.89, 2937.65, 2951.21,
    2958.01, 2964.83, 2978.52, 2985.38, 2999.16, 3047.89, 3097.42, 3147.75, 3198.9, 3250.87, 3303.7, 3349.65,
    3396.25, 3451.44, 3499.45, 3548.13, 3597.49, 3647.54, 3698.28, 3749.73, 3801.89, 3845.92, 3899.42, 3953.67,
    3999.45, 4045.76,
)
WATER_K = (  # [1], same nodes
    1.1e-7, 4.9e-8, 3.35e-8, 2.35e-8,
    1.6e-8, 1.08e-8, 6.5e-9, 3.5e-9, 1.86e-9, 1.3e-9, 1.02e-9, 9.35e-10, 1e-9, 1.32e-9,
    1.96e-9, 3.6e-9, 1.09e-8, 1.39e-8, 1.64e-8, 2.23e-8, 3.35e-8, 9.15e-8, 1.56e-7, 1.48e-7,
    1.25e-7, 1.82e-7, 2.93e-7, 3.91e-7, 4.86e-7, 1.06e-6, 2.93e-6, 3.48e-6, 2.89e-6,
    2.688e-6, 2.352e-6, 2.001e-6, 1.69e-6, 1.419e-6, 1.299e-6, 1.259e-6, 1.329e-6, 1.499e-6, 1.708e-6, 2.038e-6,
    2.628e-6, 3.869e-6, 5.951e-6, 9.306e-6, 1.069e-5, 1.12e-5, 1.16e-5, 1.181e-5, 1.199e-5, 1.191e-5, 1.179e-5,
    1.16e-5, 1.139e-5, 1.1e-5, 1.079e-5, 1.09e-5, 1.139e-5, 1.221e-5, 1.4e-5, 1.639e-5, 1.912e-5, 2.251e-5, 2.849e-5,
    4.047e-5, 4.505e-5, 5.804e-5, 7.802e-5, 1.06e-4, 1.53e-4, 2.54e-4, 3.197e-4, 3.538e-4, 3.629e-4, 3.637e-4,
    3.604e-4, 3.387e-4, 3.018e-4, 2.659e-4, 2.248e-4, 1.958e-4, 1.741e-4, 1.602e-4, 1.441e-4, 1.348e-4, 1.24e-4,
    1.14e-4, 1.071e-4, 9.94e-5, 9.347e-5, 8.804e-5, 8.31e-5, 8.096e-5, 7.903e-5, 7.591e-5, 7.398e-5, 7.404e-5,
    7.495e-5, 7.601e-5, 7.743e-5, 8.05e-5, 8.41e-5, 8.9e-5, 9.51e-5, 1e-4, 1.051e-4, 1.12e-4, 1.219e-4, 1.33e-4,
    1.359e-4, 1.371e-4, 1.38e-4, 1.418e-4, 1.552e-4, 1.861e-4, 3.205e-4, 5.209e-4, 7.224e-4, 9.221e-4, 0.001161,
    0.001678, 0.001827, 0.001922, 0.001909, 0.001848, 0.001717, 0.001548, 0.001402, 0.00125, 0.001101, 9.904e-4,
    8.888e-4, 8.05e-4, 7.392e-4, 6.742e-4, 6.206e-4, 5.725e-4, 5.294e-4, 4.884e-4, 4.643e-4, 4.403e-4, 4.176e-4,
    3.97e-4, 3.826e-4, 3.705e-4, 3.587e-4, 3.506e-4, 3.434e-4, 3.395e-4, 3.379e-4, 3.387e-4, 3.41e-4, 3.458e-4,
    3.571e-4, 3.739e-4, 3.898e-4, 4.081e-4, 4.293e-4, 4.506e-4, 4.686e-4, 4.918e-4, 5.114e-4, 5.43e-4, 5.995e-4,
    6.365e-4, 6.852e-4, 7.427e-4, 7.921e-4, 8.488e-4, 9.095e-4, 9.904e-4, 0.001071, 0.00115, 0.00125, 0.001348,
    0.001472, 0.00158, 0.001709, 0.00181, 0.0019, 0.001953, 0.00199, 0.002017, 0.002069, 0.002142, 0.002269,
    0.002311, 0.002338, 0.002387, 0.002425, 0.002476, 0.002575, 0.002703, 0.002977, 0.003302, 0.004016, 0.004363,
    0.004828, 0.005368, 0.006278, 0.007325, 0.008547, 0.01049, 0.0127, 0.01451, 0.0164, 0.01861, 0.0205, 0.02817,
    0.038, 0.04622, 0.0548, 0.06483, 0.07444, 0.08352, 0.09285, 0.102, 0.1119, 0.121, 0.1312, 0.1422, 0.1541, 0.167,
    0.1798, 0.194, 0.206, 0.2182, 0.229, 0.2392, 0.2493, 0.2581, 0.2647, 0.2715, 0.2759, 0.2798, 0.2804, 0.2824,
    0.2817, 0.2785, 0.2759, 0.2721, 0.2721, 0.2398, 0.1918, 0.1348, 0.09243, 0.06106, 0.03688, 0.02611, 0.01949,
    0.01321, 0.009393, 0.006789, 0.00515, 0.004234, 0.003596, 0.003402, 0.003402, 0.00353, 0.0038, 0.004157, 0.0046,
    0.005067,
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


class TableK:
    """k as a function of the wavelength [nm], log k linear in wavelength between ascending nodes.

    Between a node where k is 0, which has no logarithm, and its neighbours it is k that is linear.
    """

    def __init__(self, nodes_nm: Sequence[float], values: Sequence[float]) -> None:
        self.nodes_nm, self.values = np.array(nodes_nm, np.float64), np.array(values, np.float64)
        self._logs = np.log(np.where(self.values > 0.0, self.values, 1.0))

    def __call__(self, wavelength_nm: float) -> float:
        """Return k [1]; beyond the nodes that of the last."""
        straight = float(np.interp(wavelength_nm, self.nodes_nm, self.values))
        if straight == 0.0 or self.from_zero(wavelength_nm):
            return straight
        return math.exp(np.interp(wavelength_nm, self.nodes_nm, self._logs))

    def from_zero(self, wavelength_nm: float) -> bool:
        """Whether k at a wavelength [nm] is on the straight line between a node of 0 and one of a number."""
        i = int(np.searchsorted(self.nodes_nm, wavelength_nm))
        if not 0 < i < len(self.nodes_nm) or self.nodes_nm[i] == wavelength_nm:
            return False
        low, high = sorted(self.values[i - 1 : i + 1])
        return bool(low <= 0.0 < high)


def quartz_n(wavelength_nm: float) -> float:
    """Return n of quartz, ordinary ray: by Ghosh, beyond `QUARTZ_FORMULA_NM` by Radhakrishnan."""
    return (sellmeier_n(QUARTZ_TERMS) if wavelength_nm <= QUARTZ_FORMULA_NM else sellmeier_n(QUARTZ_FAR_TERMS))(
        wavelength_nm
    )


def water_n(wavelength_nm: float) -> float:
    """Return n of water at a wavelength [nm]: the formula, and from 1200 nm on a table; between them a straight line.

    The line, in 1/wavelength^2 as in tables, joins 1.32400 and 1.324: two sources that agree there.
    """
    formula = sellmeier_n(WATER_TERMS)
    if wavelength_nm <= WATER_FORMULA_NM:
        return formula(wavelength_nm)
    nodes = (WATER_FORMULA_NM, *WATER_N_NODES_NM)
    return table_n(nodes, (formula(WATER_FORMULA_NM), *WATER_N))(wavelength_nm)


MEDIA = {
    "ice": Medium(
        (200.0, 5000.0),
        table_n(ICE_NODES_NM, ICE_N),
        TableK(ICE_NODES_NM, ICE_K),
        "Warren & Brandt 2008, doi:10.1029/2007JD009744, 266 K; birefringence ignored",
    ),
    "water": Medium(
        (200.0, 4000.0),
        water_n,
        TableK(WATER_NODES_NM, WATER_K),
        "n Daimon & Masumura 2007, doi:10.1364/AO.46.003811, 20 C, beyond 1100 nm Hale & Querry; "
        "k Hale & Querry 1973, doi:10.1364/AO.12.000555, 25 C, beyond 1000 nm Segelstein 1981, hdl:10355/11599",
    ),
    "quartz": Medium(
        (198.0, 3000.0),
        quartz_n,
        None,
        "Ghosh 1999, doi:10.1016/S0030-4018(99)00091-7, beyond 2053.1 nm Radhakrishnan 1951, doi:10.1007/BF03172255, "
        "ordinary ray; birefringence ignored",
    ),
    "salt": Medium((200.0, 30000.0), sellmeier_n(SALT_TERMS), None, "NaCl, Li 1976, doi:10.1063/1.555536, 297 K"),
    "glass": Medium(
        (300.0, 2500.0),
        sellmeier_n(GLASS_TERMS),
        TableK(GLASS_NODES_NM, GLASS_K),
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
        One of MATERIALS, ends included: ice 200-5000 nm, water 200-4000, quartz (ordinary ray) 198-3000,
        salt (NaCl) 200-30000, glass (Schott N-BK7) 300-2500, sucrose 400-700. k is None for quartz, salt and
        sucrose. n of sucrose is that of 589 nm throughout; n of quartz falls by 0.017 over the same range.
    wavelength_nm : float
        Wavelength [nm]. Outside the range of the material, or not a number: UsageError.

    Examples
    --------
    >>> round(optical_constants("ice", 550.0).n, 4)
    1.311
    """
    if material not in MATERIALS:
        raise UsageError(
            f"unknown material {material!r}; it is one of {', '.join(MATERIALS)}, or the FILE of your own constants "
            "(a .csv of wavelength_nm,n,k or a .yml of refractiveindex.info); --eta takes the index itself"
        )
    medium, wavelength_nm = MEDIA[material], float(wavelength_nm)
    shortest, longest = medium.range_nm
    if not shortest <= wavelength_nm <= longest:
        raise UsageError(
            f"the wavelength must be {shortest:g} to {longest:g} nm for {material}, not {wavelength_nm:.10g}"
        )
    k = None if medium.k is None else medium.k(wavelength_nm)
    return OpticalConstants(medium.n(wavelength_nm), k, wavelength_nm, material, medium.source)
