"""What the simulated board does beyond the recorded dialogues."""

from __future__ import annotations

import math

import pytest

from simulators.grbl.board import Board, Point
from simulators.grbl.gcode import Fault, parse
from simulators.grbl.machine import Machine, State, World
from simulators.grbl.modes import Parser
from simulators.grbl.settings import Memory
from simulators.grbl.words import decimals, read_number


def board(trace: list[Point] | None = None, world: World | None = None, **settings: float) -> Board:
    memory = Memory()
    for name, value in {"110": 6000, "111": 6000, "120": 500, "121": 500, "32": 1, **settings}.items():
        assert memory.store(int(name.strip("_")), value) == 0
    memory.pending_s = 0.0
    found = Board(Machine(memory=memory, world=world or World()), trace=trace.append if trace is not None else None)
    found.advance_to(0.5)
    found.take()
    return found


def say(to: Board, data: bytes, wait_s: float = 0.5) -> str:
    to.receive(data)
    to.advance_to(to.machine.now_s + wait_s)
    return to.take().decode("latin-1")


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("G1X10", 22), ("G99", 20), ("X", 2), ("M3M5", 21), ("G0G1X1", 24), ("G2X10F100", 35), ("G2X10I0J0F100", 33),
        ("G2X10R1F100", 34), ("G2F100I1", 26), ("G2Z1I1F100", 32), ("5G1", 1), ("G1X1X2F1", 25), ("G4", 28),
        ("F-1", 4), ("G10L2P9X1", 29), ("G10L2P1", 26), ("G10P1X1", 20), ("G43.1", 37), ("G43.1X1", 37),
        ("G1.5X1", 23), ("G90.1", 20), ("G61.1", 20), ("G92", 26), ("G80X1", 31), ("G1I1F1", 36), ("T256", 38),
        ("M7", 20), ("G28X1G0", 24), ("G53G2X1I1F1", 30), ("G92.2", 20), ("N99999999", 27), ("G38.6X1F1", 20),
    ],
)  # fmt: skip
def test_a_faulty_line_gets_the_firmware_s_error(line: str, code: int) -> None:
    with pytest.raises(Fault) as caught:
        parse(line, Parser(), Memory())
    assert caught.value.code == code


def test_numbers_are_read_as_the_firmware_reads_them() -> None:
    assert read_number("1.5X", 0) == (1.5, 3)
    assert read_number("-.25", 0) == (-0.25, 4)
    assert read_number("1e3", 0) == (1.0, 1)
    assert read_number("X", 0) is None
    assert read_number("123456789", 0) == (123456784.0, 9)  # eight digits count, in single precision


def test_numbers_are_shown_rounded_half_up() -> None:
    assert [decimals(v, 3) for v in (0.0005, -0.0005, 12.3456, -1.0)] == ["0.001", "-0.001", "12.346", "-1.000"]


def test_a_hold_darkens_m4_after_braking_and_m3_without_laser_mode_stays_on() -> None:
    for mode, laser, dark in (("M4", 1, True), ("M3", 1, True), ("M3", 0, False)):
        b = board(_32=laser)
        say(b, f"{mode}S500\nG1X100F1500\n".encode(), 1.0)
        say(b, b"!", 0.2)
        assert (b.machine.pin.power_frac == 0) is dark, (mode, laser)


def test_a_reset_in_motion_is_dark_at_once_and_loses_the_position() -> None:
    b = board()
    say(b, b"M4S500\nG1X100F1500\n", 1.0)
    assert b.machine.pin.power_frac > 0
    b.receive(b"\x18")
    b.advance_to(b.machine.now_s + 0.0002)
    assert b.machine.pin.power_frac == 0
    assert "ALARM:3" in say(b, b"", 1.0)
    assert b.machine.state is State.ALARM


def test_a_reset_at_standstill_keeps_the_position() -> None:
    b = board()
    say(b, b"M4S500\nG1X100F1500\n", 1.0)
    say(b, b"!", 0.3)
    where = b.machine.position_steps()
    assert "ALARM" not in say(b, b"\x18", 0.5)
    assert b.machine.position_steps() == where
    assert "<Idle" in say(b, b"?")


def test_a_silent_host_leaves_m4_dark_and_m3_lit() -> None:
    for mode, lit in (("M4", False), ("M3", True)):
        b = board()
        say(b, f"{mode}S500\nG1X10F1500\n".encode(), 5.0)
        assert (b.machine.pin.power_frac > 0) is lit


def test_power_follows_speed_under_m4() -> None:
    trace: list[Point] = []
    b = board(trace)
    say(b, b"M4S1000\nG1X20F3000\n", 2.0)
    lit = [p.power_frac for p in trace if p.power_frac > 0]
    assert max(lit) == pytest.approx(1.0, abs=0.01)
    assert lit[0] < 0.25  # still speeding up
    assert trace[-1].power_frac == 0


def test_the_receive_buffer_loses_what_does_not_fit() -> None:
    b = board()
    say(b, b"G1X100F60\n" + b"".join(b"G1X%d\n" % (100 + k) for k in range(60)), 1.0)
    assert b.rx_lost_count > 0


