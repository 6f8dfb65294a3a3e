"""The triangle tiling of the flat: which cells there are, and which share which edge.

Edges run along x. A cell's corners are named in the order of its slits: counter-clockwise for an upright cell,
clockwise for an inverted one, which is its mirror image. Slit k of a cell leaves the edge from corner k to k − 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from design.errors import DesignError

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Placement = Literal["centred", "optimised"]

ROW_RATIO = math.sqrt(3) / 2  # height of a cell over its edge
SAMPLES_PER_EDGE = 4  # per cell edge, when the fit of a placement is estimated
TURNS_COUNT, SHIFTS_COUNT = 8, 6  # placements tried: turns of a third of the lattice's symmetry, shifts each way
PIXELS_PER_EDGE = 16  # of the picture in which a placement is judged
PIXELS_LIMIT_COUNT = 2_000_000


@dataclass(frozen=True, slots=True)
class Tiling:
    """Equal triangles that meet edge to edge."""

    edge_mm: float
    vertices_mm: Array  # (n, 2)
    cells: Index  # (k, 3) vertices, in the order of the slits
    inverted: NDArray[np.bool_]  # (k,)
    twins: Index | None = None  # (n,) the vertex that each one becomes when a seam is joined; None without a seam

    def centres_mm(self) -> Array:
        """Return the cells' centroids, `(k, 2)`."""
        return np.asarray(self.vertices_mm[self.cells].mean(axis=1))

    def edges(self) -> tuple[Index, Index]:
        """Return every edge's vertices `(e, 2)` and the edge that each slit leaves, `(k, 3)`, with the seam joined."""
        cells = self.joined_cells()
        ends = np.sort(np.stack([cells, np.roll(cells, 1, axis=1)], axis=2), axis=2)
        pairs, which = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
        return pairs, np.asarray(which.reshape(-1, 3))

    def neighbours(self) -> Index:
        """Return the cell across each slit's edge, `(k, 3)`; −1 at the border."""
        pairs, which = self.edges()
        sides = np.full((len(pairs), 2), -1, dtype=np.int64)
        order = np.argsort(which.ravel(), kind="stable")
        edge = which.ravel()[order]
        second = np.r_[False, edge[1:] == edge[:-1]]
        sides[edge[~second], 0] = order[~second] // 3
        sides[edge[second], 1] = order[second] // 3
        both = sides[which]
        own = np.arange(len(self.cells))[:, None]
        return np.where(both[..., 0] == own, both[..., 1], both[..., 0])

    def joined_cells(self) -> Index:
        """Return the cells' vertices with the two sides of a seam made one, `(k, 3)`."""
        return self.cells if self.twins is None else self.twins[self.cells]

    def part(self, keep: NDArray[np.bool_]) -> Tiling:
        """Return the tiling with only some of its cells; the vertices stay as they are."""
        return replace(self, cells=self.cells[keep], inverted=self.inverted[keep])

    def compact(self) -> Tiling:
        """Return the tiling without the vertices that no cell uses."""
        used, cells = np.unique(self.cells, return_inverse=True)
        twins = None
        if self.twins is not None:
            number = np.full(len(self.vertices_mm), -1)
            number[used] = np.arange(len(used))
            twins = number[self.twins[used]]
            twins = np.where(twins < 0, np.arange(len(used)), twins)  # the other side is not in any cell
        return replace(self, vertices_mm=self.vertices_mm[used], cells=cells.reshape(-1, 3), twins=twins)

    def moved(self, by_mm: Array) -> Tiling:
        """Return the tiling in another place."""
        return replace(self, vertices_mm=self.vertices_mm + by_mm)


@dataclass(frozen=True, slots=True)
class Place:
    """How the flat and the lattice meet: the flat turned about its box's centre, the lattice moved by `shift_mm`."""

    turn_rad: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)

    def put(self, flat_mm: Array) -> Array:
        """Return the flat's points as they lie under the lattice, `(n, 2)`."""
        centre = _box_centre(flat_mm)
        return np.asarray((flat_mm - centre) @ self._turn() + centre)

    def back(self, way_mm: Array) -> Array:
        """Return directions under the lattice as they are on the unturned flat, `(…, 2)`."""
        return np.asarray(way_mm @ self._turn().T)

    def _turn(self) -> Array:
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return np.array([[c, s], [-s, c]])


def _box_centre(points_mm: Array) -> Array:
    return np.asarray((points_mm.min(axis=0) + points_mm.max(axis=0)) / 2)


