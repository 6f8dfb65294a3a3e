"""Which of several poses it is, where distances alone cannot tell: datum points, colour, or the border decide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.borders import borne_out, circle
from fabctl.scan.judge import Judged
from fabctl.scan.paint import LUMA, Paint, chosen_by_paint, likeness
from fabctl.scan.refine import Options, weak_motions
from fabctl.scan.symmetry import Symmetries, spin_angle
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

HELD_FRAC = 0.002  # of the diagonal; a motion that the surface does not hold to this is tried
SPIN_STEPS, FINE_STEPS = 180, 21  # turns about an axis of revolution that colours are compared at
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


def decide_by_border(tree: cKDTree, candidates: list[Judged], target: Target, options: Options) -> Judged | None:
    """Return the one candidate that the border does not contradict, if every other turn is contradicted.

    `tree` holds the part's points as read.
    """
    said = [borne_out(tree, j.pose, target) for j in candidates]
    left = [k for k, s in enumerate(said) if s is None or not s.contradicted()]
    if len(left) != 1:
        return None
    mine, borne = candidates[left[0]], said[left[0]]
    weak = weak_motions(mine.fit, target, options, HELD_FRAC)
    others = [circle(tree, mine.pose, motion, target) for motion in weak]
    doubt = any(c.open_elsewhere() for c in others)
    return mine if borne is not None and borne.free() and not doubt else None


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
