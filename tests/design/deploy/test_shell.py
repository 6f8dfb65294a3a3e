"""The shell's energy is differentiated without error, and its rest shape means what it says."""

from __future__ import annotations

import numpy as np
import pytest

from design.deploy.factor import factorise
from design.deploy.indentation import Sphere
from design.deploy.newton import System, fold_angles, pins, smallest_eigenvalue_N_mm, solve
from design.deploy.shell import build_shell, neighbours, rest_sides_mm


@pytest.fixture(scope="module")
def bent(cap_of):
    cap = cap_of(edge_mm=16.0, D_mJ=40.0)
    x = cap.design_mm + np.random.default_rng(3).normal(size=cap.design_mm.shape) * 0.8
    return System(cap.layout.shell()), x


def central(function, x, way, step=1e-5):
    return (function(x + step * way) - function(x - step * way)) / (2 * step)


def test_the_gradient_is_the_slope_of_the_energy(bent) -> None:
    system, x = bent
    rng = np.random.default_rng(1)
    for _ in range(5):
        way = rng.normal(size=x.shape)
        expected = central(system.energy, x, way)
        assert np.sum(system.gradient(x)[1] * way) == pytest.approx(expected, rel=1e-6)


def test_the_hessian_is_the_slope_of_the_gradient(bent) -> None:
    system, x = bent
    rng = np.random.default_rng(2)
    hessian = system.linearise(x)[2]
    assert abs(hessian - hessian.T).max() < 1e-10
    for _ in range(5):
        way = rng.normal(size=x.shape)
        expected = central(lambda y: system.gradient(y)[1], x, way)
        found = (hessian @ way.ravel()).reshape(x.shape)
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


def test_an_indenting_sphere_is_differentiated_without_error(bent) -> None:
    system, x = bent
    ball = Sphere(np.array([3.0, -2.0, 85.0]), 14.0, np.full(len(x), 2.0))
    assert ball.energy(x) > 0
    way = np.random.default_rng(4).normal(size=x.shape)
    energy, gradient = system.gradient(x, [ball])
    assert np.sum(gradient * way) == pytest.approx(central(lambda y: system.energy(y, [ball]), x, way), rel=1e-6)
    slope = central(lambda y: system.gradient(y, [ball])[1], x, way)
    found = (system.linearise(x, [ball])[2] @ way.ravel()).reshape(x.shape)
    assert np.abs(found - slope).max() < 1e-6 * np.abs(slope).max()
    assert energy == pytest.approx(system.energy(x, [ball]))


def test_neighbours_agree_on_the_length_of_a_shared_side() -> None:
    cells = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2]])
    lam = np.array([1.2, 1.5, 1.7])
    across = neighbours(cells)
    deployed = lam[:, None] * rest_sides_mm(lam, across, 10.0)
    assert deployed[0, 0] == pytest.approx(deployed[1, 1]) == pytest.approx(10 * (1.2 + 1.5) / 2)
    assert np.allclose(rest_sides_mm(lam, across, 10.0).mean(axis=1), 10.0)


def test_an_even_sheet_costs_nothing_when_it_is_flat_and_swollen(lattice) -> None:
    flat, cells = lattice(5, 4, 10.0)
    system = System(build_shell(cells, 1.4, 0.3, 0.2, 0.1, 10.0))
    x = np.column_stack([1.4 * flat, np.zeros(len(flat))])
    energy, gradient = system.gradient(x)
    assert energy == pytest.approx(0, abs=1e-12)
    assert np.abs(gradient).max() < 1e-12


def test_stretching_an_even_sheet_costs_what_plane_stress_says(lattice) -> None:
    flat, cells = lattice(6, 6, 10.0)
    Y, nu, strain = 0.3, 0.25, 1e-5
    shell = build_shell(cells, 1.0, Y, nu, 0.1, 10.0)
    x = np.column_stack([flat * [1 + strain, 1 - nu * strain], np.zeros(len(flat))])
    expected = 0.5 * Y * strain**2 * shell.area_mm2.sum()
    assert System(shell).energy(x) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, np.pi / 6, np.pi / 2])
def test_a_cylinder_costs_half_D_kappa_squared_in_every_direction(lattice, angle_rad: float) -> None:
    flat, cells = lattice(30, 30, 10.0)
    D, kappa = 0.7, 1e-4
    shell = build_shell(cells, 1.0, 0.3, 0.2, D, 10.0)
    along = flat @ [np.cos(angle_rad), np.sin(angle_rad)]
    theta = fold_angles(np.column_stack([flat, 0.5 * kappa * along**2]), shell.hinges)
    side = flat[shell.hinges[:, 1]] - flat[shell.hinges[:, 0]]
    turn = np.rint(np.arctan2(side[:, 1], side[:, 0]) / (np.pi / 3)).astype(int) % 3
    cost = 0.5 * shell.fold_mJ * theta**2
    per_pair = sum(cost[turn == k].mean() for k in range(3))  # three hinges to two units
    assert per_pair == pytest.approx(0.5 * D * kappa**2 * 2 * shell.area_mm2[0], rel=0.005)


def test_pinning_a_free_body_leaves_its_equilibrium_without_soft_directions(cap_of) -> None:
    cap = cap_of(edge_mm=16.0)
    system = System(cap.layout.shell())
    found = solve(system, cap.design_mm)
    assert pins(found.x_mm).sum() == 6
    assert found.stable
    assert smallest_eigenvalue_N_mm(system, found.x_mm, (), None) > 1e-5
    free = factorise(system.shifted(system.linearise(found.x_mm)[2], 1e-9))[1]
    assert free == 0
    moved = solve(system, found.x_mm + np.array([1.0, 2.0, 3.0]))
    assert moved.iterations_count <= 1


def test_three_units_on_one_edge_are_refused() -> None:
    with pytest.raises(ValueError, match="more than two"):
        neighbours(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
