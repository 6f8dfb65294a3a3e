"""From a design folder back to the shell that it describes, and what `fabctl deploy` writes about it."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.bundle import open_bundle
from design.cells.bending_map import bending_for
from design.cells.contracting import is_contracting
from design.cells.hinges import with_hinge
from design.cells.homogenise import CURVE_SHARES
from design.cells.library import CellLibrary, hexagon_mm2
from design.cells.sheet import Sheet
from design.deploy.cascade import Wells
from design.deploy.designed import lift
from design.deploy.levels import Layout, prolong, refine
from design.deploy.shell import Reals
from design.findings import Finding
from design.meshfiles import read_mesh
from design.preview import few_ticks
from design.surface import TriMesh
from fabctl.config.material import load_material
from fabctl.config.spec import load_spec
from fabctl.designing import library_file, library_of, sheet_of
from fabctl.errors import RefusedError

NUMBERS = ("cx_mm", "cy_mm", "inverted", "t_mm", "theta_deg", "expansion_ratio", "hinge_mm")
ROUNDING_MM = 1e-3  # cells.csv and the meshes are rounded to less than this


@dataclass(frozen=True, slots=True)
class Laid:
    """A design as a shell, with where it should go."""

    layout: Layout
    start_mm: Reals  # (n, 3) the shape found when the design was built
    target: TriMesh
    design_mm: Reals | None  # (n, 3) where each vertex belongs, where the folder tells
    sheet: Sheet
    t_mm: Reals  # (m,) of each cell
    theta_rad: Reals
    library: CellLibrary  # of this sheet

    @property
    def goal_mm(self) -> Reals:
        """Return where each vertex belongs as far as the folder tells, `(n, 3)`."""
        return self.start_mm if self.design_mm is None else self.design_mm


def read_laid(folder: Path, home: Path) -> Laid:
    """Return the shell of a design folder; raise `BundleError`, or `RefusedError` where it was built without one."""
    bundle = open_bundle(folder)
    if bundle.kind == "coupon":
        told = Finding("DEPLOY-COUPON", "is a coupon: flat patches that are pulled open by hand", where=str(folder))
        raise RefusedError("nothing to deploy", [told])
    if "deployed.ply" not in bundle.manifest["files"]:
        missing = Finding(
            "DEPLOY-NONE", "was built without a prediction", where=str(folder), hint="take `response: null` out"
        )
        raise RefusedError("nothing to deploy", [missing])
    rows = bundle.cells()
    table = {name: np.array([float(row[name]) for row in rows]) for name in NUMBERS}
    centre = np.column_stack([table["cx_mm"], table["cy_mm"]])
    inverted = table["inverted"] == 1
    t, theta, expansion = table["t_mm"], np.deg2rad(table["theta_deg"]), table["expansion_ratio"]
    shape, _ = read_mesh(bundle.file("deployed.ply"))
    edge_mm = _edge_mm(centre)
    corners = _flat_corners(centre, inverted, edge_mm, shape)
    config, _ = load_spec(str(bundle.file("spec.yaml")), home, bundle.file("target.ply"))
    sheet = sheet_of(load_material(config.material, home), edge_mm)
    library = library_of(config, library_file(config, folder)).scaled(sheet)
    if config.cells == "expanding":
        library = with_hinge(library, float(np.median(table["hinge_mm"])))
    cells = library.at(t, theta)
    mean = float(np.nanmean(cells.nu_tangent_ratio))
    nu = np.where(np.isfinite(cells.nu_tangent_ratio), cells.nu_tangent_ratio, mean)
    Y = np.where(np.isfinite(cells.Y_N_mm), cells.Y_N_mm, np.nanmean(cells.Y_N_mm))
    D = np.asarray(bending_for(library).D_mJ(expansion, theta, sheet))
    # Cells that do not stay open are as the build's own prediction takes them: solid.
    stays_open = np.array([row["kind"] == "cut" for row in rows])
    expansion = np.where(stays_open, expansion, 1.0)
    Y = np.where(stays_open, Y, sheet.E_MPa * sheet.thickness_mm)
    nu = np.where(stays_open, nu, sheet.nu_ratio)
    D = np.where(stays_open, D, sheet.E_MPa * sheet.thickness_mm**3 / 12)
    target, _ = read_mesh(bundle.file("target.ply"))
    paper, _ = read_mesh(bundle.file("flat.ply"))
    layout = Layout(np.asarray(shape.faces, dtype=np.int64), corners, edge_mm, expansion, Y, nu, D)
    goal = _goal_mm(layout, paper, target) if len(paper.faces) == len(target.faces) else None
    return Laid(layout, shape.vertices_mm, target, goal, sheet, t, theta, library)


def divided(laid: Laid, parts: int) -> Laid:
    """Return the same sheet with `parts`² triangles a unit."""
    fine = refine(laid.layout, parts)
    start, design = (
        None if places is None else prolong(laid.layout, places, fine) for places in (laid.start_mm, laid.design_mm)
    )
    assert start is not None
    return replace(laid, layout=fine, start_mm=start, design_mm=design)


def wells_of(laid: Laid) -> Wells:
    """Return each cell's whole energy curve; raise `RefusedError` where there is none to follow."""
    if is_contracting(laid.library):
        fault = Finding("CASCADE-CLOSING", "the cells contract", hint="unit by unit goes with expanding cells only")
        raise RefusedError("the sheet cannot be opened cell by cell", [fault])
    if laid.layout.rejoined_count():
        fault = Finding("CASCADE-SEAM", "its seam is joined", hint="unit by unit goes with sheets that lie flat only")
        raise RefusedError("the sheet cannot be opened cell by cell", [fault])
    if np.any(laid.layout.expansion_ratio <= 1):
        fault = Finding("CASCADE-SOLID", "some cells are not cut or spring back", hint="they have no two wells to snap")
        raise RefusedError("the sheet cannot be opened cell by cell", [fault])
    curves = [laid.library.energy_curve(float(t), float(a)) for t, a in zip(laid.t_mm, laid.theta_rad, strict=True)]
    energy = np.array([curve.energy_mJ for curve in curves]) / hexagon_mm2(laid.sheet)
    inner = CURVE_SHARES < 1
    saddle = CURVE_SHARES[inner][np.argmax(energy[:, inner], axis=1)]
    return Wells(CURVE_SHARES, energy, saddle)


