"""The simulated rig on its own: axis, limits, watchdog, specimens, and its line."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simulators.rig import registers as R
from simulators.rig.axis import Axis
from simulators.rig.controller import Controller, Machine
from simulators.rig.faults import FaultyLine
from simulators.rig.modbus import Request, answer, crc16, rtu_frame, take_rtu
from simulators.rig.server import Link, Pace, Server
from simulators.specimens.analytic import bistable, hertz, linear
from simulators.specimens.curve import Curves, Specimen

QUIET = Machine(noise_N=0.0, zero_N=0.0, backlash_mm=0.0, contact_mm=2.0)


class Host:
    """Writes commands and feeds the watchdog, as long as it lives."""

    def __init__(self, device: Controller) -> None:
        self.device, self.number = device, 0

    def command(self, code: int, **values: float) -> dict[str, float]:
        self.number += 1
        body = {name: 0.0 for name, *_ in R.COMMAND} | {"id": self.number, "code": code} | values
        assert self.device.write(100, R.words_of(R.COMMAND, body))
        return self.status()

    def live(self, ticks_count: int) -> dict[str, float]:
        for _ in range(0, ticks_count, 10):
            self.device.advance(10)
            feed = R.words_of(R.FEED, {"feed": self.device.tick_count, "request": 1})
            assert self.device.write(140, feed)
        return self.status()

    def status(self) -> dict[str, float]:
        return R.values_of(R.STATUS, self.device.status_words()[:-1])


def homed(machine: Machine = QUIET, curves: Curves | None = None) -> Host:
    host = Host(Controller(machine, Specimen(curves or linear(0.5))))
    host.command(R.ARM)
    host.command(R.HOME, speed=10)
    assert host.live(1000)["command_state"] == R.DONE
    return host


@settings(deadline=None, max_examples=40)
@given(st.floats(0.5, 20), st.floats(0.5, 30), st.floats(10, 300))
def test_the_axis_comes_to_its_target_within_speed_and_acceleration(
    speed_mm_s: float, way_mm: float, acceleration_mm_s2: float
) -> None:
    axis = Axis(0.0, acceleration_mm_s2)
    axis.go(way_mm, speed_mm_s)
    before, fastest, ticks = 0.0, 0.0, 0
    while not axis.standing and ticks < 400_000:
        axis.tick(0.001)
        assert abs(axis.speed_mm_s - before) <= acceleration_mm_s2 * 0.001 * 2.001 + 1e-9
        before, fastest, ticks = axis.speed_mm_s, max(fastest, axis.speed_mm_s), ticks + 1
    assert axis.position_mm == way_mm
    assert fastest <= speed_mm_s + 1e-9
    reaches_speed = way_mm > speed_mm_s**2 / acceleration_mm_s2
    ramps_s = 2 * math.sqrt(way_mm / acceleration_mm_s2)
    ideal_s = way_mm / speed_mm_s + speed_mm_s / acceleration_mm_s2 if reaches_speed else ramps_s
    assert ticks * 0.001 == pytest.approx(ideal_s, rel=0.12, abs=0.02)


def test_a_silent_host_stops_the_stage_within_the_watchdog() -> None:
    host = homed()
    host.command(R.MOVE, target=40, speed=1)
    host.live(100)
    host.device.advance(500)
    assert host.status()["state"] == R.MOVING
    host.device.advance(30)
    after = host.status()
    assert after["state"] == R.FAULTED
    assert int(after["faults"]) & R.WATCHDOG
    stood = after["position"]
    host.device.advance(1000)
    assert host.status()["position"] == pytest.approx(stood, abs=0.02)


def test_an_old_feed_does_not_feed() -> None:
    host = homed()
    host.command(R.MOVE, target=40, speed=1)
    old = R.words_of(R.FEED, {"feed": host.device.tick_count, "request": 1})
    for _ in range(60):
        host.device.advance(10)
        host.device.write(140, old)
    assert int(host.status()["faults"]) & R.WATCHDOG


def test_an_overload_is_latched_and_only_the_way_out_is_open() -> None:
    host = homed()
    host.command(R.DISARM)
    settings = host.device.settings | {"force_max": 1.0}
    assert host.device.write(120, R.words_of(R.SETTINGS, settings))
    host.command(R.ARM)
    host.command(R.MOVE, target=10, speed=5)
    after = host.live(2000)
    assert int(after["faults"]) & R.OVERLOAD
    assert after["force"] < 1.3
    assert host.command(R.MOVE, target=11, speed=1)["command_reason"] == R.IS_FAULTED
    host.command(R.CLEAR)
    host.command(R.ARM)
    assert host.command(R.MOVE, target=11, speed=1)["command_reason"] == R.TOWARDS_OVERLOAD
    host.command(R.MOVE, target=0, speed=5)
    assert host.live(3000)["position"] == 0


def test_limits_act_on_the_gross_force() -> None:
    host = homed(Machine(noise_N=0.0, zero_N=0.9, backlash_mm=0.0, contact_mm=2.0))
    host.command(R.DISARM)
    host.device.write(120, R.words_of(R.SETTINGS, host.device.settings | {"force_max": 1.0}))
    host.command(R.ARM)
    host.command(R.MOVE, target=10, speed=2)
    after = host.live(3000)
    assert int(after["faults"]) & R.OVERLOAD
    assert after["position"] < 2.4  # 0.2 mm of a spring of 0.5 N/mm: 0.1 N above a zero of 0.9 N


def test_a_repeated_command_number_is_not_executed() -> None:
    host = homed()
    host.command(R.MOVE, target=5, speed=5)
    host.live(2000)
    host.number -= 1
    host.command(R.MOVE, target=9, speed=5)
    assert host.live(2000)["position"] == 5


def test_limits_are_not_taken_while_armed() -> None:
    host = homed()
    assert not host.device.write(120, R.words_of(R.SETTINGS, host.device.settings))


def test_the_stage_goes_sideways_only_at_the_safe_height() -> None:
    host = homed()
    assert host.command(R.MOVE_STAGE, stage_x=5, stage_y=-3, speed=10)["command_state"] == R.RUNNING
    host.live(1000)
    assert host.device.stage_mm == [5, -3]
    host.command(R.MOVE, target=1, speed=5)
    host.live(1000)
    assert host.command(R.MOVE_STAGE, stage_x=0, speed=10)["command_reason"] == R.NOT_AT_SAFE_HEIGHT


def test_tool_frame_and_specimen_are_in_balance() -> None:
    specimen = Specimen(hertz())
    for k in range(4000):
        depth, force = specimen.push(k * 0.001, 0.3, 0.001)
        assert depth + 0.3 * force == pytest.approx(k * 0.001, abs=1e-6)
    factor = 4 / 3 * 0.05 / (1 - 0.45**2) * math.sqrt(8)
    assert force == pytest.approx(factor * depth**1.5, rel=1e-4)


def test_a_soft_frame_snaps_through_and_back_at_different_places() -> None:
    specimen = Specimen(bistable(2.5, 7.0, 0.1))
    there = [specimen.push(k * 0.002, 2.0, 0.001)[0] for k in range(10000)]
    back = [specimen.push(20 - k * 0.002, 2.0, 0.001)[0] for k in range(10000)]
    through = max(range(1, len(there)), key=lambda k: there[k] - there[k - 1])
    again = max(range(1, len(back)), key=lambda k: back[k - 1] - back[k])
    assert there[through] - there[through - 1] > 1
    assert back[again - 1] - back[again] > 1
    assert through * 0.002 > 20 - again * 0.002  # later in than out


def test_what_the_rubber_keeps_is_the_area_between_the_curves() -> None:
    load = [0.5 * k * 0.01 for k in range(501)]
    specimen = Specimen(Curves(0.01, load, [0.8 * f for f in load]))
    work, last = 0.0, 0.0
    for k in [*range(4001), *range(3999, -1, -1)]:
        depth, force = specimen.push(k * 0.001, 0.0, 0.001)
        work, last = work + force * (depth - last), depth
    assert work == pytest.approx(0.2 * 0.5 * 0.5 * 4**2, rel=0.06)


def test_the_serial_line_is_as_slow_as_its_baud_rate() -> None:
    # Ten registers at 115200 with 11-bit characters and 1 ms of turnaround: 131 readings a second at most.
    delay_s = Pace(115200, 11, 1e-3).delay_s(8, 25)
    assert 1 / delay_s == pytest.approx(131, rel=0.02)


def test_the_published_check_of_a_modbus_frame() -> None:
    assert crc16(b"123456789") == 0x4B37  # CRC-16/MODBUS, catalogue of parametrised CRC algorithms
    assert rtu_frame(1, bytes([3, 0, 0, 0, 10])) == bytes.fromhex("01030000000ac5cd")


@given(st.binary(max_size=6))
def test_noise_before_a_request_does_not_hide_it(noise: bytes) -> None:
    request = rtu_frame(1, bytes([3, 0, 0, 0, 10]))
    buffer = bytearray(noise + request + b"\0" * 300)
    found = []
    while taken := take_rtu(buffer):
        found.append(taken.pdu)
    assert request[1:-2] in found


def test_an_unknown_function_is_refused() -> None:
    assert answer(bytes([7]), Controller(QUIET)) == bytes([0x87, 1])
    assert answer(bytes([3, 1, 0, 0, 1]), Controller(QUIET)) == bytes([0x83, 2])


def test_a_request_is_answered_at_the_tick_at_which_it_was_whole_however_late_this_process_wakes() -> None:
    now_s = [0.0]
    server = Server(Controller(QUIET), FaultyLine(), Pace(115200, 11, 1e-3), now_s=lambda: now_s[0])
    served: list[int] = []
    server.device.tell = lambda kind, _: served.append(server.device.tick_count) if kind == "command" else None
    body = {name: 0.0 for name, *_ in R.COMMAND} | {"id": 1, "code": R.STOP}
    words = R.words_of(R.COMMAND, body)
    pdu = bytes([16, 0, 100, 0, len(words), 2 * len(words)]) + b"".join(w.to_bytes(2, "big") for w in words)
    server._waiting.append((0.0205, Link(-1, serial=True), Request(0, 1, pdu, 35)))
    now_s[0] = 0.050
    server._serve_due()
    assert served == [20]
