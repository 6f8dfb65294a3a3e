"""The kerf and the state of every cut, measured in pictures whose truth the simulated beam knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from design.export.gcode import GcodeOptions
from design.findings import errors
from design.pattern.paths import CutPath, LayerPreset
from fabctl.errors import RefusedError, UsageError
from fabctl.vision import coupon as coupons
from fabctl.vision.inspect import Inspection, inspect, inspection_findings
from fabctl.vision.kerf import KerfMeasurement, kerf_at, measure
from fabctl.vision.profile import across, linear_light, missing
from simulators.camera.burn import kerf_mm
from simulators.camera.picture import Studio
from simulators.camera.scene import Beam, Bed, Camera, Pose, Scene, Sheet

FEED_mm_s = 25.0
BEAM = Beam(radius_x_mm=0.11, radius_y_mm=0.09)
COUPON = coupons.make_coupon([0.5, 0.7], FEED_mm_s)


def trace_of(jobs: list[tuple[CutPath, float, float]]) -> NDArray[np.float64]:
    """Return the burn trace of (stroke, power, speed), one after the other."""
    rows, now_s = [], 0.0
    for stroke, power_frac, speed_mm_s in jobs:
        points = np.vstack([stroke.points_mm, stroke.points_mm[:1]]) if stroke.closed else stroke.points_mm
        steps_s = np.r_[0.01, np.linalg.norm(np.diff(points, axis=0), axis=1) / speed_mm_s]
        for point, step_s, last in zip(points, steps_s, np.arange(len(points)) == len(points) - 1, strict=True):
            now_s += float(step_s)
            rows.append([now_s, *point, 0.0 if last else power_frac])
    return np.array(rows)


def photograph_coupon(over_light: bool, mm_per_px: float = 0.05) -> NDArray[np.uint8]:
    w, h = COUPON.size_mm
    sheet = Sheet(
        COUPON.size_mm,
        poses=(Pose(),),
        grey_frac=0.08 if over_light else 0.55,
        open_frac=0.85 if over_light else 0.03,
        beam=BEAM,
    )
    camera = Camera(
        size_px=(round(1.05 * w / mm_per_px), round(1.05 * h / mm_per_px)),
        mm_per_px=mm_per_px,
        focal_px=3000.0,
        looks_at_mm=(w / 2, h / 2),
        tilt_rad=0.03,
        distortion_ratio=(-0.02, 0.0, 0.0, 0.0, 0.0),
    )
    jobs = [(stroke, 0.12, 60.0) for stroke in coupons.mark_strokes(COUPON, 0.15)]
    for power in coupons.powers_of(COUPON):
        jobs += [(stroke, power, FEED_mm_s) for stroke in coupons.strokes_at(COUPON, power)]
    scene = Scene(camera=camera, bed=Bed((w, h)), sheet=sheet, texel_mm=0.02)
    return Studio(scene).frame(0, trace_of(jobs))


@pytest.fixture(scope="module")
def picture() -> NDArray[np.uint8]:
    return photograph_coupon(over_light=True)


@pytest.fixture(scope="module")
def measured(picture: NDArray[np.uint8]) -> KerfMeasurement:
    return measure(picture, "coupon", COUPON)


def test_the_kerf_is_measured_to_a_hundredth_per_direction_and_power(measured: KerfMeasurement) -> None:
    assert len(measured.widths) == 4
    for width in measured.widths:
        true_mm = kerf_mm(width.power_frac / FEED_mm_s, 0.0 if width.axis == "x" else math.pi / 2, BEAM)
        assert width.kerf_mm == pytest.approx(true_mm, abs=0.006)
        assert abs(width.kerf_mm - true_mm) < width.uncertainty_mm < 0.02


def test_the_kerf_between_two_powers_lies_between_theirs(measured: KerfMeasurement) -> None:
    low, middle, high = (kerf_at(measured, power)[0] for power in (0.5, 0.6, 0.7))
    assert low < middle < high
    with pytest.raises(RefusedError, match="outside the powers"):
        kerf_at(measured, 0.9)


def test_a_coupon_lit_from_the_front_gives_no_kerf_to_cut_by() -> None:
    found = measure(photograph_coupon(over_light=False), "coupon", COUPON)
    assert "KERF-RIM" in {finding.code for finding in found.findings}
    with pytest.raises(RefusedError, match="from behind"):
        kerf_at(found, 0.6)


def test_a_picture_without_the_coupon_or_with_it_far_away_is_refused(picture: NDArray[np.uint8]) -> None:
    with pytest.raises(RefusedError, match="0 of 4 marks"):
        measure(np.random.default_rng(1).integers(60, 200, (400, 400)).astype(np.uint8), "noise", COUPON)
    with pytest.raises(RefusedError, match="mm is the most"):
        measure(picture[::2, ::2].copy(), "far", COUPON)


def test_the_file_of_another_coupon_is_refused_by_its_marks() -> None:
    other = coupons.make_coupon([0.5, 0.6, 0.7], FEED_mm_s)
    with pytest.raises(RefusedError, match="KERF-COUPON"):
        measure(photograph_coupon(over_light=True), "photo", other)


def test_the_coupons_program_cuts_every_slit_at_its_power() -> None:
    lines = coupons.coupon_gcode(COUPON, LayerPreset(0.12, 60.0), 0.1, GcodeOptions())
    assert lines.count("M4S0") == 1
    assert sum("S500" in line for line in lines) == 1
    assert sum("S700" in line for line in lines) == 1
    cuts = [
        line for line in lines[next(k for k, line in enumerate(lines) if "S500" in line) :] if line.startswith("G0X")
    ]
    assert len(cuts) == 2 * 8 + 2 * 3  # slits and squares, then home; the first stands before its power
    assert coupons.coupon_from(coupons.coupon_data(COUPON), "here") == COUPON
    with pytest.raises(UsageError, match="powers_frac"):
        coupons.coupon_from({**coupons.coupon_data(COUPON), "powers_frac": "many"}, "here")
    for change in ({"feed_mm_s": math.nan}, {"passes_count": 0}, {"format": 1}):
        with pytest.raises(UsageError, match="here"):
            coupons.coupon_from({**coupons.coupon_data(COUPON), **change}, "here")


@pytest.mark.parametrize("blur_px", [0.5, 1.0, 2.0])
def test_blur_takes_nothing_from_the_sum(blur_px: float) -> None:
    import cv2

    fine = np.full((80, 1600), 0.5)
    fine[:, 796:804] = 0.1  # 8 of 20 texels to a pixel: a slit of 0.4 px
    light = cv2.GaussianBlur(cv2.resize(fine, (80, 80), interpolation=cv2.INTER_AREA), (0, 0), blur_px)
    ends = np.array([[39.5, 10.0], [39.5, 70.0]])
    rows = across(light, lambda p: p, ends, 20.0, 0.25, np.arange(5.0, 50.0))
    background, lacking = missing(rows, 10.0)
    width = (lacking / (background - 0.1)).sum(axis=1) * 0.25
    assert width == pytest.approx(np.full(len(width), 0.4), abs=2e-3)


def test_code_values_become_light() -> None:
    light = linear_light(np.array([[0, 128, 255]], np.uint8))
    assert light[0] == pytest.approx([0.0, 0.2158605, 1.0], abs=1e-6)


JOB = [
    CutPath("slit", np.array([[8.0 + 6 * c, 6.0 + 9 * r], [11.0 + 6 * c, 12.0 + 9 * r]]))
    for r in range(4)
    for c in range(8)
]
JOB.append(CutPath("outline", np.array([[2.0, 2.0], [58.0, 2.0], [58.0, 44.0], [2.0, 44.0]]), closed=True))
MISSING, WEAK, MOVED = {3, 17}, {5, 20}, {9, 28}


ToPixels = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@pytest.fixture(scope="module")
def cut_sheet() -> tuple[NDArray[np.uint8], ToPixels]:
    jobs = []
    for k, path in enumerate(JOB):
        shifted = replace(path, points_mm=path.points_mm + (0.35 if k in MOVED else 0.0) * np.array([0.9, -0.45]))
        if k not in MISSING:
            jobs.append((shifted, 0.25 if k in WEAK else 0.6, FEED_mm_s))
    camera = Camera(size_px=(460, 360), mm_per_px=0.15, looks_at_mm=(30.0, 23.0), blur_px=1.0, focal_px=2200.0)
    sheet = Sheet((60.0, 46.0), thickness_mm=2.3, drop_mm2=0.0)
    studio = Studio(Scene(camera=camera, bed=Bed((60.0, 46.0)), sheet=sheet))
    picture = studio.frame(0, trace_of(jobs))

    def to_pixels(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return studio.view.project(np.column_stack([points_mm, np.full(len(points_mm), 2.3)]))

    return picture, to_pixels


@pytest.fixture(scope="module")
def inspected(cut_sheet: tuple[NDArray[np.uint8], ToPixels]) -> Inspection:
    picture, to_pixels = cut_sheet
    return inspect(picture, JOB, to_pixels, 0.15)


def test_every_faulty_slit_is_named_and_no_other(inspected: Inspection) -> None:
    states = {path.index: path.state for path in inspected.faulty()}
    expected = (
        dict.fromkeys(MISSING, "missing") | dict.fromkeys(WEAK, "not_through") | dict.fromkeys(MOVED, "displaced")
    )
    assert states == expected
    assert {f.code for f in inspection_findings(inspected)} == {"CUT-MISSING", "CUT-NOT-THROUGH", "CUT-DISPLACED"}


def test_a_job_that_lies_aside_as_a_whole_is_not_cut_as_designed(
    cut_sheet: tuple[NDArray[np.uint8], ToPixels],
) -> None:
    picture, to_pixels = cut_sheet
    found = inspect(picture, JOB, lambda points_mm: to_pixels(points_mm + np.array([0.2, -0.15])), 0.15)
    assert found.shift_mm == pytest.approx((-0.2, 0.15), abs=0.03)
    assert {path.index for path in found.faulty()} == MISSING | WEAK | MOVED  # of each its own fault, not the job's
    assert "CUT-SHIFTED" in {f.code for f in errors(inspection_findings(found))}


def test_displacement_is_measured(inspected: Inspection) -> None:
    offsets = [path.offset_mm for path in inspected.paths if path.index in MOVED]
    assert offsets == pytest.approx([0.35, 0.35], abs=0.04)


def test_an_uncut_sheet_is_said_to_be_uncut() -> None:
    grey = np.random.default_rng(2).normal(140, 2, (400, 500)).astype(np.uint8)
    found = inspection_findings(inspect(grey, JOB, lambda p: p * 7 + 20, 0.15))
    assert [finding.code for finding in found] == ["CUT-NOTHING"]
