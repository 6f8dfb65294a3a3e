"""What every command shares: the lab, `--json`, progress on stderr, and the one place errors become exit codes."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from types import FrameType
from typing import Any, TextIO, TypeVar

import click

from fabctl.cli.paths import config_names
from fabctl.cli.refusal import answer_no, exit_code_of, no_in_words, plain, refusal, sentence_of
from fabctl.errors import BUG, DONE, OPERATOR, Stopped
from fabctl.events import Emit, Event
from fabctl.records.ending import INTERRUPTS, signals_heard
from fabctl.tether import end_with_parent
from fabctl.workspace import Workspace, workspace

TOGETHER_S = 0.5  # signals nearer than that are one
ERASE_TO_END = "\x1b[K"  # of the terminal's line, from the cursor
F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
yes_option = click.option("--yes", is_flag=True, help="Answer every question with yes (for scripts).")
bench_option = click.option(
    "--bench",
    "bench_name",
    type=config_names("benches"),
    default="sim",
    show_default=True,
    help="Bench file or its name.",
)
seed_option = click.option(
    "--seed",
    type=click.IntRange(0, 2**32 - 1),
    default=0,
    show_default=True,
    help="The same seed gives the same scan and the same answer.",
)
PLACE_MM = click.FloatRange(-10_000, 10_000)  # of anything on a bench
MATERIAL = config_names("materials")


def lab() -> Workspace:
    """Return the workspace of the running command."""
    return workspace(click.get_current_context().find_root().obj)


def say(text: str = "") -> None:
    """Tell the person something; standard error, so that standard output stays for results."""
    _clear_line()
    tell(text)


def tell(text: str, nl: bool = True) -> None:
    """Write to standard error; where nobody reads it any more, this and all that follows is lost, and no job ends."""
    try:
        click.echo(text, err=True, nl=nl)
    except OSError:
        _mute(sys.stderr)


def _mute(stream: TextIO) -> None:
    """Let what is written to `stream` go nowhere from now on."""
    with contextlib.suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _clear_line() -> None:
    """Take away what a live line of progress has left: its cursor waits at the line's beginning."""
    if sys.stderr.isatty():
        tell(ERASE_TO_END, nl=False)


def say_keys(text: str) -> None:
    """Name the keys that act while a job runs, where there is a keyboard."""
    if sys.stdin.isatty():
        say(text)


def show(data: dict[str, Any], as_json: bool, lines: Iterable[str], code: int = DONE, why: str = "") -> None:
    """Print the result: one JSON object, or `lines` for a person.

    A result that is a no ends the command with `code`, and the object says so: `error` is `why`, `exit_code` the code.
    """
    if as_json:
        _print(_json(data if code == DONE else answer_no(data, code, why)))
        for line in no_in_words(data, why) if code != DONE else ():
            say(line)
    else:
        _clear_line()
        for line in lines:
            _print(line)
    if code != DONE:
        click.get_current_context().exit(code)


def _print(text: str) -> None:
    """Print a result; a reader that has gone away (`| head`) changes neither what was done nor the exit code."""
    try:
        click.echo(text)
    except BrokenPipeError:
        _mute(sys.stdout)


def _json(data: dict[str, Any]) -> str:
    return json.dumps(plain(data), indent=1, default=_bare, allow_nan=False)


def _bare(value: Any) -> Any:
    """Return a NumPy scalar as Python's own number, and anything else as text."""
    return value.item() if hasattr(value, "item") else str(value)


def confirm(question: str, yes: bool) -> bool:
    """Ask once; without a terminal and without `--yes` the answer is no."""
    if yes:
        return True
    if not sys.stdin.isatty():
        say(f"{question} no (not a terminal; --yes answers yes)")
        return False
    _clear_line()
    try:
        return click.confirm(question, default=False, err=True)
    except click.exceptions.Abort:  # Ctrl-C or Ctrl-D at the question is an answer
        raise Stopped("stopped at the question; nothing was begun") from None


def progress() -> Emit:
    """Return a listener that shows a job's events on stderr: a live line on a terminal, plain lines elsewhere."""
    live = sys.stderr.isatty()
    tenth = [-1]

    def listen(event: Event) -> None:
        if event.kind == "progress" and event.done_frac is not None:
            text = f"{event.done_frac:6.1%}  {event.message}"
            if live:
                tell(f"{ERASE_TO_END}{text}\r", nl=False)
            elif int(event.done_frac * 10) != tenth[0]:
                tell(text)
            tenth[0] = int(event.done_frac * 10)
        elif event.kind == "progress" and live:  # how far is not known, only that it goes on
            tell(f"{ERASE_TO_END}        {event.message}\r", nl=False)
        elif event.kind in ("stage", "state", "warning", "finding"):
            say(event.message)

    return listen


def _interrupted_once() -> Callable[[int, FrameType | None], None]:
    """Return a handler that raises `KeyboardInterrupt`, once for signals that come together.

    A process group's SIGTERM reaches a flow's step twice, from its sender and from the flow, and a hand presses Ctrl-C
    twice: the second must not break off the record of how the first ended.
    """
    heard_s = -math.inf

    def hear(_signal: int, _frame: FrameType | None) -> None:
        nonlocal heard_s
        now_s = time.monotonic()
        together, heard_s = now_s - heard_s < TOGETHER_S, now_s
        if not together:
            raise KeyboardInterrupt

    return hear


def run_to_the_end(command: click.Command) -> int:
    """Run `command` as the last thing this process does; return its exit code.

    A second Ctrl-C may come at any moment of the way out: it must not change the exit code.
    """
    hear = _interrupted_once()
    for number in signals_heard():
        signal.signal(number, hear)
    end_with_parent()
    try:
        try:
            return run_guarded(command)
        finally:
            _deafen()
    except KeyboardInterrupt:
        _deafen()
        return OPERATOR


def _deafen() -> None:
    for number in INTERRUPTS:
        signal.signal(number, signal.SIG_IGN)


def run_guarded(command: click.Command) -> int:
    """Run `command` and return its exit code (`fabctl.errors` lists them)."""
    try:
        code = command.main(prog_name="fabctl", standalone_mode=False)
        return int(code) if isinstance(code, int) else DONE
    except BrokenPipeError:
        _mute(sys.stdout)
        return DONE
    except (Exception, KeyboardInterrupt) as fault:  # noqa: BLE001 - the outermost door: what is not known is a bug
        return _report(fault)


def _report(fault: BaseException) -> int:
    """Tell a person on stderr and, where `--json` was asked for, a program on stdout; return the exit code."""
    code = exit_code_of(fault)
    if json_asked(sys.argv[1:]):
        try:
            click.echo(_json(refusal(fault)))
        except OSError:  # nobody listens any more, or the disk behind stdout is full
            _mute(sys.stdout)
    if isinstance(fault, click.exceptions.Abort | KeyboardInterrupt):
        say("stopped")
    elif isinstance(fault, click.ClickException):
        try:
            fault.show()
        except OSError:
            _mute(sys.stderr)
    elif code == BUG:
        _clear_line()
        tell("".join(traceback.format_exception(fault)), nl=False)
        say("fabctl: this is a bug in fabctl; please report it with the lines above")
    else:
        say(f"fabctl: {sentence_of(fault)}")
    return code


def json_asked(words: Sequence[str]) -> bool:
    """Tell whether the command line asks for JSON, also where it cannot be understood."""
    options = words[: words.index("--")] if "--" in words else words
    return "--json" in options
