"""Boards are drawn as OpenCV knows them, true to size, and their files say what the print measures."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import ezdxf
import numpy as np
import pytest
from shapely import LineString, Point, Polygon, unary_union

from design.pattern.paths import CutPath
from fabctl.config.boards import config_of, load_board, write_board
from fabctl.errors import ConfigError
from fabctl.vision import boards
from fabctl.vision.drawing import POINTS_PER_MM, drawing_of, dxf, pdf
from fabctl.vision.inspect import Inspection, SeenPath
from fabctl.vision.lens import find_board
from fabctl.vision.overlay import STATES, inspection_on_bed

BOARD = boards.Charuco("lens", 10, 7, 20.0, 15.0)


def test_our_board_is_the_one_opencv_looks_for() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    told = cv2.aruco.CharucoBoard((10, 7), 20.0, 15.0, dictionary, BOARD.ids).generateImage((1400, 980), marginSize=0)
    black = unary_union([Polygon(r) for r in boards.charuco_ink(BOARD)])
    assert black.area / (200 * 140) == pytest.approx(float(np.mean(told == 0)), abs=5e-3)
    rng = np.random.default_rng(1)
    places = rng.uniform([0, 0], [200, 140], (400, 2))
    drawn = np.array([black.contains(LineString([p, p + 1e-9]).centroid) for p in places])
    seen = told[(980 - places[:, 1] * 7).astype(int), (places[:, 0] * 7).astype(int)] == 0
    assert np.mean(drawn != seen) < 0.02


@pytest.mark.parametrize(
    ("columns", "rows", "legacy"), [(8, 6, True), (9, 6, True), (7, 5, True), (8, 6, False), (5, 7, False)]
)
def test_boards_of_other_sizes_and_old_programs_are_found_corner_by_corner(
    columns: int, rows: int, legacy: bool
) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    drawn = cv2.aruco.CharucoBoard((columns, rows), 30.0, 22.0, dictionary)
    drawn.setLegacyPattern(legacy)
    picture = np.asarray(drawn.generateImage((60 * columns + 80, 60 * rows + 80), marginSize=40) // 2 + 60, np.uint8)
    board = boards.Charuco("other", columns, rows, 30.0, 22.0, first_id=0, legacy=legacy)
    view, found = find_board(picture, board, "picture")
    assert not found
    assert view is not None
    assert len(view.corners_px) == (columns - 1) * (rows - 1)
    black = unary_union([Polygon(r) for r in boards.charuco_ink(board)])
    assert bool(drawn.generateImage((60 * columns, 60 * rows))[5, 5] == 0) == black.contains(Point(1, 30 * rows - 1))
    if legacy and rows % 2 == 0:
        assert find_board(picture, replace(board, legacy=False), "picture")[0] is None


def test_a_board_held_over_the_marks_of_the_bed_is_found_among_them() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    board = boards.Charuco("lens", 7, 5, 20.0, 15.0)
    drawn = cv2.aruco.CharucoBoard((7, 5), 20.0, 15.0, dictionary, board.ids)
    picture = np.full((700, 1000), 180, np.uint8)
    picture[150:550, 200:760] = drawn.generateImage((560, 400)) // 2 + 60
    for k in range(12):
        row, column = (20, 80 * k + 20) if k < 6 else (620, 80 * k - 440)
        picture[row : row + 56, column : column + 56] = cv2.aruco.generateImageMarker(dictionary, k, 56) // 2 + 50
    view, found = find_board(picture, board, "picture")
    assert not found
    assert view is not None
    assert len(view.corners_px) == 24


def test_a_mark_that_is_turned_keeps_its_centre_and_its_first_corner() -> None:
    mark = boards.Mark(1, 10.0, 20.0, 8.0, math.pi / 2)
    assert mark.corners_mm.mean(axis=0) == pytest.approx([10, 20])
    assert mark.corners_mm[0] == pytest.approx([6, 16])  # upper left of the mark, turned a quarter to the left


def test_hatching_burns_the_black_and_nothing_else() -> None:
    ink = boards.mark_ink(boards.Mark(3, 5.0, 5.0, 7.0), "5x5_250")
    strokes = boards.hatch(ink, 0.1, 0.1)
    burned = unary_union([LineString(s.points_mm).buffer(0.05) for s in strokes])
    black = unary_union([Polygon(r) for r in ink])
    assert burned.difference(black.buffer(0.03)).area < 1e-6
    assert black.difference(burned).area / black.area < 0.02


def test_the_pdf_is_true_to_size() -> None:
    text = pdf(drawing_of(BOARD)).decode("latin-1")
    (scale,) = re.findall(r"([\d.]+) 0 0 [\d.]+ [\d.]+ [\d.]+ cm", text)
    assert float(scale) == pytest.approx(72 / 25.4)
    numbers = np.array([[float(a), float(b)] for a, b in re.findall(r"(-?[\d.]+) (-?[\d.]+) [ml]\b", text)])
    assert numbers.max(axis=0) == pytest.approx([200, 140])
    (box,) = re.findall(r"MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", text)
    assert float(box[0]) == pytest.approx(224 * POINTS_PER_MM, abs=1e-3)
    table = int(re.findall(r"startxref\n(\d+)", text)[0])
    assert text[table : table + 4] == "xref"


def test_the_dxf_holds_outlines_and_strokes_in_millimetres() -> None:
    sheet = boards.registration_marks((150.0, 100.0))
    strokes = boards.hatch(boards.sheet_ink(sheet), 0.2, 0.1)
    document = ezdxf.read(io.StringIO(dxf(drawing_of(sheet), strokes)))
    layers = [entity.dxf.layer for entity in document.modelspace()]
    assert layers.count("engrave") == len(strokes)
    assert layers.count("engrave-fill") >= 6
    assert document.units == 4


def test_a_board_file_is_read_as_written_and_the_measured_size_counts(tmp_path: Path) -> None:
    for board in (BOARD, boards.bed_marks((300.0, 200.0))):
        write_board(config_of(board), tmp_path / "b.yaml")
        config = load_board(str(tmp_path / "b.yaml"), tmp_path)
        assert (config.charuco() if config.kind == "charuco" else config.mark_sheet()) == board
    (tmp_path / "b.yaml").write_text((tmp_path / "b.yaml").read_text() + "measured_mm: [297.0, 199.0]\n")
    sheet = load_board(str(tmp_path / "b.yaml"), tmp_path).mark_sheet()
    assert sheet.marks[3].x_mm == pytest.approx(288 * 0.99)
    assert sheet.marks[11].y_mm == pytest.approx(188 * 0.995)


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ("measured_mm: [200.0, 200.0]\nmarks: [{id: 1, x_mm: 0, y_mm: 0, side_mm: 1}]", "10 %"),
        ("kind: charuco", "given twice"),
        ("first_id: -1", "first_id"),
        ("marks: [{id: 1, x_mm: 0, y_mm: 0, side_mm: 1}, {id: 1, x_mm: 9, y_mm: 0, side_mm: 1}]", "same id"),
        ("mesured_mm: [1.0, 1.0]", "mesured_mm"),
    ],
)
def test_a_wrong_board_file_is_refused(tmp_path: Path, more: str, complaint: str) -> None:
    (tmp_path / "b.yaml").write_text(f"name: b\nkind: marks\nsize_mm: [300.0, 200.0]\n{more}\n")
    with pytest.raises(ConfigError, match=complaint):
        load_board(str(tmp_path / "b.yaml"), tmp_path)


@pytest.mark.parametrize("width_px", [320, 1050, 4000])
def test_the_legend_of_an_inspection_stands_beside_the_picture_and_hides_nothing(width_px: int) -> None:
    bed = np.full((240, width_px), 150, np.uint8)
    path = CutPath("slit", np.array([[2.0, 2.0], [30.0, 2.0]]))
    seen = SeenPath(0, "slit", None, "unseen", None, None, (16.0, 2.0))
    drawn = inspection_on_bed(bed, [path], Inspection((seen,), 0.1, (0.0, 0.0)), lambda points: points)
    band, picture = drawn[:-240], drawn[-240:]
    assert picture.shape == (240, width_px, 3)
    assert (picture[2, 10:28] != 150).any()
    assert (picture[10:] == 150).all()
    for colour in STATES.values():
        assert (band == np.array(colour)).all(axis=2).any()
