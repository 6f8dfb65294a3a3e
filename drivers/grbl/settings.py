"""Who the board is and how it is set: `$I`, `$$`, `$#`, `$G`, `$N` as values. No I/O."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from drivers.grbl.messages import Banner, Info, Message, Report, Setting, Startup, Vector, finite, scaled

RX_FALLBACK_BYTES = 128
RX_LEAST_BYTES = 16
PLANNER_FALLBACK_COUNT = 15
INCH_MM = 25.4


class Settings(dict[int, float]):
    """The `$` settings by number; each in the unit that the board gives it."""


@dataclass(frozen=True, slots=True)
class Identity:
    """The board: firmware, options, buffers, settings, offsets, start-up lines."""

    firmware: str  # grbl, grblHAL or FluidNC
    version: str
    options: str
    rx_bytes: int
    planner_count: int
    settings: Settings = field(default_factory=lambda: Settings())
    offsets_mm: dict[str, Vector] = field(default_factory=dict)
    modes: str = ""
    startup: tuple[str, ...] = ()

    def setting(self, number: int) -> float | None:
        """Return a `$` setting, or None where the board does not tell it."""
        return self.settings.get(number)

    def is_on(self, number: int) -> bool:
        """Return whether a switch setting is on; one that the board does not tell counts as off."""
        return bool(self.settings.get(number, 0.0))

    @property
    def homes_to_zero(self) -> bool:
        """Return whether machine space is positive (`Z` in the build options); else it runs from minus travel to 0."""
        return "Z" in self.options

    @property
    def reports_inches(self) -> bool:
        """Return whether positions come in inches (`$13`)."""
        return self.is_on(13)

    @property
    def unit_mm(self) -> float:
        """Return the length in mm of the unit that the board reports places in."""
        return INCH_MM if self.reports_inches else 1.0

    def work_offset_mm(self) -> Vector:
        """Return machine minus work position of the active coordinate system, as `$#` and `$G` say."""
        active = next((word for word in self.modes.split() if word in self.offsets_mm and word != "G92"), "G54")
        base = self.offsets_mm.get(active, (0.0, 0.0, 0.0))
        g92 = self.offsets_mm.get("G92", (0.0, 0.0, 0.0))
        return base[0] + g92[0], base[1] + g92[1], base[2] + g92[2]


def identify(messages: Iterable[Message], idle: Report | None) -> Identity:
    """Return the identity that the answers to `$I $$ $# $G $N` amount to.

    The receive buffer is the third field of `[OPT:…,blocks,bytes]` (the second is planner blocks), or the free bytes of
    an idle `Bf:`: of both the smaller (ring buffers hold a byte less than their size), of neither 128.
    """
    version = options = modes = ""
    firmware = "grbl"
    fields: list[str] = []
    settings = Settings()
    offsets: dict[str, Vector] = {}
    startup: list[str] = []
    for message in messages:
        if isinstance(message, Setting):
            settings |= _number(message)
        elif isinstance(message, Startup):
            startup.append(message.line)
        elif isinstance(message, Banner):
            firmware = _firmware(message.text, firmware)
        elif isinstance(message, Info):
            if message.kind == "VER":
                version = message.text
                firmware = _firmware(message.text, firmware)
            elif message.kind == "OPT":
                options, *fields = message.text.split(",")
            elif message.kind == "FIRMWARE":
                firmware = _firmware(message.text, firmware)
            elif message.kind == "GC":
                modes = message.text
            elif message.kind.startswith("G") and "," in message.text:
                offsets |= _offset(message)
    if settings.get(13):
        offsets = {name: scaled(place, INCH_MM) for name, place in offsets.items()}
    rx_bytes = _rx_bytes(fields[1] if len(fields) > 1 else "", idle)
    blocks = int(fields[0]) if fields and fields[0].isdecimal() and len(fields[0]) < 7 else PLANNER_FALLBACK_COUNT
    return Identity(firmware, version, options, rx_bytes, blocks, settings, offsets, modes, tuple(startup))


def _rx_bytes(told: str, idle: Report | None) -> int:
    """Return how many bytes may be out: the smaller of what the build says and what is free while nothing waits."""
    sizes = [int(told)] if told.isdecimal() and len(told) < 7 else []
    if idle is not None and idle.state in ("Idle", "Alarm") and idle.free_bytes is not None:
        sizes.append(idle.free_bytes)
    return min((size for size in sizes if size >= RX_LEAST_BYTES), default=RX_FALLBACK_BYTES)


def _firmware(text: str, before: str) -> str:
    lower = text.lower()
    if "fluidnc" in lower:
        return "FluidNC"
    return "grblHAL" if "grblhal" in lower else before


def _number(message: Setting) -> dict[int, float]:
    try:
        return {message.number: finite(message.value)}
    except ValueError:
        return {}  # other dialects keep texts in some settings


def _offset(message: Info) -> dict[str, Vector]:
    try:
        parts = [finite(part) for part in message.text.split(",")]
    except ValueError:
        return {}
    return {message.kind: (parts[0], parts[1], parts[2] if len(parts) > 2 else 0.0)}
