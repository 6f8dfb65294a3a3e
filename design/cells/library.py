"""The library of bistable cells: a table over (t, θ), and its interpolation.

Stored per E·thickness; `load_library` and `scaled` give it for a sheet. Energies are per hexagonal cell and over the
whole thickness, in mJ; the tangent modulus Y is per width, in N/mm.
"""

from __future__ import annotations

import functools
import io
import json
import math
import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import SQRT3
from design.cells.homogenise import CURVE_SHARES, Cell
from design.cells.interpolate import Grid, grid_of
from design.cells.sheet import Sheet
from design.cells.sweep import Plan
from design.errors import UnreadableFile

Array = NDArray[np.float64]
FORMAT = 1
SHIPPED = Path(__file__).parent / "data" / "library.npz"
SHIPPED_OPEN = SHIPPED.with_name("library-open.npz")
VERDICTS = ("bistable", "not bistable", "invalid", "not converged", "not in the map")  # the last: never solved
NUMBERS = (
    "expansion_ratio",
    "saddle_ratio",
    "barrier_mm2",
    "stored_mm2",
    "stiffness_mm2",
    "nu_tangent_ratio",
    "mesh_ratio",
)
OPEN_NUMBERS = ("open_ratio", "overlap_frac")


class LibraryError(UnreadableFile):
    """The file is not a library, or not one this version reads."""


@dataclass(frozen=True, slots=True)
class CellProperties:
    """Interpolated cells, arrays of the shape asked for; NaN where `inside` is False."""

    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    barrier_mJ: Array
    stiffness_mJ: Array
    Y_N_mm: Array
    nu_tangent_ratio: Array
    inside: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class EnergyCurve:
    """Energy and force of the even stretch of one hexagonal cell, (n,) each."""

    stretch_ratio: Array
    energy_mJ: Array
    force_mJ: Array  # dE/ds


_P5 = int(np.argmin(np.abs(CURVE_SHARES - 1)))


