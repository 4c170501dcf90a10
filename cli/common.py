"""What every command shares: one-line errors, exit statuses, and text from files made safe to show.

Results go to standard output, everything else to standard error. Exit status: 0 done, 1 the data or the machine
failed, 2 the request cannot be meant, 130 interrupted. Nothing slow is imported here.
"""

import contextlib
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import click

from tsdf.errors import TSDFError, UsageError


def plain(value: Any) -> str:
    """Return text from outside as one printable line."""
    text = os.fsdecode(value) if isinstance(value, bytes | os.PathLike) else str(value)
    return text if text.isprintable() else ascii(text)[1:-1]


class Tool(click.Command):
    """A click command whose errors are one line, ``NAME: error: ...``; the callback may return an exit status."""

    def main(
        self, args: Sequence[str] | None = None, prog_name: str | None = None, *rest: Any, **extra: Any
    ) -> NoReturn:
        """Run the command and exit."""
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, ValueError):
                stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = lambda message, *_: self._tell("warning", message)  # type: ignore[assignment]
            sys.exit(self._status(args, **extra))

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
            return self._tell("error", "interrupted", 130)
        except BrokenPipeError:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
            return 1
        except OSError as error:
            name = f"{plain(error.filename)}: " if error.filename else ""
            return self._tell("error", f"{name}{error.strerror or error}", 1)
        except MemoryError:
            return self._tell("error", "not enough memory", 1)
        except Exception as error:
            if os.environ.get("TSDF_DEBUG"):
                raise
            hint = "this is a bug, please report it with the traceback that TSDF_DEBUG=1 shows"
            return self._tell("error", f"{type(error).__name__}: {error}; {hint}", 1)

    def _tell(self, kind: str, message: Any, status: int = 0) -> int:
        with contextlib.suppress(OSError):
            click.echo(f"{self.name}: {kind}: {plain(message)}", err=True)
        return status


def make_folder(out: Path) -> None:
    """Make the folder that --out names, if it is not there.

    Raises
    ------
    TSDFError
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TSDFError(f"--out {plain(out)}: cannot be made: {error.strerror}; give a folder") from None


@contextlib.contextmanager
def watched(quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Show a progress bar, to be told the share done and a word, and let SIGTERM interrupt as Ctrl-C does."""
    from tqdm import tqdm

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # signals come twice, and the second is no other
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    form = "{percentage:3.0f}% |{bar}| {postfix} [{elapsed}]"
    try:
        with tqdm(total=1.0, disable=quiet or None, bar_format=form, dynamic_ncols=True) as bar:

            def progress(share: float, word: str) -> None:
                bar.set_postfix_str(word, refresh=False)
                bar.update(share - bar.n)

            yield progress
    finally:
        signal.signal(signal.SIGTERM, before)
