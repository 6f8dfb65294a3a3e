"""The stage: a motor that follows absolute targets with a limited speed and acceleration, and a screw with play."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class Axis:
    """Position counts downwards from the home switch. The encoder sits on the motor: play is behind it."""

    position_mm: float
    acceleration_mm_s2: float = 50.0
    backlash_mm: float = 0.0
    speed_mm_s: float = 0.0
    _target_mm: float = 0.0
    _wanted_mm_s: float = 0.0
    _tool_mm: float | None = None

    @property
    def standing(self) -> bool:
        """Tell whether the motor stands and has nowhere to go."""
        return self.speed_mm_s == 0.0 and self._wanted_mm_s == 0.0

    @property
    def tool_mm(self) -> float:
        """Return where the tool is: the motor's position less the play of the screw."""
        return self.position_mm if self._tool_mm is None else self._tool_mm

    def go(self, target_mm: float, speed_mm_s: float) -> None:
        """Set out for an absolute position."""
        self._target_mm, self._wanted_mm_s = target_mm, speed_mm_s

    def brake(self) -> None:
        """Come to rest as fast as the acceleration allows."""
        self._wanted_mm_s = 0.0

    def zero(self) -> None:
        """Call this place 0."""
        self._tool_mm = None if self._tool_mm is None else self._tool_mm - self.position_mm
        self.position_mm = 0.0

    def tick(self, dt_s: float) -> None:
        """Let `dt_s` pass."""
        self._drive(dt_s)
        if self.backlash_mm > 0:
            half, tool = self.backlash_mm / 2, self.tool_mm
            self._tool_mm = min(max(tool, self.position_mm - half), self.position_mm + half)

    def _drive(self, dt_s: float) -> None:
        left, gain = self._target_mm - self.position_mm, self.acceleration_mm_s2 * dt_s
        if self._wanted_mm_s == 0.0:
            desired = 0.0
        else:
            # Half a tick ahead, so that the discrete ramp does not overshoot its end.
            ramp = math.sqrt(2 * self.acceleration_mm_s2 * abs(left) + gain**2 / 4) - gain / 2
            desired = math.copysign(min(self._wanted_mm_s, ramp), left)
        change = min(max(desired - self.speed_mm_s, -gain), gain)
        self.speed_mm_s += change
        step = self.speed_mm_s * dt_s
        if self._wanted_mm_s and abs(left) <= max(abs(step), 1e-6) and abs(self.speed_mm_s) <= 2 * gain + 1e-9:
            self.position_mm, self.speed_mm_s, self._wanted_mm_s = self._target_mm, 0.0, 0.0
        else:
            self.position_mm += step
