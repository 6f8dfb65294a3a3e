"""What a GRBL board says, as values. No I/O, no clock.

A line may hold more than one message: a status report can merge with other output where a line end got lost. A line
that is none of the known ones is `Garbled`, never guessed at: an `ok` is exactly `ok`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was parsed and planned. Not: executed."""


@dataclass(frozen=True, slots=True)
class Error:
    """A line was refused."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The board locked itself. Answers no line."""

    code: int


@dataclass(frozen=True, slots=True)
class Banner:
    """The board has just started; whatever it was doing is gone."""

    text: str


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of `$$`."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Startup:
    """One line of `$N`."""

    index: int
    line: str


@dataclass(frozen=True, slots=True)
class Info:
    """A bracketed line: `[kind:text]`."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class StartupRun:
    """A start-up line was run after a reset."""

    text: str


@dataclass(frozen=True, slots=True)
class Garbled:
    """A line that no board says. `is_report` where it began as a status report, which can simply be asked for again."""

    text: str
    is_report: bool = False


@dataclass(frozen=True, slots=True)
class Report:
    """An answer to `?`. Absent fields were not in it.

    As parsed, lengths are what the board calls them: inches with `$13=1`. `Link` hands out mm only.
    """

    state: str
    substate: int | None = None
    machine_mm: Vector | None = None
    work_mm: Vector | None = None
    offset_mm: Vector | None = None
    feed_mm_min: float | None = None
    s_count: float | None = None
    free_blocks: int | None = None
    free_bytes: int | None = None
    overrides: tuple[int, int, int] | None = None
    accessories: str | None = None
    pins: str = ""

    def scaled(self, unit_mm: float) -> Report:
        """Return the report in mm, where the board counts in units of `unit_mm`."""
        return replace(
            self,
            machine_mm=scaled(self.machine_mm, unit_mm) if self.machine_mm else None,
            work_mm=scaled(self.work_mm, unit_mm) if self.work_mm else None,
            offset_mm=scaled(self.offset_mm, unit_mm) if self.offset_mm else None,
            feed_mm_min=self.feed_mm_min * unit_mm if self.feed_mm_min is not None else None,
        )

    def placed(self, offset_mm: Vector) -> Report:
        """Return the report with its machine place also where it tells only the work place (`$10=0`)."""
        if self.machine_mm is not None or self.work_mm is None:
            return self
        (x, y, z), (dx, dy, dz) = self.work_mm, offset_mm
        return replace(self, machine_mm=(x + dx, y + dy, z + dz))

    @property
    def moving(self) -> bool:
        """Return whether the machine may be in motion."""
        return self.state in ("Run", "Jog", "Home") or (self.state in ("Hold", "Door") and not self.standing)

    @property
    def standing(self) -> bool:
        """Return whether the machine surely stands: `FS:0` during `Hold:1` is not yet that."""
        if self.state == "Hold":
            return self.substate == 0
        if self.state == "Door":
            return self.substate in (0, 1)
        return self.state in ("Idle", "Alarm", "Check", "Sleep")


def scaled(place: Vector, unit_mm: float) -> Vector:
    """Return a place in mm, where it is told in units of `unit_mm`."""
    x, y, z = place
    return x * unit_mm, y * unit_mm, z * unit_mm


Message = Ok | Error | Alarm | Banner | Setting | Startup | Info | StartupRun | Garbled | Report

REPORT = re.compile(r"<([^<>]*)>")
# Of numbers at most nine digits: more is noise, and Python reads no integer of thousands of them.
SETTING = re.compile(r"\$(\d{1,9})=(.*)")
STARTUP = re.compile(r"\$N(\d{1,9})=(.*)")
CODED = re.compile(r"(error|ALARM):(\d{1,9})")
BANNER = re.compile(r"Grbl(HAL)? \d\S* .*\[.*help.*\]", re.IGNORECASE)
STATE = re.compile(r"([A-Z][a-z]+)(?::(\d{1,9}))?")
STATES = ("Idle", "Run", "Hold", "Jog", "Home", "Alarm", "Check", "Door", "Sleep", "Tool")


def parse_line(text: str) -> list[Message]:
    """Return the messages in one line, without its end."""
    if not text:
        return []
    reports = [parse_report(body) for body in REPORT.findall(text)]
    rest = REPORT.sub("", text)
    found: list[Message] = [*reports]
    if rest:
        found.append(_plain(rest))
    return found


def _plain(text: str) -> Message:
    if text == "ok":
        return Ok()
    if match := CODED.fullmatch(text):
        code = int(match[2])
        return Error(code) if match[1] == "error" else Alarm(code)
    if text.startswith("["):
        if not text.endswith("]"):
            return Garbled(text)
        kind, _, body = text[1:-1].partition(":")
        return Info(kind, body)
    if match := STARTUP.fullmatch(text):
        return Startup(int(match[1]), match[2])
    if match := SETTING.fullmatch(text):
        return Setting(int(match[1]), match[2])
    if BANNER.fullmatch(text):
        return Banner(text)
    if text.startswith(">") and ":" in text:
        return StartupRun(text[1:])
    return Garbled(text, is_report=text.startswith("<") or text.endswith(">"))


def parse_report(body: str) -> Report | Garbled:
    """Return the status report with this text between its angle brackets."""
    head, *fields = body.split("|")
    match = STATE.fullmatch(head)
    if match is None or match[1] not in STATES:
        return Garbled(f"<{body}>", is_report=True)
    values: dict[str, object] = {"state": match[1], "substate": int(match[2]) if match[2] else None}
    try:
        for item in fields:
            name, _, text = item.partition(":")
            values |= _field(name, text)
    except (ValueError, IndexError):
        return Garbled(f"<{body}>", is_report=True)
    return Report(**values)  # type: ignore[arg-type]


def finite(text: str) -> float:
    """Return the number in `text`; raise `ValueError` for anything else, `nan` and `inf` included."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a number a machine can stand at")
    return number


def _field(name: str, text: str) -> dict[str, object]:
    if name in ("MPos", "WPos", "WCO"):
        key = {"MPos": "machine_mm", "WPos": "work_mm", "WCO": "offset_mm"}[name]
        parts = [finite(part) for part in text.split(",")]
        return {key: (parts[0], parts[1], parts[2] if len(parts) > 2 else 0.0)}
    if name == "FS":
        feed, speed = text.split(",")[:2]
        return {"feed_mm_min": finite(feed), "s_count": finite(speed)}
    if name == "F":
        return {"feed_mm_min": finite(text)}
    if name == "Bf":
        blocks, free = text.split(",")
        return {"free_blocks": int(blocks), "free_bytes": int(free)}
    if name == "Ov":
        feed_percent, rapid_percent, power_percent = (int(part) for part in text.split(","))
        return {"overrides": (feed_percent, rapid_percent, power_percent)}
    if name == "A":
        return {"accessories": text}
    if name == "Pn":
        return {"pins": text}
    return {}  # fields of other dialects


@dataclass
class Listener:
    """Bytes in, messages out. Byte 0 is line noise and left out; `nul_count` says how often."""

    nul_count: int = 0
    _partial: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes; return the messages they complete."""
        self.nul_count += data.count(0)
        self._partial += data.replace(b"\0", b"")
        *lines, rest = self._partial.split(b"\n")
        self._partial = bytearray(rest)
        found: list[Message] = []
        for line in lines:
            found += parse_line(line.rstrip(b"\r").decode("latin-1"))
        return found

    def clear(self) -> None:
        """Forget a line begun."""
        self._partial.clear()
