"""Files: written whole or not at all; whether they can be, and whether memory will do, found out beforehand.

A file is written under a hidden name beside its own, `.NAME.HEX.tmp`, then moved. Its writer holds a lock on it, which
ends with the process, so that the next one to write NAME can tell what a killed process left and take it away.
"""

import contextlib
import glob
import mmap
import os
import re
import secrets
import stat
import threading
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from urllib.parse import unquote

from tsdf.errors import TSDFError

try:
    from fcntl import LOCK_EX, LOCK_NB, flock
except ImportError:  # a system without such locks leaves what killed processes left
    flock = None  # type: ignore[assignment]

STALE_S = 5.0  # [s] younger temporary files are left alone: their lock may be about to be taken
PROBE = bytes(65536)  # what a disk must have room for before any work is done
MOST_TEXT = 1 << 26  # [bytes] of a mesh that are looked at for names of other files
_NAMES = {  # how they name them; of a line of materials the last word is one
    ".gltf": rb'"uri"\s*:\s*"([^"]{1,1024})"',
    ".obj": rb"(?m)^[ \t]*mtllib[ \t]+([^\r\n]{1,1024})",
    ".mtl": rb"(?m)^[ \t]*(?:map_\w{1,16}|bump|disp|decal|refl|norm)[ \t]([^\r\n]{1,1024})",
}
MOST_LINKS = 40  # that are followed from a name to what it leads to
MAX_NAME = 255  # [bytes] of the name of a file on common file systems

whole = threading.RLock()  # held while files are written that nothing tidies up: take it before ending the process
_open: set[Path] = set()  # temporary files of this process


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to, and move what is there to `path` if nothing was raised.

    Whatever happens, the temporary file does not stay, and a file that was at `path` stays as long as there is no whole
    new one.

    Raises
    ------
    TSDFError
        For any OSError, in one line.
    """
    try:
        target = _target(path)
        sweep(target)
        with _temporary(target) as temporary:
            yield temporary
            os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or error
        raise TSDFError(
            f"cannot write {os.fspath(path)}: {reason}; check the folder, the permissions and the free space"
        ) from error


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is a pipe, a terminal or another device, or leads through one of this process's streams.

    Where standard output is redirected to a file, /dev/stdout leads to it, and the file would be replaced by what was
    meant to be added to it.
    """
    here = Path(path).absolute()
    for _ in range(MOST_LINKS):
        here = Path(os.path.realpath(here.parent)) / here.name
        if here.parts[:2] == ("/", "proc") or str(here.parent) in ("/dev", "/dev/fd"):
            return True
        try:
            here = here.parent / os.readlink(here)
        except OSError:
            break
    try:
        mode = here.stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def probe(path: str | os.PathLike[str]) -> None:
    """Find out whether `path` can be written, as far as that can be known, by writing a little beside it.

    Raises
    ------
    OSError
    """
    target = _target(path)
    with _temporary(target) as temporary:
        temporary.write_bytes(PROBE)
    folder = target.parent.stat()
    if (
        target.exists()
        and folder.st_mode & stat.S_ISVTX
        and os.getuid() not in (0, folder.st_uid, target.stat().st_uid)
    ):
        raise PermissionError("it belongs to another user, in a folder where only owners replace files")


def sources(path: Path) -> list[Path]:
    """Return a file and, of a mesh in parts, the others that it names: buffers, materials and images."""
    found: dict[Path, None] = {}
    waiting = [path]
    while waiting:
        one = waiting.pop()
        pattern = _NAMES.get(one.suffix.lower())
        if one in found:
            continue
        found[one] = None
        text = b""
        with contextlib.suppress(OSError):  # of a name that is too long, too
            if pattern is not None and one.is_file():
                with open(one, "rb") as file:
                    text = file.read(MOST_TEXT)
        for name in map(os.fsdecode, re.findall(pattern or b"$^", text)):
            plainly = name.strip().replace("\\/", "/")
            spellings = {plainly, unquote(plainly), plainly.split()[-1] if plainly else ""} - {""}
            waiting += [one.parent / spelling for spelling in spellings if "\0" not in spelling]
    return list(found)


def discard() -> None:
    """Remove the temporary files of this process, which is about to end."""
    for path in tuple(_open):
        with contextlib.suppress(OSError):
            path.unlink()


def sweep(target: Path) -> None:
    """Remove what processes that were killed while they wrote `target` have left beside it."""
    if flock is None:
        return
    with contextlib.suppress(OSError):
        for path in list(target.parent.glob(glob.escape(_stem(target)) + "." + "[0-9a-f]" * 16 + ".tmp")):
            found = path.lstat()
            if not stat.S_ISREG(found.st_mode) or time.time() - found.st_mtime < STALE_S:
                continue
            with contextlib.suppress(OSError), open(path, "rb") as file:
                flock(file, LOCK_EX | LOCK_NB)  # refused while its writer lives
                path.unlink()


def _target(path: str | os.PathLike[str]) -> Path:
    """Return where a file really is, or will be.

    Raises
    ------
    OSError
        For what is there and not a regular file, for streams, or for a name that is too long.
    """
    if is_stream(path):
        raise OSError("it is no regular file but a stream (screen, pipe or device)")
    target = Path(os.path.realpath(path))
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(target.stat().st_mode):
            raise OSError("there is something other than a regular file")
    return target


def _stem(target: Path) -> str:
    """Return how the names of a file's temporary files begin."""
    room = MAX_NAME - len("..0123456789abcdef.tmp")
    return "." + os.fsencode(target.name)[:room].decode(errors="ignore")


@contextlib.contextmanager
def _temporary(target: Path) -> Iterator[Path]:
    """Give an empty file beside `target`, locked, which is not there any more afterwards."""
    path = target.with_name(f"{_stem(target)}.{secrets.token_hex(8)}.tmp")
    _open.add(path)
    try:
        with open(path, "xb") as file:
            if flock is None:
                file.close()  # such a system moves no open files
            else:
                with contextlib.suppress(OSError):  # a file system without locks
                    flock(file, LOCK_EX | LOCK_NB)
            yield path
    finally:
        path.unlink(missing_ok=True)
        _open.discard(path)


def need_memory(size: int) -> None:
    """Refuse what will not fit, before a library that cannot say so crashes: Embree does.

    Parameters
    ----------
    size : int
        Bytes of address space that are about to be asked for.

    Raises
    ------
    MemoryError
    """
    if os.name != "posix":
        return
    try:  # nothing can be written there, so it costs nothing
        mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=0).close()
    except OSError:
        raise MemoryError from None


def software() -> str:
    """Return name and version of this package, as files say what made them."""
    try:
        return f"tsdf-toolkit {version('tsdf-toolkit')}"
    except PackageNotFoundError:
        return "tsdf-toolkit"
