"""What the firmware does while its steppers settle (`$1`), and the single precision it counts in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks._laser_dialogues import alike, board_time, replay, rows_of
from simulators.grbl.board import Board, Point
from simulators.grbl.machine import State
from tests.simulators.test_grbl_board import board, say

STANDS_S = 10 / 25 + 25 / 500  # ten millimetres at F1500 and 500 mm/s²


def cut_ten_mm(**settings: float) -> Board:
    b = board(**settings)
    say(b, b"M4S500\nG1X10F1500\n", STANDS_S + 0.010)
    return b


def test_a_board_that_has_stopped_says_run_until_its_steppers_have_settled() -> None:
    b = cut_ten_mm()
    assert say(b, b"?", 0.005) == ""
    assert say(b, b"", 0.02).startswith("<Run|MPos:10.000,0.000,0.000|FS:0,0|")
    assert say(b, b"?", 0.01).startswith("<Idle|")


def test_steppers_that_stay_on_are_not_waited_for() -> None:
    assert say(cut_ten_mm(_1=255), b"?", 0.01).startswith("<Idle|MPos:10.000")


def test_a_longer_lock_holds_up_the_line_that_waits_for_standstill() -> None:
    assert [say(cut_ten_mm(_1=lock), b"M5\n", 0.1) for lock in (255, 200)] == ["ok\r\n", ""]


def test_a_hold_is_complete_only_after_the_lock() -> None:
    b = board(_1=100)
    say(b, b"M4S500\nG1X100F1500\n", 1.0)
    say(b, b"!", 0.110)
    assert say(b, b"?", 0.010) == ""
    assert say(b, b"~?", 0.1).startswith("<Hold:1|")  # the resume came too early, and is lost
    assert say(b, b"?", 0.02).startswith("<Hold:0|")


@pytest.mark.parametrize(("mode", "lock", "measured_s"), [("M4", 25, 0.080), ("M4", 255, 0.080), ("M3", 255, 0.092)])
def test_a_hold_is_dark_when_the_real_board_was(mode: str, lock: int, measured_s: float) -> None:
    trace: list[Point] = []
    b = board(trace, _1=lock)
    say(b, f"{mode}S500\nG1X100F1500\n".encode(), 1.0)
    began_s = b.machine.now_s
    say(b, b"!", 0.3)
    dark_s = next(p.t_s for p in trace if p.t_s > began_s and p.power_frac == 0) - began_s
    assert dark_s == pytest.approx(measured_s, abs=0.010)  # a segment more or less


def test_what_comes_while_a_reset_waits_is_kept_for_after_the_banner() -> None:
    b = board()
    b.receive(b"\x18")
    b.advance_to(b.machine.now_s + 0.005)
    said = say(b, b"G21\n?", 0.1)
    assert said.endswith("ok\r\n")
    assert said.startswith("\r\nGrbl 1.1h ['$' for help]\r\n<Idle")
    assert b.rx_lost_count == 0


def test_a_reset_in_motion_is_deaf_while_the_steppers_settle() -> None:
    b = board()
    say(b, b"M4S500\nG1X100F1500\n", 1.0)
    lost = b.rx_lost_count
    said = say(b, b"\x18" + b"G21\n" * 10, 1.0)
    assert b.rx_lost_count > lost + 30
    assert said.startswith("ALARM:3\r\n")


def test_a_jog_that_ended_before_its_cancel_leaves_no_hold() -> None:
    b = board()
    say(b, b"$J=X1F6000\n", 1.0)
    assert b.machine.state is State.IDLE
    say(b, b"\x85", 0.1)
    assert say(b, b"?", 0.02).startswith("<Idle|")


def test_a_cancelled_jog_returns_to_idle_with_nothing_left() -> None:
    b = board()
    say(b, b"$J=X100F6000\n$J=X150F6000\n", 0.3)
    say(b, b"\x85", 0.5)
    assert say(b, b"?", 0.02).startswith("<Idle|")
    place = b.machine.position_mm()
    say(b, b"~", 0.5)
    assert b.machine.position_mm() == place


@pytest.mark.parametrize("pause", [b"!", b"\x84"])
def test_lines_that_came_during_a_hold_are_answered_when_it_ends(pause: bytes) -> None:
    b = board()
    say(b, pause, 0.05)
    assert say(b, b"G21\nG90\n", 0.2) == ""
    assert say(b, b"~", 0.2) == "ok\r\nok\r\n"


@pytest.mark.parametrize("place", ["10.1", "0.7", "33.3", "-7.9"])
def test_zero_is_shown_without_a_sign_as_single_precision_finds_it(place: str) -> None:
    b = board(_10=0)
    say(b, f"G0X{place}Y{place}\n".encode(), 3.0)
    say(b, b"\x18", 0.5)
    assert say(b, b"G10L20P1X0Y0\n", 0.5) == "ok\r\n"
    assert say(b, b"?").startswith("<Idle|WPos:0.000,0.000,0.000|")


def test_half_a_step_is_rounded_as_single_precision_has_it() -> None:
    b = board()
    say(b, b"G0X10.006\n", 2.0)
    assert b.machine.position_steps()[0] == 2502  # 2501.4999 in double precision


def test_inches_are_shown_by_the_firmware_s_own_factor() -> None:
    b = board(_13=1)
    say(b, b"G0X300\n", 5.0)
    assert "|MPos:" in (said := say(b, b"?"))
    assert "MPos:11.8110," in said
    assert "F3937.0 " in say(b, b"G1F100000\n$G\n")


def test_a_recorded_hold_is_answered_at_the_recorded_times_without_any_allowance(shared: Path) -> None:
    rows = rows_of(shared / "laser" / "grbl-1.1h-dialogues" / "feed-hold.jsonl")
    recorded = b"".join(row.data for row in rows if not row.sent).decode("latin-1").split("\r\n")
    simulated = replay(rows, board_time(rows))
    assert [(a, b) for a, b in zip(recorded, simulated, strict=True) if not alike(a, b)] == []


def test_recorded_motion_takes_as_long_as_it_takes_here(shared: Path) -> None:
    path = shared / "laser" / "grbl-1.1h-dialogues" / "motion.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    last = next(k for k, row in enumerate(rows) if row["bytes"] == "M5\n")
    b = Board()
    for row in rows[: last + 1]:
        if row["dir"] == ">":
            b.advance_to(row["t_s"])
            b.take()
            b.receive(row["bytes"].encode("latin-1"))
    while b.take() != b"ok\r\n":
        b.advance_to(b.machine.now_s + 0.001)
    assert rows[last + 1]["t_s"] - b.machine.now_s == pytest.approx(0.010, abs=0.012)  # the recorder looked every 20 ms
