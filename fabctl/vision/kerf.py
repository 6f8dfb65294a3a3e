"""The kerf from a picture of the coupon: widths by adding up light, with their uncertainty.

Between the sheet's light B and that of an open place D, a slit of width w adds up to w (D - B), however blurred. D is
seen in the open squares, and interpolated between them, since no lamp is even. The rim that the beam chars beside a
slit, of the light C seen in the engraved marks, adds to the sum too. So the profile is fitted by two boxes, open within
charred, blurred alike; how much the fit differs from the plain sum is how much the rim mattered, and a quarter of it
counts as uncertainty. Over a light table open places are far brighter than rubber of any shade and the rim nearly
vanishes; lit from the front it does not, and such a picture gives no kerf to cut by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from design.findings import Finding, errors
from fabctl.errors import RefusedError
from fabctl.vision.align import mark_findings
from fabctl.vision.boards import MarkSheet
from fabctl.vision.coupon import Coupon, Slit, Window, powers_of
from fabctl.vision.markers import Marker, find_all
from fabctl.vision.profile import ToPixels, across, linear_light, missing
from fabctl.vision.quality import picture_findings
from fabctl.vision.template import F64, homography, look, warp

REACH_MM = 1.1
INNER_MM = 0.6
USED = (0.15, 0.85)  # of a slit's length; its ends are wider
STEP_PX = 0.25
COARSE_MM_PX = 0.05  # beyond this the figure is not worth writing down
LEAST_CONTRAST = 0.08  # of light, between sheet and open
RIM_RATIO = 0.25  # of the rim's correction, as a standard uncertainty
LEVEL_RATIO = 0.01  # how well the light of an open place is known
SCALE_RATIO = 0.003
LEAST_KERF_MM = 0.03  # below this the slit is not through
MOST_DISAGREE_MM = 0.04
MOST_RIM_RATIO = 0.2
MOST_MISPLACED_MM = 0.3  # of a mark's centre or side; half a percent of the coupon
OTHER_COUPON = "the coupon.json of this coupon? lying flat?"


@dataclass(frozen=True, slots=True)
class Width:
    """The kerf of one power and direction; `uncertainty_mm` is expanded (k = 2)."""

    power_frac: float
    axis: str
    kerf_mm: float
    uncertainty_mm: float
    spread_mm: float
    slits_count: int
    through: bool


@dataclass(frozen=True, slots=True)
class KerfMeasurement:
    """All widths of a coupon, the kerfs its squares show, and what is doubtful."""

    widths: tuple[Width, ...]
    window_kerf_mm: dict[float, float]  # power -> what its squares are wider than drawn; not corrected for the rim
    mm_per_px: float
    rim_ratio: float  # how much darker charred rubber looks than bare, against the contrast of open and bare
    findings: tuple[Finding, ...]


def measure(image: NDArray[np.uint8], source: str, coupon: Coupon, gamma: str = "srgb") -> KerfMeasurement:
    """Return the kerfs that a grey picture of the cut coupon shows; raise `RefusedError` with all reasons against."""
    found = picture_findings(image, source)
    if errors(found):
        raise RefusedError("the picture cannot be measured in", found)
    ids = {mark.id for mark in coupon.marks.marks}
    markers = [m for m in find_all(image, coupon.marks.family, inverted=True) if m.id in ids]
    found += mark_findings(markers, image, coupon.marks, 4)
    if errors(found):
        raise RefusedError("the coupon's marks are not found", found)
    H = _coupon_to_pixels(markers, coupon.marks)
    found += _layout_findings(H, markers, coupon.marks, source)

    def to_pixels(points_mm: F64) -> F64:
        return warp(H, points_mm)

    light = linear_light(image, gamma)
    mm_per_px = _mm_per_px(H, coupon)
    if mm_per_px > COARSE_MM_PX * 1.02:
        text = f"a pixel is {mm_per_px:.3f} mm, {COARSE_MM_PX:g} mm is the most for a kerf"
        found.append(Finding("KERF-COARSE", text, where=source, hint="nearer, or a flatbed scanner at 600 dpi"))
    levels = [_level(light, to_pixels, window, mm_per_px) for window in coupon.windows]
    found += _contrast_findings(levels, source)
    if errors(found):
        raise RefusedError("the kerf cannot be measured in this picture", found)
    scene = _Scene(light, to_pixels, mm_per_px, _field(coupon.windows, levels), _charred(light, markers))
    widths = tuple(
        _width(scene, [s for s in coupon.slits if (s.power_frac, s.axis) == (power, axis)])
        for power in powers_of(coupon)
        for axis in ("x", "y")
    )
    squares = {
        power: float(np.mean([_window_kerf(scene, w) for w in coupon.windows if w.power_frac == power]))
        for power in powers_of(coupon)
    }
    bare, opened = np.median(np.array(levels), axis=0)
    rim = float(abs(bare - scene.charred_frac) / abs(opened - bare))
    found += [_rim_finding(rim, source)] if rim > MOST_RIM_RATIO else _doubts(widths, squares, source)
    return KerfMeasurement(widths, squares, mm_per_px, rim, tuple(found))


@dataclass(frozen=True, slots=True)
class _Scene:
    """A picture of light in which slits are measured: how open and charred places look in it."""

    light: F64
    to_pixels: ToPixels
    mm_per_px: float
    open_field: F64  # (6,) coefficients of `_terms`
    charred_frac: float

    def open_light(self, place_mm: F64) -> float:
        """Return the light of an open place at a point (2,)."""
        return float(_terms(place_mm[None])[0] @ self.open_field)


def _terms(places_mm: F64) -> F64:
    x, y = places_mm.T / 50
    return np.column_stack([np.ones_like(x), x, y, x * y, x * x, y * y])


def _field(windows: Sequence[Window], levels: Sequence[tuple[float, float]]) -> F64:
    """Return how the light of open places changes over the coupon: quadratic, as far as its windows can tell."""
    places = np.array([window.centre_mm for window in windows])
    inside = np.array([level[1] for level in levels])
    rows = _terms(places)
    found = np.zeros(rows.shape[1])
    columns = [0, 1, 4] if len(windows) < 6 else [0, 1, 2, 4] if len(windows) < 9 else list(range(6))
    found[columns] = np.linalg.lstsq(rows[:, columns], inside, rcond=None)[0]
    return found


def _coupon_to_pixels(markers: Sequence[Marker], sheet: MarkSheet) -> F64:
    """Return the homography from coupon millimetres to pixels, by all corners of all marks.

    The marks' own corners make the map's scale local; ink gain moves opposite corners alike, so it cancels.
    """
    pairs = [(marker, mark) for marker in markers if (mark := sheet.mark(marker.id)) is not None]
    told = np.vstack([np.vstack([mark.corners_mm, mark.centre_mm]) for _, mark in pairs])
    seen = np.vstack([np.vstack([marker.corners_px, marker.centre_px]) for marker, _ in pairs])
    return homography(told, seen)


def _layout_findings(H: F64, markers: Sequence[Marker], sheet: MarkSheet, source: str) -> list[Finding]:
    """Return an error where the marks do not lie as the coupon's: it is another one, or the picture is bent."""
    pairs = [(marker, mark) for marker in markers if (mark := sheet.mark(marker.id)) is not None]
    back = np.asarray(np.linalg.inv(H), dtype=np.float64)
    seen = warp(back, np.array([marker.centre_px for marker, _ in pairs]))
    off_mm = float(np.linalg.norm(seen - np.array([mark.centre_mm for _, mark in pairs]), axis=1).max())
    if off_mm > MOST_MISPLACED_MM:
        text = f"a mark lies {off_mm:.2f} mm from where this coupon has it, {MOST_MISPLACED_MM:g} mm is the limit"
        return [Finding("KERF-COUPON", text, where=source, hint=OTHER_COUPON)]
    # Four marks of a coupon with more rows or fewer are stretched into place without a rest; their sides tell it.
    corners = np.array([warp(back, marker.corners_px) for marker, _ in pairs])
    told = np.array([mark.side_mm for _, mark in pairs])
    off_mm = max(float(np.median(np.abs(_side_mm(corners, k) - told))) for k in (0, 1))
    if off_mm > MOST_MISPLACED_MM:
        text = f"the marks' sides are {off_mm:.2f} mm off, {MOST_MISPLACED_MM:g} mm is the limit"
        return [Finding("KERF-COUPON", text, where=source, hint=OTHER_COUPON)]
    return []


