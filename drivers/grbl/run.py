"""Run a program: stream it, watch the board, and leave safely on every way out. **W**

The evidence decides, not silence: a slow move is no stall as long as `?` is answered. What ends a run early ends it
with the beam off (`Laser.off`), and the error says which lines may have run.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

from drivers.errors import DeviceError, DeviceTimeout
from drivers.grbl.faults import WHO, BoardRestarted, DoubledOk, GarbledLine, LineRefused, LinkStalled, LostOk
from drivers.grbl.laser import Laser
from drivers.grbl.link import HOLD, START, STATUS, Link, alarm
from drivers.grbl.messages import Alarm, Banner, Error, Garbled, Message, Ok, Report
from drivers.grbl.stream import Stream

POLL_S = 0.05  # how old the place may be by which lines are held back
ASK_AGAIN_S = 0.3
STALL_S = 0.8
IDLE_PROOF_S = 0.25  # Idle seen twice so far apart, with lines unanswered: an answer is lost
READ_S = 0.01
END_S = 3.0
DWELL = re.compile(r"G0?4(?!\d).*?P([0-9.]+)")

Wish = Literal["", "hold", "resume", "stop"]


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is: lines sent and answered, and the last thing the board said of itself."""

    sent_count: int
    answered_count: int
    report: Report | None
    held: bool
    time_s: float | None = None  # of a finished run: from its first line until the board was seen standing at its end


class Watcher(Protocol):
    """The job's side of a run."""

    def limit_count(self, now_s: float) -> int | None:
        """Return up to which line may be sent now, or None for no limit."""
        ...

    def seen(self, progress: Progress, now_s: float) -> None:
        """Hear of every status report and every few answers."""
        ...

    def wish(self) -> Wish:
        """Return what the operator wants now; each wish once."""
        ...


class StoppedByOperator(DeviceError):
    """The operator stopped the run; the machine stands and its position is known, unless `position_known` is false."""

    def __init__(self, position_known: bool) -> None:
        super().__init__(position_known)
        self.position_known = position_known

    def __str__(self) -> str:
        return f"stopped by the operator; position {'kept' if self.position_known else 'lost'}"


