"""Sheets pop into the surface they were designed for."""

from __future__ import annotations

import numpy as np
import pytest

from design.deploy.equilibrium import from_flat, pushed_flat, solve_level
from design.deploy.indentation import indentation_response, response_csv
from design.deploy.levels import coarsen, levels, prolong, refine
from design.deploy.newton import System, solve
from design.deploy.predict import compared, deploy
from design.errors import NotConverged


@pytest.fixture(scope="module")
def cap(cap_of):
    return cap_of()


@pytest.fixture(scope="module")
def popped(cap):
    return deploy(cap.layout, cap.target, cap.design_mm)


def test_the_deployed_cap_lies_on_its_sphere(cap, popped) -> None:
    assert popped.equilibrium.residual_ratio < 1e-8
    assert popped.equilibrium.stable
    assert popped.deviation.mean_frac < 0.002
    assert popped.deviation.points_rms_mm < 1.0


def test_from_flat_the_cap_finds_the_same_shape(cap, popped) -> None:
    found = from_flat(cap.layout)
    again = compared(cap.layout, found, cap.target, cap.design_mm)
    assert found.energy_mJ == pytest.approx(popped.equilibrium.energy_mJ, rel=1e-6)
    assert np.abs(again.mesh.vertices_mm - popped.mesh.vertices_mm).max() < 0.01


def test_a_push_to_the_other_side_gives_the_mirror_image(cap, popped) -> None:
    found = from_flat(cap.layout, lambda level: pushed_flat(level, -0.3))
    assert found.energy_mJ == pytest.approx(popped.equilibrium.energy_mJ, rel=1e-6)
    turned = compared(cap.layout, found, cap.target, cap.design_mm)
    assert turned.deviation.mean_mm > 10 * popped.deviation.mean_mm


def fitted_radius_mm(x: np.ndarray) -> float:
    fit = np.linalg.lstsq(np.column_stack([2 * x, np.ones(len(x))]), np.sum(x**2, axis=1), rcond=None)[0]
    return float(np.sqrt(fit[3] + fit[:3] @ fit[:3]))


def test_the_sphere_has_its_radius_when_bending_costs_nothing(cap_of) -> None:
    caps = [cap_of(edge_mm=edge, D_mJ=1e-4 * edge**2) for edge in (6.0, 3.0)]
    errors = [fitted_radius_mm(solve_level(cap.layout, cap.design_mm).x_mm) / cap.radius_mm - 1 for cap in caps]
    assert abs(errors[1]) < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4, abs=1)  # second order in the unit's side


def test_a_coarser_sheet_covers_the_finer_one(cap_of) -> None:
    cap = cap_of(edge_mm=5.0)
    coarse = coarsen(cap.layout)
    assert coarse is not None
    assert coarse.edge_mm == pytest.approx(10.0)
    assert len(coarse.cells) == pytest.approx(len(cap.layout.cells) / 4, rel=0.1)
    flat = coarse.flat_mm()
    lifted = np.column_stack([flat, 3 + 0.5 * flat[:, 0]])
    fine = prolong(coarse, lifted, cap.layout)
    assert np.allclose(fine[:, :2], cap.layout.flat_mm())
    assert np.allclose(fine[:, 2], 3 + 0.5 * cap.layout.flat_mm()[:, 0])
    assert [len(level.cells) for level in levels(cap.layout)] == sorted(
        len(level.cells) for level in levels(cap.layout)
    )


def test_a_finer_sheet_starts_on_the_curved_surface_not_on_its_facets(cap_of) -> None:
    away = []
    for edge_mm in (5.0, 2.5):
        coarse, fine = cap_of(edge_mm=2 * edge_mm), cap_of(edge_mm=edge_mm)
        start = prolong(coarse.layout, coarse.design_mm, fine.layout)
        inside = np.linalg.norm(fine.layout.flat_mm(), axis=1) < 40
        away.append(np.abs(np.linalg.norm(start[inside], axis=1) - 80).max())
    assert away[0] < 0.1  # facets of 15 mm lie 0.35 mm within the sphere
    assert np.log2(away[0] / away[1]) > 2.5  # facets would give 2


def test_dividing_units_keeps_the_sheet_and_its_mean_expansion(cap) -> None:
    fine = refine(cap.layout, 3)
    lam = fine.expansion_ratio.reshape(-1, 9)
    assert np.allclose(lam.mean(axis=1), cap.layout.expansion_ratio)
    assert np.allclose(fine.flat_mm()[: cap.layout.vertex_count], cap.layout.flat_mm())
    reach = 160 / 1.505
    exact = 1.505 / (1 + np.sum((fine.corners_mm.mean(axis=1) / reach) ** 2, axis=1))
    assert np.abs(fine.expansion_ratio - exact).max() < 0.01


def test_too_few_iterations_are_an_error_with_the_residual(cap) -> None:
    with pytest.raises(NotConverged) as refused:
        solve(System(cap.layout.shell()), pushed_flat(cap.layout), iterations_max=2)
    assert refused.value.iterations_count == 2
    assert refused.value.residual_ratio > 1e-9


def test_a_start_that_is_no_shape_is_an_error_and_not_a_loop(cap) -> None:
    nowhere = np.array(cap.design_mm)
    nowhere[0] = np.nan
    with pytest.raises(NotConverged):
        solve(System(cap.layout.shell()), nowhere)


def test_a_pressed_cap_pushes_back_and_recovers(cap, popped) -> None:
    response = indentation_response(cap.layout, popped.mesh.vertices_mm, 8.0, 2.0, steps_count=4, parts=1)
    assert response.load_N[0] == pytest.approx(0, abs=1e-9)
    assert np.all(np.diff(response.load_N) > 0)
    assert response.residual_ratio < 1e-8
    assert response.recovered_mm < 1e-6
    assert response.iterations_count > 8
    assert response.unstable_count == 0
    assert response.smallest_eigenvalue_N_mm > 0
    assert response.unload_N == pytest.approx(response.load_N, abs=1e-6)
    stiffer = cap.layout.__class__(
        **{**{f: getattr(cap.layout, f) for f in cap.layout.__slots__}, "D_mJ": 4 * cap.layout.D_mJ}
    )
    again = indentation_response(stiffer, popped.mesh.vertices_mm, 8.0, 2.0, steps_count=4, parts=1)
    ratio = again.stiffness_N_mm(2.0) / response.stiffness_N_mm(2.0)
    assert 1.5 < ratio < 3.0  # a shell's stiffness goes with √(DY)


def test_response_csv_can_be_read_back(cap, popped) -> None:
    response = indentation_response(cap.layout, popped.mesh.vertices_mm, 8.0, 1.0, steps_count=2, parts=1)
    first, header, *rows = response_csv(response).splitlines()
    assert first.startswith("# fabctl response 1; indenter_radius_mm=8; point_mm=")
    assert first.endswith("direction=0,0,-1")
    assert header == "depth_mm,load_N,unload_N"
    table = np.array([[float(v) for v in row.split(",")] for row in rows])
    assert table[:, 0] == pytest.approx([0, 0.5, 1.0])
    assert table[:, 1] == pytest.approx(response.load_N, rel=1e-6, abs=1e-9)
