"""Choosing the free scale factors by linear programme, so that the spread of expansions is least.

The scale factors u are affine in what may be chosen (the rim's values, curvature put into cones), so the least spread
max u − min u is a linear programme; its dual is a proof that nothing less is possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from design.errors import NotConverged
from design.flatten.curve import edge_lengths_mm
from design.surface import Indices, Points

Values = NDArray[np.float64]
Limits = list[tuple[float | None, float | None]]
Equations = tuple[Values, Values]  # E, e: E x = e
START_ROWS_count = 400  # rows the programme begins with; violated ones are added
ROUNDS_count = 60
TOLERANCE_u = 1e-7  # of the log scale: far below what any cell can resolve
GENTLE_u = 1e-3  # spread given away (0.1 %) for a rim that waves less


@dataclass(frozen=True, slots=True)
class Spread:
    """The least spread, how it is reached, and the weights that prove it.

    `proof` holds one weight per row, summing to zero, half its absolute sum one: for any choice the weighted sum of u
    is the same, and no choice can have a smaller spread than that sum.
    """

    choice: Values  # (k,) coefficients of the columns
    u: Values  # (n,) scale factors with that choice
    spread_ratio: float  # exp(max u − min u)
    bound_ratio: float  # proven lower bound of the spread
    proof: Values  # (n,)


def rim_modes(vertices_mm: Points, loop: Indices, count: int) -> Values:
    """Return `(len(loop), count)` cosines and sines of the arc length; the constant is left out, it spreads nothing."""
    lengths_mm = edge_lengths_mm(vertices_mm, loop)
    turn = 2 * np.pi * np.concatenate([[0.0], np.cumsum(lengths_mm)[:-1]]) / lengths_mm.sum()
    phase = np.outer(turn, wave_numbers(count))
    return np.where(np.arange(count) % 2 == 0, np.cos(phase), np.sin(phase))


def wave_numbers(count: int) -> Values:
    """Return how many waves each of `rim_modes` has around the rim: 1, 1, 2, 2, …"""
    return np.asarray(1.0 + np.arange(count) // 2)


def least_spread(
    base: Values,
    columns: Values,
    bounds: Limits | None = None,
    equal: Equations | None = None,
    roughness: Values | None = None,
) -> Spread:
    """Return the choice x that minimises max(base + columns x) − min(base + columns x).

    `base` is `(n,)`, `columns` `(n, k)`; `equal` = (E, e) adds E x = e. With `roughness` `(k,)` the choice is, among
    those within `GENTLE_u` of the least, the one of least Σ roughness·|x|. Rows enter as they are violated.
    """
    limits = bounds or [(None, None)] * columns.shape[1]
    rows = _first_rows(base)
    for _ in range(ROUNDS_count):
        answer = _solve(base[rows], columns[rows], limits, equal)
        x, low, high = answer.x[:-2], answer.x[-2], answer.x[-1]
        u = base + columns @ x
        missed = np.setdiff1d(_worst(u, low, high), rows)
        if len(missed) == 0:
            break
        rows = np.union1d(rows, missed)
    else:
        raise NotConverged("the boundary programme", float(np.ptp(u) - (high - low)), ROUNDS_count)
    proof, bound = _certificate(answer, base, columns, rows, limits, equal)
    if roughness is not None:
        x = _gentlest(base, columns, limits, equal, roughness, float(np.ptp(u)) + GENTLE_u, rows)
        u = base + columns @ x
    return Spread(x, u, float(np.exp(np.ptp(u))), float(np.exp(bound)), proof)


def _first_rows(base: Values) -> Indices:
    step = max(1, len(base) // START_ROWS_count)
    return np.union1d(np.arange(0, len(base), step), [int(base.argmin()), int(base.argmax())])


def _worst(u: Values, low: float, high: float) -> Indices:
    """Return the rows most outside the window, at most a hundred on either side."""
    above, below = u - high, low - u
    out = [side.argsort()[-100:] for side in (above, below)]
    chosen = np.concatenate([out[0][above[out[0]] > TOLERANCE_u], out[1][below[out[1]] > TOLERANCE_u]])
    return np.unique(chosen)


def _solve(base: Values, columns: Values, limits: Limits, equal: Equations | None) -> Any:
    """Minimise high − low subject to low ≤ base + columns x ≤ high; variables x, low, high."""
    ones, none = np.ones((len(base), 1)), np.zeros((len(base), 1))
    A = np.block([[columns, none, -ones], [-columns, ones, none]])
    b = np.concatenate([-base, base])
    cost = np.zeros(columns.shape[1] + 2)
    cost[-2:] = -1, 1
    A_eq, b_eq = (np.pad(equal[0], ((0, 0), (0, 2))), equal[1]) if equal else (None, None)
    bounds = [*limits, (None, None), (None, None)]
    return _solved("the boundary programme", c=cost, A_ub=A, b_ub=b, A_eq=A_eq, b_eq=b_eq, bounds=bounds)


def _solved(name: str, **programme: Any) -> Any:
    """Return the programme's answer; raise `NotConverged` where it has none.

    HiGHS's presolve gives up on some well-posed ones (equations of nearly equal coefficients), so they are tried whole.
    """
    for presolve in (True, False):
        answer: Any = linprog(**programme, method="highs", options={"presolve": presolve})
        if answer.success:
            return answer
    raise NotConverged(name, float("nan"), int(answer.nit), answer.message)


def _certificate(
    answer: Any,
    base: Values,
    columns: Values,
    rows: Indices,
    limits: Limits,
    equal: Equations | None,
) -> tuple[Values, float]:
    """Return the dual weights over all rows and the bound on max u − min u they prove, re-computed from scratch.

    For weights p = p⁺ − p⁻ of mass one each, spread ≥ p·u = p·base + (pᵀ columns)·x. Where bounds or equations tie x
    the product with x is bounded by them; what is left over is numerical and taken off.
    """
    half = len(rows)
    weights = -answer.ineqlin.marginals
    plus, minus = np.maximum(weights[:half], 0), np.maximum(weights[half:], 0)
    proof = np.zeros(len(base))
    proof[rows] = plus / max(plus.sum(), 1e-300) - minus / max(minus.sum(), 1e-300)
    slope = columns.T @ proof
    bound = float(proof @ base)
    if equal is not None:
        multipliers = -answer.eqlin.marginals
        # E x = e lets a combination of the equations be taken off the slope at the price of its right side.
        slope = slope + equal[0].T @ multipliers
        bound -= float(multipliers @ equal[1])
    x = answer.x[:-2]
    for k, (low, high) in enumerate(limits):
        edge = low if slope[k] > 0 else high
        bound += float(slope[k] * edge) if edge is not None else -abs(float(slope[k] * x[k]))
    return proof, bound


def _gentlest(
    base: Values,
    columns: Values,
    limits: Limits,
    equal: Equations | None,
    roughness: Values,
    spread: float,
    rows: Indices,
) -> Values:
    """Return the x of least Σ roughness·|x| with max − min ≤ `spread`; variables x, |x|, low."""
    k = columns.shape[1]
    for _ in range(ROUNDS_count):
        C, ones, eye = columns[rows], np.ones((len(rows), 1)), np.eye(k)
        wide, tall = np.zeros((len(rows), k)), np.zeros((k, 1))
        A = np.block([[C, wide, -ones], [-C, wide, ones], [eye, -eye, tall], [-eye, -eye, tall]])
        b = np.concatenate([spread - base[rows], base[rows], np.zeros(2 * k)])
        cost = np.concatenate([np.zeros(k), roughness, [0.0]])
        A_eq, b_eq = (np.pad(equal[0], ((0, 0), (0, k + 1))), equal[1]) if equal else (None, None)
        bounds = [*limits, *[(0, None)] * k, (None, None)]
        name = "the gentle boundary programme"
        answer = _solved(name, c=cost, A_ub=A, b_ub=b, A_eq=A_eq, b_eq=b_eq, bounds=bounds)
        low = answer.x[-1]
        missed = np.setdiff1d(_worst(base + columns @ answer.x[:k], low, low + spread), rows)
        if len(missed) == 0:
            break
        rows = np.union1d(rows, missed)
    return np.asarray(answer.x[:k])
