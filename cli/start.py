"""The first thing every command does: see to its streams and its memory, and answer Ctrl-C and SIGTERM.

Python's own handlers run between two instructions of the main thread, and compiling a kernel is one instruction of a
minute. So a thread of its own is told of signals: it ends the process at once, with one line and status 130 or 143, as
long as there is nothing to keep; else it says so to the command, which then ends by itself. Nothing is imported here
that takes time, for until `answer` has run a signal finds Python as it is.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import IO, Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN_S = 2.0  # [s] `timeout` sends each signal twice; one that comes later than this is meant
SOON_S = 0.01  # [s] until an interrupt that nobody could catch is raised again
SAVING_S = 1.0  # [s] for a file that is being written
TURN_S = 0.0005  # [s] that a thread of Python goes on while others wait
# Address space that libraries take whatever is computed, from trials: half of it for commands that only read tables.
LEAST_BYTES = 1280 << 20
BYTES_PER_PROCESSOR = 160 << 20  # for the stack and the heap of each thread
MOST_PROCESSORS = 64  # that numerical libraries start threads for
HEAVY = (
    "tsdf-accuracy",
    "tsdf-albedo",
    "tsdf-build",
    "tsdf-frontier",
    "tsdf-optics",
    "tsdf-packing",
    "tsdf-plan",
    "tsdf-preview",
    "tsdf-render",
    "tsdf-stress",
)

silent = False  # standard output was closed when the process began
_name = ""  # of the command; none before `answer`
_error = 2  # standard error as it was then, whatever becomes of its number
_first: int | None = None  # the signal that came first
_since = 0.0  # [s] and when
_meaning: Callable[[], str | None] = str  # see `interruptible`
_raises = False


def answer(name: str) -> None:
    """Answer SIGINT and SIGTERM from here on, in the name of a command."""
    global _name, _error
    if _name or threading.current_thread() is not threading.main_thread():
        return
    _name = name
    # Its threads wait for small products by spinning: on 16 cores that took three quarters of a small build's processor
    # time. The work here is shared out among threads of our own.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # One thread imports while another prepares a grain in short steps of numpy, each of which would wait the usual 5 ms
    # for its turn: a sixth of the time of a small build.
    sys.setswitchinterval(TURN_S)
    _open_streams()
    _error = os.dup(2)
    _check_memory()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    threading.Thread(target=_listen, args=(reading,), daemon=True).start()
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    for number in SIGNALS:
        signal.signal(number, _handle)
    sys.unraisablehook = _not_raised


@contextlib.contextmanager
def interruptible(meaning: Callable[[], str | None], raises: bool = False) -> Iterator[None]:
    """Say what an interrupt means while this runs.

    Parameters
    ----------
    meaning : callable
        Called in another thread when a signal comes. It returns what to say as the process ends at once ("" for no
        more than that it does), or None if there is something to keep: then the command is to end by itself.
    raises : bool
        Whether KeyboardInterrupt is then raised in the main thread, too.
    """
    global _meaning, _raises
    before = _meaning, _raises
    _meaning, _raises = meaning, raises
    try:
        yield
    finally:
        _meaning, _raises = before


def interrupted() -> bool:
    """Return whether a signal has come."""
    return _first is not None


def interrupt_status() -> int:
    """Return the exit status of an interrupted command: 128 and the number of the signal."""
    return 128 + (_first or signal.SIGINT)


def _handle(number: int, _: object) -> None:
    """Run in the main thread, before or after the other thread has been told."""
    global _raises, _first, _since
    if _raises and _meaning() is None:
        _raises = False
        if _first is None:
            _first, _since = number, time.monotonic()
        raise KeyboardInterrupt


def _not_raised(lost: Any) -> None:
    """Raise again, a little later, what was raised where Python only prints it: in a callback of the compiler, say."""
    global _raises, _since
    if _first is None or not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    _raises, _since = True, time.monotonic()
    threading.Timer(SOON_S, signal.pthread_kill, (threading.main_thread().ident, _first)).start()


def _listen(reading: int) -> None:
    global _first, _since
    while data := os.read(reading, 1):
        number = data[0]
        if number not in SIGNALS:
            continue
        if _first is None:
            _first, _since = number, time.monotonic()
            try:
                said = _meaning()
            except Exception:  # it was asked in the middle of something
                said = ""
            if said is not None:
                _end(number, said)
        elif time.monotonic() - _since > AGAIN_S:
            _end(number, "at once: what was not written yet is lost")


def _end(number: int, said: str) -> None:
    """End the process, leaving nothing half-written."""
    files = sys.modules.get("tsdf.files")
    if hasattr(files, "discard"):
        files.whole.acquire(timeout=SAVING_S)  # type: ignore[union-attr]
        files.discard()  # type: ignore[union-attr]
    with contextlib.suppress(OSError):
        import select

        text = f"{_name}: error: interrupted{': ' * bool(said)}{said}\n"
        line = ("\n" * os.isatty(2) + text).encode(errors="backslashreplace")  # after ^C and a bar
        if select.select([], [_error], [], SAVING_S)[1]:
            os.write(_error, line)
    os._exit(128 + number)


def _open_streams() -> None:
    """Give a process that was started with closed standard streams some, lest its files take their numbers.

    What is written to a closed standard output fails, as elsewhere; what is written to a closed standard error is gone.
    """
    global silent
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)

    def stream(number: int) -> IO[str]:
        return open(number, "w", errors="backslashreplace", closefd=False)

    silent = sys.stdout is None
    sys.stdout = sys.stdout or stream(1)
    sys.stderr = sys.stderr or stream(2)


def _check_memory() -> None:
    """End here where the libraries would find too little memory: some of them then hang or crash.

    Only a limit of the address space (ulimit -v) is known beforehand.
    """
    with contextlib.suppress(ImportError):  # a system without such limits
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        least = LEAST_BYTES + BYTES_PER_PROCESSOR * min(os.cpu_count() or 1, MOST_PROCESSORS)
        least = least if _name in HEAVY else least // 2
        if limit != resource.RLIM_INFINITY and limit < least:
            said = f"not enough memory: ulimit -v is {limit >> 20} MiB, at least {least >> 20} are needed here"
            with contextlib.suppress(OSError):
                os.write(2, f"{_name}: error: {said}\n".encode())
            os._exit(1)


def _command(name: str) -> Callable[[], None]:
    """Return the entry point of a command, which ends the process."""

    def run() -> None:
        answer(f"tsdf-{name}")
        try:
            import_module(f"tsdf.cli.{name}").main()
        except SystemExit as end:  # all is written: Python would give the handlers up before it ends
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.flush()
            os._exit(end.code if isinstance(end.code, int) else 1)

    return run


(
    accuracy, albedo, build, export, frontier, grains, info, merge, optics, packing, plan, plot, preview, render,
    stress, validate,
) = map(
    _command,
    ("accuracy", "albedo", "build", "export", "frontier", "grains", "info", "merge", "optics", "packing", "plan",
     "plot", "preview", "render", "stress", "validate"),
)  # fmt: skip
