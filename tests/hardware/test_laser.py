"""The laser driver against whatever answers at `--laser-url`: a real board, a pty, a TCP port.

Motion tests move at most 5 mm each way from where the head is, and come back.
"""

from __future__ import annotations

import time

import pytest

from drivers.errors import DeviceRefused
from drivers.grbl.check import check_program
from drivers.grbl.faults import LineRefused
from drivers.grbl.laser import Laser
from drivers.grbl.run import Progress, StoppedByOperator, Wish, run_program

pytestmark = pytest.mark.hardware


class Watch:
    """Follows a run; holds, resumes and stops at given times."""

    def __init__(self, *wishes: tuple[float, Wish]) -> None:
        self.wishes = list(wishes)
        self.begun_s = time.monotonic()
        self.states: list[str] = []

    def limit_count(self, now_s: float) -> int | None:
        return None

    def seen(self, progress: Progress, now_s: float) -> None:
        if progress.report is not None:
            self.states.append(progress.report.state)

    def wish(self) -> Wish:
        if self.wishes and time.monotonic() - self.begun_s >= self.wishes[0][0]:
            return self.wishes.pop(0)[1]
        return ""


def ready(laser: Laser) -> Laser:
    if laser.report().state == "Alarm":
        laser.unlock()
    assert laser.report().state == "Idle"
    return laser


def incremental(*moves: str) -> list[str]:
    return ["G21", "G91", "G94", *moves, "G90", "M5", "G4P0.01"]


def test_the_board_says_who_it_is(laser: Laser) -> None:
    assert laser.identity is not None
    assert laser.identity.rx_bytes >= 64
    assert laser.identity.planner_count >= 1
    assert laser.identity.settings


def test_status_is_answered_within_a_second(laser: Laser) -> None:
    began_s = time.monotonic()
    for _ in range(10):
        laser.report()
    assert time.monotonic() - began_s < 10


def test_connecting_again_works_and_half_a_line_harms_nobody(laser: Laser) -> None:
    laser.link.send(b"G0X9")
    laser.connect()
    assert laser.report().state in ("Idle", "Alarm")


def test_the_board_s_errors_come_back_as_errors(laser: Laser) -> None:
    ready(laser)
    with pytest.raises(DeviceRefused, match="error 20"):
        laser.ask("G99")


def test_check_mode_finds_bad_lines_and_moves_nothing(laser: Laser) -> None:
    ready(laser)
    before = laser.report().machine_mm
    refused = check_program(laser.link, ["G21", "G91", "M4S0", "G1X-1F100", "G99", "G1X1", "M5"], 128)
    assert refused == [(4, 20)]
    assert laser.report().machine_mm == before


def test_many_lines_pass_check_mode_without_an_error(laser: Laser) -> None:
    ready(laser)
    assert laser.identity is not None
    lines = ["G21", "G91", "G1F1000", *(f"X{'-' if k % 2 == 0 else ''}0.5Y0.000" for k in range(500))]
    assert check_program(laser.link, lines, laser.identity.rx_bytes) == []


def test_off_is_confirmed_and_keeps_the_position_at_standstill(laser: Laser) -> None:
    ready(laser)
    left = laser.off()
    assert left.confirmed
    assert left.position_known


@pytest.mark.usefixtures("may_move")
def test_a_program_runs_to_its_end_and_back(laser: Laser, beam_s_count: int) -> None:
    before = ready(laser).report().machine_mm
    lines = incremental("M4S0", f"G1X-5F1200S{beam_s_count}", "Y-5", "X5", "Y5")
    done = run_program(laser, lines, watch := Watch())
    assert done.answered_count == len(lines)
    assert laser.report().machine_mm == before
    assert "Run" in watch.states


@pytest.mark.usefixtures("may_move")
def test_hold_and_resume(laser: Laser, beam_s_count: int) -> None:
    before = ready(laser).report().machine_mm
    lines = incremental("M4S0", f"G1X-5F120S{beam_s_count}", "X5")
    watch = Watch((0.8, "hold"), (2.0, "resume"))
    run_program(laser, lines, watch)
    assert "Hold" in watch.states
    assert laser.report().machine_mm == before


@pytest.mark.usefixtures("may_move")
def test_stopping_is_quick_and_keeps_the_position(laser: Laser, beam_s_count: int) -> None:
    ready(laser)
    with pytest.raises(StoppedByOperator):
        run_program(laser, incremental("M4S0", f"G1X-5F120S{beam_s_count}"), Watch((0.8, "stop")))
    assert laser.left is not None
    assert laser.left.confirmed
    assert laser.left.position_known


@pytest.mark.usefixtures("may_move")
def test_an_error_in_a_run_names_the_line_and_stops(laser: Laser) -> None:
    ready(laser)
    with pytest.raises(LineRefused) as caught:
        run_program(laser, incremental("G1X-1F600", "G99", "X1"), Watch())
    assert caught.value.index == 4
    assert caught.value.code == 20


@pytest.mark.usefixtures("may_move")
def test_a_jog_goes_and_comes_back(laser: Laser) -> None:
    before = ready(laser).report().machine_mm
    laser.jog(-3.0, -3.0, 20.0)
    laser.jog(3.0, 3.0, 20.0)
    assert laser.report().machine_mm == before
