"""Coarser versions of a sheet, to find the deployed shape from flat: large units first, then smaller ones.

A fine sheet pushed from flat crumples into one of its countless wrinkled equilibria; a sheet of a few dozen large units
has hardly any. So the coarsest sheet is deployed first, and each finer one starts from the shape before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design.deploy.shell import Ints, Reals, Shell, build_shell, neighbours

SMALLEST_COUNT = 40  # units below which a coarser level would lose the outline


@dataclass(frozen=True, slots=True)
class Layout:
    """A sheet of units as it lies flat, with what each unit is made of.

    `corners_mm` gives each unit's own corners in the flat, so that a vertex welded over a seam may lie at two places.
    """

    cells: Ints  # (m, 3) vertex of each corner, counter-clockwise
    corners_mm: Reals  # (m, 3, 2)
    edge_mm: float
    expansion_ratio: Reals  # (m,)
    Y_N_mm: Reals  # (m,)
    nu_ratio: Reals  # (m,)
    D_mJ: Reals  # (m,)

    @property
    def vertex_count(self) -> int:
        """Return how many vertices the welded sheet has."""
        return int(self.cells.max()) + 1

    def flat_mm(self) -> Reals:
        """Return one flat position of each vertex, `(n, 2)`; of a welded one, either side of the seam."""
        flat = np.full((self.vertex_count, 2), np.nan)
        flat[self.cells[::-1].ravel()] = self.corners_mm[::-1].reshape(-1, 2)
        return flat

    def rejoined_count(self) -> int:
        """Return how many vertices lie at two places of the flat: those on a re-joined seam."""
        corners, vertex = self.corners_mm.reshape(-1, 2), self.cells.ravel()
        low = np.full((self.vertex_count, 2), np.inf)
        high = -low
        np.minimum.at(low, vertex, corners)
        np.maximum.at(high, vertex, corners)
        return int(np.sum(np.linalg.norm(high - low, axis=1) > self.edge_mm / 2))

    def shell(self) -> Shell:
        """Return the shell that these units make."""
        return build_shell(
            self.cells, self.expansion_ratio, self.Y_N_mm, self.nu_ratio, self.D_mJ, self.edge_mm, self.vertex_count
        )


def sheet_layout(
    flat_mm: Reals, cells: Ints, expansion_ratio: Reals, Y_N_mm: Reals, nu_ratio: Reals, D_mJ: Reals
) -> Layout:
    """Return the layout of units between lattice vertices `(n, 2)` without seams; the edge is their median side."""
    corners = flat_mm[cells]
    edge_mm = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    m = len(cells)
    lam, Y, nu, D = (np.broadcast_to(np.asarray(v, float), m).copy() for v in (expansion_ratio, Y_N_mm, nu_ratio, D_mJ))
    return Layout(np.asarray(cells, dtype=np.int64), corners, edge_mm, lam, Y, nu, D)


def weld(layout: Layout, pairs: Ints) -> Layout:
    """Return the layout with vertex pairs `(k, 2)` made one (a re-joined seam)."""
    group = np.arange(layout.vertex_count)
    for a, b in pairs:
        group[group == group[b]] = group[a]
    _, cells = np.unique(group[layout.cells], return_inverse=True)
    return Layout(
        cells.reshape(-1, 3).astype(np.int64), layout.corners_mm, layout.edge_mm, layout.expansion_ratio,
        layout.Y_N_mm, layout.nu_ratio, layout.D_mJ,
    )  # fmt: skip


def _lattice(points_mm: Reals, edge_mm: float, origin_mm: Reals) -> Reals:
    """Return coordinates along the lattice's two directions, in units of the edge."""
    along = (points_mm[..., 1] - origin_mm[1]) / (edge_mm * np.sqrt(0.75))
    return np.stack([(points_mm[..., 0] - origin_mm[0]) / edge_mm - 0.5 * along, along], axis=-1)


