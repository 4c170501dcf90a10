"""Rows about the one table that was named: whether it can be used at every level, and what that is worth."""

from collections.abc import Iterator

import numpy as np

from tsdf.errors import UsageError
from tsdf.picture import render
from tsdf.picture.world import build
from tsdf.scene.levels import LEVELS
from tsdf.scene.scene import Camera, ConstantLight, GrainSpec, MediumSpec, Scene, Slab
from tsdf.stress.cells import TABLES, Measured, Row, Setting, attempted
from tsdf.stress.slabs import BASE, Case, slab
from tsdf.walk.explicit import built_in

GROUP = "The table that was named"


def check_mesh(setting: Setting) -> None:
    """Refuse to trace the grain of a table whose mesh is not there.

    Raises
    ------
    UsageError
    """
    if setting.mesh is None and not built_in(setting.own):
        raise UsageError(f"mesh of {setting.own.header['grain']['name']} not found: --mesh FILE")


def furnace(setting: Setting) -> Iterator[Measured]:
    """Constant light around a slab of 20 R of these grains is that light, at every level that can be had."""
    camera = Camera((3.0, -30.0, 20.0), (0.0, 0.0, 0.0), 16, 12, fov_deg=30.0)
    grain = GrainSpec(setting.own, mesh=setting.mesh)

    def measured(level: str) -> Measured:
        if level == "explicit":
            check_mesh(setting)
        medium = MediumSpec(Slab(-20.0, 0.0), 0.6, 1.0, (grain,), name="slab", packing_spheres=400)
        scene = Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), name="slab")
        picture = render.render(build(scene, level), spp=setting.some(40), seed=setting.seed, threads=setting.threads)
        off = np.abs(picture.rgb - 1.0).max()
        return Measured(level, 100.0 * float(off), note=f"{picture.events:.2g} events, {picture.truncated} given up")

    yield from attempted(tuple(LEVELS), measured)


def whole(setting: Setting) -> Iterator[Measured]:
    """What each column of the table stands for sums to 1."""
    table = setting.own
    off = max(
        float(np.abs(table.block(name)[:, table.p_theta > 0.0].sum(axis=0, dtype=np.float64) - 1.0).max())
        for name in ("p_phi", "p_r", "p_z", "p_l")
    )
    off = max(off, abs(float(table.p_theta.sum(dtype=np.float64)) - 1.0))
    ledger = table.header["energy_ledger"]
    if launched := ledger["launched"]:
        kept = sum(ledger[name] for name in ("unscattered", "scattered", "absorbed", "truncated", "lost"))
        off = max(off, abs(kept / launched - 1.0))
    yield Measured(TABLES, 100.0 * off)


def against_explicit(setting: Setting) -> Iterator[Measured]:
    """Reflectance of a slab of these grains, where nothing is claimed."""
    check_mesh(setting)
    yield from slab(setting, Case("own", 0.6, 10.0), BASE)


ROWS = (
    Row("own-sums", GROUP, "sums of the table, its ledger", "off from 1", "%", 0.01, whole),
    Row("own-furnace", GROUP, "slab of 20 R in a furnace", "largest deviation of a pixel", "%", 0.5, furnace),
    Row("own-slab", GROUP, "layer of 10 R, f = .6, against explicit", "reflectance", "%", 4.0, against_explicit,
        claimed=False),
)  # fmt: skip
