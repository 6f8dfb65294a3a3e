"""The shape a cut sheet takes when its units have snapped: from flat, or from a shape near it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from design.deploy.levels import Layout, levels, prolong
from design.deploy.newton import TOLERANCE_RATIO, Equilibrium, Load, System, fold_angles, solve
from design.deploy.shell import Reals

Watch = Callable[[Layout, int, Reals, float], None]
COARSE_TOLERANCE_RATIO = 1e-5  # a start for the next level, not a result
COARSEST_STIFFENINGS = (1000.0, 100.0, 10.0, 1.0)  # of the bending stiffness, one after the other
FINER_STIFFENINGS = (10.0, 1.0)
REMEMBERED_STIFFENING = 100.0  # so stiff that the sheet does not buckle by itself


def pushed_flat(layout: Layout, side: Reals | float = 0.3) -> Reals:
    """Return the sheet swollen by its mean expansion and bulged a little, `(n, 3)`: something to start from.

    `side` is about ±0.3 for the whole sheet, or one number per unit `(m,)` that hints where it should bulge to.
    """
    flat = layout.flat_mm()
    mean = float(np.mean(layout.expansion_ratio))
    centred = mean * (flat - flat.mean(axis=0))
    size = float(np.ptp(centred, axis=0).max())
    if np.ndim(side) == 0:
        height = float(side) * 0.1 * size * (1 - np.sum((2 * centred / size) ** 2, axis=1))
    else:
        hint = np.bincount(layout.cells.ravel(), np.repeat(np.asarray(side, float), 3))
        height = 0.1 * size * hint / np.bincount(layout.cells.ravel())
    return np.column_stack([centred, height])


def rolled(layout: Layout, axis: int = 1, outward: float = 1.0) -> Reals:
    """Return a sheet with a re-joined seam rolled to a cylinder, `(n, 3)`; `axis` is the flat axis along the cylinder.

    The seam's period is measured from vertices that lie at two flat places.
    """
    across = 1 - axis
    spread = np.full(layout.vertex_count, -np.inf), np.full(layout.vertex_count, np.inf)
    np.maximum.at(spread[0], layout.cells.ravel(), layout.corners_mm[..., across].ravel())
    np.minimum.at(spread[1], layout.cells.ravel(), layout.corners_mm[..., across].ravel())
    period = float(np.max(spread[0] - spread[1]))
    if period < 2 * layout.edge_mm:
        raise ValueError("the sheet has no re-joined seam to roll it around")
    flat = layout.flat_mm()
    mean = float(np.mean(layout.expansion_ratio))
    angle = 2 * np.pi * flat[:, across] / period * (1 if axis == 1 else -1)
    radius = mean * period / (2 * np.pi)
    return np.column_stack([radius * np.sin(angle), -outward * radius * np.cos(angle), mean * flat[:, axis]])


def from_flat(
    layout: Layout,
    start: Callable[[Layout], Reals] = pushed_flat,
    watch: Watch | None = None,
) -> Equilibrium:
    """Return the free equilibrium reached from flat; `start` makes the coarsest sheet's first shape.

    Coarse units first, each level with its bending stiffness raised and then let down: a stiff sheet has one way to
    bulge, a limp one thousands. Raises `NotConverged` where the finest level does not come to rest;
    `iterations_count` sums over all levels.
    """
    chain = levels(layout)
    x = start(chain[0])
    iterations = 0
    for k, level in enumerate(chain):
        bulge, system = x if k == 0 else None, System(level.shell())
        for stiffening in COARSEST_STIFFENINGS if k == 0 else FINER_STIFFENINGS:
            exactly = k == len(chain) - 1 and stiffening == 1
            found = _solve_stiffened(system, level, x, stiffening, bulge, exactly, watch)
            iterations += found.iterations_count
            x = found.x_mm
        if k < len(chain) - 1:
            x = prolong(level, x, chain[k + 1])
    return replace(found, iterations_count=iterations)


def _solve_stiffened(
    system: System, layout: Layout, x_mm: Reals, stiffening: float, bulge_mm: Reals | None, exactly: bool,
    watch: Watch | None,
) -> Equilibrium:  # fmt: skip
    """Return the equilibrium with bending `stiffening` times as stiff as the layout's; `system` lends its pattern.

    While it is far stiffer than it should be, the folds of `bulge_mm` are its rest: a sheet too stiff to buckle would
    otherwise forget to which side it was pushed.
    """
    shell = replace(layout, D_mJ=layout.D_mJ * stiffening).shell()
    if bulge_mm is not None and stiffening >= REMEMBERED_STIFFENING:
        shell = replace(shell, rest_angle_rad=fold_angles(bulge_mm, shell.hinges))
    tolerance = TOLERANCE_RATIO if exactly else COARSE_TOLERANCE_RATIO
    return solve(system.of(shell), x_mm, tolerance_ratio=tolerance, watch=_seer(layout, watch))


def _seer(layout: Layout, watch: Watch | None) -> Callable[[int, Reals, float], None] | None:
    if watch is None:
        return None
    return lambda iteration, x, residual: watch(layout, iteration, x, residual)


def solve_level(
    layout: Layout,
    x_mm: Reals,
    loads: Sequence[Load] = (),
    fixed: NDArray[np.bool_] | None = None,
    exactly: bool = True,
    watch: Watch | None = None,
) -> Equilibrium:
    """Return the equilibrium of one sheet from the shape `x_mm`."""
    tolerance = TOLERANCE_RATIO if exactly else COARSE_TOLERANCE_RATIO
    return solve(System(layout.shell()), x_mm, loads, fixed, tolerance, watch=_seer(layout, watch))
