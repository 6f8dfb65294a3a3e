"""The black box: every byte of a line, with its time, on the way through."""

from __future__ import annotations

import json
from collections.abc import Callable

from drivers.clock import Clock
from drivers.transport import Transport

STOPS = frozenset(b"!\x18\x84\x85")  # hold, reset, door and jog cancel of GRBL: bytes that no line holds


class Tap:
    """A transport around another. What is sent is noted before it goes out, so no line is ever sent unseen.

    Only what stops the machine, and the answers to it, need no note: a full disk must not leave a beam on.
    """

    def __init__(self, inner: Transport, note: Callable[[str], None], clock: Clock) -> None:
        self.url = inner.url
        self._inner, self._note, self._clock = inner, note, clock
        self._start_s = clock.now_s()
        self._stopping = False

    def write(self, data: bytes) -> None:
        """Note `data`, then send it; what stops the machine is sent also where it cannot be noted."""
        self._stopping = not STOPS.isdisjoint(data)
        self._keep(">", data)
        self._inner.write(data)

    def read(self, timeout_s: float) -> bytes:
        """Receive, then note."""
        data = self._inner.read(timeout_s)
        if data:
            self._keep("<", data)
        return data

    def close(self) -> None:
        """Close the line."""
        self._inner.close()

    def _keep(self, direction: str, data: bytes) -> None:
        try:
            self._note(self._row(direction, data))
        except Exception:  # whatever the note failed for: no stop may wait for it
            if not self._stopping:
                raise

    def _row(self, direction: str, data: bytes) -> str:
        row = {"t_s": round(self._clock.now_s() - self._start_s, 6), "dir": direction, "bytes": data.decode("latin-1")}
        return json.dumps(row)


def read_log(text: str) -> list[tuple[float, str, bytes]]:
    """Return the rows of a log: time, direction (`>` or `<`), bytes. A torn last row is left out."""
    rows = []
    for line in text.splitlines():
        try:
            row = json.loads(line)
            rows.append((float(row["t_s"]), str(row["dir"]), str(row["bytes"]).encode("latin-1")))
        except (ValueError, KeyError, TypeError):
            continue
    return rows
