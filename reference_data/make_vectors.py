"""Makes ``sample_vectors.csv``: run ``python -m tsdf.reference_data.make_vectors``; the same bytes every time.

Random numbers and the events that `tsdf.data.sampler` makes of them, for implementations in other languages to be held
against. The numbers are multiples of 2^-24, and so exact as 32-bit floats; each edge of [0, 1) stands in each place.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tsdf.data import format as tsdf_format
from tsdf.data.sampler import Sampler

FOLDER = Path(__file__).parent
VECTORS = FOLDER / "sample_vectors.csv"
TABLES = ("valid/minimal", "valid/records", "valid/empty_columns", "valid/many_rows", "checks/STATISTICS_DROPPED")
ONE = 1 << 24
EDGES = (0, 1, ONE // 2 - 1, ONE // 2, ONE - 1)
DRAWN = 150  # events of a table besides those of the edges
DIGITS = 10  # of each result, a hundred times what a reader is asked for


def numbers(seed: int) -> np.ndarray:
    """Return random numbers in units of 2^-24, (n, 6) int64: edges in all places, in each place alone, and others."""
    drawn = np.random.default_rng(seed).integers(0, ONE, (DRAWN + 6 * len(EDGES), 6))
    for place in range(6):
        drawn[place * len(EDGES) : (place + 1) * len(EDGES), place] = EDGES
    return np.concatenate([np.repeat(np.array(EDGES)[:, None], 6, axis=1), drawn])


def lines() -> Iterator[str]:
    """Yield the lines of the file."""
    yield "# made by python -m tsdf.reference_data.make_vectors; README.md says what is in it. CC0-1.0"
    yield "table,joint,u_phi_d,u_theta,u_r,u_z,u_phi_delta,u_l,cos_theta,phi_d,r,z,phi_delta,path_length,column"
    for seed, name in enumerate(TABLES):
        with np.errstate(all="raise"):
            table = tsdf_format.read(FOLDER / "golden" / f"{name}.tsdf.exr")
        for joint in (False, True) if table.joint else (False,):
            u = numbers(seed)
            samples = Sampler(table, joint).sample(u / ONE)
            for row, event in zip(u, zip(*samples, strict=True), strict=True):
                results = [f"{value:.{DIGITS}g}" for value in event[:-1]]
                yield ",".join([name, str(int(joint)), *map(str, row), *results, str(event[-1])])


def main() -> None:
    VECTORS.write_text("\n".join(lines()) + "\n", encoding="ascii")


if __name__ == "__main__":
    main()
