"""How far the scan is from the surface: signed, weighed by area, with what could not be compared counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.foreign import nearest, spacing_of
from fabctl.scan.refine import Fit, patch_medians
from fabctl.scan.similarity import Similarity
from fabctl.scan.target import Target

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

PERCENTILES = (1, 5, 25, 50, 75, 95, 99)
COVER_SAMPLES = 5000
COVER_LEAST_FRAC = 0.01  # of the diagonal; a target sample with a point this near is covered
LONE_LIMIT = 4.0  # times the patch's own scatter: a point that far from its patch's median is a wrong match
CROWD_RATIO = 0.15  # a patch with less than this part of the usual number of points holds only wrong matches
PATCH_RATIO = 0.4  # of the usual number of points; a patch with fewer is the edge of a gap and has no mean
RESAMPLES = 200


@dataclass(frozen=True, slots=True)
class Deviation:
    """The comparison, point by point; the points are those of the specimen, in the target's frame."""

    points_mm: Floats  # (n, 3)
    value_mm: Floats  # (n,), positive on the side the normals point to
    area_weight: Floats  # (n,), sums to 1 over the points that count; 0 for the others
    counts: Mask  # (n,), False: closest to the border, or a wrong match
    on_border: Mask  # (n,)
    lone: Mask  # (n,)
    vertex_mm: Floats  # (vertices,), the mean deviation about each vertex of the target, NaN where nothing was seen
    patch_mm: Floats  # (patches,), means over even patches of the target, NaN where too little was seen
    covered_frac: float  # of the target's area


@dataclass(frozen=True, slots=True)
class Statistics:
    """The numbers of a comparison. Signed unless said otherwise; every point weighs by the area it stands for."""

    points_count: int
    border_count: int
    lone_count: int
    coverage_frac: float
    mean_mm: float
    mean_abs_mm: float
    rms_mm: float
    sigma_mm: float
    p95_abs_mm: float
    max_abs_mm: float
    max_mm: float
    max_place_mm: tuple[float, float, float]
    max_patch_mm: float
    percentiles_mm: dict[str, float]
    within_frac: dict[str, float]
    diagonal_mm: float
    abs_quantiles_mm: tuple[float, ...]  # |deviation| below which 0, 1, ... 100 % of the area lie

    def frac(self, value_mm: float) -> float:
        """Return a length as a fraction of the target's bounding-box diagonal."""
        return value_mm / self.diagonal_mm

    def within(self, tolerance_frac: float) -> float:
        """Return which share of the compared area deviates by at most `tolerance_frac` of the diagonal."""
        share = np.linspace(0, 1, len(self.abs_quantiles_mm))
        return float(np.interp(tolerance_frac * self.diagonal_mm, self.abs_quantiles_mm, share))


def deviate(points: Floats, pose: Similarity, target: Target) -> Deviation:
    """Return the signed deviations of the cloud's `points` (n, 3), as read, under `pose`.

    The sign is that of the closest point's interpolated normal. Points whose closest point lies on the border would
    measure how far the cloud reaches past it, not how far it is off: they are left out and counted. So are lone
    points, farther from the median of their patch than scatter explains.
    """
    placed = pose(points)
    found = target.closest(placed)
    gap = placed - found.points_mm
    side = np.sum(gap * found.normals, axis=1)
    value = np.copysign(np.linalg.norm(gap, axis=1), side)
    # On the surface itself the distance is rounding and has no sign worth keeping; the projection says the same.
    value = np.where(np.abs(side) > 0.999 * np.abs(value), side, value)
    samples, _, _ = target.even_samples(2000)
    tree = cKDTree(samples)
    _, patch = nearest(tree, found.points_mm)
    inner = ~found.on_border
    middle = patch_medians(value[inner], patch[inner], tree.n)[patch]
    off = np.abs(value - middle)
    scatter = patch_medians(off[inner], patch[inner], tree.n)[patch]
    usual = float(np.median(off[inner])) if inner.any() else 0.0
    with np.errstate(invalid="ignore"):
        lone = inner & (off > LONE_LIMIT * 1.4826 * np.maximum(scatter, usual))
    crowd = np.bincount(patch[inner], minlength=tree.n)
    usual_count = float(np.median(crowd[crowd > 0])) if inner.any() else 0.0
    lone |= inner & (crowd[patch] < CROWD_RATIO * usual_count)
    counts = inner & ~lone
    number = np.bincount(patch[counts], minlength=tree.n)
    weight = np.where(counts, 1.0 / np.maximum(number[patch], 1), 0.0)
    weight /= max(weight.sum(), 1e-300)
    patch_mean = np.full(tree.n, np.nan)
    held = number >= max(1.0, PATCH_RATIO * float(np.median(number[number > 0]))) if counts.any() else number > 0
    patch_mean[held] = np.bincount(patch[counts], value[counts], minlength=tree.n)[held] / number[held]
    return Deviation(
        placed,
        value,
        weight,
        counts,
        found.on_border,
        lone,
        _on_vertices(found.faces[counts], found.weights[counts], value[counts], target),
        patch_mean,
        coverage_frac(placed[counts], target),
    )


def _on_vertices(faces: NDArray[np.int64], weights: Floats, value: Floats, target: Target) -> Floats:
    corners = target.mesh.faces[faces]
    count = len(target.mesh.vertices_mm)
    total = np.bincount(corners.ravel(), weights.ravel(), minlength=count)
    sums = np.bincount(corners.ravel(), (weights * value[:, None]).ravel(), minlength=count)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0.3, sums / total, np.nan)


