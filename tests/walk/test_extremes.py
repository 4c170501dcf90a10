"""Tables at the ends of what the format allows: numbers of use, or one line; never a foreign exception or a NaN."""

import copy
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import netcdf_file

from tsdf.cli.export import TARGETS
from tsdf.cli.export import main as export
from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import UsageError
from tsdf.judge.validate import judge
from tsdf.loaders import radiative
from tsdf.picture import world
from tsdf.reference_data import make_golden
from tsdf.scene import scene
from tsdf.scene.medium import Component, free_path, volume_parameters
from tsdf.study import plots


def rows(header: dict[str, Any], name: str) -> slice:
    block = next(block for block in header["blocks"] if block["name"] == name)
    return slice(block["first_row"], block["first_row"] + block["rows"])


def made(
    change: Callable[[dict[str, Any], np.ndarray], Any], weights: list[int] | None = None, other: int = 2
) -> Table:
    """Return a table with one thing changed, which both the writer and the reader have passed."""
    header, pixels = make_golden.table(weights or [1, 1, 2, 4, 6, 2], count=8, joint=True, memory=4, other=other)
    header, pixels = copy.deepcopy(header), pixels.copy()
    change(header, pixels)
    table, findings = tsdf_format.inspect(make_golden.file(header, pixels))
    assert table is not None, findings
    return table


def backwards(header: dict[str, Any], pixels: np.ndarray) -> None:
    """All light leaves behind where it came in, and each ray meets the grain."""
    z = rows(header, "p_z")
    pixels[z] = 0.0
    pixels[z.start] = 1.0
    header["statistics"] |= {"mean_z": -1.0, "hit_probability": 1.0}
    header["energy_ledger"] |= {"unscattered": 0, "scattered": 1000}


def rare(header: dict[str, Any], pixels: np.ndarray) -> None:
    header["energy_ledger"] |= {"launched": 2**62, "unscattered": 2**62 - 1, "scattered": 1}
    header["statistics"]["hit_probability"] = 2.0**-62


def far(header: dict[str, Any], pixels: np.ndarray) -> None:
    """Paths as long as they may be: nothing is let out by the least absorption."""
    next(block for block in header["blocks"] if block["name"] == "p_l")["edges"][-1] = 1e30
    for name, value in (("p_l", 1.0), ("mean_l", 9e29)):
        block = rows(header, name)
        pixels[block] = 0.0
        pixels[block.stop - 1] = value
    pixels[rows(header, "joint_l")] = 9e29
    header["statistics"]["mean_path_length"] = 9e29


def narrow(header: dict[str, Any], pixels: np.ndarray) -> None:
    """Cells as narrow as they may be."""
    next(block for block in header["blocks"] if block["name"] == "p_r")["edges"][1] = 1e-30
    block = rows(header, "p_r")
    pixels[block] = 0.0
    pixels[block.start] = 1.0
    header["statistics"]["mean_r"] = 0.0
    header["columns"]["edges"][2] = math.nextafter(-1.0, 0.0)


def loud(header: dict[str, Any], pixels: np.ndarray) -> None:
    """Errors, areas and volumes as large, eta as small as they may be."""
    for name, error in header["standard_errors"].items():
        header["standard_errors"][name] = [1e30] * 17 if isinstance(error, list) else 1e30
    header["table_error"] = dict.fromkeys(header["table_error"], 1e30)
    header["grain"] |= {"area": 1e30, "volume": 1e30, "bounding_radius": 1e30, "faces": 2**63 - 1}
    header["optics"] |= {"eta": 1e-30, "wavelength_nm": 5e-324, "k": 1e30}
    header["provenance"] |= {"paths": 2**63 - 1, "max_bounces": 2**63 - 1}
    header["fits"]["henyey_greenstein"] = {"g": 1.0 - 2.0**-53, "total_variation": 1e30}


