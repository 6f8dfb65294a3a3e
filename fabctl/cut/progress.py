"""Where in the program the machine is, judged by the positions it reports; and how far ahead lines may be sent."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from fabctl.cut.estimate import Estimate
from fabctl.cut.program import Program, Step

NEAR_MM = 0.05
LEAST_AHEAD_S = 0.15  # of burning is sent ahead where slits are shorter: two reports and their way back
LOST_MM = 1.0
OVERLAP_MM = 0.1  # cut again before the last place seen: homing finds its switches only to about this
SLACK_MM = 0.002  # a report is rounded


@dataclass(frozen=True, slots=True)
class Place:
    """A place on the program's path: the step, how far along it, how far off it, and the estimated time there."""

    step_index: int
    along_ratio: float
    off_mm: float
    t_s: float


def project(step: Step, point_mm: tuple[float, float]) -> tuple[float, float]:
    """Return (share of the step's length, distance) of the step's nearest place to `point_mm`."""
    ax, ay = step.start_mm
    dx, dy = step.end_mm[0] - ax, step.end_mm[1] - ay
    length_sq = dx * dx + dy * dy
    share = 1.0
    if length_sq > 0:
        share = min(max(((point_mm[0] - ax) * dx + (point_mm[1] - ay) * dy) / length_sq, 0.0), 1.0)
    return share, math.hypot(ax + share * dx - point_mm[0], ay + share * dy - point_mm[1])


def locate(
    steps: Sequence[Step], times: Estimate, point_mm: tuple[float, float], first: int, last: int, expected_s: float
) -> Place | None:
    """Return the place among steps `first` to `last` where a machine at `point_mm` most likely is.

    A path may cross or repeat itself: of the places near enough, the one whose time is nearest to `expected_s`.
    Where none is near, the nearest one of all, with its distance in `off_mm`; None only where there are no steps.
    """
    best: Place | None = None
    for k in range(first, min(last + 1, len(steps))):
        share, off_mm = project(steps[k], point_mm)
        begin_s = times.end_s[k - 1] if k else 0.0
        here = Place(k, share, off_mm, begin_s + share * (times.end_s[k] - begin_s))
        if best is None or _better(here, best, expected_s):
            best = here
    return best


def _better(new: Place, old: Place, expected_s: float) -> bool:
    near, was_near = new.off_mm <= NEAR_MM, old.off_mm <= NEAR_MM
    if near and was_near:
        return abs(new.t_s - expected_s) < abs(old.t_s - expected_s)
    return near if near != was_near else new.off_mm < old.off_mm


@dataclass
class Track:
    """Follows one run. Positions come in work coordinates; `now_s` is the host's clock."""

    program: Program
    times: Estimate
    max_run_on_s: float
    done_s: float = 0.0  # of the estimated time, surely over
    place: Place | None = None
    off_mm: float = 0.0
    _seen_s: float | None = None
    _first: int = 0

    def __post_init__(self) -> None:
        self._last_step = last_steps(self.program)
        self.line_end_s = [self.times.end_s[k] if k >= 0 else 0.0 for k in self._last_step]
        self._burnt_mm, self._stroke_mm = burnt_mm(self.program.steps)
        self._longest_mm = max(self._stroke_mm, default=0.0)
        self._line_burnt_mm = [self._burnt_mm[k + 1] for k in self._last_step]

    def limit_count(self) -> int:
        """Return how many lines may have been sent.

        So many that the board never holds more than `max_run_on_s` of work, nor more burning beyond the place it last
        reported than one stroke (this one, the next one, or the program's longest where that is too little to run
        smoothly): should its position be lost, no more than that can be burnt twice.
        """
        allowed = bisect_right(self.line_end_s, self.done_s + self.max_run_on_s)
        allowed = min(allowed, bisect_right(self._line_burnt_mm, self._burn_limit_mm()))
        return max(allowed, self._first_open_line() + 1)

    def _burn_limit_mm(self) -> float:
        """Return the burnt length, from the program's begin, up to which lines may be sent."""
        if not self.program.steps:
            return math.inf
        k = min(bisect_right(self.times.end_s, self.done_s), len(self.program.steps) - 1)
        step, done = self.program.steps[k], self._burnt_mm[k]
        if self.place is not None and self.place.step_index == k and step.burns:
            done += max(step.length_mm * self.place.along_ratio - OVERLAP_MM, 0.0)  # where it would be gone on from
        ahead = bisect_right(self._burnt_mm, self._burnt_mm[k + 1])  # the first step that burns after this one
        next_mm = self._stroke_mm[ahead - 1] if ahead <= len(self._stroke_mm) else 0.0
        cut = step if step.burns or not next_mm else self.program.steps[ahead - 1]
        least_mm = LEAST_AHEAD_S * cut.speed_mm_s if math.isfinite(cut.speed_mm_s) else 0.0
        return done + max(self._stroke_mm[k], next_mm, min(least_mm, self._longest_mm)) + SLACK_MM

    def _first_open_line(self) -> int:
        return bisect_right(self.line_end_s, self.done_s)

    def reported(self, point_mm: tuple[float, float], sent_count: int, moving: bool, now_s: float) -> None:
        """Take one reported position while the board works on the lines sent so far."""
        if sent_count == 0 or not self.program.steps:
            return
        last = self._last_step[sent_count - 1]
        elapsed_s = now_s - self._seen_s if self._seen_s is not None and moving else 0.0
        self._seen_s = now_s
        found = locate(self.program.steps, self.times, point_mm, self._first, last, self.done_s + elapsed_s)
        if found is None:
            return
        self.off_mm = found.off_mm
        if found.off_mm <= NEAR_MM:
            self.place, self._first = found, found.step_index
            self.done_s = max(self.done_s, found.t_s)

    def all_done(self, answered_count: int) -> None:
        """The board stands idle with nothing unanswered: every line sent is over."""
        if answered_count:
            self.done_s = max(self.done_s, self.line_end_s[answered_count - 1])
            self._first = max(self._first, self._last_step[answered_count - 1], 0)

    @property
    def done_frac(self) -> float:
        """Return the share of the estimated time that is over."""
        return min(self.done_s / self.times.total_s, 1.0) if self.times.total_s > 0 else 0.0


def burnt_mm(steps: Sequence[Step]) -> tuple[list[float], list[float]]:
    """Return the length burnt before each step and after the last, and the length of the stroke each step is in."""
    burnt, strokes = [0.0], [0.0] * len(steps)
    first = 0
    for k, step in enumerate(steps):
        burnt.append(burnt[-1] + (step.length_mm if step.burns else 0.0))
        if not step.burns:
            first = k + 1
        elif k + 1 == len(steps) or not steps[k + 1].burns:
            strokes[first : k + 1] = [burnt[-1] - burnt[first]] * (k + 1 - first)
    return burnt, strokes


def last_steps(program: Program) -> list[int]:
    """Return for every line the index of the last step up to and including it, -1 before the first."""
    last = [-1] * len(program.lines)
    for k, step in enumerate(program.steps):
        last[step.line_index] = k
    for index in range(1, len(last)):
        last[index] = max(last[index], last[index - 1])
    return last
