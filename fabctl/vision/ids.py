"""The specimen's id as an engraved code, and back.

Two small square markers side by side carry the number: the left one its hundred-and-twenty-fives, the right one the
rest. Each marker differs from every other of its family in at least 12 of 36 modules, and which half it is follows from
its own id, so half a code is never taken for a whole one. A QR code carries the text itself, for telephones; it needs
larger modules and a flatter look.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.pattern.paths import CutPath
from fabctl.vision.boards import Mark, MarkSheet, Rectangle, hatch, sheet_ink
from fabctl.vision.markers import Family, Marker, find_markers, read_quadrilateral
from fabctl.vision.template import CORNERS, F64, warp

FAMILY: Family = "mip_36h12"
BASE = 125
MODULES = 8  # of one marker, frame included
GAP_MODULES = 2
PITCH = 2 * (MODULES + GAP_MODULES) / MODULES  # from centre to centre, in the marker's own frame (-1 to 1)
MOST_MISPLACED = 0.25  # of the partner's centre, in the same frame
ENOUGH_PX = 2e6  # pictures of more are first looked at smaller
LARGEST = BASE * BASE - 1
NAME = re.compile(r"S-(\d{4,})")

Kind = Literal["marker", "qr"]


@dataclass(frozen=True, slots=True)
class EngravedId:
    """A specimen's id read from a picture; `score_ratio` is the worse of its markers' correlations, None for QR."""

    specimen: str
    corners_px: F64  # (4, 2)
    score_ratio: float | None
    kind: Kind


def number_of(specimen: str) -> int:
    """Return the number in `S-0042`; raise `ValueError` where it is no id."""
    found = NAME.fullmatch(specimen)
    if found is None:
        raise ValueError(f"{specimen!r} is not a specimen id such as S-0042")
    return int(found[1])


def id_size_modules() -> tuple[int, int]:
    """Return width and height of a pair's black, in modules."""
    return 2 * MODULES + GAP_MODULES, MODULES


def specimen_of(left: int, right: int) -> str | None:
    """Return the id that a pair of markers spells, None where the halves are exchanged."""
    if not (left < BASE <= right < 2 * BASE):
        return None
    return f"S-{left * BASE + right - BASE:04d}"


def id_sheet(specimen: str, module_mm: float, x_mm: float = 0.0, y_mm: float = 0.0) -> MarkSheet:
    """Return the two markers of an id; (`x_mm`, `y_mm`) is the lower left corner of the black."""
    number = number_of(specimen)
    if number > LARGEST:
        raise ValueError(f"{specimen} is beyond S-{LARGEST}, the last id that two markers can carry; engrave a QR code")
    side = MODULES * module_mm
    left, right = number // BASE, BASE + number % BASE
    step = (MODULES + GAP_MODULES) * module_mm
    marks = tuple(Mark(k, x_mm + side / 2 + i * step, y_mm + side / 2, side) for i, k in enumerate((left, right)))
    return MarkSheet(specimen, (side + step, side), marks, FAMILY)


def qr_ink(specimen: str, module_mm: float, x_mm: float = 0.0, y_mm: float = 0.0) -> list[Rectangle]:
    """Return the black of a QR code (error correction M) as rectangles; its lower left corner at (`x_mm`, `y_mm`)."""
    import segno

    rows = [list(row) for row in segno.make_qr(specimen, error="m").matrix]
    found = []
    for r, row in enumerate(reversed(rows)):
        dark = np.concatenate([[0], np.array(row, dtype=int), [0]])
        for left, right in np.flatnonzero(np.diff(dark)).reshape(-1, 2):
            box = np.array([[left, r], [right, r], [right, r + 1], [left, r + 1]], dtype=np.float64)
            found.append(box * module_mm + np.array([x_mm, y_mm]))
    return found


