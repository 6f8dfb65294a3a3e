"""The global search: all ways to lay a cloud on the target that fit about as well as the best.

Rotations spread over all of them, each improved by a few robust steps in both directions, the better ones again with
more samples, and so on. Nothing is random here: the same samples give the same poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fabctl.scan.nearest import Effort, NearestGrid, Poses, align, nearest_grid, poses
from fabctl.scan.similarity import Similarity, spread_rotations
from fabctl.scan.target import SearchTarget

Floats = NDArray[np.float64]

ROTATIONS = 500  # about 25 degrees from one to the next; the basin of the first round is wider
GROWTHS_RATIO = (1.0, 0.8)  # what is unseen makes a cloud look smaller than it is: start smaller too
ROUNDS = (  # samples and steps of each round, how many poses survive it, how far apart they must then be
    (Effort(220, 220, 12), 90, 0.06),
    (Effort(900, 900, 16), 30, 0.04),
    (Effort(2000, 2000, 30, keep_cloud_frac=0.92, keep_target_frac=0.7, point_start_ratio=0.1), 12, 0.02),
)


@dataclass(frozen=True, slots=True)
class SearchCloud:
    """A cleaned cloud, centred and of unit size, and how to get there from the cloud as read."""

    grid: NearestGrid
    entering: Similarity  # cloud as read -> cloud of the search


def search_cloud(points: Floats, *, mirrored: bool = False) -> SearchCloud:
    """Return the even samples `(n, 3)` (farthest-point order) ready for the search."""
    centre = points.mean(axis=0)
    size = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))
    flip = np.diag([-1.0, 1.0, 1.0]) if mirrored else np.eye(3)
    entering = Similarity(flip, -(flip @ centre) / size, 1.0 / size)
    return SearchCloud(nearest_grid(entering(points)), entering)


def starts(cloud: SearchCloud, target: SearchTarget, known_ratio: float | None, rotations: int = ROTATIONS) -> Poses:
    """Return the poses to begin with; `known_ratio` is the scale from search cloud to search target, if known."""
    turns = spread_rotations(rotations)
    size = float(np.sqrt((target.grid.points**2).sum(axis=1).mean()))
    scales = [size * g for g in GROWTHS_RATIO] if known_ratio is None else [known_ratio]
    rotation = np.concatenate([turns] * len(scales))
    shift = np.tile(target.grid.points.mean(axis=0), (len(rotation), 1))
    return poses(rotation, shift, np.repeat(scales, len(turns)))


def distinct(found: Poses, samples: Floats, apart: float, most: int) -> NDArray[np.int64]:
    """Return the best poses in order, none nearer than `apart` (rms over the samples) to a better one."""
    places = _places(found, samples)
    kept: list[int] = []
    for k in np.argsort(found.score(), kind="stable"):
        if (np.sum((places[kept] - places[k]) ** 2, axis=1) > apart**2).all():
            kept.append(int(k))
        if len(kept) == most:
            break
    return np.array(kept, dtype=np.int64)


def _places(found: Poses, samples: Floats) -> Floats:
    """Return a point (12,) for each pose, so that the points' distance is the rms distance of the samples' images."""
    middle = samples.mean(axis=0)
    root = np.linalg.cholesky(np.cov(samples.T, bias=True) + 1e-12 * np.eye(3) * np.ptp(samples) ** 2)
    turn = found.scale_ratio[:, None, None] * found.rotation
    return np.concatenate([(turn @ root).reshape(-1, 9), turn @ middle + found.shift], axis=1)


def search(cloud: SearchCloud, target: SearchTarget, known_ratio: float | None, rotations: int = ROTATIONS) -> Poses:
    """Return the distinct poses that survive every round, the best first."""
    found = starts(cloud, target, known_ratio, rotations)
    for effort, most, apart in ROUNDS:
        found = align(found, cloud.grid, target.grid, target.normals, effort, known_ratio is None)
        found = found.take(distinct(found, cloud.grid.points[:200], apart, most))
    return found
