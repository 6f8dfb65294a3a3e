"""What the board keeps in its EEPROM: the `$` settings, offsets, start-up lines, the build note.

A write takes 3.4 ms for every byte that changes, and the firmware does not listen meanwhile.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from simulators.grbl.words import decimals

WRITE_S = 0.0034  # erase and write of one EEPROM byte, ATmega328P
N_SYSTEMS = 6  # G54 to G59; after them lie G28 and G30
G28, G30 = 6, 7
LINE_SIZE = 80

# number: (kind, default); kinds: u8, bool, float, rpm, u16
DEFAULTS: dict[int, tuple[str, float]] = {
    0: ("u8", 10),
    1: ("u8", 25),
    2: ("u8", 0),
    3: ("u8", 0),
    4: ("bool", 0),
    5: ("bool", 0),
    6: ("bool", 0),
    10: ("u8", 1),
    11: ("float", 0.010),
    12: ("float", 0.002),
    13: ("bool", 0),
    20: ("bool", 0),
    21: ("bool", 0),
    22: ("bool", 0),
    23: ("u8", 0),
    24: ("float", 25.0),
    25: ("float", 500.0),
    26: ("u16", 250),
    27: ("float", 1.0),
    30: ("rpm", 1000),
    31: ("rpm", 0),
    32: ("bool", 0),
    **{100 + k: ("float", 250.0) for k in range(3)},
    **{110 + k: ("float", 500.0) for k in range(3)},
    **{120 + k: ("float", 10.0) for k in range(3)},
    **{130 + k: ("float", 200.0) for k in range(3)},
}
OK, BAD_NUMBER, INVALID, NEGATIVE, PULSE_TOO_SHORT, NEEDS_HOMING = 0, 2, 3, 4, 6, 10


class Values(dict[int, float]):
    """Setting number to value; each in the unit the setting has."""


@dataclass
class Memory:
    """The EEPROM. `pending_s` is how long the last writes keep the board deaf."""

    values: Values = field(default_factory=lambda: Values((n, v) for n, (_, v) in DEFAULTS.items()))
    offsets_mm: list[tuple[float, float, float]] = field(default_factory=lambda: [(0.0, 0.0, 0.0)] * 8)
    startup: list[str] = field(default_factory=lambda: ["", ""])
    build_note: str = ""
    pending_s: float = 0.0

    def __getitem__(self, number: int) -> float:
        return self.values[number]

    def on(self, number: int) -> bool:
        """Return whether a switch setting is on."""
        return self.values[number] != 0

    def axes(self, first: int) -> tuple[float, float, float]:
        """Return the X, Y and Z values of the settings that begin at `first`."""
        return self.values[first], self.values[first + 1], self.values[first + 2]

    def store(self, number: int, value: float) -> int:
        """Take a setting; return 0 or the firmware's error code."""
        if value < 0:
            return NEGATIVE
        if number not in DEFAULTS:
            return INVALID
        if number == 0 and int(value) & 0xFF < 3:
            return PULSE_TOO_SHORT
        if number == 20 and int(value) & 0xFF and not self.on(22):
            return NEEDS_HOMING
        before = self._image()
        self.values[number] = _as_kind(DEFAULTS[number][0], value)
        if number == 22 and not self.on(22):
            self.values[20] = 0
        self._wrote(before, self._image())
        return OK

    def store_offset(self, system: int, offset_mm: tuple[float, float, float]) -> None:
        """Keep the offset of a work coordinate system, or of G28 or G30."""
        before, self.offsets_mm[system] = self.offsets_mm[system], offset_mm
        self._wrote(struct.pack("<3f", *before), struct.pack("<3f", *offset_mm))

    def store_startup(self, index: int, line: str) -> None:
        """Keep a start-up line; a number beyond the two lands nowhere."""
        if index < len(self.startup):
            before, self.startup[index] = self.startup[index], line
            self._wrote(_padded(before), _padded(line))

    def store_build_note(self, note: str) -> None:
        """Keep the text that `$I` shows."""
        before, self.build_note = self.build_note, note
        self._wrote(_padded(before), _padded(note))

    def restore(self, what: str) -> None:
        """Go back to the factory: `$` the settings, `#` the offsets, `*` everything."""
        before = self._image()
        if what in "$*":
            self.values = Values((n, v) for n, (_, v) in DEFAULTS.items())
        if what in "#*":
            for system in range(len(self.offsets_mm)):
                self.store_offset(system, (0.0, 0.0, 0.0))
        if what == "*":
            self.startup, self.build_note = ["", ""], ""
        self._wrote(before, self._image())

    def lines(self) -> list[str]:
        """Return the answer to `$$`."""
        return [f"${n}={_shown(kind, self.values[n])}" for n, (kind, _) in DEFAULTS.items()]

    def _image(self) -> bytes:
        return b"".join(_packed(kind, self.values[n]) for n, (kind, _) in DEFAULTS.items())

    def _wrote(self, before: bytes, after: bytes) -> None:
        changed = sum(a != b for a, b in zip(before, after, strict=True))
        if changed:
            self.pending_s += WRITE_S * (changed + 1)  # and the checksum


def _packed(kind: str, value: float) -> bytes:
    return struct.pack("<B", int(value)) if kind in ("u8", "bool") else struct.pack("<f", value)


def _padded(text: str) -> bytes:
    return text.encode("latin-1")[:LINE_SIZE].ljust(LINE_SIZE, b"\0")


def _as_kind(kind: str, value: float) -> float:
    if kind == "bool":
        return float((int(value) & 0xFF) != 0)
    if kind in ("u8", "u16"):
        return float(int(value) & 0xFF)
    return value


def _shown(kind: str, value: float) -> str:
    return decimals(value, 3) if kind == "float" else decimals(value, 0)
