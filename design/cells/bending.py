"""The bending stiffness of a deployed cell, from the solid: no plate theory at the hinges.

The two-unit cell at its second stable state is extruded (half the thickness, by symmetry), brought to rest again in
three dimensions with expansion and thickness free, and then bent a little. Everything is per Young's modulus, so
stiffness comes in mm³ and a modulus in MPa makes it mJ (= N·mm).

A cell under prestress needs care: bent by κ, neighbouring cells are turned against each other, and the forces between
them turn along. Positions to second order in κ are therefore those of a bent and *rotated* cell, and the work of the
internal forces on the second-order part belongs to the stiffness. Without it the answer is not even isotropic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from design.cells.elements import THREE_POINTS, shape_slopes
from design.cells.kernels import log_thickness
from design.cells.wedges import Wedges, extrude, solid_derivatives
from design.errors import NotConverged

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CURVATURES = np.array([[[1.0, 0], [0, 0]], [[0, 0], [0, 1.0]], [[0, 1.0], [1.0, 0]]])  # κ11, κ22, κ12
TOLERANCE_RATIO = 1e-13  # of E·edge²: rounding. The isotropy of the answer errs some hundred times as much
QUADRATIC_RATIO = 1e-8
STEPS_COUNT = 40


@dataclass(frozen=True, slots=True)
class PlaneCell:
    """A periodic cell in the plane: its P2 mesh, unmerged, at rest and deployed.

    Point p of the unmerged mesh is the periodic image of node `owner[p]`, displaced by `jump[p]` lattice steps (already
    in mm at an expansion of one, so that it grows with the expansion).
    """

    rest_mm: Array  # (p, 2)
    deployed_mm: Array  # (p, 2)
    triangles: Ints  # (m, 6) into points
    owner: Ints  # (p,)
    jump_mm: Array  # (p, 2)
    area_mm2: float  # of the whole cell, holes included, in the flat sheet
    expansion_ratio: float


@dataclass(frozen=True, slots=True)
class Bending:
    """What bending a cell came to, per Young's modulus."""

    D_mm3: float  # mean of the two principal directions
    nu_ratio: float  # Poisson ratio of bending
    anisotropy_ratio: float  # how far the 3 × 3 stiffness is from an isotropic one
    expansion_ratio: float  # of the solid cell at rest
    residual_ratio: float
    matrix_mm3: Array  # (3, 3) for κ11, κ22, κ12

    def relative_ratio(self, thickness_mm: float) -> float:
        """Return the stiffness over that of a beam of the solid sheet, h³/12."""
        return 12 * self.D_mm3 / thickness_mm**3


def bend(cell: PlaneCell, thickness_mm: float, nu_ratio: float, layers: int = 1, prestress: bool = True) -> Bending:
    """Return the bending stiffness of a deployed cell of a sheet `thickness_mm` thick.

    `prestress` False leaves the second-order work out (for comparison). Raises `NotConverged` where the solid cell
    finds no rest near the plane one.
    """
    solid = _Solid(cell, thickness_mm, nu_ratio, 1)
    p, s, residual = solid.rest(*solid.start())
    if layers > 1:  # a finer mesh starts from the coarse one's rest: from the plane it may not get there
        finer = _Solid(cell, thickness_mm, nu_ratio, layers)
        p, s, residual = finer.rest(_more_levels(p, solid.levels, finer.levels), s)
        solid = finer
    nodes, expansion = p[solid.owner] + s * solid.jump, s
    matrix = solid.stiffness_mm3(nodes, expansion, prestress)
    D = 0.5 * (matrix[0, 0] + matrix[1, 1])
    nu = matrix[0, 1] / D
    skew = [matrix[0, 0] - matrix[1, 1], matrix[0, 0] - matrix[0, 1] - 0.5 * matrix[2, 2], *matrix[2, :2]]
    return Bending(float(D), float(nu), float(np.abs(skew).max() / D), expansion, residual, matrix)


