"""An indentation job: plan, check, execute, summarise. Only `execute` meets the rig."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from design.findings import Finding, errors
from drivers.clock import Clock, WallClock
from drivers.rig.indenter import Identity, Indenter, open_indenter
from drivers.rig.plausible import contradictions
from drivers.rig.registers import RegisterMap
from fabctl.bench import Bench, refuse_without
from fabctl.config.bench import BenchConfig, RigConfig, find
from fabctl.config.method import MethodConfig, load_method
from fabctl.config.rig import load_rig
from fabctl.errors import RefusedError, Stopped
from fabctl.events import Emit, Event, silent
from fabctl.indent.analysis import summarise_run
from fabctl.indent.calibration import Calibration, load_calibration
from fabctl.indent.method import Action, Predicted, actions, check, read_predicted, time_s
from fabctl.indent.recorder import Recorder
from fabctl.indent.resume import against_resuming, curves_done, on_another_rig, points_without_contact, resumed
from fabctl.indent.run import Ending, NoContact, Runner, left_behind
from fabctl.indent.sampling import Wish
from fabctl.priority import before_other_work
from fabctl.records.ending import outcome_kept
from fabctl.records.folder import RunFolder, start_run
from fabctl.workspace import Specimen, Workspace

CONDITIONS = {
    "thickness_mm": "the sheet's thickness",
    "batch": "its batch",
    "rest_h": "hours of rest since it was opened",
}
DRIFT_TOLD_FRAC = 0.01  # a drift of so much of the stiffness is told


@dataclass(frozen=True)
class IndentPlan:
    """A test, decided but not begun."""

    specimen: Specimen
    method: MethodConfig
    method_path: Path
    rig: RigConfig
    registers: RegisterMap
    map_path: Path
    actions: tuple[Action, ...]
    predicted: Predicted | None
    calibration: Calibration | None
    sample_hz: float
    findings: tuple[Finding, ...]
    resumed: RunFolder | None = None
    conditions: Mapping[str, Any] = field(default_factory=dict)

    @property
    def time_s(self) -> float:
        """Return about how long it takes."""
        return time_s(self.actions, self.method.travel_speed_mm_s)

    @property
    def predicted_peak_N(self) -> float | None:
        """Return the greatest force the design foresees on this plan."""
        depths = [a.depth_mm for a in self.actions if a.kind == "load" and a.depth_mm is not None]
        return self.predicted.peak_N(max(depths)) if self.predicted is not None and depths else None


@dataclass(frozen=True)
class Steering:
    """What the operator may do while it runs: `wish` says go, pause or stop; `go_on` ends a wait step."""

    wish: Callable[[], Wish] = lambda: "go"
    go_on: Callable[[str], bool] = lambda _message: True


def plan_test(
    lab: Workspace,
    specimen: Specimen,
    method: str,
    bench: BenchConfig,
    resume: RunFolder | None = None,
    facts: Mapping[str, Any] | None = None,
) -> IndentPlan:
    """Return what would be done, with everything that speaks against it; touches no device."""
    refuse_without(bench, "rig")
    assert bench.rig is not None
    read, registers = load_method(method, lab.root), load_rig(bench.rig.map, lab.root)
    steps = actions(read)
    findings = _nothing_to_press(specimen)
    if resume is not None:
        findings += against_resuming(lab, resume, specimen.name, read, bench)
        steps = resumed(steps, curves_done(resume), points_without_contact(resume))
        if not steps:
            findings.append(Finding("METHOD-DONE", "every curve of that run is done", where=resume.run_id))
    response = specimen.design / "response.csv"
    predicted = read_predicted(response) if response.is_file() else None
    calibration = load_calibration(lab.root, bench.name)
    findings += check(steps, read, bench.rig, predicted, "move_stage" in registers.commands)
    findings += [Finding("RIG-MAP", f"map {registers.name}: {each}", "warning") for each in contradictions(registers)]
    found = conditions(specimen.record(), facts or {})
    findings += unrecorded(found)
    findings += calibration.findings() if calibration is not None else _uncalibrated(bench.name)
    return IndentPlan(
        specimen,
        read,
        find("methods", method, lab.root),
        bench.rig,
        registers,
        find("rigs", bench.rig.map, lab.root),
        steps,
        predicted,
        calibration,
        read.sample_hz or bench.rig.sample_hz,
        tuple(findings),
        resume,
        found,
    )


def _nothing_to_press(specimen: Specimen) -> list[Finding]:
    if not specimen.is_coupon:
        return []
    text = f"{specimen.name} is a coupon: flat patches, no surface under the indenter"
    return [Finding("INDENT-COUPON", text, hint="fill in its form, then fabctl design coupon-read")]


def refuse(plan: IndentPlan) -> None:
    """Raise `RefusedError` where an error stands against the plan."""
    against = errors(plan.findings)
    if against:
        raise RefusedError(f"{plan.specimen.name}: method {plan.method.name} is refused", against)


def run_test(
    lab: Workspace,
    plan: IndentPlan,
    bench: Bench,
    emit: Emit = silent,
    steering: Steering | None = None,
    clock: Clock | None = None,
) -> RunFolder:
    """Carry the plan out and return its run, closed; a run that went wrong is closed as such, and the error raised."""
    refuse(plan)
    bench.lay(plan.specimen.design)
    with contextlib.closing(open_indenter(bench.url("rig"), plan.registers)) as rig:
        identity = rig.identify()
        _refuse_rig(plan, identity)
        config = _config(plan, identity, rig.environment(), bench.config)
        inputs = [plan.method_path, plan.map_path]
        inputs += [p for p in (plan.specimen.design / "response.csv",) if p.is_file()]
        run = start_run(lab.runs, "indent", specimen=plan.specimen.name, inputs=inputs, config=config)
        with outcome_kept(run):
            emit(Event("stage", f"run {run.run_id}"))
            try:
                ending = _record(run, plan, rig, emit, steering or Steering(), clock or WallClock())
            except (Stopped, NoContact) as fault:
                fault.add_note(f"look at the specimen, then `fabctl rig retract`; go on by --resume {run.run_id}")
                raise
            run.write_result(_sampled(plan, ending))
            run.finish("done")  # the samples are whole: what breaks off the figures takes nothing from them
    emit(Event("stage", "recorded; computing the figures"))
    try:
        _add_figures(run, plan, ending)
    except KeyboardInterrupt:
        word = f"stopped; {run.run_id} is recorded whole, its figures: fabctl indent analyse {run.run_id}"
        raise Stopped(word) from None
    return run


def _record(run: RunFolder, plan: IndentPlan, rig: Indenter, emit: Emit, steering: Steering, clock: Clock) -> Ending:
    """Carry the plan out, every sample durable."""
    both = _both(run.log_events(), emit)
    with before_other_work(), contextlib.closing(Recorder(run.path / "samples.csv")) as keeper:
        return Runner(
            rig, plan.method, plan.actions, keeper, clock, plan.sample_hz, both, steering.wish, steering.go_on
        ).execute()


def _sampled(plan: IndentPlan, ending: Ending) -> dict[str, Any]:
    """Return how the sampling went, and what the design foresees beside it."""
    places = {action.point: action.at_mm for action in plan.actions if action.at_mm is not None}
    without = [{"point": n, "at_mm": places.get(n), "reason": why} for n, why in ending.no_contact.items()]
    reaches = plan.predicted is not None and plan.predicted.depth_mm[-1] >= plan.method.secant_mm
    return {
        "rows_count": ending.rows_count,
        "lost_replies_count": ending.lost_count,
        "tares_N": ending.tares_N,
        "points_without_contact": without,
        "findings": [f.as_dict() for f in (*plan.findings, *_untouched(without))],
        "predicted_secant_N_mm": plan.predicted.secant_N_mm(plan.method.secant_mm)
        if plan.predicted is not None and reaches
        else None,
    }


def _add_figures(run: RunFolder, plan: IndentPlan, ending: Ending) -> None:
    """Compute the run's figures and write them beside what is known; a run without any contact has failed."""
    body = {**_sampled(plan, ending), **summarise_run(run)}
    body["findings"] += [f.as_dict() for f in (*_drifting(body["curves"]), *_disturbed(body["curves"]))]
    run.write_result(body)
    if (body["curves"] or ending.no_contact) and all(curve["contact_mm"] is None for curve in body["curves"]):
        reason = "no curve has a contact: was a specimen in place, and the indenter free when it was tared?"
        run.finish("failed", reason)
        raise RefusedError(f"{run.run_id}: nothing was measured", [Finding("INDENT-NO-CONTACT", reason)])


