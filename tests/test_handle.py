"""Handles: kernels read of them what the NamedTuple holds."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import njit

from tsdf.handle import Handle


class Inner(NamedTuple):
    values: np.ndarray
    scale: float


class Outer(NamedTuple):
    flag: bool
    count: int
    inner: Inner
    several: tuple[Inner, ...]
    triple: tuple[float, float, float]
    grid: np.ndarray
    rows: np.ndarray


ROW = np.dtype([("p", "3f8"), ("n", "i4")])


def outer(several: int = 2, shift: float = 0.0) -> Outer:
    inners = tuple(Inner(np.arange(3.0) + 10.0 * i + shift, 0.5 + i) for i in range(several))
    grid = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    return Outer(True, -7, Inner(np.arange(4.0), np.float64(2.5)), inners, (1.0, 2.0, 3.0), grid, np.zeros(2, ROW))


@njit
def read(outer, m, i, found):
    """Write what an Outer holds, whether it comes as a handle or as it is, to (9,) found; mark row 1."""
    found[0], found[1], found[2] = 1.0 if outer.flag else 0.0, outer.count, outer.inner.values[i] * outer.inner.scale
    one = outer.several[m]
    found[3], found[4], found[5] = one.values[i] * one.scale, outer.triple[2], outer.grid[1, 2, 3]
    found[6], found[7], found[8] = outer.grid.shape[1], outer.grid.size, outer.inner.values.shape[0]
    row = outer.rows[1]
    row.p[2], row.n = 4.0, row.n + 1


def found(value: Any, m: int, i: int) -> np.ndarray:
    result = np.zeros(9)
    read(value, m, i, result)
    return result


def test_kernels_read_what_is_there() -> None:
    """Each kind of field, beside the same kernel with the NamedTuple itself."""
    values = outer()
    expected = [1.0, -7.0, 2.5, 11.0 * 1.5, 3.0, 23.0, 3.0, 24.0, 4.0]
    assert found(Handle(values), 1, 1).tolist() == expected == found(values, 1, 1).tolist()
    assert values.rows["p"][1, 2] == 4.0 and values.rows["n"].tolist() == [0, 2]


def test_arrays_are_shared_and_kept() -> None:
    """Changes of an array are seen, and the handle keeps what it points to."""
    handle = Handle(outer(shift=5.0))
    handle.values.several[0].values[2] = 100.0
    junk = [np.ones(3) for _ in range(100)]
    assert found(handle, 0, 2)[3] == 50.0 and len(junk) == 100


def test_one_compilation_for_any_sizes() -> None:
    """Lengths, and how many of equals there are, are no part of the type: no scene compiles what another has."""
    found(Handle(outer()), 0, 0)
    before = len(read.signatures)
    found(Handle(outer(several=3)._replace(grid=np.zeros((5, 6, 7), np.float32), rows=np.zeros(9, ROW))), 2, 0)
    assert len(read.signatures) == before
    assert Handle(outer())._numba_type_ != Handle(outer()._replace(count=1.0))._numba_type_


@pytest.mark.parametrize(
    ("field", "value"), [("grid", np.zeros((4, 3), np.float32).T), ("flag", "no"), ("triple", (1.0, 2, 3.0))]
)
def test_what_has_no_layout_is_refused(field: str, value: Any) -> None:
    with pytest.raises(TypeError):
        Handle(outer()._replace(**{field: value}))
