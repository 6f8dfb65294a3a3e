"""A surface with one rim: its scale factors as a function of the rim's, the best rim, and the flat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError
from design.flatten.curve import close, edge_lengths_mm, tangents, trace
from design.flatten.laplace import Laplace, angle_defects, assemble, factored
from design.flatten.programme import Spread, least_spread, rim_modes, wave_numbers
from design.flatten.result import FlattenOptions, Laplacian
from design.surface import Indices, Points, TriMesh

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Disk:
    """A surface with its holes closed, the rim of what is left, and the factored operator over it."""

    mesh: TriMesh  # with fans over the holes
    count: int  # vertices that were there before
    rim: Indices
    operator: Laplace
    curvature: Values  # (n,) angle defects

    def scale_factors(self, rim_u: Values) -> Values:
        """Return u over all vertices for the rim's values: the Yamabe equation of a flat metric."""
        return self.operator.extend(rim_u, -self.curvature)


def disk(mesh: TriMesh, loops: list[Indices], kind: Laplacian) -> Disk:
    """Close the holes (all loops but the first) and factor."""
    filled = fill_holes(mesh, loops[1:])
    operator = factored(assemble(filled, kind), loops[0])
    return Disk(filled, len(mesh.vertices_mm), loops[0], operator, angle_defects(filled, loops[0]))


def fill_holes(mesh: TriMesh, holes: list[Indices]) -> TriMesh:
    """Return the mesh with every hole closed by a fan around its centroid; vertices and faces keep their numbers."""
    vertices_mm, faces = [mesh.vertices_mm], [mesh.faces]
    for number, hole in enumerate(holes):
        centre = np.full(len(hole), len(mesh.vertices_mm) + number)
        vertices_mm.append(mesh.vertices_mm[hole].mean(axis=0, keepdims=True))
        faces.append(np.column_stack([np.roll(hole, -1), hole, centre]))
    return TriMesh(np.vstack(vertices_mm), np.vstack(faces))


def hole_vertices(filled: TriMesh, count: int) -> Indices:
    """Return the vertices on and in the holes of a filled mesh that had `count` vertices before."""
    fans = filled.faces[(filled.faces >= count).any(axis=1)]
    return np.unique(fans)


def rim_u(surface: Disk, options: FlattenOptions) -> Values:
    """Return the rim's scale factors as the options ask: none, given ones, or those of least spread."""
    if options.boundary == "isometric":
        return np.zeros(len(surface.rim))
    if options.boundary == "optimised":
        return best_rim(surface, options.modes_count)[0]
    return given_u(options)[surface.rim]


def given_u(options: FlattenOptions) -> Values:
    """Return the prescribed scale factors; raises where there are none."""
    if options.boundary_u is None:
        raise FlattenError("a prescribed boundary needs `boundary_u`, one value per vertex of the mesh")
    return np.asarray(options.boundary_u, dtype=np.float64)


def best_rim(surface: Disk, modes_count: int) -> tuple[Values, Spread]:
    """Return the rim's scale factors of least spread among waves of `modes_count` modes, and the programme's answer."""
    modes = rim_modes(surface.mesh.vertices_mm, surface.rim, modes_count)
    base = surface.scale_factors(np.zeros(len(surface.rim)))[: surface.count]
    columns = surface.operator.extend(modes)[: surface.count]
    answer = least_spread(base, columns, roughness=wave_numbers(modes_count))
    return modes @ answer.choice, answer


def lay_out(surface: Disk, u: Values, twins: Indices | None = None) -> Points:
    """Return the flat `(n, 2)` whose rim has the lengths and turning that `u` asks for, its inside harmonic.

    `twins` `(b,)` names for each rim edge the rim edge that must stay as long as it (itself where none).
    """
    rim = surface.rim
    turning = surface.curvature[rim] + surface.operator.flux(u)
    before_mm = edge_lengths_mm(surface.mesh.vertices_mm, rim)
    asked_mm = before_mm * np.exp(0.5 * (u[rim] + np.roll(u[rim], -1)))
    tangent = tangents(turning)
    curve = trace(close(asked_mm, before_mm, tangent, twins=twins), tangent)
    return surface.operator.extend(np.column_stack([curve.real, curve.imag]))
