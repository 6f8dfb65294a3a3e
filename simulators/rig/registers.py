"""The simulated controller's own register map, written from the rig's data sheet, not from the driver's file.

Each row: name, address, kind, step of one count (0: the integer itself). Words high first.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

Row = tuple[str, int, str, float]

STATUS: tuple[Row, ...] = (
    ("sequence", 0, "I", 0),
    ("request_echo", 2, "H", 0),
    ("heartbeat", 3, "H", 0),
    ("state", 4, "H", 0),
    ("faults", 5, "H", 0),
    ("command_id", 6, "I", 0),
    ("command_state", 8, "H", 0),
    ("command_reason", 9, "H", 0),
    ("position", 10, "i", 1e-4),
    ("force", 12, "i", 1e-5),
)
STATUS_CHECK = 14
IDENTITY: tuple[Row, ...] = (
    ("magic", 32, "H", 0),
    ("version", 33, "H", 0),
    ("model", 34, "16s", 0),
    ("serial", 42, "I", 0),
    ("firmware", 44, "H", 0),
    ("capacity", 45, "f", 0),
    ("travel", 47, "f", 0),
    ("speed_max", 49, "f", 0),
)
ENVIRONMENT: tuple[Row, ...] = (
    ("temperature", 64, "h", 0.01),
    ("humidity", 65, "H", 1e-4),
    ("stage_x", 66, "i", 1e-4),
    ("stage_y", 68, "i", 1e-4),
)
COMMAND: tuple[Row, ...] = (
    ("id", 100, "I", 0),
    ("code", 102, "H", 0),
    ("target", 103, "i", 1e-4),
    ("speed", 105, "i", 1e-4),
    ("until", 107, "i", 1e-5),
    ("stage_x", 109, "i", 1e-4),
    ("stage_y", 111, "i", 1e-4),
)
SETTINGS: tuple[Row, ...] = (
    ("force_max", 120, "i", 1e-5),
    ("force_min", 122, "i", 1e-5),
    ("travel_min", 124, "i", 1e-4),
    ("travel_max", 126, "i", 1e-4),
    ("safe_height", 128, "i", 1e-4),
    ("acceleration", 130, "i", 1e-4),
    ("watchdog", 132, "H", 0.001),
)
FEED: tuple[Row, ...] = (("feed", 140, "I", 0), ("request", 142, "H", 0))

DISARMED, READY, MOVING, FAULTED = range(4)
OVERLOAD, WATCHDOG, ESTOP, TRAVEL, SATURATION, UNHOMED, RESTARTED = (1 << bit for bit in range(7))
NONE, RUNNING, DONE, REFUSED, ABORTED = range(5)
MOVE, STOP, ARM, DISARM, HOME, CLEAR, MOVE_UNTIL_ABOVE, MOVE_UNTIL_BELOW, MOVE_STAGE = range(1, 10)
(
    NO_REASON,
    NOT_ARMED,
    IS_FAULTED,
    OUTSIDE_TRAVEL,
    UNKNOWN_CODE,
    ID_NOT_NEWER,
    BAD_SPEED,
    NOT_HOMED,
    NOT_AT_SAFE_HEIGHT,
    LIMIT_NOT_REACHED,
    STOP_COMMAND,
    TOWARDS_OVERLOAD,
) = range(12)


def words_of(rows: Sequence[Row], values: Mapping[str, float | int | str]) -> list[int]:
    """Return the words of a block, clipped to what the registers can hold, as the controller's firmware does."""
    raw = b"".join(_packed(kind, step, values[name]) for name, _, kind, step in rows)
    return list(struct.unpack(f">{len(raw) // 2}H", raw))


def values_of(rows: Sequence[Row], words: Sequence[int]) -> dict[str, float]:
    """Return the values of a block's words."""
    raw = struct.pack(f">{len(words)}H", *words)
    found, start = {}, 0
    for name, _, kind, step in rows:
        (number,) = struct.unpack_from(">" + kind, raw, start)
        found[name] = number * step if step else number
        start += struct.calcsize(">" + kind)
    return found


def length(rows: Sequence[Row]) -> int:
    """Return a block's length in words."""
    return sum(struct.calcsize(">" + kind) for _, _, kind, _ in rows) // 2


def status_check(words: Sequence[int]) -> int:
    """Return CRC-16/CCITT-FALSE of the words, bit by bit."""
    value = 0xFFFF
    for word in words:
        value ^= word
        for _ in range(16):
            value = (value << 1) ^ (0x11021 if value & 0x8000 else 0)
    return value & 0xFFFF


def _packed(kind: str, step: float, value: float | int | str) -> bytes:
    if kind.endswith("s"):
        return struct.pack(">" + kind, str(value).encode())
    if kind == "f":
        return struct.pack(">f", float(value))
    number = round(float(value) / step) if step else int(value)
    if kind in "iI":
        low, high = (-(2**31), 2**31 - 1) if kind == "i" else (0, 2**32 - 1)
    else:
        low, high = (-(2**15), 2**15 - 1) if kind == "h" else (0, 2**16 - 1)
    return struct.pack(">" + kind, min(max(number, low), high))
