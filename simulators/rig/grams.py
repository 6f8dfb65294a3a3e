"""The same machine behind another maker's registers: grams, micrometres upwards, low word first, no function 23.

Written from that maker's (invented) data sheet. Status is read from input registers at 3000; identity (9000), command
(4000), settings (5000) and feed (6000) are holding registers. Tension is positive, height is positive, the sequence has
16 bits, there is neither a check under the block nor an echo of the request, and no stage.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from simulators.rig import registers as R
from simulators.rig.controller import Controller

CENTIGRAM_N = 9.80665e-5
CODE_OFFSET = 10  # this maker's codes begin at 11
STATUS_AT, COMMAND_AT, SETTINGS_AT, FEED_AT, IDENTITY_AT = 3000, 4000, 5000, 6000, 9000
MAGIC, VERSION = 0x1A2B, 7


def long_words(value: float) -> list[int]:
    """Return a signed 32-bit number, low word first."""
    return list(struct.unpack("<2H", struct.pack("<i", round(value))))


def long_of(words: Sequence[int]) -> int:
    """Return a signed 32-bit number from its words, low word first."""
    return int(struct.unpack("<i", struct.pack("<2H", *words))[0])


def short_floats(value: float) -> list[int]:
    """Return a 32-bit float, low word first."""
    return list(struct.unpack("<2H", struct.pack("<f", value)))


@dataclass
class Grams(Controller):
    """The controller with this maker's registers before it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._raw_command = [0] * 8

    def read(self, table: str, address: int, count: int) -> list[int] | None:
        """Return registers that lie inside one block, or None where there are none."""
        for (where, start), words in self._blocks().items():
            if where == table and start <= address and address + count <= start + len(words):
                return words[address - start : address - start + count]
        return None

    def write(self, address: int, words: Sequence[int]) -> bool:
        """Take a whole block; False where it is not one, or may not be written now."""
        if (address, len(words)) == (COMMAND_AT, 8):
            self._raw_command = list(words)
            return super().write(R.COMMAND[0][1], R.words_of(R.COMMAND, self._command_of(words)))
        if (address, len(words)) == (SETTINGS_AT, 12):
            return super().write(R.SETTINGS[0][1], R.words_of(R.SETTINGS, _settings_of(words)))
        if (address, len(words)) == (FEED_AT, 2):
            newest = self.tick_count - (self.tick_count - words[0]) % 2**16
            return super().write(R.FEED[0][1], R.words_of(R.FEED, {"feed": max(0, newest), "request": words[1]}))
        return False

    def _command_of(self, words: Sequence[int]) -> dict[str, float]:
        return dict.fromkeys([name for name, *_ in R.COMMAND], 0.0) | {
            "target": -long_of(words[:2]) / 1000,
            "until": -CENTIGRAM_N * long_of(words[2:4]),
            "speed": words[4] / 100,
            "code": words[5] - CODE_OFFSET,
            "id": words[6],
        }

    def _blocks(self) -> dict[tuple[str, int], list[int]]:
        s = R.values_of(R.STATUS, self.status_words()[:-1])
        status = long_words(-s["force"] / CENTIGRAM_N) + long_words(-1000 * s["position"])
        names = ("sequence", "faults", "state", "command_reason", "command_state", "command_id")
        m, k = self.machine, self.settings
        settings = [round(100 * k["watchdog"]), round(k["acceleration"])]
        for name in ("safe_height", "travel_min", "travel_max"):
            settings += long_words(-1000 * k[name])
        for name in ("force_min", "force_max"):
            settings += long_words(-k[name] / CENTIGRAM_N)
        return {
            ("input", STATUS_AT): status + [int(s[name]) % 2**16 for name in names],
            ("holding", COMMAND_AT): self._raw_command,
            ("holding", SETTINGS_AT): settings,
            ("holding", FEED_AT): [self.last_feed % 2**16, 0],
            ("holding", IDENTITY_AT): [
                *struct.unpack(">6H", b"Gramometer\0\0"),
                VERSION,
                MAGIC,
                (1000 + self.seed) % 2**16,
                203,
                *short_floats(m.capacity_N / (100 * CENTIGRAM_N)),
                round(10 * m.travel_mm),
                round(10 * m.speed_max_mm_s),
            ],
        }


def _settings_of(words: Sequence[int]) -> dict[str, float]:
    lengths = {name: -long_of(words[k : k + 2]) / 1000 for name, k in LENGTHS.items()}
    forces = {name: -CENTIGRAM_N * long_of(words[k : k + 2]) for name, k in FORCES.items()}
    return {"watchdog": words[0] / 100, "acceleration": float(words[1]), **lengths, **forces}


LENGTHS = {"safe_height": 2, "travel_min": 4, "travel_max": 6}
FORCES = {"force_min": 8, "force_max": 10}
