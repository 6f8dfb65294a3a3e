"""What is checked of a command line before anything else: numbers are finite (click's ranges let `nan` through)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

PICTURES = (".svg", ".png", ".pdf")

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


class PictureFile(click.Path):
    """A picture to be written: `.svg`, `.png` or `.pdf`, asked for before anything is computed."""

    def __init__(self) -> None:
        super().__init__(path_type=Path, dir_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail where its ending names no kind of picture."""
        path = Path(str(super().convert(value, param, ctx)))
        if path.suffix.lower() not in PICTURES:
            self.fail(f"{value}: a picture ends in {', '.join(PICTURES)}", param, ctx)
        return path
