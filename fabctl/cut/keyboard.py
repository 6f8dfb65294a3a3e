"""Hold, resume and stop at the keyboard while a cut runs. **W**"""

from __future__ import annotations

import contextlib
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator

from drivers.grbl.run import Wish

KEYS: dict[str, Wish] = {" ": "hold", "h": "hold", "!": "hold", "r": "resume", "~": "resume", "s": "stop", "q": "stop"}
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
        yield _pressed
    finally:
        termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _pressed() -> Wish:
    ready, _, _ = select.select([sys.stdin], [], [], 0)
    return KEYS.get(sys.stdin.read(1).lower(), "") if ready else ""
