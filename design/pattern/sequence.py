"""The order of a whole cut: layer by layer, inner before outer, heat spread, and short travel within that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import shapely

from design.pattern.order import tour
from design.pattern.paths import LAYERS, CutPath, Layer
from design.pattern.tiling import Array, Index

CONTOURS: tuple[Layer, ...] = ("hole", "outline")  # never run backwards: the lead-in comes first


def sequence(
    strokes: Sequence[CutPath],
    passes_count: Mapping[Layer, int] | None = None,
    spread_mm: float = 0.0,
    start_mm: tuple[float, float] = (0.0, 0.0),
) -> list[CutPath]:
    """Return the strokes in the order and direction of cutting, every pass of a layer before the next layer.

    With `spread_mm` no stroke follows one whose middle is nearer than that, except where a round over the sheet ends;
    the strokes are then cut in several rounds, each over the whole sheet.
    """
    found: list[CutPath] = []
    here = start_mm
    for layer in LAYERS:
        mine = [stroke for stroke in strokes if stroke.layer == layer]
        run: list[CutPath] = []
        for group in _inner_first(mine) if layer in CONTOURS else _apart(mine, spread_mm):
            run += _toured(group, here, may_flip=layer not in CONTOURS)
            here = _end(run)
        for again in range(passes_count.get(layer, 1) if passes_count else 1):
            found += run if again % 2 == 0 or layer in CONTOURS else [_flipped(stroke) for stroke in reversed(run)]
        here = _end(found) if found else here
    return found


def _end(run: Sequence[CutPath]) -> tuple[float, float]:
    x, y = run[-1].points_mm[-1]
    return float(x), float(y)


def _flipped(stroke: CutPath) -> CutPath:
    return replace(stroke, points_mm=stroke.points_mm[::-1])


def _toured(group: Sequence[CutPath], here: tuple[float, float], may_flip: bool) -> list[CutPath]:
    ends = np.array([[stroke.points_mm[0], stroke.points_mm[-1 if may_flip else 0]] for stroke in group])
    order = tour(ends.reshape(-1, 2), here)[::2]
    return [_flipped(group[k // 2]) if k % 2 and may_flip else group[k // 2] for k in order.tolist()]


def _inner_first(strokes: Sequence[CutPath]) -> list[list[CutPath]]:
    """Return contours by how many others hold them, the innermost first; pieces of a tabbed contour stay together."""
    if not strokes:
        return []
    areas = [shapely.Polygon(s.points_mm) if len(s.points_mm) > 3 else shapely.Polygon() for s in strokes]
    starts = [shapely.Point(s.points_mm[0]) for s in strokes]
    held, holder = shapely.STRtree(areas).query(starts, predicate="within")
    depth = np.bincount(held[held != holder], minlength=len(strokes)).tolist()
    return [
        [s for s, d in zip(strokes, depth, strict=True) if d == level] for level in sorted(set(depth), reverse=True)
    ]


def _apart(strokes: Sequence[CutPath], spread_mm: float) -> list[list[CutPath]]:
    """Return the strokes as rounds, in each of which no two middles are nearer than `spread_mm`."""
    if not strokes:
        return []
    if spread_mm <= 0:
        return [list(strokes)]
    middles = np.array([stroke.points_mm.mean(axis=0) for stroke in strokes])
    rounds = _colours(middles, spread_mm)
    return [[strokes[k] for k in np.flatnonzero(rounds == colour).tolist()] for colour in range(int(rounds.max()) + 1)]


def _colours(middles_mm: Array, spread_mm: float) -> Index:
    """Return a round for every stroke, greedily the first that no near one has."""
    from scipy.spatial import cKDTree

    near: list[list[int]] = [[] for _ in middles_mm]
    for a, b in cKDTree(middles_mm).query_pairs(spread_mm, output_type="ndarray").tolist():
        near[max(a, b)].append(min(a, b))
    colours = np.zeros(len(middles_mm), dtype=np.int64)
    for k, earlier in enumerate(near):
        taken = {int(colours[m]) for m in earlier}
        colours[k] = next(colour for colour in range(len(earlier) + 1) if colour not in taken)
    return colours
