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
from drivers.grbl.link import RESET
from drivers.grbl.messages import Alarm, Banner, Vector
from drivers.grbl.overrides import Override
from drivers.grbl.run import Progress, StoppedByOperator, Wish, run_program
from fabctl.cut.place import travel_box_mm

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


def place(laser: Laser) -> Vector:
    """Return where the board says it is; which of its two ways of saying so it takes is its own affair (`$10`)."""
    report = laser.report()
    found = report.machine_mm or report.work_mm
    assert found is not None
    return found


def inward(laser: Laser) -> tuple[int, int]:
    """Return the signs that lead from the homed corner into the travel."""
    assert laser.identity is not None
    x, y, _, _ = travel_box_mm(laser.identity, (1.0, 1.0))
    return (1 if x == 0 else -1), (1 if y == 0 else -1)


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
    before, (sx, _) = place(laser), inward(laser)
    assert laser.identity is not None
    lines = ["G21", "G91", "M4S0", f"G1X{sx}F100", "G99", f"G1X{-sx}", "M5"]
    assert check_program(laser.link, lines, laser.identity.rx_bytes) == [(4, 20)]
    assert place(laser) == before


def test_many_lines_pass_check_mode_without_an_error(laser: Laser) -> None:
    ready(laser)
    assert laser.identity is not None
    sx, _ = inward(laser)
    lines = ["G21", "G91", "G1F1000", *(f"X{0.5 * (sx if k % 2 == 0 else -sx)}Y0.000" for k in range(500))]
    assert check_program(laser.link, lines, laser.identity.rx_bytes) == []


def test_off_is_confirmed_and_keeps_the_position_at_standstill(laser: Laser) -> None:
    ready(laser)
    left = laser.off()
    assert left.confirmed
    assert left.position_known


@pytest.mark.usefixtures("may_move")
def test_a_program_runs_to_its_end_and_back(laser: Laser, beam_s_count: int) -> None:
    before, (sx, sy) = place(ready(laser)), inward(laser)
    lines = incremental("M4S0", f"G1X{5 * sx}F1200S{beam_s_count}", f"Y{5 * sy}", f"X{-5 * sx}", f"Y{-5 * sy}")
    done = run_program(laser, lines, watch := Watch())
    assert done.answered_count == len(lines)
    assert place(laser) == before
    assert "Run" in watch.states


@pytest.mark.usefixtures("may_move")
def test_hold_and_resume(laser: Laser, beam_s_count: int) -> None:
    before, (sx, _) = place(ready(laser)), inward(laser)
    lines = incremental("M4S0", f"G1X{5 * sx}F120S{beam_s_count}", f"X{-5 * sx}")
    watch = Watch((0.8, "hold"), (2.0, "resume"))
    run_program(laser, lines, watch)
    assert "Hold" in watch.states
    assert place(laser) == before


@pytest.mark.usefixtures("may_move")
def test_stopping_is_quick_and_keeps_the_position(laser: Laser, beam_s_count: int) -> None:
    sx, _ = inward(ready(laser))
    with pytest.raises(StoppedByOperator):
        run_program(laser, incremental("M4S0", f"G1X{5 * sx}F120S{beam_s_count}"), Watch((0.8, "stop")))
    assert laser.left is not None
    assert laser.left.confirmed
    assert laser.left.position_known


@pytest.mark.usefixtures("may_move")
def test_an_error_in_a_run_names_the_line_and_stops(laser: Laser) -> None:
    sx, _ = inward(ready(laser))
    with pytest.raises(LineRefused) as caught:
        run_program(laser, incremental(f"G1X{sx}F600", "G99", f"X{-sx}"), Watch())
    assert caught.value.index == 4
    assert caught.value.code == 20


@pytest.mark.usefixtures("may_move")
def test_a_reset_in_motion_locks_the_board_and_is_told_as_an_alarm(laser: Laser) -> None:
    sx, _ = inward(ready(laser))
    for line in ("G21", "G91", f"G1X{5 * sx}F120"):
        laser.ask(line)
    wait_for(laser, "Run")
    laser.link.send(RESET)
    came, seen = laser.link.wait_for(lambda message: isinstance(message, Banner), 4.0)
    assert came
    assert [message.code for message in seen if isinstance(message, Alarm)] == [3]
    laser.begin()
    assert laser.report().state == "Alarm"
    with pytest.raises(DeviceRefused, match="error 9"):
        laser.ask(f"G0X{-sx}")
    assert laser.unlock().state == "Idle"


@pytest.mark.usefixtures("may_move")
def test_connecting_to_a_moving_board_stops_it_and_keeps_its_place(laser: Laser) -> None:
    sx, _ = inward(ready(laser))
    for line in ("G21", "G91", f"G1X{5 * sx}F120"):
        laser.ask(line)
    wait_for(laser, "Run")
    laser.link.send(b"G1X0.")  # and half a line of the sender that has died
    laser.connect()
    first = place(laser)
    assert laser.report().state == "Idle"  # a lost position would be an alarm
    assert place(laser) == first


@pytest.mark.usefixtures("may_move")
def test_overrides_reach_the_board_in_motion(laser: Laser) -> None:
    before, (sx, _) = place(ready(laser)), inward(laser)
    for line in ("G21", "G91", f"G1X{5 * sx}F120"):
        laser.ask(line)
    wait_for(laser, "Run")
    assert shown_overrides(laser, "feed", 150) == (150, 100, 100)
    assert shown_overrides(laser, "feed", 100) == (100, 100, 100)
    laser.ask(f"X{-5 * sx}")
    laser.wait_until_idle(30.0)
    assert place(laser) == before


@pytest.mark.usefixtures("may_move")
def test_a_jog_goes_and_comes_back(laser: Laser) -> None:
    before, (sx, sy) = place(ready(laser)), inward(laser)
    laser.jog(3.0 * sx, 3.0 * sy, 20.0)
    assert place(laser) != before
    laser.jog(-3.0 * sx, -3.0 * sy, 20.0)
    assert place(laser) == before


@pytest.mark.usefixtures("may_move")
def test_a_cancelled_jog_stops_short_and_leaves_the_board_idle(laser: Laser) -> None:
    before, (sx, _) = place(ready(laser)), inward(laser)
    laser.ask(f"$J=G91G21X{5 * sx}F60")
    wait_for(laser, "Jog")
    laser.cancel_jog()
    laser.wait_until_idle(5.0)
    assert abs(place(laser)[0] - before[0]) < 4.9


def wait_for(laser: Laser, state: str) -> None:
    end_s = time.monotonic() + 5.0
    while laser.report().state != state:
        assert time.monotonic() < end_s, f"never said {state}"


def shown_overrides(laser: Laser, which: Override, percent: int) -> tuple[int, int, int] | None:
    """Set an override and return what the next report that tells them shows; not every report does."""
    laser.override(which, percent)
    for _ in range(40):
        found = laser.report().overrides
        if found is not None:
            return found
    return None
