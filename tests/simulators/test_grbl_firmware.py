"""Corners of the firmware that recorded dialogues seldom reach."""

from __future__ import annotations

import random

import pytest

from simulators.grbl.board import Board
from simulators.grbl.gcode import Fault, parse
from simulators.grbl.machine import Machine, State, World
from simulators.grbl.modes import Parser
from simulators.grbl.settings import Memory
from simulators.grbl.words import read_number
from tests.simulators.test_grbl_board import board, say


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("M-1", 23), ("G256X1", 23), ("M256", 23), ("G4.1P1", 23), ("G10.1L2P1X1", 23), ("G0.5X1", 23), ("G-1", 20),
        ("G28.2", 20), ("G30.3", 20), ("G49X1G1F1", 24), ("G43.1Z1X1", 37), ("G43Z1", 20), ("G92X1G0", 24),
        ("G53G80X1", 30), ("G59.1", 23), ("G60", 20), ("G64", 20), ("G38X1F1", 20), ("G38.2F1", 26), ("G38.2X0F1", 33),
        ("G2X1R0.1F1", 34), ("G2X0Y0R5F1", 33), ("G3X1J1F100", 33), ("G17G2Z1K1F1", 32), ("G18G2Y1I1F1", 32),
        ("G1X1R1F1", 36), ("G0P1", 36), ("L2", 36), ("G10L20P7X0", 29), ("G10L2P1R1X0", 20), ("G10L3P1X0", 20),
        ("G10L20P1R1X0", 36), ("M8M9", 21), ("M0M2", 21), ("G54G55", 21), ("G20G21", 21), ("G17G18", 21),
        ("G90G91", 21), ("G93G94", 21), ("S1S2", 25), ("T-1", 4), ("P-1", 4), ("N-1", 4), ("X1.2.3", 1), ("A1", 20),
        ("G1X1F0", 22), ("G2X1I1F0", 22), ("M6", 20), ("M1M30", 21), ("G93G2X1I1", 22), ("G80", 0), ("M1", 0),
        ("G61", 0), ("G40", 0), ("G49", 0), ("G91.1", 0), ("G4P0", 0), ("G53G0X1", 0), ("N5G0X1", 0), ("G92.1X1", 0),
        ("G43.1Z1", 0), ("G10L2P0X1", 0), ("G3X2Y0R-1F1", 0), ("T255", 0), ("G01X1F1", 0), ("G1X+1F+1", 0), ("F100", 0),
        ("G53X1G1F1", 0), ("G1.0X1F1", 0), ("M05", 0), ("G0G40G17G21G90G94G54X1", 0),
        ("G0G49X1", 24), ("G92X1G0Y1", 24),
    ],
)  # fmt: skip
def test_a_line_gets_the_firmware_s_verdict(line: str, code: int) -> None:
    try:
        parse(line, Parser(), Memory())
        got = 0
    except Fault as fault:
        got = fault.code
    assert got == code


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("$J=X1", "error:22"), ("$J=G0X1F1", "error:16"), ("$J=X1F1S5", "error:36"), ("$J=G91M3X1F1", "error:16"),
        ("$J=G10L2P1X1F1", "error:16"), ("$JX1", "error:3"), ("$J=G20X0.001F10", "ok"), ("$J=G53X0.01F100", "ok"),
        ("$GX", "error:3"), ("$#1", "error:3"), ("$CC", "error:3"), ("$XY", "error:3"), ("$SLPX", "error:3"),
        ("$H", "error:5"), ("$I5", "error:3"), ("$RST=x", "error:3"), ("$RST=$$", "error:3"), ("$33=1", "error:3"),
        ("$103=1", "error:3"), ("$140=1", "error:3"), ("$300=1", "error:3"), ("$10=-1", "error:4"),
        ("$-1=5", "error:3"),
        ("$0=2", "error:6"), ("$0=3", "ok"), ("$20=1", "error:10"), ("$10=1x", "error:3"), ("$10", "error:3"),
        ("$10=", "error:2"), ("$=1", "error:2"), ("$N2=G0", "ok"), ("$N0=G99", "error:20"), ("$N0", "error:3"),
        ("$N=G0", "error:2"), ("$110=0.5", "ok"), ("$26=300", "ok"),
    ],
)  # fmt: skip
def test_a_dollar_line_gets_the_firmware_s_verdict(line: str, answer: str) -> None:
    assert say(board(), f"{line}\n".encode(), 1.0) == f"{answer}\r\n"


@pytest.mark.parametrize("line", ["G92X0", "G55", "G10L20P1X0", "G28.1", "G43.1Z1"])
def test_what_shifts_offsets_waits_for_standstill(line: str) -> None:
    b = board()
    assert say(b, f"G0X20\n{line}\n".encode(), 0.2) == "ok\r\n"
    assert "<Run" in say(b, b"?", 0.05)
    assert say(b, b"", 1.0) == "ok\r\n"
    assert "WCO:" in say(b, b"?", 0.1) or line == "G28.1"


