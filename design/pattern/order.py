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

from design.pattern.nearest_ends import nearest_ends
from design.pattern.tiling import Array, Index

NEAR_COUNT = 8  # neighbours looked at from every stroke end
CHAIN_COUNT = 25  # links exchanged in one chain at most
FIRST_COUNT = 5  # ways tried at a chain's first link
ROUNDS_COUNT, ROUND_GAIN_RATIO = 5, 0.004  # all ends are looked at again while a round still gains this much
RUN_COUNT = 3  # strokes moved together at most
KICK_COUNT = 30  # strokes in a run that a kick moves at most
KICK_CHAIN_COUNT, KICK_FIRST_COUNT = 6, 2  # the same while a kick is repaired
KICK_REACH_COUNT = 1000  # ends turned around in one exchange while a kick is repaired: more costs more than it gains
KICKS_LIMIT_COUNT = 3000  # half a second, on 20,000 strokes a fifth of the whole
# Ends turned around, three seconds' work; then chains reach no farther than a kick's repair. Not timed, but counted:
TURNED_LIMIT_COUNT = 2_500_000_000  # the same strokes have the same order on every machine.
GAIN_MM = 1e-7  # less is rounding


def tour(
    ends_mm: Array, start_mm: tuple[float, float] = (0.0, 0.0), kicks_count: int | None = None, seed: int = 0,
    turned_limit_count: int = TURNED_LIMIT_COUNT,
) -> Index:  # fmt: skip
    """Return the strokes' ends in the order they are met, `(2n,)`: stroke k has the ends 2k and 2k + 1.

    `ends_mm` is `(2n, 2)`. The tour leaves from `start_mm` and comes back to it. `kicks_count` None means as many as
    pay off for the number of strokes; 0 leaves the local search's result.
    """
    count = len(ends_mm) // 2
    if count < 2:
        return np.arange(2 * count)
    home = np.tile(np.asarray(start_mm, dtype=np.float64), (2, 1))
    points = np.ascontiguousarray(np.vstack([ends_mm, home]))
    # Numbered as the first tour meets them, ends that are looked at together lie together in memory.
    first = nearest_ends(points, 2 * count)
    points = np.ascontiguousarray(points[first])
    order = np.arange(len(first))
    kicks = kicks_count if kicks_count is not None else min(10 * count, KICKS_LIMIT_COUNT)
    _improve(points, _near(points), order, kicks, seed, turned_limit_count)
    order = first[order]
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
    return np.asarray(nearest_ends(np.ascontiguousarray(np.vstack([ends_mm, home])), len(ends_mm))[2:])


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
def _gap(points: Array, a: int, b: int) -> float:
    return math.hypot(points[a, 0] - points[b, 0], points[a, 1] - points[b, 1])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _mate(order: Index, pos: Index, v: int) -> Any:
    """Return the end that `v` is linked to by travel."""
    n = len(order)
    p = pos[v]
    q = p + 1 if p & 1 else p - 1
    return order[0 if q == n else n - 1 if q < 0 else q]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _reverse(order: Index, pos: Index, i: int, j: int) -> Any:
    """Turn the whole strokes from position i to j (cyclic) around, or all others: the same tour; return how many."""
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
    return inside


@njit(cache=True)  # type: ignore[untyped-decorator]
def _link(points: Array, order: Index, pos: Index, log: Index, a: int, c: int) -> Any:
    """Link `a` with `c`, and their mates b and d with each other; return by how much the tour grew.

    Both must leave strokes, or both enter them. `log[0, 0]` counts the entries (a, b) after it: linking those again,
    the last first, takes everything back. `log[0, 1]` counts down the ends that may still be turned at length.
    """
    n = len(order)
    b, d = _mate(order, pos, a), _mate(order, pos, c)
    p, q = pos[a], pos[c]
    log[0, 1] -= _reverse(order, pos, (p + 1) % n, q) if p % 2 else _reverse(order, pos, p, (q - 1) % n)
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
def _was_added(log: Index, begun: int, a: int, b: int) -> bool:
    """Say whether one end of a link was already moved in this chain: what was just linked is not unlinked again."""
    found = False
    for k in range(begun + 1, log[0, 0] + 1):
        found |= log[k, 0] == a or log[k, 0] == b
    return found


