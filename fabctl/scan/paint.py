"""Colour as a decider between poses: what the specimen looks like must lie where it lay when it was last seen.

The reference is a coloured PLY in the target's frame: the target itself with painted vertices, or `colours.ply` of an
earlier scan of the same specimen. Light and exposure change between scans, so brightness is compared by correlation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.errors import UsageError
from fabctl.scan.cloud import read_painted
from fabctl.scan.foreign import nearest
from fabctl.scan.similarity import Similarity
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

PLACES = 6000  # of the reference, compared
REACH_FRAC = 0.008  # of the diagonal; farther neighbours say nothing about a place
LEAST_COMMON = 300
LEAST_CORRELATION_RATIO = 0.35  # the chosen pose's
LEAST_LEAD_RATIO = 0.2  # over the next pose's
LEAST_CONTRAST = 4.0  # of 255, standard deviation; below it the reference is one colour
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601


@dataclass(frozen=True, slots=True)
class Paint:
    """How bright the specimen is, where on the target."""

    points_mm: Floats  # (n, 3), in the target's frame
    grey: Floats  # (n,), 0 to 255


def paint_of(points_mm: Floats, colours: NDArray[np.uint8]) -> Paint | None:
    """Return the reference, thinned, or None where it is all of one colour."""
    step = max(1, len(points_mm) // PLACES)
    grey = colours[::step] @ LUMA
    return Paint(points_mm[::step], grey) if float(grey.std()) >= LEAST_CONTRAST else None


def read_paint(path: Path) -> Paint:
    """Return the reference in the file; raises `UsageError` where it has no colours that differ."""
    points, colours = read_painted(path)
    found = None if colours is None else paint_of(points, colours)
    if found is None:
        raise UsageError(f"{path}: has no colours that could tell one pose from another")
    return found


def likeness(paint: Paint, tree: cKDTree, grey: Floats, pose: Similarity, target: Target) -> float:
    """Return the correlation of brightness under `pose`, -1 to 1; `tree` and `grey` are the cloud's, as read."""
    back = pose.inverse()
    distance, at = nearest(tree, back(paint.points_mm), REACH_FRAC * target.diagonal_mm * back.scale_ratio)
    near = np.isfinite(distance)
    if near.sum() < LEAST_COMMON:
        return 0.0
    a, b = paint.grey[near], grey[at[near]]
    spread = float(a.std() * b.std())
    return float(((a - a.mean()) * (b - b.mean())).mean()) / spread if spread > 1e-9 else 0.0


def chosen_by_paint(like: list[float]) -> int | None:
    """Return which pose the colours single out, or None where none stands out."""
    order = np.argsort(like)[::-1]
    best = float(like[order[0]])
    lead = best - float(like[order[1]]) if len(order) > 1 else best
    return int(order[0]) if best >= LEAST_CORRELATION_RATIO and lead >= LEAST_LEAD_RATIO else None
