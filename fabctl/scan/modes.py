"""Alignment modes as metrologists know them: from the pose that was found, the same cloud laid on by other rules."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.errors import UsageError
from fabctl.scan.foreign import nearest
from fabctl.scan.refine import Fit, refine
from fabctl.scan.register import FINAL_POINTS, Task
from fabctl.scan.rim import REACH_FRAC
from fabctl.scan.similarity import Similarity, axis_and_angle, best_similarity, rotation_of
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

Mode = Literal["best-fit", "least-squares", "datum", "rim", "gravity-and-rim"]
UP = np.array([0.0, 0.0, 1.0])  # targets stand with z up
LEAST_RIM_POINTS = 200


def aligned_by(mode: Mode, task: Task, points: Floats, found: Fit) -> Fit:
    """Return the fit of the specimen's `points` (n, 3), as read, by the rules of `mode`, starting from `found`.

    `least-squares`: every patch counts the same, deviating or not. `datum`: the datum points alone. `rim`: only what
    lies near the border. `gravity-and-rim`: the table's normal is up, only the turn about it and the place are free,
    and the rim decides them. Raises `UsageError` where the mode's own input is missing.
    """
    some = points[:: max(1, len(points) // FINAL_POINTS)]
    options = task.options
    if mode == "least-squares":
        return refine(some, found.pose, task.target, replace(options, weighting="least-squares"))
    if mode == "datum":
        if task.datums is None:
            raise UsageError("--mode datum needs datum points (--datum and --datum-target)")
        pose = best_similarity(task.datums.cloud, task.datums.target_mm, scale_ratio=task.scale_ratio)
        return replace(found, pose=pose)
    if mode == "rim":
        return refine(near_rim(some, found.pose, task.target), found.pose, task.target, options)
    if mode == "gravity-and-rim":
        if task.cleaned.table is None:
            raise UsageError("--mode gravity-and-rim needs the table in the scan; none was found")
        start = upright(found.pose, task.cleaned.table.normal, task.target)
        only_about_up = replace(options, free=(False, False, True, True, True, True))
        return refine(near_rim(some, start, task.target), start, task.target, only_about_up)
    return found


def near_rim(points: Floats, pose: Similarity, target: Target) -> Floats:
    """Return the points that lie near the target's border; raises `UsageError` where too few do."""
    if target.border is None:
        raise UsageError("the target has no border, so it cannot be aligned by its rim")
    distance, _ = nearest(cKDTree(target.border.points_mm), pose(points), REACH_FRAC * target.diagonal_mm)
    kept = points[np.isfinite(distance)]
    if len(kept) < LEAST_RIM_POINTS:
        raise UsageError(f"only {len(kept)} points lie near the rim; {LEAST_RIM_POINTS} are needed to align by it")
    return kept


def upright(pose: Similarity, up: Floats, target: Target) -> Similarity:
    """Return the pose tilted about the target's centre so that the table's normal `up` (in the cloud) points up."""
    shown = pose.rotation @ up
    goal = UP if float(shown @ UP) >= 0 else -UP
    axis = np.cross(shown, goal)
    angle = float(np.arctan2(np.linalg.norm(axis), shown @ goal))
    turn = rotation_of(angle * axis / max(float(np.linalg.norm(axis)), 1e-300))
    centre = target.centre_mm
    return Similarity(turn, centre - turn @ centre).after(pose)


def tilt_rad(one: Similarity, other: Similarity) -> float:
    """Return the angle between two poses."""
    return axis_and_angle(one.rotation @ other.rotation.T)[1]
