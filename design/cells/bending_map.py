"""Bending stiffness over the whole library: computed for a hundred-odd cells, interpolated between them.

A cell of the solid costs a second or so, far more than one of the plane; D varies gently, so a coarse set will do. The
coordinates of interpolation are the cell's expansion and θ, in which the bistable cells fill a compact region.
"""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.cells.bending import PlaneCell, bend
from design.cells.contracting import is_contracting
from design.cells.homogenise import Failure, Pair, follow, solve_pair
from design.cells.library import CellLibrary, LibraryError
from design.cells.mesh import REFERENCE, Density
from design.cells.open_cells import CLOSED_SHARE, open_model
from design.cells.sector import Model
from design.cells.select import SelectionOptions, on_curve, selection_curve
from design.cells.sheet import Sheet
from design.cells.tiling import tiling
from design.errors import NotConverged

Array = NDArray[np.float64]
FORMAT = 1
SHIPPED = Path(__file__).parent / "data" / "bending.npz"
SHIPPED_OPEN = SHIPPED.with_name("bending-open.npz")
EXPANSION_STEP_RATIO = 0.06  # between the computed cells of one angle
CURVE_STEP_RATIO = 0.025  # between those along the curve of selected cells
COLUMN_STEP = 2  # of the library's angles
LENGTH_RATIO, LENGTH_RAD = 0.1, 0.1  # over which D varies by about the same: the metric of interpolation
FIELDS = ("t_mm", "theta_rad", "expansion_ratio", "D_ratio", "nu_ratio", "anisotropy_ratio", "solid_ratio")


@dataclass(frozen=True, slots=True)
class BendingMap:
    """D over E·h³/12 and the Poisson ratio of bending at computed cells, `(n,)` each."""

    sheet: Sheet
    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    D_ratio: Array
    nu_ratio: Array
    anisotropy_ratio: Array
    solid_ratio: Array  # the expansion of the solid cell
    meta: dict[str, Any]

    def at(self, expansion_ratio: Array | float, theta_rad: Array | float) -> tuple[Array, Array]:
        """Return D/(E·h³/12) and the Poisson ratio of bending at cells of given expansion and θ.

        Outside the computed cells the nearest of them counts: D is bounded there, a polynomial would not be.
        """
        lam, theta = np.broadcast_arrays(np.asarray(expansion_ratio, float), np.asarray(theta_rad, float))
        points = np.column_stack([lam.ravel() / LENGTH_RATIO, theta.ravel() / LENGTH_RAD])
        inside, outside = _interpolators(self)
        found = inside(points)
        missing = np.isnan(found[:, 0])
        if missing.any():
            found[missing] = outside(points[missing])
        return found[:, 0].reshape(lam.shape), found[:, 1].reshape(lam.shape)

    def D_mJ(self, expansion_ratio: Array | float, theta_rad: Array | float, sheet: Sheet) -> Array:
        """Return the bending stiffness of cells of `sheet`, per deployed width.

        The map is for one thickness; another is scaled with its cube, which is exact only where thickness and edge
        grow together.
        """
        return self.at(expansion_ratio, theta_rad)[0] * sheet.E_MPa * sheet.thickness_mm**3 / 12


def _key(found: BendingMap) -> tuple[bytes, bytes, bytes]:
    return found.expansion_ratio.tobytes(), found.theta_rad.tobytes(), found.D_ratio.tobytes()


