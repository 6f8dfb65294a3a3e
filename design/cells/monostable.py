"""Cells with slits that do not stay open: their energy has one minimum, so that they spring back to flat."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from design.cells.library import VERDICTS, CellLibrary
from design.errors import DesignError

Array = NDArray[np.float64]
ROUNDING_RATIO = 1e-6  # of the edge: the table's steps are 1e-3
MARGIN_RATIO = 0.02  # of the edge, beyond the greatest bistable t: away from the fold, where the mesh could decide


def monostable_cells(library: CellLibrary, theta_rad: Array) -> tuple[Array, Array]:
    """Return (t_mm, theta_rad), `(k,)` each, of simulated cells that were found not bistable.

    Of the library's column nearest to each angle, the first cell at least `MARGIN_RATIO` edges past the greatest
    bistable t, so that it is as stretchable as such a cell can be. Raises `DesignError` where no column has one.
    """
    table, margin_mm = library.table, (MARGIN_RATIO - ROUNDING_RATIO) * library.sheet.edge_mm
    bistable = table["verdict"] == VERDICTS.index("bistable")
    not_bistable = table["verdict"] == VERDICTS.index("not bistable")
    columns = np.unique(table["theta_rad"])
    angles, offsets = [], []
    for angle in columns.tolist():
        here = table["theta_rad"] == angle
        if not (here & bistable).any():
            continue
        edge_mm = table["t_mm"][here & bistable].max()
        past_mm = table["t_mm"][here & not_bistable & (table["t_mm"] >= edge_mm + margin_mm)]
        if len(past_mm):
            angles.append(angle)
            offsets.append(float(past_mm.min()))
    if not angles:
        raise DesignError("the library has no cell past its bistable ones, so none is known to spring back")
    nearest = np.abs(np.asarray(theta_rad)[:, None] - np.array(angles)).argmin(axis=1)
    return np.array(offsets)[nearest], np.array(angles)[nearest]
