"""Contracting cells for a design: the open library per flat edge, and the outlines of their holes.

A contracting cell is cut as the deployed outline of a slit cell (t, θ) whose own edge is the lattice's over its
expansion λ₀, so that all cut units have the lattice's edge. `t_mm` names the slit cell scaled to the lattice's edge;
energies and moduli here are those of the unit as it is cut.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import turned
from design.cells.homogenise import Failure, Pair, solve_pair
from design.cells.interpolate import grid_of
from design.cells.library import SHIPPED_OPEN, CellLibrary, LibraryError, load_library
from design.cells.mesh import REFERENCE, topology
from design.cells.open_cells import outline_nodes
from design.cells.sector import Model
from design.cells.sheet import Sheet
from design.errors import DesignError

Array = NDArray[np.float64]
SAME_RATIO = 2e-4  # of the edge, and rad: cells nearer than this share an outline, a fiftieth of the kerf off at most
ENERGIES = ("barrier_mm2", "stored_mm2", "stiffness_mm2")


@functools.lru_cache(maxsize=4)
def load_contracting(path: Path | None = None) -> CellLibrary:
    """Return the library of contracting cells, the shipped one without a `path`, for units cut with the edge given."""
    library = load_library(SHIPPED_OPEN if path is None else path)
    if "open_ratio" not in library.table:
        raise LibraryError(f"{path}: has no contracting cells; build one with `fabctl library build --open`")
    opened = library.table["open_ratio"] ** 2
    table = {name: values / opened if name in ENERGIES else values for name, values in library.table.items()}
    return CellLibrary.of_table(table, library.meta, library.hash, library.sheet)


def is_contracting(library: CellLibrary) -> bool:
    """Say whether a library's cells are cut open and close."""
    return "open_ratio" in library.table


def at_cells(library: CellLibrary, name: str, t_mm: Array, theta_rad: Array) -> Array:
    """Return one column of the library's table interpolated at cells `(k,)`; the nearest cell's at the rim."""
    grid = grid_of(library.table["t_mm"], library.table["theta_rad"], library.table[name][None], library.sheet)
    found = grid(np.asarray(t_mm, dtype=float), np.asarray(theta_rad, dtype=float))[0]
    missing = ~np.isfinite(found)
    if missing.any():
        from scipy.spatial import cKDTree

        edge, good = library.sheet.edge_mm, np.isfinite(library.table[name])
        tree = cKDTree(np.column_stack([library.table["t_mm"], edge * library.table["theta_rad"]])[good])
        asked = np.column_stack([t_mm, edge * np.asarray(theta_rad)])[missing]
        found[missing] = library.table[name][good][tree.query(asked)[1]]
    return np.asarray(found)


@dataclass(frozen=True, slots=True)
class Opening:
    """Half a hole: its border in one unit, for an edge of one, from the edge V0V2 and back to it.

    The first point lies near V0, the last near V2; between `tip` and `foot` is the hinge's end of the hole.
    """

    border: Array  # (n, 2)
    tip: int  # index where the first arm's side ends
    foot: int  # index where the last arm's side begins


def openings(t_mm: Array, theta_rad: Array, sheet: Sheet) -> list[Opening]:
    """Return the opening of every cell `(k,)`, as finite elements find the slit cell deployed.

    Raises `DesignError` where a cell has no second state.
    """
    step = np.array([SAME_RATIO * sheet.edge_mm, SAME_RATIO])
    keys = np.rint(np.column_stack([t_mm, theta_rad]) / step).astype(np.int64)
    cells, which = np.unique(keys, axis=0, return_inverse=True)
    order = np.lexsort((cells[:, 1], cells[:, 0]))  # by t, so that each starts from its neighbour
    solved: dict[int, Opening] = {}
    guess: Pair | None = None
    for k in order.tolist():
        t, theta = (cells[k] * step).tolist()
        found = solve_pair(t, theta, sheet, REFERENCE, guess)
        if isinstance(found, Failure):
            raise DesignError(f"the cell t = {t:.3f} mm, θ = {np.degrees(theta):.2f}° does not open: {found.reason}")
        guess = found[1]
        solved[k] = opening_of(*found)
    return [solved[k] for k in which.ravel().tolist()]


def opening_of(m: Model, pair: Pair) -> Opening:
    """Return the opening of a solved slit cell."""
    stable, top = pair.stable, topology(m.density)
    nodes = m.nodes(stable.y, stable.s_ratio) / (m.edge_mm * stable.s_ratio)
    ring = outline_nodes(m.density).tolist()  # from the corner, counter-clockwise
    at = {node: k for k, node in enumerate(ring)}
    bottom, cut_turned = at[int(top.bottom[-1])], at[int(top.cut_turned[-1])]
    cut, left = at[int(top.cut[-1])], at[int(top.left[-1])]
    centre = np.array([0.5, 12**-0.5])
    mine = nodes[ring[cut : left + 1]][::-1]  # the outer and inner line of slit 1
    other = nodes[ring[bottom : cut_turned + 1]][::-1]
    for _ in range(2):  # of the sector at V2
        other = turned(other, centre)
    mouth = int(top.layers[len(m.density.inner) + m.density.along - 1][0])  # the arm's first layer starts at the tip
    foot = int(top.layers[len(m.density.inner) + m.density.along - 1][m.density.inner[0]])
    tip_at = left - at[mouth]
    foot_at = len(mine) - 1 + cut_turned - at[foot]
    return Opening(np.vstack([mine, other[1:]]), tip_at, foot_at)
