"""How much each cell must expand: the flat's area ratio averaged over the cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from design.errors import DesignError
from design.pattern.tiling import Array, Index, Tiling

Averaging = Literal["exact", "published"]
Which = Literal["high", "low", "middle", "value"]

PAIRS_AT_ONCE = 100_000  # cell-face overlaps clipped together: about 40 MB


@dataclass(frozen=True, slots=True)
class ScaleOptions:
    """Which end of the library's range the design takes.

    `high` gives the greatest expansion the library's most, `low` the least its least, `middle` leaves equal room (as a
    ratio) at both ends, `value` gives the greatest expansion `high_ratio`. The flat is scaled to match, so that the
    deployed size stays the target's.
    """

    end: Which = "high"
    high_ratio: float | None = None


def factor(low_ratio: float, high_ratio: float, limits_ratio: tuple[float, float], options: ScaleOptions) -> float:
    """Return what all expansions must be multiplied by; the flat is divided by it."""
    floor, ceiling = limits_ratio
    if options.end == "high":
        return ceiling / high_ratio
    if options.end == "low":
        return floor / low_ratio
    if options.end == "middle":
        return float(np.sqrt(floor * ceiling / (low_ratio * high_ratio)))
    if options.high_ratio is None:
        raise DesignError("scale.end is `value`, but no scale.high_ratio is given")
    return options.high_ratio / high_ratio


def averaged(tiling: Tiling, flat_mm: Array, faces: Index, area_ratio: Array, how: Averaging = "exact") -> Array:
    """Return each cell's expansion `(k,)`: the root of its faces' mean area ratio, deployed over flat, `(m,)`."""
    return _exact(tiling, flat_mm, faces, area_ratio) if how == "exact" else _kernel(tiling, flat_mm, faces, area_ratio)


def _kernel(tiling: Tiling, flat_mm: Array, faces: Index, area_ratio: Array) -> Array:
    """Average as published: faces whose centroid is within half an edge, weighted by 1 − d/(l0/2)."""
    from scipy.spatial import cKDTree

    reach = tiling.edge_mm / 2
    count = len(tiling.cells)
    cells, middles = cKDTree(tiling.centres_mm()), cKDTree(flat_mm[faces].mean(axis=1))
    near = np.asarray(cells.sparse_distance_matrix(middles, reach, output_type="ndarray"))
    cell, face, weight = near["i"], near["j"], 1 - near["v"] / reach
    lonely = count - len(np.unique(cell))
    if lonely:
        raise DesignError(
            f"{lonely} cells have no mesh face within half an edge ({reach:g} mm); "
            "the published averaging needs a finer mesh, averaging `exact` does not"
        )
    total = np.bincount(cell, weight * area_ratio[face], count)
    return np.asarray(np.sqrt(total / np.bincount(cell, weight, count)))


def _exact(tiling: Tiling, flat_mm: Array, faces: Index, area_ratio: Array) -> Array:
    corners = tiling.vertices_mm[tiling.cells]
    cell, area_mm2, face = overlaps(corners, flat_mm[faces])
    total = np.bincount(cell, area_mm2 * area_ratio[face], len(corners))
    weight = np.bincount(cell, area_mm2, len(corners))
    if (weight <= 0).any():
        raise DesignError(f"{int((weight <= 0).sum())} cells lie off the flat, so they have no expansion")
    return np.asarray(np.sqrt(total / weight))


def overlaps(cells_mm: Array, triangles_mm: Array) -> tuple[Index, Array, Index]:
    """Return (cell, shared area, triangle) of every pair that overlaps; both inputs `(…, 3, 2)`."""
    tree = shapely.STRtree(np.asarray(shapely.polygons(triangles_mm)))
    cell, triangle = tree.query(np.asarray(shapely.polygons(cells_mm)))
    area = np.empty(len(cell))
    for start in range(0, len(cell), PAIRS_AT_ONCE):
        part = slice(start, start + PAIRS_AT_ONCE)
        area[part] = shared_area_mm2(cells_mm[cell[part]], triangles_mm[triangle[part]])
    some = area > 0
    return cell[some], area[some], triangle[some]


def shared_area_mm2(a_mm: Array, b_mm: Array) -> Array:
    """Return the area that each triangle of `a_mm` `(p, 3, 2)` shares with its partner in `b_mm`, `(p,)`.

    The curve around `b` is pushed onto each of the three half-planes of `a` in turn: points outside move
    perpendicularly to the line. The push leaves the winding number about every point inside as it was, and what is
    outside collapses to nothing, so the area the pushed curve encloses is the area of the overlap.
    """
    a, b = _counter_clockwise(a_mm), _counter_clockwise(b_mm)
    for k in range(3):
        start = a[:, k][:, None]
        along = a[:, (k + 1) % 3] - a[:, k]
        along = (along / np.linalg.norm(along, axis=1)[:, None])[:, None]
        inward = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        b = _pushed(b, start, inward)
    x, y = (b - a[:, :1]).transpose(2, 0, 1)
    doubled = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    return np.asarray(np.maximum(0.0, doubled / 2))


def _pushed(curve: Array, start: Array, inward: Array) -> Array:
    """Return closed curves `(p, n, 2)` pushed onto a half-plane each, `(p, 2n, 2)`: corners and crossings."""
    depth = ((curve - start) * inward).sum(axis=-1)
    after = np.roll(depth, -1, axis=1)
    crosses = depth * after < 0
    share = np.where(crosses, depth / np.where(crosses, depth - after, 1.0), 0.0)
    crossing = curve + share[..., None] * (np.roll(curve, -1, axis=1) - curve)
    pushed = curve - np.minimum(depth, 0.0)[..., None] * inward
    crossing = np.where(crosses[..., None], crossing, pushed)
    return np.stack([pushed, crossing], axis=2).reshape(len(curve), -1, 2)


def _counter_clockwise(triangles_mm: Array) -> Array:
    u, v = triangles_mm[:, 1] - triangles_mm[:, 0], triangles_mm[:, 2] - triangles_mm[:, 0]
    clockwise: NDArray[np.bool_] = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0
    return np.where(clockwise[:, None, None], triangles_mm[:, ::-1], triangles_mm)
