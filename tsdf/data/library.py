"""Library: ready tables that come with the package, by name.

Wherever a table file is read, such a name will do; a file of that name wins. `reference_data/make_library.py` makes
them, docs/library.md shows them.
"""

import os
from difflib import get_close_matches
from pathlib import Path

from tsdf.errors import FormatError

FOLDER = Path(__file__).parent / "library"
SUFFIX = ".tsdf.exr"


def names() -> list[str]:
    """Return the names of the ready tables, in order."""
    return sorted(path.name.removesuffix(SUFFIX) for path in FOLDER.glob(f"*{SUFFIX}"))


def ready(name: str) -> Path | None:
    """Return the file of the ready table of a name, None for what cannot be a name: it has a folder or a suffix.

    Raises
    ------
    FormatError
        There is none of that name; the nearest is told.
    """
    if not name.replace("-", "").replace("_", "").isalnum():
        return None
    known = names()
    if name in known:
        return FOLDER / f"{name}{SUFFIX}"
    near = get_close_matches(name.lower(), known, 1)
    hint = f"did you mean {near[0]}?" if near else f"ready tables are {', '.join(known)}"
    raise FormatError("FILE_UNREADABLE", f"{name}: neither a file nor a ready table; {hint}")


def found(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    """Return the file of a ready table where `path` is no file but a name, else `path`; errors are those of `ready`."""
    name = os.fspath(path)
    return path if not isinstance(name, str) or os.path.exists(name) else ready(name) or path
