"""Cutting a surface open along edges, and finding where."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from design.errors import FlattenError
from design.findings import Finding
from design.surface import Indices, TriMesh, boundary_loops, corner_fans

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Cut:
    """A surface cut open: old vertices keep their numbers, copies come after them."""

    mesh: TriMesh
    target_index: Indices  # (n,) the vertex each was before the cut
    sides: tuple[tuple[Indices, Indices], ...]  # per chain: the copies on its left and on its right


def cut_along(mesh: TriMesh, chains: list[Indices]) -> Cut:
    """Return the mesh cut along chains of vertices that are joined by edges, and the two sides of each cut."""
    count = len(mesh.vertices_mm)
    edges = np.vstack([np.column_stack([chain[:-1], chain[1:]]) for chain in chains])
    _require_inner_edges(mesh, edges)
    fans = corner_fans(mesh.faces, count, edges)
    vertex = mesh.faces.ravel()
    pairs, back = np.unique(np.column_stack([vertex, fans.ravel()]), axis=0, return_inverse=True)
    is_copy = np.concatenate([[False], pairs[1:, 0] == pairs[:-1, 0]])
    number = np.where(is_copy, count + np.cumsum(is_copy) - 1, pairs[:, 0])
    target_index = np.concatenate([np.arange(count), pairs[is_copy, 0]])
    faces = number[back.ravel()].reshape(mesh.faces.shape)
    opened = TriMesh(mesh.vertices_mm[target_index], faces)
    return Cut(opened, target_index, tuple(_sides(mesh, faces, chain) for chain in chains))


def _require_inner_edges(mesh: TriMesh, edges: Indices) -> None:
    count = len(mesh.vertices_mm)
    tail, head = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    runs = tail * count + head
    inside = np.isin(edges[:, 0] * count + edges[:, 1], runs) & np.isin(edges[:, 1] * count + edges[:, 0], runs)
    if not inside.all():
        a, b = edges[~inside][0]
        finding = Finding("CUT-PATH", f"vertices {a} and {b} of the cut are not joined by an edge between two faces")
        raise FlattenError("the surface cannot be cut there", [finding])


def _sides(mesh: TriMesh, opened: Indices, chain: Indices) -> tuple[Indices, Indices]:
    """Return the copies of a chain on its left (faces that run along it) and on its right (faces that run against)."""
    count = len(mesh.vertices_mm)
    tail, head = mesh.faces, np.roll(mesh.faces, -1, axis=1)
    code = (tail * count + head).ravel()
    order = np.argsort(code)
    tails, heads = opened.ravel(), np.roll(opened, -1, axis=1).ravel()

    def copies(start: Indices, end: Indices) -> tuple[Indices, Indices]:
        at = order[np.searchsorted(code, start * count + end, sorter=order)]
        return tails[at], heads[at]

    left_tail, left_head = copies(chain[:-1], chain[1:])
    right_tail, right_head = copies(chain[1:], chain[:-1])
    return np.append(left_tail, left_head[-1:]), np.append(right_head, right_tail[-1:])


def shortest_chain(
    mesh: TriMesh, start: Indices, end: Indices, avoid: Indices, weights: Values | None = None
) -> Indices:
    """Return the shortest chain along edges from any vertex of `start` to any of `end`, through none of `avoid`.

    `weights` `(m, 3)` replaces edge lengths (edge k of a face joins its corners k and k + 1). Raises where none is.
    """
    count = len(mesh.vertices_mm)
    tail, head = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    if weights is None:
        cost = np.linalg.norm(mesh.vertices_mm[tail] - mesh.vertices_mm[head], axis=1)
    else:
        cost = weights.ravel()
    barred = np.zeros(count, dtype=bool)
    # A chain touches the ends only with its ends.
    barred[avoid], barred[start], barred[end] = True, True, True
    ways = np.concatenate([np.column_stack([tail, head]), np.column_stack([head, tail])])
    cost = np.concatenate([cost, cost])
    is_start, is_end = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    is_start[start], is_end[end] = True, True
    allowed = (is_start[ways[:, 0]] | ~barred[ways[:, 0]]) & (is_end[ways[:, 1]] | ~barred[ways[:, 1]])
    a, b = ways[allowed].T
    keep = np.unique(a * count + b, return_index=True)[1]
    graph = csr_array((cost[allowed][keep], (a[keep], b[keep])), shape=(count, count))
    far, before, _ = dijkstra(graph, indices=start, min_only=True, return_predecessors=True)
    goal = end[np.argmin(far[end])]
    if not np.isfinite(far[goal]):
        finding = Finding("CUT-PATH", "no way is left between the places a cut must join", hint="a finer mesh has more")
        raise FlattenError("the surface cannot be cut open", [finding])
    chain = [int(goal)]
    while not is_start[chain[-1]]:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1], dtype=np.int64)


def chain_through(mesh: TriMesh, points_mm: NDArray[np.float64]) -> Indices:
    """Return the chain of vertices along which to cut, from the rim through places on the surface, `(k, 3)`.

    The first place is taken to the nearest vertex of the rim, and so is the last where it lies within an edge or so of
    the rim; others go to their nearest vertex. Raises `FlattenError` where such a cut parts the surface.
    """
    loops = boundary_loops(mesh)
    rim = np.concatenate(loops)
    near = near_mm(mesh)
    stops = [_nearest(mesh, points_mm[0], rim)]
    for number, point in enumerate(points_mm[1:], start=2):
        at_rim = _nearest(mesh, point, rim)
        is_end = number == len(points_mm) and np.linalg.norm(mesh.vertices_mm[at_rim] - point) < near
        stops.append(at_rim if is_end else _nearest(mesh, point, np.arange(len(mesh.vertices_mm))))
    homes = [next((k for k, loop in enumerate(loops) if stop in loop), -1) for stop in stops]
    chain = np.array(stops[:1])
    for a, b in pairwise(stops):
        piece = shortest_chain(mesh, np.array([a]), np.array([b]), np.concatenate([rim, chain[:-1]]))
        chain = np.concatenate([chain, piece[1:]])
    if len(chain) < 2 or homes[0] == homes[-1] or any(home >= 0 for home in homes[1:-1]):
        text = "it must lead from the rim inwards, or from one rim to another, and meet no rim between"
        raise FlattenError("the surface cannot be cut there", [Finding("CUT-PATH", text)])
    return chain


def near_mm(mesh: TriMesh) -> float:
    """Return one and a half of the mesh's usual edge."""
    a, b = mesh.vertices_mm[mesh.faces], mesh.vertices_mm[np.roll(mesh.faces, -1, axis=1)]
    return 1.5 * float(np.median(np.linalg.norm(a - b, axis=2)))


def _nearest(mesh: TriMesh, point_mm: NDArray[np.float64], among: Indices) -> int:
    return int(among[np.argmin(np.linalg.norm(mesh.vertices_mm[among] - point_mm, axis=1))])
