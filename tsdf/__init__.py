"""TSDFs: teleportation scattering distribution functions of grains (Meng et al. 2015)."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsdf.data.format import read as read
    from tsdf.data.format import write as write
    from tsdf.data.sampler import Sampler as Sampler
    from tsdf.data.table import Table as Table
    from tsdf.errors import FormatError as FormatError
    from tsdf.errors import TSDFError as TSDFError

_HOMES = {
    "read": "data.format",
    "write": "data.format",
    "Table": "data.table",
    "Sampler": "data.sampler",
    "FormatError": "errors",
    "TSDFError": "errors",
}
__all__ = ["FormatError", "Sampler", "TSDFError", "Table", "__version__", "read", "write"]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then: ``import tsdf`` itself imports no third party (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        return version("tsdf-toolkit")
    if name not in _HOMES:
        raise AttributeError(f"module 'tsdf' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"tsdf.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
