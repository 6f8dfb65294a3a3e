"""An engraved id is read back, and half an id is not taken for a whole one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from design.pattern.paths import CutPath
from fabctl.vision.ids import LARGEST, id_paths, id_sheet, number_of, read_ids, specimen_of
from simulators.camera.picture import Studio
from simulators.camera.scene import Bed, Camera, Pose, Scene, Sheet

CAMERA = Camera(
    size_px=(700, 500),
    mm_per_px=0.12,
    focal_px=1500.0,
    looks_at_mm=(40.0, 30.0),
    tilt_rad=0.3,
    turn_rad=0.5,
    blur_px=1.0,
)
SHEET = Sheet((80.0, 60.0), poses=(Pose(),), thickness_mm=2.0)


def trace_of(strokes: list[CutPath], power_frac: float, speed_mm_s: float) -> NDArray[np.float64]:
    """Return the burn trace of strokes cut one after the other."""
    rows, now_s = [], 0.0
    for stroke in strokes:
        for k, point in enumerate(stroke.points_mm):
            step_mm = np.linalg.norm(point - stroke.points_mm[k - 1]) if k else 0.0
            now_s += float(step_mm) / speed_mm_s if k else 0.01
            rows.append([now_s, *point, power_frac if k < len(stroke.points_mm) - 1 else 0.0])
    return np.array(rows)


@given(number=st.integers(0, LARGEST))
def test_every_number_has_a_pair_of_its_own(number: int) -> None:
    name = f"S-{number:04d}"
    left, right = (mark.id for mark in id_sheet(name, 0.5).marks)
    assert specimen_of(left, right) == name
    assert specimen_of(right, left) is None
    assert number_of(name) == number


@pytest.mark.parametrize("name", ["S-12", "T-0001", "S-99999", ""])
def test_what_is_no_id_cannot_be_engraved(name: str) -> None:
    with pytest.raises(ValueError, match=r"not a specimen id|QR"):
        id_sheet(name, 0.5)


@pytest.mark.parametrize("kind", ["marker", "qr"])
def test_an_id_engraved_by_the_laser_is_read_from_the_bed_picture(kind: str) -> None:
    module_mm = 0.6 if kind == "marker" else 0.9
    strokes = id_paths("S-0142", module_mm, 30.0, 20.0, kind=kind, spot_mm=0.2)  # type: ignore[arg-type]
    picture = Studio(Scene(camera=CAMERA, bed=Bed((80.0, 60.0)), sheet=SHEET)).frame(0, trace_of(strokes, 0.12, 60.0))
    (found,) = read_ids(picture)
    assert (found.specimen, found.kind) == ("S-0142", kind)


def test_an_id_on_black_rubber_is_read_too() -> None:
    strokes = id_paths("S-0007", 0.6, 30.0, 20.0, spot_mm=0.2)
    pale = replace(SHEET, grey_frac=0.05, beam=replace(SHEET.beam, char_frac=-4.0))
    picture = Studio(Scene(camera=CAMERA, bed=Bed((80.0, 60.0)), sheet=pale)).frame(0, trace_of(strokes, 0.12, 60.0))
    assert [found.specimen for found in read_ids(picture)] == ["S-0007"]


def test_half_an_id_is_no_id() -> None:
    strokes = [s for s in id_paths("S-0142", 0.6, 30.0, 20.0, spot_mm=0.2) if s.points_mm[:, 0].max() < 35.0]
    picture = Studio(Scene(camera=CAMERA, bed=Bed((80.0, 60.0)), sheet=SHEET)).frame(0, trace_of(strokes, 0.12, 60.0))
    assert read_ids(picture) == []
