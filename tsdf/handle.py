"""Handles: one pointer for kernels to all that they share, structures of arrays, opened where they are used.

numba passes a NamedTuple of arrays by value, word by word, on every call that it does not inline. A `Handle` lays one
out in memory, a 64-bit word for each number and the address and shape of each array, and kernels are passed where that
is. They read it under the same names, ``world.geometry.planes[facet, 3]``, and only what they use is loaded: a
NamedTuple in it is a handle of its own, a tuple of equals is read by its index. So an array is added by adding a field
to its NamedTuple, and a kernel that is written for handles takes the NamedTuple as well.
"""

import hashlib
import operator
import struct
from functools import cache
from itertools import accumulate
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.pythonapi import unbox
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_getattr, infer_global, signature
from numba.extending import NativeValue, lower_builtin, models, register_model
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import from_dtype

WORD = ir.IntType(64)
TRUTH, WHOLE, REAL = bool | np.bool_, int | np.integer, float | np.floating


class Handle:
    """A NamedTuple as kernels take it.

    Parameters
    ----------
    values : NamedTuple
        Of bools, ints, floats, C-contiguous arrays, such NamedTuples, and tuples of equals. It is kept, for the handle
        points into it; what kernels see of its arrays changes with them, numbers stay as they are now.
    """

    def __init__(self, values: Any) -> None:
        self.values = values
        self._kept: list[np.ndarray] = []
        words, self._numba_type_ = _laid(values, self._kept)
        self._kept.append(np.array(words, np.uint64))
        self.address = self._kept[-1].ctypes.data


class HandleType(types.Type):
    """Where the fields of a structure are: their types, and their offsets in words."""

    def __init__(self, name: str, fields: dict[str, tuple[types.Type, int]], size: int) -> None:
        self.fields, self.size = fields, size
        super().__init__(_named(name, *(f"{field} {kind} {at}" for field, (kind, at) in fields.items())))


class ItemsType(types.Type):
    """Equals one after the other."""

    def __init__(self, item: types.Type, size: int) -> None:
        self.item, self.size = item, size
        super().__init__(_named("Items", str(item), str(size)))


def _named(name: str, *what: str) -> str:
    """Return a short name that is the same for the same things only: types are told apart by their names."""
    return f"{name}#{hashlib.sha256('; '.join(what).encode()).hexdigest()[:12]}"


# Types are made once: making those of a world takes as long as some ten thousand events


@cache
def _array(dtype: np.dtype, dimensions: int) -> types.Type:
    """Return the type of an array."""
    return types.Array(from_dtype(dtype), dimensions, "C")


@cache
def _structure(name: str, fields: tuple[str, ...], kinds: tuple[types.Type, ...], sizes: tuple[int, ...]) -> HandleType:
    """Return the type of a NamedTuple whose fields are of these types and so many words."""
    at = [0, *accumulate(sizes)]
    return HandleType(name, dict(zip(fields, zip(kinds, at, strict=False), strict=True)), at[-1])


def _laid(value: Any, kept: list[np.ndarray]) -> tuple[list[int], types.Type]:
    """Return a value as words, and its type; what they point to is added to `kept`."""
    if isinstance(value, np.ndarray):
        if not value.flags.c_contiguous:
            raise TypeError("an array in a handle must be C-contiguous")
        return [value.ctypes.data, *value.shape], _array(value.dtype, value.ndim)
    if isinstance(value, TRUTH):
        return [int(value)], types.boolean
    if isinstance(value, WHOLE):
        return [int(value) & 0xFFFFFFFFFFFFFFFF], types.int64
    if isinstance(value, REAL):
        return [struct.unpack("=Q", struct.pack("=d", value))[0]], types.float64
    if not isinstance(value, tuple):
        raise TypeError(f"a handle has no room for a {type(value).__name__}")
    parts = [_laid(part, kept) for part in value]
    words = [word for part, _ in parts for word in part]
    if hasattr(value, "_fields"):
        kinds, sizes = tuple(kind for _, kind in parts), tuple(len(part) for part, _ in parts)
        return words, _structure(type(value).__name__, value._fields, kinds, sizes)
    if not parts or any(kind != parts[0][1] for _, kind in parts):
        raise TypeError("a tuple in a handle must be of equals")
    kept.append(np.array(words, np.uint64))
    return [kept[-1].ctypes.data], ItemsType(parts[0][1], len(parts[0][0]))


# --------------------------------------------------------------------------------------- what numba must know


@register_model(HandleType)
@register_model(ItemsType)
class _Pointer(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: types.Type) -> None:
        super().__init__(manager, kind, WORD.as_pointer())


@unbox(HandleType)
def _unbox(kind: HandleType, handle: Any, c: Any) -> NativeValue:
    address = c.pyapi.object_getattr_string(handle, "address")
    pointer = c.builder.bitcast(c.pyapi.long_as_voidptr(address), WORD.as_pointer())
    c.pyapi.decref(address)
    return NativeValue(pointer)


@infer_getattr
class _Fields(AttributeTemplate):
    key = HandleType

    def generic_resolve(self, kind: Any, name: str) -> Any:  # type: ignore[override]
        return kind.fields[name][0] if name in kind.fields else None


@infer_global(operator.getitem)
class _Items(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        items, index = args
        if isinstance(items, ItemsType) and isinstance(index, types.Integer):
            return signature(items.item, items, types.intp)
        return None


@lower_getattr_generic(HandleType)
def _field(context: Any, builder: Any, kind: HandleType, pointer: Any, name: str) -> Any:
    field, at = kind.fields[name]
    return _read(context, builder, field, builder.gep(pointer, [WORD(at)]))


@lower_builtin(operator.getitem, ItemsType, types.intp)
def _item(context: Any, builder: Any, kind: Any, args: Any) -> Any:
    (items, _), (pointer, index) = kind.args, args
    return _read(context, builder, items.item, builder.gep(pointer, [builder.mul(index, WORD(items.size))]))


def _read(context: Any, builder: Any, kind: types.Type, place: Any) -> Any:
    """Return the value that is laid out at a place."""

    def word(at: int, as_type: Any = WORD) -> Any:
        there = builder.bitcast(builder.gep(place, [WORD(at)]), as_type.as_pointer())
        loaded = builder.load(there)
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))  # whatever kernels write elsewhere
        return loaded

    if isinstance(kind, HandleType):
        return place
    if isinstance(kind, ItemsType):
        return builder.inttoptr(word(0), WORD.as_pointer())
    if kind == types.float64:
        return word(0, ir.DoubleType())
    if kind == types.boolean:
        return builder.icmp_unsigned("!=", word(0), WORD(0))
    if not isinstance(kind, types.Array):
        return word(0)
    array = make_array(kind)(context, builder)
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    shape = [word(1 + k) for k in range(kind.ndim)]
    strides = [WORD(size)]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    populate_array(
        array, data=builder.inttoptr(word(0), array.data.type), shape=shape, strides=strides, itemsize=WORD(size),
        meminfo=None,
    )  # fmt: skip
    return impl_ret_borrowed(context, builder, kind, array._getvalue())
