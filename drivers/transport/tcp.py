"""A TCP connection to a device, or to a serial server in front of it."""

from __future__ import annotations

import errno
import ipaddress
import select
import socket
import sys

from drivers.errors import TransportError

CONNECT_S = 5.0
WRITE_TIMEOUT_S = 1.0


class TcpTransport:
    """One TCP connection, every byte sent at once. A second opener on this machine is told that it is in use."""

    def __init__(self, host: str, port: int, url: str) -> None:
        self.url = url
        self._claim = socket.socket(socket.AF_UNIX)
        try:
            claim(self._claim, host, port)
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as fault:
            self._claim.close()
            raise TransportError(url, *why(fault)) from fault
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
        """End the connection, and give the device free."""
        self._socket.close()
        self._claim.close()


def claim(sign: socket.socket, host: str, port: int) -> None:
    """Take the device at an address for this process, before anything of it is touched; raise `OSError` where it is.

    The sign is a name in Linux's abstract socket space: it counts for everybody on this machine, and ends with the
    process, however that ends. Elsewhere only the bench's own lock counts.
    """
    address = ipaddress.ip_address(
        str(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][4][0]).partition("%")[0]
    )
    if sys.platform == "linux":
        sign.bind(f"\0fabctl-device-{'loopback' if address.is_loopback else address}-{port}")


def why(fault: OSError) -> tuple[str, str]:
    """Return why a device cannot be claimed or connected to, and what to do."""
    if fault.errno == errno.EADDRINUSE:
        return "the device is in use by another program", "close the other sender"
    if isinstance(fault, TimeoutError):
        return f"no answer within {CONNECT_S:g} s", "is the device on the network?"
    return fault.strerror or str(fault), "is the device on, and the port right?"
