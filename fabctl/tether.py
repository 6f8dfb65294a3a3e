"""A flow and its step hold one pipe: when the flow dies, however it does, the step hears of it and stops itself."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

VARIABLE = "FABCTL_TETHER"  # the number of the step's end of the pipe


@contextlib.contextmanager
def tether() -> Iterator[int]:
    """Yield the reading end of a pipe, for a step to hold, that closes when this process dies."""
    end, held = os.pipe()
    try:
        yield end
    finally:
        os.close(end)
        os.close(held)


def end_with_parent() -> None:
    """End a flow's step as SIGTERM does once the flow is gone: no machine moves with nobody there."""
    end = os.environ.pop(VARIABLE, None)  # what this process starts itself is not on that line
    if end is not None:
        threading.Thread(target=_watch, args=(int(end),), daemon=True).start()


def _watch(end: int) -> None:
    os.read(end, 1)  # nobody ever writes: it returns when the other end is closed
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)  # it may wait in a call, and must wake up
