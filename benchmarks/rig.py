"""The rig room's figures: `python -m benchmarks rig [faults motion kill rate bistable caps shipped] [--quick]`."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import Figure
from benchmarks._rig_caps import caps, shipped
from benchmarks._rig_kill import kill_while_loading
from benchmarks._rig_lines import move_through_faults, read_naively, read_through_faults
from benchmarks._rig_memory import method, press
from benchmarks._rig_rate import slots_met_frac
from simulators.rig.controller import Machine
from simulators.specimens.analytic import bistable


def measure(words: list[str]) -> list[Figure]:
    """Measure the named parts, or all."""
    quick = "--quick" in words
    asked = [word for word in words if not word.startswith("-")] or list(PARTS)
    found: list[Figure] = []
    for name in asked:
        began_s = time.monotonic()
        found += PARTS[name](quick)
        print(f"{name}: {time.monotonic() - began_s:.0f} s", file=sys.stderr)
    return found


def faults(quick: bool) -> list[Figure]:
    """Ten thousand injected faults, half of them on each line; a naive client on a tenth as many."""
    each = 150 if quick else 5000
    wrong = injected = believed = naive = naive_injected = 0
    for serial in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            found = read_through_faults(Path(folder), serial, each, seed=11)
            plain = read_naively(Path(folder), serial, each // 10, seed=11)
        wrong, injected, believed = (
            wrong + found.wrong_count,
            injected + found.injected_count,
            believed + found.believed_count,
        )
        naive, naive_injected = naive + plain.wrong_count, naive_injected + plain.injected_count
    return [
        Figure("faults injected into reading", injected, "", "10,000 injected faults", injected >= 10_000, injected),
        Figure("wrong samples believed by the driver", wrong, "", "no wrong sample", wrong == 0, believed),
        Figure(
            "wrong samples of a naive client",
            naive,
            "",
            "a naive client does get wrong ones",
            naive > 0,
            naive_injected,
        ),
    ]


def motion(quick: bool) -> list[Figure]:
    """Motion commands over a line that loses, delays and garbles."""
    each = 30 if quick else 400
    broken: list[str] = []
    commands = confirmed = unknown = 0
    for serial in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            found = move_through_faults(Path(folder), serial, each, seed=12)
        broken += found.broken
        commands += found.commands_count
        confirmed += found.confirmed_count
        unknown += found.unknown_count
    target = "every command executed exactly once or reported as unknown and stopped"
    return [
        Figure("motion commands not executed exactly once nor reported", len(broken), "", target, not broken, commands),
        Figure("motion commands confirmed", confirmed, "", "", None, commands),
        Figure("motion commands reported as unknown, stage stopped", unknown, "", "", None, commands),
    ]


def kill(quick: bool) -> list[Figure]:
    """SIGKILL of the loading host."""
    with tempfile.TemporaryDirectory() as folder:
        found = kill_while_loading(Path(folder), 3 if quick else 50)
    worst_ms, most_N = max(found.stop_ms, default=float("inf")), max(found.overshoot_N)
    count = found.kills_count
    return [
        Figure(
            "kills after which the watchdog had stopped the stage",
            count - found.not_stopped_count,
            "",
            "50",
            found.not_stopped_count == 0,
            count,
        ),
        Figure("last feed to stop, worst", worst_ms, "ms", "watchdog (200 ms) + 50 ms", worst_ms <= 250, count),
        Figure(
            "acknowledged rows lost",
            found.rows_lost_count,
            "",
            "every acknowledged row kept",
            found.rows_lost_count == 0,
            count,
        ),
        Figure(
            "overshoot of force, worst",
            round(most_N, 4),
            "N",
            f"<= speed x stiffness x latency = {found.overshoot_allowed_N:g} N",
            most_N <= found.overshoot_allowed_N,
            count,
        ),
    ]


def rate(quick: bool) -> list[Figure]:
    """Slots that hold a new sequence number within ± 5 ms, recorded durably."""
    found = []
    for serial, hz, name in ((False, 100.0, "100 Hz over TCP"), (True, 50.0, "50 Hz over RTU at 115200")):
        with tempfile.TemporaryDirectory() as folder:
            share, jitter_ms = slots_met_frac(Path(folder), serial, hz, 5.0 if quick else 60.0)
        target = ">= 99 % of the slots within +-5 ms"
        found.append(
            Figure(
                f"slots met, {name}", round(100 * share, 2), "%", target, share >= 0.99, int(hz * (5 if quick else 60))
            )
        )
        found.append(Figure(f"jitter p99, {name}", round(jitter_ms, 2), "ms", "", None, int(hz * (5 if quick else 60))))
    return found


def bistable_closed_form(quick: bool) -> list[Figure]:
    """A cubic whose extrema, zero and barrier are known, through rig and analysis."""
    peak_mm, valley_mm, scale = 2.5, 9.0, 0.02
    curves = bistable(peak_mm, valley_mm, scale)
    speed, hz = 1.0, 100.0
    machine = Machine(noise_N=0.01, contact_mm=2.0, parked_mm=0.2, compliance_mm_N=0.02, backlash_mm=0.0)
    peak_err, valley_err, barrier_err = [], [], []
    zero_mm = _first_zero(peak_mm, valley_mm)
    truth_mJ = _work(peak_mm, valley_mm, scale, zero_mm) if zero_mm is not None else None
    for seed in range(3 if quick else 20):
        result = press(curves, machine, method(11.0, speed), seed, hz)[0][0].result
        peak_err.append(abs((result.peak_depth_mm or 99) - peak_mm))
        if result.valley_depth_mm is not None:
            valley_err.append(abs(result.valley_depth_mm - valley_mm))
        if truth_mJ is not None and result.barrier_mJ is not None:
            barrier_err.append(abs(result.barrier_mJ / truth_mJ - 1))
    sample_mm = speed / hz
    n = len(peak_err)
    median_mm, worst_mm = float(np.median(peak_err)), float(max(peak_err))
    barrier = 100 * float(max(barrier_err)) if len(barrier_err) == n else None
    return [
        Figure(
            "bistable: peak off, worst",
            round(worst_mm, 4),
            "mm",
            f"within one sample ({sample_mm:g} mm)",
            worst_mm <= sample_mm,
            n,
        ),
        Figure("bistable: peak off, median", round(median_mm, 4), "mm", "", None, n),
        Figure(
            "bistable: barrier off, worst",
            None if barrier is None else round(barrier, 3),
            "%",
            "within 1 %",
            barrier is not None and barrier <= 1,
            n,
        ),
        *_valley(quick),
    ]


def _valley(quick: bool) -> list[Figure]:
    """A cubic that stays above zero, so that the indenter keeps touching and the minimum can be seen."""
    peak_mm, valley_mm, scale = 2.5, 7.0, 0.02
    curves = bistable(peak_mm, valley_mm, scale)
    machine = Machine(noise_N=0.01, contact_mm=2.0, parked_mm=0.2, compliance_mm_N=0.02, backlash_mm=0.0)
    off = []
    for seed in range(3 if quick else 20):
        result = press(curves, machine, method(9.5, 1.0), seed, 100.0)[0][0].result
        off.append(abs((result.valley_depth_mm or 99) - valley_mm))
    worst = float(max(off))
    return [
        Figure(
            "bistable: valley off, worst", round(worst, 4), "mm", "within one sample (0.01 mm)", worst <= 0.01, len(off)
        )
    ]


def _first_zero(peak_mm: float, valley_mm: float) -> float | None:
    middle = 0.75 * (peak_mm + valley_mm)
    under = middle**2 - 3 * peak_mm * valley_mm
    return None if under < 0 else middle - under**0.5


def _work(peak_mm: float, valley_mm: float, scale: float, to_mm: float) -> float:
    return scale * (to_mm**4 / 4 - 0.5 * (peak_mm + valley_mm) * to_mm**3 + 1.5 * peak_mm * valley_mm * to_mm**2)


PARTS: dict[str, Callable[[bool], list[Figure]]] = {
    "faults": faults,
    "motion": motion,
    "kill": kill,
    "rate": rate,
    "bistable": bistable_closed_form,
    "caps": caps,
    "shipped": shipped,
}
