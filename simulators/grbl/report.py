"""What the board says. Every text is given without its line end."""

from __future__ import annotations

from simulators.grbl.machine import BUSY, Machine, State, Suspend
from simulators.grbl.modes import FLOOD, MIST
from simulators.grbl.settings import N_SYSTEMS
from simulators.grbl.words import coordinate, decimals, f32, rate

HELP = "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
CHECK_LIMITS = "[MSG:Check Limits]"
LOCKED = "[MSG:'$H'|'$X' to unlock]"
WCO_BUSY, WCO_IDLE, OV_BUSY, OV_IDLE = 30, 10, 20, 10


def status(m: Machine) -> str:
    """Return the answer to `?`, and let the counters of the occasional fields run."""
    inches = m.memory.on(13)
    mask = int(m.memory[10])
    position, offset = m.position_mm(), m.parser.offset_mm()
    name = "MPos"
    if not mask & 1:
        name, position = "WPos", _minus(position, offset)
    fields = [_state(m), f"{name}:{_vector(position, inches)}"]
    if mask & 2:
        fields.append(f"Bf:{m.dialect.blocks_count - len(m.planner.moves)},{m.rx_free()}")
    speed = m.stepper.speed_mm_s * 60 if m.state in BUSY else 0.0
    fields.append(f"FS:{rate(speed, inches)},{decimals(m.shown_s_count, 0)}")
    pins = ("P" if m.probe_triggered() else "") + "".join("XYZ"[k] for k in sorted(m.limits_hit()))
    if pins:
        fields.append(f"Pn:{pins}")
    busy = m.state in BUSY
    if m.wco_count > 0:
        m.wco_count -= 1
    else:
        m.wco_count = (WCO_BUSY if busy else WCO_IDLE) - 1
        m.ov_count = m.ov_count or 1
        fields.append(f"WCO:{_vector(offset, inches)}")
        if m.dialect.homed_field and m.memory.on(22):
            fields.append(f"H:{int(m.homed)}")
    if m.ov_count > 0:
        m.ov_count -= 1
    else:
        m.ov_count = (OV_BUSY if busy else OV_IDLE) - 1
        fields.append(f"Ov:{m.overrides.feed},{m.overrides.rapid},{m.overrides.spindle}")
        on = "" if m.pin.power_frac == 0 else "C" if m.pin.ccw else "S"
        on += ("F" if m.coolant & FLOOD else "") + ("M" if m.coolant & MIST else "")
        if on:
            fields.append(f"A:{on}")
    return f"<{'|'.join(fields)}>"


def _state(m: Machine) -> str:
    if m.state is State.HOLD:
        if Suspend.JOG_CANCEL in m.suspend:
            return "Jog"
        return "Hold:0" if Suspend.HELD in m.suspend else "Hold:1"
    if m.state is State.DOOR:
        if Suspend.RESTORE in m.suspend:
            return "Door:3"
        if Suspend.RETRACTED not in m.suspend:
            return "Door:2"
        return "Door:1" if Suspend.AJAR in m.suspend else "Door:0"
    return str(m.state.value)


def parameters(m: Machine) -> list[str]:
    """Return the answer to `$#`."""
    inches = m.memory.on(13)
    names = [*(str(54 + k) for k in range(N_SYSTEMS)), "28", "30"]
    lines = [f"[G{n}:{_vector(o, inches)}]" for n, o in zip(names, m.memory.offsets_mm, strict=True)]
    lines.append(f"[G92:{_vector(m.parser.g92_mm, inches)}]")
    lines.append(f"[TLO:{coordinate(m.parser.tool_length_mm, inches)}]")
    return [*lines, probe(m)]


def probe(m: Machine) -> str:
    """Return the last probing's result."""
    x, y, z = (f32(s / p) for s, p in zip(m.probe_steps, m.memory.axes(100), strict=True))
    return f"[PRB:{_vector((x, y, z), m.memory.on(13))}:{int(m.probe_found)}]"


def modes(m: Machine) -> str:
    """Return the answer to `$G`."""
    p, now = m.parser, m.parser.modes
    motion = f"G38.{now.motion % 10}" if now.motion > 380 else f"G{now.motion}"
    feed = rate(p.feed_mm_min, m.memory.on(13))
    words = [motion, f"G{54 + now.system}", f"G{now.plane}", f"G{now.units}", f"G{now.distance}", f"G{now.feed_mode}"]
    air = [f"M{number}" for number, bit in ((7, MIST), (8, FLOOD)) if now.coolant & bit] or ["M9"]
    words += [f"M{now.spindle}", *air, f"T{p.tool}", f"F{feed}", f"S{decimals(p.s_count, 0)}"]
    return f"[GC:{' '.join(words)}]"


def build(m: Machine) -> list[str]:
    """Return the answer to `$I`."""
    return [line.format(note=m.memory.build_note, options=m.options) for line in m.dialect.build]


def _vector(values: tuple[float, float, float], inches: bool) -> str:
    return ",".join(coordinate(value, inches) for value in values)


def _minus(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return f32(a[0] - b[0]), f32(a[1] - b[1]), f32(a[2] - b[2])
