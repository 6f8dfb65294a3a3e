"""A cut, decided but not begun: the program where it will run, how long it takes, and what speaks against it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass

from design.findings import Finding
from drivers.grbl.messages import Report, Vector
from drivers.grbl.settings import Identity
from fabctl.config.bench import LaserConfig
from fabctl.config.material import MaterialConfig
from fabctl.cut.estimate import Dynamics, Estimate, estimate
from fabctl.cut.place import Affine, lay
from fabctl.cut.preflight import Sheet, preflight
from fabctl.cut.program import WORD, Program, decimal, read_program, split_long

PIECE_RATIO = 0.2  # of the longest run-on: no single move holds the board for longer
FRAME_FEED_MM_S = 50.0
SEGMENT_S = 0.010  # the board computes power and speed a hundred times a second
WORD_ARC = re.compile("[IJ]")


@dataclass(frozen=True, slots=True)
class CutPlan:
    """What will be sent, in the board's work coordinates."""

    program: Program
    times: Estimate
    affine: Affine
    work_offset_mm: Vector
    findings: tuple[Finding, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the lines as they are sent."""
        return self.program.lines

    @property
    def text(self) -> str:
        """Return the file `job.nc`."""
        return "\n".join(self.lines) + "\n"

    @property
    def sha256(self) -> str:
        """Return the hash of `job.nc`."""
        return hashlib.sha256(self.text.encode("ascii")).hexdigest()

    def bounds_mm(self) -> tuple[float, float, float, float] | None:
        """Return (x low, y low, x high, y high) of every move, machine coordinates."""
        bounds = self.program.bounds_mm()
        if bounds is None:
            return None
        dx, dy, _ = self.work_offset_mm
        return bounds[0] + dx, bounds[1] + dy, bounds[2] + dx, bounds[3] + dy

    def burnt_mm(self) -> float:
        """Return the length of everything that is burnt."""
        return sum(step.length_mm for step in self.program.steps if step.burns)


def plan_cut(
    lines: Sequence[str],
    affine: Affine,
    identity: Identity,
    report: Report | None,
    laser: LaserConfig,
    material: MaterialConfig,
    sheet: Sheet | None = None,
    homed: bool = True,
) -> CutPlan:
    """Return the plan for running `lines` (sheet coordinates) where `affine` lays the sheet."""
    offset = identity.work_offset_mm()
    laid = lay(with_air(lines, identity, material), affine, offset)
    laid = with_lit_ends(laid, Dynamics.of(identity.settings), head_mm(report, offset))
    laid = split_long(laid, laser.max_run_on_s * PIECE_RATIO)
    program = read_program(laid, identity.setting(12) or 0.002, head_mm(report, offset))
    found = preflight(program, identity, report, laser, material, offset, sheet, homed)
    return CutPlan(program, program_times(program, identity), affine, offset, tuple(found))


def with_lit_ends(
    lines: Sequence[str], dynamics: Dynamics, start_mm: tuple[float, float] = (0.0, 0.0)
) -> tuple[str, ...]:
    """Return the program with every stroke a few hundredths of a millimetre longer at its end.

    Under M4 the board sets the power by the speed at the end of each 10 ms of motion, so the last piece of braking is
    dark: up to a t²/2. Half of that added to the end leaves what is burnt within a t²/4 of what was drawn.
    """
    program = read_program(lines, start_mm=start_mm)
    out = list(program.lines)
    for step, following in zip(program.steps, (*program.steps[1:], None), strict=True):
        single = not WORD_ARC.search(out[step.line_index])
        if not step.burns or step.beam != 4 or not single or (following is not None and following.burns):
            continue
        unit = tuple((b - a) / step.length_mm for a, b in zip(step.start_mm, step.end_mm, strict=True))
        braking = min(a / abs(u) for a, u in zip(dynamics.acceleration_mm_s2, unit, strict=True) if u)
        added = braking * SEGMENT_S**2 / 4
        x, y = (e + u * added for e, u in zip(step.end_mm, unit, strict=True))
        rest = "".join(a + b for a, b in WORD.findall(out[step.line_index]) if a not in "XYFS")
        tail = "".join(a + b for a, b in WORD.findall(out[step.line_index]) if a in "FS")
        out[step.line_index] = f"{rest}X{decimal(x)}Y{decimal(y)}{tail}"
    return tuple(out)


def program_times(program: Program, identity: Identity) -> Estimate:
    """Return when each step of `program` ends on this board."""
    dynamics = Dynamics.of(identity.settings, identity.planner_count, identity.firmware)
    return estimate(program.steps, dynamics, sum(len(line) + 1 for line in program.lines))


def head_mm(report: Report | None, work_offset_mm: Vector) -> tuple[float, float]:
    """Return where the head is, work coordinates; zero where the board does not say."""
    if report is not None and report.machine_mm is not None:
        return report.machine_mm[0] - work_offset_mm[0], report.machine_mm[1] - work_offset_mm[1]
    if report is not None and report.work_mm is not None:
        return report.work_mm[0], report.work_mm[1]
    return 0.0, 0.0


def with_air(lines: Sequence[str], identity: Identity, material: MaterialConfig) -> tuple[str, ...]:
    """Return the program with air assist (M8) and exhaust (M7) on before the beam and off at its end, per the preset.

    M7 only where the board has it; elsewhere the exhaust is the operator's switch.
    """
    preset = material.laser
    on = (
        []
        if preset is None
        else [
            *(["M7"] if preset.exhaust and "M" in identity.options else []),
            *(["M8"] if preset.air_assist else []),
        ]
    )
    present = {line.strip().upper() for line in lines}
    if not on or {"M7", "M8"} & present:
        return tuple(lines)
    first = next((k for k, line in enumerate(lines) if line.strip().upper().startswith(("M3", "M4"))), 0)
    last = next((k for k in range(len(lines) - 1, -1, -1) if lines[k].strip().upper().startswith("M5")), len(lines) - 1)
    return (*lines[:first], *on, *lines[first : last + 1], "M9", *lines[last + 1 :])


def frame_lines(plan: CutPlan, power_s_count: float = 0.0) -> tuple[str, ...]:
    """Return a program that goes once around the job's bounds; the beam off, or on at a low S for the eye."""
    bounds = plan.program.bounds_mm()
    if bounds is None:
        return ()
    x0, y0, x1, y1 = (decimal(value) for value in bounds)
    feed = f"F{60 * FRAME_FEED_MM_S:g}S{power_s_count:g}"
    beam = "M4S0" if power_s_count > 0 else "M5"
    around = [f"G1X{x1}Y{y0}{feed}", f"X{x1}Y{y1}", f"X{x0}Y{y1}", f"X{x0}Y{y0}"]
    return ("G21", "G90", "G94", beam, f"G0X{x0}Y{y0}", *around, "M5", "G4P0.01")
