"""Run a planned cut on a connected laser: follow it, hold lines back, tell how far it is. **W**"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from design.findings import Finding
from drivers.errors import DeviceError
from drivers.grbl.laser import Laser
from drivers.grbl.meanings import error_meaning
from drivers.grbl.run import Progress, Wish, run_program
from fabctl.cut.plan import CutPlan, head_mm, program_times
from fabctl.cut.program import read_program
from fabctl.cut.progress import LOST_MM, Track
from fabctl.errors import RefusedError
from fabctl.events import Emit, Event

TELL_S = 0.5
OFF_PATH_COUNT = 3


class OffPath(DeviceError):
    """The machine is where the program never goes: a byte was disturbed on its way, or steps were lost."""

    def __init__(self, off_mm: float, place_mm: tuple[float, float]) -> None:
        super().__init__(off_mm, place_mm)
        self.off_mm, self.place_mm = off_mm, place_mm

    def __str__(self) -> str:
        x, y = self.place_mm
        return (
            f"the laser reports X{x:.2f} Y{y:.2f}, {self.off_mm:.2f} mm off the program's path; the beam is off; "
            "home it and look at the sheet"
        )


@dataclass
class CutWatch:
    """The job's side of a run: lines are held back, progress is told, the operator is heard."""

    plan: CutPlan
    track: Track
    emit: Emit
    keys: Callable[[], Wish]
    _told_s: float = -1.0
    _state: str = ""
    _off_count: int = 0

    def limit_count(self, now_s: float) -> int | None:
        """Return up to which line may be sent, so that the board never holds more than a few seconds of work."""
        return self.track.limit_count()

    def seen(self, progress: Progress, now_s: float) -> None:
        """Follow the machine; raise `OffPath` where it has left the program."""
        report = progress.report
        if report is None:
            return
        if report.machine_mm is not None or report.work_mm is not None:
            point = head_mm(report, self.plan.work_offset_mm)
            self.track.reported(point, progress.sent_count, report.state == "Run", now_s)
            self._check_path(point, report.state)
        if report.state == "Idle" and progress.sent_count == progress.answered_count:
            self.track.all_done(progress.answered_count)
        state = f"{report.state}:{report.substate}" if report.substate is not None else report.state
        if state != self._state:
            self.emit(Event("state", f"laser: {_words(report.state, report.substate)}", data={"state": state}))
            self._state = state
        if now_s - self._told_s >= TELL_S:
            self._told_s = now_s
            self._tell(progress)

    def _check_path(self, point: tuple[float, float], state: str) -> None:
        off = self.track.off_mm > LOST_MM and state == "Run"
        self._off_count = self._off_count + 1 if off else 0
        if self._off_count >= OFF_PATH_COUNT:
            raise OffPath(self.track.off_mm, point)

    def _tell(self, progress: Progress) -> None:
        left_s = max(self.track.times.total_s - self.track.done_s, 0.0)
        done = self.track.done_frac
        count = len(self.plan.lines)
        message = f"line {progress.answered_count}/{count}, {minutes(left_s)} left"
        self.emit(
            Event(
                "progress",
                f"HELD  {message}" if progress.held else message,
                done,
                {
                    "sent_count": progress.sent_count,
                    "answered_count": progress.answered_count,
                    "left_s": round(left_s, 1),
                },
            )
        )

    def wish(self) -> Wish:
        """Return what the operator wants now."""
        return self.keys()


def _words(state: str, substate: int | None) -> str:
    if state == "Hold":
        return "held" if substate == 0 else "slowing down to hold"
    if state == "Door":
        return "door open: close it, then resume" if substate else "door closed: resume to go on"
    return {"Run": "running", "Idle": "idle"}.get(state, state.lower())


def minutes(seconds_s: float) -> str:
    """Return a time as people say it."""
    whole = round(seconds_s)
    return f"{whole // 60}:{whole % 60:02d} min" if whole >= 60 else f"{whole} s"


def no_keys() -> Wish:
    """Hear no operator."""
    return ""


def check_on_board(laser: Laser, lines: Sequence[str]) -> None:
    """Send the program through the board's check mode; raise `RefusedError` with every line it refuses."""
    refused = laser.check(lines)
    if refused:
        found = [
            Finding(
                "CUT-BOARD",
                f"{lines[index]}: error {code}, {error_meaning(code)[0]}",
                where=f"line {index + 1}",
                hint=error_meaning(code)[1],
            )
            for index, code in refused
        ]
        raise RefusedError("the board refuses the program in its check mode; nothing has moved", found)


def from_here(laser: Laser, plan: CutPlan) -> CutPlan:
    """Return the plan as it begins where the head is now: it may have been homed, or have framed, since it was made.

    Only the way to the first stroke differs; without it, that way would be taken for a machine that has lost steps.
    """
    assert laser.identity is not None, "connect comes first"
    program = read_program(
        plan.lines, laser.identity.setting(12) or 0.002, head_mm(laser.report(), plan.work_offset_mm)
    )
    return replace(plan, program=program, times=program_times(program, laser.identity))


def run_plan(
    laser: Laser, plan: CutPlan, max_run_on_s: float, emit: Emit, keys: Callable[[], Wish] = no_keys
) -> tuple[Progress, Track]:
    """Stream the plan from where the head is, and return when the board stands idle at its end."""
    plan = from_here(laser, plan)
    track = Track(plan.program, plan.times, max_run_on_s)
    progress = run_program(laser, plan.lines, CutWatch(plan, track, emit, keys))
    return progress, track
