"""A G-code program as the moves it makes: what preflight, estimate, progress and resume all look at.

Reads the small language that a laser job needs; anything beyond it is a finding, never guessed at.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from design.findings import Finding

LINE_LIMIT = 79
WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
MODAL_G = {"G17", "G21", "G90", "G94", "G40", "G91.1", "G54", "G55", "G56", "G57", "G58", "G59"}
MOTION = {"G0": 0, "G00": 0, "G1": 1, "G01": 1, "G2": 2, "G02": 2, "G3": 3, "G03": 3}
KNOWN_M = {"M3", "M4", "M5", "M7", "M8", "M9"}
KNOWN_LETTERS = set("GMXYIJFSPN")


@dataclass(frozen=True, slots=True)
class Step:
    """One straight piece of the program, or a pause.

    `line_index` is the line it comes from; `s_count` the S word in force (0 in rapids); `speed_mm_s` the programmed
    feed, infinite for a rapid; `sync` says that the machine stands still before it; `dwell_s` how long it then waits.
    """

    line_index: int
    start_mm: tuple[float, float]
    end_mm: tuple[float, float]
    speed_mm_s: float
    s_count: float
    beam: int = 5  # 3, 4 or 5: the M word in force
    sync: bool = False
    dwell_s: float = 0.0

    @property
    def length_mm(self) -> float:
        """Return the length of the piece."""
        return math.dist(self.start_mm, self.end_mm)

    @property
    def burns(self) -> bool:
        """Return whether the beam is on along it."""
        return self.beam != 5 and self.s_count > 0 and math.isfinite(self.speed_mm_s) and self.length_mm > 0


@dataclass(frozen=True, slots=True)
class Modes:
    """The modal state after a line; what a resumed job has to say again."""

    position_mm: tuple[float, float] = (0.0, 0.0)
    motion: int = 0
    feed_mm_min: float = 0.0
    s_count: float = 0.0
    beam: int = 5
    mist: bool = False
    flood: bool = False


@dataclass(frozen=True, slots=True)
class Program:
    """The lines as they will be sent, their steps, the modal state after each line, and what is wrong with them."""

    lines: tuple[str, ...]
    steps: tuple[Step, ...]
    modes: tuple[Modes, ...]
    findings: tuple[Finding, ...]

    def bounds_mm(self) -> tuple[float, float, float, float] | None:
        """Return (x low, y low, x high, y high) over every commanded place, in the program's own coordinates."""
        points = [p for step in self.steps if step.length_mm > 0 for p in (step.start_mm, step.end_mm)]
        # the first move starts from wherever the head is, which is no part of the job
        if self.steps and points:
            points = points[1:]
        if not points:
            return None
        xs, ys = [p[0] for p in points], [p[1] for p in points]
        return min(xs), min(ys), max(xs), max(ys)


def read_program(
    lines: Sequence[str], arc_tolerance_mm: float = 0.002, start_mm: tuple[float, float] = (0.0, 0.0)
) -> Program:
    """Return the program; `lines` in any case, with comments and blanks; `start_mm` is where the head is before it."""
    bare = [stripped for line in lines if (stripped := strip(line))]
    steps: list[Step] = []
    modes: list[Modes] = []
    findings: list[Finding] = []
    now = Modes(position_mm=start_mm)
    for index, line in enumerate(bare):
        if len(line) > LINE_LIMIT:
            findings.append(_finding("CUT-LINE-LENGTH", index, f"{len(line)} characters, the board takes {LINE_LIMIT}"))
        now = _read_line(index, line, now, steps, findings, arc_tolerance_mm)
        modes.append(now)
    return Program(tuple(bare), tuple(steps), tuple(modes), tuple(findings))


def strip(line: str) -> str:
    """Return the line as it travels: upper case, without comments and blanks."""
    line = re.sub(r"\([^)]*\)?", "", line.split(";", 1)[0])
    return "".join(line.split()).upper()


def _finding(code: str, index: int, message: str, hint: str = "") -> Finding:
    return Finding(code, message, where=f"line {index + 1}", hint=hint)


def _read_line(
    index: int, line: str, now: Modes, steps: list[Step], findings: list[Finding], arc_tolerance_mm: float
) -> Modes:
    words = WORD.findall(line)
    if "".join(letter + number for letter, number in words) != line:
        findings.append(_finding("CUT-SYNTAX", index, f"{line!r} is not G-code"))
        return now
    unknown = sorted({letter for letter, _ in words} - KNOWN_LETTERS)
    if unknown:
        findings.append(
            _finding("CUT-FORBIDDEN", index, f"{', '.join(unknown)} in {line!r} has no place in a laser job")
        )
        return now
    values = {letter: float(number) for letter, number in words if letter not in "GM"}
    before = now
    now = replace(now, feed_mm_min=values.get("F", now.feed_mm_min), s_count=values.get("S", now.s_count))
    dwell_s, sync = 0.0, now.s_count != before.s_count and not {"X", "Y"} & set(values) and before.beam != 5
    for letter, number in words:
        if letter == "G":
            name = "G" + number
            if name in MOTION:
                now = replace(now, motion=MOTION[name])
            elif name in ("G4", "G04"):
                dwell_s, sync = values.get("P", 0.0), True
            elif name not in MODAL_G:
                findings.append(_finding("CUT-FORBIDDEN", index, f"{name} has no place in a laser job", _why(name)))
        elif letter == "M":
            switched = _m_word(index, "M" + str(int(float(number))), now, findings)
            sync, now = sync or switched != now, switched  # a word that changes nothing waits for nothing
    if {"X", "Y"} & set(values) and dwell_s == 0.0:
        return _move(index, values, now, sync, steps, arc_tolerance_mm, findings)
    if sync or dwell_s:
        place = now.position_mm
        steps.append(Step(index, place, place, math.inf, now.s_count, now.beam, sync=True, dwell_s=dwell_s))
    return now


