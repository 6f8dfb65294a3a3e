"""Faults of a line, on demand: each happens once, at a moment drawn from a seed.

A fault sits between the board and the wire and sees what the board says. The kinds:
`lost-ok`, `double-ok`, `corrupt` (one bit of one byte), `nul` (a byte 0 slipped in), `merged` (a line end lost between
a report and what follows), `banner` (the board restarts), `unplug`, `stall` (nothing passes for `STALL_S`), `slow`
(the machine crawls for `SLOW_S`, which is healthy: it answers all the while).
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

KINDS = ("lost-ok", "double-ok", "corrupt", "nul", "merged", "banner", "unplug", "stall", "slow")
STALL_S, SLOW_S = 8.0, 60.0
LINE_END = b"\r\n"


@dataclass
class Fault:
    """One fault to come. `done_s` tells when it happened; `restart`, `unplug`, `crawl` ask the endpoint to act."""

    kind: str
    seed: int
    first: int = 20
    last: int = 120
    done_s: float | None = None
    restart: bool = False
    unplug: bool = False
    crawl: bool = False
    stalled_until_s: float = 0.0
    _oks: int = 0
    _partial: bytes = b""
    _at: int = field(init=False)
    _rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"unknown fault {self.kind!r}; known: {', '.join(KINDS)}")
        self._rng = random.Random(f"{self.kind}-{self.seed}")
        self._at = self._rng.randint(self.first, self.last)

    def passes(self, now_s: float) -> bool:
        """Return whether bytes pass at all at this moment."""
        return now_s >= self.stalled_until_s

    def spoil(self, data: bytes, now_s: float) -> bytes:
        """Return what reaches the host of `data`, whole lines at a time."""
        if self.done_s is not None:
            return data
        *lines, self._partial = (self._partial + data).split(LINE_END)
        out = b"".join(self._line(line, now_s) for line in lines)
        if self.done_s is not None or not self._partial.startswith((b"o", b"<", b"e")):
            out, self._partial = out + self._partial, b""
        return out

    def _line(self, line: bytes, now_s: float) -> bytes:
        whole = line + LINE_END
        self._oks += line == b"ok"
        due = self.done_s is None and self._oks >= self._at
        if not due or not self._fits(line):
            return whole
        self.done_s = now_s
        return self._happen(line, whole, now_s)

    def _fits(self, line: bytes) -> bool:
        if self.kind == "merged":
            return line.startswith(b"<")
        return line == b"ok"

    def _happen(self, line: bytes, whole: bytes, now_s: float) -> bytes:
        if self.kind == "lost-ok":
            return b""
        if self.kind == "double-ok":
            return whole + whole
        if self.kind == "corrupt":
            at = self._rng.randrange(len(line))
            flipped = line[at] ^ (1 << self._rng.randrange(7))
            return line[:at] + bytes([flipped]) + line[at + 1 :] + LINE_END
        if self.kind == "nul":
            at = self._rng.randrange(len(whole))
            return whole[:at] + b"\0" + whole[at:]
        if self.kind == "merged":
            return line
        if self.kind == "banner":
            self.restart = True
        elif self.kind == "unplug":
            self.unplug = True
        elif self.kind == "slow":
            self.crawl = True
        else:
            self.stalled_until_s = now_s + STALL_S
        return whole
