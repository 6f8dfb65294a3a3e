"""One cell's mechanics: derivatives, symmetry reduction against whole periodic cells, and an independent assembly."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from design.cells import homogenise, kernels
from design.cells.elements import THREE_POINTS, gradients
from design.cells.homogenise import Failure, Pair, is_shallow, solve_cell, solve_pair
from design.cells.mesh import REFERENCE, topology
from design.cells.periodic import (
    derivatives,
    equilibrium,
    factored,
    periodic_cell,
    positions,
    smallest_eigenvalues,
    uniaxial_curve,
)
from design.cells.sector import Model, model, raw_tangent, relax
from design.cells.sheet import Sheet
from design.cells.tangent import moduli

SHEET = Sheet()
T_MM, THETA_RAD = 1.2, math.radians(3.0)


@pytest.fixture(scope="module")
def solved() -> tuple[Model, Pair]:
    found = solve_pair(T_MM, THETA_RAD, SHEET, REFERENCE)
    assert isinstance(found, tuple)
    return found


@pytest.mark.parametrize("F", [np.array([[1.3, 0.2], [-0.1, 0.8]]), np.array([[0.6, 0.0], [0.3, 1.9]])])
def test_stress_and_moduli_are_derivatives_of_the_energy_density(F: np.ndarray) -> None:
    mu, lam = kernels.lame_MPa(1.5, 0.45)

    def density(G: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        P, H = np.zeros((2, 2)), np.zeros((4, 4))
        return kernels.energy_density(G, mu, lam, P, H, 2), P, H

    _, P, H = density(F)
    step = 1e-6
    for k in range(4):
        D = np.zeros(4)
        D[k] = step
        D = D.reshape(2, 2)
        up, down = density(F + D), density(F - D)
        assert (up[0] - down[0]) / (2 * step) == pytest.approx(P.ravel()[k], abs=1e-8)
        np.testing.assert_allclose((up[1] - down[1]).ravel() / (2 * step), H[k], atol=1e-7)


def test_the_thickness_stretch_makes_the_plane_free_of_stress() -> None:
    mu, lam = kernels.lame_MPa(1.0, 0.45)
    for J in (0.4, 1.0, 2.5):
        c = math.exp(kernels.log_thickness(math.log(J), mu, lam))
        assert mu * (c * c - 1) + lam * math.log(c * J) == pytest.approx(0, abs=1e-12)


def test_the_sheet_at_small_strain_has_youngs_modulus_and_poisson_ratio() -> None:
    mu, lam = kernels.lame_MPa(1.5, 0.45)
    P, H = np.zeros((2, 2)), np.zeros((4, 4))
    kernels.energy_density(np.eye(2), mu, lam, P, H, 2)
    assert H[0, 0] == pytest.approx(1.5 / (1 - 0.45**2))
    assert H[0, 3] / H[0, 0] == pytest.approx(0.45)


def test_gradient_and_hessian_of_the_sector_match_differences() -> None:
    m = model(T_MM, THETA_RAD, SHEET)
    rng = np.random.default_rng(7)
    y, s = m.rest + 0.004 * rng.standard_normal(m.ties.size), 1.02
    way = rng.standard_normal(m.ties.size)
    way /= np.linalg.norm(way)
    at = raw_tangent(m, y, s)
    assert at is not None
    _, slope, grad, mixed, curve, band = at
    hessian = np.zeros((m.ties.size, m.ties.size))
    for k in range(band.shape[1]):
        for j in range(m.ties.size - k):
            hessian[j + k, j] = hessian[j, j + k] = band[j, k]
    e = 1e-4

    def five_points(f: Any) -> Any:
        return (8 * (f(e) - f(-e)) - (f(2 * e) - f(-2 * e))) / (12 * e)

    def tangent_at(dy: float, ds: float) -> Any:
        found = raw_tangent(m, y + dy * way, s + ds)
        assert found is not None
        return found

    scale = np.abs(hessian @ way).max()
    assert five_points(lambda h: m.energy_mm2(y + h * way, s)) == pytest.approx(grad @ way, rel=1e-6)
    assert five_points(lambda h: m.energy_mm2(y, s + h)) == pytest.approx(slope, rel=1e-6)
    np.testing.assert_allclose(five_points(lambda h: tangent_at(h, 0)[2]), hessian @ way, atol=1e-6 * scale)
    np.testing.assert_allclose(five_points(lambda h: tangent_at(0, h)[2]), mixed, atol=1e-6 * np.abs(mixed).max())
    assert five_points(lambda h: tangent_at(0, h)[1]) == pytest.approx(curve, rel=1e-6)


def test_the_banded_factors_solve_and_count_negative_eigenvalues() -> None:
    rng = np.random.default_rng(3)
    n, width = 30, 5
    A = rng.standard_normal((n, n))
    A = np.where(np.abs(np.subtract.outer(range(n), range(n))) <= width, A + A.T, 0) + 3 * np.diag(
        rng.standard_normal(n)
    )
    band = np.array([[A[j + k, j] if j + k < n else 0.0 for k in range(width + 1)] for j in range(n)])
    rhs = rng.standard_normal((n, 3))
    negative = kernels.factor_band(band)
    assert negative == int((np.linalg.eigvalsh(A) < 0).sum())
    np.testing.assert_allclose(A @ kernels.solve_band(band, rhs), rhs, atol=1e-8)


@pytest.mark.parametrize("units", [2, 6])
def test_the_sector_stands_for_whole_periodic_cells(solved: tuple[Model, Pair], units: int) -> None:
    m, pair = solved
    cell = periodic_cell(m, units)
    for state in (pair.saddle, pair.stable):
        place = positions(cell, m, m.nodes(state.y, state.s_ratio), state.s_ratio)
        at = derivatives(cell, place, state.s_ratio * np.eye(2))
        assert at is not None
        assert at.energy_mm2 == pytest.approx(18 * state.energy_mm2, rel=1e-9)
        assert np.abs(at.grad).max() < 1e-9 and np.abs(at.stress).max() < 1e-8


@pytest.mark.parametrize("units", [2, 6])
def test_stiffness_and_poisson_ratio_are_those_of_the_whole_cell(solved: tuple[Model, Pair], units: int) -> None:
    m, pair = solved
    stable = pair.stable
    nodes = m.nodes(stable.y, stable.s_ratio)
    cell = periodic_cell(m, units)
    at = derivatives(cell, positions(cell, m, nodes, stable.s_ratio), stable.s_ratio * np.eye(2))
    assert at is not None
    lu, negative = factored(at.hessian)
    give = np.linalg.inv(at.strain_hessian - at.mixed.T @ lu.solve(at.mixed))
    linear = moduli(m, nodes)
    assert negative == 0
    assert linear.stiffness_mm2 == pytest.approx(1 / give[0, 0], rel=1e-7)
    assert linear.nu_ratio == pytest.approx(-give[1, 0] / give[0, 0], abs=1e-7)
    assert linear.anisotropy_ratio < 1e-9


def test_the_even_stiffness_is_the_sectors(solved: tuple[Model, Pair]) -> None:
    m, pair = solved
    C = moduli(m, m.nodes(pair.stable.y, pair.stable.s_ratio)).strain_hessian_mm2
    assert C[0, 0] + C[1, 1] + 2 * C[0, 1] == pytest.approx(18 * pair.stable.curve_total, rel=1e-9)


def test_released_near_P5_the_cell_returns_to_an_even_expansion(solved: tuple[Model, Pair]) -> None:
    m, pair = solved
    s = pair.stable.s_ratio
    cell = periodic_cell(m)
    place = positions(cell, m, m.nodes(pair.stable.y, s), s)
    push = 1e-3 * np.random.default_rng(0).standard_normal(place.shape)
    found = equilibrium(cell, place + push, np.array([[s + 0.004, 0.003], [0.003, s - 0.004]]), free=(0, 1, 2))
    assert found.converged
    np.testing.assert_allclose(found.F, s * np.eye(2), atol=1e-7)


@pytest.mark.parametrize("points", [24, 60])
def test_the_uniaxial_path_climbs_to_the_saddle_and_rests_in_the_second_state(
    solved: tuple[Model, Pair], points: int
) -> None:
    m, pair = solved
    states, cell = (pair.saddle, pair.stable), periodic_cell(m)
    through = [state.s_ratio for state in states]
    known = [(positions(cell, m, m.nodes(state.y, state.s_ratio), state.s_ratio), state.s_ratio) for state in states]
    curve = uniaxial_curve(cell, through[1] + 0.01, points, known)
    assert curve.converged.all()
    for state, k in zip(states, np.searchsorted(curve.F00_ratio, through), strict=True):
        assert curve.energy_mm2[k] == pytest.approx(18 * state.energy_mm2, rel=1e-7)
        assert curve.F11_ratio[k] == pytest.approx(state.s_ratio, abs=1e-5)
        assert curve.force_mm2[k] == pytest.approx(0, abs=1e-4)
    assert curve.energy_mm2.argmax() == np.searchsorted(curve.F00_ratio, through[0])
    climb = curve.F00_ratio < 1.2
    work = np.sum(np.diff(curve.F00_ratio[climb]) * (curve.force_mm2[climb][1:] + curve.force_mm2[climb][:-1]) / 2)
    assert work == pytest.approx(curve.energy_mm2[climb][-1], rel=0.01)  # the force is the energy's slope


def test_P5_is_stable_in_the_two_by_two_cell(solved: tuple[Model, Pair]) -> None:
    m, pair = solved
    s = pair.stable.s_ratio
    cell = periodic_cell(m, 8)
    values = smallest_eigenvalues(cell, positions(cell, m, m.nodes(pair.stable.y, s), s), s * np.eye(2))
    assert values[0] > 0


def test_with_the_steepest_slits_P5_gives_way_to_a_mode_of_the_two_by_two_cell() -> None:
    """Not what the paper assumes; no smaller cell shows it."""
    found = solve_pair(0.65, math.radians(21.43), SHEET, REFERENCE)
    assert isinstance(found, tuple)
    m, pair = found
    s = pair.stable.s_ratio
    least = {}
    for units in (2, 8):
        cell = periodic_cell(m, units)
        at = positions(cell, m, m.nodes(pair.stable.y, s), s)
        least[units] = smallest_eigenvalues(cell, at, s * np.eye(2), 2)[0]
    assert least[2] > 0 > least[8]


def test_the_poisson_ratio_of_the_rubber_hardly_moves_the_expansion() -> None:
    ratios = [solve_cell(T_MM, THETA_RAD, replace(SHEET, nu_ratio=nu)).expansion_ratio for nu in (0.30, 0.45)]
    assert ratios[0] is not None and ratios[1] is not None
    assert abs(ratios[0] - ratios[1]) < 0.002


def test_modulus_and_thickness_do_not_enter_a_cell() -> None:
    assert solve_cell(T_MM, THETA_RAD, replace(SHEET, E_MPa=9.0, thickness_mm=1.0)) == solve_cell(
        T_MM, THETA_RAD, SHEET
    )


def test_a_cell_twice_as_large_stores_four_times_the_energy() -> None:
    double = replace(SHEET, edge_mm=20.0, slit_mm=0.25, hinge_mm=0.5)
    small = solve_cell(T_MM, THETA_RAD, SHEET)
    density = replace(REFERENCE, first_mm=2 * REFERENCE.first_mm)
    large = solve_cell(2 * T_MM, THETA_RAD, double, density)
    assert large.expansion_ratio == pytest.approx(small.expansion_ratio, rel=1e-8)
    assert large.barrier_mm2 is not None and small.barrier_mm2 is not None
    assert large.barrier_mm2 == pytest.approx(4 * small.barrier_mm2, rel=1e-6)


def test_a_cell_that_is_not_bistable_has_a_reason_and_no_number() -> None:
    cell = solve_cell(3.0, 0.0, SHEET)
    assert cell.verdict == "not bistable" and "dE/ds" in cell.reason
    assert cell.expansion_ratio is None and cell.stiffness_mm2 is None and cell.residual_ratio < 1e-8


def test_an_invalid_polygon_is_not_solved() -> None:
    cell = solve_cell(1.5, math.radians(-20), SHEET)
    assert cell.verdict == "invalid" and cell.expansion_ratio is None


def test_the_cell_of_the_first_published_row_comes_out_the_same() -> None:
    # Published cell library of Chen et al. 2021: t/l0 = 0.05, θ = -0.0184180474 rad, expansion 1.77476184.
    cell = solve_cell(0.5, -0.0184180474, SHEET)
    assert cell.expansion_ratio == pytest.approx(1.77476184, abs=0.002)


def test_scikit_fem_assembles_the_same_energy_forces_and_stiffness(solved: tuple[Model, Pair]) -> None:
    import skfem

    m, pair = solved
    top = topology(REFERENCE)
    mesh = skfem.MeshTri(m.rest_mm[: top.vertex_count].T.copy(), top.triangles.T.copy())
    points, shares = THREE_POINTS
    rule = (points[:, 1:].T.copy(), 0.5 * shares)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP2()), quadrature=rule)
    deformed = m.nodes(pair.stable.y, pair.stable.s_ratio)
    # Nodes are met by their rest positions: two programs number them differently.
    order = {tuple(np.round(x, 9)): k for k, x in enumerate(m.rest_mm)}
    match = np.array([order[tuple(np.round(x, 9))] for x in basis.doflocs.T])
    mu, lam = m.mu, m.lam

    def kinematics(w: Any) -> tuple[Any, Any, Any, Any]:
        F = np.array(w["x"].grad)
        J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        inverse = np.array([[F[1, 1], -F[0, 1]], [-F[1, 0], F[0, 0]]]) / J
        c = np.ones_like(J)
        for _ in range(60):  # the textbook form in c itself
            c = c - (mu * (c * c - 1) + lam * np.log(c * J)) / (2 * mu * c + lam / c)
        return F, J, inverse, c

    def energy(w: Any) -> Any:
        F, J, _, c = kinematics(w)
        return mu / 2 * ((F * F).sum(axis=(0, 1)) + c * c - 3) - mu * np.log(c * J) + lam / 2 * np.log(c * J) ** 2

    def force(v: Any, w: Any) -> Any:
        F, _, inverse, c = kinematics(w)
        P = mu * F - mu * c * c * inverse.swapaxes(0, 1)
        return (P * v.grad).sum(axis=(0, 1))

    def stiffness(u: Any, v: Any, w: Any) -> Any:
        _, _, inverse, c = kinematics(w)
        trace_u, trace_v = (
            np.einsum("ij...,ji...->...", inverse, u.grad),
            np.einsum("ij...,ji...->...", inverse, v.grad),
        )
        swap = np.einsum("ij...,jk...,kl...,li...->...", inverse, u.grad, inverse, v.grad)
        fall = 2 * lam * c * c * mu / (2 * mu * c * c + lam)  # −μ d(c²)/d ln J
        return mu * (u.grad * v.grad).sum(axis=(0, 1)) + mu * c * c * swap + fall * trace_u * trace_v

    x = np.empty(basis.N)
    components = np.zeros(basis.N, dtype=int)
    for k, dofs in enumerate((basis.nodal_dofs, basis.facet_dofs)):
        for i in range(2):
            components[dofs[i]] = i
        assert k < 2
    x[:] = deformed[match, components]
    field = basis.interpolate(x)
    mine = kernels.element_derivatives(deformed, m.elements, m.grads, m.weights, mu, lam)
    place = (2 * m.elements[:, :, None] + np.arange(2)).reshape(len(m.elements), 12)
    g = np.bincount(place.ravel(), mine[1].ravel(), 2 * len(deformed))
    h = np.zeros((2 * len(deformed),) * 2)
    for e in range(len(place)):
        h[np.ix_(place[e], place[e])] += mine[2][e]
    to_mine = 2 * match + components
    assert skfem.Functional(energy).assemble(basis, x=field) == pytest.approx(mine[0], rel=1e-12)
    np.testing.assert_allclose(skfem.LinearForm(force).assemble(basis, x=field), g[to_mine], atol=1e-12)
    theirs = skfem.BilinearForm(stiffness).assemble(basis, x=field).toarray()
    np.testing.assert_allclose(theirs, h[np.ix_(to_mine, to_mine)], atol=1e-9 * np.abs(theirs).max())


def test_curved_sides_and_straight_ones_share_one_formula() -> None:
    rest = np.array([[0.0, 0], [2, 0], [0, 1], [1, 0], [1, 0.5], [0, 0.5]])
    grads, weights = gradients(rest, np.arange(6)[None])
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(
        np.einsum("mqaj,ai->mqij", grads, rest), np.broadcast_to(np.eye(2), (1, 3, 2, 2)), atol=1e-12
    )


def test_a_relaxed_state_says_when_it_did_not_arrive() -> None:
    m = model(T_MM, THETA_RAD, SHEET)
    state = relax(m, m.rest, 1.3, steps_count=1)
    assert not state.converged and state.residual_ratio > 1e-6


def test_gradient_and_hessian_of_the_periodic_cell_match_differences(solved: tuple[Model, Pair]) -> None:
    m, pair = solved
    s = pair.saddle.s_ratio
    cell = periodic_cell(m)
    rng = np.random.default_rng(11)
    place = positions(cell, m, m.nodes(pair.saddle.y, s), s) + 3e-4 * rng.standard_normal(cell.rest_mm.shape)
    F = np.array([[s, 2e-4], [2e-4, s - 3e-4]])
    way, strain = 0.01 * rng.standard_normal(place.shape), np.array([0.01, -0.02, 0.01])
    way[0] = 0
    turn = np.array([[strain[0], strain[2]], [strain[2], strain[1]]])
    at = derivatives(cell, place, F)
    assert at is not None
    e = 1e-4

    def energy(h: float) -> float:
        return cell.energy_mm2(place + h * way, F + h * turn)

    slope = (8 * (energy(e) - energy(-e)) - (energy(2 * e) - energy(-2 * e))) / (12 * e)
    curve = (16 * (energy(e) + energy(-e)) - (energy(2 * e) + energy(-2 * e)) - 30 * energy(0)) / (12 * e * e)
    free = way.ravel()[2:]
    assert slope == pytest.approx(at.grad @ free + at.stress @ strain, rel=1e-6)
    mixed = 2 * free @ at.mixed @ strain + strain @ at.strain_hessian @ strain
    assert curve == pytest.approx(free @ (at.hessian @ free) + mixed, rel=1e-6)


def test_a_thin_hinge_that_snaps_into_a_shallow_well_is_found_in_the_deep_one() -> None:
    """From rest the two middle cells first come to a well at 1.35 with twice the energy."""
    t_mm = np.array([0.804, 0.809, 0.814, 0.819])
    cells = [solve_cell(float(t), math.radians(14.61), replace(SHEET, hinge_mm=0.20)) for t in t_mm]
    for name, share in (("expansion_ratio", 1e-5), ("stored_mm2", 1e-3)):
        values = np.array([getattr(cell, name) for cell in cells])
        assert values == pytest.approx(np.polyval(np.polyfit(t_mm, values, 1), t_mm), rel=share)


SHALLOW = (2.7777280, math.radians(-20))  # the candidate of the paper's sheet nearest to the fold, in mm and radians


def test_a_well_too_shallow_for_the_mesh_is_decided_on_a_finer_one() -> None:
    found = solve_pair(*SHALLOW, SHEET, REFERENCE)
    assert isinstance(found, tuple) and is_shallow(found[1])
    cell = solve_cell(*SHALLOW, SHEET)
    finer = solve_pair(*SHALLOW, SHEET, REFERENCE.refined(2))
    assert isinstance(finer, tuple)
    assert (cell.verdict, cell.mesh_ratio) == ("bistable", 0.5)
    assert cell.expansion_ratio == finer[1].stable.s_ratio
    assert solve_cell(1.2, 0.0, SHEET).mesh_ratio == 1.0


def test_the_finer_mesh_may_also_decide_against_a_shallow_well(monkeypatch: pytest.MonkeyPatch) -> None:
    none = Failure("not bistable", "dE/ds keeps rising")
    coarse = solve_pair(*SHALLOW, SHEET, REFERENCE)
    monkeypatch.setattr(homogenise, "solve_pair", lambda *words: coarse if REFERENCE in words else none)
    cell = solve_cell(*SHALLOW, SHEET)
    assert cell.verdict == "not bistable" and "half the mesh size" in cell.reason and cell.expansion_ratio is None


def test_a_shallow_well_has_settled_at_half_the_mesh_size() -> None:
    coarse, half, third = (solve_pair(*SHALLOW, SHEET, REFERENCE.refined(k)) for k in (1, 2, 3))
    assert isinstance(coarse, tuple) and isinstance(half, tuple) and isinstance(third, tuple)
    s = [found[1].stable.s_ratio for found in (coarse, half, third)]
    assert abs(s[2] - s[1]) < 0.003 < 0.008 < s[1] - s[0]
