"""Run a plan on a rig: the only place of `indent` that makes something move.

The stage is stopped on every way out. It is drawn back only after a normal end; after a fault, a stop or Ctrl-C it
stays where it is, so that nothing is pressed or torn by a retraction nobody asked for.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from design.findings import Finding
from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.rig.indenter import LOST, Indenter, Limits, RigFaulted, ended
from drivers.rig.samples import Restarted, Sample
from fabctl.config.method import MethodConfig
from fabctl.errors import FabctlError, RefusedError, Stopped
from fabctl.events import Emit, Event, silent
from fabctl.indent.contact import first_touch
from fabctl.indent.method import Action, time_s
from fabctl.indent.recorder import Row

Wish = Literal["go", "pause", "stop"]
SHOWN_HZ = 12.0
HOMING_MM_S = 8.0
STANDING_MM = 1.0  # the safe heights of two methods differ by less; a pressed specimen is farther down
HARMLESS = ("unhomed", "restarted")  # what a controller says after it was switched on
FREE_S, FREE_SIGMA, FREE_FRAC = 0.25, 4.0, 0.1
MORE_ROOM_COUNT = 6


class Keeper(Protocol):
    """What takes the rows; `Recorder` makes them durable."""

    def take(self, row: Row) -> None:
        """Take one row."""
        ...


class NoContact(FabctlError):
    """The approach ended without meeting the specimen."""

    def __init__(self, trigger_N: float, position_mm: float) -> None:
        super().__init__(trigger_N, position_mm)
        self.trigger_N, self.position_mm = trigger_N, position_mm

    def __str__(self) -> str:
        return (
            f"no contact: the force did not rise by {self.trigger_N:g} N down to {self.position_mm:.2f} mm; "
            "is a specimen in place, and high enough?"
        )


class ForceOffZero(FabctlError):
    """The force before the test is nothing a free load cell shows."""


def left_behind(now: Sample, safe_height_mm: float) -> list[Finding]:
    """Return what an earlier run has left that a new one must not go on from: a latched fault, an indenter still down.

    A tare taken on a pressed specimen would make every figure wrong, and the approach would press on from there.
    """
    found = []
    latched = [fault for fault in now.faults if fault not in HARMLESS]
    if latched:
        hint = "look at the specimen, then `fabctl rig clear` and `fabctl rig retract`"
        found.append(Finding("RIG-LATCHED", f"the controller still holds {', '.join(latched)}", hint=hint))
    if "unhomed" not in now.faults and now.position_mm > safe_height_mm + STANDING_MM:
        text = f"the indenter stands at {now.position_mm:.2f} mm, safe is {safe_height_mm:g} mm"
        found.append(Finding("RIG-DOWN", text, hint="look at the specimen, then `fabctl rig retract`"))
    return found


@dataclass
class Ending:
    """How a run went, in numbers."""

    rows_count: int = 0
    lost_count: int = 0
    contacts_mm: dict[int, float] = field(default_factory=dict)
    tares_N: list[float] = field(default_factory=list)
    curves_done: list[tuple[int, int]] = field(default_factory=list)


class Runner:
    """Carries out actions one by one, sampling on fixed slots all the while."""

    def __init__(
        self,
        rig: Indenter,
        method: MethodConfig,
        plan: Sequence[Action],
        recorder: Keeper,
        clock: Clock,
        sample_hz: float,
        emit: Emit = silent,
        wish: Callable[[], Wish] = lambda: "go",
        go_on: Callable[[str], bool] = lambda _message: True,
    ) -> None:
        self.rig, self.method, self.plan, self.recorder = rig, method, plan, recorder
        self.clock, self.emit, self.wish, self.go_on = clock, emit, wish, go_on
        self.slot_s = 1.0 / sample_hz
        self.ending = Ending()
        self._action = Action("travel")
        self._tare_N = 0.0
        self._zero_mm: float | None = None
        self._clear_mm = 0.0
        self._trace: list[tuple[float, float]] = []
        self._next_s = clock.now_s()
        self._last_good_s = clock.now_s()
        self._shown_s = 0.0
        self._began_s = clock.now_s()
        self._needed_s = max(1.0, time_s(plan, method.travel_speed_mm_s))
        rig.hear = self._heard

    # --- the whole

    def execute(self) -> Ending:
        """Do it all; raise what went wrong, with the stage stopped and disarmed."""
        try:
            self._prepare()
            for action in self.plan:
                self._action = action
                self.emit(Event("state", _spoken(action)))
                self._do(action)
            self._action = Action("travel")
            self._drive(self.method.safe_height_mm, self.method.travel_speed_mm_s)
        finally:
            self._leave()
        return self.ending

    def _prepare(self) -> None:
        limits = self.method.limits
        left = left_behind(self.rig.fresh_sample(), self.method.safe_height_mm)
        if left:
            raise RefusedError("the rig is not ready for a test", left)
        self.rig.clear_faults()
        self.rig.set_limits(
            Limits(
                force_max_N=limits.force_N,
                force_min_N=-limits.tension_N,
                travel_min_mm=0.0,
                travel_max_mm=limits.travel_mm,
                safe_height_mm=self.method.safe_height_mm,
                acceleration_mm_s2=self.method.acceleration_mm_s2,
                watchdog_s=limits.watchdog_s,
            )
        )
        now = self.rig.fresh_sample()
        self.rig.arm()
        if "unhomed" in now.faults:
            self.emit(Event("state", "homing"))
            self._whole(lambda: self.rig.home(HOMING_MM_S))

    def _leave(self) -> None:
        """Stop and disarm, whatever happened; the controller's watchdog stands behind this."""
        try:
            stopped = self.rig.stop()
            self.rig.disarm()
        except DeviceError as fault:
            stopped = False
            self.emit(Event("warning", f"rig: {fault}"))
        if not stopped:
            self.emit(Event("warning", "rig: the stop was not confirmed; the controller's watchdog stops the stage"))
        self.ending.lost_count = self.rig.lost_count

    # --- one action

    def _do(self, action: Action) -> None:
        if action.kind == "tare":
            self._tare(action.time_s)
        elif action.kind == "approach":
            self._approach(action)
        elif action.kind == "preload":
            self._drive_to(action)
            self._rest(action.time_s)
        elif action.kind == "zero":
            self._zero_mm = self._fresh().position_mm
        elif action.kind == "load":
            self._drive_to(action)
        elif action.kind == "unload":
            self._drive_to(action)
            self.ending.curves_done.append((action.point, action.curve))
            self.emit(Event("curve", f"curve {action.curve} done", data={"point": action.point, "curve": action.curve}))
        elif action.kind == "hold":
            self._rest(action.time_s)
        elif action.kind == "wait":
            self._wait(action.message)
        else:
            self._travel(action)

    def _tare(self, duration_s: float) -> None:
        """Average the gross force; the limits go on acting on the gross force."""
        forces: list[float] = []
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            forces.append(self._fresh().force_N)
        found_N = statistics.fmean(forces)
        if abs(found_N) > 0.5 * self.method.limits.force_N:
            raise ForceOffZero(
                f"tare: the free load cell shows {found_N:.3f} N, more than half of the limit "
                f"{self.method.limits.force_N:g} N; is the indenter free, and the cell in order?"
            )
        self._tare_N = found_N
        self.ending.tares_N.append(found_N)

    def _approach(self, action: Action) -> None:
        trigger_N = action.force_N or 0.0
        here_mm = self._fresh().position_mm
        end_mm = self.method.limits.travel_mm if action.travel_mm is None else here_mm + action.travel_mm
        end_mm = min(end_mm, self.method.limits.travel_mm)
        self._trace.clear()
        found = self._drive(end_mm, action.speed_mm_s, above_N=self._tare_N + trigger_N)
        if found.reason == "limit_not_reached":
            raise NoContact(trigger_N, found.position_mm)
        self._zero_mm = self._touched(found.position_mm)
        self._clear_mm = max(0.0, self._zero_mm - action.clearance_mm)
        self.ending.contacts_mm[action.point] = self._zero_mm
        self._drive(self._clear_mm, action.speed_mm_s)
        self._make_free(action)

    def _touched(self, triggered_mm: float) -> float:
        """Return where contact began: a soft specimen is millimetres deep before the trigger's force is there."""
        position = np.array([place for place, _ in self._trace])
        force = np.array([force for _, force in self._trace])
        forward = np.flatnonzero(np.diff(position, prepend=position[:1] - 1.0) > 0)
        # Nothing samples while this is computed, so nothing feeds the watchdog: the stage stands disarmed meanwhile.
        self.rig.disarm()
        found = first_touch(position[forward], force[forward])
        self.rig.arm()
        return triggered_mm if found is None else min(found, triggered_mm)

    def _make_free(self, action: Action) -> None:
        """Rise until the force is that of the tare: every curve must begin free."""
        for _ in range(MORE_ROOM_COUNT):
            until_s = self.clock.now_s() + FREE_S
            forces = []
            while self.clock.now_s() < until_s:
                forces.append(self._fresh().force_N - self._tare_N)
            if statistics.fmean(forces) < FREE_SIGMA * statistics.pstdev(forces) / len(forces) ** 0.5 + FREE_FRAC * (
                action.force_N or 0.0
            ):
                return
            self._clear_mm = max(0.0, self._clear_mm - action.clearance_mm)
            self._drive(self._clear_mm, action.speed_mm_s)
        raise ForceOffZero(
            f"after the approach the force stays {statistics.fmean(forces):.4f} N above the tare, "
            f"{MORE_ROOM_COUNT} times the clearance above contact; does the specimen stick, or the cell drift?"
        )

    def _drive_to(self, action: Action) -> None:
        """Go to the depth or force an action names."""
        assert self._zero_mm is not None  # the check of the plan asks for an approach first
        if action.depth_mm is not None:
            self._drive(self._zero_mm + action.depth_mm, action.speed_mm_s)
        elif action.force_N is None:
            self._drive(self._clear_mm, action.speed_mm_s)
        elif action.kind == "unload":
            self._drive(self._clear_mm, action.speed_mm_s, below_N=self._tare_N + action.force_N)
        else:
            self._drive(self.method.limits.travel_mm, action.speed_mm_s, above_N=self._tare_N + action.force_N)

    def _rest(self, duration_s: float) -> None:
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            self._fresh()

    def _wait(self, message: str) -> None:
        self.emit(Event("wait", message))
        while not self.go_on(message):
            self._fresh()

    def _travel(self, action: Action) -> None:
        assert action.at_mm is not None
        self._drive(self.method.safe_height_mm, self.method.travel_speed_mm_s)
        x_mm, y_mm = action.at_mm
        self._whole(lambda: self.rig.move_stage(x_mm, y_mm, action.speed_mm_s))

    # --- motion and sampling

    def _drive(
        self, target_mm: float, speed_mm_s: float, above_N: float | None = None, below_N: float | None = None
    ) -> Sample:
        """Move to an absolute place, or until the gross force is above or below a value."""
        if above_N is not None:
            return self._whole(lambda: self.rig.move(target_mm, speed_mm_s, "above", above_N))
        if below_N is not None:
            return self._whole(lambda: self.rig.move(target_mm, speed_mm_s, "below", below_N))
        return self._whole(lambda: self.rig.move(target_mm, speed_mm_s))

    def _whole(self, begin: Callable[[], int]) -> Sample:
        """Carry a motion to its end; where the operator paused it, `begin` what is left anew."""
        while True:
            if self.wish() == "pause":  # asked for while nothing moved: then nothing begins to
                self._pause()
            found = self._finish(begin())
            if found is not None:
                return found

    def _finish(self, number: int) -> Sample | None:
        """Sample until a command is over and the stage stands; None where the operator paused it."""
        while True:
            found = self._fresh()
            if ended(found, number) and found.state != "moving":
                return found
            if self.wish() == "pause":
                self._pause()
                return None

    def _pause(self) -> None:
        self.rig.stop()
        self.emit(Event("state", "paused; the stage stands"))
        while self.wish() == "pause":
            self._fresh()
        self.emit(Event("state", "going on"))

    def _fresh(self) -> Sample:
        """Return the sample of the next slot; a lost reply is asked for again until the watchdog would have bitten."""
        self._await_slot()
        while True:
            if self.wish() == "stop":
                raise Stopped("stopped by the operator; the stage stands where it is")
            try:
                found = self.rig.sample()
            except Restarted:
                raise
            except LOST as fault:
                silent_s = self.clock.now_s() - self._last_good_s
                if silent_s > self.method.limits.watchdog_s:
                    raise DeviceTimeout(self.rig.bus.url, "a believable status", silent_s, str(fault)) from fault
                continue
            if found.state == "faulted":
                raise RigFaulted(found.faults, found.position_mm, found.force_N)
            if found.state == "disarmed":
                raise DeviceRefused("rig", "sampling", "the controller has disarmed itself", "another host?")
            return found

    def _await_slot(self) -> None:
        """Wait for the next slot of a fixed grid; slots that are past are left out, not caught up with."""
        now_s = self.clock.now_s()
        late = int((now_s - self._next_s) / self.slot_s)
        if late > 0:
            self._next_s += late * self.slot_s
        if self._next_s > now_s:
            self.clock.sleep(self._next_s - now_s)
        self._next_s += self.slot_s

    def _heard(self, sample: Sample) -> None:
        """Keep every believed sample, also those asked for to confirm a command."""
        self._last_good_s = now_s = self.clock.now_s()
        action = self._action
        self.recorder.take(
            Row(
                time_s=sample.time_s,
                sequence=sample.sequence,
                position_mm=sample.position_mm,
                force_gross_N=sample.force_N,
                force_N=sample.force_N - self._tare_N,
                step=action.kind,
                point=action.point,
                curve=action.curve,
                state=sample.state,
                faults="|".join(sample.faults),
            )
        )
        self.ending.rows_count += 1
        if action.kind == "approach":
            self._trace.append((sample.position_mm, sample.force_N - self._tare_N))
        if now_s - self._shown_s >= 1 / SHOWN_HZ:
            self._shown_s = now_s
            self._show(sample, now_s)

    def _show(self, sample: Sample, now_s: float) -> None:
        spent_s = now_s - self._began_s
        depth_mm = None if self._zero_mm is None else sample.position_mm - self._zero_mm
        force_N = sample.force_N - self._tare_N
        words = f"{self._action.kind:8} {force_N:8.3f} N " + (f"{depth_mm:8.3f} mm" if depth_mm is not None else "")
        left_s = max(0.0, self._needed_s - spent_s)
        self.emit(
            Event(
                "progress",
                f"{words}  {left_s:4.0f} s left",
                done_frac=min(0.999, spent_s / self._needed_s),
                data={"force_N": force_N, "depth_mm": depth_mm, "step": self._action.kind, "curve": self._action.curve},
            )
        )


