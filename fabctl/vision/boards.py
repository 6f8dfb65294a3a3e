"""What carries markers: sheets of coded marks at known places, and ChArUco boards for the lens.

Frames: millimetres, x to the right, y up, origin at the sheet's lower left corner (or the machine's own origin, for
marks on the bed). A mark that is not turned has its own x along the sheet's x. Numbers of marks are shared out so that
nothing is taken for something else: 0 to 49 bed, 50 to 79 registration, 80 to 99 kerf coupon, 100 to 149 scale,
150 and up ChArUco; engraved specimen ids are of another family.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.pattern.paths import CutPath
from fabctl.vision.markers import Family, codes
from fabctl.vision.template import CORNERS, F64

BED_IDS = range(50)
REGISTRATION_IDS = range(50, 80)
COUPON_IDS = range(80, 100)
SCALE_IDS = range(100, 150)
CHARUCO_IDS = range(150, 250)


@dataclass(frozen=True, slots=True)
class Mark:
    """One coded square of black side `side_mm`, its centre at (`x_mm`, `y_mm`)."""

    id: int
    x_mm: float
    y_mm: float
    side_mm: float
    turn_rad: float = 0.0

    @property
    def centre_mm(self) -> F64:
        """Return the centre (2,)."""
        return np.array([self.x_mm, self.y_mm])

    def place(self, points: F64) -> F64:
        """Return points (n, 2) of the mark's own frame (-1 to 1, y down) in the sheet's millimetres."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        axes = np.array([[c, s], [s, -c]])
        return np.asarray(self.centre_mm + self.side_mm / 2 * points @ axes, dtype=np.float64)

    @property
    def corners_mm(self) -> F64:
        """Return the corners (4, 2) in the order of `Marker.corners_px`."""
        return self.place(CORNERS)


@dataclass(frozen=True, slots=True)
class MarkSheet:
    """Marks at known places, on paper, on the bed or engraved; `size_mm` is the sheet's own width and height."""

    name: str
    size_mm: tuple[float, float]
    marks: tuple[Mark, ...]
    family: Family = "5x5_250"

    def mark(self, number: int) -> Mark | None:
        """Return the mark of that id."""
        return next((mark for mark in self.marks if mark.id == number), None)


