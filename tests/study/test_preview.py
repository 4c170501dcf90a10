"""Advice by a stated rule, and previews that are drawn as it says where the table can."""

import math
from pathlib import Path

import numpy as np
import pytest

import tsdf
from tsdf.grain.grains import grain_from_mesh
from tsdf.grain.meshes import read_mesh
from tsdf.reference_data.make_checks import CHECKS
from tsdf.scene.scene import Absorption, GrainSpec
from tsdf.study import preview
from tsdf.study.advice import Medium, advise

SNOW = Medium(packing_fraction=0.6, transport=8.0, mean_cosine=0.54)
MIRROR = SNOW._replace(mean_cosine=0.0)
DUST = SNOW._replace(packing_fraction=0.1)


@pytest.mark.parametrize(
    ("footprint", "thickness", "medium", "level", "singles"),
    [
        (0.1, 5.0, SNOW, "explicit", 0),
        (0.1, 50.0, MIRROR, "explicit", 0),
        (0.1, 50.0, SNOW, "teleport-memory", 9),
        (0.5, 50.0, SNOW, "teleport-memory", 7),
        (1.0, 50.0, SNOW, "teleport-memory", 0),
        (1.0, 50.0, MIRROR, "teleport-packed", 0),
        (2.0, 9.0, DUST, "teleport-memory", 0),
        (2.0, 10.0, DUST, "teleport", 0),
        (2.0, 199.0, SNOW, "teleport-memory", 0),
        (2.0, 200.0, SNOW, "volume", 0),
        (2.0, math.inf, MIRROR, "volume", 0),
        (2.0, 50.0, SNOW._replace(packing_fraction=0.7), "teleport", 0),
    ],
)
def test_the_rule(footprint: float, thickness: float, medium: Medium, level: str, singles: int) -> None:
    """Each branch, on both sides of its limits; k = 4 ln(texture / target), and more where pixels cover less."""
    advice = advise(footprint, thickness, medium)
    assert (advice.level, advice.explicit_grains) == (level, singles)
    assert advice.reason and str(advice).startswith(f"take level {level} here")


def test_a_table_without_records_is_drawn_at_what_it_has() -> None:
    table, cube = tsdf.read(CHECKS / "PHYSICS_CHORD.tsdf.exr"), tsdf.read(CHECKS / "cube_memory.tsdf.exr")
    assert not table.memory and cube.memory
    near = advise(0.1, 50.0, SNOW)
    assert preview._drawable(near, cube, True) == ("teleport-memory", 9, "")
    assert preview._drawable(near, cube, False)[:2] == ("teleport-packed", 0)
    level, singles, why = preview._drawable(advise(2.0, 50.0, SNOW), table, True)
    assert (level, singles) == ("teleport", 0) and "--memory 64" in why


def test_the_heap_is_closed(tmp_path: Path) -> None:
    """Its volume is that of its profile, which an open or turned mesh would not have."""
    preview._write_heap(tmp_path / "heap.obj")
    vertices, faces = read_mesh(tmp_path / "heap.obj")
    heap = grain_from_mesh(vertices, faces, name="heap")
    radius, height = preview.HEAP
    assert heap.volume * heap.bounding_radius**3 == pytest.approx(math.pi * radius**2 * height * 5.0 / 12.0, rel=0.02)


def test_the_deep_colour() -> None:
    """White without absorption; by wavelength the same as by channel where all absorb alike."""
    cube = tsdf.read(CHECKS / "cube_memory.tsdf.exr")
    white, grey = preview._deep(GrainSpec(cube), cube, None)
    assert white == pytest.approx(np.ones(3)) and grey == 0.0
    flat = Absorption("spectral", (0.01, 0.01), (380.0, 780.0))
    by_wavelength, grey = preview._deep(GrainSpec(cube, absorption=flat), cube, None)
    by_channel, _ = preview._deep(GrainSpec(cube, absorption=Absorption("grey", (0.01,))), cube, None)
    assert by_wavelength == pytest.approx(by_channel, abs=1e-9) and grey == pytest.approx(0.01)
    assert 0.2 < by_channel[0] < 0.9
