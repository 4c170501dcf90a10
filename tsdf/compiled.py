"""Compiled kernels: the door to numba, and where machine code is kept between runs.

numba's own cache knows a kernel by the text of its file, not by that of the kernels it calls, so an upgrade that
changes only those would leave old code running. Here a kernel is known by its file and all that this imports of the
package. Where neither the package nor the home can be written to (farms, containers), numba gives up; here the code is
kept in a folder of /tmp that nobody else can write to, for it is read back as it is, or else not at all. What is kept
are kernels that Python calls; those that kernels call are parts of them (`njit`).
"""

import contextlib
import gc
import hashlib
import os
import re
import stat
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import caching, cgutils, codegen, compiler, cpu, event, types
from numba.extending import intrinsic
from numba.np import linalg

from tsdf.files import whole

# Before its first kernel numba looks whether scipy has a BLAS, which takes .15 s to import. It has, and who multiplies
# matrices in a kernel asks for it again. A numba that asks otherwise is left to it.
if hasattr(linalg, "ensure_blas"):
    _ensure_blas, linalg.ensure_blas = linalg.ensure_blas, bool
    import numba.np.arraymath

    linalg.ensure_blas = _ensure_blas

PACKAGE = Path(__file__).parent
SELDOM = (50_000, 50, 50)  # thresholds of the garbage collector
_IMPORTS = re.compile(r"^from tsdf((?:\.\w+)*) import\s+([^(\n]+|\([^)]*\))", re.MULTILINE)


class _Part(codegen.JITCodeLibrary):
    """Code of a kernel that others call: it is made fast, and made machine code, in theirs alone."""

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: no machine code asks for this environment."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, which says that there is no machine code."""
        self._ensure_finalized()
        return 0

    def _optimize_final_module(self) -> None:
        """Leave it as it is, but for what numba does to each function before."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _Within(compiler.Compiler):
    """numba's compiler, for a kernel that others call."""

    def __init__(self, typing: Any, target: Any, library: Any, *others: Any) -> None:
        super().__init__(typing, target, _Part(target.codegen(), "part"), *others)


def njit(**options: Any) -> Callable[[Any], Any]:
    """Return what ``numba.njit`` does for these options; `cache` is kept as this module says.

    Kernels that others call are compiled for them once more, as parts: numba would link each with all that it calls,
    make that fast and then machine code, and begin again in its callers, one layer after the other, which took twice as
    long for all of them together.
    """
    kept = options.pop("cache", False)
    if not hasattr(cpu.CPUTargetOptions, "_nrt"):  # not a public option: without it, all works, only slower
        options.pop("_nrt", None)
    options["no_cfunc_wrapper"] = True

    def compiled(function: Any) -> Any:
        kernel = numba.njit(**options)(function)
        inner: Any = options | {"pipeline_class": _Within, "no_cpython_wrapper": True}
        kernel.part = part = cache(lambda: numba.njit(**inner)(function))
        kernel.get_call_template = lambda args, kws: part().get_call_template([_any(kind) for kind in args], kws)
        kernel.get_overload = lambda signature: part().get_overload(signature)
        if kept:
            kernel._cache = _Kept(function)
        return kernel

    return compiled