def test_a_startup_line_that_moves_is_kept_after_its_move() -> None:
    b = board()
    assert say(b, b"$N0=G0X20\n", 0.2) == ""
    assert say(b, b"", 2.0) == "ok\r\n"


def test_probing_away_from_an_open_probe_is_an_alarm_at_once() -> None:
    b = board()
    assert say(b, b"G38.4X5F100\n", 1.0) == "ALARM:4\r\nok\r\n"
    assert say(b, b"G0X1\n") == "error:9\r\n"
    assert "MPos:0.000" in say(b, b"?")


def test_a_probe_that_meets_nothing_is_quiet_only_in_its_quiet_form() -> None:
    assert say(board(), b"G38.3X1F600\n", 1.0) == "[PRB:1.000,0.000,0.000:0]\r\nok\r\n"
    assert say(board(), b"G38.2X1F600\n", 1.5).startswith("ALARM:5\r\n[PRB:0.000,0.000,0.000:0]\r\nok\r\n")


def test_turned_pins_show_as_pressed() -> None:
    b = board(_5=1, _6=1)
    assert "|Pn:PXYZ" in say(b, b"?")
    assert say(b, b"G38.2X5F100\n", 1.0) == "ALARM:4\r\nok\r\n"


def test_a_hard_limit_kills_and_wants_a_reset() -> None:
    b = board(world=World(switches=True, real_mm=(-5.0, -50.0, -50.0)), _21=1)
    said = say(b, b"G1X20F3000\n", 2.0)
    assert said == "ok\r\nALARM:1\r\n[MSG:Reset to continue]\r\n"
    assert say(b, b"?$X\n") == ""
    assert b.machine.position_mm()[0] == pytest.approx(5.0, abs=0.6)
    said = say(b, b"\x18", 0.5)
    assert said.endswith("[MSG:Check Limits]\r\n[MSG:'$H'|'$X' to unlock]\r\n")
    assert "|Pn:X" in say(b, b"?")


def test_a_board_built_with_m7_switches_both_airs() -> None:
    b = Board(Machine(options="VM"))
    b.advance_to(0.5)
    b.take()
    assert say(b, b"M7\nM8\n$G\n").endswith("M5 M7 M8 T0 F0 S0]\r\nok\r\n")
    say(b, b"?")
    assert "A:FM" in say(b, b"?") + say(b, b"?")
    assert "M5 M7 T0" in say(b, b"\xa0$G\n")
    assert "M5 M9 T0" in say(b, b"M9\n$G\n")
    assert say(board(), b"M7\n") == "error:20\r\n"


def test_the_air_toggles_during_a_hold_and_ends_with_the_program() -> None:
    b = board()
    say(b, b"M8\nG1X50F1500\n", 0.5)
    say(b, b"!\xa0", 0.3)
    assert b.machine.coolant == 0
    say(b, b"\xa0~", 0.1)
    assert b.machine.coolant == 2


def test_overrides_stop_at_their_ends_and_tell_only_changes() -> None:
    b = board()
    for _ in range(15):
        say(b, b"\x91", 0.02)
    assert b.machine.overrides.feed == 200
    for _ in range(25):
        say(b, b"\x92", 0.02)
    assert b.machine.overrides.feed == 10
    say(b, b"?")
    say(b, b"?")
    assert "Ov:" not in say(b, b"\x94?", 0.1)
    assert "Ov:11,50,100" in say(b, b"\x93\x96?", 0.1)


def test_small_arcs_and_helices_onto_themselves_are_single_lines() -> None:
    b = board()
    assert say(b, b"G2X0.001I0.0005F100\nG2X0Z1R5F6000\n", 1.0) == "ok\r\nok\r\n"
    assert "Idle" in say(b, b"?", 0.5) or b.machine.state is State.RUN


def test_numbers_go_through_the_board_s_single_precision() -> None:
    assert read_number("250.125", 0) == (250.125, 7)
    value = read_number("0.002", 0)
    assert value is not None
    assert value[0] * 250 == pytest.approx(0.5, abs=1e-7)
    assert read_number("9" * 60, 0) == (float("inf"), 60)


def test_a_move_while_check_mode_obeys_soft_limits() -> None:
    b = board(_22=1, _20=1)
    say(b, b"$X\n$C\n")
    assert say(b, b"G0X50\n", 1.0).startswith("ALARM:2\r\n")


def test_no_line_of_garbage_ever_stops_the_board() -> None:
    rng = random.Random(11)
    signs = "GMXYZIJKFSTPLNRQA0123456789.-+$=#H\r(;) !~?\x18\x85\x84\x91\x9e\xa0"
    for seed in range(30):
        b = board()
        for _ in range(60):
            text = "".join(rng.choice(signs) for _ in range(rng.randint(1, 40)))
            b.receive(text.encode("latin-1") + b"\n")
            b.advance_to(b.machine.now_s + 0.05)
        b.receive(b"\x18")
        b.advance_to(b.machine.now_s + 2)
        b.receive(b"\x18")
        b.advance_to(b.machine.now_s + 2)
        b.take()
        assert b"<" in say(b, b"?").encode() or b.machine.state is State.HOMING, seed
