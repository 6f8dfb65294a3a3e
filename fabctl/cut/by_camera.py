"""Where the sheet lies, as the bed camera sees it: before the question, and once more before the first motion. **W**

The picture is taken while the machine stands. What is drawn on it for the operator are the moves of the very program
that will be sent, in machine coordinates, so a fault in placing the job would be seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from design.findings import Finding
from drivers.camera import Frame
from fabctl.cut.place import Affine
from fabctl.cut.plan import CutPlan
from fabctl.errors import RefusedError
from fabctl.records.folder import RunFolder
from fabctl.vision.bed import FoundSheet, find_sheet
from fabctl.vision.boards import MarkSheet
from fabctl.vision.overlay import program_on_bed, write_picture
from fabctl.vision.register import (
    Registration,
    apply,
    moved_mm,
    outline_findings,
    registration_data,
    write_registration,
)
from fabctl.vision.template import F64

MOST_MOVED_MM = 0.15  # of the sheet, between two looks
MOST_PICTURE_AGE_S = 900.0  # a picture from before that shows another bed
CLEAR_MM = 0.5  # of marks, in which the job should not burn


@dataclass
class BedEye:
    """The bed camera of one job. `take` gives a picture of now; `again` says that a second one may be asked for.

    `at_mm` is where on the sheet the job's own corner lies; `expected`, a registration made before, must still hold.
    """

    state: Path
    board: MarkSheet
    thickness_mm: float
    take: Callable[[], Frame]
    at_mm: tuple[float, float] = (0.0, 0.0)
    expected: Registration | None = None
    again: bool = True
    _found: FoundSheet | None = field(default=None, init=False)

    @property
    def found(self) -> FoundSheet:
        """Return the sheet as first found; raise `RefusedError` where it is not."""
        if self._found is None:
            frame = _fresh(self.take())
            self._found = find_sheet(self.state, frame, self.board, self.thickness_mm)
            if self.expected is not None:
                _refuse_moved(self.expected, self._found.registration, "since it was registered")
        return self._found

    def place(self) -> Affine:
        """Return the map from the job's coordinates to the machine's."""
        A = self.found.registration.affine
        x, y = apply(A, np.array([self.at_mm]))[0]
        return Affine(A[0, 0], A[0, 1], float(x), A[1, 0], A[1, 1], float(y))

    def against(self, plan: CutPlan) -> list[Finding]:
        """Return what speaks against this program on this sheet: it leaves the sheet, or burns over its marks."""
        found = list(self.found.findings)
        burnt = self._burnt_mm(plan)
        if len(burnt):
            found += outline_findings(burnt.reshape(-1, 2), self.board.size_mm)
            found += _mark_findings(burnt, self.board)
        return found

    def show(self, plan: CutPlan) -> str:
        """Write the picture of the job on the bed; return what to tell the operator."""
        path = self.picture_path
        write_picture(str(path), self.picture(plan))
        made = self.found.registration
        turn_deg = math.degrees(made.turn_rad)
        x, y = made.stretch_ratio
        return (
            f"the sheet {made.sheet} by {made.marks_count} marks ({made.rms_mm:.3f} mm rms): turned {turn_deg:.2f}°, "
            f"{x:.4f} x {y:.4f} of its told size; look at {path}"
        )

    @property
    def picture_path(self) -> Path:
        """Return where the picture of the job on the bed is written before the question."""
        return self.state / "camera" / "job-on-bed.png"

    def picture(self, plan: CutPlan) -> Any:
        """Return the bed picture with the program's burning moves and the sheet's border."""
        found = self.found
        moves = _moves_mm(plan)
        return program_on_bed(found.picture.image, moves, found.registration, found.alignment)

    def look_again(self) -> None:
        """Raise `RefusedError` where the sheet no longer lies where the job was planned for."""
        if self.again:
            frame = _fresh(self.take())
            _refuse_same(self.found.picture, frame)
            now = find_sheet(self.state, frame, self.board, self.thickness_mm)
            _refuse_moved(self.found.registration, now.registration, "since the job was planned")

    def record(self, run: RunFolder, plan: CutPlan) -> None:
        """Keep the bed picture, the job drawn on it, and the registration with the run."""
        write_picture(str(run.artefact("bed.png")), self.found.picture.image)
        write_picture(str(run.artefact("job-on-bed.png")), self.picture(plan))
        write_registration(self.found.registration, run.artefact("registration.json"), at_mm=list(self.at_mm))

    def facts(self) -> dict[str, Any]:
        """Return the registration for the run's manifest."""
        return {**registration_data(self.found.registration), "at_mm": list(self.at_mm)}

    def _burnt_mm(self, plan: CutPlan) -> F64:
        """Return the burning moves (n, 2, 2) in the sheet's own coordinates."""
        A = self.found.registration.affine
        moves = np.array([[s, e] for s, e, _ in _moves_mm(plan)]).reshape(-1, 2, 2)
        return np.asarray((moves - A[:, 2]) @ np.linalg.inv(A[:, :2]).T)


