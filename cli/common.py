"""What every command shares: errors of one line, exit statuses, outputs that destroy nothing, progress, and options
that mean the same everywhere.

Results go to standard output, everything else to standard error. Exit status: 0 done, 1 the data or the machine
failed, 2 the request cannot be meant, 130 interrupted, 143 by SIGTERM. Nothing slow is imported here.
"""

import contextlib
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

import click

from tsdf.cli import start
from tsdf.cli.start import answer, interrupt_status, interruptible
from tsdf.errors import TSDFError, UsageError
from tsdf.scene import levels

LEVELS = tuple(levels.LEVELS)
AUTO = levels.AUTO
F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")
MOST_THREADS = 1024
EVERY_S = 60.0  # [s] between lines of progress where no terminal shows a bar
LEAST_S = 0.1  # [s] between two looks of a bar
TICK_S = 0.5  # [s] the clock of a bar goes on even if nothing is heard
COMPILING = "compiling, once for this machine"


def say(text: str) -> None:
    """Write a line about a result that is in a file to standard output, unless that was closed on purpose."""
    if not start.silent:
        click.echo(text)


def plain(value: Any) -> str:
    """Return text from outside as one printable line."""
    text = os.fsdecode(value) if isinstance(value, bytes | os.PathLike) else str(value)
    return text if text.isprintable() else ascii(text)[1:-1]


def _say_version(context: click.Context, _: click.Parameter, value: bool) -> None:
    if value and not context.resilient_parsing:
        import tsdf

        click.echo(f"{context.command.name} {tsdf.__version__}")
        context.exit()


class Tool(click.Command):
    """A click command whose errors are one line, ``NAME: error: ...``; the callback may return an exit status.

    Each has --version.
    """

    def __init__(self, *words: Any, **given: Any) -> None:
        super().__init__(*words, **given)
        self.params.append(
            click.Option(
                ["--version"], is_flag=True, is_eager=True, expose_value=False, callback=_say_version,
                help="Show the version and exit.",
            )
        )  # fmt: skip

    def main(
        self, args: Sequence[str] | None = None, prog_name: str | None = None, *rest: Any, **extra: Any
    ) -> NoReturn:
        """Run the command and exit."""
        if args is None:  # a process of its own
            answer(str(self.name))
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, ValueError):
                stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = lambda message, *_: self._tell("warning", message)  # type: ignore[assignment]
            status = self._status(args, **extra)
        try:
            sys.stdout.flush()
        except (OSError, ValueError):  # told already; or else Python would tell of it once more at exit
            with contextlib.suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(status)

    def _status(self, args: Sequence[str] | None, **extra: Any) -> int:
        try:
            extra["standalone_mode"] = False
            status = super().main(args, self.name, **extra)
            sys.stdout.flush()  # a closed pipe shows here and not at exit
            return status if isinstance(status, int) else 0
        except click.UsageError as error:
            return self._tell("error", f"{error.format_message()} (see {self.name} --help)", 2)
        except UsageError as error:
            return self._tell("error", error, 2)
        except click.ClickException as error:
            return self._tell("error", error.format_message(), 1)
        except TSDFError as error:
            return self._tell("error", error, 1)
        except (KeyboardInterrupt, click.Abort):
            return self._tell("error", "interrupted", interrupt_status())
        except BrokenPipeError:
            return 1
        except OSError as error:
            name = f"{plain(error.filename)}: " if error.filename else "cannot read or write: "
            return self._tell("error", f"{name}{error.strerror or error}", 1)
        except MemoryError:
            return self._tell("error", "not enough memory", 1)
        except Exception as error:
            if os.environ.get("TSDF_DEBUG"):
                raise
            if "start new thread" in str(error):  # there is no room for its stack
                return self._tell("error", "not enough memory", 1)
            hint = "this is a bug, please report it with the traceback that TSDF_DEBUG=1 shows"
            return self._tell("error", f"{type(error).__name__}: {error}; {hint}", 1)

    def _tell(self, kind: str, message: Any, status: int = 0) -> int:
        with contextlib.suppress(OSError):
            click.echo(f"{self.name}: {kind}: {plain(message)}", err=True)
        return status


def beside(work: Callable[[], T]) -> Callable[[], T]:
    """Begin some work in a thread beside what goes on here; return what waits for it, and returns or raises what it
    did."""
    done: list[T | BaseException] = []

    def run() -> None:
        try:
            done.append(work())
        except BaseException as error:
            done.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()

    def result() -> T:
        thread.join()
        if isinstance(done[0], BaseException):
            raise done[0]
        return done[0]

    return result


# --- outputs ------------------------------------------------------------------------


