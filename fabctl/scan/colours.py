"""The colours of deviations: blue below the target, white on it, red above; the same in every picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fabctl.scan.deviation import Deviation

Floats = NDArray[np.float64]

# Stops of the scale from -span to +span, RGB 0 to 255. Readable with red-green blindness, and grey where unseen.
STOPS = np.array(
    [[33, 56, 140], [67, 118, 195], [150, 196, 227], [245, 245, 240], [248, 180, 130], [218, 84, 60], [140, 20, 36]],
    dtype=np.float64,
)
UNSEEN = (168, 168, 172)


def colours_of(value_mm: Floats, span_mm: float) -> NDArray[np.uint8]:
    """Return the colour of each value on a scale of plus or minus `span_mm`, `(n, 3)`; NaN is grey."""
    at = np.clip(value_mm / max(span_mm, 1e-12), -1, 1)
    place = (np.nan_to_num(at) + 1) / 2 * (len(STOPS) - 1)
    mixed = np.stack([np.interp(place, np.arange(len(STOPS)), STOPS[:, k]) for k in range(3)], axis=1)
    mixed[~np.isfinite(value_mm)] = UNSEEN
    return np.round(mixed).astype(np.uint8)


def span_mm(found: Deviation) -> float:
    """Return a round span that holds 98 % of the compared points."""
    return round_up(float(np.quantile(np.abs(found.value_mm[found.counts]), 0.98)))


def round_up(value: float) -> float:
    """Return the next of 1, 2, 5 times a power of ten."""
    if value <= 0:
        return 1e-3
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= value * (1 - 1e-9)))
