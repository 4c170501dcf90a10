"""A ball of grains in the sun, above a grey floor: the scene of a table that has none of its own."""

from typing import Any


def ball_of(table: str) -> dict[str, Any]:
    """Return the scene of a table, a file or the name of a ready one, as `tsdf.scene.scene.parse` takes it."""
    return {
        "camera": {"position": [0, -5, 2.2], "target": [0, 0, 0.9], "fov_deg": 36, "width": 320, "height": 240},
        "render": {"level": "teleport-memory", "spp": 32},
        "light": [
            {"type": "constant", "radiance": [0.25, 0.3, 0.4]},
            {"type": "sun", "direction": [-1, -0.7, 1.1], "irradiance": [2.4, 2.3, 2.1], "angular_diameter_deg": 5},
        ],
        "surface": [
            {
                "shape": {"type": "rectangle", "centre": [0, 0, 0], "u": [20, 0, 0], "v": [0, 20, 0]},
                "reflectance": [0.2, 0.2, 0.2],
            }
        ],
        "medium": [
            {
                "shape": {"type": "sphere", "centre": [0, 0, 1], "radius": 1},
                "packing_fraction": 0.5,
                "radius": 0.02,
                "grain": [{"table": table}],
            }
        ],
    }
