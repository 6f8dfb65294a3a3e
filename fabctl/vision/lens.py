"""The lens: pixels to directions by OpenCV's model (Brown), and how it is measured from pictures of a ChArUco board."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding, errors
from fabctl.errors import RefusedError, UsageError
from fabctl.files import json_of, why_not
from fabctl.records.folder import as_json, write_atomically
from fabctl.vision.boards import Charuco
from fabctl.vision.markers import FAMILIES
from fabctl.vision.quality import picture_findings
from fabctl.vision.template import F64

FORMAT = 1
LEAST_CORNERS_COUNT = 12
LEAST_VIEWS_COUNT = 8
LEAST_COVERAGE_RATIO = 0.70
LEAST_TILT_RAD = math.radians(12)  # seen straight on, distance and focal length cannot be told apart
MOST_RMS_PX = 0.5
MOST_REPEAT_PX = 1.0
COVERAGE_CELLS = (8, 6)
# Corners this far from where the whole board says they are speak of another board, not of a lens.
MOST_LAYOUT_RATIO = 0.25


@dataclass(frozen=True, slots=True)
class Lens:
    """One camera with its lens at one focus; valid for pictures of `size_px` only."""

    size_px: tuple[int, int]
    K: F64  # (3, 3)
    distortion: F64  # (5,) k1, k2, p1, p2, k3
    rms_px: float
    repeat_px: float  # how far two halves of the pictures disagree over the whole frame, worst
    coverage_ratio: float
    views_count: int
    made_utc: str
    board: str

    def bare(self, points_px: F64) -> F64:
        """Return directions (n, 2), x/z and y/z, of pixels (n, 2)."""
        import cv2

        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
        bare = cv2.undistortPoints(points, self.K, self.distortion, criteria=criteria)
        return np.asarray(bare.reshape(-1, 2), dtype=np.float64)

    def seen(self, directions: F64) -> F64:
        """Return the pixels (n, 2) at which directions (n, 2) are seen."""
        import cv2

        points = np.column_stack([directions, np.ones(len(directions))])
        seen, _ = cv2.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.K, self.distortion)
        return np.asarray(seen.reshape(-1, 2), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class BoardView:
    """The corners of a ChArUco board in one picture."""

    source: str
    board_mm: F64  # (n, 3)
    corners_px: F64  # (n, 2)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A lens with what speaks for and against it, picture by picture."""

    lens: Lens
    view_rms_px: tuple[float, ...]
    view_tilt_rad: tuple[float, ...]
    sources: tuple[str, ...]
    findings: tuple[Finding, ...]


def find_board(image: NDArray[np.uint8], board: Charuco, source: str) -> tuple[BoardView | None, list[Finding]]:
    """Return the board's corners in a grey picture, or None with the reasons."""
    import cv2

    found = picture_findings(image, source)
    if errors(found):
        return None, found
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[board.family]))
    size = (board.columns_count, board.rows_count)
    print_ = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary, board.ids)
    print_.setLegacyPattern(board.legacy)
    detector = cv2.aruco.CharucoDetector(print_)
    corners, ids, _, marker_ids = detector.detectBoard(image)
    seen = set() if marker_ids is None else {int(k) for k in np.ravel(marker_ids)}
    count = 0 if ids is None else len(ids)
    strange = seen - {int(k) for k in board.ids}
    # Marks of the bed around the board are strange too, and do no harm.
    if len(strange) > len(seen) - len(strange) and len(strange) >= 3:
        hint = "give the board file of the board in the picture"
        return None, [
            Finding(
                "LENS-BOARD", f"{len(strange)} of {len(seen)} markers are not of {board.name}", where=source, hint=hint
            )
        ]
    if count < LEAST_CORNERS_COUNT <= len(seen):
        return None, [_misfit(source, board)]  # many markers, yet their neighbours are not where the board has them
    if count < LEAST_CORNERS_COUNT:
        text = f"{count} corners of the board found ({len(seen)} markers), {LEAST_CORNERS_COUNT} are needed"
        return None, [Finding("LENS-CORNERS", text, "warning", source, "nearer, sharper, evenly lit, the right board?")]
    view = BoardView(
        source,
        np.asarray(print_.getChessboardCorners())[np.ravel(ids)].astype(float),
        corners.reshape(-1, 2).astype(float),
    )
    return (None, [_misfit(source, board)]) if _layout_error(view, board) > MOST_LAYOUT_RATIO else (view, found)


