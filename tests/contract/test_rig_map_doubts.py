"""A register map that does not fit the rig, or itself, is told with the key to change, before anything moves far."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks._rig_memory import REGISTERS, MemoryBus
from drivers.rig.indenter import Indenter, Limits
from drivers.rig.plausible import MapDoubted, contradictions, doubt_status
from drivers.rig.registers import RegisterMap
from fabctl.config.rig import load_rig
from simulators.rig.controller import Controller, Machine

GRAMS = load_rig("grams", Path("nowhere"))


def rescaled(block: str, name: str, ratio: float) -> RegisterMap:
    """Return the reference map with one register's scale multiplied by `ratio`."""
    old = REGISTERS.blocks[block]
    rows = tuple(replace(r, scale_ratio=r.scale_ratio * ratio) if r.name == name else r for r in old.registers)
    return replace(REGISTERS, blocks={**REGISTERS.blocks, block: replace(old, registers=rows)})


def rig_at(position_mm: float, registers: RegisterMap, homed: bool = True) -> Indenter:
    device = Controller(Machine(noise_N=0.0, backlash_mm=0.0))
    bus = MemoryBus(device)
    rig = Indenter(bus, REGISTERS, now_s=bus.now_s, sleep=bus.sleep)
    rig.set_limits(Limits(5.0, -2.0, 0.0, 40.0, 0.5, 50.0, 1.0))
    rig.arm()
    if homed:
        rig.wait(rig.home(10.0), 20.0)
        rig.wait(rig.move(position_mm, 10.0), 20.0)
    found = Indenter(bus, registers, now_s=bus.now_s, sleep=bus.sleep)
    found.fresh_sample()
    return found


def looked_at(rig: Indenter) -> None:
    rig.look(rig.identify())


@pytest.mark.parametrize("homed", [True, False])
def test_the_right_map_is_not_doubted(homed: bool) -> None:
    looked_at(rig_at(9.0, REGISTERS, homed))


@pytest.mark.parametrize("registers", [REGISTERS, GRAMS])
def test_the_shipped_maps_do_not_contradict_themselves(registers: RegisterMap) -> None:
    assert list(contradictions(registers)) == []


def test_the_wrong_word_order_is_named_with_the_right_one() -> None:
    rig = rig_at(9.0, REGISTERS)
    rig.registers = replace(REGISTERS, word_order="little")
    with pytest.raises(MapDoubted, match=r"identity.capacity.*set word_order: big"):
        rig.identify()


def test_a_rig_whose_identity_has_no_long_numbers_shows_the_word_order_by_its_sequence() -> None:
    device = Controller(Machine(noise_N=0.0))
    blocks = []
    for _ in range(2):
        device.advance(300)
        blocks.append(device.status_words())
    doubt_status(REGISTERS, blocks, 0.3, 50.0, 60.0)
    with pytest.raises(MapDoubted, match="set word_order: big"):
        doubt_status(replace(REGISTERS, word_order="little"), blocks, 0.3, 50.0, 60.0)


@pytest.mark.parametrize(
    ("name", "ratio", "said"),
    [("position", -1.0, "status.position reads -9 mm"), ("position", 7.0, "status.position reads 63 mm on a travel")],
)
def test_a_stage_where_no_stage_can_be_is_told_with_its_key(name: str, ratio: float, said: str) -> None:
    rig = rig_at(9.0, rescaled("status", name, ratio))
    identity = replace(rig.identify(), travel_mm=50.0)
    with pytest.raises(MapDoubted, match=f"{said}.*check its scale"):
        rig.look(identity)


def test_a_force_that_no_cell_shows_is_told_with_its_key() -> None:
    rig = rig_at(9.0, REGISTERS)
    identity = replace(rig.identify(), capacity_N=1e-4)
    rig.bus.device.hung_N = 0.01  # type: ignore[attr-defined]
    rig.bus.sleep(0.1)  # type: ignore[attr-defined]
    with pytest.raises(MapDoubted, match=r"status.force reads 0.1\d* N on a cell of 0.0001 N"):
        rig.look(identity)


def test_scales_that_contradict_each_other_are_told_and_end_the_first_motion() -> None:
    registers = rescaled("command", "target", 10.0)
    assert list(contradictions(registers)) == ["command.target counts in 0.001 mm, status.position in 0.0001 mm"]
    rig = rig_at(2.0, registers)
    with pytest.raises(MapDoubted, match=r"sent to 1.000 mm .* done at 0.100 mm.*command.target contradict"):
        rig.wait(rig.move(1.0, 10.0), 20.0)
    assert len(list(contradictions(rescaled("settings", "force_max", -1.0)))) == 1
