"""The look-ahead: fifteen moves, joined at speeds that keep every corner within the junction deviation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from simulators.grbl.modes import Vector
from simulators.grbl.settings import Memory
from simulators.grbl.words import f32

CAPACITY = 15
MIN_RATE_MM_S = 1.0 / 60
FAST = 1e38
STRAIGHT = 0.999999  # cosine beyond which two moves count as one line, or as a full turn back


@dataclass(slots=True, eq=False)
class Move:
    """One straight move. `left_mm` shrinks as it is handed to the stepper. Speeds in mm/s."""

    steps: tuple[int, int, int]
    step_events: int
    left_mm: float
    acceleration_mm_s2: float
    rapid_mm_s: float
    feed_mm_s: float
    spindle: int
    s_count: float
    rapid: bool
    no_override: bool
    entry_mm2_s2: float = 0.0
    max_entry_mm2_s2: float = 0.0
    max_junction_mm2_s2: float = 0.0


def _nobody() -> None:
    pass


@dataclass
class Overrides:
    """Percentages, 100 at reset."""

    feed: int = 100
    rapid: int = 100
    spindle: int = 100


@dataclass
class Planner:
    """The moves waiting, oldest first. `planned` is the index up to which nothing can be improved any more."""

    memory: Memory
    overrides: Overrides
    capacity_count: int = CAPACITY
    moves: list[Move] = field(default_factory=list)
    planned: int = 0
    position_steps: tuple[int, int, int] = (0, 0, 0)
    last_unit_ratio: Vector = (0.0, 0.0, 0.0)
    last_nominal_mm_s: float = 0.0
    notify: Callable[[], None] = _nobody  # the running move's exit may change: the stepper must look again

    @property
    def full(self) -> bool:
        """Return whether no further move fits."""
        return len(self.moves) >= self.capacity_count

    def reset(self, position_steps: tuple[int, int, int]) -> None:
        """Forget every move; stand at `position_steps`."""
        self.moves, self.planned, self.position_steps = [], 0, position_steps
        self.last_unit_ratio, self.last_nominal_mm_s = (0.0, 0.0, 0.0), 0.0

    def build(
        self,
        target_mm: Vector,
        origin_steps: tuple[int, int, int],
        feed: float,
        inverse_time: bool,
        spindle: int,
        speed: float,
        rapid: bool,
        no_override: bool,
    ) -> tuple[Move, Vector, tuple[int, int, int]] | None:
        """Return the move to `target_mm`, its direction and its goal in steps; None where it has no step to make."""
        per_mm = self.memory.axes(100)
        goal = tuple(_round(f32(t * p)) for t, p in zip(target_mm, per_mm, strict=True))
        delta = [g - o for g, o in zip(goal, origin_steps, strict=True)]
        events = max(abs(d) for d in delta)
        if events == 0:
            return None
        unit, length_mm = _unit([d / p for d, p in zip(delta, per_mm, strict=True)])
        feed_mm_s = feed / 60 * (length_mm if inverse_time else 1.0)
        move = Move(
            steps=(delta[0], delta[1], delta[2]),
            step_events=events,
            left_mm=length_mm,
            acceleration_mm_s2=_limited(self.memory.axes(120), unit),
            rapid_mm_s=_limited(self.memory.axes(110), unit) / 60,
            feed_mm_s=feed_mm_s,
            spindle=spindle,
            s_count=speed,
            rapid=rapid,
            no_override=no_override,
        )
        return move, unit, (goal[0], goal[1], goal[2])

    def add(self, move: Move, unit: Vector, goal: tuple[int, int, int]) -> None:
        """Append `move` and plan again."""
        if self.moves:
            move.max_junction_mm2_s2 = self._junction_sq(unit)
        nominal = self.nominal_mm_s(move)
        _limit_entry(move, nominal, self.last_nominal_mm_s)
        self.last_nominal_mm_s, self.last_unit_ratio, self.position_steps = nominal, unit, goal
        self.moves.append(move)
        self.plan()

    def _junction_sq(self, unit: Vector) -> float:
        cosine = -sum(a * b for a, b in zip(self.last_unit_ratio, unit, strict=True))
        if cosine > STRAIGHT:
            return 0.0
        if cosine < -STRAIGHT:
            return FAST
        across, _ = _unit([b - a for a, b in zip(self.last_unit_ratio, unit, strict=True)])
        acceleration = _limited(self.memory.axes(120), across)
        half_sine = math.sqrt(0.5 * (1.0 - cosine))
        return acceleration * self.memory[11] * half_sine / (1.0 - half_sine)

    def nominal_mm_s(self, move: Move) -> float:
        """Return the speed `move` would like, with the overrides of the moment."""
        if move.rapid:
            wanted = move.rapid_mm_s * 0.01 * self.overrides.rapid
        else:
            wanted = move.feed_mm_s * (1.0 if move.no_override else 0.01 * self.overrides.feed)
            wanted = min(wanted, move.rapid_mm_s)
        return max(wanted, MIN_RATE_MM_S)

    def exit_sq(self) -> float:
        """Return the squared speed at which the running move hands over to the next; 0 at the end of the queue."""
        return self.moves[1].entry_mm2_s2 if len(self.moves) > 1 else 0.0

    def discard(self) -> None:
        """Drop the oldest move; the stepper has taken all of it."""
        self.moves.pop(0)
        self.planned = max(self.planned - 1, 0)

    def override_changed(self) -> None:
        """Set every corner's limit anew after an override."""
        before = FAST
        for move in self.moves:
            nominal = self.nominal_mm_s(move)
            _limit_entry(move, nominal, before)
            before = nominal
        self.last_nominal_mm_s = before

    def replan(self) -> None:
        """Plan everything again from the running move, whose entry speed the stepper has set."""
        self.notify()
        self.planned = 0
        self.plan()

    def plan(self) -> None:
        """Make every corner as fast as braking to zero at the queue's end allows."""
        moves, last = self.moves, len(self.moves) - 1
        if last <= self.planned:
            return
        moves[last].entry_mm2_s2 = min(
            moves[last].max_entry_mm2_s2, 2 * moves[last].acceleration_mm_s2 * moves[last].left_mm
        )
        for k in range(last - 1, self.planned, -1):
            move = moves[k]
            if move.entry_mm2_s2 != move.max_entry_mm2_s2:
                reachable = moves[k + 1].entry_mm2_s2 + 2 * move.acceleration_mm_s2 * move.left_mm
                move.entry_mm2_s2 = min(reachable, move.max_entry_mm2_s2)
        if self.planned == 0:
            self.notify()
        for k in range(self.planned, last):
            move, following = moves[k], moves[k + 1]
            if move.entry_mm2_s2 < following.entry_mm2_s2:
                reachable = move.entry_mm2_s2 + 2 * move.acceleration_mm_s2 * move.left_mm
                if reachable < following.entry_mm2_s2:
                    following.entry_mm2_s2 = reachable
                    self.planned = k + 1
            if following.entry_mm2_s2 == following.max_entry_mm2_s2:
                self.planned = k + 1


def _limit_entry(move: Move, nominal: float, before: float) -> None:
    move.max_entry_mm2_s2 = min(min(nominal, before) ** 2, move.max_junction_mm2_s2)


def _round(value: float) -> int:
    if not abs(value) < 2**31:
        return -(2**31)  # what the firmware's library answers beyond its range
    return math.floor(abs(value) + 0.5) * (1 if value >= 0 else -1)


def _unit(vector: list[float]) -> tuple[Vector, float]:
    length = math.sqrt(sum(v * v for v in vector))
    return (vector[0] / length, vector[1] / length, vector[2] / length), length


def _limited(limits: tuple[float, float, float], unit: Vector) -> float:
    return min((abs(limit / u) for limit, u in zip(limits, unit, strict=True) if u != 0), default=FAST)
