"""The whole periodic cell, of two, six or eight units, with nothing assumed but the period.

x = F X + ω with ω periodic and F symmetric. The unknowns are the positions of one representative of each node; an image
stands F·(period) away. This is the check on the sector (`sector`), the source of the uniaxial curve E*(ε) of the paper,
and the place to ask whether a state is stable against what the sector cannot do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, eigsh, splu

from design.cells import kernels
from design.cells.elements import gradients
from design.cells.homogenise import SECTORS
from design.cells.sector import Model
from design.cells.tangent import STRAINS
from design.cells.tiling import Tiling, tiling

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TOLERANCE_RATIO = 1e-9  # of E·thickness·hinge
SYMMETRIC = {"SymmetricMode": True}


@dataclass(frozen=True, slots=True)
class PeriodicCell:
    """A periodic cell ready to be solved. Energies are per hexagonal cell and per E·thickness, in mm²."""

    tile: Tiling
    elements: Ints  # into the copies' nodes, one after the other
    grads: Array
    weights: Array
    owner: Ints  # (c·n,)
    jump_mm: Array  # (c·n, 2)
    rest_mm: Array  # (count, 2)
    mu: float
    lam: float
    hinge_mm: float
    share: float  # hexagons per cell

    def nodes(self, position: Array, F: Array) -> Array:
        """Return all copies' nodes (c·n, 2) for the representatives' positions (count, 2)."""
        return np.asarray(position[self.owner] + self.jump_mm @ F.T)

    def energy_mm2(self, position: Array, F: Array) -> float:
        """Return the energy, infinite where an element is turned over."""
        nodes = self.nodes(position, F)
        total = kernels.total_energy(nodes, self.elements, self.grads, self.weights, self.mu, self.lam)
        return total / self.share


def periodic_cell(m: Model, units: int = 2) -> PeriodicCell:
    """Return the periodic cell of `units` units (2, 6 or 8) made of copies of the sector."""
    tile = tiling(m.density, units)
    edge = m.edge_mm
    nodes = (np.einsum("cij,nj->cni", tile.turns, m.rest_mm) + edge * tile.moves[:, None]).reshape(-1, 2)
    count = len(m.rest_mm)
    flipped = np.linalg.det(tile.turns) < 0
    elements = np.concatenate(
        [(m.elements[:, [0, 2, 1, 5, 4, 3]] if flip else m.elements) + c * count for c, flip in enumerate(flipped)]
    )
    grads, weights = gradients(nodes, elements)
    owner, jump = tile.owner.ravel(), edge * tile.jump.reshape(-1, 2)
    rest = np.empty((tile.count, 2))
    rest[owner] = nodes - jump
    return PeriodicCell(
        tile, elements, grads, weights, owner, jump, rest, m.mu, m.lam, m.hinge_mm, tile.units_count / 6
    )  # fmt: skip


def positions(cell: PeriodicCell, m: Model, nodes: Array, s_ratio: float) -> Array:
    """Return the representatives' positions where each copy of the sector stands as `nodes` (n, 2) at the stretch s."""
    turned = np.einsum("cij,nj->cni", cell.tile.turns, nodes) + s_ratio * m.edge_mm * cell.tile.moves[:, None]
    position = np.empty_like(cell.rest_mm)
    position[cell.owner] = turned.reshape(-1, 2) - s_ratio * cell.jump_mm
    return position


@dataclass(frozen=True, slots=True)
class Derivatives:
    """Energy per hexagon, its derivatives in the positions p (first node held) and the strains F00, F11, F01."""

    energy_mm2: float
    grad: Array  # (free,)
    stress: Array  # (3,)
    hessian: sp.csc_matrix  # (free, free)
    mixed: Array  # (free, 3)
    strain_hessian: Array  # (3, 3)


