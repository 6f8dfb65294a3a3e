"""Labels on both sides of a seam, so that hands find which cell meets which when the sheet is joined.

A pair is a letter for the seam and a number along it (`A1`, `A2`, …), engraved into the solid middle of two cells that
lie at the same place of the target, one on each side.
"""

from __future__ import annotations

import math
import string
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from design.flatten import Flattening
from design.flatten.result import Seam
from design.pattern.cuts import Cuts
from design.pattern.font import Anchor, text_strokes, text_width_mm
from design.pattern.paths import CutPath
from design.pattern.tiling import Array, Index, Tiling

PITCH_EDGES_COUNT = 2.0  # cell edges along a seam from one pair to the next
REACH_EDGES_COUNT = 0.75  # a cell further than that from its station is not beside the seam
LEAST_HEIGHT_MM, MOST_HEIGHT_MM = 0.5, 2.0  # smaller letters cannot be read, larger ones need not be
CLEAR_RATIO = 0.9  # of the free middle of a cell that letters may take


@dataclass(frozen=True, slots=True)
class Pair:
    """Two cells that meet when the seam is joined."""

    label: str
    left: int
    right: int


def seam_pairs(tiling: Tiling, flat: Flattening) -> list[Pair]:
    """Return the cells to label along every seam of the flat.

    A tube is joined where its cells end, straight up, and there cell meets cell. Cells do not run on across a cone's
    seam: there the two cells nearest to one point of the seam, each inside its own side, are a pair.
    """
    if tiling.twins is not None:
        return _numbered(0, _joined(tiling))
    found = []
    for k, seam in enumerate(seam for seam in flat.seams if not seam.closes_tube):
        found += _numbered(k, _beside(tiling, flat, seam))
    return found


def _numbered(seam: int, cells: Sequence[tuple[int, int]]) -> list[Pair]:
    letters = string.ascii_uppercase
    name = letters[seam % len(letters)] * (seam // len(letters) + 1)
    return [Pair(f"{name}{k + 1}", left, right) for k, (left, right) in enumerate(cells)]


def _joined(tiling: Tiling) -> list[tuple[int, int]]:
    """Return pairs of cells that share an edge only once a tube is joined, from the foot up."""
    neighbours, centres = tiling.neighbours(), tiling.centres_mm()
    own, slot = np.nonzero(neighbours >= 0)
    other = neighbours[own, slot]
    # Cells of one edge lie closer than an edge to each other, unless the sheet's width is between them.
    across = (centres[other, 0] - centres[own, 0]) > 2 * tiling.edge_mm
    left, right = own[across], other[across]
    order = np.argsort(centres[left, 1], kind="stable")
    return _spaced(left[order], right[order], centres, PITCH_EDGES_COUNT * tiling.edge_mm)


def _spaced(left: Index, right: Index, centres_mm: Array, pitch_mm: float) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    for a, b in zip(left.tolist(), right.tolist(), strict=True):
        if not found or centres_mm[a, 1] - centres_mm[found[-1][0], 1] >= pitch_mm:
            found.append((a, b))
    return found


def _beside(tiling: Tiling, flat: Flattening, seam: Seam) -> list[tuple[int, int]]:
    """Return pairs of cells on the two sides of a cone's seam, from the cone outwards; no cell twice."""
    stations = [_stations_mm(flat, side, tiling.edge_mm) for side in (seam.left, seam.right)]
    tree = cKDTree(tiling.centres_mm())
    (left_gap, right_gap), (left, right) = (np.array(each) for each in zip(*map(tree.query, stations), strict=True))
    found: list[tuple[int, int]] = []
    taken: set[int] = set()
    for k in np.flatnonzero(np.maximum(left_gap, right_gap) < REACH_EDGES_COUNT * tiling.edge_mm).tolist():
        a, b = int(left[k]), int(right[k])
        # Close to the cone the sides have hardly parted, and cells of both hold together in the sheet already.
        if np.isin(tiling.cells[a], tiling.cells[b]).any() or taken & {a, b}:
            continue
        taken |= {a, b}
        found.append((a, b))
    return found


def _stations_mm(flat: Flattening, side: Index, edge_mm: float) -> Array:
    """Return places at equal steps along one side of a seam, half a cell inside its flat, `(n, 2)`.

    The two sides are congruent, so that the same number of places lies on both.
    """
    points = flat.flat_mm[side]
    runs = np.diff(points, axis=0)
    along = np.r_[0.0, np.cumsum(np.linalg.norm(runs, axis=1))]
    pitch = PITCH_EDGES_COUNT * edge_mm
    count = max(1, round(float(along[-1]) / pitch - 1e-6))
    at = (np.arange(count) + 0.5) * along[-1] / count
    piece = np.searchsorted(along, at, side="right") - 1
    on = np.column_stack([np.interp(at, along, points[:, k]) for k in (0, 1)])
    run = runs[piece] / np.linalg.norm(runs[piece], axis=1)[:, None]
    inward = np.column_stack([-run[:, 1], run[:, 0]])
    # The flat lies on one and the same side all along: where the first edge's face is.
    with_edge = np.flatnonzero(np.isin(flat.faces, side[:2]).sum(axis=1) == 2)[0]
    to_face = flat.flat_mm[flat.faces[with_edge]].mean(axis=0) - points[:2].mean(axis=0)
    lies_left = runs[0, 0] * to_face[1] - runs[0, 1] * to_face[0] > 0
    return np.asarray(on + (1 if lies_left else -1) * edge_mm / 2 * inward)


def label_paths(
    tiling: Tiling, cuts: Cuts, cut: NDArray[np.bool_], pairs: Sequence[Pair]
) -> tuple[list[CutPath], list[Pair]]:
    """Return the strokes of all labels that can be read, and the pairs which they name.

    Letters keep clear of the cell's cuts; where that leaves less than `LEAST_HEIGHT_MM`, the pair has no label.
    """
    centres = tiling.centres_mm()
    border = tiling.edge_mm / math.sqrt(12)  # from a cell's middle to its edges
    free_mm = CLEAR_RATIO * np.where(cut, np.minimum(cuts.free_mm(tiling), border), border)
    strokes: list[CutPath] = []
    named = []
    for pair in pairs:
        cells = (pair.left, pair.right)
        # The greatest height at which half the text's diagonal is what is free.
        diagonal_ratio = math.hypot(text_width_mm(pair.label, 1), 1)
        height = min(MOST_HEIGHT_MM, 2 * float(free_mm[list(cells)].min()) / diagonal_ratio)
        if height < LEAST_HEIGHT_MM:
            continue
        named.append(pair)
        for cell in cells:
            anchor = Anchor(float(centres[cell, 0]), float(centres[cell, 1]), height, math.inf)
            strokes += [CutPath("engrave", path.points_mm, cell=cell) for path in text_strokes(pair.label, anchor)]
    return strokes, named
