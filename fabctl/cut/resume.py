"""Go on with a cut that was interrupted: from its record and from where the machine is, never from memory. **W**

While the position holds, the cut goes on from exactly there. Where it was lost, the machine is homed first, and the cut
goes on from the place it reported last. Asked before anything moves.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from design.findings import Finding, errors
from drivers.grbl.laser import Laser
from drivers.grbl.messages import Vector
from fabctl.bench import Bench, begun_elsewhere
from fabctl.cut.execute import minutes
from fabctl.cut.job import (
    CutDone,
    CutOrder,
    Desk,
    execute,
    identity_of,
    laser_config,
    laser_on,
    recorded,
    summary,
)
from fabctl.cut.kept import design_files, kept
from fabctl.cut.place import Affine
from fabctl.cut.plan import CutPlan, program_times
from fabctl.cut.preflight import preflight
from fabctl.cut.program import read_program
from fabctl.cut.progress import Place
from fabctl.cut.trail import burnt_before_mm, last_seen, read_trail, rest_of, stopped_at
from fabctl.cut.wirelog import WireLog
from fabctl.errors import RefusedError, Stopped, UsageError
from fabctl.events import Event
from fabctl.records.folder import RunFolder, open_run, sha256, start_run, status_of
from fabctl.workspace import Specimen, Workspace

OFFSET_MM = 0.0005


def resume(lab: Workspace, bench: Bench, order: CutOrder, path: Path, desk: Desk, dry_run: bool = False) -> CutDone:
    """Go on with the run in folder `path`; return what came of it.

    Raises `RefusedError` where the run cannot be gone on with, `UsageError` where there is no such run.
    """
    before = _interrupted(path)
    specimen = lab.specimen(str(before.manifest()["specimen"]))
    log = WireLog()
    try:
        with ExitStack() as stack:
            with kept(lab, bench, order, dry_run, {"asked_to_resume": before.run_id}):
                found = against_resuming(lab, before, specimen, order.design)
                if found:
                    raise RefusedError("the cut cannot be resumed", found)
                laser = stack.enter_context(laser_on(bench, log))
                plan, place, will_home = _plan_rest(laser, bench, order, before)
                facts = {**summary(plan, identity_of(laser)), "resumed": before.run_id, "position_kept": not will_home}
                if dry_run:
                    return CutDone(plan, specimen, None, facts)
                if not desk.ask(_question(before, plan, place, will_home)):
                    raise Stopped("not resumed: the operator said no")
            config: dict[str, Any] = {**before.manifest()["config"], "resumed": before.run_id, "plan": facts}
            run = start_run(
                lab.runs, "cut", specimen=specimen.name, inputs=design_files(specimen.design), config=config
            )
            with recorded(run, laser, log, desk, plan) as tell:
                if will_home:
                    tell(Event("stage", "homing: the position was lost"))
                    laser.home()
                result = execute(laser, plan, order, laser_config(bench), Desk(desk.ask, tell, desk.keys), run)
            bench.lay(specimen.design)
            return CutDone(plan, specimen, run, {**result, "resumed": before.run_id})
    finally:
        log.close()


def against_resuming(lab: Workspace, before: RunFolder, specimen: Specimen, design: Path) -> list[Finding]:
    """Return why going on would burn a line twice, or cut another design than the one that was begun."""
    found = []
    for later in lab.runs_of(specimen.name, "cut"):
        if later.manifest()["config"].get("resumed") == before.run_id and status_of(later) != "refused":
            text = f"{before.run_id} has already been gone on with, in {later.run_id} ({status_of(later)})"
            found.append(Finding("RESUME-TWICE", text, hint=f"look at that run: fabctl run show {later.run_id}"))
    if _identity(design) != _identity(specimen.design):
        text = f"{before.run_id} cut {specimen.name} from another design than {design}"
        found.append(Finding("RESUME-DESIGN", text, hint=f"fabctl cut run {specimen.design} --resume {before.run_id}"))
    return found


def _identity(design: Path) -> str:
    manifest = design / "manifest.json"
    return sha256(manifest) if manifest.is_file() else ""


def _interrupted(path: Path) -> RunFolder:
    if not path.is_dir():
        raise UsageError(f"{path}: no such run; `fabctl run list` names them")
    run = open_run(path)
    if run.manifest().get("kind") != "cut" or not (path / "wire.log").is_file():
        raise UsageError(f"{run.run_id}: not a cut that began")
    status = status_of(run)
    if status in ("done", "running", "refused"):
        raise RefusedError("nothing to resume", [Finding("RESUME-STATUS", f"{run.run_id} is {status}")])
    return run


def _plan_rest(laser: Laser, bench: Bench, order: CutOrder, before: RunFolder) -> tuple[CutPlan, Place, bool]:
    """Return the plan of what is left, where it begins, and whether the machine must be homed first."""
    identity, config = identity_of(laser), laser_config(bench)
    recorded_config = before.manifest()["config"]
    offset: Vector = tuple(recorded_config["work_offset_mm"])
    if any(abs(a - b) > OFFSET_MM for a, b in zip(offset, identity.work_offset_mm(), strict=True)):
        raise _refused(
            "RESUME-OFFSET", f"the work offset is {identity.work_offset_mm()}, it was {offset}", "set it back"
        )
    if elsewhere := begun_elsewhere(before, bench.config):
        raise RefusedError("the cut cannot be resumed", elsewhere)
    if sha256(before.artefact("job.nc")) != recorded_config["plan"]["job_sha256"]:
        raise _refused("RESUME-PROGRAM", f"the program of {before.run_id} is not the one sent", "cut the design anew")
    program = read_program(before.artefact("job.nc").read_text(encoding="ascii").splitlines())
    times = program_times(program, identity)
    log = before.path / "wire.log"
    trail = read_trail(log.read_text(encoding="ascii", errors="replace"), program, times, offset)
    if not trail.begun:
        raise _refused("RESUME-EMPTY", f"{before.run_id} ended before anything was cut", "cut the design anew")
    report = laser.report()
    place = stopped_at(trail, program, times, report, offset, max(time.time() - log.stat().st_mtime, 0.0))
    will_home = place is None
    if place is None:
        if not (config.homing and identity.is_on(22) and order.home):
            raise _refused(
                "RESUME-LOST",
                f"the machine's position was lost ({report.state} at {report.machine_mm})",
                "home the machine, or register the sheet by camera",
            )
        place = last_seen(trail, program)
    rest = read_program(rest_of(program, place))
    (xx, xy, x), (yx, yy, y) = recorded_config["placement"]
    affine = Affine(xx, xy, x, yx, yy, y)
    found = preflight(rest, identity, report, config, order.material, offset, order.sheet, True)
    found = [finding for finding in found if finding.code != "CUT-EMPTY"]
    if errors(found):
        raise RefusedError("the cut cannot go on", errors(found))
    return CutPlan(rest, program_times(rest, identity), affine, offset, tuple(found)), place, will_home


def _refused(code: str, message: str, hint: str) -> RefusedError:
    return RefusedError("the cut cannot be resumed", [Finding(code, message, hint=hint)])


def _question(before: RunFolder, plan: CutPlan, place: Place, will_home: bool) -> str:
    whole = read_program(before.artefact("job.nc").read_text(encoding="ascii").splitlines())
    total_mm = sum(step.length_mm for step in whole.steps if step.burns)
    done_mm = min(burnt_before_mm(whole, place), total_mm)
    how = (
        "its position was lost: it homes first, and goes on from where it was seen last, so that at most one stroke "
        "is cut twice"
        if will_home
        else "the machine still stands where it stopped, and goes on from exactly there"
    )
    return (
        f"{before.run_id}: {done_mm / 1000:.2f} of {total_mm / 1000:.2f} m are burnt; {how}.\n"
        f"  {plan.burnt_mm() / 1000:.2f} m and {minutes(plan.times.total_s)} are left. Same sheet, not moved? Go on?"
    )
