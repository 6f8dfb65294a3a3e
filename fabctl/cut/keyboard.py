"""Hold, resume and stop at the keyboard while a cut runs. **W**"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator

from drivers.grbl.run import Wish

KEYS: dict[str, Wish] = {" ": "hold", "h": "hold", "!": "hold", "r": "resume", "~": "resume", "s": "stop", "q": "stop"}
STRONGEST_FIRST: tuple[Wish, ...] = ("stop", "hold", "resume")
HELP = "keys: space hold, r resume, s stop (Ctrl-C stops too)"


@contextlib.contextmanager
def keyboard() -> Iterator[Callable[[], Wish]]:
    """Return a function that says what was pressed since the last call; without a terminal, nothing ever is."""
    if not sys.stdin.isatty():
        yield lambda: ""
        return
    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    tty.setcbreak(handle)
    try:
        yield lambda: _pressed(handle)
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _pressed(handle: int) -> Wish:
    """Return the strongest wish among all keys pressed since: to stop, to hold, to go on."""
    ready, _, _ = select.select([handle], [], [], 0)
    keys = os.read(handle, 1024).decode("latin-1").lower() if ready else ""  # all of them: none may wait in a buffer
    wishes = {KEYS.get(key, "") for key in keys}
    return next((wish for wish in STRONGEST_FIRST if wish in wishes), "")
