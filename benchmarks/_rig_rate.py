"""How evenly samples come while a run records them durably."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

import numpy as np

from drivers.clock import WallClock
from drivers.rig.indenter import open_indenter
from fabctl.config.method import Hold, LimitsConfig, MethodConfig
from fabctl.config.rig import load_rig
from fabctl.indent.method import Action
from fabctl.indent.recorder import Recorder
from fabctl.indent.run import Runner
from fabctl.priority import before_other_work

ROOT = Path(__file__).resolve().parents[1]
WINDOW_S = 0.005


def slots_met_frac(folder: Path, serial: bool, rate_hz: float, duration_s: float) -> tuple[float, float]:
    """Return (share of slots with a new sequence number within ± 5 ms, jitter p99 in ms) of a recorded hold."""
    where = ["--rtu", str(folder / "rig")] if serial else ["--tcp", "0"]
    command = [sys.executable, "-m", "simulators", "rig", *where, "--specimen", "linear"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    try:
        url = process.stdout.readline().split()[1]
        method = MethodConfig(
            name="rate",
            limits=LimitsConfig(force_N=5.0, travel_mm=50.0),
            steps=(Hold(step="hold", time_s=duration_s),),
        )
        plan = (Action("hold", time_s=duration_s),)
        with (
            contextlib.closing(open_indenter(url, load_rig("reference", ROOT))) as rig,
            before_other_work(),
            contextlib.closing(Recorder(folder / "samples.csv")) as recorder,
        ):
            Runner(rig, method, plan, recorder, WallClock(), rate_hz).execute()
    finally:
        process.terminate()
        process.wait(timeout=10)
        process.stdout.close()
    rows = [line.split(",") for line in (folder / "samples.csv").read_text().splitlines()[1:]]
    times_s = np.array([int(row[1]) / 1000 for row in rows if row[5] == "hold"])
    return _even(times_s, 1.0 / rate_hz)


def _even(times_s: np.ndarray[tuple[int], np.dtype[np.float64]], slot_s: float) -> tuple[float, float]:
    """Lay the grid of slots through the samples' median phase, and look for a sample of its own near each slot."""
    turns = np.exp(2j * np.pi * times_s / slot_s)
    phase_s = float(np.angle(np.mean(turns))) / (2 * np.pi) * slot_s
    grid = np.arange(np.ceil((times_s[0] - phase_s) / slot_s), np.floor((times_s[-1] - phase_s) / slot_s) + 1)
    nearest = np.round((times_s - phase_s) / slot_s)
    off_s = np.abs(times_s - (nearest * slot_s + phase_s))
    met = set(nearest[off_s <= WINDOW_S + 5e-4].astype(int))  # half a tick: the sequence counts whole ones
    return len(met & set(grid.astype(int))) / len(grid), 1000 * float(np.quantile(off_s, 0.99))
