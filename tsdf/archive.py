"""Arrays kept in a file between runs: part files of builds, packings in the user's cache.

A ``.npz`` whose members are stored, not compressed, so that nothing can grow when it is read, with a digest over all of
them. Whoever reads says how large the file may be, and checks names, types and shapes of what comes back.
"""

import hashlib
import io
import os
import stat
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tsdf.files import replacing

DIGEST = "sha256"  # the member that holds it
PART = "request"  # the first member of the part file of a build


def _digest(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    found = hashlib.sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        found.update(values.data)
    return np.frombuffer(found.digest(), dtype=np.uint8)


def write(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name, whole or not at all; the same arrays give the same bytes.

    Raises
    ------
    TSDFError
        If the file cannot be written; one that stood there is left as it was.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays, **{DIGEST: _digest(arrays)})  # type: ignore[arg-type]


def read(path: str | os.PathLike[str], limit: int) -> dict[str, np.ndarray]:
    """Return the arrays of a file by name; they are read-only views of its bytes.

    Parameters
    ----------
    limit : int
        Bytes that the file may have.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is not whole, or not such a file.
    """
    path = Path(path)
    if not stat.S_ISREG(path.stat().st_mode) or path.stat().st_size > limit:
        raise ValueError("not a regular file, or too large")
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as members:
            for member in members.infolist():
                name = member.filename.removesuffix(".npy")
                if member.compress_type != zipfile.ZIP_STORED or member.file_size > limit or name in arrays:
                    raise ValueError(name)
                arrays[name] = _array(members.read(member))
    except (OSError, MemoryError):
        raise
    except Exception as error:  # whatever a zip reader makes of a damaged file
        raise ValueError(str(error)) from error
    digest = arrays.pop(DIGEST, None)
    if digest is None or not np.array_equal(digest, _digest(arrays)):
        raise ValueError("the digest is not that of the arrays")
    return arrays


def is_part(path: str | os.PathLike[str]) -> bool:
    """Return whether a file begins as the part file of a build does, whole or not."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            return False
        with open(path, "rb") as file:
            return begins_part(file.read(64))
    except OSError:
        return False


def begins_part(data: bytes) -> bool:
    """Return whether the bytes of a file begin as those of a part file do."""
    return data[:4] == b"PK\x03\x04" and data[30:].startswith(f"{PART}.npy".encode())


def _array(data: bytes) -> np.ndarray:
    """Return the array that the bytes of a ``.npy`` file hold, of numbers or text and exactly as many as there are."""
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("another version of npy")
    shape, fortran, kind = np.lib.format.read_array_header_1_0(stream)
    if fortran or kind.hasobject or kind.kind not in "iufU":
        raise ValueError(f"an array of {kind}")
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape)
