"""Change the units' expansions so that the sheet at rest, bent and loaded, meets its target.

Gauss-Newton in the expansions with a trust region. Sensitivities are those of the equilibrium itself: with H the
Hessian and g the gradient at rest, dx/dλ = −H⁻¹ ∂g/∂λ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from design.deploy.compare import kabsch
from design.deploy.factor import factorise
from design.deploy.levels import Layout
from design.deploy.newton import Equilibrium, System, pins, solve
from design.deploy.shell import Ints, Reals, neighbours
from design.deploy.standing import FREE, Standing
from design.errors import NotConverged

REACH = 3  # units, across sides, as far as one unit's expansion enters the forces
STEP_RATIO = 1e-5  # of expansion, for the derivative of the forces by differences
ROUNDS = 12
SMOOTH_FRAC = 1e-3  # weight of roughness against the mean sensitivity
GAIN_RATIO = 0.02  # a round that lowers the misfit by less than this is the last


@dataclass(frozen=True, slots=True)
class Compensation:
    """What changing the expansions came to. Refused (`helps` False) where the misfit hardly falls."""

    layout: Layout
    equilibrium: Equilibrium
    before_mm: float  # RMS of corresponding points
    after_mm: float
    change_ratio: float  # the greatest change of an expansion
    at_bound_count: int  # units that the library stops
    rounds_count: int
    helps: bool


def compensate(
    layout: Layout,
    goal_mm: Reals,
    bounds_ratio: tuple[float, float],
    start_mm: Reals | None = None,
    standing: Standing = FREE,
    watch: Callable[[float], None] | None = None,
    changeable: NDArray[np.bool_] | None = None,
) -> Compensation:
    """Return the layout with the expansions that bring its vertices nearest to `goal_mm` `(n, 3)`.

    Only units that are `changeable` `(m,)` are touched (by default all): solid ones have no expansion to choose.

    `standing` is what acts on the sheet, by default nothing; degrees of freedom that it holds keep their values of
    `start_mm`. Expansions stay within `bounds_ratio`, those of the library. Stiffness stays what it was: choose cells
    anew for the result.
    """
    free = np.ones(len(layout.cells), dtype=bool) if changeable is None else changeable
    task = _Task(goal_mm, bounds_ratio, standing, _roughness(layout.cells), layout.expansion_ratio, free)
    start = goal_mm if start_mm is None else start_mm
    found = solve(System(layout.shell()), start, standing.loads, standing.fixed)
    before = best = misfit_mm(found.x_mm, goal_mm, standing)
    current, damping, rounds = layout, 1e-3, 0
    for rounds in range(1, ROUNDS + 1):
        try:
            trial, rest, misfit, damping = _better(task, current, found, damping, best)
        except NotConverged:
            break
        gain = best - misfit
        current, found, best = trial, rest, misfit
        if watch is not None:
            watch(rounds / ROUNDS)
        if gain < GAIN_RATIO * best:
            break
    lam = current.expansion_ratio
    stopped = int(np.sum(free & ((lam <= bounds_ratio[0]) | (lam >= bounds_ratio[1]))))
    change = float(np.abs(lam - layout.expansion_ratio).max())
    return Compensation(current, found, before, best, change, stopped, rounds, best < 0.9 * before)


@dataclass(frozen=True, slots=True)
class _Task:
    goal_mm: Reals
    bounds_ratio: tuple[float, float]
    standing: Standing
    roughness: sp.csr_matrix
    original_ratio: Reals
    free: NDArray[np.bool_]


def _better(
    task: _Task, layout: Layout, rest: Equilibrium, damping: float, best: float
) -> tuple[Layout, Equilibrium, float, float]:
    """Return a layout with less misfit, its rest, misfit and the damping to go on with; raise where there is none."""
    moves = _sensitivity(layout, rest.x_mm, task.standing)
    gap = _gap_mm(rest.x_mm, task.goal_mm, task.standing)
    if task.standing.aligned:
        moves = _without_rigid(moves, rest.x_mm)
    normal = moves.T @ moves
    size = float(np.trace(normal)) / len(normal)
    smooth = SMOOTH_FRAC * size * task.roughness.toarray()
    pull = moves.T @ gap.ravel() + smooth @ (layout.expansion_ratio - task.original_ratio)
    free = task.free
    for _ in range(8):
        damped = (normal + smooth + damping * size * np.eye(len(normal)))[np.ix_(free, free)]
        wanted = layout.expansion_ratio.copy()
        wanted[free] = np.clip(wanted[free] - np.linalg.solve(damped, pull[free]), *task.bounds_ratio)
        trial = replace(layout, expansion_ratio=wanted)
        try:
            held = task.standing
            found = solve(System(trial.shell()), rest.x_mm, held.loads, held.fixed, iterations_max=60)
            misfit = misfit_mm(found.x_mm, task.goal_mm, held)
        except NotConverged:
            misfit = np.inf
        if misfit < best:
            return trial, found, misfit, max(damping / 5, 1e-6)
        damping *= 8
    raise NotConverged("compensation", best, 8, "no change of the expansions lowers the misfit")


def misfit_mm(x_mm: Reals, goal_mm: Reals, standing: Standing = FREE) -> float:
    """Return the RMS distance of corresponding points; a sheet that is not held is aligned rigidly first."""
    return float(np.sqrt(np.mean(np.sum(_gap_mm(x_mm, goal_mm, standing) ** 2, axis=1))))


def _gap_mm(x: Reals, goal: Reals, standing: Standing) -> Reals:
    """Return how far each vertex is from where it belongs, `(n, 3)`, in the frame of `x`."""
    if standing.aligned:
        rotation, shift = kabsch(goal, x)
        goal = goal @ rotation.T + shift
    return x - goal


def _without_rigid(moves: Reals, x: Reals) -> Reals:
    """Return sensitivities `(3n, m)` less their rigid motions, which alignment takes out."""
    away = x - x.mean(axis=0)
    turns = [np.cross(axis, away).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(x)) for axis in np.eye(3)]
    basis = np.linalg.qr(np.array([*turns, *shifts]).T)[0]
    return np.asarray(moves - basis @ (basis.T @ moves))


def _sensitivity(layout: Layout, x: Reals, standing: Standing) -> Reals:
    """Return dx/dλ, `(3n, m)`, at rest."""
    system = System(layout.shell())
    hold = pins(x) if standing.fixed is None else standing.fixed
    matrix = system.held(system.linearise(x, standing.loads)[2], hold)
    factor = system.cholesky(matrix, x) or factorise(matrix)[0]
    forces = force_derivative(layout, x).toarray()
    forces[hold.ravel()] = 0.0
    return np.asarray(-factor.solve(forces))


def force_derivative(layout: Layout, x: Reals) -> sp.csc_matrix:
    """Return ∂g/∂λ, `(3n, m)`, by central differences, many units at a time: those whose reaches do not meet."""
    m, n = len(layout.cells), layout.vertex_count
    reach = _reach(layout.cells, n)
    colours = _colours((reach @ reach.T).tocsr())
    rows, cols, values, system = [], [], [], System(layout.shell())
    for colour in range(int(colours.max()) + 1):
        some = np.flatnonzero(colours == colour)
        nudge = np.zeros(m)
        nudge[some] = STEP_RATIO
        more, less = (
            system.of(replace(layout, expansion_ratio=layout.expansion_ratio + sign * nudge).shell()).gradient(x)[1]
            for sign in (1, -1)
        )
        slope = (more - less) / (2 * STEP_RATIO)
        part = reach[some].tocoo()
        for axis in range(3):
            rows.append(3 * part.col + axis)
            cols.append(some[part.row])
            values.append(slope[part.col, axis])
    return sp.csc_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=(3 * n, m))


def _adjacency(cells: Ints) -> sp.csr_matrix:
    across = neighbours(cells)
    one, side = np.nonzero(across >= 0)
    return sp.csr_matrix((np.ones(len(one)), (one, across[one, side])), shape=(len(cells), len(cells)))


def _reach(cells: Ints, vertex_count: int) -> sp.csr_matrix:
    """Return which vertices (columns) feel each unit's expansion."""
    m = len(cells)
    near = sp.identity(m, format="csr")
    beside = _adjacency(cells) + sp.identity(m, format="csr")
    for _ in range(REACH):
        near = near @ beside
    corners = sp.csr_matrix((np.ones(3 * m), (np.repeat(np.arange(m), 3), cells.ravel())), shape=(m, vertex_count))
    touched = (near @ corners).tocsr()
    touched.data[:] = 1.0
    return touched


def _colours(conflict: sp.csr_matrix) -> Ints:
    """Return a colour per row, so that no two rows in conflict share one (first fit)."""
    colours = np.full(conflict.shape[0], -1, dtype=np.int64)
    for k in range(len(colours)):
        taken = set(colours[conflict.indices[conflict.indptr[k] : conflict.indptr[k + 1]]].tolist())
        colour = 0
        while colour in taken:
            colour += 1
        colours[k] = colour
    return colours


def _roughness(cells: Ints) -> sp.csr_matrix:
    """Return the Laplacian of the units' neighbourhood: a quadratic form that is zero for an even change."""
    beside = _adjacency(cells)
    return sp.csr_matrix(sp.diags(np.asarray(beside.sum(axis=1)).ravel()) - beside)
