"""The linear answer of the tiling about its second stable state: one solve on the periodic cell of two units.

All six sectors of that cell are copies of one, so the sector is condensed once onto the nodes it shares, and six turned
and mirrored copies of that small matrix are put together. Prestress is in the Hessian; nothing is approximated.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from design.cells import kernels
from design.cells.mesh import Density, topology
from design.cells.sector import Model, _places
from design.cells.tiling import border_nodes, tiling

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

STRAINS = np.array([[[1.0, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 1], [1, 0]]])  # F00, F11, F01 = F10


@functools.lru_cache(maxsize=8)
def _numbering(density: Density) -> tuple[Ints, Ints, int, int]:
    """Return the numbers of inside and border coordinates, how many are inside, and the band's width."""
    top = topology(density)
    border = np.full((top.node_count, 2), -1)
    rim = border_nodes(density)
    border[rim] = np.arange(2 * len(rim)).reshape(-1, 2)
    inside = np.full((top.node_count, 2), -1)
    order = [n for n in np.lexsort((np.arange(top.node_count), _places(top))) if border[n, 0] < 0]
    inside[order] = np.arange(2 * len(order)).reshape(-1, 2)
    owned = inside[top.elements].reshape(len(top.elements), -1)
    spans = [row[row >= 0].max() - row[row >= 0].min() for row in owned if (row >= 0).any()]
    return inside, border, 2 * len(order), int(max(spans))


@functools.lru_cache(maxsize=8)
def _assembly(density: Density) -> tuple[Array, int]:
    """Return per copy the linear map from (three strains, shared nodes) to the border's coordinates, (6, edge, 3 + n).

    The strain columns are for an edge of one; the first shared node is held, against translation.
    """
    tile, rim = tiling(density, 2), border_nodes(density)
    shared, index = np.unique(tile.owner[:, rim], return_inverse=True)
    index = index.reshape(len(tile.turns), len(rim))
    maps = np.zeros((len(tile.turns), 2 * len(rim), 3 + 2 * len(shared)))
    for c, turn in enumerate(tile.turns):
        for k, node in enumerate(rim):
            rows, back = slice(2 * k, 2 * k + 2), turn.T
            maps[c, rows, :3] = back @ np.einsum("kij,j->ik", STRAINS, tile.jump[c, node])
            maps[c, rows, 3 + 2 * index[c, k] : 5 + 2 * index[c, k]] = back
    return np.delete(maps, (3, 4), axis=2), len(shared)


def condensed(m: Model, nodes: Array) -> Array:
    """Return the sector's Hessian at `nodes` (n, 2) condensed onto its shared nodes, (edge, edge)."""
    inside, border, size, width = _numbering(m.density)
    edge = 2 * len(border_nodes(m.density))
    _, _, h = kernels.element_derivatives(nodes, m.elements, m.grads, m.weights, m.mu, m.lam)
    band, couple, rim = kernels.split(h, m.elements, inside, border, size, width, edge)
    kernels.factor_band(band)
    return np.asarray(rim - couple.T @ kernels.solve_band(band, couple))


@dataclass(frozen=True, slots=True)
class Moduli:
    """The tangent at zero average stress, per hexagonal cell and per E·thickness."""

    strain_hessian_mm2: Array  # (3, 3) in F00, F11, F01, the nodes relaxed
    stiffness_mm2: float  # d²E*/dF00², F11 and F01 free (Appendix I)
    nu_ratio: float
    anisotropy_ratio: float  # how far the tangent is from isotropic; three-fold symmetry makes it zero


def moduli(m: Model, nodes: Array) -> Moduli:
    """Return the tangent moduli about the equilibrium `nodes` of the sector."""
    maps, _ = _assembly(m.density)
    small = condensed(m, nodes)
    maps = maps.copy()
    maps[:, :, :3] *= m.edge_mm
    whole = 3 * np.einsum("cap,ab,cbq->pq", maps, small, maps, optimize=True)
    relaxed = scipy.linalg.solve(whole[3:, 3:], whole[3:, :3], assume_a="sym")
    hessian = whole[:3, :3] - whole[:3, 3:] @ relaxed
    give = np.linalg.inv(hessian)
    shear = hessian[2, 2] / 4
    skew = np.abs([hessian[0, 0] - hessian[1, 1], hessian[0, 0] - hessian[0, 1] - 2 * shear, *hessian[2, :2]]).max()
    return Moduli(hessian, float(1 / give[0, 0]), float(-give[1, 0] / give[0, 0]), float(skew / hessian[0, 0]))
