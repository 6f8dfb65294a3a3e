"""Refining the cell's mesh: the energy falls, the answers settle, and the drift is the one that is told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from design.cells.homogenise import solve_cell
from design.cells.mesh import REFERENCE
from design.cells.sector import model, relax
from design.cells.sheet import Sheet

SHEET = Sheet()


def test_the_energy_of_a_held_stretch_falls_with_every_refinement() -> None:
    energies = []
    for factor in (1, 2, 4):
        m = model(1.2, 0.05, SHEET, REFERENCE.refined(factor))
        state = relax(m, m.rest, 1.02)
        assert state.converged
        energies.append(state.energy_mm2)
    assert energies[0] > energies[1] > energies[2]
    # Corners of slits are singular: the energy converges, slower than for a smooth solution.
    rate = math.log2((energies[0] - energies[1]) / (energies[1] - energies[2]))
    assert 0.6 < rate < 4.5


def test_half_the_mesh_size_moves_the_expansion_by_less_than_three_thousandths() -> None:
    for t_mm, theta_deg in ((1.2, 3.0), (0.8, 0.0), (1.8, -4.0)):
        coarse = solve_cell(t_mm, math.radians(theta_deg), SHEET)
        fine = solve_cell(t_mm, math.radians(theta_deg), SHEET, REFERENCE.refined(2))
        assert coarse.expansion_ratio is not None and fine.expansion_ratio is not None
        assert 0.0005 < fine.expansion_ratio - coarse.expansion_ratio < 0.003


def test_more_elements_along_the_arm_settle_the_stiffness() -> None:
    found = [
        solve_cell(0.6, math.radians(2), SHEET, replace(REFERENCE, columns=columns)).stiffness_mm2
        for columns in (6, 9, 18)
    ]
    first, second, third = (value or np.nan for value in found)
    assert abs(second - third) < abs(first - third)
    assert second == pytest.approx(third, rel=0.03)