def coarsen(layout: Layout) -> Layout | None:
    """Return the sheet with units of twice the side, or None where that is too few or does not hang together."""
    origin = layout.corners_mm[0, 0]
    doubled = 2 * layout.edge_mm
    centre = _lattice(layout.corners_mm.mean(axis=1), doubled, origin)
    base = np.floor(centre + 1e-9).astype(np.int64)
    upper = ((centre - base).sum(axis=1) > 1).astype(np.int64)
    key, member, count = np.unique(np.column_stack([base, upper]), axis=0, return_inverse=True, return_counts=True)
    member = member.ravel()
    keep = np.flatnonzero(count >= 2)
    if len(keep) < SMALLEST_COUNT:
        return None
    lower_corners, upper_corners = np.array([[0, 0], [1, 0], [0, 1]]), np.array([[1, 0], [1, 1], [0, 1]])
    places = key[keep, None, :2] + np.where(key[keep, 2, None, None] == 1, upper_corners, lower_corners)
    cells = _welded_places(layout, places, origin)
    mean = {
        name: np.bincount(member, getattr(layout, name))[keep] / count[keep]
        for name in ("expansion_ratio", "Y_N_mm", "nu_ratio", "D_mJ")
    }
    x = origin[0] + doubled * (places[..., 0] + 0.5 * places[..., 1])
    y = origin[1] + doubled * np.sqrt(0.75) * places[..., 1]
    return _largest_part(cells, np.stack([x, y], axis=-1), doubled, mean)


def _welded_places(layout: Layout, places: Ints, origin_mm: Reals) -> Ints:
    """Return a vertex for each place of the coarse lattice; places that the fine sheet welds share one."""
    fine = np.rint(_lattice(layout.corners_mm, layout.edge_mm, origin_mm)).astype(np.int64).reshape(-1, 2)
    vertex_at = {tuple(p): int(v) for p, v in zip(fine.tolist(), layout.cells.ravel(), strict=True)}
    wanted = 2 * places.reshape(-1, 2)
    names = [vertex_at.get((a, b), (a, b)) for a, b in wanted.tolist()]
    number: dict[object, int] = {}
    return np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64).reshape(-1, 3)


