"""From a run's `samples.csv` to its figures, its curve as a table, and its picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fabctl.errors import RecordError, UsageError
from fabctl.indent.curve import CurveResult, Snap, Strokes, Valued, analyse_curve
from fabctl.indent.recorder import COLUMNS
from fabctl.records.folder import RunFolder, status_of

Reals = NDArray[np.float64]
SUMMARY = (
    "stiffness_initial_N_mm",
    "stiffness_secant_N_mm",
    "stiffness_tangent_max_N_mm",
    "force_max_N",
    "peak_N",
    "peak_depth_mm",
    "valley_N",
    "valley_depth_mm",
    "load_energy_mJ",
    "unload_energy_mJ",
    "hysteresis_ratio",
    "barrier_mJ",
    "relaxation_ratio",
    "creep_mm",
    "creep_ratio",
    "residual_mm",
    "recovery_ratio",
)


@dataclass(frozen=True, slots=True)
class Samples:
    """The columns of `samples.csv`; every array has one entry per row, in the order they came."""

    time_s: Reals
    position_mm: Reals
    force_N: Reals
    step: NDArray[np.str_]
    point: NDArray[np.int64]
    curve: NDArray[np.int64]
    left_out: tuple[int, ...] = ()  # lines of the file that hold no sample


@dataclass(frozen=True, slots=True)
class Numbered:
    """One curve's result with the number of its point and its own."""

    point: int
    curve: int
    result: CurveResult


def samples_of(run: RunFolder) -> Path:
    """Return where a run's samples lie; raise `UsageError` where it is none that has any, and say what it is."""
    kind, path = run.manifest().get("kind"), run.path / "samples.csv"
    if kind not in ("indent", "calibrate"):
        raise UsageError(f"{run.run_id}: not an indentation but a {kind}; `fabctl run list --kind indent` names those")
    if not path.is_file():
        raise UsageError(f"{run.run_id}: holds no samples, nothing was pressed ({status_of(run)})")
    return path


def read_samples(path: Path) -> Samples:
    """Return the rows of a `samples.csv`; a last line that a kill cut short is left out, others that are none told."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as fault:
        raise RecordError(f"{path}: {fault.strerror or fault}") from fault
    lines = text.splitlines()
    if not lines or lines[0] != ",".join(COLUMNS):
        raise RecordError(f"{path}: not a table of samples ({','.join(COLUMNS)})")
    if not text.endswith("\n"):
        lines.pop()
    found = [_sample(line) for line in lines[1:]]
    left_out = tuple(number for number, sample in enumerate(found, 2) if sample is None)
    rows = [sample for sample in found if sample is not None]
    return Samples(
        time_s=np.array([row[0] for row in rows], dtype=np.float64),
        position_mm=np.array([row[1] for row in rows], dtype=np.float64),
        force_N=np.array([row[2] for row in rows], dtype=np.float64),
        step=np.array([row[3] for row in rows], dtype=np.str_),
        point=np.array([row[4] for row in rows], dtype=np.int64),
        curve=np.array([row[5] for row in rows], dtype=np.int64),
        left_out=left_out,
    )


def _sample(line: str) -> tuple[float, float, float, str, int, int] | None:
    """Return time, position, force, step, point and curve of one row; None where the row is damaged."""
    cells = line.split(",")
    try:
        row = dict(zip(COLUMNS, cells, strict=True))
        numbers = float(row["time_s"]), float(row["position_mm"]), float(row["force_N"])
        if all(map(math.isfinite, numbers)):
            return *numbers, row["step"], int(row["point"]), int(row["curve"])
    except ValueError:
        pass
    return None


def strokes_of(samples: Samples) -> list[tuple[int, int, Strokes]]:
    """Return every curve of the run that has a loading: (point, curve, strokes)."""
    found = []
    keys = sorted({(int(p), int(c)) for p, c in zip(samples.point, samples.curve, strict=True) if c > 0})
    for point, curve in keys:
        own = (samples.point == point) & (samples.curve == curve)
        load, unload, hold = (own & (samples.step == step) for step in ("load", "unload", "hold"))
        if load.sum() < 10:
            continue
        if unload.any():
            hold &= np.arange(len(hold)) < np.flatnonzero(unload)[0]  # a rest afterwards holds nothing
        zeroed = np.flatnonzero((samples.point == point) & (samples.step == "zero"))
        zeroed = zeroed[zeroed < np.flatnonzero(load)[0]]
        found.append(
            (
                point,
                curve,
                Strokes(
                    samples.position_mm[load],
                    samples.force_N[load],
                    samples.position_mm[unload],
                    samples.force_N[unload],
                    samples.time_s[hold],
                    samples.force_N[hold],
                    float(samples.position_mm[zeroed[-1]]) if len(zeroed) else None,
                    float(samples.force_N[zeroed[-1]]) if len(zeroed) else 0.0,
                    samples.position_mm[hold],
                ),
            )
        )
    return found


def analyse(samples: Samples, compliance_mm_N: float, secant_mm: float, gain_ratio: float = 1.0) -> list[Numbered]:
    """Return the result of every curve; forces are divided by the load cell's `gain_ratio` first."""
    true = Samples(
        samples.time_s, samples.position_mm, samples.force_N / gain_ratio, samples.step, samples.point, samples.curve
    )
    return [
        Numbered(point, curve, analyse_curve(strokes, compliance_mm_N, secant_mm))
        for point, curve, strokes in strokes_of(true)
    ]