EXTREMES = {
    "straight_on": made(lambda header, pixels: None, [0, 0, 0, 1]),
    "above_one": made(lambda header, _: header["statistics"].update(mean_cosine=1.0000000009), [0, 0, 0, 1]),
    "straight_back": made(lambda header, pixels: None, [1, 0, 0, 0]),
    "rare": made(rare),
    "far": made(far),
    "narrow": made(narrow),
    "loud": made(loud),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTREMES)
def test_media_and_exports(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Numbers of the medium are finite where light is let out, and each exporter has its say."""
    table = EXTREMES[name]
    for absorption in (0.0, 1e-6, 1e6):
        volume = volume_parameters([Component(table)], 0.6, [absorption])
        assert 0.0 <= volume.albedo <= 1.0 and math.isfinite(volume.sigma_t) and volume.sigma_a >= 0.0
        assert -1.0 <= volume.g <= 1.0 if volume.albedo > 0.0 else math.isnan(volume.g)
    tsdf_format.write(table, tmp_path / "t.tsdf.exr")
    for target in TARGETS:
        arguments = [str(tmp_path / "t.tsdf.exr"), "--to", target, "--packing", "0.6", "--radius", "1"]
        with pytest.raises(SystemExit) as done:
            export.main([*arguments, "--out", str(tmp_path / target)])
        assert done.value.code == 0, capsys.readouterr().err
        if target in radiative.FILES:
            with netcdf_file(tmp_path / target, mmap=False) as file:
                assert all(np.isfinite(variable[:]).all() for variable in file.variables.values())
        elif target != "npz":
            assert not re.search(r"\b(nan|inf)\b", (tmp_path / target).read_text(), flags=re.I)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTREMES)
def test_judged_and_drawn(name: str, tmp_path: Path) -> None:
    """`tsdf-validate` has findings, or none; a picture is a picture."""
    findings, checks = judge(EXTREMES[name])
    assert checks > 20 and all("\n" not in finding.message for finding in findings)
    for draw in (plots.plot_table, plots.plot_validation):
        plots.save(draw(EXTREMES[name]), tmp_path / "t.png")


@pytest.mark.slow
@pytest.mark.parametrize("level", ["volume", "volume-hg", "isotropic"])
@pytest.mark.parametrize("name", EXTREMES)
def test_scenes(name: str, level: str, tmp_path: Path) -> None:
    """What kernels take of the levels that go by statistics is finite, whatever is absorbed."""
    (tmp_path / "t.tsdf.exr").touch()
    for absorption in (0.0, 1e6):
        data = {
            "camera": {"position": [0, -3, 1], "target": [0, 0, 0], "width": 4, "height": 4},
            "light": [{"type": "constant", "radiance": [1, 1, 1]}],
            "medium": [
                {
                    "shape": {"type": "sphere", "centre": [0, 0, 0], "radius": 1.0},
                    "packing_fraction": 0.6,
                    "radius": 0.01,
                    "grain": [{"table": "t.tsdf.exr", "absorption": absorption}],
                }
            ],
        }
        parsed = scene.parse(data, tmp_path)
        (medium,) = parsed.media
        grain = medium.grains[0].__class__(**{**vars(medium.grains[0]), "table": EXTREMES[name]})
        object.__setattr__(medium, "grains", (grain,))
        media = world.build(parsed, level).media
        assert np.isfinite(media.free).all() and (media.free > 0.0).all()
        assert np.isfinite(media.g).all() and (np.abs(media.g) <= 1.0).all()


def test_light_that_goes_back_farther_than_on() -> None:
    """A mean z of -1 R in a dense packing would make the extinction negative: one line; in a loose one it does not."""
    table = made(backwards, other=200)
    with pytest.raises(UsageError, match="mean z -1") as caught:
        free_path([Component(table)], 0.6)
    assert "\n" not in str(caught.value)
    assert 0.0 < free_path([Component(table)], 0.3).sigma_t < math.inf
