"""The paper's two caps through rig and analysis: five specimens each, many times over.

They are those of `configs/specs/cap-low.yaml` and `cap.yaml`, their load curves as `fabctl design build` predicts them.
The sheets push back with some 0.02 N, which a load cell with the 10 mN of noise that are asked for cannot weigh: at
their 0.01 N/mm that noise alone is a millimetre. So what is asked (10 mN, a frame that gives a tenth, drift) is asked
of the same curves fifty times as stiff, a newton, as a sheet of 15 MPa and 5 mm would be by E h²; and `shipped` presses
them as they are, with the 0.3 mN of a small load cell.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from benchmarks import Figure
from benchmarks._rig_memory import method, press
from fabctl.indent.compare import bca, fieller, percentile
from simulators.rig.controller import Machine
from simulators.specimens.analytic import tabulate
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
STEP_MM = 0.375
SCATTER_FRAC = 0.04  # from specimen to specimen
N = 5


@dataclass(frozen=True)
class Way:
    """How the caps are pressed: how much stiffer than they are, and with what load cell."""

    stiffened: float
    noise_N: float
    drift_N_s: float
    trigger_N: float
    speed_mm_s: float
    sample_hz: float
    clearance_mm: float


ASKED = Way(50.0, 0.01, 3e-4, 0.06, 1.0, 100.0, 0.8)
SHIPPED = Way(1.0, 3e-4, 5e-6, 0.003, 0.5, 200.0, 1.0)


def cap_curves(loads_N: tuple[float, ...], factor: float) -> Curves:
    """Return a cap's curves through its predicted loads, smoothly, times `factor`."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(STEP_MM * np.arange(len(loads_N)), np.array(loads_N) * factor)
    return tabulate(lambda d: float(spline(d)), unload_ratio=0.94, depth_mm=STEP_MM * (len(loads_N) - 1))


def press_cap(loads_N: tuple[float, ...], seed: int, way: Way) -> tuple[float | None, float | None, float]:
    """Return (secant stiffness, contact error, true secant) of one specimen drawn from `seed`."""
    rng = np.random.default_rng(seed)
    curves = cap_curves(loads_N, way.stiffened * (1 + SCATTER_FRAC * float(rng.standard_normal())))
    true_N_mm = curves.load_N[round(2.0 / curves.step_mm)] / 2.0
    machine = Machine(
        noise_N=way.noise_N,
        drift_N_s=float(rng.uniform(-way.drift_N_s, way.drift_N_s)),
        compliance_mm_N=0.1 / (0.01 * way.stiffened),  # a tenth of what the stiffer cap gives way
        contact_mm=float(rng.uniform(1.8, 2.4)),
        parked_mm=0.2,
        backlash_mm=0.004,
    )
    plan = method(3.2, way.speed_mm_s, clearance_mm=way.clearance_mm, trigger_N=way.trigger_N)
    result = press(curves, machine, plan, seed, way.sample_hz)[0][0].result
    at = result.contact.position_mm
    secant = result.stiffness_secant_N_mm
    return (
        None if secant is None else secant.value,
        None if at is None else at - machine.contact_mm,
        float(true_N_mm),
    )


def caps(quick: bool) -> list[Figure]:
    """The two caps, five specimens each, a thousand times over, with the noise that is asked for."""
    return _measured("caps", ASKED, 20 if quick else int(os.environ.get("RIG_SEEDS", "1000")))


def shipped(quick: bool) -> list[Figure]:
    """The same at the loads that `fabctl design build` predicts, with a load cell that suits them."""
    return _measured("shipped caps, 0.3 mN", SHIPPED, 3 if quick else int(os.environ.get("RIG_SEEDS", "40")))


def _measured(name: str, way: Way, seeds: int) -> list[Figure]:
    from joblib import Parallel, delayed

    first = int(os.environ.get("RIG_FIRST_SEED", "0"))
    pressed = Parallel(n_jobs=int(os.environ.get("RIG_JOBS", "2")), batch_size=20)(
        delayed(press_cap)(loads, N * (first + seed) + k + offset, way)
        for loads, offset in ((LOW_N, 0), (HIGH_N, 10_000_000))
        for seed in range(seeds)
        for k in range(N)
    )
    table = np.array([[np.nan if v is None else v for v in row] for row in pressed]).reshape(2, seeds, N, 3)
    nominal = [cap_curves(loads, way.stiffened) for loads in (LOW_N, HIGH_N)]
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
            f"{name}: ratio found over the specimens' true ratio, median off",
            round(100 * float(np.median(np.abs(off))), 3),
            "%",
            "within +-5 %",
            bool(np.median(np.abs(off)) <= 0.05),
            seeds,
        ),
        Figure(f"{name}: the same, 95 % of the seeds within", round(worst, 3), "%", "within +-5 %", worst <= 5, seeds),
        Figure(
            f"{name}: Fieller's 95 % interval covers the truth",
            round(shares["Fieller"], 1),
            "%",
            "93 to 97 %",
            93 <= shares["Fieller"] <= 97,
            seeds,
        ),
        Figure(f"{name}: BCa covers", round(shares["BCa"], 1), "%", "", None, seeds),
        Figure(
            f"{name}: plain percentile covers", round(shares["percentile"], 1), "%", "covers too little", None, seeds
        ),
        Figure(f"{name}: contact bias, low", round(bias[0], 4), "mm", "<= 0.03 mm", abs(bias[0]) <= 0.03, seeds * N),
        Figure(f"{name}: contact bias, high", round(bias[1], 4), "mm", "<= 0.03 mm", abs(bias[1]) <= 0.03, seeds * N),
        Figure(f"{name}: contacts not found", lost, "", "", None, 2 * seeds * N),
    ]
