"""The host dies at a random moment: the beam never stays on, and resuming burns the rest and nothing twice."""

from __future__ import annotations

import pytest

from benchmarks._laser_kills import PROGRAM, RUN_ON_S, killed_run, missing_count, resumed, twice_mm
from benchmarks._laser_rig import lit_while_standing, slits
from fabctl.cut.program import read_program

KILLS = range(10)  # `python -m benchmarks laser` does a hundred
SLIT_MM = 5.0


@pytest.mark.parametrize("seed", KILLS)
def test_after_a_kill_the_beam_is_never_on_while_standing_and_the_board_soon_stops(seed: int) -> None:
    rig, _, died_s = killed_run(seed, read_program(PROGRAM))
    rig.board.advance_to(died_s + RUN_ON_S + 0.5)
    assert lit_while_standing(rig.trace) < 0.02
    assert rig.board.machine.pin.power_frac == 0
    assert rig.board.machine.state.value == "Idle"


@pytest.mark.parametrize("seed", KILLS)
def test_a_killed_cut_goes_on_where_it_stopped(seed: int) -> None:
    program = read_program(PROGRAM)
    rig, rows, died_s = killed_run(seed, program)
    assert resumed(rig, rows, program, died_s)
    assert missing_count(rig, program) == 0
    assert twice_mm(rig, program) <= 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_restarted_board_is_not_believed_and_nothing_is_left_uncut(seed: int) -> None:
    program = read_program(PROGRAM)
    rig, rows, died_s = killed_run(seed, program)
    assert not resumed(rig, rows, program, died_s, restart=True)
    assert missing_count(rig, program) == 0
    assert twice_mm(rig, program) <= SLIT_MM


@pytest.mark.parametrize("seed", range(4))
def test_a_board_that_ran_on_alone_and_then_restarted_burns_at_most_one_slit_twice(seed: int) -> None:
    program = read_program(PROGRAM)
    rig, rows, died_s = killed_run(seed, program, absence_s=8.0)
    assert not resumed(rig, rows, program, died_s, restart=True)
    assert missing_count(rig, program) == 0
    assert twice_mm(rig, program) <= SLIT_MM


@pytest.mark.parametrize("length_mm", [1.0, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_of_slits_shorter_than_two_reports_no_more_than_one_is_burnt_twice_either(seed: int, length_mm: float) -> None:
    program = read_program(slits(30, length_mm=length_mm))
    rig, rows, died_s = killed_run(seed, program, absence_s=8.0)
    assert not resumed(rig, rows, program, died_s, restart=True)
    assert missing_count(rig, program) == 0
    assert twice_mm(rig, program) <= length_mm
