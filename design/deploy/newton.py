"""Find an equilibrium: Newton's method with the exact Hessian and a shift that grows only while it must.

A Hessian without a Cholesky factor means that the energy is not convex there; it is then shifted until it has one.
The last factorisation, unshifted, tells whether the equilibrium is stable.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from design.deploy import kernels
from design.deploy.factor import Factor, factorise
from design.deploy.fronts import Cholesky, Front, cholesky, planned
from design.deploy.shell import Ints, Reals, Shell
from design.errors import NotConverged

TOLERANCE_RATIO = 1e-9  # a tenth of what is promised, max‖force‖ over median k_d times side
FIRST_SHIFT_RATIO = 1e-4  # of median k_d; small against any bending mode of one unit
LARGEST_SHIFT_RATIO = 1e20  # of the first shift: no finite Hessian needs that
LONGEST_STEP_RATIO = 0.6  # of a unit's deployed side, per vertex: further than that the quadratic model is fiction
LINE_SEARCH_STEPS = 30
SETTLED_RATIO = 1e-5  # of a unit's side: the Hessian changes by about this much over such a step


class Load(Protocol):
    """A force on vertices that comes from an energy: weight, floor, friction, indenter, tether."""

    def energy(self, x_mm: Reals) -> float:
        """Return the energy in mJ at positions `(n, 3)`."""

    def add(self, x_mm: Reals, gradient_N: Reals, blocks_N_mm: Reals) -> None:
        """Add the gradient `(n, 3)` and the diagonal Hessian blocks `(n, 3, 3)`."""


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """Where the shell comes to rest, and how sure that is."""

    x_mm: Reals  # (n, 3)
    energy_mJ: float
    residual_ratio: float  # max‖force‖ at free vertices over median k_d times side
    iterations_count: int
    negative_count: int  # negative eigenvalues of the Hessian on the free degrees of freedom; 0 is stable

    @property
    def stable(self) -> bool:
        """Return whether every small disturbance costs energy."""
        return self.negative_count == 0


class System:
    """The sparse pattern of one shell and the scratch space of its assembly; solves reuse it."""

    def __init__(self, shell: Shell) -> None:
        self.shell = shell
        n = shell.vertex_count
        rows = [np.repeat(shell.cells, 3, axis=1).ravel(), np.repeat(shell.hinges, 4, axis=1).ravel(), np.arange(n)]
        cols = [np.tile(shell.cells, (1, 3)).ravel(), np.tile(shell.hinges, (1, 4)).ravel(), np.arange(n)]
        key = np.concatenate(rows) * n + np.concatenate(cols)
        unique, where = np.unique(key, return_inverse=True)
        row, col = unique // n, unique % n
        start = np.searchsorted(row, np.arange(n + 1))
        width = np.diff(start)
        self.stride = 3 * width
        base = 9 * start[row] + 3 * (np.arange(len(row)) - start[row])
        slots = base[where]
        m, h = len(shell.cells), len(shell.hinges)
        self._cell_slots = np.ascontiguousarray(slots[: 9 * m].reshape(m, 3, 3))
        self._hinge_slots = np.ascontiguousarray(slots[9 * m : 9 * m + 16 * h].reshape(h, 4, 4))
        inner = np.arange(3)
        self._diagonal = slots[9 * m + 16 * h :, None, None] + inner[:, None] * self.stride[:, None, None] + inner
        self._indptr = np.concatenate([[0], np.cumsum(np.repeat(3 * width, 3))]).astype(np.int32)
        columns = (3 * col[:, None] + inner).astype(np.int32)
        self._indices = np.empty(9 * len(row), dtype=np.int32)
        for c in range(3):
            self._indices[(base + c * self.stride[row])[:, None] + inner] = columns
        self._owner = np.repeat(np.arange(3 * n, dtype=np.int32), np.diff(self._indptr))
        self._fronts: list[Front] = []

    def of(self, shell: Shell) -> System:
        """Return the system of another shell of the same units: what is known of the pattern is kept."""
        other = copy.copy(self)
        other.shell = shell
        return other

    def energy(self, x_mm: Reals, loads: Sequence[Load] = ()) -> float:
        """Return the whole energy, mJ."""
        total, _, _ = self._internal(x_mm, 0)
        return total + sum(load.energy(x_mm) for load in loads)

    def gradient(self, x_mm: Reals, loads: Sequence[Load] = ()) -> tuple[float, Reals]:
        """Return energy and gradient `(n, 3)`."""
        total, gradient, _ = self._internal(x_mm, 1)
        blocks = np.zeros((len(x_mm), 3, 3))
        for load in loads:
            total += load.energy(x_mm)
            load.add(x_mm, gradient, blocks)
        return total, gradient

    def linearise(self, x_mm: Reals, loads: Sequence[Load] = ()) -> tuple[float, Reals, sp.csc_matrix]:
        """Return energy, gradient `(n, 3)` and the Hessian (3n × 3n, symmetric)."""
        total, gradient, data = self._internal(x_mm, 2)
        blocks = np.zeros((len(x_mm), 3, 3))
        for load in loads:
            total += load.energy(x_mm)
            load.add(x_mm, gradient, blocks)
        data[self._diagonal] += blocks
        return total, gradient, self._matrix(data)

    def _matrix(self, data: Reals) -> sp.csc_matrix:
        size = 3 * self.shell.vertex_count
        return sp.csc_matrix((data, self._indices, self._indptr), shape=(size, size))

    def _internal(self, x_mm: Reals, want: int) -> tuple[float, Reals, Reals]:
        s = self.shell
        x = np.ascontiguousarray(x_mm)
        gradient = np.zeros_like(x)
        data = np.zeros(len(self._indices) if want == 2 else 1)
        total = kernels.membrane(
            x, s.cells, s.area_mm2, s.cotangents_ratio, s.expansion_ratio, s.dilation_N_mm, s.shear_N_mm,
            s.well_shares_ratio, s.wells_mJ_mm2, self._cell_slots, self.stride, gradient, data, want,
        )  # fmt: skip
        total += kernels.bending(
            x, s.hinges, s.fold_mJ, s.rest_angle_rad, self._hinge_slots, self.stride, gradient, data, want
        )
        return float(total), gradient, data

    def held(self, hessian: sp.csc_matrix, fixed: NDArray[np.bool_]) -> sp.csc_matrix:
        """Return the Hessian with the rows and columns of fixed degrees of freedom `(n, 3)` made unit ones."""
        flat = fixed.ravel()
        if not flat.any():
            return hessian
        data = hessian.data.copy()
        data[flat[self._owner] | flat[self._indices]] = 0.0
        diagonal = self._diagonal[:, range(3), range(3)].ravel()
        data[diagonal[flat]] = float(np.median(self.shell.dilation_N_mm))
        return self._matrix(data)

    def cholesky(self, matrix: sp.csc_matrix, x_mm: Reals) -> Cholesky | None:
        """Return the factorisation of a matrix of this pattern, None where it is not positive.

        The order is planned once, by where the vertices are at that time; that only decides how fast it is.
        """
        if not self._fronts:
            self._fronts.extend(planned(self._indptr.astype(np.int64), self._indices.astype(np.int64), x_mm))
        return cholesky(self._fronts, matrix.data)

    def shifted(self, hessian: sp.csc_matrix, shift_N_mm: float) -> sp.csc_matrix:
        """Return the Hessian plus a multiple of the identity."""
        data = hessian.data.copy()
        data[self._diagonal[:, range(3), range(3)].ravel()] += shift_N_mm
        return self._matrix(data)


def _convex(system: System, matrix: sp.csc_matrix, x: Reals, shift: float, first_shift: float) -> tuple[Factor, float]:
    """Return the factorisation of the matrix shifted as little as makes it positive, and that shift."""
    while True:
        found = system.cholesky(system.shifted(matrix, shift) if shift else matrix, x)
        if found is not None:
            return found, shift
        shift = max(4 * shift, first_shift)
        if shift > LARGEST_SHIFT_RATIO * first_shift:
            raise NotConverged(
                "the deployed shape", float("nan"), 0, "its stiffness is no number: a unit has collapsed"
            )


def pins(x_mm: Reals) -> NDArray[np.bool_]:
    """Return degrees of freedom `(n, 3)` that stop a free body's six rigid motions and nothing else.

    One vertex is held in x, y, z, one far from it along x in y and z, one far along y in z; so positions should lie
    roughly in the xy plane. At a free equilibrium these carry no force, so the shape does not feel them.
    """
    fixed = np.zeros(x_mm.shape, dtype=bool)
    first = int(np.argmin(np.linalg.norm(x_mm - x_mm.mean(axis=0), axis=1)))
    away = x_mm - x_mm[first]
    second = int(np.argmax(np.abs(away[:, 0])))
    arm = away[second, :2] / np.linalg.norm(away[second, :2])
    third = int(np.argmax(np.abs(away[:, 0] * arm[1] - away[:, 1] * arm[0])))
    fixed[first] = True
    fixed[second, 1:] = True
    fixed[third, 2] = True
    return fixed


def solve(
    system: System,
    x_mm: Reals,
    loads: Sequence[Load] = (),
    fixed: NDArray[np.bool_] | None = None,
    tolerance_ratio: float = TOLERANCE_RATIO,
    iterations_max: int = 300,
    watch: Callable[[int, Reals, float], None] | None = None,
) -> Equilibrium:
    """Return the equilibrium that descent from `x_mm` reaches; fixed degrees of freedom keep their start value.

    `watch(iteration, positions, residual)` sees every step (for progress and animation). Raises `NotConverged` with
    the residual where the limit of iterations is met or no step lowers the energy.
    """
    x = np.array(x_mm, dtype=float)
    hold = pins(x) if fixed is None else fixed
    stiffness = float(np.median(system.shell.dilation_N_mm))
    first_shift = FIRST_SHIFT_RATIO * stiffness
    longest = LONGEST_STEP_RATIO * system.shell.edge_mm * float(np.mean(system.shell.expansion_ratio))
    shift, settled = 0.0, False
    for iteration in range(iterations_max + 1):
        energy, gradient, hessian = system.linearise(x, loads)
        gradient[hold] = 0.0
        residual = float(np.abs(gradient).max()) / system.shell.scale_N
        if watch is not None:
            watch(iteration, x, residual)
        matrix = system.held(hessian, hold)
        if residual <= tolerance_ratio:
            if settled or system.cholesky(matrix, x) is not None:
                return Equilibrium(x, energy, residual, iteration, 0)
            x = x + _way_down(matrix, gradient.shape, hold) * 0.05 * system.shell.edge_mm
            continue
        if iteration == iterations_max:
            break
        factor, shift = _convex(system, matrix, x, shift, first_shift)
        step = -factor.solve(gradient.ravel()).reshape(x.shape)
        step[hold] = 0.0
        step *= min(1.0, longest / max(float(np.linalg.norm(step, axis=1).max()), 1e-300))
        length = _line_search(system, x, step, loads, energy, float(np.sum(gradient * step)))
        if length == 0.0 and residual <= 10 * tolerance_ratio:
            return Equilibrium(x, energy, residual, iteration, factorise(matrix)[1])
        if length == 0.0:
            if shift > 1e6 * stiffness:
                break
            shift = max(16 * shift, first_shift)
            continue
        x = x + length * step
        # A positive factorisation without shift, this near to rest, is that of the rest itself.
        settled = shift == 0 and length == 1 and float(np.abs(step).max()) < SETTLED_RATIO * system.shell.edge_mm
        shift = shift / 4 if length > 0.5 else shift
        shift = 0.0 if shift < first_shift else shift
    raise NotConverged(
        "the deployed shape", residual, iteration, "start nearer to the target shape, or give the sheet more support"
    )


def _line_search(
    system: System, x: Reals, step: Reals, loads: Sequence[Load], energy_mJ: float, slope_mJ: float
) -> float:
    """Return the longest of 1, ½, ¼, … that lowers the energy enough (Armijo); 0 where none does."""
    noise_mJ = 1e-13 * max(abs(energy_mJ), 1e-300)
    length = 1.0
    for _ in range(LINE_SEARCH_STEPS):
        trial = system.energy(x + length * step, loads)
        if np.isfinite(trial) and trial <= energy_mJ + 1e-4 * length * slope_mJ + noise_mJ:
            return length
        length *= 0.5
    return 0.0


def lowest_modes(matrix: sp.csc_matrix, count: int = 1, factor: Factor | None = None) -> tuple[Reals, Reals]:
    """Return the eigenvalues nearest below or around zero, ascending, N/mm, and their vectors `(3n, count)`."""
    inverse = LinearOperator(matrix.shape, matvec=(factor or factorise(matrix)[0]).solve, dtype=float)
    start = np.random.default_rng(7).standard_normal(matrix.shape[0])
    values, vectors = eigsh(matrix, k=count, sigma=0.0, OPinv=inverse, v0=start, which="LM")
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _way_down(matrix: sp.csc_matrix, shape: tuple[int, ...], fixed: NDArray[np.bool_]) -> Reals:
    """Return the direction `(n, 3)` of most negative curvature near zero, its largest component 1."""
    values, vectors = lowest_modes(matrix, count=4)
    direction = vectors[:, int(np.argmin(values))].reshape(shape)
    direction[fixed] = 0.0
    return np.asarray(direction / np.abs(direction).max())


def smallest_eigenvalue_N_mm(
    system: System, x_mm: Reals, loads: Sequence[Load], fixed: NDArray[np.bool_] | None
) -> float:
    """Return the smallest eigenvalue in magnitude of the Hessian on the free degrees of freedom (signed)."""
    hold = pins(x_mm) if fixed is None else fixed
    matrix = system.held(system.linearise(x_mm, loads)[2], hold)
    return float(lowest_modes(matrix, 1, system.cholesky(matrix, x_mm))[0][0])


def fold_angles(x_mm: Reals, hinges: Ints) -> Reals:
    """Return the angle `(h,)` of every fold, positive where the sheet bulges towards its normals."""
    x = np.ascontiguousarray(x_mm)
    return np.array([kernels.fold_angle(x, hinge) for hinge in hinges])
