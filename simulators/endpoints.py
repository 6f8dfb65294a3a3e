"""Put a machine of bytes behind a pty or a TCP port, so that nobody can tell it from a real one.

A pty is entered like a serial port: its path is a link that the caller names. Opening it may pulse DTR; an endpoint
tells the machine when somebody opens the line, and the machine decides what that means.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import tty
from pathlib import Path
from typing import Protocol


class Endpoint(Protocol):
    """One line to one host."""

    url: str

    def exchange(self, out: bytes, timeout_s: float) -> tuple[bytes, bool]:
        """Send `out`, wait for input at most `timeout_s`; return what came, and whether the line was opened anew."""
        ...

    def unplug(self) -> None:
        """Break the line, as a pulled plug does."""
        ...

    def close(self) -> None:
        """Take the line away."""
        ...


class PtyEndpoint:
    """A pseudo terminal; `path` becomes a link to its slave side."""

    def __init__(self, path: Path, baud: int = 115200) -> None:
        self._path = path
        self._waiting = bytearray()
        self._open = False
        self.url = f"serial://{path}?baud={baud}"
        self._master = -1
        self._plug_in()

    def _plug_in(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        if self._path.is_symlink() or self._path.exists():
            self._path.unlink()
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def exchange(self, out: bytes, timeout_s: float) -> tuple[bytes, bool]:
        """Send, wait, receive. While nobody has the line open, what is sent is lost."""
        if self._master < 0:
            select.select([], [], [], timeout_s)
            return b"", False
        poller = select.poll()
        poller.register(self._master, select.POLLIN | (select.POLLOUT if self._waiting else 0))
        state = dict(poller.poll(0)).get(self._master, 0)
        present = not state & select.POLLHUP
        opened, self._open = present and not self._open, present
        if not present:
            self._waiting.clear()
            select.select([], [], [], min(timeout_s, 0.02))
            return b"", False
        self._waiting += out
        self._push()
        select.select([self._master], [self._master] if self._waiting else [], [], timeout_s)
        try:
            return os.read(self._master, 4096), opened
        except BlockingIOError:
            return b"", opened
        except OSError:  # the other side closed between the poll and the read
            return b"", opened

    def _push(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):
            while self._waiting:
                del self._waiting[: os.write(self._master, bytes(self._waiting[:1024]))]

    def unplug(self) -> None:
        """Hang up; the path is gone until `replug`."""
        if self._master >= 0:
            os.close(self._master)
            self._master = -1
            self._path.unlink(missing_ok=True)
        self._waiting.clear()
        self._open = False

    def replug(self) -> None:
        """Put the line back under the same path."""
        if self._master < 0:
            self._plug_in()

    def close(self) -> None:
        """Hang up and remove the path."""
        self.unplug()


class TcpEndpoint:
    """A TCP port on the loopback interface, one host at a time; port 0 lets the system choose."""

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self._peer: socket.socket | None = None
        self._waiting = bytearray()
        self.url = f"tcp://{host}:{self._server.getsockname()[1]}"

    def exchange(self, out: bytes, timeout_s: float) -> tuple[bytes, bool]:
        """Send, wait, receive; a new host takes the place of none."""
        if self._peer is None:
            ready, _, _ = select.select([self._server], [], [], timeout_s)
            if not ready:
                return b"", False
            self._peer, _ = self._server.accept()
            self._peer.setblocking(False)
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b"", True
        self._waiting += out
        try:
            if self._waiting:
                with contextlib.suppress(BlockingIOError):
                    del self._waiting[: self._peer.send(bytes(self._waiting))]
            ready, _, _ = select.select([self._peer], [self._peer] if self._waiting else [], [], timeout_s)
            if not ready:
                return b"", False
            data = self._peer.recv(4096)
        except OSError:
            data = b""
        if not data:
            self.unplug()
        return data, False

    def unplug(self) -> None:
        """Drop the host."""
        if self._peer is not None:
            self._peer.close()
            self._peer = None
        self._waiting.clear()

    def replug(self) -> None:
        """Nothing to do: the port goes on listening."""

    def close(self) -> None:
        """Stop listening."""
        self.unplug()
        self._server.close()