class _Solid:
    """The extruded cell: unmerged points × levels, and the periodic unknowns they hang on."""

    def __init__(self, cell: PlaneCell, thickness_mm: float, nu_ratio: float, layers: int) -> None:
        self.cell = cell
        self.mu = 1 / (2 * (1 + nu_ratio))
        self.lam = nu_ratio / ((1 + nu_ratio) * (1 - 2 * nu_ratio))
        self.half_mm = thickness_mm / 2
        self.wedges: Wedges = extrude(cell.rest_mm, cell.triangles, THREE_POINTS, self.half_mm, layers)
        self.levels = self.wedges.levels_count
        self.count = int(cell.owner.max()) + 1
        self.owner = (cell.owner[:, None] * self.levels + np.arange(self.levels)).ravel()
        self.jump = np.repeat(np.column_stack([cell.jump_mm, np.zeros(len(cell.owner))]), self.levels, axis=0)
        dofs = 3 * self.owner[self.wedges.elements][:, :, None] + np.arange(3)
        self.dofs = dofs.reshape(len(dofs), 54)

    @property
    def size(self) -> int:
        return 3 * self.count * self.levels

    def derivatives(self, nodes: Array, want: int) -> tuple[float, Array, Array]:
        """Return energy, element forces and element Hessians at unmerged nodes."""
        w = self.wedges
        total, force, hessian = solid_derivatives(nodes, w.elements, w.grads, w.weights, self.mu, self.lam, want)
        return float(total), force, hessian

    def gathered(self, element_vectors: Array) -> Array:
        """Return element vectors (m, 54) or (m, 54, k) summed onto the periodic unknowns."""
        flat = element_vectors.reshape(self.dofs.size, -1)
        columns = [np.bincount(self.dofs.ravel(), flat[:, k], self.size) for k in range(flat.shape[1])]
        return np.stack(columns, axis=-1)

    def matrix(self, hessian: Array) -> sp.csc_matrix:
        """Return the sparse Hessian on the periodic unknowns."""
        rows = np.repeat(self.dofs, 54, axis=1).ravel()
        cols = np.tile(self.dofs, (1, 54)).ravel()
        return sp.coo_matrix((hessian.ravel(), (rows, cols)), shape=(self.size, self.size)).tocsc()

    def start(self) -> tuple[Array, float]:
        """Return the plane cell's second state on the periodic unknowns, as thick as plane stress makes it."""
        c = self.cell
        base = np.empty((self.count, 2))
        base[c.owner] = c.deployed_mm - c.expansion_ratio * c.jump_mm
        p = np.empty((self.count, self.levels, 3))
        p[..., :2] = base[:, None]
        p[..., 2] = self._thickness_ratio()[:, None] * np.linspace(0, self.half_mm, self.levels)
        return p.reshape(-1, 3), c.expansion_ratio

    def _thickness_ratio(self) -> Array:
        """Return the thickness stretch at each plane node: plane stress in every element, averaged over elements."""
        c = self.cell
        points, shares = THREE_POINTS
        slope = shape_slopes(points)
        rest, now = (np.einsum("mai,qaj->mqij", x[c.triangles], slope) for x in (c.rest_mm, c.deployed_mm))
        area = np.linalg.det(now) / np.linalg.det(rest)
        stretch = np.array([np.exp(log_thickness(v, self.mu, self.lam)) for v in np.log(area).ravel()])
        weight = (np.abs(np.linalg.det(rest)) * shares).ravel()
        owner = np.repeat(c.owner[c.triangles], len(shares), axis=0).ravel()
        each = np.repeat(weight, 6)
        total = np.bincount(owner, each * np.repeat(stretch, 6), self.count)
        return np.asarray(total / np.bincount(owner, each, self.count))

    def rest(self, p: Array, s: float) -> tuple[Array, float, float]:
        """Return periodic nodes at rest, expansion and residual, from a guess; the expansion is one of the unknowns."""
        level = np.arange(len(p)) % self.levels
        fixed = np.zeros((len(p), 3), dtype=bool)
        fixed[level == 0, 2] = True  # the mid-plane stays plane
        fixed[0, :2] = True
        free = np.flatnonzero(~fixed.ravel())
        residual = np.inf
        for step in range(STEPS_COUNT):
            energy, force, hessian = self.derivatives(p[self.owner] + s * self.jump, 2)
            pull = self.jump[self.wedges.elements].reshape(-1, 54)
            gradient = self.gathered(force.reshape(-1, 54))[:, 0][free]
            slope = float(np.sum(force.reshape(-1, 54) * pull))
            edge = float(np.sqrt(self.cell.area_mm2))
            residual = max(float(np.abs(gradient).max()), abs(slope) / edge) / edge**2
            if residual < TOLERANCE_RATIO:
                return p, s, residual
            stretched = np.einsum("mab,mb->ma", hessian, pull)
            couple = self.gathered(stretched)[:, 0][free]
            lu = splu(
                self.matrix(hessian)[free][:, free], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )  # fmt: skip
            plain, along = lu.solve(gradient), lu.solve(couple)
            own = float(np.sum(stretched * pull)) - float(couple @ along)
            ds = -(slope - float(couple @ plain)) / own
            move = np.zeros(self.size)
            move[free] = -plain - ds * along
            descent = float(gradient @ move[free] + slope * ds)
            if residual < QUADRATIC_RATIO:  # from here rounding decides whether the energy falls
                p, s = p + move.reshape(-1, 3), s + ds
                continue
            if descent > 0:
                raise NotConverged("the solid cell", residual, step + 1, "it is not stable where the plane cell is")
            p, s = self._lower(p, s, move.reshape(-1, 3), ds, energy, descent)
        raise NotConverged("the solid cell", residual, step + 1, "the cell may be too near its limit")

    def _lower(self, p: Array, s: float, move: Array, ds: float, energy: float, descent: float) -> tuple[Array, float]:
        """Return a point along the Newton step where the energy is lower and no element is turned over."""
        length = 1.0
        noise = 1e-13 * abs(energy)
        while length > 1e-6:
            trial_p, trial_s = p + length * move, s + length * ds
            found = self.derivatives(trial_p[self.owner] + trial_s * self.jump, 0)[0]
            if np.isfinite(found) and found <= energy + 1e-4 * length * descent + noise:
                return trial_p, trial_s
            length *= 0.5
        raise NotConverged("the solid cell", float("nan"), 0, "no step lowers its energy")

    def stiffness_mm3(self, nodes: Array, expansion: float, prestress: bool) -> Array:
        """Return the 3 × 3 stiffness in κ11, κ22, κ12 about the rest `nodes`, the inside relaxed."""
        _, force, hessian = self.derivatives(nodes, 2)
        x = nodes[self.wedges.elements]  # (m, 18, 3)
        plane, height = x[..., :2], x[..., 2]
        turned = np.einsum("kij,maj->kmai", CURVATURES, plane)  # κx
        sag = np.einsum("mai,kmai->kma", plane, turned)  # xκx
        first = np.empty((*x.shape, 3))
        first[..., :2, :] = -(height[None, ..., None] * turned).transpose(1, 2, 3, 0)
        first[..., 2, :] = 0.5 * sag.transpose(1, 2, 0)
        first = first.reshape(len(x), 54, 3)
        pushed = np.einsum("mab,mbk->mak", hessian, first)
        whole = np.einsum("mak,mal->kl", first, pushed)
        load = self.gathered(pushed)
        if prestress:
            whole = whole + self._second_order(force, height, turned, sag)
            cross = np.empty((*x.shape, 3))
            cross[..., :2, :] = (force[None, ..., 2, None] * turned).transpose(1, 2, 3, 0)
            cross[..., 2, :] = -np.einsum("mai,kmai->mak", force[..., :2], turned)
            load = load + self.gathered(cross.reshape(len(x), 54, 3))
        level = np.arange(self.count * self.levels) % self.levels
        fixed = np.zeros((len(level), 3), dtype=bool)
        fixed[level == 0, :2] = True  # bending is odd in z: the mid-plane does not stretch
        fixed[0, 2] = True
        free = np.flatnonzero(~fixed.ravel())
        lu = splu(
            self.matrix(hessian)[free][:, free], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
        relaxed = whole - load[free].T @ lu.solve(load[free])
        area = self.cell.area_mm2 * expansion**2
        return np.asarray((relaxed + relaxed.T) / area)  # both halves of the thickness, symmetric part

    def _second_order(self, force: Array, height: Array, turned: Array, sag: Array) -> Array:
        """Return the second derivative in κ of the forces' work on the second-order positions."""
        cubic = -np.einsum("mai,kmai,lma->kl", force[..., :2], turned, sag, optimize=True) / 6
        lift = -0.5 * np.einsum("ma,ma,kmai,lmai->kl", force[..., 2], height, turned, turned, optimize=True)
        whole = cubic + lift
        return np.asarray(whole + whole.T)


def _more_levels(p: Array, levels: int, finer: int) -> Array:
    """Return nodes of one quadratic layer evaluated at the levels of a finer one."""
    if levels != 3:
        raise ValueError("only one layer can be refined")
    z = np.linspace(0, 1, finer)
    shapes = np.stack([(1 - z) * (1 - 2 * z), 4 * z * (1 - z), z * (2 * z - 1)], axis=1)
    return np.asarray(np.einsum("lk,nkd->nld", shapes, p.reshape(-1, 3, 3)).reshape(-1, 3))
