"""Where the indenter meets the specimen, on a loading curve that begins free.

Estimators made for Hertz's convex start are early by a millimetre on a cap, whose curve rises at once and softens.
The one that is used here fits the free part and the beginning of the loaded part together,

    F(u) = b0 + b1 u + Σ a_p (u − u0)₊^p,

with p = 1, 2, 3 for a start with a slope, or p = 1.5, 2.5, 3.5 for a Hertzian one where the data clearly ask for it. u0
is found by scanning the residual, with its standard error. The others are computed to show how far opinions differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fabctl.indent.freepart import FREE_MIN, WIDTH, Free, find_free, noise_of_N, without_spikes

Reals = NDArray[np.float64]

SLOPED, HERTZIAN = (1.0, 2.0, 3.0), (1.5, 2.5, 3.5)
RISE = 2  # the column of the first power: how the force begins
FALL_SIGMA, NEVER = 0.3, 1e6  # a start that falls by so much of the noise again is none: its chi² is taken for more
STEEP_N_MM = 1e3  # a drift of which nothing is expected
BENT_SIGMA = 4.0  # a free part curved by so many standard errors is asked whether its drift bends
NEAR_FRAC, NEAR_MM = 0.4, 1.0  # and the fit with a bent free part reaches so far towards the first maximum
CLEARLY = 12.0  # by how much chi² must fall before a Hertzian start is believed instead of a sloped one
MISFIT_SIGMA = 4.0  # a window is too long where chi² exceeds its mean by so many of its standard deviations
AGREE_SIGMA = 1.5  # and where its contact lies outside so many standard errors of a shorter window's
WINDOWS = (0.15, 0.25, 0.4, 0.6, 0.85)  # of the way from the guess to the first maximum
ENOUGH_COUNT, THIN_MM = 350, 0.02  # more samples than this are averaged over at most so much of the stroke
TOUCH_COUNT, TOUCH_MM = 80, 0.1  # for the quick look during an approach
SE_GOOD_MM = 0.05  # a shorter window this sure may end the search; a less sure one is lengthened in any case
SE_MAX_MM = 0.25  # a contact less certain than this is not found


@dataclass(frozen=True, slots=True)
class Contact:
    """Where contact is, how sure that is, and what the other estimators say.

    `position_mm` is None where it was not found; `reason` says why. `slope_N_mm` is the stiffness at contact with its
    standard error; None for a Hertzian start, which has none. `drift_N_mm` is the slope of the free part where it is
    evident, else 0; where it bends (`drift_N_mm2`) its slope at contact. `kind` is `zero` where the curve begins under
    a preload and depth is counted from the method's zero, at which the force was `start_N`.
    """

    position_mm: float | None
    reason: str = ""
    se_mm: float | None = None
    kind: str = ""
    slope_N_mm: float | None = None
    slope_se_N_mm: float | None = None
    noise_N: float = 0.0
    baseline_N: float = 0.0
    baseline_N_mm: float = 0.0
    drift_N_mm: float = 0.0
    drift_N_mm2: float = 0.0
    start_N: float = 0.0
    others_mm: tuple[tuple[str, float], ...] = ()

    @property
    def spread_mm(self) -> float | None:
        """Return how far the estimators lie apart."""
        values = [value for _, value in self.others_mm] + ([] if self.position_mm is None else [self.position_mm])
        return max(values) - min(values) if len(values) > 1 else None


@dataclass(frozen=True, slots=True)
class Fit:
    """One joint fit of free and loaded part."""

    contact_mm: float
    powers: tuple[float, ...]
    coefficients: Reals  # (2 + powers,): level, drift, then a_p; and the drift's parabola where it bends
    covariance: Reals  # square, one more: contact last
    se_mm: float
    chi2: float
    count: int

    @property
    def bend_N_mm2(self) -> float:
        """Return the drift's parabola, 0 where none was fitted."""
        return float(self.coefficients[-1]) if len(self.coefficients) > RISE + len(self.powers) else 0.0

    @property
    def misfit(self) -> float:
        """Return by how many of its standard deviations chi² exceeds its mean."""
        return (self.chi2 - self.count) / float(np.sqrt(2 * self.count))


