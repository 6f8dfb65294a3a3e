"""How long a program takes: the board's own acceleration, speeds and corner rule, and its limited look-ahead.

The corner rule is the board's: a corner may be taken as fast as a circle that leaves it by `$11` allows under the
acceleration; the look-ahead must always be able to stop within the moves it holds. Feeds in mm/s, times in s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fabctl.cut.program import Step

STRAIGHT = 0.999999
DWELL_STEP_S = 0.050  # the board pauses in steps of this length
SYNC_S = 0.004  # answering a line that waits for standstill and starting again
SLOWEST_MM_S = 1.0 / 60
STEPPERS_STAY_ON = 255
BITS_PER_BYTE = 10


@dataclass(frozen=True, slots=True)
class Dynamics:
    """What of the board decides the time: `$110/$111`, `$120/$121`, `$11`, planner blocks, steps per mm.

    `lock_s` is how long GRBL stands still for its steppers to settle, whenever its queue has run out (`$1`).
    """

    rate_mm_s: tuple[float, float]
    acceleration_mm_s2: tuple[float, float]
    deviation_mm: float
    planner_count: int = 15
    steps_per_mm: tuple[float, float] = (250.0, 250.0)
    lock_s: float = 0.0

    @classmethod
    def of(cls, settings: dict[int, float], planner_count: int = 15, firmware: str = "grbl") -> Dynamics:
        """Return the dynamics that `$$` describes."""
        lock_ms = settings.get(1, 25.0) if firmware == "grbl" else 0.0  # the others do not wait for it
        return cls(
            rate_mm_s=(settings.get(110, 500.0) / 60, settings.get(111, 500.0) / 60),
            acceleration_mm_s2=(settings.get(120, 10.0), settings.get(121, 10.0)),
            deviation_mm=settings.get(11, 0.01),
            planner_count=planner_count,
            steps_per_mm=(settings.get(100, 250.0), settings.get(101, 250.0)),
            lock_s=0.0 if lock_ms == STEPPERS_STAY_ON else lock_ms / 1000,
        )


@dataclass(frozen=True, slots=True)
class Estimate:
    """`end_s[k]` is when step k is over, counted from the start; `total_s` includes the last pause."""

    end_s: tuple[float, ...]
    total_s: float


@dataclass(slots=True)
class _Block:
    step: int
    length_mm: float
    unit_ratio: tuple[float, float]
    nominal_mm_s: float
    acceleration_mm_s2: float
    corner_mm2_s2: float = 0.0


def estimate(steps: Sequence[Step], dynamics: Dynamics, byte_count: int = 0, baud: int = 115200) -> Estimate:
    """Return when each step ends; `byte_count` and `baud` bound it from below by what the wire can carry."""
    ends = [0.0] * len(steps)
    clock_s, chain = 0.0, list[_Block]()
    for k, step in enumerate(steps):
        if step.sync:
            clock_s = _run(chain, dynamics, clock_s, ends)
            chain = []
            clock_s += SYNC_S + math.ceil(step.dwell_s / DWELL_STEP_S - 1e-9) * DWELL_STEP_S
        block = _block(k, step, dynamics)
        ends[k] = clock_s
        if block is not None:
            if chain:
                block.corner_mm2_s2 = _corner_sq(chain[-1].unit_ratio, block.unit_ratio, dynamics)
            chain.append(block)
    clock_s = _run(chain, dynamics, clock_s, ends)
    _fill(ends)
    wire_s = byte_count * BITS_PER_BYTE / baud
    return Estimate(tuple(ends), max(clock_s, wire_s))


def _block(k: int, step: Step, dynamics: Dynamics) -> _Block | None:
    # The board counts whole steps: a move shorter than half a step is none, and lengths are those of the lattice.
    delta = [
        (round(b * p) - round(a * p)) / p
        for a, b, p in zip(step.start_mm, step.end_mm, dynamics.steps_per_mm, strict=True)
    ]
    length = math.hypot(*delta)
    if length == 0:
        return None
    unit = (delta[0] / length, delta[1] / length)
    rapid = _limit(dynamics.rate_mm_s, unit)
    nominal = max(min(step.speed_mm_s, rapid), SLOWEST_MM_S)
    return _Block(k, length, unit, nominal, _limit(dynamics.acceleration_mm_s2, unit))


def _limit(limits: tuple[float, float], unit: tuple[float, float]) -> float:
    return min(limit / abs(u) for limit, u in zip(limits, unit, strict=True) if u)


def _corner_sq(before: tuple[float, float], after: tuple[float, float], dynamics: Dynamics) -> float:
    cosine = -(before[0] * after[0] + before[1] * after[1])
    if cosine > STRAIGHT:
        return 0.0
    if cosine < -STRAIGHT:
        return math.inf
    across = (after[0] - before[0], after[1] - before[1])
    size = math.hypot(*across)
    acceleration = _limit(dynamics.acceleration_mm_s2, (across[0] / size, across[1] / size))
    half_sine = math.sqrt(0.5 * (1 - cosine))
    return acceleration * dynamics.deviation_mm * half_sine / (1 - half_sine)


def _run(chain: list[_Block], dynamics: Dynamics, clock_s: float, ends: list[float]) -> float:
    """Set the end of every step of a chain that starts and ends at rest; return when it is over."""
    entries = _entry_speeds_sq(chain, max(dynamics.planner_count - 1, 1))  # one of them is being made
    for block, entry_sq, exit_sq in zip(chain, entries[:-1], entries[1:], strict=True) if chain else ():
        clock_s += _time_s(block, entry_sq, exit_sq)
        ends[block.step] = clock_s
    return clock_s + (dynamics.lock_s if chain else 0.0)


def _entry_speeds_sq(chain: list[_Block], window: int) -> list[float]:
    """Return the squared speed at every corner: corner rule, look-ahead of `window` moves, braking and speeding up."""
    n = len(chain)
    limit = [0.0] * (n + 1)
    for k in range(1, n):
        slower = min(chain[k - 1].nominal_mm_s, chain[k].nominal_mm_s)
        limit[k] = min(slower * slower, chain[k].corner_mm2_s2)
    speeds = list(limit)
    for k in range(n - 1, 0, -1):
        speeds[k] = min(speeds[k], speeds[k + 1] + 2 * chain[k].acceleration_mm_s2 * chain[k].length_mm)
    reach = 0.0  # the window must be able to stop within itself
    for k in range(n - 1, 0, -1):
        reach += 2 * chain[k].acceleration_mm_s2 * chain[k].length_mm
        if k + window <= n - 1:
            reach -= 2 * chain[k + window].acceleration_mm_s2 * chain[k + window].length_mm
        speeds[k] = min(speeds[k], max(reach, 0.0))
    for k in range(n):
        speeds[k + 1] = min(speeds[k + 1], speeds[k] + 2 * chain[k].acceleration_mm_s2 * chain[k].length_mm)
    return speeds


def _time_s(block: _Block, entry_sq: float, exit_sq: float) -> float:
    """Return the time of one move that speeds up, cruises and brakes."""
    a, v = block.acceleration_mm_s2, block.nominal_mm_s
    entry, leave = math.sqrt(entry_sq), math.sqrt(exit_sq)
    ramps_mm = (2 * v * v - entry_sq - exit_sq) / (2 * a)
    if ramps_mm <= block.length_mm:
        return (2 * v - entry - leave) / a + (block.length_mm - ramps_mm) / v
    top = math.sqrt(max((2 * a * block.length_mm + entry_sq + exit_sq) / 2, entry_sq, exit_sq))
    return (2 * top - entry - leave) / a


def _fill(ends: list[float]) -> None:
    """Steps that take no time end when the one before them did."""
    latest = 0.0
    for k, end in enumerate(ends):
        latest = max(latest, end)
        ends[k] = latest