@intrinsic
def fetch(typing: Any, row: Any) -> Any:
    """Have the processor bring the begin of an array into its cache: for kernels, what is soon read at random."""

    def written(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        data = cgutils.create_struct_proxy(kind.args[0])(context, builder, args[0]).data
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        hint = ir.FunctionType(ir.VoidType(), (byte, number, number, number))
        hint = cgutils.get_or_insert_function(builder.module, hint, "llvm.prefetch.p0i8")
        builder.call(hint, (builder.bitcast(data, byte), number(0), number(3), number(1)))
        return context.get_dummy_value()

    return types.none(row), written


@intrinsic
def bits_of(typing: Any, x: Any) -> Any:
    """Return the bits of a float64 as a whole number."""
    return types.int64(types.float64), lambda context, builder, kind, args: builder.bitcast(args[0], ir.IntType(64))


@intrinsic
def float_of(typing: Any, bits: Any) -> Any:
    """Return the float64 of these bits."""
    return types.float64(types.int64), lambda context, builder, kind, args: builder.bitcast(args[0], ir.DoubleType())


def _any(kind: Any) -> Any:
    """Return the type of an argument, of a number or a truth that is written there that of any such, of a short whole
    number that of a long one.

    Else numba compiles a kernel anew for each number that others call it with, for each 0 that they count from, and for
    numbers that stand in an array.
    """
    if kind == types.int32:
        return types.int64
    literal = isinstance(kind, types.IntegerLiteral | types.BooleanLiteral | types.BaseTuple)
    return types.unliteral(kind) if literal else kind


@cache
def imported(name: str) -> frozenset[str]:
    """Return the names of the modules of the package that a module is made of: itself, and all that it imports.

    Names are dotted and without the package's own: ``walk.memory``.
    """
    found, waiting = set(), [name]
    while waiting:
        one = waiting.pop()
        if one in found or _text(one) is None:
            continue
        found.add(one)
        waiting += _named(one)
    return frozenset(found)


@cache
def _named(name: str) -> list[str]:
    """Return what may be the modules that one imports of the package."""
    named = []
    for inside, names in _IMPORTS.findall((_text(name) or b"").decode()):
        each = re.findall(r"(\w+)(?:\s+as\s+\w+)?\s*(?:,|\)|$)", names)
        named += [inside[1:], *(f"{inside}.{word}".lstrip(".") for word in each)]
    return named


@cache
def _text(name: str) -> bytes | None:
    """Return the text of a module of this name, None if there is none."""
    file = PACKAGE.joinpath(*name.split(".")).with_suffix(".py")
    return file.read_bytes() if file.is_file() else None


@cache
def _module_of(file: str) -> str | None:
    """Return the name of the module of the package that is in this file, None if none is."""
    path = Path(file)
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts) if path.is_relative_to(PACKAGE) else None


@cache
def stamp(name: str) -> str:
    """Return the SHA-256 of the text of a module and of all it imports of the package, in hexadecimal.

    How kernels read handles and are compiled is part of all of them.
    """
    return _digest(_text(one) or b"" for one in sorted(imported(name) | imported("compiled") | imported("handle")))


@cache
def _whole() -> str:
    """Return the SHA-256 of the text of the package, of which kernels elsewhere may be made."""
    return _digest(file.read_bytes() for file in sorted(PACKAGE.rglob("*.py")))


def _digest(texts: Iterable[bytes]) -> str:
    """Return the SHA-256 of the digests of texts, in hexadecimal."""
    return hashlib.sha256(b"".join(hashlib.sha256(text).digest() for text in texts)).hexdigest()


def private_folder() -> Path | None:
    """Return this user's folder for machine code among the temporary files, None where it could be another's."""
    try:
        path = Path(tempfile.gettempdir()) / f"tsdf-{os.getuid()}"
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except (OSError, AttributeError):  # not a folder, no folder for temporary files, or a system without users
        return None
    mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return path if mine and os.access(path, os.W_OK) else None


@cache
def _fallback() -> Path | None:
    """Return the folder for what nothing else can keep, and say so once."""
    folder = private_folder()
    where = f"kept in {folder} only" if folder else "not kept, and compiled again by every run"
    warnings.warn(
        f"compiled code is {where}, for neither the package nor the home can be written to; name a folder for it with "
        "NUMBA_CACHE_DIR",
        stacklevel=2,
    )
    return folder


class _Compiling(event.Listener):
    """How many kernels are being compiled.

    Meanwhile Python looks for garbage a fiftieth as often: compiling makes millions of objects and hardly any circles,
    and to look through them again and again took a tenth of the time.
    """

    count = 0
    took = np.zeros(2)  # [s] so far, by the clock and of processors

    def on_start(self, _: Any) -> None:
        if not self.count:
            self._began = self._clocks()
            self._usual = gc.get_threshold()
            gc.set_threshold(*SELDOM)
        self.count += 1

    def on_end(self, _: Any) -> None:
        self.count -= 1
        if not self.count:
            gc.set_threshold(*self._usual)
            self.took = self.took + self._clocks() - self._began

    def _clocks(self) -> np.ndarray:
        return np.array((time.perf_counter(), time.process_time()))


_now = _Compiling()
event.register("numba:compile", _now)


