"""Bed pictures to machine millimetres: the camera's pose from marks at known places, with an error map.

The pose, rather than a bare homography, is kept, because the top of a sheet lies above the bed: with the pose known,
any height can be looked at. Marks are used by their centres, which neither ink gain nor the width of the beam moves.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding, errors
from fabctl.errors import RefusedError, UsageError
from fabctl.files import json_of, why_not
from fabctl.records.folder import as_json, write_atomically
from fabctl.vision.boards import MarkSheet
from fabctl.vision.lens import Lens, lens_from
from fabctl.vision.markers import FAMILIES, Marker, find_all, mirrored
from fabctl.vision.quality import picture_findings
from fabctl.vision.template import F64

FORMAT = 1
LEAST_MARKS_COUNT = 5
LEAST_SPAN_RATIO = 0.3  # of the area that all marks of the sheet span
MOST_SIDE_RATIO = 0.04  # by how much a mark may look larger or smaller than told
MOST_RMS_MM = 0.1
MOST_WORST_MM = 0.3
MOST_AGE_DAYS = 30.0
CLOCK_DAYS = 1.0  # by which two computers' clocks may differ
MOST_DRIFT_MM = 0.15


@dataclass(frozen=True, slots=True)
class Witness:
    """A mark as the alignment saw it: at a later job it must be seen there again."""

    id: int
    x_mm: float
    y_mm: float
    u_px: float
    v_px: float
    error_mm: float  # of this mark when the others alone decide


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the camera is over the machine: a point X is in front of the lens at R X + t."""

    lens: Lens
    R: F64  # (3, 3)
    t_mm: F64  # (3,)
    height_mm: float  # of the marks over the machine's zero plane
    rms_mm: float
    worst_mm: float
    witnesses: tuple[Witness, ...]
    made_utc: str
    marks: str

    def to_machine(self, points_px: F64, height_mm: float | None = None) -> F64:
        """Return machine points (n, 2) of pixels (n, 2), on the plane `height_mm` (that of the marks where None)."""
        z = self.height_mm if height_mm is None else height_mm
        rays = np.column_stack([self.lens.bare(points_px), np.ones(len(points_px))]) @ self.R
        eye = -self.R.T @ self.t_mm
        return np.asarray(eye[:2] + rays[:, :2] * ((z - eye[2]) / rays[:, 2:]), dtype=np.float64)

    def to_pixels(self, points_mm: F64, height_mm: float | None = None) -> F64:
        """Return the pixels (n, 2) of machine points (n, 2) on the plane `height_mm`."""
        z = self.height_mm if height_mm is None else height_mm
        seen = np.column_stack([points_mm, np.full(len(points_mm), z)]) @ self.R.T + self.t_mm
        return self.lens.seen(seen[:, :2] / seen[:, 2:])

    def mm_per_px(self, place_mm: F64) -> float:
        """Return the size of a pixel at a machine point (2,)."""
        near = self.to_pixels(place_mm + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return float(2 / (np.linalg.norm(near[1] - near[0]) + np.linalg.norm(near[2] - near[0])))


def align(
    image: NDArray[np.uint8], source: str, sheet: MarkSheet, lens: Lens, made_utc: str, height_mm: float = 0.0
) -> Alignment:
    """Return the alignment of a grey bed picture by the marks of `sheet`, whose places are machine millimetres.

    Raises `RefusedError` with every reason: picture unusable, marks missing or mirrored, of a wrong size, crowded into
    one corner, or not where the sheet says.
    """
    found = picture_findings(image, source, lens.size_px)
    if errors(found):
        raise RefusedError("the bed picture cannot be measured in", found)
    markers = known_markers(image, sheet)
    found += mark_findings(markers, image, sheet, LEAST_MARKS_COUNT)
    if errors(found):
        raise RefusedError("the marks do not suffice for an alignment", found)
    alignment = _solved(markers, sheet, lens, made_utc, height_mm)
    found += size_findings(markers, sheet, alignment) + _residual_findings(alignment)
    if errors(found):
        raise RefusedError("the marks are not where they are said to be", found)
    return alignment


def known_markers(image: NDArray[np.uint8], sheet: MarkSheet) -> list[Marker]:
    """Return the markers in the picture that belong to the sheet; one that lies there twice comes twice."""
    ids = {mark.id for mark in sheet.marks}
    return [marker for marker in find_all(image, sheet.family) if marker.id in ids]


def mark_findings(markers: list[Marker], image: NDArray[np.uint8], sheet: MarkSheet, least: int) -> list[Finding]:
    """Return what speaks against these markers: too few, mirrored, all in one corner, or of two such sheets."""
    twice = sorted({a.id for a, b in itertools.pairwise(sorted(markers, key=lambda m: m.id)) if a.id == b.id})
    if twice:
        text = f"mark{'s' if len(twice) > 1 else ''} {', '.join(map(str, twice))} of {sheet.name} seen at two places"
        return [Finding("MARKS-TWICE", text, where=sheet.name, hint="two such sheets? take one away, or cover it")]
    if len(markers) < least:
        ids = {mark.id for mark in sheet.marks}
        turned = [m for m in mirrored(image, sheet.family) if m.id in ids]
        if len(turned) > len(markers):
            text = f"{len(turned)} marks of {sheet.name} are seen mirrored: the sheet lies upside down"
            hint = "turn the sheet over; if the picture itself is mirrored (by a mirror, from below), set the camera so"
            return [Finding("MARKS-MIRRORED", text, where=sheet.name, hint=f"{hint} that it is not")]
        text = f"{len(markers)} of {len(sheet.marks)} marks of {sheet.name} found, at least {least} are needed"
        hint = f"covered, blurred, glare, or another sheet?{_strangers(image, sheet)}"
        return [Finding("MARKS-FEW", text, where=sheet.name, hint=hint)]
    places = np.array([(m.x_mm, m.y_mm) for m in (sheet.mark(k.id) for k in markers) if m is not None])
    whole = np.array([(m.x_mm, m.y_mm) for m in sheet.marks])
    share = hull_area(places) / max(hull_area(whole), 1e-9)
    if share < LEAST_SPAN_RATIO:
        text = f"the {len(markers)} marks found span {share:.0%} of the sheet, {LEAST_SPAN_RATIO:.0%} is the least"
        return [Finding("MARKS-SPAN", text, where=sheet.name, hint="uncover marks at the other side")]
    return []


def _strangers(image: NDArray[np.uint8], sheet: MarkSheet) -> str:
    """Return which markers are in the picture that are not the sheet's, of any family; nothing where there are none."""
    own = {mark.id for mark in sheet.marks}
    seen = {
        family: [m.id for m in find_all(image, family) if family != sheet.family or m.id not in own]
        for family in FAMILIES
    }
    told = [f"{', '.join(map(str, ids[:8]))}{'…' * (len(ids) > 8)} of {family}" for family, ids in seen.items() if ids]
    return f" other markers are there: {'; '.join(told)}" if told else ""


def hull_area(points: F64) -> float:
    """Return the area of the convex hull of points (n, 2)."""
    import cv2

    return float(cv2.contourArea(cv2.convexHull(points.astype(np.float32)))) if len(points) > 2 else 0.0


def size_findings(markers: list[Marker], sheet: MarkSheet, alignment: Alignment) -> list[Finding]:
    """Return an error where the marks look larger or smaller than the sheet says."""
    ratios = []
    for marker in markers:
        mark = sheet.mark(marker.id)
        if mark is not None:
            corners = alignment.to_machine(marker.corners_px)
            side = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean()
            ratios.append(float(side) / mark.side_mm)
    ratio = float(np.median(ratios))
    if abs(ratio - 1) <= MOST_SIDE_RATIO:
        return []
    text = f"the marks' sides are {ratio:.3f} times what {sheet.name} says ({sheet.marks[0].side_mm:g} mm)"
    return [Finding("MARKS-SIZE", text, where=sheet.name, hint="measure the print: `fabctl camera board measured`")]


def _solved(markers: list[Marker], sheet: MarkSheet, lens: Lens, made_utc: str, height_mm: float) -> Alignment:
    pairs = [(marker, mark) for marker in markers if (mark := sheet.mark(marker.id)) is not None]
    px = np.array([marker.centre_px for marker, _ in pairs])
    mm = np.array([mark.centre_mm for _, mark in pairs])
    R, t = pose(px, mm, lens, height_mm)
    draft = Alignment(lens, R, t, height_mm, 0.0, 0.0, (), made_utc, sheet.name)
    alone_mm = np.array([_left_out(k, px, mm, draft) for k in range(len(pairs))])
    witnesses = tuple(
        Witness(mark.id, mark.x_mm, mark.y_mm, float(p[0]), float(p[1]), float(error))
        for (_, mark), p, error in zip(pairs, px, alone_mm, strict=True)
    )
    rms, worst = math.sqrt(float(np.mean(alone_mm**2))), float(alone_mm.max())
    return Alignment(lens, R, t, height_mm, rms, worst, witnesses, made_utc, sheet.name)


def pose(points_px: F64, points_mm: F64, lens: Lens, height_mm: float) -> tuple[F64, F64]:
    """Return R (3, 3) and t (3,) of the camera that sees machine points (n, 2) at pixels (n, 2), least squares."""
    import cv2

    flat = np.column_stack([points_mm, np.zeros(len(points_mm))])
    _, turn, shift = cv2.solvePnP(flat, points_px, lens.K, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(flat, points_px, lens.K, lens.distortion, turn, shift)
    R = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    return R, np.asarray(shift, dtype=np.float64).ravel() - R[:, 2] * height_mm


def _left_out(k: int, px: F64, mm: F64, draft: Alignment) -> float:
    """Return how far mark `k` is found from its place when only the others align the camera, mm."""
    rest = np.arange(len(px)) != k
    R, t = pose(px[rest], mm[rest], draft.lens, draft.height_mm)
    other = Alignment(draft.lens, R, t, draft.height_mm, 0.0, 0.0, (), draft.made_utc, draft.marks)
    return float(np.linalg.norm(other.to_machine(px[k : k + 1])[0] - mm[k]))


def _residual_findings(alignment: Alignment) -> list[Finding]:
    found = []
    if alignment.rms_mm > MOST_RMS_MM:
        text = (
            f"marks are {alignment.rms_mm:.3f} mm (rms) from where the others put them, {MOST_RMS_MM:g} mm is the limit"
        )
        found.append(Finding("ALIGN-RMS", text, where=alignment.marks, hint=_worst_mark(alignment)))
    if alignment.worst_mm > MOST_WORST_MM:
        text = (
            f"one mark is {alignment.worst_mm:.3f} mm from where the others put it, {MOST_WORST_MM:g} mm is the limit"
        )
        found.append(Finding("ALIGN-WORST", text, where=alignment.marks, hint=_worst_mark(alignment)))
    return found


def _worst_mark(alignment: Alignment) -> str:
    worst = max(alignment.witnesses, key=lambda witness: witness.error_mm)
    return f"look at mark {worst.id}; is the lens calibration of this camera and focus?"


def drift_findings(image: NDArray[np.uint8], source: str, alignment: Alignment, now: datetime) -> list[Finding]:
    """Return what speaks against using the alignment now: its age, and witnesses that are not seen where they were.

    One witness seen in its place suffices; any seen elsewhere, or none seen at all, forbids the job.
    """
    found = picture_findings(image, source, alignment.lens.size_px)
    if errors(found):
        return found
    age_days = (now - datetime.fromisoformat(alignment.made_utc)).total_seconds() / 86400
    if age_days > MOST_AGE_DAYS:
        text = f"the alignment is {age_days:.0f} days old, {MOST_AGE_DAYS:.0f} is the limit"
        found.append(Finding("ALIGN-OLD", text, where=source, hint="`fabctl camera align` again"))
    if age_days < -CLOCK_DAYS:
        text = f"the alignment is of {alignment.made_utc[:10]}, which is yet to come, so its age is not known"
        found.append(
            Finding("ALIGN-OLD", text, where=source, hint="is the clock right? then `fabctl camera align` again")
        )
    moved = witness_drift_mm(image, alignment)
    if not moved:
        text = f"none of the {len(alignment.witnesses)} marks of the alignment is in the picture"
        return [*found, Finding("ALIGN-NO-WITNESS", text, where=source, hint="uncover one, or align again")]
    worst = max(moved, key=lambda k: moved[k])
    if moved[worst] > MOST_DRIFT_MM:
        text = f"mark {worst} is seen {moved[worst]:.2f} mm from its place, {MOST_DRIFT_MM:g} mm is the limit"
        hint = "camera or bed has moved: `fabctl camera align` again"
        found.append(Finding("ALIGN-DRIFT", text, where=source, hint=hint))
    return found


def witness_drift_mm(image: NDArray[np.uint8], alignment: Alignment) -> dict[int, float]:
    """Return, for each witness in the picture, how far from its place it is seen, mm; of two of an id the farther."""
    then = {witness.id: np.array([witness.u_px, witness.v_px]) for witness in alignment.witnesses}
    found: dict[int, float] = {}
    for marker in find_all(image):
        if marker.id in then:
            both = alignment.to_machine(np.array([marker.centre_px, then[marker.id]]))
            found[marker.id] = max(found.get(marker.id, 0.0), float(np.linalg.norm(both[0] - both[1])))
    return found


def write_alignment(alignment: Alignment, path: Path) -> None:
    """Write the alignment as JSON, its lens included."""
    lens = alignment.lens
    body = {
        "format": FORMAT,
        "R": alignment.R.tolist(),
        "t_mm": alignment.t_mm.tolist(),
        "height_mm": alignment.height_mm,
        "rms_mm": alignment.rms_mm,
        "worst_mm": alignment.worst_mm,
        "made_utc": alignment.made_utc,
        "marks": alignment.marks,
        "witnesses": [{name: getattr(w, name) for name in Witness.__slots__} for w in alignment.witnesses],
        "lens": {
            "format": FORMAT,
            "size_px": list(lens.size_px),
            "K": lens.K.tolist(),
            "distortion": lens.distortion.tolist(),
            **{
                name: getattr(lens, name)
                for name in ("rms_px", "repeat_px", "coverage_ratio", "views_count", "made_utc", "board")
            },
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, as_json(body))


def read_alignment(path: Path) -> Alignment:
    """Return the alignment in the file; raise `UsageError` where there is none."""
    if not path.exists():
        raise UsageError(f"{path}: the bed is not aligned yet; run `fabctl camera align`")
    data = json_of(path, "an alignment of `fabctl camera align`")
    try:
        if data["format"] != FORMAT:
            raise UsageError(f"{path}: alignment format {data['format']}, this tool reads {FORMAT}; align again")
        height_mm, rms_mm, worst_mm = (float(data[key]) for key in ("height_mm", "rms_mm", "worst_mm"))
        witnesses = tuple(Witness(**row) for row in data["witnesses"])
        R, t_mm = np.array(data["R"], dtype=np.float64), np.array(data["t_mm"], dtype=np.float64)
        places = [value for w in witnesses for value in (w.x_mm, w.y_mm, w.u_px, w.v_px)]
        if R.shape != (3, 3) or t_mm.shape != (3,) or not np.isfinite([*R.flat, *t_mm, height_mm, *places]).all():
            raise ValueError("R must be 3 x 3, t_mm 3, and all of them and the witnesses finite numbers")
        made_utc = str(data["made_utc"])
        if datetime.fromisoformat(made_utc).tzinfo is None:
            raise ValueError("made_utc says no time zone")
        lens = lens_from(data["lens"], str(path))
        return Alignment(lens, R, t_mm, height_mm, rms_mm, worst_mm, witnesses, made_utc, str(data["marks"]))
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError(f"{path}: not an alignment: {why_not(fault)}; run `fabctl camera align`") from fault
