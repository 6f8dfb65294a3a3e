"""Lens, alignment and registration find what the simulated camera really is, and refuse what cannot be trusted."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from design.pattern.paths import CutPath
from fabctl.errors import RefusedError, UsageError
from fabctl.vision import boards
from fabctl.vision.align import Alignment, align, drift_findings, read_alignment, write_alignment
from fabctl.vision.lens import Lens, calibrate, find_board, read_lens, write_lens
from fabctl.vision.overlay import error_map, job_on_bed
from fabctl.vision.register import (
    apply,
    outline_findings,
    read_registration,
    register,
    seen_outline,
    seen_outline_findings,
    write_registration,
)
from simulators.camera.burn import to_machine
from simulators.camera.picture import Studio
from simulators.camera.scene import Charuco, Pose, Scene
from tests.fabctl.vision.conftest import BED, BOARD, CAMERA, REGISTRATION, SHEET, WHEN, bed_scene

Picture = NDArray[np.uint8]
GRID_MM = np.stack(np.meshgrid(np.linspace(0, 300, 16), np.linspace(0, 200, 11)), axis=-1).reshape(-1, 2)


def codes_of(refused: RefusedError) -> set[str]:
    return {finding.code for finding in refused.findings}


def test_the_lens_is_found_to_a_tenth_of_a_pixel_over_the_whole_frame(lens: Lens, bed: Studio) -> None:
    directions = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.28, 0.28, 7)), axis=-1).reshape(-1, 2)
    truth = replace(lens, K=bed.view.K, distortion=bed.view.distortion)
    # A shifted centre is the same as a turned camera, so the lenses are compared after the best common turn.
    shift = (lens.seen(directions) - truth.seen(directions)).mean(axis=0)
    assert np.abs(lens.seen(directions) - truth.seen(directions) - shift).max() < 0.25
    assert lens.rms_px < 0.1


def test_pixels_and_directions_are_each_others_inverse(lens: Lens) -> None:
    pixels = np.array([[0.0, 0.0], [1049.0, 724.0], [500.0, 300.0]])
    assert lens.seen(lens.bare(pixels)) == pytest.approx(pixels, abs=1e-6)


@pytest.mark.parametrize("height_mm", [0.0, 2.3, 8.0])
def test_the_bed_is_aligned_at_every_height(alignment: Alignment, bed: Studio, height_mm: float) -> None:
    seen = bed.view.project(np.column_stack([GRID_MM, np.full(len(GRID_MM), height_mm)]))
    error_mm = np.linalg.norm(alignment.to_machine(seen, height_mm) - GRID_MM, axis=1)
    assert np.sqrt(np.mean(error_mm**2)) < 0.05
    assert error_mm.max() < 0.15


def test_what_the_alignment_says_of_itself_is_not_less_than_half_its_true_error(
    alignment: Alignment, bed: Studio
) -> None:
    seen = bed.view.project(np.column_stack([GRID_MM, np.zeros(len(GRID_MM))]))
    true_mm = np.sqrt(np.mean(np.sum((alignment.to_machine(seen) - GRID_MM) ** 2, axis=1)))
    assert alignment.rms_mm > true_mm / 2


def test_the_sheet_is_found_moved_turned_and_stretched(alignment: Alignment, bed_picture: Picture) -> None:
    made = register(bed_picture, "bed", REGISTRATION, alignment, SHEET.thickness_mm, WHEN)
    corners = np.array([[0.0, 0.0], [150.0, 0.0], [150.0, 100.0], [0.0, 100.0], [75.0, 50.0]])
    error_mm = np.linalg.norm(apply(made.affine, corners) - to_machine(corners, SHEET.poses[-1], SHEET.size_mm), axis=1)
    assert error_mm.max() < 0.1
    assert made.turn_rad == pytest.approx(0.15, abs=1e-3)
    assert made.stretch_ratio == pytest.approx((1.003, 1.0), abs=5e-4)


def test_a_forgotten_thickness_is_seen_as_a_stretched_sheet(alignment: Alignment, bed_picture: Picture) -> None:
    thin = register(bed_picture, "bed", REGISTRATION, alignment, 0.0, WHEN)
    assert thin.stretch_ratio[1] > 1.005


def test_the_outline_seen_is_the_sheets_own(alignment: Alignment, bed_picture: Picture) -> None:
    made = register(bed_picture, "bed", REGISTRATION, alignment, SHEET.thickness_mm, WHEN)
    seen = seen_outline(bed_picture, alignment, made)
    assert all(offset is not None and abs(offset) < 0.5 for offset in seen.values())
    short = replace(made, size_mm=(153.0, 100.0))
    found = seen_outline_findings(seen_outline(bed_picture, alignment, short))
    assert [finding.code for finding in found] == ["SHEET-SHORT"]


def test_a_job_larger_than_the_sheet_is_an_error() -> None:
    found = outline_findings(np.array([[-1.0, 5.0], [120.0, 90.0]]), (150.0, 80.0))
    assert [finding.code for finding in found] == ["SHEET-OUTLINE", "SHEET-OUTLINE"]


def test_an_upside_down_sheet_is_refused(alignment: Alignment) -> None:
    turned = replace(SHEET, poses=(Pose(0.0, 90.0, 40.0, 0.15, upside_down=True),))
    picture = Studio(bed_scene(turned)).frame()
    with pytest.raises(RefusedError) as caught:
        register(picture, "bed", REGISTRATION, alignment, 2.3, WHEN)
    assert codes_of(caught.value) == {"MARKS-MIRRORED"}


def test_a_sheet_stretched_too_far_is_refused(alignment: Alignment) -> None:
    pulled = replace(SHEET, poses=(Pose(0.0, 90.0, 40.0, 0.15, 1.04),))
    with pytest.raises(RefusedError) as caught:
        register(Studio(bed_scene(pulled)).frame(), "bed", REGISTRATION, alignment, 2.3, WHEN)
    assert "SHEET-STRETCH" in codes_of(caught.value)


def test_too_few_marks_are_refused_with_their_number(alignment: Alignment, lens: Lens, bed_picture: Picture) -> None:
    covered = bed_picture.copy()
    covered[:, 300:] = 90
    with pytest.raises(RefusedError, match=r"of 12 marks of bed found"):
        align(covered, "bed", BED, lens, WHEN)
    with pytest.raises(RefusedError, match=r"[0-3] of 6 marks"):
        register(covered, "bed", REGISTRATION, alignment, 2.3, WHEN)


def test_marks_of_another_size_are_refused(lens: Lens, bed_picture: Picture) -> None:
    larger = replace(BED, marks=tuple(replace(mark, side_mm=13.0) for mark in BED.marks))
    with pytest.raises(RefusedError) as caught:
        align(bed_picture, "bed", larger, lens, WHEN)
    assert codes_of(caught.value) == {"MARKS-SIZE"}


def test_a_mark_that_is_not_where_it_should_be_is_named(lens: Lens, bed_picture: Picture) -> None:
    wrong = replace(BED, marks=(*BED.marks[:3], replace(BED.marks[3], x_mm=285.0), *BED.marks[4:]))
    with pytest.raises(RefusedError, match="look at mark 3"):
        align(bed_picture, "bed", wrong, lens, WHEN)


@pytest.mark.parametrize(
    ("picture", "code"),
    [
        (np.zeros((725, 1050), np.uint8), "PICTURE-FLAT"),
        (np.full((725, 1050), 255, np.uint8), "PICTURE-FLAT"),
        (np.full((480, 640), 90, np.uint8), "PICTURE-SIZE"),
        (np.zeros((0, 0), np.uint8), "PICTURE-EMPTY"),
    ],
)
def test_an_unusable_picture_is_refused(alignment: Alignment, picture: Picture, code: str) -> None:
    with pytest.raises(RefusedError) as caught:
        register(picture, "bed", REGISTRATION, alignment, 2.3, WHEN)
    assert code in codes_of(caught.value)


def test_a_saturated_picture_is_refused(alignment: Alignment) -> None:
    picture = Studio(bed_scene(SHEET, exposure_ratio=6.0)).frame()
    with pytest.raises(RefusedError, match="saturated"):
        register(picture, "bed", REGISTRATION, alignment, 2.3, WHEN)


def test_a_knocked_camera_is_noticed(alignment: Alignment, bed_picture: Picture) -> None:
    now = datetime.fromisoformat(WHEN) + timedelta(days=1)
    assert drift_findings(bed_picture, "bed", alignment, now) == []
    knocked = Studio(bed_scene(SHEET, shift_mm=(0.3, 0.0))).frame()
    assert [f.code for f in drift_findings(knocked, "bed", alignment, now)] == ["ALIGN-DRIFT"]
    bare = np.clip(np.random.default_rng(1).normal(90, 20, bed_picture.shape), 0, 255).astype(np.uint8)
    assert [f.code for f in drift_findings(bare, "bed", alignment, now)] == ["ALIGN-NO-WITNESS"]


def test_an_old_alignment_is_refused(alignment: Alignment, bed_picture: Picture) -> None:
    now = datetime.fromisoformat(WHEN) + timedelta(days=31)
    assert [f.code for f in drift_findings(bed_picture, "bed", alignment, now)] == ["ALIGN-OLD"]
    before = datetime.fromisoformat(WHEN) - timedelta(days=2)  # a clock that was wrong tells no age
    assert [f.code for f in drift_findings(bed_picture, "bed", alignment, before)] == ["ALIGN-OLD"]


def test_another_board_is_not_taken_for_ours(board_pictures: list[Picture]) -> None:
    view, found = find_board(board_pictures[2], boards.Charuco("other", 7, 10, 20.0, 15.0), "picture")
    assert view is None
    assert [finding.code for finding in found] == ["LENS-BOARD"]
    view, found = find_board(board_pictures[2], replace(BOARD, first_id=20), "picture")
    assert view is None
    assert [finding.code for finding in found] == ["LENS-BOARD"]


def test_too_few_pictures_of_too_little_of_the_frame_are_refused(board_pictures: list[Picture]) -> None:
    views = [view for view in (find_board(p, BOARD, "p")[0] for p in board_pictures[:2]) if view]
    with pytest.raises(RefusedError) as caught:
        calibrate(views, CAMERA.size_px, BOARD, WHEN)
    assert codes_of(caught.value) == {"LENS-FEW", "LENS-COVERAGE"}


def test_a_board_always_held_the_same_way_is_refused(board_pictures: list[Picture]) -> None:
    straight = Studio(Scene(camera=replace(CAMERA, tilt_rad=0.0), charuco=Charuco(10, 7, 20.0, 15.0)))
    straight.board_pose = lambda number: (  # type: ignore[method-assign]
        np.eye(3),
        np.array([150.0 + 12 * (number % 3), 100.0 + 10 * (number % 2), 0.0]),
    )
    views = [find_board(straight.frame(k), BOARD, str(k))[0] for k in range(8)]
    with pytest.raises(RefusedError) as caught:
        calibrate([view for view in views if view], CAMERA.size_px, BOARD, WHEN)
    assert codes_of(caught.value) & {"LENS-TILT", "LENS-COVERAGE"}


def test_lens_alignment_and_registration_are_read_as_written(
    alignment: Alignment, lens: Lens, bed_picture: Picture, tmp_path: Path
) -> None:
    write_lens(lens, tmp_path / "lens.json")
    write_alignment(alignment, tmp_path / "alignment.json")
    made = register(bed_picture, "bed", REGISTRATION, alignment, 2.3, WHEN)
    write_registration(made, tmp_path / "registration.json")
    assert pytest.approx(lens.K) == read_lens(tmp_path / "lens.json").K
    again = read_alignment(tmp_path / "alignment.json")
    assert again.to_pixels(GRID_MM, 2.3) == pytest.approx(alignment.to_pixels(GRID_MM, 2.3))
    assert read_registration(tmp_path / "registration.json").affine == pytest.approx(made.affine)
    with pytest.raises(UsageError, match="camera align"):
        read_alignment(tmp_path / "none.json")


def test_the_job_is_drawn_where_it_will_be_cut(alignment: Alignment, bed_picture: Picture) -> None:
    path = CutPath("slit", np.array([[20.0, 50.0], [130.0, 50.0]]))
    affine = np.array([[1.0, 0.0, 90.0], [0.0, 1.0, 40.0]])
    drawn = job_on_bed(bed_picture, [path], affine, alignment, 2.3)
    at = np.rint(alignment.to_pixels(np.array([[165.0, 90.0]]), 2.3)[0]).astype(int)
    patch = drawn[at[1] - 1 : at[1] + 2, at[0] - 1 : at[0] + 2].astype(int)
    assert (patch[..., 2] - patch[..., 0]).max() > 80
    drawn = error_map(bed_picture, alignment)
    h, w = bed_picture.shape
    assert drawn.shape[1:] == (w, 3)
    assert drawn.shape[0] > h  # a legend under it
    assert (drawn[:h, -2:, 2].astype(int) - drawn[:h, -2:, 0] < 100).all()  # no label runs out of the picture
