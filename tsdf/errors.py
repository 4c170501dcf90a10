"""The errors of the toolkit. Each message is one line: what is wrong, where, and the way out."""

from dataclasses import dataclass


class TSDFError(Exception):
    """Base of every error this package raises on purpose. The command line exits with status 1."""


class UsageError(TSDFError):
    """The request cannot be meant: an option or argument out of range. Exit status 2."""


class GrainError(TSDFError):
    """The geometry of a grain cannot be read, or is not a closed, simple surface."""


class SceneError(TSDFError):
    """A scene cannot be read, or says something that cannot be meant."""


class FormatError(TSDFError):
    """A file does not follow schema/SPEC.md.

    Parameters
    ----------
    code : str
        The rule that is broken, one of the codes listed in SPEC.md.
    message : str
        What is wrong and the way out, one line.
    pointer : str
        The place: a JSON pointer into the header, or ``bytes N`` in the file.
    """

    def __init__(self, code: str, message: str, pointer: str = "") -> None:
        super().__init__(f"{code}: {message}" + (f" (at {pointer})" if pointer else ""))
        self.code = code
        self.pointer = pointer
        self.reason = message


class FormatWarning(UserWarning):
    """A file can be used, but says something this version of the package does not know."""


@dataclass(frozen=True)
class Finding:
    """One broken rule, as a report lists it."""

    code: str  # the rule, one of the codes listed in SPEC.md
    severity: str  # "error" or "warning"
    pointer: str  # the place: a JSON pointer into the header, "bytes N" of the file or "row N, column M"
    message: str  # what is wrong and the way out, one line
