"""The coupon: uniform patches of one cell, a hinge width each, that check the library on real rubber. Pure.

Each patch carries its letter, its hinge and the specimen's id on a tag of its own, so that it is known when it has left
the sheet.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely

from design.cells.homogenise import solve_cell
from design.cells.sheet import Sheet
from design.errors import DesignError
from design.export.dxf import dxf
from design.export.svg import svg
from design.findings import Finding
from design.job import Job
from design.pattern.border import BorderOptions, border_paths, registration_marks, with_tag
from design.pattern.drawing import Drawing
from design.pattern.font import Anchor, text_strokes
from design.pattern.paths import CutPath
from design.pattern.slits import outline_loops, slit_paths, slits_of
from design.pattern.tiling import Array, Tiling, lattice

GAP_MM = 8.0  # between patches with their tags: the sheet holds together while it is cut
LINE_MM, BETWEEN_MM = 2.6, 1.4  # height of the tag's two lines of text, and what lies between them
COLUMNS_COUNT = 3  # patches side by side
PATCHES_LIMIT_COUNT = 26  # letters
CELLS = ("cell", "cx_mm", "cy_mm", "inverted", "t_mm", "theta_deg", "expansion_ratio", "hinge_mm", "kind")
COUPON_CELLS = (*CELLS, "patch")
FORM = ("patch", "hinge_mm", "expected_expansion_ratio", "flat_length_mm", "measured_length_mm", "cycles_count",
        "failed_at")  # fmt: skip
FORM_HEAD = (
    "# A line a patch. preview.png shows the two notches of a patch to measure between: A1 and A2 of patch A.",
    "# hinge_mm and expected_expansion_ratio are for you to read: the tool takes them from cells.csv by the patch",
    "# flat_length_mm: from notch 1 to notch 2 before opening. As drawn; write over it what you measured.",
    "# measured_length_mm: the same opened and let go; several readings parted by spaces",
    "# cycles_count: how often it was opened and closed. failed_at: the cycle at which a hinge tore; empty if none did",
    "# then: fabctl design coupon-read with the specimen's id or this file where it lies",
)

BORDER = BorderOptions()


@dataclass(frozen=True, slots=True)
class Patch:
    """One uniform field of a coupon: its hinge, what it should expand by, and the length to measure."""

    label: str
    hinge_mm: float
    expansion_ratio: float | None  # None where the finite elements say that it is not bistable
    gauge_mm: float  # from a notch of its left border to the one across, flat
    notches_mm: Array  # (2, 2) these two places on the sheet


@dataclass(frozen=True, slots=True)
class PatchAsCut:
    """What the cells of a coupon's folder say of one patch."""

    hinge_mm: float
    expansion_ratio: float | None  # None where the finite elements say that it is not bistable


@dataclass(frozen=True, slots=True)
class Coupon:
    """A coupon as it is cut: the drawing, its patches, and the cells of each patch on the sheet."""

    t_mm: float
    theta_rad: float
    drawing: Drawing
    patches: tuple[Patch, ...]
    tilings: tuple[Tiling, ...]


def coupon(
    t_mm: float,
    theta_rad: float,
    hinges_mm: Sequence[float],
    sheet: Sheet,
    cells_count: tuple[int, int] = (6, 6),
    border: BorderOptions = BORDER,
    watch: Callable[[str, float], None] = lambda _message, _done_frac: None,
) -> Coupon:
    """Return a sheet of uniform patches, one a hinge width, and what each should do when it is pulled open.

    Each patch is `cells_count` edges wide and rows high. Every hinge is solved by finite elements, not looked up;
    `watch` hears which, and how much is done.
    Raises `DesignError` where a hinge leaves no slit.
    """
    _check(hinges_mm, t_mm, theta_rad, sheet)
    names = [f"{chr(65 + number)} {hinge:.3f}" for number, hinge in enumerate(hinges_mm)]
    drawn = [_patch(t_mm, theta_rad, hinge, sheet, cells_count, border) for hinge in hinges_mm]
    places, size = _places([piece.bounds for piece, *_ in drawn], border.sheet_margin_mm)
    paths: list[CutPath] = []
    anchors: list[Anchor] = []
    tilings = []
    for name, place, (piece, anchor, slits, tiling) in zip(names, places, drawn, strict=True):
        paths += [replace(path, points_mm=path.points_mm + place) for path in slits]
        paths += border_paths(piece, place)
        tilings.append(tiling.moved(place))
        if anchor is not None:
            x, y, half = anchor.x_mm + place[0], anchor.y_mm + place[1], (LINE_MM + BETWEEN_MM) / 2
            paths += text_strokes(name, Anchor(x, y + half, LINE_MM, anchor.width_mm))
            anchors.append(Anchor(x, y - half, LINE_MM, anchor.width_mm))
    paths += registration_marks(size, border) if border.marks else []
    first = anchors[0] if anchors else None
    solved = []
    for k, hinge in enumerate(hinges_mm):
        watch(f"solving a cell with hinges of {hinge:g} mm", k / len(hinges_mm))
        solved.append(solve_cell(t_mm, theta_rad, replace(sheet, hinge_mm=hinge)).expansion_ratio)
    watch("writing the folder", 1.0)
    gauge_mm = sheet.edge_mm * cells_count[0]
    patches = [
        Patch(name, hinge, expansion, gauge_mm, _notches_mm(tiling, gauge_mm))
        for name, hinge, expansion, tiling in zip(names, hinges_mm, solved, tilings, strict=True)
    ]
    drawing = Drawing(size, tuple(paths), first, None, tuple(anchors[1:]))
    return Coupon(t_mm, theta_rad, drawing, tuple(patches), tuple(tilings))


