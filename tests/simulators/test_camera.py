"""The simulated camera burns what physics says, and keeps its own truth."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.camera.burn import fluence, kerf_mm, on_sheet, read_trace, strokes, to_machine, to_sheet
from simulators.camera.main import main
from simulators.camera.scene import Beam, Pose, Scene, Sheet, build, read_scene

BEAM = Beam(radius_x_mm=0.1, radius_y_mm=0.1, through_s_mm=0.01)


def test_a_line_is_open_as_wide_as_the_formula_says() -> None:
    found = strokes(np.array([[0.0, 1.0, 2.0, 0.5], [0.2, 9.0, 2.0, 0.0]]))
    share = fluence(found, (10.0, 4.0), 0.005, BEAM)
    open_mm = 0.005 * np.count_nonzero(share[:, 1000] > 1)
    assert open_mm == pytest.approx(kerf_mm(0.5 * 0.2 / 8.0, 0.0, BEAM), abs=0.011)


def test_two_passes_add_up() -> None:
    once = np.array([[0.0, 1.0, 2.0, 0.5], [0.2, 9.0, 2.0, 0.0]])
    twice = np.vstack([once, once + np.array([1.0, 0.0, 0.0, 0.0])])
    shares = [fluence(strokes(trace), (10.0, 4.0), 0.02, BEAM).max() for trace in (once, twice)]
    assert shares[1] == pytest.approx(2 * shares[0], rel=1e-5)


def test_power_counts_from_its_row_on_and_steps_in_line_are_joined() -> None:
    trace = np.array([[0, 0, 0, 0.0], [1, 0, 0, 0.6], [2, 5, 0, 0.6], [3, 10, 0, 0.0], [4, 20, 0, 0.0]], dtype=float)
    (stroke,) = strokes(trace)
    assert stroke[:5] == pytest.approx([0, 0, 10, 0, 0.12])


@given(
    x=st.floats(-50, 50), turn=st.floats(-3, 3), stretch=st.floats(0.9, 1.1), down=st.booleans(), at=st.floats(0, 90)
)
def test_sheet_and_machine_are_each_others_inverse(
    x: float, turn: float, stretch: float, down: bool, at: float
) -> None:
    pose = Pose(0.0, x, 7.0, turn, stretch, 1.0, down)
    points = np.array([[at, 3.0], [1.0, at]])
    assert to_sheet(to_machine(points, pose, (90.0, 60.0)), pose, (90.0, 60.0)) == pytest.approx(points, abs=1e-9)


def test_what_was_burned_moves_with_the_sheet() -> None:
    sheet = Sheet((100.0, 60.0), poses=(Pose(0.0, 10.0, 10.0), Pose(5.0, 30.0, 10.0, math.pi / 2)))
    found = np.array([[20.0, 10, 30, 10, 0.1, 1.0], [20.0, 10, 30, 10, 0.1, 6.0]])
    moved = on_sheet(found, sheet)
    assert moved[0, :4] == pytest.approx([10, 0, 20, 0])
    assert moved[1, :4] == pytest.approx([0, 10, 0, 0], abs=1e-9)


def test_a_scene_file_is_read_and_a_typo_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text('{"camera": {"tilt_rad": 0, "size_px": [320, 240]}, "sheet": {"size_mm": [50, 40]}}')
    scene = read_scene(path)
    assert (scene.camera.tilt_rad, scene.camera.size_px) == (0.0, (320, 240))
    assert scene.sheet is not None and scene.sheet.size_mm == (50.0, 40.0)
    with pytest.raises(ValueError, match="tilt_deg"):
        build(Scene, {"camera": {"tilt_deg": 3}}, "scene")
    path.write_text("{")
    with pytest.raises(ValueError, match="not JSON"):
        read_scene(path)


def test_a_trace_still_being_written_is_read_up_to_its_last_whole_row(tmp_path: Path) -> None:
    (tmp_path / "trace.csv").write_text("t_s,x_mm,y_mm,power_frac\n0,1,2,0.5\n1,2,2,0.5\n2,3,")
    assert read_trace(tmp_path / "trace.csv").tolist() == [[0, 1, 2, 0.5], [1, 2, 2, 0.5]]


def test_pictures_and_their_truth_are_written_apart(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(
        '{"camera": {"size_px": [160, 120], "mm_per_px": 2.0, "focal_px": 200}, "bed": {"marks": []}}'
    )
    words = ["--scene", str(tmp_path / "scene.json"), "--folder", str(tmp_path / "out"), "--count", "2"]
    assert main([*words, "--truth", str(tmp_path / "truth")]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["frame-0000.png", "frame-0001.png"]
    assert np.array(json.loads((tmp_path / "truth" / "camera.json").read_text())["K"]).shape == (3, 3)