def _largest_part(cells: Ints, corners_mm: Reals, edge_mm: float, mean: dict[str, Reals]) -> Layout | None:
    """Return the largest group of units joined by edges; None where the welded cells are no surface."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if np.any((cells[:, 0] == cells[:, 1]) | (cells[:, 1] == cells[:, 2]) | (cells[:, 2] == cells[:, 0])):
        return None
    try:
        across = neighbours(cells)
    except ValueError:
        return None
    one, side = np.nonzero(across >= 0)
    graph = coo_matrix((np.ones(len(one)), (one, across[one, side])), shape=(len(cells), len(cells)))
    _, part = connected_components(graph, directed=False)
    keep = part == np.argmax(np.bincount(part))
    if keep.sum() < SMALLEST_COUNT:
        return None
    _, used = np.unique(cells[keep], return_inverse=True)
    return Layout(
        used.reshape(-1, 3).astype(np.int64), corners_mm[keep], edge_mm, mean["expansion_ratio"][keep],
        mean["Y_N_mm"][keep], mean["nu_ratio"][keep], mean["D_mJ"][keep],
    )  # fmt: skip


def levels(layout: Layout) -> list[Layout]:
    """Return the sheet and its coarser versions, coarsest first.

    A tube with an odd number of units around has no coarser version: twice as large units do not meet at its seam.
    """
    chain = [layout]
    while len(chain[-1].cells) >= 3 * SMALLEST_COUNT:
        coarser = coarsen(chain[-1])
        if coarser is None or (layout.rejoined_count() and not coarser.rejoined_count()):
            break
        chain.append(coarser)
    return chain[::-1]


def prolong(coarse: Layout, x_mm: Reals, fine: Layout) -> Reals:
    """Return start positions `(n, 3)` of the fine sheet on the coarse one's shape.

    Each coarse unit is a quadratic patch through its corners, bent as its corners' normals ask (after the curved
    triangles of Vlachos et al. 2001): facets would crease the fine sheet along every coarse side. Barycentric and not
    clipped, so that vertices beyond the coarse outline continue the nearest patch.
    """
    from scipy.spatial import cKDTree

    flat = fine.flat_mm()
    nearest = cKDTree(coarse.corners_mm.mean(axis=1)).query(flat)[1]
    a, b, c = (coarse.corners_mm[nearest, k] for k in range(3))
    det = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    p = flat - a
    v = (p[:, 0] * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * p[:, 1]) / det
    w = ((b[:, 0] - a[:, 0]) * p[:, 1] - p[:, 0] * (b[:, 1] - a[:, 1])) / det
    weights = np.column_stack([1 - v - w, v, w])
    corners, normals = (field[coarse.cells[nearest]] for field in (x_mm, _normals(coarse.cells, x_mm)))
    places = np.einsum("nk,nkd->nd", weights, corners)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        side = corners[:, j] - corners[:, i]
        rise_i, rise_j = (np.sum(side * normals[:, k], axis=1, keepdims=True) for k in (i, j))
        bow = rise_i * normals[:, i] - rise_j * normals[:, j]
        places -= 0.5 * (weights[:, i] * weights[:, j])[:, None] * bow
    return np.asarray(places)


def _normals(cells: Ints, x_mm: Reals) -> Reals:
    """Return the unit normal at each vertex `(n, 3)`, of its units by their area."""
    a, b, c = (x_mm[cells[:, k]] for k in range(3))
    each = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = np.column_stack([np.bincount(cells.ravel(), each[:, d], len(x_mm)) for d in range(3)])
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def refine(layout: Layout, parts: int) -> Layout:
    """Return the sheet with each unit's side divided into `parts`, so `parts`² triangles a unit.

    The expansion becomes piecewise linear: each unit's own value and the gradient that its neighbours suggest, so that
    the mean over a unit stays what it was. Stiffness is each unit's own.
    """
    if parts == 1:
        return layout
    centre = layout.corners_mm.mean(axis=1)
    gradient = _gradient_per_mm(layout, centre)
    i, j = np.array([(i, j) for i in range(parts) for j in range(parts - i)]).T
    upward = np.stack([np.stack([i, j]), np.stack([i + 1, j]), np.stack([i, j + 1])], axis=1)
    inner = i + j < parts - 1
    downward = np.stack([np.stack([i + 1, j]), np.stack([i + 1, j + 1]), np.stack([i, j + 1])], axis=1)[:, :, inner]
    steps = np.concatenate([upward, downward], axis=2).transpose(2, 1, 0)  # (parts², 3, 2)
    weights = np.concatenate([parts - steps.sum(axis=2, keepdims=True), steps], axis=2)  # barycentric times parts
    corners = np.einsum("pck,mkd->mpcd", weights / parts, layout.corners_mm)
    cells = _divided_vertices(layout.cells, weights)
    offset = corners.mean(axis=2) - centre[:, None]
    count = parts * parts
    lam = layout.expansion_ratio[:, None] + np.einsum("mpd,md->mp", offset, gradient)
    return Layout(
        cells, corners.reshape(-1, 3, 2), layout.edge_mm / parts, lam.ravel(),
        np.repeat(layout.Y_N_mm, count), np.repeat(layout.nu_ratio, count), np.repeat(layout.D_mJ, count),
    )  # fmt: skip


def _gradient_per_mm(layout: Layout, centre_mm: Reals) -> Reals:
    """Return the gradient `(m, 2)` of the expansion from a unit's neighbours and theirs, by least squares."""
    across = neighbours(layout.cells)
    middle = 0.5 * (np.roll(layout.corners_mm, -1, axis=1) + np.roll(layout.corners_mm, 1, axis=1))
    away = 2 * (middle - centre_mm[:, None])  # to the neighbour's centre, also across a seam
    lam = layout.expansion_ratio
    gradient = np.zeros((len(lam), 2))
    for t in range(len(lam)):
        rows, rises = [], []
        for side in range(3):
            one = across[t, side]
            if one < 0:
                continue
            rows.append(away[t, side])
            rises.append(lam[one] - lam[t])
            for further in range(3):
                two = across[one, further]
                if two >= 0 and two != t:
                    rows.append(away[t, side] + away[one, further])
                    rises.append(lam[two] - lam[t])
        if len(rows) >= 3:
            gradient[t] = np.linalg.lstsq(np.array(rows), np.array(rises), rcond=None)[0]
    return gradient


def _divided_vertices(cells: Ints, weights: Reals) -> Ints:
    """Return vertex numbers of divided units; a point is known by its corners and weights, so sides are shared."""
    parts = int(weights[0, 0].sum())
    number: dict[tuple[tuple[int, int], ...], int] = {((int(v), parts),): int(v) for v in np.unique(cells)}
    out = np.empty((len(cells), *weights.shape[:2]), dtype=np.int64)
    whole = weights.astype(int).tolist()
    for t, corners in enumerate(cells.tolist()):
        for p, triangle in enumerate(whole):
            for c, point in enumerate(triangle):
                name = tuple(sorted((v, w) for v, w in zip(corners, point, strict=True) if w))
                out[t, p, c] = number.setdefault(name, len(number))
    return out.reshape(-1, 3)