def lattice(low_mm: Array, high_mm: Array, edge_mm: float, shift_mm: tuple[float, float] = (0.0, 0.0)) -> Tiling:
    """Return a tiling that covers a box with room to spare (Chen et al. 2021: the box's centre is the lattice's)."""
    width, height = high_mm - low_mm
    cols, rows = int(width / edge_mm + 5), int(height / (ROW_RATIO * edge_mm) + 5)
    origin = (low_mm + high_mm) / 2 - np.array([cols * edge_mm, rows * ROW_RATIO * edge_mm]) / 2 + np.array(shift_mm)
    j, i = np.divmod(np.arange(rows * cols), cols)
    vertices = origin + edge_mm * np.column_stack([i + (j % 2) / 2, j * ROW_RATIO])
    j, i = np.divmod(np.arange((rows - 1) * (cols - 1)), cols - 1)
    here = j * cols + i
    odd = (j % 2).astype(bool)
    upright = np.column_stack([here, here + 1, here + cols + odd])
    # The mirror image in a horizontal line: left, right, then the corner below.
    inverted = np.column_stack([here + cols, here + cols + 1, here + ~odd])
    cells = np.stack([upright, inverted], axis=1).reshape(-1, 3)
    return Tiling(edge_mm, vertices, cells, np.tile([False, True], len(here)))


def tile(flat_mm: Array, faces: Index, edge_mm: float, shift_mm: tuple[float, float] = (0.0, 0.0)) -> Tiling:
    """Return the cells whose centroid lies inside the flat, less those with a corner no other cell uses.

    `flat_mm` `(n, 2)` and `faces` `(m, 3)` are the flat as it lies under the lattice; `shift_mm`, of at most an edge,
    moves the lattice. Raises `DesignError` where not one cell fits.
    """
    whole = lattice(flat_mm.min(axis=0), flat_mm.max(axis=0), edge_mm, shift_mm)
    region = region_of(flat_mm, faces)
    centres = whole.centres_mm()
    kept = whole.part(shapely.contains_xy(region, centres[:, 0], centres[:, 1]))
    kept = kept.part(_well_held(kept.joined_cells(), len(kept.vertices_mm)))
    if not len(kept.cells):
        width, height = np.ptp(flat_mm, axis=0)
        raise DesignError(f"not one cell of {edge_mm:g} mm fits into a flat of {width:.1f} × {height:.1f} mm")
    return kept


def _well_held(cells: Index, vertices_count: int) -> NDArray[np.bool_]:
    uses = np.bincount(cells.ravel(), minlength=vertices_count)
    return np.asarray((uses[cells] > 1).all(axis=1))


def region_of(flat_mm: Array, faces: Index) -> shapely.Geometry:
    """Return the flat's area as polygons with their holes; its faces must not overlap."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = (faces[:, :2].ravel(), faces[:, 1:].ravel())
    pieces = connected_components(coo_array((np.ones(len(ends[0])), ends), shape=2 * (len(flat_mm),)))[1][faces[:, 0]]
    # Within a piece faces share their corners exactly; copies of a tube's meet along sides that were computed twice.
    parts = [shapely.coverage_union_all(shapely.polygons(flat_mm[faces[pieces == k]])) for k in np.unique(pieces)]
    region = shapely.union_all(parts)
    shapely.prepare(region)
    return region


def best_place(flat_mm: Array, faces: Index, edge_mm: float) -> tuple[Place, float]:
    """Return the turn and shift with the least misfit, and that misfit as a fraction of the flat's area.

    Misfit is flat area under no cell plus cell area over no flat. It is estimated on a picture of the flat, about the
    flat's border only; the cells counted are those that `tile` would keep.
    """
    best, least = Place(), math.inf
    picture = _Picture.of(flat_mm, faces, edge_mm)
    for turn in np.arange(TURNS_COUNT) * (math.pi / 3 / TURNS_COUNT):
        judge = _Judge.of(picture, flat_mm, Place(turn_rad=float(turn)), edge_mm)
        for b in range(SHIFTS_COUNT):
            for a in range(SHIFTS_COUNT):
                shift = ((a + b / 2) * edge_mm / SHIFTS_COUNT, b * ROW_RATIO * edge_mm / SHIFTS_COUNT)
                misfit = judge.misfit_ratio(np.array(shift))
                if misfit < least:
                    least, best = misfit, Place(float(turn), shift)
    return best, least


@dataclass(frozen=True, slots=True)
class _Picture:
    """Which pixels lie on the flat, and how deep, all around too; taken once, because the lattice can be turned."""

    inside: NDArray[np.bool_]  # (h, w)
    depth_mm: Array  # (h, w) to the flat's border, negative outside
    origin_mm: Array
    pixel_mm: float

    @classmethod
    def of(cls, flat_mm: Array, faces: Index, edge_mm: float) -> _Picture:
        """Return the picture of a flat with five edges of room around it."""
        from scipy.ndimage import distance_transform_edt

        low, high = flat_mm.min(axis=0) - 5 * edge_mm, flat_mm.max(axis=0) + 5 * edge_mm
        pixel = max(edge_mm / PIXELS_PER_EDGE, math.sqrt(float(np.prod(high - low)) / PIXELS_LIMIT_COUNT))
        x, y = (np.arange(low[k], high[k], pixel) for k in (0, 1))
        inside = np.atleast_2d(shapely.contains_xy(region_of(flat_mm, faces), *np.meshgrid(x, y)))
        depth_mm: Array = pixel * np.asarray(distance_transform_edt(inside) - distance_transform_edt(~inside))
        return cls(inside, depth_mm, low, pixel)

    def look(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return which points `(…, 2)` lie on the flat."""
        at = np.rint((points_mm - self.origin_mm) / self.pixel_mm).astype(np.int64)
        on = ((at >= 0) & (at < self.inside.shape[::-1])).all(axis=-1)
        at = np.where(np.asarray(on)[..., None], at, 0)
        return np.asarray(self.inside[at[..., 1], at[..., 0]] & on)

    def depths_mm(self, points_mm: Array) -> Array:
        """Return how deep points lie; beyond the picture, as deep as its rim."""
        at = np.rint((points_mm - self.origin_mm) / self.pixel_mm).astype(np.int64)
        at = np.clip(at, 0, np.array(self.inside.shape[::-1]) - 1)
        return np.asarray(self.depth_mm[at[:, 1], at[:, 0]])


