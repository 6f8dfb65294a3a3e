"""Cells to slit polylines, and the sheet's outline.

The geometry is that of Chen et al. 2021 and its published pattern: each slit's centre line leaves the edge at t + s/2
from its corner and ends a hinge's width short of the next slit; on a shared edge the two cells' slits meet in
the middle of their two ends, and each bends at its kink to get there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from design.pattern.cuts import Inside
from design.pattern.paths import CutPath
from design.pattern.tiling import Array, Tiling

STRAIGHT_MM = 1e-4  # a kink that bends less than this is left out: a thousandth of the kerf

HingeRule = Literal["constant", "widening"]


@dataclass(frozen=True, slots=True)
class HingeOptions:
    """How wide hinges are: constant, or growing with the expansion from `width_mm` by `added_mm`.

    The published sheets use `widening` with 0.30 and 0.125 mm, the extremes taken over the design's own cells.
    """

    rule: HingeRule = "constant"
    width_mm: float = 0.25
    added_mm: float = 0.125


def hinge_widths_mm(expansion_ratio: Array, options: HingeOptions) -> Array:
    """Return the hinge width of every cell, `(k,)`."""
    if options.rule == "constant" or np.ptp(expansion_ratio) == 0:
        return np.full(len(expansion_ratio), options.width_mm)
    share = (expansion_ratio - expansion_ratio.min()) / np.ptp(expansion_ratio)
    return np.asarray(options.width_mm + options.added_mm * share)


@dataclass(frozen=True, slots=True)
class Slits:
    """The centre lines of all slits, three a cell, each from its edge over the kink to the inner end, `(k, 3, 2)`."""

    edge_mm: Array
    kink_mm: Array
    inner_mm: Array

    def inside(self, tiling: Tiling, cut: NDArray[np.bool_]) -> Inside:
        """Return the slits of the cells in `cut`; a half slit needs nothing of the border."""
        return Inside(slit_paths(tiling, self, cut), [])

    def free_mm(self, tiling: Tiling) -> Array:
        """Return how far around its centroid each cell is uncut, `(k,)`."""
        lines = shapely.linestrings(np.stack([self.edge_mm, self.kink_mm, self.inner_mm], axis=2).reshape(-1, 3, 2))
        at = shapely.points(np.repeat(tiling.centres_mm(), 3, axis=0))
        return np.asarray(shapely.distance(lines, at).reshape(-1, 3).min(axis=1))


def slits_of(
    tiling: Tiling,
    t_mm: Array,
    theta_rad: Array,
    hinge_mm: Array,
    slit_mm: float,
    cut: NDArray[np.bool_] | None = None,
) -> Slits:
    """Return the slits of every cell; parameters `(k,)`. Where two cut cells share an edge their slits meet.

    What stands for a cell that is not in `cut` has no meaning.
    """
    cut = np.ones(len(tiling.cells), dtype=bool) if cut is None else cut
    corners = tiling.vertices_mm[tiling.cells]
    turn = np.where(tiling.inverted, -theta_rad, theta_rad)
    # Slit k leaves the edge from corner k to corner k − 1 and runs along edge k → k + 1, turned by theta.
    down = np.roll(corners, 1, axis=1) - corners
    down /= np.linalg.norm(down, axis=2, keepdims=True)
    along = np.roll(corners, -1, axis=1) - corners
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    run = np.stack([c * along[..., 0] - s * along[..., 1], s * along[..., 0] + c * along[..., 1]], axis=-1)

    def line(offset_mm: Array) -> Array:
        return np.asarray(corners + offset_mm[..., None] * down)

    own = np.repeat(t_mm[:, None], 3, axis=1)
    near, far = line(own), line(own + slit_mm)
    before, before_run = np.roll(near, 1, axis=1), np.roll(run, 1, axis=1)
    kink = (_meet(before, before_run, near, run) + _meet(before, before_run, far, run)) / 2
    start = line(own + slit_mm / 2)
    after, after_run = np.roll(far, -1, axis=1), np.roll(run, -1, axis=1)
    inner = _meet(start, run, after, after_run) - (hinge_mm / math.sin(math.pi / 3))[:, None, None] * run
    return Slits(line(_joined(tiling, own, cut) + slit_mm / 2), kink, inner)


def _meet(a: Array, a_run: Array, b: Array, b_run: Array) -> Array:
    """Return where the line through `a` along `a_run` meets the one through `b` along `b_run`."""
    gap = b - a
    cross = a_run[..., 0] * b_run[..., 1] - a_run[..., 1] * b_run[..., 0]
    share = (gap[..., 0] * b_run[..., 1] - gap[..., 1] * b_run[..., 0]) / cross
    return np.asarray(a + share[..., None] * a_run)


def _joined(tiling: Tiling, t_mm: Array, cut: NDArray[np.bool_]) -> Array:
    """Return t of every slit `(k, 3)`, that of two cut cells on one edge being their mean: by topology, so that a seam
    that is joined again counts as one edge. Both cells of an edge measure t from the same corner."""
    _, which = tiling.edges()
    edge, weight = which.ravel(), np.repeat(cut.astype(np.float64), 3)
    total = np.bincount(edge, weight * t_mm.ravel())
    return np.asarray((total / np.maximum(1.0, np.bincount(edge, weight)))[which])


def slit_paths(tiling: Tiling, slits: Slits, cut: NDArray[np.bool_] | None = None) -> list[CutPath]:
    """Return one polyline per edge: across it where both cells are cut, from it inwards where only one is.

    `cut` `(k,)` says which cells have slits at all; a passive cell has none. On a seam each side keeps its own half.
    """
    cut = np.ones(len(tiling.cells), dtype=bool) if cut is None else cut
    ends = np.sort(np.stack([tiling.cells, np.roll(tiling.cells, 1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    _, edge = np.unique(ends, axis=0, return_inverse=True)  # as drawn: the two sides of a seam are two edges
    mine = np.flatnonzero(np.repeat(cut, 3))
    mine = mine[np.argsort(edge[mine], kind="stable")]
    first = np.r_[True, edge[mine][1:] != edge[mine][:-1]]
    last = np.r_[first[1:], True]
    arms = np.stack([slits.inner_mm, slits.kink_mm, slits.edge_mm], axis=2).reshape(-1, 3, 2)
    arm_count = np.where(_bends(arms), 3, 2)
    paths = []
    for slot, is_first, is_last in zip(mine.tolist(), first.tolist(), last.tolist(), strict=True):
        arm = arms[slot] if arm_count[slot] == 3 else arms[slot, ::2]
        if is_first:
            begun, owner = arm, slot // 3
            if is_last:
                paths.append(CutPath("slit", arm, cell=owner, opens=True))
        else:
            paths.append(CutPath("slit", np.concatenate([begun, arm[-2::-1]]), cell=owner))
    return paths


def _bends(arms_mm: Array) -> NDArray[np.bool_]:
    """Say which arms `(n, 3, 2)` have a kink that is off the straight line between their ends."""
    chord, part = arms_mm[:, 2] - arms_mm[:, 0], arms_mm[:, 1] - arms_mm[:, 0]
    off = np.abs(chord[:, 0] * part[:, 1] - chord[:, 1] * part[:, 0])
    return np.asarray(off > STRAIGHT_MM * np.linalg.norm(chord, axis=1))


def outline_loops(tiling: Tiling) -> list[Array]:
    """Return the border of the cells as closed loops, straight runs merged; outer loops counter-clockwise."""
    upright = np.where(tiling.inverted[:, None], tiling.cells[:, ::-1], tiling.cells)
    half = np.stack([upright, np.roll(upright, -1, axis=1)], axis=2).reshape(-1, 2)
    inner = {(a, b) for a, b in half.tolist()}
    border = [(a, b) for a, b in half.tolist() if (b, a) not in inner]
    leaving: dict[int, list[int]] = {}
    for a, b in border:
        leaving.setdefault(a, []).append(b)
    loops = []
    while leaving:
        start = min(leaving)
        loop, here, came = [start], start, None
        while True:
            there = _next(tiling.vertices_mm, came, here, leaving[here])
            leaving[here].remove(there)
            if not leaving[here]:
                del leaving[here]
            came, here = here, there
            if here == start:
                break
            loop.append(here)
        loops.append(_merged(tiling.vertices_mm[loop]))
    return loops


def _next(vertices_mm: Array, came: int | None, here: int, choices: list[int]) -> int:
    """Return the way on; where two loops touch in a corner, the one that turns furthest left stays with its own."""
    if came is None or len(choices) == 1:
        return choices[0]
    back = vertices_mm[came] - vertices_mm[here]

    def turn(there: int) -> float:
        on = vertices_mm[there] - vertices_mm[here]
        # The angle from the way back, clockwise: the sharpest left turn comes first.
        angle = math.atan2(back[0] * on[1] - back[1] * on[0], float(back @ on))
        return -angle % (2 * math.pi)

    return min(choices, key=turn)


def _merged(loop_mm: Array) -> Array:
    into, out = loop_mm - np.roll(loop_mm, 1, axis=0), np.roll(loop_mm, -1, axis=0) - loop_mm
    bends = np.abs(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]) > 1e-9 * (into**2).sum(axis=1)
    return np.asarray(loop_mm[bends])
