"""From drawn paths to strokes of the beam: kerf, slit width, lead-in, overcut, tabs and passes.

A drawn path is the edge of what should remain (outline, hole) or the centre line of what should go (slit). The beam has
a width, so it must run half of that beside an edge, and end half of that before the end of a slit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import shapely

from design.errors import DesignError
from design.pattern.paths import CutPath
from design.pattern.tiling import Array

SINGLE_RATIO = 1.25  # a slit up to this many kerfs wide is one pass along its centre line
MITRE_RATIO = 5.0  # corners sharper than this many half kerfs are cut off

LEAD_SHARES = (1.0, 0.5, 0.25)  # of the lead-in that is asked for, tried in turn
LEAD_CORNERS_COUNT = 64  # of a ring, at which it may begin
ROUNDING_MM = 1e-6

Sides = Literal["auto", "single", "both"]


@dataclass(frozen=True, slots=True)
class ToolOptions:
    """What the beam is and how it goes about a contour.

    `kerf_mm` is the width the beam burns away. `slit_width_mm` is how wide slits are wanted; None means one kerf.
    Lead-in and overcut belong to closed paths; tabs to the outline.
    """

    kerf_mm: float = 0.125
    slit_width_mm: float | None = None
    slit_sides: Sides = "auto"
    lead_in_mm: float = 0.0
    overcut_mm: float = 0.0
    tabs_count: int = 0
    tab_mm: float = 0.4


def strokes_of(paths: Sequence[CutPath], options: ToolOptions = ToolOptions()) -> list[CutPath]:
    """Return what the beam does for each drawn path, in the same order; every stroke is open, first point to last."""
    found: list[CutPath] = []
    for path in paths:
        if path.layer == "slit":
            found += _slit(path, options)
        elif path.closed:
            found += _contour(path, _waste_side(path), options)
        else:
            found.append(path)
    return found


def _waste_side(path: CutPath) -> int:
    """Return 1 where the waste is outside the closed path, −1 where it is inside, 0 where nothing falls off.

    A counter-clockwise outline bounds the piece from outside; a clockwise one bounds an opening in it.
    """
    if path.layer == "outline" and signed_area_mm2(path.points_mm) > 0:
        return 1
    return -1 if path.layer in ("outline", "hole") else 0


def signed_area_mm2(loop_mm: Array) -> float:
    """Return the area inside a closed loop, positive where it runs counter-clockwise."""
    x, y = (loop_mm - loop_mm[0]).T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _slit(path: CutPath, options: ToolOptions) -> list[CutPath]:
    width = options.kerf_mm if options.slit_width_mm is None else options.slit_width_mm
    if width < options.kerf_mm - 1e-9 and options.slit_sides == "both":
        raise DesignError(f"a slit of {width:g} mm cannot be cut on both sides by a kerf of {options.kerf_mm:g} mm")
    both = options.slit_sides == "both" or (options.slit_sides == "auto" and width > SINGLE_RATIO * options.kerf_mm)
    line = path.points_mm if path.closed else _shortened(path, options.kerf_mm / 2)
    if not both or width <= options.kerf_mm:
        return [replace(path, points_mm=line)]
    around = shapely.LineString(line).buffer((width - options.kerf_mm) / 2, cap_style="flat", join_style="mitre")
    ring = np.asarray(around.exterior.coords)[:-1]
    return _contour(replace(path, points_mm=ring, closed=True), 0, options)


def _shortened(path: CutPath, by_mm: float) -> Array:
    """Return the slit with `by_mm` taken off its inner ends, which the beam's own radius burns."""
    along = along_mm(path.points_mm)
    end_mm = along[-1] if path.opens else along[-1] - by_mm
    return _between(path.points_mm, along, by_mm, end_mm) if end_mm > by_mm else path.points_mm


def _contour(path: CutPath, waste_side: int, options: ToolOptions) -> list[CutPath]:
    """Return the strokes round a closed path: moved by half a kerf into the waste, with lead-in, overcut and tabs."""
    rings = _offset(path, waste_side * options.kerf_mm / 2)
    found = []
    for ring in rings:
        lead = np.zeros((0, 2))
        if options.lead_in_mm and waste_side and not (options.tabs_count and path.layer == "outline"):
            ring, lead = _led_into(ring, waste_side, options.lead_in_mm)
        loop = np.vstack([ring, ring[:1]])
        if options.tabs_count and path.layer == "outline":
            found += [replace(path, points_mm=piece, closed=False) for piece in _tabbed(loop, options)]
            continue
        if options.overcut_mm:
            loop = np.vstack([loop, _first_mm(loop, options.overcut_mm)[1:]])
        found.append(replace(path, points_mm=np.vstack([lead, loop]), closed=False))
    return found


