"""Measure the rig itself: the load cell against known masses, the frame against a rigid block."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivers.clock import Clock, WallClock
from drivers.rig.indenter import Indenter
from fabctl.config.bench import BenchConfig, RigConfig
from fabctl.config.method import Approach, Cycles, LimitsConfig, MethodConfig, Tare
from fabctl.errors import FabctlError
from fabctl.events import Emit, Event
from fabctl.indent.analysis import read_samples, strokes_of
from fabctl.indent.calibration import (
    GRAVITY_N_KG,
    VALID_DAYS,
    Calibration,
    fit_line,
    load_calibration,
    save_calibration,
)
from fabctl.indent.method import actions
from fabctl.indent.recorder import Recorder
from fabctl.indent.run import Runner
from fabctl.records.ending import outcome_kept
from fabctl.records.folder import RunFolder, start_run

MASS_TOLERANCE_RATIO = 5e-5  # OIML class M1 from 100 g on, as a standard uncertainty
SETTLE_S = 0.5
READ_S = 2.0
GIVES_MM = 3.0  # no frame that is of use gives so much under a calibration's force
LOW_FRAC = 0.25  # below a quarter of the load a block is not yet well seated


class CalibrationRefused(FabctlError):
    """The readings do not make a calibration."""


def read_masses(
    rig: Indenter, masses_kg: Sequence[float], put_on: Callable[[float], None], clock: Clock, emit: Emit
) -> list[dict[str, float]]:
    """Return what the cell shows under each mass; nothing moves."""
    found = []
    for mass_kg in masses_kg:
        put_on(mass_kg)
        clock.sleep(SETTLE_S)
        forces = []
        until_s = clock.now_s() + READ_S
        while clock.now_s() < until_s:
            forces.append(rig.fresh_sample().force_N)
            clock.sleep(0.01)
        shown_N, noise_N = float(np.mean(forces)), float(np.std(forces, ddof=1))
        emit(Event("state", f"{1000 * mass_kg:8.1f} g  {shown_N:9.4f} N  (noise {1000 * noise_N:.1f} mN)"))
        found.append({"mass_kg": mass_kg, "true_N": mass_kg * GRAVITY_N_KG, "shown_N": shown_N, "noise_N": noise_N})
    return found


def force_result(readings: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return gain and zero with standard uncertainties, from readings under at least three masses."""
    if len({reading["mass_kg"] for reading in readings}) < 3:
        raise CalibrationRefused("give at least three different masses; 0 counts as one")
    line = fit_line([r["true_N"] for r in readings], [r["shown_N"] for r in readings])
    if not 0.5 < line.slope < 2:
        raise CalibrationRefused(
            f"the cell shows {line.slope:.3f} N for each true newton; were the masses those that were named?"
        )
    return {
        "gain_ratio": line.slope,
        "gain_se_ratio": float(np.hypot(line.slope_se, line.slope * MASS_TOLERANCE_RATIO)),
        "zero_N": line.offset,
        "zero_se_N": line.offset_se,
        "scatter_N": line.scatter,
        "readings": [dict(reading) for reading in readings],
    }


def frame_method(rig: RigConfig, force_N: float) -> MethodConfig:
    """Return the method that presses a rigid block."""
    return MethodConfig(
        name="frame",
        description="Press a rigid block: what gives way is the frame",
        limits=LimitsConfig(
            force_N=min(rig.force_limit_N, 1.3 * force_N + 1.0), travel_mm=rig.travel_mm, watchdog_s=1.0
        ),
        steps=(
            Tare(step="tare", time_s=1.0),
            Approach(step="approach", speed_mm_s=0.5, trigger_N=0.1, clearance_mm=0.1),
            Cycles(step="cycles", cycles_count=3, force_N=force_N, speed_mm_s=0.1),
        ),
    )


