"""Alignment modes, scale from markers, repeatability, datum points."""

from __future__ import annotations

import numpy as np
import pytest

from fabctl.errors import RefusedError, UsageError
from fabctl.scan.clean import Cells, Cleaned, Plane
from fabctl.scan.decide import Datums
from fabctl.scan.markers import scale_from_board
from fabctl.scan.modes import aligned_by, tilt_rad, upright
from fabctl.scan.refine import Options, refine
from fabctl.scan.register import Task
from fabctl.scan.repeat import repeatability
from fabctl.scan.similarity import IDENTITY, Similarity, rotation_of
from fabctl.scan.symmetry import Symmetries
from fabctl.scan.target import Target

NONE = Symmetries((), None, None)


def task(target: Target, points: np.ndarray, table: Plane | None = None, datums: Datums | None = None) -> Task:
    empty = np.zeros(0, dtype=np.int64)
    cells = Cells(1.0, empty, np.zeros((0, 3)), empty, empty)
    cleaned = Cleaned(cells, table, 0.0, np.zeros(0, dtype=bool), np.zeros(0, dtype=bool), empty, ())
    return Task(points, cleaned, target, NONE, scale_ratio=1.0, datums=datums)


def bumped(target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the target with a bump of 1 % of the diagonal, and the bump's height at each."""
    points, normals, _ = target.even_samples(20_000)
    size = target.diagonal_mm
    away = np.linalg.norm(points - points[0], axis=1) / (0.06 * size)
    height = 0.01 * size * np.exp(-0.5 * away**2)
    noise = np.random.default_rng(3).normal(0, 0.0015 * size, len(points))
    seen = points @ np.array([0.6, 0.8, 0.0]) < np.quantile(points @ np.array([0.6, 0.8, 0.0]), 0.7)
    seen |= away < 2
    return (points + (height + noise)[:, None] * normals)[seen], height[seen]


def test_a_bump_does_not_drag_the_robust_fit_but_does_drag_least_squares(freeform_target: Target) -> None:
    points, height = bumped(freeform_target)
    size = freeform_target.diagonal_mm
    robust = refine(points, IDENTITY, freeform_target, Options(free_scale=False))
    plain = refine(points, IDENTITY, freeform_target, Options(free_scale=False, weighting="least-squares"))
    moved = [float(np.linalg.norm(f.pose(points) - points, axis=1).max()) / size for f in (robust, plain)]
    assert moved[0] < 0.0015
    assert moved[1] > 3 * moved[0]
    found = freeform_target.closest(robust.pose(points))
    value = np.sum((robust.pose(points) - found.points_mm) * found.normals, axis=1)
    top = height > 0.9 * height.max()
    assert value[top].mean() / height[top].mean() > 0.9


def test_datum_points_alone_decide_in_their_mode(freeform_target: Target) -> None:
    points, _ = bumped(freeform_target)
    move = Similarity(rotation_of(np.array([0.1, 0.2, 0.3])), np.array([5.0, 6.0, 7.0]))
    marks = points[[0, 500, 900, 1300]]
    fit = refine(points, IDENTITY, freeform_target, Options(free_scale=False))
    found = aligned_by(
        "datum", task(freeform_target, points, datums=Datums(("a",) * 4, marks, move(marks))), points, fit
    )
    assert np.allclose(found.pose(marks), move(marks), atol=1e-9)
    with pytest.raises(UsageError):
        aligned_by("datum", task(freeform_target, points), points, fit)


def test_gravity_makes_the_table_level_and_keeps_it_so(cap_target: Target) -> None:
    points, _, _ = cap_target.even_samples(20_000)
    tilted = Similarity(rotation_of(np.array([0.02, -0.01, 0.0])), np.zeros(3))
    cloud = tilted.inverse()(points)
    table = Plane(tilted.inverse().rotation @ np.array([0.0, 0.0, 1.0]), -100.0, 0.1)
    fit = refine(cloud, IDENTITY, cap_target, Options(free_scale=False))
    found = aligned_by("gravity-and-rim", task(cap_target, cloud, table), cloud, fit)
    assert (found.pose.rotation @ table.normal)[2] == pytest.approx(1, abs=1e-9)
    assert float(np.linalg.norm(found.pose(cloud) - points, axis=1).max()) < 0.02 * cap_target.diagonal_mm
    assert tilt_rad(upright(IDENTITY, table.normal, cap_target), tilted) < 1e-6


def test_a_board_gives_the_scale_and_a_moved_marker_is_named() -> None:
    board = {
        f"B{k}": np.array(p, dtype=float) for k, p in enumerate([(0, 0, 0), (200, 0, 0), (200, 150, 0), (0, 150, 0)])
    }
    move = Similarity(rotation_of(np.array([1.0, 2.0, 0.5])), np.array([3.0, 4.0, 5.0]), 0.037)
    seen = {k: move(v[None])[0] for k, v in board.items()}
    assert scale_from_board(seen, board).unit_mm == pytest.approx(1 / 0.037, rel=1e-12)
    seen["B2"] = seen["B2"] + 0.5
    with pytest.raises(RefusedError, match="B2"):
        scale_from_board(seen, board)


def test_repeatability_is_the_scatter_of_one_scan() -> None:
    rng = np.random.default_rng(1)
    shape = rng.normal(0, 1.0, 20_000)
    first, second = shape + rng.normal(0, 0.1, 20_000), shape + 0.05 + rng.normal(0, 0.1, 20_000)
    first[:100] = np.nan
    found = repeatability(first, second)
    assert found.repeatability_mm == pytest.approx(0.1, rel=0.03)
    assert found.bias_mm == pytest.approx(0.05, abs=0.005)
    assert found.correlation_ratio > 0.97
    with pytest.raises(RefusedError):
        repeatability(np.full(50, np.nan), np.zeros(50))
