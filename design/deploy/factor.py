"""Factorise a symmetric matrix and count its negative eigenvalues: SuperLU, or PARDISO where that is installed.

Both tell the inertia by Sylvester's law: SuperLU by the signs of its pivots, PARDISO by a count of its own.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Reals = NDArray[np.float64]
PARDISO_FROM_COUNT = 6_000  # unknowns; below it SuperLU is as fast and always there
INDEFINITE = -2  # PARDISO's name for real symmetric matrices of any inertia
PERTURBED, NEGATIVE = 14, 23  # its output parameters: pivots too small to use, negative eigenvalues


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, right: Reals) -> Reals:
        """Return the solution for one right side `(n,)` or several `(n, k)`."""


def factorise(matrix: sp.csc_matrix) -> tuple[Factor, int]:
    """Return the factorisation of a symmetric matrix and the number of its negative eigenvalues.

    Raises `RuntimeError` where a pivot is exactly zero.
    """
    if matrix.shape[0] >= PARDISO_FROM_COUNT and _pardiso() is not None:
        return _by_pardiso(matrix)
    lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return lu, int(np.sum(lu.U.diagonal() < 0))


@functools.cache
def _pardiso() -> Any:
    """Return PARDISO's module, None where the optional extra `pardiso` or the library under it is not there."""
    try:
        from pypardiso import pardiso_wrapper

        pardiso_wrapper.PyPardisoSolver(mtype=INDEFINITE)
    except ImportError:
        return None
    return pardiso_wrapper


class _Pardiso:
    def __init__(self, upper: sp.csr_matrix) -> None:
        self._upper, self._solver = upper, _pardiso().PyPardisoSolver(mtype=INDEFINITE)
        self._solver.factorize(upper)

    def count(self, parameter: int) -> int:
        return int(self._solver.get_iparm(parameter))

    def solve(self, right: Reals) -> Reals:
        return np.asarray(self._solver.solve(self._upper, right))

    def __del__(self) -> None:  # the factors are not Python's: without this every Newton step would keep its own
        self._solver.free_memory(everything=True)


def _by_pardiso(matrix: sp.csc_matrix) -> tuple[Factor, int]:
    try:
        found = _Pardiso(_upper(matrix))
    except _pardiso().PyPardisoError as fault:
        raise RuntimeError(f"PARDISO: {fault}") from fault
    if found.count(PERTURBED):
        raise RuntimeError("a pivot is zero")
    return found, found.count(NEGATIVE)


def _upper(matrix: sp.csc_matrix) -> sp.csr_matrix:
    """Return the upper triangle by rows: of a symmetric matrix that is the lower one by columns."""
    size = matrix.shape[0]
    column = np.repeat(np.arange(size, dtype=np.int32), np.diff(matrix.indptr))
    kept = matrix.indices >= column
    start = np.concatenate([[0], np.cumsum(kept)])[matrix.indptr]
    return sp.csr_matrix((matrix.data[kept], matrix.indices[kept], start.astype(np.int32)), shape=matrix.shape)
