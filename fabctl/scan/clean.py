"""What in a cloud is the specimen: the table, the background and stray points are told apart and counted.

The cloud has no scale yet, so every length here is in the cloud's own units and every threshold comes from the cloud.
Where two parts of it might be the specimen both are offered, likeliest first; the registration decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from design.findings import Finding
from fabctl.errors import RefusedError
from fabctl.scan.foreign import nearest

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

FINE = 300  # cells along the diagonal of the robust box at first
LEAST_PER_CELL = 1.7  # points a cell should hold, so that a neighbourhood says something about density
LINE_RATIO = 1e-6  # of the length: thinner than the digits of any file
SPARSE_RATIO = 0.12  # a cell with less than this part of the usual neighbourhood is stray
JOIN_CELLS = 2.6  # cells nearer than this belong together
TABLE_LEAST_FRAC = 0.12  # of all cells; smaller planes are not called a table
PLANE_TRIES = 400


@dataclass(frozen=True, slots=True)
class Plane:
    """The table: `normal @ x = offset`, the specimen on the side of the normal; lengths in cloud units."""

    normal: Floats  # (3,)
    offset_cu: float
    spread_cu: float  # standard deviation of its points about it

    def height(self, points: Floats) -> Floats:
        """Return how far each point is above the plane."""
        return np.asarray(points @ self.normal - self.offset_cu)


@dataclass(frozen=True, slots=True)
class Cells:
    """The cloud in cubes: one row for every cube that holds a point."""

    size_cu: float
    of_point: Ints  # (n,), the cell of every point; -1 outside the robust box
    centre: Floats  # (m, 3), mean of the cell's points
    count: Ints  # (m,)
    around: Ints  # (m,), points in the cell and its 26 neighbours


@dataclass(frozen=True, slots=True)
class Part:
    """A set of cells that may be the specimen."""

    name: str
    cells: Mask  # (m,)


@dataclass(frozen=True, slots=True)
class Cleaned:
    """What each cell of the cloud is taken for, and the parts that may be the specimen."""

    cells: Cells
    table: Plane | None
    table_top_cu: float  # what is lower is called table
    is_table: Mask  # (n,), of the points
    sparse: Mask  # (m,), of the cells
    cluster: Ints  # (m,), -1 where sparse or empty after the table left
    parts: tuple[Part, ...]


def robust_box(points: Floats) -> tuple[Floats, Floats]:
    """Return the corners of the box that holds nearly all points, a little widened."""
    some = points[:: max(1, len(points) // 100_000)]
    low, high = np.quantile(some, 0.005, axis=0), np.quantile(some, 0.995, axis=0)
    room = 0.15 * float(np.linalg.norm(high - low))
    return low - room, high + room


def into_cells(points: Floats) -> Cells:
    """Return the cloud in cells, as fine as its density allows."""
    low, high = robust_box(points)
    diagonal = float(np.linalg.norm(high - low))
    inside = np.all((points >= low) & (points <= high), axis=1)
    size = diagonal / FINE
    while True:
        index = ((points[inside] - low) / size).astype(np.int64)
        side = int(np.ceil(((high - low) / size).max())) + 3
        keys, where, count = np.unique(
            ((index[:, 0] + 1) * side + index[:, 1] + 1) * side + index[:, 2] + 1,
            return_inverse=True,
            return_counts=True,
        )
        if len(where) >= LEAST_PER_CELL * len(keys) or size > diagonal / 40:
            break
        size *= 1.25
    centre = np.stack([np.bincount(where, points[inside, k], minlength=len(keys)) / count for k in range(3)], axis=1)
    of_point = np.full(len(points), -1, dtype=np.int64)
    of_point[inside] = where
    return Cells(size, of_point, centre, count, _around(keys, count, side))


def _around(keys: Ints, count: Ints, side: int) -> Ints:
    total = np.zeros(len(keys), dtype=np.int64)
    for step in ((i * side + j) * side + k for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)):
        at = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        total += np.where(keys[at] == keys + step, count[at], 0)
    return total


def find_table(cells: Cells, seed: int) -> Plane | None:
    """Return the plane that most of the cells lie in, if nearly everything else is on one side of it."""
    points = cells.centre[cells.around > SPARSE_RATIO * np.median(cells.around)]
    if len(points) < 50:
        return None
    rng = np.random.default_rng(seed)
    some = points[rng.permutation(len(points))[:4000]]
    a, b, c = (some[rng.integers(len(some), size=PLANE_TRIES)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    good = length > 0
    if not good.any():
        return None
    normals, offsets = normals[good] / length[good, None], np.sum(normals[good] / length[good, None] * a[good], axis=1)
    near = np.abs(some @ normals.T - offsets) < cells.size_cu
    best = int(np.argmax(near.sum(axis=0)))
    normal, offset = normals[best], float(offsets[best])
    reach = cells.size_cu
    for _ in range(6):
        held = np.abs(points @ normal - offset) < reach
        middle = points[held].mean(axis=0)
        normal = np.linalg.svd((points[held] - middle) / cells.size_cu, full_matrices=False)[2][2]
        offset = float(normal @ middle)
        spread = float(1.4826 * np.median(np.abs(points[held] @ normal - offset)))
        reach = min(max(4 * spread, 0.15 * cells.size_cu), cells.size_cu)
    height = points @ normal - offset
    above, below = int((height > 2 * reach).sum()), int((height < -2 * reach).sum())
    if above < below:
        normal, offset, above, below = -normal, -offset, below, above
    if held.mean() < TABLE_LEAST_FRAC or below > 0.15 * max(above, 1):
        return None
    return Plane(normal, offset, spread)


def table_top_cu(points: Floats, table: Plane, size: float) -> float:
    """Return the height up to which a point may belong to the table: four times its scatter; `size` is the cell's."""
    height = table.height(points)
    near = np.abs(height) < 2 * size
    some = height[near][:: max(1, int(near.sum()) // 50_000)]
    core = some[np.abs(some) < max(6 * table.spread_cu, 0.5 * size)]
    spread = 1.4826 * float(np.median(np.abs(core))) if len(core) else table.spread_cu
    return 4.0 * spread


def clean(points: Floats, seed: int = 0) -> Cleaned:
    """Return the cloud told apart; `points` as read, `(n, 3)`. Raises `RefusedError` where they are no surface."""
    if _is_line(points):
        line = Finding("SCAN-LINE", "all points lie on one straight line", hint="look at the file in a viewer")
        raise RefusedError("the cloud cannot be compared", [line])
    cells = into_cells(points)
    table = find_table(cells, seed)
    top = 0.0 if table is None else table_top_cu(points, table, cells.size_cu)
    is_table = np.zeros(len(points), dtype=bool) if table is None else table.height(points) < top
    left = np.bincount(cells.of_point[(cells.of_point >= 0) & ~is_table], minlength=len(cells.count))
    standing = left >= np.maximum(1, 0.3 * cells.count)
    usual = float(np.median(cells.around[standing])) if standing.any() else 0.0
    sparse = standing & (cells.around < max(SPARSE_RATIO * usual, 3))
    cluster = np.full(len(cells.count), -1, dtype=np.int64)
    core = standing & ~sparse
    cluster[core] = _clusters(cells.centre[core], JOIN_CELLS * cells.size_cu)
    parts = tuple(_parts(cells, cluster, table is not None))
    return Cleaned(cells, table, top, is_table, sparse, cluster, parts)


def _is_line(points: Floats) -> bool:
    """Tell whether nothing but rounding keeps the points off one line; no surface can be found in such."""
    spread = np.linalg.svd(np.cov(points.T), compute_uv=False)
    return bool(spread[1] <= LINE_RATIO**2 * spread[0])


def _clusters(points: Floats, reach: float) -> Ints:
    """Return a number for each point, 0 for those of the largest cluster."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    _, label = connected_components(links, directed=False)
    order = np.argsort(-np.bincount(label), kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return np.asarray(rank[label])


def _parts(cells: Cells, cluster: Ints, has_table: bool) -> Iterator[Part]:
    """Yield what may be the specimen, likeliest first: big clusters, pieces together, and all with the table."""
    held = cluster >= 0
    if held.any():
        sizes = np.bincount(cluster[held])
        yield Part("largest cluster", cluster == 0)
        pieces = np.flatnonzero(sizes >= 0.05 * sizes[0])
        first = cells.centre[cluster == 0]
        reach = float(np.linalg.norm(np.ptp(first, axis=0)))
        close = [k for k in pieces if k == 0 or _gap(first, cells.centre[cluster == k]) < 0.25 * reach]
        if len(close) > 1:
            yield Part(f"{len(close)} clusters side by side", np.isin(cluster, close))
        for k in pieces[1:4]:
            if sizes[k] >= 0.15 * sizes[0]:
                yield Part(f"cluster {k + 1}", cluster == k)
    if has_table:
        dense = cells.around >= SPARSE_RATIO * np.median(cells.around)
        label = np.full(len(cluster), -1, dtype=np.int64)
        label[dense] = _clusters(cells.centre[dense], JOIN_CELLS * cells.size_cu)
        yield Part("largest cluster with its plane kept", label == 0)


def _gap(a: Floats, b: Floats) -> float:
    return float(nearest(cKDTree(a), b)[0].min())
