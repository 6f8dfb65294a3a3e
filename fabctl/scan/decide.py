"""Which of several poses it is, where distances alone cannot tell: datum points, colour, or the border decide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.borders import borne_out, circle, rim_axis
from fabctl.scan.edges import EdgeFinder, clinched
from fabctl.scan.judge import Judged
from fabctl.scan.paint import LUMA, Paint, chosen_by_paint, likeness
from fabctl.scan.symmetry import Symmetries, spin_angle
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

HELD_FRAC = 0.002  # of the diagonal; a motion that the surface does not hold to this is tried
SPIN_STEPS, FINE_STEPS = 180, 21  # turns about an axis of revolution that colours are compared at
ONE_POSE_FRAC = 0.02  # of the diagonal; poses farther apart differ, even where the border does not tell them
APART_RAD = 0.2  # turns nearer to the best one than this are the same


@dataclass(frozen=True, slots=True)
class Datums:
    """Points known in both frames: labelled on the specimen, picked by a person, or markers."""

    labels: tuple[str, ...]
    cloud: Floats  # (k, 3), in the cloud's units
    target_mm: Floats  # (k, 3)


def decide_by_datums(
    candidates: list[Judged], datums: Datums, target: Target, symmetries: Symmetries
) -> tuple[Judged, bool]:
    """Return the candidate that the datum points single out, and whether they do.

    They do where the best candidate's points miss by less than a third of what the next one's do. About the axis of a
    surface of revolution the points also choose the turn.
    """
    placed = [spun_to(j, datums, symmetries) for j in candidates]
    miss = [float(np.sqrt(((j.pose(datums.cloud) - datums.target_mm) ** 2).sum(axis=1).mean())) for j in placed]
    order = np.argsort(miss)
    single = len(order) == 1 or miss[order[0]] < miss[order[1]] / 3
    fits = miss[order[0]] < 0.05 * target.diagonal_mm
    return placed[order[0]], bool(single and fits)


def spun_to(judged: Judged, datums: Datums, symmetries: Symmetries) -> Judged:
    """Return the pose turned about the axis of revolution so that the datum points fit best."""
    if symmetries.axis_point_mm is None or symmetries.axis_direction is None:
        return judged
    angle = spin_angle(judged.pose(datums.cloud), datums.target_mm, symmetries.axis_point_mm, symmetries.axis_direction)
    return replace(judged, fit=replace(judged.fit, pose=symmetries.spin(angle).after(judged.pose)))


def decide_by_border(
    finder: EdgeFinder, tree: cKDTree, candidates: list[Judged], symmetries: Symmetries
) -> Judged | None:
    """Return the one candidate that the border singles out, if it does; `tree` holds the part's points as read.

    Either the cloud contradicts every other turn, or it ends along the border in one pose exactly and in no other
    nearly as well. Poses that hardly move the border are one, and the one where the border fits best stands for them.
    """
    target = finder.target
    edges = [finder.at(j.pose) for j in candidates]
    between = [[finder.telling(b.pose.after(a.pose.inverse())) for b in candidates] for a in candidates]
    tells = np.any(between, axis=(0, 1))
    first = int(np.argmax([e.exact_frac(tells) - e.crossed_frac(tells) for e in edges]))
    mine, telling = candidates[first], between[first]
    apart = [symmetries.apart_frac(mine.pose, j.pose, target) for j in candidates]
    if any(a > ONE_POSE_FRAC and not t.any() for a, t in zip(apart, telling, strict=True)):
        return None
    said = [borne_out(tree, j.pose, target) for j in candidates]
    far = [k for k in range(len(candidates)) if telling[k].any()]
    axis = rim_axis(target)
    turns = None if axis is None else circle(tree, finder, mine.pose, axis)
    only = all((s := said[k]) is not None and s.contradicted() for k in far)
    own = said[first]
    if far and only and own is not None and own.free() and (turns is None or not turns.open_elsewhere()):
        return mine
    others = [(edges[k], telling[k]) for k in far]
    others += [] if turns is None else [e for e in turns.edges if e[1].any()]
    enough = all(finder.long_enough(which) for _, which in others)
    return mine if enough and clinched(edges[first], others) else None


def decide_by_paint(
    candidates: list[Judged],
    paint: Paint,
    points: Floats,
    colours: NDArray[np.uint8],
    target: Target,
    symmetries: Symmetries,
) -> Judged | None:
    """Return the candidate, about an axis of revolution also turned, that the colours single out, if they do."""
    tree, grey = cKDTree(points), colours @ LUMA

    def like(judged: Judged) -> float:
        return likeness(paint, tree, grey, judged.pose, target)

    if symmetries.continuous:
        turned = [_best_spin(j, like, symmetries) for j in candidates]
        candidates = [j for pair in turned for j in pair]
    chosen = chosen_by_paint([like(j) for j in candidates])
    return None if chosen is None else candidates[chosen]


def _best_spin(judged: Judged, like: Callable[[Judged], float], symmetries: Symmetries) -> tuple[Judged, Judged]:
    """Return the pose turned to where the colours agree best, and the best turn that is not near it."""

    def at(angle: float) -> Judged:
        return replace(judged, fit=replace(judged.fit, pose=symmetries.spin(angle).after(judged.pose)))

    angles = 2 * np.pi * np.arange(SPIN_STEPS) / SPIN_STEPS
    found = np.array([like(at(a)) for a in angles])
    top = float(angles[int(np.argmax(found))])
    away = np.abs((angles - top + np.pi) % (2 * np.pi) - np.pi) > APART_RAD
    next_best = float(angles[away][int(np.argmax(found[away]))])
    step = 2 * np.pi / SPIN_STEPS
    fine = top + np.linspace(-step, step, FINE_STEPS)
    return at(float(fine[int(np.argmax([like(at(float(a))) for a in fine]))])), at(next_best)
