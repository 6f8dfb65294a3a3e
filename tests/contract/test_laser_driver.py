"""The laser driver against the simulated board, in virtual time."""

from __future__ import annotations

import pytest

from benchmarks._laser_rig import LAB, Rig, Watch, slits
from drivers.errors import DeviceAlarm, DeviceError, DeviceRefused, ProtocolError
from drivers.grbl.faults import LineRefused
from drivers.grbl.laser import Laser
from drivers.grbl.run import StoppedByOperator, run_program
from drivers.transport.memory import MemoryTransport


def connected(rig: Rig) -> Laser:
    laser = rig.laser()
    laser.connect()
    return laser


def test_connecting_stops_a_moving_board_and_keeps_its_position() -> None:
    rig = Rig()
    rig.board.receive(b"G21G90M4S0\nG1X-200F1500S500\nG1X-2")  # half a line of a dead sender
    rig.board.advance_to(rig.clock.now_s() + 1.0)
    assert rig.board.machine.pin.power_frac > 0
    laser = connected(rig)
    report = laser.report()
    assert report.state == "Idle"
    assert rig.board.machine.pin.power_frac == 0
    assert laser.ask("G4P0") == []  # the half line is gone, not completed
    assert laser.report().machine_mm == report.machine_mm


def test_connecting_frees_a_board_locked_by_a_soft_limit() -> None:
    rig = Rig()
    rig.board.receive(b"G0X50\n")
    rig.board.advance_to(rig.clock.now_s() + 1.0)
    assert connected(rig).report().state == "Alarm"


def test_connecting_asks_before_it_resets_and_sends_lines_last() -> None:
    rig = Rig()
    connected(rig)
    sent = bytes(rig.sent)
    assert sent.index(b"?") < sent.index(b"\x18") < sent.index(b"$I\n")


@pytest.mark.parametrize("changes", [{10: 0}, {13: 1}, {10: 2, 13: 1}])
def test_where_the_machine_is_comes_in_mm_whatever_the_board_reports(changes: dict[int, float]) -> None:
    rig = Rig(settings={**LAB, **changes})
    laser = connected(rig)
    laser.ask("G10L2P1X-30Y-20")  # told in a later report, beside the place
    laser.jog(-5, -2.5, 50.0)
    for _ in range(40):
        report = laser.report()
        assert report.machine_mm == pytest.approx((-6.0, -3.5, -1.0), abs=0.003)
    laser = connected(rig)
    assert laser.identity is not None
    assert laser.identity.work_offset_mm() == pytest.approx((-30.0, -20.0, 0.0), abs=0.003)
    assert laser.off().machine_mm == pytest.approx((-6.0, -3.5, -1.0), abs=0.003)


def test_something_that_is_no_grbl_is_said_to_be_none() -> None:
    clock = Rig().clock

    def answer(timeout_s: float) -> bytes:
        clock.sleep(timeout_s)
        return b"login: \r\n"

    laser = Laser(MemoryTransport(lambda data: None, answer), clock)
    with pytest.raises(ProtocolError, match="nothing there answers as a GRBL board"):
        laser.connect()


def test_leaving_the_block_by_an_exception_is_dark_and_confirmed() -> None:
    rig = Rig()
    with pytest.raises(RuntimeError), rig.laser() as laser:
        laser.connect()
        laser.begin()
        laser.link.send(b"G21G90M4S0\nG1X-200F1500S500\n")
        rig.board.advance_to(rig.clock.now_s() + 1.0)
        raise RuntimeError
    assert rig.board.machine.pin.power_frac == 0
    assert laser.left is not None
    assert laser.left.confirmed
    assert laser.left.position_known


def test_a_heavy_machine_found_in_motion_is_braked_to_the_end_before_the_reset() -> None:
    rig = Rig(settings={**LAB, 120: 10})
    rig.board.receive(b"G21G90M4S0\nG1X-200F1500S500\n")
    rig.board.advance_to(rig.clock.now_s() + 5.0)
    laser = connected(rig)  # braking takes two and a half seconds
    report = laser.report()
    assert report.state == "Idle"
    assert report.machine_mm == pytest.approx(rig.board.machine.position_mm(), abs=0.002)


def test_off_never_sends_a_line() -> None:
    rig = Rig()
    laser = connected(rig)
    rig.board.receive(b"G21G90M4S0\nG1X-200F1500S500\n")
    rig.board.advance_to(rig.clock.now_s() + 1.0)
    before = len(rig.sent)
    laser.off()
    assert set(bytes(rig.sent[before:])) <= set(b"!?\x18")


def test_an_error_names_its_line_and_those_that_may_have_run() -> None:
    rig = Rig()
    lines = slits(10)
    lines[9] = "G99X1"
    with pytest.raises(LineRefused) as caught:
        run_program(connected(rig), lines, Watch())
    assert caught.value.index == 9
    assert caught.value.sent_count > 10
    assert "may have run" in str(caught.value)
    assert rig.board.machine.pin.power_frac == 0


