"""Scenes that plans are judged by, none of which anything was fitted to: grains of radius 1, 48 by 36 pixels.

In sets, by when they were written: those without a mark showed what was wrong in principle; + were held out until the
laws of texture stood, ++ until error bars did; +++ are a sceptic's, unlike the others; ++++ were written when what
those showed was mended, +++++ before the last that these showed was, ++++++ after it.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT = 48, 36
ROOT = Path(__file__).resolve().parents[1]
NOON = {"type": "sun", "direction": [0.5, -0.4, 1.0], "irradiance": [2.0, 1.9, 1.8], "angular_diameter_deg": 50.0}
LOW_SUN = {"type": "sun", "direction": [1.0, -0.2, 0.25], "irradiance": [2.5, 2.4, 2.2], "angular_diameter_deg": 35.0}
BEHIND = {"type": "sun", "direction": [0.1, 1.0, 0.4], "irradiance": [3.0, 3.0, 3.0], "angular_diameter_deg": 45.0}
SMALL_SUN = {"type": "sun", "direction": [0.5, -0.5, 0.8], "irradiance": [3.0, 2.9, 2.7], "angular_diameter_deg": 0.53}
SKY = {"type": "constant", "radiance": [0.3, 0.35, 0.45]}
WHITE = {"type": "constant", "radiance": [1.0, 1.0, 1.0]}
FLOOR = {"shape": {"type": "rectangle", "centre": [0, 0, 0], "u": [2000, 0, 0], "v": [0, 2000, 0]}, "reflectance": 0.3}


def box(x: float, y: float, z: float) -> dict[str, Any]:
    return {"type": "box", "low": [-x / 2, -y / 2, 0.02], "high": [x / 2, y / 2, z]}


def ball(radius: float) -> dict[str, Any]:
    return {"type": "sphere", "centre": [0, 0, radius + 0.02], "radius": radius}


def made(
    shape: dict[str, Any], grains: Any, fraction: float, lights: list, distance: float, height: float, look: float,
    fov: float = 40.0, floor: bool = False, inside: str = "grains",
) -> dict[str, Any]:  # fmt: skip
    """Return a scene with grains of radius 1, seen from a distance and a height [R]."""
    medium = {"shape": shape, "packing_fraction": fraction, "radius": 1.0, "inside": inside, "grain": grains}
    return {
        "camera": {"position": [0.2 * distance, -distance, height], "target": [0, 0, look], "fov_deg": fov,
                   "width": WIDTH, "height": HEIGHT},
        "light": lights,
        "medium": [medium],
        "surface": [FLOOR] if floor else [],
    }  # fmt: skip


def grain(table: str, absorption: Any = 0.0, fraction: float = 1.0) -> dict[str, Any]:
    return {"table": table, "absorption": absorption, "fraction": fraction}


def heap(folder: Path, radius: float, height: float) -> dict[str, Any]:
    """Return a closed heap with a flat foot."""
    import trimesh

    body = trimesh.creation.icosphere(3, radius=1.0)
    v = body.vertices * [radius, radius, height]
    v[:, 2] = np.maximum(v[:, 2], -0.15 * height) + 0.15 * height + 0.02
    path = folder / f"heap{radius:g}.ply"
    trimesh.Trimesh(v, body.faces, process=False).export(path)
    return {"type": "mesh", "file": str(path)}


def scenes(folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield names, scenes and two targets."""
    glass, salt, sugar, sand = (grain(name) for name in ("glass-beads", "salt", "sugar", "sand"))
    quartz, snow, fresh, plates = (grain(name) for name in ("quartz", "coarse-snow", "fresh-snow", "plates"))
    grey, tinted, dark = grain("glass-beads", 0.1), grain("salt", 0.02, 0.6), grain("salt", [0.02, 0.1, 0.3])
    brown, most, some = grain("sugar", [0.05, 0.15, 0.4]), grain("sand", 0.0, 0.7), grain("glass-beads", 0.05, 0.3)
    # fmt: off
    yield "dilute glass slab", made(box(60, 60, 12), [glass], 0.1, [SKY, NOON], 70, 60, 4), (0.02, 0.05)
    yield "dense glass box", made(box(50, 50, 30), [glass], 0.6, [SKY, NOON], 110, 80, 12), (0.02, 0.05)
    yield "glass close up", made(box(40, 40, 20), [glass], 0.6, [SKY, NOON], 12, 34, 20, 35), (0.05, 0.1)
    yield "salt ball", made(ball(15), [salt], 0.5, [SKY, LOW_SUN], 80, 40, 14), (0.03, 0.1)
    yield "sugar heap", made(heap(folder, 40, 25), [sugar], 0.55, [SKY, NOON], 130, 60, 8, floor=True), (0.04, 0.1)
    yield "grey glass", made(ball(12), [grey], 0.3, [SKY, NOON], 70, 30, 12, 30), (0.01, 0.05)
    yield "sand from behind", made(box(60, 10, 50), [sand], 0.6, [SKY, BEHIND], 130, 40, 24), (0.05, 0.1)
    yield "mixture", made(box(40, 40, 16), [quartz, tinted], 0.45, [SKY, NOON], 90, 70, 6), (0.04, 0.1)
    yield "plates", made(ball(20), [plates], 0.2, [SKY, LOW_SUN], 120, 30, 20, 30, True), (0.05, 0.1)
    yield "deep snow", made(ball(150), [snow], 0.5, [SKY, NOON], 900, 300, 140, 30, True), (0.03, 0.1)
    yield "+glass far", made(ball(30), [glass], 0.5, [SKY, LOW_SUN], 400, 150, 28, 20), (0.02, 0.05)
    yield "+fresh layer", made(box(120, 120, 30), [fresh], 0.3, [SKY, NOON], 200, 120, 10, floor=True), (0.05, 0.1)
    yield "+quartz layer", made(box(40, 40, 5), [quartz], 0.6, [SKY, NOON], 30, 35, 2, 40, True), (0.05, 0.1)
    yield "+dark salt", made(box(40, 40, 40), [dark], 0.6, [SKY, NOON], 120, 80, 16), (0.03, 0.08)
    yield "+white sky", made(heap(folder, 30, 30), [sand], 0.4, [WHITE], 100, 50, 8, floor=True), (0.02, 0.05)
    yield "+sugar centres", made(box(30, 30, 10), [sugar], 0.6, [SKY, BEHIND], 80, 30, 4, inside="centres"), (0.05, 0.1)
    yield "+dilute snow", made(ball(40), [snow], 0.1, [SKY, NOON], 250, 90, 38, 25), (0.03, 0.06)
    yield "+glass grazing", made(box(60, 60, 8), [glass], 0.5, [SKY, LOW_SUN], 60, 10, 4, 40, True), (0.03, 0.1)
    yield "++plates backlit", made(box(50, 8, 40), [plates], 0.3, [SKY, BEHIND], 110, 30, 20), (0.05, 0.1)
    yield "++glass sheet", made(box(80, 80, 4), [glass], 0.4, [SKY, NOON], 90, 70, 2, floor=True), (0.03, 0.06)
    yield "++salt heap", made(heap(folder, 25, 12), [salt], 0.6, [WHITE], 90, 40, 4, floor=True), (0.02, 0.05)
    yield "++brown ball", made(ball(25), [brown], 0.5, [SKY, NOON], 150, 50, 24), (0.04, 0.1)
    yield "++sand and glass", made(box(35, 35, 20), [most, some], 0.5, [SKY, LOW_SUN], 90, 60, 8), (0.04, 0.1)
    yield "++quartz far", made(ball(60), [quartz], 0.6, [SKY, LOW_SUN], 600, 200, 58, 22), (0.02, 0.05)
    yield "++snow wall", made(box(60, 20, 60), [fresh], 0.5, [SKY, NOON], 45, 40, 30, 35), (0.05, 0.1)
    yield "++dilute salt", made(ball(18), [salt], 0.08, [SKY, BEHIND], 90, 20, 18, 30), (0.03, 0.08)
    # fmt: on
    yield from sceptical(folder)
    yield from last(folder)
    yield from afterwards(folder)
    yield from at_last(folder)


