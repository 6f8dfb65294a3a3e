"""Expansions are changed so that the sheet at rest meets its target, or left alone."""

from __future__ import annotations

import numpy as np
import pytest

from design.deploy.compensate import compensate, force_derivative
from design.deploy.equilibrium import solve_level
from design.deploy.newton import System


@pytest.fixture(scope="module")
def cap(cap_of):
    return cap_of(edge_mm=16.0, D_mJ=2.0)


def test_the_forces_derivative_by_expansion_is_right_in_any_direction(cap) -> None:
    from dataclasses import replace

    layout = cap.layout
    x = solve_level(layout, cap.design_mm).x_mm
    way = np.random.default_rng(0).normal(size=len(layout.cells))

    def forces(step):
        lam = layout.expansion_ratio + step * way
        return System(replace(layout, expansion_ratio=lam).shell()).gradient(x)[1]

    expected = (forces(1e-6) - forces(-1e-6)) / 2e-6
    found = (force_derivative(layout, x) @ way).reshape(expected.shape)
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


def test_a_compensated_cap_meets_its_sphere(cap) -> None:
    found = compensate(cap.layout, cap.design_mm, (1.0, 1.9))
    assert found.helps
    assert found.after_mm < found.before_mm / 3
    assert found.equilibrium.residual_ratio < 1e-8
    assert found.equilibrium.stable
    again = solve_level(found.layout, cap.design_mm)
    assert again.energy_mJ == pytest.approx(found.equilibrium.energy_mJ, rel=1e-6)


def test_expansions_stay_within_the_library(cap) -> None:
    low, high = cap.layout.expansion_ratio.min(), cap.layout.expansion_ratio.max()
    found = compensate(cap.layout, cap.design_mm, (low, high))
    assert found.layout.expansion_ratio.min() >= low
    assert found.layout.expansion_ratio.max() <= high


def test_a_sheet_that_cannot_be_bettered_is_left_as_it_is(cap) -> None:
    fixed = float(cap.layout.expansion_ratio.mean())
    even = cap.layout.__class__(
        **{
            **{name: getattr(cap.layout, name) for name in cap.layout.__slots__},
            "expansion_ratio": np.full(len(cap.layout.cells), fixed),
        }
    )
    found = compensate(even, cap.design_mm, (fixed, fixed))
    assert not found.helps
    assert np.all(found.layout.expansion_ratio == fixed)
