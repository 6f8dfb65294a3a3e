"""What the sheet will do: its deployed shape beside the target, and the force of an indenter."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from design.cells.bending_map import bending_for
from design.cells.contracting import is_contracting
from design.cells.library import CellLibrary
from design.cells.select import Choice
from design.deploy.equilibrium import from_flat, pushed_flat
from design.deploy.indentation import Response, indentation_response
from design.deploy.levels import Layout, sheet_layout, weld
from design.deploy.newton import System, smallest_eigenvalue_N_mm
from design.deploy.predict import Deployed, deploy
from design.deploy.search import same_shape
from design.errors import NotConverged
from design.findings import Finding
from design.flatten import Flattening
from design.pattern.tiling import Array, Tiling
from design.spec import ResponseOptions

FROM_FLAT_COUNT = 2000  # units up to which the free deployment is computed too, in a second or so
HINGE_RATIO, HINGE_FAR_RATIO = 0.04, 0.25  # a hinge further than that from the computed cells' is told, is a warning
THICKNESS_RATIO = 0.05  # thickness over edge further than that from the computed cells' is told


@dataclass(frozen=True, slots=True)
class Predicted:
    """The deployed shape in the target's frame and the indentation response."""

    deployed: Deployed
    response: Response
    findings: tuple[Finding, ...]
    smallest_eigenvalue_N_mm: float  # of the deployed shape: how far it is from giving way


def predict(
    flat: Flattening,
    tiling: Tiling,
    choice: Choice,
    cut: NDArray[np.bool_],
    library: CellLibrary,
    options: ResponseOptions,
    watch: Callable[[str, float], None],
) -> Predicted:
    """Return what the shell model says of the cells on their sheet. Raises `NotConverged` where it finds no shape."""
    layout, design_mm = welded(layout_of(tiling, choice, cut, library), tiling, lifted(flat, tiling.vertices_mm))
    deployed = deploy(layout, flat.mesh, design_mm)
    watch("pressing the indenter", 0.8)
    response = indentation_response(
        layout,
        deployed.mesh.vertices_mm,
        options.indenter_radius_mm,
        options.depth_mm,
        options.steps_count,
        None if options.point_mm is None else np.array(options.point_mm),
        watch=lambda share: watch("pressing the indenter", 0.8 + 0.2 * share),
    )
    softest = smallest_eigenvalue_N_mm(System(layout.shell()), deployed.equilibrium.x_mm, (), None)
    doubts = (*_doubts(library), *_other_side(layout, deployed, tiling.twins is not None))
    return Predicted(deployed, response, doubts, softest)


def _other_side(layout: Layout, deployed: Deployed, is_tube: bool) -> list[Finding]:
    """Return what the sheet does when it is left to itself: from flat it may pop to another shape than the intended.

    The prediction starts from the target, as if every bump were helped to its side. Left out for large sheets and
    tubes, which have no flat start.
    """
    if len(layout.cells) > FROM_FLAT_COUNT or is_tube:
        return []
    energies = []
    for side in (0.3, -0.3):
        try:
            free = from_flat(layout, functools.partial(pushed_flat, side=side))
        except NotConverged:
            continue
        if same_shape(free.x_mm, deployed.equilibrium.x_mm):
            return []
        energies.append(free.energy_mJ)
    if not energies:
        return []
    text = (
        f"left to itself the flat sheet pops to another shape, of {min(energies):.4g} mJ; "
        f"the one predicted has {deployed.equilibrium.energy_mJ:.4g} mJ and needs its bumps helped to their sides"
    )
    return [Finding("DEPLOY-SIDES", text, "warning", hint="`fabctl deploy DESIGN --shapes 4` lists the shapes found")]


def welded(layout: Layout, tiling: Tiling, design_mm: Array) -> tuple[Layout, Array]:
    """Return the layout with the tiling's seam joined, and the places of the vertices that are left, `(n, 3)`."""
    if tiling.twins is None:
        return layout, design_mm
    right = np.flatnonzero(tiling.twins != np.arange(len(tiling.twins)))
    return weld(layout, np.column_stack([tiling.twins[right], right])), np.delete(design_mm, right, axis=0)


