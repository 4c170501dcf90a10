"""Variant: Mitsuba and Dr.Jit, whose names stand for what the variant that is set has, and arrays of it."""

import importlib
from typing import Any

import numpy as np

from tsdf.errors import UsageError

OLDEST = (3, 6)  # version of Mitsuba: dr.syntax, Properties that hold objects
INSTALL = 'pip install "tsdf-toolkit[mitsuba]"'
try:
    # Untyped: what names stand for changes with the variant
    dr: Any = importlib.import_module("drjit")
    mi: Any = importlib.import_module("mitsuba")
except ImportError as _error:
    raise UsageError(f"Mitsuba 3 cannot be imported ({_error}): {INSTALL}") from None
if tuple(int(part) for part in mi.__version__.split(".")[:2]) < OLDEST:
    raise UsageError(f"Mitsuba {mi.__version__} is too old, 3.6 is needed: {INSTALL} --upgrade")


def array_of(kind: str, values: Any) -> Any:
    """Return a Dr.Jit array of the variant ("Float", "UInt32", "Int32"); a dynamic scalar one where it has none."""
    dtype = {"Float": np.float32, "UInt32": np.uint32, "Int32": np.int32}[kind]
    values = np.ascontiguousarray(np.asarray(values, dtype=dtype).ravel())
    if not vectorised():
        return values.tolist()
    return getattr(mi, kind)(values)


def vectorised() -> bool:
    return bool(dr.is_jit_v(mi.Float))


def opposite(mask: Any) -> Any:
    """Return the opposite of a mask of any variant: ~ of a Python bool is a number."""
    return mask ^ True


def element(kind: Any, array: Any, index: Any, active: Any = True) -> Any:
    """Return the elements of an array, or its only one."""
    if not vectorised():
        return array[index if 0 <= index < len(array) else 0]
    if dr.width(array) == 1:
        return kind(array)
    return dr.gather(kind, array, mi.UInt32(index), active)


def two_elements(array: Any, index: Any, active: Any = True) -> tuple[Any, Any]:
    """Return the elements 2 index and 2 index + 1."""
    if not vectorised():
        return array[2 * index], array[2 * index + 1]
    both = dr.gather(mi.Point2f if dr.is_float_v(array) else mi.Point2u, array, mi.UInt32(index), active)
    return both.x, both.y


def nothing(kind: Any) -> Any:
    """Return a structure of zeros, of any variant."""
    return dr.zeros(kind) if vectorised() else kind()
