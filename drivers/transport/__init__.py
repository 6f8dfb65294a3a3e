"""A line to a device: bytes out, bytes in, nothing else. `open_transport(url)` finds the right kind.

`serial:///dev/ttyUSB0?baud=115200` (the path of a pty is a serial path), `tcp://host:port`.
"""

from __future__ import annotations

from typing import Protocol
from urllib.parse import parse_qsl, urlsplit

from drivers.errors import TransportError


class Transport(Protocol):
    """One open line."""

    url: str

    def write(self, data: bytes) -> None:
        """Send all of `data`; raise `TransportError` where the line is broken or takes nothing more."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """Return what has come in, waiting at most `timeout_s` for the first byte; empty on time-out."""
        ...

    def close(self) -> None:
        """Give the line back; harmless when done twice."""
        ...


def open_transport(url: str) -> Transport:
    """Open the line that `url` names; raise `TransportError` saying why it cannot be. A bare path is a serial port."""
    try:
        parts = urlsplit(url)
    except ValueError as fault:
        raise TransportError(url, str(fault), "write serial:///dev/… or tcp://host:port") from fault
    if parts.scheme == "serial" or url.startswith("/"):
        from drivers.transport.serial import SerialTransport

        options = dict(parse_qsl(parts.query))
        unknown = sorted(set(options) - {"baud"})
        if unknown:
            raise TransportError(url, f"unknown option {', '.join(unknown)}", "a serial URL takes ?baud=")
        baud = options.get("baud", "115200")
        if not baud.isdigit():
            raise TransportError(url, f"baud={baud} is not a number", "GRBL talks at 115200")
        return SerialTransport(parts.netloc + parts.path, int(baud), url)
    if parts.scheme == "tcp":
        from drivers.transport.tcp import TcpTransport

        try:
            host, port = parts.hostname, parts.port
        except ValueError as fault:
            raise TransportError(url, str(fault)) from fault
        if not host or port is None:
            raise TransportError(url, "host or port is missing", "write tcp://host:port")
        return TcpTransport(host, port, url)
    raise TransportError(
        url, f"unknown kind of line {parts.scheme!r}", "known: serial:///dev/…?baud=115200, tcp://host:port"
    )
