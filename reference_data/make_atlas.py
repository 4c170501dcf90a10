"""Makes the atlas of level errors, ``level_errors.csv``: ``python -m tsdf.reference_data.make_atlas``.

What slabs of packed grains reflect and let through, at every level, over what they do at level explicit, as
``tsdf-accuracy`` measures it: spheres, snow and mirrors, over packing fraction, thickness, angle and albedo. It takes
about eight minutes of one processor; the same version of the package makes the same bytes.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

import tsdf
from tsdf.make.scatterometer import Build
from tsdf.scene.levels import LEVELS
from tsdf.scene.medium import Component, volume_parameters
from tsdf.scene.scene import Absorption, GrainSpec
from tsdf.study.experiment import Sums, cuts, gather, slab_experiment

FILE = Path(__file__).parent / "level_errors.csv"
FRACTIONS, LAYERS, ANGLES = (0.1, 0.3, 0.5, 0.6), (4.0, 10.0, 40.0), (0.0, 60.0)  # [1], [R], [degrees]
ALBEDOS = (1.0, 0.99, 0.9)  # of a grain [1]
PACKINGS = 3
TRACED = 1_000_000  # paths of a table
PATHS = 100_000  # of a slab and level; of explicit all packings together
GRAINS = {"sphere": 1.33, "snow": 1.311, "mirror": 1e9}  # and their refractive index
COLUMNS = (
    "grain,mean_cosine,packing_fraction,layer,transport,albedo,angle_deg,level,reflectance,reflectance_error,"
    "reflectance_deviation,reflectance_deviation_error,transmittance_deviation,transmittance_deviation_error"
)
HEAD = """\
# What slabs reflect and let through at each level, over explicit; made by python -m tsdf.reference_data.make_atlas.
# packing_fraction [1]; layer of centres, transport mean free path l* [R]; albedo of a grain [1]; deviations over
# explicit, with the standard errors of both [1]. CC0-1.0.
"""


def table_of(name: str) -> tsdf.Table:
    """Return the table of a grain, with records of all kinds."""
    grain, optics = tsdf.load_grain("sphere" if name == "mirror" else name), tsdf.Optics(GRAINS[name])
    if name == "sphere":
        return tsdf.build(grain, optics, tsdf.Effort(joint=32, memory=64))
    begun = Build.start(grain, optics, tsdf.Effort(paths=TRACED, joint=32, memory=64))
    begun.run(grain, 1)
    return begun.table()


def coefficients(table: tsdf.Table) -> list[tuple[float, float]]:
    """Return albedos of a grain, and the absorption coefficients [1/R] that make them, as far as any does."""

    def left(coefficient: float, albedo: float) -> float:
        return table.albedo(coefficient) / table.albedo() - albedo

    found = [(1.0, 0.0)]
    for albedo in ALBEDOS[1:]:
        if left(100.0, albedo) < 0.0:
            found.append((albedo, float(brentq(left, 0.0, 100.0, args=(albedo,)))))
    return found


def measured(
    level: str, spec: GrainSpec, fraction: float, layer: float, cosine: float, absorbing: list[float], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return reflectance and transmittance (a, 2) for each absorption coefficient, and their standard errors."""
    traits = LEVELS[level].traits
    if traits.packed:
        tops = [(k, top) for k in range(PACKINGS) for top in cuts(fraction, layer)]
        runs = [
            gather(slab_experiment(level, spec, fraction, layer, cosine, k, absorbing, top), PATHS // len(tops),
                   None, seed + i, 1)
            for i, (k, top) in enumerate(tops)
        ]  # fmt: skip
        means = np.array([picked(run, len(absorbing)) for run in runs])
        inner = np.sqrt(sum(picked(run, len(absorbing), True) ** 2 for run in runs)) / len(runs)
        return means.mean(axis=0), np.maximum(inner, means.std(axis=0, ddof=1) / math.sqrt(len(runs)))
    if traits.spheres:
        run = gather(slab_experiment(level, spec, fraction, layer, cosine, 0, absorbing), PATHS, None, seed, 1)
        return picked(run, len(absorbing)), picked(run, len(absorbing), True)
    each = [
        gather(slab_experiment(level, replace(spec, absorption=Absorption("grey", (c,))), fraction, layer, cosine),
               PATHS, None, seed + k, 1)
        for k, c in enumerate(absorbing)
    ]  # fmt: skip
    return np.concatenate([picked(one, 1) for one in each]), np.concatenate([picked(one, 1, True) for one in each])


def picked(run: Sums, count: int, errors: bool = False) -> np.ndarray:
    """Return reflectance and transmittance (count, 2) of a run, or their errors."""
    values = run.error if errors else run.mean
    return values.reshape(count, -1)[:, :2]


def rows() -> Iterator[str]:
    """Yield the lines of the file."""
    seed = 0
    for name in GRAINS:
        table = table_of(name)
        absorbing = coefficients(table)
        spec = GrainSpec(table, absorption=Absorption("grey", (0.0,)))
        for fraction in FRACTIONS:
            medium = volume_parameters([Component(table)], fraction)
            for layer in LAYERS:
                for angle in ANGLES:
                    found = {}
                    for level in LEVELS:
                        seed += 1000
                        cosine, every = math.cos(math.radians(angle)), [c for _, c in absorbing]
                        found[level] = measured(level, spec, fraction, layer, cosine, every, seed)
                    true, own = found["explicit"]
                    place = f"{name},{medium.g:.4f},{fraction:g},{layer:g},{medium.transport_mean_free_path:.4g}"
                    for k, (albedo, _) in enumerate(absorbing):
                        for level, (mean, error) in found.items():
                            off = mean[k] / true[k] - 1.0
                            far = np.hypot(error[k] / true[k], mean[k] * own[k] / true[k] ** 2)
                            if level == "explicit":
                                off, far = 0.0 * off, own[k] / true[k]
                            yield (
                                f"{place},{albedo:g},{angle:g},{level},{mean[k, 0]:.5f},{error[k, 0]:.1e},"
                                f"{off[0]:.5f},{far[0]:.1e},{off[1]:.5f},{far[1]:.1e}"
                            )
                    print(f"{name}, f {fraction:g}, {layer:g} R, {angle:g} degrees", file=sys.stderr, flush=True)


def main() -> None:
    """Write the file."""
    text = HEAD + COLUMNS + "\n" + "".join(f"{row}\n" for row in rows())
    FILE.write_text(text)


if __name__ == "__main__":
    main()
