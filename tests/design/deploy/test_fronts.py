"""A sheet's Hessian is factorised front by front, and what has no Cholesky factor is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from design.deploy.factor import factorise
from design.deploy.fronts import cholesky, dissected, planned
from design.deploy.newton import System, pins


def hessian_of(cap, shift_N_mm: float = 0.05) -> tuple[System, sp.csc_matrix]:
    """Return a cap's system and its Hessian at the intended shape, held and made positive."""
    system = System(cap.layout.shell())
    matrix = system.held(system.linearise(cap.design_mm)[2], pins(cap.design_mm))
    return system, system.shifted(matrix, shift_N_mm)


def test_the_factor_solves_for_one_and_for_many_right_sides(cap_of) -> None:
    cap = cap_of(edge_mm=4.0)
    system, matrix = hessian_of(cap)
    factor = system.cholesky(matrix, cap.design_mm)
    assert factor is not None
    right = np.random.default_rng(1).normal(size=(matrix.shape[0], 3))
    assert matrix @ factor.solve(right) == pytest.approx(right, abs=1e-10)
    assert factor.solve(right[:, 0]) == pytest.approx(factorise(matrix)[0].solve(right[:, 0]), rel=1e-9, abs=1e-12)


def test_where_the_vertices_are_decides_only_the_order(cap_of) -> None:
    cap = cap_of(edge_mm=5.0)
    _, matrix = hessian_of(cap)
    right = np.ones(matrix.shape[0])
    anywhere = np.random.default_rng(2).normal(size=cap.design_mm.shape)
    answers = [cholesky(planned(matrix.indptr, matrix.indices, x), matrix.data) for x in (cap.design_mm, anywhere)]
    one, other = (answer.solve(right) for answer in answers if answer is not None)
    assert one == pytest.approx(other, rel=1e-9, abs=1e-12)


def test_a_matrix_that_is_not_positive_has_no_factor(cap_of) -> None:
    cap = cap_of(edge_mm=5.0)
    system, matrix = hessian_of(cap, 0.0)
    lowest = np.linalg.eigvalsh(matrix.toarray())[0]
    for shift, is_positive in ((-lowest + 1e-4, True), (-lowest - 1e-4, False)):
        found = system.cholesky(system.shifted(matrix, shift), cap.design_mm)
        assert (found is not None) == is_positive


def test_two_sheets_that_hang_together_nowhere_are_factorised_too(cap_of) -> None:
    cap = cap_of(edge_mm=5.0)
    _, one = hessian_of(cap)
    both = sp.csc_matrix(sp.block_diag([one, 2 * one]))
    both.sort_indices()
    places = np.vstack([cap.design_mm, cap.design_mm])
    factor = cholesky(planned(both.indptr, both.indices, places), both.data)
    assert factor is not None
    right = np.ones(both.shape[0])
    assert both @ factor.solve(right) == pytest.approx(right, abs=1e-10)


def test_every_vertex_is_eliminated_once_and_after_what_it_separates(cap_of) -> None:
    cap = cap_of(edge_mm=4.0)
    _, matrix = hessian_of(cap)
    n = len(cap.design_mm)
    entries = matrix.tocoo()
    graph = sp.csr_matrix((np.ones(entries.nnz), (entries.row // 3, entries.col // 3)), shape=(n, n))
    groups, waits = dissected(graph, cap.design_mm)
    assert sorted(np.concatenate(groups).tolist()) == list(range(n))
    assert all(before < k for k, after in enumerate(waits) for before in after)
    assert len(groups) > 8


def test_the_factors_grow_little_faster_than_the_sheet(cap_of) -> None:
    sizes, entries = [], []
    for edge_mm in (4.0, 2.0):
        cap = cap_of(edge_mm=edge_mm)
        system = System(cap.layout.shell())
        fronts = planned(system._indptr, system._indices, cap.design_mm)
        sizes.append(len(cap.layout.cells))
        entries.append(sum(len(f.own) * (len(f.own) + len(f.rim)) for f in fronts))
    # a plane mesh's factors grow as n·log n (George 1973)
    assert np.log(entries[1] / entries[0]) / np.log(sizes[1] / sizes[0]) < 1.3


def test_a_system_of_another_shell_keeps_what_is_known_of_the_pattern(cap_of) -> None:
    cap = cap_of(edge_mm=10.0)
    system, matrix = hessian_of(cap)
    system.cholesky(matrix, cap.design_mm)
    stiffer = replace(cap.layout, D_mJ=10 * cap.layout.D_mJ).shell()
    other = system.of(stiffer)
    assert other._fronts is system._fronts
    assert system.shell is not stiffer
    expected = System(stiffer).linearise(cap.design_mm)[2]
    assert other.linearise(cap.design_mm)[2].toarray() == pytest.approx(expected.toarray(), abs=1e-14)
