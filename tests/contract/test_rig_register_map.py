"""The register map is written twice, once on each side of the wire; here the two are laid side by side."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.rig.registers import RegisterMap, check_word
from fabctl.config.rig import load_rig
from simulators.rig import registers as R

MAP = load_rig("reference", Path("nowhere"))
SIMULATED = {
    "status": R.STATUS,
    "identity": R.IDENTITY,
    "environment": R.ENVIRONMENT,
    "command": R.COMMAND,
    "settings": R.SETTINGS,
    "feed": R.FEED,
}
KINDS = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}


def rows_of(registers: RegisterMap, block: str) -> list[tuple[str, int, str, float]]:
    return [
        (name, address, KINDS.get(register.kind, f"{2 * register.text_words_count}s"), register.scale_ratio)
        for name, (address, register) in registers.blocks[block].placed().items()
        if name != "check"
    ]


@pytest.mark.parametrize("block", sorted(SIMULATED))
def test_names_addresses_kinds_and_steps_are_the_same_on_both_sides(block: str) -> None:
    assert rows_of(MAP, block) == list(SIMULATED[block])


def test_the_codes_are_the_same_on_both_sides() -> None:
    assert {name: getattr(R, name.upper()) for name in MAP.commands} == dict(MAP.commands)
    assert [getattr(R, name.upper()) for name in MAP.states] == list(range(len(MAP.states)))
    assert [getattr(R, name.upper()) for name in MAP.faults] == [1 << k for k in range(len(MAP.faults))]
    assert [getattr(R, name.upper()) for name in MAP.command_states] == list(range(len(MAP.command_states)))


@given(st.lists(st.integers(0, 2**16 - 1), max_size=30))
def test_both_sides_put_the_same_check_under_a_block(words: list[int]) -> None:
    assert check_word(words) == R.status_check(words)


def test_the_check_is_the_published_one() -> None:
    # CRC-16/CCITT-FALSE of "123456789" is 29B1 (the catalogue of parametrised CRC algorithms); even length here.
    words = [int.from_bytes(b"12345678"[k : k + 2], "big") for k in range(0, 8, 2)]
    assert check_word(words) == 0xA12B


def test_the_status_lies_where_the_driver_looks() -> None:
    placed = MAP.blocks["status"].placed()
    assert placed["check"][0] == R.STATUS_CHECK
    assert MAP.blocks["status"].address == 0
