"""The operator's hands while a job runs: space pauses, s or Ctrl-C stops, Enter answers; and the growing curve."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import sys
import textwrap
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any

from fabctl.cli.common import tell
from fabctl.events import Emit, Event

if TYPE_CHECKING:
    from fabctl.indent.sampling import Wish

PLOT_COLUMNS, PLOT_ROWS = 60, 12
LABEL_COLUMNS, OTHER_ROWS = 11, 6  # beside the plot; and above and below it, so that a message is not pushed out
POINTS_COUNT = 1500  # of the drawn curve: more would hold up the sampling that draws it
DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))


class Keys:
    """Reads keys without waiting, and turns the first Ctrl-C into a wish; the second one interrupts."""

    def __init__(self, listener: Emit) -> None:
        self._listener = listener
        self._wish: Wish = "go"
        self._answered = False
        self._asked = ""
        self._terminal: list[Any] | None = None
        self._old: Any = None
        self._curve: list[tuple[float, float]] = []
        self._drawn_rows = 0

    def __enter__(self) -> Keys:
        self._old = signal.signal(signal.SIGINT, self._interrupt)
        if sys.stdin.isatty():
            import termios
            import tty

            self._terminal = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        signal.signal(signal.SIGINT, self._old)
        if self._terminal is not None:
            import termios

            with contextlib.suppress(termios.error):  # the terminal may be gone
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)

    def wish(self) -> Wish:
        """Return what the operator wants now."""
        while self._terminal is not None and select.select([sys.stdin], [], [], 0)[0]:
            keys = os.read(sys.stdin.fileno(), 64)  # past Python's own buffer, in which a second key would wait
            if not keys:
                break
            self._press(keys.decode(errors="ignore"))
        return self._wish

    def _press(self, keys: str) -> None:
        for key in keys:
            if key in ("s", "q", "\x1b"):
                self._wish = "stop"
            elif key == " " and self._wish != "stop":  # a stop is not taken back
                self._wish = "go" if self._wish == "pause" else "pause"
            elif key in ("\n", "\r"):
                self._answered = True

    def go_on(self, message: str) -> bool:
        """Tell whether the operator has answered the wait; without a terminal nobody can, and it goes on at once."""
        if self._terminal is None:
            return True
        if message != self._asked:
            self._asked, self._answered = message, False
        self.wish()
        if self._answered:
            self._asked = ""
            return True
        return False

    def listen(self, event: Event) -> None:
        """Show an event; on a terminal also the growing curve."""
        if event.kind == "progress" and self._terminal is not None and sys.stderr.isatty():
            self._draw(event)
        else:
            tell(self._erased(), nl=False)
            self._listener(event)

    def _interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self._wish == "stop":
            raise KeyboardInterrupt
        self._wish = "stop"
        self._drawn_rows = 0
        tell("\nstopping; once more interrupts at once")

    def _draw(self, event: Event) -> None:
        self._grow(event)
        size = shutil.get_terminal_size()
        columns, rows = min(PLOT_COLUMNS, size.columns - LABEL_COLUMNS), min(PLOT_ROWS, size.lines - OTHER_ROWS)
        plot = braille(self._curve, columns, rows) if len(self._curve) > 1 and columns > 9 and rows > 3 else []
        lines = [*plot, f"{event.done_frac or 0:6.1%}  {event.message}", *self._hints(size.columns - 1)]
        tell(self._erased() + "".join(f"{line[: size.columns - 1]}\n" for line in lines), nl=False)
        self._drawn_rows = len(lines)

    def _grow(self, event: Event) -> None:
        depth, force = event.data.get("depth_mm"), event.data.get("force_N")
        if event.data.get("step") in ("load", "unload") and depth is not None and force is not None:
            self._curve.append((depth, force))
            if len(self._curve) > POINTS_COUNT:
                del self._curve[::2]
        elif event.data.get("step") in ("approach", "travel"):
            self._curve.clear()

    def _hints(self, columns: int) -> list[str]:
        """Return what the operator may press now."""
        if self._wish == "stop":
            return ["stopping"]
        if self._asked:
            return textwrap.wrap(f"{self._asked}  [Enter: go on, s: stop]", max(20, columns))
        return ["space: go on   s: stop" if self._wish == "pause" else "space: pause   s: stop"]

    def _erased(self) -> str:
        """Return what takes the drawn lines away, so that what is told next stands above the new ones and stays."""
        up = f"\x1b[{self._drawn_rows}F\x1b[J" if self._drawn_rows else ""
        self._drawn_rows = 0
        return up


def braille(points: list[tuple[float, float]], columns: int = PLOT_COLUMNS, rows: int = PLOT_ROWS) -> list[str]:
    """Return a curve as lines of braille dots with its forces at the side, and a line with its depths."""
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
    cells = [[0] * columns for _ in range(rows)]
    for x, y in points:
        across = round((x - low_x) / ((high_x - low_x) or 1) * (2 * columns - 1))
        down = round((high_y - y) / ((high_y - low_y) or 1) * (4 * rows - 1))
        cells[down // 4][across // 2] |= DOTS[down % 4][across % 2]
    lines = ["".join(chr(0x2800 + cell) for cell in row) for row in cells]
    lines[0] += f" {high_y:.3f} N"
    lines[-1] += f" {low_y:.3f} N"
    left, right = f"{low_x:.2f}", f"{high_x:.2f} mm"
    return [*lines, left + right.rjust(columns - len(left))]