def _check(hinges_mm: Sequence[float], t_mm: float, theta_rad: float, sheet: Sheet) -> None:
    if not hinges_mm:
        raise DesignError("a coupon needs at least one hinge width")
    if len(hinges_mm) > PATCHES_LIMIT_COUNT:
        raise DesignError(f"a coupon has at most {PATCHES_LIMIT_COUNT} patches, a letter each, not {len(hinges_mm)}")
    found = []
    for hinge in hinges_mm:
        # A slit's length is l_i at a hinge of nothing; the hinge is taken off its end, along the slit.
        room = math.sin(math.pi / 3) * _slit_mm(t_mm, theta_rad, sheet)
        if not 0 < hinge < room:
            text = f"a hinge of {hinge:g} mm leaves no slit in this cell, which has room for hinges below {room:.3f} mm"
            found.append(Finding("COUPON-HINGE", text))
    if found:
        raise DesignError("; ".join(finding.message for finding in found), found)


def _slit_mm(t_mm: float, theta_rad: float, sheet: Sheet) -> float:
    """Return the length of a slit whose hinge has no width, by the straight part behind its kink."""
    tiling = lattice(np.zeros(2), np.full(2, 2 * sheet.edge_mm), sheet.edge_mm)
    one = np.ones(len(tiling.cells))
    slits = slits_of(tiling, t_mm * one, theta_rad * one, 0.0 * one, sheet.slit_mm)
    return float(np.linalg.norm(slits.inner_mm - slits.kink_mm, axis=-1).min())


def _patch(
    t_mm: float, theta_rad: float, hinge_mm: float, sheet: Sheet, cells_count: tuple[int, int], border: BorderOptions
) -> tuple[Any, Anchor | None, list[CutPath], Tiling]:
    """Return a patch with its tag, the tag's anchor, its slits, and its cells, wherever they lie."""
    columns, rows = cells_count
    edge, height = sheet.edge_mm, sheet.edge_mm * math.sqrt(3) / 2
    whole = lattice(np.zeros(2), np.array([edge * (columns + 0.5), rows * height]), edge)
    centre = whole.centres_mm() - whole.vertices_mm.min(axis=0)
    row = np.floor(centre[:, 1] / height)
    mine = (row < rows) & (centre[:, 0] > 0.4 * edge) & (centre[:, 0] < (columns + 0.6) * edge)
    tiling = whole.part(mine).compact()
    same = np.ones(len(tiling.cells))
    paths = slit_paths(tiling, slits_of(tiling, t_mm * same, theta_rad * same, hinge_mm * same, sheet.slit_mm))
    mouths = np.array([path.points_mm[-1] for path in paths if path.opens]).reshape(-1, 2)
    piece = shapely.union_all([shapely.Polygon(loop) for loop in outline_loops(tiling)])
    tag = replace(border, id_height_mm=2 * LINE_MM + BETWEEN_MM, code_module_mm=0.0)
    joined, anchor, _ = with_tag(piece, mouths, tag, edge, None)
    return joined, anchor, paths, tiling


