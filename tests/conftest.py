"""Tests keep their packings to themselves: no test reads or writes the user's cache. The scripts of fuzz/ by name."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    patch = pytest.MonkeyPatch()
    patch.setenv("TSDF_CACHE", str(folder))
    return folder


@pytest.fixture
def launch() -> Iterator[Callable[..., subprocess.Popen]]:
    """Start processes, as `subprocess.Popen` does, which end with the test, whatever becomes of it."""
    begun: list[subprocess.Popen] = []

    def start(words: list[str], **options: object) -> subprocess.Popen:
        begun.append(subprocess.Popen(words, **options))  # type: ignore[call-overload]
        return begun[-1]

    yield start
    for process in begun:
        with process:
            process.kill()


@pytest.fixture(scope="session")
def fuzzer() -> Callable[[str], ModuleType]:
    """Return the script of fuzz/ that has a name, as a module."""

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"fuzz_{name}", Path(__file__).parents[1] / "fuzz" / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load