def derivatives(cell: PeriodicCell, position: Array, F: Array) -> Derivatives | None:
    """Return the derivatives, None where an element is turned over."""
    nodes = cell.nodes(position, F)
    energy, g, h = kernels.element_derivatives(nodes, cell.elements, cell.grads, cell.weights, cell.mu, cell.lam)
    if not np.isfinite(energy):
        return None
    size = 2 * len(position)
    place = (2 * cell.owner[cell.elements][:, :, None] + np.arange(2)).reshape(len(h), 12)
    grad: Array = np.bincount(place.ravel(), g.ravel(), size).astype(np.float64)
    rows, columns = np.repeat(place, 12, axis=1), np.tile(place, (1, 12))
    hessian = sp.csc_matrix((h.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))
    # A strain moves an image by STRAIN·jump, (element, 12, 3).
    pull = np.einsum("kij,enj->enik", STRAINS, cell.jump_mm[cell.elements]).reshape(len(h), 12, 3)
    stress = np.einsum("ea,eak->k", g, pull)
    side = np.einsum("eab,ebk->eak", h, pull)
    mixed: Array = np.stack([np.bincount(place.ravel(), side[..., k].ravel(), size) for k in range(3)], axis=1)
    bulk = np.einsum("eak,eal->kl", pull, side)
    s = 1 / cell.share
    return Derivatives(energy * s, grad[2:] * s, stress * s, hessian[2:, 2:] * s, mixed[2:] * s, bulk * s)


def factored(hessian: sp.csc_matrix) -> tuple[SuperLU, int]:
    """Return the factors of a symmetric matrix and how many of its eigenvalues are negative (Sylvester)."""
    lu = splu(hessian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=SYMMETRIC)
    return lu, int((lu.U.diagonal() < 0).sum())


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """Where the positions and the free strains are in balance, or where the solver gave up."""

    position: Array
    F: Array
    energy_mm2: float
    stress: Array  # dE/d(F00, F11, F01)
    strain_hessian: Array  # of the three strains, positions relaxed
    negative_count: int  # of the Hessian in the positions
    residual_ratio: float
    steps_count: int
    converged: bool


def equilibrium(
    cell: PeriodicCell, position: Array, F: Array, free: tuple[int, ...] = (1, 2), steps_count: int = 60
) -> Equilibrium:
    """Return the minimum over positions and the strains in `free`: Newton, shifted where indefinite, line search."""
    loose = list(free)
    at = derivatives(cell, position, F)
    assert at is not None, "the start is turned over"
    for step in range(steps_count + 1):
        residual = (
            max(float(np.abs(at.grad).max()), float(np.abs(at.stress[loose]).max(initial=0)) / 10) / cell.hinge_mm
        )
        lu, negative = factored(at.hessian)
        relaxed = at.strain_hessian - at.mixed.T @ lu.solve(at.mixed)
        if residual < TOLERANCE_RATIO or step == steps_count:
            good = residual < TOLERANCE_RATIO
            return Equilibrium(position, F, at.energy_mm2, at.stress, relaxed, negative, residual, step, good)
        move, strain = _step(at, lu, negative, relaxed, loose)
        slope = min(float(at.grad @ move + at.stress @ strain), 0.0)
        length, nxt = 1.0, None
        while length > 1e-9:
            p = position + np.concatenate([[0.0, 0.0], length * move]).reshape(-1, 2)
            G = F + length * np.einsum("k,kij->ij", strain, STRAINS)
            if cell.energy_mm2(p, G) <= at.energy_mm2 + 1e-4 * length * slope + 1e-14:
                nxt = derivatives(cell, p, G)
                break
            length *= 0.5
        if nxt is None:
            return Equilibrium(position, F, at.energy_mm2, at.stress, relaxed, negative, residual, step, False)
        position, F, at = p, G, nxt
    raise AssertionError("the loop returns")


