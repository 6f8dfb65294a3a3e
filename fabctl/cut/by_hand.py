"""A small program run from where the head is: frames and test grids. **W**"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from design.findings import errors
from drivers.grbl.laser import Laser
from fabctl.bench import Bench
from fabctl.cut.execute import check_on_board, run_plan
from fabctl.cut.job import identity_of, laser_config, tell_warnings
from fabctl.cut.place import is_homed, lay, placement
from fabctl.cut.plan import PIECE_RATIO, CutPlan, head_mm, program_times
from fabctl.cut.preflight import preflight
from fabctl.cut.program import read_program, split_long
from fabctl.errors import RefusedError, Stopped
from fabctl.events import Emit


def run_here(
    laser: Laser,
    bench: Bench,
    lines: Sequence[str],
    power_frac: float,
    emit: Emit,
    ask: Callable[[], bool] = lambda: True,
) -> float:
    """Run `lines` with zero where the head is; `{s}` in them stands for `power_frac` of full power. Return its time, s.

    Refused, with all findings, for what a cut is refused for; only a material and its preset are not asked for. The
    operator is asked after that and before anything moves; `Stopped` where the answer is no.
    """
    identity, config, report = identity_of(laser), laser_config(bench), laser.report()
    full = identity.setting(30) or 1000.0
    affine = placement("here", identity, config.travel_mm, config.origin_mm, report.machine_mm)
    offset = identity.work_offset_mm()
    placed = lay([line.replace("{s}", f"{power_frac * full:g}") for line in lines], affine, offset)
    placed = split_long(placed, config.max_run_on_s * PIECE_RATIO)
    program = read_program(placed, identity.setting(12) or 0.002, head_mm(report, offset))
    found = preflight(program, identity, report, config, None, offset, homed=is_homed(identity, report))
    tell_warnings(found, emit)
    if errors(found):
        raise RefusedError("this cannot run here", errors(found))
    if not ask():
        raise Stopped("not begun: the operator said no")
    check_on_board(laser, program.lines)
    plan = CutPlan(program, program_times(program, identity), affine, offset, tuple(found))
    progress, _ = run_plan(laser, plan, config.max_run_on_s, emit)
    return progress.time_s or 0.0
