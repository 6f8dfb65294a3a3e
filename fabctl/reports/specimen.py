"""Everything known of one specimen as one page: verdict first, then each room, then where it all came from."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fabctl.coupon import KIND as READING
from fabctl.records.folder import RunFolder, sha256, status_of
from fabctl.records.words import is_simulated
from fabctl.reports.coupon_step import coupon_step, coupon_verdict
from fabctl.reports.design_step import cut_step, design_step
from fabctl.reports.indent_step import indent_step
from fabctl.reports.model import Fact, Provenance, Report, Step, Word
from fabctl.reports.numbers import clock, percent
from fabctl.reports.scan import TITLE, scan_step
from fabctl.reports.view3d import script
from fabctl.workspace import Specimen, Workspace

WITHIN = "area within ± 1.00 % of the diagonal"


def specimen_report(lab: Workspace, specimen: Specimen) -> Report:
    """Return the page about `specimen` from its records; what was not done is named as missing."""
    runs = lab.runs_of(specimen.name)
    latest = telling(runs)
    steps = [design_step(specimen.design)]
    steps += [cut_step(latest["cut"])] if "cut" in latest else []
    steps += [indent_step(latest["indent"], specimen.design)] if "indent" in latest else []
    steps += [scan_step(latest["scan"])] if "scan" in latest else []
    steps += [coupon_step(latest[READING])] if READING in latest else []
    if specimen.is_coupon:
        word, sentence, reasons = coupon_verdict(latest.get(READING), latest.get("cut"))
    else:
        word, sentence, reasons = verdict(latest)
    if made_up := simulated(latest):
        sentence = f"{sentence} Simulated, on no real device: {', '.join(made_up)}."
    record = specimen.record()
    name = _design_name(specimen)
    return Report(
        title=f"Specimen {specimen.name} · {name}",
        subtitle=f"Specimen made {clock(str(record['made_utc']))}",
        word=word,
        sentence=sentence,
        reasons=tuple(reasons),
        key_facts=tuple(_keys(steps, latest)),
        steps=tuple(steps),
        provenance=tuple(_provenance(specimen, runs)),
        versions=tuple(_versions(runs)),
        made=clock(datetime.now(UTC).isoformat()),
        head=script() if "scan" in latest else "",
    )


def telling(runs: Sequence[RunFolder]) -> dict[str, RunFolder]:
    """Return the run that speaks for each kind: the latest that was done, else the latest there is.

    A later attempt that failed takes nothing away from an earlier result; it stands in the provenance.
    """
    found: dict[str, RunFolder] = {}
    for run in runs:  # oldest first
        kind, status = str(run.manifest()["kind"]), status_of(run)
        if status == "done" or (status != "running" and (kind not in found or status_of(found[kind]) != "done")):
            found[kind] = run
    return found


def verdict(latest: dict[str, RunFolder]) -> tuple[Word, str, list[str]]:
    """Return pass, fail or incomplete, one sentence, and the reasons against a pass."""
    missing = [kind for kind in ("cut", "indent", "scan") if kind not in latest]
    broken = [
        f"{kind}: {status_of(run)}: {(run.outcome() or {}).get('message', 'nothing says how it ended')}"
        for kind, run in latest.items()
        if kind in ("cut", "indent", "scan") and status_of(run) != "done"
    ]
    scan = (latest["scan"].result() or {}) if "scan" in latest else {}
    deviation = scan.get("deviation")
    if missing or broken or deviation is None:
        reasons = [f"{kind}: not done yet" for kind in missing] + broken
        return "incomplete", "Not every step has a result.", reasons
    size = f"RMS deviation {deviation['rms_mm']:.2f} mm, {percent(deviation['rms_frac'], 2)} of the diagonal"
    tolerance = scan.get("tolerance_frac")
    if tolerance is None:
        advice = "compare again with `fabctl scan run … --tolerance-frac 0.02`, say, for a pass or a fail"
        return "incomplete", f"{size}; no tolerance was given to hold it against.", [advice]
    asked = percent(scan["share_within_required_frac"], 0)
    share = f"{asked} of the area must lie within ± {percent(tolerance, 2)} of the diagonal"
    if (within := scan.get("within_tolerance_frac")) is not None:
        share += f"; {percent(within)} does"
    if scan.get("verdict") == "pass":
        return "pass", f"{size}; within tolerance.", [share]
    if scan.get("verdict") == "fail":
        return "fail", f"{size}; out of tolerance.", [share]
    return "incomplete", f"{size}; the scan leaves the verdict open.", [f["message"] for f in scan.get("findings", [])]


def simulated(latest: dict[str, RunFolder]) -> list[str]:
    """Return the kinds whose telling run was made on a simulated bench, in the order of the work."""
    return [kind for kind in ("cut", "indent", "scan") if kind in latest and is_simulated(latest[kind].manifest())]


def _keys(steps: Sequence[Step], latest: dict[str, RunFolder]) -> Iterator[Fact]:
    facts = {(step.title, fact.label): fact for step in steps for fact in step.facts}
    wanted = (
        (TITLE, "RMS", "RMS deviation"),
        (TITLE, WITHIN, WITHIN),
        ("Indentation", "secant stiffness", "secant stiffness"),
        ("Indentation", "largest force", "largest force"),
        ("Design", "cells", "cells"),
    )
    yield from (replace(facts[title, label], label=told) for title, label, told in wanted if (title, label) in facts)


def _provenance(specimen: Specimen, runs: Sequence[RunFolder]) -> Iterator[Provenance]:
    when = clock(str(specimen.record()["made_utc"]))
    for path in sorted(p for p in specimen.design.iterdir() if p.is_file()):
        yield Provenance("design", path.name, when, sha256(path), "")
    for run in runs:
        manifest = run.manifest()
        began = clock(str(manifest["started_utc"]))
        kind, detail = str(manifest["kind"]), f"{status_of(run)}, {manifest['operator']}"
        yield Provenance(kind, run.run_id, began, sha256(run.path / "manifest.json"), detail)
        outside = [item for item in manifest["inputs"] if Path(item["path"]).parent != specimen.design]
        for item in outside:
            yield Provenance("input", Path(item["path"]).name, began, str(item["sha256"]), "")


def _versions(runs: Sequence[RunFolder]) -> Iterator[Fact]:
    found: dict[str, Any] = runs[-1].manifest()["versions"] if runs else {}
    yield from (Fact(name, str(value)) for name, value in found.items())


def _design_name(specimen: Specimen) -> str:
    manifest = specimen.design / "manifest.json"
    found = json.loads(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
    return str(found.get("name") or Path(str(specimen.record()["design"])).name)
