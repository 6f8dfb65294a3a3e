"""The parametric bistable cell: where its slits run, and which (t, θ) give a cell at all.

Frame: the unit triangle V0 = (0, 0), V1 = (edge, 0), V2 above; slit 1 starts on the edge V0V2 at distance t from V0 and
runs in direction θ; slits 2 and 3 are slit 1 turned by 120° and 240° about the centroid (Chen et al. 2021, App. II).
The three slits leave an inner triangle and three arms; a hinge joins each arm to a corner of the inner triangle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells.sheet import Sheet

Array = NDArray[np.float64]
SQRT3 = math.sqrt(3.0)
THIRD_TURN = np.array([[-0.5, -SQRT3 / 2], [SQRT3 / 2, -0.5]])  # rotation by 120°
EDGE_DIRECTION = np.array([0.5, SQRT3 / 2])  # of V0V2
MOUTH_SHARE = 0.4  # of the hinge: slit 2 must reach this far past the tip of slit 1 to form a hinge
TOUCH_RATIO = 1e-4  # of the edge: closer than this, two borders of the cell count as touching


def centroid_mm(edge_mm: float) -> Array:
    """Return the centroid of the unit triangle, (2,)."""
    return np.array([edge_mm / 2, edge_mm / (2 * SQRT3)])


def turned(points_mm: Array, centre_mm: Array) -> Array:
    """Return `points_mm` (n, 2) turned by 120° about `centre_mm`."""
    return np.asarray((points_mm - centre_mm) @ THIRD_TURN.T + centre_mm)


@dataclass(frozen=True, slots=True)
class Sector:
    """The corners of a third of the unit triangle, one arm with its hinge; each (2,) in mm.

    Turned twice by 120° about `centre` it fills the unit less its slits. `left`, `corner` and `bottom` lie on the
    mirror edges of the tiling; `cut` and `cut_turned` are the same material point of neighbouring thirds.
    """

    left: Array  # outer line of slit 1, on the edge V0V2
    corner: Array  # V0
    bottom: Array  # inner line of slit 2, on the edge V0V1
    foot_arm: Array  # where the arm's mouth meets the inner line of slit 2
    foot_inner: Array  # where the inner triangle's mouth meets it
    cut_turned: Array
    centre: Array
    cut: Array  # halfway along the inner triangle's side
    tip_inner: Array  # end of slit 1 on its inner line
    tip_outer: Array  # end of slit 1 on its outer line
    blunt: bool  # the slits end before they face one another: no hinge, and the cut runs from the centre to the tip

    def outline_mm(self) -> Array:
        """Return the closed border, counter-clockwise, (10, 2)."""
        ring = (self.left, self.corner, self.bottom, self.foot_arm, self.foot_inner, self.cut_turned)
        return np.array([*ring, self.centre, self.cut, self.tip_inner, self.tip_outer])


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def sector(t_mm: float, theta_rad: float, sheet: Sheet, hinge_mm: float | None = None) -> Sector:
    """Return the sector of the cell (t, θ); its corners may cross where `fault` finds something to say."""
    edge, slit = sheet.edge_mm, sheet.slit_mm
    hinge = sheet.hinge_mm if hinge_mm is None else hinge_mm
    centre = centroid_mm(edge)
    along = np.array([math.cos(theta_rad), math.sin(theta_rad)])
    along_2 = THIRD_TURN @ along
    bottom = np.array([edge - t_mm - slit, 0.0])  # slit 2's inner line passes here with direction `along_2`

    def tip(offset_mm: float) -> Array:
        start = offset_mm * EDGE_DIRECTION
        to_line = _cross(bottom - start, along_2) / _cross(along, along_2)
        return np.asarray(start + (to_line - hinge / math.sin(math.pi / 3)) * along)

    tip_outer, tip_inner = tip(t_mm), tip(t_mm + slit)
    length = float(np.linalg.norm(tip_inner - (t_mm + slit) * EDGE_DIRECTION))
    opposite_inner, opposite_outer = float((tip_inner - bottom) @ along_2), float((tip_outer - bottom) @ along_2)
    # The mouths end on slit 2's inner line: the inner triangle's opposite the tip of slit 1, if slit 2 reaches so far.
    blunt = opposite_inner > length - MOUTH_SHARE * hinge
    reach_inner = length if blunt else opposite_inner
    reach_cut = 0.5 * (reach_inner + length)
    # The arm's mouth slants away from the hinge and downwards, so that the arm is convex at the tip.
    reach_arm = opposite_outer - min(hinge, 0.5 * opposite_outer)
    if tip_outer[1] < hinge:
        reach_arm = min(reach_arm, 0.75 * float(tip_outer[1] / along_2[1]))
    if blunt:
        reach_arm = min(reach_arm, length - hinge)
    cut = tip_inner if blunt else (t_mm + slit) * EDGE_DIRECTION + reach_cut * along
    return Sector(
        left=t_mm * EDGE_DIRECTION,
        corner=np.zeros(2),
        bottom=bottom,
        foot_arm=bottom + reach_arm * along_2,
        foot_inner=bottom + reach_inner * along_2,
        cut_turned=turned(cut[None], centre)[0],
        centre=centre,
        cut=cut,
        tip_inner=tip_inner,
        tip_outer=tip_outer,
        blunt=blunt,
    )


def strip_mm(t_mm: float, theta_rad: float, sheet: Sheet) -> float:
    """Return t_s of Appendix II: how far slit 2's outer line still is from leaving the unit at slit 1's foot."""
    e = sheet.edge_mm
    return t_mm * math.cos(theta_rad) + SQRT3 * (2 * e / 3 - t_mm) * math.sin(theta_rad)


def inner_side_mm(t_mm: float, theta_rad: float, sheet: Sheet) -> float:
    """Return l_i of Appendix II: the side of the inner triangle, measured on the slits' outer lines."""
    e, s = sheet.edge_mm, sheet.slit_mm
    return (2 * s / 3 + t_mm - e) * SQRT3 * math.sin(theta_rad) - (2 * s + 3 * t_mm - e) * math.cos(theta_rad)


