"""A cut begins where the head is, wherever it was when the cut was planned, and takes the time that was told."""

from __future__ import annotations

import pytest

from benchmarks._laser_jobs import timed_jobs
from benchmarks._laser_kills import PROGRAM, RUN_ON_S, missing_count, twice_mm
from benchmarks._laser_rig import LAB, Rig
from drivers.grbl.laser import Laser
from drivers.grbl.run import Progress
from fabctl.cut.execute import run_plan
from fabctl.cut.place import Affine, homed_mm
from fabctl.cut.plan import CutPlan, program_times
from fabctl.cut.program import read_program
from fabctl.cut.progress import Track
from fabctl.events import silent

SHORT = ("wave", "dense", "hurried", "scattered")


def run(laser: Laser, lines: list[str]) -> tuple[Progress, Track]:
    assert laser.identity is not None
    program = read_program(lines)  # as if the head stood at zero
    plan = CutPlan(program, program_times(program, laser.identity), Affine(), (0.0, 0.0, 0.0), ())
    return run_plan(laser, plan, RUN_ON_S, silent)


@pytest.mark.parametrize("head_mm", [(-290.0, -10.0), (-5.0, -195.0), (-150.0, -100.0)])
def test_a_head_moved_since_the_plan_is_not_taken_for_one_off_its_path(head_mm: tuple[float, float]) -> None:
    rig = Rig()
    rig.board.machine.declare_position((round(250 * head_mm[0]), round(250 * head_mm[1]), -250))
    rig.board.machine.sync_position()
    laser = rig.laser()
    laser.connect()
    progress, track = run(laser, PROGRAM)
    assert progress.answered_count == len(PROGRAM)
    assert missing_count(rig, read_program(PROGRAM)) == 0
    assert twice_mm(rig, read_program(PROGRAM)) < 0.05
    assert progress.time_s == pytest.approx(track.times.total_s, rel=0.02)


@pytest.mark.parametrize("name", SHORT)
def test_a_short_job_ends_when_the_board_stands_not_when_the_host_has_listened_on(name: str) -> None:
    rig = Rig()
    rig.board.trace = None
    laser = rig.laser()
    laser.connect()
    begun_s = rig.clock.now_s()
    progress, track = run(laser, timed_jobs()[name])
    assert progress.time_s == pytest.approx(track.times.total_s, rel=0.01)
    assert rig.clock.now_s() - begun_s > progress.time_s + 0.2  # the host's own, in which nothing moves


@pytest.mark.parametrize("mask", [0, 1, 2, 3])
def test_where_the_head_stands_after_homing_is_known_before_it(mask: int) -> None:
    rig = Rig(settings={**LAB, 23: mask, 27: 2})
    laser = rig.laser()
    identity = laser.connect()
    found = laser.home().machine_mm
    assert found is not None
    assert homed_mm(identity, (300.0, 200.0))[:2] == pytest.approx(found[:2], abs=0.005)
