"""TSDFs: teleportation scattering distribution functions of grains (Meng et al. 2015).

What is named here is what the toolkit promises to keep: tables are read, written, built and sampled, scenes and grains
loaded, pictures rendered. Everything else is reached through its room (``tsdf.judge.analytic``, say) and may move.

Examples
--------
>>> import tsdf
>>> table = tsdf.read("snow.tsdf.exr")
>>> table.albedo(0.1) < table.albedo() == 1  # absorption sigma_a times R; without it a grain is lossless
True
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsdf.data.format import library as library
    from tsdf.data.format import read as read
    from tsdf.data.format import write as write
    from tsdf.data.sampler import Sampler as Sampler
    from tsdf.data.table import Table as Table
    from tsdf.errors import FormatError as FormatError
    from tsdf.errors import TSDFError as TSDFError
    from tsdf.grain.grains import load_grain as load_grain
    from tsdf.grain.optics import Optics as Optics
    from tsdf.make.build import build as build
    from tsdf.make.effort import Effort as Effort
    from tsdf.plan.shot import render as render
    from tsdf.scene.scene import load as load_scene

    __version__: str

_HOMES = {
    "Effort": "make.effort:Effort",
    "FormatError": "errors:FormatError",
    "Optics": "grain.optics:Optics",
    "Sampler": "data.sampler:Sampler",
    "TSDFError": "errors:TSDFError",
    "Table": "data.table:Table",
    "build": "make.build:build",
    "library": "data.format:library",
    "load_grain": "grain.grains:load_grain",
    "load_scene": "scene.scene:load",
    "read": "data.format:read",
    "render": "plan.shot:render",
    "write": "data.format:write",
}
__all__ = [
    "Effort",
    "FormatError",
    "Optics",
    "Sampler",
    "TSDFError",
    "Table",
    "__version__",
    "build",
    "library",
    "load_grain",
    "load_scene",
    "read",
    "render",
    "write",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then: ``import tsdf`` itself imports no third party (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        return version("tsdf-toolkit")
    if name not in _HOMES:
        raise AttributeError(f"module 'tsdf' has no attribute {name!r}")
    from importlib import import_module

    home, _, known = _HOMES[name].partition(":")
    return getattr(import_module(f"tsdf.{home}"), known)


def __dir__() -> list[str]:
    return sorted(__all__)
