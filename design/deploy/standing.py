"""What a sheet stands on while its expansions are chosen: weight, bed and friction as energies that Newton knows.

`supports.settle` lays a given sheet down step by step; here the sheet changes all the time and the bed does not: it is
made to the rim of the target, and friction holds each rim vertex to its place on the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells.sheet import Sheet
from design.deploy.indentation import CONTACT_RATIO, standing_rim
from design.deploy.levels import Layout
from design.deploy.newton import Load
from design.deploy.shell import Reals
from design.deploy.supports import NO_SLIP, Floor, Friction, Support, level_pins, weight_of


@dataclass(frozen=True, slots=True)
class Standing:
    """Loads on the sheet and what is held; `aligned` says whether the shape may be moved to be compared."""

    loads: tuple[Load, ...]
    fixed: NDArray[np.bool_] | None  # (n, 3); None: free
    aligned: bool


FREE = Standing((), None, True)


def standing(layout: Layout, goal_mm: Reals, sheet: Sheet, support: Support, friction_ratio: float = 0.5) -> Standing:
    """Return what holds a sheet that is meant to take the places `goal_mm` `(n, 3)` under its weight (along −z).

    `held`: the rim is clamped at its places on the target. Otherwise it stands on a bed made to the target's rim.
    `coulomb` lets each rim vertex slide beyond `friction_ratio` times an even share of the weight.
    """
    if support == "free":
        return FREE
    weight = weight_of(layout, sheet)
    rim = standing_rim(layout.cells, goal_mm)
    if support == "held":
        return Standing((weight,), np.repeat(rim[:, None], 3, axis=1), False)
    stiffness_N_mm = CONTACT_RATIO * float(np.median(layout.shell().dilation_N_mm))
    floor = Floor(np.where(rim, goal_mm[:, 2], goal_mm[:, 2].min()), stiffness_N_mm)
    if support == "slip":
        return Standing((weight, floor), level_pins(goal_mm), True)
    ratio = friction_ratio if support == "coulomb" else NO_SLIP
    limit_N = np.where(rim, ratio * float(weight.force_N.sum()) / int(rim.sum()), 0.0)
    friction = Friction(goal_mm[:, :2].copy(), limit_N, stiffness_N_mm)
    return Standing((weight, floor, friction), np.zeros(goal_mm.shape, dtype=bool), True)