@dataclass(frozen=True, slots=True)
class Charuco:
    """A chessboard with markers in its white squares; its inner corners are what the lens is measured by."""

    name: str
    columns_count: int
    rows_count: int
    square_mm: float
    marker_mm: float
    family: Family = "5x5_250"
    first_id: int = CHARUCO_IDS.start
    legacy: bool = False  # upper left square white where the rows are even, as OpenCV drew them before 4.6

    @property
    def first_is_white(self) -> bool:
        """Say whether the upper left square is white."""
        return self.legacy and self.rows_count % 2 == 0

    @property
    def size_mm(self) -> tuple[float, float]:
        """Return width and height of the chessboard."""
        return self.columns_count * self.square_mm, self.rows_count * self.square_mm

    @property
    def ids(self) -> NDArray[np.int32]:
        """Return the markers' ids, in OpenCV's order: row by row from the upper left."""
        return self.first_id + np.arange(self.columns_count * self.rows_count // 2, dtype=np.int32)

    @property
    def marks(self) -> tuple[Mark, ...]:
        """Return the markers, in the sheet's frame (y up)."""
        columns = [
            (c, r)
            for r in range(self.rows_count)
            for c in range(self.columns_count)
            if (c + r + self.first_is_white) % 2
        ]
        s, top = self.square_mm, self.size_mm[1]
        return tuple(
            Mark(int(number), (c + 0.5) * s, top - (r + 0.5) * s, self.marker_mm)
            for number, (c, r) in zip(self.ids, columns, strict=True)
        )


Rectangle = F64  # (4, 2) corners in mm


def mark_ink(mark: Mark, family: Family) -> list[Rectangle]:
    """Return the black of a mark as rectangles: in each row of modules, neighbours joined."""
    return [mark.place(corners) for corners in _runs(codes(family)[mark.id])]


def sheet_ink(sheet: MarkSheet) -> list[Rectangle]:
    """Return the black of all marks as rectangles."""
    return [rectangle for mark in sheet.marks for rectangle in mark_ink(mark, sheet.family)]


def charuco_ink(board: Charuco) -> list[Rectangle]:
    """Return the black of the board as rectangles: squares, then markers."""
    s, top = board.square_mm, board.size_mm[1]
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    squares = [
        np.array([c * s, top - (r + 1) * s]) + unit * s
        for r in range(board.rows_count)
        for c in range(board.columns_count)
        if (c + r + board.first_is_white) % 2 == 0
    ]
    return squares + [rectangle for mark in board.marks for rectangle in mark_ink(mark, board.family)]


def _runs(bits: F64) -> list[F64]:
    """Return rectangles (4, 2) in the frame -1 to 1, y down, that cover the zeros of `bits` row by row."""
    n = len(bits)
    found = []
    for row in range(n):
        edges = np.flatnonzero(np.diff(np.concatenate([[1], bits[row], [1]])))
        for left, right in edges.reshape(-1, 2):
            box = np.array([[left, row], [right, row], [right, row + 1], [left, row + 1]], dtype=np.float64)
            found.append(box / n * 2 - 1)
    return found


def hatch(rectangles: list[Rectangle], pitch_mm: float, spot_mm: float) -> list[CutPath]:
    """Return engraving strokes that fill `rectangles`, `pitch_mm` apart, drawn in by half a spot; every other one back.

    The first side of each rectangle is the direction of the strokes. Rows of a mark are filled to their common border,
    so that no light line stays between them.
    """
    strokes = []
    for a, b, _, d in rectangles:
        across, along = d - a, b - a
        height, length = float(np.linalg.norm(across)), float(np.linalg.norm(along))
        inset = min(spot_mm / 2, length / 2.5)
        count = max(1, math.ceil(height / pitch_mm - 1e-9))
        for k in range(count):
            start = a + across * (k + 0.5) / count + along / length * inset
            end = start + along / length * (length - 2 * inset)
            points = np.array([start, end] if k % 2 == 0 else [end, start])
            strokes.append(CutPath("engrave", points))
    return strokes


def bed_marks(travel_mm: tuple[float, float], side_mm: float = 12.0, columns: int = 4, rows: int = 3) -> MarkSheet:
    """Return a field of marks over the machine's travel, in machine millimetres, for the bed's alignment."""
    margin = side_mm
    xs = np.linspace(margin, travel_mm[0] - margin, columns)
    ys = np.linspace(margin, travel_mm[1] - margin, rows)
    places = [(float(x), float(y)) for y in ys for x in xs]
    return MarkSheet("bed", travel_mm, tuple(Mark(BED_IDS[k], x, y, side_mm) for k, (x, y) in enumerate(places)))


def registration_marks(size_mm: tuple[float, float], side_mm: float = 8.0, margin_mm: float = 8.0) -> MarkSheet:
    """Return marks in the corners and at the middle of the long sides of a sheet, in the sheet's millimetres."""
    w, h = size_mm
    m = margin_mm
    places = [(m, m), (w - m, m), (w - m, h - m), (m, h - m)]
    places += [(w / 2, m), (w / 2, h - m)] if w >= h else [(m, h / 2), (w - m, h / 2)]
    return MarkSheet(
        "registration", size_mm, tuple(Mark(REGISTRATION_IDS[k], *p, side_mm) for k, p in enumerate(places))
    )


def scale_marks(size_mm: tuple[float, float], side_mm: float = 15.0) -> MarkSheet:
    """Return marks around a specimen for photogrammetry: six along the border of a sheet."""
    w, h = size_mm
    m = side_mm
    places = [(m, m), (w / 2, m), (w - m, m), (w - m, h - m), (w / 2, h - m), (m, h - m)]
    return MarkSheet("scale", size_mm, tuple(Mark(SCALE_IDS[k], *p, side_mm) for k, p in enumerate(places)))
