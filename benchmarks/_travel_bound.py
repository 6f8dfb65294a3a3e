"""A bound that no order of strokes can travel less than (Held and Karp's), to say what a search can still gain.

A path through all strokes is a spanning tree of their ends, strokes included, in which every end has two links. Without
that condition the shortest tree is found at once; prices on the ends, raised where a tree has too many links and
lowered where it has too few, bring it near the condition, and any prices give a bound.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import Delaunay, cKDTree

Array = NDArray[np.float64]
NEAR_COUNT = 7
ROUNDS_COUNT = 300
SHRINK_RATIO = 0.985  # of the price step, each round
LIFT_MM = 1e5  # added to every link, so that none is below zero and strokes come first


def bound_mm(ends_mm: Array, tour_mm: float) -> float:
    """Return what any order of the strokes travels at least; `tour_mm` is that of a good one and sets the pace.

    Prices are found on near links only; the bound itself is that of the tree over all links.
    """
    n = len(ends_mm)
    links, length = _near_links(ends_mm)
    strokes = np.arange(n).reshape(-1, 2)
    rows, columns = np.vstack([links, strokes]).T
    price: Array = np.zeros(n)
    before: Array = np.zeros(n)
    best, best_price = -np.inf, price
    step_mm = tour_mm / n
    for number in range(ROUNDS_COUNT):
        weight = np.concatenate([length + price[links].sum(axis=1) + LIFT_MM, np.ones(len(strokes))])
        tree = minimum_spanning_tree(coo_array((weight, (rows, columns)), shape=(n, n)).tocsr()).tocoo()
        moves = tree.data > 1
        loose = np.argpartition(price, 2)[:2]  # where the path begins and ends
        value = (tree.data[moves] - LIFT_MM).sum() + price[loose].sum() - price.sum()
        if value > best:
            best, best_price = value, price
        count = np.bincount(tree.coords[0], minlength=n) + np.bincount(tree.coords[1], minlength=n)
        count[loose] += 1
        over = count.astype(np.float64) - 2
        price = price + step_mm * (0.7 * over + 0.3 * (before if number else over))
        before, step_mm = over, step_mm * SHRINK_RATIO
    return float(_tree_mm(ends_mm, best_price) + np.sort(best_price)[:2].sum() - 2 * best_price.sum())


def _near_links(ends_mm: Array) -> tuple[NDArray[np.int64], Array]:
    corners = np.asarray(Delaunay(ends_mm).simplices, dtype=np.int64)
    near = np.asarray(cKDTree(ends_mm).query(ends_mm, k=NEAR_COUNT)[1], dtype=np.int64)
    pairs = [corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]
    pairs += [np.column_stack([near[:, 0], near[:, k]]) for k in range(1, NEAR_COUNT)]
    links = np.unique(np.sort(np.vstack(pairs), axis=1), axis=0)
    links = links[links[:, 0] // 2 != links[:, 1] // 2]
    return links, np.linalg.norm(ends_mm[links[:, 0]] - ends_mm[links[:, 1]], axis=1)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _tree_mm(points: Array, price: Array) -> float:
    """Return the length of the shortest tree with all strokes in it, over every link there is (Prim's way)."""
    n = len(points)
    reach, done = np.full(n, np.inf), np.zeros(n, np.bool_)
    total, here = 0.0, 0
    for _ in range(n // 2):
        for v in (here, here ^ 1):
            done[v] = True
            total += price[v]
        for v in (here, here ^ 1):
            for w in range(n):
                if not done[w]:
                    d = np.hypot(points[w, 0] - points[v, 0], points[w, 1] - points[v, 1]) + price[v] + price[w]
                    reach[w] = min(reach[w], d)
        least, here = np.inf, -1
        for w in range(n):
            if not done[w] and reach[w] < least:
                least, here = reach[w], w
        total += least if here >= 0 else 0.0
    return total
