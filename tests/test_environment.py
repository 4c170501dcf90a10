"""Environments from the file to the picture: where each pixel is seen, and what is said of pixels and shapes."""

import numpy as np
import pytest

from tsdf.picture import image, render, world
from tsdf.scene.scene import Camera, EnvironmentLight, Scene, Sphere, SurfaceSpec

RED, GREEN, BLUE = np.eye(3)


def looking(folder, pixels, target=(-1.0, 0.0, 0.0), rotation_deg=0.0):
    """Return the world of a camera inside an environment, with a speck of a surface in its view."""
    image.write_exr(folder / "sky.exr", pixels)
    camera = Camera((0.0, 0.0, 0.0), target, 40, 20, fov_deg=90.0)
    speck = SurfaceSpec(Sphere(target, 0.05), (0.5, 0.5, 0.5))
    sky = EnvironmentLight(folder / "sky.exr", rotation_deg=rotation_deg)
    return world.build(Scene(camera, (sky,), (), (speck,)), "teleport")


@pytest.mark.parametrize(
    ("target", "rotation_deg", "left", "right"),
    [
        ((-1.0, 0.0, 0.0), 0.0, RED, BLUE),  # the middle of the image
        ((0.0, -1.0, 0.0), 90.0, RED, BLUE),  # turned counter-clockwise seen from above, to -y
        ((1.0, 0.0, 0.0), 0.0, GREEN, GREEN),  # its edges
        ((1.0, 0.0, 0.0), -180.0, RED, BLUE),
        ((0.0, -1.0, 0.0), 0.0, GREEN, RED),
        ((0.0, 1.0, 0.0), 0.0, BLUE, GREEN),
    ],
)
def test_left_in_the_image_is_left_in_the_picture(tmp_path, target, rotation_deg, left, right):
    """Red left of the middle and blue right of it, green elsewhere, seen by a camera in the middle of the world."""
    pixels = np.zeros((32, 64, 3))
    pixels[...] = GREEN
    pixels[:, 16:32], pixels[:, 32:48] = RED, BLUE
    picture = render.render(looking(tmp_path, pixels, target, rotation_deg), spp=1).rgb
    assert (picture[:, :18] == left).all()
    assert (picture[:, 22:] == right).all()


def test_what_was_mended_is_said_by_the_world(tmp_path):
    """The notes of the image are notes of the scene, which tsdf-render shows; the picture has the mended light."""
    pixels = np.full((4, 8, 3), 0.25)
    pixels[1, 4, 0] = -1e-7
    made = looking(tmp_path, pixels)
    assert sum("sky.exr: 1 pixel is negative" in note for note in made.notes) == 1 and not made.warnings
    assert render.render(made, spp=1).rgb.min() == 0.0
    assert not looking(tmp_path, np.abs(pixels)).notes
    pixels[1, 4, 0] = np.nan
    (warning,) = looking(tmp_path, pixels).warnings
    assert "sky.exr: 1 pixel is not a number: taken as 0" in warning
