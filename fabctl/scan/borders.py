"""What the target's border says about a pose: a cloud must end where the surface ends, and go on where it goes on.

A hole in a surface of revolution hardly shows in a distance, yet it alone tells how the surface is turned. Points where
there is no target speak against a pose, and cannot be explained by what was not seen. That the cloud ends along a loop
of the border only speaks for a pose: a gap in a scan can have any shape, so it never decides alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.similarity import Similarity, rotation_of
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

REACH_FRAC = 0.02  # of the diagonal; how far inside and outside the border points are asked for
LOOP_SHARE = 0.2  # likewise of a loop's own width, for small holes
PLACE_RATIO, RADIUS_RATIO = 1.2, 0.8  # of the reach: where the balls lie and how wide they are
LEAST_POINTS = 8.0  # a ball should usually hold, or the cloud is too thin to say where it ends
SEEN_RATIO, EMPTY_RATIO = 0.4, 0.15  # of the usual number of points in a ball
REFUTED, FREE, BORNE_OUT = 0.2, 0.05, 0.5  # shares of a loop
SPINS = 120
ANGLES_KEPT = 3


@dataclass(frozen=True, slots=True)
class Borne:
    """For each loop of the border: the share of it that the cloud ends at, and the share that the cloud crosses."""

    ends_frac: Floats  # (loops,)
    crossed_frac: Floats  # (loops,)

    def total(self) -> float:
        """Return one number; more is better."""
        return float((self.ends_frac - self.crossed_frac).sum())

    def contradicted(self) -> bool:
        """Return whether the cloud goes on where the surface should end, which nothing unseen can explain."""
        return bool(self.crossed_frac.max() > REFUTED)

    def free(self) -> bool:
        """Return whether hardly any of the border is crossed, and some of every loop is where the cloud ends."""
        return bool(self.crossed_frac.max() < FREE and self.ends_frac.min() > BORNE_OUT)


def borne_out(cloud: cKDTree, pose: Similarity, target: Target) -> Borne | None:
    """Return what the border says of `pose`; `cloud` holds the part's points as read. None where it cannot say."""
    border = target.border
    if border is None:
        return None
    loops = int(border.loop.max()) + 1
    width = np.array([np.linalg.norm(np.ptp(border.points_mm[border.loop == k], axis=0)) for k in range(loops)])
    reach = np.minimum(REACH_FRAC * target.diagonal_mm, LOOP_SHARE * width)[border.loop]
    back, area = pose.inverse(), (RADIUS_RATIO * reach) ** 2
    counts = [
        cloud.query_ball_point(
            back(border.points_mm + (side * PLACE_RATIO * reach)[:, None] * border.outward),
            RADIUS_RATIO * reach * back.scale_ratio,
            return_length=True,
        )
        for side in (-1.0, 1.0)
    ]
    inside, outside = np.asarray(counts[0]) / area, np.asarray(counts[1]) / area
    seen_any = inside[inside > 0]
    usual = float(np.median(seen_any)) if len(seen_any) else 0.0
    if usual * float(area.min()) < LEAST_POINTS:
        return None
    seen = inside > SEEN_RATIO * usual
    ends, crossed = seen & (outside < EMPTY_RATIO * usual), outside > SEEN_RATIO * usual
    number = np.bincount(border.loop, minlength=loops)
    return Borne(
        np.bincount(border.loop, ends.astype(float), minlength=loops) / number,
        np.bincount(border.loop, crossed.astype(float), minlength=loops) / number,
    )


@dataclass(frozen=True, slots=True)
class Circle:
    """A pose turned all round the axis of a motion that the surface hardly holds, and what the border says of each."""

    poses: tuple[Similarity, ...]
    said: tuple[Borne | None, ...]

    def likeliest(self) -> list[Similarity]:
        """Return the turns where the border is borne out best."""
        n = len(self.poses)
        merit = [-np.inf if s is None else s.total() for s in self.said]
        top = [k for k in range(n) if merit[k] > merit[k - 1] and merit[k] >= merit[(k + 1) % n]]
        return [self.poses[k] for k in sorted(top, key=lambda k: -merit[k])[:ANGLES_KEPT]]

    def open_elsewhere(self) -> bool:
        """Return whether a turn apart from the first pose's own stretch is not contradicted either."""
        refuted = [s is not None and s.contradicted() for s in self.said]
        if not any(refuted):
            return bool(self.said)
        first, last = refuted.index(True), len(refuted) - 1 - refuted[::-1].index(True)
        return not all(refuted[first : last + 1])


def circle(cloud: cKDTree, pose: Similarity, motion: Floats, target: Target) -> Circle:
    """Return the pose turned about the axis of the small `motion` (7,); empty where it hardly turns."""
    turn, shift = motion[:3], motion[3:6]
    size = float(np.linalg.norm(turn))
    if size < 0.5 * float(np.linalg.norm(shift)):
        return Circle((), ())
    centre = target.centre_mm + np.cross(turn, shift) / size**2 * target.diagonal_mm
    turns = [rotation_of(angle * turn / size) for angle in 2 * np.pi * np.arange(SPINS) / SPINS]
    made = tuple(Similarity(r, centre - r @ centre).after(pose) for r in turns)
    return Circle(made, tuple(borne_out(cloud, p, target) for p in made))
