"""Pictures for a person: the job drawn onto the bed, the error map of an alignment, what an inspection found."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.pattern.paths import CutPath
from fabctl.records.folder import write_atomically
from fabctl.vision.align import Alignment
from fabctl.vision.inspect import Inspection
from fabctl.vision.lens import COVERAGE_CELLS, BoardView, covered_cells
from fabctl.vision.profile import ToPixels
from fabctl.vision.register import Registration, apply
from fabctl.vision.template import F64

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]  # blue, green, red
COLOURS: dict[str, Colour] = {
    "engrave": (40, 160, 255),
    "mark": (200, 120, 0),
    "hole": (220, 60, 220),
    "slit": (30, 30, 230),
    "outline": (40, 180, 40),
}
PROGRAM_COLOURS = {"the sheet": "outline", "cut": "slit", "engraved": "engrave"}
GRID, ERROR = (120, 180, 60), (30, 30, 230)
SHIFT = 4  # OpenCV draws in sixteenths of a pixel
MAGNIFIED = 100  # error arrows are drawn this much longer


def polyline(picture: Picture, points_px: F64, colour: Colour, closed: bool = False, width_px: int = 1) -> None:
    """Draw a polyline (n, 2), in pixels, onto a colour picture."""
    import cv2

    points = np.rint(points_px * (1 << SHIFT)).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [points], closed, colour, width_px, cv2.LINE_AA, SHIFT)


def dense(points_mm: F64, closed: bool, step_mm: float = 2.0) -> F64:
    """Return the polyline with points at most `step_mm` apart, since a lens bends straight lines."""
    ring = np.vstack([points_mm, points_mm[:1]]) if closed else points_mm
    parts = []
    for a, b in itertools.pairwise(ring):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / step_mm)))
        parts.append(a + (b - a) * (np.arange(count) / count)[:, None])
    return np.vstack([*parts, ring[-1:]])


def job_on_bed(
    image: Picture, paths: Sequence[CutPath], affine: F64, alignment: Alignment, height_mm: float
) -> Picture:
    """Return the bed picture in colour with the job drawn where it will be cut."""
    import cv2

    picture: Picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for path in paths:
        points = apply(affine, dense(path.points_mm, path.closed))
        polyline(picture, alignment.to_pixels(points, height_mm), COLOURS[path.layer])
    return _explained(picture, [(layer, COLOURS[layer]) for layer in COLOURS if layer in {p.layer for p in paths}])


def program_on_bed(
    image: Picture, moves_mm: Sequence[tuple[F64, F64, float]], sheet: Registration, alignment: Alignment
) -> Picture:
    """Return the bed picture in colour with the sheet's border and every burning move (start, end, power) of a program.

    Moves are in machine millimetres; those at half of the strongest power or more are drawn as cuts, others as
    engraving.
    """
    import cv2

    picture: Picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    w, h = sheet.size_mm
    border = apply(sheet.affine, dense(np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64), True))
    polyline(picture, alignment.to_pixels(border, sheet.height_mm), COLOURS["outline"], width_px=2)
    strongest = max((power for _, _, power in moves_mm), default=0.0)
    ends = np.array([end for start, stop, _ in moves_mm for end in (start, stop)]).reshape(-1, 2)
    pixels = alignment.to_pixels(ends, sheet.height_mm).reshape(-1, 2, 2) if len(ends) else np.empty((0, 2, 2))
    for line, (_, _, power) in zip(pixels, moves_mm, strict=True):
        polyline(picture, line, COLOURS["slit" if power >= strongest / 2 else "engrave"])
    return _explained(picture, [(name, COLOURS[layer]) for name, layer in PROGRAM_COLOURS.items()])


STATES: dict[str, Colour] = {
    "cut": (80, 170, 60),
    "missing": (30, 30, 230),
    "not_through": (0, 140, 255),
    "displaced": (220, 60, 220),
    "unseen": (235, 190, 60),
}


def inspection_on_bed(image: Picture, paths: Sequence[CutPath], found: Inspection, to_pixels: ToPixels) -> Picture:
    """Return the bed picture in colour, each path in the colour of its state, faulty ones wide."""
    import cv2

    picture: Picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for seen in found.paths:
        path = paths[seen.index]
        points = to_pixels(dense(path.points_mm, path.closed))
        polyline(picture, points, STATES[seen.state], width_px=1 if seen.state in ("cut", "unseen") else 3)
    counts = {state: sum(seen.state == state for seen in found.paths) for state in STATES}
    rows = [(f"{state.replace('_', ' ')}: {counts[state]}", colour) for state, colour in STATES.items()]
    return np.asarray(np.vstack([_legend(picture.shape[1], rows), picture]), dtype=np.uint8)


def _explained(picture: Picture, rows: Sequence[tuple[str, Colour]]) -> Picture:
    """Return the picture with what its colours mean under it."""
    return np.asarray(np.vstack([picture, _legend(picture.shape[1], rows)]), dtype=np.uint8) if rows else picture


def _legend(width_px: int, rows: Sequence[tuple[str, Colour]]) -> Picture:
    """Return a dark band of that width with each text beside its colour; a band of its own hides no path."""
    import cv2

    scale = width_px / 1400
    line, pad = max(20, round(34 * scale)), max(6, round(12 * scale))
    band: Picture = np.full((line + 2 * pad, width_px, 3), 30, np.uint8)
    for k, (text, colour) in enumerate(rows):
        x, middle = round(width_px * k / len(rows)) + pad, line // 2 + pad
        cv2.line(band, (x, middle), (x + line, middle), colour, max(3, round(6 * scale)), cv2.LINE_AA)
        place, white = (x + line + pad, middle + round(0.27 * line)), (240, 240, 240)
        cv2.putText(band, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale, white, 1, cv2.LINE_AA)
    return band


def coverage_map(views: Sequence[BoardView], size_px: tuple[int, int]) -> Picture:
    """Return the frame with every corner that a lens is measured by; cells of it that hold none are drawn red."""
    import cv2

    w, h = size_px
    picture: Picture = np.full((h, w, 3), 245, np.uint8)
    covered = covered_cells(views, size_px)
    columns, rows = COVERAGE_CELLS
    for c in range(columns):
        for r in range(rows):
            low, high = (w * c // columns, h * r // rows), (w * (c + 1) // columns - 1, h * (r + 1) // rows - 1)
            if (c, r) not in covered:
                cv2.rectangle(picture, low, high, (170, 170, 250), -1)
            cv2.rectangle(picture, low, high, (200, 200, 200), 1)
    radius = max(2, w // 400)
    for corner in np.vstack([view.corners_px for view in views]) if views else []:
        cv2.circle(picture, _whole(corner), radius, (140, 90, 20), -1, cv2.LINE_AA)
    text = f"{len(views)} pictures, {len(covered)} of {columns * rows} cells seen"
    cv2.putText(picture, text, (20, 40), cv2.FONT_HERSHEY_SIMPLEX, max(0.5, w / 1500), (20, 20, 20), 2, cv2.LINE_AA)
    return picture


def error_map(image: Picture, alignment: Alignment) -> Picture:
    """Return the bed picture with a 20 mm grid of the machine, and each mark's error drawn MAGNIFIED times."""
    import cv2

    picture: Picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    places = np.array([(w.x_mm, w.y_mm) for w in alignment.witnesses])
    low, high = np.floor(places.min(axis=0) / 20) * 20, np.ceil(places.max(axis=0) / 20) * 20
    for k in (0, 1):
        for value in np.arange(low[k], high[k] + 1, 20):
            ends = np.array([[value, low[1]], [value, high[1]]] if k == 0 else [[low[0], value], [high[0], value]])
            polyline(picture, alignment.to_pixels(dense(ends, False)), GRID)
    told = alignment.to_pixels(places)
    for witness, at in zip(alignment.witnesses, told, strict=True):
        seen = np.array([witness.u_px, witness.v_px])
        tip = at + (seen - at) * MAGNIFIED
        cv2.arrowedLine(picture, _whole(at), _whole(tip), ERROR, 2, cv2.LINE_AA)
        _label(picture, f"{witness.id}: {witness.error_mm * 1000:.0f} um", at)
    text = f"{alignment.marks}: errors x{MAGNIFIED}, rms {alignment.rms_mm:.3f}, worst {alignment.worst_mm:.3f} mm"
    return _explained(picture, [("20 mm of the machine", GRID), (text, ERROR)])


def _label(picture: Picture, text: str, at: F64) -> None:
    """Write a mark's text beside its centre, to the left of it where the right has no room."""
    import cv2

    scale = max(0.5, picture.shape[1] / 2000)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
    aside = round(45 * scale)
    left = int(at[0]) + aside if at[0] + aside + width < picture.shape[1] else int(at[0]) - aside - width
    cv2.putText(picture, text, (left, int(at[1]) + height // 2), cv2.FONT_HERSHEY_SIMPLEX, scale, ERROR, 2, cv2.LINE_AA)


def _whole(point: F64) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def write_picture(path: str, picture: Picture) -> None:
    """Write a picture; raise `RecordError` where it cannot be written."""
    import cv2

    good, data = cv2.imencode(Path(path).suffix, picture)
    assert good, f"{path}: a picture of shape {picture.shape} does not become bytes"
    write_atomically(Path(path), data.tobytes())