def moved(medium: dict[str, Any], x: float, y: float = 0.0, z: float = 0.0) -> dict[str, Any]:
    """Return a medium elsewhere, whose shape is a ball or a box."""
    shift = (x, y, z)
    shape = dict(medium["shape"])
    for key in ("low", "high", "centre"):
        if key in shape:
            shape[key] = [a + b for a, b in zip(shape[key], shift, strict=True)]
    return {**medium, "shape": shape}


def scaled(data: Any, by: float, key: str = "") -> Any:
    """Return a scene all of whose lengths are so many times as long, and whose absorption is as much weaker."""
    lengths = ("position", "target", "low", "high", "centre", "u", "v", "radius")
    if isinstance(data, dict):
        return {name: scaled(value, by, name) for name, value in data.items()}
    if isinstance(data, list):
        return [scaled(value, by, key) for value in data]
    if isinstance(data, float | int) and not isinstance(data, bool):
        return data * by if key in lengths else data / by if key == "absorption" else data
    return data


def seen_from(scene: dict[str, Any], position: list[float], target: list[float], fov: float) -> dict[str, Any]:
    """Return a scene with another camera."""
    return {**scene, "camera": {**scene["camera"], "position": position, "target": target, "fov_deg": fov}}


def shipped(name: str) -> dict[str, Any]:
    """Return one of the scenes of `scenes`, small."""
    import tomllib

    path = ROOT / "scenes" / f"{name}.toml"
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    for medium in data["medium"]:
        medium["shape"]["file"] = str(path.parent / medium["shape"]["file"])
        for one in medium["grain"]:
            one["table"] = str((path.parent / one["table"]).resolve())
    for light in data["light"]:
        if "file" in light:
            light["file"] = str(path.parent / light["file"])
    camera = {**data["camera"], "width": WIDTH, "height": HEIGHT}
    return {key: value for key, value in {**data, "camera": camera}.items() if key != "render"}


