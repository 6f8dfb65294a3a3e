"""Statistics over specimens: means, and the ratio of two groups with an honest interval at n = 5.

Fieller's interval solves for the ratios that a t-test does not refuse. With unequal spreads the two variances stand for
themselves and the degrees of freedom follow Welch and Satterthwaite, at the ratio found. Plain percentile bootstraps
cover too little at n = 5; the bias-corrected and accelerated one (BCa) is given beside Fieller's for comparison.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Reals = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Group:
    """Mean and spread of one group, with the t interval of the mean."""

    name: str
    count: int
    mean: float
    sd: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Ratio:
    """The ratio of two groups' means. An end that is not there is None, with the reason."""

    value_ratio: float
    low_ratio: float | None
    high_ratio: float | None
    level_frac: float
    how: str
    reason: str = ""


def describe(name: str, values: Sequence[float], level_frac: float = 0.95) -> Group:
    """Return mean, standard deviation and interval of at least two values."""
    x = np.asarray(values, float)
    if len(x) < 2:
        raise ValueError(f"group {name}: {len(x)} value; a spread needs at least two")
    half = float(stats.t.ppf(0.5 + level_frac / 2, len(x) - 1) * x.std(ddof=1) / math.sqrt(len(x)))
    mean = float(x.mean())
    return Group(name, len(x), mean, float(x.std(ddof=1)), mean - half, mean + half)


def fieller(above: Sequence[float], below: Sequence[float], level_frac: float = 0.95) -> Ratio:
    """Return mean(above)/mean(below) with Fieller's interval; no interval where `below` may have mean zero."""
    a, b = np.asarray(above, float), np.asarray(below, float)
    if min(len(a), len(b)) < 2:
        raise ValueError(f"{len(a)} and {len(b)} values; a ratio's interval needs at least two of each")
    value = float(a.mean() / b.mean())
    va, vb = float(a.var(ddof=1)) / len(a), float(b.var(ddof=1)) / len(b)
    degrees = _degrees(va, vb * value**2, len(a), len(b))
    t = float(stats.t.ppf(0.5 + level_frac / 2, degrees))
    # (ā − ρ b̄)² ≤ t² (va + ρ² vb), a quadratic in ρ.
    square = float(b.mean()) ** 2 - t**2 * vb
    if square <= 0:
        return Ratio(value, None, None, level_frac, "Fieller", "the lower group's mean is not clearly above zero")
    middle = float(a.mean() * b.mean()) / square
    under = middle**2 - (float(a.mean()) ** 2 - t**2 * va) / square
    half = math.sqrt(max(under, 0.0))
    return Ratio(value, middle - half, middle + half, level_frac, "Fieller")


def bca(
    above: Sequence[float],
    below: Sequence[float],
    rng: np.random.Generator,
    level_frac: float = 0.95,
    draws_count: int = 4000,
) -> Ratio:
    """Return the ratio with the bias-corrected and accelerated bootstrap interval (Efron 1987), groups drawn apart."""
    a, b = np.asarray(above, float), np.asarray(below, float)
    value = float(a.mean() / b.mean())
    drawn = rng.choice(a, (draws_count, len(a))).mean(axis=1) / rng.choice(b, (draws_count, len(b))).mean(axis=1)
    share = float(np.clip((drawn < value).mean(), 1 / draws_count, 1 - 1 / draws_count))
    bias = float(stats.norm.ppf(share))
    left_out = np.concatenate(
        [
            [np.delete(a, k).mean() / b.mean() for k in range(len(a))],
            [a.mean() / np.delete(b, k).mean() for k in range(len(b))],
        ]
    )
    away = left_out.mean() - left_out
    speed = float((away**3).sum() / (6 * (away**2).sum() ** 1.5)) if (away**2).sum() > 0 else 0.0
    ends = []
    for tail in (0.5 - level_frac / 2, 0.5 + level_frac / 2):
        z = bias + float(stats.norm.ppf(tail))
        ends.append(float(np.quantile(drawn, stats.norm.cdf(bias + z / (1 - speed * z)))))
    return Ratio(value, ends[0], ends[1], level_frac, "BCa")


def percentile(
    above: Sequence[float], below: Sequence[float], rng: np.random.Generator, level_frac: float = 0.95
) -> Ratio:
    """Return the plain percentile bootstrap interval, shown only to be compared with: it covers too little."""
    a, b = np.asarray(above, float), np.asarray(below, float)
    drawn = rng.choice(a, (4000, len(a))).mean(axis=1) / rng.choice(b, (4000, len(b))).mean(axis=1)
    low, high = np.quantile(drawn, [0.5 - level_frac / 2, 0.5 + level_frac / 2])
    return Ratio(float(a.mean() / b.mean()), float(low), float(high), level_frac, "percentile")


def _degrees(va: float, vb: float, na: int, nb: int) -> float:
    if va + vb == 0:
        return float(na + nb - 2)
    return (va + vb) ** 2 / (va**2 / (na - 1) + vb**2 / (nb - 1))