def find_contact(position_mm: Reals, force_N: Reals) -> Contact:
    """Return the contact on a loading curve; `position_mm` (n,) rises, the frame's give already taken off."""
    u, f = _thinned(position_mm, force_N, ENOUGH_COUNT, THIN_MM)
    free = find_free(u, f)
    if isinstance(free, str):
        return Contact(None, free)
    level_N, noise_N = free.level_N, free.noise_N
    others = _opinions(u, f, free.start, level_N, noise_N)
    straight = _best_fit(u, f, free)
    if straight is None:
        reason = "no window after the rise is long enough to fit"
        return Contact(None, reason, noise_N=noise_N, baseline_N=level_N, others_mm=others)
    best = _with_bend(u, f, free, straight)
    # Between two samples nothing is known of how the contact begins.
    se_mm = float(np.hypot(best.se_mm, np.median(np.diff(u)) / np.sqrt(12)))
    sloped = best.powers == SLOPED
    found = Contact(
        best.contact_mm,
        se_mm=se_mm,
        kind="sloped" if sloped else "hertzian",
        slope_N_mm=float(best.coefficients[2]) if sloped else None,
        slope_se_N_mm=float(np.sqrt(best.covariance[2, 2])) if sloped else None,
        noise_N=noise_N,
        baseline_N=float(best.coefficients[0]),
        baseline_N_mm=float(best.coefficients[1]),
        drift_N_mm=float(best.coefficients[1]) if best.bend_N_mm2 else free.slope_N_mm,
        drift_N_mm2=best.bend_N_mm2,
        others_mm=others,
    )
    if se_mm > SE_MAX_MM:
        reason = f"the start is too soft for the noise: standard error {se_mm:.2f} mm, more than {SE_MAX_MM:g} mm"
        return Contact(None, reason, se_mm, noise_N=noise_N, baseline_N=level_N, others_mm=others)
    return found


def first_touch(position_mm: Reals, force_N: Reals) -> float | None:
    """Return roughly where an approach met the specimen, or None.

    Quick, some milliseconds: it is asked between two samples, while a watchdog waits for the next.
    """
    if len(force_N) > 3 * FREE_MIN:
        force_N, _ = without_spikes(force_N, noise_of_N(position_mm, force_N)[0])
    u, f = _thinned(position_mm, force_N, TOUCH_COUNT, TOUCH_MM)
    free = find_free(u, f)
    if isinstance(free, str):
        return None
    at_mm = float(u[free.start])
    return _scan(u, f, at_mm, float(u[-1]) - at_mm + 1.0, 0.2, SLOPED, free).contact_mm


