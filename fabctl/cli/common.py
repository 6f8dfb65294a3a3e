"""What every command shares: the lab, `--json`, progress on stderr, and the one place errors become exit codes."""

from __future__ import annotations

import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable
from types import FrameType
from typing import Any, TypeVar

import click

from fabctl.errors import BUG, DEVICE, DONE, OPERATOR, REFUSED, USAGE, FabctlError
from fabctl.events import Emit, Event
from fabctl.workspace import Workspace, workspace

F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
yes_option = click.option("--yes", is_flag=True, help="Answer every question with yes (for scripts).")
bench_option = click.option("--bench", "bench_name", default="sim", show_default=True, help="Bench file or its name.")


def lab() -> Workspace:
    """Return the workspace of the running command."""
    return workspace(click.get_current_context().find_root().obj)


def say(text: str = "") -> None:
    """Tell the person something; standard error, so that standard output stays for results."""
    click.echo(text, err=True)


def show(data: dict[str, Any], as_json: bool, lines: Iterable[str]) -> None:
    """Print the result: one JSON object, or `lines` for a person."""
    if as_json:
        click.echo(json.dumps(data, indent=1, default=str, allow_nan=False))
    else:
        for line in lines:
            click.echo(line)


def confirm(question: str, yes: bool) -> bool:
    """Ask once; without a terminal and without `--yes` the answer is no."""
    if yes:
        return True
    if not sys.stdin.isatty():
        say(f"{question} no (not a terminal; --yes answers yes)")
        return False
    return click.confirm(question, default=False, err=True)


def progress() -> Emit:
    """Return a listener that shows a job's events on stderr: a live line on a terminal, plain lines elsewhere."""
    live = sys.stderr.isatty()
    tenth = [-1]

    def listen(event: Event) -> None:
        if event.kind == "progress" and event.done_frac is not None:
            text = f"{event.done_frac:6.1%}  {event.message}"
            if live:
                click.echo(f"\r\x1b[2K{text}", err=True, nl=False)
            elif int(event.done_frac * 10) != tenth[0]:
                click.echo(text, err=True)
            tenth[0] = int(event.done_frac * 10)
        elif event.kind in ("stage", "state", "warning", "finding"):
            lead = "\r\x1b[2K" if live else ""
            click.echo(f"{lead}{event.message}", err=True)

    return listen


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def run_to_the_end(command: click.Command) -> int:
    """Run `command` as the last thing this process does; return its exit code.

    A second Ctrl-C may come at any moment of the way out: it must not change the exit code.
    """
    try:
        try:
            return run_guarded(command)
        finally:
            _deafen()
    except KeyboardInterrupt:
        _deafen()
        return OPERATOR


def _deafen() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def run_guarded(command: click.Command) -> int:
    """Run `command` and return its exit code (`fabctl.errors` lists them)."""
    signal.signal(signal.SIGTERM, _terminate)
    try:
        code = command.main(standalone_mode=False)
        return int(code) if isinstance(code, int) else DONE
    except click.exceptions.Abort:
        say("stopped")
        return OPERATOR
    except KeyboardInterrupt:
        say("stopped")
        return OPERATOR
    except click.ClickException as fault:
        fault.show()
        return USAGE
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as fault:  # noqa: BLE001 - the outermost door: what is not known is a bug, and says so
        return _report(fault)


def _report(fault: Exception) -> int:
    # Imported here: on the good path `fabctl --help` must not pay for them.
    from design.errors import DesignError, UnreadableMesh
    from drivers.errors import DeviceError

    if isinstance(fault, FabctlError | DesignError | DeviceError):
        code = REFUSED
        if isinstance(fault, FabctlError):
            code = fault.exit_code
        elif isinstance(fault, DeviceError):
            code = DEVICE
        elif isinstance(fault, UnreadableMesh):
            code = USAGE
        say(f"fabctl: {fault}")
        return code
    if isinstance(fault, OSError):
        say(f"fabctl: {fault.filename or 'storage'}: {fault.strerror or fault}")
        return DEVICE if fault.errno == 28 else USAGE
    traceback.print_exception(fault, file=sys.stderr)
    say("fabctl: this is a bug in fabctl; please report it with the lines above")
    return BUG
