"""A simulated rig in a thread of this process, so that what was served can be held against what was believed."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from drivers.errors import DeviceRefused, ProtocolError
from drivers.rig.bus import open_bus
from drivers.rig.indenter import LOST, Indenter, Limits
from drivers.rig.refusals import MotionUnknown, RigFaulted
from fabctl.config.rig import load_rig
from simulators.rig import registers as R
from simulators.rig.controller import Controller, Machine
from simulators.rig.faults import KINDS, FaultyLine
from simulators.rig.server import Pace, Server
from simulators.specimens.analytic import linear
from simulators.specimens.curve import Specimen

ROOT = Path(__file__).resolve().parents[1]
# Timeouts scaled down, so that ten thousand faults pass in minutes; nothing else of the driver is changed.
SCALED = replace(load_rig("reference", ROOT), timeout_s=0.02, response_max_s=0.015)
LATE_S = (0.021, 0.045)  # within what is drained, and beyond it
LIMITS = Limits(20.0, -5.0, 0.0, 50.0, 0.5, 200.0, 5.0)
MOTION_KINDS = ("late", "lost", "request_lost", "torn", "twice", "exception", "short", "stale", "bits", "noise")


@dataclass
class Rig:
    """A running rig: its URL, its controller, its line, and every status it ever answered with, by tick."""

    url: str
    device: Controller
    line: FaultyLine
    truth: dict[int, set[tuple[int, int]]] = field(default_factory=dict)
    events: list[tuple[str, dict[str, Any]]] = field(default_factory=list)


@contextlib.contextmanager
def running(
    folder: Path, serial: bool = False, rate_ratio: float = 0.0, kinds: Sequence[str] = KINDS, seed: int = 1
) -> Iterator[Rig]:
    """Serve a rig whose stage stands on a spring, noisy, with faults on `rate_ratio` of the replies."""
    device = Controller(Machine(noise_N=0.05), Specimen(linear(0.5)), seed=seed)
    device.axis.position_mm = 9.0
    line = FaultyLine(rate_ratio, kinds, seed, LATE_S)
    rig = Rig("", device, line)
    device.tell = lambda kind, facts: rig.events.append((kind, dict(facts)))
    plain = device.status_words

    def remembered() -> list[int]:
        words = plain()
        rig.truth.setdefault(words[0] << 16 | words[1], set()).add(_measured(words))
        return words

    device.status_words = remembered  # type: ignore[method-assign]
    server = Server(device, line, Pace())
    rig.url = server.listen_rtu(str(folder / "rig")) if serial else server.listen_tcp(0)
    going = [True]
    thread = threading.Thread(target=server.run, args=(lambda: bool(going),))
    thread.start()
    try:
        yield rig
    finally:
        going.clear()
        thread.join()
        server.close()


def _measured(words: Sequence[int]) -> tuple[int, int]:
    return (words[10] << 16 | words[11], words[12] << 16 | words[13])


@dataclass
class Campaign:
    """What came of reading through faults. `wrong` names the first few samples that were believed and not true."""

    injected_count: int = 0
    believed_count: int = 0
    rejected_count: int = 0
    wrong_count: int = 0
    wrong: list[str] = field(default_factory=list)


def read_through_faults(folder: Path, serial: bool, faults_count: int, seed: int, ratio: float = 0.5) -> Campaign:
    """Read with the driver until so many faults were injected; judge every sample it believes."""
    found = Campaign()
    registers = SCALED
    with running(folder, serial, ratio, seed=seed) as rig:
        bus = open_bus(rig.url, registers.timeout_s, registers.response_max_s)
        indenter = Indenter(bus, registers)
        with contextlib.closing(indenter):
            while rig.line.injected_count < faults_count:
                asked_at = rig.device.tick_count
                try:
                    sample = indenter.sample()
                except LOST:
                    found.rejected_count += 1
                    continue
                found.believed_count += 1
                shown = (round(sample.position_mm * 1e4), round(sample.force_N * 1e5) % 2**32)
                _judge(found, rig, sample.sequence, shown, asked_at)
        found.injected_count = rig.line.injected_count
    return found


def read_naively(folder: Path, serial: bool, faults_count: int, seed: int, ratio: float = 0.5) -> Campaign:
    """Read as a first script would: pymodbus with its defaults, one block read, no check but `isError`."""
    found = Campaign()
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient
    from pymodbus.exceptions import ModbusException

    with running(folder, serial, ratio, seed=seed) as rig:
        client: Any = (
            ModbusSerialClient(str(folder / "rig"), baudrate=115200, timeout=SCALED.timeout_s)
            if serial
            else ModbusTcpClient(
                "127.0.0.1", port=int(rig.url.rsplit(":", 1)[1].split("?")[0]), timeout=SCALED.timeout_s
            )
        )
        client.connect()
        while rig.line.injected_count < faults_count:
            asked_at = rig.device.tick_count
            try:
                reply = client.read_holding_registers(0, count=R.STATUS_CHECK + 1)
            except (ModbusException, OSError, ValueError, IndexError):
                found.rejected_count += 1
                continue
            if reply.isError() or len(reply.registers) < 14:
                found.rejected_count += 1
                continue
            found.believed_count += 1
            words = reply.registers
            _judge(found, rig, words[0] << 16 | words[1], _measured(words), asked_at)
        client.close()
        found.injected_count = rig.line.injected_count
    return found


def _judge(found: Campaign, rig: Rig, sequence: int, shown: tuple[int, int], asked_at: int) -> None:
    """Count a sample as wrong where no such reading was ever served, or where it is older than the question."""
    why = ""
    if shown not in rig.truth.get(sequence, set()):
        why = f"{sequence}: {shown} was never measured"
    elif sequence < asked_at:
        why = f"{sequence}: asked at {asked_at}, answered with an older one"
    if why:
        found.wrong_count += 1
        if len(found.wrong) < 5:
            found.wrong.append(why)


@dataclass
class Motions:
    """What came of moving through faults."""

    commands_count: int = 0
    confirmed_count: int = 0
    unknown_count: int = 0
    refused_count: int = 0
    faults_count: int = 0
    broken: list[str] = field(default_factory=list)


def move_through_faults(folder: Path, serial: bool, commands_count: int, seed: int, ratio: float = 0.35) -> Motions:
    """Give motion commands over a bad line; hold what the driver says against what the controller did."""
    found = Motions()
    registers = SCALED
    with running(folder, serial, 0.0, MOTION_KINDS, seed) as rig:
        bus = open_bus(rig.url, registers.timeout_s, registers.response_max_s)
        indenter = Indenter(bus, registers)
        with contextlib.closing(indenter):
            ready(indenter)
            for k in range(commands_count):
                rig.line.rate_ratio = ratio
                target_mm = 2.0 + (k % 7)
                before = len(rig.events)
                number = indenter.next_number
                outcome = _moved(found, indenter, target_mm)
                rig.line.rate_ratio = 0.0
                executed = _executions(rig, number)
                duplicates = [facts for kind, facts in rig.events[before:] if kind == "old_command"]
                found.broken += _broken(k, outcome, executed, duplicates, indenter)
                if outcome != "confirmed":
                    ready(indenter)
        found.commands_count = commands_count
        found.faults_count = rig.line.injected_count
    return found


def _moved(found: Motions, indenter: Indenter, target_mm: float) -> str:
    try:
        indenter.move(target_mm, 15.0)
    except MotionUnknown:
        found.unknown_count += 1
        return "unknown"
    except (DeviceRefused, RigFaulted, ProtocolError):
        found.refused_count += 1
        return "refused"
    found.confirmed_count += 1
    return "confirmed"


def _executions(rig: Rig, number: int) -> int:
    return sum(kind == "command" and int(facts["id"]) == number and not facts["reason"] for kind, facts in rig.events)


def _broken(k: int, outcome: str, executed: int, duplicates: Sequence[Any], indenter: Indenter) -> list[str]:
    said = []
    if executed > 1 or duplicates:
        said.append(f"command {k} reached the controller {executed} times, {len(duplicates)} more were refused as old")
    if outcome == "confirmed" and executed != 1:
        said.append(f"command {k} was confirmed and executed {executed} times")
    if outcome != "confirmed" and indenter.fresh_sample().state == "moving":
        said.append(f"command {k} was reported as {outcome} and the stage still moves")
    return said


def ready(indenter: Indenter) -> None:
    """Bring the stage to where a motion can begin, on a line without faults."""
    indenter.clear_faults()
    indenter.set_limits(LIMITS)
    indenter.arm()
    if "unhomed" in indenter.fresh_sample().faults:
        indenter.wait(indenter.home(20.0), 20.0)
