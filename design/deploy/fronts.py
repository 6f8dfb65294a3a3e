"""Factorise a sheet's positive Hessian front by front, with the order found once for all Newton steps.

Nested dissection (George 1973): the sheet is halved again and again, the vertices between two halves are eliminated
after both. What couples them is a dense matrix, a front (Duff and Reid 1983), so the work is done by LAPACK. A front
that has no Cholesky factor says that the whole matrix is not positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf

from design.deploy.shell import Ints, Reals

LEAF_COUNT = 40  # vertices that are not halved further: fewer cost more calls, more cost more arithmetic


@dataclass(frozen=True, slots=True)
class Front:
    """Vertices eliminated together, and what is known of them before any number is.

    `own` are the degrees of freedom eliminated here, `rim` those later ones that they touch. Entry `source` of the
    matrix's data goes to `place` of the panel `(own + rim, own)`, column after column.
    """

    own: Ints
    rim: Ints
    source: Ints
    place: Ints
    children: tuple[int, ...]
    into: tuple[Ints, ...]  # where each child's rim lies in own and rim


def dissected(graph: sp.csr_matrix, x_mm: Reals) -> tuple[list[Ints], list[tuple[int, ...]]]:
    """Return groups of vertices in the order of elimination, and the earlier groups that each waits for.

    `graph` says which vertices are coupled; where they are, `x_mm` `(n, 3)`, only decides how much work it will be.
    """
    groups: list[Ints] = []
    waits: list[tuple[int, ...]] = []

    def keep(group: Ints, after: tuple[int, ...]) -> tuple[int, ...]:
        if not len(group):
            return after
        groups.append(group)
        waits.append(after)
        return (len(groups) - 1,)

    def halve(group: Ints) -> tuple[int, ...]:
        if len(group) <= LEAF_COUNT:
            return keep(group, ())
        at = x_mm[group]
        along = at[:, int(np.argmax(np.ptp(at, axis=0)))]
        order = np.argsort(along, kind="stable")
        low, high = group[order[: len(group) // 2]], group[order[len(group) // 2 :]]
        beyond = np.zeros(graph.shape[0])
        beyond[high] = 1.0
        between = graph[low] @ beyond > 0
        return keep(low[between], halve(low[~between]) + halve(high))

    halve(np.arange(graph.shape[0]))
    return groups, waits


def planned(indptr: Ints, indices: Ints, x_mm: Reals) -> list[Front]:
    """Return the fronts of a symmetric matrix of three degrees of freedom a vertex, by its pattern (compressed)."""
    n = len(x_mm)
    column = np.repeat(np.arange(3 * n) // 3, np.diff(indptr))
    graph = sp.csr_matrix((np.ones(len(column)), (indices // 3, column)), shape=(n, n))
    groups, waits = dissected(graph, x_mm)
    rank = np.empty(n, dtype=np.int64)
    rank[np.concatenate(groups)] = np.arange(n)
    place_of = np.empty(n, dtype=np.int64)
    fronts: list[Front] = []
    rims: list[Ints] = []
    for group, after in zip(groups, waits, strict=True):
        near = np.unique(np.concatenate([graph[group].indices, *(rims[k] for k in after)]))
        rim = near[rank[near] > rank[group[-1]]]
        rim = rim[np.argsort(rank[rim])]
        rims.append(rim)
        place_of[group], place_of[rim] = np.arange(len(group)), len(group) + np.arange(len(rim))
        into = tuple(_threefold(place_of[rims[k]]) for k in after)
        own = _threefold(group)
        source, place = _entries(indptr, indices, own, 3 * (len(group) + len(rim)), rank, place_of)
        fronts.append(Front(own, _threefold(rim), source, place, after, into))
    return fronts


def _threefold(vertices: Ints) -> Ints:
    return np.asarray((3 * vertices[:, None] + np.arange(3)).ravel())


def _entries(indptr: Ints, indices: Ints, own: Ints, height: int, rank: Ints, place_of: Ints) -> tuple[Ints, Ints]:
    """Return which entries of the matrix belong to a front's panel, and where they go in it."""
    count = np.diff(indptr)[own]
    start = np.repeat(indptr[own] - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
    source = start + np.arange(len(start))
    column = np.repeat(np.arange(len(own)), count)
    row = indices[source]
    local = 3 * place_of[row // 3] + row % 3
    lower = (rank[row // 3] >= rank[own[0] // 3]) & (local >= column)
    return source[lower], (column * height + local)[lower]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _gather(into: Ints, child: Reals, panel: Reals, corner: Reals) -> None:
    """Add a child's lower triangle to the panel `(own + rim, own)` and to the rim's corner `(rim, rim)`."""
    own = panel.shape[1]
    for j in range(len(into)):
        column = into[j]
        for i in range(j, len(into)):
            if column < own:
                panel[into[i], column] += child[i, j]
            else:
                corner[into[i] - own, column - own] += child[i, j]


class Cholesky:
    """A factorised positive matrix."""

    def __init__(self, fronts: list[Front], factors: list[tuple[Reals, Reals]]) -> None:
        self._fronts, self._factors = fronts, factors

    def solve(self, right: Reals) -> Reals:
        """Return the solution for one right side `(n,)` or several `(n, k)`."""
        x = np.array(right, dtype=float).reshape(len(right), -1)
        for front, (first, rest) in zip(self._fronts, self._factors, strict=True):
            x[front.own] = dtrsm(1.0, first, x[front.own], lower=1)
            x[front.rim] -= rest @ x[front.own]
        for front, (first, rest) in zip(self._fronts[::-1], self._factors[::-1], strict=True):
            x[front.own] = dtrsm(1.0, first, x[front.own] - rest.T @ x[front.rim], lower=1, trans_a=1)
        return x.reshape(np.shape(right))


def cholesky(fronts: list[Front], data: Reals) -> Cholesky | None:
    """Return the factorisation of the matrix with these entries, None where it is not positive."""
    factors: list[tuple[Reals, Reals]] = []
    waiting: dict[int, Reals] = {}
    for k, front in enumerate(fronts):
        own, rim = len(front.own), len(front.rim)
        panel = np.zeros((own + rim, own), order="F")
        panel.T.reshape(-1)[front.place] = data[front.source]
        corner = np.zeros((rim, rim), order="F")
        for child, into in zip(front.children, front.into, strict=True):
            _gather(into, waiting.pop(child), panel, corner)
        first, fault = dpotrf(panel[:own], lower=1, clean=0)
        if fault:
            return None
        rest = dtrsm(1.0, first, panel[own:], side=1, lower=1, trans_a=1)
        if rim:
            waiting[k] = dsyrk(-1.0, rest, beta=1.0, c=corner, lower=1, overwrite_c=1)
        factors.append((first, rest))
    return Cholesky(fronts, factors)
