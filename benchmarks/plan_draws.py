"""Scenes by a recipe, drawn from a seed, that plans are judged by: nobody has chosen them, nothing is fitted to them.

`drawn` draws everything apart: a body (box, ball or slab without end), its thickness from 3 to 60 R, one or two of the
ready grains, absorption or none, packing fraction from .05 to .63, whether grains enter whole, a floor or none; a sky
with a sun of 6 to 60 degrees from anywhere above the horizon, or a white sky alone; from how far the camera looks, by
what a pixel covers, R/8 to 8 R, from what height, and how much of the picture the body takes; two targets from 2 to
15 %.
`glinting` draws as many from what sparkles: faceted clear grains, packed to .3 to .63, 4 to 15 R thick, under a sun of
1, 5, 20 or 50 degrees, pixels from R/8 to 4 R.
"""

import math
from typing import Any

import numpy as np
from plan_scenes import FLOOR, HEIGHT, SKY, WHITE, WIDTH, box, grain

FOV = 30.0  # [deg]
GRAINS = ("glass-beads", "salt", "sugar", "sand", "quartz", "coarse-snow", "fresh-snow", "plates")
FACETED = ("salt", "sugar", "fresh-snow", "plates")


def drawn(seed: int) -> tuple[str, dict[str, Any], tuple[float, float]]:
    """Return a name, a scene and two targets."""
    rng = np.random.default_rng([seed, 1])
    names = rng.choice(GRAINS, size=1 + int(rng.random() < 0.25), replace=False)
    absorption = round(_log(rng, 0.002, 0.5), 4) if rng.random() < 0.4 else 0.0
    shares = (1.0,) if len(names) == 1 else (share := round(rng.uniform(0.2, 0.8), 2), round(1.0 - share, 2))
    grains = [grain(name, absorption if n == 0 else 0.0, shares[n]) for n, name in enumerate(names.tolist())]
    lights = [WHITE] if rng.random() < 0.2 else [SKY, _sun(rng, 6.0, 60.0)]
    targets = sorted(_log(rng, 0.02, 0.15) for _ in range(2))
    thick, pixel, fraction = _log(rng, 3.0, 60.0), _log(rng, 0.125, 8.0), round(rng.uniform(0.05, 0.63), 3)
    scene = _scene(rng, grains, lights, thick, pixel, fraction)
    return f"drawn {seed}: {'+'.join(names.tolist())}", scene, (round(targets[0], 3), round(targets[1], 3))


def glinting(seed: int) -> tuple[str, dict[str, Any], tuple[float, float]]:
    """Return a name, a scene and two targets."""
    rng = np.random.default_rng([seed, 2])
    name = FACETED[seed % len(FACETED)]
    degrees = (20.0, 5.0, 50.0, 1.0)[seed // len(FACETED) % 4]
    thick, pixel, fraction = _log(rng, 4.0, 15.0), _log(rng, 0.125, 4.0), round(rng.uniform(0.3, 0.63), 3)
    scene = _scene(rng, [grain(name)], [SKY, _sun(rng, degrees, degrees)], thick, pixel, fraction)
    return f"glints {seed}: {name}, {degrees:g} degrees", scene, (0.05, 0.15)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return low * (high / low) ** rng.random()


def _sun(rng: np.random.Generator, low: float, high: float) -> dict[str, Any]:
    azimuth, height = rng.uniform(0.0, 2.0 * math.pi), math.radians(rng.uniform(10.0, 80.0))
    way = [math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)]
    return {"type": "sun", "direction": [round(w, 4) for w in way], "irradiance": [3.0, 2.9, 2.7],
            "angular_diameter_deg": round(_log(rng, low, high), 2)}  # fmt: skip


def _scene(
    rng: np.random.Generator, grains: list[dict[str, Any]], lights: list[dict[str, Any]], thick: float, pixel: float,
    fraction: float,
) -> dict[str, Any]:  # fmt: skip
    """Return a scene of grains of radius 1, so thick and seen by pixels that cover so much of it [R]."""
    kind = rng.choice(["box", "ball", "slab"], p=[0.5, 0.3, 0.2])
    wide = max(rng.uniform(0.5, 1.3) * WIDTH * pixel, 20.0)
    if kind == "ball":
        radius = max(0.75 * thick, 4.0)  # whose mean chord is as long
        shape = {"type": "sphere", "centre": [0, 0, radius + 0.02], "radius": radius}
    elif kind == "slab":
        shape = {"type": "slab", "low": 0.02, "high": 0.02 + thick}
    else:
        shape = box(wide, wide * rng.uniform(0.6, 1.0), 0.02 + thick)
    up = math.radians(rng.uniform(20.0, 80.0))
    way = np.array([0.2, -math.cos(up), math.sin(up)])
    way /= np.linalg.norm(way)
    top = np.array([0.0, 0.0, radius + 0.02]) + radius * way if kind == "ball" else np.array([0.0, 0.0, 0.02 + thick])
    distance = pixel * WIDTH / (2.0 * math.tan(0.5 * math.radians(FOV)))
    if kind == "ball":  # as much of it in the picture as of others, where it is small
        distance = min(distance, radius * rng.uniform(1.5, 5.0))
    inside = str(rng.choice(["grains", "centres"], p=[0.75, 0.25]))
    medium = {"shape": shape, "packing_fraction": fraction, "radius": 1.0, "inside": inside, "grain": grains}
    floor = rng.random() < 0.4
    return {
        "camera": {"position": (top + distance * way).tolist(), "target": top.tolist(), "fov_deg": FOV,
                   "width": WIDTH, "height": HEIGHT},
        "light": lights,
        "medium": [medium],
        "surface": [FLOOR] if floor else [],
    }  # fmt: skip
