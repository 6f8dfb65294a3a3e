"""Known distances give a scan its millimetres, and contradicting ones are not averaged away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fabctl.errors import RefusedError, UsageError
from fabctl.vision.boards import scale_marks
from fabctl.vision.colmap import read_model
from fabctl.vision.scale import (
    Bar,
    ShotPose,
    marks_in_pictures,
    scale_by_bars,
    scale_by_marks,
    scale_by_shots,
    similarity,
    triangulate,
)

SHEET = scale_marks((300.0, 200.0))
PLACES_MM = {mark.id: np.array([mark.x_mm, mark.y_mm, 0.0]) for mark in SHEET.marks}
K = np.array([[1500.0, 0, 800.0], [0, 1500.0, 600.0], [0, 0, 1.0]])


def shot(azimuth_rad: float, noise_px: float = 0.0, seed: int = 0) -> tuple[ShotPose, dict[int, np.ndarray]]:
    """Return a picture from around the sheet, in units of 37 mm, and where it sees the marks."""
    import cv2

    eye = np.array([150 + 350 * np.cos(azimuth_rad), 100 + 350 * np.sin(azimuth_rad), 400.0]) / 37
    ahead = np.array([150, 100, 0.0]) / 37 - eye
    z = ahead / np.linalg.norm(ahead)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    R = np.array([x, np.cross(z, x), z])
    pose = ShotPose(K, np.array([-0.1, 0.02, 0.0, 0.0]), R, -R @ eye)
    points = np.array(list(PLACES_MM.values())) / 37
    pixels = cv2.projectPoints(points, cv2.Rodrigues(R)[0], pose.t, K, pose.distortion)[0].reshape(-1, 2)
    pixels = pixels + np.random.default_rng(seed).normal(0, noise_px, pixels.shape) if noise_px else pixels
    return pose, dict(zip(PLACES_MM, pixels, strict=True))


def test_marks_in_a_dozen_pictures_give_the_scale_to_a_fiftieth_of_a_percent() -> None:
    places = marks_in_pictures([shot(k * np.pi / 6, 0.1, k) for k in range(12)])
    made = scale_by_marks(places, SHEET)
    assert made.mm_per_unit_ratio == pytest.approx(37.0, rel=2e-4)
    assert abs(made.mm_per_unit_ratio / 37 - 1) < made.uncertainty_ratio < 1e-3
    corner = made.to_mm @ np.append(PLACES_MM[100] / 37, 1.0)
    assert corner[:3] == pytest.approx(PLACES_MM[100], abs=0.05)


@pytest.mark.parametrize(("noise_px", "pose_rad"), [(0.03, 5e-5), (0.005, 5e-5)])
def test_the_stated_uncertainty_covers_the_error_of_nearly_all_scans(noise_px: float, pose_rad: float) -> None:
    """Errors of poses move all marks of a picture together and leave no misfit between the marks."""
    errors, stated = np.array([_drawn(seed, noise_px, pose_rad) for seed in range(32)]).T
    assert np.abs(errors).max() < 2e-4
    assert np.mean(np.abs(errors) <= stated) >= 0.875  # 95 % of 32, less two standard deviations of chance
    assert np.max(stated) < 2e-4  # nor so wide that the scale would not be known well enough


def _drawn(seed: int, noise_px: float, pose_rad: float) -> tuple[float, float]:
    """Return error and stated uncertainty of one scan whose pixels and poses are off by chance."""
    import cv2

    rng = np.random.default_rng([seed, 1])
    shots = []
    for k in range(12):
        pose, seen = shot(k * np.pi / 6)
        wobble = np.asarray(cv2.Rodrigues(rng.normal(0, pose_rad, 3))[0])
        noisy = {number: pixel + rng.normal(0, noise_px, 2) for number, pixel in seen.items()}
        shots.append((replace(pose, R=wobble @ pose.R, t=wobble @ pose.t), noisy))
    made = scale_by_shots(shots, SHEET)
    return made.mm_per_unit_ratio / 37 - 1, made.uncertainty_ratio


def test_a_scale_that_hangs_on_one_picture_states_no_uncertainty() -> None:
    assert np.isinf(scale_by_shots([shot(0.3), shot(1.9)], SHEET).uncertainty_ratio)


@given(
    scale=st.floats(1e-3, 1e3), turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-100, 100)] * 3)
)
@settings(max_examples=40, deadline=None)
def test_a_similarity_is_found_again(scale: float, turn: tuple[float, ...], shift: tuple[float, ...]) -> None:
    points = np.random.default_rng(3).normal(size=(6, 3))
    R = Rotation.from_rotvec(turn).as_matrix()
    found, found_R, found_t = similarity(points, scale * points @ R.T + shift)
    assert found == pytest.approx(scale, rel=1e-9)
    assert found_R == pytest.approx(R, abs=1e-7)
    assert found_t == pytest.approx(np.array(shift), abs=1e-6 * max(1, scale))


def test_a_mark_that_was_moved_is_left_out_by_name() -> None:
    places = {k: place / 37 for k, place in PLACES_MM.items()}
    places[102] = places[102] + np.array([0.4, 0.0, 0.0])
    made = scale_by_marks(places, SHEET)
    assert made.mm_per_unit_ratio == pytest.approx(37.0)
    assert [finding.code for finding in made.findings] == ["SCALE-MARK-DROPPED"]
    assert "mark 102" in made.findings[0].message


def test_two_marks_are_too_few_and_four_that_contradict_are_refused() -> None:
    with pytest.raises(RefusedError, match="2 marks"):
        scale_by_marks({k: PLACES_MM[k] for k in (100, 101)}, SHEET)
    four = {k: PLACES_MM[k].copy() for k in (100, 101, 102, 103)}
    four[103] += 20.0
    with pytest.raises(RefusedError, match="scales that differ"):
        scale_by_marks(four, SHEET)


def test_bars_give_the_scale_and_contradicting_bars_are_refused() -> None:
    bars = [
        Bar(np.array([0, 0, 0]), np.array([2, 0, 0]), 50.0),
        Bar(np.array([0, 0, 0]), np.array([0, 4.001, 0]), 100.0),
    ]
    assert scale_by_bars(bars).mm_per_unit_ratio == pytest.approx(25.0, rel=3e-4)
    assert [f.code for f in scale_by_bars(bars[:1]).findings] == ["SCALE-ONE-BAR"]
    with pytest.raises(RefusedError, match="differ by"):
        scale_by_bars([bars[0], Bar(np.array([0, 0, 0]), np.array([0, 4.1, 0]), 100.0)])
    with pytest.raises(RefusedError, match="two different points"):
        scale_by_bars([Bar(np.array([0, 0, 0]), np.array([0, 0, 0]), 10.0)])


def test_rays_that_hardly_differ_or_do_not_meet_place_nothing() -> None:
    one, seen = shot(0.3)
    assert triangulate([(one, seen[100])]) is None
    assert triangulate([(one, seen[100]), (one, seen[100])]) is None
    other, there = shot(1.9)
    assert triangulate([(one, seen[100]), (other, there[103])]) is None


def test_a_colmap_model_is_read_and_a_broken_one_named_by_line(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# cameras\n1 OPENCV 1600 1200 1500 1501 800 600 -0.1 0.02 0 0\n")
    (tmp_path / "images.txt").write_text(
        "# images\n1 0.7071068 0 0 0.7071068 1 2 3 1 a b.png\n\n2 1 0 0 0 0 0 1 1 c.png\n1 2 3\n"
    )
    model = read_model(tmp_path)
    assert list(model) == ["a b.png", "c.png"]
    assert model["a b.png"].R @ np.array([1.0, 0, 0]) == pytest.approx([0, 1, 0], abs=1e-6)
    assert model["c.png"].K[1, 1] == 1501
    (tmp_path / "cameras.txt").write_text("1 FISHEYE 1600 1200 1500\n")
    with pytest.raises(UsageError, match=r"cameras\.txt:1: not a camera"):
        read_model(tmp_path)
