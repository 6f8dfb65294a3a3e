"""The driver with boards that speak as GRBL, grblHAL and FluidNC do: in memory, behind a pty, and over TCP."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks._laser_rig import Rig, Watch, slits
from drivers.errors import DeviceAlarm, DeviceRefused
from drivers.grbl.faults import LineRefused
from drivers.grbl.laser import Laser
from drivers.grbl.meanings import alarm_meaning, error_meaning
from drivers.grbl.run import StoppedByOperator, run_program
from drivers.transport import open_transport
from simulators.grbl.dialects import DIALECTS

KNOWN = {"grbl": ("grbl", 128, 15), "grblhal": ("grblHAL", 1024, 35), "fluidnc": ("FluidNC", 256, 15)}

pytestmark = pytest.mark.parametrize("dialect", sorted(DIALECTS))


def connected(dialect: str) -> tuple[Rig, Laser]:
    rig = Rig(dialect=DIALECTS[dialect])
    laser = rig.laser()
    laser.connect()
    return rig, laser


def test_who_it_is_and_what_it_holds_is_known(dialect: str) -> None:
    _, laser = connected(dialect)
    identity = laser.identity
    assert identity is not None
    assert (identity.firmware, identity.rx_bytes, identity.planner_count) == KNOWN[dialect]
    assert identity.setting(32) == 1.0


def test_a_program_runs_through_and_no_byte_is_lost(dialect: str) -> None:
    rig, laser = connected(dialect)
    program = slits(12)
    assert run_program(laser, program, Watch()).answered_count == len(program)
    assert rig.board.rx_lost_count == 0
    assert rig.board.machine.pin.power_frac == 0


def test_a_refused_line_is_named_in_check_mode_and_in_a_run(dialect: str) -> None:
    _, laser = connected(dialect)
    assert laser.check(["G21", "G99", "M5"]) == [(1, 20)]
    with pytest.raises(LineRefused) as caught:
        run_program(laser, ["G21", "G99", "M5"], Watch())
    assert caught.value.index == 1
    with pytest.raises(DeviceRefused, match="error 20"):
        laser.ask("G99")


def test_an_alarm_ends_a_run(dialect: str) -> None:
    _, laser = connected(dialect)
    with pytest.raises(DeviceAlarm) as caught:
        run_program(laser, ["G21", "G90", "G1X-5F1500", "G1X5", "M5"], Watch())
    assert caught.value.code == 2


def test_hold_stop_and_home_work(dialect: str) -> None:
    rig, laser = connected(dialect)
    now_s = rig.clock.now_s()
    with pytest.raises(StoppedByOperator):
        run_program(laser, slits(30), Watch([(now_s + 0.5, "hold"), (now_s + 1.5, "stop")], rig.clock))
    assert laser.left is not None
    assert laser.left.position_known
    assert laser.home().machine_mm == pytest.approx((-1.0, -1.0, -1.0))


def test_the_same_number_means_what_this_firmware_says(dialect: str) -> None:
    firmware = KNOWN[dialect][0]
    known = {"grbl": "does not know", "grblHAL": "emergency stop", "FluidNC": "driver does not answer"}
    assert known[firmware] in alarm_meaning(10, firmware)[0]
    assert ("homed first" in error_meaning(46, firmware)[0]) is (firmware == "grblHAL")


@pytest.fixture(params=["pty", "tcp"])
def url(request: pytest.FixtureRequest, dialect: str, tmp_path: Path) -> Iterator[str]:
    line = ["--pty", str(tmp_path / "port")] if request.param == "pty" else ["--tcp", "0"]
    command = [sys.executable, "-m", "simulators", "grbl", *line, "--lab", "--speed", "8", "--dialect", dialect]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[1]
        finally:
            process.terminate()


def test_over_a_real_line_it_is_known_checked_and_run(url: str, dialect: str) -> None:
    with Laser(open_transport(url)) as laser:
        assert laser.connect().firmware == KNOWN[dialect][0]
        laser.unlock()
        assert laser.check(["G21", "G90", "M4S0", "G1X-20F1500S10", "M5"]) == []
        laser.unlock()
        program = ["G21", "G90", "G94", "M4S0", "G0X-30Y-30", "G1X-32F1500S10", "M5", "G4P0.01"]
        assert run_program(laser, program, Watch()).answered_count == len(program)
