"""In which order, and which way round, strokes are cut, so that the moves between them are short.

Travel is a travelling salesman's tour through strokes that can be run either way. It starts greedily and is then
bettered by chains of exchanged links (Lin and Kernighan's step) and by moving runs of a few strokes (Or's), over near
neighbours only; then by small random kicks that are kept where the repaired tour is shorter.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from design.pattern.tiling import Array, Index

NEAR_COUNT = 8  # neighbours looked at from every stroke end
CHAIN_COUNT = 25  # links exchanged in one chain at most
FIRST_COUNT = 5  # ways tried at a chain's first link
ROUNDS_COUNT, ROUND_GAIN_RATIO = 5, 0.004  # all ends are looked at again while a round still gains this much
RUN_COUNT = 3  # strokes moved together at most
KICK_COUNT = 30  # strokes in a run that a kick moves at most
KICKS_BUDGET_COUNT = 4_000_000  # kicks times strokes: a kick costs more on a longer tour; about a second
GAIN_MM = 1e-7  # less is rounding


def tour(
    ends_mm: Array, start_mm: tuple[float, float] = (0.0, 0.0), kicks_count: int | None = None, seed: int = 0
) -> Index:
    """Return the strokes' ends in the order they are met, `(2n,)`: stroke k has the ends 2k and 2k + 1.

    `ends_mm` is `(2n, 2)`. The tour leaves from `start_mm` and comes back to it. `kicks_count` None means as many as
    pay off for the number of strokes; 0 leaves the local search's result.
    """
    count = len(ends_mm) // 2
    if count < 2:
        return np.arange(2 * count)
    home = np.tile(np.asarray(start_mm, dtype=np.float64), (2, 1))
    points = np.ascontiguousarray(np.vstack([ends_mm, home]))
    near = _near(points)
    order = _greedy(points, 2 * count)
    kicks = kicks_count if kicks_count is not None else min(10 * count, KICKS_BUDGET_COUNT // count)
    _improve(points, near, order, kicks, seed)
    at = int(np.flatnonzero(order >= 2 * count)[0])
    # The two home ends are neighbours; at an even place, because strokes stay whole.
    return np.asarray(np.roll(order, -at)[2:])


def travel_mm(ends_mm: Array, order: Index) -> float:
    """Return the length of the moves between strokes, without the way from and to the start."""
    leave, reach = ends_mm[order[1:-1:2]], ends_mm[order[2::2]]
    return float(np.linalg.norm(leave - reach, axis=1).sum())


def floor_mm(ends_mm: Array) -> float:
    """Return what no tour can beat: half the sum of each stroke end's distance to the nearest end of another stroke."""
    near = _near(ends_mm)
    return float(np.linalg.norm(ends_mm - ends_mm[near[:, 0]], axis=1).sum() / 2)


def greedy_with_flips(ends_mm: Array, start_mm: tuple[float, float] = (0.0, 0.0)) -> Index:
    """Return the tour that always goes on to the nearest end left, `(2n,)`: what a simple sender does."""
    home = np.tile(np.asarray(start_mm, dtype=np.float64), (2, 1))
    return np.asarray(_greedy(np.ascontiguousarray(np.vstack([ends_mm, home])), len(ends_mm))[2:])


def _near(points: Array) -> NDArray[np.int32]:
    """Return the nearest ends of other strokes, nearest first, `(2n, NEAR_COUNT)`."""
    from scipy.spatial import cKDTree

    count = min(NEAR_COUNT, len(points) - 2)
    _, found = cKDTree(points).query(points, k=count + 2)
    own = found // 2 == np.arange(len(points))[:, None] // 2
    # A crowd of ends in one spot can hide a point's own stroke; then the farthest found are let go instead.
    rank = np.argsort(own, axis=1, kind="stable")[:, :count]
    return np.ascontiguousarray(np.take_along_axis(found, rank, axis=1).astype(np.int32))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _greedy(points: Array, first: int) -> Index:
    """Return the tour by nearest ends from the stroke of end `first`; a grid of buckets finds the nearest."""
    n = len(points)
    low_x, low_y = points[:, 0].min(), points[:, 1].min()
    width = max(points[:, 0].max() - low_x, points[:, 1].max() - low_y, 1e-9)
    cells = max(1, int(math.sqrt(n / 2)))
    size = width / cells * (1 + 1e-12)
    bucket = np.empty(n, np.int64)
    head = np.zeros(cells * cells + 1, np.int64)
    for v in range(n):
        cx, cy = min(cells - 1, int((points[v, 0] - low_x) / size)), min(cells - 1, int((points[v, 1] - low_y) / size))
        bucket[v] = cy * cells + cx
        head[bucket[v] + 1] += 1
    for k in range(cells * cells):
        head[k + 1] += head[k]
    content = np.empty(n, np.int64)
    place = np.empty(n, np.int64)
    fill = head[:-1].copy()
    for v in range(n):
        place[v] = fill[bucket[v]]
        content[place[v]] = v
        fill[bucket[v]] += 1
    live = fill  # buckets shrink from their end as ends are used
    order = np.empty(n, np.int64)
    here = first
    for k in range(0, n, 2):
        order[k], order[k + 1] = here, here ^ 1
        for v in (here, here ^ 1):
            b = bucket[v]
            last = content[live[b] - 1]
            content[place[v]], content[live[b] - 1] = last, v
            place[last], place[v] = place[v], live[b] - 1
            live[b] -= 1
        at = here ^ 1
        cx, cy = bucket[at] % cells, bucket[at] // cells
        best, least = -1, np.inf
        ring = 0
        while ring <= cells and (best < 0 or (ring - 1) * size < least):
            for gy in range(cy - ring, cy + ring + 1):
                if gy < 0 or gy >= cells:
                    continue
                step = 1 if abs(gy - cy) == ring else max(1, 2 * ring)
                for gx in range(cx - ring, cx + ring + 1, step):
                    if gx < 0 or gx >= cells:
                        continue
                    b = gy * cells + gx
                    for m in range(head[b], live[b]):
                        v = content[m]
                        d = math.hypot(points[v, 0] - points[at, 0], points[v, 1] - points[at, 1])
                        if d < least:
                            least, best = d, v
            ring += 1
        here = best
    return order


