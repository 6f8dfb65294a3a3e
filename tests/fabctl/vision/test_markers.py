"""Coded markers are found where they are, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks._camera_pictures import no_marker
from fabctl.vision.boards import REGISTRATION_IDS
from fabctl.vision.markers import codes, find_markers, mirrored
from fabctl.vision.template import Fit, blur_matrix, fit, homography, render, sample_grid, warp

F64 = NDArray[np.float64]
SUPER = 6


def photograph(
    number: int,
    module_px: float,
    turn_rad: float = 0.3,
    tilt_rad: float = 0.0,
    blur_px: float = 1.0,
    contrast: float = 0.6,
) -> tuple[NDArray[np.uint8], F64]:
    """Return a picture of one marker drawn by OpenCV, and the pixel of its centre."""
    unit = 24
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250), number, 7 * unit)
    page = np.full((11 * unit, 11 * unit), 255, np.uint8)
    page[2 * unit : 9 * unit, 2 * unit : 9 * unit] = drawn
    size, fine_by = int(module_px * 16), SUPER if module_px < 12 else 2
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    middle = np.array([[1, 0, -(5.5 * unit - 0.5)], [0, 1, -(5.5 * unit - 0.5)], [0, 0, 1.0]])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    tilt = np.array([[1, 0, 0], [0, np.cos(tilt_rad), 0], [0, np.sin(tilt_rad) / (60 * unit), 1.0]])
    place = np.array([[module_px / unit, 0, size / 2 + 0.3], [0, module_px / unit, size / 2 - 0.2], [0, 0, 1.0]])
    M = place @ tilt @ turn @ middle
    fine = np.array([[fine_by, 0, (fine_by - 1) / 2], [0, fine_by, (fine_by - 1) / 2], [0, 0, 1.0]])
    big = cv2.warpPerspective(page, fine @ M, (size * fine_by, size * fine_by), borderValue=255)
    small = cv2.resize(big, (size, size), interpolation=cv2.INTER_AREA).astype(float) / 255
    grey = 200 * (1 - contrast * (1 - cv2.GaussianBlur(small, (0, 0), blur_px)))
    noisy = grey + np.random.default_rng(number).normal(0, 2, grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), warp(M, np.array([[5.5 * unit - 0.5] * 2]))[0]


@pytest.mark.parametrize("turn_rad", [0.0, 0.8, 2.0, 3.3, 5.1])
def test_a_marker_is_found_to_a_twentieth_of_a_pixel_however_it_is_turned(turn_rad: float) -> None:
    picture, centre = photograph(17, 6.0, turn_rad, tilt_rad=0.4)
    (marker,) = find_markers(picture)
    assert marker.id == 17
    assert marker.centre_px == pytest.approx(centre, abs=0.05)


@pytest.mark.parametrize("blur_px", [0.5, 1.0, 2.5])
@pytest.mark.parametrize("module_px", [13.0, 16.0, 24.0, 40.0, 70.0])
def test_a_marker_of_large_modules_is_found_as_exactly_for_its_size(module_px: float, blur_px: float) -> None:
    """As a telephone of many megapixels shows it."""
    picture, centre = photograph(17, module_px, 0.7, tilt_rad=0.3, blur_px=blur_px)
    (marker,) = find_markers(picture)
    assert marker.id == 17
    assert marker.centre_px == pytest.approx(centre, abs=0.01 * module_px)


def test_the_first_corner_is_the_upper_left_one_of_the_marker_itself() -> None:
    picture, _ = photograph(5, 8.0, turn_rad=np.pi / 2)
    (marker,) = find_markers(picture)
    assert marker.corners_px[0] - marker.centre_px == pytest.approx([28, -28], abs=0.5)


def test_a_marker_of_three_pixels_a_module_is_read_through_a_blur_of_one_and_a_half() -> None:
    read = [find_markers(photograph(k, 3.0, 0.7 * k, 0.6, 1.5, 0.4)[0], upscale=2, smallest_px=12) for k in range(6)]
    assert [[marker.id for marker in found] for found in read] == [[k] for k in range(6)]


def test_a_mirrored_marker_is_no_marker_but_is_seen_in_a_mirror() -> None:
    turned = np.ascontiguousarray(photograph(17, 6.0)[0][:, ::-1])
    assert find_markers(turned) == []
    assert [marker.id for marker in mirrored(turned)] == [17]


def test_no_registration_mark_is_read_in_a_mirror_as_another() -> None:
    turned = [np.ascontiguousarray(photograph(number, 6.0)[0][:, ::-1]) for number in REGISTRATION_IDS]
    assert [marker.id for picture in turned for marker in find_markers(picture)] == []


@pytest.mark.parametrize("family", [cv2.aruco.DICT_4X4_50, cv2.aruco.DICT_6X6_50, cv2.aruco.DICT_APRILTAG_36h11])
def test_markers_of_another_family_are_left_alone(family: int) -> None:
    page = np.full((150, 900), 215, np.uint8)
    for k in range(6):
        drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(family), 4 * k, 96)
        page[27:123, 27 + 145 * k : 123 + 145 * k] = drawn
    assert find_markers(page) == []


@pytest.mark.parametrize("seed", range(4))
def test_textures_hold_no_marker(seed: int) -> None:
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 2, (40, 40)).astype(np.uint8) * 180 + 30
    assert find_markers(cv2.resize(blocks, (400, 400), interpolation=cv2.INTER_NEAREST)) == []


def test_no_registration_mark_looks_like_another_one_mirrored() -> None:
    bits = codes("5x5_250")
    turned = np.array([np.rot90(code[:, ::-1], k) for code in bits for k in range(4)])
    apart = [np.abs(bits[number] - turned).sum(axis=(1, 2)).min() for number in REGISTRATION_IDS]
    assert min(apart) >= 3


@given(sigma=st.floats(0.05, 1.0), modules=st.integers(5, 10))
@settings(max_examples=30, deadline=None)
def test_blur_moves_no_ink(sigma: float, modules: int) -> None:
    places = np.linspace(-3, 3, 4001)
    ink = blur_matrix(places, modules, sigma).sum(axis=0) * (places[1] - places[0]) * modules / 2
    assert ink == pytest.approx(np.ones(modules), abs=5e-3)


def test_a_sharp_rendering_is_the_marker_itself() -> None:
    bits = codes("5x5_250")[3]
    places = sample_grid(7, 5)
    drawn = render(bits, places, (1e-3, 1e-3))
    assert np.array_equal(drawn[5:-5:5, 5:-5:5][:7, :7], bits)


@given(shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)), bend=st.floats(-0.1, 0.1))
@settings(max_examples=30, deadline=None)
def test_a_homography_is_found_again_from_its_points(shift: tuple[float, float], bend: float) -> None:
    H = np.array([[1.2, 0.1, shift[0]], [-0.2, 0.9, shift[1]], [bend, 0.05, 1.0]])
    points = np.array([[-1.0, -1.0], [1, -1], [1, 1], [-1, 1], [0.2, 0.3]])
    assert homography(points, warp(H, points)) == pytest.approx(H, abs=1e-8)


def test_an_id_in_a_mirror_is_not_read_as_a_blurred_mark_of_the_other_family() -> None:
    """With blur and place free, few modules of another code can be smeared until the whole correlates well."""
    rng = np.random.default_rng(6)
    picture = [no_marker(k, rng) for k in range(24)][23]
    assert find_markers(picture) == []


def test_what_is_no_marker_costs_one_quick_fit_each(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    pictures = [no_marker(k, rng) for k in range(8)]
    quick: list[bool] = []

    def counted(image: F64, bits: F64, H: F64, blur_px: float, *rest: int) -> Fit | None:
        quick.append(bool(rest))
        return fit(image, bits, H, blur_px, *rest)

    monkeypatch.setattr("fabctl.vision.markers.fit", counted)
    assert all(find_markers(picture) == [] for picture in pictures)
    assert len(quick) > 20
    assert quick.count(False) < 0.5 * quick.count(True)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_pale_marker_on_a_grainy_sheet_beside_a_dark_ground_is_found(seed: int) -> None:
    """Grain frays its outline in the full picture; a mark engraved on grey rubber looks like that."""
    rng = np.random.default_rng(seed)
    page = np.full((300, 300), 35.0)
    page[40:, 45:] = 190.0
    number = int(rng.integers(80, 100))
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250), number, 119)
    page[95:214, 100:219] = np.where(drawn > 0, 190.0, 165.0)
    grain = cv2.GaussianBlur(rng.normal(0, 1, page.shape), (0, 0), 1.5)
    seen = cv2.GaussianBlur(page * (1 + 0.05 * grain / grain.std()), (0, 0), 1.3) + rng.normal(0, 2, page.shape)
    assert [m.id for m in find_markers(np.clip(np.rint(seen), 0, 255).astype(np.uint8))] == [number]