def sceptical(folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield the set +++; where `make demo` and `make tables` have made none, without those that take their tables."""
    glass, salt, sugar, sand = (grain(name) for name in ("glass-beads", "salt", "sugar", "sand"))
    quartz, fresh, plates = (grain(name) for name in ("quartz", "fresh-snow", "plates"))
    white, coal, black = grain("coarse-snow", 1e-5), grain("salt", 0.9), grain("sand", 1.5, 0.3)
    icy, clear = grain("fresh-snow", {"material": "ice"}), grain("plates", 0.0, 0.7)
    studio = {"type": "environment", "file": str(ROOT / "scenes" / "assets" / "studio.exr")}
    red = {"shape": {"type": "sphere", "centre": [0, 0, 9], "radius": 6}, "reflectance": [0.7, 0.1, 0.05]}
    slab = {"type": "slab", "low": 0.02, "high": 16}
    # fmt: off
    yield "+++edge of a sheet", made(box(70, 50, 3), [glass], 0.5, [SKY, NOON], 75, 4, 1.5, 35), (0.03, 0.1)
    yield "+++sugar slab", made(slab, [sugar], 0.5, [SKY, NOON], 60, 50, 12), (0.04, 0.1)
    yield "+++salt from very near", made(ball(8), [salt], 0.55, [SKY, NOON], 11.5, 9, 8, 25), (0.1, 0.2)
    yield "+++sand from very far", made(ball(40), [sand], 0.5, [SKY, LOW_SUN], 4000, 900, 40, 1.6), (0.02, 0.05)
    yield "+++sun and sky", made(box(80, 80, 20), [quartz], 0.5, [SKY, SMALL_SUN], 150, 110, 8), (0.05, 0.1)
    yield "+++only a sun", made(ball(15), [glass], 0.5, [SMALL_SUN], 60, 20, 15), (0.1, 0.2)
    yield "+++studio", made(ball(12), [glass], 0.6, [studio], 55, 25, 12, 32, True, "centres"), (0.05, 0.1)
    yield "+++white and deep", made(box(160, 160, 60), [white], 0.5, [SKY, NOON], 450, 250, 20, 25), (0.02, 0.05)
    yield "+++coal", made(ball(20), [coal], 0.55, [SKY, NOON], 110, 30, 20, 25), (0.01, 0.03)
    yield "+++five per cent", made(ball(30), [quartz], 0.05, [SKY, LOW_SUN], 150, 50, 30, 26), (0.02, 0.05)
    tight = made(box(50, 50, 14), [glass], 0.64, [SKY, BEHIND], 110, 60, 5, inside="centres")
    yield "+++as tight as can be", tight, (0.03, 0.08)
    two = made(ball(12), [plates], 0.3, [SKY, NOON], 100, 40, 8, floor=True)
    other = {**made(box(18, 18, 14), [sugar], 0.5, [], 1, 1, 1)["medium"][0], "radius": 0.6}
    two["medium"] = [moved(two["medium"][0], -16), moved(other, 14)]
    yield "+++two media", two, (0.04, 0.1)
    buried = made(box(40, 40, 18), [fresh], 0.2, [SKY, NOON], 60, 60, 8)
    yield "+++buried", {**buried, "surface": [red]}, (0.05, 0.1)
    inside = made(box(100, 100, 100), [fresh], 0.05, [SKY, NOON], 1, 50, 50)
    yield "+++within", seen_from(inside, [0, 20, 60], [10, 50, 70], 50.0), (0.05, 0.1)
    grazing = made({**slab, "high": 10}, [glass], 0.6, [SKY, NOON], 1, 1, 1)
    yield "+++to the horizon", seen_from(grazing, [0, -40, 15], [0, 40, 8], 45.0), (0.05, 0.1)
    yield "+++black and white", made(ball(18), [clear, black], 0.4, [SKY, NOON], 95, 40, 18, 28), (0.03, 0.08)
    tiny = made(box(60, 40, 20), [icy], 0.4, [SKY, LOW_SUN], 110, 70, 8)
    yield "+++ice in metres", {**scaled(tiny, 2e-4), "metres_per_unit": 1.0}, (0.03, 0.1)
    yield "+++in micrometres", scaled(made(ball(15), [sand, salt], 0.3, [SKY, NOON], 80, 20, 14), 400.0), (0.03, 0.1)
    if (ROOT / "demo" / "sand.tsdf.exr").exists():
        dune, few = (str(ROOT / "demo" / f"{name}.tsdf.exr") for name in ("sand", "clear"))
        own = [grain(dune, [0.02, 0.06, 0.2], 0.85), grain(few, 0.01, 0.15)]
        yield "+++grains of one's own", made(box(40, 40, 12), own, 0.55, [SKY, LOW_SUN], 80, 45, 5), (0.05, 0.1)
        yield "+++beads", shipped("beads"), (0.05, 0.15)
    # fmt: on


def last(folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield the set ++++."""
    glass, salt, sugar, sand = (grain(name) for name in ("glass-beads", "salt", "sugar", "sand"))
    quartz, snow, fresh, plates = (grain(name) for name in ("quartz", "coarse-snow", "fresh-snow", "plates"))
    tea, ink = grain("glass-beads", [0.01, 0.05, 0.2]), grain("quartz", 0.6, 0.2)
    lamp = {"type": "sun", "direction": [-0.3, -1.0, 0.5], "irradiance": [1.0, 1.2, 1.4], "angular_diameter_deg": 25.0}
    pillar = {"shape": {"type": "box", "low": [-4, -30, 0], "high": [4, -24, 24]}, "reflectance": [0.1, 0.4, 0.6]}
    wall = {"type": "box", "low": [-40, 0, 0.02], "high": [40, 6, 40]}
    # fmt: off
    yield "++++tea", made(ball(14), [tea], 0.6, [SKY, lamp], 70, 40, 14, 30, True), (0.03, 0.1)
    yield "++++a wall of sand", made(wall, [sand], 0.58, [WHITE], 110, 30, 20, 40, True, "centres"), (0.04, 0.1)
    yield "++++coast", made(heap(folder, 60, 18), [salt], 0.45, [SKY, LOW_SUN], 90, 14, 10, 50, True), (0.05, 0.12)
    yield "++++crystal", made(ball(6), [quartz], 0.3, [SKY, lamp], 26, 10, 6, 30), (0.05, 0.15)
    yield "++++cirrus", made(box(200, 200, 60), [plates], 0.02, [SKY, NOON], 300, 180, 30, 40), (0.03, 0.08)
    peppered = made(box(36, 36, 10), [sugar, ink], 0.5, [SKY, lamp], 60, 60, 4, inside="centres")
    yield "++++peppered", peppered, (0.05, 0.1)
    shade = made(box(90, 60, 14), [snow], 0.45, [SKY, lamp], 150, 90, 8, 40)
    yield "++++in the shade", {**shade, "surface": [FLOOR, pillar]}, (0.03, 0.08)
    deep = made({"type": "slab", "low": 0.02, "high": 120}, [glass], 0.6, [SKY, NOON], 200, 260, 110, 40)
    yield "++++deep glass", deep, (0.02, 0.05)
    sunny = made(ball(25), [fresh], 0.3, [SKY, SMALL_SUN], 500, 150, 25, 8, True)
    yield "++++fresh snow in the sun", sunny, (0.05, 0.1)
    yield "++++dust", scaled(made(ball(20), [snow, sand], 0.15, [SKY, NOON], 110, 40, 20, 28), 1e-5), (0.03, 0.08)
    # fmt: on


def afterwards(folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield the set +++++."""
    glass, salt, sand = (grain(name) for name in ("glass-beads", "salt", "sand"))
    quartz, snow, plates = (grain(name) for name in ("quartz", "coarse-snow", "plates"))
    brown, dark, some = grain("sugar", [0.03, 0.08, 0.2]), grain("sand", 0.4), grain("glass-beads", 0.0, 0.5)
    blue = {"type": "environment", "file": str(ROOT / "scenes" / "assets" / "blue_sky.exr")}
    noon = {**NOON, "angular_diameter_deg": 30.0}
    # fmt: off
    yield "+++++salt in the sun", made(box(90, 90, 16), [salt], 0.5, [SKY, SMALL_SUN], 300, 240, 6, 22), (0.05, 0.1)
    yield "+++++glass in snow", made(ball(16), [snow, some], 0.4, [SKY, noon], 90, 30, 16, 26), (0.04, 0.1)
    yield "+++++sugar cube", made(box(12, 12, 12), [brown], 0.55, [SKY, noon], 40, 30, 6, 32, True), (0.05, 0.12)
    veil = made({"type": "slab", "low": 0.02, "high": 20}, [quartz], 0.1, [SKY, noon], 60, 70, 10, 45)
    yield "+++++veil", {**veil, "surface": [FLOOR]}, (0.03, 0.08)
    yield "+++++dark sand", made(box(60, 60, 20), [dark], 0.6, [WHITE], 120, 120, 10), (0.02, 0.06)
    yield "+++++pane", made(box(50, 6, 50), [glass], 0.35, [SKY, BEHIND], 90, 30, 25, inside="centres"), (0.04, 0.1)
    yield "+++++plates at noon", made(ball(30), [plates], 0.25, [blue, noon], 160, 60, 30, 28), (0.03, 0.1)
    yield "+++++sand on end", made(box(16, 16, 60), [sand], 0.5, [SKY, LOW_SUN], 130, 40, 30, 40, True), (0.04, 0.1)
    # fmt: on


def at_last(folder: Path) -> Iterator[tuple[str, dict[str, Any], tuple[float, float]]]:
    """Yield the set ++++++."""
    salt, sugar, snow, fresh = (grain(name) for name in ("salt", "sugar", "coarse-snow", "fresh-snow"))
    amber, ash = grain("glass-beads", [0.005, 0.02, 0.15]), grain("sand", [0.3, 0.3, 0.35])
    side = {"type": "sun", "direction": [-1.0, -0.3, 0.5], "irradiance": [2.0, 1.8, 1.5], "angular_diameter_deg": 28.0}
    # fmt: off
    yield "++++++amber", made(box(24, 24, 12), [amber], 0.62, [SKY, side], 50, 50, 6, 36), (0.04, 0.12)
    yield "++++++ash", made(heap(folder, 22, 16), [ash], 0.5, [SKY, side], 70, 30, 6, 40, True), (0.02, 0.06)
    yield "++++++drift", made(box(120, 40, 25), [snow], 0.35, [SKY, side], 160, 60, 10, 42, True), (0.03, 0.1)
    yield "++++++two sugars", made(ball(11), [sugar, salt], 0.55, [WHITE], 60, 25, 11, 26, True), (0.04, 0.1)
    yield "++++++flurry", made(ball(45), [fresh], 0.04, [SKY, side], 260, 60, 45, 22), (0.03, 0.08)
    # fmt: on
