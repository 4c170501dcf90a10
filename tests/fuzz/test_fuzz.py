"""The fuzzers in fuzz/ run, a few seconds each, find nothing, and would find something if it was there."""

import shutil
import sys
from collections.abc import Callable
from types import ModuleType

import pytest

from tsdf.data import format as tsdf_format


def run(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Return the exit status of a script's `main`, without a C++ compiler (test_cpp compares the readers)."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["fuzz", *arguments])
    return module.main()


def test_tables(
    fuzzer: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No fault in some hundred tables; a reader that fails, and one that reads something else, are found out."""
    tables = fuzzer("tables")
    assert tables.variant(3, 5).data == tables.variant(3, 5).data != tables.variant(3, 6).data
    assert run(tables, monkeypatch, "--count", "400", "--seed", "3") == 0
    text = capsys.readouterr().out
    assert text.startswith("400 tables, seed 3: ") and ", 0 faults; " in text
    inspect = tsdf_format.inspect

    def fails(data: bytes) -> object:
        raise ValueError("not ours")

    def other(data: bytes) -> object:
        return inspect(tables.VALID[0])

    for broken in (fails, other):
        monkeypatch.setattr(tsdf_format, "inspect", broken)
        assert run(tables, monkeypatch, "--count", "50") == 1
