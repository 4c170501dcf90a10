"""What every command does first: answer signals whatever else is busy, and see to its streams and its memory."""

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tsdf.reference_data.make_checks import CHECKS

ROOT = Path(__file__).parents[2]
TABLE = CHECKS / "sphere.tsdf.exr"
COMMANDS = ("accuracy", "build", "export", "frontier", "info", "merge", "packing", "plot", "render", "validate")


def code(command: str) -> list[str]:
    return [sys.executable, "-c", f"from tsdf.cli.start import {command}; {command}()"]


@pytest.mark.slow
def test_signals_at_random_moments() -> None:
    """The long form is ``python fuzz/signals.py --count 100``."""
    words = ["--count", "6", "--within", "1.2", "--commands", "render,build,validate,frontier,plot,packing"]
    done = subprocess.run([sys.executable, ROOT / "fuzz" / "signals.py", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("6 signals: ") and done.stdout.endswith(" 0 wrong\n")


BUSY = """
import hashlib
from tsdf.cli import start
from tsdf.files import replacing
start.AGAIN_S = {again}
start.answer("tsdf-busy")
with replacing("half.txt") as temporary, start.interruptible({meaning}):
    temporary.write_text("half")
    {wait}
"""
WAIT = """print("busy", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)  # one instruction of minutes, as compiling is
"""
RAISED = """try:
        print("busy", flush=True)
        __import__("time").sleep(60)
    except KeyboardInterrupt:
        print("kept", start.interrupt_status())
"""
CALLED_BACK = """import ctypes, os, signal, time
    def called():
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            time.sleep(0.001)
    callback = ctypes.CFUNCTYPE(None)(called)
    try:
        print("busy", flush=True)
        callback()
        time.sleep(60)
    except KeyboardInterrupt:
        print("kept", start.interrupt_status())
"""


@pytest.fixture
def busy(launch: Callable[..., subprocess.Popen], tmp_path: Path) -> Callable[..., subprocess.Popen]:
    """Start a process that writes a file and is busy, and wait until it is."""

    def start(meaning: str, wait: str = WAIT, again: float = 2.0) -> subprocess.Popen:
        text = BUSY.replace("{meaning}", meaning).replace("{wait}", wait).replace("{again}", str(again))
        process = launch([sys.executable, "-c", text], stdout=-1, stderr=-1, text=True, cwd=tmp_path)
        assert process.stdout.readline() == "busy\n"
        return process

    return start


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_long_instruction_is_interrupted(
    number: int, busy: Callable[..., subprocess.Popen], tmp_path: Path
) -> None:
    process = busy("lambda: 'all is lost'")
    process.send_signal(number)
    assert process.communicate(timeout=30)[1] == "tsdf-busy: error: interrupted: all is lost\n"
    assert process.returncode == 128 + number
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_within_a_callback_is_not_lost(busy: Callable[..., subprocess.Popen]) -> None:
    """Python prints what is raised there and goes on; a compiler calls back each time it has made machine code."""
    said = busy("lambda: None, raises=True", CALLED_BACK).communicate(timeout=30)
    assert said == ("kept 130\n", "")


def test_what_there_is_to_keep_is_waited_for(busy: Callable[..., subprocess.Popen], tmp_path: Path) -> None:
    """Two signals at once are one; a later one ends at once."""
    process = busy("lambda: None", again=0.5)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    time.sleep(0.6)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert "at once" in process.communicate(timeout=30)[1]
    assert process.returncode == 143
    assert list(tmp_path.iterdir()) == []


def test_an_exception_is_raised_where_asked_for(busy: Callable[..., subprocess.Popen], tmp_path: Path) -> None:
    process = busy("lambda: None, raises=True", RAISED)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=30) == ("kept 143\n", "")
    assert [path.name for path in tmp_path.iterdir()] == ["half.txt"]


@pytest.mark.slow
@pytest.mark.parametrize("closed", [(), (0,), (1,), (2,), (0, 1), (1, 2), (0, 1, 2)], ids=str)
@pytest.mark.parametrize("out", [False, True])
def test_closed_streams(out: bool, closed: tuple[int, ...], tmp_path: Path) -> None:
    """No traceback; 1 where a result had nowhere to go, else 0."""
    shell = " ".join(f"{number}{'<' if number == 0 else '>'}&-" for number in closed)
    words = ["--packing", "0.3", "--radius", "1", "--to", "pbrt", *(["--out", "p.pbrt"] if out else [])]
    done = subprocess.run(
        ["sh", "-c", f'"$@" {shell}', "sh", *code("export"), TABLE, *words],
        capture_output=True, text=True, cwd=tmp_path, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    lost = 1 in closed and not out
    assert done.returncode == int(lost), done.stderr
    assert done.stderr.count("\n") == int(lost and 2 not in closed) and "Traceback" not in done.stderr
    assert (done.stdout != "") == (1 not in closed and not out)
    assert not out or (tmp_path / "p.pbrt").stat().st_size > 100


@pytest.mark.parametrize("command", ["info", "render"])
def test_little_memory(command: str) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (300 << 20, 300 << 20))

    done = subprocess.run([*code(command), "x"], capture_output=True, text=True, preexec_fn=limit, timeout=30)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert f"tsdf-{command}: error: not enough memory: ulimit -v is 300 MiB" in done.stderr


def test_each_command_starts_here() -> None:
    """The package's entry points, which are these functions."""
    text = (ROOT / "pyproject.toml").read_text()
    for command in COMMANDS:
        assert f'tsdf-{command} = "tsdf.cli.start:{command}"\n' in text