def conditions(record: Mapping[str, Any], facts: Mapping[str, Any], now: datetime | None = None) -> dict[str, Any]:
    """Return what is known of the specimen as it is tested: its record, what the operator says, and how long it rested.

    The rest since its deployment follows from `deployed_utc` where nobody gives `rest_h`.
    """
    known = {key: record[key] for key in (*CONDITIONS, "deployed_utc") if record.get(key) is not None}
    known |= {key: value for key, value in facts.items() if value is not None}
    with contextlib.suppress(KeyError, ValueError, TypeError):
        since = datetime.fromisoformat(str(known["deployed_utc"])).astimezone(UTC)
        known.setdefault("rest_h", round(((now or datetime.now(UTC)) - since).total_seconds() / 3600, 2))
    return known


def unrecorded(known: Mapping[str, Any]) -> list[Finding]:
    """Say which conditions of a test nobody has written down: rubber depends on them."""
    lacking = [words for name, words in CONDITIONS.items() if name not in known]
    if not lacking:
        return []
    hint = "`fabctl specimen note S-… thickness_mm=2.31 batch=B7`, or --thickness-mm, --batch and --rest-h"
    return [Finding("INDENT-CONDITIONS", f"not recorded: {', '.join(lacking)}", "warning", hint=hint)]


