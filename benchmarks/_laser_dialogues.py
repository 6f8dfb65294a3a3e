"""Dialogues recorded from real firmware, replayed against the simulated board: shared by tests and benchmark."""

from __future__ import annotations

import itertools
import json
import re
import statistics
from dataclasses import dataclass
from pathlib import Path

from simulators.grbl.board import Board

NUMBERS = re.compile(r"(MPos|WPos|FS):[-0-9.,]+")
POSITION = re.compile(r"MPos:(-?[0-9.]+),(-?[0-9.]+)")
FEED = re.compile(r"FS:([0-9.]+),")
TRANSITION_S = 0.050
LOOKED_S = 0.020  # the recorder looked for answers so often
NAMES = (
    "check-mode",
    "error-while-streaming",
    "errors",
    "feed-hold",
    "identify",
    "motion",
    "offsets-and-report-masks",
    "overrides",
    "rx-overflow",
    "soft-limit-and-homing-lock",
    "soft-reset-in-motion",
)


@dataclass(frozen=True)
class Row:
    t_s: float
    sent: bool
    data: bytes


def rows_of(path: Path) -> list[Row]:
    found = [json.loads(line) for line in path.read_text().splitlines()]
    return [Row(r["t_s"], r["dir"] == ">", r["bytes"].encode("latin-1")) for r in found]


def board_time(rows: list[Row]) -> list[float]:
    """Return the board's own time of each row: the recorder's host was at times too busy to keep up with it.

    Where three reports in a row come from one steady cruise, the distance travelled tells how much time the board
    had; in between the host's clock counts.
    """
    slow = pace(rows)
    times, host_s, board_s = [], rows[0].t_s, rows[0].t_s
    moving = False
    for row in rows:
        board_s += (row.t_s - host_s) * (slow if moving else 1.0)
        host_s = row.t_s
        times.append(board_s)
        text = row.data.decode("latin-1")
        if (row.sent and re.match(r"G[01].*[XY]", text.splitlines()[-1] if text.strip() else "")) or "\nG1X" in text:
            moving = True
        if "<Idle" in text or "<Alarm" in text:
            moving = False
    return times


def pace(rows: list[Row]) -> float:
    """Return how fast the recorded board's time ran against the host's while it cruised along X; 1 where they agree."""
    seen = []
    for row in rows:
        text = row.data.decode("latin-1")
        place, feed = POSITION.search(text), FEED.search(text)
        cruising = text.startswith("<Run") and place and feed and float(place[2]) == 0
        seen.append((row.t_s, float(place[1]), float(feed[1])) if cruising and place and feed else None)
    reports = [row for row, data in zip(seen, rows, strict=True) if not data.sent]
    ratios = [
        abs(b[1] - a[1]) / (a[2] / 60) / (b[0] - a[0])
        for a, b in itertools.pairwise(reports)
        if a and b and a[2] == b[2] > 0
    ]
    found = statistics.median(ratios) if len(ratios) > 1 else 1.0
    return found if found < 0.9 else 1.0


def replay(rows: list[Row], times: list[float], shift_s: float = 0.0) -> list[str]:
    board = Board()
    board.advance_to(0.5)
    board.take()
    out = bytearray()
    for row, t_s in zip(rows, times, strict=True):
        if row.sent:
            board.advance_to(t_s + (shift_s if row.data == b"?" else 0.0))
            out += board.take()
            board.receive(row.data)
    board.advance_to(times[-1] + 1.0)
    out += board.take()
    return out.decode("latin-1").split("\r\n")


def recorded_job(path: Path) -> tuple[list[str], float]:
    """Return the moves of the recorded `motion` dialogue, and how long they took until the board stood."""
    rows = rows_of(path)
    first, last = (next(k for k, row in enumerate(rows) if row.data == data) for data in (b"G0X5Y5\n", b"M5\n"))
    sent = [row.data.decode("ascii") for row in rows[first : last + 1] if row.sent and row.data != b"?"]
    return sent, rows[last + 1].t_s - rows[first].t_s - LOOKED_S / 2


def alike(recorded: str, simulated: str) -> bool:
    return NUMBERS.sub(r"\1", recorded) == NUMBERS.sub(r"\1", simulated)


def differences(rows: list[Row]) -> list[tuple[str, str]]:
    """Return (recorded, simulated) lines that differ, allowing a report near a transition to see the other state."""
    recorded = b"".join(row.data for row in rows if not row.sent).decode("latin-1").split("\r\n")
    times = board_time(rows)
    best: list[tuple[str, str]] | None = None
    for step in (0, *(sign * k for k in range(1, 11) for sign in (-1, 1))):
        shift_s = step / 10 * TRANSITION_S
        simulated = replay(rows, times, shift_s)
        found = [(a, b) for a, b in zip(recorded, simulated, strict=False) if not alike(a, b)]
        if len(recorded) != len(simulated):
            found.append((f"{len(recorded)} lines", f"{len(simulated)} lines"))
        if best is None or len(found) < len(best):
            best = found
        if not best:
            break
    assert best is not None
    return best
