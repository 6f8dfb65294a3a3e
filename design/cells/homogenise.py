"""One cell, from (t, θ) to its numbers: is it bistable, at what expansion, behind what barrier, and how stiff there.

The cell is stretched evenly from rest; dE/ds rises, falls through zero at the saddle P3 and rises through zero at the
second stable state P5. Both are solved as roots of (dE/dy, dE/ds). The uniaxial path of the paper crosses the same two
states, because at zero average stress the three-fold cell is isotropic; its stiffness differs, and is taken from the
periodic cell of two units (`tangent`). A cell without an answer gets a verdict and a reason, never a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import estimated_expansion_ratio, fault
from design.cells.mesh import REFERENCE, Density
from design.cells.sector import TOLERANCE_RATIO, Model, State, model, relax, root
from design.cells.sheet import Sheet
from design.cells.tangent import moduli

Array = NDArray[np.float64]
Verdict = Literal["bistable", "not bistable", "invalid", "not converged"]

SECTORS = 18  # in a hexagonal cell
SHALLOW_WELL_RATIO = 0.03  # barrier over stored energy: below, half the mesh size moves it by more than itself
FINER = 2  # how much finer the mesh is that shallow wells are decided on
STEP_RATIO = 0.02  # of the stretch between two equilibria on the path
SMALLEST_STEP_RATIO = 0.02 / 64
BEYOND_RATIO = 0.12  # how far past the linkage's own expansion the path is followed
LEAST_REACH_RATIO = 1.2  # the path goes at least this far; second states begin at 1.12


@dataclass(frozen=True, slots=True)
class Cell:
    """What one (t, θ) came to. Energies are per hexagon and per E·thickness; numbers are None unless bistable."""

    t_mm: float
    theta_rad: float
    verdict: Verdict
    reason: str = ""
    residual_ratio: float = math.nan
    expansion_ratio: float | None = None
    saddle_ratio: float | None = None
    barrier_mm2: float | None = None
    stored_mm2: float | None = None  # energy at P5
    stiffness_mm2: float | None = None
    nu_tangent_ratio: float | None = None
    mesh_ratio: float | None = None  # size of the mesh that gave the figures, over the one asked for
    open_ratio: float | None = None  # open cells: the expansion of the slit cell they are cut as
    overlap_frac: float | None = None  # open cells: material lying on material once closed
    curve_mm2: list[float] | None = None  # energy of the even stretch at CURVE_SHARES, for some cells


@dataclass(frozen=True, slots=True)
class Pair:
    """The saddle P3 and the second stable state P5 of one cell."""

    saddle: State
    stable: State


@dataclass(frozen=True, slots=True)
class Failure:
    """Why there is no pair."""

    verdict: Verdict
    reason: str
    residual_ratio: float = math.nan


Found = tuple[Model, Pair] | Failure


@dataclass(frozen=True, slots=True)
class Trail:
    """The states of the last one or two cells of a row, from which the next may start, on its mesh and on the finer."""

    pairs: tuple[Pair, ...] = ()
    finer: tuple[Pair, ...] = ()

    def joined(self, found: Found, finer: Found | None) -> Trail:
        """Return the trail one cell further; a cell without states breaks it off."""
        return Trail(_joined(self.pairs, found), _joined(self.finer, finer))


def _joined(pairs: tuple[Pair, ...], found: Found | None) -> tuple[Pair, ...]:
    return () if found is None or isinstance(found, Failure) else (*pairs[-1:], found[1])


def solve_cell(t_mm: float, theta_rad: float, sheet: Sheet, density: Density = REFERENCE) -> Cell:
    """Return the cell (t, θ), solved from rest."""
    found, mesh_ratio, _ = walked(t_mm, theta_rad, sheet, density, Trail())
    return cell_of(t_mm, theta_rad, found, mesh_ratio)


def walked(
    t_mm: float, theta_rad: float, sheet: Sheet, density: Density, trail: Trail, even: bool = True
) -> tuple[Found, float, Trail]:
    """Return what is found at (t, θ), the size of the mesh that decided over that of `density`, and the trail after it.

    Where the well is shallow a mesh of half the size decides. `even` says that t goes on by the step it went before.
    """
    found = solve_pair(t_mm, theta_rad, sheet, density, _ahead_of(trail.pairs, even))
    if isinstance(found, Failure) or not is_shallow(found[1]):
        return found, 1.0, trail.joined(found, None)
    finer = solve_pair(t_mm, theta_rad, sheet, density.refined(FINER), _ahead_of(trail.finer, even))
    after = trail.joined(found, finer)
    if isinstance(finer, Failure):
        finer = Failure(finer.verdict, f"at half the mesh size, the well being shallow: {finer.reason}")
    return finer, 1 / FINER, after


def _ahead_of(pairs: tuple[Pair, ...], even: bool) -> Pair | None:
    return predicted(*pairs) if even and len(pairs) == 2 else None


def solve_pair(t_mm: float, theta_rad: float, sheet: Sheet, density: Density, guess: Pair | None = None) -> Found:
    """Return the model and its two states: by Newton from `guess` where that holds, else along the path from rest."""
    reason = fault(t_mm, theta_rad, sheet)
    if reason is not None:
        return Failure("invalid", reason)
    m = model(t_mm, theta_rad, sheet, density)
    if m.weights.min() <= 0:
        return Failure("invalid", "the template mesh folds in this polygon")
    if guess is not None:
        pair = _from_guess(m, guess)
        if pair is not None:
            return m, pair
    reach = max(LEAST_REACH_RATIO, estimated_expansion_ratio(t_mm, theta_rad, sheet) + BEYOND_RATIO)
    found = follow(m, reach)
    return found if isinstance(found, Failure) else (m, found)


def is_shallow(pair: Pair) -> bool:
    """Tell whether the mesh's error of the barrier is as large as the barrier."""
    return (pair.saddle.energy_mm2 - pair.stable.energy_mm2) / pair.stable.energy_mm2 < SHALLOW_WELL_RATIO


