"""The hexagonal cell drawn out: where its material stands at rest, at the saddle and in the second stable state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import THIRD_TURN
from design.cells.homogenise import Failure, Pair, Trail, walked
from design.cells.mesh import REFERENCE, Density, topology
from design.cells.sector import Model
from design.cells.sheet import Sheet
from design.cells.tiling import tiling

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Drawn:
    """One state of the hexagonal cell around a corner."""

    name: str
    stretch_ratio: float
    triangles_mm: Array  # (n, 3, 2)


@dataclass(frozen=True, slots=True)
class CellStates:
    """The states of one cell, in the order of the stretch."""

    states: tuple[Drawn, ...]


def cell_states(t_mm: float, theta_rad: float, sheet: Sheet, density: Density = REFERENCE) -> CellStates | Failure:
    """Return the three states of the cell (t, θ), or why it has none."""
    found, _, _ = walked(t_mm, theta_rad, sheet, density, Trail())
    return found if isinstance(found, Failure) else states_of(*found)


def states_of(m: Model, pair: Pair) -> CellStates:
    """Return the states of a solved cell."""
    rows = [("flat", 1.0, m.rest_mm)]
    for name, state in (("saddle", pair.saddle), ("deployed", pair.stable)):
        rows.append((name, state.s_ratio, m.nodes(state.y, state.s_ratio)))
    return CellStates(tuple(Drawn(name, s, hexagon(m, nodes, s)) for name, s, nodes in rows))


def hexagon(m: Model, nodes_mm: Array, s_ratio: float) -> Array:
    """Return the triangles of six units around V0, (n, 3, 2) mm, for the sector standing as `nodes_mm`."""
    tile = tiling(m.density, 2)
    corners = nodes_mm[topology(m.density).triangles]
    two = [corners @ turn.T + s_ratio * m.edge_mm * move for turn, move in zip(tile.turns, tile.moves, strict=True)]
    pair = np.concatenate(two)  # an upright unit and its mirror image, both at V0
    turned = [pair, pair @ THIRD_TURN.T, pair @ THIRD_TURN]
    return np.concatenate(turned)
