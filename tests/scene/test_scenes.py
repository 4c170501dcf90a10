"""The shipped scenes: their assets are sound and the same every time, and each renders at the levels it is for."""

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from scenes import make_assets
from scenes.plate import plate
from scenes.side_by_side import difference, side_by_side
from tsdf.grain.grains import load_grain, read_mesh
from tsdf.grain.optics import Optics
from tsdf.make.scatterometer import Effort, exact_sphere
from tsdf.picture import image, render, world
from tsdf.scene import scene
from tsdf.walk.lights import compile_lights, radiance

FOLDER = Path(make_assets.__file__).parent
LEVELS = {
    "snow": ("teleport", "teleport-memory", "volume"),
    "sand": ("teleport", "teleport-memory", "volume"),
    "beads": ("explicit", "teleport-memory", "teleport"),
}


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    make_assets.make(folder / "assets")
    return folder


@cache
def ball():
    return exact_sphere(load_grain("sphere"), Optics(1.5), Effort(cells=256, joint=32, memory=16))


def loaded(name, folder, width):
    """The shipped scene, small, with the table of a sphere for each of its grains: tables are made by `make tables`."""
    data = tomllib.loads((FOLDER / f"{name}.toml").read_text())
    stand_in = folder / "any.tsdf.exr"
    stand_in.write_bytes(b"")
    for medium in data["medium"]:
        for grain in medium["grain"]:
            grain["table"] = stand_in.name
    made = scene.parse(data, folder, name)
    media = tuple(
        replace(medium, grains=tuple(replace(grain, table=ball()) for grain in medium.grains)) for medium in made.media
    )
    return replace(made, media=media, camera=replace(made.camera, width=width, height=max(1, width * 9 // 16)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "level"), [(name, level) for name in LEVELS for level in LEVELS[name]])
def test_every_scene_renders(assets, name, level):
    """A few pixels of each scene at each of its levels are finite, lit, and no path is lost."""
    made = world.build(loaded(name, assets, 8), level)
    picture = render.render(made, spp=2)
    assert np.isfinite(picture.rgb).all() and picture.rgb.min() >= 0.0
    assert picture.rgb.mean() > 0.01
    assert picture.events > 0
    assert picture.truncated + picture.faults == 0


@pytest.mark.slow
def test_the_meshes_are_closed_and_wound_outward(assets):
    """Each edge is shared by two faces that run along it in opposite ways, and the volume is positive."""
    for name in make_assets.MESHES:
        vertices, faces = read_mesh(assets / "assets" / f"{name}.ply")
        edges = np.concatenate((faces[:, :2], faces[:, 1:], faces[:, [2, 0]]))
        there = {tuple(edge) for edge in edges.tolist()}
        assert len(there) == len(edges), name
        assert all((b, a) in there for a, b in there), name
        a, b, c = vertices[faces].swapaxes(0, 1)
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0.0, name
        assert vertices[:, 2].min() == 0.0, name


def test_one_ball_lies_under_the_snow_and_one_half_in_it(assets):
    """The blue ball is inside the heap, 2 to 6 mm below its surface, so that it shines through and nothing of it stands
    out; the red one crosses the surface: the negative control."""
    import trimesh

    vertices, faces = read_mesh(assets / "assets" / "snow_heap.ply")

    def cover(ball):
        """Distance from a ball, whose centre is inside, to the surface [m]."""
        centre = np.array(ball.shape.centre)
        nearest = trimesh.triangles.closest_point(vertices[faces], np.tile(centre, (len(faces), 1)))
        nearest = nearest[np.linalg.norm(nearest - centre, axis=1).argmin()]
        above = vertices[np.hypot(*(vertices - centre)[:, :2].T).argsort()[:3], 2].max()
        assert ball.name == "red ball" or above > centre[2] + ball.shape.radius
        return np.linalg.norm(nearest - centre) - ball.shape.radius

    balls = {surface.name: cover(surface) for surface in loaded("snow", assets, 8).surfaces if "ball" in surface.name}
    assert 0.002 < balls["blue ball"] < 0.006
    assert balls["red ball"] < -0.02


@pytest.mark.slow
def test_skies_stand_as_the_scenes_are_lit(assets):
    """The evening's warm side is -x, where the sun of sand.toml is; the studio's window is on the left of the camera
    that looks along +y, its warm strip on the right: by the directions that the renderer looks in."""

    def red_less_blue(name, *azimuths_deg):
        lights = compile_lights(environment=image.read_exr(assets / "assets" / f"{name}.exr").rgb)
        ways = [(np.cos(a), np.sin(a), 0.7) for a in np.radians(azimuths_deg)]
        seen = [radiance(lights, tuple(np.array(way) / np.linalg.norm(way)), -1.0) for way in ways]
        return [r - b for r, _, b in seen]

    west, east = red_less_blue("evening_sky", 180.0, 0.0)
    assert west > east
    window, strip = red_less_blue("studio", 115.0, -40.0)
    assert window < -1.0 and strip > 1.0


def test_assets_are_the_same_every_time(assets, tmp_path):
    """Two makings give the same bytes."""
    for path in make_assets.make(tmp_path):
        assert path.read_bytes() == (assets / "assets" / path.name).read_bytes(), path.name


def test_a_plate_holds_its_pictures_in_order(tmp_path):
    """Two small pictures come out beside each other, the first on the left; another size is refused."""
    from matplotlib import image as png

    red, blue = np.zeros((2, 3, 4, 3))
    red[..., 0], blue[..., 2] = 1.0, 1.0
    paths = [tmp_path / name for name in ("red.png", "blue.png", "tall.png", "plate.png")]
    for path, picture in zip(paths, (red, blue, np.zeros((5, 4, 3))), strict=False):
        png.imsave(path, picture)
    plate(paths[:2], paths[3])
    assert np.array_equal(png.imread(paths[3])[..., :3], np.concatenate((red, blue), axis=1))
    with pytest.raises(SystemExit, match="not of the same size"):
        plate(paths[1:3], paths[3])


def test_difference_tells_noise_from_error(tmp_path):
    """Pictures that differ by their noise show as such, and a bias of 10 % shows as 10 %: the negative control."""
    rng = np.random.default_rng(0)
    noise = 0.05
    variance = np.full((60, 80, 3), noise**2, np.float32)

    def picture(mean):
        grey = rng.normal(mean, noise, (60, 80, 1)) * np.ones(3)
        return image.Image(grey.astype(np.float32), variance)

    standard_error = noise * np.sqrt(2.0 / (60 * 80))
    truth = picture(1.0)
    same = difference(picture(1.0), truth)
    assert abs(same.bias) < 4.0 * standard_error
    assert abs(same.error - same.noise) < 4.0 * standard_error
    other = difference(picture(1.1), truth)
    assert abs(other.bias - 0.1) < 4.0 * standard_error
    assert other.error - other.noise > 4.0 * standard_error
    paths = [tmp_path / f"{level}.exr" for level in ("explicit", "teleport")]
    for path in paths:
        image.write_exr(path, truth.rgb, truth.variance, {"tsdf_render": f'{{"level": "{path.stem}"}}'})
    ((level, none),) = side_by_side(paths, tmp_path / "plate.png")
    assert level == "teleport" and none.error == 0.0 and none.noise > 0.0
    assert (tmp_path / "plate.png").stat().st_size > 1000
