"""P2 triangles: shape functions, quadrature, and the gradients every kernel needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Barycentric points and weights on the unit triangle. Three points integrate degree 2, six degree 4 (Dunavant 1985).
THREE_POINTS = (np.array([[2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]]), np.full(3, 1 / 3))
_A, _B = 0.445948490915965, 0.091576213509771
SIX_POINTS = (
    np.array(
        [
            [1 - 2 * _A, _A, _A], [_A, 1 - 2 * _A, _A], [_A, _A, 1 - 2 * _A],
            [1 - 2 * _B, _B, _B], [_B, 1 - 2 * _B, _B], [_B, _B, 1 - 2 * _B],
        ]
    ),
    np.array([0.223381589678011] * 3 + [0.109951743655322] * 3),
)  # fmt: skip


def shape_slopes(points: Array) -> Array:
    """Return dN/d(ξ, η) of the six P2 functions at barycentric `points` (q, 3): (q, 6, 2); ξ = l1, η = l2."""
    slopes = np.zeros((len(points), 6, 2))
    l0, l1, l2 = points.T
    d0, d1, d2 = np.array([-1.0, -1.0]), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for k, (value, d) in enumerate(((l0, d0), (l1, d1), (l2, d2))):
        slopes[:, k] = (4 * value - 1)[:, None] * d
    for k, (u, du, v, dv) in enumerate(((l0, d0, l1, d1), (l1, d1, l2, d2), (l2, d2, l0, d0))):
        slopes[:, 3 + k] = 4 * (u[:, None] * dv + v[:, None] * du)
    return slopes


def gradients(nodes_mm: Array, elements: Ints, rule: tuple[Array, Array] = THREE_POINTS) -> tuple[Array, Array]:
    """Return shape gradients (m, q, 6, 2) in 1/mm and weights (m, q) in mm², for isoparametric P2 elements."""
    points, shares = rule
    slopes = shape_slopes(points)
    jacobian = np.einsum("mai,qaj->mqij", nodes_mm[elements], slopes)
    det = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
    inverse = np.empty_like(jacobian)
    inverse[..., 0, 0], inverse[..., 1, 1] = jacobian[..., 1, 1], jacobian[..., 0, 0]
    inverse[..., 0, 1], inverse[..., 1, 0] = -jacobian[..., 0, 1], -jacobian[..., 1, 0]
    inverse /= det[..., None, None]
    return np.ascontiguousarray(np.einsum("qaj,mqji->mqai", slopes, inverse)), 0.5 * det * shares
