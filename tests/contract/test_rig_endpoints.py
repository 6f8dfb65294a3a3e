"""One body of tests for the rig driver, against the simulator and against rigs on libmodbus and modbus-tk."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from serial.serialutil import Timeout

from drivers.errors import DeviceRefused, DeviceTimeout, ProtocolError, TransportError
from drivers.rig.indenter import Indenter, Limits, open_indenter
from drivers.rig.refusals import RigFaulted
from drivers.rig.samples import Sample
from tests.rig_endpoints import ENDPOINTS, PATIENT, endpoint, free_port, simulated_rig

# The watchdog is longer than a busy machine holds a process up; what it does is tested on its own.
LIMITS = Limits(5.0, -2.0, 0.0, 40.0, 0.5, 50.0, 1.0)


@pytest.fixture(params=ENDPOINTS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Indenter, list[Sample]]]:
    heard: list[Sample] = []
    with (
        endpoint(request.param, tmp_path) as (url, registers),
        contextlib.closing(open_indenter(url, registers, heard.append)) as found,
    ):
        found.set_limits(LIMITS)
        found.arm()
        found.wait(found.home(10.0), 20.0)
        yield found, heard


def test_a_guarded_move_stops_at_its_force_and_every_sample_is_new(rig: tuple[Indenter, list[Sample]]) -> None:
    indenter, heard = rig
    found = indenter.wait(indenter.move(20.0, 10.0, "above", 0.5), 20.0)
    assert found.command_state == "done"
    assert found.reason == "none"
    loaded = [s for s in heard if s.force_N > 0.05]
    assert loaded
    # The spring of every endpoint: 0.5 N/mm from 8 mm on.
    assert all(s.force_N == pytest.approx(0.5 * (s.position_mm - 8.0), abs=2e-3) for s in loaded)
    assert all(b.sequence > a.sequence for a, b in pairwise(heard))
    assert indenter.stop()


def test_an_overload_stops_the_stage_and_stays_latched(rig: tuple[Indenter, list[Sample]]) -> None:
    indenter, _ = rig
    with pytest.raises(RigFaulted, match="overload"):
        indenter.wait(indenter.move(30.0, 15.0), 20.0)
    with pytest.raises(DeviceRefused, match="faulted"):
        indenter.move(31.0, 1.0)
    assert "overload" in indenter.fresh_sample().faults


def test_a_refused_target_says_why(rig: tuple[Indenter, list[Sample]]) -> None:
    indenter, _ = rig
    with pytest.raises(DeviceRefused, match="outside_travel"):
        indenter.move(41.0, 1.0)


def test_mbpoll_reads_the_simulator(tmp_path: Path) -> None:
    if shutil.which("mbpoll") is None:
        pytest.skip("mbpoll is not installed: `bash scripts/test-peers.sh` installs it")
    with simulated_rig("--tcp", "0") as url:
        words = ["mbpoll", "-m", "tcp", "-p", str(urlsplit(url).port), "-a", "1", "-0", "-1", "-r", "32", "-c", "2"]
        said = subprocess.run([*words, "-t", "3", "127.0.0.1"], capture_output=True, text=True, check=True).stdout
    assert f"[32]: \t{0x4652}" in said
    assert "[33]: \t1" in said


def test_a_wrong_unit_id_is_a_timeout_that_says_what_to_check() -> None:
    with simulated_rig("--tcp", "0") as url, pytest.raises(DeviceTimeout, match="unit id"):
        open_indenter(url.replace("unit=1", "unit=9"), PATIENT)


def test_the_emergency_stop_stops_the_stage_and_stays_until_it_is_released(tmp_path: Path) -> None:
    with (
        simulated_rig("--tcp", "0", "--slot", str(tmp_path), "--specimen", "linear") as url,
        contextlib.closing(open_indenter(url, PATIENT)) as rig,
    ):
        rig.set_limits(LIMITS)
        rig.arm()
        rig.wait(rig.home(10.0), 20.0)
        number = rig.move(4.0, 1.0)
        (tmp_path / "estop").touch()
        with pytest.raises(RigFaulted, match="estop"):
            rig.wait(number, 20.0)
        assert rig.fresh_sample().position_mm < 3.5
        rig.clear_faults()
        with pytest.raises(DeviceRefused, match="faulted"):
            rig.arm()
        (tmp_path / "estop").unlink()
        while "estop" in rig.fresh_sample().faults:  # until the simulator has looked
            rig.clear_faults()
        rig.arm()
        assert rig.stop()


def test_nobody_there_is_a_transport_error() -> None:
    with pytest.raises(TransportError, match="cannot be opened"):
        open_indenter(f"modbus-tcp://127.0.0.1:{free_port()}?unit=1", PATIENT)


def test_a_missing_serial_port_is_named(tmp_path: Path) -> None:
    with pytest.raises(TransportError, match="No such file"):
        open_indenter(f"modbus-rtu://{tmp_path}/none?unit=1", PATIENT)


def test_a_host_held_up_while_it_writes_has_not_lost_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        simulated_rig("--rtu", str(tmp_path / "rig"), "--specimen", "linear") as url,
        contextlib.closing(open_indenter(url, PATIENT)) as rig,
    ):
        plain, late_s = os.write, [0.0]

        def held_up(handle: int, data: bytes) -> int:
            written = plain(handle, data)
            late_s[0] += 0.45  # longer than the time for a reply
            return written

        monkeypatch.setattr(Timeout, "TIME", staticmethod(lambda: time.monotonic() + late_s[0]))
        monkeypatch.setattr(os, "write", held_up)
        with contextlib.suppress(DeviceTimeout, ProtocolError):
            rig.sample()
        monkeypatch.undo()
        assert rig.fresh_sample().sequence > 0


def test_another_device_is_not_taken_for_a_rig() -> None:
    from dataclasses import replace

    with simulated_rig("--tcp", "0") as url, pytest.raises(ProtocolError, match="choose the right map"):
        open_indenter(url, replace(PATIENT, magic=0x1234))
