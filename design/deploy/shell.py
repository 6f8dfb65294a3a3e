"""The deployed sheet as a shell of triangles: what each unit wants to be, and how stiff it is.

One unit of the pattern is one triangle (or several, see `refine`). A unit of expansion λ wants to be λ times its
reference triangle; its in-plane energy per flat area is ½k_d(s − λ)² + ½k_s(σ1 − σ2)² with s² = σ1σ2, and each
interior edge resists folding. Pure data; `kernels` computes with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Shell:
    """A shell ready to be solved: topology, rest shape and stiffness, one row per unit or hinge."""

    cells: Ints  # (m, 3) vertex of each corner, counter-clockwise
    vertex_count: int
    edge_mm: float  # side of a unit in the flat sheet
    expansion_ratio: Reals  # (m,)
    rest_edges_mm: Reals  # (m, 3) sides of the reference triangle, opposite each corner
    area_mm2: Reals  # (m,) reference triangle
    cotangents_ratio: Reals  # (m, 3) of the reference triangle's angles
    dilation_N_mm: Reals  # (m,) k_d = 2Y/(1 − ν)
    shear_N_mm: Reals  # (m,) k_s = Y/(2(1 + ν))
    hinges: Ints  # (h, 4): the edge's two ends, then the corner left and the corner right of it
    fold_mJ: Reals  # (h,) energy is ½·fold·(θ − θ0)²
    rest_angle_rad: Reals  # (h,)
    edges: Ints  # (e, 2) every edge once, lower vertex first
    well_shares_ratio: Reals = field(default_factory=lambda: np.zeros(0))  # (k,) of the way from flat to λ
    wells_mJ_mm2: Reals = field(default_factory=lambda: np.zeros((0, 0, 4)))  # (m, k − 1, 4) splines; none: parabolas

    @property
    def scale_N(self) -> float:
        """Return the force every residual is measured against: median k_d times the unit's side."""
        return float(np.median(self.dilation_N_mm) * self.edge_mm)


def neighbours(cells: Ints) -> Ints:
    """Return for each unit the unit across the side opposite each corner, `(m, 3)`, −1 at the border."""
    m = len(cells)
    sides = np.stack([cells[:, [1, 2]], cells[:, [2, 0]], cells[:, [0, 1]]], axis=1).reshape(-1, 2)
    key = np.sort(sides, axis=1)
    order = np.lexsort((key[:, 1], key[:, 0]))
    same = np.all(key[order][1:] == key[order][:-1], axis=1)
    if np.any(same[1:] & same[:-1]):
        raise ValueError("an edge belongs to more than two units")
    across = np.full(3 * m, -1, dtype=np.int64)
    first, second = order[:-1][same], order[1:][same]
    across[first], across[second] = second // 3, first // 3
    return across.reshape(m, 3)


def rest_sides_mm(expansion_ratio: Reals, across: Ints, edge_mm: float) -> Reals:
    """Return the sides of each unit's reference triangle, `(m, 3)`.

    A shared side becomes the same length from both units, `edge_mm` times their mean expansion, so that the rest
    shapes fit together along edges; a border side is what makes the unit's three sides average `edge_mm`.
    """
    own = expansion_ratio[:, None]
    shared = across >= 0
    sides = np.where(shared, edge_mm * 0.5 * (own + expansion_ratio[across]) / own, 0.0)
    free_count = np.sum(~shared, axis=1)
    rest = (3 * edge_mm - sides.sum(axis=1)) / np.maximum(free_count, 1)
    return np.asarray(np.where(shared, sides, rest[:, None]))


def triangle_shape(sides_mm: Reals) -> tuple[Reals, Reals]:
    """Return area `(m,)` and cotangents `(m, 3)` of triangles given by the sides opposite each corner."""
    a2, b2, c2 = (sides_mm[:, k] ** 2 for k in range(3))
    area = 0.25 * np.sqrt(2 * (a2 * b2 + b2 * c2 + c2 * a2) - a2**2 - b2**2 - c2**2)
    cot = np.stack([b2 + c2 - a2, c2 + a2 - b2, a2 + b2 - c2], axis=1) / (4 * area[:, None])
    return area, cot


def build_shell(
    cells: Ints,
    expansion_ratio: ArrayLike,
    Y_N_mm: ArrayLike,
    nu_ratio: ArrayLike,
    D_mJ: ArrayLike,
    edge_mm: float,
    vertex_count: int | None = None,
    rest_angle_rad: ArrayLike = 0.0,
) -> Shell:
    """Return the shell of units with the given corner vertices and properties (arrays `(m,)` or scalars).

    `Y_N_mm` is the tangent in-plane modulus per flat area (thickness included), `nu_ratio` its Poisson ratio,
    `D_mJ` the bending stiffness per deployed length. Seams need nothing here: welded vertices share an index.
    """
    cells = np.ascontiguousarray(cells, dtype=np.int64)
    m = len(cells)
    lam, Y, nu, D = (np.broadcast_to(np.asarray(v, float), m).copy() for v in (expansion_ratio, Y_N_mm, nu_ratio, D_mJ))
    across = neighbours(cells)
    sides = rest_sides_mm(lam, across, edge_mm)
    area, cot = triangle_shape(sides)
    if not np.all(np.isfinite(area)):
        raise ValueError("neighbouring units differ so much in expansion that a rest triangle cannot close")
    hinges, owner, corner = _hinges(cells, across)
    other = across[owner, corner]
    length_mm = edge_mm * 0.5 * (lam[owner] + lam[other])
    deployed_mm2 = lam**2 * area
    fold = 0.5 * (D[owner] + D[other]) * length_mm**2 / (deployed_mm2[owner] + deployed_mm2[other])
    pairs = np.sort(np.concatenate([cells[:, [1, 2]], cells[:, [2, 0]], cells[:, [0, 1]]]), axis=1)
    return Shell(
        cells=cells,
        vertex_count=int(cells.max()) + 1 if vertex_count is None else vertex_count,
        edge_mm=edge_mm,
        expansion_ratio=lam,
        rest_edges_mm=sides,
        area_mm2=area,
        cotangents_ratio=cot,
        dilation_N_mm=2 * Y / (1 - nu),
        shear_N_mm=Y / (2 * (1 + nu)),
        hinges=hinges,
        fold_mJ=fold,
        rest_angle_rad=np.broadcast_to(np.asarray(rest_angle_rad, float), len(hinges)).copy(),
        edges=np.unique(pairs, axis=0),
    )


def _hinges(cells: Ints, across: Ints) -> tuple[Ints, Ints, Ints]:
    """Return hinges `(h, 4)` with the unit and corner that each was seen from."""
    owner, corner = np.nonzero(across > np.arange(len(cells))[:, None])
    other = across[owner, corner]
    start, end = cells[owner, (corner + 1) % 3], cells[owner, (corner + 2) % 3]
    far = cells[other]
    right = far[(far != start[:, None]) & (far != end[:, None])]
    if len(right) != len(owner):
        raise ValueError("two units share more than one edge")
    return np.stack([start, end, cells[owner, corner], right], axis=1), owner, corner
