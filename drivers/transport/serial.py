"""A serial port, opened for us alone."""

from __future__ import annotations

import os
import select
from pathlib import Path

import serial

from drivers.errors import TransportError

WRITE_TIMEOUT_S = 1.0


class SerialTransport:
    """One serial port, 8N1. A second opener is told that the port is busy."""

    def __init__(self, path: str, baud: int, url: str) -> None:
        self.url = url
        try:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as fault:
            raise TransportError(url, *_why(path, fault)) from fault

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self._port.write(data)
        except serial.SerialTimeoutException as fault:
            raise TransportError(self.url, "the port takes no more bytes", "is the device frozen?") from fault
        except (serial.SerialException, OSError) as fault:
            raise TransportError(self.url, "the line broke while sending", "was it unplugged?") from fault

    def read(self, timeout_s: float) -> bytes:
        """Return what has come in, waiting at most `timeout_s`."""
        try:
            ready, _, _ = select.select([self._port.fileno()], [], [], max(timeout_s, 0.0))
            if not ready:
                return b""
            data = os.read(self._port.fileno(), 4096)
        except (serial.SerialException, OSError, ValueError) as fault:
            raise TransportError(self.url, "the line broke", "was it unplugged?") from fault
        if not data:
            raise TransportError(self.url, "the line broke", "was it unplugged?")
        return data

    def close(self) -> None:
        """Give the port back."""
        self._port.close()


def _why(path: str, fault: Exception) -> tuple[str, str]:
    text = str(fault)
    if "lock" in text or "Resource temporarily unavailable" in text or "busy" in text.lower():
        return "the port is in use by another program", "close the other sender"
    if isinstance(fault, ValueError):
        return text, ""
    if not Path(path).exists():
        return "no such port", "is the device plugged in? `ls /dev/serial/by-id/` lists the ports"
    if not os.access(path, os.R_OK | os.W_OK):
        return "not allowed", "add yourself to the group that owns the port (often dialout)"
    return "cannot be opened as a serial port", text
