"""Print and cut: where a sheet with registration marks lies on the bed, as an affine map from sheet to machine.

The sheet may be moved, turned, and stretched by a known little; upside down, sheared or stretched further it is
refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding, errors
from fabctl.errors import RefusedError, UsageError
from fabctl.files import json_of, why_not
from fabctl.records.folder import as_json, write_atomically
from fabctl.vision.align import Alignment, known_markers, mark_findings
from fabctl.vision.boards import MarkSheet
from fabctl.vision.quality import picture_findings
from fabctl.vision.template import F64

FORMAT = 1
LEAST_MARKS_COUNT = 4
MOST_STRETCH_RATIO = 0.02
MOST_SHEAR_RAD = 0.01
MOST_RMS_MM = 0.1
MOST_WORST_MM = 0.25
OUTLINE_REACH_MM = 4.0
MOST_OUTLINE_MM = 1.0
LEAST_EDGE_GREY = 8.0
OUTLINE_PLACES = np.linspace(0.06, 0.94, 12)


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the sheet lies: a sheet point p is at `affine` (2, 3) times (p, 1) in machine millimetres."""

    sheet: str
    size_mm: tuple[float, float]
    affine: F64
    marks_count: int
    rms_mm: float  # of each mark when the others alone decide
    worst_mm: float
    height_mm: float
    made_utc: str

    @property
    def turn_rad(self) -> float:
        """Return how the sheet is turned against the machine."""
        return math.atan2(self.affine[1, 0], self.affine[0, 0])

    @property
    def stretch_ratio(self) -> tuple[float, float]:
        """Return the sheet's true length over the told one, along its x and y."""
        return float(np.hypot(*self.affine[:, 0])), float(np.hypot(*self.affine[:, 1]))

    @property
    def shear_rad(self) -> float:
        """Return by how much the sheet's corner is off a right angle."""
        x, y = self.affine[:, 0], self.affine[:, 1]
        return float(math.pi / 2 - math.acos(np.clip(x @ y / (np.hypot(*x) * np.hypot(*y)), -1, 1)))


def apply(affine: F64, points_mm: F64) -> F64:
    """Return points (n, 2) of the sheet in machine millimetres."""
    return np.asarray(points_mm @ affine[:, :2].T + affine[:, 2], dtype=np.float64)


def moved_mm(before: Registration, now: Registration) -> float:
    """Return how far a corner of the sheet lies from where it lay, at most."""
    w, h = before.size_mm
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    return float(np.linalg.norm(apply(before.affine, corners) - apply(now.affine, corners), axis=1).max())


def fit_affine(source_mm: F64, target_mm: F64) -> F64:
    """Return the affine map (2, 3) that takes points (n, 2) to `target_mm` with the least squares."""
    rows = np.column_stack([source_mm, np.ones(len(source_mm))])
    return np.asarray(np.linalg.lstsq(rows, target_mm, rcond=None)[0].T, dtype=np.float64)


def register(
    image: NDArray[np.uint8], source: str, sheet: MarkSheet, alignment: Alignment, height_mm: float, made_utc: str
) -> Registration:
    """Return where the sheet lies; its marks are `height_mm` over the machine's zero plane (the sheet's thickness).

    Raises `RefusedError` with every reason against.
    """
    found = picture_findings(image, source, alignment.lens.size_px)
    if errors(found):
        raise RefusedError("the bed picture cannot be measured in", found)
    markers = known_markers(image, sheet)
    found += mark_findings(markers, image, sheet, LEAST_MARKS_COUNT)
    if errors(found):
        raise RefusedError("the sheet is not found", found)
    pairs = [(marker, mark) for marker in markers if (mark := sheet.mark(marker.id)) is not None]
    told = np.array([mark.centre_mm for _, mark in pairs])
    seen = alignment.to_machine(np.array([marker.centre_px for marker, _ in pairs]), height_mm)
    alone = np.array([_left_out(k, told, seen) for k in range(len(told))])
    rms, worst = math.sqrt(float(np.mean(alone**2))), float(alone.max())
    made = Registration(sheet.name, sheet.size_mm, fit_affine(told, seen), len(told), rms, worst, height_mm, made_utc)
    found += registration_findings(made)
    if errors(found):
        raise RefusedError("the sheet does not lie as it may", found)
    return made


def _left_out(k: int, told: F64, seen: F64) -> float:
    rest = np.arange(len(told)) != k
    return float(np.linalg.norm(apply(fit_affine(told[rest], seen[rest]), told[k : k + 1])[0] - seen[k]))


def registration_findings(made: Registration) -> list[Finding]:
    """Return what speaks against the map itself: mirrored, stretched, sheared, or marks that contradict each other."""
    found = []
    if float(np.linalg.det(made.affine[:, :2])) <= 0:
        found.append(Finding("SHEET-MIRRORED", "the sheet lies upside down", where=made.sheet, hint="turn it over"))
        return found
    for axis, ratio in zip("xy", made.stretch_ratio, strict=True):
        if abs(ratio - 1) > MOST_STRETCH_RATIO:
            text = f"the sheet is {ratio:.4f} times its told length along {axis}, 1 ± {MOST_STRETCH_RATIO:g} is allowed"
            found.append(
                Finding("SHEET-STRETCH", text, where=made.sheet, hint="another sheet, or the wrong thickness?")
            )
    if abs(made.shear_rad) > MOST_SHEAR_RAD:
        off_deg, most_deg = math.degrees(made.shear_rad), math.degrees(MOST_SHEAR_RAD)
        text = f"the sheet is {off_deg:.2f}° off square, {most_deg:.2f}° is allowed"
        found.append(Finding("SHEET-SHEAR", text, where=made.sheet, hint="lay it without pulling"))
    if made.rms_mm > MOST_RMS_MM or made.worst_mm > MOST_WORST_MM:
        text = f"marks contradict each other by {made.rms_mm:.2f} mm rms, {made.worst_mm:.2f} mm at worst"
        hint = f"{MOST_RMS_MM:g} and {MOST_WORST_MM:g} mm are allowed; does the sheet lie flat?"
        found.append(Finding("SHEET-RESIDUAL", text, where=made.sheet, hint=hint))
    return found


