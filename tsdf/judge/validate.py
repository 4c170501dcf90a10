"""Validation: is a table right? Its structure, its statistics against its pixels, and both against physics.

`validate` runs three parts: the structure (`format.check`), what the header says about the pixels and about
itself (codes ``STATISTICS_``), and what is known of the grain without tracing it (``PHYSICS_``): the exact sphere,
the published curves of Zhou, Li & Stamnes 2003, and theorems. An error is more than the table's own stated error
and its cells allow; limits are `SIGMAS` standard errors, so that an honest table passes. Where a table is too
noisy or too coarse to show a fault, nothing is said.
"""

import os
import warnings
from dataclasses import dataclass

from tsdf.data import format as tsdf_format
from tsdf.data.table import Table
from tsdf.errors import Finding, FormatWarning
from tsdf.judge.consistency import judge_memory, judge_records, judge_statistics
from tsdf.judge.court import Gavel, Subject
from tsdf.judge.physics import judge_sphere, judge_theorems


@dataclass(frozen=True)
class Report:
    """What `validate` found.

    Parameters
    ----------
    path : str
        The file, as it was named.
    findings : tuple of Finding
        What is broken, worst part first; empty for a sound table.
    parts : tuple of str
        The parts that ran: "structure", "statistics", "physics".
    checks : int
        Comparisons of numbers made in the last two.
    table : Table or None
        None if the structure is broken.
    """

    path: str
    findings: tuple[Finding, ...]
    parts: tuple[str, ...]
    checks: int
    table: Table | None

    @property
    def ok(self) -> bool:
        """Whether no error was found; warnings do not count."""
        return all(finding.severity != "error" for finding in self.findings)


def validate(path: str | os.PathLike[str], structure_only: bool = False) -> Report:
    """Return what is wrong with a file; nothing is raised for a file that cannot be read.

    Examples
    --------
    >>> import tsdf
    >>> report = validate("cube.tsdf.exr")
    >>> report.ok, report.findings
    (True, ())
    """
    name = os.fspath(path)
    findings = tuple(tsdf_format.check(path))
    if any(finding.severity == "error" for finding in findings):
        return Report(name, findings, ("structure",), 0, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # it is among the findings
        table = tsdf_format.read(path)
    if structure_only:
        return Report(name, findings, ("structure",), 0, table)
    more, checks = judge(table)
    return Report(name, findings + more, ("structure", "statistics", "physics"), checks, table)


def judge(table: Table) -> tuple[tuple[Finding, ...], int]:
    """Return what statistics and physics have against a table, and how many comparisons were made."""
    gavel = Gavel()
    subject = Subject.of(table)
    judge_statistics(gavel, subject)
    judge_records(gavel, subject)
    judge_memory(gavel, subject)
    if subject.kind == "sphere":
        judge_sphere(gavel, subject)
    judge_theorems(gavel, subject)
    return tuple(gavel.findings), gavel.checks
