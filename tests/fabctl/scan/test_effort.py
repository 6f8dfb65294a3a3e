"""What keeps a scan of a million points quick without making it wrong."""

from __future__ import annotations

from itertools import cycle

import numpy as np
import pytest

from fabctl.scan import refine as refining
from fabctl.scan.judge import thin
from fabctl.scan.similarity import IDENTITY
from tests.fabctl.scan.conftest import TARGETS


def test_stray_points_of_a_dense_cloud_do_not_fill_the_even_samples() -> None:
    rng = np.random.default_rng(1)
    surface = np.concatenate([rng.uniform(-1, 1, (100_000, 2)), 1e-3 * rng.normal(size=(100_000, 1))], axis=1)
    stray = rng.uniform(-1, 1, (5000, 3)) * [1, 1, 0.5]
    samples = thin(np.concatenate([surface, stray]), 8000, seed=0)
    assert len(samples) > 6000
    assert np.mean(np.abs(samples[:, 2]) > 0.05) < 0.02


def test_a_thin_cloud_keeps_its_lone_points() -> None:
    points = np.random.default_rng(1).uniform(-1, 1, (9000, 3))
    assert len(thin(points, 8000, seed=0)) > 6000


def test_a_fit_whose_steps_undo_each_other_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    target = TARGETS["freeform"]
    points, _, _ = target.even_samples(3000)
    solved, signs = refining.solve, cycle((1.0, -1.0))

    def back_and_forth(
        rows: refining.Rows, rim: refining.Rim | None, options: refining.Options, *, sliding: bool
    ) -> tuple[refining.Floats, refining.Floats, refining.Floats, float]:
        return next(signs) * np.full(7, 2e-5), *solved(rows, rim, options, sliding=sliding)[1:]

    monkeypatch.setattr(refining, "solve", back_and_forth)
    assert refining.refine(points, IDENTITY, target, refining.Options(slides=False)).steps_count == 2
