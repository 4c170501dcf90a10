"""Ctrl-C and SIGTERM at random moments of the start of each command, with kernels compiled or not.

    python fuzz/signals.py --count 100

Each command is to be gone within two seconds, with status 130 or 143, one line and no traceback, and is to leave no
hidden file. The clock starts once the command answers signals, some hundredths of a second after its first line of
Python: until then a signal finds the interpreter itself. Exit status 1 if any command did otherwise.
"""

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
TABLE = ROOT / "reference_data" / "golden" / "checks" / "cube.tsdf.exr"
ANSWER_S = 2.0
SCENE = ROOT / "tests" / "ball.toml"
COMMANDS = {
    "accuracy": "cube.tsdf.exr --out folder --packing 0.1 --seconds 1000",
    "albedo": "cube.tsdf.exr --thickness 10mm --error 1e-5 --csv new.csv",
    "build": "cube --eta 1.31 --paths 1e9 --out new.exr",
    "export": "cube.tsdf.exr --to csv --packing 0.3 --radius 1 --out new.csv",
    "frontier": "scene.toml --out folder --seconds 1000",
    "info": "cube.tsdf.exr",
    "merge": "part --out new.exr",
    "packing": "--out new.exr --spheres 20000",
    "plan": "scene.toml --seconds 1000",
    "plot": "cube.tsdf.exr --out new.png",
    "render": "scene.toml --out new.exr --spp 1000000",
    "render auto": "scene.toml --level auto --out new.exr --seconds 1000",
    "stress": "--quick --out folder",
    "validate": "cube.tsdf.exr cube.tsdf.exr cube.tsdf.exr",
}


@dataclass(frozen=True)
class Trial:
    """What a command did."""

    command: str
    number: int  # the signal
    at: float  # after it began to answer [s]
    cold: bool  # whether kernels had to be compiled
    answered: float | None  # [s]; None if it was done before
    status: int
    said: str
    hidden: tuple[str, ...]

    @property
    def fault(self) -> str:
        """What is wrong with it, "" if nothing is."""
        if self.answered is None:
            return "" if self.status in (0, 1) and "Traceback" not in self.said else f"status {self.status}"
        if self.status not in (128 + self.number, 0):  # 0: the last line was written already
            return f"status {self.status}"
        if self.answered > ANSWER_S:
            return f"answered after {self.answered:.1f} s"
        if "Traceback" in self.said or self.said.count("\n") > 1:
            return "said too much"
        return f"left {', '.join(self.hidden)}" if self.hidden else ""


def trial(command: str, at: float, number: int, cold: bool, kept: Path) -> Trial:
    """Start a command in a folder of its own, send it a signal, and see what it does."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(TABLE, folder / "cube.tsdf.exr")
        shutil.copy(SCENE, folder / "scene.toml")
        if command == "merge":
            shutil.copy(kept / "part", folder)
        own = folder / "cache" if cold else kept / "cache"
        environment = os.environ | {"NUMBA_CACHE_DIR": str(own), "TSDF_CACHE": str(folder / "packings")}
        entry = command.split()[0]
        code = f"from tsdf.cli.start import {entry}; {entry}()"
        process = subprocess.Popen(
            [sys.executable, "-c", code, *COMMANDS[command].split()],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment,
        )  # fmt: skip
        try:
            while process.poll() is None and not answers(process.pid):
                time.sleep(0.001)
            time.sleep(at)
            done = process.poll() is not None
            begun = time.monotonic()
            process.send_signal(number)
            said = process.communicate(timeout=120)[1]
            taken = None if done else time.monotonic() - begun
        finally:
            process.kill()
            process.wait()
        hidden = [p.name for p in folder.rglob("*") if p.name.startswith(".") or ".tmp" in p.name]
        return Trial(command, number, at, cold, taken, process.returncode, said, tuple(hidden))


def answers(pid: int) -> bool:
    """Whether a process catches SIGTERM, which Python by itself does not."""
    try:
        caught = re.search(r"SigCgt:\t(\w+)", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return True
    return caught is None or bool(int(caught[1], 16) >> (signal.SIGTERM - 1) & 1)


def main() -> int:
    """Make the trials and sum them up."""
    parser = argparse.ArgumentParser(description="Send signals to commands at random moments of their start.")
    parser.add_argument("--count", type=int, default=100, help="signals [100]")
    parser.add_argument("--within", type=float, default=6.0, help="of the start [6 s]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [0]")
    parser.add_argument("--commands", default=",".join(COMMANDS), help="which [all]")
    chosen = parser.parse_args()
    commands, dice = chosen.commands.split(","), random.Random(chosen.seed)
    counts, slowest, wrong = Counter[str](), 0.0, 0
    with tempfile.TemporaryDirectory() as name:
        kept = Path(name)
        if "merge" in commands:
            words = ["cube", "--eta", "1.31", "--paths", "8192", "--chunk", "1/1", "--quiet", "--out", kept / "part"]
            subprocess.run([sys.executable, "-c", "from tsdf.cli.start import build; build()", *words], check=True)
        for k in range(chosen.count):
            command, number = commands[k % len(commands)], dice.choice((signal.SIGINT, signal.SIGTERM))
            one = trial(command, dice.uniform(0.0, chosen.within), number, dice.random() < 0.5, kept)
            counts["done before" if one.answered is None else "answered"] += 1
            slowest = max(slowest, one.answered or 0.0)
            if one.fault:
                wrong += 1
                print(f"{command}: {one.fault} ({one.number} at {one.at:.2f} s, cold {one.cold}): {one.said!r}")
    print(f"{chosen.count} signals: {dict(counts)}, the slowest answer {slowest:.2f} s, {wrong} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