@njit(cache=True)  # type: ignore[untyped-decorator]
def _offer(top: Array, ends: Index, value: float, t3: int, t5: int) -> None:
    """Keep an exchange among the most promising, best first."""
    k = FIRST_COUNT - 1
    if value <= top[k]:
        return
    while k > 0 and top[k - 1] < value:
        top[k], ends[k, 0], ends[k, 1] = top[k - 1], ends[k - 1, 0], ends[k - 1, 1]
        k -= 1
    top[k], ends[k, 0], ends[k, 1] = value, t3, t5


@njit(cache=True)  # type: ignore[untyped-decorator]
def _exchanges(
    points: Array, near: NDArray[np.int32], order: Index, pos: Index, log: Index, begun: int, t1: int,
    gained: float, reach: int, top: Array, ends: Index,
) -> None:  # fmt: skip
    """Find the most promising exchanges that go on from the loose ends t1 and its mate t2.

    A near t3 that is met the same way as t2 takes one exchange: its mate t4 becomes the loose end. One that is met the
    other way would close t2 … t3 to a ring; the ring is opened again at a t5 near t4, whose mate becomes the loose end.
    The last row is the exchange that gains most when the loose ends are linked at once, and that gain.
    """
    n = len(order)
    top[:] = -np.inf
    t2 = _mate(order, pos, t1)
    step = 1 if pos[t1] & 1 else -1  # the way that leads from t2 away from t1
    for m in range(near.shape[1]):
        t3 = near[t2, m]
        left = gained - _gap(points, t2, t3)
        if left <= GAIN_MM:
            return
        t4 = _mate(order, pos, t3)
        if t3 == t1 or _was_added(log, begun, t3, t4):
            continue
        span = (pos[t3] - pos[t2]) * step
        if span < 0:
            span += n
        value = left + _gap(points, t3, t4)
        if span & 1 == 0:
            if min(span, n - span) <= reach:
                _offer(top, ends, value, t3, -1)
                closed = value - _gap(points, t1, t4)
                if closed > top[FIRST_COUNT]:
                    top[FIRST_COUNT], ends[FIRST_COUNT, 0], ends[FIRST_COUNT, 1] = closed, t3, -1
            continue
        if span > reach:
            continue
        for k in range(near.shape[1]):
            t5 = near[t4, k]
            rest = value - _gap(points, t4, t5)
            if rest <= GAIN_MM:
                break
            inward = (pos[t5] - pos[t2]) * step
            if inward < 0:
                inward += n
            if not 0 < inward < span:
                continue
            t6 = _mate(order, pos, t5)
            if not _was_added(log, begun, t5, t6):
                promise = rest + _gap(points, t5, t6)
                _offer(top, ends, promise, t3, t5)
                closed = promise - _gap(points, t1, t6)
                if closed > top[FIRST_COUNT]:
                    top[FIRST_COUNT], ends[FIRST_COUNT, 0], ends[FIRST_COUNT, 1] = closed, t3, t5


