"""Writing a file whole or not at all."""

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
