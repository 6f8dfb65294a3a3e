"""How well a pose fits, on one measure for all of them, in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.foreign import nearest, spacing_of
from fabctl.scan.refine import Fit
from fabctl.scan.similarity import Similarity
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

KEEP_CLOUD_FRAC, KEEP_TARGET_FRAC = 0.92, 0.7  # the rest is held at its edge: outliers, and what was not seen
STRAY_RATIO = 0.12  # of the points in the cube about a usual point; a cube with fewer holds stray points
EXPLAINED_FRAC = 0.025  # of the diagonal; a point nearer to the target than this is explained by the pose
PAST_FRAC = 0.005  # of the diagonal; a point farther off the border than this lies past it
WORST_RMS_FRAC = 0.02
LEAST_COVERAGE_FRAC, LEAST_EXPLAINED_FRAC = 0.45, 0.75
SURE_RMS_FRAC, SURE_COVERAGE_FRAC, SURE_EXPLAINED_FRAC = 0.008, 0.55, 0.88


@dataclass(frozen=True, slots=True)
class Judged:
    """A refined pose and how well it fits, all as fractions of the diagonal or of a whole."""

    fit: Fit
    cloud_rms_frac: float
    target_rms_frac: float
    coverage_frac: float  # of the target's area, with a point near it
    explained_frac: float  # of the part's points, near the target
    relation: str = "found by the search"
    past_frac: float = 0.0  # of the part's points, well past the target's border

    @property
    def pose(self) -> Similarity:
        """Return the map from the cloud as read to the target, mm."""
        return self.fit.pose

    @property
    def score_frac(self) -> float:
        """Return one number for the fit in both directions; less is better."""
        return float(np.hypot(self.cloud_rms_frac, self.target_rms_frac) / np.sqrt(2))

    def plausible(self) -> bool:
        """Return whether the cloud can be a scan of the target in this pose at all."""
        return (
            max(self.cloud_rms_frac, self.target_rms_frac) < WORST_RMS_FRAC
            and self.coverage_frac > LEAST_COVERAGE_FRAC
            and self.explained_frac > LEAST_EXPLAINED_FRAC
        )

    def sure(self) -> bool:
        """Return whether the fit is so good that other parts of the cloud need not be tried."""
        return (
            max(self.cloud_rms_frac, self.target_rms_frac) < SURE_RMS_FRAC
            and self.coverage_frac > SURE_COVERAGE_FRAC
            and self.explained_frac > SURE_EXPLAINED_FRAC
        )


def thin(points: Floats, count: int, seed: int) -> Floats:
    """Return about `count` points spread evenly over the cloud's surface, in random order.

    Where there are enough points to tell, cubes that hold much fewer than usual are left out: spread over a volume,
    stray points would fill as many cubes as the surface.
    """
    if len(points) <= count:
        return points[np.random.default_rng(seed).permutation(len(points))]
    low = points.min(axis=0)
    size = float(np.linalg.norm(np.ptp(points, axis=0))) / 40
    for _ in range(12):
        index = ((points - low) / size).astype(np.int64)
        side = index.max() + 2
        keys = (index[:, 0] * side + index[:, 1]) * side + index[:, 2]
        _, first, held = np.unique(keys, return_index=True, return_counts=True)
        first = first[held >= STRAY_RATIO * np.average(held, weights=held)]
        if 0.8 * count <= len(first) <= 1.5 * count:
            break
        size *= float(np.clip(np.sqrt(len(first) / (1.1 * count)), 0.3, 3.0))
    picked = np.random.default_rng(seed).permutation(first)[:count]
    return np.asarray(points[picked])


def judge(fit: Fit, points: Floats, dense: Floats, target: Target, relation: str = "found by the search") -> Judged:
    """Return how well the fit lays the even samples `points` on the target, and the target on `dense`."""
    size = target.diagonal_mm
    placed = fit.pose(points)
    found = target.closest(placed)
    away = np.linalg.norm(placed - found.points_mm, axis=1) / size
    grid = target.search
    samples = grid.grid.points[:3000]
    image = (fit.pose(dense) - target.centre_mm) / size
    tree = cKDTree(image)
    distance, at = nearest(tree, samples)
    reach = max(3 * spacing_of(tree, image[:2000]), 0.012)
    near = distance < reach
    across = np.abs(np.sum((image[at] - samples) * grid.normals[:3000], axis=1))
    back = np.where(near, across, distance)
    return Judged(
        fit,
        _held_rms(away, KEEP_CLOUD_FRAC),
        _held_rms(back, KEEP_TARGET_FRAC),
        float(near.mean()),
        float((away < EXPLAINED_FRAC).mean()),
        relation,
        float((found.on_border & (away > PAST_FRAC)).mean()),
    )


def _held_rms(values: Floats, keep_frac: float) -> float:
    return float(np.sqrt(np.mean(np.minimum(values, np.quantile(values, keep_frac)) ** 2)))
