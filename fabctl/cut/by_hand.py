"""A small program run from where the head is: frames and test grids. **W**"""

from __future__ import annotations

import time
from collections.abc import Sequence

from design.findings import Finding, errors
from drivers.grbl.laser import Laser
from fabctl.bench import Bench
from fabctl.cut.execute import CutWatch, check_on_board, no_keys
from fabctl.cut.job import identity_of, laser_config
from fabctl.cut.place import lay, placement, travel_box_mm
from fabctl.cut.plan import CutPlan, head_mm, program_times
from fabctl.cut.preflight import BOX_MM
from fabctl.cut.program import read_program, split_long
from fabctl.cut.progress import Track
from fabctl.errors import RefusedError
from fabctl.events import Emit


def run_here(laser: Laser, bench: Bench, lines: Sequence[str], power_frac: float, emit: Emit) -> float:
    """Run `lines` with zero where the head is; `{s}` in them stands for `power_frac` of full power. Return its time.

    Refused where the board is locked, not in laser mode, or the program would leave the travel.
    """
    identity, config, report = identity_of(laser), laser_config(bench), laser.report()
    full = identity.setting(30) or 1000.0
    affine = placement("here", identity, config.travel_mm, config.origin_mm, report.machine_mm)
    offset = identity.work_offset_mm()
    placed = lay([line.replace("{s}", f"{power_frac * full:g}") for line in lines], affine, offset)
    program = read_program(split_long(placed, config.max_run_on_s * 0.2), start_mm=head_mm(report, offset))
    plan = CutPlan(program, program_times(program, identity), affine, offset, ())
    found = list(program.findings)
    if report.state == "Alarm":
        found.append(Finding("CUT-LOCKED", "the board is locked", hint="fabctl laser home"))
    if any(step.burns for step in program.steps) and not identity.is_on(32):
        found.append(Finding("CUT-LASER-MODE", "the board is not in laser mode ($32=0)", hint="$32=1"))
    if identity.is_on(13):
        found.append(Finding("CUT-INCHES", "the board reports inches ($13=1)", hint="fabctl laser settings 13=0"))
    bounds, box = plan.bounds_mm(), travel_box_mm(identity, config.travel_mm)
    if bounds is not None and identity.is_on(22):
        low, high = zip(bounds[:2], box[:2], strict=True), zip(bounds[2:], box[2:], strict=True)
        if any(a < b - BOX_MM for a, b in low) or any(a > b + BOX_MM for a, b in high):
            found.append(Finding("CUT-TRAVEL", f"it would leave the travel: {bounds} in {box} mm", hint="jog first"))
    if errors(found):
        raise RefusedError("this cannot run here", errors(found))
    check_on_board(laser, plan.lines)
    from drivers.grbl.run import run_program

    began_s = time.monotonic()
    run_program(laser, plan.lines, CutWatch(plan, Track(program, plan.times, config.max_run_on_s), emit, no_keys))
    return time.monotonic() - began_s
