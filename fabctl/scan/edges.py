"""How exactly the cloud ends along the border of the target: stretch by stretch, to about the spacing of its points.

A gap of a scan can have any shape, so that it ends along a long piece of the border to within a point's spacing, at one
distance all along, hardly ever happens by chance. That is what may decide a turn that the surface itself does not hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.foreign import nearest
from fabctl.scan.rim import stretches
from fabctl.scan.similarity import Similarity
from fabctl.scan.target import Target

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

DENSITY_SAMPLES, DENSITY_REACH_FRAC = 1500, 0.03
WINDOW, LENGTH = 5.0, 5.0  # spacings to either side of the border that are looked at, and of border in a stretch
LEVEL = 0.6  # of the window; points farther off the surface belong to something else
INSIDE = 0.3  # of the window; what lies farther in tells whether the surface was seen up to here
SEEN_RATIO = 0.4  # of the usual density
EXACT = 1.0  # spacings; an edge this near to where the others are is the border's own
OFFSETS = np.arange(-1.5, 0.05, 0.1)  # spacings; a scan's edges lie a little inside the border, all alike
PAST = 2.5  # spacings; a cloud that reaches past the border by more goes on
STRAY_SHARE = 0.04  # of a stretch's points may be stray
LEAST_STRETCHES, LEAST_IN_STRETCH = 12, 4
LEAST_LENGTH = 100.0  # spacings of border that must tell two poses apart
CLINCHED, NEXT_RATIO, CROSSED = 0.45, 0.6, 0.1


@dataclass(frozen=True, slots=True)
class Edges:
    """For each stretch of the border: whether the cloud was seen up to it, and where it ends."""

    seen: Mask  # (k,)
    edge: Floats  # (k,), spacings past the border; NaN where there are too few points to say

    def exact_frac(self, which: Mask) -> float:
        """Return the share of the stretches `which` where the cloud ends at the border, at one distance for all."""
        said = self.edge[which & self.seen & np.isfinite(self.edge)]
        if not which.any() or len(said) < LEAST_IN_STRETCH:
            return 0.0
        hits = (np.abs(said[:, None] - OFFSETS) < EXACT).sum(axis=0)
        return float(hits.max() / which.sum())

    def crossed_frac(self, which: Mask) -> float:
        """Return the share of the stretches `which` where the cloud goes on past the border."""
        past = np.nan_to_num(self.edge, nan=-np.inf) > PAST
        return float((past & self.seen & which).sum() / max(1, which.sum()))


@dataclass(frozen=True)
class EdgeFinder:
    """A cloud's points, to be asked under any pose where they end along the target's border."""

    points: Floats  # (n, 3), as read
    target: Target
    samples: cKDTree  # of the border
    spacing_mm: float
    stretch: Ints  # (border samples,)
    loop: Ints  # (k,), of each stretch
    length_mm: Floats  # (k,)

    def at(self, pose: Similarity) -> Edges:
        """Return where the cloud ends under `pose`."""
        border, window = self.target.border, WINDOW * self.spacing_mm
        assert border is not None
        placed = pose(self.points)
        distance, at = nearest(self.samples, placed, 1.2 * window)
        near = np.isfinite(distance)
        gap, at = placed[near] - border.points_mm[at[near]], at[near]
        out = np.sum(gap * border.outward[at], axis=1)
        level = np.abs(np.sum(gap * border.normals[at], axis=1)) < LEVEL * window
        kept = level & (np.abs(out) < window)
        out, stretch = out[kept], self.stretch[at[kept]]
        inner = np.bincount(stretch[out < -INSIDE * window], minlength=len(self.loop))
        usual = (1 - INSIDE) * window * self.length_mm / self.spacing_mm**2
        return Edges(inner > SEEN_RATIO * usual, self._ends(out, stretch) / self.spacing_mm)

    def _ends(self, out: Floats, stretch: Ints) -> Floats:
        order = np.lexsort((-out, stretch))
        first = np.searchsorted(stretch[order], np.arange(len(self.loop) + 1))
        count = np.diff(first)
        rank = np.minimum((STRAY_SHARE * count).astype(int) + 1, np.maximum(count - 1, 0))
        found = np.full(len(count), np.nan)
        held = count >= LEAST_IN_STRETCH
        found[held] = out[order][(first[:-1] + rank)[held]]
        return found

    def telling(self, between: Similarity) -> Mask:
        """Return which stretches belong to loops that the motion `between`, of the target, carries off the border."""
        border = self.target.border
        assert border is not None
        away, _ = nearest(self.samples, between(border.points_mm))
        loops = int(border.loop.max()) + 1
        mean = np.bincount(border.loop, away, minlength=loops) / np.bincount(border.loop, minlength=loops)
        return np.asarray((mean > 0.6 * WINDOW * self.spacing_mm)[self.loop])

    def long_enough(self, which: Mask) -> bool:
        """Return whether the stretches `which` are long against the points' spacing: else chance may fit them."""
        return float(self.length_mm[which].sum()) > LEAST_LENGTH * self.spacing_mm


def edge_finder(points: Floats, pose: Similarity, target: Target) -> EdgeFinder | None:
    """Return what asks the part's `points` (n, 3), as read; `pose` is any good one. None without a border."""
    border = target.border
    if border is None:
        return None
    samples, _, _ = target.even_samples(DENSITY_SAMPLES)
    reach = DENSITY_REACH_FRAC * target.diagonal_mm
    count = np.asarray(cKDTree(pose(points)).query_ball_point(samples, reach, return_length=True))
    if not count.any():
        return None
    spacing = float(np.sqrt(np.pi * reach**2 / np.median(count[count > 0])))
    loops = np.bincount(border.loop)
    whole = float(border.length_mm.sum())
    least = LEAST_STRETCHES * len(border.loop) / loops.min()
    number = int(min(max(whole / (LENGTH * spacing), least), len(border.loop) / 2))
    stretch = stretches(border.points_mm, border.loop, number)
    length = np.bincount(stretch, border.length_mm).astype(np.float64)
    loop = np.zeros(len(length), dtype=np.int64)
    loop[stretch] = border.loop
    return EdgeFinder(points, target, cKDTree(border.points_mm), spacing, stretch, loop, length)


def clinched(mine: Edges, others: list[tuple[Edges, Mask]]) -> bool:
    """Return whether the cloud ends along the border in one pose exactly, and in no other nearly as well.

    `others` hold the edges of every other pose and the stretches that tell it from the first. A pose that the cloud
    goes on past the border of is no rival.
    """
    for theirs, which in others:
        exact = mine.exact_frac(which)
        if exact < CLINCHED or mine.crossed_frac(which) > CROSSED:
            return False
        refuted = theirs.crossed_frac(which) > 2 * CROSSED
        if not refuted and theirs.exact_frac(which) > NEXT_RATIO * exact:
            return False
    return bool(others)
