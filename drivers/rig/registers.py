"""The register map as data: which word of which table means what, in which unit, in which word order.

Nothing here talks to a device. A map is made from a file (`configs/rigs/*.yaml`), so another rig is another file.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from drivers.errors import ProtocolError

Kind = Literal["u16", "i16", "u32", "i32", "f32", "text"]
Table = Literal["input", "holding"]
Value = int | float | str

PACKING = {"u16": ">H", "i16": ">h", "u32": ">I", "i32": ">i", "f32": ">f"}
RANGES = {"u16": (0, 2**16 - 1), "i16": (-(2**15), 2**15 - 1), "u32": (0, 2**32 - 1), "i32": (-(2**31), 2**31 - 1)}


@dataclass(frozen=True, slots=True)
class Register:
    """One value of a block. `scale_ratio` times the raw number is the value in `unit`; 0 keeps the raw number.

    A negative scale turns the sign: a rig that counts tension or height as positive. Values outside `low` to `high`, in
    `unit`, are neither sent nor believed.
    """

    name: str
    kind: Kind
    scale_ratio: float = 0.0
    unit: str = ""
    text_words_count: int = 0
    low: float = -math.inf
    high: float = math.inf

    @property
    def words_count(self) -> int:
        """Return how many 16-bit words the value takes."""
        return self.text_words_count if self.kind == "text" else struct.calcsize(PACKING[self.kind]) // 2


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that lie side by side and are read or written in one request."""

    table: Table
    address: int
    registers: tuple[Register, ...]

    @property
    def words_count(self) -> int:
        """Return the length of the block in words."""
        return sum(register.words_count for register in self.registers)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the values, in their order."""
        return tuple(register.name for register in self.registers)

    def placed(self) -> dict[str, tuple[int, Register]]:
        """Return each value's own address."""
        found, address = {}, self.address
        for register in self.registers:
            found[register.name] = (address, register)
            address += register.words_count
        return found


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """A rig's whole map. `faults` names the bits of the fault word from the lowest; `commands` are codes by name.

    With `exchange` the heartbeat is written and the status read in one request (function 23); without it in two.
    `heartbeat_s` is the load cell's time for one conversion, 0 where it is not known: then its heartbeat must only
    change. `clock_drift_ratio` is by how much the controller's clock may run faster or slower than the host's.
    """

    name: str
    word_order: Literal["big", "little"]
    exchange: bool
    magic: int
    version: int
    tick_s: float
    timeout_s: float
    response_max_s: float
    blocks: Mapping[str, Block]
    states: tuple[str, ...]
    faults: tuple[str, ...]
    command_states: tuple[str, ...]
    reasons: tuple[str, ...]
    commands: Mapping[str, int] = field(default_factory=dict)
    heartbeat_s: float = 0.0
    clock_drift_ratio: float = 5e-4

    def decode(self, block: str, words: Sequence[int]) -> dict[str, Value]:
        """Return the block's values in their units; raise `BadReply` where the number of words is wrong."""
        wanted = self.blocks[block].words_count
        if len(words) != wanted:
            raise BadReply(f"{block}: {len(words)} registers came, {wanted} were asked for")
        found: dict[str, Value] = {}
        start = 0
        for register in self.blocks[block].registers:
            end = start + register.words_count
            found[register.name] = decode_value(register, words[start:end], self.word_order)
            start = end
        return found

    def is_whole(self, words: Sequence[int]) -> bool:
        """Tell whether a status block fits the check at its end, where the map has one."""
        return self.blocks["status"].registers[-1].name != "check" or words[-1] == check_word(words[:-1])

    def encode(self, block: str, values: Mapping[str, Value]) -> list[int]:
        """Return the words of the whole block; every value of it must be given."""
        words: list[int] = []
        for register in self.blocks[block].registers:
            words += encode_value(register, values[register.name], self.word_order)
        return words

    def outside(self, block: str, values: Mapping[str, Value]) -> list[str]:
        """Return, in words, every value that lies outside the limits of its register."""
        return [
            f"{r.name} {value} {r.unit} is outside {r.low:g} to {r.high:g} {r.unit}"
            for r in self.blocks[block].registers
            if r.kind != "text"
            and (value := values.get(r.name)) is not None
            and not r.low <= float(value) <= r.high  # no number at all (nan) is outside too
        ]

    def fault_names(self, bits: int) -> tuple[str, ...]:
        """Return the names of the set bits; a bit without a name is called by its number."""
        named = dict(enumerate(self.faults))
        return tuple(named.get(k, f"bit{k}") for k in range(16) if bits >> k & 1)


class BadReply(ProtocolError):
    """A reply came and cannot be believed: wrong count, wrong check, stale, frozen or jumped. It is thrown away."""


def decode_value(register: Register, words: Sequence[int], word_order: str) -> Value:
    """Return one value from its words."""
    ordered = list(words) if word_order == "big" or register.kind == "text" else list(reversed(words))
    raw = struct.pack(f">{len(ordered)}H", *ordered)
    if register.kind == "text":
        return raw.rstrip(b"\0 ").decode("ascii", errors="replace")
    number: int | float = struct.unpack(PACKING[register.kind], raw)[0]
    return number * register.scale_ratio if register.scale_ratio else number


def encode_value(register: Register, value: Value, word_order: str) -> list[int]:
    """Return the words of one value; raise `ValueError` with the range where it does not fit."""
    if register.kind == "text":
        raw = str(value).encode("ascii").ljust(2 * register.text_words_count, b"\0")
        return list(struct.unpack(f">{register.text_words_count}H", raw[: 2 * register.text_words_count]))
    number = float(value) / register.scale_ratio if register.scale_ratio else value
    if register.kind != "f32":
        number = round(float(number)) if register.scale_ratio else int(number)
        low, high = RANGES[register.kind]
        if not low <= number <= high:
            unit = abs(register.scale_ratio) or 1
            raise ValueError(f"{register.name} = {value} {register.unit} is outside {low * unit:g} to {high * unit:g}")
    raw = struct.pack(PACKING[register.kind], number)
    words = list(struct.unpack(f">{len(raw) // 2}H", raw))
    return words if word_order == "big" else words[::-1]


def check_word(words: Sequence[int]) -> int:
    """Return the block's own check: CRC-16/CCITT-FALSE over its words, high byte first.

    Another polynomial than that of Modbus RTU, so that what slips through the one is caught by the other; and on
    Modbus TCP, which has no check of its own, the only one.
    """
    check = 0xFFFF
    for word in words:
        for byte in (word >> 8, word & 0xFF):
            check = (check << 8 & 0xFFFF) ^ _CCITT[check >> 8 ^ byte]
    return check


def _ccitt_row(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1 ^ 0x1021) & 0xFFFF if value & 0x8000 else value << 1
    return value


_CCITT = tuple(_ccitt_row(byte) for byte in range(256))
