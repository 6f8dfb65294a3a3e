"""The flattening converges to closed forms as the mesh is refined."""

from __future__ import annotations

import math

import numpy as np
import pytest

from design.flatten import flatten
from design.flatten.quality import distortion
from design.targets import cap


def cap_errors(half_angle_rad: float, edge_mm: float) -> tuple[float, float]:
    """Return the largest error of u against the stereographic one, and mean distortion minus one."""
    mesh = cap(80.0, half_angle_rad, edge_mm)
    flat = flatten(mesh)
    polar_rad = np.arccos((mesh.vertices_mm[:, 2] / 80.0 + math.cos(half_angle_rad)).clip(-1, 1))
    exact_u = np.log((1 + np.cos(half_angle_rad)) / (1 + np.cos(polar_rad)))
    return float(np.abs(flat.u - exact_u).max()), distortion(mesh, flat.flat_mm, flat.faces).mean_ratio - 1


@pytest.mark.parametrize("half_angle_rad", [math.pi / 6, math.pi / 3, math.pi / 2])
def test_scale_factors_of_a_cap_converge_to_stereographic_ones(half_angle_rad: float) -> None:
    sizes_mm = np.array([8.0, 4.0, 2.0])
    errors = np.array([cap_errors(half_angle_rad, size_mm)[0] for size_mm in sizes_mm])
    rate = np.polyfit(np.log(sizes_mm), np.log(errors), 1)[0]
    assert rate == pytest.approx(2.0, abs=0.35)


def test_distortion_vanishes_in_proportion_to_the_mesh_size() -> None:
    sizes_mm = np.array([8.0, 4.0, 2.0])
    excess = np.array([cap_errors(math.pi / 3, size_mm)[1] for size_mm in sizes_mm])
    assert (np.polyfit(np.log(sizes_mm), np.log(excess), 1)[0]) > 0.9
