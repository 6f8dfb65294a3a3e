"""Kill the host of a simulated cut at a random moment, and see what was burnt: shared by tests and benchmark."""

from __future__ import annotations

import contextlib
import itertools
import math
import random
from collections.abc import Sequence

from benchmarks._laser_rig import Killed, Rig, slits
from drivers.grbl.laser import Laser
from drivers.transport.tap import Tap
from fabctl.cut.execute import run_plan
from fabctl.cut.place import Affine
from fabctl.cut.plan import CutPlan, program_times
from fabctl.cut.program import Program, read_program
from fabctl.cut.trail import MARK, PROGRAM_BEGINS, last_seen, read_trail, rest_of, stopped_at
from fabctl.events import silent
from simulators.grbl.board import Point

KILLS = range(100)
RUN_ON_S = 5.0
GRID_MM = 0.05
ABSENCES_S = (0.3, 1.0, 3.0, 30.0)
PROGRAM = slits(60, length_mm=5.0)


def host(rig: Rig, rows: list[str]) -> Laser:
    laser = Laser(Tap(rig.revive(), rows.append, rig.clock), rig.clock)
    laser.connect()
    return laser


def follow(laser: Laser, program: Program, rows: list[str]) -> None:
    assert laser.identity is not None
    plan = CutPlan(program, program_times(program, laser.identity), Affine(), (0.0, 0.0, 0.0), ())
    rows.append(f'{{"t_s": 0, "dir": "{MARK}", "bytes": "{PROGRAM_BEGINS}"}}')
    run_plan(laser, plan, RUN_ON_S, silent)


def killed_run(
    seed: int, program: Program, absence_s: float | None = None, rig: Rig | None = None
) -> tuple[Rig, list[str], float]:
    """Return a board whose host died in mid-job, the host's log, and when it died."""
    rig, rows, rng = rig or Rig(), list[str](), random.Random(seed)
    laser = host(rig, rows)
    assert laser.identity is not None
    total_s = program_times(program, laser.identity).total_s
    rig.dies_s = rig.clock.now_s() + rng.uniform(0.05, 0.98) * total_s
    with contextlib.suppress(Killed):
        follow(laser, program, rows)
    died_s = rig.dies_s
    rig.dies_s = math.inf
    rig.board.advance_to(died_s + (rng.choice(ABSENCES_S) if absence_s is None else absence_s))
    return rig, rows, died_s


def cells(trace: Sequence[Point]) -> dict[tuple[int, int], float]:
    """Return for every small square of the sheet the length burnt in it."""
    burnt: dict[tuple[int, int], float] = {}
    for a, b in itertools.pairwise(trace):
        length = math.hypot(b.x_mm - a.x_mm, b.y_mm - a.y_mm)
        if a.power_frac > 0 and length > 0:
            count = math.ceil(length / (GRID_MM / 4))
            for k in range(count):
                t = (k + 0.5) / count
                key = (
                    round((a.x_mm + t * (b.x_mm - a.x_mm)) / GRID_MM),
                    round((a.y_mm + t * (b.y_mm - a.y_mm)) / GRID_MM),
                )
                burnt[key] = burnt.get(key, 0.0) + length / count
    return burnt


def wanted(program: Program) -> set[tuple[int, int]]:
    found = set()
    for step in program.steps:
        if step.burns:
            count = math.ceil(step.length_mm / GRID_MM)
            for k in range(1, count):
                x, y = (a + (b - a) * k / count for a, b in zip(step.start_mm, step.end_mm, strict=True))
                found.add((round(x / GRID_MM), round(y / GRID_MM)))
    return found


def resumed(rig: Rig, rows: list[str], program: Program, died_s: float, restart: bool = False) -> bool:
    """Go on with a killed cut as a new host would; return whether the position was kept."""
    if restart:
        rig.board.restart()
    again: list[str] = []
    laser = host(rig, again)
    assert laser.identity is not None
    times = program_times(program, laser.identity)
    trail = read_trail("\n".join(rows), program, times, (0.0, 0.0, 0.0))
    place = stopped_at(trail, program, times, laser.report(), (0.0, 0.0, 0.0), rig.clock.now_s() - died_s)
    if place is None:
        laser.home()
    follow(laser, read_program(rest_of(program, place or last_seen(trail, program))), again)
    return place is not None


def missing_count(rig: Rig, program: Program) -> int:
    """Return how many points of the program were never burnt."""
    return len(wanted(program) - set(cells(rig.trace)))


def twice_mm(rig: Rig, program: Program) -> float:
    """Return the length burnt more than once."""
    return sum(cells(rig.trace).values()) - sum(step.length_mm for step in program.steps if step.burns)