def _spoken(action: Action) -> str:
    goal = ""
    if action.depth_mm is not None:
        goal = f" to {action.depth_mm:g} mm"
    elif action.force_N is not None:
        goal = f" to {action.force_N:g} N"
    elif action.at_mm is not None:
        goal = f" to x {action.at_mm[0]:g}, y {action.at_mm[1]:g} mm"
    which = f" (curve {action.curve}{', conditioning' if action.condition else ''})" if action.curve else ""
    rate = f" at {action.speed_mm_s:g} mm/s" if action.speed_mm_s else ""
    span = f" for {action.time_s:g} s" if action.time_s else ""
    return f"{action.kind}{goal}{rate}{span}{which}"


def resumed(plan: Sequence[Action], done: Sequence[tuple[int, int]]) -> tuple[Action, ...]:
    """Return what is left of a plan after the curves `done`, each (point, curve).

    Whole curves only: one that was broken off is run again. Every point that is left begins with its tare and approach,
    so nothing is gone on with under an old zero.
    """
    finished = set(done)
    curves = {(a.point, a.curve) for a in plan if a.curve}
    left = {point for point, curve in curves - finished}
    kept = [a for a in plan if a.point in left and not (a.curve and (a.point, a.curve) in finished)]
    return tuple(_without_idle_rests(kept))


def _without_idle_rests(plan: Sequence[Action]) -> list[Action]:
    """Drop rests that belonged to curves which are left out."""
    return [a for k, a in enumerate(plan) if not (a.kind == "hold" and not a.curve and plan[k - 1].kind != "unload")]
