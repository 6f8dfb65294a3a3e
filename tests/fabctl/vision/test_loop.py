"""The whole loop: marks engraved, the sheet turned by hand, found by camera, cut, and looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from design.pattern.paths import CutPath
from fabctl.vision import boards
from fabctl.vision.align import Alignment
from fabctl.vision.inspect import inspect
from fabctl.vision.register import apply, register
from simulators.camera.burn import to_machine
from simulators.camera.picture import Studio
from simulators.camera.scene import Pose, Sheet
from tests.fabctl.vision.conftest import WHEN, bed_scene
from tests.fabctl.vision.test_cuts import trace_of

SIZE_MM = (140.0, 90.0)
MARKS = boards.registration_marks(SIZE_MM, side_mm=10.0, margin_mm=9.0)
LAID, TURNED = Pose(0.0, 70.0, 50.0), Pose(1e4, 108.0, 38.0, 0.35)
JOB = [
    CutPath("slit", np.array([[30.0 + 9 * c, 25.0 + 12 * r], [34.0 + 9 * c, 31.0 + 12 * r]]))
    for r in range(4)
    for c in range(9)
]
NOT_CUT = 7


def test_a_sheet_engraved_turned_found_and_cut_is_cut_where_it_should_be(alignment: Alignment) -> None:
    sheet = Sheet(SIZE_MM, poses=(LAID,), thickness_mm=2.3)
    engraving = boards.hatch(boards.sheet_ink(MARKS), 0.15, 0.2)
    laid_at = np.array([LAID.x_mm, LAID.y_mm])
    first = trace_of([(replace(s, points_mm=s.points_mm + laid_at), 0.12, 60.0) for s in engraving])
    turned = replace(sheet, poses=(LAID, TURNED))

    found = register(Studio(bed_scene(turned)).frame(0, first), "bed", MARKS, alignment, 2.3, WHEN)
    corners = np.array([[0.0, 0.0], [140.0, 0.0], [140.0, 90.0], [0.0, 90.0]])
    true = to_machine(corners, TURNED, SIZE_MM)
    assert np.linalg.norm(apply(found.affine, corners) - true, axis=1).max() < 0.15

    cuts = trace_of(
        [(replace(p, points_mm=apply(found.affine, p.points_mm)), 0.6, 25.0) for k, p in enumerate(JOB) if k != NOT_CUT]
    )
    second = cuts + np.array([TURNED.from_s + 1.0, 0.0, 0.0, 0.0])
    after = Studio(bed_scene(turned)).frame(1, np.vstack([first, second]))
    again = register(after, "bed", MARKS, alignment, 2.3, WHEN)
    seen = inspect(after, JOB, lambda p: alignment.to_pixels(apply(again.affine, p), 2.3), 0.3)
    assert [path.index for path in seen.faulty()] == [NOT_CUT]
    assert np.hypot(*seen.shift_mm) < 0.1