def _notches_mm(tiling: Tiling, gauge_mm: float) -> Array:
    """Return the notches at both ends of the narrow row of corners nearest to the patch's middle."""
    corners = tiling.vertices_mm
    levels = np.unique(corners[:, 1].round(6))
    ends = []
    for level in levels[1:-1]:
        row = corners[np.isclose(corners[:, 1], level)]
        ends.append(row[[row[:, 0].argmin(), row[:, 0].argmax()]])
    narrow = [pair for pair in ends if math.isclose(pair[1, 0] - pair[0, 0], gauge_mm, abs_tol=1e-6)]
    return min(narrow, key=lambda pair: abs(float(pair[0, 1]) - float(levels.mean())))


def _places(bounds: Sequence[tuple[float, ...]], margin_mm: float) -> tuple[list[Array], tuple[float, float]]:
    """Return by how much each piece is moved, three in a row, and the sheet's size."""
    width = max(high_x - low_x for low_x, _, high_x, _ in bounds) + GAP_MM
    height = max(high_y - low_y for _, low_y, _, high_y in bounds) + GAP_MM
    found = []
    for number, (low_x, low_y, _, _) in enumerate(bounds):
        corner = margin_mm + np.array([number % COLUMNS_COUNT * width, number // COLUMNS_COUNT * height])
        found.append(corner - np.array([low_x, low_y]))
    across, up = min(len(bounds), COLUMNS_COUNT), -(-len(bounds) // COLUMNS_COUNT)
    return found, (across * width - GAP_MM + 2 * margin_mm, up * height - GAP_MM + 2 * margin_mm)


def coupon_csv(patches: Sequence[Patch]) -> str:
    """Return a form to fill in at the table: measured length and cycles beside what is expected."""
    lines = [*FORM_HEAD, ",".join(FORM)]
    for patch in patches:
        expected = "" if patch.expansion_ratio is None else f"{patch.expansion_ratio:.4f}"
        lines.append(f"{patch.label.split()[0]},{patch.hinge_mm:.4f},{expected},{patch.gauge_mm:.3f},,,")
    return "\n".join(lines) + "\n"


def coupon_cells_csv(made: Coupon) -> str:
    """Return one row a cell, as a design's `cells.csv`; a patch that springs back counts as monostable."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COUPON_CELLS)
    number = 0
    for patch, tiling in zip(made.patches, made.tilings, strict=True):
        kind = "cut" if patch.expansion_ratio is not None else "monostable"
        values = made.t_mm, math.degrees(made.theta_rad), patch.expansion_ratio or 1.0, patch.hinge_mm
        for (x, y), inverted in zip(tiling.centres_mm().tolist(), tiling.inverted.tolist(), strict=True):
            place, letter = (f"{x:.6f}", f"{y:.6f}", int(inverted)), patch.label.split()[0]
            rows.writerow((number, *place, *(f"{v:.6f}" for v in values), kind, letter))
            number += 1
    return text.getvalue()


def patches_as_cut(cells: Sequence[Mapping[str, str]]) -> dict[str, PatchAsCut]:
    """Return the patches by their letters from the rows of a coupon's `cells.csv`."""
    found = {}
    for row in cells:
        expansion = float(row["expansion_ratio"]) if row["kind"] == "cut" else None
        found[row["patch"]] = PatchAsCut(float(row["hinge_mm"]), expansion)
    return found


def coupon_facts(made: Coupon, job: Job, edge_mm: float) -> dict[str, Any]:
    """Return the numbers that a summary shows, with their units, named as a design's."""
    known = [patch.expansion_ratio for patch in made.patches if patch.expansion_ratio is not None]
    spread = {"expansion_low_ratio": min(known), "expansion_high_ratio": max(known)} if known else {}
    return {
        "patches_count": len(made.patches),
        "cells_count": sum(len(tiling.cells) for tiling in made.tilings),
        "cell_mm": edge_mm,
        **spread,
        "sheet_mm": list(made.drawing.size_mm),
        "cut_mm": job.cut_mm,
        "travel_mm": job.travel_mm,
        "cut_time_s": job.time_s,
        "patches": [
            {"patch": p.label.split()[0], "hinge_mm": p.hinge_mm, "expected_expansion_ratio": p.expansion_ratio}
            for p in made.patches
        ],
    }


def coupon_texts(made: Coupon, job: Job) -> Mapping[str, str]:
    """Return the coupon's drawings, program, cells and form by the names of their files."""
    return {
        "cut.dxf": dxf(made.drawing.paths, made.drawing.size_mm),
        "cut.svg": svg(made.drawing.paths, made.drawing.size_mm, "coupon"),
        "cut.nc": "\n".join(job.lines) + "\n",
        "cells.csv": coupon_cells_csv(made),
        "coupon.csv": coupon_csv(made.patches),
    }
