"""TSDFs: teleportation scattering distribution functions of grains (Meng et al. 2015)."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsdf.errors import FormatError as FormatError
    from tsdf.errors import TSDFError as TSDFError
    from tsdf.format import read as read
    from tsdf.format import write as write
    from tsdf.table import Table as Table

_HOMES = {
    "read": "format",
    "write": "format",
    "Table": "table",
    "FormatError": "errors",
    "TSDFError": "errors",
}
__all__ = ["FormatError", "TSDFError", "Table", "read", "write"]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then: ``import tsdf`` itself imports no third party (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'tsdf' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"tsdf.{_HOMES[name]}"), name)
