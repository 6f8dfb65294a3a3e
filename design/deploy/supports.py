"""Weight, a floor and its friction: what a deployed sheet stands on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.cells.sheet import Sheet
from design.deploy.indentation import CONTACT_RATIO, standing_rim
from design.deploy.levels import Layout
from design.deploy.newton import Equilibrium, Load, System, smallest_eigenvalue_N_mm, solve
from design.deploy.shell import Reals
from design.errors import NotConverged

GRAVITY_M_S2 = 9.80665
Support = Literal["free", "held", "no-slip", "slip", "coulomb"]
SUPPORTS: tuple[Support, ...] = ("free", "held", "no-slip", "slip", "coulomb")
FRICTION_ROUNDS = 25  # of normal force and friction limit; they settle in a few
FRICTION_RATIO = 1e-6  # change of the friction limits, of the whole weight, that counts as settled
NO_SLIP = 1e6  # a friction coefficient that nothing here overcomes


@dataclass(frozen=True, slots=True)
class Weight:
    """A constant downward force on each vertex."""

    force_N: Reals  # (n,) along −z

    def energy(self, x_mm: Reals) -> float:
        """Return the potential, mJ."""
        return float(self.force_N @ x_mm[:, 2])

    def add(self, x_mm: Reals, gradient_N: Reals, blocks_N_mm: Reals) -> None:
        """Add the gradient; there is no Hessian."""
        gradient_N[:, 2] += self.force_N


@dataclass(frozen=True, slots=True)
class Floor:
    """A bed that pushes up whatever is below it: energy ½·stiffness·depth² per vertex."""

    height_mm: Reals  # (n,) under each vertex
    stiffness_N_mm: float

    def force_N(self, x_mm: Reals) -> Reals:
        """Return the floor's push on each vertex, `(n,)`."""
        return np.asarray(self.stiffness_N_mm * np.maximum(0.0, self.height_mm - x_mm[:, 2]))

    def energy(self, x_mm: Reals) -> float:
        """Return the energy, mJ."""
        return float(0.5 * np.sum(self.force_N(x_mm) ** 2) / self.stiffness_N_mm)

    def add(self, x_mm: Reals, gradient_N: Reals, blocks_N_mm: Reals) -> None:
        """Add gradient and Hessian blocks."""
        push = self.force_N(x_mm)
        gradient_N[:, 2] -= push
        blocks_N_mm[push > 0, 2, 2] += self.stiffness_N_mm


@dataclass(frozen=True, slots=True)
class Friction:
    """Springs to where each vertex stands, which give way at a limit (Coulomb, with the normal force given)."""

    anchor_mm: Reals  # (n, 2)
    limit_N: Reals  # (n,) 0 where a vertex does not stand
    stiffness_N_mm: float

    def _stretch(self, x: Reals) -> tuple[Reals, Reals]:
        away = x[:, :2] - self.anchor_mm
        return away, np.linalg.norm(away, axis=1)

    def energy(self, x_mm: Reals) -> float:
        """Return the energy, mJ: quadratic while a vertex sticks, linear once it slides."""
        length = self._stretch(x_mm)[1]
        k, limit = self.stiffness_N_mm, self.limit_N
        sticking = 0.5 * k * length**2
        sliding = limit * length - limit**2 / (2 * k)
        return float(np.sum(np.where(k * length <= limit, sticking, sliding)))

    def add(self, x_mm: Reals, gradient_N: Reals, blocks_N_mm: Reals) -> None:
        """Add gradient and Hessian blocks."""
        away, length = self._stretch(x_mm)
        k = self.stiffness_N_mm
        sliding = k * length > self.limit_N
        safe = np.where(length > 0, length, 1.0)
        pull = np.where(sliding, self.limit_N / safe, k)
        gradient_N[:, :2] += pull[:, None] * away
        unit = away / safe[:, None]
        along = np.where(sliding, pull, 0.0)
        outer = unit[:, :, None] * unit[:, None, :]
        blocks_N_mm[:, :2, :2] += pull[:, None, None] * np.eye(2) - along[:, None, None] * outer

    def moved(self, x_mm: Reals) -> Reals:
        """Return the anchors dragged after the vertices that slid, `(n, 2)`."""
        away, length = self._stretch(x_mm)
        reach = self.limit_N / self.stiffness_N_mm
        slid = length > reach
        back = away * (reach / np.where(length > 0, length, 1.0))[:, None]
        return np.where(slid[:, None], x_mm[:, :2] - back, self.anchor_mm)


@dataclass(frozen=True, slots=True)
class Settled:
    """A sheet at rest under its weight."""

    equilibrium: Equilibrium
    unloaded_mm: Reals  # (n, 3) the same sheet before its weight acts
    weight_N: float
    sag_mm: float  # how far the highest vertex comes down
    worst_mm: float  # the furthest any vertex moves
    standing_count: int  # vertices that the floor carries or that are held
    slid_mm: float  # the furthest a standing vertex slid
    smallest_eigenvalue_N_mm: float  # of the loaded sheet on its support


def weight_of(layout: Layout, sheet: Sheet) -> Weight:
    """Return the weight of the sheet's units, a third at each corner; the slits' own width is not taken off."""
    unit_mm3 = np.sqrt(0.1875) * layout.edge_mm**2 * sheet.thickness_mm
    unit_N = sheet.density_kg_m3 * 1e-9 * unit_mm3 * GRAVITY_M_S2
    return Weight(np.bincount(layout.cells.ravel(), minlength=layout.vertex_count) * unit_N / 3)


