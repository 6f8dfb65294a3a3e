"""A published map (CSV) as a library: its own entries, on the paper's sheet.

The map has no Poisson's ratio, no energy curves and no verdict on what it leaves out. The ratio is read off the shipped
library, which is the same sheet's; the rest stays unknown, and whoever asks for it is told so.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.cells.compare import Published, TableError, read_published
from design.cells.homogenise import CURVE_SHARES
from design.cells.library import FORMAT, VERDICTS, CellLibrary, LibraryError, load_library
from design.cells.sheet import Sheet

Array = NDArray[np.float64]
ENERGY_RATIO = 800.0  # published energies over E·thickness·edge²; fits stiffness within 3 %, the barrier within 10 %
OFF_GRID_RATIO = 0.05  # of a step: what rounding in print may do
LEAST_COUNT = 4  # rows and columns: interpolation is cubic
REASONS = ["an entry of the map", "not in the map"]


def published_library(path: Path) -> CellLibrary:
    """Return the library whose entries are those of a published map; raise `LibraryError` where it is none."""
    try:
        content = path.read_bytes()
        rows = read_published(content.decode("utf-8-sig"), Sheet())
    except (OSError, UnicodeDecodeError, TableError) as fault:
        raise LibraryError(f"{path}: not a published map of cells: {_why_not(fault)}") from fault
    sheet = Sheet()
    table = _table(path, rows, sheet)
    key = hashlib.sha256(content).hexdigest()
    meta = {
        "format": FORMAT,
        "sheet": asdict(sheet),
        "reasons": REASONS,
        "key": key,
        "command": f"the published map {path.name}",
    }
    return CellLibrary.of_table(table, meta, key, sheet)


def _why_not(fault: Exception) -> str:
    if isinstance(fault, UnicodeDecodeError):
        return "it is no text"
    return (fault.strerror or "cannot be read").lower() if isinstance(fault, OSError) else str(fault)


def _table(path: Path, rows: Published, sheet: Sheet) -> dict[str, Array]:
    """Return the candidates of the map's whole grid; where it has no entry nothing is known."""
    whole = np.isfinite([rows.expansion_ratio, rows.barrier_ratio, rows.stiffness_ratio]).all(axis=0)
    t_mm, theta = rows.t_mm[whole], rows.theta_rad[whole]
    column, theta_rad = _steps(path, "theta_rad", theta)
    row, levels_mm = _steps(path, "t_over_l0", t_mm)
    place = column * len(levels_mm) + row
    if len(np.unique(place)) < len(place):
        raise LibraryError(f"{path}: not a published map of cells: entries with the same t and theta")
    count = len(theta_rad) * len(levels_mm)

    def spread(values: Array) -> Array:
        found = np.full(count, np.nan)
        found[place] = values[whole]
        return found

    grid_t, grid_theta = np.tile(levels_mm, len(theta_rad)), np.repeat(theta_rad, len(levels_mm))
    grid_t[place] = t_mm  # as printed, to the last digit
    known = np.zeros(count, dtype=bool)
    known[place] = True
    scale = sheet.edge_mm**2 / ENERGY_RATIO
    unknown = np.full(count, np.nan)
    return {
        "t_mm": grid_t,
        "theta_rad": grid_theta,
        "verdict": np.where(known, VERDICTS.index("bistable"), VERDICTS.index(REASONS[1])).astype(float),
        "reason": np.where(known, 0.0, 1.0),
        "residual_ratio": unknown,
        "expansion_ratio": spread(rows.expansion_ratio),
        "saddle_ratio": unknown,
        "barrier_mm2": spread(rows.barrier_ratio) * scale,
        "stored_mm2": unknown,
        "stiffness_mm2": spread(rows.stiffness_ratio) * scale,
        "nu_tangent_ratio": np.where(known, _shipped_nu(grid_t, grid_theta), np.nan),
        "curve_row": np.zeros(0),
        "curve_mm2": np.zeros((0, len(CURVE_SHARES))),
    }


def _steps(path: Path, name: str, values: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the place of each value on an even grid, and the grid; raise `LibraryError` where there is none."""
    seen = np.unique(np.round(values, 7))
    if len(seen) < LEAST_COUNT:
        raise LibraryError(f"{path}: not a published map of cells: {len(seen)} different {name}, {LEAST_COUNT} needed")
    step = float(np.median(np.diff(seen)))
    place = (values - values.min()) / step
    near = np.round(place).astype(np.int64)
    if np.abs(place - near).max() > OFF_GRID_RATIO:
        raise LibraryError(f"{path}: not a published map of cells: its {name} are not evenly spaced")
    return near, values.min() + step * np.arange(near.max() + 1)


def _shipped_nu(t_mm: Array, theta_rad: Array) -> Array:
    """Return the tangent Poisson's ratio of the shipped library, at its rim that of the nearest cell."""
    from scipy.spatial import cKDTree

    shipped = load_library()
    found = shipped.at(t_mm, theta_rad).nu_tangent_ratio
    missing = ~np.isfinite(found)
    edge = shipped.sheet.edge_mm
    tree = cKDTree(np.column_stack([shipped.t_mm, edge * shipped.theta_rad]))
    _, at = tree.query(np.column_stack([t_mm, edge * theta_rad])[missing])
    found[missing] = shipped.nu_tangent_ratio[at]
    return np.asarray(found)
