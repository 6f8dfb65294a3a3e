from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fabctl.scan.similarity import Similarity, axis_and_angle, best_similarity, rotation_of, spread_rotations

small = st.floats(-3, 3)
vectors = st.tuples(small, small, small).map(np.array)


@given(turn=vectors, shift=vectors, scale=st.floats(0.01, 100))
def test_a_map_after_its_inverse_moves_nothing(turn: np.ndarray, shift: np.ndarray, scale: float) -> None:
    move = Similarity(rotation_of(turn), shift, scale)
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.allclose(move.inverse()(move(points)), points, atol=1e-9)
    assert np.allclose(move.after(move.inverse())(points), points, atol=1e-9)


@given(turn=vectors, shift=vectors, scale=st.floats(0.01, 100))
def test_the_best_map_between_a_cloud_and_its_image_is_the_one_that_made_it(
    turn: np.ndarray, shift: np.ndarray, scale: float
) -> None:
    move = Similarity(rotation_of(turn), shift, scale)
    points = np.random.default_rng(1).normal(size=(30, 3))
    found = best_similarity(points, move(points))
    assert found.scale_ratio == pytest.approx(scale, rel=1e-9)
    assert np.allclose(found.rotation, move.rotation, atol=1e-9)


@given(turn=vectors.filter(lambda v: 0.05 < np.linalg.norm(v) < np.pi - 0.01))
def test_axis_and_angle_say_what_made_a_rotation(turn: np.ndarray) -> None:
    axis, angle = axis_and_angle(rotation_of(turn))
    assert angle == pytest.approx(np.linalg.norm(turn), abs=1e-6)
    assert np.allclose(axis * angle, turn, atol=1e-5)


def test_the_starting_rotations_leave_no_rotation_far_from_all() -> None:
    turns = spread_rotations(500)
    asked = np.stack([rotation_of(v) for v in np.random.default_rng(2).normal(size=(300, 3)) * 2])
    trace = np.einsum("aij,bij->ab", asked, turns).max(axis=1)
    assert np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max() < 32
