"""The sheet opened unit by unit from flat: each is pulled open, let go, and stays open or not.

Pulled alone and let go, a unit is closed again by its neighbours wherever its own barrier is low. So the hand may keep
what it has pulled until the neighbours are pulled too (`hold`), as one opens a sheet from one place outwards.

Units have their whole energy curve here, two wells with a barrier between, not the tangent of the second one. Which of
them holds is decided by the sheet around it. Shear, bending and the sides' rest lengths stay those of the deployed
cell: the end is the predicted shape, and the flat sheet of a graded pattern is at rest only nearly flat.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from design.deploy.compare import kabsch
from design.deploy.levels import Layout
from design.deploy.newton import System, smallest_eigenvalue_N_mm, solve
from design.deploy.shell import Ints, Reals, Shell, neighbours
from design.errors import NotConverged

TOLERANCE_RATIO = 1e-7  # of a step on the way; the last shape is solved to the usual one
HINT_RATIO = 0.01  # of the intended height
NUDGE_RATIO = 1e-3  # of an edge: an exactly flat sheet would not know to which side to buckle


@dataclass(frozen=True, slots=True)
class Wells:
    """The energy per flat area of an even stretch, `(m, k)` at `shares_ratio` `(k,)` of the way from flat to λ."""

    shares_ratio: Reals
    energy_mJ_mm2: Reals
    saddle_ratio: Reals  # (m,) the share at which each unit snaps


@dataclass(frozen=True, slots=True)
class Step:
    """One unit pulled open and let go."""

    unit: int
    held_mJ: float  # the sheet's own energy while the unit is pulled open
    rest_mJ: float  # after it, and what it freed, is let go
    stays: bool
    open_count: int  # units beyond their barrier afterwards
    opened: tuple[int, ...]  # others that snapped open along with it
    closed: tuple[int, ...]  # others that it let snap back


@dataclass(frozen=True, slots=True)
class Cascade:
    """The whole way: its steps, the shapes after some of them and which units are open at the end."""

    steps: tuple[Step, ...]
    frames_mm: tuple[Reals, ...]
    x_mm: Reals
    is_open: NDArray[np.bool_]
    energy_mJ: float
    residual_ratio: float
    stable: bool
    smallest_eigenvalue_N_mm: float  # of the last shape
    iterations_count: int  # to the last shape, once all hands are off
    failed: tuple[str, ...]  # units whose pull found no rest


def with_wells(shell: Shell, wells: Wells) -> Shell:
    """Return the shell whose units have two wells."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(wells.shares_ratio, wells.energy_mJ_mm2, axis=1)  # its coefficients are (4, k − 1, m)
    curves = np.ascontiguousarray(np.moveaxis(spline.c, (0, 1, 2), (2, 1, 0)))
    return replace(shell, well_shares_ratio=np.ascontiguousarray(wells.shares_ratio), wells_mJ_mm2=curves)