def test_the_board_is_deaf_while_it_writes_its_memory() -> None:
    alone = say(board(), b"$110=1000\n", 1.0)
    assert alone == "ok\r\n"
    b = board()
    crowd = say(b, b"$110=1000\nG0X1\nG0X2\nG0X3\n", 1.0)
    assert crowd.count("ok") < 4
    assert b.rx_lost_count > 0


def test_a_written_value_that_does_not_change_costs_nothing() -> None:
    b = board()
    assert say(b, b"$110=6000\nG0X1\nG0X2\n", 1.0).count("ok") == 3


def test_homing_finds_the_switches_and_sets_the_corner() -> None:
    b = board(world=World(switches=True, real_mm=(-20.0, -15.0, -3.0)), _22=1, _25=3000, _24=300, _26=10)
    assert b.machine.state is State.ALARM
    said = say(b, b"$H\n", 60.0)
    assert said == "ok\r\n"
    assert b.machine.position_mm() == pytest.approx((-1.0, -1.0, -1.0))
    assert b.machine.limits_hit() == set()


def test_homing_without_switches_ends_in_alarm_9() -> None:
    b = board(_22=1, _25=6000, _132=10)
    assert "ALARM:9" in say(b, b"$H\n", 60.0)


def test_a_soft_limit_stops_and_only_a_reset_helps() -> None:
    b = board(_22=1, _20=1)
    say(b, b"$X\n")
    said = say(b, b"G0X10\n", 1.0)
    assert "ALARM:2" in said
    assert "Reset to continue" in said
    assert say(b, b"?$X\n") == ""
    assert "unlock" in say(b, b"\x18", 0.5)


def test_the_door_holds_and_resumes() -> None:
    b = board()
    say(b, b"M4S500\nG1X50F1500\n", 0.5)
    b.machine.world.door_is_open = True
    assert "[MSG:Check Door]" in say(b, b"\x84", 0.5)
    assert "<Door:1" in say(b, b"?")
    assert b.machine.pin.power_frac == 0
    b.machine.world.door_is_open = False
    assert "<Door:0" in say(b, b"?", 0.2) + say(b, b"?", 0.2)
    say(b, b"~", 4.0)
    assert b.machine.position_mm()[0] == pytest.approx(50.0)


def test_a_jog_is_cancelled_where_it_is() -> None:
    b = board()
    assert say(b, b"$J=G91X100F1500\n", 1.0) == "ok\r\n"
    assert "<Jog" in say(b, b"?", 0.1)
    say(b, b"\x85", 0.5)
    assert "<Idle" in say(b, b"?")
    assert 20 < b.machine.position_mm()[0] < 40


def test_check_mode_moves_nothing_and_restarts_on_leaving() -> None:
    b = board()
    assert "[MSG:Enabled]" in say(b, b"$C\n")
    assert say(b, b"G21G90M4S100\nG1X50F1000\nG99\n") == "ok\r\nok\r\nerror:20\r\n"
    assert "Grbl 1.1h" in say(b, b"$C\n")
    assert b.machine.position_steps() == (0, 0, 0)


def test_startup_lines_run_at_every_reset() -> None:
    b = board()
    assert say(b, b"$N0=G20\n", 1.0) == "ok\r\n"
    assert ">G20:ok" in say(b, b"\x18")
    assert "G20" in say(b, b"$G\n")


def test_sleep_wants_a_reset() -> None:
    b = board()
    assert say(b, b"$SLP\n") == "ok\r\n[MSG:Sleeping]\r\n"
    assert "<Sleep" in say(b, b"?")
    assert "unlock" in say(b, b"\x18")


def test_predefined_positions_are_kept_and_gone_to() -> None:
    b = board()
    say(b, b"G0X5Y7\n", 1.0)
    assert say(b, b"G28.1\n", 1.0) == "ok\r\n"
    say(b, b"G0X0Y0\n", 1.0)
    say(b, b"G28\n", 1.0)
    assert b.machine.position_mm()[:2] == pytest.approx((5.0, 7.0))


def test_an_arc_stays_on_its_circle() -> None:
    trace: list[Point] = []
    b = board(trace)
    say(b, b"G0X10\nM4S500\nG2X10Y0I-10J0F3000\n", 8.0)
    lit = [(p.x_mm, p.y_mm) for p in trace if p.power_frac > 0]
    assert len(lit) > 50
    assert max(abs(math.hypot(x, y) - 10) for x, y in lit) < 0.01
    assert b.machine.position_mm()[:2] == pytest.approx((10.0, 0.0))


def test_inverse_time_takes_the_time_it_says() -> None:
    b = board()
    say(b, b"G93G1X20F30\n", 0.1)
    assert "<Run" in say(b, b"?", 1.7)
    assert "<Idle" in say(b, b"", 0.4) + say(b, b"?", 0.2)


def test_a_program_s_end_puts_the_modes_back() -> None:
    b = board()
    assert "[MSG:Pgm End]" in say(b, b"G91G55M4S10M8\nM2\n", 1.0)
    assert say(b, b"$G\n") == "[GC:G1 G54 G17 G21 G90 G94 M5 M9 T0 F0 S10]\r\nok\r\n"


def test_m0_waits_for_the_operator() -> None:
    b = board()
    assert say(b, b"G0X5\nM0\nG0X9\n", 1.0) == "ok\r\n"
    assert "<Hold:0" in say(b, b"?")
    assert say(b, b"~", 1.0).count("ok") == 2
