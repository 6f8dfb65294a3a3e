"""What the parser remembers between lines, and what one line asks for. Values only."""

from __future__ import annotations

from dataclasses import dataclass

from simulators.grbl.words import f32

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
MIST, FLOOD = 1, 2  # bits of `coolant`: M7 and M8


@dataclass(frozen=True, slots=True)
class Modes:
    """The modal state, as `$G` shows it. `motion` is 0 to 3, 80, or 382 to 385 for G38.2 to G38.5."""

    motion: int = 0
    system: int = 0
    plane: int = 17
    units: int = 21
    distance: int = 90
    feed_mode: int = 94
    spindle: int = 5
    coolant: int = 0  # the sum of `MIST` and `FLOOD`
    tool_length: int = 49
    flow: int = -1


@dataclass(frozen=True, slots=True)
class Parser:
    """Everything the parser remembers between lines."""

    modes: Modes = Modes()
    feed_mm_min: float = 0.0  # 1/min under G93
    s_count: float = 0.0
    tool: int = 0
    position_mm: Vector = ZERO
    system_mm: Vector = ZERO
    g92_mm: Vector = ZERO
    tool_length_mm: float = 0.0
    has_mist: bool = False  # built with M7

    def offset_mm(self) -> Vector:
        """Return the work offset that is in force: machine minus work position."""
        x, y, z = (f32(a + b) for a, b in zip(self.system_mm, self.g92_mm, strict=True))
        return x, y, f32(z + self.tool_length_mm)


@dataclass(slots=True)
class Block:
    """A line that passed: its modes and what it asks for."""

    modes: Modes
    feed_mm_min: float = 0.0
    s_count: float = 0.0
    tool: int = 0
    has_axes: bool = False
    action: str = ""  # one of "", dwell, g10, g28, g30, g28.1, g30.1, g53, g92, g92.1
    axis_command: str = ""  # one of "", motion, other, length
    target_mm: Vector = ZERO
    second_mm: Vector = ZERO  # G28/G30 goal, G10 data, or the arc's centre from its start
    radius_mm: float = 0.0
    dwell_s: float = 0.0
    system: int = 0
    jog: bool = False
