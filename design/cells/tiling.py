"""How copies of one sector, turned and mirrored, make a periodic cell of two, six or more units."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import EDGE_DIRECTION, THIRD_TURN, centroid_mm, sector
from design.cells.mesh import Density, nodes_mm, topology, vertices_mm
from design.cells.sheet import Sheet

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MIRROR = np.diag([1.0, -1.0])
WELD_RATIO = 1e-7  # of the edge: nodes of two copies nearer than this are one
STEPS = np.array([[1.0, 0.0], EDGE_DIRECTION])  # the two lattice vectors of the tiling, for an edge of one


@dataclass(frozen=True, slots=True)
class Tiling:
    """Copies of a sector and how their nodes coincide. Copy c puts local node n at turns[c] @ X[n] + edge·moves[c]."""

    turns: Array  # (c, 2, 2), orthogonal
    moves: Array  # (c, 2), for an edge of one
    owner: Ints  # (c, n): number of the node in the cell, equal for nodes that are periodic images
    jump: Array  # (c, n, 2): lattice vector, for an edge of one, from that node to this image
    count: int  # nodes in the cell
    lattice: Array  # (2, 2) rows are the periods, for an edge of one

    @property
    def units_count(self) -> int:
        """Return the number of unit triangles."""
        return len(self.turns) // 3


def _units(cells: int) -> tuple[list[tuple[bool, Array]], Array]:
    """Return (mirrored, shift) of each unit and the periods: 2 the primitive cell, 6 the hexagon, 8 the 2 × 2 cell."""
    a, b = STEPS
    up_down = [(False, np.zeros(2)), (True, np.zeros(2))]
    if cells == 2:
        return up_down, STEPS
    if cells == 6:  # three primitive cells; their union repeats like the hexagon around a corner
        return [(m, k * a) for k in range(3) for m, _ in up_down], np.array([a + b, 2 * b - a])
    if cells == 8:
        return [(m, i * a + j * b) for i in range(2) for j in range(2) for m, _ in up_down], 2 * STEPS
    raise ValueError(f"no periodic cell of {cells} units; 2, 6 and 8 are known")


@functools.lru_cache(maxsize=8)
def tiling(density: Density, units: int = 2) -> Tiling:
    """Return the periodic cell of `units` units; found once on a sample cell, as the topology is the same for all."""
    sheet = Sheet(edge_mm=1.0, slit_mm=0.0125, hinge_mm=0.025)
    local = nodes_mm(vertices_mm(sector(0.13, 0.07, sheet), density), density)
    parts, lattice = _units(units)
    centre = centroid_mm(1.0)
    turns, moves = [], []
    for mirrored, shift in parts:
        turn = np.eye(2)
        for _ in range(3):
            flip = MIRROR if mirrored else np.eye(2)
            turns.append(flip @ turn)
            moves.append(flip @ (centre - turn @ centre) + shift)
            turn = THIRD_TURN @ turn
    points = np.einsum("cij,nj->cni", np.array(turns), local) + np.array(moves)[:, None]
    owner, jump, count = _weld(points, lattice)
    return Tiling(np.array(turns), np.array(moves), owner, jump, count, lattice)


def _weld(points: Array, lattice: Array) -> tuple[Ints, Array, int]:
    """Return owner, jump and count for the copies' nodes (c, n, 2) on a torus."""
    flat = points.reshape(-1, 2)
    share = flat @ np.linalg.inv(lattice)
    base = np.floor(share + WELD_RATIO * 10)
    inside = (share - base) @ lattice
    from scipy.spatial import cKDTree

    owner = np.full(len(flat), -1)
    count = 0
    pairs = cKDTree(inside).query_ball_point(inside, WELD_RATIO)
    for node, near in enumerate(pairs):
        if owner[node] < 0:
            owner[near] = count
            count += 1
    first = np.zeros(count, dtype=np.int64)
    first[owner[::-1]] = np.arange(len(flat))[::-1]
    jump = (base - base[first[owner]]) @ lattice
    return owner.reshape(points.shape[:2]), jump.reshape(points.shape), count


@functools.lru_cache(maxsize=8)
def border_nodes(density: Density) -> Ints:
    """Return the sector's nodes that a neighbouring copy shares."""
    top = topology(density)
    return np.unique(np.concatenate([[top.centre, top.corner], top.bottom, top.left, top.cut, top.cut_turned]))