@dataclass(frozen=True, slots=True)
class _Judge:
    """A lattice turned over the picture, and the cells of which the flat's border decides."""

    picture: _Picture
    lattice: Tiling
    place: Place
    deep: NDArray[np.bool_]  # (k,) cells under the flat whatever the shift
    near: Index  # cells that a shift may bring in or out
    samples_mm: Array  # (near, s, 2) points spread evenly over each

    @classmethod
    def of(cls, picture: _Picture, flat_mm: Array, place: Place, edge_mm: float) -> _Judge:
        """Return the judge of one turn of the flat: the flat stays, the lattice is turned back."""
        turned = place.put(flat_mm)
        whole = lattice(turned.min(axis=0), turned.max(axis=0), edge_mm)
        centre = _box_centre(flat_mm)
        whole = replace(whole, vertices_mm=place.back(whole.vertices_mm - centre) + centre)
        depth = picture.depths_mm(whole.centres_mm())
        reach = 2.5 * edge_mm  # a shift of up to an edge and a half, and the cell's own size
        near = np.flatnonzero(np.abs(depth) < reach)
        return cls(picture, whole, place, depth >= reach, near, _samples(whole, near))

    def misfit_ratio(self, shift_mm: Array) -> float:
        """Return the misfit with the lattice moved by `shift_mm`."""
        shift = self.place.back(shift_mm)
        keep = self.deep.copy()
        middles = self.lattice.vertices_mm[self.lattice.cells[self.near]].mean(axis=1)
        keep[self.near] = self.picture.look(middles + shift)
        kept = np.flatnonzero(keep)
        kept = kept[_well_held(self.lattice.cells[kept], len(self.lattice.vertices_mm))]
        border = np.isin(self.near, kept, assume_unique=True)
        covered = self.picture.look(self.samples_mm[border] + shift)
        cell_mm2 = ROW_RATIO / 2 * self.lattice.edge_mm**2
        flat_mm2 = float(self.picture.inside.sum()) * self.picture.pixel_mm**2
        over_mm2 = float((~covered).mean(axis=1).sum()) * cell_mm2
        under_mm2 = len(kept) * cell_mm2 - over_mm2
        return (flat_mm2 - under_mm2 + over_mm2) / flat_mm2


def _samples(tiling: Tiling, cells: Index) -> Array:
    """Return points spread evenly over every cell, `(k, s, 2)`: the centroids of its small triangles."""
    n = SAMPLES_PER_EDGE
    up = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    a, b = np.array(up + down).T / n
    weights = np.column_stack([1 - a - b, a, b])
    return np.asarray(np.einsum("sc,kcd->ksd", weights, tiling.vertices_mm[tiling.cells[cells]]))
