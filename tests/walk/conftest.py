"""What tests of lanes share: a table, and a sky that tells directions apart."""

import numpy as np
import pytest

from tsdf.data.table import Table
from tsdf.grain.grains import load_grain
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import image
from tsdf.scene.scene import EnvironmentLight


@pytest.fixture(scope="session")
def table() -> Table:
    """Return the table of the exact sphere."""
    return exact_sphere(load_grain("sphere"), Optics(1.33), Effort(cells=64, joint=8))


@pytest.fixture(scope="session")
def sky(tmp_path_factory: pytest.TempPathFactory) -> EnvironmentLight:
    """Return a sky of another radiance in every direction, so even that nothing is aimed at it."""
    file = tmp_path_factory.mktemp("sky") / "sky.exr"
    image.write_exr(file, np.random.default_rng(1).uniform(0.5, 1.5, (16, 32, 3)))
    return EnvironmentLight(file)