@dataclass
class _Run:
    link: Link
    stream: Stream
    watcher: Watcher
    empty_bytes: int | None
    held: bool = False
    asked_s: float = -math.inf
    unanswered_s: float | None = None
    changed_s: float = 0.0
    idle_since_s: float | None = None
    garbled_reports_count: int = 0
    seen_answers: int = field(default=0)

    def step(self) -> None:
        """Send what may be sent, hear what has come, ask for status when it is time."""
        now_s = self.link.clock.now_s()
        self._obey(self.watcher.wish())
        if not self.held:
            data = self.stream.take(self.watcher.limit_count(now_s))
            if data:
                self.changed_s = now_s
                self.link.send(data)
        self._ask(now_s)
        for message in self.link.receive(READ_S):
            self._hear(message)
        waiting_s = 0.0 if self.unanswered_s is None else self.link.clock.now_s() - self.unanswered_s
        if waiting_s > STALL_S:
            raise LinkStalled(waiting_s)

    def _obey(self, wish: Wish) -> None:
        if wish == "hold":
            self.held = True
            self.link.send(HOLD)
        elif wish == "resume":
            report = self.link.report
            paused = self.held or (report is not None and report.state in ("Hold", "Door"))  # by its own button or door
            if paused and report is not None and report.standing:
                self.held = False
                self.idle_since_s = None
                self.link.send(START)
        elif wish == "stop":
            raise StoppedByOperator(True)

    def _ask(self, now_s: float) -> None:
        pause_s = POLL_S if self.unanswered_s is None else ASK_AGAIN_S
        if now_s - self.asked_s >= pause_s:
            self.asked_s = now_s
            self.unanswered_s = self.unanswered_s if self.unanswered_s is not None else now_s
            self.link.send(STATUS)

    def _hear(self, message: Message) -> None:
        if isinstance(message, Ok):
            self.stream.answered()
            self.changed_s = self.link.clock.now_s()
            self.idle_since_s = None
        elif isinstance(message, Error):
            index = self.stream.answered()
            raise LineRefused(index, self.stream.lines[index], message.code, self.stream.sent_count, self.link.firmware)
        elif isinstance(message, Alarm):
            raise alarm(message.code, self.link.firmware)
        elif isinstance(message, Banner):
            raise BoardRestarted(message.text)
        elif isinstance(message, Report):
            self._heard_report(message)
        elif isinstance(message, Garbled):
            if not message.is_report:
                raise GarbledLine(message.text)
            self.garbled_reports_count += 1  # it can be asked for again

    def _heard_report(self, report: Report) -> None:
        now_s = self.link.clock.now_s()
        self.unanswered_s = None
        if report.state in ("Alarm", "Sleep", "Check"):
            raise alarm(0, self.link.firmware)
        free = report.free_bytes
        if free is not None and self.empty_bytes is not None:
            used = self.empty_bytes - free
            if used > self.stream.outstanding_bytes:
                raise DoubledOk(f"it holds {used} bytes, {self.stream.outstanding_bytes} are unanswered")
        self.watcher.seen(self.progress(), now_s)
        self._prove_lost_ok(report, now_s)

    def _prove_lost_ok(self, report: Report, now_s: float) -> None:
        if report.state != "Idle" or not self.stream.outstanding_count:
            self.idle_since_s = None
            return
        if self.idle_since_s is None:
            self.idle_since_s = now_s
        outstanding = self.stream.lines[self.stream.answered_count : self.stream.sent_count]
        dwell_s = sum(float(match[1]) for line in outstanding if (match := DWELL.search(line)))
        quiet_s = now_s - max(self.idle_since_s, self.changed_s)
        if quiet_s > IDLE_PROOF_S + dwell_s:
            raise LostOk(self.stream.outstanding_count)

    def progress(self) -> Progress:
        """Return how far the run is."""
        return Progress(self.stream.sent_count, self.stream.answered_count, self.link.report, self.held)


def run_program(laser: Laser, lines: Sequence[str], watcher: Watcher) -> Progress:
    """Stream `lines` (bare, at most 79 characters) and return when all are done and the board stands idle.

    Raises what ended it early, after `laser.off()`; `laser.left` then says how the machine was left.
    """
    identity = laser.identity
    if identity is None:
        raise ValueError("connect first")
    start = laser.report()
    if start.state != "Idle":
        raise DeviceTimeout(WHO, "by being idle", 0.0, f"it says {start.state}; home or unlock it first")
    run = _Run(laser.link, Stream(lines, identity.rx_bytes), watcher, start.free_bytes)
    run.changed_s = began_s = laser.clock.now_s()
    laser.begin()
    try:
        while not run.stream.done:
            run.step()
        stood_s = _await_standstill(run)
    except BaseException:  # Ctrl-C too: the beam goes off whatever broke the stream
        # A second Ctrl-C cuts the waiting in `off` short, and one that
        # breaks out of it meets `off` again on leaving the laser's `with` block.
        laser.off()
        raise
    laser.end()
    return replace(run.progress(), time_s=stood_s - began_s)


def _await_standstill(run: _Run) -> float:
    """Return when the board was first seen standing with all answered; then listen for an answer too many.

    Listening takes `IDLE_PROOF_S` of the host's time, in which the board does nothing: it belongs to no job's time.
    """
    clock = run.link.clock
    end_s, idle_s = clock.now_s() + END_S, math.inf
    while clock.now_s() < min(end_s, idle_s + IDLE_PROOF_S):
        run.step()
        report = run.link.report
        if report is not None and report.state == "Idle" and math.isinf(idle_s) and run.link.reported_s > run.changed_s:
            idle_s = clock.now_s()
    if math.isinf(idle_s):
        raise DeviceTimeout(WHO, "the end of the job by becoming idle", END_S)
    return idle_s
