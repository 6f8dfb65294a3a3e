"""Around the cells: the rim to clamp, the tag that carries the id, the marks on the sheet, and the sheet's size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from shapely.affinity import translate
from shapely.geometry.base import BaseGeometry

from design.pattern.drawing import Box, Drawing
from design.pattern.font import Anchor
from design.pattern.paths import CutPath
from design.pattern.tiling import Array

CLEARANCE_MM = 1.0  # around text and code on the tag, and between tag and piece
NECK_MM = 4.0  # width of the bridge that holds the tag
CODE_MODULES = (18, 8)  # width and height of the id's code: two markers of 8 modules, 2 apart
MARK_SIDES_COUNT = 64


@dataclass(frozen=True, slots=True)
class BorderOptions:
    """What is added around the cells: a rim to clamp, a tag for the id, marks for registration, room on the sheet.

    The tag holds the id as text of `id_height_mm` and leaves room for its code of `code_module_mm` a module; no
    `id_height_mm` means no tag.
    """

    margin_mm: float = 0.0
    marks: bool = True
    mark_mm: float = 4.0
    sheet_margin_mm: float = 10.0
    id_height_mm: float = 3.0
    id_width_mm: float = 16.0
    code_module_mm: float = 0.8


def framed(
    piece: BaseGeometry,
    mouths_mm: Array,
    paths: Sequence[CutPath],
    options: BorderOptions,
    edge_mm: float,
    joins: BaseGeometry | None = None,
) -> tuple[Drawing, Array]:
    """Return the whole drawing, with its lower left corner in the origin, and by how much all was moved, `(2,)`.

    `piece` is the cells with their rim, `mouths_mm` `(b, 2)` are where slits open on the cells' border; the tag's neck
    keeps clear of them where it can, and of what will be joined on at `joins`. Where no lower edge has room for the
    tag, there is none.
    """
    anchor, code = None, None
    if options.id_height_mm > 0:
        piece, anchor, code = with_tag(piece, mouths_mm, options, edge_mm, joins)
    low_x, low_y, high_x, high_y = piece.bounds
    room = options.sheet_margin_mm
    shift = np.array([room - low_x, room - low_y])
    size = (float(high_x - low_x + 2 * room), float(high_y - low_y + 2 * room))
    drawn = [_moved(path, shift) for path in paths]
    drawn += border_paths(piece, shift)
    if options.marks:
        drawn += registration_marks(size, options)
    return (
        Drawing(
            size,
            tuple(drawn),
            anchor and Anchor(anchor.x_mm + shift[0], anchor.y_mm + shift[1], anchor.height_mm, anchor.width_mm),
            code and Box(code.x_mm + shift[0], code.y_mm + shift[1], code.width_mm, code.height_mm),
        ),
        shift,
    )


def piece_of(loops_mm: Sequence[Array], margin_mm: float = 0.0) -> BaseGeometry:
    """Return the area that loops bound, with a rim of `margin_mm` around it."""
    outer = [shapely.Polygon(loop) for loop in loops_mm if shapely.LinearRing(loop).is_ccw]
    inner = [shapely.Polygon(loop) for loop in loops_mm if not shapely.LinearRing(loop).is_ccw]
    return rimmed_by(shapely.union_all(outer).difference(shapely.union_all(inner)), margin_mm)


def rimmed_by(piece: BaseGeometry, margin_mm: float) -> BaseGeometry:
    """Return a piece grown by a rim."""
    return piece.buffer(margin_mm, join_style="mitre", mitre_limit=2.0) if margin_mm > 0 else piece


def border_paths(piece: BaseGeometry, shift_mm: Array) -> list[CutPath]:
    """Return the outlines of a piece that is moved by `shift_mm`."""
    return [CutPath("outline", ring, closed=True) for ring in _rings(translate(piece, *shift_mm))]


def _rings(piece: BaseGeometry) -> list[Array]:
    """Return a piece's border loops, outer ones counter-clockwise, inner ones clockwise."""
    rings = []
    for part in getattr(piece, "geoms", [piece]):
        oriented = shapely.geometry.polygon.orient(part)
        rings += [np.asarray(ring.coords)[:-1] for ring in (oriented.exterior, *oriented.interiors)]
    return rings


