"""Rigs to test against: the simulator and two independent peers, each over TCP and over a serial line."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.rig.registers import RegisterMap
from fabctl.config.rig import load_rig

ROOT = Path(__file__).resolve().parents[1]
LIBMODBUS = ROOT / "build" / "peers" / "libmodbus_rig"
REFERENCE = load_rig("reference", ROOT)
# Three busy cores and a peer's own polling make replies later than a rig's; the driver is the same.
PATIENT = replace(REFERENCE, timeout_s=0.4, response_max_s=0.1)
ENDPOINTS = ("sim-tcp", "sim-rtu", "libmodbus-tcp", "libmodbus-rtu", "modbus_tk-tcp", "modbus_tk-rtu")


def short_method(*steps: str, name: str = "short", watchdog_s: float = 1.0) -> str:
    """Return the file of a method that presses with at most 4 N: a tare, then `steps`, each as in the file."""
    head = f"name: {name}\nsample_hz: 100\nsafe_height_mm: 0.5\ntravel_speed_mm_s: 20\nacceleration_mm_s2: 200\n"
    limits = f"limits: {{force_N: 4, tension_N: 1, travel_mm: 40, watchdog_s: {watchdog_s}}}\nsteps:\n"
    return head + limits + "".join(f"  - {{{step}}}\n" for step in ("step: tare, time_s: 0.3", *steps))


def rig_bench(url: str, name: str = "short", registers: str = "reference", slot: str = "") -> str:
    """Return the file of a bench with nothing but the rig at `url`."""
    size = "travel_mm: 60, force_limit_N: 20, indenter_radius_mm: 8"
    lines = [f"name: {name}", f'rig: {{url: "{url}", map: {registers}, {size}}}']
    return "\n".join([*lines, *([f'specimen_slot: "{slot}"'] if slot else [])]) + "\n"


@contextlib.contextmanager
def simulated_rig(*words: str, cwd: Path = ROOT) -> Iterator[str]:
    """Run the simulator with `words`; yield its URL."""
    with _process([sys.executable, "-m", "simulators", "rig", *words], cwd) as said:
        assert said.startswith("ready "), said
        yield said.split()[1]


@contextlib.contextmanager
def endpoint(name: str, folder: Path) -> Iterator[tuple[str, RegisterMap]]:
    """Run the endpoint called `name`; yield its URL and the register map to read it by."""
    peer, _, line = name.partition("-")
    if peer == "sim":
        where = ("--tcp", "0") if line == "tcp" else ("--rtu", str(folder / "rig"))
        options = ("--specimen", "linear", "--noise-N", "0", "--zero-N", "0", "--contact-mm", "8", "--gain", "1")
        with simulated_rig(*where, *options, "--compliance-mm-N", "0", "--backlash-mm", "0", "--drift-N-s", "0") as url:
            yield url, PATIENT
        return
    if peer == "libmodbus" and not LIBMODBUS.is_file():
        pytest.skip("build/peers/libmodbus_rig is missing: `bash scripts/test-peers.sh` builds it")
    program = [str(LIBMODBUS)] if peer == "libmodbus" else [sys.executable, str(ROOT / "tests/peers/modbus_tk_rig.py")]
    registers = PATIENT if peer == "libmodbus" else replace(PATIENT, exchange=False)
    if line == "tcp":
        port = free_port()
        with _process([*program, "tcp", str(port)]):
            yield f"modbus-tcp://127.0.0.1:{port}?unit=1", registers
    else:
        with joined_ptys() as (ours, theirs), _process([*program, "rtu", theirs]):
            yield f"modbus-rtu://{ours}?baud=115200&parity=N&unit=1", registers


def free_port() -> int:
    """Return a port that nobody listens on now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def joined_ptys() -> Iterator[tuple[str, str]]:
    """Yield two serial ports whose bytes come out of each other."""
    left, left_port = os.openpty()
    right, right_port = os.openpty()
    for port in (left_port, right_port):
        tty.setraw(port)
    going = [True]

    def pump() -> None:
        while going:
            for handle in select.select([left, right], [], [], 0.05)[0]:
                os.write(right if handle == left else left, os.read(handle, 4096))

    thread = threading.Thread(target=pump)
    thread.start()
    try:
        yield os.ttyname(left_port), os.ttyname(right_port)
    finally:
        going.clear()
        thread.join()
        for handle in (left, left_port, right, right_port):
            os.close(handle)


@contextlib.contextmanager
def _process(command: list[str], cwd: Path = ROOT) -> Iterator[str]:
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=cwd, env={**os.environ, "PYTHONPATH": path}
    )
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait(timeout=10)
        process.stdout.close()
        time.sleep(0)
