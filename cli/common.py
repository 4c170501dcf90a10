"""What the commands share: errors become one line on standard error and an exit status."""

import functools
import sys
import warnings
from collections.abc import Callable
from typing import Any

import click

from tsdf.errors import TSDFError, UsageError


def reports_errors(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` so that what is wrong is told in one line: exit status 1, or 2 for a wrong request."""

    @functools.wraps(function)
    def reporting(*args: Any, **kwargs: Any) -> Any:
        name = (click.get_current_context().info_name or "tsdf").removesuffix(".py")

        def show(message: Warning | str, *_: Any, **__: Any) -> None:
            click.echo(f"{name}: warning: {message}", err=True)

        with warnings.catch_warnings():
            warnings.showwarning = show
            try:
                return function(*args, **kwargs)
            except TSDFError as error:
                click.echo(f"{name}: error: {error}", err=True)
                sys.exit(2 if isinstance(error, UsageError) else 1)
            except OSError as error:
                click.echo(f"{name}: error: {error.filename or ''}: {error.strerror or error}", err=True)
                sys.exit(1)
            except KeyboardInterrupt:
                click.echo(f"{name}: interrupted", err=True)
                sys.exit(130)

    return reporting
