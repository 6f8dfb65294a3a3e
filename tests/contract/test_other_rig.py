"""Another rig is another file: one with other addresses, words, scales, signs and codes is driven by its map alone."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from drivers.errors import DeviceRefused
from drivers.rig.indenter import Indenter, Limits, RigFaulted
from drivers.rig.registers import BadReply, RegisterMap, Table
from drivers.rig.samples import Sample
from fabctl.config.loader import parse
from fabctl.config.rig import RigMapConfig
from simulators.rig import registers as R
from simulators.rig.controller import TICK_S, Controller, Machine
from simulators.specimens.analytic import linear
from simulators.specimens.curve import Specimen

MAP = """
name: other
word_order: little # low word first
exchange: false # no function 23
magic: 0x1A2B
version: 7
tick_s: 0.001
timeout_s: 0.1
response_max_s: 0.05
states: [disarmed, ready, moving, faulted]
faults: [overload, watchdog, estop, travel, saturation, unhomed, restarted]
command_states: [none, running, done, refused, aborted]
reasons: [none, not_armed, faulted, outside_travel]
commands: {move: 11, stop: 12, arm: 13, disarm: 14, home: 15, clear: 16, move_until_above: 17, move_until_below: 18}
blocks:
  status:
    table: input
    address: 3000
    registers:
      - {name: force, kind: f32, scale: -9.80665e-3, unit: N, min: -60, max: 60} # grams, tension positive
      - {name: position, kind: i32, scale: -1e-3, unit: mm, min: -65, max: 65} # micrometres, upwards
      - {name: sequence, kind: u16}
      - {name: faults, kind: u16}
      - {name: state, kind: u16}
      - {name: command_reason, kind: u16}
      - {name: command_state, kind: u16}
      - {name: command_id, kind: u16}
  identity:
    table: holding
    address: 9000
    registers:
      - {name: model, kind: text, words: 4}
      - {name: version, kind: u16}
      - {name: magic, kind: u16}
      - {name: serial, kind: u16}
      - {name: firmware, kind: u16}
      - {name: capacity, kind: u16, scale: 0.1, unit: N}
      - {name: travel, kind: u16, scale: 0.1, unit: mm}
      - {name: speed_max, kind: u16, scale: 0.1, unit: mm_s}
  command:
    table: holding
    address: 4000
    registers:
      - {name: target, kind: i32, scale: -1e-3, unit: mm, min: 0, max: 60}
      - {name: until, kind: f32, scale: -9.80665e-3, unit: N}
      - {name: speed, kind: u16, scale: 0.01, unit: mm_s, max: 20}
      - {name: code, kind: u16}
      - {name: id, kind: u16}
  settings:
    table: holding
    address: 5000
    registers:
      - {name: watchdog, kind: u16, scale: 0.01, unit: s}
      - {name: acceleration, kind: u16, scale: 1, unit: mm_s2}
      - {name: safe_height, kind: i32, scale: -1e-3, unit: mm}
      - {name: travel_min, kind: i32, scale: -1e-3, unit: mm}
      - {name: travel_max, kind: i32, scale: -1e-3, unit: mm}
      - {name: force_min, kind: f32, scale: -9.80665e-3, unit: N}
      - {name: force_max, kind: f32, scale: -9.80665e-3, unit: N}
  feed:
    table: holding
    address: 6000
    registers:
      - {name: feed, kind: u16}
      - {name: request, kind: u16}
"""
GRAM_N = 9.80665e-3
ORDER = ("watchdog", "acceleration", "safe_height", "travel_min", "travel_max", "force_min", "force_max")


def low_first(kind: str, value: float) -> list[int]:
    """Return a 32-bit value as this rig sends it, packed here and not by the driver."""
    return list(struct.unpack("<2H", struct.pack("<" + kind, value)))


def from_low_first(kind: str, words: Sequence[int]) -> float:
    return float(struct.unpack("<" + kind, struct.pack("<2H", *words))[0])


@dataclass
class OtherRig:
    """The simulated controller behind the registers of another maker; also its clock."""

    device: Controller
    url: str = "memory:other"
    kept: dict[int, list[int]] = field(default_factory=dict)

    def read(self, table: Table, address: int, count: int) -> list[int]:
        self.device.advance(1)
        if (table, address) == ("input", 3000):
            s = R.values_of(R.STATUS, self.device.status_words()[:-1])
            words = low_first("f", -s["force"] / GRAM_N) + low_first("i", round(-1000 * s["position"]))
            names = ("sequence", "faults", "state", "command_reason", "command_state", "command_id")
            return words + [int(s[name]) % 2**16 for name in names]
        if (table, address) == ("holding", 9000):
            return [*struct.unpack(">4H", b"Other\0\0\0"), 7, 0x1A2B, 5, 203, 500, 600, 200]
        return self.kept[address]

    def write(self, address: int, values: Sequence[int]) -> None:
        self.device.advance(1)
        words = list(values)
        if address == 4000:
            command = dict.fromkeys([name for name, *_ in R.COMMAND], 0.0) | {
                "target": -from_low_first("i", words[:2]) / 1000,
                "until": -GRAM_N * from_low_first("f", words[2:4]),
                "speed": words[4] / 100,
                "code": words[5] - 10,
                "id": words[6],
            }
            assert self.device.write(100, R.words_of(R.COMMAND, command))
        elif address == 5000:
            lengths = [from_low_first("i", words[k : k + 2]) / -1000 for k in (2, 4, 6)]
            forces = [-GRAM_N * from_low_first("f", words[k : k + 2]) for k in (8, 10)]
            settings = dict(zip(ORDER, [words[0] / 100, float(words[1]), *lengths, *forces], strict=True))
            assert self.device.write(120, R.words_of(R.SETTINGS, settings))
        else:
            newest = self.device.tick_count - (self.device.tick_count - words[0]) % 2**16
            self.device.write(140, R.words_of(R.FEED, {"feed": max(0, newest), "request": words[1]}))
        self.kept[address] = words

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
    bus, heard = OtherRig(Controller(machine, Specimen(linear(0.5)))), list[Sample]()
    bus.device.advance(65_000)  # its sequence of 16 bits will wrap on the way
    rig = Indenter(bus, registers, heard.append, bus.now_s, bus.sleep)
    rig.set_limits(Limits(5.0, -2.0, 0.0, 40.0, 0.5, 50.0, 0.5))
    rig.arm()
    rig.wait(rig.home(10.0), 20.0)
    return rig, bus, heard


def test_another_rig_is_identified_moved_and_sampled_by_its_file() -> None:
    rig, bus, heard = driven()
    identity = rig.identify()
    assert (identity.model, identity.capacity_N, identity.travel_mm) == ("Other", 50.0, 60.0)
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
    before = dict(bus.kept)
    with pytest.raises(DeviceRefused, match="is outside"):
        rig.move(target_mm, speed_mm_s)
    assert bus.kept[4000] == before[4000]


def test_a_reading_outside_the_maps_limits_is_not_believed() -> None:
    rig, bus, _ = driven(MAP.replace("min: -60, max: 60}", "min: -60, max: 1}"))
    bus.device.hung_N = 2.0
    bus.device.advance(5)
    before = rig.lost_count
    with pytest.raises(BadReply, match="is outside -60 to 1 N"):
        rig.sample()
    assert rig.lost_count == before + 1
