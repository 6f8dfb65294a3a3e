"""The deployed state out of its plane: the lab's thick rubber holds, a foil of it would not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from design.cells.homogenise import solve_pair
from design.cells.mesh import REFERENCE
from design.cells.periodic import PeriodicCell, periodic_cell, positions
from design.cells.sheet import Sheet
from design.cells.stability import out_of_plane_eigenvalues

Deployed = tuple[PeriodicCell, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def deployed() -> Deployed:
    found = solve_pair(1.2, math.radians(3), Sheet(), REFERENCE)
    assert isinstance(found, tuple)
    m, pair = found
    s = pair.stable.s_ratio
    cell = periodic_cell(m, 2)
    return cell, positions(cell, m, m.nodes(pair.stable.y, s), s), s * np.eye(2)


def test_the_deployed_sheet_is_stable_out_of_its_plane(deployed: Deployed) -> None:
    values = out_of_plane_eigenvalues(*deployed, thickness_mm=2.3)
    assert abs(values[0]) < 1e-9  # the whole sheet shifted
    assert values[1] > 1e-4


def test_a_foil_would_buckle_out_of_its_plane(deployed: Deployed) -> None:
    assert out_of_plane_eigenvalues(*deployed, thickness_mm=0.3)[0] < -1e-5


def test_the_flat_sheet_is_stable_at_any_thickness(deployed: Deployed) -> None:
    cell = deployed[0]
    for thickness_mm in (0.3, 2.3):
        values = out_of_plane_eigenvalues(cell, cell.rest_mm, np.eye(2), thickness_mm)
        assert abs(values[0]) < 1e-9 and values[1] > 0
