"""The whole state of the board, and the few acts that interrupt handlers may do to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from enum import Enum, Flag, auto

from simulators.grbl.dialects import GRBL, Dialect
from simulators.grbl.modes import Modes, Parser
from simulators.grbl.planner import Overrides, Planner
from simulators.grbl.settings import Memory
from simulators.grbl.stepper import Pin, Stepper
from simulators.grbl.words import f32

Program = Generator[float, None, None]
"""A part of the firmware's program. It yields until when it sleeps, deaf; `ANY` waits for the next event."""
ANY = math.inf
STEPPERS_STAY_ON = 255

ALARM_HARD_LIMIT, ALARM_SOFT_LIMIT, ALARM_ABORT, ALARM_PROBE_BEFORE, ALARM_PROBE_MISSED = range(1, 6)
ALARM_HOMING_RESET, ALARM_HOMING_DOOR, ALARM_HOMING_PULL_OFF, ALARM_HOMING_NO_SWITCH = range(6, 10)


class State(Enum):
    """The board's states; the value is the word of the status report."""

    IDLE = "Idle"
    ALARM = "Alarm"
    CHECK = "Check"
    HOMING = "Home"
    RUN = "Run"
    HOLD = "Hold"
    JOG = "Jog"
    DOOR = "Door"
    SLEEP = "Sleep"


BUSY = frozenset({State.HOMING, State.RUN, State.HOLD, State.JOG, State.DOOR})


class Asked(Flag):
    """What interrupts have asked the program to do."""

    NOTHING = 0
    STATUS = auto()
    START = auto()
    CYCLE_DONE = auto()
    HOLD = auto()
    RESET = auto()
    DOOR = auto()
    MOTION_CANCEL = auto()
    SLEEP = auto()


class Suspend(Flag):
    """Why, and how far, the program is suspended."""

    NONE = 0
    HELD = auto()
    RESTART_RETRACT = auto()
    RETRACTED = auto()
    RESTORE = auto()
    RESTORED = auto()
    AJAR = auto()
    MOTION_CANCEL = auto()
    JOG_CANCEL = auto()


class SpindleStop(Flag):
    """The laser's switch-off during a hold."""

    NONE = 0
    BEGIN = auto()
    ACTIVE = auto()
    RESTORE = auto()
    RESTORE_AND_START = auto()


@dataclass
class World:
    """What stands around the board: limit switches, the door, and a probe that nothing touches.

    `switches` says whether limit switches exist; they lie `travel` apart from where the machine really is, which
    the board does not know: `real_mm` is the head's true place, 0 at the switch and negative away from it.
    """

    switches: bool = False
    real_mm: tuple[float, float, float] = (-5.0, -5.0, -5.0)
    door_is_open: bool = False
    switch_stuck: bool = False
    probe_touches: bool = False


