"""Many builds of random grains, indices and efforts: each must end in a table that can be written and read again.

`python fuzz/builds.py --count 2000` takes about ten minutes and says what was lost; 0 of them is right. A number with
--first repeats one. What a build computes must satisfy what the writer checks, by construction.
"""

import argparse
import math
import sys
import tempfile
from pathlib import Path

import numpy as np

from tsdf.data import format as files
from tsdf.data.table import Table
from tsdf.errors import TSDFError
from tsdf.grain.grains import Grain, grain_from_mesh, load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Build, Effort, exact_sphere

BUILT_INS = {
    "cube": {},
    "octahedron": {},
    "tetrahedron": {},
    "icosphere": {"subdivisions": (0, 3)},
    "hexprism": {"aspect": (0.05, 8.0)},
    "sand": {"subdivisions": (2, 3)},
    "snow": {},
}


def random_grain(rng: np.random.Generator) -> Grain:
    """Return a built-in grain, a random convex crystal, flat and long ones too, or one with a dent in every facet."""
    from scipy.spatial import ConvexHull

    kind = rng.integers(4)
    if kind == 0:
        name = str(rng.choice(list(BUILT_INS)))
        ranges = BUILT_INS[name]
        whole = name in ("icosphere", "sand")
        return load_grain(name, **{
            key: int(rng.integers(low, high + 1)) if whole else float(low * (high / low) ** rng.random())
            for key, (low, high) in ranges.items()
        })  # fmt: skip
    if kind == 1:
        return load_grain("sphere")
    points = rng.normal(size=(int(rng.integers(4, 30)), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= np.exp(rng.normal(0.0, 0.7, 3))
    hull = ConvexHull(points)
    faces, vertices = hull.simplices.copy(), points.copy()
    turned = np.einsum("ij,ij->i", np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))),
                       hull.equations[:, :3]) < 0.0  # fmt: skip
    faces[turned] = faces[turned][:, ::-1]
    if kind == 3:
        dents = vertices[faces].mean(axis=1) * rng.uniform(0.4, 0.95, (len(faces), 1))
        tips = len(vertices) + np.arange(len(faces))
        faces = np.concatenate([np.column_stack((faces[:, k], faces[:, (k + 1) % 3], tips)) for k in range(3)])
        vertices = np.concatenate((vertices, dents))
    return grain_from_mesh(vertices, faces, name=("crystal", "dented")[kind - 2])


def request(number: int) -> tuple[Grain, Optics, Effort]:
    """Return what build `number` is of."""
    rng = np.random.default_rng([2000, number])
    grain = None
    while grain is None:
        try:
            grain = random_grain(rng)
        except TSDFError:  # slivers, dents that meet: no grain
            continue
    eta = float(rng.choice([1.0, 1.31, 1.5])) if rng.random() < 0.2 else float(0.5 * 8.0 ** rng.random())
    polarised = grain.kind == "sphere" and rng.random() < 0.3
    effort = Effort(
        paths=int(1024 * 10.0 ** rng.random()),
        cells=int(16 * 32.0 ** rng.random()),
        joint=int(rng.choice([0, 1, 8])),
        memory=int(rng.choice([0, 1, 8])),
        seed=number,
    )
    return grain, Optics(eta, "sp" if polarised else "un"), effort


def build(number: int) -> Table:
    """Return the table of build `number`; every other sphere is made by quadrature."""
    grain, optics, effort = request(number)
    if grain.kind == "sphere" and number % 2:
        return exact_sphere(grain, optics, Effort(cells=effort.cells, joint=effort.joint, memory=effort.memory))
    made = Build.start(grain, optics, effort)
    made.run(grain)
    return made.table()


def lost(number: int, folder: Path) -> str | None:
    """Return why build `number` gave no table, None if it gave one."""
    path = folder / "table.tsdf.exr"
    try:
        files.write(build(number), path)
        table = files.read(path)
        assert math.isclose(table.p_theta.sum(), 1.0, abs_tol=1e-5)
    except Exception as error:
        grain, optics, effort = request(number)
        return f"{grain.name}, eta {optics.eta:g}, {effort}: {type(error).__name__}: {error}"
    return None


def main() -> int:
    """Build, and say what was lost."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    found = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.first, options.first + options.count):
            if reason := lost(number, Path(folder)):
                found += 1
                print(f"{number}: {reason}", flush=True)
    print(f"{found} of {options.count} builds lost")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