def _moves_mm(plan: CutPlan) -> list[tuple[F64, F64, float]]:
    """Return start, end (machine coordinates) and power of every burning move."""
    offset = np.array(plan.work_offset_mm[:2])
    steps = [step for step in plan.program.steps if step.burns]
    return [(np.array(s.start_mm) + offset, np.array(s.end_mm) + offset, s.s_count) for s in steps]


def _fresh(frame: Frame) -> Frame:
    """Return the picture; raise `RefusedError` where it is too old to show what lies on the bed now."""
    age_s = (datetime.now(UTC) - datetime.fromisoformat(frame.taken_utc)).total_seconds()
    if age_s > MOST_PICTURE_AGE_S:
        text = f"the picture is {age_s / 60:.0f} minutes old, {MOST_PICTURE_AGE_S / 60:.0f} are allowed for a cut"
        finding = Finding("PICTURE-OLD", text, where=frame.source, hint="take a picture of the bed as it is now")
        raise RefusedError("the bed picture cannot be cut by", [finding])
    return frame


def _refuse_same(before: Frame, now: Frame) -> None:
    """Raise `RefusedError` where a second look gives the very same picture: no two of a living camera are equal."""
    if np.array_equal(before.image, now.image):
        text = "the second look at the bed is the very same picture as the first, so it does not show the bed of now"
        hint = "is the camera frozen? restart it; a folder must get a new picture while the question stands"
        raise RefusedError(
            "the bed picture cannot be cut by", [Finding("PICTURE-SAME", text, where=now.source, hint=hint)]
        )


def _refuse_moved(before: Registration, now: Registration, since: str) -> None:
    moved = moved_mm(before, now)
    if moved > MOST_MOVED_MM:
        text = f"the sheet has moved by {moved:.2f} mm {since}, {MOST_MOVED_MM:g} mm is the limit"
        raise RefusedError(
            "the sheet does not lie where it lay", [Finding("SHEET-MOVED", text, hint="clamp it, and start again")]
        )


def _mark_findings(burnt_mm: F64, board: MarkSheet) -> list[Finding]:
    """Return a warning where the job burns into the sheet's marks: afterwards they cannot be trusted."""
    from shapely import Polygon, STRtree, linestrings

    tree = STRtree(np.asarray(linestrings(burnt_mm)))
    hit = [
        mark.id
        for mark in board.marks
        if len(tree.query(Polygon(mark.corners_mm).buffer(CLEAR_MM), predicate="intersects"))
    ]
    if not hit:
        return []
    text = f"the job burns into mark{'s' if len(hit) > 1 else ''} {', '.join(map(str, hit))} of {board.name}"
    return [Finding("SHEET-MARK-CUT", text, "warning", hint="move the job on the sheet (--at-mm)")]
