"""One cut from design to record: connect, plan, check, ask once, home, dry-check, frame, cut, write down. **W**

Everything is asked before the first motion. On every way out the beam is off and the record says how it ended.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from design.findings import Finding, errors
from drivers.clock import WallClock
from drivers.grbl.laser import Laser
from drivers.grbl.messages import Info, Report
from drivers.grbl.run import Wish
from drivers.grbl.settings import Identity, identify
from drivers.transport import open_transport
from drivers.transport.tap import Tap
from fabctl.bench import Bench
from fabctl.config.bench import BenchConfig, LaserConfig
from fabctl.config.material import MaterialConfig
from fabctl.cut.execute import check_on_board, minutes, no_keys, run_plan
from fabctl.cut.kept import design_files, kept
from fabctl.cut.place import Affine, Origin, after_homing, is_homed, placement
from fabctl.cut.plan import CutPlan, frame_lines, plan_cut, program_times
from fabctl.cut.preflight import Sheet
from fabctl.cut.program import read_program
from fabctl.cut.recorded import recorded
from fabctl.cut.trail import PROGRAM_BEGINS
from fabctl.cut.wirelog import WireLog
from fabctl.errors import RefusedError, Stopped, UsageError
from fabctl.events import Emit, Event
from fabctl.records.folder import RunFolder, start_run
from fabctl.workspace import Specimen, Workspace

Compose = Callable[[str, float], tuple[str, ...]]
"""From the specimen's id and the board's full power ($30) to G-code lines in sheet coordinates."""


class Eye(Protocol):
    """What a job asks of the camera over the bed (`fabctl.cut.by_camera`)."""

    def place(self) -> Affine:
        """Return the map from the job's coordinates to the machine's; raise `RefusedError` where none is found."""

    def against(self, plan: CutPlan) -> list[Finding]:
        """Return what speaks against the plan on the sheet that is seen."""

    def show(self, plan: CutPlan) -> str:
        """Write the picture of the job on the bed; return what to tell the operator."""

    def look_again(self) -> None:
        """Raise `RefusedError` where the sheet has moved since."""

    def record(self, run: RunFolder, plan: CutPlan) -> None:
        """Keep what was seen with the run."""

    def facts(self) -> dict[str, Any]:
        """Return what was seen as plain JSON."""


@dataclass(frozen=True, slots=True)
class CutOrder:
    """What is to be cut, how, and where; of the kinds cut, kerf and marks only marks make no specimen."""

    design: Path
    compose: Compose
    material: MaterialConfig
    sheet: Sheet | None = None
    origin: Origin = "home"
    camera_file: Path | None = None
    frame: bool = False
    frame_power_frac: float = 0.0
    home: bool = True
    check: bool = True
    eye: Eye | None = None
    kind: str = "cut"


@dataclass(frozen=True, slots=True)
class Desk:
    """Whoever sits before the machine: answers questions, presses keys, hears events."""

    ask: Callable[[str], bool]
    emit: Emit
    keys: Callable[[], Wish] = no_keys


@dataclass(frozen=True, slots=True)
class CutDone:
    """A finished cut, or a finished dry run (then without specimen and run)."""

    plan: CutPlan
    specimen: Specimen | None
    run: RunFolder | None
    result: dict[str, Any]


@contextmanager
def laser_on(bench: Bench, log: WireLog | None = None) -> Iterator[Laser]:
    """Open the bench's laser, connected and dark; off again afterwards, whatever happened."""
    clock = WallClock()
    transport = open_transport(bench.url("laser"))
    with Laser(Tap(transport, log.note, clock) if log is not None else transport, clock) as laser:
        laser.connect()
        yield laser


def laser_config(bench: Bench) -> LaserConfig:
    """Return the bench's laser section; raise `UsageError` where it has none."""
    return laser_config_of(bench.config)


def laser_config_of(config: BenchConfig) -> LaserConfig:
    """Return the laser section of a bench file; raise `UsageError` where it has none."""
    if config.laser is None:
        raise UsageError(f"bench {config.name} has no laser; add one to its file")
    return config.laser


def cut(lab: Workspace, bench: Bench, order: CutOrder, desk: Desk, dry_run: bool = False) -> CutDone:
    """Cut `order` on `bench`; return what came of it.

    Raises `RefusedError` with all findings before anything moves, `Stopped` where the operator said no or stopped it,
    and the driver's errors where the device failed; the run's record says the same, also where nothing began.
    """
    log = WireLog()
    try:
        with ExitStack() as stack:
            with kept(lab, bench, order, dry_run):
                laser = stack.enter_context(laser_on(bench, log))
                plan = _plan(laser, bench, order, lab.next_id())
                if any(finding.code == "CUT-ZERO" for finding in plan.findings):
                    order = replace(order, frame=True)  # where zero is, only the operator knows: let it be seen
                tell_warnings(plan.findings, desk.emit)
                _refuse(plan.findings)
                if dry_run:
                    if order.check and laser.report().state == "Idle":
                        check_on_board(laser, plan.lines)
                    return CutDone(plan, None, None, summary(plan, identity_of(laser)))
                if not desk.ask(question(plan, order, bench.config, homes(laser, bench, order))):
                    raise Stopped("not cut: the operator said no")
            return _cut_now(lab, bench, order, desk, laser, log)
    finally:
        log.close()


