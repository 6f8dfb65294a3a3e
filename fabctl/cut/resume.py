"""Go on with a cut that was interrupted: from its record and from where the machine is, never from memory. **W**

While the position holds, the cut goes on from exactly there. Where it was lost, the machine is homed first, or the
operator says where the sheet's corner is now, or the camera sees it; the cut then goes on from the place it reported
last. Asked before anything moves.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from design.findings import Finding, errors
from drivers.grbl.laser import Laser
from drivers.grbl.messages import Report, Vector
from drivers.grbl.settings import Identity
from fabctl.bench import Bench, begun_elsewhere
from fabctl.config.bench import LaserConfig
from fabctl.config.loader import parse
from fabctl.config.material import MaterialConfig
from fabctl.cut.execute import minutes
from fabctl.cut.job import (
    CutDone,
    CutOrder,
    Desk,
    affine_of,
    execute,
    identity_of,
    laser_config,
    laser_on,
    placed,
    seen_against,
    summary,
    tell_warnings,
)
from fabctl.cut.kept import design_files, kept
from fabctl.cut.place import Affine, after_homing, is_homed, lay
from fabctl.cut.plan import CutPlan, program_times
from fabctl.cut.preflight import preflight
from fabctl.cut.program import Program, read_program
from fabctl.cut.progress import Place
from fabctl.cut.recorded import has_begun, how_to_go_on, recorded
from fabctl.cut.trail import EXACT_MM, PROGRAM_BEGINS, burnt_before_mm, last_seen, read_trail, rest_of, stopped_at
from fabctl.cut.wirelog import WireLog
from fabctl.errors import RefusedError, Stopped, UsageError
from fabctl.events import Emit, Event
from fabctl.records.folder import RunFolder, as_json, open_run, sha256, start_run, status_of, write_atomically
from fabctl.workspace import Specimen, Workspace

OFFSET_MM = 0.0005
STAMP = len("2026-01-01T000000Z")  # of a run's id: when it began
RESUMED_BY = "resumed-by.json"  # in the folder of the earlier run
WHAT = "the cut cannot be resumed"


@dataclass(frozen=True, slots=True)
class Rest:
    """What is left of a cut: its plan, and where in the whole program it begins.

    `stands` says that the machine still stands at `place`; `will_home` that it must be homed first.
    """

    whole: Program
    plan: CutPlan
    place: Place
    stands: bool
    will_home: bool


def resume(lab: Workspace, bench: Bench, order: CutOrder, path: Path, desk: Desk, dry_run: bool = False) -> CutDone:
    """Go on with the run in folder `path`; return what came of it.

    `order.origin` "home" leaves the job where it lay; "here" says that the sheet's corner is where the head is now,
    "camera" that it is where the camera sees it. Raises `RefusedError` where the run cannot be gone on with,
    `UsageError` where there is no such run.
    """
    before = _interrupted(path)
    specimen = lab.specimen(str(before.manifest()["specimen"]))
    log = WireLog()
    try:
        with ExitStack() as stack:
            with kept(lab, bench, order, dry_run, {"asked_to_resume": before.run_id}):
                _refuse(WHAT, [*against_resuming(lab, before, specimen, order.design), *_against(before, bench, order)])
                laser = stack.enter_context(laser_on(bench, log))
                rest = _plan_rest(laser, bench, order, before)
                facts = {**summary(rest.plan, identity_of(laser)), "resumed": before.run_id}
                facts["position_kept"] = rest.stands
                tell_warnings(rest.plan.findings, desk.emit)
                if dry_run:
                    return CutDone(rest.plan, specimen, None, facts)
                order = replace(order, frame=order.frame or _frames(order, rest))
                if not desk.ask(_question(before, rest, order)):
                    raise Stopped("not resumed: the operator said no")
                if order.eye is not None:
                    order.eye.look_again()
            config = {**before.manifest()["config"], **_laid(order, rest.plan), "resumed": before.run_id, "plan": facts}
            files = design_files(specimen.design)
            begin = partial(start_run, lab.runs, "cut", specimen=specimen.name, inputs=files, config=config)
            with recorded(begin, laser, log, desk.emit, rest.plan) as (run, tell):
                if order.eye is not None:
                    order.eye.record(run, rest.plan)
                if rest.will_home:
                    tell(Event("stage", "homing: the position was lost"))
                    laser.home()
                at_desk = Desk(desk.ask, _claiming(before, run, tell), desk.keys)
                result = execute(laser, rest.plan, order, laser_config(bench), at_desk, run)
            bench.lay(specimen.design)
            return CutDone(rest.plan, specimen, run, {**result, "resumed": before.run_id})
    finally:
        log.close()


def material_of(run: RunFolder) -> MaterialConfig:
    """Return the material that a run cut, as it was then."""
    found = run.manifest()["config"].get("material")
    if found is None:
        raise UsageError(f"{run.run_id}: not a cut that began")
    return parse(as_json(found), MaterialConfig, str(run.path / "manifest.json"))


def against_resuming(lab: Workspace, before: RunFolder, specimen: Specimen, design: Path) -> list[Finding]:
    """Return why going on would burn a line twice, or cut another design than the one that was begun."""
    found = _gone_on_with(lab, before, specimen)
    if _identity(design) != _identity(specimen.design):
        text = f"{before.run_id} cut {specimen.name} from another design than {design}"
        found.append(Finding("RESUME-DESIGN", text, hint=f"fabctl cut run {specimen.design} --resume {before.run_id}"))
    return found


def _claiming(before: RunFolder, later: RunFolder, tell: Emit) -> Emit:
    """Return `tell`, which before the program's first line writes down with `before` that `later` goes on with it.

    What is burnt twice must not hang on the later run's record alone: that may be damaged, or lost.
    """

    def claim(event: Event) -> None:
        tell(event)
        if event.data.get("mark") == PROGRAM_BEGINS:
            write_atomically(before.path / RESUMED_BY, as_json({"run": later.run_id}))

    return claim


def _gone_on_with(lab: Workspace, before: RunFolder, specimen: Specimen) -> list[Finding]:
    """Return what says, or may say, that `before` has already been gone on with."""
    found = []
    for later in lab.runs_of(specimen.name, "cut"):
        if later.manifest()["config"].get("resumed") == before.run_id and has_begun(later):
            text = f"{before.run_id} has already been gone on with, in {later.run_id} ({status_of(later)})"
            found.append(Finding("RESUME-TWICE", text, hint=f"look at that run: fabctl run show {later.run_id}"))
    if not found and (before.path / RESUMED_BY).exists():
        text = f"{before.run_id} has already been gone on with, says its {RESUMED_BY}"
        found.append(Finding("RESUME-TWICE", text, hint="that file names the run that has burnt more of the sheet"))
    for path in lab.unreadable_runs() if not found else ():
        if path.name[:STAMP] >= before.run_id[:STAMP] and "-cut-" in path.name and (path / "wire.log").exists():
            text = f"{path.name} cannot be read: it may have gone on with {before.run_id}"
            found.append(Finding("RESUME-TWICE", text, hint=f"look at the sheet; if it did not, move {path} away"))
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


def _against(before: RunFolder, bench: Bench, order: CutOrder) -> list[Finding]:
    """Return what the record has against going on here, with this material."""
    found, material = begun_elsewhere(before, bench.config), material_of(before).name
    if order.material.name != material:
        text = f"{before.run_id} cuts {material} with the powers of its preset, not {order.material.name}"
        found.append(Finding("RESUME-MATERIAL", text, hint="leave --material out"))
    if not has_begun(before):
        text = f"{before.run_id} ended before anything was cut"
        found.append(Finding("RESUME-EMPTY", text, hint=how_to_go_on(before)))
    if sha256(before.artefact("job.nc")) != before.manifest()["config"]["plan"]["job_sha256"]:
        text = f"the program of {before.run_id} is not the one sent"
        found.append(Finding("RESUME-PROGRAM", text, hint="cut the design anew"))
    return found


def _refuse(what: str, found: Sequence[Finding]) -> None:
    if errors(found):
        raise RefusedError(what, errors(found))


def _plan_rest(laser: Laser, bench: Bench, order: CutOrder, before: RunFolder) -> Rest:
    """Return what is left; raise `RefusedError` where the machine is not where it could be gone on from."""
    identity, config, report = identity_of(laser), laser_config(bench), laser.report()
    manifest = before.manifest()["config"]
    then_mm: Vector = tuple(manifest["work_offset_mm"])
    program = read_program(before.artefact("job.nc").read_text(encoding="ascii").splitlines())
    stood, seen = _stopped(before, program, identity, report, then_mm)
    will_home = stood is None and _can_home(order, config, identity)
    known = will_home or is_homed(identity, report)
    _refuse(WHAT, _against_place(order, report, then_mm, identity, stood, will_home))
    laid = Affine.of_rows(manifest["placement"])
    now = _now(order, config, identity, report, laid)
    lines = rest_of(program, stood or seen)
    if order.origin != "home":
        shift = Affine(x_mm=then_mm[0], y_mm=then_mm[1])
        lines = lay(lines, now.of(laid.inverse()).of(shift), identity.work_offset_mm())
    rest = read_program(lines)
    begin = after_homing(report, identity, config.travel_mm) if will_home else report
    offset_mm = identity.work_offset_mm()
    found = preflight(rest, identity, begin, config, order.material, offset_mm, order.sheet, known)
    found = [finding for finding in found if finding.code != "CUT-EMPTY"]
    plan = CutPlan(rest, program_times(rest, identity), now, offset_mm, tuple(found))
    plan = replace(plan, findings=(*found, *seen_against(order.eye, plan, known)))
    _refuse("the cut cannot go on", plan.findings)
    return Rest(program, plan, stood or seen, stood is not None, will_home)


def _stopped(
    before: RunFolder, program: Program, identity: Identity, report: Report, offset_mm: Vector
) -> tuple[Place | None, Place]:
    """Return where the machine stands on the program, None with its position lost; and where it was seen last."""
    times, log = program_times(program, identity), before.path / "wire.log"
    trail = read_trail(log.read_text(encoding="ascii", errors="replace"), program, times, offset_mm)
    lost = _lost(before.outcome() or {}, identity, report)
    elapsed_s = max(time.time() - log.stat().st_mtime, 0.0)
    stood = None if lost else stopped_at(trail, program, times, report, offset_mm, elapsed_s)
    return stood, last_seen(trail, program)


def _lost(outcome: Mapping[str, Any], identity: Identity, report: Report) -> bool:
    """Return whether the record says that the board's place means nothing any more.

    A board without homing that was switched off counts from elsewhere: only one that is where it was left is believed.
    """
    if outcome.get("position_known") is False:
        return True
    left_mm, now_mm = outcome.get("machine_mm"), report.machine_mm
    if identity.is_on(22) or left_mm is None or now_mm is None:
        return False
    return any(abs(a - b) > EXACT_MM for a, b in zip(left_mm[:2], now_mm[:2], strict=True))


def _can_home(order: CutOrder, config: LaserConfig, identity: Identity) -> bool:
    return order.home and order.origin != "here" and config.homing and identity.is_on(22)


def _against_place(
    order: CutOrder, report: Report, then_mm: Vector, identity: Identity, stood: Place | None, will_home: bool
) -> list[Finding]:
    """Return why the rest would not come to lie where the sheet is."""
    found, now_mm = [], identity.work_offset_mm()
    moved = any(abs(a - b) > OFFSET_MM for a, b in zip(then_mm, now_mm, strict=True))
    if order.origin == "home" and moved:
        text = f"the work offset is {now_mm}, it was {then_mm}"
        found.append(Finding("RESUME-OFFSET", text, hint="set it back"))
    if order.origin == "home" and stood is None and not will_home:
        text = f"the machine's position was lost ({report.state} at {report.machine_mm})"
        hint = "home the machine, or jog to the sheet's corner and give --origin here, or --origin camera"
        found.append(Finding("RESUME-LOST", text, hint=hint))
    if order.origin == "here" and stood is not None:
        text = "the head still stands on the cut, not at the sheet's corner"
        found.append(Finding("RESUME-ORIGIN", text, hint="leave --origin here out: it goes on from exactly there"))
    return found


def _now(order: CutOrder, config: LaserConfig, identity: Identity, report: Report, laid: Affine) -> Affine:
    """Return where the sheet lies now; `here` moves its corner and keeps its turn."""
    if order.origin == "home":
        return laid
    now = affine_of(order, config, identity, report)
    return replace(laid, x_mm=now.x_mm, y_mm=now.y_mm) if order.origin == "here" else now


def _laid(order: CutOrder, plan: CutPlan) -> dict[str, Any]:
    """Return where the rest lies, for the manifest, where that is not as before."""
    return placed(order, plan) if order.origin != "home" else {}


def _frames(order: CutOrder, rest: Rest) -> bool:
    """Return whether the operator must see where the rest lies: only he knows where zero is."""
    return order.origin == "here" or (not rest.stands and any(f.code == "CUT-ZERO" for f in rest.plan.findings))


def _question(before: RunFolder, rest: Rest, order: CutOrder) -> str:
    total_mm = sum(step.length_mm for step in rest.whole.steps if step.burns)
    done_mm = min(burnt_before_mm(rest.whole, rest.place), total_mm)
    last = "goes on from where it was seen last, so that at most one stroke is cut twice"
    how = "the machine still stands where it stopped, and goes on from exactly there"
    if not rest.stands:
        corner = "the sheet's corner is where the head is now" if order.origin == "here" else "its position was lost"
        how = f"{corner}: it homes first, and {last}" if rest.will_home else f"{corner}: it {last}"
    seen = f"  {order.eye.show(rest.plan)}\n" if order.eye is not None else ""
    sheet = "Same sheet" if order.origin != "home" else "Same sheet, not moved"
    return (
        f"{before.run_id}: {done_mm / 1000:.2f} of {total_mm / 1000:.2f} m are burnt; {how}.\n"
        f"{seen}"
        f"  {rest.plan.burnt_mm() / 1000:.2f} m and {minutes(rest.plan.times.total_s)} are left"
        f"{'; it frames them first' if order.frame else ''}. {sheet}? Go on?"
    )