def _thinned(u: Reals, f: Reals, enough_count: int, most_mm: float) -> tuple[Reals, Reals]:
    """Return means of neighbouring samples where they lie closer than is of use; the fits cost by the sample."""
    spacing = float(np.median(np.abs(np.diff(u)))) if len(u) > 1 else 1.0
    many = min(len(u) // enough_count, int(most_mm / max(spacing, 1e-6)))
    if many < 2:
        return u, f
    kept = len(u) // many * many
    return u[:kept].reshape(-1, many).mean(axis=1), f[:kept].reshape(-1, many).mean(axis=1)


def _best_fit(u: Reals, f: Reals, free: Free) -> Fit | None:
    """Return the fit over the longest window that the model still follows and that agrees with all shorter ones."""
    start = free.start
    top = start + int(np.argmax(f[start:]))
    span_mm = float(u[top] - u[start])
    # Where samples lie far apart the mean that showed the rise began far before it.
    after_mm = max(0.5, WIDTH * float(np.median(np.diff(u))))
    taken: list[Fit] = []
    shorter: list[dict[tuple[float, ...], Fit]] = []
    for part in WINDOWS:
        end = int(np.searchsorted(u, u[start] + part * span_mm))
        if end - start < 4 * len(SLOPED) and part != WINDOWS[-1]:
            continue
        around = (float(u[start]), 2.5, after_mm) if not taken else (taken[-1].contact_mm, 0.6, 0.6)
        sloped = _scan(u[:end], f[:end], *around, SLOPED, free)
        hertzian = _scan(u[:end], f[:end], *around, HERTZIAN, free)
        found = _chosen(sloped, hertzian)
        # With what the same kind of start said before: that a longer window shows the kind is no disagreement.
        before = [kinds[found.powers] for kinds in shorter]
        agrees = all(abs(found.contact_mm - one.contact_mm) <= AGREE_SIGMA * one.se_mm for one in before)
        if taken and taken[-1].se_mm < SE_GOOD_MM and (found.misfit > MISFIT_SIGMA or not agrees):
            break
        taken.append(found)
        shorter.append({SLOPED: sloped, HERTZIAN: hertzian})
    return taken[-1] if taken else None


def _with_bend(u: Reals, f: Reals, free: Free, straight: Fit) -> Fit:
    """Return the fit with a parabola for the free part where that explains all clearly better, else `straight`.

    A drift that bends is else taken for the specimen. The part must be curved, and the parabola better than a straight
    line with one power more under load, and than a corner, which is where a specimen is met that stiffens later. The
    error holds how far the contact lies off without the first half of the free part, and the other view as far as it
    is likely.
    """
    bends = replace(free, bends=True)
    top_mm = float(u[int(np.argmax(f[free.start :])) + free.start])
    contact_mm = straight.contact_mm
    for _ in range(2):  # from a contact that is early the first look ends early too
        end = int(np.searchsorted(u, contact_mm + max(NEAR_FRAC * (top_mm - contact_mm), NEAR_MM)))
        found = _wherever(u[:end], f[:end], (SLOPED, HERTZIAN), bends)
        contact_mm = found.contact_mm
    worse = _worse_than_a_corner(u, f, contact_mm, free)
    if found.misfit > MISFIT_SIGMA or worse is None:
        return straight
    plain = _wherever(u[:end], f[:end], ((*SLOPED, 4.0), (*HERTZIAN, 4.5)), free)
    if plain.chi2 - found.chi2 < CLEARLY:
        return straight
    likely = 1 / (1 + float(np.exp(np.clip(worse / 2, -50, 50))))
    apart_mm = contact_mm - straight.contact_mm
    if worse > 0:
        return replace(straight, se_mm=float(np.hypot(straight.se_mm, likely * apart_mm)))
    later = int(np.searchsorted(u, (float(u[0]) + contact_mm) / 2))
    half = _wherever(u[later:end], f[later:end], (SLOPED, HERTZIAN), bends)
    doubts = (found.se_mm, half.contact_mm - contact_mm, (1 - likely) * apart_mm)
    return replace(found, se_mm=float(np.linalg.norm(doubts)))


def _wherever(u: Reals, f: Reals, kinds: tuple[tuple[float, ...], tuple[float, ...]], free: Free) -> Fit:
    """Return the better of two kinds of start, sloped and Hertzian, looked for along the whole of what is given."""
    around = (float(u[0]), 0.0, float(u[-1] - u[0]))
    return _chosen(_scan(u, f, *around, kinds[0], free), _scan(u, f, *around, kinds[1], free))


def _worse_than_a_corner(u: Reals, f: Reals, until_mm: float, free: Free) -> float | None:
    """Return by how much chi² a parabola is worse than a corner before `until_mm`; None where nothing is curved."""
    x, part = u[u < until_mm], f[u < until_mm]
    if len(x) < 2 * FREE_MIN:
        return None
    design = np.vander((x - x.mean()) / float(np.ptp(x)), 3)
    weights = np.linalg.lstsq(design, part, rcond=None)[0]
    off = part - design @ weights
    if abs(weights[0]) < BENT_SIGMA * free.noise_N * np.sqrt(np.linalg.inv(design.T @ design)[0, 0]):
        return None
    corner = _scan(x, part, float(x[0]), 0.0, float(np.ptp(x)), (1.0,), replace(free, drift_N_mm=STEEP_N_MM))
    return float(off @ off) / free.noise_N**2 - corner.chi2


def _chosen(sloped: Fit, hertzian: Fit) -> Fit:
    """Return the start that is believed; its error holds how far the other one lies off, as likely as that one is."""
    found, other = (hertzian, sloped) if _is_hertzian(sloped, hertzian) else (sloped, hertzian)
    weight = 1 / (1 + float(np.exp(np.clip((other.chi2 - found.chi2) / 2, -50, 50))))
    apart_mm = weight * (other.contact_mm - found.contact_mm)
    return replace(found, se_mm=float(np.hypot(found.se_mm, apart_mm)))


def _is_hertzian(sloped: Fit, hertzian: Fit) -> bool:
    """Believe a Hertzian start where it fits clearly better, or as well on a curve that bends upwards at once."""
    bend, bend_se = sloped.coefficients[3], float(np.sqrt(sloped.covariance[3, 3]))
    upwards = bend > 3 * bend_se
    return hertzian.chi2 < sloped.chi2 - CLEARLY or bool(upwards and hertzian.chi2 < sloped.chi2 + 2)


def _scan(
    u: Reals, f: Reals, around_mm: float, before_mm: float, after_mm: float, powers: tuple[float, ...], free: Free
) -> Fit:
    """Return the least-squares fit over the contact point: a scan, then a refinement by halving."""
    low = max(float(u[FREE_MIN // 2]), around_mm - before_mm)
    high = max(min(around_mm + after_mm, float(u[-2 * len(powers)])), low + 0.1)
    grid = np.linspace(low, high, max(9, round((high - low) / 0.08)))
    step = grid[1] - grid[0]
    costs = [_cost(u, f, c, powers, free) for c in grid]
    # Of a flat valley the curvature at its bottom says too little: what lies within 2σ of the best counts.
    likely = grid[np.array(costs) < min(costs) + 4 * free.noise_N**2]
    valley_mm = float(np.ptp(likely)) / 4
    middle = float(grid[int(np.argmin(costs))])
    while step > 1e-3:
        step /= 2.5
        trial = [middle + k * step for k in (-2, -1, 0, 1, 2)]
        costs = [_cost(u, f, c, powers, free) for c in trial]
        middle = trial[int(np.argmin(costs))]
    return _fit_at(u, f, middle, powers, free, valley_mm)


def _fit_at(u: Reals, f: Reals, contact_mm: float, powers: tuple[float, ...], free: Free, valley_mm: float) -> Fit:
    design, wanted = _system(u, f, contact_mm, powers, free)
    coefficients = np.linalg.lstsq(design, wanted, rcond=None)[0].astype(np.float64)
    if coefficients[RISE] < 0:
        coefficients = np.insert(np.linalg.lstsq(np.delete(design, RISE, 1), wanted, rcond=None)[0], RISE, 0.0)
    residual = wanted - design @ coefficients
    away = np.maximum(u - contact_mm, 1e-9)
    slope = sum(-a * p * away ** (p - 1) * (u > contact_mm) for a, p in zip(coefficients[2:], powers, strict=False))
    jacobian = np.column_stack([design, np.append(slope, 0.0)])
    covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-13) * free.noise_N**2
    se_mm = max(float(np.sqrt(covariance[-1, -1])), valley_mm)
    return Fit(
        contact_mm, powers, coefficients, covariance, se_mm, float(residual @ residual) / free.noise_N**2, len(u)
    )


def _system(u: Reals, f: Reals, contact_mm: float, powers: Sequence[float], free: Free) -> tuple[Reals, Reals]:
    """Return columns and right side; a last row expects the free part to slope by no more than the drift.

    Where that bends nothing is expected of it, and its parabola is the last column: under load it is one with a_2.
    """
    away = np.maximum(u - contact_mm, 0.0)
    design = np.zeros((len(u) + 1, 2 + len(powers) + free.bends))
    design[:-1, 0] = 1.0
    design[:-1, 1] = u - contact_mm
    for k, power in enumerate(powers):
        design[:-1, 2 + k] = away**power
    if free.bends:
        design[:-1, -1] = (u - contact_mm) ** 2
    else:
        design[-1, 1] = free.noise_N / free.drift_N_mm
    return design, np.append(f, 0.0)


def _cost(u: Reals, f: Reals, contact_mm: float, powers: Sequence[float], free: Free) -> float:
    design, wanted = _system(u, f, contact_mm, powers, free)
    # Normal equations: four times faster than an orthogonal solution, and the columns are scaled to keep them sound.
    scaled = design / (np.sqrt((design**2).sum(axis=0)) + 1e-300)
    square, right = scaled.T @ scaled + 1e-12 * np.eye(scaled.shape[1]), scaled.T @ wanted
    weights = np.linalg.solve(square, right)
    if weights[RISE] < 0:
        # No specimen pulls the indenter in where it is touched: such a fit follows the noise before contact.
        less = np.delete(np.delete(square, RISE, 0), RISE, 1)
        weights = np.insert(np.linalg.solve(less, np.delete(right, RISE)), RISE, 0.0)
    rising = slice(int(np.searchsorted(u, contact_mm)), int(np.searchsorted(u, free.rise_mm)))
    loaded = slice(RISE, RISE + len(powers))
    residual = wanted - scaled @ weights
    falls = _falls_back(scaled[rising, loaded] @ weights[loaded], FALL_SIGMA * free.noise_N)
    return float(residual @ residual) + falls * NEVER * free.noise_N**2


def _falls_back(load_N: Reals, by_N: float) -> bool:
    """Tell whether a force falls on its way to the sure rise: such a fit follows the noise before contact, too."""
    return len(load_N) > 1 and bool(np.any(np.maximum.accumulate(load_N) - load_N > by_N))


def _opinions(u: Reals, f: Reals, start: int, level_N: float, noise_N: float) -> tuple[tuple[str, float], ...]:
    """Return what the usual estimators say: none of them is used, their spread is shown."""
    found: dict[str, float] = {}
    over = np.flatnonzero(f - level_N > 5 * noise_N)
    runs = over[np.flatnonzero(np.diff(over, append=over[-1:] + 1) == 1)] if len(over) else over
    if len(runs):
        found["threshold"] = float(u[runs[0]])
    top = start + int(np.argmax(f[start:]))
    low, high = level_N + 0.2 * (f[top] - level_N), level_N + 0.5 * (f[top] - level_N)
    part = np.flatnonzero((f[start:top] > low) & (f[start:top] < high)) + start
    if len(part) >= 3 and np.ptp(u[part]) > 0:
        slope, offset = np.polyfit(u[part], f[part], 1)
        if slope > 0:
            found["tangent"] = float((level_N - offset) / slope)
    rise = np.maximum(f[start:top] - level_N, 0.0) ** (2 / 3)
    if len(rise) >= 6:
        slope, offset = np.polyfit(u[start:top], rise, 1)
        if slope > 0:
            found["hertz"] = float(-offset / slope)
    width = max(6, start // 6)
    if width + 2 < top - width:
        centres = np.arange(width, top - width)
        ratio = [np.var(f[k : k + width]) / (np.var(f[k - width : k]) + noise_N**2 / 10) for k in centres]
        found["variance_ratio"] = float(u[centres[int(np.argmax(ratio))]])
    return tuple(sorted(found.items()))