def id_paths(
    specimen: str,
    module_mm: float,
    x_mm: float = 0.0,
    y_mm: float = 0.0,
    *,
    kind: Kind = "marker",
    pitch_mm: float = 0.1,
    spot_mm: float = 0.1,
) -> list[CutPath]:
    """Return the strokes that engrave the id with its lower left corner at (`x_mm`, `y_mm`).

    A margin of one module (marker) or four (QR) around it must stay free.
    """
    ink = (
        sheet_ink(id_sheet(specimen, module_mm, x_mm, y_mm))
        if kind == "marker"
        else qr_ink(specimen, module_mm, x_mm, y_mm)
    )
    return hatch(ink, pitch_mm, spot_mm)


def read_ids(image: NDArray[np.uint8], *, upscale: int = 2, smallest_px: float = 14.0) -> list[EngravedId]:
    """Return every id in a grey picture (h, w), by name: marker pairs first, then QR codes.

    A large picture is searched from coarse to fine, and no finer than where it shows ids.
    """
    import cv2

    halvings = max(0, math.ceil(math.log2(math.sqrt(image.size / ENOUGH_PX)))) if image.size else 0
    for step in (2**k for k in range(halvings, 0, -1)):
        small = cv2.resize(image, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA)
        found = _read(np.asarray(small, dtype=np.uint8), 1, smallest_px)
        if found:
            return [replace(one, corners_px=(one.corners_px + 0.5) * step - 0.5) for one in found]
    return _read(image, upscale, smallest_px)


def _read(image: NDArray[np.uint8], upscale: int, smallest_px: float) -> list[EngravedId]:
    markers = find_markers(image, FAMILY, upscale=upscale, inverted=True, smallest_px=smallest_px)
    grey = np.ascontiguousarray(image, dtype=np.float64)
    found: dict[str, EngravedId] = {}
    for marker in markers:
        pair = _pair(marker, markers, grey)
        name = specimen_of(pair[0].id, pair[1].id) if pair else None
        if pair and name and name not in found:
            found[name] = EngravedId(name, _outline(pair[0]), min(m.score_ratio for m in pair), "marker")
    for qr in _read_qr(image):
        found.setdefault(qr.specimen, qr)
    return [found[name] for name in sorted(found)]


def _pair(marker: Marker, markers: list[Marker], grey: F64) -> tuple[Marker, Marker] | None:
    """Return the marker with its partner, left one first; look for the partner where it must be."""
    side = 1 if marker.id < BASE else -1
    place = CORNERS + np.array([side * PITCH, 0.0])
    expected = warp(marker.H, np.vstack([place, [[side * PITCH, 0.0]]]))
    reach = MOST_MISPLACED * float(np.linalg.norm(expected[1] - expected[0])) / 2
    near = [
        m for m in markers if np.linalg.norm(m.centre_px - expected[4]) < reach and (m.id < BASE) != (marker.id < BASE)
    ]
    partner = near[0] if near else read_quadrilateral(grey, expected[:4], FAMILY, inverted=True)
    if partner is None or (partner.id < BASE) == (marker.id < BASE):
        return None
    if np.linalg.norm(partner.corners_px - expected[:4], axis=1).max() > 2 * reach:
        return None  # turned otherwise than its neighbour
    return (marker, partner) if side == 1 else (partner, marker)


def _outline(left: Marker) -> F64:
    both = np.array([[-1.0, -1.0], [1 + PITCH, -1.0], [1 + PITCH, 1.0], [-1.0, 1.0]])
    return warp(left.H, both)


def _read_qr(image: NDArray[np.uint8]) -> list[EngravedId]:
    import cv2

    good, texts, corners, _ = cv2.QRCodeDetector().detectAndDecodeMulti(image)
    if not good or corners is None:
        return []
    pairs = zip(texts, np.asarray(corners, dtype=np.float64), strict=True)
    return [EngravedId(text, quad.reshape(4, 2), None, "qr") for text, quad in pairs if NAME.fullmatch(text)]
