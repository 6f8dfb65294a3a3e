"""What is checked of a command line before anything else: numbers are finite (click's ranges let `nan` through)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import click

Callback = Callable[[click.Context, click.Parameter, Any], Any]


@dataclass(frozen=True)
class FiniteOnly:
    """A parameter's callback that refuses what is not finite before its own callback sees it."""

    then: Callback | None

    def __call__(self, ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        """Return the value; raise `click.BadParameter` where a number in it is nan or infinite."""
        for number in floats(value):
            if not math.isfinite(number):
                raise click.BadParameter(f"{number} is no measure; give a finite number", ctx, param)
        return value if self.then is None else self.then(ctx, param, value)


def floats(value: Any) -> list[float]:
    """Return every float in `value`, however deep in tuples."""
    if isinstance(value, tuple | list):
        return [number for part in value for number in floats(part)]
    return [value] if isinstance(value, float) else []


def finite(command: click.Command) -> click.Command:
    """Return `command` with all its parameters, and those of its subcommands, held to finite numbers."""
    for param in command.params:
        if not isinstance(param.callback, FiniteOnly):
            param.callback = FiniteOnly(param.callback)
    for inner in command.commands.values() if isinstance(command, click.Group) else ():
        finite(inner)
    return command


def numbers(text: str, option: str) -> list[float]:
    """Return the numbers of `option`, parted by commas; raise `click.UsageError` where one is none."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        raise click.UsageError(f"{option} takes finite numbers with commas between them, not {text!r}")
    return found
