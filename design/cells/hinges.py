"""The library for another hinge: what a hinge's width changes, swept at four widths beside the library's own.

The shipped file holds the same candidates (t, θ) at several hinge widths, by the library's own solver on its own mesh.
A field at another width is the library's plus a difference, quadratic in the width between the three nearest ones.
"""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.cells.homogenise import Cell
from design.cells.interpolate import Grid, grid_of
from design.cells.library import VERDICTS, CellLibrary, LibraryError, load_library, shape_of
from design.cells.sheet import Sheet
from design.errors import DesignError

Array = NDArray[np.float64]
SHIPPED_HINGES = Path(__file__).parent / "data" / "hinges.npz"
FIELDS = ("expansion_ratio", "barrier_mm2", "stiffness_mm2", "nu_tangent_ratio")  # in the order of a library's grid
SAME_RATIO = 1e-9
NEAR_RATIO = 0.003  # of the edge: a step and a half of the sweeps' columns


@dataclass(frozen=True, slots=True)
class Hinges:
    """Candidates `(n,)` swept at several hinge widths `(w,)`: fields `(w, 4, n)`, NaN where not bistable."""

    sheet: Sheet  # its hinge is that of the library beside
    hinge_mm: Array
    t_mm: Array
    theta_rad: Array
    fields: Array


def save_hinges(path: Path, sheet: Sheet, swept: Mapping[float, Sequence[Cell]]) -> None:
    """Write the sweeps; all must be over the same candidates."""
    first = next(iter(swept.values()))
    names = np.array([[[getattr(c, name) for c in cells] for name in FIELDS] for cells in swept.values()], dtype=float)
    buffer = io.BytesIO()
    meta = np.frombuffer(json.dumps(asdict(sheet), sort_keys=True).encode(), dtype=np.uint8)
    np.savez_compressed(
        buffer, meta=meta, hinge_mm=np.array(list(swept)), fields=names.astype(np.float32),
        t_mm=np.array([c.t_mm for c in first]), theta_rad=np.array([c.theta_rad for c in first]),
    )  # fmt: skip
    path.write_bytes(buffer.getvalue())


@functools.lru_cache(maxsize=2)
def load_hinges(path: Path = SHIPPED_HINGES) -> Hinges:
    """Return the shipped sweeps."""
    try:
        with np.load(path) as file:
            sheet = Sheet(**json.loads(file["meta"].tobytes()))
            fields = file["fields"].astype(np.float64)
            return Hinges(sheet, file["hinge_mm"], file["t_mm"], file["theta_rad"], fields)
    except (OSError, ValueError, KeyError) as fault:
        raise LibraryError(f"{path}: not a file of hinges ({fault}); scripts/build_hinges.py writes it") from fault


def with_hinge(library: CellLibrary, hinge_mm: float) -> CellLibrary:
    """Return the library of the same cells cut with another hinge.

    Raises `DesignError` where the shipped sweeps do not reach so far, or belong to another sheet.
    """
    sheet = library.sheet
    if abs(hinge_mm / sheet.hinge_mm - 1) < SAME_RATIO:
        return library
    known = load_hinges()
    check_reach(library, hinge_mm)
    width = hinge_mm / sheet.edge_mm * known.sheet.edge_mm
    change = _change(library, known, width)
    table = dict(library.table)
    good = np.flatnonzero(table["verdict"] == VERDICTS.index("bistable"))
    change_here = change(table["t_mm"][good], table["theta_rad"][good])
    for name, values in zip(FIELDS, change_here, strict=True):
        table[name] = table[name].copy()
        table[name][good] += values
    table["verdict"] = table["verdict"].copy()
    lost = good[~(np.isfinite(change_here).all(axis=0) & (table["barrier_mm2"][good] > 0))]
    table["verdict"][lost] = VERDICTS.index("not converged")  # nothing is known of them at this hinge
    for name in FIELDS:
        table[name][lost] = np.nan
    if hinge_mm < sheet.hinge_mm:  # what springs back with the library's hinge may stay open with a narrower one
        table["verdict"][_opened_by_less(library, known)] = VERDICTS.index("not converged")
    key = f"{library.hash}, hinge {width:.6f}"
    cut = replace(sheet, hinge_mm=hinge_mm)
    return CellLibrary.of_table(table, {**library.meta, "sheet": asdict(cut)}, key, cut)


