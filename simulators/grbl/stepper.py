"""From planned moves to steps: segments of about 10 ms, five of them prepared ahead, and the laser pin that goes along.

What reports show as speed and power is that of the segment prepared last; the position is that of the segment running.
The difference is why a hold reads `FS:0` some 50 ms before the machine stands.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

from simulators.grbl.planner import Move, Planner
from simulators.grbl.settings import Memory

SEGMENT_S = 0.010
AHEAD = 5  # segments prepared, the running one included
LEAST_STEPS = 1.25  # a segment is stretched until it holds this much
EPSILON_MM = 1e-9

ACCELERATE, CRUISE, BRAKE, BRAKE_TO_CRUISE = range(4)


class Duty(Protocol):
    """From an S word to the pin's duty."""

    def __call__(self, s_count: float, /) -> float:
        """Return the duty, 0 to 1."""
        ...


@dataclass(slots=True)
class Pin:
    """The laser's output. `power_frac` is its duty; `ccw` tells M4 from M3."""

    power_frac: float = 0.0
    ccw: bool = False


@dataclass(slots=True, eq=False)
class Stretch:
    """One planned move as the step generator sees it: where it starts, and how far along it is."""

    start: tuple[int, int, int]
    steps: tuple[int, int, int]
    step_events: int
    dynamic: bool  # M4: power follows speed, and is off at the end
    done: int = 0

    def at(self, events: int) -> tuple[int, int, int]:
        """Return the position in steps after so many step events."""
        x, y, z = (s + _nearest(d * events / self.step_events) for s, d in zip(self.start, self.steps, strict=True))
        return x, y, z


@dataclass(slots=True, eq=False)
class Segment:
    """Some whole steps at one rate and one power."""

    stretch: Stretch
    events: int
    duration_s: float
    power_frac: float


