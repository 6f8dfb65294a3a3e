"""The right pose or an honest no."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from design.surface import TriMesh
from design.targets import vase
from fabctl.scan.clean import clean
from fabctl.scan.decide import Datums
from fabctl.scan.judge import Judged
from fabctl.scan.refine import Fit, Rows, patch_rows
from fabctl.scan.register import Registration, Task, register, specimen_points
from fabctl.scan.said import findings_of, left_aside
from fabctl.scan.similarity import IDENTITY, Similarity
from fabctl.scan.symmetry import find_symmetries
from fabctl.scan.target import Target
from simulators.photogrammetry import ScanPlan, sample_mesh
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


def test_a_mirror_image_that_fits_askew_is_named() -> None:
    """A quadric turned by twice its own slant is its mirror image, apart from the outline."""
    u, v = (np.linspace(-1, 1, 30)[k] for k in np.indices((30, 30)).reshape(2, -1))
    corner = (np.arange(29)[:, None] * 30 + np.arange(29)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 30, corner + 1], 1), corner[:, None] + [1, 30, 31]])
    vertices = np.stack([70 * u, 50 * v, 25 * u**2 - 18 * v**2 + 6 * u * v + 4 * u**3], axis=1)
    target = Target(TriMesh(vertices, faces), "twisted saddle")
    rng = np.random.default_rng(4)
    points, normals = sample_mesh(vertices, faces, 12_000, rng)
    points = points + 0.15 * rng.normal(size=(len(points), 1)) * normals
    symmetries = find_symmetries(target)
    assert register(Task(points, clean(points), target, symmetries)).status == "aligned"
    mirrored = points * [1.0, 1.0, -1.0]
    assert register(Task(mirrored, clean(mirrored), target, symmetries)).status == "mirrored"


def test_a_plane_that_belongs_to_the_specimen_says_nothing_about_its_side() -> None:
    cleaned = clean(scanned("cap", RAW).points, 3)
    over = Similarity(np.diag([1.0, -1.0, -1.0]), np.zeros(3), 1.0).after(true_pose(scanned("cap", RAW)))
    nothing = Rows(np.zeros((0, 7)), np.zeros(0), np.zeros(0), np.zeros(0))
    judged = Judged(Fit(over, nothing, None, np.zeros(0), np.zeros(0), 0.0, 0, 0.0), 0.001, 0.001, 0.7, 1.0)
    for name, said in ((cleaned.parts[0].name, True), ("largest cluster with its plane kept", False)):
        part = replace(cleaned.parts[0], name=name)
        found = findings_of("aligned", judged, (), part, cleaned, symmetries_of("cap"), TARGETS["cap"])
        assert ("SCAN-OTHER-SIDE" in [f.code for f in found]) is said


def test_an_unrelated_cloud_is_refused() -> None:
    made = scanned("cap", RAW)
    found = register(Task(made.points, clean(made.points), TARGETS["freeform"], symmetries_of("freeform")))
    assert found.status == "failed"


def test_a_cloud_in_another_unit_is_refused_with_both_sizes() -> None:
    points = 1e-3 * TARGETS["freeform"].even_samples(3000)[0]
    task = Task(points, clean(points), TARGETS["freeform"], symmetries_of("freeform"), scale_ratio=1.0)
    found = register(task)
    assert found.status == "failed"
    assert "--unit-mm" in found.findings[0].hint
    assert f"{TARGETS['freeform'].diagonal_mm:.3g} mm" in found.findings[0].hint


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
