"""Measure what an event costs in C++ and in numba: ``python benchmarks/bench_cpp.py --help``.

Both walk from event to event with the same hashed random numbers, on the same table, in turn; times are medians over
rounds and so are their ratios. The C++ is built here, by g++.
"""

import argparse
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

from bench_sampler import algorithm_1, built, joint_records

from tsdf.data import format as tsdf_format
from tsdf.data.sampler import compile_tables

ROOT = Path(__file__).parent.parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--grain", default="snow", help="built-in grain to make a table of")
    parser.add_argument("--table", type=Path, help="a finished table with joint records instead")
    parser.add_argument("--paths", type=int, default=1_000_000, help="paths of the table")
    parser.add_argument("--records", type=int, default=32, help="joint records per column")
    parser.add_argument("--events", type=int, default=1_000_000, help="events in each round")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--flags", default="-O3 -march=native", help="for g++, in one word; numba has the like")
    given = parser.parse_args()
    table = tsdf_format.read(given.table) if given.table else built(given.grain, given.paths, given.records)
    tables = compile_tables([table], joint=True)
    with tempfile.TemporaryDirectory() as folder:
        program, path = Path(folder) / "check_tsdf", Path(folder) / "table.tsdf.exr"
        tsdf_format.write(table, path)
        source = ROOT / "loaders" / "cpp" / "check_tsdf.cpp"
        subprocess.run(["g++", "-std=c++17", *given.flags.split(), source, "-o", program], check=True)
        print(f"{table!r}, g++ {given.flags}")
        print(f"{'':16} C++ ns/event   numba ns/event   C++ / numba")
        for name, kernel, word in (("Algorithm 1", algorithm_1, "apart"), ("joint records", joint_records, "joint")):
            command = [str(program), "bench", str(path), word, str(given.events), "1"]
            kernel(tables, 1000, 1)
            pairs = []
            for _ in range(given.rounds):
                start = time.perf_counter()
                kernel(tables, given.events, 1)
                own = (time.perf_counter() - start) / given.events * 1e9
                other = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
                pairs.append((other, own))
            cpp, numba = (statistics.median(side) for side in zip(*pairs, strict=True))
            ratio = statistics.median(a / b for a, b in pairs)
            print(f"{name:16} {cpp:12.1f}   {numba:14.1f}   {ratio:11.2f}")


if __name__ == "__main__":
    main()
