"""Writing a file whole or not at all; whether there is room in memory for what is to come."""

import mmap
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tsdf.errors import TSDFError


@contextmanager
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
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():
            raise OSError("there is something other than a regular file")
        temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
        try:
            yield temporary
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise TSDFError(
            f"cannot write {os.fspath(path)}: {reason}; check the folder, the permissions and the free space"
        ) from error


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
