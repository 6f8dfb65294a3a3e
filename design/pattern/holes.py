"""Contracting cells to hole polygons: the deployed outlines of slit cells, stress-free as they are cut.

A hole reaches across the edge of two cells. Where they differ, its two points on the edge are the mean of theirs, by
topology, and each side of the hole bends from there to its hinge, which stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from design.cells.contracting import Opening
from design.pattern.cuts import HalfHole, Inside
from design.pattern.paths import CutPath
from design.pattern.tiling import Array, Tiling

SIMPLE_MM = 2e-3  # points nearer than this to the line between others are left out: a sixtieth of the kerf


@dataclass(frozen=True, slots=True)
class Holes:
    """Half a hole for every slot of every cell, `halves_mm[3 cell + slot]` (n, 2): from the edge, and back to it."""

    halves_mm: tuple[Array, ...]

    def inside(self, tiling: Tiling, cut: NDArray[np.bool_]) -> Inside:
        """Return one closed path per edge of two cut cells, and a half hole where only one is."""
        found = Inside([], [])
        begun: dict[int, int] = {}
        edges = drawn_edges(tiling)
        both = np.bincount(edges.ravel(), np.repeat(cut, 3))[edges.ravel()] > 1
        for slot in np.flatnonzero(np.repeat(cut, 3)).tolist():
            half, edge = self.halves_mm[slot], int(edges.flat[slot])
            if not both[slot]:
                found.halves.append(HalfHole(_simple(half), slot // 3))
            elif edge not in begun:
                begun[edge] = slot
            else:
                ring = np.vstack([self.halves_mm[begun[edge]], half[-2:0:-1]])
                found.paths.append(CutPath("hole", _clockwise(ring), closed=True, cell=begun[edge] // 3))
        return found

    def free_mm(self, tiling: Tiling) -> Array:
        """Return how far around its centroid each cell is uncut, `(k,)`."""
        lines = np.array([shapely.LineString(half) for half in self.halves_mm])
        at = shapely.points(np.repeat(tiling.centres_mm(), 3, axis=0))
        return np.asarray(shapely.distance(lines, at).reshape(-1, 3).min(axis=1))


def drawn_edges(tiling: Tiling) -> NDArray[np.int64]:
    """Return the edge that each slot's hole lies on, `(k, 3)`, the two sides of a seam being two edges."""
    ends = np.sort(np.stack([tiling.cells, np.roll(tiling.cells, 1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    return np.asarray(np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1, 3))


def holes_of(tiling: Tiling, opened: Sequence[Opening], cut: NDArray[np.bool_]) -> Holes:
    """Return the half holes of every cell, matched along the edges of two cut cells."""
    near = np.array([np.linalg.norm(one.border[0]) for one in opened])  # from the corner the slot belongs to
    far = np.array([np.linalg.norm(one.border[-1]) for one in opened])
    near_mean, far_mean = _means(tiling, near, cut), _means(tiling, far, cut)
    corners = tiling.vertices_mm[tiling.cells]
    halves = []
    for k, one in enumerate(opened):
        for slot in range(3):
            border = _bent(one, near_mean[k, slot] - near[k], far_mean[k, slot] - far[k])
            halves.append(_placed(border, np.roll(corners[k], -slot, axis=0)))
    return Holes(tuple(halves))


def _means(tiling: Tiling, value: Array, cut: NDArray[np.bool_]) -> Array:
    """Return each slot's value `(k, 3)`, that of two cut cells on one edge being their mean."""
    _, which = tiling.edges()
    edge, weight = which.ravel(), np.repeat(cut.astype(np.float64), 3)
    total = np.bincount(edge, weight * np.repeat(value, 3))
    return np.asarray((total / np.maximum(1.0, np.bincount(edge, weight)))[which])


def _bent(one: Opening, near_by: float, far_by: float) -> Array:
    """Return the border with its ends moved along the edge; each side follows in proportion, hinges stay."""
    border = one.border.copy()
    along = np.array([0.5, 0.75**0.5])
    first, last = border[: one.tip + 1], border[one.foot :]
    border[: one.tip + 1] += near_by * np.outer(1 - _shares(first), along)
    border[one.foot :] += far_by * np.outer(_shares(last), along)
    return border


def _shares(line: Array) -> Array:
    """Return how far along a polyline each of its points lies, 0 to 1."""
    run = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    return np.asarray(run / run[-1])


def _placed(border: Array, corners_mm: Array) -> Array:
    """Return points of the unit triangle in the cell whose corners `(3, 2)` stand for V0, V1, V2."""
    up = border[:, 1] / 0.75**0.5
    right = border[:, 0] - up / 2
    return np.asarray(np.column_stack([1 - right - up, right, up]) @ corners_mm)


def _simple(ring: Array) -> Array:
    return np.asarray(shapely.LineString(ring).simplify(SIMPLE_MM).coords)


def _clockwise(ring: Array) -> Array:
    """Return a closed ring without needless points, clockwise as openings run."""
    points = _simple(np.vstack([ring, ring[:1]]))[:-1]
    x, y = points.T
    return points if float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) < 0 else points[::-1]
