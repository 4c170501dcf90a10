"""What `import tsdf` offers beyond reading and writing: the same as the command line does, in one call each."""

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

import tsdf
from tsdf.cli.build import main as build
from tsdf.errors import SceneError, UsageError
from tsdf.reference_data.make_checks import CHECKS

TEXT = (Path(__file__).parent / "ball.toml").read_text()
SCENE = {**tomllib.loads(TEXT), "render": {"spp": 2, "seed": 5, "level": "volume"}}


@pytest.mark.slow
@pytest.mark.parametrize("words", [("sphere", "--cells", "32"), ("cube", "--paths", "5000", "--joint", "2")])
def test_build_makes_what_the_command_makes(words: tuple[str, ...], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as done:
        build([*words, "--eta", "1.31", "--quiet", "--out", str(tmp_path / "command.exr")])
    assert done.value.code == 0
    grain, *options = words
    effort = tsdf.Effort(**{name[2:]: int(value) for name, value in zip(options[::2], options[1::2], strict=True)})
    tsdf.write(tsdf.build(grain, 1.31, effort, threads=1), tmp_path / "call.exr")
    assert (tmp_path / "call.exr").read_bytes() == (tmp_path / "command.exr").read_bytes()
    again = tsdf.build(tsdf.load_grain(grain), tsdf.Optics(1.31), effort)
    np.testing.assert_array_equal(again.pixels, tsdf.read(tmp_path / "call.exr").pixels)


def test_build_refuses() -> None:
    for eta, effort in ((-1.0, None), (1.31, tsdf.Effort(target_error=1e-9, cells=32))):
        with pytest.raises(UsageError):
            tsdf.build("sphere", eta, effort)


@pytest.mark.slow
def test_render_takes_scenes_of_all_kinds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file, a dict and a scene give one picture; what is said of the scene holds unless it is said otherwise."""
    shutil.copy(CHECKS / "cube.tsdf.exr", tmp_path)
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(TEXT.replace('level = "teleport"', 'level = "volume"').replace("spp = 3", "spp = 2"))
    whole = tsdf.render(SCENE)
    assert whole.rgb.shape == (8, 12, 3) and (whole.samples == 2).all() and whole.rgb.min() < 0.25
    for scene in ("scene.toml", Path("scene.toml"), tsdf.load_scene("scene.toml")):
        np.testing.assert_array_equal(tsdf.render(scene, threads=1).rgb, whole.rgb)
    small = tsdf.render(SCENE, "isotropic", spp=1, width=3, seed=6)
    assert small.rgb.shape == (2, 3, 3) and (small.samples == 1).all()
    assert not np.array_equal(tsdf.render(SCENE, seed=6).rgb, whole.rgb)
    assert tsdf.render(SCENE, target_error=0.5).relative_error <= 0.5
    with pytest.raises(SceneError, match="no level 'telepot'"):
        tsdf.render(SCENE, "telepot")


def test_render_says_what_is_to_know(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The notes of a scene are warnings: here of a grain that is larger than its medium."""
    shutil.copy(CHECKS / "cube.tsdf.exr", tmp_path)
    monkeypatch.chdir(tmp_path)
    medium = {**SCENE["medium"][0], "radius": 4.0}  # type: ignore[index]
    with pytest.warns(UserWarning, match="does not fit into the medium"):
        tsdf.render({**SCENE, "medium": [medium]}, spp=1)