@dataclass
class Stepper:
    """Prepares segments from the planner (`prepare`) and runs them in time (`start`, `finish`)."""

    planner: Planner
    memory: Memory
    pin: Pin
    duty: Duty  # S word -> duty; also notes the speed that reports show
    position: tuple[int, int, int] = (0, 0, 0)
    system_move: Move | None = None
    holding: bool = False
    ended: bool = False  # no more segments until the hold or the system move is settled
    update_pin: bool = False
    speed_mm_s: float = 0.0  # of the segment prepared last
    linger_s: float = 0.0  # so much longer takes the next segment to be run, on demand of a fault
    awake: bool = False
    segments: deque[Segment] = field(default_factory=deque)
    locked: set[int] = field(default_factory=set)  # axes that homing has stopped
    running_until_s: float = math.inf
    _running_from_s: float = 0.0
    _move: Move | None = None
    _recalculate: bool = False
    _brake_over: bool = False
    _ramp: int = CRUISE
    _complete_mm: float = 0.0
    _accelerate_until_mm: float = 0.0
    _brake_after_mm: float = 0.0
    _top_mm_s: float = 0.0
    _exit_mm_s: float = 0.0
    _left_count: float = 0.0
    _steps_per_mm: float = 0.0
    _rest_s: float = 0.0
    _duty_frac: float = 0.0
    _stretch: Stretch | None = None
    _end: tuple[int, int, int] = (0, 0, 0)  # where the last stretch that was opened ends

    def halt(self, now_s: float) -> None:
        """Stop dead where the machine is; the steps not yet made are lost."""
        self.position = self.position_at(now_s)
        self.segments.clear()
        self.running_until_s = math.inf
        self.awake = False

    def reset(self, now_s: float) -> None:
        """Halt and forget everything prepared; the position stays."""
        self.halt(now_s)
        self.awake = self.holding = self.ended = self.update_pin = False
        self._recalculate = self._brake_over = False
        self.system_move = self._move = self._stretch = None
        self.speed_mm_s = self._duty_frac = self._rest_s = 0.0
        self.locked = set()
        self._end = self.position

    def look_again(self) -> None:
        """Compute the running move's profile anew from the speed it has now; the planner asks for this."""
        if self._move is not None:
            self._recalculate = True
            self._move.entry_mm2_s2 = self.speed_mm_s**2
            self._move = None

    def prepare(self) -> None:
        """Fill the segment queue as far as the planned moves reach."""
        while not self.ended and len(self.segments) < AHEAD:
            if self._move is None and not self._load():
                return
            if not self._make_segment():
                return

    def _load(self) -> bool:
        move = self.system_move if self.system_move is not None else self._next_move()
        if move is None:
            return False
        self._move = move
        if self._recalculate:
            self._recalculate = False
        else:
            dynamic = self.memory.on(32) and move.spindle == 4
            self._stretch = Stretch(self._end, move.steps, move.step_events, dynamic)
            self._end = self._stretch.at(move.step_events)
            self._left_count = float(move.step_events)
            self._steps_per_mm = move.step_events / move.left_mm
            self._rest_s = 0.0
            if self.holding or self._brake_over:
                self.speed_mm_s = self._exit_mm_s
                move.entry_mm2_s2 = self._exit_mm_s**2
                self._brake_over = False
            else:
                self.speed_mm_s = math.sqrt(move.entry_mm2_s2)
        self._profile(move)
        self.update_pin = True
        return True

    def _next_move(self) -> Move | None:
        return self.planner.moves[0] if self.planner.moves else None

    def _profile(self, move: Move) -> None:
        self._complete_mm = 0.0
        per_2a = 0.5 / move.acceleration_mm_s2
        if self.holding:
            self._ramp = BRAKE
            stop_mm = move.left_mm - per_2a * move.entry_mm2_s2
            if stop_mm < 0:
                self._exit_mm_s = math.sqrt(max(move.entry_mm2_s2 - 2 * move.acceleration_mm_s2 * move.left_mm, 0.0))
            else:
                self._complete_mm, self._exit_mm_s = stop_mm, 0.0
            return
        exit_sq = 0.0 if self.system_move is not None else self.planner.exit_sq()
        nominal = move.feed_mm_s if self.system_move is not None else self.planner.nominal_mm_s(move)
        self._exit_mm_s = math.sqrt(exit_sq)
        self._ramp = ACCELERATE
        self._accelerate_until_mm = move.left_mm
        nominal_sq = nominal * nominal
        meet_mm = 0.5 * (move.left_mm + per_2a * (move.entry_mm2_s2 - exit_sq))
        if move.entry_mm2_s2 > nominal_sq:
            self._accelerate_until_mm = move.left_mm - per_2a * (move.entry_mm2_s2 - nominal_sq)
            if self._accelerate_until_mm <= 0:
                self._ramp = BRAKE
                self._exit_mm_s = math.sqrt(max(move.entry_mm2_s2 - 2 * move.acceleration_mm_s2 * move.left_mm, 0.0))
                self._brake_over = True
            else:
                self._brake_after_mm = per_2a * (nominal_sq - exit_sq)
                self._top_mm_s, self._ramp = nominal, BRAKE_TO_CRUISE
        elif meet_mm <= 0:
            self._accelerate_until_mm, self._brake_after_mm, self._top_mm_s = 0.0, 0.0, self._exit_mm_s
        elif meet_mm >= move.left_mm:
            self._ramp = BRAKE
        else:
            self._brake_after_mm = per_2a * (nominal_sq - exit_sq)
            if self._brake_after_mm < meet_mm:
                self._top_mm_s = nominal
                if move.entry_mm2_s2 == nominal_sq:
                    self._ramp = CRUISE
                else:
                    self._accelerate_until_mm -= per_2a * (nominal_sq - move.entry_mm2_s2)
            else:
                self._accelerate_until_mm = self._brake_after_mm = meet_mm
                self._top_mm_s = math.sqrt(2 * move.acceleration_mm_s2 * meet_mm + exit_sq)

    def _make_segment(self) -> bool:
        move, stretch = self._move, self._stretch
        assert move is not None and stretch is not None
        left_mm, duration_s = self._advance(move)
        self._set_duty(move, stretch)
        exact = self._steps_per_mm * left_mm
        steps_left = math.ceil(exact - 1e-7)
        events = math.ceil(self._left_count - 1e-7) - steps_left
        if events == 0 and self.holding:
            self.ended = True
            return False
        duration_s += self._rest_s
        moved = math.ceil(self._left_count - 1e-7) - exact
        per_step_s = duration_s / moved if moved > 0 else 0.0
        if events > 0:
            self.segments.append(Segment(stretch, events, events * per_step_s, self._duty_frac))
        self._rest_s = (steps_left - exact) * per_step_s
        self._left_count = float(steps_left)
        move.left_mm = left_mm
        if left_mm <= self._complete_mm + EPSILON_MM:
            if left_mm > EPSILON_MM:
                self.ended = True
                return False
            if self.system_move is not None:
                self.ended = True
                return False
            self._move = None
            self.planner.discard()
        return True

    def _advance(self, move: Move) -> tuple[float, float]:
        """Return what is left of `move` after one more segment, and how long that segment takes."""
        limit_s, spent_s, part_s = SEGMENT_S, 0.0, SEGMENT_S
        left = move.left_mm
        least = max(left - LEAST_STEPS / self._steps_per_mm, 0.0)
        while True:
            left, part_s = self._ramp_step(move, left, part_s)
            spent_s += part_s
            if spent_s < limit_s - 1e-12:
                part_s = limit_s - spent_s
            elif left > least:
                limit_s += SEGMENT_S
                part_s = limit_s - spent_s
            else:
                break
            if left <= self._complete_mm + EPSILON_MM:
                break
        return left, spent_s

    def _ramp_step(self, move: Move, left: float, part_s: float) -> tuple[float, float]:
        """Move on for `part_s` or to the end of the present ramp; return what is left and the time that took."""
        change = move.acceleration_mm_s2 * part_s
        if self._ramp == BRAKE_TO_CRUISE:
            if self.speed_mm_s - self._top_mm_s <= change:
                part_s = 2 * (left - self._accelerate_until_mm) / (self.speed_mm_s + self._top_mm_s)
                self._ramp, self.speed_mm_s = CRUISE, self._top_mm_s
                return self._accelerate_until_mm, part_s
            left -= part_s * (self.speed_mm_s - 0.5 * change)
            self.speed_mm_s -= change
            return left, part_s
        if self._ramp == ACCELERATE:
            after = left - part_s * (self.speed_mm_s + 0.5 * change)
            if after < self._accelerate_until_mm:
                part_s = 2 * (left - self._accelerate_until_mm) / (self.speed_mm_s + self._top_mm_s)
                self._ramp = BRAKE if self._accelerate_until_mm == self._brake_after_mm else CRUISE
                self.speed_mm_s = self._top_mm_s
                return self._accelerate_until_mm, part_s
            self.speed_mm_s += change
            return after, part_s
        if self._ramp == CRUISE:
            after = left - self._top_mm_s * part_s
            if after < self._brake_after_mm:
                part_s = (left - self._brake_after_mm) / self._top_mm_s
                self._ramp = BRAKE
                return self._brake_after_mm, part_s
            return after, part_s
        if self.speed_mm_s > change:
            after = left - part_s * (self.speed_mm_s - 0.5 * change)
            if after > self._complete_mm:
                self.speed_mm_s -= change
                return after, part_s
        total = self.speed_mm_s + self._exit_mm_s
        part_s = 2 * (left - self._complete_mm) / total if total > 0 else 0.0
        self.speed_mm_s = self._exit_mm_s
        return self._complete_mm, part_s

    def _set_duty(self, move: Move, stretch: Stretch) -> None:
        if not (stretch.dynamic or self.update_pin):
            return
        if move.spindle in (3, 4):
            speed = move.s_count
            if stretch.dynamic and move.feed_mm_s > 0:
                speed *= self.speed_mm_s / move.feed_mm_s
            self._duty_frac = self.duty(speed)
        else:
            self._duty_frac = self.duty(0.0)
        self.update_pin = False

    def start(self, now_s: float) -> None:
        """Run the oldest segment from now on."""
        segment = self.segments[0]
        if self.linger_s:
            whole_s = segment.duration_s + self.linger_s
            segment.power_frac *= segment.duration_s / whole_s  # the beam follows the speed
            segment.duration_s, self.linger_s = whole_s, 0.0
        self._running_from_s, self.running_until_s = now_s, now_s + segment.duration_s
        self.pin.power_frac = segment.power_frac

    def finish(self) -> bool:
        """End the running segment; return whether another waits."""
        segment = self.segments.popleft()
        stretch = segment.stretch
        stretch.done += segment.events
        self.position = self._free(stretch.at(stretch.done))
        self.running_until_s = math.inf
        if self.segments:
            return True
        self.awake = False
        if stretch.dynamic:
            self.pin.power_frac = 0.0
        return False

    def position_at(self, now_s: float) -> tuple[int, int, int]:
        """Return where the machine is, in steps."""
        if not self.segments or math.isinf(self.running_until_s):
            return self.position
        segment = self.segments[0]
        share = (now_s - self._running_from_s) / segment.duration_s if segment.duration_s > 0 else 1.0
        events = segment.stretch.done + int(min(max(share, 0.0), 1.0) * segment.events)
        return self._free(segment.stretch.at(events))

    def _free(self, position: tuple[int, int, int]) -> tuple[int, int, int]:
        x, y, z = (self.position[k] if k in self.locked else position[k] for k in range(3))
        return x, y, z

    def stand_at(self, position: tuple[int, int, int]) -> None:
        """Declare where the machine is (homing, and stopping in motion)."""
        self.position = self._end = position


def _nearest(value: float) -> int:
    return math.floor(value + 0.5) if value >= 0 else -math.floor(-value + 0.5)