class Output(NamedTuple):
    """A file that a command is to write."""

    option: str  # that says where
    path: Path
    printed: str = ""  # what to say to have it on standard output instead, where that can be


def check_output(
    out: Path, *inputs: Path, beside: Iterable[Path] = (), part: bool = False, option: str = "--out", printed: str = ""
) -> None:
    """Refuse an output that cannot be written, or would replace an input, before any work is done for it.

    Parameters
    ----------
    out : path
    inputs : paths
        All that is read. However they are spelled and linked, they are left alone.
    beside : paths
        What is written beside `out`.
    part : bool
        Whether `out` is a part file; no other output replaces one, which holds the paths of an unfinished build.
    option, printed : str
        As of an `Output`.

    Raises
    ------
    TSDFError
    """
    check_outputs([Output(option, out, printed), *(Output(option, path) for path in beside)], *inputs, part=part)


def check_outputs(outputs: Sequence[Output], *inputs: Path, part: bool = False) -> None:
    """Refuse outputs as `check_output` does, the first of which may be a part file.

    Raises
    ------
    TSDFError
    """
    from tsdf import archive, files

    read = [source for path in inputs for source in files.sources(Path(path))]
    written: list[Path] = []
    for number, (option, path, printed) in enumerate(outputs):
        shown = plain(path)
        if shown != os.fspath(path):
            raise UsageError(f"cannot write {shown}: its name cannot be shown on one line; choose another {option}")
        if files.is_stream(path):
            ways = f"choose another {option}" + (f", or {printed}" if printed else "")
            raise TSDFError(
                f"cannot write {shown}: it is no regular file but a stream (screen, pipe or device); {ways}"
            )
        if any(_same(path, other) for other in read):
            raise UsageError(f"cannot write {shown}: it is an input; choose another {option}")
        if any(_same(path, other) for other in written):
            raise UsageError(f"cannot write {shown}: another output is the same file; choose another {option}")
        if number == 0 and not part and archive.is_part(path):
            raise TSDFError(
                f"cannot write {shown}: it holds paths of an unfinished build, which tsdf-merge takes, or --resume "
                f"with the --out of that build; choose another {option}, or delete it"
            )
        written.append(path)
        folder = Path(os.path.realpath(path)).parent
        if not folder.is_dir():
            raise TSDFError(
                f"cannot write {shown}: {plain(folder)} is not a folder; make it, or choose another {option}"
            )
        try:
            files.probe(path)
        except OSError as error:
            raise TSDFError(f"cannot write {shown}: {error.strerror or error}; choose another {option}") from None


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text, whole or not at all."""
    from tsdf.files import replacing

    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _same(one: Path, other: Path) -> bool:
    """Return whether two paths lead to one file, which need not be there yet."""
    try:
        return os.path.samefile(one, other)
    except (OSError, ValueError):
        return os.path.realpath(one) == os.path.realpath(other)


def check_folder(out: Path, names: Iterable[str], *inputs: Path) -> None:
    """Make the folder that --out names, if it is not there, and see to it that files of these names can be written.

    Raises
    ------
    TSDFError
    """
    if not plain(out) == os.fspath(out):
        raise UsageError(f"cannot write {plain(out)}: its name cannot be shown on one line; choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TSDFError(f"--out {plain(out)}: cannot be made: {error.strerror}; give a folder") from None
    first, *others = (out / name for name in names)
    check_output(first, *inputs, beside=others)


# --- progress -----------------------------------------------------------------------


class Progress:
    """How far a command is, on standard error: a bar on a terminal, whose clock always goes; else a line a minute."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._share, self._word = 0.0, "starting"
        self._begun = self._shown = time.monotonic()
        self._bar = None
        if not quiet and sys.stderr.isatty():
            from tqdm import tqdm

            form = "{percentage:3.0f}% |{bar}| {desc} [{elapsed}<{remaining}]"
            self._bar = tqdm(total=1.0, bar_format=form, ncols=80, nrows=24)

    def __call__(self, share: float, word: str) -> None:
        """Take note of the share done, in [0, 1], and of a word about it."""
        self._share, self._word = share, word
        if time.monotonic() - self._shown >= LEAST_S:
            self.show()

    def show(self) -> None:
        """Show it, if it is time to; a reader who is gone costs no result."""
        if not self._quiet:
            with contextlib.suppress(OSError, ValueError):
                self._show()

    def _show(self) -> None:
        compiled = sys.modules.get("tsdf.compiled")
        word = COMPILING if getattr(compiled, "compiling", bool)() else self._word
        now = time.monotonic()
        if self._bar is not None:
            self._shown, self._bar.n = now, min(self._share, 1.0)
            with contextlib.suppress(OSError):
                self._bar.ncols = os.get_terminal_size(2).columns or 80  # some terminals say that they have none
            self._bar.set_description_str(word)
        elif now - self._shown >= EVERY_S:
            self._shown = now
            minutes, seconds = divmod(int(now - self._begun), 60)
            click.echo(f"{100.0 * self._share:.0f} %, {word} [{minutes}:{seconds:02d}]", err=True)

    def note(self, text: str) -> None:
        """Write a line above the bar."""
        if self._quiet:
            return
        with contextlib.suppress(OSError, ValueError):
            if self._bar is not None:
                self._bar.clear()
            click.echo(f"note: {plain(text)}", err=True)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self.show()
            self._bar.close()


