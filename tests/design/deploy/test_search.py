"""Domes can stand either way: both are found from the intended shape."""

from __future__ import annotations

import numpy as np
import pytest

from design.deploy.equilibrium import solve_level
from design.deploy.levels import Layout
from design.deploy.search import bumps, equilibria, hinted, same_shape, turned_over


@pytest.fixture(scope="module")
def dumbbell(cap_of) -> Layout:
    """Return an even sheet with two places that grow more than the rest."""
    from dataclasses import replace

    layout = cap_of(apex_ratio=1.2).layout
    centre = layout.corners_mm.mean(axis=1)
    lam = 1.2 + sum(0.25 * np.exp(-np.sum((centre - [x, 0.0]) ** 2, axis=1) / 400) for x in (-36.0, 36.0))
    return replace(layout, expansion_ratio=lam, D_mJ=np.full(len(lam), 0.3))


def test_places_that_dome_are_told_from_saddles(dumbbell) -> None:
    found = bumps(dumbbell)
    centres = [dumbbell.corners_mm[group].mean(axis=(0, 1)) for group in found[:2]]
    assert sorted(c[0] for c in centres) == pytest.approx([-36, 36], abs=8)


def test_a_hint_pushes_the_bump_at_its_place_to_its_side(dumbbell) -> None:
    flat = dumbbell.flat_mm()
    design = np.column_stack(
        [1.2 * flat, sum(18 * np.exp(-np.sum((flat - [x, 0]) ** 2, axis=1) / 400) for x in (-36, 36))]
    )
    both_up = solve_level(dumbbell, design)
    again = hinted(dumbbell, design, [(-36.0, 0.0, 1.0), (36.0, 0.0, 1.0)])
    assert again.energy_mJ == pytest.approx(both_up.energy_mJ, rel=1e-6)
    with pytest.raises(ValueError, match="beside the sheet"):
        hinted(dumbbell, design, [(999.0, 0.0, 1.0)])
    one_down = hinted(dumbbell, design, [(30.0, 5.0, -1.0)])
    assert one_down.stable
    assert one_down.energy_mJ > 1.02 * both_up.energy_mJ
    mirrored = hinted(dumbbell, design, [(-30.0, 5.0, -1.0)])
    assert mirrored.energy_mJ == pytest.approx(one_down.energy_mJ, rel=1e-3)
    assert not same_shape(mirrored.x_mm, one_down.x_mm)


def test_a_bump_turned_over_is_another_equilibrium(dumbbell) -> None:
    flat = dumbbell.flat_mm()
    height = sum(18 * np.exp(-np.sum((flat - [x, 0.0]) ** 2, axis=1) / 400) for x in (-36.0, 36.0))
    design = np.column_stack([1.2 * flat, height])
    pushed = turned_over(dumbbell, design, bumps(dumbbell)[0], -1.0)
    assert np.ptp((pushed - design)[:, 2]) > 10
    found, _ = equilibria(dumbbell, design, count=0)
    starts = [start for one in found for start in one.starts]
    assert "designed, bump 1 down" in starts
    assert "designed, bump 1 down, then bump 2 down" in starts
    assert len(found) >= 3  # both up, either one down, and some with both down
    assert all(one.equilibrium.residual_ratio < 1e-8 for one in found)
