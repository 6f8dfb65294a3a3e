"""A TCP connection to a device, or to a serial server in front of it."""

from __future__ import annotations

import select
import socket

from drivers.errors import TransportError

CONNECT_S = 5.0
WRITE_TIMEOUT_S = 1.0


class TcpTransport:
    """One TCP connection, every byte sent at once."""

    def __init__(self, host: str, port: int, url: str) -> None:
        self.url = url
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except TimeoutError as fault:
            raise TransportError(url, f"no answer within {CONNECT_S:g} s", "is the device on the network?") from fault
        except OSError as fault:
            raise TransportError(url, fault.strerror or str(fault), "is the device on, and the port right?") from fault
        self._socket.settimeout(WRITE_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self._socket.sendall(data)
        except TimeoutError as fault:
            raise TransportError(self.url, "the connection takes no more bytes", "is the device frozen?") from fault
        except OSError as fault:
            raise TransportError(self.url, "the connection broke while sending", "was it unplugged?") from fault

    def read(self, timeout_s: float) -> bytes:
        """Return what has come in, waiting at most `timeout_s`."""
        try:
            ready, _, _ = select.select([self._socket], [], [], max(timeout_s, 0.0))
            if not ready:
                return b""
            data = self._socket.recv(4096)
        except (OSError, ValueError) as fault:
            raise TransportError(self.url, "the connection broke", "was it unplugged?") from fault
        if not data:
            raise TransportError(self.url, "the device closed the connection", "was it unplugged?")
        return data

    def close(self) -> None:
        """End the connection."""
        self._socket.close()
