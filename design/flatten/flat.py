"""Boundary-first flattening (Sawhney, Crane 2017): a surface in, its conformal flat out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError, NotConverged
from design.findings import Finding, errors
from design.flatten.cones import place_cones, seams_of
from design.flatten.cut import Cut, cut_along
from design.flatten.disk import disk, lay_out, rim_u
from design.flatten.given import given_flat
from design.flatten.quality import check_flat, signed_areas_mm2
from design.flatten.result import Flattening, FlattenOptions, Seam
from design.flatten.rims import lay_rims, rims, rims_u
from design.flatten.tube import lay_strip, tube, tube_scale_factors
from design.surface import Faces, Indices, Points, TriMesh, boundary_loops

Values = NDArray[np.float64]
DEFAULTS = FlattenOptions()
TUBE_ABOVE_ratio = 2.0  # a spread beyond any library: rather a seam than a filled hole


def flatten(mesh: TriMesh, options: FlattenOptions = DEFAULTS) -> Flattening:
    """Return the surface laid flat, as conformally as its mesh allows; the flat's scale is the rim's own.

    `mesh` must be one oriented manifold piece with a boundary (`read_mesh` sees to that); holes are open again in the
    flat. Raises `FlattenError` with all findings where the flat has flipped faces or overlaps itself, whatever is
    tried: fewer boundary modes, filled holes, a Laplacian of better shaped triangles.
    """
    if options.given_mm is not None:
        return given_flat(mesh, options.given_mm)
    loops = boundary_loops(mesh)
    if not loops:
        raise FlattenError("the surface is closed; a sheet has an edge")
    if options.boundary == "prescribed" and options.boundary_u is None:
        raise FlattenError("a prescribed boundary needs `boundary_u`, one value per vertex of the mesh")
    faults: list[Finding] = []
    for asked in _tries(options, len(loops)):
        try:
            flat = _flatten_as_asked(mesh, loops, asked)
        except NotConverged as fault:
            found = [Finding("FLAT-PROGRAMME", str(fault))]
        except FlattenError as fault:
            found = list(fault.findings) or [Finding("FLAT-RIM", fault.message)]
        else:
            if not errors(flat.findings):
                return replace(flat, findings=(*flat.findings, *_changed(options, asked)))
            found = list(flat.findings)
        faults = faults or found
    raise FlattenError("the surface could not be laid flat", faults)


def _tries(options: FlattenOptions, loop_count: int) -> list[FlattenOptions]:
    """Return what is asked, then ever tamer ways to come near it."""
    tries = [options]
    if options.boundary == "optimised" or options.cones_count:
        tries += [replace(options, modes_count=count) for count in (8, 4, 2) if count < options.modes_count]
    if loop_count > 1 and options.holes != "filled":
        tries.append(replace(tries[-1], holes="filled"))
    return [*tries, replace(tries[-1], laplacian="delaunay")]


def _changed(options: FlattenOptions, used: FlattenOptions) -> list[Finding]:
    found = []
    if used.modes_count != options.modes_count:
        text = f"the boundary was optimised with {used.modes_count} modes only; with more the flat overlapped itself"
        found.append(Finding("FLAT-MODES", text, "info"))
    if used.holes != options.holes:
        found.append(Finding("FLAT-FILLED", "holes were filled: with rims of their own the flat overlapped", "info"))
    if used.laplacian != options.laplacian:
        found.append(Finding("FLAT-DELAUNAY", "badly shaped faces: the intrinsic Laplacian was used", "info"))
    return found


def _flatten_as_asked(mesh: TriMesh, loops: list[Indices], options: FlattenOptions) -> Flattening:
    if options.cut_path is not None and not (len(loops) > 1 and _joins(loops, options.cut_path)):
        return _flatten_cut(mesh, cut_along(mesh, [options.cut_path]), options)
    if options.cones_count:
        return _flatten_with_cones(mesh, loops, options)
    if len(loops) > 1 and options.seam != "none":
        if options.seam == "tube" or options.cut_path is not None:
            return _flatten_tube(mesh, loops, options)
        flat = _flatten_disk(mesh, loops, options)
        if errors(flat.findings) or flat.spread_ratio() > TUBE_ABOVE_ratio:
            strip = _flatten_tube(mesh, loops, options)
            return strip if errors(flat.findings) or strip.spread_ratio() < flat.spread_ratio() else flat
        return flat
    return _flatten_disk(mesh, loops, options)


def _joins(loops: list[Indices], path: Indices) -> bool:
    """Say whether a path leads from one of the two longest loops to the other."""
    ends = [next((k for k, loop in enumerate(loops[:2]) if end in loop), -1) for end in (path[0], path[-1])]
    return sorted(ends) == [0, 1]


def _flatten_disk(mesh: TriMesh, loops: list[Indices], options: FlattenOptions) -> Flattening:
    count = len(mesh.vertices_mm)
    if len(loops) > 1 and (options.holes == "free" or (options.holes == "auto" and options.boundary == "optimised")):
        open_surface = rims(mesh, loops, options.laplacian)
        u = rims_u(open_surface, options)
        flat_mm = lay_rims(open_surface, u)
    else:
        surface = disk(mesh, loops, options.laplacian)
        u = surface.scale_factors(rim_u(surface, options))
        flat_mm, u = lay_out(surface, u)[:count], u[:count]
    found = check_flat(mesh, flat_mm, mesh.faces, loops)
    return _finish(mesh, flat_mm, mesh.faces, np.arange(count), u, (), found)


def _flatten_tube(mesh: TriMesh, loops: list[Indices], options: FlattenOptions) -> Flattening:
    surface = tube(mesh, loops, options.laplacian)
    path = options.cut_path
    if path is not None and path[0] in loops[1]:
        path = path[::-1]
    strip = lay_strip(surface, tube_scale_factors(surface, options), path)
    faces = strip.cut.mesh.faces[: len(mesh.faces)]
    # The fans over further holes go; their centres lie between the mesh's own vertices and the seam's copies.
    keep = np.concatenate([np.arange(surface.count), np.arange(len(surface.mesh.vertices_mm), len(strip.flat_mm))])
    number = np.cumsum(np.isin(np.arange(len(strip.flat_mm)), keep)) - 1
    flat_mm, faces, index = strip.flat_mm[keep], number[faces], strip.cut.target_index[keep]
    seam = Seam(number[strip.left], number[strip.right], 0.0, (strip.period_mm, 0.0), 0.0, closes_tube=True)
    opened = TriMesh(mesh.vertices_mm[index], faces)
    found = check_flat(opened, flat_mm, faces, boundary_loops(opened))
    return _finish(mesh, flat_mm, faces, index, strip.u[keep], (seam.measured(flat_mm),), found)


def _flatten_with_cones(mesh: TriMesh, loops: list[Indices], options: FlattenOptions) -> Flattening:
    surface = disk(mesh, loops, options.laplacian)
    cones = place_cones(surface, options.cones_count, options.modes_count)
    useful = cones.vertices[cones.angles_rad > 1e-3]
    if len(useful) == 0:
        return _flatten_disk(mesh, loops, replace(options, cones_count=0, boundary="optimised"))
    opened = cut_along(mesh, seams_of(surface, useful))
    return _flatten_cut(mesh, opened, replace(options, boundary="prescribed", boundary_u=cones.u))


def _flatten_cut(mesh: TriMesh, opened: Cut, options: FlattenOptions) -> Flattening:
    """Flatten a surface that was cut from inside to its rim; both sides of a cut keep the same lengths."""
    loops = boundary_loops(opened.mesh)
    index = opened.target_index
    surface = disk(opened.mesh, loops, options.laplacian)
    given = None if options.boundary_u is None else options.boundary_u[index]
    u = surface.scale_factors(rim_u(surface, replace(options, boundary_u=given)))
    flat_mm = lay_out(surface, u, _twins(surface.rim, opened))[: surface.count]
    seams = tuple(Seam(left, right, 0.0, (0.0, 0.0), 0.0).measured(flat_mm) for right, left in opened.sides)
    found = check_flat(opened.mesh, flat_mm, opened.mesh.faces, loops)
    return _finish(mesh, flat_mm, opened.mesh.faces, index, u[: surface.count], seams, found)


def _twins(rim: Indices, opened: Cut) -> Indices:
    """Return for each rim edge the edge that lies on it when the cut is closed, or itself."""
    place = np.full(len(opened.mesh.vertices_mm), -1)
    place[rim] = np.arange(len(rim))
    twins = np.arange(len(rim))
    for left, right in opened.sides:
        # The rim follows the faces: along the chain on its left, against it on its right.
        one, other = place[left[:-1]], place[right[1:]]
        twins[one], twins[other] = other, one
    return twins


def _finish(
    mesh: TriMesh,
    flat_mm: Points,
    faces: Faces,
    index: Indices,
    u: Values,
    seams: tuple[Seam, ...],
    found: list[Finding],
) -> Flattening:
    with np.errstate(divide="ignore"):  # a collapsed face is among the findings
        expansion_ratio = np.sqrt(mesh.face_areas_mm2() / np.abs(signed_areas_mm2(flat_mm, faces)))
    return Flattening(mesh, flat_mm, faces, index, expansion_ratio, u, seams, tuple(found))