def _m_word(index: int, name: str, now: Modes, findings: list[Finding]) -> Modes:
    if name not in KNOWN_M:
        findings.append(_finding("CUT-FORBIDDEN", index, f"{name} has no place in a laser job"))
        return now
    if name in ("M3", "M4", "M5"):
        return replace(now, beam=int(name[1]))
    if name == "M9":
        return replace(now, mist=False, flood=False)
    return replace(now, mist=True) if name == "M7" else replace(now, flood=True)


def _move(
    index: int,
    values: dict[str, float],
    now: Modes,
    sync: bool,
    steps: list[Step],
    tolerance_mm: float,
    findings: list[Finding],
) -> Modes:
    start = now.position_mm
    end = (values.get("X", start[0]), values.get("Y", start[1]))
    rapid = now.motion == 0
    if not rapid and now.feed_mm_min <= 0:
        findings.append(_finding("CUT-FEED", index, "a cut without a feed rate"))
    speed = math.inf if rapid else max(now.feed_mm_min, 1.0) / 60
    power = 0.0 if rapid else now.s_count
    points = [end]
    if now.motion in (2, 3):
        if not {"I", "J"} & set(values):
            findings.append(_finding("CUT-FORBIDDEN", index, "an arc without I and J", "give the centre by I and J"))
        else:
            points = arc_points(start, end, (values.get("I", 0.0), values.get("J", 0.0)), now.motion == 2, tolerance_mm)
    for point in points:
        steps.append(Step(index, start, point, speed, power, now.beam, sync=sync))
        start, sync = point, False
    return replace(now, position_mm=end)


def arc_points(
    start: tuple[float, float],
    end: tuple[float, float],
    offset: tuple[float, float],
    clockwise: bool,
    tolerance_mm: float,
) -> list[tuple[float, float]]:
    """Return the ends of the chords into which the board divides an arc."""
    hub = (start[0] + offset[0], start[1] + offset[1])
    spoke, goal = (-offset[0], -offset[1]), (end[0] - hub[0], end[1] - hub[1])
    radius = math.hypot(*spoke)
    sweep = math.atan2(spoke[0] * goal[1] - spoke[1] * goal[0], spoke[0] * goal[0] + spoke[1] * goal[1])
    if clockwise and sweep >= -5e-7:
        sweep -= 2 * math.pi
    elif not clockwise and sweep <= 5e-7:
        sweep += 2 * math.pi
    square = tolerance_mm * (2 * radius - tolerance_mm)
    count = int(abs(0.5 * sweep * radius) / math.sqrt(square)) if square > 0 else 0
    points = []
    for k in range(1, count):
        cosine, sine = math.cos(sweep * k / count), math.sin(sweep * k / count)
        points.append((hub[0] + spoke[0] * cosine - spoke[1] * sine, hub[1] + spoke[0] * sine + spoke[1] * cosine))
    return [*points, end]


def _why(name: str) -> str:
    if name in ("G10", "G28.1", "G30.1"):
        return "it writes the board's memory"
    if name == "G20":
        return "jobs are in millimetres"
    if name == "G91":
        return "an incremental job cannot be resumed"
    return ""


def moved(lines: Sequence[str], shift_mm: tuple[float, float]) -> tuple[str, ...]:
    """Return the program moved by `shift_mm`: X and Y words shifted, everything else as it is."""
    return tuple(WORD.sub(lambda m: _shifted(m, shift_mm), strip(line)) for line in lines if strip(line))


def _shifted(match: re.Match[str], shift_mm: tuple[float, float]) -> str:
    letter, number = match[1], match[2]
    if letter not in "XY":
        return letter + number
    return letter + decimal(float(number) + shift_mm["XY".index(letter)])


def decimal(value: float) -> str:
    """Return a coordinate with at most three decimals, without trailing zeros, never `-0`."""
    text = f"{value:.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def split_long(lines: Sequence[str], longest_s: float, arc_tolerance_mm: float = 0.002) -> tuple[str, ...]:
    """Return the program with every straight cut that lasts longer than `longest_s` divided into equal pieces.

    So that the board never holds more than a few seconds of work: it goes on with what it holds when the host dies.
    """
    program = read_program(lines, arc_tolerance_mm)
    by_line: dict[int, list[Step]] = {}
    for step in program.steps:
        by_line.setdefault(step.line_index, []).append(step)
    out: list[str] = []
    for index, line in enumerate(program.lines):
        steps = by_line.get(index, [])
        long = len(steps) == 1 and math.isfinite(steps[0].speed_mm_s) and steps[0].dwell_s == 0
        count = math.ceil(steps[0].length_mm / (steps[0].speed_mm_s * longest_s) - 1e-9) if long else 1
        out += _pieces(line, steps[0], count) if count > 1 else [line]
    return tuple(out)


def _pieces(line: str, step: Step, count: int) -> list[str]:
    def place(k: int) -> str:
        x, y = (a + (b - a) * k / count for a, b in zip(step.start_mm, step.end_mm, strict=True))
        return f"X{decimal(x)}Y{decimal(y)}"

    head = "".join(letter + number for letter, number in WORD.findall(line) if letter not in "XY")
    return [
        head + place(1),
        *(place(k) for k in range(2, count)),
        f"X{decimal(step.end_mm[0])}Y{decimal(step.end_mm[1])}",
    ]
