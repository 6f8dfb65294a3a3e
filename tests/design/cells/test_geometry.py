"""The parametric cell: bounds, slits, sound polygons, and a mesh that fills them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.cells.geometry import (
    cell_slits,
    fault,
    inner_side_mm,
    sector,
    self_crossing,
    strip_mm,
    t_bounds_mm,
)
from design.cells.mesh import REFERENCE, fitting, nodes_mm, topology, vertices_mm
from design.cells.sector import ties
from design.cells.sheet import Sheet
from design.cells.sweep import column_t_mm, plan_of, thetas_rad

SHEET = Sheet()
angles = st.floats(-math.pi / 6, math.pi / 6)
shares = st.floats(0.01, 0.99)


def area_mm2(ring: np.ndarray) -> float:
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - np.roll(x, -1) @ y)


@given(theta=st.floats(-math.pi / 6, 0.4))
def test_the_bounds_are_where_strip_and_inner_triangle_vanish(theta: float) -> None:
    low, high = t_bounds_mm(theta, SHEET)
    assert inner_side_mm(high, theta, SHEET) == pytest.approx(0, abs=1e-9)
    if low > 0:
        assert strip_mm(low, theta, SHEET) == pytest.approx(0, abs=1e-9)


def test_the_paper_has_7552_candidates() -> None:
    plan = plan_of(SHEET)
    assert sum(len(column_t_mm(plan, theta)) for theta in thetas_rad(plan)) == 7552


@given(theta=angles, share=shares)
def test_three_sectors_and_three_slits_fill_the_unit(theta: float, share: float) -> None:
    low, high = t_bounds_mm(theta, SHEET)
    low = max(low + 0.05, 0.5)
    if high <= low:
        return
    t = low + share * (high - low)
    if fault(t, theta, SHEET) is not None:
        return
    filled = 3 * area_mm2(sector(t, theta, SHEET).outline_mm())
    cut = sum(abs(area_mm2(ring)) for ring in cell_slits(t, theta, SHEET))
    assert filled + cut == pytest.approx(25 * math.sqrt(3), rel=1e-9)


@settings(max_examples=60)
@given(theta=angles, share=shares)
def test_the_template_never_folds_and_fills_the_sector(theta: float, share: float) -> None:
    low, high = t_bounds_mm(theta, SHEET)
    low = max(low + 0.01, 0.5)
    if high <= low:
        return
    t = low + share * (high - low)
    assert fault(t, theta, SHEET) is None
    part = sector(t, theta, SHEET)
    density = fitting(part, REFERENCE)
    corners = vertices_mm(part, density)[topology(density).triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(area_mm2(part.outline_mm()), rel=1e-9)


def test_the_reference_mesh_has_about_1600_elements_a_hexagon() -> None:
    assert 18 * len(topology(REFERENCE).triangles) == 1530


def test_the_hinge_lies_its_width_away_from_the_next_slit() -> None:
    first, second, _ = cell_slits(1.2, 0.05, SHEET)
    inner_start, inner_end = second[3], second[2]
    along = (inner_end - inner_start) / np.linalg.norm(inner_end - inner_start)
    for tip in first[1:3]:
        offset = tip - inner_start
        assert abs(along[0] * offset[1] - along[1] * offset[0]) == pytest.approx(SHEET.hinge_mm, rel=1e-9)


def test_the_slit_takes_its_width_along_the_edge() -> None:
    first = cell_slits(1.2, 0.05, SHEET)[0]
    assert np.linalg.norm(first[3] - first[0]) == pytest.approx(SHEET.slit_mm)
    assert np.linalg.norm(first[0]) == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("t_mm", "theta_deg", "why"),
    [(0.0, 0.0, "corner"), (9.95, 0.0, "corner"), (1.5, -20.0, "mirror edge"), (5.2, 25.0, "")],
)
def test_what_is_no_cell_is_refused_with_the_reason(t_mm: float, theta_deg: float, why: str) -> None:
    reason = fault(t_mm, math.radians(theta_deg), SHEET)
    assert reason is not None and why in reason


def test_a_bow_tie_crosses_itself() -> None:
    assert self_crossing(np.array([[0.0, 0], [1, 1], [1, 0], [0, 1]]))
    assert not self_crossing(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))


def test_images_under_the_turn_are_images() -> None:
    part = sector(1.2, 0.05, SHEET)
    nodes = nodes_mm(vertices_mm(part, REFERENCE), REFERENCE)
    top = topology(REFERENCE)
    turn = np.array([[-0.5, -math.sqrt(0.75)], [math.sqrt(0.75), -0.5]])
    np.testing.assert_allclose((nodes[top.cut] - part.centre) @ turn.T + part.centre, nodes[top.cut_turned], atol=1e-9)
    assert ties(REFERENCE).width < 60
