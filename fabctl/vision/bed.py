"""The bed camera of a bench: where its lens and alignment are kept, and the questions a job asks of it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding, errors
from design.pattern.paths import CutPath
from drivers.camera import Frame
from fabctl.errors import RefusedError
from fabctl.vision.align import Alignment, drift_findings, read_alignment
from fabctl.vision.boards import MarkSheet
from fabctl.vision.overlay import job_on_bed
from fabctl.vision.register import Registration, outline_findings, register, seen_outline, seen_outline_findings


@dataclass(frozen=True, slots=True)
class FoundSheet:
    """A sheet found on the bed, with the picture that shows it and what is doubtful about it."""

    registration: Registration
    alignment: Alignment
    picture: Frame
    overlay: NDArray[np.uint8]
    findings: tuple[Finding, ...]


def lens_path(state: Path, calibration: str | None = None) -> Path:
    """Return where the bench's lens is kept: as the bench file says, or in its state folder."""
    return Path(calibration.replace("{state}", str(state))) if calibration else state / "camera" / "lens.json"


def alignment_path(state: Path) -> Path:
    """Return where the bench's alignment is kept."""
    return state / "camera" / "alignment.json"


def checked_alignment(state: Path, picture: Frame) -> tuple[Alignment, list[Finding]]:
    """Return the bench's alignment, compared with a picture of now; raise `RefusedError` where it drifted."""
    alignment = read_alignment(alignment_path(state))
    found = drift_findings(picture.image, picture.source, alignment, datetime.now(UTC))
    if errors(found):
        raise RefusedError("the bed camera's alignment cannot be trusted now", found)
    return alignment, found


def find_sheet(
    state: Path, picture: Frame, sheet: MarkSheet, height_mm: float, job: tuple[CutPath, ...] = ()
) -> FoundSheet:
    """Return where the sheet lies, or raise `RefusedError`: drift, its own outline, the job's.

    `height_mm` is the sheet's thickness: its marks lie that far over the bed. `job` is in the sheet's frame.
    """
    alignment, found = checked_alignment(state, picture)
    made = register(picture.image, picture.source, sheet, alignment, height_mm, datetime.now(UTC).isoformat())
    found += seen_outline_findings(seen_outline(picture.image, alignment, made))
    if job:
        found += outline_findings(np.vstack([path.points_mm for path in job]), sheet.size_mm)
    if errors(found):
        raise RefusedError("the sheet on the bed does not fit the job", found)
    w, h = sheet.size_mm
    border = CutPath("outline", np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64), closed=True)
    overlay = job_on_bed(picture.image, [border, *job], made.affine, alignment, height_mm)
    return FoundSheet(made, alignment, picture, overlay, tuple(found))