def identity_of(laser: Laser) -> Identity:
    """Return who the connected board is."""
    assert laser.identity is not None, "connect comes first"
    return laser.identity


def homes(laser: Laser, bench: Bench, order: CutOrder) -> bool:
    """Return whether the job will home the machine first."""
    config = laser_config(bench)
    return order.home and config.homing and order.origin != "here" and identity_of(laser).is_on(22)


def _plan(laser: Laser, bench: Bench, order: CutOrder, specimen: str) -> CutPlan:
    config, identity = laser_config(bench), identity_of(laser)
    report, will_home = laser.report(), homes(laser, bench, order)
    affine = affine_of(order, config, identity, report)
    lines = order.compose(specimen, identity.setting(30) or 1000.0)
    known = will_home or is_homed(identity, report)
    begin = after_homing(report, identity, config.travel_mm) if will_home else report
    plan = plan_cut(lines, affine, identity, begin, config, order.material, order.sheet, known)
    return replace(plan, findings=(*plan.findings, *seen_against(order.eye, plan, known)))


def seen_against(eye: Eye | None, plan: CutPlan, known: bool) -> list[Finding]:
    """Return what the camera has against the plan; it measures places on the machine, which homing makes `known`."""
    return [*_unhomed(known), *eye.against(plan)] if eye is not None else []


def _unhomed(known: bool) -> list[Finding]:
    """Return why a camera is of no use: it measures machine coordinates, which only homing makes mean anything."""
    if known:
        return []
    text = "the machine is not homed, so what the camera measures is no place on it"
    return [Finding("CUT-CAMERA-UNHOMED", text, hint="fabctl laser home; a machine without homing cuts from here")]


def affine_of(order: CutOrder, config: LaserConfig, identity: Identity, report: Report) -> Affine:
    """Return the map from the sheet to the machine that the order's origin means."""
    head = report.machine_mm
    if order.eye is not None:
        return order.eye.place()
    if order.origin == "home" and not identity.is_on(22):
        # Without homing, zero is where the operator says it is: the work origin of the board.
        dx, dy, _ = identity.work_offset_mm()
        return Affine(x_mm=dx + config.origin_mm[0], y_mm=dy + config.origin_mm[1])
    return placement(order.origin, identity, config.travel_mm, config.origin_mm, head, order.camera_file)


def tell_warnings(findings: Sequence[Finding], emit: Emit) -> None:
    """Emit every finding that does not stop the job."""
    for finding in findings:
        if finding.level != "error":
            emit(Event("finding", str(finding), data=finding.as_dict()))


def _refuse(findings: tuple[Finding, ...]) -> None:
    if errors(findings):
        raise RefusedError("the cut cannot begin", errors(findings))


def question(plan: CutPlan, order: CutOrder, config: BenchConfig, will_home: bool) -> str:
    """Return the one screen before the first motion."""
    preset = order.material.laser
    bounds = plan.bounds_mm() or (0.0, 0.0, 0.0, 0.0)
    focus = f", focus at {preset.focus_height_mm:g} mm" if preset is not None and preset.focus_height_mm else ""
    seen = f"  {order.eye.show(plan)}\n" if order.eye is not None else ""
    first = "homes the machine, then cuts" if will_home else "cuts from the zero you have set"
    run_on = f"{laser_config_of(config).max_run_on_s:g} s{' of simulated time' if config.is_simulated else ''}"
    return (
        f"{order.design}\n"
        f"  {order.material.name}, {order.material.thickness_mm:g} mm: on the bed, flat, clamped{focus}?\n"
        f"  machine X {bounds[0]:.1f} to {bounds[2]:.1f}, Y {bounds[1]:.1f} to {bounds[3]:.1f} mm; "
        f"{plan.burnt_mm() / 1000:.2f} m burnt, {len(plan.lines)} lines, {minutes(plan.times.total_s)}\n"
        f"{seen}"
        f"  {first}{', frames the job first' if order.frame else ''}; should this computer die, the machine "
        f"stops within {run_on}\n"
        "  exhaust on, lid shut, glasses on, you stay beside it with the stop within reach. Start?"
    )


