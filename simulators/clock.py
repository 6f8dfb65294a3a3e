"""The simulators' time: the machine's own clock, or the same one running `speed` times as fast."""

from __future__ import annotations

import time


class Clock:
    """Seconds since the simulator began, multiplied by `speed`."""

    def __init__(self, speed: float = 1.0) -> None:
        if speed <= 0:
            raise ValueError(f"the speed of time must be positive, not {speed}")
        self.speed = speed
        self._start_s = time.monotonic()

    def now_s(self) -> float:
        """Return the simulated time."""
        return (time.monotonic() - self._start_s) * self.speed

    def real_s(self, simulated_s: float) -> float:
        """Return how long `simulated_s` takes on the wall."""
        return simulated_s / self.speed
