"""Machine code that is kept: never stale, never where others can write, and never a reason to stop."""

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tsdf import compiled
from tsdf.compiled import PACKAGE, fetch, njit, private_folder

INNER = "from tsdf.compiled import njit\n\nSCALE = {}\n\n@njit(cache=True)\ndef f(x):\n    return SCALE * x\n"
OUTER = "from tsdf.compiled import njit\nfrom tsdf.inner import f\n\n@njit(cache=True)\ndef g(x):\n    return f(x)\n"
RUN = "from tsdf.outer import g; print(g(1.0), sum(g.stats.cache_hits.values()), g._cache.cache_path)"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A small package of this name, of which one module calls a kernel of another."""
    package = tmp_path / "tsdf"
    package.mkdir()
    for name in ("__init__", "errors", "files", "compiled"):
        shutil.copy(PACKAGE / f"{name}.py", package)
    (package / "inner.py").write_text(INNER.format(2.0))
    (package / "outer.py").write_text(OUTER)
    return package


def run(package: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Call the outer kernel in a process of its own: its value, cache hits, and where it is kept."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "PYTHON", "XDG"))}
    own |= {"PYTHONDONTWRITEBYTECODE": "1", **environment}
    code = f"import sys; sys.path.insert(0, {str(package.parent)!r})\n{RUN}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=own, check=True)


@pytest.mark.slow
def test_a_changed_callee_is_noticed(package: Path) -> None:
    """An upgrade that changes a kernel's callee alone runs the new one; numba's own cache runs the old one."""
    assert run(package).stdout.split()[:2] == ["2.0", "0"]
    (package / "inner.py").write_text(INNER.format(3.0))
    assert run(package).stdout.split() == ["3.0", "0", str(package / "__pycache__")]
    (package / "unrelated.py").write_text("")
    for file in package.glob("__pycache__/outer*.nbc"):
        file.write_bytes(file.read_bytes()[:-100])
    assert run(package).stdout.split()[:2] == ["3.0", "0"]  # damaged: compiled again
    for file in package.glob("__pycache__/outer*.nbi"):
        file.write_bytes(file.read_bytes()[:-9])
    assert run(package).stdout.split()[:2] == ["3.0", "0"]  # so with an index that cannot be read, as after a rename
    assert run(package).stdout.split()[:2] == ["3.0", "1"]  # and kept again
    assert run(package).stdout.split()[:2] == ["3.0", "1"]


@pytest.mark.slow
def test_nowhere_to_keep_it(package: Path, tmp_path: Path) -> None:
    """Neither beside the package (a file is in the way) nor in a home: a private folder, or none; one line each."""
    (package / "__pycache__").write_text("in the way")
    bare = {"HOME": "/proc/none", "TMPDIR": str(tmp_path)}
    own = tmp_path / f"tsdf-{os.getuid()}"
    for hits in "01":
        done = run(package, **bare)
        assert done.stdout.split()[:2] == ["2.0", hits] and done.stdout.split()[2].startswith(str(own))
        assert done.stderr.count("NUMBA_CACHE_DIR") == 1 and str(own) in done.stderr
    assert own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)  # others may have put in what they like
    done = run(package, **bare)
    assert done.stdout.split() == ["2.0", "0", "None"] and done.stderr.count("NUMBA_CACHE_DIR") == 1
    named = run(package, NUMBA_CACHE_DIR=str(tmp_path / "named"), **bare)
    assert named.stderr == "" and str(tmp_path / "named") in named.stdout


def test_a_folder_of_another_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled.tempfile, "gettempdir", lambda: str(tmp_path))
    path = tmp_path / f"tsdf-{os.getuid()}"
    assert private_folder() == path
    path.chmod(0o720)
    assert private_folder() is None
    path.rmdir()
    path.symlink_to(tmp_path)
    assert private_folder() is None
    path.unlink()
    path.write_text("")
    assert private_folder() is None
    path.unlink()
    monkeypatch.setattr(compiled.os, "getuid", lambda: 12345)
    (tmp_path / "tsdf-12345").mkdir(mode=0o700)
    assert private_folder() is None or os.stat(tmp_path).st_uid == 12345


def test_a_numba_without_the_private_option(monkeypatch: pytest.MonkeyPatch) -> None:
    owner = next(one for one in compiled.cpu.CPUTargetOptions.__mro__ if "_nrt" in vars(one))
    monkeypatch.delattr(owner, "_nrt")

    @njit(_nrt=False, nogil=True)
    def twice(x):
        return 2 * x

    assert twice(3) == 6


def test_numbers_written_down_are_numbers() -> None:
    """A kernel that others call with 0, 1, a count from 0, or a number of an array, alone or in a tuple, with True and
    with False, is compiled once."""

    @njit()
    def inner(pair, i, negative):  # type: ignore[no-untyped-def]
        return -pair[0] - i if negative else pair[0] + i

    @njit()
    def outer(n, short):  # type: ignore[no-untyped-def]
        total = 0
        for i in range(n):
            total += inner((total, 1), i, False) + inner((0, 2), 0, False) + inner((1, 3), 1, i < 0)
        return total + inner((0, 2), short[0], True)

    assert outer(2, np.array([3], np.int32)) == 4
    assert len(inner.part().signatures) == 1 and not inner.signatures


def test_a_kernel_of_others_is_compiled_in_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """No machine code of its own is made for it, it does what it does from Python, and its errors come out."""
    emitted = []
    finish = compiled.codegen.CPUCodeLibrary._finalize_final_module
    monkeypatch.setattr(
        compiled.codegen.CPUCodeLibrary, "_finalize_final_module", lambda own: (emitted.append(own.name), finish(own))
    )

    @njit(nogil=True)
    def root(x):  # type: ignore[no-untyped-def]
        if x < 0.0:
            raise ValueError("below 0")
        return x**0.5

    @njit(nogil=True)
    def twice(x):  # type: ignore[no-untyped-def]
        return 2.0 * root(x) + root(x + 1.0)

    assert twice(0.0) == 1.0 and len(root.part().signatures) == 1
    assert any("twice" in name for name in emitted) and not any("root" in name for name in emitted)
    with pytest.raises(ValueError, match="below 0"):
        twice(-3.0)
    assert root(4.0) == 2.0 and any("root" in name for name in emitted)


def test_what_is_fetched_is_what_it_was() -> None:
    """A hint to the processor changes nothing, whatever the row."""

    @njit()
    def summed(rows):  # type: ignore[no-untyped-def]
        total = 0.0
        for i in range(rows.shape[0]):
            fetch(rows[i])
            total += rows[i, 0]
        return total

    for kind in (np.float32, np.float64):
        rows = np.arange(12.0).reshape(4, 3).astype(kind)
        assert summed(rows) == 18.0 and (rows == np.arange(12.0).reshape(4, 3)).all()


@pytest.mark.slow
def test_a_first_kernel_needs_no_scipy() -> None:
    """numba imports scipy's linear algebra before any kernel, for .15 s; kernels that multiply matrices still do."""
    code = (
        "import sys, numpy as np\nfrom tsdf.compiled import njit\n"
        "f = njit()(lambda x: x + 1.0)\nprint(f(1.0), 'scipy.linalg' in sys.modules)\n"
        "g = njit()(lambda a: np.cov(a))\nprint(g(np.eye(2))[0, 1], 'scipy.linalg' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["2.0", "False", "-0.5", "True"]


def test_compiling_is_timed_and_collects_no_less_garbage_afterwards():
    before, usual = compiled.compiled_for(), gc.get_threshold()
    compiled.njit()(lambda x: 2.0 * x)(1.0)
    assert (compiled.compiled_for() > before).all()
    assert gc.get_threshold() == usual
    assert not compiled.compiling()
