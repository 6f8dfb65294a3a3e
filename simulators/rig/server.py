"""Puts a rig behind a TCP port or a pseudo-terminal, in real time, on one thread."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from simulators.rig.controller import TICK_S, Controller
from simulators.rig.faults import Delivery, FaultyLine
from simulators.rig.modbus import Request, take_rtu, take_tcp

IDLE_S = 0.005  # how long the controller may run behind while nobody asks
SILENCE_S = 0.01  # after this, a broken request on the serial line is forgotten


@dataclass(frozen=True)
class Pace:
    """How slow the line is: a serial line has a baud rate, silences between frames, and a device that thinks."""

    baud: int = 0
    bits_per_byte_count: int = 11
    turnaround_s: float = 0.0

    def delay_s(self, asked_count: int, answered_count: int) -> float:
        """Return the time from a request's first byte to its reply's last."""
        if not self.baud:
            return self.turnaround_s
        silence_s = max(1.75e-3, 3.5 * self.bits_per_byte_count / self.baud)
        line_s = (asked_count + answered_count) * self.bits_per_byte_count / self.baud
        return line_s + 2 * silence_s + self.turnaround_s

    def asking_s(self, asked_count: int) -> float:
        """Return the time from a request's first byte to the moment the device begins with it."""
        return asked_count * self.bits_per_byte_count / self.baud + 1.75e-3 if self.baud else 0.0


@dataclass
class Link:
    """One open line, with what came and has not been understood yet."""

    handle: int
    serial: bool
    buffer: bytearray = field(default_factory=bytearray)
    heard_s: float = 0.0


class Server:
    """The controller's ticks follow the wall clock; every request is answered at the tick it arrives."""

    def __init__(
        self,
        device: Controller,
        line: FaultyLine,
        pace: Pace,
        unit: int = 1,
        now_s: Callable[[], float] = time.monotonic,
        each_turn: Callable[[], None] = lambda: None,
    ) -> None:
        self.device, self.line, self.pace, self.unit = device, line, pace, unit
        self._now_s, self._each_turn = now_s, each_turn
        self._links: dict[int, Link] = {}
        self._sockets: dict[int, socket.socket] = {}
        self._due: list[tuple[float, int, bytes]] = []
        self._waiting: list[tuple[float, Link, Request]] = []
        self._ran_s = now_s()
        self._listener: socket.socket | None = None
        self._pty_name = ""
        self._pty_other = -1

    def listen_tcp(self, port: int) -> str:
        """Listen on a loopback port (0: any free one); return the URL."""
        self._listener = socket.create_server(("127.0.0.1", port))
        return f"modbus-tcp://127.0.0.1:{self._listener.getsockname()[1]}?unit={self.unit}"

    def listen_rtu(self, path: str) -> str:
        """Open a pseudo-terminal and link `path` to it; return the URL."""
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        link = Path(path)
        if link.is_symlink():
            link.unlink()
        link.symlink_to(os.ttyname(theirs))
        self._pty_name, self._pty_other = path, theirs  # kept open, so that a host may come and go
        os.set_blocking(ours, False)
        self._links[ours] = Link(ours, serial=True)
        return f"modbus-rtu://{link.absolute()}?baud={self.pace.baud or 115200}&parity=N&unit={self.unit}"

    def run(self, going: Callable[[], bool]) -> None:
        """Serve while `going()`."""
        while going():
            self._turn()

    def close(self) -> None:
        """Let go of every line."""
        for handle in list(self._links):
            self._hang_up(handle)
        if self._listener is not None:
            self._listener.close()
        if self._pty_name:
            os.close(self._pty_other)
            Path(self._pty_name).unlink(missing_ok=True)

    def _turn(self) -> None:
        now_s = self._now_s()
        next_s = min([due_s for due_s, *_ in [*self._due, *self._waiting]], default=now_s + IDLE_S)
        handles = list(self._links) + ([self._listener.fileno()] if self._listener else [])
        ready, _, _ = select.select(handles, [], [], min(max(0.0, next_s - now_s), IDLE_S))
        for handle in ready:
            if self._listener is not None and handle == self._listener.fileno():
                self._accept()
            elif handle in self._links:
                self._hear(self._links[handle])
        self._serve_due()
        self._catch_up(self._now_s())
        self._each_turn()

    def _catch_up(self, until_s: float) -> None:
        ticks_count = max(0, int((until_s - self._ran_s) / TICK_S))
        self.device.advance(ticks_count)
        self._ran_s += ticks_count * TICK_S

    def _accept(self) -> None:
        assert self._listener is not None
        other, _ = self._listener.accept()
        other.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        other.setblocking(False)
        self._sockets[other.fileno()] = other
        self._links[other.fileno()] = Link(other.fileno(), serial=False)

    def _hear(self, link: Link) -> None:
        now_s = self._now_s()
        if link.serial and now_s - link.heard_s > SILENCE_S:
            link.buffer.clear()
        try:
            got = os.read(link.handle, 4096)
        except BlockingIOError:
            return
        except OSError:
            got = b""
        if not got:
            self._hang_up(link.handle)
            return
        link.heard_s = now_s
        link.buffer += got
        while request := (take_rtu if link.serial else take_tcp)(link.buffer):
            if request.unit == self.unit:
                asking_s = self.pace.asking_s(request.length_bytes_count) if link.serial else 0.0
                self._waiting.append((now_s + asking_s, link, request))

    def _serve_due(self) -> None:
        now_s = self._now_s()
        for item in sorted((item for item in self._waiting if item[0] <= now_s), key=lambda item: item[0]):
            self._waiting.remove(item)
            # At the tick at which a controller has the whole request, not when this process was woken for it.
            self._catch_up(item[0])
            self._serve(item[0], item[1], item[2])
        self._send_due()

    def _serve(self, began_s: float, link: Link, request: Request) -> None:
        delivery: Delivery = self.line.serve(request, self.device, link.serial)
        if delivery.hang_up:
            self._hang_up(link.handle)
            return
        for delay_s, raw in delivery.parts:
            asked, answered = request.length_bytes_count, len(raw)
            spent_s = self.pace.asking_s(asked) if link.serial else 0.0
            on_line_s = self.pace.delay_s(asked, answered) - spent_s if link.serial else self.pace.turnaround_s
            self._due.append((began_s + on_line_s + delay_s, link.handle, raw))

    def _send_due(self) -> None:
        now_s = self._now_s()
        for part in [part for part in self._due if part[0] <= now_s]:
            self._due.remove(part)
            if part[1] in self._links:
                with contextlib.suppress(OSError):
                    os.write(part[1], part[2])

    def _hang_up(self, handle: int) -> None:
        self._links.pop(handle, None)
        other = self._sockets.pop(handle, None)
        if other is not None:
            other.close()
        else:
            with contextlib.suppress(OSError):
                os.close(handle)
