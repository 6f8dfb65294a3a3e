"""Young's modulus from a measured force: at one geometry every force of the model scales with E·thickness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.errors import DesignError

Array = NDArray[np.float64]

LEAST_SAMPLES_COUNT = 8
T95 = 1.96


@dataclass(frozen=True, slots=True)
class Calibration:
    """How a measured curve stands to a predicted one: force = factor · predicted(depth − contact)."""

    factor_ratio: float
    factor_ci95_ratio: float
    contact_mm: float
    misfit_ratio: float  # RMS of the difference over the greatest force used
    samples_count: int


def calibrate(depth_mm: Array, force_N: Array, predicted_depth_mm: Array, predicted_N: Array) -> Calibration:
    """Return the factor between a measured and a predicted loading curve, with the contact point fitted too.

    Only samples inside the predicted depths count. Raises `DesignError` where too few do or the prediction is flat.
    """
    span = float(predicted_depth_mm[-1])
    if np.ptp(predicted_N) <= 0:
        raise DesignError("the predicted curve carries no force; nothing can be scaled to it")

    def fit(contact_mm: float) -> tuple[float, float, NDArray[np.bool_]]:
        depth = depth_mm - contact_mm
        used = (depth >= 0) & (depth <= span)
        if used.sum() < LEAST_SAMPLES_COUNT:
            return np.nan, np.inf, used
        model = np.interp(depth[used], predicted_depth_mm, predicted_N)
        if not model.any():
            return np.nan, np.inf, used
        factor = float(model @ force_N[used] / (model @ model))
        # Per sample, so that shifts that leave fewer samples gain nothing.
        return factor, float(np.mean((force_N[used] - factor * model) ** 2)), used

    from scipy.optimize import minimize_scalar

    shifts = np.linspace(-0.2 * span, 0.2 * span, 41)
    best = int(np.argmin([fit(s)[1] for s in shifts]))
    low, high = shifts[max(best - 1, 0)], shifts[min(best + 1, len(shifts) - 1)]
    contact = float(minimize_scalar(lambda s: fit(s)[1], bounds=(low, high), method="bounded").x)
    factor, misfit, used = fit(contact)
    if not np.isfinite(factor):
        raise DesignError(
            f"{int(used.sum())} samples lie within the predicted 0 to {span:g} mm; at least {LEAST_SAMPLES_COUNT} are "
            "needed: measure deeper or slower"
        )
    model = np.interp(depth_mm[used] - contact, predicted_depth_mm, predicted_N)
    spread = np.sqrt(misfit * used.sum() / max(used.sum() - 2, 1) / float(model @ model))
    return Calibration(
        factor, T95 * float(spread), contact, float(np.sqrt(misfit) / np.abs(force_N[used]).max()), int(used.sum())
    )