def t_bounds_mm(theta_rad: float, sheet: Sheet) -> tuple[float, float]:
    """Return the range of t in which Appendix II allows a cell: t_s = 0 below (or zero), l_i = 0 above."""
    e, s, sin, cos = sheet.edge_mm, sheet.slit_mm, math.sin(theta_rad), math.cos(theta_rad)
    low = 2 * SQRT3 * e * sin / (3 * SQRT3 * sin - 3 * cos)
    high = ((3 * e - 2 * s) * SQRT3 * sin + 3 * (2 * s - e) * cos) / (3 * SQRT3 * sin - 9 * cos)
    return max(low, 0.0), high


def estimated_expansion_ratio(t_mm: float, theta_rad: float, sheet: Sheet) -> float:
    """Return the expansion of the rigid linkage, 1 + 2 l_i/edge · sin(θ + 30°) (Appendix II)."""
    return 1 + 2 * inner_side_mm(t_mm, theta_rad, sheet) / sheet.edge_mm * math.sin(theta_rad + math.pi / 6)


def cell_slits(t_mm: float, theta_rad: float, sheet: Sheet, hinge_mm: float | None = None) -> Array:
    """Return the three slits as quadrilaterals, (3, 4, 2) mm: outer start and end, inner end and start."""
    part = sector(t_mm, theta_rad, sheet, hinge_mm)
    first = np.array([part.left, part.tip_outer, part.tip_inner, (t_mm + sheet.slit_mm) * EDGE_DIRECTION])
    second = turned(first, part.centre)
    return np.array([first, second, turned(second, part.centre)])


def fault(t_mm: float, theta_rad: float, sheet: Sheet, hinge_mm: float | None = None) -> str | None:
    """Return why (t, θ) is not a cell, or None where its polygon is sound."""
    margin = TOUCH_RATIO * sheet.edge_mm
    part = sector(t_mm, theta_rad, sheet, hinge_mm)
    along = np.array([math.cos(theta_rad), math.sin(theta_rad)])
    along_2 = THIRD_TURN @ along
    if t_mm < margin or part.bottom[0] < margin:
        return "a slit starts at or beyond a corner of the unit"
    if float((part.tip_outer - part.left) @ along) < margin:
        return "the hinge leaves no slit"
    if float((part.foot_arm - part.bottom) @ along_2) < margin or part.tip_outer[1] < margin:
        return "the slit's tip touches or crosses the mirror edge"
    if float((part.foot_inner - part.foot_arm) @ along_2) < margin:
        return "the hinge lies beyond the end of the slit it belongs to"
    if self_crossing(part.outline_mm()):
        return "the outline crosses itself"
    return None


def self_crossing(ring_mm: Array) -> bool:
    """Tell whether two edges of the closed polygon (n, 2) cross, or it runs clockwise."""
    a, b = ring_mm, np.roll(ring_mm, -1, axis=0)
    if float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) <= 0:
        return True

    def side(p: Array, q: Array, r: Array) -> Array:
        return np.asarray(
            (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        )

    p, q, r, s = a[:, None], b[:, None], a[None, :], b[None, :]
    rounding = 1e-12 * float(np.abs(ring_mm).max()) ** 4  # corners may coincide
    crosses = (side(p, q, r) * side(p, q, s) < -rounding) & (side(r, s, p) * side(r, s, q) < -rounding)
    return bool(crosses.any())