def summarised(found: Sequence[Numbered], conditioning: Sequence[tuple[int, int]] = ()) -> dict[str, Any]:
    """Return the figures of a run as plain JSON: each curve's own, and the median of the curves that count.

    Curves that only worked the rubber in (`conditioning`, as (point, curve)) are listed and do not count.
    """
    skipped = set(conditioning)
    counted = [n for n in found if (n.point, n.curve) not in skipped]
    body: dict[str, Any] = {
        "curves": [{**_one(n), "conditioning": (n.point, n.curve) in skipped} for n in found],
        "curves_count": len(counted),
    }
    for name in SUMMARY:
        values = [v for n in counted if (v := _number(getattr(n.result, name))) is not None]
        body[name] = float(np.median(values)) if values else None
        if not values and counted:
            body.setdefault("not_found", {})[name] = counted[-1].result.reasons.get(name, "no contact was found")
    intervals = [r.ci95 for n in counted if (r := n.result.stiffness_secant_N_mm) is not None]
    body["stiffness_secant_ci95_N_mm"] = float(np.median(intervals)) if intervals else None
    return body


def _one(numbered: Numbered) -> dict[str, Any]:
    result, contact = numbered.result, numbered.result.contact
    body: dict[str, Any] = {
        "point": numbered.point,
        "curve": numbered.curve,
        "contact_mm": contact.position_mm,
        "contact_se_mm": contact.se_mm,
        "counted_from": contact.kind,
        "contact_spread_mm": contact.spread_mm,
        "contact_others_mm": dict(contact.others_mm),
        "noise_N": contact.noise_N,
        "drift_N_mm": contact.drift_N_mm,
        "drift_N_mm2": contact.drift_N_mm2,
        "spikes_count": result.spikes_count,
        "depth_max_mm": result.depth_max_mm,
        "not_found": dict(result.reasons),
    }
    for name in SUMMARY:
        value = getattr(result, name)
        body[name] = _number(value)
        if isinstance(value, Valued):
            body[name.replace("_N_mm", "_ci95_N_mm")] = value.ci95
    for name in ("snap_through", "snap_back"):
        snap = getattr(result, name)
        if isinstance(snap, Snap):
            body[f"{name}_depth_mm"], body[f"{name}_N"] = snap.depth_mm, snap.fall_N
    return body


def _number(value: object) -> float | None:
    if isinstance(value, Valued):
        return value.value
    return float(value) if isinstance(value, float | int) else None


def write_curves(path: Path, found: Sequence[Numbered]) -> None:
    """Write every curve as depth and force, the frame's give and the tare taken off."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["point", "curve", "branch", "depth_mm", "force_N"])
        for n in found:
            branches = (
                ("load", n.result.depth_mm, n.result.load_N),
                ("unload", n.result.unload_depth_mm, n.result.unload_N),
            )
            for branch, depth, force in branches:
                for d, f in zip(depth, force, strict=True):
                    table.writerow([n.point, n.curve, branch, f"{d:.4f}", f"{f:.5f}"])


def conditioning_curves(manifest: Mapping[str, Any]) -> list[tuple[int, int]]:
    """Return (point, curve) of the curves that only worked the rubber in."""
    plan = manifest.get("config", {}).get("plan", [])
    return sorted({(a["point"], a["curve"]) for a in plan if a.get("condition") and a.get("curve")})


def summarise_run(run: RunFolder) -> dict[str, Any]:
    """Analyse a run from its record, write its table and pictures, and return its figures."""
    config = run.manifest().get("config", {})
    calibration = config.get("calibration") or {}
    compliance = float(calibration.get("compliance_mm_N") or 0.0)
    gain = float(calibration.get("gain_ratio") or 1.0)
    secant = float(config.get("method", {}).get("secant_mm", 2.0))
    samples = read_samples(samples_of(run))
    found = analyse(samples, compliance, secant, gain)
    conditioning = conditioning_curves(run.manifest())
    body = summarised(found, conditioning)
    body["lines_left_out"] = list(samples.left_out)
    body |= {"compliance_mm_N": compliance, "gain_ratio": gain, "secant_mm": secant}
    write_curves(run.artefact("curves.csv"), found)
    counted = [n for n in found if (n.point, n.curve) not in set(conditioning)]
    from fabctl.indent.plot import draw_curves

    if draw_curves({run.manifest().get("specimen") or run.run_id: counted}, run.artefact("curve.svg")):
        body["picture"] = "artefacts/curve.svg"
    return body