def check_reach(library: CellLibrary, hinge_mm: float) -> None:
    """Raise `DesignError` where the library cannot be had for this hinge."""
    known, sheet = load_hinges(), library.sheet
    if not np.allclose(shape_of(sheet), shape_of(known.sheet), rtol=1e-6):
        raise DesignError(
            f"a hinge of {hinge_mm:g} mm is not the library's {sheet.hinge_mm:g} mm, and other hinges are known for "
            "the shipped library's sheet alone; build a library with this hinge (`fabctl library build`)"
        )
    low, high = (float(w) * sheet.edge_mm / known.sheet.edge_mm for w in (known.hinge_mm.min(), known.hinge_mm.max()))
    if not low * (1 - SAME_RATIO) <= hinge_mm <= high * (1 + SAME_RATIO):
        raise DesignError(
            f"a hinge of {hinge_mm:g} mm is outside the {low:g} to {high:g} mm that are known for cells of "
            f"{sheet.edge_mm:g} mm; build a library with this hinge (`fabctl library build`)"
        )


def _change(library: CellLibrary, known: Hinges, width_mm: float) -> Grid:
    """Return the differences from the shipped library's fields, whose mesh the sweeps have, as its columns lie."""
    stretch = library.sheet.edge_mm / known.sheet.edge_mm
    t = known.t_mm * stretch
    base = load_library().scaled(library.sheet).grid(t, known.theta_rad)
    lengths = np.array([1.0, stretch**2, stretch**2, 1.0])[:, None]
    widths = np.append(known.hinge_mm, known.sheet.hinge_mm)
    fields = np.concatenate([known.fields * lengths, base[None]])
    order = np.argsort(widths)
    at, weights = _quadratic(widths[order], width_mm)
    change = sum(w * fields[order[k]] for k, w in zip(at, weights, strict=True)) - base
    return grid_of(t, known.theta_rad, np.asarray(change), library.sheet)


def _quadratic(nodes: Array, x: float) -> tuple[list[int], list[float]]:
    """Return the three nodes about `x`, narrower ones where there is a choice, and their weights."""
    above = int(np.clip(np.searchsorted(nodes, x - 1e-12), 1, len(nodes) - 1))
    first = max(0, above - 2)
    at = [first, first + 1, first + 2]
    weights = [float(np.prod([(x - nodes[j]) / (nodes[i] - nodes[j]) for j in at if j != i])) for i in at]
    return at, weights


def _opened_by_less(library: CellLibrary, known: Hinges) -> NDArray[np.bool_]:
    """Say which candidates spring back with the library's hinge, but lie by one that stays open with the narrowest."""
    from scipy.spatial import cKDTree

    stretch, edge = library.sheet.edge_mm / known.sheet.edge_mm, library.sheet.edge_mm
    opened = np.isfinite(known.fields[int(np.argmin(known.hinge_mm)), 0])
    tree = cKDTree(np.column_stack([known.t_mm * stretch, edge * known.theta_rad])[opened])
    away, _ = tree.query(np.column_stack([library.table["t_mm"], edge * library.table["theta_rad"]]))
    near = away < NEAR_RATIO * edge
    return np.asarray(near & (library.table["verdict"] == VERDICTS.index("not bistable")))


def ladder(library: CellLibrary, narrow_mm: float, wide_mm: float, count: int) -> list[CellLibrary]:
    """Return the library at `count` hinge widths in even steps."""
    return [with_hinge(library, float(w)) for w in np.linspace(narrow_mm, wide_mm, count)]


def cells_as_cut(library: CellLibrary, t_mm: Array, theta_rad: Array, hinge_mm: Array) -> dict[str, Any]:
    """Return expansion, barrier and stiffness of cells `(k,)` each with its own hinge; NaN where none stays open."""
    low, high = float(hinge_mm.min()), float(hinge_mm.max())
    count = 1 if high - low < SAME_RATIO else 5
    rungs = ladder(library, low, high, count)
    names = ("expansion_ratio", "barrier_mJ", "stiffness_mJ")
    found = [rung.at(t_mm, theta_rad) for rung in rungs]
    if count == 1:
        return {name: getattr(found[0], name) for name in names}
    place = (hinge_mm - low) / (high - low) * (count - 1)
    k = np.minimum(place.astype(np.int64), count - 2)
    here, share = np.arange(len(place)), place - k
    stacked = {name: np.array([getattr(one, name) for one in found]) for name in names}
    return {name: (1 - share) * v[k, here] + share * v[k + 1, here] for name, v in stacked.items()}