def _drifting(curves: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Say which curves began while the force was drifting."""
    worst = max(curves, key=lambda curve: abs(curve.get("drift_N_mm") or 0.0), default=None)
    drift_N_mm = (worst or {}).get("drift_N_mm") or 0.0
    if worst is not None and abs(drift_N_mm) > DRIFT_TOLD_FRAC * abs(worst.get("stiffness_secant_N_mm") or 0.0):
        count = sum(bool(curve.get("drift_N_mm")) for curve in curves)
        bent = " (it bends; what that leaves open of the contact is in its error)" if worst.get("drift_N_mm2") else ""
        yield Finding(
            "INDENT-DRIFT",
            f"in {count} of {len(curves)} curves the force drifts before contact, by up to {1000 * drift_N_mm:.2g} "
            f"mN/mm{bent}; the contact is found beside it, forces under load may hold it",
            "warning",
            hint="let the load cell warm up, look for a cable that is dragged along, go faster",
        )


def _disturbed(curves: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Say how many single samples stood out and were left out of the figures."""
    count = sum(curve.get("spikes_count") or 0 for curve in curves)
    if count:
        text = f"{count} single samples of the force stand out far on both sides and are left out of the figures"
        yield Finding("INDENT-SPIKES", text, "warning", hint="earth the shield, keep the cell's cable from the motor's")


def _untouched(without: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Say at which grid points nothing was met."""
    if without:
        places = ", ".join(f"{one['point']} at ({one['at_mm'][0]:g}, {one['at_mm'][1]:g}) mm" for one in without)
        yield Finding("INDENT-POINT-NO-CONTACT", f"no contact at point {places}: nothing measured there", "warning")


def _uncalibrated(bench: str) -> list[Finding]:
    return [
        Finding(
            "RIG-UNCALIBRATED",
            f"bench {bench} has no calibration: forces are the controller's, the frame's give is not removed",
            "warning",
            hint="fabctl rig calibrate force, then fabctl rig calibrate frame",
        )
    ]


def ask_rig(plan: IndentPlan, bench: Bench) -> None:
    """Raise `RefusedError` where the rig that answers, or how it was left, stands against the plan; nothing moves."""
    with contextlib.closing(open_indenter(bench.url("rig"), plan.registers)) as rig:
        _refuse_rig(plan, rig.identify())
        left = left_behind(rig.fresh_sample(), plan.method.safe_height_mm)
    if left:
        raise RefusedError("the rig is not ready for a test", left)


def _refuse_rig(plan: IndentPlan, identity: Identity) -> None:
    """Raise where the rig that answers cannot do what is planned, or is not the one a resumed run was begun on."""
    limits = plan.method.limits
    fastest = max(*(a.speed_mm_s for a in plan.actions), plan.method.travel_speed_mm_s)
    asked = (
        ("RIG-CAPACITY", "the force limit", limits.force_N, identity.capacity_N, "N", "lower limits.force_N"),
        ("RIG-TRAVEL", "the travel", limits.travel_mm, identity.travel_mm, "mm", "shorten limits.travel_mm"),
        ("RIG-SPEED", "the fastest step", fastest, identity.speed_max_mm_s, "mm/s", "slow it down"),
    )
    found = on_another_rig(plan.resumed, identity) if plan.resumed is not None else []
    for code, what, value, limit, unit, remedy in asked:
        if value > limit:
            text = f"{what}, {value:g} {unit}, is beyond the rig's {limit:g} {unit}"
            found.append(Finding(code, text, hint=f"{remedy} in the method", value=value, unit=unit, limit=limit))
    if found:
        raise RefusedError(f"{identity.model} cannot run method {plan.method.name}", found)


def _config(plan: IndentPlan, identity: Identity, air: Mapping[str, float], bench: BenchConfig) -> dict[str, Any]:
    """Return what is frozen into the run: method, plan, rig, calibration, and the conditions."""
    return {
        "method": plan.method.model_dump(mode="json"),
        "plan": [asdict(action) for action in plan.actions],
        "rig": {**asdict(identity), "map": plan.registers.name, "indenter_radius_mm": plan.rig.indenter_radius_mm},
        "bench": bench.model_dump(mode="json"),
        "simulated": bench.is_simulated,
        "sample_hz": plan.sample_hz,
        "calibration": plan.calibration.as_dict() if plan.calibration is not None else None,
        "conditions": {**air, **plan.conditions},
        "resumes": plan.resumed.run_id if plan.resumed is not None else None,
        "findings": [finding.as_dict() for finding in plan.findings],
    }


def _both(log: Callable[[Event], None], emit: Emit) -> Emit:
    """Return a listener for both; what only the screen wants is not logged."""

    def hear(event: Event) -> None:
        if event.kind != "progress":
            log(event)
        emit(event)

    return hear