def settle(
    layout: Layout,
    x_mm: Reals,
    sheet: Sheet,
    support: Support = "no-slip",
    friction_ratio: float = 0.5,
    bedded: bool = True,
    steps_count: int = 4,
    watch: Callable[[float], None] | None = None,
) -> Settled:
    """Return the rest of a deployed sheet under gravity (−z) on a floor.

    `held`: the rim stays where it is. `no-slip`: what stands on the floor cannot slide but may lift. `coulomb`: it
    slides beyond `friction_ratio` times its load. `slip`: no friction. `bedded`: the whole rim stands, each of its
    vertices at its own height, as on a bed made to the rim; otherwise the floor is level and touches only the lowest
    vertices (the rim of a tiling is a zigzag). The weight comes on in `steps_count` steps, because friction remembers
    the way. Raises `NotConverged` where a step finds no rest.
    """
    if support == "free":
        raise ValueError("a sheet with weight needs a support")
    system = System(layout.shell())
    whole = weight_of(layout, sheet)
    rim = standing_rim(layout.cells, x_mm)
    lowest = float(x_mm[:, 2].min())
    height = np.where(rim & bedded, x_mm[:, 2], lowest)
    floor = Floor(height, CONTACT_RATIO * float(np.median(system.shell.dilation_N_mm)))
    fixed = level_pins(x_mm)
    ratio = {"held": 0.0, "no-slip": NO_SLIP, "slip": 0.0, "coulomb": friction_ratio}[support]
    standing = x_mm[:, 2] <= height
    share_N = float(whole.force_N.sum()) / steps_count / max(int(standing.sum()), 1)
    friction = Friction(x_mm[:, :2].copy(), np.where(standing, ratio * share_N, 0.0), floor.stiffness_N_mm)
    if support == "held":
        fixed = np.repeat(rim[:, None], 3, axis=1)
    x, iterations, residual = x_mm, 0, 0.0
    for step in range(1, steps_count + 1):
        weight = Weight(whole.force_N * step / steps_count)
        loads: list[Load] = [weight] if support == "held" else [weight, floor]
        found, friction = _rub(system, x, loads, floor, friction, ratio, fixed)
        iterations += found.iterations_count
        residual = max(residual, found.residual_ratio)
        x = found.x_mm
        if watch is not None:
            watch(step / steps_count)
    held = np.zeros_like(fixed) if ratio and np.sum(friction.limit_N > 0) > 2 else fixed
    carried = rim if support == "held" else floor.force_N(x) > 0
    slid = np.linalg.norm((x - x_mm)[carried, :2], axis=1)
    top = int(np.argmax(x_mm[:, 2]))
    return Settled(
        replace(found, iterations_count=iterations, residual_ratio=residual),
        x_mm,
        float(whole.force_N.sum()),
        float(x_mm[top, 2] - x[top, 2]),
        float(np.linalg.norm(x - x_mm, axis=1).max()),
        int(carried.sum()),
        float(slid.max()) if len(slid) else 0.0,
        smallest_eigenvalue_N_mm(system, x, loads if ratio == 0 else [*loads, friction], held),
    )


def level_pins(x: Reals) -> NDArray[np.bool_]:
    """Return degrees of freedom that stop drifting and turning over a level floor, and nothing else.

    Without friction nothing else would; with it they carry no force, as the pull of friction sums to zero.
    """
    fixed = np.zeros(x.shape, dtype=bool)
    away = np.linalg.norm(x[:, :2] - x[:, :2].mean(axis=0), axis=1)
    first = int(np.argmin(away))
    second = int(np.argmax(np.abs(x[:, 0] - x[first, 0])))
    fixed[first, :2] = True
    fixed[second, 1] = True
    return fixed


def _rub(
    system: System, x: Reals, loads: Sequence[Load], floor: Floor, friction: Friction, ratio: float,
    fixed: NDArray[np.bool_],
) -> tuple[Equilibrium, Friction]:  # fmt: skip
    """Return the rest under given loads with friction limits that agree with the floor's forces."""
    if ratio == 0.0:
        return solve(system, x, loads, fixed), friction
    whole = max(float(sum(load.force_N.sum() for load in loads if isinstance(load, Weight))), 1e-300)
    stood = friction.limit_N > 0
    for _ in range(FRICTION_ROUNDS):
        found = solve(system, x, [*loads, friction], np.zeros_like(fixed) if stood.sum() > 2 else fixed)
        x = found.x_mm
        push = floor.force_N(x)
        fresh = (push > 0) & ~stood
        anchor = np.where(fresh[:, None], x[:, :2], friction.anchor_mm)
        limit = ratio * push
        change = float(np.abs(np.minimum(limit, whole) - np.minimum(friction.limit_N, whole)).max())
        friction = Friction(anchor, limit, friction.stiffness_N_mm)
        stood = push > 0
        if change <= FRICTION_RATIO * whole:
            return found, Friction(friction.moved(x), friction.limit_N, friction.stiffness_N_mm)
    raise NotConverged("friction on the floor", change / whole, FRICTION_ROUNDS, "lay it on in more steps")
