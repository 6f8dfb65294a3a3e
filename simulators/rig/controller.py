"""The rig's controller: registers in, registers out, one thousand ticks a second.

Limits, latched overload, e-stop and watchdog are its own: a host that dies leaves a stage that stops.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from simulators.rig import registers as R
from simulators.rig.axis import Axis
from simulators.rig.loadcell import LoadCell
from simulators.specimens.curve import Place, Specimen

TICK_S = 0.001
APEX = Place(0.0, 1.0)  # a surface that is the same everywhere
OVERLOAD_ROOM = 0.5  # of what an overload exceeds its limit by: noise on the way out must not latch it again


@dataclass(frozen=True)
class Machine:
    """What stands on the table. Seeds draw the specimen's height and the noise."""

    noise_N: float = 0.01
    drift_N_s: float = 0.0
    wander_N_sqrt_s: float = 0.0
    zero_N: float = 0.12
    gain_ratio: float = 1.0
    capacity_N: float = 50.0
    compliance_mm_N: float = 0.0
    backlash_mm: float = 0.004
    travel_mm: float = 60.0
    speed_max_mm_s: float = 20.0
    contact_mm: float = 8.0
    parked_mm: float = 1.5
    stage_mm: float = 100.0


@dataclass
class Controller:
    """One rig. `specimen` may be exchanged while the stage is disarmed; `tell` hears what happens."""

    machine: Machine
    specimen: Specimen | None = None
    seed: int = 0
    tell: Callable[[str, dict[str, Any]], None] = lambda _kind, _facts: None
    on_arm: Callable[[Controller], None] = lambda _: None
    place: Callable[[float, float], Place | None] = lambda _x, _y: APEX
    hung_N: float = 0.0
    tick_count: int = 0
    true_N: float = 0.0
    depth_mm: float = 0.0
    estop_open: bool = False
    last_feed: int = 0
    _state: int = R.DISARMED
    _faults: int = R.UNHOMED | R.RESTARTED
    _command: dict[str, float] = field(default_factory=dict)
    _command_state: int = R.NONE
    _reason: int = R.NO_REASON
    _echo: int = 0
    _shown_N: float = 0.0
    _forgiven_N: float = 0.0

    def __post_init__(self) -> None:
        rng, m = random.Random(self.seed), self.machine
        self.axis = Axis(m.parked_mm, backlash_mm=m.backlash_mm)
        self.cell = LoadCell(m.capacity_N, m.gain_ratio, m.zero_N, m.drift_N_s, m.wander_N_sqrt_s, m.noise_N, rng)
        self.stage_mm = [0.0, 0.0]
        self._stage_to_mm = [0.0, 0.0]
        self._under: Place | None = APEX
        self.settings: dict[str, float] = {
            "force_max": 0.9 * m.capacity_N,
            "force_min": -5.0,
            "travel_min": 0.0,
            "travel_max": m.travel_mm,
            "safe_height": 0.0,
            "acceleration": 50.0,
            "watchdog": 0.5,
        }
        self._command = {name: 0.0 for name, *_ in R.COMMAND}

    # --- time

    def advance(self, ticks_count: int) -> None:
        """Let the controller run for some ticks."""
        for _ in range(ticks_count):
            self._tick()

    def _tick(self) -> None:
        self.tick_count += 1
        self.axis.tick(TICK_S)
        if self._stage_to_mm != self.stage_mm:
            self._slide()
        self._load()
        self._watch()
        if self._command_state == R.RUNNING:
            self._follow()
        if self._state == R.MOVING and self.axis.standing and self._command_state != R.RUNNING:
            self._state = R.READY

    def _load(self) -> None:
        tool_mm = self.axis.tool_mm - self.machine.contact_mm
        if self.specimen is not None and self._under is not None:
            lean, tool_mm = self._under.lean_ratio, tool_mm - self._under.drop_mm
            into_mm, along_N = self.specimen.push(tool_mm * lean, self.machine.compliance_mm_N * lean**2, TICK_S)
            self.depth_mm, force_N = into_mm / lean, along_N * lean
        else:
            self.depth_mm, force_N = tool_mm, 0.0
        self.true_N = force_N + self.hung_N
        self.cell.tick(TICK_S)
        self._shown_N, saturated = self.cell.convert(self.true_N)
        if saturated:
            self._fault(R.SATURATION)

    def _watch(self) -> None:
        if self.estop_open:
            self._fault(R.ESTOP)
        if self._state not in (R.READY, R.MOVING):
            return
        beyond_N = self._beyond_N()
        if beyond_N > self._forgiven_N:
            self._fault(R.OVERLOAD)
        elif beyond_N == 0.0:
            self._forgiven_N = 0.0
        silent = self.tick_count - self.last_feed
        if silent > self.settings["watchdog"] / TICK_S:
            self._fault(R.WATCHDOG)

    def _beyond_N(self) -> float:
        """Return by how much the gross force is outside its limits."""
        return max(0.0, self._shown_N - self.settings["force_max"], self.settings["force_min"] - self._shown_N)

    def _follow(self) -> None:
        """See whether the running command is over."""
        code, until = int(self._command["code"]), self._command["until"]
        reached = (code == R.MOVE_UNTIL_ABOVE and self._shown_N >= until) or (
            code == R.MOVE_UNTIL_BELOW and self._shown_N <= until
        )
        if reached:
            self.axis.brake()
            self._end(R.DONE)
        elif code == R.MOVE_STAGE:
            if self._stage_to_mm == self.stage_mm:
                self._end(R.DONE)
        elif self.axis.standing:
            if code == R.HOME:
                self.axis.zero()
                self._faults &= ~(R.UNHOMED | R.RESTARTED)
            missed = code in (R.MOVE_UNTIL_ABOVE, R.MOVE_UNTIL_BELOW)
            self._end(R.DONE, R.LIMIT_NOT_REACHED if missed else R.NO_REASON)

    def _end(self, state: int, reason: int = R.NO_REASON) -> None:
        self._command_state, self._reason = state, reason
        self.tell(
            "ended",
            {
                "command": int(self._command["id"]),
                "state": state,
                "reason": reason,
                "position_mm": self.axis.position_mm,
            },
        )

    def _slide(self) -> None:
        step = self._command["speed"] * TICK_S
        for k in (0, 1):
            left = self._stage_to_mm[k] - self.stage_mm[k]
            self.stage_mm[k] = self._stage_to_mm[k] if abs(left) <= step else self.stage_mm[k] + step * (left > 0 or -1)
        if self._stage_to_mm == self.stage_mm:
            self.look_under()

    def look_under(self) -> None:
        """Take the place under the indenter anew: what was pressed elsewhere has left no trace here."""
        self._under = self.place(*self.stage_mm)
        if self.specimen is not None:
            self.specimen = self.specimen.fresh()

    def _fault(self, bit: int) -> None:
        self.axis.brake()
        if self._faults & bit and self._state == R.FAULTED:
            return
        if self._command_state == R.RUNNING:
            self._command_state = R.ABORTED
        self._stage_to_mm = list(self.stage_mm)
        self._faults |= bit
        self._state = R.FAULTED
        self.tell(
            "fault",
            {
                "bit": bit,
                "last_feed": self.last_feed,
                "position_mm": self.axis.position_mm,
                "speed_mm_s": self.axis.speed_mm_s,
                "true_N": self.true_N,
            },
        )

    def power_cycle(self) -> None:
        """Lose everything that is not mechanics: sequence, limits, armed state, home."""
        keep = (self.axis.position_mm, self.axis.tool_mm)
        self.tick_count, self._echo, self.last_feed = 0, 0, 0
        self._state, self._faults = R.DISARMED, R.UNHOMED | R.RESTARTED
        self._command_state, self._reason = R.NONE, R.NO_REASON
        zero, specimen, stage = self.cell.zero_N, self.specimen, self.stage_mm
        self.__post_init__()
        self.axis.position_mm, self.axis._tool_mm = keep
        self.cell.zero_N, self.specimen, self.stage_mm = zero, specimen, stage
        self._stage_to_mm = list(stage)
        self.tell("power", {})

    # --- registers

    def status_words(self) -> list[int]:
        """Return the status block, check word included."""
        words = R.words_of(
            R.STATUS,
            {
                "sequence": self.tick_count % 2**32,
                "request_echo": self._echo,
                "heartbeat": self.tick_count % 2**16,
                "state": self._state,
                "faults": self._faults | (R.ESTOP if self.estop_open else 0),
                "command_id": int(self._command["id"]),
                "command_state": self._command_state,
                "command_reason": self._reason,
                "position": self.axis.position_mm,
                "force": self._shown_N,
            },
        )
        return [*words, R.status_check(words)]

    def blocks(self) -> dict[tuple[str, int], list[int]]:
        """Return every readable block but the status, by table and first address."""
        m = self.machine
        identity: dict[str, float | int | str] = {
            "magic": 0x4652,
            "version": 1,
            "model": "fabsim indenter",
            "serial": 1000 + self.seed,
            "firmware": 104,
            "capacity": m.capacity_N,
            "travel": m.travel_mm,
            "speed_max": m.speed_max_mm_s,
        }
        air = {"temperature": 22.5, "humidity": 0.45, "stage_x": self.stage_mm[0], "stage_y": self.stage_mm[1]}
        return {
            ("input", 32): R.words_of(R.IDENTITY, identity),
            ("input", 64): R.words_of(R.ENVIRONMENT, air),
            ("holding", 100): R.words_of(R.COMMAND, self._command),
            ("holding", 120): R.words_of(R.SETTINGS, self.settings),
            ("holding", 140): R.words_of(R.FEED, {"feed": self.last_feed, "request": self._echo}),
        }

    def read(self, table: str, address: int, count: int) -> list[int] | None:
        """Return registers that lie inside one block, or None where there are none."""
        if address >= 0 and address + count <= R.STATUS_CHECK + 1:
            return self.status_words()[address : address + count]
        for (where, start), words in self.blocks().items():
            if where == table and start <= address and address + count <= start + len(words):
                return words[address - start : address - start + count]
        return None

    def write(self, address: int, words: Sequence[int]) -> bool:
        """Take a whole block; False where it is not one, or may not be written now."""
        if address == R.FEED[0][1] and len(words) == R.length(R.FEED):
            values = R.values_of(R.FEED, words)
            self._echo = int(values["request"])
            self._take_feed(int(values["feed"]))
            return True
        if address == R.SETTINGS[0][1] and len(words) == R.length(R.SETTINGS):
            return self._take_settings(R.values_of(R.SETTINGS, words))
        if address == R.COMMAND[0][1] and len(words) == R.length(R.COMMAND):
            self._take_command(R.values_of(R.COMMAND, words))
            return True
        return False

    def _take_feed(self, feed: int) -> None:
        """Believe a feed only if it is newer than the last and itself not older than the watchdog allows."""
        if self.last_feed < feed <= self.tick_count:
            self.last_feed = feed

    def _take_settings(self, values: Mapping[str, float]) -> bool:
        m = self.machine
        allowed = (
            self._state in (R.DISARMED, R.FAULTED)
            and 0 < values["force_max"] <= m.capacity_N
            and -m.capacity_N <= values["force_min"] < 0
            and 0 <= values["travel_min"] < values["travel_max"] <= m.travel_mm
            and 0 < values["acceleration"] <= 500
            and 0.05 <= values["watchdog"] <= 5
        )
        if allowed:
            self.settings = dict(values)
            self.axis.acceleration_mm_s2 = values["acceleration"]
        return allowed

    def _take_command(self, command: Mapping[str, float]) -> None:
        known = int(self._command["id"])
        if int(command["id"]) <= known:
            self.tell("old_command", {"command": int(command["id"]), "known": known, "code": int(command["code"])})
            return
        reason = self._objection(command)
        if int(command["code"]) != R.STOP or self._command_state == R.RUNNING:
            self._command_state = R.ABORTED if self._command_state == R.RUNNING else self._command_state
        self._command = dict(command)
        self.tell("command", {**command, "reason": reason})
        if reason != R.NO_REASON:
            self._end(R.REFUSED, reason)
            return
        self._command_state, self._reason = R.RUNNING, R.NO_REASON
        self._begin(command)

    def _objection(self, command: Mapping[str, float]) -> int:
        code, target = int(command["code"]), command["target"]
        if not R.MOVE <= code <= R.MOVE_STAGE:
            return R.UNKNOWN_CODE
        if code in (R.STOP, R.DISARM, R.CLEAR):
            return R.NO_REASON
        if code == R.ARM:
            latched = self._faults & ~(R.UNHOMED | R.RESTARTED)
            return R.IS_FAULTED if latched or self.estop_open else R.NO_REASON
        if self._state == R.FAULTED:
            return R.IS_FAULTED
        if self._state == R.DISARMED:
            return R.NOT_ARMED
        if not 0 < command["speed"] <= self.machine.speed_max_mm_s:
            return R.BAD_SPEED
        if code == R.HOME:
            return R.NO_REASON
        if self._faults & R.UNHOMED:
            return R.NOT_HOMED
        if code == R.MOVE_STAGE:
            inside = max(abs(command["stage_x"]), abs(command["stage_y"])) <= self.machine.stage_mm
            high = self.axis.position_mm <= self.settings["safe_height"] + 1e-6
            return R.NO_REASON if inside and high else R.NOT_AT_SAFE_HEIGHT if inside else R.OUTSIDE_TRAVEL
        if not self.settings["travel_min"] - 1e-9 <= target <= self.settings["travel_max"] + 1e-9:
            return R.OUTSIDE_TRAVEL
        down = target > self.axis.position_mm
        overloaded = self._shown_N > self.settings["force_max"] if down else self._shown_N < self.settings["force_min"]
        return R.TOWARDS_OVERLOAD if overloaded else R.NO_REASON

    def _begin(self, command: Mapping[str, float]) -> None:
        code = int(command["code"])
        if code == R.STOP:
            self.axis.brake()
            self._stage_to_mm = list(self.stage_mm)
            self._end(R.DONE, R.STOP_COMMAND)
        elif code == R.DISARM:
            self.axis.brake()
            self._state = R.DISARMED
            self._end(R.DONE)
        elif code == R.CLEAR:
            self._faults &= R.UNHOMED | R.RESTARTED
            # An overload that is still there is forgiven for the way out, not for a way further in.
            self._forgiven_N = (1 + OVERLOAD_ROOM) * self._beyond_N()
            self._state = R.DISARMED
            self._end(R.DONE)
        elif code == R.ARM:
            self.on_arm(self)
            self.last_feed = self.tick_count
            self._state = R.READY
            self._end(R.DONE)
        elif code == R.MOVE_STAGE:
            self._stage_to_mm = [command["stage_x"], command["stage_y"]]
            self._state = R.MOVING
        else:
            # The home switch is where the encoder of this stage reads nothing: the motor drives up to it.
            self.axis.go(0.0 if code == R.HOME else command["target"], command["speed"])
            self._state = R.MOVING