def cell_of(t_mm: float, theta_rad: float, found: Found, mesh_ratio: float = 1.0) -> Cell:
    """Return the cell's figures from its two states, or the verdict without any."""
    if isinstance(found, Failure):
        return Cell(t_mm, theta_rad, found.verdict, found.reason, found.residual_ratio)
    m, pair = found
    saddle, stable = pair.saddle, pair.stable
    linear = moduli(m, m.nodes(stable.y, stable.s_ratio))
    return Cell(
        t_mm,
        theta_rad,
        "bistable",
        "",
        max(saddle.residual_ratio, stable.residual_ratio),
        expansion_ratio=stable.s_ratio,
        saddle_ratio=saddle.s_ratio,
        barrier_mm2=SECTORS * (saddle.energy_mm2 - stable.energy_mm2),
        stored_mm2=SECTORS * stable.energy_mm2,
        stiffness_mm2=linear.stiffness_mm2,
        nu_tangent_ratio=linear.nu_ratio,
        mesh_ratio=mesh_ratio,
    )


def predicted(before: Pair, last: Pair) -> Pair:
    """Return where the pair goes next if it goes on as it went (secant)."""
    return Pair(_ahead(before.saddle, last.saddle), _ahead(before.stable, last.stable))


def _ahead(a: State, b: State) -> State:
    return State(
        2 * b.y - a.y, 2 * b.s_ratio - a.s_ratio, b.energy_mm2, 0.0, b.curve_total, b.drift, 0, math.inf, 0, False
    )


CURVE_SHARES = np.linspace(0.0, 1.12, 29)  # of the way from flat to the second stable state


def even_curve_mm2(m: Model, pair: Pair) -> list[float] | None:
    """Return the energy per hexagon of the even stretch at CURVE_SHARES, or None where a point did not converge."""
    state = relax(m, m.rest, 1.0)
    energies = [SECTORS * state.energy_mm2]
    for share in CURVE_SHARES[1:]:
        state = _held(m, state, 1 + float(share) * (pair.stable.s_ratio - 1))
        if not state.converged:
            return None
        energies.append(SECTORS * state.energy_mm2)
    return energies


GUESS_DRIFT_RATIO = 0.02  # a root further than this from its guess may be another branch


def _from_guess(m: Model, guess: Pair) -> Pair | None:
    stable = root(m, guess.stable.y, guess.stable.s_ratio, 8)
    if not is_stable(stable) or abs(stable.s_ratio - guess.stable.s_ratio) > GUESS_DRIFT_RATIO:
        return None
    saddle = root(m, guess.saddle.y, guess.saddle.s_ratio, 8)
    if abs(saddle.s_ratio - guess.saddle.s_ratio) > GUESS_DRIFT_RATIO:
        return None
    pair = Pair(saddle, stable)
    return pair if is_pair(pair) else None


def is_stable(state: State) -> bool:
    """Tell whether `state` is a converged minimum in y and s together."""
    return state.converged and state.negative_count == 0 and state.curve_total > 0


def is_pair(pair: Pair) -> bool:
    """Tell whether the two states are a saddle of index one and a minimum behind it."""
    saddle, stable = pair.saddle, pair.stable
    index = saddle.negative_count + (saddle.curve_total < 0)
    return (
        is_stable(stable)
        and saddle.converged
        and index == 1
        and 0 < (saddle.s_ratio - 1) / (stable.s_ratio - 1) < 1
        and saddle.energy_mm2 > stable.energy_mm2
    )