def test_an_alarm_in_a_run_ends_it() -> None:
    rig = Rig()
    with pytest.raises(DeviceAlarm) as caught:
        run_program(connected(rig), ["G21", "G90", "G1X-5F1500", "G1X5", "M5"], Watch())
    assert caught.value.code == 2


def test_hold_and_resume_finish_the_job() -> None:
    rig = Rig()
    laser = connected(rig)
    now_s = rig.clock.now_s()
    watch = Watch([(now_s + 0.5, "hold"), (now_s + 2.0, "resume")], rig.clock)
    done = run_program(laser, slits(6), watch)
    assert done.answered_count == len(slits(6))
    assert any(p.report is not None and p.report.state == "Hold" for p in watch.reports)


def test_a_stop_keeps_the_position() -> None:
    rig = Rig()
    laser = connected(rig)
    with pytest.raises(StoppedByOperator):
        run_program(laser, slits(30), Watch([(rig.clock.now_s() + 1.0, "stop")], rig.clock))
    assert laser.left is not None
    assert laser.left.position_known
    assert laser.left.machine_mm == pytest.approx(rig.board.machine.position_mm(), abs=0.002)


def test_a_second_interrupt_resets_at_once() -> None:
    rig = Rig()
    laser = connected(rig)
    rig.board.receive(b"G21G90M4S0\nG1X-200F1500S500\n")
    rig.board.advance_to(rig.clock.now_s() + 1.0)

    def interrupt(data: bytes) -> None:
        if data[:1] == b"!":
            rig.before_send = lambda more: None
            raise KeyboardInterrupt

    rig.before_send = interrupt
    left = laser.off()
    assert left.confirmed
    assert not left.position_known
    assert rig.board.machine.pin.power_frac == 0


@pytest.mark.parametrize("button", [b"!", b"\x84"])
def test_a_board_paused_by_its_own_button_or_door_is_resumed_too(button: bytes) -> None:
    rig = Rig()
    laser = connected(rig)
    now_s = rig.clock.now_s()
    watch = Watch([(now_s + 2.0, "resume")], rig.clock)
    pressed: list[float] = []

    def press(_: bytes) -> None:
        if not pressed and rig.clock.now_s() > now_s + 0.6:
            pressed.append(rig.clock.now_s())
            rig.board.receive(button)

    rig.before_send = press
    done = run_program(laser, slits(6), watch)
    assert done.answered_count == len(slits(6))
    assert {p.report.state for p in watch.reports if p.report is not None} & {"Hold", "Door"}


def test_homing_makes_the_position_known() -> None:
    rig = Rig(homed=False)
    laser = connected(rig)
    assert laser.report().state == "Alarm"
    assert laser.home().machine_mm == pytest.approx((-1.0, -1.0, -1.0))


def test_a_jog_outside_the_travel_is_refused() -> None:
    laser = connected(Rig())
    with pytest.raises(DeviceRefused, match="travel"):
        laser.jog(10.0, 0.0, 50.0)


@pytest.mark.parametrize("percent", [10, 57, 99, 100, 101, 123, 200])
def test_overrides_reach_every_percentage(percent: int) -> None:
    rig = Rig()
    laser = connected(rig)
    laser.override("feed", percent)
    laser.override("power", percent)
    laser.override("rapid", 25)
    overrides = rig.board.machine.overrides
    assert (overrides.feed, overrides.rapid, overrides.spindle) == (percent, 25, percent)


def test_overrides_out_of_range_are_refused() -> None:
    laser = connected(Rig())
    with pytest.raises(ValueError, match="10 to 200"):
        laser.override("feed", 5)
    with pytest.raises(ValueError, match="100, 50 or 25"):
        laser.override("rapid", 60)


def test_an_opened_door_holds_dark_and_is_resumed() -> None:
    rig = Rig()
    laser = connected(rig)
    laser.begin()
    laser.link.send(b"G21G90M4S0\nG1X-50F1500S500\n")
    rig.board.advance_to(rig.clock.now_s() + 0.8)
    laser.open_door()
    rig.board.advance_to(rig.clock.now_s() + 0.5)
    assert laser.report().state == "Door"
    assert rig.board.machine.pin.power_frac == 0
    laser.resume()
    assert laser.wait_until_idle(10.0).machine_mm == pytest.approx((-50.0, -1.0, -1.0))


def test_check_mode_tells_every_bad_line() -> None:
    laser = connected(Rig())
    assert laser.check(["G21", "G99", "G90", "M4S0", "G1X-5F100Q1", "M5"]) == [(1, 20), (4, 20)]
    assert laser.report().state == "Idle"


def test_settings_and_offsets_come_as_values() -> None:
    rig = Rig()
    rig.board.machine.memory.offsets_mm[0] = (10.0, 20.0, 0.0)
    identity = connected(rig).identity
    assert identity is not None
    assert identity.setting(30) == 1000.0
    assert identity.work_offset_mm() == (10.0, 20.0, 0.0)
    assert identity.setting(999) is None


def test_a_refused_question_is_an_error_not_a_crash() -> None:
    with pytest.raises(DeviceError):
        connected(Rig()).ask("$foo")
