"""A triangulation of the sector with one topology for all cells, morphed over (t, θ).

The sector is a chain of layers: from the centre of the inner triangle to its mouth, across the hinge, and from the
arm's mouth to the mirror edges. Each layer is a polyline with a fixed number of segments, so the connectivity, the
unknowns and the matrix structure are found once, and results vary smoothly with the cell.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import Sector

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Density:
    """How finely the sector is cut up; the default is the reference mesh, 0.25 mm at the hinge.

    `inner` counts the segments of each layer of the inner triangle, from the mouth to the centre (the last is even: its
    middle is the centre). The hinge is `inner[0]` segments wide and `along` layers long. The arm has `columns` layers
    from its start (mouth and slit 2) to the edge V0V2, each of `rows` segments, the mouth's among them.
    """

    inner: tuple[int, ...] = (1, 3, 4, 4)
    along: int = 1
    rows: int = 4
    columns: int = 8
    first_mm: float = 0.25  # thickness of the layers next to the hinge

    def refined(self, factor: int) -> Density:
        """Return the density with every segment and layer cut in `factor`."""
        inner = (self.inner[0], *(c for c in self.inner[1:] for _ in range(factor)))
        return Density(
            tuple(c * factor for c in inner),
            self.along * factor,
            self.rows * factor,
            self.columns * factor,
            self.first_mm / factor,
        )


REFERENCE = Density()


def fitting(part: Sector, density: Density) -> Density:
    """Return `density`, or its likeness for a sector without an inner triangle."""
    if not part.blunt:
        return density
    mouth = 4 * density.rows // REFERENCE.rows
    return Density((mouth,), density.along, mouth + density.rows, density.columns, density.first_mm)


@dataclass(frozen=True, slots=True)
class Topology:
    """What all sectors of one density share. P2: vertices first, then the midpoints of `edges`."""

    triangles: Ints  # (m, 3) vertices
    edges: Ints  # (e, 2) vertices of each midpoint node
    elements: Ints  # (m, 6) nodes: three vertices, then midpoints of 01, 12, 20
    vertex_count: int
    layers: tuple[Ints, ...]  # vertices of each layer, centre first
    centre: int
    corner: int
    bottom: Ints  # nodes on V0V1, without the corner
    left: Ints  # nodes on V0V2, without the corner
    cut: Ints  # nodes from the centre (excluded) to the cut
    cut_turned: Ints  # their images under the turn by 120°

    @property
    def node_count(self) -> int:
        """Return the number of P2 nodes."""
        return self.vertex_count + len(self.edges)


@functools.lru_cache(maxsize=8)
def topology(density: Density) -> Topology:
    """Return the connectivity for `density`; pure combinatorics, no coordinates."""
    counts = _layer_counts(density)
    starts = np.concatenate([[0], np.cumsum([c + 1 for c in counts])])
    layers = tuple(np.arange(starts[k], starts[k] + c + 1) for k, c in enumerate(counts))
    mouth, hinge_end = density.inner[0], len(density.inner) + density.along - 1
    # The hinge meets only the mouth, the first segments of the arm's first layer.
    lower = [layer[: mouth + 1] if k == hinge_end else layer for k, layer in enumerate(layers)]
    triangles = np.array([tri for k in range(len(counts) - 1) for tri in _zip(layers[k], lower[k + 1], k < hinge_end)])
    number: dict[tuple[int, int], int] = {}
    middle = np.empty_like(triangles)
    for row, tri in enumerate(triangles):
        for side in range(3):
            pair = sorted((int(tri[side]), int(tri[(side + 1) % 3])))
            middle[row, side] = number.setdefault((pair[0], pair[1]), len(number))
    vertex_count = int(starts[-1])
    elements = np.hstack([triangles, middle + vertex_count])
    first, last = layers[0], layers[-1]
    half = len(first) // 2

    def chain(vertices: Ints) -> list[int]:
        """Return vertices after the first, each preceded by the midpoint that leads to it."""
        nodes: list[int] = []
        for a, b in itertools.pairwise(vertices):
            nodes += [vertex_count + number[min(a, b), max(a, b)], int(b)]
        return nodes

    edge_V0V1 = np.array([layer[-1] for layer in layers[hinge_end:]])[::-1]
    return Topology(
        triangles=triangles,
        edges=np.array(list(number)),
        elements=elements,
        vertex_count=vertex_count,
        layers=layers,
        centre=int(first[half]),
        corner=int(last[-1]),
        bottom=np.array(chain(edge_V0V1)),
        left=np.array(chain(last[::-1])),
        cut=np.array(chain(first[half::-1])),
        cut_turned=np.array(chain(first[half:])),
    )


def _layer_counts(density: Density) -> list[int]:
    mouth = density.inner[0]
    if density.inner[-1] % 2 or density.rows <= mouth:
        raise ValueError(f"layers do not fit together: {density}")
    return [*density.inner[::-1], *[mouth] * (density.along - 1), *[density.rows] * (density.columns + 1)]


def _zip(upper: Ints, lower: Ints, inner: bool) -> list[tuple[int, int, int]]:
    """Return the triangles between two polylines that run from slit 1 to slit 2, counter-clockwise.

    The first diagonal starts from the tip of slit 1, which is the lower polyline's on the inner side: the widest angle
    is split.
    """
    i = j = 0
    turn = 0 if inner else 1
    n, m = len(upper) - 1, len(lower) - 1
    triangles = []
    while i < n or j < m:
        # Advance on the side whose next point comes first; ties alternate so that diagonals balance.
        ahead = (i + 1) * m - (j + 1) * n
        if j == m or (i < n and (ahead < 0 or (ahead == 0 and (i + j) % 2 == turn))):
            triangles.append((int(upper[i]), int(lower[j]), int(upper[i + 1])))
            i += 1
        else:
            triangles.append((int(upper[i]), int(lower[j]), int(lower[j + 1])))
            j += 1
    return triangles


def vertices_mm(part: Sector, density: Density) -> Array:
    """Return the vertices of the sector's mesh in the order of `topology(density)`, (vertex_count, 2)."""
    inner = _inner_layers(part, density)
    arm = _arm_layers(part, density)
    mouth = arm[0][: density.inner[0] + 1]
    hinge = [inner[0] + k / density.along * (mouth - inner[0]) for k in range(1, density.along)]
    return np.vstack([*inner[::-1], *hinge, *arm])