def summary(plan: CutPlan, identity: Identity) -> dict[str, Any]:
    """Return the numbers of a plan, for the record and `--json`."""
    bounds = plan.bounds_mm()
    return {
        "lines_count": len(plan.lines),
        "burnt_mm": round(plan.burnt_mm(), 3),
        "estimate_s": round(plan.times.total_s, 2),
        "bounds_mm": [round(value, 3) for value in bounds] if bounds else None,
        "job_sha256": plan.sha256,
        "firmware": f"{identity.firmware} {identity.version}".strip(": "),
        "findings": [finding.as_dict() for finding in plan.findings],
    }


def _cut_now(lab: Workspace, bench: Bench, order: CutOrder, desk: Desk, laser: Laser, log: WireLog) -> CutDone:
    with kept(lab, bench, order):
        if order.eye is not None:
            order.eye.look_again()
        specimen = lab.new_specimen(order.design) if order.kind != "marks" else None
        plan = _plan(laser, bench, order, specimen.name if specimen is not None else "")
        _refuse(plan.findings)
    facts = {
        "bench": bench.config.model_dump(mode="json"),
        "material": order.material.model_dump(mode="json"),
        **placed(order, plan),
        "plan": summary(plan, identity_of(laser)),
    }
    begin = partial(
        start_run,
        lab.runs,
        order.kind,
        specimen=specimen.name if specimen is not None else None,
        inputs=design_files(specimen.design if specimen is not None else order.design),
        config=facts,
    )
    with recorded(begin, laser, log, desk.emit, plan) as (run, tell):
        if order.eye is not None:
            order.eye.record(run, plan)
        if homes(laser, bench, order):
            tell(Event("stage", "homing"))
            laser.home()
        result = execute(laser, plan, order, laser_config(bench), Desk(desk.ask, tell, desk.keys), run)
    if specimen is not None and order.kind == "cut":
        bench.lay(specimen.design)
    return CutDone(plan, specimen, run, result)


def placed(order: CutOrder, plan: CutPlan) -> dict[str, Any]:
    """Return where the job lies, for the run's manifest."""
    return {
        "origin": order.origin,
        "placement": plan.affine.rows(),
        "work_offset_mm": list(plan.work_offset_mm),
        **({"registration": order.eye.facts()} if order.eye is not None else {}),
    }


def execute(
    laser: Laser, plan: CutPlan, order: CutOrder, config: LaserConfig, desk: Desk, run: RunFolder
) -> dict[str, Any]:
    """Check on the board, frame if asked, cut; return the numbers of the run."""
    if order.check:
        desk.emit(Event("stage", f"checking {len(plan.lines)} lines on the board"))
        check_on_board(laser, plan.lines)
        recheck_offset(laser, plan)
    if order.frame:
        frame(laser, plan, order, config, desk)
    desk.emit(Event("stage", f"cutting, {minutes(plan.times.total_s)}", data={"mark": PROGRAM_BEGINS}))
    progress, track = run_plan(laser, plan, config.max_run_on_s, desk.emit, desk.keys)
    plan, actual_s = replace(plan, times=track.times), progress.time_s or 0.0
    result = {
        **summary(plan, identity_of(laser)),
        "actual_s": round(actual_s, 2),
        "answered_count": progress.answered_count,
        "nul_count": laser.link.listener.nul_count,
        "garbled_count": len(laser.link.garbled),
    }
    run.write_result(result)
    desk.emit(Event("stage", f"cut in {minutes(actual_s)} (estimated {minutes(plan.times.total_s)})"))
    return result


def recheck_offset(laser: Laser, plan: CutPlan) -> None:
    """Check mode restarts the board: the work offset must still be the one the plan was made for."""
    answers = [m for m in (*laser.ask("$#"), *laser.ask("$G")) if isinstance(m, Info)]
    laser.end()
    now = identify(answers, None).work_offset_mm()
    if any(abs(a - b) > 0.0005 for a, b in zip(now, plan.work_offset_mm, strict=True)):
        found = Finding(
            "CUT-OFFSET", f"the work offset changed from {plan.work_offset_mm} to {now}", hint="start again"
        )
        raise RefusedError("the cut cannot begin", [found])


def frame(laser: Laser, plan: CutPlan, order: CutOrder, config: LaserConfig, desk: Desk) -> None:
    """Go once around the job, dark or at low power, and ask whether it fits."""
    desk.emit(Event("stage", "framing"))
    full = identity_of(laser).setting(30) or 1000.0
    program = read_program(frame_lines(plan, order.frame_power_frac * full))
    around = CutPlan(program, program_times(program, identity_of(laser)), plan.affine, plan.work_offset_mm, ())
    run_plan(laser, around, config.max_run_on_s, desk.emit, desk.keys)
    if not desk.ask("The head went around the job. Does it fit the sheet?"):
        raise Stopped("not cut: the frame did not fit")
