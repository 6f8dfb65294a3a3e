"""The file of a rig (`configs/rigs/*.yaml`): its register map, checked and handed to the driver as plain data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from drivers.rig.registers import Block, Register, RegisterMap
from fabctl.config.bench import find
from fabctl.config.loader import Model, load

NEEDED = {
    "status": {"sequence", "state", "faults", "command_id", "command_state", "command_reason", "position", "force"},
    "identity": {"magic", "version", "model", "serial", "firmware", "capacity", "travel", "speed_max"},
    "command": {"id", "code", "target", "speed", "until"},
    "settings": {
        "force_max",
        "force_min",
        "travel_min",
        "travel_max",
        "safe_height",
        "acceleration",
        "watchdog",
    },
    "feed": {"feed", "request"},
}
COMMANDS = {"move", "stop", "arm", "disarm", "home", "clear", "move_until_above", "move_until_below"}


def _number(value: object) -> object:
    return int(value, 16) if isinstance(value, str) and value.startswith("0x") else value


Word = Annotated[int, BeforeValidator(_number), Field(ge=0, lt=2**16)]


class RegisterConfig(Model):
    """One value. `scale` times the raw number is the value in `unit` (negative: the sign is turned).

    Without `scale` the raw number counts. What is outside `min` to `max` is neither sent nor believed.
    """

    name: str
    kind: Literal["u16", "i16", "u32", "i32", "f32", "text"]
    scale: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    unit: str = ""
    words: Annotated[int, Field(ge=0, le=32)] = 0
    min: Annotated[float, Field(allow_inf_nan=False)] | None = None
    max: Annotated[float, Field(allow_inf_nan=False)] | None = None

    def register(self) -> Register:
        """Return it as the driver takes it."""
        low = -math.inf if self.min is None else self.min
        high = math.inf if self.max is None else self.max
        return Register(self.name, self.kind, self.scale, self.unit, self.words, low, high)


class BlockConfig(Model):
    """Registers side by side, read or written in one request."""

    table: Literal["input", "holding"]
    address: Word
    registers: Annotated[tuple[RegisterConfig, ...], Field(min_length=1)]


class RigMapConfig(Model):
    """The whole register map. Names in lists stand in the order of their codes (faults: of their bits)."""

    name: str
    word_order: Literal["big", "little"] = "big"
    exchange: bool = True
    magic: Word
    version: Word
    tick_s: Annotated[float, Field(gt=0)]
    timeout_s: Annotated[float, Field(gt=0)]
    response_max_s: Annotated[float, Field(gt=0)]
    heartbeat_s: Annotated[float, Field(ge=0)] = 0.0
    clock_drift_ratio: Annotated[float, Field(gt=0, lt=0.1)] = 5e-4
    states: tuple[str, ...]
    faults: Annotated[tuple[str, ...], Field(max_length=16)]
    command_states: tuple[str, ...]
    reasons: tuple[str, ...]
    commands: dict[str, Word]
    blocks: dict[str, BlockConfig]

    @model_validator(mode="after")
    def _complete(self) -> RigMapConfig:
        said = []
        for block, names in NEEDED.items():
            if block not in self.blocks:
                said.append(f"block {block} is missing")
                continue
            registers = self.blocks[block].registers
            lacking = names - {register.name for register in registers}
            said += [f"{block} lacks {', '.join(sorted(lacking))}"] if lacking else []
            if sum(max(1, r.words) for r in registers) > 121:
                said.append(f"{block} is longer than one request can be")
        if "status" in self.blocks:
            names_in_order = [r.name for r in self.blocks["status"].registers]
            if "check" in names_in_order and names_in_order[-1] != "check":
                said.append("status: check must be the last register")
            if self.exchange and self.blocks["status"].table != "holding":
                said.append("status: an exchange reads holding registers, not input registers")
        if lacking := COMMANDS - set(self.commands):
            said.append(f"commands lack {', '.join(sorted(lacking))}")
        if said:
            raise ValueError("; ".join(said))
        return self

    def registers(self) -> RegisterMap:
        """Return the map as the driver takes it."""
        blocks = {
            name: Block(
                table=block.table,
                address=block.address,
                registers=tuple(r.register() for r in block.registers),
            )
            for name, block in self.blocks.items()
        }
        facts = {name: getattr(self, name) for name in type(self).model_fields if name != "blocks"}
        return RegisterMap(blocks=blocks, **facts)


def load_rig(name: str, home: Path) -> RegisterMap:
    """Return the register map called `name`, or the one in the file of that path."""
    return load(find("rigs", name, home), RigMapConfig).registers()
