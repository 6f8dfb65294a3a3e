"""Solid elements for the deployed cell: P2 triangles extruded to wedges, quadratic through the thickness as well.

Compressible neo-Hookean in three dimensions, ψ = μ/2(I1 − 3) − μ ln J + Λ/2 ln²J: the solid of which the plane-stress
sheet of `kernels` is the thin limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Gauss' three points on [0, 1]: exact to degree 5
_R = np.sqrt(0.15)
HEIGHTS = np.array([0.5 - _R, 0.5, 0.5 + _R])
HEIGHT_SHARES = np.array([5.0, 8.0, 5.0]) / 18.0


@dataclass(frozen=True, slots=True)
class Wedges:
    """Extruded elements over nodes numbered `plane node · levels + level`."""

    elements: Ints  # (m, 18): for each of six plane nodes its three levels
    grads: Array  # (m, q, 18, 3) shape gradients at rest, 1/mm
    weights: Array  # (m, q) mm³
    levels_count: int


def extrude(points_mm: Array, triangles: Ints, rule: tuple[Array, Array], height_mm: float, layers: int) -> Wedges:
    """Return the wedges over P2 `triangles` (m, 6) of `points_mm` (n, 2), from z = 0 to `height_mm` in `layers`.

    Triangles may run either way round; `rule` is a plane quadrature as in `elements`.
    """
    levels = 2 * layers + 1
    plane, share = rule
    value, slope = _plane_shapes(plane)
    jacobian = np.einsum("mai,qaj->mqij", points_mm[triangles], slope)
    det = np.linalg.det(jacobian)
    plane_grads = np.einsum("qaj,mqji->mqai", slope, np.linalg.inv(jacobian))
    z = HEIGHTS
    up = np.stack([(1 - z) * (1 - 2 * z), 4 * z * (1 - z), z * (2 * z - 1)], axis=1)  # (3, 3)
    up_slope = np.stack([4 * z - 3, 4 - 8 * z, 4 * z - 1], axis=1) * layers / height_mm
    m, q = len(triangles), len(plane) * len(z)
    grads = np.empty((m, len(plane), len(z), 6, 3, 3))
    grads[..., :2] = plane_grads[:, :, None, :, None, :] * up[None, None, :, None, :, None]
    grads[..., 2] = value[None, :, None, :, None] * up_slope[None, None, :, None, :]
    weights = 0.5 * np.abs(det)[:, :, None] * share[None, :, None] * HEIGHT_SHARES * height_mm / layers
    nodes = triangles[:, :, None] * levels + np.arange(3)
    return Wedges(
        np.concatenate([(nodes + 2 * k).reshape(m, 18) for k in range(layers)]),
        np.tile(grads.reshape(m, q, 18, 3), (layers, 1, 1, 1)),
        np.tile(weights.reshape(m, q), (layers, 1)),
        levels,
    )


def _plane_shapes(points: Array) -> tuple[Array, Array]:
    """Return values (q, 6) and slopes (q, 6, 2) of the P2 functions at barycentric points."""
    from design.cells.elements import shape_slopes

    a, b, c = points.T
    values = [a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * c * a]
    return np.stack(values, axis=1), shape_slopes(points)


@njit(cache=True)  # type: ignore[untyped-decorator]
def solid_derivatives(
    nodes: Array, elements: Ints, grads: Array, weights: Array, mu: float, lam: float, want: int
) -> tuple[float, Array, Array]:
    """Return the energy, forces (m, 18, 3) and, for `want` 2, Hessians (m, 54, 54); infinite where J ≤ 0."""
    count = len(elements)
    force = np.zeros((count, 18, 3))
    hessian = np.zeros((count if want == 2 else 1, 54, 54))
    total = 0.0
    F = np.empty((3, 3))
    G = np.empty((3, 3))
    P = np.empty((3, 3))
    A = np.empty((3, 3, 3, 3))
    half = np.empty((18, 3, 3, 3))
    for e in range(count):
        for q in range(weights.shape[1]):
            F[:] = 0.0
            for a in range(18):
                for i in range(3):
                    for j in range(3):
                        F[i, j] += nodes[elements[e, a], i] * grads[e, q, a, j]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                for c in range(3):
                    d, f = (c + 1) % 3, (c + 2) % 3
                    G[i, c] = F[j, d] * F[k, f] - F[j, f] * F[k, d]
            J = F[0, 0] * G[0, 0] + F[0, 1] * G[0, 1] + F[0, 2] * G[0, 2]
            if J <= 0.0:
                return np.inf, force, hessian
            log_J = np.log(J)
            w = weights[e, q]
            first = 0.0
            for i in range(3):
                for j in range(3):
                    G[i, j] /= J  # F⁻ᵀ
                    first += F[i, j] * F[i, j]
            total += w * (0.5 * mu * (first - 3.0) - mu * log_J + 0.5 * lam * log_J * log_J)
            if want == 0:
                continue
            for i in range(3):
                for j in range(3):
                    P[i, j] = w * (mu * F[i, j] + (lam * log_J - mu) * G[i, j])
            for a in range(18):
                for i in range(3):
                    for j in range(3):
                        force[e, a, i] += P[i, j] * grads[e, q, a, j]
            if want == 1:
                continue
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        for l in range(3):
                            A[i, j, k, l] = w * (lam * G[i, j] * G[k, l] + (mu - lam * log_J) * G[i, l] * G[k, j])
                            if i == k and j == l:
                                A[i, j, k, l] += w * mu
            for a in range(18):
                for i in range(3):
                    for k in range(3):
                        for l in range(3):
                            value = 0.0
                            for j in range(3):
                                value += grads[e, q, a, j] * A[i, j, k, l]
                            half[a, i, k, l] = value
            for a in range(18):
                for i in range(3):
                    for b in range(18):
                        for k in range(3):
                            hessian[e, 3 * a + i, 3 * b + k] += (
                                half[a, i, k, 0] * grads[e, q, b, 0]
                                + half[a, i, k, 1] * grads[e, q, b, 1]
                                + half[a, i, k, 2] * grads[e, q, b, 2]
                            )
    return total, force, hessian
