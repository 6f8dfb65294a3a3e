"""A plane curve from its edge lengths and turning angles, closed with the least change of lengths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError
from design.surface import Indices, Points

Values = NDArray[np.float64]
Complex = NDArray[np.complex128]


def edge_lengths_mm(vertices_mm: Points, loop: Indices) -> Values:
    """Return the length of the edge that leaves each vertex of a loop."""
    points = vertices_mm[loop]
    return np.asarray(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))


def tangents(turning_rad: Values) -> Complex:
    """Return unit tangents of a loop's edges; edge i leaves vertex i, and the curve turns by `turning_rad[i]` there."""
    angle = np.concatenate([[0.0], np.cumsum(turning_rad[1:])])
    return np.exp(1j * angle)


def close(
    lengths_mm: Values, weights: Values, tangent: Complex, period_mm: complex = 0.0, twins: Indices | None = None
) -> Values:
    """Return the lengths nearest to `lengths_mm` with which the curve ends `period_mm` from where it began.

    The change is measured by Σ (change²/weight), so an edge yields in proportion to its weight (its original length).
    `twins[i]` is the edge that changes with edge i, as the two sides of a seam do (i itself where none does).
    """
    step = tangent if twins is None else (tangent + tangent[twins]) / 2
    T = np.stack([step.real, step.imag])
    gap = np.sum(lengths_mm * tangent) - period_mm
    change = weights * (T.T @ np.linalg.solve((T * weights) @ T.T, [gap.real, gap.imag]))
    closed = lengths_mm - change
    if (closed <= 0).any():
        count = int(np.count_nonzero(closed <= 0))
        raise FlattenError(f"the flat's rim cannot be closed: {count} of its edges would have no length")
    return np.asarray(closed)


def trace(lengths_mm: Values, tangent: Complex) -> Complex:
    """Return the curve's points, the first in the origin."""
    return np.concatenate([[0.0], np.cumsum(lengths_mm * tangent)[:-1]])