def _moved(path: CutPath, shift_mm: Array) -> CutPath:
    return CutPath(path.layer, path.points_mm + shift_mm, path.closed, path.cell, path.opens)


def registration_marks(size_mm: tuple[float, float], options: BorderOptions) -> list[CutPath]:
    """Return a ring and a cross in three corners of the sheet: which way it lies can be seen from them.

    Nothing where the sheet's margin has no room for them.
    """
    inset, radius = options.sheet_margin_mm / 2, options.mark_mm / 2
    if inset < radius + CLEARANCE_MM / 2:
        return []
    angle = 2 * math.pi * np.arange(MARK_SIDES_COUNT) / MARK_SIDES_COUNT
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    arm = np.array([[-radius, 0.0], [radius, 0.0]])
    found = []
    for corner in ((inset, inset), (size_mm[0] - inset, inset), (inset, size_mm[1] - inset)):
        at = np.array(corner)
        found.append(CutPath("mark", ring + at, closed=True))
        found += [CutPath("mark", stroke + at) for stroke in (arm, arm[:, ::-1])]
    return found


def with_tag(
    piece: BaseGeometry, mouths_mm: Array, options: BorderOptions, edge_mm: float, joins: BaseGeometry | None
) -> tuple[BaseGeometry, Anchor | None, Box | None]:
    """Return the piece with a tag hanging from its lowest edge that has room, and the places on the tag.

    The piece alone where no edge has.
    """
    code_width, code_height = (count * options.code_module_mm for count in CODE_MODULES)
    width = max(options.id_width_mm, code_width) + 2 * CLEARANCE_MM
    height = options.id_height_mm + 2 * CLEARANCE_MM + (code_height + CLEARANCE_MM if code_height > 0 else 0.0)
    narrow = min(NECK_MM, edge_mm / 3)
    # Cells too small to pass between their mouths: the neck closes a few of them.
    places = [(at, narrow) for at in _neck_places(piece, mouths_mm, narrow)]
    places += [(at, NECK_MM) for at in _neck_places(piece, np.zeros((0, 2)), NECK_MM)]
    if joins is not None:
        places.sort(key=lambda place: joins.distance(shapely.Point(place[0])) < CLEARANCE_MM)
    for (x, y), neck in places:
        body = shapely.box(x - width / 2, y - CLEARANCE_MM - height, x + width / 2, y - CLEARANCE_MM)
        if body.distance(piece) < CLEARANCE_MM - 1e-9:
            continue
        bridge = shapely.box(x - neck / 2, y - CLEARANCE_MM, x + neck / 2, y)
        joined = shapely.union_all([piece, body, bridge])
        base = y - CLEARANCE_MM - height + CLEARANCE_MM
        code = Box(x - code_width / 2, base, code_width, code_height) if code_height > 0 else None
        text_y = y - 2 * CLEARANCE_MM - options.id_height_mm / 2
        return joined, Anchor(x, text_y, options.id_height_mm, width - 2 * CLEARANCE_MM), code
    return piece, None, None


def _neck_places(piece: BaseGeometry, mouths_mm: Array, neck_mm: float) -> list[tuple[float, float]]:
    """Return the middles of level stretches of the lower border that are free of slit mouths, lowest first."""
    found = []
    for ring in _rings(piece):
        for a, b in zip(ring.tolist(), np.roll(ring, -1, axis=0).tolist(), strict=True):
            if abs(b[1] - a[1]) > 1e-9 or b[0] <= a[0]:
                continue  # counter-clockwise, so that the lower border runs towards +x
            mouths = mouths_mm[np.abs(mouths_mm[:, 1] - a[1]) < 1e-6, 0]
            stops = np.sort(np.r_[a[0], mouths[(mouths > a[0]) & (mouths < b[0])], b[0]])
            for left, right in pairwise(stops.tolist()):
                if right - left >= neck_mm + 2 * CLEARANCE_MM:
                    found.append(((left + right) / 2, a[1]))
    return sorted(found, key=lambda place: (round(place[1], 6), abs(place[0] - piece.centroid.x)))