def frame_result(samples: Path, gain_ratio: float, block_mm_N: float = 0.0) -> dict[str, Any]:
    """Return the frame's compliance: the slope of position over true force, less what the block itself gives."""
    slopes, most_N = [], 0.0
    for _, _, strokes in strokes_of(read_samples(samples)):
        force = strokes.load_N / gain_ratio
        most_N = max(most_N, float(force.max()))
        seated = force > LOW_FRAC * most_N
        if seated.sum() >= 10:
            slopes.append(fit_line(list(force[seated]), list(strokes.load_position_mm[seated])).slope)
    if len(slopes) < 2:
        raise CalibrationRefused("too few samples under load; press slower or with more force")
    compliance = float(np.mean(slopes)) - block_mm_N
    if compliance < 0:
        raise CalibrationRefused(
            f"all that gives way is {compliance + block_mm_N:.5f} mm/N, the block alone is said to give "
            f"{block_mm_N:g} mm/N; check --block-mm-N"
        )
    if compliance * most_N > GIVES_MM:
        gives = f"{compliance * most_N:.1f} mm under {most_N:.1f} N"
        raise CalibrationRefused(f"what was pressed gives {gives}: is it a rigid block, and not a specimen?")
    return {
        "compliance_mm_N": compliance,
        "compliance_se_mm_N": float(np.std(slopes, ddof=1) / np.sqrt(len(slopes))),
        "curves_count": len(slopes),
        "block_mm_N": block_mm_N,
    }


def calibrate_force(
    lab: Path,
    bench: BenchConfig,
    rig: Indenter,
    masses_kg: Sequence[float],
    put_on: Callable[[float], None],
    emit: Emit,
    valid_days_count: int = VALID_DAYS,
    clock: Clock | None = None,
) -> tuple[RunFolder, dict[str, Any]]:
    """Calibrate the load cell, keep the record, and make it the bench's current one."""
    before = load_calibration(lab, bench.name) or Calibration()
    asked = {"what": "force", "masses_kg": list(masses_kg), "bench": bench.model_dump(mode="json")}
    run = start_run(lab / "runs", "calibrate", config=asked)
    with outcome_kept(run):
        body = force_result(read_masses(rig, masses_kg, put_on, clock or WallClock(), emit))
        run.write_result(body)
        run.finish("done")
    found = {name: body[name] for name in ("gain_ratio", "gain_se_ratio")}
    save_calibration(lab, bench.name, before.model_copy(update=found | _since(run, "force", valid_days_count)))
    return run, body


def calibrate_frame(
    lab: Path,
    bench: BenchConfig,
    rig: Indenter,
    config: RigConfig,
    force_N: float,
    emit: Emit,
    block_mm_N: float = 0.0,
    valid_days_count: int = VALID_DAYS,
    clock: Clock | None = None,
) -> tuple[RunFolder, dict[str, Any]]:
    """Press a rigid block, keep the record, and make its compliance the bench's current one."""
    before = load_calibration(lab, bench.name) or Calibration()
    method = frame_method(config, force_N)
    asked = {"what": "frame", "method": method.model_dump(), "bench": bench.model_dump(mode="json")}
    run = start_run(lab / "runs", "calibrate", config=asked)
    with outcome_kept(run):
        with contextlib.closing(Recorder(run.path / "samples.csv")) as recorder:
            Runner(rig, method, actions(method), recorder, clock or WallClock(), config.sample_hz, emit).execute()
        body = frame_result(run.path / "samples.csv", before.gain_ratio or 1.0, block_mm_N)
        run.write_result(body)
        run.finish("done")
    found = {name: body[name] for name in ("compliance_mm_N", "compliance_se_mm_N")}
    save_calibration(lab, bench.name, before.model_copy(update=found | _since(run, "frame", valid_days_count)))
    return run, body


def _since(run: RunFolder, what: str, valid_days_count: int) -> dict[str, Any]:
    """Return from which run, and for how long, the bench's calibration of `what` holds."""
    now = datetime.now(UTC).isoformat()
    return {f"{what}_run": run.run_id, f"{what}_utc": now, f"{what}_valid_days_count": valid_days_count}


def hang_in_slot(slot: Path, mass_kg: float) -> None:
    """Lay a mass on the cell of a bench that has a slot, as a person would."""
    path = slot / "mass_kg.txt"
    if mass_kg == 0:
        path.unlink(missing_ok=True)
    else:
        draft = slot / ".mass_kg.new"
        draft.write_text(f"{mass_kg!r}\n", encoding="utf-8")
        draft.replace(path)


def block_in_slot(slot: Path, stiffness_N_mm: float = 20000.0) -> None:
    """Lay a steel block on a bench that has a slot."""
    rows = "".join(f"{d:.3f},{stiffness_N_mm * d:.6g},{stiffness_N_mm * d:.6g}\n" for d in (0.0, 0.5, 1.0))
    head = "# fabctl response 1; indenter_radius_mm=8; point_mm=0,0,0; direction=0,0,-1\ndepth_mm,load_N,unload_N\n"
    draft = slot / ".response.csv.new"
    draft.write_text(head + rows, encoding="utf-8")
    draft.replace(slot / "response.csv")