def nodes_mm(vertices: Array, density: Density) -> Array:
    """Return all P2 nodes, the midpoints on straight edges, (node_count, 2)."""
    edges = topology(density).edges
    return np.vstack([vertices, 0.5 * (vertices[edges[:, 0]] + vertices[edges[:, 1]])])


def _between(a: Array, b: Array, shares: Array) -> Array:
    return np.asarray(a + shares[:, None] * (b - a))


def _inner_layers(part: Sector, density: Density) -> list[Array]:
    """Return the layers of the inner triangle's third, from its mouth to the centre, on straight rays."""
    layers = []
    steps = len(density.inner) - 1
    if steps == 0:
        at, knots = [0, 0.5, 1], np.array([part.cut, part.centre, part.cut_turned])
        q = np.linspace(0.0, 1.0, density.inner[0] + 1)
        return [np.column_stack([np.interp(q, at, knots[:, i]) for i in (0, 1)])]
    for k, count in enumerate(density.inner):
        q = np.linspace(0.0, 1.0, count + 1)
        near = _between(part.tip_inner, part.foot_inner, q)
        ray = np.column_stack(
            [np.interp(q, [0, 0.5, 1], [part.cut[i], part.centre[i], part.cut_turned[i]]) for i in (0, 1)]
        )
        length_mm = np.linalg.norm(ray - near, axis=1)
        share = np.array([graded(length, density.first_mm, steps)[k] for length in length_mm])
        layers.append(near + share[:, None] * (ray - near))
    return layers


def _arm_layers(part: Sector, density: Density) -> list[Array]:
    """Return the arm's layers: straight rungs between slit 1 and the edge V0V1, bent into the start's shape near it."""
    mouth, rows, columns = density.inner[0], density.rows, density.columns
    wall_mm = float(np.linalg.norm(part.bottom - part.foot_arm))
    width_mm = float(np.linalg.norm(part.foot_arm - part.tip_outer))
    start = np.vstack(
        [
            _between(part.tip_outer, part.foot_arm, np.linspace(0, 1, mouth + 1)),
            _between(part.foot_arm, part.bottom, graded(wall_mm, density.first_mm, rows - mouth)[1:]),
        ]
    )
    slit_mm = float(np.linalg.norm(part.left - part.tip_outer))
    edge_mm = float(np.linalg.norm(part.bottom - part.corner))
    upper = _between(part.tip_outer, part.left, graded(slit_mm, density.first_mm, columns))
    first_mm = max(density.first_mm, 0.5 * wall_mm / density.columns)
    lower = _between(part.bottom, part.corner, graded(edge_mm, first_mm, columns))
    straight = np.concatenate(
        [np.linspace(0, width_mm, mouth + 1), width_mm + np.linalg.norm(start[mouth + 1 :] - part.foot_arm, axis=1)]
    )
    straight /= straight[-1]
    bend = start - _between(part.tip_outer, part.bottom, straight)
    even = np.linspace(0, 1, rows + 1)
    layers = []
    for k, share in enumerate(np.linspace(0, 1, columns + 1)):
        layers.append(_between(upper[k], lower[k], (1 - share) * straight + share * even) + (1 - share) ** 2 * bend)
    return layers


def graded(length_mm: float, first_mm: float, steps: int) -> Array:
    """Return fractions 0 to 1 in `steps` growing steps, (steps + 1,), the first `first_mm` where the length allows."""
    wanted = max(length_mm / first_mm, steps)
    low, high = 1.0, max(wanted, 1.0)
    for _ in range(60):  # bisection on the growth ratio: the sum of a geometric series is monotone
        ratio = 0.5 * (low + high)
        if sum(ratio**i for i in range(steps)) < wanted:
            low = ratio
        else:
            high = ratio
    sizes = (0.5 * (low + high)) ** np.arange(steps)
    return np.concatenate([[0.0], np.cumsum(sizes) / sizes.sum()])
