"""What decides where distances cannot: colour, and where the cloud goes on past the border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from design.targets import pierced_cap
from fabctl.scan import register as registering
from fabctl.scan.borders import Circle, borne_out, circle, rim_axis
from fabctl.scan.clean import clean
from fabctl.scan.decide import decide_by_border
from fabctl.scan.edges import edge_finder
from fabctl.scan.judge import Judged
from fabctl.scan.markers import scale_from_board
from fabctl.scan.paint import chosen_by_paint, paint_of
from fabctl.scan.painted import marks_on_table
from fabctl.scan.refine import Fit, Rows
from fabctl.scan.register import Task, register, tried
from fabctl.scan.similarity import IDENTITY, Similarity, rotation_of
from fabctl.scan.symmetry import Symmetries
from fabctl.scan.target import Target
from fabctl.vision.boards import scale_marks, sheet_ink
from simulators.photogrammetry import ScanPlan, sample_mesh
from tests.fabctl.scan.conftest import TARGETS, scanned, symmetries_of, true_pose


def test_the_colours_of_an_earlier_scan_decide_the_turn_of_a_cap() -> None:
    first = scanned("cap", ScanPlan(seed=1, unseen_frac=0.1, points_count=20_000))
    plan = ScanPlan(seed=2, unseen_frac=0.25, points_count=20_000)
    second, target = scanned("cap", plan), TARGETS["cap"]
    body = first.labels == 0
    paint = paint_of(true_pose(first)(first.points[body]), np.round(255 * first.colours[body]).astype(np.uint8))
    assert paint is not None
    task = Task(second.points, clean(second.points, 2), target, symmetries_of("cap"), seed=2)
    assert register(task).status == "symmetric"
    seen = np.round(255 * second.colours).astype(np.uint8)
    found = register(replace(task, colours=seen, paint=paint))
    assert (found.status, found.decided_by) == ("aligned", "colour")
    assert found.best is not None
    points = target.even_samples(500)[0]
    off = found.best.pose(true_pose(second).inverse()(points)) - points
    assert float(np.sqrt((off**2).sum(axis=1).mean())) < 0.005 * target.diagonal_mm


def test_colours_that_say_nothing_leave_the_turn_open() -> None:
    plan = ScanPlan(seed=2, unseen_frac=0.25, points_count=20_000)
    made = scanned("cap", plan)
    rng = np.random.default_rng(0)
    points = TARGETS["cap"].even_samples(4000)[0]
    paint = paint_of(points, rng.integers(0, 255, (4000, 3)).astype(np.uint8))
    seen = np.round(255 * made.colours).astype(np.uint8)
    task = Task(made.points, clean(made.points, 2), TARGETS["cap"], symmetries_of("cap"), colours=seen, paint=paint)
    assert register(task).status == "symmetric"
    assert paint_of(points, np.full((4000, 3), 90, dtype=np.uint8)) is None


def test_one_pose_must_lead_clearly_for_colours_to_decide() -> None:
    assert chosen_by_paint([0.2, 0.8, 0.3]) == 1
    assert chosen_by_paint([0.7, 0.8]) is None
    assert chosen_by_paint([0.3, 0.05]) is None


PIERCED = Target(pierced_cap(), "pierced")


def test_points_in_the_hole_refute_a_turn_and_a_gap_of_the_scan_does_not() -> None:
    target, axis = PIERCED, rim_axis(PIERCED)
    assert axis is not None
    points = target.even_samples(12_000)[0]
    turned = Similarity(rotation_of(np.array([0.0, 0.0, 1.5])), np.zeros(3))
    right, wrong = borne_out(cKDTree(points), IDENTITY, target), borne_out(cKDTree(points), turned, target)
    assert right is not None
    assert wrong is not None
    assert right.free()
    assert not right.contradicted()
    assert wrong.contradicted()
    assert not round_about(points).open_elsewhere()
    assert round_about(gap_at(points, 1.5, 0.12)).open_elsewhere()


def round_about(points: np.ndarray) -> Circle:
    finder, axis = edge_finder(points, IDENTITY, PIERCED), rim_axis(PIERCED)
    assert finder is not None
    assert axis is not None
    return circle(cKDTree(points), finder, IDENTITY, axis)


def gap_at(points: np.ndarray, turn_rad: float, radius_frac: float) -> np.ndarray:
    """Return the points without a round gap where the hole would be if it were turned by `turn_rad`."""
    border = PIERCED.border
    assert border is not None
    spans = [np.ptp(border.points_mm[border.loop == k], axis=0).max() for k in (0, 1)]
    hole = border.points_mm[border.loop == int(np.argmin(spans))].mean(axis=0)
    place = rotation_of(np.array([0.0, 0.0, turn_rad])) @ hole
    return points[np.linalg.norm(points - place, axis=1) > radius_frac * PIERCED.diagonal_mm]


def test_the_rims_axis_is_found_however_finely_the_rim_is_meshed() -> None:
    axis = rim_axis(PIERCED)
    assert axis is not None
    assert np.abs(axis[0][:2]).max() < 0.05
    assert abs(axis[1][2]) > 0.9999


@pytest.mark.parametrize(("count", "enough"), [(6_000, False), (25_000, True), (60_000, True)])
def test_the_holes_own_edge_decides_although_a_gap_could_hide_the_hole(count: int, enough: bool) -> None:
    points = gap_at(scattered(count), 2.0, 0.13)
    off = Similarity(rotation_of(np.array([0.0, 0.0, -2.0])), np.zeros(3))
    chosen = decided(points, [off, IDENTITY])
    assert (chosen is not None) == enough
    assert chosen is None or chosen.pose is IDENTITY


def scattered(count: int) -> np.ndarray:
    return sample_mesh(PIERCED.mesh.vertices_mm, PIERCED.mesh.faces, count, np.random.default_rng(5))[0]


@pytest.mark.parametrize("radius_frac", [0.055, 0.1, 0.115])
def test_a_gap_about_as_large_as_the_hole_never_passes_for_it(radius_frac: float) -> None:
    points = gap_at(gap_at(scattered(40_000), 0.0, 0.14), 2.0, radius_frac)
    off = Similarity(rotation_of(np.array([0.0, 0.0, -2.0])), np.zeros(3))
    assert decided(points, [off, IDENTITY]) is None


@pytest.mark.parametrize(("hidden", "status"), [(True, "ambiguous"), (False, "aligned")])
def test_a_pose_found_alone_is_not_trusted_while_the_border_allows_another_turn(
    hidden: bool, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search and the pushes miss the rival: the hole seen through a gap, another gap where it might be as well."""
    points = gap_at(gap_at(scattered(40_000), 0.0, 0.14), 2.0, 0.14) if hidden else scattered(40_000)
    task = Task(points, clean(points), PIERCED, Symmetries((), None, None))
    monkeypatch.setattr(registering, "poses_of", lambda task, body: [tried(task, body, IDENTITY)])
    monkeypatch.setattr(registering, "pushed", lambda task, body, best: [])
    assert register(task).status == status


