"""What can go wrong at a device. Each error carries its numbers as fields and says what to do."""

from __future__ import annotations


class DeviceError(Exception):
    """Root of everything the drivers raise."""


class TransportError(DeviceError):
    """The line to the device cannot be opened, or broke."""

    def __init__(self, url: str, reason: str, hint: str = "") -> None:
        super().__init__(url, reason, hint)
        self.url, self.reason, self.hint = url, reason, hint

    def __str__(self) -> str:
        return f"{self.url}: {self.reason}" + (f"; {self.hint}" if self.hint else "")


class DeviceTimeout(DeviceError, TimeoutError):
    """The device did not answer in time."""

    def __init__(self, who: str, what: str, waited_s: float, hint: str = "") -> None:
        super().__init__(who, what, waited_s, hint)
        self.who, self.what, self.waited_s, self.hint = who, what, waited_s, hint

    def __str__(self) -> str:
        return f"{self.who} did not answer {self.what} within {self.waited_s:g} s" + (
            f"; {self.hint}" if self.hint else ""
        )


class ProtocolError(DeviceError):
    """The device said something that its protocol does not allow."""


class DeviceRefused(DeviceError):
    """The device understood and said no."""

    def __init__(self, who: str, command: str, reason: str, hint: str = "") -> None:
        super().__init__(who, command, reason, hint)
        self.who, self.command, self.reason, self.hint = who, command, reason, hint

    def __str__(self) -> str:
        return f"{self.who} refused {self.command!r}: {self.reason}" + (f"; {self.hint}" if self.hint else "")


class DeviceAlarm(DeviceError):
    """The device stopped by itself; where it stands is not known any more."""

    def __init__(self, who: str, code: int, meaning: str, hint: str = "") -> None:
        super().__init__(who, code, meaning, hint)
        self.who, self.code, self.meaning, self.hint = who, code, meaning, hint

    def __str__(self) -> str:
        return f"{self.who} raised alarm {self.code}: {self.meaning}; position lost" + (
            f"; {self.hint}" if self.hint else ""
        )


class InterlockOpen(DeviceError):
    """A door, an emergency stop or an enable chain is open."""