@njit(cache=True)  # type: ignore[untyped-decorator]
def _gap(points: Array, a: int, b: int) -> float:
    return math.hypot(points[a, 0] - points[b, 0], points[a, 1] - points[b, 1])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _mate(order: Index, pos: Index, v: int) -> Any:
    """Return the end that `v` is linked to by travel."""
    n = len(order)
    p = pos[v]
    q = p + 1 if p % 2 else p - 1
    return order[q % n]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _reverse(order: Index, pos: Index, i: int, j: int) -> None:
    """Run the whole strokes from position i to j (cyclic) the other way; or all the others, which is the same tour."""
    n = len(order)
    inside = (j - i) % n + 1
    if 2 * inside > n:
        i, j = (j + 1) % n, (i - 1) % n
        inside = n - inside
    for _ in range(inside // 2):
        a, b = order[i], order[j]
        order[i], order[j] = b, a
        pos[b], pos[a] = i, j
        i += 1
        if i == n:
            i = 0
        j -= 1
        if j < 0:
            j = n - 1


@njit(cache=True)  # type: ignore[untyped-decorator]
def _link(points: Array, order: Index, pos: Index, log: Index, a: int, c: int) -> Any:
    """Link `a` with `c`, and their mates b and d with each other; return by how much the tour grew.

    Both must leave strokes, or both enter them. `log[0, 0]` counts the entries (a, b) after it: linking those again,
    the last first, takes everything back.
    """
    n = len(order)
    b, d = _mate(order, pos, a), _mate(order, pos, c)
    p, q = pos[a], pos[c]
    if p % 2:
        _reverse(order, pos, (p + 1) % n, q)
    else:
        _reverse(order, pos, p, (q - 1) % n)
    log[0, 0] += 1
    log[log[0, 0], 0], log[log[0, 0], 1] = a, b
    return _gap(points, a, c) + _gap(points, b, d) - _gap(points, a, b) - _gap(points, c, d)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _back_to(points: Array, order: Index, pos: Index, log: Index, kept: int) -> None:
    """Take back what the log has beyond its first `kept` entries."""
    while log[0, 0] > kept:
        at = log[0, 0]
        _link(points, order, pos, log, log[at, 0], log[at, 1])
        log[0, 0] = at - 1


@njit(cache=True)  # type: ignore[untyped-decorator]
def _chain(points: Array, near: NDArray[np.int32], order: Index, pos: Index, log: Index, t1: int, first: int) -> float:
    """Try a chain of exchanges that begins by unlinking `t1`; return by how much the tour shrank.

    Each step links the loose end t2 with a near t3 and takes t3's mate as the new loose end. The first step takes
    the near end number `first`, the further ones the most promising. Only the best prefix stays.
    """
    gained = _gap(points, t1, _mate(order, pos, t1))
    best, begun = GAIN_MM, log[0, 0]
    keep = begun
    for level in range(CHAIN_COUNT):
        t2 = _mate(order, pos, t1)
        pick, promise, seen = -1, -np.inf, 0
        for m in range(near.shape[1]):
            t3 = near[t2, m]
            left = gained - _gap(points, t2, t3)
            if left <= GAIN_MM:
                break
            if t3 == t1 or (pos[t3] - pos[t2]) % 2:
                continue
            t4 = _mate(order, pos, t3)
            tried = False
            for k in range(begun + 1, begun + level + 1):
                if log[k, 0] == t4:
                    tried = True
            if tried:
                continue
            value = left + _gap(points, t3, t4)
            if level == 0:
                if seen == first:
                    promise, pick = value, t3
                    break
                seen += 1
            elif value > promise:
                promise, pick = value, t3
        if pick < 0:
            break
        t4 = _mate(order, pos, pick)
        _link(points, order, pos, log, t2, pick)
        gained = promise
        if gained - _gap(points, t1, t4) > best:
            best, keep = gained - _gap(points, t1, t4), log[0, 0]
    _back_to(points, order, pos, log, keep)
    return best if keep > begun else 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _shift(points: Array, near: NDArray[np.int32], order: Index, pos: Index, log: Index, s: int) -> Any:
    """Try to move a run of strokes that begins at end `s` between a near end and its mate; return the gain."""
    n = len(order)
    p = _mate(order, pos, s)
    step = 1 if pos[p] % 2 else -1  # the way the run goes from s
    lost = _gap(points, p, s)
    for m in range(near.shape[1]):
        x = near[s, m]
        left = lost - _gap(points, s, x)
        if left <= GAIN_MM:
            return 0.0
        y = _mate(order, pos, x)
        for run in range(1, RUN_COUNT + 1):
            e = order[(pos[s] + step * (2 * run - 1)) % n]
            if (pos[x] - pos[s]) * step % n < 2 * run or e == y or x == p:
                break  # the run has reached the place it should go to
            nx = _mate(order, pos, e)
            gain = left + _gap(points, e, nx) + _gap(points, x, y) - _gap(points, p, nx) - _gap(points, e, y)
            if gain > GAIN_MM and nx != p:
                same = (pos[x] - pos[p]) % 2 == 0
                c = x if same else y
                _link(points, order, pos, log, p, c)
                _link(points, order, pos, log, p, nx)
                if same:
                    _link(points, order, pos, log, c, s)
                return gain
    return 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _settle(
    points: Array,
    near: NDArray[np.int32],
    order: Index,
    pos: Index,
    log: Index,
    queue: Index,
    waiting: NDArray[np.bool_],
) -> float:
    """Better the tour about the ends in the queue until none can be bettered; return the gain.

    `queue[0]` and `queue[1]` are where the ring of waiting ends begins and how many wait.
    """
    size = len(queue) - 2
    total = 0.0
    while queue[1] > 0:
        v = queue[2 + queue[0]]
        queue[0] = (queue[0] + 1) % size
        queue[1] -= 1
        waiting[v] = False
        begun = log[0, 0]
        if begun + 2 * CHAIN_COUNT + 8 > len(log):
            log[0, 0] = begun = 0  # only the first, kickless round is this long, and is never taken back
        gain = _shift(points, near, order, pos, log, v)
        for first in range(FIRST_COUNT):
            if gain == 0.0:
                gain = _chain(points, near, order, pos, log, v, first)
        if gain > 0.0:
            total += gain
            for k in range(begun + 1, log[0, 0] + 1):
                for w in (log[k, 0], log[k, 1]):
                    _await(order, pos, queue, waiting, w)
                    _await(order, pos, queue, waiting, _mate(order, pos, w))
    return total


@njit(cache=True)  # type: ignore[untyped-decorator]
def _await(order: Index, pos: Index, queue: Index, waiting: NDArray[np.bool_], v: int) -> None:
    if not waiting[v]:
        size = len(queue) - 2
        waiting[v] = True
        queue[2 + (queue[0] + queue[1]) % size] = v
        queue[1] += 1


@njit(cache=True)  # type: ignore[untyped-decorator]
def _improve(points: Array, near: NDArray[np.int32], order: Index, kicks: int, seed: int) -> None:
    """Better the tour in place."""
    n = len(order)
    np.random.seed(seed)
    pos = np.empty(n, np.int64)
    for k in range(n):
        pos[order[k]] = k
    log = np.zeros((4096, 2), np.int64)
    queue = np.zeros(n + 2, np.int64)
    waiting = np.zeros(n, np.bool_)
    length = 0.0
    for k in range(1, n, 2):
        length += _gap(points, order[k], order[(k + 1) % n])
    for _ in range(ROUNDS_COUNT):
        for v in order.copy():
            _await(order, pos, queue, waiting, v)
        gain = _settle(points, near, order, pos, log, queue, waiting)
        length -= gain
        if gain < ROUND_GAIN_RATIO * length:
            break
    strokes = n // 2
    reach = min(KICK_COUNT, (strokes - 2) // 2)
    if reach < 1:
        return
    for _ in range(kicks):
        log[0, 0] = 0
        # Two neighbouring runs change places: a double bridge, which no single chain undoes.
        i = 2 * np.random.randint(strokes) + 1
        j = (i + 2 * np.random.randint(1, reach + 1)) % n
        k = (j + 2 * np.random.randint(1, reach + 1)) % n
        p, s, e, nx, c, d = order[i], order[(i + 1) % n], order[j], order[(j + 1) % n], order[k], order[(k + 1) % n]
        grown = _link(points, order, pos, log, p, c)
        grown += _link(points, order, pos, log, p, nx)
        grown += _link(points, order, pos, log, c, s)
        for v in (p, s, e, nx, c, d):
            _await(order, pos, queue, waiting, v)
        grown -= _settle(points, near, order, pos, log, queue, waiting)
        if grown > 0.0:
            _back_to(points, order, pos, log, 0)