@dataclass(frozen=True, slots=True)
class CellLibrary:
    """All bistable cells of a sheet, (n,) each, and the verdict on every other candidate."""

    sheet: Sheet
    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    barrier_mJ: Array
    stiffness_mJ: Array  # d²E*/dε² of the hexagonal cell, ε relative to the flat sheet
    Y_N_mm: Array  # tangent modulus at the second stable state, per width
    nu_tangent_ratio: Array
    hash: str
    meta: dict[str, Any]
    table: dict[str, Array]  # every candidate, as stored
    grid: Grid

    def __len__(self) -> int:
        return len(self.t_mm)

    def range_ratio(self) -> tuple[float, float]:
        """Return the least and the greatest expansion over all bistable cells."""
        return float(self.expansion_ratio.min()), float(self.expansion_ratio.max())

    def counts(self) -> dict[str, int]:
        """Return how many candidates came to each verdict."""
        codes = Counter(self.table["verdict"].astype(int).tolist())
        return {name: codes.get(k, 0) for k, name in enumerate(VERDICTS)}

    def reasons(self) -> dict[str, int]:
        """Return why candidates are not in the library, most frequent first; figures inside a reason are left out."""
        words = [_general(self.meta["reasons"][int(k)]) for k in self.table["reason"][self.table["verdict"] != 0]]
        return dict(Counter(words).most_common())

    def shallow_cells(self) -> tuple[Array, Array]:
        """Return (t_mm, theta_rad), (n,) each, of the cells whose shallow well was decided at half the mesh size."""
        rows = self.table.get("mesh_ratio", np.ones(len(self.table["t_mm"]))) < 1
        return self.table["t_mm"][rows], self.table["theta_rad"][rows]

    def at(self, t_mm: Array | float, theta_rad: Array | float) -> CellProperties:
        """Return the cells (t, θ), broadcast; NaN and `inside` False where no bistable cells surround the point."""
        t, theta = np.broadcast_arrays(np.asarray(t_mm, dtype=float), np.asarray(theta_rad, dtype=float))
        values = self.grid(t.ravel(), theta.ravel()).reshape(-1, *t.shape)
        lam, barrier, stiffness, nu = values
        scale = energy_scale_mJ(self.sheet)
        return CellProperties(
            t, theta, lam, barrier * scale, stiffness * scale, stiffness * scale / hexagon_mm2(self.sheet), nu,
            np.isfinite(lam),
        )  # fmt: skip

    def energy_curve(self, t_mm: float, theta_rad: float) -> EnergyCurve:
        """Return the energy of one cell's even stretch, from flat past its second stable state.

        The shape is blended from the nearest kept curves (every tenth cell of each column); its height at the saddle
        and at the second state is that of the map. Raises `LibraryError` outside the map.
        """
        here = self.at(t_mm, theta_rad)
        if not here.inside:
            raise LibraryError(f"no bistable cell at t = {t_mm:g} mm, θ = {math.degrees(theta_rad):g}°")
        stored_mm2 = float(self._read("stored_mm2", t_mm, theta_rad))
        rows, curves = self.table["curve_row"].astype(int), self.table["curve_mm2"]
        if not len(rows):
            raise LibraryError(f"{self.meta['command']} has no energy curves")
        away = np.hypot(
            (self.table["t_mm"][rows] - t_mm) / self.sheet.edge_mm, self.table["theta_rad"][rows] - theta_rad
        )
        near = np.argsort(away, kind="stable")[:4]
        weights = 1 / (away[near] + 1e-9)
        barrier, stored = self.table["barrier_mm2"][rows[near]], self.table["stored_mm2"][rows[near]]
        # Before the saddle the height is that of the saddle, behind it the well is measured from its own floor.
        scale, total = energy_scale_mJ(self.sheet), np.zeros(curves.shape[1])
        top = float(here.barrier_mJ) / scale + stored_mm2
        for k, w in zip(range(len(near)), weights / weights.sum(), strict=True):
            curve, peak = curves[near[k]], barrier[k] + stored[k]
            climb = curve * top / peak
            well = stored_mm2 + (curve - stored[k]) * (top - stored_mm2) / barrier[k]
            total += w * np.where(np.arange(len(curve)) <= np.argmax(curve[: _P5 + 1]), climb, well)
        stretch = 1 + CURVE_SHARES * (float(here.expansion_ratio) - 1)
        return EnergyCurve(stretch, total * scale, np.gradient(total * scale, stretch))

    def _read(self, name: str, t_mm: float, theta_rad: float) -> float:
        grid = grid_of(self.table["t_mm"], self.table["theta_rad"], self.table[name][None], self.sheet)
        return float(grid(np.array([t_mm]), np.array([theta_rad]))[0, 0])

    @classmethod
    def of_table(cls, table: dict[str, Array], meta: dict[str, Any], key: str, sheet: Sheet) -> CellLibrary:
        """Return the library of a table of candidates, whose `meta` says for which sheet it stands."""
        return _with_sheet(table, meta, key, sheet)

    def firm(self) -> CellLibrary:
        """Return the library without its shallow wells: where the mesh changes, the map has a small step."""
        shallow = self.table.get("mesh_ratio", np.ones(len(self.table["t_mm"]))) < 1
        read = ("expansion_ratio", "barrier_mm2", "stiffness_mm2", "nu_tangent_ratio")
        kept = {name: np.where(shallow, np.nan, self.table[name]) for name in read}
        return _with_sheet({**self.table, **kept}, self.meta, self.hash, self.sheet)

    def scaled(self, sheet: Sheet) -> CellLibrary:
        """Return the library for a sheet of the same slit/edge, hinge/edge and ν: lengths and energies only scale."""
        mine, asked = shape_of(self.sheet), shape_of(sheet)
        if not np.allclose(mine, asked, rtol=1e-9):
            raise LibraryError(
                f"this library is for slit/edge, hinge/edge, ν = {mine}, the sheet has {asked}; "
                "build one with `fabctl library build`"
            )
        return _with_sheet(self.table, self.meta, self.hash, sheet)


def _general(reason: str) -> str:
    return re.sub(r":? (up to the stretch )?-?\d[\d.e+-]*( mm²)?$", "", reason)


def shape_of(sheet: Sheet) -> tuple[float, float, float]:
    """Return what decides a cell's expansion: slit/edge, hinge/edge and ν."""
    return sheet.slit_mm / sheet.edge_mm, sheet.hinge_mm / sheet.edge_mm, sheet.nu_ratio


def hexagon_mm2(sheet: Sheet) -> float:
    """Return the flat area of the hexagonal cell, six units."""
    return 6 * SQRT3 / 4 * sheet.edge_mm**2


def energy_scale_mJ(sheet: Sheet) -> float:
    """Return the mJ in one mm² of energy per E·thickness (MPa·mm·mm² = N·mm = mJ)."""
    return sheet.E_MPa * sheet.thickness_mm


