"""The line to a board, one message at a time: send, receive, ask for status. **W**"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drivers.clock import Clock
from drivers.errors import DeviceAlarm, DeviceRefused, DeviceTimeout
from drivers.grbl.faults import WHO, BoardRestarted
from drivers.grbl.meanings import alarm_meaning, error_meaning
from drivers.grbl.messages import Alarm, Banner, Error, Garbled, Listener, Message, Ok, Report, Vector
from drivers.transport import Transport

STATUS, START, HOLD, RESET = b"?", b"~", b"!", b"\x18"
DOOR, JOG_CANCEL = b"\x84", b"\x85"
STEP_S = 0.02
ANSWER_S = 3.0
DRAINS_COUNT = 32


def alarm(code: int, firmware: str = "grbl") -> DeviceAlarm:
    """Return the error for `ALARM:code` of this firmware."""
    return DeviceAlarm(WHO, code, *alarm_meaning(code, firmware))


class Link:
    """Messages over a transport, their lengths in mm. The last report is kept as `report`, with its machine place.

    `unit_mm` is what the board counts in (`$13`), `offset_mm` its work offset: known once identified. Overrides are
    told in every few reports and whenever they change: the others carry the last ones.
    """

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self.transport, self.clock = transport, clock
        self.listener = Listener()
        self.report: Report | None = None
        self.reported_s = 0.0
        self.garbled: list[str] = []
        self.unit_mm = 1.0
        self.offset_mm: Vector | None = None
        self.overrides: tuple[int, int, int] | None = None
        self.firmware = "grbl"  # whose numbers `error:` and `ALARM:` are; known once identified

    def send(self, data: bytes) -> None:
        """Put bytes on the line."""
        self.transport.write(data)

    def receive(self, timeout_s: float) -> list[Message]:
        """Return the messages that have come, waiting at most `timeout_s`."""
        came = self.listener.feed(self.transport.read(timeout_s))
        found = [self._whole(message) if isinstance(message, Report) else message for message in came]
        for message in found:
            if isinstance(message, Report):
                self.report, self.reported_s = message, self.clock.now_s()
            elif isinstance(message, Banner):
                self.overrides = None
            elif isinstance(message, Garbled):
                self.garbled.append(message.text)
        return found

    def _whole(self, report: Report) -> Report:
        if self.unit_mm != 1.0:
            report = report.scaled(self.unit_mm)
        if report.offset_mm is not None:
            self.offset_mm = report.offset_mm
        self.overrides = report.overrides or self.overrides
        report = replace(report, overrides=self.overrides)
        return report.placed(self.offset_mm) if self.offset_mm is not None else report

    def drain(self) -> None:
        """Throw away what has come in so far."""
        for _ in range(DRAINS_COUNT):  # a device that never stops talking must not hold us here
            if not self.transport.read(0.0):
                break
        self.listener.clear()
        self.report = None

    def wait_for(self, wanted: Callable[[Message], bool], timeout_s: float) -> tuple[bool, list[Message]]:
        """Receive until `wanted` accepts a message or time is up; return whether it came, and all that came."""
        end_s = self.clock.now_s() + timeout_s
        seen: list[Message] = []
        while True:
            fresh = self.receive(min(STEP_S, max(end_s - self.clock.now_s(), 0.0)))
            seen += fresh
            if any(wanted(message) for message in fresh):
                return True, seen
            if self.clock.now_s() >= end_s:
                return False, seen

    def status(self, timeout_s: float = 1.0) -> Report | None:
        """Return a fresh status report, or None where the board does not answer within `timeout_s`."""
        self.send(STATUS)
        came, _ = self.wait_for(lambda message: isinstance(message, Report), timeout_s)
        return self.report if came else None

    def ask(self, line: str, timeout_s: float = ANSWER_S) -> list[Message]:
        """Send one line alone and wait for its `ok`; return what came before it.

        Raise `DeviceRefused` on `error:n`, `DeviceAlarm` on an alarm, `BoardRestarted` on a banner, `DeviceTimeout`
        where nothing answers. A status report or noise in between does no harm.
        """
        self.send(line.encode("ascii") + b"\n")
        _, seen = self.wait_for(lambda m: isinstance(m, Ok | Error | Alarm | Banner), timeout_s)
        for message in seen:
            if isinstance(message, Ok):
                return seen[: seen.index(message)]
            if isinstance(message, Error):
                meaning, hint = error_meaning(message.code, self.firmware)
                raise DeviceRefused(WHO, line, f"error {message.code}: {meaning}", hint)
            if isinstance(message, Alarm):
                raise alarm(message.code, self.firmware)
            if isinstance(message, Banner):
                raise BoardRestarted(message.text)
        raise DeviceTimeout(WHO, repr(line), timeout_s, "is this a GRBL board, at the right speed?")
