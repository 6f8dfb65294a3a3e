"""Everything that speaks against a cut, found at once, before anything moves. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from design.findings import Finding
from drivers.grbl.messages import Report, Vector
from drivers.grbl.settings import Identity
from fabctl.config.bench import LaserConfig
from fabctl.config.material import MaterialConfig
from fabctl.cut.place import travel_box_mm
from fabctl.cut.program import Program

BOX_MM = 0.0005  # half of the last decimal that a program has: soft limits are as strict
THICKNESS_RATIO = 0.02


@dataclass(frozen=True, slots=True)
class Sheet:
    """The sheet that the design was made for."""

    material: str
    thickness_mm: float


def preflight(
    program: Program,
    identity: Identity,
    report: Report | None,
    laser: LaserConfig,
    material: MaterialConfig | None,
    work_offset_mm: Vector,
    sheet: Sheet | None = None,
    homed: bool = True,
) -> list[Finding]:
    """Return all findings against running `program` (in work coordinates) on this board with this material.

    `homed` says that the machine is homed now or will be before the first move. A program run by hand, such as a frame
    or a test grid, has no material yet, and may burn nothing.
    """
    return [
        *program.findings,
        *(_material(program, material, sheet) if material is not None else ()),
        *_bounds(program, identity, laser, work_offset_mm, homed),
        *_words(program, identity, laser),
        *_board(identity, report, laser, homed),
    ]


def _material(program: Program, material: MaterialConfig, sheet: Sheet | None) -> list[Finding]:
    found = []
    if not any(step.burns for step in program.steps):
        found.append(Finding("CUT-EMPTY", "the program burns nothing"))
    if material.laser is not None and material.laser.air_assist and not any(mode.flood for mode in program.modes):
        found.append(Finding("CUT-AIR", "the preset wants air assist, the job never switches it on (M8)"))
    if material.danger is not None:
        found.append(
            Finding(
                "CUT-MATERIAL-DANGER",
                f"{material.name} must not be cut: {material.danger}",
                hint="take another material",
            )
        )
    elif material.laser is None:
        found.append(Finding("CUT-PRESET", f"{material.name} has no laser preset", hint="cut a test grid first"))
    if sheet is not None:
        if sheet.material != material.name:
            found.append(
                Finding(
                    "CUT-SHEET",
                    f"the design is for {sheet.material}, the material is {material.name}",
                    hint="build the design for this sheet",
                )
            )
        elif abs(sheet.thickness_mm - material.thickness_mm) > THICKNESS_RATIO * material.thickness_mm:
            found.append(
                Finding(
                    "CUT-SHEET",
                    f"the design is for {sheet.thickness_mm:g} mm, {material.name} is {material.thickness_mm:g} mm",
                    hint="build the design for this sheet",
                    value=material.thickness_mm,
                    unit="mm",
                    limit=sheet.thickness_mm,
                )
            )
    return found


def _bounds(
    program: Program, identity: Identity, laser: LaserConfig, work_offset_mm: Vector, homed: bool
) -> list[Finding]:
    bounds = program.bounds_mm()
    if bounds is None:
        return []
    if not homed:
        return [
            Finding(
                "CUT-ZERO",
                "without homing the travel cannot be checked",
                "warning",
                hint="confirm where zero is, and frame the job first",
            )
        ]
    found = []
    box = travel_box_mm(identity, laser.travel_mm)
    for axis, k in (("X", 0), ("Y", 1)):
        low, high = bounds[k] + work_offset_mm[k], bounds[k + 2] + work_offset_mm[k]
        floor, ceiling = box[k], box[k + 2]
        if low < floor - BOX_MM or high > ceiling + BOX_MM:
            found.append(
                Finding(
                    f"CUT-{axis}",
                    f"the job needs {axis} {low:.3f} to {high:.3f} mm, the machine has {floor:g} to "
                    f"{ceiling:g} mm (all moves, lead-ins and the id included)",
                    hint="move the origin, or make the design smaller",
                    value=(low, high),
                    unit="mm",
                    limit=(floor, ceiling),
                )
            )
    return found


def _words(program: Program, identity: Identity, laser: LaserConfig) -> list[Finding]:
    found = []
    full = identity.setting(30)
    most = max((step.s_count for step in program.steps), default=0.0)
    if full is None:
        found.append(Finding("CUT-S", "the board does not tell its full power ($30)", "warning"))
    elif most > full:
        found.append(
            Finding(
                "CUT-S",
                f"S{most:g} is more than the board's full power $30={full:g}",
                hint="build for this $30",
                value=most,
                unit="S",
                limit=full,
            )
        )
    least = identity.setting(31) or 0.0
    if least > 0:
        found.append(
            Finding("CUT-S-MIN", f"$31={least:g}: the beam never goes below that while on", "warning", hint="set $31=0")
        )
    rates = (identity.setting(110) or math.inf, identity.setting(111) or math.inf)
    fastest = max((step.speed_mm_s for step in program.steps if step.burns), default=0.0) * 60
    if fastest > min(rates):
        found.append(
            Finding(
                "CUT-RATE",
                f"the job asks for F{fastest:g}, the machine's axes allow {min(rates):g} mm/min: the cut "
                "would get more energy than the preset says",
                hint="lower the feed of the preset",
                value=fastest,
                unit="mm/min",
                limit=min(rates),
            )
        )
    if any(step.beam == 3 and step.s_count > 0 for step in program.steps) and not laser.allow_m3:
        found.append(
            Finding(
                "CUT-M3",
                "M3 keeps the beam on while the machine stands still if the host dies",
                hint="use M4; allow_m3 in the bench file says that you accept a fire",
            )
        )
    if any(mode.mist for mode in program.modes) and "M" not in identity.options:
        found.append(Finding("CUT-M7", "this board has no M7", hint="switch the exhaust on by hand"))
    return found


def _board(identity: Identity, report: Report | None, laser: LaserConfig, homed: bool) -> list[Finding]:
    found = []
    if not identity.is_on(32):
        found.append(
            Finding(
                "CUT-LASER-MODE",
                "the board is not in laser mode ($32=0): the beam would stay on while it stands",
                hint="fabctl laser settings 32=1",
            )
        )
    for k, line in enumerate(identity.startup):
        if line:
            found.append(
                Finding(
                    "CUT-STARTUP", f"$N{k}={line} runs at every reset", hint=f"clear it: fabctl laser settings N{k}="
                )
            )
    if identity.reports_inches:
        found.append(Finding("CUT-INCHES", "the board reports inches ($13=1)", hint="fabctl laser settings 13=0"))
    if laser.homing and not identity.is_on(22):
        found.append(
            Finding(
                "CUT-HOMING",
                "the bench file says homing, the board has it off ($22=0)",
                hint="set $22=1, or homing: false in the bench file",
            )
        )
    if homed and not identity.is_on(20):
        found.append(Finding("CUT-SOFT-LIMITS", "soft limits are off ($20=0)", "warning", hint="set $20=1"))
    board = (identity.setting(130), identity.setting(131))
    for axis, theirs, ours in zip("XY", board, laser.travel_mm, strict=True):
        if theirs is not None and abs(theirs - ours) > 0.5:
            found.append(
                Finding(
                    "CUT-TRAVEL",
                    f"the bench file says {axis} {ours:g} mm, the board {theirs:g} mm",
                    "warning",
                    hint="the board's counts",
                )
            )
    if report is not None:
        found += _report(report)
    return found


def _report(report: Report) -> list[Finding]:
    found = []
    if report.overrides is not None and report.overrides != (100, 100, 100):
        found.append(
            Finding("CUT-OVERRIDE", f"overrides stand at {report.overrides}, not 100 %", hint="reset the board")
        )
    if report.state == "Alarm":
        found.append(Finding("CUT-LOCKED", "the board is locked: its position is not known", hint="fabctl laser home"))
    if report.state in ("Door", "Sleep", "Check", "Run", "Jog", "Home", "Hold"):
        found.append(Finding("CUT-STATE", f"the board is not idle: {report.state}", hint="close the door, or reset it"))
    if set("XY") & set(report.pins):
        found.append(Finding("CUT-SWITCH", f"a limit switch is pressed ({report.pins})", hint="move off it by hand"))
    if "D" in report.pins:
        found.append(Finding("CUT-DOOR", "the door is open", hint="close it"))
    return found
