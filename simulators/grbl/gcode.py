"""One line of G-code, judged as the firmware judges it: what it asks for, or the number of its error.

Pure: nothing moves here. The order of the checks decides which error a line with several faults gets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from simulators.grbl.modes import FLOOD, MIST, Block, Modes, Parser, Vector
from simulators.grbl.settings import G28, G30, N_SYSTEMS, Memory
from simulators.grbl.words import MM_PER_INCH, f32, read_number

MAX_LINE_NUMBER = 10_000_000
PLANES = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}  # first, second and normal axis
NEVER_NEGATIVE = "FNPTS"

EXPECTED_LETTER, BAD_NUMBER, NEGATIVE = 1, 2, 4
JOG_WORDS = 16
UNSUPPORTED, MODAL_CLASH, NO_FEED, NOT_INTEGER, TWO_AXIS_COMMANDS, REPEATED, NO_AXIS_WORDS, LINE_NUMBER = range(20, 28)
WORD_MISSING, NO_SUCH_SYSTEM, G53_MODE, AXIS_WORDS_WITH_G80, NO_AXIS_IN_PLANE, BAD_TARGET, BAD_RADIUS = range(28, 35)
NO_OFFSETS_IN_PLANE, UNUSED_WORDS, TLO_AXIS, TOO_LARGE = range(35, 39)


class Fault(Exception):
    """The line is refused with this error number."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Values(dict[str, float]):
    """Letter to number; each in the unit its letter has."""


@dataclass(slots=True)
class _Words:
    values: Values = field(default_factory=lambda: Values())
    groups: set[str] = field(default_factory=set)
    axis_command: str = ""
    action: str = ""
    modes: Modes = field(default_factory=Modes)

    @property
    def axes(self) -> list[int]:
        return [k for k, letter in enumerate("XYZ") if letter in self.values]


def parse(line: str, parser: Parser, memory: Memory) -> Block:
    """Return what `line` asks for (upper case, no blanks, `$J=` taken off by the caller's flag); raise `Fault`."""
    jog = line.startswith("$J=")
    words = _read(line[3:] if jog else line, parser.modes, jog, parser.has_mist)
    block = Block(modes=words.modes, action=words.action, axis_command=words.axis_command, jog=jog)
    block.has_axes = bool(words.axes)
    if words.axes and not block.axis_command:
        block.axis_command = "motion"
    if words.values.get("N", 0) > MAX_LINE_NUMBER:
        raise Fault(LINE_NUMBER)
    used = set("NF") if jog else set("NFST")
    _set_feed(block, words, parser)
    block.s_count = words.values.get("S", parser.s_count)
    block.tool = int(words.values.get("T", 0))
    if block.action == "dwell":
        if "P" not in words.values:
            raise Fault(WORD_MISSING)
        block.dwell_s = words.values["P"]
        used.add("P")
    xyz = _millimetres(words)
    if block.axis_command == "length" and block.modes.tool_length == 43 and words.axes != [2]:
        raise Fault(TLO_AXIS)
    base = memory.offsets_mm[block.modes.system] if "system" in words.groups else parser.system_mm
    _set_target(block, words, xyz, base, parser, memory, used)
    _check_motion(block, words, parser, used)
    if block.axis_command:
        used |= set("XYZ")
    if set(words.values) - used:
        raise Fault(UNUSED_WORDS)
    if jog and (words.groups - {"distance", "units", "action"} or block.action not in ("", "g53")):
        raise Fault(JOG_WORDS)
    return block


def _read(text: str, modes: Modes, jog: bool, has_mist: bool) -> _Words:
    words = _Words(modes=replace(modes, motion=1, feed_mode=94) if jog else modes)
    at = 0
    while at < len(text):
        letter = text[at]
        if not "A" <= letter <= "Z":
            raise Fault(EXPECTED_LETTER)
        found = read_number(text, at + 1)
        if found is None:
            raise Fault(BAD_NUMBER)
        value, at = found
        if letter == "G":
            _command(words, *_g_word(words, *_whole_and_hundredths(value)))
        elif letter == "M":
            whole, hundredths = _whole_and_hundredths(value)
            if hundredths:
                raise Fault(NOT_INTEGER)
            _command(words, *_m_word(words, whole, has_mist))
        elif letter in "FIJKLNPRSTXYZ":
            if letter == "T" and value > 255:
                raise Fault(TOO_LARGE)
            if letter in words.values:
                raise Fault(REPEATED)
            if letter in NEVER_NEGATIVE and value < 0:
                raise Fault(NEGATIVE)
            words.values[letter] = value
        else:
            raise Fault(UNSUPPORTED)
    return words


def _whole_and_hundredths(value: float) -> tuple[int, int]:
    """Return a command's number as the firmware keeps it: one byte, and two for what that byte leaves."""
    if not math.isfinite(value):
        return 0, 1
    whole = int(value) & 0xFF
    left = 100 * (value - whole)
    return whole, int(math.copysign(math.floor(abs(left) + 0.5), left)) & 0xFFFF


