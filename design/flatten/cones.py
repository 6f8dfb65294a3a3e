"""Cone singularities: a few points where the flat's angle is less than a full turn, with a seam from each to the rim.

The scale factors are affine in the angles taken out, too, so the same linear programme chooses them; where the next
cone helps most is read from its dual: one solve with the proof's weights gives what a cone would gain, everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.flatten.cut import shortest_chain
from design.flatten.disk import Disk, hole_vertices
from design.flatten.programme import Spread, least_spread, rim_modes, wave_numbers
from design.surface import Indices

Values = NDArray[np.float64]
LARGEST_rad = 1.5 * np.pi  # angle a cone may take out; the wedge left must still hold cells
NEAR_ratio = 0.06  # of the diagonal: nearer than that to the rim or another cone a cone is no use


@dataclass(frozen=True, slots=True)
class Cones:
    """Where the cones are, how much angle each takes out, and the scale factors that go with them."""

    vertices: Indices
    angles_rad: Values
    u: Values  # (n,) over the filled mesh
    answer: Spread


def place_cones(surface: Disk, cones_count: int, modes_count: int) -> Cones:
    """Return up to `cones_count` cones, chosen one after the other where the programme gains most, and the rim's u."""
    operator, n = surface.operator, surface.count
    modes = rim_modes(surface.mesh.vertices_mm, surface.rim, modes_count)
    base = surface.scale_factors(np.zeros(len(surface.rim)))
    columns = operator.extend(modes)
    chosen: list[int] = []
    roughness = list(wave_numbers(modes_count))
    while True:
        limits: list[tuple[float | None, float | None]] = [(None, None)] * modes_count
        limits += [(0.0, LARGEST_rad)] * len(chosen)
        weight = np.array(roughness + [0.0] * len(chosen))
        answer = least_spread(base[:n], columns[:n], limits, roughness=weight)
        if len(chosen) == cones_count or (vertex := _most_useful(surface, answer.proof, chosen)) is None:
            break
        chosen.append(vertex)
        columns = np.column_stack([columns, _green(surface, vertex)])
    return Cones(
        np.array(chosen, dtype=np.int64),
        answer.choice[modes_count:],
        base + columns @ answer.choice,
        answer,
    )


def _green(surface: Disk, vertex: int) -> Values:
    """Return what one rad of angle taken out at `vertex` adds to u."""
    source = np.zeros(len(surface.mesh.vertices_mm))
    source[vertex] = 1.0
    return surface.operator.extend(np.zeros(len(surface.rim)), source)


def _most_useful(surface: Disk, proof: Values, chosen: list[int]) -> int | None:
    """Return the vertex where a cone lowers the bound fastest: the proof's weights, spread by the Green's function."""
    weights = np.zeros(len(surface.mesh.vertices_mm))
    weights[: surface.count] = proof
    gain = -surface.operator.extend(np.zeros(len(surface.rim)), weights)
    points = surface.mesh.vertices_mm
    holes = hole_vertices(surface.mesh, surface.count)
    near_mm = NEAR_ratio * surface.mesh.diagonal_mm()
    taken = points[np.concatenate([surface.rim, holes, np.array(chosen, dtype=np.int64)])]
    gain[_distances_mm(points, taken) < near_mm] = 0
    best = int(gain.argmax())
    return best if gain[best] > 1e-6 else None


def _distances_mm(points_mm: Values, to_mm: Values) -> Values:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(to_mm).query(points_mm)[0])


def seams_of(surface: Disk, cones: Indices) -> list[Indices]:
    """Return a chain of vertices from each cone to the rim, none touching another."""
    taken = hole_vertices(surface.mesh, surface.count)
    chains = []
    for number, cone in enumerate(cones):
        others = np.delete(cones, number)
        avoid = np.concatenate([taken, others])
        chain = shortest_chain(surface.mesh, np.array([cone]), np.setdiff1d(surface.rim, taken), avoid)
        chains.append(chain)
        taken = np.concatenate([taken, chain])
    return chains
