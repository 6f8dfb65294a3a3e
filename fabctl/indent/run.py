"""Run a plan on a rig: the only place of `indent` that makes something move.

The stage is stopped on every way out. It is drawn back only after a normal end; after a fault, a stop or Ctrl-C it
stays where it is, so that nothing is pressed or torn by a retraction nobody asked for.
"""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from design.findings import Finding
from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.rig.indenter import Indenter, Limits
from drivers.rig.samples import Sample
from fabctl.config.method import MethodConfig
from fabctl.errors import FabctlError, RefusedError
from fabctl.events import Emit, Event, silent
from fabctl.indent.contact import first_touch
from fabctl.indent.method import Action, times_s
from fabctl.indent.sampling import Keeper, Sampler, TimeLeft, Wish
from fabctl.records.ending import undisturbed

HOMING_MM_S = 8.0
STANDING_MM = 1.0  # the safe heights of two methods differ by less; a pressed specimen is farther down
HARMLESS = ("unhomed", "restarted")  # what a controller says after it was switched on
FREE_S, FREE_SIGMA, FREE_FRAC = 0.25, 4.0, 0.1
MORE_ROOM_COUNT = 6
KEEP_S, KEEP_FRAC, KEEP_OVER_FRAC, KEEP_STEP_MM = 0.5, 0.005, 0.1, 0.1  # how a force is kept: looked at twice a second


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
    if latched := _latched(now):
        hint = "look at the specimen, then `fabctl rig clear` and `fabctl rig retract`"
        found.append(Finding("RIG-LATCHED", f"the controller still holds {', '.join(latched)}", hint=hint))
    if "unhomed" not in now.faults and now.position_mm > safe_height_mm + STANDING_MM:
        text = f"the indenter stands at {now.position_mm:.2f} mm, safe is {safe_height_mm:g} mm"
        found.append(Finding("RIG-DOWN", text, hint="look at the specimen, then `fabctl rig retract`"))
    return found


def _latched(now: Sample) -> list[str]:
    return [fault for fault in now.faults if fault not in HARMLESS]