def _side_mm(corners: F64, first: int) -> F64:
    """Return the mean length of two opposite sides of squares (n, 4, 2), the first from corner `first`."""
    a, b, c, d = (corners[:, (first + k) % 4] for k in range(4))
    return np.asarray((np.linalg.norm(b - a, axis=1) + np.linalg.norm(d - c, axis=1)) / 2, dtype=np.float64)


def _mm_per_px(H: F64, coupon: Coupon) -> float:
    middle = np.array(coupon.size_mm) / 2
    near = warp(H, middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(2 / (np.linalg.norm(near[1] - near[0]) + np.linalg.norm(near[2] - near[0])))


def _level(light: F64, to_pixels: ToPixels, window: Window, mm_per_px: float) -> tuple[float, float]:
    """Return the light of the sheet around a window, and inside it."""
    inner = np.linspace(-0.25, 0.25, 15) * window.side_mm
    outer = window.side_mm / 2 + max(0.6, 8 * mm_per_px)
    middle = np.array(window.centre_mm)
    square = np.stack(np.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    edge = np.linspace(-window.side_mm / 2, window.side_mm / 2, 25)
    ring = np.vstack([np.column_stack([edge, np.full(25, outer)]), np.column_stack([edge, np.full(25, -outer)])])
    around, inside = (look(light, to_pixels(middle + points)) for points in (ring, square))
    return float(np.median(around)), float(np.median(inside))


def _contrast_findings(levels: Sequence[tuple[float, float]], source: str) -> list[Finding]:
    found = []
    weakest = min(abs(inside - outside) for outside, inside in levels)
    if weakest < LEAST_CONTRAST:
        text = f"open squares differ from the sheet by {weakest:.2f} of full light, {LEAST_CONTRAST:g} is needed"
        hint = "did the squares fall out? light from behind, dark sheet; or a dark ground under a light sheet"
        found.append(Finding("KERF-CONTRAST", text, where=source, hint=hint))
    if max(inside for _, inside in levels) > 0.985:
        text = "the open squares are saturated, so their light is unknown"
        found.append(Finding("KERF-SATURATED", text, where=source, hint="shorter exposure"))
    return found


def _charred(light: F64, markers: Sequence[Marker]) -> float:
    """Return the light of charred rubber: the frames of the engraved marks."""
    frame = np.array([[x, y] for y in (-6 / 7, 6 / 7) for x in np.linspace(-0.8, 0.8, 15)])
    return float(np.median([look(light, warp(marker.H, frame)).mean() for marker in markers]))


def _width(scene: _Scene, slits: Sequence[Slit]) -> Width:
    """Return the kerf of slits alike: the mean over slits, its spread over them."""
    each = np.array([_slit_mm(scene, slit) for slit in slits])
    plain, fitted = each[:, 0].mean(), each[:, 1].mean()
    spread = float(each[:, 1].std(ddof=1)) if len(each) > 1 else 0.0
    parts = (
        spread / math.sqrt(len(each)),
        (LEVEL_RATIO + SCALE_RATIO) * fitted,
        RIM_RATIO * abs(plain - fitted),
        0.02 * scene.mm_per_px,
    )
    first, kerf = slits[0], float(fitted)
    return Width(first.power_frac, first.axis, kerf, 2 * math.hypot(*parts), spread, len(each), kerf >= LEAST_KERF_MM)


def _slit_mm(scene: _Scene, slit: Slit) -> tuple[float, float]:
    """Return a slit's width by the plain sum, and by the fit that allows for a charred rim."""
    length = float(np.linalg.norm(slit.ends[1] - slit.ends[0]))
    along = np.arange(USED[0] * length, USED[1] * length, scene.mm_per_px)
    step = STEP_PX * scene.mm_per_px
    rows = across(scene.light, scene.to_pixels, slit.ends, REACH_MM, step, along)
    background, lacking = missing(rows, INNER_MM)
    open_light = scene.open_light(slit.ends.mean(axis=0))
    plain = float(np.median((lacking / (background - open_light)).sum(axis=1)) * step)
    inner = np.abs(rows.offset_mm) < INNER_MM
    bare = float(background.mean())
    mean = -lacking.mean(axis=0)[inner]
    return plain, _two_boxes(
        rows.offset_mm[inner], mean, open_light - scene.charred_frac, scene.charred_frac - bare, plain
    )


def _two_boxes(offset: F64, light: F64, opened: float, charred: float, start_mm: float) -> float:
    """Return the width of the open box within a charred one that explain the light added to the bare sheet's."""

    def box(width: float, middle: float, blur: float) -> F64:
        return np.asarray(ndtr((offset - middle + width / 2) / blur) - ndtr((offset - middle - width / 2) / blur))

    def residual(q: F64) -> F64:
        width, rim, middle, blur = (float(value) for value in q)
        return charred * box(width + 2 * rim, middle, blur) + opened * box(width, middle, blur) - light

    start = [float(np.clip(start_mm, 0.02, 0.5)), 0.03, 0.0, 0.05]
    found = least_squares(residual, start, bounds=([0.0, 0.0, -0.3, 0.01], [0.6, 0.3, 0.3, 0.3]))
    return float(found.x[0])


def _window_kerf(scene: _Scene, window: Window) -> float:
    """Return by how much an open square is wider than drawn, the mean over both directions."""
    step = STEP_PX * scene.mm_per_px
    reach, inner = window.side_mm / 2 + REACH_MM, window.side_mm / 2 + INNER_MM
    found = []
    for axis in (0, 1):
        unit = np.eye(2)[axis] * 0.3 * window.side_mm
        ends = np.array([np.array(window.centre_mm) - unit, np.array(window.centre_mm) + unit])
        along = np.arange(0, float(np.linalg.norm(ends[1] - ends[0])), scene.mm_per_px)
        rows = across(scene.light, scene.to_pixels, ends, reach, step, along)
        background, lacking = missing(rows, inner)
        share = lacking / (background - scene.open_light(np.array(window.centre_mm)))
        found.append(float(np.median(share.sum(axis=1)) * step) - window.side_mm)
    return float(np.mean(found))


def _doubts(widths: Sequence[Width], squares: dict[float, float], source: str) -> list[Finding]:
    found = []
    for power, square in squares.items():
        mine = [w for w in widths if w.power_frac == power]
        if not all(w.through for w in mine):
            text = f"slits at power {power:g} are not through"
            found.append(Finding("KERF-NOT-THROUGH", text, "warning", source, "more power, slower, or more passes"))
        elif abs(square - float(np.mean([w.kerf_mm for w in mine]))) > MOST_DISAGREE_MM:
            text = f"at power {power:g} the square shows a kerf of {square:.3f} mm, the slits {mine[0].kerf_mm:.3f} mm"
            found.append(Finding("KERF-DISAGREE", text, "warning", source, "did the sheet move, or the square tilt?"))
    return found


def _rim_finding(ratio: float, source: str) -> Finding:
    text = f"charred rims differ from the sheet by {ratio:.0%} of what slits do, so they look like slit"
    hint = f"light the coupon from behind; {MOST_RIM_RATIO:.0%} is the limit"
    return Finding("KERF-RIM", text, "warning", source, hint)


def kerf_at(measurement: KerfMeasurement, power_frac: float) -> tuple[float, float]:
    """Return the kerf at a power, the mean of both directions, and its uncertainty (k = 2), linear between powers.

    Raises `RefusedError` outside the powers that came through. Half the difference between the directions counts as
    uncertainty, since one number stands for both.
    """
    if measurement.rim_ratio > MOST_RIM_RATIO:
        raise RefusedError("no kerf to cut by", [_rim_finding(measurement.rim_ratio, "")])
    good = sorted({w.power_frac for w in measurement.widths if w.through})
    good = [p for p in good if all(w.through for w in measurement.widths if w.power_frac == p)]
    if not good or not good[0] - 1e-9 <= power_frac <= good[-1] + 1e-9:
        span = f"{good[0]:g} to {good[-1]:g}" if good else "none"
        text = f"power {power_frac:g} lies outside the powers that cut through ({span})"
        raise RefusedError("no kerf for this power", [Finding("KERF-POWER", text, hint="cut a coupon around it")])
    pairs = [[w for w in measurement.widths if w.power_frac == p] for p in good]
    kerfs = [float(np.mean([w.kerf_mm for w in pair])) for pair in pairs]
    doubts = [
        math.hypot(max(w.uncertainty_mm for w in pair), abs(pair[0].kerf_mm - pair[-1].kerf_mm) / 2) for pair in pairs
    ]
    return float(np.interp(power_frac, good, kerfs)), float(np.interp(power_frac, good, doubts))
