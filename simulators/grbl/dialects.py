"""How grblHAL and FluidNC differ on the wire from GRBL 1.1h: banner, `$I`, buffers, extra lines and fields.

From what is publicly documented, not from recordings. Parser and motion are those of GRBL.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Dialect:
    """One firmware's way of speaking. `{note}` in `build` stands for the user's note, `{options}` for build options."""

    name: str
    banner: str
    build: tuple[str, ...]
    before_banner: tuple[str, ...] = ()
    blocks_count: int = 15
    rx_bytes: int = 128
    homed_field: bool = False  # |H:0 or |H:1 beside the work offset
    before_error: str = ""  # a line before `error:{code}`
    after_alarm: str = ""  # a line after `ALARM:{code}`


GRBL = Dialect("grbl", "Grbl 1.1h ['$' for help]", ("[VER:1.1h.20190830:{note}]", "[OPT:{options},15,128]"))
GRBLHAL = Dialect(
    "grblhal",
    "GrblHAL 1.1f ['$' or '$HELP' for help]",
    (
        "[VER:1.1f.20230917:{note}]",
        "[OPT:{options}NSL,35,1024,3,0]",
        "[AXS:3:XYZ]",
        "[NEWOPT:ENUMS,RT-,SED]",
        "[FIRMWARE:grblHAL]",
        "[NVS STORAGE:*FLASH]",
        "[DRIVER:SIMULATED]",
    ),
    blocks_count=35,
    rx_bytes=1024,
    homed_field=True,
)
FLUIDNC = Dialect(
    "fluidnc",
    "Grbl 3.7 [FluidNC v3.7.8 (esp32-wifi) '$' for help]",
    ("[VER:3.7 FluidNC v3.7.8 (esp32-wifi):{note}]", "[OPT:PHS]", "[MSG: Machine: simulated laser]"),
    before_banner=("[MSG:INFO: FluidNC v3.7.8]", "[MSG:INFO: Configuration file:config.yaml]"),
    blocks_count=16,
    rx_bytes=256,
    before_error="[MSG:ERR: Bad GCode: error {code}]",
    after_alarm="[MSG:INFO: ALARM {code}]",
)
DIALECTS = {dialect.name: dialect for dialect in (GRBL, GRBLHAL, FLUIDNC)}
