"""What the target's border says about a pose: a cloud must end where the surface ends, and go on where it goes on.

A hole in a surface of revolution hardly shows in a distance, yet it alone tells how the surface is turned. Points where
there is no target speak against a pose, and cannot be explained by what was not seen. That the cloud ends along a loop
of the border coarsely only speaks for a pose: a gap in a scan can have any shape. `edges` looks at it closely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.edges import EdgeFinder, Edges
from fabctl.scan.similarity import Similarity, rotation_of
from fabctl.scan.target import Target

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

REACH_FRAC = 0.02  # of the diagonal; how far inside and outside the border points are asked for
LOOP_SHARE = 0.2  # likewise of a loop's own width, for small holes
PLACE_RATIO, RADIUS_RATIO = 1.2, 0.8  # of the reach: where the balls lie and how wide they are
LEAST_POINTS = 8.0  # a ball should usually hold, or the cloud is too thin to say where it ends
SEEN_RATIO, EMPTY_RATIO = 0.4, 0.15  # of the usual number of points in a ball
REFUTED, FREE, BORNE_OUT = 0.2, 0.05, 0.5  # shares of a loop
SPINS = 240
ANGLES_KEPT, APART_RAD = 4, 0.2
OPEN_RAD = 0.3  # the border never tells turns much nearer than this apart by what crosses it


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
    """A pose turned all round an axis about which the surface hardly holds it, and what the border says of each turn.

    Only the turns that the cloud does not contradict are held.
    """

    poses: tuple[Similarity, ...]
    angles_rad: Floats  # of the poses, -pi to pi
    merit: Floats  # of the poses; more is better
    edges: tuple[tuple[Edges, Mask], ...]  # of the poses, with the stretches of border that tell it from the first

    def likeliest(self) -> list[Similarity]:
        """Return the turns where the border is borne out best, well apart, also from the first pose."""
        picked: list[int] = []
        for k in np.argsort(-self.merit, kind="stable"):
            off = np.abs([_angle(self.angles_rad[k] - a) for a in (0.0, *self.angles_rad[picked])])
            if off.min() > APART_RAD and len(picked) < ANGLES_KEPT:
                picked.append(int(k))
        return [self.poses[k] for k in picked]

    def open_elsewhere(self) -> bool:
        """Return whether a turn well away from the first pose is not contradicted either."""
        return bool((np.abs(self.angles_rad) > OPEN_RAD).any())


def _angle(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def rim_axis(target: Target) -> tuple[Floats, Floats] | None:
    """Return point and direction of the axis of the border's longest loop, where there is more than that loop."""
    border = target.border
    if border is None or border.loop.max() == 0:
        return None
    longest = int(np.argmax(np.bincount(border.loop, border.length_mm)))
    mine = border.loop == longest
    points, length = border.points_mm[mine], border.length_mm[mine, None]
    middle = np.asarray((length * points).sum(axis=0) / length.sum())
    return middle, np.linalg.svd(np.sqrt(length) * (points - middle), full_matrices=False)[2][2]


def turn_motion(axis: tuple[Floats, Floats], target: Target) -> Floats:
    """Return the small motion (7,) that turns about the axis; see `refine.Rows`."""
    arm = (axis[0] - target.centre_mm) / target.diagonal_mm
    return np.concatenate([axis[1], np.cross(arm, axis[1]), [0.0]])


def circle(cloud: cKDTree, finder: EdgeFinder, pose: Similarity, axis: tuple[Floats, Floats]) -> Circle:
    """Return the pose turned about the axis, in turns that the cloud, as read, does not contradict."""
    kept, angles, merit, found = [], [], [], []
    for k in range(SPINS):
        turn = rotation_of(2 * np.pi * k / SPINS * axis[1])
        spun = Similarity(turn, axis[0] - turn @ axis[0])
        image = spun.after(pose)
        said = borne_out(cloud, image, finder.target)
        if said is None or said.contradicted():
            continue
        which = finder.telling(spun)
        edges = finder.at(image)
        kept.append(image)
        found.append((edges, which))
        angles.append(_angle(2 * np.pi * k / SPINS))
        merit.append(said.total() + edges.exact_frac(which) - 2 * edges.crossed_frac(which))
    return Circle(tuple(kept), np.array(angles), np.array(merit), tuple(found))
