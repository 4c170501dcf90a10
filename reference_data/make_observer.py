"""Makes ``observer.csv``: run ``python -m tsdf.reference_data.make_observer``; the same bytes every time.

How bright and of what colour each wavelength of daylight is, for `tsdf.picture.image.spectral_weights`: all that it
would ask of colour-science, whose import takes longer than a small picture.
"""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

OBSERVER = Path(__file__).parent / "observer.csv"


def lines() -> Iterator[str]:
    """Yield the lines of the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour

    nm = np.arange(380.0, 781.0)
    observer, d65 = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"], colour.SDS_ILLUMINANTS["D65"]
    columns = [np.interp(nm, observer.wavelengths, values) for values in observer.values.T]
    columns.append(np.interp(nm, d65.wavelengths, d65.values))  # CIE 15:2018 interpolates D65 linearly
    yield "# made by python -m tsdf.reference_data.make_observer; README.md says what is in it"
    yield "wavelength_nm,x,y,z,d65"
    for row in zip(nm.tolist(), *(column.tolist() for column in columns), strict=True):
        yield ",".join(map(repr, row))


def main() -> None:
    OBSERVER.write_text("\n".join(lines()) + "\n", encoding="ascii")


if __name__ == "__main__":
    main()