def compiled_for() -> np.ndarray:
    """Return how long kernels have been compiled in this process [s]: by the clock, and of processors."""
    return _now.took


def compiling() -> bool:
    """Return whether a kernel is being compiled, which may take a minute."""
    return _now.count > 0


def compile_ahead(kernel: Any, module: str) -> None:
    """Have another process compile a kernel that is to be kept, by running a module, which says `end_with_parent`.

    Nothing is done where it is kept already or cannot be, or where there is no processor for it. Who calls the kernel
    waits for that process; whatever becomes of it, a kernel that is not kept then is compiled as ever.
    """
    kept = kernel._cache
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    if kept.process is None and len(allowed) > 1 and kept.missing:
        command = [sys.executable, "-P", "-m", module]
        quiet = subprocess.DEVNULL
        kept.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)


def not_ahead(kernel: Any) -> None:
    """End the process that `compile_ahead` has begun for a kernel, for it is not needed."""
    if (process := kernel._cache.process) is not None:
        process.stdin.close()


def end_with_parent() -> None:
    """End this process when the one that began it by `compile_ahead` has ended, however that came."""

    def wait() -> None:
        os.read(0, 1)  # until nobody holds the other end
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class _Stamped:
    """A place for machine code, of numba's, known by all that a kernel is made of."""

    _py_file: str

    def get_source_stamp(self) -> Any:
        name = _module_of(self._py_file)
        return (super().get_source_stamp(), _whole()) if name is None else stamp(name)  # type: ignore[misc]


class _Given(_Stamped, caching.UserProvidedCacheLocator):
    """NUMBA_CACHE_DIR."""


class _InTree(_Stamped, caching.InTreeCacheLocator):
    """Beside the package."""


class _UserWide(_Stamped, caching.UserWideCacheLocator):
    """In the home."""


class _Temporary(_Stamped, caching.InTreeCacheLocator):
    """In a folder of /tmp."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)
        self._cache_path = os.path.join(_fallback() or "", self.get_suitable_cache_subpath(file))

    @classmethod
    def from_function(cls, function: Any, file: str) -> Any:
        return super().from_function(function, file) if _fallback() else None


class _Places(caching.CompileResultCacheImpl):
    _locator_classes: Any = (_Given, _InTree, _UserWide, _Temporary)


class _Cache(caching.FunctionCache):
    """numba's cache, which a damaged file or a full disk does not stop: the kernel is compiled again."""

    _impl_class = _Places

    def load_overload(self, signature: Any, context: Any) -> Any:
        try:
            return super().load_overload(signature, context)
        except Exception:  # whatever unpickling makes of a damaged file
            return None

    def save_overload(self, signature: Any, data: Any) -> None:
        try:
            with whole:
                super().save_overload(signature, data)
        except OSError:
            pass
        except Exception:  # an index that cannot be read, as of a version in which a type had another name
            with contextlib.suppress(OSError), whole:
                self.flush()
                super().save_overload(signature, data)


class _Kept:
    """The cache of a kernel, made when the kernel is first called: of most, others call nothing but parts.

    What the kernel is made of is read at once, before an upgrade of the package can change it.
    """

    process: subprocess.Popen[bytes] | None = None  # which compiles it, see `compile_ahead`

    def __init__(self, function: Any) -> None:
        self._function = function
        if (name := _module_of(function.__code__.co_filename)) is not None:
            stamp(name)

    @cached_property
    def _made(self) -> Any:
        try:
            return _Cache(self._function)
        except RuntimeError:  # nowhere to keep it, which `_fallback` has said
            return caching.NullCache()

    @property
    def missing(self) -> bool:
        """Whether nothing is kept yet, where it can be."""
        try:
            return not self._made._cache_file._load_index()
        except AttributeError:  # numba's NullCache: there is no place for it
            return False
        except Exception:  # a damaged file
            return True

    def load_overload(self, signature: Any, context: Any) -> Any:
        if self.process is not None and self.process.poll() is None:
            _now.on_start(None)
            try:
                self.process.wait()
            finally:
                _now.on_end(None)
        return self._made.load_overload(signature, context)

    def __getattr__(self, name: str) -> Any:
        if name in ("_function", "_made"):  # of a copy that is not whole yet
            raise AttributeError(name)
        return getattr(self._made, name)
