"""The sheets that the figures of the deployed shape are taken on: caps, published targets, a vase."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.cells.bending_map import load_bending
from design.cells.library import load_library
from design.cells.select import SelectionOptions, on_curve, selection_curve
from design.cells.sheet import Sheet
from design.deploy.compare import surface_samples
from design.deploy.designed import designed_layout, lift
from design.deploy.levels import Layout, sheet_layout
from design.flatten import Flattening, flatten
from design.meshfiles import read_corner_uv, read_mesh
from design.pattern.assign import averaged
from design.pattern.tiling import tile
from design.pipeline import scaled_tube
from design.predicted import lifted, welded
from design.spec import DesignSpec
from design.surface import TriMesh

Reals = NDArray[np.float64]
SHEET = Sheet()
PRESCRIBED_MJ = 0.1 * 1.5 * 2.3**3 / 12  # the solver check's bending stiffness
CAP_MM, APEX = 80.0, {"low": 1.505, "high": 1.775}


def properties(expansion: Reals) -> tuple[Reals, Reals, Reals]:
    """Return Y, ν and D of the stiffest cells of these expansions."""
    library = load_library()
    curve = selection_curve(library, SelectionOptions(rule="stiffest"))
    chosen = on_curve(curve, np.clip(expansion, *curve.range_ratio()))
    at = library.at(chosen.t_mm, chosen.theta_rad)
    nu = np.where(np.isfinite(at.nu_tangent_ratio), at.nu_tangent_ratio, np.nanmean(at.nu_tangent_ratio))
    flat_mm2 = 6 * np.sqrt(3) / 4 * SHEET.edge_mm**2
    return chosen.stiffness_mJ / flat_mm2, nu, load_bending().D_mJ(chosen.expansion_ratio, chosen.theta_rad, SHEET)


def cap(apex: float, edge_mm: float, D_mJ: float | None = None) -> tuple[Layout, Reals]:
    """Return the half-angle-60° cap's layout, stereographic, and where its vertices belong; `D_mJ` None: computed."""
    reach = 2 * CAP_MM / apex
    radius = reach * np.tan(np.pi / 6)
    ring = np.linspace(0, 2 * np.pi, 181)[:-1]
    disk = np.vstack([[0.0, 0.0], radius * np.column_stack([np.cos(ring), np.sin(ring)])])
    fan = np.array([[0, k + 1, (k + 1) % 180 + 1] for k in range(180)])
    tiling = tile(disk, fan, edge_mm)
    centre = tiling.centres_mm()
    lam = apex / (1 + np.sum((centre / reach) ** 2, axis=1))
    Y, nu, D = properties(lam)
    layout, _ = designed_layout(tiling.vertices_mm, tiling.cells, lam, Y, nu, D if D_mJ is None else np.array(D_mJ))
    flat = layout.flat_mm()
    polar, turn = 2 * np.arctan(np.hypot(*flat.T) / reach), np.arctan2(flat[:, 1], flat[:, 0])
    goal = CAP_MM * np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=1)
    return layout, goal


def sphere_deviation_mm(x: Reals, layout: Layout) -> tuple[float, Reals]:
    """Return the mean distance of the units from the sphere fitted with its own radius, and the shape about it."""
    from scipy.optimize import least_squares

    points, area = surface_samples(x, layout.cells)

    def gap(centre: Reals) -> Reals:
        return np.asarray((np.linalg.norm(points - centre, axis=1) - CAP_MM) * np.sqrt(area))

    centre = least_squares(gap, x.mean(axis=0) - [0, 0, 60]).x
    return float(np.average(np.abs(np.linalg.norm(points - centre, axis=1) - CAP_MM), weights=area)), x - centre


def sphere_rms_mm(x: Reals, aligned: bool) -> float:
    """Return the RMS distance of the vertices from the cap's sphere, where it stands or moved to fit best."""
    from scipy.optimize import least_squares

    def gap(centre: Reals) -> Reals:
        return np.asarray(np.linalg.norm(x - centre, axis=1) - CAP_MM)

    centre = least_squares(gap, np.zeros(3)).x if aligned else np.zeros(3)
    return float(np.sqrt(np.mean(gap(centre) ** 2)))


