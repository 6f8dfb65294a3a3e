"""Expansions are changed so that the sheet at rest meets its target, or left alone."""

from __future__ import annotations

import numpy as np
import pytest

from design.cells.sheet import Sheet
from design.deploy.compensate import compensate, force_derivative, misfit_mm
from design.deploy.equilibrium import solve_level
from design.deploy.newton import System
from design.deploy.standing import standing


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


@pytest.mark.parametrize("support", ["held", "no-slip", "slip", "coulomb"])
def test_a_cap_that_bears_its_weight_is_brought_nearer_to_its_sphere(cap, support) -> None:
    sheet = Sheet(density_kg_m3=2_000.0)
    held = standing(cap.layout, cap.design_mm, sheet, support)
    free = solve_level(cap.layout, cap.design_mm)
    loaded = solve_level(cap.layout, cap.design_mm, held.loads, held.fixed)
    assert abs(loaded.x_mm - free.x_mm).max() > 0.05
    found = compensate(cap.layout, cap.design_mm, (1.0, 1.9), standing=held)
    assert found.helps
    assert found.before_mm == pytest.approx(misfit_mm(loaded.x_mm, cap.design_mm, held))
    assert found.after_mm < found.before_mm / 3
    again = solve_level(found.layout, cap.design_mm, held.loads, held.fixed)
    assert misfit_mm(again.x_mm, cap.design_mm, held) == pytest.approx(found.after_mm, rel=1e-3)


def test_a_held_rim_does_not_move_and_the_rest_of_the_misfit_counts_where_it_stands(cap) -> None:
    held = standing(cap.layout, cap.design_mm, Sheet(), "held")
    rest = solve_level(cap.layout, cap.design_mm, held.loads, held.fixed)
    assert held.fixed is not None
    assert np.all(rest.x_mm[held.fixed] == cap.design_mm[held.fixed])
    assert misfit_mm(rest.x_mm + np.eye(3)[0], rest.x_mm, held) == pytest.approx(1.0)
    free = standing(cap.layout, cap.design_mm, Sheet(), "free")
    assert misfit_mm(rest.x_mm + np.eye(3)[0], rest.x_mm, free) == pytest.approx(0.0, abs=1e-9)


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
