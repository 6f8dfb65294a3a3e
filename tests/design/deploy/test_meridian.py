"""The triangulated sheet answers an indenter as a shell that is computed from its meridian alone."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks._axisymmetric import pressed_N, spherical
from design.deploy.equilibrium import solve_level
from design.deploy.indentation import indentation_response

Y, NU, D, R = 0.2, 0.3, 0.15, 80.0


def even(polar: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.full(len(polar), Y), np.full(len(polar), NU), np.full(len(polar), D)


def test_the_meridian_begins_with_reissners_stiffness() -> None:
    meridian, nodes = spherical(R, np.pi / 3, 121, even)
    load = pressed_N(meridian, nodes, 8.0, np.array([0.02]))[0]
    assert load / 0.02 == pytest.approx(8 * np.sqrt(D * Y) / R, rel=0.05)


def test_triangles_and_meridian_agree_while_the_indenter_goes_in(cap_of) -> None:
    cap = cap_of(D_mJ=D)
    found = solve_level(cap.layout, cap.design_mm)
    response = indentation_response(cap.layout, found.x_mm, 8.0, 2.0, steps_count=4, parts=3)
    meridian, nodes = spherical(R, np.pi / 3, 121, even)
    loads = pressed_N(meridian, nodes, 8.0, response.depth_mm[1:])
    assert response.load_N[1:] == pytest.approx(loads, rel=0.1)
