"""The contracting kind (paper, section 5): cut in the open state, stress-free there, and closed to its second state.

The rest shape is the deployed outline of the slit cell (t, θ); its cuts are holes. Its own edge is the slit cell's edge
times that expansion λ₀; stretched by s < 1 it finds a second minimum near s = 1/λ₀, where the holes have closed. The
solver knows no contact: how much of the cell would lie on top of itself is reported, and where it does the state is
the frictionless, interpenetrating one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import THIRD_TURN, centroid_mm
from design.cells.homogenise import (
    FINER,
    Cell,
    Failure,
    Found,
    Pair,
    Trail,
    cell_of,
    follow,
    is_shallow,
    solve_pair,
    walked,
)
from design.cells.mesh import REFERENCE, Density, topology
from design.cells.sector import Model, model_of
from design.cells.sheet import Sheet

Array = NDArray[np.float64]

ROUNDING_FRAC = 1e-9  # of an area computed twice
CLOSED_SHARE = 0.94  # of 1/λ₀: the path is followed a little past the fully closed cell


def holes_mm(m: Model, nodes_mm: Array, s_ratio: float) -> Array:
    """Return the outlines of one unit's three sectors as they stand, (3, n, 2) mm: cut along them, the rest is hole."""
    ring = nodes_mm[outline_nodes(m.density)]
    centre = s_ratio * centroid_mm(m.edge_mm)
    rings = [ring]
    for _ in range(2):
        rings.append((rings[-1] - centre) @ THIRD_TURN.T + centre)
    return np.array(rings)


def outline_nodes(density: Density) -> NDArray[np.int64]:
    """Return the vertices and midpoints around the sector, in order."""
    top = topology(density)
    middle = {tuple(sorted(pair)): k + top.vertex_count for k, pair in enumerate(top.edges.tolist())}
    directed = {(int(a), int(b)) for tri in top.triangles for a, b in zip(tri, np.roll(tri, -1), strict=True)}
    follows = {a: b for a, b in directed if (b, a) not in directed}
    nodes, at = [], top.corner
    while True:
        to = follows[at]
        pair = sorted((at, to))
        nodes += [at, middle[pair[0], pair[1]]]
        at = to
        if at == top.corner:
            return np.array(nodes)


def open_model(closed: Model, pair: Pair, sheet: Sheet) -> Model:
    """Return the sector that is stress-free where the slit cell's second state stands."""
    stable = pair.stable
    rest = closed.nodes(stable.y, stable.s_ratio)
    return model_of(rest, replace(sheet, edge_mm=sheet.edge_mm * stable.s_ratio), closed.density)


def solve_open_cell(
    t_mm: float, theta_rad: float, sheet: Sheet, density: Density = REFERENCE, trail: Trail | None = None
) -> tuple[Cell, Trail]:
    """Return the open cell of (t, θ), expansion below one, and the slit cells' states for a neighbour to start from.

    Where the slit cell's well is shallow, or the open cell's own, half the mesh size decides.
    """
    slit, mesh_ratio, after = walked(t_mm, theta_rad, sheet, density, trail or Trail())
    found = _closed(slit, sheet)
    if mesh_ratio == 1 and not isinstance(found, Failure) and is_shallow(found[1]):
        slit, mesh_ratio = solve_pair(t_mm, theta_rad, sheet, density.refined(FINER)), 1 / FINER
        found = _closed(slit, sheet)
    cell = cell_of(t_mm, theta_rad, found, mesh_ratio)
    if isinstance(slit, Failure) or isinstance(found, Failure):
        return cell, after
    m, stable = found[0], found[1].stable
    overlap = overlap_frac(m, m.nodes(stable.y, stable.s_ratio), stable.s_ratio)
    return replace(cell, open_ratio=slit[1].stable.s_ratio, overlap_frac=overlap), after


def _closed(slit: Found, sheet: Sheet) -> Found:
    """Return the open cell that a slit cell is cut as, with its two states."""
    if isinstance(slit, Failure):
        return Failure(slit.verdict, f"as a slit cell: {slit.reason}", slit.residual_ratio)
    m = open_model(*slit, sheet)
    if m.weights.min() <= 0:
        return Failure("invalid", "the deployed outline folds the mesh")
    pair = follow(m, CLOSED_SHARE / slit[1].stable.s_ratio)
    return pair if isinstance(pair, Failure) else (m, pair)


def overlap_frac(m: Model, nodes_mm: Array, s_ratio: float) -> float:
    """Return the share of a unit's material that lies on other material or across the mirror edges, as it stands."""
    from shapely import Polygon, unary_union

    rings = [Polygon(ring).buffer(0) for ring in holes_mm(m, nodes_mm, s_ratio)]
    edge = s_ratio * m.edge_mm
    unit = Polygon([(0, 0), (edge, 0), (edge / 2, edge * 0.75**0.5)])
    material = sum(ring.area for ring in rings)
    share = 1 - float(unary_union(rings).intersection(unit).area) / material
    return share if share > ROUNDING_FRAC else 0.0
