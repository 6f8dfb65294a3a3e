"""Flow control by counting characters: how much may be sent, and which line an answer belongs to. No I/O, no clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.grbl.faults import DoubledOk

LINE_LIMIT = 79  # characters a board holds of one line
LEAST_SHARE = 0.5  # of the receive buffer is always used, however long the lines


def bare(line: str) -> str:
    """Return `line` as it should travel: without comments and blanks."""
    out, depth = [], 0
    for sign in line:
        if depth:
            depth -= sign == ")"
        elif sign == ";":
            break
        elif sign == "(":
            depth = 1
        elif not sign.isspace():
            out.append(sign)
    return "".join(out)


@dataclass
class Stream:
    """A program on its way. Every byte sent, newlines included, counts until its line is answered.

    The longest line is kept free in the board's buffer, so that even one `ok` too many can make nothing overflow.
    """

    lines: Sequence[str]
    rx_bytes: int
    sent_count: int = 0
    answered_count: int = 0
    outstanding_bytes: int = 0
    _sizes: deque[int] = field(default_factory=deque)

    def __post_init__(self) -> None:
        longest = max((len(line) + 1 for line in self.lines), default=0)
        self.budget_bytes = max(self.rx_bytes - longest, int(self.rx_bytes * LEAST_SHARE), min(longest, self.rx_bytes))

    @property
    def done(self) -> bool:
        """Return whether every line has been answered."""
        return self.answered_count == len(self.lines)

    @property
    def outstanding_count(self) -> int:
        """Return how many lines are sent and not answered."""
        return self.sent_count - self.answered_count

    def take(self, limit_count: int | None = None) -> bytes:
        """Return the next lines that fit, up to line number `limit_count`; they count as sent from now on."""
        limit = len(self.lines) if limit_count is None else min(limit_count, len(self.lines))
        out = bytearray()
        while self.sent_count < limit:
            data = self.lines[self.sent_count].encode("ascii") + b"\n"
            if self.outstanding_bytes + len(data) > self.budget_bytes:
                break
            out += data
            self.outstanding_bytes += len(data)
            self._sizes.append(len(data))
            self.sent_count += 1
        return bytes(out)

    def answered(self) -> int:
        """Count one answer; return the index of the line it is for. Raise `DoubledOk` where none is awaited."""
        if not self._sizes:
            raise DoubledOk("an ok with no line outstanding")
        self.outstanding_bytes -= self._sizes.popleft()
        self.answered_count += 1
        return self.answered_count - 1

    def contradicts(self, free_bytes: int) -> bool:
        """Return whether the board holds more unread bytes than were sent and not answered."""
        return self.rx_bytes - free_bytes > self.outstanding_bytes
