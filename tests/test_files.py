"""Files are written whole or not at all, and what a killed process left is taken away by the next."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tsdf import files
from tsdf.errors import TSDFError
from tsdf.files import replacing

WRITER = """
import sys, time
from tsdf.files import replacing
with replacing(sys.argv[1]) as temporary:
    print(temporary, flush=True)
    time.sleep(60)
"""


def write(path: Path, text: str = "new") -> None:
    with replacing(path) as temporary:
        temporary.write_text(text)


def test_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a"
    write(path, "old")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_what_killed_processes_leave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dead writer's file goes at the next write to the same name; a living one's, another name's and others' stay."""
    path = tmp_path / "a[1]*.exr"
    others = [tmp_path / f".{name}.tmp" for name in ("a", "a.exr.0123456789abcdef", "a[1]*.exr", "a[1]*.exr.backup")]
    for other in others:
        other.write_text("mine")
    dead, alive = (
        subprocess.Popen([sys.executable, "-c", WRITER, path], stdout=subprocess.PIPE, text=True) for _ in range(2)
    )
    left, busy = (Path(process.stdout.readline().strip()) for process in (dead, alive))
    try:
        dead.kill()
        dead.wait()
        write(path)
        assert left.exists() and busy.exists()  # young files are left alone
        for old in (left, busy, *others):
            os.utime(old, times=(time.time() - 10.0,) * 2)
        write(path)
        assert not left.exists() and busy.exists() and all(other.exists() for other in others)
    finally:
        alive.send_signal(signal.SIGKILL)
        alive.wait()
        for process in (dead, alive):
            process.stdout.close()


def test_long_names(tmp_path: Path) -> None:
    """The longest name a file system takes can be written; one byte more is refused in one line."""
    path = tmp_path / ("é" * 127 + "a")
    write(path)
    assert path.read_text() == "new"
    for attempt in (write, files.probe):
        with pytest.raises((TSDFError, OSError), match="too long"):
            attempt(tmp_path / ("é" * 128))
    assert list(tmp_path.iterdir()) == [path]


def test_what_meshes_name(tmp_path: Path) -> None:
    """All files of a mesh in parts, in circles too, and nothing is opened that could block."""
    (tmp_path / "a.obj").write_text("\n" * 1000 + "\tmtllib  my own.mtl \r\nv 0 0 0\n")
    (tmp_path / "my own.mtl").write_text("map_Kd -s 1 1 1 skin.png\nbump my own.mtl\nKd 1 1 1")
    found = {path.name for path in files.sources(tmp_path / "a.obj")}
    assert {"a.obj", "my own.mtl", "skin.png"} <= found
    (tmp_path / "b.gltf").write_text('{"buffers": [{"uri":\n"in\\/the%20box.bin"}, {"uri": "data:;base64,AA"}]}')
    assert tmp_path / "in" / "the box.bin" in files.sources(tmp_path / "b.gltf")
    os.mkfifo(tmp_path / "c.obj")
    assert files.sources(tmp_path / "c.obj") == [tmp_path / "c.obj"]
    (tmp_path / "d.mtl").write_bytes(b"\n" * (1 << 20) + b" " * (1 << 20) + b"map_Kd " + b"a b " * (1 << 18))
    begun = time.process_time()
    files.sources(tmp_path / "d.mtl")
    assert time.process_time() - begun < 2.0


def test_streams_are_told_from_files(tmp_path: Path) -> None:
    """By what a name leads through; files, folders, what is not there yet and links in circles are none."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").touch()
    links = {
        "a": "/dev/stdout",
        "b": "a",
        "c": "/proc/self/fd",
        "d": "fifo",
        "e": "file",
        "f": "none",
        "g": "h",
        "h": "g",
    }
    for name, target in links.items():
        (tmp_path / name).symlink_to(target)
    for name in ("a", "b", "c/1", "c/x.csv", "d", "fifo", "/dev/stderr", "/dev/fd/2", "/dev/null", "/proc/self/fd/1"):
        assert files.is_stream(tmp_path / name), name
        with pytest.raises(TSDFError, match="a stream"):
            write(tmp_path / name)
    for name in ("file", "e", "f", "g", "none", "none/x", ".", ""):
        assert not files.is_stream(tmp_path / name), name


def test_only_regular_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path, tmp_path / "fifo", Path("/dev/full"), tmp_path / "none" / "a"):
        with pytest.raises(TSDFError, match="cannot write"):
            write(path)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "real")
    write(link)
    assert link.is_symlink() and (tmp_path / "real").read_text() == "new"
