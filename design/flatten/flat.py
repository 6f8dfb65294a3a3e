"""Boundary-first flattening (Sawhney, Crane 2017): a surface in, its conformal flat out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError
from design.findings import Finding, errors
from design.flatten.curve import close, tangents, trace
from design.flatten.laplace import Laplace, angle_defects, laplace
from design.flatten.quality import check_flat, signed_areas_mm2
from design.flatten.result import Flattening, FlattenOptions
from design.surface import Indices, Points, TriMesh, boundary_loops

Values = NDArray[np.float64]
DEFAULTS = FlattenOptions()


def flatten(mesh: TriMesh, options: FlattenOptions = DEFAULTS) -> Flattening:
    """Return the surface laid flat, as conformally as its mesh allows; the flat's scale is the rim's own.

    `mesh` must be one oriented manifold piece with a boundary (`read_mesh` sees to that); holes are closed for the
    computation and open again afterwards. Raises `FlattenError` with all findings where the flat has flipped faces or
    overlaps itself.
    """
    loops = boundary_loops(mesh)
    if not loops:
        raise FlattenError("the surface is closed; a sheet has an edge")
    filled = fill_holes(mesh, loops[1:])
    flat_mm, u = _lay_disk(filled, loops[0], options)
    count = len(mesh.vertices_mm)
    found = check_flat(mesh, flat_mm[:count], mesh.faces, loops)
    if errors(found) and options.laplacian == "cotangent":
        # Obtuse triangles make the plain Laplacian lose the maximum principle; the intrinsic one keeps it.
        flat_mm, u = _lay_disk(filled, loops[0], _with_delaunay(options))
        again = check_flat(mesh, flat_mm[:count], mesh.faces, loops)
        found = [*again, Finding("FLAT-DELAUNAY", "badly shaped faces: the intrinsic Laplacian was used", "info")]
    if errors(found):
        raise FlattenError("the surface could not be laid flat", found)
    return finish(mesh, flat_mm[:count], u[:count], found)


def finish(mesh: TriMesh, flat_mm: Points, u: Values, found: list[Finding]) -> Flattening:
    """Return the flattening of a mesh without seams."""
    expansion_ratio = np.sqrt(mesh.face_areas_mm2() / np.abs(signed_areas_mm2(flat_mm, mesh.faces)))
    return Flattening(mesh, flat_mm, mesh.faces, np.arange(len(flat_mm)), expansion_ratio, u, (), tuple(found))


def fill_holes(mesh: TriMesh, holes: list[Indices]) -> TriMesh:
    """Return the mesh with every hole closed by a fan around its centroid; vertices and faces keep their numbers."""
    vertices_mm, faces = [mesh.vertices_mm], [mesh.faces]
    for number, hole in enumerate(holes):
        centre = np.full(len(hole), len(mesh.vertices_mm) + number)
        vertices_mm.append(mesh.vertices_mm[hole].mean(axis=0, keepdims=True))
        faces.append(np.column_stack([np.roll(hole, -1), hole, centre]))
    return TriMesh(np.vstack(vertices_mm), np.vstack(faces))


def _with_delaunay(options: FlattenOptions) -> FlattenOptions:
    return FlattenOptions(options.boundary, options.boundary_u, "delaunay")


def _lay_disk(mesh: TriMesh, border: Indices, options: FlattenOptions) -> tuple[Points, Values]:
    """Return flat points `(n, 2)` and scale factors `(n,)` of a disk whose boundary loop is `border`."""
    operator = laplace(mesh, border, options.laplacian)
    curvature = angle_defects(mesh, border)
    u = operator.extend(_border_u(border, options), -curvature)
    return lay_out(mesh, operator, curvature, u), u


def _border_u(border: Indices, options: FlattenOptions) -> Values:
    if options.boundary == "isometric":
        return np.zeros(len(border))
    if options.boundary_u is None:
        raise FlattenError("a prescribed boundary needs `boundary_u`, one value per vertex of the mesh")
    return np.asarray(options.boundary_u[border], dtype=np.float64)


def lay_out(mesh: TriMesh, operator: Laplace, curvature: Values, u: Values) -> Points:
    """Return the flat `(n, 2)` whose rim has the lengths and turning that `u` asks for, its inside harmonic."""
    border = operator.border
    turning = curvature[border] + operator.flux(u)
    before = edge_lengths_mm(mesh.vertices_mm, border)
    asked = before * np.exp(0.5 * (u[border] + np.roll(u[border], -1)))
    tangent = tangents(turning)
    rim = trace(close(asked, before, tangent), tangent)
    return operator.extend(np.column_stack([rim.real, rim.imag]))


def edge_lengths_mm(vertices_mm: Points, loop: Indices) -> Values:
    """Return the length of the edge that leaves each vertex of a loop."""
    points = vertices_mm[loop]
    return np.asarray(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))
