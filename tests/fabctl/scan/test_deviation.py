"""Signs, counts and heights of deviations."""

from __future__ import annotations

import numpy as np
import pytest

from fabctl.scan.deviation import deviate, statistics
from fabctl.scan.similarity import IDENTITY
from fabctl.scan.target import Target


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_sign_is_right_at_every_point(freeform_target: Target, side: float) -> None:
    points, normals, _ = freeform_target.even_samples(4000)
    offset_mm = side * 0.002 * freeform_target.diagonal_mm
    found = deviate(points + offset_mm * normals, IDENTITY, freeform_target)
    assert (np.sign(found.value_mm[found.counts]) == side).all()
    numbers = statistics(found, freeform_target)
    assert numbers.mean_mm == pytest.approx(offset_mm, rel=0.01)


def test_points_past_the_border_are_left_out_and_counted(freeform_target: Target) -> None:
    border = freeform_target.border
    assert border is not None
    past = border.points_mm + 0.03 * freeform_target.diagonal_mm * border.outward
    points, _, _ = freeform_target.even_samples(3000)
    found = deviate(np.concatenate([points, past]), IDENTITY, freeform_target)
    assert found.on_border[3000:].mean() > 0.99
    assert statistics(found, freeform_target).rms_mm < 1e-6 * freeform_target.diagonal_mm


def test_half_a_scan_covers_half_the_target(freeform_target: Target) -> None:
    points, _, _ = freeform_target.even_samples(6000)
    half = points[points[:, 0] < np.median(points[:, 0])]
    found = deviate(half, IDENTITY, freeform_target)
    assert found.covered_frac == pytest.approx(0.5, abs=0.05)


def test_every_area_weighs_the_same_however_many_points_it_caught(freeform_target: Target) -> None:
    points, normals, _ = freeform_target.even_samples(20_000)
    right = points[:, 0] > np.median(points[:, 0])
    shifted = points + np.where(right, 0.5, -0.5)[:, None] * normals
    crowded = np.concatenate([shifted, shifted[right], shifted[right], shifted[right]])
    numbers = statistics(deviate(crowded, IDENTITY, freeform_target), freeform_target)
    assert abs(numbers.mean_mm) < 0.03


def test_a_few_points_at_the_edge_of_a_gap_are_no_patch(freeform_target: Target) -> None:
    points, normals, _ = freeform_target.even_samples(40_000)
    middle = points[0]
    away = np.linalg.norm(points - middle, axis=1) / freeform_target.diagonal_mm
    few = np.argsort(away)[:6]
    scanned = np.concatenate([points[away > 0.1], points[few] + 1.5 * normals[few]])
    numbers = statistics(deviate(scanned, IDENTITY, freeform_target), freeform_target)
    assert abs(numbers.max_patch_mm) < 0.05
