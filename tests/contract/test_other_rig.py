"""Another rig is another file: one with other addresses, words, scales, signs and codes is driven by its map alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.errors import DeviceRefused
from drivers.rig.indenter import Indenter, Limits
from drivers.rig.refusals import RigFaulted
from drivers.rig.registers import BadReply, RegisterMap, Table
from drivers.rig.samples import Sample
from fabctl.config.loader import parse
from fabctl.config.rig import RigMapConfig
from fabctl.testing import SimulatedBench
from fabctl.workspace import Workspace
from simulators.rig.controller import TICK_S, Machine
from simulators.rig.grams import Grams
from simulators.specimens.analytic import linear
from simulators.specimens.curve import Specimen
from tests.rig_endpoints import rig_bench, short_method, simulated_rig

MAP = (Path(__file__).resolve().parents[2] / "configs" / "rigs" / "grams.yaml").read_text()
STATUS_AT, COMMAND_AT = 3000, 4000


@dataclass
class OtherRig:
    """The simulated controller behind the registers of another maker; also its clock."""

    device: Grams
    url: str = "memory:other"
    commands: list[list[int]] = field(default_factory=list)

    def read(self, table: Table, address: int, count: int) -> list[int]:
        self.device.advance(1)
        words = self.device.read(table, address, count)
        assert words is not None
        return words

    def write(self, address: int, values: Sequence[int]) -> None:
        self.device.advance(1)
        self.commands += [list(values)] if address == COMMAND_AT else []
        assert self.device.write(address, values)

    def exchange(self, *_: object) -> list[int]:
        raise AssertionError("this rig knows no function 23")

    def drain(self) -> None:
        raise AssertionError("nothing is ever lost here")

    def close(self) -> None: ...

    def now_s(self) -> float:
        return self.device.tick_count * TICK_S

    def sleep(self, duration_s: float) -> None:
        self.device.advance(max(1, round(duration_s / TICK_S)))


def driven(text: str = MAP) -> tuple[Indenter, OtherRig, list[Sample]]:
    registers: RegisterMap = parse(text, RigMapConfig, "other.yaml").registers()
    machine = Machine(noise_N=0.0, zero_N=0.0, backlash_mm=0.0, contact_mm=3.0)
    bus, heard = OtherRig(Grams(machine, Specimen(linear(0.5)))), list[Sample]()
    bus.device.advance(65_000)  # its sequence of 16 bits will wrap on the way
    rig = Indenter(bus, registers, heard.append, bus.now_s, bus.sleep)
    rig.set_limits(Limits(5.0, -2.0, 0.0, 40.0, 0.5, 50.0, 0.5))
    rig.arm()
    rig.wait(rig.home(10.0), 20.0)
    return rig, bus, heard


def test_another_rig_is_identified_moved_and_sampled_by_its_file() -> None:
    rig, bus, heard = driven()
    identity = rig.identify()
    assert (identity.model, identity.travel_mm, identity.speed_max_mm_s) == ("Gramometer", 60.0, 20.0)
    assert identity.capacity_N == pytest.approx(50.0)
    found = rig.wait(rig.move(20.0, 5.0, "above", 0.5), 20.0)
    assert found.command_state == "done"
    loaded = [s for s in heard if s.force_N > 0.05]
    assert loaded
    assert all(s.force_N == pytest.approx(0.5 * (s.position_mm - 3.0), abs=1e-3) for s in loaded)
    assert all(b.time_s > a.time_s for a, b in pairwise(heard))
    assert bus.device.tick_count > 2**16
    assert rig.lost_count <= 1  # the very first reply only


def test_its_limits_were_written_to_it_and_hold() -> None:
    rig, bus, _ = driven()
    assert bus.device.settings["force_max"] == pytest.approx(5.0, abs=1e-4)
    assert bus.device.settings["travel_max"] == pytest.approx(40.0)
    with pytest.raises(RigFaulted, match="overload"):
        rig.wait(rig.move(30.0, 10.0), 20.0)


@pytest.mark.parametrize(("target_mm", "speed_mm_s"), [(60.5, 1.0), (-0.5, 1.0), (5.0, 21.0), (float("nan"), 1.0)])
def test_what_the_map_forbids_is_not_sent(target_mm: float, speed_mm_s: float) -> None:
    rig, bus, _ = driven()
    before = list(bus.commands)
    with pytest.raises(DeviceRefused, match="is outside"):
        rig.move(target_mm, speed_mm_s)
    assert bus.commands == before


def test_a_reading_outside_the_maps_limits_is_not_believed() -> None:
    rig, bus, _ = driven(MAP.replace("min: -60, max: 60}", "min: -60, max: 1}"))
    bus.device.hung_N = 2.0
    bus.device.advance(5)
    before = rig.lost_count
    with pytest.raises(BadReply, match="is outside -60 to 1 N"):
        rig.sample()
    assert rig.lost_count == before + 1


METHOD = short_method(
    "step: approach, speed_mm_s: 6, trigger_N: 0.05, clearance_mm: 1.0",
    "step: preload, force_N: 0.03, speed_mm_s: 1",
    "step: zero",
    "step: cycles, cycles_count: 1, depth_mm: 2.8, speed_mm_s: 1, unload_speed_mm_s: 6",
).replace("sample_hz: 100", "sample_hz: 50")


@pytest.mark.parametrize("line", ["tcp", "rtu"])
def test_another_rig_on_a_real_line_is_asked_tared_and_goes_through_a_whole_method(tmp_path: Path, line: str) -> None:
    where = ("--tcp", "0") if line == "tcp" else ("--rtu", str(tmp_path / "rig"))
    options = ("--registers", "grams", "--unit", "17", "--specimen", "linear", "--gain", "1", "--seed", "5")
    (tmp_path / "design").mkdir()
    lab = Workspace(tmp_path)
    specimen = lab.new_specimen(tmp_path / "design").name
    (tmp_path / "short.yaml").write_text(METHOD)
    with simulated_rig(*where, *options, "--compliance-mm-N", "0") as url:
        assert "unit=17" in url
        (tmp_path / "other.yaml").write_text(rig_bench(url, "other", "grams"))
        bench = SimulatedBench(lab, {"rig": url})
        said = bench.fabctl("rig", "info", "--bench", "other.yaml")
        assert (said["model"], said["serial"]) == ("Gramometer", 1005)
        assert abs(bench.fabctl("rig", "tare", "--bench", "other.yaml")["zero_N"]) < 0.03
        words = ("indent", "run", specimen, "--bench", "other.yaml", "--yes", "--method")
        found = bench.fabctl(*words, "short.yaml")
        assert found["stiffness_secant_N_mm"] == pytest.approx(0.5, rel=0.01)  # the simulator's spring
        bench.fabctl(*words, "grid", expect=3)  # this rig's map has no stage
