"""What is checked of a command line before anything else, which click itself lets through.

Numbers are finite, and an option that takes one value is given once: of two the last would count, unsaid.
"""

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


@dataclass(frozen=True)
class Once:
    """A command's way to read its words, which refuses an option that is given twice."""

    command: click.Command
    then: Callable[[click.Context, list[str]], list[str]]

    def __call__(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Return the words that are left; raise `click.UsageError` where an option stands there twice."""
        words = args[: args.index("--")] if "--" in args else list(args)
        for param in self.command.params:
            if isinstance(param, click.Option) and not param.multiple and not param.is_flag:
                given = [word for word in words if word.split("=", 1)[0] in param.opts]
                if len(given) > 1:
                    raise click.UsageError(
                        f"{given[0].split('=', 1)[0]} is given {len(given)} times; give it once", ctx
                    )
        return self.then(ctx, args)


def finite(command: click.Command) -> click.Command:
    """Return `command` and its subcommands with all that is checked here."""
    if not isinstance(command, click.Group) and not isinstance(command.parse_args, Once):
        command.parse_args = Once(command, command.parse_args)  # type: ignore[method-assign]
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
