"""The whole rig in memory and virtual time: the driver's own code on the simulated controller, no line between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.rig.indenter import Indenter
from drivers.rig.registers import Table
from fabctl.config.method import Approach, Cycles, LimitsConfig, MethodConfig, Tare
from fabctl.config.rig import load_rig
from fabctl.indent.analysis import Numbered, Samples, analyse
from fabctl.indent.method import actions
from fabctl.indent.recorder import Row
from fabctl.indent.run import Runner
from simulators.rig.controller import TICK_S, Controller, Machine
from simulators.specimens.curve import Curves, Specimen

REGISTERS = load_rig("reference", Path(__file__).resolve().parents[1])


@dataclass
class MemoryBus:
    """Registers of the controller, one tick a request; also the clock of everybody who uses it."""

    device: Controller
    url: str = "memory:"

    def read(self, table: Table, address: int, count: int) -> list[int]:
        """Return registers."""
        self.device.advance(1)
        words = self.device.read(table, address, count)
        assert words is not None
        return words

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write registers."""
        self.device.advance(1)
        assert self.device.write(address, values)

    def exchange(self, read_address: int, count: int, write_address: int, values: Sequence[int]) -> list[int]:
        """Write, then read."""
        self.write(write_address, values)
        words = self.device.read("holding", read_address, count)
        assert words is not None
        return words

    def drain(self) -> None:
        """Do nothing: no reply is ever under way."""

    def close(self) -> None:
        """Do nothing."""

    def now_s(self) -> float:
        """Return the controller's own time."""
        return self.device.tick_count * TICK_S

    def sleep(self, duration_s: float) -> None:
        """Let the controller run."""
        self.device.advance(max(0, round(duration_s / TICK_S)))


@dataclass
class Kept:
    """Rows in a list."""

    rows: list[Row] = field(default_factory=list)

    def take(self, row: Row) -> None:
        """Take one row."""
        self.rows.append(row)

    def samples(self) -> Samples:
        """Return the columns, rounded as the file rounds them."""
        rows = self.rows
        return Samples(
            np.array([row.time_s for row in rows]),
            np.round(np.array([row.position_mm for row in rows]), 4),
            np.round(np.array([row.force_N for row in rows]), 5),
            np.array([row.step for row in rows]),
            np.array([row.point for row in rows], dtype=np.int64),
            np.array([row.curve for row in rows], dtype=np.int64),
        )


def method(
    depth_mm: float, speed_mm_s: float, clearance_mm: float = 1.0, cycles_count: int = 1, trigger_N: float = 0.06
) -> MethodConfig:
    """Return a method of tare, approach and cycles."""
    return MethodConfig(
        name="bench",
        safe_height_mm=0.2,
        travel_speed_mm_s=20.0,
        acceleration_mm_s2=200.0,
        limits=LimitsConfig(force_N=45.0, travel_mm=55.0, tension_N=4.0),
        steps=(
            Tare(step="tare", time_s=0.5),
            Approach(step="approach", speed_mm_s=3.0, trigger_N=trigger_N, clearance_mm=clearance_mm),
            Cycles(
                step="cycles",
                cycles_count=cycles_count,
                depth_mm=depth_mm,
                speed_mm_s=speed_mm_s,
                unload_speed_mm_s=6.0,
            ),
        ),
    )


def press(
    curves: Curves, machine: Machine, plan: MethodConfig, seed: int, sample_hz: float = 100.0
) -> tuple[list[Numbered], Kept]:
    """Run a method on a specimen in virtual time and analyse it with the frame's true compliance taken off."""
    device = Controller(machine, Specimen(curves), seed=seed)
    bus, kept = MemoryBus(device), Kept()
    rig = Indenter(bus, REGISTERS, now_s=bus.now_s, sleep=bus.sleep)
    Runner(rig, plan, actions(plan), kept, bus, sample_hz).execute()
    return analyse(kept.samples(), machine.compliance_mm_N, 2.0, machine.gain_ratio), kept
