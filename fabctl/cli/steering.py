"""The operator's hands while a job runs: space pauses, s or Ctrl-C stops, Enter answers; and the growing curve."""

from __future__ import annotations

import os
import select
import signal
import sys
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any

import click

from fabctl.events import Emit, Event

if TYPE_CHECKING:
    from fabctl.indent.sampling import Wish

PLOT_COLUMNS, PLOT_ROWS = 60, 12
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
            click.echo("space: pause   s or Ctrl-C: stop", err=True)
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        signal.signal(signal.SIGINT, self._old)
        if self._terminal is not None:
            import termios

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
            click.echo(f"\r\x1b[2K{message}   [Enter]", err=True)
        self.wish()
        return self._answered

    def listen(self, event: Event) -> None:
        """Show an event; on a terminal also the growing curve."""
        if event.kind == "progress" and self._terminal is not None and sys.stderr.isatty():
            self._draw(event)
        else:
            self._listener(event)

    def _interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self._wish == "stop":
            raise KeyboardInterrupt
        self._wish = "stop"
        click.echo("\nstopping; once more interrupts at once", err=True)

    def _draw(self, event: Event) -> None:
        depth, force = event.data.get("depth_mm"), event.data.get("force_N")
        if event.data.get("step") in ("load", "unload") and depth is not None and force is not None:
            self._curve.append((depth, force))
        elif event.data.get("step") in ("approach", "travel"):
            self._curve.clear()
        lines = [*braille(self._curve), f"{event.done_frac or 0:6.1%}  {event.message}"]
        up = f"\x1b[{self._drawn_rows}F" if self._drawn_rows else ""
        click.echo(up + "".join(f"\x1b[2K{line}\n" for line in lines), err=True, nl=False)
        self._drawn_rows = len(lines)


def braille(points: list[tuple[float, float]], columns: int = PLOT_COLUMNS, rows: int = PLOT_ROWS) -> list[str]:
    """Return a curve as lines of braille dots, with its ranges at the side."""
    if len(points) < 2:
        return [""] * rows
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
    cells = [[0] * columns for _ in range(rows)]
    for x, y in points:
        across = round((x - low_x) / ((high_x - low_x) or 1) * (2 * columns - 1))
        down = round((high_y - y) / ((high_y - low_y) or 1) * (4 * rows - 1))
        cells[down // 4][across // 2] |= DOTS[down % 4][across % 2]
    lines = ["".join(chr(0x2800 + cell) for cell in row) for row in cells]
    lines[0] += f" {high_y:.3f} N"
    lines[-1] += f" {low_y:.3f} N   {low_x:.2f} to {high_x:.2f} mm"
    return lines