def _step(at: Derivatives, lu: SuperLU, negative: int, relaxed: Array, loose: list[int]) -> tuple[Array, Array]:
    """Return the Newton step in the positions and the strains; a shift makes the Hessian positive where it is not."""
    shift = 1e-4
    mixed, bulk = at.mixed[:, loose], at.strain_hessian[np.ix_(loose, loose)]
    core = relaxed[np.ix_(loose, loose)]
    while negative or (len(loose) and np.linalg.eigvalsh(core)[0] <= 0):
        lu, negative = factored(at.hessian + shift * sp.identity(at.hessian.shape[0], format="csc"))
        core = bulk + 100 * shift * np.eye(len(loose)) - mixed.T @ lu.solve(mixed)
        shift *= 4
    back = lu.solve(at.grad)
    strain = np.zeros(3)
    if loose:
        strain[loose] = np.linalg.solve(core, mixed.T @ back - at.stress[loose])
    return -back - lu.solve(at.mixed @ strain), strain


@dataclass(frozen=True, slots=True)
class Curve:
    """The uniaxial stretch of the paper: E*(ε) and its force, the other strains free; (n,) each."""

    F00_ratio: Array
    F11_ratio: Array
    F01_ratio: Array
    energy_mm2: Array
    force_mm2: Array  # dE*/dε, per hexagon and E·thickness
    converged: NDArray[np.bool_]


def uniaxial_curve(
    cell: PeriodicCell, reach_ratio: float, points_count: int = 60, known: Sequence[tuple[Array, float]] = ()
) -> Curve:
    """Return E*(ε) from rest to F00 = `reach_ratio`, each state started from the one before.

    `known` are even states (positions, stretch) on the path, which are taken up as they are: just past the saddle most
    cells snap sideways (F11 jumps), so the peak must be a root and not the highest of the points.
    """
    roots = {s_ratio: position for position, s_ratio in known}
    F00 = np.union1d(np.linspace(1.0, reach_ratio, points_count), list(roots))
    position, F = cell.rest_mm, np.eye(2)
    before: tuple[Array, Array] | None = None
    rows, good = [], []
    for value in F00:
        start_p, start_F = position, F
        if before is not None:
            start_p, start_F = 2 * position - before[0], 2 * F - before[1]
        if value in roots:
            start_p, start_F = roots[value], value * np.eye(2)
        start_F = start_F.copy()
        start_F[0, 0] = value
        if not np.isfinite(cell.energy_mm2(start_p, start_F)):
            stretch = np.diag([value / F[0, 0], 1.0])
            start_p, start_F = position @ stretch, stretch @ F @ stretch
            start_F[0, 0] = value
        state = equilibrium(cell, start_p, start_F)
        before, position, F = (position, F), state.position, state.F
        rows.append([state.F[0, 0], state.F[1, 1], state.F[0, 1], state.energy_mm2, state.stress[0]])
        good.append(state.converged)
    F00, F11, F01, energy, force = np.array(rows).T
    return Curve(F00, F11, F01, energy, force, np.array(good))


def smallest_eigenvalues(cell: PeriodicCell, position: Array, F: Array, count: int = 4) -> Array:
    """Return the smallest eigenvalues of the Hessian in the positions and all three strains, per hexagon.

    Strains are scaled by the edge, so that both kinds of unknowns are lengths. Units: 1 (mm² per mm², per E·thickness).
    """
    at = derivatives(cell, position, F)
    assert at is not None, "the state is turned over"
    size = float(np.abs(cell.jump_mm).max())
    side, corner = sp.csc_matrix(at.mixed / size), sp.csc_matrix(at.strain_hessian / size**2)
    hessian = sp.vstack([sp.hstack([at.hessian, side]), sp.hstack([side.T, corner])], format="csc")
    values = eigsh(hessian, k=count, sigma=0.0, which="LM", return_eigenvectors=False, v0=np.ones(hessian.shape[0]))
    return np.sort(values)


def hexagon_energy_mm2(sector_energy_mm2: float) -> float:
    """Return the energy per hexagon of eighteen equal sectors."""
    return SECTORS * sector_energy_mm2