@contextlib.contextmanager
def shown_progress(quiet: bool) -> Iterator[Progress]:
    """Show progress while this runs, with a clock that goes on whatever else is busy."""
    progress, done = Progress(quiet), threading.Event()

    def tick() -> None:
        while not done.wait(TICK_S):
            progress.show()

    ticking = threading.Thread(target=tick, daemon=True)
    ticking.start()
    try:
        yield progress
    finally:
        done.set()
        ticking.join()
        progress.close()


class Work:
    """What a command is at: its progress, whether there is something to keep, and the word to stop.

    Attributes
    ----------
    progress : Progress
    begun : bool
        Whether an interrupt leaves something to write: then it sets `stop`, else it ends the process.
    stop : Event
    """

    def __init__(self, progress: Progress) -> None:
        self.progress, self.begun, self.stop = progress, False, threading.Event()

    def told(self, share: float, word: str) -> None:
        """Show progress; from the first share above 0 on there is something to keep."""
        self.begun = self.begun or share > 0.0
        self.progress(share, word)

    def meaning(self) -> str | None:
        """Say what an interrupt means, see `start.interruptible`."""
        if not self.begun:
            return "nothing is written"
        self.stop.set()
        return None


@contextlib.contextmanager
def working(quiet: bool) -> Iterator[Work]:
    """Show progress and answer interrupts while this runs, by what has been begun."""
    with shown_progress(quiet) as progress:
        work = Work(progress)
        with interruptible(work.meaning):
            yield work


# --- options ------------------------------------------------------------------------


def whole_number(context: click.Context, parameter: click.Parameter, value: str | None) -> int | None:
    """Read a whole number, also written as 1e7."""
    if value is None:
        return None
    try:
        number = float(value)
        if number == int(number):
            return int(value) if value.lstrip("+-").isdigit() else int(number)
    except (ValueError, OverflowError):
        pass
    raise click.BadParameter(f"{value!r} is not a whole number", context, parameter)


threads_option = click.option("--threads", callback=whole_number, metavar="N", help="[default: all processors]")


def seed_option(default: str) -> Callable[[F], F]:
    """Return the option --seed, of the random numbers; its default is a number, or in words where it is found later."""
    number = default if default.isdecimal() else None
    said = "" if number else f"  [default: {default}]"
    return click.option(
        "--seed", callback=whole_number, metavar="N", default=number, show_default=bool(number),
        help=f"Of the random numbers, >= 0.{said}",
    )  # fmt: skip


def setting(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """Read settings NAME=VALUE, each name once."""
    settings: dict[str, str] = {}
    for value in values:
        name, equals, number = value.partition("=")
        if not equals or not name or name in settings:
            raise click.BadParameter(f"{value!r} is not NAME=VALUE, each name once", context, parameter)
        settings[name] = number
    return settings


def check_numbers(seed: int | None = None, threads: int | None = None, **counts: int | None) -> None:
    """Refuse whole numbers that are out of range; None is not given.

    Raises
    ------
    UsageError
    """
    if seed is not None and not 0 <= seed < 2**63:
        raise UsageError(f"--seed is a whole number from 0 to 2^63 - 1, not {seed}")
    if threads is not None and not 1 <= threads <= MOST_THREADS:
        raise UsageError(f"--threads is a whole number from 1 to {MOST_THREADS}, not {threads}")
    for name, value in counts.items():
        if value is not None and value < 1:
            raise UsageError(f"--{name} is a whole number of at least 1, not {value}")


def named_levels(text: str | None, default: Sequence[str], option: str = "--levels") -> list[str]:
    """Return the levels A,B,.. of an option.

    Raises
    ------
    UsageError
        With the level that was likely meant.
    """
    from difflib import get_close_matches

    chosen = [name.strip() for name in text.split(",")] if text is not None else list(default)
    for name in chosen:
        if name not in LEVELS:
            near = get_close_matches(name, LEVELS, 1)
            hint = f"did you mean {near[0]}?" if near else f"levels are {', '.join(LEVELS)}"
            raise UsageError(f"{option}: no level {name!r}; {hint}")
    return chosen
