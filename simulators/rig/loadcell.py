"""The load cell: a true force in, what the converter makes of it out."""

from __future__ import annotations

import random
from dataclasses import dataclass, field


@dataclass
class LoadCell:
    """Gain, zero, drift, noise and saturation. `drift_N_s` is the slow creep of the zero, plus a random walk."""

    capacity_N: float = 50.0
    gain_ratio: float = 1.0
    zero_N: float = 0.0
    drift_N_s: float = 0.0
    wander_N_sqrt_s: float = 0.0
    noise_N: float = 0.0
    rng: random.Random = field(default_factory=random.Random)

    def tick(self, dt_s: float) -> None:
        """Let the zero drift."""
        self.zero_N += self.drift_N_s * dt_s
        if self.wander_N_sqrt_s:
            self.zero_N += self.rng.gauss(0.0, self.wander_N_sqrt_s * dt_s**0.5)

    def convert(self, true_N: float) -> tuple[float, bool]:
        """Return (reported force, saturated)."""
        shown = self.gain_ratio * true_N + self.zero_N
        if self.noise_N:
            shown += self.rng.gauss(0.0, self.noise_N)
        limit = 1.1 * self.capacity_N
        return min(max(shown, -limit), limit), abs(shown) >= limit