def shared_folder() -> Path:
    """Return where the published data are, if they are here."""
    return Path(os.environ.get("FABCTL_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def published(name: str) -> TriMesh | None:
    """Return a published target, None where it is not here."""
    path = shared_folder() / "published" / "targets" / f"{name}.obj"
    return read_mesh(path)[0] if path.is_file() else None


def published_lie_rad(name: str, flat: Flattening) -> float:
    """Return how far the published flat of a target is turned against ours: units have their sides along its x.

    The two flats are the same shape; least squares over the points that lie at the same place in space.
    """
    from scipy.spatial import cKDTree

    corners, uv = read_corner_uv(shared_folder() / "published" / "targets" / f"{name}_flat.obj")
    _, same = cKDTree(flat.mesh.vertices_mm).query(corners.reshape(-1, 3))
    ours, theirs = (p - p.mean(axis=0) for p in (flat.flat_mm[same], uv.reshape(-1, 2)))
    return float(np.angle(np.vdot(ours @ [1, 1j], theirs @ [1, 1j])))


def tiled(
    mesh: TriMesh, count: int | None, D_mJ: float | None, name: str | None = None, turn_rad: float = 0.0
) -> tuple[Layout, Reals]:
    """Return a target's layout of about `count` units (None: 10 mm cells) and where its vertices belong.

    The flat lies as its published one, where `name` is given, and is turned by `turn_rad` from there.
    """
    flat = flatten(mesh)
    scale = 1.75 / float(np.quantile(flat.expansion_ratio, 0.99))
    turn = turn_rad + (published_lie_rad(name, flat) if name else 0.0)
    turning = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    expansion, points = flat.expansion_ratio * scale, flat.flat_mm @ turning / scale
    area = float(np.sum(mesh.face_areas_mm2() / expansion**2))
    edge = SHEET.edge_mm if count is None else float(np.sqrt(area / count / np.sqrt(0.1875)))
    cells = tile(points, flat.faces, edge)
    lam = averaged(cells, points, flat.faces, expansion**2, "exact")
    Y, nu, D = properties(lam)
    layout, _ = designed_layout(cells.vertices_mm, cells.cells, lam, Y, nu, D if D_mJ is None else np.array(D_mJ))
    return layout, lift(layout.flat_mm(), points, flat.faces, flat.mesh.vertices_mm, flat.mesh.faces)


def whole_vase(half: TriMesh) -> TriMesh:
    """Return the half and its mirror image in x = 0, welded."""
    mirrored = half.vertices_mm * [-1.0, 1.0, 1.0]
    points = np.vstack([half.vertices_mm, mirrored])
    _, first, place = np.unique(np.rint(points * 1e4).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    faces = np.vstack([half.faces, half.faces[:, ::-1] + len(half.vertices_mm)])
    return TriMesh(points[first], place.ravel()[faces])


def tiled_vase(mesh: TriMesh, count: int) -> tuple[Layout, Reals]:
    """Return the layout of a tube of about `count` units with its seam joined, and where its vertices belong."""
    flat = flatten(mesh)
    flat = flat.scaled(float(np.quantile(flat.expansion_ratio, 0.99)) / 1.75)
    area = float(np.sum(mesh.face_areas_mm2() / flat.expansion_ratio**2))
    spec = DesignSpec("vase", cell_mm=float(np.sqrt(area / count / np.sqrt(0.1875))))
    flat, tiling, lam = scaled_tube(spec, flat, load_library().range_ratio(), [])
    Y, nu, _ = properties(lam)
    cells = np.where(tiling.inverted[:, None], tiling.cells[:, ::-1], tiling.cells)
    sheet = sheet_layout(tiling.vertices_mm, cells, lam, Y, nu, np.array(PRESCRIBED_MJ))
    return welded(sheet, tiling, lifted(flat, tiling.vertices_mm))
