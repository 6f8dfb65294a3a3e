"""How far a deployed sheet is from its target: rigid alignment without scale, then distances both ways of counting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design.deploy.shell import Ints, Reals
from design.surface import TriMesh

REFINEMENTS = 30  # rounds of closest points; stops earlier once the pose stands still
FREE_RATIO = 0.03  # a motion that changes distances by less than this of the strongest one is left alone


@dataclass(frozen=True, slots=True)
class Deviation:
    """Distances of the aligned shape from the target.

    `mean_mm`, `rms_mm`, `max_mm` are from points spread evenly over the units to the nearest target point;
    `points_rms_mm` is between corresponding points (lattice vertex and the place it was designed for), if known.
    """

    mean_mm: float
    rms_mm: float
    max_mm: float
    mean_frac: float  # of the target's bounding-box diagonal
    points_rms_mm: float | None


def kabsch(source_mm: Reals, goal_mm: Reals, weights: Reals | None = None) -> tuple[Reals, Reals]:
    """Return rotation `(3, 3)` and shift `(3,)` that bring source to goal, no mirror; Kabsch 1976."""
    w = np.ones(len(source_mm)) if weights is None else weights
    a, b = np.average(source_mm, axis=0, weights=w), np.average(goal_mm, axis=0, weights=w)
    u, _, vt = np.linalg.svd((source_mm - a).T @ (w[:, None] * (goal_mm - b)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u @ flip @ vt).T
    return rotation, b - rotation @ a


def surface_samples(x_mm: Reals, cells: Ints) -> tuple[Reals, Reals]:
    """Return four points a unit `(4m, 3)`, each for an equal part of it, with their areas `(4m,)`."""
    corners = x_mm[cells]
    inner = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]], float)
    inner /= inner.sum(axis=1, keepdims=True)
    points = np.einsum("pk,mkd->mpd", inner, corners).reshape(-1, 3)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return points, np.repeat(area / 4, 4)


def closest(points_mm: Reals, target: TriMesh) -> tuple[Reals, Reals, Reals]:
    """Return distances `(k,)`, nearest target points `(k, 3)` and the normals of their faces `(k, 3)`."""
    import igl

    squared, face, nearest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points_mm), target.vertices_mm, target.faces
    )
    a, b, c = (target.vertices_mm[target.faces[face, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.sqrt(squared), nearest, normal


def align(x_mm: Reals, cells: Ints, target: TriMesh, design_mm: Reals | None) -> Reals:
    """Return the shape `(n, 3)` moved rigidly onto the target.

    Corresponding points `design_mm` give the pose; without them `x_mm` must lie near it already. It is then refined
    by closest points (point to plane, Chen and Medioni 1992), which ends on the least distance to the surface.
    """
    x = x_mm
    if design_mm is not None:
        rotation, shift = kabsch(x, design_mm)
        x = x @ rotation.T + shift
    best, best_error = x, np.inf
    for _ in range(REFINEMENTS):
        points, area = surface_samples(x, cells)
        distance, nearest, normal = closest(points, target)
        error = float(np.sqrt(np.average(distance**2, weights=area)))
        if error < best_error:
            gain = best_error - error
            best, best_error = x, error
            if gain < 1e-7 * target.diagonal_mm():
                break
        else:
            break
        x = _moved(x, points, nearest, normal, area)
    return best


def _moved(x: Reals, points: Reals, nearest: Reals, normal: Reals, area: Reals) -> Reals:
    """Return `x` after one point-to-plane step, its rotation made exact."""
    pivot = points.mean(axis=0)
    lever = np.cross(points - pivot, normal)
    weight = np.sqrt(area)[:, None]
    gap = np.sum((nearest - points) * normal, axis=1)
    size = float(np.ptp(points, axis=0).max())
    system = np.hstack([lever / size, normal]) * weight
    # A sphere turns in itself: directions that change nothing get no motion.
    answer = np.linalg.lstsq(system, gap * weight[:, 0], rcond=FREE_RATIO)[0]
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(answer[:3] / size).as_matrix()
    return np.asarray((x - pivot) @ turn.T + pivot + answer[3:])


def deviation(x_mm: Reals, cells: Ints, target: TriMesh, design_mm: Reals | None = None) -> Deviation:
    """Return the distances of a shape that is already aligned."""
    points, area = surface_samples(x_mm, cells)
    distance = closest(points, target)[0]
    rms = float(np.sqrt(np.average(distance**2, weights=area)))
    mean = float(np.average(distance, weights=area))
    pairs = None
    if design_mm is not None:
        rotation, shift = kabsch(x_mm, design_mm)
        pairs = float(np.sqrt(np.mean(np.sum((x_mm @ rotation.T + shift - design_mm) ** 2, axis=1))))
    return Deviation(mean, rms, float(distance.max()), mean / target.diagonal_mm(), pairs)