_CACHE: dict[tuple[bytes, bytes, bytes], tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {}


def _interpolators(found: BendingMap) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Return the interpolators inside and outside the computed cells' hull."""
    from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator

    key = _key(found)
    if key not in _CACHE:
        points = np.column_stack([found.expansion_ratio / LENGTH_RATIO, found.theta_rad / LENGTH_RAD])
        values = np.column_stack([found.D_ratio, found.nu_ratio])
        _CACHE[key] = CloughTocher2DInterpolator(points, values), NearestNDInterpolator(points, values)
    return _CACHE[key]


def plane_cell(t_mm: float, theta_rad: float, sheet: Sheet, density: Density = REFERENCE) -> PlaneCell | Failure:
    """Return the two-unit cell (t, θ) at rest and at its second stable state, or why there is none."""
    found = solve_pair(t_mm, theta_rad, sheet, density)
    return found if isinstance(found, Failure) else laid_out(*found)


def contracting_plane_cell(t_mm: float, theta_rad: float, sheet: Sheet) -> tuple[PlaneCell, float] | Failure:
    """Return the two units of an open cell, and its edge over the sheet's; the slit cell has the sheet's own edge."""
    slit = solve_pair(t_mm, theta_rad, sheet, REFERENCE)
    if isinstance(slit, Failure):
        return slit
    model, pair = slit
    opened = open_model(model, pair, sheet)
    found = follow(opened, CLOSED_SHARE / pair.stable.s_ratio)
    return found if isinstance(found, Failure) else (laid_out(opened, found), pair.stable.s_ratio)


def laid_out(model: Model, pair: Pair) -> PlaneCell:
    """Return the two-unit cell of a solved sector."""
    tile, edge, s = tiling(model.density, 2), model.edge_mm, pair.stable.s_ratio
    local = model.nodes(pair.stable.y, s)
    copies = len(tile.turns)

    def laid(nodes: Array, stretch: float) -> Array:
        return np.asarray(np.einsum("cij,nj->cni", tile.turns, nodes) + stretch * edge * tile.moves[:, None]).reshape(
            -1, 2
        )

    triangles = model.elements[None] + len(local) * np.arange(copies)[:, None, None]
    return PlaneCell(
        laid(model.rest_mm, 1.0), laid(local, s), triangles.reshape(-1, 6), tile.owner.ravel(),
        edge * tile.jump.reshape(-1, 2), float(np.sqrt(0.75)) * edge**2, s,
    )  # fmt: skip


def plane_cell_of(library: CellLibrary, t_mm: float, theta_rad: float) -> tuple[PlaneCell, float] | Failure:
    """Return a cell of the library in the plane and the thickness that belongs to its size, or why there is none.

    D over E·h³/12 has no unit: a contracting cell is solved larger than it is cut, and as much thicker.
    """
    sheet = library.sheet
    if not is_contracting(library):
        found = plane_cell(t_mm, theta_rad, sheet)
        return found if isinstance(found, Failure) else (found, sheet.thickness_mm)
    opened = contracting_plane_cell(t_mm, theta_rad, sheet)
    return opened if isinstance(opened, Failure) else (opened[0], opened[1] * sheet.thickness_mm)


def chosen_cells(library: CellLibrary) -> Array:
    """Return the (t, θ) to be computed, `(k, 2)`: some per angle over its expansions, and the usual selection."""
    picks = []
    for theta in np.unique(library.theta_rad)[::COLUMN_STEP]:
        column = np.flatnonzero(library.theta_rad == theta)
        lam = library.expansion_ratio[column]
        count = max(2, 1 + int(np.ceil(np.ptp(lam) / EXPANSION_STEP_RATIO)))
        near = [int(np.argmin(np.abs(lam - want))) for want in np.linspace(lam.min(), lam.max(), count)]
        picks += [(library.t_mm[column[k]], theta) for k in sorted(set(near))]
    curve = selection_curve(library, SelectionOptions(rule="stiffest"))
    chosen = on_curve(curve, np.append(np.arange(*curve.range_ratio(), CURVE_STEP_RATIO), curve.range_ratio()[1]))
    picks += list(zip(chosen.t_mm, chosen.theta_rad, strict=True))
    return np.array(picks)


def compute_map(
    library: CellLibrary, layers: int = 1, watch: Callable[[float, str], None] | None = None
) -> tuple[dict[str, Array], list[str]]:
    """Return the columns of a bending map for the library's sheet, and what could not be computed."""
    sheet, rows, failures = library.sheet, [], []
    cells = chosen_cells(library)
    for k, (t, theta) in enumerate(cells):
        name = f"t {t:.3f} mm, θ {np.degrees(theta):.2f}°"
        solved = plane_cell_of(library, float(t), float(theta))
        if isinstance(solved, Failure):
            failures.append(f"{name}: {solved.reason}")
            continue
        cell, thickness_mm = solved
        try:
            found = bend(cell, thickness_mm, sheet.nu_ratio, layers)
        except NotConverged as fault:
            failures.append(f"{name}, expansion {cell.expansion_ratio:.4f}: {fault}")
            continue
        rows.append(
            (t, theta, cell.expansion_ratio, found.relative_ratio(thickness_mm), found.nu_ratio,
             found.anisotropy_ratio, found.expansion_ratio)
        )  # fmt: skip
        if watch is not None:
            watch((k + 1) / len(cells), name)
    table = np.array(rows)
    return {name: table[:, k] for k, name in enumerate(FIELDS)}, failures


def save_map(path: Path, library: CellLibrary, table: dict[str, Array], failures: list[str]) -> None:
    """Write the map; the same table gives the same bytes."""
    meta = {"format": FORMAT, "sheet": asdict(library.sheet), "library": library.hash, "failures": failures}
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(meta, sort_keys=True).encode(), dtype=np.uint8)
    np.savez_compressed(buffer, meta=text, **table)  # type: ignore[arg-type]
    path.write_bytes(buffer.getvalue())


def bending_for(library: CellLibrary) -> BendingMap:
    """Return the shipped map for a library's kind of cells."""
    return load_bending(SHIPPED_OPEN if is_contracting(library) else SHIPPED)


@functools.lru_cache(maxsize=4)
def load_bending(path: Path | None = None) -> BendingMap:
    """Return the map in `path`; without one, the shipped map of the paper's sheet."""
    source = SHIPPED if path is None else path
    try:
        with np.load(source) as file:
            table = {name: file[name] for name in FIELDS}
            meta = json.loads(file["meta"].tobytes())
    except (OSError, ValueError, KeyError) as fault:
        raise LibraryError(
            f"{source}: not a map of bending stiffness ({fault}); build one with scripts/build_bending.py"
        ) from fault
    if meta.get("format") != FORMAT:
        raise LibraryError(f"{source}: format {meta.get('format')}, this version reads {FORMAT}; build it anew")
    return BendingMap(Sheet(**meta["sheet"]), meta=meta, **table)
