"""Makes the API reference, HTML, from the docstrings: ``python docs/reference.py``, into reference/; see `make docs`.

Names that `tsdf` imports only when asked for are looked up first, for pdoc shows what a module holds. What pdoc warns
of, types that do not exist among it, is an error.
"""

import pkgutil
import sys
import warnings
from pathlib import Path

import pdoc

import tsdf

INTO = Path(__file__).parents[1] / "reference"
ROOT = Path(tsdf.__file__).parent  # the rooms are found, so that none is forgotten


def main(into: Path = INTO) -> None:
    """Write the pages, index.html first."""
    warnings.simplefilter("error")
    for name in tsdf.__all__:
        setattr(tsdf, name, getattr(tsdf, name))
    pdoc.render.configure(docformat="numpy", search=True, footer_text=f"tsdf-toolkit {tsdf.__version__}")
    rooms = [f"tsdf.{name}" for _, name, _ in pkgutil.iter_modules([ROOT])]
    pdoc.pdoc("tsdf", *rooms, "tsdf.loaders.export", "tsdf.loaders.pointmedium", output_directory=into)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
