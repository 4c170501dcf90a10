"""``tsdf-validate``: whether tables are right."""

import json
from pathlib import Path

import click

from tsdf.cli.common import Tool, check_output, plain
from tsdf.errors import UsageError


@click.command("tsdf-validate", cls=Tool)
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@click.option("--json", "as_json", is_flag=True, help="Write one JSON array, a report per file.")
@click.option("--structure", is_flag=True, help="Check only that the files follow the format, not what the tables say.")
@click.option(
    "--plot",
    metavar="PNG|PDF",
    help="Draw the table of the one FILE: a sphere beside the exact answer, at eta 1.333 as Fig. 8 of Zhou et "
    "al. 2003; other grains beside their fits.  [default: no picture]",
)
def main(files: tuple[str, ...], as_json: bool, structure: bool, plot: str | None) -> int:
    """Check that each FILE follows the format, that its header and pixels agree, and that its physics is right.

    \b
    One line per finding (its code is explained in SPEC.md) and one with the verdict.
    Exit status 0 if no file has an error, 1 if any has, 2 if the request makes no sense.
    """
    if plot is not None:
        from tsdf.study import plots

        plots.check_suffix(plot)
        if len(files) != 1 or structure:
            raise UsageError("--plot draws one FILE, checked in full")
        check_output(Path(plot), Path(files[0]), option="--plot")
    from tsdf.judge.validate import validate

    reports, failed = [], False
    for file in files:
        report = validate(file, structure_only=structure)
        failed |= not report.ok
        shown = [
            {"code": f.code, "severity": f.severity, "pointer": f.pointer, "message": f.message}
            for f in report.findings
        ]
        if as_json:
            entry = {"file": plain(file), "valid": report.ok, "parts": report.parts, "checks": report.checks}
            reports.append({**entry, "findings": shown})
        else:
            for one in shown:
                place = f" at {one['pointer']}" if one["pointer"] else ""
                text = f"{file}: {one['severity']} {one['code']}{place}: {one['message']}"
                click.echo(plain(text))
            errors = sum(f.severity == "error" for f in report.findings)
            warned = len(report.findings) - errors
            counts = [f"{n} {word}{'s' * (n != 1)}" for n, word in ((errors, "error"), (warned, "warning")) if n]
            if report.ok:
                run = "structure only" if structure else f"structure and {report.checks} checks"
                counts.insert(0, run)
            click.echo(plain(f"{file}: {'valid' if report.ok else 'not valid'} ({', '.join(counts)})"))
        if plot is not None:
            if report.table is None:
                click.echo(f"tsdf-validate: warning: no picture, {plain(file)} holds no table", err=True)
            else:
                plots.save(plots.plot_validation(report.table), plot)
    if as_json:
        click.echo(json.dumps(reports, indent=1))
    return int(failed)