def coverage_frac(placed_mm: Floats, target: Target) -> float:
    """Return how much of the target's area has a point near it."""
    if len(placed_mm) == 0:
        return 0.0
    samples, _, _ = target.even_samples(COVER_SAMPLES)
    some = placed_mm[:: max(1, len(placed_mm) // 200_000)]
    tree = cKDTree(some)
    spacing = spacing_of(tree, some[:: max(1, len(some) // 2000)])
    reach = max(4 * spacing, COVER_LEAST_FRAC * target.diagonal_mm)
    distance, _ = nearest(tree, samples, reach)
    return float(np.isfinite(distance).mean())


def statistics(found: Deviation, target: Target, bands_frac: tuple[float, ...] = (0.0025, 0.005, 0.01)) -> Statistics:
    """Return the numbers; raises `ValueError` where no point can be compared."""
    counts = found.counts
    if not counts.any():
        raise ValueError("no point of the cloud can be compared with the target")
    value, weight = found.value_mm[counts], found.area_weight[counts]
    mean, square = float(weight @ value), float(weight @ value**2)
    most = int(np.argmax(np.abs(value)))
    place = found.points_mm[counts][most]
    patch = found.patch_mm[np.isfinite(found.patch_mm)]
    size = target.diagonal_mm
    ranks = _weighted_quantiles(value, weight, np.array(PERCENTILES) / 100)
    return Statistics(
        points_count=int(counts.sum()),
        border_count=int(found.on_border.sum()),
        lone_count=int(found.lone.sum()),
        coverage_frac=found.covered_frac,
        mean_mm=mean,
        mean_abs_mm=float(weight @ np.abs(value)),
        rms_mm=float(np.sqrt(square)),
        sigma_mm=float(np.sqrt(max(square - mean**2, 0.0))),
        p95_abs_mm=_weighted_quantiles(np.abs(value), weight, np.array([0.95]))[0],
        max_abs_mm=float(abs(value[most])),
        max_mm=float(value[most]),
        max_place_mm=(float(place[0]), float(place[1]), float(place[2])),
        max_patch_mm=float(patch[np.argmax(np.abs(patch))]),
        percentiles_mm={f"p{p:02d}": x for p, x in zip(PERCENTILES, ranks, strict=True)},
        within_frac={f"{band:g}": float(weight[np.abs(value) <= band * size].sum()) for band in bands_frac},
        diagonal_mm=size,
        abs_quantiles_mm=tuple(_weighted_quantiles(np.abs(value), weight, np.linspace(0, 1, 101))),
    )


def _weighted_quantiles(values: Floats, weight: Floats, shares: Floats) -> list[float]:
    order = np.argsort(values)
    reached = np.cumsum(weight[order])
    at = np.minimum(np.searchsorted(reached, shares * reached[-1]), len(order) - 1)
    return [float(x) for x in values[order][at]]


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Standard deviations by resampling whole patches with replacement; `motion_frac` is rms over the target."""

    turn_rad: float
    shift_mm: float
    scale_frac: float
    motion_frac: float
    mean_mm: float
    rms_mm: float


def bootstrap(fit: Fit, target: Target, seed: int, *, free_scale: bool, still: Floats | None = None) -> Uncertainty:
    """Return how much pose, scale and statistics would move with other patches of the same surface.

    Patches, not points, are drawn: neighbouring points share their errors. The fit is linear about its end, so each
    draw is one small system.
    """
    rng = np.random.default_rng([seed, 2])
    rows, count = fit.patches, len(fit.patches.residual)
    arms = target.search.grid.points[:300]
    motions, means, rmses, spans = [], [], [], []
    for _ in range(RESAMPLES if count > 10 else 0):
        drawn = rng.integers(count, size=count)
        J, r, w = rows.jacobian[drawn], rows.residual[drawn], fit.weight[drawn] / max(fit.patch_sigma_frac, 1e-9) ** 2
        A, b = (J * w[:, None]).T @ J, -(J * w[:, None]).T @ r
        if fit.rim is not None:
            pick = rng.integers(len(fit.rim.residual), size=len(fit.rim.residual))
            Jr, v = fit.rim.jacobian[pick], fit.rim_weight[pick] / (fit.rim.reach_frac / 8) ** 2
            e = fit.rim.residual[pick] - np.median(fit.rim.residual)
            A, b = A + (Jr * v[:, None]).T @ Jr, b - (Jr * v[:, None]).T @ e
        if not free_scale:
            A[6, :], A[:, 6], A[6, 6], b[6] = 0.0, 0.0, 1.0, 0.0
        if still is not None:
            A += 1e3 * np.trace(A) * np.outer(still, still)
        x = np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(7), b)
        after = r + J @ x
        motions.append(x)
        means.append(after.mean())
        rmses.append(np.sqrt((after**2).mean()))
        spans.append(np.cross(x[:3], arms) + x[3:6] + x[6] * arms)
    if not motions:
        return Uncertainty(*(float("inf"),) * 6)
    spread = np.std(np.array(motions), axis=0)
    moved = np.array(spans) - np.mean(spans, axis=0)
    size = target.diagonal_mm
    return Uncertainty(
        turn_rad=float(np.linalg.norm(spread[:3])),
        shift_mm=float(np.linalg.norm(spread[3:6])) * size,
        scale_frac=float(spread[6]),
        motion_frac=float(np.sqrt((moved**2).sum(axis=2).mean())),
        mean_mm=float(np.std(means)) * size,
        rms_mm=float(np.std(rmses)) * size,
    )