def _doubts(library: CellLibrary) -> list[Finding]:
    """Return what makes the prediction less sure."""
    computed, sheet = bending_for(library).sheet, library.sheet
    found = []
    asked, known = sheet.thickness_mm / sheet.edge_mm, computed.thickness_mm / computed.edge_mm
    if abs(asked / known - 1) >= THICKNESS_RATIO:
        text = (
            f"bending stiffness was computed for a thickness of {known:.3g} of the cell's edge; yours is {asked:.3g}, "
            "and is scaled with the cube of the thickness"
        )
        hint = "shape and response are less sure; `scripts/build_bending.py` computes the map anew"
        found.append(Finding("DEPLOY-THICKNESS", text, "warning", hint=hint))
    mine, theirs = sheet.hinge_mm / sheet.edge_mm, computed.hinge_mm / computed.edge_mm
    if not is_contracting(library) and abs(mine / theirs - 1) >= HINGE_RATIO:
        far = abs(mine / theirs - 1) > HINGE_FAR_RATIO
        off = "a quarter less at low expansions, a tenth more at high ones" if far else "a twentieth either way"
        text = (
            f"bending stiffness is that of hinges of {theirs * sheet.edge_mm:.3g} mm; with yours of about "
            f"{sheet.hinge_mm:.3g} mm it may be up to {off}"
        )
        found.append(Finding("DEPLOY-HINGE", text, "warning" if far else "info", hint="take the response with care"))
    return found


def layout_of(tiling: Tiling, choice: Choice, cut: NDArray[np.bool_], library: CellLibrary) -> Layout:
    """Return the shell's units: the tiling's cells, counter-clockwise, with their stiffness; solid where not cut."""
    sheet = library.sheet
    cells = np.where(tiling.inverted[:, None], tiling.cells[:, ::-1], tiling.cells)
    at = library.at(choice.t_mm, choice.theta_rad)
    # At the very rim of the map Poisson's ratio cannot be interpolated: the nearest cell's is as good.
    nu = np.where(np.isfinite(at.nu_tangent_ratio), at.nu_tangent_ratio, _nearest_nu(choice, library))
    flat_mm2 = 6 * np.sqrt(3) / 4 * sheet.edge_mm**2
    bending = bending_for(library).D_mJ(choice.expansion_ratio, choice.theta_rad, sheet)
    expansion = np.where(cut, choice.expansion_ratio, 1.0)
    Y = np.where(cut, choice.stiffness_mJ / flat_mm2, sheet.E_MPa * sheet.thickness_mm)
    nu = np.where(cut, nu, sheet.nu_ratio)
    bending = np.where(cut, bending, sheet.E_MPa * sheet.thickness_mm**3 / 12)
    return sheet_layout(tiling.vertices_mm, cells, expansion, Y, nu, bending)


def _nearest_nu(choice: Choice, library: CellLibrary) -> Array:
    from scipy.spatial import cKDTree

    edge = library.sheet.edge_mm
    tree = cKDTree(np.column_stack([library.t_mm, edge * library.theta_rad]))
    _, at = tree.query(np.column_stack([choice.t_mm, edge * choice.theta_rad]))
    return np.asarray(library.nu_tangent_ratio[at])


def lifted(flat: Flattening, points_mm: Array) -> Array:
    """Return where points of the flat lie on the target, `(n, 3)`; beyond its border the nearest face goes on."""
    points, faces, copy = flat.unrolled()
    corners = points[faces]
    tree = shapely.STRtree(np.asarray(shapely.polygons(corners)))
    which, face = tree.query_nearest(np.asarray(shapely.points(points_mm)), all_matches=False)
    face = face[np.argsort(which)]
    a, b, c = corners[face].transpose(1, 0, 2)
    u, v, w = b - a, c - a, points_mm - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    second = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
    third = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
    weights = np.column_stack([1 - second - third, second, third])
    return np.asarray(np.einsum("nk,nkd->nd", weights, flat.mesh.vertices_mm[flat.mesh.faces[copy[face]]]))
