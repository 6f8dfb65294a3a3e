"""What a record tells of an interrupted program, where the machine must be, and the program of the rest. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.grbl.messages import Listener, Ok, Report, Vector
from drivers.transport.tap import read_log
from fabctl.cut.estimate import Estimate
from fabctl.cut.program import Modes, Program, Step, decimal
from fabctl.cut.progress import NEAR_MM, OVERLAP_MM, Place, last_steps, locate

MARK = "#"  # direction of a row in `wire.log` that is no byte but a remark
PROGRAM_BEGINS = "program begins"
EXACT_MM = 0.01  # two steps of a usual machine, and the rounding of its report
POWER_UP_MM = 0.0005


@dataclass(frozen=True, slots=True)
class Trail:
    """How far a program came: lines written (the last write may not have arrived), lines answered, last place seen."""

    begun: bool
    written_count: int
    answered_count: int
    place: Place | None


def begins(row: tuple[float, str, bytes]) -> bool:
    """Return whether a row of `wire.log` says that the program begins here."""
    return row[1] == MARK and row[2] == PROGRAM_BEGINS.encode("ascii")


def read_trail(text: str, program: Program, times: Estimate, work_offset_mm: Vector) -> Trail:
    """Return the trail of `program` in the text of a `wire.log`; what came before the program began does not count."""
    rows = read_log(text)
    starts = [k for k, row in enumerate(rows) if begins(row)]
    if not starts:
        return Trail(False, 0, 0, None)
    listener, last = Listener(), [-1, *last_steps(program)]
    written = answered = 0
    place: Place | None = None
    seen_s = 0.0
    for t_s, direction, data in rows[starts[-1] + 1 :]:
        if direction == ">":
            written = min(written + data.count(b"\n"), len(program.lines))
            continue
        for message in listener.feed(data) if direction == "<" else ():
            if isinstance(message, Ok):
                answered += 1
            elif isinstance(message, Report) and (point := _point(message, work_offset_mm)) is not None:
                expected_s = place.t_s + t_s - seen_s if place else 0.0
                first = place.step_index if place else 0
                found = locate(program.steps, times, point, first, last[written], expected_s)
                if found is not None and found.off_mm <= NEAR_MM:
                    place, seen_s = found, t_s
    return Trail(True, written, answered, place)


def _point(report: Report, offset_mm: Vector) -> tuple[float, float] | None:
    """Return where the machine stood, work coordinates; None where the report does not say."""
    if report.machine_mm is not None:
        return report.machine_mm[0] - offset_mm[0], report.machine_mm[1] - offset_mm[1]
    return report.work_mm[:2] if report.work_mm is not None else None


def stopped_at(
    trail: Trail, program: Program, times: Estimate, report: Report, work_offset_mm: Vector, elapsed_s: float
) -> Place | None:
    """Return where on the program the machine stands, or None where its position cannot be trusted.

    Trusted is a board that is not locked and stands exactly on the path, between the last place seen and the last line
    written; not the bare zero of a board that has just been switched on. `elapsed_s` is the time since the last byte.
    """
    point = _point(report, work_offset_mm)
    if report.state != "Idle" or point is None:
        return None
    x, y = point[0] + work_offset_mm[0], point[1] + work_offset_mm[1]
    if abs(x) < POWER_UP_MM and abs(y) < POWER_UP_MM:
        return None
    last = ([-1, *last_steps(program)])[trail.written_count]
    first = trail.place.step_index if trail.place else 0
    end_s = times.end_s[last] if last >= 0 else 0.0
    expected_s = min((trail.place.t_s if trail.place else 0.0) + elapsed_s, end_s)
    found = locate(program.steps, times, point, first, last, expected_s)
    return found if found is not None and found.off_mm <= EXACT_MM else None


def last_seen(trail: Trail, program: Program) -> Place:
    """Return the place where the machine was seen last, a little before it: where to go on with the position lost.

    Everything before it is surely burnt. What the board held beyond it may be: the lines were held back so that this
    is at most one stroke, which is cut again.
    """
    if trail.place is None:
        return Place(0, 0.0, 0.0, 0.0)
    step = program.steps[trail.place.step_index]
    back = OVERLAP_MM / step.length_mm if step.length_mm > 0 else 1.0
    return Place(trail.place.step_index, max(trail.place.along_ratio - back, 0.0), 0.0, trail.place.t_s)


def rest_of(program: Program, place: Place) -> tuple[str, ...]:
    """Return the program of what is left from `place` on, with all modes said again."""
    step = program.steps[place.step_index]
    before = program.modes[step.line_index - 1] if step.line_index else Modes()
    after = program.modes[step.line_index]
    x, y = (a + (b - a) * place.along_ratio for a, b in zip(step.start_mm, step.end_mm, strict=True))
    air = [word for word, on in (("M7", after.mist), ("M8", after.flood)) if on]
    beam = [f"M{after.beam}S0"] if after.beam != 5 else []
    head = ["G21", "G90", "G94", "G17", *air, *beam]
    if not step.burns:
        return (*head, *_modes_again(before), *program.lines[step.line_index :])
    left = [s for s in program.steps[place.step_index :] if s.line_index == step.line_index]
    head += [f"G0X{decimal(x)}Y{decimal(y)}"]
    cuts = [f"G1{_place(s)}" for s in left]
    cuts[0] += f"F{decimal(60 * step.speed_mm_s)}S{decimal(step.s_count)}"
    tail = program.lines[step.line_index + 1 :]
    again = [] if after.motion == 1 else [f"G{after.motion}"]
    return (*head, *cuts, *(again if tail and not tail[0].startswith(("G", "M")) else []), *tail)


def _place(step: Step) -> str:
    return f"X{decimal(step.end_mm[0])}Y{decimal(step.end_mm[1])}"


def _modes_again(modes: Modes) -> list[str]:
    words = f"G{modes.motion}" if modes.motion in (0, 1) else ""
    words += f"F{decimal(modes.feed_mm_min)}" if modes.feed_mm_min else ""
    if modes.motion == 1 and not modes.feed_mm_min:
        words = ""
    return [words + (f"S{decimal(modes.s_count)}" if modes.s_count and modes.beam != 5 else "")] if words else []


def burnt_before_mm(program: Program, place: Place) -> float:
    """Return the length burnt up to `place`."""
    done = sum(step.length_mm for step in program.steps[: place.step_index] if step.burns)
    step = program.steps[place.step_index]
    return done + (step.length_mm * place.along_ratio if step.burns else 0.0)
