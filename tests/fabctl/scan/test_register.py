"""The right pose or an honest no."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from design.targets import vase
from fabctl.scan.clean import clean
from fabctl.scan.decide import Datums
from fabctl.scan.refine import patch_rows
from fabctl.scan.register import Registration, Task, register, specimen_points
from fabctl.scan.said import left_aside
from fabctl.scan.similarity import IDENTITY, Similarity
from fabctl.scan.symmetry import find_symmetries
from fabctl.scan.target import Target
from simulators.photogrammetry import ScanPlan
from tests.fabctl.scan.conftest import TARGETS, scanned, symmetries_of, true_pose

RAW = ScanPlan(seed=3, unseen_frac=0.3, points_count=20_000)


def registered(name: str, plan: ScanPlan, datums: Datums | None = None) -> Registration:
    made = scanned(name, plan)
    cleaned = clean(made.points, plan.seed)
    return register(Task(made.points, cleaned, TARGETS[name], symmetries_of(name), datums=datums, seed=plan.seed))


def error_frac(name: str, plan: ScanPlan, found: Registration) -> float:
    assert found.best is not None
    return symmetries_of(name).apart_frac(true_pose(scanned(name, plan)), found.best.pose, TARGETS[name])


def test_a_raw_scan_of_unknown_scale_is_laid_right() -> None:
    found = registered("freeform", RAW)
    assert found.status == "aligned"
    assert error_frac("freeform", RAW, found) < 0.0005
    assert found.best is not None
    assert found.best.pose.scale_ratio * scanned("freeform", RAW).scale_ratio == pytest.approx(1, abs=1e-3)


def test_the_same_seed_gives_the_same_answer() -> None:
    first, second = registered("freeform", RAW), registered("freeform", RAW)
    assert first.best is not None
    assert second.best is not None
    assert np.array_equal(first.best.pose.rotation, second.best.pose.rotation)
    assert first.best.pose.scale_ratio == second.best.pose.scale_ratio


def test_a_cap_is_known_up_to_a_turn_about_its_axis() -> None:
    assert symmetries_of("cap").continuous
    assert abs(symmetries_of("cap").axis_direction @ np.array([0, 0, 1])) > 0.9999  # type: ignore[operator]


def test_the_axis_of_a_surface_that_is_only_nearly_round_is_found_exactly() -> None:
    target = Target(vase(), "vase")
    found = find_symmetries(target)
    assert found.axis_misfit_frac < 5e-4  # its centroid and main directions alone leave 2e-3
    assert found.axis_point_mm is not None
    assert np.linalg.norm(found.axis_point_mm[:2]) < 0.01


def test_a_mirror_image_is_named() -> None:
    plan = ScanPlan(seed=5, unseen_frac=0.1, points_count=20_000, mirrored=True)
    found = registered("freeform", plan)
    assert found.status == "mirrored"
    assert [f.code for f in found.findings] == ["SCAN-MIRROR"]


def test_an_unrelated_cloud_is_refused() -> None:
    made = scanned("cap", RAW)
    found = register(Task(made.points, clean(made.points), TARGETS["freeform"], symmetries_of("freeform")))
    assert found.status == "failed"


def test_coordinates_far_from_the_origin_change_nothing() -> None:
    made = scanned("freeform", RAW)
    size = made.scale_ratio
    points = made.points / size + np.array([4.5e5, 5.2e6, 300.0])
    found = register(Task(points, clean(points, 3), TARGETS["freeform"], symmetries_of("freeform"), 1.0, seed=3))
    assert found.status == "aligned"
    assert found.best is not None
    moved = Similarity(np.eye(3), np.array([4.5e5, 5.2e6, 300.0]), 1 / size)
    off = symmetries_of("freeform").apart_frac(true_pose(made), found.best.pose.after(moved), TARGETS["freeform"])
    assert off < 0.0005


def test_another_thing_of_the_specimens_size_is_told() -> None:
    points = TARGETS["cap"].even_samples(8000)[0]
    small = 0.3 * points + np.array([0.0, 300.0, 0.0])
    for other, said in ((points + np.array([250.0, 0.0, 0.0]), ["SCAN-OTHERS"]), (small, [])):
        cleaned = clean(np.concatenate([points, other]))
        assert [f.code for f in left_aside(cleaned, cleaned.parts[0])] == said


def test_the_points_noise_does_not_go_into_how_the_scale_is_found() -> None:
    target = TARGETS["freeform"]
    points, normals, _ = target.even_samples(6000)
    patches = cKDTree(target.even_samples(200)[0])
    exact = patch_rows(points, IDENTITY, target, patches, 0.05)
    lifted = patch_rows(points + 0.01 * target.diagonal_mm * normals, IDENTITY, target, patches, 0.05)
    assert np.median(np.abs(exact.jacobian[:, 6] - lifted.jacobian[:, 6])) < 1e-3


def test_no_point_is_compared_whose_place_on_the_target_is_too_near_the_table() -> None:
    made, target = scanned("cap", RAW), TARGETS["cap"]
    cleaned, pose = clean(made.points, 3), true_pose(made)
    task = Task(made.points, cleaned, target, symmetries_of("cap"), seed=3)
    kept = made.points[specimen_points(task, cleaned.parts[0], pose)]
    assert cleaned.table is not None
    height = cleaned.table.height(pose.inverse()(target.closest(pose(kept)).points_mm))
    assert len(kept) > 5000
    assert height.min() > cleaned.table_top_cu