def _layout_error(view: BoardView, board: Charuco) -> float:
    """Return how far the worst tenth of corners is from a flat board's, in squares."""
    import cv2

    H, _ = cv2.findHomography(view.corners_px, view.board_mm[:, :2].copy(), cv2.LMEDS)
    if H is None:
        return math.inf
    moved = cv2.perspectiveTransform(view.corners_px.reshape(-1, 1, 2), H).reshape(-1, 2)
    return float(np.quantile(np.linalg.norm(moved - view.board_mm[:, :2], axis=1), 0.9) / board.square_mm)


def _misfit(source: str, board: Charuco) -> Finding:
    text = f"the corners do not lie as {board.name} ({board.columns_count} x {board.rows_count}) says"
    return Finding(
        "LENS-BOARD", text, where=source, hint="another board, a bent one, or of an old program (legacy: true)?"
    )


def calibrate(views: Sequence[BoardView], size_px: tuple[int, int], board: Charuco, made_utc: str) -> Calibration:
    """Return the lens that explains the views best; raise `RefusedError` where they do not suffice.

    Refused are: too few views, pictures that leave parts of the frame unseen, a board always held flat, residuals too
    large, and two halves of the views that give two lenses.
    """
    before = _enough(views, size_px)
    if errors(before):
        raise RefusedError("these pictures do not suffice for a calibration", before)
    rms, K, distortion, turns, view_rms = _solve(views, size_px)
    halves = [_solve(list(views)[k::2], size_px) for k in (0, 1)]
    repeat_px = _disagreement((halves[0][1], halves[0][2]), (halves[1][1], halves[1][2]), size_px)
    tilts = tuple(float(np.arccos(np.clip(abs(_rotation(turn)[2, 2]), 0, 1))) for turn in turns)
    lens = Lens(size_px, K, distortion, rms, repeat_px, _coverage(views, size_px), len(views), made_utc, board.name)
    found = [*before, *_judge(lens, tilts)]
    if errors(found):
        raise RefusedError("the calibration is not good enough to be used", found)
    return Calibration(lens, tuple(view_rms), tilts, tuple(view.source for view in views), tuple(found))


def _enough(views: Sequence[BoardView], size_px: tuple[int, int]) -> list[Finding]:
    found = []
    if len(views) < LEAST_VIEWS_COUNT:
        text = f"{len(views)} pictures show the board, at least {LEAST_VIEWS_COUNT} are needed"
        found.append(Finding("LENS-FEW", text, hint="hold the board another way in each"))
    coverage = _coverage(views, size_px)
    if coverage < LEAST_COVERAGE_RATIO:
        text = f"the corners reach {coverage:.0%} of the frame, at least {LEAST_COVERAGE_RATIO:.0%} are needed"
        found.append(Finding("LENS-COVERAGE", text, hint="bring the board to the frame's borders and corners too"))
    return found


def _judge(lens: Lens, tilts: Sequence[float]) -> list[Finding]:
    found = []
    steep = sorted(tilts)[-3] if len(tilts) >= 3 else 0.0
    if steep < LEAST_TILT_RAD:
        asked_deg = math.degrees(LEAST_TILT_RAD)
        text = (
            f"the board is tilted {math.degrees(steep):.0f}° at most; three pictures with {asked_deg:.0f}° are needed"
        )
        found.append(Finding("LENS-TILT", text, hint="a board held flat does not show the focal length"))
    if lens.rms_px > MOST_RMS_PX:
        text = f"corners are {lens.rms_px:.2f} px (rms) from where the lens says, {MOST_RMS_PX:g} px is the limit"
        found.append(Finding("LENS-RMS", text, hint="a flat board? sharp pictures? the focus unchanged?"))
    if lens.repeat_px > MOST_REPEAT_PX:
        text = (
            f"two halves of the pictures disagree by up to {lens.repeat_px:.2f} px, {MOST_REPEAT_PX:g} px is the limit"
        )
        found.append(Finding("LENS-REPEAT", text, hint="take more pictures, and more different ones"))
    return found