@njit(cache=True)  # type: ignore[untyped-decorator]
def _exchange(points: Array, order: Index, pos: Index, log: Index, t1: int, t3: int, t5: int) -> None:
    """Make the exchange: t2 is linked with t3, and where there is a t5, t4 with it; t1 with what is loose then."""
    t2 = _mate(order, pos, t1)
    if t5 < 0:
        _link(points, order, pos, log, t2, t3)
        return
    t6 = _mate(order, pos, t5)
    if (pos[t5] - pos[t2]) % 2 == 0:  # both parts of the ring run the other way
        _link(points, order, pos, log, t1, t6)
        _link(points, order, pos, log, t2, t3)
    else:  # they change places
        _link(points, order, pos, log, t1, t3)
        _link(points, order, pos, log, t1, t6)
        _link(points, order, pos, log, t3, t2)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _chain(
    points: Array, near: NDArray[np.int32], order: Index, pos: Index, log: Index, t1: int, first: int, reach: int,
    chain: int, top: Array, ends: Index,
) -> float:  # fmt: skip
    """Try a chain of exchanges that begins by unlinking `t1`; return by how much the tour shrank.

    The first step takes the exchange number `first`, the further ones the most promising. Only the best prefix stays.
    """
    gained = _gap(points, t1, _mate(order, pos, t1))
    best, begun = GAIN_MM, log[0, 0]
    keep = begun
    for level in range(chain):
        _exchanges(points, near, order, pos, log, begun, t1, gained, reach, top, ends)
        pick = first if level == 0 else 0
        if top[pick] == -np.inf:
            break
        gained = top[pick]
        _exchange(points, order, pos, log, t1, ends[pick, 0], ends[pick, 1])
        closing = _gap(points, t1, _mate(order, pos, t1))
        if gained - closing > best:
            best, keep = gained - closing, log[0, 0]
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
    reach: int,
    chain: int,
    firsts: int,
) -> float:
    """Better the tour about the ends in the queue until none can be bettered; return the gain.

    No exchange turns around more than `reach` ends; `chain` exchanges make one chain at most, begun in `firsts` ways.

    `queue[0]` and `queue[1]` are where the ring of waiting ends begins and how many wait.
    """
    size = len(queue) - 2
    total = 0.0
    top, ends = np.empty(FIRST_COUNT + 1), np.empty((FIRST_COUNT + 1, 2), np.int64)
    while queue[1] > 0:
        v = queue[2 + queue[0]]
        queue[0] = (queue[0] + 1) % size
        queue[1] -= 1
        waiting[v] = False
        begun = log[0, 0]
        if begun + 3 * CHAIN_COUNT + 8 > len(log):
            log[0, 0] = begun = 0  # only the first, kickless round is this long, and is never taken back
        gain = _shift(points, near, order, pos, log, v)
        if gain == 0.0:
            unlinked = _gap(points, v, _mate(order, pos, v))
            _exchanges(points, near, order, pos, log, begun, v, unlinked, reach, top, ends)
            if top[FIRST_COUNT] > GAIN_MM:
                gain = top[FIRST_COUNT]
                _exchange(points, order, pos, log, v, ends[FIRST_COUNT, 0], ends[FIRST_COUNT, 1])
        far = reach if log[0, 1] > 0 else min(reach, KICK_REACH_COUNT)
        for first in range(firsts):
            if gain == 0.0:
                gain = _chain(points, near, order, pos, log, v, first, far, chain, top, ends)
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
def _improve(points: Array, near: NDArray[np.int32], order: Index, kicks: int, seed: int, turned_limit: int) -> None:
    """Better the tour in place."""
    n = len(order)
    np.random.seed(seed)
    pos = np.empty(n, np.int64)
    for k in range(n):
        pos[order[k]] = k
    log = np.zeros((16384, 2), np.int64)
    log[0, 1] = turned_limit
    queue = np.zeros(n + 2, np.int64)
    waiting = np.zeros(n, np.bool_)
    length = 0.0
    for k in range(1, n, 2):
        length += _gap(points, order[k], order[(k + 1) % n])
    for _ in range(ROUNDS_COUNT):
        for v in order.copy():
            _await(order, pos, queue, waiting, v)
        gain = _settle(points, near, order, pos, log, queue, waiting, n, CHAIN_COUNT, FIRST_COUNT)
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
        grown -= _settle(
            points, near, order, pos, log, queue, waiting, KICK_REACH_COUNT, KICK_CHAIN_COUNT, KICK_FIRST_COUNT
        )
        if grown > 0.0:
            _back_to(points, order, pos, log, 0)