@dataclass
class Ending:
    """How a run went, in numbers."""

    rows_count: int = 0
    lost_count: int = 0
    contacts_mm: dict[int, float] = field(default_factory=dict)
    tares_N: list[float] = field(default_factory=list)
    curves_done: list[tuple[int, int]] = field(default_factory=list)
    no_contact: dict[int, str] = field(default_factory=dict)  # grid points where nothing was met, and why


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
        self.rig, self.method, self.plan = rig, method, plan
        self.clock, self.emit, self.wish, self.go_on = clock, emit, wish, go_on
        self.ending = Ending()
        left = TimeLeft(times_s(plan, method.travel_speed_mm_s), clock.now_s())
        self.sampler = Sampler(rig, recorder, clock, sample_hz, method.limits.watchdog_s, left, emit, wish)
        self._clear_mm = 0.0

    # --- the whole

    def execute(self) -> Ending:
        """Do it all; raise what went wrong, with the stage stopped and disarmed."""
        try:
            self._prepare()
            for k, action in enumerate(self.plan):
                if action.point in self.ending.no_contact:
                    continue
                self.sampler.action = action
                self.sampler.time_left.begin(k, self.clock.now_s())
                self.emit(Event("state", spoken(action)))
                self._do_or_pass_by(action)
            self.sampler.action = Action("travel")
            self.sampler.time_left.begin(len(self.plan), self.clock.now_s())
            self._draw_back()
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
            with undisturbed():  # another Ctrl-C between the two would leave the stage armed
                stopped = self.rig.stop()
                self.rig.disarm()
        except DeviceError as fault:
            stopped = False
            self.emit(Event("warning", f"rig: {fault}"))
        if not stopped:
            self.emit(Event("warning", "rig: the stop was not confirmed; the controller's watchdog stops the stage"))
        else:
            self._tell_what_is_left()
        self.ending.lost_count, self.ending.rows_count = self.rig.lost_count, self.sampler.rows_count

    def _tell_what_is_left(self) -> None:
        with contextlib.suppress(DeviceError):
            for each in left_behind(self.rig.fresh_sample(), self.method.safe_height_mm):
                self.emit(Event("warning", f"{each.message}; {each.hint}"))

    # --- one action

    def _do_or_pass_by(self, action: Action) -> None:
        """Do it; a grid point where nothing is met is noted, and the next one gone to by the safe height.

        Safe because the approach ended free: the controller stands ready, with nothing latched, and every grid point
        begins by rising to the safe height and with a tare of its own. Outside a grid nothing is left to measure.
        """
        try:
            self._do(action)
        except NoContact as fault:
            now = self.sampler.fresh()
            touches = now.force_N - self.sampler.tare_N >= fault.trigger_N
            if not action.point or _latched(now) or touches:
                raise
            self.ending.no_contact[action.point] = str(fault)
            self.emit(Event("no_contact", f"point {action.point}: {fault}", data={"point": action.point}))
            self.emit(Event("warning", f"point {action.point}: no contact, noted; going on to the next one"))

    def _do(self, action: Action) -> None:
        if action.kind == "tare":
            self._tare(action.time_s)
        elif action.kind == "approach":
            self._approach(action)
        elif action.kind == "preload":
            self._drive_to(action)
            self.sampler.for_a_time(action.time_s)
        elif action.kind == "zero":
            self.sampler.zero_mm = self.sampler.fresh().position_mm
        elif action.kind == "load":
            self._drive_to(action)
        elif action.kind == "unload":
            self._drive_to(action)
            self.ending.curves_done.append((action.point, action.curve))
            self.emit(Event("curve", f"curve {action.curve} done", data={"point": action.point, "curve": action.curve}))
        elif action.kind == "hold":
            self._hold(action)
        elif action.kind == "wait":
            self._wait(action.message)
        else:
            self._travel(action)

    def _tare(self, duration_s: float) -> None:
        """Average the gross force; the limits go on acting on the gross force."""
        found_N = statistics.fmean(self.sampler.for_a_time(duration_s))
        if abs(found_N) > 0.5 * self.method.limits.force_N:
            raise ForceOffZero(
                f"tare: the free load cell shows {found_N:.3f} N, more than half of the limit "
                f"{self.method.limits.force_N:g} N; is the indenter free, and the cell in order?"
            )
        self.sampler.tare_N = found_N
        self.ending.tares_N.append(found_N)

    def _approach(self, action: Action) -> None:
        trigger_N = action.force_N or 0.0
        here_mm = self.sampler.fresh().position_mm
        end_mm = self.method.limits.travel_mm if action.travel_mm is None else here_mm + action.travel_mm
        end_mm = min(end_mm, self.method.limits.travel_mm)
        self.sampler.trace.clear()
        self.sampler.zero_mm = None
        found = self._drive(end_mm, action.speed_mm_s, above_N=self.sampler.tare_N + trigger_N)
        if found.reason == "limit_not_reached":
            raise NoContact(trigger_N, found.position_mm)
        zero_mm = self._touched(found.position_mm)
        self.sampler.zero_mm = self.ending.contacts_mm[action.point] = zero_mm
        self._clear_mm = max(0.0, zero_mm - action.clearance_mm)
        self._drive(self._clear_mm, action.speed_mm_s)
        self._make_free(action)

    def _touched(self, triggered_mm: float) -> float:
        """Return where contact began: a soft specimen is millimetres deep before the trigger's force is there."""
        position = np.array([place for place, _ in self.sampler.trace])
        force = np.array([force for _, force in self.sampler.trace])
        forward = np.flatnonzero(np.diff(position, prepend=position[:1] - 1.0) > 0)
        # Nothing samples while this is computed, so nothing feeds the watchdog: the stage stands disarmed meanwhile.
        self.rig.disarm()
        found = first_touch(position[forward], force[forward])
        self.rig.arm()
        return triggered_mm if found is None else min(found, triggered_mm)

    def _make_free(self, action: Action) -> None:
        """Rise until the force is that of the tare: every curve must begin free."""
        for _ in range(MORE_ROOM_COUNT):
            forces = [force_N - self.sampler.tare_N for force_N in self.sampler.for_a_time(FREE_S)]
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
        assert self.sampler.zero_mm is not None  # the check of the plan asks for an approach first
        if action.depth_mm is not None:
            self._drive(self.sampler.zero_mm + action.depth_mm, action.speed_mm_s)
        elif action.force_N is None:
            self._drive(self._clear_mm, action.speed_mm_s)
        elif action.kind == "unload":
            self._drive(self._clear_mm, action.speed_mm_s, below_N=self.sampler.tare_N + action.force_N)
        else:
            self._drive(self.method.limits.travel_mm, action.speed_mm_s, above_N=self.sampler.tare_N + action.force_N)

    def _hold(self, action: Action) -> None:
        """Stand; where a force is to be kept, follow the creeping specimen by small steps downwards."""
        if action.force_N is None:
            self.sampler.for_a_time(action.time_s)
            return
        until_s = self.clock.now_s() + action.time_s
        goal_N = self.sampler.tare_N + action.force_N
        while (left_s := until_s - self.clock.now_s()) > 0:
            lacking_N = goal_N - statistics.fmean(self.sampler.for_a_time(min(KEEP_S, left_s)))
            if lacking_N > KEEP_FRAC * action.force_N:
                self._follow(action, lacking_N / action.force_N, goal_N * (1 + KEEP_OVER_FRAC))

    def _follow(self, action: Action, lacking_frac: float, at_most_N: float) -> None:
        """Go deeper by what the secant stiffness says is lacking; the controller stops it above `at_most_N`."""
        assert self.sampler.zero_mm is not None
        here_mm = self.sampler.fresh().position_mm
        step_mm = min(lacking_frac * max(here_mm - self.sampler.zero_mm, 0.0), KEEP_STEP_MM)
        goal_mm = min(here_mm + step_mm, self.method.limits.travel_mm)
        self._drive(goal_mm, action.speed_mm_s, above_N=at_most_N)

    def _wait(self, message: str) -> None:
        self.emit(Event("wait", message))
        self.sampler.while_held(lambda: not self.go_on(message))

    def _draw_back(self) -> None:
        """Go up to the safe height; where the indenter is above it, it stays: a way down is no way out."""
        if self.rig.fresh_sample().position_mm > self.method.safe_height_mm:
            self._drive(self.method.safe_height_mm, self.method.travel_speed_mm_s)

    def _travel(self, action: Action) -> None:
        assert action.at_mm is not None
        self._draw_back()
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
            found = self.sampler.fresh()
            if self.rig.ended(found, number) and found.state != "moving":
                return found
            if self.wish() == "pause":
                self._pause()
                return None

    def _pause(self) -> None:
        self.rig.stop()
        self.emit(Event("state", "paused; the stage stands"))
        self.sampler.while_held(lambda: self.wish() == "pause")
        self.emit(Event("state", "going on"))


def spoken(action: Action) -> str:
    """Return what an action does, in words."""
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
    asked = f": {action.message}" if action.message else ""
    return f"{action.kind}{goal}{rate}{span}{which}{asked}"
