"""Where the cloud ends against where the target ends: what holds a surface that could slide in itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.clean import Plane
from fabctl.scan.foreign import nearest
from fabctl.scan.nearest import farthest_order
from fabctl.scan.similarity import Similarity, jacobian
from fabctl.scan.target import Target

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

REACH_FRAC = 0.05  # of the diagonal; how far from the border points may tell where the cloud's edge is
REACH_FIRST_FRAC = 0.14  # likewise at first, while the surface may still have to slide
QUANTILE = 0.96
STRETCHES = 120
LEAST_STRETCHES, LEAST_POINTS = 6, 25
SLACK_FRAC = 0.006  # of the diagonal; how far inside the true border a cloud's edge usually lies
SLACK_ON_TABLE_FRAC = 0.05  # likewise where cleaning the table away cut the specimen's foot off
ON_TABLE_TOPS = 2.0  # a border lower than this many heights of the table's top stands on it


@dataclass(frozen=True, slots=True)
class Rest:
    """The table the specimen stands on, in cloud units, and up to which height points were taken for it."""

    table: Plane
    top_cu: float


@dataclass(frozen=True, slots=True)
class Rim:
    """Equations `residual + jacobian @ x - offset of the loop = 0`, one for each stretch of border that shows.

    Every closed loop of the border has an offset of its own, unknown within `slack_frac`: a cloud's edge is always
    a little inside the true one, and more so where it stood on the table.
    """

    jacobian: Floats  # (k, 7)
    residual: Floats  # (k,), of the diagonal; positive where the cloud reaches past the border
    loop: Ints  # (k,)
    slack_frac: Floats  # (loops,)
    reach_frac: float


def rim_rows(
    points: Floats, pose: Similarity, target: Target, reach_frac: float = REACH_FRAC, rest: Rest | None = None
) -> Rim | None:
    """Return the rim's equations for the cloud's `points` (n, 3) under `pose`, or None where no rim shows.

    The edge is a high quantile of how far out the points near a stretch lie; where the cloud ends well inside there
    is none, so holes elsewhere do not matter.
    """
    border, size = target.border, target.diagonal_mm
    if border is None:
        return None
    placed = pose(points)
    distance, at = nearest(cKDTree(border.points_mm), placed, reach_frac * size)
    near = np.isfinite(distance)
    gap, at = placed[near] - border.points_mm[at[near]], at[near]
    level = np.abs(np.sum(gap * border.normals[at], axis=1)) < 0.4 * reach_frac * size
    gap, at = gap[level], at[level]
    stretch_of = stretches(border.points_mm, border.loop, max(8, min(STRETCHES, len(gap) // 40)))
    out, stretch = np.sum(gap * border.outward[at], axis=1) / size, stretch_of[at]
    count = np.bincount(stretch, minlength=stretch_of.max() + 1)
    used = np.flatnonzero(count >= LEAST_POINTS)
    if len(used) < LEAST_STRETCHES:
        return None
    order = np.lexsort((out, stretch))
    ends = np.searchsorted(stretch[order], np.arange(len(count) + 1))
    edge = out[order][ends[used] + (QUANTILE * (count[used] - 1)).astype(int)]
    places = np.stack([_mean_by(border.points_mm[:, k], stretch_of)[used] for k in range(3)], axis=1)
    outward = np.stack([_mean_by(border.outward[:, k], stretch_of)[used] for k in range(3)], axis=1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    loop = np.rint(_mean_by(border.loop.astype(float), stretch_of)[used]).astype(np.int64)
    J = jacobian((places - target.centre_mm) / size, outward)
    return Rim(J, edge, loop, _slack(target, pose, rest), reach_frac)


def _slack(target: Target, pose: Similarity, rest: Rest | None) -> Floats:
    border = target.border
    assert border is not None
    loops = int(border.loop.max()) + 1
    if rest is None:
        return np.full(loops, SLACK_FRAC)
    height = rest.table.height(pose.inverse()(border.points_mm))
    low = (height < ON_TABLE_TOPS * rest.top_cu).astype(float)
    share = np.bincount(border.loop, low, minlength=loops) / np.bincount(border.loop, minlength=loops)
    return np.where(share > 0.2, SLACK_ON_TABLE_FRAC, SLACK_FRAC)


def stretches(points: Floats, loop: Ints, count: int) -> Ints:
    """Return for each border sample the number of its stretch; a stretch never spans two loops."""
    found = np.empty(len(points), dtype=np.int64)
    done = 0
    for k in range(int(loop.max()) + 1):
        mine = loop == k
        share = max(4, round(count * float(mine.mean())))
        centres = points[mine][farthest_order(points[mine], share)]
        found[mine] = done + nearest(cKDTree(centres), points[mine])[1]
        done = int(found[mine].max()) + 1
    return found


def _mean_by(values: Floats, group: Ints) -> Floats:
    return np.asarray(np.bincount(group, values) / np.maximum(np.bincount(group), 1))
