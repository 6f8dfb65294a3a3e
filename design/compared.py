"""Two designs side by side, and the coupon that checks the library on real rubber."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from design.bundle import Bundle
from design.cells.homogenise import solve_cell
from design.cells.sheet import Sheet
from design.errors import DesignError
from design.pattern.drawing import Drawing
from design.pattern.font import Anchor, text_strokes
from design.pattern.paths import CutPath
from design.pattern.slits import outline_loops, slit_paths, slits_of
from design.pattern.tiling import lattice

GAP_MM = 12.0  # between patches, with the label in it


def compare(a: Bundle, b: Bundle) -> dict[str, Any]:
    """Return the facts of both designs, what B has over A, and how far cells at the same place differ."""
    facts_a, facts_b = a.manifest["facts"], b.manifest["facts"]
    numbers = [key for key in facts_a if isinstance(facts_a[key], int | float) and key in facts_b]
    ratios = {key: facts_b[key] / facts_a[key] for key in numbers if facts_a[key]}
    found: dict[str, Any] = {"a": dict(facts_a), "b": dict(facts_b), "b_over_a_ratio": ratios}
    found["same_files"] = sorted(name for name, d in a.manifest["files"].items() if b.manifest["files"].get(name) == d)
    found["same_library"] = a.manifest["library"] == b.manifest["library"]
    rows_a, rows_b = ({(row["cx_mm"], row["cy_mm"]): row for row in bundle.cells()} for bundle in (a, b))
    shared = sorted(rows_a.keys() & rows_b.keys())
    found["cells_at_the_same_place_count"] = len(shared)
    for name in ("t_mm", "theta_deg", "expansion_ratio", "hinge_mm") if shared else ():
        gap = [abs(float(rows_a[place][name]) - float(rows_b[place][name])) for place in shared]
        found[f"largest_difference_{name}"] = max(gap)
    return found


@dataclass(frozen=True, slots=True)
class Patch:
    """One uniform field of a coupon: its hinge, what it should expand by, and the length to measure."""

    label: str
    hinge_mm: float
    expansion_ratio: float | None  # None where the finite elements say that it is not bistable
    gauge_mm: float  # between the middles of its left and right borders, flat


def coupon(
    t_mm: float, theta_rad: float, hinges_mm: Sequence[float], sheet: Sheet, cells_count: tuple[int, int] = (6, 6)
) -> tuple[Drawing, list[Patch]]:
    """Return a sheet of uniform patches, one a hinge width, and what each should do when it is pulled open.

    Each patch is `cells_count` edges wide and rows high. Every hinge is solved by finite elements, not looked up.
    """
    if not hinges_mm:
        raise DesignError("a coupon needs at least one hinge width")
    columns, rows = cells_count
    edge = sheet.edge_mm
    paths: list[CutPath] = []
    patches = []
    width, height = edge * (columns + 0.5), edge * rows * np.sqrt(3) / 2
    for number, hinge in enumerate(hinges_mm):
        corner = np.array([GAP_MM + (number % 3) * (width + GAP_MM), GAP_MM + (number // 3) * (height + GAP_MM)])
        whole = lattice(np.zeros(2), np.array([width, height]), edge)
        first = whole.vertices_mm.min(axis=0)
        centre = whole.centres_mm() - first
        row = np.floor(centre[:, 1] / (edge * np.sqrt(3) / 2))
        mine = (row < rows) & (centre[:, 0] > 0.4 * edge) & (centre[:, 0] < (columns + 0.6) * edge)
        tiling = whole.part(mine).compact()
        tiling = tiling.moved(corner - tiling.vertices_mm.min(axis=0))
        same = np.ones(len(tiling.cells))
        slits = slits_of(tiling, t_mm * same, theta_rad * same, hinge * same, sheet.slit_mm)
        paths += slit_paths(tiling, slits)
        paths += [CutPath("outline", loop, closed=True) for loop in outline_loops(tiling)]
        label = f"{chr(65 + number)} {hinge:.3f}"
        at = Anchor(float(corner[0] + width / 2), float(corner[1] - GAP_MM / 2), 3.0, width)
        paths += text_strokes(label, at)
        solved = solve_cell(t_mm, theta_rad, replace(sheet, hinge_mm=hinge))
        patches.append(Patch(label, hinge, solved.expansion_ratio, columns * edge))
    points = np.vstack([path.points_mm for path in paths])
    high = points.max(axis=0) + GAP_MM
    return Drawing((float(high[0]), float(high[1])), tuple(paths)), patches


def coupon_csv(patches: Sequence[Patch]) -> str:
    """Return a form to fill in at the table: measured length and cycles beside what is expected."""
    lines = ["patch,hinge_mm,expected_expansion_ratio,flat_length_mm,measured_length_mm,cycles_count,failed_at"]
    for patch in patches:
        expected = "" if patch.expansion_ratio is None else f"{patch.expansion_ratio:.4f}"
        lines.append(f"{patch.label.split()[0]},{patch.hinge_mm:.4f},{expected},{patch.gauge_mm:.3f},,,")
    return "\n".join(lines) + "\n"