def table_of(cells: Sequence[Cell]) -> tuple[dict[str, Array], list[str]]:
    """Return the cells as columns of numbers, NaN where there is none, and the reasons that `reason` counts into."""
    reasons = sorted({cell.reason for cell in cells})
    place = {reason: k for k, reason in enumerate(reasons)}
    table = {
        "t_mm": np.array([c.t_mm for c in cells]),
        "theta_rad": np.array([c.theta_rad for c in cells]),
        "verdict": np.array([float(VERDICTS.index(c.verdict)) for c in cells]),
        "reason": np.array([float(place[c.reason]) for c in cells]),
        "residual_ratio": np.array([c.residual_ratio for c in cells]),
    }
    is_open = any(c.open_ratio is not None for c in cells)
    for name in (*NUMBERS, *(OPEN_NUMBERS if is_open else ())):
        values = (getattr(c, name) for c in cells)
        table[name] = np.array([np.nan if value is None else value for value in values], dtype=float)
    kept = [k for k, c in enumerate(cells) if c.curve_mm2 is not None]
    table["curve_row"] = np.array(kept, dtype=float)
    table["curve_mm2"] = np.array([cells[k].curve_mm2 for k in kept], dtype=float).reshape(-1, len(CURVE_SHARES))
    return table, reasons


def save_library(path: Path, plan: Plan, sheet: Sheet, cells: Sequence[Cell], command: str) -> None:
    """Write the library; the same cells give the same bytes."""
    table, reasons = table_of(cells)
    meta = {
        "format": FORMAT,
        "sheet": asdict(sheet),
        "plan": asdict(plan),
        "key": plan.key(),
        "reasons": reasons,
        "command": command,
    }
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(meta, sort_keys=True).encode(), dtype=np.uint8)
    np.savez_compressed(buffer, meta=text, **table)  # type: ignore[arg-type]
    draft = path.with_suffix(".tmp")
    draft.write_bytes(buffer.getvalue())
    draft.replace(path)


@functools.lru_cache(maxsize=4)
def load_library(path: Path | None = None) -> CellLibrary:
    """Return the library in `path`, an .npz or a published map as .csv; without one, the shipped library."""
    source = SHIPPED if path is None else path
    if source.suffix.lower() == ".csv":
        from design.cells.published_map import published_library

        return published_library(source)
    try:
        with np.load(source) as file:
            table = {name: file[name] for name in file.files if name != "meta"}
            meta = json.loads(file["meta"].tobytes())
    except (OSError, ValueError, KeyError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as fault:
        raise LibraryError(f"{source}: {_why_not(fault)}; build one with `fabctl library build`") from fault
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        told = meta.get("format") if isinstance(meta, dict) else "unknown"
        raise LibraryError(f"{source}: format {told}, this version reads {FORMAT}; build it anew")
    try:
        return _with_sheet(table, meta, meta["key"], Sheet(**meta["sheet"]))
    except (ValueError, KeyError, TypeError, IndexError) as fault:
        raise LibraryError(f"{source}: is damaged: its table is not whole; build it anew") from fault


def _why_not(fault: Exception) -> str:
    """Return in words why a file is no library: NumPy's are about pickles and magic strings."""
    if isinstance(fault, FileNotFoundError):
        return "no such file"
    if isinstance(fault, OSError) and fault.strerror:
        return f"cannot be read: {fault.strerror.lower()}"
    return "holds no library of cells" if isinstance(fault, KeyError) else "is no library of cells, or damaged"


def _with_sheet(table: dict[str, Array], meta: dict[str, Any], key: str, sheet: Sheet) -> CellLibrary:
    stretch = sheet.edge_mm / Sheet(**meta["sheet"]).edge_mm
    moved = {name: values * _length_power(name, stretch) for name, values in table.items()}
    good = moved["verdict"] == 0
    scale = energy_scale_mJ(sheet)
    grid = grid_of(
        moved["t_mm"],
        moved["theta_rad"],
        np.array([moved[name] for name in ("expansion_ratio", "barrier_mm2", "stiffness_mm2", "nu_tangent_ratio")]),
        sheet,
    )
    return CellLibrary(
        sheet=sheet,
        t_mm=moved["t_mm"][good],
        theta_rad=moved["theta_rad"][good],
        expansion_ratio=moved["expansion_ratio"][good],
        barrier_mJ=moved["barrier_mm2"][good] * scale,
        stiffness_mJ=moved["stiffness_mm2"][good] * scale,
        Y_N_mm=moved["stiffness_mm2"][good] * scale / hexagon_mm2(sheet),
        nu_tangent_ratio=moved["nu_tangent_ratio"][good],
        hash=key,
        meta={**meta, "sheet": asdict(sheet)},
        table=moved,
        grid=grid,
    )


def _length_power(name: str, stretch: float) -> float:
    return stretch**2 if name.endswith("_mm2") else stretch if name.endswith("_mm") else 1.0
