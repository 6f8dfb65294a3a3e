"""The board at the end of its wire: bytes in, bytes out, time forward. Nothing here reads a clock.

The receive buffer holds 128 bytes and loses what does not fit; both directions run at the speed of the line.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from simulators.grbl.machine import Asked, Machine, State
from simulators.grbl.system import program

BITS_PER_BYTE = 10  # 8N1
TX_BYTES = 104
TICK_S = 1e-6  # shorter waits are none
UART_BYTES = 2  # what the receiver's own registers hold while the program is deaf
REAL_TIME = {0x3F: Asked.STATUS, 0x7E: Asked.START, 0x21: Asked.HOLD, 0x84: Asked.DOOR}
RESET = 0x18
MOTION_OVERRIDES, ACCESSORY_OVERRIDES = range(0x90, 0x98), range(0x99, 0xA2)


@dataclass(frozen=True, slots=True)
class Point:
    """From `t_s` on, at this place, the beam had this power."""

    t_s: float
    x_mm: float
    y_mm: float
    power_frac: float


@dataclass
class Board:
    """A GRBL board. `receive` takes what the host sends, `advance` lets time pass, `take` gives what has come out."""

    machine: Machine = field(default_factory=Machine)
    baud: float | None = 115200
    trace: Callable[[Point], None] | None = None
    rx_lost_count: int = 0
    _rx: deque[int] = field(default_factory=deque)
    _wire_free_s: float = 0.0
    _out_free_s: float = 0.0
    _deaf_until_s: float = 0.0
    _deaf_count: int = 0
    _wake_s: float = 0.0
    _last_point: Point | None = None

    def __post_init__(self) -> None:
        m = self.machine
        m.say, m.read, m.flush_rx, m.go_deaf = self._say, self._read, self._rx.clear, self._go_deaf
        m.rx_free = lambda: self.rx_bytes - len(self._rx)
        self.rx_bytes = m.dialect.rx_bytes
        self._program = program(m)
        self._wire_in: list[tuple[float, int, int]] = []  # arrival, order, byte
        self._wire_out: deque[tuple[float, bytes]] = deque()  # departure, bytes
        self._order = itertools.count()
        self._byte_s = BITS_PER_BYTE / self.baud if self.baud else 0.0
        self._run()

    def restart(self) -> None:
        """Power the board off and on, as a pulse on DTR does: what it was doing is gone, and so is its position."""
        m = self.machine
        m.stepper.halt(m.now_s)
        m.spindle_off()
        self._note_beam()
        m.state, m.planner.moves = State.IDLE, []
        real = [m.real_mm(k) for k in range(3)]
        m.stepper.stand_at((0, 0, 0))
        m.world.real_mm = (real[0], real[1], real[2])
        self._wire_in.clear()
        self._wire_out.clear()
        self._out_free_s = m.now_s
        self._program = program(m)
        self._run()

    def receive(self, data: bytes) -> None:
        """Put bytes on the wire; each arrives in its turn."""
        self._wire_free_s = max(self._wire_free_s, self.machine.now_s)
        for byte in data:
            self._wire_free_s += self._byte_s
            heapq.heappush(self._wire_in, (self._wire_free_s, next(self._order), byte))

    def take(self) -> bytes:
        """Return the bytes that have come out by now."""
        out = bytearray()
        while self._wire_out and self._wire_out[0][0] <= self.machine.now_s + 1e-12:
            out += self._wire_out.popleft()[1]
        return bytes(out)

    def next_output_s(self) -> float:
        """Return when the next byte comes out, infinity when none is on its way."""
        return self._wire_out[0][0] if self._wire_out else math.inf

    def next_event_s(self) -> float:
        """Return when something happens next by itself."""
        arrival = self._wire_in[0][0] if self._wire_in else math.inf
        return min(arrival, self.machine.stepper.running_until_s, self._wake_s)

    def advance_to(self, until_s: float) -> None:
        """Let time pass until `until_s`."""
        m = self.machine
        while (at_s := self.next_event_s()) <= until_s:
            m.now_s = max(m.now_s, at_s)
            worth_a_look = self._arrivals()
            if m.stepper.running_until_s <= m.now_s:
                self._segment_done()
                worth_a_look = True
            asleep = not math.isinf(self._wake_s)
            if (asleep and self._wake_s <= m.now_s) or (not asleep and worth_a_look):
                self._run()
        m.now_s = max(m.now_s, until_s)

    def _run(self) -> None:
        """Let the program go on until it waits; it stalls while its transmit buffer is full."""
        m = self.machine
        if m.stalled_until_s > m.now_s + TICK_S:
            self._wake_s = m.stalled_until_s
            return
        if (
            self._byte_s
            and self._out_free_s - m.now_s > TX_BYTES * self._byte_s + TICK_S
            and Asked.RESET not in m.asked
        ):
            self._wake_s = self._out_free_s - TX_BYTES * self._byte_s
            return
        self._wake_s = next(self._program)
        self._note_beam()

    def _arrivals(self) -> bool:
        """Take what has arrived; return whether the program has reason to look."""
        look = False
        m = self.machine
        while self._wire_in and self._wire_in[0][0] <= m.now_s:
            byte = heapq.heappop(self._wire_in)[2]
            if m.now_s < self._deaf_until_s:
                self._deaf_count += 1
                if self._deaf_count > UART_BYTES:
                    self.rx_lost_count += 1
                    continue
            look |= self._interrupt(byte)
        return look

    def _interrupt(self, byte: int) -> bool:
        """Do what the receive interrupt does with one byte."""
        m = self.machine
        if byte == RESET:
            m.kill()
            self._go_deaf(m.stalled_until_s)
            self._note_beam()
        elif byte in REAL_TIME:
            m.asked |= REAL_TIME[byte]
        elif byte in MOTION_OVERRIDES:
            m.motion_override.append(byte)
        elif byte in ACCESSORY_OVERRIDES:
            m.accessory_override.append(byte)
        elif byte == 0x85:
            m.asked |= Asked.MOTION_CANCEL if m.state is State.JOG else Asked.NOTHING
        elif byte < 0x80:
            if len(self._rx) >= self.rx_bytes:
                self.rx_lost_count += 1
                return False
            self._rx.append(byte)
            return byte in b"\r\n" or len(self._rx) > self.rx_bytes - 40
        return True

    def _segment_done(self) -> None:
        m = self.machine
        if m.stepper.finish():
            m.stepper.start(m.now_s)
        else:
            m.asked |= Asked.CYCLE_DONE
            m.stall()
        if m.memory.on(21):
            m.watch_switches()
        self._note_beam()

    def _note_beam(self) -> None:
        if self.trace is None:
            return
        m = self.machine
        x_mm, y_mm, _ = m.position_mm()
        point = Point(m.now_s, x_mm, y_mm, m.pin.power_frac)
        last = self._last_point
        if last is None or (point.x_mm, point.y_mm, point.power_frac) != (last.x_mm, last.y_mm, last.power_frac):
            self.trace(point)
            self._last_point = point

    def _say(self, text: str) -> None:
        data = text.encode("latin-1")
        at_s = max(self._out_free_s, self.machine.now_s)
        self._out_free_s = at_s + len(data) * self._byte_s
        self._wire_out.append((self._out_free_s, data))

    def _read(self) -> int | None:
        return self._rx.popleft() if self._rx else None

    def _go_deaf(self, until_s: float) -> None:
        if until_s > self._deaf_until_s:
            self._deaf_until_s, self._deaf_count = until_s, 0