def _command(words: _Words, group: str, left_over: int) -> None:
    if left_over:
        raise Fault(NOT_INTEGER)
    if group in words.groups:
        raise Fault(MODAL_CLASH)
    words.groups.add(group)


def _claim_axes(words: _Words, by: str) -> None:
    if words.axis_command:
        raise Fault(TWO_AXIS_COMMANDS)
    words.axis_command = by


def _g_word(words: _Words, g: int, hundredths: int) -> tuple[str, int]:
    """Apply one G word to `words`; return its modal group and the fraction nobody used."""
    if g in (10, 28, 30, 92, 4, 53):
        if g in (10, 28, 30, 92) and not hundredths:
            _claim_axes(words, "other")
        names = {4: "dwell", 53: "g53", 10: "g10"}
        if g in names:
            words.action = names[g]
            return "action", hundredths
        if hundredths not in (0, 10):
            raise Fault(UNSUPPORTED)
        words.action = f"g{g}.1" if hundredths else f"g{g}"
        return "action", 0
    if g in (0, 1, 2, 3, 38, 80):
        if g != 80:
            _claim_axes(words, "motion")
        if g == 38:
            if hundredths not in (20, 30, 40, 50):
                raise Fault(UNSUPPORTED)
            words.modes = replace(words.modes, motion=380 + hundredths // 10)
            return "motion", 0
        words.modes = replace(words.modes, motion=g)
        return "motion", hundredths
    if g in PLANES:
        words.modes = replace(words.modes, plane=g)
        return "plane", hundredths
    if g in (90, 91):
        if not hundredths:
            words.modes = replace(words.modes, distance=g)
            return "distance", 0
        if g == 90 or hundredths != 10:
            raise Fault(UNSUPPORTED)
        return "arc distance", 0
    if g in (93, 94):
        words.modes = replace(words.modes, feed_mode=g)
        return "feed mode", hundredths
    if g in (20, 21):
        words.modes = replace(words.modes, units=g)
        return "units", hundredths
    if g == 40:
        return "cutter", hundredths
    if g in (43, 49):
        _claim_axes(words, "length")
        if g == 43 and hundredths != 10:
            raise Fault(UNSUPPORTED)
        words.modes = replace(words.modes, tool_length=g)
        return "tool length", 0
    if 54 <= g <= 59:
        words.modes = replace(words.modes, system=g - 54)
        return "system", hundredths
    if g == 61:
        if hundredths:
            raise Fault(UNSUPPORTED)
        return "path control", 0
    raise Fault(UNSUPPORTED)


def _m_word(words: _Words, m: int, has_mist: bool) -> tuple[str, int]:
    if m in (0, 1, 2, 30):
        if m != 1:
            words.modes = replace(words.modes, flow=m)
        return "flow", 0
    if m in (3, 4, 5):
        words.modes = replace(words.modes, spindle=m)
        return "spindle", 0
    if m in (8, 9) or (m == 7 and has_mist):
        on = {7: words.modes.coolant | MIST, 8: words.modes.coolant | FLOOD}
        words.modes = replace(words.modes, coolant=on.get(m, 0))
        return "coolant", 0
    raise Fault(UNSUPPORTED)


def _set_feed(block: Block, words: _Words, parser: Parser) -> None:
    given = "F" in words.values
    scale = MM_PER_INCH if block.modes.units == 20 else 1.0
    block.feed_mm_min = words.values.get("F", 0.0)
    if block.jog:
        if not given:
            raise Fault(NO_FEED)
        block.feed_mm_min *= scale
    elif block.modes.feed_mode == 93:
        needs_it = block.axis_command == "motion" and block.modes.motion not in (0, 80)
        if needs_it and not given:
            raise Fault(NO_FEED)
    elif parser.modes.feed_mode == 94:
        block.feed_mm_min = block.feed_mm_min * scale if given else parser.feed_mm_min


def _millimetres(words: _Words) -> list[float]:
    scale = MM_PER_INCH if words.modes.units == 20 else 1.0
    return [f32(words.values.get(letter, 0.0) * scale) for letter in "XYZ"]


def _set_target(
    block: Block, words: _Words, xyz: list[float], base: Vector, parser: Parser, memory: Memory, used: set[str]
) -> None:
    if block.action == "g10":
        _set_system(block, words, xyz, parser, memory, used)
        return
    if block.action == "g92":
        if not words.axes:
            raise Fault(NO_AXIS_WORDS)
        goal = list(parser.g92_mm)
        for k in words.axes:
            goal[k] = f32(f32(parser.position_mm[k] - base[k]) - xyz[k])
            if k == 2:
                goal[k] = f32(goal[k] - parser.tool_length_mm)
        block.target_mm = _vector(goal)
        return
    goal = list(xyz)
    if block.axis_command != "length" and words.axes:
        goal = list(parser.position_mm)
        for k in words.axes:
            goal[k] = xyz[k]
            if block.action != "g53":
                goal[k] = f32(goal[k] + _shift(k, block, base, parser))
    block.target_mm = _vector(goal)
    if block.action in ("g28", "g30"):
        stored = memory.offsets_mm[G28 if block.action == "g28" else G30]
        if words.axes:
            home = [stored[k] if k in words.axes else parser.position_mm[k] for k in range(3)]
            block.second_mm = _vector(home)
        else:
            block.second_mm = stored
            block.axis_command = ""
    if block.action == "g53" and block.modes.motion not in (0, 1):
        raise Fault(G53_MODE)


def _shift(axis: int, block: Block, base: Vector, parser: Parser) -> float:
    if block.modes.distance == 91:
        return parser.position_mm[axis]
    return f32(base[axis] + parser.g92_mm[axis]) + (parser.tool_length_mm if axis == 2 else 0.0)


def _set_system(block: Block, words: _Words, xyz: list[float], parser: Parser, memory: Memory, used: set[str]) -> None:
    if not words.axes:
        raise Fault(NO_AXIS_WORDS)
    if not {"P", "L"} & set(words.values):
        raise Fault(WORD_MISSING)
    number = int(words.values.get("P", 0.0)) & 0xFF
    if number > N_SYSTEMS:
        raise Fault(NO_SUCH_SYSTEM)
    how = int(words.values.get("L", 0.0)) & 0xFF
    if how not in (2, 20) or (how == 2 and "R" in words.values):
        raise Fault(UNSUPPORTED)
    used |= {"L", "P"}
    block.system = number - 1 if number else block.modes.system
    data = list(memory.offsets_mm[block.system])
    for k in words.axes:
        data[k] = xyz[k]
        if how == 20:
            data[k] = f32(f32(parser.position_mm[k] - parser.g92_mm[k]) - xyz[k])
            if k == 2:
                data[k] = f32(data[k] - parser.tool_length_mm)
    block.second_mm = _vector(data)


def _check_motion(block: Block, words: _Words, parser: Parser, used: set[str]) -> None:
    if block.modes.motion == 80:
        if words.axes:
            raise Fault(AXIS_WORDS_WITH_G80)
        return
    if block.axis_command != "motion":
        return
    if block.modes.motion == 0:
        block.axis_command = "motion" if words.axes else ""
        return
    if block.feed_mm_min == 0:
        raise Fault(NO_FEED)
    if block.modes.motion == 1:
        block.axis_command = "motion" if words.axes else ""
        return
    if not words.axes:
        raise Fault(NO_AXIS_WORDS)
    if block.modes.motion in (2, 3):
        _check_arc(block, words, parser, used)
    elif block.target_mm == parser.position_mm:
        raise Fault(BAD_TARGET)


def _check_arc(block: Block, words: _Words, parser: Parser, used: set[str]) -> None:
    first, second, _ = PLANES[block.modes.plane]
    if not {first, second} & set(words.axes):
        raise Fault(NO_AXIS_IN_PLANE)
    scale = MM_PER_INCH if block.modes.units == 20 else 1.0
    x = block.target_mm[first] - parser.position_mm[first]
    y = block.target_mm[second] - parser.position_mm[second]
    centre = [words.values.get(letter, 0.0) for letter in "IJK"]
    if "R" in words.values:
        used.add("R")
        if block.target_mm == parser.position_mm:
            raise Fault(BAD_TARGET)
        radius = words.values["R"] * scale
        height = 4.0 * radius * radius - x * x - y * y
        if height < 0:
            raise Fault(BAD_RADIUS)
        across = math.hypot(x, y)
        ratio = -math.sqrt(height) / across if across else math.nan  # a helix onto itself has no centre
        if block.modes.motion == 3:
            ratio = -ratio
        if radius < 0:
            ratio, radius = -ratio, -radius
        centre[first], centre[second] = 0.5 * (x - y * ratio), 0.5 * (y + x * ratio)
        block.radius_mm = radius
    else:
        if not {"IJK"[first], "IJK"[second]} & set(words.values):
            raise Fault(NO_OFFSETS_IN_PLANE)
        used |= set("IJK")
        centre = [value * scale for value in centre]
        block.radius_mm = math.hypot(centre[first], centre[second])
        error_mm = abs(math.hypot(x - centre[first], y - centre[second]) - block.radius_mm)
        if error_mm > 0.005 and (error_mm > 0.5 or error_mm > 0.001 * block.radius_mm):
            raise Fault(BAD_TARGET)
    block.second_mm = _vector(centre)


def _vector(values: list[float]) -> Vector:
    return values[0], values[1], values[2]
