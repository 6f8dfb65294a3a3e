"""Both solvers agree on the answer and on the number of negative eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from design.deploy import factor
from design.deploy.factor import _Pardiso, factorise
from design.deploy.newton import System, pins


def squashed(cap_of) -> tuple[sp.csc_matrix, int]:
    """Return the Hessian of a cap pushed half through itself, and how many negative eigenvalues it has."""
    cap = cap_of(edge_mm=20.0)
    system, x = System(cap.layout.shell()), cap.design_mm * [1.0, 1.0, -0.2]
    matrix = system.held(system.linearise(x)[2], pins(cap.design_mm))
    return matrix, int(np.sum(np.linalg.eigvalsh(matrix.toarray()) < 0))


def check(matrix: sp.csc_matrix, negative_count: int) -> None:
    found, count = factorise(matrix)
    assert count == negative_count > 0
    right = np.random.default_rng(1).normal(size=(matrix.shape[0], 2))
    assert matrix @ found.solve(right) == pytest.approx(right, abs=1e-8)
    assert matrix @ found.solve(right[:, 0]) == pytest.approx(right[:, 0], abs=1e-8)


def test_scipys_solver_counts_negative_eigenvalues(cap_of, monkeypatch) -> None:
    monkeypatch.setattr(factor, "PARDISO_FROM_COUNT", 10**9)
    check(*squashed(cap_of))


def test_pardiso_counts_the_same(cap_of, monkeypatch) -> None:
    if factor._pardiso() is None:
        pytest.skip("the extra `pardiso` is not installed")
    monkeypatch.setattr(factor, "PARDISO_FROM_COUNT", 0)
    matrix, negative_count = squashed(cap_of)
    assert isinstance(factorise(matrix)[0], _Pardiso)
    check(matrix, negative_count)


def test_the_upper_triangle_by_rows_is_the_lower_by_columns(cap_of) -> None:
    matrix, _ = squashed(cap_of)
    assert factor._upper(matrix).toarray() == pytest.approx(np.triu(matrix.toarray()), abs=1e-15)


def test_a_matrix_without_an_inverse_is_told(monkeypatch) -> None:
    for least in (0, 10**9):
        monkeypatch.setattr(factor, "PARDISO_FROM_COUNT", least)
        with pytest.raises(RuntimeError):
            factorise(sp.csc_matrix(np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])))
