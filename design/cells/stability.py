"""Whether the second stable state withstands what a flat, repeating cell cannot do. The paper assumes so.

In the plane: modes of the 2 × 2 cell (`periodic.smallest_eigenvalues` on eight units). Out of the plane: the second
variation of a sheet of finite thickness about the deployed state, prestress included, with the kinematics of a thick
plate: a deflection w and a slope φ of the fibres through the thickness, u = z φ. Per mm² of rest area and per E,

    h³/12 · ∇φ : (plane-stress tangent) : ∇φ + h · (μ|φ|² + μ|∇w|² + 2 μ c ∇w · F⁻¹φ),

where c is the thickness stretch. The last three terms are the three-dimensional neo-Hookean tangent at zero thickness
stress; a rigid turn of an unstressed sheet costs nothing in the sum.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from design.cells import kernels
from design.cells.elements import THREE_POINTS
from design.cells.periodic import PeriodicCell

Array = NDArray[np.float64]


def plate_hessian(cell: PeriodicCell, position: Array, F: Array, thickness_mm: float) -> sp.csc_matrix:
    """Return the second variation in (φx, φy, w) of each node, (3 count, 3 count), per E, in N/mm per mm and MPa."""
    nodes = cell.nodes(position, F)
    elements = cell.elements
    shapes = _shapes()
    gradient = np.einsum("eai,eqaj->eqij", nodes[elements], cell.grads)
    det = gradient[..., 0, 0] * gradient[..., 1, 1] - gradient[..., 0, 1] * gradient[..., 1, 0]
    inverse = np.linalg.inv(gradient)
    c = np.exp(np.vectorize(kernels.log_thickness)(np.log(det), cell.mu, cell.lam))
    moduli = np.empty((*det.shape, 4, 4))
    P, H = np.empty((2, 2)), np.empty((4, 4))
    for at in np.ndindex(det.shape):
        kernels.energy_density(gradient[at], cell.mu, cell.lam, P, H, 2)
        moduli[at] = H
    h, B, w, N = thickness_mm, cell.grads, cell.weights, shapes
    bend = h**3 / 12 * np.einsum("eq,eqaj,eqijkl,eqbl->eaibk", w, B, moduli.reshape(*det.shape, 2, 2, 2, 2), B)
    fibre = h * cell.mu * np.einsum("eq,qa,qb->eab", w, N, N)
    deflect = h * cell.mu * np.einsum("eq,eqaj,eqbj->eab", w, B, B)
    # 2 μ c ∇w · F⁻¹φ: rows w of node a, columns φ_i of node b.
    cross = h * cell.mu * np.einsum("eq,eq,eqaj,eqji,qb->eabi", w, c, B, inverse, N)
    count, corners = len(elements), elements.shape[1]
    full = np.zeros((count, corners, 3, corners, 3))
    full[:, :, :2, :, :2] = bend
    for i in range(2):
        full[:, :, i, :, i] += fibre
    full[:, :, 2, :, 2] = deflect
    full[:, :, 2, :, :2] = cross
    full[:, :, :2, :, 2] = cross.transpose(0, 2, 3, 1)
    place = (3 * cell.owner[elements][:, :, None] + np.arange(3)).reshape(count, -1)
    width = place.shape[1]
    rows, columns = np.repeat(place, width, axis=1), np.tile(place, (1, width))
    size = 3 * len(position)
    return sp.csc_matrix((full.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))


def _shapes() -> Array:
    """Return the six P2 functions at the quadrature points, (q, 6)."""
    l0, l1, l2 = THREE_POINTS[0].T
    corner = [v * (2 * v - 1) for v in (l0, l1, l2)]
    return np.stack([*corner, 4 * l0 * l1, 4 * l1 * l2, 4 * l2 * l0], axis=1)


def plate_mass(cell: PeriodicCell, thickness_mm: float) -> sp.csc_matrix:
    """Return ∫ h w² + h³/12 |φ|² as a matrix, so that eigenvalues do not depend on the mesh."""
    N, w, elements = _shapes(), cell.weights, cell.elements
    overlap = thickness_mm * np.einsum("eq,qa,qb->eab", w, N, N)
    count, corners = overlap.shape[:2]
    full = np.zeros((count, corners, 3, corners, 3))
    for i, factor in enumerate((thickness_mm**2 / 12, thickness_mm**2 / 12, 1.0)):
        full[:, :, i, :, i] = factor * overlap
    place = (3 * cell.owner[elements][:, :, None] + np.arange(3)).reshape(count, -1)
    width = place.shape[1]
    rows, columns = np.repeat(place, width, axis=1), np.tile(place, (1, width))
    size = 3 * cell.tile.count
    return sp.csc_matrix((full.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))


def out_of_plane_eigenvalues(
    cell: PeriodicCell, position: Array, F: Array, thickness_mm: float, count: int = 4
) -> Array:
    """Return the smallest eigenvalues out of the plane, 1/mm² per E; the first is the shift of the whole sheet, zero.

    All others positive: the state is stable against every mode that repeats with the cell.
    """
    hessian, mass = plate_hessian(cell, position, F, thickness_mm), plate_mass(cell, thickness_mm)
    # Below any real mode: the shifted matrix can be factored although the shift of the sheet costs nothing.
    start = np.ones(hessian.shape[0])
    values = eigsh(hessian, k=count, M=mass, sigma=-1e-3, which="LM", return_eigenvectors=False, v0=start)
    return np.asarray(np.sort(values), dtype=np.float64)