def decided(points: np.ndarray, poses: list[Similarity]) -> Judged | None:
    judged = [Judged(fit_at(pose), 0.001, 0.001, 0.7, 1.0) for pose in poses]
    finder = edge_finder(points, poses[0], PIERCED)
    assert finder is not None
    return decide_by_border(finder, cKDTree(points), judged, Symmetries((), None, None))


def fit_at(pose: Similarity) -> Fit:
    nothing = Rows(np.zeros((0, 7)), np.zeros(0), np.zeros(0), np.zeros(0))
    return Fit(pose, nothing, None, np.zeros(0), np.zeros(0), 0.0, 0, 0.0)


@pytest.mark.parametrize("flip", [False, True])
def test_marks_are_found_in_the_colours_of_the_table_and_give_the_scale(flip: bool) -> None:
    rng = np.random.default_rng(3)
    sheet = scale_marks((200.0, 150.0), side_mm=20.0)
    table = np.column_stack([rng.uniform(-10, 210, 300_000), rng.uniform(-10, 160, 300_000), np.zeros(300_000)])
    dark = np.zeros(len(table), dtype=bool)
    for corners in sheet_ink(sheet):  # upright rectangles
        dark |= ((table[:, :2] > corners.min(axis=0)) & (table[:, :2] < corners.max(axis=0))).all(axis=1)
    ball = rng.normal(size=(30_000, 3))
    ball = 35 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [100, 75, 40]
    points = np.concatenate([table + rng.normal(0, 0.05, table.shape), ball])
    grey = np.concatenate([np.where(dark, 30, 220), np.full(len(ball), 120)])
    turn = rotation_of(np.array([0.4, -1.1, 2.0]) * (-1 if flip else 1))
    cloud = Similarity(turn, np.array([5.0, -3.0, 900.0]), 0.037)(points)
    seen = marks_on_table(cloud, np.repeat(grey[:, None], 3, axis=1).astype(np.uint8), clean(cloud))
    board = {str(m.id): np.array([m.x_mm, m.y_mm, 0.0]) for m in sheet.marks}
    scale = scale_from_board(seen, board)
    assert scale.markers_count >= 5
    assert scale.unit_mm * 0.037 == pytest.approx(1, abs=2e-4)
