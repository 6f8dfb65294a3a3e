"""The part of a loading curve before contact: where it ends, its level, drift and noise. Pure.

A load cell that warms, or a cable that is dragged along, makes the free part slope; a level alone would then take the
drift for the specimen. So a line is followed as well, and taken off where the data show clearly that there is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

HEAD_COUNT = 12  # the first samples, for a first idea of level and noise
FREE_MIN = 12  # samples that must lie before the rise
WIDTH = 8  # samples of the running mean that shows a rise
SURE_COUNT = 40  # free samples that tell the noise better than the whole curve does
SLOW_RATIO, STRAIGHT_MM = 1.5, 0.8  # noise is slow beyond this ratio, seen over a stretch that short
LEAST_N = 1e-6  # a noise of nothing would let every rounding count
SPIKE_SIGMA = 12.0  # a sample so many noises off both its sides is a disturbance
SIGNAL = 8.0  # the force must exceed the noise by this factor
SURE_FRAC = 0.2  # of the way to the greatest force: there the specimen is met for sure
BAND_SIGMA, BAND_FRAC = 4.5, 0.004  # a mean outside so many standard errors, and so much of the range, has risen
DRIFT_N_MM = 2e-3  # how much the free part is expected to slope: drift over speed
DRIFT_SIGMA = 2.0  # a slope is believed beyond so many of its standard errors
DRIFT_MAX_FRAC = 0.3  # a free part that climbs by more than this share of the loaded part is none


@dataclass(frozen=True, slots=True)
class Free:
    """The free part of a curve. `start` is the index of the first sure rise, `rise_mm` its position.

    `slope_N_mm` is the drift where it is evident, else 0; `drift_N_mm` is what the free part may be expected to slope;
    where it `bends` nothing is expected.
    """

    start: int
    level_N: float
    noise_N: float
    slope_N_mm: float = 0.0
    drift_N_mm: float = DRIFT_N_MM
    rise_mm: float = -np.inf
    bends: bool = False


def find_free(u: Reals, f: Reals) -> Free | str:
    """Return the free part of a loading, position `u` (n,) rising, or why there is none."""
    if len(u) < 3 * FREE_MIN:
        return f"only {len(u)} samples in the loading"
    first_N, slow_ratio = noise_of_N(u, f)
    slope_N_mm, drift_N_mm = _drift(u, f, first_N)
    straight = f - slope_N_mm * (u - u[0])
    if slope_N_mm and _comes_back(f, _followed(straight, first_N, slow_ratio)):
        slope_N_mm, drift_N_mm, straight = 0.0, DRIFT_N_MM, f
    drifts = f", a drift of {1000 * slope_N_mm:.1f} mN/mm taken off" if slope_N_mm else ""
    if _means(straight).max() - np.median(straight[:HEAD_COUNT]) < SIGNAL * first_N / np.sqrt(WIDTH):
        return f"the force never leaves the noise of {1000 * first_N:.1f} mN{drifts}"
    found = _followed(straight, first_N, slow_ratio)
    if isinstance(found, str):
        return found + drifts
    start, level_N, settled_N = found
    before = _few(u, f, start)
    if before is not None:
        return before
    steepest_N_mm = _steepest(u, straight, start)
    if abs(slope_N_mm) > DRIFT_MAX_FRAC * steepest_N_mm:
        return (
            f"before the rise the force already climbs by {1000 * slope_N_mm:.1f} mN/mm, after it by "
            f"{1000 * steepest_N_mm:.1f}: the curve begins in contact, or the load cell drifts too much"
        )
    return Free(start, level_N, settled_N, slope_N_mm, drift_N_mm, float(u[start]))


def _followed(f: Reals, noise_N: float, slow_ratio: float) -> tuple[int, float, float] | str:
    """Return (start, level, noise): the free part grows as long as the running mean stays in its band."""
    means, top_N = _means(f), float(f.max())
    level_N = float(np.median(f[:HEAD_COUNT]))
    start = 0
    for _ in range(3):
        band = BAND_SIGMA * noise_N / np.sqrt(WIDTH) + BAND_FRAC * (top_N - level_N)
        risen = means - level_N > band
        sure = means - level_N > max(band, SURE_FRAC * (float(means.max()) - level_N))
        if not risen.any() or not sure.any():
            return "the force never rises steadily"
        free = np.flatnonzero(~risen[: int(np.argmax(sure))])  # what rises and comes back was no contact
        start = int(free[-1]) + 1 if len(free) else 0
        if start < FREE_MIN // 3:
            break
        level_N = float(np.median(f[:start]))
        if start >= SURE_COUNT:
            noise_N = max(slow_ratio * float(np.std(np.diff(f[:start])) / np.sqrt(2)), LEAST_N)
    if start >= SURE_COUNT and (waves_N := _waves_N(f[: 4 * start // 5])) > SLOW_RATIO * noise_N:
        noise_N = waves_N
    return start, level_N, noise_N


def _comes_back(f: Reals, found: tuple[int, float, float] | str) -> bool:
    """Tell whether the force falls below where it seemed to rise: a wave, half of which was taken for drift.

    Asked of the force as it is, up to where the specimen is met for sure.
    """
    if isinstance(found, str) or found[0] < WIDTH:
        return False
    means, start = _means(f), found[0]
    before_N = float(np.median(f[start - WIDTH : start]))
    sure = int(np.argmax(means > before_N + SURE_FRAC * (float(means.max()) - before_N)))
    return bool(np.any(means[start:sure] < before_N))


def _waves_N(free_N: Reals) -> float:
    """Return the noise of a free part as its means of some samples show it, a parabola taken off: draughts, steps."""
    means = _means(free_N)
    x = np.linspace(-1, 1, len(means))
    off = means - np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyfit(x, means, 2))
    return float(np.sqrt(WIDTH) * np.std(off))


def _few(u: Reals, f: Reals, start: int) -> str | None:
    """Say that too few samples lie before the rise, and whether that is contact from the first one on."""
    before = start + WIDTH - 2  # the rise is in the last samples of the mean that shows it
    head_u, head = u[:HEAD_COUNT], f[:HEAD_COUNT]
    slope, se = _line(head_u, head)
    climbs = slope > 4 * se and slope * float(np.ptp(head_u)) > BAND_FRAC * float(np.ptp(f))
    if start < FREE_MIN and (climbs or before < 4):
        return "the curve begins in contact: there is no free part before it"
    if before < FREE_MIN:
        room_mm = float(u[max(before, 1)] - u[0])
        return (
            f"only {before} samples ({room_mm:.2f} mm) lie before the rise, {FREE_MIN} are needed: "
            "begin higher above the specimen, go slower, or sample more often"
        )
    return None


def _drift(u: Reals, f: Reals, noise_N: float) -> tuple[float, float]:
    """Return (slope that is evident or 0, what may be expected of it), from the samples before the line breaks off."""
    end = _end_of_line(u, f, noise_N)
    if end < FREE_MIN + WIDTH:  # a line through so few has begun to follow the rise itself
        return 0.0, DRIFT_N_MM
    slope, se = _line(u[:end], f[:end])
    beyond = float(np.sqrt(max(0.0, slope**2 - (DRIFT_SIGMA * se) ** 2)))
    return (slope, beyond) if beyond > DRIFT_N_MM else (0.0, DRIFT_N_MM)


def _end_of_line(u: Reals, f: Reals, noise_N: float) -> int:
    """Return the first index from which the force rises off the line through what came before; its count if never.

    The last fifth before a tested mean is left out of the line, so that a gentle rise does not bend it up.
    """
    ends = np.arange(FREE_MIN, len(f) - WIDTH + 1)
    if not len(ends):
        return len(f)
    counts = ends - ends // 5
    x = u - u[0]
    sums = [np.concatenate([[0.0], np.cumsum(c)])[counts] for c in (x, x * x, f, x * f)]
    mean_x, mean_f = sums[0] / counts, sums[2] / counts
    spread = np.maximum(sums[1] - counts * mean_x**2, 1e-12)
    slope = (sums[3] - counts * mean_x * mean_f) / spread
    ahead = np.convolve(x, np.full(WIDTH, 1 / WIDTH), "valid")[ends] - mean_x
    off = _means(f)[ends] - (mean_f + slope * ahead)
    doubt = noise_N * np.sqrt(1 / WIDTH + 1 / counts + ahead**2 / spread)
    over = np.flatnonzero(off > BAND_SIGMA * doubt + BAND_FRAC * float(np.ptp(f)))
    return int(ends[over[0]]) if len(over) else len(f)


def _line(x: Reals, f: Reals) -> tuple[float, float]:
    """Return slope and its standard error."""
    away = x - x.mean()
    spread = float(away @ away) or 1e-12
    slope = float(away @ f) / spread
    residual = f - f.mean() - slope * away
    return slope, float(np.sqrt(residual @ residual / max(1, len(x) - 2) / spread))


def _steepest(u: Reals, f: Reals, start: int) -> float:
    """Return the steepest of five chords between the rise and the greatest force."""
    top = max(start + int(np.argmax(f[start:])), start + 5)
    marks = np.unique(np.linspace(start, min(top, len(f) - 1), 6).astype(int))
    return float(np.max(np.diff(f[marks]) / np.maximum(np.diff(u[marks]), 1e-9)))


def _means(f: Reals) -> Reals:
    return np.convolve(f, np.full(WIDTH, 1 / WIDTH), "valid")


def without_spikes(f: Reals, noise_N: float) -> tuple[Reals, int]:
    """Return the forces without single samples that stand out on both sides, and how many they were.

    Each is held against the lines through the two samples before it and the two after it: a snap or a cusp goes on from
    one of them. In its place comes the mean of its neighbours.
    """
    if len(f) < 5:
        return f, 0
    before, after = f[2:-2] - (2 * f[1:-3] - f[:-4]), f[2:-2] - (2 * f[3:-1] - f[4:])
    stands_out = np.minimum(np.abs(before), np.abs(after)) > SPIKE_SIGMA * noise_N
    at = np.flatnonzero(stands_out & (before * after > 0)) + 2
    at = at[np.abs(f[at] - (f[at - 1] + f[at + 1]) / 2) > SPIKE_SIGMA * noise_N]
    at = at[np.flatnonzero(np.diff(at, prepend=-9) > 2)]
    clean = f.copy()
    clean[at] = (f[at - 1] + f[at + 1]) / 2
    return clean, len(at)


def noise_of_N(u: Reals, f: Reals) -> tuple[float, float]:
    """Return (noise that counts for means of some samples, its ratio to the noise from one sample to the next).

    They are the same where samples err each for itself; a load cell behind a filter, or one that wanders, errs slowly.
    """
    fast_N = _bends_N(f, 1)
    if float(np.median(np.diff(u))) * 4 * WIDTH > STRAIGHT_MM or len(f) < 6 * WIDTH:
        return fast_N, 1.0  # over so long a way the specimen's own curvature would be taken for noise
    ratio = float(np.sqrt(WIDTH)) * _bends_N(_means(f), WIDTH) / fast_N
    return (ratio * fast_N, ratio) if ratio > SLOW_RATIO else (fast_N, 1.0)


def _bends_N(f: Reals, lag: int) -> float:
    """Return the noise from third differences of the whole curve: its slope, bend, kink and snap do not count."""
    bends = f[3 * lag :] - 3 * f[2 * lag : -lag] + 3 * f[lag : -2 * lag] - f[: -3 * lag]
    usual = 1.4826 * float(np.median(np.abs(bends - np.median(bends)))) or float(np.std(bends))
    return max(usual / float(np.sqrt(20)), LEAST_N)
