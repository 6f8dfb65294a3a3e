"""Young's modulus from a measured force: at one geometry every force of the model scales with E·thickness."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
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


@dataclass(frozen=True, slots=True)
class Loading:
    """One loading curve, and which of a table's it is."""

    depth_mm: Array
    force_N: Array
    name: str


def read_loading(text: str, point: int | None = None, curve: int | None = None) -> Loading:
    """Return the loading curve of a CSV with a header that names depth_mm and load_N (or force_N); # begins a comment.

    A rig's `curves.csv` holds many, with their unloading: `point` is needed where it has more than one, `curve` is
    the last of that point, whose rubber the earlier ones have worked in. Raises `DesignError`.
    """
    lines = [line for line in text.lstrip("\ufeff").splitlines() if line.strip() and not line.startswith("#")]
    rows: list[dict[str, str]] = list(csv.DictReader(lines))
    name = next((name for name in ("load_N", "force_N") if rows and name in rows[0]), None)
    if name is None or "depth_mm" not in rows[0]:
        raise DesignError("needs the columns depth_mm and load_N (or force_N), as a run's curves.csv")
    rows = [row for row in rows if row.get("branch", "load") == "load"]
    told = []
    for key, asked in (("point", point), ("curve", curve)):
        if rows and key in rows[0]:
            chosen = _chosen(key, asked, rows)
            rows = [row for row in rows if int(row[key]) == chosen]
            told.append(f"{key} {chosen}")
    try:
        pairs = np.array([[float(row["depth_mm"]), float(row[name])] for row in rows if row[name]]).reshape(-1, 2)
    except (TypeError, ValueError) as fault:
        raise DesignError(f"a row of depth_mm and {name} is no pair of numbers: {fault}") from fault
    if not len(pairs) or not np.isfinite(pairs).all():
        raise DesignError(f"depth_mm and {name} hold no loading, or numbers that are none")
    return Loading(pairs[:, 0], pairs[:, 1], ", ".join(told))


def _chosen(key: str, asked: int | None, rows: Sequence[Mapping[str, str]]) -> int:
    there = sorted({int(row[key]) for row in rows})
    if asked is None and key == "point" and len(there) > 1:
        raise DesignError(f"there are points {', '.join(map(str, there))}; say which with --point")
    if asked is not None and asked not in there:
        raise DesignError(f"there is no {key} {asked}; there are {', '.join(map(str, there))}")
    return there[-1] if asked is None else asked


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