def _edge_mm(centre_mm: Reals) -> float:
    from scipy.spatial import cKDTree

    nearest = np.asarray(cKDTree(centre_mm).query(centre_mm, k=2)[0])
    return float(np.median(nearest[:, 1]) * np.sqrt(3))


def _flat_corners(centre: Reals, inverted: NDArray[np.bool_], edge_mm: float, shape: TriMesh) -> Reals:
    """Return the flat corners `(m, 3, 2)` of the deployed mesh's faces, which are the cells in their order.

    A vertex on a re-joined seam lies at two places of the flat, a period apart; any other one must lie at one.
    """
    low, high = edge_mm / np.sqrt(12), edge_mm / np.sqrt(3)
    upright = np.array([[-edge_mm / 2, -low], [edge_mm / 2, -low], [0, high]])
    hanging = np.array([[0, -high], [edge_mm / 2, low], [-edge_mm / 2, low]])
    corners = centre[:, None] + np.where(inverted[:, None, None], hanging, upright)
    if len(shape.faces) != len(corners):
        raise RefusedError("the deployed mesh is not that of the cells", [])
    apart = np.linalg.norm(_places_apart_mm(corners, shape.faces), axis=1)
    joined = apart > edge_mm
    if np.any(apart[~joined] > ROUNDING_MM) or (joined.any() and np.ptp(apart[joined]) > ROUNDING_MM):
        fault = Finding("DEPLOY-SEAM", "its corners do not meet as those of the deployed mesh do", hint="build it anew")
        raise RefusedError("the deployed mesh does not lie flat as the cells do", [fault])
    return corners


