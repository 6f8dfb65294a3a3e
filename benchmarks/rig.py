"""The rig room's figures: `python -m benchmarks rig [faults motion kill rate bistable caps] [--quick]`.

The two caps are those of `configs/specs/cap-low.yaml` and `cap.yaml`, their load curves as `fabctl design build`
predicts them, stiffened fifty times: the sheets themselves push back with some 0.02 N, which a load cell with 10 mN of
noise cannot weigh. What is asked (10 mN noise, 10 % frame compliance, drift) is asked of curves of a newton.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import Figure
from benchmarks._rig_kill import kill_while_loading
from benchmarks._rig_lines import move_through_faults, read_naively, read_through_faults
from benchmarks._rig_memory import method, press
from benchmarks._rig_rate import slots_met_frac
from fabctl.indent.compare import bca, fieller, percentile
from simulators.rig.controller import Machine
from simulators.specimens.analytic import bistable, tabulate
from simulators.specimens.curve import Curves

# Load at multiples of 0.375 mm of depth, newton: `fabctl design build configs/specs/cap-low.yaml` and `…/cap.yaml`.
LOW_N = (
    0,
    0.005188,
    0.009719,
    0.013680,
    0.017155,
    0.020217,
    0.022929,
    0.025343,
    0.027506,
    0.029457,
    0.031230,
    0.032856,
)
HIGH_N = (
    0,
    0.003233,
    0.006141,
    0.008749,
    0.011084,
    0.013171,
    0.015036,
    0.016703,
    0.018198,
    0.019542,
    0.020756,
    0.021861,
)
STEP_MM, STIFFENED = 0.375, 50.0
SCATTER_FRAC = 0.04  # from specimen to specimen
N = 5


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


def cap_curves(loads_N: tuple[float, ...], factor: float) -> Curves:
    """Return a cap's curves through its predicted loads, smoothly, times `factor`."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(STEP_MM * np.arange(len(loads_N)), np.array(loads_N) * STIFFENED * factor)
    return tabulate(lambda d: float(spline(d)), unload_ratio=0.94, depth_mm=STEP_MM * (len(loads_N) - 1))


def press_cap(loads_N: tuple[float, ...], seed: int) -> tuple[float | None, float | None, float]:
    """Return (secant stiffness, contact error, true secant) of one specimen drawn from `seed`."""
    rng = np.random.default_rng(seed)
    curves = cap_curves(loads_N, 1 + SCATTER_FRAC * float(rng.standard_normal()))
    true_N_mm = curves.load_N[round(2.0 / curves.step_mm)] / 2.0
    machine = Machine(
        noise_N=0.01,
        drift_N_s=float(rng.uniform(-3e-4, 3e-4)),
        compliance_mm_N=0.1 / 0.5,  # a tenth of what the stiffer cap gives way
        contact_mm=float(rng.uniform(1.8, 2.4)),
        parked_mm=0.2,
        backlash_mm=0.004,
    )
    result = press(curves, machine, method(3.2, 1.0, clearance_mm=0.8), seed)[0][0].result
    at = result.contact.position_mm
    secant = result.stiffness_secant_N_mm
    return (
        None if secant is None else secant.value,
        None if at is None else at - machine.contact_mm,
        float(true_N_mm),
    )


def caps(quick: bool) -> list[Figure]:
    """The two caps, five specimens each, a thousand times over."""
    from joblib import Parallel, delayed

    seeds = 20 if quick else int(os.environ.get("RIG_SEEDS", "1000"))
    pressed = Parallel(n_jobs=int(os.environ.get("RIG_JOBS", "2")), batch_size=50)(
        delayed(press_cap)(loads, N * seed + k + offset)
        for loads, offset in ((LOW_N, 0), (HIGH_N, 10_000_000))
        for seed in range(seeds)
        for k in range(N)
    )
    table = np.array([[np.nan if v is None else v for v in row] for row in pressed]).reshape(2, seeds, N, 3)
    nominal = [cap_curves(loads, 1.0) for loads in (LOW_N, HIGH_N)]
    truth = nominal[0].load_N[round(2 / nominal[0].step_mm)] / nominal[1].load_N[round(2 / nominal[1].step_mm)]
    lost = int(np.isnan(table).any(axis=-1).sum())
    off, covered = [], {"Fieller": 0, "BCa": 0, "percentile": 0}
    for seed in range(seeds):
        low, high = table[0, seed, :, 0], table[1, seed, :, 0]
        low, high = low[np.isfinite(low)], high[np.isfinite(high)]
        own = table[0, seed, :, 2].mean() / table[1, seed, :, 2].mean()
        rng = np.random.default_rng(seed)
        for ratio in (fieller(low, high), bca(low, high, rng, draws_count=2000), percentile(low, high, rng)):
            if ratio.low_ratio is not None and ratio.high_ratio is not None:
                covered[ratio.how] += ratio.low_ratio <= truth <= ratio.high_ratio
        off.append(float(low.mean() / high.mean() / own - 1))
    bias = [float(np.nanmean(table[group, :, :, 1])) for group in (0, 1)]
    shares = {name: 100 * count / seeds for name, count in covered.items()}
    worst = 100 * float(np.quantile(np.abs(off), 0.95))
    return [
        Figure(
            "caps: ratio found over the specimens' true ratio, median off",
            round(100 * float(np.median(np.abs(off))), 3),
            "%",
            "within +-5 %",
            bool(np.median(np.abs(off)) <= 0.05),
            seeds,
        ),
        Figure("caps: the same, 95 % of the seeds within", round(worst, 3), "%", "within +-5 %", worst <= 5, seeds),
        Figure(
            "caps: Fieller's 95 % interval covers the truth",
            round(shares["Fieller"], 1),
            "%",
            "93 to 97 %",
            93 <= shares["Fieller"] <= 97,
            seeds,
        ),
        Figure("caps: BCa covers", round(shares["BCa"], 1), "%", "", None, seeds),
        Figure("caps: plain percentile covers", round(shares["percentile"], 1), "%", "covers too little", None, seeds),
        Figure("caps: contact bias, low", round(bias[0], 4), "mm", "<= 0.03 mm", abs(bias[0]) <= 0.03, seeds * N),
        Figure("caps: contact bias, high", round(bias[1], 4), "mm", "<= 0.03 mm", abs(bias[1]) <= 0.03, seeds * N),
        Figure("caps: contacts not found", lost, "", "", None, 2 * seeds * N),
    ]


PARTS: dict[str, Callable[[bool], list[Figure]]] = {
    "faults": faults,
    "motion": motion,
    "kill": kill,
    "rate": rate,
    "bistable": bistable_closed_form,
    "caps": caps,
}
