"""The laser driver on the simulated board in one thread and virtual time: what the contract tests share."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.errors import TransportError
from drivers.grbl.laser import Laser
from drivers.grbl.run import Progress, Wish
from drivers.transport.memory import MemoryTransport
from simulators.faults import SLOW_S, Fault
from simulators.grbl.board import Board, Point
from simulators.grbl.dialects import GRBL, Dialect
from simulators.grbl.machine import Machine, State, World
from simulators.grbl.settings import Memory

LAB = {22: 1, 20: 1, 32: 1, 10: 3, 130: 300, 131: 200, 110: 6000, 111: 6000, 120: 500, 121: 500, 25: 3000, 26: 50}


class VirtualClock:
    """The board's time is everybody's time."""

    def __init__(self, board: Board) -> None:
        self._board = board

    def now_s(self) -> float:
        return self._board.machine.now_s

    def sleep(self, duration_s: float) -> None:
        self._board.advance_to(self.now_s() + duration_s)


class Killed(BaseException):
    """The host process is gone: nothing more is sent, no clean-up runs."""


@dataclass
class Rig:
    """A board, its line with at most one fault in it, the beam's trace, and every line the board was given."""

    fault: Fault | None = None
    settings: dict[int, float] = field(default_factory=lambda: dict(LAB))
    homed: bool = True
    options: str = "V"
    dialect: Dialect = GRBL
    trace: list[Point] = field(default_factory=list)
    sent: bytearray = field(default_factory=bytearray)
    unplugged: bool = False
    dies_s: float = math.inf  # from this moment on the host is dead
    before_send: Callable[[bytes], None] = lambda data: None

    def __post_init__(self) -> None:
        memory = Memory()
        for number, value in self.settings.items():
            assert memory.store(number, value) == 0
        memory.pending_s = 0.0
        machine = Machine(
            memory=memory,
            world=World(switches=True, real_mm=(-40.0, -30.0, -5.0)),
            options=self.options,
            dialect=self.dialect,
        )
        self.board = Board(machine, trace=self.trace.append)
        if self.homed:
            machine.state = State.IDLE
            machine.declare_position((-250, -250, -250))
            machine.sync_position()
        self.clock = VirtualClock(self.board)
        self.transport = MemoryTransport(self._send, self._receive)

    def laser(self) -> Laser:
        return Laser(self.transport, self.clock)

    def revive(self) -> MemoryTransport:
        """Return a new line to the same board, for a new host."""
        self.dies_s = math.inf
        self.board.take()
        return MemoryTransport(self._send, self._receive)

    def _send(self, data: bytes) -> None:
        if self.clock.now_s() >= self.dies_s:
            raise Killed
        if self.unplugged:
            raise TransportError("memory://board", "the line broke")
        self.before_send(data)
        self.sent += data
        if self.fault is None or self.fault.passes(self.clock.now_s()):
            self.board.receive(data)

    def _receive(self, timeout_s: float) -> bytes:
        end_s = self.clock.now_s() + timeout_s
        while True:
            if self.clock.now_s() >= self.dies_s:
                raise Killed
            if self.unplugged:
                raise TransportError("memory://board", "the line broke")
            out = self._through(self.board.take())
            now_s = self.clock.now_s()
            if out or now_s >= end_s:
                return out
            self.board.advance_to(min(end_s, max(self.board.next_output_s(), now_s + 1e-6), now_s + 0.005))

    def _through(self, out: bytes) -> bytes:
        if self.fault is None:
            return out
        now_s = self.clock.now_s()
        if not self.fault.passes(now_s):
            return b""
        out = self.fault.spoil(out, now_s)
        if self.fault.restart:
            self.fault.restart = False
            self.board.restart()
        if self.fault.crawl:
            self.fault.crawl = False
            self.board.machine.stepper.linger_s = SLOW_S
        if self.fault.unplug:
            self.unplugged = True
            self.fault.unplug = False
        return out


@dataclass
class Watch:
    """A job that only looks."""

    wishes: list[tuple[float, Wish]] = field(default_factory=list)
    clock: VirtualClock | None = None
    limit: int | None = None
    reports: list[Progress] = field(default_factory=list)
    since_s: Callable[[], float] | None = None  # from this moment on, the first report of standstill is noted
    idle_s: float | None = None

    def limit_count(self, now_s: float) -> int | None:
        return self.limit

    def seen(self, progress: Progress, now_s: float) -> None:
        self.reports.append(progress)
        if self.idle_s is None and self.since_s is not None and progress.report is not None:
            at_rest = progress.report.state == "Idle" and now_s > self.since_s()
            self.idle_s = now_s if at_rest else None

    def wish(self) -> Wish:
        if self.wishes and self.clock is not None and self.clock.now_s() >= self.wishes[0][0]:
            return self.wishes.pop(0)[1]
        return ""


def slits(count: int, length_mm: float = 4.0, feed_mm_min: int = 1500) -> list[str]:
    """Return a program of short parallel slits, some of them bent."""
    lines = ["G21", "G90", "G94", "M4S0", f"G0X-200Y-150F{feed_mm_min}S600"]
    for k in range(count):
        x, y = -200 + 1.5 * (k % 40), -150 + 6 * (k // 40)
        lines += [f"G0X{x:g}Y{y:g}", f"G1X{x:g}Y{y + length_mm:g}"]
    return [*lines, "M5", "G4P0.01"]


def lit_while_standing(trace: Sequence[Point]) -> float:
    """Return the longest time in s that the beam was on while the machine stood still."""
    worst = 0.0
    for a, b in itertools.pairwise(trace):
        if a.power_frac > 0 and (a.x_mm, a.y_mm) == (b.x_mm, b.y_mm):
            worst = max(worst, b.t_s - a.t_s)
    return worst