def _solve(views: Sequence[BoardView], size_px: tuple[int, int]) -> tuple[float, F64, F64, Sequence[F64], list[float]]:
    import cv2

    boards = [view.board_mm.astype(np.float32) for view in views]
    corners = [view.corners_px.astype(np.float32).reshape(-1, 1, 2) for view in views]
    # The third radial term follows noise at the border more than it follows glass.
    found = cv2.calibrateCameraExtended(boards, corners, size_px, None, None, flags=cv2.CALIB_FIX_K3)
    rms, K, distortion, turns, per_view = found[0], found[1], found[2], found[3], found[-1]
    return float(rms), np.asarray(K), np.ravel(distortion)[:5], turns, [float(v) for v in np.ravel(per_view)]


def _rotation(turn: F64) -> F64:
    import cv2

    return np.asarray(cv2.Rodrigues(turn)[0])


def _coverage(views: Sequence[BoardView], size_px: tuple[int, int]) -> float:
    """Return which part of the frame's cells holds at least one corner."""
    return len(covered_cells(views, size_px)) / math.prod(COVERAGE_CELLS)


def covered_cells(views: Sequence[BoardView], size_px: tuple[int, int]) -> set[tuple[int, int]]:
    """Return column and row of every cell of the frame that holds at least one corner."""
    if not views:
        return set()
    points = np.vstack([view.corners_px for view in views]) / np.array(size_px)
    cells = np.clip((points * np.array(COVERAGE_CELLS)).astype(int), 0, np.array(COVERAGE_CELLS) - 1)
    return {(int(column), int(row)) for column, row in cells}


def _disagreement(first: tuple[F64, F64], second: tuple[F64, F64], size_px: tuple[int, int]) -> float:
    """Return how far apart two lenses see the same directions at worst, after the best common turn of the camera."""
    import cv2

    w, h = size_px
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 7)), axis=-1).reshape(-1, 1, 2)
    rays = [cv2.undistortPoints(grid, K, d).reshape(-1, 2) for K, d in (first, second)]
    H, _ = cv2.findHomography(rays[1], rays[0])
    moved = cv2.perspectiveTransform(rays[1].reshape(-1, 1, 2), H).reshape(-1, 2)
    return float(np.abs(moved - rays[0]).max() * first[0][0, 0])


def write_lens(lens: Lens, path: Path, extra: dict[str, Any] | None = None) -> None:
    """Write the lens as JSON."""
    body = {
        "format": FORMAT,
        "size_px": list(lens.size_px),
        "K": lens.K.tolist(),
        "distortion": lens.distortion.tolist(),
        "rms_px": lens.rms_px,
        "repeat_px": lens.repeat_px,
        "coverage_ratio": lens.coverage_ratio,
        "views_count": lens.views_count,
        "made_utc": lens.made_utc,
        "board": lens.board,
        **(extra or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, as_json(body))


def lens_from(data: dict[str, Any], where: str) -> Lens:
    """Return the lens in plain JSON; raise `UsageError` where it is not one."""
    try:
        if data["format"] != FORMAT:
            raise UsageError(f"{where}: lens format {data['format']}, this tool reads {FORMAT}; calibrate again")
        K, distortion = np.array(data["K"], dtype=np.float64), np.array(data["distortion"], dtype=np.float64)
        if K.shape != (3, 3) or distortion.shape != (5,) or not np.isfinite([*K.flat, *distortion]).all():
            raise ValueError("K must be 3 x 3, distortion 5 finite numbers")
        w, h = data["size_px"]
        rms_px, repeat_px, coverage = (float(data[key]) for key in ("rms_px", "repeat_px", "coverage_ratio"))
        made, board = str(data["made_utc"]), str(data["board"])
        return Lens((int(w), int(h)), K, distortion, rms_px, repeat_px, coverage, int(data["views_count"]), made, board)
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError(f"{where}: not a lens file: {why_not(fault)}") from fault


def read_lens(path: Path) -> Lens:
    """Return the lens in the file."""
    return lens_from(json_of(path, "a lens of `fabctl camera calibrate`"), str(path))
