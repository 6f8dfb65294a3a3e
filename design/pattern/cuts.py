"""What the cells of a tiling are cut with: slits that open, or holes that close."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from design.pattern.paths import CutPath
from design.pattern.tiling import Array, Tiling

BEYOND_MM = 0.01  # a half hole is cut this far across its edge, so that no rounding leaves a film there


@dataclass(frozen=True, slots=True)
class HalfHole:
    """The part of a hole in one cell whose neighbour has none: its first and last point lie on their edge."""

    ring_mm: Array  # (n, 2)
    cell: int

    def middle_mm(self) -> Array:
        """Return the middle of its mouth."""
        return np.asarray((self.ring_mm[0] + self.ring_mm[-1]) / 2)

    def notch(self) -> BaseGeometry:
        """Return its area and a little beyond the edge."""
        along = self.ring_mm[-1] - self.ring_mm[0]
        out = BEYOND_MM * np.array([-along[1], along[0]]) / np.linalg.norm(along)
        if (self.ring_mm.mean(axis=0) - self.ring_mm[0]) @ out > 0:
            out = -out
        return shapely.Polygon(np.vstack([self.ring_mm, self.ring_mm[-1] + out, self.ring_mm[0] + out])).buffer(0)


@dataclass(frozen=True, slots=True)
class Inside:
    """The cuts of some cells: whole paths, and half holes, which may lie on the border."""

    paths: list[CutPath]
    halves: list[HalfHole]


class Cuts(Protocol):
    """The cuts of all cells of a tiling."""

    def inside(self, tiling: Tiling, cut: NDArray[np.bool_]) -> Inside:
        """Return the cuts of the cells in `cut` `(k,)`; every other cell is solid, or not on this sheet."""
        ...

    def free_mm(self, tiling: Tiling) -> Array:
        """Return how far around its centroid each cell is uncut, `(k,)`; it may reach beyond the cell."""
        ...


def notched(piece: BaseGeometry, halves: Sequence[HalfHole]) -> tuple[BaseGeometry, list[CutPath]]:
    """Return the piece with the half holes on its border taken out, and those inside it as closed paths."""
    if not halves:
        return piece, []
    inner = piece.buffer(-2 * BEYOND_MM)
    shapely.prepare(inner)
    closed = [half for half in halves if inner.contains(shapely.Point(half.middle_mm()))]
    paths = [CutPath("hole", half.ring_mm, closed=True, cell=half.cell) for half in closed]
    kept = {id(half) for half in closed}
    open_ones = [half.notch() for half in halves if id(half) not in kept]
    left = piece.difference(shapely.union_all(open_ones)) if open_ones else piece
    return left, paths