def follow(m: Model, reach_ratio: float) -> Pair | Failure:
    """Return the pair found by stretching from rest up to `reach_ratio`, or by closing down to it where below one."""
    sign = 1 if reach_ratio > 1 else -1
    last = relax(m, m.rest, 1.0)
    least = math.inf  # of the slope along the path where it dips
    saddle: State | None = None
    while sign * last.s_ratio < sign * reach_ratio:
        state = _next(m, last, sign)
        if isinstance(state, Failure):
            return state
        rise, before = sign * state.slope, sign * last.slope
        if saddle is None and rise <= 0 < before:
            saddle = _crossing(m, last, state)
        elif saddle is None and last.curve_total < 0 < state.curve_total:
            low = _least_slope(m, last, state, sign)
            least = min(least, sign * low.slope)
            if sign * low.slope < 0:
                return _pair(_crossing(m, last, low), _crossing(m, low, state))
        elif saddle is not None and rise >= 0:
            pair = _pair(saddle, _crossing(m, last, state))
            return pair if isinstance(pair, Failure) or sign < 0 else _deepest(m, pair, state)
        last = state
    where = f"up to the stretch {reach_ratio:.3f}"
    if saddle is not None:
        return Failure("not converged", f"dE/ds stays negative {where}", last.residual_ratio)
    if math.isfinite(least):
        reason = f"dE/ds dips but stays above zero: {least * SECTORS:.3g} mm²"
        return Failure("not bistable", reason, last.residual_ratio)
    return Failure("not bistable", f"dE/ds keeps rising {where}", last.residual_ratio)


def _next(m: Model, last: State, sign: int = 1) -> State | Failure:
    """Return the equilibrium one step further, by smaller steps where the first is too bold."""
    step = sign * STEP_RATIO
    while True:
        state = relax(m, last.y + step * last.drift, last.s_ratio + step)
        if state.converged:
            return state
        step /= 4
        if abs(step) < SMALLEST_STEP_RATIO:
            return Failure(
                "not converged", f"no equilibrium at the stretch {last.s_ratio + step:.4f}", state.residual_ratio
            )


LOOK_RATIO = 0.06  # of the stretch, how far past a second state a deeper one is looked for


def _deepest(m: Model, pair: Pair, past: State) -> Pair:
    """Return the pair, with the deeper well behind it where the path drops into one.

    A thin hinge snaps on the way down from the saddle, and may land in a shallow well with about twice the energy.
    Stretched on it drops out of that; past the deepest well the energy only rises.
    """
    last, end = past, pair.stable.s_ratio + LOOK_RATIO
    while last.s_ratio < end:
        state = _next(m, last)
        if isinstance(state, Failure):
            break
        if state.energy_mm2 < last.energy_mm2:
            deeper = Pair(pair.saddle, root(m, state.y, state.s_ratio))
            if is_pair(deeper) and deeper.stable.energy_mm2 < pair.stable.energy_mm2:
                pair = deeper
        last = state
    return pair


def _least_slope(m: Model, a: State, b: State, sign: int) -> State:
    """Return about where the path's slope is least between two states of opposite curvature, or is negative."""
    best = min(a, b, key=lambda state: sign * state.slope)
    for _ in range(8):
        share = a.curve_total / (a.curve_total - b.curve_total)
        mid = _held(m, a, a.s_ratio + float(np.clip(share, 0.1, 0.9)) * (b.s_ratio - a.s_ratio))
        if not mid.converged:
            break
        best = min(best, mid, key=lambda state: sign * state.slope)
        if sign * best.slope < 0 or abs(b.s_ratio - a.s_ratio) < SMALLEST_STEP_RATIO:
            break
        a, b = (mid, b) if mid.curve_total < 0 else (a, mid)
    return best


def _held(m: Model, near: State, s_ratio: float) -> State:
    return relax(m, near.y + (s_ratio - near.s_ratio) * near.drift, s_ratio)


def _crossing(m: Model, a: State, b: State) -> State:
    """Return the root of dE/ds between two states where it has opposite signs: Newton, kept inside by halving."""
    falls = (a.slope > 0) == (b.s_ratio > a.s_ratio)  # seen in the direction of growing s: the saddle
    found = a
    for _ in range(12):
        start = a if abs(a.slope) < abs(b.slope) else b
        found = root(m, start.y, start.s_ratio)
        low, high = sorted((a.s_ratio, b.s_ratio))
        inside = low - SMALLEST_STEP_RATIO <= found.s_ratio <= high + SMALLEST_STEP_RATIO
        if found.converged and inside and (found.curve_total < 0) == falls:
            return found
        mid = _held(m, a, 0.5 * (a.s_ratio + b.s_ratio))
        if not mid.converged:
            break
        a, b = (mid, b) if mid.slope * a.slope > 0 else (a, mid)
    return found


def _pair(saddle: State, stable: State) -> Pair | Failure:
    pair = Pair(saddle, stable)
    if is_pair(pair):
        return pair
    residual = max(saddle.residual_ratio, stable.residual_ratio)
    if residual > TOLERANCE_RATIO:
        return Failure("not converged", "the saddle or the stable state was not reached", residual)
    return Failure("not converged", "the roots found are not a saddle and a minimum behind it", residual)