def _offset(path: CutPath, offset_mm: float) -> list[Array]:
    if offset_mm == 0:
        return [path.points_mm]
    polygon = shapely.Polygon(path.points_mm)
    if not polygon.is_valid:
        raise DesignError(f"a closed path on the layer {path.layer} crosses itself, so it has no inside")
    moved = polygon.buffer(offset_mm, join_style="mitre", mitre_limit=MITRE_RATIO)
    parts = [part for part in getattr(moved, "geoms", [moved]) if not part.is_empty]
    if not parts:
        raise DesignError(
            f"a closed path on the layer {path.layer} is narrower than the kerf ({2 * abs(offset_mm):g} mm)"
        )
    counter_clockwise = signed_area_mm2(path.points_mm) > 0
    rings = [np.asarray(part.exterior.coords)[:-1] for part in parts]
    return [ring if (signed_area_mm2(ring) > 0) == counter_clockwise else ring[::-1] for ring in rings]


def _led_into(ring_mm: Array, waste_side: int, length_mm: float) -> tuple[Array, Array]:
    """Return the ring from the corner on which its lead-in keeps to the waste, and where that begins, `(1, 2)`.

    Where the waste is too narrow everywhere the lead-in is shorter, and at last none, `(0, 2)`.
    """
    area = shapely.Polygon(ring_mm)
    step = max(1, len(ring_mm) // LEAD_CORNERS_COUNT)
    for share in LEAD_SHARES:
        for corner in range(0, len(ring_mm), step):
            ring = np.roll(ring_mm, -corner, axis=0)
            begin = _lead_in(ring, waste_side, share * length_mm)
            way = shapely.LineString([begin[0], ring[0]])
            burnt = way.difference(area) if waste_side < 0 else way.intersection(area)
            if burnt.length < ROUNDING_MM:
                return ring, begin
    return ring_mm, np.zeros((0, 2))


def _lead_in(ring_mm: Array, waste_side: int, length_mm: float) -> Array:
    """Return the point from which the beam comes to the ring's first corner, along its bisector on the waste side."""
    into = ring_mm[0] - ring_mm[-1]
    on = ring_mm[1] - ring_mm[0]
    turned = into / np.linalg.norm(into) + on / np.linalg.norm(on)
    normal = np.array([turned[1], -turned[0]])
    size = np.linalg.norm(normal)
    normal = normal / size if size > 1e-9 else into / np.linalg.norm(into)
    side = waste_side if signed_area_mm2(ring_mm) > 0 else -waste_side
    return np.asarray(ring_mm[:1] + side * length_mm * normal)


def _first_mm(line_mm: Array, length_mm: float) -> Array:
    """Return the beginning of a polyline, `length_mm` long."""
    return _between(line_mm, along_mm(line_mm), 0.0, length_mm)


def along_mm(line_mm: Array) -> list[float]:
    """Return how far along a polyline each of its points lies; in plain numbers, because most lines have three."""
    found = [0.0]
    for a, b in pairwise(line_mm.tolist()):
        found.append(found[-1] + math.dist(a, b))
    return found


def _between(line_mm: Array, along: Sequence[float], start_mm: float, end_mm: float) -> Array:
    """Return the part of a polyline between two distances along it; `along` says how far its points lie."""
    marks = [start_mm, *(s for s in along if start_mm + 1e-9 < s < end_mm - 1e-9), min(end_mm, along[-1])]
    found = np.empty((len(marks), 2))
    found[:, 0], found[:, 1] = np.interp(marks, along, line_mm[:, 0]), np.interp(marks, along, line_mm[:, 1])
    return found


def _tabbed(loop_mm: Array, options: ToolOptions) -> list[Array]:
    """Return the loop as pieces with gaps between, so that bridges of `tab_mm` hold the piece in the sheet."""
    length = along_mm(loop_mm)[-1]
    pitch = length / options.tabs_count
    bare = options.tab_mm + options.kerf_mm  # the beam burns half a kerf into the bridge from each end
    if pitch <= bare:
        raise DesignError(
            f"{options.tabs_count} tabs of {options.tab_mm:g} mm do not fit on {length:.1f} mm of outline"
        )
    twice = np.vstack([loop_mm, loop_mm[1:]])
    along = along_mm(twice)
    starts = pitch * (np.arange(options.tabs_count) + 0.5) + bare / 2
    return [_between(twice, along, start, start + pitch - bare) for start in starts.tolist()]