@dataclass
class Machine:
    """The board."""

    memory: Memory = field(default_factory=Memory)
    world: World = field(default_factory=World)
    options: str = "V"
    dialect: Dialect = GRBL
    now_s: float = 0.0
    state: State = State.IDLE
    asked: Asked = Asked.NOTHING
    alarm: int = 0
    abort: bool = False
    suspend: Suspend = Suspend.NONE
    soft_limit_hit: bool = False
    spindle_stop: SpindleStop = SpindleStop.NONE
    motion_override: list[int] = field(default_factory=list)
    accessory_override: list[int] = field(default_factory=list)
    overrides: Overrides = field(default_factory=Overrides)
    wco_count: int = 0
    ov_count: int = 0
    parser: Parser = field(default_factory=Parser)
    pin: Pin = field(default_factory=Pin)
    shown_s_count: float = 0.0
    coolant: int = 0
    homed: bool = False
    stalled_until_s: float = 0.0  # until then the program stands still in an interrupt's delay
    switches_seen: set[int] = field(default_factory=set)
    probe_found: bool = False
    probe_steps: tuple[int, int, int] = (0, 0, 0)
    say: Callable[[str], None] = print
    read: Callable[[], int | None] = lambda: None
    rx_free: Callable[[], int] = lambda: 128
    flush_rx: Callable[[], None] = lambda: None
    go_deaf: Callable[[float], None] = lambda until_s: None

    def __post_init__(self) -> None:
        self.planner = Planner(self.memory, self.overrides, capacity_count=self.dialect.blocks_count)
        self.stepper = Stepper(self.planner, self.memory, self.pin, self.duty)
        self.planner.notify = self.stepper.look_again

    def aborted(self) -> bool:
        """Return whether a reset is under way."""
        return self.abort

    def is_in(self, state: State) -> bool:
        """Return whether the board is in `state` now; time may have passed since the caller last looked."""
        return self.state is state

    def duty(self, speed: float) -> float:
        """Return the pin's duty for an S word, with the spindle override; the speed shown in reports follows."""
        speed *= 0.01 * self.overrides.spindle
        low, high = self.memory[31], self.memory[30]
        if low >= high or speed >= high:
            self.shown_s_count = high
            return 1.0
        if speed <= low:
            self.shown_s_count = low if speed else 0.0
            return 1 / 255 if speed else 0.0
        self.shown_s_count = speed
        return (math.floor((speed - low) * 254 / (high - low)) + 1) / 255

    def lock_s(self) -> float:
        """Return how long the program waits when the steppers go idle: `$1`, none where they stay on (255)."""
        stay_on = self.memory[1] == STEPPERS_STAY_ON and not self.alarm and self.state is not State.SLEEP
        return 0.0 if stay_on or self.state is State.HOMING else self.memory[1] / 1000

    def stall(self) -> None:
        """Let the steppers go idle in an interrupt: the program stands still meanwhile."""
        self.stalled_until_s = self.now_s + self.lock_s()

    def spindle_off(self) -> None:
        """Switch the laser pin off."""
        self.pin.power_frac = 0.0

    def set_spindle(self, mode: int, speed: float) -> None:
        """Set the laser pin while nothing moves; M4 in laser mode keeps it dark until motion."""
        if self.abort:
            return
        if mode == 5:
            self.shown_s_count = 0.0
            self.spindle_off()
        else:
            self.pin.ccw = mode == 4
            dark = self.memory.on(32) and mode == 4
            self.pin.power_frac = self.duty(0.0 if dark else speed)
        self.ov_count = 0

    def set_coolant(self, coolant: int) -> None:
        """Set the pins of M7 (mist, here the exhaust) and M8 (flood, here the air assist)."""
        if not self.abort:
            self.coolant = coolant
            self.ov_count = 0

    def kill(self) -> None:
        """Reset, as `0x18` and the limit switches ask for it: laser off and steppers dead at once."""
        if Asked.RESET in self.asked:
            return
        self.asked |= Asked.RESET
        self.spindle_off()
        self.coolant = 0
        moving = self.state in (State.RUN, State.HOMING, State.JOG)
        if moving or self.stepper.holding or self.stepper.system_move is not None:
            if self.state is State.HOMING:
                self.alarm = self.alarm or ALARM_HOMING_RESET
            else:
                self.alarm = ALARM_ABORT
            self.stepper.halt(self.now_s)
            self.stall()

    def position_steps(self) -> tuple[int, int, int]:
        """Return where the board believes it is, in steps."""
        return self.stepper.position_at(self.now_s)

    def position_mm(self) -> tuple[float, float, float]:
        """Return where the board believes it is."""
        x, y, z = (f32(s / p) for s, p in zip(self.position_steps(), self.memory.axes(100), strict=True))
        return x, y, z

    def limits_hit(self) -> set[int]:
        """Return the axes whose switch the board takes for pressed; `$5` turns the pins' meaning over."""
        if self.world.switch_stuck:
            pressed = {0, 1, 2}
        elif self.world.switches:
            pressed = {k for k in range(3) if self.real_mm(k) >= 0}
        else:
            pressed = set()
        return {0, 1, 2} - pressed if self.memory.on(5) else pressed

    def probe_triggered(self, away: bool = False) -> bool:
        """Return whether the probe counts as met; moving `away` from contact, an open pin does. `$6` turns it over."""
        return self.world.probe_touches ^ self.memory.on(6) ^ away

    def watch_switches(self) -> None:
        """Do what the limit pins' interrupt does under `$21`: any change kills, except in homing and alarm."""
        now = self.limits_hit()
        changed, self.switches_seen = now != self.switches_seen, now
        if changed and self.state not in (State.ALARM, State.HOMING) and not self.alarm:
            self.kill()
            self.go_deaf(self.stalled_until_s)
            self.alarm = ALARM_HARD_LIMIT

    def real_mm(self, axis: int) -> float:
        """Return how far the head is past the switch of `axis`; negative while it has not reached it."""
        sign = -1.0 if int(self.memory[23]) & (1 << axis) else 1.0
        return self.world.real_mm[axis] + sign * self.position_mm()[axis]

    def declare_position(self, steps: tuple[int, int, int]) -> None:
        """Rename the place where the machine stands; the switches stay where they really are."""
        real = [self.real_mm(k) for k in range(3)]
        self.stepper.stand_at(steps)
        self.world.real_mm = (0.0, 0.0, 0.0)
        x, y, z = (real[k] - self.real_mm(k) for k in range(3))
        self.world.real_mm = (x, y, z)

    def sync_position(self) -> None:
        """Let planner and parser begin from where the machine stands."""
        self.planner.position_steps = self.position_steps()
        self.parser = replace(self.parser, position_mm=self.position_mm())

    def reinitialise(self) -> None:
        """Clear everything a reset clears; state, settings, offsets and position stay."""
        self.stepper.reset(self.now_s)
        self.planner.reset(self.stepper.position)
        self.overrides.feed = self.overrides.rapid = self.overrides.spindle = 100
        self.asked, self.alarm, self.abort = Asked.NOTHING, 0, False
        self.suspend, self.spindle_stop, self.soft_limit_hit = Suspend.NONE, SpindleStop.NONE, False
        self.motion_override.clear()
        self.accessory_override.clear()
        self.wco_count = self.ov_count = 0
        self.shown_s_count, self.coolant = 0.0, 0
        self.spindle_off()
        self.probe_steps, self.probe_found = (0, 0, 0), False
        self.switches_seen = self.limits_hit()
        self.flush_rx()
        self.parser = Parser(modes=Modes(), system_mm=self.memory.offsets_mm[0], has_mist="M" in self.options)
        self.sync_position()