def outline_findings(job_mm: F64, size_mm: tuple[float, float], margin_mm: float = 0.0) -> list[Finding]:
    """Return an error where the job, points (n, 2) in the sheet's frame, leaves the sheet less `margin_mm`."""
    low, high = job_mm.min(axis=0) - margin_mm, job_mm.max(axis=0) + margin_mm
    found = []
    for axis, k in (("x", 0), ("y", 1)):
        if low[k] < 0 or high[k] > size_mm[k]:
            text = f"the job needs {axis} {low[k]:.2f} to {high[k]:.2f} mm, the sheet has 0 to {size_mm[k]:g} mm"
            found.append(Finding("SHEET-OUTLINE", text, hint="a larger sheet, or the job moved on it"))
    return found


def seen_outline(image: NDArray[np.uint8], alignment: Alignment, made: Registration) -> dict[str, float | None]:
    """Return, for each side of the sheet, how far outside its told place its edge is seen, mm; None where none is seen.

    The strongest step of brightness across the told edge, the median over a dozen places of each side.
    """
    w, h = made.size_mm
    sides = {"left": ((0, 0), (0, h)), "right": ((w, 0), (w, h)), "lower": ((0, 0), (w, 0)), "upper": ((0, h), (w, h))}
    grey = image.astype(np.float64)
    centre = np.array([w / 2, h / 2])
    return {
        name: _edge_offset(grey, alignment, made, np.array(ends, dtype=float), centre) for name, ends in sides.items()
    }


def _edge_offset(grey: F64, alignment: Alignment, made: Registration, ends: F64, centre: F64) -> float | None:
    from fabctl.vision.template import look

    step_mm = alignment.mm_per_px(apply(made.affine, centre[None])[0])
    along = ends[1] - ends[0]
    outward = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    outward *= np.sign(outward @ (ends.mean(axis=0) - centre))
    reach = np.arange(-OUTLINE_REACH_MM, OUTLINE_REACH_MM, step_mm)
    offsets = []
    for share in OUTLINE_PLACES:
        points = ends[0] + share * along + reach[:, None] * outward
        row = look(grey, alignment.to_pixels(apply(made.affine, points), made.height_mm))
        steps = np.abs(row[4:] - row[:-4])
        if steps.max() >= LEAST_EDGE_GREY:
            offsets.append(float(reach[int(steps.argmax()) + 2]))
    if len(offsets) < len(OUTLINE_PLACES) / 2:
        return None
    return float(np.median(offsets))


def seen_outline_findings(seen: dict[str, float | None]) -> list[Finding]:
    """Return an error where the sheet is seen to end short, a warning where its edge is not seen."""
    found = []
    for side, offset in seen.items():
        if offset is None:
            text = f"the sheet's {side} edge is not seen within {OUTLINE_REACH_MM:g} mm of its told place"
            found.append(Finding("SHEET-EDGE-UNSEEN", text, "warning", hint="is this the sheet's size?"))
        elif offset < -MOST_OUTLINE_MM:
            text = f"the sheet's {side} edge lies {-offset:.1f} mm inside its told place"
            found.append(Finding("SHEET-SHORT", text, hint="the sheet is smaller than told"))
    return found


def registration_data(made: Registration, **more: Any) -> dict[str, Any]:
    """Return the registration as plain JSON: `sheet_to_machine` is what the cut takes."""
    return {
        "format": FORMAT,
        "sheet": made.sheet,
        "size_mm": list(made.size_mm),
        "sheet_to_machine": made.affine.tolist(),
        "marks_count": made.marks_count,
        "rms_mm": made.rms_mm,
        "worst_mm": made.worst_mm,
        "height_mm": made.height_mm,
        "turn_rad": made.turn_rad,
        "stretch_ratio": list(made.stretch_ratio),
        "shear_rad": made.shear_rad,
        "made_utc": made.made_utc,
        **more,
    }


def write_registration(made: Registration, path: Path, **more: Any) -> None:
    """Write the registration, with what else is worth keeping."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, as_json(registration_data(made, **more)))


def read_registration(path: Path) -> Registration:
    """Return the registration in the file; raise `UsageError` where it is none."""
    data = json_of(path, "a registration of `fabctl camera register`")
    try:
        if data["format"] != FORMAT:
            raise UsageError(f"{path}: registration format {data['format']}, this tool reads {FORMAT}")
        affine = np.array(data["sheet_to_machine"], dtype=np.float64)
        if affine.shape != (2, 3) or not np.isfinite(affine).all():
            raise ValueError("sheet_to_machine must be 2 x 3 finite numbers")
        w, h = data["size_mm"]
        rms, worst, height = (float(data[key]) for key in ("rms_mm", "worst_mm", "height_mm"))
        size = (float(w), float(h))
        if not np.isfinite([*size, height]).all():
            raise ValueError("size_mm and height_mm must be finite numbers")
        return Registration(data["sheet"], size, affine, int(data["marks_count"]), rms, worst, height, data["made_utc"])
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError(
            f"{path}: not a registration: {why_not(fault)}; make one with `fabctl camera register`"
        ) from fault
