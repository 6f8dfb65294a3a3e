"""A line that never leaves the process: two functions, so that a test can put anything behind it, in virtual time."""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import TransportError


class MemoryTransport:
    """`send(data)` takes what is written; `receive(timeout_s)` returns what comes back and lets the time pass."""

    def __init__(
        self, send: Callable[[bytes], None], receive: Callable[[float], bytes], url: str = "memory://device"
    ) -> None:
        self.url = url
        self._send, self._receive = send, receive
        self._open = True

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        self._check()
        self._send(data)

    def read(self, timeout_s: float) -> bytes:
        """Return what has come in, waiting at most `timeout_s` of the peer's time."""
        self._check()
        return self._receive(timeout_s)

    def close(self) -> None:
        """End it."""
        self._open = False

    def _check(self) -> None:
        if not self._open:
            raise TransportError(self.url, "the line is closed")
