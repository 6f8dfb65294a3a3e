"""What is left of a plan after a run that was broken off, and what speaks against going on with it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Sequence

from design.findings import Finding
from drivers.rig.indenter import Identity
from fabctl.bench import begun_elsewhere
from fabctl.config.bench import BenchConfig
from fabctl.config.method import MethodConfig
from fabctl.indent.method import Action
from fabctl.records.folder import RunFolder, open_run, status_of
from fabctl.workspace import Workspace


def resumed(
    plan: Sequence[Action], done: Iterable[tuple[int, int]], untouched: Iterable[int] = ()
) -> tuple[Action, ...]:
    """Return what is left of a plan after the curves `done`, each (point, curve), and the points without contact.

    Whole curves only: one that was broken off is run again. Every point that is left begins with its tare and approach,
    so nothing is gone on with under an old zero.
    """
    finished, past = set(done), set(untouched)
    curves = {(a.point, a.curve) for a in plan if a.curve}
    left = {point for point, curve in curves - finished if point not in past}
    kept = [a for a in plan if a.point in left and not (a.curve and (a.point, a.curve) in finished)]
    return tuple(_without_idle_rests(kept))


def _without_idle_rests(plan: Sequence[Action]) -> list[Action]:
    """Drop rests that belonged to curves which are left out."""
    return [a for k, a in enumerate(plan) if not (a.kind == "hold" and not a.curve and plan[k - 1].kind != "unload")]


def curves_done(run: RunFolder) -> list[tuple[int, int]]:
    """Return (point, curve) of every curve that a run, or one that it went on with, finished, from their events."""
    return [(data["point"], data["curve"]) for link in _chain(run) for data in _told(link, "curve")]


def points_without_contact(run: RunFolder) -> list[int]:
    """Return the grid points at which a run, or one that it went on with, met nothing, from their events."""
    return [data["point"] for link in _chain(run) for data in _told(link, "no_contact")]


def _chain(run: RunFolder) -> Iterator[RunFolder]:
    """Yield a run, the one that it went on with, and so on back to the first."""
    seen = set()
    while run.run_id not in seen:
        yield run
        seen.add(run.run_id)
        before = run.manifest().get("config", {}).get("resumes")
        run = open_run(run.path.parent / str(before)) if before else run


def _told(run: RunFolder, kind: str) -> list[dict[str, int]]:
    found = []
    path = run.path / "events.jsonl"
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        with contextlib.suppress(ValueError, KeyError):  # a last line may be cut short
            event = json.loads(line)
            if event["kind"] == kind:
                found.append({"curve": 0, **event["data"]})
    return found


def against_resuming(
    lab: Workspace, run: RunFolder, specimen: str, method: MethodConfig, bench: BenchConfig
) -> list[Finding]:
    """Return what speaks against going on with `run`, as far as it is known before the rig is asked."""
    manifest = run.manifest()
    if manifest.get("kind") != "indent" or manifest.get("specimen") != specimen:
        return [Finding("RESUME-OTHER", f"{run.run_id} is not a test of {specimen}")]
    found = begun_elsewhere(run, bench)
    if manifest.get("config", {}).get("method") != method.model_dump(mode="json"):
        found.append(Finding("RESUME-METHOD", "the method has changed since", hint="run it from the beginning"))
    outcome = run.outcome()
    if outcome is not None and outcome["status"] == "done":
        found.append(Finding("RESUME-DONE", f"{run.run_id} came to its end"))
    return found + _gone_on_with(lab, run, specimen)


def _gone_on_with(lab: Workspace, run: RunFolder, specimen: str) -> list[Finding]:
    """Say which later runs went on with `run` already; one that pressed no curve to its end may be tried again."""
    return [
        Finding(
            "RESUME-TWICE",
            f"{run.run_id} has already been gone on with, in {later.run_id} ({status_of(later)})",
            hint=f"go on with that one: --resume {later.run_id}",
        )
        for later in lab.runs_of(specimen, "indent")
        if later.manifest().get("config", {}).get("resumes") == run.run_id
        and (_told(later, "curve") or _told(later, "no_contact") or status_of(later) == "running")
    ]


def on_another_rig(run: RunFolder, identity: Identity) -> list[Finding]:
    """Return what speaks against going on with `run` on the rig that answers: that it was begun on another one."""
    before = run.manifest().get("config", {}).get("rig") or {}
    there, here = (before.get("model"), before.get("serial")), (identity.model, identity.serial)
    if there in ((None, None), here):
        return []
    text = f"{run.run_id} was begun on {there[0]} no. {there[1]}, here answers {here[0]} no. {here[1]}"
    return [Finding("RESUME-RIG", text, hint="go on with that rig, or run it from the beginning")]