def share_of(shell: Shell, x_mm: Reals) -> Reals:
    """Return how far each unit is on the way from flat (0) to its expansion (1), `(m,)`."""
    a, b, c = (x_mm[shell.cells[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray((np.sqrt(area / shell.area_mm2) - 1) / (shell.expansion_ratio - 1))


def from_the_middle(layout: Layout) -> Ints:
    """Return the units in the order of their distance from the sheet's middle."""
    centre = layout.corners_mm.mean(axis=1)
    return np.argsort(np.linalg.norm(centre - centre.mean(axis=0), axis=1), kind="stable")


def cascade(
    layout: Layout,
    wells: Wells,
    order: Sequence[int] | Ints | None = None,
    hold: bool = True,
    intended_mm: Reals | None = None,
    frames_count: int = 24,
    watch: Callable[[float], None] | None = None,
) -> Cascade:
    """Return what happens when the units are pulled open one after the other, from flat; `order` names them.

    A unit that another one took along is not pulled again. With `hold` a unit is let go once all its neighbours have
    been pulled, without it at once; at the end every one is. `intended_mm` `(n, 3)` hints to which side the sheet is to
    bulge, by a hundredth of its height. A pull that finds no rest is named in `failed` and undone.
    """
    shell = with_wells(layout.shell(), wells)
    order = from_the_middle(layout) if order is None else np.asarray(order)
    x = _nearly_flat(layout, intended_mm)
    free, hand = System(shell), _Hand(neighbours(layout.cells), hold)
    is_open = np.zeros(len(layout.cells), dtype=bool)
    steps: list[Step] = []
    frames, failed, every = [x], [], max(1, len(order) // frames_count)
    for k, unit in enumerate(int(u) for u in order):
        hand.take(unit)
        if not is_open[unit]:
            try:
                x, step, is_open = _pulled(free, wells, unit, hand, x, is_open)
                steps.append(step)
            except NotConverged as fault:
                failed.append(f"unit {unit}: {fault}")
        if k % every == 0:
            frames.append(x)
        if watch is not None:
            watch((k + 1) / len(order))
    last = solve(free, x)
    return Cascade(
        tuple(steps), (*frames, last.x_mm), last.x_mm, share_of(shell, last.x_mm) > wells.saddle_ratio,
        last.energy_mJ, last.residual_ratio, last.stable, smallest_eigenvalue_N_mm(free, last.x_mm, (), None),
        last.iterations_count, tuple(failed),
    )  # fmt: skip


def _nearly_flat(layout: Layout, intended_mm: Reals | None) -> Reals:
    """Return the flat sheet with heights too small to matter: a hundredth of those intended, or none in particular."""
    flat = np.column_stack([layout.flat_mm(), np.zeros(layout.vertex_count)])
    if intended_mm is None:
        flat[:, 2] = NUDGE_RATIO * layout.edge_mm * np.random.default_rng(5).normal(size=len(flat))
        return flat
    rotation, _ = kabsch(intended_mm, flat)
    flat[:, 2] = HINT_RATIO * (intended_mm @ rotation.T)[:, 2]
    return flat


class _Hand:
    """Which units are pulled, and which of them are still held."""

    def __init__(self, across: Ints, hold: bool) -> None:
        self.across, self.hold = across, hold
        self.pulled = np.zeros(len(across), dtype=bool)

    def take(self, unit: int) -> None:
        self.pulled[unit] = True

    def held(self) -> Ints:
        """Return the units with a neighbour that is still to be pulled."""
        waiting = np.any((self.across >= 0) & ~self.pulled[self.across], axis=1)
        return np.flatnonzero(self.pulled & waiting & self.hold)


def _pulled(
    free: System, wells: Wells, unit: int, hand: _Hand, x: Reals, is_open: NDArray[np.bool_]
) -> tuple[Reals, Step, NDArray[np.bool_]]:
    """Return the sheet after one more unit was pulled open and those the hand is done with were let go."""
    kept = hand.held()
    pulled = solve(free.of(_held_open(free.shell, [unit, *kept])), x, tolerance_ratio=TOLERANCE_RATIO)
    rest = solve(free.of(_held_open(free.shell, kept)), pulled.x_mm, tolerance_ratio=TOLERANCE_RATIO)
    now = share_of(free.shell, rest.x_mm) > wells.saddle_ratio
    others = np.arange(len(now)) != unit
    opened, closed = (np.flatnonzero(c & others).tolist() for c in (now & ~is_open, ~now & is_open))
    before_mJ, after_mJ = free.energy(pulled.x_mm), free.energy(rest.x_mm)
    step = Step(unit, before_mJ, after_mJ, bool(now[unit]), int(now.sum()), tuple(opened), tuple(closed))
    return rest.x_mm, step, now


def _held_open(shell: Shell, units: Sequence[int] | Ints) -> Shell:
    """Return the shell with a parabola about the open state, as stiff as the open cell, in place of units' wells."""
    curves = shell.wells_mJ_mm2.copy()
    away = shell.well_shares_ratio[:-1] - 1.0
    stiff = shell.dilation_N_mm * (shell.expansion_ratio - 1) ** 2
    parabola = np.stack([0 * away, 0 * away + 0.5, away, 0.5 * away**2], axis=1)
    for unit in units:
        curves[unit] = stiff[unit] * parabola
    return replace(shell, wells_mJ_mm2=curves)


def cascade_csv(found: Cascade) -> str:
    """Return one row a pull, in their order; lists of units are parted by spaces."""
    rows = ["unit,held_mJ,rest_mJ,stays,open_count,opened,closed"]
    for step in found.steps:
        opened, closed = (" ".join(map(str, units)) for units in (step.opened, step.closed))
        rows.append(
            f"{step.unit},{step.held_mJ:.9g},{step.rest_mJ:.9g},{int(step.stays)},{step.open_count},{opened},{closed}"
        )
    return "\n".join(rows) + "\n"
