"""How a run ends in its record, whatever breaks it off."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fabctl.errors import RefusedError, Stopped

if TYPE_CHECKING:
    from fabctl.records.folder import RunFolder

INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last: a terminal closed, a connection dropped


def signals_heard() -> list[signal.Signals]:
    """Return the signals that end a run: all of `INTERRUPTS`, but for a hang-up that `nohup` has it live through."""
    return [kind for kind in INTERRUPTS if kind != signal.SIGHUP or signal.getsignal(kind) != signal.SIG_IGN]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP come only after the block: for short work that must not be left half done.

    Python interrupts its main thread only, whichever thread the system gave the signal to: a mask would not do.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before: dict[signal.Signals, Any] = {}
    try:
        for kind in INTERRUPTS:
            before[kind] = signal.signal(kind, lambda number, _: came.append(number)) or signal.SIG_DFL
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
        for number in came:
            signal.raise_signal(number)


@contextmanager
def outcome_kept(run: RunFolder) -> Iterator[None]:
    """Write down how a run ended that is broken off inside the block: stopped, refused or failed; the fault goes on.

    An outcome that is there already stays: what comes after it changes nothing of what was done.
    """
    try:
        yield
    except (Exception, KeyboardInterrupt) as fault:
        if run.outcome() is None:
            run.finish(*_outcome_of(fault))
        raise


def _outcome_of(fault: BaseException) -> tuple[str, str]:
    if isinstance(fault, Stopped | KeyboardInterrupt):
        return "stopped", str(fault) or "stopped by the operator"
    return "refused" if isinstance(fault, RefusedError) else "failed", str(fault) or type(fault).__name__
