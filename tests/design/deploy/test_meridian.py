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


def test_triangles_come_to_the_meridians_load_as_they_get_smaller(cap_of) -> None:
    cap = cap_of(D_mJ=D)
    found = solve_level(cap.layout, cap.design_mm)
    meridian, nodes = spherical(R, np.pi / 3, 121, even)
    wanted = pressed_N(meridian, nodes, 8.0, np.array([1.0, 2.0]))
    off = {}
    for parts in (2, 4):
        response = indentation_response(cap.layout, found.x_mm, 8.0, 2.0, steps_count=2, parts=parts)
        off[parts] = response.load_N[1:] / wanted - 1
    assert (np.abs(off[4]) < 0.5 * np.abs(off[2])).all()  # 13 % softer, then 4.5 %; 2 % with 6² a unit
    assert (np.abs(off[4]) < 0.06).all()
