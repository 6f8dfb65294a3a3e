"""A sampling loop's place before other work on the machine. The only file that asks the scheduler for anything."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def before_other_work() -> Iterator[bool]:
    """Run the block, and the threads begun in it, before ordinary processes; yield whether the system allowed it.

    Linux: the lowest real-time priority, for root or where `ulimit -r` gives at least 1. The kernel keeps a twentieth
    of every second for others, so that even a loop that never waits cannot lock the machine up.
    """
    try:
        was, how = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (OSError, AttributeError):  # AttributeError: a system without these calls
        yield False
        return
    try:
        yield True
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, was, how)
