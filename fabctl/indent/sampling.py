"""Samples on a fixed grid of slots: asked for, kept, shown, with the time that is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, Protocol

from drivers.clock import Clock
from drivers.errors import DeviceRefused, DeviceTimeout
from drivers.rig.indenter import LOST, Indenter
from drivers.rig.refusals import RigFaulted
from drivers.rig.samples import Restarted, Sample
from fabctl.errors import Stopped
from fabctl.events import Emit, Event
from fabctl.indent.method import Action
from fabctl.indent.recorder import Row

Wish = Literal["go", "pause", "stop"]
SHOWN_HZ = 12.0


class Keeper(Protocol):
    """What takes the rows; `Recorder` makes them durable."""

    def take(self, row: Row) -> None:
        """Take one row."""
        ...


class TimeLeft:
    """What a plan still needs: the estimates of the actions to come, and what is left of the present one.

    Time in which the operator holds everything up counts for nothing.
    """

    def __init__(self, needed_s: Sequence[float], now_s: float) -> None:
        self._needed_s = needed_s
        self._total_s = max(1.0, sum(needed_s))
        self._index = 0
        self._began_s = now_s
        self._held_since_s: float | None = None

    def begin(self, index: int, now_s: float) -> None:
        """Begin the action number `index`."""
        self._index, self._began_s, self._held_since_s = index, now_s, None

    def hold(self, now_s: float) -> None:
        """Stand still: the operator has paused, or is waited for."""
        self._held_since_s = now_s if self._held_since_s is None else self._held_since_s

    def go_on(self, now_s: float) -> None:
        """Count on."""
        if self._held_since_s is not None:
            self._began_s += now_s - self._held_since_s
            self._held_since_s = None

    def left_s(self, now_s: float) -> float:
        """Return about how long it still takes."""
        counted_s = (now_s if self._held_since_s is None else self._held_since_s) - self._began_s
        own_s = self._needed_s[self._index] if self._index < len(self._needed_s) else 0.0
        return max(0.0, own_s - counted_s) + sum(self._needed_s[self._index + 1 :])

    def done_frac(self, now_s: float) -> float:
        """Return how much of it is done, 0 to just under 1."""
        return min(0.999, max(0.0, 1.0 - self.left_s(now_s) / self._total_s))

    @property
    def holds(self) -> bool:
        """Tell whether the operator holds it up."""
        return self._held_since_s is not None


class Sampler:
    """Asks for samples at fixed times, and keeps each believed one with what the stage was doing."""

    def __init__(
        self,
        rig: Indenter,
        recorder: Keeper,
        clock: Clock,
        sample_hz: float,
        watchdog_s: float,
        time_left: TimeLeft,
        emit: Emit,
        wish: Callable[[], Wish],
    ) -> None:
        self.rig, self.recorder, self.clock, self.emit, self.wish = rig, recorder, clock, emit, wish
        self.time_left, self.watchdog_s = time_left, watchdog_s
        self.slot_s = 1.0 / sample_hz
        self.action = Action("travel")
        self.tare_N = 0.0
        self.zero_mm: float | None = None
        self.trace: list[tuple[float, float]] = []
        self.rows_count = 0
        self._next_s = self._last_good_s = clock.now_s()
        self._shown_s = 0.0
        self._wished: Wish = "go"
        rig.hear = self._heard

    def fresh(self) -> Sample:
        """Return the sample of the next slot; a lost reply is asked for again until the watchdog would have bitten."""
        self._await_slot()
        while True:
            self._wished = self.wish()
            if self._wished == "stop":
                raise Stopped("stopped by the operator; the stage stands where it is")
            try:
                found = self.rig.sample()
            except Restarted:
                raise
            except LOST as fault:
                silent_s = self.clock.now_s() - self._last_good_s
                if silent_s > self.watchdog_s:
                    raise DeviceTimeout(self.rig.bus.url, "a believable status", silent_s, str(fault)) from fault
                continue
            if found.state == "faulted":
                raise RigFaulted(found.faults, found.position_mm, found.force_N)
            if found.state == "disarmed":
                raise DeviceRefused("rig", "sampling", "the controller has disarmed itself", "another host?")
            return found

    def for_a_time(self, duration_s: float) -> list[float]:
        """Return the gross forces of `duration_s`; it stands anyway, so a pause asked for meanwhile begins after it."""
        forces: list[float] = []
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            forces.append(self.fresh().force_N)
        return forces

    def while_held(self, holds: Callable[[], bool]) -> None:
        """Sample on as long as the operator `holds` it up; the time left stands still."""
        self.time_left.hold(self.clock.now_s())
        while holds():
            self.fresh()
        self.time_left.go_on(self.clock.now_s())

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
        action, net_N = self.action, sample.force_N - self.tare_N
        self.recorder.take(
            Row(
                time_s=sample.time_s,
                sequence=sample.sequence,
                position_mm=sample.position_mm,
                force_gross_N=sample.force_N,
                force_N=net_N,
                step=action.kind,
                point=action.point,
                curve=action.curve,
                state=sample.state,
                faults="|".join(sample.faults),
            )
        )
        self.rows_count += 1
        if action.kind == "approach":
            self.trace.append((sample.position_mm, net_N))
        if now_s - self._shown_s >= 1 / SHOWN_HZ:
            self._shown_s = now_s
            self._show(sample.position_mm, net_N, now_s)

    def _show(self, position_mm: float, force_N: float, now_s: float) -> None:
        depth_mm = None if self.zero_mm is None else position_mm - self.zero_mm
        step: str = self.action.kind
        if step != "wait" and (self.time_left.holds or self._wished == "pause"):
            step = "paused" if self.time_left.holds else "pausing"  # it begins at the next motion
        place = f"at {position_mm:.3f} mm" if depth_mm is None else f"{depth_mm:8.3f} mm"
        words = f"{step:8} {force_N:8.3f} N {place}  {self.time_left.left_s(now_s):4.0f} s left"
        words += f", point {self.action.point}" if self.action.point else ""
        facts = {"force_N": force_N, "depth_mm": depth_mm, "step": step, "point": self.action.point}
        self.emit(Event("progress", words, self.time_left.done_frac(now_s), data={**facts, "curve": self.action.curve}))
