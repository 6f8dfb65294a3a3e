"""The cotangent Laplacian of a surface, factored once, and the two boundary problems solved with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, triu
from scipy.sparse.linalg import splu

from design.errors import FlattenError
from design.flatten.result import Laplacian
from design.surface import Indices, TriMesh

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Laplace:
    """Positive semi-definite Laplacian A over all vertices; `factor` solves with its interior block."""

    A: csc_array
    inner: Indices
    border: Indices
    A_inner_border: csc_array
    factor: Any  # of A over `inner`; has .solve

    def extend(self, border_values: Values, source: Values | None = None) -> Values:
        """Return the `(n,)` or `(n, k)` solution of A x = source inside, x = `border_values` on the border.

        `source` has a row for every vertex; only the inner ones count.
        """
        right = -(self.A_inner_border @ border_values)
        if source is not None:
            right = right + source[self.inner]
        out = np.empty((len(self.inner) + len(self.border), *border_values.shape[1:]))
        out[self.border] = border_values
        out[self.inner] = self.factor.solve(np.ascontiguousarray(right)) if len(self.inner) else right
        return out

    def flux(self, values: Values) -> Values:
        """Return A x at the border: the flux of x out through each border vertex."""
        return np.asarray((self.A @ values)[self.border])


def assemble(mesh: TriMesh, kind: Laplacian = "cotangent") -> csc_array:
    """Return A over all vertices; `delaunay` flips edges intrinsically first, so that no angle is badly obtuse."""
    if kind == "delaunay":
        lengths_mm = igl.edge_lengths(mesh.vertices_mm, mesh.faces)
        return csc_array(-igl.intrinsic_delaunay_cotmatrix(lengths_mm, mesh.faces)[0])
    return csc_array(-igl.cotmatrix(mesh.vertices_mm, mesh.faces))


def factored(A: csc_array, border: Indices) -> Laplace:
    """Factor the inner block of A, all but the rows and columns of `border`."""
    inside = np.ones(A.shape[0], dtype=bool)
    inside[border] = False
    inner = np.flatnonzero(inside)
    columns = A[:, border]
    return Laplace(A, inner, border, csc_array(columns[inner]), _factor(csc_array(A[:, inner][inner])))


def _factor(A: csc_array) -> Any:
    """Factor a symmetric matrix; PARDISO where it is installed and the matrix large, else SuperLU."""
    if A.shape[0] == 0:
        return None
    if A.shape[0] > PARDISO_FROM and (solver := _pardiso(A)) is not None:
        return solver
    try:
        # Minimum degree on A + Aᵀ without pivoting keeps the symmetric pattern: a fifth of COLAMD's fill.
        return splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as fault:
        raise FlattenError("the surface's Laplacian is singular: a part of it hangs on no boundary") from fault


PARDISO_FROM = 30_000  # unknowns; below it SuperLU is as fast and always there


class _Pardiso:
    def __init__(self, upper: csr_array, solver: Any) -> None:
        self._upper, self._solver = upper, solver

    def solve(self, right: Values) -> Values:
        return np.asarray(self._solver.solve(self._upper, right))


def _pardiso(A: csc_array) -> _Pardiso | None:
    try:
        from pypardiso.pardiso_wrapper import PyPardisoError, PyPardisoSolver

        solver = PyPardisoSolver(mtype=2)  # symmetric positive definite, given by its upper triangle
    except ImportError:  # the optional extra `pardiso` or the library under it is not there
        return None
    upper = csr_array(triu(A, format="csr"))
    try:
        solver.factorize(upper)
    except PyPardisoError:  # rounding made a nearly singular matrix indefinite; SuperLU is more patient
        return None
    return _Pardiso(upper, solver)


def angle_defects(mesh: TriMesh, border: Indices) -> Values:
    """Return 2π − Σ angles at inner vertices, π − Σ angles at border ones: curvature, integrated, `(n,)` in rad."""
    angles = igl.internal_angles(mesh.vertices_mm, mesh.faces)
    total = np.bincount(mesh.faces.ravel(), angles.ravel(), len(mesh.vertices_mm))
    defect = 2 * np.pi - total
    defect[border] -= np.pi
    return np.asarray(defect)
