"""The colour of a deep medium, or of a slab, by rendering it: what `tsdf.scene.deep` computes, as a picture shows it.

White light falls from all directions of a half space; nothing lies behind. By reciprocity it is enough to look from a
few directions at light from everywhere.
"""

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tsdf.data.table import Table
from tsdf.picture import image, render, world
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.scene import Absorption, Camera, EnvironmentLight, GrainSpec, MediumSpec, Scene, Slab

VIEWS = 6  # directions from which it is looked, at Gauss's nodes in the cosine
WIDTH = 40.0  # [R] of a beam, so that explicit grains are met everywhere
DEEP = 12.0  # [diffusion lengths] e^-12 of the light passes
FEWEST = 40.0  # [R] a layer of few grains is none at levels that jump


def rendered(
    table: Table,
    absorption_times_radius: Sequence[float],
    packing_fraction: float,
    level: str = "volume",
    thickness: float = math.inf,
    samples: int = 4000,
    seed: int = 0,
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of diffuse light that grains send back, red, green, blue (3,) [1], and its standard error.

    Parameters
    ----------
    table : Table
    absorption_times_radius : (3,) float
        sigma_a R of the grains' material by channel [1].
    packing_fraction : float
        Share of the volume in bounding spheres [1].
    level : str
        Of the renderer.
    thickness : float
        Of a slab [R]; deep by default.
    samples : int
        Paths of each view.
    seed, threads
        As of `tsdf.picture.render.measure`.

    Raises
    ------
    UsageError, SceneError
        For what the renderer refuses.
    """
    x = np.array(absorption_times_radius, dtype=np.float64)
    least = volume_parameters([Component(table)], packing_fraction, [float(x.min())])
    if math.isinf(thickness):
        effective = math.sqrt(3.0 * least.sigma_a * (least.sigma_a + least.sigma_s_reduced))
        thickness = max(FEWEST, DEEP / max(effective, 1e-12))
    red, green, blue = x.tolist()
    grains = (GrainSpec(table, absorption=Absorption("rgb", (red, green, blue))),)
    body = MediumSpec(Slab(-thickness, 0.0), packing_fraction, 1.0, grains, name="deep", inside="centres")
    camera = Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 1, 1, up=(0.0, 1.0, 0.0))
    cosines, weights = np.polynomial.legendre.leggauss(VIEWS)
    cosines, weights = 0.5 * (cosines + 1.0), 0.5 * weights
    rgb, variance = np.zeros(3), np.zeros(3)
    with tempfile.TemporaryDirectory() as folder:
        sky = Path(folder) / "sky.exr"
        image.write_exr(sky, np.array([[[1.0] * 3], [[0.0] * 3]]))
        built = world.build(Scene(camera, (EnvironmentLight(sky),), (body,), name="colour"), level)
        for view, (mu, weight) in enumerate(zip(cosines.tolist(), weights.tolist(), strict=True)):
            beam = world.beam(built, (0.0, 0.0, 2.0 + WIDTH), (math.sqrt(1.0 - mu * mu), 0.0, -mu), WIDTH)
            seen = render.measure(built, beam, spp=samples, seed=seed * VIEWS + view, threads=threads)
            rgb += 2.0 * weight * mu * seen.rgb[0, 0]
            variance += (2.0 * weight * mu) ** 2 * seen.variance[0, 0]
    return rgb, np.sqrt(variance)
