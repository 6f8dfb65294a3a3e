"""The force curve on a specimen's page: measured against what the design foresaw."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from fabctl.indent.calibration import Calibration
from fabctl.indent.method import read_predicted
from fabctl.records.folder import RunFolder, status_of
from fabctl.records.words import is_simulated
from fabctl.reports.model import Fact, Figure, Step
from fabctl.reports.numbers import COVERAGE, fact, percent, plain, with_half

FIGURES = (
    ("stiffness_secant_N_mm", "secant stiffness", "N/mm"),
    ("stiffness_initial_N_mm", "initial stiffness", "N/mm"),
    ("force_max_N", "largest force", "N"),
    ("load_energy_mJ", "energy in", "mJ"),
    ("unload_energy_mJ", "energy back", "mJ"),
    ("hysteresis_ratio", "hysteresis", ""),
    ("recovery_ratio", "recovery of shape", ""),
)
HELD = (("relaxation_ratio", "relaxation", ""), ("creep_mm", "creep", "mm"))  # told only where a method holds


def indent_step(run: RunFolder, design: Path) -> Step:
    """Return the part about one indentation run."""
    manifest, result = run.manifest(), run.result() or {}
    config = manifest.get("config", {})
    method = config.get("method", {}).get("name", "?")
    predicted = design / "response.csv"
    curves = run.path / "artefacts" / "curves.csv"
    figures = (plot(curves, predicted if predicted.is_file() else None),) if curves.is_file() else ()
    outcome = run.outcome() or {}
    notes = tuple(f"{f['level']}: {f['message']}" for f in result.get("findings", []))
    if outcome.get("status") != "done" and outcome.get("message"):
        notes = (str(outcome["message"]), *notes)
    if outcome.get("status") == "done" and "curves" not in result:
        notes = (f"recorded, its figures are not computed: fabctl indent analyse {run.run_id}", *notes)
    summary = f"Method {method}, {_counted(run, result)}."
    return Step(
        "Indentation", status_of(run), summary, tuple(_facts(result, config, _started(manifest))), figures, notes,
        bool(is_simulated(manifest)),
    )  # fmt: skip


def _counted(run: RunFolder, result: Mapping[str, Any]) -> str:
    """Return how much was measured; of a run that was broken off, what its files hold."""
    if "curves_count" in result:
        return f"{result['curves_count']} curves that count, {result.get('rows_count', 0)} samples"
    samples = run.path / "samples.csv"
    count = max(0, samples.read_bytes().count(b"\n") - 1) if samples.is_file() else 0
    return f"{count} samples recorded, no figures computed"


def _facts(result: Mapping[str, Any], config: Mapping[str, Any], started: datetime | None) -> list[Fact]:
    found = []
    for key, label, unit in (*FIGURES, *(row for row in HELD if result.get(row[0]) is not None)):
        value = result.get(key)
        if value is None:
            reason = result.get("not_found", {}).get(key)
            found += [Fact(label, "not found", reason)] if reason else []
            continue
        spread = result.get(key.replace("_N_mm", "_ci95_N_mm")) if key.endswith("_N_mm") else None
        if unit == "":
            found.append(Fact(label, percent(value)))
        else:
            found.append(Fact(label, with_half(value, spread, unit), "95 % interval" if spread else ""))
    foreseen = result.get("predicted_secant_N_mm")
    if foreseen is not None:
        measured = result.get("stiffness_secant_N_mm")
        note = f"measured / predicted = {measured / foreseen:.2f}" if measured and foreseen else ""
        found.append(Fact("predicted secant stiffness", plain(foreseen, "N/mm"), note))
    rig = config.get("rig", {})
    found.append(
        Fact(
            "rig",
            f"{rig.get('model', '?')} no. {rig.get('serial', '?')}",
            f"{config.get('sample_hz', '?')} samples a second",
        )
    )
    found += _calibration_facts(config.get("calibration"), started)
    for name, value in (config.get("conditions") or {}).items():
        found.append(Fact(*fact(str(name), value)))
    return found


def _started(manifest: Mapping[str, Any]) -> datetime | None:
    try:
        return datetime.fromisoformat(str(manifest.get("started_utc")))
    except ValueError:
        return None


def _calibration_facts(known: Mapping[str, Any] | None, started: datetime | None) -> list[Fact]:
    """Return both calibrations with their uncertainty (k = 2) and date, flagged where the run began after it."""
    if known is None:
        return [Fact("calibration", "none", "forces as the controller shows them, the frame's give not taken off")]
    calibration = Calibration.model_construct(**known)  # as the run had it, whatever is asked of one today
    pairs: tuple[tuple[str, Literal["force", "frame"], float | None, float | None, str], ...] = (
        ("load cell's gain", "force", calibration.gain_ratio, calibration.gain_se_ratio, ""),
        ("frame's give", "frame", calibration.compliance_mm_N, calibration.compliance_se_mm_N, "mm/N"),
    )
    found = []
    for label, word, value, se, unit in pairs:
        ends = calibration.ends(word)
        if value is None or ends is None:
            found.append(Fact(label, "not calibrated"))
            continue
        past = started is not None and started > ends
        note = f"PAST ITS DATE: ended on {ends.date()}" if past else f"valid to {ends.date()}"
        found.append(Fact(label, with_half(value, COVERAGE * (se or 0.0), unit), note))
    return found


def plot(curves: Path, predicted: Path | None) -> Figure:
    """Return all curves of a run with the predicted one behind them, as SVG in the page."""
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(6.2, 3.9), layout="constrained")
    axes = canvas.add_subplot()
    deepest_mm = 0.0
    for (_, branch), (depth, force) in _branches(curves).items():
        axes.plot(
            depth, force, color="#0b6e99", lw=1.0 if branch == "load" else 0.8, ls="-" if branch == "load" else "--"
        )
        deepest_mm = max(deepest_mm, *depth)
    axes.plot([], [], color="#0b6e99", label="measured (dashed: unloading)")
    if predicted is not None:
        foreseen = read_predicted(predicted)
        shown = foreseen.depth_mm <= deepest_mm * 1.05
        axes.plot(
            foreseen.depth_mm[shown], foreseen.load_N[shown], color="#c8502d", lw=1.6, alpha=0.8, label="predicted"
        )
    axes.set_xlabel("displacement from contact [mm]")
    axes.set_ylabel("force [N]")
    axes.axhline(0, color="#999999", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    return Figure(
        as_svg(canvas),
        "Force against displacement from contact. The tare is taken off, and the frame's give where it was calibrated.",
        True,
    )


def as_svg(canvas: Any, dpi: float = 100.0) -> str:
    """Return a matplotlib figure as an `<svg>` element whose ids no other figure of the page shares."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "fabctl", "svg.fonttype": "path"}):
        canvas.savefig(stream, format="svg", dpi=dpi, metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    return re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.S)


def _branches(curves: Path) -> dict[tuple[str, str], tuple[list[float], list[float]]]:
    found: dict[tuple[str, str], tuple[list[float], list[float]]] = {}
    with curves.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            depth, force = found.setdefault((f"{row['point']}.{row['curve']}", row["branch"]), ([], []))
            depth.append(float(row["depth_mm"]))
            force.append(float(row["force_N"]))
    return found