def _places_apart_mm(corners_mm: Reals, faces: NDArray[np.int64]) -> Reals:
    """Return for each vertex by how much its places in the flat differ, `(n, 2)`."""
    low = np.full((int(faces.max()) + 1, 2), np.inf)
    high = -low
    np.minimum.at(low, faces.ravel(), corners_mm.reshape(-1, 2))
    np.maximum.at(high, faces.ravel(), corners_mm.reshape(-1, 2))
    return np.asarray(high - low, dtype=np.float64)


def _goal_mm(layout: Layout, paper: TriMesh, target: TriMesh) -> Reals:
    """Return where each vertex belongs on the target, `(n, 3)`; around a tube the flat goes on period after period."""
    import igl

    flat, level = layout.flat_mm(), np.ascontiguousarray(paper.vertices_mm * [1.0, 1.0, 0.0])
    period = _places_apart_mm(layout.corners_mm, layout.cells).max(axis=0) * [1.0, 0.0]
    if layout.rejoined_count():
        turns = [np.column_stack([flat + k * period, np.zeros(len(flat))]) for k in (0, 1, -1)]
        away = [
            igl.point_mesh_squared_distance(points, level, np.ascontiguousarray(paper.faces))[0] for points in turns
        ]
        flat = np.asarray(turns)[np.argmin(np.round(away, 6), axis=0), np.arange(len(flat)), :2]
    return lift(flat, paper.vertices_mm[:, :2], paper.faces, target.vertices_mm, target.faces)


def farthest_mm(mesh: TriMesh, target: TriMesh) -> Reals:
    """Return for every unit the distance of its farthest sample from the target, `(m,)`."""
    from design.deploy.compare import closest, surface_samples

    away: Reals = closest(surface_samples(mesh.vertices_mm, mesh.faces)[0], target)[0]
    farthest: Reals = away.reshape(-1, 4).max(axis=1)
    return farthest


def picture_png(mesh: TriMesh, target: TriMesh, title: str) -> bytes:
    """Return a picture of a deployed sheet, each unit coloured by how far its farthest sample is from the target.

    The samples are those of `Deviation`, so that the bar ends at its `max_mm`.
    """
    distance = farthest_mm(mesh, target)
    figure, axes, faces = _stage(mesh, title)
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable

    scale = ScalarMappable(cmap=colormaps["viridis"])
    scale.set_array(distance)
    scale.set_clim(0.0, float(distance.max()))
    faces.set_facecolor(scale.to_rgba(distance))
    figure.colorbar(scale, ax=axes, shrink=0.6, label="farthest of each unit from the target, mm")
    out = io.BytesIO()
    figure.savefig(out, dpi=110, format="png")
    return out.getvalue()


def animation_gif(frames_mm: list[Reals], mesh: TriMesh, title: str) -> bytes:
    """Return the deployment as an animated picture, flat first, with the last frame held."""
    from PIL import Image

    figure, _, faces = _stage(mesh, title)
    pictures = []
    for x in [*frames_mm, *[frames_mm[-1]] * 6]:
        faces.set_verts(list(x[mesh.faces]))
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]))
    out = io.BytesIO()
    pictures[0].save(out, format="GIF", save_all=True, append_images=pictures[1:], duration=120, loop=0)
    return out.getvalue()


def _stage(mesh: TriMesh, title: str):  # type: ignore[no-untyped-def]  # matplotlib has no types here
    """Return a figure, its axes and the mesh's faces in it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    figure = Figure(figsize=(7, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    faces = Poly3DCollection(list(mesh.vertices_mm[mesh.faces]), edgecolors="#333", linewidths=0.3, facecolors="#8ab")
    axes.add_collection3d(faces)
    low, high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
    middle, reach = (low + high) / 2, 0.5 * float(np.ptp(mesh.vertices_mm, axis=0).max())
    for k, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(middle[k] - reach, middle[k] + reach)
        getattr(axes, f"set_{name}label")(f"{name}, mm")
    few_ticks(axes)
    axes.set_title(title, fontsize=10)
    return figure, axes, faces
