"""The contracting kind: cut open, closing to a second stable state."""

from __future__ import annotations

import math

import numpy as np
import pytest

from design.cells.homogenise import solve_pair
from design.cells.mesh import REFERENCE
from design.cells.open_cells import open_model, overlap_frac, solve_open_cell
from design.cells.sheet import Sheet

SHEET = Sheet()


def test_an_open_cell_closes_to_nearly_the_size_of_the_slit_one() -> None:
    cell, _ = solve_open_cell(1.2, math.radians(3), SHEET)
    assert cell.verdict == "bistable" and cell.expansion_ratio is not None and cell.open_ratio is not None
    assert cell.expansion_ratio < 1
    assert cell.expansion_ratio * cell.open_ratio == pytest.approx(1.0, abs=0.03)
    assert cell.barrier_mm2 is not None and cell.barrier_mm2 > 0 and cell.overlap_frac == 0


def test_the_open_cell_is_free_of_stress_where_the_slit_cell_is_deployed() -> None:
    found = solve_pair(1.2, math.radians(3), SHEET, REFERENCE)
    assert isinstance(found, tuple)
    m = open_model(*found, SHEET)
    assert m.energy_mm2(m.rest, 1.0) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(m.nodes(m.rest, 1.0), m.rest_mm, atol=1e-9)


def test_material_on_material_is_seen() -> None:
    found = solve_pair(1.2, math.radians(3), SHEET, REFERENCE)
    assert isinstance(found, tuple)
    m, _ = found
    assert overlap_frac(m, m.rest_mm, 1.0) == 0
    assert overlap_frac(m, 1.02 * m.rest_mm, 1.0) > 0.01


def test_a_cell_that_does_not_open_has_no_open_kind() -> None:
    cell, _ = solve_open_cell(3.0, 0.0, SHEET)
    assert cell.verdict == "not bistable" and cell.reason.startswith("as a slit cell")
