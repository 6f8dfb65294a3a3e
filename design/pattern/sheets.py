"""A design larger than the laser's bed: parts of its cells, each on a sheet of its own, joined along lattice edges.

Cells on a join keep half slits, as those on the border do, so that joined parts are the sheet that was designed.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry

from design.pattern.border import BorderOptions, framed, piece_of, rimmed_by
from design.pattern.cuts import Cuts, notched
from design.pattern.drawing import Drawing
from design.pattern.paths import CutPath
from design.pattern.seams import PITCH_EDGES_COUNT, Pair, label_paths
from design.pattern.slits import outline_loops
from design.pattern.tiling import ROW_RATIO, Index, Tiling

MORE_COUNT = 5  # columns and rows tried beyond what the cells alone would need, for teeth, tags and rims


@dataclass(frozen=True, slots=True)
class Split:
    """A design on several sheets: a drawing each, the part of every cell `(k,)`, and the labels on the joins."""

    drawings: tuple[Drawing, ...]
    part: Index
    pairs: tuple[Pair, ...]


def fits(size_mm: tuple[float, float], bed_mm: tuple[float, float]) -> bool:
    """Say whether a sheet lies on the bed as it is drawn, unturned."""
    return size_mm[0] <= bed_mm[0] and size_mm[1] <= bed_mm[1]


def split(
    tiling: Tiling,
    cuts: Cuts,
    cut: NDArray[np.bool_],
    border: BorderOptions,
    bed_mm: tuple[float, float],
    seam_labels: Sequence[CutPath] = (),
) -> Split | None:
    """Return the design on the fewest sheets that a grid of windows gives; None where none is small enough.

    Cells that `seam_labels` are engraved in get no second label.
    """
    labelled = {path.cell for path in seam_labels if path.cell is not None}
    room = 2 * border.sheet_margin_mm
    usable = np.array(bed_mm) - room
    if (usable <= 0).any():
        return None
    least = np.maximum(1, np.ceil(np.ptp(tiling.vertices_mm, axis=0) / usable)).astype(int).tolist()
    windows = [(least[0] + i, least[1] + j) for i in range(MORE_COUNT) for j in range(MORE_COUNT)]
    for columns, rows in sorted(windows, key=lambda pair: (pair[0] * pair[1], sum(pair))):
        part = parts_of(tiling, columns, rows)
        boxes = [np.ptp(tiling.vertices_mm[tiling.cells[part == k]], axis=(0, 1)) for k in range(int(part.max()) + 1)]
        if not all(fits((box[0] + room, box[1] + room), bed_mm) for box in boxes):
            continue
        pairs = join_pairs(tiling, part, labelled)
        labels, named = label_paths(tiling, cuts, cut, pairs)
        drawings = []
        for k, piece in enumerate(pieces_of(tiling, part, border.margin_mm)):
            mine = part == k
            inside = cuts.inside(tiling, cut & mine)
            piece, closed = notched(piece, inside.halves)
            paths = inside.paths + closed
            mouths = np.array([path.points_mm[-1] for path in paths if path.opens]).reshape(-1, 2)
            paths += [label for label in [*seam_labels, *labels] if label.cell is not None and mine[label.cell]]
            joins = shapely.union_all(shapely.polygons(tiling.vertices_mm[tiling.cells[~mine]]))
            drawings.append(framed(piece, mouths, paths, border, tiling.edge_mm, joins)[0])
        if all(fits(drawing.size_mm, bed_mm) for drawing in drawings):
            return Split(tuple(drawings), part, tuple(named))
    return None


def parts_of(tiling: Tiling, columns: int, rows: int) -> Index:
    """Return the part of every cell `(k,)`: cells of one window of a grid that hold together by edges.

    What a window cuts off from its greatest part goes to the neighbour that it shares most edges with.
    """
    centres = tiling.centres_mm()
    # Whole steps of the lattice, so that rounding decides nothing and level joins run along one line of edges.
    x = np.rint((centres[:, 0] - centres[:, 0].min()) / (tiling.edge_mm / 2)).astype(np.int64)
    y = np.floor((centres[:, 1] - tiling.vertices_mm[:, 1].min()) / (ROW_RATIO * tiling.edge_mm)).astype(np.int64)
    window = (x * columns // (x.max() + 1)) * rows + y * rows // (y.max() + 1)
    a, b = shared_edges(tiling)
    count = len(tiling.cells)
    whole = window[a] == window[b]
    graph = coo_array((np.ones(int(whole.sum())), (a[whole], b[whole])), shape=(count, count))
    island = np.asarray(connected_components(graph, directed=False)[1])
    size = np.bincount(island)
    by_size = np.argsort(size[island], kind="stable")
    greatest = dict(zip(window[by_size].tolist(), island[by_size].tolist(), strict=True))  # the last one stays
    for small in np.setdiff1d(island, list(greatest.values())).tolist():
        mine = island == small
        across = np.r_[island[b[mine[a] & ~mine[b]]], island[a[mine[b] & ~mine[a]]]]
        if len(across):
            island[mine] = np.bincount(across).argmax()
    return np.asarray(np.unique(island, return_inverse=True)[1], dtype=np.int64)


def shared_edges(tiling: Tiling) -> tuple[Index, Index]:
    """Return the two cells of every edge that two cells share as drawn, a tube's joint apart, `(e,)` each."""
    neighbours = replace(tiling, twins=None).neighbours()
    cell, slot = np.nonzero(neighbours >= 0)
    other = neighbours[cell, slot]
    return cell[cell < other], other[cell < other]


def join_pairs(tiling: Tiling, part: Index, labelled: Set[int] = frozenset()) -> list[Pair]:
    """Return the cells to label along the joins, numbered from `1`: every other edge, no cell twice."""
    a, b = shared_edges(tiling)
    on_join = part[a] != part[b]
    a, b = a[on_join], b[on_join]
    a, b = np.where(part[a] < part[b], a, b), np.where(part[a] < part[b], b, a)
    middle = (tiling.centres_mm()[a] + tiling.centres_mm()[b]) / 2
    found: list[Pair] = []
    places: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
    taken = set(labelled)
    for k in np.lexsort((middle[:, 0], middle[:, 1], part[b], part[a])).tolist():
        left, right = int(a[k]), int(b[k])
        join = places.setdefault((int(part[left]), int(part[right])), [])
        near = any(np.linalg.norm(middle[k] - at) < PITCH_EDGES_COUNT * tiling.edge_mm * 0.999 for at in join)
        if near or {left, right} & taken:
            continue
        taken |= {left, right}
        join.append(middle[k])
        found.append(Pair(str(len(found) + 1), left, right))
    return found


def pieces_of(tiling: Tiling, part: Index, margin_mm: float) -> list[BaseGeometry]:
    """Return the outline of every part; a rim to clamp only where the design ends, not along the joins."""
    pieces = [piece_of(outline_loops(tiling.part(part == k))) for k in range(int(part.max()) + 1)]
    if margin_mm <= 0:
        return pieces
    given = shapely.union_all(pieces)
    whole_rim = rimmed_by(given, margin_mm)
    rimmed = []
    for piece in pieces:
        rim = rimmed_by(piece, margin_mm).intersection(whole_rim).difference(given)
        given = given.union(rim)
        # What touches the part in a point alone would fall off.
        whole = piece.union(rim)
        rimmed.append(max(getattr(whole, "geoms", [whole]), key=lambda one: float(one.area)))
    return rimmed
